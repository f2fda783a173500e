"""The calibration's own poses: what its fit left there, linear where it ended."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.uncertainty import PosewiseFit
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import cluster_joint_regions, group_repeated_poses
from minimax_cal.measuring.visit_history import has_session_time, session_clock_values
from minimax_cal.modelling.error_rows import lack_of_fit_motions_by_pose
from minimax_cal.validation.monitoring.session_pair import (
    KNOWN_COMPONENT,
    OLD,
    RowProducts,
    SessionPair,
    fit_variances_by_reml,
)

MAX_CALIBRATION_POSES = 500  # poses that tell what more would
JITTER_FRACTIONS = 0.5 ** np.arange(6)  # of the joints' noise, of which one is taken


@dataclass(frozen=True, eq=False)
class CalibrationPoses:
    """Rows of a calibration's training poses, in units of their noise.

    names: (f,) of what it fitted.  error: (m, r).  jacobian: (m, r, f) by what was fitted, and
    links: (m, r, 5n) by every link parameter.  arm: (m, r, n) by the joints.  q: (m, n) joint
    values with signs applied.  label: (m,) region.  when: (m,) place in the session, None where
    nothing tells it.  kept: (p,) True for parameters that are known and were fixed, as those of a
    calibration corrected after a check.  latent: (m, r, l) motion by what is not known of them,
    each of variance 1; (m, r, 0) where none are.  jitter: noise of the joints [rad].  log_noise:
    logarithm of the determinant of all noise.  factor: variances of what its model lacks.
    """

    names: tuple[str, ...]
    error: Array
    jacobian: Array
    links: Array
    arm: Array
    q: Array
    label: Array
    when: Array | None
    kept: Array
    latent: Array
    jitter: float
    log_noise: float
    factor: Array

    def row_products_by_region(self, whole: Array) -> Iterator[RowProducts]:
        """Products of columns (m, r, q), region by region."""
        for one in np.unique(self.label):
            rows = whole[self.label == one].reshape(-1, whole.shape[2])
            count = int(np.count_nonzero(self.arm[self.label == one].any(axis=2)))
            yield RowProducts(rows.T @ rows, count, OLD)


def build_calibration_poses(fit: Fit) -> CalibrationPoses | None:
    """A calibration's own poses; None where its file has none.

    Its noise of the joints was found as if nothing else was left, and holds what the model lacks.
    Beside that as such, it is as much less as is likeliest.
    """
    train = fit.train
    if not train.poses:
        return None
    few, rows = fit.estimator.thinned(group_repeated_poses(train), MAX_CALIBRATION_POSES)
    poses, some = PosewiseFit(few, fit.cell.parameter_values), train.take(rows)
    best, least, near = None, np.inf, np.zeros(0)
    for share in JITTER_FRACTIONS:
        old = whiten_calibration_poses(fit, poses, some, share * fit.uncertainty.noise.joint_jitter)
        found = fit_variances_by_reml(build_calibration_pair(fit, old, near))
        near = found.factor
        if found.deviance + old.log_noise > least:
            break
        best, least = replace(old, factor=near), found.deviance + old.log_noise
        if not fit.uncertainty.noise.joint_jitter:
            break
    return best


def whiten_calibration_poses(
    fit: Fit, poses: PosewiseFit, some: Measurements, jitter: float
) -> CalibrationPoses:
    """The same with a noise of the joints [rad]."""
    half = pose_noise_root(poses, fit.uncertainty.noise.variance, jitter)
    error, every = poses.errors_and_full_jacobian
    white = np.linalg.solve(
        half, np.concatenate([error[..., None], every, poses.joint_motion], axis=2)
    )
    slope, model = white[..., 1 : 1 + every.shape[2]], poses.estimator.model
    kept = model.active & np.isin(model.names.all_names, fit.options.fix)
    active = model.active & ~kept
    root = np.where(kept[:, None], fit.uncertainty.covariance_root, 0.0)[
        :, : None if kept.any() else 0
    ]
    return CalibrationPoses(
        names=tuple(name for name, free in zip(model.names.all_names, active, strict=True) if free),
        error=white[..., 0],
        jacobian=slope[..., active],
        links=slope[..., : 5 * fit.cell.robot.joints],
        arm=white[..., 1 + every.shape[2] :],
        q=model.q,
        label=cluster_joint_regions(some),
        when=session_clock_values(some) if has_session_time(some) else None,
        kept=kept,
        latent=-slope @ root,
        jitter=jitter,
        factor=np.ones(0),
        log_noise=2.0 * float(np.log(np.einsum("mrr->mr", half)).sum()),
    )


def build_calibration_pair(fit: Fit, old: CalibrationPoses, near: Array) -> SessionPair:
    """A calibration's poses by themselves.  near: as in `SessionPair`."""
    turned, kind = lack_of_fit_motions_by_pose(fit.cell.robot, old.q, old.arm)
    f = old.jacobian.shape[2]
    whole = np.concatenate([old.jacobian, old.latent, turned, old.error[..., None]], axis=2)
    parts = tuple(old.row_products_by_region(whole))
    component = np.append(np.full(old.latent.shape[2], KNOWN_COMPONENT), kind[:, 0])
    nothing = np.zeros(0, dtype=int)
    return SessionPair(parts, f, len(component), component, nothing, nothing > 0, near)


def pose_noise_root(poses: PosewiseFit, variance: float, jitter: float) -> Array:
    """(m, r, r) root of each pose's noise: of the instrument [m^2], and of the joints [rad]."""
    r = poses.error.shape[1]
    noise = jitter**2 * poses.joint_motion @ np.swapaxes(
        poses.joint_motion, 1, 2
    ) + variance * np.eye(r)
    return np.asarray(np.linalg.cholesky(noise))
