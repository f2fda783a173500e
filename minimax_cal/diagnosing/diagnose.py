"""Diagnose the gap that geometry leaves: where it lies, what causes it, how far it shrinks."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from minimax_cal.diagnosing.causes import causes_of, explained, fault_findings, judged
from minimax_cal.diagnosing.gap import blocked, gap_of, with_shares
from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.diagnosing.sentences import reasons
from minimax_cal.diagnosing.study import SUM, Study, studied
from minimax_cal.diagnosing.where import Where, where
from minimax_cal.evidence.alternatives import resemblances
from minimax_cal.evidence.library import library
from minimax_cal.fitting.calibrate import doubts
from minimax_cal.fitting.checks import check_plausible, misplaced, put_right
from minimax_cal.fitting.fit import Provenance
from minimax_cal.fitting.options import Progress, silent
from minimax_cal.fitting.solve import Solved, fit_cell
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.measuring import checks
from minimax_cal.measuring.faults import Fault, find_faults, in_lines, mended
from minimax_cal.measuring.grouping import split
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import EFFECTS
from minimax_cal.robots.robot import Robot, load_robot


def diagnose(
    robot: Robot | str | Path,
    data: Measurements | str | Path,
    *,
    seed: int = 0,
    holdout: float = 0.2,
    exclude: Sequence[str] = (),
    progress: Progress = silent,
) -> Diagnosis:
    """Say what is still wrong with a calibrated robot, and why, as far as the data can tell.

    robot, data: loaded, or a name or path.  seed, holdout: of the poses kept out of the fit, and
    their share.  exclude: effects that are not to be considered.  progress: called with a word on
    each stage.  Lengths of the result are in m, in mm where a name says so.  Raises
    CalibrationError for wrong input.

    >>> print(mc.diagnose("irb2600", "poses.csv", exclude=["backlash"]).summary())
    """
    began = time.perf_counter()
    robot = robot if isinstance(robot, Robot) else load_robot(robot)
    given = data if isinstance(data, Measurements) else read_measurements(data)
    for name in exclude:
        if name not in EFFECTS:
            raise OptionError(f"no effect {name!r} to leave out; choose {', '.join(EFFECTS)}")
    checks.check_joints(robot, given)
    checks.check_spread(given)
    with threadpool_limits(limits=1, user_api="blas"):  # more would wait for each other, and longer
        return examined(robot, given, seed, holdout, exclude, progress, began)


def examined(
    robot: Robot,
    given: Measurements,
    seed: int,
    holdout: float,
    exclude: Sequence[str],
    progress: Progress,
    began: float,
) -> Diagnosis:
    """The diagnosis of checked measurements.  began: when the work did [s]."""
    progress("data faults")
    raw = with_history(given)
    clean = cleaned(robot, raw, seed, holdout, progress)
    train, held, notices = split(clean.data, holdout, seed)
    if not held.poses:
        raise DataError(
            f"{given.source}: no pose is held out; a diagnosis needs some that no fit has seen"
        )
    study = studied(robot, train, clean.fit or fit_cell(robot, train, SUM, progress))
    causes = causes_of(study, clean.faults, exclude, progress)
    progress("gap ladder")
    gap = gap_of(study, raw, clean.data, held, causes, seed, holdout)
    findings = with_shares([*fault_findings(causes.faults), *causes.effects], gap.steps, gap.floor)
    verdict, structure_left = judged(findings, causes.traces, explained(study, causes.choice))
    noise = causes.choice.noise
    if verdict == "none" and gap.shaky(noise):
        verdict = "not_repeatable"
    lies = located(study)
    wrong = doubts(robot, study.fit, study.nominal.error(study.data))
    settings = {"seed": seed, "holdout": holdout, "exclude": list(exclude)}
    told = reasons(
        verdict, gap.steps, gap.floor, findings, gap.closed, gap.closed_ci, structure_left
    )
    return Diagnosis(
        robot=robot.name,
        status=study.fit.status,
        verdict=verdict,
        reasons=told,
        findings=tuple(findings),
        ladder=gap.steps,
        floor=gap.floor,
        floor_from=gap.floor_from,
        closed=gap.closed,
        closed_ci=gap.closed_ci,
        blocked=blocked(study, clean.data, gap.cells[-1]),
        noise=float(np.sqrt(noise.variance)),
        jitter=noise.jitter,
        structure=structure_left[1],
        structure_in=structure_left[0],
        where=lies.to_dict(),
        not_testable=causes.untestable,
        notices=(*given.notices, *notices, *clean.remarks, *study.fit.notices, *wrong),
        provenance=Provenance.of(robot, given, settings),
        seconds=time.perf_counter() - began,
        data=clean.data,
        held=np.isin(clean.data.line, held.line),
        cells=gap.cells,
        nominal=study.nominal,
    )


def located(study: Study) -> Where:
    """Where the geometric errors of the training poses lie."""
    state = study.fit.state
    return where(
        study.data,
        study.model.error(state),
        study.scene.jacobian,
        study.geometric.base,
        float("nan"),
        fitted=study.model.jacobian(state)[..., study.fit.identification.active],
        up=study.robot.up,
    )


# ---- data faults -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Clean:
    """Measurements with rows and points put right or left out.

    faults: their rows as lines of the file.  remarks: on them, for people.  fit: the geometric fit
    of the training poses, where it is that of the clean data.
    """

    data: Measurements
    faults: tuple[Fault, ...]
    remarks: tuple[str, ...]
    fit: Solved | None


def cleaned(
    robot: Robot, data: Measurements, seed: int, holdout: float, progress: Progress
) -> Clean:
    """The data without the faults that can be mended."""
    data, exchanged = in_order(robot, data)
    found = find_faults(data)
    sound = mended(data, found)
    check_plausible(robot, sound)
    train, _, _ = split(sound, holdout, seed)
    progress("geometry")
    fit = fit_cell(robot, train, SUM, progress)
    error = Cell.of(robot, fit.state, sound.target_names).error(sound)
    more = tuple(fault for fault in find_faults(sound, error) if fault.effect == "outliers")
    faults = (
        *exchanged,
        *in_lines(data, found, "swapped_rows", "outliers"),
        *in_lines(sound, more, "outliers"),
    )
    sound = mended(sound, more)
    sound = sound.take(np.asarray(sound.seen.any(axis=1)))
    remarks = tuple(fault.text for fault in (*found, *more) if fault.effect != "target_shift")
    return Clean(sound, faults, remarks, None if more else fit)


def in_order(robot: Robot, data: Measurements) -> tuple[Measurements, tuple[Fault, ...]]:
    """The data with points that stand in each other's rows put back, and the fault if any did."""
    rows, source = misplaced(robot, data)
    if not len(rows):
        return data, ()
    lines = ", ".join(str(data.line[row]) for row in rows[:8])
    text = f"{data.source}: rows hold each other's points: lines {lines}"
    fault = Fault("swapped_rows", "all", text, data.line[rows])
    return put_right(data, rows, source), (fault,)


def resemblance(
    robot: Robot | str | Path, data: Measurements | str | Path, displacement: Array, seed: int = 0
) -> dict[tuple[str, str], float]:
    """rho^2 between a known displacement and every effect that the data can test.

    displacement: (k, m, 3) of the points of all rows in the measurement frame [m].  Both are seen
    by the training poses, after projection on what geometry cannot imitate.  For studies.
    """
    robot = robot if isinstance(robot, Robot) else load_robot(robot)
    data = with_history(data if isinstance(data, Measurements) else read_measurements(data))
    train, _, _ = split(data, 0.2, seed)
    study = studied(robot, train, fit_cell(robot, train, SUM, silent))
    rows = np.isin(data.line, train.line)
    moved = np.einsum("ab,kma->kbm", study.fit.state.rotation, displacement[:, rows])
    return resemblances(library(study.scene, study.rows), moved)
