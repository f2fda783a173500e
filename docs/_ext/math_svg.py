"""Formulas as SVG, set at build time: pages need no script, no font and no network to show them."""

from __future__ import annotations

from functools import cache
from html import escape
from xml.etree import ElementTree

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator
from ziamath.zmath import Latex

LOGGER = logging.getLogger(__name__)
EM = 16.0  # the text's size, to which lengths are relative in the page
DISPLAY, INLINE = 1.1, 1.05  # size of a formula: letters of mathematics look smaller than text


@cache
def drawn(tex: str, display: bool) -> tuple[str, float]:
    """A formula as an SVG element, and how far it reaches below the line [em].

    Raises ValueError for TeX that is not understood.
    """
    if "\\" in convert(tex):
        raise ValueError(f"TeX that cannot be set: {tex}")
    size = EM * (DISPLAY if display else INLINE)
    made = Latex(tex, size=size, color="currentColor", inline=not display)
    picture: ElementTree.Element = made.svgxml()
    for side in ("width", "height"):
        picture.set(side, f"{float(picture.attrib[side]) / EM:.3f}em")
    picture.set("role", "img")
    picture.set("aria-label", tex)
    return ElementTree.tostring(picture, encoding="unicode"), -float(made.getyofst()) / EM


def formula(node: nodes.Node, tex: str, *, display: bool) -> tuple[str, float]:
    """As `drawn`; the TeX itself, and a warning that names the page, where it cannot be set."""
    try:
        return drawn(" ".join(tex.split()), display)
    except Exception as error:  # the setter may stumble over anything
        LOGGER.warning("%s: %s", type(error).__name__, error, location=node)
        return f"<code>{escape(tex)}</code>", 0.0


def inline(page: HTML5Translator, node: nodes.math) -> None:
    """A formula in a line."""
    text, depth = formula(node, node.astext(), display=False)
    page.body.append(f'<span class="math" style="vertical-align:{-depth:.3f}em">{text}</span>')
    raise nodes.SkipNode


def block(page: HTML5Translator, node: nodes.math_block) -> None:
    """A formula on lines of its own."""
    text, _ = formula(node, node.astext(), display=True)
    page.body.append(f"{page.starttag(node, 'div', CLASS='math')}{text}</div>\n")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer."""
    app.add_html_math_renderer("svg", (inline, None), (block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
