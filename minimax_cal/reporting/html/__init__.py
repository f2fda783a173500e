"""A report of a calibration, a diagnosis, or both: one HTML file that needs nothing else.

Result files are read and checked (`sources`), said in words, tables and figures (`document`), and
put on a page (`page`); `pdf` prints it.
"""

from minimax_cal.reporting.html.browser_print import find_browser, write_first_page_png, write_pdf
from minimax_cal.reporting.html.html_page import render_html
from minimax_cal.reporting.html.report_builder import ReportRequest, build_report
from minimax_cal.reporting.html.report_content import (
    ChartBlock,
    NoteBlock,
    ReportDocument,
    ReportSection,
    View3dBlock,
)
from minimax_cal.reporting.html.report_sources import ReportSources, read_report_sources

__all__ = [
    "ChartBlock",
    "NoteBlock",
    "ReportDocument",
    "ReportRequest",
    "ReportSection",
    "ReportSources",
    "View3dBlock",
    "build_report",
    "find_browser",
    "read_report_sources",
    "render_html",
    "write_first_page_png",
    "write_pdf",
]
