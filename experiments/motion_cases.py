"""Arms in motion with hidden causes: torques by MuJoCo, or by our own integration.

Half of the cases are MuJoCo's inverse dynamics along an excitation, with its own soft friction and
rotor inertias; what MuJoCo has no element for is added as torque.  The other half is Newton and
Euler with LuGre friction, whose bristles are integrated along the motion.  Neither uses the columns
by which torques are diagnosed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from xml.etree import ElementTree as ET

import numpy as np

from experiments.sweep import import_optional_module
from minimax_cal.core.arrays import Array
from minimax_cal.dynamics.logs.log_table import Run
from minimax_cal.dynamics.regressor import (
    JointMotion,
    build_nominal_inertial_parameters,
    compute_link_inertial_parameters,
    inverse_dynamics,
)
from minimax_cal.robots.robot import Robot, robot_from_dict

MOTION_CASE_TIME_STEP = 0.002  # of the integration [s]
STEPS_PER_LOG_ROW = 5  # steps between rows of the log
RUN_SECONDS = (10.0, 10.0, 10.0, 14.0)  # lengths of the runs [s]
MAX_SLOW_RUN_SPEED = 0.2  # largest speed of the last run [rad/s]
FIRST_HARMONIC_RANGE_HZ = (0.06, 0.12)  # of the excitation's first harmonic
EXCITATION_HARMONICS = 5
GIVEN_GEAR_RATIO = 50.0  # of the gears, which is given
UNKNOWN_COGGING_WAVES = 23.7  # waves a turn of a cogging whose ratio nobody gives
KNOWN_PAYLOAD = (
    1.5,
    (0.0, 0.0, 0.06),
)  # known payload of the second run, where there is one [kg], [m]
BRISTLE_TRAVEL_RANGE = (2e-5, 1e-4)  # way over which friction of a sound arm builds up [rad]
TORQUE_NOISE_RANGE = (0.02, 0.05)  # of a torque sample, of the joint's Coulomb friction
CORRELATED_NOISE_FRACTION, NOISE_AUTOCORRELATION = (
    0.4,
    0.95,
)  # a part of the noise that remembers: its size, its correlation in a sample
JOINT_VALUE_NOISE = 2e-6  # noise of joint values [rad]
MUJOCO_GENERATOR, INTEGRATION_GENERATOR = "mujoco", "own"


@dataclass(frozen=True)
class MotionCase:
    """What is drawn: generator, causes with the numbers of their joints, and the seed."""

    condition: str
    generator: str
    causes: tuple[tuple[str, int], ...]
    seed: int


@dataclass(frozen=True, eq=False)
class TrueArm:
    """The true arm.

    robot: as drawn.  body: (n, 10).  armature, coulomb, viscous, bristles: (n,) of each joint.
    stribeck: (n, 2) share of Coulomb friction that is gone above a speed [rad/s].
    more: torques of the motion, the rigid body's torque and the time since the first run began.
    compliance: (n,) [rad/(N m)].  gain: (n,) of what is logged.  zero: (n,) [rad].
    late: by which torques are logged [s].  warmth: of a sensor over the time [C].
    """

    robot: Robot
    body: Array
    armature: Array
    coulomb: Array
    viscous: Array
    bristles: Array
    stribeck: Array
    compliance: Array
    gain: Array
    zero: Array
    late: float = 0.0
    more: tuple[Callable[[JointMotion, Array, Array], Array], ...] = field(default=())


@dataclass(frozen=True, eq=False)
class MotionCaseData:
    """Runs of a case, the arm as its file has it, and what a sound arm would show of the same logs.

    signal: (m, n) of each run, what the causes add to the torques of the logged motion.  noise: the
    same, of the log.  extra: mass at the flange that nobody told [kg].
    """

    robot: Robot
    runs: tuple[Run, ...]
    signal: tuple[Array, ...]
    noise: tuple[Array, ...]
    payload: tuple[float, tuple[float, float, float]] | None
    extra: float


# ---- arms ----------------------------------------------------------------------------------------


def draw_arm(rng: np.random.Generator) -> Robot:
    """A vertical axis, two parallel ones, and in half of the arms a wrist, of random bars."""
    half, wrist = np.pi / 2.0, bool(rng.integers(2))
    upper, fore = rng.uniform(0.3, 0.6, 2)
    frames = [(0.0, rng.uniform(0.2, 0.5), half), (upper, 0.0, 0.0),
              (fore, rng.uniform(0.0, 0.15), half if wrist else 0.0)]  # fmt: skip
    frames += [(0.1, 0.15, -half)] if wrist else []
    joints = []
    for number, (a, d, alpha) in enumerate(frames):
        length, mass = max(a, d), rng.uniform(0.7, 1.3) * (10.0, 7.0, 4.0, 2.0)[number]
        across = mass * rng.uniform(0.06, 0.1) ** 2 / 6.0
        about = across + mass * length**2 / 12.0
        along_x = a > d
        joints.append({
            "a": a, "d": d, "theta": 0.0, "alpha": alpha, "mass_kg": mass,
            "com_mm": [*(-1e3 * np.array([a if along_x else 0.0, 0.0 if along_x else d, 0.0])
                         * rng.uniform(0.4, 0.6) + rng.uniform(-30.0, 30.0, 3))],
            "inertia": [across if along_x else about, 0.0, 0.0, about, 0.0, about],
        })  # fmt: skip
    units = {"length": "m", "angle": "rad"}
    return robot_from_dict({"name": f"{len(joints)} joints", "units": units, "joints": joints})


def draw_log_uniform(rng: np.random.Generator, lowest: float, highest: float) -> float:
    """A size between two, every ratio as likely."""
    return float(np.exp(rng.uniform(np.log(lowest), np.log(highest))))


def build_sound_arm(rng: np.random.Generator, robot: Robot) -> TrueArm:
    """An arm with usual friction and nothing more."""
    n = robot.joints
    fall = np.array([4.0, 4.0, 2.0, 1.0])[:n]
    return TrueArm(
        robot,
        build_nominal_inertial_parameters(robot),
        armature=np.zeros(n),
        coulomb=fall * rng.uniform(0.7, 1.5, n),
        viscous=fall * rng.uniform(0.5, 1.5, n),
        bristles=np.array([draw_log_uniform(rng, *BRISTLE_TRAVEL_RANGE) for _ in range(n)]),
        stribeck=np.tile([0.0, 1.0], (n, 1)),
        compliance=np.zeros(n),
        gain=np.ones(n),
        zero=np.zeros(n),
    )


def draw_robot_with_wrong_masses(rng: np.random.Generator, robot: Robot) -> Robot:
    """The arm as a file has it whose masses are guesses."""
    mass = robot.mass * rng.uniform(0.75, 1.3, robot.joints)
    return replace(robot, mass=mass, com=robot.com + rng.uniform(-0.03, 0.03, robot.com.shape))


def draw_excitation(
    rng: np.random.Generator, robot: Robot, seconds: float, peak_speed: float
) -> JointMotion:
    """A finite Fourier series.  peak_speed: largest speed [rad/s], infinite for its own."""
    rate = (
        2.0
        * np.pi
        * rng.uniform(*FIRST_HARMONIC_RANGE_HZ)
        * np.arange(1.0, EXCITATION_HARMONICS + 1.0)[:, None]
    )
    size = 0.7 * rng.normal(size=(2, EXCITATION_HARMONICS, robot.joints)) / rate * rate[0]
    motion = fourier_motion(seconds, np.tile(rate, robot.joints), size)
    if np.isfinite(peak_speed):
        motion = fourier_motion(seconds, rate * peak_speed / np.abs(motion.qd).max(axis=0), size)
    return replace(motion, q=motion.q + np.array([0.0, 0.7, -1.0, 0.0])[: robot.joints])


def fourier_motion(seconds: float, rate: Array, size: Array) -> JointMotion:
    """Sines and cosines.  rate: (h, n) [rad/s].  size: (2, h, n) [rad]."""
    turn = np.arange(0.0, seconds, MOTION_CASE_TIME_STEP)[:, None, None] * rate
    a, b = size
    sin, cos = np.sin(turn), np.cos(turn)
    q, qd = a * sin + b * cos, rate * (a * cos - b * sin)
    return JointMotion(q.sum(axis=1), qd.sum(axis=1), (-(rate**2) * q).sum(axis=1))


# ---- generators ----------------------------------------------------------------------------------


def lugre_friction(plant: TrueArm, qd: Array) -> Array:
    """(m, n) LuGre friction: bristles that bend along the way [Canudas de Wit et al. 1995]."""
    share, fades = plant.stribeck.T
    height = plant.coulomb * (1.0 - share * (1.0 - np.exp(-((qd / fades) ** 2))))
    left = np.exp(-np.abs(qd) * MOTION_CASE_TIME_STEP * plant.coulomb / height / plant.bristles)
    target, bent = np.sign(qd) * height, np.zeros_like(qd)
    now = target[0]
    for i in range(len(qd)):
        now = target[i] + (now - target[i]) * left[i]
        bent[i] = now
    return np.asarray(bent + plant.viscous * qd)


def torques_by_integration(plant: TrueArm, motion: JointMotion) -> tuple[Array, Array]:
    """Torque of the body and all torque (m, n), by Newton and Euler and LuGre friction."""
    rigid = inverse_dynamics(plant.robot, motion, plant.body)
    return rigid, rigid + plant.armature * motion.qdd + lugre_friction(plant, motion.qd)


def format_mjcf(plant: TrueArm) -> str:
    """The arm for MuJoCo: a link's frame is where the next joint turns."""
    root = ET.Element("mujoco")
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", gravity="0 0 -9.80665", timestep=str(MOTION_CASE_TIME_STEP))
    parent, place = ET.SubElement(root, "worldbody"), {"pos": "0 0 0", "quat": "1 0 0 0"}
    for j, (a, d, theta, alpha, _) in enumerate(plant.robot.mdh):
        turned, tilted = theta / 2.0, alpha / 2.0
        c, s, cc, ss = np.cos(turned), np.sin(turned), np.cos(tilted), np.sin(tilted)
        quat = " ".join(map(repr, map(float, (c * cc, c * ss, s * ss, s * cc))))
        at = np.array([a * np.cos(theta), a * np.sin(theta), d])
        body = ET.SubElement(parent, "body", place)
        ET.SubElement(body, "joint", name=f"joint{j + 1}", axis="0 0 1",
                      armature=repr(float(plant.armature[j])),
                      damping=repr(float(plant.viscous[j])),
                      frictionloss=repr(float(plant.coulomb[j])))  # fmt: skip
        place = {"pos": " ".join(map(repr, at.tolist())), "quat": quat}
        link = ET.SubElement(body, "body", place)
        mass, *first = plant.body[j, :4]
        com = np.array(first) / mass
        xx, xy, xz, yy, yz, zz = plant.body[j, 4:]
        about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        about = about - mass * (com @ com * np.eye(3) - np.outer(com, com))
        full = about[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        ET.SubElement(link, "inertial", mass=repr(float(mass)),
                      pos=" ".join(map(repr, com.tolist())),
                      fullinertia=" ".join(map(repr, full.tolist())))  # fmt: skip
        parent, place = link, {"pos": "0 0 0", "quat": "1 0 0 0"}
    return ET.tostring(root, encoding="unicode")


def torques_by_mujoco(plant: TrueArm, motion: JointMotion) -> tuple[Array, Array]:
    """Torque of the body and all torque (m, n), by MuJoCo's inverse dynamics.

    Friction that falls with the speed or builds up over a way is no element of MuJoCo: it is added.
    """
    mujoco = import_optional_module("mujoco", "sim")
    own = (plant.stribeck[:, 0] > 0.0) | (plant.bristles > BRISTLE_TRAVEL_RANGE[1])
    model = mujoco.MjModel.from_xml_string(
        format_mjcf(replace(plant, coulomb=np.where(own, 0.0, plant.coulomb)))
    )
    data, out = mujoco.MjData(model), np.empty_like(motion.q)
    for i in range(len(out)):
        data.qpos, data.qvel, data.qacc = motion.q[i], motion.qd[i], motion.qdd[i]
        mujoco.mj_inverse(model, data)
        out[i] = data.qfrc_inverse
    if own.any():
        dry = replace(plant, viscous=np.zeros_like(plant.viscous))
        out += own * lugre_friction(dry, motion.qd)
    return inverse_dynamics(plant.robot, motion, plant.body), out


TORQUE_GENERATORS = {
    MUJOCO_GENERATOR: torques_by_mujoco,
    INTEGRATION_GENERATOR: torques_by_integration,
}


def simulate_logged_torques(
    plant: TrueArm, generator: str, motion: JointMotion, start_seconds: float
) -> tuple[JointMotion, Array]:
    """The motion and the torques (m, n) that the log of a run has, without noise.

    motion: of the links.  start_seconds: when the run did [s].
    """
    rigid, out = TORQUE_GENERATORS[generator](plant, motion)
    if plant.compliance.any():  # what is logged is the motor; friction and rotor are on its side
        by = plant.compliance * rigid
        rate = time_derivative(by)
        motion = JointMotion(motion.q + by, motion.qd + rate, motion.qdd + time_derivative(rate))
        body, whole = TORQUE_GENERATORS[generator](plant, motion)
        out = rigid + whole - body
    time = MOTION_CASE_TIME_STEP * np.arange(len(out))
    for extra in plant.more:
        out = out + extra(motion, rigid, start_seconds + time)
    if plant.late:
        out = np.stack([np.interp(time - plant.late, time, column) for column in out.T], axis=1)
    return replace(motion, q=motion.q + plant.zero), out * plant.gain


def time_derivative(values: Array) -> Array:
    """In time, of values (m, n) at every step."""
    return np.asarray(np.gradient(values, MOTION_CASE_TIME_STEP, axis=0, edge_order=2))


def simulate_case(case: MotionCase) -> MotionCaseData:
    """The runs of a case."""
    rng = np.random.default_rng(case.seed)
    arm = draw_arm(rng)
    healthy = build_sound_arm(rng, arm)
    true = healthy
    for name, joint in case.causes:
        true = ALL_MOTION_CAUSES[name].put(rng, true, joint % arm.joints)
    of_masses = any(ALL_MOTION_CAUSES[name].of_masses for name, _ in case.causes)
    robot = arm if of_masses or rng.integers(2) else draw_robot_with_wrong_masses(rng, arm)
    loaded = bool(rng.integers(2)) and not of_masses
    warms = bool(rng.integers(3) == 0) or any(name == "warm_up" for name, _ in case.causes)
    level = rng.uniform(*TORQUE_NOISE_RANGE) * healthy.coulomb
    runs, signals, noises, began = list[Run](), list[Array](), list[Array](), 0.0
    for number, seconds in enumerate(RUN_SECONDS):
        slow = number == len(RUN_SECONDS) - 1
        motion = draw_excitation(rng, arm, seconds, MAX_SLOW_RUN_SPEED if slow else np.inf)
        carried = KNOWN_PAYLOAD[0] if loaded and number == 1 else 0.0
        moved, torque = simulate_logged_torques(
            add_known_payload(true, carried), case.generator, motion, began
        )
        _, usual = simulate_logged_torques(
            add_known_payload(healthy, carried), case.generator, moved, began
        )
        noise = level * draw_coloured_noise(rng, torque[::STEPS_PER_LOG_ROW].shape)
        q = moved.q[::STEPS_PER_LOG_ROW] + JOINT_VALUE_NOISE * rng.normal(size=noise.shape)
        time = MOTION_CASE_TIME_STEP * STEPS_PER_LOG_ROW * np.arange(len(q))
        name = f"run{number + 1}"
        runs.append(
            Run(
                name,
                f"{name}.csv",
                time,
                q,
                None,
                None,
                torque[::STEPS_PER_LOG_ROW] + noise,
                "N m",
                payload=carried if loaded else None,
                temperature=sensor_temperature(began + time) if warms else None,
            )
        )
        signals.append((torque - usual)[::STEPS_PER_LOG_ROW])
        noises.append(noise)
        began += seconds + 60.0
    return MotionCaseData(
        robot,
        tuple(runs),
        tuple(signals),
        tuple(noises),
        KNOWN_PAYLOAD if loaded else None,
        float(true.body[-1, 0] - healthy.body[-1, 0]),
    )


def draw_coloured_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """(m, n) noise of unit size, a part of which remembers."""
    red = np.sqrt(1.0 - NOISE_AUTOCORRELATION**2) * rng.normal(size=shape)
    for i in range(1, len(red)):
        red[i] += NOISE_AUTOCORRELATION * red[i - 1]
    return np.asarray(
        np.sqrt(1.0 - CORRELATED_NOISE_FRACTION**2) * rng.normal(size=shape)
        + CORRELATED_NOISE_FRACTION * red
    )


def add_known_payload(plant: TrueArm, payload_mass: float) -> TrueArm:
    """The arm with a known payload."""
    body = plant.body.copy()
    body[-1] += compute_link_inertial_parameters(
        payload_mass, np.array(KNOWN_PAYLOAD[1]), np.zeros(6)
    )
    return replace(plant, body=body)


def sensor_temperature(time: Array) -> Array:
    """What a sensor of the arm says [C]."""
    return np.asarray(22.0 + 14.0 * (1.0 - np.exp(-time / 150.0)))


# ---- causes --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class JointMotionState:
    """What a law of torque knows of a joint, (m,) along the motion.

    size, phase: of the law.  time: since the first run began [s].  load: torque of the rigid body.
    slip: sign of the speed, over 1e-3 rad/s.  fast: speed over 2 rad/s, the same both ways.
    """

    size: float
    phase: float
    time: Array
    coulomb: float
    viscous: float
    q: Array
    qd: Array
    qdd: Array
    load: Array
    slip: Array
    fast: Array


TorqueLaw = Callable[
    [JointMotionState, JointMotionState], Array
]  # of a joint and the next one, or the first after the last


@dataclass(frozen=True)
class MotionCause:
    """How an arm is made to have a cause, and whether it shows as masses that are not as given."""

    put: Callable[[np.random.Generator, TrueArm, int], TrueArm]
    of_masses: bool = False


def cause_changing_number(
    field_name: str, lowest: float, highest: float, *, either_sign: bool = False
) -> MotionCause:
    """A number of a joint, drawn between two sizes, of either sign if asked."""

    def put(rng: np.random.Generator, plant: TrueArm, j: int) -> TrueArm:
        value = getattr(plant, field_name).copy()
        more = draw_log_uniform(rng, lowest, highest)
        value[j] += -more if either_sign and rng.integers(2) else more
        return replace(plant, **{field_name: value})

    return MotionCause(put)


def cause_adding_torque(law: TorqueLaw, lowest: float, highest: float) -> MotionCause:
    """Torque at a joint.  lowest, highest: of its size, which the law takes with a phase."""

    def put(rng: np.random.Generator, plant: TrueArm, j: int) -> TrueArm:
        size, phase = draw_log_uniform(rng, lowest, highest), rng.uniform(-np.pi, np.pi)

        def at(j: int, motion: JointMotion, rigid: Array, time: Array) -> JointMotionState:
            q, qd, qdd, load = (of[:, j] for of in (motion.q, motion.qd, motion.qdd, rigid))
            return JointMotionState(
                size,
                phase,
                time,
                plant.coulomb[j],
                plant.viscous[j],
                q,
                qd,
                qdd,
                load,
                np.tanh(qd / 1e-3),
                np.abs(qd) / 2.0,
            )

        def extra(motion: JointMotion, rigid: Array, time: Array) -> Array:
            out = np.zeros_like(rigid)
            beside = (j + 1) % out.shape[1]
            out[:, j] = law(*(at(k, motion, rigid, time) for k in (j, beside)))
            return out

        return replace(plant, more=(*plant.more, extra))

    return MotionCause(put)


def set_long_bristle_travel(
    rng: np.random.Generator, true_arm: TrueArm, joint_index: int
) -> TrueArm:
    """Friction that builds up over a way that is seen."""
    way = true_arm.bristles.copy()
    way[joint_index] = draw_log_uniform(rng, 0.005, 0.05)
    return replace(true_arm, bristles=way)


def set_stribeck_friction(rng: np.random.Generator, true_arm: TrueArm, joint_index: int) -> TrueArm:
    """Friction that falls from rest with the speed; above it, it is as usual."""
    peak, stribeck = rng.uniform(0.3, 1.0), true_arm.stribeck.copy()
    coulomb = true_arm.coulomb.copy()
    coulomb[joint_index] *= 1.0 + peak
    stribeck[joint_index] = peak / (1.0 + peak), draw_log_uniform(rng, 0.05, 0.3)
    return replace(true_arm, coulomb=coulomb, stribeck=stribeck)


def set_torque_delay(rng: np.random.Generator, true_arm: TrueArm, joint_index: int) -> TrueArm:
    """Torques that are logged late."""
    return replace(true_arm, late=draw_log_uniform(rng, 0.002, 0.012))


def add_unknown_payload(rng: np.random.Generator, true_arm: TrueArm, joint_index: int) -> TrueArm:
    """A payload that nobody told."""
    mass, at = draw_log_uniform(rng, 0.3, 3.0), rng.uniform(-0.05, 0.05, 3)
    body = true_arm.body.copy()
    at[2] += 0.05
    body[-1] += compute_link_inertial_parameters(
        mass, at, np.array([1e-3, 0.0, 0.0, 1e-3, 0.0, 1e-3])
    )
    return replace(true_arm, body=body)


def add_link_mass(rng: np.random.Generator, true_arm: TrueArm, joint_index: int) -> TrueArm:
    """A link that is heavier than drawn, by a mass beside its own centre."""
    joint_index, body = (
        max(joint_index, 1) if len(true_arm.body) > 2 else joint_index,
        true_arm.body.copy(),
    )
    joint_index = min(joint_index, len(body) - 2)
    more = rng.uniform(0.1, 0.4) * body[joint_index, 0]
    at = body[joint_index, 1:4] / body[joint_index, 0] + rng.uniform(-0.08, 0.08, 3)
    body[joint_index] += compute_link_inertial_parameters(more, at, np.zeros(6))
    return replace(true_arm, body=body)


def first_order_lag(drive: Array, seconds: float) -> Array:
    """(m,) a drive that is followed late, to the first order."""
    out, left, now = np.empty_like(drive), np.exp(-MOTION_CASE_TIME_STEP / seconds), 0.0
    for i, value in enumerate(drive):
        now = value + (now - value) * left
        out[i] = now
    return out


def slider_spring_hysteresis(q: Array, slip_travel: float) -> Array:
    """(m,) a spring in series with a slider: it lags the angle, and remembers where it turned."""
    out, now = np.empty_like(q), 0.0
    for i in range(1, len(q)):
        now = float(np.clip(now + q[i] - q[i - 1], -slip_travel, slip_travel))
        out[i] = now
    out[0] = 0.0
    return out / slip_travel


def sloshing_mass_force(drive: Array, natural_frequency: float) -> Array:
    """(m,) the force of a mass on a spring of that rate [rad/s], a tenth damped, on its holder."""
    out, x, v = np.empty_like(drive), 0.0, 0.0
    for i, value in enumerate(drive):
        v += MOTION_CASE_TIME_STEP * (
            -value - 0.2 * natural_frequency * v - natural_frequency**2 * x
        )
        x += MOTION_CASE_TIME_STEP * v
        out[i] = natural_frequency**2 * x
    return out


LIBRARY_MOTION_CAUSES: Mapping[str, MotionCause] = {
    "degressive": cause_adding_torque(
        lambda a, b: a.size * a.coulomb * a.slip * a.fast ** (0.45 + 0.15 * np.sin(a.phase)),
        0.4,
        2.0,
    ),
    "stribeck": MotionCause(set_stribeck_friction),
    "presliding": MotionCause(set_long_bristle_travel),
    "asymmetry": cause_adding_torque(
        lambda a, b: a.size * a.coulomb * np.sign(a.phase) * a.fast, 0.15, 0.6
    ),
    "load_friction": cause_adding_torque(lambda a, b: a.size * np.abs(a.load) * a.slip, 0.03, 0.12),
    "angle_friction": cause_adding_torque(
        lambda a, b: a.size * a.coulomb * a.slip * np.cos(a.q - a.phase), 0.15, 0.6
    ),
    "warm_up": cause_adding_torque(
        lambda a, b: a.size * a.coulomb * a.slip * (36.0 - sensor_temperature(a.time)) / 14.0,
        0.2,
        0.7,
    ),
    "armature": cause_changing_number("armature", 0.05, 0.5),
    "drive_gain": cause_changing_number("gain", 0.02, 0.08, either_sign=True),
    "torque_offset": cause_adding_torque(
        lambda a, b: a.size * a.coulomb * np.sign(a.phase) * np.ones_like(a.time), 0.15, 1.0
    ),
    "torque_ripple": cause_adding_torque(
        lambda a, b: a.size * a.coulomb * np.cos(GIVEN_GEAR_RATIO * a.q - a.phase), 0.1, 0.5
    ),
    "cable": cause_adding_torque(
        lambda a, b: a.size * a.coulomb * (a.q - 0.3 * a.phase), 0.15, 1.0
    ),
    "gravity_spring": cause_adding_torque(
        lambda a, b: a.size * a.coulomb * np.sin(2.0 * a.q - a.phase), 0.15, 1.0
    ),
    "payload": MotionCause(add_unknown_payload, of_masses=True),
    "link_inertia": MotionCause(add_link_mass, of_masses=True),
    "joint_flexibility": cause_changing_number("compliance", 5e-5, 1e-3),
    "delay": MotionCause(set_torque_delay),
    "encoder_zero": cause_changing_number("zero", 0.003, 0.03, either_sign=True),
}
OUTSIDE_MOTION_CAUSES: Mapping[str, MotionCause] = {
    "friction that recent motion lowers": cause_adding_torque(
        lambda a, b: -a.size * a.coulomb * a.slip * first_order_lag(a.fast, 3.0), 0.5, 2.0
    ),
    "damping by another joint's angle": cause_adding_torque(
        lambda a, b: a.size * a.viscous * a.qd * np.cos(b.q - a.phase), 0.3, 1.0
    ),
    "hysteretic cable": cause_adding_torque(
        lambda a, b: a.size * a.coulomb * slider_spring_hysteresis(a.q, 0.4), 0.3, 1.0
    ),
    "torque step at a moment": cause_adding_torque(
        lambda a, b: a.size * a.coulomb * np.sign(a.phase) * (a.time > 70.0 + np.abs(a.phase)),
        0.3,
        1.0,
    ),
    "temperature wave": cause_adding_torque(
        lambda a, b: a.size * a.coulomb * a.slip * np.sin(a.time / 5.0 + a.phase), 0.2, 0.8
    ),
    "cogging of no given ratio": cause_adding_torque(
        lambda a, b: a.size * a.coulomb * np.cos(UNKNOWN_COGGING_WAVES * a.q - a.phase), 0.15, 0.6
    ),
    "sloshing load": cause_adding_torque(
        lambda a, b: a.size * sloshing_mass_force(a.qdd, 9.0), 0.1, 0.6
    ),
    "friction of another joint": cause_adding_torque(
        lambda a, b: a.size * a.coulomb * b.slip, 0.2, 0.7
    ),
    "friction by another joint's load": cause_adding_torque(
        lambda a, b: (
            a.size * a.coulomb * a.slip * np.tanh(b.load / max(np.abs(b.load).mean(), 1e-9))
        ),
        0.3,
        1.0,
    ),
    "drag by the square of the speed": cause_adding_torque(
        lambda a, b: a.size * a.coulomb * a.qd * a.fast, 0.4, 2.0
    ),
}
ALL_MOTION_CAUSES: Mapping[str, MotionCause] = {**LIBRARY_MOTION_CAUSES, **OUTSIDE_MOTION_CAUSES}
