"""A diagnosis that contradicts its own data: failed, and no robot comes of it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.diagnosing.diagnose import against
from minimax_cal.diagnosing.result import Step
from minimax_cal.fitting.accuracy import Accuracy
from minimax_cal.fitting.floor import AT_MOST, REPEATS, Floor
from minimax_cal.robots.transforms import transform


def mirrored(data: mc.Measurements) -> mc.Measurements:
    """One coordinate of one target with the wrong sign."""
    return data.with_y(data.y * np.array([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]]))


def test_it_ends_with_one_and_writes_no_robot(
    robot: mc.Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, out = tmp_path / "d.csv", tmp_path / "gap.json"
    mc.write_measurements(data, mirrored(mc.simulate(robot, 40, 2, seed=5).data))
    assert run("diagnose", "irb2600", data, "--quick", "--json", "-o", out) == 1
    said = capsys.readouterr()
    assert said.err.splitlines()[-1].startswith("error: failed: ")
    assert not out.exists()
    found = mc.Diagnosis.from_dict(json.loads(said.out))
    assert (found.status, found.verdict) == ("failed", "unknown")
    gone = replace(found.cells[0], base=transform(np.eye(3), np.array([3e5, 0.0, 0.0])))
    again = mc.Diagnosis.from_dict(json.loads(replace(found, cells=(gone,)).json()))
    assert_allclose(again.cells[0].base, gone.base, rtol=1e-9)  # wherever it ended
    assert "no calibration of this arm" in found.headline()
    assert "no calibration of this arm" in found.notices[-1]
    with pytest.raises(mc.OptionError, match="contradicts its own data"):
        mc.export(found, "json")


def test_points_that_are_suspect_contradict_nothing(robot: mc.Robot) -> None:
    def scores(rms: float, points: int) -> Accuracy:
        return Accuracy(rms, rms, rms, points, (points * rms**2,), (points,))

    fits, open_end = scores(0.1, 80), Floor(0.1, 0.0, 0.1, AT_MOST)
    few_bad = Step("geometric", fits, scores(90.0, 20), scores(0.1, 16))
    assert against(robot, open_end, few_bad) == ""
    most_bad = Step("geometric", fits, scores(90.0, 20), scores(0.1, 8))
    assert "misses the held-out poses by 90 mm" in against(robot, open_end, most_bad)
    known = Floor(0.1, 0.1, 0.1, REPEATS)
    off = Step("geometric", scores(5.5, 80), fits, fits)
    assert "50 times the noise floor" in against(robot, known, off)
    assert against(robot, open_end, off) == ""


def test_an_arm_that_comes_back_well_may_bend(robot: mc.Robot) -> None:
    """Readings at standstill tell what the instrument does, not how large an effect may be."""
    made = mc.simulate(robot, 100, 3, seed=1, truth=mc.Truth(noise=0.0, noise_per_metre=0.0))
    rng = np.random.default_rng(1)
    twice = made.data.take(np.repeat(np.arange(100), 2))
    twice = twice.with_y(twice.y + 2e-6 * rng.normal(size=twice.y.shape))
    assert mc.calibrate(robot, twice, objective="sum").status == "converged"
    exact = Floor(0.002, 0.002, 0.002, REPEATS)

    def step(share: float) -> Step:
        rms = 1e3 * share * robot.reach()
        one = Accuracy(rms, rms, rms, 80, (80 * rms**2,), (80,))
        return Step("geometric", one, one, one)

    assert against(robot, exact, step(0.9e-3)) == ""
    assert "and 0.1 % of the arm's reach" in against(robot, exact, step(1.1e-3))
