"""The JSON schemas are of the files as they are written, and refuse what the readers refuse."""

import json
from collections.abc import Iterator
from importlib import resources
from typing import Any

import numpy as np
import pytest
from conftest import run

import minimax_cal as mc
from minimax_cal.cli.schemas import KINDS, schema_of
from minimax_cal.robots.robot import robot_from_dict

jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
WHOLE = {
    "name": "arm", "convention": "Rz(sign*q+theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)",
    "units": {"length": "mm", "angle": "rad"}, "up": [0, 0, 1], "repeatability_mm": 0.1,
    "joints": [{"a": 0, "d": 290, "theta": 0, "alpha": -1.5, "beta": 0, "sign": 1,
                "type": "revolute", "lower": -2.8, "upper": 2.8, "ratio": 101, "mass_kg": 3,
                "com_mm": [0, 0, 1], "name": "J1"}],
}  # fmt: skip


def faults(kind: str, content: Any) -> list[str]:
    checker = jsonschema.Draft202012Validator(schema_of(kind))
    return [f"{list(fault.path)}: {fault.message}"[:200] for fault in checker.iter_errors(content)]


@pytest.mark.parametrize("kind", KINDS)
def test_each_is_a_schema(kind, capsys):
    assert run("robots", "--schema", kind) == 0
    printed = json.loads(capsys.readouterr().out)
    jsonschema.Draft202012Validator.check_schema(printed)
    assert printed == schema_of(kind)


def test_a_robot_file_is_meant_unless_told(capsys):
    assert run("robots", "--schema") == 0
    assert json.loads(capsys.readouterr().out) == schema_of("robot")


@pytest.mark.parametrize("name", mc.builtin_robots())
def test_robots_as_they_are_written(name):
    file = resources.files("minimax_cal.robots") / "builtin" / f"{name}.json"
    for content in (json.loads(file.read_text("utf-8")), mc.load_robot(name).to_dict()):
        assert not faults("robot", content)


def places(content: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where each key of a robot file stands."""
    pairs = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in pairs:
        if isinstance(key, str):
            yield (*path, key)
        if isinstance(value, dict | list):
            yield from places(value, (*path, key))


@pytest.mark.parametrize("path", list(places(WHOLE)), ids=lambda path: ".".join(map(str, path)))
def test_every_key_misspelt_is_refused(path):
    """With the nearest known one; today's spelling is ignored tomorrow otherwise."""
    *inner, key = path
    rng = np.random.default_rng(0)
    at = int(rng.integers(len(key)))
    for slip in (key + "s", key[:at] + "q" + key[at + 1 :], key.upper()):
        content = json.loads(json.dumps(WHOLE))
        part = content
        for step in inner:
            part = part[step]
        part[slip] = part.pop(key)
        assert faults("robot", content), slip
        with pytest.raises(mc.CalibrationError) as error:
            robot_from_dict(content)
        assert f"unknown key {slip!r}" in str(error.value)


def test_notes_are_free_and_nothing_else():
    notes = {"x_cell": 7, "source": "data sheet", "source_of_nominal": "drawing", "notes": ["a"]}
    assert not faults("robot", WHOLE | notes)
    assert robot_from_dict(WHOLE | notes).name == "arm"
    for key in ("coupling2", "gripper", "comment"):
        with pytest.raises(mc.CalibrationError, match=f"unknown key '{key}'; did you mean "):
            robot_from_dict(WHOLE | {key: 1})
    joint = [WHOLE["joints"][0] | {"note": "worn"}]  # type: ignore[index, operator]
    with pytest.raises(mc.CalibrationError, match=r"joints\[0\]: unknown key 'note'"):
        robot_from_dict(WHOLE | {"joints": joint})
