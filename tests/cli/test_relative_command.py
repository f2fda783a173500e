"""`minimax-cal relative`: exit codes, one line of error, JSON that others can read."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import run

import minimax_cal as mc
from experiments.relative import SIMULATORS, Arm
from minimax_cal.instruments import write_relative
from minimax_cal.robots.robot import robot_from_dict
from minimax_cal.robots.sampling import random_poses


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A file of each kind, and the known distance of the closures as an option says it."""
    folder, arm = tmp_path_factory.mktemp("relative"), Arm.of("irb2600", 1, 0.0)
    out = {}
    for kind in ("wires_3", "closures_known", "poses"):
        seen = SIMULATORS[kind](arm, np.random.default_rng(2), 80, 15e-6)
        out[kind] = folder / f"{kind}.csv"
        write_relative(out[kind], seen.data)
        for first, second, length in seen.known:
            out["known"] = Path(f"{first},{second},{1e3 * length:.4f}")
    q = random_poses(arm.robot, 80, np.random.default_rng(3))
    for name, unit in (("tracker", 1.0), ("tracker_m", 1e-3)):
        out[name] = folder / f"{name}.csv"
        mc.write_measurements(out[name], mc.measurements(q, unit * arm.place(q)))
    return out


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
def test_tables_on_stdout_and_notices_on_stderr(kind, words, said, files, capsys):
    assert run("relative", "irb2600", files[kind], "--details") == 0
    out, err = capsys.readouterr()
    text = " ".join(out.split())
    for some in (*words, "held out, nominal", "held out, calibrated", "not identified because"):
        assert some in text
    assert said in err
    assert "\x1b" not in out + err  # no colour codes into a pipe
    assert run("relative", "irb2600", files[kind], "--quiet") == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("kind", ["wires_3", "closures_known", "poses"])
def test_json_alone_on_stdout_and_the_same_in_the_file(kind, files, tmp_path, capsys):
    path = tmp_path / "fit.json"
    assert run("relative", "irb2600", files[kind], "--json", "-o", path) == 0
    text = capsys.readouterr().out
    assert text == path.read_text()
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


def test_options_reach_the_fit(files, capsys):
    more = ("--holdout", 0.3, "--seed", 7, "--fix", "a2,beta*", "--free", "d1", "--json", "-q")
    assert run("relative", "irb2600", files["wires_3"], "--offset", *more) == 0
    content = json.loads(capsys.readouterr().out)
    told = {p["name"]: p for p in content["parameters"]}
    assert told["a2"]["reason"] == "fixed by the user"
    assert told["d1"]["identifiable"]
    assert told["offset2"]["identifiable"]
    assert set(content["instrument"]["offsets_mm"]) == {"wire1", "wire2", "wire3"}
    assert content["accuracy"]["holdout"]["poses"] == 24
    assert content["provenance"]["settings"]["seed"] == 7
    assert (
        run(
            "relative",
            "irb2600",
            files["closures_known"],
            "--known-distance",
            files["known"],
            "--method",
            "nlgn",
            "--json",
        )
        == 0
    )
    content = json.loads(capsys.readouterr().out)
    assert content["identified"] == 21
    assert content["instrument"]["scale"] == "known distance"
    assert run("relative", "irb2600", files["poses"], "--lever", 250, "--json", "-q") == 0
    assert json.loads(capsys.readouterr().out)["instrument"]["lever_mm"] == pytest.approx(250.0)


@pytest.mark.parametrize(
    ("arguments", "say"),
    [
        (("irb2600", "nowhere.csv"), "nowhere.csv: cannot be read"),
        (("irb9000", "wires_3"), "no robot called 'irb9000'"),
        (("scara_600", "wires_3"), "has 6 joint columns"),
        (("irb2600", "wires_3", "--holdout", "2"), "not a fraction"),
        (("irb2600", "wires_3", "--fix", "a9"), "no parameter called 'a9'"),
        (("irb2600", "wires_3", "--known-distance", "A,B"), "write two sockets and a length"),
        (("irb2600", "wires_3", "--known-distance", "A,B,5"), "--known-distance is for closures"),
        (("irb2600", "closures_known", "--lever", "5"), "--lever is for poses"),
        (("irb2600", "poses", "--offset"), "--offset is for distances"),
        (("irb2600", "tracker"), "it holds reflectors: use minimax-cal calibrate"),
        (("irb2600", "wires_3", "wires_3"), "is given twice"),
        (("irb2600", "wires_3", "tracker_m"), "points look like metres given as millimetres"),
        (("irb2600", "poses", "--lever", "lots"), "--lever"),
        (("irb2600", "wires_3", "-o", "no/such/folder/fit.json"), "there is no such folder"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(arguments, say, files, capsys):
    assert run("relative", *(files.get(a, a) for a in arguments)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    lines = [line for line in err.splitlines() if not line.startswith("notice:")]
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    assert say in lines[0]


@pytest.mark.parametrize(
    ("kind", "column", "cell", "say"),
    [
        ("wires_3", "wire2_mm", "-3", ":4: column wire2_mm: -3 is no length"),
        ("wires_3", "wire2_mm", "nan", ":4: column wire2_mm: nan is not a finite number"),
        ("wires_3", "q3_rad", "", ":4: column q3_rad: is empty"),
        ("wires_3", "q3_rad", "170", ":4: joint 3 at 170.0 rad is more than two turns"),
        ("closures_known", "socket", "lonely", ":4: column socket: 'lonely' is visited once"),
        ("poses", "flange_ry_rad", "", ":4: some of the flange's columns are empty"),
    ],
)
def test_a_bad_cell_is_named_by_line_and_column(kind, column, cell, say, files, tmp_path, capsys):
    lines = files[kind].read_text().splitlines()
    cells = lines[3].split(",")
    cells[lines[0].split(",").index(column)] = cell
    path = tmp_path / "bad.csv"
    path.write_text("\n".join([*lines[:3], ",".join(cells), *lines[4:]]))
    assert run("relative", "irb2600", path) == 2
    assert capsys.readouterr().err.startswith(f"error: {path}{say}")


def test_numbers_that_do_not_work_out_are_exit_code_1(files, tmp_path, capsys):
    # lengths under the joint values of other poses: no geometry explains them
    header, *lines = files["wires_3"].read_text().splitlines()[:41]
    cells = [line.split(",") for line in lines]
    order = np.random.default_rng(0).permutation(len(cells))
    mixed = [",".join(row[:6] + cells[k][6:]) for row, k in zip(cells, order, strict=True)]
    path = tmp_path / "mixed.csv"
    path.write_text("\n".join([header, *mixed]))
    assert run("relative", "irb2600", path, "-o", tmp_path / "fit.json") == 1
    out, err = capsys.readouterr()
    assert "held out, calibrated" in " ".join(out.split())
    assert "the nominal robot misses by" in err
    assert err.splitlines()[-1].startswith("error: failed: ")
    assert not (tmp_path / "fit.json").exists()


def test_a_diagnosis_of_two_files_is_reported(files, tmp_path, capsys):
    result, page = tmp_path / "relative.json", tmp_path / "relative.html"
    given = ("relative", "irb2600", files["wires_3"], files["tracker"], "--diagnose")
    assert run(*given, "-o", result, "--quiet") == 0
    said = capsys.readouterr().out
    assert "No cause beyond geometry was found." in said
    assert "wires_3 RMS mm" in said
    assert json.loads(result.read_text())["diagnosis"]["verdict"] == "none"
    assert run("report", result, "-o", page, "--quiet") == 0
    text = page.read_text()
    assert 'id="diagnosis"' in text
    assert "No cause beyond geometry was found." in text
    assert run("export", result, "--to", "dh-csv", "-o", tmp_path / "arm.csv", "--quiet") == 0


def test_without_needs_diagnose(files, capsys):
    assert run("relative", "irb2600", files["wires_3"], "--without", "backlash") == 2
    assert "--without is of --diagnose" in capsys.readouterr().err
