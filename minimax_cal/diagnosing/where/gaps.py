"""What is said of the errors of one target, joint, region, trend or kind."""

from __future__ import annotations

import math
from dataclasses import dataclass

from minimax_cal.ground.arrays import Array


@dataclass(frozen=True, eq=False)
class TargetGap:
    """Errors of one target.  mean: (3,) in base axes; sight: mean along the line of sight [m]."""

    name: str
    points: int
    rms: float
    worst: float
    mean: Array
    sight: float

    def to_dict(self) -> dict[str, object]:
        """For JSON, in millimetres."""
        return {
            "target": self.name,
            "points": self.points,
            "rms_mm": 1e3 * self.rms,
            "max_mm": 1e3 * self.worst,
            "mean_mm": 1e3 * self.mean,
            "mean_sight_mm": 1e3 * self.sight,
        }


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

    name: str
    radius: tuple[float, float]
    height: tuple[float, float]
    points: int
    rms: float

    def to_dict(self) -> dict[str, object]:
        """For JSON, in millimetres."""
        return {
            "region": self.name,
            "radius_mm": [1e3 * edge for edge in self.radius],
            "height_mm": [1e3 * edge for edge in self.height],
            "points": self.points,
            "rms_mm": 1e3 * self.rms,
        }


@dataclass(frozen=True)
class Part:
    """A part of the mean square: its root per point [m], its share, and p that it is nothing."""

    rms: float
    share: float
    p: float

    def to_dict(self) -> dict[str, object]:
        """For JSON, in millimetres."""
        return {"rms_mm": 1e3 * self.rms, "share": self.share, "p": self.p}


CANNOT_TELL = Part(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Trend:
    """Share of the error that a slow function of something explains, and p that it is chance."""

    share: float
    p: float

    def to_dict(self) -> dict[str, object] | None:
        """For JSON; null where the data hold no such column."""
        if math.isnan(self.share):
            return None
        return {"share": self.share, "p": self.p}


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

    def to_dict(self) -> dict[str, object]:
        """For JSON; null where the data cannot tell."""
        return {
            name: None if math.isnan(part.rms) else part.to_dict()
            for name, part in vars(self).items()
        }
