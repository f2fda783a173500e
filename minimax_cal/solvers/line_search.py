"""A step that lowers the merit function max f + penalties @ violation.

With a second-order correction where the curvature of the active pieces spoils the full step
[Maratos effect; Nocedal and Wright, Numerical Optimization, ch. 18].
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.solvers.bfgs import EPS
from minimax_cal.solvers.epigraph_qp import SearchStep
from minimax_cal.solvers.iterate import VALUE_ROUNDING, Iterate, X
from minimax_cal.solvers.linearisation import Linearisation, constraint_excess

MIN_ARMIJO_DECREASE = 1e-4  # of what the linear model promises [Armijo]
MIN_FALLING_SLOPE = 0.25  # at the end of a step, relative to its start: worth going on
MAX_STEP_LENGTHENING = 1e15  # times a step
CorrectStep = Callable[[Array, Array], SearchStep]


class LineSearchResult(NamedTuple, Generic[X]):
    """Length that is taken (0 if none), its d (p,), the point at its end and the problem there."""

    length: float
    step: Array
    end: X
    linearisation: Linearisation


def search_along_step(
    iterate: Iterate[X], step: SearchStep, correct_step: CorrectStep
) -> LineSearchResult[X]:
    """Length of the step that is taken (0 if none), its d (p,), its end and the problem there.

    The full step is nearly always taken, so its derivatives are computed at once.
    correct_step: solves the QP again with other values f (k,) and c (l,).
    """
    problem, x, here = iterate.problem, iterate.x, iterate.linearisation

    def merit(f: Array, c: Array) -> float:
        value = float(f.max())
        if len(c):
            excess = constraint_excess(c, problem.lower, problem.upper)
            value += float(iterate.penalties @ excess)
        return value if np.isfinite(value) else float("inf")

    start = merit(here.f, here.c)
    decrease = start - merit(here.f + here.jacobian @ step.d, here.c + here.normal @ step.d)
    # Differences below this are rounding: the model is trusted there.
    rounding = VALUE_ROUNDING * abs(start) + EPS * iterate.value_terms

    # The full step, or several times it.
    trial = problem.step(x, step.d)
    there = problem.linearise(trial)
    value = merit(there.f, there.c)
    if value <= start - MIN_ARMIJO_DECREASE * decrease + rounding:
        ahead = merit(there.f + there.jacobian @ step.d, there.c + there.normal @ step.d)
        length = 1.0
        if iterate.quasi_newton and value - ahead > MIN_FALLING_SLOPE * decrease > rounding:
            length = step_lengthening_factor(iterate, step.d, merit, start, value)
        if length == 1.0:
            return LineSearchResult(1.0, step.d, trial, there)
        trial = problem.step(x, length * step.d)
        return LineSearchResult(length, length * step.d, trial, problem.linearise(trial))

    # Second-order correction: what the linear model missed at the step goes into the constants.
    if np.isfinite(value):
        corrected = correct_step(there.f - here.jacobian @ step.d, there.c - here.normal @ step.d)
        lengths = iterate.descent_lengths
        if corrected.usable and np.linalg.norm(corrected.d / lengths) <= 2.0 * np.linalg.norm(
            step.d / lengths
        ):
            trial = problem.step(x, corrected.d)
            there = problem.linearise(trial)
            if merit(there.f, there.c) <= start - MIN_ARMIJO_DECREASE * decrease + rounding:
                return LineSearchResult(1.0, corrected.d, trial, there)

    # Backtracking, to the minimum of the parabola through slope and value where there is one.
    length = 1.0
    while length * decrease > rounding:
        bend = 2.0 * (value - start + length * decrease)
        lowest = length**2 * decrease / bend if np.isfinite(value) and bend > 0 else 0.0
        length = min(max(lowest, 0.1 * length), 0.5 * length)
        move = length * step.d
        trial = problem.step(x, move)
        value = merit(*problem.evaluate(trial))
        if value <= start - MIN_ARMIJO_DECREASE * length * decrease + rounding:
            return LineSearchResult(length, move, trial, problem.linearise(trial))
    return LineSearchResult(0.0, np.zeros_like(step.d), x, here)


def step_lengthening_factor(
    iterate: Iterate[X],
    d: Array,
    merit: Callable[[Array, Array], float],
    start_merit: float,
    step_merit: float,
) -> float:
    """How many times the step d (p,) to go, doubled while the merit falls well.

    Where an estimated Hessian is far too large, as after steps through functions that grow fast.
    start_merit, step_merit: merits here and after d.  A step ends where a linearised constraint
    does.
    """
    problem, here = iterate.problem, iterate.linearisation
    violation = constraint_excess(here.c, problem.lower, problem.upper)
    length = 1.0
    while length < MAX_STEP_LENGTHENING:
        ends = here.c + 2.0 * length * (here.normal @ d)
        if np.any(constraint_excess(ends, problem.lower, problem.upper) > violation):
            break
        farther = merit(*problem.evaluate(problem.step(iterate.x, 2.0 * length * d)))
        if not step_merit - farther > min(0.1 * (start_merit - step_merit), 0.5 * abs(step_merit)):
            break
        length, step_merit = 2.0 * length, farther
    return length
