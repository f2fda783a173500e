"""Is anything left?  Tests of what remains against poses, moves, loads, time, by no named law.

Each test asks whether some motion (of a joint, the base, a target) still follows some functions of
the poses.  Under the null hypothesis what is left after weighing and projection is white, so that
its share in the span of motion times functions has an F distribution, exactly.  Few motions and
few functions a test: a small unknown effect of one joint is not to drown among all others.  A
motion may scatter more than the rest does, where a joint comes back badly or the floor shakes: its
functions must tell more than they leave of that motion itself, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy import stats

from minimax_cal.diagnosing.where.residual import evened
from minimax_cal.diagnosing.where.significance import score_flips
from minimax_cal.evidence.limits import MATTERS, SCATTER, STRUCTURE, WORTH
from minimax_cal.evidence.noise import Noise, inflation
from minimax_cal.evidence.selection import Choice
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import from_means, summed, visits
from minimax_cal.modelling.effects.scene import Scene, joint_of, turning
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.effects.time import ROOM
from minimax_cal.modelling.rows import Rows
from minimax_cal.robots.kinematics import cross

SHARE = 0.3  # of the degrees of freedom that a test may take at most
LOUD = 0.05  # chance above which nobody asks why
HALF_OF = 0.5  # of those of its own motion
FAINT = 1e-6  # of the largest motion, below which there is none
FASTEST = 6  # waves a turn, of two joints together, that are looked for
STEPS = 5  # joint values at which a joint, or its play, may jump
LEAST, MOST = 1e-300, 0.99  # chances as they are combined: one of 1 would outweigh all others
SWINGS = 12  # half periods of a course, from the first visit to the last, that are looked for


@dataclass(frozen=True, eq=False)
class Probe:
    """What might still move: motions (d, k, 3, m) [m], each by any of the functions (f, m)."""

    name: str
    motion: Array
    feature: Array


def probes(scene: Scene) -> Iterator[Probe]:
    """Every question that is asked of the rest."""
    angles, circle = turning(scene), around(scene)
    pairs = sums_of(scene, angles)
    bare = [unit(q - q.mean()) for q in scene.q]
    powers = [*bare, *(u * u for u in bare), *(u * v for u, v in combinations(bare, 2))]
    load, move, side = scene.gravity, scene.each("move"), scene.each("approach")
    for j in range(scene.joints):
        motion, name = scene.jacobian[j : j + 1], f"J{j + 1}"
        yield Probe(f"{name} with its own angle", motion, by_itself(scene.q[j]))
        others = [row for i, rows in circle.items() if i != j for row in rows]
        if others:
            yield Probe(f"{name} with other angles", motion, np.array(others))
        if pairs:
            yield Probe(f"{name} with two angles together", motion, np.array(pairs))
        yield Probe(f"{name} with products of angles", motion, np.array(powers))
        u, v = unit(load[j]), unit(move[j])
        carried = [u, u**2, u**3] if u.any() else []
        led = [side[j], v, np.abs(v), v * np.abs(v)] if side[j].any() else []
        if side[j].any() and j in circle:  # teeth wear where a gear works most
            sectors = [side[j], *(side[j] * (scene.q[j] > at) for at in steps(scene.q[j]))]
            yield Probe(f"{name} with its approach and angle", motion, np.array(sectors))
        if carried:
            yield Probe(f"{name} with its load", motion, np.array(carried))
        if led:
            yield Probe(f"{name} with its last move", motion, np.array(led))
    first = angles[:3]
    wide = [row for i in first for row in circle[i]] + sums_of(scene, first)
    for axis, letter in enumerate("xyz"):
        motion = np.zeros((1, *scene.points.shape))
        motion[0, :, axis] = 1.0
        if wide:
            yield Probe(f"the whole arm along {letter} with the first angles", motion,
                        np.array(wide))  # fmt: skip
    clock = scene.column("clock")
    course = [np.cos(np.pi * k * clock) for k in (1, 2, 3, 4)] if np.ptp(clock) > 0.0 else []
    if scene.has("temperature"):
        course.append(unit(scene.column("temperature") - ROOM))
    if course:
        eye = np.broadcast_to(np.eye(3)[:, None, :, None], (3, *scene.points.shape))
        twist = [eye, cross(eye, np.broadcast_to(scene.points, eye.shape))]
        yield Probe("the base with time", np.concatenate(twist), np.array(course))
        yield Probe("the scale with time", scene.points[None], np.array(course))
        yield Probe("the joints with time", scene.jacobian, np.array(course))
    if np.ptp(clock) > 0.0:
        swings = np.array([np.cos(np.pi * k * clock) for k in range(1, SWINGS + 1)])
        yield Probe("the base to and fro", np.concatenate(twist), swings[4:])
        for j in range(scene.joints):
            yield Probe(f"J{j + 1} to and fro with time", scene.jacobian[j : j + 1], swings)
    yield from at_targets(scene, np.array(course))


def at_targets(scene: Scene, course: Array) -> Iterator[Probe]:
    """Each target on the flange and along the line of sight."""
    axes = scene.links.axes
    g = (axes * -scene.robot.up[:, None]).sum(axis=1)
    attitude = [*g, g[0] * g[1], g[1] * g[2], g[2] * g[0], g[0] ** 2 - g[1] ** 2]
    seen = scene.points - scene.instruments
    away = np.linalg.norm(seen, axis=1, keepdims=True)
    ray = seen / away
    for i, name in enumerate(scene.data.target_names):
        alone = np.zeros((3, *scene.points.shape))
        alone[:, i] = axes
        yield Probe(f"{name} with the tool's attitude", alone, np.array([*attitude, *course]))
        sight = np.zeros((1, *scene.points.shape))
        sight[0, i] = ray[i]
        d, direction = unit(away[i, 0] - away[i].mean()), ray[i] - ray[i].mean(axis=1)[:, None]
        u, v, w = direction
        feature = np.array([np.ones_like(d), d, u, v, w, d * d, d * u, d * v, d * w])
        yield Probe(f"{name} along the line of sight", sight, feature)


def sums_of(scene: Scene, angles: Sequence[int]) -> list[Array]:
    """Cosines and sines of the sums and differences of two joint angles."""
    return [
        row
        for i, j in combinations(angles, 2)
        for sign in (1, -1)
        for row in wave(scene.q[i] + sign * scene.q[j], 1)
    ]


def around(scene: Scene) -> dict[int, list[Array]]:
    """Cosines and sines of up to three waves a turn of every joint that turns."""
    return {j: [row for k in (1, 2, 3) for row in wave(scene.q[j], k)] for j in turning(scene)}


def by_itself(q: Array) -> Array:
    """Functions of one joint's value (m,): waves, powers, jumps: (f, m)."""
    u = unit(q - q.mean())
    jumps = [np.sign(q - at) for at in steps(q)]
    return np.array([*(row for k in (1, 2, 3, 4, 5) for row in wave(q, k)), u, u**2, u**3, *jumps])


def steps(q: Array) -> Array:
    """(s,) values that part the poses of one joint (m,) into equal numbers."""
    return np.asarray(np.quantile(q, np.arange(1, STEPS + 1) / (STEPS + 1)))


def wave(q: Array, k: int) -> Array:
    """(2, m) cos and sin of k waves a turn."""
    return np.stack([np.cos(k * q), np.sin(k * q)])


def unit(x: Array) -> Array:
    """Values scaled to a largest size of 1; zeros stay."""
    return np.asarray(x / max(float(np.abs(x).max()), 1e-300))


@dataclass(frozen=True)
class Trace:
    """p: probability that the rest has nothing of it.  excess: weighed square beyond chance.

    doubts: whether a name is asked, not the poses in general.
    """

    name: str
    p: float
    excess: float
    doubts: bool = False


@dataclass(frozen=True, eq=False)
class Rest:
    """What is left, white under the null hypothesis.

    rows: (N,).  basis: (N, p) orthonormal span of all that was fitted.  root: (N,) square roots of
    the weights.  dof: degrees of freedom.  group: (N,) of rows at the same pose, from 0.  width: of
    rows a visit.
    """

    rows: Array
    basis: Array
    root: Array
    dof: int
    group: Array
    width: int

    @property
    def total(self) -> float:
        """Its square."""
        return float(self.rows @ self.rows)

    @cached_property
    def even(self) -> Array:
        """(N,) the rows as large as they were before the fit: `evened`."""
        m, r = len(self.rows) // self.width, self.width
        spread = np.broadcast_to(np.eye(r), (m, r, r))
        basis = self.basis.reshape(m, r, -1)
        return evened(self.rows.reshape(m, r), basis, spread, self.group[::r]).reshape(-1)

    def along(self, motion: Array, told: Array) -> tuple[float, float]:
        """Square of what functions of the poses leave along a motion, and its degrees of freedom.

        motion: (N, e), at each visit any combination of its columns.  told: (N, d) orthonormal, the
        functions, none of which was fitted.
        """
        block = motion.reshape(-1, self.width, motion.shape[1])
        span, size, _ = np.linalg.svd(block, full_matrices=False)
        span = span * (size > FAINT * max(float(size.max(initial=0.0)), 1e-300))[:, None]
        left = self.rows - told @ (told.T @ self.rows)
        square, free = (
            float(((np.swapaxes(span, 1, 2) @ part.reshape(*block.shape[:2], -1)) ** 2).sum())
            for part in (left, np.concatenate([self.basis, told], axis=1))
        )
        return square, float((span**2).sum()) - free


def rest_of(rows: Rows, noise: Noise, known: Array) -> Rest:
    """Weighted rows with the span of geometry and known columns (N, q) taken out."""
    root = np.sqrt(noise.weights(rows))
    columns = np.concatenate([rows.basis, known], axis=1) * root[:, None]
    norm = np.linalg.norm(columns, axis=0)
    basis = np.linalg.qr(columns[:, norm > 0] / norm[norm > 0])[0]
    rest = rows.error * root
    rest = rest - basis @ (basis.T @ rest)
    return Rest(rest, basis, root, rows.count - basis.shape[1], rows.group, rows.width)


@dataclass(frozen=True, eq=False)
class Named:
    """An effect that was named.

    motion: (d, N) rows of its motion, as fitted or in its parts.  whole: (N,) as fitted.
    """

    term: Term
    motion: Array
    whole: Array

    @property
    def joint(self) -> int | None:
        """The joint, from 0, or the link's joint, where it has one."""
        place = self.term.place
        return joint_of(place) if place[:1] in "JL" and place[1:].isdigit() else None

    def size(self, scene: Scene, rows: Rows) -> Array:
        """(m,) how much there is of it at each pose, at most 1: of a joint's effect its angle."""
        m, r = rows.weight.shape
        size = np.linalg.norm(self.whole.reshape(m, r), axis=1)
        if self.joint is not None:
            lever = rows.of(scene.jacobian[[self.joint]]).reshape(m, r)
            size = size / np.maximum(np.linalg.norm(lever, axis=1), 1e-300)
        return unit(size)


def doubted(scene: Scene, named: Named) -> Iterator[tuple[str, Array]]:
    """Questions to a name: whether its motion still varies with what its law does not know.

    Each with its functions (f, m).
    """
    name, joints = named.term.label, [] if named.joint is None else [named.joint]
    angles = [j for j in joints or range(min(scene.joints, 3)) if j in turning(scene)]
    if angles:
        yield f"{name} with angle", np.concatenate([wave(scene.q[j], 1) for j in angles])
    load, move, side = scene.gravity, scene.each("move"), scene.each("approach")
    felt = [unit(load[j]) for j in joints if load[j].any()]
    led = [part for j in joints if side[j].any() for part in (side[j], np.abs(unit(move[j])))]
    if felt or led:
        yield f"{name} with load or move", np.array([*felt, *led])
    clock = scene.column("clock")
    if np.ptp(clock) > 0.0:
        yield f"{name} with time", np.array([np.cos(np.pi * k * clock) for k in (1, 2)])


def narrowly(scene: Scene, named: Named) -> Iterator[Probe]:
    """Questions to a name of which few functions tell: what its nearest relatives would leave."""
    name, since = named.term.label, named.term.choice.get("since")
    if since is not None:
        after = (scene.column("clock") >= since).astype(float)[None]
        for i, target in enumerate(scene.data.target_names):
            alone = np.zeros((3, *scene.points.shape))
            alone[:, i] = scene.links.axes
            yield Probe(f"{target} since {name}", alone, after)
    if named.joint is not None:
        motion = scene.jacobian[named.joint : named.joint + 1]
        for i in turning(scene):
            if i != named.joint:
                bare = unit(scene.q[i] - scene.q[i].mean())
                yield Probe(f"{name} with J{i + 1}", motion, np.array([bare, *wave(scene.q[i], 1)]))


def structure(
    scene: Scene, rows: Rows, noise: Noise, known: Array, names: Sequence[Named] = ()
) -> tuple[Trace, ...]:
    """What is left, question by question.

    known: (N, q) columns fitted beside the geometry.  names: effects that these belong to.
    """
    rest = rest_of(rows, noise, known)
    found = []
    r = rows.width
    wide, narrow = list(probes(scene)), [p for one in names for p in narrowly(scene, one)]
    for number, probe in enumerate((*wide, *narrow)):
        moved = rows.of(probe.motion) * rest.root[:, None]
        spread = np.repeat(probe.feature.T, r, axis=0)
        features = (moved[:, :, None] * spread[:, None, :]).reshape(len(moved), -1)
        found.append(Trace(probe.name, *share(features, rest, moved), doubts=number >= len(wide)))
    for one in names:
        moved = (one.motion * rest.root).T
        for name, functions in doubted(scene, one):
            spread = np.repeat(functions, r, axis=1) * rest.root
            features = (one.motion[:, None] * spread).reshape(-1, len(rest.root)).T
            found.append(Trace(name, *share(features, rest, moved), doubts=True))
        size = one.size(scene, rows)  # a law that is not in proportion to what drives it
        spread = np.repeat([size, size**2], r, axis=1) * rest.root
        found.append(Trace(f"{one.term.label} with its own size",
                           *share((one.whole * spread).T, rest, moved), doubts=True))  # fmt: skip
    found.append(Trace("a wave of two joint angles", *strongest_wave(scene, rows, rest)))
    found.append(Trace("poses compared with repeated poses", *repeats(scene, rest)))
    return tuple(found)


def heard(traces: Sequence[Trace], explained: float, count: int) -> Trace | None:
    """The least probable structure that matters, beside what was explained and beside the noise.

    explained: weighed square that the effects explain.  count: of rows.
    """
    least = max(MATTERS * explained, WORTH * count)
    loud = [t for t in traces if t.excess > least]
    quiet = [replace(t, p=max(t.p, 0.5)) for t in traces if not t.excess > least]
    if not chance_of([*loud, *quiet]) < STRUCTURE:
        return None
    return min(loud, key=lambda trace: trace.p)


def chance_of(traces: Sequence[Trace]) -> float:
    """Chance that noise alone shows so much in all traces together, in whatever way they depend.

    The Cauchy combination of their chances [Liu and Xie 2020].  Several that each are rare count
    together; the smallest times their number, by Bonferroni, would count one.  Questions to the
    names weigh together as much as all others: there a law that is in no library shows first.  A
    chance of 1 is of a question that these data cannot be asked.
    """
    asked = [trace for trace in traces if trace.p < 1.0]
    kinds = [[t.p for t in asked if t.doubts == doubts] for doubts in (False, True)]
    if not asked:
        return 1.0
    score = [np.mean(stats.cauchy.isf(np.clip(p, LEAST, MOST))) for p in kinds if p]
    return float(stats.cauchy.sf(np.mean(score)))


def explained(rows: Rows, choice: Choice) -> float:
    """Weighed square that the effects explain."""
    none = np.zeros((len(rows.error), 0))
    without, left = (rest_of(rows, choice.noise, known).total for known in (none, choice.known))
    return without - left


def share(features: Array, rest: Rest, motion: Array) -> tuple[float, float]:
    """F test that the rest has no more than its share in the span of features (N, D).

    If the pose that tells most is off by itself, without it: one outlier is no structure.  motion:
    (N, e) which the features are, times functions of the poses.
    """
    before = np.linalg.norm(features, axis=0)
    features = features[:, before > 0.0] / before[before > 0.0]
    features = features - rest.basis @ (rest.basis.T @ features)
    if not features.shape[1]:
        return 1.0, 0.0
    values, vectors = np.linalg.eigh(features.T @ features)
    poses = len(rest.rows) // rest.width
    most = max(int(min(SHARE * rest.dof, HALF_OF * poses * motion.shape[1])), 1)
    kept = np.flatnonzero(values > 1e-6 * max(float(values[-1]), 1e-4))[::-1][:most]
    unit = vectors[:, kept] / np.sqrt(values[kept])
    pull = unit.T @ (features.T @ rest.rows)
    d = len(kept)
    told = features @ unit
    field = told @ pull
    wide = inflation(field, rest.rows, rest.group, rest.dof)
    inside = float(pull @ pull) / wide
    outside = max(rest.total - inside, 1e-300)
    if d == 0 or rest.dof - d < 5:
        return 1.0, 0.0
    all_left = outside, float(rest.dof - d)
    p = exceeds(inside, d, all_left)
    if p < LOUD:
        by_itself = exceeds(inside, d, shrunk(rest.along(motion, told), all_left))
        if by_itself > p:
            signs = score_flips(float(pull @ pull), summed(told * rest.even[:, None], rest.group))
            p = max(p, min(by_itself, signs))
    own = rest.group == int(np.argmax(np.bincount(rest.group, field * rest.rows)))
    size = float(rest.rows[own] @ rest.rows[own])
    if stats.chi2.sf(size, own.sum()) * (rest.group.max() + 1) < STRUCTURE:
        gain, taken = float(field[own] @ rest.rows[own]) / wide, float((told[own] ** 2).sum())
        fewer, free = max(d - taken, 1.0), max(rest.dof - d - own.sum() + taken, 1.0)
        ratio = ((inside - gain) / fewer) / (max(outside - size + gain, 1e-300) / free)
        p = max(p, float(stats.f.sf(ratio, fewer, free)))
    return p, inside - d


def exceeds(told: float, d: int, left: tuple[float, float]) -> float:
    """p that so much is told by d functions, beside what is left: its square and freedom."""
    square, free = left
    return float(stats.f.sf((told / d) / max(square / free, 1e-300), d, free))


def shrunk(own: tuple[float, float], left: tuple[float, float]) -> tuple[float, float]:
    """What is left of a motion itself, taken to scatter as all does by `SCATTER`; or all, if less.

    own, left: square and degrees of freedom, of the motion and of all.
    """
    mean, free = left[0] / left[1], max(own[1], 0.0) + SCATTER
    square = max(own[0], 0.0) + SCATTER * mean
    return (square, free) if square > free * mean else left


def strongest_wave(scene: Scene, rows: Rows, rest: Rest) -> tuple[float, float]:
    """The strongest wave cos(a q_i + b q_j) of any joint, all waves tried."""
    angles = turning(scene)
    r = rows.width
    arms = rows.of(scene.jacobian) * rest.root[:, None]
    score = (arms * rest.rows[:, None]).reshape(-1, r, scene.joints).sum(axis=1)
    size = (arms**2).reshape(-1, r, scene.joints).sum(axis=1)
    harmonic = np.exp(1j * np.arange(FASTEST + 1)[:, None, None] * scene.q[angles])  # (f, a, m)
    if not angles:
        return 1.0, 0.0
    whole = size.sum(axis=0)

    def gain(waves: Array) -> Array:
        pull, square = waves @ score, (waves**2) @ size
        cc, ss, cs = 0.5 * (whole + square.real), 0.5 * (whole - square.real), 0.5 * square.imag
        det = cc * ss - cs**2
        good = det > 1e-3 * whole**2
        top = ss * pull.real**2 - 2.0 * cs * pull.real * pull.imag + cc * pull.imag**2
        return np.where(good, top / np.where(good, det, 1.0), 0.0)

    alone = gain(harmonic[1:].reshape(-1, scene.poses))
    found = [(alone.max(axis=0), 2, alone.size)]
    sums: list[Array] = []
    for i, j in combinations(range(len(angles)), 2):
        sums += [
            (harmonic[1:, None, i] * other[None]).reshape(-1, scene.poses)
            for other in (harmonic[1:, j], harmonic[1:, j].conj())
        ]
    if sums:
        each = gain(np.concatenate(sums)).reshape(len(sums) // 2, 2, -1, scene.joints)
        both = each.sum(axis=1)  # a product of waves is a sum wave and a difference wave
        found += [(each.max(axis=(0, 1, 2)), 2, each.size), (both.max(axis=(0, 1)), 4, both.size)]
    none = np.zeros((len(arms), 0))
    own = [rest.along(arms[:, [j]], none) for j in range(scene.joints)]
    best = (1.0, 0.0)
    for most, d, tries in found:
        for told, (square, left) in zip(most.tolist(), own, strict=True):
            all_left = max(rest.total - told, 1e-300), float(max(rest.dof - d, 1))
            p = max(exceeds(told, d, one) for one in (
                all_left, shrunk((square - told, left - d), all_left)))  # fmt: skip
            best = min(best, (min(1.0, p * tries * len(found)), told - d))
    return best


def repeats(scene: Scene, rest: Rest) -> tuple[float, float]:
    """F test of lack of fit: scatter between poses against scatter at the same pose.

    Without poses that are off by themselves: among few repeated poses there is none as a rule.
    """
    block = rest.rows.reshape(scene.poses, -1)
    used = np.count_nonzero(rest.root.reshape(block.shape), axis=1)
    size = (block**2).sum(axis=1)
    sound = stats.chi2.sf(size, np.maximum(used, 1)) * scene.poses >= STRUCTURE
    seen = np.where(rest.root.reshape(block.shape) > 0.0, block, np.nan)
    off, free = from_means(seen[sound], visits(scene.data)[sound])
    pure, pure_dof = float((off**2).sum()), round(float(free.sum()))
    dof = rest.dof - int(used[~sound].sum()) - pure_dof
    if pure_dof < 20 or dof < 20:
        return 1.0, 0.0
    between = float(size[sound].sum()) - pure
    ratio = (between / dof) / (pure / pure_dof)
    return float(stats.f.sf(ratio, dof, pure_dof)), between * (1.0 - 1.0 / ratio)
