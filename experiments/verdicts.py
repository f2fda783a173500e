"""One line of the table of verdicts: an item of a paper, its figure, ours, and what follows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from minimax_cal.ground.tables import Table

HEADER = ("item", "command", "paper", "ours", "verdict", "remark", "claims", "held", "failed")
HOLDS, YES, PARTLY, NO = "holds", "reproduced", "reproduced in part", "not reproduced"
MISSING = "not covered"  # for want of hardware, which the remark names
TOO_FEW = "too few to say"  # of a quick run, or where nothing could be asked
VERDICTS = (HOLDS, YES, PARTLY, NO, MISSING, TOO_FEW)
ENOUGH = 20  # starts, splits or arms that a quick run needs for a verdict on them
NEAR = 0.25  # of the printed figure, both ways, that counts as reproducing it


@dataclass(frozen=True)
class Claim:
    """A statement of a paper about one figure, and whether the figure of this run bears it out."""

    text: str
    holds: bool


@dataclass(frozen=True)
class Verdict:
    """A line; the verdict follows from its claims by one rule, that of `verdict_of`.

    command: the study that prints ours.  paper, ours: figures in words.  claims: one for each
    figure, arm or method that the item speaks of.  exact: a formula, which holds or does not.
    cases: how many starts, splits, copies or arms are behind it; 0 where it is the same whatever
    the run.  quick: a run too small for a verdict on few cases.
    """

    item: str
    command: str
    paper: str
    ours: str
    claims: tuple[Claim, ...] = ()
    remark: str = ""
    cases: int = 0
    exact: bool = False
    quick: bool = False

    @property
    def verdict(self) -> str:
        """One of `VERDICTS`."""
        if self.command == "-":
            return MISSING
        if self.quick and 0 < self.cases < ENOUGH:
            return TOO_FEW
        found = verdict_of(self.claims)
        return {YES: HOLDS, PARTLY: NO}.get(found, found) if self.exact else found

    def cells(self) -> tuple[str, ...]:
        """A row under `HEADER`."""
        held, failed = (
            "; ".join(claim.text for claim in self.claims if claim.holds == which)
            for which in (True, False)
        )
        count = sum(claim.holds for claim in self.claims)
        told = f"{count} of {len(self.claims)}" if self.claims else ""
        return (self.item, self.command, self.paper, self.ours, self.verdict, self.remark, told,
                held, failed)  # fmt: skip


def verdict_of(claims: Sequence[Claim]) -> str:
    """Reproduced: all claims hold; in part: more than half; not: no more than half."""
    if not claims:
        return TOO_FEW
    held = sum(claim.holds for claim in claims)
    return YES if held == len(claims) else PARTLY if 2 * held > len(claims) else NO


def by_name(text: str, pairs: Iterable[tuple[str, bool]]) -> tuple[Claim, ...]:
    """A claim for each pair of a name, which replaces {} in the text, and whether it holds."""
    return tuple(Claim(text.format(name), bool(holds)) for name, holds in pairs)


def near(ours: float, printed: float, share: float = NEAR) -> bool:
    """Whether a figure is within a share of the printed one, both ways."""
    return abs(ours / printed - 1.0) <= share


def listed(values: Iterable[float], form: str = ".2f") -> str:
    """As 1.00 / 2.00."""
    return " / ".join(format(value, form) for value in values)


def hardware(item: str, paper: str, needs: str) -> Verdict:
    """What cannot be covered without a machine that we have not got."""
    return Verdict(item, "-", paper, "-", remark=f"hardware we lack: {needs}")


def table_of(verdicts: Sequence[Verdict]) -> Table:
    """All verdicts, each with the claims that held and that failed."""
    return Table("the two papers, item by item", HEADER, tuple(v.cells() for v in verdicts))
