"""One page for all studies: their tables, pictures and files, with what they were made on."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from experiments.sweep import import_optional_module
from minimax_cal.core.files import write_file_atomically
from minimax_cal.core.tables import Table

INDEX_TEMPLATE = "index.html.jinja"


@dataclass(frozen=True)
class StudyOutcome:
    """How a study went: done, or failed with its error; files: what it wrote."""

    name: str
    description: str
    status: str
    error: str = ""
    files: tuple[Path, ...] = ()


@dataclass(frozen=True)
class FileLink:
    """A file to point at: where it is from the page, escaped for a URL, and its name."""

    url: str
    name: str


def write_index_page(
    folder: Path, command: str, made_on: Table, outcomes: Sequence[StudyOutcome]
) -> Path:
    """Write folder/index.html about the outcomes; every file shown lies below folder."""
    jinja2 = import_optional_module("jinja2", "experiments")
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    pages = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    studies = [
        {
            "outcome": outcome,
            "tables": [
                path.read_text("utf-8") for path in list_files_with_suffix(outcome, ".html")
            ],
            "figures": [
                (
                    build_file_link(folder, path),
                    build_file_links(folder, outcome, path.with_suffix(".svg")),
                )
                for path in list_files_with_suffix(outcome, ".png")
            ],
            "links": build_file_links(
                folder, outcome, *list_files_with_suffix(outcome, ".csv", ".tex", ".json")
            ),
        }
        for outcome in outcomes
    ]
    page = pages.get_template(INDEX_TEMPLATE).render(
        command=command, made_on=made_on.formatted_cells(), studies=studies
    )
    write_file_atomically(folder / "index.html", page)
    return folder / "index.html"


def list_files_with_suffix(outcome: StudyOutcome, *suffixes: str) -> list[Path]:
    """The study's files of these kinds, in the order of their numbers."""
    found = [path for path in outcome.files if path.suffix in suffixes]
    return sorted(
        found, key=lambda path: (suffixes.index(path.suffix), natural_sort_key(path.stem))
    )


def natural_sort_key(text: str) -> list[tuple[int, str]]:
    """Sorts table_10 after table_9."""
    return [(int(word), "") if word.isdigit() else (-1, word) for word in re.split(r"(\d+)", text)]


def build_file_link(folder: Path, path: Path) -> FileLink:
    """A file as seen from the page in folder."""
    return FileLink(quote(path.relative_to(folder).as_posix()), path.name)


def build_file_links(folder: Path, outcome: StudyOutcome, *paths: Path) -> list[FileLink]:
    """Those of the paths that the study wrote."""
    return [build_file_link(folder, path) for path in paths if path in outcome.files]
