"""Rows of joint values, and the optional columns beside them, of files that hold no points."""

from __future__ import annotations

import re

import numpy as np

from minimax_cal.measuring.measurements import Measurements, check_columns, check_u95
from minimax_cal.reading.rows import NOTHING, TARGET, Rows, header_check

ANY_TARGET = ("smr1_x_mm", "smr1_y_mm", "smr1_z_mm")  # the header's rules ask for one


def joint_rows(
    file: Rows,
    own: re.Pattern[str],
    doubts: re.Pattern[str] = NOTHING,
    unused: str = "is not used",
) -> tuple[Rows, Measurements]:
    """The rows of a file, and its poses without any point.

    own, doubts: as of `Rows.optional`.  unused: what is said of other columns.  Raises DataError.
    """
    bare = [name for name in file.header if not TARGET.fullmatch(name)]
    header_check(file.path, [*bare, *ANY_TARGET])
    q, sliding = file.joints()
    columns, left = file.optional(own, doubts)
    left |= {name: "" for name in file.header if TARGET.fullmatch(name) and not own.fullmatch(name)}
    idle = (f"{file.path}: column {name} {unused}{why}" for name, why in left.items())
    notices = (*file.notices, *idle)
    at = Measurements(
        q, np.zeros((len(q), 0, 3)), (), sliding, file.line, columns, {}, notices, str(file.path),
        file.sheet.digest,
    )  # fmt: skip
    return file, check_u95(check_columns(at))
