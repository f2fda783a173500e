"""A file of joint targets in, a corrected one out."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from minimax_cal.compensation.joint_compensation import Compensation
from minimax_cal.core.errors import DataError
from minimax_cal.core.files import format_csv
from minimax_cal.measuring.measurements import Measurements, build_joint_measurements
from minimax_cal.reading.column_words import STANDARD_COLUMN_KINDS
from minimax_cal.reading.measurement_table import (
    JOINT_COLUMN_PATTERN,
    SI_PER_COLUMN_UNIT,
    MeasurementTable,
    read_measurement_table,
)

ADDED_TARGET_COLUMNS = ("residual_mm", "residual_mrad", "status")
USED_TARGET_COLUMNS = ("q", "order", "temperature", "payload", "tau", "approach", "session")
KEPT_TARGET_COLUMN_PATTERN = re.compile(
    "|".join(
        kind.full_name_pattern
        for name, kind in STANDARD_COLUMN_KINDS.items()
        if name not in USED_TARGET_COLUMNS
    )
)


@dataclass(frozen=True, eq=False)
class TargetFile:
    """A file of joint targets: its cells as text, and what they mean."""

    file: MeasurementTable
    data: Measurements

    def format_corrected(self, compensation: Compensation) -> str:
        """The same file with other joints, and what remains at each target."""
        rows = [[*self.file.given, *ADDED_TARGET_COLUMNS]]
        joints = {
            i: m
            for i, name in enumerate(self.file.header)
            if (m := JOINT_COLUMN_PATTERN.fullmatch(name))
        }
        for k, row in enumerate(self.file.rows):
            out = list(row)
            for i, match in joints.items():
                out[i] = (
                    f"{compensation.q[k, int(match[1]) - 1] / SI_PER_COLUMN_UNIT[match[2]]:.9f}"
                )
            left = (f"{1e3 * compensation.distance[k]:.6f}", f"{1e3 * compensation.angle[k]:.6f}")
            rows.append([*out, *left, str(compensation.outcome[k])])
        return format_csv(rows)


def read_target_file(path: Path | str) -> TargetFile:
    """Joint columns as in a measurement file; payload, approach, order ... where there.

    Raises DataError.
    """
    file = read_measurement_table(path)
    if done := [name for name in ADDED_TARGET_COLUMNS if name in file.header]:
        raise DataError(
            f"{path}:1: column {done[0]}: these joints are corrected already, and would be twice; "
            "give the targets as programmed"
        )
    if file.sheet.torn:
        raise DataError(f"{path}:{file.sheet.torn[0]}: the line is torn; complete it or delete it")
    return TargetFile(
        file,
        build_joint_measurements(
            file, KEPT_TARGET_COLUMN_PATTERN, unused_text="is kept and not used"
        ),
    )
