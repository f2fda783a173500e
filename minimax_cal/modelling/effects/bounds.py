"""Between which values the parameters of effects must lie, in every fit that has them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import EFFECTS, Term

ROUNDING = 1e-9  # of a parameter's largest value
FARTHEST = 0.02  # of the reach: no effect of a body moves a point farther


def bounds(scene: Scene, terms: Sequence[Term]) -> Array:
    """(e, 2) between which the parameters of effects must lie: of compliances not below 0."""
    out = [np.zeros((0, 2))]
    for term in terms:
        columns = term.columns(scene)
        if len(columns.ridge):  # a prior holds them
            out.append(np.full((len(columns.names), 2), np.inf) * [-1.0, 1.0])
            continue
        fields = columns.displacement(scene)
        size = np.sqrt((fields**2).sum(axis=2)).max(axis=(1, 2))
        most = FARTHEST * scene.robot.reach() / np.maximum(size, 1e-300)
        least = np.where(EFFECTS[term.effect].upward(columns), 0.0, -most)
        out.append(np.stack([least, most], axis=1))
    return np.concatenate(out)


def at_bounds(values: Array, allowed: Array) -> Array:
    """(e,) True for parameters that lie at one of their bounds (e, 2), but for rounding."""
    return np.asarray(near_bounds(values, allowed).any(axis=1))


def settled(values: Array, allowed: Array) -> Array:
    """(e,) the values, those at one of their bounds (e, 2) exactly there."""
    near = near_bounds(values, allowed)
    return np.where(near[:, 0], allowed[:, 0], np.where(near[:, 1], allowed[:, 1], values))


def near_bounds(values: Array, allowed: Array) -> Array:
    """(e, 2) which of its bounds each parameter is at, or beyond."""
    most = np.abs(allowed).max(axis=1, keepdims=True)
    near = ROUNDING * np.where(np.isfinite(most), most, 0.0)
    return np.asarray((values[:, None] - allowed) * [1.0, -1.0] <= near)
