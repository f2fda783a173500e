"""Intervals of held-out accuracy: identities, known laws, and coverage over repeated samples."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import stats

from minimax_cal.fitting.intervals import (
    Interval,
    chance_of_larger,
    max_interval,
    rms_interval,
    told,
    top_of_normal,
)
from minimax_cal.ground.arrays import Array

RUNS = 300
CHANCE = 3.3 * np.sqrt(0.95 * 0.05 / RUNS)  # one test in a thousand fails by chance


def rng_of(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def both(error: Array, seed: int = 0) -> Array:
    """Ends of both intervals, (4,)."""
    out = [f(error, rng=rng_of(seed)) for f in (rms_interval, max_interval)]
    return np.array([end for interval in out for end in (interval.low, interval.high)])


@settings(max_examples=40)
@given(st.integers(3, 40), st.integers(1, 4), st.floats(1e-7, 1e3), st.integers(0, 99))
def test_intervals_scale_with_the_errors(m, k, size, seed):
    error = rng_of(seed).normal(size=(k, m, 3))
    low, high, least, most = both(error)
    rms = np.sqrt((error**2).sum(-1).mean())
    assert 0.0 < low < rms < high
    assert 0.0 < least < most
    assert_allclose(both(size * error), size * np.array([low, high, least, most]), rtol=1e-9)


def test_the_same_seed_gives_the_same_ends(rng):
    error = rng.normal(size=(2, 15, 3))
    assert np.array_equal(both(error, 4), both(error, 4))
    assert not np.array_equal(both(error, 4), both(error, 5))


def test_targets_of_a_pose_are_no_further_poses(rng):
    error = rng.normal(size=(1, 20, 3))
    assert_allclose(both(np.repeat(error, 3, axis=0)), both(error), rtol=1e-12)


def test_what_was_not_measured_does_not_count(rng):
    error = rng.normal(size=(3, 20, 3))
    error[1, ::2] = np.nan
    padded = np.concatenate([error, np.full((3, 7, 3), np.nan)], axis=1)
    assert_allclose(both(padded), both(error), rtol=1e-12)
    turned = error[::-1] @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    assert_allclose(both(turned), both(error), rtol=1e-9)


def test_too_few_poses_tell_nothing():
    for m in range(3):
        assert np.isnan(both(np.ones((2, m, 3)))).all()
    assert rms_interval(np.zeros((1, 5, 3)), rng=rng_of()) == Interval(0.0, 0.0)
    assert max_interval(np.zeros((1, 5, 3)), rng=rng_of()) == Interval(0.0, 0.0)


@pytest.mark.parametrize(("m", "zero"), [(12, 6), (7, 6), (400, 399)])
def test_exact_zeros_are_the_smallest_errors(m, zero):
    """Bootstrap samples may hold nothing but zeros: no warning, and the ends of tiny errors."""
    error = rng_of(5).normal(size=(1, m, 3))
    error[:, :zero] = 0.0
    found, tiny = (
        rms_interval(errors, rng=rng_of())
        for errors in (error, np.where(error == 0.0, 1e-12, error))
    )
    rms = np.sqrt((error**2).sum() / m)
    assert 0.0 < found.low < rms < found.high
    assert_allclose([found.low, found.high], [tiny.low, tiny.high], rtol=1e-9)
    assert np.isnan(told(found, rms).high) == (m == zero + 1)  # one pose is all of the error


def test_an_upper_end_of_the_law_alone_is_not_told():
    """Seven poses of which one is nearly all of the error: no sample without it tells anything."""
    error = np.zeros((1, 7, 3))
    error[0, :, 0] = [2.09, 0.31, 0.35, 0.4, 0.29, 0.38, 0.33]
    for interval, seen in ((rms_interval, np.sqrt((error**2).sum() / 7)), (max_interval, 2.09)):
        found = interval(error, rng=rng_of())
        assert found.high > 10.0 * seen
        assert told(found, seen).low == found.low
        assert np.isnan(told(found, seen).high)
    assert told(Interval(0.5, 2.0), 1.0) == Interval(0.5, 2.0)


@settings(max_examples=40, deadline=None)
@given(st.integers(3, 30), st.data())
def test_exact_poses_count_as_nearly_exact_ones(m, data):
    """Bootstrap samples of exact poses alone have no logarithm; the limit of small errors does."""
    exact = data.draw(st.integers(1, m - 1))
    error = rng_of(m).normal(size=(2, m, 3))
    error[:, :exact] = 0.0
    low, high, least, most = found = both(error)
    assert 0.0 < low <= np.sqrt((error**2).sum(-1).mean()) <= high < np.inf
    assert 0.0 < least <= most < np.inf
    error[:, :exact] = 1e-9
    assert_allclose(both(error), found, rtol=1e-6)


def test_many_normal_errors_give_the_chi_square_interval(rng):
    """3m normal coordinates of one variance: its exact interval, within 10 % of its width."""
    error = rng.normal(size=(1, 2000, 3))
    found = rms_interval(error, rng=rng_of())
    total, free = float((error**2).sum()), 6000
    exact = np.sqrt(total / stats.chi2.ppf([0.975, 0.025], free) * 3.0)
    assert_allclose([found.low, found.high], exact, rtol=0, atol=0.1 * np.ptp(exact))


def test_a_wider_level_is_wider(rng):
    error = rng.normal(size=(3, 12, 3))
    for interval in (rms_interval, max_interval):
        wide, narrow = (interval(error, level=v, rng=rng_of()) for v in (0.99, 0.8))
        assert wide.low < narrow.low < narrow.high < wide.high


# Known shortfall of each law at these numbers of poses, from 1500 samples each: the method is no
# better on few skew squares.
LAWS = {
    "tracker noise": (lambda rng, n: rng.chisquare(3, n), 3.0, 10, 0.01),
    "one axis": (lambda rng, n: rng.chisquare(1, n), 1.0, 20, 0.01),
    "skew": (lambda rng, n: np.exp(0.7 * rng.normal(size=n)), np.exp(0.245), 40, 0.015),
    "half exact": (lambda rng, n: rng.chisquare(3, n) * rng.integers(0, 2, n), 1.5, 20, 0.01),
    "very skew": (lambda rng, n: np.exp(rng.normal(size=n)), np.exp(0.5), 20, 0.03),
}


@pytest.mark.parametrize("name", LAWS)
def test_the_rms_interval_covers(name):
    """95 % less the known shortfall, within 3.3 standard deviations of the number of runs."""
    law, mean, poses, loss = LAWS[name]
    rng, held = rng_of(1), 0
    for _ in range(RUNS):
        error = np.zeros((1, poses, 3))
        error[0, :, 1] = np.sqrt(law(rng, poses))
        found = rms_interval(error, rng=rng)
        held += found.low <= np.sqrt(mean) <= found.high
    assert 0.95 - loss - CHANCE < held / RUNS < 0.95 + loss + CHANCE


@pytest.mark.parametrize(("name", "poses"), [("exact", 10), ("exact", 40), ("tracker", 20)])
def test_the_largest_of_new_poses_is_covered(name, poses):
    """Lognormal distances: 95 %.  Lighter tails, as of noise: up to 3 % more."""
    rng, held = rng_of(2), 0
    for _ in range(RUNS):
        if name == "exact":
            distance = np.exp(0.6 * rng.normal(size=2 * poses))
        else:
            distance = np.sqrt(rng.chisquare(3, 2 * poses))
        error = np.zeros((1, poses, 3))
        error[0, :, 2] = distance[:poses]
        found = max_interval(error, rng=rng)
        held += found.low <= distance[poses:].max() <= found.high
    more = 0.0 if name == "exact" else 0.03
    assert 0.95 - CHANCE < held / RUNS < 0.95 + more + CHANCE


def test_the_largest_of_normal_samples_follow_their_law():
    """The largest of n has the distribution Phi^n; all of n sorted are a normal sample."""
    top = top_of_normal(12, 5, rng_of(3))
    assert np.all(np.diff(top, axis=1) < 0.0)
    assert stats.kstest(stats.norm.cdf(top[:, 0]) ** 12, "uniform").pvalue > 1e-3
    fifth = stats.beta(12 - 4, 5)  # the fifth largest of 12 uniform numbers
    assert stats.kstest(fifth.cdf(stats.norm.cdf(top[:, 4])), "uniform").pvalue > 1e-3
    every = top_of_normal(6, 6, rng_of(4)).reshape(-1)
    assert abs(every.mean()) < 4.0 / np.sqrt(len(every))
    assert abs(every.var() - 1.0) < 4.0 * np.sqrt(2.0 / len(every))


def test_chance_of_a_larger_error_is_free_of_the_law(rng):
    """The next of n + 1 is the largest as often as any other; 4 standard deviations."""
    runs, n = 20000, 14
    for sample in (rng.standard_cauchy((runs, n + 1)), rng.uniform(size=(runs, n + 1))):
        share = float(np.mean(sample[:, n] > sample[:, :n].max(axis=1)))
        p_value = chance_of_larger(n)
        assert abs(share - p_value) < 4.0 * np.sqrt(p_value / runs)
