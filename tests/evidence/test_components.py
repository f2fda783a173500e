"""Variances of groups of random factors: what was drawn is found, and what is not there is not."""

import numpy as np

from minimax_cal.evidence.components import fit_components


def test_variances_of_groups_and_noise_are_found():
    rng = np.random.default_rng(0)
    group = np.repeat([0, 1, 2], 60)
    sigma = np.array([3.0, 0.0, 0.5])
    columns = rng.normal(size=(2000, 180))
    error = columns @ (sigma[group] * rng.normal(size=180)) + 2.0 * rng.normal(size=2000)
    basis = np.linalg.qr(rng.normal(size=(2000, 10)))[0]
    error, columns = (part - basis @ (basis.T @ part) for part in (error, columns))
    found = fit_components(
        columns.T @ columns, columns.T @ error, float(error @ error), 1990, group
    )
    assert abs(np.sqrt(found.noise) / 2.0 - 1.0) < 0.05
    spread = np.sqrt(found.variance)
    assert np.all(np.abs(spread[[0, 2]] / sigma[[0, 2]] - 1.0) < 0.2)
    assert spread[1] < 0.05
