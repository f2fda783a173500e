"""Simulated "real" arms in motion: MuJoCo with effects that the model's file does not have.

A controller that knows the file alone (computed torque) drives both the real arm and every model of
it along the same commands.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.simulator_gap import robot_called
from minimax_cal.dynamics.logs.table import TORQUE, Run
from minimax_cal.ground.arrays import Array
from minimax_cal.robots.gravity import tubes
from minimax_cal.robots.mjcf import mujoco, numbers
from minimax_cal.robots.robot import Robot
from minimax_cal.simulators.mjcf_tree import MjcfTree
from minimax_cal.simulators.motion.numbers import new_model

ARMS = ("ur10", "ur5e", "irb2600", "scara_600")
STEP = 0.001  # of the real arm [s]
LOG_HZ, CYCLE = 250.0, 0.002  # of the log [Hz], of the controller [s]
FREQUENCY = 2.0 * np.pi * 4.0  # of the controller [1/s]
HUB = 1.5  # mass of each joint's motor [kg]
NOISE_Q, NOISE_TORQUE = 2e-6, 2e-3  # of the log [rad, m]; of the largest torque
WAVES, SLOWEST_WAVE = 5, 0.1  # of a trajectory, and its lowest frequency [Hz]
REACH = {False: 1.5, True: 0.1}  # of a trajectory either side of 0, of a hinge and a slide [rad, m]
WAVE_SHARE = 1.4  # of the reach, amplitudes together: waves seldom all add up
SOFT = 0.01  # speed over which friction of the load changes its sign [rad/s, m/s]


@dataclass(frozen=True, eq=False)
class Withheld:
    """What the file does not know.  friction, damping, armature: (n,).  share: (n,) of the load.

    payload: kg at the flange.  delay: of the commands [s].
    """

    friction: Array
    damping: Array
    armature: Array
    share: Array
    payload: float = 0.0
    delay: float = 0.0


@dataclass(frozen=True, eq=False)
class DrivenArm:
    """An arm's file, and what it lacks."""

    robot: Robot
    xml: bytes
    withheld: Withheld
    seed: int
    step: float = STEP

    @cached_property
    def known(self) -> Any:
        """The model as its file has it, compiled."""
        return mujoco().MjModel.from_xml_string(self.xml.decode())

    def real(self) -> Any:
        """The real arm, compiled, without friction of the load."""
        mj, lacks = mujoco(), self.withheld
        spec = mj.MjSpec.from_string(self.xml.decode())
        spec.option.timestep = self.step
        model = spec.compile()
        model.dof_frictionloss[:] = lacks.friction
        model.dof_damping[:] = lacks.damping
        model.dof_armature[:] += lacks.armature
        if lacks.payload:
            carry(model, lacks.payload)
        mj.mj_setConst(model, mj.MjData(model))
        return model


def carry(model: Any, mass: float) -> None:
    """Put a ball at the flange of the last body."""
    body, at = model.nbody - 1, np.array([0.02, 0.0, 0.06])
    old, centre = float(model.body_mass[body]), np.array(model.body_ipos[body])
    turn = Rotation.from_quat(model.body_iquat[body], scalar_first=True).as_matrix()
    about = turn @ np.diag(model.body_inertia[body]) @ turn.T
    new = (old * centre + mass * at) / (old + mass)
    whole = about + np.eye(3) * 0.4 * mass * 0.03**2
    for m, c in ((old, centre), (mass, at)):
        arm = c - new
        whole += m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    size, axes = np.linalg.eigh(whole)
    axes = axes * np.linalg.det(axes)
    model.body_mass[body], model.body_ipos[body] = old + mass, new
    model.body_inertia[body] = size
    model.body_iquat[body] = Rotation.from_matrix(axes).as_quat(scalar_first=True)


def heavy(name: str, rng: np.random.Generator) -> Robot:
    """A built-in arm with masses of its own."""
    robot = robot_called(name)
    mass, com = tubes(robot.mdh)
    mass = mass * rng.uniform(0.5, 0.9) + HUB
    length = np.maximum(np.hypot(robot.mdh[:, 0], robot.mdh[:, 1]), 0.1)
    com = com + rng.normal(0.0, 0.1, com.shape) * length[:, None]
    inertia = np.zeros((robot.joints, 6))
    for i in range(robot.joints):
        sides = np.array([length[i], 0.12, 0.12]) ** 2
        turn = Rotation.random(rng=rng).as_matrix()
        about = mass[i] / 12.0 * (sides.sum() - sides)
        whole = turn @ np.diag(about) @ turn.T
        inertia[i] = whole[np.triu_indices(3)]
    return replace(robot, mass=mass, com=com, inertia=inertia)


def with_motors(robot: Robot) -> bytes:
    """A file with a motor a joint, and gravity that they have to carry."""
    root = new_model(robot).root
    for body in root.iter("body"):
        body.attrib.pop("gravcomp", None)
    for joint in root.iter("joint"):
        for key in ("actuatorgravcomp", "actuatorfrclimited", "actuatorfrcrange", "damping"):
            joint.attrib.pop(key, None)
    for actuators in root.iter("actuator"):
        for servo in list(actuators):
            name = servo.get("joint", "")
            servo.attrib.clear()
            servo.tag = "motor"
            servo.attrib.update({"name": name, "joint": name})
    return MjcfTree(root).to_bytes()


def served(xml: bytes, stiffness: Array, damper: Array) -> bytes:
    """A file of motors with position servos in their place."""
    root = ET.fromstring(xml)
    motors = [motor for part in root.iter("actuator") for motor in part]
    for motor, kp, kv in zip(motors, stiffness, damper, strict=True):
        motor.tag = "position"
        motor.attrib |= {"kp": numbers([kp]), "kv": numbers([kv])}
    return bytes(ET.tostring(root))


def drawn_arm(name: str, seed: int, effects: tuple[str, ...]) -> DrivenArm:
    """An arm that has some of the effects of `Withheld`, of random size."""
    rng = np.random.default_rng([seed, *name.encode()])
    robot = heavy(name, rng)
    xml = with_motors(robot)
    mj = mujoco()
    model = mj.MjModel.from_xml_string(xml.decode())
    data, n = mj.MjData(model), robot.joints
    inertia, load = np.zeros(n), np.zeros(n)
    whole = np.zeros((n, n))
    for _ in range(40):
        data.qpos[:] = rng.uniform(-1.5, 1.5, n) * np.where(robot.prismatic, 0.1, 1.0)
        mj.mj_forward(model, data)
        mj.mj_fullM(model, data, whole) if model.nv == n else None
        inertia = np.maximum(inertia, np.diag(whole))
        load = np.maximum(load, np.abs(data.qfrc_bias))
    size = 0.03 * load + 0.6 * inertia
    has = {kind: float(kind in effects) for kind in ("friction", "load", "armature")}
    share = np.where(
        (load > 0.2 * load.max()) & (np.arange(n) > 0), rng.uniform(0.04, 0.09, n), 0.0
    )
    lacks = Withheld(
        friction=has["friction"] * size * rng.uniform(0.5, 1.5, n),
        damping=has["friction"] * size * rng.uniform(0.3, 1.2, n),
        armature=has["armature"] * inertia * rng.uniform(0.1, 0.4, n),
        share=has["load"] * share,
        payload=float(rng.uniform(0.5, 3.0)) if "payload" in effects else 0.0,
        delay=float(rng.uniform(0.003, 0.008)) if "delay" in effects else 0.0,
    )
    return DrivenArm(robot, xml, lacks, seed)


Motion = Callable[[Array], Array]


def commands(arm: DrivenArm, number: int, speed: float) -> Motion:
    """(3, m, n) commanded joint values and two derivatives at times (m,): a run's Fourier series.

    speed: of the run, over the usual.
    """
    rng = np.random.default_rng([arm.seed, number])
    n, slides = arm.robot.joints, arm.robot.prismatic
    rate = 2.0 * np.pi * SLOWEST_WAVE * speed * np.arange(1, WAVES + 1)
    reach = np.where(slides, REACH[True], REACH[False])
    low, high = np.maximum(arm.robot.lower, -reach), np.minimum(arm.robot.upper, reach)
    low, high = np.minimum(low, high - 0.5 * reach), np.maximum(high, low + 0.5 * reach)
    waves = rng.normal(size=(2, WAVES, n)) / np.arange(1, WAVES + 1)[:, None]
    half = 0.5 * (high - low)
    waves *= half / np.abs(waves).sum(axis=(0, 1)) * WAVE_SHARE
    middle = 0.5 * (high + low)

    def at(time: Array) -> Array:
        turn = np.outer(time, rate)
        s, c = np.sin(turn), np.cos(turn)
        q = middle + s @ waves[0] + c @ waves[1]
        qd = (rate * c) @ waves[0] - (rate * s) @ waves[1]
        qdd = -(rate**2 * s) @ waves[0] - (rate**2 * c) @ waves[1]
        return np.stack([q, qd, qdd])

    return at


@dataclass(frozen=True, eq=False)
class Course:
    """A run: (m,) times, (m, n) joint values and torques of the controller."""

    time: Array
    q: Array
    torque: Array


def drive_along(
    arm: DrivenArm, model: Any, at: Motion, seconds: float, withheld: Withheld | None = None
) -> Course:
    """Where the controller brings a model.  withheld: what a real arm has besides its numbers."""
    mj, known = mujoco(), arm.known
    told, data = mj.MjData(known), mj.MjData(model)
    n, step = arm.robot.joints, float(model.opt.timestep)
    wanted = at(step * np.arange(round(seconds / step)))
    data.qpos[:n], data.qvel[:n] = wanted[0, 0], wanted[1, 0]
    every, cycle = round(1.0 / LOG_HZ / step), round(CYCLE / step)
    late = 0 if withheld is None else round(withheld.delay / step)
    torque, load, rows = np.zeros(n), np.zeros(n), []
    waiting: list[Array] = []
    for k in range(wanted.shape[1]):
        if k % cycle == 0:
            q, qd, qdd = wanted[:, k]
            off, slow = q - data.qpos[:n], qd - data.qvel[:n]
            told.qpos[:n], told.qvel[:n] = data.qpos[:n], data.qvel[:n]
            told.qacc[:n] = qdd + FREQUENCY**2 * off + 2.0 * FREQUENCY * slow
            mj.mj_inverse(known, told)
            torque = told.qfrc_inverse[:n].copy()
        if k % every == 0:
            rows.append(np.concatenate([[k * step], data.qpos[:n], torque]))
        waiting.append(torque)
        data.ctrl[:n] = waiting[max(0, k - late)]
        if withheld is not None and withheld.share.any():
            mj.mj_rne(model, data, 1, load)
            data.qfrc_applied[:n] = -withheld.share * np.abs(load) * np.tanh(data.qvel[:n] / SOFT)
        mj.mj_step(model, data)
    table = np.array(rows)
    return Course(table[:, 0], table[:, 1 : n + 1], table[:, n + 1 :])


def logged(arm: DrivenArm, numbers: int, seconds: float) -> list[Run]:
    """Logs of the real arm: the first run is slow."""
    rng, model, out = np.random.default_rng([arm.seed, 99]), arm.real(), []
    for number in range(numbers):
        at = commands(arm, number, 0.3 if number == 0 else 0.8 + 0.2 * number)
        course = drive_along(arm, model, at, seconds, arm.withheld)
        q = course.q + NOISE_Q * rng.normal(size=course.q.shape)
        size = NOISE_TORQUE * np.abs(course.torque).max(axis=0)
        torque = course.torque + size * rng.normal(size=course.q.shape)
        name = f"run{number}"
        out.append(Run(name, f"{name}.csv", course.time, q, None, None, torque, TORQUE))
    return out


def save_model(arm: DrivenArm, folder: Path) -> Path:
    """The file of the model."""
    name = re.sub(r"[^A-Za-z0-9]+", "_", arm.robot.name)
    path = folder / f"{name}_{arm.seed}.xml"
    path.write_bytes(arm.xml)
    return path
