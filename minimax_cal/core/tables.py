"""The one way a number reaches people: a table, as text, Markdown, CSV, LaTeX or HTML."""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from html import escape
from typing import Any, Literal, NamedTuple, cast

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from minimax_cal.core.display_text import replace_invisible_and_bidi_characters
from minimax_cal.core.files import format_csv
from minimax_cal.core.record_fields import all_field_formats, scale_numbers

TableCell = str | float | int
TABLE_EDGE_LETTERS, COLUMN_GAP_LETTERS = 1, 3  # letters beside a table's columns, and between two
MAX_FIRST_SCREEN_ROWS = 6  # of a table on a first screen
MAX_NAME_CELL_LETTERS = (
    28  # letters of a cell that is a name; what is longer is a sentence, and wraps
)
NOWRAP_CELL_ATTRIBUTE, MAX_NOWRAP_CELL_LETTERS = (
    ' class="name"',
    16,
)  # of a cell of a page that stays in one line, and letters
WORD_JOINER = "\N{WORD JOINER}"
JOINED_UNIT_REPLACEMENT = rf"\1{WORD_JOINER}\2"
COLUMN_SPEC_SEPARATOR = " | "  # between columns that one text tells
COLUMN_SPEC_PATTERN = re.compile(r"(.*?)(?: ([-+#]?\.?\d*[defg]))?", re.DOTALL)  # header, format
NUMBER_WITH_UNIT_PATTERN = re.compile(r"(\d) (\S{1,9})(?!\S)")  # of a number in a sentence

LATEX_ESCAPES = str.maketrans(
    {c: "\\" + c for c in "&%$#_{}"}
    | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}
)


class ColumnWidth(NamedTuple):
    """Widths of a column in letters: the least that breaks no number, unit or name, and the usual
    one.
    """

    minimum: int
    usual: int


@dataclass(frozen=True)
class Table:
    """A title, a header with units, and rows; formats holds one format spec a column."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[TableCell, ...], ...]
    formats: tuple[str, ...] = ()

    @staticmethod
    def from_rows(
        title: str, rows: Iterable[Iterable[object]], column_specs: str, *more_column_specs: str
    ) -> Table:
        """Rows under a header.  column_specs: header and format of each, as "name | RMS mm .4f".

        more_column_specs: columns of which users may have named a part, one each.
        """
        told = [
            cast(re.Match[str], COLUMN_SPEC_PATTERN.fullmatch(one))
            for one in (*column_specs.split(COLUMN_SPEC_SEPARATOR), *more_column_specs)
        ]
        header, formats = zip(*(one.groups("") for one in told), strict=True)
        return Table(title, header, tuple(tuple(map(to_table_cell, row)) for row in rows), formats)

    @staticmethod
    def from_records(
        title: str, records: Iterable[object], column_specs: str, *more_column_specs: str
    ) -> Table:
        """A row a record.  column_specs: attribute, its header if another, format: "rms=RMS mm
        .4f".

        Columns are told as for `from_rows`; see `value_in_file_unit` for the attribute.
        """
        told = [
            one.partition("=")
            for one in (*column_specs.split(COLUMN_SPEC_SEPARATOR), *more_column_specs)
        ]
        names = [name if named else name.partition(" ")[0] for name, named, _ in told]
        heads = (head if named else name.replace("_", " ") for name, named, head in told)
        rows = ([value_in_file_unit(one, name) for name in names] for one in records)
        return Table.from_rows(title, rows, *heads)

    def with_rows(self, *rows: Iterable[object]) -> Table:
        """With more rows."""
        return replace(self, rows=(*self.rows, *(tuple(map(to_table_cell, row)) for row in rows)))

    def shorten(self, *column_names: str, max_rows: int = MAX_FIRST_SCREEN_ROWS) -> Table:
        """Some of the columns, all unless named, and at most so many rows: the first and the
        last.

        The title says how many rows are left out.
        """
        more = len(self.rows) - max_rows
        some = self.rows if more <= 0 else (*self.rows[: max_rows - 1], self.rows[-1])
        title = f"{self.title} ({more} rows left out)" if more > 0 else self.title
        kept = [self.header.index(name) for name in column_names] or range(len(self.header))
        return replace(self, title=title, rows=some).select_columns(*kept)

    def formatted_cells(self) -> list[list[str]]:
        """Every cell as text; NaN is a dash."""
        formats = self.formats or ("",) * len(self.header)
        return [
            [format_cell(cell, spec) for cell, spec in zip(row, formats, strict=True)]
            for row in self.rows
        ]

    def is_numeric_by_column(self) -> list[bool]:
        """Which columns hold numbers (and are aligned right)."""
        return [
            any(isinstance(row[i], int | float) for row in self.rows)
            for i in range(len(self.header))
        ]

    def select_columns(self, *column_indices: int) -> Table:
        """Some of the columns, by number."""
        return replace(
            self,
            header=tuple(self.header[i] for i in column_indices),
            rows=tuple(tuple(row[i] for i in column_indices) for row in self.rows),
            formats=tuple(self.formats[i] for i in column_indices) if self.formats else (),
        )

    def text(self, width: int = 100) -> str:
        """Plain text, without colour."""
        stream = io.StringIO()
        self.print_to_console(Console(file=stream, width=width, color_system=None, highlight=False))
        return stream.getvalue().rstrip()

    def print_to_console(self, console: Console) -> None:
        """Print it on a terminal; what is too wide in parts, each with the first column.

        No number, unit or name is broken: columns that have no room for theirs stand below.
        """
        here, room = [0], console.width - TABLE_EDGE_LETTERS
        least = [least + COLUMN_GAP_LETTERS for least, _ in self.column_widths()]
        for i in range(1, len(self.header)):
            if len(here) > 1 and sum(least[j] for j in (*here, i)) > room:
                console.print(self.select_columns(*here).to_rich_table(room))
                here = [0]
            here.append(i)
        console.print(self.select_columns(*here).to_rich_table(room))

    def column_widths(self) -> list[ColumnWidth]:
        """The widths of each column."""
        rows, out = self.formatted_cells(), []
        for i, (name, right) in enumerate(
            zip(self.header, self.is_numeric_by_column(), strict=True)
        ):
            cells = [replace_invisible_and_bidi_characters(row[i]) for row in rows]
            parts = [
                part for cell in cells for part in split_unbreakable_parts(cell, is_number=right)
            ]
            least = max(
                map(len, [*parts, *replace_invisible_and_bidi_characters(name).split()]), default=1
            )
            usual = max(map(len, [*cells, replace_invisible_and_bidi_characters(name)]))
            out.append(ColumnWidth(least, usual))
        return out

    def to_rich_table(self, max_width: int = 0) -> RichTable:
        """For a terminal.  Cells are literal text, never markup.  max_width: letters a line, if
        few.
        """
        table = RichTable(
            title=Text(replace_invisible_and_bidi_characters(self.title)),
            title_justify="left",
            header_style="bold",
            box=box.SIMPLE,
        )
        least, widths = (list(column) for column in zip(*self.column_widths(), strict=True))
        over = sum(widths) + COLUMN_GAP_LETTERS * len(widths) - max_width if max_width else 0
        while over > 0 and widths != least:  # a letter from where most is to spare
            i = max(range(len(widths)), key=lambda i: widths[i] - least[i])
            widths[i], over = widths[i] - 1, over - 1
        for name, right, width in zip(
            self.header, self.is_numeric_by_column(), widths, strict=True
        ):
            justify: Literal["left", "right"] = "right" if right else "left"
            table.add_column(
                Text(replace_invisible_and_bidi_characters(name)),
                justify=justify,
                overflow="fold",
                width=width,
            )
        for row in self.formatted_cells():
            table.add_row(
                *(
                    Text(wrap_cell(replace_invisible_and_bidi_characters(c), n))
                    for c, n in zip(row, widths, strict=True)
                )
            )
        return table

    def markdown(self) -> str:
        """A pipe table under its title."""
        rule = ["---:" if right else "---" for right in self.is_numeric_by_column()]
        lines = [list(self.header), rule, *self.formatted_cells()]
        body = "\n".join(
            "| " + " | ".join(c.replace("|", "\\|") for c in row) + " |" for row in lines
        )
        return f"**{self.title}**\n\n{body}\n"

    def html(self) -> str:
        """A table with its title as caption; the first cell of a row is its header."""
        classes = [' class="right"' if right else "" for right in self.is_numeric_by_column()]

        def is_short(tag: str, cell: str) -> bool:
            return tag == "td" and len(cell) <= MAX_NOWRAP_CELL_LETTERS

        def row(cells: list[str], tags: list[str]) -> str:
            whole = zip(cells, tags, classes, strict=True)
            inner = "".join(
                f"<{tag}"
                f"{kind or NOWRAP_CELL_ATTRIBUTE * is_short(tag, cell)}>{escape(cell)}</{tag[:2]}>"
                for cell, tag, kind in whole
            )
            return f"<tr>{inner}</tr>"

        heads, body = ['th scope="col"'] * len(self.header), ["td"] * (len(self.header) - 1)
        rows = "\n".join(row(cells, ['th scope="row"', *body]) for cells in self.formatted_cells())
        return (
            f"<table><caption>{escape(self.title)}</caption>\n<thead>\n"
            f"{row(list(self.header), heads)}\n</thead>\n<tbody>\n{rows}\n</tbody></table>"
        )

    def to_records(self, *keys: str) -> list[dict[str, TableCell]]:
        """The rows for JSON, by the header or other keys."""
        return [dict(zip(keys or self.header, row, strict=True)) for row in self.rows]

    def csv(self) -> str:
        """Header and rows at full precision."""
        return format_csv((self.header, *self.rows))

    def latex(self) -> str:
        """A booktabs tabular with the title as caption."""
        align = "".join("r" if right else "l" for right in self.is_numeric_by_column())
        header, *body = [
            " & ".join(cell.translate(LATEX_ESCAPES) for cell in row) + r" \\"
            for row in (list(self.header), *self.formatted_cells())
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


def columns_to_records(columns: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Columns of one length as objects for JSON, one a row."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def drop_empty_tables(*tables: Table) -> tuple[Table, ...]:
    """The tables that have rows."""
    return tuple(table for table in tables if table.rows)


def value_in_file_unit(record: Any, dotted_path: str) -> Any:
    """What a record holds in the unit of files, as `facts` has it.

    dotted_path: attributes, keys or numbers, of one within the other where dots join them.
    """
    found = record
    for name in dotted_path.split("."):
        if isinstance(found, Mapping):
            found = found[name]
        elif name.isdecimal():
            found = found[int(name)]
        else:
            kind: Any = type(found)
            known = all_field_formats(kind).get(name)
            found = scale_numbers(getattr(found, name), known.scale if known else 1.0)
    return found


def to_table_cell(value: Any) -> TableCell:
    """A value for people."""
    value = value.item() if hasattr(value, "item") else value
    if isinstance(value, bool):
        return "yes" if value else ""
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    return math.nan if value is None else value if isinstance(value, float | int) else str(value)


def split_unbreakable_parts(cell: str, *, is_number: bool) -> list[str]:
    """Parts of a cell that stand on one line: a number, a name, words of a sentence with units."""
    if is_number or len(cell) <= MAX_NAME_CELL_LETTERS:
        return [cell]
    return [
        cell[:MAX_NAME_CELL_LETTERS],
        *NUMBER_WITH_UNIT_PATTERN.sub(JOINED_UNIT_REPLACEMENT, cell).split(),
    ]


def wrap_cell(cell: str, width: int) -> str:
    """A cell in lines of at most so many letters, numbers with their units."""
    if len(cell) <= width:
        return cell
    lines = textwrap.wrap(
        NUMBER_WITH_UNIT_PATTERN.sub(JOINED_UNIT_REPLACEMENT, cell), width, break_on_hyphens=False
    )
    return "\n".join(lines).replace(WORD_JOINER, " ")


def format_cell(cell: TableCell, format_spec: str) -> str:
    """One cell as text: numbers by the column's format, missing ones as a dash, no minus zero."""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, float) and math.isnan(cell):
        return "-"
    text = format(cell, format_spec)
    return text if text.strip("-0.") else text.lstrip("-")
