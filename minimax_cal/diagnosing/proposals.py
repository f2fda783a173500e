"""The measurement to make next: it shows the noise, settles a name, or asks of what remains."""

from __future__ import annotations

from collections.abc import Sequence

from minimax_cal.diagnosing.diagnosis import (
    AlternativeEffect,
    Explanation,
    Finding,
    MeasurementProposal,
)
from minimax_cal.diagnosing.diagnosis_sentences import format_effect_names
from minimax_cal.modelling.effects.effect_names import format_remaining_structure
from minimax_cal.selection.remaining_structure import PLACE_DRIVER_SEPARATOR
from minimax_cal.solvers.status import Status

REVISIT_PROPOSAL = MeasurementProposal(
    "revisit", "visit 10 poses twice", "whether the remaining error is the arm's repeatability"
)
# of what errors follow: words of the driver, kind and text of what would tell more
PROPOSALS_BY_DRIVER = (
    (
        ("move", "its past", "previous"),
        "approach",
        "visit 10 poses again, each approached from its other side",
    ),
    (("load",), "payload", "measure 20 of these poses again with another payload"),
    (("time",), "late", "measure the first 10 poses again at the end"),
    (("temperature",), "warm", "measure 10 poses with the arm cold, and again warm"),
    (("where it is",), "instrument", "measure 20 poses again with the instrument elsewhere"),
    (("angle", "attitude", "joints"), "more", "measure 40 more poses all over the workspace"),
)
MORE_POSES_PROPOSAL = PROPOSALS_BY_DRIVER[-1]
CHECK_PROPOSAL = MeasurementProposal(
    "check",
    "measure 10 poses again, with robot file, joint signs, zero positions and units checked",
    "whether these are measurements of this arm",
)
REPEAT_PROPOSAL = MeasurementProposal(
    "repeat",
    "visit one pose 30 times in a row, half of them approached from its other side",
    "whether it scatters by itself, or with the way there",
)


def propose_next_measurement(
    diagnosis: Explanation, floor_known: bool
) -> MeasurementProposal | None:
    """What to measure next; None where nothing is open."""
    if diagnosis.status is Status.FAILED:
        return CHECK_PROPOSAL
    if not floor_known:
        return REVISIT_PROPOSAL
    if diagnosis.verdict == "not_repeatable":
        return REPEAT_PROPOSAL
    settled = find_separating_proposal(
        [one for one in diagnosis.findings_in_step_order if one.established]
    )
    if settled or diagnosis.verdict != "unknown":
        return settled
    driver = diagnosis.structure_in.partition(PLACE_DRIVER_SEPARATOR)[2]
    asked = (one for one in PROPOSALS_BY_DRIVER if any(word in driver for word in one[0]))
    _, kind, text = next(asked, MORE_POSES_PROPOSAL)
    what = (
        f"what causes {format_remaining_structure(diagnosis.structure_in)}"
        if driver
        else "which causes hold"
    )
    return MeasurementProposal(kind, text, what)


def find_separating_proposal(causes: Sequence[Finding]) -> MeasurementProposal | None:
    """The one measurement that settles most of the gap; None where none would.

    That is causes by their share, and of equal ones the most alternatives.
    """
    by_text: dict[str, list[tuple[Finding, AlternativeEffect]]] = {}
    for finding in causes:
        for other in finding.alternatives:
            if other.has_helpful_measurement:
                by_text.setdefault(other.separate_with, []).append((finding, other))
    if not by_text:
        return None

    def settled(pairs: Sequence[tuple[Finding, AlternativeEffect]]) -> tuple[float, int]:
        shares = {f.term.key: f.share for f, _ in pairs if f.share > 0.0}
        return sum(shares.values()), len(pairs)

    text, pairs = max(by_text.items(), key=lambda entry: settled(entry[1]))
    named = format_effect_names(list({f.name: f for f, _ in pairs}.values()), " and ")
    others = format_effect_names(list({a.name: a for _, a in pairs}.values()), " and ")
    return MeasurementProposal("separate", text, f"whether {named} is rather {others}")
