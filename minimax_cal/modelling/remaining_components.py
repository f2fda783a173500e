"""What may remain of an arm's errors: motions of its parts, and what may drive them.

Directions: a joint about its axis, a joint's axis tilting, the foot, the flange's plate as one
body, each target, the line of sight, the scale.  Drivers: smooth functions of what the pose, the
way to it, the time and the past tell.  No law of the library is used.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
import scipy

from minimax_cal.core.arrays import Array
from minimax_cal.modelling.effects.scene import PosedArm, find_driven_revolute_joints
from minimax_cal.modelling.effects.time_effects import REFERENCE_TEMPERATURE_C
from minimax_cal.modelling.error_rows import PoseRows
from minimax_cal.robots.kinematics import cross
from minimax_cal.selection.remaining_structure import FadingMemory, StructureComponent

WIDE_CURVE_LENGTH, FINE_CURVE_LENGTH = (
    1.0,
    0.15,
)  # lengths of a joint's curve, of a radian or of half its travel
MAX_JOINT_WAVES, MAX_JOINT_PAIR_WAVES = 3, 6  # waves a turn, of one joint, and of two together
SLOW_HALF_PERIODS, MAX_HALF_PERIODS = 4, 24  # half periods over the measurement: slow, and fast
FADING_FACTORS = (0.5, 0.8, 0.92, 0.97)  # of the past, from visit to visit
VISIT_CORRELATION = 0.6  # correlation of one visit with the next
RANDOM_FEATURE_COUNT = 64  # Fourier features of all joints [Rahimi and Recht 2007]
RANDOM_FEATURE_LENGTH = 2.0  # length of their kernel, in standard deviations of each joint
MIN_DRIVER_SIZE = 1e-9  # of a driver's size: it does not vary

DriverFeatures = dict[str, Array | FadingMemory]


def list_error_components(
    posed_arm: PosedArm, rows: PoseRows, fitted_motions: Sequence[tuple[str, Array]]
) -> Iterator[StructureComponent]:
    """Everything that is asked of the rest.

    fitted_motions: label and rows (N, d) of the motion of each law that was fitted.
    """
    shared, past = common_driver_features(posed_arm), body_driver_features(posed_arm)
    fast: DriverFeatures = {"a wave of two angles": joint_pair_wave_features(posed_arm)}
    for j in range(posed_arm.joints):
        turn = rows.rows_from_fields(posed_arm.jacobian[j : j + 1])
        yield from build_components_by_driver(
            f"J{j + 1}", turn, joint_driver_features(posed_arm, j) | shared | fast
        )
        tilt = rows.rows_from_fields(axis_tilt_motions(posed_arm, j))
        yield from build_components_by_driver(
            f"J{j + 1} tilting", tilt, tilt_driver_features(posed_arm, j) | past
        )
    base, plate = (
        rows.rows_from_fields(rigid_body_motions(posed_arm, None)),
        rows.rows_from_fields(rigid_body_motions(posed_arm, posed_arm.links.axes)),
    )
    yield from build_components_by_driver("base", base, past | shared)
    yield from build_components_by_driver("plate", plate, past | shared)
    yield from build_components_by_driver(
        "scale", rows.rows_from_fields(posed_arm.points[None]), shared
    )
    for i, name in enumerate(posed_arm.data.target_names):
        if posed_arm.targets > 1:
            alone = np.zeros((3, *posed_arm.points.shape))
            alone[:, i] = posed_arm.links.axes
            few = {name: past[name] for name in past if name != "all joints"}
            yield from build_components_by_driver(
                name, rows.rows_from_fields(alone), few | time_driver_features(posed_arm)
            )
        ray, seen = line_of_sight_motion_and_features(posed_arm, i)
        yield from build_components_by_driver(
            f"{name} along the line of sight", rows.rows_from_fields(ray), {"where it is": seen}
        )
    for label, motion in fitted_motions:
        yield from build_components_by_driver(label, motion, past | shared)


def build_components_by_driver(
    place: str, motion: Array, drivers: DriverFeatures
) -> Iterator[StructureComponent]:
    """The motion with each driver that varies."""
    for name, feature in drivers.items():
        if isinstance(feature, FadingMemory):
            yield StructureComponent(place, name, motion, feature)
        elif np.abs(feature).max(initial=0.0) > MIN_DRIVER_SIZE:
            ways = feature if feature.ndim == 3 else feature[None]
            yield StructureComponent(place, name, motion, ways)


# ---- what moves ----------------------------------------------------------------------------------


def axis_tilt_motions(posed_arm: PosedArm, joint: int) -> Array:
    """(2, k, 3, m) turns of all beyond a joint about two axes that are across its own."""
    x, z = posed_arm.links.x[joint], posed_arm.links.z[joint]
    lever = posed_arm.points - posed_arm.links.before[joint]
    return np.stack([cross(np.broadcast_to(axis[None], lever.shape), lever)
                     for axis in (x, cross(z, x))])  # fmt: skip


def rigid_body_motions(posed_arm: PosedArm, axes: Array | None) -> Array:
    """(6, k, 3, m) shifts and turns of all targets as one body, along the base's axes or others.

    axes: (3, 3, m).
    """
    shape = (3, *posed_arm.points.shape)
    own = np.broadcast_to(np.eye(3)[:, None, :, None], shape)
    lever = posed_arm.points
    if axes is not None:
        own = np.broadcast_to(axes[:, None], shape)
        lever = posed_arm.points - posed_arm.points.mean(axis=0)
    return np.concatenate([own, cross(own, np.broadcast_to(lever, shape))])


def line_of_sight_motion_and_features(
    posed_arm: PosedArm, target_index: int
) -> tuple[Array, Array]:
    """A target along the line of sight (1, k, 3, m), and functions (f, m) of where it is."""
    seen = posed_arm.points[target_index] - posed_arm.instruments
    away = np.linalg.norm(seen, axis=0)
    ray = np.zeros((1, *posed_arm.points.shape))
    ray[0, target_index] = seen / away
    u, v, w = ray[0, target_index] - ray[0, target_index].mean(axis=1)[:, None]
    d = scale_to_unit_size(away - away.mean())
    return ray, np.array([np.ones_like(d), d, u, v, w, d * d, d * u, d * v, d * w])


# ---- what drives it ------------------------------------------------------------------------------


def joint_driver_features(posed_arm: PosedArm, joint: int) -> DriverFeatures:
    """What one joint's turn may follow of its own: (f, m) each."""
    q, u = posed_arm.q[joint], scale_to_unit_size(posed_arm.gravity[joint], posed_arm.gravity)
    side, v = posed_arm.each("approach")[joint], scale_to_unit_size(posed_arm.each("move")[joint])
    others = [i for i in find_driven_revolute_joints(posed_arm) if i != joint]
    pairs = list(combinations(find_driven_revolute_joints(posed_arm), 2))
    waves = (
        np.concatenate([wave_features(q, 1), wave_features(q, 2)])
        if joint in find_driven_revolute_joints(posed_arm)
        else smooth_curve_features(q, WIDE_CURVE_LENGTH)
    )
    return {
        "its own angle": np.concatenate([smooth_curve_features(q, WIDE_CURVE_LENGTH), waves]),
        "its own angle, finely": smooth_curve_features(q, FINE_CURVE_LENGTH),
        "its load": np.array([u, u**2, u**3]),
        "its last move": np.array([side, v, np.abs(v), v * np.abs(v)]),
        "its last move and load": side * np.array([u, np.abs(u), u**2]),
        "its last move and angle": side
        * np.concatenate([waves, smooth_curve_features(q, WIDE_CURVE_LENGTH)]),
        "its load and angle": u * waves,
        "other angles": stack_features(
            posed_arm,
            [
                wave_features(posed_arm.q[i], k)
                for i in others
                for k in range(1, MAX_JOINT_WAVES + 1)
            ],
        ),
        "two angles together": stack_features(
            posed_arm,
            [
                wave_features(posed_arm.q[a] + sign * posed_arm.q[b], 1)
                for a, b in pairs
                for sign in (1, -1)
            ],
        ),
        "its past": np.concatenate(
            [*(fading_memory_features(x) for x in (side, np.abs(v), u)), slip_windup_features(v)]
        ),
    }


def stack_features(posed_arm: PosedArm, features: Sequence[Array]) -> Array:
    """(f, m) functions together; one that is nothing where there are none."""
    return np.concatenate(features) if features else np.zeros((1, posed_arm.poses))


def tilt_driver_features(posed_arm: PosedArm, joint: int) -> DriverFeatures:
    """What the tilt of a joint's axis may follow besides."""
    return {"its own angle": smooth_curve_features(posed_arm.q[joint], WIDE_CURVE_LENGTH)}


def body_driver_features(posed_arm: PosedArm) -> DriverFeatures:
    """What bodies follow: attitude, loads, their past, all joints."""
    g = (posed_arm.links.axes * -posed_arm.robot.up[:, None]).sum(axis=1)
    attitude = [*g, g[0] * g[1], g[1] * g[2], g[2] * g[0], g[0] ** 2 - g[1] ** 2]
    load = np.array([scale_to_unit_size(row, posed_arm.gravity) for row in posed_arm.gravity])
    moment = overturning_moment_features(posed_arm)
    return {
        "the tool's attitude": np.array(attitude),
        "the loads": np.concatenate([load, moment]),
        "the loads of the past": np.concatenate(
            [fading_memory_features(row) for row in (*moment, *load)]
        ),
    }


def common_driver_features(posed_arm: PosedArm) -> DriverFeatures:
    """What any motion may follow."""
    out: DriverFeatures = {"all joints": random_fourier_features(posed_arm.q)}
    return out | time_driver_features(posed_arm)


def time_driver_features(posed_arm: PosedArm) -> DriverFeatures:
    """What any motion may follow of the time, and of the order of the visits."""
    clock = posed_arm.column("clock")
    out: DriverFeatures = {}
    if np.ptp(clock) > 0.0:
        last = min(MAX_HALF_PERIODS, posed_arm.poses // 3)
        out["time"] = np.array([np.cos(np.pi * k * clock) for k in range(1, SLOW_HALF_PERIODS + 1)])
        if last > SLOW_HALF_PERIODS:
            swings = range(SLOW_HALF_PERIODS + 1, last + 1)
            out["time, to and fro"] = np.array([np.cos(np.pi * k * clock) for k in swings])
        order = np.argsort(clock, kind="stable")
        out["the previous poses"] = FadingMemory(order, VISIT_CORRELATION)
    if posed_arm.column_varies("temperature"):
        warm = scale_to_unit_size(posed_arm.column("temperature") - REFERENCE_TEMPERATURE_C)
        out["temperature"] = np.array([warm, warm**2])
    return out


def joint_pair_wave_features(posed_arm: PosedArm) -> Array:
    """(w, 2, m) cos and sin of every wave along two angles."""
    angles = np.exp(
        1j
        * np.arange(1, MAX_JOINT_PAIR_WAVES + 1)[:, None, None]
        * posed_arm.q[find_driven_revolute_joints(posed_arm)]
    )
    several = [
        (angles[:, None, i] * other[None]).reshape(-1, posed_arm.poses)
        for i, j in combinations(range(angles.shape[1]), 2)
        for other in (angles[:, j], angles[:, j].conj())
    ]
    found = stack_features(posed_arm, several)
    return np.stack([found.real, found.imag], axis=1)


def overturning_moment_features(posed_arm: PosedArm) -> Array:
    """(3, m) moment of what hangs on the foot, of one size."""
    mass, com = posed_arm.link_masses_and_centres
    moment, _ = posed_arm.moment_and_mass_beyond_link(0, mass, com)
    return np.array([scale_to_unit_size(row, moment) for row in moment])


def smooth_curve_features(values: Array, kernel_length: float) -> Array:
    """(f, m) smooth functions of values (m,), their weights those of a Gaussian kernel."""
    span = max(float(np.ptp(values)), 1e-9)
    at = np.pi * (values - values.min()) / span
    k = np.arange(1, 40)
    weight = np.exp(-0.25 * (k * np.pi * kernel_length / span) ** 2)
    weight[:2] = np.maximum(weight[:2], 0.5)
    kept = weight > 0.05
    return np.asarray(weight[kept, None] * np.cos(k[kept, None] * at))


def wave_features(angles: Array, waves_per_turn: int) -> Array:
    """(2, m) cos and sin of k waves a turn."""
    return np.stack([np.cos(waves_per_turn * angles), np.sin(waves_per_turn * angles)])


def random_fourier_features(joint_values: Array) -> Array:
    """(2 f, m) Fourier features of all joints (n, m) together: a Gaussian kernel's."""
    spread = joint_values.std(axis=1)
    moving = spread > MIN_DRIVER_SIZE
    rng = np.random.default_rng(0)
    pull = rng.normal(size=(RANDOM_FEATURE_COUNT // 2, int(moving.sum()))) / (
        RANDOM_FEATURE_LENGTH * spread[moving]
    )
    return np.concatenate(
        [np.cos(pull @ joint_values[moving]), np.sin(pull @ joint_values[moving])]
    )


def fading_memory_features(values: Array) -> Array:
    """(f, m) what is left of the past of values (m,) in the order of the rows, at several rates."""
    before = np.append(0.0, values[:-1])
    return np.array(
        [
            (1.0 - keep) * scipy.signal.lfilter([1.0], [1.0, -keep], before)
            for keep in FADING_FACTORS
        ]
    )


def slip_windup_features(moves: Array) -> Array:
    """(3, m) wind-up of a joint that slips beyond so many of its usual moves (m,)."""
    usual = float(np.median(np.abs(moves)))
    out = np.zeros((3, len(moves)))
    for row, most in zip(out, usual * np.array([0.5, 1.0, 2.0]), strict=True):
        at = 0.0
        for i, step in enumerate(moves):
            at = min(max(at + step, -most), most)
            row[i] = at
    return out / max(usual, MIN_DRIVER_SIZE)


def scale_to_unit_size(values: Array, reference: Array | float = 0.0) -> Array:
    """Values scaled to a largest size of 1; zeros stay, and rounding beside larger ones is 0."""
    size = float(np.abs(values).max(initial=0.0))
    is_real = size > MIN_DRIVER_SIZE * float(np.abs(reference).max(initial=0.0))
    return np.asarray(values / max(size, 1e-300) * is_real)
