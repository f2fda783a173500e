"""A calibration that cannot be has failed, and one that does not help says so."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.fitting.accuracy import summarise_point_errors
from minimax_cal.fitting.arm_comparison import compare_paired_errors, compare_with_nominal
from minimax_cal.fitting.arm_identity import (
    MAX_NOISE_TO_ERROR_RATIO,
    check_same_arm,
    smallest_possible_noise,
)
from minimax_cal.fitting.data_slips import MAX_LENGTH_CHANGE_OF_REACH, describe_other_arm
from minimax_cal.fitting.outliers import Outlier
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.global_start import fit_base_and_targets
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.modelling.simulate import Truth, gravity, simulate
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.robot import robot_from_dict

# ---- outcome -------------------------------------------------------------------------------------


EXACT = Truth(compliance=0.0, noise=0.0, noise_per_metre=0.0)


def as_measured(data: Measurements) -> Measurements:
    """The same points without the word that they are simulated."""
    return replace(data, simulated=False)


AS_DRAWN = Truth(length=1e-12, angle=1e-12, compliance=0.0)  # an arm as drawn


def whole_degrees(data: Measurements) -> Measurements:
    """The joints as a log that keeps no decimals has them."""
    return replace(data, q=np.radians(np.round(np.degrees(data.q))))


# ---- another arm ---------------------------------------------------------------------------------


def test_the_file_of_another_arm_has_failed_and_names_links(tmp_path):
    """Nobody sees it in the errors: enough free parameters make the one arm of the other."""
    data, out = tmp_path / "d.csv", tmp_path / "fit.json"
    mc.write_measurements(data, simulate("irb120", 105, 3, seed=1).data)
    fit = mc.calibrate("ur10", data, "sum")
    assert fit.status == "failed"
    assert fit.within.after.rms_mm < 1.0
    assert "the measured arm is not the one that" in fit.reason
    assert fit.reason in fit.notices
    assert run("calibrate ur10", data, "--objective", "sum", "-o", out) == 1
    assert not out.exists()
    assert mc.calibrate("ur10", data, "sum", allow_large_changes=True).status == "converged"
    rough = replace(mc.load_robot("ur10"), rough=True)
    assert mc.calibrate(rough, data, "sum").status == "converged"


def test_another_arm_is_not_polished():
    """Its minimax took a minute: links of a kilometre, and QPs that no backend answers."""
    other = simulate("ur10", 24, 3, 1, Truth(compliance=0.0)).data
    with pytest.warns(mc.CalibrationWarning, match="implausibly large changes"):
        fit = mc.calibrate("irb2600", other, holdout=0.0)
    assert fit.status == "failed"
    assert fit.minimax
    assert fit.minimax.iterations <= 20


def test_large_changes_are_those_of_identified_links(robot):
    reach, n = robot.reach(), robot.joints
    known = np.ones(5 * n, dtype=bool)

    def said(joint: int, column: int, by: float, active: np.ndarray = known) -> str:
        mdh = robot.mdh.copy()
        mdh[joint, column] += by
        return describe_other_arm(robot, mdh, active)

    limits = [MAX_LENGTH_CHANGE_OF_REACH * reach] * 2 + list(np.radians([30.0, 5.0, 5.0]))
    for column, most in enumerate(limits):
        assert not said(2, column, 0.99 * most)
        assert f"{('a', 'd', 'theta', 'alpha', 'beta')[column]}3 by" in said(2, column, 1.01 * most)
        unknown = known.copy()
        unknown[column * n + 2] = False
        assert not said(2, column, 2.0 * most, unknown)
        assert not said(n - 1, column, 2.0 * most)  # the last link moves all as the tool does
    assert not said(0, 1, 0.5 * reach)
    assert not said(0, 2, 1.0)
    assert not said(2, 2, 2.0 * np.pi + 0.1)  # a whole turn more is the same joint
    assert said(2, 3, 2.0 * np.pi + 0.1)


def test_a_rough_drawing_says_so_in_its_file(robot):
    content = robot.to_dict()
    assert "nominal" not in content
    rough = replace(robot, rough=True).to_dict()
    assert rough["nominal"] == "rough"
    assert robot_from_dict(rough).rough
    assert not robot_from_dict(content).rough
    with pytest.raises(mc.RobotError, match="nominal"):
        robot_from_dict({**content, "nominal": "guessed"})


# ---- exchanged rows ------------------------------------------------------------------------------


def exchanged(data: Measurements, one: int, other: int) -> Measurements:
    """The joints of two rows in each other's place."""
    q = data.q.copy()
    q[[one, other]] = q[[other, one]]
    return replace(data, q=q)


def test_exchanged_rows_are_named(robot):
    data = simulate(robot, 100, 3, seed=5).data
    held = mc.calibrate(robot, data, "sum").held
    one, other = np.flatnonzero(~held)[[7, 40]]
    wrong = exchanged(data, one, other)
    fit = mc.calibrate(robot, wrong, "sum")
    lines = sorted(data.line[[one, other]].tolist())
    assert fit.status == "failed"
    assert f"rows hold each other's points: lines {lines[0]}, {lines[1]}" in fit.reason
    # a loss that sets them aside is not pulled by them: they are named, and the arm is right
    fit = mc.calibrate(robot, wrong, "sum", loss="tukey")
    assert fit.status == "converged"
    assert any("rows hold each other's points" in notice for notice in fit.notices)


def test_slips_are_judged_on_the_rows_that_tried_them():
    """Two exchanged rows made the sign of a joint look reversed; the rows tried held neither."""
    data = simulate("ur10", 200, 1, seed=2).data
    fit = mc.calibrate("ur10", exchanged(data, 66, 133), "sum")  # raised DataError
    assert "rows hold each other's points" in fit.reason or fit.status == "failed"


# ---- computed points -----------------------------------------------------------------------------


def test_points_of_the_controller_were_computed(robot, noisy):
    sound = mc.calibrate(robot, noisy.data, "sum")
    q = noisy.data.q
    for cell, arm in ((sound.nominal, "the drawn arm"), (sound.cell, "the calibrated arm")):
        y = np.round(cell.predict(q), 6)  # the controller shows a thousandth of a millimetre
        fit = mc.calibrate(robot, (q, y), "sum")
        assert fit.status == "failed"
        assert "these points were computed, not measured" in fit.reason
        assert arm in fit.reason
        again = mc.calibrate(robot, (q, y), "sum", simulated=True)
        assert again.status in ("converged", "no_better")


def test_the_limit_is_a_twentieth_of_what_is_declared(robot):
    """Points as exact as 2 um are measured where nothing else is declared."""
    truth = replace(EXACT, noise=2e-6)
    data = as_measured(simulate(robot, 60, 3, seed=6, truth=truth).data)
    robot = replace(robot, repeatability=np.nan)
    assert mc.calibrate(robot, data, "sum").status == "converged"
    fit = mc.calibrate(robot, data, "sum", instrument="100um")
    assert fit.status == "failed"
    noise, _ = smallest_possible_noise(fit.data, np.nan)
    assert_allclose(noise, np.sqrt(3.0) * 100e-6 / 1.959964, rtol=1e-6)
    assert np.sqrt(3.0) * 2e-6 < noise / MAX_NOISE_TO_ERROR_RATIO
    assert mc.calibrate(robot, data, "sum", instrument="10um").status == "converged"


def test_a_simulated_file_says_so_in_a_column(tmp_path, clean):
    path, plain, older = (tmp_path / name for name in ("d.csv", "plain.csv", "older.csv"))
    mc.write_measurements(path, clean.data)
    header, *rows = path.read_text().splitlines()
    assert header.endswith(",simulated")
    assert all(row.endswith(",1") for row in rows)
    data = mc.read_measurements(path)
    assert data.simulated
    assert "simulated" not in data.columns
    assert not data.notices
    assert mc.calibrate("irb2600", data, "sum").status == "converged"
    assert mc.import_files([path]).data.simulated
    mc.write_measurements(plain, replace(clean.data, simulated=False))
    assert not mc.read_measurements(plain).simulated
    assert run("calibrate irb2600", plain, "--objective", "sum") == 1
    assert run("calibrate irb2600", plain, "--objective", "sum", "--simulated") == 0
    older.write_text(f"# simulated\n{plain.read_text()}")
    assert mc.read_measurements(older).simulated
    made = tmp_path / "made.csv"
    assert run("simulate ur10 --poses 9 -o", made) == 0
    assert mc.read_measurements(made).simulated
    with made.open() as file:
        assert len({len(row) for row in csv.reader(file)}) == 1  # no line above the header


# ---- no better than the drawn arm ----------------------------------------------------------------


def test_an_arm_that_is_no_better_keeps_the_drawn_one(robot, tmp_path):
    data, out = tmp_path / "d.csv", tmp_path / "fit.json"
    mc.write_measurements(data, simulate(robot, 40, 2, 3, AS_DRAWN).data)
    assert run("calibrate irb2600", data, "-o", out) == 1
    content = json.loads(out.read_text())
    assert content["status"] == "no_better"
    assert "no better than the drawn one" in content["reason"]
    assert "keep the drawn arm" in content["reason"]
    assert_allclose(mc.load_robot(out).mdh, robot.mdh, atol=1e-12)
    fit = mc.load_fit(out)
    assert fit.robot is fit.nominal.robot
    assert not np.allclose(fit.cell.robot.mdh, robot.mdh, atol=1e-6)
    assert_allclose(fit.cell.error(fit.data), fit.error, atol=1e-9)
    again = json.loads(fit.json())
    assert {key: again[key] for key in ("robot", "reason", "status")} == {
        key: content[key] for key in ("robot", "reason", "status")
    }
    assert fit.headline().startswith("The calibrated arm is no better than the drawn one (")


def test_an_arm_that_the_poses_determine_less_well_than_the_drawing_is_not_determined(
    robot, tmp_path, refuses
):
    data, out = tmp_path / "d.csv", tmp_path / "fit.json"
    mc.write_measurements(data, whole_degrees(simulate(robot, 40, 2, seed=3).data))
    assert run("calibrate irb2600", data, "--objective", "sum", "-o", out) == 1
    fit = mc.load_fit(out)
    assert fit.status == "not_determined"
    assert fit.robot is fit.nominal.robot
    assert fit.headline().startswith("These measurements do not determine")
    refuses("--keep-anyway", "export", out, "--to", "urdf", "-o", tmp_path / "arm.urdf")
    # by what it says itself: some sigma is larger than drawn, and no position is known better
    links = [p for p in fit.parameters if p.identifiable][:20]
    within = {"m": robot.drawn_within[0], "rad": robot.drawn_within[1]}
    vague = [p for p in links if p.sigma > within[p.unit]]
    assert vague
    assert all(abs(p.value - p.nominal) < 3.0 * p.sigma for p in vague)
    # a drawing that is known worse is determined
    rough = replace(robot, drawn_within=(20e-3, 20e-3))
    assert mc.calibrate(rough, mc.read_measurements(data), "sum").status != "not_determined"


def test_before_and_after_are_of_the_same_poses_by_the_same_rule(robot):
    """The drawn arm is placed without each pose, as the calibrated one is fitted without it."""
    data = simulate(robot, 40, 2, seed=3).data
    fit = mc.calibrate(robot, data, "sum")
    drawn = fit.error_drawn_crossed
    assert drawn.shape == fit.error_crossed.shape
    assert_allclose(drawn[fit.held], fit.error_nominal[fit.held], rtol=0, atol=1e-9)
    assert (
        summarise_point_errors(drawn[~fit.held]).rms_mm
        > summarise_point_errors(fit.error_nominal[~fit.held]).rms_mm
    )
    assert_allclose(fit.within.before.rms_mm, summarise_point_errors(drawn).rms_mm, rtol=1e-12)
    assert fit.within.before.counts == fit.within.after.counts
    told_first = fit.accuracy_table().rows[0]
    assert told_first[0] == "cross-validated, nominal"
    assert fit.to_dict()["accuracy"]["cv"]["nominal"]["rms_mm"] == fit.within.before.rms_mm
    # one fold by an own fit of base and targets
    row = int(np.flatnonzero(~fit.held)[0])
    names = np.unique(fit.group)
    part = np.random.default_rng(0).permutation(len(names)) % 10
    fold = part[np.searchsorted(names, fit.group)]
    train = np.flatnonzero(~fit.held)
    rest = data.take(train[fold != fold[0]])
    state = fit_base_and_targets(build_point_model(robot, rest), robot.mdh).state
    own = Cell.from_parameters(robot, state, data.target_names).error(data.take(np.array([row])))
    assert_allclose(
        summarise_point_errors(drawn[[row]]).rms_mm, summarise_point_errors(own).rms_mm, rtol=0.02
    )


def test_the_comparison_is_paired(rng):
    drawn = rng.normal(size=(50, 2, 3))
    group = np.arange(50)
    same = compare_paired_errors(drawn, drawn, group)
    assert same.gain == same.error == 0.0
    assert not same.is_better
    found = compare_paired_errors(drawn, 0.9 * drawn, group)
    square = (1e6 * drawn**2).sum(axis=(1, 2)) * (1.0 - 0.81) / 2.0
    assert_allclose(found.gain, square.mean(), rtol=1e-12)
    assert_allclose(found.error, square.std(ddof=1) / np.sqrt(50), rtol=1e-12)
    twice = np.concatenate([drawn, drawn])  # visits again count once
    again = compare_paired_errors(twice, 0.9 * twice, np.tile(group, 2))
    assert_allclose([again.gain, again.error], [found.gain, found.error], rtol=1e-12)
    assert compare_paired_errors(drawn[:1], drawn[:1], group[:1]).is_better  # nobody can say


def test_a_held_out_outlier_does_not_hide_a_better_arm(robot):
    data = simulate(robot, 120, 2, seed=4).data
    sound = mc.calibrate(robot, data, "sum")
    row = int(np.flatnonzero(sound.held)[3])
    for side in (1.0, -1.0):  # with the one sign all of the error is less, with the other more
        y = data.y.copy()
        y[row, 0] += side * np.array([0.5, 0.3, 0.4])
        fit = mc.calibrate(robot, data.with_y(y), "sum")
        assert fit.status == "converged"
        told_of = [text for text in fit.notices if f"line {data.line[row]} " in text]
        assert told_of  # never in silence
    # the same outlier pulls at the fit: named, and the arm is judged by what it does
    row = int(np.flatnonzero(~sound.held)[3])
    y = data.y.copy()
    y[row, 0] += np.array([0.5, 0.3, 0.4])
    fit = mc.calibrate(robot, data.with_y(y), "sum")
    assert fit.status in ("not_determined", "no_better", "failed")
    assert f"line {data.line[row]} smr1" in fit.reason or fit.status == "failed"


def test_a_point_that_only_the_calibrated_arm_misses_counts(robot):
    """Of an arm that extrapolates badly the bad pose is no outlier."""
    fit = mc.calibrate(robot, simulate(robot, 120, 2, seed=4).data, "sum")
    row = int(np.flatnonzero(fit.held)[0])
    drawn, after = fit.error_nominal.copy(), fit.error.copy()
    after[row, 0] += 0.1
    one = mc.calibrate(robot, fit.data, "sum").suspects
    off = Outlier(int(fit.data.line[row]), "smr1", 0.1, 99.0, 0.0, False, True)
    hidden = np.where(fit.held[:, None, None], 1.0, np.nan)
    found = compare_with_nominal(
        drawn * hidden, after * hidden, np.arange(120), fit.data, (*one, off)
    )
    assert not found.is_better
    assert not found.wrong


# ---- what is made of it --------------------------------------------------------------------------


def test_what_is_no_better_is_never_passed_nor_valid_nor_exported_unasked(
    robot, tmp_path, capsys, refuses, says
):
    data, out, arm = (tmp_path / name for name in ("d.csv", "fit.json", "arm.urdf"))
    made = simulate(robot, 40, 2, 3, AS_DRAWN)
    mc.write_measurements(data, made.data)
    assert (
        "error: no_better: The calibrated arm is no better"
        in says("calibrate irb2600", data, "--objective", "sum", "-o", out, code=1).err
    )
    for limit in ("rms 1000", "rms 1000, max 5000"):
        assert run("report", out, "--tolerance", limit, "-o", tmp_path / "r.html") in (0, 1)
        said = capsys.readouterr().out
        assert "not passed" in said
        assert "no better than the drawn one" in said
    assert "not valid" in says("check", out, data, "--tolerance", "rms 1000", code=1).out
    refuses("--keep-anyway", "export", out, "--to", "urdf", "-o", arm)
    assert not arm.exists()
    assert run("export", out, "--to", "urdf", "-o", arm, "--keep-anyway") == 0
    targets = tmp_path / "t.csv"
    mc.write_measurements(targets, made.data.take(np.arange(3)))
    refuses("--keep-anyway", "compensate", out, targets, "-o", tmp_path / "c.csv")
    fit = mc.load_fit(out)
    with pytest.raises(mc.OptionError, match="keep_anyway"):
        mc.export(fit, "json")
    kept = json.loads(mc.export(fit, "json", keep_anyway=True))
    assert_allclose(robot_from_dict(kept).mdh, fit.cell.robot.mdh, atol=1e-12)


def test_computed_points_keep_no_calibration_valid(robot, noisy):
    fit = mc.calibrate(robot, noisy.data, "sum")
    q = simulate(robot, 15, 1, seed=9).data.q
    y = np.round(fit.cell.predict(q), 6)
    found = mc.check(fit, (data := mc.measurements(q, y)), "rms 0.5")
    assert found.valid is False
    assert "computed, not measured" in found.headline()
    assert mc.check(fit, data, "rms 0.5", simulated=True).valid


# ---- sound arms ----------------------------------------------------------------------------------


def sound_arm(seed: int) -> tuple[str, float, str]:
    """How a sound arm ends, by how much its error is truly less than that of the drawn one, and
    its case: of varied size, noise, poses and targets, half of them with a lack of fit.
    """  # fmt: skip
    rng = np.random.default_rng(seed)
    name = str(rng.choice(["irb2600", "irb120", "ur10", "ur5e"]))
    poses = round(np.exp(rng.uniform(np.log(20), np.log(150))))
    targets = int(rng.integers(1, 4))
    size, noise = (np.exp(rng.uniform(*np.log(ends))) for ends in ((0.1, 3.0), (5e-6, 1e-4)))
    compliance = 0.0 if rng.random() < 0.5 else np.exp(rng.uniform(*np.log([1e-7, 3e-6])))
    truth = Truth(length=5e-4 * size, angle=1e-3 * size, compliance=compliance, noise=noise)
    made = simulate(name, poses, targets, seed, truth)
    fit = mc.calibrate(name, as_measured(made.data), ("minimax", "sum")[seed % 2])
    robot = mc.load_robot(name)
    q = random_joint_values_above_floor(robot, 300, np.random.default_rng(seed + 10**6), np.pi)
    y = made.cell.predict(q + compliance * gravity(made.cell.robot, q))
    before, after = (np.linalg.norm(cell.predict(q) - y) for cell in (fit.nominal, fit.cell))
    case = f"{seed}: {name}, {poses} poses, {targets} targets, size {size:.2g}"
    return str(fit.status), float(1.0 - after / before), case


@pytest.mark.filterwarnings("ignore::minimax_cal.CalibrationWarning")
@pytest.mark.parametrize("count", [pytest.param(12), pytest.param(500, marks=pytest.mark.slow)])
def test_sound_arms_are_calibrated(count):
    """None has failed.  Those that are no better by what was seen are truly better in 2 of 500:
    of 21 and 34 poses, where what no geometry explains is most of the error.
    """  # fmt: skip
    found = [sound_arm(seed) for seed in range(1, count + 1)]
    assert not [one for one in found if one[0] not in ("converged", "no_better")]
    wrongly = [one for one in found if one[0] == "no_better" and one[1] > 0.05]
    assert len(wrongly) <= 0.01 * count, wrongly


# ---- same arm ------------------------------------------------------------------------------------


def turned(data: mc.Measurements, joint: int, angle: float) -> mc.Measurements:
    """The same points, read at a joint whose zero has moved since [rad]."""
    q = data.q.copy()
    q[:, joint] += angle
    return replace(data, q=q)


def test_another_arm_or_unit_is_refused_before_anything_is_judged(fit, noisy, tmp_path):
    few = noisy.data.take(np.arange(12))
    check_same_arm(fit.robot, few)
    with pytest.raises(mc.DataError, match="millimetres given as metres"):
        mc.check(fit, few.with_y(1e3 * few.y), "rms 0.5")
    with pytest.raises(mc.DataError, match=r"misses ABB IRB 2600.* by \d+ mm wherever base"):
        mc.check(fit, mc.simulate("ur10", 12, 3, seed=5).data, "rms 0.5")
    data, saved, out = tmp_path / "d.csv", tmp_path / "fit.json", tmp_path / "refit.json"
    mc.write_measurements(data, few.with_y(1e3 * few.y))
    fit.save(saved)
    assert run("check", saved, data, "--tolerance", "rms 0.5", "-o", out) == 2
    assert not out.exists()


@pytest.mark.parametrize("angle", [5e-3, 0.1, 0.5])
def test_a_zero_may_have_moved_far(fit, noisy, angle):
    few = turned(noisy.data.take(np.arange(20)), 1, angle)
    check_same_arm(fit.robot, few)
    if angle < 0.05:
        found = mc.check(fit, few, "rms 0.5")
        assert {moved.joint for moved in found.moved} == {"J2"}


def test_too_few_poses_say_nothing_of_the_arm(fit):
    check_same_arm(fit.robot, mc.simulate("ur10", 2, 3, seed=5).data)


def test_calibrations_of_two_arms_are_not_compared(fit, robot):
    other = mc.calibrate("ur10", mc.simulate("ur10", 40, 3, seed=5).data, "sum")
    with pytest.raises(mc.OptionError, match="drawn as different arms"):
        mc.compare(fit, other)
    assert not any("implausibly" in text for text in mc.compare(fit, fit).notices)


def test_a_change_that_no_arm_makes_is_told(fit, robot, noisy):
    longer, later = np.array([0.2, 0, 0, 0, 0]), np.array([0, 0, 0.3, 0, 0])
    far = replace(fit, cell=replace(fit.cell, robot=robot.with_mdh(robot.mdh + longer)))
    (said,) = (text for text in mc.compare(fit, far).notices if "implausibly" in text)
    assert "a1 by +200" in said
    served = robot.with_mdh(fit.robot.mdh + later)  # zeros set anew
    anew = replace(fit, cell=replace(fit.cell, robot=served))
    assert not any("implausibly" in text for text in mc.compare(fit, anew).notices)
