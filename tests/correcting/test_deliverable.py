"""What leaves the house: files with the geometry fitted for what they carry, and their figures."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from minimax_cal.cli.export import export_command
from minimax_cal.compensation import deliverable
from minimax_cal.compensation.deliverable import DELIVERABLES
from minimax_cal.compensation.robot_export import build_export
from minimax_cal.fitting.accuracy import summarise_point_errors
from minimax_cal.fitting.opened_results import place_nominal_arm
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.effects.table import Fitted
from minimax_cal.modelling.simulate import Truth, gravity, simulate
from minimax_cal.robots.gravity_torques import link_masses_and_centres
from minimax_cal.solvers.status import Status
from tests.conftest import shared
from tests.problems_deliverables import READERS, reached

WORSE = 1.03  # of the plain geometric fit exported alike
TOLD = 0.15  # between what a deliverable says and what its file reaches on new poses
EFFECTS = "joint_compliance:all"
REAL = {  # effects that a diagnosis confirms there, chosen by hand: a full one takes minutes
    "irb120": f"{EFFECTS},joint_coupling:J6,gear_error:J1,gear_error:J2,gear_error:J3",
    "meca500_r": f"{EFFECTS},gear_error:J4,gear_error:J5",
}
Split = tuple[mc.Fit, mc.Fit, Measurements]


def split_of(robot: mc.Robot, data: Measurements, effects: str, seed: int = 0) -> Split:
    """Fits with effects and of geometry alone of 60 % of the poses, cross-validated; the others."""
    data = add_history_columns(data)
    new = np.random.default_rng(seed).permutation(data.poses) < 0.4 * data.poses
    train = data.take(~new)
    joint = mc.calibrate(robot, train, "sum", effects=effects, cv=True)
    return joint, mc.calibrate(robot, train, "sum", cv=True), data.take(new)


@pytest.fixture(scope="module", params=["ur10", "irb2600"])
def simulated(request: pytest.FixtureRequest) -> Split:
    robot = mc.load_robot(request.param)
    made = simulate(robot, 150, 3, seed=3, truth=Truth(compliance=3e-6))
    return split_of(robot, made.data, EFFECTS)


@pytest.fixture(scope="module", params=REAL)
def real(request: pytest.FixtureRequest) -> Split:
    robot, data = shared(request.param)
    return split_of(mc.load_robot(robot), mc.read_measurements(data), REAL[request.param])


def check_files(split: Split, folder: Path) -> None:
    """Each file does what the plain fit's does, and what is said of it."""
    joint, plain, new = split
    alone = summarise_point_errors(place_nominal_arm(joint.cell.robot, new).error(new)).rms_mm
    formats = [to for to in READERS if to != "ur-yaml" or "UR" in joint.cell.robot.name]
    for to in formats:
        own = mc.deliver(joint, to)
        rms = reached(joint, to, new, folder)
        assert rms <= WORSE * reached(plain, to, new, folder)
        assert rms == pytest.approx(own.figures.rms, rel=TOLD)
        assert own.carries == ()
        assert set(own.not_carried) == {term.label for term in joint.cell.effects.terms}
    assert rms < 0.97 * alone  # what the geometry of the joint fit would have done


def test_files_of_simulated_arms(simulated, tmp_path):
    check_files(simulated, tmp_path)


def test_files_of_real_arms(real, tmp_path):
    check_files(real, tmp_path)


# ---- what each format carries ------------------------------------------------------------------


def weighed(name: str) -> mc.Robot:
    """An arm whose masses are known, so that a joint's compliance is one number."""
    robot = mc.load_robot(name)
    mass, com = link_masses_and_centres(robot)
    return replace(robot, mass=mass, com=com)


@pytest.fixture(scope="module")
def soft() -> mc.Fit:
    """An arm with a compliance, play, and what ends with its session."""
    robot = weighed("irb2600")
    data = add_history_columns(simulate(robot, 80, 3, seed=4, truth=Truth(compliance=2e-6)).data)
    effects = f"{EFFECTS},backlash:J3,tool_flex:all,frame_drift:frame,thermal_growth:all"
    return mc.calibrate(robot, data, "sum", effects=effects)


CARRIED = {
    **dict.fromkeys(["urdf", "json", "dh-csv", "ros-yaml", "ros2-control", "ur-yaml"], ()),
    "moc": (EFFECTS,),
    "mjcf": (EFFECTS, "backlash:J3", "tool_flex:all"),
    "compensate": (EFFECTS, "backlash:J3"),
}


@pytest.mark.parametrize("to", DELIVERABLES)
def test_each_says_what_it_carries(to, soft):
    """Drift and growth by the session's clock belong to none."""
    found = mc.deliver(soft, to)
    every = {term.label for term in soft.cell.effects.terms}
    assert found.carries == CARRIED[to]
    assert set(found.not_carried) == every - set(CARRIED[to])
    assert {t.label for t in found.cell.effects.terms} == set(found.carries)
    assert found.to_dict().keys() == {
        "format", "carries", "not_carried", "holdout_rms_mm", "outside_typical_mm",
        "outside_worst_mm", "outside_largest_mm",
    }  # fmt: skip


def test_it_is_the_fit_of_exactly_that(soft):
    """The same poses, split and options: what `calibrate` finds with those effects."""
    for to, options in (
        ("json", {}),
        ("ros2-control", {"only": "offsets"}),
        ("moc", {"effects": EFFECTS}),
    ):
        split = np.where(soft.held, "holdout", "train")
        data = replace(soft.data, columns={**soft.data.columns, "split": split})
        plain = mc.calibrate(soft.nominal.robot, data, "sum", **options)
        found = mc.deliver(soft, to)
        assert_allclose(found.cell.robot.mdh, plain.cell.robot.mdh, rtol=0, atol=1e-8)
        assert found.figures.rms == pytest.approx(plain.within.after.rms_mm, rel=1e-4)
        assert found.figures.typical == pytest.approx(plain.beyond.typical_mm, rel=1e-3)
        assert found.whole.rms == soft.within.after.rms_mm
    with pytest.raises(mc.CalibrationError, match="no such format"):
        mc.deliver(soft, "step")


def test_priors_fixed_names_and_the_objective_stay():
    made = simulate("ur10", 60, 3, seed=6, truth=Truth(compliance=2e-6))
    asked: dict[str, Any] = {"objective": "minimax", "fix": "beta*", "priors": {"a*": "0.1mm"}}
    plain = mc.calibrate("ur10", made.data, **asked)
    joint = mc.calibrate("ur10", made.data, **asked, effects=EFFECTS)
    assert_allclose(joint.robot.mdh, plain.robot.mdh, rtol=0, atol=1e-8)
    assert_array_equal(joint.robot.mdh[:, 4], joint.nominal.robot.mdh[:, 4])
    assert mc.deliver(joint, "urdf").figures.rms == pytest.approx(plain.within.after.rms_mm)


def test_what_carries_all_is_written_as_it_is():
    robot = weighed("irb120")
    data = simulate(robot, 60, 3, seed=2, truth=Truth(compliance=2e-6)).data
    joint = mc.calibrate(robot, data, "sum", effects=EFFECTS)
    plain = mc.calibrate(robot, data, "sum")
    for fit, to in ((joint, "mjcf"), (joint, "compensate"), (joint, "moc"), (plain, "json")):
        found = mc.deliver(fit, to)
        assert found.cell is fit.cell
        assert found.fit is fit
        assert not found.not_carried
        close = 0.01 if to == "mjcf" else 1e-12  # sag of sag: no law of a fit has it
        assert found.figures.rms == pytest.approx(found.whole.rms, rel=close)
        assert found.whole.rms == fit.within.after.rms_mm
    content = json.loads(build_export(plain, "json").file.content)
    assert content == plain.to_dict()["robot"]


def test_a_file_delivers_what_the_fit_does(soft, tmp_path):
    """The digits of geometry alone are those of `robot` in the file of the result."""
    soft.save(tmp_path / "fit.json")
    for to in ("json", "compensate", "ros2-control"):
        one, other = mc.deliver(soft, to), mc.deliver(tmp_path / "fit.json", to)
        assert_allclose(other.cell.robot.mdh, one.cell.robot.mdh, rtol=0, atol=1e-12)
        assert other.figures.rms == pytest.approx(one.figures.rms, rel=1e-9)
        assert other.whole.rms == pytest.approx(one.whole.rms, rel=1e-9)
    written = json.loads(build_export(tmp_path / "fit.json", "json").file.content)
    assert written == json.loads((tmp_path / "fit.json").read_text())["robot"]


def test_a_result_without_measurements_goes_out_as_it_is(soft, tmp_path):
    soft.save(tmp_path / "fit.json", poses=False)
    found = build_export(tmp_path / "fit.json", "urdf")
    assert found.delivered
    assert "fit.json holds no measurements" in found.notices[-1]
    assert_allclose(found.delivered.cell.robot.mdh, soft.robot.mdh, rtol=0, atol=1e-14)
    assert found.to_dict()["delivered"]["holdout_rms_mm"] is None
    arm = mc.deliver(soft.cell, "mjcf")
    assert arm.cell is soft.cell
    assert arm.carries == CARRIED["mjcf"]
    assert "holds no measurements" in arm.sentence()
    assert build_export("irb120", "json").to_dict()["delivered"]["holdout_rms_mm"] is None


def test_a_fit_after_a_check_is_not_made_again(soft):
    """Its few poses tell what moved, and not the links: what moved goes into both geometries."""
    rng = np.random.default_rng(0)
    moved = soft.cell.robot.mdh.copy()
    moved[1, 2] += 2e-3
    arm = replace(soft.cell, robot=soft.cell.robot.with_mdh(moved), effects=Fitted((), ()))
    few = soft.data.take(rng.permutation(soft.data.poses)[:20])
    few = replace(few.with_y(arm.predict(few.q)), digest="")
    after = mc.check(soft, few, "rms 0.2").fit
    change = after.robot.mdh - soft.robot.mdh
    assert_allclose(change, after.cell.robot.mdh - soft.cell.robot.mdh, rtol=0, atol=1e-12)
    assert "by a check" in mc.deliver(after, "json").reason
    assert_array_equal(mc.deliver(after, "json").cell.robot.mdh, after.robot.mdh)


# ---- a diagnosis -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gap() -> mc.Diagnosis:
    made = simulate("irb120", 80, 3, seed=5, truth=Truth(compliance=5e-6))
    return mc.diagnose("irb120", made.data, quick=True, seed=3)


def test_a_diagnosis_delivers_its_confirmed_effects(gap, tmp_path):
    firm = {f.term.label for f in gap.effects if f.established}
    assert firm
    gap.save(tmp_path / "gap.json")
    for source in (gap, tmp_path / "gap.json"):
        alone, whole = mc.deliver(source, "json"), mc.deliver(source, "compensate")
        assert_allclose(alone.cell.robot.mdh, gap.cells[0].robot.mdh, rtol=0, atol=1e-8)
        assert alone.figures.rms == pytest.approx(gap.ladder[1].holdout.rms_mm, rel=1e-3)
        assert set(whole.carries) == firm
        first = mc.deliver(source, "json", rung=1)
        assert not first.not_carried
        assert_allclose(first.cell.robot.mdh, gap.cells[0].robot.mdh, rtol=0, atol=1e-12)
    assert alone.fit
    assert (alone.fit.held == gap.held).all()


# ---- corrected targets -------------------------------------------------------------------------


def test_corrected_targets_say_what_to_expect_on_the_arm(soft):
    """The figures of what joints can correct, fitted for exactly that; never the model's own 0."""
    own, q = mc.deliver(soft, "compensate"), soft.data.q[:3]
    found = mc.compensate(soft, q)
    told = found.to_dict()["delivered"]
    assert (told["carries"], told["format"]) == (list(own.carries), "compensate")
    assert told["holdout_rms_mm"] == pytest.approx(own.figures.rms, rel=1e-9)
    assert f"Expect on the arm: held-out RMS {own.figures.rms:.3f} mm" in found.headline()
    assert "0.000 mm" not in found.headline()
    assert "fitted without tool flex, frame drift" in found.notices[-1]
    late = mc.compensate(soft, q, clock=1.0)
    assert late.delivered
    assert set(late.delivered.carries) == {*own.carries, "thermal_growth:all"}
    assert any("taken at 1 of it" in notice for notice in late.notices)
    assert not any("session: taken" in notice for notice in found.notices)


# ---- by command --------------------------------------------------------------------------------


def test_the_command_tells_figures_and_json(soft, tmp_path):
    soft.save(tmp_path / "fit.json")

    def told(*more: object) -> Any:
        words = [str(word) for word in (tmp_path / "fit.json", *more)]
        result = CliRunner().invoke(export_command, words, standalone_mode=False)
        assert result.exception is None, result.output
        return result

    asked = told("--to", "urdf", "--json", "-o", tmp_path / "arm.urdf")
    own = mc.deliver(soft, "urdf")
    found = json.loads(asked.stdout)["delivered"]
    assert found["holdout_rms_mm"] == pytest.approx(own.figures.rms, rel=1e-9)
    assert found["not_carried"] == list(own.not_carried)
    assert (tmp_path / "arm.urdf").is_file()
    assert f"held-out RMS {own.figures.rms:.3f} mm" in asked.stderr
    assert f"the full model: held-out RMS {own.whole.rms:.3f} mm" in asked.stderr
    assert json.loads(told("--to", "json", "--json").stdout).keys() == {"delivered"}
    assert "delivered" not in told("--to", "json").stdout


def test_a_refit_that_is_no_better_than_the_drawing_is_not_delivered_unasked(monkeypatch):
    """The joint fit helps; what the file can hold of it does not."""
    made = simulate(mc.load_robot("ur10"), 40, 3, seed=3, truth=Truth(compliance=3e-6))
    joint = mc.calibrate("ur10", made.data, "sum", effects=EFFECTS)
    refit = deliverable.fit_held_split
    monkeypatch.setattr(
        deliverable, "fit_held_split", lambda *a: replace(refit(*a), status=Status.NO_BETTER)
    )
    with pytest.raises(mc.CalibrationError, match=r"urdf, without joint compliance.*keep"):
        mc.export(joint, "urdf")
    assert "<robot" in mc.export(joint, "urdf", keep_anyway=True, notify=lambda text: None)


def with_torques(robot: mc.Robot, own: str) -> Measurements:
    """An arm that bends under measured torques: gravity's, and what no model of it knows."""
    made = simulate(robot, 150, 3, seed=3, truth=Truth(compliance=0.0, noise_per_metre=0.0))
    rng, q = np.random.default_rng(7), made.data.q
    torque = gravity(made.cell.robot, q)
    size = np.abs(torque).max(axis=0)
    torque = (
        torque
        + {
            "bias": 0.5 * size,
            "friction": 0.5 * size * rng.choice([-1.0, 1.0], q.shape),
            "noise": 1.5 * size * rng.normal(size=q.shape),
        }[own]
    )
    y = made.cell.predict(q + 3e-6 * torque)
    columns = {f"tau{joint + 1}": torque[:, joint] for joint in range(robot.joints)}
    y = y + 1e-5 * rng.normal(size=y.shape)
    return replace(made.data.with_y(y), columns={**made.data.columns, **columns})


@pytest.mark.parametrize("own", ["bias", "friction", "noise"])
def test_what_was_fitted_to_measured_torques_is_fitted_to_those_of_gravity(own):
    """No torque is measured where a file is used: its figure is what it reaches without."""
    robot = mc.load_robot("irb2600")
    data = with_torques(robot, own)
    joint, plain, new = split_of(robot, data, EFFECTS)
    assert joint.within.after.rms_mm < 0.03  # with the torques, noise alone is left
    known = {name: values for name, values in new.columns.items() if not name.startswith("tau")}
    bare = replace(new, columns=known)
    alone = summarise_point_errors(plain.cell.error(new)).rms_mm
    for to in ("mjcf", "compensate"):
        made = mc.deliver(joint, to)
        found = summarise_point_errors(made.cell.error(bare)).rms_mm
        assert found == pytest.approx(made.figures.rms, rel=2.0 * TOLD)
        assert found < WORSE * alone
        assert made.figures.rms < WORSE * plain.within.after.rms_mm
        assert "fitted without the measured torques" in made.sentence()
    if own == "bias":  # geometry takes it up, and gravity is all that is left
        assert found < 0.03
    targets = data.take(np.arange(4))
    measured = mc.compensate(joint, targets)
    assert measured.delivered is not None
    assert measured.delivered.figures.rms == joint.within.after.rms_mm
