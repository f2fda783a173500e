"""No two statements of one diagnosis contradict: over the cases of the blind studies."""

from dataclasses import replace
from functools import cache

import pytest

import minimax_cal as mc
from experiments import blind_gap, motion_blind
from experiments.gap_cases import make
from minimax_cal.diagnosing.verdict import ABOVE_NOISE
from minimax_cal.dynamics.laws import USUAL
from tests.contradictions import contradictions

CASES = blind_gap.plan(7001, blind_gap.QUICK)
FEW = range(0, len(CASES), 10)
TORQUES = motion_blind.plan(7003, 1, 3)


@cache
def found_of(i: int) -> mc.Diagnosis:
    made = make(CASES[i])
    return mc.diagnose(made.robot, made.data, quick=True)


@cache
def found_by(i: int) -> mc.MotionDiagnosis:
    made = motion_blind.make(TORQUES[i])
    return mc.diagnose_motion(made.robot, made.runs, ratio=motion_blind.RATIO, payload=made.payload)


def check(i: int) -> None:
    """The answer agrees with itself, and with what the command that it prints reaches."""
    found, made = found_of(i), make(CASES[i])
    assert contradictions(found) == []
    if found.main and not found.main[0].rows:
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
    named = next(one for one in map(found_of, FEW) if one.main and len(one.ladder) > 2)
    first, *others = named.effects
    rest = replace(named.remaining, unexplained_mm=2.0 * named.remaining.unexplained_mm + 1.0)
    for seen, change in {
        "an effect stands twice": {"effects": (first,) * 2},
        "a step that is not confirmed": {"effects": (replace(first, again=0.5), *others)},
        "parts that do not add up": {"remaining": rest},
        "above noise that is as large": {
            "verdict": "unknown", "tested": (0.1372, 0.1373), "structure_in": ABOVE_NOISE,
        },
    }.items():  # fmt: skip
        assert seen in contradictions(replace(named, **change)), seen


def test_a_contradiction_of_torques_is_seen():
    every = map(found_by, range(len(TORQUES)))
    named = next(one for one in every if {e.effect for e in one.main} - {*USUAL})
    none = replace(named, verdict="none", effects=(*named.effects, named.effects[0]))
    assert {"an effect stands twice", "none, and a cause"} <= {*contradictions(none)}
