"""The comparison of methods: measures of error, splits, and what must hold between methods."""

import numpy as np
import pytest
from conftest import SHARED, shared
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments import methods
from experiments.hand_eye import fit_base_and_tool, fit_mdh_to_poses, solve_hand_eye_in_closed_form
from experiments.methods import MethodJob, pooled_figure
from experiments.pose_fitting import (
    fit_poses_to_points,
    orientation_error,
    rotation_lever_arm,
    transform_points,
    triangle_from_distances,
    twist_exponential,
)
from experiments.product_of_exponentials import (
    ScrewArm,
    build_screw_arm,
    fit_screws_to_poses,
    fit_screws_to_positions,
)
from minimax_cal.core.arrays import Array
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.transforms import build_transform, invert_transform

# ---- methods -------------------------------------------------------------------------------------


def moved_triangle(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Corners, poses and corners at these poses."""
    shape = triangle_from_distances(rng.normal(size=(1, 3, 3)))
    poses = twist_exponential(rng.normal(size=(30, 6)))
    return shape, poses, transform_points(poses, shape)


def test_poses_of_a_triangle_are_recovered(rng):
    shape, poses, y = moved_triangle(rng)
    assert_allclose(triangle_from_distances(y), shape, atol=1e-13)
    assert_allclose(shape.mean(axis=0), 0.0, atol=1e-15)
    assert_allclose(fit_poses_to_points(shape, y), poses, atol=1e-13)


def test_errors_of_known_poses(rng):
    measured = twist_exponential(rng.normal(size=(30, 6)))
    turn = rng.normal(size=(30, 3))
    other = measured @ build_transform(
        Rotation.from_rotvec(turn).as_matrix(), np.tile([0.3, 0, 0.4], (30, 1))
    )
    assert_allclose(orientation_error(measured, other), np.linalg.norm(turn, axis=1), atol=1e-12)


def test_real_robots_improve_held_out():
    shared("irb120")
    case = methods.list_cases(quick=True)[1]
    outcomes = {
        name: [methods.run_method(MethodJob(case, 0, name, 0, SHARED))]
        for name in ("nominal", "POE pose", "MDH pose", "sum")
    }
    error = {name: pooled_figure(each, "AP RMSE", "held out") for name, each in outcomes.items()}
    assert 0.7 < error["nominal"] < 1.1  # [mm]
    assert error["POE pose"] == pytest.approx(error["MDH pose"], rel=1e-6)
    assert max(error["MDH pose"], error["sum"]) < 0.4


# ---- poe -----------------------------------------------------------------------------------------


EXACT = Truth(compliance=0, noise=0, noise_per_metre=0)
ROUNDING = 1e-12


@pytest.mark.parametrize("name", mc.builtin_robots())
def test_same_forward_kinematics_as_the_links(name, rng):
    robot = mc.load_robot(name)
    q, tool = random_joint_values_above_floor(robot, 40, rng), twist_exponential(rng.normal(size=6))
    found = build_screw_arm(robot, tool).tool_poses(q * robot.sign)
    assert_allclose(found, robot.pose(q) @ tool, rtol=0, atol=ROUNDING)


def measured_arm(name: str, truth: Truth) -> tuple[mc.Robot, Array, Array, float, ScrewArm]:
    """Robot, joints, poses in the nominal base, lever, and nominal screws."""
    robot = mc.load_robot(name)
    data = simulate(robot, 40, 3, seed=3, truth=truth).data
    q, shape = data.q * robot.sign, triangle_from_distances(data.y)
    poses = fit_poses_to_points(shape, data.y)
    arm = fit_base_and_tool(robot.mdh, q, robot.prismatic, poses, rotation_lever_arm(shape)).x
    return (
        robot,
        q,
        invert_transform(arm.base) @ poses,
        rotation_lever_arm(shape),
        build_screw_arm(robot, arm.tool),
    )


@pytest.mark.parametrize(
    ("name", "independent"), [("irb2600", 30), ("ur10", 30), ("scara_600", 20)]
)
def test_exact_poses_are_met(name, independent):
    _, q, poses, length, nominal = measured_arm(name, EXACT)
    found = fit_screws_to_poses(nominal, q, poses, length)
    assert found.status == "converged"
    assert found.identified == independent  # 4 a turning joint, 2 a slide, 6 of the tool
    assert_allclose(found.x.tool_poses(q), poses, rtol=0, atol=1e-10)
    spot = build_transform(
        np.eye(3), np.array([0.1, 0.0, 0.0])
    )  # off the last axis, to see that it turns
    seen = (poses @ spot)[:, :3, 3]
    found = fit_screws_to_positions(ScrewArm(nominal.twists, nominal.tool @ spot), q, seen)
    assert found.identified == independent - 3
    assert_allclose(found.x.tool_poses(q)[:, :3, 3], seen, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", ["irb2600", "ur10", "scara_600"])
def test_poe_and_mdh_describe_the_same_arms(name):
    robot, q, poses, length, nominal = measured_arm(name, Truth())
    screws = fit_screws_to_poses(nominal, q, poses, length)
    links = fit_base_and_tool(robot.mdh, q, robot.prismatic, poses, length, with_links=True)
    assert screws.identified == links.identified
    assert screws.cost == pytest.approx(links.cost, rel=1e-8)


# ---- hand eye ------------------------------------------------------------------------------------


LENGTH = 0.1


def cell(robot: mc.Robot, count: int, seed: int) -> tuple[Array, Array, Array, Array, Array]:
    """Joints, A, exact B = Z^-1 A X, X and Z at a random place."""
    rng = np.random.default_rng(seed)
    q = random_joint_values_above_floor(robot, count, rng)
    X, Z = twist_exponential(rng.normal(size=(2, 6)) * [1, 1, 1, 2, 2, 2])
    A = robot.pose(q)
    return q, A, invert_transform(Z) @ A @ X, X, Z


@pytest.mark.parametrize("name", ["irb2600", "ur10", "meca500"])
@pytest.mark.parametrize("seed", range(4))
def test_closed_form_recovers_both_frames(name, seed):
    robot = mc.load_robot(name)
    _, A, B, X, Z = cell(robot, 20, seed)
    found_x, found_z = solve_hand_eye_in_closed_form(A, B)
    assert_allclose(found_x, X, rtol=0, atol=1e-9)
    assert_allclose(found_z, Z, rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_refinement_finds_what_rotations_about_one_axis_leave_open(seed):
    robot = mc.load_robot("scara_600")
    q, _, B, _, _ = cell(robot, 20, seed)
    found = fit_base_and_tool(robot.mdh, q * robot.sign, robot.prismatic, B, LENGTH)
    assert found.identified == 11  # heights of base and tool cannot be told apart
    poses = found.x.tool_poses(q * robot.sign, robot.prismatic)
    assert_allclose(poses, B, rtol=0, atol=1e-9)


def test_mdh_pose_fit_finds_the_true_robot(robot, clean):
    found = fit_mdh_to_poses(robot, clean.data)
    assert found.status == "converged"
    q = random_joint_values_above_floor(robot, 50, np.random.default_rng(9))
    assert_allclose(found.predict(q), clean.cell.predict(q), rtol=0, atol=1e-9)
