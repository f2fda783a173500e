"""The diagnosis of several instruments: known causes, the noise that is given, the file."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from experiments import blind_gap, motion_blind
from experiments.gap_cases import build_and_measure_arm
from experiments.relative import RELATIVE_LENGTH_NOISE
from experiments.relative_gap import (
    RELATIVE_GAP_CAUSES,
    RELATIVE_GAP_INSTRUMENT_SETS,
    ArmWithCause,
    RelativeGapJob,
    draw_arm,
    simulate_instrument,
)
from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.diagnose_instruments import SINGLE_INSTRUMENT_NEEDED, diagnose_relative
from minimax_cal.diagnosing.instruments_result import RelativeDiagnosis
from minimax_cal.diagnosing.verdict import ABOVE_NOISE_TEXT
from minimax_cal.dynamics.laws import USUAL_FRICTION_EFFECTS
from minimax_cal.fitting.multi_instrument.relative_calibration import relative
from minimax_cal.fitting.opened_results import open_result
from tests.contradictions import contradictions


def measured(job: RelativeGapJob, arm: ArmWithCause | None = None) -> tuple[ArmWithCause, list]:
    arm, rng = arm or draw_arm(job), np.random.default_rng([job.seed, 2])
    return arm, [simulate_instrument(arm, kind, job.poses, rng) for kind in job.instruments]


@cache
def diagnosed(title: str, cause: str) -> RelativeDiagnosis:
    arm, data = measured(
        RelativeGapJob("irb2600", RELATIVE_GAP_INSTRUMENT_SETS[title], cause, 1, 100)
    )
    return diagnose_relative(arm.robot, data)


@pytest.mark.parametrize("cause", RELATIVE_GAP_CAUSES)
@pytest.mark.parametrize("title", RELATIVE_GAP_INSTRUMENT_SETS)
def test_the_cause_is_named_and_no_other(title: str, cause: str) -> None:
    found = diagnosed(title, cause)
    assert contradictions(found) == []
    names = {f.term.effect for f in found.effects if f.established}
    if cause in ("sound", "outside"):
        assert found.verdict == {"sound": "none", "outside": "unknown"}[cause]
        assert not names
        return
    assert found.verdict in ("named", "one_of")
    assert names == {"joint_compliance" if cause == "compliance" else "gear_ripple"}
    assert found.steps[-1].holdout.rms_mm < 0.7 * found.steps[1].holdout.rms_mm
    assert found.steps[-1].holdout.rms_mm < 2.5e3 * RELATIVE_LENGTH_NOISE


@pytest.mark.parametrize("title", RELATIVE_GAP_INSTRUMENT_SETS)
def test_the_last_step_is_the_calibration_with_the_effects(title: str) -> None:
    """And the one before is that of geometry: by file and of all, as `relative` has them."""
    found = diagnosed(title, "compliance")
    arm, data = measured(
        RelativeGapJob("irb2600", RELATIVE_GAP_INSTRUMENT_SETS[title], "compliance", 1, 100)
    )
    terms = [term for one in found.effects for term in one.terms]
    for step, effects in ((found.steps[1], ()), (found.steps[-1], terms)):
        fit = relative(arm.robot, data, effects=effects)
        assert_allclose(step.holdout.rms_mm, fit.accuracy["holdout"].rms_mm, rtol=1e-12)
        for one in fit.instruments if len(fit.instruments) > 1 else ():
            assert_allclose(step.files[one.name].rms_mm, one.accuracy["holdout"].rms_mm, rtol=1e-12)
    values = [p.value for p in fit.parameters if p.is_of_effect]
    assert_allclose([v for f in found.effects for v in f.values], values, rtol=1e-12)
    assert found.calibration.cell is not None
    assert fit.cell is not None
    assert_allclose(found.calibration.cell.robot.mdh, fit.cell.robot.mdh, rtol=0, atol=1e-14)


class Tossed(ArmWithCause):
    """A joint that three others turn: to any law of one or two angles, chance."""

    def bent_joint_values(self, q: Array) -> Array:
        out = q + 0.0
        out[..., 1] += 1e-4 * np.sin(3.0 * q[..., 0] + 5.0 * q[..., 2] + 4.0 * q[..., 3])
        return out


@pytest.mark.parametrize("title", RELATIVE_GAP_INSTRUMENT_SETS)
def test_what_no_law_finds_is_above_the_noise_that_is_given(title: str) -> None:
    job = RelativeGapJob("irb2600", RELATIVE_GAP_INSTRUMENT_SETS[title], "sound", 3, 100)
    sound = draw_arm(job)
    tossed = Tossed(sound.robot, sound.real, 0.0)
    plain = diagnosed(title, "sound")
    assert plain.meets_floor is None
    names = [one.name for one in plain.calibration.instruments] or [plain.calibration.kind]
    for arm, verdict, meets in ((sound, "none", True), (tossed, "unknown", False)):
        _, data = measured(job, arm)
        found = diagnose_relative(
            arm.robot, data, noises=dict.fromkeys(names, RELATIVE_LENGTH_NOISE)
        )
        assert (found.verdict, found.meets_floor) == (verdict, meets)
        assert not [f for f in found.effects if f.established]
        remaining, highest = found.floor
        assert (remaining < 1.1 * highest) == meets
        assert highest >= RELATIVE_LENGTH_NOISE
    assert found.headline().startswith("Unexplained")


def test_what_is_left_out_is_not_found() -> None:
    arm, data = measured(
        RelativeGapJob("irb2600", RELATIVE_GAP_INSTRUMENT_SETS["whole poses"], "compliance", 1, 100)
    )
    found = diagnose_relative(arm.robot, data, exclude=["joint_compliance"])
    every = [(f.term.effect, *(a.effect for a in f.alternatives)) for f in found.effects]
    assert "joint_compliance" not in [name for names in every for name in names]


def test_effects_of_one_instrument_are_not_testable() -> None:
    found = diagnosed("tracker + sockets", "sound")
    needs = dict(found.not_testable)
    assert needs["target_offset"] == SINGLE_INSTRUMENT_NEEDED
    assert "approach1" in needs["backlash"]


def test_a_file_comes_back_and_its_effects_can_be_fitted(tmp_path: Path) -> None:
    found = diagnosed("tracker + sockets", "compliance")
    path = tmp_path / "relative.json"
    found.save(path)
    content = json.loads(path.read_text())
    again = RelativeDiagnosis.from_dict(content)
    back = json.loads(again.json())["diagnosis"]
    jitters = [one.pop("noise")["joint_jitter_mrad"] for one in (back, content["diagnosis"])]
    assert jitters[0] == pytest.approx(jitters[1], rel=1e-12)
    assert back == content["diagnosis"]
    assert again.headline() == found.headline()
    assert [t.text(99) for t in again.diagnosis_tables()] == [
        t.text(99) for t in found.diagnosis_tables()
    ]
    opened = open_result(path)
    assert not opened.possible
    assert found.calibration.cell is not None
    given = found.calibration.cell.effects.terms
    assert [t.text for t in opened.cell.effects.terms] == [t.text for t in given]
    arm, data = measured(
        RelativeGapJob(
            "irb2600", RELATIVE_GAP_INSTRUMENT_SETS["tracker + sockets"], "compliance", 1, 100
        )
    )
    fit = relative(arm.robot, data, effects=path)
    assert_allclose(fit.accuracy["holdout"].rms_mm, found.steps[-1].holdout.rms_mm, rtol=1e-9)


def test_a_possible_effect_is_not_taken_from_a_file() -> None:
    found = diagnosed("tracker + sockets", "compliance")
    loose = replace(found, effects=tuple(replace(f, again=0.7) for f in found.effects))
    assert open_result(loose).possible == {t.text for f in found.effects for t in f.terms}
    arm, data = measured(
        RelativeGapJob(
            "irb2600", RELATIVE_GAP_INSTRUMENT_SETS["tracker + sockets"], "compliance", 1, 100
        )
    )
    assert relative(arm.robot, data, effects=loose).cell is None


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"effects": "backlash"}, "a diagnosis looks for them"),
        ({"exclude": ["nonsense"]}, "no effect 'nonsense' to leave out"),
        ({"holdout": 0.0}, "needs held-out rows in every file"),
    ],
)
def test_mistakes_are_one_line(options: dict, words: str) -> None:
    arm, data = measured(RelativeGapJob("irb2600", ("wires_3",), "sound", 1, 60))
    with pytest.raises(mc.CalibrationError, match=words):
        mc.diagnose_relative(arm.robot, data, **options)


# ---- contradictions ------------------------------------------------------------------------------


CASES = blind_gap.draw_all_cases(7001, blind_gap.QUICK_BLIND_STUDY_SIZE)
FEW = range(0, len(CASES), 10)
TORQUES = motion_blind.draw_all_cases(7003, 1, 3)


@cache
def found_of(i: int) -> mc.Diagnosis:
    made = build_and_measure_arm(CASES[i])
    return mc.diagnose(made.robot, made.data, quick=True)


@cache
def found_by(i: int) -> mc.MotionDiagnosis:
    made = motion_blind.simulate_case(TORQUES[i])
    return mc.diagnose_motion(
        made.robot, made.runs, ratio=motion_blind.GIVEN_GEAR_RATIO, payload=made.payload
    )


def check(i: int) -> None:
    """The answer agrees with itself, and with what the command that it prints reaches."""
    found, made = found_of(i), build_and_measure_arm(CASES[i])
    assert contradictions(found) == []
    if found.main_findings and not found.main_findings[0].rows:
        fit = mc.calibrate(made.robot, made.data, objective="sum", effects=found)
        reached = fit.accuracy["holdout"].rms_mm
        assert reached == pytest.approx(found.budget[-1]["rms_mm"], rel=0.01)


@pytest.mark.parametrize("i", FEW)
def test_an_answer_does_not_contradict_itself(i):
    check(i)


@pytest.mark.slow
@pytest.mark.parametrize("i", sorted({*range(len(CASES))} - {*FEW}))
def test_no_answer_contradicts_itself(i):
    check(i)


@pytest.mark.parametrize("i", range(len(TORQUES)))
def test_no_answer_by_torques_contradicts_itself(i):
    assert contradictions(found_by(i)) == []


def test_a_contradiction_is_seen():
    named = next(one for one in map(found_of, FEW) if one.main_findings and len(one.ladder) > 2)
    first, *others = named.effects
    rest = replace(named.remaining, unexplained_mm=2.0 * named.remaining.unexplained_mm + 1.0)
    for words, change in {
        "an effect stands twice": {"effects": (first,) * 2},
        "a step that is not confirmed": {"effects": (replace(first, again=0.5), *others)},
        "parts that do not add up": {"remaining": rest},
        "above noise that is as large": {
            "verdict": "unknown", "tested": (0.1372, 0.1373), "structure_in": ABOVE_NOISE_TEXT,
        },
    }.items():  # fmt: skip
        assert words in contradictions(replace(named, **change)), words


def test_a_contradiction_of_torques_is_seen():
    every = map(found_by, range(len(TORQUES)))
    named = next(one for one in every if {e.effect for e in one.main} - {*USUAL_FRICTION_EFFECTS})
    none = replace(named, verdict="none", effects=(*named.effects, named.effects[0]))
    assert {"an effect stands twice", "none, and a cause"} <= {*contradictions(none)}
