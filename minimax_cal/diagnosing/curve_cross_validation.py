"""Free curves of joints beside a fit, judged by groups of its poses that are left out in turn.

A block of free functions has a Gaussian prior [Rasmussen and Williams 2006], so that it is a ridge
regression.  Its length and size are those that meet the groups left out best: what is fitted judges
nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import scipy
from scipy.linalg import cho_factor, cho_solve

from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.budget_steps import assign_folds
from minimax_cal.diagnosing.joint_fit import GeometryEffectFit
from minimax_cal.measuring.pose_groups import cluster_poses
from minimax_cal.modelling.effects.joint_error_maps import (
    map_range_of_angles,
    sine_basis,
    sine_count_over_span,
    sine_factor_sigmas,
)
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.error_rows import MIN_ESTIMATED_POINT_NOISE
from minimax_cal.selection.thresholds import (
    BUDGET_FOLD_COUNT,
    FAR_POSE_ERROR_RATIO,
    MIN_CURVE_SWEEP_DEG,
)

MIN_TESTED_GROUPS = 10  # groups that can say anything
CURVE_LENGTHS_RAD = np.radians([4.0, 8.0, 20.0, 60.0]).tolist()  # of a joint's curve [rad]
CURVE_PRIOR_SHAPES = list(
    product((5e-5, 2e-4, 8e-4), CURVE_LENGTHS_RAD)
)  # its size, beside what is left, and length
RELATIVE_PARAMETER_RIDGE = (
    1e-10  # of a parameter's own weight: what poses do not tell stays where it is
)


@dataclass(frozen=True, eq=False)
class LinearResidual:
    """What a fit leaves at its poses, linear there.

    errors: (m, r) errors, columns: (m, r, p) their derivatives by what was fitted, joint_motions:
    (m, r, n) motion of the points by the joints, weight_roots: (m, r) root of each weight [m, rad].
    prior_weights: (p,) weights that hold what was fitted near 0, of which y has then what it took
    away.  joint_values: (m, n) joints, of a slide its place in the arm's reach [rad].  pose_groups:
    (m,).  fold_masks: (f, m) masks, left out in turn.
    """

    errors: Array
    columns: Array
    joint_motions: Array
    weight_roots: Array
    prior_weights: Array
    joint_values: Array
    pose_groups: Array
    fold_masks: Array

    @staticmethod
    def from_fit(last: GeometryEffectFit) -> LinearResidual:
        """At the end of a fit, with the parts that it can do without."""
        scene, poses, data = last.study.scene, last.pose_linearisation, last.study.data
        part, unit = assign_folds(data, BUDGET_FOLD_COUNT), joint_unit_sizes(scene)
        parts = np.array(
            last.select_dispensable_folds([part == number for number in range(BUDGET_FOLD_COUNT)])
        )
        held = np.where(poses.prior > 0.0, poses.prior_deviation, 0.0)
        return LinearResidual(
            errors=poses.error - poses.jacobian @ held,
            columns=poses.jacobian,
            joint_motions=poses.joint_motion @ scene.joint_motion_per_drive * unit,
            weight_roots=np.repeat(np.sqrt(last.model.weight), 3, axis=0).T,
            prior_weights=poses.prior,
            joint_values=(scene.q / unit[:, None]).T,
            pose_groups=cluster_poses(data),
            fold_masks=parts.reshape(-1, data.poses),
        )

    def select_poses(self, pose_mask: Array) -> LinearResidual:
        """Some of the poses.  pose_mask: mask (m,)."""
        parts = self.fold_masks[:, pose_mask]
        names = (
            "errors",
            "columns",
            "joint_motions",
            "weight_roots",
            "joint_values",
            "pose_groups",
        )
        some: dict[str, Any] = {name: getattr(self, name)[pose_mask] for name in names}
        return replace(self, **some, fold_masks=parts[parts.any(axis=1)])

    @property
    def group_count(self) -> int:
        """How many stand apart."""
        return len(np.unique(self.pose_groups))


def joint_unit_sizes(scene: PosedArm) -> Array:
    """(n,) what counts as a radian of each joint: of a slide the arm's reach [m]."""
    return np.where(scene.robot.prismatic, scene.robot.reach(), 1.0)


def cross_validate_residual(residual: LinearResidual) -> CrossValidatedFit:
    """The fit as it is."""
    return CrossValidatedFit.cross_validate(
        residual.fold_masks, residual.errors, residual.columns, residual.prior_weights
    )


def heldout_gain_p_value(
    before: CrossValidatedFit, after: CrossValidatedFit, pose_groups: Array
) -> float:
    """Chance that groups of poses left out gain so much by what tells nothing.  pose_groups: (m,).

    By the sum of their gains, or by their ranks, which a few poses far from all others do not sway.
    """
    names = np.unique(pose_groups, return_inverse=True)[1].reshape(-1)
    gains = np.bincount(names, (before.error**2 - after.error**2).sum(axis=1))
    if len(gains) < MIN_TESTED_GROUPS or not gains.sum() > 0.0:
        return 1.0
    mean = scipy.stats.ttest_1samp(gains, 0.0, alternative="greater").pvalue
    ranks = scipy.stats.wilcoxon(gains, alternative="greater").pvalue
    return min(2.0 * float(min(mean, ranks)), 1.0)


# ---- free functions ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class CurveColumns:
    """Free functions at a place.

    columns: (m, r, c) motion of the points per unit of each.  prior_sigmas: (h, c) their standard
    deviations, of which one row is chosen.
    """

    place: str
    columns: Array
    prior_sigmas: Array


def build_joint_curves(residual: LinearResidual) -> Iterator[CurveColumns]:
    """A turn of each joint that is smooth in its own angle; of a slide, in its place."""
    for j, q in enumerate(residual.joint_values.T):
        if np.ptp(q) < np.radians(MIN_CURVE_SWEEP_DEG):
            continue
        low, high = map_range_of_angles(q)
        count = max(min(sine_count_over_span(high - low), residual.group_count // 2), 1)
        columns = residual.joint_motions[:, :, j, None] * sine_basis(q, low, high, count).T[:, None]
        priors = [
            size * sine_factor_sigmas(length, high - low, count)
            for size, length in CURVE_PRIOR_SHAPES
        ]
        yield CurveColumns(f"J{j + 1}", columns, np.array(priors))


# ---- fits without each part of the poses -------------------------------------------------------


@dataclass(frozen=True, eq=False)
class CrossValidatedFit:
    """A fit of some columns, and what it predicts of each part of the poses without that part.

    fold_masks: (f, m) masks of the poses left out, each pose in one at most.  fitted_errors: (m, r)
    what is fitted. columns: (m, r, p), with weights `ridge` (p,) of a prior of mean 0.  error: (m,
    r) what is left of each pose without its part.  selected_prior: which prior of the last block.
    """

    fold_masks: Array
    fitted_errors: Array
    columns: Array
    ridge: Array
    error: Array
    selected_prior: int = 0

    @staticmethod
    def cross_validate(parts: Array, y: Array, columns: Array, prior: Array) -> CrossValidatedFit:
        """Columns that are fitted freely, but for weights (p,) that hold them near 0."""
        size = np.linalg.norm(columns.reshape(-1, columns.shape[-1]), axis=0)
        size = np.where(size > 0.0, size, 1.0)  # of what no pose shows 0 is left
        bare = CrossValidatedFit(
            parts, y, columns / size, RELATIVE_PARAMETER_RIDGE + prior / size**2, y
        )
        column = y[..., None]
        return replace(
            bare,
            error=bare.subtract_fold_predictions(column, bare.solve_without_folds(column)[0])[
                ..., 0
            ],
        )

    @property
    def heldout_variance(self) -> float:
        """Of a coordinate that is left out [m^2]."""
        return max(self.heldout_square / self.fitted_errors.size, MIN_ESTIMATED_POINT_NOISE**2)

    @cached_property
    def parameter_values(self) -> Array:
        """(p,) with all poses."""
        gram = multiply_pose_columns(self.columns, self.columns) + np.diag(self.ridge)
        pull = multiply_pose_columns(self.columns, self.fitted_errors[..., None])
        return np.asarray(np.linalg.solve(gram, pull)[:, 0])

    @property
    def usual_poses(self) -> Array:
        """(m,) True for poses that some fit does without, and that do not stand far out."""
        judged, size = self.fold_masks.any(axis=0), (self.error**2).sum(axis=1)
        return np.asarray(judged & (size <= FAR_POSE_ERROR_RATIO**2 * np.median(size[judged])))

    @property
    def heldout_square(self) -> float:
        """Sum of squares at the poses left out [m^2]."""
        return float((self.error**2).sum())

    @cached_property
    def fold_cholesky_factors(self) -> list[tuple[Array, bool]]:
        """(f,) of products of the columns at all poses but a part's, and the ridge."""
        grams = self.products_without_folds(self.columns, self.columns) + np.diag(self.ridge)
        return [cho_factor(gram, check_finite=False) for gram in grams]

    def products_without_folds(self, left_columns: Array, right_columns: Array) -> Array:
        """(f, c, d) products of columns (m, r, c) and (m, r, d) at all poses but a part's."""
        own = np.array(
            [
                multiply_pose_columns(left_columns[part], right_columns[part])
                for part in self.fold_masks
            ]
        )
        never = ~self.fold_masks.any(axis=0)
        return np.asarray(
            own.sum(axis=0) + multiply_pose_columns(left_columns[never], right_columns[never]) - own
        )

    def solve_without_folds(self, columns: Array) -> tuple[Array, Array]:
        """Values (f, p, c) of this fit's columns for others (m, r, c), without each part.

        And the products (f, p, c) of its own with them.
        """
        cross = self.products_without_folds(self.columns, columns)
        pairs = zip(self.fold_cholesky_factors, cross, strict=True)
        return np.array([cho_solve(one, pull, check_finite=False) for one, pull in pairs]), cross

    def subtract_fold_predictions(self, columns: Array, values: Array) -> Array:
        """What values of this fit, as `solve_without_folds`, leave of columns (m, r, c), each by
        its part's.
        """
        out = np.zeros_like(columns)
        for part, value in zip(self.fold_masks, values, strict=True):
            out[part] = columns[part] - self.columns[part] @ value
        return out

    def with_curve(self, curve: CurveColumns) -> CrossValidatedFit:
        """The fit with a block besides, by that prior of it which meets the parts best."""
        both = np.concatenate([curve.columns, self.fitted_errors[..., None]], axis=-1)
        values, cross = self.solve_without_folds(both)
        clear = self.subtract_fold_predictions(both, values)
        left = (self.products_without_folds(both, both) - np.swapaxes(cross, 1, 2) @ values)[
            :, None
        ]
        ridge = self.heldout_variance / curve.prior_sigmas**2
        eye = np.eye(ridge.shape[1])
        value = np.linalg.solve(left[..., :-1, :-1] + ridge[:, :, None] * eye, left[..., :-1, -1:])
        error = np.zeros((len(ridge), *self.fitted_errors.shape))
        for part, one in zip(self.fold_masks, value[..., 0], strict=True):
            free, rest = clear[part, :, :-1], clear[part, :, -1]
            told = one @ free.reshape(-1, len(eye)).T
            error[:, part] = rest - told.reshape(len(ridge), *rest.shape)
        best = int(np.argmin((error**2).sum(axis=(1, 2))))
        columns = np.concatenate([self.columns, curve.columns], axis=-1)
        ridge = np.append(self.ridge, ridge[best])
        return CrossValidatedFit(
            self.fold_masks, self.fitted_errors, columns, ridge, error[best], best
        )


def multiply_pose_columns(left_columns: Array, right_columns: Array) -> Array:
    """(c, d) products of columns (m, r, c) and (m, r, d)."""
    return np.asarray(
        left_columns.reshape(-1, left_columns.shape[-1]).T
        @ right_columns.reshape(-1, right_columns.shape[-1])
    )
