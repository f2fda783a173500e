import warnings
from dataclasses import dataclass, field, replace
from functools import partial

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from experiments import cones
from experiments.cones import Settings, ahead
from minimax_cal.solvers import minimax
from minimax_cal.solvers.dual_bound import Multipliers, Rows, aligned, lower_bound, of_squares
from minimax_cal.solvers.status import Status
from qp_backends import solve as solve_qp

NONE = np.zeros(0)


def reference(rows: Rows, lower: np.ndarray, upper: np.ndarray) -> float:
    """Optimum of the linearised problem, stated for cvxpy with nothing of ours in between.

    NaN where cvxpy's solver says that its answer is inaccurate.
    """
    d = cp.Variable(rows.J.shape[2])
    norms = [cp.norm(r + J @ d) for r, J in zip(rows.r, rows.J, strict=True)]
    c = rows.c + rows.C @ d if len(rows.c) else None
    kept = [] if c is None else [
        *(c[k] >= low for k, low in enumerate(lower) if np.isfinite(low)),
        *(c[k] <= high for k, high in enumerate(upper) if np.isfinite(high)),
    ]  # fmt: skip
    problem = cp.Problem(cp.Minimize(cp.max(cp.hstack(norms))), kept)
    tight = {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        value = float(problem.solve(solver="CLARABEL", **tight))
    return value if problem.status == cp.OPTIMAL else np.nan


@dataclass(frozen=True)
class Linear:
    """A problem that is linear as it stands; x in R^p."""

    rows: Rows
    lower: np.ndarray = field(default_factory=lambda: NONE)
    upper: np.ndarray = field(default_factory=lambda: NONE)

    def linearise(self, x: np.ndarray) -> Rows:
        rows = self.rows
        return Rows(rows.r + rows.J @ x, rows.J, rows.c + rows.C @ x, rows.C)

    def step(self, x: np.ndarray, d: np.ndarray) -> np.ndarray:
        return x + d


def random_problem(seed: int, n: int, p: int, constraints: int, w: int = 3) -> Linear:
    """Constraints of all kinds: two-sided, open on either side, equal; x = 0 may break them."""
    rng = np.random.default_rng(seed)
    rows = Rows(
        rng.normal(size=(n, w)),
        rng.normal(size=(n, w, p)),
        rng.normal(size=constraints),
        rng.normal(size=(constraints, p)),
    )
    inside = rows.c + rows.C @ rng.normal(size=p) * 0.3
    width = rng.uniform(0, 0.5, (2, constraints)) * rng.choice([0.0, 1.0], constraints)
    lower, upper = inside - width[0], inside + width[1]
    lower[::3], upper[1::3] = -np.inf, np.inf
    return Linear(rows, lower, upper)


sizes = st.tuples(st.integers(0, 2**31), st.integers(1, 30), st.integers(1, 6), st.integers(0, 3))
slow = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@slow
@given(sizes)
def test_optimum_is_cvxpys(size: tuple[int, int, int, int]) -> None:
    seed, n, p, constraints = size
    problem = random_problem(seed, n + p, p, min(constraints, p))
    best = reference(problem.rows, problem.lower, problem.upper)
    assume(best > 1e-3)
    found = cones.solve(problem, np.zeros(p))
    assert found.status is Status.CONVERGED
    assert_allclose(found.value, best, rtol=1e-8)
    assert found.violation <= 1e-9
    assert -1e-8 <= found.gap <= 1e-8


@slow
@given(sizes, st.floats(0.0, 3.0), st.booleans())
def test_no_multipliers_give_a_bound_above_the_optimum(
    size: tuple[int, int, int, int], noise: float, right: bool
) -> None:
    """Right multipliers, wrong ones, infeasible ones: the bound is one whatever they are."""
    seed, n, p, constraints = size
    problem = random_problem(seed, n, p, min(constraints, p))
    best = reference(problem.rows, problem.lower, problem.upper)
    assume(np.isfinite(best))
    rng = np.random.default_rng(seed)
    y, lam = rng.normal(size=(n, 3)), rng.normal(size=len(problem.lower))
    if right:
        exact = cones.solve(problem, np.zeros(p)).multipliers
        y, lam = exact.y + noise * y / n, exact.lam + noise * lam
    bound = lower_bound(problem.rows, problem.lower, problem.upper, Multipliers(y, lam))
    assert 0.0 <= bound <= best * (1 + 1e-9) + 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_the_bound_of_right_multipliers_is_the_optimum(seed: int) -> None:
    """And it stays so when they are only nearly right: the bound loses no more than their error."""
    problem = random_problem(seed, 25, 4, 2)
    best = reference(problem.rows, problem.lower, problem.upper)
    given = cones.solve(problem, np.zeros(4)).multipliers
    sides = problem.lower, problem.upper
    assert_allclose(lower_bound(problem.rows, *sides, given), best, rtol=1e-8)
    rng = np.random.default_rng(seed)
    near = Multipliers(given.y + 1e-6 * rng.normal(size=given.y.shape), given.lam)
    assert lower_bound(problem.rows, *sides, near) == pytest.approx(best, rel=1e-3)


def test_where_all_norms_vanish_the_bound_is_zero() -> None:
    problem = random_problem(1, 2, 9, 0)
    found = cones.solve(problem, np.zeros(9))
    assert found.value < 1e-9
    assert found.bound <= found.value


def test_a_program_of_few_points_answers_for_all() -> None:
    """400 points, of which a program starts with 20: those that it misses are added."""
    problem = random_problem(3, 400, 4, 1)
    rows = replace(problem.rows, r=problem.rows.r / problem.rows.norms[:, None])  # none stands out
    best = reference(rows, problem.lower, problem.upper)
    empty = cones.Program.empty(problem.lower, problem.upper)
    answer, program = empty.answer(rows, 100.0, 1e3)
    assert 20 < program.count < 400
    assert_allclose(ahead(rows, answer.d)[0].max(), best, rtol=1e-8)
    assert answer.error < 1e-8


def test_a_program_takes_other_values() -> None:
    """The solver built for one problem answers another of the same shape as its own would."""
    one, two = random_problem(3, 30, 4, 2), random_problem(9, 30, 4, 2)
    two = replace(two, lower=one.lower, upper=one.upper)
    _, program = cones.Program.empty(one.lower, one.upper).answer(one.rows, 100.0, 1e3)
    answer, same = program.answer(two.rows, 100.0, 1e3)
    assert same.solver is program.solver
    best = reference(two.rows, two.lower, two.upper)
    assert_allclose(ahead(two.rows, answer.d)[0].max(), best, rtol=1e-8)


def test_a_trust_region_is_kept() -> None:
    problem = random_problem(4, 30, 5, 0)
    empty = cones.Program.empty(problem.lower, problem.upper)
    answer, _ = empty.answer(problem.rows, 0.05, 10.0)
    d = cp.Variable(5)
    norms = [cp.norm(r + J @ d) for r, J in zip(problem.rows.r, problem.rows.J, strict=True)]
    reference = cp.Problem(cp.Minimize(cp.max(cp.hstack(norms))), [cp.norm(d) <= 0.05])
    assert np.linalg.norm(answer.d) <= 0.05 * (1 + 1e-9)
    ours = ahead(problem.rows, answer.d)[0].max()
    assert_allclose(ours, reference.solve(solver="CLARABEL"), rtol=1e-7)
    assert answer.error < 1e-8  # proven within the region, by its own multipliers


@dataclass(frozen=True)
class Curved:
    """Points in the plane seen from an unknown place x: the circle that holds all, smallest."""

    spots: np.ndarray
    lower: np.ndarray = field(default_factory=lambda: NONE)
    upper: np.ndarray = field(default_factory=lambda: NONE)

    def linearise(self, x: np.ndarray) -> Rows:
        away = self.spots - x
        bend = 0.3 * (away**2)  # a smooth, invertible distortion of the plane
        r = away + bend
        J = -(np.eye(2) + np.einsum("na,ab->nab", 0.6 * away, np.eye(2)))
        some = slice(0, len(self.lower))
        return Rows(r, J, (x**2)[some], (2.0 * np.diag(x))[some])

    def step(self, x: np.ndarray, d: np.ndarray) -> np.ndarray:
        return x + d

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows = self.linearise(x)
        return (rows.r**2).sum(axis=1), rows.c


@dataclass(frozen=True)
class Squared:
    """The same in squares, as `solvers.minimax` wants it."""

    problem: Curved

    @property
    def lower(self) -> np.ndarray:
        return self.problem.lower

    @property
    def upper(self) -> np.ndarray:
        return self.problem.upper

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.problem.evaluate(x)

    def linearise(self, x: np.ndarray) -> minimax.Linear:
        rows = self.problem.linearise(x)
        f = (rows.r**2).sum(axis=1)
        slope = 2.0 * np.einsum("nw,nwp->np", rows.r, rows.J)

        def curvature(weights: np.ndarray) -> np.ndarray:
            return 2.0 * np.einsum("n,nwp,nwq->pq", weights, rows.J, rows.J)

        return minimax.Linear(f, slope, rows.c, rows.C, curvature)

    def step(self, x: np.ndarray, d: np.ndarray) -> np.ndarray:
        return x + d


def spots(count: int = 12) -> np.ndarray:
    return np.random.default_rng(7).uniform(-0.5, 0.5, (count, 2))


@pytest.mark.parametrize("bounds", [(NONE, NONE), (np.array([0.04]), np.array([0.05]))])
def test_curved_problems_end_where_the_sqp_does(bounds: tuple[np.ndarray, np.ndarray]) -> None:
    problem = Curved(spots(), *bounds)
    x = np.array([0.3, 0.2])
    found = cones.solve(problem, x)
    qp = minimax.solve(Squared(problem), x, partial(solve_qp, name="daqp", tolerance=1e-10))
    assert found.status is Status.CONVERGED
    assert_allclose(found.value**2, qp.value, rtol=1e-8)
    assert found.gap < 1e-8
    # the multipliers of the squares are the norms' ones but for the lengths of the gradients
    rows = problem.linearise(qp.x)
    given = of_squares(rows, qp.mu, qp.lam)
    assert_allclose(lower_bound(rows, *bounds, given), found.value, rtol=1e-7)
    assert_allclose(
        np.linalg.norm(given.y, axis=1), np.linalg.norm(found.multipliers.y, axis=1), atol=1e-4
    )
    if len(bounds[0]):
        assert abs(found.c[0] - 0.04) < 1e-9  # active
        assert found.multipliers.lam[0] < 0  # at its lower bound


def test_far_starts_need_the_trust_region() -> None:
    problem = Curved(spots())
    best = cones.solve(problem, np.zeros(2)).value
    for x in ([1.2, -0.4], [0.9, 0.9], [-0.2, 1.1]):
        found = cones.solve(problem, np.array(x), Settings(radius=0.1))
        assert found.status is Status.CONVERGED
        assert_allclose(found.value, best, rtol=1e-8)


def test_contradicting_constraints_are_said() -> None:
    rows = random_problem(2, 10, 2, 0).rows
    rows = Rows(rows.r, rows.J, np.zeros(2), np.array([[1.0, 0.0], [1.0, 0.0]]))
    problem = Linear(rows, np.array([2.0, -np.inf]), np.array([np.inf, 1.0]))
    found = cones.solve(problem, np.zeros(2))
    assert found.status is Status.INFEASIBLE
    assert "contradict" in found.status.advice


def test_numbers_that_break_down_are_a_status() -> None:
    rows = random_problem(2, 10, 2, 0).rows
    broken = Linear(Rows(rows.r * np.nan, rows.J, rows.c, rows.C))
    assert cones.solve(broken, np.zeros(2)).status is Status.FAILED


def test_a_solver_that_lies_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clarabel's word is never taken: an answer that its own multipliers do not prove is none."""
    problem = random_problem(5, 20, 3, 0)

    def lying(self, rows, radius, penalty):  # type: ignore[no-untyped-def]
        return np.zeros(3), aligned(rows, np.ones(len(rows.r)), np.zeros(0)), self

    monkeypatch.setattr(cones.Program, "solved", lying)
    assert cones.solve(problem, np.zeros(3)).status is Status.FAILED


def test_the_iteration_limit_is_a_status() -> None:
    problem = Curved(spots())
    found = cones.solve(problem, np.array([1.2, -0.4]), Settings(radius=0.01, iterations=2))
    assert found.status is Status.ITERATION_LIMIT
    assert found.iterations == 2
    assert found.gap > 0.01
