"""One page for all studies: their tables, pictures and files, with what they were made on."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from experiments.sweep import needed
from minimax_cal.ground.files import write_whole
from minimax_cal.ground.tables import Table

TEMPLATE = "index.html.jinja"


@dataclass(frozen=True)
class Outcome:
    """How a study went: done, or failed with its error; files: what it wrote."""

    name: str
    description: str
    status: str
    error: str = ""
    files: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Link:
    """A file to point at: where it is from the page, escaped for a URL, and its name."""

    url: str
    name: str


def write_index(folder: Path, command: str, made_on: Table, outcomes: Sequence[Outcome]) -> Path:
    """Write folder/index.html about the outcomes; every file shown lies below folder."""
    jinja2 = needed("jinja2", "experiments")
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    pages = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    studies = [
        {
            "outcome": outcome,
            "tables": [path.read_text("utf-8") for path in with_suffix(outcome, ".html")],
            "figures": [
                (link(folder, path), links(folder, outcome, path.with_suffix(".svg")))
                for path in with_suffix(outcome, ".png")
            ],
            "links": links(folder, outcome, *with_suffix(outcome, ".csv", ".tex", ".json")),
        }
        for outcome in outcomes
    ]
    page = pages.get_template(TEMPLATE).render(
        command=command, made_on=made_on.cells(), studies=studies
    )
    write_whole(folder / "index.html", page)
    return folder / "index.html"


def with_suffix(outcome: Outcome, *suffixes: str) -> list[Path]:
    """The study's files of these kinds, in the order of their numbers."""
    found = [path for path in outcome.files if path.suffix in suffixes]
    return sorted(found, key=lambda path: (suffixes.index(path.suffix), natural(path.stem)))


def natural(text: str) -> list[tuple[int, str]]:
    """Sorts table_10 after table_9."""
    return [(int(word), "") if word.isdigit() else (-1, word) for word in re.split(r"(\d+)", text)]


def link(folder: Path, path: Path) -> Link:
    """A file as seen from the page in folder."""
    return Link(quote(path.relative_to(folder).as_posix()), path.name)


def links(folder: Path, outcome: Outcome, *paths: Path) -> list[Link]:
    """Those of the paths that the study wrote."""
    return [link(folder, path) for path in paths if path in outcome.files]
