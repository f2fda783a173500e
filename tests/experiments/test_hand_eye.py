"""Simultaneous robot-world and hand-eye calibration, and the MDH pose fit built on it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from experiments.hand_eye import Placed, closed_form, linearise, mdh_pose, place, twists
from experiments.poses import exp, inverse, pose_residual
from minimax_cal.ground.arrays import Array
from minimax_cal.robots import kinematics
from minimax_cal.robots.sampling import random_poses

LENGTH = 0.1


def cell(robot: mc.Robot, count: int, seed: int) -> tuple[Array, Array, Array, Array, Array]:
    """Joints, A, exact B = Z^-1 A X, X and Z at a random place."""
    rng = np.random.default_rng(seed)
    q = random_poses(robot, count, rng)
    X, Z = exp(rng.normal(size=(2, 6)) * [1, 1, 1, 2, 2, 2])
    A = robot.pose(q)
    return q, A, inverse(Z) @ A @ X, X, Z


@pytest.mark.parametrize("name", ["irb2600", "ur10", "meca500"])
@pytest.mark.parametrize("seed", range(20))
def test_closed_form_recovers_both_frames(name, seed):
    robot = mc.load_robot(name)
    _, A, B, X, Z = cell(robot, 20, seed)
    found_x, found_z = closed_form(A, B)
    assert_allclose(found_x, X, rtol=0, atol=1e-9)
    assert_allclose(found_z, Z, rtol=0, atol=1e-9)


def test_closed_form_with_half_turns():
    # from the first pose all others turn by almost 180 degrees: the signs are in doubt
    rng = np.random.default_rng(4)
    axes = rng.normal(size=(12, 3))
    turns = np.pi * (1 - 1e-9) * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    A = np.concatenate([np.eye(4)[None], exp(np.concatenate([axes, turns], axis=1))])
    X, Z = exp(rng.normal(size=(2, 6)))
    found_x, found_z = closed_form(A, inverse(Z) @ A @ X)
    assert_allclose(found_x, X, rtol=0, atol=1e-9)
    assert_allclose(found_z, Z, rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_refinement_finds_what_rotations_about_one_axis_leave_open(seed):
    robot = mc.load_robot("scara_600")
    q, _, B, _, _ = cell(robot, 20, seed)
    found = place(robot.mdh, q * robot.sign, robot.prismatic, B, LENGTH)
    assert found.identified == 11  # heights of base and tool cannot be told apart
    poses = found.x.poses(q * robot.sign, robot.prismatic)
    assert_allclose(poses, B, rtol=0, atol=1e-9)


def test_refinement_of_noisy_poses(robot):
    q, A, B, X, Z = cell(robot, 60, 1)
    noise = 1e-4 * np.random.default_rng(2).normal(size=(60, 6))
    B = B @ exp(noise)
    first_x, first_z = closed_form(A, B)
    start = inverse(first_z) @ A @ first_x
    signed = q * robot.sign
    found = place(robot.mdh, signed, robot.prismatic, B, LENGTH)
    assert found.status == "converged"
    assert found.cost <= np.sum(pose_residual(B, start, LENGTH) ** 2)
    residual, slope = linearise(found.x, signed, robot.prismatic, B, LENGTH, False)
    assert_allclose(slope.T @ residual, 0.0, atol=1e-11)  # a stationary point
    # 360 numbers of spread 1e-4 determine 12: errors of the order of 1e-4 / sqrt(60)
    assert_allclose(found.x.tool, X, rtol=0, atol=1e-4)
    assert_allclose(inverse(found.x.base), Z, rtol=0, atol=1e-4)


def test_twists_are_the_derivative_of_the_step(rng):
    robot = mc.load_robot("scara_600")  # turning joints and a slide
    q = random_poses(robot, 5, rng) * robot.sign
    mdh = robot.mdh + 0.1 * rng.normal(size=robot.mdh.shape)
    arm = Placed(mdh, np.eye(4), exp(rng.normal(size=6)))
    now = arm.poses(q, robot.prismatic)
    slopes = twists(arm, kinematics.chain(mdh, q, robot.prismatic), with_links=True)
    for i, step in enumerate(1e-30j * np.eye(slopes.shape[-1])):  # complex step
        slope = arm.step(step, links=True).poses(q, robot.prismatic).imag / 1e-30 @ inverse(now)
        assert_allclose(slope[:, :3, 3], slopes[:, :3, i], rtol=0, atol=1e-12)
        turn = np.stack([slope[:, 2, 1], slope[:, 0, 2], slope[:, 1, 0]], axis=1)
        assert_allclose(turn, slopes[:, 3:, i], rtol=0, atol=1e-12)


def test_mdh_pose_fit_finds_the_true_robot(robot, clean):
    found = mdh_pose(robot, clean.data)
    assert found.status == "converged"
    assert found.identified == 30
    q = random_poses(robot, 50, np.random.default_rng(9))
    assert_allclose(found.predict(q), clean.cell.predict(q), rtol=0, atol=1e-9)
