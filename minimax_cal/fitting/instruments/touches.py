"""Contacts of a probe's ball with surfaces: what is measured, and its file."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from minimax_cal.fitting.instruments.data import (
    RelativeData,
    bare,
    checked,
    different,
    without_blind,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.joint_rows import joint_rows
from minimax_cal.reading.rows import Rows

CONTACT = re.compile(r"surface|kind|(?:radius|ball_radius|offset)_(?:mm|m)|normal_[xyz]")
PLANE, SPHERE = "plane", "sphere"
LEAST_CONTACTS = {PLANE: 4, SPHERE: 5}  # one more than the surface itself has unknowns


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
class Touches(RelativeData):
    """Contacts.

    surface: (m,) label of the one of `surfaces` that the probe's ball touched.  ball_radius: NaN
    where not known [m].
    """

    surface: Array
    surfaces: tuple[Surface, ...]
    ball_radius: float = np.nan

    kind = "contacts"
    by_row = ("surface",)

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
    file, at = joint_rows(file, CONTACT)
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
