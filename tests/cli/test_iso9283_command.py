"""The commands `iso9283` and `map`: files in, tables, JSON and pictures out."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, invoked
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.cli.iso9283 import iso9283_command
from minimax_cal.cli.map import map_command
from minimax_cal.fitting.uncertainty import Uncertainty
from minimax_cal.modelling.parameters import ParameterNames
from minimax_cal.modelling.simulate import Simulation
from minimax_cal.selection.noise_model import Noise
from minimax_cal.validation.evaluation import open_saved_result

FAST = ("--samples", 2000, "--bins", 16)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fit")


@pytest.fixture(scope="module")
def poses(folder: Path, noisy: Simulation) -> Path:
    path = folder / "poses.csv"
    mc.write_measurements(path, noisy.data)
    return path


@pytest.fixture(scope="module")
def fit(folder: Path, poses: Path) -> Path:
    path = folder / "fit.json"
    mc.calibrate("irb2600", poses).save(path)
    return path


def values(*arguments: object) -> dict:
    code, out, _ = invoked(iso9283_command, *arguments, "--json")
    assert code == 0
    return dict(json.loads(out))


def without(fit: Path, folder: Path, *keys: str, **put: object) -> Path:
    """The fit's file without some keys, and with others."""
    content = {k: v for k, v in json.loads(fit.read_text()).items() if k not in keys} | put
    path = folder / "other.json"
    path.write_text(json.dumps(content))
    return path


def test_tables_on_stdout(fit):
    code, out, notes = invoked(iso9283_command, fit)
    assert code == 0
    assert not notes
    for words in ("by the formulas of ISO 9283", "held out", "training", "before", "after",
                  "AO' mean", "|AD| mean mm", "no test by ISO 9283", "30 cycles"):  # fmt: skip
        assert words in out
    assert "every pose" not in out
    assert "every pose" in invoked(iso9283_command, fit, "--poses")[1]


def test_held_out_stays_apart_as_in_the_fit(fit):
    told = json.loads(fit.read_text())["accuracy"]
    found = values(fit)["parts"]
    for part, keys in (("holdout", ("nominal", "holdout")), ("train", ("nominal_train", "train"))):
        for cell, key in zip(("before", "after"), keys, strict=True):
            every = found[part]["cells"][cell]["AP_target_mm"].values()
            assert sum(each["count"] for each in every) == sum(told[key]["points"])
            assert max(each["max"] for each in every) == pytest.approx(told[key]["max_mm"])
            mean = np.mean([each["mean"] for each in every])
            assert mean == pytest.approx(told[key]["mean_mm"])


def test_the_file_of_the_fit_says_the_same(fit, poses, tmp_path):
    own, named = values(fit), values(fit, poses)
    for part in ("holdout", "train"):
        assert len(own["parts"][part]["poses"]) == len(named["parts"][part]["poses"])
        for cell in ("before", "after"):
            for key in ("AP_mm", "AO_angle_mrad"):
                pair = [v["parts"][part]["cells"][cell][key] for v in (own, named)]
                assert pair[0] == pytest.approx(pair[1])
    moved = tmp_path / "copy.csv"
    moved.write_text(poses.read_text() + "\n")  # another file with the same poses
    again = values(fit, moved)
    assert again["parts"]["holdout"]["cells"] == named["parts"]["holdout"]["cells"]
    assert any("is not the file of the fit; 48 of its 60 rows" in n for n in again["notices"])


def test_a_nominal_arm_is_placed_where_the_fit_placed_it(fit):
    """A robot that is named is placed as the fit placed its own."""
    told = values(fit)["parts"]["holdout"]["cells"]["before"]["AP_mm"]
    found = values(fit, "--nominal", "irb2600")
    assert any("is placed where it fits 48 poses best" in notice for notice in found["notices"])
    assert found["parts"]["holdout"]["cells"]["before"]["AP_mm"] == pytest.approx(told)


def test_new_poses_are_all_held_out(fit, poses, tmp_path, noisy, rng):
    q = np.tile(noisy.data.q[:5] + 0.02, (6, 1))
    y = noisy.cell.predict(q) + 2e-5 * rng.normal(size=(30, 3, 3))
    labels = np.tile([f"P{i}" for i in range(1, 6)], 6)
    path = tmp_path / "again.csv"
    mc.write_measurements(path, mc.measurements(q, y, pose=labels, order=np.arange(30)))
    out = tmp_path / "iso.json"
    code, text, notes = invoked(iso9283_command, fit, path, "-o", out)
    assert code == 0
    assert "0 of its 30 rows" in notes
    content = json.loads(out.read_text())
    assert list(content["parts"]) == ["holdout"]
    assert [p["visits"] for p in content["parts"]["holdout"]["poses"]] == [6] * 5
    assert f"{content['parts']['holdout']['poses'][0]['RP_all_mm']:.4f}" in text
    assert invoked(iso9283_command, fit, path, "-q")[2] == ""


def test_tcp_by_name_and_by_place(fit):
    spot = json.loads(fit.read_text())["targets_mm"]["smr2"]
    named = values(fit, "--tcp", "smr2")["parts"]["holdout"]["cells"]["after"]["AP_mm"]
    there = values(fit, "--tcp", ",".join(map(str, spot)))["parts"]["holdout"]["cells"]["after"]
    # the same but for what the triangle's own shape is off
    assert there["AP_mm"]["rms"] == pytest.approx(named["rms"], abs=0.02)


@pytest.mark.parametrize(
    ("command", "arguments", "words"),
    [
        (iso9283_command, "--tcp smr9", "no TCP 'smr9'"),
        (iso9283_command, "--tcp 1,2,x", "give centroid, a target, or X,Y,Z in mm"),
        (iso9283_command, "--nominal scara_600", "6 joint columns"),
        (iso9283_command, "--nominal irb26", "no robot called"),
        (iso9283_command, "-o /nowhere/iso.json", "no such folder"),
        (map_command, "-o map.gif", "ending must be one of"),
        (map_command, "--samples 3", "samples 3"),
        (map_command, "--bins 1", "bins 1"),
        (map_command, "--slab -5", "slab over 0"),
        (map_command, "--height 9e6", "the arm does not come there"),
        (map_command, "--seed -1", "seed -1"),
    ],
)
def test_mistakes_are_one_line(fit, command, arguments, words):
    code, out, message = invoked(command, fit, *shlex.split(arguments))
    assert code == 2
    assert not out
    assert words in message
    assert "\n" not in message


def test_files_that_are_no_fit(fit, folder, poses):
    for path, words in (
        (poses, "is not JSON"),
        (folder / "none.json", "cannot be read"),
        (without(fit, folder, "poses"), "name the file of measurements too"),
    ):
        code, _, message = invoked(iso9283_command, path)
        assert code == 2
        assert words in message
    bare = without(fit, folder, "poses")
    found = values(bare, poses)
    assert list(found["parts"]) == ["train"]
    assert any("all count as training poses" in n for n in found["notices"])
    gone = without(fit, folder, "nominal_robot")
    assert "nominal_robot" in invoked(iso9283_command, gone)[2]


def test_poses_that_cannot_give_back_their_errors_are_refused(fit, folder):
    stored = json.loads(fit.read_text())["poses"]
    stored["errors_mm"]["final"][3][0][0] += 0.01
    code, _, message = invoked(iso9283_command, without(fit, folder, poses=stored))
    assert code == 2
    assert "its effects need columns of the measurements" in message


def test_data_of_another_frame_are_doubted(fit, noisy, tmp_path):
    path = tmp_path / "moved.csv"
    mc.write_measurements(path, noisy.data.with_y(noisy.data.y + 0.5))
    _, _, notes = invoked(iso9283_command, fit, path)
    assert "check that data and fit belong to the same robot, measurement frame" in notes


def test_targets_that_the_fit_left_out_are_left_out(fit, folder, poses, noisy):
    two = mc.read_measurements(poses).keep(np.array([True, True, False]))
    path = folder / "two.json"
    mc.calibrate("irb2600", two).save(path)
    found = values(path, poses)
    assert found["targets"] == ["smr1", "smr2"]
    assert any("smr3 left out" in n for n in found["notices"])


def test_effects_are_part_of_what_is_commanded(folder, poses, robot):
    fitted = mc.calibrate(robot, poses, "sum", effects=["joint_compliance:all"])
    path = folder / "effects.json"
    fitted.save(path)
    saved = open_saved_result(path)
    assert_allclose(
        saved.cells["after"].error(saved.data), fitted.cell.error(fitted.data), rtol=0, atol=1e-9
    )
    found = values(path)["parts"]["holdout"]["cells"]["after"]["AP_target_mm"]
    rms = np.sqrt(np.mean([each["rms"] ** 2 for each in found.values()]))
    assert rms == pytest.approx(fitted.accuracy["holdout"].rms_mm, rel=1e-6)


def test_the_page_quotes_what_its_commands_print(tmp_path, monkeypatch):
    page = (ROOT / "docs" / "iso9283.md").read_text().partition("## An example")[2]
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", page, flags=re.S)
    exec(compile(code, "iso9283.md", "exec"), {})
    mc.calibrate("irb2600", "poses.csv").save("fit.json")
    assert "minimax-cal iso9283 fit.json revisits.csv" in page
    _, out, _ = invoked(iso9283_command, "fit.json", "revisits.csv")
    printed = out.split()
    quoted = [part for text in re.findall(r"```text\n(.*?)```", page, flags=re.S)
              for part in re.split(r"\n\n(?=\w)", text)]  # fmt: skip
    assert len(quoted) == 3
    for table in quoted:
        told = table.split()
        start = next(i for i in range(len(printed)) if printed[i : i + 4] == told[:4])
        for said, found in zip(told, printed[start : start + len(told)], strict=True):
            try:  # the last digit may differ on another machine
                assert float(said) == pytest.approx(float(found), abs=2e-3)
            except ValueError:
                assert said == found


# ---- map -----------------------------------------------------------------------------------------


def test_map_draws_and_tells(fit, tmp_path):
    path = tmp_path / "map.png"
    code, out, _ = invoked(map_command, fit, "-o", path, *FAST)
    assert code == 0
    assert path.read_bytes().startswith(b"\x89PNG")
    for words in ("beyond", "observed before, held-out poses", "95 % mm"):
        assert words in out
    code, out, _ = invoked(map_command, fit, *FAST, "--json", "--height", 1000, "--slab", 300)
    assert code == 0
    content = json.loads(out)
    assert content["height_mm"] == 1000.0
    assert [s["name"] for s in content["sections"]] == ["vertical", "horizontal"]
    assert sum(content["observed"]["held_out"]) == 12


def test_map_predicts_by_the_covariance_in_the_file(fit, folder, robot, poses):
    found = mc.calibrate(robot, poses)
    names = ParameterNames(6, found.cell.target_names)
    units = tuple("m" if length else "rad" for length in names.linear_mask)
    even = 0.5 * (found.covariance + found.covariance.T)
    known = Uncertainty(names, units, even, lambda: Noise(0.0, 1e-10, 0.0), 100.0, "noise")
    file = without(fit, folder, covariance=known.to_dict())
    maps = []
    for frame in ("measurement", "base"):
        code, out, notes = invoked(map_command, file, *FAST, "--json", "--frame", frame)
        assert code == 0
        assert "the predicted radius, made wider" in notes  # joints give way: not in the covariance
        maps.append(json.loads(out))
    medians = [np.array(m["sections"][0]["radius95_median_mm"], dtype=float) for m in maps]
    some = np.isfinite(medians[0])
    assert 0.01 < medians[0][some].min() < medians[0][some].max() < 1.0  # mm
    assert np.nanmax(np.abs(medians[0] - medians[1])) > 0.0
    for broken in (
        without(fit, folder, "covariance"),
        without(fit, folder, covariance={"names": ["a9"]}),
    ):
        code, _, notes = invoked(map_command, broken, *FAST)
        assert code == 2
        assert "covariance" in notes
