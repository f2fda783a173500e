"""Frames of sessions: a start from the robot as drawn, and small steps of them taken exactly.

In a fit the frame of each further session is six linear parameters (`session_jump`), in base axes
about where it was taken to stand.  What they find is put into the frame as a whole turn, so that
the next pass has them near zero, where they are exact.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.session_frames import Frames, convert_to_first_frame, session_labels
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.global_start import fit_base_and_targets
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import rotation_to_vector
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import build_transform, nearest_rotations

MIN_FRAME_POINTS = 3  # points that give a frame
MIN_SESSION_POSES = 12  # poses of a session that place the robot by themselves
MAX_PLACING_ROUNDS = 20  # of placing targets and frames in turn,
MAX_SETTLED_MOVE = 1e-9  # until these move less [m]


def place_sessions(robot: Robot, data: Measurements, train: Array) -> Measurements:
    """The data with the points of all sessions in the frame of the first, as the drawing has it.

    train: (m,) True for the rows that may be looked at.  Sessions that have none there are taken to
    be in the first frame (`warn_of_unplaced_sessions`).  Raises DataError for a session of too few
    points.
    """
    label, names = session_labels(data), session_names(data.take(train))
    if len(names) < 2 or data.frames:
        return data
    for name in names:
        points = data.seen[train & (label == name)].sum()
        if points < MIN_FRAME_POINTS:
            raise DataError(
                f"{data.source}: session {name!r} has {points} points to place its measurement "
                "frame by; measure more, leave its rows out, or give them the session whose frame "
                "they share"
            )
    seen = data.take(train)
    sessions = {name: seen.take(session_labels(seen) == name) for name in names}

    # First the largest session; others by themselves, or by points that few poses have of it.
    largest = max(sessions.values(), key=lambda session: session.poses)
    state = fit_base_and_targets(build_point_model(robot, largest), robot.mdh).state
    frames = {}
    for name, session in sessions.items():
        if session.poses >= MIN_SESSION_POSES:
            own = fit_base_and_targets(build_point_model(robot, session), robot.mdh).state
            frames[name] = state.base_pose @ np.linalg.inv(own.base_pose)
        else:
            frames[name] = fit_session_frame(session, robot, state)

    # Then targets, and frames, in turn.
    for _ in range(MAX_PLACING_ROUNDS):
        state = fit_base_and_targets(
            build_point_model(robot, convert_to_first_frame(seen, frames)), robot.mdh
        ).state
        placed = {name: fit_session_frame(one, robot, state) for name, one in sessions.items()}
        step = max(np.abs(placed[name] - frames[name]).max() for name in names)
        frames = placed
        if step < MAX_SETTLED_MOVE:
            break
    first = np.linalg.inv(frames[names[0]])
    return convert_to_first_frame(
        data,
        {name: np.eye(4) if name == names[0] else first @ frames[name] for name in names},
    )


def session_names(data: Measurements) -> list[str]:
    """The names of sessions in the order of their first rows."""
    return list(dict.fromkeys(session_labels(data).tolist()))


def warn_of_unplaced_sessions(data: Measurements, train: Array) -> tuple[str, ...]:
    """A notice on sessions that are held out whole: no row determines their frame."""
    names = session_names(data.take(train))
    lost = [name for name in session_names(data) if name not in names]
    if not lost:
        return ()
    return (
        f"{data.source}: held out whole: session {', '.join(lost)}; judged in the frame of session "
        f"{names[0]}",
    )


def fit_session_frame(data: Measurements, robot: Robot, state: ParameterValues) -> Array:
    """(4, 4) what takes points as they are given nearest to where a state has them."""
    there = Cell.from_parameters(robot, state, data.target_names).predict(data.q)[data.seen]
    return fit_rigid_motion(data.y[data.seen], there)


def fit_rigid_motion(points: Array, target_points: Array) -> Array:
    """(4, 4) what takes points (n, 3) nearest to where others are [Kabsch 1976]."""
    centre, goal = points.mean(axis=0), target_points.mean(axis=0)
    rotation = nearest_rotations((target_points - goal).T @ (points - centre))
    return build_transform(rotation, goal - rotation @ centre)


def apply_frame_steps(frames: Frames, state: ParameterValues) -> tuple[Frames, ParameterValues]:
    """Frames with the steps that a state holds for them, first of its effects, and it without."""
    if not len(state.effects):
        return frames, state
    steps = state.effects[: count_frame_parameters(frames)].reshape(-1, 6)
    base, out = state.base_pose, dict(frames)
    for name, step in zip(list(frames)[1:], steps, strict=True):
        jump = build_transform(kinematics.rotation_from_vector(step[3:]), step[:3])
        out[name] = base @ np.linalg.inv(jump) @ np.linalg.inv(base) @ frames[name]
    rest = np.concatenate([0.0 * steps.reshape(-1), state.effects[steps.size :]])
    return out, replace(state, effects=rest)


def count_frame_parameters(frames: Frames) -> int:
    """How many parameters free the frames."""
    return 6 * max(len(frames) - 1, 0)


def base_poses_in_sessions(frames: Frames, base: Array) -> Array:
    """(6 (s - 1),) where the base stands in each further session, as seen from the first.

    Three lengths along its own axes there [m], and its turn as a vector [rad].  base: (4, 4).
    """
    out = []
    for frame in list(frames.values())[1:]:
        jump = np.linalg.inv(base) @ np.linalg.inv(frame) @ base
        turn = jump[:3, :3]
        out += [turn.T @ jump[:3, 3], rotation_to_vector(turn)]
    return np.concatenate([np.zeros(0), *out])
