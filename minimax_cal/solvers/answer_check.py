"""The last question of a minimisation: is the answer optimal, measured where it is?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.solvers.derivatives import measure_lengths
from minimax_cal.solvers.max_problem import EPS, MaxOfFunctions
from minimax_cal.solvers.minimax import (
    CANCELLED,
    Kkt,
    Linear,
    Units,
    excess,
    multipliers_at,
    optimality,
)

FLAT = 1e-6  # gradients below, relative to the lengths and the level, count as none
NEARBY = 1e-3  # distance, in lengths, at which a better point is looked for
MIN_ROUNDINGS = 10.0  # of x, over which functions change by more than their own rounding
MIN_FALL = 1e6  # lengths of the variables over which functions without end fall at least
MIN_DROP_RATIO = 0.5  # of a fall to the one before, over ways that grow alike


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


def check_answer(
    problem: MaxOfFunctions, x: Array, mu: Array, lam: Array, start: Array, tolerance: float
) -> AnswerCheck:
    """Stationarity, complementarity and violation at x, everything measured there.

    mu: (m,) and lam: (l,), multipliers of the last QP; where they do not balance the gradients,
    those that do it best.  start: (n,) where the search began, whose rounding x has.  Slopes by
    differences are taken as central ones.
    """
    here = problem.linearise_best(x)
    size = min(abs(float(here.f.max())), find_variation(problem, here.f, mu, x, start))
    terms = float(mu @ (np.abs(here.f) + np.abs(here.jacobian) @ np.abs(x)))
    level = max(size, CANCELLED * terms) or 1.0
    check = measure_optimality(problem, here, x, mu, lam, level)
    if check.kkt.residual <= tolerance:
        return check
    check = min(check, balance_multipliers(problem, here, x, level), key=residual_of)
    if check.kkt.residual <= tolerance or check.kkt.violation > tolerance:
        return check
    zero_level = find_zero_level(problem, here.f, check.mu, x, start)
    if abs(float(here.f.max())) > zero_level:
        return check
    level = max(level, zero_level / tolerance)
    trials = (
        check,
        measure_optimality(problem, here, x, check.mu, check.lam, level),
        balance_multipliers(problem, here, x, level),
    )
    return min(trials, key=residual_of)


def residual_of(check: AnswerCheck) -> float:
    """The largest of its three residuals."""
    return check.kkt.residual


def measure_optimality(
    problem: MaxOfFunctions, here: Linear, x: Array, mu: Array, lam: Array, level: float
) -> AnswerCheck:
    """The residuals for given multipliers, where a change of the value by `level` matters."""
    units = find_local_units(problem, here, x, mu, level)
    scaled, lower, upper = units.scaled(here), problem.lower / units.c, problem.upper / units.c
    scaled_lam = lam * units.c / level
    kkt = optimality(scaled, mu, scaled_lam, lower, upper)
    # Multipliers of nearly equal rows may be huge: what cancels then shows nothing beyond the
    # rounding of the rows' entries.
    uncertain = (problem.rows.slope_rounding(x) * np.abs(scaled_lam)) @ np.abs(scaled.normal)
    # A gain is quadratic in what is left of smooth gradients: below the root of the values'
    # rounding it is less than that rounding.
    smooth = np.sqrt(EPS * float(mu @ np.abs(here.f)) / level)
    left = kkt.stationarity + float(uncertain.max(initial=0.0))
    violations = problem.relative_violations(x, here.c, here.normal)
    kkt = Kkt(
        0.0 if left <= smooth else left,
        kkt.complementarity,
        float(violations.max(initial=0.0)),
    )
    return AnswerCheck(kkt, mu, lam, level)


def balance_multipliers(
    problem: MaxOfFunctions, here: Linear, x: Array, level: float
) -> AnswerCheck:
    """The residuals for the multipliers that balance the gradients best."""
    even = np.full(len(here.f), 1.0 / len(here.f))
    units = find_local_units(problem, here, x, even, level)
    scaled, lower, upper = units.scaled(here), problem.lower / units.c, problem.upper / units.c
    mu, lam = multipliers_at(scaled, lower, upper)
    return measure_optimality(problem, here, x, mu, lam * level / units.c, level)


def find_local_units(
    problem: MaxOfFunctions, here: Linear, x: Array, mu: Array, level: float
) -> Units:
    """Units of value, variables and rows at x, for a level of the value.

    A variable's is where it changes the functions by the level, weighted by mu: of functions that
    balance each other, as in a curved valley, each alone changes much faster.  Where their
    weighted sum does not change, as at a vertex, it is |x| or where any function changes so.
    """

    def weigh(z: Array) -> Array:
        return np.atleast_1d(mu[mu > 0.0] @ problem.values(z)[mu > 0.0])

    low, high = problem.low, problem.high
    alone = measure_lengths(problem.values, x, low, high, level, problem.lengths)
    weighted = measure_lengths(weigh, x, low, high, level, problem.lengths)
    lengths = np.maximum(np.minimum(weighted, np.maximum(alone, np.abs(x))), alone)
    return Units.of(here, level, lengths, problem.lower, problem.upper)


def find_variation(problem: MaxOfFunctions, f: Array, mu: Array, x: Array, start: Array) -> float:
    """By how much moving a variable, by itself or back to the start, changes the largest functions.

    It bounds what counts as the size of the value: a number added to all functions is no size.
    """
    return find_largest_change(problem, f, mu, x, np.maximum(np.abs(x), np.abs(x - start)))


def find_zero_level(problem: MaxOfFunctions, f: Array, mu: Array, x: Array, start: Array) -> float:
    """A value that counts as zero: by how much rounding of x changes the largest functions.

    x is known to the rounding of itself and of the way from the start; a smooth minimiser to the
    root of its rounding.  f: (m,) at x.
    """
    rounding = EPS * np.maximum(np.abs(x), np.abs(x - start))
    bends = find_largest_change(problem, f, mu, x, np.sqrt(EPS) * np.abs(x), is_second_order=True)
    return MIN_ROUNDINGS * max(find_largest_change(problem, f, mu, x, rounding), bends)


def find_largest_change(
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
    active, largest = mu > 0.0, 0.0
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


def find_descent_from_stationary_point(problem: MaxOfFunctions, x: Array) -> Array | None:
    """A point near x that is better though every gradient vanishes at x, as on a hilltop.

    None where there is none, or where the multipliers balance gradients that do not vanish.
    """
    here = problem.linearise(x)
    worst, reach = float(here.f.max()), np.maximum(np.abs(x), problem.lengths)
    level = float(np.abs(here.f).max()) or 1.0
    active = here.f >= worst - FLAT * level
    if np.abs(here.jacobian[active] * reach).max(initial=0.0) > FLAT * level:
        return None
    best, found = worst - FLAT**2 * level, None
    for step in NEARBY * np.concatenate([np.diag(reach), -np.diag(reach)]):
        f, c = problem.evaluate(x + step)
        inside = np.all(c >= problem.lower) and np.all(c <= problem.upper)
        if inside and np.all(np.isfinite(f)) and f.max() < best:
            best, found = float(f.max()), x + step
    return found


def falls_without_end(problem: MaxOfFunctions, start: Array, end: Array, tolerance: float) -> bool:
    """Whether the largest function falls on and on along the way from a start to an end.

    problem: in the units of the start, which meets the constraints.  Asked from one length of the
    variables to the end, and at least to `MIN_FALL` lengths, in steps that grow alike; what falls
    by less and less, as 1/x, comes to an end.
    """
    way = end - start
    length_count = float(np.abs(way / np.maximum(problem.lengths, np.abs(start))).max())
    if not 0.0 < length_count < np.inf:
        return False
    last_value, last_drop = float(problem.values(start).max()), 0.0
    decade_count = int(np.ceil(np.log10(max(length_count, MIN_FALL))))
    for share in np.logspace(0, decade_count, 2 * decade_count + 1) / length_count:
        x = start + share * way
        f, c = problem.evaluate(x)
        reach = np.abs(problem.rows.jacobian(x)) @ np.maximum(np.abs(x), problem.lengths)
        is_inside = np.all(excess(c, problem.lower, problem.upper) <= tolerance * reach)
        drop = last_value - float(f.max())
        if not (is_inside and drop > MIN_DROP_RATIO * last_drop):
            return False
        last_value, last_drop = last_value - drop, drop
    return True
