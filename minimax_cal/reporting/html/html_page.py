"""A report as one HTML file that needs nothing else: no network, no other file.

The page's own Content-Security-Policy forbids every request, and every script but the two whose
SHA-256 it names: that of this package and plotly.js.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
from importlib import resources
from typing import Any, NamedTuple

from minimax_cal.core.optional_packages import import_optional
from minimax_cal.core.tables import Table
from minimax_cal.reporting.html.chart_parts import PALETTE_COLOUR_NAMES
from minimax_cal.reporting.html.report_content import (
    ChartBlock,
    NoteBlock,
    ReportBlock,
    ReportDocument,
    View3dBlock,
)

HTML_PACKAGE_NAME = "minimax_cal.reporting.html"
TEMPLATE_BLOCK_KINDS = {
    NoteBlock: "note",
    Table: "table",
    ChartBlock: "figure",
    View3dBlock: "view",
}
UNSAFE_SCRIPT_LETTERS = {letter: f"\\u{ord(letter):04x}" for letter in "<>&\u2028\u2029"}


class ReportPackages(NamedTuple):
    """The imported modules jinja2 and plotly.offline."""

    jinja: Any
    plotly_offline: Any


def render_html(report: ReportDocument, *, for_print: bool = False) -> str:
    """The page.  for_print: for the printer, with its charts drawn while it is read, none to
    turn.
    """
    jinja, offline = import_report_packages()
    from markupsafe import Markup

    own, plotly = (
        read_package_file("drawing.js") + read_package_file("page.js"),
        str(offline.get_plotlyjs()),
    )
    whole: str = load_template(jinja, "page.html.jinja").render(
        report=report,
        policy=content_security_policy(own, plotly),
        style=Markup(read_package_file("page.css")),
        script=Markup(own),
        packed=Markup("" if for_print else compress_to_base64(plotly)),
        library=Markup(plotly if for_print else ""),
        palette=" ".join(PALETTE_COLOUR_NAMES),
        sections=[
            (s, [(template_block_kind(block), block) for block in s.blocks])
            for s in report.sections
        ],
        table=lambda table: Markup(table.html()),
        still=lambda view: Markup(view.still),
        data=lambda figure: Markup(format_script_json(chart_to_json_data(figure))),
    )
    return whole


def import_report_packages() -> ReportPackages:
    """The packages that draw the page: jinja2, plotly.offline.  Raises OptionError."""
    jinja, offline = (
        import_optional(name, "a report", "minimax-cal[report]")
        for name in ("jinja2", "plotly.offline")
    )
    return ReportPackages(jinja, offline)


def read_package_file(name: str, package: str = HTML_PACKAGE_NAME) -> str:
    """A file of this package, or of another one of ours."""
    return (resources.files(package) / name).read_text("utf-8")


def load_template(jinja: Any, name: str, package: str = HTML_PACKAGE_NAME) -> Any:
    """A template of ours: text is escaped, and nothing that it names may be missing."""
    pages = jinja.Environment(autoescape=True, undefined=jinja.StrictUndefined, trim_blocks=True)
    return pages.from_string(read_package_file(name, package))


def template_block_kind(block: ReportBlock) -> str:
    """How the template calls a block."""
    return TEMPLATE_BLOCK_KINDS[type(block)]


def content_security_policy(*scripts: str) -> str:
    """No request to anywhere, and no script but these."""
    hashes = " ".join(f"'sha256-{base64_sha256(script)}'" for script in scripts)
    return (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )


def base64_sha256(script: str) -> str:
    """SHA-256 as a policy wants it."""
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def compress_to_base64(script: str) -> str:
    """A script compressed, as letters; the same script gives the same letters."""
    return base64.b64encode(gzip.compress(script.encode(), 9, mtime=0)).decode()


def chart_to_json_data(figure: ChartBlock) -> dict[str, Any]:
    """What the page draws."""
    out = {"traces": figure.traces, "layout": figure.layout, "height": figure.height}
    return out | ({"arms": figure.arms} if isinstance(figure, View3dBlock) else {})


def format_script_json(content: Any) -> str:
    """JSON that cannot end the script element it stands in."""
    out = json.dumps(content, allow_nan=False, separators=(",", ":"))
    for letter, code in UNSAFE_SCRIPT_LETTERS.items():
        out = out.replace(letter, code)
    return out
