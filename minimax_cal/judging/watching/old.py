"""The calibration's own poses: what its fit left there, linear where it ended."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.uncertainty import Poses
from minimax_cal.ground.arrays import Array
from minimax_cal.judging.watching.both import KNOWN, OLD, Both, Part, fit_variances
from minimax_cal.measuring.grouping import groups, regions
from minimax_cal.measuring.history import clock, is_timed
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.rows import by_pose

PLENTY = 500  # poses that tell what more would
SHARES = 0.5 ** np.arange(6)  # of the joints' noise, of which one is taken


@dataclass(frozen=True, eq=False)
class Old:
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

    def parts(self, whole: Array) -> Iterator[Part]:
        """Products of columns (m, r, q), region by region."""
        for one in np.unique(self.label):
            rows = whole[self.label == one].reshape(-1, whole.shape[2])
            count = int(np.count_nonzero(self.arm[self.label == one].any(axis=2)))
            yield Part(rows.T @ rows, count, OLD)


def own_poses(fit: Fit) -> Old | None:
    """A calibration's own poses; None where its file has none.

    Its noise of the joints was found as if nothing else was left, and holds what the model lacks.
    Beside that as such, it is as much less as is likeliest.
    """
    train = fit.train
    if not train.poses:
        return None
    few, rows = fit.estimator.thinned(groups(train), PLENTY)
    poses, some = Poses(few, fit.cell.state), train.take(rows)
    best, least, near = None, np.inf, np.zeros(0)
    for share in SHARES:
        old = old_at(fit, poses, some, share * fit.uncertainty.noise.jitter)
        found = fit_variances(alone(fit, old, near))
        near = found.factor
        if found.deviance + old.log_noise > least:
            break
        best, least = replace(old, factor=near), found.deviance + old.log_noise
        if not fit.uncertainty.noise.jitter:
            break
    return best


def old_at(fit: Fit, poses: Poses, some: Measurements, jitter: float) -> Old:
    """The same with a noise of the joints [rad]."""
    half = noise_root(poses, fit.uncertainty.noise.variance, jitter)
    error, every = poses.every
    white = np.linalg.solve(half, np.concatenate([error[..., None], every, poses.arm], axis=2))
    slope, model = white[..., 1 : 1 + every.shape[2]], poses.estimator.model
    kept = model.active & np.isin(model.names.all, fit.options.fix)
    active = model.active & ~kept
    root = np.where(kept[:, None], fit.uncertainty.root, 0.0)[:, : None if kept.any() else 0]
    return Old(
        names=tuple(name for name, free in zip(model.names.all, active, strict=True) if free),
        error=white[..., 0],
        jacobian=slope[..., active],
        links=slope[..., : 5 * fit.cell.robot.joints],
        arm=white[..., 1 + every.shape[2] :],
        q=model.q,
        label=regions(some),
        when=clock(some) if is_timed(some) else None,
        kept=kept,
        latent=-slope @ root,
        jitter=jitter,
        factor=np.ones(0),
        log_noise=2.0 * float(np.log(np.einsum("mrr->mr", half)).sum()),
    )


def alone(fit: Fit, old: Old, near: Array) -> Both:
    """A calibration's poses by themselves.  near: as in `Both`."""
    turned, kind = by_pose(fit.cell.robot, old.q, old.arm)
    f = old.jacobian.shape[2]
    whole = np.concatenate([old.jacobian, old.latent, turned, old.error[..., None]], axis=2)
    parts = tuple(old.parts(whole))
    component = np.append(np.full(old.latent.shape[2], KNOWN), kind[:, 0])
    nothing = np.zeros(0, dtype=int)
    return Both(parts, f, len(component), component, nothing, nothing > 0, near)


def noise_root(poses: Poses, variance: float, jitter: float) -> Array:
    """(m, r, r) root of each pose's noise: of the instrument [m^2], and of the joints [rad]."""
    r = poses.error.shape[1]
    noise = jitter**2 * poses.arm @ np.swapaxes(poses.arm, 1, 2) + variance * np.eye(r)
    return np.asarray(np.linalg.cholesky(noise))
