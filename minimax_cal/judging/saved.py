"""A saved calibration and measurements to judge it by: who predicts, and what no fit has seen."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.fitting.start import fit_base
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, DataError
from minimax_cal.ground.files import read_text
from minimax_cal.measuring.checks import check_joints
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.measuring.pose_rows import read_poses
from minimax_cal.modelling.cell import Cell, cell_from_dict, load_cell
from minimax_cal.modelling.model import model_of
from minimax_cal.robots.robot import load_robot, robot_from_dict

BEFORE, AFTER = "before", "after"
SAME = 1e-6  # a file's own errors come back to this, or its effects need more columns [m]
FAR = 5e-3  # errors above this share of the arm's reach are not what calibration leaves


@dataclass(frozen=True, eq=False)
class Saved:
    """Cells before (nominal) and after (calibrated), and poses to judge them by.

    held: (m,) True where the fit has not seen the pose.  content: of the file.
    """

    cells: Mapping[str, Cell]
    data: Measurements
    held: Array
    content: Mapping[str, Any]
    notices: tuple[str, ...]


def open_fit(fit: Path | str, data: Path | str = "", nominal: str = "") -> Saved:
    """A file of `calibrate -o` with the measurements in a file, or with its own.

    nominal: the robot before calibration, file or name; that of the fit unless given.
    Raises CalibrationError.
    """
    cell = load_cell(fit)
    content: Mapping[str, Any] = json.loads(read_text(fit))
    own = [read_poses(content["poses"], str(fit))] if "poses" in content else []
    said: tuple[str, ...] = ()
    if data:
        measured, said = known_targets(read_measurements(data), cell)
        held, more = unseen(measured, own, content)
        said += more
    elif own:
        measured, held = own[0]
        check_own(cell, measured, content, str(fit))
    else:
        raise CalibrationError(f"{fit}: holds no poses; name the file of measurements too")
    train = [poses.take(~out) for poses, out in own] or [measured.take(~held)]
    before, more = nominal_cell(content, cell, train[0], nominal, str(fit))
    miss = np.nanmedian(np.linalg.norm(cell.error(measured), axis=-1))
    if miss > FAR * cell.robot.reach():
        more += (
            f"{measured.source}: the fit misses by {1e3 * miss:.3g} mm: check that data and fit "
            "belong to the same robot, measurement frame, units and order of targets",
        )
    cells = {BEFORE: before, AFTER: cell}
    return Saved(cells, measured, held, content, (*measured.notices, *said, *more))


def known_targets(data: Measurements, cell: Cell) -> tuple[Measurements, tuple[str, ...]]:
    """The data without targets that the fit does not know, and a notice that names them."""
    known = np.array([name in cell.target_names for name in data.target_names])
    if known.all() or not known.any():
        return data, ()  # of none in common the cell itself complains
    names = ", ".join(np.array(data.target_names)[~known])
    return data.keep(known), (f"{data.source}: {names} left out: the fit does not know them",)


def unseen(
    data: Measurements, own: list[tuple[Measurements, Array]], content: Mapping[str, Any]
) -> tuple[Array, tuple[str, ...]]:
    """(m,) True where the fit has not seen the pose, by its own split or by the joints; notices."""
    if not own:
        said = "the fit does not tell its training poses: all count as training poses"
        return np.zeros(data.poses, dtype=bool), (said,)
    stored, out = own[0]
    if data.digest and data.digest == content.get("provenance", {}).get("data_sha256"):
        return np.isin(data.line, stored.line[out]), ()
    joints = {row.tobytes() for row in np.round(stored.q[~out], 9) + 0.0}
    held = np.array([row.tobytes() not in joints for row in np.round(data.q, 9) + 0.0])
    said = (
        f"{data.source}: is not the file of the fit; {int((~held).sum())} of its {data.poses} rows "
        "have the joints of a training pose, the others count as held out"
    )
    return held, (said,)


def check_own(cell: Cell, data: Measurements, content: Mapping[str, Any], source: str) -> None:
    """Raise DataError if the poses in a file do not give back the errors in it."""
    try:
        told = np.moveaxis(np.array(content["poses"]["errors_mm"]["final"], dtype=float), 0, 1)
        apart = np.nanmax(np.abs(cell.error(data) - 1e-3 * told), initial=0.0)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{source}: its list of errors cannot be read ({error})") from error
    if not apart <= SAME:
        raise DataError(
            f"{source}: its effects need columns of the measurements that it does not hold; name "
            "the file of measurements too"
        )


def nominal_cell(
    content: Mapping[str, Any], cell: Cell, train: Measurements, nominal: str, source: str
) -> tuple[Cell, tuple[str, ...]]:
    """The arm before calibration in its place: as saved, else as it fits the poses best; notices.

    train: the training poses.  nominal: its robot, "" for the fit's own.  Raises CalibrationError.
    """
    if not nominal and {"nominal_cell", "nominal_robot"} <= set(content):
        both = {"robot": content["nominal_robot"], **content["nominal_cell"]}
        return cell_from_dict(both, f"{source}: nominal_cell"), ()
    if nominal:
        robot = load_robot(nominal)
    elif "nominal_robot" in content:
        robot = robot_from_dict(content["nominal_robot"], f"{source}: nominal_robot")
    else:
        raise CalibrationError(f"{source}: does not tell its nominal robot; give it (--nominal)")
    missing = [name for name in cell.target_names if name not in train.target_names]
    if missing:
        raise DataError(f"{train.source}: {missing[0]} was not measured")
    check_joints(robot, train)
    state = fit_base(model_of(robot, train), robot.mdh).state
    said = f"{robot.name} before calibration is placed where it fits {train.poses} poses best"
    return Cell.of(robot, state, train.target_names), (said,)
