"""Contacts of a ball on the flange with planes, spheres and the faces of one known body.

A contact says that the ball's centre p lies at the ball's radius r from the surface: n.p = c + r of
a plane, |p - C| = R + r of a sphere, n.(p - t) = d + r of a face with the normal n and the offset d
in the body's frame, which stands at t.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.instruments.instrument import (
    UNREADY,
    Columns,
    Instrument,
    Started,
    Words,
    bare,
    checked,
    different,
    without_blind,
)
from minimax_cal.instruments.options import FAR, InstrumentOptions
from minimax_cal.instruments.protocol import Arm, FlangePoses, ResidualRows
from minimax_cal.instruments.shapes import PLANE, SPHERE, Shapes, Surface, placed_best
from minimax_cal.instruments.sockets import CLOSED, reach
from minimax_cal.measuring.measurements import joint_rows
from minimax_cal.reading.rows import Rows
from minimax_cal.robots.kinematics import hat, right_jacobian
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.sampling import random_joints

CONTACT = re.compile(r"surface|kind|(?:radius|ball_radius|offset)_(?:mm|m)|normal_[xyz]")
LEAST_CONTACTS = {PLANE: 4, SPHERE: 5}  # one more than the surface itself has unknowns
PLENTY = 300  # contacts that show what no contacts could tell
BETTER_RADIUS = 4.0  # times the mean square of a sphere whose radius is free


@dataclass(frozen=True, eq=False)
class Touches(Instrument):
    """Contacts.

    surface: (m,) label of the one of `surfaces` that the probe's ball touched.  ball_radius: NaN
    where not known [m].  shapes: the surfaces where they fit the arm as drawn, and drawn: (e,) own
    parameters there.

    Its own: ball, surfaces, body, radius of the ball.
    """

    surface: Array
    surfaces: tuple[Surface, ...]
    ball_radius: float = np.nan
    shapes: Shapes = UNREADY
    drawn: Array = field(default_factory=lambda: np.zeros(0))

    kind = "contacts"
    words = Words(
        quantity="gap between the probe's ball and its surface",
        part="surface",
        caution="A gap is no error of position: what moves along the surface does not show in it. ",
        counted="contacts",
        check="the labels of the surfaces, and radii",
        more="more surfaces, of other directions and farther apart",
        whole="all surfaces moved together",
    )
    by_row = ("surface",)
    chosen = ("shapes", "drawn")
    given_up = ("ball_radius",)
    has_length = False  # the rank says whether some radius is one
    shrinks = True
    scale = (
        "a contact has no length standard",
        "a ball of known radius on a sphere or body of known size gives it, or a file of lengths",
    )

    @property
    def independent(self) -> int:
        """Those of different poses, of each surface."""
        return sum(different(self.at, self.surface == each.label) for each in self.surfaces)

    def check(self) -> None:
        """Raise DataError for surfaces that are none, or that are touched too seldom."""
        where, known = self.at.source, [surface.label for surface in self.surfaces]
        unknown = sorted(set(self.surface.tolist()) - set(known))
        if unknown or len(set(known)) < len(known):
            wrong = f"{unknown[0]!r} is none of the surfaces" if unknown else "two have one label"
            raise DataError(f"{where}: column surface: {wrong}")
        for surface in self.surfaces:
            if surface.kind not in LEAST_CONTACTS:
                raise DataError(
                    f"{where}: column kind: {surface.kind!r} of surface {surface.label!r}; "
                    "write plane or sphere"
                )
            count = different(self.at, self.surface == surface.label)
            least = LEAST_CONTACTS[surface.kind]
            if count < least:
                raise DataError(
                    f"{where}: column surface: {surface.label!r} is touched at {count} different "
                    f"poses; touch a {surface.kind} at {least} or more"
                )
        if self.ball_radius <= 0.0 or any(s.kind == SPHERE and s.size <= 0 for s in self.surfaces):
            raise DataError(f"{where}: a radius must be positive; leave it empty if not known")

    def columns(self) -> Mapping[str, Array]:
        """What was touched."""
        touched = {surface.label: surface for surface in self.surfaces}
        each = [touched[str(label)] for label in self.surface]
        sizes = {
            "radius_mm": [s.size if s.kind == SPHERE else np.nan for s in each],
            "offset_mm": [s.size if s.is_face else np.nan for s in each],
            "ball_radius_mm": [self.ball_radius] * len(each),
        }
        normals = np.array([s.normal if s.is_face else np.full(3, np.nan) for s in each])
        columns = {"surface": self.surface, "kind": np.array([s.kind for s in each])}
        columns |= {name: 1e3 * np.array(values) for name, values in sizes.items()}
        columns |= {f"normal_{axis}": normals[:, i] for i, axis in enumerate("xyz")}
        return {
            name: column
            for name, column in columns.items()
            if column.dtype.kind == "U" or np.isfinite(column).any()
        }

    # ---- in a fit ----------------------------------------------------------------------------

    def ready(self, robot: Robot, options: InstrumentOptions) -> Touches:
        """With a start that needs no guess."""
        arm = Arm.of(robot, self.at.q).at(robot.mdh)
        shapes, drawn = placed_best(arm, self.surfaces, self.ball_radius, self.touched)
        return replace(self, shapes=shapes, drawn=drawn)

    @cached_property
    def touched(self) -> Array:
        """(m,) which surface."""
        labels = self.parts
        return np.array([labels.index(str(label)) for label in self.surface])

    @property
    def names(self) -> tuple[str, ...]:
        """Ball, surfaces, body, radius of the ball."""
        return self.shapes.own()

    @property
    def held(self) -> tuple[str, ...]:
        """The radii and offsets that are given."""
        return self.shapes.given()

    @property
    def parts(self) -> tuple[str, ...]:
        """The surfaces."""
        return tuple(surface.label for surface in self.surfaces)

    def read(self, arm: FlangePoses, own: Array) -> ResidualRows:
        """A row for each contact: the ball's distance from the surface, which is zero."""
        m, touched, place = self.poses, self.touched, arm.place(own[:3])
        gap, along, by_own = np.zeros(m), np.zeros((m, 3)), np.zeros((m, len(own)))
        by_own[:, -1] = -1.0
        for at, slot in enumerate(self.shapes.slots()):
            here = touched == at
            along[here], gap[here], by_own[here, slot] = self.met(place[here], at, own)
            if self.surfaces[at].is_face:
                by_own[here, -7:-1] = self.by_body(place[here], at, own)
        by_own[:, :3] = np.einsum("ri,rij->rj", along, arm.rotation)
        return ResidualRows(-gap, np.arange(m), place, along, np.zeros_like(along), by_own, touched)

    def met(self, p: Array, at: int, own: Array) -> tuple[Array, Array, Array]:
        """Normal (m, 3) where p lies, its gap (m,), slopes by the surface's own (m, ..).

        p: (m, 3) of the ball's centre [m].  at: which surface.
        """
        surface, values = self.surfaces[at], own[self.shapes.slots()[at]]
        if surface.kind == SPHERE:
            off = p - values[:3]
            distance = np.maximum(np.linalg.norm(off, axis=1), 1e-12)
            normal = off / distance[:, None]
            slopes = [*-normal.T]
        elif surface.is_face:
            turn, origin = self.shapes.body(own)
            normal = np.broadcast_to(turn @ surface.normal, p.shape)
            distance, slopes = (normal * (p - origin)).sum(axis=1), []
        else:
            n, *tilts = self.shapes.plane(at, own)
            normal, distance = np.broadcast_to(n, p.shape), p @ n
            slopes = [p @ tilt for tilt in tilts]
        gap = distance - values[-1] - own[-1]
        return normal, gap, np.column_stack([*slopes, -np.ones(len(p))])

    def by_body(self, p: Array, at: int, own: Array) -> Array:
        """(m, 6) slopes of a face's distance by the body's place and turn."""
        turn, origin = self.shapes.body(own)
        normal = self.surfaces[at].normal
        swing = -turn @ hat(normal) @ right_jacobian(own[-4:-1])
        moved = np.broadcast_to(-turn @ normal, p.shape)
        return np.concatenate([moved, (p - origin) @ swing], axis=1)

    def starts(self, arm: FlangePoses, free: Array) -> Sequence[Array]:
        """The closed start."""
        return [self.drawn]

    def nearest(self, own: Array, p: Array, touched: Array) -> Array:
        """(m, 3) ball's places on the surfaces nearest to p (m, 3) [m]."""
        goal = p.copy()
        for at in range(len(self.surfaces)):
            rows = touched == at
            normal, gap, _ = self.met(p[rows], at, own)
            goal[rows] -= gap[:, None] * normal
        return goal

    def elsewhere(self, robot: Robot, own: Array) -> Touches:
        """At plenty of random poses that touch."""
        rng, count = np.random.default_rng(0), PLENTY * len(self.surfaces)
        q, touched = random_joints(robot, (count,), rng), np.arange(count) % len(self.surfaces)
        place = Arm.of(robot, q).at(robot.mdh).place(own[:3])
        found, gap = reach(robot, own[:3], self.nearest(own, place, touched), q)
        kept = gap < CLOSED
        if len(np.unique(touched[kept])) < len(self.surfaces):  # hardly within reach
            return self.fitting(robot, own)
        labels = np.array(self.parts)[touched[kept]]
        return replace(self, at=bare(found[kept], {}), surface=labels)

    def fitting(self, robot: Robot, own: Array) -> Touches:
        """At nearby poses where the arm itself touches."""
        place = Arm.of(robot, self.at.q).at(robot.mdh).place(own[:3])
        q, _ = reach(robot, own[:3], self.nearest(own, place, self.touched), self.at.q)
        return replace(self, at=replace(self.at, q=q))

    def placed(self, arm: FlangePoses, own: Array, drawn: Array) -> dict[str, Any]:
        """Ball in the last frame, surfaces in the robot's base."""
        shapes, out = self.shapes, {}
        turn, origin = shapes.body(own) if shapes.has_body else (np.eye(3), np.zeros(3))
        for at, (surface, slot) in enumerate(zip(self.surfaces, shapes.slots(), strict=True)):
            size = 1e3 * own[slot][-1]
            if surface.kind == SPHERE:
                found = {"centre_mm": (1e3 * own[slot][:3]).tolist(), "radius_mm": size}
            else:
                n = turn @ surface.normal if surface.is_face else shapes.plane(at, own)[0]
                offset = size + 1e3 * float(n @ origin) if surface.is_face else size
                found = {"normal": n.tolist(), "offset_mm": offset}
            out[surface.label] = {"kind": surface.kind, **found}
        radius = 1e3 * float(own[-1])
        return {"target_mm": (1e3 * own[:3]).tolist(), "ball_radius_mm": radius, "surfaces": out}

    def check_given(self, started: Started) -> None:
        """Raise DataError for a given radius that no arm like the drawn one can have found."""
        if not (np.isfinite(self.ball_radius) and any(s.kind == SPHERE for s in self.surfaces)):
            return
        free = tuple(replace(s, size=np.nan) if s.kind == SPHERE else s for s in self.surfaces)
        ready, arm, own = started(self)
        loose, there, at = started(replace(self, surfaces=free))
        one, other = ready.mean_square(arm, own), loose.mean_square(there, at)
        found = loose.placed(there, at, at)["surfaces"]
        for surface in self.surfaces:
            size_mm = found[surface.label].get("radius_mm", 0.0)
            off = abs(size_mm - 1e3 * surface.size) if surface.kind == SPHERE else 0.0
            if one > BETTER_RADIUS * other and off > FAR * 1e3 * np.sqrt(other):
                raise DataError(
                    f"{self.at.source}: column radius_mm: by the arm as drawn surface "
                    f"{surface.label!r} has a radius of {size_mm:.4g} mm, not "
                    f"{1e3 * surface.size:.4g} mm; check radius_mm, ball_radius_mm and their units"
                )


def contacts(
    q: Array,
    surface: Array,
    surfaces: Sequence[Surface],
    ball_radius: float = np.nan,
    **columns: Array,
) -> Touches:
    """Contacts of a probe's ball with surfaces, from arrays.

    q: (m, n) [rad, m].  surface: (m,) labels of surfaces.  ball_radius: NaN where not known [m].
    """
    labels = np.asarray(surface).astype(str)
    at = bare(q, columns, surface=labels)
    return checked(Touches(at, labels, tuple(surfaces), ball_radius))


def read(file: Rows) -> Touches:
    """Contacts of a probe.  Raises DataError."""
    at = joint_rows(file, CONTACT)
    labels = np.array(file.text("surface"))
    rows = len(labels)
    if "kind" not in file.header:
        raise DataError(f"{file.path}:1: column kind is missing; it says plane or sphere")
    kinds = np.array([text.strip().lower() for text in file.text("kind")])
    sizes = {stem: sized(file, stem) for stem in ("radius", "offset", "ball_radius")}
    faces = [name for name in file.header if name.startswith("normal_")]
    if faces and len(faces) < 3:
        raise DataError(
            f"{file.path}:1: a face has normal_x, normal_y and normal_z; give all three"
        )
    normals = (
        np.stack([file.number(f"normal_{axis}", unit="", empty=True) for axis in "xyz"], axis=1)
        if faces
        else np.full((rows, 3), np.nan)
    )
    touched = labels != ""
    surfaces = []
    for label in dict.fromkeys(labels[touched].tolist()):
        here = np.flatnonzero(labels == label)
        stem = "radius" if kinds[here[0]] == "sphere" else "offset"
        told = np.column_stack([sizes[stem][here], normals[here]])
        alike = (kinds[here] == kinds[here[0]]) & np.isclose(
            told, told[0], rtol=0, atol=1e-9, equal_nan=True
        ).all(axis=1)
        if not alike.all():
            line = file.line[here[int(np.argmin(alike))]]
            raise DataError(
                f"{file.path}:{line}: surface {label!r} has another kind, size or normal than in "
                f"line {file.line[here[0]]}; a surface has one of each"
            )
        surfaces.append(Surface(label, str(kinds[here[0]]), float(told[0, 0]), normal_of(told[0])))
    ball = np.unique(sizes["ball_radius"][np.isfinite(sizes["ball_radius"])])
    if len(ball) > 1:
        raise DataError(f"{file.path}: column ball_radius_mm: {len(ball)} values; a probe has one")
    radius = float(ball[0]) if len(ball) else np.nan
    return without_blind(Touches(at, labels, tuple(surfaces), radius), ~touched)


def normal_of(told: Array) -> Array:
    """(3,) unit normal of a face, (0,) where none is given.  told: (4,) size and normal."""
    length = float(np.linalg.norm(told[1:]))
    return told[1:] / length if np.isfinite(length) and length > 0.0 else np.zeros(0)


def sized(file: Rows, stem: str) -> Array:
    """(m,) a length by its name without the unit, NaN where it is empty or not there [m]."""
    for unit in ("mm", "m"):
        if f"{stem}_{unit}" in file.header:
            return file.number(f"{stem}_{unit}", unit=unit, empty=True)
    return np.full(len(file.rows), np.nan)


Touches.file = Columns(re.compile("surface"), CONTACT, "surface with kind", read)
