"""Options made from fields: what is shown is the default, and what is given arrives in SI."""

import json
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from types import SimpleNamespace as Namespace
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner

import minimax_cal as mc
from minimax_cal.cli.diagnose import suggest_next_commands
from minimax_cal.cli.options import (
    CommandOutput,
    SuggestedCommand,
    options_from_dataclass,
    options_from_parameters,
)
from minimax_cal.cli.schemas import SCHEMA_CLASS_BY_KIND, build_file_schema
from minimax_cal.compensation.joint_compensation import compensate
from minimax_cal.core.option_fields import Option
from minimax_cal.diagnosing.diagnose import DiagnosisOptions
from minimax_cal.fitting.multi_instrument.options import RelativeOptions
from minimax_cal.fitting.options import Options
from minimax_cal.modelling.simulate import Truth
from minimax_cal.planning.plan_options import PlanOptions
from minimax_cal.robots.robot import robot_from_dict
from minimax_cal.solvers.status import Status
from minimax_cal.validation.workspace_maps import MapGrid

# ---- options -------------------------------------------------------------------------------------


def given(options: Any, *arguments: object) -> dict[str, Any]:
    """What a command with these options gets."""
    got: dict[str, Any] = {}

    @click.command()
    @options
    def command(**chosen: Any) -> None:
        got.update(chosen)

    CliRunner().invoke(command, list(map(str, arguments)), catch_exceptions=False)
    return got


@pytest.mark.parametrize("kind", [Options, RelativeOptions, PlanOptions, Truth, MapGrid])
def test_defaults_are_those_of_the_fields(kind):
    defaults = vars(kind())
    found = given(options_from_dataclass(kind))
    assert found
    for name, value in found.items():
        if name != "joints":  # texts until the robot is known
            expected = defaults[name]
            number = isinstance(expected, float) or name in ("reach", "elevation")
            assert value == (
                pytest.approx(expected, rel=1e-12, nan_ok=True) if number else expected
            )


def test_units_arrive_in_si():
    found = given(
        options_from_dataclass(PlanOptions),
        *("--acceptance", 90, "--noise", 20, "--body", 80, "--range", "1:20"),
        *("--elevation", "-90:45", "--tracker", "3000,0,500", "--target", "1,2,3"),
    )
    assert found["acceptance"] == pytest.approx(np.pi / 2.0)
    assert found["noise"] == pytest.approx(20e-6)
    assert found["body"] == pytest.approx(0.08)
    assert found["reach"] == (1.0, 20.0)
    assert found["elevation"] == pytest.approx((-np.pi / 2.0, np.pi / 4.0))
    assert found["tracker"] == (3.0, 0.0, 0.5)
    assert found["spots"] == (pytest.approx((0.001, 0.002, 0.003)),)


def test_some_fields_and_arguments_of_a_function():
    assert set(given(options_from_dataclass(Options, "seed", "qp"))) == {"seed", "qp"}
    told = options_from_parameters(compensate, most_change=Option(unit="deg", flag="--max-change"))
    assert given(told) == {"most_change": pytest.approx(np.pi / 36.0)}
    assert given(told, "--max-change", 90) == {"most_change": pytest.approx(np.pi / 2.0)}
    several = given(
        options_from_dataclass(Options), "--fix", "a1, d2", "--fix", "beta*", "--prior", "a*=1mm"
    )
    assert several["fix"] == ("a1", "d2", "beta*")
    assert several["priors"] == {"a*": 1e-3}


# ---- schemas -------------------------------------------------------------------------------------


WHOLE = {
    "name": "arm", "convention": "Rz(sign*q+theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)",
    "units": {"length": "mm", "angle": "rad"}, "up": [0, 0, 1], "repeatability_mm": 0.1,
    "joints": [{"a": 0, "d": 290, "theta": 0, "alpha": -1.5, "beta": 0, "sign": 1,
                "type": "revolute", "lower": -2.8, "upper": 2.8, "ratio": 101, "mass_kg": 3,
                "com_mm": [0, 0, 1], "name": "J1"}],
}  # fmt: skip


def faults(kind: str, content: Any) -> list[str]:
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    jsonschema.Draft202012Validator.check_schema(build_file_schema(kind))
    checker = jsonschema.Draft202012Validator(build_file_schema(kind))
    return [f"{list(fault.path)}: {fault.message}"[:200] for fault in checker.iter_errors(content)]


@pytest.mark.parametrize("kind", SCHEMA_CLASS_BY_KIND)
def test_each_is_a_schema(kind, says):
    printed = json.loads(says("robots --schema", kind).out)
    assert printed == build_file_schema(kind)
    assert faults(kind, [])


def test_a_robot_file_is_meant_unless_told(says):
    assert json.loads(says("robots --schema").out) == build_file_schema("robot")


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
    joint = [WHOLE["joints"][0] | {"note": "worn"}]
    with pytest.raises(mc.CalibrationError, match=r"joints\[0\]: unknown key 'note'"):
        robot_from_dict(WHOLE | {"joints": joint})


@pytest.mark.parametrize("status", [one for one in Status if one is not Status.CONVERGED])
def test_after_a_failure_nothing_is_suggested_but_its_mend(status, capsys):
    class Result:
        notices = ()
        json = headline = lambda self: "result"
        first_tables = tables = lambda self: ()

    advice = [SuggestedCommand("Next, to go on", "minimax-cal go")]
    output = CommandOutput(keep="fit.json")
    assert output.write_and_print_result(Result(), status=status, advice=advice) == 1
    out, err = capsys.readouterr()
    assert "Next" not in out
    assert "minimax-cal go" not in out
    assert status.advice[:40] in err
    assert output.write_and_print_result(Result(), advice=advice) == 0
    assert "minimax-cal go" in capsys.readouterr().out


def test_a_diagnosis_that_was_not_written_suggests_the_same_calibration():
    fit = Namespace(seed=0)
    usual = vars(DiagnosisOptions())
    names = ("seed", "holdout", "holdout_by", "instrument")
    settings = {name: usual.get(name) for name in names}
    diagnosis = Namespace(main_findings=(fit,), status=Status.CONVERGED,
                          provenance=Namespace(settings=settings))  # fmt: skip
    lists = [
        list(suggest_next_commands(diagnosis, "arm.json", (Path("a b.csv"),), path, False))
        for path in (None, Path("diagnosis.json"))
    ]
    fits = [one.command for each in lists for one in each if " calibrate " in one.command]
    assert fits[0] == fits[1]
    assert "--effects diagnosis.json" in fits[0]
    assert lists[0][0].command == "add -o diagnosis.json"
