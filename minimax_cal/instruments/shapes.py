"""Planes, spheres and the faces of one body, and where they are without a guess."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import scipy

from minimax_cal.ground.arrays import Array
from minimax_cal.instruments.instrument import SPOT, scaled_lstsq, spots_aside
from minimax_cal.instruments.protocol import FlangePoses
from minimax_cal.instruments.wires import linear_target
from minimax_cal.robots.kinematics import rotation
from minimax_cal.robots.transforms import nearest_rotation

PLANE, SPHERE = "plane", "sphere"

MAX_STARTS, MAX_TRIES = 3, 60  # places of the ball that are refined; gaps looked at for each
ROUNDS = 5  # of a sphere's fit by its distances
BODY = tuple(f"body_{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))


@dataclass(frozen=True, eq=False)
class Surface:
    """What a probe touches.

    kind: PLANE or SPHERE.  size: radius of a sphere, or offset of a face from the body's origin
    along its normal, NaN where not known [m].  normal: (3,) outward in the body's frame of a plane
    that is a face of the body, else (0,).
    """

    label: str
    kind: str = PLANE
    size: float = np.nan
    normal: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def is_face(self) -> bool:
        """Whether it is a face of the body."""
        return bool(len(self.normal))

    @property
    def ends(self) -> tuple[str, ...]:
        """Endings of its own parameters' names, the size last."""
        if self.kind == SPHERE:
            return ("x", "y", "z", "radius")
        return ("offset",) if self.is_face else ("tilt1", "tilt2", "offset")


@dataclass(frozen=True, eq=False)
class Shapes:
    """Which surfaces there are, and where their parameters stand among the instrument's own.

    surfaces: s of them.  axes: (s, 3, 3) rows n, u, v: of a plane the normal from which its tilts
    count, and two axes across it.  turn: (3, 3) rotation from which the body's turn counts.
    """

    surfaces: tuple[Surface, ...]
    ball_radius: float
    axes: Array
    turn: Array

    @property
    def has_body(self) -> bool:
        """Whether some are faces of a body."""
        return any(surface.is_face for surface in self.surfaces)

    def own(self) -> tuple[str, ...]:
        """Names: target, surfaces, body, radius of the ball."""
        names = [f"surface_{s.label}_{end}" for s in self.surfaces for end in s.ends]
        return (*SPOT, *names, *(BODY if self.has_body else ()), "ball_radius")

    def given(self) -> tuple[str, ...]:
        """Those of them whose values are given."""
        known = [(f"surface_{s.label}_{s.ends[-1]}", s.size) for s in self.surfaces]
        known += [("ball_radius", self.ball_radius)]
        return tuple(name for name, value in known if np.isfinite(value))

    def slots(self) -> list[slice]:
        """Of each surface."""
        ends = 3 + np.cumsum([0, *(len(s.ends) for s in self.surfaces)])
        return [slice(int(a), int(b)) for a, b in pairwise(ends)]

    def body(self, own: Array) -> tuple[Array, Array]:
        """Rotation (3, 3) and origin (3,) of the body."""
        return self.turn @ rotation(own[-4:-1]), own[-7:-4]

    def plane(self, at: int, own: Array) -> tuple[Array, Array, Array]:
        """Normal (3,) of a plane, and its derivatives by the two tilts."""
        n0, u, v = self.axes[at]
        a, b, _ = own[self.slots()[at]]
        size = np.sqrt(1.0 + a**2 + b**2)
        n = (n0 + a * u + b * v) / size
        one, other = ((w - n * (n @ w)) / size for w in (u, v))
        return n, one, other


# ---- a start without a guess -------------------------------------------------------------------


def fit_plane(p: Array) -> tuple[Array, float]:
    """Normal (3,) and offset of the plane that points (m, 3) lie on best [m]."""
    centre = p.mean(axis=0)
    normal = np.linalg.svd(p - centre, full_matrices=False)[2][-1]
    return normal, float(normal @ centre)


def fit_sphere(p: Array, radius: float) -> tuple[Array, float]:
    """Centre (3,) and radius of the sphere that points (m, 3) lie on best [m].

    Algebraic, |p|^2 = 2 p.C + k, then by distances.  radius: given, or NaN.
    """
    middle = p.mean(axis=0)
    q = p - middle
    found = scaled_lstsq(np.column_stack([2.0 * q, np.ones(len(q))]), (q**2).sum(axis=1))
    centre, size = found[:3], float(np.sqrt(max(found[3] + found[:3] @ found[:3], 1e-12)))
    size = radius if np.isfinite(radius) else size
    for _ in range(ROUNDS):
        off = q - centre
        distance = np.maximum(np.linalg.norm(off, axis=1), 1e-12)
        columns = [-off / distance[:, None], np.full((len(q), int(np.isnan(radius))), -1.0)]
        step = scaled_lstsq(np.concatenate(columns, axis=1), size - distance)
        centre, size = centre + step[:3], size + float(step[3:].sum())
    return middle + centre, size


def found_on(
    p: Array, surfaces: Sequence[Surface], ball: float, touched: Array
) -> list[tuple[Array, float]]:
    """The best plane or sphere through the ball's centres p (m, 3) of each surface."""
    out = []
    for at, surface in enumerate(surfaces):
        here = p[touched == at]
        out.append(
            fit_sphere(here, surface.size + ball) if surface.kind == SPHERE else fit_plane(here)
        )
    return out


def linear_spots(arm: FlangePoses, surfaces: Sequence[Surface], touched: Array) -> list[Array]:
    """Places (3,) of the ball on the flange that each surface by itself suggests [m].

    With the last frame (R, o), a plane's n.(o + R t) = c is linear and homogeneous in n, the nine
    products n t' and c; of a sphere see `wires.linear_target`.
    """
    out = []
    for at, surface in enumerate(surfaces):
        here = touched == at
        o, turn = arm.origin[here], arm.rotation[here]
        if surface.kind == SPHERE:
            some = arm._replace(origin=o, rotation=turn)
            out.append(linear_target(some, np.zeros((len(o), 1)), with_offset=False))
            continue
        rows = np.concatenate([o, turn.reshape(len(o), 9), -np.ones((len(o), 1))], axis=1)
        found = np.linalg.svd(rows)[2][-1]
        size = max(float(found[:3] @ found[:3]), 1e-12)
        out.append(found[:3] @ found[3:12].reshape(3, 3) / size)
    return [spot for spot in out if np.isfinite(spot).all()]


def placed_best(
    arm: FlangePoses, surfaces: tuple[Surface, ...], ball: float, touched: Array
) -> tuple[Shapes, Array]:
    """Where ball and surfaces fit the arm as drawn best, and their values.

    For a given place of the ball on the flange each surface is found in closed form, which leaves
    three unknowns: least squares from several places.
    """

    def found(spot: Array) -> tuple[Array, list[tuple[Array, float]]]:
        p = arm.place(spot)
        return p, found_on(p, surfaces, ball, touched)

    def misses(spot: Array) -> Array:
        p, each = found(spot)
        out = np.zeros(len(p))
        for at, (place, size) in enumerate(each):
            here = touched == at
            round_ = surfaces[at].kind == SPHERE
            reached = np.linalg.norm(p[here] - place, axis=1) if round_ else p[here] @ place
            out[here] = reached - size
        return out

    spots = [*linear_spots(arm, surfaces, touched), *spots_aside(arm, np.zeros(3))[1:]]
    best = sorted(spots, key=lambda one: float((misses(one) ** 2).sum()))[:MAX_STARTS]
    tries = [
        scipy.optimize.least_squares(misses, spot, method="lm", max_nfev=MAX_TRIES) for spot in best
    ]
    spot = min(tries, key=lambda one: float(one.cost)).x
    p, each = found(spot)
    return placed_surfaces(spot, p, each, surfaces, ball, touched)


def placed_surfaces(
    spot: Array,
    p: Array,
    each: list[tuple[Array, float]],
    surfaces: tuple[Surface, ...],
    ball: float,
    touched: Array,
) -> tuple[Shapes, Array]:
    """The surfaces found, as a block's shapes and values.  p: (m, 3) of the ball's centre [m]."""
    axes = np.zeros((len(surfaces), 3, 3))
    for at, (place, _) in enumerate(each):
        if surfaces[at].kind == PLANE:
            axes[at] = np.linalg.svd(place[None])[2]
            axes[at, 0] = place
    turn, origin, radius = body_of(p, each, surfaces, ball, touched)
    shapes = Shapes(surfaces, ball, axes, turn)
    own = np.zeros(len(shapes.own()))
    own[:3], own[-1] = spot, radius
    if shapes.has_body:
        own[-7:-4] = origin
    for at, slot in enumerate(shapes.slots()):
        surface, (place, size) = surfaces[at], each[at]
        if surface.is_face:
            middle = p[touched == at].mean(axis=0)
            drawn = float((turn @ surface.normal) @ (middle - origin)) - radius
            own[slot] = surface.size if np.isfinite(surface.size) else drawn
        elif surface.kind == SPHERE:
            radius_here = surface.size if np.isfinite(surface.size) else size - radius
            own[slot] = [*place, radius_here]
        else:
            own[slot] = [0.0, 0.0, size - radius]
    return shapes, own


def body_of(
    p: Array,
    each: list[tuple[Array, float]],
    surfaces: tuple[Surface, ...],
    ball: float,
    touched: Array,
) -> tuple[Array, Array, float]:
    """Rotation (3, 3) and origin (3,) of the body by its faces, and the radius of the ball [m].

    The ball touches from outside, so that the other contacts with the body lie inwards.
    """
    faces = [at for at, surface in enumerate(surfaces) if surface.is_face]
    radius = ball if np.isfinite(ball) else 0.0
    spheres = [size - s.size for (_, size), s in zip(each, surfaces, strict=True)
               if s.kind == SPHERE and np.isfinite(s.size)]  # fmt: skip
    radius = float(np.mean(spheres)) if spheres and not np.isfinite(ball) else radius
    if not faces:
        return np.eye(3), np.zeros(3), radius
    middle = p[np.isin(touched, faces)].mean(axis=0)
    outward = []
    for at in faces:
        normal, offset = each[at]
        outward.append(normal if normal @ middle <= offset else -normal)
    drawn = np.array([surfaces[at].normal for at in faces])
    turn = nearest_rotation(np.array(outward).T @ drawn)
    known = [at for at in faces if np.isfinite(surfaces[at].size)]
    rows = np.array([np.append(turn @ surfaces[at].normal, np.isnan(ball)) for at in known])
    reached = np.array([turn @ surfaces[at].normal @ p[touched == at].mean(axis=0) for at in known])
    sizes = np.array([surfaces[at].size for at in known]) + (ball if np.isfinite(ball) else 0.0)
    if not known:
        return turn, middle, radius
    found = middle_body(rows, reached - sizes, middle)
    return turn, found[:3], float(found[3]) if np.isnan(ball) and len(known) > 3 else radius


def middle_body(rows: Array, offset: Array, middle: Array) -> Array:
    """(4,) origin and radius nearest to the contacts' middle that the offsets allow."""
    guess = np.append(middle, 0.0)
    return np.asarray(guess + scaled_lstsq(rows, offset - rows @ guess))
