"""A solved fit judged at all poses: its result, with accuracy, notices and what is alarming."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from minimax_cal.fitting.accuracy import accuracy, by_key
from minimax_cal.fitting.between_sessions import Change, between_sessions
from minimax_cal.fitting.checks import MIN_STRAY_OF_REACH, POOR_FIT, exchanged, wild
from minimax_cal.fitting.claims import (
    bad_rows,
    beyond_of,
    crossed_of,
    drawn_sigmas,
    is_crossed,
    known_positions,
    other_points,
    unjudged,
    unseen_suspects,
)
from minimax_cal.fitting.common_scale import common_share, with_lack
from minimax_cal.fitting.crossed import NOT_CROSSED, few_poses
from minimax_cal.fitting.disagreement import Contradiction
from minimax_cal.fitting.fit import Fit, KeptDistance, Provenance, Work, WorstCase
from minimax_cal.fitting.floor import known_floor
from minimax_cal.fitting.found import Parameters, link_by_link
from minimax_cal.fitting.improvement import (
    Improvement,
    hidden,
    improvement,
    name_outliers,
    no_better,
    rms_of,
    said_without,
)
from minimax_cal.fitting.jump_sizes import fit_jump_sizes
from minimax_cal.fitting.minimax_problem import MIN_TRUSTED_WEIGHT
from minimax_cal.fitting.options import Options, objective_of, qp_name
from minimax_cal.fitting.outcome import (
    FileEvidence,
    FitEvidence,
    Outcome,
    judge,
    select_vague_links,
)
from minimax_cal.fitting.same_arm import computed, least_noise, residual
from minimax_cal.fitting.set_aside import judged_with
from minimax_cal.fitting.solve import PER, Solved
from minimax_cal.fitting.stations import jumps
from minimax_cal.fitting.suspects import Suspect, aside, contradictions
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.facts import Later
from minimax_cal.measuring import checks
from minimax_cal.measuring.faults.sessions import session_jumps
from minimax_cal.measuring.grouping import grouped
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.stations import Frames
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.parameters import State, links_of
from minimax_cal.modelling.start import EVERYWHERE
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.least_squares import name_of
from minimax_cal.solvers.status import Status

MIN_MULTIPLIER = 1e-6  # a point of a smaller multiplier does not decide
ACTIVE_TOLERANCE = 1e-6  # a function equals the largest, relative


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


@dataclass(frozen=True, eq=False)
class Judged:
    """A solved fit at all poses: errors of the drawn and the calibrated arm, and how it ended."""

    robot: Robot
    options: Options
    poses: Parts
    solved: Solved

    @cached_property
    def held(self) -> Array:
        """(m,) True for poses that the fit has not seen."""
        return np.isin(self.poses.data.line, self.poses.held.line)

    @cached_property
    def cell(self) -> Cell:
        """The calibrated robot in its place."""
        return self.solved.cell(self.robot, self.poses.data)

    @cached_property
    def nominal(self) -> Cell:
        """The drawn robot in its place."""
        return self.solved.nominal_cell(self.robot, self.poses.data, self.cell.sessions.clock)

    @cached_property
    def data(self) -> Measurements:
        """All poses in the first frame of the fit's sessions."""
        return self.cell.placed(self.poses.data)

    @cached_property
    def before(self) -> Array:
        """(m, k, 3) errors of the drawn arm [m]."""
        return self.nominal.error(self.data)

    @cached_property
    def after(self) -> Array:
        """(m, k, 3) errors of the calibrated arm [m]."""
        return self.cell.error(self.data)

    @cached_property
    def suspects(self) -> tuple[Suspect, ...]:
        """The points that stand out, those of the fit first."""
        unseen = unseen_suspects(self.robot, self.data, self.held, self.solved)
        return (*self.solved.robust.suspects, *unseen)

    @cached_property
    def crossed(self) -> tuple[Array, Array]:
        """(m, k, 3) errors of both arms by fits without each pose, where so judged [m]."""
        if not is_crossed(self.options, self.poses.held):
            return NOT_CROSSED, NOT_CROSSED
        return crossed_of(self.robot, self.options, self.data, self.held, self.solved)

    @cached_property
    def unseen(self) -> tuple[Array, Array]:
        """(m, k, 3) errors of both arms on poses that neither has seen, NaN elsewhere [m]."""
        if self.crossed[1].size:
            return self.crossed
        return hidden(self.before, self.after, ~self.held[:, None])

    @cached_property
    def swapped(self) -> Array:
        """(b,) rows whose points belong to other rows: their lines were exchanged."""
        far = np.nanmax(np.linalg.norm(self.before, axis=-1), initial=0.0)
        if far > MIN_STRAY_OF_REACH * self.robot.reach():
            return exchanged(self.robot, self.data)
        return np.zeros(0, dtype=int)

    @cached_property
    def better(self) -> Improvement | None:
        """Both arms on unseen poses; None without such, or where both are the same arm.

        With an objective of one target that one alone: the others follow.
        """
        solved, unseen = self.solved, self.unseen
        fixed = not solved.identification.active[: solved.state.mdh.size].any()
        if (fixed and not solved.effects.terms) or not np.isfinite(unseen[1]).any():
            return None
        if (target := objective_of(self.options.objective, self.data)) >= 0:
            others = np.arange(len(self.data.target_names)) != target
            unseen = hidden(*unseen, others)
        group = grouped(self.data, self.options.holdout_by)
        return improvement(*unseen, group, self.data, self.suspects)

    @cached_property
    def contradictions(self) -> tuple[Contradiction, ...]:
        """How sessions contradict each other; none where what changed between them is fitted."""
        known = any("session" in term.choice for term in self.solved.effects.causes)
        if len(self.solved.frames) < 2 or known:
            return ()
        from minimax_cal.fitting.several.agreement import (  # slow to import
            find_contradicting_sessions,
        )

        trusted = self.solved.robust.weights > MIN_TRUSTED_WEIGHT
        return find_contradicting_sessions(self.robot, self.poses.train, trusted)

    @cached_property
    def evidence(self) -> FitEvidence:
        """What the outcome is judged by."""
        robot, data, solved, held = self.robot, self.data, self.solved, self.held
        links, active = 5 * robot.joints, solved.identification.active
        rest = aside(self.after, data, self.suspects)
        parts = {"training": ~held, "held-out": held}
        pulling = (solved.robust.weights > MIN_TRUSTED_WEIGHT).any(axis=0)
        wrong = np.isin(self.swapped, np.flatnonzero(~held)[pulling]).any()
        noise = least_noise(data, robot.repeatability)
        drawn_left = residual(self.before, float(active[links:].sum()))
        left = residual(self.after, float(active.sum()))
        better = self.better
        within = drawn_sigmas(robot, self.options.priors)
        mdh, sigma = solved.state.mdh, solved.uncertainty.sigma[:links]
        calibrated = drawn = np.nan  # positions are asked for only where a link is in doubt
        if select_vague_links(robot, mdh, active[:links], sigma, within).any():
            calibrated, drawn = known_positions(robot, solved, within)
        return FitEvidence(
            robot,
            mdh,
            active[:links],
            [
                FileEvidence(
                    {k: (accuracy(self.after[rows]), accuracy(rest[rows]))
                     for k, rows in parts.items()},
                    drawn={k: accuracy(self.before[rows]) for k, rows in parts.items()},
                    floor=known_floor(data, rest, robot.repeatability),
                )
            ],
            sigma=sigma,
            drawn=within,
            position_sigma=calibrated,
            drawn_sigma=drawn,
            allow_large_changes=self.options.allow_large_changes,
            objection=said_of_exchanged(data, self.swapped) if wrong else "",
            computed=computed(data, drawn_left, noise, "the drawn arm")
            or computed(data, left, noise, "the calibrated arm"),
            contradictions=self.contradictions,
            worse=no_better(better) if better and not better.is_better else "",
            outliers=name_outliers(self.suspects, data),
        )  # fmt: skip

    @cached_property
    def outcome(self) -> Outcome:
        """How it ended."""
        return judge(self.evidence, self.solved.status)

    @cached_property
    def moved(self) -> tuple[Change, ...]:
        """What changed between sessions."""
        if self.outcome.status is Status.FAILED:
            return ()
        return between_sessions(self.robot, self.poses.train, self.solved, self.cell)

    @cached_property
    def alarming(self) -> tuple[str, ...]:
        """Why the result should not be used as it is."""
        return tuple(alarms(self.robot, self.poses, self.solved, self.before[~self.held]))

    @property
    def notices(self) -> tuple[str, ...]:
        """What the reader should know."""
        data, better, after = self.data, self.better, self.after
        swapped = len(self.swapped) and self.outcome.status is not Status.FAILED
        return (
            *self.poses.notices,
            *self.solved.notices,
            *remarks(self.options, self.poses),
            *checks.outliers(data, np.linalg.norm(after, axis=-1)),
            *contradictions(data, after),
            *(fault.text for fault in session_jumps(data, after, self.fit_jumps)),
            *(change.sentence for change in self.moved),
            *self.alarming,
            *bad_rows(self.suspects, data),
            *unjudged(data, self.crossed[1]),
            *other_points(self.robot, self.solved, after),
            *([said_of_exchanged(data, self.swapped)] if swapped else []),
            *([said_without(better, rms_of(*self.unseen))] if better and better.wrong else []),
            *filter(None, [self.outcome.reason]),
        )

    def fit_jumps(self, rows: Array) -> Array:
        """Sizes (j,) of jumps that start at some rows, fitted beside the arm [m]."""
        poses = self.poses
        return fit_jump_sizes(
            self.robot, self.data, ~self.held, self.options, rows, near=poses.near
        )

    def fit(self, began: float) -> Fit:
        """The result.  began: the calibration, by `time.perf_counter`."""
        solved, options, data, held = self.solved, self.options, self.data, self.held
        before, after, (drawn_crossed, crossed) = self.before, self.after, self.crossed
        gone, counted = judged_with(data, held, self.cell, after, crossed, solved, options)
        given = self.robot, options, data, held, solved, self.suspects
        return Fit(
            cell=self.cell,
            nominal=self.nominal,
            objective=options.objective,
            qp=qp_name(options.qp),
            status=self.outcome.status,
            iterations=solved.iterations,
            parameters=parameters_of(self.robot, solved),
            accuracy={
                **{key: accuracy(error) for key, error in by_key(before, after, held).items()},
                **({"holdout_with_them": counted} if counted else {}),
            },
            identification=solved.identification,
            uncertainty=solved.uncertainty,
            minimax=worst_case(options.objective, solved, self.poses.train, after[~held]),
            certificate=solved.certificate,
            trace=tuple(float(value) for value in solved.squares.trace[:, 0]),
            data=data,
            held=held,
            error_nominal=before,
            error=after,
            notices=self.notices,
            loss=options.loss,
            suspects=self.suspects,
            weights=solved.robust.weights,
            share=solved.estimator.share,
            prior=solved.estimator.model.prior.weight,
            widening=solved.widening,
            provenance=Provenance.of(self.robot, data, options.settings()),
            claim=Later(partial(beyond_of, *given)),
            error_crossed=crossed,
            set_aside=gone,
            answered=solved.optimum.answered if solved.optimum else {},
            work=work_of(solved),
            error_drawn_crossed=drawn_crossed,
            reason=self.outcome.reason,
            moved=self.moved,
            contradictions=self.evidence.contradictions,
            seconds=time.perf_counter() - began,
        )


def said_of_exchanged(data: Measurements, rows: Array) -> str:
    """That rows hold each other's points, by their names or lines."""
    return (
        f"{data.source}: rows hold each other's points: {data.list_rows(rows)}; put their joint "
        "values and points right, or delete them"
    )


def work_of(solved: Solved) -> Work:
    """What the solvers did."""
    method, best = name_of(solved.squares.method), solved.optimum
    plain = Work(method, int(solved.squares.iterations[0]))
    if best is None:
        return plain
    qps = sum(best.answered.values())
    return replace(plain, qps=qps, warm_starts=best.warm, qp_residual=best.qp_residual)


def alarms(robot: Robot, poses: Parts, solved: Solved, nominal_error: Array) -> Iterator[str]:
    """Why the result should not be used as it is.  nominal_error: (training poses, k, 3) [m]."""
    free = solved.identification.active & (solved.estimator.model.prior.weight == 0.0)
    if few := few_poses(poses.train, int(free.sum())):
        yield f"too few poses: {few}"
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
    if share := same_share(robot, solved):
        yield (
            f"all lengths changed by the same share, {100.0 * share:+.3f} %, as no error of links "
            "does: check the scale, the units and the temperature compensation of the instrument; "
            f"points scaled by {1.0 / (1.0 + share):.6g} have the drawn lengths"
        )
    if named := wild(solved.names, links_of(solved.state.mdh - solved.nominal.mdh), reach):
        yield f"implausibly large changes: {named}; is the robot file the right one?"


def same_share(robot: Robot, solved: Solved) -> float:
    """The share by which all identified lengths of the arm changed, 0 where they did not."""
    drawn, n = solved.nominal.mdh, len(solved.nominal.mdh)
    found = solved.identification.active[: 5 * n].reshape(5, n).T  # in the order of `links_of`
    change = solved.state.mdh - drawn
    if not common_share(drawn, change, found, np.zeros((5 * n, 5 * n))):
        return 0.0
    shift, covariance = with_lack(robot, solved.estimator.whole, solved.state)
    return common_share(drawn, change + shift.reshape(5, n).T, found, covariance)


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

    error: (m, k, 3) of the training poses [m].
    """
    best, weights = solved.optimum, solved.robust.weights
    if best is None:
        return None
    labels = train.target_names
    size = np.array(accuracy(np.sqrt(weights).T[..., None] * error).sse_mm2)
    chosen = np.arange(len(best.mu))
    if PER[objective] == "point":
        points = np.argwhere(weights > 0.0)
        labels = tuple(f"{labels[k]}, {train.called(train.line[i])}" for k, i in points)
        size = 1e3 * np.linalg.norm(error, axis=-1).T[weights > 0.0]  # as `points`
        chosen = np.argsort(-best.mu)
        chosen = chosen[best.mu[chosen] > MIN_MULTIPLIER]
    active = np.flatnonzero(best.f >= best.f.max() * (1 - ACTIVE_TOLERANCE))
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
