"""Poses that joints never came to: report, evaluate and map say that nothing is claimed there."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import run

import minimax_cal as mc
from minimax_cal.modelling.simulate import simulate

FROZEN = ["J1", "J2", "J3"]


@pytest.fixture(scope="module")
def here(robot: mc.Robot, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Poses of an arm whose first three joints never moved, poses all over, and both results."""
    folder = tmp_path_factory.mktemp("frozen")
    made = simulate(robot, 60, 3, seed=4)
    q, rng = made.data.q.copy(), np.random.default_rng(4)
    q[:, :3] = [0.3, 0.2, -0.1]
    y = made.cell.predict(q)
    data = mc.measurements(q, y + 2e-5 * rng.normal(size=y.shape))
    mc.write_measurements(folder / "poses.csv", data)
    mc.write_measurements(folder / "fresh.csv", made.data)
    mc.calibrate(robot, folder / "poses.csv", "sum").save(folder / "fit.json")
    mc.calibrate(robot, folder / "poses.csv", "sum").save(folder / "bare.json", poses=False)
    mc.diagnose(robot, folder / "poses.csv").save(folder / "diagnosis.json")
    return folder


@pytest.mark.parametrize("result", ["fit.json", "diagnosis.json"])
@pytest.mark.parametrize("spelling", ["outside", "beyond"])
def test_a_requirement_outside_is_not_judged(result, spelling, here, tmp_path, capsys):
    page = tmp_path / "report.html"
    told = ("report", here / result, "--tolerance", "rms 50", "-o", page, "-q")
    assert run(*told, "--tolerance-for", spelling) == 0
    first, why, *_ = capsys.readouterr().out.splitlines()
    assert first == "not stated"
    assert "joint 1 spans 0 deg (18 needed), joint 2 spans 0 deg" in why
    assert "minimax-cal plan ROBOT --poses" in why
    assert "joint 3 spans 0 deg" in page.read_text()
    for inside in ("inside", "within"):
        assert run(*told, "--tolerance-for", inside) == 0
        assert capsys.readouterr().out.startswith("passed")


def test_old_spellings_are_not_offered(capsys):
    assert run("report", "--help") == 0
    told = capsys.readouterr().out
    assert "inside or outside" in " ".join(told.split())
    assert "within or beyond" not in " ".join(told.split())


@pytest.mark.parametrize("result", ["fit.json", "bare.json", "diagnosis.json"])
def test_evaluate_says_which_poses_are_outside(result, here, capsys):
    assert run("evaluate", here / result, here / "fresh.csv", "--json") == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["outside_spans"] == {"poses": 60, "joints": FROZEN}
    assert json.loads(out)["accuracy"]["rms_mm"] > 0.5  # they are far worse indeed
    assert "60 of 60 poses are outside what the joints of the fit spanned (joint 1 spans" in err
    assert run("evaluate", here / result, here / "poses.csv", "--json") == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["outside_spans"]["poses"] == 0
    assert "outside what" not in err


def test_a_map_predicts_nothing_outside(here, capsys):
    assert run("map", here / "fit.json", "--samples", 500, "--bins", 6, "--json") == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    summary = {row["what"].partition(" (")[0]: row for row in found["summary"]}
    away = summary["predicted, outside the spans of joints that hardly moved: none"]
    assert (away["count"], away["worst_mm"]) == (500, None)
    for section in found["sections"]:
        shares = [v for row in section["outside_spans"] for v in row if v is not None]
        assert max(shares) == 1.0
        radii = [v for row in section["radius95_worst_mm"] for v in row]
        known = [s for row in section["outside_spans"] for s in row]
        assert all(r is None for r, s in zip(radii, known, strict=True) if s in (None, 1.0))
        assert any(r is not None for r in radii)
    assert "nothing is predicted for" in err
    assert "joint 1 spans 0 deg" in err
