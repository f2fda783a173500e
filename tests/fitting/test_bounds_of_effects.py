"""No calibration has a joint that rises under load, as no search for causes has."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.fitting.found import Parameter
from minimax_cal.fitting.solve import AT_BOUND
from minimax_cal.measuring.history import with_history
from minimax_cal.modelling.effects.bounds import settled
from minimax_cal.modelling.effects.table import Fitted, terms
from minimax_cal.modelling.model import SumOfSquares
from minimax_cal.robots.gravity import tubes
from minimax_cal.solvers.bounded import bounded

EFFECTS = ("joint_compliance:J2", "joint_compliance:J3", "encoder_gain:J1")
RISES = "joint_compliance:J3"
IRB = mc.load_robot("irb2600")
MASS, COM = tubes(IRB.mdh)
ARM = replace(IRB, mass=np.maximum(MASS, 1.0), com=COM)  # told: each joint has one compliance
ALIKE, ROUGHLY = 1e-9, 3e-6  # least squares; what ends by a KKT residual
OBJECTIVES = ("sum", "minimax", "point", "pose")


def measured(compliance: float, seed: int = 0) -> mc.Measurements:
    """An arm whose third joint gives way so much [rad/(N m)], or rises where that is negative."""
    rng = np.random.default_rng(seed)
    plain = mc.simulate(ARM, 60, seed=seed, truth=mc.Truth(compliance=0.0, noise=0.0))
    scene = plain.cell.scene(with_history(plain.data))
    found = terms(scene, EFFECTS)
    values = (np.array([1e-6]), np.array([compliance]), np.array([3e-4]))
    y = replace(plain.cell, effects=Fitted(found, values)).predict(plain.data.q)
    return mc.measurements(plain.data.q, y + 15e-6 * rng.normal(size=y.shape))


def of(fit: mc.Fit, effect: str) -> list[Parameter]:
    return [p for p in fit.parameters if p.name.startswith(effect)]


@pytest.mark.parametrize("loss", ["square", "huber"])
@pytest.mark.parametrize("objective", OBJECTIVES)
def test_a_compliance_that_would_be_negative_rests_at_0(objective, loss):
    data = measured(-1e-6)
    fit = mc.calibrate(ARM, data, objective, effects=EFFECTS, loss=loss)
    (rests,) = of(fit, RISES)
    assert rests.value == 0.0
    assert np.isnan(rests.sigma)
    assert (rests.identifiable, rests.reason) == (False, AT_BOUND)
    (soft,) = of(fit, "joint_compliance:J2")
    assert soft.value > 0.0
    assert soft.sigma > 0.0
    assert AT_BOUND in fit.summary(width=200)
    if loss != "square":  # its scale counts the parameter that rests
        return
    without = mc.calibrate(ARM, data, objective, effects=EFFECTS[::2])
    alike = ALIKE if objective == "sum" else ROUGHLY
    assert_allclose(fit.robot.mdh, without.robot.mdh, rtol=0, atol=alike)
    assert_allclose(soft.value, of(without, "joint_compliance:J2")[0].value, rtol=1e-3)
    assert fit.accuracy["train"].rms_mm == pytest.approx(without.accuracy["train"].rms_mm, rel=1e-5)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_what_is_positive_is_found_as_without_bounds(objective):
    fit = mc.calibrate(ARM, measured(2e-6), objective, effects=EFFECTS)
    (found,) = of(fit, RISES)
    assert abs(found.value - 2e-6) < 5.0 * found.sigma
    assert not of(fit, RISES)[0].reason


def test_a_fit_at_its_bounds_is_the_best_between_them():
    """Its slope pulls no parameter that is free, and those at a bound beyond it."""
    data = measured(-1e-6)
    fit = mc.calibrate(ARM, data, "sum", effects=EFFECTS)
    model = fit.estimator.model
    rests = model.names.geometric + 1
    assert not model.active[rests]
    every = model.only(model.active | (np.arange(model.names.count) == rests))
    _, slope, gram = SumOfSquares(every).normal(fit.cell.state)
    slope = slope / np.sqrt(np.diag(gram))
    here = np.flatnonzero(every.active) == rests
    assert slope[here] < -1e-5
    assert np.abs(slope[~here]).max() < 1e-7


def test_steps_and_values_keep_to_their_bounds():
    gram = np.array([[2.0, 1.0], [1.0, 2.0]])
    step = bounded(gram, np.array([-1.0, 1.0]), np.array([0.0, -np.inf]), np.full(2, np.inf))
    assert_allclose(step, [0.0, 0.5], rtol=0, atol=1e-12)
    allowed = np.array([[0.0, 2.0], [0.0, 2.0], [-np.inf, np.inf]])
    kept = settled(np.array([7e-18, 2.0 - 1e-12, 1e-18]), allowed)
    assert kept.tolist() == [0.0, 2.0, 1e-18]
