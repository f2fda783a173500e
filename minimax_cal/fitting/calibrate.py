"""Calibrate a robot: from measurements to parameters with their uncertainty and honest accuracy."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from minimax_cal.fitting import identify
from minimax_cal.fitting.between_sessions import between_sessions
from minimax_cal.fitting.checks import (
    POOR_FIT,
    check_plausible,
    coarse_joints,
)
from minimax_cal.fitting.claims import (
    bad_rows,
    beyond_of,
    crossed_of,
    drawn_crossed_of,
    is_crossed,
    unjudged,
    unseen_suspects,
)
from minimax_cal.fitting.common_scale import common_share
from minimax_cal.fitting.crossed import NOT_CROSSED, few_poses
from minimax_cal.fitting.fit import (
    Fit,
    KeptDistance,
    Parameters,
    Provenance,
    Work,
    WorstCase,
    link_by_link,
)
from minimax_cal.fitting.improvement import no_better, rms_of, said_without
from minimax_cal.fitting.opened import Writes, listed_effects
from minimax_cal.fitting.options import (
    Options,
    Progress,
    QpFunction,
    check_options,
    listed,
    objective_of,
    qp_name,
    sigmas_of,
    silent,
    usable,
)
from minimax_cal.fitting.outcome import (
    compared,
    exchanged_rows,
    hidden,
    impossible,
    said_of_exchanged,
)
from minimax_cal.fitting.robust import SQUARE
from minimax_cal.fitting.same_arm import wild
from minimax_cal.fitting.second_visits import contradictions
from minimax_cal.fitting.set_aside import judged_with
from minimax_cal.fitting.solve import LEAST_POSES, PER, Solved, fit_cell
from minimax_cal.fitting.start import EVERYWHERE
from minimax_cal.fitting.stations import jumps, stationed, unplaced
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationWarning
from minimax_cal.measuring import campaigns, checks, faults
from minimax_cal.measuring.accuracy import accuracy
from minimax_cal.measuring.aside import TOOL
from minimax_cal.measuring.faults.declared import noise
from minimax_cal.measuring.grouping import groups, mislabelled, split, with_groups
from minimax_cal.measuring.history import time_notices, with_history
from minimax_cal.measuring.instrument import with_instrument
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.measuring.set_aside import set_aside
from minimax_cal.measuring.stations import Frames, seen_from
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.effects.time import SESSION_JUMP
from minimax_cal.modelling.parameters import State, links_of
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.solvers.least_squares import AUTO, name_of
from minimax_cal.solvers.status import Status

JUMP = (SESSION_JUMP.name, f"{SESSION_JUMP.name}:frame")  # without its moment
TOLD = 1e-6  # a point of a smaller multiplier does not decide
ACTIVE = 1e-6  # a function equals the largest, relative
ENDED = (Status.CONVERGED, Status.ITERATION_LIMIT, Status.STALLED)  # with an arm to compare


@dataclass(frozen=True, eq=False)
class Parts:
    """Measurements as they are used: all poses, those of the fit, those held out; remarks.

    near: (3, 3) rotation of the base that fits all poses best, where it was looked for.
    """

    data: Measurements
    train: Measurements
    held: Measurements
    notices: tuple[str, ...]
    near: Array = field(default_factory=lambda: EVERYWHERE)


def calibrate(
    robot: Robot | str | Path,
    data: Measurements | str | Path | Sequence[str | Path] | tuple[ArrayLike, ArrayLike],
    objective: str = "minimax",
    qp: str | QpFunction = "daqp",
    *,
    holdout: float = 0.2,
    seed: int = 0,
    holdout_by: str | None = None,
    cv: bool = False,
    instrument: str | None = None,
    fix: str | Sequence[str] = (),
    free: str | Sequence[str] = (),
    only: str = "",
    priors: Mapping[str, float | str] | None = None,
    method: str = AUTO,
    lever: float | None = None,
    hessian: str = "gauss-newton",
    distance: str = "two-sided",
    distance_tolerance: float | None = None,
    resolution: float = identify.RESOLUTION,
    effects: str | Path | Writes | Sequence[str | Path | Term] = (),
    loss: str = SQUARE,
    trim: float = 0.0,
    allow_large_changes: bool = False,
    simulated: bool = False,
    progress: Progress = silent,
) -> Fit:
    """Calibrate a robot from measurements.

    robot, data: loaded, or a name or path; data also as joints (m, n) and points (m, 3) or (m, k,
    3), or a list of paths: the campaigns of one arm, each a session. objective: sum, minimax
    (the worst target), point (the worst point), pose, or smr:K. qp: backend of the minimax QPs,
    or a function from Problem to a verified Solution. holdout: share of the poses kept out of
    the fit; seed: of that choice; holdout_by: a column (session, group ...) or region, whose
    poses are held out together. instrument: u95 of a coordinate, as 10um+2.5um/m, where the
    data do not say. cv: judge every pose by a fit without it, which is done anyway where fewer
    than 20 poses are held out. fix, free: parameters as ``beta*``, a list or a text with
    commas. only: offsets, for the joints' zero positions alone. priors: sigma of a parameter's
    deviation from nominal, by name [m, rad], or a text as 0.5mm. method: of the least squares.
    lever: what a radian counts as in the pose objective [m], the targets' own unless given.
    hessian: gauss-newton or bfgs. distance: form of the distance constraints, two-sided,
    squared or off; distance_tolerance: theirs [m], as measured unless given. resolution:
    relative singular value that counts as not measured. effects: beyond geometry, as
    joint_compliance:J2, or a diagnosis (or its file), whose confirmed effects are taken.
    loss: square, huber, cauchy or tukey. trim: share of the points that may be set aside.
    allow_large_changes: accept links that differ from the drawing by more than 5 % of the
    reach, 5 degrees (alpha, beta) or 30 degrees (theta). simulated: the points may be exact.
    progress: called with a word on each stage. Raises CalibrationError for wrong input; how the
    numbers ended is in the result's `status`.

    >>> print(mc.calibrate("irb2600", "poses.csv", objective="sum", holdout=0.3).summary())
    """
    began = time.perf_counter()
    options = Options(
        objective=objective,
        qp=qp,
        holdout=holdout,
        seed=seed,
        holdout_by=holdout_by,
        cv=cv,
        instrument=instrument,
        fix=listed(fix),
        free=listed(free),
        only=only,
        priors=sigmas_of(priors or {}),
        method=method,
        lever=lever,
        hessian=hessian,
        distance=distance,
        distance_tolerance=distance_tolerance,
        resolution=resolution,
        effects=listed_effects(effects),
        loss=loss,
        trim=trim,
        allow_large_changes=allow_large_changes,
        simulated=simulated,
    )
    robot = robot if isinstance(robot, Robot) else load_robot(robot)
    data = measured(data)
    data = checked(robot, data, options)
    poses = parted(robot, data, options)
    progress("start")
    options = with_jump(robot, poses, options, progress)
    solved = fit_cell(robot, poses.train, options, progress, poses.near)
    fit, doubts = judged(robot, options, poses, solved, began)
    for doubt in doubts:
        warnings.warn(doubt, CalibrationWarning, stacklevel=2)
    return fit


def measured(
    data: Measurements | str | Path | Sequence[str | Path] | tuple[ArrayLike, ArrayLike],
) -> Measurements:
    """Measurements as they are, of files, or of joints (m, n) and points.  Raises DataError."""
    if isinstance(data, tuple) and not all(isinstance(part, str | Path) for part in data):
        return measurements(*(np.asarray(part, dtype=float) for part in data))
    return campaigns.measured(data)  # type: ignore[arg-type]


def again(fit: Fit, progress: Progress = silent, **changes: object) -> Fit:
    """A fit of the same poses, split as they were, with some options changed.

    changes: fields of `Options`.  Raises CalibrationError.
    """
    options = replace(fit.options, **changes)  # type: ignore[arg-type]
    return fit_split(fit.before.robot, fit.data, fit.held, options, progress)


def fit_split(
    robot: Robot, data: Measurements, held: Array, options: Options, progress: Progress = silent
) -> Fit:
    """A fit of poses that are split already, as a result holds them.

    held: (m,) True where held out.  Raises CalibrationError.
    """
    began = time.perf_counter()
    data = checked(robot, data, options)
    poses = Parts(data, data.take(~held), data.take(held), data.notices)
    solved = fit_cell(robot, poses.train, options, progress)
    return judged(robot, options, poses, solved, began)[0]


def checked(robot: Robot, data: Measurements, options: Options) -> Measurements:
    """The data with all joints of the arm.  Raises an error, before any work, for what cannot be
    done.
    """
    objective_of(options.objective, data)
    check_options(options)
    if isinstance(options.qp, str):
        usable(options.qp)
    data = checks.check_joints(robot, data)
    checks.check_spread(robot, data)
    return data


def parted(robot: Robot, data: Measurements, options: Options) -> Parts:
    """Training and held-out poses; targets that hardly any pose shows are left out."""
    if options.effects:
        data = with_history(data)  # the way to a pose is lost once its predecessor is held out
    data = with_groups(with_instrument(data, options.instrument))
    data = replace(data, simulated=data.simulated or options.simulated)
    train, held, said = split(data, options.holdout, options.seed, options.holdout_by)
    kept = np.isin(data.line, train.line)
    said = (*said, *unplaced(data, kept))
    data = stationed(robot, data, kept)
    train, held = seen_from(train, data.frames), seen_from(held, data.frames)
    doubts = (*checks.limit_notices(robot, data), *time_notices(data), mislabelled(data))
    off = (*faults.distance_faults(data), *noise(data))
    doubts = (*doubts, *(fault.text for fault in off))
    notices = (*data.notices, *filter(None, doubts), *said)
    few = train.seen.sum(axis=0) < LEAST_POSES
    if few.any() and not few.all():
        names, why = ", ".join(np.array(data.target_names)[few]), f"fewer than {LEAST_POSES} poses"
        notices += (f"left out: {names}, measured at fewer than {LEAST_POSES} training poses",)
        data = set_aside(data, data.seen & few, f"the fit has {why} with this target", TOOL)
        data, train, held = (part.keep(~few) for part in (data, train, held))
        objective_of(options.objective, data)
    near = EVERYWHERE
    if len(np.unique(groups(train))) >= LEAST_POSES:
        given = check_plausible(robot, data)
        near = given.state.rotation
        notices += tuple(filter(None, [coarse_joints(robot, data, given)]))
    return Parts(data, train, held, notices, near)


def with_jump(robot: Robot, poses: Parts, options: Options, progress: Progress) -> Options:
    """The options with the moment of a jump that was asked for without one.

    That of the largest in the errors of the geometry, on all poses: held-out ones between the last
    training pose before it and the first one after could not be placed otherwise.
    """
    if not any(text in JUMP for text in options.effects):
        return options
    plain = replace(options, effects=(), objective="sum")
    cell = fit_cell(robot, poses.train, plain, progress).cell(robot, poses.data)
    rows, sizes = faults.jumps(cell.placed(poses.data), cell.error(poses.data))
    if not len(rows):
        return options
    since = float(poses.data.columns["clock"][rows[np.argmax(sizes)]])
    found = Term(SESSION_JUMP.name, "frame", {"since": since})
    return replace(options, effects=[found if e in JUMP else e for e in options.effects])


def judged(
    robot: Robot, options: Options, poses: Parts, solved: Solved, began: float
) -> tuple[Fit, tuple[str, ...]]:
    """The fit with its accuracy on training and on held-out poses, and what is alarming."""
    held = np.isin(poses.data.line, poses.held.line)
    cell = solved.cell(robot, poses.data)
    nominal = solved.nominal_cell(robot, poses.data, cell.sessions.clock)
    data = cell.placed(poses.data)
    before, after = nominal.error(data), cell.error(data)
    suspects = (*solved.robust.suspects, *unseen_suspects(robot, data, held, solved))
    drawn_crossed = crossed = NOT_CROSSED
    if is_crossed(options, poses.held):
        crossed = crossed_of(robot, options, data, held, solved)
        drawn_crossed = drawn_crossed_of(robot, options, data, held, solved)
    swapped = exchanged_rows(robot, data, before)
    wrong = impossible(robot, options, solved, data, held, before, after, swapped, suspects)
    unseen = (drawn_crossed, crossed) if crossed.size else hidden(before, after, ~held)
    better = compared(options, solved, data, unseen, suspects)
    status, reason = solved.status, wrong
    if wrong:
        status = Status.FAILED
    elif better and not better.is_better and status in ENDED:
        status, reason = Status.NO_BETTER, no_better(better, suspects)
    moved = () if wrong else between_sessions(robot, poses.train, solved, cell)
    gone, counted = judged_with(data, held, cell, after, crossed, solved, options)
    alarming = tuple(alarms(robot, poses, solved, before[:, ~held]))
    notices = (
        *poses.notices,
        *solved.notices,
        *remarks(options, poses),
        *checks.outliers(data, np.linalg.norm(after, axis=-1)),
        *contradictions(data, after),
        *(fault.text for fault in faults.session_jumps(data, after)),
        *(change.sentence for change in moved),
        *alarming,
        *bad_rows(suspects, data.source),
        *unjudged(data, crossed),
        *([said_of_exchanged(data, swapped)] if len(swapped) and not wrong else []),
        *([said_without(better, rms_of(*unseen))] if better and better.wrong else []),
        *([reason] if reason else []),
    )
    fit = Fit(
        cell=cell,
        nominal=nominal,
        objective=options.objective,
        qp=qp_name(options.qp),
        status=status,
        iterations=solved.iterations,
        seconds=time.perf_counter() - began,
        parameters=parameters_of(robot, solved),
        accuracy={
            "nominal": accuracy(before[:, held]),
            "train": accuracy(after[:, ~held]),
            "holdout": accuracy(after[:, held]),
            "nominal_train": accuracy(before[:, ~held]),
            **({"holdout_with_them": counted.accuracy} if counted else {}),
        },
        identification=solved.identification,
        uncertainty=solved.uncertainty,
        minimax=worst_case(options.objective, solved, poses.train, after[:, ~held]),
        certificate=solved.certificate,
        trace=tuple(float(value) for value in solved.squares.trace[:, 0]),
        data=data,
        held=held,
        error_nominal=before,
        error=after,
        notices=notices,
        loss=options.loss,
        suspects=suspects,
        weights=solved.robust.weights,
        share=solved.estimator.share,
        prior=solved.estimator.model.prior.weight,
        widening=solved.widening,
        provenance=Provenance.of(robot, data, options.settings()),
        claim=partial(beyond_of, robot, options, data, held, solved, suspects),
        error_crossed=crossed,
        set_aside=gone,
        with_them=counted,
        answered=solved.optimum.answered if solved.optimum else {},
        work=work_of(solved),
        error_drawn_crossed=drawn_crossed,
        reason=reason,
        moved=moved,
    )
    return fit, alarming


def work_of(solved: Solved) -> Work:
    """What the solvers did."""
    method, best = name_of(solved.squares.method), solved.optimum
    plain = Work(method, int(solved.squares.iterations[0]))
    if best is None:
        return plain
    qps = sum(best.answered.values())
    return replace(plain, qps=qps, warm_starts=best.warm, qp_residual=best.qp_residual)


def alarms(robot: Robot, poses: Parts, solved: Solved, nominal_error: Array) -> Iterator[str]:
    """Why the result should not be used as it is.  nominal_error: (k, training poses, 3) [m]."""
    free = solved.identification.active & (solved.estimator.model.prior.weight == 0.0)
    if few := few_poses(poses.train, int(free.sum())):
        yield few
    yield from doubts(robot, solved, nominal_error)


def remarks(options: Options, poses: Parts) -> Iterator[str]:
    """What the reader should know about the data behind a result."""
    if is_crossed(options, poses.held) and not options.cv:
        yield (
            f"only {poses.held.poses} poses are held out: the result is cross-validated, every "
            "pose judged by a fit without it"
        )
    if not poses.held.poses:
        yield "no pose is held out: nothing here says how the fit does on new poses"
    if options.objective.startswith("smr:") and len(poses.data.target_names) > 1:
        name = options.objective.replace(":", "")
        others = ", ".join(other for other in poses.data.target_names if other != name)
        yield f"objective {options.objective}: {name} alone is fitted; {others} took no part"
    if options.objective == "minimax" and len(poses.data.target_names) == 1:
        yield "there is one target: minimax and sum are the same"
    if checks.collinear(poses.train):
        yield (
            "the targets lie nearly on a line: positions are fine, but orientations about that "
            "line would not be determined"
        )


def doubts(robot: Robot, solved: Solved, nominal_error: Array) -> Iterator[str]:
    """Notices where the result is no calibration of this robot but of another one."""
    reach = robot.reach()
    miss = float(np.sqrt(np.nanmean(np.nansum(nominal_error**2, axis=-1))))
    if miss > POOR_FIT * reach:
        yield (
            f"the nominal robot misses by {1e3 * miss:.3g} mm: check that it is the robot of these "
            "measurements, with their joint signs, zero positions and units"
        )
    if share := same_share(solved):
        yield (
            f"all lengths changed by the same share, {100.0 * share:+.3f} %, as no error of links "
            "does: check the scale, the units and the temperature compensation of the instrument; "
            f"points scaled by {1.0 / (1.0 + share):.6g} have the drawn lengths"
        )
    if named := wild(solved.names, links_of(solved.state.mdh - solved.nominal.mdh), reach):
        yield f"implausibly large changes: {named}; is the robot file the right one?"


def same_share(solved: Solved) -> float:
    """The share by which all identified lengths of the arm changed, 0 where they did not."""
    drawn, n = solved.nominal.mdh, len(solved.nominal.mdh)
    found = solved.identification.active[: 5 * n].reshape(5, n).T  # in the order of `links_of`
    return common_share(drawn, solved.state.mdh - drawn, found)


def parameters_of(robot: Robot, solved: Solved) -> Parameters:
    """Every parameter, link by link, in the convention of the robot's file.

    Base entries are measured along the nominal base's own axes: its origin as seen from the
    instrument, and its turn from the nominal orientation (the pose itself is `Cell.base`).
    Those of `session_jump` tell where it stands in a further session (`stations.jumps`).
    """
    known, sure = solved.identification, solved.uncertainty

    def values(x: State, frames: Frames) -> Array:
        stood, effects = jumps(frames, x.base), np.zeros(len(solved.units))
        effects[len(effects) - len(x.effects) :] = x.effects
        effects[: len(stood)] = stood
        return replace(x, effects=effects).along(solved.nominal.rotation, robot)

    before = values(solved.nominal, solved.start)
    found = known.active | (np.arange(solved.names.count) >= solved.names.geometric)
    after = np.where(found, values(solved.state, solved.frames), before)
    every = link_by_link(solved.names, sure.units, before, after, sure.sigma, known)
    return Parameters(every, sure.dof)


def worst_case(
    objective: str, solved: Solved, train: Measurements, error: Array
) -> WorstCase | None:
    """What the minimax rests on: every target, or the points that decide.

    error: (k, m, 3) of the training poses [m].
    """
    best, weights = solved.optimum, solved.robust.weights
    if best is None:
        return None
    labels, size = (
        train.target_names,
        np.array(accuracy(np.sqrt(weights)[..., None] * error).sse_mm2),
    )
    chosen = np.arange(len(best.mu))
    if PER[objective] == "point":
        points = np.argwhere(weights > 0.0)
        labels = tuple(f"{labels[target]} line {train.line[pose]}" for target, pose in points)
        size = 1e3 * np.linalg.norm(error, axis=-1)[weights > 0.0]
        chosen = np.argsort(-best.mu)
        chosen = chosen[best.mu[chosen] > TOLD]
    active = np.flatnonzero(best.f >= best.f.max() * (1 - ACTIVE))
    kept, names = solved.distances, train.target_names
    return WorstCase(
        functions=tuple(labels[i] for i in chosen),
        size=size[chosen],
        multiplier=best.mu[chosen],
        active=tuple(labels[i] for i in active),
        distances=tuple(
            KeptDistance((names[a], names[b]), float(mean), float(tolerance), float(lam))
            for (a, b), mean, tolerance, lam in zip(
                kept.pairs,
                kept.mean,
                kept.tolerance,
                best.lam[: len(kept.mean)] if len(best.lam) else np.zeros(len(kept.mean)),
                strict=True,
            )
        ),
        kkt=best.kkt,
        iterations=best.iterations,
        trace=best.trace,
    )
