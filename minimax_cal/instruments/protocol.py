"""What an instrument has of its own: it reads points of the flange, or the flange itself.

The arm's columns and those of its laws are made here, once for every instrument.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import rotation_from_vector, so3_right_jacobian
from minimax_cal.robots.robot import Robot

UNIT_TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3.0)
FLANGE_CORNER_DISTANCE = (
    0.1  # how far from their middle the corners lie by which laws are asked [m]
)
NO_ROW_NUMBERS: Array = np.zeros(0, dtype=int)
NO_PART = -1
NO_SUM_ROWS: Array = np.zeros((0, 0))
MIN_MEAN_WEIGHT = 1e-12  # of rows about a place, so that one of which none counts has a mean too


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


class ReducedRows(NamedTuple):
    """Residuals (r,), and their slopes (p, r) by parameters."""

    residuals: Array
    slopes: Array


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
    part: Array = NO_ROW_NUMBERS
    about: Array = NO_ROW_NUMBERS
    sums: Array = NO_SUM_ROWS
    short: Array = np.zeros(0)
    sum_pose: Array = NO_ROW_NUMBERS
    heavy: float = 1.0

    @property
    def row_weights(self) -> Array:
        """(r + c,) how much more each row weighs than its noise says."""
        return np.concatenate([np.ones(len(self.residual)), np.full(len(self.short), self.heavy)])

    @property
    def pose_of_each_row(self) -> Array:
        """(r + c,) the pose at which each row was measured."""
        return np.concatenate([self.pose, self.sum_pose])

    @property
    def slopes_by_eliminated_places(self) -> Array:
        """(q, r + c) how the rows move with each number that is eliminated."""
        count = int(self.about.max(initial=-1)) + 1
        member = (self.about == np.arange(count)[:, None]).astype(float)
        return np.pad(member, ((0, 0), (0, len(self.residual) + len(self.sums) - member.shape[1])))

    def eliminate_places_and_add_sums(
        self, slopes: Array, *, keep_slopes: bool = False, row_weights: Array = NO_ROW_NUMBERS
    ) -> ReducedRows:
        """Residuals (r + c,) and slopes (p, r + c), places eliminated and sums made.

        slopes: (p, r) of the rows.  keep_slopes: whether slopes leave the places where they are.
        row_weights: (r + c,) weights of the rows, empty where all weigh alike.
        """
        error = self.residual
        if not len(self.about):
            return ReducedRows(error, slopes)
        short, more = self.short, slopes @ self.sums.T if len(self.sums) else slopes[:, :0]
        error = self.subtract_place_means(error, row_weights)
        slopes = slopes if keep_slopes else self.subtract_place_means(slopes, row_weights)
        return ReducedRows(np.concatenate([error, short]), np.concatenate([slopes, more], axis=1))

    def subtract_place_means(self, values: Array, row_weights: Array = NO_ROW_NUMBERS) -> Array:
        """Values (..., r) without the mean of those about the same place.  row_weights: as
        above.
        """
        order = np.argsort(self.about, kind="stable")
        _, first = np.unique(self.about[order], return_index=True)
        weight = row_weights[order] + MIN_MEAN_WEIGHT if len(row_weights) else np.ones(len(order))
        total = np.add.reduceat(weight, first)
        mean = np.add.reduceat(weight * values[..., order], first, axis=-1) / total
        return np.asarray(values - mean[..., self.about])


def slopes_by_arm_parameters(arm: FlangePoses, rows: ResidualRows) -> Array:
    """(p, r) slopes of any instrument's predictions by the arm's parameters."""
    if not len(arm.linear):
        return np.zeros((0, len(rows.residual)))
    along = np.einsum("rc,prc->pr", rows.by_point, arm.linear[:, rows.pose])
    turned = np.einsum(
        "rc,prc->pr", slopes_by_flange_rotation(arm, rows), arm.angular[:, rows.pose]
    )
    return np.asarray(along + turned)


def slopes_by_flange_rotation(arm: FlangePoses, rows: ResidualRows) -> Array:
    """(r, 3) slopes by a turn of the flange about its origin, the points on it turning along."""
    return np.cross(rows.point - arm.origin[rows.pose], rows.by_point) + rows.by_rotation


# ---- the arm ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class EffectMotion:
    """By how much laws turn and move the flange at m poses, in the axes of the base.

    angular, linear: (d, m, 3) per unit of each.  turned: (m, 3) rotation vector, moved: (m, 3) that
    come to them [rad, m].
    """

    angular: Array
    linear: Array
    turned: Array
    moved: Array

    @staticmethod
    def without_effects(pose_count: int) -> EffectMotion:
        """An arm that does not give way."""
        still, nothing = np.zeros((0, pose_count, 3)), np.zeros((pose_count, 3))
        return EffectMotion(still, still, nothing, nothing)

    @staticmethod
    def from_corner_motions(
        arm: FlangePoses,
        corner_centre: Array,
        corner_fields: Array,
        extra_motions: Array,
        values: Array,
    ) -> EffectMotion:
        """From motions of the `flange_corners` about a point: fields (d, 4, 3, m), more (4, 3, m)
        [m].

        arm: as stiff as the fields are of.  corner_centre: (3,) in the flange [m].  values: (d,) at
        which more comes to the fields.
        """
        levers = np.einsum("mij,kj->kmi", arm.rotation, flange_corners(np.zeros(3)))
        size = 3.0 / (8.0 * FLANGE_CORNER_DISTANCE**2)  # one over the corners' moment of inertia

        def twist(motion: Array) -> tuple[Array, Array]:
            """Of motions (..., 4, 3, m): angular and linear (..., m, 3) at the middle."""
            moved = np.moveaxis(motion, -1, -2)
            centre = moved.mean(axis=-3)
            return size * np.cross(levers, moved - centre[..., None, :, :]).sum(axis=-3), centre

        angular, linear = twist(corner_fields)
        whole, turned, moved = np.tensordot(values, angular, 1), *twist(extra_motions)
        # of finite turns the corners' motions hold the sine
        swung = whole + turned
        sine = np.clip(np.linalg.norm(swung, axis=1, keepdims=True), 1e-12, 1.0)
        swung = swung * (np.arcsin(sine) / sine)
        lever = np.einsum("mij,j->mi", arm.rotation, corner_centre)
        moved = moved + np.tensordot(values, linear, 1)
        linear = linear - np.cross(angular, lever)
        moved = moved - (np.einsum("mij,mj->mi", rotation_from_vector(swung), lever) - lever)
        return EffectMotion(angular, linear, swung - whole, moved - np.tensordot(values, linear, 1))


def flange_corners(centre: Array) -> Array:
    """(4, 3) points of the flange about one (3,) by which motions of the flange are known [m]."""
    return np.asarray(centre + FLANGE_CORNER_DISTANCE * UNIT_TETRAHEDRON)


@dataclass(frozen=True, eq=False)
class FlangeKinematics:
    """An arm at its poses.

    q: (m, n) joint values with signs applied.  prismatic: (n,).  reach: [m].  given: laws by which
    it gives way.  still: its poses where no parameter of it moves any more.
    """

    q: Array
    prismatic: Array
    reach: float
    given: EffectMotion
    still: FlangePoses | None = None

    @staticmethod
    def from_robot(robot: Robot, q: Array) -> FlangeKinematics:
        """A stiff one at joint values (m, n), as the controller gives them."""
        return FlangeKinematics(
            robot.chain_joint_values(q),
            robot.prismatic,
            robot.reach(),
            EffectMotion.without_effects(len(q)),
        )

    def with_fixed_links(self, mdh: Array) -> FlangeKinematics:
        """The same with links (n, 5) that stay."""
        return replace(self, still=self.compute_flange_poses(mdh))

    def compute_flange_poses(
        self, mdh: Array, effect_values: Array | None = None, active_parameters: Array | None = None
    ) -> FlangePoses:
        """The flange's poses.

        mdh: (n, 5).  effect_values: (d,) of the laws, stiff unless given.  active_parameters: (5n +
        d,) the parameters of which motions are asked, none unless given.
        """
        if self.still:
            return self.still
        given = (
            self.given if effect_values is not None else EffectMotion.without_effects(len(self.q))
        )
        effect_values = effect_values if effect_values is not None else np.zeros(0)
        links = kinematics.compute_link_frames(mdh, self.q, self.prismatic)
        turn, origin = np.moveaxis(links.axes, -1, 0).swapaxes(1, 2), links.origin.T
        swing = given.turned + np.tensordot(effect_values, given.angular, 1)
        moved = given.moved + np.tensordot(effect_values, given.linear, 1)
        bend, none = rotation_from_vector(swing), np.zeros((0, *origin.shape))
        out = FlangePoses(bend @ turn, origin + moved, none, none, self.reach)
        if active_parameters is None or not active_parameters.any():
            return out
        slides, turns, bends = np.split(active_parameters, [2 * len(mdh), 5 * len(mdh)])
        along = np.moveaxis(np.concatenate([links.x, links.z])[slides], 1, -1)
        about, moment = (
            np.moveaxis(part[turns], 1, -1) for part in kinematics.screw_axes_and_moments(links)
        )
        own = (so3_right_jacobian(-swing) @ given.angular[bends][..., None])[..., 0]
        return out._replace(
            angular=np.concatenate([0.0 * along, (bend @ about[..., None])[..., 0], own]),
            linear=np.concatenate([along, moment + np.cross(about, origin), given.linear[bends]]),
        )
