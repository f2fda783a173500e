"""How much each joint scatters, and the instrument along its line of sight and across it.

Effects are sought with two noises, of the instrument and of all joints alike.  Where joints scatter
unlike each other, or range and angles of a tracker do, the sizes are estimated by restricted
maximum likelihood [Patterson and Thompson 1971] from what geometry and effects leave, and the rows
are weighed by them: motions of joints and of the points, so scaled that one noise stands for all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.study import LinearisedGeometry
from minimax_cal.fitting.outliers import PointScores, StudentSpread, estimate_spread
from minimax_cal.measuring.faults.data_fault import DataFault, measure_target_distances
from minimax_cal.measuring.faults.point_faults import far_off
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import rows_in_visit_order
from minimax_cal.modelling.error_rows import linearise_to_point_rows
from minimax_cal.robots.kinematics import cross
from minimax_cal.selection.noise_model import estimate_noise_by_reml, orthonormal_basis
from minimax_cal.selection.thresholds import (
    CERTAIN_P_VALUE,
    GAUSSIAN_OUTLIER_MEDIAN_RATIO,
    HEAVY_TAIL_DEGREES_OF_FREEDOM,
    MIN_SELECTION_DEGREES_OF_FREEDOM,
)

MIN_NOISE_SIGMA = 1e-7  # standard deviation that is none [m, rad]
MIN_ISOTROPIC_VARIANCE_FRACTION = (
    0.05  # least part of the instrument's variance that all directions have
)
MAX_LOG_VARIANCE_CHANGE = 9.0  # of a logarithm of a variance, on both sides of where it starts


def reweight_by_noise_components(
    study: LinearisedGeometry, effect_columns: Array, *, separate_joints: bool = True
) -> LinearisedGeometry:
    """The study, its rows weighed by the noises that the data tell, or itself if those are alike.

    effect_columns: (N, q) columns of effects.  separate_joints: whether every joint may scatter by
    itself: not where structure is left, which would pass for scatter of its joint.
    """
    whole = np.asarray((study.rows.weight > 0.0).all(axis=1))
    dof = (
        int(whole.sum()) * study.rows.rows_per_pose
        - study.rows.nuisance_basis.shape[1]
        - effect_columns.shape[1]
    )
    noise = estimate_noise_by_reml(study.rows, effect_columns)
    if dof < MIN_SELECTION_DEGREES_OF_FREEDOM or noise.variance < study.rows.rounding_noise**2:
        return study
    joints, sight = joint_and_sight_motions(study)
    rest = FullyMeasuredPoses.from_study(study, effect_columns, whole)
    turned, (along, across) = rest.field_covariances(joints), rest.field_covariances(sight)
    size, alike = (noise.joint_jitter**2, noise.variance), turned.sum(axis=0)
    least, _ = rest.fit_variances([alike, along + across], np.array(size))
    parts = [*(turned if separate_joints else alike[None]), along, across]
    most, found = rest.fit_variances(parts, np.repeat(size, (len(parts) - 2, 2)))
    if scipy.stats.chi2.sf(least - most, len(parts) - 2) > CERTAIN_P_VALUE:
        return study
    scatter = np.broadcast_to(np.sqrt(found[:-2]), len(turned))
    return with_noise_weights(study, scatter, sight, found[-2:])


def joint_and_sight_motions(study: LinearisedGeometry) -> tuple[list[Array], list[Array]]:
    """Fields (d, k, 3, m) by which each joint moves the points; along and across the sight."""
    scene, k = study.scene, study.scene.targets
    seen = scene.points - scene.instruments
    along = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    helper = np.zeros_like(along)
    helper[:, 2] = 1.0
    side = cross(along, helper)
    side = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    own = np.eye(k)[:, :, None, None]  # each point errs by itself
    root = np.where(study.model.weight > 0.0, np.sqrt(study.model.weight), 1.0)[None, :, None]
    parts = [own * part / root for part in (along, side, cross(along, side))]
    return list(scene.jacobian[:, None]), [parts[0], np.concatenate(parts[1:])]


def with_noise_weights(
    study: LinearisedGeometry,
    joint_sigmas: Array,
    sight_motions: Sequence[Array],
    sight_variances: Array,
) -> LinearisedGeometry:
    """The study, its rows weighed by given noises.

    joint_sigmas: (n,) standard deviations.  sight_motions: motions along and across it, as
    `joint_and_sight_motions`; sight_variances: (2,) the variance of a coordinate of each [m^2].
    """
    along, across = sight_variances
    usual = max(float(np.sqrt(np.mean(joint_sigmas**2))), MIN_NOISE_SIGMA)
    mean = (along + 2.0 * across) / 3.0
    both = max(min(along, across), MIN_ISOTROPIC_VARIANCE_FRACTION * mean)
    more = sight_motions[0] if along > across else sight_motions[1]
    parts = np.concatenate([
        study.scene.jacobian * (joint_sigmas / usual)[:, None, None, None],
        more * np.sqrt(max(along, across) - both) / usual,
    ])  # fmt: skip
    rows = linearise_to_point_rows(study.model, study.fit.state, parts)
    return replace(
        study, rows=rows.with_pose_numbers(study.rows.pose_numbers), variance_anisotropy=mean / both
    )


@dataclass(frozen=True, eq=False)
class FullyMeasuredPoses:
    """Poses at which every point was measured.

    study: whose rows they are.  pose_mask: (m,) which poses.  errors: (w, r).  fitted_columns: (w,
    r, p).
    """

    study: LinearisedGeometry
    pose_mask: Array
    errors: Array
    fitted_columns: Array

    @staticmethod
    def from_study(
        study: LinearisedGeometry, effect_columns: Array, pose_mask: Array
    ) -> FullyMeasuredPoses:
        """The rows of some poses, with geometry and known columns (N, q) to be fitted."""
        m, r = study.rows.weight.shape
        columns = orthonormal_basis(
            np.concatenate([study.rows.nuisance_basis, effect_columns], axis=1)
        )
        y = study.rows.error.reshape(m, r)[pose_mask]
        return FullyMeasuredPoses(study, pose_mask, y, columns.reshape(m, r, -1)[pose_mask])

    def field_covariances(self, fields: Sequence[Array]) -> Array:
        """(g, w, r, r) covariance that fields (d, k, 3, m) of unit variance give."""
        m, r = self.study.rows.weight.shape
        out = []
        for field in fields:
            part = self.study.rows.rows_from_fields(field).reshape(m, r, -1)[self.pose_mask]
            out.append(part @ np.swapaxes(part, 1, 2))
        return np.array(out)

    def fit_variances(
        self, covariances: Sequence[Array], start_variances: Array
    ) -> tuple[float, Array]:
        """-2 log restricted likelihood at its least, and the variance (g,) of each part.

        start_variances: (g,) variances near by.
        """
        begin = np.log(np.maximum(start_variances, MIN_NOISE_SIGMA**2))
        whole = np.array(covariances)
        room = [(x - MAX_LOG_VARIANCE_CHANGE, x + MAX_LOG_VARIANCE_CHANGE) for x in begin]
        found = scipy.optimize.minimize(
            self.restricted_deviance_and_gradient,
            begin,
            (whole,),
            jac=True,
            method="L-BFGS-B",
            bounds=room,
        )
        return float(found.fun), np.asarray(np.exp(found.x))

    def restricted_deviance_and_gradient(
        self, log_variances: Array, covariances: Array
    ) -> tuple[float, Array]:
        """-2 log restricted likelihood and its gradient by the logarithms of the variances (g,)."""
        v = np.exp(log_variances)
        covariance = np.tensordot(v, covariances, 1)
        inverse = np.linalg.inv(covariance)
        pressed = inverse @ self.fitted_columns
        gram = np.einsum("mrp,mrq->pq", self.fitted_columns, pressed, optimize=True)
        gram += 1e-11 * np.trace(gram) / max(len(gram), 1) * np.eye(len(gram))
        factor = np.linalg.cholesky(gram)
        pull = np.einsum("mrp,mr->p", pressed, self.errors)
        value = np.linalg.solve(gram, pull)
        rest = (inverse @ self.errors[..., None])[..., 0] - pressed @ value
        taken = np.linalg.solve(factor, pressed.reshape(-1, len(gram)).T).T.reshape(pressed.shape)
        spread = inverse - taken @ np.swapaxes(taken, 1, 2) - rest[:, :, None] * rest[:, None]
        cost = np.linalg.slogdet(covariance)[1].sum() + 2.0 * np.log(np.diag(factor)).sum()
        slope = v * np.einsum("gmrs,mrs->g", covariances, spread, optimize=True)
        return float(cost + np.sum(self.errors * rest)), np.asarray(slope)


# ---- tails ---------------------------------------------------------------------------------------


def find_rows_beyond_tails(data: Measurements, error: Array) -> Array:
    """(m,) True where a point is farther off than the tails of all others allow.

    Judged by the errors of a fit, and by the distances between targets, each against Student's t
    with as heavy tails as the other points show.  Where the errors' tails are heavy no point is
    wrong for being far off.  error: (m, k, 3) of all points [m].
    """
    out = np.zeros(data.poses, dtype=bool)
    spread, far = fit_tails_and_find_outliers(np.linalg.norm(error, axis=-1), 3)
    if spread.dof <= HEAVY_TAIL_DEGREES_OF_FREEDOM:
        return out
    off = np.abs(measure_target_distances(data).off.T)
    return np.asarray(far | fit_tails_and_find_outliers(off, 1)[1] if off.size else far)


def find_points_of_pulled_fit(
    error: Array, compute_robust_errors: Callable[[], Array], data: Measurements
) -> tuple[DataFault, ...]:
    """Points that are wrong where so many are that they pull the fit.

    error: (m, k, 3) of a plain fit [m].  compute_robust_errors: that of one which wrong points do
    not pull, asked where an error is larger than those of Gaussian noise are.  Its heavy tails are
    no wrong points, nor are poses that were visited one after the other.
    """
    size = np.linalg.norm(error, axis=-1)
    if not np.nanmax(size, initial=0.0) > GAUSSIAN_OUTLIER_MEDIAN_RATIO * np.nanmedian(size):
        return ()
    robust = compute_robust_errors()
    spread, far = fit_tails_and_find_outliers(np.linalg.norm(robust, axis=-1), 3)
    runs = int((np.diff(far[rows_in_visit_order(data)].astype(int), prepend=0) == 1).sum())
    is_scattered = 2 * runs > int(far.sum())  # most are single ones among the visits
    return (
        far_off(data, robust, far)
        if spread.dof > HEAVY_TAIL_DEGREES_OF_FREEDOM and is_scattered
        else ()
    )


def fit_tails_and_find_outliers(
    error_sizes: Array, direction_count: int
) -> tuple[StudentSpread, Array]:
    """How sizes (m, s) scatter, and (m,) True where one stands out.  NaN is unknown."""
    seen = np.isfinite(error_sizes)
    scores = PointScores(np.where(seen, error_sizes, 0.0) ** 2, direction_count * seen)
    spread = estimate_spread(scores, float(direction_count * seen.sum()))
    return spread, np.asarray(spread.is_outlier(scores).any(axis=1))
