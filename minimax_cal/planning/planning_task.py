"""What is to be planned: an arm in its room, what poses can tell, and what is asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError, OptionError
from minimax_cal.fitting.arm_identity import check_same_arm
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.data_slips import describe_implausible_changes
from minimax_cal.fitting.opened_results import ResultOrFile, open_result
from minimax_cal.measuring.measurement_checks import check_and_complete_joints
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import effect_displacement_fields
from minimax_cal.modelling.effects_in_model import pose_arm_at_values
from minimax_cal.modelling.error_rows import linearise_to_point_rows
from minimax_cal.modelling.parameters import (
    ParameterNames,
    ParameterValues,
    flatten_link_parameters,
    joint_zero_indices,
)
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.planning import effect_separation
from minimax_cal.planning.candidate_poses import (
    CandidatePoses,
    draw_collision_free_poses,
    find_joint_limits,
)
from minimax_cal.planning.designs.design_exchange import ExperimentPool
from minimax_cal.planning.designs.optimality_criteria import (
    DeterminantCriterion,
    LargestEigenvalueCriterion,
    LargestVarianceCriterion,
    OptimalityCriterion,
    TraceCriterion,
)
from minimax_cal.planning.effect_separation import SeparationPower, SeparationQuestion
from minimax_cal.planning.plan_options import PlanOptions
from minimax_cal.planning.pose_information import (
    PlanningNoise,
    PoseInformation,
    add_effects_to_cell,
    build_pose_information,
    default_tracker_position,
    place_measurement_frame,
    target_positions_on_circle,
)
from minimax_cal.planning.pose_visibility import (
    BODY_RADIUS_FRACTION_OF_REACH,
    ArmWorkspace,
    TrackerVisibility,
    target_normals,
)
from minimax_cal.robots.robot import Robot
from minimax_cal.selection.noise_model import Noise, estimate_noise_by_reml
from minimax_cal.solvers.status import Status

DEFAULT_TRACKER_DISTANCE = (
    3.0  # where the tracker stands unless told: so far off, or the arm's reach [m]
)
MAX_NOISE_OF_COMPUTED_DATA = 1e-7  # noise below which data were computed, not measured [m]


@dataclass(frozen=True, eq=False)
class PlanningInputs:
    """What a plan starts from.  measurement_sets: poses at hand, none or one set."""

    cell: Cell
    measurement_sets: tuple[Measurements, ...]
    noise: PlanningNoise
    notices: tuple[str, ...]


def build_planning_inputs(
    robot: Robot,
    fit: ResultOrFile,
    measurements: Measurements | str | Path,
    options: PlanOptions,
) -> PlanningInputs:
    """Cell, poses at hand and noise.  Raises CalibrationError."""
    notices: list[str] = []
    own: tuple[Measurements, ...] = ()
    cells: list[Cell] = []
    if fit:
        known = open_result(fit)
        cells = [known.cell] if known.placed else []
        own = (known.data,) if known.data.poses else ()
    if isinstance(measurements, Measurements):
        own = (measurements,)
    elif measurements:
        own = (read_measurements(measurements),)
    notices += [notice for one in own for notice in one.notices]
    if cells and cells[0].robot.joints != robot.joints:
        raise OptionError(
            f"the fit's robot has {cells[0].robot.joints} joints, but {robot.name} has "
            f"{robot.joints}"
        )
    if cells:
        check_same_robot(robot, cells[0].robot)
    if own and not cells:
        first = calibrate(robot, own[0], "sum", holdout=0.0)
        if first.status is Status.FAILED:
            raise DataError(f"{own[0].source}: {first.notices[-1]}")
        cells = [first.cell]
        notices.append(
            "the existing poses were calibrated first, geometry alone; give fit= for another model"
        )
    if cells:
        if len(options.tracker) or len(options.spots):
            raise OptionError(
                "the fit tells where tracker and targets are: leave tracker= and spots= out"
            )
        own = tuple(check_and_complete_joints(robot, one) for one in own)
        for one in own:
            if measurements:
                check_same_arm(cells[0].robot, one)
            strange = [name for name in one.target_names if name not in cells[0].target_names]
            if strange:
                raise OptionError(f"{one.source}: target {strange[0]} is not one of the fit's")
        if not own:
            notices.append("the fit tells no poses: none count as measured; give data=")
        noise, text = choose_planning_noise(cells[0], own, options)
        return PlanningInputs(cells[0], own, noise, (*notices, text))
    cell, text = build_assumed_cell(robot, options)
    notices += [text] if text else []
    noise, text = choose_planning_noise(cell, (), options)
    return PlanningInputs(cell, (), noise, (*notices, text))


def check_same_robot(robot: Robot, calibrated_robot: Robot) -> None:
    """Raise OptionError where a fit is of another arm than the one to plan for.

    Zeros of the joints may be anywhere: a calibration may have set them.
    """
    change = flatten_link_parameters(calibrated_robot.mdh - robot.mdh)
    change[joint_zero_indices(robot.prismatic)] = 0.0
    if named := describe_implausible_changes(
        ParameterNames.for_robot(robot, ()), change, robot.reach()
    ):
        raise OptionError(
            f"the fit is of {calibrated_robot.name}, which is not "
            f"{robot.name} ({named}); name the robot "
            "of the fit, or give another fit"
        )


class AssumedCell(NamedTuple):
    """A cell that is assumed, and the sentence that says so."""

    cell: Cell
    notice: str


def build_assumed_cell(robot: Robot, options: PlanOptions) -> AssumedCell:
    """A nominal robot before a tracker, and a notice where nobody said where that is."""
    spots = np.array(options.spots, dtype=float).reshape(-1, 3)
    spots = spots if len(spots) else target_positions_on_circle(options.targets)
    names = tuple(f"smr{i + 1}" for i in range(len(spots)))
    cell = Cell(robot, np.eye(4), names, spots)
    if len(options.tracker):
        return AssumedCell(
            place_measurement_frame(cell, np.array(options.tracker, dtype=float)), ""
        )
    away = max(DEFAULT_TRACKER_DISTANCE, robot.reach())
    place = default_tracker_position(cell, away)
    where = ", ".join(f"{1e3 * value:.0f}" for value in place)
    text = f"the tracker is taken to stand at {where} mm in base axes; say where with tracker="
    return AssumedCell(place_measurement_frame(cell, place), text)


class NoiseWithSource(NamedTuple):
    """Noise, and the sentence that says where it is from."""

    noise: PlanningNoise
    source_text: str


def choose_planning_noise(
    cell: Cell, measurement_sets: Sequence[Measurements], options: PlanOptions
) -> NoiseWithSource:
    """The noise to plan with, and where it is from."""
    given = {name: getattr(options, name) for name in ("noise", "per_metre", "jitter")}
    told = {name: float(value) for name, value in given.items() if value is not None}
    base, source = PlanningNoise(), ", assumed"
    if measurement_sets and not told:
        noise = estimate_cell_noise(cell, measurement_sets[0])
        if np.sqrt(noise.variance) > MAX_NOISE_OF_COMPUTED_DATA:
            source = (
                ", estimated from the existing poses, with the model errors in them; give noise= "
                "and jitter= where you know them"
            )
            base = PlanningNoise(float(np.sqrt(noise.variance)), 0.0, noise.joint_jitter)
    out = replace(base, **told)
    text = (
        f"noise of a coordinate {1e6 * out.noise:.3g} um + {1e6 * out.per_metre:.3g} um/m, jitter "
        f"of a joint {1e6 * out.jitter:.3g} urad{', as given' if told else source}"
    )
    return NoiseWithSource(out, text)


def estimate_cell_noise(cell: Cell, measurements: Measurements) -> Noise:
    """Noise of instrument and joints in the errors of a cell."""
    chosen = [cell.target_names.index(name) for name in measurements.target_names]
    state = ParameterValues(
        cell.robot.mdh, cell.base[:3, :3], cell.base[:3, 3], cell.target_positions[chosen]
    )
    measurements = cell.align_to_first_session(measurements)
    model = build_point_model(cell.robot, measurements)
    scene = pose_arm_at_values(cell.robot, measurements, model, state)
    rows = linearise_to_point_rows(model, state, scene.jacobian)
    terms = cell.effects.terms
    fields = (
        effect_displacement_fields(terms, scene) if terms else np.zeros((0, *scene.points.shape))
    )
    return estimate_noise_by_reml(rows, rows.rows_from_fields(fields))


class PlanningSurroundings(NamedTuple):
    """Where the arm may go, what the instrument sees, and notices."""

    workspace: ArmWorkspace
    visibility: TrackerVisibility
    notices: tuple[str, ...]


def build_workspace_and_visibility(
    cell: Cell, options: PlanOptions, measurement_sets: Sequence[Measurements] = ()
) -> PlanningSurroundings:
    """Where the arm may go and what the instrument sees.  measurement_sets: poses at hand."""
    robot = cell.robot
    lower, upper, notices = find_joint_limits(robot, options.joints, measurement_sets)
    radius = BODY_RADIUS_FRACTION_OF_REACH * robot.reach() if options.body is None else options.body
    room = ArmWorkspace(
        robot, cell.target_positions, target_normals(cell.target_positions, options.normals), lower,
        upper, radius, floor=options.floor, all_targets_required=options.whole,
    )  # fmt: skip
    if len(options.volume):
        low, high = np.array(options.volume, dtype=float)
        room = replace(room, low=low, high=high)
    place = -cell.base[:3, 3] @ cell.base[:3, :3]
    sight = TrackerVisibility(
        place, robot.up, options.acceptance, *options.reach, *options.elevation
    )
    return PlanningSurroundings(room, sight, notices)


# ---- the task ------------------------------------------------------------------------------------


WORKSPACE_PREDICTION_POSES = 1000  # poses of the workspace at which positions are predicted

CRITERION_BUILDERS: Mapping[str, Callable[[PoseInformation, Array], OptimalityCriterion]] = {
    # of the parameters' covariance, or of the variances at workspace poses by B (w, 3k, f)
    "D": lambda ahead, b: DeterminantCriterion(),
    "A": lambda ahead, b: TraceCriterion(
        np.eye(len(ahead.parameter_scale)) / len(ahead.parameter_scale)
    ),
    "E": lambda ahead, b: LargestEigenvalueCriterion(),
    "G": lambda ahead, b: LargestVarianceCriterion(np.swapaxes(b, 1, 2) @ b),
    "I": lambda ahead, b: TraceCriterion(np.einsum("wri,wrj->ij", b, b) / len(b)),
}


class DesignProblem(NamedTuple):
    """The experiments to choose from, and the criterion of the choice."""

    pool: ExperimentPool
    criterion: OptimalityCriterion


@dataclass(frozen=True, eq=False)
class PlanningTask:
    """The arm in its room, and what poses can tell of it.

    workspace_poses: (w, n) poses at which positions are predicted.  measured_information: (f, f)
    information at hand. questions: two effects to tell apart, or nothing.
    """

    options: PlanOptions
    inputs: PlanningInputs
    workspace: ArmWorkspace
    visibility: TrackerVisibility
    pose_information: PoseInformation
    workspace_poses: Array
    measured_information: Array
    questions: tuple[SeparationQuestion, ...]

    @cached_property
    def position_predictions(self) -> Array:
        """B (w, 3k, f) as `PoseInformation.position_predictions`."""
        return self.pose_information.position_prediction_matrices(self.workspace_poses)

    def build_parameter_pool(self, candidates: CandidatePoses) -> ExperimentPool:
        """What the candidates tell about the parameters."""
        return ExperimentPool(
            self.pose_information.whitened_jacobian_of_new_poses(candidates.q, candidates.seen),
            self.measured_information,
        )

    def predict_separation_powers(self, candidates: CandidatePoses) -> tuple[SeparationPower, ...]:
        """What the candidates tell about the effects asked for."""
        nowhere = np.zeros(candidates.count, dtype=bool)
        return tuple(
            effect_separation.predict_separation_power(
                one, candidates.q, candidates.seen[:, self.find_target_indices(one)], nowhere
            )
            for one in self.questions
        )

    def build_design_problem(self, candidates: CandidatePoses) -> DesignProblem:
        """What is to be chosen from, and by what."""
        for contest in self.predict_separation_powers(candidates):
            return DesignProblem(contest.pool, contest.criterion)
        return DesignProblem(
            self.build_parameter_pool(candidates),
            CRITERION_BUILDERS[self.options.criterion](
                self.pose_information, self.position_predictions
            ),
        )

    def find_target_indices(self, question: SeparationQuestion) -> list[int]:
        """Which targets of the cell the measurements behind a question have."""
        names = question.site.scene.data.target_names
        return [self.inputs.cell.target_names.index(name) for name in names]


def build_planning_task(
    robot: Robot,
    inputs: PlanningInputs,
    workspace: ArmWorkspace,
    visibility: TrackerVisibility,
    candidates: CandidatePoses,
    options: PlanOptions,
) -> PlanningTask:
    """The task once the candidates are known.  robot: nominal."""
    cell = add_effects_to_cell(inputs.cell, options.effects, candidates.q)
    ahead = build_pose_information(cell, inputs.noise, candidates.q, candidates.seen)
    known = np.zeros((len(ahead.parameter_scale),) * 2)
    for one in inputs.measurement_sets:
        known = known + ahead.measured_information(one)
    work = draw_collision_free_poses(workspace, WORKSPACE_PREDICTION_POSES, options.seed + 1)
    asked = build_separation_questions(robot, inputs, options)
    return PlanningTask(options, inputs, workspace, visibility, ahead, work, known, asked)


def build_separation_questions(
    robot: Robot, inputs: PlanningInputs, options: PlanOptions
) -> tuple[SeparationQuestion, ...]:
    """The effects that the poses are to tell apart, if any.  Raises OptionError."""
    if not len(options.separate):
        return ()
    if not inputs.measurement_sets:
        raise OptionError(
            "separate= needs to know how large the effects are: give measurements as data=, or a "
            "calibration that holds its poses as fit="
        )
    return (
        effect_separation.build_separation_question(
            robot, inputs.measurement_sets[0], inputs.cell, options.separate, options.seed
        ),
    )
