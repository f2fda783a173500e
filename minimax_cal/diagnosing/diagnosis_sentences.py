"""A diagnosis in words: the main cause first; each number is in the JSON, too."""

from __future__ import annotations

import math
from collections.abc import Sequence

from minimax_cal.diagnosing.diagnosis import (
    AlternativeEffect,
    Diagnosis,
    Explanation,
    Finding,
)
from minimax_cal.diagnosing.verdict import ABOVE_NOISE_TEXT, ONLY_MINOR_TEXT
from minimax_cal.fitting.noise_floor import REPEATS
from minimax_cal.modelling.effects.effect_names import (
    format_budget_step,
    format_p_value,
    format_remaining_structure,
)
from minimax_cal.selection.thresholds import MAIN_PART_FRACTION, REMAINING_STRUCTURE_P_VALUE
from minimax_cal.solvers.status import Status

NamedEffect = Finding | AlternativeEffect
MIN_REPORTED_MM = 5e-4  # of a length that is reported to three digits
MAX_NAMED_MINOR = 2  # more minor effects than this are counted, not listed
UNKNOWN_REPEATABILITY_TEXT = "it is not known how much of the rest is the arm's repeatability"
FOUND_IN_FOLDS_TEXT = ", by effects found without them too (a cautious figure)"
SCATTER_SENTENCE = "Visits to one pose scatter more than the instrument and sound joints do."
CONTRADICTION_SENTENCE = (
    "Unexplained: the best fit contradicts the measurements. It is no calibration of this arm, and "
    "says nothing about causes."
)
ONLY_SMALL_CAUSES_SENTENCE = "No cause beyond geometry was found that matters."
VERDICT_OPENINGS = {  # by the JSON's verdict
    "none": "No cause beyond geometry was found.",
    "named": "Main cause",
    "one_of": "Ambiguous cause",
    "unknown": "Unexplained",
    "not_repeatable": "Not repeatable: the arm does not return to the same place when a pose is "
    "repeated, and no known effect of time, load or approach explains it.",
}


def describe_diagnosis(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Main causes with their share, minor ones, errors, remaining error, next measurement.

    Only one sentence where the fit failed.
    """
    if diagnosis.status is Status.FAILED:
        return (CONTRADICTION_SENTENCE,)
    following = diagnosis.next
    first, *others = (
        sentence
        for sentence in (
            *describe_main_causes(diagnosis),
            describe_minor_effects(diagnosis),
            describe_error_reduction(diagnosis),
            describe_remaining_error(diagnosis),
            SCATTER_SENTENCE
            if not (diagnosis.repeatable or diagnosis.verdict == "not_repeatable")
            else "",
            describe_extrapolation(diagnosis),
            f"Recommended: {following.text}, to know {following.settles}." if following else "",
            describe_possible_effects(
                [f for f in diagnosis.findings_in_step_order if not f.established]
            ),
        )
        if sentence
    )
    left = diagnosis.remaining
    is_open = not diagnosis.floor_known and (left is None or left.unexplained_mm >= MIN_REPORTED_MM)
    known = f"; {UNKNOWN_REPEATABILITY_TEXT}." if is_open else "."
    return (f"{first.removesuffix('.')}{known}", *others)


def describe_explanation(explanation: Explanation) -> tuple[str, ...]:
    """Main causes with their share, and minor and possible ones, of whatever instruments."""
    if explanation.status is Status.FAILED:
        return (CONTRADICTION_SENTENCE,)
    loose = describe_possible_effects(
        [f for f in explanation.findings_in_step_order if not f.established]
    )
    return tuple(
        filter(
            None, [*describe_main_causes(explanation), describe_minor_effects(explanation), loose]
        )
    )


def describe_main_causes(explanation: Explanation) -> tuple[str, ...]:
    """What comes first: the causes, or that the most is unexplained."""
    verdict, main, partial = (
        explanation.verdict,
        explanation.main_findings,
        is_mostly_unexplained(explanation),
    )
    ambiguous = verdict == "one_of" and bool(main and main[0].alternatives)
    title = VERDICT_OPENINGS["one_of" if ambiguous else "named"]
    if verdict == "none":
        title = "Minor cause"
    elif verdict == "unknown" and partial:
        title = "Partial cause"
    title += "s" if len(main) > 1 else ""

    opening = VERDICT_OPENINGS[verdict]
    if verdict in ("named", "one_of") and main:
        opening = ""  # the causes say it all
    elif verdict == "none" and main:
        opening = ONLY_SMALL_CAUSES_SENTENCE
    elif verdict == "unknown":
        opening = f"{opening}: {describe_unexplained_error(explanation)}"
    causes = (
        describe_causes(title, main, explanation.describe_share_reference),
        describe_frequencies(main),
    )
    return (opening, *causes) if partial else (*causes, opening)


# ---- the sentences -----------------------------------------------------------------------------


def is_mostly_unexplained(explanation: Explanation) -> bool:
    """Whether the confirmed causes leave most of the error unexplained."""
    return sum(f.share for f in explanation.main_findings if f.share > 0.0) < MAIN_PART_FRACTION


def describe_unexplained_error(explanation: Explanation) -> str:
    """What is not explained, and how that is known."""
    left = format_remaining_structure(explanation.structure_in)
    if left in (ABOVE_NOISE_TEXT, ONLY_MINOR_TEXT):
        return f"{left}, {explanation.describe_excess}."
    sure = any(f.established and not f.rows for f in explanation.effects)
    if (
        not explanation.structure < REMAINING_STRUCTURE_P_VALUE
    ):  # it is the causes that are not certain
        return f"{left}: {'these causes are uncertain' if sure else 'the cause is unknown'}."
    after = "after all effects" if sure else "after geometry"
    guess = " An effect that the library lacks may contribute to the causes above." if sure else ""
    return (
        f"the error {after} is not random ({left}; p "
        f"{format_p_value(explanation.structure)}), and no "
        f"confirmed effect explains it.{guess}"
    )


def describe_causes(title: str, findings: Sequence[Finding], share_reference: str) -> str:
    """Causes with their share of something, the largest first, those of one kind together."""
    kinds: dict[str, list[Finding]] = {}
    for finding in findings:
        kinds.setdefault(finding.term.effect, []).append(finding)
    parts = []
    for i, same in enumerate(kinds.values()):
        # Where, of the first kind also what it is, its alternatives, its share.
        text = f"{format_effects_of_one_kind(same)}{'' if i else f' ({same[0].cause})'}"
        amounts = dict(zip(same[0].names, same[0].values, strict=True))
        part = amounts.get("explained", math.nan)  # of joints that were read back
        if math.isfinite(part) and not math.isfinite(same[0].before):
            text += f", with {100.0 * part:.0f} % of the remaining error along the last moves"
        which = {
            id(f): f" (for {f.place_text.removeprefix('at ')})" * (len(same) > 1) for f in same
        }
        others = sorted({f"{a.name}{which[id(f)]}" for f in same for a in f.alternatives})
        text += f", or {' or '.join(others)}" if others else ""
        shares = [f"{100.0 * f.share:.0f} %" for f in same if f.share > 0.0]
        parts.append(", ".join([text, " and ".join(shares)]) if shares else text)
    share = f" of the squared error {share_reference}" if any("%" in part for part in parts) else ""
    return f"{title}: {'; '.join(parts)}{share}." if parts else ""


def describe_frequencies(findings: Sequence[Finding]) -> str:
    """How often the causes are found again; empty where that was not asked."""
    often = min((f.again for f in findings if not f.rows), default=math.nan)
    if not math.isfinite(often):
        return ""
    each = "Each was found" if len(findings) > 1 else "Found"
    least = "at least " if len(findings) > 1 and often < 1.0 else ""
    loose = [f for f in findings if f.alternatives]
    sure = "one of them is confirmed" if loose == list(findings) else "confirmed"
    if loose and loose != list(findings):
        sure = (
            f"confirmed, but {format_effect_names(loose, ' and ')} is not distinguished from others"
        )
    return f"{each} again in {least}{100.0 * often:.0f} % of the subsamples of the poses: {sure}."


def format_effect_names(effects: Sequence[NamedEffect], separator: str = "; ") -> str:
    """Effects with their places, those of one kind together."""
    kinds: dict[str, list[NamedEffect]] = {}
    for one in effects:
        kinds.setdefault(one.name.removesuffix(one.place_text), []).append(one)
    return separator.join(map(format_effects_of_one_kind, kinds.values()))


def format_effects_of_one_kind(effects: Sequence[NamedEffect]) -> str:
    """Findings of one effect, as joint compliance at joint 2 and 3."""
    first = effects[0]
    if len(effects) == 1:
        return first.name
    return (
        f"{first.name.removesuffix(first.place_text)}{join_places([f.place_text for f in effects])}"
    )


def describe_minor_effects(explanation: Explanation) -> str:
    """The minor effects in one line, and what they take off the error."""
    small = explanation.minor_findings
    if not small:
        return ""
    names = f" ({format_effect_names(small)})" if len(small) <= MAX_NAMED_MINOR else ""
    many = f"{names} takes" if len(small) == 1 else f"s{names} together take"
    return (
        f"{len(small)} minor effect{many} "
        f"{explanation.minor_effect_sizes[1]:.3f} mm off the RMS error."
    )


def describe_possible_effects(findings: Sequence[Finding]) -> str:
    """The causes that are not confirmed, and what they take off the error."""
    if not findings:
        return ""
    gain = sum(f.before - f.after for f in findings if math.isfinite(f.before - f.after))
    return (
        f"Possible causes, not confirmed: {format_effect_names(findings)}"
        f"; {gain:.3f} mm off the RMS error."
    )


def join_places(place_texts: Sequence[str]) -> str:
    """Several places in a few words, as at joint 2, 1 and 3."""
    kinds = [place.rpartition(" ")[0] for place in place_texts]
    if len(place_texts) > 1 and len(set(kinds)) == 1:
        numbers = [place.rpartition(" ")[2] for place in place_texts]
        return f"{kinds[0]} {', '.join(numbers[:-1])} and {numbers[-1]}"
    return ", ".join(place_texts)


def describe_error_reduction(diagnosis: Diagnosis) -> str:
    """How far the error falls on held-out poses."""
    nominal, geometric, last = (diagnosis.ladder[i].holdout for i in (0, 1, -1))
    text = (
        f"RMS error on held-out poses: nominal arm {nominal.rms_mm:.3f} mm, geometry calibrated by "
        f"least squares {geometric.rms_mm:.3f} mm (largest {geometric.max_mm:.3f} mm)"
    )
    if len(diagnosis.ladder) < 3:
        return f"{text}."
    sound = diagnosis.ladder[-1].trusted
    count = sum(last.counts) - sum(sound.counts)
    far = f"largest {last.max_mm:.3f} mm"
    if count and sum(sound.counts):
        points = "1 outlier" if count == 1 else f"{count} outliers"
        far += f"; {sound.rms_mm:.3f} mm without {points}"
    name = diagnosis.ladder[-1].name
    what = "all confirmed effects" if name.startswith("+ ") else format_budget_step(name)
    text += f", {what} {last.rms_mm:.3f} mm ({far})"
    return (
        f"{text}; {describe_explained_fraction(diagnosis)}."
        if math.isfinite(diagnosis.closed)
        else f"{text}."
    )


def describe_explained_fraction(diagnosis: Diagnosis) -> str:
    """How much of the error is explained, and how sure that is."""
    low, high = (100.0 * end for end in diagnosis.closed_ci)
    ends = f" (95 % interval {low:.0f} to {high:.0f} %)" if diagnosis.has_interval else ""
    share = f"{100.0 * diagnosis.closed:.0f} %"
    if not (diagnosis.floor.is_certain or share == "100 %"):  # reported as if noise were zero
        share = f"at least {share}"
    return f"{share} of the squared error {diagnosis.describe_share_reference} is explained{ends}"


def describe_remaining_error(diagnosis: Diagnosis) -> str:
    """The remaining error: what is noise, what depends on something, and what nothing explains."""
    left = diagnosis.remaining
    if left is None:
        return ""
    own = "measurement noise" if left.noise_from == REPEATS else "the instrument's noise"
    noise = f"{left.noise_mm:.3f} mm is {own} ({left.noise_from})"
    parts = [noise if math.isfinite(left.noise_mm) else "its noise is not known"]
    parts += [
        f"{one.rms_mm:.3f} mm is {format_remaining_structure(one.name)} (p {format_p_value(one.p)})"
        for one in left.depends[:1]
    ] or ["no dependence was found"]
    within = diagnosis.floor_known and diagnosis.meets_floor  # the noise is no surer than that
    if left.unexplained_mm >= MIN_REPORTED_MM and not within:
        what = "is unexplained" if diagnosis.floor_known else "may be the arm's repeatability"
        parts.append(f"{left.unexplained_mm:.3f} mm {what}")
    return f"Remaining error {diagnosis.ladder[-1].trusted.rms_mm:.3f} mm RMS: {', '.join(parts)}."


def describe_extrapolation(diagnosis: Diagnosis) -> str:
    """How the model does on whole parts that were held out."""
    again = any(f.established and not f.rows for f in diagnosis.effects)
    text = diagnosis.beyond.sentence(FOUND_IN_FOLDS_TEXT if again else "")
    if not math.isfinite(diagnosis.refused):
        return text
    return text.removesuffix(".") + (
        f"; with the effects {diagnosis.refused:.3f} mm: they do not extrapolate, and none is "
        "recommended."
    )
