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

from experiments.simulator_gap import load_robot_or_seven_axes
from minimax_cal.core.arrays import Array
from minimax_cal.dynamics.logs.log_table import TORQUE_UNIT, Run
from minimax_cal.robots.gravity_torques import assumed_link_masses_and_centres
from minimax_cal.robots.mjcf_import import format_exact_numbers, import_mujoco
from minimax_cal.robots.robot import Robot
from minimax_cal.simulators.mjcf_tree import MjcfTree
from minimax_cal.simulators.motion.model_parameters import new_model

DRIVEN_ARMS = ("ur10", "ur5e", "irb2600", "scara_600")
REAL_ARM_TIME_STEP = 0.001  # of the real arm [s]
DRIVEN_LOG_RATE_HZ, CONTROLLER_CYCLE = 250.0, 0.002  # of the log [Hz], of the controller [s]
CONTROLLER_BANDWIDTH = 2.0 * np.pi * 4.0  # of the controller [1/s]
JOINT_MOTOR_MASS_KG = 1.5  # mass of each joint's motor [kg]
JOINT_LOG_NOISE, TORQUE_LOG_NOISE_FRACTION = (
    2e-6,
    2e-3,
)  # of the log [rad, m]; of the largest torque
TRAJECTORY_HARMONICS, LOWEST_FREQUENCY_HZ = 5, 0.1  # of a trajectory, and its lowest frequency [Hz]
TRAJECTORY_HALF_RANGE_BY_PRISMATIC = {
    False: 1.5,
    True: 0.1,
}  # of a trajectory either side of 0, of a hinge and a slide [rad, m]
AMPLITUDE_SUM_OVER_RANGE = 1.4  # of the reach, amplitudes together: waves seldom all add up
FRICTION_SIGN_SPEED = 0.01  # speed over which friction of the load changes its sign [rad/s, m/s]


@dataclass(frozen=True, eq=False)
class WithheldEffects:
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
    withheld: WithheldEffects
    seed: int
    step: float = REAL_ARM_TIME_STEP

    @cached_property
    def compiled_file_model(self) -> Any:
        """The model as its file has it, compiled."""
        return import_mujoco().MjModel.from_xml_string(self.xml.decode())

    def compile_real_arm(self) -> Any:
        """The real arm, compiled, without friction of the load."""
        mj, lacks = import_mujoco(), self.withheld
        spec = mj.MjSpec.from_string(self.xml.decode())
        spec.option.timestep = self.step
        model = spec.compile()
        model.dof_frictionloss[:] = lacks.friction
        model.dof_damping[:] = lacks.damping
        model.dof_armature[:] += lacks.armature
        if lacks.payload:
            add_payload_to_model(model, lacks.payload)
        mj.mj_setConst(model, mj.MjData(model))
        return model


def add_payload_to_model(model: Any, payload_mass: float) -> None:
    """Put a ball at the flange of the last body."""
    body, at = model.nbody - 1, np.array([0.02, 0.0, 0.06])
    old, centre = float(model.body_mass[body]), np.array(model.body_ipos[body])
    turn = Rotation.from_quat(model.body_iquat[body], scalar_first=True).as_matrix()
    about = turn @ np.diag(model.body_inertia[body]) @ turn.T
    new = (old * centre + payload_mass * at) / (old + payload_mass)
    whole = about + np.eye(3) * 0.4 * payload_mass * 0.03**2
    for m, c in ((old, centre), (payload_mass, at)):
        arm = c - new
        whole += m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    size, axes = np.linalg.eigh(whole)
    axes = axes * np.linalg.det(axes)
    model.body_mass[body], model.body_ipos[body] = old + payload_mass, new
    model.body_inertia[body] = size
    model.body_iquat[body] = Rotation.from_matrix(axes).as_quat(scalar_first=True)


def load_robot_with_random_masses(name: str, rng: np.random.Generator) -> Robot:
    """A built-in arm with masses of its own."""
    robot = load_robot_or_seven_axes(name)
    mass, com = assumed_link_masses_and_centres(robot.mdh)
    mass = mass * rng.uniform(0.5, 0.9) + JOINT_MOTOR_MASS_KG
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


def build_motor_model_xml(robot: Robot) -> bytes:
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


def replace_motors_by_servos(xml: bytes, stiffness: Array, damping: Array) -> bytes:
    """A file of motors with position servos in their place."""
    root = ET.fromstring(xml)
    motors = [motor for part in root.iter("actuator") for motor in part]
    for motor, kp, kv in zip(motors, stiffness, damping, strict=True):
        motor.tag = "position"
        motor.attrib |= {"kp": format_exact_numbers([kp]), "kv": format_exact_numbers([kv])}
    return bytes(ET.tostring(root))


def draw_driven_arm(name: str, seed: int, withheld_effects: tuple[str, ...]) -> DrivenArm:
    """An arm that has some of the effects of `WithheldEffects`, of random size."""
    rng = np.random.default_rng([seed, *name.encode()])
    robot = load_robot_with_random_masses(name, rng)
    xml = build_motor_model_xml(robot)
    mj = import_mujoco()
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
    has = {kind: float(kind in withheld_effects) for kind in ("friction", "load", "armature")}
    share = np.where(
        (load > 0.2 * load.max()) & (np.arange(n) > 0), rng.uniform(0.04, 0.09, n), 0.0
    )
    lacks = WithheldEffects(
        friction=has["friction"] * size * rng.uniform(0.5, 1.5, n),
        damping=has["friction"] * size * rng.uniform(0.3, 1.2, n),
        armature=has["armature"] * inertia * rng.uniform(0.1, 0.4, n),
        share=has["load"] * share,
        payload=float(rng.uniform(0.5, 3.0)) if "payload" in withheld_effects else 0.0,
        delay=float(rng.uniform(0.003, 0.008)) if "delay" in withheld_effects else 0.0,
    )
    return DrivenArm(robot, xml, lacks, seed)


CommandedMotion = Callable[[Array], Array]


def draw_commanded_motion(arm: DrivenArm, run_number: int, speed_factor: float) -> CommandedMotion:
    """(3, m, n) commanded joint values and two derivatives at times (m,): a run's Fourier series.

    speed_factor: of the run, over the usual.
    """
    rng = np.random.default_rng([arm.seed, run_number])
    n, slides = arm.robot.joints, arm.robot.prismatic
    rate = 2.0 * np.pi * LOWEST_FREQUENCY_HZ * speed_factor * np.arange(1, TRAJECTORY_HARMONICS + 1)
    reach = np.where(
        slides, TRAJECTORY_HALF_RANGE_BY_PRISMATIC[True], TRAJECTORY_HALF_RANGE_BY_PRISMATIC[False]
    )
    low, high = np.maximum(arm.robot.lower, -reach), np.minimum(arm.robot.upper, reach)
    low, high = np.minimum(low, high - 0.5 * reach), np.maximum(high, low + 0.5 * reach)
    waves = (
        rng.normal(size=(2, TRAJECTORY_HARMONICS, n))
        / np.arange(1, TRAJECTORY_HARMONICS + 1)[:, None]
    )
    half = 0.5 * (high - low)
    waves *= half / np.abs(waves).sum(axis=(0, 1)) * AMPLITUDE_SUM_OVER_RANGE
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
class DrivenRun:
    """A run: (m,) times, (m, n) joint values and torques of the controller."""

    time: Array
    q: Array
    torque: Array


def simulate_controlled_run(
    arm: DrivenArm,
    model: Any,
    motion: CommandedMotion,
    seconds: float,
    withheld_effects: WithheldEffects | None = None,
) -> DrivenRun:
    """Where the controller brings a model.  withheld_effects: what a real arm has besides its
    numbers.
    """
    mj, known = import_mujoco(), arm.compiled_file_model
    told, data = mj.MjData(known), mj.MjData(model)
    n, step = arm.robot.joints, float(model.opt.timestep)
    wanted = motion(step * np.arange(round(seconds / step)))
    data.qpos[:n], data.qvel[:n] = wanted[0, 0], wanted[1, 0]
    every, cycle = round(1.0 / DRIVEN_LOG_RATE_HZ / step), round(CONTROLLER_CYCLE / step)
    late = 0 if withheld_effects is None else round(withheld_effects.delay / step)
    torque, load, rows = np.zeros(n), np.zeros(n), []
    waiting: list[Array] = []
    for k in range(wanted.shape[1]):
        if k % cycle == 0:
            q, qd, qdd = wanted[:, k]
            off, slow = q - data.qpos[:n], qd - data.qvel[:n]
            told.qpos[:n], told.qvel[:n] = data.qpos[:n], data.qvel[:n]
            told.qacc[:n] = qdd + CONTROLLER_BANDWIDTH**2 * off + 2.0 * CONTROLLER_BANDWIDTH * slow
            mj.mj_inverse(known, told)
            torque = told.qfrc_inverse[:n].copy()
        if k % every == 0:
            rows.append(np.concatenate([[k * step], data.qpos[:n], torque]))
        waiting.append(torque)
        data.ctrl[:n] = waiting[max(0, k - late)]
        if withheld_effects is not None and withheld_effects.share.any():
            mj.mj_rne(model, data, 1, load)
            data.qfrc_applied[:n] = (
                -withheld_effects.share
                * np.abs(load)
                * np.tanh(data.qvel[:n] / FRICTION_SIGN_SPEED)
            )
        mj.mj_step(model, data)
    table = np.array(rows)
    return DrivenRun(table[:, 0], table[:, 1 : n + 1], table[:, n + 1 :])


def simulate_logs(arm: DrivenArm, run_count: int, seconds: float) -> list[Run]:
    """Logs of the real arm: the first run is slow."""
    rng, model, out = np.random.default_rng([arm.seed, 99]), arm.compile_real_arm(), []
    for number in range(run_count):
        at = draw_commanded_motion(arm, number, 0.3 if number == 0 else 0.8 + 0.2 * number)
        course = simulate_controlled_run(arm, model, at, seconds, arm.withheld)
        q = course.q + JOINT_LOG_NOISE * rng.normal(size=course.q.shape)
        size = TORQUE_LOG_NOISE_FRACTION * np.abs(course.torque).max(axis=0)
        torque = course.torque + size * rng.normal(size=course.q.shape)
        name = f"run{number}"
        out.append(Run(name, f"{name}.csv", course.time, q, None, None, torque, TORQUE_UNIT))
    return out


def write_model_file(arm: DrivenArm, folder: Path) -> Path:
    """The file of the model."""
    name = re.sub(r"[^A-Za-z0-9]+", "_", arm.robot.name)
    path = folder / f"{name}_{arm.seed}.xml"
    path.write_bytes(arm.xml)
    return path
