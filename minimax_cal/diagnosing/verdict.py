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

from minimax_cal.diagnosing.cause_search import FoundCauses
from minimax_cal.diagnosing.confirmation import (
    find_unconfirmed,
    has_frequencies,
    is_mostly_unconfirmed,
)
from minimax_cal.diagnosing.curve_cross_validation import joint_unit_sizes
from minimax_cal.diagnosing.diagnosis import WORSE_OUTSIDE_TEXT, Finding, UntestableEffect
from minimax_cal.diagnosing.joint_fit import GeometryEffectFit
from minimax_cal.diagnosing.remaining_error import most_telling_component
from minimax_cal.fitting.accuracy import bootstrap_rms_interval
from minimax_cal.fitting.noise_floor import (
    REPEATS,
    NoiseFloor,
    rms_mm_from_coordinate_sigma,
    smallest_revisit_deviations,
)
from minimax_cal.measuring.faults.point_faults import estimate_noise_from_distances
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import cluster_poses
from minimax_cal.selection.thresholds import (
    MAIN_PART_FRACTION,
    MAX_ERROR_TO_NOISE_RATIO,
    SOUND_JOINT_JITTER_RAD,
)
from minimax_cal.solvers.status import Status

ABOVE_NOISE_TEXT = "the remaining error is above the known noise"
ONLY_MINOR_TEXT = "every confirmed cause is minor, and the remaining error is above the known noise"


@dataclass(frozen=True)
class NoiseLimits:
    """What is known of the noise beneath a final model, as RMS distances [mm].

    highest_noise_mm: that visits, or instrument and sound joints, may add up to; NaN where nothing
    tells. lowest_error_mm: lower 95 % limit of the model's error but for what its own fit takes.
    lowest_visit_scatter_mm: lower 97.5 % limit of the scatter of repeated poses, NaN without.
    expected_scatter_mm: what instrument and sound joints would show there, NaN where the instrument
    is not known.
    """

    highest_noise_mm: float
    lowest_error_mm: float
    lowest_visit_scatter_mm: float
    expected_scatter_mm: float

    @property
    def is_down_to_noise(self) -> bool | None:
        """Whether the model is down to the noise; None where that is not known."""
        if not math.isfinite(self.highest_noise_mm):
            return None
        return self.lowest_error_mm <= MAX_ERROR_TO_NOISE_RATIO * self.highest_noise_mm

    @property
    def is_repeatable(self) -> bool:
        """False where visits to one pose scatter more than instrument and sound joints do."""
        return (
            not self.lowest_visit_scatter_mm > MAX_ERROR_TO_NOISE_RATIO * self.expected_scatter_mm
        )

    @property
    def is_mostly_scatter(self) -> bool:
        """Whether what visits scatter is most of what the model leaves."""
        return (
            self.is_down_to_noise is True
            or self.lowest_visit_scatter_mm**2 > MAIN_PART_FRACTION * self.lowest_error_mm**2
        )


def is_down_to_complete_noise(noise_limits: NoiseLimits, is_noise_complete: bool) -> bool | None:
    """Whether a model is down to the noise; None where that is not known.

    is_noise_complete: whether all noise is: where it is not, more may be the model's than sound
    joints do.
    """
    above = noise_limits.is_down_to_noise is False
    return not above if is_noise_complete or above else None


def estimate_noise_limits(
    last_fit: GeometryEffectFit, noise_floor: NoiseFloor, data: Measurements, repeatability: float
) -> NoiseLimits:
    """What is known of the noise beneath the last step.

    data: without faults.  repeatability: of the arm by its data sheet, NaN unknown [m].
    """
    # RMS distance by which sound joints miss their place at these poses, at most.
    scene = last_fit.study.scene
    arm = scene.jacobian * joint_unit_sizes(scene)[:, None, None, None]
    sound = 1e3 * SOUND_JOINT_JITTER_RAD * float(np.sqrt((arm**2).sum(axis=(0, 2)).mean()))
    known = math.isfinite(repeatability)
    expected = max(sound, 1e3 * repeatability) if known else sound

    # Scatter of repeated poses by the mean of the squares, which sees two peaks where a median does
    # not; a pose counts as one number, for what joints do moves all of its points.
    repeats, between = noise_floor.source == REPEATS, estimate_noise_from_distances(data)
    again = smallest_revisit_deviations(data, last_fit.cell.error(data)) if repeats else None
    visits = math.nan
    if again:
        square, group = again
        free = float(len(np.unique(group)))
        visits = 1e3 * math.sqrt(float(square.mean()) * free / float(chdtri(free, 0.025)))

    # Error on the poses of the fit, over their degrees of freedom: elsewhere errors of the
    # parameters count, which no noise tells.
    own, free = last_fit.study.data, last_fit.pose_linearisation.degrees_of_freedom
    low = bootstrap_rms_interval(
        last_fit.cell.error(own), cluster_poses(own), rng=np.random.default_rng(0)
    ).low
    count = 3.0 * float(np.count_nonzero(own.seen))
    remaining = 1e3 * float(np.nan_to_num(low)) * math.sqrt(count / free) if free >= 1.0 else 0.0

    instrument = rms_mm_from_coordinate_sigma(between[0]) if between else math.nan
    highest = math.hypot(noise_floor.high, 0.0 if repeats or known else sound)
    return NoiseLimits(
        highest_noise_mm=highest if noise_floor.is_certain else math.nan,
        lowest_error_mm=remaining,
        lowest_visit_scatter_mm=visits,
        expected_scatter_mm=math.hypot(instrument, expected),
    )


def adjust_verdict_to_noise(
    verdict: str, unexplained_text: str, findings: Sequence[Finding], noise_limits: NoiseLimits
) -> tuple[str, str]:
    """The verdict, and what is unexplained, once all that is known has been asked.

    verdict, unexplained_text: by the evidence.
    """
    if (
        not noise_limits.is_repeatable
        and noise_limits.is_mostly_scatter
        and verdict in ("none", "unknown")
    ):
        return "not_repeatable", unexplained_text
    sure = [found for found in findings if found.established]
    carry = [found for found in sure if not found.minor]
    meets = noise_limits.is_down_to_noise
    if verdict in ("named", "one_of") and not carry:
        return ("unknown", ONLY_MINOR_TEXT) if meets is False else ("none", unexplained_text)
    if verdict != "unknown" and meets is False:
        return "unknown", ABOVE_NOISE_TEXT
    return verdict, unexplained_text


# ---- the verdict ---------------------------------------------------------------------------------


CHANGING_CAUSES_TEXT = "the causes found change with the choice of poses"
TOO_FEW_POSES_TEXT = "too few poses to confirm the causes found"
UNHELPFUL_CAUSES_TEXT = "the causes found do not improve held-out poses"


def explain_verdict(
    findings: Sequence[Finding],
    causes: FoundCauses,
    noise_limits: NoiseLimits,
    status: Status,
    *,
    is_contradicted: bool,
) -> dict[str, Any]:
    """The fields of `diagnosis.Explanation`.

    findings: as the ladder took them, with the faults.  noise_limits: noise.  status: of the
    geometric fit.  is_contradicted: whether the last fit contradicts the data.
    """
    # By the evidence: what is confirmed, and whether anything significant remains.
    remains = most_telling_component(causes.remaining_components)
    loud = remains or causes.remaining_components[0]
    where, p = loud.place_and_driver, loud.p
    sure = [found for found in findings if found.established]
    named = [found for found in sure if np.isfinite(found.size)]  # no fault of the data
    if remains:
        verdict = "unknown"
    elif is_mostly_unconfirmed(causes.effects, named):
        verdict = "unknown"
        where = describe_why_unconfirmed(causes.effects, find_unconfirmed(causes.effects, named))
    elif not sure:
        verdict = "none"
    else:
        verdict = "one_of" if any(found.alternatives for found in sure) else "named"

    # By all that is known of the noise besides.
    verdict, where = adjust_verdict_to_noise(verdict, where, findings, noise_limits)
    return {
        "status": Status.FAILED if is_contradicted else status,
        "verdict": "unknown" if is_contradicted else verdict,
        "effects": tuple(findings),
        "jitter": causes.selection.noise.joint_jitter,
        "structure": p,
        "structure_in": where,
        "not_testable": tuple(UntestableEffect(*each) for each in causes.untestable),
        "meets_floor": noise_limits.is_down_to_noise,
    }


def describe_why_unconfirmed(effects: Sequence[Finding], unconfirmed: Sequence[Finding]) -> str:
    """What is wrong with the names that do not hold."""
    if not has_frequencies(effects):
        return TOO_FEW_POSES_TEXT
    if any(not found.extends for found in unconfirmed):
        return WORSE_OUTSIDE_TEXT
    refused = sum(found.size for found in unconfirmed if found.established)
    return (
        UNHELPFUL_CAUSES_TEXT
        if refused > MAIN_PART_FRACTION * sum(found.size for found in unconfirmed)
        else CHANGING_CAUSES_TEXT
    )
