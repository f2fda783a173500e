"""Lengths from fixed anchors to a target on the flange."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minimax_cal.fitting.checks import MAX_TRIAL_POSES
from minimax_cal.fitting.found import Parameter
from minimax_cal.fitting.identify import plenty_of_poses
from minimax_cal.fitting.instruments.data import (
    RelativeData,
    bare,
    checked,
    different,
    without_blind,
)
from minimax_cal.fitting.instruments.fit import InstrumentFit, fit_instruments, own_parameters
from minimax_cal.fitting.instruments.options import RelativeOptions, silent
from minimax_cal.fitting.instruments.plausible import Slip, check_slips
from minimax_cal.fitting.instruments.record import Columns, Instrument, Words
from minimax_cal.fitting.instruments.refine import refined, spots_aside
from minimax_cal.fitting.instruments.rows import (
    SPOT,
    OnFlange,
    motion,
    places,
    scaled_lstsq,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.joint_rows import joint_rows
from minimax_cal.measuring.measurements import FARTHEST
from minimax_cal.modelling.model import Model, arm_at
from minimax_cal.modelling.parameters import State
from minimax_cal.reading.rows import Rows
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import Chain
from minimax_cal.robots.robot import Robot

WIRE = re.compile(r"wire(\d+)_(mm|m)")
LEAST_LENGTHS = 5  # of one wire; its anchor alone has three unknowns
PLENTY = 200  # poses that show what no poses could tell
ENOUGH = 60  # poses that tell one start from another
BETTER = 0.25  # of the mean square: what explains so much is worth a look
LEAST = 5e-3  # a fit that misses by less leaves nothing to explain [mm]


# ---- what is measured --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Lengths(RelativeData):
    """Lengths of wires.

    wires: s names, as wire1.  length: (m, s) from an anchor to the target, NaN where not measured
    [m].
    """

    wires: tuple[str, ...]
    length: Array

    kind = "distances"
    by_row = ("length",)

    @property
    def numbers(self) -> Array:
        """(m,) of the wires that were measured."""
        return np.asarray(np.isfinite(self.length).sum(axis=1))

    @property
    def independent(self) -> int:
        """Those of different poses, of each wire."""
        return sum(different(self.at, np.isfinite(length)) for length in self.length.T)

    @property
    def often(self) -> dict[str, int]:
        """How many lengths of each wire there are."""
        return dict(zip(self.wires, np.isfinite(self.length).sum(axis=0).tolist(), strict=True))

    def check(self) -> None:
        """Raise DataError for a length that is none, and for wires that tell nothing."""
        wrong = (self.length <= 0.0) | (self.length > FARTHEST) | np.isinf(self.length)
        if wrong.any():
            row, wire = np.argwhere(wrong)[0]
            value = 1e3 * self.length[row, wire]
            what = "is no length" if value <= 0.0 else "is more than 100 km"
            raise DataError(
                f"{self.says(row)}: column {self.wires[wire]}_mm: {value:g} {what}; leave the cell "
                "empty where it was not measured"
            )
        for name, count in self.often.items():
            if count < LEAST_LENGTHS:
                raise DataError(
                    f"{self.at.source}: {name} is measured at {count} poses, but its anchor alone "
                    f"has three unknowns; measure at least {LEAST_LENGTHS}, or delete its column"
                )

    def check_training(self) -> None:
        """Raise DataError for wires that are held out too often."""
        for name, count in self.often.items():
            if count < LEAST_LENGTHS:
                raise DataError(
                    f"{self.at.source}: {name} has {count} lengths in training, and needs "
                    f"{LEAST_LENGTHS}; measure more or hold out fewer"
                )

    def columns(self) -> Mapping[str, Array]:
        """A column a wire."""
        return {f"{name}_mm": 1e3 * self.length[:, i] for i, name in enumerate(self.wires)}


def distances(q: Array, length: Array, **columns: Array) -> Lengths:
    """Wire lengths from arrays.

    q: (m, n) [rad, m].  length: (m,) or (m, s), NaN where not measured [m].  columns: as
    `data.measurements` takes them.
    """
    length = np.array(length, dtype=float)
    length = length[:, None] if length.ndim == 1 else length
    at = bare(q, columns, length=length)
    return checked(Lengths(at, wire_names(range(1, length.shape[1] + 1)), length))


def wire_names(numbers: Iterable[int]) -> tuple[str, ...]:
    """wire1 ..."""
    return tuple(f"wire{number}" for number in numbers)


def read(file: Rows) -> Lengths:
    """The wires' columns.  Raises DataError."""
    file, at = joint_rows(file, WIRE)
    found = sorted((int(m[1]), n, m[2]) for n in file.header if (m := WIRE.fullmatch(n)))
    numbers = [number for number, _, _ in found]
    twice = [number for number in numbers if numbers.count(number) > 1]
    if twice:
        raise DataError(f"{file.path}:1: wire{twice[0]} has two columns; keep one unit")
    length = np.stack([file.number(n, unit=unit, empty=True) for _, n, unit in found], axis=1)
    return without_blind(Lengths(at, wire_names(numbers), length), np.isnan(length).all(axis=1))


# ---- the model ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Wires(OnFlange):
    """Wires as a block, see `rows.Block`.

    length: (m, s), NaN where not measured [m].  Its own: the target, s anchors, s offsets.
    """

    model: Model
    wires: tuple[str, ...]
    length: Array
    with_offsets: bool = False

    kind = "distances"
    whole = "all anchors moved together"
    has_length = True

    @staticmethod
    def of(robot: Robot, data: Lengths, options: RelativeOptions) -> Wires:
        """Wires of a robot; the parameters of wire3 are anchor3_x ... and offset3."""
        return Wires(arm_at(robot, data.at.q), data.wires, data.length, options.offset)

    @property
    def own(self) -> tuple[str, ...]:
        """Target, anchors, offsets."""
        numbers = [wire.removeprefix("wire") for wire in self.wires]
        anchors = (f"anchor{number}_{axis}" for number in numbers for axis in "xyz")
        return (*SPOT, *anchors, *(f"offset{number}" for number in numbers))

    @property
    def given_up(self) -> tuple[str, ...]:
        """The offsets."""
        return tuple(name for name in self.own if name.startswith("offset"))

    @property
    def held(self) -> tuple[str, ...]:
        """The offsets, unless they are to be fitted: 0."""
        return () if self.with_offsets else self.given_up

    @property
    def parts(self) -> tuple[str, ...]:
        """The wires."""
        return self.wires

    @property
    def points(self) -> int:
        """Number of measured lengths."""
        return int(np.isfinite(self.length).sum())

    @property
    def pose_of_row(self) -> Array:
        """Wire by wire."""
        return np.nonzero(np.isfinite(self.length.T))[1]

    def split(self, x: State) -> tuple[Array, Array]:
        """Anchors (..., s, 3) and offsets (..., s) [m]."""
        s, own = self.length.shape[1], x.effects[..., 3:]
        return own[..., : 3 * s].reshape(*own.shape[:-1], s, 3), own[..., 3 * s : 4 * s]

    def misses(self, x: State) -> Array:
        """Measured minus predicted lengths: (..., s, m), NaN where not measured [m]."""
        anchors, offsets = self.split(x)
        gap = places(self.model, x)[..., None, :, :] - anchors[..., None]
        return np.asarray(self.length.T - np.linalg.norm(gap, axis=-2) - offsets[..., None])

    def rows(self, x: State, active: Array) -> tuple[Array, Array]:
        """A row for each measured length: it grows as the target moves along the wire."""
        first = self.model.names.geometric
        point, arms = motion(self.model, x, active)
        anchors, offsets = self.split(x)
        gap = point[..., None, :, :] - anchors[..., None]
        distance = np.maximum(np.linalg.norm(gap, axis=-2), 1e-12)
        unit = gap / distance[..., None, :]
        *batch, s, m = distance.shape
        own = np.zeros((*batch, len(active), s, m))
        for i in range(s):
            own[..., first + 3 * i : first + 3 * i + 3, i, :] = -unit[..., i, :, :]
            own[..., first + 3 * s + i, i, :] = 1.0
        along = np.einsum("...scm,...pcm->...psm", unit, arms)
        jacobian = along + own[..., active, :, :]
        seen = np.isfinite(self.length.T)
        error = self.length.T - distance - offsets[..., None]
        return error[..., seen], jacobian[..., seen]

    def start(self, robot: Robot, free: Array) -> Array:
        """Anchors and target (and offsets, where free) that fit the arm as drawn best.

        With the last frame (R, o) known at every pose, |o + R t - A| = L - z squared is
        2 o.Rt - 2 o.A - 2 Rt.A + 2 L z + c = L^2 - |o|^2: linear in t, A, the nine products t A', z
        and c.  That start, and trilaterations from some places t, are refined; the best is kept.
        """
        with_offset = bool(free[3 + 3 * len(self.wires) :].any())
        links = kinematics.chain(robot.mdh, self.model.q, self.model.prismatic)
        first = linear_target(links, self.length, with_offset=with_offset)
        starts = [
            np.concatenate([spot, trilaterated(links, self.length, spot, with_offset)])
            for spot in spots_aside(robot, first)
        ]
        return refined(robot, self, self.thinned(), free, starts)

    def thinned(self) -> Wires:
        """At some of the poses, the same number for each wire as far as there are."""
        chosen = np.zeros(len(self.model.q), dtype=bool)
        for lengths in self.length.T:
            chosen[spread(lengths, ENOUGH)] = True
        return replace(self, model=self.model.take(chosen), length=self.length[chosen])

    def reference(self, robot: Robot, x: State) -> Wires:
        """At plenty of random poses."""
        count = max(PLENTY, self.model.names.geometric + 4 * len(self.wires))
        model = plenty_of_poses(robot, self.model, count)
        return replace(self, model=model, length=np.zeros((count, len(self.wires))))

    def closed(self, robot: Robot, x: State) -> Wires:
        """The same: lengths fit any arm by its anchors."""
        return self

    def mean_square(self, x: State) -> float:
        """Of the misses of lengths [m^2]."""
        return float(np.nanmean(self.misses(x) ** 2))

    def errors(self, model: Model, x: State, data: Lengths, held: Array) -> Array:
        """The error of a length stands first of three."""
        error = replace(self, model=model, length=data.length).misses(x)
        return np.stack([error, *(np.where(np.isnan(error), np.nan, 0.0),) * 2], axis=-1)

    def placed(self, x: State, nominal: State) -> dict[str, Any]:
        """Target in the last frame, anchors in the robot's base."""
        anchors, offsets = self.split(x)
        out: dict[str, Any] = {"target_mm": (1e3 * x.effects[:3]).tolist()}
        out["anchors_mm"] = dict(zip(self.wires, (1e3 * anchors).tolist(), strict=True))
        if self.with_offsets:
            out["offsets_mm"] = dict(zip(self.wires, (1e3 * offsets).tolist(), strict=True))
        return out


def spread(length: Array, most: int) -> Array:
    """Rows of at most so many lengths of a wire (m,), evenly spread."""
    seen = np.flatnonzero(np.isfinite(length))
    return np.asarray(seen[np.linspace(0, len(seen) - 1, min(len(seen), most)).astype(int)])


def linear_target(links: Chain, length: Array, *, with_offset: bool) -> Array:
    """The target (3,) of the linear start [m].  length: (m, s), NaN where not measured."""
    s = length.shape[1]
    parts, rights = [], []
    for i in range(s):
        seen = np.isfinite(length[:, i])
        o, axes, long = links.origin[:, seen], links.axes[..., seen], length[seen, i]
        own = np.zeros((len(long), s, 14))
        own[:, i, :3] = -2.0 * o.T
        own[:, i, 3:12] = -2.0 * axes.reshape(9, -1).T
        own[:, i, 12] = 1.0
        own[:, i, 13] = 2.0 * long if with_offset else 0.0
        turned = 2.0 * np.einsum("kjm,jm->mk", axes, o)
        parts.append(np.concatenate([turned, own.reshape(len(long), -1)], axis=1))
        rights.append(long**2 - (o**2).sum(axis=0))
    return scaled_lstsq(np.concatenate(parts), np.concatenate(rights))[:3]


def trilaterated(links: Chain, length: Array, target: Array, with_offset: bool) -> Array:
    """Anchors and offsets (4s,) for a given target: 2 p.A - 2 L z - c = |p|^2 - L^2 [m]."""
    point = kinematics.points(links, target[None])[0]
    anchors, offsets = [], []
    for long in length.T:
        seen = np.isfinite(long)
        p, long = point[:, seen], long[seen]
        matrix = np.stack([*(2.0 * p), -np.ones(len(long)), -2.0 * long * with_offset], axis=1)
        found = scaled_lstsq(matrix, (p**2).sum(axis=0) - long**2)
        anchors.append(found[:3])
        offsets.append(found[4])
    return np.concatenate([*anchors, offsets])


# ---- what is said of it ------------------------------------------------------------------------


def check(robot: Robot, data: Lengths, options: RelativeOptions) -> None:
    """Raise DataError for slips, by some lengths of each wire: the held-out ones among them."""
    chosen = np.zeros(data.poses, dtype=bool)
    for length in data.length.T:
        chosen[spread(length, MAX_TRIAL_POSES)] = True
    few = data.take(chosen)
    check_slips(robot, few, options, slips(few))


def slips(data: Lengths) -> list[Slip]:
    """Units that were taken for others."""
    texts = {
        1e-3: "the lengths look like millimetres given as metres: name the columns wire1_mm, ...",
        1e3: "the lengths look like metres given as millimetres: name the columns wire1_m, ...",
    }
    return [(text, replace(data, length=unit * data.length)) for unit, text in texts.items()]


def of_offsets(
    robot: Robot, fit: InstrumentFit, i: int, options: RelativeOptions
) -> tuple[str, ...]:
    """How weakly the offsets of wires are determined."""
    if not options.offset:
        return ()
    told = [
        p for p in own_parameters(robot, fit, i) if p.name.rpartition(".")[2].startswith("offset")
    ]
    each = ", ".join(map(offset_text, told))
    return (
        f"offsets are weakly determined (a length is known to {1e3 * fit.noise[i]:.3f} mm): "
        f"{each}; only how the wires' directions vary tells an offset from the anchor's place",
    )


def offset_text(offset: Parameter) -> str:
    """An offset and its sigma."""
    if not offset.identifiable:
        return f"{offset.name} not identifiable"
    return f"{offset.name} {1e3 * offset.value:+.3f} +- {1e3 * offset.sigma:.3f} mm"


def unfitted(robot: Robot, fit: InstrumentFit, i: int, options: RelativeOptions) -> tuple[str, str]:
    """A notice where an offset of each wire explains what the fit leaves; '' where not."""
    if options.offset or 1e3 * fit.noise[i] < LEAST:
        return "", ""
    try:
        more = fit_instruments(robot, fit.trains, replace(options, offset=True), silent)
    except DataError:  # too few lengths for so many unknowns
        return "", ""
    if more.noise[i] ** 2 > BETTER * fit.noise[i] ** 2:
        return "", ""
    mend = "fit the wires' zeros with offset="
    return (
        f"with an offset of each wire the lengths fit to {1e3 * more.noise[i]:.3g} mm, without to "
        f"{1e3 * fit.noise[i]:.3g} mm: the wires' zeros look off; fit them with offset=",
        mend,
    )


INSTRUMENT = Instrument(
    name=Lengths.kind,
    words=Words(
        quantity="length of a wire",
        part="wire",
        caution="An error of lengths is no error of position: what lies across the wires does not "
        "show in it. ",
        counted="lengths",
        check="which length is which wire's",
        more="more anchors, around it",
    ),
    block=Wires.of,
    columns=Columns(re.compile(r"wire.*"), WIRE, "wire1_mm ...", read),
    check_slips=check,
    options=("offset",),
    remarks=of_offsets,
    unfitted=unfitted,
)
