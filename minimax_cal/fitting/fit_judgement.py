"""A solved fit judged at all poses: its result, with accuracy, outcome, notices and alarms."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.core.record_fields import LazyValue
from minimax_cal.fitting.accuracy import summarise_point_errors
from minimax_cal.fitting.accuracy_claims import (
    cross_validate_both_arms,
    find_held_out_outliers,
    judge_outside_measured_region,
    needs_cross_validation,
    nominal_link_sigmas,
    position_sigmas_of_both_arms,
    warn_of_uncertain_tool_points,
    warn_of_unjudged_poses,
)
from minimax_cal.fitting.arm_comparison import (
    ArmComparison,
    compare_with_nominal,
    describe_no_improvement,
    mask_points,
    warn_of_hidden_improvement,
)
from minimax_cal.fitting.arm_identity import (
    describe_computed_points,
    residual_rms,
    smallest_possible_noise,
)
from minimax_cal.fitting.cell_fit import WORST_CASE_OF_OBJECTIVE, CellFit
from minimax_cal.fitting.common_scale import estimate_common_length_change, links_with_lack_of_fit
from minimax_cal.fitting.contradiction import Contradiction
from minimax_cal.fitting.cross_validation import NO_CROSS_VALIDATED_ERRORS, describe_too_few_poses
from minimax_cal.fitting.data_slips import (
    MAX_CALIBRATION_ERROR_OF_REACH,
    MIN_STRAY_OF_REACH,
    describe_implausible_changes,
    find_exchanged_rows,
)
from minimax_cal.fitting.fit import Fit, KeptDistance, SolverWork, WorstCase
from minimax_cal.fitting.jump_sizes import fit_jump_sizes
from minimax_cal.fitting.minimax_problem import MIN_TRUSTED_WEIGHT
from minimax_cal.fitting.noise_floor import known_noise_floor
from minimax_cal.fitting.options import Options, parse_objective_target
from minimax_cal.fitting.outcome import (
    FileEvidence,
    FitEvidence,
    Outcome,
    judge,
    select_vague_links,
)
from minimax_cal.fitting.outliers import Outlier, find_contradicting_points, mask_outliers
from minimax_cal.fitting.parameter_results import Parameters, build_parameters
from minimax_cal.fitting.session_changes import SessionChange, find_session_changes
from minimax_cal.fitting.session_frames import base_poses_in_sessions
from minimax_cal.fitting.set_aside_points import judge_with_set_aside
from minimax_cal.measuring import measurement_checks
from minimax_cal.measuring.faults.session_faults import find_session_jumps
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import group_for_holdout
from minimax_cal.modelling.global_start import NO_BASE_ROTATION
from minimax_cal.modelling.parameters import flatten_link_parameters
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.least_squares import find_method_name
from minimax_cal.solvers.status import Status

MAX_NAMED = 5  # points that a notice names
MIN_DECIDING_MULTIPLIER = 1e-6  # a point of a smaller multiplier does not decide
MAX_ACTIVE_FUNCTION_GAP = 1e-6  # a function equals the largest, relative


@dataclass(frozen=True, eq=False)
class DataSplit:
    """Measurements as they are used: all poses, those of the fit, those held out; notices.

    near: (3, 3) rotation of the base that fits all poses best, where it was looked for.
    """

    data: Measurements
    train: Measurements
    held: Measurements
    notices: tuple[str, ...]
    near: Array = field(default_factory=lambda: NO_BASE_ROTATION)


@dataclass(frozen=True, eq=False)
class FitErrors:
    """Measured minus predicted of a fit at all m poses, of the drawn and the calibrated arm [m].

    data: in the first frame of the fit's sessions.  held: (m,) True where held out.  drawn,
    calibrated: (m, k, 3).  crossed_drawn, crossed: (m, k, 3) by fits without each pose, or empty.
    suspects: outliers, those of the fit first.  exchanged: (b,) rows with other rows' points.
    """

    data: Measurements
    held: Array
    drawn: Array
    calibrated: Array
    crossed_drawn: Array
    crossed: Array
    suspects: tuple[Outlier, ...]
    exchanged: Array

    @property
    def unseen(self) -> tuple[Array, Array]:
        """(m, k, 3) of both arms on poses that neither has seen, NaN elsewhere [m]."""
        if self.crossed.size:
            return self.crossed_drawn, self.crossed
        return mask_points(self.drawn, self.calibrated, ~self.held[:, None])

    def name_exchanged_rows(self) -> str:
        """That rows hold each other's points, by their names or lines."""
        return (
            f"{self.data.source}: rows hold each other's points: "
            f"{self.data.format_row_names(self.exchanged)}; put "
            f"their joint values and points right, or "
            "delete them"
        )


@dataclass(frozen=True, eq=False)
class JudgedFit:
    """A result, and why it should not be used as it is."""

    fit: Fit
    alarms: tuple[str, ...]


def judge_fit(
    robot: Robot, options: Options, split: DataSplit, solved: CellFit, start_time: float
) -> JudgedFit:
    """The result of a fit, judged at poses that it has not seen.

    start_time: start of the calibration by `time.perf_counter` [s].
    """
    # Errors of the calibrated arm, and of the drawn one with its best base and targets.
    held = np.isin(split.data.line, split.held.line)
    cell = solved.cell(robot, split.data)
    nominal = solved.nominal_cell(robot, split.data, cell.sessions.clock)
    data = cell.align_to_first_session(split.data)
    drawn, calibrated = nominal.error(data), cell.error(data)
    exchanged = np.zeros(0, dtype=int)
    largest = np.nanmax(np.linalg.norm(drawn, axis=-1), initial=0.0)
    if largest > MIN_STRAY_OF_REACH * robot.reach():
        exchanged = find_exchanged_rows(robot, data)
    suspects = (*solved.robust.suspects, *find_held_out_outliers(robot, data, held, solved))

    # Folds: where few poses are held out, every pose is judged by a fit without it.
    folds = NO_CROSS_VALIDATED_ERRORS, NO_CROSS_VALIDATED_ERRORS
    if needs_cross_validation(options, split.held):
        folds = cross_validate_both_arms(robot, options, data, held, solved)
    errors = FitErrors(data, held, drawn, calibrated, *folds, suspects, exchanged)

    # Is the calibrated arm better than the drawn one on unseen poses?  By paired comparison; not
    # asked where both are the same arm.
    better = None
    links_fixed = not solved.identification.active[: solved.state.mdh.size].any()
    is_same_arm = links_fixed and not solved.effects.terms
    if not is_same_arm and np.isfinite(errors.unseen[1]).any():
        both = errors.unseen
        if (target := parse_objective_target(options.objective, data)) >= 0:  # the others follow it
            both = mask_points(*both, np.arange(len(data.target_names)) != target)
        better = compare_with_nominal(
            *both, group_for_holdout(data, options.holdout_by), data, suspects
        )

    # Do sessions contradict each other, where what changed between them is not fitted?
    contradictions: tuple[Contradiction, ...] = ()
    changes_fitted = any("session" in term.choice for term in solved.effects.cause_terms)
    if len(solved.frames) > 1 and not changes_fitted:
        from minimax_cal.fitting.multi_instrument.agreement import (
            find_contradicting_sessions,
        )  # slow

        trusted = solved.robust.weights > MIN_TRUSTED_WEIGHT
        contradictions = find_contradicting_sessions(robot, split.train, trusted)

    # The outcome, and what moved between sessions.
    evidence = collect_evidence(robot, options, solved, errors, better, contradictions)
    outcome = judge(evidence, solved.status)
    moved: tuple[SessionChange, ...] = ()
    if outcome.status is not Status.FAILED:
        moved = find_session_changes(robot, split.train, solved, cell)
    alarms = tuple(warn_of_wrong_robot(robot, solved, drawn[~held]))
    free = solved.identification.active & (solved.estimator.model.prior.weight == 0.0)
    if few := describe_too_few_poses(split.train, int(free.sum())):
        alarms = (f"too few poses: {few}", *alarms)
    notices = list_notices(robot, options, split, solved, errors, moved, alarms, better, outcome)

    gone, counted = judge_with_set_aside(
        data, held, cell, calibrated, errors.crossed, solved, options
    )
    optimum, robust = solved.optimum, solved.robust
    work = SolverWork(find_method_name(solved.squares.method), int(solved.squares.iterations[0]))
    if optimum:
        qp_count = sum(optimum.answered.values())
        work = replace(
            work, qps=qp_count, warm_starts=optimum.warm, qp_residual=optimum.qp_residual
        )
    fit = Fit.build(
        cell,
        nominal,
        data,
        held,
        (drawn, calibrated),
        options.settings(),
        solved.uncertainty,
        status=outcome.status,
        reason=outcome.reason,
        notices=notices,
        iterations=solved.iterations,
        parameters=build_fit_parameters(robot, solved),
        accuracy={"holdout_with_them": counted} if counted else {},
        identification=solved.identification,
        minimax=describe_worst_case(options, solved, split.train, calibrated[~held]),
        certificate=solved.certificate,
        trace=tuple(float(value) for value in solved.squares.trace[:, 0]),
        suspects=suspects,
        weights=robust.weights,
        share=solved.estimator.share,
        prior=solved.estimator.model.prior.weight,
        widening=solved.loss_sigma_factor,
        claim=LazyValue(
            partial(judge_outside_measured_region, robot, options, data, held, solved, suspects)
        ),
        error_crossed=errors.crossed,
        error_drawn_crossed=errors.crossed_drawn,
        set_aside=gone,
        answered=optimum.answered if optimum else {},
        work=work,
        moved=moved,
        contradictions=contradictions,
        seconds=time.perf_counter() - start_time,
    )
    return JudgedFit(fit, alarms)


def collect_evidence(
    robot: Robot, options: Options, solved: CellFit, errors: FitErrors,
    better: ArmComparison | None, contradictions: tuple[Contradiction, ...],
) -> FitEvidence:  # fmt: skip
    """What the outcome of a fit is judged by.

    better: the paired comparison with the drawn arm, None where there is none.
    """
    data, held, suspects = errors.data, errors.held, errors.suspects
    mdh, link_count, active = solved.state.mdh, 5 * robot.joints, solved.identification.active
    trusted = mask_outliers(errors.calibrated, data, suspects)
    parts = {"training": ~held, "held-out": held}
    scores = FileEvidence(
        {
            name: (
                summarise_point_errors(errors.calibrated[rows]),
                summarise_point_errors(trusted[rows]),
            )
            for name, rows in parts.items()
        },
        drawn={name: summarise_point_errors(errors.drawn[rows]) for name, rows in parts.items()},
        floor=known_noise_floor(data, trusted, robot.repeatability),
    )

    # Rows that were exchanged, where they have a weight in the fit.
    weighted = (solved.robust.weights > MIN_TRUSTED_WEIGHT).any(axis=0)
    is_wrong = np.isin(errors.exchanged, np.flatnonzero(~held)[weighted]).any()

    # Points that were computed, from either arm: errors, the parameters' share put back, far below
    # the noise of any instrument.
    noise = smallest_possible_noise(data, robot.repeatability)
    drawn_rms = residual_rms(errors.drawn, float(active[link_count:].sum()))
    rms = residual_rms(errors.calibrated, float(active.sum()))
    is_computed = describe_computed_points(
        data, drawn_rms, noise, "the drawn arm"
    ) or describe_computed_points(data, rms, noise, "the calibrated arm")

    names = [one.describe(data) for one in suspects]

    # How well positions of both arms are known, only where a link is vague.
    links, sigma = active[:link_count], solved.uncertainty.sigma[:link_count]
    drawn_sigma = nominal_link_sigmas(robot, options.priors)
    position_sigmas = np.nan, np.nan
    if select_vague_links(robot, mdh, links, sigma, drawn_sigma).any():
        position_sigmas = position_sigmas_of_both_arms(robot, solved, drawn_sigma)
    return FitEvidence(
        robot, mdh, links, [scores], sigma, drawn_sigma, *position_sigmas,
        allow_large_changes=options.allow_large_changes,
        objection=errors.name_exchanged_rows() if is_wrong else "",
        computed=is_computed,
        contradictions=contradictions,
        worse=describe_no_improvement(better) if better and not better.is_better else "",
        outliers=f"; check the outliers ({format_first_names(names, MAX_NAMED)})" if names else "",
    )  # fmt: skip


def list_notices(
    robot: Robot,
    options: Options,
    split: DataSplit,
    solved: CellFit,
    errors: FitErrors,
    moved: Sequence[SessionChange],
    alarms: Sequence[str],
    better: ArmComparison | None,
    outcome: Outcome,
) -> tuple[str, ...]:
    """What the reader of a result should know."""
    data, train, calibrated = errors.data, split.train, errors.calibrated
    notices = [*split.notices, *solved.notices]

    # What the fit was asked for, against what the data are.
    if needs_cross_validation(options, split.held) and not options.cv:
        notices.append(
            f"only {split.held.poses} poses are held out: the result is cross-validated, every "
            "pose judged by a fit without it"
        )
    if not split.held.poses:
        notices.append("no pose is held out: nothing here says how the fit does on new poses")
    if options.objective.startswith("smr:") and len(data.target_names) > 1:
        name = options.objective.replace(":", "")
        others = ", ".join(other for other in data.target_names if other != name)
        notices.append(
            f"objective {options.objective}: {name} alone is fitted; {others} took no part"
        )
    if options.objective == "minimax" and len(data.target_names) == 1:
        notices.append("there is one target: minimax and sum are the same")
    if measurement_checks.has_collinear_targets(train):
        notices.append(
            "the targets lie nearly on a line: positions are fine, but orientations about that "
            "line would not be determined"
        )

    # Faults of the data that the errors show; sizes of jumps are fitted beside the arm.
    def fit_jumps(rows: Array) -> Array:
        return fit_jump_sizes(robot, data, ~errors.held, options, rows, base_rotation=split.near)

    notices += measurement_checks.list_outlier_notices(data, np.linalg.norm(calibrated, axis=-1))
    notices += find_contradicting_points(data, calibrated)
    notices += [fault.text for fault in find_session_jumps(data, calibrated, fit_jumps)]
    notices += [change.sentence for change in moved]
    notices += alarms
    if outliers := [one.describe(data) for one in errors.suspects if one.held]:
        notices.append(
            f"{data.source}: outliers among the held-out points: "
            f"{format_first_names(outliers, MAX_NAMED)}; they "
            f"count in the held-out accuracy, which is "
            "also given without them"
        )
    notices += warn_of_unjudged_poses(data, errors.crossed)
    notices += warn_of_uncertain_tool_points(robot, solved, calibrated)
    if len(errors.exchanged) and outcome.status is not Status.FAILED:
        notices.append(errors.name_exchanged_rows())
    if better and better.wrong:
        notices.append(warn_of_hidden_improvement(better, *errors.unseen))
    return (*notices, *filter(None, [outcome.reason]))


def warn_of_wrong_robot(robot: Robot, solved: CellFit, drawn_error: Array) -> Iterator[str]:
    """Notices where the result is no calibration of this robot but of another one.

    drawn_error: (training poses, k, 3) of the drawn arm [m].
    """
    reach, drawn = robot.reach(), solved.nominal.mdh
    miss = float(np.sqrt(np.nanmean(np.nansum(drawn_error**2, axis=-1))))
    if miss > MAX_CALIBRATION_ERROR_OF_REACH * reach:
        yield (
            f"the nominal robot misses by {1e3 * miss:.3g} mm: check that it is the robot of these "
            "measurements, with their joint signs, zero positions and units"
        )

    # A common factor of all identified lengths; the lack of fit is estimated only where, by the
    # values alone, there may be one.
    n, change = len(drawn), solved.state.mdh - drawn
    found = (
        solved.identification.active[: 5 * n].reshape(5, n).T
    )  # in the order of `flatten_link_parameters`
    factor = estimate_common_length_change(drawn, change, found, np.zeros((5 * n, 5 * n)))
    if factor:
        shift, covariance = links_with_lack_of_fit(
            robot, solved.estimator.fully_weighted_model, solved.state
        )
        factor = estimate_common_length_change(
            drawn, change + shift.reshape(5, n).T, found, covariance
        )
    if factor:
        yield (
            f"all lengths changed by the same share, {100.0 * factor:+.3f} %, as no error of links "
            "does: check the scale, the units and the temperature compensation of the instrument; "
            f"points scaled by {1.0 / (1.0 + factor):.6g} have the drawn lengths"
        )
    if named := describe_implausible_changes(solved.names, flatten_link_parameters(change), reach):
        yield f"implausibly large changes: {named}; is the robot file the right one?"


def build_fit_parameters(robot: Robot, solved: CellFit) -> Parameters:
    """Every parameter, link by link, in the convention of the robot's file.

    Base entries are measured along the nominal base's own axes: its origin as seen from the
    instrument, and its rotation from the nominal orientation (the pose itself is `Cell.base`).
    Those of `session_jump` say where it stands in a further session
    (`session_frames.base_poses_in_sessions`).
    """
    identification, uncertainty, names = solved.identification, solved.uncertainty, solved.names
    values = []
    for state, frames in ((solved.nominal, solved.nominal_frames), (solved.state, solved.frames)):
        bases, effects = (
            base_poses_in_sessions(frames, state.base_pose),
            np.zeros(len(solved.units)),
        )
        effects[len(effects) - len(state.effects) :] = state.effects
        effects[: len(bases)] = bases
        values.append(
            replace(state, effects=effects).values_in_file_convention(
                solved.nominal.rotation, robot
            )
        )
    before, after = values
    found = identification.active | (np.arange(names.parameter_count) >= names.geometric_count)
    every = build_parameters(
        names, uncertainty.units, before, np.where(found, after, before), uncertainty.sigma,
        identification,
    )  # fmt: skip
    return Parameters(every, uncertainty.dof)


def describe_worst_case(
    options: Options, solved: CellFit, train: Measurements, error: Array
) -> WorstCase | None:
    """What the minimax rests on: every target, or the points that decide.

    error: (m, k, 3) of the training poses [m].
    """
    best, weights, names = solved.optimum, solved.robust.weights, train.target_names
    if best is None:
        return None
    labels, chosen = names, np.arange(len(best.mu))
    if WORST_CASE_OF_OBJECTIVE[options.objective] == "target":
        size = np.array(summarise_point_errors(np.sqrt(weights).T[..., None] * error).sse_mm2)
    else:
        points = np.argwhere(weights > 0.0)
        labels = tuple(f"{names[k]}, {train.called(train.line[i])}" for k, i in points)
        size = 1e3 * np.linalg.norm(error, axis=-1).T[weights > 0.0]  # as `points`
        chosen = np.argsort(-best.mu)
        chosen = chosen[best.mu[chosen] > MIN_DECIDING_MULTIPLIER]
    active = np.flatnonzero(best.f >= best.f.max() * (1 - MAX_ACTIVE_FUNCTION_GAP))
    kept = solved.distances
    lam = best.lam[: len(kept.mean)] if len(best.lam) else np.zeros(len(kept.mean))
    numbers = (part.tolist() for part in (kept.mean, kept.tolerance, lam))
    return WorstCase(
        functions=tuple(labels[i] for i in chosen),
        size=size[chosen],
        multiplier=best.mu[chosen],
        active=tuple(labels[i] for i in active),
        distances=tuple(
            KeptDistance((names[a], names[b]), *each)
            for (a, b), *each in zip(kept.pairs, *numbers, strict=True)
        ),
        kkt=best.kkt,
        iterations=best.iterations,
        trace=best.trace,
    )
