"""The requirement against what leaves the house: files, or corrected targets, by their own fits."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from minimax_cal.correcting.deliverable import COMPENSATED, Delivered, deliver_or_explain
from minimax_cal.fitting.fit import Fit
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.words import capitalise
from minimax_cal.judging.tolerance import (
    NOT_PASSED,
    NOT_STATED,
    Bound,
    Claim,
    Judgement,
    Limit,
    judge,
    overall,
)
from minimax_cal.reporting.html.sources import Sources
from minimax_cal.solvers.status import Status

USUAL = (COMPENSATED, "urdf", "mjcf")  # where none is named: all that joints correct, and no effect
NOWHERE = Bound(math.nan, math.nan)
CORRECTED = "joint targets corrected by minimax-cal compensate"
SHORT = "corrected targets"

Claims = tuple[Claim, ...]


@dataclass(frozen=True, eq=False)
class Row:
    """One deliverable.  claims: inside, then outside.  judged: each requirement against them."""

    delivered: Delivered
    claims: Claims
    judged: tuple[Judgement, ...]

    @property
    def name(self) -> str:
        """For people."""
        to = self.delivered.format
        return CORRECTED if to == COMPENSATED else f"the {to} file of minimax-cal export"

    @property
    def short(self) -> str:
        """In a table."""
        to = self.delivered.format
        return SHORT if to == COMPENSATED else f"{to} file"

    def said(self) -> str:
        """What it does not hold of the whole model, in a sentence."""
        own, name = self.delivered, capitalise(self.short)
        if own.reason or own.unmade:
            return f"{own.sentence()}."
        return f"{name}: {f'cannot hold {own.lacks}' if own.lacks else 'all of the model'}."

    @property
    def verdict(self) -> str:
        """passed, not passed or not stated; empty without a requirement."""
        return overall(self.judged) if self.judged else ""


def rows_of(
    sources: Sources,
    names: Sequence[str],
    rung: int | None,
    limits: Sequence[Limit],
    which: str,
    claims_of: Callable[[Fit], Claims],
    as_it_is: Claims,
) -> tuple[Row, ...]:
    """Each deliverable against the requirements; a file that cannot be made is a row that says why.

    names: as of `deliver`; the usual ones where nothing is named and the result has effects.
    as_it_is: the claims of the result itself.  Raises OptionError.
    """
    source = sources.fit or sources.gap
    if source is None:
        if names:
            raise OptionError("deliver: lengths alone tell no accuracy of a file; leave it out")
        return ()
    if not names and (source.status is Status.FAILED or not has_effects(sources, rung)):
        return ()
    out = []
    for name in names or USUAL:
        found = deliver_or_explain(source, name, rung)
        claims = as_it_is
        if why := found.reason or found.unmade:
            claims = tuple(
                Claim(claim.name, NOWHERE, NOWHERE, 0, "", reason=why) for claim in as_it_is
            )
        elif found.fit and found.fit is not source:
            claims = claims_of(found.fit)
        claims = tuple(claim_of_file(claim, found) for claim in claims)
        chosen = next((claim for claim in claims if claim.name == which), None)
        if chosen is None:
            why = "this result makes no such claim"
            chosen = Claim(which, NOWHERE, NOWHERE, 0, "", reason=why)
        out.append(Row(found, claims, tuple(judge(limit, chosen) for limit in limits)))
    return tuple(out)


def whole(rows: Sequence[Row]) -> str:
    """How the whole model does beside its deliverables, and what makes these."""
    size = rows[0].delivered.whole
    has = "" if math.isnan(size.rms) else (
        f"The whole model has RMS {size.rms:.3f} mm, largest {size.largest:.3f} mm. "
    )  # fmt: skip
    return f"{has}minimax-cal compensate corrects targets, minimax-cal export writes files."


def claim_of_file(claim: Claim, made: Delivered) -> Claim:
    """What is claimed of a file, where that of its fit is known."""
    rms, largest = claim.rms, claim.largest
    return replace(
        claim,
        rms=Bound(*map(made.rms_of_file, (rms.value, rms.high, rms.low))),
        largest=Bound(*map(made.largest_of_file, (largest.value, largest.high, largest.low))),
    )


def has_effects(sources: Sources, rung: int | None) -> bool:
    """Whether the result holds more than geometry."""
    if sources.fit:
        return bool(sources.fit.cell.effects.causes)
    gap = sources.gap
    rungs = [cell for _, cell in gap.rungs()] if gap else []
    if not rungs:
        return False
    at = len(rungs) - 1 if rung is None else rung
    return 0 <= at < len(rungs) and bool(rungs[at].effects.causes)


def governing(rows: Sequence[Row], named: bool) -> Row | None:
    """That which the verdict is of: of those named the worst, else the first that can be made."""
    if not rows:
        return None
    if not named:
        return next((row for row in rows if not row.delivered.unmade), rows[0])
    for verdict in (NOT_PASSED, NOT_STATED):
        for row in rows:
            if row.verdict == verdict:
                return row
    return rows[0]
