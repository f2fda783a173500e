"""A file of joint targets in, a corrected one out."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from minimax_cal.correcting.compensate import Compensation
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.files import csv_text
from minimax_cal.measuring.measurements import Measurements, joint_rows
from minimax_cal.reading.rows import JOINT, UNITS, Rows, read_rows
from minimax_cal.reading.words import OWN

ADDED = ("residual_mm", "residual_mrad", "status")
USED = ("q", "order", "temperature", "payload", "tau", "approach", "session")
KEPT = re.compile("|".join(kind.pattern for name, kind in OWN.items() if name not in USED))


@dataclass(frozen=True, eq=False)
class TargetFile:
    """A file of joint targets: its cells as text, and what they mean."""

    file: Rows
    data: Measurements

    def corrected(self, found: Compensation) -> str:
        """The same file with other joints, and what remains at each target."""
        rows = [[*self.file.given, *ADDED]]
        joints = {i: m for i, name in enumerate(self.file.header) if (m := JOINT.fullmatch(name))}
        for k, row in enumerate(self.file.rows):
            out = list(row)
            for i, match in joints.items():
                out[i] = f"{found.q[k, int(match[1]) - 1] / UNITS[match[2]]:.9f}"
            left = (f"{1e3 * found.distance[k]:.6f}", f"{1e3 * found.angle[k]:.6f}")
            rows.append([*out, *left, str(found.outcome[k])])
        return csv_text(rows)


def read_targets(path: Path | str) -> TargetFile:
    """Joint columns as in a measurement file; payload, approach, order ... where there.

    Raises DataError.
    """
    file = read_rows(path)
    if done := [name for name in ADDED if name in file.header]:
        raise DataError(
            f"{path}:1: column {done[0]}: these joints are corrected already, and would be twice; "
            "give the targets as programmed"
        )
    if file.sheet.torn:
        raise DataError(f"{path}:{file.sheet.torn[0]}: the line is torn; complete it or delete it")
    return TargetFile(file, joint_rows(file, KEPT, unused="is kept and not used"))
