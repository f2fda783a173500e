"""The comparison of methods: measures of error, splits, and what must hold between methods."""

import numpy as np
import pytest
from conftest import SHARED, shared
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments import methods
from experiments.hand_eye import closed_form, mdh_pose, place
from experiments.methods import Job, figure_of
from experiments.poe import Screws, fit_poses, fit_positions, screws_of
from experiments.poses import exp, lever, orientation_error, points, poses_of, triangle
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots.sampling import random_poses
from minimax_cal.robots.transforms import inverse, transform

# ---- methods -------------------------------------------------------------------------------------


def moved_triangle(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Corners, poses and corners at these poses."""
    shape = triangle(rng.normal(size=(1, 3, 3)))
    poses = exp(rng.normal(size=(30, 6)))
    return shape, poses, points(poses, shape)


def test_poses_of_a_triangle_are_recovered(rng):
    shape, poses, y = moved_triangle(rng)
    assert_allclose(triangle(y), shape, atol=1e-13)
    assert_allclose(shape.mean(axis=0), 0.0, atol=1e-15)
    assert_allclose(poses_of(shape, y), poses, atol=1e-13)


def test_errors_of_known_poses(rng):
    measured = exp(rng.normal(size=(30, 6)))
    turn = rng.normal(size=(30, 3))
    other = measured @ transform(
        Rotation.from_rotvec(turn).as_matrix(), np.tile([0.3, 0, 0.4], (30, 1))
    )
    assert_allclose(orientation_error(measured, other), np.linalg.norm(turn, axis=1), atol=1e-12)


def test_real_robots_improve_held_out():
    shared("irb120")
    case = methods.cases(quick=True)[1]
    outcomes = {
        name: [methods.outcome_of(Job(case, 0, name, 0, SHARED))]
        for name in ("nominal", "POE pose", "MDH pose", "sum")
    }
    error = {name: figure_of(each, "AP RMSE", "held out") for name, each in outcomes.items()}
    assert 0.7 < error["nominal"] < 1.1  # [mm]
    assert error["POE pose"] == pytest.approx(error["MDH pose"], rel=1e-6)
    assert max(error["MDH pose"], error["sum"]) < 0.4


# ---- poe -----------------------------------------------------------------------------------------


EXACT = Truth(compliance=0, noise=0, noise_per_metre=0)
ROUNDING = 1e-12


@pytest.mark.parametrize("name", mc.builtin_robots())
def test_same_forward_kinematics_as_the_links(name, rng):
    robot = mc.load_robot(name)
    q, tool = random_poses(robot, 40, rng), exp(rng.normal(size=6))
    found = screws_of(robot, tool).poses(q * robot.sign)
    assert_allclose(found, robot.pose(q) @ tool, rtol=0, atol=ROUNDING)


def measured_arm(name: str, truth: Truth) -> tuple[mc.Robot, Array, Array, float, Screws]:
    """Robot, joints, poses in the nominal base, lever, and nominal screws."""
    robot = mc.load_robot(name)
    data = simulate(robot, 40, 3, seed=3, truth=truth).data
    q, shape = data.q * robot.sign, triangle(data.y)
    poses = poses_of(shape, data.y)
    arm = place(robot.mdh, q, robot.prismatic, poses, lever(shape)).x
    return robot, q, inverse(arm.base) @ poses, lever(shape), screws_of(robot, arm.tool)


@pytest.mark.parametrize(
    ("name", "independent"), [("irb2600", 30), ("ur10", 30), ("scara_600", 20)]
)
def test_exact_poses_are_met(name, independent):
    _, q, poses, length, nominal = measured_arm(name, EXACT)
    found = fit_poses(nominal, q, poses, length)
    assert found.status == "converged"
    assert found.identified == independent  # 4 a turning joint, 2 a slide, 6 of the tool
    assert_allclose(found.x.poses(q), poses, rtol=0, atol=1e-10)
    spot = transform(
        np.eye(3), np.array([0.1, 0.0, 0.0])
    )  # off the last axis, to see that it turns
    seen = (poses @ spot)[:, :3, 3]
    found = fit_positions(Screws(nominal.twists, nominal.tool @ spot), q, seen)
    assert found.identified == independent - 3
    assert_allclose(found.x.poses(q)[:, :3, 3], seen, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", ["irb2600", "ur10", "scara_600"])
def test_poe_and_mdh_describe_the_same_arms(name):
    robot, q, poses, length, nominal = measured_arm(name, Truth())
    screws = fit_poses(nominal, q, poses, length)
    links = place(robot.mdh, q, robot.prismatic, poses, length, links=True)
    assert screws.identified == links.identified
    assert screws.cost == pytest.approx(links.cost, rel=1e-8)


# ---- hand eye ------------------------------------------------------------------------------------


LENGTH = 0.1


def cell(robot: mc.Robot, count: int, seed: int) -> tuple[Array, Array, Array, Array, Array]:
    """Joints, A, exact B = Z^-1 A X, X and Z at a random place."""
    rng = np.random.default_rng(seed)
    q = random_poses(robot, count, rng)
    X, Z = exp(rng.normal(size=(2, 6)) * [1, 1, 1, 2, 2, 2])
    A = robot.pose(q)
    return q, A, inverse(Z) @ A @ X, X, Z


@pytest.mark.parametrize("name", ["irb2600", "ur10", "meca500"])
@pytest.mark.parametrize("seed", range(4))
def test_closed_form_recovers_both_frames(name, seed):
    robot = mc.load_robot(name)
    _, A, B, X, Z = cell(robot, 20, seed)
    found_x, found_z = closed_form(A, B)
    assert_allclose(found_x, X, rtol=0, atol=1e-9)
    assert_allclose(found_z, Z, rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_refinement_finds_what_rotations_about_one_axis_leave_open(seed):
    robot = mc.load_robot("scara_600")
    q, _, B, _, _ = cell(robot, 20, seed)
    found = place(robot.mdh, q * robot.sign, robot.prismatic, B, LENGTH)
    assert found.identified == 11  # heights of base and tool cannot be told apart
    poses = found.x.poses(q * robot.sign, robot.prismatic)
    assert_allclose(poses, B, rtol=0, atol=1e-9)


def test_mdh_pose_fit_finds_the_true_robot(robot, clean):
    found = mdh_pose(robot, clean.data)
    assert found.status == "converged"
    q = random_poses(robot, 50, np.random.default_rng(9))
    assert_allclose(found.predict(q), clean.cell.predict(q), rtol=0, atol=1e-9)
