"""What is left of the torques when all that has a name is taken out, and what it follows.

A probe is a set of smooth functions of one driver.  Its fit beside the model is tested against the
noise, by rows and by groups of them, and its size is the RMS torque that it would explain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from minimax_cal.dynamics.model import Normal
from minimax_cal.dynamics.scene import Scene
from minimax_cal.evidence.noise import inflation
from minimax_cal.ground.arrays import Array

LEVEL = 0.001  # chance that noise alone is called structure, of all probes at all joints
RANK = 1e-4  # of a probe's largest direction beside the model: smaller ones are no test
BUMPS = 5  # smooth steps over the range of a driver


@dataclass(frozen=True)
class Unexplained:
    """Torque without a name.  size: RMS, and noise: that of the whole remaining error, both of the
    rows that are fitted [unit of the log].  share: of the remaining error's square.
    """

    place: str
    follows: str
    size: float
    noise: float
    share: float
    p: float


def waves(q: Array, most: int) -> list[Array]:
    """Cosines and sines of an angle (M,)."""
    return [f(k * q) for k in range(1, most + 1) for f in (np.cos, np.sin)]


def bumps(x: Array) -> list[Array]:
    """Smooth bumps over the range of a driver (M,)."""
    low, high = np.quantile(x, [0.02, 0.98])
    width = max(float(high - low), 1e-12) / BUMPS
    return [np.exp(-(((x - low) / width - k) ** 2)) for k in range(BUMPS + 1)]


def by_angle(s: Scene, j: int) -> list[Array]:
    """The joint's own angle, alone and with the direction."""
    q = s.logs.motion.q[:, j]
    if s.arm.robot.prismatic[j]:
        return [f for b in bumps(q) for f in (b, b * s.sense[:, j])]
    return [*waves(q, 4), *(f * s.sense[:, j] for f in waves(q, 2))]


def by_speed(s: Scene, j: int) -> list[Array]:
    """The joint's speed, the same both ways."""
    return [b * s.sense[:, j] for b in bumps(np.abs(s.logs.motion.qd[:, j]))]


def by_direction(s: Scene, j: int) -> list[Array]:
    """The joint's speed, otherwise one way than the other."""
    return bumps(np.abs(s.logs.motion.qd[:, j]))


def by_load(s: Scene, j: int) -> list[Array]:
    """The torque that the joint transmits, alone, with the direction and with the speed."""
    load = s.load[:, j]
    size = load / max(float(np.abs(load).max()), 1e-12)
    sense, v = s.sense[:, j], s.logs.motion.qd[:, j]
    return [size, np.abs(size), size**2, size**3, np.abs(size) * sense, size**2 * sense,
            np.abs(size) * v, size**2 * v]  # fmt: skip


def by_acceleration(s: Scene, j: int) -> list[Array]:
    """The joint's acceleration and its derivative."""
    qdd = s.logs.motion.qdd[:, j]
    return [qdd, np.abs(qdd), np.abs(qdd) * s.sense[:, j], s.logs.slope(qdd)]


def by_others(s: Scene, j: int) -> list[Array]:
    """Where the other joints are, how they move and what they transmit."""
    motion, out = s.logs.motion, []
    for k in range(s.logs.joints):
        if k != j:
            out += [np.cos(motion.q[:, k]), np.sin(motion.q[:, k]), motion.qd[:, k],
                    motion.qdd[:, k], s.sense[:, k], s.load[:, k],
                    motion.qd[:, k] * motion.qd[:, j]]  # fmt: skip
    return out


def by_time(s: Scene, j: int) -> list[Array]:
    """The time since the run began, and the run itself."""
    since = s.logs.since / max(float(s.logs.since.max()), 1e-9)
    out = [f * g for f in (since, since**2) for g in (np.ones_like(since), s.sense[:, j])]
    for a, b in zip(s.logs.start[:-2], s.logs.start[1:-1], strict=True):
        within = np.zeros_like(since)
        within[a:b] = 1.0
        out += [within, within * s.sense[:, j]]
    return out


def by_memory(s: Scene, j: int) -> list[Array]:
    """How far the joint is from where it last turned round."""
    way = s.since_reversal[:, j] / max(float(s.since_reversal[:, j].max()), 1e-12)
    faded = [np.exp(-way / length) for length in (0.02, 0.06, 0.2, 0.6)]
    return [f for b in faded for f in (b * s.sense[:, j], b * s.logs.motion.qd[:, j])]


DRIVERS: dict[str, Callable[[Scene, int], list[Array]]] = {
    "angle": by_angle,
    "speed": by_speed,
    "direction": by_direction,
    "load": by_load,
    "acceleration": by_acceleration,
    "other joints": by_others,
    "time": by_time,
    "way since the last reversal": by_memory,
}


def unexplained(normal: Normal, value: Array) -> list[Unexplained]:
    """What the remaining error follows, at each joint the drivers whose p-value is low enough.

    value: (p,) of the fit, 0 where a column is not part of it.
    """
    scene, white = normal.columns.scene, normal.white
    rest, plain = normal.error - normal.matrix @ value, normal.rest(value)
    out = []
    for j in range(scene.logs.joints):
        mine = white.joint == j
        if np.count_nonzero(mine) < 10 * BUMPS:
            continue
        matrix = normal.matrix[mine][:, value != 0.0]
        matrix = matrix[:, np.linalg.norm(matrix, axis=0) > 0.0]
        basis = np.linalg.svd(matrix / np.linalg.norm(matrix, axis=0), full_matrices=False)
        span = basis[0][:, basis[1] > RANK * basis[1][0]]
        left = rest[mine] - span @ (span.T @ rest[mine])
        noise = float(np.sqrt(np.mean(plain[mine] ** 2)))
        probes = {name: np.stack(f(scene, j), axis=1) for name, f in DRIVERS.items()}
        rows = scene.logs.filtered(np.concatenate(list(probes.values()), axis=1))
        field = white.white_joint(j, rows[white.kept[j]])
        field = field - span @ (span.T @ field)
        at = 0
        for name, columns in probes.items():
            part = field[:, at : at + columns.shape[1]]
            at += columns.shape[1]
            found = tested(part, left, normal.group[mine], len(left) - span.shape[1])
            p = min(1.0, found[0] * len(DRIVERS) * scene.logs.joints)
            if p < LEVEL:
                size = noise * float(np.sqrt(found[1]))
                out.append(Unexplained(f"J{j + 1}", name, size, noise, found[1], p))
    return sorted(out, key=lambda one: -one.share)


def tested(field: Array, left: Array, group: Array, dof: int) -> tuple[float, float]:
    """p-value of a probe beside the model, and the share of the squares that it explains.

    The share is less what as many columns explain of noise.  field: (k, d).  left, group: (k,).
    """
    size = np.maximum(np.linalg.norm(field, axis=0), 1e-300)
    vectors, values, _ = np.linalg.svd(field / size, full_matrices=False)
    span = vectors[:, values > RANK * max(values.max(initial=0.0), 1e-300)]
    fitted = span @ (span.T @ left)
    d, whole, gain = span.shape[1], float(left @ left), float(fitted @ fitted)
    free = dof - d
    if free < d or whole <= 0.0 or gain >= whole:
        return 1.0, 0.0
    wide = inflation(fitted, left, group, free)
    p = float(fdtrc(d, free, gain / d / ((whole - gain) / free) / wide))
    return p, max(1.0 - (whole - gain) / free / (whole / dof), 0.0)
