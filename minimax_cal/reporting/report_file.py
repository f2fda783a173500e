"""A calibration, a diagnosis or both as four pages that need nothing else."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from datetime import date as Date
from pathlib import Path
from typing import NamedTuple

from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import check_output_path, write_file_atomically
from minimax_cal.core.option_fields import option_field_in_group, take_option_fields_as_keywords
from minimax_cal.fitting.options import split_names
from minimax_cal.reporting.html import (
    ReportDocument,
    ReportRequest,
    build_report,
    find_browser,
    read_report_sources,
    render_html,
    write_first_page_png,
    write_pdf,
)
from minimax_cal.reporting.html.cell_facts import REPORT_TEXT_KEYS, read_facts_file
from minimax_cal.reporting.html.first_page import ReportJudgement
from minimax_cal.reporting.html.html_page import import_report_packages
from minimax_cal.reporting.html.motion_report import (
    MotionReportSource,
    build_motion_report,
    find_motion_diagnosis,
)
from minimax_cal.reporting.html.report_sources import ReportableResult
from minimax_cal.validation.tolerance import parse_claim_name, parse_tolerance_limits

requirement_option, report_text_option = (
    option_field_in_group("What is required"),
    option_field_in_group("What the page says"),
)
HTML_SUFFIXES, PDF_SUFFIXES, PNG_SUFFIXES = (".html", ".htm"), (".pdf",), (".png",)


class JudgedReport(NamedTuple):
    """A report, what it judges, and notices for the reader."""

    document: ReportDocument
    judgement: ReportJudgement | MotionReportSource
    notices: tuple[str, ...]


@dataclass(frozen=True)
class ReportOptions:
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

    tolerance: str = requirement_option(
        "", 'What is required, in mm, as "rms 0.2, max 0.5".', metavar="LIMITS"
    )
    tolerance_for: str = requirement_option(
        "inside", "Judge poses inside or outside the measured region.", metavar="CLAIM"
    )
    deliver: tuple[str, ...] = requirement_option(
        (),
        "Judge by what this reaches: a format of export, or compensate; may be given several "
        "times [default: corrected targets, where the result holds effects].",
        metavar="FORMAT",
        many=tuple,
    )
    facts: Path | str | None = report_text_option(  # noqa: RUF009
        None,
        "A TOML file with serial_number, controller, tool, payload, temperature, instrument, "
        "certificate, place, validity.",
        metavar="FILE",
    )
    title: str = report_text_option("", "The title of the report [default: of the robot].")
    customer: str = report_text_option("", "Who accepts the report.", metavar="NAME")
    author: str = report_text_option("", "Who measured and evaluated.", metavar="NAME")
    date: str = report_text_option(
        "", "The date of the report [default: SOURCE_DATE_EPOCH, or today].", metavar="YYYY-MM-DD"
    )
    appendix: bool = report_text_option(False, "With all that the four pages leave out.")
    rung: int | None = None

    def build_request(self) -> ReportRequest:
        """As the page needs it.  Raises OptionError."""
        told = read_facts_file(self.facts) if self.facts else {}
        title, customer, author, date = (
            getattr(self, name) or told.get(name, "") for name in REPORT_TEXT_KEYS
        )
        limits, which = parse_tolerance_limits(self.tolerance), parse_claim_name(self.tolerance_for)
        more = (self.rung, self.deliver, self.appendix)
        return ReportRequest(
            resolve_report_date(date), title, customer, author, told, limits, which, *more
        )


@take_option_fields_as_keywords(
    chosen=ReportOptions, readers_by_field={"deliver": lambda given: tuple(split_names(given))}
)
def report(
    results: ReportableResult | Sequence[ReportableResult],
    path: Path | str = "report.html",
    *,
    chosen: ReportOptions,
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
        See `ReportOptions`.
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
    write_report(results, path, chosen, pdf, notify)
    return Path(path)


def write_report(
    results: ReportableResult | Sequence[ReportableResult],
    path: Path | str,
    options: ReportOptions,
    pdf: Path | str | None,
    notify: Callable[[str], object],
) -> ReportJudgement | MotionReportSource:
    """Write the report; what it judges."""
    check_output_path(path, (*HTML_SUFFIXES, *PDF_SUFFIXES, *PNG_SUFFIXES))
    import_report_packages()
    wording = options.build_request()
    if pdf is not None:
        check_output_path(pdf, PDF_SUFFIXES)
    suffix = Path(path).suffix.lower()
    browser = find_browser() if pdf is not None or suffix not in HTML_SUFFIXES else ""
    if not isinstance(results, Sequence) or isinstance(results, str):
        results = [results]
    content, found, notices = build_document_and_judgement(results, wording)
    if suffix in HTML_SUFFIXES:
        write_file_atomically(path, render_html(content))
    elif suffix in PDF_SUFFIXES:
        write_pdf(render_html(content, for_print=True), Path(path), browser)
    else:
        write_first_page_png(render_html(content, for_print=True), Path(path), browser)
    if pdf is not None:
        write_pdf(render_html(content, for_print=True), Path(pdf), browser)
    for notice in notices:
        notify(notice)
    return found


def build_document_and_judgement(
    results: Sequence[ReportableResult], request: ReportRequest
) -> JudgedReport:
    """The page, what it judges, and what the reader should know of the results."""
    if motion := find_motion_diagnosis(results):
        return JudgedReport(build_motion_report(motion, request), motion, ())
    sources = read_report_sources(results)
    found = request.judge_sources(sources)
    return JudgedReport(build_report(sources, request, found), found, sources.notices)


def resolve_report_date(date_text: str) -> str:
    """The date of a report: as given, else of SOURCE_DATE_EPOCH, else today (UTC)."""
    try:
        if date_text:
            return Date.fromisoformat(date_text).isoformat()
    except ValueError:
        raise OptionError(f"date {date_text!r}: write it as 2026-01-31") from None
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    try:
        now = datetime.fromtimestamp(int(epoch), UTC) if epoch else datetime.now(UTC)
    except (ValueError, OverflowError, OSError):
        raise OptionError(f"SOURCE_DATE_EPOCH={epoch!r}: is not a number of seconds") from None
    return now.date().isoformat()
