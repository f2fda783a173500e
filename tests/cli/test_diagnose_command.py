import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run

import minimax_cal as mc
from minimax_cal.diagnosing.result import VERDICTS, load_diagnosis
from minimax_cal.modelling.effects.table import EFFECTS
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.reporting import tables


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A UR10 that gives way under gravity, measured."""
    made = simulate(mc.load_robot("ur10"), 60, 3, seed=1, truth=Truth(compliance=2e-6))
    where = tmp_path_factory.mktemp("gap")
    mc.write_measurements(where / "gap.csv", replace(made.data, simulated=False))
    return where


@pytest.fixture
def here(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "gap.csv").symlink_to(folder / "gap.csv")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_details_are_words_then_tables(here, capsys):
    options = ("--seed", 3, "--holdout", 0.3, "--quick", "--details", "-o", "gap.json")
    assert run("diagnose", "ur10", "gap.csv", *options) == 0
    out, err = capsys.readouterr()
    found = load_diagnosis("gap.json")
    assert (found.provenance.settings["seed"], found.provenance.settings["holdout"]) == (3, 0.3)
    assert found.held.sum() == 18  # of 60
    assert " ".join(out.split()).startswith(" ".join(found.headline().split()))
    assert max(map(len, out.splitlines())) <= 110
    titles = (
        "step by step",
        "effects found",
        "error after geometry, by target",
        "by target",
        "rotations of each joint",
    )
    places = [out.index(title) for title in titles]
    assert places == sorted(places)
    assert f"{found.ladder[-1].holdout.rms_mm:.4f}" in out
    assert "\x1b" not in out + err
    taken, notice, written = err.splitlines()
    assert taken == "taken: gap.csv holds points at 60 poses"
    assert notice.startswith("notice: only 18 poses are held out")
    assert written == "written: gap.json"


def test_json_is_alone_and_as_agreed(here, capsys):
    files = ("-o", "gap.json", "--figure", "gap.png")
    assert run("diagnose", "ur10", "gap.csv", "--quick", "--json", "-q", *files) == 0
    out, err = capsys.readouterr()
    assert err == ""
    picture = Path("gap.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert len(picture) > 20_000
    content = json.loads(out)
    kept = json.loads((here / "gap.json").read_text())
    assert content["kind"] == "diagnosis"
    assert {**kept, "seconds": 0} == {**content, "seconds": 0}
    assert content["verdict"] in VERDICTS
    assert content["effects"][0]["effect"] == "joint_compliance"
    for effect in content["effects"]:
        assert effect.keys() >= {
            "effect", "place", "share", "parameters", "holdout_rms_mm", "alternatives"
        }  # fmt: skip
        assert effect["holdout_rms_mm"].keys() == {"before", "after"}
        for parameter in effect["parameters"]:
            assert parameter.keys() == {"name", "value", "sigma", "unit"}
        for other in effect["alternatives"]:
            assert other.keys() >= {"effect", "place", "rho2", "separate_with"}
    gap = content["gap"]
    for kind in ("holdout_rms_mm", "holdout_max_mm"):
        assert gap[kind].keys() == {"nominal", "geometric", "final"}
    rms = gap["holdout_rms_mm"]
    assert rms["final"] < rms["geometric"] < rms["nominal"]
    assert gap["closed_ci95"][0] <= gap["closed"] <= gap["closed_ci95"][1]
    assert gap["noise_floor_mm"] > 0.0
    where = content["where"]
    assert where.keys() == {"by_target", "by_joint", "by_region", "by_order", "noise_mm"}
    assert all(entry.keys() == {"effect", "needs"} for entry in content["not_testable"])


def test_a_suspect_can_be_left_out(here, capsys):
    options = ("--without", "joint_compliance,link_bending", "--without", "base_flex")
    assert run("diagnose", "ur10", "gap.csv", *options, "--quick", "--json") == 0
    content = json.loads(capsys.readouterr().out)
    named = {e["effect"] for e in content["effects"]}
    named |= {a["effect"] for e in content["effects"] for a in e["alternatives"]}
    out = ["joint_compliance", "link_bending", "base_flex"]
    assert content["provenance"]["settings"]["exclude"] == out
    assert not named & set(out)


def test_notices_go_to_stderr_unless_quiet(here, capsys):
    header, *rows = Path("gap.csv").read_text().splitlines()
    noted = [f"{header},colour", *(f"{row},red" for row in rows)]
    Path("noted.csv").write_text("\n".join(noted) + "\n")
    assert run("diagnose", "ur10", "noted.csv", "--quick", "--json") == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["notices"]
    assert "notice: " in err
    assert "colour" in err
    figure = ("--figure", "gap.svg")
    assert run("diagnose", "ur10", "noted.csv", "--quick", "--json", "--quiet", *figure) == 0
    assert capsys.readouterr().err == ""
    assert Path("gap.svg").read_bytes().startswith(b"<?xml")


@pytest.mark.parametrize(
    ("arguments", "say"),
    [
        (("diagnose", "ur10", "gap.csv", "--without", "rust"), "joint_compliance"),
        (("diagnose", "ur10", "gap.csv", "--holdout", "0"), "no pose is held out"),
        (("diagnose", "ur10", "gap.csv", "--holdout", "1"), "fraction"),
        (("diagnose", "ur10", "gap.csv", "--seed", "-1"), "seed -1"),
        (("diagnose", "ur10", "absent.csv"), "absent.csv"),
        (("diagnose", "ur10", "bad.csv"), "bad.csv:3"),
        (("diagnose", "ur11", "gap.csv"), "ur10"),
        (("diagnose", "ur10", "gap.csv", "--figure", "x.bmp"), ".png, .svg, .pdf"),
        (("diagnose", "ur10", "gap.csv", "-o", "no/x.json"), "no such folder"),
        (("diagnose", "ur10", "gap.csv", "--figure", "no/x.png"), "no such folder"),
        (("diagnose", "ur10"), "DATA"),
        (("calibrate", "ur10", "gap.csv", "--effects", "rust:J1"), "no effect 'rust'"),
        (("calibrate", "ur10", "gap.csv", "--effects", "backlash:J9"), "no place 'J9'"),
        (("effects", "ur10"), "both ROBOT and DATA"),
        (("effects", "ur10", "absent.csv"), "absent.csv"),
    ],
)
def test_wrong_input_is_one_line_and_exit_2(arguments, say, here, capsys):
    lines = Path("gap.csv").read_text().splitlines()
    cells = lines[2].split(",")
    (here / "bad.csv").write_text("\n".join([*lines[:2], ",".join(["oops", *cells[1:]])]))
    before = set(here.iterdir())
    assert run(*arguments) == 2
    out, err = capsys.readouterr()
    errors = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert say in errors[0]
    assert "Traceback" not in err
    assert out == ""
    assert set(here.iterdir()) == before


def test_numbers_that_break_down_are_exit_1(here, capsys, monkeypatch):
    def broken(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("minimax_cal.cli.diagnose.diagnose", broken)
    assert run("diagnose", "ur10", "gap.csv", "--quick", "-o", "gap.json") == 1
    out, err = capsys.readouterr()
    assert err.startswith("error: the numbers did not work out (Singular matrix)")
    assert out == ""
    assert not (here / "gap.json").exists()


def test_a_figure_needs_matplotlib_and_says_so(here, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert run("diagnose", "ur10", "gap.csv", "--figure", "gap.png") == 2
    out, err = capsys.readouterr()
    assert "pip install '.[plot]' in a clone" in err
    assert not out  # asked before the work
    assert not (here / "gap.png").exists()


def test_effects_reach_the_fit(here, capsys):
    options = ("--effects", "joint_compliance:J2,backlash:J3", "--effects", "joint_compliance:J3")
    assert run("calibrate", "ur10", "gap.csv", "--objective", "sum", *options, "--json") == 0
    content = json.loads(capsys.readouterr().out)
    asked = content["provenance"]["settings"]["effects"]
    assert asked == ["joint_compliance:J2", "backlash:J3", "joint_compliance:J3"]
    fitted = [f"{entry['effect']}:{entry['place']}" for entry in content["cell"]["effects"]]
    assert fitted == asked
    plain = mc.calibrate("ur10", "gap.csv", objective="sum").accuracy["holdout"].rms_mm
    assert content["accuracy"]["holdout"]["rms_mm"] < plain


def test_the_library_is_listed(here, capsys):
    assert run("effects") == 0
    out = capsys.readouterr().out
    assert all(name in out for name in EFFECTS)
    assert run("effects", "--json") == 0
    listed = {e["effect"]: e for e in json.loads(capsys.readouterr().out)["effects"]}
    assert not any("the file" in entry["needs"] for entry in listed.values())  # none was given
    assert listed.keys() == EFFECTS.keys()
    assert "order" in listed["settling"]["needs"]
    assert listed["backlash"]["law"] == EFFECTS["backlash"].law


def test_places_that_data_can_test(here, capsys):
    assert run("effects", "ur10", "gap.csv", "--json") == 0
    with_order = {e["effect"]: e for e in json.loads(capsys.readouterr().out)["effects"]}
    assert "J2" in with_order["joint_compliance"]["places"]
    assert "J1" not in with_order["joint_compliance"]["places"]  # its axis is upright
    assert with_order["target_shift"]["places"] == ["smr1", "smr2", "smr3"]
    data = mc.read_measurements("gap.csv")
    mc.write_measurements("one.csv", data.only(0))
    assert run("effects", "ur10", "one.csv") == 0
    out = capsys.readouterr().out
    rows = [line for line in out.splitlines() if "target_shift" in line]  # a part of a wide table
    assert not any("smr" in row for row in rows)
    assert any("a second target" in row for row in rows)


def test_tables_of_where_show_dashes_for_what_cannot_be_told():
    where = {
        "by_target": [
            {"target": "smr1", "points": 4, "rms_mm": 0.5, "max_mm": 1.0, "mean_sight_mm": None}
        ],
        "by_joint": [
            {"joint": "J1", "rms_mrad": 0.25, "follows": "its load", "share": 0.5, "p": 0.002},
            {"joint": "J2", "rms_mm": 0.75, "follows": "", "share": None, "p": None},
        ],
        "by_region": {"cells": []},
        "by_order": {"clock": {"place": "base", "follows": "time", "share": 0.5, "p": 0.3},
                     "temperature": None},
    }  # fmt: skip
    target, joint, trend = tables.where_tables(where)
    assert target.cells() == [["smr1", "4", "0.5000", "1.0000", "-", "", "-", "-"]]
    assert joint.cells() == [["J1", "mrad", "0.2500", "its load", "50", "< 0.005"],
                             ["J2", "mm", "0.7500", "", "-", "-"]]  # fmt: skip
    assert trend.cells() == [["visit order", "base", "time", "50", "0.3"]]


def test_what_cannot_be_tested_and_what_to_measure_next(folder):
    from dataclasses import replace

    from minimax_cal.diagnosing.result import Alternative

    found = mc.diagnose("ur10", folder / "gap.csv", quick=True)
    other = Alternative("base_flex", "frame", 0.9, 3.0, 1.0, "ten poses stretched out")
    first = replace(found.effects[0], alternatives=(other,))
    more = replace(found, effects=(first,), not_testable=(("settling", "the visit order"),))
    *_, further, needs = more.tables()
    assert needs.rows == (("settling", "the visit order"),)
    assert further.rows[0][1:] == ("base flex", 0.9, 3.0, 1.0, "ten poses stretched out")
    assert len(replace(more, effects=(), not_testable=()).tables()) == 1  # the ladder
