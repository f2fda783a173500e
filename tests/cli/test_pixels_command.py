"""`minimax-cal calibrate --pixels`: exit codes, one line of error, results that others take."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import run

import minimax_cal as mc
from experiments.pixel_cells import arm_error, board_points, make_cell, write_cell
from minimax_cal.judging.saved import evaluate

CELL = make_cell(np.random.default_rng(2), points=board_points((6, 5), 0.04), poses=30)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The options that read a cell."""
    return write_cell(CELL, tmp_path_factory.mktemp("cell"))


def test_pixels_to_urdf(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = tmp_path / "fit.json"
    assert run("calibrate", "ur5", *files, "--json", "-o", result) == 0
    content = json.loads(capsys.readouterr().out)
    assert content == json.loads(result.read_text())
    assert content["status"] == "converged"
    assert content["objective"] == "sum"
    assert content["set_aside"] == []
    for key in ("nominal", "train", "holdout", "nominal_train"):
        assert {"rms_mm", "max_mm", "poses", "sse_mm2", "rms_px"} <= set(content["accuracy"][key])
    assert content["accuracy"]["holdout"]["rms_px"] < 0.25
    assert content["arm_position"]["better"] is True
    assert {"name", "value", "nominal", "sigma", "unit"} <= set(content["parameters"][0])
    assert "camera_cam0_fx" in {p["name"] for p in content["parameters"]}
    arm = mc.load_robot(result)
    assert arm_error(CELL, arm) < 0.03
    assert run("export", result, "--to", "urdf", "-o", tmp_path / "arm.urdf") == 0
    assert arm_error(CELL, mc.load_robot(tmp_path / "arm.urdf")) < 0.03
    assert run("report", result, "-o", tmp_path / "report.html") == 0
    assert "Pixels: RMS error" in (tmp_path / "report.html").read_text()
    made = mc.simulate(CELL.true, 30, 3, seed=1)
    before, after = (evaluate(result, made.data, rung).rms_mm for rung in (0, 1))
    assert after < 0.5 * before


def test_tables_say_what_pixels_do_not(
    files: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("calibrate", "ur5", *files, "--fix-camera", "--details") == 0
    out, err = capsys.readouterr()
    text = " ".join(out.split())
    for words in ("determine a position of the arm to", "RMS px", "drawn_within", "board_rz"):
        assert words in text
    assert "the lenses are held as their files say" in err


def test_the_worst_target_by_a_named_backend(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = tmp_path / "fit.json"
    chosen = ("--objective", "minimax", "--qp", "quadprog")
    assert run("calibrate", "ur5", *files, *chosen, "--json", "-o", result) == 0
    content = json.loads(capsys.readouterr().out)
    assert (content["objective"], content["qp"]) == ("minimax", "quadprog")
    assert content["answered"].keys() == {"quadprog"}
    worst = content["minimax"]
    assert max(worst["rms_px"]) < worst["sum_largest_rms_px"]
    assert len(worst["functions"]) == len(CELL.names)
    assert run("report", result, "-o", tmp_path / "report.html") == 0
    assert "what decides the minimax" in (tmp_path / "report.html").read_text()


def test_the_drawn_arm_is_kept_where_it_is_known_better(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn = mc.load_robot("ur5").to_dict() | {"drawn_within": {"mm": 1e-3, "mrad": 1e-3}}
    robot, result = tmp_path / "robot.json", tmp_path / "fit.json"
    robot.write_text(json.dumps(drawn))
    assert run("calibrate", robot, *files, "-o", result) == 1
    assert "no_better: the drawing is known better" in capsys.readouterr().err
    content = json.loads(result.read_text())
    assert content["status"] == "no_better"
    assert content["robot"]["joints"] == drawn["joints"]
    assert content["robot"]["drawn_within"] == {"mm": 1e-3, "mrad": 1e-3}
    assert run("report", result, "-o", tmp_path / "report.html") == 0
    assert run("export", result, "--to", "urdf", "-o", tmp_path / "arm.urdf") == 2
    assert "--keep-anyway" in capsys.readouterr().err
    kept = ("export", result, "--to", "urdf", "-o", tmp_path / "arm.urdf", "--keep-anyway")
    assert run(*kept) == 0
    assert arm_error(CELL, mc.load_robot(tmp_path / "arm.urdf")) < 0.03


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ((), "Missing argument 'DATA...', or --pixels with --joints and --camera"),
        (("--pixels", "d.csv"), "cameras need all three of --pixels, --joints and --camera"),
        (("d.csv", "--pixels", "d.csv"), "d.csv: cannot be read"),
        (("--pixels", "d", "--joints", "j", "--camera", "left"), "--camera left: give a name"),
        (("--pixels", "d", "--joints", "j", "--camera", "a=b", "--trim", "0.1"), "--trim is not "),
        (
            ("--pixels", "d", "--joints", "j", "--camera", "a=b", "--objective", "pose"),
            "for pixels",
        ),
        (("--pixels", "d", "--joints", "j", "--camera", "a=b", "--camera", "a=c"), "name twice"),
        (("--pixels", "d", "--joints", "j", "--camera", "a=b", "--camera-on", "x"), "--camera-on"),
        (("--pixels", "d", "--joints", "j", "--camera", "a=b", "--camera-prior", "x"), "write f"),
        (("--pixels", "d", "--joints", "j", "--camera", "a=b"), "b: cannot be read"),
    ],
)
def test_wrong_input_is_one_line(
    given: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("calibrate", "ur5", *given) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err
    assert len(err.strip().splitlines()) == 1


@pytest.mark.parametrize("command", ["calibrate", "relative"])
def test_options_of_cameras_without_any(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(command, "irb120", tmp_path / "data.csv", "--camera-prior", "f 1%") == 2
    assert "--camera-prior is about what cameras see, with --pixels" in capsys.readouterr().err
