"""What cameras saw, beside other instruments; alone it is `pixel_calibration`.

Its own parameters are those of `PixelModel`: cameras, board or targets, lenses.  Pixels are rows in
metres at a typical target; what the files know of the lenses is rows too.  Which pixels are wrong
and how noisy they are, the pixels say by themselves, in a fit of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.fitting.pixels.camera import read_camera, slopes
from minimax_cal.fitting.pixels.data import PixelData, read_pixels
from minimax_cal.fitting.pixels.determined import (
    fitted_on,
    judged_pixels,
    metre_of,
    placed,
    table_of,
)
from minimax_cal.fitting.pixels.fit import PixelFit, reference_of
from minimax_cal.fitting.pixels.model import LENS, PixelModel, Scene, imaged, turned, units_of
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.ground.arrays import Array
from minimax_cal.instruments.instrument import UNREADY, Instrument, Words, bare, checked
from minimax_cal.instruments.options import InstrumentOptions
from minimax_cal.instruments.protocol import FlangePoses, ResidualRows
from minimax_cal.measuring.grouping import groups
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import right_jacobian
from minimax_cal.robots.robot import Robot


@dataclass(frozen=True, eq=False)
class Images(Instrument):
    """Pixels, at these poses.

    robot: as drawn.  fit: of training images, by themselves.  model: theirs.  metre: what a pixel
    is at a typical target.  bearings: whether rows are directions to targets, which need no camera
    that sees them.
    """

    pixels: PixelData
    robot: Robot = UNREADY
    fit: PixelFit = UNREADY
    model: PixelModel = UNREADY
    metre: float = 1.0
    bearings: bool = False

    kind = "pixels"
    words = Words(
        quantity="pixel at the target",
        caution="A pixel is no position: what moves along the line of sight does not show in it. ",
        whole="cameras and targets moved together",
    )
    chosen = ("robot", "fit", "model", "metre")
    options = ("camera_on", "fix_camera", "camera_prior")
    targets_at = slice(0, 0)
    refines = False
    alone = (
        "it holds pixels alone: give it to calibrate as pixels=, or add files of other instruments"
    )
    on_arm = False
    noise_given = False

    @property
    def images(self) -> PixelData:
        """The pixels at these poses."""
        return replace(self.pixels, at=self.at)

    @property
    def numbers(self) -> Array:
        """(m,) two a pixel."""
        return 2 * np.bincount(self.pixels.pose, minlength=self.poses)

    @property
    def independent(self) -> int:
        """Six for each different pose: many targets in an image are one pose of a camera."""
        return 6 * len(np.unique(groups(self.at)[self.pixels.pose]))

    def take(self, rows: Array) -> Images:
        """The images at some poses only.  rows: indices or a mask."""
        return replace(self, at=self.at.take(rows), pixels=self.pixels.take(rows))

    # ---- in a fit ----------------------------------------------------------------------------

    def ready(self, robot: Robot, options: InstrumentOptions) -> Images:
        """Fitted by itself.  Raises DataError."""
        chosen = PixelOptions(
            holdout=0.0, **{name: getattr(options, name) for name in self.options}
        )
        fit = fitted_on(robot, self.images, chosen, lambda stage: None)
        return replace(self, robot=robot, fit=fit, model=fit.model, metre=metre_of(fit))

    @property
    def names(self) -> tuple[str, ...]:
        """Cameras, board or targets, lenses."""
        return self.model.names.effects

    @property
    def units(self) -> tuple[str, ...]:
        """SI; pixels where a lens has them."""
        return units_of(self.model.names)[self.model.names.geometric :]

    @property
    def parts(self) -> tuple[str, ...]:
        """The targets, in each camera."""
        return self.pixels.parts

    @property
    def points(self) -> int:
        """Number of pixels that count."""
        return int((self.model.weight > 0.0).sum())

    @property
    def degrees(self) -> int:
        """Two a pixel, and as many as the files know of the lenses."""
        return 2 * self.points + self.lens_rows

    @property
    def lens_rows(self) -> int:
        """What the files know of the lenses, unless these are held."""
        return 0 if self.fit.held else int(self.fit.lens_sigma.size)

    @property
    def has_length(self) -> bool:
        """A board has lengths."""
        return bool(len(self.model.board))

    def scene_of(self, own: Array) -> Scene:
        """Cameras and targets; its links are those of the drawing."""
        drawn, c = self.fit.nominal, len(self.model.intrinsic)
        cameras, spots, lens = self.model.split(own)
        cameras = cameras.reshape(c, 6)
        moved = replace(
            drawn,
            place=cameras[None, :, :3],
            turn=drawn.turn @ kinematics.rotation(cameras[:, 3:]),
            lens=lens.reshape(1, c, LENS),
        )
        if not len(self.model.board):
            return replace(moved, points=spots.reshape(1, -1, 3))
        turn = drawn.board_turn @ kinematics.rotation(spots[3:])
        return replace(moved, board_place=spots[None, :3], board_turn=turn)

    def turns_of(self, own: Array) -> list[tuple[slice, Array]]:
        """Where the turns stand among the own parameters, and what a change of each turns by."""
        count = len(self.model.intrinsic) + bool(len(self.model.board))
        places = [slice(6 * i + 3, 6 * i + 6) for i in range(count)]
        return [(each, right_jacobian(own[each])) for each in places]

    def starts(self, arm: FlangePoses, free: Array) -> Sequence[Array]:
        """Of the fit of the pixels to the arm as drawn."""
        own = self.fit.nominal.values()
        for place, _ in self.turns_of(own):
            own[place] = 0.0  # from there
        return [own]

    def read(self, arm: FlangePoses, own: Array) -> ResidualRows:
        """u and v of each pixel, then the lenses."""
        scene, model = self.scene_of(own), on(self.model, arm)
        seen, mine = model.seen(scene), np.arange(model.names.count) >= model.names.geometric
        if self.fit.held:
            mine[-self.fit.lens_sigma.size :] = False
        by_place = np.moveaxis(model.by_place(seen), 1, 0)
        if self.bearings:
            by_point, slope = turned(seen, by_place), model.bearings(scene, mine)
            error, root = np.zeros(slope.shape[1:]), np.ones(len(model.pose))
        else:
            error, slope = model.rows(scene, mine)
            by = slopes(model.lenses(scene), *(seen.point[:2] / seen.point[2]))[1]
            by_point, root = imaged(seen, by, by_place), self.metre * np.sqrt(model.weight)
        count = len(error)
        by_own = np.zeros((len(own), *error.shape))
        by_own[: len(slope)] = slope * root
        for place, by in self.turns_of(own):
            by_own[place] = np.einsum("ij,irn->jrn", by, by_own[place])
        short, known = self.lens_known(own)
        none = np.zeros((len(short), 3))
        along = (by_point * root).reshape(3, -1).T
        return ResidualRows(
            residual=np.concatenate([(error * root).reshape(-1), short]),
            pose=np.concatenate([np.tile(model.pose, count), np.zeros(len(short), dtype=int)]),
            point=np.concatenate([np.tile(seen.base.T, (count, 1)), none]),
            by_point=np.concatenate([along, none]),
            by_rotation=np.zeros((len(along) + len(none), 3)),
            by_own=np.concatenate([by_own.reshape(len(own), -1).T, known]),
        )

    def lens_known(self, own: Array) -> tuple[Array, Array]:
        """What the lenses differ from their files, by their doubts, as heavy as pixels: (l,).

        And its derivative, (l, e).
        """
        count = self.lens_rows
        rows = np.zeros((count, len(own)))
        if not count:
            return np.zeros(0), rows
        size = 1.0 if self.bearings else self.metre * self.fit.noise
        by = size / self.fit.lens_sigma.reshape(-1)
        rows[:, -count:] = np.diag(by)
        return (self.model.intrinsic[:, :LENS].reshape(-1) - own[-count:]) * by, rows

    def elsewhere(self, robot: Robot, own: Array) -> Images:
        """Directions to the targets at plenty of poses."""
        model = reference_of(robot, self.model)
        return replace(self, at=bare(robot.commanded(model.q), {}), model=model, bearings=True)

    def fitting(self, robot: Robot, own: Array) -> Images:
        """The pixels that the arm as drawn would show."""
        pixel = self.model.predicted(self.scene_of(own)).T
        return replace(self, model=replace(self.model, pixel=pixel))

    def mean_square(self, arm: FlangePoses, own: Array) -> float:
        """Of the errors at the targets [m^2]."""
        scene, model = self.scene_of(own), on(self.model, arm)
        depth, focal = model.seen(scene).point[2], model.intrinsic[model.camera, 0]
        error = model.errors(scene) * depth / focal
        return float((error[:, model.weight > 0.0] ** 2).sum(axis=0).mean())

    def errors(self, arm: FlangePoses, own: Array, held: Array) -> Array:
        """At the targets, of all images; wrong pixels are left out."""
        robot, pixels = self.robot, self.images
        every = on(PixelModel.of(robot, pixels, self.model.on_flange), arm)
        known = np.isin(np.arange(len(pixels.targets)), self.model.target) | self.has_length
        out = table_of(every, pixels, self.scene_of(own), known[pixels.target])[0]
        wrong = judged_pixels(robot, pixels, held, self.fit).aside
        out[pixels.part[wrong], pixels.pose[wrong]] = np.nan
        return out

    def placed(self, arm: FlangePoses, own: Array, drawn: Array) -> dict[str, Any]:
        """Cameras, lenses, and the board or the targets."""
        return placed(self.pixels, replace(self.fit, scene=self.scene_of(own)), None)


def on(model: PixelModel, arm: FlangePoses) -> PixelModel:
    """The same with the flange where it is."""
    axes = np.ascontiguousarray(np.moveaxis(arm.rotation, (0, 1, 2), (2, 1, 0)))
    return replace(model, flange=(axes, arm.origin.T))


def detected(
    detections: Path | str,
    joints: Path | str,
    camera: Mapping[str, Path | str],
    board: Path | str | None = None,
) -> Images:
    """What cameras saw, for `relative`.  Files as `calibrate_pixels` takes them."""
    cameras = [read_camera(name, path) for name, path in camera.items()]
    return as_instrument(read_pixels(detections, joints, cameras, board))


def as_instrument(data: PixelData) -> Images:
    """Pixels as one instrument of several."""
    at = replace(data.at, source=data.source, digest=data.digest, notices=data.notices)
    return checked(Images(at, data))
