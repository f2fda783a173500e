"""The last question of a minimisation: is the answer optimal, measured where it is?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.solvers.derivatives import measure_variable_lengths
from minimax_cal.solvers.iterate import MIN_VALUE_OF_TERMS
from minimax_cal.solvers.linearisation import (
    Kkt,
    Linearisation,
    Scaling,
    constraint_excess,
    fit_multipliers_by_least_squares,
    measure_kkt,
)
from minimax_cal.solvers.max_problem import EPS, MaxOfFunctions

MAX_FLAT_GRADIENT = 1e-6  # gradients below, relative to the lengths and the level, count as none
DESCENT_SEARCH_DISTANCE = 1e-3  # distance, in lengths, at which a better point is looked for
MIN_CHANGE_IN_ROUNDINGS = 10.0  # of x, over which functions change by more than their own rounding
MIN_UNBOUNDED_FALL_LENGTHS = (
    1e6  # lengths of the variables over which functions without end fall at least
)
MIN_UNBOUNDED_DROP_RATIO = 0.5  # of a fall to the one before, over ways that grow alike


@dataclass(frozen=True, eq=False)
class AnswerCheck:
    """Optimality of a point in the units of values, variables and rows at that point.

    mu: (m,) and lam: (l,), the multipliers that show it.  level: below which, times the tolerance,
    a change of the value does not matter.
    """

    kkt: Kkt
    mu: Array
    lam: Array
    level: float


def measure_answer_optimality(
    problem: MaxOfFunctions, x: Array, mu: Array, lam: Array, start: Array, tolerance: float
) -> AnswerCheck:
    """Stationarity, complementarity and violation at x, everything measured there.

    mu: (m,) and lam: (l,), multipliers of the last QP; where they do not balance the gradients,
    those that do it best.  start: (n,) where the search began, whose rounding x has.  Slopes by
    differences are taken as central ones.
    """
    here = problem.linearise_with_central_differences(x)
    size = min(
        abs(float(here.f.max())), value_variation_along_variables(problem, here.f, mu, x, start)
    )
    weights = np.where(mu > EPS, mu, 0.0)  # less is the rounding of a QP's answer
    terms = float(weights @ (np.abs(here.f) + np.abs(here.jacobian) @ np.abs(x)))
    level = max(size, MIN_VALUE_OF_TERMS * terms) or 1.0
    check = measure_optimality(problem, here, x, mu, lam, level)
    if check.kkt.residual <= tolerance:
        return check
    check = min(
        check,
        measure_optimality_with_fitted_multipliers(problem, here, x, level),
        key=largest_kkt_residual,
    )
    if check.kkt.residual <= tolerance or check.kkt.violation > tolerance:
        return check
    zero_level = value_rounding_level(problem, here.f, check.mu, x, start)
    if abs(float(here.f.max())) > zero_level:
        return check
    level = max(level, zero_level / tolerance)
    trials = (
        check,
        measure_optimality(problem, here, x, check.mu, check.lam, level),
        measure_optimality_with_fitted_multipliers(problem, here, x, level),
    )
    return min(trials, key=largest_kkt_residual)


def largest_kkt_residual(check: AnswerCheck) -> float:
    """The largest of its three residuals."""
    return check.kkt.residual


def measure_optimality(
    problem: MaxOfFunctions,
    linearisation: Linearisation,
    x: Array,
    mu: Array,
    lam: Array,
    level: float,
) -> AnswerCheck:
    """The residuals for given multipliers, where a change of the value by `level` matters."""
    scaling = measure_scaling_at_point(problem, linearisation, x, mu, level)
    scaled, lower, upper = (
        scaling.apply(linearisation),
        problem.lower / scaling.c,
        problem.upper / scaling.c,
    )
    scaled_lam = lam * scaling.c / level
    kkt = measure_kkt(scaled, mu, scaled_lam, lower, upper)
    # Multipliers of nearly equal rows may be huge: what cancels then shows nothing beyond the
    # rounding of the rows' entries.
    uncertain = (problem.rows.relative_derivative_rounding(x) * np.abs(scaled_lam)) @ np.abs(
        scaled.normal
    )
    # A gain is quadratic in what is left of smooth gradients: below the root of the values'
    # rounding it is less than that rounding.
    smooth = np.sqrt(EPS * float(mu @ np.abs(linearisation.f)) / level)
    left = kkt.stationarity + float(uncertain.max(initial=0.0))
    violations = problem.relative_violations(x, linearisation.c, linearisation.normal)
    kkt = Kkt(
        0.0 if left <= smooth else left,
        kkt.complementarity,
        float(violations.max(initial=0.0)),
    )
    return AnswerCheck(kkt, mu, lam, level)


def measure_optimality_with_fitted_multipliers(
    problem: MaxOfFunctions, linearisation: Linearisation, x: Array, level: float
) -> AnswerCheck:
    """The residuals for the multipliers that balance the gradients best."""
    even = np.full(len(linearisation.f), 1.0 / len(linearisation.f))
    scaling = measure_scaling_at_point(problem, linearisation, x, even, level)
    scaled, lower, upper = (
        scaling.apply(linearisation),
        problem.lower / scaling.c,
        problem.upper / scaling.c,
    )
    mu, lam = fit_multipliers_by_least_squares(scaled, lower, upper)
    return measure_optimality(problem, linearisation, x, mu, lam * level / scaling.c, level)


def measure_scaling_at_point(
    problem: MaxOfFunctions, linearisation: Linearisation, x: Array, mu: Array, level: float
) -> Scaling:
    """Scaling of value, variables and rows at x, for a level of the value.

    A variable's is where it changes the functions by the level, weighted by mu: of functions that
    balance each other, as in a curved valley, each alone changes much faster.  Where their
    weighted sum does not change, as at a vertex, it is |x| or where any function changes so.
    """

    def weigh(z: Array) -> Array:
        return np.atleast_1d(mu[mu > 0.0] @ problem.values(z)[mu > 0.0])

    low, high = problem.low, problem.high
    alone = measure_variable_lengths(problem.values, x, low, high, level, problem.lengths)
    weighted = measure_variable_lengths(weigh, x, low, high, level, problem.lengths)
    lengths = np.maximum(np.minimum(weighted, np.maximum(alone, np.abs(x))), alone)
    return Scaling.from_lengths(linearisation, level, lengths, problem.lower, problem.upper)


def value_variation_along_variables(
    problem: MaxOfFunctions, f: Array, mu: Array, x: Array, start: Array
) -> float:
    """By how much moving a variable, by itself or back to the start, changes the largest functions.

    It bounds what counts as the size of the value: a number added to all functions is no size.
    """
    return largest_weighted_function_change(
        problem, f, mu, x, np.maximum(np.abs(x), np.abs(x - start))
    )


def value_rounding_level(
    problem: MaxOfFunctions, f: Array, mu: Array, x: Array, start: Array
) -> float:
    """A value that counts as zero: by how much rounding of x changes the largest functions.

    x is known to the rounding of itself and of the way from the start; a smooth minimiser to the
    root of its rounding.  f: (m,) at x.
    """
    rounding = EPS * np.maximum(np.abs(x), np.abs(x - start))
    bends = largest_weighted_function_change(
        problem, f, mu, x, np.sqrt(EPS) * np.abs(x), is_second_order=True
    )
    return MIN_CHANGE_IN_ROUNDINGS * max(
        largest_weighted_function_change(problem, f, mu, x, rounding), bends
    )


def largest_weighted_function_change(
    problem: MaxOfFunctions,
    f: Array,
    mu: Array,
    x: Array,
    steps: Array,
    is_second_order: bool = False,
) -> float:
    """Largest change of the functions, weighted by mu, over a step of one variable in its bounds.

    f: (m,) at x.  mu: (m,) of sum one.  steps: (n,), each gone either way.  is_second_order: what
    the changes both ways have in common.
    """
    active, largest = mu > EPS, 0.0  # less is the rounding of a multiplier
    for step in np.diag(steps):
        both = np.array([x + step, x - step])
        ends = np.clip(both, problem.low, problem.high)
        if is_second_order and np.any(ends != both):
            continue
        ahead, back = (problem.values(end) - f for end in ends)
        change = np.abs(ahead + back) if is_second_order else np.abs([ahead, back]).max(axis=0)
        weighted = float(mu[active] @ change[active])
        largest = max(largest, weighted) if np.isfinite(weighted) else largest
    return largest


def find_better_point_near_stationary_point(problem: MaxOfFunctions, x: Array) -> Array | None:
    """A point near x that is better though every gradient vanishes at x, as on a hilltop.

    None where there is none, or where the multipliers balance gradients that do not vanish.
    """
    here = problem.linearise(x)
    worst, reach = float(here.f.max()), np.maximum(np.abs(x), problem.lengths)
    level = float(np.abs(here.f).max()) or 1.0
    active = here.f >= worst - MAX_FLAT_GRADIENT * level
    if np.abs(here.jacobian[active] * reach).max(initial=0.0) > MAX_FLAT_GRADIENT * level:
        return None
    best, found = worst - MAX_FLAT_GRADIENT**2 * level, None
    for step in DESCENT_SEARCH_DISTANCE * np.concatenate([np.diag(reach), -np.diag(reach)]):
        f, c = problem.evaluate(x + step)
        inside = np.all(c >= problem.lower) and np.all(c <= problem.upper)
        if inside and np.all(np.isfinite(f)) and f.max() < best:
            best, found = float(f.max()), x + step
    return found


def is_unbounded_below_along_line(
    problem: MaxOfFunctions, start: Array, far_point: Array, tolerance: float
) -> bool:
    """Whether the largest function falls on and on along the way from a start to an end.

    problem: in the units of the start, which meets the constraints.  Asked from one length of the
    variables to the end, and at least to `MIN_UNBOUNDED_FALL_LENGTHS` lengths, in steps that grow
    alike; what falls by less and less, as 1/x, comes to an end.
    """
    way = far_point - start
    length_count = float(np.abs(way / np.maximum(problem.lengths, np.abs(start))).max())
    if not 0.0 < length_count < np.inf:
        return False
    last_value, last_drop = float(problem.values(start).max()), 0.0
    decade_count = int(np.ceil(np.log10(max(length_count, MIN_UNBOUNDED_FALL_LENGTHS))))
    for share in np.logspace(0, decade_count, 2 * decade_count + 1) / length_count:
        x = start + share * way
        f, c = problem.evaluate(x)
        reach = np.abs(problem.rows.jacobian(x)) @ np.maximum(np.abs(x), problem.lengths)
        is_inside = np.all(constraint_excess(c, problem.lower, problem.upper) <= tolerance * reach)
        drop = last_value - float(f.max())
        if not (is_inside and drop > MIN_UNBOUNDED_DROP_RATIO * last_drop):
            return False
        last_value, last_drop = last_value - drop, drop
    return True
