"""From training poses to a fit: start, identification, least squares, weights, effects, minimax."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.fitting.data_slips import MAX_CALIBRATION_ERROR_OF_REACH, describe_other_arm
from minimax_cal.fitting.geometry_fit import (
    FitTask,
    ParameterFit,
    add_nominal_priors,
    fit_geometry,
    start_fit,
)
from minimax_cal.fitting.identification import Identification, NotIdentifiedReason
from minimax_cal.fitting.minimax_problem import (
    Certificate,
    TargetDistanceLimits,
    build_certificate,
    build_minimax_problem,
    trusted_distances,
)
from minimax_cal.fitting.options import Options, Progress, build_qp_solver, silent_progress
from minimax_cal.fitting.robust_fit import RobustFit, loss_sigma_factor
from minimax_cal.fitting.session_frames import apply_frame_steps
from minimax_cal.fitting.uncertainty import (
    Estimator,
    Uncertainty,
    estimate_uncertainty,
    point_weights_from_multipliers,
)
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import cluster_poses
from minimax_cal.measuring.session_frames import Frames, SessionFrames, convert_to_first_frame
from minimax_cal.measuring.visit_history import SessionClock
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import (
    NO_EFFECTS,
    Fitted,
    Term,
    at_bound_mask,
    effect_parameter_bounds,
    effect_parameter_names_and_units,
    session_frame_terms,
    snap_to_near_bounds,
)
from minimax_cal.modelling.effects.table import parse_effect_terms as terms_of
from minimax_cal.modelling.effects_in_model import (
    extend_model_with_effects,
    pose_arm_at_values,
    split_values_by_effect,
)
from minimax_cal.modelling.error_rows import linearise_to_point_rows
from minimax_cal.modelling.global_start import NO_BASE_ROTATION
from minimax_cal.modelling.nearby_fit import fit_within_bounds_from_start
from minimax_cal.modelling.parameters import ParameterNames, ParameterValues
from minimax_cal.modelling.point_model import (
    NO_POSE_MIX,
    PointModel,
    build_point_model,
    pose_error_weights,
    with_pose_errors,
)
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import minimax
from minimax_cal.solvers.least_squares import LeastSquaresSolution
from minimax_cal.solvers.minimax import Optimum, Sqp
from minimax_cal.solvers.status import Status

FIT_QP_TOLERANCE = 1e-9
EFFECT_PASSES = 2  # of a fit with effects: the second takes finite rotations into account
MIN_TARGET_WEIGHT = 1e-3  # least weight of a target in a covariance, as in the SQP's Hessian
AT_BOUND_REASON = "at its bound"
MAX_ROUNDING_ERROR = 1e-9  # an error below is rounding: data that were computed, not measured [m]
# worst errors above this share of the reach: no calibration, so that so many QPs, which then go
# from backend to backend, are enough to say so
MIN_HOPELESS_ERROR = 10.0 * MAX_CALIBRATION_ERROR_OF_REACH
MAX_HOPELESS_QPS = 20
WORST_CASE_OF_OBJECTIVE = {
    "minimax": "target",
    "point": "point",
}  # objectives that ask for the worst of something


@dataclass(frozen=True, eq=False)
class CellFit:
    """What the solvers found.

    nominal: the nominal geometry with its best base and targets.  state: the calibrated one.
    estimator: how the poses were weighed.  group: (m,) rows with one number are one pose. optimum:
    the minimax answer, where there was one to find.  certificate: of the worst point. squares: the
    least squares, from whose end the minimax starts. effects: those asked for, with their values;
    units: of each value. robust: the weights of the points, and which stand out. nominal_frames,
    frames: of the sessions, where there are several, for the nominal and for this robot.
    """

    nominal: ParameterValues
    state: ParameterValues
    identification: Identification
    estimator: Estimator
    group: Array
    status: Status
    iterations: int
    optimum: Optimum[ParameterValues] | None
    certificate: Certificate | None
    distances: TargetDistanceLimits
    squares: LeastSquaresSolution[ParameterValues]
    notices: tuple[str, ...]
    effects: Fitted
    units: tuple[str, ...]
    robust: RobustFit
    nominal_frames: Frames = field(default_factory=dict)
    frames: Frames = field(default_factory=dict)

    def cell(self, robot: Robot, data: Measurements) -> Cell:
        """The calibrated robot in its place.  data: all poses of the fit, held out or not."""
        sessions = SessionFrames.from_measurements(convert_to_first_frame(data, self.frames))
        return Cell.from_parameters(robot, self.state, data.target_names, self.effects, sessions)

    def nominal_cell(
        self, robot: Robot, data: Measurements, clock: SessionClock | None = None
    ) -> Cell:
        """The same of the nominal robot.  clock: of the data, where it is known."""
        frames = convert_to_first_frame(data, self.nominal_frames).frames
        sessions = SessionFrames(frames, clock or SessionClock.from_measurements(data))
        return Cell.from_parameters(robot, self.nominal, data.target_names, sessions=sessions)

    @property
    def names(self) -> ParameterNames:
        """Of all parameters."""
        return self.estimator.model.names

    @cached_property
    def loss_sigma_factor(self) -> float:
        """What a robust loss adds to all sigmas: `robust.loss_sigma_factor`."""
        return loss_sigma_factor(self.robust, self.state)

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Of all parameters, the base's along its own axes."""
        known = estimate_uncertainty(self.estimator, self.state, self.group, self.units)
        return known.scale_sigmas(self.loss_sigma_factor)


def fit_cell(
    robot: Robot,
    data: Measurements,
    options: Options,
    progress: Progress = silent_progress,
    near: Array = NO_BASE_ROTATION,
) -> CellFit:
    """Fit the chosen objective to all poses of the data.  Raises OptionError, DataError.

    data: with the points of all sessions in one frame (`session_frames.place_sessions`).  near:
    (3, 3) the base's rotation where it is known already, as in `global_start.fit_base_and_targets`.
    """
    # Geometry by least squares [paper S]; the drawing holds what the poses hardly determine.
    task, first_frames = start_fit(robot, data, options, near), data.frames
    fit = fit_geometry(task, progress)
    task, fit = add_nominal_priors(task, fit, progress)

    # Frames of further sessions, and then effects, as linear columns beside the geometry.
    if options.effects or data.frames:
        progress("effects")
    if frame_terms := session_frame_terms(data.frames):
        task, fit = fit_with_terms(task, fit, frame_terms)
    asked = [e for e in options.effects if not (isinstance(e, Term) and e.frees_session_frames)]
    if asked:
        from minimax_cal.modelling.arm_laws import ArmLaws
        from minimax_cal.selection.forward_selection import select_best_variant  # slow to import

        scene = pose_arm_at_values(robot, task.data, fit.robust.unweighted_model, fit.robust.state)
        laws = ArmLaws(
            scene, linearise_to_point_rows(fit.robust.model, fit.robust.state, scene.jacobian)
        )
        effect_terms = terms_of(scene, asked, partial(select_best_variant, laws))
        task, fit = fit_with_terms(task, fit, (*frame_terms, *effect_terms))
    data, model, state, squares = (
        task.data,
        fit.robust.model,
        fit.robust.state,
        fit.robust.least_squares,
    )

    # Position and orientation of whole poses.  The rotation that fits best has a zero gradient
    # half a turn away too: the fit of the points is a start near the answer.
    mix = NO_POSE_MIX
    if options.objective == "pose":
        mix, model = pose_error_weights(data, options.lever), fit.robust.model_weighted_by_pose
        squares = fit_within_bounds_from_start(with_pose_errors(model, mix), state, options.method)
        state = squares.x.take(np.array(0))

    # The worst target or point, with the distances between targets kept [paper M].
    distances = trusted_distances(data, fit.robust.weights, options.distance_tolerance)
    worst = minimise_worst_error(task, model, state, distances, progress)
    status, iterations = squares.status[0], int(squares.iterations[0]) + fit.robust.rounds
    if worst.optimum is not None:
        state, status = worst.optimum.x, worst.optimum.status
        iterations += worst.optimum.iterations

    # Effects with their values; a parameter at its bound is not identified.
    identification = fit.identification
    if len(model.room):
        is_at_bound = at_bound_mask(state.effects, model.room)
        identification = without_bounded_effects(identification, model.names, is_at_bound)
    effects, units = NO_EFFECTS, tuple[str, ...]()
    if fit.terms:
        scene = pose_arm_at_values(robot, data, model, state)
        effects, units = (
            split_values_by_effect(fit.terms, scene, state.effects),
            effect_parameter_names_and_units(fit.terms, scene)[1],
        )
    unweighted = replace(model, weight=model.weight / task.target_weights[:, None])
    return CellFit(
        task.start.state,
        state,
        identification,
        Estimator(unweighted.with_active(identification.active), worst.weights, mix),
        cluster_poses(data),
        status,
        iterations,
        worst.optimum,
        worst.certificate,
        distances,
        squares,
        (*fit.notices, *fit.robust.notices, *worst.notices),
        effects,
        units,
        fit.robust,
        nominal_frames=first_frames,
        frames=data.frames,
    )


def fit_with_terms(
    task: FitTask, fit: ParameterFit, terms: tuple[Term, ...]
) -> tuple[FitTask, ParameterFit]:
    """Geometry and effects together; the task with the data in the frames of sessions found so."""
    robot, robust, identification = task.robot, fit.robust, fit.identification
    for _ in range(EFFECT_PASSES):
        # Steps of the frames that the last pass found are taken exactly.
        frames, here = apply_frame_steps(task.data.frames, robust.state)
        data = convert_to_first_frame(task.data, frames)
        y = build_point_model(robot, data).y if frames else task.model.y
        task = replace(task, data=data, model=replace(task.model, y=y))

        # Columns of the effects, linear at the last fit, within their bounds.
        plain = replace(robust.unweighted_model, y=y).with_active(identification.active)
        model, begin = extend_model_with_effects(plain, robot, data, here, terms)
        scene = pose_arm_at_values(robot, data, model, begin)
        room = [np.zeros((0, 2))]
        for term in terms:  # frames of sessions are anywhere
            room.append(effect_parameter_bounds(scene, [term]))
            if term.frees_session_frames:
                room[-1] = np.full(room[-1].shape, np.inf) * [-1.0, 1.0]
        model = replace(model, room=np.concatenate(room))
        identification = task.identify_parameters(model, begin, fit.offsets)
        known = identification.active[task.model.names.parameter_count :]
        begin = replace(begin, effects=np.where(known, begin.effects, 0.0))
        free = model.with_active(identification.active)
        robust = task.fit_robustly(*task.fit_least_squares(free, begin))
    return task, ParameterFit(identification, robust, terms, fit.notices, fit.offsets)


def without_bounded_effects(
    identification: Identification, names: ParameterNames, is_at_bound: Array
) -> Identification:
    """The identified parameters but for those of effects at a bound.  is_at_bound: (e,) mask."""
    dropped = np.pad(is_at_bound, (names.geometric_count, 0)) & identification.active
    why = dict.fromkeys(
        (names.all_names[i] for i in np.flatnonzero(dropped)), NotIdentifiedReason(AT_BOUND_REASON)
    )
    active = identification.active & ~dropped
    return replace(identification, active=active, reasons={**identification.reasons, **why})


@dataclass(frozen=True, eq=False)
class WorstErrorFit:
    """The minimax answer, where the objective asks for one, and its certificate.

    weights: (k,) of each target in the fit, or (k, m) of each point.
    """

    optimum: Optimum[ParameterValues] | None
    certificate: Certificate | None
    weights: Array
    notices: tuple[str, ...] = ()


def minimise_worst_error(
    task: FitTask,
    model: PointModel,
    state: ParameterValues,
    distances: TargetDistanceLimits,
    progress: Progress,
) -> WorstErrorFit:
    """Minimise the worst target's, or the worst point's, error from a least-squares fit.

    A WorstErrorFit without an answer where the objective does not ask for one.
    """
    options, reach = task.options, task.robot.reach()
    per = WORST_CASE_OF_OBJECTIVE.get(options.objective)
    if per is None or (per == "target" and len(task.target_weights) == 1):
        return WorstErrorFit(None, None, task.target_weights)
    progress("minimax")
    problem = build_minimax_problem(model, state, distances, options.distance, per)
    qp, notices = build_qp_solver(options.qp, FIT_QP_TOLERANCE)
    settings = Sqp(hessian=options.hessian)

    # Of an arm that is not the one drawn a few steps are enough to say so.
    links = model.active[: 5 * task.robot.joints]
    is_other_arm = not options.allow_large_changes and describe_other_arm(
        task.robot, state.mdh, links
    )
    if is_other_arm or problem.size > (MIN_HOPELESS_ERROR * reach) ** 2:
        settings = replace(settings, iterations=min(settings.iterations, MAX_HOPELESS_QPS))
    optimum = minimax.solve(problem, state, qp, settings)
    if len(model.room):
        effects = snap_to_near_bounds(optimum.x.effects, model.room)
        optimum = replace(optimum, x=replace(optimum.x, effects=effects))
    if optimum.status is Status.STALLED and optimum.value * problem.size < MAX_ROUNDING_ERROR**2:
        # nothing but rounding is left; the last note says how much that is
        optimum = replace(optimum, status=Status.CONVERGED, notes=optimum.notes[:-1])
    notices = (*notices, *(f"QP: {note}" for note in optimum.notes))

    # The multipliers are the weights of a sum of squares with the same minimum.
    if per == "target":
        share = (
            np.maximum(optimum.mu, MIN_TARGET_WEIGHT)
            * model.pose_counts_by_target.sum()
            / model.pose_counts_by_target
        )
        return WorstErrorFit(optimum, None, np.asarray(share), notices)
    certificate = None
    if optimum.status is not Status.FAILED:
        certificate = build_certificate(problem, optimum, task.data.line)
    return WorstErrorFit(
        optimum,
        certificate,
        point_weights_from_multipliers(optimum.mu, model.measured_mask),
        notices,
    )
