"""Whether an arm keeps a tolerance: by the upper 95 % limit of what is claimed, or not stated."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from minimax_cal.core.display_text import format_first_names
from minimax_cal.core.errors import OptionError
from minimax_cal.fitting.accuracy import (
    UNKNOWN_INTERVAL,
    Accuracy,
    Interval,
    exceedance_probability,
)
from minimax_cal.fitting.region_holdout import RegionHoldout
from minimax_cal.solvers.status import Status

PASSED, NOT_PASSED, NOT_STATED = "passed", "not passed", "not stated"
CLAIM_NAMES = ("inside", "outside")  # the measured poses
OTHER_CLAIM_NAMES = {"within": "inside", "beyond": "outside"}  # accepted, and not offered
LIMIT_KIND_NAMES = {"rms": "RMS", "max": "largest"}  # as people write it, and as they read it
# that the next pose exceeds the largest so far: more says nothing of a maximum
MAX_EXCEED_CHANCE = 0.05
# poses: `exceedance_probability` is then small enough
MIN_POSES_FOR_MAXIMUM = math.ceil(1.0 / MAX_EXCEED_CHANCE - 1.0)
MAX_NAMED_REGIONS = 3  # parts that could not be judged
LIMIT_PATTERN = re.compile(r"\s*(rms|max)\s*[:=<]?\s*([0-9.eE+-]+)\s*(mm)?\s*", re.IGNORECASE)


@dataclass(frozen=True)
class ToleranceLimit:
    """What is required.  kind: rms or max.  size_mm: of the error of a position."""

    kind: str
    size_mm: float


@dataclass(frozen=True)
class ErrorBound:
    """A value and its 95 % limits, NaN where they are not known [mm]."""

    value: float
    high: float
    low: float = math.nan


@dataclass(frozen=True)
class AccuracyClaim:
    """What is claimed of poses that no fit has seen.

    name: inside or outside.  before: of the nominal arm [mm], by kind.  poses: that count by
    themselves.  where: in words.  reason: why there is no claim, if there is none.  open: what
    could not be judged, so that nothing is passed by the rest; empty where all was.  sets: how many
    poses RMS and largest are of; regions: where these are.
    refused: why nothing is passed, whatever the numbers; empty where it may be.
    """

    name: str
    rms: ErrorBound
    largest: ErrorBound
    poses: int
    where: str
    before: tuple[float, float] = (math.nan, math.nan)
    reason: str = ""
    open: str = ""
    sets: tuple[int, int] = (0, 0)
    regions: tuple[str, str] = ("", "")
    refused: str = ""

    def bound(self, kind: str) -> ErrorBound:
        """Of rms or max."""
        return self.rms if kind == "rms" else self.largest


@dataclass(frozen=True)
class LimitJudgement:
    """One requirement against a claim.  verdict: one of the three; why: a clause."""

    limit: ToleranceLimit
    bound: ErrorBound
    verdict: str
    why: str

    @property
    def is_explained_by_numbers(self) -> bool:
        """Whether the numbers alone say why."""
        return self.verdict == PASSED or self.bound.value > self.limit.size_mm

    def sentence(self) -> str:
        """For a terminal."""
        kind = {"rms": "RMS", "max": "Largest"}[self.limit.kind]
        return f"{kind} error at most {self.limit.size_mm:g} mm: {self.verdict} ({self.why})"


def parse_tolerance_limits(text: str) -> tuple[ToleranceLimit, ...]:
    """Requirements as ``rms 0.2, max 0.5`` in millimetres.  Raises OptionError."""
    out = []
    for part in filter(str.strip, text.split(",")):
        found = LIMIT_PATTERN.fullmatch(part)
        try:
            size = float(found[2]) if found else math.nan
        except ValueError:
            size = math.nan
        if not (found and 0.0 < size < math.inf):
            raise OptionError(f"tolerance {text!r}: write it in mm as rms 0.2, max 0.5")
        out.append(ToleranceLimit(found[1].lower(), size))
    if len({limit.kind for limit in out}) < len(out):
        raise OptionError(f"tolerance {text!r}: names rms or max twice")
    return tuple(out)


def parse_claim_name(name: str) -> str:
    """Which of `CLAIM_NAMES` people mean.  Raises OptionError."""
    found = OTHER_CLAIM_NAMES.get(name, name)
    if found not in CLAIM_NAMES:
        raise OptionError(f"tolerance for {name!r}: choose {' or '.join(CLAIM_NAMES)}")
    return found


def build_inside_claim(
    name: str,
    before: Accuracy,
    after: Accuracy,
    intervals: tuple[Interval, Interval] = (UNKNOWN_INTERVAL, UNKNOWN_INTERVAL),
    poses: int | None = None,
    missed: int = 0,
) -> AccuracyClaim:
    """The claim for poses between the measured ones.

    name: of these poses, in words.  missed: how many more no fit without them judges.
    """
    rms, largest = intervals
    return AccuracyClaim(
        "inside",
        ErrorBound(after.rms_mm, 1e3 * rms.high, 1e3 * rms.low),
        ErrorBound(after.max_mm, 1e3 * largest.high, 1e3 * largest.low),
        after.poses if poses is None else poses,
        name,
        (before.rms_mm, before.max_mm),
        "" if after.poses else "no pose was held out",
        f"{missed} poses, which the fit needs, could not be judged" if missed else "",
        (after.poses, after.poses),
    )


def build_outside_claim(found: RegionHoldout) -> AccuracyClaim:
    """The claim for poses away from the measured ones, of the worst part that was left out."""
    worst = found.worst
    if worst is None:
        nothing = ErrorBound(math.nan, math.nan)
        return AccuracyClaim("outside", nothing, nothing, 0, "", reason=found.reason)
    far = max(found.folds, key=lambda fold: fold.max_mm)
    not_judged = ""
    if found.missed:
        missed = format_first_names(found.missed, MAX_NAMED_REGIONS)
        not_judged = (
            f"only {found.judged_region_text} could be judged, not {missed}, which the fit needs"
        )
    of = f"; {found.judged_region_text} could be judged" if found.judged_region_text else ""
    return AccuracyClaim(
        "outside",
        ErrorBound(worst.rms_mm, found.rms_high_mm),
        ErrorBound(far.max_mm, found.max_high_mm),
        worst.poses,
        f"the worst of whole parts held out in turn{found.kept_effects_text} "
        f"({worst.where}, {worst.poses} poses{of})",
        open=not_judged,
        sets=(worst.poses, far.poses),
        regions=(worst.where, far.where),
    )


REFUSAL_REASONS = {  # ends of a calibration of which nothing is passed, whatever its numbers
    Status.FAILED: "the calibration failed",
    Status.CONTRADICTORY: "the files contradict each other",
    Status.NOT_DETERMINED: "the measurements do not determine the arm",
    Status.NO_BETTER: "the calibrated arm is no better than the drawn one",
}


def judge_limit_by_claim(limit: ToleranceLimit, claim: AccuracyClaim) -> LimitJudgement:
    """A requirement against a claim.

    What was seen above the limit is not passed, however few the poses are; and nothing is passed
    while something could not be judged, for it is what the fit rests on most.
    """
    bound = claim.bound(limit.kind)

    def told(verdict: str, why: str) -> LimitJudgement:
        return LimitJudgement(limit, bound, verdict, why)

    if claim.reason:
        return told(NOT_STATED, claim.reason)
    if bound.value > limit.size_mm:
        return told(NOT_PASSED, f"{bound.value:.3f} mm was seen")
    if limit.kind == "max" and exceedance_probability(claim.poses) > MAX_EXCEED_CHANCE:
        return told(
            NOT_STATED,
            (
                f"{claim.poses} poses are too few for a maximum: at "
                f"least {MIN_POSES_FOR_MAXIMUM} are needed"
            ),
        )
    if math.isnan(bound.high):
        return told(
            NOT_STATED,
            f"{bound.value:.3f} mm seen, and no 95 % limit is known: {claim.poses} poses are too "
            "few, or too unlike each other, to tell one",
        )
    seen = f"{bound.value:.3f} mm seen, 95 % limit {bound.high:.3f} mm"
    if bound.high < limit.size_mm and claim.refused:
        return told(NOT_PASSED, f"{seen}, but {claim.refused}")
    if bound.high < limit.size_mm and claim.open:
        return told(NOT_STATED, f"{seen}, but {claim.open}")
    if bound.high < limit.size_mm:
        return told(PASSED, seen)
    return told(NOT_PASSED, f"{seen}: more poses may narrow it")


def describe_other_claim(judged: LimitJudgement, other: AccuracyClaim) -> str:
    """What a requirement that is passed should not hide: another claim is above it; else empty."""
    seen, limit = other.bound(judged.limit.kind).value, judged.limit.size_mm
    if judged.verdict != PASSED or other.reason or not seen > limit:
        return ""
    asked = next(name for name in CLAIM_NAMES if name != other.name)
    kind = {"rms": "RMS", "max": "Largest"}[judged.limit.kind]
    return (
        f"{kind} error passed {asked} the measured region alone: {other.name} it is "
        f"{seen:.3f} mm, more than the {limit:g} mm required"
    )


def overall_verdict(judged: tuple[LimitJudgement, ...]) -> str:
    """Of all requirements together."""
    verdicts = [one.verdict for one in judged]
    if NOT_PASSED in verdicts:
        return NOT_PASSED
    return PASSED if verdicts and set(verdicts) == {PASSED} else NOT_STATED
