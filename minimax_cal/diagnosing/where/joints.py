"""Errors as turns of the joints."""

from __future__ import annotations

import math

import numpy as np

from minimax_cal.diagnosing.where.features import WAVES, waves
from minimax_cal.diagnosing.where.gaps import JointGap
from minimax_cal.diagnosing.where.residual import Residual
from minimax_cal.diagnosing.where.rows import blocks, joint_rows
from minimax_cal.diagnosing.where.significance import explained
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.measuring.measurements import Measurements


def joint_equivalent(error: Array, jacobian: Array, noise: float) -> Array:
    """Turns of the joints that would make the errors of each pose: (m, n) [rad, m].

    Ridge least squares, min |e - S dq|^2 + lambda |dq|^2 with lambda = noise^2 / turn^2, where turn
    is the RMS turn that would make all of the error if every joint had its part.  Without ridge a
    wrist in line, or a single target, would ask for endless turns.  Arguments as `where`.
    """
    rows, seen = blocks(error)
    motion = joint_rows(jacobian, seen)
    gram = np.swapaxes(motion, 1, 2) @ motion
    size = np.trace(gram, axis1=1, axis2=2).mean()
    square = (rows**2).sum(1).mean()
    if not (size > 0.0 and square > 0.0):
        return np.zeros((len(rows), len(jacobian)))
    floor = max(noise**2 if math.isfinite(noise) else 0.0, 1e-4 * square / seen.sum(1).mean())
    ridge = floor * size / square
    gradient = (np.swapaxes(motion, 1, 2) @ rows[..., None])[..., 0]
    return np.asarray(
        np.linalg.solve(gram + ridge * np.eye(len(jacobian)), gradient[..., None])[..., 0]
    )


def by_joint(
    data: Measurements, rest: Residual, motion: Array, turn: Array
) -> tuple[JointGap, ...]:
    """One `JointGap` a joint.  motion: (m, 3k, n) as `joint_rows`.  turn: (m, n)."""
    wave = np.stack([waves(column, WAVES, start=0) for column in data.q.T])  # (n, m, w)
    tall = np.einsum("mrj,jmw->mrjw", motion, wave)
    tall = rest.without_fit(tall.reshape(*motion.shape[:2], -1)).reshape(tall.shape)
    gaps = []
    for j in range(motion.shape[2]):
        size = float((motion[:, :, j] ** 2).sum())
        share, p = explained(rest, tall[:, :, j], size)
        sliding = bool(data.sliding[j])
        gaps.append(JointGap(f"J{j + 1}", sliding, rms(turn[:, j]), share, p))
    return tuple(gaps)
