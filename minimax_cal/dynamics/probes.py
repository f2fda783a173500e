"""What is left of the torques when all that has a name is taken out, and what it follows.

A probe is a set of functions of one driver, at the rows that are fitted.  Its size is what it
foretells of rows that its fit does not see: no number of functions makes it large, and noise that
remembers, or that was taken for more than it is, does not make it small.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr

from minimax_cal.dynamics.model import Normal
from minimax_cal.dynamics.rows import CUTOFF_HZ, FILTER_ORDER, SAMPLE_HZ, Scene
from minimax_cal.evidence.noise import orthonormal
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.linear_algebra import project_out

LEVEL = 0.02  # chance that noise alone is called structure, of all probes at all joints, at most:
# what noise foretells of rows left out is below 0 on average
RANK = 1e-4  # of a probe's largest direction beside the model: smaller ones are no test
BUMPS = 5  # smooth steps over the range of a driver
WAVES = 4  # a turn of a joint that angle alone is tried by; more are those of gears
FINEST, STEPS = 60.0, 28  # waves a turn of a gear that are tried at most, and how many of them
PARTS = (1.0, 0.1, 0.01)  # of the remaining error's square, that a probe may explain
BLOCK_S, TIME_FOLDS = 1.0, 8  # length of stretches that are left out together, every eighth [s]
TIME = "time"
RECENT_S = (0.5, 2.0, 8.0)  # over which motion that went before is averaged [s]
BEFORE_S = (0.1, 0.2, 0.3, 0.45, 0.6, 0.8)  # by which accelerations went before [s]
PLAYS = (0.03, 0.1, 0.3)  # of a joint's range: ways over which a spring lags the angle


@dataclass(frozen=True)
class Unexplained:
    """Torque without a name.  size: RMS that its driver foretells of rows left out, and noise: that
    of the whole remaining error, both of the rows that are fitted [unit of the log].  share: of its
    square.
    """

    place: str
    follows: str
    size: float
    noise: float
    share: float
    p: float

    def sentence(self, unit: str) -> str:
        """For people, without its full stop.  unit: of the log."""
        size = f"{self.size:.3g} {unit}"
        return f"{size} at {self.place} follow the {self.follows} and have no name"


# ---- what drivers are functions of ---------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Moments:
    """What a scene knows of some rows, for one joint.

    scene: of all samples.  joint: from 0.  at: (k,) samples.  past: what all joints did before.
    q, qd, qdd, sense: (k, n) of the joints.  load: (k, n) torques that the body puts on them, over
    the largest.
    """

    scene: Scene
    joint: int
    at: Array
    past: Past
    q: Array
    qd: Array
    qdd: Array
    sense: Array
    load: Array

    @staticmethod
    def of(scene: Scene, joint: int, at: Array, past: Past) -> Moments:
        """With what joints do there."""
        motion, load = scene.logs.motion.at(at), scene.load
        size = np.maximum(np.abs(load).max(axis=0), 1e-12)
        return Moments(scene, joint, at, past, motion.q, motion.qd, motion.qdd, scene.sense[at],
                       load[at] / size)  # fmt: skip

    @property
    def own_sense(self) -> Array:
        """(k,) of the joint."""
        return self.sense[:, self.joint]

    @property
    def own_speed(self) -> Array:
        """(k,) of the joint."""
        return self.qd[:, self.joint]

    def both_ways(self, columns: list[Array]) -> list[Array]:
        """Columns alone and with the direction."""
        return [f for one in columns for f in (one, one * self.own_sense)]

    @property
    def others(self) -> list[int]:
        """The other joints."""
        return [k for k in range(self.q.shape[1]) if k != self.joint]


@dataclass(frozen=True, eq=False)
class Past:
    """What joints did before: (M, n, d) at every sample.

    recent: averages of the speed's size and of the angle.  lagged: where a spring with play is.
    """

    recent: Array
    lagged: Array

    @staticmethod
    def of(scene: Scene) -> Past:
        """Of every run for itself."""
        q, qd = scene.logs.motion.q, scene.logs.motion.qd
        recent = np.empty((*q.shape, len(RECENT_S)))
        lagged = np.empty((*q.shape, len(PLAYS)))
        way = np.maximum(np.ptp(q, axis=0), 1e-12)[:, None] * np.array(PLAYS)
        stays = np.exp(-1.0 / SAMPLE_HZ / np.array(RECENT_S))
        for run in scene.logs.spans:
            now, average = np.zeros_like(way), np.zeros((q.shape[1], len(RECENT_S)))
            step = np.diff(q[run], axis=0, prepend=q[run][:1])[:, :, None]
            new = np.abs(qd[run, :, None]) * (1.0 - stays)
            for i in range(len(new)):
                now = np.clip(now + step[i], -way, way)
                average = stays * average + new[i]
                lagged[run.start + i], recent[run.start + i] = now, average
        return Past(recent, lagged / way)


# ---- drivers -------------------------------------------------------------------------------------


def waves(q: Array, counts: Array) -> list[Array]:
    """Cosines and sines of an angle (k,), so many a turn."""
    return [f(k * q) for k in counts for f in (np.cos, np.sin)]


def bumps(x: Array) -> list[Array]:
    """Smooth bumps over the range of a driver (k,)."""
    low, high = np.quantile(x, [0.02, 0.98])
    width = max(float(high - low), 1e-12) / BUMPS
    return hills((x - low) / width)


def hills(x: Array) -> list[Array]:
    """Smooth bumps about 0, 1, ... BUMPS."""
    return [np.exp(-((x - k) ** 2)) for k in range(BUMPS + 1)]


def by_angle(m: Moments) -> list[Array]:
    """The joint's own angle, alone and with the direction."""
    q = m.q[:, m.joint]
    if m.scene.arm.robot.prismatic[m.joint]:
        return m.both_ways(bumps(q))
    slow = waves(q, np.arange(1.0, WAVES + 1.0))
    return [*slow, *(wave * m.own_sense for wave in slow[:4])]


def by_fine_angle(m: Moments) -> list[Array]:
    """Waves of the angle as gears and motors have them, less what the filter takes."""
    q, qd = m.q[:, m.joint], m.own_speed
    far = max(float(np.ptp(q)), 1e-12)
    first = WAVES + 1.0 if not m.scene.arm.robot.prismatic[m.joint] else np.pi / far
    counts = first + np.arange(STEPS) * max(np.pi / far, (FINEST - first) / STEPS)
    out = []
    for k in counts:
        rate = k * np.abs(qd) / (2.0 * np.pi * CUTOFF_HZ)
        out += [f / (1.0 + rate ** (2 * FILTER_ORDER)) for f in waves(q, np.array([k]))]
    return out


def by_speed(m: Moments) -> list[Array]:
    """The joint's speed, the same both ways."""
    return [b * m.own_sense for b in bumps(np.abs(m.own_speed))]


def by_direction(m: Moments) -> list[Array]:
    """The joint's speed, otherwise one way than the other."""
    return bumps(np.abs(m.own_speed))


def by_load(m: Moments) -> list[Array]:
    """The torque that the joint transmits, alone, with the direction and with the speed."""
    load, sense, v = m.load[:, m.joint], m.own_sense, m.own_speed
    size, square = np.abs(load), load**2
    return [load, size, square, load**3, size * sense, square * sense, size * v, square * v,
            load * sense]  # fmt: skip


def by_acceleration(m: Moments) -> list[Array]:
    """The joint's acceleration, its derivative, and accelerations that went before."""
    logs, j = m.scene.logs, m.joint
    qdd = m.qdd[:, j]
    first = logs.start[logs.run_of(m.at)]
    earlier = [logs.motion.qdd[np.maximum(m.at - int(s * SAMPLE_HZ), first), j] for s in BEFORE_S]
    return [qdd, np.abs(qdd), np.abs(qdd) * m.own_sense,
            logs.slope(logs.motion.qdd[:, j])[m.at], *earlier]  # fmt: skip


def by_others(m: Moments) -> list[Array]:
    """Where the other joints are, alone and two together, how they move and what they transmit."""
    others = m.others
    alone = [
        f
        for k in others
        for f in (np.cos(m.q[:, k]), np.sin(m.q[:, k]), m.qd[:, k], m.qdd[:, k], m.sense[:, k],
                  m.load[:, k], np.abs(m.qd[:, k]))
    ]  # fmt: skip
    sums = [m.q[:, a] + m.q[:, b] for a in others for b in others if a <= b]
    differences = [m.q[:, a] - m.q[:, b] for a in others for b in others if a < b]
    return [*alone, *(f(q) for q in (*sums, *differences) for f in (np.cos, np.sin))]


def by_friction_of_others(m: Moments) -> list[Array]:
    """Friction and damping of this joint by what the other joints do."""
    sense, v = m.own_sense, m.own_speed
    out = []
    for k in m.others:
        cos, sin = np.cos(m.q[:, k]), np.sin(m.q[:, k])
        out += [sense * cos, sense * sin, v * cos, v * sin, sense * m.load[:, k],
                sense * np.abs(m.load[:, k]), sense * m.sense[:, k], v * m.qd[:, k],
                sense * np.abs(m.qd[:, k])]  # fmt: skip
    return out


def by_time(m: Moments) -> list[Array]:
    """The time since the run began, of every run for itself."""
    logs = m.scene.logs
    run = logs.run_of(m.at)
    out = []
    for r in range(len(logs.names)):
        mine = run == r
        if mine.any():
            since = logs.since[m.at] / max(float(logs.since[m.at][mine].max()), 1e-9)
            out += [mine * hill for hill in hills(BUMPS * since)]
    return m.both_ways(out)


def by_memory(m: Moments) -> list[Array]:
    """How far the joint is from where it last turned round, and how it moved before."""
    j, whole = m.joint, m.scene.since_reversal[:, m.joint]
    way = whole[m.at] / max(float(whole.max()), 1e-12)
    faded = [np.exp(-way / length) for length in (0.02, 0.06, 0.2, 0.6)]
    recent = [*m.past.recent[m.at, j].T]
    by_way = [f for b in faded for f in (b * m.own_sense, b * m.own_speed)]
    return [*by_way, *m.both_ways(recent), *m.past.lagged[m.at, j].T]


DRIVERS: dict[str, Callable[[Moments], list[Array]]] = {
    "angle": by_angle,
    "fine waves of the angle": by_fine_angle,
    "speed": by_speed,
    "direction": by_direction,
    "load": by_load,
    "acceleration": by_acceleration,
    "other joints": by_others,
    "other joints and the direction": by_friction_of_others,
    TIME: by_time,
    "motion before": by_memory,
}


# ---- the test ------------------------------------------------------------------------------------


def unexplained(normal: Normal, value: Array) -> list[Unexplained]:
    """What the remaining error follows, at each joint the drivers whose p-value is low enough.

    value: (p,) of the fit, 0 where a column is not part of it.
    """
    scene, white = normal.columns.scene, normal.white
    plain, out, past = normal.rest(value), list[Unexplained](), Past.of(scene)
    for j in range(scene.logs.joints):
        mine, kept = white.joint == j, white.kept[j]
        if np.count_nonzero(mine) < 10 * BUMPS:
            continue
        basis = orthonormal(normal.raw[j, kept][:, value != 0.0])
        left = project_out(plain[mine], basis)
        noise = float(np.sqrt(np.mean(plain[mine] ** 2)))
        moments = Moments.of(scene, j, scene.logs.picked[kept], past)
        group = np.unique(normal.group[mine], return_inverse=True)[1]
        for name, columns in DRIVERS.items():
            fold = group
            if name == TIME:  # stretches: what follows time is not foretold far from where it was
                fold = (scene.logs.since[moments.at] / BLOCK_S).astype(int) % TIME_FOLDS
            raw = np.stack(columns(moments), axis=1)
            share, p = foretold(beside(basis, raw), left, fold, group)
            p = min(1.0, p * len(DRIVERS) * scene.logs.joints)
            if p < LEVEL:
                size = noise * float(np.sqrt(share))
                out.append(Unexplained(f"J{j + 1}", name, size, noise, share, p))
    return sorted(out, key=lambda one: -one.share)


def beside(basis: Array, columns: Array) -> Array:
    """Columns (k, d) less what the model imitates, of unit size a row."""
    field = project_out(columns, basis)
    size = np.sqrt(np.mean(field**2, axis=0))
    least = RANK * np.sqrt(np.mean(columns**2, axis=0)) + 1e-300
    return np.asarray(field / np.maximum(size, least))


def foretold(field: Array, left: Array, fold: Array, group: Array) -> tuple[float, float]:
    """Share of the square of the remaining error that a probe foretells in folds left out, p-value.

    The ridge is that of a probe that explains a part of the error, the part that foretells best.
    The p-value is Student's, of relative gains over groups, each between -1 and 1: no group counts
    for more than another.  field: (k, d).  left: (k,).  fold, group: (k,) from 0.
    """
    d, found = field.shape[1], (-np.inf, 1.0)
    folds = [fold == f for f in np.unique(fold)]
    gram, pull = field.T @ field, field.T @ left
    parts = [(field[own].T @ field[own], field[own].T @ left[own]) for own in folds]
    before = np.bincount(group, left**2)
    for part in PARTS:
        missed = left.copy()
        for own, (inner, toward) in zip(folds, parts, strict=True):
            value = np.linalg.solve(gram - inner + d / part * np.eye(d), pull - toward)
            missed[own] -= field[own] @ value
        after = np.bincount(group, missed**2)
        share = 1.0 - float(after.sum()) / max(float(before.sum()), 1e-300)
        if share > found[0]:
            gain = (before - after) / np.maximum(np.maximum(before, after), 1e-300)
            count = len(gain)
            unsure = float(gain.std(ddof=1)) / np.sqrt(count) if count > 1 else np.inf
            found = share, float(stdtr(count - 1, -float(gain.mean()) / max(unsure, 1e-12)))
    return found
