"""What a report consists of: sections of sentences, tables and figures; not how they look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Table

LONGEST = 70  # letters of a label in a figure
MOST_POSES = 500  # drawn one by one; more only cost time and hide each other


@dataclass(frozen=True)
class Note:
    """A sentence or some.  kind: text, verdict, notice, caveat, missing, warning or banner."""

    text: str
    kind: str = "text"


@dataclass(frozen=True, eq=False)
class Figure:
    """A chart as plotly draws it.  name: of its element.  says: for those who do not see it.

    Colours are names of the page's palette, so that the page may be light or dark.
    """

    name: str
    title: str
    says: str
    traces: tuple[dict[str, Any], ...]
    layout: dict[str, Any]
    height: int = 340


@dataclass(frozen=True, eq=False)
class View(Figure):
    """A view in three dimensions.  still: the same as SVG, for paper and where nothing moves.

    arms: for the page's controls, see `scene`.
    """

    still: str = ""
    arms: dict[str, Any] = field(default_factory=dict)


Block = Note | Table | Figure
Blocks = Sequence[Block]


@dataclass(frozen=True, eq=False)
class Section:
    """A part of the report.  name: of its element.  sheet: whether it is a page of its own."""

    name: str
    title: str
    blocks: tuple[Block, ...]
    sheet: bool = True

    @property
    def is_told(self) -> bool:
        """Whether it holds more than what is missing; without, it is no chapter."""
        return any(not isinstance(one, Note) or one.kind != "missing" for one in self.blocks)


@dataclass(frozen=True, eq=False)
class Report:
    """The whole document.

    facts: of the title block, label and text, empty where people write by hand.  sections: the
    first is the one to sign.  digest: of the data.  kind: above the title.
    """

    title: str
    robot: str
    facts: tuple[tuple[str, str], ...]
    signatures: tuple[tuple[str, str], ...]
    sections: tuple[Section, ...]
    digest: str
    kind: str = "Calibration report"


def bound(pages: Sequence[Section], more: Sequence[Section], appendix: bool) -> tuple[Section, ...]:
    """The pages with the appendix, or with a line that says what it would hold."""
    pages = [part for part in pages if part.is_told]
    rest = [replace(part, sheet=False) for part in more if part.is_told]
    if appendix or not rest:
        return (*pages, *rest)
    titles = "; ".join(part.title for part in rest)
    note = Note(f"This report is without its appendix, which has: {titles}.", "notice")
    return (*pages[:-1], replace(pages[-1], blocks=(*pages[-1].blocks, note)))


def text(sentence: str) -> Note:
    """Plain text."""
    return Note(sentence)


def missing(sentence: str) -> Note:
    """What the files do not hold."""
    return Note(sentence, "missing")


def caveat(sentence: str) -> Note:
    """What to bear in mind."""
    return Note(sentence, "caveat")


def label(words: str) -> str:
    """Text in a figure: plotly reads <, > and & as marks of its own; very long ones are cut."""
    short = words if len(words) <= LONGEST else words[: LONGEST - 1] + "…"
    return short.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def plain(values: Array, digits: int = 6) -> list[float | None]:
    """A list for JSON, rounded to some digits; null where there is no number."""
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in np.ravel(values)]


def some(size: Array, most: int = MOST_POSES) -> Array:
    """Indices of at most so many: a quarter of them the largest, the others evenly spread."""
    if len(size) <= most:
        return np.arange(len(size))
    largest = np.argsort(-np.nan_to_num(size), kind="stable")[: most // 4]
    others = np.setdiff1d(np.arange(len(size)), largest)
    even = others[np.linspace(0, len(others) - 1, most - len(largest)).astype(int)]
    return np.sort(np.concatenate([largest, even]))
