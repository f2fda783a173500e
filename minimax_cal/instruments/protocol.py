"""What an instrument has of its own: it reads points of the flange, or the flange itself.

The arm's columns and those of its laws are made here, once for every instrument.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import right_jacobian, rotation
from minimax_cal.robots.robot import Robot

TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3.0)
EDGE = 0.1  # how far from their middle the corners lie by which laws are asked [m]
NONE: Array = np.zeros(0, dtype=int)
OF_NONE = -1
NO_SUMS: Array = np.zeros((0, 0))
LEAST_SHARE = 1e-12  # of rows about a place, so that one of which none counts has a mean too


class FlangePoses(NamedTuple):
    """m poses of the flange in the base, and its motion by each of p parameters (links, laws).

    rotation: (m, 3, 3).  origin: (m, 3) [m].  angular, linear: (p, m, 3) parts of the twist at the
    origin, per unit.  reach: of the arm [m].
    """

    rotation: Array
    origin: Array
    angular: Array
    linear: Array
    reach: float

    def place(self, spot: Array) -> Array:
        """(m, 3) or (m, k, 3) of points of the flange, (3,) or (k, 3), in the base [m]."""
        turned = np.einsum("mij,...j->m...i", self.rotation, spot)
        return np.asarray(turned + (self.origin if spot.ndim == 1 else self.origin[:, None]))


class ResidualRows(NamedTuple):
    """r rows: measured minus predicted, and the slopes of the prediction.

    residual: (r,) in the unit of the instrument.  pose: (r,).  point: (r, 3) looked at, in the base
    [m].  by_point, by_rotation: (r, 3) slopes by that point and by a rotation of the flange.
    by_own: (r, e).
    part: (r,) which of the instrument's parts it is of, or OF_NONE; empty for the first.
    about: (r,) numbers from 0; rows of one number are taken about their mean, as a place that they
    share is eliminated; empty for none.
    sums: (c, r) further rows as sums of these; short: (c,) their residuals, weighed like the sums;
    sum_pose: (c,); heavy: how much more such a row weighs than its noise says.
    """

    residual: Array
    pose: Array
    point: Array
    by_point: Array
    by_rotation: Array
    by_own: Array
    part: Array = NONE
    about: Array = NONE
    sums: Array = NO_SUMS
    short: Array = np.zeros(0)
    sum_pose: Array = NONE
    heavy: float = 1.0

    @property
    def weights(self) -> Array:
        """(r + c,) how much more each row weighs than its noise says."""
        return np.concatenate([np.ones(len(self.residual)), np.full(len(self.short), self.heavy)])

    @property
    def pose_of_row(self) -> Array:
        """(r + c,) the pose at which each row was measured."""
        return np.concatenate([self.pose, self.sum_pose])

    @property
    def places(self) -> Array:
        """(q, r + c) how the rows move with each number that is eliminated."""
        count = int(self.about.max(initial=-1)) + 1
        member = (self.about == np.arange(count)[:, None]).astype(float)
        return np.pad(member, ((0, 0), (0, len(self.residual) + len(self.sums) - member.shape[1])))

    def settled(
        self, slopes: Array, *, loose: bool = False, share: Array = NONE
    ) -> tuple[Array, Array]:
        """Residuals (r + c,) and slopes (p, r + c), places eliminated and sums made.

        slopes: (p, r) of the rows.  loose: whether slopes leave the places where they are.
        share: (r + c,) weights of the rows, empty where all weigh alike.
        """
        error = self.residual
        if not len(self.about):
            return error, slopes
        short, more = self.short, slopes @ self.sums.T if len(self.sums) else slopes[:, :0]
        error = self.centred(error, share)
        slopes = slopes if loose else self.centred(slopes, share)
        return np.concatenate([error, short]), np.concatenate([slopes, more], axis=1)

    def centred(self, values: Array, share: Array = NONE) -> Array:
        """Values (..., r) without the mean of those about the same place.  share: as above."""
        order = np.argsort(self.about, kind="stable")
        _, first = np.unique(self.about[order], return_index=True)
        weight = share[order] + LEAST_SHARE if len(share) else np.ones(len(order))
        total = np.add.reduceat(weight, first)
        mean = np.add.reduceat(weight * values[..., order], first, axis=-1) / total
        return np.asarray(values - mean[..., self.about])


def by_arm(arm: FlangePoses, rows: ResidualRows) -> Array:
    """(p, r) slopes of any instrument's predictions by the arm's parameters."""
    if not len(arm.linear):
        return np.zeros((0, len(rows.residual)))
    along = np.einsum("rc,prc->pr", rows.by_point, arm.linear[:, rows.pose])
    turned = np.einsum("rc,prc->pr", by_turns(arm, rows), arm.angular[:, rows.pose])
    return np.asarray(along + turned)


def by_turns(arm: FlangePoses, rows: ResidualRows) -> Array:
    """(r, 3) slopes by a turn of the flange about its origin, the points on it turning along."""
    return np.cross(rows.point - arm.origin[rows.pose], rows.by_point) + rows.by_rotation


# ---- the arm ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Given:
    """By how much laws turn and move the flange at m poses, in the axes of the base.

    angular, linear: (d, m, 3) per unit of each.  turned: (m, 3) rotation vector, moved: (m, 3) that
    come to them [rad, m].
    """

    angular: Array
    linear: Array
    turned: Array
    moved: Array

    @staticmethod
    def none(poses: int) -> Given:
        """An arm that does not give way."""
        still, nothing = np.zeros((0, poses, 3)), np.zeros((poses, 3))
        return Given(still, still, nothing, nothing)

    @staticmethod
    def of(arm: FlangePoses, middle: Array, fields: Array, more: Array, values: Array) -> Given:
        """From motions of the `corners` about a point: fields (d, 4, 3, m), more (4, 3, m) [m].

        arm: as stiff as the fields are of.  middle: (3,) in the flange [m].  values: (d,) at which
        more comes to the fields.
        """
        levers = np.einsum("mij,kj->kmi", arm.rotation, corners(np.zeros(3)))
        size = 3.0 / (8.0 * EDGE**2)  # one over the corners' moment of inertia

        def twist(motion: Array) -> tuple[Array, Array]:
            """Of motions (..., 4, 3, m): angular and linear (..., m, 3) at the middle."""
            moved = np.moveaxis(motion, -1, -2)
            centre = moved.mean(axis=-3)
            return size * np.cross(levers, moved - centre[..., None, :, :]).sum(axis=-3), centre

        angular, linear = twist(fields)
        whole, turned, moved = np.tensordot(values, angular, 1), *twist(more)
        # of finite turns the corners' motions hold the sine
        swung = whole + turned
        sine = np.clip(np.linalg.norm(swung, axis=1, keepdims=True), 1e-12, 1.0)
        swung = swung * (np.arcsin(sine) / sine)
        lever = np.einsum("mij,j->mi", arm.rotation, middle)
        moved = moved + np.tensordot(values, linear, 1)
        linear = linear - np.cross(angular, lever)
        moved = moved - (np.einsum("mij,mj->mi", rotation(swung), lever) - lever)
        return Given(angular, linear, swung - whole, moved - np.tensordot(values, linear, 1))


def corners(middle: Array) -> Array:
    """(4, 3) points of the flange about one (3,) by which motions of the flange are known [m]."""
    return np.asarray(middle + EDGE * TETRAHEDRON)


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm at its poses.

    q: (m, n) joint values with signs applied.  prismatic: (n,).  reach: [m].  given: laws by which
    it gives way.  still: its poses where no parameter of it moves any more.
    """

    q: Array
    prismatic: Array
    reach: float
    given: Given
    still: FlangePoses | None = None

    @staticmethod
    def of(robot: Robot, q: Array) -> Arm:
        """A stiff one at joint values (m, n), as the controller gives them."""
        return Arm(robot.turned(q), robot.prismatic, robot.reach(), Given.none(len(q)))

    def stopped(self, mdh: Array) -> Arm:
        """The same with links (n, 5) that stay."""
        return replace(self, still=self.at(mdh))

    def at(
        self, mdh: Array, values: Array | None = None, active: Array | None = None
    ) -> FlangePoses:
        """The flange's poses.

        mdh: (n, 5).  values: (d,) of the laws, stiff unless given.  active: (5n + d,) the
        parameters of which motions are asked, none unless given.
        """
        if self.still:
            return self.still
        given = self.given if values is not None else Given.none(len(self.q))
        values = values if values is not None else np.zeros(0)
        links = kinematics.chain(mdh, self.q, self.prismatic)
        turn, origin = np.moveaxis(links.axes, -1, 0).swapaxes(1, 2), links.origin.T
        swing = given.turned + np.tensordot(values, given.angular, 1)
        moved = given.moved + np.tensordot(values, given.linear, 1)
        bend, none = rotation(swing), np.zeros((0, *origin.shape))
        out = FlangePoses(bend @ turn, origin + moved, none, none, self.reach)
        if active is None or not active.any():
            return out
        slides, turns, bends = np.split(active, [2 * len(mdh), 5 * len(mdh)])
        along = np.moveaxis(np.concatenate([links.x, links.z])[slides], 1, -1)
        about, moment = (np.moveaxis(part[turns], 1, -1) for part in kinematics.screws(links))
        own = (right_jacobian(-swing) @ given.angular[bends][..., None])[..., 0]
        return out._replace(
            angular=np.concatenate([0.0 * along, (bend @ about[..., None])[..., 0], own]),
            linear=np.concatenate([along, moment + np.cross(about, origin), given.linear[bends]]),
        )
