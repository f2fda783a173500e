"""Product of exponentials: the same arm as the MDH chain, and the same calibration."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from experiments.hand_eye import place
from experiments.poe import Screws, fit_poses, fit_positions, screws_of
from experiments.poses import (
    exp,
    gauss_newton,
    inverse,
    lever,
    pose,
    pose_residual,
    pose_slope,
    poses_of,
    triangle,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots import kinematics
from minimax_cal.robots.sampling import random_poses

EXACT = Truth(compliance=0, noise=0, noise_per_metre=0)
ROUNDING = 1e-12


@pytest.mark.parametrize("name", mc.builtin_robots())
def test_same_forward_kinematics_as_the_links(name, rng):
    robot = mc.load_robot(name)
    q, tool = random_poses(robot, 40, rng), exp(rng.normal(size=6))
    found = screws_of(robot, tool).poses(q * robot.sign)
    assert_allclose(found, robot.pose(q) @ tool, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("name", ["irb2600", "ur10", "scara_600"])
def test_twists_are_the_derivative_of_the_step(name, rng):
    robot = mc.load_robot(name)
    q = random_poses(robot, 5, rng) * robot.sign
    arm = screws_of(robot, exp(rng.normal(size=6)))
    twists, now = arm.tool_twists(q), arm.poses(q)
    for i, step in enumerate(1e-30j * np.eye(twists.shape[-1])):  # complex step
        slope = arm.step(step).poses(q).imag / 1e-30 @ inverse(now)
        assert_allclose(slope[:, :3, 3], twists[:, :3, i], rtol=0, atol=ROUNDING)
        turn = np.stack([slope[:, 2, 1], slope[:, 0, 2], slope[:, 1, 0]], axis=1)
        assert_allclose(turn, twists[:, 3:, i], rtol=0, atol=ROUNDING)


def test_pose_slope_is_the_derivative_of_the_residual(rng):
    computed, length, h = exp(rng.normal(size=(7, 6))), 0.3, 1e-5
    measured = computed @ exp(rng.normal(size=(7, 6)))  # large errors: Jl^-1 matters
    slope = pose_slope(measured, computed, np.broadcast_to(np.eye(6), (7, 6, 6)), length)
    for i, step in enumerate(h * np.eye(6)):
        ends = [pose_residual(measured, exp(s * step) @ computed, length) for s in (1.0, -1.0)]
        assert_allclose((ends[0] - ends[1]) / (2 * h), slope[..., i], rtol=0, atol=1e-8)


def test_a_step_keeps_screws_pure(rng):
    robot = mc.load_robot("scara_600")
    arm = screws_of(robot, np.eye(4)).step(rng.normal(size=30))
    v, w = arm.twists[:, :3], arm.twists[:, 3:]
    turning = ~robot.prismatic
    assert_allclose(np.linalg.norm(w[turning], axis=1), 1.0, atol=ROUNDING)
    assert_allclose((v * w)[turning].sum(axis=1), 0.0, atol=1e-11)  # no pitch
    assert_allclose(w[~turning], 0.0, atol=ROUNDING)
    assert_allclose(np.linalg.norm(v[~turning], axis=1), 1.0, atol=ROUNDING)


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
    spot = pose(np.eye(3), np.array([0.1, 0.0, 0.0]))  # off the last axis, to see that it turns
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


def test_redundant_parameters_share_the_step():
    def linearise(x: Array) -> tuple[Array, Array]:
        return np.array([x[0] + x[1] - 2.0, x[2] - 1.0]), np.array([[1.0, 1, 0], [0, 0, 1]])

    found = gauss_newton(linearise, lambda x, dx: x + dx, np.zeros(3))
    assert_allclose(found.x, [1.0, 1.0, 1.0], atol=ROUNDING)
    assert (found.identified, found.parameters) == (2, 3)


def test_exp_of_a_small_twist_agrees_with_its_series(rng):
    for size in (1e-9, 1e-4, 1e-3, 0.1):
        twist = size * rng.normal(size=6)
        hat = np.zeros((4, 4))
        hat[:3, :3] = kinematics.hat(twist[3:])
        hat[:3, 3] = twist[:3]
        term, total = np.eye(4), np.eye(4)
        for k in range(1, 15):
            term = term @ hat / k
            total = total + term
        assert_allclose(exp(twist), total, rtol=0, atol=1e-15)
    assert_allclose(exp(np.zeros(6)), pose(np.eye(3), np.zeros(3)), atol=0)
