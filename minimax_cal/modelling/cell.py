"""A robot in its place: base frame and targets as the instrument sees them; predictions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, DataError
from minimax_cal.ground.files import json_of, read_text
from minimax_cal.measuring.checks import check_joints
from minimax_cal.measuring.measurements import FARTHEST, Measurements
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import EFFECTS, NOTHING, Fitted, fitted_from_list
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.robot import Robot, robot_from_dict


class NotSaved(CalibrationError):
    """A file that holds no saved result."""


@dataclass(frozen=True, eq=False)
class Cell:
    """A robot, its base in the measurement frame, and the targets on its flange.

    base: (4, 4) pose of the base [m].  target_names: k of them.  target_positions: (k, 3) in
    the last frame [m].
    effects: what moves the targets beyond geometry.
    """

    robot: Robot
    base: Array
    target_names: tuple[str, ...]
    target_positions: Array
    effects: Fitted = field(default=NOTHING)

    @staticmethod
    def of(robot: Robot, state: State, targets: tuple[str, ...], effects: Fitted = NOTHING) -> Cell:
        """The cell that a state of the parameters describes."""
        base = np.eye(4)
        base[:3, :3], base[:3, 3] = state.rotation, state.origin
        return Cell(robot.with_mdh(state.mdh), base, targets, state.target_positions, effects)

    @property
    def state(self) -> State:
        """The parameters' values, those of the effects included."""
        values = np.concatenate([np.zeros(0), *self.effects.values])
        base = self.base
        return State(self.robot.mdh, base[:3, :3], base[:3, 3], self.target_positions, values)

    def predict(self, q: Array) -> Array:
        """Where the instrument should see each target: (m, k, 3) [m].  q: (m, n) [rad, m].

        Effects that depend on time, payload or the way there are those of an arm at rest: `follow`
        takes them from measurements.
        """
        q = np.atleast_2d(np.asarray(q, dtype=float))
        if self.effects.terms:
            return self.follow(still(q, self.target_names, self.robot))
        pose = self.base @ self.robot.pose(q)
        turned = np.einsum("mij,kj->mki", pose[:, :3, :3], self.target_positions)
        return np.asarray(turned + pose[:, None, :3, 3])

    def scene(self, data: Measurements) -> Scene:
        """What the laws of effects look at, for all targets of the cell."""
        base = (self.base[:3, :3], self.base[:3, 3])
        hidden = np.full((data.poses, len(self.target_names), 3), np.nan)
        data = replace(data, target_names=self.target_names, y=hidden)
        return Scene.of(self.robot, data, base, self.target_positions, data.q * self.robot.sign)

    def follow(self, data: Measurements) -> Array:
        """As `predict`, with the columns of the data (order, temperature, payload ...)."""
        if not (self.effects.terms and data.poses):
            return Cell(self.robot, self.base, self.target_names, self.target_positions).predict(
                data.q
            )
        points = np.moveaxis(self.effects.points(self.scene(data)), -1, 0)
        return np.asarray(points @ self.base[:3, :3].T + self.base[:3, 3])

    def error(self, data: Measurements) -> Array:
        """Measured minus predicted: (k, m, 3), for the targets of the data [m]."""
        check_joints(self.robot, data)
        strange = [name for name in data.target_names if name not in self.target_names]
        if strange:
            raise DataError(
                f"{data.source}: target {strange[0]} is not one of the fit's "
                f"({', '.join(self.target_names)})"
            )
        chosen = [self.target_names.index(name) for name in data.target_names]
        return np.asarray(np.moveaxis(data.y - self.follow(data)[:, chosen], 1, 0))

    def to_dict(self) -> dict[str, Any]:
        """For JSON: millimetres and a rotation vector in radians."""
        turn = Rotation.from_matrix(self.base[:3, :3]).as_rotvec()
        return {
            "base": {
                "translation_mm": [float(v) * 1e3 for v in self.base[:3, 3]],
                "rotation_vector_rad": [float(v) for v in turn],
            },
            "targets_mm": {
                name: [float(v) * 1e3 for v in spot]
                for name, spot in zip(self.target_names, self.target_positions, strict=True)
            },
            "effects": self.effects.to_list(),
        }

    def whole(self) -> dict[str, Any]:
        """`to_dict` with the robot, as `cell_from_dict` reads it."""
        return {"robot": self.robot.to_dict(), **self.to_dict()}


def still(q: Array, targets: tuple[str, ...], robot: Robot) -> Measurements:
    """Poses (m, n) that no motion led to, at the start of a session."""
    zero = np.zeros(len(q))
    history = {f"{stem}{j + 1}": zero for stem in ("approach", "move") for j in range(robot.joints)}
    nowhere = np.full((len(q), len(targets), 3), np.nan)
    columns = {**history, "followed": zero, "clock": zero}
    return Measurements(q, nowhere, targets, robot.prismatic, np.arange(len(q)) + 1, columns)


def cell_from_dict(content: Mapping[str, Any], source: str) -> Cell:
    """A cell from the JSON of a calibration.  Raises CalibrationError."""
    if content.get("schema", 1) != 1 or content.get("kind", "calibration") != "calibration":
        raise CalibrationError(
            f"{source}: is a {content.get('kind', 'file')} of schema {content.get('schema')}; "
            "expected a calibration of schema 1"
        )
    try:
        base = np.eye(4)
        turn = np.array(content["base"]["rotation_vector_rad"], dtype=float)
        base[:3, :3] = Rotation.from_rotvec(turn.reshape(3)).as_matrix()
        base[:3, 3] = np.array(content["base"]["translation_mm"], dtype=float).reshape(3) * 1e-3
        targets = content["targets_mm"]
        spots = np.array([targets[name] for name in targets], dtype=float).reshape(-1, 3) * 1e-3
        robot = content["robot"]
        effects = effects_from(content, source)
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"{source}: is not a saved calibration (robot, base, targets_mm: {error}); "
            "write one with minimax-cal calibrate -o"
        ) from error
    large = np.abs(np.concatenate([base[:3, 3], spots.reshape(-1)])).max()
    if not (np.all(np.isfinite(base)) and large <= FARTHEST):
        raise CalibrationError(f"{source}: base or targets are not plausible numbers")
    cell = Cell(robot_from_dict(robot, source), base, tuple(map(str, targets)), spots, effects)
    try:
        scene = cell.scene(still(np.zeros((1, cell.robot.joints)), cell.target_names, cell.robot))
        for term, value in zip(effects.terms, effects.values, strict=True):
            names = term.columns(scene).names
            if len(names) != len(value):
                raise ValueError(f"{term.label}: {len(value)} values for {', '.join(names)}")
    except (KeyError, IndexError, ValueError) as error:
        raise CalibrationError(f"{source}: its effects do not fit its robot ({error})") from error
    return cell


def effects_from(content: Mapping[str, Any], source: str) -> Fitted:
    """The effects of a saved calibration.  Raises CalibrationError for one that is not known."""
    listed = content.get("effects", [])
    strange = [str(e["effect"]) for e in listed if e["effect"] not in EFFECTS]
    if strange:
        raise CalibrationError(
            f"{source}: effect {strange[0]!r} is not known here; register it before loading"
        )
    return fitted_from_list(listed)


def load_cell(path: Path | str) -> Cell:
    """The calibrated cell of a file that `minimax-cal calibrate -o` wrote.

    path: of the file.  Raises CalibrationError.

    >>> mc.load_cell("fit.json").predict([[0, 0.3, 0.2, 0, 0.5, 0]])
    """
    return cell_from_dict(saved_content(path), str(path))


def saved_content(path: Path | str) -> Mapping[str, Any]:
    """The JSON of a saved calibration.  Raises NotSaved."""
    try:
        content = json_of(read_text(path, kind=NotSaved))
    except (ValueError, RecursionError) as error:
        raise NotSaved(f"{path}: is not JSON ({error})") from error
    if not isinstance(content, Mapping):
        raise NotSaved(f"{path}: is not a saved calibration")
    return content
