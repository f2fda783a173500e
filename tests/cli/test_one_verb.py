"""`calibrate` and `diagnose` take any instrument's files: as the verb of each kind does."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import run

import minimax_cal as mc
from experiments.pixel_cells import board_points, make_cell, write_cell
from experiments.relative import SIMULATORS, Arm
from minimax_cal.instruments import write_relative
from minimax_cal.robots.sampling import random_poses

KINDS = {"wires_3": "distances", "closures_known": "closures", "poses": "poses"}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A file of each kind, of an arm that bends."""
    folder, arm = tmp_path_factory.mktemp("any"), Arm.of("irb2600", 1, 3e-7)
    out = {}
    for kind in KINDS:
        out[kind] = folder / f"{kind}.csv"
        seen = SIMULATORS[kind](arm, np.random.default_rng(2), 80, 15e-6)
        write_relative(out[kind], seen.data)
    rng = np.random.default_rng(3)
    q = random_poses(arm.robot, 80, rng)
    out["tracker"] = folder / "tracker.csv"
    mc.write_measurements(
        out["tracker"], mc.measurements(q, arm.place(q) + 15e-6 * rng.normal(size=(80, 3)))
    )
    return out


def answered(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[Any, list[str]]:
    """The JSON of a command without its time, and its lines of stderr."""
    assert run(*arguments, "--json") == 0
    out, err = capsys.readouterr()
    return json.loads(out), err.splitlines()


def alike(one: Any, other: Any) -> None:
    """The same but for the time, and for how machine code rounds."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one.keys() - {"seconds"}:
            alike(one[key], other[key])
    elif isinstance(one, list):
        for mine, its in zip(one, other, strict=True):
            alike(mine, its)
    else:
        assert one == (
            pytest.approx(other, rel=1e-6, abs=1e-9) if isinstance(one, float) else other
        )


@pytest.mark.parametrize("kinds", [*([kind] for kind in KINDS), ["tracker", "wires_3"]])
def test_one_verb_calibrates_all(
    kinds: list[str], files: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    given = [files[kind] for kind in kinds]
    found, said = answered(capsys, "calibrate", "irb2600", *given, "--seed", 3)
    alike(found, answered(capsys, "relative", "irb2600", *given, "--seed", 3)[0])
    held = [f"{files[kind]} holds {KINDS.get(kind, 'points')}" for kind in kinds]
    assert said[: len(kinds)] == [f"taken: {each} at 80 poses" for each in held]
    by_python = json.loads(mc.calibrate("irb2600", given, seed=3).json())
    alike(by_python["parameters"], found["parameters"])


@pytest.mark.parametrize("column", ["socket", "surface", "wire_tension", "flange_load"])
def test_points_stay_points_beside_others(column, files, tmp_path, capsys):
    """What a file is does not depend on its neighbours."""
    more = tmp_path / "more.csv"
    header, *rows = files["tracker"].read_text().splitlines()
    more.write_text("\n".join([f"{header},{column}", *(f"{row},3" for row in rows)]) + "\n")
    _, alone = answered(capsys, "calibrate", "irb2600", more, "--objective", "sum")
    found, beside = answered(capsys, "calibrate", "irb2600", more, files["wires_3"])
    assert alone[0] == beside[0] == f"taken: {more} holds points at 80 poses"
    assert [one["kind"] for one in found["instruments"]] == ["points", "distances"]


def test_nothing_and_sets_without_files_are_refused():
    for verb in (mc.calibrate, mc.diagnose):
        with pytest.raises(mc.DataError, match="no file of measurements is given"):
            verb("irb2600", [])
    data = mc.simulate("irb2600", 20, 1, seed=1).data
    with pytest.raises(mc.DataError, match="give their files"):
        mc.calibrate("irb2600", [data, data])


def test_campaigns_of_a_tracker_stay_one_fit(
    files: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    found, said = answered(capsys, "calibrate", "irb2600", files["tracker"], "--objective", "sum")
    assert found["kind"] == "calibration"
    assert said[0] == f"taken: {files['tracker']} holds points at 80 poses"


@pytest.mark.parametrize(
    ("kind", "options", "said"),
    [
        ("wires_3", ["--objective", "point"], "--objective is for points of a tracker"),
        ("wires_3", ["--objective", "minimax"], "--objective is for points of a tracker"),
        ("wires_3", ["--figure", "x.png"], "x.png: a picture is of points of a tracker alone"),
        ("wires_3", ["-o", "x.png"], "x.png: a picture is of points of a tracker alone"),
        ("wires_3", ["--bootstrap", "20"], "--bootstrap is for points of a tracker"),
        ("wires_3", ["--known-distance", "A,B,500"], "--known-distance is for closures"),
        ("tracker", ["--offset"], "--offset is for distances"),
        ("tracker", ["--noise", "tracker=0.1"], "--noise is for several instruments"),
        ("tracker", ["--camera-on", "flange"], "--camera-on is about what cameras see"),
    ],
)
def test_what_an_instrument_has_no_use_for_is_refused_in_one_line(
    kind: str,
    options: list[str],
    said: str,
    files: dict[str, Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run("calibrate", "irb2600", files[kind], *options) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {said}")


def test_one_verb_diagnoses_all(files: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    found, said = answered(capsys, "diagnose", "irb2600", files["poses"])
    alike(found, answered(capsys, "relative", "irb2600", files["poses"], "--diagnose")[0])
    assert found["diagnosis"]["effects"][0]["effect"] == "joint_compliance"
    assert said[0] == f"taken: {files['poses']} holds poses at 80 poses"
    assert run("diagnose", "irb2600", files["poses"], "--quick") == 2
    assert "--quick is for points of a tracker" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["wires_3", "poses"])
def test_a_fit_is_judged_by_any_instrument(
    kind: str, files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What the instrument has of its own is fitted, so that all of it is what the arm leaves."""
    fit = tmp_path / "fit.json"
    made, _ = answered(capsys, "calibrate", "irb2600", files[kind], "-o", fit)
    found, said = answered(capsys, "evaluate", fit, files[kind])
    spent = found["accuracy"]["sse_mm2"], made["accuracy"]["train"]["sse_mm2"]
    assert sum(spent[1]) < sum(spent[0])
    assert found["accuracy"]["rms_mm"] < 1.2 * made["accuracy"]["holdout"]["rms_mm"]
    assert found["training_poses"] == 80
    assert any("the fit was made of these rows" in line for line in said)
    drawn, _ = answered(capsys, "evaluate", fit, files[kind], "--step", 0)
    assert drawn["accuracy"]["rms_mm"] > 5.0 * found["accuracy"]["rms_mm"]
    by_tracker = tmp_path / "tracker.json"
    answered(capsys, "calibrate", "irb2600", files["tracker"], "-o", by_tracker)
    other, _ = answered(capsys, "evaluate", by_tracker, files[kind])
    assert other["accuracy"]["rms_mm"] < 0.2 * drawn["accuracy"]["rms_mm"]
    assert other["training_poses"] == 0
    assert run("evaluate", fit, files[kind], "--new-frame") == 2
    assert "--new-frame is for points of a tracker" in capsys.readouterr().err
    with pytest.raises(mc.DataError, match="one file at a time"):
        mc.evaluate(fit, [files["wires_3"], files["poses"]])
    wrong = tmp_path / "wrong.json"
    made["robot"] = mc.load_robot("ur10").to_dict()
    wrong.write_text(json.dumps(made))
    _, said = answered(capsys, "evaluate", wrong, files[kind])
    assert any("the fit misses by" in line for line in said)


def test_detections_are_data_where_cameras_are_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = make_cell(np.random.default_rng(2), points=board_points((6, 5), 0.04), poses=30)
    pixels, detections, *rest = write_cell(cell, tmp_path)
    assert pixels == "--pixels"
    found, _ = answered(capsys, "calibrate", "ur5", detections, *rest)
    alike(found, answered(capsys, "calibrate", "ur5", pixels, detections, *rest)[0])
    beside = tmp_path / "tracker.csv"
    mc.write_measurements(beside, mc.simulate(cell.drawn, 30, 1, seed=1).data)
    assert run("calibrate", "ur5", beside, detections, *rest, "--drawn-prior") == 2
    assert "--drawn-prior is for pixels alone" in capsys.readouterr().err
    assert run("calibrate", "ur5", detections) == 2
    assert "cameras need all three of --pixels" in capsys.readouterr().err
