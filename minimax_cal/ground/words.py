"""Text from files and names on its way to people."""

from __future__ import annotations

import unicodedata

HIDDEN = ("Cc", "Cs", "LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI")
REPLACED = "\N{REPLACEMENT CHARACTER}"
LONGEST = 1000  # letters of a message; a cell of a file may hold more than anybody reads


def visible(text: str) -> str:
    """Text without control characters, which could hide or reverse what a reader signs."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        REPLACED
        if unicodedata.category(letter) in HIDDEN or unicodedata.bidirectional(letter) in HIDDEN
        else letter
        for letter in text
    )


def one_line(text: str) -> str:
    """A message in one line that hides nothing and floods no terminal."""
    line = visible(" ".join(text.split()))
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 1]}\N{HORIZONTAL ELLIPSIS}"
