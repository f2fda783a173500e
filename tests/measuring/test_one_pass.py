"""Texts of programs are searched in one pass, however long a word or a blank is."""

import re

import pytest

from minimax_cal.measuring.importers import cmm, programs
from minimax_cal.reading import words

TEXTS = (
    "9" * 200_000,
    "P[1]{ " * 40_000,
    "x = {X 1 " * 30_000,
    "{ " * 100_000,
    "[" + " " * 200_000,
    "x = [" + "1, " * 60_000,
)


WORDS = {found for found in vars(words).values() if isinstance(found, re.Pattern)}
PATTERNS = [found for module in (cmm, programs) for found in vars(module).values()
            if isinstance(found, re.Pattern) and found not in WORDS]  # fmt: skip
PATTERNS += [language.cartesian for language in programs.LANGUAGES]


@pytest.mark.parametrize(
    "text", TEXTS, ids=["digits", "positions", "poses", "braces", "blanks", "numbers"]
)
@pytest.mark.parametrize("pattern", PATTERNS)
def test_no_text_takes_more_than_one_pass(pattern, text):
    """Each would take minutes, were its time to grow with the square of its length."""
    assert sum(1 for _ in pattern.finditer(text)) <= len(text)


@pytest.mark.parametrize("cell", ["x_" * 20_000, "pos_x" * 10_000, "x_pos_" * 10_000, "9" * 40_000])
@pytest.mark.parametrize("pattern", sorted(WORDS, key=lambda found: found.pattern))
def test_no_name_takes_more_than_one_pass(pattern, cell):
    """Words are compared with whole cells."""
    assert pattern.fullmatch(cell + "!") is None
