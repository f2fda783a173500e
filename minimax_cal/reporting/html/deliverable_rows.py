"""The requirement against what leaves the house: files, or corrected targets, by their own fits."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from minimax_cal.compensation.deliverable import (
    COMPENSATED_TARGETS,
    Delivered,
    deliver_or_describe_failure,
)
from minimax_cal.core.display_text import capitalise_sentence
from minimax_cal.core.errors import OptionError
from minimax_cal.fitting.fit import Fit
from minimax_cal.reporting.html.report_sources import ReportSources
from minimax_cal.solvers.status import Status
from minimax_cal.validation.tolerance import (
    NOT_PASSED,
    NOT_STATED,
    AccuracyClaim,
    ErrorBound,
    LimitJudgement,
    ToleranceLimit,
    judge_limit_by_claim,
    overall_verdict,
)

DEFAULT_REPORTED_DELIVERABLES = (
    COMPENSATED_TARGETS,
    "urdf",
    "mjcf",
)  # where none is named: all that joints correct, and no effect
UNKNOWN_BOUND = ErrorBound(math.nan, math.nan)
CORRECTED_TARGETS_NAME = "joint targets corrected by minimax-cal compensate"
CORRECTED_TARGETS_SHORT_NAME = "corrected targets"

AccuracyClaims = tuple[AccuracyClaim, ...]


@dataclass(frozen=True, eq=False)
class DeliverableRow:
    """One deliverable.  claims: inside, then outside.  judgements: each requirement against
    them.
    """

    delivered: Delivered
    claims: AccuracyClaims
    judgements: tuple[LimitJudgement, ...]

    @property
    def name(self) -> str:
        """For people."""
        to = self.delivered.format
        return (
            CORRECTED_TARGETS_NAME
            if to == COMPENSATED_TARGETS
            else f"the {to} file of minimax-cal export"
        )

    @property
    def short(self) -> str:
        """In a table."""
        to = self.delivered.format
        return CORRECTED_TARGETS_SHORT_NAME if to == COMPENSATED_TARGETS else f"{to} file"

    def describe_missing_effects(self) -> str:
        """What it does not hold of the whole model, in a sentence."""
        own, name = self.delivered, capitalise_sentence(self.short)
        if own.reason or own.unmade:
            return f"{own.sentence()}."
        return f"{name}: {f'cannot hold {own.lacks}' if own.lacks else 'all of the model'}."

    @property
    def verdict(self) -> str:
        """passed, not passed or not stated; empty without a requirement."""
        return overall_verdict(self.judgements) if self.judgements else ""


def judge_deliverables(
    sources: ReportSources,
    format_names: Sequence[str],
    step_number: int | None,
    limits: Sequence[ToleranceLimit],
    claim_name: str,
    build_claims: Callable[[Fit], AccuracyClaims],
    result_claims: AccuracyClaims,
) -> tuple[DeliverableRow, ...]:
    """Each deliverable against the requirements; a file that cannot be made is a row that says why.

    format_names: as of `deliver`; the usual ones where nothing is named and the result has effects.
    result_claims: the claims of the result itself.  Raises OptionError.
    """
    source = sources.fit or sources.gap
    if source is None:
        if format_names:
            raise OptionError("deliver: lengths alone tell no accuracy of a file; leave it out")
        return ()
    if not format_names and (
        source.status is Status.FAILED or not has_effects_at_step(sources, step_number)
    ):
        return ()
    out = []
    for name in format_names or DEFAULT_REPORTED_DELIVERABLES:
        found = deliver_or_describe_failure(source, name, step_number)
        claims = result_claims
        if why := found.reason or found.unmade:
            claims = tuple(
                AccuracyClaim(claim.name, UNKNOWN_BOUND, UNKNOWN_BOUND, 0, "", reason=why)
                for claim in result_claims
            )
        elif found.fit and found.fit is not source:
            claims = build_claims(found.fit)
        claims = tuple(adapt_claim_to_file(claim, found) for claim in claims)
        chosen = next((claim for claim in claims if claim.name == claim_name), None)
        if chosen is None:
            why = "this result makes no such claim"
            chosen = AccuracyClaim(claim_name, UNKNOWN_BOUND, UNKNOWN_BOUND, 0, "", reason=why)
        out.append(
            DeliverableRow(
                found, claims, tuple(judge_limit_by_claim(limit, chosen) for limit in limits)
            )
        )
    return tuple(out)


def describe_whole_model(rows: Sequence[DeliverableRow]) -> str:
    """How the whole model does beside its deliverables, and what makes these."""
    size = rows[0].delivered.whole
    has = "" if math.isnan(size.rms) else (
        f"The whole model has RMS {size.rms:.3f} mm, largest {size.largest:.3f} mm. "
    )  # fmt: skip
    return f"{has}minimax-cal compensate corrects targets, minimax-cal export writes files."


def adapt_claim_to_file(claim: AccuracyClaim, delivered: Delivered) -> AccuracyClaim:
    """What is claimed of a file, where that of its fit is known."""
    rms, largest = claim.rms, claim.largest
    return replace(
        claim,
        rms=ErrorBound(*map(delivered.rms_of_file, (rms.value, rms.high, rms.low))),
        largest=ErrorBound(
            *map(delivered.largest_of_file, (largest.value, largest.high, largest.low))
        ),
    )


def has_effects_at_step(sources: ReportSources, step_number: int | None) -> bool:
    """Whether the result holds more than geometry."""
    if sources.fit:
        return bool(sources.fit.cell.effects.cause_terms)
    gap = sources.gap
    rungs = [cell for _, cell in gap.rungs()] if gap else []
    if not rungs:
        return False
    at = len(rungs) - 1 if step_number is None else step_number
    return 0 <= at < len(rungs) and bool(rungs[at].effects.cause_terms)


def select_governing_row(
    rows: Sequence[DeliverableRow], is_requested: bool
) -> DeliverableRow | None:
    """That which the verdict is of: of those named the worst, else the first that can be made."""
    if not rows:
        return None
    if not is_requested:
        return next((row for row in rows if not row.delivered.unmade), rows[0])
    for verdict in (NOT_PASSED, NOT_STATED):
        for row in rows:
            if row.verdict == verdict:
                return row
    return rows[0]
