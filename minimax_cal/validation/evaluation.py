"""A saved result and measurements to judge it by: who predicts, and what no fit has seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import CalibrationError, DataError, OptionError
from minimax_cal.core.record_fields import FieldFormat, StoredSeparately
from minimax_cal.core.results import Result
from minimax_cal.core.tables import Table
from minimax_cal.fitting.accuracy import Accuracy, summarise_point_errors
from minimax_cal.fitting.data_slips import MAX_CALIBRATION_ERROR_OF_REACH
from minimax_cal.fitting.joint_spans import (
    JointSpan,
    describe_spans,
    is_outside_narrow_spans,
    select_narrow_spans,
)
from minimax_cal.fitting.multi_instrument.instrument_fit import (
    build_start_state,
    build_training_stack,
    select_parameters,
)
from minimax_cal.fitting.multi_instrument.options import RelativeOptions
from minimax_cal.fitting.multi_instrument.relative_result import MeasuredAccuracy
from minimax_cal.fitting.opened_results import OpenedResult, open_result
from minimax_cal.fitting.opened_results import ResultOrFile as Given
from minimax_cal.fitting.set_aside_points import (
    accuracy_with_set_aside,
    describe_points_set_aside,
    set_aside_errors,
)
from minimax_cal.fitting.uncertainty import Uncertainty
from minimax_cal.instruments.instrument import METRE_UNIT, Instrument
from minimax_cal.instruments.instrument_files import InstrumentInput as Measured
from minimax_cal.instruments.instrument_files import read_instruments_or_measurements
from minimax_cal.measuring.measurement_checks import check_and_complete_joints, list_outlier_notices
from minimax_cal.measuring.measurements import Measurements, SetAsidePoint, read_measurements
from minimax_cal.measuring.pose_groups import MAX_REPEAT_DISTANCE, group_repeated_poses
from minimax_cal.modelling.cell import Cell, list_session_and_time_notices
from minimax_cal.modelling.global_start import fit_base_and_targets
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.robots.robot import load_robot

BEFORE, AFTER = "before", "after"
MAX_RECOMPUTED_ERROR_DIFFERENCE = (
    1e-6  # a file's own errors come back to this, or its effects need more columns [m]
)
# errors above this share of the arm's reach are not what calibration leaves
MAX_EXPECTED_ERROR_OF_REACH = 5e-3


@dataclass(frozen=True, eq=False)
class SavedResult:
    """Cells before (nominal) and after (calibrated), and poses to judge them by.

    held: (m,) True where the fit has not seen the pose.  uncertainty: of the fit, where it tells.
    spans: how far each joint went in its poses.
    """

    cells: Mapping[str, Cell]
    data: Measurements
    held: Array
    uncertainty: Uncertainty | None
    notices: tuple[str, ...]
    spans: tuple[JointSpan, ...] = ()


def evaluate(
    source: Given,
    data: Measured,
    rung: int | None = None,
    new_frame: bool = False,
) -> Accuracy:
    """Accuracy of a calibrated arm on new measurements in the same measurement frame.

    Parameters
    ----------
    source
        A calibration, its cell, a diagnosis, a relative calibration, or the file of one.
    data
        Points, and the columns that effects look at; nothing is fitted to them, but for
        base and targets of a relative calibration, which knows none.  Lengths, closures, contacts
        or poses: what their instrument has of its own (anchors, frames ...) is fitted to them.
    rung
        Of a diagnosis (0 nominal, 1 geometric ...), the last unless given.
    new_frame
        The instrument or the base stands elsewhere than in the calibration, so that its
        frame is fitted.

    Returns
    -------
    Accuracy
        Errors, in mm.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.evaluate(fit, "new_poses.csv").rms_mm)
    """
    return evaluate_with_notices(source, data, rung, new_frame).accuracy


@dataclass(frozen=True)
class Evaluation(Result):
    """How well the arm of a result predicts measurements.

    fit, data: their files.  rung: of the result, its name.  training_poses: of the measurements.
    outside: poses outside what the fit's joints spanned; narrow: joints that hardly moved there.
    with_them: the accuracy where points that were set aside count, None without any.
    """

    KIND = "evaluation"

    fit: str
    rung: str
    data: str
    data_sha256: str
    training_poses: int
    outside: Annotated[int, FieldFormat(key="outside_spans.poses")]
    narrow: Annotated[tuple[str, ...], FieldFormat(key="outside_spans.joints")]
    accuracy: Accuracy
    set_aside: tuple[SetAsidePoint, ...]
    with_them: StoredSeparately[Accuracy | None]
    shown: StoredSeparately[Table]
    notices: StoredSeparately[tuple[str, ...]]

    def headline(self) -> str:
        """The error in a sentence."""
        rms, unit = f"{self.accuracy.rms_mm:.4f}", "mm"
        if isinstance(self.accuracy, MeasuredAccuracy) and self.accuracy.unit:
            size, _, _, unit = self.accuracy.for_display
            rms = f"{size:.4g}"
        return f"RMS error {rms} {unit} on {self.data}."

    def tables(self) -> tuple[Table, ...]:
        """The error of all targets and of each."""
        return (self.shown,)

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """The accuracy of all points that were measured."""
        return {"accuracy": {"holdout_with_them": self.with_them} if self.with_them else {}}


def evaluate_with_notices(
    source: Given, data: Measured, rung: int | None, new_frame: bool = False
) -> Evaluation:
    """As `evaluate`, with what the reader should know."""
    given = read_instruments_or_measurements(data)
    if isinstance(given, list):
        if len(given) > 1:
            raise DataError("evaluate judges by one file at a time")
        if new_frame:
            raise OptionError("new_frame= is for points of a tracker: leave it out")
        return evaluate_on_instrument(source, given[0], rung)
    data = given
    opened = open_result(source, rung)
    cell, _, said = opened.place_on_data(data, new_frame)
    error = cell.error(data)
    found = summarise_point_errors(error)
    count, mixed = count_training_poses(data, opened, error)
    doubts = list_outlier_notices(data, np.linalg.norm(error, axis=-1))
    if found.rms_mm > 1e3 * MAX_CALIBRATION_ERROR_OF_REACH * cell.robot.reach():
        doubts.append(
            f"{data.source}: the fit misses by {found.rms_mm:.3g} mm: check that data and fit "
            "belong to the same robot, measurement frame, units and order of targets; if it was "
            "measured from elsewhere, new_frame=True fits where"
        )
    away, few = is_outside_narrow_spans(opened.spans, data.q), select_narrow_spans(opened.spans)
    if away.any():
        doubts.append(
            f"{data.source}: {away.sum()} of {data.poses} poses are outside what the joints of the "
            f"fit spanned ({describe_spans(few)}): no claim was made for them"
        )
    gone = None
    if data.set_aside:
        gone = accuracy_with_set_aside(
            error, group_repeated_poses(data), set_aside_errors(cell, data)
        )
        doubts.append(describe_points_set_aside(data.set_aside, gone))
    step = opened.rungs[opened.number].name
    name = cell.robot.name if rung is None else f"{cell.robot.name}, {step},"
    return Evaluation(
        fit=opened.source,
        rung=step,
        data=data.source,
        data_sha256=data.digest,
        training_poses=count,
        outside=int(away.sum()),
        narrow=tuple(span.joint for span in few),
        accuracy=found,
        set_aside=data.set_aside,
        with_them=gone,
        shown=found.table(f"{name} on {data.source}", data.target_names),
        notices=(*data.notices, *said, *list_session_and_time_notices(cell, data), *mixed, *doubts),
    )


def evaluate_on_instrument(
    source: Given, judged_instrument: Instrument, rung: int | None
) -> Evaluation:
    """How well an arm fits what an instrument measured, whose own unknowns are fitted to it."""
    opened = open_result(source, rung)
    robot, step = opened.cell.robot, opened.rungs[opened.number].name
    if opened.cell.effects.terms:
        raise OptionError(
            f"{opened.source}: its effects are judged by points of a tracker alone; take a step "
            "without them (step 1)"
        )
    judged_instrument, options = (
        replace(judged_instrument, at=check_and_complete_joints(robot, judged_instrument.at)),
        RelativeOptions(),
    )
    stack = build_training_stack(robot, {"": judged_instrument}, options)
    x, block = (
        build_start_state(robot, stack, select_parameters(stack, options)[0]),
        stack.blocks[0],
    )
    error = block.instrument.part_errors(
        *block.flange_and_own_values(x), np.zeros(judged_instrument.poses, dtype=bool)
    )
    found, data = (
        MeasuredAccuracy.from_errors(
            error, [judged_instrument.unit], int(judged_instrument.numbers_per_pose.sum())
        ),
        judged_instrument.at,
    )
    seen = bool(data.digest) and data.digest in opened.digest.split()
    said = [f"{data.source}: what the instrument has of its own is fitted to these rows"]
    said += [f"{data.source}: the fit was made of these rows"] * seen
    if found.rms_mm > 1e3 * MAX_CALIBRATION_ERROR_OF_REACH * robot.reach():
        said.append(
            f"{data.source}: the fit misses by {found.rms_mm:.3g} mm: check that data and fit "
            "belong to the same robot, units and order of columns"
        )
    return Evaluation(
        fit=opened.source,
        rung=step,
        data=data.source,
        data_sha256=data.digest,
        training_poses=data.poses if seen else 0,
        outside=int(is_outside_narrow_spans(opened.spans, data.q)[0].sum()),
        narrow=tuple(span.joint for span in select_narrow_spans(opened.spans)),
        accuracy=found,
        set_aside=data.set_aside,
        with_them=None,
        shown=part_error_table(
            f"{judged_instrument.words.quantity} on {data.source}", found, block.instrument, error
        ),
        notices=(*data.notices, *said),
    )


def part_error_table(
    title: str, whole: MeasuredAccuracy, judged_instrument: Instrument, error: Array
) -> Table:
    """Errors of each part of an instrument, as of each wire, and of all, in its unit.

    error: (m, parts, 3), NaN where not measured [unit].
    """
    if judged_instrument.unit == METRE_UNIT:
        return whole.table(title, judged_instrument.part_names)
    parts = [
        MeasuredAccuracy.from_errors(part[:, None], [judged_instrument.unit])
        for part in np.swapaxes(error, 0, 1)
    ]
    every = zip((*judged_instrument.part_names, "all"), (*parts, whole), strict=True)
    rows = ((n, sum(s.counts), *s.for_display[:3]) for n, s in every)
    unit = whole.for_display[-1]
    columns = f"part | numbers d | RMS {unit} .4g | max {unit} .4g | mean {unit} .4g"
    return Table.from_rows(title, rows, columns)


def open_saved_result(
    source: Given, data: Path | str = "", nominal: str = "", rung: int | None = None
) -> SavedResult:
    """A result, or its file, with the measurements in a file, or with its own.

    nominal: the robot before calibration, file or name; that of the result unless given.
    rung: see `open_result`.  Raises CalibrationError.
    """
    known = open_result(source, rung)
    notices: list[str] = []
    if data:
        measured = read_measurements(data)
        measured = check_and_complete_joints(known.cell.robot, measured)
        notices += measured.notices
        if known.placed:
            is_known = np.isin(measured.target_names, known.cell.target_names)
            if is_known.any() and not is_known.all():  # of none in common the cell complains
                names = ", ".join(np.array(measured.target_names)[~is_known])
                measured = measured.keep(is_known)
                notices.append(f"{measured.source}: {names} left out: the fit does not know them")
            notices += list_session_and_time_notices(known.cell, measured)
            measured = known.cell.align_to_first_session(measured)
        held, said = find_unseen_poses(measured, known)
        notices += said
    elif known.data.poses:
        measured, held = known.data, known.held
        check_saved_errors(known)
    else:
        raise CalibrationError(f"{known.source}: holds no poses; name the file of measurements too")
    cell, drawn, said = known.place_on_data(measured)
    train = known.train if known.data.poses else measured.take(~held)
    before, more = place_nominal_cell(cell, drawn, train, nominal, known.source)
    notices += [*said, *more]
    miss = np.nanmedian(np.linalg.norm(cell.error(measured), axis=-1))
    if miss > MAX_EXPECTED_ERROR_OF_REACH * cell.robot.reach():
        notices.append(
            f"{measured.source}: the fit misses by {1e3 * miss:.3g} mm: check that data and fit "
            "belong to the same robot, measurement frame, units and order of targets"
        )
    cells = {BEFORE: before, AFTER: cell}
    return SavedResult(cells, measured, held, known.uncertainty, tuple(notices), known.spans)


class UnseenPoses(NamedTuple):
    """(m,) True where a fit has not seen the pose, and notices on how that is known."""

    mask: Array
    notices: tuple[str, ...]


def find_unseen_poses(data: Measurements, known: OpenedResult) -> UnseenPoses:
    """Find the poses that a fit has not seen, by its own split or by the joints."""
    if not known.data.poses:
        said = "the fit does not tell its training poses: all count as training poses"
        return UnseenPoses(np.zeros(data.poses, dtype=bool), (said,))
    if data.digest and data.digest == known.digest:
        return UnseenPoses(np.isin(data.line, known.data.line[known.held]), ())
    held = np.asarray(KDTree(known.train.q).query(data.q)[0]) > MAX_REPEAT_DISTANCE
    said = (
        f"{data.source}: is not the file of the fit; {int((~held).sum())} of its {data.poses} rows "
        "have the joints of a training pose, the others count as held out"
    )
    return UnseenPoses(held, (said,))


class TrainingPoseCount(NamedTuple):
    """How many poses a fit was made of, and notices on it."""

    pose_count: int
    notices: tuple[str, ...]


def count_training_poses(
    data: Measurements, known: OpenedResult, error: Array
) -> TrainingPoseCount:
    """How many of the poses a fit was made of, and a notice that they are no new ones.

    error: (m, k, 3) of the poses [m].
    """
    if not known.data.poses:
        return TrainingPoseCount(0, ())
    held = find_unseen_poses(data, known)[0]
    count = int((~held).sum())
    if not count:
        return TrainingPoseCount(0, ())
    said = f"{data.source}: {count} of {data.poses} poses are training poses of the fit, which it "
    said += "meets better than new ones"
    if held.any():
        others = summarise_point_errors(error[held])
        said += f"; the others: RMS {others.rms_mm:.4f} mm, largest {others.max_mm:.4f} mm"
    return TrainingPoseCount(count, (said,))


def check_saved_errors(known: OpenedResult) -> None:
    """Raise DataError if the poses in a file do not give back the errors in it."""
    told = known.rungs[known.number].error
    if told is None:
        return
    if (
        not np.nanmax(np.abs(known.cell.error(known.data) - told), initial=0.0)
        <= MAX_RECOMPUTED_ERROR_DIFFERENCE
    ):
        raise DataError(
            f"{known.source}: its effects need columns of the measurements that it does not hold; "
            "name the file of measurements too"
        )


class PlacedNominalCell(NamedTuple):
    """The arm before calibration in its place, and notices on it."""

    cell: Cell
    notices: tuple[str, ...]


def place_nominal_cell(
    cell: Cell, before: Cell | None, train: Measurements, nominal: str, source: str
) -> PlacedNominalCell:
    """The arm before calibration in its place: the result's, else as it fits poses best; notices.

    before: that of the result.  train: the training poses.  nominal: its robot, "" for the
    result's own.  Raises CalibrationError.
    """
    if not nominal:
        if before is None:
            raise CalibrationError(
                f"{source}: does not tell its nominal robot; name it (`nominal`)"
            )
        return PlacedNominalCell(before, ())
    robot = load_robot(nominal)
    missing = [name for name in cell.target_names if name not in train.target_names]
    if missing:
        raise DataError(f"{train.source}: {missing[0]} was not measured")
    train = check_and_complete_joints(robot, train)
    state = fit_base_and_targets(
        build_point_model(robot, cell.align_to_first_session(train)), robot.mdh
    ).state
    said = f"{robot.name} before calibration is placed where it fits {train.poses} poses best"
    return PlacedNominalCell(
        Cell.from_parameters(robot, state, train.target_names, sessions=cell.sessions), (said,)
    )
