"""What measuring a pose would tell about the parameters of a cell, before it is measured.

The information of a pose is J'V^-1 J over the identifiable parameters, all targets seen there
together.  V = diag(s^2) + t^2 S S': the instrument's noise s, growing with range, and the joints'
jitter t, S being the motion of the targets per unit of each joint (as in `noise`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.record_fields import FieldFormat
from minimax_cal.fitting import identification
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, build_measurements_at_rest
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.effects.table import Fitted
from minimax_cal.modelling.effects.table import parse_effect_terms as terms_of
from minimax_cal.modelling.effects_in_model import build_model_of_cell
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.planning.plan_figures import MICROMETRE_FACT
from minimax_cal.robots.transforms import translation

MAX_POSES_FOR_IDENTIFICATION = 1000  # poses that tell which parameters are identifiable
POSES_PER_JACOBIAN_CHUNK = 2048  # poses whose Jacobian of all parameters is kept at a time


@dataclass(frozen=True)
class PlanningNoise:
    """Noise of each coordinate, its growth with range, and jitter of each joint [m, -, rad or m].

    The defaults are a laser tracker's data sheet, and an arm that stops to 0.01 mrad.
    """

    noise: Annotated[float, MICROMETRE_FACT] = 10e-6
    per_metre: Annotated[float, FieldFormat(key="noise_um_per_m", scale=1e6)] = 2.5e-6
    jitter: Annotated[float, FieldFormat(scale=1e6, unit="urad")] = 10e-6


@dataclass(frozen=True, eq=False)
class PoseInformation:
    """A cell and what poses can tell about it.

    is_identifiable: (p,) parameters that these poses identify; f of them.  names: of those.
    parameter_scale: (f,) root mean square motion of a target per unit of each [m per unit]: every
    matrix here is in parameters times their scale, which are metres.
    """

    cell: Cell
    noise: PlanningNoise
    is_identifiable: Array
    names: tuple[str, ...]
    parameter_scale: Array

    def whitened_jacobian(self, measurements: Measurements, visible_targets: Array) -> Array:
        """(m, 3k, f) Jacobian over noise, 0 where a target is not seen.  visible_targets: (m,
        k).
        """
        out = [
            self.whiten_jacobian_chunk(
                measurements.take(
                    np.arange(start, min(start + POSES_PER_JACOBIAN_CHUNK, measurements.poses))
                ),
                visible_targets[start : start + POSES_PER_JACOBIAN_CHUNK],
            )
            for start in range(0, measurements.poses, POSES_PER_JACOBIAN_CHUNK)
        ]
        return (
            np.concatenate(out)
            if out
            else np.zeros((0, 3 * visible_targets.shape[1], len(self.names)))
        )

    def whiten_jacobian_chunk(self, measurements: Measurements, visible_targets: Array) -> Array:
        """`whitened_jacobian` of few poses."""
        k = visible_targets.shape[1]
        jacobian, scene = target_derivatives_and_posed_arm(self.cell, measurements)
        told = np.repeat(visible_targets, 3, axis=1)
        swing = np.moveaxis(scene.jacobian, (3, 1, 2, 0), (0, 1, 2, 3))
        swing = swing.reshape(len(visible_targets), 3 * k, -1) * told[..., None]
        away = np.linalg.norm(scene.points - scene.instrument[:, None], axis=1).T
        spread = self.noise.noise + self.noise.per_metre * away
        cov = self.noise.jitter**2 * swing @ np.swapaxes(swing, 1, 2)
        cov[:, np.arange(3 * k), np.arange(3 * k)] += np.repeat(spread**2, 3, axis=1)
        scaled = (
            jacobian.reshape(len(visible_targets), 3 * k, -1)[..., self.is_identifiable]
            / self.parameter_scale
        )
        return np.asarray(np.linalg.solve(np.linalg.cholesky(cov), scaled * told[..., None]))

    def whitened_jacobian_of_new_poses(self, q: Array, visible_targets: Array) -> Array:
        """`whitened_jacobian` of poses that may be measured.  q: (m, n)."""
        return self.whitened_jacobian(
            build_measurements_at_rest(q, self.cell.target_names, self.cell.robot), visible_targets
        )

    def measured_information(self, measurements: Measurements) -> Array:
        """(f, f) information of poses that were measured."""
        chosen = [self.cell.target_names.index(name) for name in measurements.target_names]
        seen = np.zeros((measurements.poses, len(self.cell.target_names)), dtype=bool)
        seen[:, chosen] = measurements.seen
        flat = self.whitened_jacobian(measurements, seen).reshape(-1, len(self.names))
        return np.asarray(flat.T @ flat)

    def scaled_jacobian(self, q: Array, visible_targets: Array) -> Array:
        """(N, f) of every coordinate that is seen at poses (m, n), without noise: no unit."""
        moved, _ = target_derivatives_and_posed_arm(
            self.cell, build_measurements_at_rest(q, self.cell.target_names, self.cell.robot)
        )
        return np.asarray(
            moved[visible_targets].reshape(-1, moved.shape[-1])[:, self.is_identifiable]
            / self.parameter_scale
        )

    def position_prediction_matrices(self, q: Array) -> Array:
        """B (m, 3k, f): tr(B C B') is a pose's variance of position, the mean of its targets."""
        moved, _ = target_derivatives_and_posed_arm(
            self.cell, build_measurements_at_rest(q, self.cell.target_names, self.cell.robot)
        )
        k = moved.shape[1]
        flat = moved.reshape(len(q), 3 * k, -1)[..., self.is_identifiable]
        return np.asarray(flat / self.parameter_scale / np.sqrt(k))


def target_derivatives_and_posed_arm(
    cell: Cell, measurements: Measurements
) -> tuple[Array, PosedArm]:
    """Derivative of every target by every parameter, (m, k, 3, p) in base axes, and the scene."""
    model, state = build_model_of_cell(cell, measurements)
    jacobian = model.point_jacobian(state)
    return np.asarray(jacobian), cell.pose_arm(measurements)


def build_pose_information(
    cell: Cell, noise: PlanningNoise, q: Array, visible_targets: Array
) -> PoseInformation:
    """What poses (m, n) can tell of a cell.  visible_targets: (m, k).

    Parameters are identified as in a calibration; of many poses the first thousand tell which.
    """
    q, visible_targets = (
        q[:MAX_POSES_FOR_IDENTIFICATION],
        visible_targets[:MAX_POSES_FOR_IDENTIFICATION],
    )
    robot = cell.robot
    model, state = build_model_of_cell(cell, q)
    model = replace(model, weight=visible_targets.T.astype(float))
    names = model.names
    plain = build_point_model(robot, build_measurements_at_rest(q, cell.target_names, robot))
    order = identification.redundancy_drop_order(robot, plain.names)
    found = identification.identify_point_parameters(
        model,
        state,
        np.concatenate([np.arange(names.geometric_count, names.parameter_count), order]),
        is_allowed=np.ones(names.parameter_count, dtype=bool),
        reference_model=identification.build_reference_model(robot, plain),
        has_prior=np.zeros(names.parameter_count, dtype=bool),
    )
    active = found.active
    kept = tuple(name for name, free in zip(names.all_names, active, strict=True) if free)
    return PoseInformation(cell, noise, active, kept, found.scale[active])


def add_effects_to_cell(cell: Cell, effect_texts: Sequence[str], q: Array) -> Cell:
    """The cell with further effects whose size is not known yet; their laws are as at poses (m, n).

    Raises OptionError.
    """
    known = [term.label for term in cell.effects.terms]
    scene = cell.pose_arm(
        build_measurements_at_rest(q[:MAX_POSES_FOR_IDENTIFICATION], cell.target_names, cell.robot)
    )
    terms = [term for term in terms_of(scene, effect_texts) if term.label not in known]
    nothing = [np.zeros(len(term.columns(scene).names)) for term in terms]
    both = Fitted((*cell.effects.terms, *terms), (*cell.effects.values, *nothing))
    return replace(cell, effects=both)


def place_measurement_frame(cell: Cell, tracker_position: Array) -> Cell:
    """A cell whose measurement frame has the base's axes and its origin at a place (3,) [m]."""
    return Cell(
        cell.robot,
        translation(*-tracker_position),
        cell.target_names,
        cell.target_positions,
        cell.effects,
    )


def target_positions_on_circle(target_count: int, radius: float = 0.1) -> Array:
    """(k, 3) targets on a circle about the flange's axis, as `simulate` has them [m]."""
    angle = 2.0 * np.pi * np.arange(target_count) / target_count
    flat = np.stack([np.cos(angle), np.sin(angle), np.full(target_count, 0.3)], axis=1)
    return np.asarray(radius * flat)


def default_tracker_position(cell: Cell, distance: float) -> Array:
    """(3,) a place before the arm as it points at joint values 0, at half its reach's height [m].

    Where it points up, along the base's x.
    """
    up = cell.robot.up
    flange = cell.robot.pose(np.zeros((1, cell.robot.joints)))[0, :3, 3]
    level = flange - up * (up @ flange)
    if np.linalg.norm(level) < 0.05 * cell.robot.reach():
        level = np.eye(3)[0] - up * up[0]
    if np.linalg.norm(level) < 0.1:
        level = np.eye(3)[1] - up * up[1]
    return np.asarray(distance * level / np.linalg.norm(level) + 0.5 * cell.robot.reach() * up)
