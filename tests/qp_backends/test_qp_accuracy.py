from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_qp import epigraph
from scipy import sparse

from qp_backends import Problem, Solution, Status, accuracy, solve


def answer(x, y):
    return Solution(np.asarray(x, float), np.asarray(y, float), Status.SOLVED, 0.0)


# min ½x² - 3x with x ≤ 1: x = 1, y = 2, objective -2.5
ONE = Problem([[1.0]], [-3.0], [[1.0]], [-np.inf], [1.0])


def test_the_optimum_has_no_residual():
    judged = accuracy(ONE, answer([1.0], [2.0]))
    assert judged.worst == 0.0
    assert judged.objective == -2.5


def test_residuals_are_what_the_formulas_say():
    judged = accuracy(ONE, answer([1.5], [1.0]))
    assert_allclose(judged.primal, 0.5, rtol=1e-15)  # 1.5 - 1
    assert_allclose(judged.dual, 0.5, rtol=1e-15)  # 1.5 - 3 + 1
    assert_allclose(judged.gap, 1.25, rtol=1e-15)  # 2.25 - 4.5 + 1
    # a millionth of a variable's reach counts beside the terms of a row
    assert_allclose(judged.primal_relative, 0.5 / 1.5, rtol=2e-6)
    assert_allclose(judged.dual_relative, 0.5 / 3.0, rtol=1e-15)
    assert_allclose(judged.gap_relative, 1.25 / 4.5, rtol=2e-6)


def test_a_multiplier_at_an_open_side_counts_as_missing():
    judged = accuracy(ONE, answer([3.0], [-1e-3]))  # stationary but for the inadmissible -1e-3
    assert judged.dual == 0.0
    assert_allclose(judged.primal, 2.0, rtol=1e-15)


def test_lower_and_upper_bounds_have_multipliers_of_opposite_sign():
    problem = Problem(np.eye(2), [3.0, -3.0], np.eye(2), [-1.0, -1.0], [1.0, 1.0])
    assert accuracy(problem, answer([-1.0, 1.0], [-2.0, 2.0])).worst == 0.0
    assert accuracy(problem, answer([-1.0, 1.0], [2.0, -2.0])).worst > 0.5


def test_sparse_and_dense_are_judged_alike():
    rng = np.random.default_rng(0)
    dense = epigraph(rng)
    thin = Problem(sparse.csc_array(dense.P), dense.q, sparse.csr_array(dense.A), dense.l, dense.u)
    given = answer(rng.normal(size=46), rng.normal(size=9))
    one, other = accuracy(dense, given), accuracy(thin, given)
    for name in ("primal", "dual", "gap", "worst", "objective"):
        assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-12)


@pytest.mark.parametrize("factor", [1e-8, 1e8])
def test_relative_numbers_do_not_depend_on_units(factor):
    """Of the objective, of rows and of variables: only the millionth of a reach follows them."""
    rng = np.random.default_rng(1)
    problem = epigraph(rng)
    x, y = rng.normal(size=46), np.abs(rng.normal(size=9))
    row = np.where(np.arange(9) % 2, factor, 1.0)
    unit = 10.0 ** rng.uniform(-8.0, 8.0, 46)
    other = Problem(
        factor * problem.P / np.outer(unit, unit),
        factor * problem.q / unit,
        row[:, None] * problem.A / unit,
        row * problem.l,
        row * problem.u,
    )
    before, after = (
        accuracy(problem, answer(x, y)),
        accuracy(other, answer(unit * x, factor * y / row)),
    )
    for name in ("primal_relative", "dual_relative", "gap_relative"):
        assert_allclose(getattr(after, name), getattr(before, name), rtol=1e-3)


@pytest.mark.parametrize(("p", "wrong"), [(1e3, 1e-5), (1e6, 1e-10)])
def test_a_variable_is_judged_by_its_own_terms(p, wrong):
    """x2 is off by 100 % and adds a part of 1e-8, or 1e-16, to the objective: truth (1, 1)."""
    problem = Problem(np.diag([p, wrong]), [-p, -wrong], np.eye(2), [-9.0, -9.0], [9.0, 9.0])
    assert accuracy(problem, answer([1.0, 1.0], [0.0, 0.0])).worst == 0.0
    assert_allclose(accuracy(problem, answer([1.0, 0.0], [0.0, 0.0])).dual_relative, 1.0)
    held = Problem(np.diag([p, wrong]), [-p, -3 * wrong], np.eye(2), [-9.0, -9.0], [9.0, 1.0])
    assert accuracy(held, answer([1.0, 1.0], [0.0, 2 * wrong])).worst < 1e-15
    assert accuracy(held, answer([1.0, 0.0], [0.0, 3 * wrong])).gap_relative > 0.1  # not at x2 = 1


def test_rows_that_nearly_contradict_each_other_are_not_met_far_away():
    """a'x >= 1 and a'x <= 0: at 1e18 along the row the violation 1 is rounding of the terms."""
    rows = np.array([[1.0, 1.0], [1.0, 1.0]])
    problem = Problem(np.eye(2), np.zeros(2), rows, [1.0, -np.inf], [np.inf, 0.0])
    for x in ([1e18, -1e18], [0.5, 0.5], [1e18, 1.0 - 1e18]):
        assert accuracy(problem, answer(x, [-1.0, 1.0])).worst > 0.1


def test_rounding_at_a_solution_that_vanishes_is_forgiven():
    cone = Problem(np.eye(2), [1.0, 2.0], np.eye(2), np.zeros(2), np.full(2, np.inf))
    assert accuracy(cone, answer([-1e-15, 1e-15], [-1.0, -2.0])).worst < 1e-8
    assert accuracy(cone, answer([-1e-3, 0.0], [-1.0, -2.0])).worst > 1e-4


def test_no_rows_leave_only_the_gradient():
    free = Problem(np.eye(2), [1.0, 2.0], np.zeros((0, 2)), [], [])
    assert accuracy(free, answer([-1.0, -2.0], [])).worst == 0.0
    assert_allclose(accuracy(free, answer([-1.0, -1.0], [])).dual, 1.0, rtol=1e-15)


@pytest.mark.parametrize(
    ("x", "y"),
    [([np.nan], [0.0]), ([1.0], [np.nan]), ([np.inf], [0.0]), ([], []), ([1.0, 2.0], [0.0])],
)
def test_without_numbers_of_the_right_shape_everything_is_infinite(x, y):
    judged = accuracy(ONE, answer(x, y))
    assert judged.worst == np.inf
    assert judged.primal == judged.dual == judged.gap == np.inf


def test_the_solution_tells_its_own_residual():
    problem = epigraph(np.random.default_rng(2))
    solution = solve(problem)
    assert solution.residual == accuracy(problem, solution).worst


def test_a_problem_without_objective_is_judged_by_its_rows():
    anywhere = Problem(np.zeros((2, 2)), np.zeros(2), np.eye(2), [1.0, 1.0], [2.0, 2.0])
    assert accuracy(anywhere, answer([1.5, 1.5], [1e-12, 0.0])).worst < 1e-11
    assert accuracy(anywhere, answer([0.5, 1.5], [0.0, 0.0])).worst > 0.1


def test_least_norm_in_small_units_is_not_taken_for_zero():
    tiny = Problem(np.eye(2), np.zeros(2), np.ones((1, 2)), [1e-9], [1e-9])
    assert accuracy(tiny, answer([5e-10, 5e-10], [-5e-10])).worst < 1e-15
    assert accuracy(tiny, answer([0.0, 0.0], [0.0])).worst > 0.1
