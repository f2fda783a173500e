"""Where the errors lie: what is said of one target, joint, region, trend or kind, and of all."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.files import number, plain
from minimax_cal.ground.tables import Cell, Table


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
            "rms_mm": plain(1e3 * self.rms),
            "max_mm": plain(1e3 * self.worst),
            "mean_mm": plain(1e3 * self.mean),
            "mean_sight_mm": plain(1e3 * self.sight),
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
            f"rms_{unit}": plain(1e3 * self.rms),
            "share": plain(self.share),
            "p": plain(self.p),
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
            "rms_mm": plain(1e3 * self.rms),
        }


@dataclass(frozen=True)
class Part:
    """A part of the mean square: its root per point [m], its share, and p that it is nothing."""

    rms: float
    share: float
    p: float

    def to_dict(self) -> dict[str, object]:
        """For JSON, in millimetres."""
        return {"rms_mm": plain(1e3 * self.rms), "share": plain(self.share), "p": plain(self.p)}


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
        return {"share": plain(self.share), "p": plain(self.p)}


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


@dataclass(frozen=True, eq=False)
class Where:
    """Where the errors of a fit lie.

    by_direction: RMS per axis [m].
    noise: of the instrument, per coordinate, given or estimated, NaN if neither [m].
    turn: (m, n) joint-equivalent residual, see `joint_equivalent` [rad, m].
    """

    by_target: tuple[TargetGap, ...]
    by_joint: tuple[JointGap, ...]
    by_direction: dict[str, float]
    by_region: tuple[Region, ...]
    order: Trend
    temperature: Trend
    triage: Triage
    noise: float
    turn: Array

    @property
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
        return {
            "by_target": [gap.to_dict() for gap in self.by_target],
            "by_joint": [gap.to_dict() for gap in self.by_joint],
            "by_direction": {
                f"{name}_mm": plain(1e3 * rms) for name, rms in self.by_direction.items()
            },
            "by_region": {
                "cells": [cell.to_dict() for cell in self.by_region],
                "worst": self.worst_region,
            },
            "by_order": {
                "clock": self.order.to_dict(),
                "temperature": self.temperature.to_dict(),
            },
            "triage": self.triage.to_dict(),
            "noise_mm": plain(1e3 * self.noise),
        }


def triage_table(triage: Mapping[str, Any]) -> Table:
    """The mean squares, one a row.  triage: as `Triage.to_dict`."""
    causes = {
        "noise": "noise, of any origin",
        "shape": "targets against each other",
        "repeat": "revisits against each other",
        "pose": "static model error",
    }
    nothing: dict[str, float | None] = {}
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (cause, *(number((triage[kind] or nothing).get(key)) for key in ("rms_mm", "share", "p")))
        for kind, cause in causes.items()
    )
    title = "kind of error; p-values below 0.01 are significant"
    return Table(title, ("kind", "RMS mm", "share", "p-value"), rows, ("", ".4f", ".3f", ".2g"))
