"""What the laws of joint torque are functions of: the motion, the load, and the arm's own numbers.

Columns are made of the motion at every sample, in the unit of the log, and then filtered to rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np

from minimax_cal.dynamics.regressor import (
    PER_LINK,
    Motion,
    base_parameters,
    inertial_parameters,
    inverse_dynamics,
    regressor,
)
from minimax_cal.dynamics.rows import SLOWEST, Logs
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.facts import APART
from minimax_cal.robots.robot import Robot

KEPT = ("regressor", "base_rows", "known_torque", "sense", "bristles", "since_reversal")
SOFT = 0.0025  # of a joint's largest speed: where friction changes its sign
YIELD = np.array([1e-4, 1e-3])  # way after which each of a joint's bristles slides [rad, m]


def sense_of(qd: Array, soft: Array | float) -> Array:
    """Sign of a speed, in proportion to it below `soft`, as simulators have it."""
    return np.asarray(np.clip(qd / soft, -1.0, 1.0))


def bent_bristles(logs: Logs, yields: Array) -> Array:
    """(M, n, k) how far bristles are bent along a motion, -1 to 1.  yields: (k,) or (n, k).

    A joint that stops or turns round keeps the friction of those that it has not bent over yet:
    Maxwell-slip elements, each after the law of Dahl [Al-Bender, Lampaert, Swevers 2005].
    """
    out = np.zeros((*logs.torque.shape, yields.shape[-1]))
    for a, b in zip(logs.start[:-1], logs.start[1:], strict=True):
        q = logs.motion.q[a:b]
        way = np.diff(q, axis=0, prepend=q[:1])[..., None] / yields
        stays = np.exp(-np.abs(way))
        bent, step = np.sign(way) * (1.0 - stays), 1
        while step < b - a:  # bent[i] += stays[i] * bent[i - 1], all i at once by doubling
            bent[step:] += stays[step:] * bent[:-step]
            stays[step:] *= stays[:-step].copy()
            step *= 2
        out[a:b] = bent
    return out


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm, and how its torques are read.

    gain: (n,) torque per unit of the log, 1 where it holds torques [N m/A, or none]; empty where a
    current has none, and then each joint has inertial parameters of its own.
    ratio: (n,) gear ratios, NaN where not given.  soft, fastest: (n,) speeds over which friction
    changes its sign, and the largest [rad/s, m/s].  known: (10,) of what the flange carries in runs
    that say so, per kilogram.
    """

    robot: Annotated[Robot, APART]
    gain: Array
    ratio: Array
    soft: Array
    fastest: Array
    known: Array

    @staticmethod
    def of(robot: Robot, gain: Array, ratio: Array, known: Array, logs: Logs) -> Arm:
        """With the speeds that the logs show."""
        fastest = np.maximum(np.abs(logs.motion.qd).max(axis=0), SLOWEST)
        return Arm(robot, gain, ratio, np.maximum(SOFT * fastest, 1e-4), fastest, known)

    @cached_property
    def drawn(self) -> Array:
        """(10 n,) inertial parameters as the robot file gives them."""
        return inertial_parameters(self.robot).ravel()

    @property
    def shared(self) -> bool:
        """Whether all joints have the same inertial parameters."""
        return bool(len(self.gain))

    @cached_property
    def base(self) -> Array:
        """(10 n, r) combinations of inertial parameters that any motion can show."""
        n = self.robot.joints
        rng = np.random.default_rng(0)
        q, qd, qdd = rng.normal(size=(3, 10 * n, n))
        columns = regressor(self.robot, Motion(q, qd, qdd))
        return base_parameters(columns.reshape(-1, PER_LINK * n))


@dataclass(frozen=True, eq=False)
class Scene:
    """An arm along the trajectories of some logs.

    rigid: (n, 10 n) inertial parameters as they are last known, by joint; equal rows where joints
    share them.  friction: (M, n) of every joint as it is last known, in the unit of the log.
    """

    arm: Arm
    logs: Logs
    rigid: Array
    friction: Array

    @staticmethod
    def of(arm: Arm, logs: Logs) -> Scene:
        """With the rigid body as drawn and no friction."""
        rigid = np.broadcast_to(arm.drawn, (logs.joints, len(arm.drawn)))
        return Scene(arm, logs, rigid, np.zeros_like(logs.torque))

    @cached_property
    def divisor(self) -> Array:
        """(n,) torque per unit of the log; 1 where it is not known."""
        return self.arm.gain if self.arm.shared else np.ones(self.logs.joints)

    @cached_property
    def regressor(self) -> Array:
        """(M, n, 10 n) in the unit of the log."""
        return regressor(self.arm.robot, self.logs.motion) / self.divisor[:, None]

    @cached_property
    def base_rows(self) -> Array:
        """(R, n, r) of the combinations that any motion can show."""
        return self.logs.filtered(self.regressor @ self.arm.base)

    @cached_property
    def known_torque(self) -> Array:
        """(M, n) of what the flange carries and a run says [unit of the log]."""
        carried = np.nan_to_num(self.logs.payload)[:, None]
        return np.asarray(carried * (self.regressor[:, :, -PER_LINK:] @ self.arm.known))

    @cached_property
    def load(self) -> Array:
        """(M, n) torque that the body puts on every joint, in the unit of the log."""
        rigid = np.einsum("mjp,jp->mj", self.regressor, self.rigid)
        return np.asarray(rigid + self.known_torque)

    @cached_property
    def sense(self) -> Array:
        """(M, n) sign of the speed, soft where it changes."""
        return sense_of(self.logs.motion.qd, self.arm.soft)

    @cached_property
    def bristles(self) -> Array:
        """(R, n, k) how far bristles are bent, -1 to 1, less the sense; 0 while a joint slides."""
        return self.stuck(YIELD)

    def stuck(self, yields: Array) -> Array:
        """The same of bristles that yield after other ways (k,) or (n, k)."""
        off = bent_bristles(self.logs, yields) - self.sense[..., None]
        return self.logs.filtered(~self.logs.sliding[..., None] * off)

    @cached_property
    def since_reversal(self) -> Array:
        """(M, n) how far a joint is from where it last turned round, or began [rad, m]."""
        out = np.zeros_like(self.logs.torque)
        for a, b in zip(self.logs.start[:-1], self.logs.start[1:], strict=True):
            q, back = self.logs.motion.q[a:b], self.logs.motion.qd[a:b] > 0.0
            flips = np.zeros(back.shape, dtype=bool)
            flips[1:] = back[1:] != back[:-1]
            last = np.maximum.accumulate(np.where(flips, np.arange(b - a)[:, None], 0), axis=0)
            out[a:b] = np.abs(q - np.take_along_axis(q, last, axis=0))
        return out

    def along(self, motion: Motion) -> Array:
        """(M, n) torque of the body along another motion, by recursion."""
        return inverse_dynamics(self.arm.robot, motion, self.rigid[0].reshape(-1, PER_LINK))

    @cached_property
    def as_moved(self) -> Array:
        """(M, n) torque of the body by the same recursion as where the motion is shifted."""
        return self.along(self.logs.motion)

    def shifted(self, by: Array) -> Array:
        """(M, n) torque of the body per unit of a shift `by` (M, n) of the motion [rad, m]."""
        one = self.logs.motion
        step = 1e-6 / max(float(np.abs(by).max()), 1e-300)
        rate = self.logs.slope(by)
        moved = Motion(
            one.q + step * by, one.qd + step * rate, one.qdd + step * self.logs.slope(rate)
        )
        return np.asarray((self.along(moved) - self.as_moved) / step / self.divisor)

    def with_body(self, rigid: Array, friction: Array) -> Scene:
        """The scene with another body and friction, its regressor kept."""
        new = replace(self, rigid=rigid, friction=friction)
        for name in vars(self).keys() & KEPT:
            vars(new)[name] = vars(self)[name]
        return new
