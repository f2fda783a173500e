"""Geometry and effects in one model: the effects' fields become columns beside the geometry's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, still
from minimax_cal.modelling.effects.scene import BESIDE, Scene
from minimax_cal.modelling.effects.table import (
    Fitted,
    Term,
    fields_of,
    names_of,
    of_sessions,
    ridge_of,
)
from minimax_cal.modelling.model import Model, Prior, model_of
from minimax_cal.modelling.near import nearby
from minimax_cal.modelling.parameters import Names, State
from minimax_cal.robots.robot import Robot


def scene_of(robot: Robot, data: Measurements, model: Model, state: State) -> Scene:
    """What effects look at, with the geometry of a state."""
    base = (state.rotation, state.origin)
    return Scene.of(robot.with_mdh(state.mdh), data, base, state.target_positions, model.q)


def fitted(terms: Sequence[Term], scene: Scene, values: Array) -> Fitted:
    """Effects with their values from one array of all parameters."""
    sizes = [len(term.columns(scene).names) for term in terms]
    return Fitted(tuple(terms), tuple(np.split(values, np.cumsum(sizes)[:-1])) if terms else ())


def extended(
    model: Model, robot: Robot, data: Measurements, state: State, terms: Sequence[Term]
) -> tuple[Model, State]:
    """The geometric model with the effects' columns at a state, and the state with their values.

    Parameters that the state does not hold yet, the last ones, are zero.  Columns are constant;
    what finite turns add to them is taken from the state's values, so that a second pass at the fit
    of the first is exact to second order.
    """
    scene = scene_of(robot, data, model, state)
    fields = fields_of(terms, scene)
    names, _ = names_of(terms, scene)
    values = np.pad(state.effects, (0, len(names) - len(state.effects)))
    moved = np.zeros((0, 0, 0))
    if values.any():
        exact = fitted(terms, scene, values).points(scene)
        moved = exact - scene.points - np.tensordot(values, fields, 1)
    count, more = model.names.geometric, len(names)
    prior, ridge = model.prior, ridge_of(terms, scene)
    return replace(
        model,
        names=replace(model.names, effects=names),
        fields=fields,
        moved=moved,
        active=np.concatenate([model.active[:count], np.ones(more, dtype=bool)]),
        prior=Prior(
            np.concatenate([prior.mean[:count], np.zeros(more)]),
            np.concatenate([prior.weight[:count], ridge]),
            np.concatenate([np.zeros(count), np.where(ridge > 0.0, BESIDE**2, 0.0)]),
        ),
    ), replace(state, effects=values)


def model_at(cell: Cell, poses: Measurements | Array) -> tuple[Model, State]:
    """The model of a cell, effects included, where nothing was measured, and its state.

    poses: (m, n) joint values [rad, m], or measurements, whose columns (order, payload ...) count.
    """
    if not isinstance(poses, Measurements):
        q = np.atleast_2d(np.asarray(poses, dtype=float))
        poses = still(q, cell.target_names, cell.robot)
    names = Names.of(cell.robot, cell.target_names)
    nothing = np.zeros(names.count)
    model = Model(
        q=cell.robot.turned(poses.q),
        prismatic=cell.robot.prismatic,
        y=np.zeros((len(names.target_names), 3, poses.poses)),
        weight=np.ones((len(names.target_names), poses.poses)),
        names=names,
        active=np.ones(names.count, dtype=bool),
        prior=Prior(nothing, nothing),
    )
    if not cell.effects.terms:
        return model, cell.state
    hidden = cell.placed(replace(poses, target_names=cell.target_names))
    return extended(model, cell.robot, hidden, cell.state, cell.effects.terms)


def refitted(
    robot: Robot, data: Measurements, start: State, active: Array, weight: float | Array = 0.0
) -> tuple[Model, State]:
    """Geometry alone by least squares, from a fit that is near, and where it ends.

    active: (p,) the geometric parameters that are free; so are the frames of further sessions.
    weight: (p,) of the drawing as a prior.
    """
    model, begin = model_of(robot, data).only(active), replace(start, effects=np.zeros(0))
    model = model.with_prior(replace(model.prior, weight=model.prior.weight + weight))
    if free := of_sessions(data.frames):
        model, begin = extended(model, robot, data, begin, free)
    return model, nearby(model, begin).x.take(np.array(0))
