"""Conditions on poses against plain geometry."""

import dataclasses

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.optimize import minimize

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.planning.candidate_poses import (
    POSES_DRAWN_AT_A_TIME,
    draw_candidates_near_poses,
    draw_visible_candidates,
    find_joint_limits,
)
from minimax_cal.planning.pose_visibility import (
    ARM_CONDITIONS,
    FULL_ACCEPTANCE_ANGLE,
    TARGET_CONDITIONS,
    ArmAtPoses,
    ArmWorkspace,
    TrackerVisibility,
    segment_distances,
    target_normals,
)
from minimax_cal.robots.robot import robot_from_dict

SOUGHT = 1e-6  # a minimiser's own accuracy of a distance near 1 m


def straight(lengths: list[float], **more: object) -> mc.Robot:
    """Revolute joints about parallel horizontal axes, links along the first one's x: z is up."""
    joints = [{"a": 0.0, "d": 500.0, "theta": 0.0, "alpha": -np.pi / 2, **more}]
    joints += [{"a": a, "d": 0.0, "theta": 0.0, "alpha": 0.0, **more} for a in lengths]
    content = {"name": "planar", "units": {"length": "mm", "angle": "rad"}, "joints": joints}
    return robot_from_dict(content)


def room_of(robot: mc.Robot, **more: object) -> ArmWorkspace:
    n = robot.joints
    room = ArmWorkspace(
        robot, np.zeros((1, 3)), np.eye(3)[2:], np.full(n, -np.pi), np.full(n, np.pi), 0.05
    )
    return dataclasses.replace(room, **more)


def view(robot: mc.Robot, q: list[float], sight: TrackerVisibility, **more: object) -> ArmAtPoses:
    return ArmAtPoses(room_of(robot, **more), sight, np.array([q]))


@pytest.fixture
def eye(robot: mc.Robot) -> TrackerVisibility:
    return TrackerVisibility(np.array([3.0, 0.0, 0.5]), robot.up)


# ---- segments ----------------------------------------------------------------------------------

lengths = st.floats(-1.0, 1.0, allow_subnormal=False)
point = st.tuples(lengths, lengths, lengths)


@settings(max_examples=60, deadline=None)
@given(a=point, b=point, c=point, d=point)
@example((0, 0, 0), (1, 0, 0), (0.2, 1, 0), (0.8, 1, 0))  # parallel
@example((0, 0, 0), (0.3, 0, 0), (0.6, 0, 0), (1, 0, 0))  # in line
@example((0, 0, 0), (0, 0, 0), (0, 0, 1), (1, 0, 1))  # a point
def test_gap_is_the_least_distance(a, b, c, d):
    ends = [np.array(end)[:, None] for end in (a, b, c, d)]
    found = float(segment_distances(*ends)[0])

    def square(x: Array) -> float:
        off = ends[0] + x[0] * (ends[1] - ends[0]) - ends[2] - x[1] * (ends[3] - ends[2])
        return float((off**2).sum())

    starts = [(s, t) for s in (0.0, 0.5, 1.0) for t in (0.0, 0.5, 1.0)]
    best = min(minimize(square, x, bounds=[(0, 1)] * 2).fun for x in starts)
    assert found**2 <= best + SOUGHT
    # and there are points that near: it is no less than the true least distance either
    assert found >= np.sqrt(max(best, 0.0)) - np.sqrt(SOUGHT)


# ---- conditions --------------------------------------------------------------------------------


def test_the_floor_is_where_it_is_said_to_be():
    arm = straight([800.0])
    sight = TrackerVisibility(np.array([3.0, 0.0, 0.5]), arm.up)
    for angle, floor, free in ((0.0, 0.0, True), (0.5, 0.0, True), (0.8, 0.0, False),
                               (0.8, -0.2, True), (0.0, 0.46, False)):  # fmt: skip
        tip = 0.5 - 0.8 * np.sin(angle)  # joint 2 turns about -y: the arm sinks
        assert (tip > floor + 0.05) == free
        assert bool(ARM_CONDITIONS["floor"](view(arm, [0.0, angle], sight, floor=floor))[0]) == free


def test_the_box_holds_the_flange():
    arm = straight([800.0])
    sight = TrackerVisibility(np.array([3.0, 0.0, 0.5]), arm.up)
    low, high = np.array([0.7, -0.1, 0.4]), np.array([0.9, 0.1, 0.6])
    for q, inside in (([0.0, 0.0], True), ([0.5, 0.0], False), ([0.0, 0.2], False)):
        seen = view(arm, q, sight, low=low, high=high)
        assert bool(ARM_CONDITIONS["volume"](seen)[0]) == inside


def test_a_folded_arm_touches_itself():
    arm = straight([400.0, 300.0, 350.0])
    sight = TrackerVisibility(np.array([3.0, 0.0, 0.5]), arm.up)
    stretched, bent, folded = [0.0] * 4, [0.0, 0.0, 1.5, 0.0], [0.0, 0.0, 2.3, 2.3]
    for q, free in ((stretched, True), (bent, True), (folded, False)):
        assert bool(ARM_CONDITIONS["self-collision"](view(arm, q, sight))[0]) == free
    # the third link crosses the first: by elementary geometry in the arm's plane
    corner = np.array([0.4 + 0.3 * np.cos(2.3), -0.3 * np.sin(2.3)])
    tip = corner + 0.35 * np.array([np.cos(4.6), -np.sin(4.6)])
    assert corner[1] < -0.1 < 0.0 < tip[1]
    assert 0.0 < tip[0] < 0.4


def test_acceptance_is_an_angle_about_the_normal(robot):
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (200, 6))
    spots = np.array([[0.1, 0.0, 0.03], [0.0, -0.1, 0.02]])
    normals = target_normals(spots, "radial")
    sight = TrackerVisibility(np.array([2.5, -1.0, 0.7]), robot.up, np.radians(40.0))
    seen = ArmAtPoses(room_of(robot, target_positions=spots, normals=normals), sight, q)
    found = TARGET_CONDITIONS["acceptance"](seen)
    pose = robot.pose(q)
    for k in range(2):
        where = pose[:, :3, :3] @ spots[k] + pose[:, :3, 3]
        to = sight.position - where
        cos = (to * (pose[:, :3, :3] @ normals[k])).sum(axis=1) / np.linalg.norm(to, axis=1)
        assert np.array_equal(found[k], np.degrees(np.arccos(cos)) < 40.0)
        assert 0 < found[k].sum() < len(q)
    wide = dataclasses.replace(sight, acceptance=FULL_ACCEPTANCE_ANGLE)
    assert TARGET_CONDITIONS["acceptance"](dataclasses.replace(seen, visibility=wide)).all()


def test_range_and_elevation(robot):
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (200, 6))
    flange = robot.pose(q)[:, :3, 3]
    sight = TrackerVisibility(
        np.array([2.0, 0.0, 0.0]), robot.up, near=1.5, far=2.2, low=0.2, high=0.6
    )
    seen = ArmAtPoses(room_of(robot), sight, q)
    away = np.linalg.norm(flange - sight.position, axis=1)
    rise = np.arctan2(flange[:, 2], np.hypot(*(flange - sight.position)[:, :2].T))
    assert np.array_equal(TARGET_CONDITIONS["range"](seen)[0], (away >= 1.5) & (away <= 2.2))
    assert np.array_equal(TARGET_CONDITIONS["elevation"](seen)[0], (rise >= 0.2) & (rise <= 0.6))
    for name in ("range", "elevation"):
        assert 0 < TARGET_CONDITIONS[name](seen).sum() < len(q)


def test_the_arm_hides_what_is_behind_it():
    arm = straight([600.0])
    behind, before = np.array([-3.0, 0.0, 0.5]), np.array([3.0, 0.0, 0.5])
    aside = np.array([0.6, 3.0, 0.5])
    for place, free in ((behind, False), (before, True), (aside, True)):
        seen = view(arm, [0.0, 0.0], TrackerVisibility(place, arm.up))
        assert bool(TARGET_CONDITIONS["line of sight"](seen)[0, 0]) == free
    # forward, then up: the line from low behind passes the shoulder at 0.32 m
    arm, low = straight([1000.0, 800.0]), np.array([-3.0, 0.0, -0.5])
    for radius, free in ((0.05, True), (0.30, True), (0.34, False)):
        seen = view(arm, [0.0, 0.0, -np.pi / 2], TrackerVisibility(low, arm.up), radius=radius)
        assert bool(TARGET_CONDITIONS["line of sight"](seen)[0, 0]) == free


def test_normals():
    spots = np.array([[0.1, 0.0, 0.03], [0.0, -0.2, 0.0], [0.0, 0.0, 0.1]])
    assert_allclose(target_normals(spots, "flange"), np.tile([0.0, 0.0, 1.0], (3, 1)))
    assert_allclose(target_normals(spots, "radial"), [[1, 0, 0], [0, -1, 0], [0, 0, 1]])
    with pytest.raises(mc.OptionError, match="no normals 'up'"):
        target_normals(spots, "up")


# ---- candidates --------------------------------------------------------------------------------


def test_candidates_meet_every_condition(robot, eye):
    lower, upper, notices = find_joint_limits(robot, {1: (-0.5, 0.9)})
    assert notices == ()
    room = room_of(robot, lower=lower, upper=upper, low=np.array([0.4, -1.5, 0.2]),
                   high=np.array([1.6, 1.5, 1.4]))  # fmt: skip
    found = draw_visible_candidates(room, eye, 300, 3)
    assert len(found.q) == 300
    assert found.drawn == 300
    assert found.tested % POSES_DRAWN_AT_A_TIME == 0
    assert np.all((found.q >= lower) & (found.q <= upper))
    seen = ArmAtPoses(room, eye, found.q)
    for holds in ARM_CONDITIONS.values():
        assert holds(seen).all()
    for sees in TARGET_CONDITIONS.values():
        assert sees(seen).all()
    assert found.seen.all()
    again = draw_visible_candidates(room, eye, 300, 3)
    assert np.array_equal(again.q, found.q)
    assert not np.array_equal(draw_visible_candidates(room, eye, 300, 4).q, found.q)


def test_one_target_is_enough_unless_all_are_asked_for(robot, eye):
    lower, upper, _ = find_joint_limits(robot, {})
    spots = 0.1 * np.array([[1.0, 0.0, 0.3], [-1.0, 0.0, 0.3]])
    room = room_of(
        robot,
        target_positions=spots,
        normals=target_normals(spots, "radial"),
        lower=lower,
        upper=upper,
    )
    wide = dataclasses.replace(eye, acceptance=np.radians(80.0))
    found = draw_visible_candidates(room, wide, 200, 0)
    assert found.seen.any(axis=1).all()
    assert not found.seen.all(axis=1).any()  # they look away from each other
    with pytest.raises(mc.OptionError, match="acceptance rejects most"):
        draw_visible_candidates(dataclasses.replace(room, all_targets_required=True), wide, 10, 0)


def test_what_rejects_most_is_named(robot, eye):
    lower, upper, _ = find_joint_limits(robot, {})
    room = room_of(robot, lower=lower, upper=upper)
    far = dataclasses.replace(eye, near=40.0, far=45.0)
    with pytest.raises(mc.OptionError, match=r"range rejects most \(100.0 %\): give another"):
        draw_visible_candidates(room, far, 10, 0)
    with pytest.raises(mc.OptionError, match="floor rejects most"):
        draw_visible_candidates(dataclasses.replace(room, floor=5.0), eye, 10, 0)


def test_neighbours_are_near_and_allowed(robot, eye):
    lower, upper, _ = find_joint_limits(robot, {})
    room = room_of(robot, lower=lower, upper=upper)
    some = draw_visible_candidates(room, eye, 20, 0).q
    q, seen = draw_candidates_near_poses(room, eye, some, 30, 0.01, np.random.default_rng(0))
    assert 0 < len(q) <= 600
    assert seen.shape == (len(q), 1)
    away = np.abs((q[:, None] - some[None]) / (upper - lower)).max(axis=2).min(axis=1)
    assert away.max() < 0.06
    assert np.all((q >= lower) & (q <= upper))
    for holds in ARM_CONDITIONS.values():
        assert holds(ArmAtPoses(room, eye, q)).all()


def test_limits_of_robots_without_any():
    arm = straight([500.0])
    lower, upper, notices = find_joint_limits(arm, {1: (-0.2, 0.4)})
    assert_allclose(lower, [-np.pi, -0.2])
    assert_allclose(upper, [np.pi, 0.4])
    assert len(notices) == 1
    assert "no limits for joint 1:" in notices[0]
    with pytest.raises(mc.OptionError, match="joint 1: no range is left"):
        find_joint_limits(arm, {0: (2.0, 1.0)})


def test_joints_turn_once_round_at_most_and_keep_a_margin(robot):
    lower, upper, _ = find_joint_limits(robot, {})  # joint 6 of the file turns +-400 degrees
    inside = np.array([2.0] * 5 + [0.0]) * np.pi / 180.0
    assert_allclose(lower, np.maximum(robot.lower + inside, -np.pi))
    assert_allclose(upper, np.minimum(robot.upper - inside, np.pi))
    scara = mc.load_robot("scara_600")
    low, high, _ = find_joint_limits(scara, {})
    slides = scara.prismatic
    assert_allclose(low[slides], scara.lower[slides] + 0.005)
    assert_allclose(high[slides], scara.upper[slides] - 0.005)
    near = dataclasses.replace(scara, lower=scara.upper - 0.01)  # a range that is hardly any
    assert_allclose(find_joint_limits(near, {})[0], near.lower + 0.05 * 0.01)
    assert_allclose(
        find_joint_limits(scara, {0: (scara.lower[0], 0.0)})[0], low
    )  # of the robot's limits
