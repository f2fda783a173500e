"""The errors of an arm, linearised at a fit, as the rows of a problem with two kinds of noise.

The noises are those of the instrument and of the joints at every pose.  A pose's errors have the
covariance s^2 I + t^2 S S', with S the motion of its points per radian of each joint: the joints do
not stop exactly where they should.  In the eigenvectors of S S' that matrix is diagonal for any s
and t, so that one rotation of the rows gives an `evidence.noise.LinearProblem`.

A law that no parameter holds (compliance, gears, cables) turns a joint by a function of the pose;
what drifts, by one of time.  Nobody knows the functions, but poses tell how large they are: waves
of the joint's own angle, waves of each other one alone and together with it, and the gravity on it,
each with a random factor [Rasmussen and Williams 2006].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointModel
from minimax_cal.robots import kinematics
from minimax_cal.robots.gravity_torques import joint_gravity_torques, link_masses_and_centres
from minimax_cal.robots.robot import Robot
from minimax_cal.selection.noise_model import (
    MIN_COMPUTED_NOISE_FRACTION,
    LinearProblem,
    orthonormal_basis,
)

MAX_COMPUTED_POINT_NOISE = 1e-8  # noise below which data were computed, not measured [m]
MIN_ESTIMATED_POINT_NOISE = (
    MIN_COMPUTED_NOISE_FRACTION * MAX_COMPUTED_POINT_NOISE
)  # no noise is estimated below it [m]


@dataclass(frozen=True, eq=False)
class PoseRows(LinearProblem):
    """Rows of linearised errors [m], r a pose, poses rotated so that both noises are diagonal.

    variance_ratio: of the joints' noise over the instrument's; size: its mean [m^2/rad^2].
    group: the pose of each row, of repeats the same.  turn: (m, r, r) the rotations.
    weight: (m, r) square roots of the rows' weights.
    """

    turn: Array
    weight: Array

    def rows_from_fields(self, displacement_fields: Array) -> Array:
        """(N, D) displacement fields (D, k, 3, m) as rows."""
        raise NotImplementedError

    @property
    def rows_per_pose(self) -> int:
        """Rows of a pose."""
        return int(self.weight.shape[1])

    @property
    def pose_numbers(self) -> Array:
        """(m,) a number, from 0, of each pose."""
        return np.asarray(self.row_groups[:: self.rows_per_pose])

    def with_pose_numbers(self, pose_numbers: Array) -> Self:
        """With poses of one number (m,) as repeats of each other."""
        return replace(self, row_groups=np.repeat(pose_numbers, self.rows_per_pose))

    def row_mask_of_poses(self, pose_mask: Array) -> Array:
        """(N,) mask of the rows of some poses (m,)."""
        return np.repeat(np.asarray(pose_mask, dtype=bool), self.rows_per_pose)


@dataclass(frozen=True, eq=False)
class PointRows(PoseRows):
    """Rows of points of a tracker: r = 3k a pose, of k targets."""

    def rows_from_fields(self, displacement_fields: Array) -> Array:
        """(N, D) displacement fields (D, k, 3, m) as rows."""
        d, k, _, m = displacement_fields.shape
        flat = (
            np.moveaxis(displacement_fields.reshape(d, 3 * k, m), -1, 0) * self.weight[:, None, :]
        )
        return np.asarray((flat @ self.turn).swapaxes(1, 2).reshape(3 * k * m, d))

    def rows_to_points(self, rows: Array) -> Array:
        """(k, 3, m) rows (N,) as points again; what was not measured is 0."""
        m, r = self.weight.shape
        flat = (self.turn @ rows.reshape(m, r, 1))[..., 0]
        plain = np.where(self.weight > 0, flat / np.where(self.weight > 0, self.weight, 1.0), 0.0)
        return np.asarray(plain.T.reshape(r // 3, 3, m))


def build_point_rows(
    point_errors: Array, jacobian: Array, joint_jacobian: Array, point_weights: Array
) -> PointRows:
    """Rows from an error (k, 3, m), geometry's Jacobian (k, p, 3, m), slope (n, k, 3, m).

    point_weights: (k, m) of each point, 0 where not measured.
    """
    k, _, m = point_errors.shape
    root = np.repeat(np.sqrt(point_weights)[:, None], 3, axis=1).reshape(3 * k, m).T
    arm = (
        np.moveaxis(joint_jacobian.reshape(len(joint_jacobian), 3 * k, m), -1, 0) * root[:, None, :]
    )
    spread, turn = np.linalg.eigh(np.swapaxes(arm, 1, 2) @ arm)
    spread = np.maximum(spread, 0.0).reshape(-1)
    size = float(spread.sum() / (3 * int(np.count_nonzero(point_weights))))
    bare = PointRows(
        error=np.zeros(0),
        nuisance_basis=np.zeros((0, 0)),
        variance_ratio=spread / size,
        mean_variance_ratio=size,
        row_groups=np.repeat(np.arange(m), 3 * k),
        measured=(root > 0.0).reshape(-1),
        rounding_noise=MAX_COMPUTED_POINT_NOISE,
        turn=turn,
        weight=root,
    )
    matrix = bare.rows_from_fields(np.moveaxis(jacobian, 1, 0))
    rest = bare.rows_from_fields(np.where(point_weights[:, None] > 0, point_errors, 0.0)[None])[
        :, 0
    ]
    return replace(bare, error=rest, nuisance_basis=orthonormal_basis(matrix))


def linearise_to_point_rows(
    model: PointModel, state: ParameterValues, joint_jacobian: Array
) -> PointRows:
    """The rows of a model at a fitted state.  joint_jacobian: (n, k, 3, m) as `Scene.jacobian`."""
    error = np.nan_to_num(np.moveaxis(model.point_errors(state), 0, -1))
    jacobian = np.moveaxis(model.point_jacobian(state), (0, 2, 3), (3, 2, 1))
    return build_point_rows(error, jacobian, joint_jacobian, model.weight)


# ---- lack of fit ---------------------------------------------------------------------------------


FUNCTION_UNIT_ANGLE = (
    1e-4  # turn by a factor of 1, so that variances are numbers of ordinary size [rad]
)
OWN_ANGLE_DRIVER, OTHER_ANGLES_DRIVER, GRAVITY_DRIVER = LACK_OF_FIT_DRIVERS = range(
    3
)  # what drives a function
MAX_OWN_ANGLE_WAVES = 2  # waves in a turn of the joint itself: gears err once and twice a turn
MAX_SESSION_WAVES = 2  # of the place in the session: a drift and a bow
SESSION_CHANGE_OVER_DRIFT = float(
    np.sqrt(12.0)
)  # from one session's mean to the next, over the RMS of a drift


def joint_radian_equivalents(robot: Robot) -> Array:
    """(n,) what counts as a radian of each joint: of a slide the arm's reach [m]."""
    return np.where(robot.prismatic, robot.reach(), 1.0)


class FunctionMotions(NamedTuple):
    """Motion of the points by the factor of each function, and the kind of each factor."""

    motions: Array
    kinds: Array


def lack_of_fit_motions_by_pose(
    robot: Robot, q: Array, motions_per_joint: Array
) -> FunctionMotions:
    """(m, r, c) motion of the points by each function's factor, and (c, 2) its kind.

    The kind is the joint that it turns, and what drives it.  q: (m, n) joint values with signs
    applied.  motions_per_joint: (m, r, n) motion per unit of each joint.
    """
    unit = joint_radian_equivalents(robot)
    angle, n = q / unit, robot.joints
    links = kinematics.compute_link_frames(robot.mdh, q, robot.prismatic)
    load = joint_gravity_torques(links, *link_masses_and_centres(robot), robot.up).T
    size = float(np.sqrt(np.mean(load**2)))
    columns, kind = [], []
    for j in range(n):
        others = np.delete(angle, j, axis=1)
        own = angle[:, j, None]
        waves = [own * np.arange(1, MAX_OWN_ANGLE_WAVES + 1), others, others + own, others - own]
        phase = np.concatenate(waves, axis=1)
        pull = load[:, j, None] / (size or 1.0)
        functions = np.concatenate([np.sin(phase), np.cos(phase), pull], axis=1)
        columns.append(
            FUNCTION_UNIT_ANGLE * unit[j] * motions_per_joint[:, :, j, None] * functions[:, None, :]
        )
        driven = np.repeat(
            [OWN_ANGLE_DRIVER, *[OTHER_ANGLES_DRIVER] * 3], [part.shape[1] for part in waves]
        )
        driver = np.concatenate([driven, driven, np.full(pull.shape[1], GRAVITY_DRIVER)])
        kind.append(np.stack([np.full(len(driver), j), driver], axis=1))
    return FunctionMotions(np.concatenate(columns, axis=2), np.concatenate(kind))


def lack_of_fit_motions_by_time(
    robot: Robot, session_time: Array, motions_per_joint: Array, motions_per_strain: Array
) -> FunctionMotions:
    """(1 + WAVES, m, r, n + 1) motion by what drifts: for the whole session, then by each wave.

    And (n + 1,) the kind: 0 a joint's zero, 1 the length of all links.  session_time: (m,) place in
    the session, 0 to 1.  motions_per_joint: as in `lack_of_fit_motions_by_pose`.
    motions_per_strain: (m, r) motion per share of all lengths.
    """
    turned = FUNCTION_UNIT_ANGLE * np.concatenate(
        [joint_radian_equivalents(robot) * motions_per_joint, motions_per_strain[..., None]], axis=2
    )
    phase = np.pi * np.arange(MAX_SESSION_WAVES + 1)[:, None] * session_time
    size = np.where(np.arange(MAX_SESSION_WAVES + 1) > 0, np.sqrt(2.0), SESSION_CHANGE_OVER_DRIFT)[
        :, None
    ]
    functions = size * np.cos(phase)
    kind = np.append(np.zeros(robot.joints, dtype=int), 1)
    return FunctionMotions(functions[:, :, None, None] * turned, kind)
