"""The result of a calibration by cameras: the arm, and how well pixels know it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from minimax_cal.fitting.accuracy import NO_ENDS, Accuracy
from minimax_cal.fitting.fit import ACCURACIES
from minimax_cal.fitting.found import parameter_table
from minimax_cal.fitting.pixels.judge import Claim
from minimax_cal.fitting.pixels.worst import WorstPixels
from minimax_cal.fitting.several.result import RelativeCalibration
from minimax_cal.ground.facts import APART, Fact
from minimax_cal.ground.results import merged
from minimax_cal.ground.tables import Table
from minimax_cal.ground.words import capitalise
from minimax_cal.robots.robot import Robot, robot_from_dict
from minimax_cal.solvers.status import Status

PIXELS = "pixels"  # what was measured
NO_CLAIM = Claim(*[math.nan] * 4)


@dataclass(frozen=True, eq=False)
class PixelCalibration(RelativeCalibration):
    """A robot calibrated by cameras; `robot` is the drawn one where that is kept.

    calibrated: the robot that fits the pixels.  pixels: RMS and largest error by key [px].
    claim: of positions of the arm.  with_them: held-out accuracy with the pixels set aside.
    reason: why it failed or the drawn arm is kept; empty where neither.  worst: what a minimax
    rests on, None where there was none.
    """

    calibrated: Annotated[Robot | None, APART] = None
    worst: Annotated[WorstPixels | None, Fact(key="minimax")] = None
    pixels: Annotated[Mapping[str, tuple[float, float]], APART] = field(default_factory=dict)
    claim: Annotated[Claim, Fact(key="arm_position")] = NO_CLAIM
    with_them: Annotated[Accuracy | None, Fact(key="accuracy.holdout_with_them", brief=True)] = None

    @property
    def is_no_better(self) -> bool:
        """Whether the drawn arm is kept."""
        return self.status is Status.NO_BETTER

    def accuracy_table(self) -> Table:
        """Errors in the image, and at the target, before and after, training and held out."""
        return Table.made(
            f"{self.robot.name}: pixels, and the same at the target",
            [(title, a.poses, *self.pixels.get(key, NO_ENDS), a.rms_mm, a.max_mm)
             for title, key in ACCURACIES for a in [self.accuracy[key]]],
            "poses | count d | RMS px .3f | max px .3f | RMS mm .4f | max mm .4f",
        )  # fmt: skip

    def claim_table(self) -> Table:
        """Positions of the arm: what pixels and the drawing know."""
        rows = (
            ("calibrated arm, sigma", 1e3 * self.claim.sigma),
            ("drawn arm, sigma (drawn_within)", 1e3 * self.claim.drawn),
            ("drawn arm, as pixels show it", 1e3 * self.claim.shown),
            ("calibrated against drawn", 1e3 * self.claim.change),
        )
        title = "positions over the joints' whole range, base and tool fitted"
        return Table.made(title, rows, "arm | RMS mm .4f")

    def tables(self) -> tuple[Table, ...]:
        """Every table of the result."""
        worst = [self.worst.table()] if self.worst else []
        parameters = parameter_table(self.parameters)
        return (self.accuracy_table(), self.claim_table(), *worst, parameters)

    def first_tables(self) -> tuple[Table, ...]:
        """What stands on the first screen."""
        return (self.accuracy_table().brief(),)

    def headline(self) -> str:
        """The result in some sentences, with what it does not say."""
        before, after, where = self.before_and_after()
        key = "holdout" if self.accuracy["holdout"].poses else "train"
        drawn = {"holdout": "nominal", "train": "nominal_train"}[key]
        (px_before, _), (px_after, _) = (self.pixels.get(name, NO_ENDS) for name in (drawn, key))
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

    def beside(self, *, poses: bool = True) -> dict[str, Any]:
        """What pixels tell besides."""
        more = {
            "accuracy": {
                key: dict(zip(("rms_px", "max_px"), sizes, strict=True))
                for key, sizes in self.pixels.items()
            },
            "answered": self.worst.answered if self.worst else {},
            "calibrated_robot": self.calibrated or self.robot,
        }
        return merged(super().beside(), more)

    @classmethod
    def told_beside(
        cls, content: Mapping[str, Any], told: Mapping[str, Any], source: str
    ) -> dict[str, Any]:
        """As `RelativeCalibration`, and what pixels tell besides."""
        own = super().told_beside(content, told, source)
        stated = own["stated"]
        calibrated = robot_from_dict(content["calibrated_robot"], f"{source}: calibrated_robot")
        return own | {
            "calibrated": calibrated,
            "pixels": {key: (each.rms_px, each.max_px) for key, each in stated.items()},
        }
