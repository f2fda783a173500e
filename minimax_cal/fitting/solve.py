"""From training poses to a fit: start, identification, least squares, weights, effects, minimax."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from minimax_cal.fitting import identify
from minimax_cal.fitting.checks import POOR_FIT, too_changed
from minimax_cal.fitting.coaxial import (
    coaxial_joints,
    identify_with_offset,
    is_offset_shown,
    start_with_offset,
)
from minimax_cal.fitting.identify import MAX_NAMED, Because, Identification, Reason
from minimax_cal.fitting.minimax_problem import (
    Certificate,
    Distances,
    certify,
    minimax_problem,
    trusted_distances,
)
from minimax_cal.fitting.options import (
    OFFSETS,
    Options,
    Progress,
    freed,
    known_within,
    objective_of,
    silent,
    solver_of,
)
from minimax_cal.fitting.robust import Robust, flatness, robust_fit
from minimax_cal.fitting.stations import steps_of, turned_in
from minimax_cal.fitting.uncertainty import Estimator, Uncertainty, point_share, uncertainty_of
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.words import name_first
from minimax_cal.measuring import checks
from minimax_cal.measuring.grouping import clusters, groups
from minimax_cal.measuring.history import Clock
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.stations import Frames, Sessions, seen_from
from minimax_cal.modelling import start
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
from minimax_cal.modelling.model import (
    NO_MIX,
    Model,
    SumOfSquares,
    model_of,
    pose_weights,
    with_poses,
)
from minimax_cal.modelling.near import nearby
from minimax_cal.modelling.parameters import Names, State, zero_positions
from minimax_cal.modelling.rows import linearised
from minimax_cal.modelling.start import BaseFit
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import minimax
from minimax_cal.solvers.least_squares import LeastSquares, solve_normal
from minimax_cal.solvers.minimax import Optimum, Sqp
from minimax_cal.solvers.status import Status

QP_TOLERANCE = 1e-9
# With smr:K the other targets follow the geometry without pulling at it: a weight that is nothing
# beside 1, but leaves their own coordinates determined.
ASIDE = 1e-9
EFFECT_PASSES = 2  # of a fit with effects: the second takes finite turns into account
PRIOR_ROUNDS = 20  # of weighing a prior against the noise that remains
MIN_TARGET_WEIGHT = 1e-3  # least weight of a target in a covariance, as in the SQP's Hessian
LEAST_NOISE = 5e-6  # of a coordinate, when a fit with priors leaves no residual to judge by [m]
AT_BOUND = "at its bound"
MAX_ROUNDING = 1e-9  # an error below is rounding: data that were computed, not measured [m]
# worst errors above this share of the reach: no calibration, so that
MIN_HOPELESS_MISS = 10.0 * POOR_FIT
LAST_STEPS = 20  # of the SQP are enough to say so; its QPs then go from backend to backend
# of the cost: a fit that holds the drawing and leaves more than its inverse contradicts the drawing
MAX_REMAINING_COST = 0.5
# times the drawing's own doubt, or as many times a usual link's: of a larger sigma the poses
# hardly determine a link
MAX_DOUBT = 10.0
LEAST_POSES = 3  # of a target in the fit; with fewer its own place explains all
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


@dataclass(frozen=True, eq=False)
class Task:
    """What is to be fitted, and what the user wants of the parameters.

    base: the geometric model of the training poses.  frame: the nominal geometry's best base.
    reference: plenty of poses, which tell what no pose could.  share: (k,) weight of each target.
    allowed: (p,) False for parameters that stay nominal.  order: those to give up first at the
    front.  sigma: (p,) of the prior, inf for none.
    """

    robot: Robot
    data: Measurements
    options: Options
    base: Model
    frame: BaseFit
    reference: Model
    share: Array
    allowed: Array
    order: Array
    sigma: Array

    @property
    def judged(self) -> Array:
        """(k,) True for targets that the geometry answers to, False for those that follow."""
        return self.share > ASIDE

    def identified(self, model: Model, state: State, offsets: Iterable[int] = ()) -> Identification:
        """The parameters that the poses of a model tell; those of effects are given up first.

        offsets: parameters by which coaxial axes were found apart: these stay.
        """
        more, count = len(model.fields), self.base.names.count
        known = np.isfinite(self.sigma)
        known[[*offsets]] = True
        return identify.identify(
            model,
            state,
            np.concatenate([np.arange(count, count + more), self.order]),
            allowed=np.pad(self.allowed, (0, more), constant_values=True),
            reference=self.reference,
            known=np.concatenate([known, model.prior.weight[count:] > 0.0]),
            resolution=self.options.resolution,
        )

    def squares(self, model: Model, begin: State) -> tuple[Model, LeastSquares[State]]:
        """Least squares; with priors, weighed against the noise that remains."""
        sigma, own = self.sigma, model.prior.weight[len(self.sigma) :]
        if not np.isfinite(sigma).any():
            return model, nearby(model, begin, self.options.method)
        points, following = float(model.counts[self.judged].sum()), 3.0 * (~self.judged).sum()
        mean_square = self.frame.mean_square / 3.0
        for _ in range(PRIOR_ROUNDS):
            weight = np.concatenate([mean_square / sigma**2, own])
            model = model.with_prior(replace(model.prior, weight=weight))
            found = nearby(model, begin, self.options.method)
            state = found.x.take(np.array(0))
            _, _, gram = SumOfSquares(model).normal(state)
            known = np.diag(weight[model.active])
            paid = np.trace(solve_normal(gram, gram - known))  # parameters the data pay for
            previous = mean_square
            dof = max(3.0 * points - (paid - following), 1.0)
            mean_square = max(float(model.cost(state).sum()) / dof, LEAST_NOISE**2)
            if abs(mean_square - previous) <= 0.01 * previous:
                break
        return model, found

    def robust(self, model: Model, found: LeastSquares[State]) -> Robust:
        """The fit with the loss and the trimming that were asked for."""
        line, options = self.data.line, self.options
        return robust_fit(
            self.squares, model, found, line, options.loss, options.trim, judged=self.judged
        )


@dataclass(frozen=True, eq=False)
class Stage:
    """How far a fit has come.

    base: the model with all columns, unweighted.  squares: the least squares that count now.
    terms: effects in the model.  offsets: parameters by which coaxial axes were found apart.
    """

    base: Model
    identification: Identification
    robust: Robust
    squares: LeastSquares[State]
    terms: tuple[Term, ...] = ()
    notices: tuple[str, ...] = ()
    offsets: tuple[int, ...] = ()

    @property
    def state(self) -> State:
        """Where the least squares ended."""
        return self.squares.x.take(np.array(0))


def fit_cell(
    robot: Robot,
    data: Measurements,
    options: Options,
    progress: Progress = silent,
    near: Array = start.EVERYWHERE,
) -> Solved:
    """Fit the chosen objective to all poses of the data.  Raises OptionError, DataError.

    data: with the points of all sessions in one frame (`stations.stationed`).  near: (3, 3) the
    base's rotation where it is known already, as in `start.fit_base`.
    """
    task, begun = prepared(robot, data, options, near), data.frames
    mix = NO_MIX
    if options.objective == "pose":
        check_poses(data)
    task, stage = by_drawing(task, geometry(task, progress), progress)
    if options.effects or data.frames:
        progress("effects")
        task, stage = with_effects(task, stage)
        data = task.data
    model = stage.robust.model
    if options.objective == "pose":
        mix = pose_weights(data, options.lever)
        model = stage.robust.by_pose
        # the turn that fits the errors best vanishes for half a turn too: start near the answer
        squares = nearby(with_poses(model, mix), stage.state, options.method)
        stage = replace(stage, squares=squares)
    distances = trusted_distances(data, stage.robust.weights, options.distance_tolerance)
    optimum, certificate, said = worst_case(task, model, stage.state, distances, progress)
    state, identification = optimum.x if optimum else stage.state, stage.identification
    if len(model.room):
        rests = at_bounds(state.effects, model.room)
        identification = without_resting(identification, model.names, rests)
    effects, units = NOTHING, tuple[str, ...]()
    if stage.terms:
        scene = scene_of(robot, data, model, state)
        effects, units = fitted(stage.terms, scene, state.effects), names_of(stage.terms, scene)[1]
    plain = replace(stage.base, weight=model.weight / task.share[:, None])
    plain = plain.only(identification.active).with_prior(model.prior)
    rounds = int(stage.squares.iterations[0]) + stage.robust.rounds
    return Solved(
        nominal=task.frame.state,
        state=state,
        identification=identification,
        estimator=Estimator(plain, shares(task, model, optimum), mix),
        group=clusters(data),
        status=optimum.status if optimum else stage.squares.status[0],
        iterations=rounds + (optimum.iterations if optimum else 0),
        optimum=optimum,
        certificate=certificate,
        distances=distances,
        squares=stage.squares,
        notices=(*stage.notices, *stage.robust.notices, *said),
        effects=effects,
        units=units,
        robust=stage.robust,
        start=begun,
        frames=data.frames,
    )


def prepared(
    robot: Robot, data: Measurements, options: Options, near: Array = start.EVERYWHERE
) -> Task:
    """The task, with poses enough for its unknowns.  Raises OptionError, DataError."""
    base, k = model_of(robot, data), len(data.target_names)
    allowed, order, sigma = wanted(robot, base, options)
    reference = identify.plenty_of_poses(robot, base)
    unknowns = identify.generic_count(robot, reference, order, allowed)
    only = objective_of(options.objective, data)
    telling = data if only < 0 else data.only(only)
    following = 0 if only < 0 else 3 * (k - 1)  # coordinates of targets that follow
    poses, known = len(np.unique(groups(telling))), int(np.isfinite(sigma[allowed]).sum())
    free = steps_of(data.frames)
    checks.check_count(telling, poses, unknowns - following + free, known)
    share = np.ones(k) if only < 0 else np.where(np.arange(k) == only, 1.0, ASIDE)
    frame = start.fit_base(base, robot.mdh, near)
    return Task(robot, data, options, base, frame, reference, share, allowed, order, sigma)


def wanted(robot: Robot, model: Model, options: Options) -> tuple[Array, Array, Array]:
    """What the user asked of the parameters: allowed (p,), order to give up, prior sigma (p,)."""
    names = model.names
    allowed = ~names.match(options.fix, "fix")
    if options.only == OFFSETS:
        zeros = np.isin(np.arange(names.count), zero_positions(robot.prismatic))
        allowed &= zeros | ~names.links
    kept = freed(names, options.free, allowed)
    order = identify.drop_order(robot, names)
    order = np.concatenate([order[~kept[order]], order[kept[order]]])
    sigma = known_within(names, options.priors, "base and targets")
    return allowed, order, sigma


def check_poses(data: Measurements) -> None:
    """Raise OptionError if the targets give no orientation."""
    if len(data.target_names) < 3 or checks.collinear(data):
        raise OptionError("objective pose needs three targets that are not on a line")
    whole = int(data.seen.all(axis=1).sum())
    if whole < LEAST_POSES:
        raise OptionError(
            f"objective pose needs poses at which all targets were measured; there are {whole}"
        )


def geometry(task: Task, progress: Progress, *, wide: bool = True) -> Stage:
    """The least-squares fit of the geometry.

    wide: whether base rotations are searched where it misses grossly.
    """
    progress("identifiable parameters")
    model = task.base.emphasise(task.share)
    identification = task.identified(model, task.frame.state)
    progress("least squares")
    model, squares = task.squares(model.only(identification.active), task.frame.state)
    robust = task.robust(model, squares)
    # a few gross outliers are no reason to search: what counts is how the believed points are met
    notices: tuple[str, ...] = ()
    if wide:
        better, notices = wider(task.robot, robust.model, robust.found, progress)
        if better is not robust.found:
            robust = task.robust(robust.plain, better)
    stage = Stage(task.base, identification, robust, robust.found, notices=notices)
    for joint in coaxial_joints(task.robot):
        stage = with_offset(task, stage, joint)
    return stage


def with_offset(task: Task, stage: Stage, joint: int) -> Stage:
    """The fit in which a coaxial axis and its next are apart in any direction, if poses show it."""
    robust, base, known = stage.robust, task.base.emphasise(task.share), stage.identification
    trial = start_with_offset(
        task.robot, stage.state, joint, known.active, task.allowed, task.order,
        lambda state: identify.gram_of(task.reference, state),
    )  # fmt: skip
    if trial is None:
        return stage
    _, squares = task.squares(robust.model.only(trial.active), trial.begin)
    points = 3.0 * float(robust.model.counts[task.judged].sum()) + 3.0 * float((~task.judged).sum())
    spare = points - float(trial.active.sum())
    if not is_offset_shown(robust.found.cost[0], squares.cost[0], trial.joined, spare):
        return stage
    begin = squares.x.take(np.array(0))
    model, squares = task.squares(robust.plain.only(trial.active), begin)
    names = base.names
    return replace(
        stage,
        identification=identify_with_offset(
            known, names, trial, identify.gram_of(base, begin), names.target_names,
            identify.TOGETHER,
        ),
        robust=(robust := task.robust(model, squares)),
        squares=robust.found,
        offsets=(*stage.offsets, *(int(i) for i in np.flatnonzero(trial.joined))),
    )  # fmt: skip


def by_drawing(task: Task, stage: Stage, progress: Progress) -> tuple[Task, Stage]:
    """The fit in which the drawing holds, by its own doubt, what the poses hardly determine.

    Where the sigma of a link, by the poses alone, is many times the drawing's, the drawing is a
    prior of all that it knows better: noise moves such links together, however far.  Not where
    all sigmas are as large, nor where the drawing contradicts the data: as of another arm.
    """
    model, names, judged = stage.robust.model, task.base.names, task.judged
    active, reasons = model.active, stage.identification.reasons
    within = np.full(names.count, np.inf)
    within[names.links] = np.repeat(task.robot.drawn_within, np.array([2, 3]) * names.joints)
    begin = task.frame.state
    for joint in coaxial_joints(task.robot) if stage.offsets else ():
        within[2 * names.joints + np.array([joint, joint + 1])] = np.inf  # the sum is drawn alone
        mdh = begin.mdh.copy()
        mdh[joint, 0] = stage.state.mdh[joint, 0]
        begin = replace(begin, mdh=mdh)
    spare = 3.0 * (model.counts[judged].sum() + (~judged).sum()) - active.sum()
    noise, times = stage.squares.cost[0] / max(spare, 1.0), np.zeros(names.count)
    for state in (begin, stage.state):  # the fit may have gone astray
        gram = SumOfSquares(model).normal(state)[2]
        variance = noise * np.diag(solve_normal(gram, np.eye(len(gram))))
        sigma = np.sqrt(np.maximum(variance, 0.0))
        times[active] = np.maximum(times[active], sigma / within[active])
    usual = max(float(np.median(times[active & names.links])), 1.0) if times.any() else 1.0
    vague = (times > MAX_DOUBT * usual) & np.isinf(task.sigma)
    if task.robot.rough or not vague.any():
        return task, stage
    not_told = [name for name, why in reasons.items() if why.kind is Because.NOT_TOLD]
    better = (times > usual) | np.isin(names.all, not_told)  # what the drawing knows better
    sigma = np.where(better, np.minimum(task.sigma, within), task.sigma)
    held = replace(task, sigma=sigma)
    found = geometry(held, progress, wide=False)  # near the drawing its base is the best of all
    if stage.squares.cost[0] < MAX_REMAINING_COST * found.squares.cost[0]:
        return task, stage  # the drawing contradicts the data
    named = name_first([names.all[i] for i in np.flatnonzero(vague)], MAX_NAMED)
    length, angle = 1e3 * np.array(task.robot.drawn_within)
    said = (
        f"these poses hardly determine {named}: the drawing holds them, to {length:g} mm and "
        f"{angle:g} mrad (drawn_within of the robot); move all joints farther"
    )
    return held, replace(found, notices=(*found.notices, said))


def wider(
    robot: Robot, model: Model, found: LeastSquares[State], progress: Progress
) -> tuple[LeastSquares[State], tuple[str, ...]]:
    """The fit, or a better one from a search over base rotations where it misses grossly."""
    points = float(model.counts.sum())
    limit = POOR_FIT * robot.reach()

    def miss(fit: LeastSquares[State]) -> float:
        return float(np.sqrt(fit.cost[0] / points))

    if miss(found) <= limit:
        return found, ()
    progress("search over base rotations")
    wide = start.search(model, robot.mdh, points, limit)
    notices: tuple[str, ...] = ()
    if wide.cost[0] < 0.99 * found.cost[0]:
        found = wide
        notices = ("the nominal angles are far off; a search over base rotations found this fit",)
    if miss(found) > limit:
        notices += (
            f"the best fit still misses by {1e3 * miss(found):.3g} mm: check joint signs, units "
            "and the link lengths in the robot file",
        )
    return found, notices


def with_effects(task: Task, stage: Stage) -> tuple[Task, Stage]:
    """The fit with the frames of further sessions, and then the effects, beside the geometry."""
    if free := of_sessions(task.data.frames):
        task, stage = jointly(task, stage, free)
    asked = [e for e in task.options.effects if not (isinstance(e, Term) and e.frees_frames)]
    if not asked:
        return task, stage
    from minimax_cal.evidence.selection import best_variant  # slow to import
    from minimax_cal.modelling.dictionary import ArmLaws

    robust = stage.robust
    scene = scene_of(task.robot, task.data, robust.plain, stage.state)
    rows = linearised(robust.model, stage.state, scene.jacobian)
    found = terms_of(scene, asked, partial(best_variant, ArmLaws(scene, rows)))
    return jointly(task, stage, (*free, *found))


def jointly(task: Task, stage: Stage, terms: tuple[Term, ...]) -> tuple[Task, Stage]:
    """Geometry and effects together; the task with the data where its sessions then stand."""
    robot, robust, identification = task.robot, stage.robust, stage.identification
    for _ in range(EFFECT_PASSES):
        frames, here = turned_in(task.data.frames, robust.state)
        task = replace(task, data=seen_from(task.data, frames))
        y = model_of(robot, task.data).y if frames else task.base.y
        task, plain = replace(task, base=replace(task.base, y=y)), replace(robust.plain, y=y)
        active = identification.active
        model, begin = extended(plain.only(active), robot, task.data, here, terms)
        model = replace(model, room=room_of(task, model, begin, terms))
        identification = task.identified(model, begin, stage.offsets)
        known = identification.active[task.base.names.count :]
        begin = replace(begin, effects=np.where(known, begin.effects, 0.0))
        model, squares = task.squares(model.only(identification.active), begin)
        robust = task.robust(model, squares)
    base = replace(
        task.base, names=model.names, fields=model.fields, moved=model.moved, room=model.room
    )
    return task, Stage(
        base, identification, robust, robust.found, terms, stage.notices, stage.offsets
    )


def room_of(task: Task, model: Model, state: State, terms: tuple[Term, ...]) -> Array:
    """(e, 2) bounds of the effects' parameters; frames of sessions are wherever they stood."""
    scene = scene_of(task.robot, task.data, model, state)
    out = [np.zeros((0, 2))]
    for term in terms:
        allowed = bounds(scene, [term])
        out.append(np.full(allowed.shape, np.inf) * [-1.0, 1.0] if term.frees_frames else allowed)
    return np.concatenate(out)


def without_resting(known: Identification, names: Names, rests: Array) -> Identification:
    """The parameters that the poses tell, without those of effects (e,) that rest at a bound."""
    gone = np.pad(rests, (names.geometric, 0)) & known.active
    said = dict.fromkeys((names.all[i] for i in np.flatnonzero(gone)), Reason(AT_BOUND))
    return replace(known, active=known.active & ~gone, reasons={**known.reasons, **said})


def worst_case(
    task: Task, model: Model, state: State, distances: Distances, progress: Progress
) -> tuple[Optimum[State] | None, Certificate | None, tuple[str, ...]]:
    """The minimax answer and its certificate, where the objective asks for one, and notices."""
    options = task.options
    per = PER.get(options.objective)
    if per is None or (per == "target" and len(task.share) == 1):
        return None, None, ()
    progress("minimax")
    problem = minimax_problem(model, state, distances, options.distance, per)
    qp, notices = solver_of(options.qp, QP_TOLERANCE)
    settings = Sqp(hessian=options.hessian)
    links = model.active[: 5 * task.robot.joints]
    other = not options.allow_large_changes and too_changed(task.robot, state.mdh, links)
    if other or problem.size > (MIN_HOPELESS_MISS * task.robot.reach()) ** 2:
        settings = replace(settings, iterations=min(settings.iterations, LAST_STEPS))
    optimum = minimax.solve(problem, state, qp, settings)
    if len(model.room):
        effects = settled(optimum.x.effects, model.room)
        optimum = replace(optimum, x=replace(optimum.x, effects=effects))
    if optimum.status is Status.STALLED and optimum.value * problem.size < MAX_ROUNDING**2:
        # nothing but rounding is left; the last note says how much that is
        optimum = replace(optimum, status=Status.CONVERGED, notes=optimum.notes[:-1])
    certificate = None
    if per == "point" and optimum.status is not Status.FAILED:
        certificate = certify(problem, optimum, task.data.line)
    return optimum, certificate, (*notices, *(f"QP: {note}" for note in optimum.notes))


def shares(task: Task, model: Model, optimum: Optimum[State] | None) -> Array:
    """How much each target (k,), or each point (k, m) of the worst, counts in the fit."""
    if optimum is None:
        return task.share
    if PER[task.options.objective] == "point":
        return point_share(optimum.mu, model.seen)
    return np.asarray(np.maximum(optimum.mu, MIN_TARGET_WEIGHT) * model.counts.sum() / model.counts)
