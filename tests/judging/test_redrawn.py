"""Draws solved at once: each ends where the SQP of one ends, and the small QPs are solved."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.fitting.minimax_problem import measured_distances, minimax_problem
from minimax_cal.fitting.options import solver_of
from minimax_cal.fitting.solve import QP_TOLERANCE
from minimax_cal.judging.bootstrap import draw, drawn_distances
from minimax_cal.judging.redrawn import Redrawn, multipliers, solved_at_once
from minimax_cal.modelling.simulate import Simulation
from minimax_cal.solvers import minimax
from minimax_cal.solvers.minimax import Sqp

SAME = 1e-8  # relative difference of two optima: the tolerance of both
STILL = 1e-10  # of the small QPs' conditions


def test_draws_end_where_one_by_one_ends(robot: mc.Robot, noisy: Simulation) -> None:
    fit = mc.calibrate(robot, noisy.data, holdout=0.0)
    times = draw(fit.group, 6, np.random.default_rng(5)).times
    told, drawn = drawn_distances(fit, times)
    model, state = fit.estimator.model, fit.cell.state
    assert fit.minimax
    ends, good = solved_at_once(model, state, drawn, fit.minimax.multiplier, Sqp())
    assert told.all()
    assert good.mean() > 0.5
    here = Redrawn.of(model, drawn, state).rows(ends)
    for b in np.flatnonzero(good):
        rows = np.repeat(np.arange(len(times[b])), times[b])
        kept = measured_distances(fit.train.take(rows))
        assert_allclose(drawn.mean[b], kept.mean, rtol=1e-12)
        assert_allclose(drawn.tolerance[b], kept.tolerance, rtol=1e-9)
        problem = minimax_problem(model.take(rows), state, kept, "two-sided", "target")
        best = minimax.solve(problem, state, solver_of("daqp", QP_TOLERANCE)[0])
        assert here.f[b].max() == pytest.approx(best.value, rel=SAME)
        assert np.abs(here.c[b]).max() <= 1.0 + SAME


def test_multipliers_solve_the_qp(rng: np.random.Generator) -> None:
    """Primal and dual conditions of min 1/2 d'Hd + v, checked with d = -H^-1 B'z."""
    B = rng.normal(size=(40, 6, 9))
    f, c = rng.normal(size=(40, 3)), 2.0 * rng.normal(size=(40, 3))
    z, told = multipliers(B @ np.swapaxes(B, 1, 2), f, c, np.tile([1.0, 1, 1, 0, 0, 0], (40, 1)))
    assert told.mean() > 0.9
    d = -np.einsum("brp,br->bp", B, z)
    ahead = np.concatenate([f, c], axis=1) + np.einsum("brp,bp->br", B, d)
    for mu, lam, functions, kept in zip(
        z[told, :3], z[told, 3:], ahead[told, :3], ahead[told, 3:], strict=True
    ):
        largest = functions.max()
        assert mu.sum() == pytest.approx(1.0, abs=STILL)
        assert (mu >= -STILL).all()
        assert np.abs(kept).max() <= 1.0 + STILL
        assert_allclose(mu * (largest - functions), 0.0, atol=STILL)
        assert_allclose(lam * (np.sign(lam) - kept), 0.0, atol=STILL)
