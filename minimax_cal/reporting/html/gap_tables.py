"""The tables of a diagnosis, from its file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from minimax_cal.diagnosing.result import Diagnosis, Finding
from minimax_cal.diagnosing.sentences import at, cause
from minimax_cal.ground.files import number
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.reporting.tables import where_tables

SURE = 1e-15  # a smaller chance is as good as none
SHOWN_LINES = 12  # lines of a fault that are told one by one


def ladder_table(gap: Diagnosis) -> Table:
    """The gap, rung by rung, held out beside training."""
    rows: list[tuple[Cell, ...]] = [
        (r.name, r.holdout.rms_mm, r.holdout.max_mm, r.train.rms_mm, r.train.max_mm)
        for r in gap.ladder
    ]
    floor = gap.floor
    rows.append((f"noise floor ({gap.floor_from})", floor, "", floor, ""))
    return Table(
        "The gap, step by step",
        ("model", "held-out RMS mm", "held-out max mm", "training RMS mm", "training max mm"),
        tuple(rows),
        ("", ".4f", ".4f", ".4f", ".4f"),
    )


def effects_table(gap: Diagnosis) -> Table:
    """The effects found, with what each does for held-out poses."""
    rows = tuple(
        (
            e.term.effect,
            at(e.term.place) + lines_of(e),
            cause(e.term.effect),
            100.0 * e.share,
            e.before,
            e.after,
            chance(e.p_value),
        )
        for e in gap.findings
    )
    return Table(
        "Effects found, the largest first",
        ("effect", "place", "cause", "share of gap %", "held-out RMS before mm", "after mm",
         "by chance"),
        rows,
        ("", "", "", ".0f", ".4f", ".4f", ""),
    )  # fmt: skip


def chance(value: float) -> str:
    """A probability that may be too small to matter how small."""
    return "-" if math.isnan(value) else f"< {SURE:g}" if value < SURE else f"{value:.1g}"


def lines_of(effect: Finding) -> str:
    """Lines of the file that a fault of the data concerns, in brackets."""
    if not effect.rows:
        return ""
    named = ", ".join(map(str, effect.rows[:SHOWN_LINES]))
    more = len(effect.rows) - SHOWN_LINES
    return f" (line {named}{f' and {more} more' if more > 0 else ''})"


def effect_parameters(gap: Diagnosis) -> Table:
    """The parameters of every effect found."""
    rows = tuple(
        (
            e.term.effect,
            e.term.place,
            p["name"],
            p["value"],
            p["sigma"] or math.nan,
            p["unit"],
        )
        for e in gap.findings
        for p in e.parameters()
    )
    header = ("effect", "place", "parameter", "value", "sigma", "unit")
    return Table("Parameters of the effects", header, rows, ("", "", "", ".4g", ".2g", ""))


def rival_table(gap: Diagnosis) -> Table:
    """What these data cannot tell from the effects found."""
    rows = tuple(
        (f"{e.term.effect} {e.term.place}", f"{a.effect} {a.place}", a.rho2, a.power, a.loss,
         a.separate_with or "no measurement considered would")
        for e in gap.findings
        for a in e.alternatives
    )  # fmt: skip
    header = ("named", "or rather", "likeness", "power", "fits worse by", "what to measure next")
    return Table("Rivals that these data do not rule out", header, rows,
                 ("", "", ".3f", ".3g", ".3g", ""))  # fmt: skip


def untestable_table(gap: Diagnosis) -> Table:
    """Effects that are neither found nor excluded."""
    return Table("Not testable with these data", ("effect", "needs"), gap.not_testable)


def place_tables(where: Mapping[str, Any]) -> tuple[Table, ...]:
    """Where the geometric errors lie: kind, targets, joints, directions, regions, trends."""
    tables = list(where_tables(where))
    directions = tuple(
        (name.removesuffix("_mm").replace("_", " "), number(value))
        for name, value in where["by_direction"].items()
    )
    tables.append(
        Table(
            "what geometry leaves, by direction", ("direction", "RMS mm"), directions, ("", ".4f")
        )
    )
    regions = tuple(
        (cell["region"], *(1e-3 * number(v) for v in (*cell["radius_mm"], *cell["height_mm"])),
         cell["points"], number(cell["rms_mm"]))
        for cell in where["by_region"]["cells"]
    )  # fmt: skip
    tables.append(
        Table(
            "what geometry leaves, by region",
            ("region", "from the base axis m", "to m", "height from m", "to m", "points", "RMS mm"),
            regions,
            ("", ".2f", ".2f", ".2f", ".2f", "d", ".4f"),
        )
    )
    trends = tuple(
        ({"clock": "visit order"}.get(name, name), number(trend["share"]), number(trend["p"]))
        for name, trend in where["by_order"].items()
        if trend
    )
    header = ("against", "share explained", "p")
    tables.append(Table("what geometry leaves, trends", header, trends, ("", ".2f", ".1g")))
    shown = tuple(table for table in tables if table.rows)
    for table in shown:
        table.cells()  # an entry that is no number is found here, where its file is known
    return shown
