"""A robot in its place: base frame and targets as the instrument sees them; predictions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import CalibrationError, DataError, describe_file_content_error
from minimax_cal.core.files import read_saved_result_json
from minimax_cal.core.units import metres_to_file_mm
from minimax_cal.measuring.measurement_checks import check_and_complete_joints
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.session_frames import (
    NO_SESSION_FRAMES,
    SessionFrames,
    convert_to_first_frame,
    session_labels,
    transform_points,
    transforms_to_first_frame,
)
from minimax_cal.measuring.visit_history import SessionClock, has_visit_order
from minimax_cal.modelling.effects.effect_names import format_effect
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.effects.table import (
    EFFECTS,
    NO_EFFECTS,
    Fitted,
    fitted_effects_from_list,
)
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.robots.kinematics import rotation_from_vector, rotation_to_vector
from minimax_cal.robots.robot import (
    Robot,
    check_poses_and_start,
    robot_from_dict,
    warn_of_unreached_poses,
)
from minimax_cal.robots.transforms import build_transform

MAX_SAVED_POSITION = 1e9  # of a place in a file [m]: a fit that failed may end anywhere
MAX_SILENT_TIME_EXTRAPOLATION = (
    0.1  # of a session: so far beyond its ends, effects of time are not extrapolated silently
)


@dataclass(frozen=True, eq=False)
class Cell:
    """A robot, its base in the measurement frame, and the targets on its flange.

    base: (4, 4) pose of the base [m].  target_names: k of them.  target_positions: (k, 3) in
    the last frame [m].
    effects: what moves the targets beyond geometry.  sessions: where the instrument stood in each,
    and their time; predictions are for the first where data name none.
    """

    robot: Robot
    base: Array
    target_names: tuple[str, ...]
    target_positions: Array
    effects: Fitted = field(default=NO_EFFECTS)
    sessions: SessionFrames = field(default=NO_SESSION_FRAMES)

    @staticmethod
    def from_parameters(
        robot: Robot,
        parameters: ParameterValues,
        targets: tuple[str, ...],
        effects: Fitted = NO_EFFECTS,
        sessions: SessionFrames = NO_SESSION_FRAMES,
    ) -> Cell:
        """The cell that a state of the parameters describes."""
        robot = robot.with_mdh(parameters.mdh)
        return Cell(
            robot, parameters.base_pose, targets, parameters.target_positions, effects, sessions
        )

    @property
    def parameter_values(self) -> ParameterValues:
        """The parameters' values, those of the effects included."""
        values = np.concatenate([np.zeros(0), *self.effects.values])
        base = self.base
        return ParameterValues(
            self.robot.mdh, base[:3, :3], base[:3, 3], self.target_positions, values
        )

    def predict(self, q: Array) -> Array:
        """Where the instrument should see each target: (m, k, 3) [m].  q: (m, n) [rad, m].

        Effects that depend on time, payload or the way there are those of an arm at rest: `follow`
        takes them from measurements.  Raises RobotError for joint values of another arm.
        """
        q = self.robot.check_joint_values(np.atleast_2d(np.asarray(q, dtype=float)))
        if self.effects.terms:
            return self.follow(build_measurements_at_rest(q, self.target_names, self.robot))
        pose = self.base @ self.robot.pose(q)
        turned = self.target_positions @ np.swapaxes(pose[:, :3, :3], 1, 2)
        return np.asarray(turned + pose[:, None, :3, 3])

    def inverse(self, pose: Array, near: Array | None = None) -> Array:
        """Joints (..., n) that bring the flange to poses in the base, effects counted.

        pose: (..., 4, 4) [m].  near: joints to start from, (n,) or (..., n), which choose among the
        ways of the arm [rad, m]; without it any way will do.  Effects are those of an arm at rest,
        and of them those that move the flange.  What cannot be reached ends nearby, with a
        CalibrationWarning.  Raises RobotError for what is no pose.
        """
        from minimax_cal.modelling.inverse_with_effects import solve_joints_at_poses

        given = check_poses_and_start(pose, near, self.robot.joints)
        return warn_of_unreached_poses(*solve_joints_at_poses(self, *given))

    def align_to_first_session(self, data: Measurements) -> Measurements:
        """The data in the first frame of the fit's sessions, with the fit's clock."""
        frames, clock = self.sessions.frames, self.sessions.clock
        return convert_to_first_frame(clock.add_clock_column(data) if clock else data, frames)

    def pose_arm(self, data: Measurements) -> PosedArm:
        """What the laws of effects look at, for all targets of the cell."""
        base = (self.base[:3, :3], self.base[:3, 3])
        hidden = np.full((data.poses, len(self.target_names), 3), np.nan)
        data = self.align_to_first_session(replace(data, target_names=self.target_names, y=hidden))
        return PosedArm.at_measured_poses(
            self.robot, data, base, self.target_positions, self.robot.chain_joint_values(data.q)
        )

    def follow(self, data: Measurements) -> Array:
        """As `predict`, with the columns of the data (session, order, temperature, payload ...).

        Each row in the frame of its session; in the first where the data's points are all given so.
        """
        points, frames = self.predict_in_first_session_frame(data), self.sessions.frames
        if not (frames and data.poses):
            return points
        return transform_points(points, np.linalg.inv(transforms_to_first_frame(data, frames)))

    def predict_in_first_session_frame(self, data: Measurements) -> Array:
        """As `follow`, all rows in the frame of the first session."""
        if not (self.effects.terms and data.poses):
            return replace(self, effects=NO_EFFECTS).predict(data.q)
        points = np.moveaxis(self.effects.displaced_targets(self.pose_arm(data)), -1, 0)
        return np.asarray(points @ self.base[:3, :3].T + self.base[:3, 3])

    def error(self, data: Measurements) -> Array:
        """Measured minus predicted: (m, k, 3), for the targets of the data [m].

        In the axes of the first session.
        """
        data = check_and_complete_joints(self.robot, data)
        strange = [name for name in data.target_names if name not in self.target_names]
        if strange:
            raise DataError(
                f"{data.source}: target {strange[0]} is not one of the fit's "
                f"({', '.join(self.target_names)})"
            )
        chosen = [self.target_names.index(name) for name in data.target_names]
        return np.asarray(
            self.align_to_first_session(data).y
            - self.predict_in_first_session_frame(data)[:, chosen]
        )

    def to_dict(self) -> dict[str, Any]:
        """For JSON: millimetres and a rotation vector in radians."""
        frames, clock = self.sessions.frames, self.sessions.clock
        told: dict[str, Any] = {"clock": vars(clock)} if clock else {}
        if frames:
            told["sessions"] = {label: pose_to_dict(frame) for label, frame in frames.items()}
        return {
            "base": pose_to_dict(self.base),
            "targets_mm": {
                name: [metres_to_file_mm(v) for v in spot]
                for name, spot in zip(self.target_names, self.target_positions, strict=True)
            },
            "effects": self.effects.to_list(),
            **told,
        }

    def whole(self) -> dict[str, Any]:
        """`to_dict` with the robot, as `cell_from_dict` reads it."""
        return {"robot": self.robot.to_dict(), **self.to_dict()}


def pose_to_dict(pose: Array) -> dict[str, list[float]]:
    """A pose (4, 4) for JSON: millimetres and a rotation vector in radians."""
    turn = rotation_to_vector(pose[:3, :3])
    return {
        "translation_mm": [metres_to_file_mm(v) for v in pose[:3, 3]],
        "rotation_vector_rad": [float(v) for v in turn],
    }


def pose_from_dict(content: Mapping[str, Any]) -> Array:
    """From `pose_to_dict`.  Raises KeyError, TypeError, ValueError."""
    turn = np.array(content["rotation_vector_rad"], dtype=float)
    place = np.array(content["translation_mm"], dtype=float)
    pose = build_transform(rotation_from_vector(turn.reshape(3)), 1e-3 * place.reshape(3))
    if not np.isfinite(pose).all() or np.abs(pose).max() > MAX_SAVED_POSITION:
        raise ValueError("a pose is not of plausible numbers")
    return pose


def sessions_from_dict(content: Mapping[str, Any]) -> SessionFrames:
    """The sessions of a saved calibration.  Raises KeyError, TypeError, ValueError."""
    frames = {str(k): pose_from_dict(pose) for k, pose in content.get("sessions", {}).items()}
    told = content.get("clock")
    if told is None:
        return SessionFrames(frames)
    clock = SessionClock(str(told["column"]), float(told["origin"]), float(told["length"]))
    if not (np.isfinite(clock.origin) and 0.0 < clock.length < np.inf):
        raise ValueError("its clock does not run")
    return SessionFrames(frames, clock)


def build_measurements_at_rest(
    q: Array, target_names: tuple[str, ...], robot: Robot
) -> Measurements:
    """Poses (m, n) that no motion led to, at the start of a session."""
    zero = np.zeros(len(q))
    history = {f"{stem}{j + 1}": zero for stem in ("approach", "move") for j in range(robot.joints)}
    nowhere = np.full((len(q), len(target_names), 3), np.nan)
    columns = {**history, "followed": zero, "clock": zero}
    return Measurements(q, nowhere, target_names, robot.prismatic, np.arange(len(q)) + 1, columns)


def cell_from_dict(content: Mapping[str, Any], source: str) -> Cell:
    """A cell from the JSON of a calibration.  Raises CalibrationError.

    Of a fit with effects it is what stands under `cell`, beside the geometry fitted alone.
    """
    if content.get("schema", 1) != 1 or content.get("kind", "calibration") != "calibration":
        raise CalibrationError(
            f"{source}: is a {content.get('kind', 'file')} of schema {content.get('schema')}; "
            "expected a calibration of schema 1"
        )
    try:
        content = {**content, **content.get("cell", {})}
        base, sessions = pose_from_dict(content["base"]), sessions_from_dict(content)
        targets = content["targets_mm"]
        spots = np.array(list(targets.values()), dtype=float).reshape(-1, 3) * 1e-3
        robot = content["robot"]
        effects = effects_from_dict(content, source)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"{source}: is not a saved calibration (robot, base, "
            f"targets_mm: {describe_file_content_error(error)}); "
            "write one with minimax-cal calibrate"
        ) from error
    if not np.abs(spots).max(initial=0.0) <= MAX_SAVED_POSITION:
        raise CalibrationError(f"{source}: targets are not plausible numbers")
    names = tuple(map(str, targets))
    cell = Cell(robot_from_dict(robot, source), base, names, spots, effects, sessions)
    try:
        scene = cell.pose_arm(
            build_measurements_at_rest(
                np.zeros((1, cell.robot.joints)), cell.target_names, cell.robot
            )
        )
        for term, value in effects.terms_with_values:
            names = term.columns(scene).names
            if len(names) != len(value):
                raise ValueError(f"{term.label}: {len(value)} values for {', '.join(names)}")
    except (KeyError, IndexError, ValueError) as error:
        raise CalibrationError(
            f"{source}: its effects do not fit its robot ({describe_file_content_error(error)})"
        ) from error
    return cell


def effects_from_dict(content: Mapping[str, Any], source: str) -> Fitted:
    """The effects of a saved calibration.  Raises CalibrationError for one that is not known."""
    listed = content.get("effects", [])
    strange = [str(e["effect"]) for e in listed if e["effect"] not in EFFECTS]
    if strange:
        raise CalibrationError(
            f"{source}: effect {strange[0]!r} is not known here; register it before loading"
        )
    return fitted_effects_from_list(listed)


def load_cell(path: Path | str) -> Cell:
    """The calibrated cell of a file that `minimax-cal calibrate -o` wrote.

    Parameters
    ----------
    path
        Of the file.

    Returns
    -------
    Cell
        The arm in its place.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> mc.load_cell("fit.json").predict([[0, 0.3, 0.2, 0, 0.5, 0]])
    """
    return cell_from_dict(read_saved_result_json(path), str(path))


def list_session_and_time_notices(cell: Cell, data: Measurements) -> tuple[str, ...]:
    """Notices on measurements whose session or time the fit cannot place.  data: as measured."""
    said = []
    frames, clock = cell.sessions.frames, cell.sessions.clock
    new = sorted(set(session_labels(data)) - set(frames)) if frames else []
    if new:
        named = "no session is named" if new == [""] else f"session {new[-1]} is new to the fit"
        said.append(
            f"{data.source}: {named}: taken to be measured from where session "
            f"{next(iter(frames))} was (the fit knows {', '.join(frames)})"
        )
    led = [format_effect(*t.key) for t in cell.effects.terms if EFFECTS[t.effect].follows_last_move]
    sides = [data.columns[c] for c in data.columns if c.startswith("approach")]
    told = any(np.nan_to_num(side).any() for side in sides)
    if led and not (told or has_visit_order(data)):
        said.append(
            f"{data.source}: {', '.join(led)} depends on the way to a pose, which these data do "
            "not tell: taken as 0; give the column order, or approach1 ..."
        )
    timed = [format_effect(*t.key) for t in cell.effects.terms if t.follows_clock]
    if timed and "clock" not in data.columns:
        column = clock.column if clock else "visit order"
        place = clock.add_clock_column(data).columns.get("clock") if clock else None
        if place is None:
            said.append(
                f"{data.source}: {', '.join(timed)} depends on time, and the fit's clock "
                f"({column}) does not run here: taken to last as long as the fit's session"
            )
        elif (
            place.min() < -MAX_SILENT_TIME_EXTRAPOLATION
            or place.max() > 1.0 + MAX_SILENT_TIME_EXTRAPOLATION
        ):
            said.append(
                f"{data.source}: {', '.join(timed)} is extrapolated: by {column} these poses lie "
                f"from {place.min():.3g} to {place.max():.3g} of the fit's session"
            )
    return tuple(said)
