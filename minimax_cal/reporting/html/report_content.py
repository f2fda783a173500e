"""What a report consists of: sections of sentences, tables and figures; not how they look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table

MAX_FIGURE_LABEL_LETTERS = 70  # letters of a label in a figure
MAX_CHART_POSES = 500  # drawn one by one; more only cost time and hide each other


@dataclass(frozen=True)
class NoteBlock:
    """A sentence or some.  kind: text, verdict, notice, caveat, missing, warning or banner."""

    text: str
    kind: str = "text"


@dataclass(frozen=True, eq=False)
class ChartBlock:
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
class View3dBlock(ChartBlock):
    """A view in three dimensions.  still: the same as SVG, for paper and where nothing moves.

    arms: for the page's controls, see `scene`.
    """

    still: str = ""
    arms: dict[str, Any] = field(default_factory=dict)


ReportBlock = NoteBlock | Table | ChartBlock
ReportBlocks = Sequence[ReportBlock]


@dataclass(frozen=True, eq=False)
class ReportSection:
    """A part of the report.  name: of its element.  sheet: whether it is a page of its own."""

    name: str
    title: str
    blocks: tuple[ReportBlock, ...]
    sheet: bool = True

    @property
    def has_content(self) -> bool:
        """Whether it holds more than what is missing; without, it is no chapter."""
        return any(not isinstance(one, NoteBlock) or one.kind != "missing" for one in self.blocks)


@dataclass(frozen=True, eq=False)
class ReportDocument:
    """The whole document.

    facts: of the title block, label and text, empty where people write by hand.  sections: the
    first is the one to sign.  digest: of the data.  kind: above the title.
    """

    title: str
    robot: str
    facts: tuple[tuple[str, str], ...]
    signatures: tuple[tuple[str, str], ...]
    sections: tuple[ReportSection, ...]
    digest: str
    kind: str = "Calibration report"


def join_pages_and_appendix(
    pages: Sequence[ReportSection], appendix_sections: Sequence[ReportSection], with_appendix: bool
) -> tuple[ReportSection, ...]:
    """The pages with the appendix, or with a line that says what it would hold."""
    pages = [part for part in pages if part.has_content]
    rest = [replace(part, sheet=False) for part in appendix_sections if part.has_content]
    if with_appendix or not rest:
        return (*pages, *rest)
    titles = "; ".join(part.title for part in rest)
    note = NoteBlock(f"This report is without its appendix, which has: {titles}.", "notice")
    return (*pages[:-1], replace(pages[-1], blocks=(*pages[-1].blocks, note)))


def build_text_note(sentence: str) -> NoteBlock:
    """Plain text."""
    return NoteBlock(sentence)


def build_missing_note(sentence: str) -> NoteBlock:
    """What the files do not hold."""
    return NoteBlock(sentence, "missing")


def build_caveat_note(sentence: str) -> NoteBlock:
    """What to bear in mind."""
    return NoteBlock(sentence, "caveat")


def escape_figure_label(label_text: str) -> str:
    """Text in a figure: plotly reads <, > and & as marks of its own; very long ones are cut."""
    short = (
        label_text
        if len(label_text) <= MAX_FIGURE_LABEL_LETTERS
        else label_text[: MAX_FIGURE_LABEL_LETTERS - 1] + "…"
    )
    return short.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def round_for_json(values: Array, digits: int = 6) -> list[float | None]:
    """A list for JSON, rounded to some digits; null where there is no number."""
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in np.ravel(values)]


def select_drawn_indices(sizes: Array, max_count: int = MAX_CHART_POSES) -> Array:
    """Indices of at most so many: a quarter of them the largest, the others evenly spread."""
    if len(sizes) <= max_count:
        return np.arange(len(sizes))
    largest = np.argsort(-np.nan_to_num(sizes), kind="stable")[: max_count // 4]
    others = np.setdiff1d(np.arange(len(sizes)), largest)
    even = others[np.linspace(0, len(others) - 1, max_count - len(largest)).astype(int)]
    return np.sort(np.concatenate([largest, even]))
