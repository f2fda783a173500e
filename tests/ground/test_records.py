"""Dataclasses read from files by their own annotations."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import minimax_cal as mc
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.facts import Fact, derived, facts_in_words
from minimax_cal.ground.files import json_text, plain
from minimax_cal.ground.records import Gaps, Part, Recorded, checked, json_schema
from minimax_cal.solvers.minimax import Kkt, Step


class File(Part):
    first: Recorded[Step]
    ends: Annotated[Kkt, Gaps(required=("violation",))]


@dataclass(frozen=True, eq=False)
class Wire:
    """A record with units, arrays and records of its own."""

    name: str
    length: Annotated[float, Fact(key="length_mm", scale=1e3)]
    ends: Annotated[tuple[float, ...], Fact(key="ends_mm", scale=1e3)]
    error: Array
    steps: tuple[Step, ...] = ()
    used: bool | None = None

    @derived("{:.1f} mm on average", key="mean_mm", scale=1e3)
    def mean(self) -> float:
        """Of the errors [m]."""
        return float(self.error.mean())


class Wires(Part):
    wires: tuple[Recorded[Wire], ...]


STEP = {"iteration": 3, "value": 1.5, "kkt": None, "later": "unknown to this version"}


def test_what_is_null_or_missing_is_nan() -> None:
    read = checked(File, {"first": STEP, "ends": {"violation": None}}, "f.json")
    assert (read.first.iteration, read.first.value, read.first.backend) == (3, 1.5, "")
    assert all(math.isnan(x) for x in (read.first.kkt, read.first.length, read.ends.violation))


def test_a_record_comes_back_from_its_keys_and_units() -> None:
    wire = Wire(
        "a", 1.25, (0.5, math.nan), np.array([[1e-3, 3e-3]]), (Step(1, 2.0, 0.0, 0.0, 1.0),)
    )
    content = json.loads(json_text({"wires": [plain(wire)]}))
    assert content["wires"][0] | {"steps": ()} == {
        "name": "a", "length_mm": 1250.0, "ends_mm": [500.0, None], "error": [[1e-3, 3e-3]],
        "steps": (), "used": None, "mean_mm": 2.0,
    }  # fmt: skip
    (read,) = checked(Wires, content, "f.json").wires
    assert (read.name, read.length, read.steps, read.used) == ("a", 1.25, wire.steps, None)
    assert_array_equal(read.ends, wire.ends)
    assert_array_equal(read.error, wire.error)
    assert facts_in_words(read) == "2.0 mm on average"


def test_the_schema_has_the_keys_of_the_file() -> None:
    made = json_schema(Wires, "Wires")["$defs"]["Wire"]
    assert {"length_mm", "ends_mm", "error"} <= made["properties"].keys()
    assert set(made["required"]) == {"name", "ends_mm", "error"}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"first": STEP, "ends": {}}, "ends.violation: Field required"),
        ({"first": {"iteration": None}, "ends": {"violation": 0.0}}, "first.iteration: Input"),
        ({"first": {**STEP, "value": "much"}, "ends": {"violation": 0.0}}, "first.value: Input"),
        ({"first": STEP, "ends": []}, "ends: Input should be a valid dictionary"),
    ],
)
def test_what_is_wrong_is_one_line(content: dict[str, object], says: str) -> None:
    with pytest.raises(mc.CalibrationError, match=f"f.json: {says}") as told:
        checked(File, content, "f.json")
    assert "\n" not in str(told.value)
