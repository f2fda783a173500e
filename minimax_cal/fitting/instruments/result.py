"""The result of a calibration without coordinates: what was found, how well, and what it is not."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from minimax_cal.fitting.fit import (
    ACCURACIES,
    Parameter,
    Provenance,
    parameter_table,
    table_of_effects,
)
from minimax_cal.fitting.fit_file import SCHEMA, ScoresPart, TableParameter, in_si
from minimax_cal.fitting.identify import Identification
from minimax_cal.fitting.instruments.record import Words
from minimax_cal.fitting.instruments.table import INSTRUMENTS, instrument
from minimax_cal.fitting.intervals import Interval
from minimax_cal.fitting.opened import RELATIVE
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.files import json_text, plain, write_whole
from minimax_cal.ground.records import Number, Part, checked, reading
from minimax_cal.ground.tables import Cell as TableCell
from minimax_cal.ground.tables import Table
from minimax_cal.ground.words import name_first
from minimax_cal.measuring.accuracy import Accuracy, accuracy, before_and_after
from minimax_cal.modelling.cell import Cell, cell_from_dict, pose_from_dict
from minimax_cal.modelling.frames import paired, tables_of
from minimax_cal.robots.frames import CONVENTION, Frame
from minimax_cal.robots.robot import Robot, robot_from_dict
from minimax_cal.solvers.status import Status

SEVERAL = "several"  # kind of a calibration from several files
ALL = Words(
    quantity="what every file measured",
    caution="Lengths, misclosures and positions are one number here; each file has its own. ",
)
if TYPE_CHECKING:
    Kind = str
else:  # of the table, which no type checker sees
    Kind = Literal[(*INSTRUMENTS, SEVERAL)]


class ErrorsPart(ScoresPart):
    """Accuracy of lengths, closures or poses, in a file."""

    numbers: int = 0
    rms_mrad: Number = math.nan
    max_mrad: Number = math.nan
    rms_px: Number = math.nan
    max_px: Number = math.nan


class MeasuredPart(Part):
    """What an instrument measured, and how well it is fitted, in a file."""

    measured: Kind
    parts: tuple[str, ...]
    instrument: dict[str, Any] = Field(default_factory=dict)
    accuracy: dict[Literal["nominal", "holdout", "nominal_train", "train"], ErrorsPart]

    def fields(self) -> dict[str, Any]:
        """As `Measured` has them, without the errors of single rows."""
        turns = {
            key: (1e-3 * each.rms_mrad, 1e-3 * each.max_mrad)
            for key, each in self.accuracy.items()
            if not math.isnan(each.rms_mrad)
        }
        return {
            "kind": self.measured,
            "parts": self.parts,
            "errors": {},
            "numbers": {key: each.numbers for key, each in self.accuracy.items()},
            "turns": turns,
            "instrument": self.instrument,
            "stated": {key: each.accuracy() for key, each in self.accuracy.items()},
        }


class InstrumentPart(MeasuredPart):
    """One of several instruments, in a file."""

    name: str
    noise_mm: Number = math.nan
    alone: tuple[str, ...] = ()
    directions_alone: int = 0


class RelativePart(MeasuredPart):
    """The file of `minimax-cal relative -o`."""

    robot: dict[str, Any]
    nominal_robot: dict[str, Any]
    instruments: tuple[InstrumentPart, ...] = ()
    cell: dict[str, Any] = Field(default_factory=dict)
    status: Status
    iterations: int = 0
    seconds: Number = math.nan
    parameters: tuple[TableParameter, ...]
    beyond_one_reflector: tuple[str, ...] = ()
    condition: Number = math.nan
    position_sigma_mm: Number = math.nan
    positions_open: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()
    provenance: Provenance


@dataclass(frozen=True)
class Stated(Identification):
    """As a file tells it, without the singular values."""

    told: float

    @property
    def condition(self) -> float:
        """As the file says."""
        return self.told


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured:
    """What was measured, and how well it is fitted.

    kind: name of an instrument, or `SEVERAL`.  parts: what each row of the errors is, as wire1.
    errors: by key nominal, holdout, nominal_train, train, (parts, m, 3) of the measured quantity,
    NaN where not measured [m]; a length's error stands first of three.  numbers: independent
    numbers behind each accuracy.  turns: RMS and largest error of orientation by key [rad], empty
    but for poses.  instrument: what was fitted besides the robot, for JSON.
    """

    kind: str
    parts: tuple[str, ...]
    errors: Mapping[str, Array]
    numbers: Mapping[str, int]
    turns: Mapping[str, tuple[float, float]]
    instrument: Mapping[str, Any]
    stated: Mapping[str, Accuracy] | None = None

    @property
    def words(self) -> Words:
        """What is said of it."""
        return ALL if self.kind == SEVERAL else instrument(self.kind).words

    @cached_property
    def accuracy(self) -> Mapping[str, Accuracy]:
        """Of the errors, by their keys; as a file states it where it keeps no errors."""
        if self.stated is not None:
            return self.stated
        return {key: accuracy(error) for key, error in self.errors.items()}

    def before_and_after(self) -> tuple[Accuracy, Accuracy, str]:
        """On held-out poses where there are any, and which poses those are."""
        return before_and_after(self.accuracy)

    def scores(self, title: str) -> Table:
        """Accuracy before and after, training and held out."""
        rows: list[tuple[TableCell, ...]] = []
        for heading, key in ACCURACIES:
            a, turned = self.accuracy[key], [1e3 * value for value in self.turns.get(key, ())]
            rows.append(
                (heading, a.poses, self.numbers[key], a.rms_mm, a.mean_mm, a.max_mm, *turned)
            )
        turns = ("RMS mrad", "max mrad") if self.turns else ()
        return Table(
            title,
            ("poses", "count", "numbers", "RMS mm", "mean mm", "max mm", *turns),
            tuple(rows),
            ("", "d", "d", *[".4f"] * (3 + len(turns))),
        )

    def parts_table(self, title: str) -> Table:
        """RMS errors part by part, as wire by wire."""
        rows: tuple[tuple[TableCell, ...], ...] = tuple(
            (
                part,
                *(1e3 * rms(np.linalg.norm(self.errors[key][i], axis=-1)) for _, key in ACCURACIES),
            )
            for i, part in enumerate(self.parts)
        )
        header = ("RMS mm", *(heading for heading, _ in ACCURACIES))
        return Table(title, header, rows, ("", *[".4f"] * len(ACCURACIES)))

    @property
    def frames(self) -> dict[str, Frame]:
        """Base and tool as a tracker's points or whole poses have them, the drawn arm's, and the
        corrections.
        """
        places = {
            name: pose_from_dict(self.instrument[name]) if name in self.instrument else None
            for name in ("base", "nominal_base", "tool", "nominal_tool")
        }
        base = paired("base", places["base"], places["nominal_base"])
        return base | paired("tool", places["tool"], places["nominal_tool"])

    def measured_dict(self) -> dict[str, Any]:
        """For JSON."""
        accuracies = {}
        for key, value in self.accuracy.items():
            turns = [1e3 * turn for turn in self.turns.get(key, ())]
            angles = dict(zip(("rms_mrad", "max_mrad"), turns, strict=False))
            accuracies[key] = {**value.to_dict(), "numbers": self.numbers[key], **angles}
        frames = {name: frame.to_dict() for name, frame in self.frames.items()}
        return {
            "measured": self.kind,
            "parts": list(self.parts),
            **({"frames": frames, "frames_convention": CONVENTION} if frames else {}),
            "instrument": dict(self.instrument),
            "accuracy": accuracies,
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class InstrumentResult(Measured):
    """One of several files.

    interval: 95 % of the held-out RMS [m].  noise: sigma of a number by what the fit leaves [m].
    alone: link parameters that only this file
    determines; directions_alone: the number of independent directions in which it does.
    """

    name: str
    interval: Interval
    noise: float
    alone: tuple[str, ...]
    directions_alone: int

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        measured = self.measured_dict()
        measured["accuracy"]["holdout"]["rms_ci95_mm"] = [
            1e3 * self.interval.low,
            1e3 * self.interval.high,
        ]
        return {
            "name": self.name,
            **measured,
            "noise_mm": 1e3 * self.noise,
            "alone": list(self.alone),
            "directions_alone": self.directions_alone,
        }

    @staticmethod
    def of(part: InstrumentPart) -> InstrumentResult:
        """From a file's part."""
        return InstrumentResult(
            **part.fields(),
            name=part.name,
            interval=Interval(*(1e-3 * end for end in part.accuracy["holdout"].rms_ci95_mm)),
            noise=1e-3 * part.noise_mm,
            alone=part.alone,
            directions_alone=part.directions_alone,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class RelativeCalibration(Measured):
    """A robot calibrated from lengths, closures or poses, or from several files together.

    robot: calibrated; nominal: as drawn.  position_sigma: expected error of a position over the
    joints' range, by the parameters' sigmas alone, the base fitted [m].  positions_open: parameters
    that positions depend on and that the measurements do not determine; no sigma holds these.
    beyond: parameters that whole poses tell and one reflector does not.  instruments: each of
    several files.  cell: the arm with its effects, fitted together; None without any.  robot is
    then of a fit without them.
    """

    robot: Robot
    nominal: Robot
    status: Status
    iterations: int
    seconds: float
    parameters: tuple[Parameter, ...]
    identification: Identification
    position_sigma: float
    beyond: tuple[str, ...]
    notices: tuple[str, ...]
    provenance: Provenance
    instruments: tuple[InstrumentResult, ...] = ()
    positions_open: tuple[str, ...] = ()
    cell: Cell | None = None

    @property
    def identified(self) -> int:
        """Number of identified parameters."""
        return sum(p.identifiable for p in self.parameters)

    def accuracy_table(self) -> Table:
        """Accuracy of what was measured, before and after, training and held out."""
        return self.scores(f"{self.robot.name}: {self.words.quantity}")

    def files_table(self) -> Table:
        """Each of several files: held-out RMS before and after, and what it alone determines."""
        rows: list[tuple[TableCell, ...]] = []
        for one in self.instruments:
            before, after, _ = one.before_and_after()
            ends = (1e3 * one.interval.low, 1e3 * one.interval.high)
            rows.append((one.name, before.rms_mm, after.rms_mm, *ends, 1e3 * one.noise))
        header = ("file", "nominal mm", "RMS mm", "95 % from", "to", "noise mm")
        return Table("each file, RMS", header, tuple(rows), ("", *[".4f"] * 5))

    def alone_table(self) -> Table:
        """What only one of the files determines."""
        rows = tuple(
            (one.name, one.directions_alone, ", ".join(one.alone) or "none")
            for one in self.instruments
        )
        header = ("only by", "directions", "parameters of the arm")
        return Table("identified by one file alone", header, rows, ("", "d", ""))

    def first_tables(self) -> list[Table]:
        """What stands on the first screen."""
        first = [self.accuracy_table().brief("poses", "count", "RMS mm", "max mm")]
        if self.instruments:
            first = [self.files_table(), self.alone_table()]
        return [*first, *self.effect_tables()]

    def tables(self) -> tuple[Table, ...]:
        """Every table of the result."""
        parts = len(self.parts) > 1 and self.errors and not self.instruments
        own: list[Table] = [self.parts_table(f"by {self.words.part}")] if parts else []
        own += tables_of(self.frames)
        for one in self.instruments:
            own.append(one.scores(f"{one.name}: {one.words.quantity}"))
            own += tables_of(one.frames)
            if len(one.parts) > 1 and one.errors:
                own.append(one.parts_table(f"{one.name}, by {one.words.part}"))
        first = [self.files_table(), self.alone_table()] if self.instruments else [
            self.accuracy_table()
        ]  # fmt: skip
        geometry = parameter_table(p for p in self.parameters if not p.of_effect)
        return (*first, *self.effect_tables(), *own, geometry)

    def effect_tables(self) -> tuple[Table, ...]:
        """The parameters of effects beyond geometry; none without any."""
        return (table_of_effects(self.parameters),) if self.cell else ()

    @property
    def given_open(self) -> str:
        """On what a position's sigma rests, as the begin of a sentence."""
        if not self.positions_open:
            return "By the parameters' sigmas alone"
        many = "is" if len(self.positions_open) == 1 else "are"
        return (
            f"These data do not determine {name_first(self.positions_open)}, on which positions "
            f"depend: if {'it' if many == 'is' else 'they'} {many} as drawn, by the sigmas alone"
        )

    def headline(self) -> str:
        """The result in some sentences, with what it does not say."""
        before, after, where = self.before_and_after()
        text = (
            f"{self.words.quantity.capitalize()}: RMS error {before.rms_mm:.3f} mm -> "
            f"{after.rms_mm:.3f} mm, largest {before.max_mm:.3f} mm -> {after.max_mm:.3f} mm, "
            f"at {where}. {self.words.caution}{self.given_open} a position over the "
            f"joints' range is good to {1e3 * self.position_sigma:.3f} mm RMS once a base is "
            f"fitted. {self.identified} of {len(self.parameters)} parameters identified (condition "
            f"{self.identification.condition:.3g}); {self.status} after {self.iterations} "
            f"iterations, {self.seconds:.2f} s."
        )
        return text + (f" {self.status.advice}." if self.status.advice else "")

    def summary(self, width: int = 110) -> str:
        """The result as plain text."""
        return "\n\n".join([*(table.text(width) for table in self.tables()), self.headline()])

    def to_dict(self) -> dict[str, Any]:
        """For JSON: `robot` is the calibrated robot, whole, as `load_robot` reads it."""
        content = {
            "schema": SCHEMA,
            "kind": RELATIVE,
            "robot": self.robot.to_dict(),
            "nominal_robot": self.nominal.to_dict(),
            **self.measured_dict(),
            "status": str(self.status),
            "advice": self.status.advice,
            "iterations": self.iterations,
            "seconds": self.seconds,
            "parameters": [p.to_dict() for p in self.parameters],
            "identified": self.identified,
            "beyond_one_reflector": list(self.beyond),
            "condition": self.identification.condition,
            "position_sigma_mm": 1e3 * self.position_sigma,
            "positions_open": list(self.positions_open),
            "notices": list(self.notices),
            "provenance": vars(self.provenance),
        }
        if self.instruments:
            content["instruments"] = [one.to_dict() for one in self.instruments]
        if self.cell:
            content["cell"] = self.cell.whole()
        return dict(plain(content))

    @staticmethod
    def from_dict(content: Mapping[str, Any], source: str = "result") -> RelativeCalibration:
        """From `to_dict`, without the errors of single rows.  Raises CalibrationError."""
        part = checked(RelativePart, content, source)
        known = np.array([p.identifiable for p in part.parameters])
        found = RelativeCalibration(
            **part.fields(),
            robot=robot_from_dict(content["robot"], f"{source}: robot"),
            nominal=robot_from_dict(content["nominal_robot"], f"{source}: nominal_robot"),
            status=part.status,
            iterations=part.iterations,
            seconds=part.seconds,
            parameters=tuple(in_si(p) for p in part.parameters),
            identification=Stated(known, {}, np.zeros(0), np.zeros(0), part.condition),
            position_sigma=1e-3 * part.position_sigma_mm,
            positions_open=part.positions_open,
            beyond=part.beyond_one_reflector,
            notices=part.notices,
            provenance=part.provenance,
            instruments=tuple(InstrumentResult.of(each) for each in part.instruments),
            cell=cell_from_dict(part.cell, f"{source}: cell") if part.cell else None,
        )
        with reading(source, "instrument"):  # poses that are none are refused here, not when shown
            _ = [each.frames for each in (found, *found.instruments)]
        return found

    def json(self) -> str:
        """`to_dict` as text."""
        return json_text(self.to_dict())

    def save(self, path: Path | str) -> None:
        """Write the JSON; never a half-written file."""
        write_whole(path, self.json())
