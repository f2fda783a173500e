"""Text from files and names on its way to people."""

from __future__ import annotations

import csv
import io
import re
import unicodedata
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

HIDDEN_CHARACTER_CLASSES = (
    "Cc",
    "Cs",
    "LRE",
    "RLE",
    "LRO",
    "RLO",
    "PDF",
    "LRI",
    "RLI",
    "FSI",
    "PDI",
)
REPLACEMENT_CHARACTER = "\N{REPLACEMENT CHARACTER}"
MAX_MESSAGE_LETTERS = (
    1000  # letters of a message; a cell of a file may hold more than anybody reads
)

FORMULA_START_CHARACTERS = tuple("=+-@\t\r\N{FULLWIDTH EQUALS SIGN}\N{FULLWIDTH PLUS SIGN}"
                "\N{FULLWIDTH HYPHEN-MINUS}\N{FULLWIDTH COMMERCIAL AT}")  # fmt: skip


def format_first_names(names: Sequence[str], max_names: int = 8, separator: str = ", ") -> str:
    """The first few names, and how many more there are."""
    more = f" and {len(names) - max_names} more" if len(names) > max_names else ""
    return separator.join(names[:max_names]) + more


def capitalise_sentence(sentence: str) -> str:
    """A sentence with a large first letter, unless it begins with a path, a name or a number."""
    word = sentence.split(maxsplit=1)[0].rstrip(".,:;") if sentence.strip() else ""
    plain = word.replace("-", "").isalpha()
    return sentence[:1].upper() + sentence[1:] if plain else sentence


def format_counts_largest_first(counts: Mapping[str, int]) -> str:
    """How many by whom, the most first, as 4 by daqp, 1 by highs."""
    most_first = sorted(counts.items(), key=lambda item: -item[1])
    return ", ".join(f"{count} by {name}" for name, count in most_first)


def replace_invisible_and_bidi_characters(text: str) -> str:
    """Text without control characters, which could hide or reverse what a reader signs."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        REPLACEMENT_CHARACTER
        if unicodedata.category(letter) in HIDDEN_CHARACTER_CLASSES
        or unicodedata.bidirectional(letter) in HIDDEN_CHARACTER_CLASSES
        else letter
        for letter in text
    )


def clean_and_shorten_to_one_line(text: str) -> str:
    """A message in one line that hides nothing and floods no terminal."""
    line = replace_invisible_and_bidi_characters(" ".join(text.split()))
    return (
        line
        if len(line) <= MAX_MESSAGE_LETTERS
        else f"{line[: MAX_MESSAGE_LETTERS - 1]}\N{HORIZONTAL ELLIPSIS}"
    )


def replace_matches_with_spaces(text: str, pattern: re.Pattern[str]) -> str:
    """Text with what matches turned into spaces; line ends stay."""
    return pattern.sub(lambda found: re.sub(r"[^\r\n]", " ", found[0]), text)


class EscapedCsv(NamedTuple):
    """A CSV text whose formulas are escaped, and the number of cells that were."""

    text: str
    escaped_cell_count: int


def escape_spreadsheet_formulas(csv_text: str) -> EscapedCsv:
    """Put an apostrophe before each cell that a spreadsheet would run as a formula."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    count = 0
    for row in csv.reader(io.StringIO(csv_text, newline="")):
        runs = [is_spreadsheet_formula(cell) for cell in row]
        count += sum(runs)
        writer.writerow([f"'{cell}" if run else cell for cell, run in zip(row, runs, strict=True)])
    return EscapedCsv(stream.getvalue(), count)


def is_spreadsheet_formula(cell: str) -> bool:
    """Whether a spreadsheet takes a cell for a formula; a number with its sign is none."""
    if not cell.startswith(FORMULA_START_CHARACTERS):
        return False
    with suppress(ValueError):
        float(cell)
        return False
    return True
