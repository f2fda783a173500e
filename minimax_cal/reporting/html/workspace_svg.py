"""A still picture of the workspace as SVG: for paper, and where nothing can move."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np

from minimax_cal.core.arrays import Array

SVG_WIDTH, MAX_SVG_HEIGHT, SVG_EDGE = 680.0, 520.0, 26.0
VIEW_AZIMUTH, VIEW_ELEVATION = np.radians(-45.0), np.radians(24.0)
ARROW_HEAD_FRACTION = 0.28  # of an arrow's length
LEGEND_LINE_HEIGHT = 18.0  # height of a line of the legend
BASE_AXIS_FRACTION = 0.12  # length of the axes of the base, of the picture


@dataclass(frozen=True, eq=False)
class WorkspaceDrawing:
    """What is seen, in the base frame [mm]: (.., 3) each.  words: of arrows, arm and tracker."""

    start: Array
    end: Array
    arm: Array
    joints: Array
    spots: Array
    tracker: Array
    centre: Array
    words: tuple[str, str, str]

    def all_points(self) -> Array:
        """All points of the picture."""
        return np.concatenate(
            [self.start, self.end, self.arm, self.spots, self.tracker[None], np.zeros((1, 3))]
        )


def project_to_plane(points: Array) -> Array:
    """Parallel projection, seen from the front right and above: (..., 2), y downwards."""
    ca, sa, ce, se = (
        np.cos(VIEW_AZIMUTH),
        np.sin(VIEW_AZIMUTH),
        np.cos(VIEW_ELEVATION),
        np.sin(VIEW_ELEVATION),
    )
    right = np.array([-sa, ca, 0.0])
    up = np.array([-ca * se, -sa * se, ce])
    return np.asarray(np.stack([points @ right, -(points @ up)], axis=-1))


def draw_workspace_svg(drawing: WorkspaceDrawing) -> str:
    """The picture, in the colours of the page."""
    every = project_to_plane(drawing.all_points())
    low, size = every.min(axis=0), np.maximum(np.ptp(every, axis=0), 1.0)
    scale = min((SVG_WIDTH - 2 * SVG_EDGE) / size[0], (MAX_SVG_HEIGHT - 2 * SVG_EDGE) / size[1])
    height = size[1] * scale + 2 * SVG_EDGE
    offset = np.array([(SVG_WIDTH - size[0] * scale) / 2.0, SVG_EDGE]) - low * scale

    def put(points: Array) -> Array:
        return np.asarray(project_to_plane(points) * scale + offset)

    triad = BASE_AXIS_FRACTION * max(size) * np.eye(3)
    parts = [
        *format_svg_tracker(put(drawing.tracker), put(drawing.centre)),
        format_svg_arrows(put(drawing.start), put(drawing.end)),
        format_svg_polyline("arm", put(drawing.arm)),
        *(
            f'<circle class="joint" cx="{x:.1f}" cy="{y:.1f}" r="4"/>'
            for x, y in put(drawing.joints)
        ),
        *(
            format_svg_polyline("tool", put(np.stack([drawing.arm[-1], spot])))
            for spot in drawing.spots
        ),
        *(format_svg_target(x, y) for x, y in put(drawing.spots)),
        *format_svg_base_axes(put(np.zeros(3)), put(triad)),
    ]
    key = format_svg_legend(drawing.words, height)
    return (
        f'<svg class="still" role="img" viewBox="0 0 {SVG_WIDTH:.0f}'
        f' {height + 3 * LEGEND_LINE_HEIGHT:.0f}" '
        f'aria-label="{escape(", ".join(drawing.words))}">\n'
        + "\n".join([*parts, *key])
        + "\n</svg>"
    )


def format_svg_polyline(css_class: str, points: Array) -> str:
    """A line through points."""
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline class="{css_class}" points="{path}"/>'


def format_svg_arrows(start: Array, end: Array) -> str:
    """All arrows as one path."""
    along = end - start
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    left, right = (
        end - ARROW_HEAD_FRACTION * (along + sign * 0.5 * across) for sign in (1.0, -1.0)
    )
    path = "".join(
        f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}M{c[0]:.1f} {c[1]:.1f}L{b[0]:.1f} {b[1]:.1f}"
        f"L{d[0]:.1f} {d[1]:.1f}"
        for a, b, c, d in zip(start, end, left, right, strict=True)
    )
    return f'<path class="arrow" d="{path}"/>'


def format_svg_tracker(tracker: Array, centre: Array) -> list[str]:
    """The tracker, and where it looks."""
    (x, y), (u, v) = tracker, centre
    return [
        f'<line class="sight" x1="{x:.1f}" y1="{y:.1f}" x2="{u:.1f}" y2="{v:.1f}"/>',
        f'<rect class="tracker" x="{x - 5:.1f}" y="{y - 5:.1f}" width="10" height="10"/>',
    ]


def format_svg_target(x: float, y: float) -> str:
    """A target."""
    return f'<path class="target" d="M{x:.1f} {y - 5:.1f}l5 5l-5 5l-5 -5z"/>'


def format_svg_base_axes(origin: Array, ends: Array) -> list[str]:
    """The axes of the base frame with their names."""
    out = []
    for name, end in zip("xyz", ends, strict=True):
        (x, y), (u, v) = end, end + 9.0 * (end - origin) / max(np.linalg.norm(end - origin), 1e-9)
        out.append(
            f'<line class="axis" x1="{origin[0]:.1f}" y1="{origin[1]:.1f}" x2="{x:.1f}" '
            f'y2="{y:.1f}"/><text class="name" x="{u:.1f}" y="{v + 4:.1f}">{name}</text>'
        )
    return out


def format_svg_legend(legend_texts: tuple[str, str, str], picture_height: float) -> list[str]:
    """What the marks mean, a line each below the picture."""
    marks = (
        '<line class="arrow" x1="8" y1="{y:.1f}" x2="32" y2="{y:.1f}"/>',
        '<line class="arm" x1="8" y1="{y:.1f}" x2="32" y2="{y:.1f}"/>',
        '<rect class="tracker" x="15" y="{top:.1f}" width="10" height="10"/>',
    )
    out = []
    for row, (mark, text) in enumerate(zip(marks, legend_texts, strict=True)):
        y = picture_height + LEGEND_LINE_HEIGHT * (row + 0.5)
        shape = mark.format(y=y, top=y - 5.0)
        out.append(shape + f'<text x="42" y="{y + 4.0:.1f}">{escape(text)}</text>')
    return out
