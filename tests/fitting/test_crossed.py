"""Cross-validation of few poses, and the warning where they are too few."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.fitting.crossed import MIN_HELD_POSES
from minimax_cal.measuring.accuracy import accuracy
from minimax_cal.modelling.simulate import simulate

ONE_STEP = 0.02  # of an error's size: a fit without a fold is one Gauss-Newton step away


def test_every_pose_is_judged_by_a_fit_without_it(robot, noisy):
    """One held-out pose each, so that a fold's own fit can be had by `split`."""
    fit = mc.calibrate(robot, noisy.data, "sum", cv=True, seed=3)
    held = fit.error_crossed[:, fit.held]
    assert_allclose(held, fit.errors["holdout"], rtol=0, atol=1e-12)
    folds = np.random.default_rng(3).permutation(48) % 10
    for number in (0, 7):
        rows = np.flatnonzero(~fit.held)[_by_group(fit, folds) == number]
        label = np.where(np.isin(np.arange(60), rows) | fit.held, "holdout", "train")
        other = mc.Measurements(**{**vars(noisy.data), "columns": {"split": label}})
        again = mc.calibrate(robot, other, "sum").cell.error(noisy.data.take(rows))
        assert_allclose(
            accuracy(fit.error_crossed[:, rows]).rms_mm, accuracy(again).rms_mm, rtol=ONE_STEP
        )


def _by_group(fit: mc.Fit, folds: np.ndarray) -> np.ndarray:
    """(training poses,) the fold of each, by the order of its joints."""
    from minimax_cal.measuring.grouping import clusters

    group = clusters(fit.data)
    return folds[np.searchsorted(np.unique(group[~fit.held]), group[~fit.held])]


def test_few_held_out_poses_are_cross_validated(robot):
    few, many = (simulate(robot, count, 3, seed=5).data for count in (60, 100))
    told = mc.calibrate(robot, few, "sum")
    assert told.accuracy["holdout"].poses < MIN_HELD_POSES
    assert any("the result is cross-validated" in notice for notice in told.notices)
    assert "60 poses, each judged by a fit without it" in told.headline()
    assert_allclose(told.within.after.rms_mm, accuracy(told.error_crossed).rms_mm, rtol=1e-12)
    plain = mc.calibrate(robot, many, "sum")
    assert not plain.error_crossed.size
    assert "20 poses that were not used for the fit" in plain.headline()
    again = mc.Fit.from_dict(told.to_dict())
    assert again.within == told.within
    assert told.to_dict()["accuracy"]["cv"]["poses"] == 60
    # the truth of a random hold-out stays where it was
    assert told.to_dict()["accuracy"]["holdout"]["poses"] == 12


def test_too_few_poses_are_a_loud_warning(robot):
    """8 training poses of 3 targets tell 48 numbers, for 33 parameters."""
    data = simulate(robot, 10, 3, seed=5).data
    with pytest.warns(mc.CalibrationWarning, match="too few poses: 8 training poses tell 48"):
        fit = mc.calibrate(robot, data, "sum")
    said = next(notice for notice in fit.notices if notice.startswith("too few poses"))
    assert "for 33 free parameters" in said
    assert "measure at 17 poses or more" in said
    held, train = fit.accuracy["holdout"].rms_mm, fit.accuracy["train"].rms_mm
    assert held > 1.5 * train
