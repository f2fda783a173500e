"""A simulated arm driven from pose to pose as a controller would: the judge of every model.

Commands follow a minimum-jerk move of 2 s, or as long as keeps every joint below 1 rad/s (slides:
0.25 m/s), at the model's own timestep; then the arm has 1.5 s to come to rest.

Actuators carry gravity but for a share s (`gravcomp` of the bodies, `actuatorgravcomp` of the
joints), so that a joint of the gain s/c stands off by s tau / (s/c) = c tau, whatever s is.  Where
no share suits all joints, because one is stiff and another is not, actuators carry all of gravity
and a compliant joint has a spring of its own on its axis.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import CalibrationError, RobotError
from minimax_cal.core.files import read_saved_result_json
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, build_measurements_at_rest, cell_from_dict
from minimax_cal.robots.kinematics import rotation_from_vector, skew_matrix
from minimax_cal.robots.mjcf_import import body_pose, find_joint_path_to_body, import_mujoco
from minimax_cal.robots.transforms import invert_transform
from minimax_cal.simulators.arm import SimulatedArm
from minimax_cal.simulators.chain import ModelArm, fill_command_history


@dataclass(frozen=True, eq=False)
class Commands:
    """A command map: call it with joint values to get what to command.

    cell: the arm with the effects that the map holds.
    """

    cell: Cell

    def __call__(self, q: Array) -> Array:
        """The commands for joint values q, (n,) or (m, n) [rad, m]."""
        rows = np.atleast_2d(np.asarray(q, dtype=float))
        told = build_measurements_at_rest(rows, self.cell.target_names, self.cell.robot)
        return self.follow(told).reshape(np.shape(q))

    def follow(self, data: Measurements) -> Array:
        """(m, n) the same for measured poses, with the way that led to each [rad, m]."""
        turn = self.cell.effects.joint_shifts(self.cell.pose_arm(data))
        return data.q + self.cell.robot.controller_joint_values(turn)


def load_commands(path: Path | str) -> Commands:
    """The command map that an export to mjcf wrote beside a file.

    Parameters
    ----------
    path
        Of the map.

    Returns
    -------
    Commands
        It takes and gives the controller's joint values [rad, m].

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> data.ctrl[:] = mc.load_commands("arm.commands.json")(q)
    """
    content = read_saved_result_json(path)
    if content.get("kind") != "commands" or "cell" not in content:
        raise CalibrationError(
            f"{path}: is no command map; an export to mjcf writes one where it is needed"
        )
    return Commands(cell_from_dict(content["cell"], str(path)))


# ---- driven --------------------------------------------------------------------------------------


MIN_MOVE_TIME, REST_TIME = 2.0, 1.5  # a move lasts at least, and a rest after it [s]
MAX_COMMANDED_SPEED, MAX_COMMANDED_SLIDE_SPEED = (
    1.0,
    0.25,
)  # no joint is commanded faster [rad/s, m/s]
MAX_REST_SPEED, MAX_REST_SLIDE_SPEED = 2e-3, 1e-3  # slower is at rest [rad/s, m/s]
MINIMUM_JERK_PEAK_SPEED = 1.875  # largest speed of a minimum-jerk move of length 1 in time 1
PARALLEL_RUNS = 4  # of neighbouring poses, whatever the machine: its results are those of any other
TIMESTEPS_BETWEEN_FORCE_CHECKS = 10  # timesteps of a rest between two looks at its forces


@dataclass(frozen=True, eq=False)
class DrivenPoses:
    """Where an arm was after its moves, row by row.

    target_body_poses: (m, 4, 4) of the body that carries the targets, in the world [m]. q: (m, n)
    where the joints were [rad, m].  relative_speed: (m,) largest of all joints, springs with them,
    as a share of what counts as rest.  share_at_force_limit: (n,) share of the timesteps at which a
    joint's actuator was at its force limit.
    """

    target_body_poses: Array
    q: Array
    relative_speed: Array
    share_at_force_limit: Array

    @property
    def is_moving(self) -> Array:
        """(m,) True where it had not come to rest."""
        return self.relative_speed > 1.0


def drive_to_poses(
    chain: ModelArm,
    commands: Array,
    source: str,
    play_positions: Array | None = None,
    progress: Callable[[int], object] = lambda done: None,
) -> DrivenPoses:
    """Drive an arm from command to command and let it rest at each.

    commands: (m, n) [rad, m].  play_positions: (m, n) where each joint rests in its play [rad].
    progress: called with the number of poses done.  The poses are dealt out to threads in runs of
    neighbours; each run begins at rest at the pose before its first one.
    Raises RobotError where MuJoCo finds that the model is unstable.
    """
    if (chain.servo_ids < 0).any():
        return set_joints_without_servos(chain, commands, play_positions)
    count = len(commands)
    runs = np.array_split(np.arange(count), min(PARALLEL_RUNS, count))
    lock, done = Lock(), [0]

    def heard() -> None:
        with lock:
            done[0] += 1
            progress(done[0])

    def one(rows: Array) -> list[DrivenPose]:
        sides = np.zeros(commands.shape) if play_positions is None else play_positions
        return drive_run(chain, commands, sides, rows, source, heard)

    with ThreadPoolExecutor(min(len(runs), os.cpu_count() or 1)) as pool:
        found = zip(*(visit for part in pool.map(one, runs) for visit in part), strict=True)
        poses, q, speed, limited = map(np.array, found)
    return DrivenPoses(poses, q, speed, limited.mean(axis=0))


DrivenPose = tuple[Array, Array, float, Array]  # a row of `DrivenPoses`


def drive_run(
    chain: ModelArm,
    commands: Array,
    play_positions: Array,
    rows: Array,
    source: str,
    report_pose: Callable[[], object],
) -> list[DrivenPose]:
    """A run of moves, one after the other, with a model of its own: a row each of `DrivenPoses`."""
    chain = replace(chain, model=copy(chain.model))
    (mj, model, data, at, dofs), plays, carrier = (
        chain.create_data_with_indices(),
        chain.find_play_qpos_by_joint(),
        chain.target_body,
    )
    joints, servos, moved = (
        list(chain.joint_ids),
        chain.servo_ids,
        list(find_joint_path_to_body(model, carrier)),
    )
    is_slide = model.jnt_type[moved] == mj.mjtJoint.mjJNT_SLIDE
    rest = np.where(is_slide, MAX_REST_SLIDE_SPEED, MAX_REST_SPEED)

    # Limits of actuators and joints, a little inside: rounding does not hide what is at one.
    inside, none = 1.0 - 1e-9, np.array([-np.inf, np.inf])
    is_limited, ends = model.actuator_forcelimited[servos, None], model.actuator_forcerange[servos]
    low, high = (np.where(is_limited, ends, none) * inside).T
    is_limited, ends = model.jnt_actfrclimited[joints, None], model.jnt_actfrcrange[joints]
    low_torque, high_torque = (np.where(is_limited, ends, none) * inside).T

    def steer(path: Array, every: int = 1) -> Array:
        """(n,) at how many timesteps each joint is at a limit along commands (steps, n).

        every: timesteps between two looks, and two commands.
        """
        starts, forces, torques = range(0, len(path), every), list[Array](), list[Array]()
        for k in starts:
            data.ctrl[servos] = path[k]
            mj.mj_step(model, data, min(every, len(path) - k))
            forces.append(data.actuator_force[servos])
            torques.append(data.qfrc_actuator[dofs])
        force, torque = np.array(forces), np.array(torques)
        at_limit = (force <= low) | (force >= high) | (torque <= low_torque)
        return np.asarray(np.diff([*starts, len(path)]) @ (at_limit | (torque >= high_torque)))

    step, start = chain.timestep, commands[rows[0] - 1]
    data.qpos[at], data.ctrl[servos] = start, start
    fill_command_history(model, data)
    count, out = round(REST_TIME / step), list[DrivenPose]()
    steer(np.tile(start, (count, 1)), TIMESTEPS_BETWEEN_FORCE_CHECKS)
    for row in rows:
        for joint, place in plays.items():
            model.qpos_spring[place] = play_positions[row, joint]
        path = minimum_jerk_path(start, commands[row], chain.robot.prismatic, step)
        at_limit = steer(path) + steer(
            np.tile(commands[row], (count, 1)), TIMESTEPS_BETWEEN_FORCE_CHECKS
        )
        check_simulation_is_stable(mj, data, source)
        speed = float((np.abs(data.qvel[model.jnt_dofadr[moved]]) / rest).max())
        share = at_limit / (len(path) + count)
        out.append((body_pose(data, carrier), data.qpos[at], speed, share))
        start = commands[row]
        report_pose()
    return out


def minimum_jerk_path(start: Array, end: Array, is_prismatic: Array, timestep: float) -> Array:
    """(steps, n) commands of a minimum-jerk move [Flash and Hogan 1985, eq. 3]."""
    way = end - start
    needed = (
        MINIMUM_JERK_PEAK_SPEED
        * np.abs(way)
        / np.where(is_prismatic, MAX_COMMANDED_SLIDE_SPEED, MAX_COMMANDED_SPEED)
    )
    count = max(1, round(max(MIN_MOVE_TIME, float(needed.max(initial=0.0))) / timestep))
    t = np.arange(1, count + 1)[:, None] / count
    return start + way * t**3 * (10.0 - 15.0 * t + 6.0 * t**2)


def check_simulation_is_stable(mujoco_module: Any, data: Any, source: str) -> None:
    """Raise RobotError where MuJoCo found numbers that no arm has, and began anew."""
    for kind in (mujoco_module.mjtWarning.mjWARN_BADQPOS, mujoco_module.mjtWarning.mjWARN_BADQVEL,
                 mujoco_module.mjtWarning.mjWARN_BADQACC):  # fmt: skip
        if data.warning[int(kind)].number:
            raise RobotError(
                f"{source}: the simulation is unstable (MuJoCo: {kind.name}); give its servos "
                'dampers (kv), a shorter timestep, or <option integrator="implicitfast">'
            )


def set_joints_without_servos(
    chain: ModelArm, commands: Array, play_positions: Array | None
) -> DrivenPoses:
    """The same for a model without servos: its joints are set and nothing moves."""
    (mj, model, data, at, _), out = chain.create_data_with_indices(), []
    for row in range(len(commands)):
        data.qpos[at] = commands[row]
        for joint, place in chain.find_play_qpos_by_joint().items():
            data.qpos[place] = 0.0 if play_positions is None else play_positions[row, joint]
        mj.mj_kinematics(model, data)
        out.append(body_pose(data, chain.target_body))
    still, limited = np.zeros(len(commands)), np.zeros(commands.shape[1])
    return DrivenPoses(np.array(out), commands, still, limited)


def find_poses_in_contact(chain: ModelArm, model: Any, joint_values: Array) -> Array:
    """(m,) True where the arm touches something, or itself, at joint values (m, n) [rad, m].

    model: that of the chain, with its contacts.
    """
    mj, carried = import_mujoco(), chain.find_carrying_joints() >= 0
    data, out = mj.MjData(model), np.zeros(len(joint_values), dtype=bool)
    for row, values in enumerate(joint_values):
        data.qpos[chain.qpos_indices] = values
        mj.mj_fwdPosition(model, data)
        sides = carried[model.geom_bodyid[data.contact.geom]].any(axis=-1)
        out[row] = (sides & (data.contact.dist < 0.0)).any()
    return out


# ---- where a written file lets its targets stand -------------------------------------------------


MAX_NEWTON_STEPS, MAX_CONVERGED_STEP = (
    20,
    1e-12,
)  # of Newton's method, and the largest step that is none [rad, m]
DIFFERENCE_STEP = 1e-7  # to find slopes of forces [rad, m]


def measure_target_offsets(
    chain: ModelArm, cell: Cell, arm: SimulatedArm, base: Array, data: Measurements
) -> Array:
    """(m, k, 3) from where the targets of a written model stand to where the cell says [m].

    As the instrument sees it; the command map of the arm corrects the commands.
    base: (4, 4) of the arm in the model's world [m].
    """
    commands = Commands(replace(cell, effects=arm.mapped_effects)).follow(data)
    points = find_target_positions_at_rest(
        chain, data.target_names, commands, arm.find_play_positions(data)
    )
    to = cell.base @ invert_transform(base)
    chosen = [cell.target_names.index(name) for name in data.target_names]
    expected = cell.predict_in_first_session_frame(data)[:, chosen]
    return np.asarray(expected - points @ to[:3, :3].T - to[:3, 3])


def find_target_positions_at_rest(
    chain: ModelArm, target_names: tuple[str, ...], commands: Array, play_positions: Array | None
) -> Array:
    """(m, k, 3) sites of these names, in the world, with all forces of the arm in balance [m].

    commands: (m, n) [rad, m].  play_positions: (m, n) where each joint rests in its play [rad].
    """
    chain = replace(chain, model=copy(chain.model))
    (mj, model, data, *_), sides, servos = (
        chain.create_data_with_indices(),
        chain.find_play_qpos_by_joint(),
        chain.servo_ids,
    )
    joints = list(find_joint_path_to_body(model, int(model.site(target_names[0]).bodyid[0])))
    at, dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    states = model.actuator_actadr[servos]
    out = np.empty((len(commands), len(target_names), 3))

    def force(q: Array) -> Array:
        data.qpos[at] = q
        mj.mj_forward(model, data)
        return np.array(data.qfrc_smooth[dofs])

    for row, command in enumerate(commands):
        mj.mj_resetData(model, data)
        data.qpos[chain.qpos_indices] = data.ctrl[servos] = command
        fill_command_history(model, data)
        data.act[states[states >= 0]] = command[states >= 0]
        for joint, place in sides.items():
            data.qpos[place] = model.qpos_spring[place] = (
                0.0 if play_positions is None else play_positions[row, joint]
            )
        q = data.qpos[at]
        for _ in range(MAX_NEWTON_STEPS):
            here = force(q)
            slope = (
                np.array([force(q + step) - here for step in DIFFERENCE_STEP * np.eye(len(q))]).T
                / DIFFERENCE_STEP
            )
            step = np.linalg.solve(slope, here)
            q = q - step
            if np.abs(step).max() < MAX_CONVERGED_STEP:
                break
        force(q)
        out[row] = [data.site(name).xpos for name in target_names]
    return out


# ---- base and targets that suit given flange poses best ------------------------------------------


MAX_GAUSS_NEWTON_STEPS = 30  # of Gauss and Newton, until a step is none


def compute_error_with_fitted_base(
    flange_poses: Array,
    data: Measurements,
    is_training: Array,
    start_base_and_targets: tuple[Array, Array],
) -> Array:
    """Measured minus predicted (m, k, 3), NaN where not measured [m].

    flange_poses: (m, 4, 4) of the flange in some base frame [m].  is_training: (m,) mask of the
    poses that place base and targets.  start_base_and_targets: base (4, 4) in the measurement frame
    and targets (k, 3) in the flange.
    """
    turn, origin = start_base_and_targets[0][:3, :3], start_base_and_targets[0][:3, 3]
    spots = start_base_and_targets[1]
    for _ in range(MAX_GAUSS_NEWTON_STEPS):
        error, columns = linearise_base_and_targets(
            flange_poses[is_training], data.y[is_training], turn, origin, spots
        )
        seen = np.isfinite(error).all(axis=-1)
        step = np.linalg.lstsq(
            columns[seen].reshape(-1, columns.shape[-1]), error[seen].reshape(-1), rcond=1e-10
        )[0]
        origin = origin + turn @ step[:3]
        turn = turn @ rotation_from_vector(step[3:6])
        spots = spots + step[6:].reshape(-1, 3)
        if np.abs(step).max() < MAX_CONVERGED_STEP:
            break
    error, _ = linearise_base_and_targets(flange_poses, data.y, turn, origin, spots)
    return error


class BaseAndTargetColumns(NamedTuple):
    """Errors (m, k, 3) and their derivatives (m, k, 3, 6 + 3 k) by base and targets."""

    error: Array
    columns: Array


def linearise_base_and_targets(
    poses: Array, y: Array, base_rotation: Array, base_origin: Array, target_positions: Array
) -> BaseAndTargetColumns:
    """Errors (m, k, 3) and their columns (m, k, 3, 6 + 3 k): shift, turn of the base; targets."""
    inside = np.einsum("mij,kj->mki", poses[:, :3, :3], target_positions) + poses[:, None, :3, 3]
    error = y - inside @ base_rotation.T - base_origin
    m, k = inside.shape[:2]
    columns = np.zeros((m, k, 3, 6 + 3 * k))
    columns[..., :3] = base_rotation
    columns[..., 3:6] = -base_rotation @ skew_matrix(inside)
    for i in range(k):
        columns[:, i, :, 6 + 3 * i : 9 + 3 * i] = base_rotation @ poses[:, :3, :3]
    return BaseAndTargetColumns(error, columns)
