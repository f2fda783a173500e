from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_fit import study_of
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal

from experiments.gap_cases import Case, Cause, make
from minimax_cal.diagnosing.joint import joint
from minimax_cal.diagnosing.study import Study, studied
from minimax_cal.diagnosing.trial import unsized, weights_of
from minimax_cal.fitting.uncertainty import Estimator, Poses
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.joint_fit import extended

TOLERANCE = 2e-2
GEAR = Term("gear_error", "J2", {"turns": 1.0})


@pytest.fixture(scope="module")
def geared() -> Study:
    return study_of(make(Case("irb2600", "single", (Cause("gear_error", "J2", 300.0),), seed=4)))


def linear(study: Study, *terms: Term, at: float = 0.0) -> tuple[Poses, Array]:
    """The poses at a state whose effects are all of one value, and those values."""
    base, state = study.model.only(study.fit.identification.active), study.fit.state
    model, state = extended(base, study.robot, study.data, state, terms)
    state = replace(state, effects=state.effects + at)
    model, state = extended(base, study.robot, study.data, state, terms)
    return Poses.of(Estimator(model, np.ones(len(model.y))), state), state.effects


@pytest.mark.parametrize("at", [0.0, 4e-5])
@pytest.mark.parametrize("power", [300.0, 12.0])
def test_the_size_is_the_likeliest(power: float, at: float) -> None:
    """Against the marginal likelihood of the same linear model, maximised by SciPy."""
    study = study_of(make(Case("irb2600", "single", (Cause("gear_error", "J2", power),), seed=4)))
    poses, values = linear(study, GEAR, at=at)
    weight = weights_of(poses, values, [slice(0, 2)])
    poses, _ = linear(study, GEAR)  # a linear model is the same everywhere
    columns, e = poses.jacobian.reshape(-1, poses.jacobian.shape[2]), poses.error.reshape(-1)
    size = np.linalg.norm(columns[:, -2:], axis=0)
    u, s, _ = np.linalg.svd(columns[:, :-2], full_matrices=True)
    rest = u[:, int(np.count_nonzero(s > 1e-9 * s[0])) :]  # what geometry cannot do
    across, f = np.linalg.qr(rest.T @ (columns[:, -2:] / size))
    y = across.T @ (rest.T @ e)  # all that tells the size: the rest is noise whatever it is
    least = np.sum((rest.T @ e) ** 2) - y @ y
    variance = float(least) / (len(e) - columns.shape[1])

    def unlikely(log: float) -> float:
        covariance = variance * np.eye(2) + np.exp(log) * f @ f.T
        return -float(multivariate_normal.logpdf(y, np.zeros(2), covariance))

    best = minimize_scalar(unlikely, bounds=np.log([1e-6 * variance, 1e6 * variance]))
    # 20 rounds of expectation and maximisation come within two per cent
    assert_allclose(weight, variance / np.exp(best.x) * size**2, rtol=TOLERANCE)


def test_what_the_data_tell_is_left_alone(geared: Study) -> None:
    found = joint(geared, (GEAR,))
    poses, _ = linear(geared, GEAR)
    gram = poses.normal_matrix
    free = np.linalg.lstsq(gram, poses.gradient + poses.prior * poses.off, rcond=None)[0][-2:]
    sigma = np.sqrt(np.diag(np.linalg.pinv(gram, hermitian=True))[-2:])
    sigma *= np.sqrt((poses.error**2).mean())
    assert (np.abs(found.state.effects - free) < 0.3 * sigma).all()


def test_what_the_data_do_not_tell_stays_small(geared: Study) -> None:
    """An effect that is not there: its square falls well below that of least squares."""
    other = Term("gear_error", "J5", {"turns": 1.0})
    poses, values = linear(geared, GEAR, other)
    weight = weights_of(poses, values, [slice(0, 2), slice(2, 4)])
    gram, pull = poses.normal_matrix, poses.gradient + poses.prior * poses.off
    prior = np.concatenate([np.zeros(len(gram) - 4), weight])
    free, held = (np.linalg.solve(gram + np.diag(w), pull)[-2:] for w in (0.0 * prior, prior))
    assert np.linalg.norm(held) < 0.7 * np.linalg.norm(free)


def test_single_parameters_and_maps_have_none(geared: Study) -> None:
    terms = (Term("backlash", "J2"), GEAR, Term("joint_compliance", "J2", {"parts": 128.0}))
    assert unsized(terms, geared.scene) == [slice(1, 3)]
    poses, values = linear(geared, terms[0])
    assert not weights_of(poses, values, []).any()


def test_the_sigma_of_a_held_effect_is_no_more_than_its_size() -> None:
    """A joint that turned by a radian: its gear's two waves are nearly geometry there."""
    made = make(Case("irb2600", "single", (Cause("gear_error", "J2", 300.0),), seed=4))
    study = study_of(made)
    rows = np.abs(study.data.q[:, 4] - np.median(study.data.q[:, 4])) < 0.5
    data = study.data.take(rows)
    few = studied(study.robot, data, study.fit)
    held = joint(few, (Term("gear_error", "J5", {"turns": 1.0}),))
    weight = held.model.prior.weight[-2:]
    assert (weight > 0.0).all()
    size = np.sqrt(held.poses.mean_square / weight)  # of the prior
    assert (held.uncertainty.sigma[-2:] < 1.5 * size).all()
    assert not held.model.prior.beside[-2:].any()
