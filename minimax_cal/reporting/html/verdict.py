"""What was found, in words for those who sign: each sentence states numbers of the files."""

from __future__ import annotations

import math

from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.fitting.accuracy import UNKNOWN, Accuracy, Interval
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.identify import Because
from minimax_cal.reporting.html.content import Note, caveat, text

OBJECTIVES = {
    "sum": "the sum of all squared errors as small as possible",
    "minimax": "minimax, the error of the worst target as small as possible",
    "point": "minimax over points, the largest single error as small as possible",
    "pose": "errors of position and orientation together as small as possible",
}


def number(value: float) -> str:
    """A length in millimetres, or that it is not known."""
    return f"{value:.3f}\N{NO-BREAK SPACE}mm" if math.isfinite(value) else "an unknown amount"


def within(interval: Interval) -> str:
    """An interval, nothing where it is not known."""
    low, high = 1e3 * interval.low, 1e3 * interval.high
    if math.isnan(low):
        return ""
    if math.isnan(high):
        return f" (95 % interval from {low:.3f}\N{NO-BREAK SPACE}mm; no upper end is known)"
    return f", 95 % interval {low:.3f} to {high:.3f}\N{NO-BREAK SPACE}mm"


def changed(before: Accuracy, after: Accuracy, interval: Interval = UNKNOWN) -> str:
    """Accuracy before and after."""
    return (
        f"the nominal robot missed the measured points by {number(before.rms_mm)} RMS, at most "
        f"{number(before.max_mm)}; the calibrated robot misses them by {number(after.rms_mm)} RMS"
        f"{within(interval)}; at most {number(after.max_mm)}"
    )


def fit_verdict(fit: Fit) -> tuple[Note, ...]:
    """The calibration in some sentences."""
    train, held = fit.accuracy["train"], fit.accuracy["holdout"]
    if not held.poses:
        first = f"On the {train.poses} poses of the fit itself, "
        return text(first + changed(fit.accuracy["nominal_train"], train) + "."), how(fit)
    first = f"On {held.poses} poses that were not used for the fit, "
    known = fit.intervals.get("holdout", (UNKNOWN, UNKNOWN))[0]
    return (
        text(first + changed(fit.accuracy["nominal"], held, known) + "."),
        text(
            f"On the {train.poses} poses of the fit itself the calibrated robot misses by "
            f"{number(train.rms_mm)} RMS, at most {number(train.max_mm)}."
        ),
        how(fit),
    )


def fit_warnings(fit: Fit) -> tuple[Note, ...]:
    """What nobody should sign without having read it."""
    held, notes = fit.accuracy["holdout"], []
    if not held.poses:
        notes.append(
            caveat(
                "No pose was held out: these numbers were reached on the poses of the fit and are "
                "too good for new ones."
            )
        )
    elif not held.rms_mm < fit.accuracy["nominal"].rms_mm:
        notes.append(
            Note("On poses not used for the fit, the calibration is no improvement.", "warning")
        )
    return (*notes, *trouble(fit.status, fit.reason or fit.status.advice))


def how(fit: Fit) -> Note:
    """What was asked for, and how much of it the data told."""
    known = sum(p.identifiable for p in fit.parameters)
    objective = OBJECTIVES.get(fit.objective, fit.objective)
    return text(
        f"{known} of {len(fit.parameters)} parameters were identified; the others keep their "
        f"nominal values, each for a reason that is given. Objective: {objective}."
    )


def trouble(status: str, advice: str) -> tuple[Note, ...]:
    """A warning where the numbers did not work out."""
    if status == "converged":
        return ()
    if status == "no_better":
        return (Note(f"{advice}.", "warning"),)
    tail = f": {advice}." if advice else "."
    return (Note(f"The fit did not converge ({status.replace('_', ' ')}){tail}", "warning"),)


def gap_verdict(gap: Diagnosis) -> tuple[Note, ...]:
    """The diagnosis in its sentences, the verdict first."""
    verdict, *reasons = gap.reasons
    more = (Note(reason, "reason") for reason in reasons)
    return (Note(verdict, "verdict"), *more, *trouble(gap.status, ""))


REASONS = {
    Because.SAME_MOTION: "A parameter with the same motion as others moves every target in the "
    "same way as these do, at all poses: only their sum can be known, and it is in the parameter "
    "that was kept free. Nothing is lost for the positions of the targets.",
    Because.NOT_TOLD: "Where these poses do not tell it from others, the parameter could be known "
    "with more poses, or over a wider range of the joints.",
    Because.NO_MOTION: "A parameter that moves no measured point has no effect on them.",
    Because.FIXED: "Some were kept nominal on purpose.",
}


def why_not(fit: Fit) -> tuple[Note, ...]:
    """The kinds of reasons that occur, explained."""
    given = {p.because for p in fit.parameters if not p.identifiable}
    return tuple(text(words) for kind, words in REASONS.items() if kind in given)
