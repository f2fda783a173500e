"""What is wrong with data: a `Fault` and its numbers."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from minimax_cal.ground.arrays import Array

NO_ERROR: Array = np.zeros((0, 0, 3))
NONE: Array = np.zeros(0, dtype=int)


@dataclass(frozen=True)
class Amount:
    """A number of a fault or an effect.  value, sigma: in `unit`, SI; sigma NaN if not known."""

    name: str
    value: float
    unit: str = ""
    sigma: float = np.nan


@dataclass(frozen=True, eq=False)
class Fault:
    """One thing wrong with the data, or a notice.

    effect: outliers, swapped_rows, target_shift (target_reseat where the visits are not known) or
    readback; as notices also mixed_units, session_jump and noise.  place: smr1, smr1 or smr2, all,
    frame.
    rows: (r,) rows of the data; of a shift all rows after it, as visited; of jumps the first after.
    targets: outliers (r,) the target of each row; swapped rows (r, k) in whose columns each
    target stands; shift: which nest it can be; else of length 0.
    """

    effect: str
    place: str
    text: str
    rows: Array = field(default_factory=lambda: NONE)
    targets: Array = field(default_factory=lambda: NONE)
    parameters: tuple[Amount, ...] = ()
