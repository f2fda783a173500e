"""Which names hold: found again, chosen anew, when each fifth of the poses is left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from scipy.stats import chi2

from minimax_cal.diagnosing.gap import folds
from minimax_cal.diagnosing.result import Finding
from minimax_cal.evidence.library import Library
from minimax_cal.evidence.limits import AGAIN, DIFFER, FOLDS, MOST, SAME
from minimax_cal.evidence.selection import Choice, select
from minimax_cal.ground.arrays import Array
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
    times = [0] * len(findings)
    for number in range(FOLDS):
        choice = select(library.only(part != number), ripple=ripple, level=AGAIN, seldom=MOST)
        times = [n + is_found(one, choice, whole) for n, one in zip(times, findings, strict=True)]
    pairs = zip(findings, times, strict=True)
    return [replace(one, again=n / FOLDS) for one, n in pairs]


def is_found(finding: Finding, choice: Choice, whole: Choice) -> bool:
    """Whether a choice has an effect, or a rival that was told with it, as large as before."""
    rivals = {(a.effect, a.place) for a in finding.alternatives}
    effect, place = finding.term.key
    own, before = (estimates_of(finding, one) for one in (choice, whole))
    if not own:  # all joints hold one, too
        alike = {candidate.key for candidate in choice.chosen}
        wide = any(name == effect and "all" in (place, other) for name, other in alike)
        return wide or bool(alike & rivals)
    if own.keys() != before.keys():
        return True  # another variant of the law, or another of its lines
    return all(agree(own[text], before[text]) for text in own)


def estimates_of(finding: Finding, choice: Choice) -> dict[str, tuple[Array, Array]]:
    """Values and sigmas of the parameters of an effect's terms, by the text of each."""
    pairs = zip(choice.chosen, choice.estimates, strict=True)
    return {c.term.text: values for c, values in pairs if c.key == finding.term.key}


def agree(part: tuple[Array, Array], whole: tuple[Array, Array]) -> bool:
    """Whether the parameters of a part are those of the whole, within the sigmas of both."""
    (ours, sigma), (theirs, other) = part, whole
    variance = sigma**2 + other**2 + 1e-300
    off, size = (float((x**2 / variance).sum()) for x in (ours - theirs, theirs))
    return bool(off < max(chi2.isf(DIFFER, len(ours)), SAME * size))
