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

from minimax_cal.evidence.remains import Component, Fading
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.scene import Scene, turning
from minimax_cal.modelling.effects.time import ROOM
from minimax_cal.modelling.rows import Posed
from minimax_cal.robots.kinematics import cross

WIDE, SHORT = 1.0, 0.15  # lengths of a joint's curve, of a radian or of half its travel
WAVES, FASTEST = 3, 6  # waves a turn, of one joint, and of two together
COURSE, SWINGS = 4, 24  # half periods over the measurement: slow, and fast
KEEPS = (0.5, 0.8, 0.92, 0.97)  # of the past, from visit to visit
VISIT_CORRELATION = 0.6  # correlation of one visit with the next
RANDOM = 64  # Fourier features of all joints [Rahimi and Recht 2007]
ALL = 2.0  # length of their kernel, in standard deviations of each joint
MIN_SPAN = 1e-9  # of a driver's size: it does not vary

Drivers = dict[str, Array | Fading]


def components(
    scene: Scene, rows: Posed, named: Sequence[tuple[str, Array]]
) -> Iterator[Component]:
    """Everything that is asked of the rest.

    named: label and rows (N, d) of the motion of each law that was fitted.
    """
    shared, past = everywhere(scene), together(scene)
    fast: Drivers = {"a wave of two angles": waves(scene)}
    for j in range(scene.joints):
        turn = rows.of(scene.jacobian[j : j + 1])
        yield from driven(f"J{j + 1}", turn, own(scene, j) | shared | fast)
        tilt = rows.of(tilts(scene, j))
        yield from driven(f"J{j + 1} tilting", tilt, tilting(scene, j) | past)
    base, plate = rows.of(bodies(scene, None)), rows.of(bodies(scene, scene.links.axes))
    yield from driven("base", base, past | shared)
    yield from driven("plate", plate, past | shared)
    yield from driven("scale", rows.of(scene.points[None]), shared)
    for i, name in enumerate(scene.data.target_names):
        if scene.targets > 1:
            alone = np.zeros((3, *scene.points.shape))
            alone[:, i] = scene.links.axes
            few = {name: past[name] for name in past if name != "all joints"}
            yield from driven(name, rows.of(alone), few | timed(scene))
        ray, seen = sight(scene, i)
        yield from driven(f"{name} along the line of sight", rows.of(ray), {"where it is": seen})
    for label, motion in named:
        yield from driven(label, motion, past | shared)


def driven(place: str, motion: Array, drivers: Drivers) -> Iterator[Component]:
    """The motion with each driver that varies."""
    for name, feature in drivers.items():
        if isinstance(feature, Fading):
            yield Component(place, name, motion, feature)
        elif np.abs(feature).max(initial=0.0) > MIN_SPAN:
            ways = feature if feature.ndim == 3 else feature[None]
            yield Component(place, name, motion, ways)


# ---- what moves ----------------------------------------------------------------------------------


def tilts(scene: Scene, j: int) -> Array:
    """(2, k, 3, m) turns of all beyond a joint about two axes that are across its own."""
    x, z = scene.links.x[j], scene.links.z[j]
    lever = scene.points - scene.links.before[j]
    return np.stack([cross(np.broadcast_to(axis[None], lever.shape), lever)
                     for axis in (x, cross(z, x))])  # fmt: skip


def bodies(scene: Scene, axes: Array | None) -> Array:
    """(6, k, 3, m) shifts and turns of all targets as one body, along the base's axes or others.

    axes: (3, 3, m).
    """
    shape = (3, *scene.points.shape)
    own = np.broadcast_to(np.eye(3)[:, None, :, None], shape)
    lever = scene.points
    if axes is not None:
        own = np.broadcast_to(axes[:, None], shape)
        lever = scene.points - scene.points.mean(axis=0)
    return np.concatenate([own, cross(own, np.broadcast_to(lever, shape))])


def sight(scene: Scene, i: int) -> tuple[Array, Array]:
    """A target along the line of sight (1, k, 3, m), and functions (f, m) of where it is."""
    seen = scene.points[i] - scene.instruments
    away = np.linalg.norm(seen, axis=0)
    ray = np.zeros((1, *scene.points.shape))
    ray[0, i] = seen / away
    u, v, w = ray[0, i] - ray[0, i].mean(axis=1)[:, None]
    d = unit(away - away.mean())
    return ray, np.array([np.ones_like(d), d, u, v, w, d * d, d * u, d * v, d * w])


# ---- what drives it ------------------------------------------------------------------------------


def own(scene: Scene, j: int) -> Drivers:
    """What one joint's turn may follow of its own: (f, m) each."""
    q, u = scene.q[j], unit(scene.gravity[j], scene.gravity)
    side, v = scene.each("approach")[j], unit(scene.each("move")[j])
    others = [i for i in turning(scene) if i != j]
    pairs = list(combinations(turning(scene), 2))
    waves = np.concatenate([wave(q, 1), wave(q, 2)]) if j in turning(scene) else curve(q, WIDE)
    return {
        "its own angle": np.concatenate([curve(q, WIDE), waves]),
        "its own angle, finely": curve(q, SHORT),
        "its load": np.array([u, u**2, u**3]),
        "its last move": np.array([side, v, np.abs(v), v * np.abs(v)]),
        "its last move and load": side * np.array([u, np.abs(u), u**2]),
        "its last move and angle": side * np.concatenate([waves, curve(q, WIDE)]),
        "its load and angle": u * waves,
        "other angles": joined(scene, [wave(scene.q[i], k) for i in others
                                       for k in range(1, WAVES + 1)]),
        "two angles together": joined(scene, [wave(scene.q[a] + sign * scene.q[b], 1)
                                              for a, b in pairs for sign in (1, -1)]),
        "its past": np.concatenate([*(faded(x) for x in (side, np.abs(v), u)), wound(v)]),
    }  # fmt: skip


def joined(scene: Scene, parts: Sequence[Array]) -> Array:
    """(f, m) functions together; one that is nothing where there are none."""
    return np.concatenate(parts) if parts else np.zeros((1, scene.poses))


def tilting(scene: Scene, j: int) -> Drivers:
    """What the tilt of a joint's axis may follow besides."""
    return {"its own angle": curve(scene.q[j], WIDE)}


def together(scene: Scene) -> Drivers:
    """What bodies follow: attitude, loads, their past, all joints."""
    g = (scene.links.axes * -scene.robot.up[:, None]).sum(axis=1)
    attitude = [*g, g[0] * g[1], g[1] * g[2], g[2] * g[0], g[0] ** 2 - g[1] ** 2]
    load = np.array([unit(row, scene.gravity) for row in scene.gravity])
    moment = hanging(scene)
    return {
        "the tool's attitude": np.array(attitude),
        "the loads": np.concatenate([load, moment]),
        "the loads of the past": np.concatenate([faded(row) for row in (*moment, *load)]),
    }


def everywhere(scene: Scene) -> Drivers:
    """What any motion may follow."""
    out: Drivers = {"all joints": randomly(scene.q)}
    return out | timed(scene)


def timed(scene: Scene) -> Drivers:
    """What any motion may follow of the time, and of the order of the visits."""
    clock = scene.column("clock")
    out: Drivers = {}
    if np.ptp(clock) > 0.0:
        last = min(SWINGS, scene.poses // 3)
        out["time"] = np.array([np.cos(np.pi * k * clock) for k in range(1, COURSE + 1)])
        if last > COURSE:
            swings = range(COURSE + 1, last + 1)
            out["time, to and fro"] = np.array([np.cos(np.pi * k * clock) for k in swings])
        order = np.argsort(clock, kind="stable")
        out["the previous poses"] = Fading(order, VISIT_CORRELATION)
    if scene.has("temperature"):
        warm = unit(scene.column("temperature") - ROOM)
        out["temperature"] = np.array([warm, warm**2])
    return out


def waves(scene: Scene) -> Array:
    """(w, 2, m) cos and sin of every wave along two angles."""
    angles = np.exp(1j * np.arange(1, FASTEST + 1)[:, None, None] * scene.q[turning(scene)])
    several = [
        (angles[:, None, i] * other[None]).reshape(-1, scene.poses)
        for i, j in combinations(range(angles.shape[1]), 2)
        for other in (angles[:, j], angles[:, j].conj())
    ]
    found = joined(scene, several)
    return np.stack([found.real, found.imag], axis=1)


def hanging(scene: Scene) -> Array:
    """(3, m) moment of what hangs on the foot, of one size."""
    mass, com = scene.masses
    moment, _ = scene.load_beyond(0, mass, com)
    return np.array([unit(row, moment) for row in moment])


def curve(x: Array, length: float) -> Array:
    """(f, m) smooth functions of values (m,), their weights those of a Gaussian kernel."""
    span = max(float(np.ptp(x)), 1e-9)
    at = np.pi * (x - x.min()) / span
    k = np.arange(1, 40)
    weight = np.exp(-0.25 * (k * np.pi * length / span) ** 2)
    weight[:2] = np.maximum(weight[:2], 0.5)
    kept = weight > 0.05
    return np.asarray(weight[kept, None] * np.cos(k[kept, None] * at))


def wave(q: Array, k: int) -> Array:
    """(2, m) cos and sin of k waves a turn."""
    return np.stack([np.cos(k * q), np.sin(k * q)])


def randomly(q: Array) -> Array:
    """(2 f, m) Fourier features of all joints (n, m) together: a Gaussian kernel's."""
    spread = q.std(axis=1)
    moving = spread > MIN_SPAN
    rng = np.random.default_rng(0)
    pull = rng.normal(size=(RANDOM // 2, int(moving.sum()))) / (ALL * spread[moving])
    return np.concatenate([np.cos(pull @ q[moving]), np.sin(pull @ q[moving])])


def faded(x: Array) -> Array:
    """(f, m) what is left of the past of values (m,) in the order of the rows, at several rates."""
    before = np.append(0.0, x[:-1])
    return np.array(
        [(1.0 - keep) * scipy.signal.lfilter([1.0], [1.0, -keep], before) for keep in KEEPS]
    )


def wound(move: Array) -> Array:
    """(3, m) wind-up of a joint that slips beyond so many of its usual moves (m,)."""
    usual = float(np.median(np.abs(move)))
    out = np.zeros((3, len(move)))
    for row, most in zip(out, usual * np.array([0.5, 1.0, 2.0]), strict=True):
        at = 0.0
        for i, step in enumerate(move):
            at = min(max(at + step, -most), most)
            row[i] = at
    return out / max(usual, MIN_SPAN)


def unit(x: Array, beside: Array | float = 0.0) -> Array:
    """Values scaled to a largest size of 1; zeros stay, and rounding beside larger ones is 0."""
    size = float(np.abs(x).max(initial=0.0))
    is_real = size > MIN_SPAN * float(np.abs(beside).max(initial=0.0))
    return np.asarray(x / max(size, 1e-300) * is_real)
