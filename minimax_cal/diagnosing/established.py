"""Which names hold: found again, chosen anew, when each fifth of the poses is left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from scipy.stats import chi2

from minimax_cal.diagnosing.gap import folds
from minimax_cal.diagnosing.result import Finding
from minimax_cal.evidence.bench import Added
from minimax_cal.evidence.library import Library
from minimax_cal.evidence.limits import AGAIN, DIFFER, FOLDS, SAME
from minimax_cal.evidence.selection import Choice, select
from minimax_cal.measuring.measurements import Measurements


def judged_again(
    findings: Sequence[Finding], whole: Choice, data: Measurements, library: Library, ripple: bool
) -> list[Finding]:
    """The findings, each with how often it was found again.

    whole: what was chosen on all poses.  library: what it was chosen from.
    """
    if not findings:
        return []
    part = folds(data, FOLDS)
    choices = [
        select(library.only(part != number), ripple=ripple, level=AGAIN) for number in range(FOLDS)
    ]
    return [
        replace(one, again=sum(is_found(one, choice, whole) for choice in choices) / FOLDS)
        for one in findings
    ]


def is_found(finding: Finding, choice: Choice, whole: Choice) -> bool:
    """Whether a choice has an effect, or a rival that was told with it, as large as before."""
    rivals = {(a.effect, a.place) for a in finding.alternatives}
    effect, place = finding.term.key
    own = [one for one in choice.fits if one.candidate.key == finding.term.key]
    if not own:  # all joints hold one, too
        alike = {one.candidate.key for one in choice.fits}
        wide = any(name == effect and "all" in (place, other) for name, other in alike)
        return wide or bool(alike & rivals)
    before = [one for one in whole.fits if one.candidate.key == finding.term.key]
    if {one.candidate.term.text for one in own} != {one.candidate.term.text for one in before}:
        return True  # another variant of the law, or another of its lines
    known = {one.candidate.term.text: one for one in before}
    return all(agree(one, known[one.candidate.term.text]) for one in own)


def agree(part: Added, whole: Added) -> bool:
    """Whether the parameters of a part are those of the whole, within the sigmas of both."""
    variance = part.sigma**2 + whole.sigma**2 + 1e-300
    off, size = (float((x**2 / variance).sum()) for x in (part.value - whole.value, whole.value))
    return bool(off < max(chi2.isf(DIFFER, len(part.value)), SAME * size))
