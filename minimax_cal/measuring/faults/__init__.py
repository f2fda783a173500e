"""Faults of the data, found before any effect is fitted: points, rows, nests, sessions, joints.

Distances between targets tell without any model: a point that moved, rows with exchanged names, a
nest that shifted.  What lies across the plane of the targets they cannot show; there, and with one
or two targets, the residual of a fit must stand out grossly.
"""

from minimax_cal.measuring.faults.declared import noise, noise_between
from minimax_cal.measuring.faults.fault import Amount, Fault
from minimax_cal.measuring.faults.find import (
    distance_faults,
    find_faults,
    in_lines,
    mended,
    spoilt,
    standing_out,
)
from minimax_cal.measuring.faults.joints import looks_read_back, read_back, unsettled
from minimax_cal.measuring.faults.nests import target_shifts
from minimax_cal.measuring.faults.outliers import far_off, outlying
from minimax_cal.measuring.faults.sessions import jumps, mixed_units, session_jumps
from minimax_cal.measuring.faults.swaps import swapped_rows

__all__ = [
    "Amount",
    "Fault",
    "distance_faults",
    "far_off",
    "find_faults",
    "in_lines",
    "jumps",
    "looks_read_back",
    "mended",
    "mixed_units",
    "noise",
    "noise_between",
    "outlying",
    "read_back",
    "session_jumps",
    "spoilt",
    "standing_out",
    "swapped_rows",
    "target_shifts",
    "unsettled",
]
