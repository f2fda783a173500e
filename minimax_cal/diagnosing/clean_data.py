"""Measurements without faults of the data, as every fit of a diagnosis takes them.

Distances between targets show the row of a re-seat.  Which of two targets it was, and how far it
went across the line between them, the geometry shows: without the points after it an arm fits the
others better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.diagnosing.scatter import find_points_of_pulled_fit, find_rows_beyond_tails
from minimax_cal.diagnosing.study import SUM
from minimax_cal.fitting.checks import NO_ROWS, check_plausible, misplaced, put_right
from minimax_cal.fitting.jump_sizes import fit_jump_sizes
from minimax_cal.fitting.options import Options, Progress, silent
from minimax_cal.fitting.solve import Solved, fit_cell
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.faults import find_faults, in_lines, mended, spoilt, standing_out
from minimax_cal.measuring.faults.fault import Fault
from minimax_cal.measuring.faults.nests import RESEAT
from minimax_cal.measuring.faults.sessions import session_jumps
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.time import TARGET_SHIFT
from minimax_cal.robots.robot import Robot

ROBUST = replace(SUM, trim=0.3)  # a fit that up to so many wrong points do not pull
MEDIAN_ERROR_RATIO = 1.2533  # standard error of a median over that of a mean, Gaussian: sqrt(pi/2)


@dataclass(frozen=True, eq=False)
class CleanData:
    """Measurements with rows and points put right or left out.

    measured: as measured, but for points that stood in each other's rows.  left_out: faults whose
    points no fit counts, and faults: what is reported; both by lines of the file.  remarks: on
    them, for people.  fit: the geometric fit of the training poses, where it is that of the clean
    data.  jump_times: (j,) as `Study.moments`.  jump_texts: what is said of these, where no effect
    says it.
    """

    data: Measurements
    measured: Measurements
    left_out: tuple[Fault, ...]
    faults: tuple[Fault, ...]
    remarks: tuple[str, ...]
    fit: Solved | None
    jump_times: Array
    jump_texts: tuple[str, ...]


def clean_measurements(
    robot: Robot, given: Measurements, held_lines: Array, progress: Progress
) -> CleanData:
    """The measurements without the faults that can be mended.

    held_lines: lines of the file that no fit may see.
    """

    def take_training_poses(some: Measurements) -> Measurements:
        return some.take(~np.isin(some.line, held_lines))

    def fit_geometry(some: Measurements, options: Options = SUM) -> Cell:
        return fit_cell(robot, take_training_poses(some), options, silent).cell(robot, some)

    # Points that stand in each other's rows go back where the nominal arm expects them.
    data, faults = given, list[Fault]()
    exchanged, source = misplaced(robot, given)
    if len(exchanged):
        data = put_right(given, exchanged, source)
        text = f"{given.source}: rows hold each other's points: {given.list_rows(exchanged)}"
        faults.append(Fault("swapped_rows", "all", text, given.line[exchanged]))

    # Distances between targets, without any arm: single points that moved, swapped targets,
    # re-seated reflectors.  Of a re-seat the geometry then finds the target and the size.
    found = find_faults(data)
    check_plausible(robot, mended(data, found))
    progress("geometry")
    found = find_reseated_targets(found, data, fit_geometry)
    sound = mended(data, found)
    fit = fit_cell(robot, take_training_poses(sound), SUM, progress)
    cell = fit.cell(robot, sound)
    found = tuple(measure_reseat(fault, cell, data) for fault in found)

    # Outliers of the fit; of a robust fit where they may be so many that they pull a plain one.
    error = cell.error(sound)
    outliers = standing_out(cell.placed(sound), error)
    pulling: tuple[Fault, ...] = ()
    if not outliers and all(fault.effect != TARGET_SHIFT.name for fault in found):
        pulling = find_points_of_pulled_fit(
            error, lambda: fit_geometry(sound, ROBUST).error(sound), sound
        )

    # Reported as faults are only points farther off than the tails of all others allow.
    wrong_lines = data.line[find_rows_beyond_tails(data, cell.error(data))]
    points = (*in_lines(data, found, "outliers"), *in_lines(sound, outliers, "outliers"))
    faults += in_lines(data, found, "swapped_rows", RESEAT)
    faults += (fault for fault in points if np.isin(fault.rows, wrong_lines).any())
    faults += in_lines(sound, pulling, "outliers")
    outliers = (*outliers, *pulling)
    sound = mended(sound, outliers)
    sound = sound.take(np.asarray(sound.seen.any(axis=1)))

    # Moments at which all targets jumped together: candidates of the search for causes.
    placed, held = cell.placed(sound), np.isin(sound.line, held_lines)
    jumps = session_jumps(
        placed, cell.error(sound), lambda rows: fit_jump_sizes(robot, placed, ~held, SUM, rows)
    )
    return CleanData(
        data=sound,
        measured=data,
        left_out=tuple(in_lines(data, (*found, *outliers), "outliers", RESEAT)),
        faults=tuple(faults),
        remarks=tuple(f.text for f in (*found, *outliers) if f.effect != TARGET_SHIFT.name),
        fit=None if outliers else fit,
        jump_times=sound.columns["clock"][np.concatenate([NO_ROWS, *(j.rows for j in jumps)])],
        jump_texts=tuple(jump.text for jump in jumps),
    )


def find_reseated_targets(
    faults: Sequence[Fault], data: Measurements, fit_geometry: Callable[[Measurements], Cell]
) -> tuple[Fault, ...]:
    """The faults, each re-seat at the one target without whose points an arm fits best.

    fit_geometry: the calibrated arm of the training poses among some.
    """
    out = list(faults)
    for i, fault in enumerate(faults):
        if fault.effect != RESEAT or len(fault.targets) == 1:
            continue
        trials = [
            replace(fault, place=data.target_names[target], targets=np.array([target]))
            for target in fault.targets
        ]
        squares = []
        for trial in trials:
            some = mended(data, (*out[:i], trial, *out[i + 1 :]))
            squares.append(float(np.nanmean(fit_geometry(some).error(some) ** 2)))
        out[i] = trials[int(np.argmin(squares))]
    return tuple(out)


def measure_reseat(fault: Fault, cell: Cell, data: Measurements) -> Fault:
    """A re-seat with how far the target moved on the flange, the median over its poses [m].

    cell: fitted without the points of the shorter part.  data: with them.
    """
    if fault.effect != RESEAT:
        return fault
    (rows, target), *_ = spoilt(data, [fault])
    error = cell.error(data)[rows, target]
    flange = cell.robot.pose(data.q[rows])[:, :3, :3]
    moves = np.einsum("mji,mj->mi", flange, error @ cell.base[:3, :3])
    size = float(np.linalg.norm(np.median(moves, axis=0)))
    sigma = float(MEDIAN_ERROR_RATIO * np.std(moves, axis=0).max() / np.sqrt(len(moves)))
    first, *others = fault.parameters
    return replace(fault, parameters=(replace(first, value=size, sigma=sigma), *others))
