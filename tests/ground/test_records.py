"""Dataclasses read from files by their own annotations."""

from __future__ import annotations

import math
from typing import Annotated

import pytest

import minimax_cal as mc
from minimax_cal.ground.records import Gaps, Part, Recorded, checked
from minimax_cal.solvers.minimax import Kkt, Step


class File(Part):
    first: Recorded[Step]
    ends: Annotated[Kkt, Gaps(required=("violation",))]


STEP = {"iteration": 3, "value": 1.5, "kkt": None, "later": "unknown to this version"}


def test_what_is_null_or_missing_is_nan() -> None:
    read = checked(File, {"first": STEP, "ends": {"violation": None}}, "f.json")
    assert (read.first.iteration, read.first.value, read.first.backend) == (3, 1.5, "")
    assert all(math.isnan(x) for x in (read.first.kkt, read.first.length, read.ends.violation))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"first": STEP, "ends": {}}, "ends.violation: Field required"),
        ({"first": {"iteration": None}, "ends": {"violation": 0.0}}, "first.iteration: Input"),
        ({"first": {**STEP, "value": "much"}, "ends": {"violation": 0.0}}, "first.value: Input"),
        ({"first": STEP, "ends": []}, "ends: Input should be a dictionary"),
    ],
)
def test_what_is_wrong_is_one_line(content: dict[str, object], says: str) -> None:
    with pytest.raises(mc.CalibrationError, match=f"f.json: {says}") as told:
        checked(File, content, "f.json")
    assert "\n" not in str(told.value)
