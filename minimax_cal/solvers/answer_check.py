"""The last question of a minimisation: is the answer optimal, measured where it is?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.solvers.derivatives import difference_jacobian, measure_lengths
from minimax_cal.solvers.max_problem import EPS, MaxOfFunctions
from minimax_cal.solvers.minimax import (
    CANCELLED,
    Kkt,
    Linear,
    Units,
    multipliers_at,
    optimality,
)

FLAT = 1e-6  # gradients below, relative to the lengths and the level, count as none
NEARBY = 1e-3  # distance, in lengths, at which a better point is looked for
MIN_ROUNDINGS = 10.0  # of x, over which functions change by more than their own rounding
FARTHER = (1.0, 1e2, 1e4, 1e6)  # times the way of a search that found no end


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
    here = problem.linearise(x)
    if problem.jacobian.scheme == "2-point":
        slopes = difference_jacobian(
            problem.values, x, np.maximum(np.abs(x), problem.lengths), True
        )
        here = replace(here, jacobian=np.where(np.isfinite(slopes), slopes, here.jacobian))
    terms = mu @ np.abs(here.f)
    terms += (mu @ np.abs(here.jacobian) + np.abs(lam) @ np.abs(here.normal)) @ np.abs(x)
    size = min(abs(float(here.f.max())), find_variation(problem, here.f, x, start))
    level = max(size, CANCELLED * float(terms)) or 1.0
    check = measure_optimality(problem, here, x, mu, lam, level)
    if check.kkt.residual <= tolerance:
        return check
    check = min(check, balance_multipliers(problem, here, x, level), key=residual_of)
    if check.kkt.residual <= tolerance or check.kkt.violation > tolerance:
        return check
    zero_level = find_zero_level(problem, here.f, x, start)
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
    units = find_local_units(problem, here, x, level)
    scaled, lower, upper = units.scaled(here), problem.lower / units.c, problem.upper / units.c
    kkt = optimality(scaled, mu, lam * units.c / level, lower, upper)
    violations = problem.relative_violations(x, here.c, here.normal)
    kkt = replace(kkt, violation=float(violations.max(initial=0.0)))
    return AnswerCheck(kkt, mu, lam, level)


def balance_multipliers(
    problem: MaxOfFunctions, here: Linear, x: Array, level: float
) -> AnswerCheck:
    """The residuals for the multipliers that balance the gradients best."""
    units = find_local_units(problem, here, x, level)
    scaled, lower, upper = units.scaled(here), problem.lower / units.c, problem.upper / units.c
    try:
        mu, lam = multipliers_at(scaled, lower, upper)
    except ValueError:  # a gradient is infinite here
        mu, lam = np.full(len(here.f), 1.0 / len(here.f)), np.zeros(len(here.c))
    return measure_optimality(problem, here, x, mu, lam * level / units.c, level)


def find_local_units(problem: MaxOfFunctions, here: Linear, x: Array, level: float) -> Units:
    """Units of value, variables and rows at x, for a level of the value."""
    lengths = measure_lengths(problem.values, x, problem.low, problem.high, level, problem.lengths)
    return Units.of(here, level, lengths, problem.lower, problem.upper)


def find_variation(problem: MaxOfFunctions, f: Array, x: Array, start: Array) -> float:
    """By how much moving a variable, by itself or back to the start, changes the largest functions.

    It bounds what counts as the size of the value: a number added to all functions is no size.
    """
    return find_largest_change(problem, f, x, np.maximum(np.abs(x), np.abs(x - start)))


def find_zero_level(problem: MaxOfFunctions, f: Array, x: Array, start: Array) -> float:
    """A value that counts as zero: by how much rounding of x changes the largest functions.

    x is known to the rounding of itself and of the way from the start; a smooth minimiser to the
    root of its rounding.  f: (m,) at x.
    """
    rounding = EPS * np.maximum(np.abs(x), np.abs(x - start))
    bends = find_largest_change(problem, f, x, np.sqrt(EPS) * np.abs(x), is_second_order=True)
    return MIN_ROUNDINGS * max(find_largest_change(problem, f, x, rounding), bends)


def find_largest_change(
    problem: MaxOfFunctions, f: Array, x: Array, steps: Array, is_second_order: bool = False
) -> float:
    """Largest change of the largest functions over a step of one variable, within its bounds.

    f: (m,) at x.  steps: (n,).  is_second_order: what the changes both ways have in common.
    """
    active = f >= f.max() - FLAT * abs(f.max())
    largest = 0.0
    for step in np.diag(steps):
        both = np.array([x + step, x - step])
        ends = np.clip(both, problem.low, problem.high)
        if is_second_order and np.any(ends != both):
            continue
        ahead, back = (problem.values(end) - f for end in ends)
        change = np.abs(ahead + back) if is_second_order else np.abs([ahead, back]).max(axis=0)
        change = change[active]
        largest = max(largest, float(change[np.isfinite(change)].max(initial=0.0)))
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
    variables to far beyond the end.
    """
    way = end - start
    length_count = float(np.abs(way / np.maximum(problem.lengths, np.abs(start))).max())
    if not 0.0 < length_count < np.inf:
        return False
    shares = [far / length_count for far in FARTHER]
    shares += [far for far in FARTHER if far * length_count < 1.0 / tolerance]
    worst = float(problem.values(start).max())
    for share in sorted(set(shares)):
        x = start + share * way
        f, c = problem.evaluate(x)
        violations = problem.relative_violations(x, c, problem.rows.jacobian(x))
        if not (violations.max(initial=0.0) <= tolerance and f.max() < worst):
            return False
        worst = float(f.max())
    return True
