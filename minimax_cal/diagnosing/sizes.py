"""Priors of effects, of mean zero and of a size that the data tell themselves.

Where poses cover half of a joint's sweep, one and two waves a turn are nearly what geometry does
there.  Least squares then makes them large against each other, and new poses are met worse than by
geometry alone.  So an effect of several parameters has a Gaussian prior: all of its parameters are
as likely to move the points far, and how far is what makes the data likeliest, found by expectation
and maximisation [Dempster, Laird, Rubin 1977].  What the data tell by themselves it leaves alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.fitting.uncertainty import Linearised
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.solvers.least_squares import solve_normal

RIDGE = 1e-12  # of a unit field: what nothing tells stays finite
ROUNDS = 20  # of expectation and maximisation


def unsized(terms: Sequence[Term], scene: Scene) -> list[slice]:
    """The parameters of each effect of several, among all, that no prior or sign holds."""
    out, at = [], 0
    for term in terms:
        columns = term.columns(scene)
        own = slice(at, at + len(columns.names))
        at = own.stop
        loose = int((~EFFECTS[term.effect].upward(columns)).sum())  # they come last
        if loose > 1 and not len(columns.ridge) and not term.frees_frames:
            out.append(slice(own.stop - loose, own.stop))
    return out


def weights_of(poses: Linearised, values: Array, parts: Sequence[slice]) -> Array:
    """(e,) weights of the priors, beside squares of errors [m^2 per unit^2]; 0 outside the parts.

    poses: linear at a state with effects of values (e,), the last of its parameters, all free.
    """
    weight = np.zeros(len(values))
    if not parts:
        return weight
    gram, pull = poses.normal_matrix, poses.gradient + poses.prior * poses.off
    p = len(gram) - len(values)
    across = solve_normal(gram[:p, :p], gram[:p, p:])
    left = gram[p:, p:] - gram[p:, :p] @ across  # what geometry leaves of the effects
    size = np.sqrt(np.diag(gram)[p:])  # how far a unit moves all points
    left = left / np.outer(size, size)
    told = (pull[p:] - across.T @ pull[:p]) / size + left @ (values * size)
    square = float((poses.error**2).sum())
    least = square - float(pull @ solve_normal(gram, pull[:, None])[:, 0])
    variance = least / max(3 * int(np.count_nonzero(poses.seen)) - len(gram), 1)
    for part in parts:
        weight[part] = variance / square  # as if each might explain all that is left
    free = np.isin(np.arange(len(weight)), np.concatenate([np.r_[part] for part in parts]))
    left += RIDGE * np.eye(len(left))
    # the others, alone or with priors of their own, are projected out once
    across = solve_normal(left[np.ix_(~free, ~free)], left[np.ix_(~free, free)])
    told = told[free] - across.T @ told[~free]
    left = left[np.ix_(free, free)] - left[np.ix_(free, ~free)] @ across
    for _ in range(ROUNDS):
        covariance = np.linalg.inv(left + np.diag(weight[free]))
        second = np.zeros(len(weight))
        second[free] = (covariance @ told) ** 2 + variance * np.diag(covariance)
        for part in parts:
            weight[part] = variance / np.mean(second[part])
    return np.asarray(weight * size**2)
