"""A diagnosis in words: the main cause first; each number is in the JSON, too."""

from __future__ import annotations

import math
from collections.abc import Sequence

from minimax_cal.diagnosing.result import (
    Alternative,
    Diagnosis,
    Explained,
    Finding,
)
from minimax_cal.diagnosing.verdict import ABOVE_NOISE, ONLY_MINOR
from minimax_cal.evidence.limits import HALF, STRUCTURE
from minimax_cal.fitting.floor import REPEATS
from minimax_cal.modelling.effects.words import name_chance, name_step, name_structure
from minimax_cal.solvers.status import Status

Named = Finding | Alternative
NOTHING_MM = 5e-4  # of a length that is reported to three digits
MAX_NAMED_MINOR = 2  # more minor effects than this are counted, not listed
NOT_VISITED = "it is not known how much of the rest is the arm's repeatability"
FOUND_WITHOUT = ", by effects found without them too (a cautious figure)"
SCATTERS = "Visits to one pose scatter more than the instrument and sound joints do."
CONTRADICTED = (
    "Unexplained: the best fit contradicts the measurements. It is no calibration of this arm, and "
    "says nothing about causes."
)
ONLY_SMALL = "No cause beyond geometry was found that matters."
OPENINGS = {  # by the JSON's verdict
    "none": "No cause beyond geometry was found.",
    "named": "Main cause",
    "one_of": "Ambiguous cause",
    "unknown": "Unexplained",
    "not_repeatable": "Not repeatable: the arm does not return to the same place when a pose is "
    "repeated, and no known effect of time, load or approach explains it.",
}


def reasons(found: Diagnosis) -> tuple[str, ...]:
    """Main causes with their share, minor ones, errors, remaining error, next measurement.

    Only one sentence where the fit failed.
    """
    if found.status is Status.FAILED:
        return (CONTRADICTED,)
    following = found.next
    first, *others = (
        sentence
        for sentence in (
            *causes_first(found),
            minor(found),
            shrunk(found),
            remaining(found),
            SCATTERS if not (found.repeatable or found.verdict == "not_repeatable") else "",
            away(found),
            f"Recommended: {following.text}, to know {following.settles}." if following else "",
            possible([f for f in found.by_rung if not f.established]),
        )
        if sentence
    )
    left = found.remaining
    is_open = not found.floor_known and (left is None or left.unexplained_mm >= NOTHING_MM)
    known = f"; {NOT_VISITED}." if is_open else "."
    return (f"{first.removesuffix('.')}{known}", *others)


def explained(found: Explained) -> tuple[str, ...]:
    """Main causes with their share, and minor and possible ones, of whatever instruments."""
    if found.status is Status.FAILED:
        return (CONTRADICTED,)
    loose = possible([f for f in found.by_rung if not f.established])
    return tuple(filter(None, [*causes_first(found), minor(found), loose]))


def causes_first(found: Explained) -> tuple[str, ...]:
    """What comes first: the causes, or that the most is unexplained."""
    verdict, main, partial = found.verdict, found.main, is_partial(found)
    ambiguous = verdict == "one_of" and bool(main and main[0].alternatives)
    title = OPENINGS["one_of" if ambiguous else "named"]
    if verdict == "none":
        title = "Minor cause"
    elif verdict == "unknown" and partial:
        title = "Partial cause"
    title += "s" if len(main) > 1 else ""

    opening = OPENINGS[verdict]
    if verdict in ("named", "one_of") and main:
        opening = ""  # the causes say it all
    elif verdict == "none" and main:
        opening = ONLY_SMALL
    elif verdict == "unknown":
        opening = f"{opening}: {unexplained(found)}"
    causes = (listed(title, main, found.shares_of), subsampled(main))
    return (opening, *causes) if partial else (*causes, opening)


# ---- the sentences -----------------------------------------------------------------------------


def is_partial(found: Explained) -> bool:
    """Whether the confirmed causes leave most of the error unexplained."""
    return sum(f.share for f in found.main if f.share > 0.0) < HALF


def unexplained(found: Explained) -> str:
    """What is not explained, and how that is known."""
    left = name_structure(found.structure_in)
    if left in (ABOVE_NOISE, ONLY_MINOR):
        return f"{left}, {found.excess}."
    sure = any(f.established and not f.rows for f in found.effects)
    if not found.structure < STRUCTURE:  # it is the causes that are not certain
        return f"{left}: {'these causes are uncertain' if sure else 'the cause is unknown'}."
    after = "after all effects" if sure else "after geometry"
    guess = " An effect that the library lacks may contribute to the causes above." if sure else ""
    return (
        f"the error {after} is not random ({left}; p {name_chance(found.structure)}), and no "
        f"confirmed effect explains it.{guess}"
    )


def listed(title: str, findings: Sequence[Finding], of: str) -> str:
    """Causes with their share of something, the largest first, those of one kind together."""
    kinds: dict[str, list[Finding]] = {}
    for finding in findings:
        kinds.setdefault(finding.term.effect, []).append(finding)
    parts = []
    for i, same in enumerate(kinds.values()):
        # Where, of the first kind also what it is, its alternatives, its share.
        text = f"{named_together(same)}{'' if i else f' ({same[0].cause})'}"
        amounts = dict(zip(same[0].names, same[0].values, strict=True))
        part = amounts.get("explained", math.nan)  # of joints that were read back
        if math.isfinite(part) and not math.isfinite(same[0].before):
            text += f", with {100.0 * part:.0f} % of the remaining error along the last moves"
        which = {id(f): f" (for {f.at.removeprefix('at ')})" * (len(same) > 1) for f in same}
        others = sorted({f"{a.name}{which[id(f)]}" for f in same for a in f.alternatives})
        text += f", or {' or '.join(others)}" if others else ""
        shares = [f"{100.0 * f.share:.0f} %" for f in same if f.share > 0.0]
        parts.append(", ".join([text, " and ".join(shares)]) if shares else text)
    share = f" of the squared error {of}" if any("%" in part for part in parts) else ""
    return f"{title}: {'; '.join(parts)}{share}." if parts else ""


def subsampled(findings: Sequence[Finding]) -> str:
    """How often the causes are found again; empty where that was not asked."""
    often = min((f.again for f in findings if not f.rows), default=math.nan)
    if not math.isfinite(often):
        return ""
    each = "Each was found" if len(findings) > 1 else "Found"
    least = "at least " if len(findings) > 1 and often < 1.0 else ""
    loose = [f for f in findings if f.alternatives]
    sure = "one of them is confirmed" if loose == list(findings) else "confirmed"
    if loose and loose != list(findings):
        sure = f"confirmed, but {names_of(loose, ' and ')} is not distinguished from others"
    return f"{each} again in {least}{100.0 * often:.0f} % of the subsamples of the poses: {sure}."


def names_of(found: Sequence[Named], between: str = "; ") -> str:
    """Effects with their places, those of one kind together."""
    kinds: dict[str, list[Named]] = {}
    for one in found:
        kinds.setdefault(one.name.removesuffix(one.at), []).append(one)
    return between.join(map(named_together, kinds.values()))


def named_together(same: Sequence[Named]) -> str:
    """Findings of one effect, as joint compliance at joint 2 and 3."""
    first = same[0]
    if len(same) == 1:
        return first.name
    return f"{first.name.removesuffix(first.at)}{together([f.at for f in same])}"


def minor(found: Explained) -> str:
    """The minor effects in one line, and what they take off the error."""
    small = found.minor
    if not small:
        return ""
    names = f" ({names_of(small)})" if len(small) <= MAX_NAMED_MINOR else ""
    many = f"{names} takes" if len(small) == 1 else f"s{names} together take"
    return f"{len(small)} minor effect{many} {found.minor_sizes[1]:.3f} mm off the RMS error."


def possible(findings: Sequence[Finding]) -> str:
    """The causes that are not confirmed, and what they take off the error."""
    if not findings:
        return ""
    gain = sum(f.before - f.after for f in findings if math.isfinite(f.before - f.after))
    return f"Possible causes, not confirmed: {names_of(findings)}; {gain:.3f} mm off the RMS error."


def together(places: Sequence[str]) -> str:
    """Several places in a few words, as at joint 2, 1 and 3."""
    kinds = [place.rpartition(" ")[0] for place in places]
    if len(places) > 1 and len(set(kinds)) == 1:
        numbers = [place.rpartition(" ")[2] for place in places]
        return f"{kinds[0]} {', '.join(numbers[:-1])} and {numbers[-1]}"
    return ", ".join(places)


def shrunk(found: Diagnosis) -> str:
    """How far the error falls on held-out poses."""
    nominal, geometric, last = (found.ladder[i].holdout for i in (0, 1, -1))
    text = (
        f"RMS error on held-out poses: nominal arm {nominal.rms_mm:.3f} mm, geometry calibrated by "
        f"least squares {geometric.rms_mm:.3f} mm (largest {geometric.max_mm:.3f} mm)"
    )
    if len(found.ladder) < 3:
        return f"{text}."
    sound = found.ladder[-1].trusted
    count = sum(last.counts) - sum(sound.counts)
    far = f"largest {last.max_mm:.3f} mm"
    if count and sum(sound.counts):
        points = "1 outlier" if count == 1 else f"{count} outliers"
        far += f"; {sound.rms_mm:.3f} mm without {points}"
    name = found.ladder[-1].name
    what = "all confirmed effects" if name.startswith("+ ") else name_step(name)
    text += f", {what} {last.rms_mm:.3f} mm ({far})"
    return f"{text}; {closed_words(found)}." if math.isfinite(found.closed) else f"{text}."


def closed_words(found: Diagnosis) -> str:
    """How much of the error is explained, and how sure that is."""
    low, high = (100.0 * end for end in found.closed_ci)
    ends = f" (95 % interval {low:.0f} to {high:.0f} %)" if found.has_interval else ""
    share = f"{100.0 * found.closed:.0f} %"
    if not (found.floor.certain or share == "100 %"):  # reported as if noise were zero
        share = f"at least {share}"
    return f"{share} of the squared error {found.shares_of} is explained{ends}"


def remaining(found: Diagnosis) -> str:
    """The remaining error: what is noise, what depends on something, and what nothing explains."""
    left = found.remaining
    if left is None:
        return ""
    own = "measurement noise" if left.noise_from == REPEATS else "the instrument's noise"
    noise = f"{left.noise_mm:.3f} mm is {own} ({left.noise_from})"
    parts = [noise if math.isfinite(left.noise_mm) else "its noise is not known"]
    parts += [
        f"{one.rms_mm:.3f} mm is {name_structure(one.name)} (p {name_chance(one.p)})"
        for one in left.depends[:1]
    ] or ["no dependence was found"]
    within = found.floor_known and found.meets_floor  # the noise is no surer than that
    if left.unexplained_mm >= NOTHING_MM and not within:
        what = "is unexplained" if found.floor_known else "may be the arm's repeatability"
        parts.append(f"{left.unexplained_mm:.3f} mm {what}")
    return f"Remaining error {found.ladder[-1].trusted.rms_mm:.3f} mm RMS: {', '.join(parts)}."


def away(found: Diagnosis) -> str:
    """How the model does on whole parts that were held out."""
    again = any(f.established and not f.rows for f in found.effects)
    text = found.beyond.sentence(FOUND_WITHOUT if again else "")
    if not math.isfinite(found.refused):
        return text
    return text.removesuffix(".") + (
        f"; with the effects {found.refused:.3f} mm: they do not extrapolate, and none is "
        "recommended."
    )
