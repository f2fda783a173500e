"""Several files of one arm, measured one after the other: campaigns, each a session of its own."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.measurements import Measurements, Origin, measurements_in
from minimax_cal.reading.rows import read_rows
from minimax_cal.reading.sheet import Sheet, open_text

MOST_FILES = 100
LABELS = ("pose", "group")  # which mean something in their own file only


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
    if len(paths) > MOST_FILES:
        raise DataError(f"{len(paths)} files of measurements; give at most {MOST_FILES}")
    sheets = [open_text(path) for path in paths]
    if len(paths) > 1 and (whole := apart(sheets)):
        return whole
    parts = [measurements_in(read_rows(sheet)) for sheet in sheets]
    return (
        parts[0]
        if len(parts) == 1
        else campaigns(parts, session_names([sheet.path for sheet in sheets]))
    )


def apart(sheets: Sequence[Sheet]) -> Measurements | None:
    """Measurements whose points and joints lie in files of their own; None where none does.

    Raises DataError.
    """
    from minimax_cal.measuring import importers  # few lie apart

    try:
        readings = [importers.read_any(sheet, importers.Given()) for sheet in sheets]
    except DataError:
        return None  # the reader of each says what is wrong
    if all(reading.smrs and reading.joints for reading in readings):
        return None
    return importers.import_files(sheets).understood()


def session_names(paths: Sequence[Path | str]) -> list[str]:
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


def campaigns(parts: Sequence[Measurements], names: Sequence[str]) -> Measurements:
    """Measurements of one arm as sessions of one set.

    names: of the sessions; where a part has sessions itself these come after it, as june/2.  Lines
    of the second part are those of its file and a round number more, and so on.  Targets go by
    their names.  Raises DataError for parts of different joints.
    """
    check_alike(parts)
    first_of = {part.digest: part for part in reversed(parts) if part.digest}
    for part in parts:
        if (same := first_of.get(part.digest, part)) is not part:
            raise DataError(
                f"{part.source}: holds the same as {same.source}; a campaign counts once"
            )
    last = max(int(part.line.max(initial=1)) for part in parts)
    step = int(10 ** max(3, len(str(last))))  # a round number above all lines
    targets = tuple(dict.fromkeys(name for part in parts for name in part.target_names))
    first, *others = in_turn(
        [
            part.everywhere(partial(placed, name=name, more=number * step, targets=targets))
            for number, (part, name) in enumerate(zip(parts, names, strict=True))
        ]
    )
    said = ", ".join(
        f"{part.source} from line {number * step + 1}"
        for number, part in enumerate(parts)
        if number
    )
    return replace(
        first.followed_by(*others),
        notices=(
            *(notice for part in parts for notice in part.notices),
            f"{len(parts)} files are sessions {', '.join(names)}; lines are numbered on: {said}",
        ),
        source=" + ".join(part.source for part in parts),
        origins=tuple(Origin((part.source,), begin=i * step) for i, part in enumerate(parts)),
        digest=hashlib.sha256("".join(part.digest for part in parts).encode()).hexdigest(),
    )


def check_alike(parts: Sequence[Measurements]) -> None:
    """Raise DataError for parts whose joints are not those of the first."""
    first = parts[0]
    for part in parts[1:]:
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


def placed(part: Measurements, name: str, more: int, targets: tuple[str, ...]) -> Measurements:
    """A part as the session of a name, before that of the file where it has several.

    Its lines are counted on, its labels apart from those of other files; of all targets those that
    it lacks are measured nowhere.
    """
    own = part.columns.get("session", np.full(part.poses, "")).astype(str)
    several = len(np.unique(own)) > 1
    label = np.array([f"{name}/{cell}" if several and cell else name for cell in own], dtype=str)
    columns = {**part.columns, "session": label}
    for column in {*LABELS} & {*columns}:
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


def in_turn(parts: Sequence[Measurements]) -> list[Measurements]:
    """The parts, the time of each after that of the one before where their clocks overlap."""
    out: list[Measurements] = []
    last = -np.inf
    for part in parts:
        time = part.columns.get("time", np.zeros(0)).astype(float)
        known = time[np.isfinite(time)]
        if len(known):
            late = float(last - known.min()) if known.min() <= last else 0.0
            last = float(known.max()) + late
            part = part.everywhere(partial(later, seconds=late + 1.0)) if late else part
        out.append(part)
    return out


def later(part: Measurements, seconds: float) -> Measurements:
    """A part measured so much later [s]."""
    columns = {**part.columns, "time": part.columns["time"].astype(float) + seconds}
    return replace(part, columns=columns)
