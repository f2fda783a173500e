"""Rows of joint values, and the optional columns beside them, of files that hold no points."""

from __future__ import annotations

import re

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements, check_columns, check_u95
from minimax_cal.reading.rows import (
    JOINT,
    TARGET,
    TEXT,
    Rows,
    header_check,
    near,
    optional_kind,
    useless,
)

ANY_TARGET = ("smr1_x_mm", "smr1_y_mm", "smr1_z_mm")  # the header's rules ask for one
NOTHING = re.compile(r"(?!)")


def joint_rows(
    file: Rows, own: re.Pattern[str], doubts: re.Pattern[str] = NOTHING
) -> tuple[Rows, Measurements]:
    """The whole rows of a file, and its poses without any point.

    own: names of columns that the caller reads.  doubts: of an instrument's own accuracy, with the
    unit as their group; others have no use here.  Raises DataError.
    """
    bare = [name for name in file.header if not TARGET.fullmatch(name)]
    header_check(file.path, [*bare, *ANY_TARGET])
    q, sliding = file.joints()
    columns, notices = optional_columns(file, own, doubts)
    at = Measurements(
        q, np.zeros((len(q), 0, 3)), (), sliding, file.line, columns, {}, notices, str(file.path),
        file.digest,
    )  # fmt: skip
    return file, check_u95(check_columns(at))


def optional_columns(
    file: Rows, own: re.Pattern[str], doubts: re.Pattern[str]
) -> tuple[dict[str, Array], tuple[str, ...]]:
    """The optional columns by name, in SI, and a notice for each column that is not used."""
    columns: dict[str, Array] = {}
    idle = useless(file.header)
    notices = [f"{file.path}: column {name} is not used: {why}" for name, why in idle.items()]
    for name in file.header:
        if name in idle or own.fullmatch(name) or JOINT.fullmatch(name):
            continue
        family, match = optional_kind(name)
        match = doubts.fullmatch(name) or (None if family == "u95" else match)
        if family in TEXT:
            columns[name] = np.array(file.text(name))
        elif match:
            unit = match[1] if match.re.groups else ""
            columns[name.removesuffix(f"_{unit}")] = file.number(name, unit=unit, empty=True)
        else:
            notices.append(f"{file.path}: column {name} is not used{'' if family else near(name)}")
    return columns, tuple(notices)
