"""The parts of the minimax SQP, each against its formula or a problem whose answer is plain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minimax_cal.core.arrays import Array
from minimax_cal.solvers.bfgs import Bfgs
from minimax_cal.solvers.epigraph_qp import (
    SearchStep,
    build_elastic_qp,
    build_epigraph_qp,
    does_step_lower_violation,
    find_functions_above_epigraph_bound,
    ignore_warm_start,
    next_penalties_or_none,
    solve_subproblem,
)
from minimax_cal.solvers.iterate import Iterate, PointTerms
from minimax_cal.solvers.line_search import search_along_step
from minimax_cal.solvers.linearisation import (
    Kkt,
    Linearisation,
    Scaling,
    constraint_excess,
    measure_kkt,
)
from minimax_cal.solvers.minimax import Sqp, merge_similar_notes, solve
from minimax_cal.solvers.status import Status
from qp_backends import Problem, Solution
from qp_backends import Status as QpStatus
from qp_backends import solve as solve_qp

INF = np.inf


def none(mu: Array) -> Array:
    return np.zeros((0, 0))


def linear(
    f: list[float],
    jacobian: list[list[float]],
    c: list[float] | None = None,
    normal: list[list[float]] | None = None,
) -> Linearisation:
    p = len(jacobian[0])
    rows = np.array(normal or [], dtype=float).reshape(-1, p)
    return Linearisation(np.array(f), np.array(jacobian), np.array(c or []), rows, none)


@dataclass(frozen=True)
class Curve:
    """One function of one variable, and x itself as a constraint."""

    value: Callable[[float], float]
    slope: Callable[[float], float]
    lower: Array = field(default_factory=lambda: np.zeros(0))
    upper: Array = field(default_factory=lambda: np.zeros(0))

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        return np.array([self.value(x[0])]), x[: len(self.lower)]

    def linearise(self, x: Array) -> Linearisation:
        f, c = self.evaluate(x)
        return Linearisation(f, np.array([[self.slope(x[0])]]), c, np.ones((len(c), 1)), none)

    def step(self, x: Array, d: Array) -> Array:
        return x + d


def parabola(lower: float = -INF, upper: float = INF) -> Curve:
    rows = np.isfinite([lower, upper]).any()
    bounds = (np.array([lower]), np.array([upper])) if rows else (np.zeros(0), np.zeros(0))
    return Curve(lambda x: x * x, lambda x: 2.0 * x, *bounds)


def begun(problem: Curve, x: float, hessian: str = "bfgs") -> Iterate[Array]:
    return Iterate.start_at(problem, np.array([x]), hessian, np.zeros(0))


def standing(here: Linearisation, mu: Array, lower: Array, upper: Array) -> Iterate[Array]:
    """An iterate at given derivatives."""
    problem = Curve(lambda x: x, lambda x: 1.0, lower, upper)
    none, p = np.zeros(len(here.c)), here.jacobian.shape[1]
    terms, ones = PointTerms.measure(here, np.ones(p), lower, upper), np.ones(p)
    return Iterate(
        problem, np.zeros(1), here, mu, none, None, np.zeros(p), ones, terms, none, 1e-12
    )


def plan(
    d: list[float], mu: list[float], lam: list[float] | None = None, **more: object
) -> SearchStep:
    said = {"usable": True, "backend": "", "notes": ()} | more
    return SearchStep(np.array(d), np.array(mu), np.array(lam or []), **said)


# ---- how far from optimal ----------------------------------------------------------------------

LOWER, UPPER = np.array([-INF, 1.5, -0.2]), np.array([0.7, INF, INF])
BENT = linear(
    [3.0, 1.0, 3.0],
    [[1.0, 0.0], [0.0, 1.0], [-1.0, 2.0]],
    [0.5, 2.0, -1.0],
    [[1.0, 1.0], [0.0, 2.0], [3.0, 0.0]],
)


def test_the_distance_from_optimal_is_its_formula():
    mu, lam = np.array([0.5, 0.2, 0.3]), np.array([0.4, -0.3, 0.0])
    found = measure_kkt(BENT, mu, lam, LOWER, UPPER)
    assert_allclose(found.stationarity, 0.6)  # of (0.5 - 0.3 + 0.4, 0.2 + 0.6 + 0.4 - 0.6)
    assert_allclose(found.complementarity, 0.2 * 2.0 + 0.4 * 0.2 + 0.3 * 0.5)
    assert_allclose(found.violation, 0.8)
    free = linear([3.0, 1.0], [[1.0, -4.0], [0.0, 1.0]])
    found = measure_kkt(free, np.array([0.5, 0.5]), np.zeros(0), np.zeros(0), np.zeros(0))
    assert (found.stationarity, found.complementarity, found.violation) == (1.5, 1.0, 0.0)


@pytest.mark.parametrize("three", [(3.0, 1.0, 2.0), (1.0, 3.0, 2.0), (2.0, 1.0, 3.0)])
def test_the_residual_is_the_largest(three):
    assert Kkt(*three).residual == 3.0


def test_a_violation_that_no_step_lessens_is_hopeless():
    here = linear([0.0], [[1.0]], [2.0, 0.0], [[1.0], [1.0]])
    lower, upper = np.array([-INF, 1.0]), np.array([1.0, INF])
    assert_array_equal(constraint_excess(here.c, lower, upper), [1.0, 1.0])
    assert not does_step_lower_violation(
        here, np.array([0.7]), lower, upper, 1e-8
    )  # one gains what the other loses
    assert does_step_lower_violation(
        here, np.array([0.7]), lower, upper, 3.0
    )  # not violated, so large
    only = replace(here, c=here.c[:1], normal=here.normal[:1])
    assert does_step_lower_violation(only, np.array([-0.1]), lower[:1], upper[:1], 1e-8)
    assert not does_step_lower_violation(only, np.array([0.1]), lower[:1], upper[:1], 1e-8)


# ---- quadratic programs ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("decrease", "curvature"), [(1e20, 1e-8), (4.0, 1e-8), (4e-3, 2.5e-7), (1e-9, 1e-6)]
)
def test_the_epigraph_problem_is_its_formula(decrease, curvature, rng):
    hessian = np.array([[2.0, 0.5], [0.5, 1.0]])
    made = build_epigraph_qp(BENT, 3.5, hessian, LOWER, UPPER, decrease)
    d, v = rng.normal(size=2), rng.normal()
    x = np.append(d, v)
    bent = 0.5 * d @ hessian @ d
    assert_allclose(
        0.5 * x @ made.P @ x + made.q @ x, bent + v + 0.5 * curvature * v * v, rtol=1e-12
    )
    above = BENT.f + BENT.jacobian @ d - 3.5 - v
    assert_allclose((made.A @ x - made.u)[:3], above, rtol=1e-12)
    assert np.all(made.l[:3] == -INF)
    there = BENT.c + BENT.normal @ d
    assert_allclose((made.A @ x)[3:] - made.u[3:], there - UPPER, rtol=1e-12)
    assert_allclose((made.A @ x)[3:] - made.l[3:], there - LOWER, rtol=1e-12)


@pytest.mark.parametrize(("price", "there"), [(0.5, 0.5), (1.9, 1.9), (5.0, 2.0)])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_relaxed_constraint_is_kept_if_its_price_is_high(price, there, sign):
    """Least 1/2 d^2 with |d| 2 at least: the slope d is paid up to the price."""
    low, high = (2.0, INF) if sign > 0.0 else (-INF, -2.0)
    rows = np.array([[0.0, -1.0], [1.0, 0.0]])
    made = Problem(np.diag([1.0, 1e-8]), np.array([0.0, 1.0]), rows, np.array([-INF, low]),
                   np.array([0.0, high]))  # fmt: skip
    found = solve_qp(build_elastic_qp(made, 1, np.array([price])), name="daqp", tolerance=1e-9)
    assert_allclose(found.x[0], sign * there, rtol=1e-6)
    assert_allclose(found.x[2:].sum(), 2.0 - there, atol=1e-6)


def test_multipliers_are_put_in_their_places():
    here = linear([0.0] * 5, [[1.0, 2.0]] * 5, [1.0], [[0.0, 1.0]])
    answer = Solution(np.array([7.0, 8.0, 9.0]), np.array([-1e-9, 0.5, 1.5, -0.25]),
                      QpStatus.SOLVED, 0.0, "daqp", notes=("slow",))  # fmt: skip
    units = Scaling(2.0, np.array([3.0, 0.5]), np.array([4.0]))
    found = SearchStep.from_qp(answer, here, np.array([4, 1, 3]), units)
    assert_array_equal(found.d, [21.0, 4.0])
    assert_array_equal(found.mu, [0.0, 0.25, 0.0, 0.75, 0.0])
    assert_array_equal(found.lam, [-0.125])
    assert (found.usable, found.exact, found.backend, found.notes) == (
        True,
        True,
        "daqp",
        ("slow",),
    )
    rough = SearchStep.from_qp(
        replace(answer, status=QpStatus.INACCURATE), here, np.array([4, 1, 3]), units
    )
    assert_array_equal(rough.d, found.d)
    assert (rough.usable, rough.exact) == (True, False)
    for lost in (replace(answer, status=QpStatus.FAILED), replace(answer, y=np.zeros(4))):
        found = SearchStep.from_qp(lost, here, np.array([4, 1, 3]), units)
        assert_allclose(found.mu, 0.2)
        assert_array_equal(found.lam, [0.0])
        assert found.usable == lost.solved
        assert_array_equal(found.d, [21.0, 4.0] if lost.solved else [0.0, 0.0])


def test_functions_that_were_forgotten_are_the_worst_beyond():
    """Six functions of two variables; the answer makes three of those unknown larger than v."""
    slopes = [[1.0, 0.0], [0.0, 1.0], [3.0, 0.0], [0.0, 0.0], [2.0, 0.0], [0.0, 4.0]]
    here = linear([1.0, 0.0, 1.0, 1.0, 0.0, 0.0], slopes)
    answer = Solution(np.array([1.0, 1.0, 0.5]), np.zeros(1), QpStatus.SOLVED, 0.0)
    # f + f'd - max f - v of all: 0.5, -0.5, 2.5, -0.5, 0.5, 2.5; of equals the first comes first
    assert set(find_functions_above_epigraph_bound(here, np.array([0]), answer).tolist()) == {2, 5}
    assert_array_equal(find_functions_above_epigraph_bound(here, np.array([0, 2]), answer), [5, 4])
    assert_array_equal(find_functions_above_epigraph_bound(here, np.array([0, 2, 5]), answer), [4])
    assert not len(find_functions_above_epigraph_bound(here, np.array([4, 0, 2, 5]), answer))
    assert not len(find_functions_above_epigraph_bound(here, np.arange(6), answer))
    lost = replace(answer, status=QpStatus.FAILED)
    assert_array_equal(
        find_functions_above_epigraph_bound(here, np.array([0, 2]), lost), [1, 3, 4, 5]
    )


def test_of_many_functions_the_largest_come_first():
    values = [0.0, 9.0, 1.0, 8.0, 2.0, 7.0, 3.0]
    mu = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    nothing = np.zeros(0)
    seven = standing(linear(values, [[1.0]] * 7), mu, nothing, nothing)
    assert_array_equal(seven.select_largest_functions(seven.linearisation), [1, 3, 5])
    assert_array_equal(
        replace(seven, qp_count=1).select_largest_functions(seven.linearisation), [1, 2, 3, 5]
    )
    six = linear(values[:6], [[1.0]] * 6)
    assert_array_equal(seven.select_largest_functions(six), range(6))


def test_contradicting_constraints_are_relaxed_at_a_price():
    """x at least 2 and at most 1; a hundred times the slope by the way, or what was paid before."""
    here = linear([0.0], [[-3.0]], [0.0, 0.0], [[1.0], [1.0]])
    at = standing(here, np.ones(1), np.array([2.0, -INF]), np.array([INF, 1.0]))
    qp = partial(solve_qp, name="daqp", tolerance=1e-9)
    for before, price in ((0.0, [150.0, 300.0]), (1e4, [1e4, 1e4])):
        found = solve_subproblem(replace(at, penalties=np.full(2, before)), np.eye(1), qp)
        assert found.usable
        assert found.elastic_penalties is not None
        assert_allclose(found.elastic_penalties, price)
        assert 1.0 - 1e-6 <= found.d[0] <= 2.0 + 1e-6
    agreed = standing(here, np.ones(1), np.array([0.5, -INF]), np.array([INF, 1.0]))
    plain = solve_subproblem(agreed, np.eye(1), qp)
    assert plain.elastic_penalties is None
    assert_allclose(plain.d, 1.0, atol=1e-8)
    moved = solve_subproblem(agreed, np.eye(1), qp, here.f, here.c + 0.25)
    assert_allclose(moved.d, 0.75, atol=1e-8)


# ---- an iterate --------------------------------------------------------------------------------


def test_it_begins_with_even_multipliers_or_those_given():
    problem = Plane(np.array([1.0, 2.0, 4.0, 0.0]))
    at = Iterate.start_at(problem, np.zeros(1), "gauss-newton", np.zeros(0))
    assert_array_equal(at.mu, 0.25)
    assert_array_equal(at.lam, [0.0])
    assert at.quasi_newton is None
    assert at.kkt.residual == at.kkt.complementarity == (4.0 - 7.0 / 4.0) / 4.0
    given = np.array([0.0, 0.5, 0.5, 0.0])
    assert_array_equal(Iterate.start_at(problem, np.zeros(1), "gauss-newton", given).mu, given)
    assert begun(parabola(), 1.0).quasi_newton is not None


@dataclass(frozen=True)
class Plane:
    """Functions that do not change, and a constraint that holds."""

    f: Array
    slope: float | Array = 0.0
    lower: Array = field(default_factory=lambda: np.array([-1.0]))
    upper: Array = field(default_factory=lambda: np.array([1.0]))

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        return self.f, x

    def linearise(self, x: Array) -> Linearisation:
        slopes = np.full((len(self.f), 1), self.slope)
        return Linearisation(self.f, slopes, x, np.ones((1, 1)), lambda mu: np.eye(1))

    def step(self, x: Array, d: Array) -> Array:
        return x + d


@pytest.mark.parametrize(
    "problem",
    [
        Plane(np.array([1.0]), np.nan),
        Plane(np.array([np.nan]), 1.0),
        Plane(np.array([1.0, np.nan]), 1.0),
        Plane(np.array([1.0, 2.0]), np.array([[1.0], [np.nan]])),
    ],
)
def test_what_is_no_number_ends_in_a_status(problem):
    asked: list[Problem] = []
    found = solve(problem, np.zeros(1), ignore_warm_start(asked.append))
    assert found.status is Status.FAILED
    assert asked == []


def test_the_notes_of_backends_are_told_once():
    said = iter(["slow", "slow", "lost"])

    def qp(problem: Problem) -> Solution:
        answer = solve_qp(problem, name="daqp", tolerance=1e-9)
        return replace(answer, notes=(next(said, "lost"),))

    told = []
    hill = Curve(lambda x: np.exp(x) + np.exp(-2 * x), lambda x: np.exp(x) - 2 * np.exp(-2 * x))
    settings = Sqp(hessian="bfgs", iterations=4)
    found = solve(hill, np.array([3.0]), ignore_warm_start(qp), settings, told.append)
    assert found.notes == ("slow (the first of 2 alike)", "lost (the first of 2 alike)")
    assert found.status is Status.ITERATION_LIMIT
    assert found.iterations == len(found.trace) == len(told) == 4
    assert [step.iteration for step in found.trace] == [1, 2, 3, 4]
    assert np.all(np.diff([step.value for step in found.trace]) < 0.0)
    assert replace(found, f=np.array([1.0, 3.0, 2.0])).value == 3.0


def test_notes_that_differ_in_their_numbers_are_one():
    notes = [f"daqp said infeasible, its relative residual is {r}" for r in ("1.2e-08", "4", "inf")]
    first, other = merge_similar_notes([*notes[:2], "slow", notes[1]])
    assert first == f"{notes[0]} (the first of 3 alike)"
    assert other == "slow"
    assert merge_similar_notes(notes[1:]) == tuple(notes[1:])


def test_the_hessian_has_a_floor_and_is_damped():
    here = replace(linear([1.0, 2.0], [[1.0, 0.0], [0.0, 1.0]]), curvature=np.diag)
    at = standing(here, np.array([1.0, 0.0]), np.zeros(0), np.zeros(0))
    assert_array_equal(at.damped_hessian(0.1), np.diag([1.0, 0.05]))
    assert_allclose(replace(at, damping=3.0).damped_hessian(0.1), np.diag([4.0, 0.2]))
    # the floor: 1e-8 of what bends by the level 2 over the length 2 at which f reaches twice 2
    assert_allclose(replace(at, damping=3.0).damped_hessian(0.0), np.diag([4.0, 1.5e-8]))


def test_idle_is_who_falls_neither_in_value_nor_in_residual():
    """f is 1 with the slope 2, which is all of it over the length 1/2: the residual is 1."""
    at = replace(begun(parabola(), 1.0), least_residual=10.0, least_value=5.0, stalled_count=4)
    one, none = plan([0.0], [1.0]), np.zeros(0)
    fell = at.update_after_qp(one.mu, one.lam, none, one.exact)
    assert (fell.least_residual, fell.least_value, fell.stalled_count, fell.qp_count) == (
        1.0,
        1.0,
        0,
        1,
    )
    assert fell.kkt.residual == 1.0
    still = fell.update_after_qp(one.mu, one.lam, none, one.exact)
    assert (still.least_residual, still.least_value, still.stalled_count, still.qp_count) == (
        1.0,
        1.0,
        1,
        2,
    )
    assert (
        replace(at, least_residual=1.05, least_value=1.0)
        .update_after_qp(one.mu, one.lam, none, one.exact)
        .stalled_count
        == 5
    )  # less than a tenth
    assert (
        replace(at, least_residual=1.15, least_value=1.0)
        .update_after_qp(one.mu, one.lam, none, one.exact)
        .stalled_count
        == 0
    )
    value = replace(at, least_residual=0.5, least_value=1.0 + 1e-6).update_after_qp(
        one.mu, one.lam, none, one.exact
    )
    assert (value.least_residual, value.stalled_count) == (0.5, 0)


def judged(at: Iterate[Array], *kkt: float) -> Iterate[Array]:
    """The iterate as if it was so far from optimal."""
    vars(at)["kkt"] = Kkt(*kkt)
    return at


@pytest.mark.parametrize(
    ("residual", "violation", "state", "ended", "rough"),
    [
        (1e-8, 0.0, {"stalled_count": 0}, Status.CONVERGED, Status.CONVERGED),
        (1.1e-8, 0.0, {"stalled_count": 9}, None, None),
        (1.1e-8, 1e-8, {"stalled_count": 10}, Status.STALLED, Status.STALLED),
        (
            1e-6,
            1.1e-8,
            {"stalled_count": 99},
            None,
            Status.STALLED,
        ),  # of a violation that rough QPs leave
        (1e-8, 0.0, {"damping": 1e9}, Status.CONVERGED, Status.CONVERGED),
        (1.0, 0.0, {"damping": 1e8}, None, None),
        (1.0, 1e-8, {"damping": 1.1e8}, Status.STALLED, Status.STALLED),
        (1.0, 1.1e-8, {"damping": 1.1e8}, Status.INFEASIBLE, Status.STALLED),
    ],
)
def test_patience_and_damping_have_an_end(residual, violation, state, ended, rough):
    at = judged(replace(begun(parabola(), 1.0), **state), residual, 0.0, violation)
    end = at.status_before_step if "stalled_count" in state else at.status_after_step
    assert end(1e-8) is ended
    assert end(1e-8, is_exact=False) is rough


def test_values_that_have_all_underflowed_are_optimal():
    nothing = np.zeros(0)
    at = standing(linear([0.0], [[0.0]]), np.ones(1), nothing, nothing)
    assert replace(at, zero_level=0.0).kkt.residual == 0.0


def test_damping_grows_and_falls_tenfold():
    at = begun(parabola(), 1.0)
    assert at.with_more_damping().damping == 1e-3
    assert replace(at, damping=2.0).with_more_damping().damping == 20.0
    there = at.problem.linearise(np.array([0.25]))
    for before, after in ((2.0, 0.2), (2e-6, 2e-7), (1e-6, 0.0), (0.0, 0.0)):
        move = np.array([-0.75])
        moved = replace(at, damping=before).after_step(move, np.array([0.25]), there)
        assert_allclose(moved.damping, after, rtol=1e-12)
    assert_allclose(moved.displacement, -0.75)
    assert_allclose(moved.kkt.stationarity, 0.5 * 0.75 / 0.25**2)  # slope by way over value
    assert_allclose(moved.quasi_newton.matrix, [[2.0]])  # what the two slopes tell


@pytest.mark.parametrize(
    ("relaxed", "d", "penalty", "expected"),
    [
        (False, 0.0, 0.5, 3.0),  # one and a half times the largest multiplier
        (False, 0.0, 7.0, 7.0),
        (True, -1.0, 7.0, 7.0),
        (True, -1.0, 0.5, 5.0),
        (True, 0.0, 7.0, 70.0),  # no step lessens the violation
        (True, 0.0, 2.9e6, 2.9e7),
        (True, 0.0, 3.1e6, None),  # a million times the slope 3
    ],
)
def test_the_price_of_a_violation(relaxed, d, penalty, expected):
    here = linear([0.0], [[-3.0]], [2.0], [[1.0]])
    at = standing(here, np.ones(1), np.array([-INF]), np.array([1.0]))
    one = plan([d], [1.0], [-2.0], elastic_penalties=np.array([5.0]) if relaxed else None)
    found = next_penalties_or_none(replace(at, penalties=np.array([penalty])), one, 1e-8)
    assert (None if found is None else found[0]) == pytest.approx(expected)


# ---- the search along a step -------------------------------------------------------------------


def lost(f: Array, c: Array) -> SearchStep:
    return plan([0.0], [1.0], usable=False)


def test_a_full_step_that_helps_is_taken():
    length, move, end, there = search_along_step(begun(parabola(), 1.0), plan([-0.9], [1.0]), lost)
    assert (length, move[0], there.jacobian[0, 0]) == (1.0, -0.9, 2.0 * end[0])
    assert_allclose(end, 0.1)


@pytest.mark.parametrize(
    ("d", "length"),
    [
        (-2.0, 0.5),  # the vertex of the parabola that the two values and the slope tell
        (-10.0, 0.1),
        (-100.0, 0.01),  # by two steps, neither below a tenth
        (-2.5, 0.4),
    ],
)
def test_a_step_too_long_is_shortened_to_the_vertex(d, length):
    found, move, end, there = search_along_step(begun(parabola(), 1.0), plan([d], [1.0]), lost)
    assert_allclose(found, length, rtol=1e-12)
    assert_allclose(move, length * d, rtol=1e-12)
    assert_allclose([end[0], there.f[0]], 0.0, atol=1e-12)


def test_a_step_is_never_shortened_to_more_than_half_nor_less_than_a_tenth():
    """Beyond a kink nothing is known (NaN); before it a wall leaves the vertex at the start."""
    wall = Curve(lambda x: -x if x < 0.3 else INF, lambda x: -1.0)
    assert search_along_step(begun(wall, 0.0), plan([1.0], [1.0]), lost)[0] == 0.1
    steep = Curve(lambda x: -x if x < 0.3 else 1e9, lambda x: -1.0)
    assert search_along_step(begun(steep, 0.0), plan([1.0], [1.0]), lost)[0] == 0.1
    flat = Curve(lambda x: -x if x < 0.3 else -5e-5 * x, lambda x: -1.0)
    assert (
        search_along_step(begun(flat, 0.0), plan([1.0], [1.0]), lost)[0] == 0.25
    )  # half of a half


def test_no_step_up_a_hill():
    uphill = Curve(lambda x: x, lambda x: -1.0)  # whose slope is told wrong
    length, move, end, _ = search_along_step(begun(uphill, 0.0), plan([1.0], [1.0]), lost)
    assert (length, move[0], end[0]) == (0.0, 0.0, 0.0)


def test_a_violation_counts_at_its_price():
    """From 1 to 0.5 x^2 falls by 0.75, and x is short of its bound 1 by 0.5."""
    at = begun(parabola(lower=1.0), 1.0)
    assert (
        search_along_step(replace(at, penalties=np.array([1.0])), plan([-0.5], [1.0], [0.0]), lost)[
            0
        ]
        == 1.0
    )
    dear = search_along_step(
        replace(at, penalties=np.array([10.0])), plan([-0.5], [1.0], [0.0]), lost
    )
    assert dear[0] == 0.0


def test_the_second_order_correction_is_asked_what_the_step_missed():
    asked = []

    def bent(f: Array, c: Array, usable: bool = True, d: float = -1.0) -> SearchStep:
        asked.append((f, c))
        return plan([d], [1.0], usable=usable)

    at = begun(parabola(lower=-9.0), 1.0)
    length, move, end, there = search_along_step(at, plan([-4.0], [1.0], [0.0]), bent)
    assert_array_equal(asked[0], [[9.0 + 8.0], [-3.0 + 4.0]])
    assert (length, move[0], end[0], there.f[0]) == (1.0, -1.0, 0.0, 0.0)
    for other in ({"usable": False}, {"d": -8.1}, {"d": -2.0}):  # the last is as high as the start
        found = search_along_step(at, plan([-4.0], [1.0], [0.0]), partial(bent, **other))
        assert_allclose(found[0], 0.25)  # the vertex
    far = Curve(lambda x: abs(x + 7.0), lambda x: 1.0)  # at -3 it helps, but not a correction
    twice = search_along_step(begun(far, 1.0), plan([-16.0], [1.0]), partial(bent, d=-8.0))
    assert (twice[0], twice[1][0]) == (1.0, -8.0)


# ---- a Hessian from gradients ------------------------------------------------------------------


def changed(q: list[float]) -> tuple[Linearisation, Linearisation]:
    """Before and after a step along which the Lagrangian's gradient changes by q.

    A third of it by f, with the multiplier 1, the rest by c, with the multiplier 2.
    """
    third = np.array(q) / 3.0
    before = linear([0.0], [[1.0, 1.0]], [0.0], [[2.0, 0.0]])
    jacobian, normal = before.jacobian + third, before.normal + third
    return before, replace(before, jacobian=jacobian, normal=normal)


def updated(start: Bfgs, s: list[float], q: list[float]) -> Bfgs:
    return start.update(np.array(s), *changed(q), np.ones(1), np.full(1, 2.0))


GUESS = Bfgs(np.array([[2.0, 0.5], [0.5, 1.0]]), is_guess=False)


def test_the_hessian_explains_the_latest_step():
    s, q = np.array([1.0, -2.0]), np.array([3.0, -1.0])
    found = updated(GUESS, s.tolist(), q.tolist())
    assert_allclose(found.matrix @ s, q, rtol=1e-12)
    assert_array_equal(found.matrix, found.matrix.T)
    assert np.linalg.eigvalsh(found.matrix)[0] > 0.0
    assert_allclose(
        np.linalg.det(found.matrix),
        np.linalg.det(GUESS.matrix) * (q @ s) / (s @ GUESS.matrix @ s),
        rtol=1e-12,
    )


@pytest.mark.parametrize("q", [[-3.0, 1.0], [0.1, 0.0], [0.0, 0.0]])
def test_curvature_that_is_missing_is_damped_by_powell(q):
    s = np.array([1.0, -2.0])
    found = updated(GUESS, s.tolist(), q)
    assert_allclose(s @ found.matrix @ s, 0.2 * (s @ GUESS.matrix @ s), rtol=1e-12)
    assert np.linalg.eigvalsh(found.matrix)[0] > 0.0


def test_the_first_guess_takes_its_size_from_the_first_step():
    fresh = Bfgs(np.eye(2), is_guess=True)
    s, q = np.array([2.0, 0.0]), np.array([0.4, 0.2])
    size = (q @ q) / (q @ s)
    sized = updated(Bfgs(size * np.eye(2), is_guess=False), s.tolist(), q.tolist())
    found = updated(fresh, s.tolist(), q.tolist())
    assert_allclose(found.matrix, sized.matrix, rtol=1e-12)
    assert not found.is_guess
    back = updated(fresh, s.tolist(), (-q).tolist())  # no size in a fall of the slope
    assert_allclose(back.matrix, updated(replace(fresh, is_guess=False), [2.0, 0.0],
                                         [-0.4, -0.2]).matrix)  # fmt: skip


def test_steps_that_teach_nothing_leave_the_hessian():
    assert updated(GUESS, [0.0, 0.0], [1.0, 1.0]) is GUESS
    assert updated(GUESS, [1.0, 0.0], [np.nan, 1.0]) is GUESS
    hollow = Bfgs(np.diag([0.0, 1.0]), is_guess=False)
    assert updated(hollow, [1.0, 0.0], [1.0, 1.0]) is hollow


def test_the_hessian_begins_with_the_mean_curvature_where_there_is_one():
    here = linear([0.0, 0.0], [[1.0, 0.0], [0.0, 1.0]])
    guess = np.array([1.0, 4.0])
    plain = Bfgs.from_linearisation(here, guess)
    assert plain.is_guess
    assert_array_equal(plain.matrix, np.diag(guess))
    known = Bfgs.from_linearisation(replace(here, curvature=lambda mu: np.diag(mu) + 1.0), guess)
    assert not known.is_guess
    assert_allclose(known.matrix, [[1.5015, 1.0], [1.0, 1.5015]])
