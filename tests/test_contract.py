"""Every result that can be read back: its file, its schema, and what a slip in the file does."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from conftest import ROOT, slipped

import minimax_cal as mc
from minimax_cal.cli.schemas import SCHEMA_CLASS_BY_KIND, build_file_schema
from minimax_cal.core.errors import CalibrationError
from minimax_cal.core.results import Result

INPUTS = ROOT / "tests" / "frozen_inputs"
PLAIN, CELL, DRIVEN = INPUTS / "plain.csv", INPUTS / "cell", INPUTS / "driven"
RUNS = [DRIVEN / f"run{i}.csv" for i in range(2)]
ODD = [None, "x", -1, 1e30, [], {}, [None], True, "1", [[]], {"a": 1}]
SLIPS = 60


def simulated_gap() -> Any:
    pytest.importorskip("mujoco", reason="mujoco is not installed")
    return mc.simulator_gap(INPUTS / "posed" / "arm.xml", INPUTS / "posed" / "poses.csv")


def driven_gap() -> Any:
    pytest.importorskip("mujoco", reason="mujoco is not installed")
    return mc.motion_gap(DRIVEN / "arm.xml", RUNS, driven=False)


def by_torques() -> Any:
    pytest.importorskip("mujoco", reason="mujoco is not installed")
    from minimax_cal.cli.torques import load_torque_robot
    from minimax_cal.dynamics.known_inputs import read_runs_of_robot

    runs = read_runs_of_robot(str(DRIVEN / "arm.xml"), RUNS)
    return mc.diagnose_motion(load_torque_robot(str(DRIVEN / "arm.xml"), runs), runs)


# by the names of `cli.schemas.SCHEMA_CLASS_BY_KIND`, and variants
MAKERS: dict[str, Callable[[], Any]] = {
    "calibration": partial(mc.calibrate, "irb2600", PLAIN),
    "calibration, point": partial(mc.calibrate, "irb2600", PLAIN, "point", cv=True),
    "calibration, effects": partial(
        mc.calibrate, "irb2600", PLAIN, "sum", effects="joint_compliance:J2,backlash:J5"
    ),
    "diagnosis": partial(mc.diagnose, "irb2600", PLAIN, quick=True),
    "relative": partial(mc.relative, "irb2600", INPUTS / "poses.csv"),
    "relative, several": partial(
        mc.relative, "irb2600", [INPUTS / "closures.csv", INPUTS / "wires.csv"]
    ),
    "pixels": partial(
        mc.calibrate_pixels, "ur5", CELL / "detections.csv", CELL / "joints.csv",
        {"cam0": CELL / "cam0.yaml"}, CELL / "board.csv",
    ),
    "simulator_gap": simulated_gap,
    "motion_gap": driven_gap,
    "motion_diagnosis": by_torques,
}  # fmt: skip
MADE: dict[str, Any] = {}


def result_of(name: str) -> Result:
    """Made once for all tests of a process."""
    if name not in MADE:
        MADE[name] = MAKERS[name]()
    found: Result = MADE[name]
    return found


def differing(one: Any, other: Any, rel: float, at: str = "") -> Iterator[str]:
    """Where two JSONs differ by more than a share of their numbers."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in one.keys() | other.keys():
            yield from differing(one.get(key, "-"), other.get(key, "-"), rel, f"{at}.{key}")
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for i, pair in enumerate(zip(one, other, strict=True)):
            yield from differing(*pair, rel, f"{at}[{i}]")
    elif isinstance(one, float) and isinstance(other, float):
        if not math.isclose(one, other, rel_tol=rel, abs_tol=rel):
            yield f"{at}: {one!r} {other!r}"
    elif one != other:
        yield f"{at}: {one!r:.60} {other!r:.60}"


def test_every_kind_is_made():
    assert {name.partition(",")[0] for name in MAKERS} == SCHEMA_CLASS_BY_KIND.keys() - {"robot"}


@pytest.mark.parametrize("name", MAKERS)
def test_a_file_comes_back(name):
    """As it was to what a difference of 15 digits leaves; then to what a turn of a frame does."""
    made = result_of(name)
    content = json.loads(made.json())
    again = type(made).from_dict(content)
    told = json.loads(again.json())
    assert not list(differing(content, told, 1e-9))
    once_more = json.loads(type(made).from_dict(told).json())
    assert not list(differing(told, once_more, 1e-10))
    assert again.headline() == made.headline()
    assert again.summary()


@pytest.mark.parametrize("name", MAKERS)
def test_a_file_is_as_its_schema_says(name):
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    made = jsonschema.Draft202012Validator(build_file_schema(name.partition(",")[0]))
    assert not [fault.message for fault in made.iter_errors(json.loads(result_of(name).json()))]


@pytest.mark.parametrize("name", MAKERS)
def test_a_slip_in_a_file_is_one_line_or_does_no_harm(name):
    made, rng = result_of(name), np.random.default_rng(3)
    whole = json.loads(made.json())
    for number in range(SLIPS):
        content = slipped(whole, rng, ODD, 0.3)
        said = ""
        try:
            type(made).from_dict(content, "slip.json").summary()
        except CalibrationError as error:
            said = str(error)
        assert "\n" not in said, number
