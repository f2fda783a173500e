"""The two noises: rotated rows are the same problem, and REML finds what was put in."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_fit import study

from experiments.gap_cases import Case, make
from minimax_cal.diagnosing.study import Study, studied
from minimax_cal.evidence.noise import Noise, Problem, inflation, restricted
from minimax_cal.fitting.options import Options, silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.measuring.grouping import split
from minimax_cal.measuring.history import with_history


@pytest.fixture(scope="module")
def quiet() -> Study:
    return study(6e-6, 1.0, 0)


def test_rotated_rows_keep_every_square(quiet, rng):
    fields = rng.normal(size=(4, *quiet.scene.points.shape))
    rows = quiet.rows.of(fields)
    assert_allclose(rows.T @ rows, fields.reshape(4, -1) @ fields.reshape(4, -1).T, rtol=1e-12)
    assert_allclose(quiet.rows.back(rows[:, 2]), fields[2], rtol=0, atol=1e-12)


def test_the_variance_of_a_row_is_that_of_its_direction(quiet):
    """Each rotated row has variance s^2 + t^2 |S'u|^2, and rows of a pose are uncorrelated."""
    rows, jacobian = quiet.rows, quiet.scene.jacobian
    arms = rows.of(jacobian)  # (N, n)
    pose = 7
    r = rows.weight.shape[1]
    own = arms.reshape(-1, r, jacobian.shape[0])[pose]
    expected = np.diag(rows.variance_ratio.reshape(-1, r)[pose] * rows.size)
    assert_allclose(own @ own.T, expected, rtol=0, atol=1e-9 * expected.max())


def test_what_is_left_is_square_to_the_geometry(quiet):
    """The fit is a least-squares one, so its rows have no part in the geometry's span."""
    rows = quiet.rows
    assert_allclose(rows.basis.T @ rows.error, 0.0, atol=1e-6 * np.linalg.norm(rows.error))


@pytest.mark.parametrize(("jitter", "noise"), [(0.0, 1.0), (6e-6, 1.0), (20e-6, 1.0), (6e-6, 2.0)])
def test_noise_and_jitter_are_found(jitter, noise):
    """Means over eight arms, within 15 % (a fifth of the mean instrument noise for no jitter)."""
    found = []
    for seed in range(8):
        made = study(jitter, noise, seed)
        away = np.linalg.norm(made.data.y, axis=-1).mean()
        one = restricted(made.rows, np.zeros((len(made.rows.error), 0)))
        truth = noise * (10e-6 + 2.5e-6 * away)
        found.append((one.jitter, np.sqrt(one.variance) / truth))
    mean_jitter, mean_ratio = np.mean(found, axis=0)
    assert abs(mean_ratio - 1.0) < 0.1
    assert abs(mean_jitter - jitter) < max(0.15 * jitter, 2e-6)


def test_weights_are_the_inverse_variances(quiet):
    noise = Noise(2.0, 1e-10, 0.0)
    variance_ratio = quiet.rows.variance_ratio
    assert_allclose(
        noise.weights(quiet.rows) * 1e-10 * (1.0 + 2.0 * variance_ratio), 1.0, rtol=1e-12
    )


def test_the_variance_counts_what_the_fit_took(rng):
    """Half of the rows' freedom is in the fit: dividing by their number would say 0.5."""
    n, p = 300, 150
    found = []
    for _ in range(20):
        basis = np.linalg.qr(rng.normal(size=(n, p)))[0]
        noise = rng.normal(size=n)
        rest = noise - basis @ (basis.T @ noise)
        rows = Problem(rest, basis, np.ones(n), 1.0, np.arange(n), np.ones(n, dtype=bool), 0.0)
        found.append(restricted(rows, np.zeros((n, 0))))
    total = [one.variance * (1.0 + one.ratio) for one in found]  # equal rows: only the sum counts
    assert abs(np.mean(total) - 1.0) < 4.0 * np.sqrt(2.0 / (n - p) / len(found))


def test_a_problem_without_freedom_has_a_noise(quiet):
    rows = quiet.rows
    few = Problem(
        rows.error[:9], np.eye(9), rows.variance_ratio[:9], rows.size, rows.group[:9],
        rows.measured[:9], rows.exact,
    )  # fmt: skip
    assert restricted(few, np.zeros((9, 0))).variance > 0.0


def test_missing_targets_count_for_nothing(robot):
    made = make(Case("irb2600", "none", seed=3))
    data = with_history(made.data)
    y = data.y.copy()
    y[::3, 1] = np.nan
    train, _, _ = split(data.with_y(y), 0.2, 0)
    one = studied(made.robot, train, fit_cell(made.robot, train, Options(objective="sum"), silent))
    assert one.rows.count == 3 * int(train.seen.sum())
    found = restricted(one.rows, np.zeros((len(one.rows.error), 0)))
    assert 12e-6 < np.sqrt(found.variance) < 25e-6


def test_a_field_is_as_noisy_as_its_groups_tell():
    """White rows: 1; an error that all rows of a group share: as many times as there are rows."""
    rng, n, count = np.random.default_rng(5), 3000, 6
    group = np.arange(n) // count
    field = np.sign(rng.normal(size=n // count))[group] * 0.1
    white = [inflation(field, field + rng.normal(size=n), group, n) for _ in range(40)]
    assert abs(np.mean(white) - 1.0) < 0.1
    shared = rng.normal(size=n // count)[group] * np.sqrt(0.5)
    alike = inflation(field, field + shared + np.sqrt(0.5) * rng.normal(size=n), group, n)
    assert abs(alike - (1.0 + 0.5 * (count - 1))) < 0.6  # variance of a sum of `count` rows


def test_one_wrong_group_makes_a_field_no_surer():
    rng, n = np.random.default_rng(6), 900
    group, law = np.arange(n) // 9, rng.normal(size=n)
    rest = rng.normal(size=n)
    rest[:9] += 30.0 * np.sign(law[:9])
    field = law * float(law @ rest) / float(law @ law)
    gain = float(field @ field) / float(np.var(rest - field))
    assert gain > 10.0  # as by rows alone: p = 0.001
    assert gain / inflation(field, rest, group, n) < 2.0
