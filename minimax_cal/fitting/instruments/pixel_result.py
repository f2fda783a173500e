"""The result of a calibration by cameras: the arm, and how well pixels know it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from pydantic import Field

from minimax_cal.fitting.fit import ACCURACIES, parameter_table
from minimax_cal.fitting.instruments.result import RelativeCalibration, RelativePart
from minimax_cal.fitting.pixels.judge import Claim
from minimax_cal.fitting.pixels.options import SUM
from minimax_cal.fitting.pixels.worst import WorstPixels
from minimax_cal.ground.files import plain
from minimax_cal.ground.records import Number, Part, Recorded, checked
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.ground.words import capitalise
from minimax_cal.measuring.accuracy import Accuracy
from minimax_cal.measuring.aside import SetAside
from minimax_cal.robots.robot import Robot, robot_from_dict
from minimax_cal.solvers.minimax import Kkt
from minimax_cal.solvers.status import Status

PIXELS = "pixels"  # what was measured
NO_CLAIM = Claim(*[math.nan] * 4)


class ArmPart(Part):
    """What is known of positions of the arm, in a file [mm]."""

    sigma_mm: Number = math.nan
    drawn_sigma_mm: Number = math.nan
    change_mm: Number = math.nan
    drawn_shown_mm: Number = math.nan


class AsidePart(Part):
    """A pixel that was set aside, in a file."""

    row: int
    pose: int
    target: str
    why: str
    by: str


class WorstPart(Part):
    """What a minimax rests on, in a file."""

    functions: tuple[str, ...]
    rms_px: tuple[Number, ...]
    multipliers: tuple[Number, ...]
    active: tuple[str, ...]
    sum_largest_rms_px: Number
    kkt: Recorded[Kkt]

    def read(self, answered: Mapping[str, int]) -> WorstPixels:
        """What it says."""
        size, multiplier = np.array(self.rms_px), np.array(self.multipliers)
        before = self.sum_largest_rms_px
        return WorstPixels(self.functions, size, multiplier, before, self.kkt, answered)


class PixelPart(RelativePart):
    """The file of a calibration by cameras."""

    calibrated_robot: dict[str, Any]
    arm_position: ArmPart
    objective: str = SUM
    qp: str = ""
    answered: dict[str, int] = Field(default_factory=dict)
    minimax: WorstPart | None = None
    set_aside: tuple[AsidePart, ...] = ()
    reason: str = ""


@dataclass(frozen=True, eq=False)
class PixelCalibration(RelativeCalibration):
    """A robot calibrated by cameras; `robot` is the drawn one where that is kept.

    calibrated: the robot that fits the pixels.  pixels: RMS and largest error by key [px].
    claim: of positions of the arm.  with_them: held-out accuracy with the pixels set aside.
    reason: why it failed or the drawn arm is kept; empty where neither.  worst: what a minimax
    rests on, None where there was none.
    """

    calibrated: Robot | None = None
    objective: str = SUM
    qp: str = ""
    worst: WorstPixels | None = None
    pixels: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    claim: Claim = NO_CLAIM
    set_aside: tuple[SetAside, ...] = ()
    with_them: Accuracy | None = None
    reason: str = ""

    @property
    def is_no_better(self) -> bool:
        """Whether the drawn arm is kept."""
        return self.status is Status.NO_BETTER

    def accuracy_table(self) -> Table:
        """Errors in the image, and at the target, before and after, training and held out."""
        rows: list[tuple[Cell, ...]] = []
        for title, key in ACCURACIES:
            found, (rms_px, max_px) = self.accuracy[key], self.pixels.get(key, (math.nan,) * 2)
            rows.append((title, found.poses, rms_px, max_px, found.rms_mm, found.max_mm))
        return Table(
            f"{self.robot.name}: pixels, and the same at the target",
            ("poses", "count", "RMS px", "max px", "RMS mm", "max mm"),
            tuple(rows),
            ("", "d", ".3f", ".3f", ".4f", ".4f"),
        )

    def claim_table(self) -> Table:
        """Positions of the arm: what pixels and the drawing know."""
        rows = (
            ("calibrated arm, sigma", 1e3 * self.claim.sigma),
            ("drawn arm, sigma (drawn_within)", 1e3 * self.claim.drawn),
            ("drawn arm, as pixels show it", 1e3 * self.claim.shown),
            ("calibrated against drawn", 1e3 * self.claim.change),
        )
        title = "positions over the joints' whole range, base and tool fitted"
        return Table(title, ("arm", "RMS mm"), rows, ("", ".4f"))

    def tables(self) -> tuple[Table, ...]:
        """Every table of the result."""
        worst = (self.worst.table(),) if self.worst else ()
        parameters = parameter_table(self.parameters)
        return (self.accuracy_table(), self.claim_table(), *worst, parameters)

    def headline(self) -> str:
        """The result in some sentences, with what it does not say."""
        before, after, where = self.before_and_after()
        key = "holdout" if self.accuracy["holdout"].poses else "train"
        drawn = {"holdout": "nominal", "train": "nominal_train"}[key]
        (px_before, _), (px_after, _) = (
            self.pixels.get(name, (math.nan,) * 2) for name in (drawn, key)
        )
        text = (
            f"Pixels: RMS error {px_before:.3f} px -> {px_after:.3f} px ({before.rms_mm:.3f} mm -> "
            f"{after.rms_mm:.3f} mm at the target), at {where}. That says nothing of the arm's "
            f"positions by itself. {self.claim.sentence()} {self.identified} of "
            f"{len(self.parameters)} parameters identified (condition "
            f"{self.identification.condition:.3g}); {self.status} after {self.iterations} "
            f"iterations, {self.seconds:.2f} s."
        )
        if self.worst:
            text += f" {self.worst.sentence()}"
        if self.set_aside:
            text += f" {len(self.set_aside)} pixels set aside as wrong."
        if self.reason:
            return f"{capitalise(self.reason)}. {text}"
        return text + (f" {self.status.advice}." if self.status.advice else "")

    def to_dict(self) -> dict[str, Any]:
        """For JSON: `robot` is the arm to use, whole, as `load_robot` reads it."""
        content = super().to_dict()
        for key, (rms_px, max_px) in self.pixels.items():
            content["accuracy"][key] |= plain({"rms_px": rms_px, "max_px": max_px})
        if self.with_them is not None:
            content["accuracy"]["holdout_with_them"] = self.with_them.to_dict()
        calibrated = self.calibrated or self.robot
        more: dict[str, Any] = plain(
            {
                "objective": self.objective,
                "qp": self.qp,
                "answered": self.worst.answered if self.worst else {},
                "minimax": self.worst.to_dict() if self.worst else None,
                "calibrated_robot": calibrated.to_dict(),
                "arm_position": {
                    "sigma_mm": 1e3 * self.claim.sigma,
                    "drawn_sigma_mm": 1e3 * self.claim.drawn,
                    "change_mm": 1e3 * self.claim.change,
                    "drawn_shown_mm": 1e3 * self.claim.shown,
                    "better": self.claim.is_better,
                },
                "set_aside": [point.to_dict() for point in self.set_aside],
                "reason": self.reason,
            }
        )
        return content | more

    @staticmethod
    def from_dict(content: Mapping[str, Any], source: str = "result") -> PixelCalibration:
        """From `to_dict`, without the errors of single pixels.  Raises CalibrationError."""
        part = checked(PixelPart, content, source)
        told = RelativeCalibration.from_dict(content, source)
        arm = part.arm_position
        claimed = (arm.sigma_mm, arm.drawn_sigma_mm, arm.change_mm, arm.drawn_shown_mm)
        return PixelCalibration(
            **{each.name: getattr(told, each.name) for each in fields(told)},
            calibrated=robot_from_dict(part.calibrated_robot, f"{source}: calibrated_robot"),
            pixels={key: (each.rms_px, each.max_px) for key, each in part.accuracy.items()},
            claim=Claim(*(1e-3 * value for value in claimed)),
            set_aside=tuple(SetAside(**each.model_dump()) for each in part.set_aside),
            reason=part.reason,
            objective=part.objective,
            qp=part.qp,
            worst=part.minimax.read(part.answered) if part.minimax else None,
        )
