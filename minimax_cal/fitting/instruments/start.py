"""Anchors, target and ball without a guess, for the arm as drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minimax_cal.fitting.instruments.rows import (
    Closures,
    Instrument,
    Squares,
    Wires,
    arm_at,
    state_of,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.parameters import State
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import Chain
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import METHODS, Limits

ENOUGH = 60  # poses that tell one start from another
SCREENED = Limits(step=1e-6)  # tells one start from another; the best is refined
LINEAR_RANK = 1e-6  # relative singular value below which the linear start says nothing
SPREAD = (0.05, 0.2)  # where else the target may be, from the last frame, per metre of reach


def wire_start(robot: Robot, q: Array, wires: Wires, active: Array) -> State:
    """Anchors and target (and offsets, where active) that fit the arm as drawn best.

    q: (m, n).  With the last frame (R, o) known at every pose, |o + R t - A| = L - z squared is
    2 o.Rt - 2 o.A - 2 Rt.A + 2 L z + c = L^2 - |o|^2: linear in t, A, the nine products t A', z and
    c.  That start, and trilaterations from some places t, are refined; the best is kept.
    """
    free = active.copy()
    free[: 5 * robot.joints] = False
    with_offset = bool(free[wires.names.geometric + 3 * wires.length.shape[1] :].any())
    links = kinematics.chain(robot.mdh, wires.model.q, wires.model.prismatic)
    target = linear_target(links, wires.length, with_offset=with_offset)
    aside = np.concatenate([np.zeros((1, 3)), *(s * np.eye(3) for s in SPREAD), -0.1 * np.eye(3)])
    targets = np.concatenate([target[None], robot.reach() * aside])
    own = np.stack([trilaterated(links, wires.length, t, with_offset) for t in targets])
    count = len(targets)
    starts = State(
        np.repeat(robot.mdh[None], count, axis=0),
        np.repeat(np.eye(3)[None], count, axis=0),
        np.zeros((count, 3)),
        targets[:, None],
        own,
    )
    few = thinned(robot, q, wires)
    screened = least_squares.solve(
        Squares(few, free), starts, count, float(few.points), limits=SCREENED, trace=False
    )
    cost = np.where(np.isfinite(screened.cost), screened.cost, np.inf)
    return refined(wires, free, screened.x.take(np.array(int(cost.argmin()))))


def thinned(robot: Robot, q: Array, wires: Wires) -> Wires:
    """The wires at some of the poses, the same number for each wire as far as there are."""
    chosen = np.zeros(len(q), dtype=bool)
    for lengths in wires.length.T:
        seen = np.flatnonzero(np.isfinite(lengths))
        chosen[seen[np.linspace(0, len(seen) - 1, min(len(seen), ENOUGH)).astype(int)]] = True
    return replace(wires, model=arm_at(robot, q[chosen]), length=wires.length[chosen])


def refined(instrument: Instrument, free: Array, start: State) -> State:
    """The best fit near a start over the free parameters."""
    problem, points = Squares(instrument, free), float(instrument.points)
    found = least_squares.solve(
        problem, start.batch(), 1, points, METHODS["snllm"], Limits(damping=1e-6)
    )
    return found.x.take(np.array(0))


def linear_target(links: Chain, length: Array, *, with_offset: bool) -> Array:
    """The target (3,) of the linear start [m].  length: (m, s), NaN where not measured."""
    s = length.shape[1]
    parts, rights = [], []
    for i in range(s):
        seen = np.isfinite(length[:, i])
        o, axes, long = links.origin[:, seen], links.axes[..., seen], length[seen, i]
        own = np.zeros((len(long), s, 14))
        own[:, i, :3] = -2.0 * o.T
        own[:, i, 3:12] = -2.0 * axes.reshape(9, -1).T
        own[:, i, 12] = 1.0
        own[:, i, 13] = 2.0 * long if with_offset else 0.0
        turned = 2.0 * np.einsum("kjm,jm->mk", axes, o)
        parts.append(np.concatenate([turned, own.reshape(len(long), -1)], axis=1))
        rights.append(long**2 - (o**2).sum(axis=0))
    return scaled_lstsq(np.concatenate(parts), np.concatenate(rights))[:3]


def trilaterated(links: Chain, length: Array, target: Array, with_offset: bool) -> Array:
    """Anchors and offsets (4s,) for a given target: 2 p.A - 2 L z - c = |p|^2 - L^2 [m]."""
    point = kinematics.points(links, target[None])[0]
    anchors, offsets = [], []
    for long in length.T:
        seen = np.isfinite(long)
        p, long = point[:, seen], long[seen]
        matrix = np.stack([*(2.0 * p), -np.ones(len(long)), -2.0 * long * with_offset], axis=1)
        found = scaled_lstsq(matrix, (p**2).sum(axis=0) - long**2)
        anchors.append(found[:3])
        offsets.append(found[4])
    return np.concatenate([*anchors, offsets])


def scaled_lstsq(matrix: Array, right: Array) -> Array:
    """Least squares with columns scaled to one; the least solution where poses do not tell."""
    norm = np.linalg.norm(matrix, axis=0)
    norm = np.where(norm > 0.0, norm, 1.0)
    return np.asarray(np.linalg.lstsq(matrix / norm, right, rcond=LINEAR_RANK)[0] / norm)


def ball_start(robot: Robot, closures: Closures) -> State:
    """The ball's place on the flange for the arm as drawn: linear, since sockets are eliminated."""
    free = np.zeros(closures.names.count, dtype=bool)
    free[-3:] = True
    problem = Squares(replace(closures, pairs=closures.pairs[:0]), free)
    start = state_of(robot.mdh, np.zeros(3), np.zeros(0))
    _, gradient, gram = problem.normal(start)
    values, vectors = np.linalg.eigh(gram)
    told = values > LINEAR_RANK**2 * max(float(values[-1]), 1e-30)
    ball = vectors[:, told] @ (vectors[:, told].T @ gradient / values[told])
    return problem.step(start, ball)
