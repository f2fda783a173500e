"""A file of joint targets in, a corrected one out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from minimax_cal.correcting.compensate import Compensation
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.files import csv_text
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.reading.rows import (
    JOINT,
    TARGET,
    TEXT,
    UNITS,
    Rows,
    header_check,
    near,
    optional_kind,
    read_rows,
    useless,
)

ADDED = ("residual_mm", "residual_mrad", "status")
USED = ("order", "temperature", "payload", "tau", "approach", "session")
ANY_TARGET = ["smr1_x_mm", "smr1_y_mm", "smr1_z_mm"]  # the header's rules ask for one


@dataclass(frozen=True, eq=False)
class TargetFile:
    """A file of joint targets: its cells as text, and what they mean."""

    file: Rows
    data: Measurements

    def corrected(self, found: Compensation) -> str:
        """The same file with other joints, and what remains at each target."""
        rows = [[*self.file.header, *ADDED]]
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
    header = file.header
    header_check(path, [name for name in header if not TARGET.fullmatch(name)] + ANY_TARGET)
    done = [name for name in ADDED if name in header]
    if done:
        raise DataError(
            f"{path}:1: column {done[0]}: these joints are corrected already, and would be twice; "
            "give the targets as programmed"
        )
    q, sliding = file.joints()
    columns: dict[str, Array] = {}
    idle = useless(header)
    notices = [
        f"{path}: column {name} is kept and not used: {why}"
        for name, why in idle.items()
        if optional_kind(name)[0] in USED
    ]
    for name in header:
        kind, match = optional_kind(name)
        if name in idle:
            continue
        if kind in USED and kind in TEXT:
            columns[name] = np.array(file.text(name))
        elif kind in USED and match:
            stem = name.removesuffix(f"_{match[1]}") if match.re.groups else name
            columns[stem] = file.number(name, empty=True)
        elif not (kind or JOINT.fullmatch(name) or TARGET.fullmatch(name)):
            notices.append(f"{path}: column {name} is kept and not used{near(name)}")
    data = Measurements(
        q=q,
        y=np.zeros((len(q), 0, 3)),
        target_names=(),
        sliding=sliding,
        line=file.line,
        columns=columns,
        notices=tuple(notices),
        source=str(path),
    )
    return TargetFile(file, data)
