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
from threading import Lock
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import RobotError
from minimax_cal.robots.gravity import G, centres, inertia_of, torques
from minimax_cal.robots.kinematics import chain, cross
from minimax_cal.robots.mjcf import body_pose, mujoco, way_to
from minimax_cal.robots.sampling import random_poses
from minimax_cal.simulators.arm import Arm
from minimax_cal.simulators.chain import Chain, carrier, fill_history, holders

MOVE, REST = 2.0, 1.5  # a move lasts at least, and a rest after it [s]
FASTEST, FASTEST_SLIDE = 1.0, 0.25  # no joint is commanded faster [rad/s, m/s]
STILL, STILL_SLIDE = 2e-3, 1e-3  # slower is at rest [rad/s, m/s]
PEAK = 1.875  # largest speed of a minimum-jerk move of length 1 in time 1
RUNS = 4  # of neighbouring poses, whatever the machine: its results are those of any other
LOOKS = 10  # timesteps of a rest between two looks at its forces


@dataclass(frozen=True, eq=False)
class Driven:
    """Where an arm was after its moves, row by row.

    poses: (m, 4, 4) of the body that carries the targets, in the world [m].
    q: (m, n) where the joints were [rad, m].  speed: (m,) largest of all joints, springs with them,
    as a share of what counts as rest.  limited: (n,) share of the timesteps at which a joint's
    actuator was at its force limit.
    driven: whether servos moved it; else its joints were set.
    """

    poses: Array
    q: Array
    speed: Array
    limited: Array
    driven: bool

    @property
    def moving(self) -> Array:
        """(m,) True where it had not come to rest."""
        return np.asarray(self.speed > 1.0)


def drive(
    chain: Chain,
    commands: Array,
    source: str,
    play: Array | None = None,
    progress: Callable[[int], object] = lambda done: None,
) -> Driven:
    """Drive an arm from command to command and let it rest at each.

    commands: (m, n) [rad, m].  play: (m, n) where each joint rests in its play [rad].
    progress: called with the number of poses done.  The poses are dealt out to threads in runs of
    neighbours; each run begins at rest at the pose before its first one.
    Raises RobotError where MuJoCo finds that the model is unstable.
    """
    servos = np.array([chain.servo(joint) for joint in chain.joints])
    if (servos < 0).any():
        return set_joints(chain, commands, play)
    count = len(commands)
    runs = np.array_split(np.arange(count), min(RUNS, count))
    lock, done = Lock(), [0]

    def heard() -> None:
        with lock:
            done[0] += 1
            progress(done[0])

    def one(rows: Array) -> list[Visit]:
        sides = np.zeros(commands.shape) if play is None else play
        return visits(chain, servos, commands, sides, rows, source, heard)

    with ThreadPoolExecutor(min(len(runs), os.cpu_count() or 1)) as pool:
        found = [visit for part in pool.map(one, runs) for visit in part]
    return Driven(
        poses=np.array([visit.pose for visit in found]),
        q=np.array([visit.q for visit in found]),
        speed=np.array([visit.speed for visit in found]),
        limited=np.mean([visit.limited for visit in found], axis=0),
        driven=True,
    )


@dataclass(frozen=True, eq=False)
class Visit:
    """One row of `Driven`."""

    pose: Array
    q: Array
    speed: float
    limited: Array


def visits(
    chain: Chain,
    servos: Array,
    commands: Array,
    play: Array,
    rows: Array,
    source: str,
    heard: Callable[[], object],
) -> list[Visit]:
    """A run of moves, one after the other, with a model of its own."""
    mj, model = mujoco(), copy(chain.model)
    chain_here = replace(chain, model=model)
    data, sides = mj.MjData(model), plays(chain_here)
    at = chain.places
    moved = way_to(model, carrier(chain_here))
    dofs = np.array([int(model.jnt_dofadr[joint]) for joint in moved])
    rest = np.where(model.jnt_type[list(moved)] == 2, STILL_SLIDE, STILL)
    limits = Limits.of(chain_here, servos)
    step = float(model.opt.timestep)
    start = commands[rows[0] - 1]
    data.qpos[at], data.ctrl[servos] = start, start
    fill_history(model, data)
    settle(mj, model, data, limits, round(REST / step))
    out = []
    for row in rows:
        for joint, place in sides.items():
            model.qpos_spring[place] = play[row, joint]
        path = moves(start, commands[row], chain.robot.prismatic, step)
        looks = (
            move(mj, model, data, servos, path, limits),
            settle(mj, model, data, limits, round(REST / step)),
        )
        check_stable(mj, data, source)
        (moved_at, moved_for), (rested_at, rested_for) = looks
        share = (moved_at + rested_at) / (moved_for + rested_for)
        out.append(Visit(
            body_pose(data, carrier(chain_here)), np.array(data.qpos[at]),
            float((np.abs(data.qvel[dofs]) / rest).max()), share,
        ))  # fmt: skip
        start = commands[row]
        heard()
    return out


def moves(start: Array, end: Array, slides: Array, step: float) -> Array:
    """(steps, n) commands of a minimum-jerk move [Flash and Hogan 1985, eq. 3]."""
    way = end - start
    needed = PEAK * np.abs(way) / np.where(slides, FASTEST_SLIDE, FASTEST)
    count = max(1, round(max(MOVE, float(needed.max(initial=0.0))) / step))
    t = np.arange(1, count + 1)[:, None] / count
    return np.asarray(start + way * t**3 * (10.0 - 15.0 * t + 6.0 * t**2))


@dataclass(frozen=True, eq=False)
class Limits:
    """Force limits of the arm's actuators, and of its joints.

    servos, dofs: (n,) ids.  force, torque: (n, 2) limits, infinite where there are none.
    """

    servos: Array
    dofs: Array
    force: Array
    torque: Array

    @staticmethod
    def of(chain: Chain, servos: Array) -> Limits:
        """Those of a model, a little inside, so that rounding does not hide what is at one."""
        m, joints = chain.model, list(chain.joints)
        open_ends = np.array([-np.inf, np.inf])
        force = np.where(m.actuator_forcelimited[servos, None], m.actuator_forcerange[servos],
                         open_ends)  # fmt: skip
        torque = np.where(m.jnt_actfrclimited[joints, None], m.jnt_actfrcrange[joints], open_ends)
        inside = 1.0 - 1e-9
        return Limits(servos, chain.dofs, force * inside, torque * inside)

    def reached(self, force: Array, torque: Array) -> Array:
        """(..., n) True where an actuator or its joint is at a limit."""
        return np.asarray(
            (force <= self.force[:, 0]) | (force >= self.force[:, 1])
            | (torque <= self.torque[:, 0]) | (torque >= self.torque[:, 1])
        )  # fmt: skip


def move(
    mj: Any, model: Any, data: Any, servos: Array, path: Array, limits: Limits
) -> tuple[Array, int]:
    """Follow commands, one a timestep; how many of them at each limit, and how many there are."""
    force, torque = np.empty(path.shape), np.empty(path.shape)
    for k, command in enumerate(path):
        data.ctrl[servos] = command
        mj.mj_step(model, data)
        force[k], torque[k] = data.actuator_force[servos], data.qfrc_actuator[limits.dofs]
    return limits.reached(force, torque).sum(axis=0), len(path)


def settle(mj: Any, model: Any, data: Any, limits: Limits, count: int) -> tuple[Array, int]:
    """Stay at a command; the same, from a look every few timesteps."""
    at_limit, done = np.zeros(len(limits.servos), dtype=int), 0
    while done < count:
        steps = min(LOOKS, count - done)
        mj.mj_step(model, data, steps)
        found = limits.reached(data.actuator_force[limits.servos], data.qfrc_actuator[limits.dofs])
        at_limit += steps * found
        done += steps
    return at_limit, count


def check_stable(mj: Any, data: Any, source: str) -> None:
    """Raise RobotError where MuJoCo found numbers that no arm has, and began anew."""
    for kind in (mj.mjtWarning.mjWARN_BADQPOS, mj.mjtWarning.mjWARN_BADQVEL,
                 mj.mjtWarning.mjWARN_BADQACC):  # fmt: skip
        if data.warning[int(kind)].number:
            raise RobotError(
                f"{source}: the simulation is unstable (MuJoCo: {kind.name}); give its servos "
                'dampers (kv), a shorter timestep, or <option integrator="implicitfast">'
            )


def set_joints(chain: Chain, commands: Array, play: Array | None) -> Driven:
    """The same for a model without servos: its joints are set and nothing moves."""
    model, mj, out = chain.model, mujoco(), []
    data = mj.MjData(model)
    at = chain.places
    for row in range(len(commands)):
        data.qpos[at] = commands[row]
        for joint, place in plays(chain).items():
            data.qpos[place] = 0.0 if play is None else play[row, joint]
        mj.mj_kinematics(model, data)
        out.append(body_pose(data, carrier(chain)))
    still, limited = np.zeros(len(commands)), np.zeros(commands.shape[1])
    return Driven(np.array(out), commands, still, limited, False)


def touching(chain: Chain, model: Any, q: Array) -> Array:
    """(m,) True where the arm touches something, or itself, at joint values (m, n) [rad, m].

    model: that of the chain, with its contacts.
    """
    mj, carried = mujoco(), holders(model, chain.bodies) >= 0
    data, out = mj.MjData(model), np.zeros(len(q), dtype=bool)
    for row, values in enumerate(q):
        data.qpos[chain.places] = values
        mj.mj_fwdPosition(model, data)
        sides = carried[model.geom_bodyid[data.contact.geom]].any(axis=-1)
        out[row] = bool((sides & (data.contact.dist < 0.0)).any())
    return out


def plays(chain: Chain) -> dict[int, int]:
    """Joint, and where the position in its play is in qpos."""
    model, out = chain.model, {}
    for i in range(len(chain.joints)):
        found = mujoco().mj_name2id(model, mujoco().mjtObj.mjOBJ_JOINT, f"play{i + 1}")
        if found >= 0:
            out[i] = int(model.jnt_qposadr[found])
    return out


# ---- servos --------------------------------------------------------------------------------------


SETTLES = 15.0  # a servo's frequency at the largest inertia: 1.5 s of rest leave 4e-9 [rad/s]
LEAST_RATIO, SLOWEST = 0.7, 7.5  # a given damper stays from this damping ratio to this pole [1/s]
SMALLEST = 0.1  # of the largest gain, for joints that carry little: as published models have them
WIDEST = 10.0  # gains are at most so much larger than the largest that a smooth move needs
SAG = 2e-6  # gravity moves the tool of a joint that is stiff by no more [m]
STEPS = 2.0  # a damper's own time is at least so many timesteps: then no stiffness shakes
NOTHING = 1e-12
LEVER = 0.1  # from the flange to what it carries [m]
SAMPLES = 200  # poses at which loads are looked for


@dataclass(frozen=True, eq=False)
class Drives:
    """The servos of a model as they are, all at the joints; of a new one there are none.

    gain, damper: (n,) [N m/rad, N m s/rad]; own: (n,) the part of damper that the joint itself has.
    limits: (n, 2) of the torque of each joint's actuators [N m].
    inertia: (n,) largest about each joint [kg m^2].  timestep: [s].
    gravity_free: whether actuators carry no gravity because the model's bodies float already.
    braked: (n,) True where the joint is to hold its servo's damper, which is implicit there.
    """

    gain: Array
    damper: Array
    own: Array
    limits: Array
    inertia: Array
    braked: Array
    timestep: float = 0.002
    gravity_free: bool = False

    @staticmethod
    def none(joints: int) -> Drives:
        """Of a new file."""
        nothing = np.zeros(joints)
        ends = np.array([[-np.inf, np.inf]] * joints)
        return Drives(nothing, nothing, nothing, ends, nothing, np.ones(joints, dtype=bool))


@dataclass(frozen=True, eq=False)
class Servos:
    """share: of gravity that bends the joints, s.  gain, damper: (n,) [N m/rad, N m s/rad].

    sprung: (n,) True where a spring of its own holds the joint's compliance.
    kept: (n,) True where gain and damper are those that the model has.
    """

    share: float
    gain: Array
    damper: Array
    sprung: Array
    kept: Array


def choose_servos(arm: Arm, drives: Drives, *, springs: bool = False) -> Servos:
    """Gains that settle within a rest of 1.5 s, and the share of gravity that makes them exact.

    springs: whether springs of their own hold what joints give way, and no gain.
    """
    inertia, torque = loads(arm)
    inertia = np.maximum(inertia, drives.inertia)
    needed = SETTLES**2 * inertia
    ordinary = np.maximum(drives.gain, np.maximum(needed, SMALLEST * needed.max()))
    _, reach, _ = carried(arm)
    lever = np.where(arm.robot.prismatic, 1.0, reach)
    soft = arm.turn > NOTHING
    compliance = np.where(soft, arm.turn, np.inf)
    share = min(1.0, float((arm.turn * ordinary).max()))
    stiff = np.maximum(ordinary, share * torque * lever / SAG)
    gain = np.where(soft, share / compliance, stiff)
    sprung = np.zeros(len(gain), dtype=bool)
    if springs or gain.max() > WIDEST * ordinary.max():
        share, gain, sprung = 0.0, ordinary, soft
    critical = 2.0 * np.sqrt(gain * inertia)
    kept = np.isclose(gain, drives.gain, rtol=1e-9)
    kept &= (drives.damper >= LEAST_RATIO * critical) & (drives.damper <= gain / SLOWEST)
    new = np.maximum(critical, STEPS * drives.timestep * gain)
    return Servos(share, gain, np.where(kept, drives.damper, new), sprung, kept)


def loads(arm: Arm, q: Array | None = None) -> tuple[Array, Array]:
    """(n,) largest inertia [kg m^2] and gravity torque [N m] of each joint, of slides kg and N.

    q: (m, n) poses, all over the workspace unless given [rad, m].
    """
    robot = arm.robot
    if q is None:
        q = random_poses(robot, SAMPLES, np.random.default_rng(0))
    links = chain(robot.mdh, robot.turned(q), robot.prismatic)
    at = centres(links, arm.com)
    beyond = np.cumsum(arm.mass[::-1])[::-1]
    own = [inertia_of(robot.mdh, i, m) for i, m in enumerate(arm.mass)]
    turning = np.cumsum(np.array(own)[::-1])[::-1]
    inertia = np.zeros((robot.joints, len(q)))
    for i in range(robot.joints):
        lever = cross(links.z[i][None], at[i:] - links.before[i][None])
        inertia[i] = np.einsum("k,kam,kam->m", arm.mass[i:], lever, lever) + turning[i]
    torque = torques(links, arm.mass, arm.com, robot.up)
    force = G * beyond[:, None] * np.einsum("nam,a->nm", links.z, robot.up)
    slides = robot.prismatic[:, None]
    return (
        np.asarray(np.where(slides, beyond[:, None], inertia).max(axis=1)),
        np.asarray(np.abs(np.where(slides, force, torque)).max(axis=1)),
    )


def carried(arm: Arm) -> tuple[Array, Array, Array]:
    """For each joint: weight beyond it [N], largest lever of that [m], largest inertia [kg m^2]."""
    robot = arm.robot
    length = np.abs(robot.mdh[:, :2]).sum(axis=1) + np.linalg.norm(arm.com, axis=1)
    slide = np.where(robot.prismatic, np.clip(np.abs(robot.upper), 0.0, 2.0), 0.0)
    reach = np.cumsum((length + slide)[::-1])[::-1] + LEVER
    mass = np.cumsum(arm.mass[::-1])[::-1]
    return mass * G, reach, mass * reach**2
