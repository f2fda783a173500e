"""Joints at a pose: what forward kinematics says of them is the pose again."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.modelling.cell import still
from minimax_cal.modelling.effects.table import Fitted, Term
from minimax_cal.modelling.reach import arm_of, bent
from minimax_cal.robots.sampling import random_poses

THERE = 1e-7  # of a pose [m, and what turns a point at the lever so far]


def test_every_robot_comes_back_to_its_pose(rng):
    for name in mc.builtin_robots():
        robot = mc.load_robot(name)
        q = random_poses(robot, 20, rng, 0.9 * np.pi)
        near = np.clip(q + 0.05 * rng.normal(size=q.shape), robot.lower, robot.upper)
        if robot.joints < 6:  # a start away from it may choose another of fewer ways
            near = q + 1e-3
        pose = robot.pose(q)
        assert_allclose(robot.pose(robot.inverse(pose, near=near)), pose, rtol=0, atol=THERE)


def test_a_regular_pose_gives_the_joints_near_by(robot):
    q = np.array([0.3, 0.2, 0.1, 0.5, 0.8, -0.4])
    assert_allclose(robot.inverse(robot.pose(q), near=q + 0.05), q, rtol=0, atol=1e-9)


def test_batches_have_the_shape_of_their_poses(robot, rng):
    q = np.array([0.3, 0.2, 0.1, 0.5, 0.8, -0.4]) + 0.1 * rng.normal(size=(2, 3, 6))
    pose = robot.pose(q)
    assert robot.inverse(pose, near=q).shape == (2, 3, 6)
    assert robot.inverse(pose, near=q[0, 0]).shape == (2, 3, 6)
    assert robot.inverse(pose[0, 0], near=q[0, 0]).shape == (6,)
    assert robot.inverse(pose[:0], near=q[0, 0]).shape == (0, 3, 6)


def test_without_a_start_any_way_is_found(robot, rng):
    pose = robot.pose(random_poses(robot, 30, rng))
    q = robot.inverse(pose)
    assert_allclose(robot.pose(q), pose, rtol=0, atol=1e-6)
    assert (q >= robot.lower).all()
    assert (q <= robot.upper).all()


def test_what_is_out_of_reach_is_said(robot):
    pose = np.eye(4)
    pose[0, 3] = 9.0
    with pytest.warns(mc.CalibrationWarning, match="1 of 1 poses are not reached"):
        robot.inverse(pose, near=np.zeros(6))


@pytest.mark.parametrize(
    ("pose", "near", "said"),
    [
        (np.eye(3), None, "shape"),
        (2.0 * np.eye(4), None, "rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), None, "rotation"),
        (np.full((4, 4), np.nan), None, "finite"),
        (np.eye(4), np.zeros(5), "near"),
        (np.eye(4), [np.inf] * 6, "near"),
        ("here", None, "numbers"),
    ],
)
def test_no_pose_is_one_line(robot, pose, near, said):
    with pytest.raises(mc.RobotError, match=said):
        robot.inverse(pose, near=near)  # type: ignore[arg-type]


def test_a_fit_counts_its_effects(noisy, rng):
    """The flange with its compliance, by the law itself, is at the pose."""
    fit = mc.calibrate("irb2600", noisy.data, "sum", effects="joint_compliance:all")
    arm, robot = arm_of(fit.cell), fit.cell.robot
    q = random_poses(robot, 10, rng)
    turn, moved = bent(arm, still(q, arm.target_names, robot))
    assert np.abs(turn).max() > 1e-4
    pose = moved @ robot.pose(q + turn * robot.sign)
    found = fit.inverse(pose, near=q + 1e-3)
    turn, moved = bent(arm, still(found, arm.target_names, robot))
    assert_allclose(moved @ robot.pose(found + turn * robot.sign), pose, rtol=0, atol=THERE)
    assert np.abs(robot.pose(robot.inverse(pose, near=q)) - pose).max() < THERE
    assert np.abs(found - robot.inverse(pose, near=found)).max() > 1e-5  # the effects' share


def test_what_only_the_tracker_sees_moves_no_flange(clean):
    cell, q = clean.cell, np.array([0.3, 0.2, 0.1, 0.5, 0.8, -0.4])
    drift = Fitted((Term("target_offset", "smr1", {}),), (np.array([1e-3]),))
    pose = cell.robot.pose(q)
    assert_allclose(replace(cell, effects=drift).inverse(pose, near=q), q, rtol=0, atol=1e-9)
