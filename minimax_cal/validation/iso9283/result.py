"""All values of a robot on held-out and on training poses, before and after: tables and JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import starmap
from typing import Annotated, Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array, rms
from minimax_cal.core.errors import DataError, OptionError
from minimax_cal.core.record_fields import FieldFormat, StoredSeparately, scale_numbers
from minimax_cal.core.results import Result
from minimax_cal.core.tables import Table, columns_to_records, drop_empty_tables
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import describe_mislabelled_pose
from minimax_cal.measuring.visit_history import add_history_columns, has_visit_order
from minimax_cal.modelling.cell import Cell
from minimax_cal.validation.iso9283.formulas import group_means
from minimax_cal.validation.iso9283.visits import (
    MAX_PAIRED_POSES,
    ArmStops,
    IsoAccuracy,
    IsoRepeatability,
    build_cell_view,
    build_stops,
    compute_iso_accuracy,
    compute_iso_repeatability,
    is_near_gimbal_lock,
)

STANDARD_CYCLE_COUNT = 30  # visits of a pose that the standard asks for (6.9)
ISO_PART_NAMES = {"holdout": "held out", "train": "training"}
NO_ORIENTATION_REASON = "not available: needs three reflectors, not on a line, measured at one pose"
GIMBAL_LOCK_NOTE = "a and c left out near gimbal lock, b within 5.7 deg of +-90 deg"


@dataclass(frozen=True, eq=False)
class IsoPart:
    """Held-out or training poses.  names: (P,) of the poses.  values: by the name of the cell.

    locked: number of poses near gimbal lock.
    """

    names: Array
    values: Mapping[str, IsoAccuracy]
    scatter: IsoRepeatability
    locked: int

    @property
    def reasons(self) -> dict[str, str]:
        """Why something is not available."""
        if not any(np.isfinite(values.angle).any() for values in self.values.values()):
            return {"AO": NO_ORIENTATION_REASON}
        return {"AO_a, AO_c": f"{GIMBAL_LOCK_NOTE}, at {self.locked} poses"} if self.locked else {}


class IsoCondition(NamedTuple):
    """Of a test: the clause, what the standard asks there, what the data tell."""

    clause: str
    asked: str
    told: str


class IsoRow(NamedTuple):
    """A part of the poses and a cell, their words, and the values of the cell there."""

    part_name: str
    cell_name: str
    part: IsoPart
    values: IsoAccuracy


@dataclass(frozen=True, eq=False)
class Iso9283(Result):
    """Values by the formulas of ISO 9283 on held-out and on training poses, before and after.

    parts: by the keys of PARTS, those that hold poses.  targets: k names.  tcp: which point.
    """

    KIND = "iso9283"

    robot: str
    source: Annotated[str, FieldFormat(key="data")]
    target_names: Annotated[tuple[str, ...], FieldFormat(key="targets")]
    tcp: str
    parts: StoredSeparately[Mapping[str, IsoPart]]
    conditions: tuple[IsoCondition, ...]
    notices: tuple[str, ...] = ()

    def rows(self) -> list[IsoRow]:
        """Every part with every cell, and their words."""
        return [
            IsoRow(ISO_PART_NAMES[key], name, part, values)
            for key, part in self.parts.items()
            for name, values in part.values.items()
        ]

    def pose_accuracy_table(self) -> Table:
        """AP of the TCP."""
        rows = (
            (title, name, *summary_figures(size), *(1e3 * rms(axis) for axis in values.position.T),
             name_of_largest(part.names, size))
            for title, name, part, values in self.rows()
            if np.isfinite(size := lengths_mm(values.position)).any()
        )  # fmt: skip
        return Table.from_rows(
            f"{self.robot}: pose accuracy AP of {self.tcp} (7.2), by the formulas of ISO 9283",
            rows,
            "poses | cell | count d | AP mean mm .4f | RMS mm .4f | max mm .4f | AP_x RMS mm .4f | "
            "AP_y RMS mm .4f | AP_z RMS mm .4f | worst pose",
        )

    def target_table(self) -> Table:
        """AP of each target; empty where there is only one."""
        rows = (
            (title, name, target, *summary_figures(lengths_mm(values.targets[:, i])))
            for title, name, _, values in self.rows()
            for i, target in enumerate(self.target_names)
            if len(self.target_names) > 1
        )
        columns = "poses | cell | target | count d | AP mean mm .4f | RMS mm .4f | max mm .4f"
        return Table.from_rows("pose accuracy AP of each target (7.2)", rows, columns)

    def orientation_table(self) -> Table:
        """AO and AO'; or why there is none."""
        title = "orientation accuracy (7.2)"
        rows = [
            (words, name, *summary_figures(1e3 * values.angle),
             *(1e3 * rms(axis) for axis in values.euler.T), part.locked)
            for words, name, part, values in self.rows()
            if np.isfinite(values.angle).any()
        ]  # fmt: skip
        if not rows:
            return Table.from_rows(title, [("all", NO_ORIENTATION_REASON)], "poses | AO")
        return Table.from_rows(
            f"{title}: AO', the angle between attained and commanded; AO_a, AO_b, AO_c, Euler "
            f"angles about x, y, z ({GIMBAL_LOCK_NOTE})",
            rows,
            "poses | cell | count d | AO' mean mrad .4f | RMS mrad .4f | max mrad .4f | "
            "AO_a RMS mrad .4f | AO_b RMS mrad .4f | AO_c RMS mrad .4f | left out d",
        )

    def distance_table(self) -> Table:
        """AD over pairs of poses, and RD where both were visited again."""
        none = np.zeros(0)
        rows = (
            (title, name, kind, *summary_figures(1e3 * abs(errors)), 1e3 * errors.mean(),
             1e3 * scatter.max() if len(scatter) else None)
            for title, name, part, values in self.rows()
            for kind, errors, scatter in (("all", values.pairs, none),
                                          ("consecutive", values.moves, none),
                                          ("repeated", values.repeated, part.scatter.distance))
            if len(errors)
        )  # fmt: skip
        return Table.from_rows(
            "distance accuracy AD and repeatability RD between poses of one part (7.3)",
            rows,
            "poses | cell | pairs | count d | |AD| mean mm .4f | RMS mm .4f | max mm .4f | "
            "AD mean mm +.4f | RD max mm .4f",
        )

    def repeat_table(self) -> Table:
        """RP, vAP and RO of each pose that was visited again; empty without any."""
        rows = (
            (
                part.names[i],
                ISO_PART_NAMES[key],
                s.stops[i],
                s.ways[i],
                *scale_numbers(
                    (s.one_way[i], s.all_ways[i], s.variation[i], *s.euler[i], s.angle[i]), 1e3
                ),
            )
            for key, part in self.parts.items()
            for s in [part.scatter]
            for i in np.flatnonzero(np.isfinite(s.all_ways))
        )
        return Table.from_rows(
            f"pose repeatability (7.2) of {self.tcp}: RP of the worst single way of approach, RP "
            f"over all ways, vAP between ways, RO ({STANDARD_CYCLE_COUNT} visits each way are due)",
            rows,
            "pose | poses | visits d | ways d | RP mm .4f | RP all mm .4f | vAP mm .4f | "
            "RO_a mrad .4f | RO_b mrad .4f | RO_c mrad .4f | RO' mrad .4f",
        )

    def pose_table(self) -> Table:
        """AP and AO of every pose."""
        rows = (
            (pose, title, name, *row)
            for title, name, part, v in self.rows()
            for pose, row in zip(part.names, 1e3 * np.column_stack(
                [np.linalg.norm(v.position, axis=1), v.position, v.angle, v.euler]
            ), strict=True)
        )  # fmt: skip
        return Table.from_rows(
            "every pose",
            rows,
            "pose | poses | cell | AP mm .4f | AP_x mm +.4f | AP_y mm +.4f | AP_z mm +.4f | "
            "AO' mrad .4f | AO_a mrad +.4f | AO_b mrad +.4f | AO_c mrad +.4f",
        )

    def conditions_table(self) -> Table:
        """What the standard asks of a test, and what these data tell."""
        columns = "clause | ISO 9283 asks | these data"
        return Table.from_rows("why this is no test by ISO 9283", self.conditions, columns)

    def tables(self, *, poses: bool = False) -> tuple[Table, ...]:
        """Every table that holds something.  poses: with a row for each pose."""
        return drop_empty_tables(
            self.pose_accuracy_table(), self.target_table(), self.orientation_table(),
            self.distance_table(), self.repeat_table(), *([self.pose_table()] if poses else []),
            self.conditions_table(),
        )  # fmt: skip

    def headline(self) -> str:
        """What is judged, and by what."""
        return f"{self.robot}: {self.tcp} on {self.source}, by the formulas of ISO 9283."

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """The parts: mm and mrad, null where not available."""
        parts = {key: part_to_dict(part, self.target_names) for key, part in self.parts.items()}
        return {"parts": parts}


def part_to_dict(part: IsoPart, targets: Sequence[str]) -> dict[str, Any]:
    """One part for JSON."""
    s = part.scatter
    sizes = {"RP_mm": s.one_way, "RP_all_mm": s.all_ways, "vAP_mm": s.variation,
             "RO_angle_mrad": s.angle}  # fmt: skip
    poses = {
        "pose": part.names,
        "visits": s.stops,
        "directions": s.ways,
        **scale_numbers({**sizes, "RO_mrad": s.euler}, 1e3),
        "RP_target_mm": columns_to_records(dict(zip(targets, 1e3 * s.targets.T, strict=True))),
        "cells": columns_to_records(
            {name: pose_records(values) for name, values in part.values.items()}
        ),
    }
    return {
        "cells": {name: part_figures(values, targets) for name, values in part.values.items()},
        "repeat": figures_in_thousandths({**sizes, "RD_mm": s.distance}),
        "not_available": part.reasons,
        "poses": columns_to_records(poses),
    }


def pose_records(values: IsoAccuracy) -> list[dict[str, Any]]:
    """What one cell makes of each pose, for JSON."""
    sizes = {"AP_mm": values.position, "AO_mrad": values.euler, "AO_angle_mrad": values.angle}
    return columns_to_records(scale_numbers(sizes, 1e3))


def part_figures(values: IsoAccuracy, targets: Sequence[str]) -> dict[str, Any]:
    """What one cell makes of all poses of a part, for JSON."""
    each = np.linalg.norm(values.targets, axis=2).T
    return figures_in_thousandths({
        "AP_mm": np.linalg.norm(values.position, axis=1),
        **{f"AP_{x}_mm": off for x, off in zip("xyz", values.position.T, strict=True)},
        "AP_target_mm": dict(zip(targets, each, strict=True)),
        "AO_angle_mrad": values.angle,
        **{f"AO_{a}_mrad": off for a, off in zip("abc", values.euler.T, strict=True)},
        "AD_mm": {"all": values.pairs, "consecutive": values.moves, "repeated": values.repeated},
    })  # fmt: skip


def lengths_mm(off: Array) -> Array:
    """(m,) lengths [mm] of (m, 3) [m]."""
    return np.asarray(1e3 * np.linalg.norm(off, axis=1))


class SummaryFigures(NamedTuple):
    """Of some values; NaN where there is none."""

    value_count: int
    mean: float
    rms: float
    largest: float


def summary_figures(values: Array) -> SummaryFigures:
    """Count, mean, RMS and largest size of some values; NaN without any."""
    known = values[np.isfinite(values)]
    if not len(known):
        return SummaryFigures(0, math.nan, math.nan, math.nan)
    return SummaryFigures(len(known), float(known.mean()), rms(known), float(np.abs(known).max()))


def figures_in_thousandths(values: Array | Mapping[str, Any]) -> dict[str, Any]:
    """`summary_figures` of an array, or of each of several, for JSON, in thousandths of the
    unit.
    """
    if isinstance(values, Mapping):
        return {key: figures_in_thousandths(part) for key, part in values.items()}
    return dict(zip(("count", "mean", "rms", "max"), summary_figures(1e3 * values), strict=True))


def name_of_largest(names: Array, values: Array) -> str:
    """The name with the largest value."""
    known = np.isfinite(values)
    return str(names[known][np.argmax(values[known])]) if known.any() else ""


def compute_iso9283(
    cells: Mapping[str, Cell],
    data: Measurements,
    held: Array,
    tcp: str | Sequence[float] = "centroid",
) -> Iso9283:
    """AP, AO, AD, and where poses were visited again RP, vAP, RO, RD.

    cells: who commands, by name; the first is the controller's own arm, usually "before" (nominal)
    and "after" (calibrated).  held: (m,) True where no fit has seen the pose.  tcp: centroid (of
    the targets), a target, or a point of the last frame (3,) [m].  Raises CalibrationError.
    """
    if fault := describe_mislabelled_pose(data):
        raise DataError(fault)
    # in the order of the file where nothing tells another: a row measured again is no new visit
    data = add_history_columns(data if has_visit_order(data) else data.in_visit_order())
    chosen, told = parse_tcp(data, tcp)
    commanded = {name: data.y - c.error(data) for name, c in cells.items()}
    stops = build_stops(data, commanded, np.asarray(held, dtype=bool))
    parts = {
        key: build_iso_part(cells, stops.take(mask), data.target_names, chosen)
        for key, mask in (("holdout", stops.held), ("train", ~stops.held))
        if mask.any()
    }
    robot = next(iter(cells.values())).robot.name
    notices = tuple(list_iso_notices(data, stops, parts))
    asked = list_test_conditions(data, stops)
    return Iso9283(robot, data.source, data.target_names, told, parts, asked, notices)


class ParsedTcp(NamedTuple):
    """The TCP as `build_cell_view` takes it, and in words."""

    tcp: int | Array
    text: str


def parse_tcp(data: Measurements, tcp: str | Sequence[float]) -> ParsedTcp:
    """Parse the TCP: a target's name, a point of the flange, or the centroid.  Raises
    OptionError.
    """
    if isinstance(tcp, str):
        if tcp != "centroid" and tcp not in data.target_names:
            raise OptionError(
                f"no TCP {tcp!r}; choose centroid, {', '.join(data.target_names)}, or X,Y,Z in mm"
            )
        if tcp == "centroid":
            centre = "the targets' centroid" if len(data.target_names) > 1 else data.target_names[0]
            return ParsedTcp(np.zeros(0), centre)
        return ParsedTcp(data.target_names.index(tcp), tcp)
    point = np.asarray(tcp, dtype=float)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise OptionError("the TCP: give three numbers X,Y,Z in the last frame")
    if len(data.target_names) < 3:
        raise DataError(f"{data.source}: a TCP away from the targets needs three of them")
    x, y, z = 1e3 * point
    return ParsedTcp(point, f"the point {x:g}, {y:g}, {z:g} mm of the flange")


def build_iso_part(
    cells: Mapping[str, Cell], stops: ArmStops, targets: tuple[str, ...], tcp: int | Array
) -> IsoPart:
    """All values of some stops."""
    names, pose = stops.poses()
    values, each, middle = {}, {}, {}
    real = group_means(stops.attained, pose, len(names))
    for key, cell in cells.items():
        spots = cell.target_positions[[cell.target_names.index(target) for target in targets]]
        told = group_means(stops.commanded[key], pose, len(names))
        middle[key] = build_cell_view(cell, real, told, spots, tcp)
        each[key] = build_cell_view(cell, stops.attained, stops.commanded[key], spots, tcp)
        values[key] = compute_iso_accuracy(middle[key], each[key], stops)
    first = next(iter(cells))
    near = int(is_near_gimbal_lock(middle[first]).sum())
    return IsoPart(names, values, compute_iso_repeatability(each[first], stops), near)


def list_iso_notices(
    data: Measurements, stops: ArmStops, parts: Mapping[str, IsoPart]
) -> list[str]:
    """What the reader should know."""
    out = []
    merged = data.poses - len(stops.pose)
    if merged:
        out.append(
            f"{data.source}: {merged} rows repeat the joints of the row before and count as one "
            "stop with it; label them in a column pose if the arm had moved away between"
        )
    for key, part in parts.items():
        if len(part.names) > MAX_PAIRED_POSES:
            out.append(
                f"AD of the {ISO_PART_NAMES[key]} poses: pairs of "
                f"{MAX_PAIRED_POSES} of {len(part.names)}"
            )
        if not np.isfinite(part.values[next(iter(part.values))].position).any():
            out.append(
                f"the TCP was measured at none of the {ISO_PART_NAMES[key]}"
                f" poses: choose one target for it "
                f"(tcp {data.target_names[0]})"
            )
    return out


def list_test_conditions(data: Measurements, stops: ArmStops) -> tuple[IsoCondition, ...]:
    """Conditions of a test by the standard that matter here, and what the data tell of each."""
    often = np.unique(stops.pose, return_counts=True)[1]
    enough, poses = int((often >= STANDARD_CYCLE_COUNT).sum()), len(often)

    def told(stem: str, scale: float, unit: str) -> str:
        column = data.columns.get(stem, np.zeros(0)).astype(float)
        known = scale * column[np.isfinite(column)]
        if not len(known):
            return "not given"
        return f"{stem} {format_value_range(known)} {unit}"

    cycles = (
        f"{format_value_range(often)} visits; {STANDARD_CYCLE_COUNT}"
        f" or more at {enough} of {poses} poses"
    )
    rows = (
        ("6.3", "stated ambient temperature, 20 C for choice", told("temperature", 1.0, "C")),
        ("6.4", "base frame found on the robot, apart from the test",
         "best fit to the training poses: AP is smaller than with a measured base"),
        ("6.5", "uncertainty of the instrument at most a quarter of a value",
         told("u95", 1e3, "mm")),
        ("6.6", "rated load on the flange", told("payload", 1.0, "kg")),
        ("6.7", "stated velocities, up to the rated one", "not given"),
        ("6.8", "five poses on a plane in a cube of the workspace", f"{poses} poses, anywhere"),
        ("6.9", f"{STANDARD_CYCLE_COUNT} cycles", cycles),
    )  # fmt: skip
    return tuple(starmap(IsoCondition, rows))


def format_value_range(values: Array) -> str:
    """As 20 to 22, or 20."""
    low, high = f"{values.min():g}", f"{values.max():g}"
    return low if low == high else f"{low} to {high}"
