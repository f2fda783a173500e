"""What was found, in words for those who sign: each sentence states numbers of the files."""

from __future__ import annotations

import math

from minimax_cal.reporting.html.content import Note, caveat, text
from minimax_cal.reporting.html.schema import UNKNOWN, FitFile, Scores
from minimax_cal.reporting.html.sources import Diagnosed, Fit

VERDICTS = {
    "none": "Nothing beyond geometry and noise was found.",
    "named": "What remains has been found and named; no rival explains it as well.",
    "one_of": "A cause has been found, but these data leave more than one name for it.",
    "unknown": "Something remains that follows pose, load, move or time, and no known law "
    "explains it.",
    "not_repeatable": "The arm does not come back to the same place when a pose is repeated.",
}
OBJECTIVES = {
    "sum": "the sum of all squared errors as small as possible",
    "minimax": "minimax, the error of the worst target as small as possible",
    "point": "minimax over points, the largest single error as small as possible",
    "pose": "errors of position and orientation together as small as possible",
}


def number(value: float) -> str:
    """A length in millimetres, or that it is not known."""
    return f"{value:.3f}\N{NO-BREAK SPACE}mm" if math.isfinite(value) else "an unknown amount"


def within(interval: tuple[float, float]) -> str:
    """An interval, nothing where it is not known."""
    if interval == UNKNOWN or any(math.isnan(end) for end in interval):
        return ""
    return f", 95 % interval {interval[0]:.3f} to {interval[1]:.3f}\N{NO-BREAK SPACE}mm"


def changed(before: Scores, after: Scores) -> str:
    """Accuracy before and after."""
    return (
        f"the nominal robot missed the measured points by {number(before.rms_mm)} RMS, at most "
        f"{number(before.max_mm)}; the calibrated robot misses them by {number(after.rms_mm)} RMS"
        f"{within(after.rms_ci95_mm)}; at most {number(after.max_mm)}"
    )


def fit_verdict(fit: Fit) -> tuple[Note, ...]:
    """The calibration in some sentences."""
    c, a = fit.content, fit.content.accuracy
    notes = []
    if a.holdout.poses:
        first = f"On {a.holdout.poses} poses that were not used for the fit, "
        notes.append(text(first + changed(a.nominal, a.holdout) + "."))
        notes.append(
            text(
                f"On the {a.train.poses} poses of the fit itself the calibrated robot misses by "
                f"{number(a.train.rms_mm)} RMS, at most {number(a.train.max_mm)}."
            )
        )
    else:
        first = f"On the {a.train.poses} poses of the fit itself, "
        notes.append(text(first + changed(a.nominal_train, a.train) + "."))
        notes.append(
            caveat(
                "No pose was held out: these numbers were reached on the poses of the fit and are "
                "too good for new ones."
            )
        )
    if a.holdout.poses and not a.holdout.rms_mm < a.nominal.rms_mm:
        notes.append(
            Note("On poses not used for the fit, the calibration is no improvement.", "warning")
        )
    return (*notes, how(c), *trouble(c.status, c.advice))


def how(content: FitFile) -> Note:
    """What was asked for, and how much of it the data told."""
    known = sum(p.identifiable for p in content.parameters)
    objective = OBJECTIVES.get(content.objective, content.objective)
    return text(
        f"{known} of {len(content.parameters)} parameters were identified; the others keep their "
        f"nominal values, each for a reason that is given. Objective: {objective}."
    )


def trouble(status: str, advice: str) -> tuple[Note, ...]:
    """A warning where the numbers did not work out."""
    if status == "converged":
        return ()
    tail = f": {advice}." if advice else "."
    return (Note(f"The fit did not converge ({status.replace('_', ' ')}){tail}", "warning"),)


def gap_verdict(gap: Diagnosed) -> tuple[Note, ...]:
    """The diagnosis, its reasons as they stand in the file."""
    c = gap.content
    reasons = (Note(reason, "reason") for reason in c.reasons)
    return (Note(VERDICTS[c.verdict], "verdict"), *reasons, *trouble(c.status, ""))


REASONS = (
    (
        "same motion as",
        "A parameter with the same motion as others moves every target in the same way as these "
        "do, at all poses: only their sum can be known, and it is in the parameter that was kept "
        "free. Nothing is lost for the positions of the targets.",
    ),
    (
        "these poses do not tell",
        "Where these poses do not tell it from others, the parameter could be known with more "
        "poses, or over a wider range of the joints.",
    ),
    ("moves no measured point", "A parameter that moves no measured point has no effect on them."),
    ("fixed by the user", "Some were kept nominal on purpose."),
)


def why_not(content: FitFile) -> tuple[Note, ...]:
    """The kinds of reasons that occur, explained."""
    given = [p.reason for p in content.parameters if not p.identifiable]
    return tuple(
        text(words) for start, words in REASONS if any(reason.startswith(start) for reason in given)
    )
