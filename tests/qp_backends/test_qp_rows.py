from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import sparse

from qp_backends import Problem
from qp_backends.rows import multipliers, parts, split

A = np.array([[1.0, 2.0, 0.0], [0.0, -2.0, 0.0], [3.0, 0.0, 1.0], [0.0, 0.0, 4.0], [1.0, 1.0, 1.0]])
L = np.array([-1.0, -4.0, 2.0, -np.inf, -np.inf])
U = np.array([1.0, 6.0, 2.0, 8.0, np.inf])


def problem(stored):
    return Problem(np.eye(3), np.zeros(3), stored(A), L, U)


@pytest.mark.parametrize("stored", [np.array, sparse.csc_array])
def test_the_split_rows_say_the_same_as_the_two_sided_ones(stored):
    rows = split(problem(stored), boxed=True)
    box = rows.box[0]
    assert_array_equal(box.lower, [-np.inf, -3.0, -np.inf])  # -4 ≤ -2x ≤ 6
    assert_array_equal(box.upper, [np.inf, 2.0, 2.0])
    rng = np.random.default_rng(0)
    for x in rng.normal(scale=3.0, size=(200, 3)):
        Ax = A @ x
        inside = (Ax >= L - 1e-12).all() and (Ax <= U + 1e-12).all()
        split_inside = (
            (rows.G @ x <= rows.h + 1e-12).all()
            and (np.abs(rows.E @ x - rows.b) <= 1e-12).all()
            and (x >= box.lower - 1e-12).all()
            and (x <= box.upper + 1e-12).all()
        )
        assert inside == split_inside


@pytest.mark.parametrize("boxed", [False, True])
@pytest.mark.parametrize("stored", [np.array, sparse.csc_array])
def test_multipliers_come_back_with_the_same_force(stored, boxed):
    """A'y is the force of the rows on x, in whatever form they are written."""
    given = problem(stored)
    rows = split(given, boxed)
    y = np.array([-0.5, 0.7, -3.0, 0.2, 0.0])
    z, equal, bounds = parts(rows, y, 3)
    assert (z >= 0).all()
    force = rows.G.T @ z + rows.E.T @ equal + bounds
    assert_allclose(force, A.T @ y, rtol=0, atol=1e-15)
    assert_allclose(multipliers(rows, 5, z, equal, bounds), y, rtol=0, atol=1e-15)


def test_of_two_bounds_on_a_variable_the_tighter_one_holds_and_gets_the_multiplier():
    given = Problem([[1.0]], [0.0], [[1.0], [2.0]], [0.0, 1.0], [5.0, 6.0])
    rows = split(given, boxed=True)
    assert_array_equal(rows.box[0].lower, [0.5])
    assert_array_equal(rows.box[0].upper, [3.0])
    none = np.zeros(0)
    assert_array_equal(multipliers(rows, 2, none, none, np.array([4.0])), [0.0, 2.0])


def test_rows_with_only_upper_bounds_are_not_copied():
    given = Problem(np.eye(3), np.zeros(3), A, np.full(5, -np.inf), np.ones(5))
    rows = split(given)
    assert rows.G is given.A
    assert_array_equal(multipliers(rows, 5, U[:5], rows.b, rows.b), U)
