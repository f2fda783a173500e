"""A diagnosis in words: the verdict first, each number one that stands in the JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence

from minimax_cal.diagnosing.last_question import ABOVE_NOISE, ONLY_MINOR
from minimax_cal.diagnosing.result import Alternative, Diagnosis, Finding, in_words
from minimax_cal.evidence.limits import STRUCTURE
from minimax_cal.measuring.floor import REPEATS
from minimax_cal.solvers.status import Status

NOTHING_MM = 5e-4  # of a length that is told to three digits
SMALL = 0.05  # share of the gap below which a cause is told with its like, in one line
REVISIT = "Next measurement: visit 10 poses twice, to know the measurement noise."
NO_CHANCE = f"below {STRUCTURE:g} is no accident"
CONTRADICTED = (
    "Verdict: unknown. The best fit contradicts the measurements: this is no calibration of this "
    "arm, and no cause is to be read from it."
)
VERDICTS = {  # what stands first
    "none": "Verdict: none. Nothing beyond geometry and noise is established.",
    "named": "Verdict: named, and no rival explains the errors as well.",
    "one_of": "Verdict: one of several: these data leave more than one name for a cause.",
    "unknown": "Verdict: unknown.",
    "not_repeatable": "Verdict: not repeatable. The arm does not return to the same place when a "
    "pose is repeated, and no known effect of time, load or approach explains it.",
}


def reasons(found: Diagnosis) -> tuple[str, ...]:
    """Verdict, established causes, share, remainder, next measurement; then what is tentative.

    Nothing but the verdict of a diagnosis that failed.
    """
    if found.status is Status.FAILED:
        return (CONTRADICTED,)
    causes = [f for f in found.by_rung if f.established]
    tentative = [f for f in found.by_rung if not f.established]
    large = [f for f in causes if not f.share < SMALL] or causes[:1]
    small = [f for f in causes if f not in large]
    return tuple(
        sentence
        for sentence in (
            verdict(found, causes),
            listed("Cause", large, rivals=True),
            listed(f"Small, each below {100 * SMALL:.0f} % of the gap", small),
            shrunk(found),
            remaining(found),
            away(found),
            proposal(found),
            listed("Tentative, and no cause yet", tentative),
        )
        if sentence
    )


# ---- the sentences -----------------------------------------------------------------------------


def verdict(found: Diagnosis, causes: Sequence[Finding]) -> str:
    """The verdict, and of an unknown one why."""
    text = VERDICTS[found.verdict]
    if found.verdict != "unknown":
        return text
    carrying = [f for f in causes if not f.share < SMALL]
    if carrying:
        names = ", ".join(f"{f.term.effect} {f.at}" for f in carrying)
        text = f"Verdict: unknown beside {names}."
    if found.structure_in in (ABOVE_NOISE, ONLY_MINOR):
        said = found.structure_in[:1].upper() + found.structure_in[1:]
        joints = "" if found.floor.source == REPEATS else ", and what sound joints add"
        return (
            f"{text} {said}: {found.ladder[-1].trusted.rms_mm:.3f} mm against "
            f"{found.floor.high:.3f} mm at most ({found.floor.source}{joints})."
        )
    what = "the causes below leave" if causes else "geometry leaves"
    guess = "these names are a best guess" if causes else "the cause is unknown"
    if not found.structure < STRUCTURE:  # it is the names that do not hold
        return f"{text} {found.structure_in[:1].upper()}{found.structure_in[1:]}: {guess}."
    return (
        f"{text} What {what} is not noise ({found.structure_in}: by chance {found.structure:.1g}, "
        f"{NO_CHANCE}), and no known effect explains it: {guess}."
    )


def listed(title: str, findings: Sequence[Finding], *, rivals: bool = False) -> str:
    """Effects in the order of the ladder, those of one kind together; with their rivals."""
    kinds: dict[str, list[Finding]] = {}
    for finding in findings:
        kinds.setdefault(finding.term.effect, []).append(finding)
    parts = []
    for effect, same in kinds.items():
        why = f" ({same[0].cause})" if rivals else ""
        parts.append(f"{effect} {together([f.at for f in same])}{why}{lines_of(same[0])}")
        for finding in same if rivals else ():
            others = {f"{a.effect} {a.at}" for a in finding.alternatives}
            where = f" {finding.at}" if len(same) > 1 else ""
            if others:
                parts[-1] += f",{where} or else {' or '.join(sorted(others))}"
    many = "s" if title == "Cause" and len(findings) > 1 else ""
    return f"{title}{many}: {'; '.join(parts)}." if parts else ""


def together(places: Sequence[str]) -> str:
    """Several places in a few words, as at joint 2, 1 and 3."""
    kinds = [place.rpartition(" ")[0] for place in places]
    if len(places) > 1 and len(set(kinds)) == 1:
        numbers = [place.rpartition(" ")[2] for place in places]
        return f"{kinds[0]} {', '.join(numbers[:-1])} and {numbers[-1]}"
    return ", ".join(places)


def lines_of(finding: Finding) -> str:
    """Of joints that were read back: how much of the rest it explains."""
    share = dict(zip(finding.names, finding.values, strict=True)).get("explained", math.nan)
    if math.isfinite(finding.before) or not math.isfinite(share):
        return ""
    return f", with {100.0 * share:.0f} % of the rest along the last moves"


def shrunk(found: Diagnosis) -> str:
    """How far the error falls on poses that no fit has seen."""
    nominal, geometric, last = (found.ladder[i].holdout for i in (0, 1, -1))
    text = (
        f"RMS error on poses that no fit has seen: nominal robot {nominal.rms_mm:.3f} mm, "
        f"calibrated geometry {geometric.rms_mm:.3f} mm (largest {geometric.max_mm:.3f} mm)"
    )
    if len(found.ladder) < 3:
        return f"{text}."
    text += f", whole model {last.rms_mm:.3f} mm (largest {last.max_mm:.3f} mm{without_far(found)})"
    return f"{text}; {closed_words(found)}." if math.isfinite(found.closed) else f"{text}."


def closed_words(found: Diagnosis) -> str:
    """How much of the gap to the noise is closed, for people, and how sure that is."""
    low, high = (100.0 * end for end in found.closed_ci)
    ends = f" (95 % interval {low:.0f} to {high:.0f} %)" if found.has_interval else ""
    share = f"{100.0 * found.closed:.0f} %"
    if not (found.floor.certain or share == "100 %"):  # told as if noise alone left nothing
        share = f"at least {share}"
    return f"{share} of the gap to the noise is closed{ends}"


def without_far(found: Diagnosis) -> str:
    """What the whole model does where no held-out point stands out; empty where none does."""
    every, sound = found.ladder[-1].holdout, found.ladder[-1].trusted
    count = sum(every.counts) - sum(sound.counts)
    points = "the point that stands" if count == 1 else f"{count} points that stand"
    return f"; {sound.rms_mm:.3f} mm without {points} out" if count and sum(sound.counts) else ""


def remaining(found: Diagnosis) -> str:
    """What is left: what could be predicted, what could not, what noise alone would leave."""
    floor = found.floor
    noise = (
        f"{floor.value:.3f} mm ({floor.source})"
        if floor.certain
        else f"at most {floor.value:.3f} mm, the noise of the fit"
    )
    left = found.remainder
    if left is None:
        return f"Noise alone would leave {noise}."
    if left.predictable_mm < NOTHING_MM:
        return f"Nothing tells poses left out what remains; noise alone would leave {noise}."
    where = ", ".join(f"{in_words(place)} {100.0 * share:.0f} %" for place, share in left.where[:3])
    told = f" ({where})" if where else ""
    return (
        f"Of what remains at poses left out, {left.predictable_mm:.3f} mm follow the pose{told}, "
        f"{left.unpredictable_mm:.3f} mm follow nothing known; noise alone would leave {noise}."
    )


def away(found: Diagnosis) -> str:
    """How the model does on whole parts that were left out."""
    beyond = found.beyond
    text = beyond.sentence()
    if beyond.worst and beyond.typical_mm > beyond.geometric_typical_mm:
        text = text.removesuffix(".") + (
            f"; geometry alone does better beyond them ({beyond.geometric_typical_mm:.3f} mm), so "
            "that the effects do not carry over to places that were not measured."
        )
    return text


def proposal(found: Diagnosis) -> str:
    """The one measurement to make next: what settles causes, else what tells the noise."""
    settles = next_measurement([f for f in found.by_rung if f.established])
    return settles or ("" if found.floor.certain else REVISIT)


def next_measurement(causes: Sequence[Finding]) -> str:
    """The one measurement that settles most of the gap; empty where none would.

    That is causes by their share, and of equal ones the most rivals.
    """
    by_text: dict[str, list[tuple[Finding, Alternative]]] = {}
    for finding in causes:
        for other in finding.alternatives:
            if other.helps:
                by_text.setdefault(other.separate_with, []).append((finding, other))
    if not by_text:
        return ""

    def settled(pairs: Sequence[tuple[Finding, Alternative]]) -> tuple[float, int]:
        told = {f.term.key: f.share for f, _ in pairs if f.share > 0.0}
        return sum(told.values()), len(pairs)

    text, pairs = max(by_text.items(), key=lambda entry: settled(entry[1]))
    named = " and ".join(dict.fromkeys(f"{f.term.effect} {f.at}" for f, _ in pairs))
    others = " and ".join(dict.fromkeys(f"{a.effect} {a.at}" for _, a in pairs))
    return f"Next measurement: {text}, to tell {named} from {others}."
