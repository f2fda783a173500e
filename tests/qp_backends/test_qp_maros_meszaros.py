"""The problems of Maros and Meszaros that are shared with the project."""

from __future__ import annotations

import numpy as np
import pytest
from problems_qp import MAROS_MESZAROS, maros_meszaros

from qp_backends import Problem, Status, accuracy, solve
from qp_backends.registry import fallback_order
from qp_backends.traits import TRAITS

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
