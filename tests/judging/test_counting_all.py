"""`evaluate`, `check` and `import` list what was set aside and say what the distances show."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.simulate import Simulation, Truth, simulate

TRUTH = Truth(noise=20e-6, noise_per_metre=0.0, compliance=0.0)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Simulation]:
    """A calibration, and the arm that it is of."""
    folder = tmp_path_factory.mktemp("arm")
    sim = simulate("irb120", 150, 3, seed=4, truth=TRUTH)
    mc.calibrate("irb120", sim.data, "sum").save(folder / "fit.json")
    return folder, sim


def later(sim: Simulation, poses: int = 30) -> Measurements:
    """New measurements of the same arm in its place, with one pose 1 mm off."""
    data = simulate("irb120", poses, 3, seed=77, truth=TRUTH).data
    y = sim.cell.predict(data.q) + TRUTH.noise * np.random.default_rng(5).normal(size=data.y.shape)
    y[6] += [0.6e-3, 0.0, 0.8e-3]
    return replace(data.with_y(y), simulated=False, line=np.arange(poses) + 2)


def test_evaluate_counts_with_them(arm, capsys):
    folder, sim = arm
    data = later(sim)
    mc.write_measurements(folder / "new.csv", data)
    left = f"--leave-out={data.line[6]}=looks odd"
    assert run("import", folder / "new.csv", left, "-o", folder / "some.csv", "--quiet") == 0
    capsys.readouterr()
    answers = []
    for name in ("new", "some"):
        assert run("evaluate", folder / "fit.json", folder / f"{name}.csv", "--json") == 0
        answers.append(json.loads(capsys.readouterr().out))
    whole, some = answers
    assert whole["set_aside"] == []
    assert "holdout_with_them" not in whole["accuracy"]
    assert [(p["target"], p["why"], p["by"]) for p in some["set_aside"]] == [
        (name, "looks odd", "user") for name in data.target_names
    ]
    assert {(p["row"], p["pose"]) for p in some["set_aside"]} == {(8, 7)}
    assert some["accuracy"]["max_mm"] < 0.3
    for key in ("rms_mm", "max_mm", "mean_mm", "poses"):
        assert_allclose(some["accuracy"]["holdout_with_them"][key], whole["accuracy"][key],
                        rtol=1e-9)  # fmt: skip


def test_check_counts_with_them(arm):
    folder, sim = arm
    data = later(sim)
    cells = np.where(np.arange(data.poses) == 6, "looks odd", "")
    path = folder / "checked.csv"
    mc.write_measurements(path, replace(data, columns={**data.columns, "set_aside": cells}))
    found = mc.check(folder / "fit.json", path, "rms 0.2")
    assert found.valid
    content = found.to_dict()
    assert {(p["row"], p["by"]) for p in content["set_aside"]} == {(8, "user")}
    assert content["accuracy"]["max_mm"] < 0.3
    assert_allclose(content["accuracy"]["holdout_with_them"]["max_mm"], 1.0, rtol=0.15)
    assert "3 points set aside by the user; with them RMS" in found.headline()
    assert found.fit.set_aside == found.set_aside
    assert "holdout_with_them" not in found.fit.to_dict()["accuracy"]  # none is held out


def test_a_reseat_is_told_by_check_and_import(arm, capsys):
    folder, sim = arm
    data = later(sim, 40)
    spots = sim.cell.target_positions + np.array([[0, 0, 0], [3e-3, 4e-3, 0], [0, 0, 0]])
    y = data.y.copy()
    y[20:, 1] = replace(sim.cell, target_positions=spots).predict(data.q[20:])[:, 1]
    path = folder / "reseated.csv"
    mc.write_measurements(path, replace(data.with_y(y), columns={}))
    said = "smr2 was re-seated, or exchanged for one of another radius, by 4.99 mm or more"
    assert run("import", path) == 0
    assert f"{said} before line 22" in capsys.readouterr().err
    found = mc.check(folder / "fit.json", path, "rms 0.2")
    assert any(said in notice for notice in found.notices)
