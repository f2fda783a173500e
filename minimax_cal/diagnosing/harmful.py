"""Effects with which poses far from all others are met worse: fitted, but not to be relied on.

An effect may help between the poses of a fit and harm beyond them, where it stands for a law that
it is not.  Whole parts of the poses (`grouping.parts`) that are left out in turn tell it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.diagnosing.joint import Joint
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import parts
from minimax_cal.modelling.effects.table import Term
from minimax_cal.solvers.least_squares import solve_normal

HARM = 1.05  # times the RMS distance at the parts: what an effect may cost them


def harmful(fit: Joint, effects: Sequence[Sequence[Term]]) -> int | None:
    """Number of the effect that harms the parts most, None where none does.

    effects: those of the fit, in its order.
    """
    folds = fit.spared([part.rows for part in parts(fit.study.data)])
    if not folds or not effects:
        return None
    own = owned(fit, effects)
    nothing = np.zeros_like(own[0])
    squares = parts_without(fit, folds, [nothing, *own])
    best = int(np.argmin(squares[1:]))
    return best if HARM**2 * squares[1:][best] < squares[0] else None


def owned(fit: Joint, effects: Sequence[Sequence[Term]]) -> list[Array]:
    """(p,) of each effect: True for its parameters, of those that a fit is free to choose."""
    scene, active = fit.study.scene, fit.estimator.model.active
    counts = [sum(len(term.columns(scene).names) for term in terms) for terms in effects]
    ends = len(active) - sum(counts) + np.cumsum(counts)
    number = np.arange(len(active))
    return [
        np.asarray((end - count <= number) & (number < end))[active]
        for count, end in zip(counts, ends, strict=True)
    ]


def parts_without(fit: Joint, folds: Sequence[Array], effects: Sequence[Array]) -> Array:
    """(e,) sums of squares at folds left out in turn, the fit made without each effect [m^2].

    Linear where the fit ended.  folds: masks (m,) of poses.  effects: as `owned`.
    """
    poses = fit.poses
    names = fit.model.names
    value = np.concatenate([np.zeros(names.geometric), fit.state.effects])
    value = value[fit.estimator.model.active]
    squares = np.zeros(len(effects))
    for mine in folds:
        gram, pull = poses.sums_of(mine)
        rest, aim = poses.bread - gram, poses.pull - pull + poses.prior * poses.off
        error, jacobian = poses.error[mine], poses.jacobian[mine]
        for number, gone in enumerate(effects):
            kept, step = ~gone, np.where(gone, -value, 0.0)
            aside = aim[kept] - rest[np.ix_(kept, gone)] @ step[gone]
            step[kept] = solve_normal(rest[np.ix_(kept, kept)], aside[:, None])[:, 0]
            squares[number] += float(((error - jacobian @ step) ** 2).sum())
    return squares
