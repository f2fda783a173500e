"""From training poses to a fit: start, identification, least squares, weights, effects, minimax."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from minimax_cal.fitting.checks import POOR_FIT, too_changed
from minimax_cal.fitting.geometry_fit import (
    FitTask,
    ParameterFit,
    fit_geometry,
    hold_vague_links,
    start_fit,
)
from minimax_cal.fitting.identify import Identification, Reason
from minimax_cal.fitting.minimax_problem import (
    Certificate,
    Distances,
    certify,
    minimax_problem,
    trusted_distances,
)
from minimax_cal.fitting.options import Options, Progress, silent, solver_of
from minimax_cal.fitting.robust import Robust, flatness
from minimax_cal.fitting.stations import apply_frame_steps
from minimax_cal.fitting.uncertainty import Estimator, Uncertainty, point_share, uncertainty_of
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import clusters
from minimax_cal.measuring.history import Clock
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.stations import Frames, Sessions, seen_from
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import (
    NOTHING,
    Fitted,
    Term,
    at_bounds,
    bounds,
    names_of,
    of_sessions,
    settled,
)
from minimax_cal.modelling.effects.table import terms as terms_of
from minimax_cal.modelling.joint_fit import extended, fitted, scene_of
from minimax_cal.modelling.model import NO_MIX, Model, model_of, pose_weights, with_poses
from minimax_cal.modelling.near import nearby
from minimax_cal.modelling.parameters import Names, State
from minimax_cal.modelling.rows import linearised
from minimax_cal.modelling.start import EVERYWHERE
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import minimax
from minimax_cal.solvers.least_squares import LeastSquares
from minimax_cal.solvers.minimax import Optimum, Sqp
from minimax_cal.solvers.status import Status

QP_TOLERANCE = 1e-9
EFFECT_PASSES = 2  # of a fit with effects: the second takes finite rotations into account
MIN_TARGET_WEIGHT = 1e-3  # least weight of a target in a covariance, as in the SQP's Hessian
AT_BOUND = "at its bound"
MAX_ROUNDING = 1e-9  # an error below is rounding: data that were computed, not measured [m]
# worst errors above this share of the reach: no calibration, so that so many QPs, which then go
# from backend to backend, are enough to say so
MIN_HOPELESS_ERROR = 10.0 * POOR_FIT
MAX_HOPELESS_QPS = 20
PER = {"minimax": "target", "point": "point"}  # objectives that ask for the worst of something


@dataclass(frozen=True, eq=False)
class Solved:
    """What the solvers found.

    nominal: the nominal geometry with its best base and targets.  state: the calibrated one.
    estimator: how the poses were weighed.  group: (m,) rows with one number are one pose.
    optimum: the minimax answer, where there was one to find.  certificate: of the worst point.
    squares: the least squares, from whose end the minimax starts.
    effects: those asked for, with their values; units: of each value.
    robust: the weights of the points, and which stand out.
    start, frames: of the sessions, where there are several, for the nominal and for this robot.
    """

    nominal: State
    state: State
    identification: Identification
    estimator: Estimator
    group: Array
    status: Status
    iterations: int
    optimum: Optimum[State] | None
    certificate: Certificate | None
    distances: Distances
    squares: LeastSquares[State]
    notices: tuple[str, ...]
    effects: Fitted
    units: tuple[str, ...]
    robust: Robust
    start: Frames = field(default_factory=dict)
    frames: Frames = field(default_factory=dict)

    def cell(self, robot: Robot, data: Measurements) -> Cell:
        """The calibrated robot in its place.  data: all poses of the fit, held out or not."""
        sessions = Sessions.of(seen_from(data, self.frames))
        return Cell.of(robot, self.state, data.target_names, self.effects, sessions)

    def nominal_cell(self, robot: Robot, data: Measurements, clock: Clock | None = None) -> Cell:
        """The same of the nominal robot.  clock: of the data, where it is known."""
        frames = seen_from(data, self.start).frames
        sessions = Sessions(frames, clock or Clock.of(data))
        return Cell.of(robot, self.nominal, data.target_names, sessions=sessions)

    @property
    def names(self) -> Names:
        """Of all parameters."""
        return self.estimator.model.names

    @cached_property
    def widening(self) -> float:
        """What a robust loss adds to all sigmas: `robust.flatness`."""
        return flatness(self.robust, self.state)

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Of all parameters, the base's along its own axes."""
        known = uncertainty_of(self.estimator, self.state, self.group, self.units)
        return known.widened(self.widening)


def fit_cell(
    robot: Robot,
    data: Measurements,
    options: Options,
    progress: Progress = silent,
    near: Array = EVERYWHERE,
) -> Solved:
    """Fit the chosen objective to all poses of the data.  Raises OptionError, DataError.

    data: with the points of all sessions in one frame (`stations.place_sessions`).  near: (3, 3)
    the base's rotation where it is known already, as in `start.fit_base`.
    """
    # Geometry by least squares [paper S]; the drawing holds what the poses hardly determine.
    task, first_frames = start_fit(robot, data, options, near), data.frames
    fit = fit_geometry(task, progress)
    task, fit = hold_vague_links(task, fit, progress)

    # Frames of further sessions, and then effects, as linear columns beside the geometry.
    if options.effects or data.frames:
        progress("effects")
    if frame_terms := of_sessions(data.frames):
        task, fit = fit_with_terms(task, fit, frame_terms)
    asked = [e for e in options.effects if not (isinstance(e, Term) and e.frees_frames)]
    if asked:
        from minimax_cal.evidence.selection import best_variant  # slow to import
        from minimax_cal.modelling.dictionary import ArmLaws

        scene = scene_of(robot, task.data, fit.robust.plain, fit.robust.state)
        laws = ArmLaws(scene, linearised(fit.robust.model, fit.robust.state, scene.jacobian))
        effect_terms = terms_of(scene, asked, partial(best_variant, laws))
        task, fit = fit_with_terms(task, fit, (*frame_terms, *effect_terms))
    data, model, state, squares = task.data, fit.robust.model, fit.robust.state, fit.robust.found

    # Position and orientation of whole poses.  The rotation that fits best has a zero gradient
    # half a turn away too: the fit of the points is a start near the answer.
    mix = NO_MIX
    if options.objective == "pose":
        mix, model = pose_weights(data, options.lever), fit.robust.by_pose
        squares = nearby(with_poses(model, mix), state, options.method)
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
        is_at_bound = at_bounds(state.effects, model.room)
        identification = without_bounded_effects(identification, model.names, is_at_bound)
    effects, units = NOTHING, tuple[str, ...]()
    if fit.terms:
        scene = scene_of(robot, data, model, state)
        effects, units = fitted(fit.terms, scene, state.effects), names_of(fit.terms, scene)[1]
    unweighted = replace(model, weight=model.weight / task.target_weights[:, None])
    return Solved(
        task.start.state, state, identification,
        Estimator(unweighted.only(identification.active), worst.weights, mix),
        clusters(data), status, iterations, worst.optimum, worst.certificate, distances, squares,
        (*fit.notices, *fit.robust.notices, *worst.notices), effects, units, fit.robust,
        start=first_frames, frames=data.frames,
    )  # fmt: skip


def fit_with_terms(
    task: FitTask, fit: ParameterFit, terms: tuple[Term, ...]
) -> tuple[FitTask, ParameterFit]:
    """Geometry and effects together; the task with the data in the frames of sessions found so."""
    robot, robust, identification = task.robot, fit.robust, fit.identification
    for _ in range(EFFECT_PASSES):
        # Steps of the frames that the last pass found are taken exactly.
        frames, here = apply_frame_steps(task.data.frames, robust.state)
        data = seen_from(task.data, frames)
        y = model_of(robot, data).y if frames else task.model.y
        task = replace(task, data=data, model=replace(task.model, y=y))

        # Columns of the effects, linear at the last fit, within their bounds.
        plain = replace(robust.plain, y=y).only(identification.active)
        model, begin = extended(plain, robot, data, here, terms)
        scene = scene_of(robot, data, model, begin)
        room = [np.zeros((0, 2))]
        for term in terms:  # frames of sessions are anywhere
            room.append(bounds(scene, [term]))
            if term.frees_frames:
                room[-1] = np.full(room[-1].shape, np.inf) * [-1.0, 1.0]
        model = replace(model, room=np.concatenate(room))
        identification = task.identify_parameters(model, begin, fit.offsets)
        known = identification.active[task.model.names.count :]
        begin = replace(begin, effects=np.where(known, begin.effects, 0.0))
        free = model.only(identification.active)
        robust = task.fit_robustly(*task.fit_least_squares(free, begin))
    return task, ParameterFit(identification, robust, terms, fit.notices, fit.offsets)


def without_bounded_effects(
    identification: Identification, names: Names, is_at_bound: Array
) -> Identification:
    """The identified parameters but for those of effects at a bound.  is_at_bound: (e,) mask."""
    dropped = np.pad(is_at_bound, (names.geometric, 0)) & identification.active
    why = dict.fromkeys((names.all[i] for i in np.flatnonzero(dropped)), Reason(AT_BOUND))
    active = identification.active & ~dropped
    return replace(identification, active=active, reasons={**identification.reasons, **why})


@dataclass(frozen=True, eq=False)
class WorstErrorFit:
    """The minimax answer, where the objective asks for one, and its certificate.

    weights: (k,) of each target in the fit, or (k, m) of each point.
    """

    optimum: Optimum[State] | None
    certificate: Certificate | None
    weights: Array
    notices: tuple[str, ...] = ()


def minimise_worst_error(
    task: FitTask, model: Model, state: State, distances: Distances, progress: Progress
) -> WorstErrorFit:
    """Minimise the worst target's, or the worst point's, error from a least-squares fit.

    A WorstErrorFit without an answer where the objective does not ask for one.
    """
    options, reach = task.options, task.robot.reach()
    per = PER.get(options.objective)
    if per is None or (per == "target" and len(task.target_weights) == 1):
        return WorstErrorFit(None, None, task.target_weights)
    progress("minimax")
    problem = minimax_problem(model, state, distances, options.distance, per)
    qp, notices = solver_of(options.qp, QP_TOLERANCE)
    settings = Sqp(hessian=options.hessian)

    # Of an arm that is not the one drawn a few steps are enough to say so.
    links = model.active[: 5 * task.robot.joints]
    is_other_arm = not options.allow_large_changes and too_changed(task.robot, state.mdh, links)
    if is_other_arm or problem.size > (MIN_HOPELESS_ERROR * reach) ** 2:
        settings = replace(settings, iterations=min(settings.iterations, MAX_HOPELESS_QPS))
    optimum = minimax.solve(problem, state, qp, settings)
    if len(model.room):
        effects = settled(optimum.x.effects, model.room)
        optimum = replace(optimum, x=replace(optimum.x, effects=effects))
    if optimum.status is Status.STALLED and optimum.value * problem.size < MAX_ROUNDING**2:
        # nothing but rounding is left; the last note says how much that is
        optimum = replace(optimum, status=Status.CONVERGED, notes=optimum.notes[:-1])
    notices = (*notices, *(f"QP: {note}" for note in optimum.notes))

    # The multipliers are the weights of a sum of squares with the same minimum.
    if per == "target":
        share = np.maximum(optimum.mu, MIN_TARGET_WEIGHT) * model.counts.sum() / model.counts
        return WorstErrorFit(optimum, None, np.asarray(share), notices)
    certificate = None
    if optimum.status is not Status.FAILED:
        certificate = certify(problem, optimum, task.data.line)
    return WorstErrorFit(optimum, certificate, point_share(optimum.mu, model.seen), notices)
