"""Whether a calibrated arm is better than the drawn one on poses that neither has seen.

Both are judged on the same poses by the same rule: base, targets and frames of the drawn arm are
fitted to the same training poses as the calibrated arm is.  The comparison is paired, pose by pose,
so that what both miss alike, as noise, does not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.fitting.accuracy import summarise_point_errors
from minimax_cal.fitting.outliers import MIN_POINTS_LEFT, Outlier, mask_outliers
from minimax_cal.measuring.measurements import Measurements

# A point that both arms miss by so many times what lies between them there does not say which of
# them is right; a point that only the calibrated arm misses does, and counts.
MIN_COMMON_ERROR_RATIO = 2.0

MAX_NAMED_COMMON_ERRORS = 5  # points that a reason names


@dataclass(frozen=True)
class ArmComparison:
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
    def comparison_text(self) -> str:
        """Calibrated against drawn, for people."""
        return f"{self.after:#.3g} against {self.before:#.3g} mm"


def compare_paired_errors(
    nominal_errors: Array, calibrated_errors: Array, pose_groups: Array
) -> ArmComparison:
    """The paired comparison of errors (m, k, 3) at the points that both have [m].

    pose_groups: (m,) poses with one number belong together and count once.
    """
    both = np.isfinite(nominal_errors[..., 0]) & np.isfinite(calibrated_errors[..., 0])
    each = [
        np.where(both, 1e6 * (error**2).sum(axis=-1), 0.0)
        for error in (nominal_errors, calibrated_errors)
    ]
    names, member = np.unique(pose_groups, return_inverse=True)
    parts = (both, each[0] - each[1])
    count, lower = (np.bincount(member, part.sum(axis=1), len(names)) for part in parts)
    lower, count = lower[count > 0.0], count[count > 0.0]
    points, poses = count.sum(), len(count)
    before, after = (float(np.sqrt(square.sum() / points)) if poses else np.nan for square in each)
    if poses < 2:
        return ArmComparison(before, after, np.nan, np.nan)
    gain = float(lower.sum() / points)
    off = lower - gain * count  # of a ratio of sums, to first order
    error = float(np.sqrt((off**2).sum() * poses / (poses - 1.0)) / points)
    return ArmComparison(before, after, gain, error)


def compare_with_nominal(
    nominal_errors: Array,
    calibrated_errors: Array,
    pose_groups: Array,
    data: Measurements,
    suspects: Sequence[Outlier],
) -> ArmComparison:
    """The comparison of all points; without wrong points where these alone hide what is better.

    nominal_errors, calibrated_errors: (m, k, 3) errors [m], NaN where not judged.  pose_groups:
    (m,).  suspects: points that stand out from the calibrated arm.
    """
    whole = compare_paired_errors(nominal_errors, calibrated_errors, pose_groups)
    if whole.is_better:
        return whole
    between = np.linalg.norm(nominal_errors - calibrated_errors, axis=-1)
    alike = np.linalg.norm(calibrated_errors, axis=-1) > MIN_COMMON_ERROR_RATIO * between
    wrong = alike & np.isnan(mask_outliers(calibrated_errors, data, suspects)[..., 0])
    judged = np.isfinite(calibrated_errors[..., 0])
    if not (wrong & judged).any() or (judged & ~wrong).sum() < MIN_POINTS_LEFT * judged.sum():
        return whole
    less = compare_paired_errors(
        *mask_points(nominal_errors, calibrated_errors, wrong), pose_groups
    )
    named = list_points(data, wrong & judged, calibrated_errors)
    return replace(less, wrong=named) if less.is_better else whole


def list_points(data: Measurements, is_chosen: Array, point_errors: Array) -> str:
    """Points in words, target by target.  is_chosen: (m, k).  point_errors: (m, k, 3) [m]."""
    size = 1e3 * np.linalg.norm(point_errors, axis=-1)
    shown = [
        f"{data.called(data.line[pose])} {data.target_names[target]} {size[pose, target]:.3g} mm"
        for target, pose in np.argwhere(is_chosen.T).tolist()
    ]
    return format_first_names(shown, MAX_NAMED_COMMON_ERRORS)


def compare_files_with_nominal(
    nominal_errors: Sequence[Array],
    calibrated_errors: Sequence[Array],
    pose_groups: Sequence[Array],
    noises: Sequence[float],
) -> ArmComparison | None:
    """The comparison of all rows of several files; None where no row judges.

    nominal_errors, calibrated_errors: (m, k, 3) of each file [m].  pose_groups: (m,) of each.
    noises: of each, by which its rows count beside those of the others [m].
    """
    unit, first, every, pairs = min(noises), 0, [], []
    for before, after, group, noise in zip(
        nominal_errors, calibrated_errors, pose_groups, noises, strict=True
    ):
        for part in range(before.shape[1]):
            pairs.append(unit / noise * np.stack([before[:, part], after[:, part]]))
            every.append(first + group)
        first += int(group.max(initial=-1)) + 1
    both = np.concatenate(pairs, axis=1)[:, :, None]
    if not np.isfinite(both).any():
        return None
    return compare_paired_errors(both[0], both[1], np.concatenate(every))


def describe_no_improvement(comparison: ArmComparison) -> str:
    """The sentence for an arm that is no better than the drawn one, and what to do."""
    return (
        f"The calibrated arm is no better than the drawn one "
        f"({comparison.comparison_text} on new poses): keep "
        "the drawn arm, or calibrate again with more poses, joint values with all their digits "
        "and less noise"
    )


def warn_of_hidden_improvement(found: ArmComparison, drawn: Array, calibrated: Array) -> str:
    """Notice that wrong points hide what is better.  drawn, calibrated: (m, k, 3) errors [m]."""
    both = np.isfinite(drawn) & np.isfinite(calibrated)
    whole = [
        summarise_point_errors(np.where(both, one, np.nan)).rms_mm for one in (drawn, calibrated)
    ]
    return (
        f"points that the drawn and the calibrated arm both miss ({found.wrong}) hide the "
        f"improvement on new poses: {whole[0]:#.3g} -> {whole[1]:#.3g} mm with them, "
        f"{found.before:#.3g} -> {found.after:#.3g} mm without; correct or delete these rows"
    )


def mask_points(
    nominal_errors: Array, calibrated_errors: Array, is_masked: Array
) -> tuple[Array, Array]:
    """Errors (m, k, 3) of two arms without some points.  is_masked: (m, k), or what broadcasts."""
    gone = np.broadcast_to(is_masked, nominal_errors.shape[:2])[..., None]
    return np.where(gone, np.nan, nominal_errors), np.where(gone, np.nan, calibrated_errors)
