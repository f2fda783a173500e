"""Where the errors lie: what is said of one target, joint, region, trend or kind, and of all."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.facts import Apart, Fact, Milli, Mm, derived, in_file
from minimax_cal.ground.files import plain


@dataclass(frozen=True, eq=False)
class TargetGap:
    """Errors of one target.  mean: (3,) in base axes; sight: mean along the line of sight [m]."""

    name: Annotated[str, Fact(key="target")]
    points: int
    rms: Mm
    worst: Annotated[float, Fact(key="max_mm", scale=1e3)]
    mean: Milli[Array]
    sight: Annotated[float, Fact(key="mean_sight_mm", scale=1e3)]


@dataclass(frozen=True)
class JointGap:
    """Errors as one joint's: RMS of its equivalent turn [rad, m], and what q_j alone explains."""

    joint: str
    sliding: bool
    rms: float
    share: float
    p: float

    def to_dict(self) -> dict[str, object]:
        """For JSON, in milliradians, millimetres for a slide."""
        unit = "mm" if self.sliding else "mrad"
        return {
            "joint": self.joint,
            f"rms_{unit}": 1e3 * self.rms,
            "share": self.share,
            "p": self.p,
        }


@dataclass(frozen=True)
class Region:
    """Errors in one cell of the workspace.  radius, height: its edges [m]."""

    name: Annotated[str, Fact(key="region")]
    radius: Milli[tuple[float, float]]
    height: Milli[tuple[float, float]]
    points: int
    rms: Mm


@dataclass(frozen=True)
class Trend:
    """Share of the error that a slow function of something explains, and p that it is chance."""

    share: float
    p: float

    def to_dict(self) -> dict[str, object] | None:
        """For JSON; null where the data cannot tell."""
        return None if math.isnan(self.share) else in_file(self)


@dataclass(frozen=True)
class Part(Trend):
    """A part of the mean square: its share, p that it is nothing, and its root per point [m]."""

    rms: Mm


CANNOT_TELL = Part(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Triage:
    """Mean squares per point that tell the kind of cause apart, each a `Part`; NaN if untellable.

    noise: of the instrument.  shape: of targets against each other.  repeat: between revisits.
    pose: the rest, which returns when a pose returns (without revisits: may or may not return).
    Exactly: see `triage`.
    """

    noise: Part
    shape: Part
    repeat: Part
    pose: Part


@dataclass(frozen=True, eq=False)
class Where:
    """Where the errors of a fit lie.

    by_direction: RMS per axis [m].
    noise: of the instrument, per coordinate, given or estimated, NaN if neither [m].
    turn: (m, n) joint-equivalent residual, see `joint_equivalent` [rad, m].
    """

    by_target: tuple[TargetGap, ...]
    by_joint: tuple[JointGap, ...]
    by_direction: Apart[dict[str, float]]
    by_region: Annotated[tuple[Region, ...], Fact(key="by_region.cells")]
    order: Annotated[Trend, Fact(key="by_order.clock")]
    temperature: Annotated[Trend, Fact(key="by_order.temperature")]
    triage: Triage
    noise: Mm
    turn: Apart[Array]

    @derived(key="by_region.worst")
    def worst_region(self) -> str:
        """The cell with the largest RMS, in words; empty if there are none."""
        if not self.by_region:
            return ""
        worst = max(self.by_region, key=lambda cell: cell.rms)
        points = sum(cell.points for cell in self.by_region)
        square = sum(cell.points * cell.rms**2 for cell in self.by_region)
        (near, far), (low, high) = worst.radius, worst.height
        return (
            f"{worst.name}: {near:.2f} to {far:.2f} m from the base axis, {low:.2f} to "
            f"{high:.2f} m high, RMS {1e3 * worst.rms:.3f} mm "
            f"({1e3 * math.sqrt(square / points):.3f} mm everywhere)"
        )

    def to_dict(self) -> dict[str, object]:
        """For JSON: strictly JSON-able, units in the names, null for what cannot be told."""
        directions = {f"{name}_mm": 1e3 * rms for name, rms in self.by_direction.items()}
        return dict(plain({**in_file(self), "by_direction": directions}))
