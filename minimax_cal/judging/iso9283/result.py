"""All values of a robot on held-out and on training poses, before and after: tables and JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import starmap
from typing import Annotated, Any, NamedTuple

import numpy as np

from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.ground.facts import Apart, Fact, scaled
from minimax_cal.ground.results import Result
from minimax_cal.ground.tables import Table, filled, records_of
from minimax_cal.judging.iso9283.formulas import mean_of
from minimax_cal.judging.iso9283.visits import (
    MAX_PAIRED_POSES,
    Scatter,
    Stops,
    Values,
    locked,
    scatter_of,
    stops_of,
    values_of,
    view_of,
)
from minimax_cal.measuring.grouping import mislabelled
from minimax_cal.measuring.history import ordered, with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell

CYCLES = 30  # visits of a pose that the standard asks for (6.9)
PARTS = {"holdout": "held out", "train": "training"}
NO_TURNS = "not available: needs three reflectors, not on a line, measured at one pose"
LOCKED = "a and c left out near gimbal lock, b within 5.7 deg of +-90 deg"


@dataclass(frozen=True, eq=False)
class Part:
    """Held-out or training poses.  names: (P,) of the poses.  values: by the name of the cell.

    locked: number of poses near gimbal lock.
    """

    names: Array
    values: Mapping[str, Values]
    scatter: Scatter
    locked: int

    @property
    def reasons(self) -> dict[str, str]:
        """Why something is not available."""
        if not any(np.isfinite(values.angle).any() for values in self.values.values()):
            return {"AO": NO_TURNS}
        return {"AO_a, AO_c": f"{LOCKED}, at {self.locked} poses"} if self.locked else {}


class Condition(NamedTuple):
    """Of a test: the clause, what the standard asks there, what the data tell."""

    clause: str
    asked: str
    told: str


@dataclass(frozen=True, eq=False)
class Iso9283(Result):
    """Values by the formulas of ISO 9283 on held-out and on training poses, before and after.

    parts: by the keys of PARTS, those that hold poses.  targets: k names.  tcp: which point.
    """

    KIND = "iso9283"

    robot: str
    source: Annotated[str, Fact(key="data")]
    target_names: Annotated[tuple[str, ...], Fact(key="targets")]
    tcp: str
    parts: Apart[Mapping[str, Part]]
    conditions: tuple[Condition, ...]
    notices: tuple[str, ...] = ()

    def rows(self) -> list[tuple[str, str, Part, Values]]:
        """Every part with every cell, and their words."""
        return [
            (PARTS[key], name, part, values)
            for key, part in self.parts.items()
            for name, values in part.values.items()
        ]

    def position_table(self) -> Table:
        """AP of the TCP."""
        rows = (
            (title, name, *summary(size), *(1e3 * rms(axis) for axis in values.position.T),
             worst(part.names, size))
            for title, name, part, values in self.rows()
            if np.isfinite(size := millimetres(values.position)).any()
        )  # fmt: skip
        return Table.made(
            f"{self.robot}: pose accuracy AP of {self.tcp} (7.2), by the formulas of ISO 9283",
            rows,
            "poses | cell | count d | AP mean mm .4f | RMS mm .4f | max mm .4f | AP_x RMS mm .4f | "
            "AP_y RMS mm .4f | AP_z RMS mm .4f | worst pose",
        )

    def target_table(self) -> Table:
        """AP of each target; empty where there is only one."""
        rows = (
            (title, name, target, *summary(millimetres(values.targets[:, i])))
            for title, name, _, values in self.rows()
            for i, target in enumerate(self.target_names)
            if len(self.target_names) > 1
        )
        columns = "poses | cell | target | count d | AP mean mm .4f | RMS mm .4f | max mm .4f"
        return Table.made("pose accuracy AP of each target (7.2)", rows, columns)

    def orientation_table(self) -> Table:
        """AO and AO'; or why there is none."""
        title = "orientation accuracy (7.2)"
        rows = [
            (words, name, *summary(1e3 * values.angle),
             *(1e3 * rms(axis) for axis in values.euler.T), part.locked)
            for words, name, part, values in self.rows()
            if np.isfinite(values.angle).any()
        ]  # fmt: skip
        if not rows:
            return Table.made(title, [("all", NO_TURNS)], "poses | AO")
        return Table.made(
            f"{title}: AO', the angle between attained and commanded; AO_a, AO_b, AO_c, Euler "
            f"angles about x, y, z ({LOCKED})",
            rows,
            "poses | cell | count d | AO' mean mrad .4f | RMS mrad .4f | max mrad .4f | "
            "AO_a RMS mrad .4f | AO_b RMS mrad .4f | AO_c RMS mrad .4f | left out d",
        )

    def distance_table(self) -> Table:
        """AD over pairs of poses, and RD where both were visited again."""
        none = np.zeros(0)
        rows = (
            (title, name, kind, *summary(1e3 * abs(errors)), 1e3 * errors.mean(),
             1e3 * scatter.max() if len(scatter) else None)
            for title, name, part, values in self.rows()
            for kind, errors, scatter in (("all", values.pairs, none),
                                          ("consecutive", values.moves, none),
                                          ("repeated", values.repeated, part.scatter.distance))
            if len(errors)
        )  # fmt: skip
        return Table.made(
            "distance accuracy AD and repeatability RD between poses of one part (7.3)",
            rows,
            "poses | cell | pairs | count d | |AD| mean mm .4f | RMS mm .4f | max mm .4f | "
            "AD mean mm +.4f | RD max mm .4f",
        )

    def repeat_table(self) -> Table:
        """RP, vAP and RO of each pose that was visited again; empty without any."""
        rows = (
            (part.names[i], PARTS[key], s.stops[i], s.ways[i],
             *scaled((s.one_way[i], s.all_ways[i], s.variation[i], *s.euler[i], s.angle[i]), 1e3))
            for key, part in self.parts.items()
            for s in [part.scatter]
            for i in np.flatnonzero(np.isfinite(s.all_ways))
        )  # fmt: skip
        return Table.made(
            f"pose repeatability (7.2) of {self.tcp}: RP of the worst single way of approach, RP "
            f"over all ways, vAP between ways, RO ({CYCLES} visits each way are due)",
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
        return Table.made(
            "every pose",
            rows,
            "pose | poses | cell | AP mm .4f | AP_x mm +.4f | AP_y mm +.4f | AP_z mm +.4f | "
            "AO' mrad .4f | AO_a mrad +.4f | AO_b mrad +.4f | AO_c mrad +.4f",
        )

    def conditions_table(self) -> Table:
        """What the standard asks of a test, and what these data tell."""
        columns = "clause | ISO 9283 asks | these data"
        return Table.made("why this is no test by ISO 9283", self.conditions, columns)

    def tables(self, *, poses: bool = False) -> tuple[Table, ...]:
        """Every table that holds something.  poses: with a row for each pose."""
        return filled(
            self.position_table(), self.target_table(), self.orientation_table(),
            self.distance_table(), self.repeat_table(), *([self.pose_table()] if poses else []),
            self.conditions_table(),
        )  # fmt: skip

    def headline(self) -> str:
        """What is judged, and by what."""
        return f"{self.robot}: {self.tcp} on {self.source}, by the formulas of ISO 9283."

    def beside(self, *, poses: bool = True) -> dict[str, Any]:
        """The parts: mm and mrad, null where not available."""
        parts = {key: part_to_dict(part, self.target_names) for key, part in self.parts.items()}
        return {"parts": parts}


def part_to_dict(part: Part, targets: Sequence[str]) -> dict[str, Any]:
    """One part for JSON."""
    s = part.scatter
    sizes = {"RP_mm": s.one_way, "RP_all_mm": s.all_ways, "vAP_mm": s.variation,
             "RO_angle_mrad": s.angle}  # fmt: skip
    poses = {
        "pose": part.names,
        "visits": s.stops,
        "directions": s.ways,
        **scaled({**sizes, "RO_mrad": s.euler}, 1e3),
        "RP_target_mm": records_of(dict(zip(targets, 1e3 * s.targets.T, strict=True))),
        "cells": records_of({name: poses_of(values) for name, values in part.values.items()}),
    }
    return {
        "cells": {name: figures_of(values, targets) for name, values in part.values.items()},
        "repeat": figures({**sizes, "RD_mm": s.distance}),
        "not_available": part.reasons,
        "poses": records_of(poses),
    }


def poses_of(values: Values) -> list[dict[str, Any]]:
    """What one cell makes of each pose, for JSON."""
    sizes = {"AP_mm": values.position, "AO_mrad": values.euler, "AO_angle_mrad": values.angle}
    return records_of(scaled(sizes, 1e3))


def figures_of(values: Values, targets: Sequence[str]) -> dict[str, Any]:
    """What one cell makes of all poses of a part, for JSON."""
    each = np.linalg.norm(values.targets, axis=2).T
    return figures({
        "AP_mm": np.linalg.norm(values.position, axis=1),
        **{f"AP_{x}_mm": off for x, off in zip("xyz", values.position.T, strict=True)},
        "AP_target_mm": dict(zip(targets, each, strict=True)),
        "AO_angle_mrad": values.angle,
        **{f"AO_{a}_mrad": off for a, off in zip("abc", values.euler.T, strict=True)},
        "AD_mm": {"all": values.pairs, "consecutive": values.moves, "repeated": values.repeated},
    })  # fmt: skip


def millimetres(off: Array) -> Array:
    """(m,) lengths [mm] of (m, 3) [m]."""
    return np.asarray(1e3 * np.linalg.norm(off, axis=1))


def summary(values: Array) -> tuple[int, float, float, float]:
    """Count, mean, RMS and largest size of some values; NaN without any."""
    known = values[np.isfinite(values)]
    if not len(known):
        return 0, math.nan, math.nan, math.nan
    return len(known), float(known.mean()), rms(known), float(np.abs(known).max())


def figures(values: Array | Mapping[str, Any]) -> dict[str, Any]:
    """`summary` of an array, or of each of several, for JSON, in thousandths of the unit."""
    if isinstance(values, Mapping):
        return {key: figures(part) for key, part in values.items()}
    return dict(zip(("count", "mean", "rms", "max"), summary(1e3 * values), strict=True))


def worst(names: Array, values: Array) -> str:
    """The name with the largest value."""
    known = np.isfinite(values)
    return str(names[known][np.argmax(values[known])]) if known.any() else ""


def iso9283(
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
    if fault := mislabelled(data):
        raise DataError(fault)
    # in the order of the file where nothing tells another: a row measured again is no new visit
    data = with_history(data if ordered(data) else data.in_visit_order())
    chosen, told = tcp_of(data, tcp)
    commanded = {name: data.y - c.error(data) for name, c in cells.items()}
    stops = stops_of(data, commanded, np.asarray(held, dtype=bool))
    parts = {
        key: part_of(cells, stops.take(mask), data.target_names, chosen)
        for key, mask in (("holdout", stops.held), ("train", ~stops.held))
        if mask.any()
    }
    robot = next(iter(cells.values())).robot.name
    notices = tuple(remarks(data, stops, parts))
    asked = conditions(data, stops)
    return Iso9283(robot, data.source, data.target_names, told, parts, asked, notices)


def tcp_of(data: Measurements, tcp: str | Sequence[float]) -> tuple[int | Array, str]:
    """The TCP for `view_of`, and in words.  Raises OptionError."""
    if isinstance(tcp, str):
        if tcp != "centroid" and tcp not in data.target_names:
            raise OptionError(
                f"no TCP {tcp!r}; choose centroid, {', '.join(data.target_names)}, or X,Y,Z in mm"
            )
        if tcp == "centroid":
            centre = "the targets' centroid" if len(data.target_names) > 1 else data.target_names[0]
            return np.zeros(0), centre
        return data.target_names.index(tcp), tcp
    point = np.asarray(tcp, dtype=float)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise OptionError("the TCP: give three numbers X,Y,Z in the last frame")
    if len(data.target_names) < 3:
        raise DataError(f"{data.source}: a TCP away from the targets needs three of them")
    x, y, z = 1e3 * point
    return point, f"the point {x:g}, {y:g}, {z:g} mm of the flange"


def part_of(
    cells: Mapping[str, Cell], stops: Stops, targets: tuple[str, ...], tcp: int | Array
) -> Part:
    """All values of some stops."""
    names, pose = stops.poses()
    values, each, middle = {}, {}, {}
    real = mean_of(stops.attained, pose, len(names))
    for key, cell in cells.items():
        spots = cell.target_positions[[cell.target_names.index(target) for target in targets]]
        told = mean_of(stops.commanded[key], pose, len(names))
        middle[key] = view_of(cell, real, told, spots, tcp)
        each[key] = view_of(cell, stops.attained, stops.commanded[key], spots, tcp)
        values[key] = values_of(middle[key], each[key], stops)
    first = next(iter(cells))
    near = int(locked(middle[first]).sum())
    return Part(names, values, scatter_of(each[first], stops), near)


def remarks(data: Measurements, stops: Stops, parts: Mapping[str, Part]) -> list[str]:
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
                f"AD of the {PARTS[key]} poses: pairs of {MAX_PAIRED_POSES} of {len(part.names)}"
            )
        if not np.isfinite(part.values[next(iter(part.values))].position).any():
            out.append(
                f"the TCP was measured at none of the {PARTS[key]} poses: choose one target for it "
                f"(tcp {data.target_names[0]})"
            )
    return out


def conditions(data: Measurements, stops: Stops) -> tuple[Condition, ...]:
    """Conditions of a test by the standard that matter here, and what the data tell of each."""
    often = np.unique(stops.pose, return_counts=True)[1]
    enough, poses = int((often >= CYCLES).sum()), len(often)

    def told(stem: str, scale: float, unit: str) -> str:
        column = data.columns.get(stem, np.zeros(0)).astype(float)
        known = scale * column[np.isfinite(column)]
        if not len(known):
            return "not given"
        return f"{stem} {between(known)} {unit}"

    cycles = f"{between(often)} visits; {CYCLES} or more at {enough} of {poses} poses"
    rows = (
        ("6.3", "stated ambient temperature, 20 C for choice", told("temperature", 1.0, "C")),
        ("6.4", "base frame found on the robot, apart from the test",
         "best fit to the training poses: AP is smaller than with a measured base"),
        ("6.5", "uncertainty of the instrument at most a quarter of a value",
         told("u95", 1e3, "mm")),
        ("6.6", "rated load on the flange", told("payload", 1.0, "kg")),
        ("6.7", "stated velocities, up to the rated one", "not given"),
        ("6.8", "five poses on a plane in a cube of the workspace", f"{poses} poses, anywhere"),
        ("6.9", f"{CYCLES} cycles", cycles),
    )  # fmt: skip
    return tuple(starmap(Condition, rows))


def between(values: Array) -> str:
    """As 20 to 22, or 20."""
    low, high = f"{values.min():g}", f"{values.max():g}"
    return low if low == high else f"{low} to {high}"
