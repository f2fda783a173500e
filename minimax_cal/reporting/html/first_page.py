"""The page to sign: requirement, result, verdict, what limits it; one final number."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.diagnosing.result import Diagnosis, Finding
from minimax_cal.diagnosing.sentences import OPENINGS, parts_of
from minimax_cal.fitting.accuracy import NO_ENDS, Accuracy
from minimax_cal.fitting.beyond import Beyond
from minimax_cal.fitting.checks import wild
from minimax_cal.fitting.crossed import intervals_of
from minimax_cal.fitting.fit import Fit
from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.tables import Table
from minimax_cal.ground.words import capitalise
from minimax_cal.judging.tolerance import (
    KINDS,
    NOT_PASSED,
    PASSED,
    REFUSED,
    Bound,
    Claim,
    Judgement,
    Limit,
    beyond,
    elsewhere,
    judge,
    overall,
    within,
)
from minimax_cal.measuring.grouping import clusters
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import SetAside
from minimax_cal.measuring.set_aside import counted
from minimax_cal.modelling.cell import Cell as Arm
from minimax_cal.modelling.effects.words import name_effect, name_structure
from minimax_cal.modelling.parameters import Names, links_of
from minimax_cal.reporting.html.content import Block, Note, caveat, text
from minimax_cal.reporting.html.delivered import Row, delivered_table, governing, rows_of
from minimax_cal.reporting.html.sources import Sources
from minimax_cal.reporting.html.verdict import fit_warnings, number, trouble
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.status import Status

CERTAIN = ("named", "one_of")  # verdicts that let a cause be told for established
CLOSES = 0.005  # share of the gap that is told as 1 %: a cause of less does not limit
NEAR_NOISE = 1.5  # times the noise floor: what is left is noise
MAX_NAMED = 5  # more kinds of effects than this are counted, not listed
SHOWN_REASONS = 3  # why points were set aside
NOTHING_ASIDE = "No measured point was set aside."
NO_LIMIT = "No requirement was given: the result is stated, and nothing is passed or failed."


@dataclass(frozen=True)
class Signed:
    """The judgement of a report.  claims: inside, then outside where there is one.

    wild: links that no whole arm changes so much, empty where there are none.  rows: of what leaves
    the house; row: that of them which is judged, None where the result itself is.
    set_aside: points that take no part; with_them: the claim inside where they count, None without
    any; judged_with: the requirements against their bounds.  which: the claim that is judged.
    """

    model: str
    claims: tuple[Claim, ...]
    judged: tuple[Judgement, ...]
    wild: str = ""
    rows: tuple[Row, ...] = ()
    row: Row | None = None
    set_aside: tuple[SetAside, ...] = ()
    with_them: Claim | None = None
    judged_with: tuple[Judgement, ...] = ()
    which: str = "inside"

    @property
    def verdict(self) -> str:
        """passed, not passed or not stated; empty without a requirement."""
        return overall(self.judged) if self.judged else ""

    @property
    def holds_for(self) -> str:
        """What the result holds for, in a sentence; empty where it is of geometry alone."""
        if self.row is None:
            return ""
        rest = ""
        if any(row.delivered.not_carried for row in self.rows if row is not self.row):
            rest = "; other deliverables are judged below"
        return f"Result and verdict hold for {self.row.name} ({self.model}){rest}."

    @property
    def sentence(self) -> str:
        """The verdict; where it is passed only without points set aside, that it is so."""
        if self.verdict != PASSED or not self.judged_with or overall(self.judged_with) == PASSED:
            return self.verdict
        with_all = overall(self.judged_with)
        worst = next(one for one in self.judged_with if one.verdict == with_all)
        them = "it" if len(self.set_aside) == 1 else "them"
        return (
            f"{PASSED} without {counted(self.set_aside)}; with {them} "
            f"{KINDS[worst.limit.kind]} {worst.bound.value:.3f} mm: {with_all}"
        )

    @property
    def besides(self) -> list[str]:
        """What a requirement that is passed should not hide: a claim above it, another arm."""
        pairs = ((one, claim) for one in self.judged for claim in self.claims)
        other = f"Implausibly large changes: {self.wild}: the robot file may be another arm's"
        return [said for said in (elsewhere(one, claim) for one, claim in pairs) if said] + (
            [other] if self.wild else []
        )

    def lines(self) -> list[str]:
        """For a terminal."""
        said = [one.sentence() for one in self.judged]
        aside = [aside_of(self)] if self.set_aside else []
        if not self.judged:
            return aside
        told = [self.holds_for] if self.row else []
        rows = [row.line() for row in self.rows]
        return [self.sentence, *said, *aside, *told, *rows, *self.besides]


def signed(
    sources: Sources,
    limits: tuple[Limit, ...],
    which: str,
    rung: int | None,
    deliver: Sequence[str] = (),
) -> Signed:
    """The claims of a result, and the requirements against the one that is named.

    which: inside or outside.  rung: of a diagnosis.  deliver: what is judged of the result, as of
    `deliver`; where it holds effects and nothing is named, corrected targets: no file of a robot
    reaches what it says.  Raises OptionError.
    """
    if rung is not None and not (sources.gap and not sources.fit):
        raise OptionError("step: only a report of a diagnosis alone has steps")
    if sources.fit:
        model, claims = model_of(sources.fit), claims_of(sources.fit)
    elif sources.gap:
        model, claims = claims_at(sources.gap, rung)
    else:
        model, claims = "calibration without coordinates", (claim_of_parts(sources),)
    own, fit = sources.fit or sources.gap or sources.relative, sources.fit
    claims = refused(claims, own.status) if own else claims
    odd = changed(fit.nominal.robot, fit.cell.robot) if fit else ""
    rows = rows_of(sources, deliver, rung, limits, which, claims_of, claims)
    if row := governing(rows, bool(deliver)):
        model = with_effects(row.delivered.cell)
        found = Signed(model, row.claims, row.judged, odd, rows, row, which=which)
        return counting_all(found, sources, limits, which)
    chosen = next((claim for claim in claims if claim.name == which), None)
    if chosen is None:
        chosen = beyond(Beyond(reason="this result makes no such claim"))
    judged = tuple(judge(limit, chosen) for limit in limits)
    found = Signed(model, claims, judged, odd, which=which)
    return counting_all(found, sources, limits, which)


def counting_all(found: Signed, sources: Sources, limits: tuple[Limit, ...], which: str) -> Signed:
    """The judgement beside that with the points that were set aside, where there are any.

    which: inside or outside.
    """
    result = sources.fit or sources.gap
    if result is None or not result.set_aside:
        return found
    inside = counting(found.claims[0], result.with_them)
    chosen = next((claim for claim in found.claims if claim.name == which), inside)
    also = replace(chosen, rms=inside.rms, largest=inside.largest)
    with_all = tuple(judge(limit, also) for limit in limits) if result.with_them else ()
    return replace(found, set_aside=result.set_aside, with_them=inside, judged_with=with_all)


def counting(claim: Claim, found: Accuracy | None) -> Claim:
    """A claim inside, where the points that were set aside count."""
    if found is None:
        return claim
    (_, rms), (_, largest) = found.rms_ci95_mm or NO_ENDS, found.max_ci95_mm or NO_ENDS
    return replace(claim, rms=Bound(found.rms_mm, rms), largest=Bound(found.max_mm, largest))


def aside_of(found: Signed) -> str:
    """How many points were set aside, by whom, why, and the error with them."""
    reasons = Counter(point.why for point in found.set_aside).most_common()
    why = "; ".join(f"{text} ({count})" for text, count in reasons[:SHOWN_REASONS])
    more = f"; {len(reasons) - SHOWN_REASONS} more reasons" if len(reasons) > SHOWN_REASONS else ""
    seen = found.with_them
    them = "it" if len(found.set_aside) == 1 else "them"
    errors = (
        f"; with {them} RMS {seen.rms.value:.3f} mm, largest {seen.largest.value:.3f} mm"
        if seen
        else ""
    )
    return f"{counted(found.set_aside)}{errors}. Why: {why}{more}"


def refused(claims: tuple[Claim, ...], status: Status) -> tuple[Claim, ...]:
    """The claims of a result, of which nothing is passed where it has failed or is no better."""
    return tuple(replace(claim, refused=REFUSED.get(status, "")) for claim in claims)


def changed(before: Robot, after: Robot) -> str:
    """Links that no whole arm changes so much; empty where there are none."""
    change = links_of(after.mdh - before.mdh)
    return wild(Names.of(before, ()), change, before.reach())


def model_of(fit: Fit) -> str:
    """What the calibration holds, in words."""
    return with_effects(fit.cell)


def with_effects(cell: Arm) -> str:
    """Geometry and the kinds of effects of an arm."""
    terms = list(dict.fromkeys(name_effect(term.effect) for term in cell.effects.terms))
    if len(terms) > MAX_NAMED:
        return f"geometry and {len(terms)} kinds of effects"
    return f"geometry, {', '.join(terms)}" if terms else "geometry alone"


def claims_of(fit: Fit) -> tuple[Claim, ...]:
    """Of a calibration."""
    seen = fit.within
    held = fit.accuracy["holdout"].poses > 0 or bool(fit.error_crossed.size)
    inside = within(
        seen.where,
        seen.before,
        seen.after,
        (seen.rms, seen.largest),
        seen.poses,
        seen.missed,
        "cross-validated" if fit.error_crossed.size else "held out",
    )
    if not held:
        inside = Claim("inside", inside.rms, inside.largest, 0, seen.where, inside.before,
                       "no pose was held out, and training errors are too small")  # fmt: skip
    return refused((inside, beyond(fit.beyond)), fit.status)


def claims_at(gap: Diagnosis, rung: int | None) -> tuple[str, tuple[Claim, ...]]:
    """Name and claim of a rung of a diagnosis.  Raises OptionError."""
    rungs = gap.rungs()
    last = len(rungs) - 1
    if rung is not None and not 0 <= rung <= last:
        names = ", ".join(f"{i} ({name})" for i, (name, _) in enumerate(rungs)) or "the last alone"
        raise OptionError(f"the diagnosis has no step {rung}; it has {names}")
    at = last if rung is None else rung
    step = gap.ladder[0] if rungs and at == 0 else gap.ladder[len(gap.ladder) - 1 - (last - at)]
    if rungs and gap.data.poses:
        error = rungs[at][1].error(with_history(gap.data))[:, gap.held]
    else:
        error = gap.errors[1][:, gap.held] if gap.data.poses else np.zeros((1, 0, 3))
    group = clusters(gap.data)[gap.held] if error.shape[1] else np.zeros(0)
    ends = intervals_of(error, group, 0)
    where = f"{step.holdout.poses} poses that were not used for the fit"
    poses = len(np.unique(group)) or step.holdout.poses
    plain = {"nominal": "the nominal robot", "geometric": "geometry alone"}
    model = plain.get(step.name) or with_effects(rungs[at][1] if rungs else gap.cells[-1])
    claims = [within(where, gap.ladder[0].holdout, step.holdout, ends, poses)]
    if at == last:
        claims.append(beyond(gap.beyond))
    return model, tuple(claims)


def claim_of_parts(sources: Sources) -> Claim:
    """Of a calibration without coordinates, whose errors are not those of positions."""
    told = sources.relative
    if told is None:
        raise CalibrationError("a report needs a result")
    before, after, where = told.before_and_after()
    claim = within(where, before, after)
    if told.words.of_position:
        return claim
    return Claim(claim.name, claim.rms, claim.largest, claim.poses, where, claim.before,
                 f"errors of {told.kind} are not errors of position")  # fmt: skip


# ---- what stands on the page -------------------------------------------------------------------


def page_blocks(sources: Sources, found: Signed) -> tuple[Block, ...]:
    """Verdict, table, and a few lines."""
    kind = {PASSED: "passed", NOT_PASSED: "failed"}.get(found.verdict, "unstated")
    banner = capitalise(found.sentence) if found.verdict else NO_LIMIT
    kind = kind if found.sentence == found.verdict else "unstated"
    banner += f" {found.which} the measured region" if kind == "passed" else ""
    alarm = "caveat" if kind == "passed" else "warning"  # nothing is red under what is passed
    lines: list[Block] = [Note(banner, f"banner {kind}" if found.verdict else "text")]
    lines += [text(found.holds_for)] if found.row else []
    lines += [result_table(sources, found), text(basis(found))]
    lines += [Note(f"{said}.", alarm) for said in found.besides]
    if sources.results:
        lines.append(Note(f"{aside_of(found)}.", alarm) if found.set_aside else text(NOTHING_ASIDE))
    lines += [delivered_table(found.rows)] if found.rows else []
    lines += [Note(one.sentence() + ".") for one in found.judged if not one.plain]
    if limiting := limits_now(sources, found):
        lines.append(text(f"What limits it now: {limiting}"))
    lines += [text(which) for which in which_is_which(sources, found)]
    lines += [Note(notice, alarm) for notice in sources.notices]
    wrong = fit_warnings(sources.fit) if sources.fit else ()
    if sources.gap and not sources.fit:
        wrong = trouble(sources.gap.status, "")
    lines += [caveat(one.text) if kind == "passed" else one for one in wrong]
    return tuple(lines)


def result_table(sources: Sources, found: Signed) -> Table:
    """Before, result, its 95 % limit, what is required, verdict."""
    named = {(one.bound, one.limit.kind): one for one in found.judged}
    rows: list[tuple[object, ...]] = []
    for claim in found.claims:
        if claim.name == "outside" and claim.reason:
            continue
        title = "inside measured region" if claim.name == "inside" else "outside, worst part"
        for i, kind in enumerate(KINDS):
            bound = claim.bound(kind)
            one = named.get((bound, kind))
            which = f" ({claim.sets[i]})" if claim.sets[i] else ""
            asked = (one.limit.size_mm, one.verdict) if one else (None, "")
            size = claim.before[i], bound.value, bound.high
            rows.append((f"{KINDS[kind]}, {title}{which}", *size, *asked))
    if (all_of := found.with_them) is not None:
        rows += [
            (f"{name}, inside, with {len(found.set_aside)} points set aside", before, bound.value,
             bound.high, None, "")
            for (kind, name), before in zip(KINDS.items(), all_of.before, strict=True)
            for bound in [all_of.bound(kind)]
        ]  # fmt: skip
    rows += iso_rows(sources.fit) if sources.fit else ()
    columns = "before mm .3f | result mm .3f | 95 % limit mm .3f | required mm .3g | verdict"
    head = f"error of position (on poses) | {columns}"
    return Table.made(f"Model: {found.model}", rows, head)


def iso_rows(fit: Fit) -> list[tuple[object, ...]]:
    """Mean and largest AP of held-out poses by the formulas of ISO 9283, where they can be had."""
    from minimax_cal.judging.standard import iso9283

    try:
        values = iso9283(fit).parts["holdout"].values
    except (CalibrationError, KeyError):
        return []
    sizes = [1e3 * np.linalg.norm(values[key].position, axis=1) for key in ("before", "after")]
    if not all(np.isfinite(size).any() for size in sizes):
        return []
    return [
        (f"AP of ISO 9283, {name} ({np.isfinite(sizes[1]).sum()} held out)",
         *map(take, sizes), None, None, "")
        for name, take in (("mean", np.nanmean), ("largest", np.nanmax))
    ]  # fmt: skip


def basis(found: Signed) -> str:
    """What the numbers rest on."""
    inside = found.claims[0]
    out = f"Inside the measured region: on {inside.where}. "
    away = found.claims[1] if len(found.claims) > 1 else None
    if away and not away.reason:
        out += f"Outside: {away.where.removeprefix('outside the measured region, in ')}. "
    elif away:
        out += f"Outside them nothing is claimed: {away.reason}. "
    out += (
        "With 95 % confidence the RMS of such poses, and the largest error of as many new ones, "
        "stay below the 95 % limits, which are compared with the requirement."
    )
    told = [claim for claim in found.claims if not claim.reason]
    if any(math.isnan(claim.bound(kind).high) for claim in told for kind in KINDS):
        out += " A dash: the poses are too few, or too unlike each other, to tell a limit."
    return out


def limits_now(sources: Sources, found: Signed) -> str:
    """The one thing that keeps the error from being smaller; empty where nobody knows."""
    left = found.claims[0].rms.value
    if found.row and found.row.delivered.lacks:
        own = found.row.delivered
        whole = number(own.whole.rms)
        return (
            f"{own.lacks}, which {own.format} leaves out; the full model has {whole} RMS."
            f"{unexplained_of(sources.gap)}"
        )
    if sources.gap:
        lacking = [f for f in causes(sources.gap) if not (holds(sources, f) or f.share < CLOSES)]
        if lacking and sources.gap.verdict in CERTAIN:
            return f"{said_of(lacking)}, which the diagnosis establishes and this model leaves out."
        if lacking:
            return f"{said_of(lacking)}, which this model leaves out.{unexplained_of(sources.gap)}"
        return left_now(sources.gap, left) + unexplained_of(sources.gap)
    if sources.fit:
        few = [notice for notice in sources.fit.notices if notice.startswith("too few poses")]
        if few:
            return few[0].removeprefix("too few poses: ") + "."
        return (
            f"what {model_of(sources.fit)} leaves, {number(left)} RMS; a diagnosis of the same "
            "measurements finds its cause."
        )
    return ""


def unexplained_of(gap: Diagnosis | None) -> str:
    """What the diagnosis does not explain, after a space; empty where it explains all."""
    if gap is None or gap.verdict not in ("unknown", "not_repeatable"):
        return ""
    if gap.verdict == "not_repeatable":
        return f" {OPENINGS[gap.verdict]}"
    return f" Unexplained by the diagnosis: {name_structure(gap.structure_in)}."


def left_now(gap: Diagnosis, left: float) -> str:
    """What remains beneath the causes that were found.  left: RMS [mm].

    A floor that is only the most that noise may be tells no cause: it is what the model leaves.
    """
    floor, rest = gap.floor, gap.remaining
    if floor.certain and left <= NEAR_NOISE * floor.value:
        return f"measurement noise ({number(floor.value)})."
    parts = f" ({', '.join(parts_of(gap, rest))})" if rest else ""
    return f"a remaining error that no known effect explains{parts}."


def causes(gap: Diagnosis) -> list[Finding]:
    """The confirmed effects, the largest first."""
    return [f for f in gap.effects if f.established and not f.rows]


def holds(sources: Sources, finding: Finding) -> bool:
    """Whether the model that is signed has an effect."""
    if sources.fit is None:
        return True
    return finding.term.effect in {term.effect for term in sources.fit.cell.effects.terms}


def said_of(findings: list[Finding]) -> str:
    """Causes in words, at most three."""
    named = [f"{f.cause} ({f.name})" for f in findings[:3]]
    more = f" and {len(findings) - 3} more" if len(findings) > 3 else ""
    return ", ".join(named) + more


def which_is_which(sources: Sources, found: Signed) -> list[str]:
    """Where fit and diagnosis hold different models: which one is signed."""
    if not (sources.fit and sources.gap):
        return []
    last, _ = claims_at(sources.gap, None)
    if all(holds(sources, f) for f in causes(sources.gap)):
        return []
    final = sources.gap.ladder[-1].holdout.rms_mm
    return [
        f"Signed is the calibration ({found.model}). The diagnosis in the appendix ends with "
        f"another model ({last}), of {number(final)} RMS on its held-out poses."
    ]
