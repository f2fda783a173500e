"""A saved calibration and measurements to judge it by: who predicts, and what no fit has seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from minimax_cal.fitting.fit import Fit, load_fit
from minimax_cal.fitting.start import fit_base
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, DataError
from minimax_cal.measuring.checks import check_joints
from minimax_cal.measuring.grouping import REPEAT
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.model import model_of
from minimax_cal.robots.robot import load_robot

BEFORE, AFTER = "before", "after"
SAME = 1e-6  # a file's own errors come back to this, or its effects need more columns [m]
FAR = 5e-3  # errors above this share of the arm's reach are not what calibration leaves


@dataclass(frozen=True, eq=False)
class Saved:
    """Cells before (nominal) and after (calibrated), and poses to judge them by.

    held: (m,) True where the fit has not seen the pose.
    """

    cells: Mapping[str, Cell]
    data: Measurements
    held: Array
    fit: Fit
    notices: tuple[str, ...]


def open_fit(source: Fit | Path | str, data: Path | str = "", nominal: str = "") -> Saved:
    """A fit, or its file, with the measurements in a file, or with its own.

    nominal: the robot before calibration, file or name; that of the fit unless given.
    Raises CalibrationError.
    """
    fit = source if isinstance(source, Fit) else load_fit(source)
    cell = fit.cell
    notices: tuple[str, ...] = ()
    if data:
        measured, said = known_targets(read_measurements(data), cell)
        held, more = unseen(measured, fit)
        notices = (*measured.notices, *said, *more)
    elif fit.data.poses:
        measured, held = fit.data, fit.held
        check_own(fit, str(source))
    else:
        raise CalibrationError(f"{source}: holds no poses; name the file of measurements too")
    train = fit.train if fit.data.poses else measured.take(~held)
    before, said = nominal_cell(fit, train, nominal, str(source))
    miss = np.nanmedian(np.linalg.norm(cell.error(measured), axis=-1))
    if miss > FAR * cell.robot.reach():
        said += (
            f"{measured.source}: the fit misses by {1e3 * miss:.3g} mm: check that data and fit "
            "belong to the same robot, measurement frame, units and order of targets",
        )
    return Saved({BEFORE: before, AFTER: cell}, measured, held, fit, (*notices, *said))


def known_targets(data: Measurements, cell: Cell) -> tuple[Measurements, tuple[str, ...]]:
    """The data without targets that the fit does not know, and a notice that names them."""
    known = np.array([name in cell.target_names for name in data.target_names])
    if known.all() or not known.any():
        return data, ()  # of none in common the cell itself complains
    names = ", ".join(np.array(data.target_names)[~known])
    return data.keep(known), (f"{data.source}: {names} left out: the fit does not know them",)


def unseen(data: Measurements, fit: Fit) -> tuple[Array, tuple[str, ...]]:
    """(m,) True where the fit has not seen the pose, by its own split or by the joints; notices."""
    if not fit.data.poses:
        said = "the fit does not tell its training poses: all count as training poses"
        return np.zeros(data.poses, dtype=bool), (said,)
    if data.digest and data.digest == fit.provenance.data_sha256:
        return np.isin(data.line, fit.data.line[fit.held]), ()
    held = np.asarray(KDTree(fit.train.q).query(data.q)[0]) > REPEAT
    said = (
        f"{data.source}: is not the file of the fit; {int((~held).sum())} of its {data.poses} rows "
        "have the joints of a training pose, the others count as held out"
    )
    return held, (said,)


def check_own(fit: Fit, source: str) -> None:
    """Raise DataError if the poses in a file do not give back the errors in it."""
    if not np.nanmax(np.abs(fit.cell.error(fit.data) - fit.error), initial=0.0) <= SAME:
        raise DataError(
            f"{source}: its effects need columns of the measurements that it does not hold; name "
            "the file of measurements too"
        )


def nominal_cell(
    fit: Fit, train: Measurements, nominal: str, source: str
) -> tuple[Cell, tuple[str, ...]]:
    """The arm before calibration in its place: the fit's, else as it fits poses best; notices.

    train: the training poses.  nominal: its robot, "" for the fit's own.  Raises CalibrationError.
    """
    if not nominal:
        if fit.nominal is None:
            raise CalibrationError(
                f"{source}: does not tell its nominal robot; give it (--nominal)"
            )
        return fit.nominal, ()
    robot = load_robot(nominal)
    missing = [name for name in fit.cell.target_names if name not in train.target_names]
    if missing:
        raise DataError(f"{train.source}: {missing[0]} was not measured")
    check_joints(robot, train)
    state = fit_base(model_of(robot, train), robot.mdh).state
    said = f"{robot.name} before calibration is placed where it fits {train.poses} poses best"
    return Cell.of(robot, state, train.target_names), (said,)
