import json
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import minimax_cal as mc
from minimax_cal.diagnosing.diagnosis import VERDICTS, load_diagnosis
from minimax_cal.modelling.effects.table import EFFECTS
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.reporting import diagnosis_tables


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


def test_details_are_words_then_tables(here, says):
    options = ("--seed", 3, "--holdout", 0.3, "--quick", "--details", "-o", "gap.json")
    out, err = says("diagnose ur10 gap.csv", *options)
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


def test_json_is_alone_and_as_agreed(here, says):
    files = ("-o", "gap.json", "--figure", "gap.png")
    out, err = says("diagnose ur10 gap.csv --quick --json -q", *files)
    assert err == ""
    picture = Path("gap.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert len(picture) > 20_000
    content = json.loads(out)
    kept = json.loads((here / "gap.json").read_text())
    assert {**kept, "seconds": 0} == {**content, "seconds": 0}
    assert content["verdict"] in VERDICTS
    assert content["effects"][0]["effect"] == "joint_compliance"
    gap = content["gap"]
    rms = gap["holdout_rms_mm"]
    assert rms["final"] < rms["geometric"] < rms["nominal"]
    assert gap["closed_ci95"][0] <= gap["closed"] <= gap["closed_ci95"][1]
    assert gap["noise_floor_mm"] > 0.0
    where = content["where"]
    assert where.keys() == {"by_target", "by_joint", "by_region", "by_order", "noise_mm"}
    assert all(entry.keys() == {"effect", "needs"} for entry in content["not_testable"])


def test_a_suspect_can_be_left_out(here, answered):
    options = ("--without", "joint_compliance,link_bending", "--without", "base_flex")
    content = answered("diagnose ur10 gap.csv", *options, "--quick")
    named = {e["effect"] for e in content["effects"]}
    named |= {a["effect"] for e in content["effects"] for a in e["alternatives"]}
    out = ["joint_compliance", "link_bending", "base_flex"]
    assert content["provenance"]["settings"]["exclude"] == out
    assert not named & set(out)


def test_notices_go_to_stderr_unless_quiet(here, says):
    header, *rows = Path("gap.csv").read_text().splitlines()
    noted = [f"{header},colour", *(f"{row},red" for row in rows)]
    Path("noted.csv").write_text("\n".join(noted) + "\n")
    out, err = says("diagnose ur10 noted.csv --quick --json")
    assert json.loads(out)["notices"]
    assert "notice: " in err
    assert "colour" in err
    figure = ("--figure", "gap.svg")
    assert says("diagnose ur10 noted.csv --quick --json --quiet", *figure).err == ""
    assert Path("gap.svg").read_bytes().startswith(b"<?xml")


@pytest.mark.parametrize(
    ("arguments", "say"),
    [
        ("diagnose ur10 gap.csv --without rust", "joint_compliance"),
        ("diagnose ur10 gap.csv --holdout 0", "no pose is held out"),
        ("diagnose ur10 absent.csv", "absent.csv"),
        ("diagnose ur10 bad.csv", "bad.csv:3"),
        ("diagnose ur10 gap.csv --figure no/x.png", "no such folder"),
        ("diagnose ur10", "DATA"),
        ("effects ur10", "both ROBOT and DATA"),
    ],
)
def test_wrong_input_is_one_line_and_exit_2(arguments, say, here, refuses):
    lines = Path("gap.csv").read_text().splitlines()
    cells = lines[2].split(",")
    (here / "bad.csv").write_text("\n".join([*lines[:2], ",".join(["oops", *cells[1:]])]))
    before = set(here.iterdir())
    refuses(say, *shlex.split(arguments))
    assert set(here.iterdir()) == before


def test_numbers_that_break_down_are_exit_1(here, says, monkeypatch):
    def broken(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("minimax_cal.cli.diagnose.diagnose", broken)
    out, err = says("diagnose ur10 gap.csv --quick -o gap.json", code=1)
    assert err.startswith("error: the numbers did not work out (Singular matrix)")
    assert out == ""
    assert not (here / "gap.json").exists()


def test_a_figure_needs_matplotlib_and_says_so(here, says, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    out, err = says("diagnose ur10 gap.csv --figure gap.png", code=2)
    assert 'pip install ".[plot]" in a clone' in err
    assert not out  # asked before the work
    assert not (here / "gap.png").exists()


def test_effects_reach_the_fit(here, answered):
    options = ("--effects", "joint_compliance:J2,backlash:J3", "--effects", "joint_compliance:J3")
    content = answered("calibrate ur10 gap.csv --objective sum", *options)
    asked = content["provenance"]["settings"]["effects"]
    assert asked == ["joint_compliance:J2", "backlash:J3", "joint_compliance:J3"]
    fitted = [f"{entry['effect']}:{entry['place']}" for entry in content["cell"]["effects"]]
    assert fitted == asked
    plain = mc.calibrate("ur10", "gap.csv", objective="sum").accuracy["holdout"].rms_mm
    assert content["accuracy"]["holdout"]["rms_mm"] < plain


def test_the_library_is_listed(here, answered, says):
    out = says("effects").out
    assert all(name in out for name in EFFECTS)
    listed = {e["effect"]: e for e in answered("effects")["effects"]}
    assert not any("the file" in entry["needs"] for entry in listed.values())  # none was given
    assert listed.keys() == EFFECTS.keys()
    assert "order" in listed["settling"]["needs"]
    assert listed["backlash"]["law"] == EFFECTS["backlash"].law


def test_places_that_data_can_test(here, answered, says):
    with_order = {e["effect"]: e for e in answered("effects ur10 gap.csv")["effects"]}
    assert "J2" in with_order["joint_compliance"]["places"]
    assert "J1" not in with_order["joint_compliance"]["places"]  # its axis is upright
    assert with_order["target_shift"]["places"] == ["smr1", "smr2", "smr3"]
    data = mc.read_measurements("gap.csv")
    mc.write_measurements("one.csv", data.only(0))
    out = says("effects ur10 one.csv").out
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
    target, joint, trend = diagnosis_tables.build_error_location_tables(where)
    assert target.formatted_cells() == [["smr1", "4", "0.5000", "1.0000", "-", "", "-", "-"]]
    assert joint.formatted_cells() == [["J1", "mrad", "0.2500", "its load", "50", "< 0.005"],
                             ["J2", "mm", "0.7500", "", "-", "-"]]  # fmt: skip
    assert trend.formatted_cells() == [["visit order", "base", "time", "50", "0.3"]]


def test_what_cannot_be_tested_and_what_to_measure_next(folder):
    from dataclasses import replace

    from minimax_cal.diagnosing.diagnosis import AlternativeEffect

    found = mc.diagnose("ur10", folder / "gap.csv", quick=True)
    other = AlternativeEffect("base_flex", "frame", 0.9, 3.0, 1.0, "ten poses stretched out")
    first = replace(found.effects[0], alternatives=(other,))
    more = replace(found, effects=(first,), not_testable=(("settling", "the visit order"),))
    *_, further, needs = more.tables()
    assert needs.rows == (("settling", "the visit order"),)
    assert further.rows[0][1:] == ("base flex", 0.9, 3.0, 1.0, "ten poses stretched out")
    assert len(replace(more, effects=(), not_testable=()).tables()) == 1  # the ladder
