"""One line of the table of verdicts: an item of a paper, its figure, ours, and what follows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from minimax_cal.core.tables import Table

VERDICT_COLUMNS = (
    "item",
    "command",
    "paper",
    "ours",
    "verdict",
    "remark",
    "claims",
    "held",
    "failed",
)
HOLDS_VERDICT, REPRODUCED_VERDICT, PARTLY_REPRODUCED_VERDICT, NOT_REPRODUCED_VERDICT = (
    "holds",
    "reproduced",
    "reproduced in part",
    "not reproduced",
)
NOT_COVERED_VERDICT = "not covered"  # for want of hardware, which the remark names
TOO_FEW_VERDICT = "too few to say"  # of a quick run, or where nothing could be asked
ALL_VERDICTS = (
    HOLDS_VERDICT,
    REPRODUCED_VERDICT,
    PARTLY_REPRODUCED_VERDICT,
    NOT_REPRODUCED_VERDICT,
    NOT_COVERED_VERDICT,
    TOO_FEW_VERDICT,
)
MIN_CASES_OF_QUICK_VERDICT = (
    20  # starts, splits or arms that a quick run needs for a verdict on them
)
MAX_RELATIVE_DIFFERENCE_FROM_PAPER = (
    0.25  # of the printed figure, both ways, that counts as reproducing it
)


@dataclass(frozen=True)
class PaperClaim:
    """A statement of a paper about one figure, and whether the figure of this run bears it out."""

    text: str
    holds: bool


@dataclass(frozen=True)
class PaperVerdict:
    """A line; the verdict follows from its claims by one rule, that of `verdict_from_claims`.

    command: the study that prints ours.  paper, ours: figures in words.  claims: one for each
    figure, arm or method that the item speaks of.  exact: a formula, which holds or does not.
    cases: how many starts, splits, copies or arms are behind it; 0 where it is the same whatever
    the run.  quick: a run too small for a verdict on few cases.
    """

    item: str
    command: str
    paper: str
    ours: str
    claims: tuple[PaperClaim, ...] = ()
    remark: str = ""
    cases: int = 0
    exact: bool = False
    quick: bool = False

    @property
    def verdict(self) -> str:
        """One of `ALL_VERDICTS`."""
        if self.command == "-":
            return NOT_COVERED_VERDICT
        if self.quick and 0 < self.cases < MIN_CASES_OF_QUICK_VERDICT:
            return TOO_FEW_VERDICT
        found = verdict_from_claims(self.claims)
        return (
            {
                REPRODUCED_VERDICT: HOLDS_VERDICT,
                PARTLY_REPRODUCED_VERDICT: NOT_REPRODUCED_VERDICT,
            }.get(found, found)
            if self.exact
            else found
        )

    def to_table_row(self) -> tuple[str, ...]:
        """A row under `VERDICT_COLUMNS`."""
        held, failed = (
            "; ".join(claim.text for claim in self.claims if claim.holds == which)
            for which in (True, False)
        )
        count = sum(claim.holds for claim in self.claims)
        told = f"{count} of {len(self.claims)}" if self.claims else ""
        return (self.item, self.command, self.paper, self.ours, self.verdict, self.remark, told,
                held, failed)  # fmt: skip


def verdict_from_claims(claims: Sequence[PaperClaim]) -> str:
    """Reproduced: all claims hold; in part: more than half; not: no more than half."""
    if not claims:
        return TOO_FEW_VERDICT
    held = sum(claim.holds for claim in claims)
    return (
        REPRODUCED_VERDICT
        if held == len(claims)
        else PARTLY_REPRODUCED_VERDICT
        if 2 * held > len(claims)
        else NOT_REPRODUCED_VERDICT
    )


def build_claims_by_name(text: str, pairs: Iterable[tuple[str, bool]]) -> tuple[PaperClaim, ...]:
    """A claim for each pair of a name, which replaces {} in the text, and whether it holds."""
    return tuple(PaperClaim(text.format(name), bool(holds)) for name, holds in pairs)


def is_near_printed_figure(
    ours: float, printed: float, max_relative_difference: float = MAX_RELATIVE_DIFFERENCE_FROM_PAPER
) -> bool:
    """Whether a figure is within a share of the printed one, both ways."""
    return abs(ours / printed - 1.0) <= max_relative_difference


def join_values(values: Iterable[float], form: str = ".2f") -> str:
    """As 1.00 / 2.00."""
    return " / ".join(format(value, form) for value in values)


def verdict_for_missing_hardware(item: str, paper: str, needs: str) -> PaperVerdict:
    """What cannot be covered without a machine that we have not got."""
    return PaperVerdict(item, "-", paper, "-", remark=f"hardware we lack: {needs}")


def build_verdicts_table(verdicts: Sequence[PaperVerdict]) -> Table:
    """All verdicts, each with the claims that held and that failed."""
    return Table(
        "the two papers, item by item", VERDICT_COLUMNS, tuple(v.to_table_row() for v in verdicts)
    )
