"""The papers item by item: errata, verdicts, and that the pages say what the commands print."""

import csv
import io
import re
from itertools import permutations, takewhile
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from conftest import ROOT, shared
from numpy.testing import assert_allclose

from experiments import errata
from experiments.__main__ import STUDIES
from experiments.conditions import PAPER
from experiments.verdicts import HEADER, MISSING, TOO_FEW, VERDICTS

PAGE = ROOT / "docs" / "papers.md"
LIST = ROOT / "docs" / "errata.md"


# ---- errata ------------------------------------------------------------------------------------


@pytest.mark.parametrize("one", errata.ERRATA, ids=lambda one: one.where)
def test_an_erratum_is_shown_by_its_counter_example(one):
    assert errata.stands(one)


def test_what_was_withdrawn_is_shown_too():
    """The printed iteration ends at the optimum, x = 1, from multipliers above and below."""
    ends = errata.WITHDRAWN[0].numbers()
    assert_allclose(ends, 1.0, atol=1e-4)
    assert len(errata.ERRATA) == 13
    assert not {one.where for one in errata.ERRATA} & {one.where for one in errata.WITHDRAWN}


def test_no_entries_of_table_3_give_the_percentages_of_the_text():
    columns = np.array(list(PAPER.values())).T
    pairs = np.array([(a, b) for column in columns for a, b in permutations(column, 2)])
    given = 100.0 * (1.0 - np.concatenate([pairs[:, 1] / pairs[:, 0],
                                           np.sqrt(pairs[:, 1] / pairs[:, 0])]))  # fmt: skip
    for printed in (67.34, 23.48, 14.36):
        assert np.abs(given - printed).min() > 0.02, printed  # two decimals are told


def test_the_list_on_the_page_is_what_the_command_writes():
    assert errata.page() in LIST.read_text(encoding="utf-8")


# ---- the page ----------------------------------------------------------------------------------

NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
LOOSE, TINY = 0.05, 1e-5  # of a number on another machine; below: rounding
MOVED = "S Table 2: % of starts, each moved by a unit of rounding"
POINTS = 3.0  # percent points of 441 starts that rounding may send another way
ROUNDED = ("S Fig. 5", "S Fig. 6")  # ways of single starts, which rounding decides on each machine
BAR = re.compile(r"(?<!\\)\|")  # between cells; a bar within one is escaped
RULE = re.compile(r"(?:; |^)rule: .*$")
SPAN = re.compile(rf"({NUMBER.pattern})(?: to ({NUMBER.pattern}))?")
TIMES, COUNT = 3.0, 6.0  # spans over nine copies of a start meet within this factor, or so many


def rows_of_page() -> list[tuple[str, ...]]:
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    first = lines.index(f"| {' | '.join(HEADER)} |") + 2
    rows = (BAR.split(row)[1:-1] for row in takewhile(lambda line: line[:1] == "|", lines[first:]))
    return [tuple(cell.strip().replace(r"\|", "|") for cell in row) for row in rows]


def test_the_page_has_no_item_that_is_not_covered_but_for_hardware():
    rows = rows_of_page()
    assert len({row[0] for row in rows}) == len(rows) >= 20
    for item, command, paper, ours, verdict, remark in rows:
        assert verdict in VERDICTS, item
        assert (verdict == MISSING) == remark.startswith("hardware we lack: "), item
        assert command in STUDIES or verdict == MISSING, item
        assert paper, item
        assert ours, item


def rows_of_command(out: Path, *options: str) -> list[list[str]]:
    """The verdicts that a run writes, without the rules, which the page leaves out."""
    from experiments.papers import main

    result = CliRunner().invoke(main, ["--out", str(out), *options])
    assert result.exit_code == 0, result.output[-2000:]
    text = (out / "verdicts.csv").read_text(encoding="utf-8")
    header, *rows = csv.reader(io.StringIO(text))
    assert tuple(header) == HEADER
    return [[*row[:-1], RULE.sub("", row[-1])] for row in rows]


@pytest.mark.slow
def test_no_quick_verdict_contradicts_the_page(tmp_path):
    verdict = {row[0]: row[4] for row in rows_of_page()}
    quick = {row[0]: row[4] for row in rows_of_command(tmp_path, "--quick")}
    said = {item: one for item, one in quick.items() if item in verdict and one != TOO_FEW}
    assert said
    assert said == {item: verdict[item] for item in said}


@pytest.mark.slow
def test_the_page_says_what_the_command_prints(tmp_path):
    for arm in ("irb120", "fanuc_r2000", "ur10_b", "meca500_r"):
        shared(arm)  # skips where its measurements are not there
    fresh = {row[0]: row for row in rows_of_command(tmp_path)}
    for old in rows_of_page():
        new = fresh[old[0]]
        assert new[4] == old[4], new[0]
        for one, other in zip(new, old, strict=True):
            assert SPAN.sub("#", one) == SPAN.sub("#", other), new[0]
            assert same_numbers(new[0], one, other), (new[0], one, other)


def same_numbers(item: str, one: str, other: str) -> bool:
    """Whether two cells of an item tell the same, as far as machines agree on it."""
    if item.startswith(ROUNDED):
        pairs = zip(SPAN.findall(one), SPAN.findall(other), strict=True)
        return all(meet(*(tuple(float(x or span[0]) for x in span) for span in p)) for p in pairs)
    a, b = (np.array(NUMBER.findall(cell), dtype=float) for cell in (one, other))
    away = dict(rtol=0.0, atol=POINTS) if item == MOVED else dict(rtol=LOOSE, atol=TINY)
    return bool(np.allclose(a, b, **away))


def meet(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    """Whether two spans overlap, or nearly."""
    (low, high), (least, most) = one, other
    return low <= max(TIMES * most, most + COUNT) and least <= max(TIMES * high, high + COUNT)


def test_pages_are_compared_as_far_as_machines_agree():
    assert same_numbers("S Fig. 5: x", "150 to 360 / 7", "400 / 7")
    assert not same_numbers("S Fig. 5: x", "150 to 360 / 7", "1200 / 7")
    assert not same_numbers("S Fig. 6: x", "0 / 9 of 9", "7 / 9 of 9")
    assert same_numbers(MOVED, "98.2 / 0.0", "96.1 / 0.2")
    assert not same_numbers(MOVED, "98.2", "94.2")
    assert not same_numbers("M Table 4", "1.00", "1.06")
