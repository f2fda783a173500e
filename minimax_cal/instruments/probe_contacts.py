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
from typing import Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.instruments.instrument import (
    NOT_READY,
    FitNominalArm,
    Instrument,
    InstrumentColumns,
    Words,
    bare,
    check_instrument_data,
    count_distinct_poses,
    drop_unmeasured_rows,
)
from minimax_cal.instruments.instrument_options import MAX_GIVEN_DEVIATION_SIGMAS, InstrumentOptions
from minimax_cal.instruments.protocol import FlangeKinematics, FlangePoses, ResidualRows
from minimax_cal.instruments.shapes import (
    PLANE_KIND,
    SPHERE_KIND,
    Surface,
    SurfaceParameters,
    fit_ball_and_surfaces,
)
from minimax_cal.instruments.sockets import MAX_CLOSED_GAP, reach
from minimax_cal.measuring.measurements import build_joint_measurements
from minimax_cal.reading.measurement_table import MeasurementTable
from minimax_cal.robots.joint_sampling import random_joint_values
from minimax_cal.robots.kinematics import skew_matrix, so3_right_jacobian
from minimax_cal.robots.robot import Robot

CONTACT_COLUMN_PATTERN = re.compile(
    r"surface|kind|(?:radius|ball_radius|offset)_(?:mm|m)|normal_[xyz]"
)
MIN_CONTACTS_BY_KIND = {
    PLANE_KIND: 4,
    SPHERE_KIND: 5,
}  # one more than the surface itself has unknowns
RANDOM_CONTACTS_PER_SURFACE = 300  # contacts that show what no contacts could tell
MAX_GIVEN_RADIUS_SQUARES_RATIO = 4.0  # times the mean square of a sphere whose radius is free


class SurfaceGaps(NamedTuple):
    """Normals (m, 3) of a surface, gaps (m,) [m], and their slopes (m, s) by the surface."""

    normals: Array
    gaps: Array
    slopes: Array


@dataclass(frozen=True, eq=False)
class SurfaceContacts(Instrument):
    """Contacts.

    surface: (m,) label of the one of `surfaces` that the probe's ball touched.  ball_radius: NaN
    where not known [m].  shapes: the surfaces where they fit the arm as drawn, and drawn: (e,) own
    parameters there.

    Its own: ball, surfaces, body, radius of the ball.
    """

    surface: Array
    surfaces: tuple[Surface, ...]
    ball_radius: float = np.nan
    shapes: SurfaceParameters = NOT_READY
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
    def independent_number_count(self) -> int:
        """Those of different poses, of each surface."""
        return sum(
            count_distinct_poses(self.at, self.surface == each.label) for each in self.surfaces
        )

    def check_data(self) -> None:
        """Raise DataError for surfaces that are none, or that are touched too seldom."""
        where, known = self.at.source, [surface.label for surface in self.surfaces]
        unknown = sorted(set(self.surface.tolist()) - set(known))
        if unknown or len(set(known)) < len(known):
            wrong = f"{unknown[0]!r} is none of the surfaces" if unknown else "two have one label"
            raise DataError(f"{where}: column surface: {wrong}")
        for surface in self.surfaces:
            if surface.kind not in MIN_CONTACTS_BY_KIND:
                raise DataError(
                    f"{where}: column kind: {surface.kind!r} of surface {surface.label!r}; "
                    "write plane or sphere"
                )
            count = count_distinct_poses(self.at, self.surface == surface.label)
            least = MIN_CONTACTS_BY_KIND[surface.kind]
            if count < least:
                raise DataError(
                    f"{where}: column surface: {surface.label!r} is touched at {count} different "
                    f"poses; touch a {surface.kind} at {least} or more"
                )
        if self.ball_radius <= 0.0 or any(
            s.kind == SPHERE_KIND and s.size <= 0 for s in self.surfaces
        ):
            raise DataError(f"{where}: a radius must be positive; leave it empty if not known")

    def file_columns(self) -> Mapping[str, Array]:
        """What was touched."""
        touched = {surface.label: surface for surface in self.surfaces}
        each = [touched[str(label)] for label in self.surface]
        sizes = {
            "radius_mm": [s.size if s.kind == SPHERE_KIND else np.nan for s in each],
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

    def ready(self, robot: Robot, options: InstrumentOptions) -> SurfaceContacts:
        """With a start that needs no guess."""
        arm = FlangeKinematics.from_robot(robot, self.at.q).compute_flange_poses(robot.mdh)
        shapes, drawn = fit_ball_and_surfaces(
            arm, self.surfaces, self.ball_radius, self.touched_surface_index
        )
        return replace(self, shapes=shapes, drawn=drawn)

    @cached_property
    def touched_surface_index(self) -> Array:
        """(m,) which surface."""
        labels = self.part_names
        return np.array([labels.index(str(label)) for label in self.surface])

    @property
    def names(self) -> tuple[str, ...]:
        """Ball, surfaces, body, radius of the ball."""
        return self.shapes.parameter_names()

    @property
    def given_unknown_names(self) -> tuple[str, ...]:
        """The radii and offsets that are given."""
        return self.shapes.given_parameter_names()

    @property
    def part_names(self) -> tuple[str, ...]:
        """The surfaces."""
        return tuple(surface.label for surface in self.surfaces)

    def read(self, arm: FlangePoses, unknowns: Array) -> ResidualRows:
        """A row for each contact: the ball's distance from the surface, which is zero."""
        m, touched, place = self.poses, self.touched_surface_index, arm.place(unknowns[:3])
        gap, along, by_own = np.zeros(m), np.zeros((m, 3)), np.zeros((m, len(unknowns)))
        by_own[:, -1] = -1.0
        for at, slot in enumerate(self.shapes.surface_slices()):
            here = touched == at
            along[here], gap[here], by_own[here, slot] = self.normals_gaps_and_slopes(
                place[here], at, unknowns
            )
            if self.surfaces[at].is_face:
                by_own[here, -7:-1] = self.slopes_by_body_pose(place[here], at, unknowns)
        by_own[:, :3] = np.einsum("ri,rij->rj", along, arm.rotation)
        return ResidualRows(-gap, np.arange(m), place, along, np.zeros_like(along), by_own, touched)

    def normals_gaps_and_slopes(
        self, ball_centres: Array, surface_index: int, unknowns: Array
    ) -> SurfaceGaps:
        """Normal (m, 3) where p lies, its gap (m,), slopes by the surface's own (m, ..).

        ball_centres: (m, 3) of the ball's centre [m].  surface_index: which surface.
        """
        surface, values = (
            self.surfaces[surface_index],
            unknowns[self.shapes.surface_slices()[surface_index]],
        )
        if surface.kind == SPHERE_KIND:
            off = ball_centres - values[:3]
            distance = np.maximum(np.linalg.norm(off, axis=1), 1e-12)
            normal = off / distance[:, None]
            slopes = [*-normal.T]
        elif surface.is_face:
            turn, origin = self.shapes.body_rotation_and_origin(unknowns)
            normal = np.broadcast_to(turn @ surface.normal, ball_centres.shape)
            distance, slopes = (normal * (ball_centres - origin)).sum(axis=1), []
        else:
            n, *tilts = self.shapes.plane_normal_and_derivatives(surface_index, unknowns)
            normal, distance = np.broadcast_to(n, ball_centres.shape), ball_centres @ n
            slopes = [ball_centres @ tilt for tilt in tilts]
        gap = distance - values[-1] - unknowns[-1]
        return SurfaceGaps(normal, gap, np.column_stack([*slopes, -np.ones(len(ball_centres))]))

    def slopes_by_body_pose(
        self, ball_centres: Array, surface_index: int, unknowns: Array
    ) -> Array:
        """(m, 6) slopes of a face's distance by the body's place and turn."""
        turn, origin = self.shapes.body_rotation_and_origin(unknowns)
        normal = self.surfaces[surface_index].normal
        swing = -turn @ skew_matrix(normal) @ so3_right_jacobian(unknowns[-4:-1])
        moved = np.broadcast_to(-turn @ normal, ball_centres.shape)
        return np.concatenate([moved, (ball_centres - origin) @ swing], axis=1)

    def starts(self, arm: FlangePoses, free_unknowns: Array) -> Sequence[Array]:
        """The closed start."""
        return [self.drawn]

    def nearest_points_on_surfaces(
        self, unknowns: Array, ball_centres: Array, touched_surface: Array
    ) -> Array:
        """(m, 3) ball's places on the surfaces nearest to p (m, 3) [m]."""
        goal = ball_centres.copy()
        for at in range(len(self.surfaces)):
            rows = touched_surface == at
            normal, gap, _ = self.normals_gaps_and_slopes(ball_centres[rows], at, unknowns)
            goal[rows] -= gap[:, None] * normal
        return goal

    def at_random_poses(self, robot: Robot, unknowns: Array) -> SurfaceContacts:
        """At plenty of random poses that touch."""
        rng, count = np.random.default_rng(0), RANDOM_CONTACTS_PER_SURFACE * len(self.surfaces)
        q, touched = (
            random_joint_values(robot, (count,), rng),
            np.arange(count) % len(self.surfaces),
        )
        place = (
            FlangeKinematics.from_robot(robot, q)
            .compute_flange_poses(robot.mdh)
            .place(unknowns[:3])
        )
        found, gap = reach(
            robot, unknowns[:3], self.nearest_points_on_surfaces(unknowns, place, touched), q
        )
        kept = gap < MAX_CLOSED_GAP
        if len(np.unique(touched[kept])) < len(self.surfaces):  # hardly within reach
            return self.at_exactly_fitting_poses(robot, unknowns)
        labels = np.array(self.part_names)[touched[kept]]
        return replace(self, at=bare(found[kept], {}), surface=labels)

    def at_exactly_fitting_poses(self, robot: Robot, unknowns: Array) -> SurfaceContacts:
        """At nearby poses where the arm itself touches."""
        place = (
            FlangeKinematics.from_robot(robot, self.at.q)
            .compute_flange_poses(robot.mdh)
            .place(unknowns[:3])
        )
        q, _ = reach(
            robot,
            unknowns[:3],
            self.nearest_points_on_surfaces(unknowns, place, self.touched_surface_index),
            self.at.q,
        )
        return replace(self, at=replace(self.at, q=q))

    def fitted_values_to_dict(
        self, arm: FlangePoses, unknowns: Array, nominal_unknowns: Array
    ) -> dict[str, Any]:
        """Ball in the last frame, surfaces in the robot's base."""
        shapes, out = self.shapes, {}
        turn, origin = (
            shapes.body_rotation_and_origin(unknowns)
            if shapes.has_body
            else (np.eye(3), np.zeros(3))
        )
        for at, (surface, slot) in enumerate(
            zip(self.surfaces, shapes.surface_slices(), strict=True)
        ):
            size = 1e3 * unknowns[slot][-1]
            if surface.kind == SPHERE_KIND:
                found = {"centre_mm": (1e3 * unknowns[slot][:3]).tolist(), "radius_mm": size}
            else:
                n = (
                    turn @ surface.normal
                    if surface.is_face
                    else shapes.plane_normal_and_derivatives(at, unknowns)[0]
                )
                offset = size + 1e3 * float(n @ origin) if surface.is_face else size
                found = {"normal": n.tolist(), "offset_mm": offset}
            out[surface.label] = {"kind": surface.kind, **found}
        radius = 1e3 * float(unknowns[-1])
        return {
            "target_mm": (1e3 * unknowns[:3]).tolist(),
            "ball_radius_mm": radius,
            "surfaces": out,
        }

    def check_given_values(self, fit_nominal_arm: FitNominalArm) -> None:
        """Raise DataError for a given radius that no arm like the drawn one can have found."""
        if not (
            np.isfinite(self.ball_radius) and any(s.kind == SPHERE_KIND for s in self.surfaces)
        ):
            return
        free = tuple(replace(s, size=np.nan) if s.kind == SPHERE_KIND else s for s in self.surfaces)
        ready, arm, own = fit_nominal_arm(self)
        loose, there, at = fit_nominal_arm(replace(self, surfaces=free))
        one, other = ready.mean_square_error(arm, own), loose.mean_square_error(there, at)
        found = loose.fitted_values_to_dict(there, at, at)["surfaces"]
        for surface in self.surfaces:
            size_mm = found[surface.label].get("radius_mm", 0.0)
            off = abs(size_mm - 1e3 * surface.size) if surface.kind == SPHERE_KIND else 0.0
            if (
                one > MAX_GIVEN_RADIUS_SQUARES_RATIO * other
                and off > MAX_GIVEN_DEVIATION_SIGMAS * 1e3 * np.sqrt(other)
            ):
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
) -> SurfaceContacts:
    """Contacts of a probe's ball with surfaces, from arrays.

    q: (m, n) [rad, m].  surface: (m,) labels of surfaces.  ball_radius: NaN where not known [m].
    """
    labels = np.asarray(surface).astype(str)
    at = bare(q, columns, surface=labels)
    return check_instrument_data(SurfaceContacts(at, labels, tuple(surfaces), ball_radius))


def parse_contacts(table: MeasurementTable) -> SurfaceContacts:
    """Contacts of a probe.  Raises DataError."""
    at = build_joint_measurements(table, CONTACT_COLUMN_PATTERN)
    labels = np.array(table.text_column("surface"))
    rows = len(labels)
    if "kind" not in table.header:
        raise DataError(f"{table.path}:1: column kind is missing; it says plane or sphere")
    kinds = np.array([text.strip().lower() for text in table.text_column("kind")])
    sizes = {
        stem: optional_length_column(table, stem) for stem in ("radius", "offset", "ball_radius")
    }
    faces = [name for name in table.header if name.startswith("normal_")]
    if faces and len(faces) < 3:
        raise DataError(
            f"{table.path}:1: a face has normal_x, normal_y and normal_z; give all three"
        )
    normals = (
        np.stack(
            [table.number_column(f"normal_{axis}", unit="", allow_empty=True) for axis in "xyz"],
            axis=1,
        )
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
            line = table.line[here[int(np.argmin(alike))]]
            raise DataError(
                f"{table.path}:{line}: surface {label!r} has another kind, size or normal than in "
                f"line {table.line[here[0]]}; a surface has one of each"
            )
        surfaces.append(
            Surface(label, str(kinds[here[0]]), float(told[0, 0]), unit_normal_of_face(told[0]))
        )
    ball = np.unique(sizes["ball_radius"][np.isfinite(sizes["ball_radius"])])
    if len(ball) > 1:
        raise DataError(f"{table.path}: column ball_radius_mm: {len(ball)} values; a probe has one")
    radius = float(ball[0]) if len(ball) else np.nan
    return drop_unmeasured_rows(SurfaceContacts(at, labels, tuple(surfaces), radius), ~touched)


def unit_normal_of_face(size_and_normal: Array) -> Array:
    """(3,) unit normal of a face, (0,) where none is given.  size_and_normal: (4,) size and
    normal.
    """
    length = float(np.linalg.norm(size_and_normal[1:]))
    return size_and_normal[1:] / length if np.isfinite(length) and length > 0.0 else np.zeros(0)


def optional_length_column(table: MeasurementTable, stem: str) -> Array:
    """(m,) a length by its name without the unit, NaN where it is empty or not there [m]."""
    for unit in ("mm", "m"):
        if f"{stem}_{unit}" in table.header:
            return table.number_column(f"{stem}_{unit}", unit=unit, allow_empty=True)
    return np.full(len(table.rows), np.nan)


SurfaceContacts.file = InstrumentColumns(
    re.compile("surface"), CONTACT_COLUMN_PATTERN, "surface with kind", parse_contacts
)
