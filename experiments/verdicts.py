"""One line of the table of verdicts: an item of a paper, its figure, ours, and what follows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass

from minimax_cal.ground.tables import Table

HEADER = ("item", "command", "paper", "ours", "verdict", "remark")
HOLDS, YES, PARTLY, NO = "holds", "reproduced", "reproduced in part", "not reproduced"
MISSING = "not covered"  # for want of hardware, which the remark names
VERDICTS = (HOLDS, YES, PARTLY, NO, MISSING)


@dataclass(frozen=True)
class Verdict:
    """A line.

    command: the study that prints ours.  paper, ours: figures in words.  verdict: of VERDICTS.
    """

    item: str
    command: str
    paper: str
    ours: str
    verdict: str
    remark: str = ""


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
    """All verdicts."""
    rows = tuple(astuple(v) for v in verdicts)
    return Table("the two papers, item by item", HEADER, rows)
