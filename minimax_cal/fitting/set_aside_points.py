"""What was set aside for a fit, and how the arm does where those points count too."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.fitting.accuracy import Accuracy, summarise_point_errors, with_intervals
from minimax_cal.fitting.cell_fit import CellFit
from minimax_cal.fitting.cross_validation import error_intervals
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.robust_fit import SQUARE_LOSS
from minimax_cal.measuring.measurements import SET_ASIDE_BY_TOOL, Measurements, SetAsidePoint
from minimax_cal.measuring.pose_groups import group_for_holdout
from minimax_cal.measuring.session_frames import convert_to_first_frame
from minimax_cal.measuring.set_aside_points import (
    format_set_aside_count,
    merge_rows_by_line,
    set_points_aside,
)
from minimax_cal.modelling.cell import Cell


def accuracy_with_set_aside(
    point_errors: Array,
    pose_groups: Array,
    set_aside_errors: Array,
    held_out_fraction: float = 1.0,
    seed: int = 0,
) -> Accuracy:
    """Accuracy, with its intervals, on poses that no fit has seen, the points set aside among them.

    No fit has seen these either.  Each weighs as the share of the other points that is held out, so
    that they count as they would among all. point_errors: (h, k, 3) at poses that judge,
    pose_groups: (h,) of them.  set_aside_errors: (a, k, 3) at the points set aside, NaN elsewhere
    [m].  held_out_fraction: of all other points that judge.
    """
    both = np.concatenate([point_errors, set_aside_errors])
    found = summarise_point_errors(both)
    seen, gone = (int(np.isfinite(part[..., 0]).sum()) for part in (point_errors, set_aside_errors))
    if not (seen and gone):
        held_out_fraction = 1.0
    even = (seen + gone) / max(seen + held_out_fraction * gone, 1e-300)
    root = np.sqrt(
        np.repeat([even, even * held_out_fraction], [len(point_errors), len(set_aside_errors)])
    )
    weighed = summarise_point_errors(root[:, None, None] * both)
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
    last = int(pose_groups.max(initial=-1)) + 1
    every = np.concatenate([pose_groups, last + np.arange(len(set_aside_errors))])
    rms, _ = error_intervals(root[:, None, None] * both, every, seed)
    _, largest = error_intervals(both, every, seed)
    return with_intervals(whole, rms, largest)


def judge_with_set_aside(
    data: Measurements,
    is_held: Array,
    cell: Cell,
    point_errors: Array,
    cross_validated_errors: Array,
    solved: CellFit,
    options: Options,
) -> tuple[tuple[SetAsidePoint, ...], Accuracy | None]:
    """The points set aside for a fit, and the accuracy with them; None where there are none.

    data: all poses.  is_held: (m,).  point_errors: (m, k, 3) of the fit; cross_validated_errors: of
    every pose by a fit without it, or empty [m].
    """
    trimmed = data
    if options.trim or options.loss != SQUARE_LOSS:  # training points that the fit gave no weight
        gone = np.zeros(data.seen.shape, dtype=bool)
        gone[~is_held] = (solved.robust.weights == 0.0).T & data.seen[~is_held]
        why = f"trim {options.trim:g}" if options.trim else f"loss {options.loss}"
        trimmed = set_points_aside(data, gone, f"outlier ({why})", SET_ASIDE_BY_TOOL)
    if not trimmed.set_aside:
        return (), None
    group = np.unique(group_for_holdout(data, options.holdout_by), return_inverse=True)[1].reshape(
        -1
    )
    if cross_validated_errors.size:  # which holds what was trimmed, by fits that trim anew
        found = accuracy_with_set_aside(
            cross_validated_errors, group, set_aside_errors(cell, data), seed=options.seed
        )
        return trimmed.set_aside, found
    share = float(data.seen[is_held].sum() / max(int(trimmed.seen.sum()), 1))
    aside = set_aside_errors(cell, trimmed)
    return trimmed.set_aside, accuracy_with_set_aside(
        point_errors[is_held], group[is_held], aside, share, options.seed
    )


def set_aside_errors(cell: Cell, data: Measurements) -> Array:
    """(a, k, 3) errors of a cell at the points of data that were set aside [m].

    With all poses, for these were visited between them; (0, k, 3) where there are none.
    """
    if data.aside is None:
        return np.zeros((0, len(data.target_names), 3))
    aside = convert_to_first_frame(data.aside, data.frames)
    every = merge_rows_by_line(replace(data, aside=None, set_aside=()), aside)
    rows = np.searchsorted(every.line, aside.line)
    error = cell.error(every)[rows]
    return np.where(aside.seen[..., None], error, np.nan)


def describe_points_set_aside(points: Sequence[SetAsidePoint], accuracy: Accuracy | None) -> str:
    """How many points were set aside, by whom, and the error with them."""
    them = "it" if len(points) == 1 else "them"
    if accuracy is None:
        return f"{format_set_aside_count(points)}."
    errors = f"RMS {accuracy.rms_mm:.3f} mm, largest {accuracy.max_mm:.3f} mm"
    return f"{format_set_aside_count(points)}; with {them} {errors}."
