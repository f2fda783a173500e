"""Which names hold: how often subsamples of the poses find them again."""

from dataclasses import replace

import numpy as np
import pytest
from problems_fit import study_of

import minimax_cal as mc
from experiments.gap_cases import Case, Cause, make
from minimax_cal.diagnosing.established import as_alternative, asked, judged, often, stands_for
from minimax_cal.diagnosing.result import Alternative, Finding
from minimax_cal.evidence.limits import CONFIRMED, FREQUENT, PARTS, ROUNDS
from minimax_cal.evidence.selection import Choice, select
from minimax_cal.evidence.stability import Repeats
from minimax_cal.modelling.dictionary import arm_library
from minimax_cal.modelling.effects.table import Term


def found(effect: str, place: str, size: float = 100.0) -> Finding:
    return Finding((Term(effect, place),), ("x",), ("1",), (1.0,), (0.1,), size, 1e-9)


def named(*names: tuple[str, str]) -> frozenset[tuple[str, str]]:
    return frozenset(names)


def test_the_frequency_decides_what_is_established_and_what_is_in_the_model() -> None:
    count = PARTS * ROUNDS
    for times in range(count + 1):
        one = replace(found("backlash", "J1"), again=times / count)
        assert one.established == (times >= count - 1)
        assert (often([one]) == [one]) == (times >= 8)
        assert one.evidence.endswith(f", {times / count:.2f}")
    assert FREQUENT < CONFIRMED < (count - 1) / count
    unasked = replace(found("backlash", "J1"), again=float("nan"))
    assert often([unasked]) == [unasked]
    assert not asked([unasked])
    assert not unasked.established
    assert unasked.evidence == "possible"


def test_one_joint_and_all_of_them_stand_for_each_other() -> None:
    rival = Alternative("base_flex", "frame", 0.9, 5.0, 1.0)
    one = replace(found("joint_compliance", "J2"), alternatives=(rival,))
    repeats = Repeats(
        (named(("joint_compliance", "all")), named(("joint_compliance", "J3"), ("backlash", "J1"))),
        2,
    )  # fmt: skip
    assert stands_for(one, repeats) == {
        ("joint_compliance", "J2"), ("joint_compliance", "all"), ("base_flex", "frame")
    }  # fmt: skip
    every = replace(one, terms=(Term("joint_compliance", "all"),), alternatives=())
    assert stands_for(every, repeats) == {
        ("joint_compliance", "J3"), ("joint_compliance", "all")
    }  # fmt: skip


@pytest.fixture(scope="module")
def geared() -> Choice:
    study = study_of(make(Case("irb2600", "single", (Cause("gear_error", "J1", 300.0),), seed=4)))
    return select(arm_library(study.scene, study.rows))


def test_what_takes_the_place_of_a_name_is_its_alternative(geared: Choice) -> None:
    (term,) = (candidate.term for candidate in geared.chosen)
    effect = replace(found("gear_error", "J1"), terms=(term,))
    gain, play = ("encoder_gain", "J1"), ("backlash", "J6")
    own = named(effect.term.key)
    repeats = Repeats((own, own, own, named(gain), named(gain), named(play)), 6)
    told = judged(effect, geared, repeats)
    assert told.again == 5 / 6  # it, or what takes its place
    assert [(a.effect, a.place) for a in told.alternatives] == [gain]
    assert told.alternatives[0].loss > 0.0
    assert 0.0 < told.alternatives[0].rho2 < 1.0
    assert as_alternative(effect, geared, ("no such", "J1")) == []


def test_poses_too_few_to_ask_leave_an_effect_possible_below_the_budget() -> None:
    """Twenty poses of one target: two thirds of them tell the geometry and little more."""
    made = make(
        Case("irb2600", "single", (Cause("joint_compliance", "J2", 2e4),), seed=3, poses=20)
    )
    data = made.data.keep(np.arange(len(made.data.target_names)) == 0).take(np.arange(20))
    columns = {name: column for name, column in data.columns.items() if name != "split"}
    told = mc.diagnose(made.robot, replace(data, columns=columns), quick=True)
    (one,) = told.effects
    assert one.term.key == ("joint_compliance", "J2")
    assert np.isnan(one.again)
    assert not one.established
    assert told.to_dict()["effects"][0]["frequency"] is None
    assert told.ladder[-1].name == "geometric"
    assert told.possible.holdout.rms_mm < 0.2 * told.ladder[-1].holdout.rms_mm
