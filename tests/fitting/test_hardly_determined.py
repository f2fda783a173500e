"""A joint that nearly stands still: the drawing holds what the poses hardly determine."""

from dataclasses import replace

import numpy as np
import pytest

import minimax_cal as mc
from minimax_cal.fitting.opened import open_result
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.cell import Cell
from minimax_cal.robots.sampling import random_poses
from minimax_cal.robots.transforms import nearest_rotation

NOISE = 0.3e-3  # of a coordinate [m]
LAST = ("a5", "d5", "theta5", "alpha5")  # which joint 6 alone tells from the tool


def measured(seed: int, still: float) -> tuple[mc.Measurements, Cell]:
    """A UR10 drawn as well as `drawn_within`, joint 6 within 10 mrad in a share of 30 poses."""
    robot, rng = mc.load_robot("ur10"), np.random.default_rng(seed)
    off = rng.normal(size=(6, 5)) * np.repeat(robot.drawn_within, (2, 3))
    q = random_poses(robot, 30, rng)
    q[rng.random(30) < still, 5] *= 0.01 / np.pi
    base = np.eye(4)
    base[:3, 3] = [2.0, 1.0, 0.3]
    cell = Cell(robot.with_mdh(robot.mdh + off), base, ("smr1",), np.array([[0.0, 0.0, 0.1]]))
    y = cell.predict(q)
    data = mc.measurements(q, y + NOISE * rng.normal(size=y.shape))
    return replace(data, target_names=cell.target_names), cell


def misses(cell: Cell, true: Cell, q: Array) -> float:
    """RMS distance of points over the joints' range, the base fitted [m]."""
    here, there = (one.predict(q)[:, 0] for one in (cell, true))
    here, there = (points - points.mean(axis=0) for points in (here, there))
    turn = nearest_rotation(there.T @ here)
    return float(np.sqrt(((here @ turn.T - there) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("seed", range(6))
def test_a_joint_that_nearly_stands_still(seed):
    data, true = measured(seed, 1.0)
    fit = mc.calibrate("ur10", data, "sum")
    assert fit.status in ("converged", "no_better")
    assert any("drawing holds them, to 0.3 mm and 0.5 mrad" in text for text in fit.notices)
    q = random_poses(true.robot, 300, np.random.default_rng(99))
    assert misses(fit.cell, true, q) < misses(fit.nominal, true, q)
    away = np.abs(fit.cell.robot.mdh - true.robot.mdh).T.reshape(-1)
    for name in LAST:
        i = fit.uncertainty.names.index(name)
        assert away[i] < 4.0 * fit.uncertainty.sigma[i], name
    freely = mc.calibrate("ur10", data, "sum", allow_large_changes=True)
    assert np.array_equal(freely.cell.robot.mdh, fit.cell.robot.mdh)


def test_poses_that_determine_all_need_no_drawing():
    data, _ = measured(0, 0.0)
    fit = mc.calibrate("ur10", data, "sum")
    assert not fit.prior.any()
    assert not any("drawing holds" in text for text in fit.notices)


def test_a_diagnosis_holds_them_as_well():
    """Its geometry is that of the calibration, to the rounds that weigh the prior."""
    data, _ = measured(2, 1.0)
    fit = mc.calibrate("ur10", data, "sum", holdout=0.2)
    found = open_result(mc.diagnose("ur10", data, quick=True), 1)
    own = found.cell.robot.mdh
    assert np.abs(own - fit.cell.robot.mdh).max() < 1e-4
