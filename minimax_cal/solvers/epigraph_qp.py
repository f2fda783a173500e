"""The quadratic program of a step, put to any QP solver [paper M, eq. 10-13].

min 1/2 d'Hd + v,  f + f'd - max f <= v,  lower - c <= c'd <= upper - c, in units in which all is
about one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.solvers.iterate import FLAT_CURVATURE, Iterate, X
from minimax_cal.solvers.linearisation import Linearisation, Scaling, constraint_excess
from qp_backends import Problem, Solution
from qp_backends import Status as QpStatus
from qp_backends.problem import COLD

ELASTIC_PENALTY_FACTOR = 1e2  # times what the functions could gain by a violation
MULTIPLIER_PENALTY_FACTOR = 1.5  # times the largest multiplier of a QP
MAX_PENALTY = 1e6  # times the minimal ones: beyond it a violation is there to stay
# P_vv of the epigraph variable v: a force that changes the sum of the multipliers by a part of
# NEGLIGIBLE_FORCE at the decrease that is still to be had, from FLAT_CURVATURE to this.  Active set
# methods work with A P^-1 A', whose entries are of size one beside 1 / P_vv: from 1e8 on the
# rounding of the sum exceeds a QP's tolerance.
NEGLIGIBLE_FORCE = 1e-9
MAX_DECREASE_CURVATURE = 1e-6


class VerifiedQpSolver(Protocol):
    """A QP solver whose answers are verified already, as `qp_backends.solve` with a name."""

    def __call__(self, problem: Problem, /, *, warm_start: Solution = COLD) -> Solution:
        """The answer.  warm_start: that of a similar problem of the same size, or COLD."""


def ignore_warm_start(solve_qp: Callable[[Problem], Solution]) -> VerifiedQpSolver:
    """A solver of a problem alone as a `VerifiedQpSolver`."""

    def run(problem: Problem, /, *, warm_start: Solution = COLD) -> Solution:
        return solve_qp(problem)

    return run


@dataclass
class CountingQpSolver:
    """Puts QPs to a solver, each from the answer to the last one of its size, and keeps count.

    answered: QPs by the backend that answered.  warm: those that a backend began at that answer.
    residual: the largest relative residual of an answer, as its judge says.
    """

    qp: VerifiedQpSolver
    last: Solution = COLD
    answered: Counter[str] = field(default_factory=Counter)
    warm: int = 0
    residual: float = 0.0

    def __call__(self, problem: Problem) -> Solution:
        """The answer to a problem."""
        start = self.last if self.last.x.shape == problem.q.shape else COLD
        answer = self.qp(problem, warm_start=start)
        self.answered[answer.backend or "unnamed"] += 1
        self.warm += answer.warm
        if np.isfinite(answer.residual):
            self.residual = max(self.residual, answer.residual)
        if answer.usable:
            self.last = answer
        return answer


@dataclass(frozen=True, eq=False)
class SearchStep:
    """An answer of the QP: step d (p,), multipliers mu (k,) and lam (l,), and who gave it.

    exact: whether the answer kept the tolerance; else it is one that is used as it is.
    elastic_penalties: (l,) at which it may violate constraints that contradict each other.
    """

    d: Array
    mu: Array
    lam: Array
    usable: bool
    backend: str
    notes: tuple[str, ...]
    exact: bool = True
    elastic_penalties: Array | None = None

    @staticmethod
    def from_qp(
        answer: Solution, linearisation: Linearisation, working_set: Array, scaling: Scaling
    ) -> SearchStep:
        """Step and multipliers of a QP answer; mu is brought back to sum one exactly.

        working_set: the functions that the QP knew.  scaling: of the QP.
        """
        k, p = linearisation.jacobian.shape
        usable, count = is_answer_usable(answer), len(working_set)
        mu = np.zeros(k) if usable else np.full(k, 1.0 / k)
        if usable:
            mu[working_set] = np.maximum(answer.y[:count], 0.0)
        total = mu.sum()
        lam = (
            answer.y[count : count + len(linearisation.c)]
            if usable
            else np.zeros(len(linearisation.c))
        )
        return SearchStep(
            d=answer.x[:p] * scaling.x if usable else np.zeros(p),
            mu=mu / total if total > 0.0 else np.full(k, 1.0 / k),
            lam=lam * scaling.value / scaling.c,
            usable=usable,
            backend=answer.backend,
            notes=answer.notes,
            exact=answer.solved or not usable,
        )


def solve_subproblem(
    iterate: Iterate[X],
    hessian: Array,
    solve_qp: Callable[[Problem], Solution],
    f: Array | None = None,
    c: Array | None = None,
) -> SearchStep:
    """Search direction of the epigraph QP at an iterate [paper M, eq. 10-13].

    hessian: (p, p) of the Lagrangian.  f: (k,) and c: (l,), in place of the iterate's values, for
    a second-order correction.  The elastic QP's where the constraints contradict each other.
    """
    # Variables scaled by the curvature, so that the QP's Hessian has a unit diagonal.
    curvature = np.diag(hessian) / iterate.scaling.value
    is_curved = curvature > 0.0
    lengths = 1.0 / np.sqrt(np.where(is_curved, curvature, 1.0))
    scaling = replace(iterate.scaling, x=np.where(is_curved, lengths, iterate.descent_lengths))
    values = (
        iterate.linearisation
        if f is None or c is None
        else replace(iterate.linearisation, f=f, c=c)
    )
    here = scaling.apply(values)
    hessian = hessian / scaling.value * np.outer(scaling.x, scaling.x)
    lower, upper = iterate.problem.lower / scaling.c, iterate.problem.upper / scaling.c
    # Decrease that weak duality leaves at the last multipliers, the Hessian taken as its diagonal.
    slope = iterate.mu @ here.jacobian + (iterate.lam * scaling.c / scaling.value) @ here.normal
    decrease = iterate.kkt.complementarity + 0.5 * float(slope @ slope)

    # Working set: of many functions those that are largest now; what becomes larger than v joins.
    missed = working_set = iterate.select_largest_functions(here)
    while len(missed):
        some = here if len(working_set) == len(here.f) else here.take_functions(working_set)
        qp = build_epigraph_qp(some, here.f.max(), hessian, lower, upper, decrease)
        answer = solve_qp(qp)
        missed = find_functions_above_epigraph_bound(here, working_set, answer)
        working_set = np.concatenate([working_set, missed])
    if is_answer_usable(answer) or not len(here.c):
        return SearchStep.from_qp(answer, here, working_set, scaling)

    # Elastic mode [Nocedal and Wright, sec. 18.5]: violations are allowed at a penalty well above
    # what the functions could gain by them.
    penalties = np.maximum(iterate.penalties, ELASTIC_PENALTY_FACTOR * iterate.minimal_penalties)
    answer = solve_qp(build_elastic_qp(qp, len(working_set), penalties * scaling.c / scaling.value))
    step = SearchStep.from_qp(answer, here, working_set, scaling)
    return replace(step, elastic_penalties=penalties)


def is_answer_usable(answer: Solution) -> bool:
    """Whether a QP has an answer, exact or not: what it is good for the search finds out."""
    return answer.usable or (
        answer.status is QpStatus.INACCURATE and bool(np.isfinite(answer.x).all())
    )


def find_functions_above_epigraph_bound(
    linearisation: Linearisation, working_set: Array, answer: Solution
) -> Array:
    """Functions beyond the working set that an answer of the epigraph QP makes larger than v.

    All, where there is no answer; else at most as many as there are variables.
    """
    k, p = linearisation.jacobian.shape
    if len(working_set) == k:
        return working_set[:0]
    if not is_answer_usable(answer):
        return np.setdiff1d(np.arange(k), working_set)
    over = (
        linearisation.f
        - linearisation.f.max()
        + linearisation.jacobian @ answer.x[:p]
        - answer.x[p]
    )
    over[working_set] = -np.inf
    found = np.flatnonzero(over > 0.0)
    return found[np.argsort(-over[found])[:p]]


def build_epigraph_qp(
    linearisation: Linearisation,
    largest: float,
    hessian: Array,
    lower: Array,
    upper: Array,
    expected_decrease: float,
) -> Problem:
    """min 1/2 d'Hd + v with rows f - largest + f'd <= v and lower - c <= c'd <= upper - c.

    expected_decrease: about how far v may fall.
    """
    k, p = linearisation.jacobian.shape
    rows = np.zeros((k + len(linearisation.c), p + 1))
    rows[:k, :p], rows[:k, p], rows[k:, :p] = linearisation.jacobian, -1.0, linearisation.normal
    quadratic = np.zeros((p + 1, p + 1))
    quadratic[:p, :p] = hessian
    curvature = NEGLIGIBLE_FORCE / max(expected_decrease, FLAT_CURVATURE)
    quadratic[p, p] = min(max(curvature, FLAT_CURVATURE), MAX_DECREASE_CURVATURE)
    linear = np.zeros(p + 1)
    linear[p] = 1.0
    low = np.concatenate([np.full(k, -np.inf), lower - linearisation.c])
    high = np.concatenate([largest - linearisation.f, upper - linearisation.c])
    return Problem(quadratic, linear, rows, low, high)


def build_elastic_qp(problem: Problem, function_count: int, penalties: Array) -> Problem:
    """The same QP with slacks s, t >= 0 on its constraint rows: c'd + s - t, at a penalty (l,)."""
    n, m, k = len(problem.q), len(problem.l), function_count
    slack = np.zeros((m, 2 * (m - k)))
    slack[k:] = np.hstack([np.eye(m - k), -np.eye(m - k)])
    rows = np.block([[problem.A, slack], [np.zeros((2 * (m - k), n)), np.eye(2 * (m - k))]])
    quadratic = np.zeros((n + 2 * (m - k),) * 2)
    quadratic[:n, :n] = problem.P
    quadratic[n:, n:] = FLAT_CURVATURE * np.eye(2 * (m - k))
    linear = np.concatenate([problem.q, penalties, penalties])
    low = np.concatenate([problem.l, np.zeros(2 * (m - k))])
    high = np.concatenate([problem.u, np.full(2 * (m - k), np.inf)])
    return Problem(quadratic, linear, rows, low, high)


def next_penalties_or_none(iterate: Iterate[X], step: SearchStep, tolerance: float) -> Array | None:
    """(l,) the next penalties; None where no penalty makes the constraints agree."""
    c, lower, upper = iterate.scaling.c, iterate.problem.lower, iterate.problem.upper
    if step.elastic_penalties is None:
        largest = np.abs(step.lam * c).max(initial=0.0)
        return np.asarray(np.maximum(iterate.penalties, MULTIPLIER_PENALTY_FACTOR * largest / c))
    penalties = np.maximum(iterate.penalties, step.elastic_penalties)
    here, d = iterate.scaling.apply(iterate.linearisation), step.d / iterate.reach
    if does_step_lower_violation(here, d, lower / c, upper / c, tolerance):
        return penalties
    is_hopeless = np.all(penalties > MAX_PENALTY * iterate.minimal_penalties)
    return None if is_hopeless else 10.0 * penalties


def does_step_lower_violation(
    linearisation: Linearisation, step: Array, lower: Array, upper: Array, tolerance: float
) -> bool:
    """Whether constraints are met to a tolerance, or the elastic QP's step d (p,) lowers them."""
    now = constraint_excess(linearisation.c, lower, upper).sum()
    ahead = constraint_excess(linearisation.c + linearisation.normal @ step, lower, upper).sum()
    return bool(now <= tolerance or ahead <= (1.0 - 1e-6) * now)
