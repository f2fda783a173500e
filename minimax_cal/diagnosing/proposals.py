"""The measurement to make next: it shows the noise, settles a name, or asks of what remains."""

from __future__ import annotations

from collections.abc import Sequence

from minimax_cal.diagnosing.result import Alternative, Explained, Finding, Proposal
from minimax_cal.diagnosing.sentences import names_of
from minimax_cal.evidence.remains import FOLLOWING
from minimax_cal.modelling.effects.words import name_structure
from minimax_cal.solvers.status import Status

REVISIT = Proposal(
    "revisit", "visit 10 poses twice", "whether the remaining error is the arm's repeatability"
)
ASKING = (  # of what errors follow: words of the driver, kind and text of what would tell more
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
MORE = ASKING[-1]
CHECK = Proposal(
    "check",
    "measure 10 poses again, with robot file, joint signs, zero positions and units checked",
    "whether these are measurements of this arm",
)
AGAIN = Proposal(
    "repeat",
    "visit one pose 30 times in a row, half of them approached from its other side",
    "whether it scatters by itself, or with the way there",
)


def proposal(found: Explained, floor_known: bool) -> Proposal | None:
    """What to measure next; None where nothing is open."""
    if found.status is Status.FAILED:
        return CHECK
    if not floor_known:
        return REVISIT
    if found.verdict == "not_repeatable":
        return AGAIN
    settled = separating([one for one in found.by_rung if one.established])
    if settled or found.verdict != "unknown":
        return settled
    driver = found.structure_in.partition(FOLLOWING)[2]
    asked = (one for one in ASKING if any(word in driver for word in one[0]))
    _, kind, text = next(asked, MORE)
    what = f"what causes {name_structure(found.structure_in)}" if driver else "which causes hold"
    return Proposal(kind, text, what)


def separating(causes: Sequence[Finding]) -> Proposal | None:
    """The one measurement that settles most of the gap; None where none would.

    That is causes by their share, and of equal ones the most alternatives.
    """
    by_text: dict[str, list[tuple[Finding, Alternative]]] = {}
    for finding in causes:
        for other in finding.alternatives:
            if other.helps:
                by_text.setdefault(other.separate_with, []).append((finding, other))
    if not by_text:
        return None

    def settled(pairs: Sequence[tuple[Finding, Alternative]]) -> tuple[float, int]:
        shares = {f.term.key: f.share for f, _ in pairs if f.share > 0.0}
        return sum(shares.values()), len(pairs)

    text, pairs = max(by_text.items(), key=lambda entry: settled(entry[1]))
    named = names_of(list({f.name: f for f, _ in pairs}.values()), " and ")
    others = names_of(list({a.name: a for _, a in pairs}.values()), " and ")
    return Proposal("separate", text, f"whether {named} is rather {others}")
