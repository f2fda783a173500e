"""The least value of a function of one variable between two ends, without derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

GOLDEN_SECTION_FRACTION = 0.5 * (3.0 - math.sqrt(5.0))
ROOT_OF_EPS = math.sqrt(np.finfo(float).eps)


class ScalarMinimum(NamedTuple):
    """Where a function is least, and its value there."""

    argument: float
    value: float


def minimise_scalar_between(
    function: Callable[[float], float], low: float, high: float, tolerance: float = 1e-5
) -> ScalarMinimum:
    """Find the minimum of a function of one variable that has one between two ends.

    Golden sections, and parabolas where they are short [Brent 1973, ch. 5; Forsythe, Malcolm and
    Moler 1977, sec. 8.2].  tolerance: of the place.
    """
    best = second = third = low + GOLDEN_SECTION_FRACTION * (high - low)
    at_best = at_second = at_third = function(best)
    step = before = 0.0
    while True:
        middle, near = 0.5 * (low + high), ROOT_OF_EPS * abs(best) + tolerance / 3.0
        if abs(best - middle) <= 2.0 * near - 0.5 * (high - low):
            return ScalarMinimum(best, at_best)
        golden = True
        if abs(before) > near:  # a parabola through the three best
            r = (best - second) * (at_best - at_third)
            q = (best - third) * (at_best - at_second)
            p = (best - third) * q - (best - second) * r
            q = 2.0 * (q - r)
            p, q = (-p if q > 0.0 else p), abs(q)
            r, before = before, step
            if abs(p) < abs(0.5 * q * r) and q * (low - best) < p < q * (high - best):
                step, golden = p / q, False
                trial = best + step
                if trial - low < 2.0 * near or high - trial < 2.0 * near:
                    step = math.copysign(near, middle - best) if middle != best else near
        if golden:
            before = low - best if best >= middle else high - best
            step = GOLDEN_SECTION_FRACTION * before
        trial = best + math.copysign(max(abs(step), near), step)
        value = function(trial)
        if value <= at_best:
            low, high = (best, high) if trial >= best else (low, best)
            third, at_third, second, at_second = second, at_second, best, at_best
            best, at_best = trial, value
            continue
        low, high = (trial, high) if trial < best else (low, trial)
        if value <= at_second or second == best:
            third, at_third, second, at_second = second, at_second, trial, value
        elif value <= at_third or third in (best, second):
            third, at_third = trial, value
