"""What was set aside for a fit, and how the arm does where those points count too."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.fitting.accuracy import Accuracy, accuracy, with_ends
from minimax_cal.fitting.crossed import intervals_of
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.robust import SQUARE
from minimax_cal.fitting.solve import Solved
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import grouped
from minimax_cal.measuring.measurements import TOOL, Measurements, SetAside
from minimax_cal.measuring.set_aside import counted, merged, set_aside
from minimax_cal.measuring.stations import seen_from
from minimax_cal.modelling.cell import Cell


def with_them(
    error: Array, group: Array, aside: Array, share: float = 1.0, seed: int = 0
) -> Accuracy:
    """Accuracy, with its intervals, on poses that no fit has seen, the points set aside among them.

    No fit has seen these either.  Each weighs as the share of the other points that is held out, so
    that they count as they would among all.
    error: (h, k, 3) at poses that judge, group: (h,) of them.  aside: (a, k, 3) at the points set
    aside, NaN elsewhere [m].  share: of all other points that judge.
    """
    both = np.concatenate([error, aside])
    found = accuracy(both)
    seen, gone = (int(np.isfinite(part[..., 0]).sum()) for part in (error, aside))
    if not (seen and gone):
        share = 1.0
    even = (seen + gone) / max(seen + share * gone, 1e-300)
    root = np.sqrt(np.repeat([even, even * share], [len(error), len(aside)]))
    weighed = accuracy(root[:, None, None] * both)
    size = np.linalg.norm(both, axis=-1)
    means = [1e3 * float(np.nansum(root**2 * row)) for row in size.T]
    counts = found.counts
    whole = Accuracy(
        rms_mm=weighed.rms_mm,
        max_mm=found.max_mm,
        mean_mm=sum(means) / max(sum(counts), 1) if sum(counts) else math.nan,
        poses=found.poses,
        sse_mm2=weighed.sse_mm2,
        counts=counts,
    )
    if not sum(counts):
        return whole
    last = int(group.max(initial=-1)) + 1
    every = np.concatenate([group, last + np.arange(len(aside))])
    rms, _ = intervals_of(root[:, None, None] * both, every, seed)
    _, largest = intervals_of(both, every, seed)
    return with_ends(whole, rms, largest)


def judged_with(
    data: Measurements,
    held: Array,
    cell: Cell,
    error: Array,
    crossed: Array,
    solved: Solved,
    options: Options,
) -> tuple[tuple[SetAside, ...], Accuracy | None]:
    """The points set aside for a fit, and the accuracy with them; None where there are none.

    data: all poses.  held: (m,).  error: (m, k, 3) of the fit; crossed: of every pose by a fit
    without it, or empty [m].
    """
    trimmed = data
    if options.trim or options.loss != SQUARE:  # training points that the fit gave no weight
        gone = np.zeros(data.seen.shape, dtype=bool)
        gone[~held] = (solved.robust.weights == 0.0).T & data.seen[~held]
        why = f"trim {options.trim:g}" if options.trim else f"loss {options.loss}"
        trimmed = set_aside(data, gone, f"outlier ({why})", TOOL)
    if not trimmed.set_aside:
        return (), None
    group = np.unique(grouped(data, options.holdout_by), return_inverse=True)[1].reshape(-1)
    if crossed.size:  # which holds what was trimmed, by fits that trim anew
        found = with_them(crossed, group, errors_of(cell, data), seed=options.seed)
        return trimmed.set_aside, found
    share = float(data.seen[held].sum() / max(int(trimmed.seen.sum()), 1))
    aside = errors_of(cell, trimmed)
    return trimmed.set_aside, with_them(error[held], group[held], aside, share, options.seed)


def errors_of(cell: Cell, data: Measurements) -> Array:
    """(a, k, 3) errors of a cell at the points of data that were set aside [m].

    With all poses, for these were visited between them; (0, k, 3) where there are none.
    """
    if data.aside is None:
        return np.zeros((0, len(data.target_names), 3))
    aside = seen_from(data.aside, data.frames)
    every = merged(replace(data, aside=None, set_aside=()), aside)
    rows = np.searchsorted(every.line, aside.line)
    error = cell.error(every)[rows]
    return np.where(aside.seen[..., None], error, np.nan)


def aside_sentence(points: Sequence[SetAside], found: Accuracy | None) -> str:
    """How many points were set aside, by whom, and the error with them."""
    them = "it" if len(points) == 1 else "them"
    if found is None:
        return f"{counted(points)}."
    errors = f"RMS {found.rms_mm:.3f} mm, largest {found.max_mm:.3f} mm"
    return f"{counted(points)}; with {them} {errors}."
