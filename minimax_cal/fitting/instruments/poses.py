"""Whole flange poses as virtual reflectors, and the calibration from them.

Four reflectors at the corners of a regular tetrahedron say exactly what a pose says: their sum of
squared errors is 4 (|e|^2 + lever^2 |w|^2) for an error e of its position and a small turn w.  The
lever is the ratio of the instrument's linear and angular noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.fitting import identify
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit, Parameter
from minimax_cal.fitting.instruments.data import RelativeData
from minimax_cal.fitting.instruments.options import (
    Progress,
    RelativeOptions,
    sigmas_of,
    wishes,
)
from minimax_cal.fitting.instruments.split import before_and_after
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, pose_to_dict
from minimax_cal.modelling.model import Model, model_of
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.kinematics import hat, rotation_vector
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import nearest_rotation, transform
from minimax_cal.solvers.least_squares import solve_normal

LEVER = 0.1  # where nothing tells the ratio of the noises [m]
TOOL = ("tool_x", "tool_y", "tool_z", "tool_rx", "tool_ry", "tool_rz")
CORNERS = {  # of unit distance from their centre
    3: np.stack([[np.cos(a), np.sin(a), 0.0] for a in 2.0 * np.pi * np.arange(3) / 3.0]),
    4: np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3.0),
}


def spots_of(lever: float, count: int = 4) -> Array:
    """Virtual reflectors in the frame of the pose: (count, 3) [m]; their centre is its origin.

    Their RMS distance from it is sqrt(3/2) lever.  Three lie in the plane z = 0 and weigh a turn
    about its normal twice as much as one in the plane; four weigh all turns alike.
    """
    if count not in CORNERS:
        raise OptionError(f"{count} virtual reflectors: choose 3 or 4")
    if not (np.isfinite(lever) and lever > 0.0):
        raise OptionError(f"lever {lever:g} m: must be positive and finite")
    return np.asarray(np.sqrt(1.5) * lever * CORNERS[count])


def poses_as_targets(data: RelativeData, lever: float = LEVER, count: int = 4) -> Measurements:
    """The poses as virtual reflectors smr1 ..., for `calibrate`.  lever: [m].  count: 3 or 4."""
    turned = np.einsum("mij,kj->mki", data.pose[:, :3, :3], spots_of(lever, count))
    names = tuple(f"smr{i + 1}" for i in range(count))
    return replace(data.at, y=turned + data.pose[:, None, :3, 3], target_names=names)


def lever_of(data: RelativeData, lever: float | None) -> tuple[float, str]:
    """The lever and where it comes from.  lever: asked for [m], None where not."""
    if lever is not None:
        return lever, "as given"
    columns = data.at.columns
    if {"u95", "rotation_u95"} <= set(columns):
        ratio = np.nanmedian(columns["u95"] / columns["rotation_u95"])
        if np.isfinite(ratio) and ratio > 0.0:
            return float(ratio), "typical u95_mm over rotation_u95_rad"
    return LEVER, "by default; give the lever, the ratio of linear and angular noise"


def tool_of(cell: Cell, spots: Array) -> Array:
    """Pose (4, 4) of the measured frame in the flange that fits the reflectors best [m]."""
    centre = cell.target_positions.mean(axis=0)
    return transform(nearest_rotation((cell.target_positions - centre).T @ spots), centre)


def pose_errors(cell: Cell, tool: Array, data: RelativeData) -> tuple[Array, Array]:
    """Measured minus predicted positions (m, 3) [m], and angles between orientations (m,) [rad]."""
    pose = cell.base @ cell.robot.pose(data.at.q) @ tool
    turn = np.swapaxes(pose[:, :3, :3], 1, 2) @ data.pose[:, :3, :3]
    return data.pose[:, :3, 3] - pose[:, :3, 3], np.asarray(Rotation.from_matrix(turn).magnitude())


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A calibration from virtual reflectors, as one from poses.

    fit: what `calibrate` found.  train: the virtual reflectors of the training poses.
    spots: (k, 3) their places in the frame of the pose [m].  model, state: at its solution.
    tool, nominal_tool: (4, 4), of the calibrated and of the nominal arm.
    covariance: (p, p) of the model's parameters, NaN where not identified [SI].
    """

    fit: Fit
    train: Measurements
    spots: Array
    model: Model
    state: State
    tool: Array
    nominal_tool: Array
    covariance: Array


def fit_poses(
    robot: Robot, data: RelativeData, lever: float, options: RelativeOptions, progress: Progress
) -> PoseFit:
    """The calibration of the virtual reflectors.  Raises CalibrationError."""
    spots, targets = spots_of(lever), poses_as_targets(data, lever)
    shared = ("holdout", "seed", "fix", "free", "priors", "method", "resolution")
    chosen: dict[str, Any] = {name: getattr(options, name) for name in shared}
    try:
        fit = calibrate(
            robot, targets, objective="sum", simulated=True, progress=progress, **chosen
        )
    except DataError as wrong:  # the user's columns have other names
        raise DataError(str(wrong).replace("smr1_x_", "flange_x_")) from wrong
    train, state = targets.take(~fit.held), fit.cell.state
    model = model_of(fit.before.robot, train).only(fit.identification.active)
    tool, nominal_tool = tool_of(fit.cell, spots), tool_of(fit.before, spots)
    sigma = np.pad(sigmas_of(model.names, options), (0, model.names.count - 5 * robot.joints),
                   constant_values=np.inf)  # fmt: skip
    covariance = covariance_of(model, state, sigma)
    return PoseFit(fit, train, spots, model, state, tool, nominal_tool, covariance)


def covariance_of(model: Model, state: State, sigma: Array) -> Array:
    """The covariance (p, p) of a fit to poses, NaN where not identified [SI].

    sigma: (p,) of the prior, infinite where there is none.

    The reflectors' errors are those of six numbers a pose, not of 3k: with k = 4 their covariance
    is 4 s^2 times the projector on rigid motions, s^2 being the variance of a coordinate of the
    pose.  No other motion is in the fit's slopes, so that its covariance is that of 4 s^2 I.
    """
    normal, active = model.normal(state, model.active), model.active
    dof = 6 * len(model.q) - (int(active.sum()) - (3 * len(model.y) - 6))
    variance = float(normal.cost.sum()) / max(dof, 1)
    covariance = np.full((model.names.count,) * 2, np.nan)
    gram = normal.gram.sum(axis=0) + np.diag(variance / sigma[active] ** 2)
    covariance[np.ix_(active, active)] = variance * solve_normal(gram, np.eye(len(gram)))
    return covariance


def errors_of(
    fitted: PoseFit, data: RelativeData
) -> tuple[dict[str, Array], dict[str, tuple[float, float]]]:
    """Errors of position (1, m, 3) [m], and RMS and largest turn [rad], by the keys of a result."""
    fit, held = fitted.fit, fitted.fit.held
    before, turned_before = pose_errors(fit.before, fitted.nominal_tool, data)
    after, turned_after = pose_errors(fit.cell, fitted.tool, data)
    angles = before_and_after(turned_before[None], turned_after[None], held)
    turns = {
        key: (rms(angle), float(angle.max()) if angle.size else math.nan)
        for key, angle in angles.items()
    }
    return before_and_after(before[None], after[None], held), turns


def notices_of(fitted: PoseFit) -> tuple[str, ...]:
    """Those of `calibrate`, but for what is said of poses instead."""
    again = ("outliers", "no pose is held out")
    return tuple(told for told in fitted.fit.notices if not any(words in told for words in again))


def pose_parameters(fitted: PoseFit) -> tuple[Parameter, ...]:
    """Links and base as `calibrate` tells them, and the tool instead of its reflectors."""
    names, k = fitted.model.names, len(fitted.spots)
    sigma = dict(zip(names.all, np.sqrt(np.diag(fitted.covariance)), strict=True))
    whole = "all targets moved together", "the tool"
    links = tuple(
        replace(p, sigma=float(sigma[p.name]), reason=p.reason.replace(*whole))
        for p in fitted.fit.parameters
        if p.name.rpartition("_")[0] not in names.target_names
    )
    turned = fitted.tool[:3, :3]
    arm = fitted.spots @ turned.T  # in the flange's axes
    rigid = np.concatenate([np.tile(np.eye(3), (k, 1)), -hat(arm).reshape(3 * k, 3)], axis=1)
    back = np.linalg.pinv(rigid)
    spread = back @ fitted.covariance[-3 * k :, -3 * k :] @ back.T
    before = [*fitted.nominal_tool[:3, 3], *np.zeros(3)]
    after = [*fitted.tool[:3, 3], *rotation_vector(turned @ fitted.nominal_tool[:3, :3].T)]
    told = bool(fitted.model.active[-3 * k :].all())
    return links + tuple(
        Parameter(
            name=name,
            value=float(after[i]),
            nominal=float(before[i]),
            sigma=float(np.sqrt(spread[i, i])) if told else np.nan,
            unit="m" if i < 3 else "rad",
            identifiable=told,
            reason="" if told else "same motion as links and base",
        )
        for i, name in enumerate(TOOL)
    )


def beyond_one(fitted: PoseFit, robot: Robot, options: RelativeOptions) -> tuple[str, ...]:
    """Parameters that these poses tell, and one reflector at the pose's origin would not."""
    names, origin = fitted.model.names, fitted.train.y.mean(axis=1, keepdims=True)
    model = model_of(robot, replace(fitted.train, y=origin, target_names=("smr1",)))
    rows = model.names.count - 3
    allowed, _ = wishes(names, options)
    alone = identify.identify(
        model,
        replace(fitted.state, target_positions=fitted.tool[None, :3, 3]),
        identify.drop_order(robot, model.names),
        allowed=np.append(allowed[:rows], [True] * 3),
        reference=identify.plenty_of_poses(robot, model),
        known=np.zeros(model.names.count, dtype=bool),
    )
    more = fitted.model.active[:rows] & ~alone.active[:rows]
    place = [name for name, told in zip(TOOL[:3], alone.active[rows:], strict=True) if not told]
    return (*(names.all[i] for i in np.flatnonzero(more)), *place, *TOOL[3:])


def pose_place(fitted: PoseFit, lever: float) -> dict[str, Any]:
    """For JSON: base in the measurement frame, measured frame in the flange, and the lever."""
    places = {
        "base": fitted.fit.cell.base,
        "tool": fitted.tool,
        "nominal_base": fitted.fit.before.base,
        "nominal_tool": fitted.nominal_tool,
    }
    return {name: pose_to_dict(pose) for name, pose in places.items()} | {"lever_mm": 1e3 * lever}
