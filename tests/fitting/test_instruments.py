"""Calibration without coordinates, against simulation with known truth and plain models."""

import json
import re
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from conftest import SHARED, shared
from numpy.testing import assert_allclose
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

import minimax_cal as mc
import minimax_cal.instruments as mc_instruments
from experiments.relative import (
    MEASUREMENT_SIMULATORS,
    RELATIVE_JOINT_COMPLIANCE,
    RELATIVE_LENGTH_NOISE,
    RELATIVE_TARGET_POSITION,
    ImperfectArm,
    RealRelativeJob,
    RelativeMeasurement,
    fitted_target_position,
    measurement_rank,
    position_errors,
    reduce_points_to_lengths,
    rms_in_mm,
    run_real_job,
    target_positions_in_base,
)
from minimax_cal.core.arrays import Array
from minimax_cal.fitting.identification import ReasonKind
from minimax_cal.fitting.multi_instrument.instrument_fit import InstrumentFit, fit_instruments
from minimax_cal.fitting.multi_instrument.instrument_stack import (
    InstrumentBlock,
    InstrumentStack,
    build_own_state,
)
from minimax_cal.fitting.multi_instrument.options import (
    RelativeOptions,
    check_relative_options,
    merge_instrument_options,
    silent_progress,
)
from minimax_cal.fitting.multi_instrument.relative_calibration import relative
from minimax_cal.fitting.multi_instrument.relative_result import RelativeCalibration
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.robust_fit import LOSSES
from minimax_cal.instruments import (
    Instrument,
    Surface,
    closures,
    contacts,
    distances,
    flange_poses,
    poses_as_targets,
)
from minimax_cal.instruments.instrument import Words, bare
from minimax_cal.instruments.instrument_options import parse_known_distance
from minimax_cal.instruments.protocol import FlangePoses, ResidualRows
from minimax_cal.instruments.sockets import (
    closing_poses,
    compute_misclosures,
    count_independent_coordinates,
    reach,
)
from minimax_cal.instruments.tracker_points import TrackerPoints
from minimax_cal.instruments.virtual_reflectors import virtual_reflector_positions
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.solvers.status import Status

# ---- instruments ---------------------------------------------------------------------------------


@cache
def measured(
    name: str, kind: str, seed: int = 0, noise: float = 0.0
) -> tuple[ImperfectArm, RelativeMeasurement]:
    """An arm, stiff, and what an instrument says of it."""
    arm = ImperfectArm.draw(name, seed, 0.0)
    return arm, MEASUREMENT_SIMULATORS[kind](arm, np.random.default_rng([seed, 5]), 100, noise)


@cache
def fitted(
    name: str, kind: str, seed: int = 0, noise: float = 0.0
) -> tuple[ImperfectArm, RelativeCalibration]:
    arm, seen = measured(name, kind, seed, noise)
    return arm, relative(arm.robot, seen.data, known_distances=seen.known)


def checks(arm: ImperfectArm) -> Array:
    return random_joint_values_above_floor(arm.robot, 200, np.random.default_rng(8))


# ---- the residuals ---------------------------------------------------------------------------


def wires(robot: mc.Robot, rng: np.random.Generator) -> tuple[InstrumentStack, ParameterValues]:
    q = random_joint_values_above_floor(robot, 15, rng)
    length = rng.uniform(0.5, 2.0, (15, 3))
    length[rng.uniform(size=length.shape) < 0.3] = np.nan
    x = build_own_state(robot.mdh, np.append(RELATIVE_TARGET_POSITION, rng.normal(size=12)))
    data = replace(distances(q, length), wires=("wire1", "wire2", "wire7"))
    return InstrumentStack.from_instruments(robot, [data], ["w"]), x


def sockets(robot: mc.Robot, rng: np.random.Generator) -> tuple[InstrumentStack, ParameterValues]:
    q, socket = random_joint_values_above_floor(robot, 15, rng), rng.permutation(np.arange(15) % 4)
    visits = replace(closures(q, socket), known=(("0", "2", 0.7), ("3", "1", 1.1)))
    return InstrumentStack.from_instruments(robot, [visits], ["s"]), build_own_state(
        robot.mdh, RELATIVE_TARGET_POSITION
    )


def seen(robot: mc.Robot, rng: np.random.Generator) -> tuple[InstrumentStack, ParameterValues]:
    q, y = random_joint_values_above_floor(robot, 15, rng), rng.normal(size=(15, 2, 3))
    y[rng.uniform(size=(15, 2)) < 0.3] = np.nan
    tracker = TrackerPoints(mc.measurements(q, y)).ready(robot, RelativeOptions())
    x = build_own_state(robot.mdh, rng.normal(size=12))
    # errors turn with the base, rows do not: the same where the points are met
    turn, origin = tracker.base_rotation_and_origin(x.effects)
    met = Cell.from_parameters(
        robot,
        ParameterValues(robot.mdh, turn, origin, tracker.flange_points(x.effects)),
        ("smr1", "smr2"),
    ).predict(q)
    at = replace(tracker.at, y=np.where(np.isnan(y), np.nan, met))
    return InstrumentStack.from_instruments(robot, [replace(tracker, at=at)], ["t"]), x


def touches(robot: mc.Robot, rng: np.random.Generator) -> tuple[InstrumentStack, ParameterValues]:
    surfaces = [Surface("A"), Surface("B", "sphere"), Surface("C", "plane", 0.1, np.eye(3)[0])]
    surfaces += [Surface("D", "plane", np.nan, np.eye(3)[1]), Surface("E", "sphere", 0.3)]
    made = contacts(
        random_joint_values_above_floor(robot, 40, rng), [s.label for s in surfaces] * 8, surfaces
    )
    probe = made.ready(robot, RelativeOptions())
    x = build_own_state(robot.mdh, 0.5 * rng.normal(size=len(probe.names)))
    return InstrumentStack.from_instruments(robot, [probe], ["c"]), x


def several(robot: mc.Robot, rng: np.random.Generator) -> tuple[InstrumentStack, ParameterValues]:
    made = [make(robot, rng) for make in (seen, wires, sockets)]
    stack = InstrumentStack.from_instruments(
        robot, [one.instruments[0] for one, _ in made], ["t", "w", "s"]
    )
    return replace(stack, precision=np.array([1.0, 0.3, 0.7])), stack.state(
        robot.mdh, [x.effects for _, x in made]
    )


MAKERS = [seen, wires, sockets, touches, several]


@pytest.mark.parametrize("name", ["irb2600", "scara_600"])
@pytest.mark.parametrize("make", MAKERS)
def test_slopes_are_the_derivative_of_the_rows(name, make, rng):
    robot = mc.load_robot(name)
    robot = robot.with_mdh(robot.mdh + 0.05 * rng.normal(size=robot.mdh.shape))
    stack, x = make(robot, rng)
    count = stack.names.parameter_count
    every = stack.movable  # the base is the frame
    _, jacobians = stack.rows(x, every)
    for column, i in enumerate(np.flatnonzero(every)):
        step = np.zeros(count)
        step[i] = 1e-6
        after, before = (stack.rows(x.step(sign * step), every)[0] for sign in (1, -1))
        # rows are measured minus predicted; central differences of 1e-6 are good to 1e-9
        assert_allclose(jacobians[column], -(after - before) / 2e-6, rtol=1e-7, atol=3e-8)


@pytest.mark.parametrize("make", MAKERS)
def test_rows_of_a_batch_are_those_of_its_members(robot, make, rng):
    stack, x = make(robot, rng)
    some = stack.movable & (rng.uniform(size=stack.names.parameter_count) < 0.7)
    batch = x.repeat(3)
    batch = batch.step(1e-2 * rng.normal(size=(3, stack.names.parameter_count)) * some)
    errors, jacobians = stack.rows(batch, some)
    for i in range(3):
        error, jacobian = stack.rows(batch.take(np.array(i)), some)
        assert_allclose(errors[i], error, rtol=0, atol=1e-13)
        assert_allclose(jacobians[i], jacobian, rtol=0, atol=1e-13)


def test_the_barycentre_is_the_best_place_of_a_socket(robot, rng):
    # the cost without the sockets is the least over all sockets' places, by explicit least squares
    q, socket = random_joint_values_above_floor(robot, 20, rng), rng.permutation(np.arange(20) % 3)
    visits = InstrumentBlock.without_effects(robot, closures(q, socket))
    error, _ = visits.rows(
        build_own_state(robot.mdh, RELATIVE_TARGET_POSITION), np.zeros(39, dtype=bool)
    )
    design = np.kron(np.eye(3)[socket], np.eye(3))
    _, cost, _, _ = np.linalg.lstsq(
        design, target_positions_in_base(robot, q, RELATIVE_TARGET_POSITION).reshape(-1)
    )
    assert_allclose(error @ error, cost[0], rtol=1e-12)


# ---- recovery, rank, scale -------------------------------------------------------------------

KINDS = [k for k in MEASUREMENT_SIMULATORS if k != "closures"]


@pytest.mark.parametrize("name", ["irb2600", "ur10"])
@pytest.mark.parametrize("kind", KINDS)
def test_without_noise_the_true_arm_is_found(name, kind):
    arm, fit = fitted(name, kind)
    assert fit.status == "converged"
    assert fit.accuracy["holdout"].poses > 0
    assert fit.accuracy["holdout"].max_mm < 1e-6  # 1e-9 m
    assert fit.accuracy["nominal"].rms_mm > 0.3
    off = position_errors(
        arm, fit.robot, fitted_target_position(fit), checks(arm), with_scale=False
    )
    assert off.max() < 1e-8  # what is not identified moves no position once a base is fitted


@pytest.mark.parametrize("name", ["irb2600", "ur10"])
def test_closures_find_the_arm_but_for_its_scale(name):
    arm, fit = fitted(name, "closures")
    assert fit.accuracy["holdout"].max_mm < 1e-6
    shape = position_errors(
        arm, fit.robot, fitted_target_position(fit), checks(arm), with_scale=True
    )
    plain = position_errors(
        arm, fit.robot, fitted_target_position(fit), checks(arm), with_scale=False
    )
    assert shape.max() < 1e-8
    assert plain.max() > 1e-5
    kept = [n for n, why in fit.identification.reasons.items() if why.kind is ReasonKind.NO_SCALE]
    lengths = {p.name: abs(p.nominal) for p in fit.parameters if p.name.rstrip("123456") in "ad"}
    assert kept == [max(lengths, key=lengths.__getitem__)]  # the longest is as drawn
    joint, column = int(kept[0][1:]) - 1, "ad".index(kept[0][0])
    assert fit.robot.mdh[joint, column] == arm.robot.mdh[joint, column]
    assert any("the scale is not identifiable" in notice for notice in fit.notices)
    # the scale is that of the drawing: every length is off by the same factor, which a fit with a
    # known distance tells
    _, told = fitted(name, "closures_known")
    factor = told.robot.mdh[joint, column] / arm.robot.mdh[joint, column]
    scaled = fit.robot.mdh.copy()
    scaled[:, :2] *= factor
    off = position_errors(
        arm,
        arm.robot.with_mdh(scaled),
        factor * fitted_target_position(fit),
        checks(arm),
        with_scale=False,
    )
    assert off.max() < 1e-8


def test_one_socket_is_enough():
    arm, seen = measured("irb2600", "closures")
    rng = np.random.default_rng(3)
    goal = np.repeat(arm.target_positions(seen.data.at.q[:1]), 300, axis=0)
    q, gap = reach(
        arm.real,
        RELATIVE_TARGET_POSITION,
        goal,
        random_joint_values_above_floor(arm.robot, 300, rng),
    )
    data = closures(q[gap < 1e-9][:60], np.repeat("A", 60))
    fit = relative(arm.robot, data)
    assert fit.identified == measurement_rank(arm, RelativeMeasurement(data)) == 20
    assert fit.accuracy["holdout"].max_mm < 1e-6
    shape = position_errors(
        arm, fit.robot, fitted_target_position(fit), checks(arm), with_scale=True
    )
    assert shape.max() < 1e-8


def test_scaling_all_lengths_changes_no_closure_but_a_known_distance(robot):
    q, socket = closing_poses(robot, RELATIVE_TARGET_POSITION, 4, 5, np.random.default_rng(0))
    _, socket = np.unique(socket, return_inverse=True)
    centres = [
        target_positions_in_base(robot, q, RELATIVE_TARGET_POSITION)[socket == i].mean(axis=0)
        for i in (0, 1)
    ]
    length, visits = float(np.linalg.norm(centres[0] - centres[1])), closures(q, socket)
    none = np.zeros(30 + 9, dtype=bool)
    for factor in (1.0, 1.01, 2.0):
        mdh = robot.mdh * [factor, factor, 1, 1, 1]
        x = build_own_state(mdh, factor * RELATIVE_TARGET_POSITION)
        alone, _ = InstrumentBlock.without_effects(robot, visits).rows(x, none)
        assert_allclose(alone, 0.0, atol=1e-8)
        known = replace(visits, known=(("0", "1", length),))
        told, _ = InstrumentBlock.without_effects(robot, known).rows(x, none)
        root = np.sqrt(3 * len(q))  # weighs as all visits together
        assert_allclose(told[-1] / root, (1.0 - factor) * length, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("name", ["irb2600", "ur10", "meca500"])
@pytest.mark.parametrize("kind", list(MEASUREMENT_SIMULATORS))
def test_identified_is_the_rank_by_finite_differences(name, kind):
    arm, seen = measured(name, kind)
    _, fit = fitted(name, kind)
    assert fit.identified == measurement_rank(arm, seen)


def slid(name: str, sizes: tuple[float, float]) -> tuple[ImperfectArm, np.random.Generator]:
    rng = np.random.default_rng(4)
    robot = mc.load_robot(name)
    errors = rng.normal(size=(robot.joints, 5)) * np.repeat(sizes, (2, 3))
    return ImperfectArm(robot, robot.with_mdh(robot.mdh + errors), 0.0), rng


def test_an_arm_with_a_slide():
    arm, rng = slid("scara_600", (5e-4, 1e-3))
    q = random_joint_values_above_floor(arm.robot, 80, rng)
    anchors = rng.normal(size=(3, 3))
    data = distances(q, np.linalg.norm(arm.target_positions(q)[:, None] - anchors, axis=-1))
    with pytest.raises(mc.DataError, match="q3_mm"):
        relative(arm.robot, data)
    data = replace(data, at=replace(data.at, sliding=arm.robot.prismatic))
    fit = relative(arm.robot, data)
    assert (
        fit.identified
        == measurement_rank(replace(arm, real=arm.robot), RelativeMeasurement(data))
        == 20
    )
    assert fit.accuracy["holdout"].max_mm < 1e-6


# ---- the start -------------------------------------------------------------------------------


SEEDS = (0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 8)))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("anchors", "offset"), [(1, 0.0), (3, 0.1)])
def test_no_guess_is_needed(seed, anchors, offset):
    # 5 mm and 10 mrad off, a target half a metre off, anchors anywhere, offsets of 0.1 m
    rng = np.random.default_rng(seed)
    robot = mc.load_robot(["irb2600", "ur10"][seed % 2])
    real = robot.with_mdh(robot.mdh + rng.normal(size=(6, 5)) * np.repeat([5e-3, 1e-2], (2, 3)))
    q = random_joint_values_above_floor(robot, 70, rng)
    spot = rng.uniform(-0.5, 0.5, 3)
    at = 0.8 * robot.reach() * rng.normal(size=(anchors, 3))
    zero = offset * rng.uniform(-1, 1, anchors)
    length = np.linalg.norm(target_positions_in_base(real, q, spot)[:, None] - at, axis=-1) + zero
    fit = relative(robot, distances(q, np.where(length > 0, length, np.nan)), offset=offset > 0)
    assert fit.status == "converged"
    assert fit.accuracy["holdout"].max_mm < 1e-6
    if offset:
        found = np.array(list(fit.instrument["offsets_mm"].values()))
        assert_allclose(found, 1e3 * zero, rtol=0, atol=1e-6)
        assert any("offsets are weakly determined" in notice for notice in fit.notices)


def test_an_offset_that_is_there_and_not_fitted_shows_and_a_large_one_fails():
    arm, seen = measured("irb2600", "wires_3", noise=RELATIVE_LENGTH_NOISE)
    shifted = replace(seen.data, length=seen.data.length + np.array([0.002, 0.0, -0.003]))
    wrong, right = relative(arm.robot, shifted), relative(arm.robot, shifted, offset=True)
    assert right.identified == wrong.identified + 3
    assert right.accuracy["holdout"].rms_mm < 0.025 < wrong.accuracy["holdout"].rms_mm
    told = {p.name: p for p in right.parameters}
    for name, value in (("offset1", 0.002), ("offset2", 0.0), ("offset3", -0.003)):
        assert abs(told[name].value - value) < 4.0 * told[name].sigma
        assert told[name].sigma > RELATIVE_LENGTH_NOISE / np.sqrt(
            80
        )  # weaker than the mean of the lengths
    far = replace(seen.data, length=seen.data.length + np.array([0.1, 0.05, -0.03]))
    fit = relative(arm.robot, far)
    assert fit.status is Status.FAILED
    assert any("offset=" in n for n in fit.notices)
    assert relative(arm.robot, far, offset=True).status is Status.CONVERGED


# ---- what the numbers say --------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "arms"), [("wires_3", 5), ("closures_known", 3), ("poses", 4)])
def test_sigmas_are_the_scatter_of_fits(kind, arms):
    # each parameter's deviation from the fit without noise, which is the truth in the same gauge
    z, ratio = [], []
    for seed in range(arms):
        _, clean = fitted("irb2600", kind, seed)
        arm, noisy = fitted("irb2600", kind, seed, RELATIVE_LENGTH_NOISE)
        assert noisy.identification.active.tolist() == clean.identification.active.tolist()
        rows = [
            ((a.value - b.value) / a.sigma)
            for a, b in zip(noisy.parameters, clean.parameters, strict=True)
            if a.identifiable and not a.name.startswith(("base", "tool_r"))  # of other axes
        ]
        z.append(rows)
        error = position_errors(
            arm, noisy.robot, fitted_target_position(noisy), checks(arm), with_scale=False
        )
        ratio.append(np.sqrt(np.mean(error**2)) / noisy.position_sigma)
    scatter = np.sqrt(np.mean(np.square(z)))
    assert 0.8 < scatter < 1.2  # 100 to 200 correlated numbers
    assert 0.7 < np.sqrt(np.mean(np.square(ratio))) < 1.3


def test_misclosures_are_as_about_known_sockets():
    rng = np.random.default_rng(3)
    socket = np.array(["A"] * 4 + ["B"] * 2 + ["C"] * 3 + ["D"])
    held = np.array([False, False, False, True] + [False] * 2 + [True] * 3 + [True])
    draws = rng.normal(size=(4000, 10, 3))
    squares = [(compute_misclosures(draw, socket, held) ** 2).sum(axis=1) for draw in draws]
    mean = np.mean(squares, axis=0)
    assert_allclose(mean[:9], 3.0, rtol=0.1)  # unit variance of each coordinate
    assert np.isnan(mean[9])  # one visit closes with nothing
    # numbers: A and B train with 3 + 2 visits about 2 barycentres; C and D have their own
    assert count_independent_coordinates(socket, held) == (3 * (5 - 2), 3 * (5 - 2))


def test_whole_sockets_are_held_out_where_there_are_enough():
    arm, seen = measured("irb2600", "closures_known", noise=RELATIVE_LENGTH_NOISE)
    fit = relative(arm.robot, seen.data, known_distances=seen.known, holdout=0.3)
    assert len([n for n in fit.notices if "3 of 10 sockets" in n]) == 1
    assert fit.numbers["holdout"] == 3 * (30 - 3)
    assert fit.numbers["train"] == 3 * (70 - 7)
    assert not set(seen.known[0][:2]) - set(fit.instrument["sockets_mm"])  # those must stay
    some = seen.data.take_rows(np.isin(seen.data.socket, ["S1", "S2", "S3"]))
    with pytest.raises(mc.DataError, match=r"\b20\b"):
        relative(arm.robot, some.take_rows(np.arange(30) % 10 < 3))
    fewer = relative(arm.robot, some)
    assert any("3 sockets" in n for n in fewer.notices)
    assert fewer.numbers["holdout"] == 3 * 6


def test_the_split_column_decides():
    arm, seen = measured("irb2600", "closures_known")
    out = [label for label in seen.data.socket_labels if label not in seen.known[0][:2]][:2]
    label = np.where(np.isin(seen.data.socket, out), "holdout", "train")
    data = replace(seen.data, at=replace(seen.data.at, columns={"split": label}))
    fit = relative(arm.robot, data, known_distances=seen.known)
    assert set(fit.instrument["sockets_mm"]) == set(data.socket_labels) - set(out)
    needed = np.where(data.socket == seen.known[0][0], "holdout", "train")
    data = replace(seen.data, at=replace(seen.data.at, columns={"split": needed}))
    with pytest.raises(mc.DataError, match=rf"\b{seen.known[0][0]}\b"):
        relative(arm.robot, data, known_distances=seen.known)


def test_an_error_of_lengths_is_not_called_one_of_position():
    for kind in ("wires_3", "closures"):
        assert (
            "no error of position"
            in fitted("irb2600", kind, noise=RELATIVE_LENGTH_NOISE)[1].headline()
        )


@pytest.mark.slow  # its fit goes to the limit of its steps
def test_another_robot_is_doubted():
    seen = MEASUREMENT_SIMULATORS["wires_3"](
        ImperfectArm.draw("irb2600", 0, 0.0), np.random.default_rng(5), 45, 0.0
    )
    fit = relative("irb120", seen.data)
    assert any("the nominal robot misses by" in notice for notice in fit.notices)
    assert any("implausibly large changes" in notice for notice in fit.notices)


# ---- slips -----------------------------------------------------------------------------------


def test_lengths_in_another_unit_are_refused_and_one_that_stands_out_is_named():
    arm, seen = measured("irb2600", "wires_3", noise=RELATIVE_LENGTH_NOISE)
    length = seen.data.length.copy()
    for factor, name in ((1e-3, "wire1_m"), (1e3, "wire1_mm")):
        with pytest.raises(mc.DataError, match=rf"\b{name}\b"):
            relative(arm.robot, replace(seen.data, length=factor * length))
    length[17, 2] += 0.05
    fit = relative(arm.robot, replace(seen.data, length=length))
    assert any("line 18 wire3" in notice for notice in fit.notices)


@pytest.mark.parametrize("kind", ["wires_3", "closures"])
def test_a_reversed_joint_is_named(kind):
    arm, seen = measured("irb2600", kind, noise=RELATIVE_LENGTH_NOISE)
    q = seen.data.at.q * [1, 1, -1, 1, 1, 1]
    wrong = replace(seen.data, at=replace(seen.data.at, q=q))
    with pytest.raises(mc.DataError, match="joint 3"):
        relative(arm.robot, wrong)


def test_labels_of_sockets_at_random_are_no_closures(robot):
    """All could close if the arm shrank to a point."""
    q = random_joint_values_above_floor(robot, 60, np.random.default_rng(0))
    fit = relative(robot, closures(q, [f"S{i % 6}" for i in range(60)]))
    assert fit.status is Status.FAILED


def test_a_known_distance_that_cannot_be_is_refused():
    arm, seen = measured("irb2600", "closures", noise=RELATIVE_LENGTH_NOISE)
    a, b = seen.data.socket_labels[:2]
    fit = relative(arm.robot, seen.data)
    spots = fit.instrument["sockets_mm"]
    far = 1e-3 * float(np.linalg.norm(np.subtract(spots[a], spots[b])))
    for known, words in (
        ([(a, b, 1e-3 * far)], "mm apart; metres?"),
        ([(a, b, far + 0.2)], "mm apart; check the labels"),
        ([(a, b, far), (b, a, far + 0.1)], "given twice"),
    ):
        with pytest.raises(mc.OptionError, match=words):
            relative(arm.robot, seen.data, known_distances=known)
    assert relative(arm.robot, seen.data, known_distances=[(a, b, far)]).status is Status.CONVERGED


# ---- options ---------------------------------------------------------------------------------


def test_fix_and_free():
    arm, seen = measured("irb2600", "wires_3", noise=RELATIVE_LENGTH_NOISE)
    fit = relative(arm.robot, seen.data, fix="a2,beta*", free=["d1"])
    told = {p.name: p for p in fit.parameters}
    assert told["a2"].reason == told["beta2"].reason == "fixed by the user"
    assert told["d1"].identifiable
    assert not told["anchor1_z"].identifiable or not told["anchor2_z"].identifiable
    # a fixed length sets the scale of closures: nothing else is given up for it
    arm, seen = measured("irb2600", "closures", noise=RELATIVE_LENGTH_NOISE)
    fit = relative(arm.robot, seen.data, fix=["a2"])
    assert ReasonKind.NO_SCALE not in {why.kind for why in fit.identification.reasons.values()}
    assert {p.name: p.identifiable for p in fit.parameters}["d4"]
    # what the user wants is not what is kept for the scale
    fit = relative(arm.robot, seen.data, free=["d4"])
    assert "length standard" in fit.identification.reasons["a2"].text


@pytest.mark.parametrize(
    ("kind", "options", "words"),
    [
        ("closures", {"offset": True}, "offset= is for distances"),
        ("wires_3", {"known_distances": [("S1", "S2", 1.0)]}, "known_distances= is for closures"),
        ("wires_3", {"lever": 0.1}, "lever= is for poses"),
        ("closures", {"known_distances": [("S1", "Z", 1.0)]}, "no socket 'Z'"),
        ("closures", {"known_distances": [("S1", "S1", 1.0)]}, "two different sockets"),
        ("closures", {"known_distances": [("S1", "S2", -1.0)]}, "a positive length"),
        ("poses", {"lever": -0.1}, "must be positive"),
        ("wires_3", {"holdout": 1.0}, "not a fraction"),
        ("wires_3", {"seed": -1}, "seed -1"),
        ("wires_3", {"method": "newton"}, "no method 'newton'"),
        ("wires_3", {"objective": "point"}, "no objective 'point'; choose sum or minimax"),
        ("wires_3", {"objective": "minimax", "effects": ["tool_flex"]}, "objective='sum'"),
        ("wires_3", {"objective": "minimax", "qp": "none"}, "none"),
        ("wires_3", {"loss": "l1"}, "no loss 'l1'; choose square, huber, cauchy, tukey"),
        ("wires_3", {"loss": "huber", "objective": "minimax"}, "weigh errors twice: give one"),
        ("wires_3", {"resolution": 1.0}, "resolution"),
        ("wires_3", {"fix": ["a9"]}, "no parameter called 'a9'"),
        ("wires_3", {"fix": ["a2"], "free": ["a2"]}, "a2 is both fixed and freed"),
        ("wires_3", {"fix": ["anchor1_x"]}, "no nominal value to keep"),
    ],
)
def test_bad_options_are_one_line(kind, options, words):
    arm, seen = measured("irb2600", kind)
    with pytest.raises(mc.OptionError) as caught:
        relative(arm.robot, seen.data, **options)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_too_few_lengths_are_told_with_their_number():
    arm, seen = measured("irb2600", "wires_1")
    few = seen.data.take_rows(np.arange(25))
    with pytest.raises(mc.DataError, match=r"\b20\b.*\b24\b"):
        relative(arm.robot, few)
    with pytest.raises(mc.DataError, match=r"wire1\b.*\b4\b.*\b5\b"):
        relative(arm.robot, seen.data.take_rows(np.arange(5)))
    with pytest.raises(mc.DataError, match="has 4 joints"):
        relative("scara_600", seen.data)


def test_a_known_distance_in_words():
    for text in ("A,B", "A,B,x", "A,B,5,6", ",B,5", "A,B,--5", "A,B,nan"):
        with pytest.raises(mc.OptionError, match="write two sockets and a length"):
            parse_known_distance(text)
    *labels, length = parse_known_distance(" S1 , plate 2, 500.02 mm")
    assert labels == ["S1", "plate 2"]
    assert_allclose(length, 0.50002, rtol=1e-14)


# ---- whole poses -----------------------------------------------------------------------------


def test_four_reflectors_weigh_position_and_turn_by_the_lever(rng):
    lever = 0.37
    shift, turn = 1e-6 * rng.normal(size=3), 1e-6 * rng.normal(size=3)
    for count in (3, 4):
        spots = virtual_reflector_positions(lever, count)
        assert_allclose(spots.mean(axis=0), 0.0, atol=1e-16)
        assert_allclose(np.mean((spots**2).sum(axis=1)), 1.5 * lever**2, rtol=1e-14)
    moved = shift + np.cross(turn, spots)
    square = 4.0 * (shift @ shift + lever**2 * turn @ turn)
    assert_allclose((moved**2).sum(), square, rtol=1e-12)


@pytest.mark.parametrize("count", [3, 4])
def test_virtual_reflectors_are_real_ones(count):
    """Reflectors screwed on where the virtual ones are give the same calibration."""
    arm, seen = measured("ur10", "poses", noise=RELATIVE_LENGTH_NOISE)
    lever = 0.2
    pose = seen.data.pose
    spots = virtual_reflector_positions(lever, count)
    y = np.stack([pose[:, :3, :3] @ spot + pose[:, :3, 3] for spot in spots], axis=1)
    real = mc.calibrate(arm.robot, mc.measurements(seen.data.at.q, y), objective="sum")
    virtual = mc.calibrate(arm.robot, poses_as_targets(seen.data, lever, count), objective="sum")
    assert_allclose(virtual.robot.mdh, real.robot.mdh, rtol=0, atol=1e-13)
    if count == 4:
        fit = relative(arm.robot, seen.data, lever=lever)
        assert_allclose(fit.robot.mdh, real.robot.mdh, rtol=0, atol=1e-13)
        assert fit.identified == sum(p.identifiable for p in real.parameters) - 6  # their shape


def test_poses_tell_the_turn_of_the_tool_and_more():
    arm, seen = measured("irb2600", "poses", noise=RELATIVE_LENGTH_NOISE)
    fit = relative(arm.robot, seen.data)
    assert fit.beyond == ("tool_rx", "tool_ry", "tool_rz")  # at a point off all wrist axes
    # a frame in the flange's centre: one reflector there would not see the wrist's last turn
    tool = np.eye(4)
    tool[:3, 3] = -RELATIVE_TARGET_POSITION + [0.0, 0.0, 1e-5]
    centred = relative(arm.robot, replace(seen.data, pose=seen.data.pose @ tool))
    assert set(centred.beyond) > {"tool_rx", "tool_ry", "tool_rz"}
    assert any("beyond what one reflector" in notice for notice in centred.notices)


@pytest.mark.slow
def test_the_tool_and_its_sigma_are_found():
    _, fit = fitted("irb2600", "poses", noise=RELATIVE_LENGTH_NOISE)
    told = {p.name: p for p in fit.parameters}
    exact = fitted("irb2600", "poses")[1]
    turned = Rotation.from_rotvec(fit.instrument["tool"]["rotation_vector_rad"])
    true = Rotation.from_rotvec(exact.instrument["tool"]["rotation_vector_rad"])
    off = (turned * true.inv()).as_rotvec()
    for i, axis in enumerate("xyz"):
        assert told[f"tool_r{axis}"].unit == "rad"
        assert 0.0 < abs(off[i]) < 4.0 * told[f"tool_r{axis}"].sigma < 1e-3
    assert fit.turns["holdout"][0] == pytest.approx(np.sqrt(3) * 0.15e-3, rel=0.25)
    assert fit.turns["nominal"][0] > 5.0 * fit.turns["holdout"][0]
    assert told["d6"].reason == "same motion as the tool"


def test_the_lever_comes_from_the_columns():
    arm, seen = measured("irb2600", "poses", noise=RELATIVE_LENGTH_NOISE)
    assert relative(arm.robot, seen.data).instrument["lever_mm"] == pytest.approx(100.0)
    columns = {"u95": np.full(100, 3e-5), "rotation_u95": np.full(100, 1e-4)}
    data = replace(seen.data, at=replace(seen.data.at, columns=columns))
    assert relative(arm.robot, data).instrument["lever_mm"] == pytest.approx(300.0)
    assert relative(arm.robot, data, lever=0.05).instrument["lever_mm"] == pytest.approx(50.0)


def test_errors_of_poses_name_the_users_columns():
    arm, seen = measured("irb2600", "poses")
    pose = seen.data.pose.copy()
    pose[:, :3, 3] *= 1e-3
    with pytest.raises(mc.DataError, match="flange_x_m"):
        relative(arm.robot, flange_poses(seen.data.at.q, pose), lever=1e-4)


def test_a_real_arm_by_lengths_of_its_trackers_points():
    shared("irb120")  # skips where there are no data
    kinds = ("wires_3", "wires_1", "tracker")
    three, one, tracker = (run_real_job(RealRelativeJob("irb120", kind, 0)) for kind in kinds)
    assert three.position_mm[1] < 1.2 * tracker.position_mm[1] < 0.4 * three.position_mm[0]
    # a length may fit well and tell little of positions: that must be said
    assert one.held_mm < tracker.held_mm
    assert one.position_mm[1] > 10.0 * three.position_mm[1]
    data = mc.read_measurements(SHARED / "irb120" / "measurements.csv").only(0)
    robot = mc.load_robot(SHARED / "irb120" / "robot.json")
    said = [
        relative(robot, reduce_points_to_lengths(data, kind)).notices
        for kind in ("wires_3", "wires_1")
    ]
    weakly = [any("positions are poorly determined" in notice for notice in some) for some in said]
    assert weakly == [False, True]


# ---- the result ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["wires_3", "closures_known", "poses"])
def test_the_saved_result_is_a_robot(kind, tmp_path):
    arm, fit = fitted("irb2600", kind, noise=RELATIVE_LENGTH_NOISE)
    path = tmp_path / "fit.json"
    fit.save(path)
    again = mc.load_robot(path)
    q = checks(arm)
    assert_allclose(again.pose(q), fit.robot.pose(q), rtol=0, atol=1e-12)
    assert "<robot" in mc.export(path, "urdf", notify=lambda said: None)
    with pytest.raises(mc.CalibrationError, match="relative calibration"):
        mc.load_cell(path)  # it has no place in a measurement frame, or no reflectors


def test_nothing_held_out_is_said():
    arm, seen = measured("ur10", "closures", noise=RELATIVE_LENGTH_NOISE)
    fit = relative(arm.robot, seen.data, holdout=0.0)
    assert any("no pose is held out" in notice for notice in fit.notices)
    assert "none was held out" in fit.headline()
    assert fit.to_dict()["accuracy"]["holdout"]["rms_mm"] is None
    # sockets by arrays, and labels that are numbers
    number = np.unique(seen.data.socket, return_inverse=True)[1]
    fit = relative(arm.robot, closures(seen.data.at.q, number))
    same = relative(arm.robot, seen.data)
    assert_allclose(fit.robot.mdh, same.robot.mdh, rtol=0, atol=1e-9)


# ---- of one's own ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Height(mc_instruments.Instrument):
    """How high a point of the flange stands above a floor.  wrong: a fault that is put in."""

    height: Array
    wrong: str = ""

    kind = "height"
    words = Words(quantity="height")
    by_row = ("height",)
    names = ("target_x", "target_y", "target_z", "floor")

    def starts(self, arm: FlangePoses, free_unknowns: Array) -> list[Array]:
        return [np.array([0.1, 0.0, 0.1, 0.0][: 3 if self.wrong == "start" else 4])]

    def read(self, arm: FlangePoses, unknowns: Array) -> ResidualRows:
        up, m = np.array([0.0, 0.0, 1.0]), self.poses
        point, sign = arm.place(unknowns[:3]), -1.0 if self.wrong == "sign" else 1.0
        by_own = np.column_stack([arm.rotation[:, 2], np.full(m, -sign)])
        along = np.tile(-up if self.wrong == "point" else up, (m, 1))
        error = self.height - point[:, 2] + unknowns[3]
        return ResidualRows(error, np.arange(m), point, along, np.zeros((m, 3)), by_own)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("", ""),
        ("start", r"a start has the shape \(3,\), not \(4,\)"),
        ("sign", "by_own for floor of row .* is 1, but the prediction, .* changes by -1"),
        ("point", "by_point .* of row "),
    ],
)
def test_an_instrument_that_does_not_read_as_it_says_is_named(robot, wrong, said):
    q = random_joint_values_above_floor(robot, 40, np.random.default_rng(0))
    made = Height(
        bare(q, {}), target_positions_in_base(robot, q, RELATIVE_TARGET_POSITION)[:, 2], wrong
    )
    with pytest.raises(mc.DataError, match=f"height: {said}") if wrong else nullcontext():
        mc_instruments.check_instrument(made, robot)


def test_a_kind_of_its_own_is_asked_for():
    with pytest.raises(mc.OptionError, match="give it a kind of its own: 'distances' is built in"):
        mc.register_instrument(type("Mine", (Height,), {"kind": "distances"}))
    with pytest.raises(mc.OptionError, match="it has none"):
        mc.register_instrument(type("Mine", (mc_instruments.Instrument,), {}))


def test_readings_that_are_no_numbers_are_named(robot):
    q = random_joint_values_above_floor(robot, 40, np.random.default_rng(0))
    with pytest.raises(mc.DataError, match="height has 39 entries; there are 40 poses"):
        mc.relative(robot, Height(bare(q, {}), np.zeros(39)))
    with pytest.raises(mc.DataError, match="height is not a finite number"):
        mc.relative(robot, Height(bare(q, {}), np.full(40, np.nan)))


@dataclass(frozen=True, eq=False)
class Level(mc_instruments.Instrument):
    """How far the flange's z axis leans along the base's x: no point is looked at."""

    lean: Array

    kind = "level"
    unit = "rad"
    words = Words(quantity="lean")
    by_row = ("lean",)
    names = ("lean_zero_rx",)
    targets_at = slice(0, 0)

    def starts(self, arm: FlangePoses, free_unknowns: Array) -> list[Array]:
        return [np.zeros(1)]

    def read(self, arm: FlangePoses, unknowns: Array) -> ResidualRows:
        axis, m = arm.rotation[:, :, 2], self.poses
        nowhere, across = np.zeros((m, 3)), np.cross(axis, [1.0, 0.0, 0.0])
        error = self.lean - axis[:, 0] - unknowns[0]
        return ResidualRows(error, np.arange(m), nowhere, nowhere, across, np.ones((m, 1)))


def test_an_instrument_may_read_the_flange_itself(robot):
    """Beside a tracker it is fitted, and effects of the arm are sought in it: they turn it, too."""
    arm, rng = ImperfectArm.draw("irb2600", 1, 3e-6), np.random.default_rng(0)
    mc.register_instrument(Level)
    q, seen = (
        random_joint_values_above_floor(arm.robot, 50, rng),
        random_joint_values_above_floor(arm.robot, 30, rng),
    )
    lean = arm.real.pose(arm.bent_joint_values(q))[:, 0, 2] + 0.01 + 1e-6 * rng.normal(size=50)
    points = mc.measurements(
        seen, arm.target_positions(seen)[:, None] + 1e-5 * rng.normal(size=(30, 1, 3))
    )
    level = Level(bare(q, {}), lean)
    mc_instruments.check_instrument(level, arm.robot)
    fit = mc.relative(arm.robot, [points, level], effects="joint_compliance:all")
    zero = next(p for p in fit.parameters if p.name == "level.lean_zero_rx")
    assert zero.unit == "rad"
    assert zero.value == pytest.approx(0.01, abs=5e-6)
    assert mc.relative(arm.robot, level, holdout=0.0).positions_open
    found = mc.diagnose_relative(arm.robot, [points, level])
    assert {one.term.effect for one in found.effects} == {"joint_compliance"}
    told = found.calibration.instruments[1].accuracy
    assert told["holdout"].rms_error < 3e-6 < 1e-5 < told["nominal"].rms_error


# ---- units of rows -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Tilt(Level):
    """The same, in a unit of the test's choice: its numbers are `per` times as large."""

    per: float = 1.0
    kind = "tilt"
    unit = "rad"

    def read(self, arm: FlangePoses, unknowns: Array) -> ResidualRows:
        rows = super().read(arm, unknowns)
        return rows._replace(
            residual=self.per * rows.residual,
            by_rotation=self.per * rows.by_rotation,
            by_own=self.per * rows.by_own,
        )


LEVEL_NOISE = 20e-6  # [rad]


@cache
def tilts(unit: str, per: float, objective: str = "sum") -> tuple[RelativeCalibration, Array]:
    """A tracker and a level whose rows have a unit; and the level's true errors at held-out poses.

    These come from the rows themselves, asked at the calibrated arm.
    """
    kind = mc.register_instrument(type("Tilt", (Tilt,), {"unit": unit}))
    arm, rng = ImperfectArm.draw("irb2600", 1, 0.0), np.random.default_rng(0)
    q, seen = (
        random_joint_values_above_floor(arm.robot, 200, rng),
        random_joint_values_above_floor(arm.robot, 40, rng),
    )
    lean = arm.real.pose(q)[:, 0, 2] + 0.01 + LEVEL_NOISE * rng.normal(size=200)
    points = mc.measurements(
        seen, arm.target_positions(seen)[:, None] + 1e-5 * rng.normal(size=(40, 1, 3))
    )
    level = kind(bare(q, {}), lean, per)
    fit = mc.relative(arm.robot, [points, level], objective=objective)
    assert fit.cell is None
    zero = next(p.value for p in fit.parameters if p.name == "tilt.lean_zero_rx")
    return fit, lean - fit.robot.pose(q)[:, 0, 2] - zero


@pytest.mark.parametrize(
    ("unit", "per", "scale", "shown"), [("rad", 1.0, 1e3, "mrad"), ("px", 2000.0, 1.0, "px")]
)
def test_noise_and_accuracy_are_in_the_unit_of_the_rows(unit, per, scale, shown, tmp_path):
    fit, error = tilts(unit, per)
    content = json.loads(fit.json())
    level = next(one for one in content["instruments"] if one["kind"] == "tilt")
    assert level["unit"] == unit
    assert level["noise"] == pytest.approx(per * LEVEL_NOISE, rel=0.15)  # 5 % by 160 numbers
    held, train = level["accuracy"]["holdout"], level["accuracy"]["train"]
    assert held["unit"] == unit
    square = held["numbers"] * held["rms"] ** 2 + train["numbers"] * train["rms"] ** 2
    assert square == pytest.approx(per**2 * float(error @ error), rel=1e-9)
    assert max(held["max"], train["max"]) == pytest.approx(per * np.abs(error).max(), rel=1e-9)
    assert held["rms_ci95"][0] < held["rms"] < held["rms_ci95"][1]
    assert held["rms_mm"] is None
    assert held["sse_mm2"] == [None]
    # people read the same numbers, and no length
    table = fit.files_table()
    row = dict(zip(table.header, next(r for r in table.rows if r[0] == "tilt"), strict=True))
    assert row["unit"] == shown
    assert row["noise"] == pytest.approx(scale * level["noise"])
    assert row["RMS"] == pytest.approx(scale * held["rms"])
    assert f"-> {scale * held['rms']:#.3g} {shown}" in fit.headline()
    again = RelativeCalibration.from_dict(content)
    assert again.headline() == fit.headline()
    assert [t.formatted_cells() for t in again.first_tables()] == [
        t.formatted_cells() for t in fit.first_tables()
    ]
    assert json.loads(again.json())["instruments"] == content["instruments"]


def test_errors_in_several_units_are_not_one_number():
    fit, _ = tilts("rad", 1.0)
    content = json.loads(fit.json())
    for accuracy in content["accuracy"].values():
        assert {accuracy[key] for key in ("rms_mm", "max_mm", "mean_mm")} == {None}
        assert not {"rms", "max", "mean"} & set(accuracy)
    points = next(one for one in content["instruments"] if one["kind"] == "points")
    assert points["unit"] == "mm"
    assert points["accuracy"]["holdout"]["rms_mm"] > 0.0
    arm, rng = ImperfectArm.draw("irb2600", 1, 0.0), np.random.default_rng(1)
    q = random_joint_values_above_floor(arm.robot, 40, rng)
    wires = distances(q, np.linalg.norm(arm.target_positions(q) - [2.0, 0.5, 0.1], axis=1)[:, None])
    alike = mc.relative(arm.robot, [mc.measurements(q, arm.target_positions(q)[:, None]), wires])
    assert alike.accuracy["holdout"].rms_mm >= 0.0  # of lengths alone it is


def test_a_minimax_over_several_units_compares_by_noise():
    fit, _ = tilts("rad", 1.0, "minimax")
    worst = json.loads(fit.json())["minimax"]
    assert "rms_mm" not in worst
    level = fit.instruments[1]
    assert level.kind == "tilt"
    sigma = worst["rms_over_noise"][worst["functions"].index("tilt tilt")]
    assert sigma == pytest.approx(level.accuracy["train"].rms_error / level.noise, rel=1e-6)
    assert RelativeCalibration.from_dict(json.loads(fit.json())).worst.table().rows


def test_a_diagnosis_of_several_units_reports_each_file(tmp_path):
    tilts("rad", 1.0)  # registers the kind
    kind = mc_instruments.instrument_registry.load_instrument_class("tilt")
    arm, rng = ImperfectArm.draw("irb2600", 1, 0.0), np.random.default_rng(0)
    q, seen = (
        random_joint_values_above_floor(arm.robot, 60, rng),
        random_joint_values_above_floor(arm.robot, 40, rng),
    )
    lean = arm.real.pose(q)[:, 0, 2] + LEVEL_NOISE * rng.normal(size=60)
    points = mc.measurements(
        seen, arm.target_positions(seen)[:, None] + 1e-5 * rng.normal(size=(40, 1, 3))
    )
    level = kind(bare(q, {}), lean)
    found = mc.diagnose_relative(arm.robot, [points, level], noises={"tilt": LEVEL_NOISE})
    assert found.budget_table().header == ("model", "points RMS mm", "tilt RMS mrad")
    last = found.calibration.instruments[1].accuracy["holdout"].rms_error
    assert found.budget_table().rows[-1][-1] == pytest.approx(1e3 * last)
    floor = json.loads(found.json())["diagnosis"]["floor"]
    assert floor["unit"] == "rad"
    # given noise and the jitter of sound joints, which turns a level by some urad
    assert LEVEL_NOISE < floor["noise_floor"] < 2.0 * LEVEL_NOISE
    again = mc.RelativeDiagnosis.from_dict(json.loads(found.json()))
    assert (again.floor_unit, again.headline()) == ("rad", found.headline())


def test_noise_is_given_in_the_unit_of_the_rows():
    tilts("rad", 1.0)  # registers the kind
    arm, rng = ImperfectArm.draw("irb2600", 1, 0.0), np.random.default_rng(0)
    q = random_joint_values_above_floor(arm.robot, 60, rng)
    lean = arm.real.pose(q)[:, 0, 2] + LEVEL_NOISE * rng.normal(size=60)
    level = mc_instruments.instrument_registry.load_instrument_class("tilt")(bare(q, {}), lean)
    for text in ("0.02mrad", "20 urad"):
        fit = mc.relative(arm.robot, level, noises={"tilt": text})
        assert fit.instruments[0].noise == pytest.approx(20e-6)
    for text in ("0.02", "0.02mm", "3 px"):
        with pytest.raises(mc.OptionError, match=r"whose rows are in rad: .* in mrad"):
            mc.relative(arm.robot, level, noises={"tilt": text})


def test_report_and_evaluation_are_in_the_unit_of_the_rows(tmp_path):
    fit, _ = tilts("rad", 1.0)
    held = fit.instruments[1].accuracy["holdout"]
    fit.save(tmp_path / "fit.json")
    mc.report(tmp_path / "fit.json", path=tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert f"{1e3 * held.rms_error:.4g}" in page
    assert not re.search(r"\bnan\b(?= mm)", page)
    arm = ImperfectArm.draw("irb2600", 1, 0.0)
    q = random_joint_values_above_floor(arm.robot, 60, np.random.default_rng(5))
    kind = mc_instruments.instrument_registry.load_instrument_class("tilt")
    judged = mc.evaluate(
        fit, kind(bare(q, {}), fit.robot.pose(q)[:, 0, 2] + 1e-4 * (-1.0) ** q[:, 0].argsort())
    )
    assert judged.unit == "rad"
    assert judged.rms == pytest.approx(1e-4, rel=0.05)  # the zero takes the mean


def test_a_unit_is_asked_for(robot):
    for unit in ("mm", "deg", "mrad", ""):
        with pytest.raises(mc.OptionError, match="rows in SI"):
            mc.register_instrument(type("Mine", (Height,), {"unit": unit}))
    mc.register_instrument(type("Tilt", (Tilt,), {"unit": "m"}))
    arm, rng = ImperfectArm.draw("irb2600", 1, 0.0), np.random.default_rng(0)
    q = random_joint_values_above_floor(arm.robot, 50, rng)
    level = mc_instruments.instrument_registry.load_instrument_class("tilt")(
        bare(q, {}), arm.real.pose(q)[:, 0, 2]
    )
    fit = mc.relative(arm.robot, level)
    assert any('unit = "rad"' in one for one in fit.notices)


def test_an_arm_that_misses_a_level_by_many_mrad_is_another_arm():
    """As with rotations of whole poses: beyond 50 mrad RMS no calibrated arm."""
    mc.register_instrument(type("Tilt", (Tilt,), {"unit": "rad"}))
    arm, rng = ImperfectArm.draw("irb2600", 1, 0.0), np.random.default_rng(0)
    q = random_joint_values_above_floor(arm.robot, 60, rng)
    lean = arm.real.pose(q)[:, 0, 2] + 0.1 * rng.normal(size=60)
    fit = mc.relative(
        arm.robot,
        mc_instruments.instrument_registry.load_instrument_class("tilt")(bare(q, {}), lean),
    )
    assert fit.status is Status.FAILED
    assert "mrad" in fit.reason


# ---- open positions ------------------------------------------------------------------------------


SCALE = {"irb2600": "d4", "ur10": "a2"}  # the longest length, kept as drawn where none is known


def calibrated(name: str, kind: str, seed: int, **options) -> tuple[RelativeCalibration, float]:
    """The result, and the true error of positions over its sigma."""
    arm = ImperfectArm.draw(name, seed, 0.0)
    seen = MEASUREMENT_SIMULATORS[kind](
        arm, np.random.default_rng([seed, 6]), 100, RELATIVE_LENGTH_NOISE
    )
    fit = relative(arm.robot, seen.data, known_distances=seen.known, **options)
    q = random_joint_values_above_floor(arm.robot, 300, np.random.default_rng(1))
    plain = position_errors(arm, fit.robot, fitted_target_position(fit), q, with_scale=False)
    return fit, rms_in_mm(plain) / (1e3 * fit.position_sigma)


@pytest.mark.parametrize("kind", ["poses", "wires_3", "wires_1", "ball_bar", "closures_known"])
@pytest.mark.parametrize("name", SCALE)
def test_where_nothing_is_open_the_sigma_holds_the_truth(name, kind):
    fit, ratio = calibrated(name, kind, 0)
    assert fit.positions_open == ()
    assert ratio < 3.0
    assert "By the parameters' sigmas, lack of fit included" in fit.headline()


@pytest.mark.parametrize("name", SCALE)
def test_closures_without_a_length_leave_one_length_open(name):
    fit, _ = calibrated(name, "closures", 0)
    assert fit.positions_open == (SCALE[name],)
    assert np.isnan(fit.position_sigma)  # no sigma holds what is kept as drawn
    assert f"do not determine {SCALE[name]}" in fit.headline()
    content = json.loads(fit.json())
    assert content["positions_open"] == [SCALE[name]]
    assert content["position_sigma_mm"] is None
    assert RelativeCalibration.from_dict(content).headline() == fit.headline()
    if name == "ur10":  # what the user fixes is not open
        assert calibrated(name, "closures", 1, fix="a2")[0].positions_open == ()


@pytest.mark.parametrize("name", ["irb2600", "ur10"])
@pytest.mark.parametrize("on_axis", [True, False])
def test_one_reflector_on_the_last_axis_does_not_speak_for_the_tool(name, on_axis):
    """True errors of another point of the tool, whose offset and base are fitted by scipy."""
    arm, rng = ImperfectArm.draw(name, 1, 0.0), np.random.default_rng(1)
    spot = np.array([0.0, 0.0, 0.1]) if on_axis else RELATIVE_TARGET_POSITION
    q, new = (random_joint_values_above_floor(arm.robot, count, rng) for count in (80, 200))
    y = target_positions_in_base(arm.real, q, spot) + RELATIVE_LENGTH_NOISE * rng.normal(
        size=(80, 3)
    )
    fit = mc.calibrate(arm.robot, mc.measurements(q, y[:, None]), objective="sum")
    said = [notice for notice in fit.notices if "other points of the tool" in notice]
    other = np.array([0.1, -0.05, 0.05])
    true = target_positions_in_base(arm.real, new, other)

    def missed(x: Array) -> Array:
        here = target_positions_in_base(fit.robot, new, x[6:])
        return (here @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:6] - true).ravel()

    left = least_squares(missed, np.append(np.zeros(6), other)).fun.reshape(-1, 3)
    off_mm = rms_in_mm(np.linalg.norm(left, axis=1))
    assert bool(said) == on_axis == (off_mm > 3.0 * fit.accuracy["holdout"].rms_mm)


# ---- minimax -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["wires_4", "ball_bar"])
def test_the_worst_part_is_as_good_as_slsqp_makes_it(kind: str) -> None:
    """By another solver over the same parameters."""
    arm, seen = measured("irb2600", kind, 1, RELATIVE_LENGTH_NOISE)
    found = relative(arm.robot, seen.data, objective="minimax")
    train = {"": seen.data.take_rows(~seen.data.holdout_rows_and_notices(RelativeOptions())[0])}
    fit = fit_instruments(arm.robot, train, RelativeOptions(), silent_progress)
    problem, start = fit.problem, fit.state
    label = problem.stack.blocks[0].read_residual_rows(start).part
    size = (
        np.linalg.norm(problem.stack.rows(start, problem.active)[1], axis=1) / RELATIVE_LENGTH_NOISE
    )

    def squares(x: Array) -> Array:
        at = problem.step(start, x[:-1] / size)
        error, _ = problem.stack.rows(at, np.zeros_like(problem.active))
        return np.bincount(label, (error / RELATIVE_LENGTH_NOISE) ** 2) / np.bincount(label)

    first = np.append(np.zeros(len(size)), squares(np.zeros(len(size) + 1)).max())
    slope = np.append(np.zeros(len(size)), 1.0)
    theirs = minimize(
        lambda x: x[-1], first, jac=lambda x: slope, method="SLSQP",
        constraints={"type": "ineq", "fun": lambda x: x[-1] - squares(x)},
        options={"maxiter": 200, "ftol": 1e-12},
    )  # fmt: skip
    assert found.worst is not None
    assert found.worst.functions == found.parts
    ours = (found.worst.size.max() / RELATIVE_LENGTH_NOISE) ** 2
    assert ours == pytest.approx(squares(theirs.x).max(), rel=1e-3)
    assert found.worst.size.max() <= found.worst.before * (1.0 + 1e-9)
    assert found.worst.kkt.residual <= 1e-6
    assert_allclose(found.worst.multiplier.sum(), 1.0)
    again = RelativeCalibration.from_dict(found.to_dict(), "file")
    assert again.worst is not None
    assert again.worst.answered == found.worst.answered == {"daqp": found.iterations}
    plain = {p.name: p for p in relative(arm.robot, seen.data).parameters}
    known = [p for p in found.parameters if p.identifiable]
    assert all(abs(p.value - plain[p.name].value) < 5.0 * p.sigma for p in known)


def test_parts_of_several_files_compare_by_their_noises() -> None:
    """Wires ten times as rough as the poses are no worse than these in units of their noise."""
    arm, wires = measured("irb2600", "wires_3", 1, 10.0 * RELATIVE_LENGTH_NOISE)
    _, poses = measured("irb2600", "poses", 1, RELATIVE_LENGTH_NOISE)
    found = relative(arm.robot, [wires.data, poses.data], objective="minimax")
    assert found.worst is not None
    assert found.worst.functions == found.parts
    at = next(i for i, name in enumerate(found.parts) if name.startswith("poses"))
    assert found.worst.size[at] < 0.5 * found.worst.size.max()
    assert found.worst.multiplier[at] < 1.0
    assert "what decides the minimax" in found.summary()
    assert found.worst.kkt.residual <= 1e-6


# ---- losses --------------------------------------------------------------------------------------


SHARE = 0.08  # of the measurements that are wrong
EFFECT = {"effects": ("joint_compliance:J2",)}


def wrong(kind: str, data: Instrument, rng: np.random.Generator) -> Instrument:
    """The data with a share of gross errors of 3 to 20 mm."""
    size = rng.uniform(3e-3, 20e-3, (data.poses, 4)) * rng.choice([-1.0, 1.0], (data.poses, 4))
    size *= rng.uniform(size=size.shape) < SHARE
    if kind.startswith("wires"):
        return replace(data, length=data.length + size[:, : data.length.shape[1]])
    if kind == "poses":
        pose = data.pose.copy()
        pose[:, :3, 3] += size[:, :1] * rng.normal(size=(data.poses, 3))
        return replace(data, pose=pose)
    q = data.at.q.copy()
    q += size[:, :1] * rng.normal(size=q.shape)  # a radian is about a metre
    return replace(data, at=replace(data.at, q=q))


@cache
def fit_by(kind: str, loss: str, *, dirty: bool) -> InstrumentFit:
    arm, seen = measured("irb2600", kind, 1, RELATIVE_LENGTH_NOISE)
    data = wrong(kind, seen.data, np.random.default_rng(3)) if dirty else seen.data
    options = RelativeOptions(loss=loss, known_distances=seen.known)
    return fit_instruments(arm.robot, {"": data}, options, silent_progress)


def off(fit: InstrumentFit, other: InstrumentFit) -> Array:
    """By how many sigmas of the first the links differ."""
    links = fit.state.mdh.size
    known = fit.identification.active[:links] & other.identification.active[:links]
    apart = np.abs(fit.state.mdh - other.state.mdh).T.reshape(-1)
    return apart[known] / np.sqrt(np.diag(fit.covariance)[:links][known])


@pytest.mark.parametrize("kind", ["wires_3", "closures_known", "poses"])
@pytest.mark.parametrize("loss", ["huber", "tukey"])
def test_gross_errors_do_not_pull_a_loss(kind: str, loss: str) -> None:
    clean, found = fit_by(kind, "square", dirty=False), fit_by(kind, loss, dirty=True)
    assert found.least_squares.status[0] is Status.CONVERGED
    assert off(found, clean).max() < 3.0
    assert_allclose(found.noise, clean.noise, rtol=0.2)
    pulled = fit_by(kind, "square", dirty=True)
    assert off(clean, pulled).max() > 20.0
    assert pulled.noise[0] > 20.0 * clean.noise[0]


@pytest.mark.parametrize("kind", ["wires_3", "closures_known", "poses"])
def test_without_outliers_a_loss_costs_little(kind: str) -> None:
    """95 % of the efficiency: sigmas 2.6 % larger, by mean squares of these errors."""
    plain, found = fit_by(kind, "square", dirty=False), fit_by(kind, "huber", dirty=False)
    sigma = [np.sqrt(np.diag(fit.covariance))[plain.identification.active] / fit.noise[0]
             for fit in (plain, found)]  # fmt: skip
    assert np.median(sigma[1] / sigma[0]) == pytest.approx(0.95**-0.5, abs=0.07)
    assert_allclose(found.noise, plain.noise, rtol=0.1)
    assert off(plain, found).max() < 1.0  # sqrt(1 / 0.95 - 1) = 0.23 of a sigma, the largest of 25


def test_a_loss_of_lengths_is_that_of_scipy() -> None:
    """The same rows at the scale that was held, from beside the answer."""
    arm, seen = measured("irb2600", "wires_3", 1, RELATIVE_LENGTH_NOISE)
    data = wrong("wires_3", seen.data, np.random.default_rng(3))
    options = RelativeOptions(loss="huber", fix=("theta*", "alpha*", "beta*"))
    fit = fit_instruments(arm.robot, {"": data}, options, silent_progress)
    problem, edge = (
        fit.problem,
        fit.problem.scale[0] * LOSSES["huber"].interpolate_tuning(np.ones(1))[0],
    )

    def rows(x: Array, at: int) -> Array:
        state = problem.step(fit.state, x * RELATIVE_LENGTH_NOISE)
        return next(problem.stack.rows_by_block(state, problem.active))[at]

    start = np.random.default_rng(0).normal(size=problem.active.sum())
    theirs = least_squares(
        lambda x: rows(x, 0) / RELATIVE_LENGTH_NOISE, start, lambda x: -rows(x, 1).T, loss="huber",
        f_scale=edge / RELATIVE_LENGTH_NOISE, xtol=1e-12, ftol=1e-14, gtol=1e-10,
    )  # fmt: skip
    error = np.abs(rows(np.zeros(len(start)), 0)) / edge
    ours = (edge / RELATIVE_LENGTH_NOISE) ** 2 * np.where(
        error < 1.0, 0.5 * error**2, error - 0.5
    ).sum()
    assert ours == pytest.approx(theirs.cost, rel=1e-6)
    sigma = np.sqrt(np.diag(fit.covariance)[problem.active]) / RELATIVE_LENGTH_NOISE
    assert np.abs(theirs.x / sigma).max() < 1e-3


def test_a_loss_of_visits_is_least_where_no_socket_and_no_link_moves_it() -> None:
    """Huber's, with the sockets' places among the unknowns."""
    fit = fit_by("closures_known", "huber", dirty=True)
    problem, block = fit.problem, fit.problem.stack.blocks[0]
    edge, one = problem.scale[0] * LOSSES["huber"].tuning, block.instrument
    weight = problem.stack.row_weights(fit.state)[-1]

    def cost(x: Array, shift: Array) -> float:
        state = problem.stack.state_of_block(problem.step(fit.state, x), 0)
        place = block.flange(state).place(block.own_values(state)[:3])
        centre = one.socket_centres(place) + shift
        u = np.linalg.norm(place - centre[one.socket_index], axis=1) / edge
        apart = centre[one.socket_labels.index(one.known[0][0])] - centre[
            one.socket_labels.index(one.known[0][1])]  # fmt: skip
        short = (np.linalg.norm(apart) - one.known[0][2]) / edge
        return float(np.where(u < 1.0, u**2, 2.0 * u - 1.0).sum() + weight * short**2)

    sigma = np.sqrt(np.diag(fit.covariance)[problem.active])
    rng, still = (
        np.random.default_rng(0),
        (np.zeros(len(sigma)), np.zeros((len(one.socket_labels), 3))),
    )
    for _ in range(30):
        step = 1e-2 * sigma * rng.normal(size=len(sigma))
        shift = 1e-2 * RELATIVE_LENGTH_NOISE * rng.normal(size=still[1].shape)
        shift[[one.socket_labels.index(label) for label in one.known[0][:2]]] = 0.0
        for way in (1.0, -1.0):
            assert cost(way * step, way * shift) > cost(*still)


@cache
def tracked() -> tuple[ImperfectArm, mc.Measurements, InstrumentFit]:
    """A tracker's points with gross errors, and their fit as those of an instrument."""
    arm, rng = ImperfectArm.draw("irb2600", 1, 0.0), np.random.default_rng(4)
    q = random_joint_values_above_floor(arm.robot, 80, rng)
    y = arm.target_positions(q) + RELATIVE_LENGTH_NOISE * rng.normal(size=(80, 3))
    y += 5e-3 * rng.normal(size=y.shape) * (rng.uniform(size=(80, 1)) < SHARE)
    data = mc.measurements(q, y, split=np.where(np.arange(80) % 4 == 0, "holdout", "train"))
    return arm, data, by_huber(arm, data)


def by_huber(arm: ImperfectArm, data: mc.Measurements, **others: Instrument) -> InstrumentFit:
    points = TrackerPoints(data).take_rows(data.columns["split"] == "train")
    trains = {"points": points, **others}
    return fit_instruments(arm.robot, trains, RelativeOptions(loss="huber"), silent_progress)


def test_points_have_the_loss_that_calibrate_has() -> None:
    """The same points by both, to a tenth of a sigma."""
    arm, data, ours = tracked()
    theirs = mc.calibrate(arm.robot, data, objective="sum", loss="huber", simulated=True)
    names = ours.stack.names.all_names[:30]
    values = dict(zip(names, ours.state.mdh.T.reshape(-1), strict=True))
    links = [p for p in theirs.parameters if p.identifiable and p.name in values]
    assert len(links) == ours.identification.active[:30].sum() == 18
    for p in links:
        assert abs(p.value - values[p.name]) < 0.1 * p.sigma


def test_wires_with_gross_errors_beside_the_tracker_find_the_same_arm() -> None:
    arm, data, alone = tracked()
    _, seen = measured("irb2600", "wires_3", 1, 4.0 * RELATIVE_LENGTH_NOISE)
    lengths = wrong("wires_3", seen.data.take_rows(np.arange(60)), np.random.default_rng(3))
    both = by_huber(arm, data, wires=lengths)
    assert off(alone, both).max() < 3.0
    assert_allclose(both.noise, np.array([1.0, 4.0]) * RELATIVE_LENGTH_NOISE, rtol=0.25)
    low = re.search(r"(\d+) of 180 measurements of wires count less than half", both.notices[0])
    assert low
    assert (lengths.length != seen.data.length[:60]).sum() <= int(low[1]) <= 25


def test_effects_are_found_and_fitted_beside_gross_errors() -> None:
    """The same variant of the law as without them, to its sigmas."""
    arm = ImperfectArm.draw("irb2600", 1, RELATIVE_JOINT_COMPLIANCE)
    data = MEASUREMENT_SIMULATORS["wires_3"](
        arm, np.random.default_rng([1, 5]), 60, RELATIVE_LENGTH_NOISE
    ).data
    bad = wrong("wires_3", data, np.random.default_rng(3))
    clean, found = (
        fit_instruments(arm.robot, {"": each}, RelativeOptions(**how), silent_progress)
        for each, how in ((data, EFFECT), (bad, {**EFFECT, "loss": "huber"}))
    )
    assert found.stack.laws.names == clean.stack.laws.names
    laws = slice(clean.stack.parameter_count_without_laws, None)
    sigma = np.sqrt(np.diag(clean.covariance))[laws]
    apart = found.stack.law_values(found.state) - clean.stack.law_values(clean.state)
    assert np.nanmax(np.abs(apart) / sigma) < 2.0
    assert off(clean, found).max() < 3.0


def test_a_result_says_its_loss() -> None:
    arm, seen = measured("irb2600", "wires_1", 1, RELATIVE_LENGTH_NOISE)
    data = wrong("wires_1", seen.data, np.random.default_rng(3))
    found = relative(arm.robot, data, loss="tukey", offset=True)
    assert found.provenance.settings["loss"] == "tukey"
    said = next(notice for notice in found.notices if notice.startswith("loss tukey: "))
    assert " of 80 measurements of distances count less than half: a suspect may be" in said


def test_a_loss_goes_to_what_knows_it() -> None:
    arm, seen = measured("irb2600", "wires_3")
    chosen = merge_instrument_options(
        [seen.data], Options(objective="sum", loss="tukey"), RelativeOptions()
    )
    assert chosen.loss == "tukey"
    with pytest.raises(mc.OptionError, match="loss=huber is not for a diagnosis yet"):
        mc.diagnose_relative(arm.robot, seen.data, loss="huber")
    pixels = type("Pixels", (type(seen.data),), {"kind": "pixels"})(**vars(seen.data))
    with pytest.raises(mc.OptionError, match="loss=huber is not for pixels yet"):
        check_relative_options([pixels], RelativeOptions(loss="huber"))
