"""A reflector that was re-seated, and poses that are off, where nothing tells the noise."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.diagnosing.set_aside import WHY
from minimax_cal.fitting.floor import DISTANCES
from minimax_cal.measuring.faults.nests import RESEAT
from minimax_cal.measuring.measurements import TOOL, USER, Measurements
from minimax_cal.measuring.set_aside import left_out
from minimax_cal.modelling.simulate import Simulation, Truth, simulate

TRUTH = Truth(noise=20e-6, noise_per_metre=0.0, compliance=0.0)
ROW = 30
NOISE_MM = 1e3 * np.sqrt(3.0) * TRUTH.noise


def reseated(sim: Simulation, by: tuple[float, float, float]) -> Measurements:
    """From the row ROW on smr2 sits elsewhere on the flange; the file tells no visits."""
    spots = sim.cell.target_positions.copy()
    spots[1] += by
    y = sim.data.y.copy()
    q = sim.data.q[ROW:]
    y[ROW:, 1] += replace(sim.cell, target_positions=spots).predict(q)[:, 1]
    y[ROW:, 1] -= sim.cell.predict(q)[:, 1]
    return replace(sim.data.with_y(y), columns={})


@cache
def diagnosed(targets: int) -> tuple[Simulation, Measurements, mc.Diagnosis]:
    """A reflector that was re-seated by 5 mm."""
    sim = simulate("irb120", 60, targets, seed=1, truth=TRUTH)
    data = reseated(sim, (3e-3, 0.0, 4e-3))
    return sim, data, mc.diagnose("irb120", data, quick=True)


@pytest.mark.parametrize("targets", [2, 3])
def test_a_reseat_of_5_mm_is_named_with_its_size(targets: int) -> None:
    sim, _, found = diagnosed(targets)
    assert found.verdict == "named"
    (reseat,) = found.effects
    assert (reseat.term.effect, reseat.term.place) == ("target_reseat", "smr2")
    assert reseat.at == "at smr2"
    assert "re-seated" in reseat.cause
    assert_allclose(reseat.values[0], 5e-3, rtol=0.02)
    assert min(reseat.rows) == sim.data.line[ROW] or max(reseat.rows) == sim.data.line[ROW - 1]
    assert found.floor.source == DISTANCES
    assert_allclose(found.floor.value, NOISE_MM, rtol=0.5)
    assert found.floor.high < 2.0 * NOISE_MM
    assert found.ladder[-1].trusted.rms_mm < 2.0 * NOISE_MM


def test_a_fault_of_the_data_is_no_effect_to_fit() -> None:
    _, data, found = diagnosed(3)
    fit = mc.calibrate("irb120", data, objective="sum", effects=found)
    assert fit.cell.effects.terms == ()
    assert any("smr2 was re-seated" in notice for notice in fit.notices)


@pytest.mark.parametrize("targets", [1, 3])
def test_8_of_60_poses_that_are_off_are_named(targets: int) -> None:
    """All targets of a pose alike, which no distance shows; more than a tenth of the poses."""
    rng = np.random.default_rng(1)
    sim = simulate("irb120", 60, targets, seed=2, truth=TRUTH)
    rows, by = rng.choice(60, 8, replace=False), rng.normal(size=(8, 1, 3))
    y = sim.data.y.copy()
    y[rows] += 3e-3 * by / np.linalg.norm(by, axis=-1, keepdims=True)
    found = mc.diagnose("irb120", replace(sim.data.with_y(y), columns={}), quick=True)
    assert found.verdict == "named"
    (wrong,) = found.effects
    assert wrong.term.effect == "outliers"
    assert set(wrong.rows) == set(sim.data.line[rows].tolist())
    assert found.ladder[-1].trusted.rms_mm < 2.0 * NOISE_MM
    assert found.floor.high < 2.5 * NOISE_MM


def test_what_no_fit_counts_is_listed_and_counted() -> None:
    """The re-seated part, and a point that the user set aside; both in the accuracy with them."""
    _, data, _ = diagnosed(3)
    found = mc.diagnose("irb120", left_out(data, ["3:smr1=looks odd"]), quick=True)
    by = {(p.by, p.target) for p in found.set_aside}
    assert by == {(USER, "smr1"), (TOOL, "smr2")}
    assert len(found.set_aside) == 1 + min(ROW, 60 - ROW)
    assert {p.why for p in found.set_aside if p.by == TOOL} == {WHY[RESEAT]}
    assert found.with_them is not None
    assert_allclose(found.with_them.max_mm, 5.0, rtol=0.05)
    content = found.to_dict()
    assert len(content["set_aside"]) == len(found.set_aside)
    assert content["accuracy"]["holdout_with_them"]["max_mm"] == found.with_them.max_mm
    again = mc.Diagnosis.from_dict(content)
    assert again.set_aside == found.set_aside
    assert again.to_dict()["accuracy"] == content["accuracy"]
    assert "set aside (1 by the user, 30 by the program); with them RMS" in found.headline()
