"""Where the errors lie: the answer as a whole, for JSON and as tables."""

from __future__ import annotations

import math
from dataclasses import dataclass

from minimax_cal.diagnosing.where.gaps import JointGap, Region, TargetGap, Trend, Triage
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.files import plain
from minimax_cal.ground.tables import Cell, Table


@dataclass(frozen=True, eq=False)
class Where:
    """Where the errors of a fit lie.

    by_direction: RMS per axis [m].  structure: p that residuals are unrelated to the joint values.
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
    structure: float
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
        whole = {
            "by_target": [gap.to_dict() for gap in self.by_target],
            "by_joint": [gap.to_dict() for gap in self.by_joint],
            "by_direction": {f"{name}_mm": 1e3 * rms for name, rms in self.by_direction.items()},
            "by_region": {
                "cells": [cell.to_dict() for cell in self.by_region],
                "worst": self.worst_region,
            },
            "by_order": {
                "clock": self.order.to_dict(),
                "temperature": self.temperature.to_dict(),
            },
            "triage": self.triage.to_dict(),
            "structure_p": self.structure,
            "noise_mm": 1e3 * self.noise,
        }
        return dict(plain(whole))


def triage_table(triage: Triage) -> Table:
    """The mean squares, one a row."""
    causes = {
        "noise": "instrument noise",
        "shape": "targets against each other",
        "repeat": "revisits against each other",
        "pose": "static model error",
    }
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (causes[name], 1e3 * part.rms, part.share, part.p) for name, part in vars(triage).items()
    )
    return Table("kind of error", ("kind", "RMS mm", "share", "p"), rows, ("", ".4f", ".3f", ".2g"))
