"""Errors of new poses as rows of a linear problem, in units of their noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.evidence.noise import orthonormal
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.parameters import State


@dataclass(frozen=True, eq=False)
class Rows:
    """New errors in units of their noise, linear in all parameters.

    error: (N,).  jacobian: (N, p).  latent: (N, r) by what the calibration did not know, and
    by what the model lacks, each of variance 1.  active: (p,) what is free.  state: about which.
    count: coordinates that were measured.  pose: (N,) number of each row's pose, -1 for the foot,
    last.  half: (m, r, r) root of each pose's noise [m].  arm: (m, r, n) motion of the points per
    unit of each joint, in units of the noise.  scale: by how much the noise is larger than it was.
    """

    error: Array
    jacobian: Array
    latent: Array
    active: Array
    state: State
    count: int
    pose: Array
    half: Array
    arm: Array
    scale: float = 1.0

    @property
    def foot(self) -> int:
        """Coordinates of the foot."""
        return int(np.count_nonzero(self.pose < 0))

    def share(self, columns: Array, held: Array) -> Array:
        """(c,) share of each motion that other parameters, (p,) True in held, do not imitate."""
        size = (self.jacobian[:, columns] ** 2).sum(axis=0)
        rest = size
        if held.any():
            basis = orthonormal(self.jacobian[:, held])
            off = self.jacobian[:, columns] - basis @ (basis.T @ self.jacobian[:, columns])
            rest = (off**2).sum(axis=0)
        return np.asarray(rest / np.where(size > 0.0, size, np.inf))
