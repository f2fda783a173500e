"""A calibration, a diagnosis or both as one page that needs nothing else."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from datetime import date as Date
from pathlib import Path

from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.fitting.fit import Fit
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import check_writable, write_whole
from minimax_cal.reporting.html import (
    Wording,
    compose,
    find_browser,
    print_pdf,
    read_sources,
    render,
)
from minimax_cal.reporting.html.page import needed
from minimax_cal.reporting.html.sources import Result
from minimax_cal.simulators.result import SimulatorGap

PAGES, PAPERS = (".html", ".htm"), (".pdf",)


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

    results: each itself or the file that it was saved to; a gap in a simulator may come with them.
    path: of the page, which needs no network.  title: that of the robot unless given.  customer,
    author: who accepts, who measured.  date: YYYY-MM-DD; SOURCE_DATE_EPOCH or today unless given.
    pdf: printed to this file as well, by an installed Chromium, Chrome or Edge.  notify: called
    with what the reader should know of both together, which the page says too.  Lengths on the page
    are in mm, angles in mrad.  Returns its path.  Raises CalibrationError for wrong input.

    >>> mc.report([fit, diagnosis], "report.html", author="A. Turing")
    """
    check_writable(path, PAGES)
    needed()
    if pdf is not None:
        check_writable(pdf, PAPERS)
    browser = find_browser() if pdf is not None else ""
    if isinstance(results, Fit | Diagnosis | SimulatorGap | Path | str):
        results = [results]
    sources = read_sources(results)
    content = compose(sources, Wording(date_of(date), title, customer, author))
    write_whole(path, render(content))
    if pdf is not None:
        print_pdf(render(content, paper=True), Path(pdf), browser)
    for notice in sources.notices:
        notify(notice)
    return Path(path)


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
