"""What pages need in the site only, added as they are read: so they stay plain text elsewhere.

The table of contents goes under the start page; a page that no part names joins the guides by
itself.  Links to the scripts of the gallery lead to its pages.
"""

from __future__ import annotations

import re
from pathlib import Path

from sphinx.application import Sphinx

OTHERS = "*"  # stands for every page that no part names
PARTS = {
    "Start": ("tutorial", "examples/index"),
    "Guides": (
        "import",
        "planning",
        "diagnosis",
        "effects",
        OTHERS,
        "export",
        "simulator",
        "compensate",
    ),
    "Coming from": ("from_robodk", "from_ros2", "from_matlab"),
    "Extend": ("own_effect", "backends"),
    "Background": ("mathematics", "papers", "trust"),
    "Reference": ("api/cli", "api/minimax_cal", "api/parts", "api/qp_backends"),
}


def pages(folder: Path) -> dict[str, tuple[str, ...]]:
    """The pages of each part that are there."""
    named = {page for part in PARTS.values() for page in part}
    there = {path.stem for path in folder.glob("*.md")} - {"index"}

    def found(page: str) -> list[str]:
        if page == OTHERS:
            return sorted(there - named)
        return [page] if "/" in page or page in there else []

    return {
        part: tuple(one for page in some for one in found(page)) for part, some in PARTS.items()
    }


def complete(app: Sphinx, name: str, source: list[str]) -> None:
    """Turn links to scripts into links to their pages, and add the table of contents."""
    scripts = app.config.executed_examples
    source[0] = re.sub(rf"\]\(\.\./(examples/(?:{scripts}))\.py\)", r"](\1)", source[0])
    source[0] = source[0].replace("](../examples/)", "](examples/index)")
    if name == app.config.root_doc:
        app.env.note_reread()  # other pages may have come
        for part, some in pages(Path(app.srcdir)).items():
            listed = "\n".join(some)
            source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {part}\n\n{listed}\n```\n"


def setup(app: Sphinx) -> dict[str, bool]:
    """Listen to the reading of pages."""
    app.add_config_value("executed_examples", "", "env", types=str)
    app.connect("source-read", complete)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
