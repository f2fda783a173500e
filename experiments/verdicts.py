"""One line of the table of verdicts: an item of a paper, its figure, ours, and what follows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from minimax_cal.ground.tables import Table

HEADER = ("item", "command", "paper", "ours", "verdict", "remark")
HOLDS, YES, PARTLY, NO = "holds", "reproduced", "reproduced in part", "not reproduced"
MISSING = "not covered"  # for want of hardware, which the remark names
TOO_FEW = "too few to say"  # of a quick run
VERDICTS = (HOLDS, YES, PARTLY, NO, MISSING, TOO_FEW)
ENOUGH = 20  # starts, splits or arms that a quick run needs for a verdict on them
NEAR = 0.25  # of the printed figure, both ways, that counts as reproducing it
ALL_PARTS = "reproduced: all parts of the claim; in part: some"
EXACT = "holds: to the tolerance of the figure"


@dataclass(frozen=True)
class Verdict:
    """A line.

    command: the study that prints ours.  paper, ours: figures in words.  verdict: of VERDICTS.
    rule: what the verdict asks of the figures.  cases: how many starts, splits, copies or arms are
    behind it; 0 where it is the same whatever the run.
    """

    item: str
    command: str
    paper: str
    ours: str
    verdict: str
    remark: str = ""
    rule: str = ""
    cases: int = 0

    @property
    def stated(self) -> str:
        """The rule, with what goes for all of its kind where it has none of its own."""
        if self.rule or self.verdict == MISSING:
            return self.rule
        return EXACT if self.verdict in (HOLDS, NO) and not self.cases else ALL_PARTS

    @property
    def explained(self) -> str:
        """The remark and the rule."""
        rule = f"rule: {self.stated}" if self.stated else ""
        return "; ".join(filter(None, (self.remark, rule)))


def of_quick(verdict: Verdict) -> Verdict:
    """A verdict of a quick run: none on few cases, of which the whole run has more."""
    few = 0 < verdict.cases < ENOUGH
    return replace(verdict, verdict=TOO_FEW) if few else verdict


def near(ours: float, printed: float, share: float = NEAR) -> bool:
    """Whether a figure is within a share of the printed one, both ways."""
    return abs(ours / printed - 1.0) <= share


def told(*truths: bool) -> str:
    """All, some or none of a claim's parts."""
    return YES if all(truths) else PARTLY if any(truths) else NO


def listed(values: Iterable[float], form: str = ".2f") -> str:
    """As 1.00 / 2.00."""
    return " / ".join(format(value, form) for value in values)


def hardware(item: str, paper: str, needs: str) -> Verdict:
    """What cannot be covered without a machine that we have not got."""
    return Verdict(item, "-", paper, "-", MISSING, f"hardware we lack: {needs}")


def table_of(verdicts: Sequence[Verdict]) -> Table:
    """All verdicts, each with its rule at the end of the remark."""
    rows = tuple((v.item, v.command, v.paper, v.ours, v.verdict, v.explained) for v in verdicts)
    return Table("the two papers, item by item", HEADER, rows)
