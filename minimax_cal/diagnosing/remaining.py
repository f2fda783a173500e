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
from minimax_cal.fitting.floor import REPEATS, instrument_alone, least_scatter
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements


def remaining_of(
    left: Sequence[Remains], last: float, data: Measurements, error: Array
) -> tuple[Remaining, bool]:
    """What remains, and whether all noise beneath it is known.

    left: what the last step leaves, as asked of its poses.  last: RMS distance that it leaves at
    held-out poses [mm].  data: without faults; error: (k, m, 3) of its arm at them [m].
    """
    again = least_scatter(data, error)
    noise, source = instrument_alone(data)
    if again:  # joints that stop on either side have no middle: by the mean of the squares
        noise, source = 1e3 * math.sqrt(float(again[0].mean())), REPEATS
    known = source == REPEATS or last <= MAX_ALONE * noise
    noise = min(noise, last) if math.isfinite(noise) else noise
    rest = math.sqrt(last**2 - (noise**2 if noise > 0.0 else 0.0))
    depends = tuple(
        Dependence(one.place, one.driver, min(last * math.sqrt(one.share), rest), one.p)
        for one in certain(left)
    )
    told = Remaining(depends, 0.0, noise, source)
    return replace(told, unexplained_mm=math.sqrt(rest**2 - told.dependent_mm**2)), known
