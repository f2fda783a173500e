"""A calibration watched: what moved is found, what cannot be told is said, no more is named."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run, shared
from numpy.testing import assert_allclose
from problems_watch import SHIFT, checked, seen_anew, shifted

import minimax_cal as mc
from experiments import one_session
from experiments.one_session import SessionJob
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.effects import EFFECTS
from minimax_cal.modelling.simulate import Simulation, Truth, gravity, simulate
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.robot import robot_from_dict
from minimax_cal.validation.monitoring import calibration_check, change_search
from minimax_cal.validation.monitoring.check_result import LimitVerdict
from minimax_cal.validation.monitoring.session_pair import (
    NEW,
    OLD,
    RowProducts,
    SessionPair,
    fit_variances_by_reml,
)
from minimax_cal.validation.tolerance import ToleranceLimit

# ---- watching ------------------------------------------------------------------------------------


TRUTH = Truth(compliance=0.0)
SIGMAS = 4.0  # that an estimate may be off: one of 16 000 is


@pytest.fixture(scope="module")
def made(robot: mc.Robot) -> Simulation:
    return simulate(robot, 50, 3, 3, TRUTH)


@pytest.fixture(scope="module")
def fit(made: Simulation) -> mc.Fit:
    return mc.calibrate("irb2600", made.data, "sum")


def poses(made: Simulation, count: int, joint: int = 0, by: float = 0.0, seed: int = 1):
    """Poses of the arm with the zero of a joint, counted from 1, shifted; the tracker anew."""
    rng = np.random.default_rng(seed)
    q = random_joint_values_above_floor(made.cell.robot, count, rng)
    return seen_anew(shifted(made.cell, joint - 1, by), q, TRUTH, rng)


@pytest.fixture(scope="module")
def knocked(fit: mc.Fit, made: Simulation):
    return mc.check(fit, poses(made, 10, 3, SHIFT), "rms 0.5")


# ---- check ------------------------------------------------------------------------------------


@pytest.mark.parametrize("arm", ["irb120", "ur10"])
def test_a_shifted_joint_is_found_and_nothing_else(arm):
    for seed in (0, 1):
        found = checked(arm, seed)
        assert found.named == (found.joint,)
        assert found.alarms == ()
        assert "theta1" in found.hidden
        assert found.hidden[-1] == "theta6"


@pytest.mark.slow
def test_rates_are_those_promised():
    results = [checked(arm, seed) for arm in ("irb2600", "ur10") for seed in range(150)]
    assert np.mean([r.joint in r.named for r in results]) >= 0.95
    assert np.mean([bool(r.alarms) for r in results]) < 0.01


@pytest.mark.parametrize(("seen", "poses"), [(1.2, 12), (0.85, 10)])
def test_as_many_poses_as_named_decide_every_second_session(seen, poses):
    """Within a factor of 1.5, by sessions drawn from the law of the first."""
    rng = np.random.default_rng(3)
    rms = np.sqrt(3.0 * (1.0 + 0.3**2))  # mm, of pose and reflector

    def session(count: int) -> tuple[np.ndarray, mc.Measurements]:
        error = 1e-3 * (rng.normal(size=(count, 1, 3)) + 0.3 * rng.normal(size=(count, 3, 3)))
        return error, mc.measurements(rng.uniform(-2.0, 2.0, (count, 6)), error)

    def judged(error: np.ndarray, data: mc.Measurements) -> LimitVerdict:
        return calibration_check.judge_limit_by_errors(
            ToleranceLimit("rms", seen * rms), error, data, 0.0, 0
        )

    named = []
    while len(named) < 25:
        error, data = session(poses)
        error *= 1e-3 * rms / np.sqrt((error**2).sum(axis=-1).mean())
        if (found := judged(error, data)).valid is None:
            said = re.search(r": (?:about|more than) (\d+) poses like these decide$", found.why)
            named.append(int(said[1]))
    few, many = (
        np.mean([judged(*session(round(count))).valid is not None for _ in range(80)])
        for count in np.median(named) * np.array([1.0 / 1.5, 1.5])
    )
    assert few < 0.5 < many


def test_the_size_of_the_shift_is_told(knocked):
    (moved,) = knocked.moved
    assert moved.parameter == "theta3"
    assert abs(moved.by - SHIFT) < SIGMAS * moved.sigma
    assert moved.sigma < 0.1 * SHIFT
    assert knocked.valid is True
    assert knocked.confidence > 0.975
    assert {h.parameter: h.like for h in knocked.hidden} == {
        "theta1": "the measurement frame",
        "theta6": "the tool",
    }


def test_the_refit_is_a_calibration_that_holds(knocked, fit, made, tmp_path):
    knocked.save(tmp_path / "refit.json")
    again = mc.load_fit(tmp_path / "refit.json")
    change = again.robot.mdh - fit.robot.mdh
    assert change[2, 2] == pytest.approx(knocked.moved[0].by, abs=1e-15)
    change[2, 2] = 0.0
    assert np.abs(change).max() < 1e-14  # the rest is as it was
    other = mc.check(again, poses(made, 10, 3, SHIFT, seed=9), "rms 0.1")
    assert other.moved == ()
    assert other.valid
    back = mc.check(again, poses(made, 10, seed=9), "rms 0.1")
    assert [m.joint for m in back.moved] == ["J3"]


def test_not_valid_and_not_decided(fit, made):
    far = mc.check(fit, poses(made, 10, 4, 0.02), "rms 0.2, max 1")
    assert far.valid is False
    assert [m.joint for m in far.moved] == ["J4"]
    close = mc.check(fit, poses(made, 10), f"rms {1.01 * far.refitted.rms_mm}, max 5")
    assert close.valid is None
    assert [v.valid for v in close.verdicts] == [None, None]  # ten poses tell no maximum
    assert close.confidence < 0.975


def test_a_known_frame_tells_joint_one(fit, made):
    rng = np.random.default_rng(4)
    q = random_joint_values_above_floor(made.cell.robot, 10, rng)
    cell = shifted(made.cell, 0, SHIFT)
    y = cell.predict(q) + 15e-6 * rng.normal(size=(10, 3, 3))
    found = mc.check(fit, mc.measurements(q, y), "rms 0.5", known="frame,targets")
    assert [m.parameter for m in found.moved] == ["theta1"]
    assert found.hidden == ()
    assert mc.check(fit, mc.measurements(q, y), "rms 0.5").moved == ()
    alone = mc.check(fit, mc.measurements(q, y), "rms 0.5", known="frame")
    assert [m.parameter for m in alone.moved] == ["theta1"]
    assert [h.parameter for h in alone.hidden] == ["theta6"]


def test_what_moved_has_the_sign_of_the_file():
    """A first row of modified DH that turns by 180 degrees turns the sense of joint 1 around."""
    rows = [(0, -675, 0, 180), (350, 0, 0, 90), (1150, 0, -90, 0), (41, -1200, 0, 90),
            (0, 0, 0, -90), (0, -215, 180, 90)]  # fmt: skip
    keys = ("a", "d", "theta", "alpha")
    content = {
        "name": "turned", "convention": "modified", "units": {"length": "mm", "angle": "deg"},
        "joints": [dict(zip(keys, row, strict=True), lower=-120, upper=120) for row in rows],
    }  # fmt: skip
    made = simulate(robot_from_dict(content, "turned"), 50, 3, 3, TRUTH)
    fit = mc.calibrate(made.cell.robot, made.data, "sum")
    rng = np.random.default_rng(4)
    q = random_joint_values_above_floor(made.cell.robot, 10, rng)
    moved = q + SHIFT * np.eye(6)[0]  # the file's joint 1 has sign +1: its theta1 grows
    y = made.cell.predict(moved) + 15e-6 * rng.normal(size=(10, 3, 3))
    (found,) = mc.check(fit, mc.measurements(q, y), "rms 0.5", known="frame,targets").moved
    assert found.parameter == "theta1"
    assert abs(found.by - SHIFT) < SIGMAS * found.sigma < 0.5 * SHIFT


FOOT = np.array([[0.3, 0.3, 0.0], [-0.3, 0.3, 0.0], [0.0, -0.4, 0.1]])


def with_foot(
    data: mc.Measurements, base: np.ndarray, rng: np.random.Generator, noise: float = 15e-6
) -> mc.Measurements:
    """The same with reflectors on the foot of an arm whose base stands there."""
    spots = FOOT @ base[:3, :3].T + base[:3, 3] + noise * rng.normal(size=(data.poses, 3, 3))
    more = {f"base{i + 1}_{axis}": spots[:, i, j] for i in range(3) for j, axis in enumerate("xyz")}
    return replace(data, columns={**data.columns, **more})


def test_reflectors_on_the_foot_tell_joint_one(made):
    rng = np.random.default_rng(8)
    fit = mc.calibrate("irb2600", with_foot(made.data, made.cell.base, rng), "sum")
    q = random_joint_values_above_floor(made.cell.robot, 10, rng)
    base = made.cell.base.copy()
    base[:3, 3] += 0.2
    cell = replace(shifted(made.cell, 0, SHIFT), base=base)
    y = cell.predict(q) + 15e-6 * rng.normal(size=(10, 3, 3))
    found = mc.check(fit, with_foot(mc.measurements(q, y), base, rng), "rms 0.5")
    assert [m.parameter for m in found.moved] == ["theta1"]
    assert [h.parameter for h in found.hidden] == ["theta6"]
    assert abs(found.moved[0].by - SHIFT) < SIGMAS * found.moved[0].sigma


def test_a_foot_that_tells_less_than_the_instrument_names_nothing(made):
    """The foot gives way at each pose: the calibration's own poses say how much."""
    rng = np.random.default_rng(11)
    base = made.cell.base
    fit = mc.calibrate("irb2600", with_foot(made.data, base, rng, 3e-4), "sum")
    named = []
    for _ in range(4):
        q = random_joint_values_above_floor(made.cell.robot, 10, rng)
        y = made.cell.predict(q) + 15e-6 * rng.normal(size=(10, 3, 3))
        data = with_foot(mc.measurements(q, y), base, rng, 3e-4)
        named += [m.parameter for m in mc.check(fit, data, "rms 0.5").moved]
    assert named == []


# ---- an arm that gives way, which its model does not know ---------------------------------------


@pytest.fixture(scope="module")
def giving_way():
    """An IRB 120 that misses by 0.4 mm, reflectors on its foot: its fit, ten poses, and many."""
    truth, rng = Truth(compliance=1e-5), np.random.default_rng(0)
    made = simulate("irb120", 80, 3, 3, truth)
    base = made.cell.base
    fit = mc.calibrate("irb120", with_foot(made.data, base, rng), "sum")

    def seen(count: int, joint: int = 0, by: float = 0.0) -> mc.Measurements:
        q = random_joint_values_above_floor(made.cell.robot, count, rng, truth.span)
        bent = q + truth.compliance * gravity(made.cell.robot, q)
        y = shifted(made.cell, joint, by).predict(bent) + 15e-6 * rng.normal(size=(count, 3, 3))
        return with_foot(mc.measurements(q, y), base, rng)

    return fit, seen


def rms(fit: mc.Fit, data: mc.Measurements) -> float:
    return float(np.sqrt(np.square(fit.cell.error(data)).sum(axis=-1).mean()))


def test_a_refit_of_an_arm_that_did_not_move_is_as_good_as_its_fit(giving_way):
    fit, seen = giving_way
    many = seen(150)
    before, own, after = [], [], []
    for _ in range(4):
        ten = seen(10)
        found = mc.check(fit, ten, "rms 1")
        assert found.moved == ()
        before.append(rms(fit, ten))
        own.append(rms(found.fit, ten))
        after.append(rms(found.fit, many))
    assert np.all(np.array(own) < np.array(before))
    assert np.mean(after) < 1.1 * rms(fit, many)


def test_a_correction_helps_the_poses_that_it_is_made_from(giving_way):
    fit, seen = giving_way
    for joint in (2, 4):
        ten = seen(10, joint, 4e-3)
        found = mc.check(fit, ten, "rms 1")
        assert f"J{joint + 1}" in [m.joint for m in found.moved]
        assert found.refitted.rms_mm < found.accuracy.rms_mm
        assert rms(found.fit, ten) < rms(fit, ten)


def test_one_rms_is_told(giving_way):
    fit, seen = giving_way
    found = mc.check(fit, seen(10, 2, 4e-3), "rms 1")
    (verdict,) = found.verdicts
    assert verdict.value_mm == found.accuracy.rms_mm
    assert f"RMS {verdict.value_mm:.3f} mm, at most" in found.headline()
    assert f"RMS {verdict.value_mm:.3f} ->" in found.headline()


# ---- one session ------------------------------------------------------------------------------


CUTS = [("ur10", 8, "2"), ("irb2600", 12, "3"), ("irb120", 28, "time")]


@pytest.mark.parametrize(("arm", "seed", "way"), CUTS)
def test_halves_of_a_session_whose_model_lacks_something_do_not_differ(arm, seed, way):
    found = one_session.run_session(SessionJob(arm, seed, way, commands=("compare", "check")))
    assert found.compared == ()
    assert found.checked == ()


@pytest.mark.parametrize(("arm", "seed", "way"), [("irb2600", 0, "1"), ("irb120", 4, "time")])
def test_a_joint_that_moved_between_halves_is_named_alone(arm, seed, way):
    job = SessionJob(
        arm, seed, way, one_session.LACK_OF_FIT_AS_DRAWN, commands=("compare", "check")
    )
    found = one_session.run_session(job)
    assert found.joint
    assert found.compared == (found.joint,)
    assert found.checked == (found.joint,)


@pytest.mark.parametrize(("name", "way"), [("qkm_hl6", "q5"), ("ur10_b", "q3")])
def test_halves_of_a_real_session_do_not_differ(name, way):
    robot, path = shared(name)
    data = mc.read_measurements(path)
    data = data.take(np.linspace(0, data.poses - 1, min(data.poses, 300)).astype(int))
    first = one_session.find_first_half(data, way[1:])
    a, b = (mc.calibrate(robot, data.take(half), "sum") for half in (first, ~first))
    assert mc.compare(a, b).changed == ()
    assert mc.check(a, data.take(~first), "rms 1").moved == ()


def test_ten_poses_of_a_session_name_nothing_in_it():
    """A real arm with reflectors on its foot: what its model lacks is no movement."""
    robot, path = shared("irb120")
    data = mc.read_measurements(path)
    order = np.random.default_rng(0).permutation(data.poses)
    fit = mc.calibrate(robot, data.take(np.sort(order[:400])), "sum")
    for start in range(400, 440, 10):
        ten = data.take(np.sort(order[start : start + 10]))
        assert mc.check(fit, ten, "rms 0.3").moved == ()
        q = ten.q.copy()
        q[:, 2] -= 2e-3 * fit.robot.sign[2]
        knocked = mc.check(fit, replace(ten, q=q), "rms 0.3")
        assert [m.joint for m in knocked.moved] == ["J3"]
        assert knocked.refitted.rms_mm < knocked.accuracy.rms_mm


def test_few_poses_suffice(fit, made):
    data = poses(made, 12)
    found = mc.check(fit, data, "rms 0.2")
    assert found.enough is not None
    assert found.enough < 12
    assert max(found.findable.values()) <= SHIFT
    few = mc.check(fit, data.take(np.arange(3)), "rms 0.2")
    assert few.asked is not None
    assert few.asked > 3 or few.enough == 3


def test_the_command_says_what_the_function_says(fit, made, tmp_path, answered, says):
    fit.save(tmp_path / "fit.json")
    mc.write_measurements(tmp_path / "new.csv", poses(made, 10, 3, SHIFT))
    words = ["check", tmp_path / "fit.json", tmp_path / "new.csv", "--tolerance"]
    told = answered(*words, "rms 0.5", "-o", tmp_path / "refit.json")
    assert told["valid"] is True
    assert [m["parameter"] for m in told["moved"]] == ["theta3"]
    assert told["moved"][0]["unit"] == "rad"
    kept = json.loads((tmp_path / "refit.json").read_text())
    assert kept["check"]["moved"] == kept["moved"] == told["moved"]
    out, err = says(*words, "rms 0.05", code=1)
    assert "not valid" in out
    (line,) = [line for line in err.splitlines() if line.startswith("error: ")]
    assert "not valid" in line
    assert run("evaluate", tmp_path / "refit.json", tmp_path / "new.csv") == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--tolerance", "0.2"], "write it in mm"),
        (["--tolerance", ""], "write it in mm"),
        (["--tolerance", "rms 0.2", "--known", "foot"], "none of frame, targets"),
        ([], "Missing option"),
    ],
)
def test_a_wrong_option_is_one_line(fit, made, tmp_path, says, options, said):
    fit.save(tmp_path / "fit.json")
    mc.write_measurements(tmp_path / "new.csv", poses(made, 10))
    err = says("check", tmp_path / "fit.json", tmp_path / "new.csv", *options, code=2).err
    assert said in err
    assert len(err.splitlines()) == 1


def test_data_that_say_nothing_are_one_line(fit, made):
    data = poses(made, 2)
    with pytest.raises(mc.DataError, match="measure more"):
        mc.check(fit, data.take(np.arange(1)), "rms 0.2")
    two = replace(data, columns={"session": np.array(["a", "b"])})
    with pytest.raises(mc.DataError, match="several sessions"):
        mc.check(fit, two, "rms 0.2")
    odd = replace(data, target_names=("smr1", "smr2", "smr9"))
    with pytest.raises(mc.DataError, match="smr9"):
        mc.check(fit, odd, "rms 0.2", known="targets")


# ---- compare ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def repaired(made: Simulation) -> mc.Fit:
    return mc.calibrate("irb2600", poses(made, 40, 4, 3e-4, seed=21), "sum")


def test_a_repair_is_named(fit, repaired):
    found = mc.compare(fit, repaired)
    (changed,) = found.changed
    assert changed.parameter == "theta4"
    assert abs(changed.by - 3e-4) < SIGMAS * changed.sigma
    assert found.same < 1e-6
    told = {d.parameter: d for d in found.differences}
    assert told["theta1"].reason
    assert told["d1"].reason
    others = [d.sigmas for d in found.differences if not d.reason and d.parameter != "theta4"]
    assert np.sqrt(np.mean(np.square(others))) < 2.0
    (_, a_on_a, b_on_a), (_, a_on_b, b_on_b) = found.accuracy
    assert a_on_a.rms_mm < b_on_a.rms_mm
    assert b_on_b.rms_mm < a_on_b.rms_mm


def test_which_parameters_were_kept_does_not_matter(made, fit):
    """d1 in place of the base's z: nothing moved, and nothing is told to have."""
    data = poses(made, 40, seed=33)
    usual, odd = (mc.calibrate("irb2600", data, "sum", free=free) for free in ("", "d6,theta6"))
    assert np.abs(usual.robot.mdh - odd.robot.mdh).max() > 1e-5
    one, other = mc.compare(fit, usual), mc.compare(fit, odd)
    assert one.changed == other.changed == ()
    for a, b in zip(one.differences, other.differences, strict=True):
        assert_allclose(a.b, b.b, rtol=0, atol=5e-7)  # to first order
    assert mc.compare(usual, odd).notices


def test_compare_command(fit, repaired, tmp_path, answered, says):
    fit.save(tmp_path / "a.json")
    repaired.save(tmp_path / "b.json")
    told = answered("compare", tmp_path / "a.json", tmp_path / "b.json")
    assert [c["joint"] for c in told["changed"]] == ["J4"]
    assert "J4 changed" in says("compare", tmp_path / "a.json", tmp_path / "b.json").out
    (tmp_path / "c.json").write_text("{}")
    for name in ("c.json", "none.json"):
        assert (
            len(says("compare", tmp_path / "a.json", tmp_path / name, code=2).err.splitlines()) == 1
        )
    ur10 = mc.calibrate("scara_600", mc.simulate("scara_600", 30).data, "sum")
    with pytest.raises(mc.OptionError, match="compare calibrations of one arm"):
        mc.compare(fit, ur10)


def test_the_pick_explains_most_and_zero_positions_go_first():
    every, none = np.ones(3, dtype=bool), np.zeros(3, dtype=bool)
    first = np.array([True, False, False])
    square = np.array([30.0, 38.0, 20.0])
    assert (
        change_search.select_change(square, every, first)[0] == 0
    )  # a link that is not clearly better
    clearer = np.array([30.0, 38.0 + change_search.MIN_LINK_LEAD, 20.0])
    assert change_search.select_change(clearer, every, first)[0] == 1
    assert (
        change_search.select_change(square, ~first, first)[0] == 1
    )  # the zero position may be chance
    assert (
        change_search.select_change(square, every, none)[0] == 1
    )  # no zero position at all: the largest
    rivals = change_search.select_change(
        np.array([30.0, 30.0 - 0.9 * change_search.MAX_ALTERNATIVE_LOSS, -np.inf]), every, none
    )
    assert rivals == (0, [1])


def test_laws_of_the_session_end_with_it():
    ended = {name for name, effect in EFFECTS.items() if effect.ends_with_session}
    assert ended == {"frame_drift", "session_jump", "target_shift", "target_reseat"}


# ---- counting all --------------------------------------------------------------------------------


PLAIN_TRUTH = Truth(noise=20e-6, noise_per_metre=0.0, compliance=0.0)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Simulation]:
    """A calibration, and the arm that it is of."""
    folder = tmp_path_factory.mktemp("arm")
    sim = simulate("irb120", 150, 3, seed=4, truth=PLAIN_TRUTH)
    mc.calibrate("irb120", sim.data, "sum").save(folder / "fit.json")
    return folder, sim


def later(sim: Simulation, poses: int = 30) -> Measurements:
    """New measurements of the same arm in its place, with one pose 1 mm off."""
    data = simulate("irb120", poses, 3, seed=77, truth=PLAIN_TRUTH).data
    y = sim.cell.predict(data.q) + PLAIN_TRUTH.noise * np.random.default_rng(5).normal(
        size=data.y.shape
    )
    y[6] += [0.6e-3, 0.0, 0.8e-3]
    return replace(data.with_y(y), simulated=False, line=np.arange(poses) + 2)


def test_evaluate_counts_with_them(arm, capsys, answered):
    folder, sim = arm
    data = later(sim)
    mc.write_measurements(folder / "new.csv", data)
    left = f"--leave-out={data.line[6]}=looks odd"
    assert run("import", folder / "new.csv", left, "-o", folder / "some.csv", "--quiet") == 0
    capsys.readouterr()
    whole, some = (
        answered("evaluate", folder / "fit.json", folder / f"{name}.csv")
        for name in ("new", "some")
    )
    assert whole["set_aside"] == []
    assert "holdout_with_them" not in whole["accuracy"]
    assert [(p["target"], p["why"], p["by"]) for p in some["set_aside"]] == [
        (name, "looks odd", "user") for name in data.target_names
    ]
    assert {(p["row"], p["pose"]) for p in some["set_aside"]} == {(8, 7)}
    assert some["accuracy"]["max_mm"] < 0.3
    for key in ("rms_mm", "max_mm", "mean_mm", "poses"):
        assert_allclose(some["accuracy"]["holdout_with_them"][key], whole["accuracy"][key],
                        rtol=1e-9)  # fmt: skip


def test_check_counts_with_them(arm):
    folder, sim = arm
    data = later(sim)
    cells = np.where(np.arange(data.poses) == 6, "looks odd", "")
    path = folder / "checked.csv"
    mc.write_measurements(path, replace(data, columns={**data.columns, "set_aside": cells}))
    found = mc.check(folder / "fit.json", path, "rms 0.2")
    assert found.valid
    content = found.to_dict()
    assert {(p["row"], p["by"]) for p in content["set_aside"]} == {(8, "user")}
    assert content["accuracy"]["max_mm"] < 0.3
    assert_allclose(content["accuracy"]["holdout_with_them"]["max_mm"], 1.0, rtol=0.15)
    assert "3 points set aside by the user; with them RMS" in found.headline()
    assert found.fit.set_aside == found.set_aside
    assert "holdout_with_them" not in found.fit.to_dict()["accuracy"]  # none is held out


def test_a_reseat_is_told_by_check_and_import(arm, says):
    folder, sim = arm
    data = later(sim, 40)
    spots = sim.cell.target_positions + np.array([[0, 0, 0], [3e-3, 4e-3, 0], [0, 0, 0]])
    y = data.y.copy()
    y[20:, 1] = replace(sim.cell, target_positions=spots).predict(data.q[20:])[:, 1]
    path = folder / "reseated.csv"
    mc.write_measurements(path, replace(data.with_y(y), columns={}))
    said = "smr2 was re-seated, or exchanged for one of another radius, by 4.99 mm or more"
    assert f"{said} before line 22" in says("import", path).err
    found = mc.check(folder / "fit.json", path, "rms 0.2")
    assert any(said in notice for notice in found.notices)


# ---- both ----------------------------------------------------------------------------------------


FREE, RANDOM, ASKED = 6, 40, 3
ROWS, PARTS = 60, 8
NOISE, FACTOR = 0.5, 4.0


def drawn(rng: np.random.Generator, noise: float = NOISE) -> tuple[SessionPair, list[np.ndarray]]:
    """Both sessions with lack of fit of a known size, and the rows that they are made of."""
    u, x = np.sqrt(FACTOR) * rng.normal(size=RANDOM), rng.normal(size=FREE)
    parts, rows = [], []
    for number in range(PARTS):
        new = number >= PARTS // 2
        columns = rng.normal(size=(ROWS, FREE + RANDOM + ASKED))
        columns[:, -ASKED:] *= new
        sigma = np.sqrt(noise if new else NOISE)
        error = columns[:, : FREE + RANDOM] @ np.append(x, u) + sigma * rng.normal(size=ROWS)
        rows.append(np.column_stack([columns, error]))
        parts.append(RowProducts(rows[-1].T @ rows[-1], ROWS, NEW if new else OLD))
    asked = np.arange(ASKED)
    component = np.zeros(RANDOM, dtype=int)
    return SessionPair(tuple(parts), FREE, RANDOM, component, asked, asked < 1, np.ones(0)), rows


def test_variances_are_those_that_were_drawn():
    rng = np.random.default_rng(0)
    found = [fit_variances_by_reml(drawn(rng)[0]) for _ in range(20)]
    assert np.mean([v.noise[OLD] for v in found]) == pytest.approx(NOISE, rel=0.05)
    assert np.mean([v.factor[0] for v in found]) == pytest.approx(FACTOR, rel=0.2)


def test_new_poses_may_be_noisier():
    rng = np.random.default_rng(1)
    found = [drawn(rng, 9.0 * NOISE)[0].noise_ratio for _ in range(20)]
    assert np.mean(found) == pytest.approx(3.0, rel=0.1)
    quiet = drawn(rng, NOISE / 9.0)[0]
    assert quiet.noise_ratio == 1.0


def test_scores_spread_as_their_sigmas_say():
    rng, none = np.random.default_rng(2), np.zeros(0, dtype=int)
    z = []
    for _ in range(40):
        by, sigma, dof = drawn(rng)[0].candidate_scores(none)
        z.append(by / sigma)
        assert np.all(dof > PARTS - 2)
    assert abs(np.sqrt(np.mean(np.square(z))) - 1.0) < 4.0 / np.sqrt(2 * np.size(z))


def test_a_part_left_out_is_judged_by_a_fit_of_the_others():
    both, rows = drawn(np.random.default_rng(3))
    noise = both.variances.noise
    fitted = both.select_fitted_columns(np.array([1]))
    left = PARTS - 1
    scaled = [part / np.sqrt(noise[p.source]) for part, p in zip(rows, both.parts, strict=True)]
    rest = np.concatenate([part for number, part in enumerate(scaled) if number != left])
    prior = np.diag(np.sqrt(both.prior_precision(fitted)))
    matrix = np.concatenate([rest[:, fitted], prior])
    value = np.linalg.lstsq(matrix, np.append(rest[:, -1], np.zeros(len(prior))))[0]
    error = scaled[left][:, -1] - scaled[left][:, fitted] @ value
    assert_allclose(both.predicted_square(both.parts[left], fitted), error @ error, rtol=1e-6)


def test_folds_scatter_as_the_estimate_does():
    rng, none = np.random.default_rng(4), np.zeros(0, dtype=int)
    found = [drawn(rng)[0] for _ in range(40)]
    ratio = [both.jackknife_sigma(none, 1) / both.candidate_scores(none)[1][1] for both in found]
    assert np.sqrt(np.mean(np.square(ratio))) == pytest.approx(1.0, abs=0.3)
