"""Minimax by sequential quadratic programming on the epigraph QP [paper M, eq. 10-13].

    min over x of  max_i f_i(x)   subject to   lower <= c(x) <= upper

Each step solves a QP (`epigraph_qp`) with any QP solver.  Globalisation (the paper has none): a
line search (`line_search`), and damping of the Hessian as the last resort.
The solver knows no robot; problem and iterate are the caller's.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Generic

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.solvers.epigraph_qp import (
    CountingQpSolver,
    VerifiedQpSolver,
    next_penalties_or_none,
    solve_subproblem,
)
from minimax_cal.solvers.iterate import NO_MULTIPLIERS, Iterate, StartScales, X
from minimax_cal.solvers.line_search import search_along_step
from minimax_cal.solvers.linearisation import Kkt, MinimaxProblem
from minimax_cal.solvers.status import Status
from qp_backends import ProblemError

HESSIAN_CHOICES = ("gauss-newton", "bfgs")
NUMBER_PATTERN = re.compile(r"\d[\d.]*(e[+-]?\d+)?")


@dataclass(frozen=True)
class Sqp:
    """Settings of the SQP.

    tolerance: on stationarity, complementarity and violation, as `Kkt` has them.
    iterations: at most so many QPs.  floor: least weight of the functions in the Gauss-Newton
    Hessian, shared evenly, which inactive ones would otherwise leave singular.
    hessian: "gauss-newton" (the problem's own curvature, weighted by the multipliers) or "bfgs"
    (damped, Powell; it starts from the problem's curvature where there is one).
    """

    tolerance: float = 1e-8
    iterations: int = 200
    floor: float = 3e-3
    hessian: str = "gauss-newton"


@dataclass(frozen=True)
class Step:
    """One line of the iteration trace; `backend` is the QP solver that really answered."""

    iteration: int
    value: float
    violation: float
    kkt: float
    length: float
    backend: str = ""


@dataclass(frozen=True, eq=False)
class Optimum(Generic[X]):
    """x with its f (k,), c (l,), multipliers mu (k,) that sum to one and lambda (l,).

    lambda is > 0 at an upper bound and < 0 at a lower one.
    answered, warm: as in `CountingQpSolver`; qp_residual: its residual.
    """

    x: X
    f: Array
    c: Array
    mu: Array
    lam: Array
    kkt: Kkt
    iterations: int
    status: Status
    trace: tuple[Step, ...] = ()
    notes: tuple[str, ...] = field(default=())
    answered: Mapping[str, int] = field(default_factory=dict)
    warm: int = 0
    qp_residual: float = 0.0

    @property
    def value(self) -> float:
        """max f."""
        return float(self.f.max())


def solve(
    problem: MinimaxProblem[X],
    x: X,
    qp: VerifiedQpSolver,
    settings: Sqp = Sqp(),
    report: Callable[[Step], None] = lambda step: None,
    mu: Array = NO_MULTIPLIERS,
    scales: StartScales | None = None,
) -> Optimum[X]:
    """Minimise max f from x.  qp: a QP solver; it is given each answer as the next one's start.

    report: is called with each step.  mu: (k,) multipliers of a similar problem, to begin with.
    scales: of variables and value, where they are known; else the derivatives at x give them.
    """
    iterate = Iterate.start_at(problem, x, settings.hessian, mu, scales)
    solve_qp, tolerance = CountingQpSolver(qp), settings.tolerance
    status: Status | None = None
    trace: list[Step] = []
    notes: list[str] = []
    for iteration in range(1, settings.iterations + 1):
        # Search direction and multipliers.
        if not iterate.is_finite:
            status = Status.FAILED
            break
        hessian = iterate.damped_hessian(settings.floor)
        try:
            step = solve_subproblem(iterate, hessian, solve_qp)
        except ProblemError:  # values so large that the QP's numbers overflow
            status = Status.FAILED
            break
        notes += step.notes
        if not step.usable:
            balanced = iterate.with_fitted_multipliers()
            is_optimal = balanced.is_nearly_optimal(tolerance)  # all the same
            iterate = balanced if is_optimal else iterate
            status = Status.CONVERGED if is_optimal else Status.FAILED
            break
        if not step.exact:
            balanced = iterate.with_fitted_multipliers()
            step = replace(step, mu=balanced.mu, lam=balanced.lam)

        # Penalties of violations, at least as large as the multipliers.
        penalties = next_penalties_or_none(iterate, step, tolerance)
        iterate = iterate.update_after_qp(
            step.mu, step.lam, iterate.penalties if penalties is None else penalties, step.exact
        )
        if penalties is None:
            status = Status.INFEASIBLE
            break

        # A step that lowers the merit function, or more damping where there is none.
        length, d, end, there = 0.0, np.zeros_like(step.d), iterate.x, iterate.linearisation
        if iterate.kkt.residual > tolerance:
            correct_step = partial(solve_subproblem, iterate, hessian, solve_qp)
            length, d, end, there = search_along_step(iterate, step, correct_step)
        value, kkt = float(iterate.linearisation.f.max()), iterate.kkt
        trace.append(Step(iteration, value, kkt.violation, kkt.residual, length, step.backend))
        report(trace[-1])
        status = iterate.status_before_step(tolerance, step.exact)
        if status is None:
            iterate = iterate.after_step(d, end, there) if length else iterate.with_more_damping()
            status = iterate.status_after_step(tolerance, step.exact)

        # Where nothing moves any more, the multipliers of the QP may be to blame.
        if status is Status.STALLED or (status is None and not length):
            balanced = iterate.with_fitted_multipliers()
            if balanced.is_nearly_optimal(tolerance):
                iterate, status = balanced, Status.CONVERGED
        if status is not None:
            break
    if status is Status.STALLED:
        percent = 100.0 * iterate.relative_decrease_bound()
        notes.append(f"to first order the largest function may still fall by {percent:.2g} %")
    return Optimum(
        iterate.x,
        iterate.linearisation.f,
        iterate.linearisation.c,
        iterate.mu,
        iterate.lam,
        iterate.kkt,
        len(trace),
        status or Status.ITERATION_LIMIT,
        tuple(trace),
        merge_similar_notes(notes),
        dict(solve_qp.answered),
        solve_qp.warm,
        solve_qp.residual,
    )


def merge_similar_notes(notes: Sequence[str]) -> tuple[str, ...]:
    """Notes; of those that differ in nothing but numbers the first, with their count."""
    alike: dict[str, list[str]] = {}
    for note in notes:
        alike.setdefault(NUMBER_PATTERN.sub("#", note), []).append(note)
    return tuple(
        same[0] if len(same) == 1 else f"{same[0]} (the first of {len(same)} alike)"
        for same in alike.values()
    )
