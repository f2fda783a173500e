"""What contradicts itself within one diagnosis: its words, its numbers, its file."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

import minimax_cal as mc
from minimax_cal.diagnosing.diagnosis import Explanation
from minimax_cal.diagnosing.diagnosis_sentences import MIN_REPORTED_MM, UNKNOWN_REPEATABILITY_TEXT
from minimax_cal.diagnosing.verdict import ABOVE_NOISE_TEXT
from minimax_cal.dynamics.laws import USUAL_FRICTION_EFFECTS
from minimax_cal.dynamics.result import MOTION_VERDICT_SENTENCES
from minimax_cal.selection.thresholds import MIN_CONFIRMED_FREQUENCY, REMAINING_STRUCTURE_P_VALUE
from minimax_cal.solvers.status import Status

NEAR = 1e-9
NO_CAUSE = "No cause beyond geometry was found."


def same(one: float, other: float) -> bool:
    """Whether two numbers are one, or neither is there."""
    return bool(math.isclose(one, other, rel_tol=NEAR)) or (math.isnan(one) and math.isnan(other))


def contradictions(found: Explanation | mc.MotionDiagnosis) -> list[str]:
    """Every pair of statements of a diagnosis that cannot both be true."""
    if isinstance(found, mc.MotionDiagnosis):
        rules = list(of_torques(found))
    elif found.status is Status.FAILED:
        rules = [("a failed fit says more", bool(found.next) and not found.effects)]
    else:
        rules = list(of_causes(found))
        if isinstance(found, mc.Diagnosis):
            rules += [*of_budget(found), *of_rest(found)]
    return [name for name, holds in rules if not holds]


def of_causes(found: Explanation) -> Iterator[tuple[str, bool]]:
    """Causes: named once, by one verdict, as large as they are said to be."""
    text, main = " ".join(found.reasons), found.main_findings
    sure, loose = ([f for f in found.effects if f.established is such] for such in (True, False))
    keys = [(f.effect, f.place) for f in found.effects]
    yield "an effect stands twice", len(keys) == len(set(keys))
    yield (
        "an effect is found and not testable",
        not {e for e, _ in keys} & {one.effect for one in found.not_testable},
    )
    yield "no cause, and one", NO_CAUSE not in text or not sure
    yield "possible causes are told", ("Possible causes" in text) == bool(loose)
    yield "a name without a cause", found.verdict not in ("named", "one_of") or bool(sure)
    yield "one of several, of one", found.verdict != "one_of" or any(f.alternatives for f in sure)
    yield (
        "named, and one of several",
        found.verdict != "named" or not any(f.alternatives for f in main),
    )
    often = re.search(r"again in (?:at least )?(\d+) %", text)
    yield (
        "confirmed, and seldom found",
        not often or int(often[1]) >= 100 * MIN_CONFIRMED_FREQUENCY - 0.5,
    )
    yield "a share above all", all(not f.share > 1.0 for f in found.effects)
    yield "a main cause that is minor", all(not f.minor for f in main) or len(main) == 1
    yield (
        "unknown, and its p is large",
        ("is not random" not in text or found.structure < REMAINING_STRUCTURE_P_VALUE),
    )


def of_budget(found: mc.Diagnosis) -> Iterator[tuple[str, bool]]:
    """The budget: one arm, that is recommended, at one set of poses."""
    rows, last = found.budget, found.ladder[-1]
    sure = {f.term.budget_step_name for f in found.effects if f.established and not f.rows}
    steps = {row["name"] for row in rows[2:] if row["name"].startswith("+ ")}
    text = " ".join(found.reasons)
    yield "a step that is not confirmed", steps <= sure
    yield "a confirmed cause without a step", sure <= steps
    yield "two last errors", same(rows[-1]["rms_mm"], last.holdout.rms_mm)
    for words, value in (("nominal arm", rows[0]), ("least squares", rows[1])):
        told = re.search(rf"{words} ([\d.]+) mm", text)
        yield f"two errors of {words}", not told or told[1] == f"{value['rms_mm']:.3f}"
    outside = [row["outside_rms_mm"] for row in (rows[1], rows[-1])]
    yield "recommended, and worse outside", None in outside or outside[1] <= outside[0]
    low, high = found.closed_ci
    yield "a share outside its interval", not found.has_interval or low <= found.closed <= high
    yield "an interval upside down", not low > high
    errors = [row["max_mm"] >= row["rms_mm"] for row in rows]
    yield "a largest error below the RMS", all(errors)


def of_rest(found: mc.Diagnosis) -> Iterator[tuple[str, bool]]:
    """What remains: its parts, what it depends on, and what to do about it."""
    left, text, following = found.remaining, " ".join(found.reasons), found.next
    if left is None:
        yield "nothing is said of the rest", False
        return
    error, noise = found.ladder[-1].trusted.rms_mm, left.noise_mm
    parts = [left.dependent_mm, left.unexplained_mm, noise if math.isfinite(noise) else 0.0]
    yield "parts that do not add up", same(math.hypot(*parts), error)
    told = re.search(r"Remaining error ([\d.]+) mm", text)
    yield "two remaining errors", bool(told) and told[1] == f"{error:.3f}"
    yield "dependence, and none", ("no dependence was found" in text) != bool(left.depends)
    known = found.floor_known or left.unexplained_mm < MIN_REPORTED_MM
    yield (
        "an open floor in the first sentence",
        (UNKNOWN_REPEATABILITY_TEXT in found.reasons[0]) != known,
    )
    yield (
        "unexplained, and perhaps repeatability",
        not ("is unexplained" in text and "may be the arm's repeatability" in text),
    )
    unsure = found.verdict == "unknown" or not found.floor_known
    yield "unknown, and nothing to do", following is not None or not unsure
    yield "to do, and not told", following is None or following.text in text
    if found.structure_in == ABOVE_NOISE_TEXT and found.verdict == "unknown":
        low, high = found.tested
        yield "above noise that is as large", f"{low:.3f}" > f"{high:.3f}"
        yield "two noises", not noise > high
    yield (
        "random, and above noise",
        not (
            found.verdict == "none"
            and found.structure < REMAINING_STRUCTURE_P_VALUE
            and left.depends
        ),
    )


def of_torques(found: mc.MotionDiagnosis) -> Iterator[tuple[str, bool]]:
    """What torques say: as `of_causes`."""
    text, last = found.headline(), found.budget[-1]
    keys = [(one.effect, one.place) for one in found.effects]
    yield "an effect stands twice", len(keys) == len(set(keys))
    open_ones = {(one.effect, one.place) for one in found.not_testable}
    yield "an effect is found and not testable", not open_ones & set(keys)
    yield "named, and nothing is", found.verdict != "named" or bool(found.main)
    odd = [one for one in found.main if one.effect not in USUAL_FRICTION_EFFECTS]
    yield "none, and a cause", found.verdict != "none" or not odd
    yield "none, and unexplained", found.verdict != "none" or not found.unexplained
    yield "too little motion, and a name", not (found.too_little and odd)
    yield "unknown, and nothing is left", found.verdict != "unknown" or bool(found.unexplained)
    worth = [pair for one in found.main for pair in one.worth.values()]
    yield "a cause that closes nothing", not found.main or any(b < a for a, b in worth)
    ends = zip(found.budget[0].holdout_rms, last.holdout_rms, strict=True)
    yield "a budget that rises", any(after <= before for before, after in ends)
    yield "a curve of another run", found.held_run.name in found.runs
    yield (
        "words of another verdict",
        MOTION_VERDICT_SENTENCES[found.verdict] in text or bool(found.too_little),
    )
