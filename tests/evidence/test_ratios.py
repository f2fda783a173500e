"""Polynomials between ratios of the noises, and where a likelihood is least."""

import numpy as np
import pytest
from numpy.polynomial import chebyshev
from numpy.testing import assert_allclose, assert_array_equal

from minimax_cal.evidence.ratios import (
    FEW,
    FINE,
    NODES,
    RATIOS,
    find_ratio,
    finely,
    interpolation,
    nodes,
    points,
    vertex,
)
from minimax_cal.ground.arrays import Array


@pytest.mark.parametrize("count", [2, FEW, NODES])
def test_points_are_the_zeros_of_a_chebyshev_polynomial(count):
    at = points(count)
    assert_allclose(chebyshev.chebval(2.0 * at - 1.0, np.eye(count + 1)[count]), 0.0, atol=1e-13)
    assert np.all(np.diff(at) > 0.0)
    assert np.all((at > 0.0) & (at < 1.0))


def test_ratios_are_tried_in_decades():
    assert_allclose(RATIOS, [0.0, *(10.0**power for power in range(-3, 6))], rtol=1e-12)


@pytest.mark.parametrize("decade", [-3, 0, 4])
def test_nodes_lie_so_in_a_decade(decade):
    assert_allclose(np.log10(nodes(decade)), decade + points(NODES), rtol=0, atol=1e-12)


@pytest.mark.parametrize("count", [FEW, NODES])
def test_polynomials_are_met_exactly(count, rng):
    coefficients, at = rng.normal(size=count), points(count)
    x = np.array([0.0, 0.1, at[3], 0.77, 1.0])

    def value(x: Array) -> Array:
        return np.asarray(chebyshev.chebval(2.0 * x - 1.0, coefficients))

    assert_allclose(interpolation(x, count) @ value(at), value(x), rtol=0, atol=1e-12)
    assert_array_equal(interpolation(at, count), np.eye(count))
    x, between = finely()
    assert_allclose(x, np.arange(FINE) / (FINE - 1.0), rtol=0, atol=1e-15)
    assert_array_equal(between, interpolation(x, FEW))


def bowl(least: float, bent: float = 0.0) -> Array:
    """The ratio of least cost where that is a bowl about a power of ten, and 1e3 without joints."""

    def cost(ratios: Array) -> Array:
        off = np.log10(np.where(ratios > 0.0, ratios, 1.0)) - least
        return np.where(ratios > 0.0, off**2 + bent * off**4, 1e3)

    return np.log10(find_ratio(cost))


@pytest.mark.parametrize("least", [-2.9, -2.02, -0.3, 0.0, 1.7183, 4.4, 4.95])
def test_the_likeliest_ratio_is_found_between_those_that_are_tried(least):
    assert_allclose(bowl(least), least, rtol=0, atol=1e-9)
    assert_allclose(bowl(least, bent=1.0), least, rtol=0, atol=1e-6)


def test_beyond_the_ends_it_is_the_end():
    assert_allclose([bowl(-4.5), bowl(7.0)], np.log10(RATIOS[[1, -1]]), atol=1e-12)


def test_it_is_none_where_none_is_better():
    assert find_ratio(lambda ratios: np.where(ratios > 0.0, 1.0, 0.0)) == 0.0
    assert find_ratio(lambda ratios: 0.0 * ratios) == 0.0


def test_a_vertex_is_that_of_the_parabola():
    x = np.arange(5.0)
    for least in (1.6, 2.0, 2.4):
        assert_allclose(2.0 + vertex(3.0 * (x - least) ** 2 - 7.0, 2), least, rtol=1e-12)
    for at in (0, 4):
        assert vertex((x - at) ** 2 + x, at) == 0.0
    assert vertex(0.0 * x, 2) == vertex(-((x - 1.7) ** 2), 2) == 0.0
