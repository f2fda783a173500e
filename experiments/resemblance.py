"""How alike a known displacement and the effects of the library are, as measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.linear_algebra import project_out
from minimax_cal.diagnosing.cause_search import add_session_jumps
from minimax_cal.diagnosing.study import LEAST_SQUARES_OPTIONS, linearise_geometry
from minimax_cal.fitting.cell_fit import fit_cell
from minimax_cal.fitting.options import silent_progress
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.measuring.pose_groups import split_train_and_holdout
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.arm_laws import build_library_of_testable_arm_laws
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.selection.candidate_library import CandidateLibrary
from minimax_cal.selection.noise_model import estimate_noise_by_reml

MIN_VISITS_AROUND_JUMP = 5  # visits before a jump that is possible, and after it


def effect_similarities(
    robot: Robot | str | Path, data: Measurements | str | Path, displacement: Array
) -> dict[tuple[str, str], float]:
    """rho^2 between a known displacement and every effect that the data can test.

    displacement: (m, k, 3) of the points of all rows in the measurement frame [m].  Both are seen
    by the training poses, after projection on what geometry cannot imitate.
    """
    robot = load_robot(robot)
    data = add_history_columns(read_measurements(data))
    train, _, _ = split_train_and_holdout(data, 0.2, 0)
    study = linearise_geometry(
        robot, train, fit_cell(robot, train, LEAST_SQUARES_OPTIONS, silent_progress)
    )
    rows = np.isin(data.line, train.line)
    moved = np.einsum("ab,mka->kbm", study.fit.state.rotation, displacement[rows])
    clock = np.unique(study.scene.column("clock"))  # a jump may be at any moment
    study = replace(
        study, jump_times=clock[MIN_VISITS_AROUND_JUMP : len(clock) - MIN_VISITS_AROUND_JUMP]
    )
    lib = add_session_jumps(build_library_of_testable_arm_laws(study.scene, study.rows), study)
    return resemblances(lib, study.rows.rows_from_fields(moved[None]))


def resemblances(lib: CandidateLibrary, column: Array) -> dict[tuple[str, str], float]:
    """rho^2 of every candidate with rows (N, 1) that something adds to the error: the best variant.

    Projected on what geometry cannot imitate and weighed by the noise that the data show with it.
    """
    noise = estimate_noise_by_reml(lib.problem, column)
    root = np.sqrt(noise.row_weights(lib.problem))[:, None]
    basis = np.linalg.qr(lib.problem.nuisance_basis * root)[0]
    field = project_out(column * root, basis)[:, 0]
    whole = project_out(lib.candidate_columns * root, basis)
    out: dict[tuple[str, str], float] = {}
    for c in lib.candidates:
        part = whole[:, c.column_indices]
        scale = np.maximum(np.linalg.norm(part, axis=0), 1e-300)
        found = np.linalg.lstsq(part / scale, field, rcond=1e-6)[0]
        share = 1.0 - float(((field - part / scale @ found) ** 2).sum() / (field @ field))
        out[c.key] = max(out.get(c.key, 0.0), share)
    return out
