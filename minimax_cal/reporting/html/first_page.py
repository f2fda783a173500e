"""The page to sign: verdict, cause, result by deliverable, what was set aside, a picture."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.fitting.accuracy import NO_ENDS, Accuracy
from minimax_cal.fitting.beyond import Beyond
from minimax_cal.fitting.checks import wild
from minimax_cal.fitting.crossed import few_poses, intervals_of
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.set_aside import aside_sentence
from minimax_cal.fitting.several.result import RelativeCalibration
from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.tables import Table
from minimax_cal.ground.words import capitalise, name_first
from minimax_cal.instruments.instrument import METRE
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
from minimax_cal.modelling.effects.words import name_effect
from minimax_cal.modelling.parameters import Names, links_of
from minimax_cal.reporting.html.content import Block, Figure, Note, caveat, text
from minimax_cal.reporting.html.delivered import Row, governing, rows_of, whole
from minimax_cal.reporting.html.error_charts import cumulative
from minimax_cal.reporting.html.more_charts import budget_chart, waterfall
from minimax_cal.reporting.html.pages import names_of, split_reasons
from minimax_cal.reporting.html.sources import Sources, named
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.status import Status

MAX_NAMED = 5  # more kinds of effects than this are counted, not listed
SHOWN_REASONS = 3  # why points were set aside
NOTHING_ASIDE = "No measured point was set aside."
NO_LIMIT = "No requirement was given: the result is stated, and nothing is passed or failed."
NO_CAUSE = "The cause of the remaining error is not known: diagnose the same measurements."


@dataclass(frozen=True)
class Signed:
    """The judgement of a report.  claims: inside, then outside where there is one.

    wild: links that no whole arm changes so much, empty where there are none.  rows: of what leaves
    the house; row: that of them which is judged, None where the result itself is.
    set_aside: points that take no part; with_them: the claim inside where they count, None without
    any; judged_with: the requirements against their bounds.  aside: what any of the results sets
    aside, in sentences.  which: the claim that is judged.  errors: by file, where they are no
    lengths.
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
    aside: tuple[str, ...] = ()
    errors: Table | None = None

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
    def only_without(self) -> bool:
        """Whether it is passed only without the points that were set aside."""
        return bool(self.verdict == PASSED and self.judged_with) and (
            overall(self.judged_with) != PASSED
        )

    @property
    def sentence(self) -> str:
        """Of what which verdict, and where it holds; that it does only without points set aside."""
        if not self.verdict:
            return NO_LIMIT
        of = f" for {self.row.short}" if self.row else ""
        if self.verdict != PASSED:
            return f"{self.verdict}{of}"
        if not self.only_without:
            return f"{PASSED} {self.which} the measured region{of}"
        with_all = overall(self.judged_with)
        worst = next(one for one in self.judged_with if one.verdict == with_all)
        them = "it" if len(self.set_aside) == 1 else "them"
        return (
            f"{PASSED}{of} without {counted(self.set_aside)}; with {them} "
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

    @property
    def look(self) -> str:
        """How the verdict looks: passed, failed or unstated."""
        kind = {PASSED: "passed", NOT_PASSED: "failed"}.get(self.verdict, "unstated")
        return "unstated" if self.only_without else kind

    def lines(self) -> list[str]:
        """For a terminal, beside the table."""
        said = [one.sentence() for one in self.judged]
        if not self.judged:
            return [self.sentence, *self.aside]
        told = [self.holds_for] if self.row else []
        return [self.sentence, *said, *self.aside, *told, *self.held, *self.besides]

    @property
    def held(self) -> list[str]:
        """What each deliverable holds, and what the whole model does; empty without any."""
        return [*(row.said() for row in self.rows), whole(self.rows)] if self.rows else []

    def tables(self) -> tuple[Table, ...]:
        """For a terminal."""
        return (result_table(self),)

    @property
    def complaint(self) -> str:
        """What of the requirement is not passed."""
        return "; ".join(one.sentence() for one in self.judged if one.verdict == NOT_PASSED)


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
    aside = asides(sources)
    if row := governing(rows, bool(deliver)):
        model = with_effects(row.delivered.cell)
        found = Signed(model, row.claims, row.judged, odd, rows, row, which=which, aside=aside)
        return counting_all(found, sources, limits, which)
    chosen = next((claim for claim in claims if claim.name == which), None)
    if chosen is None:
        chosen = beyond(Beyond(reason="this result makes no such claim"))
    judged = tuple(judge(limit, chosen) for limit in limits)
    told = sources.relative
    errors = told.error_table() if told and told.units != (METRE,) else None
    found = Signed(model, claims, judged, odd, which=which, aside=aside, errors=errors)
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
    (least, rms), (low, largest) = found.rms_ci95_mm or NO_ENDS, found.max_ci95_mm or NO_ENDS
    bounds = Bound(found.rms_mm, rms, least), Bound(found.max_mm, largest, low)
    return replace(claim, rms=bounds[0], largest=bounds[1])


def asides(sources: Sources) -> tuple[str, ...]:
    """What each result sets aside; once where calibration and diagnosis say the same."""
    said = {kind: aside_of(result) for kind, result in named(sources) if result.set_aside}
    if len(said) == len(named(sources)) and len(set(said.values())) == 1:
        return tuple(set(said.values()))
    return tuple(f"In the {kind}: {text}" for kind, text in said.items())


def aside_of(result: Fit | Diagnosis | RelativeCalibration) -> str:
    """How many points a result sets aside, by whom, why, and its error with them."""
    reasons = Counter(point.why for point in result.set_aside).most_common()
    why = "; ".join(f"{text} ({count})" for text, count in reasons[:SHOWN_REASONS])
    more = f"; {len(reasons) - SHOWN_REASONS} more reasons" if len(reasons) > SHOWN_REASONS else ""
    seen = None if isinstance(result, RelativeCalibration) else result.with_them
    return f"{aside_sentence(result.set_aside, seen)} Why: {why}{more}."


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
        error = rungs[at][1].error(with_history(gap.data))[gap.held]
    else:
        error = gap.errors[1][gap.held] if gap.data.poses else np.zeros((0, 1, 3))
    group = clusters(gap.data)[gap.held] if len(error) else np.zeros(0)
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
    """Verdict, cause, results, what was set aside, and a picture."""
    kind = found.look
    alarm = "caveat" if kind == "passed" else "warning"  # nothing is red under what is passed
    lines: list[Block] = [
        Note(capitalise(found.sentence), f"banner {kind}" if found.verdict else "text"),
        *because(sources),
        result_table(found),
        text(basis(found)),
        *([text(" ".join(found.held))] if found.held else []),
        *(Note(f"{said}.", alarm) for said in found.besides),
    ]
    if sources.results or sources.relative:
        lines += [Note(said, alarm) for said in found.aside]
        none = () if found.aside else (NOTHING_ASIDE,)
        lines += [text(" ".join(said))] if (said := (*none, *kept(sources))) else []
    lines += [text(one.sentence() + ".") for one in found.judged if not one.plain]
    lines += [text(which) for which in which_is_which(sources, found)]
    lines += [Note(notice, alarm) for notice in sources.notices]
    wrong = fit_warnings(sources.fit) if sources.fit else ()
    if sources.gap and not sources.fit:
        wrong = trouble(sources.gap.status, "")
    lines += [caveat(one.text) if kind == "passed" else one for one in wrong]
    return tuple(lines) if found.errors else (*lines, picture(sources, found))


def because(sources: Sources) -> Iterator[Note]:
    """The cause with its share, and the joint that it turns most; how to find it where unknown."""
    fit = sources.fit
    few = (
        few_poses(fit.train, int(fit.identification.active.sum())) if fit and fit.data.poses else ""
    )
    if found := sources.gap or sources.causes:
        (first, *others), _ = split_reasons(found)
        yield Note(first, "verdict")
        yield from [text(" ".join(others))] if others else []
    elif few:
        yield text(f"What limits it now: {few}.")
    elif fit and fit.cell.effects.causes:
        yield text(f"The model holds {model_of(fit)}; what each explains is in the diagnosis.")
    else:
        yield text(NO_CAUSE)
    yield from map(text, worst_joint(sources))


def worst_joint(sources: Sources) -> Iterator[str]:
    """The joint that effects turn most, in degrees, and the pose; nothing where none turns one."""
    if sources.turned:
        data, turn = sources.turned
        pose, joint = np.unravel_index(np.argmax(turn), turn.shape)
        at = ", ".join(
            f"{1e3 * q:.0f} mm" if slides else f"{np.degrees(q):.0f}"
            for q, slides in zip(data.q[pose], data.sliding, strict=True)
        )
        most = turn[pose, joint]
        yield (
            f"Worst joint: joint {joint + 1}, turned {np.degrees(most):.3f} degrees "
            f"({1e3 * most:.2f} mrad) by all effects at its worst pose "
            f"({data.row_called(int(pose))}; joints at {at} deg)."
        )


def kept(sources: Sources) -> Iterator[str]:
    """Which points stand out and yet take part."""
    if sources.fit and sources.fit.suspects:
        fit = sources.fit
        most = sorted(fit.suspects, key=lambda one: -one.distance)
        names = [f"{fit.data.called(s.line)} {s.target} {1e3 * s.distance:.2f} mm" for s in most]
        many = "1 outlier was" if len(names) == 1 else f"{len(names)} outliers were"
        where = name_first(names, MAX_NAMED)
        counts = "count in the result" if any(one.held for one in most) else (
            "the limits inside are of poses without such"
        )  # fmt: skip
        yield f"{many} kept, and {counts}: {where}."


def picture(sources: Sources, found: Signed) -> Figure:
    """How far each step brings the error down, or of how many points."""
    if sources.gap:
        return waterfall(sources.gap)
    if sources.poses:
        return cumulative(sources.poses, names_of(sources))
    inside = found.claims[0]
    after = (found.model, inside.rms.value, inside.largest.value)
    return budget_chart("ladder", [("nominal arm", *inside.before), after])


def result_table(found: Signed) -> Table:
    """Of each deliverable: before, result, its 95 % interval, what is required, verdict.

    Errors that are no lengths stand by file, in their units.
    """
    if found.errors:
        return found.errors
    groups = [(row.short, row.claims, row.judged) for row in found.rows]
    groups = groups or [("", found.claims, found.judged)]
    rows: list[tuple[object, ...]] = []
    for name, claims, judged in groups:
        said = {one.limit.kind: one.verdict for one in judged}
        for claim in claims:
            inside = claim.name == "inside"
            if claim.reason and not inside:
                continue
            for i, (kind, title) in enumerate(KINDS.items()):
                if not inside and i and name != groups[0][0]:
                    continue  # in the words of `export`; the page has no room for all
                which = "inside" if inside else f"outside ({claim.regions[i]})"
                verdict = said.get(kind, "") if claim.name == found.which else ""
                sizes = ends(claim.before[i], claim.bound(kind))
                poses = claim.sets[i] or ""
                rows.append((name, f"{title}, {which}", poses, *sizes, verdict))
    if (all_of := found.with_them) is not None:
        rows += [
            (groups[0][0], f"{title}, inside, with {len(found.set_aside)} points set aside", "",
             *ends(before, all_of.bound(kind)), "")
            for (kind, title), before in zip(KINDS.items(), all_of.before, strict=True)
        ]  # fmt: skip
    columns = "before .3f | result .3f | 95 % interval | verdict"
    title = f"{'Result by deliverable' if found.rows else f'Model: {found.model}'} [mm]"
    limits = [f"{KINDS[one.limit.kind]} at most {one.limit.size_mm:g}" for one in found.judged]
    title += f"; required: {', '.join(limits)}" if limits else ""
    what = "error" if found.claims[0].reason else "error of position"
    every = Table.made(title, rows, f"of | {what} | poses d | {columns}")
    first, last = (0 if found.rows else 1), (7 if found.judged else 6)
    return every.only(*range(first, last))


def ends(before: float, bound: Bound) -> tuple[float, float, str]:
    """Cells of a row: before, result, its interval."""
    most = bound.high if bound.high > bound.value else math.nan  # what was seen is no limit
    low, high = ("" if math.isnan(end) else f"{end:.3f}" for end in (bound.low, most))
    return before, bound.value, f"{low or 'up'} to {high}" if high else f"from {low}" if low else ""


def basis(found: Signed) -> str:
    """What the numbers rest on."""
    inside = found.claims[0]
    out = f"Inside: {inside.where}. "
    away = found.claims[1] if len(found.claims) > 1 else None
    if away and not away.reason:
        out += f"Outside: {away.where}. "
    elif away:
        out += f"Outside them nothing is claimed: {away.reason}. "
    out += "With 95 % confidence as many new poses stay below the upper ends."
    told = [claim for claim in found.claims if not claim.reason]
    if any(math.isnan(claim.bound(kind).high) for claim in told for kind in KINDS):
        out += " A dash: the poses are too few, or too unlike each other, to tell a limit."
    return out


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


def trouble(status: str, advice: str) -> tuple[Note, ...]:
    """A warning where the numbers did not work out."""
    if status == "converged":
        return ()
    if Status(status).keeps_drawn:
        return (Note(f"{advice}.", "warning"),)
    tail = f": {advice}." if advice else "."
    return (Note(f"The fit did not converge ({status.replace('_', ' ')}){tail}", "warning"),)


def which_is_which(sources: Sources, found: Signed) -> list[str]:
    """Where fit and diagnosis hold different models: which one is signed."""
    fit, gap = sources.fit, sources.gap
    if not (fit and gap):
        return []
    held = {term.effect for term in fit.cell.effects.terms}
    if all(f.term.effect in held for f in gap.effects if f.established and not f.rows):
        return []
    last, _ = claims_at(gap, None)
    return [
        f"Signed is the calibration ({found.model}), which leaves confirmed causes out. With them "
        f"({last}) the RMS on held-out poses is {gap.ladder[-1].holdout.rms_mm:.3f} mm."
    ]
