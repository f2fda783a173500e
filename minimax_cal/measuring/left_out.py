"""Single points, or whole poses, that people set aside."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from minimax_cal.ground.errors import OptionError
from minimax_cal.measuring.measurements import Measurements

POINT = re.compile(r"(\d+)(?::(smr\d+))?")
MANY = 1000  # letters of the names that a notice repeats


def left_out(data: Measurements, points: Iterable[str]) -> Measurements:
    """The measurements with some points as if nobody had measured them; every row stays.

    points: each as 12:smr2 (of the pose in line 12 of the file), or 12 for all of that pose.
    Raises OptionError.
    """
    y, names = data.y.copy(), tuple(dict.fromkeys(points))
    for name in names:
        found = POINT.fullmatch(name)
        if not found:
            raise OptionError(f"leave out {name!r}: write LINE:TARGET, as 12:smr2, or LINE")
        rows = data.line == int(found[1])
        if not rows.any():
            lines = f"{data.line.min()} to {data.line.max()}" if data.poses else "none"
            raise OptionError(f"leave out {name}: no pose stands in line {found[1]} (but {lines})")
        if found[2] and found[2] not in data.target_names:
            known = ", ".join(data.target_names)
            raise OptionError(f"leave out {name}: no such target; there are {known}")
        targets = [not found[2] or found[2] == target for target in data.target_names]
        y[np.ix_(rows, targets)] = np.nan
    if not names:
        return data
    said = " ".join(names)
    said = said if len(said) <= MANY else f"{said[:MANY]} ..."
    count = int(data.seen.sum() - np.isfinite(y).all(axis=2).sum())
    return replace(data, y=y, notices=(*data.notices, f"{count} points left out: {said}"))
