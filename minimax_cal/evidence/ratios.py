"""Ratios of the two noises at which products are formed, and polynomials between them.

A row with the variance ratio v weighs 1/(1 + ratio v).  Along the logarithm of the ratio that is a
smooth step whose nearest poles lie pi beside the real line, so that a polynomial through so many
Chebyshev points in every decade gives all weights to rounding, and with them all products, what
is left of these when columns are projected out, and likelihoods.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from minimax_cal.ground.arrays import Array

RATIOS = np.concatenate([[0.0], np.logspace(-3, 5, 9)])  # among which the likeliest is sought
ZERO = -300  # the decade of the ratio 0
NODES = 18  # points in a decade of ratios: products to rounding
FEW = 14  # points in two decades where a likelihood is least: to 1e-7 of it
FINE = 401  # points between which a polynomial's least value is sought


@cache
def points(count: int) -> Array:
    """(g,) Chebyshev points between 0 and 1."""
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * (2.0 * np.arange(count) + 1.0) / (2.0 * count)))


def nodes(number: int) -> Array:
    """(g,) ratios in a decade; in ZERO the ratio 0 alone."""
    return np.asarray(10.0 ** (number + points(NODES))) if number > ZERO else np.zeros(1)


def interpolation(x: Array, count: int) -> Array:
    """(s, g) values at x of the polynomials that are 1 at one Chebyshev point and 0 at the others.

    By the barycentric formula [Berrut and Trefethen 2004].
    """
    at = points(count)
    off = x[:, None] - at
    met = off == 0.0
    size = np.sqrt(at * (1.0 - at)) * np.where(np.arange(count) % 2, -1.0, 1.0)
    part = size / np.where(met, 1.0, off)
    part = np.where(met.any(axis=1, keepdims=True), met.astype(float), part)
    return np.asarray(part / part.sum(axis=1, keepdims=True))


@cache
def finely() -> tuple[Array, Array]:
    """Points (f,) from 0 to 1, and how values there follow from those at a few (f, g)."""
    x = np.linspace(0.0, 1.0, FINE)
    return x, interpolation(x, FEW)


def find_ratio(cost: Callable[[Array], Array]) -> float:
    """The ratio of least cost, 0 if none of RATIOS costs less.  cost: (g,) of ratios (g,)."""
    best = int(np.argmin(cost(RATIOS)))
    if not best:
        return 0.0
    ends = RATIOS[[max(best - 1, 1), min(best + 1, len(RATIOS) - 1)]]
    low, high = np.log10(ends)
    x, between = finely()
    values = between @ cost(10.0 ** (low + (high - low) * points(FEW)))
    at = int(np.argmin(values))
    step = vertex(values, at) / (FINE - 1)
    return float(10.0 ** (low + (high - low) * (x[at] + step)))


def vertex(values: Array, at: int) -> float:
    """Where beside its least point, in steps, the parabola through it and its neighbours is."""
    if at in (0, len(values) - 1):
        return 0.0
    before, here, after = values[at - 1 : at + 2]
    bend = before - 2.0 * here + after
    return float(0.5 * (before - after) / bend) if bend > 0.0 else 0.0
