"""Springs and masses of one arm that give way as the laws of a fit say.

A fit without known masses takes the torques of upper arm, forearm and wrist apart, joint by joint.
A simulator has one set of masses for all joints, so masses, centres of gravity and compliances are
chosen together: displacements are bilinear in compliances and in the first moments of the links.
What geometry, base and targets can take over does not count; they change with the springs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import scipy

from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.bending import TOOL_FLEX, bent, tilted
from minimax_cal.modelling.effects.scene import Scene, joint_of, turning, unmasked
from minimax_cal.modelling.effects.table import EFFECTS, Fitted, Term

Masses = tuple[Array, Array]  # (n,) [kg] and (n, 3) centres of gravity in the link frames [m]

BELIEF = 0.01  # what a mass or spring off by e, or a centre by 0.1 m, counts as [mm of all points]
NEAR = 0.1  # [m]
FELT = 1e-3  # of the largest: what moves less tells nothing of its spring
MOST = 30.0  # no spring is softer than the softest by itself, by this factor
RESOLVED = 1e-4  # of the largest singular value: what geometry is asked to take over
LEAST = 1e-12  # a smaller compliance is none [rad/(N m)]


TRACELESS = np.linalg.svd(np.eye(3).reshape(1, 9))[2][1:].T  # (9, 8) matrices without a trace


@dataclass(frozen=True, eq=False)
class Springs:
    """held: of an arm: `turn`, `bend`, `base`, `mass`, `com`, and `remainder`: RMS distance from
    the laws, or from the measurements [m].

    sag, drawn: of the tool: (3, 3) turn per direction of gravity [rad], and along its z [m].
    change: of geometry, base and targets, in the order of `Names` [m, rad].  firm: of the
    parameters of effects that elements hold exactly.
    """

    held: dict[str, Any]
    sag: Array
    drawn: float
    change: Array
    firm: Array


def springs_of(
    scene: Scene,
    laws: Fitted,
    left: Array,
    geometry: Array,
    firm: Sequence[Term],
    masses: Masses,
    *,
    fixed: bool,
) -> Springs:
    """The springs that imitate laws at the poses of a scene.

    left: (k, 3, m) what the laws leave of measurements, in base axes, NaN where not measured, so
    that the springs explain these; 0 where the laws count alone [m].
    geometry: (k, 3, m, p) motion of the points per unit of every parameter of the geometry.
    firm: effects that elements hold exactly; their values change with the springs.
    masses: to begin with, or to keep where they are fixed.
    """
    wanted = sum(
        (np.tensordot(v, t.columns(scene).displacement(scene), 1)
         for t, v in laws.pairs),
        np.zeros(scene.points.shape),
    )  # fmt: skip
    seen = np.isfinite(left).reshape(-1)
    kinds = places_of(scene, laws)
    fields = 1e3 * np.array([per_moment(scene, *kind) for kind in kinds])
    fields = fields.reshape(len(kinds), 4 * scene.joints, wanted.size)[..., seen]
    right = 1e3 * (wanted + left).reshape(-1)[seen]
    parts = [1e3 * part.reshape(wanted.size, -1)[seen]
             for part in beside(scene, laws, geometry, firm)]  # fmt: skip
    columns, count = np.hstack(parts), parts[0].shape[1]
    tool = count + sum(part.shape[1] for part in parts[1 : 1 + len(firm)])
    u, size, back = np.linalg.svd(columns, full_matrices=False)
    kept = size > RESOLVED * size[0]
    u, inverse = u[:, kept], (back[kept].T / size[kept]) @ u[:, kept].T
    mass, com = masses
    clear, goal = condensed(fields - (fields @ u) @ u.T, right - u @ (u.T @ right))
    points, none = len(right) / 3.0, np.zeros((3, 3))
    soft = np.zeros(0)
    if kinds:
        each = np.einsum("l,elr->re", moments(mass, com), clear)
        felt = np.linalg.norm(each, axis=0)
        soft = scipy.optimize.nnls(each * (felt > FELT * felt.max()), goal)[0]
    if kinds and not fixed:
        soft = started(soft, [kind for kind, _ in kinds])
        soft, mass, com = together(clear, goal, soft, masses, points)
        felt = np.linalg.norm(np.einsum("l,elr->er", moments(mass, com), clear), axis=1) * soft
        soft = np.where(felt > FELT * felt.max(), soft, 0.0)
    sizes = np.einsum("e,l->el", soft, moments(mass, com))
    rest = goal - np.einsum("el,elr->r", sizes, clear)
    change = inverse @ (right - np.einsum("el,elr->r", sizes, fields))
    values = dict(zip(kinds, (float(c) if c > LEAST else 0.0 for c in soft), strict=True))
    held = {
        "turn": np.array([values.get(("joint", j), 0.0) for j in range(scene.joints)]),
        "bend": {i: c for (kind, i), c in values.items() if kind == "link" and c > 0.0},
        "base": values.get(("base", 0), 0.0), "mass": mass, "com": com,
        "remainder": 1e-3 * float(np.sqrt((rest**2).sum() / points)),
    }  # fmt: skip
    sag = (TRACELESS @ change[tool : tool + 8]).reshape(3, 3) if len(change) > tool else none
    drawn = float(change[tool + 8]) if len(change) > tool else 0.0
    return Springs(held, sag, drawn, change[:count], change[count:tool])


def beside(scene: Scene, laws: Fitted, geometry: Array, firm: Sequence[Term]) -> Iterator[Array]:
    """Motions (k, 3, m, d) of what is fitted with the springs: geometry, firm effects, the tool."""
    yield geometry
    for term in firm:
        yield np.moveaxis(term.columns(scene).displacement(scene), 0, -1)
    if any(EFFECTS[term.effect].moves == "tool" for term in laws.terms):
        yield tool_columns(scene)


def places_of(scene: Scene, laws: Fitted) -> list[tuple[str, int]]:
    """What gives way: joints, links, the base; for a whole arm all joints that turn."""
    out: dict[tuple[str, int], None] = {}
    for term in laws.terms:
        if "parts" in term.choice:
            joints = [part // 4 for part in unmasked(term.choice["parts"])]
            out |= {("joint", j): None for j in (turning(scene) if term.place == "all" else joints)}
        elif term.place[0] == "L":
            out[("link", joint_of(term.place))] = None
        elif EFFECTS[term.effect].moves == "foot":
            out[("base", 0)] = None
    return list(out)


def tool_columns(scene: Scene) -> Array:
    """(k, 3, m, 9) motion of the points for every way in which weights can make the tool sag.

    Eight turns per direction of gravity, none of them about gravity itself; drawn along z.
    """
    whole = Term(TOOL_FLEX.name, "all", {"lever": 2.0}).columns(scene).displacement(scene)
    turns = np.einsum("dkcm,de->kcme", whole[:9], TRACELESS)
    return np.concatenate([turns, whole[9][..., None]], axis=-1)


def moments(mass: Array, com: Array) -> Array:
    """(4 n,) mass and first moments of each link [kg, kg m]."""
    return np.concatenate([mass[:, None], mass[:, None] * com], axis=1).reshape(-1)


def per_moment(scene: Scene, kind: str, place: int) -> Array:
    """(4 n, k, 3, m) displacement of a spring of compliance 1, for each mass and first moment."""
    verbs: dict[str, Callable[..., Array]] = {
        "joint": partial(turned, joint=place),
        "link": partial(bent, link=place),
        "base": tilted,
    }
    verb = verbs[kind]
    out, n = [], scene.joints
    for link in range(n):
        mass, com = np.zeros(n), np.zeros((n, 3))
        mass[link] = 1.0
        alone = verb(scene, mass=mass, com=com)
        out.append(alone)
        for axis in range(3):
            moved = com.copy()
            moved[link, axis] = 1.0
            out.append(verb(scene, mass=mass, com=moved) - alone)
    return np.array(out)


def turned(scene: Scene, mass: Array, com: Array, joint: int) -> Array:
    """(k, 3, m) motion of the targets when a joint turns by the torque about it."""
    return np.asarray(scene.torque(mass, com)[joint] * scene.jacobian[joint])


def condensed(fields: Array, right: Array) -> tuple[Array, Array]:
    """The same least squares in as many rows as there are fields.

    fields: (e, l, rows).  right: (rows,).
    """
    e, moments_, rows = fields.shape
    every = np.vstack([fields.reshape(-1, rows), right]).T
    triangle = np.asarray(np.linalg.qr(every, mode="r"))
    return triangle[:, :-1].T.reshape(e, moments_, -1), triangle[:, -1]


def together(
    fields: Array, right: Array, soft: Array, masses: Masses, points: float
) -> tuple[Array, Array, Array]:
    """Compliances, masses and centres that imitate displacements best [mm].

    fields: (e, 4 n, rows) per unit of compliance and moment.  right: (rows,).  soft: (e,) to begin
    with.  points: how many there are.
    """
    mass, com = masses
    e, n = len(soft), len(mass)
    start = np.concatenate([np.log(soft), np.zeros(4 * n)])
    weight = BELIEF * np.sqrt(points / (e + 4.0 * n))

    def split(x: Array) -> tuple[Array, Array, Array]:
        factors, off = x[e : e + n], x[e + n :].reshape(n, 3)
        return np.exp(x[:e]), mass * np.exp(factors), com + NEAR * off

    def residual(x: Array) -> Array:
        c, m, at = split(x)
        left = np.einsum("el,elr->r", np.outer(c, moments(m, at)), fields) - right
        return np.concatenate([left, weight * (x - start)])

    def jacobian(x: Array) -> Array:
        c, m, at = split(x)
        by_soft = np.einsum("l,elr->er", moments(m, at), fields) * c[:, None]
        by_moment = np.einsum("e,elr->lr", c, fields).reshape(n, 4, -1) * m[:, None, None]
        by_mass = by_moment[:, 0] + np.einsum("na,nar->nr", at, by_moment[:, 1:])
        by_com = NEAR * by_moment[:, 1:].reshape(3 * n, -1)
        return np.vstack([np.concatenate([by_soft, by_mass, by_com]).T, weight * np.eye(len(x))])

    ends = np.concatenate([np.full(e, 2.0 * np.log(MOST)), np.full(4 * n, 3.0)])
    found = scipy.optimize.least_squares(
        residual, start, jacobian, bounds=(start - ends, start + ends), max_nfev=300
    )
    return split(found.x)


def started(soft: Array, kinds: Sequence[str]) -> Array:
    """Compliances to begin with: those of 0 like the others of their kind."""
    out = soft.copy()
    known = soft > LEAST
    for i in np.flatnonzero(~known):
        alike = [j for j in range(len(kinds)) if known[j] and kinds[j] == kinds[int(i)]]
        out[i] = np.exp(np.log(soft[alike or known]).mean()) if known.any() else LEAST
    return out
