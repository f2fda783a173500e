"""Before a verdict is spoken it is asked whether the model meets the noise that is known."""

from dataclasses import replace

import pytest
from test_verdict import finding

import minimax_cal as mc
from experiments.gap_cases import Cause
from experiments.machines import Asked, make
from minimax_cal.diagnosing.result import Finding
from minimax_cal.diagnosing.verdict import ABOVE_NOISE, ONLY_MINOR, Known, answered

NAN = float("nan")
QUIET = Known(highest=0.05, remaining=0.04, visits=NAN, expected=NAN)
LOUD = replace(QUIET, remaining=0.14)
UNKNOWN = replace(LOUD, highest=NAN)


@pytest.mark.parametrize(
    ("known", "meets"), [(QUIET, True), (LOUD, False), (UNKNOWN, None)], ids=str
)
def test_a_model_meets_the_noise_where_that_is_known(known: Known, meets: bool | None) -> None:
    assert known.meets_floor is meets


@pytest.mark.parametrize(
    ("verdict", "known", "expected"),
    [
        ("none", QUIET, "none"),
        ("none", LOUD, "unknown"),  # a model at 0.14 mm beside a noise of 0.05 mm
        ("none", UNKNOWN, "none"),
        ("named", QUIET, "named"),
        ("named", LOUD, "unknown"),
        ("named", UNKNOWN, "named"),
        ("unknown", QUIET, "unknown"),
    ],
)
def test_the_verdict_reads_the_noise(verdict: str, known: Known, expected: str) -> None:
    found = [sure(minor=False)] if verdict == "named" else []
    assert answered(verdict, "", found, known)[0] == expected


def sure(*, minor: bool) -> Finding:
    """A confirmed cause."""
    return replace(finding("gear_error", "J2"), minor=minor)


@pytest.mark.parametrize(
    ("known", "expected"), [(QUIET, "none"), (UNKNOWN, "none"), (LOUD, "unknown")]
)
def test_minor_causes_alone_carry_no_verdict(known: Known, expected: str) -> None:
    verdict, why = answered("named", "", [sure(minor=True)], known)
    assert verdict == expected
    assert (why == ONLY_MINOR) == (expected == "unknown")


def test_a_cause_that_carries_the_error_is_no_answer_to_noise_that_is_known() -> None:
    assert answered("named", "", [sure(minor=False)], LOUD) == ("unknown", ABOVE_NOISE)
    assert answered("one_of", "", [sure(minor=False)], QUIET) == ("one_of", "")


@pytest.mark.parametrize(("visits", "repeatable"), [(0.1, True), (0.2, False), (NAN, True)])
def test_an_arm_is_not_repeatable_whose_visits_scatter_more_than_it_may(
    visits: float, repeatable: bool
) -> None:
    known = replace(QUIET, visits=visits, expected=0.1)
    assert known.is_repeatable == repeatable
    expected = "none" if repeatable else "not_repeatable"
    assert answered("none", "", [], known)[0] == expected


def test_a_joint_on_two_seats_is_not_repeatable() -> None:
    """By its visits, beside what the distances between the targets say of the instrument."""
    made = make(Asked("ur5e", "mechanism", (Cause("outside_seats", "J2", 5000.0),), seed=5))
    found = mc.diagnose(made.robot, made.data, quick=True)
    assert found.verdict == "not_repeatable"
    said = found.to_dict()
    assert said["floor_known"]
    assert isinstance(said["meets_floor"], bool)
