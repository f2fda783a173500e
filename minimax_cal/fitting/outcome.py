"""How a calibration ended: impossible, no better than the drawn arm, or neither.

Both are judged on the same poses by the same rule: base, targets and frames of the drawn arm are
fitted to the same training poses as the calibrated arm is.  The comparison is paired, pose by pose,
so that what both miss alike, as noise, does not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.fitting.accuracy import accuracy
from minimax_cal.fitting.checks import MIN_STRAY_OF_REACH, exchanged, too_changed
from minimax_cal.fitting.claims import contradiction
from minimax_cal.fitting.minimax_problem import MIN_TRUSTED_WEIGHT
from minimax_cal.fitting.options import Options, objective_of
from minimax_cal.fitting.same_arm import computed, least_noise, residual
from minimax_cal.fitting.solve import Solved
from minimax_cal.fitting.suspects import MIN_POINTS_LEFT, Suspect, aside
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.words import name_first
from minimax_cal.measuring.grouping import grouped
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots.robot import Robot

# A point that both arms miss by so many times what lies between them there does not say which of
# them is right; a point that only the calibrated arm misses does, and counts.
MIN_COMMON_MISS = 2.0

MAX_NAMED = 5  # points that a reason names


@dataclass(frozen=True)
class Improvement:
    """RMS of the drawn and of the calibrated arm on the same points [mm].

    gain: by how much the mean square is lower [mm^2].  error: standard error of that.
    wrong: points that both arms miss and that were set aside, as a clause; empty for none.
    """

    before: float
    after: float
    gain: float
    error: float
    wrong: str = ""

    @property
    def is_better(self) -> bool:
        """Whether the calibrated arm is better by one standard error; True where none is known."""
        return not (self.gain <= self.error)

    @property
    def numbers(self) -> str:
        """Calibrated against drawn, for people."""
        return f"{self.after:#.3g} against {self.before:#.3g} mm"


def compare_arms(drawn: Array, calibrated: Array, group: Array) -> Improvement:
    """The paired comparison of errors (k, m, 3) at the points that both have [m].

    group: (m,) poses with one number belong together and count once.
    """
    both = np.isfinite(drawn[..., 0]) & np.isfinite(calibrated[..., 0])
    each = [np.where(both, 1e6 * (error**2).sum(axis=-1), 0.0) for error in (drawn, calibrated)]
    names, member = np.unique(group, return_inverse=True)
    parts = (both, each[0] - each[1])
    count, lower = (np.bincount(member, part.sum(axis=0), len(names)) for part in parts)
    lower, count = lower[count > 0.0], count[count > 0.0]
    points, poses = count.sum(), len(count)
    before, after = (float(np.sqrt(square.sum() / points)) if poses else np.nan for square in each)
    if poses < 2:
        return Improvement(before, after, np.nan, np.nan)
    gain = float(lower.sum() / points)
    off = lower - gain * count  # of a ratio of sums, to first order
    error = float(np.sqrt((off**2).sum() * poses / (poses - 1.0)) / points)
    return Improvement(before, after, gain, error)


def improvement(
    drawn: Array,
    calibrated: Array,
    group: Array,
    data: Measurements,
    suspects: Sequence[Suspect],
) -> Improvement:
    """The comparison of all points; without wrong points where these alone hide what is better.

    drawn, calibrated: (k, m, 3) errors [m], NaN where not judged.  group: (m,).  suspects: points
    that stand out from the calibrated arm.
    """
    whole = compare_arms(drawn, calibrated, group)
    if whole.is_better:
        return whole
    between = np.linalg.norm(drawn - calibrated, axis=-1)
    alike = np.linalg.norm(calibrated, axis=-1) > MIN_COMMON_MISS * between
    wrong = alike & np.isnan(aside(calibrated, data, suspects)[..., 0])
    judged = np.isfinite(calibrated[..., 0])
    if not (wrong & judged).any() or (judged & ~wrong).sum() < MIN_POINTS_LEFT * judged.sum():
        return whole
    less = compare_arms(*hidden(drawn, calibrated, wrong), group)
    named = points_of(data, wrong & judged, calibrated)
    return replace(less, wrong=named) if less.is_better else whole


def points_of(data: Measurements, which: Array, error: Array) -> str:
    """Points in words.  which: (k, m).  error: (k, m, 3) [m]."""
    size = 1e3 * np.linalg.norm(error, axis=-1)
    shown = [
        f"{data.called(data.line[pose])} {data.target_names[target]} {size[target, pose]:.3g} mm"
        for target, pose in np.argwhere(which).tolist()
    ]
    return name_first(shown, MAX_NAMED)


def no_better(found: Improvement, suspects: Sequence[Suspect], data: Measurements) -> str:
    """The sentence for an arm that is no better than the drawn one, and what to do."""
    off = [one.text(data) for one in suspects]
    rows = f"; check the outliers ({name_first(off, MAX_NAMED)})" if off else ""
    return (
        f"The calibrated arm is no better than the drawn one ({found.numbers} on new poses): keep "
        "the drawn arm, or calibrate again with more poses, joint values with all their digits "
        f"and less noise{rows}"
    )


def said_without(found: Improvement, whole: tuple[float, float]) -> str:
    """Notice that wrong points hide what is better.  whole: RMS before and after of all [mm]."""
    return (
        f"points that the drawn and the calibrated arm both miss ({found.wrong}) hide the "
        f"improvement on new poses: {whole[0]:#.3g} -> {whole[1]:#.3g} mm with them, "
        f"{found.before:#.3g} -> {found.after:#.3g} mm without; correct or delete these rows"
    )


def rms_of(drawn: Array, calibrated: Array) -> tuple[float, float]:
    """RMS of both at the points that both have [mm]."""
    both = np.isfinite(drawn) & np.isfinite(calibrated)
    before, after = (accuracy(np.where(both, one, np.nan)).rms_mm for one in (drawn, calibrated))
    return before, after


# ---- how it ended --------------------------------------------------------------------------------


def exchanged_rows(robot: Robot, data: Measurements, before: Array) -> Array:
    """(b,) rows whose points belong to other rows.  before: (k, m, 3) errors as drawn [m]."""
    far = np.nanmax(np.linalg.norm(before, axis=-1), initial=0.0)
    if far > MIN_STRAY_OF_REACH * robot.reach():
        return exchanged(robot, data)
    return np.zeros(0, dtype=int)


def said_of_exchanged(data: Measurements, rows: Array) -> str:
    """That rows hold each other's points, by their names or lines."""
    return (
        f"{data.source}: rows hold each other's points: {data.list_rows(rows)}; put their joint "
        "values and points right, or delete them"
    )


def impossible(
    robot: Robot,
    options: Options,
    solved: Solved,
    data: Measurements,
    held: Array,
    before: Array,
    after: Array,
    swapped: Array,
    suspects: Sequence[Suspect],
) -> str:
    """Why this is no calibration of this arm; empty where it is one.

    held: (m,).  before, after: (k, m, 3) errors as drawn and as calibrated [m].  swapped: rows
    whose points belong to other rows.
    """
    active, links = solved.identification.active, 5 * robot.joints
    noise, train = least_noise(data, robot.repeatability), np.flatnonzero(~held)
    pulling = np.isin(swapped, train[(solved.robust.weights > MIN_TRUSTED_WEIGHT).any(axis=0)])
    if pulling.any():
        return said_of_exchanged(data, swapped)
    changed = ""
    if not options.allow_large_changes:
        changed = too_changed(robot, solved.state.mdh, active[:links])
    placed = float(active[links:].sum())
    return (
        contradiction(robot, data, after, held, suspects)
        or changed
        or computed(data, residual(before, placed), noise, "the drawn arm")
        or computed(data, residual(after, float(active.sum())), noise, "the calibrated arm")
    )


def compared(
    options: Options,
    solved: Solved,
    data: Measurements,
    unseen: tuple[Array, Array],
    suspects: Sequence[Suspect],
) -> Improvement | None:
    """Drawn and calibrated arm on poses that neither has seen; None where there are none, or where
    the calibrated arm is the drawn one.

    unseen: (k, m, 3) errors of both, NaN at poses that were seen [m].
    """  # fmt: skip
    fixed = not solved.identification.active[: solved.state.mdh.size].any()
    if (fixed and not solved.effects.terms) or not np.isfinite(unseen[1]).any():
        return None
    if (target := objective_of(options.objective, data)) >= 0:  # the other targets follow
        unseen = hidden(*unseen, np.arange(len(data.target_names))[:, None] != target)
    return improvement(*unseen, grouped(data, options.holdout_by), data, suspects)


def hidden(drawn: Array, calibrated: Array, which: Array) -> tuple[Array, Array]:
    """Errors (k, m, 3) of two arms without some points.  which: (k, m), or what broadcasts."""
    gone = np.broadcast_to(which, drawn.shape[:2])[..., None]
    return np.where(gone, np.nan, drawn), np.where(gone, np.nan, calibrated)
