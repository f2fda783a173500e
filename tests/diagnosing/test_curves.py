"""Curves of an arm that errs by one known effect, against what that effect looks at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from minimax_cal.diagnosing.curves import (
    Curve,
    Leftover,
    guilty,
    joint_equivalent,
    order_curve,
    residual_curve,
    turns,
    without,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.history import with_history
from minimax_cal.modelling.effects import drivers
from minimax_cal.modelling.effects.drivers import own_value
from minimax_cal.modelling.effects.table import NOTHING, Fitted, Term
from minimax_cal.robots.gravity import masses_of
from minimax_cal.robots.kinematics import rotation
from minimax_cal.robots.sampling import random_poses

M = 60
SPOTS = np.array([[0.1, 0.0, 0.03], [-0.05, 0.09, 0.03], [-0.05, -0.09, 0.03]])
NAMES = ("smr1", "smr2", "smr3")


def fitted(name: str, place: str, value: list[float], **choice: float) -> Fitted:
    return Fitted((Term(name, place, choice),), (np.array(value),))


def cell_of(robot: mc.Robot, effects: Fitted = NOTHING) -> mc.Cell:
    base = np.eye(4)
    base[:3, :3], base[:3, 3] = rotation(np.array([0.2, -0.1, 1.0])), [3.0, -1.0, 0.5]
    return mc.Cell(robot, base, NAMES, SPOTS, effects)


def left_by(
    effects: Fitted, name: str = "irb2600", told: bool = True, **columns: Array
) -> Leftover:
    """What is left of exact measurements of an arm with effects, without them and with."""
    robot, rng = mc.load_robot(name), np.random.default_rng(1)
    order = {"order": np.arange(M)[::-1] + 1.0} if told else {}
    q = random_poses(robot, M, rng)
    data = mc.measurements(q, rng.normal(size=(M, 3, 3)), **order, **columns)
    data = with_history(replace(data, target_names=NAMES, sliding=robot.prismatic))
    first, last = cell_of(robot), cell_of(robot, effects)
    data = data.with_y(last.follow(data))
    return Leftover.of(data, np.arange(M) % 5 == 0, 1e-5, (first, last), effects.terms)


PLAY = fitted("backlash", "J5", [1e-3])


def test_views_are_geometry_effects_and_all_but_the_first() -> None:
    left = left_by(PLAY)
    plain, whole, bare = left.views
    measured = left.data.y - cell_of(left.scene.robot).predict(left.data.q)
    axes = cell_of(left.scene.robot).base[:3, :3]
    assert_allclose(plain, np.moveaxis(measured, 1, 0) @ axes, rtol=0, atol=1e-12)
    assert_allclose(whole, 0.0, atol=1e-12)
    assert_allclose(bare, plain, rtol=0, atol=1e-12)
    assert_allclose(left.distances()[0], 1e3 * np.linalg.norm(measured, axis=-1).T, atol=1e-9)
    there = left.scene.robot.pose(left.data.q) @ np.append(SPOTS[1], 1.0)
    assert_allclose(left.points[1] - left.views[0][1], there[:, :3], rtol=0, atol=1e-12)
    alone = left_by(NOTHING)
    assert len(alone.views) == 1
    assert alone.law is None
    assert alone.term is None


def test_an_effect_is_taken_out_with_all_its_lines() -> None:
    ripple = [Term("gear_ripple", "J3", {"turns": t}) for t in (121.0, 242.0)]
    both = Fitted((*ripple, *PLAY.terms), (np.ones(2), 2.0 * np.ones(2), np.ones(1)))
    assert without(both, ripple[1]).terms == PLAY.terms
    assert without(both, PLAY.terms[0]).terms == tuple(ripple)
    assert [v.tolist() for v in without(both, PLAY.terms[0]).values] == [[1, 1], [2, 2]]


def test_play_is_a_turn_of_its_joint_by_the_side_it_came_from() -> None:
    left = left_by(PLAY)
    curve = residual_curve(left)
    came = np.zeros(M)
    came[:-1] = left.data.q[:-1, 4] - left.data.q[1:, 4]  # the last row is visited first
    assert_allclose(curve.x, np.degrees(came), rtol=0, atol=1e-9)
    assert curve.xlabel == "last move of joint 5 (deg)"
    assert curve.ylabel == "equivalent turn of joint 5 (mrad)"
    assert curve.title == "errors as a turn of joint 5, for backlash at joint 5"
    plain, whole, bare = curve.y
    assert_array_equal(np.sign(plain[:-1]), np.sign(came[:-1]))
    assert 0.2 < np.abs(plain[:-1]).max() < 0.6  # half of a milliradian, less the ridge
    assert_allclose(whole, 0.0, atol=1e-9)
    assert_allclose(bare, plain, rtol=1e-9)


def static_torque(left: Leftover, joint: int) -> Array:
    return np.asarray(left.scene.gravity[joint])


def test_torques_of_masses_that_were_told_do_not_say_that_they_are_assumed() -> None:
    scene = left_by(NOTHING).scene
    mass, com = masses_of(scene.robot)
    told = replace(scene, robot=replace(scene.robot, mass=mass, com=com))
    measured = {f"tau{j + 1}": np.arange(M) for j in range(scene.joints)}
    felt = replace(scene, data=replace(scene.data, columns={**scene.data.columns, **measured}))
    for one in (told, felt):
        assert drivers.torque(one, 1, {})[0] == "static torque of joint 2 (N m)"


def wave(left: Leftover, joint: int) -> Array:
    return np.asarray(np.degrees(left.data.q[:, joint]) % (360.0 / 121.0))


def degrees(left: Leftover, joint: int) -> Array:
    return np.degrees(left.data.q[:, joint])


@pytest.mark.parametrize(
    ("effects", "law", "joint", "label"),
    [
        (fitted("link_bending", "L2", [1e-6]), static_torque, 1,
         "static torque of joint 2, masses assumed (N m)"),
        (fitted("base_flex", "frame", [5e-7]), static_torque, 1,
         "static torque of joint 2, masses assumed (N m)"),
        (fitted("gear_ripple", "J3", [2e-4, 1e-4], turns=121.0), wave, 2,
         "joint 3 within a wave of 2.98° (deg)"),
        (fitted("encoder_gain", "J4", [1e-3]), degrees, 3, "joint 4 (deg)"),
        (fitted("joint_coupling", "J5", [1e-3], source=4.0), degrees, 3, "joint 4 (deg)"),
        (NOTHING, degrees, 0, "joint 1 (deg)"),
    ],
    ids=lambda part: part.terms[0].effect if isinstance(part, Fitted) and part.terms else "",
)  # fmt: skip
def test_a_curve_is_drawn_against_what_its_law_looks_at(
    effects: Fitted, law: object, joint: int, label: str
) -> None:
    left = left_by(effects)
    curve = residual_curve(left)
    assert curve.xlabel == label
    wanted = law(left, joint)  # type: ignore[operator]
    assert_allclose(np.abs(curve.x), np.abs(wanted), rtol=1e-9, atol=1e-9)
    assert len(curve.y) == (3 if effects.terms else 1)
    if effects.terms and effects.terms[0].effect in ("encoder_gain", "joint_coupling"):
        shown = turns(left)[-1][:, guilty(left, turns(left))]
        assert_allclose(curve.y[-1], 1e3 * (shown - shown.mean()), rtol=0, atol=1e-12)
        assert abs(curve.y[0].mean()) > 1e-3  # a constant turn, which geometry takes


def test_time_and_heat_are_drawn_along_their_motion() -> None:
    heat = np.linspace(20.0, 30.0, M)
    warm = left_by(fitted("thermal_growth", "all", [3e-4], temperature=1.0, apart=0.0),
                   temperature=heat)  # fmt: skip
    curve = residual_curve(warm)
    assert curve.xlabel == "temperature (°C)"
    assert_array_equal(curve.x, np.broadcast_to(heat, (3, M)))
    assert curve.ylabel == "error along its growth (mm)"
    assert_allclose(np.abs(curve.y[0]), warm.distances()[0], rtol=0, atol=1e-6)
    jump = left_by(fitted("session_jump", "frame", [1e-3, 0, 0, 0, 0, 0], since=0.5))
    curve = residual_curve(jump)
    assert curve.title == "error of all targets, for session jump"
    assert_allclose(curve.x[0], np.linspace(1.0, 0.0, M), rtol=0, atol=1e-12)
    assert_allclose(curve.y[0], 1.0 * (curve.x >= 0.5), rtol=0, atol=1e-9)
    shift = left_by(fitted("target_shift", "smr2", [0.0, 2e-3, 0.0], since=0.5))
    curve = residual_curve(shift)
    assert curve.title == "error of smr2, for target shift at smr2"
    assert curve.y[0].shape == curve.x.shape == (1, M)
    assert_allclose(curve.y[0], 2.0 * (curve.x >= 0.5), rtol=0, atol=1e-9)


def test_an_offset_is_drawn_along_the_line_of_sight() -> None:
    left = left_by(fitted("target_offset", "all", [1e-3]))
    curve = residual_curve(left)
    away = np.linalg.norm(left.data.y, axis=-1).T  # the instrument is the origin
    assert_allclose(curve.x, away, rtol=1e-12)
    assert_allclose(curve.y[0], 1.0, rtol=0, atol=1e-9)
    assert curve.xlabel == "distance from the instrument (m)"


def test_a_slide_is_shown_in_millimetres() -> None:
    left = left_by(NOTHING, "scara_600")
    label, x = own_value(left.scene, 2, {})
    assert label == "joint 3 (mm)"
    assert_allclose(x, 1e3 * left.data.q[:, 2], rtol=1e-14)


@pytest.mark.parametrize("told", [True, False])
def test_errors_in_the_order_of_the_visits(told: bool) -> None:
    left = left_by(PLAY, told=told)
    curve = order_curve(left)
    rms = np.sqrt(np.mean(left.distances()[0] ** 2, axis=0))
    assert_allclose(curve.y[0], rms, rtol=1e-12)
    if told:
        assert_array_equal(curve.x, np.arange(M)[::-1] + 1.0)
    assert (curve.xlabel == "visit (first to last)") == told
    some = replace(left, errors=tuple(np.where(np.arange(3)[:, None, None] == 1, np.nan, e)
                                      for e in left.errors))  # fmt: skip
    rms = np.sqrt(np.mean(left.distances()[0][[0, 2]] ** 2, axis=0))
    assert_allclose(order_curve(some).y[0], rms, rtol=1e-12)


def test_a_curve_names_its_views() -> None:
    curve = Curve("t", "x (m)", "y (mm)", np.arange(2.0), (np.ones(2), np.array([np.nan, 2.0])))
    told = curve.to_dict()
    assert told["x"] == {"label": "x (m)", "values": [0.0, 1.0]}
    assert told["views"] == [
        {"name": "geometry alone", "values": [1.0, 1.0]},
        {"name": "with effects", "values": [None, 2.0]},
    ]


def test_joint_equivalent_is_the_turn():
    scene = left_by(NOTHING).scene
    turn = 1e-3 * np.random.default_rng(0).normal(size=(scene.poses, scene.joints))
    error = np.einsum("nkcm,mn->kmc", scene.jacobian, turn)
    off = np.abs(joint_equivalent(error, scene.jacobian, 1e-7) - turn)
    assert np.median(off) < 1e-5  # large only where the wrist or the arm is stretched
    assert np.quantile(off[:, :3], 0.9) < 1e-4
