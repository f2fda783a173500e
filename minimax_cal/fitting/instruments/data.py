"""Measurements that are no coordinates: wire lengths, sockets visited again, whole flange poses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.grouping import groups
from minimax_cal.measuring.measurements import FARTHEST, Measurements

if TYPE_CHECKING:
    from minimax_cal.fitting.pixels.data import PixelData

KINDS = ("distances", "closures", "poses", "points", "contacts", "pixels")
PLANE, SPHERE = "plane", "sphere"
NO_POSES: Array = np.zeros((0, 4, 4))
NORM = 1e-3  # a quaternion farther from unit length is no rotation
LEAST_LENGTHS = 5  # of one wire; its anchor alone has three unknowns


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
class RelativeData:
    """Joint values, and what was measured instead of coordinates.

    at: the m poses (q, line, columns), with points where the kind is points.  kind: one of KINDS.
    wires: s names, as wire1.  length: (m, s) from an anchor to the target, NaN where not measured
    [m].  socket: (m,) label of the socket that held the ball.  pose: (m, 4, 4) of the flange in
    the measurement frame [m].  surface: (m,) label of the one of `surfaces` that the probe's ball
    touched; ball_radius: NaN where not known [m].  pixels: of cameras, at these poses.  What is not
    of the kind is empty: s = 0, labels '', no poses, None.
    """

    at: Measurements
    kind: str
    wires: tuple[str, ...] = ()
    length: Array = field(default_factory=lambda: np.zeros((0, 0)))
    socket: Array = field(default_factory=lambda: np.zeros(0, dtype=str))
    pose: Array = field(default_factory=lambda: NO_POSES)
    surface: Array = field(default_factory=lambda: np.zeros(0, dtype=str))
    surfaces: tuple[Surface, ...] = ()
    ball_radius: float = np.nan
    pixels: PixelData | None = None

    @property
    def images(self) -> PixelData:
        """The pixels at these poses."""
        if self.pixels is None:
            raise DataError(f"{self.at.source}: holds {self.kind}, no pixels")
        return replace(self.pixels, at=self.at)

    @property
    def poses(self) -> int:
        """Number of rows."""
        return len(self.at.q)

    @property
    def sockets(self) -> tuple[str, ...]:
        """The sockets' labels, in alphabetical order."""
        return tuple(str(label) for label in np.unique(self.socket))

    def take(self, rows: Array) -> RelativeData:
        """The measurements at some rows only.  rows: indices or a mask."""
        return replace(
            self,
            at=self.at.take(rows),
            length=self.length[rows] if self.wires else self.length,
            socket=self.socket[rows] if len(self.socket) else self.socket,
            pose=self.pose[rows] if len(self.pose) else self.pose,
            surface=self.surface[rows] if len(self.surface) else self.surface,
            pixels=self.pixels and self.pixels.take(rows),
        )

    def says(self, row: int) -> str:
        """Where a row stands, for a message."""
        return f"{self.at.source}:{self.at.line[row]}"


def bare(q: Array, columns: Mapping[str, Array], **measured: Array) -> Measurements:
    """Poses without any point.  q: (m, n) [rad, m].  measured: by what the caller calls it."""
    q = np.array(q, dtype=float)
    if q.ndim != 2:
        raise DataError(f"q must be (m, n); got {q.shape}")
    extra = {name: np.asarray(column) for name, column in columns.items()}
    for name, column in (*measured.items(), *extra.items()):
        if len(column) != len(q):
            raise DataError(f"{name} has {len(column)} entries, but there are {len(q)} poses")
    sliding = np.zeros(q.shape[1], dtype=bool)
    return Measurements(q, np.zeros((len(q), 0, 3)), (), sliding, np.arange(len(q)) + 1, extra)


def distances(q: Array, length: Array, **columns: Array) -> RelativeData:
    """Wire lengths from arrays.

    q: (m, n) [rad, m].  length: (m,) or (m, s), NaN where not measured [m].  columns: as
    `data.measurements` takes them.
    """
    length = np.array(length, dtype=float)
    length = length[:, None] if length.ndim == 1 else length
    at = bare(q, columns, length=length)
    return check(RelativeData(at, "distances", wire_names(range(1, length.shape[1] + 1)), length))


def wire_names(numbers: Iterable[int]) -> tuple[str, ...]:
    """wire1 ..."""
    return tuple(f"wire{number}" for number in numbers)


def closures(q: Array, socket: Array, **columns: Array) -> RelativeData:
    """Sockets visited again, from arrays.  q: (m, n) [rad, m].  socket: (m,) labels."""
    labels = np.asarray(socket).astype(str)
    return check(RelativeData(bare(q, columns, socket=labels), "closures", socket=labels))


def flange_poses(q: Array, pose: Array, **columns: Array) -> RelativeData:
    """Whole poses from arrays.  q: (m, n) [rad, m].  pose: (m, 4, 4) [m]."""
    pose = np.array(pose, dtype=float)
    return check(RelativeData(bare(q, columns, pose=pose), "poses", pose=pose))


def contacts(
    q: Array,
    surface: Array,
    surfaces: Sequence[Surface],
    ball_radius: float = np.nan,
    **columns: Array,
) -> RelativeData:
    """Contacts of a probe's ball with surfaces, from arrays.

    q: (m, n) [rad, m].  surface: (m,) labels of surfaces.  ball_radius: NaN where not known [m].
    """
    labels = np.asarray(surface).astype(str)
    at = bare(q, columns, surface=labels)
    return check(
        RelativeData(
            at, "contacts", surface=labels, surfaces=tuple(surfaces), ball_radius=ball_radius
        )
    )


def check(data: RelativeData) -> RelativeData:
    """The data, if a fit can make sense of them.  Raises DataError."""
    where = data.at.source
    if not data.poses:
        raise DataError(f"{where}: holds no poses")
    if not np.isfinite(data.at.q).all():
        row, joint = np.argwhere(~np.isfinite(data.at.q))[0]
        raise DataError(f"{data.says(row)}: joint {joint + 1} is not a finite number")
    if len(np.unique(groups(data.at))) == 1:
        raise DataError(
            f"{where}: holds one pose only; its joint values must differ from row to row"
        )
    CHECKS[data.kind](data)
    return data


def check_lengths(data: RelativeData) -> None:
    """Raise DataError for a length that is none, and for wires that tell nothing."""
    wrong = (data.length <= 0.0) | (data.length > FARTHEST) | np.isinf(data.length)
    if wrong.any():
        row, wire = np.argwhere(wrong)[0]
        value = 1e3 * data.length[row, wire]
        what = "is no length" if value <= 0.0 else "is more than 100 km"
        raise DataError(
            f"{data.says(row)}: column {data.wires[wire]}_mm: {value:g} {what}; leave the cell "
            "empty where it was not measured"
        )
    for name, count in zip(data.wires, np.isfinite(data.length).sum(axis=0), strict=True):
        if count < LEAST_LENGTHS:
            raise DataError(
                f"{data.at.source}: {name} is measured at {count} poses, but its anchor alone has "
                f"three unknowns; measure at least {LEAST_LENGTHS}, or delete its column"
            )


def check_sockets(data: RelativeData) -> None:
    """Raise DataError for a socket that was not visited again with other joint values."""
    group = groups(data.at)
    for label in data.sockets:
        rows = np.flatnonzero(data.socket == label)
        if len(np.unique(group[rows])) < 2:
            often = "once" if len(rows) == 1 else "with the same joint values only"
            raise DataError(
                f"{data.says(rows[0])}: column socket: {label!r} is visited {often}; visit it "
                "again with other joint values, or leave the cell empty"
            )


def check_poses(data: RelativeData) -> None:
    """Raise DataError for poses that are no rigid motions."""
    if data.pose.shape != (data.poses, 4, 4):
        raise DataError(f"{data.at.source}: pose must be (m, 4, 4); got {data.pose.shape}")
    turn = data.pose[:, :3, :3]
    off = np.abs(np.swapaxes(turn, 1, 2) @ turn - np.eye(3)).max(axis=(1, 2))
    wrong = ~(np.isfinite(data.pose).all(axis=(1, 2)) & (off < NORM) & (np.linalg.det(turn) > 0))
    if wrong.any():
        raise DataError(
            f"{data.says(int(np.argmax(wrong)))}: the flange pose is no rigid motion; its rotation "
            "must be orthonormal and right-handed"
        )
    if np.abs(data.pose[:, :3, 3]).max() > FARTHEST:
        row = int(np.argmax(np.abs(data.pose[:, :3, 3]).max(axis=1)))
        raise DataError(f"{data.says(row)}: column flange_x_mm ...: is more than 100 km away")


def points(at: Measurements) -> RelativeData:
    """Points of a tracker beside other instruments."""
    return check(RelativeData(at, "points"))


def check_pixels(data: RelativeData) -> None:
    """Pixels are checked where they are read."""


def check_points(data: RelativeData) -> None:
    """Raise DataError where there are none."""
    if not data.at.seen.any():
        raise DataError(f"{data.at.source}: holds no measured point")


LEAST_CONTACTS = {PLANE: 4, SPHERE: 5}  # one more than the surface itself has unknowns


def check_contacts(data: RelativeData) -> None:
    """Raise DataError for surfaces that are none, or that are touched too seldom."""
    where, known = data.at.source, [surface.label for surface in data.surfaces]
    unknown = sorted(set(data.surface.tolist()) - set(known))
    if unknown or len(set(known)) < len(known):
        wrong = f"{unknown[0]!r} is none of the surfaces" if unknown else "two have one label"
        raise DataError(f"{where}: column surface: {wrong}")
    group = groups(data.at)
    for surface in data.surfaces:
        if surface.kind not in LEAST_CONTACTS:
            raise DataError(
                f"{where}: column kind: {surface.kind!r} of surface {surface.label!r}; "
                "write plane or sphere"
            )
        rows = np.flatnonzero(data.surface == surface.label)
        count, least = len(np.unique(group[rows])), LEAST_CONTACTS[surface.kind]
        if count < least:
            raise DataError(
                f"{where}: column surface: {surface.label!r} is touched at {count} different "
                f"poses; touch a {surface.kind} at {least} or more"
            )
    if data.ball_radius <= 0.0 or any(s.kind == SPHERE and s.size <= 0 for s in data.surfaces):
        raise DataError(f"{where}: a radius must be positive; leave it empty if not known")


CHECKS = {
    "contacts": check_contacts,
    "points": check_points,
    "pixels": check_pixels,
    "distances": check_lengths,
    "closures": check_sockets,
    "poses": check_poses,
}
