"""What the last step of a diagnosis leaves, and where each part of it is known from.

error^2 = noise^2 + what depends on something^2 + what nothing explains^2.  A part that nobody has
measured is no number here: the scatter of the joints, which only visits to one pose tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from minimax_cal.diagnosing.result import Dependence, Remaining
from minimax_cal.diagnosing.what_remains import certain
from minimax_cal.evidence.limits import MAX_ALONE
from minimax_cal.evidence.remains import Remains
from minimax_cal.measuring.floor import REPEATS, Floor, instrument_alone
from minimax_cal.measuring.measurements import Measurements


def remaining_of(
    left: Sequence[Remains], last: float, floor: Floor, data: Measurements
) -> tuple[Remaining, bool]:
    """What remains, and whether all noise beneath it is known.

    left: what the last step leaves, as asked of its poses.  last: RMS distance that it leaves at
    held-out poses [mm].  floor: beneath it.  data: without faults.
    """
    depends = tuple(
        Dependence(one.place, one.driver, last * math.sqrt(min(one.share, 1.0)), one.p)
        for one in certain(left)
    )
    noise, source = (floor.value, REPEATS) if floor.source == REPEATS else instrument_alone(data)
    known = source == REPEATS or last <= MAX_ALONE * noise
    told = Remaining(depends, 0.0, noise, source)
    square = last**2 - (noise**2 if noise > 0.0 else 0.0) - told.dependent_mm**2
    return replace(told, unexplained_mm=math.sqrt(max(square, 0.0))), known
