"""A damped BFGS estimate of the Hessian of the Lagrangian [Powell 1978]."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.solvers.linearisation import Linearisation

EPS = float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False)
class Bfgs:
    """matrix: (p, p) positive definite.  is_guess: whether it is a guess that no step has
    changed.
    """

    matrix: Array
    is_guess: bool

    @staticmethod
    def from_linearisation(linearisation: Linearisation, default_diagonal: Array) -> Bfgs:
        """The mean Gauss-Newton Hessian where there is one, else a guess of its diagonal (p,)."""
        mean = linearisation.curvature(np.full(len(linearisation.f), 1.0 / len(linearisation.f)))
        if len(mean):
            return Bfgs(mean + 1e-3 * np.diag(np.diag(mean)), is_guess=False)
        return Bfgs(np.diag(default_diagonal), is_guess=True)

    def update(
        self, step: Array, before: Linearisation, after: Linearisation, mu: Array, lam: Array
    ) -> Bfgs:
        """With the change of the Lagrangian's gradient over the step s, same multipliers."""
        q = (after.jacobian - before.jacobian).T @ mu + (after.normal - before.normal).T @ lam
        length = float(step @ step)
        if length == 0.0 or not np.all(np.isfinite(q)):
            return self
        matrix = self.matrix
        if self.is_guess and q @ step > 0:  # size of the first guess [Nocedal and Wright, eq. 6.20]
            guess = np.diag(matrix)
            matrix = float(q @ (q / guess)) / float(q @ step) * matrix
        bs = matrix @ step
        curve = float(step @ bs)
        if curve <= 0.0:
            return self
        if float(q @ step) < 0.2 * curve:  # Powell's damping
            share = 0.8 * curve / (curve - float(q @ step))
            q = share * q + (1.0 - share) * bs
        bs, q = bs / np.sqrt(curve), q / np.sqrt(float(q @ step))  # first, against overflow
        new = matrix - np.outer(bs, bs) + np.outer(q, q)
        new = 0.5 * (new + new.T)
        if not is_positive_definite(new):  # by rounding, of entries of many sizes
            new = np.diag(np.maximum(np.diag(new), EPS * np.diag(matrix)))
        return Bfgs(new, is_guess=False)


def is_positive_definite(matrix: Array) -> bool:
    """Whether a symmetric matrix has a Cholesky factor; also where it holds no numbers."""
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return not bool(np.all(np.isfinite(matrix)))
    return True
