"""No status that is not true, by any backend, in any units: closed forms."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_qp import MAROS_MESZAROS, epigraph, in_units, maros_meszaros

from qp_backends import Problem, Status, accuracy, available, solve, via_cvxpy
from qp_backends.child import call
from qp_backends.registry import fallback_order
from qp_backends.traits import TRAITS

BACKENDS = [*available(), *(["daqp:direct"] if "daqp" in available() else [])]
INF = np.inf
every_backend = pytest.mark.parametrize("name", BACKENDS)
NEGATIVE = (Status.INFEASIBLE, Status.UNBOUNDED)


@every_backend
@pytest.mark.parametrize("r", [1e-4, 1e-10, 1e-16])
def test_a_long_way_is_not_an_endless_one(name, r):
    """min (r x1^2 + x2^2) / 2 - x1 - x2: x = (1 / r, 1), however small r is."""
    for unit in (np.ones(2), np.array([1e-8, 1e8])):
        problem = Problem(np.diag([r, 1.0]), [-1.0, -1.0], np.zeros((0, 2)), [], [])
        solution = solve(in_units(problem, unit), name)
        assert solution.status is Status.SOLVED
        assert_allclose(solution.x / unit, [1.0 / r, 1.0], rtol=1e-5)


@every_backend
@pytest.mark.parametrize("a", [1e-4, 1e-10, 1e-16])
def test_rows_that_meet_far_away_do_not_contradict_each_other(name, a):
    """x1 = 0 and x1 + a x2 = 1 meet at (0, 1 / a)."""
    for unit in (np.ones(2), np.array([1e8, 1e-8])):
        rows = np.array([[1.0, 0.0], [1.0, a]])
        problem = Problem(np.eye(2), np.zeros(2), rows, [0.0, 1.0], [0.0, 1.0])
        solution = solve(in_units(problem, unit), name)
        assert solution.status not in NEGATIVE
        if solution.solved:
            assert_allclose(solution.x / unit, [0.0, 1.0 / a], rtol=1e-5, atol=1e-6)


@every_backend
@pytest.mark.parametrize("p", [(1e3, 1e-5), (1e4, 1e-6), (1e6, 1e-4)])
def test_variables_of_different_weight_are_all_right(name, p):
    """min sum p_i (x_i^2 / 2 - x_i) in a box of +-10: x = (1, 1)."""
    box = np.full(2, 10.0)
    for unit in (np.ones(2), np.array([1e8, 1e-8]), np.array([1e-8, 1e8])):
        problem = Problem(np.diag(p), -np.array(p), np.eye(2), -box, box)
        solution = solve(in_units(problem, unit), name)
        assert solution.status is Status.SOLVED
        assert_allclose(solution.x / unit, [1.0, 1.0], rtol=1e-3)


def built(rng):
    """A strictly convex problem with its solution, some rows active."""
    n, m = int(rng.integers(2, 8)), int(rng.integers(1, 6))
    root, A, x = rng.normal(size=(n, n)), rng.normal(size=(m, n)), rng.normal(size=n)
    P = root.T @ root + 0.1 * np.eye(n)
    active = np.arange(m) < min(m, n) - 1
    y = np.where(active, rng.choice([-1.0, 1.0], m) * rng.uniform(0.1, 2.0, m), 0.0)
    l, u = A @ x - rng.uniform(0.5, 2.0, m), A @ x + rng.uniform(0.5, 2.0, m)  # noqa: E741
    l, u = np.where(y < 0, A @ x, l), np.where(y > 0, A @ x, u)  # noqa: E741
    return Problem(P, -P @ x - A.T @ y, A, l, u), x


@every_backend
def test_status_and_answer_do_not_depend_on_units(name):
    rng = np.random.default_rng(0)
    for _ in range(3 if name == "subgradient" else 10):
        problem, x = built(rng)
        units = (
            10.0 ** rng.uniform(-8.0, 8.0, x.size),
            10.0 ** rng.uniform(-6.0, 6.0, problem.l.size),
        )
        for unit, row, objective in (
            (np.ones(x.size), 1.0, 1.0),
            (*units, 10.0 ** rng.uniform(-6, 6)),
        ):
            solution = solve(in_units(problem, unit, row, objective), name)
            assert solution.status is Status.SOLVED
            assert_allclose(solution.x / unit, x, rtol=0, atol=1e-4 * np.abs(x).max())


@every_backend
def test_what_has_no_solution_is_recognised_in_any_units(name):
    """A direction without curvature, and a row that contradicts two others."""
    rng = np.random.default_rng(1)
    for _ in range(2 if name == "subgradient" else 5):
        n = int(rng.integers(2, 6))
        unit = 10.0 ** rng.uniform(-8.0, 8.0, n)
        flat = np.diag(np.where(np.arange(n) > 0, 1.0, 0.0))
        turned = np.ones((n, n)) - n * np.eye(n)  # without curvature along (1, ..., 1)
        for P in (flat, turned @ turned):
            endless = Problem(P, np.ones(n), np.zeros((0, n)), [], [])
            solution = solve(in_units(endless, unit), name)
            assert solution.status is Status.UNBOUNDED
            ray = solution.certificate / unit
            assert_allclose(P @ ray, 0.0, rtol=0, atol=1e-12 * np.abs(ray).max())
            assert ray.sum() < -1e-3 * np.abs(ray).max()
        rows = rng.normal(size=(3, n))
        rows[2] = -rows[0] - rows[1]
        contradiction = Problem(np.eye(n), np.ones(n), rows, np.full(3, -INF), [1.0, 1.0, -2.1])
        row = 10.0 ** rng.uniform(-6.0, 6.0, 3)
        solution = solve(in_units(contradiction, unit, row), name)
        assert solution.status is Status.INFEASIBLE
        y = solution.certificate * row
        assert_allclose(rows.T @ y, 0.0, rtol=0, atol=1e-12 * np.abs(y).max())
        assert y.min() >= 0.0
        assert y @ contradiction.u < -1e-3 * np.abs(y).max()


def test_a_long_step_in_one_variable_hides_nothing_of_another():
    """x1 = 1e16, and x2 is held at 0 or at 0.5 by a row, or free at 1."""
    P = np.diag([1e-16, 1.0])
    for pull, low, high, truth in (
        (-1.0, -9.0, 0.5, 0.5),
        (1.0, 0.0, 9.0, 0.0),
        (-1.0, -9.0, 9.0, 1.0),
    ):
        problem = Problem(P, [-1.0, pull], np.eye(2), [-1e19, low], [1e19, high])
        for name in BACKENDS:
            solution = solve(problem, name)
            assert solution.status not in NEGATIVE
            if solution.solved:
                assert_allclose(solution.x, [1e16, truth], rtol=1e-3, atol=1e-3)


@pytest.mark.skipif("highs" not in available(), reason="HiGHS is not installed")
def test_no_backend_takes_the_process_down():
    """HiGHS 1.16 does on these data as they are: free() of an invalid pointer."""
    rows = np.array([[8.86e-7, 7.98e-2], [2.139e-2, 1.927e3]])
    P, bounds = np.diag([2.7e-14, 2.2e-4]), np.array([0.0, 1.298e5])
    problem = Problem(P, [-1.8e-8, -4.04e-2], rows, bounds, bounds)
    found = call("qp_backends.judge", "solve", problem, {"name": "highs"}, 60.0)
    assert not any("process ended" in note for note in found.notes)


# ---- qp maros meszaros ---------------------------------------------------------------------------


FILES = sorted(MAROS_MESZAROS.glob("*.mat"))
OBJECTIVES = {  # of the published collection, constant term left out
    "HS21": -99.96 + 100.0,
    "HS35": 0.11111111 - 9.0,
    "TAME": 0.0,
}
pytestmark = pytest.mark.skipif(not FILES, reason=f"no problems in {MAROS_MESZAROS}")


@pytest.mark.parametrize("tolerance", [1e-6, 1e-8])
def test_the_fallback_order_solves_at_least_95_percent(tolerance):
    solved = 0
    for path in FILES:
        problem = maros_meszaros(path)
        first = fallback_order(problem)[0]
        solution = solve(problem, first, tolerance=tolerance, time_limit=20.0)
        judged = accuracy(problem, solution)
        assert solution.solved == (judged.worst <= tolerance)
        assert solution.status not in (Status.INFEASIBLE, Status.UNBOUNDED)
        solved += solution.solved
    assert solved >= 0.95 * len(FILES)


def test_published_objectives():
    for path in FILES:
        if path.stem in OBJECTIVES:
            problem = maros_meszaros(path)
            found = accuracy(problem, solve(problem)).objective
            assert abs(found - OBJECTIVES[path.stem]) < 1e-7


def test_dense_and_sparse_data_have_the_same_optimum():
    for path in FILES:
        thin = maros_meszaros(path)
        if thin.q.size <= 150:
            dense = Problem(thin.P.toarray(), thin.q, thin.A.toarray(), thin.l, thin.u)
            one, other = solve(dense), solve(thin)
            assert one.solved
            assert other.solved
            best = accuracy(thin, other).objective
            np.testing.assert_allclose(accuracy(dense, one).objective, best, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", ["QPCBOEI2", "QSCAGR25"])
def test_daqp_answers_where_a_finer_tolerance_cycles(name):
    problem = maros_meszaros(MAROS_MESZAROS / f"{name}.mat")
    solution = solve(problem, "daqp", tolerance=1e-6, time_limit=60.0, fallback=False)
    assert solution.solved


def test_daqp_starts_no_process_for_what_takes_less_than_its_start():
    """GOULDQP3, which it answers in a fifth of a second."""
    problem = maros_meszaros(MAROS_MESZAROS / "GOULDQP3.mat")
    assert TRAITS["daqp"].pace * sum(problem.A.shape) ** 3 < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["piqp", "clarabel", "highs", "osqp", "daqp", "cvxpy:CLARABEL"])
def test_nothing_wrong_is_called_solved(name):
    for path in FILES:
        problem = maros_meszaros(path)
        reference = accuracy(problem, solve(problem, "clarabel", tolerance=1e-8)).objective
        solution = solve(problem, name, tolerance=1e-6, time_limit=10.0, fallback=False)
        assert solution.status not in (Status.INFEASIBLE, Status.UNBOUNDED)
        if solution.solved:
            found = accuracy(problem, solution).objective
            assert abs(found - reference) <= 1e-4 * max(1.0, abs(reference))


# ---- qp via cvxpy --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", via_cvxpy.solvers())
def test_each_of_its_solvers_gives_x_and_multipliers(name):
    x = cp.Variable()
    try:
        cp.Problem(cp.Minimize(x**2), [x >= 1.0]).solve(solver=name)
    except Exception as error:
        pytest.skip(f"cvxpy lists {name} and cannot run it: {type(error).__name__}")
    problem = epigraph(np.random.default_rng(0))
    exact = solve(problem, "daqp")
    solution = solve(problem, f"cvxpy:{name}", fallback=False)
    assert solution.solved
    assert_allclose(solution.x, exact.x, rtol=0, atol=1e-5 * np.abs(exact.x).max())
    assert_allclose(solution.y, exact.y, rtol=0, atol=1e-5)


def test_problems_of_one_shape_share_a_compiled_model():
    """The second problem is solved with its own data, not with those of the first."""
    via_cvxpy._compiled.cache_clear()
    rng = np.random.default_rng(1)
    for _ in range(3):
        problem = epigraph(rng, 10, 5)
        solution = solve(problem, "cvxpy:CLARABEL", fallback=False)
        assert_allclose(solution.x, solve(problem, "daqp").x, rtol=0, atol=1e-5)
    assert via_cvxpy._compiled.cache_info().misses == 1
    assert via_cvxpy._compiled.cache_info().hits == 2


def test_its_model_is_disciplined_parametrised():
    assert via_cvxpy._compiled(4, 3, 2).problem.is_dcp(dpp=True)


def test_large_problems_are_modelled_with_constants(monkeypatch):
    monkeypatch.setattr(via_cvxpy, "LARGEST_COMPILED", 0)
    rng = np.random.default_rng(2)
    A, x = rng.normal(size=(4, 6)), rng.normal(size=6)
    problem = Problem(np.diag([1.0, 2, 3, 4, 5, 0]), np.ones(6), A, A @ x, A @ x + [0, 1, 0, 1])
    bounded = Problem(problem.P, problem.q - problem.A[0], problem.A, problem.l, problem.u)
    solution = solve(bounded, "cvxpy:CLARABEL")
    assert solution.status is solve(bounded, "daqp").status
