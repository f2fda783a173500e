"""The verdict: what is established, whether it is enough, and whether anything else is there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from minimax_cal.diagnosing.causes import Causes
from minimax_cal.diagnosing.established import asked, loose_among, mostly_loose
from minimax_cal.diagnosing.last_question import Known, answered
from minimax_cal.diagnosing.result import WORSE_OUTSIDE, Finding, Untestable
from minimax_cal.diagnosing.what_remains import loudest
from minimax_cal.evidence.limits import HALF
from minimax_cal.solvers.status import Status

UNSURE = "the causes found change with the choice of poses"
UNASKED = "too few poses to confirm the causes found"
UNHELPFUL = "the causes found do not improve held-out poses"

Structure = tuple[str, float]


def explanation(
    findings: Sequence[Finding], causes: Causes, known: Known, status: Status, *, failed: bool
) -> dict[str, Any]:
    """The fields of `result.Explained`.

    findings: as the ladder took them, with the faults.  known: noise.  status: of the geometric
    fit.  failed: whether the last fit contradicts the data.
    """
    verdict, (where, p) = judged(findings, causes)
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


def judged(findings: Sequence[Finding], causes: Causes) -> tuple[str, Structure]:
    """The verdict by the evidence; what remains loudest, and its chance.

    findings: as the ladder took them, with the faults.
    """
    loud = loudest(causes.left) or causes.left[0]
    structure = (loud.name, loud.p)
    sure = [found for found in findings if found.established]
    if loudest(causes.left):
        return "unknown", structure
    named = [found for found in sure if np.isfinite(found.size)]  # no fault of the data
    unsure = why_loose(causes.effects, loose_among(causes.effects, named))
    if mostly_loose(causes.effects, named):
        return "unknown", (unsure, structure[1])
    if not sure:
        return "none", structure
    return ("one_of" if any(found.alternatives for found in sure) else "named"), structure


def why_loose(effects: Sequence[Finding], loose: Sequence[Finding]) -> str:
    """What is wrong with the names that do not hold."""
    if not asked(effects):
        return UNASKED
    if any(not found.extends for found in loose):
        return WORSE_OUTSIDE
    refused = sum(found.size for found in loose if found.established)
    return UNHELPFUL if refused > HALF * sum(found.size for found in loose) else UNSURE
