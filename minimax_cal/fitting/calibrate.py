"""Calibrate a robot: from measurements to parameters with their uncertainty and honest accuracy."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import qp_backends
from minimax_cal.evidence.noise import linearised
from minimax_cal.evidence.selection import best_variant
from minimax_cal.fitting import identify, start
from minimax_cal.fitting.calibration import Calibration, Parameter, Provenance
from minimax_cal.fitting.certificate import Certificate, certify
from minimax_cal.fitting.checks import POOR_FIT, check_plausible
from minimax_cal.fitting.identify import Identification
from minimax_cal.fitting.minimax_problem import (
    DISTANCE_FORMS,
    Distances,
    measured_distances,
    minimax_problem,
)
from minimax_cal.fitting.robust import SQUARE, Robust, check_robust, flatness, robust_fit
from minimax_cal.fitting.start import BaseFit
from minimax_cal.fitting.uncertainty import Estimator, Uncertainty, point_share, uncertainty_of
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.measuring import checks
from minimax_cal.measuring.accuracy import accuracy
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements, groups, read_measurements, split
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import Fitted, Term, names_of
from minimax_cal.modelling.effects.table import terms as terms_of
from minimax_cal.modelling.joint_fit import extended, fitted, scene_of
from minimax_cal.modelling.model import (
    NO_MIX,
    Model,
    Prior,
    SumOfSquares,
    model_of,
    pose_weights,
    with_poses,
)
from minimax_cal.modelling.parameters import Names, State, links_of
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.solvers import least_squares, minimax
from minimax_cal.solvers.least_squares import METHODS, LeastSquares, solve_normal
from minimax_cal.solvers.minimax import Optimum, Sqp
from minimax_cal.solvers.status import Status
from qp_backends import BackendError, Problem
from qp_backends import solve as solve_qp

QP_TOLERANCE = 1e-9
FALLBACK = "daqp"  # a required package
TRIVIAL = Problem(np.eye(1), np.zeros(1), np.zeros((0, 1)), np.zeros(0), np.zeros(0))
# With smr:K the other targets follow the geometry without pulling at it: a weight that is nothing
# beside 1, but leaves their own coordinates determined.
ASIDE = 1e-9
PASSES = 2  # of a fit with effects: the second takes finite turns into account
FLOOR = 1e-3  # least weight of a target in a covariance, as in the SQP's Hessian
LEAST_NOISE = 5e-6  # of a coordinate, when a fit with priors leaves no residual to judge by [m]
DOUBTED = 0.5  # a point of less weight tells no distance between targets
LEAST_POSES = 3  # of a target in the fit; with fewer its own place explains all
WILD_ANGLE = 0.05  # no joint of a whole robot is farther from its drawing [rad]


@dataclass(frozen=True)
class Options:
    """How to calibrate.

    objective: sum, minimax (the worst target), point (the worst point), pose, or smr:K.
    lever: metres that a radian counts as in the pose objective, NaN for the targets' own.
    qp: backend of the minimax QPs.  holdout: share of the poses kept out of the fit.
    seed: of that choice.  fix, free: names or patterns as ``beta*``.
    priors: sigma of a parameter's deviation from nominal by name or pattern [m, rad].
    method: of the least squares.  hessian: gauss-newton or bfgs.  distance: form of the
    distance constraints, two-sided, squared or off.  distance_tolerance: [m], NaN for the
    instrument's own accuracy.  resolution: relative singular value that counts as not measured.
    effects: beyond geometry, fitted jointly, as joint_compliance:J2 or backlash:all.
    loss: of the distances in the least squares: square, huber, cauchy or tukey.
    trim: at most this share of the points, those that stand out, is set aside.
    """

    objective: str = "minimax"
    qp: str = "daqp"
    holdout: float = 0.2
    seed: int = 0
    fix: Sequence[str] = ()
    free: Sequence[str] = ()
    priors: Mapping[str, float] = field(default_factory=dict)
    method: str = "snllm"
    lever: float = np.nan
    hessian: str = "gauss-newton"
    distance: str = "two-sided"
    distance_tolerance: float = np.nan
    resolution: float = identify.RESOLUTION
    effects: Sequence[str | Term] = ()
    loss: str = SQUARE
    trim: float = 0.0


Progress = Callable[[str], None]


def silent(message: str) -> None:
    """Say nothing."""


def calibrate(
    robot: Robot | str | Path,
    data: Measurements | str | Path,
    objective: str = "minimax",
    qp: str = "daqp",
    progress: Progress = silent,
    **options: object,
) -> Calibration:
    """Calibrate a robot from measurements.

    robot, data: loaded, or a name or path.  options: the fields of `Options`.  progress: called
    with a word on each stage.  Raises CalibrationError for wrong input; how the numbers ended
    is in the result's `status`.
    """
    for name in ("fix", "free", "effects"):
        if isinstance(options.get(name), str):
            options[name] = tuple(filter(None, str(options[name]).replace(" ", "").split(",")))
    chosen = Options(objective=objective, qp=qp, **options)  # type: ignore[arg-type]
    began = time.perf_counter()
    robot = robot if isinstance(robot, Robot) else load_robot(robot)
    data = data if isinstance(data, Measurements) else read_measurements(data)
    objective_of(chosen.objective, data)
    check_options(chosen)
    usable(chosen.qp)
    checks.check_joints(robot, data)
    checks.check_spread(data)
    if chosen.effects:
        data = with_history(data)  # the way to a pose is lost once its predecessor is held out
    train, held, notices = split(data, chosen.holdout, chosen.seed)
    notices = (*data.notices, *checks.limit_notices(robot, data), *notices)
    few = train.seen.sum(axis=0) < LEAST_POSES
    if few.any() and not few.all():
        names = ", ".join(np.array(data.target_names)[few])
        notices += (f"left out: {names}, measured at fewer than {LEAST_POSES} training poses",)
        data, train, held = data.keep(~few), train.keep(~few), held.keep(~few)
        objective_of(chosen.objective, data)
    if len(np.unique(groups(train))) >= LEAST_POSES:
        check_plausible(robot, data)
    progress("start")
    fit = fit_cell(robot, train, chosen, progress)
    calibrated = Cell.of(robot, fit.state, data.target_names, fit.effects)
    nominal = Cell.of(robot, fit.nominal, data.target_names)
    errors = {
        "nominal": nominal.error(held),
        "train": calibrated.error(train),
        "holdout": calibrated.error(held),
        "nominal_train": nominal.error(train),
    }
    notices += fit.notices
    notices += tuple(remarks(chosen, data, train, held))
    notices += tuple(checks.outliers(data, np.linalg.norm(calibrated.error(data), axis=-1)))
    notices += tuple(doubts(robot, fit, errors["nominal_train"]))
    return Calibration(
        robot=calibrated.robot,
        cell=calibrated,
        nominal=nominal,
        objective=chosen.objective,
        qp=chosen.qp,
        status=fit.status,
        iterations=fit.iterations,
        seconds=time.perf_counter() - began,
        parameters=parameter_table(robot, fit),
        accuracy={key: accuracy(error) for key, error in errors.items()},
        errors=errors,
        identification=fit.identification,
        uncertainty=fit.uncertainty,
        worst=fit.worst,
        certificates=fit.certificates,
        distances=fit.distances,
        trace=fit.trace,
        data=data,
        held=np.isin(data.line, held.line),
        notices=notices,
        loss=chosen.loss,
        suspects=fit.robust.suspects,
        weights=fit.robust.weights,
        provenance=Provenance.of(robot, data, settings_of(chosen)),
    )


def settings_of(options: Options) -> dict[str, object]:
    """The options for the record, effects in their written form."""
    effects = [e.text if isinstance(e, Term) else e for e in options.effects]
    return {**vars(options), "effects": effects}


def remarks(
    options: Options, data: Measurements, train: Measurements, held: Measurements
) -> list[str]:
    """What the reader should know about the data behind a result."""
    out = []
    if not held.poses:
        out.append("no pose is held out: nothing here says how the fit does on new poses")
    if options.objective == "minimax" and len(data.target_names) == 1:
        out.append("there is one target: minimax and sum are the same")
    if checks.collinear(train):
        out.append(
            "the targets lie nearly on a line: positions are fine, but orientations about that "
            "line would not be determined"
        )
    return out


def objective_of(objective: str, data: Measurements) -> int:
    """Index of the single target of smr:K, else -1.  Raises OptionError."""
    if objective in ("sum", "minimax", "point", "pose"):
        return -1
    kind, _, which = objective.partition(":")
    if kind != "smr" or not which:
        raise OptionError(
            f"no objective {objective!r}; choose sum, minimax, point, pose or smr:K (K as in smr1)"
        )
    if f"smr{which}" not in data.target_names:
        raise OptionError(
            f"objective {objective}: {data.source} has no target smr{which}; "
            f"it has {', '.join(data.target_names)}"
        )
    return data.target_names.index(f"smr{which}")


def check_options(options: Options) -> None:
    """Raise an error for a choice that does not exist, before any work."""
    for name, value, choices in (
        ("method", options.method, tuple(METHODS)),
        ("hessian", options.hessian, minimax.HESSIANS),
        ("distance form", options.distance, DISTANCE_FORMS),
    ):
        if value not in choices:
            raise OptionError(f"no {name} {value!r}; choose {', '.join(choices)}")
    check_robust(options.loss, options.trim)
    if not 0.0 <= options.resolution < 1.0:
        raise OptionError(f"resolution {options.resolution:g}: give 0 <= resolution < 1")
    if options.lever <= 0.0 or np.isinf(options.lever):
        raise OptionError(f"lever {options.lever:g} m: must be positive and finite")
    if options.distance_tolerance <= 0.0 or np.isinf(options.distance_tolerance):
        raise OptionError(
            f"distance tolerance {options.distance_tolerance:g} m: must be positive and finite"
        )
    for pattern, sigma in options.priors.items():
        if not (np.isfinite(sigma) and sigma > 0.0):
            raise OptionError(f"prior {pattern}: sigma {sigma:g} must be positive")


def usable(qp: str) -> tuple[str, tuple[str, ...]]:
    """The QP backend to use, and a notice where it is not the one that was named.

    A backend that exists but is not installed is replaced; a name that does not exist is a
    mistake.  Raises OptionError.
    """
    try:
        solve_qp(TRIVIAL, qp)
    except BackendError as error:
        if qp.partition(":")[0] not in qp_backends.names():
            raise OptionError(str(error)) from error
        return FALLBACK, (f"QP: {error}; {FALLBACK} is used",)
    return qp, ()


@dataclass(frozen=True, eq=False)
class Fit:
    """What the solvers found.

    nominal: the nominal geometry with its best base and targets.  state: the calibrated one.
    estimator: how the poses were weighed.  group: (m,) rows with one number are one pose.
    worst: the minimax answer, where there was one to find.  certificates: of the worst point.
    trace: cost at each iterate of the least squares [m^2].
    effects: those asked for, with their values; units: of each value.
    robust: the weights of the points, and which stand out.
    """

    names: Names
    nominal: State
    state: State
    identification: Identification
    estimator: Estimator
    group: Array
    status: Status
    iterations: int
    worst: tuple[Optimum[State], ...]
    certificates: tuple[Certificate, ...]
    distances: Distances
    trace: tuple[float, ...]
    notices: tuple[str, ...]
    effects: Fitted
    units: tuple[str, ...]
    robust: Robust

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Of all parameters, the base's along its own axes."""
        found = uncertainty_of(self.estimator, self.state, self.group, self.units)
        return found.widened(flatness(self.robust, self.state))


def fit_cell(robot: Robot, data: Measurements, options: Options, progress: Progress) -> Fit:
    """Fit the chosen objective to all poses of the data."""
    base = model_of(robot, data)
    names, k = base.names, len(data.target_names)
    allowed, order, sigma = wishes(robot, base, options)
    reference = identify.plenty_of_poses(robot, base)
    unknowns = identify.generic_count(robot, reference, order, allowed)
    only = objective_of(options.objective, data)
    telling = data if only < 0 else data.only(only)
    following = 0 if only < 0 else 3 * (k - 1)  # coordinates of targets that follow
    poses, known = len(np.unique(groups(telling))), int(np.isfinite(sigma[allowed]).sum())
    checks.check_count(telling, poses, unknowns - following, known)
    frame = start.fit_base(base, robot.mdh)

    progress("identifiable parameters")
    share = np.ones(k) if only < 0 else np.where(np.arange(k) == only, 1.0, ASIDE)
    weights = NO_MIX
    aside, model = share, base.emphasise(share)
    if options.objective == "pose":
        check_poses(data)
        weights = pose_weights(data, options.lever)
    found = identify.identify(
        model,
        frame.state,
        order,
        allowed=allowed,
        reference=reference,
        known=np.isfinite(sigma),
        resolution=options.resolution,
    )
    progress("least squares")
    model, squares = least(model.only(found.active), frame, sigma, options)

    def resist(model: Model, found: LeastSquares[State], sigma: Array) -> Robust:
        def again(model: Model, state: State) -> tuple[Model, LeastSquares[State]]:
            return least(model, replace(frame, state=state), sigma, options)

        return robust_fit(again, model, found, data.line, options.loss, options.trim, share > ASIDE)

    robust = resist(model, squares, sigma)
    # a few gross outliers are no reason to search: what counts is how the believed points are met
    squares, notices = wider(robot, robust.model, robust.fit, progress)
    if squares is not robust.fit:
        robust = resist(robust.plain, squares, sigma)
    terms: tuple[Term, ...] = ()
    if options.effects:
        progress("effects")
        here = robust.fit.x.take(np.array(0))
        scene = scene_of(robot, data, model, here)
        rows = linearised(robust.model, here, scene.jacobian)
        terms = terms_of(scene, options.effects, partial(best_variant, scene, rows))
        known_ones = np.isfinite(sigma)
        for _ in range(PASSES):
            here = robust.fit.x.take(np.array(0))
            model, begin = extended(robust.plain.only(found.active), robot, data, here, terms)
            more = len(model.fields)
            found = identify.identify(
                model,
                begin,
                np.concatenate([np.arange(names.count, names.count + more), order]),
                allowed=np.pad(allowed, (0, more), constant_values=True),
                reference=reference,
                known=np.pad(known_ones, (0, more)),
                resolution=options.resolution,
            )
            told = found.active[names.count :]
            begin = replace(begin, effects=np.where(told, begin.effects, 0.0))
            wide = np.pad(sigma, (0, more), constant_values=np.inf)
            model, squares = least(
                model.only(found.active), replace(frame, state=begin), wide, options
            )
            robust = resist(model, squares, wide)
        base = replace(base, names=model.names, fields=model.fields, moved=model.moved)
    squares, notices = robust.fit, (*notices, *robust.notices)
    model = robust.model
    if len(weights):
        model = robust.by_pose
        # the turn that fits the errors best vanishes for half a turn too: start near the answer
        problem = SumOfSquares(with_poses(model, weights))
        points = float(model.counts.sum())
        method = METHODS[options.method]
        squares = least_squares.solve(problem, squares.x, 1, points, method, least_squares.NEAR)
    state, status = squares.x.take(np.array(0)), squares.status[0]
    iterations = int(squares.iterations[0]) + robust.rounds
    believed = np.where(robust.weights.T[..., None] > DOUBTED, data.y, np.nan)
    distances = measured_distances(data.with_y(believed), options.distance_tolerance)
    worst: tuple[Optimum[State], ...] = ()
    proofs: tuple[Certificate, ...] = ()
    per = {"minimax": "target", "point": "point"}.get(options.objective, "")
    if per == "point" or (per == "target" and k > 1):
        progress("minimax")
        worst_case = minimax_problem(model, state, distances, options.distance, per)
        name, said = usable(options.qp)
        qp = partial(solve_qp, name=name, tolerance=QP_TOLERANCE)
        best = minimax.solve(worst_case, state, qp, Sqp(hessian=options.hessian))
        if per == "point" and best.status is not Status.FAILED:
            proofs = (certify(worst_case, best, data.line),)
        state, status, worst = best.x, best.status, (best,)
        iterations += best.iterations
        if per == "target":
            share = np.maximum(best.mu, FLOOR) * model.counts.sum() / model.counts
        else:
            share = point_share(best.mu, model.seen)
        notices += (*said, *(f"QP: {note}" for note in best.notes))
    scene = scene_of(robot, data, model, state)
    return Fit(
        names=model.names,
        nominal=frame.state,
        state=state,
        identification=found,
        estimator=Estimator(
            replace(base, weight=model.weight / aside[:, None])
            .only(found.active)
            .with_prior(model.prior),
            share,
            weights,
        ),
        group=groups(data),
        status=status,
        iterations=iterations,
        worst=worst,
        certificates=proofs,
        distances=distances,
        trace=tuple(float(value) for value in squares.trace[:, 0]),
        notices=notices,
        effects=fitted(terms, scene, state.effects),
        units=names_of(terms, scene)[1],
        robust=robust,
    )


def check_poses(data: Measurements) -> None:
    """Raise OptionError if the targets give no orientation."""
    if len(data.target_names) < 3 or checks.collinear(data):
        raise OptionError("objective pose needs three targets that are not on a line")
    whole = int(data.seen.all(axis=1).sum())
    if whole < LEAST_POSES:
        raise OptionError(
            f"objective pose needs poses at which all targets were measured; there are {whole}"
        )


def wishes(robot: Robot, model: Model, options: Options) -> tuple[Array, Array, Array]:
    """What the user asked of the parameters: allowed (p,), order to give up, prior sigma (p,)."""
    names = model.names
    allowed = ~names.match(options.fix, "--fix")
    order = identify.drop_order(robot, names)
    wanted = names.match(options.free, "--free")
    if (wanted & ~allowed).any():
        name = names.all[int(np.argmax(wanted & ~allowed))]
        raise OptionError(f"{name} is both fixed and freed; take it out of --fix or --free")
    order = np.concatenate([order[~wanted[order]], order[wanted[order]]])
    sigma = np.full(names.count, np.inf)
    for pattern, value in options.priors.items():
        chosen = names.match([pattern], "--prior")
        if (chosen & ~names.links).any():
            raise OptionError(
                f"--prior {pattern}: base and targets have no nominal value to keep to"
            )
        sigma[chosen] = value
    return allowed, order, sigma


def least(
    model: Model, frame: BaseFit, sigma: Array, options: Options
) -> tuple[Model, LeastSquares[State]]:
    """Least squares from the nominal start; with priors, weighed against the noise that remains."""
    points = float(model.counts.sum())
    method = METHODS[options.method]
    mean_square = frame.mean_square / 3.0
    for _ in range(20 if np.isfinite(sigma).any() else 1):
        model = model.with_prior(Prior(model.prior.mean, mean_square / sigma**2))
        problem = SumOfSquares(model)
        begin = frame.state.batch()
        found = least_squares.solve(problem, begin, 1, points, method, least_squares.NEAR)
        state = found.x.take(np.array(0))
        _, _, gram = problem.normal(state)
        weight = np.diag(model.prior.weight[model.active])
        fitted = np.trace(solve_normal(gram, gram - weight))  # parameters the data pay for
        previous = mean_square
        dof = max(3.0 * points - fitted, 1.0)
        mean_square = max(float(model.cost(state).sum()) / dof, LEAST_NOISE**2)
        if abs(mean_square - previous) <= 0.01 * previous:
            break
    return model, found


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


def doubts(robot: Robot, fit: Fit, nominal_error: Array) -> list[str]:
    """Notices where the result is no calibration of this robot but of another one."""
    reach, notices = robot.reach(), []
    miss = float(np.sqrt(np.nanmean(np.nansum(nominal_error**2, axis=-1))))
    if miss > POOR_FIT * reach:
        notices.append(
            f"the nominal robot misses by {1e3 * miss:.3g} mm: check that it is the robot of these "
            "measurements, with their joint signs, zero positions and units"
        )
    change = (fit.state.mdh - fit.nominal.mdh).T.reshape(-1)
    length = fit.names.linear[: len(change)]
    wild = np.abs(change) > np.where(length, 0.02 * reach, WILD_ANGLE)
    if wild.any():
        named = ", ".join(
            f"{fit.names.all[i]} by {1e3 * change[i]:+.4g} {'mm' if length[i] else 'mrad'}"
            for i in np.flatnonzero(wild)[:5]
        )
        notices.append(f"implausibly large changes: {named}; is the robot file the right one?")
    return notices


def parameter_table(robot: Robot, fit: Fit) -> tuple[Parameter, ...]:
    """Every parameter, link by link.

    Base entries are measured along the nominal base's own axes: its origin as seen from the
    instrument, and its turn from the nominal orientation (the pose itself is `Cell.base`).
    """
    names, n = fit.names, robot.joints
    known = fit.identification.active
    sigma = fit.uncertainty.sigma
    axes = fit.nominal.rotation

    def values(x: State) -> Array:
        turn = Rotation.from_matrix(axes.T @ x.rotation).as_rotvec()
        parts = (links_of(x.mdh), axes.T @ x.origin, turn, x.target_positions.reshape(-1))
        return np.concatenate([*parts, x.effects if len(x.effects) else np.zeros(len(fit.units))])

    before, linear = values(fit.nominal), names.linear
    units = [*("m" if length else "rad" for length in linear[: names.geometric]), *fit.units]
    value = np.where(known, values(fit.state), before)
    order = [kind * n + joint for joint in range(n) for kind in range(5)]
    order += range(5 * n, names.count)
    return tuple(
        Parameter(
            name=names.all[i],
            value=float(value[i]),
            nominal=float(before[i]),
            sigma=float(sigma[i]),
            unit=units[i],
            identifiable=bool(known[i]),
            reason=fit.identification.reasons.get(names.all[i], ""),
        )
        for i in order
    )
