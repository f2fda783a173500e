"""Files of lengths, closures and poses: CSV in, CSV out, joint columns as in a measurement file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.fitting.instruments.data import (
    NORM,
    SPHERE,
    RelativeData,
    Surface,
    check,
    points,
    wire_names,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.files import csv_text, write_whole
from minimax_cal.measuring.columns import (
    JOINT,
    TARGET,
    TEXT,
    Rows,
    header_check,
    near,
    optional_kind,
    read_rows,
    useless,
    whole_rows,
)
from minimax_cal.measuring.measurements import (
    Measurements,
    check_columns,
    check_u95,
    file_column,
    measurements_in,
)

WIRE = re.compile(r"wire(\d+)_(mm|m)")
PLACE = re.compile(r"flange_([xyz])_(mm|m)")
TURN = re.compile(r"flange_r([xyz])_(rad|deg)")
QUATERNION = re.compile(r"flange_q([wxyz])()")
CONTACT = re.compile(r"surface|kind|(?:radius|ball_radius|offset)_(?:mm|m)|normal_[xyz]")
DOUBT = re.compile(r"rotation_u95_(rad|deg)")  # of a pose, beside u95_mm of its position
ANY_TARGET = ("smr1_x_mm", "smr1_y_mm", "smr1_z_mm")  # the header's rules ask for one


def kind_of(path: Path | str, header: Sequence[str]) -> str:
    """Which kind of measurement a header announces.  Raises DataError."""
    families = {
        "distances": [n for n in header if n.startswith("wire")],
        "closures": [n for n in header if n == "socket"],
        "poses": [n for n in header if n.startswith("flange")],
        "contacts": [n for n in header if n == "surface"],
    }
    known = (WIRE, PLACE, TURN, QUATERNION)
    for name in (*families["distances"], *families["poses"]):
        if not any(pattern.fullmatch(name) for pattern in known):
            raise DataError(
                f"{path}:1: column {name} is not understood; write wire1_mm, flange_x_mm, "
                "flange_rx_rad or flange_qw"
            )
    found = [kind for kind, names in families.items() if names]
    if not found and any(TARGET.fullmatch(name) for name in header):
        return "points"
    if not found:
        raise DataError(
            f"{path}:1: no measured columns; name them wire1_mm ..., or socket, or surface with "
            "kind, or flange_x_mm, flange_y_mm, flange_z_mm, flange_rx_rad ..., or smr1_x_mm ..."
        )
    if len(found) > 1:
        first, second = (families[kind][0] for kind in found[:2])
        raise DataError(
            f"{path}:1: columns {first} and {second} are of different kinds; put them into two "
            "files"
        )
    return found[0]


def read_relative(path: Path | str) -> RelativeData:
    """Read a CSV file of lengths, closures, poses, or points of a tracker.  Raises DataError."""
    file = read_rows(path)
    kind = kind_of(path, file.header)
    if kind == "points":
        return points(measurements_in(file))
    header_check(path, [n for n in file.header if not TARGET.fullmatch(n)] + list(ANY_TARGET))
    file = whole_rows(file)
    q, sliding = file.joints()
    columns, notices = optional_columns(file, kind)
    nothing = np.zeros((len(q), 0, 3))
    at = Measurements(
        q, nothing, (), sliding, file.line, columns, {}, notices, str(path), file.digest
    )
    data, blind = READERS[kind](file, check_u95(check_columns(at)))
    if blind.all():
        raise DataError(f"{path}: nothing was measured at any pose")
    if blind.any():
        notice = f"{path}: {blind.sum()} rows hold nothing measured and are left out"
        data = data.take(~blind)
        data = replace(data, at=replace(data.at, notices=(*data.at.notices, notice)))
    return check(data)


def optional_columns(file: Rows, kind: str) -> tuple[dict[str, Array], tuple[str, ...]]:
    """The optional columns by name, in SI, and a notice for each column that is not used."""
    columns: dict[str, Array] = {}
    idle = useless(file.header)
    notices = [f"{file.path}: column {name} is not used: {why}" for name, why in idle.items()]
    for name in file.header:
        if name in idle:
            continue
        family, match = optional_kind(name)
        match = match or DOUBT.fullmatch(name)
        own = name == "socket" or name.startswith(("wire", "flange"))
        own |= kind == "contacts" and bool(CONTACT.fullmatch(name))
        if family in TEXT:
            columns[name] = np.array(file.text(name))
        elif match and (kind == "poses" or "u95" not in name):
            unit = match[1] if match.re.groups else ""
            columns[name.removesuffix(f"_{unit}")] = file.number(name, unit=unit, empty=True)
        elif not (own or JOINT.fullmatch(name)):
            hint = "" if match else near(name)
            notices.append(f"{file.path}: column {name} is not used{hint}")
    return columns, tuple(notices)


def read_lengths(file: Rows, at: Measurements) -> tuple[RelativeData, Array]:
    """The wires' columns, and which rows hold none."""
    found = sorted((int(m[1]), n, m[2]) for n in file.header if (m := WIRE.fullmatch(n)))
    numbers = [number for number, _, _ in found]
    twice = [number for number in numbers if numbers.count(number) > 1]
    if twice:
        raise DataError(f"{file.path}:1: wire{twice[0]} has two columns; keep one unit")
    length = np.stack([file.number(n, unit=unit, empty=True) for _, n, unit in found], axis=1)
    return RelativeData(at, "distances", wire_names(numbers), length), np.isnan(length).all(axis=1)


def read_sockets(file: Rows, at: Measurements) -> tuple[RelativeData, Array]:
    """The sockets' labels, and which rows have none."""
    labels = np.array(file.text("socket"))
    return RelativeData(at, "closures", socket=labels), np.asarray(labels == "")


def family(file: Rows, pattern: re.Pattern[str], axes: str) -> Array:
    """The columns of a family, (m, axes), or (m, 0) where there is none.  Raises DataError."""
    found = {m[1]: (name, m[2]) for name in file.header if (m := pattern.fullmatch(name))}
    if not found:
        return np.zeros((len(file.rows), 0))
    name, unit = next(iter(found.values()))
    stem, ending = (name.removesuffix(f"_{unit}")[:-1], f"_{unit}") if unit else (name[:-1], "")
    for axis in axes:
        if axis not in found:
            raise DataError(f"{file.path}:1: column {stem}{axis}{ending} is missing")
    columns = [file.number(found[axis][0], unit=found[axis][1], empty=True) for axis in axes]
    return np.stack(columns, axis=1)


def read_poses(file: Rows, at: Measurements) -> tuple[RelativeData, Array]:
    """Whole poses, orientation as a rotation vector or a quaternion; which rows have none."""
    place = family(file, PLACE, "xyz")
    vector, quaternion = family(file, TURN, "xyz"), family(file, QUATERNION, "wxyz")
    if not place.shape[1]:
        raise DataError(f"{file.path}:1: column flange_x_mm is missing")
    if bool(vector.shape[1]) == bool(quaternion.shape[1]):
        raise DataError(
            f"{file.path}:1: give the flange's orientation once: flange_rx_rad, flange_ry_rad, "
            "flange_rz_rad or flange_qw, flange_qx, flange_qy, flange_qz"
        )
    turn = vector if vector.shape[1] else quaternion
    empty = np.isnan(np.concatenate([place, turn], axis=1))
    blind = empty.all(axis=1)
    torn = empty.any(axis=1) & ~blind
    if torn.any():
        raise DataError(
            f"{file.path}:{file.line[int(np.argmax(torn))]}: some of the flange's columns are "
            "empty; give all, or leave all empty where it was not measured"
        )
    seen = np.flatnonzero(~blind)
    pose = np.tile(np.eye(4), (len(place), 1, 1))
    pose[seen, :3, 3] = place[seen]
    pose[seen, :3, :3] = (
        Rotation.from_rotvec(turn[seen]) if vector.shape[1] else unit_rotation(file, turn, seen)
    ).as_matrix()
    return RelativeData(at, "poses", pose=pose), blind


def unit_rotation(file: Rows, quaternion: Array, seen: Array) -> Rotation:
    """Rotations of the rows seen from quaternions (m, 4), scalar first.  Raises DataError."""
    length = np.linalg.norm(quaternion[seen], axis=1)
    off = np.abs(length - 1.0) > NORM
    if off.any():
        row = int(np.argmax(off))
        raise DataError(
            f"{file.path}:{file.line[seen[row]]}: columns flange_qw ...: the quaternion has "
            f"length {length[row]:.4g}, not 1"
        )
    return Rotation.from_quat(quaternion[seen], scalar_first=True)


def read_contacts(file: Rows, at: Measurements) -> tuple[RelativeData, Array]:
    """Contacts of a probe, and which rows have none.  Raises DataError."""
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
    data = RelativeData(
        at, "contacts", surface=labels, surfaces=tuple(surfaces), ball_radius=radius
    )
    return data, ~touched


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


READERS = {
    "contacts": read_contacts,
    "distances": read_lengths,
    "closures": read_sockets,
    "poses": read_poses,
}


def write_relative(path: Path | str, data: RelativeData) -> None:
    """Write CSV as `read_relative` reads it: radians (mm for slides) and millimetres."""
    at = data.at
    columns: dict[str, Array] = {
        f"q{i + 1}_{'mm' if slides else 'rad'}": at.q[:, i] * (1e3 if slides else 1.0)
        for i, slides in enumerate(at.sliding)
    }
    columns |= {f"{name}_mm": 1e3 * data.length[:, i] for i, name in enumerate(data.wires)}
    if data.kind == "closures":
        columns["socket"] = data.socket
    if data.kind == "contacts":
        columns |= contact_columns(data)
    if data.kind == "poses":
        turn = Rotation.from_matrix(data.pose[:, :3, :3]).as_rotvec()
        columns |= {f"flange_{axis}_mm": 1e3 * data.pose[:, i, 3] for i, axis in enumerate("xyz")}
        columns |= {f"flange_r{axis}_rad": turn[:, i] for i, axis in enumerate("xyz")}
    for stem, column in at.columns.items():
        name, factor = ("rotation_u95_rad", 1.0) if stem == "rotation_u95" else file_column(stem)
        columns[name] = column if column.dtype.kind == "U" else factor * column
    rows = ([cell(value) for value in row] for row in zip(*columns.values(), strict=True))
    write_whole(path, csv_text([list(columns), *rows]))


def contact_columns(data: RelativeData) -> dict[str, Array]:
    """What was touched, as `read_relative` reads it."""
    touched = {surface.label: surface for surface in data.surfaces}
    each = [touched[str(label)] for label in data.surface]
    sizes = {
        "radius_mm": [s.size if s.kind == SPHERE else np.nan for s in each],
        "offset_mm": [s.size if s.is_face else np.nan for s in each],
        "ball_radius_mm": [data.ball_radius] * len(each),
    }
    normals = np.array([s.normal if s.is_face else np.full(3, np.nan) for s in each])
    columns = {"surface": data.surface, "kind": np.array([s.kind for s in each])}
    columns |= {name: 1e3 * np.array(values) for name, values in sizes.items()}
    columns |= {f"normal_{axis}": normals[:, i] for i, axis in enumerate("xyz")}
    return {
        name: column
        for name, column in columns.items()
        if column.dtype.kind == "U" or np.isfinite(column).any()
    }


def cell(value: str | float) -> str:
    """A label as it is, a number to nine decimals; nothing for NaN."""
    if isinstance(value, str):
        return str(value)
    return "" if np.isnan(value) else f"{value:.9f}"
