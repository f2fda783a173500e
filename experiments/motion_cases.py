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

from experiments.sweep import needed
from minimax_cal.dynamics.logs.table import Run
from minimax_cal.dynamics.regressor import (
    Motion,
    inertial_parameters,
    inverse_dynamics,
    link_parameters,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.robots.robot import Robot, robot_from_dict

STEP = 0.002  # of the integration [s]
EVERY = 5  # steps between rows of the log
RUN_S = (10.0, 10.0, 10.0, 14.0)  # lengths of the runs [s]
SLOW_PEAK = 0.2  # largest speed of the last run [rad/s]
BASE_HZ = (0.06, 0.12)  # of the excitation's first harmonic
HARMONICS = 5
RATIO = 50.0  # of the gears, which is given
HUMS = 23.7  # waves a turn of a cogging whose ratio nobody gives
CARRIED = (1.5, (0.0, 0.0, 0.06))  # known payload of the second run, where there is one [kg], [m]
BRISTLES = (2e-5, 1e-4)  # way over which friction of a sound arm builds up [rad]
NOISE = (0.02, 0.05)  # of a torque sample, of the joint's Coulomb friction
RED, MEMORY = 0.4, 0.95  # a part of the noise that remembers: its size, its correlation in a sample
ENCODER = 2e-6  # noise of joint values [rad]
MUJOCO, OWN = "mujoco", "own"


@dataclass(frozen=True)
class Case:
    """What is drawn: generator, causes with the numbers of their joints, and the seed."""

    condition: str
    generator: str
    causes: tuple[tuple[str, int], ...]
    seed: int


@dataclass(frozen=True, eq=False)
class Plant:
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
    more: tuple[Callable[[Motion, Array, Array], Array], ...] = field(default=())


@dataclass(frozen=True, eq=False)
class Made:
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


def some_arm(rng: np.random.Generator) -> Robot:
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


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """A size between two, every ratio as likely."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def sound(rng: np.random.Generator, robot: Robot) -> Plant:
    """An arm with usual friction and nothing more."""
    n = robot.joints
    fall = np.array([4.0, 4.0, 2.0, 1.0])[:n]
    return Plant(
        robot,
        inertial_parameters(robot),
        armature=np.zeros(n),
        coulomb=fall * rng.uniform(0.7, 1.5, n),
        viscous=fall * rng.uniform(0.5, 1.5, n),
        bristles=np.array([between(rng, *BRISTLES) for _ in range(n)]),
        stribeck=np.tile([0.0, 1.0], (n, 1)),
        compliance=np.zeros(n),
        gain=np.ones(n),
        zero=np.zeros(n),
    )


def off_by(rng: np.random.Generator, robot: Robot) -> Robot:
    """The arm as a file has it whose masses are guesses."""
    mass = robot.mass * rng.uniform(0.75, 1.3, robot.joints)
    return replace(robot, mass=mass, com=robot.com + rng.uniform(-0.03, 0.03, robot.com.shape))


def excitation(rng: np.random.Generator, robot: Robot, seconds: float, peak: float) -> Motion:
    """A finite Fourier series.  peak: largest speed [rad/s], infinite for its own."""
    rate = 2.0 * np.pi * rng.uniform(*BASE_HZ) * np.arange(1.0, HARMONICS + 1.0)[:, None]
    size = 0.7 * rng.normal(size=(2, HARMONICS, robot.joints)) / rate * rate[0]
    motion = series(seconds, np.tile(rate, robot.joints), size)
    if np.isfinite(peak):
        motion = series(seconds, rate * peak / np.abs(motion.qd).max(axis=0), size)
    return replace(motion, q=motion.q + np.array([0.0, 0.7, -1.0, 0.0])[: robot.joints])


def series(seconds: float, rate: Array, size: Array) -> Motion:
    """Sines and cosines.  rate: (h, n) [rad/s].  size: (2, h, n) [rad]."""
    turn = np.arange(0.0, seconds, STEP)[:, None, None] * rate
    a, b = size
    sin, cos = np.sin(turn), np.cos(turn)
    q, qd = a * sin + b * cos, rate * (a * cos - b * sin)
    return Motion(q.sum(axis=1), qd.sum(axis=1), (-(rate**2) * q).sum(axis=1))


# ---- generators ----------------------------------------------------------------------------------


def bristle_friction(plant: Plant, qd: Array) -> Array:
    """(m, n) LuGre friction: bristles that bend along the way [Canudas de Wit et al. 1995]."""
    share, fades = plant.stribeck.T
    height = plant.coulomb * (1.0 - share * (1.0 - np.exp(-((qd / fades) ** 2))))
    left = np.exp(-np.abs(qd) * STEP * plant.coulomb / height / plant.bristles)
    target, bent = np.sign(qd) * height, np.zeros_like(qd)
    now = target[0]
    for i in range(len(qd)):
        now = target[i] + (now - target[i]) * left[i]
        bent[i] = now
    return np.asarray(bent + plant.viscous * qd)


def by_integration(plant: Plant, motion: Motion) -> tuple[Array, Array]:
    """Torque of the body and all torque (m, n), by Newton and Euler and LuGre friction."""
    rigid = inverse_dynamics(plant.robot, motion, plant.body)
    return rigid, rigid + plant.armature * motion.qdd + bristle_friction(plant, motion.qd)


def mjcf_of(plant: Plant) -> str:
    """The arm for MuJoCo: a link's frame is where the next joint turns."""
    root = ET.Element("mujoco")
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", gravity="0 0 -9.80665", timestep=str(STEP))
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


def by_mujoco(plant: Plant, motion: Motion) -> tuple[Array, Array]:
    """Torque of the body and all torque (m, n), by MuJoCo's inverse dynamics.

    Friction that falls with the speed or builds up over a way is no element of MuJoCo: it is added.
    """
    mujoco = needed("mujoco", "sim")
    own = (plant.stribeck[:, 0] > 0.0) | (plant.bristles > BRISTLES[1])
    model = mujoco.MjModel.from_xml_string(
        mjcf_of(replace(plant, coulomb=np.where(own, 0.0, plant.coulomb)))
    )
    data, out = mujoco.MjData(model), np.empty_like(motion.q)
    for i in range(len(out)):
        data.qpos, data.qvel, data.qacc = motion.q[i], motion.qd[i], motion.qdd[i]
        mujoco.mj_inverse(model, data)
        out[i] = data.qfrc_inverse
    if own.any():
        dry = replace(plant, viscous=np.zeros_like(plant.viscous))
        out += own * bristle_friction(dry, motion.qd)
    return inverse_dynamics(plant.robot, motion, plant.body), out


GENERATORS = {MUJOCO: by_mujoco, OWN: by_integration}


def logged(plant: Plant, generator: str, motion: Motion, began: float) -> tuple[Motion, Array]:
    """The motion and the torques (m, n) that the log of a run has, without noise.

    motion: of the links.  began: when the run did [s].
    """
    rigid, out = GENERATORS[generator](plant, motion)
    if plant.compliance.any():  # what is logged is the motor; friction and rotor are on its side
        by = plant.compliance * rigid
        rate = derivative(by)
        motion = Motion(motion.q + by, motion.qd + rate, motion.qdd + derivative(rate))
        body, whole = GENERATORS[generator](plant, motion)
        out = rigid + whole - body
    time = STEP * np.arange(len(out))
    for extra in plant.more:
        out = out + extra(motion, rigid, began + time)
    if plant.late:
        out = np.stack([np.interp(time - plant.late, time, column) for column in out.T], axis=1)
    return replace(motion, q=motion.q + plant.zero), out * plant.gain


def derivative(values: Array) -> Array:
    """In time, of values (m, n) at every step."""
    return np.asarray(np.gradient(values, STEP, axis=0, edge_order=2))


def make(case: Case) -> Made:
    """The runs of a case."""
    rng = np.random.default_rng(case.seed)
    arm = some_arm(rng)
    healthy = sound(rng, arm)
    true = healthy
    for name, joint in case.causes:
        true = CAUSES[name].put(rng, true, joint % arm.joints)
    of_masses = any(CAUSES[name].of_masses for name, _ in case.causes)
    robot = arm if of_masses or rng.integers(2) else off_by(rng, arm)
    loaded = bool(rng.integers(2)) and not of_masses
    warms = bool(rng.integers(3) == 0) or any(name == "warm_up" for name, _ in case.causes)
    level = rng.uniform(*NOISE) * healthy.coulomb
    runs, signals, noises, began = list[Run](), list[Array](), list[Array](), 0.0
    for number, seconds in enumerate(RUN_S):
        slow = number == len(RUN_S) - 1
        motion = excitation(rng, arm, seconds, SLOW_PEAK if slow else np.inf)
        carried = CARRIED[0] if loaded and number == 1 else 0.0
        moved, torque = logged(with_load(true, carried), case.generator, motion, began)
        _, usual = logged(with_load(healthy, carried), case.generator, moved, began)
        noise = level * coloured(rng, torque[::EVERY].shape)
        q = moved.q[::EVERY] + ENCODER * rng.normal(size=noise.shape)
        time = STEP * EVERY * np.arange(len(q))
        name = f"run{number + 1}"
        runs.append(Run(name, f"{name}.csv", time, q, None, None, torque[::EVERY] + noise, "N m",
                        payload=carried if loaded else None,
                        temperature=warmth(began + time) if warms else None))  # fmt: skip
        signals.append((torque - usual)[::EVERY])
        noises.append(noise)
        began += seconds + 60.0
    return Made(robot, tuple(runs), tuple(signals), tuple(noises), CARRIED if loaded else None,
                float(true.body[-1, 0] - healthy.body[-1, 0]))  # fmt: skip


def coloured(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """(m, n) noise of unit size, a part of which remembers."""
    red = np.sqrt(1.0 - MEMORY**2) * rng.normal(size=shape)
    for i in range(1, len(red)):
        red[i] += MEMORY * red[i - 1]
    return np.asarray(np.sqrt(1.0 - RED**2) * rng.normal(size=shape) + RED * red)


def with_load(plant: Plant, mass: float) -> Plant:
    """The arm with a known payload."""
    body = plant.body.copy()
    body[-1] += link_parameters(mass, np.array(CARRIED[1]), np.zeros(6))
    return replace(plant, body=body)


def warmth(time: Array) -> Array:
    """What a sensor of the arm says [C]."""
    return np.asarray(22.0 + 14.0 * (1.0 - np.exp(-time / 150.0)))


# ---- causes --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class At:
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


Law = Callable[[At, At], Array]  # of a joint and the next one, or the first after the last


@dataclass(frozen=True)
class Cause:
    """How an arm is made to have a cause, and whether it shows as masses that are not as given."""

    put: Callable[[np.random.Generator, Plant, int], Plant]
    of_masses: bool = False


def changed(name: str, low: float, high: float, *, either: bool = False) -> Cause:
    """A number of a joint, drawn between two sizes, of either sign if asked."""

    def put(rng: np.random.Generator, plant: Plant, j: int) -> Plant:
        value = getattr(plant, name).copy()
        more = between(rng, low, high)
        value[j] += -more if either and rng.integers(2) else more
        return replace(plant, **{name: value})

    return Cause(put)


def added(law: Law, low: float, high: float) -> Cause:
    """Torque at a joint.  low, high: of its size, which the law takes with a phase."""

    def put(rng: np.random.Generator, plant: Plant, j: int) -> Plant:
        size, phase = between(rng, low, high), rng.uniform(-np.pi, np.pi)

        def at(j: int, motion: Motion, rigid: Array, time: Array) -> At:
            q, qd, qdd, load = (of[:, j] for of in (motion.q, motion.qd, motion.qdd, rigid))
            return At(size, phase, time, plant.coulomb[j], plant.viscous[j], q, qd, qdd, load,
                      np.tanh(qd / 1e-3), np.abs(qd) / 2.0)  # fmt: skip

        def extra(motion: Motion, rigid: Array, time: Array) -> Array:
            out = np.zeros_like(rigid)
            beside = (j + 1) % out.shape[1]
            out[:, j] = law(*(at(k, motion, rigid, time) for k in (j, beside)))
            return out

        return replace(plant, more=(*plant.more, extra))

    return Cause(put)


def bristly(rng: np.random.Generator, plant: Plant, j: int) -> Plant:
    """Friction that builds up over a way that is seen."""
    way = plant.bristles.copy()
    way[j] = between(rng, 0.005, 0.05)
    return replace(plant, bristles=way)


def falling(rng: np.random.Generator, plant: Plant, j: int) -> Plant:
    """Friction that falls from rest with the speed; above it, it is as usual."""
    peak, stribeck = rng.uniform(0.3, 1.0), plant.stribeck.copy()
    coulomb = plant.coulomb.copy()
    coulomb[j] *= 1.0 + peak
    stribeck[j] = peak / (1.0 + peak), between(rng, 0.05, 0.3)
    return replace(plant, coulomb=coulomb, stribeck=stribeck)


def lasting(rng: np.random.Generator, plant: Plant, j: int) -> Plant:
    """Torques that are logged late."""
    return replace(plant, late=between(rng, 0.002, 0.012))


def carrying(rng: np.random.Generator, plant: Plant, j: int) -> Plant:
    """A payload that nobody told."""
    mass, at = between(rng, 0.3, 3.0), rng.uniform(-0.05, 0.05, 3)
    body = plant.body.copy()
    at[2] += 0.05
    body[-1] += link_parameters(mass, at, np.array([1e-3, 0.0, 0.0, 1e-3, 0.0, 1e-3]))
    return replace(plant, body=body)


def heavier(rng: np.random.Generator, plant: Plant, j: int) -> Plant:
    """A link that is heavier than drawn, by a mass beside its own centre."""
    j, body = max(j, 1) if len(plant.body) > 2 else j, plant.body.copy()
    j = min(j, len(body) - 2)
    more = rng.uniform(0.1, 0.4) * body[j, 0]
    at = body[j, 1:4] / body[j, 0] + rng.uniform(-0.08, 0.08, 3)
    body[j] += link_parameters(more, at, np.zeros(6))
    return replace(plant, body=body)


def relaxed(drive: Array, seconds: float) -> Array:
    """(m,) a drive that is followed late, to the first order."""
    out, left, now = np.empty_like(drive), np.exp(-STEP / seconds), 0.0
    for i, value in enumerate(drive):
        now = value + (now - value) * left
        out[i] = now
    return out


def hysteresis(q: Array, way: float) -> Array:
    """(m,) a spring in series with a slider: it lags the angle, and remembers where it turned."""
    out, now = np.empty_like(q), 0.0
    for i in range(1, len(q)):
        now = float(np.clip(now + q[i] - q[i - 1], -way, way))
        out[i] = now
    out[0] = 0.0
    return out / way


def sloshing(drive: Array, rate: float) -> Array:
    """(m,) the force of a mass on a spring of that rate [rad/s], a tenth damped, on its holder."""
    out, x, v = np.empty_like(drive), 0.0, 0.0
    for i, value in enumerate(drive):
        v += STEP * (-value - 0.2 * rate * v - rate**2 * x)
        x += STEP * v
        out[i] = rate**2 * x
    return out


LIBRARY: Mapping[str, Cause] = {
    "degressive": added(lambda a, b: a.size * a.coulomb * a.slip
                        * a.fast ** (0.45 + 0.15 * np.sin(a.phase)), 0.4, 2.0),
    "stribeck": Cause(falling),
    "presliding": Cause(bristly),
    "asymmetry": added(lambda a, b: a.size * a.coulomb * np.sign(a.phase) * a.fast, 0.15, 0.6),
    "load_friction": added(lambda a, b: a.size * np.abs(a.load) * a.slip, 0.03, 0.12),
    "angle_friction": added(
        lambda a, b: a.size * a.coulomb * a.slip * np.cos(a.q - a.phase), 0.15, 0.6),
    "warm_up": added(
        lambda a, b: a.size * a.coulomb * a.slip * (36.0 - warmth(a.time)) / 14.0, 0.2, 0.7),
    "armature": changed("armature", 0.05, 0.5),
    "drive_gain": changed("gain", 0.02, 0.08, either=True),
    "torque_offset": added(
        lambda a, b: a.size * a.coulomb * np.sign(a.phase) * np.ones_like(a.time), 0.15, 1.0),
    "torque_ripple": added(
        lambda a, b: a.size * a.coulomb * np.cos(RATIO * a.q - a.phase), 0.1, 0.5),
    "cable": added(lambda a, b: a.size * a.coulomb * (a.q - 0.3 * a.phase), 0.15, 1.0),
    "gravity_spring": added(
        lambda a, b: a.size * a.coulomb * np.sin(2.0 * a.q - a.phase), 0.15, 1.0),
    "payload": Cause(carrying, of_masses=True),
    "link_inertia": Cause(heavier, of_masses=True),
    "joint_flexibility": changed("compliance", 5e-5, 1e-3),
    "delay": Cause(lasting),
    "encoder_zero": changed("zero", 0.003, 0.03, either=True),
}  # fmt: skip
OUTSIDE: Mapping[str, Cause] = {
    "friction that recent motion lowers": added(
        lambda a, b: -a.size * a.coulomb * a.slip * relaxed(a.fast, 3.0), 0.5, 2.0),
    "damping by another joint's angle": added(
        lambda a, b: a.size * a.viscous * a.qd * np.cos(b.q - a.phase), 0.3, 1.0),
    "hysteretic cable": added(
        lambda a, b: a.size * a.coulomb * hysteresis(a.q, 0.4), 0.3, 1.0),
    "torque step at a moment": added(lambda a, b: a.size * a.coulomb * np.sign(a.phase)
                                     * (a.time > 70.0 + np.abs(a.phase)), 0.3, 1.0),
    "temperature wave": added(
        lambda a, b: a.size * a.coulomb * a.slip * np.sin(a.time / 5.0 + a.phase), 0.2, 0.8),
    "cogging of no given ratio": added(
        lambda a, b: a.size * a.coulomb * np.cos(HUMS * a.q - a.phase), 0.15, 0.6),
    "sloshing load": added(lambda a, b: a.size * sloshing(a.qdd, 9.0), 0.1, 0.6),
    "friction of another joint": added(lambda a, b: a.size * a.coulomb * b.slip, 0.2, 0.7),
    "friction by another joint's load": added(
        lambda a, b: a.size * a.coulomb * a.slip
        * np.tanh(b.load / max(np.abs(b.load).mean(), 1e-9)), 0.3, 1.0),
    "drag by the square of the speed": added(
        lambda a, b: a.size * a.coulomb * a.qd * a.fast, 0.4, 2.0),
}  # fmt: skip
CAUSES: Mapping[str, Cause] = {**LIBRARY, **OUTSIDE}
