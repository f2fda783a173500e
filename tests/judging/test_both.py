"""Two sessions in one linear problem: its variances, scores and left-out errors are right."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minimax_cal.judging.watching.both import (
    NEW,
    OLD,
    RIDGE,
    Both,
    Part,
    fit_variances,
    inverse,
    solve,
)

FREE, RANDOM, ASKED = 6, 40, 3
ROWS, PARTS = 60, 8
NOISE, FACTOR = 0.5, 4.0


def drawn(rng: np.random.Generator, noise: float = NOISE) -> tuple[Both, list[np.ndarray]]:
    """Both sessions with lack of fit of a known size, and the rows that they are made of."""
    u, x = np.sqrt(FACTOR) * rng.normal(size=RANDOM), rng.normal(size=FREE)
    parts, rows = [], []
    for number in range(PARTS):
        new = number >= PARTS // 2
        columns = rng.normal(size=(ROWS, FREE + RANDOM + ASKED))
        columns[:, -ASKED:] *= new
        sigma = np.sqrt(noise if new else NOISE)
        error = columns[:, : FREE + RANDOM] @ np.append(x, u) + sigma * rng.normal(size=ROWS)
        rows.append(np.column_stack([columns, error]))
        parts.append(Part(rows[-1].T @ rows[-1], ROWS, NEW if new else OLD))
    asked = np.arange(ASKED)
    component = np.zeros(RANDOM, dtype=int)
    return Both(tuple(parts), FREE, RANDOM, component, asked, asked < 1, np.ones(0)), rows


def test_variances_are_those_that_were_drawn():
    rng = np.random.default_rng(0)
    found = [fit_variances(drawn(rng)[0]) for _ in range(20)]
    assert np.mean([v.noise[OLD] for v in found]) == pytest.approx(NOISE, rel=0.05)
    assert np.mean([v.factor[0] for v in found]) == pytest.approx(FACTOR, rel=0.2)


def test_new_poses_may_be_noisier():
    rng = np.random.default_rng(1)
    found = [drawn(rng, 9.0 * NOISE)[0].noise_ratio for _ in range(20)]
    assert np.mean(found) == pytest.approx(3.0, rel=0.1)
    quiet = drawn(rng, NOISE / 9.0)[0]
    assert quiet.noise_ratio == 1.0


def test_scores_spread_as_their_sigmas_say():
    rng, none = np.random.default_rng(2), np.zeros(0, dtype=int)
    z = []
    for _ in range(40):
        by, sigma, dof = drawn(rng)[0].scores(none)
        z.append(by / sigma)
        assert np.all(dof > PARTS - 2)
    assert abs(np.sqrt(np.mean(np.square(z))) - 1.0) < 4.0 / np.sqrt(2 * np.size(z))


def test_a_part_left_out_is_judged_by_a_fit_of_the_others():
    both, rows = drawn(np.random.default_rng(3))
    noise = both.variances.noise
    fitted = both.fitted(np.array([1]))
    left = PARTS - 1
    scaled = [part / np.sqrt(noise[p.source]) for part, p in zip(rows, both.parts, strict=True)]
    rest = np.concatenate([part for number, part in enumerate(scaled) if number != left])
    prior = np.diag(np.sqrt(both.ridge(fitted)))
    matrix = np.concatenate([rest[:, fitted], prior])
    value = np.linalg.lstsq(matrix, np.append(rest[:, -1], np.zeros(len(prior))))[0]
    error = scaled[left][:, -1] - scaled[left][:, fitted] @ value
    assert_allclose(both.square(both.parts[left], fitted), error @ error, rtol=1e-6)


def test_folds_scatter_as_the_estimate_does():
    rng, none = np.random.default_rng(4), np.zeros(0, dtype=int)
    found = [drawn(rng)[0] for _ in range(40)]
    ratio = [both.scatter(none, 1) / both.scores(none)[1][1] for both in found]
    assert np.sqrt(np.mean(np.square(ratio))) == pytest.approx(1.0, abs=0.3)


def test_an_inverse_is_a_solution():
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(30, 8)) * 10.0 ** np.arange(-4, 4)
    gram = rows.T @ rows
    assert_allclose(inverse(gram), solve(gram, np.eye(8)), rtol=1e-7)
    gram[:, 3] = gram[3] = 0.0  # what no row tells
    assert np.isfinite(inverse(gram)).all()
    assert solve(gram, np.ones((8, 1)))[3, 0] == pytest.approx(1.0 / RIDGE)
