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
from experiments.gap_cases import (
    DATA_FAULT_AMPLITUDES,
    DATA_FILE_NAME,
    ROBOT_FILE_NAME,
    GapCase,
    GapTruth,
    SealedArm,
    write_diagnosis_files,
)
from experiments.study_record import clopper_pearson_interval
from experiments.sweep import Study, study_options
from minimax_cal.core.errors import OptionError
from minimax_cal.core.tables import Table, TableCell

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row = dict[str, Any]
Name = tuple[str, str]  # effect, place
C = TypeVar("C", bound=GapCase)
MAX_LISTED_MISSES, MAX_MISSES_PER_CRITERION = 40, 8


@dataclass(frozen=True, eq=False)
class DiagnosisAnswer:
    """What a diagnosis said, as its JSON, its time [s], and the files that it saw, as read."""

    said: Row
    seconds: float
    robot: mc.Robot
    data: mc.Measurements


def diagnose_sealed_arm(sealed_arm: SealedArm, **options: Any) -> DiagnosisAnswer:
    """What `diagnose` makes of an arm's files; what is claimed of other poses is not asked."""
    with TemporaryDirectory() as name:
        write_diagnosis_files(sealed_arm, Path(name))
        robot, data = Path(name) / ROBOT_FILE_NAME, Path(name) / DATA_FILE_NAME
        began = time.perf_counter()
        try:
            said = mc.diagnose(robot, data, quick=True, **options).to_dict()
        except Exception as error:  # a crash is an answer too, and a bad one
            said = {"verdict": "error", "trouble": f"{type(error).__name__}: {error}"}
        seconds = time.perf_counter() - began
        return DiagnosisAnswer(said, seconds, mc.load_robot(robot), mc.read_measurements(data))


# ---- scoring an answer ---------------------------------------------------------------------------


def match_kind(named_effect: Name, true_effect: Name) -> str:
    """exact; broad (one joint for all, or all for one); place (another); or wrong."""
    if named_effect[0] != true_effect[0]:
        return "wrong"
    if named_effect[1] == true_effect[1] or true_effect[0] in DATA_FAULT_AMPLITUDES:
        return "exact"
    return "broad" if "all" in (named_effect[1], true_effect[1]) else "place"


def is_name_right(named_effect: Name, true_effect: Name) -> bool:
    """Effect and place agree, where all joints and one of them agree too."""
    return match_kind(named_effect, true_effect) in ("exact", "broad")


def count_matched_truths(true_effects: Sequence[Name], named_sets: Sequence[Sequence[Name]]) -> int:
    """How many truths find an answer of their own: the largest matching."""
    if not true_effects:
        return 0
    first, rest = true_effects[0], true_effects[1:]
    best = count_matched_truths(rest, named_sets)
    for i, options in enumerate(named_sets):
        if any(is_name_right(name, first) for name in options):
            best = max(
                best, 1 + count_matched_truths(rest, [*named_sets[:i], *named_sets[i + 1 :]])
            )
    return best


def list_confirmed_causes(diagnosis_json: Row) -> list[list[Name]]:
    """Each confirmed cause of a diagnosis, before its alternatives."""
    sure = [
        effect for effect in diagnosis_json.get("effects", []) if effect.get("established", True)
    ]
    return [
        [(str(e["effect"]), str(e["place"])) for e in (one, *one.get("alternatives", []))]
        for one in sure
    ]


def score_common_fields(
    case: GapCase, truth: GapTruth, diagnosis_json: Row, names: Sequence[Name]
) -> Row:
    """What an answer is worth in every study, as plain data.  names: those that count."""
    known = (*truth.truth, *truth.background)
    alone = count_matched_truths(truth.truth, [[name] for name in names])
    return {
        "condition": case.condition,
        "seed": case.seed,
        "laws": [cause.law for cause in case.causes],
        "truth": [list(name) for name in truth.truth],
        "verdict": str(diagnosis_json["verdict"]),
        "names": [list(name) for name in names],
        "strange": sum(not any(is_name_right(name, true) for true in known) for name in names),
        "all_right": len(names) == len(truth.truth) == alone,
        "final_mm": number_in_json(diagnosis_json, "gap", "holdout_rms_mm", "final"),
        "geometric_mm": number_in_json(diagnosis_json, "gap", "holdout_rms_mm", "geometric"),
        "trouble": str(diagnosis_json.get("trouble", "")),
    }


def number_in_json(json_content: Any, *keys: str) -> float:
    """A number deep in a JSON object, NaN where there is none."""
    for key in keys:
        json_content = json_content.get(key) if isinstance(json_content, dict) else None
    return float(json_content) if isinstance(json_content, (int, float)) else float("nan")


# ---- criteria ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StudyCriterion:
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

    def to_table_row(self) -> tuple[TableCell, ...]:
        """Text, runs, share with its interval, limit and whether it is kept."""
        n = len(self.rows)
        hits = sum(map(self.hit, self.rows))
        share = hits / n if n else float("nan")
        low, high = clopper_pearson_interval(hits, n) if n else (share, share)
        kept = share >= self.limit if self.good else share <= self.limit
        bound = f"{'>=' if self.good else '<='} {100.0 * self.limit:.3g} %"
        shown = bound if np.isfinite(self.limit) else ""
        verdict = ("met" if kept else "MISSED") if shown and n else ""
        return (self.text, n, 100.0 * share, 100.0 * low, 100.0 * high, shown, verdict)

    def list_missed_rows(self) -> list[Row]:
        """Rows that did not do their part, where there is a limit."""
        if not np.isfinite(self.limit):
            return []
        return [row for row in self.rows if self.hit(row) != self.good]


def select_conditions(rows: Sequence[Row], *conditions: str) -> list[Row]:
    """Rows of some conditions."""
    return [row for row in rows if row["condition"] in conditions]


def make_verdict_test(*verdicts: str) -> Callable[[Row], bool]:
    """Whether a row has one of these verdicts."""
    return lambda row: row["verdict"] in verdicts


def make_key_test(key: str) -> Callable[[Row], bool]:
    """Whether something is true of a row, or more than none."""
    return lambda row: bool(row[key])


def build_criteria_table(criteria: Sequence[StudyCriterion], *more: tuple[TableCell, ...]) -> Table:
    """The criteria, and more lines that are no shares."""
    return Table.from_rows(
        "blind study: shares [%] with 95 % intervals, and the limits",
        [*(criterion.to_table_row() for criterion in criteria), *more],
        "criterion | runs d | found .1f | low .1f | high .1f | limit | verdict",
    )


def percentage_of_rows(rows: Sequence[Row], is_hit: Callable[[Row], Any]) -> float:
    """Share of rows [%], NaN without any."""
    return 100.0 * float(np.mean([bool(is_hit(row)) for row in rows])) if rows else float("nan")


def build_verdict_table(rows: Sequence[Row]) -> Table:
    """How often each verdict was given in each condition."""
    kinds = ("none", "named", "one_of", "unknown", "not_repeatable", "error")
    lines = []
    for condition in dict.fromkeys(row["condition"] for row in rows):
        own = select_conditions(rows, condition)
        counts = Counter(row["verdict"] for row in own)
        seconds = float(np.median([row["seconds"] for row in own]))
        lines.append((condition, len(own), *(counts[kind] for kind in kinds), seconds))
    each = (f"{kind} d" for kind in kinds)
    return Table.from_rows("verdicts", lines, "condition | runs d", *each, "median s .2f")


def format_effect_names(names: Iterable[Sequence[str]]) -> str:
    """Names as effect:place, joined."""
    return " + ".join(":".join(name) for name in names)


def build_misses_table(
    criteria: Sequence[StudyCriterion], describe_arm: Callable[[Row], str], reference_key: str
) -> Table:
    """The runs behind the limits, some of each reason, for those who mend the diagnosis.

    reference_key: what the held-out RMS is compared with.
    """
    lines = []
    for criterion in criteria:
        for row in criterion.list_missed_rows()[:MAX_MISSES_PER_CRITERION]:
            others = [":".join(name) for name in row.get("set", [])[1:4]]
            said = f"{row['verdict']} {format_effect_names(row['names'])}".strip()
            said += f" (or {', '.join(others)})" if others else ""
            places = [place for _, place in row["truth"]]
            lines.append(
                (
                    criterion.reason,
                    f"{describe_arm(row)} #{row['seed']}",
                    format_effect_names(zip(row["laws"], places, strict=True)),
                    row["trouble"][:60] or said,
                    row["lambda"],
                    row["telling"],
                    row["final_mm"] / row[reference_key],
                )
            )
    total = sum(len(criterion.list_missed_rows()) for criterion in criteria)
    shown = lines[:MAX_LISTED_MISSES]
    return Table.from_rows(
        f"misses: {len(shown)} of {total}",
        shown,
        "what | arm | truth | said | lambda .0f | telling .0f | RMS over .3f",
    )


def build_error_message_table(rows: Sequence[Row]) -> Table:
    """What went wrong in the diagnosis or in the judge, the most frequent first."""
    counts = Counter(row["trouble"][:120] for row in rows if row["trouble"])
    return Table.from_rows("troubles", counts.most_common(10), "message | runs d")


# ---- the study -----------------------------------------------------------------------------------


def blind_study_command(study_name: str) -> Callable[[Callable[..., None]], click.Command]:
    """Makes a command of which some conditions, and each N-th case, may be run alone."""

    def decorate(function: Callable[..., None]) -> click.Command:
        every = click.option("--every", type=int, help="Run each N-th case alone.")
        only = click.option("--only", multiple=True, help="A condition to run; may be repeated.")
        return study_options(study_name)(only(every(function)))

    return decorate


def select_cases(
    study: Study, cases: Sequence[C], only: Sequence[str], every: int | None, quick_stride: int
) -> list[C]:
    """Cases of some conditions, each so many-th.  quick_stride: of --quick.  Raises OptionError."""
    conditions = tuple(dict.fromkeys(case.condition for case in cases))
    for name in only:
        if name not in conditions:
            raise OptionError(f"--only {name}: choose {', '.join(conditions)}")
    step = (quick_stride if study.quick else 1) if every is None else every
    if step < 1:
        raise OptionError(f"--every {every}: give a whole number, 1 or more")
    return [case for case in cases if not only or case.condition in only][::step]


def save_blind_results(
    study: Study, tables: Sequence[Table], rows: Sequence[Row], figures: dict[str, Figure]
) -> None:
    """Leave tables, the first of which is the headline, and the rows."""
    more = [build_error_message_table(rows)] if any(row["trouble"] for row in rows) else []
    content = {"criteria": tables[0].to_records(), "rows": rows}
    study.save([*tables, *more], content, figures)
