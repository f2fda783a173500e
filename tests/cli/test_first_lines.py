"""What a first screen says of files, failures and jumps: true, and fit to be carried out."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import capitalise_sentence


def write_apart(folder: Path, q: Array, points: Array, names: Array, order: Array) -> None:
    """Points and joints in files of their own, by name, the points in another order."""
    for name, header, rows in (
        ("joints", "name," + ",".join(f"q{i}_rad" for i in range(1, 7)), np.c_[names, q]),
        ("points", "name,x_mm,y_mm,z_mm", np.c_[names, points][order]),
    ):
        forms = ["%d", *["%.5f"] * (rows.shape[1] - 1)]
        np.savetxt(folder / f"{name}.csv", rows, forms, ",", header=header, comments="")


@pytest.fixture
def apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Array]:
    """A folder with points.csv and joints.csv, one reading stale; the order of the points."""
    robot, rng = mc.load_robot("ur5"), np.random.default_rng(8)
    q = rng.uniform(-2.0, 2.0, (40, 6)).round(5)
    points = 1e3 * (robot.pose(q)[:, :3, 3] + [5.0, 1.0, -0.3]) + 0.03 * rng.normal(size=(40, 3))
    points[17] = points[16]
    order = np.arange(40)[::-1]
    monkeypatch.chdir(tmp_path)
    write_apart(tmp_path, q, points, 100 + np.arange(40), order)
    return tmp_path, order


def test_a_stale_reading_is_where_the_point_stands_and_its_mend_runs(apart, says):
    folder, order = apart
    line = 2 + int(np.flatnonzero(order == 17)[0])
    said = says("calibrate ur5 points.csv joints.csv", code=2).err
    assert said.startswith(f"error: points.csv:{line}: ")
    command = said[said.index("minimax-cal import ") :].strip()
    assert run(*shlex.split(command)[1:]) == 0
    assert mc.read_measurements(folder / "mended.csv").poses == 39


def test_what_a_file_was_taken_for_names_the_one_with_the_points(apart, says):
    says("import points.csv --joints joints.csv --leave-out 19 -o mended.csv")
    joints, points = Path("joints.csv"), Path("points.csv")
    for path in (joints, points):  # without the stale pose
        rows = path.read_text().splitlines()
        path.write_text("\n".join(row for row in rows if not row.startswith("117,")) + "\n")
    told = says("calibrate ur5 points.csv joints.csv --objective sum", code=1).err.splitlines()
    assert told[0] == "taken: points.csv holds points at 39 poses"
    assert told[1] == "taken: joints.csv holds their joint values"


def test_a_stale_reading_of_a_campaign_is_in_its_own_file(tmp_path, says, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number in (1, 2):
        data = replace(mc.simulate("irb120", 30, 1, number).data, simulated=False)
        y = data.y.copy()
        if number == 2:
            y[9] = y[8]
        mc.write_measurements(tmp_path / f"part{number}.csv", data.with_y(y))
    said = says("calibrate irb120 part1.csv part2.csv", code=2).err
    assert said.startswith("error: part2.csv:11: ")
    assert "minimax-cal import part2.csv --leave-out 11 -o" in said


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("the arm moved.", "The arm moved."),
        ("re-seated at row 3", "Re-seated at row 3"),
        ("data/march.csv: 3 rows are torn.", "data/march.csv: 3 rows are torn."),
        ("march.csv: 3 rows are torn.", "march.csv: 3 rows are torn."),
        ("a2 by 3 mm", "a2 by 3 mm"),
        ("", ""),
    ],
)
def test_a_path_or_name_keeps_its_letters(text, said):
    assert capitalise_sentence(text) == said


def test_nothing_but_its_mend_follows_a_failure(tmp_path, says):
    """In the words of the terminal; in Python in those of Python."""
    robot = mc.load_robot("irb120")
    mdh = robot.mdh.copy()
    mdh[1, 0] *= 1.5
    data = replace(mc.simulate(robot.with_mdh(mdh), 60, 3, 1).data, simulated=False)
    mc.write_measurements(tmp_path / "data.csv", data)
    out, err = says("calibrate irb120", tmp_path / "data.csv", "--objective", "sum", code=1)
    assert "--allow-large-changes" in out
    assert "--allow-large-changes" in err.splitlines()[-1]
    assert "=True" not in out + err
    assert "minimax-cal " not in out
    assert "add -o" not in out
    with pytest.warns(mc.CalibrationWarning):
        fit = mc.calibrate("irb120", data, "sum")
    assert "allow_large_changes=True" in fit.reason


def test_effects_of_a_diagnosis_that_confirms_nothing(results, tmp_path, says):
    content = json.loads((results / "gap.json").read_text())
    assert content["effects"]
    for effect in content["effects"]:
        effect["established"] = False
    (tmp_path / "d.json").write_text(json.dumps(content))
    asked = ("calibrate ur10", results / "poses.csv", "--objective", "sum", "--effects")
    out, err = says(*asked, tmp_path / "d.json")
    assert "d.json: the diagnosis confirms no effect" in err
    assert "minimax-cal diagnose" not in out
    assert "confirms no effect" not in says(*asked, results / "gap.json").err


def test_one_jump_has_one_size(tmp_path):
    """That of the effect which the diagnosis fits; the residuals of a fit without it show less."""
    data = replace(mc.simulate("irb120", 80, 3, 3).data, simulated=False)
    y = data.y.copy()
    turn = Rotation.from_rotvec([0.0006, -0.0004, 0.0008]).as_matrix()
    y[45:] = y[45:] @ turn.T + [0.002, -0.002, 0.001]
    found = mc.diagnose("irb120", data.with_y(y))
    assert found.effects[0].term.effect == "session_jump"
    assert not [text for text in found.notices if "stand elsewhere" in text]
    alone = mc.diagnose("irb120", data.with_y(y), exclude=["session_jump"])
    assert [text for text in alone.notices if "stand elsewhere" in text]
