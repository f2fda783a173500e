"""One fit from several instruments: what they tell together, and which of them tells what."""

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments.relative import MEASUREMENT_SIMULATORS, RELATIVE_LENGTH_NOISE, ImperfectArm
from minimax_cal.fitting.multi_instrument.instrument_fit import (
    InstrumentFit,
    fit_instruments,
    select_laws,
)
from minimax_cal.fitting.multi_instrument.linear_rows import (
    build_common_arm_state,
    build_instrument_rows,
)
from minimax_cal.fitting.multi_instrument.options import RelativeOptions, silent_progress
from minimax_cal.fitting.multi_instrument.relative_calibration import relative
from minimax_cal.fitting.multi_instrument.relative_result import RelativeCalibration
from minimax_cal.fitting.opened_results import open_result
from minimax_cal.instruments import (
    Instrument,
    Surface,
    closures,
    contacts,
    distances,
    flange_poses,
    read_relative,
    write_relative,
)
from minimax_cal.instruments.instrument_files import convert_to_instrument
from minimax_cal.instruments.sockets import reach
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.global_start import fit_base_and_targets
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots.gravity_torques import assumed_link_masses_and_centres
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.robot import robot_from_dict
from minimax_cal.selection.noise_model import estimate_noise_by_reml

# ---- several instruments -------------------------------------------------------------------------


TOOL = np.array([[0.1, 0.0, 0.1], [0.0, 0.1, 0.1], [-0.1, -0.1, 0.2]])
SEEDS = range(6)


def tracker(
    arm: ImperfectArm, rng: np.random.Generator, poses: int, noise: float
) -> mc.Measurements:
    q = random_joint_values_above_floor(arm.robot, poses, rng)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    return mc.measurements(
        q, arm.target_positions(q) @ turn.T + shift + noise * rng.normal(size=(poses, 3))
    )


def missed(arm: ImperfectArm, robot: mc.Robot) -> float:
    """RMS error of fresh poses of three points of a tool, base and tool fitted [mm]."""
    q = random_joint_values_above_floor(arm.robot, 300, np.random.default_rng(98))
    pose = arm.real.pose(q)
    y = np.einsum("mij,kj->mki", pose[:, :3, :3], TOOL) + pose[:, None, :3, 3]
    fit = fit_base_and_targets(build_point_model(robot, mc.measurements(q, y)), robot.mdh)
    return float(1e3 * np.sqrt(fit.mean_square))


@cache
def errors(name: str, seed: int) -> tuple[float, ...]:
    """Of the tracker, sockets, wires, tracker and sockets, tracker and wires."""
    arm, rng = ImperfectArm.draw(name, seed, 0.0), np.random.default_rng([seed, 77])
    seen = tracker(arm, rng, 60, RELATIVE_LENGTH_NOISE)
    sockets = MEASUREMENT_SIMULATORS["closures_known"](arm, rng, 60, RELATIVE_LENGTH_NOISE)
    wires = MEASUREMENT_SIMULATORS["wires_3"](arm, rng, 60, RELATIVE_LENGTH_NOISE).data
    known = {"known_distances": sockets.known}
    alone = mc.calibrate(arm.robot, seen, objective="sum", simulated=True)
    fits = (
        alone,
        relative(arm.robot, sockets.data, **known),
        relative(arm.robot, wires),
        relative(arm.robot, [seen, sockets.data], **known),
        relative(arm.robot, [seen, wires]),
    )
    return tuple(missed(arm, fit.robot) for fit in fits)


@pytest.mark.parametrize("name", ["irb2600", "ur10"])
def test_two_instruments_are_better_than_either(name):
    found = np.array([errors(name, seed) for seed in SEEDS])
    with_sockets = found[:, 3] / np.minimum(found[:, 0], found[:, 1])
    with_wires = found[:, 4] / np.minimum(found[:, 0], found[:, 2])
    assert with_sockets.max() < 1.03
    # as good as a tracker each, so that the better of two draws is often better than the mean says
    assert with_wires.max() < 1.2
    assert np.median(with_sockets) < 0.9
    assert np.median(with_wires) < 0.85


def test_a_rough_instrument_does_not_spoil_a_fine_one():
    """Each counts by its own noise: alike, wires 13 times as rough would triple the error."""
    ratios = []
    for seed in SEEDS:
        arm, rng = ImperfectArm.draw("irb2600", seed, 0.0), np.random.default_rng([seed, 78])
        seen = tracker(arm, rng, 60, RELATIVE_LENGTH_NOISE)
        wires = MEASUREMENT_SIMULATORS["wires_3"](arm, rng, 60, 200e-6).data
        fit = relative(arm.robot, [seen, wires])
        noises = {one.kind: one.noise for one in fit.instruments}
        assert noises["points"] == pytest.approx(RELATIVE_LENGTH_NOISE, rel=0.25)
        assert noises["distances"] == pytest.approx(200e-6, rel=0.25)
        alone = mc.calibrate(arm.robot, seen, objective="sum", simulated=True)
        ratios.append(missed(arm, fit.robot) / missed(arm, alone.robot))
    assert max(ratios) < 1.1
    assert np.median(ratios) < 1.02


def test_a_noise_that_is_given_counts_instead_of_the_residuals():
    arm, rng = ImperfectArm.draw("irb2600", 2, 0.0), np.random.default_rng(3)
    seen, wires = (
        tracker(arm, rng, 40, RELATIVE_LENGTH_NOISE),
        MEASUREMENT_SIMULATORS["wires_3"](arm, rng, 60, RELATIVE_LENGTH_NOISE).data,
    )
    plain = relative(arm.robot, [seen, wires])
    told = relative(arm.robot, [seen, wires], noises={"distances": "0.3mm"})
    assert [one.noise for one in told.instruments][1] == pytest.approx(3e-4, rel=1e-9)
    sigmas = ({p.name: p.sigma for p in fit.parameters} for fit in (plain, told))
    before, after = (sigma["distances.anchor1_x"] for sigma in sigmas)
    assert after > 5.0 * before
    for noises, words in (
        ({"wire": 1e-4}, "noise wire: no file is called so; they are points, distances"),
        ({"points": -1.0}, "must be positive"),
        ({"points": "1 rad"}, "write FILE=SIGMA in mm"),
    ):
        with pytest.raises(mc.OptionError, match=words):
            relative(arm.robot, [seen, wires], noises=noises)


@cache
def all_kinds() -> tuple[ImperfectArm, RelativeCalibration]:
    arm, rng = ImperfectArm.draw("ur10", 3, 0.0), np.random.default_rng(6)
    kinds = ("closures", "wires_1", "poses")
    data = [
        MEASUREMENT_SIMULATORS[kind](arm, rng, 60, RELATIVE_LENGTH_NOISE).data for kind in kinds
    ]
    return arm, relative(arm.robot, [tracker(arm, rng, 40, RELATIVE_LENGTH_NOISE), *data])


def test_without_noise_all_kinds_together_find_the_true_arm():
    arm, rng = ImperfectArm.draw("ur10", 3, 0.0), np.random.default_rng(6)
    kinds = ("closures", "wires_1", "poses")
    data = [MEASUREMENT_SIMULATORS[kind](arm, rng, 60, 0.0).data for kind in kinds]
    fit = relative(arm.robot, [tracker(arm, rng, 40, 0.0), *data])
    assert fit.status == "converged"
    assert missed(arm, fit.robot) < 1e-5
    assert all(one.accuracy["holdout"].max_mm < 1e-5 for one in fit.instruments)


def test_what_only_one_instrument_determines_is_said():
    """A tracker that saw the last joints still gives the base, and wires alone see the wrist."""
    arm, rng = ImperfectArm.draw("irb2600", 0, 0.0), np.random.default_rng(4)
    sockets = MEASUREMENT_SIMULATORS["closures"](arm, rng, 60, RELATIVE_LENGTH_NOISE).data
    q = random_joint_values_above_floor(arm.robot, 60, rng)
    q[:, 3:] = q[0, 3:]
    seen = mc.measurements(
        q, arm.target_positions(q) + RELATIVE_LENGTH_NOISE * rng.normal(size=(60, 3))
    )
    fit = relative(arm.robot, [seen, sockets])
    told = {one.name: one for one in fit.instruments}
    assert "a5" in told["closures"].alone  # the tracker saw no turn of the wrist
    assert told["points"].directions_alone == 1  # the scale, which no closure has
    lengths = {name for name in told["points"].alone if name[0] in "ad" and name[1].isdigit()}
    assert {"a2", "d4"} <= lengths
    assert not {name for name in told["points"].alone if name.startswith("theta")}
    table = fit.alone_table().text(110)
    assert "closures" in table
    assert "a5" in table


def test_the_result_lists_each_file_and_comes_back(tmp_path):
    _, fit = all_kinds()
    assert [one.name for one in fit.instruments] == ["points", "closures", "distances", "poses"]
    path = tmp_path / "fit.json"
    fit.save(path)
    content = json.loads(path.read_text())
    assert content["measured"] == "several"
    for one in content["instruments"]:
        held = one["accuracy"]["holdout"]
        low, high = held["rms_ci95_mm"]
        assert low < held["rms_mm"] < high
        assert held["rms_mm"] < 0.1 * one["accuracy"]["nominal"]["rms_mm"]
        assert one["noise"] == pytest.approx(1e3 * RELATIVE_LENGTH_NOISE, rel=0.5)
    again = RelativeCalibration.from_dict(content)
    assert [one.name for one in again.instruments] == [one.name for one in fit.instruments]
    assert again.files_table().text(100) == fit.files_table().text(100)
    assert_allclose(mc.load_robot(path).mdh, fit.robot.mdh, rtol=0, atol=1e-12)
    report = mc.report(path, tmp_path / "report.html")
    assert "only by" in Path(report).read_text()


def test_files_are_one_fit_and_named_by_their_stems(tmp_path):
    arm, rng = ImperfectArm.draw("irb2600", 1, 0.0), np.random.default_rng(2)
    seen, sockets = (
        tracker(arm, rng, 40, RELATIVE_LENGTH_NOISE),
        MEASUREMENT_SIMULATORS["closures"](arm, rng, 60, RELATIVE_LENGTH_NOISE).data,
    )
    mc.write_measurements(tmp_path / "tracker.csv", seen)
    write_relative(tmp_path / "sockets.csv", sockets)
    files = [tmp_path / "tracker.csv", tmp_path / "sockets.csv"]
    fit = relative(arm.robot, files)
    assert [one.name for one in fit.instruments] == ["tracker", "sockets"]
    assert {"tracker.base_x", "tracker.smr1_x", "sockets.target_x"} <= {
        p.name for p in fit.parameters
    }
    assert read_relative(files[0]).kind == "points"
    # the order of files is no matter
    other = relative(arm.robot, files[::-1])
    assert_allclose(other.robot.mdh, fit.robot.mdh, rtol=0, atol=1e-8)


def test_a_slip_in_one_of_several_files_is_named():
    arm, rng = ImperfectArm.draw("irb2600", 1, 0.0), np.random.default_rng(2)
    seen, sockets = (
        tracker(arm, rng, 40, RELATIVE_LENGTH_NOISE),
        MEASUREMENT_SIMULATORS["closures"](arm, rng, 60, RELATIVE_LENGTH_NOISE).data,
    )
    metres = mc.measurements(seen.q, 1e-3 * seen.y)
    with pytest.raises(mc.DataError, match="points look like metres given as millimetres"):
        relative(arm.robot, [metres, sockets])
    turned = closures(sockets.at.q * [1, 1, -1, 1, 1, 1], sockets.socket)
    with pytest.raises(mc.DataError, match="the sign of joint 3 looks reversed"):
        relative(arm.robot, [seen, turned])
    with pytest.raises(mc.DataError, match="use minimax-cal calibrate"):
        relative(arm.robot, [seen])
    with pytest.raises(mc.DataError, match="no file of measurements"):
        relative(arm.robot, [])
    with pytest.raises(mc.OptionError, match=r"offset= is for distances; .* holds points and "):
        relative(arm.robot, [seen, sockets], offset=True)


# ---- instrument laws -----------------------------------------------------------------------------


COMPLIANCE = 3e-7  # of every joint [rad/(N m)]
PLAIN = mc.load_robot("irb2600")
MASS, COM = assumed_link_masses_and_centres(PLAIN.mdh)
TOLD = replace(PLAIN, mass=np.maximum(MASS, 1.0), com=COM)  # one compliance a joint
ASKED = ("joint_compliance:J2", "joint_compliance:J3")
SEVERAL = (*ASKED, "link_bending:L2", "base_flex", "gear_error:J1:turns=1")


def arm_of(seed: int) -> ImperfectArm:
    return ImperfectArm(
        TOLD, TOLD.with_mdh(ImperfectArm.draw("irb2600", seed, 0.0).real.mdh), COMPLIANCE
    )


def tracked(arm: ImperfectArm, rng: np.random.Generator, poses: int) -> Instrument:
    q = random_joint_values_above_floor(arm.robot, poses, rng)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    y = (
        arm.target_positions(q) @ turn.T
        + shift
        + RELATIVE_LENGTH_NOISE * rng.normal(size=(poses, 3))
    )
    return convert_to_instrument(mc.measurements(q, y))


def plates(arm: ImperfectArm, rng: np.random.Generator, count: int) -> Instrument:
    """Contacts with four planes that stand where the ball happened to be: no pose is special."""
    q, labels = (
        random_joint_values_above_floor(arm.robot, 4 * count, rng),
        np.repeat(list("ABCD"), count),
    )
    return contacts(q, labels, [Surface(label) for label in "ABCD"])


KINDS = ("tracker", "wires_3", "closures_known", "poses")


@cache
def measured(
    seed: int, kinds: tuple[str, ...]
) -> tuple[ImperfectArm, tuple[Instrument, ...], tuple]:
    arm, rng = arm_of(seed), np.random.default_rng([seed, 5])
    data, known = [], ()
    for kind in kinds:
        if kind == "tracker":
            data.append(tracked(arm, rng, 60))
            continue
        made = MEASUREMENT_SIMULATORS[kind](arm, rng, 100, RELATIVE_LENGTH_NOISE)
        data.append(made.data)
        known = made.known or known
    return arm, tuple(data), known


def fitted(
    kinds: tuple[str, ...], effects: tuple[str, ...] = ()
) -> tuple[ImperfectArm, InstrumentFit]:
    arm, data, known = measured(0, kinds)
    every = [replace(each, at=add_history_columns(each.at)) for each in data]
    trains = {f"file{i}": each for i, each in enumerate(every)}
    options = RelativeOptions(known_distances=known, effects=effects)
    return arm, fit_instruments(arm.robot, trains, options, silent_progress)


@pytest.mark.parametrize("kind", [*KINDS, "contacts"])
def test_the_rows_of_an_arm_that_gives_way_have_its_derivative(kind):
    """By central differences, of links, of the instrument's own and of the laws.

    But for a turn of the base of points: their rows are along its axes, and turn with it.
    """
    arm, rng = arm_of(1), np.random.default_rng(3)
    if kind == "contacts":
        data = [replace(plates(arm, rng, 30), at=add_history_columns(plates(arm, rng, 30).at))]
        options = RelativeOptions(fix=("*",))
        fit = fit_instruments(arm.robot, {"plates": data[0]}, options, silent_progress)
    else:
        arm, fit = fitted((kind,))
    laws = select_laws(arm.robot, fit, SEVERAL)
    stack, x = fit.stack.with_laws(arm.robot, laws, fit.state)
    first = stack.names.geometric_count
    turns = [name.startswith("base_r") for name in stack.names.all_names]
    active = stack.movable & ~np.array(turns)
    size = np.abs(stack.rows(x, active)[1][-len(laws.names) :]).max(axis=1)
    x.effects[stack.parameter_count_without_laws - first :] = (
        1e-5 * rng.normal(size=len(size)) / size
    )  # some 10 um
    _, slope = stack.rows(x, active)
    for row, at in zip(slope, np.flatnonzero(active), strict=True):
        step, size = np.zeros(stack.names.parameter_count), max(float(np.abs(row).max()), 1.0)
        step[at] = 1e-6 / size
        ends = [stack.rows(x.step(sign * step), ~active)[0] for sign in (1, -1)]
        assert_allclose(
            row / size, (ends[1] - ends[0]) / 2e-6, atol=3e-8, err_msg=stack.names.all_names[at]
        )


def test_an_arm_at_other_poses_gives_way_by_the_same_laws():
    """At the training poses `at_rows_of` predicts what the rows do."""
    for kind in KINDS:
        arm, fit = fitted((kind,), ASKED)
        data = next(iter(fit.training_data.values()))
        stack, x = fit.stack, fit.stack.state_of_block(fit.state, 0)
        block = stack.blocks[0].with_measurements(arm.robot, data, stack.laws, x)
        held = np.zeros(data.poses, dtype=bool)
        error = block.instrument.part_errors(block.flange(x), block.own_values(x), held)
        assert (
            0.5 * RELATIVE_LENGTH_NOISE
            < np.sqrt(np.nanmean(error**2))
            < 2.0 * RELATIVE_LENGTH_NOISE
        )


PULLED = (("wires_3",), ("closures_known",), ("poses",), ("tracker", "closures_known"))


@pytest.mark.parametrize("kinds", PULLED)
def test_the_compliance_is_found_to_its_sigma(kinds):
    pulls = []
    for seed in range(5):
        arm, data, known = measured(seed, kinds)
        fit = relative(arm.robot, list(data), known_distances=known, effects=ASKED)
        found = [p for p in fit.parameters if p.is_of_effect]
        assert [p.name for p in found] == ["joint_compliance:J2.c2", "joint_compliance:J3.c3"]
        assert all(p.sigma < 0.3 * COMPLIANCE for p in found)
        pulls += [(p.value - COMPLIANCE) / p.sigma for p in found]
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.6  # ten: 0.57 to 1.43 in 95 %
    assert np.abs(pulls).max() < 3.5


def test_with_its_effects_an_arm_is_met_as_no_stiff_one_is():
    for kinds in PULLED:
        arm, data, known = measured(1, kinds)
        plain = relative(arm.robot, list(data), known_distances=known)
        bent = relative(arm.robot, list(data), known_distances=known, effects=ASKED)
        before, after = (fit.accuracy["holdout"].rms_mm for fit in (plain, bent))
        assert after < 0.6 * before
        assert after < 2.5e3 * RELATIVE_LENGTH_NOISE
        # the robot of the file is that of geometry alone
        assert_allclose(bent.robot.mdh, plain.robot.mdh, rtol=0, atol=1e-12)
        assert plain.cell is None


def test_a_joint_that_does_not_give_way_rests_at_its_bound():
    arm, rng = ImperfectArm(TOLD, arm_of(2).real, -2e-7), np.random.default_rng(8)
    data = MEASUREMENT_SIMULATORS["wires_3"](arm, rng, 100, RELATIVE_LENGTH_NOISE).data
    fit = relative(arm.robot, data, effects="joint_compliance:J2")
    (found,) = (p for p in fit.parameters if p.is_of_effect)
    assert (found.value, found.identifiable, found.reason) == (0.0, False, "at its bound")


# ---- the rows of evidence ----------------------------------------------------------------------


@pytest.mark.parametrize("kinds", [*((kind,) for kind in KINDS), KINDS])
def test_the_rows_of_evidence_estimate_what_the_fit_does(kinds):
    """One Gauss-Newton step from geometry alone, weighed alike, geometry projected out."""
    arm, fit = fitted(kinds)
    scene = build_common_arm_state(arm.robot, fit)
    rows = build_instrument_rows(scene, fit)
    found = select_laws(arm.robot, fit, ASKED)
    field = np.concatenate(
        [term.columns(scene).target_displacements(scene) for term in found.terms]
    )
    columns = rows.rows_from_fields(field)
    clear = columns - rows.nuisance_basis @ (rows.nuisance_basis.T @ columns)
    value = np.linalg.lstsq(clear, rows.error, rcond=None)[0]
    stack, x = fit.stack.with_laws(arm.robot, found, fit.state)
    active = np.pad(fit.identification.active, (0, 2), constant_values=True)
    weight = np.sqrt(stack.row_weights(x))  # a known distance counts as a coordinate in evidence
    error, slope = stack.rows(x, active)
    step = np.linalg.lstsq((slope / weight).T, error / weight, rcond=1e-12)[0]
    assert_allclose(value, step[-2:], rtol=1e-6)


@pytest.mark.parametrize("kinds", [*((kind,) for kind in KINDS), KINDS])
def test_the_rows_of_a_stiff_arm_have_the_noise_of_their_instruments(kinds):
    arm, fit = fitted(kinds, ASKED)
    scene = build_common_arm_state(arm.robot, fit)
    rows = build_instrument_rows(scene, fit)
    noise = estimate_noise_by_reml(rows, np.zeros((len(rows.error), 0)))
    assert noise.variance == pytest.approx(float(fit.noise.min()) ** 2, rel=0.2)
    assert noise.joint_jitter < 5e-6
    numbers = sum(
        6 * one.poses
        if one.kind == "poses"
        else len(fit.stack.blocks[i].read_residual_rows(part).row_weights)
        for i, one in enumerate(fit.stack.instruments)
        for part in [fit.stack.state_of_block(fit.state, i)]
    )
    assert rows.measured_row_count == numbers


# ---- the file ----------------------------------------------------------------------------------


def test_a_file_predicts_with_its_effects(tmp_path):
    arm, data, _ = measured(3, ("wires_3", "closures"))
    fit = relative(arm.robot, list(data), effects=ASKED)
    path = tmp_path / "fit.json"
    fit.save(path)
    again = open_result(path)
    assert fit.cell is not None
    assert_allclose(again.cell.robot.mdh, fit.cell.robot.mdh, rtol=0, atol=1e-12)
    assert [t.label for t in again.cell.effects.terms] == list(ASKED)
    assert again.geometric is not None
    assert_allclose(again.geometric.robot.mdh, fit.robot.mdh, rtol=0, atol=1e-12)
    seen = tracked(arm, np.random.default_rng(12), 80).at
    cell, _, _ = again.place_on_data(seen)
    stiff, _, _ = replace(again, rungs=(again.rungs[0], replace(
        again.rungs[1], cell=again.geometric))).place_on_data(seen)  # fmt: skip
    met, missed = (float(np.sqrt(np.mean(one.error(seen) ** 2))) for one in (cell, stiff))
    assert met < 2.0 * RELATIVE_LENGTH_NOISE < 0.5 * missed


def test_what_carries_no_effect_holds_the_geometry_fitted_alone(tmp_path):
    arm, data, _ = measured(3, ("wires_3", "closures"))
    fit = relative(arm.robot, list(data), effects=ASKED)
    made = mc.deliver(fit, "urdf")
    assert made.not_carried == ASKED
    assert_allclose(made.cell.robot.mdh, fit.robot.mdh, rtol=0, atol=1e-12)
    held = mc.deliver(fit, "mjcf")
    assert held.carries == ASKED
    assert_allclose(held.cell.robot.mdh, fit.cell.robot.mdh, rtol=0, atol=1e-12)


def test_effects_that_are_no_arms_or_lack_something_are_refused(tmp_path):
    arm, data, _ = measured(3, ("wires_3", "closures"))
    for effect, words in (
        ("target_offset", "belongs to one instrument, not to the arm that all share"),
        ("backlash:J1", "lacks columns approach1"),
        ("nonsense", "no effect 'nonsense'"),
        ("joint_compliance:J9", "no place 'J9'"),
    ):
        with pytest.raises(mc.OptionError, match=words):
            relative(arm.robot, list(data), effects=effect)


# ---- instrument priors ---------------------------------------------------------------------------


QUARTER = np.pi / 2
PANDA = robot_from_dict(
    {
        "name": "panda", "convention": "modified", "units": {"length": "m", "angle": "rad"},
        "joints": [
            {"a": a, "d": d, "theta": 0.0, "alpha": alpha}
            for a, d, alpha in (
                (0.0, 0.333, 0.0), (0.0, 0.0, -QUARTER), (0.0, 0.316, QUARTER),
                (0.0825, 0.0, QUARTER), (-0.0825, 0.384, -QUARTER), (0.0, 0.0, QUARTER),
                (0.088, 0.107, QUARTER),
            )
        ],
    },
    "panda",
)  # fmt: skip
PRIOR = {"a*": "5mm", "d*": "5mm", "theta*": "20mrad", "alpha*": "20mrad", "beta*": "20mrad"}
BALL = np.array([0.03, -0.02, 0.1])
HOME = np.array([0.0, 0.3, 0.0, -1.9, 0.0, 2.2, 0.8])
SOCKETS, VISITS, TILT = 11, 4, 0.08  # a plate, four visits each that hardly turn the flange
JITTER, GAUGE = 1e-4, 20e-6  # of a joint [rad], of a known distance [m]


@cache
def plate(seed: int) -> tuple[mc.Robot, np.ndarray, list[str], list[tuple[str, str, float]]]:
    """A true arm, joints that hold the ball in eleven sockets, labels, three known distances."""
    rng = np.random.default_rng(seed)
    error = rng.normal(size=(7, 5)) * ([5e-3] * 2 + [20e-3] * 3)
    true = PANDA.with_mdh(PANDA.mdh + error)
    pose = true.pose(HOME[None])[0]
    centre = pose[:3, :3] @ BALL + pose[:3, 3]
    spots = centre + np.append(rng.uniform(-0.2, 0.2, (SOCKETS, 2)), np.zeros((SOCKETS, 1)), 1)
    joints, labels = [], []
    for number, spot in enumerate(spots):
        start = HOME + TILT * rng.normal(size=(3 * VISITS, 7))
        q, gap = reach(true, BALL, np.repeat(spot[None], len(start), axis=0), start)
        q = q[gap < 1e-9][:VISITS]
        joints.append(q + JITTER * rng.normal(size=q.shape))
        labels += [f"S{number}"] * len(q)
    known = [
        (f"S{a}", f"S{b}", float(np.linalg.norm(spots[a] - spots[b]) + GAUGE * rng.normal()))
        for a, b in ((0, 3), (1, 4), (2, 5))
    ]
    return true, np.concatenate(joints), labels, known


def with_priors(seed: int, priors: Mapping[str, float | str] | None) -> RelativeCalibration:
    _, q, labels, known = plate(seed)
    return mc.relative(PANDA, closures(q, labels), known_distances=known, priors=priors)


def off(seed: int, robot: mc.Robot, ball: np.ndarray) -> float:
    """RMS error of positions about the plate once a base is fitted [m]."""
    q = HOME + 0.5 * np.random.default_rng(99).uniform(-1.0, 1.0, (200, 7))
    both = []
    for arm, spot in ((plate(seed)[0], BALL), (robot, ball)):
        pose = arm.pose(q)
        points = pose[:, :3, :3] @ spot + pose[:, :3, 3]
        both.append(points - points.mean(axis=0))
    u, _, v = np.linalg.svd(both[1].T @ both[0])
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    return float(np.sqrt(((both[0] - both[1] @ turn) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("seed", range(2))
def test_a_weak_prior_brings_a_panda_home_from_a_plate_of_sockets(seed):
    with_prior, plain = with_priors(seed, PRIOR), with_priors(seed, None)
    assert str(with_prior.status) == "converged"
    balls = [1e-3 * np.array(fit.instrument["target_mm"]) for fit in (with_prior, plain)]
    errors = [off(seed, f.robot, b) for f, b in zip((with_prior, plain), balls, strict=True)]
    assert errors[0] < 1.2 * errors[1]
    assert errors[0] < 0.5 * off(seed, PANDA, BALL)
    links = [p for p in with_prior.parameters if p.name[0] == "d" and p.identifiable]
    assert all(abs(p.value - p.nominal) < 4.0 * 5e-3 for p in links)  # four sigmas
    assert all(0.0 < p.sigma <= 5e-3 for p in links)


def test_a_firm_prior_keeps_the_drawing():
    firm = with_priors(0, {"a*": 1e-9, "d*": 1e-9})
    for p in firm.parameters:
        if p.name[0] in "ad" and not p.name.startswith("alpha") and p.identifiable:
            assert abs(p.value - p.nominal) < 1e-8
            assert 0.0 < p.sigma < 2e-9


def wires() -> tuple[mc.Simulation, Instrument]:
    made = mc.simulate("irb2600", 60, 1, 2)
    point = made.cell.predict(made.data.q)[:, 0]
    anchors = np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 1.0], [-1.0, -1.0, 2.0]])
    length = np.linalg.norm(point[:, None] - anchors, axis=-1)
    length = length + 15e-6 * np.random.default_rng(0).normal(size=length.shape)
    return made, distances(made.data.q, length)


def test_a_loose_prior_says_nothing():
    _, data = wires()
    loose, plain = (mc.relative("irb2600", data, priors=p) for p in ({"theta*": 1e3}, None))
    for one, other in zip(loose.parameters, plain.parameters, strict=True):
        assert_allclose(one.value, other.value, rtol=0, atol=1e-7)
        assert_allclose(one.sigma, other.sigma, rtol=1e-3)


def test_wires_and_poses_take_priors_too():
    made, lengths = wires()
    q = made.data.q
    pose = made.cell.base @ made.cell.robot.pose(q)
    for data in (lengths, flange_poses(q, pose)):
        fit = mc.relative("irb2600", data, priors={"alpha*": 1e-9})
        kept = [p for p in fit.parameters if p.name.startswith("alpha") and p.identifiable]
        assert kept
        assert all(abs(p.value - p.nominal) < 1e-7 for p in kept)


def test_what_no_prior_can_be_is_refused():
    with pytest.raises(mc.OptionError, match=r"target_x: .* have no nominal value to keep"):
        with_priors(0, {"target_x": 1e-3})
    with pytest.raises(mc.OptionError, match="must be positive"):
        with_priors(0, {"a2": -1.0})


def test_a_distance_that_no_prior_allows_is_refused():
    _, q, labels, known = plate(0)
    wrong = [(*known[0][:2], known[0][2] + 0.5), *known[1:]]
    with pytest.raises(mc.OptionError, match="check the labels and the length"):
        mc.relative(PANDA, closures(q, labels), known_distances=wrong, priors=PRIOR)


def test_the_command_takes_priors(tmp_path, says):
    _, q, labels, known = plate(2)
    head = ",".join([*(f"q{j + 1}_rad" for j in range(7)), "socket"])
    pairs = zip(q.tolist(), labels, strict=True)
    rows = [",".join([*map(repr, row), label]) for row, label in pairs]
    (tmp_path / "sockets.csv").write_text("\n".join([head, *rows]))
    (tmp_path / "panda.json").write_text(json.dumps(PANDA.to_dict()))
    given = [f"--known-distance={a},{b},{1e3 * length!r}" for a, b, length in known]
    priors = [f"--prior={name}={sigma}" for name, sigma in PRIOR.items()]
    files = [str(tmp_path / "panda.json"), str(tmp_path / "sockets.csv")]
    assert "converged" in says("relative", *files, *given, *priors).out


# ---- priors of links that points tell together alone -------------------------------------------


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("seen", ["tracker", "poses"])
def test_of_links_that_move_alike_priors_tell_each(seen, seed):
    """d2 and d3 of parallel axes: their sum is measured, their difference is what priors say.

    With equal priors s each gets half of the sum, and the sigma s / sqrt(2).
    """
    prior = {"d2": "0.4mm", "d3": "0.4mm"}
    truth = Truth(compliance=0.0, length=0.4e-3)
    robot = mc.load_robot("irb2600")
    made = simulate(robot, poses=60, targets=2, seed=seed, truth=truth)
    if seen == "tracker":
        fit = mc.calibrate(robot, made.data, objective="sum", priors=prior)
    else:
        pose = made.cell.robot.pose(made.data.q)
        pose[:, :3, 3] += 15e-6 * np.random.default_rng(seed).normal(size=(60, 3))
        fit = mc.relative(robot, flange_poses(made.data.q, pose), priors=prior)
    one, other = (next(p for p in fit.parameters if p.name == name) for name in prior)
    off = [p.value - p.nominal for p in (one, other)]
    true = made.cell.robot.mdh[1:3, 1] - robot.mdh[1:3, 1]
    assert_allclose(off[0], off[1], atol=2e-6)
    assert_allclose([one.sigma, other.sigma], 0.4e-3 / np.sqrt(2.0), rtol=0.02)
    assert np.abs(off - true).max() < 4.0 * one.sigma
