"""The table of links as CSV, units in the header."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minimax_cal.compensation.exporters.export_job import (
    ExportedFile,
    ExportJob,
    format_exact_number,
)
from minimax_cal.core.errors import OptionError
from minimax_cal.robots.kinematics import BETA

DH_CSV_HEADER = "joint,type,sign,a_mm,d_mm,theta_rad,alpha_rad,beta_rad"
DH_CSV_CONVENTION_COLUMN = ",convention"


def build_dh_csv(job: ExportJob) -> ExportedFile:
    """One line a link, in the convention of the robot's own file (`notation.FORMULAS`).

    Offsets of joints are in theta (d of a slide).
    """
    robot, lines = job.robot, [DH_CSV_HEADER + DH_CSV_CONVENTION_COLUMN]
    notation = replace(robot.notation, offset=np.zeros(0))
    rows, end = notation.rows_in_file_convention(robot.mdh, robot.prismatic)
    if end.any():
        raise OptionError("dh-csv: has no place for what follows the last joint; use json or urdf")
    sign, name = robot.sign.copy(), "modified" if notation.modified else "standard"
    sign[0] *= -1.0 if notation.half_turn else 1.0
    for i, row in enumerate(rows * [1e3, 1e3, 1.0, 1.0, 1.0]):
        kind = "prismatic" if robot.prismatic[i] else "revolute"
        lines.append(
            ",".join([str(i + 1), kind, str(int(sign[i])), *map(format_exact_number, row), name])
        )
    bent = [str(i + 1) for i in np.flatnonzero(rows[:, BETA])]
    said = f"beta is not 0 at joint {', '.join(bent)}: a reader that knows only four DH columns "
    notices = [said + "would lose geometry; the file needs its beta_rad column"] if bent else []
    return ExportedFile.from_text("\n".join([*lines, ""]), *notices)
