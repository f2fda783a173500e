"""What to measure next, so that two effects which these data confuse can be told apart.

Every proposal is computed as if it had been carried out: its poses are added to those at hand, the
geometry and the other effects are fitted to all of them, and what is left of the named effect's
motion once its rival has imitated it is weighed by the noise of instrument and joints.  All that is
new is measured after what is there: the clock of the session goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from minimax_cal.evidence.limits import COVERED, ENOUGH, HELPFUL, NO_POWER
from minimax_cal.evidence.noise import Noise, identified
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.linear_algebra import column_scales, schur_complement
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import EFFECTS, Term, fields_of, of_sessions
from minimax_cal.modelling.model import Model
from minimax_cal.modelling.parameters import State
from minimax_cal.modelling.rows import Rows, rows_of
from minimax_cal.robots.transforms import level_to

MORE, AGAIN = (10, 20, 40, 80), (10, 20, 40)  # poses of a proposal
MINUTE = 1.0  # to move, settle and measure all targets of a pose [min]
PREPARE = {"more": 0.0, "late": 5.0, "side": 5.0, "load": 15.0, "foot": 20.0}  # once [min]
GOLDEN = 0.6180339887498949
STEP = 0.1  # move by which a pose is approached from its other side [rad, m]
LOAD = 0.03  # payload that is proposed, as a share of the arm's mass
FOOT = 0.2  # radius of the reflectors on the foot, as a share of the reach
FITTED_RIDGE = 1e-13  # of a unit column that is fitted: what no pose shows stays finite
SAME = 1e-6  # relative change of a field below which a proposal does not concern an effect


@dataclass(frozen=True)
class Advice:
    """One further measurement.

    text: for the person who carries it out.  minutes: what it costs, by `MINUTE` and `PREPARE`.
    power: lambda (1 - rho^2) on old and new poses together; `ENOUGH` tells the effects apart.
    """

    text: str
    minutes: float
    power: float


@dataclass(frozen=True, eq=False)
class Pair:
    """An effect and the rival that data confuse with it.

    value: (d,) what was fitted of the one.  known: other effects that were found, with values.
    """

    one: Term
    value: Array
    other: Term
    known: Sequence[tuple[Term, Array]] = ()


@dataclass(frozen=True, eq=False)
class Plan:
    """The poses at hand and all that are proposed, one after another.

    data: every row.  weight: (k, m) of its points.  at: first row and count of each kind.
    """

    data: Measurements
    weight: Array
    at: dict[str, tuple[int, int]]

    def rows(self, kind: str, count: int) -> slice:
        """The first so many poses of a kind."""
        start, most = self.at[kind]
        return slice(start, start + min(count, most))


@dataclass(frozen=True, eq=False)
class Site:
    """A fitted cell with poses that might be measured; shared by all pairs of effects.

    scene: of the poses at hand, with their history.  model, state: the geometry fitted to them.
    noise: of instrument and joints.
    """

    scene: Scene
    model: Model
    state: State
    noise: Noise
    seed: int = 0

    @cached_property
    def plan(self) -> Plan:
        """What may be measured."""
        return plan(self.scene, self.model.weight, np.random.default_rng(self.seed))

    @cached_property
    def whole(self) -> Scene:
        """The scene of all rows of the plan."""
        robot, base = self.scene.robot, (self.scene.rotation, self.scene.origin)
        data = self.plan.data
        return Scene.of(robot, data, base, self.scene.target_positions, robot.turned(data.q))

    @cached_property
    def turned(self) -> Rows:
        """Rotations of the rows that make both noises diagonal."""
        k, _, m = self.whole.points.shape
        nothing = np.zeros((k, 0, 3, m))
        return rows_of(np.zeros((k, 3, m)), nothing, self.whole.jacobian, self.plan.weight)

    @cached_property
    def root(self) -> Array:
        """(N,) square roots of the weights of rows [1/m]."""
        joints = self.noise.jitter**2 * self.turned.variance_ratio * self.turned.size
        return np.asarray(1.0 / np.sqrt(self.noise.variance + joints))

    @cached_property
    def geometry(self) -> Array:
        """(N, p) how every row follows the geometry [m per unit]."""
        k, _, m = self.whole.points.shape
        model = replace(
            self.model,
            q=self.scene.robot.turned(self.plan.data.q),
            y=np.zeros((k, 3, m)),
            weight=self.plan.weight,
        )
        if free := of_sessions(self.plan.data.frames):
            fields = fields_of(free, self.whole)
            model = replace(model, fields=fields, moved=np.zeros((0, 0, 0)))
        return self.turned.of(np.moveaxis(model.jacobian(self.state), (3, 0), (0, 3)))

    def lines(self, poses: slice) -> slice:
        """The rows of some poses."""
        per = 3 * self.whole.targets
        return slice(poses.start * per, poses.stop * per)

    @cached_property
    def spans(self) -> dict[tuple[str, int], Array]:
        """(p, r) per proposal: the combinations of geometric parameters that can be fitted."""
        gram = {
            key: own.T @ own
            for key in self.proposals
            for own in [self.geometry[self.lines(self.plan.rows(*key))]]
        }
        old = gram["old", self.scene.poses]
        return {
            key: identified(old if key[0] in ("old", "foot") else old + gram[key])
            for key in self.proposals
        }

    @cached_property
    def proposals(self) -> tuple[tuple[str, int], ...]:
        """Kinds and counts of poses, first the data as they are."""
        sizes = {kind: MORE if kind == "more" else AGAIN for kind in PREPARE}
        listed = [
            (kind, count)
            for kind, counts in sizes.items()
            for count in sorted({min(c, self.plan.at[kind][1]) for c in counts})
        ]
        return (("old", self.scene.poses), *listed)


# ---- what might be measured --------------------------------------------------------------------


def plan(scene: Scene, weight: Array, rng: np.random.Generator) -> Plan:
    """The existing poses, and after them those that are proposed."""
    m, n = scene.poses, scene.joints
    tip, up = scene.points.mean(axis=0), scene.robot.up
    reach = np.linalg.norm(tip - up[:, None] * (up @ tip), axis=0)  # from the vertical at the base
    outer = np.argsort(-reach, kind="stable")[: max(AGAIN)]
    first = np.argsort(scene.column("clock"), kind="stable")[: max(AGAIN)]
    old = with_columns(scene.data, scene)
    like = rng.integers(0, m, max(MORE))  # which targets are seen, and what is not told below
    some = [old, more(scene, old.take(like), rng)]
    fresh = 1.0 + (np.arange(len(outer)) + 0.5) * GOLDEN % 1.0  # all over another session
    again = then(old.take(outer), clock=fresh)
    last = {name: again.columns[name] for name in (f"approach{j + 1}" for j in range(n))}
    sides = {name: np.where(side == 0.0, 1.0, -side) for name, side in last.items()}
    moves = {f"move{j + 1}": STEP * sides[f"approach{j + 1}"] for j in range(n)}
    heavier = again.columns["payload"] + payload(scene)
    hung = then(again, payload=heavier, **hanging(scene, outer, payload(scene)))
    read = old.columns.get("temperature", np.zeros(0))
    warm: dict[str, Array] = {}
    if np.isfinite(read).any():  # as high as it was
        warm = {"temperature": np.full(len(first), np.nanmax(read))}
    late = then(old.take(first), clock=1.0 + (np.arange(len(first)) + 1.0) / m, **warm)
    some += [late, again, hung, then(again, **sides, **moves)]
    parts = [weight[:, rows] for rows in (np.arange(m), like, first, outer, outer, outer)]
    starts = np.cumsum([0, *(part.poses for part in some)])
    kinds = ("old", "more", "late", "foot", "load", "side")
    at = {
        kind: (int(start), part.poses)
        for kind, start, part in zip(kinds, starts[:-1], some, strict=True)
    }
    return Plan(old.followed_by(*some[1:]), np.concatenate(parts, axis=1), at)


def with_columns(data: Measurements, scene: Scene) -> Measurements:
    """The data with a payload and whole numbers as floats, so that rows can be changed."""
    columns = {
        name: column.astype(float) if column.dtype.kind in "biuf" else column
        for name, column in data.columns.items()
    }
    return replace(data, columns={**columns, "payload": scene.column("payload")})


def then(data: Measurements, **columns: Array) -> Measurements:
    """The same rows with other columns."""
    return replace(data, columns={**data.columns, **columns})


def payload(scene: Scene) -> float:
    """A payload that such an arm surely carries: 1, 2 or 5 times a power of ten [kg]."""
    target = LOAD * float(scene.masses[0].sum())
    ten = 10.0 ** np.floor(np.log10(max(target, 0.1)))
    return float(max(step * ten for step in (1.0, 2.0, 5.0) if step * ten <= max(target, ten)))


def hanging(scene: Scene, rows: Array, mass: float) -> dict[str, Array]:
    """Measured torques with a further payload, where torques were measured."""
    if not scene.measured_torques:
        return {}
    one = np.ones(scene.poses)
    heavy = then(scene.data, payload=one)
    torque = replace(scene, data=heavy).payload * scene.robot.sign[:, None] * mass
    return {
        f"tau{j + 1}": scene.data.columns[f"tau{j + 1}"][rows] + torque[j, rows]
        for j in range(scene.joints)
        if f"tau{j + 1}" in scene.data.columns
    }


def bounds(scene: Scene) -> tuple[Array, Array]:
    """(n,) the joints' limits; where the robot file has none, what the data span."""
    q, robot = scene.data.q, scene.robot
    low, high = q.min(axis=0), q.max(axis=0)
    most = np.where(robot.prismatic, np.inf, np.maximum(np.pi, np.abs(q).max(axis=0)))
    lower = np.where(np.isfinite(robot.lower), np.maximum(robot.lower, -most), low)
    upper = np.where(np.isfinite(robot.upper), np.minimum(robot.upper, most), high)
    return np.minimum(lower, upper), np.maximum(lower, upper)


def more(scene: Scene, like: Measurements, rng: np.random.Generator) -> Measurements:
    """Random poses within the bounds, above the floor, about as far from the instrument."""
    robot, count = scene.robot, like.poses
    q = rng.uniform(*bounds(scene), (32 * count, scene.joints))
    flange = robot.pose(q)[:, :3, 3].T
    there = scene.links.origin
    floor = min(0.1 * robot.reach(), float((robot.up @ there).min()))
    seen = np.linalg.norm(there - scene.instrument[:, None], axis=0)
    away = np.linalg.norm(flange - scene.instrument[:, None], axis=0)
    off = np.maximum(floor - robot.up @ flange, 0.0) + np.abs(
        away - np.clip(away, seen.min(), seen.max())
    )
    return visited_after(scene, like, q[np.argsort(off, kind="stable")[:count]])


def visited_after(scene: Scene, like: Measurements, q: Array) -> Measurements:
    """Poses (m, n) measured one after another once the data at hand are.

    like: m rows with the columns that the way there does not tell.
    """
    last = scene.data.q[int(np.argmax(scene.column("clock")))]
    move = np.diff(q, axis=0, prepend=last[None])
    history = {f"move{j + 1}": move[:, j] for j in range(scene.joints)}
    history |= {f"approach{j + 1}": np.sign(move[:, j]) for j in range(scene.joints)}
    clock = 1.0 + (np.arange(len(q)) + 1.0) / scene.poses
    moved = replace(then(like, **history, clock=clock, followed=np.ones(len(q))), q=q)
    return then(moved, **predicted(scene, moved))


def predicted(scene: Scene, data: Measurements) -> dict[str, Array]:
    """Torques that would be measured at other poses, by the weights that those at hand suggest."""
    if not scene.measured_torques:
        return {}
    robot, base = scene.robot, (scene.rotation, scene.origin)
    there = Scene.of(robot, data, base, scene.target_positions, robot.turned(data.q))
    mass, com = scene.masses
    links = np.diag(mass)
    known, new = ([s.torque(one, com) for one in links] for s in (scene, there))
    out = {}
    for j in range(scene.joints):
        if f"tau{j + 1}" in scene.data.columns:
            tau = scene.data.columns[f"tau{j + 1}"]
            old = np.stack([part[j] for part in known] + [np.ones(scene.poses)], axis=1)
            ahead = np.stack([part[j] for part in new] + [np.ones(data.poses)], axis=1)
            told = np.isfinite(tau)
            out[f"tau{j + 1}"] = ahead @ np.linalg.lstsq(old[told], tau[told], rcond=1e-6)[0]
    return out


# ---- what it would tell ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Fields:
    """Motions by some effects.

    points: (d, k, 3, m) of the targets at all rows of the plan [m].
    foot: (d, 3, 3, poses) of three points of the foot [m].
    ridge: (d,) inverse variance of what is known of each.
    """

    points: Array
    foot: Array
    ridge: Array


def fields(site: Site, term: Term) -> tuple[Fields, Fields, list[int]]:
    """Motion per unit of each parameter; the doubts about it, and the parameter of each."""
    scene, k = site.whole, site.scene.targets
    base = EFFECTS[term.effect].of_base
    if base:  # probes about the targets' centre tell how the law moves any point of the base
        centre = scene.points.mean(axis=0)
        probes = np.concatenate([np.eye(3), -np.eye(3)])[:, :, None] + centre
        scene = replace(scene, points=np.concatenate([scene.points, probes]))
    columns = term.columns(scene)
    doubts, owners = [np.zeros((0, *scene.points.shape))], []
    for owner, part in columns.doubts(scene):
        doubts.append(part)
        owners += [owner] * len(part)
    out = []
    for one in (columns.displacement(scene), np.concatenate(doubts)):
        foot = at_foot(site, one[:, k:], centre) if base else np.zeros((len(one), 3, 3, 0))
        out.append(Fields(one[:, :k], foot, np.zeros(len(one))))
    return out[0], out[1], owners


def at_foot(site: Site, probes: Array, centre: Array) -> Array:
    """(d, 3, 3, poses) motion of three points of the foot.  probes: (d, 6, 3, m) as `fields`."""
    rows = site.plan.rows("foot", max(AGAIN))
    across = level_to(site.scene.robot.up)
    angle = 2.0 * np.pi * np.arange(3) / 3.0
    feet = FOOT * site.scene.robot.reach() * np.stack([np.cos(angle), np.sin(angle)], 1) @ across
    mean = probes[..., rows].mean(axis=1)
    jacobian = 0.5 * (probes[:, :3, :, rows] - probes[:, 3:, :, rows])
    arm = feet[:, :, None] - centre[None, :, rows]
    return np.asarray(mean[:, None] + np.einsum("fam,dacm->dfcm", arm, jacobian))


def beside(site: Site, known: Sequence[tuple[Term, Array]]) -> list[Fields]:
    """Effects that are fitted along with the geometry, with their doubts as priors."""
    out = []
    for term, value in known:
        main, doubt, owners = fields(site, term)
        size = np.maximum(np.abs(value[owners]), 1e-30)
        out += [main, replace(doubt, ridge=1.0 / size**2)]
    return out


def powers(site: Site, pair: Pair) -> dict[tuple[str, int], float]:
    """Power to tell the two apart: now (`old`), and with each proposal that concerns them."""
    mine, _, _ = fields(site, pair.one)
    moved, foot = (np.tensordot(pair.value, part, 1)[None] for part in (mine.points, mine.foot))
    found = Fields(moved, foot, np.zeros(1))
    rival = list(fields(site, pair.other)[:2])
    fitted = beside(site, pair.known)
    count = sum(len(part.ridge) for part in fitted)
    columns, poses = [*fitted, found, *rival], site.plan.at["foot"][1]
    everything = Fields(
        np.concatenate([part.points for part in columns]),
        np.concatenate([
            part.foot if part.foot.shape[-1] else np.zeros((*part.foot.shape[:-1], poses))
            for part in columns  # that do not move the foot leave it still
        ]),
        np.concatenate([part.ridge for part in columns]),
    )  # fmt: skip
    p = site.geometry.shape[1]
    rows = np.concatenate([site.geometry, site.turned.of(everything.points)], axis=1)
    rows *= site.root[:, None]

    def products(key: tuple[str, int]) -> Array:
        kind, number = key
        if kind != "foot":
            part = rows[site.lines(site.plan.rows(kind, number))]
            return np.asarray(part.T @ part)
        out = np.zeros((rows.shape[1],) * 2)
        feet = everything.foot[..., :number]
        feet = feet - feet.mean(axis=-1, keepdims=True)  # where they sit is not known
        flat = feet.reshape(len(feet), -1)
        out[p:, p:] = flat @ flat.T / site.noise.variance
        return out

    old = products(site.proposals[0])
    old[np.arange(p, len(old)), np.arange(p, len(old))] += everything.ridge
    concerned = {"old", "more", *concerning(site, everything, count)}
    out = {}
    for key in site.proposals:
        if key[0] in concerned:
            gram = old if key[0] == "old" else old + products(key)
            span = site.spans[key]
            half = np.concatenate([span.T @ gram[:p], gram[p:]])
            whole = np.concatenate([half[:, :p] @ span, half[:, p:]], axis=1)
            # What remains of the effect's motion once the rival has imitated it.
            left = schur_complement(whole, span.shape[1] + count, FITTED_RIDGE)
            scale = 1.0 / column_scales(left[1:, 1:])
            unit = left[1:, 1:] * scale * scale[:, None]
            inverse = np.linalg.pinv(unit, 1e-9, hermitian=True)
            across = left[0, 1:] * scale
            out[key] = float(max(left[0, 0] - across @ inverse @ across, 0.0))
    return out


def concerning(site: Site, everything: Fields, known: int) -> list[str]:
    """Kinds of revisits at which the effect or its rival moves a point otherwise than before."""
    points = everything.points[known:]
    found = ["foot"] if np.any(everything.foot[known:]) else []
    first = np.argsort(site.scene.column("clock"), kind="stable")[: max(AGAIN)]
    again = points[..., site.plan.rows("foot", max(AGAIN))]
    for kind, before in (("late", points[..., first]), ("load", again), ("side", again)):
        after = points[..., site.plan.rows(kind, max(AGAIN))]
        change, size = (np.abs(x).max(axis=(1, 2, 3)) for x in (after - before, before))
        if np.any(change > SAME * size):
            found.append(kind)
    return found


def separate(site: Site, pair: Pair) -> tuple[Advice, ...]:
    """Further measurements that may tell an effect from a rival, the cheapest first."""
    found = powers(site, pair)
    advices = [
        Advice(words(site, kind, count), PREPARE[kind] + MINUTE * count, power)
        for (kind, count), power in found.items()
        if kind != "old"
    ]
    return tuple(sorted(advices, key=lambda advice: advice.minutes))


def separate_with(site: Site, pair: Pair) -> str:
    """The cheapest measurement that has enough power; else the strongest, and what it lacks."""
    advices = separate(site, pair)
    for advice in advices:
        if advice.power >= ENOUGH:
            return advice.text
    best = max(advices, key=lambda advice: advice.power)
    if pair.one.effect == pair.other.effect and best.power < NO_POWER:
        return "no measurement can: one includes the other; more poses show what it has besides"
    raises = f"raises the power to {best.power:.2g} of the {ENOUGH:.0f} needed"
    if best.power < HELPFUL * ENOUGH:
        return f"no measurement considered is enough: the best {raises}"
    return f"{best.text}; that {raises}"


# ---- in words ----------------------------------------------------------------------------------


def words(site: Site, kind: str, count: int) -> str:
    """A proposal as one would say it to a technician."""
    scene = site.scene
    if kind == "more":
        # Over the joints by which further poses reach farther than those at hand.
        lower, upper = bounds(scene)
        narrow = np.ptp(scene.data.q, axis=0) < COVERED * (upper - lower)
        names = [str(j + 1) for j in np.flatnonzero(narrow)]
        where = f"over the whole range of joint{'s' if len(names) > 1 else ''} "
        where += " and ".join([*filter(None, [", ".join(names[:-1])]), *names[-1:]])
        if not names:
            where = "all over the workspace"
        elif len(names) == scene.joints:
            where = "over the whole range of all joints"
        return f"measure {count} more poses {where}"
    if kind == "load":
        extra = " more" if scene.column("payload").any() else ""
        return (
            f"measure the {count} poses that reach out farthest again, with a payload of "
            f"{payload(scene):g} kg{extra}"
        )
    return {
        "late": f"measure the first {count} poses again at the end, with the arm warm",
        "side": f"measure {count} of these poses again, each approached from its other side by a "
        "short move of all joints",
        "foot": "put three reflectors on the robot's foot, far apart, and measure them at the "
        f"{count} poses that reach out farthest",
    }[kind]
