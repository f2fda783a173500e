"""The errors of an arm, linearised at a fit, as the rows of a problem with two kinds of noise.

The noises are those of the instrument and of the joints at every pose.  A pose's errors have the
covariance s^2 I + t^2 S S', with S the motion of its points per radian of each joint: the joints do
not stop exactly where they should.  In the eigenvectors of S S' that matrix is diagonal for any s
and t, so that one rotation of the rows gives an `evidence.noise.Problem`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from minimax_cal.evidence.noise import ROUNDING, Problem, orthonormal
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.model import Model
from minimax_cal.modelling.parameters import State

MAX_COMPUTED_NOISE = 1e-8  # noise below which data were computed, not measured [m]
MIN_COMPUTED_NOISE = ROUNDING * MAX_COMPUTED_NOISE  # no noise is estimated below it [m]


@dataclass(frozen=True, eq=False)
class Posed(Problem):
    """Rows of linearised errors [m], r a pose, poses rotated so that both noises are diagonal.

    variance_ratio: of the joints' noise over the instrument's; size: its mean [m^2/rad^2].
    group: the pose of each row, of repeats the same.  turn: (m, r, r) the rotations.
    weight: (m, r) square roots of the rows' weights.
    """

    turn: Array
    weight: Array

    def of(self, fields: Array) -> Array:
        """(N, D) displacement fields (D, k, 3, m) as rows."""
        raise NotImplementedError

    @property
    def width(self) -> int:
        """Rows of a pose."""
        return int(self.weight.shape[1])

    @property
    def poses(self) -> Array:
        """(m,) a number, from 0, of each pose."""
        return np.asarray(self.group[:: self.width])

    def with_poses(self, number: Array) -> Self:
        """With poses of one number (m,) as repeats of each other."""
        return replace(self, group=np.repeat(number, self.width))

    def at(self, poses: Array) -> Array:
        """(N,) mask of the rows of some poses (m,)."""
        return np.repeat(np.asarray(poses, dtype=bool), self.width)


@dataclass(frozen=True, eq=False)
class Rows(Posed):
    """Rows of points of a tracker: r = 3k a pose, of k targets."""

    def of(self, fields: Array) -> Array:
        """(N, D) displacement fields (D, k, 3, m) as rows."""
        d, k, _, m = fields.shape
        flat = np.moveaxis(fields.reshape(d, 3 * k, m), -1, 0) * self.weight[:, None, :]
        return np.asarray((flat @ self.turn).swapaxes(1, 2).reshape(3 * k * m, d))

    def back(self, rows: Array) -> Array:
        """(k, 3, m) rows (N,) as points again; what was not measured is 0."""
        m, r = self.weight.shape
        flat = (self.turn @ rows.reshape(m, r, 1))[..., 0]
        plain = np.where(self.weight > 0, flat / np.where(self.weight > 0, self.weight, 1.0), 0.0)
        return np.asarray(plain.T.reshape(r // 3, 3, m))


def rows_of(error: Array, jacobian: Array, joint_jacobian: Array, weight: Array) -> Rows:
    """Rows from an error (k, 3, m), geometry's Jacobian (k, p, 3, m), slope (n, k, 3, m).

    weight: (k, m) of each point, 0 where not measured.
    """
    k, _, m = error.shape
    root = np.repeat(np.sqrt(weight)[:, None], 3, axis=1).reshape(3 * k, m).T
    arm = (
        np.moveaxis(joint_jacobian.reshape(len(joint_jacobian), 3 * k, m), -1, 0) * root[:, None, :]
    )
    spread, turn = np.linalg.eigh(np.swapaxes(arm, 1, 2) @ arm)
    spread = np.maximum(spread, 0.0).reshape(-1)
    size = float(spread.sum() / (3 * int(np.count_nonzero(weight))))
    bare = Rows(
        error=np.zeros(0),
        basis=np.zeros((0, 0)),
        variance_ratio=spread / size,
        size=size,
        group=np.repeat(np.arange(m), 3 * k),
        measured=(root > 0.0).reshape(-1),
        exact=MAX_COMPUTED_NOISE,
        turn=turn,
        weight=root,
    )
    matrix = bare.of(np.moveaxis(jacobian, 1, 0))
    rest = bare.of(np.where(weight[:, None] > 0, error, 0.0)[None])[:, 0]
    return replace(bare, error=rest, basis=orthonormal(matrix))


def linearised(model: Model, state: State, joint_jacobian: Array) -> Rows:
    """The rows of a model at a fitted state.  joint_jacobian: (n, k, 3, m) as `Scene.jacobian`."""
    error = np.nan_to_num(np.swapaxes(model.error(state), -1, -2))
    jacobian = np.moveaxis(model.jacobian(state), (1, 2, 3), (3, 2, 1))
    return rows_of(error, jacobian, joint_jacobian, model.weight)
