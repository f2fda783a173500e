"""Whether a calibrated arm is better than the drawn one on poses that neither has seen.

Both are judged on the same poses by the same rule: base, targets and frames of the drawn arm are
fitted to the same training poses as the calibrated arm is.  The comparison is paired, pose by pose,
so that what both miss alike, as noise, does not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.fitting.accuracy import accuracy
from minimax_cal.fitting.suspects import MIN_POINTS_LEFT, Suspect, aside
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.words import name_first
from minimax_cal.measuring.measurements import Measurements

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
    """The paired comparison of errors (m, k, 3) at the points that both have [m].

    group: (m,) poses with one number belong together and count once.
    """
    both = np.isfinite(drawn[..., 0]) & np.isfinite(calibrated[..., 0])
    each = [np.where(both, 1e6 * (error**2).sum(axis=-1), 0.0) for error in (drawn, calibrated)]
    names, member = np.unique(group, return_inverse=True)
    parts = (both, each[0] - each[1])
    count, lower = (np.bincount(member, part.sum(axis=1), len(names)) for part in parts)
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

    drawn, calibrated: (m, k, 3) errors [m], NaN where not judged.  group: (m,).  suspects: points
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
    """Points in words, target by target.  which: (m, k).  error: (m, k, 3) [m]."""
    size = 1e3 * np.linalg.norm(error, axis=-1)
    shown = [
        f"{data.called(data.line[pose])} {data.target_names[target]} {size[pose, target]:.3g} mm"
        for target, pose in np.argwhere(which.T).tolist()
    ]
    return name_first(shown, MAX_NAMED)


def improvement_of_files(
    drawn: Sequence[Array], calibrated: Sequence[Array], groups: Sequence[Array],
    noises: Sequence[float],
) -> Improvement | None:  # fmt: skip
    """The comparison of all rows of several files; None where no row judges.

    drawn, calibrated: (m, k, 3) of each file [m].  groups: (m,) of each.  noises: of each, by which
    its rows count beside those of the others [m].
    """
    unit, first, every, pairs = min(noises), 0, [], []
    for before, after, group, noise in zip(drawn, calibrated, groups, noises, strict=True):
        for part in range(before.shape[1]):
            pairs.append(unit / noise * np.stack([before[:, part], after[:, part]]))
            every.append(first + group)
        first += int(group.max(initial=-1)) + 1
    both = np.concatenate(pairs, axis=1)[:, :, None]
    if not np.isfinite(both).any():
        return None
    return compare_arms(both[0], both[1], np.concatenate(every))


def no_better(found: Improvement) -> str:
    """The sentence for an arm that is no better than the drawn one, and what to do."""
    return (
        f"The calibrated arm is no better than the drawn one ({found.numbers} on new poses): keep "
        "the drawn arm, or calibrate again with more poses, joint values with all their digits "
        "and less noise"
    )


def warn_of_hidden_improvement(found: Improvement, drawn: Array, calibrated: Array) -> str:
    """Notice that wrong points hide what is better.  drawn, calibrated: (m, k, 3) errors [m]."""
    both = np.isfinite(drawn) & np.isfinite(calibrated)
    whole = [accuracy(np.where(both, one, np.nan)).rms_mm for one in (drawn, calibrated)]
    return (
        f"points that the drawn and the calibrated arm both miss ({found.wrong}) hide the "
        f"improvement on new poses: {whole[0]:#.3g} -> {whole[1]:#.3g} mm with them, "
        f"{found.before:#.3g} -> {found.after:#.3g} mm without; correct or delete these rows"
    )


def hidden(drawn: Array, calibrated: Array, which: Array) -> tuple[Array, Array]:
    """Errors (m, k, 3) of two arms without some points.  which: (m, k), or what broadcasts."""
    gone = np.broadcast_to(which, drawn.shape[:2])[..., None]
    return np.where(gone, np.nan, drawn), np.where(gone, np.nan, calibrated)
