"""Paper M's Algorithm 1 to the letter."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments import algorithm_1
from experiments.algorithm_1 import GOOD, Job, course_of, problem_of, rows_of, subproblem
from qp_backends import Problem, subgradient


@pytest.fixture(scope="module")
def course() -> algorithm_1.Course:
    return course_of(Job("irb2600", 0, 10), ("subgradient:raw",))


def test_the_printed_algorithm_comes_near_the_optimum(course):
    """A thousandth of what the start is off by, within ten outer steps, full steps or searched."""
    for values in course.ways.values():
        assert values[10] <= min(GOOD, 1e-3 * values[0])
        assert min(values) > -1e-9  # nothing is below the optimum


def test_a_line_search_never_rises(course):
    assert (np.diff(course.ways["with a line search"]) <= 1e-9).all()


def test_our_backend_of_the_method_comes_as_near(course):
    assert course.ours["subgradient:raw"] <= 1e-3


@pytest.mark.slow  # loops that are not compiled; `test_the_inner_loop_...` holds the iterates
def test_the_eliminated_form_comes_nearer():
    ours = course_of(Job("irb2600", 0, 0), ("subgradient:eliminated",)).ours
    assert ours["subgradient:eliminated"] <= 1e-5


def test_the_inner_loop_is_that_of_our_backend():
    """Written twice, from the paper: the same iterates."""
    problem, start = problem_of(Job("irb2600", 0, 1), "squared")
    at = problem.linearise(start)
    slope, C, G = rows_of(at)
    H = at.curvature(np.full(3, 1.0 / 3.0))
    dx, lam = subproblem(H, slope, C, G)
    given = Problem(H, slope, G, np.full(len(C), -np.inf), -C)
    ours = subgradient.solve(given, method="raw", tolerance=0.0, iterations=3_008)
    near = subgradient.solve(given, method="raw", tolerance=0.0, iterations=2_944)
    assert_allclose(dx, ours.x, atol=np.abs(ours.x - near.x).max() + 1e-12)
    assert_allclose(lam, ours.y, atol=np.abs(ours.y - near.y).max() + 1e-12)


def test_rows_are_those_of_the_paper():
    """The active function's own row is zero; a distance that is met exactly leaves C = -1."""
    problem, start = problem_of(Job("irb2600", 0, 1), "squared")
    at = problem.linearise(start)
    slope, C, G = rows_of(at)
    active = int(at.f.argmax())
    assert C[active] == 0.0
    assert not G[active].any()
    assert (C[:3] <= 0.0).all()
    assert_allclose(slope, at.jacobian[active])
    assert (C[3:] >= -1.0).all()
