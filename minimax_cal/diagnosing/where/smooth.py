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
RANK = 24  # features of the kernel over the joints


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


def circles(data: Measurements) -> Array:
    """Joint values as points whose distance a kernel may use: (m, n, 2), a turn is a circle."""
    spread = np.maximum(data.q.std(axis=0), 1e-12)
    slide = np.stack([data.q / spread, np.zeros_like(data.q)], axis=-1)
    turn = np.stack([np.cos(data.q), np.sin(data.q)], axis=-1)
    return np.where(data.sliding[:, None], slide, turn)


def smooth_rows(data: Measurements, motion: Array) -> Array:
    """Features (m, 3k, r) that span smooth motions of the joints, for `structure_by_pose`.

    Every joint moves by a random function of its own value and by one of all values, of equal
    energy; joints weigh alike, wrist or shoulder.  motion: (m, 3k, n) as `joint_rows`.
    """
    even = motion / np.maximum(np.sqrt((motion**2).mean(axis=(0, 1))), 1e-12)
    fade = 1.0 / np.arange(1, WAVES + 1)
    wave = np.stack([waves(column, WAVES - 1, start=0) * fade for column in data.q.T])
    own = np.einsum("mrj,jmw->mrjw", even, wave).reshape(*motion.shape[:2], -1)
    shared = products(even, factors(circles(data), RANK, width=2.0))
    parts = [part / max(float(np.sqrt((part**2).sum())), 1e-300) for part in (own, shared)]
    return np.concatenate(parts, axis=2)


def levelled(features: Array) -> Array:
    """F (..., r) with the kernel FF' replaced by its square root: weaker directions count more.

    Apply it after the fit was taken out.  A smooth kernel otherwise looks at its first few
    directions only; most of those the geometric fit has taken.
    """
    flat = features.reshape(-1, features.shape[-1])
    value, vector = np.linalg.eigh(flat.T @ flat)
    kept = value > 1e-6 * max(float(value[-1]), 1e-300)
    turned = flat @ (vector[:, kept] * value[kept] ** -0.25)
    return np.asarray(turned.reshape(*features.shape[:-1], -1))


def factors(coordinates: Array, rank: int, width: float = 1.0) -> Array:
    """F (m, <= rank) with F F' nearly a kernel K over the poses.

    K(a, b) = mean_i exp(-|a_i - b_i|^2 / 2 w^2) + exp(-mean_i |a_i - b_i|^2 / w^2), for functions
    of one coordinate each and of all together.  coordinates: (m, c, d), c of d numbers each, or
    (m, c), in units in which `width` is a small step.  Pivoted Cholesky: Nystroem at the poses that
    tell most [Harbrecht, Peters & Schneider 2012].
    """
    x = coordinates[..., None] if coordinates.ndim == 2 else coordinates
    left, columns = np.full(len(x), 2.0), np.zeros((min(rank, len(x)), len(x)))
    for i in range(len(columns)):
        pivot = int(np.argmax(left))
        if left[pivot] < 1e-6:
            return columns[:i].T
        off = ((x - x[pivot]) ** 2).sum(-1) / width**2
        column = np.exp(-0.5 * off).mean(-1) + np.exp(-off.mean(-1))
        column -= columns[:i, pivot] @ columns[:i]
        columns[i] = column / math.sqrt(left[pivot])
        left = np.maximum(left - columns[i] ** 2, 0.0)
        left[pivot] = 0.0
    return columns.T


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
