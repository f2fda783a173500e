"""The one way a number reaches people: a table, as text, Markdown, CSV, LaTeX or HTML."""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from html import escape
from typing import Any, Literal, cast

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from minimax_cal.ground.facts import all_facts, scaled
from minimax_cal.ground.files import csv_text
from minimax_cal.ground.words import visible

Cell = str | float | int
EDGE, BETWEEN = 1, 3  # letters beside a table's columns, and between two
MAX_ROWS = 6  # of a table on a first screen
LONGEST_NAME = 28  # letters of a cell that is a name; what is longer is a sentence, and wraps
SHORT, MAX_SHORT = ' class="name"', 16  # of a cell of a page that stays in one line, and letters
JOINT = "\N{WORD JOINER}"
JOINED = rf"\1{JOINT}\2"
BAR = " | "  # between columns that one text tells
HEAD = re.compile(r"(.*?)(?: ([-+#]?\.?\d*[defg]))?", re.DOTALL)  # header, format
UNIT = re.compile(r"(\d) (\S{1,9})(?!\S)")  # of a number in a sentence

LATEX_ESCAPES = str.maketrans(
    {c: "\\" + c for c in "&%$#_{}"}
    | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}
)


@dataclass(frozen=True)
class Table:
    """A title, a header with units, and rows; formats holds one format spec a column."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    formats: tuple[str, ...] = ()

    @staticmethod
    def made(title: str, rows: Iterable[Iterable[object]], columns: str, *more: str) -> Table:
        """Rows under a header.  columns: header and format of each, as "name | RMS mm .4f".

        more: columns of which users may have named a part, one each.
        """
        told = [cast(re.Match[str], HEAD.fullmatch(one)) for one in (*columns.split(BAR), *more)]
        header, formats = zip(*(one.groups("") for one in told), strict=True)
        return Table(title, header, tuple(tuple(map(cell, row)) for row in rows), formats)

    @staticmethod
    def of(title: str, records: Iterable[object], columns: str, *more: str) -> Table:
        """A row a record.  columns: attribute, its header if another, format: "rms=RMS mm .4f".

        Columns are told as for `made`; see `value_at` for the attribute.
        """
        told = [one.partition("=") for one in (*columns.split(BAR), *more)]
        names = [name if named else name.partition(" ")[0] for name, named, _ in told]
        heads = (head if named else name.replace("_", " ") for name, named, head in told)
        rows = ([value_at(one, name) for name in names] for one in records)
        return Table.made(title, rows, *heads)

    def plus(self, *rows: Iterable[object]) -> Table:
        """With more rows."""
        return replace(self, rows=(*self.rows, *(tuple(map(cell, row)) for row in rows)))

    def brief(self, *header: str, rows: int = MAX_ROWS) -> Table:
        """Some of the columns, all unless named, and at most so many rows: the first and the last.

        The title says how many rows are left out.
        """
        more = len(self.rows) - rows
        some = self.rows if more <= 0 else (*self.rows[: rows - 1], self.rows[-1])
        title = f"{self.title} ({more} rows left out)" if more > 0 else self.title
        kept = [self.header.index(name) for name in header] or range(len(self.header))
        return replace(self, title=title, rows=some).only(*kept)

    def cells(self) -> list[list[str]]:
        """Every cell as text; NaN is a dash."""
        formats = self.formats or ("",) * len(self.header)
        return [
            [show(cell, spec) for cell, spec in zip(row, formats, strict=True)] for row in self.rows
        ]

    def numeric(self) -> list[bool]:
        """Which columns hold numbers (and are aligned right)."""
        return [
            any(isinstance(row[i], int | float) for row in self.rows)
            for i in range(len(self.header))
        ]

    def only(self, *kept: int) -> Table:
        """Some of the columns, by number."""
        return replace(
            self,
            header=tuple(self.header[i] for i in kept),
            rows=tuple(tuple(row[i] for i in kept) for row in self.rows),
            formats=tuple(self.formats[i] for i in kept) if self.formats else (),
        )

    def text(self, width: int = 100) -> str:
        """Plain text, without colour."""
        stream = io.StringIO()
        self.show(Console(file=stream, width=width, color_system=None, highlight=False))
        return stream.getvalue().rstrip()

    def show(self, console: Console) -> None:
        """Print it on a terminal; what is too wide in parts, each with the first column.

        No number, unit or name is broken: columns that have no room for theirs stand below.
        """
        here, room = [0], console.width - EDGE
        least = [least + BETWEEN for least, _ in self.widths()]
        for i in range(1, len(self.header)):
            if len(here) > 1 and sum(least[j] for j in (*here, i)) > room:
                console.print(self.only(*here).rich(room))
                here = [0]
            here.append(i)
        console.print(self.only(*here).rich(room))

    def widths(self) -> list[tuple[int, int]]:
        """Of each column, the least that breaks no number, unit or name, and the usual one."""
        rows, out = self.cells(), []
        for i, (name, right) in enumerate(zip(self.header, self.numeric(), strict=True)):
            cells = [visible(row[i]) for row in rows]
            parts = [part for cell in cells for part in unbroken(cell, right=right)]
            least = max(map(len, [*parts, *visible(name).split()]), default=1)
            out.append((least, max(map(len, [*cells, visible(name)]))))
        return out

    def rich(self, room: int = 0) -> RichTable:
        """For a terminal.  Cells are literal text, never markup.  room: letters a line, if few."""
        table = RichTable(
            title=Text(visible(self.title)),
            title_justify="left",
            header_style="bold",
            box=box.SIMPLE,
        )
        least, widths = (list(column) for column in zip(*self.widths(), strict=True))
        over = sum(widths) + BETWEEN * len(widths) - room if room else 0
        while over > 0 and widths != least:  # a letter from where most is to spare
            i = max(range(len(widths)), key=lambda i: widths[i] - least[i])
            widths[i], over = widths[i] - 1, over - 1
        for name, right, width in zip(self.header, self.numeric(), widths, strict=True):
            justify: Literal["left", "right"] = "right" if right else "left"
            table.add_column(Text(visible(name)), justify=justify, overflow="fold", width=width)
        for row in self.cells():
            table.add_row(*(Text(folded(visible(c), n)) for c, n in zip(row, widths, strict=True)))
        return table

    def markdown(self) -> str:
        """A pipe table under its title."""
        rule = ["---:" if right else "---" for right in self.numeric()]
        lines = [list(self.header), rule, *self.cells()]
        body = "\n".join(
            "| " + " | ".join(c.replace("|", "\\|") for c in row) + " |" for row in lines
        )
        return f"**{self.title}**\n\n{body}\n"

    def html(self) -> str:
        """A table with its title as caption; the first cell of a row is its header."""
        classes = [' class="right"' if right else "" for right in self.numeric()]

        def row(cells: list[str], tags: list[str]) -> str:
            whole = zip(cells, tags, classes, strict=True)
            inner = "".join(
                f"<{tag}{kind or SHORT * (tag == 'td' and len(cell) <= MAX_SHORT)}>"
                f"{escape(cell)}</{tag[:2]}>"
                for cell, tag, kind in whole
            )
            return f"<tr>{inner}</tr>"

        heads, body = ['th scope="col"'] * len(self.header), ["td"] * (len(self.header) - 1)
        rows = "\n".join(row(cells, ['th scope="row"', *body]) for cells in self.cells())
        return (
            f"<table><caption>{escape(self.title)}</caption>\n<thead>\n"
            f"{row(list(self.header), heads)}\n</thead>\n<tbody>\n{rows}\n</tbody></table>"
        )

    def records(self, *keys: str) -> list[dict[str, Cell]]:
        """The rows for JSON, by the header or other keys."""
        return [dict(zip(keys or self.header, row, strict=True)) for row in self.rows]

    def csv(self) -> str:
        """Header and rows at full precision."""
        return csv_text((self.header, *self.rows))

    def latex(self) -> str:
        """A booktabs tabular with the title as caption."""
        align = "".join("r" if right else "l" for right in self.numeric())
        header, *body = [
            " & ".join(cell.translate(LATEX_ESCAPES) for cell in row) + r" \\"
            for row in (list(self.header), *self.cells())
        ]
        return "\n".join(
            [
                r"\begin{table}",
                rf"\caption{{{self.title.translate(LATEX_ESCAPES)}}}",
                rf"\begin{{tabular}}{{{align}}}",
                r"\toprule",
                header,
                r"\midrule",
                *body,
                r"\bottomrule",
                r"\end{tabular}",
                r"\end{table}",
                "",
            ]
        )


def records_of(columns: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Columns of one length as objects for JSON, one a row."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def filled(*tables: Table) -> tuple[Table, ...]:
    """The tables that have rows."""
    return tuple(table for table in tables if table.rows)


def value_at(record: Any, place: str) -> Any:
    """What a record holds in the unit of files, as `facts` has it.

    place: attributes, keys or numbers, of one within the other where dots join them.
    """
    found = record
    for name in place.split("."):
        if isinstance(found, Mapping):
            found = found[name]
        elif name.isdecimal():
            found = found[int(name)]
        else:
            kind: Any = type(found)
            known = all_facts(kind).get(name)
            found = scaled(getattr(found, name), known.scale if known else 1.0)
    return found


def cell(value: Any) -> Cell:
    """A value for people."""
    value = value.item() if hasattr(value, "item") else value
    if isinstance(value, bool):
        return "yes" if value else ""
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    return math.nan if value is None else value if isinstance(value, float | int) else str(value)


def unbroken(cell: str, *, right: bool) -> list[str]:
    """Parts of a cell that stand on one line: a number, a name, words of a sentence with units."""
    if right or len(cell) <= LONGEST_NAME:
        return [cell]
    return [cell[:LONGEST_NAME], *UNIT.sub(JOINED, cell).split()]


def folded(cell: str, width: int) -> str:
    """A cell in lines of at most so many letters, numbers with their units."""
    if len(cell) <= width:
        return cell
    lines = textwrap.wrap(UNIT.sub(JOINED, cell), width, break_on_hyphens=False)
    return "\n".join(lines).replace(JOINT, " ")


def show(cell: Cell, spec: str) -> str:
    """One cell as text: numbers by the column's format, missing ones as a dash, no minus zero."""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, float) and math.isnan(cell):
        return "-"
    text = format(cell, spec)
    return text if text.strip("-0.") else text.lstrip("-")
