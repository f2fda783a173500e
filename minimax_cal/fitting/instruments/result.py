"""The result of a calibration without coordinates: what was found, how well, and what it is not."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from minimax_cal.fitting.fit import ACCURACIES, Parameter, Provenance, parameter_table
from minimax_cal.fitting.fit_file import SCHEMA, ScoresPart, TableParameter, in_si
from minimax_cal.fitting.identify import Identification
from minimax_cal.fitting.opened import RELATIVE
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.files import json_text, plain, write_whole
from minimax_cal.ground.records import Number, Part, checked, reading
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.measuring.accuracy import Accuracy, accuracy, before_and_after
from minimax_cal.modelling.cell import pose_from_dict
from minimax_cal.modelling.frames import paired, tables_of
from minimax_cal.robots.frames import CONVENTION, Frame
from minimax_cal.robots.robot import Robot, robot_from_dict
from minimax_cal.solvers.status import Status

QUANTITY = {
    "distances": "length of a wire",
    "closures": "ball about its socket",
    "poses": "position of the flange",
    "pixels": "pixel at the target",
}
CAUTION = {
    "distances": "An error of lengths is no error of position: what lies across the wires does "
    "not show in it. ",
    "closures": "A misclosure is no error of position: what moves all visits of a socket alike "
    "does not show in it. ",
    "poses": "",
    "pixels": "A pixel is no position: what moves along the line of sight does not show in it. ",
}


class ErrorsPart(ScoresPart):
    """Accuracy of lengths, closures or poses, in a file."""

    numbers: int = 0
    rms_mrad: Number = math.nan
    max_mrad: Number = math.nan
    rms_px: Number = math.nan
    max_px: Number = math.nan


class RelativePart(Part):
    """The file of `minimax-cal relative -o`."""

    measured: Literal["distances", "closures", "poses", "pixels"]
    robot: dict[str, Any]
    nominal_robot: dict[str, Any]
    parts: tuple[str, ...]
    instrument: dict[str, Any] = Field(default_factory=dict)
    status: Status
    iterations: int = 0
    seconds: Number = math.nan
    parameters: tuple[TableParameter, ...]
    accuracy: dict[Literal["nominal", "holdout", "nominal_train", "train"], ErrorsPart]
    beyond_one_reflector: tuple[str, ...] = ()
    condition: Number = math.nan
    position_sigma_mm: Number = math.nan
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


@dataclass(frozen=True, eq=False)
class RelativeCalibration:
    """A robot calibrated from lengths, closures or poses.

    kind: one of `data.KINDS`.  robot: calibrated; nominal: as drawn.
    parts: what each row of the errors is, as wire1.  errors: by key nominal, holdout,
    nominal_train, train, (parts, m, 3) of the measured quantity, NaN where not measured
    [m]; a length's error stands first of three.  numbers: independent numbers behind each
    accuracy.  turns: RMS and largest error of orientation by key [rad], empty but for poses.
    instrument: what was fitted besides the robot, for JSON.  position_sigma: expected error of a
    position over the joints' range, by the parameters' sigmas alone, the base fitted [m].
    beyond: parameters that whole poses tell and one reflector does not.
    """

    kind: str
    robot: Robot
    nominal: Robot
    parts: tuple[str, ...]
    status: Status
    iterations: int
    seconds: float
    parameters: tuple[Parameter, ...]
    errors: Mapping[str, Array]
    numbers: Mapping[str, int]
    turns: Mapping[str, tuple[float, float]]
    instrument: Mapping[str, Any]
    identification: Identification
    position_sigma: float
    beyond: tuple[str, ...]
    notices: tuple[str, ...]
    provenance: Provenance
    stated: Mapping[str, Accuracy] | None = None

    @cached_property
    def accuracy(self) -> Mapping[str, Accuracy]:
        """Of the errors, by their keys; as a file states it where it keeps no errors."""
        if self.stated is not None:
            return self.stated
        return {key: accuracy(error) for key, error in self.errors.items()}

    def before_and_after(self) -> tuple[Accuracy, Accuracy, str]:
        """On held-out poses where there are any, and which poses those are."""
        return before_and_after(self.accuracy)

    @property
    def identified(self) -> int:
        """Number of identified parameters."""
        return sum(p.identifiable for p in self.parameters)

    def accuracy_table(self) -> Table:
        """Accuracy of what was measured, before and after, training and held out."""
        rows: list[tuple[Cell, ...]] = []
        for title, key in ACCURACIES:
            a, turned = self.accuracy[key], [1e3 * value for value in self.turns.get(key, ())]
            rows.append((title, a.poses, self.numbers[key], a.rms_mm, a.mean_mm, a.max_mm, *turned))
        turns = ("RMS mrad", "max mrad") if self.turns else ()
        return Table(
            f"{self.robot.name}: {QUANTITY[self.kind]}",
            ("poses", "count", "numbers", "RMS mm", "mean mm", "max mm", *turns),
            tuple(rows),
            ("", "d", "d", *[".4f"] * (3 + len(turns))),
        )

    def parts_table(self) -> Table:
        """RMS errors wire by wire."""
        rows: tuple[tuple[Cell, ...], ...] = tuple(
            (
                part,
                *(1e3 * rms(np.linalg.norm(self.errors[key][i], axis=-1)) for _, key in ACCURACIES),
            )
            for i, part in enumerate(self.parts)
        )
        header = ("RMS mm", *(title for title, _ in ACCURACIES))
        return Table("by wire", header, rows, ("", *[".4f"] * len(ACCURACIES)))

    def tables(self) -> tuple[Table, ...]:
        """Every table of the result."""
        parts = (self.parts_table(),) if len(self.parts) > 1 and self.errors else ()
        frames = tables_of(self.frames)
        return (self.accuracy_table(), *parts, *frames, parameter_table(self.parameters))

    @property
    def frames(self) -> dict[str, Frame]:
        """Base and tool of whole poses, those of the drawn arm, and the corrections."""
        places = {
            name: pose_from_dict(self.instrument[name]) if name in self.instrument else None
            for name in ("base", "nominal_base", "tool", "nominal_tool")
        }
        base = paired("base", places["base"], places["nominal_base"])
        return base | paired("tool", places["tool"], places["nominal_tool"])

    def headline(self) -> str:
        """The result in some sentences, with what it does not say."""
        before, after, where = self.before_and_after()
        text = (
            f"{QUANTITY[self.kind].capitalize()}: RMS error {before.rms_mm:.3f} mm -> "
            f"{after.rms_mm:.3f} mm, largest {before.max_mm:.3f} mm -> {after.max_mm:.3f} mm, "
            f"at {where}. {CAUTION[self.kind]}By the parameters' sigmas alone a position over the "
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
        accuracies = {}
        for key, value in self.accuracy.items():
            turns = [1e3 * turn for turn in self.turns.get(key, ())]
            angles = dict(zip(("rms_mrad", "max_mrad"), turns, strict=False))
            accuracies[key] = {**value.to_dict(), "numbers": self.numbers[key], **angles}
        content = {
            "schema": SCHEMA,
            "kind": RELATIVE,
            "measured": self.kind,
            "robot": self.robot.to_dict(),
            "nominal_robot": self.nominal.to_dict(),
            "parts": list(self.parts),
            **(
                {
                    "frames": {name: frame.to_dict() for name, frame in self.frames.items()},
                    "frames_convention": CONVENTION,
                }
                if self.frames
                else {}
            ),
            "instrument": dict(self.instrument),
            "status": str(self.status),
            "advice": self.status.advice,
            "iterations": self.iterations,
            "seconds": self.seconds,
            "parameters": [p.to_dict() for p in self.parameters],
            "identified": self.identified,
            "beyond_one_reflector": list(self.beyond),
            "condition": self.identification.condition,
            "position_sigma_mm": 1e3 * self.position_sigma,
            "accuracy": accuracies,
            "notices": list(self.notices),
            "provenance": vars(self.provenance),
        }
        return dict(plain(content))

    @staticmethod
    def from_dict(content: Mapping[str, Any], source: str = "result") -> RelativeCalibration:
        """From `to_dict`, without the errors of single rows.  Raises CalibrationError."""
        part = checked(RelativePart, content, source)
        known = np.array([p.identifiable for p in part.parameters])
        found = RelativeCalibration(
            kind=part.measured,
            robot=robot_from_dict(content["robot"], f"{source}: robot"),
            nominal=robot_from_dict(content["nominal_robot"], f"{source}: nominal_robot"),
            parts=part.parts,
            status=part.status,
            iterations=part.iterations,
            seconds=part.seconds,
            parameters=tuple(in_si(p) for p in part.parameters),
            errors={},
            numbers={key: each.numbers for key, each in part.accuracy.items()},
            turns={
                key: (1e-3 * each.rms_mrad, 1e-3 * each.max_mrad)
                for key, each in part.accuracy.items()
                if not math.isnan(each.rms_mrad)
            },
            instrument=part.instrument,
            identification=Stated(known, {}, np.zeros(0), np.zeros(0), part.condition),
            position_sigma=1e-3 * part.position_sigma_mm,
            beyond=part.beyond_one_reflector,
            notices=part.notices,
            provenance=part.provenance,
            stated={key: each.accuracy() for key, each in part.accuracy.items()},
        )
        with reading(source, "instrument"):
            _ = found.frames  # poses that are none are refused here, not when they are shown
        return found

    def json(self) -> str:
        """`to_dict` as text."""
        return json_text(self.to_dict())

    def save(self, path: Path | str) -> None:
        """Write the JSON; never a half-written file."""
        write_whole(path, self.json())
