"""How alike a known displacement and the effects of the library are, as measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from minimax_cal.diagnosing.causes import add_session_jumps
from minimax_cal.diagnosing.study import SUM, studied
from minimax_cal.evidence.library import Library
from minimax_cal.evidence.noise import restricted
from minimax_cal.fitting.options import silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.linear_algebra import project_out
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
    lib = add_session_jumps(arm_library(study.scene, study.rows), study)
    return resemblances(lib, study.rows.of(moved[None]))


def resemblances(lib: Library, column: Array) -> dict[tuple[str, str], float]:
    """rho^2 of every candidate with rows (N, 1) that something adds to the error: the best variant.

    Projected on what geometry cannot imitate and weighed by the noise that the data show with it.
    """
    noise = restricted(lib.rows, column)
    root = np.sqrt(noise.weights(lib.rows))[:, None]
    basis = np.linalg.qr(lib.rows.basis * root)[0]
    field = project_out(column * root, basis)[:, 0]
    whole = project_out(lib.columns * root, basis)
    out: dict[tuple[str, str], float] = {}
    for c in lib.candidates:
        part = whole[:, c.main]
        scale = np.maximum(np.linalg.norm(part, axis=0), 1e-300)
        found = np.linalg.lstsq(part / scale, field, rcond=1e-6)[0]
        share = 1.0 - float(((field - part / scale @ found) ** 2).sum() / (field @ field))
        out[c.key] = max(out.get(c.key, 0.0), share)
    return out
