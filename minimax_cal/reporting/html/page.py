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
from typing import Any

from minimax_cal.ground.optional import optional
from minimax_cal.ground.tables import Table
from minimax_cal.reporting.html.charts import PALETTE
from minimax_cal.reporting.html.content import Block, Figure, Note, Report, View

PACKAGE = "minimax_cal.reporting.html"
KINDS = {Note: "note", Table: "table", Figure: "figure", View: "view"}
UNSAFE = {letter: f"\\u{ord(letter):04x}" for letter in "<>&\u2028\u2029"}


def render(report: Report, *, paper: bool = False) -> str:
    """The page.  paper: for the printer, with its charts drawn while it is read, none to turn."""
    jinja, offline = needed()
    from markupsafe import Markup

    own, plotly = part("drawing.js") + part("page.js"), str(offline.get_plotlyjs())
    whole: str = template(jinja, "page.html.jinja").render(
        report=report,
        policy=policy(own, plotly),
        style=Markup(part("page.css")),
        script=Markup(own),
        packed=Markup("" if paper else pack(plotly)),
        library=Markup(plotly if paper else ""),
        palette=" ".join(PALETTE),
        sections=[(s, [(kind_of(block), block) for block in s.blocks]) for s in report.sections],
        table=lambda table: Markup(table.html()),
        still=lambda view: Markup(view.still),
        data=lambda figure: Markup(script_json(figure_data(figure))),
    )  # fmt: skip
    return whole


def needed() -> tuple[Any, Any]:
    """The packages that draw the page: jinja2, plotly.offline.  Raises OptionError."""
    jinja, offline = (
        optional(name, "a report", "minimax-cal[report]") for name in ("jinja2", "plotly.offline")
    )
    return jinja, offline


def part(name: str, package: str = PACKAGE) -> str:
    """A file of this package, or of another one of ours."""
    return (resources.files(package) / name).read_text("utf-8")


def template(jinja: Any, name: str, package: str = PACKAGE) -> Any:
    """A template of ours: text is escaped, and nothing that it names may be missing."""
    pages = jinja.Environment(autoescape=True, undefined=jinja.StrictUndefined, trim_blocks=True)
    return pages.from_string(part(name, package))


def kind_of(block: Block) -> str:
    """How the template calls a block."""
    return KINDS[type(block)]


def policy(*scripts: str) -> str:
    """No request to anywhere, and no script but these."""
    hashes = " ".join(f"'sha256-{digest(script)}'" for script in scripts)
    return (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )


def digest(script: str) -> str:
    """SHA-256 as a policy wants it."""
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def pack(script: str) -> str:
    """A script compressed, as letters; the same script gives the same letters."""
    return base64.b64encode(gzip.compress(script.encode(), 9, mtime=0)).decode()


def figure_data(figure: Figure) -> dict[str, Any]:
    """What the page draws."""
    out = {"traces": figure.traces, "layout": figure.layout, "height": figure.height}
    return out | ({"arms": figure.arms} if isinstance(figure, View) else {})


def script_json(content: Any) -> str:
    """JSON that cannot end the script element it stands in."""
    out = json.dumps(content, allow_nan=False, separators=(",", ":"))
    for letter, code in UNSAFE.items():
        out = out.replace(letter, code)
    return out
