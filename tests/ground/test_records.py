"""Records that are written to files, read from them and described by their own annotations."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from minimax_cal.core.arrays import Array
from minimax_cal.core.files import convert_to_plain_json, format_json
from minimax_cal.core.record_fields import (
    SEPARATE_FIELD_FORMAT,
    FieldFormat,
    LazyValue,
    LengthInMillimetres,
    derived_field,
    format_record_fields,
)
from minimax_cal.core.record_parsing import build_record_schema, parse_record

jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")


class Kind(StrEnum):
    THICK = "thick"
    THIN = "thin"


class Ends(NamedTuple):
    first: float
    last: float


@dataclass(frozen=True)
class Knot:
    """A record in a record."""

    at: float
    name: str = ""


@dataclass(frozen=True, eq=False)
class Wire:
    """A record with units, arrays and records of its own."""

    name: str
    length: LengthInMillimetres
    ends: Annotated[Ends, FieldFormat(key="where.ends_mm", scale=1e3)]
    error: Array
    interval: tuple[float, float]
    kind: Kind
    side: Literal["left", "right"]
    colour: Annotated[str, FieldFormat(among=("red", "blue"))]
    count: Annotated[int, FieldFormat(least=0)]
    knots: Annotated[tuple[Knot, ...], FieldFormat(fewest=1)]
    loads: Mapping[str, tuple[float, float]]
    hidden: Annotated[Knot | None, SEPARATE_FIELD_FORMAT] = None
    used: bool | None = None
    note: Annotated[str, FieldFormat(brief=True)] = ""
    tension: LazyValue[float] = field(default_factory=lambda: LazyValue(lambda: 7.0))

    @derived_field("{:.1f} mm on average", key="where.mean_mm", scale=1e3)
    def mean(self) -> float:
        """Of the errors [m]."""
        return float(self.error.mean())


WIRE = Wire(
    name="a",
    length=1.25,
    ends=Ends(0.5, math.nan),
    error=np.array([[1e-3, 3e-3]]),
    interval=(math.nan, 1.0),
    kind=Kind.THIN,
    side="left",
    colour="red",
    count=3,
    knots=(Knot(0.5, "k"), Knot(math.nan)),
    loads={"J1": (1.0, 2.0)},
    hidden=Knot(1.0),
)
FILE = {
    "name": "a",
    "length_mm": 1250.0,
    "where": {"ends_mm": {"first": 500.0, "last": None}, "mean_mm": 2.0},
    "error": [[1e-3, 3e-3]],
    "interval": [None, 1.0],
    "kind": "thin",
    "side": "left",
    "colour": "red",
    "count": 3,
    "knots": [{"at": 0.5, "name": "k"}, {"at": None, "name": ""}],
    "loads": {"J1": [1.0, 2.0]},
    "used": None,
    "tension": 7.0,
}


def test_a_record_is_written_by_its_keys_and_units():
    assert json.loads(format_json(convert_to_plain_json(WIRE))) == FILE


def test_a_record_comes_back_bit_by_bit():
    found = parse_record(Wire, FILE | {"later": "unknown to this version"})
    assert convert_to_plain_json(found) == FILE
    assert (found.length, found.kind, found.hidden) == (1.25, Kind.THIN, None)
    assert math.isnan(found.ends.last)
    assert_array_equal(found.error, WIRE.error)
    assert format_record_fields(found) == "2.0 mm on average"


def test_what_may_miss_is_filled_in():
    content: dict[str, Any] = {k: v for k, v in FILE.items() if k not in ("used", "tension")}
    content["knots"] = [{"at": 1}]
    found = parse_record(Wire, content)
    assert (found.used, found.tension.value, found.knots) == (None, 7.0, (Knot(1.0),))


def test_the_schema_is_of_the_file():
    made = build_record_schema(Wire)
    jsonschema.Draft202012Validator.check_schema(made)
    assert not list(jsonschema.Draft202012Validator(made).iter_errors(FILE))
    assert {"length_mm", "where", "error"} <= set(made["required"])
    assert not {"used", "note", "tension", "hidden"} & set(made["required"])
    assert "hidden" not in made["properties"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"name": 3}, "name: should be a text"),
        ({"length_mm": "long"}, "length_mm: should be a number"),
        ({"length_mm": True}, "length_mm: should be a number"),
        ({"length_mm": 1e101}, "length_mm: cannot be 1e.101"),
        ({"where": {}}, "where.ends_mm: is missing"),
        ({"where": {"ends_mm": {"first": 1.0}}}, "where.ends_mm.last: is missing"),
        ({"error": [[1.0], [1.0, 2.0]]}, "error: holds something else than numbers"),
        ({"interval": [1.0]}, "interval: should be a list of 2"),
        ({"kind": "fat"}, "kind: should be one of thick, thin"),
        ({"side": None}, "side: should be one of left, right"),
        ({"colour": "green"}, "colour: should be one of red, blue"),
        ({"count": -1}, "count: cannot be -1"),
        ({"count": 1.5}, "count: should be a whole number"),
        ({"knots": []}, "knots: should be a list of 1 or more"),
        ({"knots": [{"at": "x"}]}, r"knots\[0\].at: should be a number"),
        ({"knots": [[]]}, r"knots\[0\]: should be an object"),
        ({"loads": {"J1": "x"}}, "loads.J1: should be a list of 2"),
        ({"used": "yes"}, "used: should be true or false"),
    ],
)
def test_what_is_wrong_is_named_with_its_place(change, says):
    with pytest.raises(ValueError, match=f"^{says}"):
        parse_record(Wire, FILE | change)
    errors = jsonschema.Draft202012Validator(build_record_schema(Wire)).iter_errors(FILE | change)
    assert list(errors) or "e.101" in says or "rows" in says or "than numbers" in says
