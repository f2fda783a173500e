"""A report of a calibration, a diagnosis, or both: one HTML file that needs nothing else.

Result files are read and checked (`sources`), said in words, tables and figures (`document`), and
put on a page (`page`); `pdf` prints it.
"""

from minimax_cal.reporting.html.content import Figure, Note, Report, Section, View
from minimax_cal.reporting.html.document import Wording, compose
from minimax_cal.reporting.html.page import render
from minimax_cal.reporting.html.pdf import find_browser, picture, print_pdf
from minimax_cal.reporting.html.sources import Sources, read_sources

__all__ = [
    "Figure",
    "Note",
    "Report",
    "Section",
    "Sources",
    "View",
    "Wording",
    "compose",
    "find_browser",
    "picture",
    "print_pdf",
    "read_sources",
    "render",
]
