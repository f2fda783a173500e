"""Habits of people who know SciPy: pairs, texts, functions and arrays where these are natural."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import Bounds

import minimax_cal as mc
from qp_backends import Problem, Solution, solve

EXACT = 1e-12


def largest(x: np.ndarray) -> np.ndarray:
    return np.array([x[0] ** 2 + x[1] ** 4, (2 - x[0]) ** 2 + (2 - x[1]) ** 2])


def test_bounds_as_pairs_are_bounds():
    told = mc.minimize_max(largest, [2.0, 2.0], bounds=[(None, 0.8), (0.9, None)])
    same = mc.minimize_max(largest, [2.0, 2.0], bounds=Bounds([-np.inf, 0.9], [0.8, np.inf]))
    assert_allclose(told.x, same.x, rtol=0, atol=EXACT)
    assert told.x[0] <= 0.8 + 1e-9
    for wrong in ([(0.0, 1.0)], [(0.0, 1.0), 3.0], [("a", 1.0), (0.0, 1.0)]):
        with pytest.raises(mc.OptionError, match="give 2 pairs"):
            mc.minimize_max(largest, [2.0, 2.0], bounds=wrong)


def test_central_differences_are_nearer_than_forward_ones():
    exact = mc.minimize_max(largest, [2.0, 2.0], jac="cs")
    central = mc.minimize_max(largest, [2.0, 2.0], jac="3-point")
    assert_allclose(central.fun, exact.fun, rtol=1e-9)
    assert_allclose(central.x, exact.x, rtol=0, atol=1e-6)
    with pytest.raises(mc.OptionError, match="'3-point'"):
        mc.minimize_max(largest, [2.0, 2.0], jac="4-point")


def test_a_qp_solver_may_be_a_function(robot, noisy):
    asked = []

    def counting(problem: Problem) -> Solution:
        asked.append(problem)
        return replace(solve(problem, "quadprog"), backend="")

    fit = mc.calibrate(robot, noisy.data, qp=counting)
    named = mc.calibrate(robot, noisy.data, qp="quadprog")
    assert asked
    assert fit.qp == "function counting"
    assert list(fit.answered) == ["function counting"]
    assert fit.work.warm_starts == 0
    assert_allclose(fit.parameters.value, named.parameters.value, rtol=0, atol=1e-9)
    again = mc.Fit.from_dict(fit.to_dict())
    assert again.options.qp == "function counting"


def test_priors_have_units_as_text(robot, noisy):
    told = mc.calibrate(robot, noisy.data, "sum", priors={"a*": "0.5mm", "theta2": "1mrad"})
    same = mc.calibrate(robot, noisy.data, "sum", priors={"a*": 5e-4, "theta2": 1e-3})
    assert_allclose(told.parameters.value, same.parameters.value, rtol=0, atol=EXACT)
    with pytest.raises(mc.OptionError, match="is a length"):
        mc.calibrate(robot, noisy.data, priors={"a1": "1mrad"})


def test_arrays_are_measurements(robot, noisy):
    fit = mc.calibrate(robot, (noisy.data.q, noisy.data.y), "sum")
    same = mc.calibrate(robot, noisy.data, "sum")
    assert_allclose(fit.parameters.value, same.parameters.value, rtol=0, atol=EXACT)
    with pytest.raises(mc.DataError, match="q must be"):
        mc.calibrate(robot, (noisy.data.q[:3], noisy.data.y))


def test_a_fit_draws_itself_and_is_short(robot, noisy):
    pytest.importorskip("matplotlib")
    fit = mc.calibrate(robot, noisy.data, "sum")
    left, right = mc.plot_errors(fit).axes
    shown = np.concatenate([np.asarray(line.get_ydata()) for line in left.lines])
    held = 1e3 * np.linalg.norm(
        np.concatenate([fit.errors["nominal"], fit.errors["holdout"]]), axis=-1
    )
    assert_allclose(np.sort(shown), np.sort(held.ravel()), rtol=1e-12)
    assert right.get_xscale() == "log"
    assert len(repr(fit)) < 120
    assert f"RMS {fit.within.after.rms_mm:.3f} mm" in repr(fit)


def test_one_target_alone_is_told(robot, noisy):
    fit = mc.calibrate(robot, noisy.data, "smr:1")
    said = "objective smr:1: smr1 alone is fitted; smr2, smr3 took no part"
    assert said in fit.notices
