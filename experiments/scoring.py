"""What the blind studies of `diagnose` share: an answer beside the truth, shares, and tables.

An arm is made, a diagnosis sees its two files alone, and what it says is scored by the truth: a row
a case, criteria that are shares of rows with their limits, and the rows that missed them.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeVar

import click
import numpy as np

import minimax_cal as mc
from experiments.gap_cases import DATA, FAULTS, ROBOT, Case, Sealed, Truth, write
from experiments.record import interval
from experiments.sweep import Study, study_options
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row = dict[str, Any]
Name = tuple[str, str]  # effect, place
C = TypeVar("C", bound=Case)
MOST_MISSES, MISSES_EACH = 40, 8


@dataclass(frozen=True, eq=False)
class Answer:
    """What a diagnosis said, as its JSON, its time [s], and the files that it saw, as read."""

    said: Row
    seconds: float
    robot: mc.Robot
    data: mc.Measurements


def asked(made: Sealed, **options: Any) -> Answer:
    """What `diagnose` makes of an arm's files; what is claimed of other poses is not asked."""
    with TemporaryDirectory() as name:
        write(made, Path(name))
        robot, data = Path(name) / ROBOT, Path(name) / DATA
        began = time.perf_counter()
        try:
            said = mc.diagnose(robot, data, quick=True, **options).to_dict()
        except Exception as error:  # a crash is an answer too, and a bad one
            said = {"verdict": "error", "trouble": f"{type(error).__name__}: {error}"}
        seconds = time.perf_counter() - began
        return Answer(said, seconds, mc.load_robot(robot), mc.read_measurements(data))


# ---- scoring an answer ---------------------------------------------------------------------------


def match(said: Name, truth: Name) -> str:
    """exact; broad (one joint for all, or all for one); place (another); or wrong."""
    if said[0] != truth[0]:
        return "wrong"
    if said[1] == truth[1] or truth[0] in FAULTS:
        return "exact"
    return "broad" if "all" in (said[1], truth[1]) else "place"


def is_right(said: Name, truth: Name) -> bool:
    """Effect and place agree, where all joints and one of them agree too."""
    return match(said, truth) in ("exact", "broad")


def pairing(truth: Sequence[Name], sets: Sequence[Sequence[Name]]) -> int:
    """How many truths find an answer of their own: the largest matching."""
    if not truth:
        return 0
    first, rest = truth[0], truth[1:]
    best = pairing(rest, sets)
    for i, options in enumerate(sets):
        if any(is_right(name, first) for name in options):
            best = max(best, 1 + pairing(rest, [*sets[:i], *sets[i + 1 :]]))
    return best


def answers(said: Row) -> list[list[Name]]:
    """Each confirmed cause of a diagnosis, before its alternatives."""
    sure = [effect for effect in said.get("effects", []) if effect.get("established", True)]
    return [
        [(str(e["effect"]), str(e["place"])) for e in (one, *one.get("alternatives", []))]
        for one in sure
    ]


def scored(case: Case, truth: Truth, said: Row, names: Sequence[Name]) -> Row:
    """What an answer is worth in every study, as plain data.  names: those that count."""
    known = (*truth.truth, *truth.background)
    alone = pairing(truth.truth, [[name] for name in names])
    return {
        "condition": case.condition,
        "seed": case.seed,
        "laws": [cause.law for cause in case.causes],
        "truth": [list(name) for name in truth.truth],
        "verdict": str(said["verdict"]),
        "names": [list(name) for name in names],
        "strange": sum(not any(is_right(name, true) for true in known) for name in names),
        "all_right": len(names) == len(truth.truth) == alone,
        "final_mm": number_of(said, "gap", "holdout_rms_mm", "final"),
        "geometric_mm": number_of(said, "gap", "holdout_rms_mm", "geometric"),
        "trouble": str(said.get("trouble", "")),
    }


def number_of(content: Any, *keys: str) -> float:
    """A number deep in a JSON object, NaN where there is none."""
    for key in keys:
        content = content.get(key) if isinstance(content, dict) else None
    return float(content) if isinstance(content, (int, float)) else float("nan")


# ---- criteria ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Criterion:
    """A share of rows, and the limit that it must keep.

    reason: what a row that does not do its part is listed under.  good: whether a hit is.
    limit: of the share, NaN for none; the least one if a hit is good, else the largest.
    """

    text: str
    reason: str
    rows: Sequence[Row]
    hit: Callable[[Row], bool]
    limit: float = float("nan")
    good: bool = True

    def line(self) -> tuple[Cell, ...]:
        """Text, runs, share with its interval, limit and whether it is kept."""
        n = len(self.rows)
        hits = sum(map(self.hit, self.rows))
        share = hits / n if n else float("nan")
        low, high = interval(hits, n) if n else (share, share)
        kept = share >= self.limit if self.good else share <= self.limit
        bound = f"{'>=' if self.good else '<='} {100.0 * self.limit:.3g} %"
        shown = bound if np.isfinite(self.limit) else ""
        verdict = ("met" if kept else "MISSED") if shown and n else ""
        return (self.text, n, 100.0 * share, 100.0 * low, 100.0 * high, shown, verdict)

    def misses(self) -> list[Row]:
        """Rows that did not do their part, where there is a limit."""
        if not np.isfinite(self.limit):
            return []
        return [row for row in self.rows if self.hit(row) != self.good]


def of(rows: Sequence[Row], *conditions: str) -> list[Row]:
    """Rows of some conditions."""
    return [row for row in rows if row["condition"] in conditions]


def verdict_is(*verdicts: str) -> Callable[[Row], bool]:
    """Whether a row has one of these verdicts."""
    return lambda row: row["verdict"] in verdicts


def has(key: str) -> Callable[[Row], bool]:
    """Whether something is true of a row, or more than none."""
    return lambda row: bool(row[key])


def headline(criteria: Sequence[Criterion], *more: tuple[Cell, ...]) -> Table:
    """The criteria, and more lines that are no shares."""
    return Table.made(
        "blind study: shares [%] with 95 % intervals, and the limits",
        [*(criterion.line() for criterion in criteria), *more],
        "criterion | runs d | found .1f | low .1f | high .1f | limit | verdict",
    )


def share_of(rows: Sequence[Row], hit: Callable[[Row], Any]) -> float:
    """Share of rows [%], NaN without any."""
    return 100.0 * float(np.mean([bool(hit(row)) for row in rows])) if rows else float("nan")


def verdicts(rows: Sequence[Row]) -> Table:
    """How often each verdict was given in each condition."""
    kinds = ("none", "named", "one_of", "unknown", "not_repeatable", "error")
    lines = []
    for condition in dict.fromkeys(row["condition"] for row in rows):
        own = of(rows, condition)
        counts = Counter(row["verdict"] for row in own)
        seconds = float(np.median([row["seconds"] for row in own]))
        lines.append((condition, len(own), *(counts[kind] for kind in kinds), seconds))
    each = (f"{kind} d" for kind in kinds)
    return Table.made("verdicts", lines, "condition | runs d", *each, "median s .2f")


def text_of(names: Iterable[Sequence[str]]) -> str:
    """Names as effect:place, joined."""
    return " + ".join(":".join(name) for name in names)


def misses(criteria: Sequence[Criterion], arm: Callable[[Row], str], against: str) -> Table:
    """The runs behind the limits, some of each reason, for those who mend the diagnosis.

    against: what the held-out RMS is compared with.
    """
    lines = []
    for criterion in criteria:
        for row in criterion.misses()[:MISSES_EACH]:
            others = [":".join(name) for name in row.get("set", [])[1:4]]
            said = f"{row['verdict']} {text_of(row['names'])}".strip()
            said += f" (or {', '.join(others)})" if others else ""
            places = [place for _, place in row["truth"]]
            lines.append((
                criterion.reason, f"{arm(row)} #{row['seed']}",
                text_of(zip(row["laws"], places, strict=True)), row["trouble"][:60] or said,
                row["lambda"], row["telling"], row["final_mm"] / row[against],
            ))  # fmt: skip
    total = sum(len(criterion.misses()) for criterion in criteria)
    shown = lines[:MOST_MISSES]
    return Table.made(
        f"misses: {len(shown)} of {total}",
        shown,
        "what | arm | truth | said | lambda .0f | telling .0f | RMS over .3f",
    )


def troubles(rows: Sequence[Row]) -> Table:
    """What went wrong in the diagnosis or in the judge, the most frequent first."""
    counts = Counter(row["trouble"][:120] for row in rows if row["trouble"])
    return Table.made("troubles", counts.most_common(10), "message | runs d")


# ---- the study -----------------------------------------------------------------------------------


def blind_study(name: str) -> Callable[[Callable[..., None]], click.Command]:
    """Makes a command of which some conditions, and each N-th case, may be run alone."""

    def decorate(function: Callable[..., None]) -> click.Command:
        every = click.option("--every", type=int, help="Run each N-th case alone.")
        only = click.option("--only", multiple=True, help="A condition to run; may be repeated.")
        return study_options(name)(only(every(function)))

    return decorate


def chosen(
    study: Study, cases: Sequence[C], only: Sequence[str], every: int | None, sparse: int
) -> list[C]:
    """Cases of some conditions, each so many-th.  sparse: of --quick.  Raises OptionError."""
    conditions = tuple(dict.fromkeys(case.condition for case in cases))
    for name in only:
        if name not in conditions:
            raise OptionError(f"--only {name}: choose {', '.join(conditions)}")
    step = (sparse if study.quick else 1) if every is None else every
    if step < 1:
        raise OptionError(f"--every {every}: give a whole number, 1 or more")
    return [case for case in cases if not only or case.condition in only][::step]


def save(
    study: Study, tables: Sequence[Table], rows: Sequence[Row], figures: dict[str, Figure]
) -> None:
    """Leave tables, the first of which is the headline, and the rows."""
    more = [troubles(rows)] if any(row["trouble"] for row in rows) else []
    content = {"criteria": tables[0].records(), "rows": rows}
    study.save([*tables, *more], content, figures)
