"""How large random factors of a linear problem are: variances of groups of them, and the noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array

MAX_ROUNDS = 60
VARIANCE_TOLERANCE = 1e-3  # relative change of every variance in the last round
MIN_VARIANCE, MAX_VARIANCE = 1e-10, 1e6  # of a factor, the first of the noise too
MIN_DOF = 1e-12  # of a factor


@dataclass(frozen=True, eq=False)
class Components:
    """noise: variance of a number.  variance: (g,) of each group's factors.

    mean: (c,) of the factors, given the data.  moment: (c, c) mean of their products, given the
    data.
    """

    noise: float
    variance: Array
    mean: Array
    moment: Array


def fit_components(
    gram: Array, gradient: Array, square: float, dof: int, group: Array
) -> Components:
    """Restricted maximum likelihood by its fixed point [Harville 1977].

    gram: (c, c) products of the factors' columns, parameters taken out.  gradient: (c,) their
    products with the errors.  square: of the errors.  dof: numbers less parameters.  group: (c,)
    whose factors share a variance.
    """
    variance, noise = np.ones(int(group.max(initial=-1)) + 1), max(square / dof, MIN_VARIANCE)
    for _ in range(MAX_ROUNDS):
        before = np.append(variance, noise)
        cover = np.linalg.inv(gram / noise + np.diag(1.0 / variance[group]))
        mean = cover @ gradient / noise
        told = np.maximum(1.0 - np.diag(cover) / variance[group], 0.0)
        one = np.bincount(group, mean**2) / (np.bincount(group, told) + MIN_DOF)
        left = square - 2.0 * mean @ gradient + mean @ gram @ mean
        noise = max(left / max(dof - told.sum(), 1.0), MIN_VARIANCE)
        variance = np.clip(one, MIN_VARIANCE, MAX_VARIANCE)
        if np.all(np.abs(np.log(np.append(variance, noise) / before)) < VARIANCE_TOLERANCE):
            break
    return Components(float(noise), variance, mean, cover + np.outer(mean, mean))
