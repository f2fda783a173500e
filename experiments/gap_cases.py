"""Measurement files with a known gap between model and robot, for the blind study of `diagnose`.

A `GapCase` says what is wrong with an arm; `build_and_measure_arm` builds the arm, lets it be
measured and keeps the truth; `write_diagnosis_files` leaves robot.json and data.csv for the
diagnosis.

The laws here are this file's own and share no code with the library that is judged by them: every
deviation is finite (offsets go through the forward kinematics, links turn and bend), and they are
evaluated with the arm's true geometry and true masses, which the robot file does not tell.
How large an effect is, is asked for by its detectability lambda: the squared length of its
displacement of the training points, whitened by instrument noise and by the joints' repeatability,
after projection on what no error of the geometry could explain.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.real_arms import perturb_link_parameters
from minimax_cal.core.arrays import Array
from minimax_cal.measuring.measurements import Measurements, measurements, write_measurements
from minimax_cal.robots.robot import Robot, load_robot

STANDARD_GRAVITY = 9.80665  # [m/s^2]
HELD_OUT_POSES, REVISITED_POSES = 80, 15
COORDINATE_NOISE, NOISE_PER_METRE = (
    10e-6,
    2.5e-6,
)  # of each coordinate, and its growth with range [m, -]
LINK_LENGTH_SIGMA, LINK_ANGLE_SIGMA = (
    0.5e-3,
    1e-3,
)  # standard deviation of the geometry's errors [m, rad]
RELATIVE_MASS_ERROR = 0.15  # relative error of the masses and centres that the robot file tells
MEAN_SECONDS_BETWEEN_POSES = 30.0  # from one pose to the next [s]
MIN_RELATIVE_SINGULAR_VALUE = (
    1e-4  # singular values of the geometry that count as nothing, relative to the largest
)
MAX_JOINT_ANGLE = np.pi  # joints stay within one turn


@dataclass(frozen=True)
class ArmKnowledge:
    """What the generator knows of a robot beside its geometry.

    mass, com: of each link in its own frame, the tool with the last [kg, m].  ratio: of the gears
    whose ratio the robot file tells, NaN for the others.  beams: links that may bend.  loaded:
    joints that carry gravity.  upright: joint that a spring may balance.  driven: joints that the
    motor of another moves, and its number.  ripple: waves a turn of gears of no told ratio.  hot:
    (joint, column of the MDH table) of the lengths that grow.
    """

    mass: tuple[float, ...]
    ratio: tuple[float, ...]
    beams: tuple[int, ...]
    loaded: tuple[int, ...]
    upright: str = ""
    driven: tuple[tuple[str, int], ...] = ()
    com: tuple[tuple[float, float, float], ...] = ()
    ripple: tuple[float, float] = (17.0, 24.0)
    hot: tuple[tuple[int, int], ...] = ()


NO_GEAR_RATIO = float("nan")
COUPLED_WRIST_JOINTS = (("J3", 2), ("J5", 4), ("J6", 5))
GAP_ARMS = {
    "irb2600": ArmKnowledge(
        (95.0, 52.0, 48.0, 22.0, 7.0, 14.0),
        (121.0, 141.3, 105.5, NO_GEAR_RATIO, NO_GEAR_RATIO, NO_GEAR_RATIO),
        (2, 4),
        (2, 3, 5),
        "J2",
        COUPLED_WRIST_JOINTS,
        com=(
            (-0.11, 0.14, 0.02),
            (-0.44, 0.02, 0.06),
            (-0.06, 0.03, 0.12),
            (0.01, -0.42, 0.01),
            (0.0, 0.01, 0.05),
            (0.02, -0.01, 0.05),
        ),
        hot=((1, 1), (2, 0), (4, 1)),
    ),
    "ur10e": ArmKnowledge(
        (7.4, 13.1, 4.0, 2.1, 2.0, 4.6),
        (101.0, 101.0, 101.0, NO_GEAR_RATIO, NO_GEAR_RATIO, NO_GEAR_RATIO),
        (2, 3),
        (2, 3, 4, 5),
        driven=COUPLED_WRIST_JOINTS,
        com=(
            (0.0, 0.02, 0.03),
            (0.38, 0.0, 0.16),
            (0.24, 0.0, 0.07),
            (0.0, 0.01, 0.02),
            (0.0, 0.01, 0.02),
            (0.02, -0.01, 0.03),
        ),
        ripple=(13.0, 17.0),
        hot=((1, 1), (2, 0), (3, 0)),
    ),
}


# ---- what is asked for, and what comes out -----------------------------------------------------


@dataclass(frozen=True)
class GapCause:
    """A law of `GAP_LAWS` at a place.

    power: its detectability lambda (of a fault the factor of its size, 1 as a rule).
    variant: which of a law's forms, as once or twice a turn.
    """

    law: str
    place: str
    power: float
    variant: int = 0

    @property
    def effect(self) -> str:
        """The effect's name in the contract: a law may be a distorted form, as in name/form."""
        return self.law.partition("/")[0]


@dataclass(frozen=True)
class GapCase:
    """One arm and its measurement, as plain data.

    background: lambda of each of the small effects on all joints, 0 for none.  poses: of the
    training, revisits apart.  jitter: of every joint at every visit [rad].  noise: factor on the
    instrument's noise.  delete: effects that the diagnosis must do without.  targets: how many.
    """

    robot: str
    condition: str
    causes: tuple[GapCause, ...] = ()
    background: float = 0.0
    poses: int = 100
    jitter: float = 6e-6
    noise: float = 1.0
    delete: tuple[str, ...] = ()
    seed: int = 0
    targets: int = 3


@dataclass(frozen=True, eq=False)
class GapTruth:
    """What is wrong with an arm.

    truth: (effect, place) of every cause of the case.  background: those of the background.
    displacement: (m, k, 3) of the points by all effects, in the measurement frame [m].
    parts: (c, m, k, 3) the same by each cause of the case alone [m].  powers: (c,) lambda of each.
    power: lambda of all.  amplitudes: (c,) of the laws, in the law's own unit.
    floor: RMS that the noise and the jitter alone leave on the held-out poses [m].
    """

    truth: tuple[tuple[str, str], ...]
    background: tuple[tuple[str, str], ...]
    displacement: Array
    parts: Array
    powers: tuple[float, ...]
    power: float
    amplitudes: tuple[float, ...]
    floor: float


@dataclass(frozen=True, eq=False)
class SealedArm(GapTruth):
    """A measured arm: what is told, and the truth.

    robot: as told, nominal geometry and wrong masses.  data: as measured.  true: the arm itself.
    """

    case: GapCase
    robot: Robot
    data: Measurements
    true: Robot


@dataclass(frozen=True, eq=False)
class MeasuredArm:
    """An arm in its place, and its visits in their order.

    robot: the arm as it is.  told: as the robot file tells it.  base: (4, 4) pose in the
    measurement frame [m].  spots: (k, 3) targets in the flange's frame [m].  q: (m, n) commanded
    [rad].  jitter: (m, n) [rad].  move: (m, n) last move of the joints, 0 before the first [rad].
    time: (m,) since the start [s].  warm: time constant of the warming [s].
    train: (m,) True where a row is for training.
    """

    robot: Robot
    told: Robot
    arm: ArmKnowledge
    base: Array
    spots: Array
    q: Array
    jitter: Array
    move: Array
    time: Array
    warm: float
    train: Array


@dataclass(frozen=True, eq=False)
class ArmDeviation:
    """How an arm deviates from the rigid one, at every row.

    joints: (m, n) turn, in the controller's sense [rad].  lengths: (m, n, 2) of a and d [m].
    links: (m, n, 6) rotation vector and translation of the end of a link in its frame [rad, m].
    base, tool: (m, 6) the same of the base in the base's and of the tool in the flange's frame.
    spots: (m, k, 3) of the targets in the flange's frame [m].
    sight: (m, k) along the line of sight [m].  points: (m, k, 3) of what is written down [m].
    """

    joints: Array
    lengths: Array
    links: Array
    base: Array
    tool: Array
    spots: Array
    sight: Array
    points: Array

    def __add__(self, other: ArmDeviation) -> ArmDeviation:
        return ArmDeviation(
            *(a + b for a, b in zip(self.list_arrays(), other.list_arrays(), strict=True))
        )

    def __mul__(self, factor: float) -> ArmDeviation:
        return ArmDeviation(*(factor * part for part in self.list_arrays()))

    def list_arrays(self) -> tuple[Array, ...]:
        """The fields, in their order."""
        return tuple(vars(self).values())


def zero_deviation(world: MeasuredArm) -> ArmDeviation:
    """No deviation."""
    (m, n), k = world.q.shape, len(world.spots)
    shapes = ((m, n), (m, n, 2), (m, n, 6), (m, 6), (m, 6), (m, k, 3), (m, k), (m, k, 3))
    return ArmDeviation(*(np.zeros(shape) for shape in shapes))


# ---- the arm: forward kinematics, loads, geometry ----------------------------------------------


def rotation_about_axis(axis: int, angle: Array) -> Array:
    """Rotation about the axis x (0) or y (1) or z (2): (..., 4, 4)."""
    out = np.zeros((*np.shape(angle), 4, 4), dtype=np.asarray(angle).dtype)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out[..., axis, axis] = out[..., 3, 3] = 1.0
    out[..., i, i] = out[..., j, j] = np.cos(angle)
    out[..., j, i] = np.sin(angle)
    out[..., i, j] = -out[..., j, i]
    return out


def translation(vector: Array) -> Array:
    """Translation: (..., 4, 4).  vector: (..., 3) [m]."""
    out = np.zeros((*vector.shape[:-1], 4, 4), dtype=vector.dtype)
    out[..., range(4), range(4)] = 1.0
    out[..., :3, 3] = vector
    return out


def transform_from_rotation_vector(rotation_vector_and_translation: Array) -> Array:
    """Rotation by a vector, and translation: (m, 4, 4).  rotation_vector_and_translation: (m, 6)
    [rad, m].
    """
    out = translation(rotation_vector_and_translation[:, 3:])
    out[:, :3, :3] = Rotation.from_rotvec(rotation_vector_and_translation[:, :3]).as_matrix()
    return out


def link_frames(robot: Robot, q: Array, deviation: ArmDeviation | None = None) -> Array:
    """Poses of all frames in the base, the base's own first: (m, n + 1, 4, 4) [m].

    q: (m, n) [rad, m].  A deviation of joints, lengths and links is taken into account.
    """
    m = len(q)
    pose = np.broadcast_to(np.eye(4, dtype=q.dtype), (m, 4, 4))
    out = [pose]
    for i, (a, d, theta, alpha, beta) in enumerate(robot.mdh):
        dq = deviation.joints[:, i] if deviation else 0.0
        da, dd = deviation.lengths[:, i].T if deviation else (0.0, 0.0)
        zero = np.zeros(m)
        own = robot.sign[i] * (q[:, i] + dq)
        turned, slid = (0.0, own) if robot.prismatic[i] else (own, 0.0)
        step = np.stack([zero + a + da, zero, zero + d + dd + slid], axis=-1)
        link = rotation_about_axis(2, zero + theta + turned) @ translation(step)
        pose = pose @ link @ rotation_about_axis(0, alpha) @ rotation_about_axis(1, beta)
        if deviation and deviation.links[:, i].any():
            pose = pose @ transform_from_rotation_vector(deviation.links[:, i])
        out.append(pose)
    return np.stack(out, axis=1)


def measured_points_without_noise(world: MeasuredArm, deviation: ArmDeviation) -> Array:
    """Where the instrument sees the targets, without its noise: (m, k, 3) [m]."""
    flange = link_frames(world.robot, world.q + world.jitter, deviation)[:, -1]
    pose = (
        world.base
        @ transform_from_rotation_vector(deviation.base)
        @ flange
        @ transform_from_rotation_vector(deviation.tool)
    )
    spots = world.spots + deviation.spots
    y = np.einsum("mij,mkj->mki", pose[:, :3, :3], spots) + pose[:, None, :3, 3]
    away = y / np.linalg.norm(y, axis=-1, keepdims=True)
    return np.asarray(y + deviation.sight[..., None] * away + deviation.points)


def link_centres_of_gravity(robot: Robot, frames: Array) -> Array:
    """Centres of gravity of the links in the base: (m, n, 3) [m].  frames: as `link_frames`."""
    turned = np.einsum("mnij,nj->mni", frames[:, 1:, :3, :3], robot.com)
    return np.asarray(turned + frames[:, 1:, :3, 3])


def weight_and_moment(
    robot: Robot, frames: Array, first_link: int, moment_points: Array
) -> tuple[Array, Array]:
    """Weight of links first, first + 1, ... and its moment about points: (m, 3) each [N, N m].

    first_link: counted from 0.  moment_points: (m, 3) in the base [m].
    """
    weight = -STANDARD_GRAVITY * robot.mass[first_link:, None] * robot.up
    lever = link_centres_of_gravity(robot, frames)[:, first_link:] - moment_points[:, None]
    force = np.broadcast_to(weight.sum(axis=0), moment_points.shape)
    return force, np.cross(lever, weight).sum(axis=1)


def gravity_torques(robot: Robot, q: Array) -> Array:
    """Gravity's torque on every joint, in the controller's sense: (m, n) [N m]."""
    pose = link_frames(robot, q)
    about = [weight_and_moment(robot, pose, i, pose[:, i, :3, 3])[1] for i in range(robot.joints)]
    axes = pose[:, :-1, :3, 2]
    return np.asarray(np.sum(np.stack(about, axis=1) * axes, axis=-1) * robot.sign)


def geometry_and_joint_jacobians(world: MeasuredArm) -> tuple[Array, Array]:
    """Motion of the points by the geometry's parameters, and by the joints, in the base.

    Returns (m, k, 3, p) with p of theta, d, a, alpha, beta, base and targets, and (m, k, 3, n).
    """
    robot, k = world.robot, len(world.spots)
    pose = link_frames(robot, world.q)
    turned, origin = pose[:, :, :3, :3], pose[:, :, :3, 3]
    points = np.einsum("mij,kj->mki", turned[:, -1], world.spots) + origin[:, -1, None]
    z, y = turned[:, :-1, :, 2], turned[:, 1:, :, 1]
    turned_by = np.where(robot.prismatic, 0.0, robot.sign * world.q)
    across = rotation_about_axis(2, robot.mdh[:, 2] + turned_by)[..., :3, 0]
    x = np.einsum("mnij,mnj->mni", turned[:, :-1], across)

    def about(axis: Array, through: Array) -> Array:
        lever = points[:, :, None] - through[:, None]
        return np.moveaxis(np.cross(axis[:, None], lever), 2, 3)

    def along(axis: Array) -> Array:
        still = np.broadcast_to(axis[:, None], (len(axis), k, *axis.shape[1:]))
        return np.moveaxis(still, 2, 3)

    before, after = origin[:, :-1], origin[:, 1:]
    unit = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    theta = about(z, before)
    parts = [theta, along(z), along(x), about(x, after), about(y, after)]
    parts += [about(unit, np.zeros_like(unit)), along(unit)]
    for target in range(k):
        own = np.zeros((len(points), k, 3, 3))
        own[:, target] = turned[:, -1]
        parts.append(own)
    moved = np.where(robot.prismatic, along(z), theta)
    return np.concatenate(parts, axis=-1), moved * robot.sign


# ---- detectability -----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class DetectabilityMeasure:
    """Measures displacements of the training points by what noise and geometry leave of them.

    turn: (3, 3) from the measurement frame to the base.  train: (m,) rows that count.
    white: (m', 3k, 3k) inverse root of the covariance of a row.  geometry: (3k m', r)
    orthonormal, what errors of the geometry can explain after whitening.  floor: as `SealedArm`.
    """

    turn: Array
    train: Array
    white: Array
    geometry: Array
    floor: float

    def project_out_geometry(self, displacement: Array) -> Array:
        """What is left of displacements (m, k, 3) after whitening and projection: (3k m',)."""
        rows = (displacement[self.train] @ self.turn.T).reshape(len(self.white), -1)
        flat = np.einsum("mij,mj->mi", self.white, rows).reshape(-1)
        return np.asarray(flat - self.geometry @ (self.geometry.T @ flat))

    def detectability(self, displacement: Array) -> float:
        """The detectability lambda of a displacement (m, k, 3) [m]."""
        return float(np.sum(self.project_out_geometry(displacement) ** 2))


def build_detectability_measure(
    world: MeasuredArm, noise: Array, jitter: float
) -> DetectabilityMeasure:
    """The measure of detectability.

    noise: (m, k) standard deviation of each coordinate [m].  jitter: of a joint [rad].
    """
    geometry, joints = geometry_and_joint_jacobians(world)
    m, k, _, p = geometry.shape
    bends = joints.reshape(m, 3 * k, -1)
    variance = np.repeat(noise**2, 3, axis=1)
    covariance = jitter**2 * bends @ bends.swapaxes(1, 2) + variance[:, :, None] * np.eye(3 * k)
    held = covariance[~world.train]
    floor = np.sqrt(np.trace(held, axis1=1, axis2=2).mean() / k)
    white = np.linalg.inv(np.linalg.cholesky(covariance[world.train]))
    columns = (white @ geometry[world.train].reshape(-1, 3 * k, p)).reshape(-1, p)
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return DetectabilityMeasure(
        world.base[:3, :3].T,
        world.train,
        white,
        u[:, s > MIN_RELATIVE_SINGULAR_VALUE * s[0]],
        float(floor),
    )


# ---- laws: what a cause does to the arm, at amplitude 1 ----------------------------------------

DeviationLaw = Callable[[MeasuredArm, GapCause, np.random.Generator], ArmDeviation]


def index_from_place(place: str) -> int:
    """Index, from 0, of the joint, link or target that a place names."""
    found = re.fullmatch(r"(?:J|L|smr)(\d+)", place)
    if not found:
        raise ValueError(f"place {place!r} has no number")
    return int(found[1]) - 1


def joint_values_of_cause(world: MeasuredArm, cause: GapCause) -> Array:
    """Values (m,) of the place's joint [rad]."""
    return np.asarray(world.q[:, index_from_place(cause.place)])


def joint_rotation_deviation(world: MeasuredArm, place: str, joint_errors: Array) -> ArmDeviation:
    """The joint of a place turns by dq (m,) [rad]."""
    joints = np.zeros(world.q.shape)
    joints[:, index_from_place(place)] = joint_errors
    return replace(zero_deviation(world), joints=joints)


def base_motion_deviation(
    world: MeasuredArm, turn: Array | float = 0.0, shift: Array | float = 0.0
) -> ArmDeviation:
    """The base turns by rotation vectors and moves, (m, 3) each [rad, m]."""
    base = np.zeros((len(world.q), 6))
    base[:, :3], base[:, 3:] = turn, shift
    return replace(zero_deviation(world), base=base)


def all_joints_rotation_deviation(
    world: MeasuredArm, place: str, joint_errors: Array, rng: np.random.Generator
) -> ArmDeviation:
    """All joints turn by dq (m, n), each by a factor of its own, or the one of the place."""
    factors = rng.uniform(0.6, 1.6, world.q.shape[1])
    if place != "all":
        return joint_rotation_deviation(world, place, joint_errors[:, index_from_place(place)])
    return replace(zero_deviation(world), joints=joint_errors * factors)


def joint_compliance(world: MeasuredArm, cause: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """dq = c torque [c in rad/(N m)]."""
    return all_joints_rotation_deviation(
        world, cause.place, gravity_torques(world.robot, world.q), rng
    )


def hardening_joint_compliance(
    world: MeasuredArm, cause: GapCause, rng: np.random.Generator
) -> ArmDeviation:
    """Compliance that is a third at the largest torque: dq = c torque / (1 + 2 |torque| / max)."""
    load = gravity_torques(world.robot, world.q)
    most = np.maximum(np.abs(load).max(axis=0), 1e-9)
    return all_joints_rotation_deviation(
        world, cause.place, load / (1.0 + 2.0 * np.abs(load) / most), rng
    )


def link_bending(world: MeasuredArm, cause: GapCause, _: np.random.Generator) -> ArmDeviation:
    """Cantilever of stiffness EI under all links beyond it [1/EI in 1/(N m^2)]."""
    i = index_from_place(cause.place)
    pose = link_frames(world.robot, world.q)
    end = pose[:, i + 1, :3, 3]
    beam = end - pose[:, i, :3, 3]
    length = np.linalg.norm(beam, axis=1, keepdims=True)
    along = beam / length
    force, moment = weight_and_moment(world.robot, pose, i + 1, end)
    slope = length**2 / 2.0 * np.cross(along, force) + length * moment
    lateral = force - along * np.sum(along * force, axis=1, keepdims=True)
    sag = length**3 / 3.0 * lateral + length**2 / 2.0 * np.cross(moment, along)
    links = np.zeros((*world.q.shape, 6))
    inward = pose[:, i + 1, :3, :3].swapaxes(1, 2)
    links[:, i, :3] = np.einsum("mij,mj->mi", inward, slope)
    links[:, i, 3:] = np.einsum("mij,mj->mi", inward, sag)
    return replace(zero_deviation(world), links=links)


def gravity_compensator(
    world: MeasuredArm, cause: GapCause, rng: np.random.Generator
) -> ArmDeviation:
    """A spring from the base to the link turns its joint: dq = k a L sin(q - phi) (1 - s0/s)."""
    a, arm = rng.uniform(0.2, 0.3), rng.uniform(0.5, 0.6)
    rest = rng.uniform(0.4, 0.95) * (arm - a)  # always in tension, shortest near upright
    angle = joint_values_of_cause(world, cause) - rng.normal(0.0, 0.2)
    spring = np.sqrt(a**2 + arm**2 - 2.0 * a * arm * np.cos(angle))
    return joint_rotation_deviation(
        world, cause.place, a * arm * np.sin(angle) * (1.0 - rest / spring)
    )


def joint_wave_deviation(
    world: MeasuredArm, cause: GapCause, waves_per_turn: float, rng: np.random.Generator
) -> ArmDeviation:
    """dq = sin(times q + phase)."""
    phase = rng.uniform(0.0, 2.0 * np.pi)
    return joint_rotation_deviation(
        world, cause.place, np.sin(waves_per_turn * joint_values_of_cause(world, cause) + phase)
    )


def gear_error(world: MeasuredArm, cause: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """Eccentricity: once or twice a turn of the joint [amplitude in rad]."""
    return joint_wave_deviation(world, cause, gear_waves_per_turn(world.arm, cause), rng)


def gear_error_of_odd_order(
    world: MeasuredArm, cause: GapCause, rng: np.random.Generator
) -> ArmDeviation:
    """A wave of 1.3 a turn: neither once nor twice [amplitude in rad]."""
    return joint_wave_deviation(world, cause, 1.3, rng)


def gear_ripple(world: MeasuredArm, cause: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """A wave at the gear ratio or twice it, or where the file tells none at some other number."""
    return joint_wave_deviation(world, cause, gear_waves_per_turn(world.arm, cause), rng)


def gear_waves_per_turn(arm: ArmKnowledge, cause: GapCause) -> float:
    """Waves a turn of a gear's error, by the cause's variant."""
    twice = cause.variant % 2
    if cause.effect == "gear_error":
        return (1.0, 2.0)[twice]
    ratio = arm.ratio[index_from_place(cause.place)]
    return ratio * (1.0, 2.0)[twice] if np.isfinite(ratio) else arm.ripple[twice]


def encoder_gain(world: MeasuredArm, cause: GapCause, _: np.random.Generator) -> ArmDeviation:
    """dq = g q."""
    return joint_rotation_deviation(world, cause.place, joint_values_of_cause(world, cause))


def joint_coupling(world: MeasuredArm, cause: GapCause, _: np.random.Generator) -> ArmDeviation:
    """A joint turned by the motor of another: dq_j = c q_i."""
    return joint_rotation_deviation(
        world, cause.place, world.q[:, dict(world.arm.driven)[cause.place] - 1]
    )


def backlash(world: MeasuredArm, cause: GapCause, _: np.random.Generator) -> ArmDeviation:
    """dq = b sign(last move) [half the play, rad]."""
    return joint_rotation_deviation(
        world, cause.place, np.sign(world.move[:, index_from_place(cause.place)])
    )


def backlash_growing_with_travel(
    world: MeasuredArm, cause: GapCause, _: np.random.Generator
) -> ArmDeviation:
    """Play that grows with the distance of the last move."""
    move = world.move[:, index_from_place(cause.place)]
    return joint_rotation_deviation(
        world, cause.place, np.sign(move) * (0.3 + np.abs(move) / np.pi)
    )


def settling(world: MeasuredArm, cause: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """A rest of the last move is still to come: dq = -e (q_n - q_(n-1))."""
    return all_joints_rotation_deviation(world, cause.place, -world.move, rng)


def thermal_growth(world: MeasuredArm, _: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """Lengths grow by strain (1 - exp(-t / tau))."""
    tau = world.warm * rng.uniform(0.8, 1.25)
    lengths = np.zeros((*world.q.shape, 2))
    for joint, column in world.arm.hot:
        nominal = world.robot.mdh[joint - 1, column]
        lengths[:, joint - 1, column] = nominal * -np.expm1(-world.time / tau)
    return replace(zero_deviation(world), lengths=lengths)


def base_flex(world: MeasuredArm, _: GapCause, __: np.random.Generator) -> ArmDeviation:
    """The foot turns by C times the overturning moment [rad/(N m)]."""
    pose, up = link_frames(world.robot, world.q), world.robot.up
    about = pose[:, 1, :3, 3] if world.robot.prismatic[0] else np.zeros((len(pose), 3))
    moment = weight_and_moment(world.robot, pose, 0, about)[1]
    return base_motion_deviation(world, moment - np.outer(moment @ up, up))


def frame_drift(world: MeasuredArm, cause: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """Base against instrument, in proportion to time or slowing down [m at the end]."""
    share = world.time / world.time.max()
    slowing = -np.expm1(-3.0 * share)
    course = slowing if cause.variant % 2 else share
    direction = np.concatenate([rng.normal(size=3) * 0.5, rng.normal(size=3)])
    return replace(zero_deviation(world), base=np.outer(course, direction))


def tool_flex(world: MeasuredArm, _: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """The bracket tips towards gravity about its foot, and sags along its axis [rad]."""
    flange = link_frames(world.robot, world.q)[:, -1, :3, :3]
    down = -np.einsum("mij,i->mj", flange, world.robot.up)
    tool = np.zeros((len(down), 6))
    tool[:, :3] = np.cross([0.0, 0.0, 1.0], down)
    tool[:, 5] = rng.uniform(0.02, 0.06) * down[:, 2]
    return replace(zero_deviation(world), tool=tool)


def target_offset(world: MeasuredArm, cause: GapCause, _: np.random.Generator) -> ArmDeviation:
    """A target, or all, are seen too far along the line of sight [m]."""
    sight = np.zeros((len(world.q), len(world.spots)))
    sight[:, slice(None) if cause.place == "all" else index_from_place(cause.place)] = 1.0
    return replace(zero_deviation(world), sight=sight)


def target_shift(world: MeasuredArm, cause: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """A nest moves on the flange after some visit [m]."""
    m, k = len(world.q), len(world.spots)
    spots = np.zeros((m, k, 3))
    way = rng.normal(size=3)
    spots[round(m * rng.uniform(0.3, 0.7)) :, index_from_place(cause.place)] = way / np.linalg.norm(
        way
    )
    return replace(zero_deviation(world), spots=spots)


def outliers(world: MeasuredArm, _: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """Three points in a hundred are off by 0.3 to 1 [amplitude 1 mm makes that millimetres]."""
    m, k = len(world.q), len(world.spots)
    points = np.zeros((m * k, 3))
    chosen = rng.choice(m * k, max(2, round(0.03 * m * k)), replace=False)
    way = rng.normal(size=(len(chosen), 3))
    size = rng.uniform(0.3, 1.0, (len(chosen), 1))
    points[chosen] = size * way / np.linalg.norm(way, axis=1, keepdims=True)
    return replace(zero_deviation(world), points=points.reshape(m, k, 3))


def swapped_rows(world: MeasuredArm, _: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """Two pairs of training rows hold each other's points [amplitude 1 swaps them whole]."""
    y = measured_points_without_noise(world, zero_deviation(world))
    rows = rng.choice(np.flatnonzero(world.train), 4, replace=False)
    points = np.zeros_like(y)
    points[rows] = y[rows[[1, 0, 3, 2]]] - y[rows]
    return replace(zero_deviation(world), points=points)


def joint_values_of_two_joints(
    world: MeasuredArm, cause: GapCause, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Joint values (m,) of the place's joint and of another [rad]."""
    others = [i for i in range(world.q.shape[1]) if i != index_from_place(cause.place)]
    return joint_values_of_cause(world, cause), world.q[:, rng.choice(others)]


def outside_sum(world: MeasuredArm, cause: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """dq_j = sin(q_j + q_i + phase)."""
    q, other = joint_values_of_two_joints(world, cause, rng)
    return joint_rotation_deviation(
        world, cause.place, np.sin(q + other + rng.uniform(0.0, 2.0 * np.pi))
    )


def outside_product(world: MeasuredArm, cause: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """dq_j = q_i q_j."""
    q, other = joint_values_of_two_joints(world, cause, rng)
    return joint_rotation_deviation(world, cause.place, q * other)


def outside_waves(world: MeasuredArm, cause: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """dq_j = sin(5 q_j + phase) sin(5 q_i + phase)."""
    q, other = joint_values_of_two_joints(world, cause, rng)
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    dq = np.sin(5.0 * q + phase[0]) * np.sin(5.0 * other + phase[1])
    return joint_rotation_deviation(world, cause.place, dq)


def outside_step(world: MeasuredArm, cause: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """dq_j jumps where q_j passes an angle in the middle of its range."""
    q = joint_values_of_cause(world, cause)
    return joint_rotation_deviation(
        world, cause.place, 1.0 * (q > np.quantile(q, rng.uniform(0.3, 0.7)))
    )


def outside_cubic(world: MeasuredArm, cause: GapCause, _: np.random.Generator) -> ArmDeviation:
    """dq_j = (torque / its largest)^3."""
    load = gravity_torques(world.robot, world.q)[:, index_from_place(cause.place)]
    return joint_rotation_deviation(world, cause.place, (load / np.abs(load).max()) ** 3)


def outside_field(world: MeasuredArm, _: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """The flange is moved by a smooth random field over the first three joints."""
    waves = rng.normal(0.0, 1.5, (3, 12))
    phase, weight = rng.uniform(0.0, 2.0 * np.pi, 12), rng.normal(size=(12, 3))
    return base_motion_deviation(world, shift=np.cos(world.q[:, :3] @ waves + phase) @ weight)


def laws_by_function_name(*laws: DeviationLaw) -> dict[str, DeviationLaw]:
    """Laws by the names of their functions."""
    return {law.__name__: law for law in laws}


GAP_LAWS: dict[str, DeviationLaw] = laws_by_function_name(
    joint_compliance, link_bending, gravity_compensator, gear_error, gear_ripple, encoder_gain,
    joint_coupling, backlash, settling, thermal_growth, base_flex, frame_drift, tool_flex,
    target_offset, target_shift, outliers, swapped_rows, outside_sum, outside_product,
    outside_waves, outside_step, outside_cubic, outside_field,
)  # fmt: skip
GAP_LAWS |= {
    "joint_compliance/hardening": hardening_joint_compliance,
    "gear_error/between": gear_error_of_odd_order,
    "backlash/travel": backlash_growing_with_travel,
}
DATA_FAULT_AMPLITUDES = {
    "outliers": 1e-3,
    "swapped_rows": 1.0,
}  # amplitude at power 1: they have no lambda
LIBRARY_LAW_NAMES = tuple(law for law in GAP_LAWS if "/" not in law and "outside" not in law)
OUTSIDE_LAW_NAMES = tuple(law for law in GAP_LAWS if "outside" in law)
DISTORTED_LAW_NAMES = tuple(law for law in GAP_LAWS if "/" in law)
SIX_JOINT_NAMES = tuple(f"J{i}" for i in range(1, 7))


def list_law_places(
    law: str, arm: ArmKnowledge, joint_names: Sequence[str], target_count: int
) -> tuple[str, ...]:
    """Where a law can be on an arm with some turning joints and targets."""
    loaded, spots = (
        tuple(f"J{i}" for i in arm.loaded),
        tuple(f"smr{i + 1}" for i in range(target_count)),
    )
    every = ("all",)
    some = {
        "joint_compliance": (*loaded, "all") if loaded else (),
        "link_bending": tuple(f"L{i}" for i in arm.beams),
        "gravity_compensator": (arm.upright,) if arm.upright else (),
        "joint_coupling": tuple(place for place, _ in arm.driven),
        "thermal_growth": every,
        "base_flex": ("frame",),
        "frame_drift": ("frame",),
        "tool_flex": every if loaded else (),
        "target_offset": (*spots, "all") if target_count > 1 else every,
        "target_shift": spots if target_count > 1 else (),
        "outliers": every,
        "swapped_rows": every,
        "outside_cubic": loaded,
        "outside_field": every,
        "outside_sway": every,
        "outside_plate": every if target_count > 1 else (),
        "outside_clearance": loaded,
        "outside_settling_base": ("frame",) if loaded else (),
    }
    return some.get(law.partition("/")[0], tuple(joint_names))


def list_law_places_on_robot(law: str, robot: str) -> tuple[str, ...]:
    """Where a law can be on a robot."""
    return (
        ("all", "J1", "J3", "J5")
        if law == "settling"
        else list_law_places(law, GAP_ARMS[robot], SIX_JOINT_NAMES, 3)
    )


def format_effect_option(robot: str, cause: GapCause) -> str:
    """The cause as `calibrate` takes effects, as gear_error:J2:turns=1."""
    choice = ""
    if cause.effect.startswith("gear_"):
        choice = f":turns={gear_waves_per_turn(GAP_ARMS[robot], cause):g}"
    elif cause.effect == "joint_coupling":
        choice = f":source={dict(GAP_ARMS[robot].driven)[cause.place]}"
    return f"{cause.effect}:{cause.place}{choice}"


# ---- building a case ---------------------------------------------------------------------------


def build_told_robot(name: str) -> Robot:
    """The robot of the file that is given to the diagnosis."""
    arm = GAP_ARMS[name]
    nominal = load_robot(name)
    ratio, mass, com = (np.array(value) for value in (arm.ratio, arm.mass, arm.com))
    return replace(nominal, ratio=ratio, mass=mass, com=com)


def draw_true_robot(told_robot: Robot, rng: np.random.Generator) -> Robot:
    """The arm itself: errors of its geometry, and other masses and centres than told."""
    n, off = (
        told_robot.joints,
        perturb_link_parameters(told_robot, rng, LINK_LENGTH_SIGMA, LINK_ANGLE_SIGMA),
    )
    factor = 1.0 + RELATIVE_MASS_ERROR * np.clip(rng.normal(size=n), -2.5, 2.5)
    way = rng.normal(size=(n, 3))
    wrong = np.linalg.norm(told_robot.com, axis=1, keepdims=True) * RELATIVE_MASS_ERROR
    com = told_robot.com + wrong * way / np.linalg.norm(way, axis=1, keepdims=True)
    return replace(off, mass=told_robot.mass * factor, com=com)


def draw_poses_above_floor(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    """Joint values (count, n) over the range within one turn, the flange above the floor [rad]."""
    lower, upper = (
        np.maximum(robot.lower, -MAX_JOINT_ANGLE),
        np.minimum(robot.upper, MAX_JOINT_ANGLE),
    )
    found = np.zeros((0, robot.joints))
    while len(found) < count:
        q = rng.uniform(lower, upper, (2 * count, robot.joints))
        height = link_frames(robot, q)[:, -1, :3, 3] @ robot.up
        found = np.concatenate([found, q[height > 0.15]])
    return found[:count]


def draw_base_pose(rng: np.random.Generator) -> Array:
    """Pose of the robot's foot in the instrument's frame: (4, 4) [m]."""
    away, side = rng.uniform(2.5, 4.0), rng.uniform(-np.pi, np.pi)
    base = np.eye(4)
    base[:3, :3] = Rotation.random(rng=rng).as_matrix()
    down = base[:3, 2] * rng.uniform(-1.5, -0.5)
    flat = base[:3, :2] @ [np.cos(side), np.sin(side)]
    base[:3, 3] = down + flat * np.sqrt(away**2 - down @ down)
    return base


def draw_target_positions(rng: np.random.Generator) -> Array:
    """Three targets about 0.1 to 0.15 m off the flange's axis, in no symmetry: (3, 3) [m]."""
    angle = np.array([0.0, 1.7, 3.9]) + rng.uniform(-0.3, 0.3, 3) + rng.uniform(0.0, 2.0 * np.pi)
    radius, height = rng.uniform(0.1, 0.15, 3), rng.uniform(0.02, 0.1, 3)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def draw_measured_arm(case: GapCase, rng: np.random.Generator) -> MeasuredArm:
    """The arm in its place with all its visits."""
    told = build_told_robot(case.robot)
    q = draw_poses_above_floor(told, case.poses + HELD_OUT_POSES, rng)
    return draw_visits(case, told, GAP_ARMS[case.robot], q, REVISITED_POSES, rng)


def draw_visits(
    case: GapCase,
    told_robot: Robot,
    arm: ArmKnowledge,
    q: Array,
    revisit_count: int,
    rng: np.random.Generator,
) -> MeasuredArm:
    """An arm in its place: training poses, `revisit_count` of them twice, and held-out poses,
    mixed.

    q: (m, n) the training poses, then the others.
    """
    twice = rng.choice(case.poses, revisit_count, replace=False)
    pose = rng.permutation(np.concatenate([np.arange(len(q)), twice]))
    time = np.cumsum(MEAN_SECONDS_BETWEEN_POSES * rng.uniform(0.7, 1.3, len(pose)))
    q, move = q[pose], np.zeros((len(pose), told_robot.joints))
    move[1:] = np.diff(q, axis=0)
    return MeasuredArm(
        robot=draw_true_robot(told_robot, rng),
        told=told_robot,
        arm=arm,
        base=draw_base_pose(rng),
        spots=draw_target_positions(rng)[: case.targets],
        q=q,
        jitter=case.jitter * rng.normal(size=q.shape),
        move=move,
        time=time - time[0],
        warm=rng.uniform(1000.0, 3000.0),
        train=pose < case.poses,
    )


class InvisibleLawError(ValueError):
    """Poses at which a law shows nothing."""


def amplitude_for_detectability(
    world: MeasuredArm,
    detectability_measure: DetectabilityMeasure,
    cause: GapCause,
    unit_deviation: ArmDeviation,
) -> float:
    """Amplitude at which a law's deviation has the detectability that is asked for.

    Laws are nearly linear in it: a few corrections reach it to rounding.  Raises Unseen.
    """
    if cause.law in DATA_FAULT_AMPLITUDES or cause.power == 0.0:
        return DATA_FAULT_AMPLITUDES.get(cause.law, 1.0) * cause.power
    still = measured_points_without_noise(world, zero_deviation(world))
    amplitude = 1e-6 / max(float(np.abs(part).max()) for part in unit_deviation.list_arrays())
    for _ in range(5):
        power = detectability_measure.detectability(
            measured_points_without_noise(world, unit_deviation * amplitude) - still
        )
        if not power > 0.0:
            raise InvisibleLawError(
                f"{cause.law} at {cause.place} moves nothing that geometry does not"
            )
        amplitude *= np.sqrt(cause.power / power)
    return float(amplitude)


def draw_background_causes(case: GapCase, rng: np.random.Generator) -> tuple[GapCause, ...]:
    """The background: a small effect of random kind on every joint."""
    kinds = ("gear_error", "encoder_gain", "backlash", "joint_compliance")
    named = {(cause.effect, cause.place) for cause in case.causes}

    def one(place: str) -> GapCause:
        free = [
            k
            for k in kinds
            if place in list_law_places_on_robot(k, case.robot) and (k, place) not in named
        ]
        return GapCause(str(rng.choice(free)), place, case.background, int(rng.integers(2)))

    return tuple(map(one, SIX_JOINT_NAMES)) if case.background > 0.0 else ()


SimulateMeasurement = Callable[[MeasuredArm, ArmDeviation, Array], tuple[Robot, Measurements]]


def build_and_measure_arm(case: GapCase) -> SealedArm:
    """Build the arm of a case and measure it."""
    rng = np.random.default_rng(case.seed)

    def see(world: MeasuredArm, whole: ArmDeviation, spread: Array) -> tuple[Robot, Measurements]:
        y = measured_points_without_noise(world, whole)
        return world.told, build_measurements(
            world, y + spread[..., None] * rng.normal(size=y.shape), rng
        )

    return apply_causes_and_measure(case, draw_measured_arm(case, rng), GAP_LAWS, see, rng)


def apply_causes_and_measure(
    case: GapCase,
    world: MeasuredArm,
    laws: Mapping[str, DeviationLaw],
    simulate_measurement: SimulateMeasurement,
    rng: np.random.Generator,
) -> SealedArm:
    """Give an arm the causes of a case, each of the size that is asked for, and measure it.

    simulate_measurement: what is told of the arm, and measured; takes what all causes do to it, and
    the noise of a coordinate (m, k) [m].
    """
    still = measured_points_without_noise(world, zero_deviation(world))
    spread = case.noise * (COORDINATE_NOISE + NOISE_PER_METRE * np.linalg.norm(still, axis=-1))
    ruler = build_detectability_measure(world, spread, case.jitter)
    causes, count = (*case.causes, *draw_background_causes(case, rng)), len(case.causes)
    whole, parts, amplitudes = zero_deviation(world), list[Array](), list[float]()
    for cause in causes:
        unit = laws[cause.law](world, cause, rng)
        amplitudes.append(amplitude_for_detectability(world, ruler, cause, unit))
        whole += unit * amplitudes[-1]
        parts.append(measured_points_without_noise(world, unit * amplitudes[-1]) - still)
    robot, data = simulate_measurement(world, whole, spread)
    moved = measured_points_without_noise(world, whole) - still
    names = tuple((cause.effect, cause.place) for cause in causes)
    return SealedArm(
        case=case,
        robot=robot,
        data=data,
        true=world.robot,
        truth=names[:count],
        background=names[count:],
        displacement=moved,
        parts=np.array(parts[:count]).reshape(count, *moved.shape),
        powers=tuple(map(ruler.detectability, parts[:count])),
        power=ruler.detectability(moved),
        amplitudes=tuple(amplitudes[:count]),
        floor=ruler.floor,
    )


def build_measurements(world: MeasuredArm, y: Array, rng: np.random.Generator) -> Measurements:
    """What stands in the file.  y: (m, k, 3) with its noise [m]."""
    warm = -6.0 * np.expm1(-world.time / world.warm)
    _, same = np.unique(world.q, axis=0, return_inverse=True)
    names = np.array([f"p{i + 1:03d}" for i in rng.permutation(same.max() + 1)])
    return measurements(
        world.q,
        y,
        order=np.arange(len(y), dtype=float),
        time=np.round(world.time, 1),
        temperature=np.round(21.0 + warm + 0.1 * rng.normal(size=len(y)), 2),
        pose=names[same.reshape(-1)],
        split=np.where(world.train, "train", "holdout"),
    )


# ---- files -------------------------------------------------------------------------------------

ROBOT_FILE_NAME, DATA_FILE_NAME = "robot.json", "data.csv"


def write_diagnosis_files(sealed: SealedArm, folder: Path) -> None:
    """Leave robot.json and data.csv for the diagnosis, and nothing of the truth."""
    sealed.robot.save(folder / ROBOT_FILE_NAME)
    write_measurements(folder / DATA_FILE_NAME, sealed.data)
