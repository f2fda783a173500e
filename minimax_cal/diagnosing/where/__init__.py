"""Where the gap between model and robot lies, before any effect is named.

Nothing here knows a displacement law.  Errors are cut by target, joint, direction, region and visit
order; mean squares tell the instrument's noise, the targets' scatter against each other, the
scatter between revisits and the static rest apart.
"""

from minimax_cal.diagnosing.where.answer import Where
from minimax_cal.diagnosing.where.locate import where
from minimax_cal.diagnosing.where.mean_squares import noise_of
from minimax_cal.diagnosing.where.smooth import joint_equivalent

__all__ = ["Where", "joint_equivalent", "noise_of", "where"]
