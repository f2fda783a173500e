"""What the calibration's own poses say of scores: what the model lacks is no noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.judging.watching.rows import Both, Rows
from minimax_cal.solvers.least_squares import solve_normal

SAMPLES = 200  # of the calibration's own poses, as many at a time as are new
TINY = 1e-300  # in place of a zero


@dataclass(frozen=True, eq=False)
class Own:
    """The calibration's own poses, as new ones would be seen.

    rows: about the calibration itself.  foot: (m, 3f) errors of the reflectors on the foot at each
    pose, in units of noise, NaN where unseen.
    """

    rows: Both
    foot: Array

    @cached_property
    def single(self) -> Array:
        """(2,) share of the coordinates that so many independent ones would be [Box 1954].

        Points of a pose err together: (tr C)^2 / tr C^2 of the covariance C of a pose's errors,
        without bias from the number of poses.
        """
        return np.array([self.single_of(rows) for rows in (self.rows.noise, self.rows.alike)])

    @staticmethod
    def single_of(rows: Rows) -> float:
        """Of rows weighed one way."""
        m, r, _ = rows.half.shape
        error = rows.error[: m * r].reshape(m, r)
        square = (error**2).sum(axis=1)
        pairs = float(((error.T @ error) ** 2).sum() - (square**2).sum()) / (m * (m - 1))
        many = float(square.mean()) ** 2 / max(pairs, TINY)
        return float(min(many * m / (rows.count - rows.foot), 1.0))

    def spread(self, columns: Array, poses: int, seed: int) -> Array:
        """(2, c) by how much scores spread more than noises say, in samples of so many poses."""
        return np.array(
            [
                self.spread_of(rows, columns, poses, np.random.default_rng(seed))
                for rows in (self.rows.noise, self.rows.alike)
            ]
        )

    def spread_of(self, rows: Rows, columns: Array, poses: int, rng: np.random.Generator) -> Array:
        """(c,) of rows weighed one way."""
        whole, counts = self.samples(rows, columns, poses, rng)
        c, free = len(columns), int(rows.active.sum())
        q = whole.shape[-1] - c - 1  # what is free, and what was not known
        kept, rest = whole[:, :q, :q], whole[:, :q, q:]
        left = whole[:, q:, q:] - np.swapaxes(rest, 1, 2) @ solve_normal(kept, rest)
        score, size = left[:, :c, c], np.einsum("dcc->dc", left)[:, :c]
        dof = np.maximum(counts - free - 1.0, 1.0)[:, None]
        square = score**2 / np.where(size > 0.0, size, np.inf)
        noise = np.maximum((left[:, c, c, None] - square) / dof, 1.0)
        return np.asarray(np.maximum(np.sqrt((square / noise).mean(axis=0)), 1.0))

    def samples(
        self, rows: Rows, columns: Array, poses: int, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Products as of `Rows.by_pose`: (s, q, q), and coordinates: (s,), of samples.

        The prior of what was not known is among them, and the foot as these poses see it.
        """
        gram, counts = rows.by_pose(columns)
        drawn = np.zeros((SAMPLES, len(gram)))
        for row in drawn:
            row[rng.permutation(len(gram))[: min(poses, len(gram) // 2)]] = 1.0
        whole = np.tensordot(drawn, gram, 1)
        free = int(rows.active.sum())
        prior = np.arange(free, free + rows.latent.shape[1])
        whole[:, prior, prior] += 1.0
        seen = np.isfinite(self.foot)
        error = drawn @ np.where(seen, self.foot, 0.0) / np.maximum(drawn @ seen, 1.0)
        slope = rows.columns(columns)[rows.pose < 0]
        slopes = np.broadcast_to(slope, (SAMPLES, *slope.shape))
        foot = np.concatenate([slopes, error[..., None]], axis=2)
        return whole + np.swapaxes(foot, 1, 2) @ foot, drawn @ counts + rows.foot
