"""Where the gap between model and robot lies, before any effect is named.

Nothing here knows a displacement law.  Errors are cut by target, joint, direction, region and visit
order; mean squares tell the instrument's noise, the targets' scatter against each other, the
scatter between revisits and the static rest apart; a kernel test tells whether structure is left.
"""

from minimax_cal.diagnosing.where.answer import Where, triage_table
from minimax_cal.diagnosing.where.gaps import CANNOT_TELL, Part, Triage
from minimax_cal.diagnosing.where.joints import joint_equivalent
from minimax_cal.diagnosing.where.locate import where
from minimax_cal.diagnosing.where.spread import noise_of

__all__ = [
    "CANNOT_TELL",
    "Part",
    "Triage",
    "Where",
    "joint_equivalent",
    "noise_of",
    "triage_table",
    "where",
]
