"""From files of lengths, closures, poses and points to a calibrated robot."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from minimax_cal.core.arrays import Array, rms
from minimax_cal.core.option_fields import take_option_fields_as_keywords
from minimax_cal.core.threads import limit_blas_to_one_thread
from minimax_cal.fitting.accuracy import IS_HELD_BY_KEY, split_errors_by_key
from minimax_cal.fitting.accuracy_claims import (
    NO_LACK_MOTION,
    nominal_link_sigmas,
    random_position_jacobian,
    random_position_sigma,
    select_missing_parameters,
)
from minimax_cal.fitting.arm_comparison import compare_files_with_nominal, describe_no_improvement
from minimax_cal.fitting.fit import Provenance
from minimax_cal.fitting.multi_instrument import instrument_fit, instrument_slips
from minimax_cal.fitting.multi_instrument.agreement import (
    find_contradictions,
    find_moved_bases,
    find_other_order,
    find_other_scale,
)
from minimax_cal.fitting.multi_instrument.instrument_fit import InstrumentFit
from minimax_cal.fitting.multi_instrument.instrument_identification import DeterminedAlone
from minimax_cal.fitting.multi_instrument.lack import with_lack
from minimax_cal.fitting.multi_instrument.options import (
    RELATIVE_OPTION_READERS,
    Progress,
    RelativeOptions,
    check_file_noises,
    check_given_instruments,
    check_relative_options,
    silent_progress,
)
from minimax_cal.fitting.multi_instrument.relative_result import (
    SEVERAL_KINDS,
    InstrumentResult,
    MeasuredResult,
    RelativeCalibration,
)
from minimax_cal.fitting.options import qp_solver_name
from minimax_cal.fitting.outcome import FileEvidence, FitEvidence, judge
from minimax_cal.instruments.instrument import (
    METRE_UNIT,
    RADIAN_UNIT,
    Instrument,
    check_instrument_data,
)
from minimax_cal.instruments.instrument_files import InstrumentInput, convert_to_instrument
from minimax_cal.instruments.instrument_registry import is_user_registered
from minimax_cal.instruments.slope_check import check_instrument
from minimax_cal.measuring.campaigns import session_names_from_paths
from minimax_cal.measuring.measurement_checks import check_and_complete_joints, list_robot_notices
from minimax_cal.measuring.pose_groups import group_repeated_poses
from minimax_cal.measuring.session_frames import SessionFrames
from minimax_cal.measuring.visit_history import SessionClock, add_history_columns
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.effects_in_model import split_values_by_effect
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import DEFAULT_TARGET_NAME
from minimax_cal.robots.robot import Robot, load_robot

R = TypeVar("R", bound=RelativeCalibration)
POSE_SET_NAME_BY_KEY = {
    "train": "training",
    "holdout": "held-out",
}  # of the poses, by the keys of accuracy


@take_option_fields_as_keywords(options=RelativeOptions, readers_by_field=RELATIVE_OPTION_READERS)
def relative(
    robot: Robot | str | Path,
    data: InstrumentInput | Sequence[InstrumentInput],
    progress: Progress = silent_progress,
    *,
    options: RelativeOptions,
) -> RelativeCalibration:
    """Calibrate a robot from lengths, closures or poses, or from several files together.

    Several files share the arm; each has unknowns and a noise of its own, by its own residuals.
    One of them may be measurements of a tracker.

    Parameters
    ----------
    robot, data
        Loaded, or a name or path; several data in a list.
    options
        See `RelativeOptions`.
    progress
        Called with a word on each stage.

    Returns
    -------
    RelativeCalibration
        The calibration; how the numbers ended is in its `status`.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.relative("irb2600", "wires.csv", holdout=0.1).headline())
    """
    return calibrate_instruments(robot, data, options, progress)


@limit_blas_to_one_thread()
def calibrate_instruments(
    robot: Robot | str | Path,
    data: InstrumentInput | Sequence[InstrumentInput],
    options: RelativeOptions,
    progress: Progress,
) -> RelativeCalibration:
    """`relative`, which calls this, with its options in one."""
    asked = prepare_relative_task(robot, data, options)
    began = time.perf_counter()
    return judge_instrument_fit(asked, asked.fit_training_data(progress), began)


@dataclass(frozen=True, eq=False)
class RelativeTask:
    """What is to be calibrated, checked.

    every: the measurements of each instrument.  splits: of each, (m,) True where held out, and what
    the reader should know of that.
    """

    robot: Robot
    every: Sequence[Instrument]
    options: RelativeOptions
    splits: Sequence[tuple[Array, tuple[str, ...]]]

    @cached_property
    def training_data(self) -> dict[str, Instrument]:
        """What fits may see, by what the file is called."""
        named = zip(file_labels(self.every), self.every, self.splits, strict=True)
        return {label: data.take_rows(~held) for label, data, (held, _) in named}

    def fit_training_data(self, progress: Progress) -> InstrumentFit:
        """The fit of the training measurements."""
        found = instrument_fit.fit_instruments(
            self.robot, self.training_data, self.options, progress
        )
        progress("sigmas")
        return with_lack(self.robot, found)

    def with_effects(self, effects: Sequence[Term]) -> RelativeTask:
        """The same with effects."""
        return replace(self, options=replace(self.options, effects=tuple(effects)))


def prepare_relative_task(
    robot: Robot | str | Path,
    data: InstrumentInput | Sequence[InstrumentInput],
    options: RelativeOptions,
    *,
    with_effect_search: bool = False,
) -> RelativeTask:
    """Data loaded, checked, and split into training and held-out poses.

    with_effect_search: whether effects are looked for.  Raises CalibrationError.
    """
    # Each file by its instrument, those that look at the arm first.
    robot = load_robot(robot)
    given = [data] if isinstance(data, InstrumentInput) else list(data)
    every = sorted(map(convert_to_instrument, given), key=lambda data: not data.on_arm)
    check_given_instruments(every, with_effects=with_effect_search or bool(options.effects))
    check_relative_options(every, options)

    # All joints of the arm, and the way to each pose.
    every = [
        replace(each, at=add_history_columns(check_and_complete_joints(robot, each.at)))
        for each in every
    ]
    check_file_noises(file_labels(every), every, options)

    # Instruments of the user's own keep the protocol; slips show where the drawn arm is fitted.
    for each in filter(is_user_registered, every):
        check_instrument(check_instrument_data(each), robot, options)
    for each in every:
        instrument_slips.check_instrument_slips(robot, each, options)
    return RelativeTask(
        robot, every, options, [each.holdout_rows_and_notices(options) for each in every]
    )


def file_labels(instruments: Sequence[Instrument]) -> list[str]:
    """What files are called: by their stems; data from arrays by their kind."""
    files = [Path(data.at.source) for data in instruments if data.at.digest]
    names = iter(session_names_from_paths(files) if files else ())
    out: list[str] = []
    for data in instruments:
        name = next(names) if data.at.digest else data.kind
        alike = [each for each in out if each.rstrip("0123456789") == name]
        out.append(f"{name}{len(alike) + 1}" if name in out else name)
    return out


def judge_instrument_fit(
    task: RelativeTask, fit: InstrumentFit, start_time: float
) -> RelativeCalibration:
    """The result of a fit, judged at all poses.  start_time: when the work did [s]."""
    robot, every, options, splits = task.robot, task.every, task.options, task.splits

    # Errors of each file, as drawn and calibrated; how well positions of the arm are known.
    measured = [
        measure_instrument_errors(robot, fit, i, data, held)
        for i, (data, (held, _)) in enumerate(zip(every, splits, strict=True))
    ]
    left_open, sigma = (
        find_undetermined_parameters(robot, fit),
        calibrated_position_sigma_of_instruments(robot, fit),
    )
    result = build_relative_result(
        task,
        fit,
        measured,
        start_time,
        RelativeCalibration,
        position_sigma=np.nan if left_open else sigma,
        positions_open=left_open,
        beyond=instrument_slips.find_parameters_beyond_one_point(robot, fit, options)
        if len(measured) == 1
        else (),
        cell=build_effect_cell(robot, fit) if fit.geometric_fit else None,
    )

    # The outcome: with it, what of an instrument was not fitted and the residuals show.
    unfitted = [
        instrument_slips.compare_with_wider_instrument(robot, fit, i, options)
        for i in range(len(every))
    ]
    evidence = collect_instrument_evidence(
        task, fit, measured, sigma, [mend for _, mend in unfitted]
    )
    outcome = judge(evidence, result.status)

    # What the reader should know.
    instruments = enumerate(fit.stack.instruments)
    notices = [
        *result.notices,
        *(
            remark
            for i, one in instruments
            for remark in one.list_remarks(
                instrument_fit.build_own_parameters(robot, fit, i), fit.noise[i]
            )
        ),
        *instrument_slips.describe_extra_identified(result),
        *instrument_slips.warn_of_missing_scale(fit),
        *instrument_slips.warn_of_rotation_units(fit),
        *instrument_slips.warn_of_uncertain_positions(
            fit,
            result,
            measured,
            calibrated_position_sigma_of_instruments(robot, fit, with_lack=False),
        ),
        *instrument_slips.warn_of_other_arm(result, measured),
        *evidence.doubts,
        *filter(None, (*(notice for notice, _ in unfitted), outcome.reason)),
    ]
    for data, (held, _), each in zip(every, splits, measured, strict=True):
        notices += instrument_slips.list_general_notices(each, data, held)
    return replace(
        result,
        robot=robot if outcome.status.keeps_drawn else result.robot,
        calibrated=result.robot,
        status=outcome.status,
        reason=outcome.reason,
        contradictions=evidence.contradictions,
        notices=tuple(dict.fromkeys(notices)),
    )


def collect_instrument_evidence(
    task: RelativeTask,
    fit: InstrumentFit,
    measured: Sequence[MeasuredResult],
    position_sigma: float,
    mend_texts: Sequence[str],
) -> FitEvidence:
    """What the outcome is judged by.

    position_sigma: of a position, but for what is open [m].  mend_texts: of what was not fitted of
    each file and the residuals show, empty where nothing is.
    """
    robot, every, geometry = task.robot, task.every, fit.geometric_fit or fit
    links, stack = slice(5 * robot.joints), fit.stack
    active = geometry.identification.active[links]

    # Errors of each file; one that more of an instrument would explain is an objection where the
    # fit is worse than the drawn arm.
    files, objection = [], ""
    for data, one, mend in zip(every, measured, mend_texts, strict=True):
        scores = {what: one.accuracy[key] for key, what in POSE_SET_NAME_BY_KEY.items()}
        rotations = {
            what: one.turns[key][0]
            for key, what in POSE_SET_NAME_BY_KEY.items()
            if key in one.turns
        }
        if one.units == (RADIAN_UNIT,):
            rotations = {what: score.rms_error for what, score in scores.items()}
        drawn_scores = {}
        if data.unit == METRE_UNIT:
            drawn_scores = {key: one.accuracy[key] for key in ("nominal_train", "nominal")}
        files.append(
            FileEvidence(
                {what: (score, score) for what, score in scores.items()},
                source=data.at.source if len(every) > 1 else "",
                check=data.words.check,
                rotations=rotations,
                drawn=drawn_scores,
            )
        )
        drawn, calibrated, _ = one.before_and_after()
        if mend and not objection and calibrated.rms_error > drawn.rms_error:
            objection = f"the fit is worse than the arm as drawn: {mend}"

    # Is the calibrated arm better on held-out rows?  By paired comparison, files by their noises.
    better = None
    if active.any() or stack.laws.names:
        better = compare_files_with_nominal(
            [one.errors["nominal"] for one in measured],
            [one.errors["holdout"] for one in measured],
            [
                group_repeated_poses(data.at)[held]
                for data, (held, _) in zip(every, task.splits, strict=True)
            ],
            [s / one.row_noise for s, one in zip(fit.noise, stack.instruments, strict=True)],
        )

    # Do files contradict each other?  How well does the drawing know the adopted links?
    drawn_sigma = nominal_link_sigmas(robot, task.options.priors)
    other_scale, scale_doubt = find_other_scale(robot, geometry, drawn_sigma)
    return FitEvidence(
        robot,
        geometry.state.mdh,
        active,
        files,
        sigma=np.sqrt(np.maximum(np.diag(geometry.covariance)[links], 0.0)),
        drawn=drawn_sigma,
        position_sigma=position_sigma,
        drawn_sigma=nominal_position_sigma_of_instruments(robot, geometry, drawn_sigma),
        allow_large_changes=task.options.allow_large_changes,
        objection=objection,
        contradictions=find_other_order(robot, geometry)
        or find_contradictions(robot, geometry)
        or find_moved_bases(geometry)
        or other_scale,
        doubts=(scale_doubt,) if scale_doubt else (),
        worse=describe_no_improvement(better) if better and not better.is_better else "",
    )


def build_relative_result(
    task: RelativeTask,
    fit: InstrumentFit,
    measured: Sequence[MeasuredResult],
    start_time: float,
    result_class: type[R],
    **more: Any,
) -> R:
    """A kind of result of what was measured, before it is judged.  more: fields of its own."""
    robot, every, splits, options = task.robot, task.every, task.splits, task.options
    whole = measured[0] if len(every) == 1 else merge_file_errors(fit.stack.part_names, measured)
    notices = [
        said
        for data, (_, notes) in zip(every, splits, strict=True)
        for said in (*data.at.notices, *list_robot_notices(robot, data.at), *notes)
    ] + [*fit.notices]
    sources = ", ".join(data.at.source for data in every)
    source = replace(every[0].at, source=sources, digest=" ".join(d.at.digest for d in every))
    geometry = fit.geometric_fit or fit
    settings = options.settings()
    for one in reversed(fit.stack.instruments):  # the first one's stand
        settings |= one.choices_for_record
    own: dict[str, Any] = dict(vars(whole)) | dict(
        robot=robot.with_mdh(geometry.state.mdh),
        nominal=robot,
        status=fit.least_squares.status[0],
        iterations=int(fit.least_squares.iterations[0]),
        seconds=time.perf_counter() - start_time,
        parameters=instrument_fit.build_instrument_parameters(robot, fit),
        identification=fit.identification,
        beyond=(),
        notices=tuple(dict.fromkeys(notices)),
        provenance=Provenance.from_run(robot, source, settings),
        instruments=build_instrument_results(fit, every, splits, measured),
        objective=options.objective,
        qp=qp_solver_name(options.qp) if fit.worst else "",
        worst=fit.worst,
    )
    return result_class(**{**own, **more})


def measure_instrument_errors(
    robot: Robot, fit: InstrumentFit, instrument_index: int, data: Instrument, held: Array
) -> MeasuredResult:
    """The errors of an instrument, as drawn and calibrated.  held: (m,)."""
    stack, seen = fit.stack, []
    for x in fit.states_of_instrument(instrument_index):
        block = stack.blocks[instrument_index].with_measurements(robot, data, stack.laws, x)
        seen.append((block.instrument, *block.flange_and_own_values(x)))
    nominal, calibrated = (one.part_errors(arm, own, held) for one, arm, own in seen)
    turned = [one.orientation_errors(arm, own) for one, arm, own in seen]
    turns = split_errors_by_key(turned[0], turned[1], held) if turned[0].size else {}
    train, drawn, own = stack.instruments[instrument_index], seen[0][2], seen[1][2]
    counts = data.count_train_and_holdout_numbers(held)
    return MeasuredResult(
        kind=data.kind,
        parts=train.part_names,
        errors=split_errors_by_key(nominal, calibrated, held),
        numbers={key: counts[is_held] for key, is_held in IS_HELD_BY_KEY.items()},
        turns=rms_and_largest(turns),
        instrument=train.fitted_values_to_dict(
            stack.blocks[instrument_index].flange(x), own, drawn
        ),
        units=(data.unit,),
    )


def rms_and_largest(sizes: Mapping[str, Array]) -> dict[str, tuple[float, float]]:
    """RMS and largest, by the same keys."""
    return {key: (rms(s), float(s.max()) if s.size else np.nan) for key, s in sizes.items()}


def merge_file_errors(parts: tuple[str, ...], measured: Sequence[MeasuredResult]) -> MeasuredResult:
    """The errors of all files, one beside the other."""
    errors = {}
    for key in IS_HELD_BY_KEY:
        every = [each.errors[key] for each in measured]
        ends = np.cumsum([[0, 0], *(part.shape[:2] for part in every)], axis=0)
        errors[key] = np.full((*ends[-1], 3), np.nan)
        for part, (pose, row) in zip(every, ends, strict=False):
            errors[key][pose : pose + part.shape[0], row : row + part.shape[1]] = part
    return MeasuredResult(
        kind=SEVERAL_KINDS,
        parts=parts,
        errors=errors,
        numbers={key: sum(each.numbers[key] for each in measured) for key in IS_HELD_BY_KEY},
        turns={},
        instrument={},
        units=tuple(dict.fromkeys(unit for each in measured for unit in each.units)),
    )


def build_effect_cell(robot: Robot, fit: InstrumentFit) -> Cell:
    """The arm with its effects in its own base, and amid the first file's targets one of its own.

    Where these are is all that the laws know of them.
    """
    stack = fit.stack
    scene = stack.arm_states(robot, fit.state)[0]
    effects = split_values_by_effect(stack.laws.terms, scene, stack.law_values(fit.state))
    amid = scene.target_positions.mean(axis=0, keepdims=True)
    sessions = SessionFrames(
        {}, SessionClock.from_measurements(next(iter(fit.training_data.values())).at)
    )
    return Cell(scene.robot, np.eye(4), (DEFAULT_TARGET_NAME,), amid, effects, sessions)


def build_instrument_results(
    fit: InstrumentFit,
    instruments: Sequence[Instrument],
    splits: Sequence[tuple[Array, tuple[str, ...]]],
    measured: Sequence[MeasuredResult],
) -> tuple[InstrumentResult, ...]:
    """Each file's own figures."""
    names, fitted = fit.stack.labels, fit.stack.instruments
    alone = fit.determined_alone or (DeterminedAlone(0, ()),)
    noise = [float(s) / one.row_noise for s, one in zip(fit.noise, fitted, strict=True)]
    told = zip(names, measured, instruments, splits, noise, alone, strict=True)
    return tuple(
        InstrumentResult.from_measured(name, seen, data.at, held, sigma, own)
        for name, seen, data, (held, _), sigma, own in told
    )


def calibrated_position_sigma_of_instruments(
    robot: Robot, fit: InstrumentFit, *, with_lack: bool = True
) -> float:
    """`positions.random_position_sigma`, of the target of the first file.

    with_lack: of fit; without it, what noise alone leaves.
    """
    stack, spots = fit.stack, first_instrument_targets(fit, fit.state)
    (place, column), values = target_parameter_columns(fit), stack.law_values(fit.state)
    count = 5 * robot.joints + 6 + 3 * len(spots) + len(values)
    covariance = np.full((count, count), np.nan)
    covariance[np.ix_(column, column)] = fit.covariance[np.ix_(place, place)]
    if fit.lack is None:
        return random_position_sigma(robot, fit.state.mdh, spots, covariance, stack.laws, values)
    moved, moment = np.zeros((count, fit.lack.moved.shape[1])), fit.lack.moment
    moved[column] = fit.lack.moved[place]
    alone = covariance - moved @ moment @ moved.T
    lack = (moved, moment) if with_lack else ()
    return random_position_sigma(robot, fit.state.mdh, spots, alone, stack.laws, values, *lack)


def nominal_position_sigma_of_instruments(
    robot: Robot, fit: InstrumentFit, nominal_sigmas: Array
) -> float:
    """The same of the drawn arm, by the links that were adopted.  nominal_sigmas: (5n,) sigmas [m].

    The drawn arm bends as the calibrated one does, and no link of it takes a part of that.
    """
    spots, links = first_instrument_targets(fit, fit.nominal), 5 * robot.joints
    count = links + 6 + 3 * len(spots)
    covariance, adopted = np.full((count, count), np.nan), fit.identification.active[:links]
    covariance[:links, :links] = np.where(
        np.outer(adopted, adopted), np.diag(nominal_sigmas**2), np.nan
    )
    moment = fit.lack.moment if fit.lack else NO_LACK_MOTION
    still = np.zeros((count, len(moment)))
    return random_position_sigma(
        robot, robot.mdh, spots, covariance, lack_motion=still, lack_moment=moment
    )


def first_instrument_targets(fit: InstrumentFit, x: ParameterValues) -> Array:
    """(k, 3) targets of the first file on the flange, none where it has none there [m]."""
    block = fit.stack.blocks[0]
    spots = block.instrument.flange_points(block.own_values(fit.stack.state_of_block(x, 0)))
    return spots if block.instrument.on_arm else spots[:0]


def target_parameter_columns(fit: InstrumentFit) -> tuple[Array, Array]:
    """Where what moves the target of the first file stands among all, and in
    `random_position_jacobian`.
    """
    stack, spots = fit.stack, first_instrument_targets(fit, fit.state)
    every = np.arange(stack.names.parameter_count)
    own = stack.own_columns(0)[stack.instruments[0].targets_at]
    first, laws = 5 * stack.names.joints + 6, every[stack.parameter_count_without_laws :]
    place = np.concatenate([every[:first], own, laws])
    last = first + 3 * len(spots) + laws - stack.parameter_count_without_laws
    return place, np.concatenate([every[: first + len(own)], last])


def find_undetermined_parameters(robot: Robot, found: InstrumentFit) -> tuple[str, ...]:
    """Parameters that positions over the joints' range depend on and the measurements do not tell.

    Asked of the arm as drawn, where what is redundant is so exactly.  Not those that were fixed.
    """
    fit = found.geometric_fit or found
    (place, column), stack, known = target_parameter_columns(fit), fit.stack, fit.identification
    names = [stack.names.all_names[i] for i in place]
    asked = known.is_not_fixed(names) & stack.movable[place]
    jacobian = random_position_jacobian(
        robot, fit.nominal.mdh, first_instrument_targets(fit, fit.nominal)
    )[:, column]
    left = select_missing_parameters(jacobian, known.active[place], asked)
    return tuple(name for name, is_open in zip(names, left, strict=True) if is_open)
