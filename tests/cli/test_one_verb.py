"""`calibrate` and `diagnose` take any instrument's files: as the verb of each kind does."""

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import run

import minimax_cal as mc
from experiments.pixel_cells import (
    PixelCell,
    board_corner_points,
    rms_arm_error_mm,
    simulate_pixel_cell,
    write_cell_files,
)
from experiments.relative import MEASUREMENT_SIMULATORS, ImperfectArm
from minimax_cal.instruments import write_relative
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.robot import robot_from_dict
from minimax_cal.validation.evaluation import evaluate

# ---- one verb ------------------------------------------------------------------------------------


KINDS = {"wires_3": "distances", "closures_known": "closures", "poses": "poses"}


def written(folder: Path, compliance: float) -> dict[str, Path]:
    """A file of each kind, and the known distance of the closures as an option says it."""
    arm, rng = ImperfectArm.draw("irb2600", 1, compliance), np.random.default_rng(3)
    out = {}
    for kind in KINDS:
        seen = MEASUREMENT_SIMULATORS[kind](arm, np.random.default_rng(2), 80, 15e-6)
        out[kind] = folder / f"{kind}.csv"
        write_relative(out[kind], seen.data)
        for first, second, length in seen.known:
            out["known"] = Path(f"{first},{second},{1e3 * length:.4f}")
    q = random_joint_values_above_floor(arm.robot, 80, rng)
    y = arm.target_positions(q) + 15e-6 * rng.normal(size=(80, 3))
    for name, unit in (("tracker", 1.0), ("tracker_m", 1e-3)):
        out[name] = folder / f"{name}.csv"
        mc.write_measurements(out[name], mc.measurements(q, unit * y))
    return out


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Of an arm that bends."""
    return written(tmp_path_factory.mktemp("any"), 3e-7)


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
def test_one_verb_calibrates_all(kinds, files, capsys):
    given = [files[kind] for kind in kinds]
    found, said = answered(capsys, "calibrate", "irb2600", *given, "--seed", 3)
    alike(found, answered(capsys, "relative", "irb2600", *given, "--seed", 3)[0])
    held = [f"{files[kind]} holds {KINDS.get(kind, 'points')}" for kind in kinds]
    assert said[: len(kinds)] == [f"taken: {each} at 80 poses" for each in held]
    by_python = json.loads(mc.calibrate("irb2600", given, seed=3).json())
    alike(by_python["parameters"], found["parameters"])


@pytest.mark.parametrize("column", ["socket", "wire_tension"])
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


@pytest.mark.parametrize(
    ("kind", "options", "said"),
    [
        ("wires_3", "--objective point", "--objective is for points of a tracker"),
        ("wires_3", "--figure x.png", "x.png: a picture is of points of a tracker alone"),
        ("wires_3", "--bootstrap 20", "--bootstrap is for points of a tracker"),
        ("wires_3", "--known-distance A,B,500", "--known-distance is for closures"),
        ("tracker", "--offset", "--offset is for distances"),
        ("tracker", "--noise tracker=0.1", "--noise is for several instruments"),
        ("tracker", "--camera-on flange", "--camera-on is about what cameras see"),
    ],
)
def test_what_an_instrument_has_no_use_for_is_refused_in_one_line(
    kind, options, said, files, refuses
):
    refuses(said, "calibrate irb2600", files[kind], *shlex.split(options))


def test_one_verb_diagnoses_all(files, capsys, refuses):
    found, said = answered(capsys, "diagnose", "irb2600", files["poses"])
    alike(found, answered(capsys, "relative", "irb2600", files["poses"], "--diagnose")[0])
    assert found["diagnosis"]["effects"][0]["effect"] == "joint_compliance"
    assert said[0] == f"taken: {files['poses']} holds poses at 80 poses"
    refuses("--quick is for points of a tracker", "diagnose irb2600", files["poses"], "--quick")


@pytest.mark.parametrize("kind", ["wires_3", "poses"])
def test_a_fit_is_judged_by_any_instrument(kind, files, tmp_path, capsys, refuses):
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
    refuses("--new-frame is for points of a tracker", "evaluate", fit, files[kind], "--new-frame")
    with pytest.raises(mc.DataError, match="one file at a time"):
        mc.evaluate(fit, [files["wires_3"], files["poses"]])
    wrong = tmp_path / "wrong.json"
    made["robot"] = mc.load_robot("ur10").to_dict()
    wrong.write_text(json.dumps(made))
    _, said = answered(capsys, "evaluate", wrong, files[kind])
    assert any("the fit misses by" in line for line in said)


def test_detections_are_data_where_cameras_are_given(cell, cell_files, tmp_path, capsys, refuses):
    pixels, detections, *rest = cell_files
    assert pixels == "--pixels"
    found, _ = answered(capsys, "calibrate", "ur5", detections, *rest)
    alike(found, answered(capsys, "calibrate", "ur5", pixels, detections, *rest)[0])
    beside = tmp_path / "tracker.csv"
    mc.write_measurements(beside, mc.simulate(cell.drawn, 30, 1, seed=1).data)
    given = ("calibrate ur5", beside, detections, *rest, "--drawn-prior")
    refuses("--drawn-prior is for pixels alone", *given)
    refuses("cameras need all three of --pixels", "calibrate ur5", detections)


# ---- relative command ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stiff_files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return written(tmp_path_factory.mktemp("relative"), 0.0)


@pytest.mark.parametrize(
    ("kind", "words", "said"),
    [
        ("wires_3", ["length of a wire", "wire3", "same motion as all anchors", "30 of 42"], ""),
        (
            "closures_known",
            ["ball about its socket", "closure has no length standard", "20 of 33"],
            "the scale is not identifiable",
        ),
        ("poses", ["position of the flange", "tool_rz", "RMS mrad", "30 of 42"], "a radian counts"),
    ],
)
def test_tables_or_json_on_stdout_and_notices_on_stderr(
    kind, words, said, stiff_files, tmp_path, says
):
    out, err = says("relative irb2600", stiff_files[kind], "--details")
    text = " ".join(out.split())
    for some in (*words, "held out, nominal", "held out, calibrated", "not identified because"):
        assert some in text
    assert said in err
    assert "\x1b" not in out + err  # no colour codes into a pipe
    path = tmp_path / "fit.json"
    text, err = says("relative irb2600", stiff_files[kind], "--json", "--quiet", "-o", path)
    assert (text, err) == (path.read_text(), "")
    content = json.loads(text)
    assert content["schema"] == 1
    assert content["kind"] == "relative calibration"
    assert content["status"] == "converged"
    before, after = (content["accuracy"][key]["rms_mm"] for key in ("nominal", "holdout"))
    assert after < 0.1 * before
    assert content["accuracy"]["holdout"]["numbers"] > 0
    assert (content["position_sigma_mm"] is None) == bool(content["positions_open"])
    identified = [p for p in content["parameters"] if p["identifiable"]]
    assert len(identified) == content["identified"]
    for p in content["parameters"]:
        assert (p["sigma"] is None) != p["identifiable"]
        assert ("reason" in p) != p["identifiable"]
        assert p["unit"] in ("mm", "rad")
    assert robot_from_dict(content["robot"]).joints == 6
    assert run("export", path, "--to", "dh-csv") == 0


def test_options_reach_the_fit(stiff_files, answered, says):
    more = ("--holdout", 0.3, "--seed", 7, "--fix", "a2,beta*", "--free", "d1", "--json", "-q")
    content = json.loads(says("relative irb2600", stiff_files["wires_3"], "--offset", *more).out)
    told = {p["name"]: p for p in content["parameters"]}
    assert told["a2"]["reason"] == "fixed by the user"
    assert told["d1"]["identifiable"]
    assert told["offset2"]["identifiable"]
    assert set(content["instrument"]["offsets_mm"]) == {"wire1", "wire2", "wire3"}
    assert content["accuracy"]["holdout"]["poses"] == 24
    assert content["provenance"]["settings"]["seed"] == 7
    known = ("--known-distance", stiff_files["known"], "--method", "nlgn")
    content = answered("relative irb2600", stiff_files["closures_known"], *known)
    assert content["identified"] == 21
    assert content["instrument"]["scale"] == "known distance"
    content = answered("relative irb2600", stiff_files["poses"], "--lever", 250, "-q")
    assert content["instrument"]["lever_mm"] == pytest.approx(250.0)


@pytest.mark.parametrize(
    ("arguments", "say"),
    [
        ("scara_600 wires_3", "has 6 joint columns"),
        ("irb2600 wires_3 --known-distance A,B", "write two sockets and a length"),
        ("irb2600 tracker", "it holds reflectors: use minimax-cal calibrate"),
        ("irb2600 wires_3 wires_3", "is given twice"),
        ("irb2600 wires_3 tracker_m", "points look like metres given as millimetres"),
        ("irb2600 poses --lever lots", "--lever"),
        ("irb2600 wires_3 --without backlash", "--without is of --diagnose"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(arguments, say, stiff_files, refuses):
    refuses(say, "relative", *(stiff_files.get(a, a) for a in shlex.split(arguments)))


def test_numbers_that_do_not_work_out_are_exit_code_1(stiff_files, tmp_path, says):
    # sockets under the joint values of other poses: all would close if the arm shrank to a point
    header, *lines = stiff_files["closures_known"].read_text().splitlines()
    cells = [line.split(",") for line in lines]
    order = np.random.default_rng(0).permutation(len(cells))
    mixed = [",".join(row[:6] + cells[k][6:]) for row, k in zip(cells, order, strict=True)]
    path = tmp_path / "mixed.csv"
    path.write_text("\n".join([header, *mixed]))
    out, err = says("relative irb2600", path, "-o", tmp_path / "fit.json", code=1)
    assert "held out, calibrated" in " ".join(out.split())
    assert "the nominal robot misses by" in err
    assert err.splitlines()[-1].startswith("error: failed: ")
    assert not (tmp_path / "fit.json").exists()


def test_a_diagnosis_of_two_files_is_reported(stiff_files, tmp_path, says):
    result, page = tmp_path / "relative.json", tmp_path / "relative.html"
    given = (stiff_files["wires_3"], stiff_files["tracker"], "--diagnose", "-o", result, "-q")
    said = says("relative irb2600", *given).out
    assert "No cause beyond geometry was found." in said
    assert "wires_3 RMS mm" in said
    assert json.loads(result.read_text())["diagnosis"]["verdict"] == "none"
    assert run("report", result, "-o", page, "--quiet") == 0
    text = page.read_text()
    assert 'id="budget"' in text
    assert "No cause beyond geometry was found." in text
    assert run("export", result, "--to", "dh-csv", "-o", tmp_path / "arm.csv", "--quiet") == 0


# ---- pixels command ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cell() -> PixelCell:
    return simulate_pixel_cell(
        np.random.default_rng(2), target_points=board_corner_points((6, 5), 0.04), pose_count=30
    )


@pytest.fixture(scope="module")
def cell_files(cell: PixelCell, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The options that read a cell."""
    return write_cell_files(cell, tmp_path_factory.mktemp("cell"))


def test_pixels_to_urdf(cell, cell_files, tmp_path, answered):
    result = tmp_path / "fit.json"
    content = answered("calibrate", "ur5", *cell_files, "-o", result)
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
    assert rms_arm_error_mm(cell, arm) < 0.03
    assert run("export", result, "--to", "urdf", "-o", tmp_path / "arm.urdf") == 0
    assert rms_arm_error_mm(cell, mc.load_robot(tmp_path / "arm.urdf")) < 0.03
    assert run("report", result, "-o", tmp_path / "report.html") == 0
    assert "Pixels: RMS error" in (tmp_path / "report.html").read_text()
    made = mc.simulate(cell.true, 30, 3, seed=1)
    before, after = (evaluate(result, made.data, rung).rms_mm for rung in (0, 1))
    assert after < 0.5 * before


def test_tables_say_what_pixels_do_not(cell_files, says):
    out, err = says("calibrate ur5", *cell_files, "--fix-camera", "--details")
    text = " ".join(out.split())
    for words in ("determine a position of the arm to", "RMS px", "drawn_within", "board_rz"):
        assert words in text
    assert "the lenses are held as their files say" in err


def test_the_worst_target_by_a_named_backend(cell, cell_files, tmp_path, answered):
    result = tmp_path / "fit.json"
    chosen = ("--objective", "minimax", "--qp", "quadprog")
    content = answered("calibrate", "ur5", *cell_files, *chosen, "-o", result)
    assert (content["objective"], content["qp"]) == ("minimax", "quadprog")
    assert content["answered"].keys() == {"quadprog"}
    worst = content["minimax"]
    assert max(worst["rms_px"]) < worst["sum_largest_rms_px"]
    assert len(worst["functions"]) == len(cell.names)
    assert run("report", result, "-o", tmp_path / "report.html", "--appendix") == 0
    assert "what decides the minimax" in (tmp_path / "report.html").read_text()


def test_the_drawn_arm_is_kept_where_it_is_known_better(cell, cell_files, tmp_path, refuses, says):
    drawn = mc.load_robot("ur5").to_dict() | {"drawn_within": {"mm": 1e-3, "mrad": 1e-3}}
    robot, result = tmp_path / "robot.json", tmp_path / "fit.json"
    robot.write_text(json.dumps(drawn))
    assert (
        "no_better: the drawing is known better"
        in says("calibrate", robot, *cell_files, "-o", result, code=1).err
    )
    content = json.loads(result.read_text())
    assert content["status"] == "no_better"
    assert content["robot"]["joints"] == drawn["joints"]
    assert content["robot"]["drawn_within"] == {"mm": 1e-3, "mrad": 1e-3}
    assert run("report", result, "-o", tmp_path / "report.html") == 0
    refuses("--keep-anyway", "export", result, "--to", "urdf", "-o", tmp_path / "arm.urdf")
    kept = ("export", result, "--to", "urdf", "-o", tmp_path / "arm.urdf", "--keep-anyway")
    assert run(*kept) == 0
    assert rms_arm_error_mm(cell, mc.load_robot(tmp_path / "arm.urdf")) < 0.03


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("", "Missing argument 'DATA...', or --pixels with --joints and --camera"),
        ("--pixels d.csv", "cameras need all three of --pixels, --joints and --camera"),
        ("d.csv --pixels d.csv", "d.csv: cannot be read"),
        ("--pixels d --joints j --camera left", "--camera left: give a name"),
        ("--pixels d --joints j --camera a=b --trim 0.1", "--trim is not "),
        ("--pixels d --joints j --camera a=b --objective pose", "for pixels"),
        ("--pixels d --joints j --camera a=b --camera a=c", "name twice"),
        ("--pixels d --joints j --camera a=b --camera-on x", "--camera-on"),
        ("--pixels d --joints j --camera a=b --camera-prior x", "write f"),
        ("--pixels d --joints j --camera a=b", "b: cannot be read"),
    ],
)
def test_wrong_input_is_one_line(given, said, refuses):
    refuses(said, "calibrate ur5", *shlex.split(given))


@pytest.mark.parametrize("command", ["calibrate", "relative"])
def test_options_of_cameras_without_any(command, tmp_path, refuses):
    given = (command, "irb120", tmp_path / "data.csv", "--camera-prior", "f 1%")
    refuses("--camera-prior is about what cameras see, with --pixels", *given)
