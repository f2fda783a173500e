"""How well positions over the joints' range are known, and what they depend on beside."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from minimax_cal.evidence.noise import orthonormal
from minimax_cal.ground.arrays import Array
from minimax_cal.instruments.instrument import PLENTY, anywhere
from minimax_cal.instruments.protocol import Arm, Given, ResidualRows, by_arm, corners
from minimax_cal.modelling.cell import still
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.robots.kinematics import hat
from minimax_cal.robots.robot import Robot

if TYPE_CHECKING:
    from minimax_cal.fitting.several.laws import Laws

OPEN = 1e-4  # of the largest column: positions that a parameter moves by less depend on it no more
NO_VALUES: Array = np.zeros(0)


def position_sigma(
    robot: Robot, mdh: Array, spots: Array, covariance: Array, laws: Laws | None = None,
    values: Array = NO_VALUES,
) -> float:  # fmt: skip
    """RMS of a position's standard deviation at random poses, by the parameters alone [m].

    Arguments as of `positions_by`.  covariance: (p, p), NaN where not identified.
    """
    known = np.isfinite(np.diag(covariance))
    known[5 * robot.joints : 5 * robot.joints + 6] = False  # the base, fitted again
    jacobian = positions_by(robot, mdh, spots, laws, values)
    # by its square root: where much is known badly, rounding would make the sum itself negative
    spread, axes = np.linalg.eigh(covariance[np.ix_(known, known)])
    root = jacobian[:, known] @ (axes * np.sqrt(np.maximum(spread, 0.0)))
    return float(np.sqrt(3.0 * (root**2).sum() / len(jacobian)))


def lacking(jacobian: Array, active: Array, asked: Array) -> Array:
    """(p,) the fewest of the parameters asked for with which all of them would be determined.

    Those that move positions as no others together do.  jacobian: (r, p) as `positions_by`.
    active: (p,) the identified parameters.
    """
    size = np.linalg.norm(jacobian, axis=0)
    waiting = asked & ~active & (size > OPEN * size.max())
    known, out = active.copy(), np.zeros_like(active)
    while waiting.any():
        basis = orthonormal(jacobian[:, known])
        rest = np.linalg.norm(jacobian - basis @ (basis.T @ jacobian), axis=0)
        waiting &= ~known & (rest > OPEN * size.max())
        share = np.where(waiting, rest / np.maximum(size, 1e-300), 0.0)
        if waiting.any():
            most = int(np.argmax(share))
            known[most] = out[most] = True
    return out


def positions_by(
    robot: Robot, mdh: Array, spots: Array, laws: Laws | None = None, values: Array = NO_VALUES
) -> Array:
    """(3 m, p) motion of the targets' centroid at random poses per unit of each parameter.

    But for the best rigid motion of all positions: a base is fitted wherever an arm is put to work.
    mdh: (n, 5).  spots: (k, 3) targets on the flange [m].  The parameters are links, a base, the
    targets and the laws, with values (d,).
    """
    at, spot = still(anywhere(robot, PLENTY).q, (), robot), spots.mean(axis=0)
    arm, frame = Arm.of(robot, at.q), (np.eye(3), np.zeros(3))
    if laws and laws.terms:
        scene = Scene.of(robot.with_mdh(mdh), at, frame, corners(spot), arm.q)
        arm = replace(arm, given=Given.of(arm.at(mdh), spot, *laws.fields(scene, values), values))
    flange = arm.at(mdh, values, np.ones(5 * len(mdh) + len(values), dtype=bool))
    point, pose = np.repeat(flange.place(spot), 3, axis=0), np.repeat(np.arange(PLENTY), 3)
    axes, none = np.tile(np.eye(3), (PLENTY, 1)), np.zeros((len(pose), 3))
    by = by_arm(flange, ResidualRows(none[:, 0], pose, point, axes, none, none[:, :0])).T
    target = flange.rotation.reshape(-1, 3) / len(spots)
    links, bends = np.split(by, [5 * len(mdh)], axis=1)
    jacobian = np.hstack([links, np.zeros((len(by), 6)), *[target] * len(spots), bends])
    stiff = arm.at(mdh).place(spot)
    stiff = stiff - stiff.mean(axis=0)
    rigid = np.concatenate([np.tile(np.eye(3), (len(stiff), 1, 1)), -hat(stiff)], axis=2)
    basis, _ = np.linalg.qr(rigid.reshape(-1, 6))
    return np.asarray(jacobian - basis @ (basis.T @ jacobian))
