"""Lengths from fixed anchors to a target on the flange."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.instruments.instrument import (
    SPOT,
    DataCorrection,
    Instrument,
    InstrumentColumns,
    NoticeAndMend,
    Words,
    bare,
    check_instrument_data,
    count_distinct_poses,
    drop_unmeasured_rows,
    scaled_least_squares,
    spots_aside,
)
from minimax_cal.instruments.instrument_options import InstrumentOptions
from minimax_cal.instruments.protocol import FlangePoses, ResidualRows
from minimax_cal.measuring.file_mistakes import LENGTH_UNIT_ADVICE, MAX_TRIAL_POSES
from minimax_cal.measuring.measurements import MAX_POINT_DISTANCE, build_joint_measurements
from minimax_cal.reading.measurement_table import MeasurementTable
from minimax_cal.robots.robot import Robot

WIRE_COLUMN_PATTERN = re.compile(r"wire(\d+)_(mm|m)")
MIN_LENGTHS_PER_WIRE = 5  # of one wire; its anchor alone has three unknowns
SCREENING_LENGTHS_PER_WIRE = 60  # poses that tell one start from another
MAX_OFFSET_SQUARES_RATIO = 0.25  # of the mean square: what explains so much is worth a look


class AnchorsAndOffsets(NamedTuple):
    """Anchors (s, 3) and offsets (s,) of wires [m]."""

    anchors: Array
    offsets: Array


@dataclass(frozen=True, eq=False)
class WireLengths(Instrument):
    """Lengths of wires.

    wires: s names, as wire1.  length: (m, s) from an anchor to the target, NaN where not measured
    [m].  offset: whether a constant of each wire is fitted.

    Its own: the target, s anchors, s offsets; of wire3 anchor3_x ... and offset3.
    """

    wires: tuple[str, ...]
    length: Array
    offset: bool = False

    kind = "distances"
    words = Words(
        quantity="length of a wire",
        part="wire",
        caution="An error of lengths is no error of position: what lies across the wires does not "
        "show in it. ",
        counted="lengths",
        check="which length is which wire's",
        more="more anchors, around it",
        whole="all anchors moved together",
    )
    by_row = ("length",)
    chosen = options = ("offset",)
    given_up = ("offset",)

    @property
    def numbers_per_pose(self) -> Array:
        """(m,) of the wires that were measured."""
        return np.asarray(np.isfinite(self.length).sum(axis=1))

    @property
    def independent_number_count(self) -> int:
        """Those of different poses, of each wire."""
        return sum(count_distinct_poses(self.at, np.isfinite(length)) for length in self.length.T)

    @property
    def length_count_by_wire(self) -> dict[str, int]:
        """How many lengths of each wire there are."""
        return dict(zip(self.wires, np.isfinite(self.length).sum(axis=0).tolist(), strict=True))

    def check_data(self) -> None:
        """Raise DataError for a length that is none, and for wires that tell nothing."""
        wrong = (self.length <= 0.0) | (self.length > MAX_POINT_DISTANCE) | np.isinf(self.length)
        if wrong.any():
            row, wire = np.argwhere(wrong)[0]
            value = 1e3 * self.length[row, wire]
            what = "is no length" if value <= 0.0 else "is more than 100 km"
            raise DataError(
                f"{self.row_location(row)}: column {self.wires[wire]}"
                f"_mm: {value:g} {what}; leave the cell "
                "empty where it was not measured"
            )
        for name, count in self.length_count_by_wire.items():
            if count < MIN_LENGTHS_PER_WIRE:
                raise DataError(
                    f"{self.at.source}: {name} is measured at {count} poses, but its anchor alone "
                    f"has three unknowns; measure at least "
                    f"{MIN_LENGTHS_PER_WIRE}, or delete its column"
                )

    def check_enough_training_data(self) -> None:
        """Raise DataError for wires that are held out too often."""
        for name, count in self.length_count_by_wire.items():
            if count < MIN_LENGTHS_PER_WIRE:
                raise DataError(
                    f"{self.at.source}: {name} has {count} lengths in training, and needs "
                    f"{MIN_LENGTHS_PER_WIRE}; measure more or hold out fewer"
                )

    def file_columns(self) -> Mapping[str, Array]:
        """A column a wire."""
        return {f"{name}_mm": 1e3 * self.length[:, i] for i, name in enumerate(self.wires)}

    # ---- in a fit ----------------------------------------------------------------------------

    def ready(self, robot: Robot, options: InstrumentOptions) -> WireLengths:
        """With offsets or without."""
        return replace(self, offset=options.offset)

    @property
    def names(self) -> tuple[str, ...]:
        """Target, anchors, offsets."""
        numbers = [wire.removeprefix("wire") for wire in self.wires]
        anchors = (f"anchor{number}_{axis}" for number in numbers for axis in "xyz")
        return (*SPOT, *anchors, *(f"offset{number}" for number in numbers))

    @property
    def given_unknown_names(self) -> tuple[str, ...]:
        """The offsets, unless they are to be fitted: 0."""
        return () if self.offset else self.names[-len(self.wires) :]

    @property
    def part_names(self) -> tuple[str, ...]:
        """The wires."""
        return self.wires

    def read(self, arm: FlangePoses, unknowns: Array) -> ResidualRows:
        """A row for each measured length, wire by wire: it grows as the target moves along it."""
        wire, pose = np.nonzero(np.isfinite(self.length.T))
        anchors, offsets = self.anchors_and_offsets(unknowns)
        point = arm.place(unknowns[:3])[pose]
        gap = point - anchors[wire]
        distance = np.maximum(np.linalg.norm(gap, axis=1), 1e-12)
        along, row = gap / distance[:, None], np.arange(len(pose))
        by_own = np.zeros((len(pose), len(unknowns)))
        by_own[:, :3] = np.einsum("ri,rij->rj", along, arm.rotation[pose])
        for axis in range(3):
            by_own[row, 3 + 3 * wire + axis] = -along[:, axis]
        by_own[row, 3 + 3 * len(self.wires) + wire] = 1.0
        error = self.length[pose, wire] - distance - offsets[wire]
        return ResidualRows(error, pose, point, along, np.zeros_like(along), by_own, wire)

    def anchors_and_offsets(self, unknowns: Array) -> AnchorsAndOffsets:
        """Anchors (s, 3) and offsets (s,) [m]."""
        s = len(self.wires)
        return AnchorsAndOffsets(unknowns[3 : 3 + 3 * s].reshape(s, 3), unknowns[3 + 3 * s :])

    def starts(self, arm: FlangePoses, free_unknowns: Array) -> Sequence[Array]:
        """From some places of the target, anchors and offsets by trilateration.

        With the last frame (R, o) known at every pose, |o + R t - A| = L - z squared is
        2 o.Rt - 2 o.A - 2 Rt.A + 2 L z + c = L^2 - |o|^2: linear in t, A, the nine products t A', z
        and c.  That is the first place.
        """
        with_offset = bool(free_unknowns[3 + 3 * len(self.wires) :].any())
        first = solve_linear_target(arm, self.length, with_offset=with_offset)
        return [
            np.concatenate([spot, trilaterated(arm.place(spot), self.length, with_offset)])
            for spot in spots_aside(arm, first)
        ]

    def rows_for_screening(self) -> Array:
        """Some of the poses, the same number for each wire as far as there are."""
        return self.rows_with_spread_lengths(SCREENING_LENGTHS_PER_WIRE)

    def rows_with_spread_lengths(self, max_lengths: int) -> Array:
        """(m,) True for at most so many evenly spread lengths of each wire."""
        chosen = np.zeros(self.poses, dtype=bool)
        for lengths in self.length.T:
            seen = np.flatnonzero(np.isfinite(lengths))
            chosen[seen[np.linspace(0, len(seen) - 1, min(len(seen), max_lengths)).astype(int)]] = (
                True
            )
        return chosen

    def fitted_values_to_dict(
        self, arm: FlangePoses, unknowns: Array, nominal_unknowns: Array
    ) -> dict[str, Any]:
        """Target in the last frame, anchors in the robot's base."""
        anchors, offsets = self.anchors_and_offsets(unknowns)
        out: dict[str, Any] = {"target_mm": (1e3 * unknowns[:3]).tolist()}
        out["anchors_mm"] = dict(zip(self.wires, (1e3 * anchors).tolist(), strict=True))
        if self.offset:
            out["offsets_mm"] = dict(zip(self.wires, (1e3 * offsets).tolist(), strict=True))
        return out

    # ---- slips and remarks -------------------------------------------------------------------

    def thin_for_trials(self) -> WireLengths:
        """Some lengths of each wire, the held-out ones among them."""
        return self.take_rows(self.rows_with_spread_lengths(MAX_TRIAL_POSES))

    def propose_data_corrections(self) -> Iterable[DataCorrection]:
        """Units that were taken for others."""
        return [
            (text.format("the lengths", "wire1"), replace(self, length=unit * self.length))
            for unit, text in LENGTH_UNIT_ADVICE.items()
        ]

    def list_remarks(self, parameters: Sequence[Any], noise: float) -> tuple[str, ...]:
        """How weakly the offsets of wires are determined."""
        if not self.offset:
            return ()
        told = [p for p in parameters if p.name.rpartition(".")[2].startswith("offset")]
        each = ", ".join(map(format_offset, told))
        return (
            f"offsets are weakly determined (a length is known to {1e3 * noise:.3f} mm): "
            f"{each}; only how the wires' directions vary tells an offset from the anchor's place",
        )

    def options_for_more_parameters(self) -> Mapping[str, object]:
        """Offsets, where they are not fitted."""
        return {} if self.offset else {"offset": True}

    def describe_wider_fit(self, noise_before: float, noise_after: float) -> NoticeAndMend:
        """A notice where an offset of each wire explains most of what the fit leaves."""
        if noise_after**2 > MAX_OFFSET_SQUARES_RATIO * noise_before**2:
            return NoticeAndMend("", "")
        mend = "fit the wires' zeros with offset="
        return NoticeAndMend(
            f"with an offset of each wire the lengths fit to "
            f"{1e3 * noise_after:.3g} mm, without to "
            f"{1e3 * noise_before:.3g} mm: the wires' zeros look off; fit them with offset=",
            mend,
        )


def format_offset(offset: Any) -> str:
    """An offset and its sigma."""
    if not offset.identifiable:
        return f"{offset.name} not identifiable"
    return f"{offset.name} {1e3 * offset.value:+.3f} +- {1e3 * offset.sigma:.3f} mm"


def distances(q: Array, length: Array, **columns: Array) -> WireLengths:
    """Wire lengths from arrays.

    q: (m, n) [rad, m].  length: (m,) or (m, s), NaN where not measured [m].  columns: as
    `data.measurements` takes them.
    """
    length = np.array(length, dtype=float)
    length = length[:, None] if length.ndim == 1 else length
    at = bare(q, columns, length=length)
    return check_instrument_data(
        WireLengths(at, format_wire_names(range(1, length.shape[1] + 1)), length)
    )


def format_wire_names(numbers: Iterable[int]) -> tuple[str, ...]:
    """wire1 ..."""
    return tuple(f"wire{number}" for number in numbers)


def parse_wire_lengths(table: MeasurementTable) -> WireLengths:
    """The wires' columns.  Raises DataError."""
    at = build_joint_measurements(table, WIRE_COLUMN_PATTERN)
    found = sorted(
        (int(m[1]), n, m[2]) for n in table.header if (m := WIRE_COLUMN_PATTERN.fullmatch(n))
    )
    numbers = [number for number, _, _ in found]
    twice = [number for number in numbers if numbers.count(number) > 1]
    if twice:
        raise DataError(f"{table.path}:1: wire{twice[0]} has two columns; keep one unit")
    length = np.stack(
        [table.number_column(n, unit=unit, allow_empty=True) for _, n, unit in found], axis=1
    )
    return drop_unmeasured_rows(
        WireLengths(at, format_wire_names(numbers), length), np.isnan(length).all(axis=1)
    )


# ---- a start without a guess -------------------------------------------------------------------


def solve_linear_target(arm: FlangePoses, lengths: Array, *, with_offset: bool) -> Array:
    """The target (3,) of the linear start [m].  lengths: (m, s), NaN where not measured."""
    s = lengths.shape[1]
    axes = arm.rotation.swapaxes(1, 2)  # one a row
    turned = 2.0 * np.einsum("mkj,mj->mk", axes, arm.origin)
    parts, rights = [], []
    for i in range(s):
        seen = np.isfinite(lengths[:, i])
        o, long = arm.origin[seen], lengths[seen, i]
        own = np.zeros((len(long), s, 14))
        own[:, i, :3] = -2.0 * o
        own[:, i, 3:12] = -2.0 * axes[seen].reshape(-1, 9)
        own[:, i, 12] = 1.0
        own[:, i, 13] = 2.0 * long if with_offset else 0.0
        parts.append(np.concatenate([turned[seen], own.reshape(len(long), -1)], axis=1))
        rights.append(long**2 - (o**2).sum(axis=1))
    return scaled_least_squares(np.concatenate(parts), np.concatenate(rights))[:3]


def trilaterated(point: Array, length: Array, with_offset: bool) -> Array:
    """Anchors and offsets (4s,) for a target at (m, 3): 2 p.A - 2 L z - c = |p|^2 - L^2 [m]."""
    anchors, offsets = [], []
    for long in length.T:
        seen = np.isfinite(long)
        p, long = point[seen], long[seen]
        matrix = np.column_stack([2.0 * p, -np.ones(len(long)), -2.0 * long * with_offset])
        found = scaled_least_squares(matrix, (p**2).sum(axis=1) - long**2)
        anchors.append(found[:3])
        offsets.append(found[4])
    return np.concatenate([*anchors, offsets])


WireLengths.file = InstrumentColumns(
    re.compile(r"wire.*"), WIRE_COLUMN_PATTERN, "wire1_mm ...", parse_wire_lengths
)
