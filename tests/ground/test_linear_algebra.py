"""Projection, Schur complement, scaling and the jackknife, each by its definition."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minimax_cal.core.linear_algebra import (
    column_norms_from_gram,
    divide_by_scales,
    jackknife_variance,
    project_out,
    schur_complement,
)


def test_what_is_projected_out_is_what_least_squares_leaves(rng: np.random.Generator) -> None:
    basis = np.linalg.qr(rng.normal(size=(30, 4)))[0]
    columns = rng.normal(size=(30, 3))
    value = np.linalg.lstsq(basis, columns, rcond=None)[0]
    assert_allclose(project_out(columns, basis), columns - basis @ value, atol=1e-14)
    assert_allclose(project_out(columns[:, 0], basis), (columns - basis @ value)[:, 0], atol=1e-14)


@pytest.mark.parametrize("size", [1.0, 1e-6])
def test_the_schur_complement_is_the_gram_matrix_of_residuals(
    rng: np.random.Generator, size: float
) -> None:
    columns = rng.normal(size=(40, 7)) * np.append(size, np.ones(6))
    basis = np.linalg.qr(columns[:, :3])[0]
    rest = project_out(columns[:, 3:], basis)
    assert_allclose(schur_complement(columns.T @ columns, 3), rest.T @ rest, rtol=1e-10, atol=1e-12)
    twice = np.concatenate([columns[:, :1], columns], axis=1)  # no pose tells these apart
    found = schur_complement(twice.T @ twice, 4, ridge=1e-13)
    assert_allclose(found, rest.T @ rest, rtol=1e-6, atol=1e-9)


def test_a_scaled_gram_matrix_is_that_of_scaled_columns(rng: np.random.Generator) -> None:
    columns = rng.normal(size=(2, 20, 5))
    gram = np.swapaxes(columns, 1, 2) @ columns
    scale = column_norms_from_gram(gram)
    assert_allclose(scale, np.linalg.norm(columns, axis=1), rtol=1e-14)
    unit = columns / scale[:, None]
    assert_allclose(divide_by_scales(gram, scale), np.swapaxes(unit, 1, 2) @ unit, atol=1e-14)
    assert np.all(column_norms_from_gram(np.zeros((3, 3))) > 0.0)


def test_the_jackknife_of_a_mean_is_its_standard_error(rng: np.random.Generator) -> None:
    numbers = rng.normal(size=(25, 2))
    without = np.array([np.delete(numbers, i, axis=0).mean(axis=0) for i in range(25)])
    assert_allclose(jackknife_variance(without), numbers.var(axis=0, ddof=1) / 25, rtol=1e-12)
