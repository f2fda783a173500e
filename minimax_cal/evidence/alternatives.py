"""What else it could be: candidates that the data cannot tell from the one that is named."""

from __future__ import annotations

import numpy as np

from minimax_cal.evidence.bench import Added, Bench
from minimax_cal.evidence.library import Library
from minimax_cal.evidence.limits import BAND, ENOUGH, LEVEL, LUCK
from minimax_cal.evidence.noise import restricted
from minimax_cal.ground.arrays import Array


def alternatives(table: Bench, one: Added) -> list[tuple[Added, float, float]]:
    """Other effects or places that may be the truth, with rho^2 and the power to tell them apart.

    Those that do nearly as well; and those that do worse by some luck, the data having too little
    power to tell them apart.  Where they have it, what is needed beside another too is no other
    name for it: both are there, or something else is.
    """
    out, seen = [], {one.candidate.key, *(c.key for c in table.chosen)}
    for other in table.everyone:
        if other.candidate.key in seen or other.evidence <= 0.0:
            continue
        close = other.evidence > one.evidence - BAND
        alike = other.candidate.family == one.candidate.family  # as all joints hold one
        if not close and (alike or other.evidence < one.evidence - LUCK):
            continue
        size, rho2 = table.likeness(one, other.candidate)
        power = size * (1.0 - rho2)
        if power < ENOUGH or (close and table.p_beside(one, other.candidate) >= LEVEL):
            seen.add(other.candidate.key)
            out.append((other, rho2, power))
    return out


def resemblances(lib: Library, column: Array) -> dict[tuple[str, str], float]:
    """rho^2 of every candidate with rows (N, 1) that something adds to the error: the best variant.

    Projected on what geometry cannot imitate and weighed by the noise that the data show with it.
    """
    noise = restricted(lib.rows, column)
    root = np.sqrt(noise.weights(lib.rows))[:, None]
    basis = np.linalg.qr(lib.rows.basis * root)[0]
    field = column * root
    field = (field - basis @ (basis.T @ field))[:, 0]
    whole = lib.columns * root
    whole = whole - basis @ (basis.T @ whole)
    out: dict[tuple[str, str], float] = {}
    for c in lib.candidates:
        part = whole[:, c.main]
        scale = np.maximum(np.linalg.norm(part, axis=0), 1e-300)
        found = np.linalg.lstsq(part / scale, field, rcond=1e-6)[0]
        share = 1.0 - float(((field - part / scale @ found) ** 2).sum() / (field @ field))
        out[c.key] = max(out.get(c.key, 0.0), share)
    return out
