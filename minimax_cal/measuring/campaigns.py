"""Several files of one arm, measured one after the other: campaigns, each a session of its own."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from minimax_cal.core.errors import DataError
from minimax_cal.measuring.measurements import Measurements, RowOrigin, build_measurements
from minimax_cal.reading.measurement_table import read_measurement_table
from minimax_cal.reading.text_sheet import Sheet, read_text_sheet

MAX_CAMPAIGN_FILES = 100
FILE_LABEL_COLUMNS = ("pose", "group")  # which mean something in their own file only


def read_campaigns(paths: Sequence[Path | str | Sheet]) -> Measurements:
    """The measurements of one file, or of several as sessions.

    Parameters
    ----------
    paths
        In the order in which they were measured.

    Returns
    -------
    Measurements
        Each file is a session.

    Raises
    ------
    DataError
        For wrong input.

    Examples
    --------
    >>> data = mc.read_campaigns(["march.csv", "june.csv"])
    """
    if not paths:
        raise DataError("no file of measurements is given")
    if len(paths) > MAX_CAMPAIGN_FILES:
        raise DataError(f"{len(paths)} files of measurements; give at most {MAX_CAMPAIGN_FILES}")
    sheets = [read_text_sheet(path) for path in paths]
    if len(paths) > 1 and (whole := import_separate_points_and_joints(sheets)):
        return whole
    parts = [build_measurements(read_measurement_table(sheet)) for sheet in sheets]
    return (
        parts[0]
        if len(parts) == 1
        else join_campaigns(parts, session_names_from_paths([sheet.path for sheet in sheets]))
    )


def import_separate_points_and_joints(sheets: Sequence[Sheet]) -> Measurements | None:
    """Measurements whose points and joints lie in files of their own; None where none does.

    Raises DataError.
    """
    from minimax_cal.measuring import importers  # few lie apart

    try:
        readings = [
            importers.read_in_first_fitting_format(sheet, importers.ImportOptions())
            for sheet in sheets
        ]
    except DataError:
        return None  # the reader of each says what is wrong
    if all(reading.target_numbers and reading.joint_columns for reading in readings):
        return None
    return importers.import_files(sheets).understood()


def session_names_from_paths(paths: Sequence[Path | str]) -> list[str]:
    """What the sessions of files are called: by the stem, or as much of the path as differs.

    Raises DataError for a file that is given twice.
    """
    whole = [Path(path).resolve() for path in paths]
    if len(set(whole)) < len(whole):
        twice = next(path for path in whole if whole.count(path) > 1)
        raise DataError(f"{twice}: is given twice; a campaign counts once")
    for depth in range(1, max(len(path.parts) for path in whole) + 1):
        names = ["/".join((*path.parts[-depth:-1], path.stem)) for path in whole]
        if len(set(names)) == len(names):
            return names
    return [str(path) for path in whole]  # stems alike, endings not


def join_campaigns(campaigns: Sequence[Measurements], session_names: Sequence[str]) -> Measurements:
    """Measurements of one arm as sessions of one set.

    session_names: of the sessions; where a part has sessions itself these come after it, as june/2.
    Lines of the second part are those of its file and a round number more, and so on.  Targets go
    by their names.  Raises DataError for parts of different joints.
    """
    check_same_joints(campaigns)
    first_of = {part.digest: part for part in reversed(campaigns) if part.digest}
    for part in campaigns:
        if (same := first_of.get(part.digest, part)) is not part:
            raise DataError(
                f"{part.source}: holds the same as {same.source}; a campaign counts once"
            )
    last = max(int(part.line.max(initial=1)) for part in campaigns)
    step = int(10 ** max(3, len(str(last))))  # a round number above all lines
    targets = tuple(dict.fromkeys(name for part in campaigns for name in part.target_names))
    first, *others = shift_overlapping_times(
        [
            part.change_with_set_aside(
                partial(label_as_session, name=name, more=number * step, targets=targets)
            )
            for number, (part, name) in enumerate(zip(campaigns, session_names, strict=True))
        ]
    )
    said = ", ".join(
        f"{part.source} from line {number * step + 1}"
        for number, part in enumerate(campaigns)
        if number
    )
    return replace(
        first.append_measurements(*others),
        notices=(
            *(notice for part in campaigns for notice in part.notices),
            (
                f"{len(campaigns)} files are sessions {', '.join(session_names)}"
                f"; lines are numbered on: {said}"
            ),
        ),
        source=" + ".join(part.source for part in campaigns),
        origins=tuple(
            RowOrigin((part.source,), begin=i * step) for i, part in enumerate(campaigns)
        ),
        digest=hashlib.sha256("".join(part.digest for part in campaigns).encode()).hexdigest(),
    )


def check_same_joints(campaigns: Sequence[Measurements]) -> None:
    """Raise DataError for parts whose joints are not those of the first."""
    first = campaigns[0]
    for part in campaigns[1:]:
        if part.q.shape[1] != first.q.shape[1]:
            raise DataError(
                f"{part.source}: has {part.q.shape[1]} joints, {first.source} has "
                f"{first.q.shape[1]}; files of one calibration are of one arm"
            )
        if (part.sliding != first.sliding).any():
            joint = int(np.argmax(part.sliding != first.sliding)) + 1
            raise DataError(
                f"{part.source}: joint {joint} is a length there and an angle in {first.source}, "
                "or the other way round; name the column by its unit"
            )


def label_as_session(
    part: Measurements, name: str, more: int, targets: tuple[str, ...]
) -> Measurements:
    """A part as the session of a name, before that of the file where it has several.

    Its lines are counted on, its labels apart from those of other files; of all targets those that
    it lacks are measured nowhere.
    """
    own = part.columns.get("session", np.full(part.poses, "")).astype(str)
    several = len(np.unique(own)) > 1
    label = np.array([f"{name}/{cell}" if several and cell else name for cell in own], dtype=str)
    columns = {**part.columns, "session": label}
    for column in {*FILE_LABEL_COLUMNS} & {*columns}:
        cells = columns[column].astype(str)
        columns[column] = np.array([f"{name}/{cell}" if cell else "" for cell in cells], dtype=str)
    y = np.full((part.poses, len(targets), 3), np.nan)
    y[:, [targets.index(target) for target in part.target_names]] = part.y
    return replace(
        part,
        y=y,
        target_names=targets,
        line=part.line + more,
        columns=columns,
        set_aside=tuple(replace(point, row=point.row + more) for point in part.set_aside),
    )


def shift_overlapping_times(campaigns: Sequence[Measurements]) -> list[Measurements]:
    """The parts, the time of each after that of the one before where their clocks overlap."""
    out: list[Measurements] = []
    last = -np.inf
    for part in campaigns:
        time = part.columns.get("time", np.zeros(0)).astype(float)
        known = time[np.isfinite(time)]
        if len(known):
            late = float(last - known.min()) if known.min() <= last else 0.0
            last = float(known.max()) + late
            part = (
                part.change_with_set_aside(partial(shift_measurement_time, seconds=late + 1.0))
                if late
                else part
            )
        out.append(part)
    return out


def shift_measurement_time(part: Measurements, seconds: float) -> Measurements:
    """A part measured so much later [s]."""
    columns = {**part.columns, "time": part.columns["time"].astype(float) + seconds}
    return replace(part, columns=columns)
