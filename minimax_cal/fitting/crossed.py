"""The claim *within* the measured poses: by poses held out, or by cross-validation where few are.

Of a few held-out poses an accuracy is known badly, and a largest error not at all.  So every pose
is judged by a fit without it: those held out by the fit itself, the others in turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from minimax_cal.fitting.accuracy import (
    UNKNOWN,
    Accuracy,
    Interval,
    accuracy,
    max_interval,
    rms_interval,
    told,
)
from minimax_cal.fitting.beyond import without
from minimax_cal.fitting.uncertainty import Estimator
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import groups
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.parameters import State

MIN_HELD_POSES = 20  # held-out poses; of fewer a share is left out in turn as well
FOLDS = 10  # parts of the training poses: a fit without one has nearly all of them
# numbers measured per parameter; with fewer, errors on new poses are far larger
MIN_NUMBERS_PER_PARAMETER = 3.0
FREE = 6  # numbers that a pose tells at most, however many targets it shows
NOT_CROSSED = np.zeros((0, 0, 3))


@dataclass(frozen=True)
class Within:
    """How the arm did on poses that its fit had not seen, and before.

    poses: that count by themselves; repeats and clusters count once.  where: which, in words.
    rms, largest: 95 % intervals [m].  missed: poses that no fit without them judges.
    """

    before: Accuracy
    after: Accuracy
    where: str
    poses: int = 0
    rms: Interval = UNKNOWN
    largest: Interval = UNKNOWN
    missed: int = 0


def crossed(
    estimator: Estimator,
    state: State,
    held: Array,
    group: Array,
    error_of: Callable[[State, Array], Array],
    seed: int,
    frames: int,
) -> Array:
    """(m, k, 3) errors of every pose by a fit without it, NaN where no fit can do without [m].

    Fits without a part are those of `beyond.without`.  held: (m,) True where the fit has not seen
    the pose.  group: (m,) poses with one number are left out together.  error_of: errors (r, k, 3)
    of a state at some rows [m].  frames: as `beyond.without`.
    """
    names = np.unique(group[~held])
    drawn = np.random.default_rng(seed).permutation(len(names)) % min(FOLDS, len(names))
    fold = np.where(held, -1, drawn[np.minimum(np.searchsorted(names, group), len(names) - 1)])
    masks = [fold == number for number in range(int(drawn.max(initial=-1)) + 1)]
    fits = without(estimator, state, [mask[~held] for mask in masks], frames)
    out = np.full((len(held), len(estimator.model.y), 3), np.nan)
    for mask, fit in zip([held, *masks], [state, *fits], strict=True):
        if fit:
            out[mask] = error_of(fit, mask)
    return out


def intervals_of(
    error: Array, group: Array, seed: int | np.random.Generator
) -> tuple[Interval, Interval]:
    """95 % intervals of the RMS and of the largest of errors (m, k, 3) [m], as they are told.

    group: (m,).
    """
    rng, found = np.random.default_rng(seed), accuracy(error)
    rms, largest = rms_interval(error, group, rng=rng), max_interval(error, group, rng=rng)
    return told(rms, 1e-3 * found.rms_mm), told(largest, 1e-3 * found.max_mm)


def few_poses(train: Measurements, parameters: int) -> str:
    """Why the poses are too few for the parameters, else nothing.

    With n numbers and p parameters the mean square on new poses is (n + p) / (n - p) times that of
    the poses of the fit.
    """
    _, first = np.unique(groups(train), return_index=True)
    each = np.minimum(3 * train.seen[first].sum(axis=1), FREE)
    numbers = int(each.sum())
    if numbers >= MIN_NUMBERS_PER_PARAMETER * parameters or not parameters:
        return ""
    more = math.ceil(MIN_NUMBERS_PER_PARAMETER * parameters / each.mean())
    growth = "many"
    if numbers > parameters:
        growth = f"about {math.sqrt((numbers + parameters) / (numbers - parameters)):.1f}"
    return (
        f"{len(first)} training poses tell {numbers} numbers for {parameters} free "
        f"parameters, so that errors on new poses are {growth} times those of training; measure at "
        f"{more} poses or more, fix parameters, or tell what is known of them as priors"
    )
