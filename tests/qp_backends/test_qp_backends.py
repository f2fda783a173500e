"""Every installed backend on the same problems: closed forms, hard ones, ones without solution."""

from __future__ import annotations

import ctypes
import sys
import time
import warnings
from dataclasses import replace

import numpy as np
import pytest
import qpsolvers
from numpy.testing import assert_allclose
from problems_qp import any_problem, epigraph, random_problem
from scipy import sparse

from qp_backends import Problem, Status, accuracy, available, solve
from qp_backends.registry import backend

INSTALLED = [name for name in available() if name != "cvxpy"]
CVXPY = ["cvxpy", "cvxpy:CLARABEL", "cvxpy:OSQP"] if "cvxpy" in available() else []
EXACT = [n for n in ("quadprog", "daqp", "piqp", "clarabel", "proxqp", "osqp") if n in INSTALLED]
INF = np.inf
every_backend = pytest.mark.parametrize("name", INSTALLED + CVXPY)

CLOSED_FORMS = {
    "projection on a box": (
        Problem(np.eye(3), [-2.0, 0.5, 3.0], np.eye(3), -np.ones(3), np.ones(3)),
        [1.0, -0.5, -1.0],
        [1.0, 0.0, -2.0],
    ),
    "shortest vector on a plane": (
        Problem(np.eye(4), np.zeros(4), np.ones((1, 4)), [2.0], [2.0]),
        np.full(4, 0.5),
        [-0.5],
    ),
    "no rows": (Problem(np.diag([1.0, 4.0]), [-1.0, 4.0], np.zeros((0, 2)), [], []), [1, -1], []),
    "no curvature": (  # a linear program: max x + 2y on a triangle
        Problem(
            np.zeros((2, 2)), [-1.0, -2.0], [[1, 1], [1, 0], [0, 1]], [-INF, 0, 0], [1, INF, INF]
        ),
        [0.0, 1.0],
        [2.0, -1.0, 0.0],
    ),
    "curvature in one direction": (
        Problem([[1, 0], [0, 0]], [-1.0, -1.0], [[1, 1], [0, 1]], [-INF, -INF], [3, 1.5]),
        [1.0, 1.5],
        [0.0, 1.0],
    ),
    "all at a corner": (
        Problem(np.eye(2), [1.0, 1.0], np.eye(2), np.zeros(2), np.full(2, INF)),
        [0.0, 0.0],
        [-1.0, -1.0],
    ),
    "only equalities": (
        Problem(np.diag([1.0, 2.0, 3.0]), np.ones(3), [[1, 1, 1], [1, -1, 0]], [1, 0], [1, 0]),
        # with x = y and z = 1 - 2x it is min 3/2 x² + 3/2 (1 - 2x)², so 15 x = 6
        [0.4, 0.4, 0.2],
        [-1.6, 0.2],
    ),
}


@every_backend
@pytest.mark.parametrize("case", CLOSED_FORMS)
def test_closed_forms(name, case):
    problem, x, y = CLOSED_FORMS[case]
    solution = solve(problem, name, fallback=False)
    assert solution.status is Status.SOLVED
    assert solution.backend == name
    # residuals of 1e-8 leave 1e-4 in x where a row touches with multiplier 0 (interior points)
    assert_allclose(solution.x, x, rtol=0, atol=2e-4)
    assert_allclose(solution.y, y, rtol=0, atol=2e-4)


@every_backend
def test_random_problems_have_the_objective_that_cvxpy_finds(name):
    rng = np.random.default_rng(3)
    for rank in (8, 5, 0):
        problem = random_problem(rng, rank=rank)
        reference = solve(problem, "cvxpy:CLARABEL", fallback=False)
        solution = solve(problem, name)
        assert reference.solved
        assert solution.solved
        best = accuracy(problem, reference).objective
        assert_allclose(accuracy(problem, solution).objective, best, rtol=1e-6, atol=1e-6)


@every_backend
def test_sparse_data_give_the_same_answer(name):
    problem = random_problem(np.random.default_rng(4), rank=8)
    thin = Problem(
        sparse.csr_array(problem.P), problem.q, sparse.coo_matrix(problem.A), problem.l, problem.u
    )
    dense, other = solve(problem, name, fallback=False), solve(thin, name, fallback=False)
    assert dense.solved
    assert other.solved
    assert_allclose(other.x, dense.x, rtol=0, atol=1e-6)
    assert_allclose(other.y, dense.y, rtol=0, atol=1e-5)


@every_backend
def test_contradictory_rows_are_recognised(name):
    A = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [0.0, 0.0, 1.0]])
    problem = Problem(np.eye(3), np.ones(3), A, [-INF, 2.1, 0.0], [1.0, INF, 1.0])
    solution = solve(problem, name)
    assert solution.status is Status.INFEASIBLE
    assert np.isnan(solution.x).all()
    y = solution.certificate
    assert_allclose(A.T @ y, 0.0, rtol=0, atol=1e-9)
    assert np.where(y > 0, problem.u, np.where(y < 0, problem.l, 0.0)) @ y < -1e-3


@every_backend
def test_unbounded_problems_are_recognised(name):
    problem = Problem(np.diag([1.0, 0.0]), [0.0, -1.0], [[1.0, -1.0]], [-INF], [1.0])
    solution = solve(problem, name)
    assert solution.status is Status.UNBOUNDED
    ray = solution.certificate
    assert_allclose(problem.P @ ray, 0.0, rtol=0, atol=1e-9)
    assert problem.q @ ray < -1e-3
    assert problem.A @ ray <= 1e-9


@pytest.mark.parametrize("name", [*INSTALLED, *CVXPY, *(["cvxpy:HIGHS"] * ("highs" in INSTALLED))])
def test_a_backend_says_nothing(name, capfd):
    """Nor do those that take over: stdout is for what a command answers."""
    rng = np.random.default_rng(6)
    impossible = Problem(np.eye(1), [0.0], [[1.0], [1.0]], [-INF, 1.0], [0.0, INF])
    endless = Problem(np.zeros((1, 1)), [-1.0], [[1.0]], [0.0], [INF])
    for problem in (epigraph(rng), impossible, endless):
        solve(problem, name)
    solve(random_problem(rng), name, tolerance=1e-300)  # nobody is good enough: all are asked
    if sys.platform != "win32":
        ctypes.CDLL(None).fflush(None)  # what is printed from C waits in a buffer of its own
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize(("n", "m", "count"), [(46, 9, 20), (46, 300, 2)])
def test_the_problems_of_a_calibration_are_solved_to_1e_6(name, n, m, count):
    rng = np.random.default_rng(5)
    for curvature in (0.0, 1e-8):
        for _ in range(count // 2):
            problem = epigraph(rng, n, m, condition=1e4, curvature=curvature)
            solution = solve(problem, name, fallback=False)
            assert solution.solved
            assert accuracy(problem, solution).worst <= 1e-6


def test_all_backends_agree_on_whatever_a_problem_is():
    """Solved with one objective, infeasible or unbounded: for 100 problems of every kind."""
    rng = np.random.default_rng(9)
    seen = set()
    for _ in range(100):
        problem = any_problem(rng)
        found = [solve(problem, name) for name in (*INSTALLED[:2], *rng.choice(INSTALLED[2:8], 2))]
        assert len({solution.status for solution in found}) == 1
        assert found[0].status in (Status.SOLVED, Status.INFEASIBLE, Status.UNBOUNDED)
        seen.add(found[0].status)
        if found[0].solved:
            objectives = [accuracy(problem, solution).objective for solution in found]
            assert_allclose(objectives, objectives[0], rtol=1e-5, atol=1e-5)
    assert len(seen) == 3


@pytest.mark.parametrize("name", [n for n in ("quadprog", "daqp") if n in INSTALLED])
def test_the_check_costs_at_most_as_much_as_the_solve(name):
    """Without qpsolvers in between: measured 1.6 times qpsolvers alone, and 2.5 fails here."""
    problem = epigraph(np.random.default_rng(10))
    G = np.vstack([problem.A, -problem.A[6:]])
    h = np.concatenate([problem.u, -problem.l[6:]])
    bare, checked = [], []
    for _ in range(300):
        start = time.perf_counter()
        qpsolvers.solve_problem(qpsolvers.Problem(problem.P, problem.q, G, h), name)
        middle = time.perf_counter()
        solve(problem, f"{name}:direct")
        bare.append(middle - start)
        checked.append(time.perf_counter() - middle)
    assert min(checked) <= 2.5 * min(bare)


@pytest.mark.parametrize("name", EXACT)
def test_degenerate_problems(name):
    """Each row three times, and a redundant equality."""
    rows = np.vstack([np.eye(4)] * 3 + [np.ones((2, 4))])
    l = np.concatenate([np.zeros(12), [1.0, 1.0]])  # noqa: E741
    u = np.concatenate([np.full(12, INF), [1.0, 1.0]])
    problem = Problem(np.eye(4), [-1.0, 0.0, 1.0, 2.0], rows, l, u)
    solution = solve(problem, name)
    assert solution.solved
    assert_allclose(solution.x, [1.0, 0.0, 0.0, 0.0], rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_badly_scaled_problems(name, factor):
    """The same problem with the objective, the rows or x in other units."""
    x, y = np.array([0.2, 0.3, 1.0]), np.array([0.8, 0.7, 0.0])
    bounds = np.full(3, -INF), np.array([0.2, 0.3, 2.0])
    given = np.eye(3), -np.ones(3), np.eye(3)
    for objective, row, unit in ((factor, 1.0, 1.0), (1.0, factor, 1.0), (1.0, 1.0, factor)):
        problem = Problem(
            objective * unit**2 * given[0],
            objective * unit * given[1],
            row * unit * given[2],
            row * bounds[0],
            row * bounds[1],
        )
        solution = solve(problem, name)
        assert solution.solved
        assert_allclose(unit * solution.x, x, rtol=0, atol=1e-5)
        assert_allclose(row / objective * solution.y, y, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", [n for n in ("osqp", "proxqp", "scs") if n in INSTALLED])
@pytest.mark.parametrize("stored", [np.array, sparse.csc_array])
def test_a_warm_start_gives_the_same_answer(name, stored):
    rng = np.random.default_rng(6)
    problem = epigraph(rng, 20, 60)
    given = Problem(stored(problem.P), problem.q, stored(problem.A), problem.l, problem.u)
    near = Problem(given.P, given.q, given.A, given.l, given.u + 1e-3)
    cold = solve(near, name, fallback=False)
    warm = solve(near, name, fallback=False, warm_start=solve(given, name))
    assert warm.solved
    assert_allclose(warm.x, cold.x, rtol=0, atol=1e-5)


def test_a_warm_start_saves_daqp_its_iterations():
    problem = epigraph(np.random.default_rng(7), 46, 300)
    cold = solve(problem, "daqp")
    warm = solve(problem, "daqp", warm_start=cold)
    assert warm.warm
    assert not cold.warm
    assert warm.iterations < cold.iterations / 4


@pytest.mark.parametrize("name", [n for n in ("osqp", "proxqp", "scs") if n in INSTALLED])
@pytest.mark.parametrize("with_multipliers", [True, False])
def test_a_warm_start_is_handed_to_qpsolvers(name, with_multipliers, monkeypatch):
    """The primal as `initvals`, also where the multipliers are of another number of rows."""
    problem = epigraph(np.random.default_rng(11))
    near = solve(problem, name)
    start = near if with_multipliers else replace(near, y=near.y[:-1])
    seen = []
    plain = qpsolvers.solve_problem

    def listen(qp, solver, initvals=None, **settings):
        seen.append(initvals)
        return plain(qp, solver, initvals=initvals, **settings)

    monkeypatch.setattr(qpsolvers, "solve_problem", listen)
    assert solve(problem, name).warm is False
    assert solve(problem, name, warm_start=start).warm is True
    assert seen[0] is None
    np.testing.assert_array_equal(seen[1], near.x)


@pytest.mark.parametrize("name", [n for n in ("quadprog", "daqp") if n in INSTALLED])
def test_the_direct_way_gives_the_same_answer(name):
    problem = epigraph(np.random.default_rng(12))
    short = Problem(problem.P, problem.q, 1e-6 * problem.A, 1e-6 * problem.l, 1e-6 * problem.u)
    for given in (problem, short):
        usual, direct = solve(given, name), solve(given, f"{name}:direct")
        assert (usual.backend, direct.backend) == (name, f"{name}:direct")
        assert_allclose(direct.x, usual.x, rtol=0, atol=1e-9)
        assert_allclose(direct.y, usual.y, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("name", INSTALLED)
def test_solvers_do_not_change_the_data(name):
    problem = random_problem(np.random.default_rng(8))
    copies = [value.copy() for value in (problem.P, problem.q, problem.A, problem.l, problem.u)]
    solve(problem, name, fallback=False)
    for value, copy in zip(
        (problem.P, problem.q, problem.A, problem.l, problem.u), copies, strict=True
    ):
        np.testing.assert_array_equal(value, copy)


@every_backend
def test_no_backend_warns(name):
    """A solver's warnings are silenced even where it fails: the status says it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        backend(name)(Problem(np.eye(2), [1.0, 1.0], [[1.0, 1.0]], [0.0], [INF]))
        solve(Problem(np.eye(1), [1.0], [[1.0], [1.0]], [-INF, 2.0], [1.0, INF]), name)
    assert not caught
