"""Is anything left?  What effects leave of an arm's errors, asked by `evidence.remains`.

error^2 = noise^2 + what depends on something^2 + what nothing explains^2.  A part that nobody has
measured is no number here: the scatter of the joints, which only visits to one pose tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.diagnosing.result import Dependence, Remaining
from minimax_cal.diagnosing.study import Study
from minimax_cal.evidence.limits import MAX_ALONE, MAX_JOINT_JITTER, STRUCTURE, WORTH
from minimax_cal.evidence.noise import Noise, Problem, restricted
from minimax_cal.evidence.remains import Asked, Remains, asked, rest_of
from minimax_cal.evidence.selection import Choice
from minimax_cal.fitting.floor import REPEATS, instrument_alone, least_scatter
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.remaining import components
from minimax_cal.modelling.rows import Posed

FEW = 2  # parameters of an effect whose motions are asked each by itself
NOTHING = Remains("nothing", "anything", 0.0, 1.0, 0.0)


def left_by(study: Study, choice: Choice, more: Array | None = None) -> tuple[Remains, ...]:
    """What effects leave, the loudest first, whatever the masses are that they were told with.

    more: (N, q) columns that were fitted besides.
    """
    known = choice.doubted if more is None else np.concatenate([choice.doubted, more], axis=1)
    if choice.noise.variance < study.rows.exact**2:
        return (NOTHING,)
    return left_over(study.scene, study.rows, known, motions(choice))


def left_over(
    scene: Scene, rows: Posed, known: Array, named: Sequence[tuple[str, Array]] = ()
) -> tuple[Remains, ...]:
    """What geometry and known columns (N, q) leave.  named: motions as `components` has them."""
    return asked_of(scene, rows, known, named).loud_ones or (NOTHING,)


def asked_of(
    scene: Scene,
    rows: Posed,
    known: Array | None = None,
    named: Sequence[tuple[str, Array]] = (),
) -> Asked:
    """Everything that may remain, asked of what geometry and known columns leave.

    As `left_over`.
    """
    columns = np.zeros((len(rows.error), 0)) if known is None else known
    noise = anchored(restricted(rows, columns), rows)
    return asked(rest_of(rows, noise, columns, rows.turn), list(components(scene, rows, named)))


def anchored(noise: Noise, rows: Problem) -> Noise:
    """The noise, its joints no worse than sound ones are: more is lack of fit."""
    most = MAX_JOINT_JITTER**2 * rows.size / noise.variance
    return replace(noise, ratio=min(noise.ratio, most))


def motions(choice: Choice) -> list[tuple[str, Array]]:
    """The effects with the rows of their motions: of few parameters each its own, else together."""
    out = []
    for candidate, (value, _) in zip(choice.chosen, choice.estimates, strict=True):
        motion = choice.library.columns[:, candidate.main]
        whole = (motion @ value)[:, None]
        out.append((candidate.term.label, motion if motion.shape[1] <= FEW else whole))
    return out


def certain(left: Sequence[Remains]) -> list[Remains]:
    """What certainly remains and matters, what tells most of it first."""
    sure = [one for one in left if one.p < STRUCTURE and one.share > WORTH]
    return sorted(sure, key=lambda one: one.telling)


def loudest(left: Sequence[Remains]) -> Remains | None:
    """Of what certainly remains and matters the loudest; None where nothing does."""
    return next(iter(certain(left)), None)


# ---- where each part is known from ---------------------------------------------------------------


def remaining_of(
    left: Sequence[Remains], last: float, data: Measurements, error: Array, most: float = math.inf
) -> tuple[Remaining, bool]:
    """What remains, and whether all noise beneath it is known.

    left: what the last step leaves, as asked of its poses.  last: RMS distance that it leaves at
    held-out poses [mm].  data: without faults; error: (m, k, 3) of its arm at them [m].  most: what
    noise is said to be at most, which few visits that are far off do not change [mm].
    """
    again = least_scatter(data, error)
    noise, source = instrument_alone(data)
    if again:  # joints that stop on either side have no middle: by the mean of the squares
        noise, source = 1e3 * math.sqrt(float(again[0].mean())), REPEATS
    known = source == REPEATS or last <= MAX_ALONE * noise
    noise = min(noise, last, most) if math.isfinite(noise) else noise
    rest = math.sqrt(last**2 - (noise**2 if noise > 0.0 else 0.0))
    depends = tuple(
        Dependence(one.place, one.driver, min(last * math.sqrt(one.share), rest), one.p)
        for one in certain(left)
    )
    told = Remaining(depends, 0.0, noise, source)
    return replace(told, unexplained_mm=math.sqrt(rest**2 - told.dependent_mm**2)), known
