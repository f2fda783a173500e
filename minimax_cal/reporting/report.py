"""A calibration, a diagnosis or both as four pages that need nothing else."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from datetime import date as Date
from pathlib import Path

from minimax_cal.fitting.options import listed
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import check_writable, write_whole
from minimax_cal.ground.options import grouped, takes
from minimax_cal.judging.tolerance import claim_called, limits_of
from minimax_cal.reporting.html import (
    Report,
    Wording,
    compose,
    find_browser,
    picture,
    print_pdf,
    read_sources,
    render,
)
from minimax_cal.reporting.html.facts import WORDS, read_facts
from minimax_cal.reporting.html.first_page import Signed
from minimax_cal.reporting.html.motion import MotionSource, compose_motion, motion_of
from minimax_cal.reporting.html.page import needed
from minimax_cal.reporting.html.sources import Result

asked, said = grouped("What is required"), grouped("What the page says")
PAGES, PAPERS, PICTURES = (".html", ".htm"), (".pdf",), (".png",)


@dataclass(frozen=True)
class Chosen:
    """What people say of a report.

    title: that of the robot unless given.  customer, author: who accepts, who measured.
    date: YYYY-MM-DD; SOURCE_DATE_EPOCH or today unless given.
    tolerance: what is required in mm, as ``rms 0.2, max 0.5``.
    tolerance_for: inside or outside the measured region.
    facts: a TOML file with serial_number, controller, tool ...
    rung: of a diagnosis, the last unless given.
    appendix: with all that the four pages leave out, as distributions, correlations, ISO 9283.
    deliver: formats of `export`, or compensate: the requirement is judged by what each reaches,
    fitted for exactly what it carries; where a result holds effects and nothing is named, by
    corrected targets.
    """

    tolerance: str = asked("", 'What is required, in mm, as "rms 0.2, max 0.5".', metavar="LIMITS")
    tolerance_for: str = asked(
        "inside", "Judge poses inside or outside the measured region.", metavar="CLAIM"
    )
    deliver: tuple[str, ...] = asked(
        (),
        "Judge by what this reaches: a format of export, or compensate; may be given several "
        "times [default: corrected targets, where the result holds effects].",
        metavar="FORMAT",
        many=tuple,
    )
    facts: Path | str | None = said(  # noqa: RUF009
        None,
        "A TOML file with serial_number, controller, tool, payload, temperature, instrument, "
        "certificate, place, validity.",
        metavar="FILE",
    )
    title: str = said("", "The title of the report [default: of the robot].")
    customer: str = said("", "Who accepts the report.", metavar="NAME")
    author: str = said("", "Who measured and evaluated.", metavar="NAME")
    date: str = said(
        "", "The date of the report [default: SOURCE_DATE_EPOCH, or today].", metavar="YYYY-MM-DD"
    )
    appendix: bool = said(False, "With all that the four pages leave out.")
    rung: int | None = None

    def wording(self) -> Wording:
        """As the page needs it.  Raises OptionError."""
        told = read_facts(self.facts) if self.facts else {}
        title, customer, author, date = (
            getattr(self, name) or told.get(name, "") for name in WORDS
        )
        limits, which = limits_of(self.tolerance), claim_called(self.tolerance_for)
        more = (self.rung, self.deliver, self.appendix)
        return Wording(date_of(date), title, customer, author, told, limits, which, *more)


@takes(chosen=Chosen, read={"deliver": lambda given: tuple(listed(given))})
def report(
    results: Result | Sequence[Result],
    path: Path | str = "report.html",
    *,
    chosen: Chosen,
    pdf: Path | str | None = None,
    notify: Callable[[str], object] = warnings.warn,
) -> Path:
    """Four pages, one to sign, of a calibration, a diagnosis, or both of the same measurements.

    Parameters
    ----------
    results
        Each itself or the file that it was saved to; a gap in a simulator may come with
        them, a relative calibration and a motion diagnosis stand alone.
    path
        Of the HTML, which needs no network, or of a PDF, or of a PNG of the first page.
    chosen
        See `Chosen`.
    pdf
        Printed to this file as well, by an installed Chromium, Chrome or Edge.
    notify
        Called with what the reader should know of both together, which the page says too.

    Returns
    -------
    Path
        The path of the page. Lengths on the page are in mm, angles in mrad.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> mc.report([fit, diagnosis], "report.html", author="A. Turing")
    """
    signed(results, path, chosen, pdf, notify)
    return Path(path)


def signed(
    results: Result | Sequence[Result],
    path: Path | str,
    chosen: Chosen,
    pdf: Path | str | None,
    notify: Callable[[str], object],
) -> Signed | MotionSource:
    """Write the report; what it judges."""
    check_writable(path, (*PAGES, *PAPERS, *PICTURES))
    needed()
    wording = chosen.wording()
    if pdf is not None:
        check_writable(pdf, PAPERS)
    suffix = Path(path).suffix.lower()
    browser = find_browser() if pdf is not None or suffix not in PAGES else ""
    if not isinstance(results, Sequence) or isinstance(results, str):
        results = [results]
    content, found, notices = composed(results, wording)
    if suffix in PAGES:
        write_whole(path, render(content))
    elif suffix in PAPERS:
        print_pdf(render(content, paper=True), Path(path), browser)
    else:
        picture(render(content, paper=True), Path(path), browser)
    if pdf is not None:
        print_pdf(render(content, paper=True), Path(pdf), browser)
    for notice in notices:
        notify(notice)
    return found


def composed(
    results: Sequence[Result], wording: Wording
) -> tuple[Report, Signed | MotionSource, tuple[str, ...]]:
    """The page, what it judges, and what the reader should know of the results."""
    if motion := motion_of(results):
        return compose_motion(motion, wording), motion, ()
    sources = read_sources(results)
    found = wording.judge(sources)
    return compose(sources, wording, found), found, sources.notices


def date_of(given: str) -> str:
    """The date of a report: as given, else of SOURCE_DATE_EPOCH, else today (UTC)."""
    try:
        if given:
            return Date.fromisoformat(given).isoformat()
    except ValueError:
        raise OptionError(f"date {given!r}: write it as 2026-01-31") from None
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    try:
        now = datetime.fromtimestamp(int(epoch), UTC) if epoch else datetime.now(UTC)
    except (ValueError, OverflowError, OSError):
        raise OptionError(f"SOURCE_DATE_EPOCH={epoch!r}: is not a number of seconds") from None
    return now.date().isoformat()
