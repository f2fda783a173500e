"""The verdict: what is established, whether it is enough, and whether anything else is there.

Evidence says which causes are there.  Whether they are the whole story is asked of what the tool
knows besides: repeated poses, the distances between targets, what is declared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import chdtri

from minimax_cal.diagnosing.causes import Causes
from minimax_cal.diagnosing.established import (
    find_unconfirmed,
    has_frequencies,
    is_mostly_unconfirmed,
)
from minimax_cal.diagnosing.joint import Joint
from minimax_cal.diagnosing.left_out import joint_units
from minimax_cal.diagnosing.result import WORSE_OUTSIDE, Finding, Untestable
from minimax_cal.diagnosing.what_remains import loudest
from minimax_cal.evidence.limits import HALF, MAX_JOINT_JITTER, MAX_OVER_NOISE
from minimax_cal.fitting.accuracy import rms_interval
from minimax_cal.fitting.floor import REPEATS, Floor, least_scatter, of_coordinate
from minimax_cal.measuring.faults.points import noise_between
from minimax_cal.measuring.grouping import clusters
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.solvers.status import Status

ABOVE_NOISE = "the remaining error is above the known noise"
ONLY_MINOR = "every confirmed cause is minor, and the remaining error is above the known noise"


@dataclass(frozen=True)
class Known:
    """What is known of the noise beneath a final model, as RMS distances [mm].

    highest: that visits, or instrument and sound joints, may add up to; NaN where nothing tells.
    remaining: lower 95 % limit of the model's error but for what its own fit takes.
    visits: lower 97.5 % limit of the scatter of repeated poses, NaN without.  expected: what
    instrument and sound joints would show there, NaN where the instrument is not known.
    """

    highest: float
    remaining: float
    visits: float
    expected: float

    @property
    def meets_floor(self) -> bool | None:
        """Whether the model is down to the noise; None where that is not known."""
        if not math.isfinite(self.highest):
            return None
        return self.remaining <= MAX_OVER_NOISE * self.highest

    @property
    def is_repeatable(self) -> bool:
        """False where visits to one pose scatter more than instrument and sound joints do."""
        return not self.visits > MAX_OVER_NOISE * self.expected

    @property
    def scatters_most(self) -> bool:
        """Whether what visits scatter is most of what the model leaves."""
        return self.meets_floor is True or self.visits**2 > HALF * self.remaining**2


def down_to(known: Known, complete: bool) -> bool | None:
    """Whether a model is down to the noise; None where that is not known.

    complete: whether all noise is: where it is not, more may be the model's than sound joints do.
    """
    above = known.meets_floor is False
    return not above if complete or above else None


def known_noise(last: Joint, floor: Floor, data: Measurements, repeatability: float) -> Known:
    """What is known of the noise beneath the last step.

    data: without faults.  repeatability: of the arm by its data sheet, NaN unknown [m].
    """
    # RMS distance by which sound joints miss their place at these poses, at most.
    scene = last.study.scene
    arm = scene.jacobian * joint_units(scene)[:, None, None, None]
    sound = 1e3 * MAX_JOINT_JITTER * float(np.sqrt((arm**2).sum(axis=(0, 2)).mean()))
    known = math.isfinite(repeatability)
    expected = max(sound, 1e3 * repeatability) if known else sound

    # Scatter of repeated poses by the mean of the squares, which sees two peaks where a median does
    # not; a pose counts as one number, for what joints do moves all of its points.
    repeats, between = floor.source == REPEATS, noise_between(data)
    again = least_scatter(data, last.cell.error(data)) if repeats else None
    visits = math.nan
    if again:
        square, group = again
        free = float(len(np.unique(group)))
        visits = 1e3 * math.sqrt(float(square.mean()) * free / float(chdtri(free, 0.025)))

    # Error on the poses of the fit, over their degrees of freedom: elsewhere errors of the
    # parameters count, which no noise tells.
    own, free = last.study.data, last.poses.left_free
    low = rms_interval(last.cell.error(own), clusters(own), rng=np.random.default_rng(0)).low
    count = 3.0 * float(np.count_nonzero(own.seen))
    remaining = 1e3 * float(np.nan_to_num(low)) * math.sqrt(count / free) if free >= 1.0 else 0.0

    instrument = of_coordinate(between[0]) if between else math.nan
    highest = math.hypot(floor.high, 0.0 if repeats or known else sound)
    return Known(
        highest=highest if floor.certain else math.nan,
        remaining=remaining,
        visits=visits,
        expected=math.hypot(instrument, expected),
    )


def answered(
    verdict: str, where: str, findings: Sequence[Finding], known: Known
) -> tuple[str, str]:
    """The verdict, and what is unexplained, once all that is known has been asked.

    verdict, where: by the evidence.
    """
    if not known.is_repeatable and known.scatters_most and verdict in ("none", "unknown"):
        return "not_repeatable", where
    sure = [found for found in findings if found.established]
    carry = [found for found in sure if not found.minor]
    meets = known.meets_floor
    if verdict in ("named", "one_of") and not carry:
        return ("unknown", ONLY_MINOR) if meets is False else ("none", where)
    if verdict != "unknown" and meets is False:
        return "unknown", ABOVE_NOISE
    return verdict, where


# ---- the verdict ---------------------------------------------------------------------------------


UNSURE = "the causes found change with the choice of poses"
UNASKED = "too few poses to confirm the causes found"
UNHELPFUL = "the causes found do not improve held-out poses"


def explanation(
    findings: Sequence[Finding], causes: Causes, known: Known, status: Status, *, failed: bool
) -> dict[str, Any]:
    """The fields of `result.Explained`.

    findings: as the ladder took them, with the faults.  known: noise.  status: of the geometric
    fit.  failed: whether the last fit contradicts the data.
    """
    # By the evidence: what is confirmed, and whether anything significant remains.
    remains = loudest(causes.left)
    loud = remains or causes.left[0]
    where, p = loud.name, loud.p
    sure = [found for found in findings if found.established]
    named = [found for found in sure if np.isfinite(found.size)]  # no fault of the data
    if remains:
        verdict = "unknown"
    elif is_mostly_unconfirmed(causes.effects, named):
        verdict = "unknown"
        where = why_loose(causes.effects, find_unconfirmed(causes.effects, named))
    elif not sure:
        verdict = "none"
    else:
        verdict = "one_of" if any(found.alternatives for found in sure) else "named"

    # By all that is known of the noise besides.
    verdict, where = answered(verdict, where, findings, known)
    return {
        "status": Status.FAILED if failed else status,
        "verdict": "unknown" if failed else verdict,
        "effects": tuple(findings),
        "jitter": causes.choice.noise.jitter,
        "structure": p,
        "structure_in": where,
        "not_testable": tuple(Untestable(*each) for each in causes.untestable),
        "meets_floor": known.meets_floor,
    }


def why_loose(effects: Sequence[Finding], loose: Sequence[Finding]) -> str:
    """What is wrong with the names that do not hold."""
    if not has_frequencies(effects):
        return UNASKED
    if any(not found.extends for found in loose):
        return WORSE_OUTSIDE
    refused = sum(found.size for found in loose if found.established)
    return UNHELPFUL if refused > HALF * sum(found.size for found in loose) else UNSURE
