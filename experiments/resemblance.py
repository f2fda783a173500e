"""How alike a known displacement and the effects of the library are, as measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from minimax_cal.diagnosing.causes import with_jumps
from minimax_cal.diagnosing.study import SUM, studied
from minimax_cal.evidence.stability import resemblances
from minimax_cal.fitting.options import silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import split
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.modelling.dictionary import arm_library
from minimax_cal.robots.robot import Robot, load_robot

EARLIEST = 5  # visits before a jump that is possible, and after it


def resemblance(
    robot: Robot | str | Path, data: Measurements | str | Path, displacement: Array
) -> dict[tuple[str, str], float]:
    """rho^2 between a known displacement and every effect that the data can test.

    displacement: (m, k, 3) of the points of all rows in the measurement frame [m].  Both are seen
    by the training poses, after projection on what geometry cannot imitate.
    """
    robot = load_robot(robot)
    data = with_history(read_measurements(data))
    train, _, _ = split(data, 0.2, 0)
    study = studied(robot, train, fit_cell(robot, train, SUM, silent))
    rows = np.isin(data.line, train.line)
    moved = np.einsum("ab,mka->kbm", study.fit.state.rotation, displacement[rows])
    clock = np.unique(study.scene.column("clock"))  # a jump may be at any moment
    study = replace(study, moments=clock[EARLIEST : len(clock) - EARLIEST])
    lib = with_jumps(arm_library(study.scene, study.rows), study)
    return resemblances(lib, study.rows.of(moved[None]))
