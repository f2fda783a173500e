"""A calibration, a diagnosis or both as one page that needs nothing else."""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from datetime import date as Date
from functools import partial
from pathlib import Path

from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.fitting.calibration import Calibration
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import check_writable, write_whole
from minimax_cal.reporting.html import (
    Sources,
    Wording,
    compose,
    find_browser,
    print_pdf,
    read_sources,
    render,
)

PAGES, PAPERS = (".html", ".htm"), (".pdf",)
Result = Calibration | Diagnosis | Path | str


def report(
    results: Result | Sequence[Result],
    path: Path | str = "report.html",
    *,
    title: str = "",
    customer: str = "",
    author: str = "",
    date: str = "",
    pdf: Path | str | None = None,
    notify: Callable[[str], object] = warnings.warn,
) -> Path:
    """One HTML page of a calibration, a diagnosis, or both of the same measurements.

    results: one or two, each itself or the file that it was saved to.  path: of the page, which
    needs no network.  title: that of the robot unless given.  customer, author: who accepts, who
    measured.  date: YYYY-MM-DD; SOURCE_DATE_EPOCH or today unless given.  pdf: printed to this file
    as well, by an installed Chromium, Chrome or Edge.  notify: called with what the reader should
    know of both together, which the page says too.  Lengths on the page are in mm, angles in mrad.
    Returns the path of the page.  Raises CalibrationError for wrong input.

    >>> mc.report([fit, diagnosis], "report.html", author="A. Turing")
    """
    check_writable(path, PAGES)
    if pdf is not None:
        check_writable(pdf, PAPERS)
    browser = find_browser() if pdf is not None else ""
    sources = sources_of(results)
    content = compose(sources, Wording(date_of(date), title, customer, author))
    write_whole(path, render(content))
    if pdf is not None:
        print_pdf(render(content, paper=True), Path(pdf), browser)
    for notice in sources.notices:
        notify(notice)
    return Path(path)


def sources_of(results: Result | Sequence[Result]) -> Sources:
    """Results as a report reads them; what is in memory goes through a file of its own."""
    if isinstance(results, Calibration | Diagnosis | Path | str):
        results = [results]
    with tempfile.TemporaryDirectory(prefix="minimax-cal-") as folder:
        found = read_sources([saved(result, Path(folder)) for result in results])
    named = partial(name_of, folder=folder)
    return replace(
        found,
        fits=tuple(replace(fit, path=named(fit.path)) for fit in found.fits),
        gaps=tuple(replace(gap, path=named(gap.path)) for gap in found.gaps),
    )


def saved(result: Result, folder: Path) -> Path | str:
    """The file of a result, written into the folder where there is none yet."""
    if not isinstance(result, Calibration | Diagnosis):
        return result
    taken = len(list(folder.iterdir()))
    path = folder / f"{type(result).__name__.lower()}{taken or ''}.json"
    result.save(path)
    return path


def name_of(path: str, folder: str) -> str:
    """How the page calls a file: what was in memory has no path that stays."""
    return f"{Path(path).stem}, not saved" if Path(path).parent == Path(folder) else path


def date_of(given: str) -> str:
    """The date of a report: as given, else of SOURCE_DATE_EPOCH, else today (UTC)."""
    try:
        if given:
            return Date.fromisoformat(given).isoformat()
    except ValueError:
        raise OptionError(f"--date {given!r}: write it as 2026-01-31") from None
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    try:
        now = datetime.fromtimestamp(int(epoch), UTC) if epoch else datetime.now(UTC)
    except (ValueError, OverflowError, OSError):
        raise OptionError(f"SOURCE_DATE_EPOCH={epoch!r}: is not a number of seconds") from None
    return now.date().isoformat()
