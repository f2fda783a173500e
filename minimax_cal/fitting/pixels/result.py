"""The result of a calibration by cameras: the arm, and how well pixels know it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any

from minimax_cal.fitting.accuracy import NO_ENDS, Accuracy
from minimax_cal.fitting.fit import ACCURACIES
from minimax_cal.fitting.found import parameter_table
from minimax_cal.fitting.several.result import RelativeCalibration
from minimax_cal.fitting.several.worst import WorstPixels
from minimax_cal.ground.facts import APART, Fact, Mm, derived
from minimax_cal.ground.results import merged
from minimax_cal.ground.tables import Table
from minimax_cal.ground.words import capitalise
from minimax_cal.robots.robot import Robot, robot_from_dict
from minimax_cal.solvers.status import Status

MARGIN = 2.0 / 3.0  # of the drawing's sigma: an arm less sure may be worse than drawn
SAME = 1e-9  # arms so far apart are one and the same [m]


@dataclass(frozen=True)
class Claim:
    """What is known of positions of the arm, RMS over the joints' range, base and tool fitted [m].

    sigma: of the calibrated arm.  drawn: of the drawing, by `drawn_within`.  change: between the
    two.  shown: of the drawing, by how far the pixels show it to be off; 0 where they do not.
    """

    sigma: Mm
    drawn: Annotated[float, Fact(key="drawn_sigma_mm", scale=1e3)]
    change: Mm
    shown: Annotated[float, Fact(key="drawn_shown_mm", scale=1e3)]

    @derived(key="better")
    def is_better(self) -> bool:
        """Whether the calibrated arm is known clearly better than the drawn one."""
        return self.sigma < MARGIN * self.shown

    def texts(self) -> dict[str, str]:
        """Each number for people."""
        return {f.name: f"{1e3 * getattr(self, f.name):#.3g} mm" for f in fields(self)}

    def why_kept(self) -> str:
        """Why the drawn arm is kept."""
        mm = self.texts()
        why = (
            f"the calibrated arm, known to {mm['sigma']}, differs from the drawn one by "
            f"{mm['change']}, which shows the drawing to be off by {mm['shown']}: too little to be "
            "sure"
        )
        if self.sigma >= self.drawn:
            why = (
                f"the drawing is known better ({mm['drawn']}) than these pixels tell the arm "
                f"({mm['sigma']})"
            )
        return (
            f"{why}: the drawn arm is kept; take more images, nearer and more tilted, or say how "
            "well the drawing is known (drawn_within)"
        )

    def sentence(self) -> str:
        """For people."""
        mm = self.texts()
        if self.change < SAME:
            return (
                "The arm stays as drawn: cameras and targets go with it, whose positions the "
                f"drawing knows to {mm['drawn']} RMS (drawn_within)."
            )
        said = (
            f"These pixels determine a position of the arm to {mm['sigma']} RMS (sigma over the "
            "joints' whole range, lack of fit and the lenses' doubt included); the drawing knows "
            f"it to {mm['drawn']} (drawn_within), and the calibrated arm differs from it by "
            f"{mm['change']}"
        )
        if self.is_better:
            return f"{said}: the calibrated arm is better."
        if self.sigma >= self.drawn:
            return f"{said}: keep the drawn arm; take more images, nearer, with more tilt."
        return (
            f"{said}. By that the drawing is off by {mm['shown']}, too little to be sure: keep the "
            "drawn arm."
        )


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
        keys = (
            ("nominal", "holdout") if self.accuracy["holdout"].poses else ("nominal_train", "train")
        )
        (px_before, _), (px_after, _) = (self.pixels.get(key, NO_ENDS) for key in keys)
        text = (
            f"Pixels: RMS error {px_before:.3f} px -> {px_after:.3f} px ({before.rms_mm:.3f} mm -> "
            f"{after.rms_mm:.3f} mm at the target), at {where}. That says nothing of the arm's "
            f"positions by itself. {self.claim.sentence()} {self.outcome}"
        )
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
        calibrated = robot_from_dict(content["calibrated_robot"], f"{source}: calibrated_robot")
        pixels = {key: (each.rms_px, each.max_px) for key, each in own["stated"].items()}
        return own | {"calibrated": calibrated, "pixels": pixels}
