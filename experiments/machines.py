"""Arms as shops have them, for the harder half of the blind study: more makes, worse conditions.

Six arms from a SCARA to a six-axis arm on a rail; poses all over, in one half of the workspace, or
in clusters; 40 to 600 of them; masses given or not; trackers whose range is better than their
angles; a few points that are slightly off; a base that creeps by microns.  Laws have the forms that
machines show: two orders of one eccentricity, two time constants, settling that saturates.

What a deviation is, how an arm moves and what lambda means stand in `gap_cases`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from experiments import gap_cases
from experiments.gap_cases import (
    COUPLED_WRIST_JOINTS,
    NO_GEAR_RATIO,
    ArmDeviation,
    ArmKnowledge,
    DeviationLaw,
    GapCase,
    GapCause,
    MeasuredArm,
    SealedArm,
    all_joints_rotation_deviation,
    base_motion_deviation,
    gravity_torques,
    index_from_place,
    joint_rotation_deviation,
    joint_values_of_cause,
    link_frames,
    measured_points_without_noise,
    weight_and_moment,
    zero_deviation,
)
from minimax_cal.core.arrays import Array
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.robots.gravity_torques import assumed_link_masses_and_centres
from minimax_cal.robots.robot import Robot, load_robot

MAX_POSE_CHOICES, SEED_STEP_BETWEEN_CHOICES = (
    5,
    1_000_000_000_000,
)  # choices of poses that may show nothing; between their seeds
MACHINE_HELD_OUT_POSES = 60
REVISITED_FRACTION = 0.1  # of the training poses, measured twice
HALF_WORKSPACE_FRACTION = 0.5  # of a joint's range, in half a workspace
POSES_PER_CLUSTER, CLUSTER_HALF_WIDTH = (
    8,
    0.06,
)  # poses of a cluster, and how far its joints scatter [rad]
OUTLIER_FRACTION, OUTLIER_SIGMAS_RANGE = 0.01, (5.0, 12.0)  # points that are slightly off
RADIAL_NOISE_FACTOR, LATERAL_NOISE_FACTOR = (
    0.5,
    1.3,
)  # noise along the line of sight and across it, of what is told
BASE_CREEP_RMS = 4e-6  # RMS of a base that wanders [m]


COUPLED_RAIL_WRIST_JOINTS = (("J4", 3), ("J6", 5), ("J7", 6))
MACHINE_MAKES = {
    "scara_600": ArmKnowledge(
        (8.0, 5.0, 2.0, 1.5), (50.0, 50.0, NO_GEAR_RATIO, NO_GEAR_RATIO), (1,), ()
    ),
    "irb120": ArmKnowledge(
        (4.0, 6.0, 4.0, 2.5, 1.0, 1.0),
        (120.0, 120.0, 100.0, NO_GEAR_RATIO, NO_GEAR_RATIO, NO_GEAR_RATIO),
        (2, 4),
        (2, 3, 5),
        driven=COUPLED_WRIST_JOINTS,
    ),
    "ur5e": ArmKnowledge(
        (4.0, 8.0, 2.8, 1.4, 1.4, 1.2), (NO_GEAR_RATIO,) * 6, (2, 3), (2, 3, 4, 5)
    ),
    "fanuc_r2000ic_165f": ArmKnowledge(
        (350.0, 200.0, 180.0, 90.0, 30.0, 60.0),
        (NO_GEAR_RATIO, 180.0, 170.0, NO_GEAR_RATIO, NO_GEAR_RATIO, NO_GEAR_RATIO),
        (2, 4),
        (2, 3, 5),
        "J2",
        COUPLED_WRIST_JOINTS,
    ),
    "rail": ArmKnowledge(
        (400.0, 95.0, 52.0, 48.0, 22.0, 7.0, 14.0),
        (NO_GEAR_RATIO, 121.0, 141.3, 105.5, NO_GEAR_RATIO, NO_GEAR_RATIO, NO_GEAR_RATIO),
        (3, 5),
        (3, 4, 6),
        "J3",
        COUPLED_RAIL_WRIST_JOINTS,
    ),
    "seven": ArmKnowledge(
        (4.0, 4.0, 3.0, 2.7, 1.7, 1.8, 1.3),
        (160.0,) * 4 + (NO_GEAR_RATIO,) * 3,
        (3, 5),
        (2, 3, 4, 6),
    ),
}


@cache
def load_nominal_arm(make: str) -> Robot:
    """The arm of a make, without masses."""
    if make == "seven":
        lengths = np.array([0.34, 0.0, 0.4, 0.0, 0.4, 0.0, 0.126])
        alpha = np.array([-1.0, 1.0, 1.0, -1.0, -1.0, 1.0, 0.0]) * np.pi / 2.0
        mdh = np.zeros((7, 5))
        mdh[:, 1], mdh[:, 3] = lengths, alpha
        limit = np.radians([170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0])
        return build_robot_without_masses(
            "seven", mdh, np.zeros(7, dtype=bool), -limit, limit, np.array([0, 0, 1.0])
        )
    if make == "rail":
        arm = load_robot("irb2600")
        mdh = np.concatenate([[[0.0, 0.0, 0.0, -np.pi / 2.0, 0.0]], arm.mdh])
        slides = np.array([True, *arm.prismatic])
        lower, upper = np.append(0.0, arm.lower), np.append(3.0, arm.upper)
        return build_robot_without_masses(
            "rail", mdh, slides, lower, upper, np.array([0.0, 1.0, 0.0])
        )
    return load_robot(make)


def build_robot_without_masses(
    name: str, mdh: Array, prismatic: Array, lower: Array, upper: Array, up: Array
) -> Robot:
    """A robot of which no masses are told."""
    n = len(mdh)
    nothing = np.full(n, np.nan)
    return Robot(name, mdh, np.ones(n), prismatic, lower, upper, nothing, nothing,
                 np.full((n, 3), np.nan), up)  # fmt: skip


# ---- what is asked for ---------------------------------------------------------------------------


@dataclass(frozen=True)
class MachineCase(GapCase):
    """One arm and its measurement, as plain data.

    spread: of its poses, whole, half or clusters.  told: whether the file tells masses.  off, oval,
    creep: whether some points are slightly off, range and angles of the tracker differ, the base
    wanders.
    """

    spread: str = "whole"
    told: bool = True
    off: bool = False
    oval: bool = False
    creep: bool = False


# ---- laws as machines show them ------------------------------------------------------------------


def gear_error_of_two_orders(
    world: MeasuredArm, cause: GapCause, rng: np.random.Generator
) -> ArmDeviation:
    """An eccentric gear: once and twice a turn."""
    q, phase = joint_values_of_cause(world, cause), rng.uniform(0.0, 2.0 * np.pi, 2)
    second = rng.uniform(0.4, 1.0) * np.sin(2.0 * q + phase[1])
    return joint_rotation_deviation(world, cause.place, np.sin(q + phase[0]) + second)


def gear_ripple_of_any_ratio(
    world: MeasuredArm, cause: GapCause, rng: np.random.Generator
) -> ArmDeviation:
    """Ripple at the gear ratio or twice that, or at a few dozen waves a turn where none is told."""
    ratio = world.told.ratio[index_from_place(cause.place)]
    times = ratio * (1 + cause.variant % 2) if np.isfinite(ratio) else rng.uniform(12.0, 60.0)
    return gap_cases.joint_wave_deviation(world, cause, times, rng)


def saturating_settling(
    world: MeasuredArm, cause: GapCause, rng: np.random.Generator
) -> ArmDeviation:
    """A rest of the last move, but never more than that of half a radian."""
    return all_joints_rotation_deviation(world, cause.place, -np.tanh(world.move / 0.5), rng)


def load_dependent_backlash(
    world: MeasuredArm, cause: GapCause, _: np.random.Generator
) -> ArmDeviation:
    """Play that closes a little under load."""
    i = index_from_place(cause.place)
    pull = np.abs(gravity_torques(world.robot, world.q)[:, i])
    side = np.sign(world.move[:, i])
    return joint_rotation_deviation(
        world, cause.place, side * (1.0 - 0.3 * pull / max(float(pull.max()), 1e-9))
    )


def thermal_growth_of_two_time_constants(
    world: MeasuredArm, cause: GapCause, rng: np.random.Generator
) -> ArmDeviation:
    """Growth by motors that warm up soon and a casting that warms up late."""
    tau = world.time.max() * rng.uniform(0.08, 0.2)
    way = 0.6 * -np.expm1(-world.time / tau) + 0.4 * -np.expm1(-world.time / (5.0 * tau))
    mdh = world.robot.mdh
    lengths = np.zeros((*world.q.shape, 2))
    lengths[:] = np.where(np.abs(mdh[:, :2]) > 0.15, mdh[:, :2], 0.0) * way[:, None, None]
    return replace(zero_deviation(world), lengths=lengths)


def gravity_compensator_of_either_side(
    world: MeasuredArm, cause: GapCause, rng: np.random.Generator
) -> ArmDeviation:
    """A spring, shortest with the arm upright or with the arm hanging."""
    i = index_from_place(cause.place)
    pose = link_frames(world.robot, world.q)
    along = pose[:, i + 1, :3, 3] - pose[:, i, :3, 3]
    axis, up = pose[:, i, :3, 2], world.robot.up
    lean = np.arctan2(np.sum(np.cross(up, along) * axis, axis=1), along @ up)
    a, arm = rng.uniform(0.2, 0.3), rng.uniform(0.5, 0.6)
    angle = lean - rng.normal(0.0, 0.2) + np.pi * (cause.variant % 2)
    length = np.sqrt(a**2 + arm**2 - 2.0 * a * arm * np.cos(angle))
    rest = rng.uniform(0.4, 0.95) * (arm - a)
    return joint_rotation_deviation(world, cause.place, np.sin(angle) * (1.0 - rest / length))


# ---- what no library holds -----------------------------------------------------------------------


def worn_sector_play(world: MeasuredArm, cause: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """Play in one sector of the joint alone."""
    q = joint_values_of_cause(world, cause)
    low, high = np.quantile(q, np.sort(rng.uniform(0.0, 0.5, 1))[0] + [0.0, 0.4])
    side = np.sign(world.move[:, index_from_place(cause.place)])
    return joint_rotation_deviation(world, cause.place, np.where((q > low) & (q < high), side, 0.0))


def drift_by_recent_work(
    world: MeasuredArm, cause: GapCause, _: np.random.Generator
) -> ArmDeviation:
    """A joint that drifts with the work of its last dozen moves."""
    fade, work = 0.0, []
    for move in np.abs(world.move[:, index_from_place(cause.place)]):
        fade = 0.92 * fade + move
        work.append(fade)
    return joint_rotation_deviation(world, cause.place, np.array(work))


def cable_pull(world: MeasuredArm, cause: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """A cable pulls a joint as two others wind it up."""
    i = index_from_place(cause.place)
    others = rng.choice([j for j in range(world.q.shape[1]) if j != i], 2, replace=False)
    a, b = world.q[:, others].T
    return joint_rotation_deviation(
        world, cause.place, np.abs(a) * np.sin(1.5 * b + rng.uniform(0.0, 2.0 * np.pi))
    )


def swaying_floor(world: MeasuredArm, _: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """A hall that tilts to and fro as the sun and the crane move."""
    t = world.time / world.time.max()
    wave = np.sin(2.0 * np.pi * rng.uniform(2.0, 5.0) * t)
    return base_motion_deviation(world, wave[:, None] * rng.normal(size=3))


# ---- mechanisms and memories: directions and pasts that no law of one joint's pose has -----------


def loose_target_plate(world: MeasuredArm, _: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """The target plate rocks as one body on its bolts, and reaches its stops soon."""
    pose = link_frames(world.robot, world.q)
    down = -np.einsum("mji,j->mi", pose[:, -1, :3, :3], world.robot.up)
    seated = np.tanh(3.0 * down)
    tool = np.concatenate([seated @ rng.normal(size=(3, 3)),
                           0.1 * (down * down) @ rng.normal(size=(3, 3))], axis=1)  # fmt: skip
    return replace(zero_deviation(world), tool=tool)


def bearing_clearance(world: MeasuredArm, cause: GapCause, _: np.random.Generator) -> ArmDeviation:
    """A joint's axis tilts with the moment across it until the bearing's clearance is used up."""
    i = index_from_place(cause.place)
    pose = link_frames(world.robot, world.q)
    moment = weight_and_moment(world.robot, pose, i, pose[:, i, :3, 3])[1]
    across = np.einsum("mji,mj->mi", pose[:, i + 1, :3, :3], moment)
    axis = np.einsum("mji,mj->mi", pose[:, i + 1, :3, :3], pose[:, i, :3, 2])
    across = across - np.sum(across * axis, axis=1, keepdims=True) * axis
    size = np.linalg.norm(across, axis=1, keepdims=True)
    links = np.zeros((*world.q.shape, 6))
    links[:, i, :3] = across / np.maximum(size, 1e-12) * np.tanh(2.0 * size / max(size.max(), 1e-9))
    return replace(zero_deviation(world), links=links)


def settling_base_foot(world: MeasuredArm, _: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """The foot follows the overturning moments of the last dozen poses."""
    pose = link_frames(world.robot, world.q)
    moment = weight_and_moment(world.robot, pose, 0, np.zeros((len(pose), 3)))[1]
    past, fade = np.zeros_like(moment), np.zeros(3)
    keep = rng.uniform(0.8, 0.92)
    for row, now in enumerate(moment):
        past[row] = fade = keep * fade + (1.0 - keep) * now
    return base_motion_deviation(world, past)


def gear_hysteresis(world: MeasuredArm, cause: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """A gear that winds up in its friction: it remembers where its joint last turned back."""
    i, wound = index_from_place(cause.place), 0.0
    most = rng.uniform(0.8, 1.6) * float(np.median(np.abs(world.move[:, i])))
    out = []
    for move in world.move[:, i]:
        wound = float(np.clip(wound + move, -most, most))
        out.append(-wound)
    return joint_rotation_deviation(world, cause.place, np.array(out))


def two_seat_joint(world: MeasuredArm, cause: GapCause, rng: np.random.Generator) -> ArmDeviation:
    """A joint that comes to rest on one of two seats, whichever it happens to be."""
    return joint_rotation_deviation(world, cause.place, rng.choice((-1.0, 1.0), len(world.q)))


GAP_CASE_LAWS = gap_cases.GAP_LAWS
MACHINE_LAWS: dict[str, DeviationLaw] = {
    **{name: GAP_CASE_LAWS[name] for name in (
        "joint_compliance", "link_bending", "gear_error", "encoder_gain", "backlash", "settling",
        "frame_drift", "tool_flex", "target_offset", "target_shift", "joint_compliance/hardening",
        "outside_sum", "outside_product", "outside_waves", "outside_cubic",
        "outside_field",
    )},
    "gear_error/orders": gear_error_of_two_orders,
    "joint_error_map/step": GAP_CASE_LAWS["outside_step"],
    "gear_ripple": gear_ripple_of_any_ratio,
    "settling/saturating": saturating_settling,
    "backlash/loaded": load_dependent_backlash,
    "thermal_growth/two": thermal_growth_of_two_time_constants,
    "gravity_compensator": gravity_compensator_of_either_side,
    "joint_coupling": GAP_CASE_LAWS["joint_coupling"],
    "base_flex": GAP_CASE_LAWS["base_flex"],
    "outside_worn": worn_sector_play,
    "outside_weary": drift_by_recent_work,
    "outside_cable": cable_pull,
    "outside_sway": swaying_floor,
}  # fmt: skip
MECHANISM_LAWS: dict[str, DeviationLaw] = {
    "outside_plate": loose_target_plate,
    "outside_clearance": bearing_clearance,
    "outside_settling_base": settling_base_foot,
    "outside_hysteresis": gear_hysteresis,
    "outside_seats": two_seat_joint,
}
OUTSIDE_MACHINE_LAWS = tuple(law for law in MACHINE_LAWS if "outside" in law)
MACHINE_LAWS |= MECHANISM_LAWS
INSIDE_MACHINE_LAWS = tuple(
    law for law in MACHINE_LAWS if "outside" not in law and law != "joint_compliance/hardening"
)


def list_law_places(law: str, make_name: str, target_count: int) -> tuple[str, ...]:
    """Where a law can be on an arm."""
    joints = [f"J{i + 1}" for i in np.flatnonzero(~load_nominal_arm(make_name).prismatic)]
    if law.partition("/")[0] == "settling":
        return "all", joints[0], joints[1]
    return gap_cases.list_law_places(law, MACHINE_MAKES[make_name], joints, target_count)


# ---- building a case -----------------------------------------------------------------------------


def build_told_robot(case: MachineCase) -> Robot:
    """The robot of the file, with the masses that it would tell."""
    known, arm = MACHINE_MAKES[case.robot], load_nominal_arm(case.robot)
    rng = np.random.default_rng(len(case.robot))
    _, halfway = assumed_link_masses_and_centres(arm.mdh)
    com = halfway + rng.normal(0.0, 0.02, halfway.shape)
    mass, ratio = np.array(known.mass), np.array(known.ratio)
    return replace(arm, name=case.robot, mass=mass, com=com, ratio=ratio)


def draw_poses_of_spread(robot: Robot, count: int, spread: str, rng: np.random.Generator) -> Array:
    """Joint values (count, n) as the spread has them, the flange above the floor [rad, m]."""
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    lower, upper = (
        np.where(np.isfinite(lower), lower, -2.0),
        np.where(np.isfinite(upper), upper, 2.0),
    )
    if spread == "half":
        for j in rng.choice(min(3, robot.joints), 2, replace=False):
            low = rng.uniform(0.0, 1.0 - HALF_WORKSPACE_FRACTION) * (upper[j] - lower[j])
            lower[j], upper[j] = (
                lower[j] + low,
                lower[j] + low + HALF_WORKSPACE_FRACTION * (upper[j] - lower[j]),
            )

    def above(q: Array) -> Array:
        pose = link_frames(robot, q)
        height = (pose[:, -1, :3, 3] - pose[:, 0, :3, 3]) @ robot.up
        return q[height > 0.05]

    many = -(-count // POSES_PER_CLUSTER) if spread == "clusters" else count
    found = np.zeros((0, robot.joints))
    while len(found) < many:
        found = np.concatenate([found, above(rng.uniform(lower, upper, (2 * many, robot.joints)))])
    found = found[:many]
    if spread != "clusters":
        return found
    found = np.repeat(found, POSES_PER_CLUSTER, axis=0)[:count]
    return np.clip(found + CLUSTER_HALF_WIDTH * rng.uniform(-1.0, 1.0, found.shape), lower, upper)


def draw_measured_arm(case: MachineCase, rng: np.random.Generator) -> MeasuredArm:
    """The arm in its place with all its visits; of clusters whole ones are held out."""
    told = build_told_robot(case)
    q = [
        draw_poses_of_spread(told, count, case.spread, rng)
        for count in (case.poses, MACHINE_HELD_OUT_POSES)
    ]
    again = round(REVISITED_FRACTION * case.poses)
    return gap_cases.draw_visits(
        case, told, MACHINE_MAKES[case.robot], np.concatenate(q), again, rng
    )


def build_and_measure_arm(
    case: MachineCase, laws: Mapping[str, DeviationLaw] = MACHINE_LAWS
) -> SealedArm:
    """Build the arm of a case and measure it; where its poses show nothing of a law, others."""
    for more in range(MAX_POSE_CHOICES):
        try:
            return build_arm_of_seed(
                replace(case, seed=case.seed + more * SEED_STEP_BETWEEN_CHOICES), laws
            )
        except gap_cases.InvisibleLawError:
            continue
    raise ValueError(f"{case.causes} show nothing at {MAX_POSE_CHOICES} choices of the poses")


def build_arm_of_seed(case: MachineCase, laws: Mapping[str, DeviationLaw]) -> SealedArm:
    """The arm of a case by its seed, measured.  Raises Unseen."""
    rng = np.random.default_rng(case.seed)

    def see(world: MeasuredArm, whole: ArmDeviation, spread: Array) -> tuple[Robot, Measurements]:
        y = measured_points_without_noise(
            world, whole + draw_base_creep(world, rng) if case.creep else whole
        )
        data = build_measurements(world, y + draw_instrument_noise(case, y, spread, rng))
        unknown = np.full((world.told.joints, 4), NO_GEAR_RATIO)
        told = replace(world.told, mass=unknown[:, 0], com=unknown[:, 1:])
        return world.told if case.told else told, data

    return gap_cases.apply_causes_and_measure(case, draw_measured_arm(case, rng), laws, see, rng)


def draw_instrument_noise(
    case: MachineCase, y: Array, spread: Array, rng: np.random.Generator
) -> Array:
    """(m, k, 3) what the instrument adds [m].  spread: (m, k) of a coordinate."""
    out = spread[..., None] * rng.normal(size=y.shape)
    if case.oval:
        sight = y / np.linalg.norm(y, axis=-1, keepdims=True)
        along = np.sum(out * sight, axis=-1, keepdims=True) * sight
        out = RADIAL_NOISE_FACTOR * along + LATERAL_NOISE_FACTOR * (out - along)
    if case.off:
        off = rng.random(spread.shape) < OUTLIER_FRACTION
        way = rng.normal(size=y.shape)
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        size = rng.uniform(*OUTLIER_SIGMAS_RANGE, spread.shape) * spread
        out = out + (off * size)[..., None] * way
    return out


def draw_base_creep(world: MeasuredArm, rng: np.random.Generator) -> ArmDeviation:
    """A base that wanders by microns."""
    walk = np.cumsum(rng.normal(size=(len(world.q), 3)), axis=0)
    walk = walk - walk.mean(axis=0)
    return base_motion_deviation(
        world, shift=BASE_CREEP_RMS * walk / np.sqrt(np.mean(np.sum(walk**2, axis=1)))
    )


def build_measurements(world: MeasuredArm, y: Array) -> Measurements:
    """What stands in the file.  y: (m, k, 3) with its noise [m]."""
    data = measurements(
        world.q,
        y,
        order=np.arange(len(y), dtype=float),
        time=np.round(world.time, 1),
        split=np.where(world.train, "train", "holdout"),
    )
    return replace(data, sliding=world.told.prismatic)
