"""Smooth functions of joint values and time, and what they explain of the errors."""

from __future__ import annotations

import math

import numpy as np

from minimax_cal.diagnosing.where.answer import JointGap, Trend
from minimax_cal.diagnosing.where.residual import Residual, blocks, joint_rows
from minimax_cal.diagnosing.where.significance import explained
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.measuring.measurements import Measurements

WAVES = 6  # half-waves over the range of a joint that count as smooth


def scaled(x: Array) -> Array:
    """Values mapped to [0, 1]; NaN stays."""
    low, high = np.nanmin(x), np.nanmax(x)
    return np.asarray((x - low) / (high - low if high > low else 1.0))


def waves(x: Array, count: int, start: int) -> Array:
    """Half-waves cos(pi l u) of x mapped to u in [0, 1], l = start ... count: (m, ...)."""
    return np.asarray(np.cos(np.pi * np.arange(start, count + 1) * scaled(x)[:, None]))


def products(motion: Array, feature: Array) -> Array:
    """Every motion (m, 3k, n) times every feature of the pose (m, r): (m, 3k, n r)."""
    m, wide, _ = motion.shape
    return (motion[..., None] * feature[:, None, None, :]).reshape(m, wide, -1)


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


SLOW = 2  # half-waves over the session that count as a drift


def trend(rest: Residual, shared: Array, against: Array) -> Trend:
    """What slow changes of base frame and size with `against` (m,) explain; NaN rows left out."""
    known = np.isfinite(against)
    if known.sum() < 8 or np.ptp(against[known]) == 0.0:
        return Trend(math.nan, math.nan)
    slow = np.where(known[:, None], waves(against, SLOW, start=1), 0.0)
    share, p = explained(rest, rest.without_fit(products(shared, slow)), float((shared**2).sum()))
    return Trend(share, p)


def clock(data: Measurements) -> Array:
    """(m,) when each row was visited, in [0, 1]: by `clock`, time, order or the row's place."""
    for name in ("clock", "time", "order"):
        if name in data.columns and np.isfinite(data.columns[name]).any():
            return scaled(data.columns[name].astype(float))
    return scaled(np.arange(data.poses, dtype=float))
