"""A text file as it is: encoding, delimiter, decimal sign, header and cells."""

from __future__ import annotations

import codecs
import csv
import hashlib
import io
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mode
from typing import NamedTuple, overload

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.core.files import read_bytes
from minimax_cal.reading.column_words import (
    is_summary_cell,
    is_understood_header,
    meaning_of_plain_name,
    standard_unit_name,
)
from minimax_cal.reading.workbook import is_workbook_path, read_workbook_as_text

DELIMITER_NAMES = {";": "semicolon", "\t": "tab", ",": "comma", "|": "bar", " ": "spaces"}
DECIMAL_SIGN_NAMES = {".": "point", ",": "comma"}
CELL_NUMBER_PATTERN = re.compile(r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?")
THOUSANDS_NUMBER_PATTERN = re.compile(
    r"[-+]?\d{1,3}([.,' \u00a0\u202f])\d{3}(?:\1\d{3})*(?!\1)([.,])\d+"
)
COMMA_NUMBER_PATTERN = re.compile(r"[-+]?(\d*),(\d+)([eE][-+]?\d+)?")
CERTAIN_DECIMAL_COMMA_PATTERN = re.compile(
    r",(?!\d{3}(?!\d))|\d{4},|(?<!\d)0,"
)  # no sign of thousands
COMMENT_MARKS = ("#", "%", "//", "!")
SIMULATED_FIRST_LINE = (
    "# simulated"  # first line of a file whose points were computed, not measured
)
# names and codecs; the last takes any bytes, and cp1252 is meant by latin-1 mostly
TRIED_ENCODINGS = (
    ("utf-16", "utf-16"), ("utf-16", "utf-16-le"), ("utf-16", "utf-16-be"), ("utf-8", "utf-8-sig"),
    ("gb2312", "gbk"), ("latin-1", "cp1252"), ("latin-1", "latin-1"),
)  # fmt: skip
CHINESE_LETTER_PATTERN = re.compile(
    rb"([\xa1-\xd7][\xa1-\xfe])|[\x81-\xfe][\x40-\xfe]"
)  # signs; common ones
UTF16_BYTE_ORDER_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
SPREADSHEET_FILE_STARTS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")  # how spreadsheets begin
WORKBOOK_ENCODING = "workbook"
BLANK_LETTERS = " \t,;|"
MAX_TABLE_COLUMNS = 1 << 14  # as of workbooks
NUMBER_LETTERS = b"0123456789+-.eE "  # letters of numbers
ROWS_PARSED_AT_ONCE = 1 << 13  # rows that are made numbers at once
MAX_TORN_SHARE, MIN_ROWS_PER_TORN_ROW = 0.01, 20  # share of rows that may be torn; one of so many
MAX_LISTED_LINES = 3  # lines that a notice names
DELIMITER_SAMPLE_LINES = 200  # rows that decide the delimiter
Row = tuple[str, ...]
NumberedRow = tuple[int, Row]  # the line of the file, and its cells


@dataclass(frozen=True, eq=False)
class LazyRows(Sequence[Row]):
    """Lines as rows of cells, each cut when it is asked for."""

    lines: Sequence[str]
    delimiter: str

    def __len__(self) -> int:
        return len(self.lines)

    @overload
    def __getitem__(self, at: int) -> Row: ...
    @overload
    def __getitem__(self, at: slice) -> LazyRows: ...
    def __getitem__(self, at: int | slice) -> Row | LazyRows:
        some = self.lines[at]
        return (
            split_line_into_cells(some, self.delimiter)
            if isinstance(some, str)
            else replace(self, lines=some)
        )


@dataclass(frozen=True, eq=False)
class Sheet:
    """A file of rows and columns.

    header: names, or empty.  line: (m,) line of the file of each row.  cells: m rows of text.
    delimiter, decimal: empty where the text has no columns.  above, below: lines that are not of
    the table.  torn: lines that have fewer or more cells, where they were left out.
    block: (m, width) the cells as numbers, where all are.
    """

    path: Path
    text: str
    encoding: str
    delimiter: str
    decimal: str
    header: tuple[str, ...]
    line: Array
    cells: Sequence[Row]
    torn: tuple[int, ...] = ()
    above: tuple[int, ...] = ()
    below: tuple[int, ...] = ()
    block: Array | None = None

    @property
    def column_count(self) -> int:
        """Number of columns."""
        return len(self.header) or max(map(len, self.cells), default=0)

    def list_left_out_notices(self, other_lines: Iterable[int] = ()) -> tuple[str, ...]:
        """What is said of lines that are not of the table, torn, or broken otherwise."""
        parts = (("above", self.above), ("below", self.below))
        said = [
            f"{where} the table, and left out: line {', '.join(map(str, lines))}"
            for where, lines in parts
            if lines
        ]
        if lines := sorted({*self.torn, *other_lines}):
            some = ", ".join(map(str, lines[:MAX_LISTED_LINES])) + (
                " ..." if len(lines) > MAX_LISTED_LINES else ""
            )
            plural = "s are" if len(lines) > 1 else " is"
            said.append(f"{len(lines)} torn line{plural} left out ({some})")
        return tuple(f"{self.path}: {text}" for text in said)

    @property
    def digest(self) -> str:
        """SHA-256 of the text."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @property
    def is_marked_simulated(self) -> bool:
        """Whether the first line says that the points were computed, not measured."""
        return self.text.partition("\n")[0].strip(' \t\r,;"').lower() == SIMULATED_FIRST_LINE


def parse_numbers(cells: Sequence[str], decimal_sign: str = ".") -> Array:
    """(m,) numbers, NaN where a cell is empty or holds none."""
    given = [cell.replace(",", ".") for cell in cells] if decimal_sign == "," else list(cells)
    with suppress(ValueError):
        if "_" not in "".join(given):  # 1_000 is a number to Python only
            return np.array([cell or "nan" for cell in given], dtype=float)
    return np.array([parse_number(cell, decimal_sign) for cell in cells], dtype=float)


def parse_number(cell: str, decimal_sign: str = ".") -> float:
    """One number, NaN where the cell holds none.  Thousands may stand apart, by another sign."""
    if found := THOUSANDS_NUMBER_PATTERN.fullmatch(cell):
        cell = f"{cell[: found.start(2)].replace(found[1], '')}.{cell[found.end(2) :]}"
    try:
        return float(cell.replace(decimal_sign, ".") if "_" not in cell else "nan")
    except ValueError:
        return np.nan


def read_text_sheet(path: Path | str | Sheet) -> Sheet:
    """A text file, not yet cut into rows and columns; one that is open stays.  Raises DataError."""
    if isinstance(path, Sheet):
        return path
    path = Path(path)
    return build_text_sheet(
        path,
        *(
            (read_workbook_as_text(path), WORKBOOK_ENCODING)
            if is_workbook_path(path)
            else read_and_decode_text(path)
        ),
    )


def build_text_sheet(path: Path | str, text: str, encoding: str = "utf-8") -> Sheet:
    """A text that is, or shall be, in a file.  Raises DataError where it is none."""
    if "\0" in text:
        raise DataError(f"{path}: is not a text file; expected rows of numbers")
    if not text.strip():
        raise DataError(f"{path}: is empty")
    if text.startswith('"') and all(map(is_whole_line_quoted, text.rstrip("\n").split("\n"))):
        text = text.replace('"', "")
    if not text.isascii():
        text = text.replace("\u2212", "-")  # the minus of typographers
    return Sheet(Path(path), text, encoding, "", "", (), np.empty(0, dtype=int), ())


def is_whole_line_quoted(line: str) -> bool:
    """Whether a whole line was taken for one cell, and stands in quotation marks."""
    return line.startswith('"') and line.endswith('"') and line.count('"') == 2


def parse_sheet_table(
    sheet: Sheet,
    decimal_sign: str = "",
    *,
    max_torn_share: float = MAX_TORN_SHARE,
    lone_column_delimiter: str = "",
) -> Sheet:
    """The rows and columns of a text, by the delimiter and decimal sign found.  Raises DataError.

    decimal_sign: the sign, where the user gives it.  max_torn_share: share of rows that may be left
    out because they have fewer or more cells than the others, one of `MIN_ROWS_PER_TORN_ROW` in any
    case; where it is 0 none may, nor remarks below the table.  lone_column_delimiter: the delimiter
    of a table of one column.
    """
    path = sheet.path
    if (found := parse_pure_number_table(sheet, lone_column_delimiter, decimal_sign)) is not None:
        return found
    delimiter, notes, lines = split_delimiter_comments_lines(sheet, lone_column_delimiter)
    rows = split_lines_into_rows(path, lines, delimiter)
    if not rows:
        raise DataError(f"{path}: is empty")
    top, end = find_table_row_range([row for _, row in rows], sheet.encoding == WORKBOOK_ENCODING)
    end = end if max_torn_share else len(rows)
    above, below = (tuple(number for number, _ in some) for some in (rows[:top], rows[end:]))
    header, rows = split_header_from_rows(rows[top:end])
    if not header:
        header = find_header_in_comments(
            [line for n, line in notes.items() if n < rows[0][0]], delimiter, rows
        )
    if not rows:
        raise DataError(f"{path}: holds a header but no rows")
    width = (
        len(header)
        or Counter(len(strip_empty_end_cells(row)) for _, row in rows).most_common(1)[0][0]
    )
    if width > MAX_TABLE_COLUMNS:
        raise DataError(f"{path}: has {width} columns; a table has at most {MAX_TABLE_COLUMNS}")
    torn = [(number, row) for number, row in rows
            if len(row) < width or any(row[width:]) or row[:width] == header]  # fmt: skip
    if len(torn) > max(
        max_torn_share * len(rows), max_torn_share > 0.0 and len(rows) >= MIN_ROWS_PER_TORN_ROW
    ):
        number, row = torn[0]
        what = "the header has" if header else "most rows have"
        raise DataError(
            f"{path}:{number}: {len(strip_empty_end_cells(row))} cells, but {what} {width}; "
            "complete the row or delete it"
        )
    lost = tuple(number for number, _ in torn)
    rows = [(number, row) for number, row in rows if number not in lost] if lost else rows
    line = np.array([number for number, _ in rows], dtype=int)
    cells = tuple(row[:width] for _, row in rows)
    names = header or tuple(f"column {i + 1}" for i in range(width))
    sign = decimal_sign or detect_decimal_sign(path, names, line, cells)
    found = replace(sheet, delimiter=delimiter, decimal=sign, header=header, line=line, cells=cells)
    return replace(found, torn=lost, above=above, below=below)


class DelimitedText(NamedTuple):
    """The delimiter of a text, its comments by line number, and its other lines."""

    delimiter: str
    comments: dict[int, str]
    lines: list[str]


def split_delimiter_comments_lines(sheet: Sheet, lone_column_delimiter: str) -> DelimitedText:
    """The delimiter of a text, its comments by line, and its other lines.  Raises DataError.

    A line below the first other one that has as many cells as most is no comment, however it
    begins: a pose may be called #1.
    """
    lines = sheet.text.split("\n")
    notes = {n: line for n, line in enumerate(lines, 1) if line.lstrip().startswith(COMMENT_MARKS)}
    told = [n for n, line in enumerate(lines, 1) if n not in notes and line.strip(BLANK_LETTERS)]
    some = [lines[n - 1] for n in told[:DELIMITER_SAMPLE_LINES]]
    delimiter = (
        "\t"
        if sheet.encoding == WORKBOOK_ENCODING
        else detect_delimiter(some) or lone_column_delimiter
    )
    if not delimiter:
        raise DataError(
            f"{sheet.path}: has no columns that commas, semicolons, tabs or spaces separate"
        )
    if told and delimiter != " " and (usual := mode([line.count(delimiter) for line in some])):
        notes = {n: line for n, line in notes.items()
                 if n < told[0] or line.count(delimiter) != usual}  # fmt: skip
    for n in notes:
        lines[n - 1] = ""
    return DelimitedText(delimiter, notes, lines)


def parse_pure_number_table(
    sheet: Sheet, lone_column_delimiter: str, decimal_sign: str
) -> Sheet | None:
    """The table of a text that holds a header and below it plain numbers alone; else None.

    Read as JSON, whose numbers are rounded as Python's.
    """
    from pydantic_core import from_json

    lines = sheet.text.split("\n")
    told = (
        n
        for n, line in enumerate(lines)
        if line.strip(BLANK_LETTERS) and not line.lstrip().startswith(COMMENT_MARKS)
    )
    top = next(told, len(lines))
    last = next((n for n in range(len(lines), top, -1) if lines[n - 1].strip(BLANK_LETTERS)), top)
    body = lines[top + 1 : last]
    delimiter = (
        detect_delimiter(lines[top : min(top + DELIMITER_SAMPLE_LINES, last)])
        or lone_column_delimiter
    )
    if not body or delimiter in ("", " ") or '"' in lines[top]:
        return None
    head = strip_empty_end_cells(split_line_into_cells(lines[top], delimiter))
    if comma := delimiter != "," and "," in body[0] and decimal_sign != ".":
        every = "\n".join(body)
        if "." in every or not (decimal_sign or CERTAIN_DECIMAL_COMMA_PATTERN.search(every)):
            return None
        body = every.replace(",", ".").split("\n")
    block, sign = np.empty((len(body), len(head))), delimiter.encode()
    cut = sign * (len(head) - 1) + b"\n"  # what a row holds beside its numbers
    for first in range(0, len(body), ROWS_PARSED_AT_ONCE) if is_header_row(head) else ():
        some = body[first : first + ROWS_PARSED_AT_ONCE]
        raw = "\n".join([*some, ""]).encode()
        if raw.translate(None, NUMBER_LETTERS) != cut * len(some):
            return None
        try:
            values = from_json(b"[" + raw[:-1].replace(b"\n", sign).replace(sign, b",") + b"]")
        except ValueError:
            return None
        block[first : first + ROWS_PARSED_AT_ONCE] = np.array(values, dtype=float).reshape(
            -1, len(head)
        )
    if not (is_header_row(head) and np.isfinite(block).all()):
        return None
    line = np.arange(top + 1, last) + 1
    return replace(sheet, delimiter=delimiter, header=head, line=line, block=block,
                   decimal="," if comma else ".", cells=LazyRows(body, delimiter))  # fmt: skip


class RowRange(NamedTuple):
    """Index of the first row of a table, and of the first row below it."""

    first: int
    end: int


def find_table_row_range(rows: list[Row], are_rows_padded: bool) -> RowRange:
    """The first row of the table, and the first below it.

    Above it are rows that say something else, half as long, or shorter; below it means and the
    like, or in half the columns at most words alone, or what is of all rows.  are_rows_padded:
    whether all rows have cells up to the last column.
    """
    short = [len(strip_empty_end_cells(row)) for row in rows]
    lengths = short if are_rows_padded else list(map(len, rows))
    width, most = (Counter(some).most_common(1)[0][0] for some in (short, lengths))
    first = next((i for i, length in enumerate(short) if 2 * length > width), 0)
    last = len(rows)
    while last > 1:
        filled = [cell for cell in rows[last - 1] if cell] or [""]
        of_all = meaning_of_plain_name(filled[0].rstrip(":")) or not any(
            map(is_number_cell, filled)
        )
        if not (is_summary_cell(filled[0]) or (of_all and 2 * lengths[last - 1] <= most)):
            break
        last -= 1
    return RowRange(first if first < len(rows) - 1 else 0, last)


class HeaderAndRows(NamedTuple):
    """Names of columns, and the rows below them."""

    header: tuple[str, ...]
    rows: list[NumberedRow]


def split_header_from_rows(rows: list[NumberedRow]) -> HeaderAndRows:
    """Names of the columns with their units, and the rows below.

    A row of names that are the same, or not there, has names of groups above it or below it: SMR 1
    over X, Y, Z.
    """
    if not is_header_row(rows[0][1]):
        return HeaderAndRows((), rows)
    names, rows = [*strip_empty_end_cells(rows[0][1])], rows[1:]
    if "" in names and len(rows) > 1 and not any(map(is_number_cell, rows[0][1])):
        names, rows = join_group_names(names, rows[0][1]), rows[1:]
    if rows and (units := parse_unit_row(rows[0][1], len(names))):
        names = [f"{n} [{u}]" if u else n for n, u in zip(names, units, strict=True)]
        rows = rows[1:]
    return HeaderAndRows(tuple(names), rows)


def join_group_names(group_names: Sequence[str], names_below: Row) -> list[str]:
    """The names below groups, each with that of its group where others are called alike."""
    names = [*strip_empty_end_cells(names_below)]
    names += [""] * (len(group_names) - len(names))
    over: list[str] = []
    for group in [*group_names, *[""] * len(names)][: len(names)]:
        over.append(group or (over[-1] if over else ""))
    return [
        f"{group} {name}".strip() if not name or names.count(name) > 1 else name
        for group, name in zip(over, names, strict=True)
    ]


def find_header_in_comments(
    comments: list[str], delimiter: str, rows: list[NumberedRow]
) -> tuple[str, ...]:
    """The names of a last comment above the rows that has one for each column, else nothing."""
    marks = "".join(COMMENT_MARKS)
    names = (
        ()
        if not comments or '"' in comments[-1]
        else split_line_into_cells(comments[-1].strip(marks + " "), delimiter)
    )
    right = len(names) == len(strip_empty_end_cells(rows[0][1])) and is_header_row(names)
    return tuple(names) if right and is_understood_header(names) else ()


def parse_unit_row(row: Row, column_count: int) -> list[str]:
    """The units of a row that holds nothing else, below the header; else nothing."""
    cells = [cell.strip("[]() ") for cell in (*row, *[""] * column_count)][:column_count]
    filled = [cell for cell in cells if cell and cell != "-"]
    known = bool(filled) and all(map(standard_unit_name, filled))
    return [cell if standard_unit_name(cell) else "" for cell in cells] if known else []


class DecodedText(NamedTuple):
    """The text of a file, its lines ended alike, and the name of its encoding."""

    text: str
    encoding: str


def read_and_decode_text(path: Path) -> DecodedText:
    """The text, its lines ended alike, and the name of its encoding.  Raises DataError."""
    raw = read_bytes(path, error_type=DataError)
    if raw.startswith(SPREADSHEET_FILE_STARTS):
        raise DataError(f"{path}: is a spreadsheet, not text; save it as CSV")
    for name, codec in TRIED_ENCODINGS:
        with suppress(UnicodeError):
            if fits_encoding(codec, raw):
                text = raw.decode(codec)
                if "\r" in text:
                    text = text.replace("\r\n", "\n").replace("\r", "\n")
                return DecodedText(text, name)
    raise DataError(f"{path}: is not a text file; expected rows of numbers")


def fits_encoding(codec: str, raw: bytes) -> bool:
    """Whether bytes look as in a codec: 16 bits a letter begin by a mark, or have zeros in turn.

    Letters with accents can be Chinese signs, rare ones; a Chinese text has common ones mostly.
    """
    if codec.startswith("utf-16"):
        zeros = {"utf-16-le": raw[1:8:2], "utf-16-be": raw[:8:2]}.get(codec, b"")
        return (
            raw.startswith(UTF16_BYTE_ORDER_MARKS)
            if codec == "utf-16"
            else bool(zeros) and not any(zeros)
        )
    common = (
        [bool(sign[1]) for sign in CHINESE_LETTER_PATTERN.finditer(raw)]
        if codec == "gbk"
        else [True]
    )
    return 2 * sum(common) > len(common)


def split_line_into_cells(line: str, delimiter: str) -> Row:
    """The cells of a line."""
    if delimiter == " ":
        return tuple(line.split())
    if '"' not in line:
        return tuple(map(str.strip, line.split(delimiter)))
    row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True, strict=True))
    return tuple(map(str.strip, row))


def split_lines_into_rows(path: Path, lines: Sequence[str], delimiter: str) -> list[NumberedRow]:
    """The rows that hold something, each with the line on which it ends.  Raises DataError."""
    if delimiter == " " or not any('"' in line for line in lines):
        return [(n, split_line_into_cells(line, delimiter)) for n, line in enumerate(lines, 1)
                if line.strip(BLANK_LETTERS)]  # fmt: skip
    text = io.StringIO("\n".join(lines), newline="")
    reader = csv.reader(text, delimiter=delimiter, skipinitialspace=True, strict=True)
    rows, begun = [], 0
    try:
        for row in reader:
            begun = reader.line_num
            rows.append((begun, tuple(map(str.strip, row))))
    except csv.Error:
        what = "has a quotation mark without its pair; delete it"
        raise DataError(f"{path}:{begun + 1}: {what}") from None
    return [row for row in rows if any(row[1])]


def strip_empty_end_cells(row: Row) -> Row:
    """A row without empty cells at its end."""
    end = max((i + 1 for i, cell in enumerate(row) if cell), default=0)
    return row[:end]


def is_number_cell(cell: str) -> bool:
    """Whether a cell is a number with either decimal sign."""
    return bool(
        CELL_NUMBER_PATTERN.fullmatch(cell)
        or COMMA_NUMBER_PATTERN.fullmatch(cell)
        or THOUSANDS_NUMBER_PATTERN.fullmatch(cell)
    )


def is_header_row(row: Row) -> bool:
    """Whether most cells of a row are words."""
    filled = [cell for cell in row if cell]
    return 2 * sum(not is_number_cell(cell) for cell in filled) > len(filled)


def detect_delimiter(lines: list[str]) -> str:
    """The delimiter that cuts most lines into one count, with most digits in numbers, or ''."""
    best, most = "", 0.0
    for delimiter in DELIMITER_NAMES:
        rows: list[Row] = []
        for line in lines:
            with suppress(csv.Error):
                rows.append(split_line_into_cells(line, delimiter))
        if not rows:
            continue
        count, times = Counter(map(len, rows)).most_common(1)[0]
        if count < 2 or 2 * times < len(rows):
            continue
        body = rows[1:] or rows
        score = times * sum(len(cell) for row in body for cell in row if is_number_cell(cell))
        if score > most or not best:
            best, most = delimiter, score
    return best


def detect_decimal_sign(
    path: Path,
    column_names: tuple[str, ...],
    line_numbers: Array,
    cells: tuple[tuple[str, ...], ...],
) -> str:
    """The decimal sign, where the cells prove it.  Raises DataError."""
    if not any("," in cell for row in cells for cell in row):
        return "."
    comma, point, proven = "", "", False
    for number, row in zip(line_numbers, cells, strict=True):
        for name, cell in zip(column_names, row, strict=True):
            found = COMMA_NUMBER_PATTERN.fullmatch(cell)
            apart = None if found else THOUSANDS_NUMBER_PATTERN.fullmatch(cell)
            if found:
                proven |= len(found[2]) != 3 or len(found[1]) > 3 or found[1] in ("", "0")
                proven |= bool(found[3])
            if found or (apart and apart[2] == ","):
                comma = comma or f"{path}:{number}: column {name}: {cell}"
                proven |= bool(apart)
            elif not point and (apart or ("." in cell and CELL_NUMBER_PATTERN.fullmatch(cell))):
                point = f"column {name} of line {number}: {cell}"
    if comma and point:
        raise DataError(
            f"{comma} has a decimal comma, but {point} has a decimal point; use a decimal point in "
            "all, or a comma"
        )
    if comma and not proven:
        raise DataError(
            f"{comma} may have a decimal comma or be thousands; add decimal='comma', or take "
            "the commas out"
        )
    return "," if comma else "."
