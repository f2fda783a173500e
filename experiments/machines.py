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
    NAN,
    WRISTS,
    Arm,
    Case,
    Cause,
    Deviation,
    Law,
    Sealed,
    World,
    at_base,
    at_joint,
    at_joints,
    frames,
    load,
    measure,
    number,
    own,
    rigid,
    torque,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.robots.gravity import tubes
from minimax_cal.robots.robot import Robot, load_robot

TRIES, NEXT = 5, 1_000_000_000_000  # choices of poses that may show nothing; between their seeds
HELD_OUT = 60
REVISITED = 0.1  # of the training poses, measured twice
HALF = 0.5  # of a joint's range, in half a workspace
CLUSTER, WIDTH = 8, 0.06  # poses of a cluster, and how far its joints scatter [rad]
OFF_SHARE, OFF_SIGMAS = 0.01, (5.0, 12.0)  # points that are slightly off
RADIAL, ACROSS = 0.5, 1.3  # noise along the line of sight and across it, of what is told
CREEP = 4e-6  # RMS of a base that wanders [m]


ON_RAIL = (("J4", 3), ("J6", 5), ("J7", 6))
MAKES = {
    "scara_600": Arm((8.0, 5.0, 2.0, 1.5), (50.0, 50.0, NAN, NAN), (1,), ()),
    "irb120": Arm(
        (4.0, 6.0, 4.0, 2.5, 1.0, 1.0), (120.0, 120.0, 100.0, NAN, NAN, NAN), (2, 4), (2, 3, 5),
        driven=WRISTS,
    ),
    "ur5e": Arm((4.0, 8.0, 2.8, 1.4, 1.4, 1.2), (NAN,) * 6, (2, 3), (2, 3, 4, 5)),
    "fanuc_r2000ic_165f": Arm(
        (350.0, 200.0, 180.0, 90.0, 30.0, 60.0), (NAN, 180.0, 170.0, NAN, NAN, NAN), (2, 4),
        (2, 3, 5), "J2", WRISTS,
    ),
    "rail": Arm(
        (400.0, 95.0, 52.0, 48.0, 22.0, 7.0, 14.0), (NAN, 121.0, 141.3, 105.5, NAN, NAN, NAN),
        (3, 5), (3, 4, 6), "J3", ON_RAIL,
    ),
    "seven": Arm(
        (4.0, 4.0, 3.0, 2.7, 1.7, 1.8, 1.3), (160.0,) * 4 + (NAN,) * 3, (3, 5), (2, 3, 4, 6),
    ),
}  # fmt: skip


@cache
def nominal(make: str) -> Robot:
    """The arm of a make, without masses."""
    if make == "seven":
        lengths = np.array([0.34, 0.0, 0.4, 0.0, 0.4, 0.0, 0.126])
        alpha = np.array([-1.0, 1.0, 1.0, -1.0, -1.0, 1.0, 0.0]) * np.pi / 2.0
        mdh = np.zeros((7, 5))
        mdh[:, 1], mdh[:, 3] = lengths, alpha
        limit = np.radians([170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0])
        return bare("seven", mdh, np.zeros(7, dtype=bool), -limit, limit, np.array([0, 0, 1.0]))
    if make == "rail":
        arm = load_robot("irb2600")
        mdh = np.concatenate([[[0.0, 0.0, 0.0, -np.pi / 2.0, 0.0]], arm.mdh])
        slides = np.array([True, *arm.prismatic])
        lower, upper = np.append(0.0, arm.lower), np.append(3.0, arm.upper)
        return bare("rail", mdh, slides, lower, upper, np.array([0.0, 1.0, 0.0]))
    return load_robot(make)


def bare(name: str, mdh: Array, prismatic: Array, lower: Array, upper: Array, up: Array) -> Robot:
    """A robot of which no masses are told."""
    n = len(mdh)
    nothing = np.full(n, np.nan)
    return Robot(name, mdh, np.ones(n), prismatic, lower, upper, nothing, nothing,
                 np.full((n, 3), np.nan), up)  # fmt: skip


# ---- what is asked for ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Asked(Case):
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


def two_orders(world: World, cause: Cause, rng: np.random.Generator) -> Deviation:
    """An eccentric gear: once and twice a turn."""
    q, phase = own(world, cause), rng.uniform(0.0, 2.0 * np.pi, 2)
    second = rng.uniform(0.4, 1.0) * np.sin(2.0 * q + phase[1])
    return at_joint(world, cause.place, np.sin(q + phase[0]) + second)


def ripple(world: World, cause: Cause, rng: np.random.Generator) -> Deviation:
    """Ripple at the gear ratio or twice that, or at a few dozen waves a turn where none is told."""
    ratio = world.told.ratio[number(cause.place)]
    times = ratio * (1 + cause.variant % 2) if np.isfinite(ratio) else rng.uniform(12.0, 60.0)
    return gap_cases.wave(world, cause, times, rng)


def saturating(world: World, cause: Cause, rng: np.random.Generator) -> Deviation:
    """A rest of the last move, but never more than that of half a radian."""
    return at_joints(world, cause.place, -np.tanh(world.move / 0.5), rng)


def loaded_play(world: World, cause: Cause, _: np.random.Generator) -> Deviation:
    """Play that closes a little under load."""
    i = number(cause.place)
    pull = np.abs(torque(world.robot, world.q)[:, i])
    side = np.sign(world.move[:, i])
    return at_joint(world, cause.place, side * (1.0 - 0.3 * pull / max(float(pull.max()), 1e-9)))


def two_constants(world: World, cause: Cause, rng: np.random.Generator) -> Deviation:
    """Growth by motors that warm up soon and a casting that warms up late."""
    tau = world.time.max() * rng.uniform(0.08, 0.2)
    way = 0.6 * -np.expm1(-world.time / tau) + 0.4 * -np.expm1(-world.time / (5.0 * tau))
    mdh = world.robot.mdh
    lengths = np.zeros((*world.q.shape, 2))
    lengths[:] = np.where(np.abs(mdh[:, :2]) > 0.15, mdh[:, :2], 0.0) * way[:, None, None]
    return replace(rigid(world), lengths=lengths)


def balance(world: World, cause: Cause, rng: np.random.Generator) -> Deviation:
    """A spring, shortest with the arm upright or with the arm hanging."""
    i = number(cause.place)
    pose = frames(world.robot, world.q)
    along = pose[:, i + 1, :3, 3] - pose[:, i, :3, 3]
    axis, up = pose[:, i, :3, 2], world.robot.up
    lean = np.arctan2(np.sum(np.cross(up, along) * axis, axis=1), along @ up)
    a, arm = rng.uniform(0.2, 0.3), rng.uniform(0.5, 0.6)
    angle = lean - rng.normal(0.0, 0.2) + np.pi * (cause.variant % 2)
    length = np.sqrt(a**2 + arm**2 - 2.0 * a * arm * np.cos(angle))
    rest = rng.uniform(0.4, 0.95) * (arm - a)
    return at_joint(world, cause.place, np.sin(angle) * (1.0 - rest / length))


# ---- what no library holds -----------------------------------------------------------------------


def worn(world: World, cause: Cause, rng: np.random.Generator) -> Deviation:
    """Play in one sector of the joint alone."""
    q = own(world, cause)
    low, high = np.quantile(q, np.sort(rng.uniform(0.0, 0.5, 1))[0] + [0.0, 0.4])
    side = np.sign(world.move[:, number(cause.place)])
    return at_joint(world, cause.place, np.where((q > low) & (q < high), side, 0.0))


def weary(world: World, cause: Cause, _: np.random.Generator) -> Deviation:
    """A joint that drifts with the work of its last dozen moves."""
    fade, work = 0.0, []
    for move in np.abs(world.move[:, number(cause.place)]):
        fade = 0.92 * fade + move
        work.append(fade)
    return at_joint(world, cause.place, np.array(work))


def cable(world: World, cause: Cause, rng: np.random.Generator) -> Deviation:
    """A cable pulls a joint as two others wind it up."""
    i = number(cause.place)
    others = rng.choice([j for j in range(world.q.shape[1]) if j != i], 2, replace=False)
    a, b = world.q[:, others].T
    return at_joint(world, cause.place, np.abs(a) * np.sin(1.5 * b + rng.uniform(0.0, 2.0 * np.pi)))


def swaying(world: World, _: Cause, rng: np.random.Generator) -> Deviation:
    """A hall that tilts to and fro as the sun and the crane move."""
    t = world.time / world.time.max()
    wave = np.sin(2.0 * np.pi * rng.uniform(2.0, 5.0) * t)
    return at_base(world, wave[:, None] * rng.normal(size=3))


# ---- mechanisms and memories: directions and pasts that no law of one joint's pose has -----------


def loose_plate(world: World, _: Cause, rng: np.random.Generator) -> Deviation:
    """The target plate rocks as one body on its bolts, and reaches its stops soon."""
    pose = frames(world.robot, world.q)
    down = -np.einsum("mji,j->mi", pose[:, -1, :3, :3], world.robot.up)
    seated = np.tanh(3.0 * down)
    tool = np.concatenate([seated @ rng.normal(size=(3, 3)),
                           0.1 * (down * down) @ rng.normal(size=(3, 3))], axis=1)  # fmt: skip
    return replace(rigid(world), tool=tool)


def bearing_clearance(world: World, cause: Cause, _: np.random.Generator) -> Deviation:
    """A joint's axis tilts with the moment across it until the bearing's clearance is used up."""
    i = number(cause.place)
    pose = frames(world.robot, world.q)
    moment = load(world.robot, pose, i, pose[:, i, :3, 3])[1]
    across = np.einsum("mji,mj->mi", pose[:, i + 1, :3, :3], moment)
    axis = np.einsum("mji,mj->mi", pose[:, i + 1, :3, :3], pose[:, i, :3, 2])
    across = across - np.sum(across * axis, axis=1, keepdims=True) * axis
    size = np.linalg.norm(across, axis=1, keepdims=True)
    links = np.zeros((*world.q.shape, 6))
    links[:, i, :3] = across / np.maximum(size, 1e-12) * np.tanh(2.0 * size / max(size.max(), 1e-9))
    return replace(rigid(world), links=links)


def settling_base(world: World, _: Cause, rng: np.random.Generator) -> Deviation:
    """The foot follows the overturning moments of the last dozen poses."""
    pose = frames(world.robot, world.q)
    moment = load(world.robot, pose, 0, np.zeros((len(pose), 3)))[1]
    past, fade = np.zeros_like(moment), np.zeros(3)
    keep = rng.uniform(0.8, 0.92)
    for row, now in enumerate(moment):
        past[row] = fade = keep * fade + (1.0 - keep) * now
    return at_base(world, past)


def hysteresis(world: World, cause: Cause, rng: np.random.Generator) -> Deviation:
    """A gear that winds up in its friction: it remembers where its joint last turned back."""
    i, wound = number(cause.place), 0.0
    most = rng.uniform(0.8, 1.6) * float(np.median(np.abs(world.move[:, i])))
    out = []
    for move in world.move[:, i]:
        wound = float(np.clip(wound + move, -most, most))
        out.append(-wound)
    return at_joint(world, cause.place, np.array(out))


def two_seats(world: World, cause: Cause, rng: np.random.Generator) -> Deviation:
    """A joint that comes to rest on one of two seats, whichever it happens to be."""
    return at_joint(world, cause.place, rng.choice((-1.0, 1.0), len(world.q)))


KNOWN = gap_cases.LAWS
LAWS: dict[str, Law] = {
    **{name: KNOWN[name] for name in (
        "joint_compliance", "link_bending", "gear_error", "encoder_gain", "backlash", "settling",
        "frame_drift", "tool_flex", "target_offset", "target_shift", "joint_compliance/hardening",
        "outside_sum", "outside_product", "outside_waves", "outside_cubic",
        "outside_field",
    )},
    "gear_error/orders": two_orders,
    "joint_error_map/step": KNOWN["outside_step"],
    "gear_ripple": ripple,
    "settling/saturating": saturating,
    "backlash/loaded": loaded_play,
    "thermal_growth/two": two_constants,
    "gravity_compensator": balance,
    "joint_coupling": KNOWN["joint_coupling"],
    "base_flex": KNOWN["base_flex"],
    "outside_worn": worn,
    "outside_weary": weary,
    "outside_cable": cable,
    "outside_sway": swaying,
}  # fmt: skip
MECHANISMS: dict[str, Law] = {
    "outside_plate": loose_plate,
    "outside_clearance": bearing_clearance,
    "outside_settling_base": settling_base,
    "outside_hysteresis": hysteresis,
    "outside_seats": two_seats,
}
OUTSIDE = tuple(law for law in LAWS if "outside" in law)
LAWS |= MECHANISMS
INSIDE = tuple(law for law in LAWS if "outside" not in law and law != "joint_compliance/hardening")


def places(law: str, make: str, targets: int) -> tuple[str, ...]:
    """Where a law can be on an arm."""
    joints = [f"J{i + 1}" for i in np.flatnonzero(~nominal(make).prismatic)]
    if law.partition("/")[0] == "settling":
        return "all", joints[0], joints[1]
    return gap_cases.places_of(law, MAKES[make], joints, targets)


# ---- building a case -----------------------------------------------------------------------------


def told_robot(asked: Asked) -> Robot:
    """The robot of the file, with the masses that it would tell."""
    known, arm = MAKES[asked.robot], nominal(asked.robot)
    rng = np.random.default_rng(len(asked.robot))
    _, halfway = tubes(arm.mdh)
    com = halfway + rng.normal(0.0, 0.02, halfway.shape)
    mass, ratio = np.array(known.mass), np.array(known.ratio)
    return replace(arm, name=asked.robot, mass=mass, com=com, ratio=ratio)


def some_poses(robot: Robot, count: int, spread: str, rng: np.random.Generator) -> Array:
    """Joint values (count, n) as the spread has them, the flange above the floor [rad, m]."""
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    lower, upper = (
        np.where(np.isfinite(lower), lower, -2.0),
        np.where(np.isfinite(upper), upper, 2.0),
    )
    if spread == "half":
        for j in rng.choice(min(3, robot.joints), 2, replace=False):
            low = rng.uniform(0.0, 1.0 - HALF) * (upper[j] - lower[j])
            lower[j], upper[j] = lower[j] + low, lower[j] + low + HALF * (upper[j] - lower[j])

    def above(q: Array) -> Array:
        pose = frames(robot, q)
        height = (pose[:, -1, :3, 3] - pose[:, 0, :3, 3]) @ robot.up
        return q[height > 0.05]

    many = -(-count // CLUSTER) if spread == "clusters" else count
    found = np.zeros((0, robot.joints))
    while len(found) < many:
        found = np.concatenate([found, above(rng.uniform(lower, upper, (2 * many, robot.joints)))])
    found = found[:many]
    if spread != "clusters":
        return found
    found = np.repeat(found, CLUSTER, axis=0)[:count]
    return np.clip(found + WIDTH * rng.uniform(-1.0, 1.0, found.shape), lower, upper)


def world_of(asked: Asked, rng: np.random.Generator) -> World:
    """The arm in its place with all its visits; of clusters whole ones are held out."""
    told = told_robot(asked)
    q = [some_poses(told, count, asked.spread, rng) for count in (asked.poses, HELD_OUT)]
    again = round(REVISITED * asked.poses)
    return gap_cases.visited(asked, told, MAKES[asked.robot], np.concatenate(q), again, rng)


def make(asked: Asked, laws: Mapping[str, Law] = LAWS) -> Sealed:
    """Build the arm of a case and measure it; where its poses show nothing of a law, others."""
    for more in range(TRIES):
        try:
            return made_of(replace(asked, seed=asked.seed + more * NEXT), laws)
        except gap_cases.Unseen:
            continue
    raise ValueError(f"{asked.causes} show nothing at {TRIES} choices of the poses")


def made_of(asked: Asked, laws: Mapping[str, Law]) -> Sealed:
    """The arm of a case by its seed, measured.  Raises Unseen."""
    rng = np.random.default_rng(asked.seed)

    def see(world: World, whole: Deviation, spread: Array) -> tuple[Robot, Measurements]:
        y = measure(world, whole + creep(world, rng) if asked.creep else whole)
        data = measured(world, y + noise(asked, y, spread, rng))
        unknown = np.full((world.told.joints, 4), NAN)
        told = replace(world.told, mass=unknown[:, 0], com=unknown[:, 1:])
        return world.told if asked.told else told, data

    return gap_cases.sealed(asked, world_of(asked, rng), laws, see, rng)


def noise(asked: Asked, y: Array, spread: Array, rng: np.random.Generator) -> Array:
    """(m, k, 3) what the instrument adds [m].  spread: (m, k) of a coordinate."""
    out = spread[..., None] * rng.normal(size=y.shape)
    if asked.oval:
        sight = y / np.linalg.norm(y, axis=-1, keepdims=True)
        along = np.sum(out * sight, axis=-1, keepdims=True) * sight
        out = RADIAL * along + ACROSS * (out - along)
    if asked.off:
        off = rng.random(spread.shape) < OFF_SHARE
        way = rng.normal(size=y.shape)
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        size = rng.uniform(*OFF_SIGMAS, spread.shape) * spread
        out = out + (off * size)[..., None] * way
    return out


def creep(world: World, rng: np.random.Generator) -> Deviation:
    """A base that wanders by microns."""
    walk = np.cumsum(rng.normal(size=(len(world.q), 3)), axis=0)
    walk = walk - walk.mean(axis=0)
    return at_base(world, shift=CREEP * walk / np.sqrt(np.mean(np.sum(walk**2, axis=1))))


def measured(world: World, y: Array) -> Measurements:
    """What stands in the file.  y: (m, k, 3) with its noise [m]."""
    data = measurements(
        world.q,
        y,
        order=np.arange(len(y), dtype=float),
        time=np.round(world.time, 1),
        split=np.where(world.train, "train", "holdout"),
    )
    return replace(data, sliding=world.told.prismatic)
