"""The claim *within* the measured poses: by poses held out, or by cross-validation where few are.

Of a few held-out poses an accuracy is known badly, and a largest error not at all.  So every pose
is judged by a fit without it: those held out by the fit itself, the others in turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.fitting.accuracy import (
    UNKNOWN_INTERVAL,
    Accuracy,
    Interval,
    bootstrap_rms_interval,
    interval_for_display,
    predict_max_error_interval,
    summarise_point_errors,
)
from minimax_cal.fitting.region_holdout import refit_without_regions
from minimax_cal.fitting.uncertainty import Estimator
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import group_repeated_poses
from minimax_cal.modelling.parameters import ParameterValues

MIN_HELD_POSES = 20  # held-out poses; of fewer a share is left out in turn as well
MAX_FOLDS = 10  # parts of the training poses: a fit without one has nearly all of them
# numbers measured per parameter; with fewer, errors on new poses are far larger
MIN_NUMBERS_PER_PARAMETER = 3.0
MAX_NUMBERS_PER_POSE = 6  # numbers that a pose tells at most, however many targets it shows
NO_CROSS_VALIDATED_ERRORS = np.zeros((0, 0, 3))


@dataclass(frozen=True)
class UnseenAccuracy:
    """How the arm did on poses that its fit had not seen, and before.

    poses: that count by themselves; repeats and clusters count once.  where: which, in words.
    rms, largest: 95 % intervals [m].  missed: poses that no fit without them judges.
    """

    before: Accuracy
    after: Accuracy
    where: str
    poses: int = 0
    rms: Interval = UNKNOWN_INTERVAL
    largest: Interval = UNKNOWN_INTERVAL
    missed: int = 0


def cross_validate(
    estimator: Estimator,
    state: ParameterValues,
    is_held: Array,
    pose_groups: Array,
    compute_errors: Callable[[ParameterValues, Array], Array],
    seed: int,
    frame_parameter_count: int,
) -> Array:
    """(m, k, 3) errors of every pose by a fit without it, NaN where no fit can do without [m].

    Fits without a part are those of `beyond.refit_without_regions`.  is_held: (m,) True where the
    fit has not seen the pose.  pose_groups: (m,) poses with one number are left out together.
    compute_errors: errors (r, k, 3) of a state at some rows [m].  frame_parameter_count: as
    `beyond.refit_without_regions`.
    """
    names = np.unique(pose_groups[~is_held])
    drawn = np.random.default_rng(seed).permutation(len(names)) % min(MAX_FOLDS, len(names))
    fold = np.where(
        is_held, -1, drawn[np.minimum(np.searchsorted(names, pose_groups), len(names) - 1)]
    )
    masks = [fold == number for number in range(int(drawn.max(initial=-1)) + 1)]
    fits = refit_without_regions(
        estimator, state, [mask[~is_held] for mask in masks], frame_parameter_count
    )
    out = np.full((len(is_held), len(estimator.model.y), 3), np.nan)
    for mask, fit in zip([is_held, *masks], [state, *fits], strict=True):
        if fit:
            out[mask] = compute_errors(fit, mask)
    return out


def error_intervals(
    point_errors: Array, pose_groups: Array, seed: int | np.random.Generator
) -> tuple[Interval, Interval]:
    """95 % intervals of the RMS and of the largest of errors (m, k, 3) [m], as they are told.

    pose_groups: (m,).
    """
    rng, found = np.random.default_rng(seed), summarise_point_errors(point_errors)
    rms, largest = (
        bootstrap_rms_interval(point_errors, pose_groups, rng=rng),
        predict_max_error_interval(point_errors, pose_groups, rng=rng),
    )
    return interval_for_display(rms, 1e-3 * found.rms_mm), interval_for_display(
        largest, 1e-3 * found.max_mm
    )


def describe_too_few_poses(training_data: Measurements, parameter_count: int) -> str:
    """Why the poses are too few for the parameters, else nothing.

    With n numbers and p parameters the mean square on new poses is (n + p) / (n - p) times that of
    the poses of the fit.
    """
    _, first = np.unique(group_repeated_poses(training_data), return_index=True)
    each = np.minimum(3 * training_data.seen[first].sum(axis=1), MAX_NUMBERS_PER_POSE)
    numbers = int(each.sum())
    if numbers >= MIN_NUMBERS_PER_PARAMETER * parameter_count or not parameter_count:
        return ""
    more = math.ceil(MIN_NUMBERS_PER_PARAMETER * parameter_count / each.mean())
    growth = "many"
    if numbers > parameter_count:
        growth = f"about {math.sqrt((numbers + parameter_count) / (numbers - parameter_count)):.1f}"
    return (
        f"{len(first)} training poses tell {numbers} numbers for {parameter_count} free "
        f"parameters, so that errors on new poses are {growth} times those of training; measure at "
        f"{more} poses or more, fix parameters, or tell what is known of them as priors"
    )
