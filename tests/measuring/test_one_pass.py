"""Texts of programs are searched in one pass, however long a word or a blank is."""

import re

import pytest

from minimax_cal.measuring.importers import krl, rapid, urscript

TEXTS = ("9" * 200_000, "{ " * 100_000, "[" + " " * 200_000, "x = [" + "1, " * 60_000)


@pytest.mark.parametrize("text", TEXTS, ids=["digits", "braces", "blanks", "numbers"])
@pytest.mark.parametrize("pattern", [krl.TARGET, krl.AXIS, urscript.LIST, rapid.VALUES])
def test_no_text_takes_more_than_one_pass(pattern: re.Pattern[str], text: str) -> None:
    """Each would take minutes, were its time to grow with the square of its length."""
    assert pattern.search(text) is None
