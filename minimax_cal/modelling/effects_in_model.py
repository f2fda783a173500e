"""Geometry and effects in one model: the effects' fields become columns beside the geometry's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, build_measurements_at_rest
from minimax_cal.modelling.effects.scene import PRIOR_REFERENCE_ERROR, PosedArm
from minimax_cal.modelling.effects.table import (
    Fitted,
    Term,
    effect_displacement_fields,
    effect_parameter_names_and_units,
    effect_prior_weights,
    session_frame_terms,
)
from minimax_cal.modelling.nearby_fit import fit_within_bounds_from_start
from minimax_cal.modelling.parameters import ParameterNames, ParameterValues
from minimax_cal.modelling.point_model import GaussianPrior, PointModel, build_point_model
from minimax_cal.robots.robot import Robot


def pose_arm_at_values(
    robot: Robot, data: Measurements, model: PointModel, state: ParameterValues
) -> PosedArm:
    """What effects look at, with the geometry of a state."""
    base = (state.rotation, state.origin)
    return PosedArm.at_measured_poses(
        robot.with_mdh(state.mdh), data, base, state.target_positions, model.q
    )


def split_values_by_effect(terms: Sequence[Term], posed_arm: PosedArm, values: Array) -> Fitted:
    """Effects with their values from one array of all parameters."""
    sizes = [len(term.columns(posed_arm).names) for term in terms]
    return Fitted(tuple(terms), tuple(np.split(values, np.cumsum(sizes)[:-1])) if terms else ())


class ModelAtValues(NamedTuple):
    """A model, and the values of its parameters."""

    model: PointModel
    values: ParameterValues


def extend_model_with_effects(
    model: PointModel,
    robot: Robot,
    data: Measurements,
    state: ParameterValues,
    terms: Sequence[Term],
) -> ModelAtValues:
    """The geometric model with the effects' columns at a state, and the state with their values.

    Parameters that the state does not hold yet, the last ones, are zero.  Columns are constant;
    what finite turns add to them is taken from the state's values, so that a second pass at the fit
    of the first is exact to second order.
    """
    scene = pose_arm_at_values(robot, data, model, state)
    fields = effect_displacement_fields(terms, scene)
    names, _ = effect_parameter_names_and_units(terms, scene)
    values = np.pad(state.effects, (0, len(names) - len(state.effects)))
    moved = np.zeros((0, 0, 0))
    if values.any():
        exact = split_values_by_effect(terms, scene, values).displaced_targets(scene)
        moved = exact - scene.points - np.tensordot(values, fields, 1)
    count, more = model.names.geometric_count, len(names)
    prior, ridge = model.prior, effect_prior_weights(terms, scene)
    return ModelAtValues(
        replace(
            model,
            names=replace(model.names, effects=names),
            fields=fields,
            moved=moved,
            active=np.concatenate([model.active[:count], np.ones(more, dtype=bool)]),
            prior=GaussianPrior(
                np.concatenate([prior.mean[:count], np.zeros(more)]),
                np.concatenate([prior.weight[:count], ridge]),
                np.concatenate(
                    [np.zeros(count), np.where(ridge > 0.0, PRIOR_REFERENCE_ERROR**2, 0.0)]
                ),
            ),
        ),
        replace(state, effects=values),
    )


def build_model_of_cell(cell: Cell, poses: Measurements | Array) -> ModelAtValues:
    """The model of a cell, effects included, where nothing was measured, and its state.

    poses: (m, n) joint values [rad, m], or measurements, whose columns (order, payload ...) count.
    """
    if not isinstance(poses, Measurements):
        q = np.atleast_2d(np.asarray(poses, dtype=float))
        poses = build_measurements_at_rest(q, cell.target_names, cell.robot)
    names = ParameterNames.for_robot(cell.robot, cell.target_names)
    nothing = np.zeros(names.parameter_count)
    model = PointModel(
        q=cell.robot.chain_joint_values(poses.q),
        prismatic=cell.robot.prismatic,
        y=np.zeros((len(names.target_names), 3, poses.poses)),
        weight=np.ones((len(names.target_names), poses.poses)),
        names=names,
        active=np.ones(names.parameter_count, dtype=bool),
        prior=GaussianPrior(nothing, nothing),
    )
    if not cell.effects.terms:
        return ModelAtValues(model, cell.parameter_values)
    hidden = cell.align_to_first_session(replace(poses, target_names=cell.target_names))
    return extend_model_with_effects(
        model, cell.robot, hidden, cell.parameter_values, cell.effects.terms
    )


def fit_geometry_nearby(
    robot: Robot,
    data: Measurements,
    start: ParameterValues,
    active: Array,
    prior_weight: float | Array = 0.0,
) -> ModelAtValues:
    """Geometry alone by least squares, from a fit that is near, and where it ends.

    active: (p,) the geometric parameters that are free; so are the frames of further sessions.
    prior_weight: (p,) of the drawing as a prior.
    """
    model, begin = (
        build_point_model(robot, data).with_active(active),
        replace(start, effects=np.zeros(0)),
    )
    model = model.with_prior(replace(model.prior, weight=model.prior.weight + prior_weight))
    if free := session_frame_terms(data.frames):
        model, begin = extend_model_with_effects(model, robot, data, begin, free)
    return ModelAtValues(model, fit_within_bounds_from_start(model, begin).x.take(np.array(0)))
