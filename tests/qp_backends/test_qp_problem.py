from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems_qp import epigraph, in_units, random_problem
from qpsolvers import solve_qp
from scipy import sparse

from qp_backends import (
    BackendError,
    Problem,
    ProblemError,
    Solution,
    Status,
    accuracy,
    eliminate,
    solve,
)
from qp_backends.elimination import restore
from qp_backends.polish import polish
from qp_backends.rows import multipliers, parts, split

# ---- qp problem ----------------------------------------------------------------------------------


def test_data_become_float_arrays_and_far_bounds_open():
    problem = Problem([[2, 0], [0, 2]], [1, 1], [[1, 1]], [-1e20], [5])
    assert problem.P.dtype == problem.q.dtype == problem.A.dtype == np.float64
    assert_array_equal(problem.l, [-np.inf])
    assert_array_equal(problem.u, [5.0])


@pytest.mark.parametrize("kind", [np.asarray, sparse.csc_matrix])
def test_what_qpsolvers_takes_has_the_same_answer(kind):
    """Each part alone and all together, against qpsolvers itself."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(5, 4))
    P, q = root.T @ root + np.eye(4), rng.normal(size=4)
    parts = {
        "G": kind(rng.normal(size=(3, 4))), "h": np.ones(3),
        "A": kind(rng.normal(size=(1, 4))), "b": np.array([0.3]),
        "lb": np.full(4, -0.5), "ub": np.full(4, 0.4),
    }  # fmt: skip
    for names in ((), ("G", "h"), ("A", "b"), ("lb",), ("ub",), tuple(parts)):
        given = {name: parts[name] for name in names}
        plain = {n: v.toarray() if sparse.issparse(v) else v for n, v in given.items()}
        expected = solve_qp(P, q, solver="daqp", **plain)
        found = solve(Problem.from_qpsolvers(kind(P), q, **given), "daqp")
        assert_allclose(found.x, expected, atol=1e-9)
    for wrong, said in (
        ({"G": parts["G"]}, "G needs h"),
        ({"h": parts["h"]}, "G needs h"),
        ({"G": parts["G"], "h": np.ones(2)}, "G: rows of 4 numbers"),
        ({"A": np.ones((1, 3)), "b": [1.0]}, "A: rows of 4 numbers"),
        ({"lb": np.zeros(3)}, "has shape"),
    ):
        with pytest.raises(ProblemError, match=said):
            Problem.from_qpsolvers(P, q, **wrong)


def test_read_only_data_are_copied():
    P = np.eye(2)
    P.flags.writeable = False
    assert Problem(P, np.zeros(2), np.zeros((0, 2)), [], []).P.flags.writeable


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"P": np.ones((2, 3))}, "square"),
        ({"P": np.ones(2)}, "two dimensions"),
        ({"P": [[1.0, 1.0], [0.0, 1.0]]}, "both triangles"),
        ({"q": [1.0]}, r"q has shape \(1,\)"),
        ({"A": np.ones((1, 3))}, "A has 3 columns"),
        ({"l": [0.0, 0.0]}, "l has shape"),
        ({"u": [np.nan]}, "NaN"),
        ({"q": [np.nan, 0.0]}, "q holds NaN"),
        ({"A": [[np.inf, 0.0]]}, "A holds NaN or infinite"),
    ],
)
def test_what_cannot_be_meant_is_refused(change, message):
    data = {"P": np.eye(2), "q": np.zeros(2), "A": np.ones((1, 2)), "l": [0.0], "u": [1.0]}
    with pytest.raises(ProblemError, match=message):
        Problem(**(data | change))


STORED = pytest.mark.parametrize("stored", [np.array, sparse.csc_array])


def free(P):
    return Problem(P, np.zeros(P.shape[0]), np.zeros((0, P.shape[0])), [], [])


@STORED
@pytest.mark.parametrize("unit", [1e-8, 1.0, 1e8])
@pytest.mark.parametrize("e", [1e-2, 1e-6, 1e-9])
def test_a_saddle_or_a_maximum_is_refused(stored, unit, e):
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    units = np.outer([1.0, unit], [1.0, unit])
    for P in (np.diag([1.0, -e]), -np.eye(2), turn @ np.diag([1.0, -e]) @ turn.T):
        with pytest.raises(ProblemError, match="not positive semidefinite"):
            free(stored(P * units))
    for P in (np.array([[0.0, e], [e, 1.0]]), np.array([[1.0, 1.0 + e], [1.0 + e, 1.0]])):
        with pytest.raises(ProblemError, match="not positive semidefinite"):
            free(stored(P * units))


@STORED
def test_rounding_of_a_semidefinite_matrix_is_not_curvature(stored):
    """Gram matrices of every rank, in units from 1e-8 to 1e8; the data are not changed."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        n = int(rng.integers(1, 12))
        root = rng.normal(size=(rng.integers(0, n + 1), n)) * 10.0 ** rng.uniform(-8.0, 8.0, n)
        P = root.T @ root
        assert_array_equal(np.asarray(free(stored(P)).P @ np.eye(n)), P)


# ---- qp accuracy ---------------------------------------------------------------------------------


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
    other = in_units(problem, unit, row, factor)
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


# ---- qp polish -----------------------------------------------------------------------------------


@pytest.mark.parametrize("stored", [np.array, sparse.csc_array])
@pytest.mark.parametrize("error", [1e-8, 1e-5, 1e-3])
def test_a_nearby_answer_becomes_exact(stored, error):
    rng = np.random.default_rng(0)
    for given in (epigraph(rng, 20, 9), random_problem(rng, rank=8)):
        problem = Problem(stored(given.P), given.q, stored(given.A), given.l, given.u)
        exact = solve(given, "daqp")
        x = exact.x * (1 + error * rng.normal(size=exact.x.size))
        y = exact.y * (1 + error * rng.normal(size=exact.y.size))
        rough = Solution(x, y, Status.INACCURATE, 0.0)
        assert accuracy(problem, rough).worst > error / 100
        assert accuracy(problem, polish(problem, rough)).worst < 1e-11


def test_dependent_active_rows_do_no_harm():
    rows = np.vstack([np.ones((3, 2)), np.eye(2)])
    problem = Problem(np.eye(2), np.zeros(2), rows, np.ones(5) * [1, 1, 1, 0, 0], np.full(5, 9.0))
    rough = Solution(np.array([0.5, 0.5001]), -np.array([0.2, 0.1, 0.2, 0, 0]), Status.SOLVED, 0.0)
    assert accuracy(problem, polish(problem, rough)).worst < 1e-12


@pytest.mark.parametrize("x", [np.full(20, np.nan), np.zeros(20), np.full(20, 1e200)])
def test_an_answer_is_never_made_worse(x):
    problem = epigraph(np.random.default_rng(1), 20, 9)
    bad = Solution(x, np.zeros(9), Status.SOLVED, 0.0)
    assert accuracy(problem, polish(problem, bad)).worst <= accuracy(problem, bad).worst


# ---- qp rows -------------------------------------------------------------------------------------


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


# ---- qp elimination ------------------------------------------------------------------------------


def objective(problem, x):
    return 0.5 * x @ problem.P @ x + problem.q @ x


@pytest.mark.parametrize("stored", [np.array, sparse.csc_array])
def test_with_the_row_that_is_active_it_is_the_same_problem(stored):
    """Any row with a positive multiplier may be fixed: it holds with equality anyway."""
    given = epigraph(np.random.default_rng(0), 12, 9, curvature=1e-3)
    problem = Problem(stored(given.P), given.q, stored(given.A), given.l, given.u)
    exact = solve(given, "daqp")
    for active in np.flatnonzero(exact.y[:6] > 1e-6):
        elimination = eliminate(problem, int(active))
        assert elimination.problem.q.size == 11
        smaller = solve(elimination.problem, "daqp")
        answer = restore(elimination, smaller)
        assert accuracy(problem, answer).worst < 1e-10
        assert_allclose(answer.x, exact.x, rtol=0, atol=1e-8)
        assert_allclose(answer.y, exact.y, rtol=0, atol=1e-8)


def test_the_rows_are_those_of_the_paper():
    """(gᵢ - g_I)'d ≤ F_I - F_i, gradient g_I; paper M eq. 20, 22, 25, 27."""
    rng = np.random.default_rng(1)
    g, F = rng.normal(size=(3, 4)), np.array([1.0, 3.0, 2.0])
    H = np.eye(5) * [1, 2, 3, 4, 0]
    A = np.hstack([g, -np.ones((3, 1))])
    problem = Problem(H, np.eye(5)[4], A, np.full(3, -np.inf), F.max() - F)
    elimination = eliminate(problem)
    assert elimination.active == 1  # the largest F
    assert_allclose(elimination.problem.A, g[[0, 2]] - g[1], rtol=0, atol=1e-15)
    assert_allclose(elimination.problem.u, F[1] - F[[0, 2]], rtol=0, atol=1e-15)
    assert_allclose(elimination.problem.q, g[1], rtol=0, atol=1e-15)
    assert_allclose(elimination.problem.P, H[:4, :4], rtol=0, atol=1e-15)


def test_it_is_a_restriction():
    """Its objective is never better, and worse where the fixed row is not active."""
    rng = np.random.default_rng(2)
    worse = 0
    for _ in range(20):
        problem = epigraph(rng, 6, 5)
        exact = solve(problem, "daqp")
        elimination = eliminate(problem)
        answer = restore(elimination, solve(elimination.problem, "daqp"))
        best, found = objective(problem, exact.x), objective(problem, answer.x)
        assert accuracy(problem, answer).primal < 1e-9
        assert found >= best - 1e-9
        if found > best + 1e-6:
            worse += 1
            assert answer.y[elimination.active] < 0  # the multiplier tells
    assert worse > 0


def test_what_is_not_an_epigraph_problem_is_refused():
    plain = Problem(np.eye(2), np.ones(2), np.eye(2), np.zeros(2), np.ones(2))
    with pytest.raises(BackendError, match="not an epigraph problem"):
        eliminate(plain)
    coupled = Problem([[1, 0.5], [0.5, 1]], [0, 1], [[1, -1]], [-np.inf], [0])
    with pytest.raises(BackendError, match="couples"):
        eliminate(coupled)
    with pytest.raises(BackendError, match="row 8"):
        eliminate(epigraph(np.random.default_rng(0)), 8)


def test_row_norm_is_the_same_dense_and_sparse():
    A = np.array([[3.0, 4.0], [0.0, 0.0], [0.0, -2.0]])
    bounds = np.zeros(3), np.ones(3)
    dense = Problem(np.eye(2), np.zeros(2), A, *bounds)
    thin = Problem(sparse.eye_array(2), np.zeros(2), sparse.coo_array(A), *bounds)
    assert_allclose(dense.row_norm, [5.0, 1.0, 2.0], rtol=1e-15)
    assert_allclose(thin.row_norm, dense.row_norm, rtol=1e-15)
    assert thin.has_sparse
    assert not dense.has_sparse
