"""A diagnosis in words: each sentence states numbers that stand in the JSON."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.diagnosing.result import Finding, Step
from minimax_cal.fitting.beyond import Beyond
from minimax_cal.measuring.floor import Floor


def opening(ladder: Sequence[Step], floor: Floor) -> str:
    """What geometry alone does."""
    nominal, geometric = ladder[0].holdout, ladder[1].holdout
    known = (
        f"{floor.value:.3f} mm ({floor.source})"
        if floor.certain
        else (f"at most {floor.value:.3f} mm, the noise of the fit")
    )
    return (
        f"On poses that no fit has seen, the nominal robot misses by {nominal.rms_mm:.3f} mm RMS, "
        f"the geometrically calibrated one by {geometric.rms_mm:.3f} mm (largest "
        f"{geometric.max_mm:.3f} mm); noise alone would leave {known}."
    )


def named(finding: Finding) -> str:
    """One effect."""
    if not np.isfinite(finding.before):
        amounts = dict(zip(finding.names, finding.values, strict=True))
        share = amounts.get("explained", float("nan"))
        seen = f"; {100.0 * share:.0f} % of the rest lies along the last moves"
        seen = seen if np.isfinite(share) else ""
        return f"{finding.term.effect}: {finding.cause}{seen}."
    text = (
        f"{finding.term.effect} {finding.at} ({finding.cause}) takes the "
        f"error from {finding.before:.3f} to {finding.after:.3f} mm"
    )
    if finding.alternatives:
        others = ", ".join(f"{a.effect} {a.place}" for a in finding.alternatives)
        text += f"; these data cannot tell it from {others}"
    return text + "."


def advice(finding: Finding) -> list[str]:
    """What to measure next."""
    by_text: dict[str, list[str]] = {}
    for a in finding.alternatives:
        if a.separate_with:
            by_text.setdefault(a.separate_with, []).append(f"{a.effect} {a.place}")
    return [f"To tell it from {' and '.join(names)}: {text}." for text, names in by_text.items()]


def reasons(
    verdict: str,
    ladder: Sequence[Step],
    floor: Floor,
    findings: Sequence[Finding],
    closed: float,
    interval: tuple[float, float],
    structure: tuple[str, float],
    beyond: Beyond,
) -> tuple[str, ...]:
    """The verdict and why, in sentences.  structure: where most of it is, and its probability."""
    out = [opening(ladder, floor)]
    final = ladder[-1].holdout
    if findings:
        steps = sorted(findings[:4], key=lambda f: -f.before if np.isfinite(f.before) else -np.inf)
        out += [named(finding) for finding in steps]
        if len(findings) > 4:
            out.append(f"{len(findings) - 4} smaller effects follow in the table.")
        share = f"{100.0 * closed:.0f} %" if np.isfinite(closed) else "an unknown share"
        bounds = (
            f" (95 % interval {100.0 * interval[0]:.0f} to {100.0 * interval[1]:.0f} %)"
            if np.isfinite(interval[0])
            else ""
        )
        out.append(f"Together they close {share} of the gap{bounds}: {final.rms_mm:.3f} mm remain.")
    where, p = structure
    if verdict == "none":
        out.append("Nothing beyond geometry and noise was found; no effect is named.")
    elif verdict == "unknown":
        what = "The rest" if findings else "What geometry leaves"
        out.append(
            f"{what} is not noise ({where}, p = {p:.1g}) and no known effect explains it: "
            + ("the names above are a best guess." if findings else "the cause is unknown.")
        )
    elif verdict == "not_repeatable":
        out.append(
            "The arm does not return to the same place when a pose is repeated, and no known "
            "effect of time, load or approach explains it."
        )
    if beyond.worst:
        out.append(beyond.sentence())
        if beyond.typical_mm > beyond.geometric_typical_mm:
            out.append(
                f"There geometry alone does better ({beyond.geometric_typical_mm:.3f} mm): the "
                "effects do not carry over to places that were not measured."
            )
    for finding in findings:
        out += advice(finding)
    return tuple(out)
