from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from qpsolvers import solve_qp
from scipy import sparse

from qp_backends import Problem, ProblemError, solve


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


def test_row_norm_is_the_same_dense_and_sparse():
    A = np.array([[3.0, 4.0], [0.0, 0.0], [0.0, -2.0]])
    bounds = np.zeros(3), np.ones(3)
    dense = Problem(np.eye(2), np.zeros(2), A, *bounds)
    thin = Problem(sparse.eye_array(2), np.zeros(2), sparse.coo_array(A), *bounds)
    assert_allclose(dense.row_norm, [5.0, 1.0, 2.0], rtol=1e-15)
    assert_allclose(thin.row_norm, dense.row_norm, rtol=1e-15)
    assert thin.has_sparse
    assert not dense.has_sparse


def test_one_sided_rows_say_the_same():
    A = np.array([[1.0, 2.0], [3.0, -1.0], [0.5, 0.5]])
    problem = Problem(np.eye(2), np.zeros(2), A, [-1.0, -np.inf, 0.0], [1.0, 2.0, 4.0])
    rows, bound, low = problem.above
    assert low.tolist() == [True, False, True]
    for x in np.random.default_rng(0).uniform(-2.0, 2.0, (200, 2)):
        inside = bool((problem.l <= A @ x).all() and (A @ x <= problem.u).all())
        assert inside == bool((rows @ x >= bound).all())
    assert problem.boxed
    assert not Problem(np.eye(2), np.zeros(2), A, [0.0, 1.0, 2.0], [0.0, 2.0, 3.0]).boxed


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
