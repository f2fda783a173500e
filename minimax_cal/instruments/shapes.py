"""Planes, spheres and the faces of one body, and where they are without a guess."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy

from minimax_cal.core.arrays import Array
from minimax_cal.instruments.instrument import SPOT, FramePose, scaled_least_squares, spots_aside
from minimax_cal.instruments.protocol import FlangePoses
from minimax_cal.instruments.wires import solve_linear_target
from minimax_cal.robots.kinematics import rotation_from_vector
from minimax_cal.robots.transforms import nearest_rotations

PLANE_KIND, SPHERE_KIND = "plane", "sphere"

MAX_BALL_STARTS, MAX_BALL_EVALUATIONS = (
    3,
    60,
)  # places of the ball that are refined; gaps looked at for each
SPHERE_FIT_ROUNDS = 5  # of a sphere's fit by its distances
BODY_PARAMETER_NAMES = tuple(f"body_{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))


@dataclass(frozen=True, eq=False)
class Surface:
    """What a probe touches.

    kind: PLANE or SPHERE.  size: radius of a sphere, or offset of a face from the body's origin
    along its normal, NaN where not known [m].  normal: (3,) outward in the body's frame of a plane
    that is a face of the body, else (0,).
    """

    label: str
    kind: str = PLANE_KIND
    size: float = np.nan
    normal: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def is_face(self) -> bool:
        """Whether it is a face of the body."""
        return bool(len(self.normal))

    @property
    def parameter_endings(self) -> tuple[str, ...]:
        """Endings of its own parameters' names, the size last."""
        if self.kind == SPHERE_KIND:
            return ("x", "y", "z", "radius")
        return ("offset",) if self.is_face else ("tilt1", "tilt2", "offset")


class PlaneNormal(NamedTuple):
    """Normal (3,) of a plane, and its derivatives (3,) by the two tilts."""

    normal: Array
    by_first_tilt: Array
    by_second_tilt: Array


@dataclass(frozen=True, eq=False)
class SurfaceParameters:
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

    def parameter_names(self) -> tuple[str, ...]:
        """Names: target, surfaces, body, radius of the ball."""
        names = [f"surface_{s.label}_{end}" for s in self.surfaces for end in s.parameter_endings]
        return (*SPOT, *names, *(BODY_PARAMETER_NAMES if self.has_body else ()), "ball_radius")

    def given_parameter_names(self) -> tuple[str, ...]:
        """Those of them whose values are given."""
        known = [(f"surface_{s.label}_{s.parameter_endings[-1]}", s.size) for s in self.surfaces]
        known += [("ball_radius", self.ball_radius)]
        return tuple(name for name, value in known if np.isfinite(value))

    def surface_slices(self) -> list[slice]:
        """Of each surface."""
        ends = 3 + np.cumsum([0, *(len(s.parameter_endings) for s in self.surfaces)])
        return [slice(int(a), int(b)) for a, b in pairwise(ends)]

    def body_rotation_and_origin(self, unknowns: Array) -> FramePose:
        """Rotation (3, 3) and origin (3,) of the body."""
        return FramePose(self.turn @ rotation_from_vector(unknowns[-4:-1]), unknowns[-7:-4])

    def plane_normal_and_derivatives(self, surface_index: int, unknowns: Array) -> PlaneNormal:
        """Normal (3,) of a plane, and its derivatives by the two tilts."""
        n0, u, v = self.axes[surface_index]
        a, b, _ = unknowns[self.surface_slices()[surface_index]]
        size = np.sqrt(1.0 + a**2 + b**2)
        n = (n0 + a * u + b * v) / size
        one, other = ((w - n * (n @ w)) / size for w in (u, v))
        return PlaneNormal(n, one, other)


# ---- a start without a guess -------------------------------------------------------------------


class FittedPlane(NamedTuple):
    """Unit normal (3,) of a plane, and its distance from the origin [m]."""

    normal: Array
    offset: float


def fit_plane(points: Array) -> FittedPlane:
    """Normal (3,) and offset of the plane that points (m, 3) lie on best [m]."""
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][-1]
    return FittedPlane(normal, float(normal @ centre))


class FittedSphere(NamedTuple):
    """Centre (3,) and radius of a sphere [m]."""

    centre: Array
    radius: float


def fit_sphere(points: Array, given_radius: float) -> FittedSphere:
    """Centre (3,) and radius of the sphere that points (m, 3) lie on best [m].

    Algebraic, |p|^2 = 2 p.C + k, then by distances.  given_radius: given, or NaN.
    """
    middle = points.mean(axis=0)
    q = points - middle
    found = scaled_least_squares(np.column_stack([2.0 * q, np.ones(len(q))]), (q**2).sum(axis=1))
    centre, size = found[:3], float(np.sqrt(max(found[3] + found[:3] @ found[:3], 1e-12)))
    size = given_radius if np.isfinite(given_radius) else size
    for _ in range(SPHERE_FIT_ROUNDS):
        off = q - centre
        distance = np.maximum(np.linalg.norm(off, axis=1), 1e-12)
        columns = [-off / distance[:, None], np.full((len(q), int(np.isnan(given_radius))), -1.0)]
        step = scaled_least_squares(np.concatenate(columns, axis=1), size - distance)
        centre, size = centre + step[:3], size + float(step[3:].sum())
    return FittedSphere(middle + centre, size)


def fit_surfaces_to_ball_centres(
    ball_centres: Array, surfaces: Sequence[Surface], ball_radius: float, touched_surface: Array
) -> list[FittedPlane | FittedSphere]:
    """The best plane or sphere through the ball's centres p (m, 3) of each surface."""
    out: list[FittedPlane | FittedSphere] = []
    for at, surface in enumerate(surfaces):
        here = ball_centres[touched_surface == at]
        out.append(
            fit_sphere(here, surface.size + ball_radius)
            if surface.kind == SPHERE_KIND
            else fit_plane(here)
        )
    return out


def find_linear_ball_positions(
    arm: FlangePoses, surfaces: Sequence[Surface], touched_surface: Array
) -> list[Array]:
    """Places (3,) of the ball on the flange that each surface by itself suggests [m].

    With the last frame (R, o), a plane's n.(o + R t) = c is linear and homogeneous in n, the nine
    products n t' and c; of a sphere see `wires.solve_linear_target`.
    """
    out = []
    for at, surface in enumerate(surfaces):
        here = touched_surface == at
        o, turn = arm.origin[here], arm.rotation[here]
        if surface.kind == SPHERE_KIND:
            some = arm._replace(origin=o, rotation=turn)
            out.append(solve_linear_target(some, np.zeros((len(o), 1)), with_offset=False))
            continue
        rows = np.concatenate([o, turn.reshape(len(o), 9), -np.ones((len(o), 1))], axis=1)
        found = np.linalg.svd(rows)[2][-1]
        size = max(float(found[:3] @ found[:3]), 1e-12)
        out.append(found[:3] @ found[3:12].reshape(3, 3) / size)
    return [spot for spot in out if np.isfinite(spot).all()]


class SurfaceStart(NamedTuple):
    """The parameters of surfaces, and start values (e,) of them."""

    parameters: SurfaceParameters
    unknowns: Array


def fit_ball_and_surfaces(
    arm: FlangePoses, surfaces: tuple[Surface, ...], ball_radius: float, touched_surface: Array
) -> SurfaceStart:
    """Where ball and surfaces fit the arm as drawn best, and their values.

    For a given place of the ball on the flange each surface is found in closed form, which leaves
    three unknowns: least squares from several places.
    """

    def found(spot: Array) -> tuple[Array, list[FittedPlane | FittedSphere]]:
        p = arm.place(spot)
        return p, fit_surfaces_to_ball_centres(p, surfaces, ball_radius, touched_surface)

    def misses(spot: Array) -> Array:
        p, each = found(spot)
        out = np.zeros(len(p))
        for at, (place, size) in enumerate(each):
            here = touched_surface == at
            round_ = surfaces[at].kind == SPHERE_KIND
            reached = np.linalg.norm(p[here] - place, axis=1) if round_ else p[here] @ place
            out[here] = reached - size
        return out

    spots = [
        *find_linear_ball_positions(arm, surfaces, touched_surface),
        *spots_aside(arm, np.zeros(3))[1:],
    ]
    best = sorted(spots, key=lambda one: float((misses(one) ** 2).sum()))[:MAX_BALL_STARTS]
    tries = [
        scipy.optimize.least_squares(misses, spot, method="lm", max_nfev=MAX_BALL_EVALUATIONS)
        for spot in best
    ]
    spot = min(tries, key=lambda one: float(one.cost)).x
    p, each = found(spot)
    return build_surface_unknowns(spot, p, each, surfaces, ball_radius, touched_surface)


def build_surface_unknowns(
    ball_position: Array,
    ball_centres: Array,
    fitted_surfaces: list[FittedPlane | FittedSphere],
    surfaces: tuple[Surface, ...],
    ball_radius: float,
    touched_surface: Array,
) -> SurfaceStart:
    """The surfaces found, as a block's shapes and values.  ball_centres: (m, 3) of the ball's
    centre [m].
    """
    axes = np.zeros((len(surfaces), 3, 3))
    for at, (place, _) in enumerate(fitted_surfaces):
        if surfaces[at].kind == PLANE_KIND:
            axes[at] = np.linalg.svd(place[None])[2]
            axes[at, 0] = place
    turn, origin, radius = fit_body_and_ball_radius(
        ball_centres, fitted_surfaces, surfaces, ball_radius, touched_surface
    )
    shapes = SurfaceParameters(surfaces, ball_radius, axes, turn)
    own = np.zeros(len(shapes.parameter_names()))
    own[:3], own[-1] = ball_position, radius
    if shapes.has_body:
        own[-7:-4] = origin
    for at, slot in enumerate(shapes.surface_slices()):
        surface, (place, size) = surfaces[at], fitted_surfaces[at]
        if surface.is_face:
            middle = ball_centres[touched_surface == at].mean(axis=0)
            drawn = float((turn @ surface.normal) @ (middle - origin)) - radius
            own[slot] = surface.size if np.isfinite(surface.size) else drawn
        elif surface.kind == SPHERE_KIND:
            radius_here = surface.size if np.isfinite(surface.size) else size - radius
            own[slot] = [*place, radius_here]
        else:
            own[slot] = [0.0, 0.0, size - radius]
    return SurfaceStart(shapes, own)


class BodyFrameAndRadius(NamedTuple):
    """Rotation (3, 3) and origin (3,) of a body, and the radius of the ball [m]."""

    rotation: Array
    origin: Array
    ball_radius: float


def fit_body_and_ball_radius(
    ball_centres: Array,
    fitted_surfaces: list[FittedPlane | FittedSphere],
    surfaces: tuple[Surface, ...],
    ball_radius: float,
    touched_surface: Array,
) -> BodyFrameAndRadius:
    """Rotation (3, 3) and origin (3,) of the body by its faces, and the radius of the ball [m].

    The ball touches from outside, so that the other contacts with the body lie inwards.
    """
    faces = [at for at, surface in enumerate(surfaces) if surface.is_face]
    radius = ball_radius if np.isfinite(ball_radius) else 0.0
    spheres = [size - s.size for (_, size), s in zip(fitted_surfaces, surfaces, strict=True)
               if s.kind == SPHERE_KIND and np.isfinite(s.size)]  # fmt: skip
    radius = float(np.mean(spheres)) if spheres and not np.isfinite(ball_radius) else radius
    if not faces:
        return BodyFrameAndRadius(np.eye(3), np.zeros(3), radius)
    middle = ball_centres[np.isin(touched_surface, faces)].mean(axis=0)
    outward = []
    for at in faces:
        normal, offset = fitted_surfaces[at]
        outward.append(normal if normal @ middle <= offset else -normal)
    drawn = np.array([surfaces[at].normal for at in faces])
    turn = nearest_rotations(np.array(outward).T @ drawn)
    known = [at for at in faces if np.isfinite(surfaces[at].size)]
    rows = np.array([np.append(turn @ surfaces[at].normal, np.isnan(ball_radius)) for at in known])
    reached = np.array(
        [
            turn @ surfaces[at].normal @ ball_centres[touched_surface == at].mean(axis=0)
            for at in known
        ]
    )
    sizes = np.array([surfaces[at].size for at in known]) + (
        ball_radius if np.isfinite(ball_radius) else 0.0
    )
    if not known:
        return BodyFrameAndRadius(turn, middle, radius)
    found = solve_body_origin_and_radius(rows, reached - sizes, middle)
    return BodyFrameAndRadius(
        turn, found[:3], float(found[3]) if np.isnan(ball_radius) and len(known) > 3 else radius
    )


def solve_body_origin_and_radius(rows: Array, offsets: Array, contact_middle: Array) -> Array:
    """(4,) origin and radius nearest to the contacts' middle that the offsets allow."""
    guess = np.append(contact_middle, 0.0)
    return np.asarray(guess + scaled_least_squares(rows, offsets - rows @ guess))
