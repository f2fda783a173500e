"""Errors of poses as rows of a linear problem, in units of their noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from minimax_cal.evidence.noise import orthonormal
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.parameters import State

PLENTY = 500  # poses that tell what more would


@dataclass(frozen=True, eq=False)
class Rows:
    """New errors in units of their noise, linear in all parameters.

    error: (N,).  jacobian: (N, p).  latent: (N, r) by what the calibration did not know, each of
    variance 1.  active: (p,) what is free.  state: about which.  count: coordinates that were
    measured.  pose: (N,) number of each row's pose, -1 for the foot, last.  half: (m, r, r) root of
    each pose's noise [m].
    """

    error: Array
    jacobian: Array
    latent: Array
    active: Array
    state: State
    count: int
    pose: Array
    half: Array

    @cached_property
    def whole(self) -> Array:
        """(N + r, free + r) columns of what is free and of what was not known, with its prior."""
        r = self.latent.shape[1]
        free = self.jacobian[:, self.active]
        return np.block([[free, self.latent], [np.zeros((r, free.shape[1])), np.eye(r)]])

    @cached_property
    def basis(self) -> Array:
        """(N + r, q) orthonormal span of `whole`."""
        return orthonormal(self.whole)

    @cached_property
    def left(self) -> Array:
        """(N + r,) what they leave of the error."""
        error = np.pad(self.error, (0, self.latent.shape[1]))
        return np.asarray(error - self.basis @ (self.basis.T @ error))

    @property
    def foot(self) -> int:
        """Coordinates of the foot."""
        return int(np.count_nonzero(self.pose < 0))

    @property
    def dof(self) -> int:
        """Degrees of freedom of what is left."""
        return max(self.count - int(self.basis.shape[1] - self.latent.shape[1]), 1)

    @property
    def mean_square(self) -> float:
        """Of what is left, in units of the noise."""
        return float(self.left @ self.left) / self.dof

    @property
    def scale(self) -> float:
        """By how much the noise is larger than it was, at least 1."""
        return float(np.sqrt(max(self.mean_square, 1.0)))

    def apart(self, columns: Array, basis: Array) -> Array:
        """(N + r, c) what of some parameters' motion a basis does not hold."""
        motion = np.pad(self.jacobian[:, columns], ((0, self.latent.shape[1]), (0, 0)))
        rest = motion - basis @ (basis.T @ motion)
        return np.asarray(rest - basis @ (basis.T @ rest))  # twice is enough

    def columns(self, more: Array) -> Array:
        """(N, q) what is free, what was not known, and some more parameters."""
        return np.hstack([self.jacobian[:, self.active], self.latent, self.jacobian[:, more]])

    def by_pose(self, columns: Array, most: int = PLENTY) -> tuple[Array, Array]:
        """Products of each pose's rows: (m, q, q), and its coordinates: (m,).

        q: what is free, what was not known, some more parameters, and the error last.  most: of
        more poses so many are taken, evenly.
        """
        every = np.concatenate([self.columns(columns), self.error[:, None]], axis=1)
        poses = np.unique(self.pose[self.pose >= 0])
        poses = poses[np.linspace(0, len(poses) - 1, min(len(poses), most)).astype(int)]
        parts = [every[self.pose == pose] for pose in poses]
        seen = [int(np.count_nonzero(part.any(axis=1))) for part in parts]
        return np.array([part.T @ part for part in parts]), np.array(seen, dtype=float)

    def share(self, columns: Array, held: Array) -> Array:
        """(c,) share of each motion that other parameters, (p,) True in held, do not imitate."""
        size = (self.jacobian[:, columns] ** 2).sum(axis=0)
        rest = size
        if held.any():
            basis = orthonormal(self.jacobian[:, held])
            off = self.jacobian[:, columns] - basis @ (basis.T @ self.jacobian[:, columns])
            rest = (off**2).sum(axis=0)
        return np.asarray(rest / np.where(size > 0.0, size, np.inf))

    def sizes(self, columns: Array) -> Array:
        """(c,) how large each score is, in sigmas, by the noise that the others leave."""
        by, sigma = self.scores(columns)
        square = np.nan_to_num((by / sigma * self.scale) ** 2)
        dof = max(self.dof - 1, 1)  # what is explained is no noise
        noise = np.maximum((self.dof * self.mean_square - square) / dof, 1.0)
        return np.asarray(np.sqrt(square / noise))

    def sigmas(self, columns: Array) -> Array:
        """(c,) of each parameter's change if the noise is what it was [SI]."""
        return replace(self, error=np.zeros_like(self.error)).scores(columns)[1]

    def scores(self, columns: Array) -> tuple[Array, Array]:
        """Each parameter's change if it alone moved besides, and its sigma: (c,) each [SI]."""
        rest = self.apart(columns, self.basis)
        size = (rest**2).sum(axis=0)
        size = np.where(size > 0.0, size, np.nan)
        return rest.T @ self.left / size, self.scale / np.sqrt(size)


@dataclass(frozen=True, eq=False)
class Both:
    """The same errors by the noises that the calibration found, and with all coordinates alike.

    The first tell most where noises are all there is; the second where the model lacks something in
    directions in which nothing is noisy.
    """

    noise: Rows
    alike: Rows
