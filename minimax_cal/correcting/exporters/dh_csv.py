"""The table of links as CSV, units in the header."""

from __future__ import annotations

import numpy as np

from minimax_cal.correcting.exporters.job import Export, Job, number
from minimax_cal.robots.kinematics import BETA

HEADER = "joint,type,sign,a_mm,d_mm,theta_rad,alpha_rad,beta_rad"


def write(job: Job) -> Export:
    """One line a link ``Rz(sign*q+theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)``."""
    robot, lines = job.robot, [HEADER]
    for i, row in enumerate(robot.mdh * [1e3, 1e3, 1.0, 1.0, 1.0]):
        kind = "prismatic" if robot.prismatic[i] else "revolute"
        lines.append(",".join([str(i + 1), kind, str(int(robot.sign[i])), *map(number, row)]))
    bent = [str(i + 1) for i in np.flatnonzero(robot.mdh[:, BETA])]
    said = f"beta is not 0 at joint {', '.join(bent)}: a reader that knows only four DH columns "
    notices = [said + "would lose geometry; the file needs its beta_rad column"] if bent else []
    return Export.of("\n".join([*lines, ""]), *notices)
