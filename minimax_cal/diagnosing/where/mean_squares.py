"""Mean squares that tell the kind of cause apart."""

from __future__ import annotations

import math

import numpy as np
from scipy.stats import chi2, f

from minimax_cal.diagnosing.where.gaps import CANNOT_TELL, Part, Triage
from minimax_cal.diagnosing.where.residual import Residual
from minimax_cal.diagnosing.where.significance import flips
from minimax_cal.diagnosing.where.spread import revisit_scatter, shape_scatter
from minimax_cal.measuring.measurements import Measurements


def lack_of_fit(rest: Residual) -> float:
    """p that residuals do not return when a pose returns; by flips of the visits' signs."""
    once, count = np.unique(rest.group, return_counts=True)
    again = np.isin(rest.group, once[count > 1])
    rows, group = rest.even[again], rest.group[again]
    gram = np.where(group[:, None] == group, rows @ rows.T, 0.0)
    return flips(float(gram.sum()), gram)


def triage(data: Measurements, rest: Residual, noise: float, known: float, dof: float) -> Triage:
    """Mean squares per point of the errors `rest`: noise + shape + repeat + pose.

    With s^2 = noise^2, per coordinate, p fitted directions and N points:
    noise: s^2 (3 - p / N).
    shape: u^2 (3 - p / N), u^2 = `shape_scatter` per degree of freedom less s^2: targets that
    scatter on their own seem to move rigidly, too, as noise does.
    repeat: `revisit_scatter` per visit less that of s^2 + u^2, less what the fit has taken.
    pose: what is left.  Negative parts are 0; shares add up to 1 over the parts that can be told,
    and what cannot (no revisits, one target) falls to pose.
    p of shape: chi^2 against s^2, F if that has finite `dof`.  p of repeat: the same, but F
    against the scatter of the shape where that is clearly larger.  p of pose: `lack_of_fit`.
    noise: as given, NaN if it was estimated from the data as `known`: then the scatter that gave it
    is noise by definition, and cannot be told.
    """
    points = float(rest.seen.sum()) / 3.0
    total = float((rest.rows**2).sum()) / points
    if not (math.isfinite(known) and total > 0.0):
        return Triage(CANNOT_TELL, CANNOT_TELL, CANNOT_TELL, CANNOT_TELL)
    given, left = math.isfinite(noise), 3.0 - rest.fitted / points
    least, behind = max(known**2, 1e-24), dof
    told = {"noise": (known**2 * left, math.nan)}
    shape, shape_free = shape_scatter(data)
    if given and shape_free >= 1.0:
        p = above(shape, shape_free, least, behind)
        told["shape"] = (max(0.0, shape / shape_free - known**2) * left, p)
        if p < 0.01:
            least, behind = shape / shape_free, shape_free
    repeat, repeat_free, visits = revisit_scatter(data)
    if repeat_free >= 1.0 and (given or shape_free >= 1.0):
        own = sum(square for square, _ in told.values()) / left * repeat_free
        kept = max(0.0, 1.0 - rest.fitted / (3.0 * points - shape_free))
        p = above(repeat, repeat_free, least, behind)
        told["repeat"] = (max(0.0, repeat - own) / visits * kept, p)
    static = max(0.0, total - sum(square for square, _ in told.values()))
    told["pose"] = (static, lack_of_fit(rest) if repeat_free >= 1.0 else math.nan)
    whole = max(sum(square for square, _ in told.values()), 1e-300)
    parts = {name: Part(math.sqrt(ms), ms / whole, p) for name, (ms, p) in told.items()}
    return Triage(*(parts.get(name, CANNOT_TELL) for name in ("noise", "shape", "repeat", "pose")))


def above(energy: float, free: float, variance: float, behind: float) -> float:
    """p that energy / free is that large if its expectation is variance, known from `behind`."""
    ratio = energy / variance
    return float(f.sf(ratio / free, free, behind) if behind < 1e9 else chi2.sf(ratio, free))
