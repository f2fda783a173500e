"""The page to sign: verdict, cause, result by deliverable, what was set aside, a picture."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from minimax_cal.core.display_text import capitalise_sentence, format_first_names
from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.core.tables import Table
from minimax_cal.diagnosing.diagnosis import Diagnosis
from minimax_cal.fitting.accuracy import UNKNOWN_ENDS, Accuracy
from minimax_cal.fitting.cross_validation import describe_too_few_poses, error_intervals
from minimax_cal.fitting.data_slips import describe_implausible_changes
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.multi_instrument.relative_result import RelativeCalibration
from minimax_cal.fitting.region_holdout import RegionHoldout
from minimax_cal.fitting.set_aside_points import describe_points_set_aside
from minimax_cal.instruments.instrument import METRE_UNIT
from minimax_cal.measuring.measurements import SetAsidePoint
from minimax_cal.measuring.pose_groups import cluster_poses
from minimax_cal.measuring.set_aside_points import format_set_aside_count
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.cell import Cell as Arm
from minimax_cal.modelling.effects.effect_names import format_effect
from minimax_cal.modelling.parameters import ParameterNames, flatten_link_parameters
from minimax_cal.reporting.html.deliverable_rows import (
    DeliverableRow,
    describe_whole_model,
    judge_deliverables,
    select_governing_row,
)
from minimax_cal.reporting.html.diagnosis_charts import (
    build_budget_chart,
    build_budget_chart_of_diagnosis,
)
from minimax_cal.reporting.html.error_charts import build_cumulative_error_chart
from minimax_cal.reporting.html.report_content import (
    ChartBlock,
    NoteBlock,
    ReportBlock,
    build_caveat_note,
    build_text_note,
)
from minimax_cal.reporting.html.report_pages import before_and_after_names, split_cause_sentences
from minimax_cal.reporting.html.report_sources import ReportSources, list_named_results
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.status import Status
from minimax_cal.validation.tolerance import (
    LIMIT_KIND_NAMES,
    NOT_PASSED,
    PASSED,
    REFUSAL_REASONS,
    AccuracyClaim,
    ErrorBound,
    LimitJudgement,
    ToleranceLimit,
    build_inside_claim,
    build_outside_claim,
    describe_other_claim,
    judge_limit_by_claim,
    overall_verdict,
)

MAX_NAMED_EFFECT_KINDS = 5  # more kinds of effects than this are counted, not listed
MAX_SHOWN_REASONS = 3  # why points were set aside
NOTHING_SET_ASIDE_TEXT = "No measured point was set aside."
NO_REQUIREMENT_TEXT = (
    "No requirement was given: the result is stated, and nothing is passed or failed."
)
UNKNOWN_CAUSE_TEXT = (
    "The cause of the remaining error is not known: diagnose the same measurements."
)


@dataclass(frozen=True)
class ReportJudgement:
    """The judgement of a report.  claims: inside, then outside where there is one.

    implausible_links: links that no whole arm changes so much, empty where there are none.  rows:
    of what leaves the house; governing_row: that of them which is judged, None where the result
    itself is. set_aside: points that take no part; claim_with_set_aside: the claim inside where
    they count, None without any; judgements_with_set_aside: the requirements against their bounds.
    set_aside_sentences: what any of the results sets aside, in sentences.  claim_name: the claim
    that is judged.  error_table: by file, where they are no lengths.
    """

    model: str
    claims: tuple[AccuracyClaim, ...]
    judgements: tuple[LimitJudgement, ...]
    implausible_links: str = ""
    rows: tuple[DeliverableRow, ...] = ()
    governing_row: DeliverableRow | None = None
    set_aside: tuple[SetAsidePoint, ...] = ()
    claim_with_set_aside: AccuracyClaim | None = None
    judgements_with_set_aside: tuple[LimitJudgement, ...] = ()
    claim_name: str = "inside"
    set_aside_sentences: tuple[str, ...] = ()
    error_table: Table | None = None

    @property
    def verdict(self) -> str:
        """passed, not passed or not stated; empty without a requirement."""
        return overall_verdict(self.judgements) if self.judgements else ""

    @property
    def validity_sentence(self) -> str:
        """What the result holds for, in a sentence; empty where it is of geometry alone."""
        if self.governing_row is None:
            return ""
        rest = ""
        if any(row.delivered.not_carried for row in self.rows if row is not self.governing_row):
            rest = "; other deliverables are judged below"
        return f"Result and verdict hold for {self.governing_row.name} ({self.model}){rest}."

    @property
    def passes_only_without_set_aside(self) -> bool:
        """Whether it is passed only without the points that were set aside."""
        return bool(self.verdict == PASSED and self.judgements_with_set_aside) and (
            overall_verdict(self.judgements_with_set_aside) != PASSED
        )

    @property
    def requirement_verdict_sentence(self) -> str:
        """The verdict on the requirement, and whether it needs points set aside."""
        if not self.verdict:
            return NO_REQUIREMENT_TEXT
        of = f" for {self.governing_row.short}" if self.governing_row else ""
        if self.verdict != PASSED:
            return f"{self.verdict}{of}"
        if not self.passes_only_without_set_aside:
            return f"{PASSED} {self.claim_name} the measured region{of}"
        with_all = overall_verdict(self.judgements_with_set_aside)
        worst = next(one for one in self.judgements_with_set_aside if one.verdict == with_all)
        them = "it" if len(self.set_aside) == 1 else "them"
        return (
            f"{PASSED}{of} without {format_set_aside_count(self.set_aside)}; with {them} "
            f"{LIMIT_KIND_NAMES[worst.limit.kind]} {worst.bound.value:.3f} mm: {with_all}"
        )

    @property
    def warning_sentences(self) -> list[str]:
        """What a requirement that is passed should not hide: a claim above it, another arm."""
        pairs = ((one, claim) for one in self.judgements for claim in self.claims)
        other = (
            f"Implausibly large changes: {self.implausible_links}"
            f": the robot file may be another arm's"
        )
        return [
            said for said in (describe_other_claim(one, claim) for one, claim in pairs) if said
        ] + ([other] if self.implausible_links else [])

    @property
    def verdict_style(self) -> str:
        """How the verdict looks: passed, failed or unstated."""
        kind = {PASSED: "passed", NOT_PASSED: "failed"}.get(self.verdict, "unstated")
        return "unstated" if self.passes_only_without_set_aside else kind

    def list_terminal_lines(self) -> list[str]:
        """For a terminal, beside the table."""
        said = [one.sentence() for one in self.judgements]
        if not self.judgements:
            return [self.requirement_verdict_sentence, *self.set_aside_sentences]
        told = [self.validity_sentence] if self.governing_row else []
        return [
            self.requirement_verdict_sentence,
            *said,
            *self.set_aside_sentences,
            *told,
            *self.deliverable_sentences,
            *self.warning_sentences,
        ]

    @property
    def deliverable_sentences(self) -> list[str]:
        """What each deliverable holds, and what the whole model does; empty without any."""
        return (
            [
                *(row.describe_missing_effects() for row in self.rows),
                describe_whole_model(self.rows),
            ]
            if self.rows
            else []
        )

    def tables(self) -> tuple[Table, ...]:
        """For a terminal."""
        return (build_result_table(self),)

    @property
    def failed_requirements(self) -> str:
        """What of the requirement is not passed."""
        return "; ".join(one.sentence() for one in self.judgements if one.verdict == NOT_PASSED)


class StepClaims(NamedTuple):
    """Model and claims of a step of a diagnosis."""

    model: str
    claims: tuple[AccuracyClaim, ...]


class ResultCells(NamedTuple):
    """Cells of a row of the result: errors [mm], and the 95 % interval."""

    before: float
    result: float
    interval: str


def judge_sources(
    sources: ReportSources,
    limits: tuple[ToleranceLimit, ...],
    claim_name: str,
    step_number: int | None,
    deliverable_names: Sequence[str] = (),
) -> ReportJudgement:
    """The claims of a result, and the requirements against the one that is named.

    claim_name: inside or outside.  step_number: of a diagnosis.  deliverable_names: what is judged
    of the result, as of `deliverable_names`; where it holds effects and nothing is named, corrected
    targets: no file of a robot reaches what it says.  Raises OptionError.
    """
    if step_number is not None and not (sources.gap and not sources.fit):
        raise OptionError("step: only a report of a diagnosis alone has steps")
    if sources.fit:
        model, claims = describe_fit_model(sources.fit), build_fit_claims(sources.fit)
    elif sources.gap:
        model, claims = build_claims_at_step(sources.gap, step_number)
    else:
        model, claims = "calibration without coordinates", (build_relative_claim(sources),)
    own, fit = sources.fit or sources.gap or sources.relative, sources.fit
    claims = refuse_claims_by_status(claims, own.status) if own else claims
    odd = describe_implausible_links(fit.nominal.robot, fit.cell.robot) if fit else ""
    rows = judge_deliverables(
        sources, deliverable_names, step_number, limits, claim_name, build_fit_claims, claims
    )
    aside = describe_set_aside_points(sources)
    if row := select_governing_row(rows, bool(deliverable_names)):
        model = describe_geometry_and_effects(row.delivered.cell)
        found = ReportJudgement(
            model,
            row.claims,
            row.judgements,
            odd,
            rows,
            row,
            claim_name=claim_name,
            set_aside_sentences=aside,
        )
        return add_judgement_with_set_aside(found, sources, limits, claim_name)
    chosen = next((claim for claim in claims if claim.name == claim_name), None)
    if chosen is None:
        chosen = build_outside_claim(RegionHoldout(reason="this result makes no such claim"))
    judged = tuple(judge_limit_by_claim(limit, chosen) for limit in limits)
    told = sources.relative
    errors = told.error_table() if told and told.units != (METRE_UNIT,) else None
    found = ReportJudgement(
        model,
        claims,
        judged,
        odd,
        claim_name=claim_name,
        set_aside_sentences=aside,
        error_table=errors,
    )
    return add_judgement_with_set_aside(found, sources, limits, claim_name)


def add_judgement_with_set_aside(
    judgement: ReportJudgement,
    sources: ReportSources,
    limits: tuple[ToleranceLimit, ...],
    claim_name: str,
) -> ReportJudgement:
    """The judgement beside that with the points that were set aside, where there are any.

    claim_name: inside or outside.
    """
    result = sources.fit or sources.gap
    if result is None or not result.set_aside:
        return judgement
    inside = bound_claim_with_set_aside(judgement.claims[0], result.with_them)
    chosen = next((claim for claim in judgement.claims if claim.name == claim_name), inside)
    also = replace(chosen, rms=inside.rms, largest=inside.largest)
    with_all = (
        tuple(judge_limit_by_claim(limit, also) for limit in limits) if result.with_them else ()
    )
    return replace(
        judgement,
        set_aside=result.set_aside,
        claim_with_set_aside=inside,
        judgements_with_set_aside=with_all,
    )


def bound_claim_with_set_aside(
    claim: AccuracyClaim, accuracy_with_set_aside: Accuracy | None
) -> AccuracyClaim:
    """A claim inside, where the points that were set aside count."""
    if accuracy_with_set_aside is None:
        return claim
    (least, rms), (low, largest) = (
        accuracy_with_set_aside.rms_ci95_mm or UNKNOWN_ENDS,
        accuracy_with_set_aside.max_ci95_mm or UNKNOWN_ENDS,
    )
    bounds = (
        ErrorBound(accuracy_with_set_aside.rms_mm, rms, least),
        ErrorBound(accuracy_with_set_aside.max_mm, largest, low),
    )
    return replace(claim, rms=bounds[0], largest=bounds[1])


def describe_set_aside_points(sources: ReportSources) -> tuple[str, ...]:
    """What each result sets aside; once where calibration and diagnosis say the same."""
    said = {
        kind: describe_set_aside_of_result(result)
        for kind, result in list_named_results(sources)
        if result.set_aside
    }
    if len(said) == len(list_named_results(sources)) and len(set(said.values())) == 1:
        return tuple(set(said.values()))
    return tuple(f"In the {kind}: {text}" for kind, text in said.items())


def describe_set_aside_of_result(result: Fit | Diagnosis | RelativeCalibration) -> str:
    """How many points a result sets aside, by whom, why, and its error with them."""
    reasons = Counter(point.why for point in result.set_aside).most_common()
    why = "; ".join(f"{text} ({count})" for text, count in reasons[:MAX_SHOWN_REASONS])
    more = (
        f"; {len(reasons) - MAX_SHOWN_REASONS} more reasons"
        if len(reasons) > MAX_SHOWN_REASONS
        else ""
    )
    seen = None if isinstance(result, RelativeCalibration) else result.with_them
    return f"{describe_points_set_aside(result.set_aside, seen)} Why: {why}{more}."


def refuse_claims_by_status(
    claims: tuple[AccuracyClaim, ...], status: Status
) -> tuple[AccuracyClaim, ...]:
    """The claims of a result, of which nothing is passed where it has failed or is no better."""
    return tuple(replace(claim, refused=REFUSAL_REASONS.get(status, "")) for claim in claims)


def describe_implausible_links(nominal: Robot, calibrated: Robot) -> str:
    """Links that no whole arm changes so much; empty where there are none."""
    change = flatten_link_parameters(calibrated.mdh - nominal.mdh)
    return describe_implausible_changes(
        ParameterNames.for_robot(nominal, ()), change, nominal.reach()
    )


def describe_fit_model(fit: Fit) -> str:
    """What the calibration holds, in words."""
    return describe_geometry_and_effects(fit.cell)


def describe_geometry_and_effects(cell: Arm) -> str:
    """Geometry and the kinds of effects of an arm."""
    terms = list(dict.fromkeys(format_effect(term.effect) for term in cell.effects.terms))
    if len(terms) > MAX_NAMED_EFFECT_KINDS:
        return f"geometry and {len(terms)} kinds of effects"
    return f"geometry, {', '.join(terms)}" if terms else "geometry alone"


def build_fit_claims(fit: Fit) -> tuple[AccuracyClaim, ...]:
    """Of a calibration."""
    seen = fit.within
    held = fit.accuracy["holdout"].poses > 0 or bool(fit.error_crossed.size)
    inside = build_inside_claim(
        seen.where,
        seen.before,
        seen.after,
        (seen.rms, seen.largest),
        seen.poses,
        seen.missed,
    )
    if not held:
        inside = AccuracyClaim("inside", inside.rms, inside.largest, 0, seen.where, inside.before,
                       "no pose was held out, and training errors are too small")  # fmt: skip
    return refuse_claims_by_status((inside, build_outside_claim(fit.beyond)), fit.status)


def build_claims_at_step(diagnosis: Diagnosis, step_number: int | None) -> StepClaims:
    """What a step of a diagnosis holds, and its claims.  Raises OptionError."""
    rungs = diagnosis.rungs()
    last = len(rungs) - 1
    if step_number is not None and not 0 <= step_number <= last:
        names = ", ".join(f"{i} ({name})" for i, (name, _) in enumerate(rungs)) or "the last alone"
        raise OptionError(f"the diagnosis has no step {step_number}; it has {names}")
    at = last if step_number is None else step_number
    step = (
        diagnosis.ladder[0]
        if rungs and at == 0
        else diagnosis.ladder[len(diagnosis.ladder) - 1 - (last - at)]
    )
    if rungs and diagnosis.data.poses:
        error = rungs[at][1].error(add_history_columns(diagnosis.data))[diagnosis.held]
    else:
        error = diagnosis.errors[1][diagnosis.held] if diagnosis.data.poses else np.zeros((0, 1, 3))
    group = cluster_poses(diagnosis.data)[diagnosis.held] if len(error) else np.zeros(0)
    ends = error_intervals(error, group, 0)
    where = f"{step.holdout.poses} poses that were not used for the fit"
    poses = len(np.unique(group)) or step.holdout.poses
    plain = {"nominal": "the nominal robot", "geometric": "geometry alone"}
    model = plain.get(step.name) or describe_geometry_and_effects(
        rungs[at][1] if rungs else diagnosis.cells[-1]
    )
    claims = [build_inside_claim(where, diagnosis.ladder[0].holdout, step.holdout, ends, poses)]
    if at == last:
        claims.append(build_outside_claim(diagnosis.beyond))
    return StepClaims(model, tuple(claims))


def build_relative_claim(sources: ReportSources) -> AccuracyClaim:
    """Of a calibration without coordinates, whose errors are not those of positions."""
    told = sources.relative
    if told is None:
        raise CalibrationError("a report needs a result")
    before, after, where = told.before_and_after()
    claim = build_inside_claim(where, before, after)
    if told.words.of_position:
        return claim
    return AccuracyClaim(claim.name, claim.rms, claim.largest, claim.poses, where, claim.before,
                 f"errors of {told.kind} are not errors of position")  # fmt: skip


# ---- what stands on the page -------------------------------------------------------------------


def build_first_page_blocks(
    sources: ReportSources, judgement: ReportJudgement
) -> tuple[ReportBlock, ...]:
    """Verdict, cause, results, what was set aside, and a picture."""
    kind = judgement.verdict_style
    alarm = "caveat" if kind == "passed" else "warning"  # nothing is red under what is passed
    lines: list[ReportBlock] = [
        NoteBlock(
            capitalise_sentence(judgement.requirement_verdict_sentence),
            f"banner {kind}" if judgement.verdict else "text",
        ),
        *describe_cause(sources),
        build_result_table(judgement),
        build_text_note(describe_basis_of_numbers(judgement)),
        *(
            [build_text_note(" ".join(judgement.deliverable_sentences))]
            if judgement.deliverable_sentences
            else []
        ),
        *(NoteBlock(f"{said}.", alarm) for said in judgement.warning_sentences),
    ]
    if sources.results or sources.relative:
        lines += [NoteBlock(said, alarm) for said in judgement.set_aside_sentences]
        none = () if judgement.set_aside_sentences else (NOTHING_SET_ASIDE_TEXT,)
        lines += (
            [build_text_note(" ".join(said))]
            if (said := (*none, *describe_kept_outliers(sources)))
            else []
        )
    lines += [
        build_text_note(one.sentence() + ".")
        for one in judgement.judgements
        if not one.is_explained_by_numbers
    ]
    lines += [build_text_note(which) for which in explain_which_model_is_signed(sources, judgement)]
    lines += [NoteBlock(notice, alarm) for notice in sources.notices]
    wrong = warn_of_fit_quality(sources.fit) if sources.fit else ()
    if sources.gap and not sources.fit:
        wrong = warn_of_status(sources.gap.status, "")
    lines += [build_caveat_note(one.text) if kind == "passed" else one for one in wrong]
    return (
        tuple(lines)
        if judgement.error_table
        else (*lines, build_first_page_chart(sources, judgement))
    )


def describe_cause(sources: ReportSources) -> Iterator[NoteBlock]:
    """The cause with its share, and the joint that it turns most; how to find it where unknown."""
    fit = sources.fit
    few = (
        describe_too_few_poses(fit.train, int(fit.identification.active.sum()))
        if fit and fit.data.poses
        else ""
    )
    if found := sources.gap or sources.causes:
        (first, *others), _ = split_cause_sentences(found)
        yield NoteBlock(first, "verdict")
        yield from [build_text_note(" ".join(others))] if others else []
    elif few:
        yield build_text_note(f"What limits it now: {few}.")
    elif fit and fit.cell.effects.cause_terms:
        yield build_text_note(
            f"The model holds {describe_fit_model(fit)}; what each explains is in the diagnosis."
        )
    else:
        yield build_text_note(UNKNOWN_CAUSE_TEXT)
    yield from map(build_text_note, describe_most_rotated_joint(sources))


def describe_most_rotated_joint(sources: ReportSources) -> Iterator[str]:
    """The joint that effects turn most, in degrees, and the pose; nothing where none turns one."""
    if sources.joint_rotations_by_effects:
        data, turn = sources.joint_rotations_by_effects
        pose, joint = np.unravel_index(np.argmax(turn), turn.shape)
        at = ", ".join(
            f"{1e3 * q:.0f} mm" if slides else f"{np.degrees(q):.0f}"
            for q, slides in zip(data.q[pose], data.sliding, strict=True)
        )
        most = turn[pose, joint]
        yield (
            f"Worst joint: joint {joint + 1}, turned {np.degrees(most):.3f} degrees "
            f"({1e3 * most:.2f} mrad) by all effects at its worst pose "
            f"({data.row_name(int(pose))}; joints at {at} deg)."
        )


def describe_kept_outliers(sources: ReportSources) -> Iterator[str]:
    """Which points stand out and yet take part."""
    if sources.fit and sources.fit.suspects:
        fit = sources.fit
        most = sorted(fit.suspects, key=lambda one: -one.distance)
        names = [f"{fit.data.called(s.line)} {s.target} {1e3 * s.distance:.2f} mm" for s in most]
        many = "1 outlier was" if len(names) == 1 else f"{len(names)} outliers were"
        where = format_first_names(names, MAX_NAMED_EFFECT_KINDS)
        counts = "count in the result" if any(one.held for one in most) else (
            "the limits inside are of poses without such"
        )  # fmt: skip
        yield f"{many} kept, and {counts}: {where}."


def build_first_page_chart(sources: ReportSources, judgement: ReportJudgement) -> ChartBlock:
    """How far each step brings the error down, or of how many points."""
    if sources.gap:
        return build_budget_chart_of_diagnosis(sources.gap)
    if sources.poses:
        return build_cumulative_error_chart(sources.poses, before_and_after_names(sources))
    inside = judgement.claims[0]
    after = (judgement.model, inside.rms.value, inside.largest.value)
    return build_budget_chart("ladder", [("nominal arm", *inside.before), after])


def build_result_table(judgement: ReportJudgement) -> Table:
    """Of each deliverable: before, result, its 95 % interval, what is required, verdict.

    Errors that are no lengths stand by file, in their units.
    """
    if judgement.error_table:
        return judgement.error_table
    groups = [(row.short, row.claims, row.judgements) for row in judgement.rows]
    groups = groups or [("", judgement.claims, judgement.judgements)]
    rows: list[tuple[object, ...]] = []
    for name, claims, judged in groups:
        said = {one.limit.kind: one.verdict for one in judged}
        for claim in claims:
            inside = claim.name == "inside"
            if claim.reason and not inside:
                continue
            for i, (kind, title) in enumerate(LIMIT_KIND_NAMES.items()):
                if not inside and i and name != groups[0][0]:
                    continue  # in the words of `export`; the page has no room for all
                which = "inside" if inside else f"outside ({claim.regions[i]})"
                verdict = said.get(kind, "") if claim.name == judgement.claim_name else ""
                sizes = format_result_cells(claim.before[i], claim.bound(kind))
                poses = claim.sets[i] or ""
                rows.append((name, f"{title}, {which}", poses, *sizes, verdict))
    if (all_of := judgement.claim_with_set_aside) is not None:
        rows += [
            (groups[0][0], f"{title}, inside, with {len(judgement.set_aside)} points set aside", "",
             *format_result_cells(before, all_of.bound(kind)), "")
            for (kind, title), before in zip(LIMIT_KIND_NAMES.items(), all_of.before, strict=True)
        ]  # fmt: skip
    columns = "before .3f | result .3f | 95 % interval | verdict"
    title = f"{'Result by deliverable' if judgement.rows else f'Model: {judgement.model}'} [mm]"
    limits = [
        f"{LIMIT_KIND_NAMES[one.limit.kind]} at most {one.limit.size_mm:g}"
        for one in judgement.judgements
    ]
    title += f"; required: {', '.join(limits)}" if limits else ""
    what = "error" if judgement.claims[0].reason else "error of position"
    every = Table.from_rows(title, rows, f"of | {what} | poses d | {columns}")
    first, last = (0 if judgement.rows else 1), (7 if judgement.judgements else 6)
    return every.select_columns(*range(first, last))


def format_result_cells(before: float, bound: ErrorBound) -> ResultCells:
    """Cells of a row: before, result, its interval."""
    most = bound.high if bound.high > bound.value else math.nan  # what was seen is no limit
    low, high = ("" if math.isnan(end) else f"{end:.3f}" for end in (bound.low, most))
    interval = f"{low or 'up'} to {high}" if high else f"from {low}" if low else ""
    return ResultCells(before, bound.value, interval)


def describe_basis_of_numbers(judgement: ReportJudgement) -> str:
    """What the numbers rest on."""
    inside = judgement.claims[0]
    out = f"Inside: {inside.where}. "
    away = judgement.claims[1] if len(judgement.claims) > 1 else None
    if away and not away.reason:
        out += f"Outside: {away.where}. "
    elif away:
        out += f"Outside them nothing is claimed: {away.reason}. "
    out += "With 95 % confidence as many new poses stay below the upper ends."
    told = [claim for claim in judgement.claims if not claim.reason]
    if any(math.isnan(claim.bound(kind).high) for claim in told for kind in LIMIT_KIND_NAMES):
        out += " A dash: the poses are too few, or too unlike each other, to tell a limit."
    return out


def warn_of_fit_quality(fit: Fit) -> tuple[NoteBlock, ...]:
    """What nobody should sign without having read it."""
    held, notes = fit.accuracy["holdout"], []
    if not held.poses:
        notes.append(
            build_caveat_note(
                "No pose was held out: these numbers were reached on the poses of the fit and are "
                "too good for new ones."
            )
        )
    elif not held.rms_mm < fit.accuracy["nominal"].rms_mm:
        notes.append(
            NoteBlock(
                "On poses not used for the fit, the calibration is no improvement.", "warning"
            )
        )
    return (*notes, *warn_of_status(fit.status, fit.reason or fit.status.advice))


def warn_of_status(status: str, advice: str) -> tuple[NoteBlock, ...]:
    """A warning where the numbers did not work out."""
    if status == "converged":
        return ()
    if Status(status).keeps_drawn:
        return (NoteBlock(f"{advice}.", "warning"),)
    tail = f": {advice}." if advice else "."
    return (NoteBlock(f"The fit did not converge ({status.replace('_', ' ')}){tail}", "warning"),)


def explain_which_model_is_signed(sources: ReportSources, judgement: ReportJudgement) -> list[str]:
    """Where fit and diagnosis hold different models: which one is signed."""
    fit, gap = sources.fit, sources.gap
    if not (fit and gap):
        return []
    held = {term.effect for term in fit.cell.effects.terms}
    if all(f.term.effect in held for f in gap.effects if f.established and not f.rows):
        return []
    last, _ = build_claims_at_step(gap, None)
    return [
        f"Signed is the calibration ({judgement.model}), which "
        f"leaves confirmed causes out. With them "
        f"({last}) the RMS on held-out poses is {gap.ladder[-1].holdout.rms_mm:.3f} mm."
    ]
