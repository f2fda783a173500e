"""Pixels in one fit with other instruments: what they are to it, a fit of their own says first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from minimax_cal.fitting.pixels.determined import counting, fitted_on, metre_of, placed
from minimax_cal.fitting.pixels.fit import PixelFit
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.stages import silent
from minimax_cal.instruments.camera import read_camera
from minimax_cal.instruments.images import Images
from minimax_cal.instruments.instrument import UNREADY, checked
from minimax_cal.instruments.options import InstrumentOptions
from minimax_cal.instruments.pixels import PixelData, read_pixels
from minimax_cal.instruments.protocol import FlangePoses
from minimax_cal.robots.robot import Robot


@dataclass(frozen=True, eq=False)
class FittedImages(Images):
    """robot: as drawn.  fit: of training images, by themselves."""

    robot: Robot = UNREADY
    fit: PixelFit = UNREADY

    chosen = (*Images.chosen, "robot", "fit")

    def ready(self, robot: Robot, options: InstrumentOptions) -> FittedImages:
        """Fitted by itself, as it then weighs.  Raises DataError."""
        chosen = {name: getattr(options, name) for name in self.options}
        fit = fitted_on(robot, self.images, PixelOptions(holdout=0.0, **chosen), silent)
        return replace(
            FittedImages(**vars(fit.images)), robot=robot, fit=fit, metre=metre_of(fit),
            doubt=fit.lens_sigma, noise=fit.noise_px, lens_held=fit.held,
        )  # fmt: skip

    def starts(self, arm: FlangePoses, free: Array) -> Sequence[Array]:
        """Of the fit of the pixels to the arm as drawn."""
        return [self.fit.nominal.effects]

    def errors(self, arm: FlangePoses, own: Array, held: Array) -> Array:
        """At the targets, of all images; wrong pixels are left out."""
        return self.table(arm, own, counting(self.robot, self.images, held, self.fit)[0])

    def placed(self, arm: FlangePoses, own: Array, drawn: Array) -> dict[str, Any]:
        """Cameras, lenses, and the board or the targets."""
        return placed(self, own, self.fit)


def detected(
    detections: Path | str,
    joints: Path | str,
    camera: Mapping[str, Path | str],
    board: Path | str | None = None,
) -> FittedImages:
    """What cameras saw, for `relative`.  Files as `calibrate_pixels` takes them."""
    cameras = [read_camera(name, path) for name, path in camera.items()]
    return as_instrument(read_pixels(detections, joints, cameras, board))


def as_instrument(data: PixelData) -> FittedImages:
    """Pixels as one instrument of several."""
    at = replace(data.at, source=data.source, digest=data.digest, notices=data.notices)
    return checked(FittedImages(at, data))
