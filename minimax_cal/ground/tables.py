"""The one way a number reaches people: a table, as text, Markdown, CSV, LaTeX or HTML."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from minimax_cal.ground.files import csv_text
from minimax_cal.ground.words import visible

Cell = str | float | int
MAX_ROWS = 6  # of a table on a first screen

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

    def brief(self, *header: str, rows: int = MAX_ROWS) -> Table:
        """Some of the columns, all unless named, and at most so many rows: the first and the last.

        The title says how many rows are left out.
        """
        kept = [self.header.index(name) for name in header] or list(range(len(self.header)))
        more = len(self.rows) - rows
        some = self.rows if more <= 0 else (*self.rows[: rows - 1], self.rows[-1])
        return Table(
            f"{self.title} ({more} rows left out)" if more > 0 else self.title,
            tuple(self.header[i] for i in kept),
            tuple(tuple(row[i] for i in kept) for row in some),
            tuple(self.formats[i] for i in kept) if self.formats else (),
        )

    def cells(self) -> list[list[str]]:
        """Every cell as text; NaN is a dash."""
        formats = self.formats or ("",) * len(self.header)
        return [
            [show(cell, spec) for cell, spec in zip(row, formats, strict=True)] for row in self.rows
        ]

    def numeric(self) -> list[bool]:
        """Which columns hold numbers (and are aligned right)."""
        return [
            any(isinstance(row[i], (int, float)) for row in self.rows)
            for i in range(len(self.header))
        ]

    def text(self, width: int = 100) -> str:
        """Plain text, without colour."""
        stream = io.StringIO()
        Console(file=stream, width=width, color_system=None, highlight=False).print(self.rich())
        return stream.getvalue().rstrip()

    def rich(self) -> RichTable:
        """For a terminal.  Cells are literal text, never markup."""
        table = RichTable(
            title=Text(visible(self.title)),
            title_justify="left",
            header_style="bold",
            box=box.SIMPLE,
        )
        for name, right in zip(self.header, self.numeric(), strict=True):
            table.add_column(
                Text(visible(name)), justify="right" if right else "left", overflow="fold"
            )
        for row in self.cells():
            table.add_row(*(Text(visible(cell)) for cell in row))
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
            inner = "".join(f"<{tag}{kind}>{escape(cell)}</{tag[:2]}>" for cell, tag, kind in whole)
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


def show(cell: Cell, spec: str) -> str:
    """One cell as text: numbers by the column's format, missing ones as a dash, no minus zero."""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, float) and math.isnan(cell):
        return "-"
    text = format(cell, spec)
    return text[1:] if text.startswith("-") and not text.strip("-0.") else text
