"""What cameras saw, beside other instruments; alone it is `pixel_calibration`.

Its own parameters are those of `PixelModel`: cameras, board or targets, lenses.  Pixels are rows in
metres at a typical target; what the files know of the lenses is rows too.  Which pixels are wrong
and how noisy they are, the pixels say by themselves, in a fit of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from minimax_cal.fitting.found import Parameter
from minimax_cal.fitting.instruments.data import RelativeData, checked
from minimax_cal.fitting.instruments.options import RelativeOptions
from minimax_cal.fitting.instruments.record import Instrument, Words
from minimax_cal.fitting.instruments.rows import Plain, own_state
from minimax_cal.fitting.pixels.camera import read_camera
from minimax_cal.fitting.pixels.data import PixelData, read_pixels
from minimax_cal.fitting.pixels.determined import fitted_on, judged_pixels, placed, table_of
from minimax_cal.fitting.pixels.fit import PixelFit
from minimax_cal.fitting.pixels.identify import reference_of
from minimax_cal.fitting.pixels.model import LENS, PixelModel, Scene, units_of
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import groups
from minimax_cal.modelling.model import Model, arm_at
from minimax_cal.modelling.parameters import State
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import right_jacobian
from minimax_cal.robots.robot import Robot


@dataclass(frozen=True, eq=False)
class Images(RelativeData):
    """Pixels, at these poses."""

    pixels: PixelData

    kind = "pixels"
    by_row = ()

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


@dataclass(frozen=True, eq=False)
class Pixels(Plain):
    """Pixels of training images.

    data: of them.  fit: their own.  seen: their model.  metre: what a pixel is at a typical target.
    bearings: whether rows are directions to targets, which need no camera that sees them.
    """

    data: PixelData
    robot: Robot
    fit: PixelFit
    seen: PixelModel
    metre: float
    bearings: bool = False

    kind = "pixels"
    whole = "cameras and targets moved together"
    spots = slice(0, 0)

    @staticmethod
    def of(robot: Robot, data: PixelData, options: PixelOptions) -> Pixels:
        """Pixels of a robot.  Raises DataError."""
        fit = fitted_on(robot, data, options, lambda stage: None)
        depth = fit.model.seen(fit.nominal).point[2]
        metre = float(np.median(depth / fit.model.intrinsic[fit.model.camera, 0]))
        return Pixels(data, robot, fit, fit.model, metre)

    @staticmethod
    def beside_others(robot: Robot, data: Images, options: RelativeOptions) -> Pixels:
        """Pixels among other instruments.  Raises DataError."""
        chosen = PixelOptions(
            camera_on=options.camera_on,
            fix_camera=options.fix_camera,
            camera_prior=options.camera_prior,
            holdout=0.0,
        )
        return Pixels.of(robot, data.images, chosen)

    @property
    def model(self) -> Model:
        """The arm alone."""
        return arm_at(self.robot, self.data.at.q)

    @property
    def own(self) -> tuple[str, ...]:
        """Cameras, board or targets, lenses."""
        return self.seen.names.effects

    @property
    def parts(self) -> tuple[str, ...]:
        """The targets, in each camera."""
        return self.data.parts

    @property
    def points(self) -> int:
        """Number of pixels that count."""
        return int((self.seen.weight > 0.0).sum())

    @property
    def numbers(self) -> int:
        """Two a pixel, and as many as the files know of the lenses."""
        return 2 * self.points + self.lens_rows

    @property
    def lens_rows(self) -> int:
        """What the files know of the lenses, unless these are held."""
        return 0 if self.fit.held else int(self.fit.lens_sigma.size)

    @property
    def weights(self) -> Array:
        """(rows,) one each."""
        return np.ones((3 if self.bearings else 2) * len(self.seen.pose) + self.lens_rows)

    @property
    def has_length(self) -> bool:
        """A board has lengths."""
        return bool(len(self.seen.board))

    def scene_of(self, mdh: Array, own: Array) -> Scene:
        """The scene of a state.  mdh: (n, 5).  own: (e,)."""
        drawn, c = self.fit.nominal, len(self.seen.intrinsic)
        cameras, spots, lens = self.seen.split(own)
        cameras = cameras.reshape(c, 6)
        moved = replace(
            drawn,
            mdh=mdh[None],
            place=cameras[None, :, :3],
            turn=drawn.turn @ kinematics.rotation(cameras[:, 3:]),
            lens=lens.reshape(1, c, LENS),
        )
        if not len(self.seen.board):
            return replace(moved, points=spots.reshape(1, -1, 3))
        turn = drawn.board_turn @ kinematics.rotation(spots[3:])
        return replace(moved, board_place=spots[None, :3], board_turn=turn)

    def turns_of(self, own: Array) -> list[tuple[slice, Array]]:
        """Where the turns stand among the own parameters, and what a change of each turns by."""
        count = len(self.seen.intrinsic) + bool(len(self.seen.board))
        places = [slice(6 * i + 3, 6 * i + 6) for i in range(count)]
        return [(each, right_jacobian(own[each])) for each in places]

    def start(self, robot: Robot, free: Array) -> Array:
        """Of the fit of the pixels to the arm as drawn."""
        own = self.fit.nominal.values()
        for place, _ in self.turns_of(own):
            own[place] = 0.0  # from there
        return own

    def rows(self, x: State, active: Array) -> tuple[Array, Array]:
        """u and v of each pixel, then the lenses."""
        *batch, n, k = x.mdh.shape
        pairs = zip(x.mdh.reshape(-1, n, k), x.effects.reshape(-1, len(self.own)), strict=True)
        found = [self.rows_of(mdh, own, active) for mdh, own in pairs]
        error, jacobian = (np.stack(part) for part in zip(*found, strict=True))
        return error.reshape(*batch, -1), jacobian.reshape(*batch, *jacobian.shape[1:])

    def rows_of(self, mdh: Array, own: Array, active: Array) -> tuple[Array, Array]:
        """`rows` of one state."""
        scene, first = self.scene_of(mdh, own), self.seen.names.geometric
        turns, wanted = self.turns_of(own), active.copy()
        if self.fit.held:
            wanted[-self.fit.lens_sigma.size :] = False
        for place, _ in turns:
            wanted[first:][place] = True
        if self.bearings:
            slope = self.seen.bearings(scene, wanted)
            error = np.zeros(slope.shape[1:])
        else:
            error, slope = self.seen.rows(scene, wanted)
            root = self.metre * np.sqrt(self.seen.weight)
            error, slope = error * root, slope * root
        whole = np.zeros((len(active), *error.shape))
        whole[wanted] = slope
        for place, by in turns:
            whole[first:][place] = np.einsum("ij,irn->jrn", by, whole[first:][place])
        beside, known = self.lens_known(own)
        flat = np.concatenate([whole.reshape(len(active), -1), known], axis=1)
        return np.concatenate([error.reshape(-1), beside]), flat[active]

    def lens_known(self, own: Array) -> tuple[Array, Array]:
        """What the lenses differ from their files, by their doubts, as heavy as pixels: (l,).

        And its derivative, (p, l).
        """
        count = self.lens_rows
        rows = np.zeros((self.seen.names.count, count))
        if not count:
            return np.zeros(0), rows
        size = 1.0 if self.bearings else self.metre * self.fit.noise
        by = size / self.fit.lens_sigma.reshape(-1)
        rows[-count:] = np.diag(by)
        return (self.seen.intrinsic[:, :LENS].reshape(-1) - own[-count:]) * by, rows

    def reference(self, robot: Robot, x: State) -> Self:
        """Directions to the targets at plenty of poses."""
        return replace(self, seen=reference_of(robot, self.seen), bearings=True)

    def closed(self, robot: Robot, x: State) -> Self:
        """The pixels that the arm at a state would show."""
        pixel = self.seen.predicted(self.scene_of(x.mdh, x.effects)).T
        return replace(self, seen=replace(self.seen, pixel=pixel))

    def arm_state(self, x: State) -> State:
        """The links, and a point at the flange."""
        return replace(own_state(x.mdh, x.effects[..., :0]), target_positions=np.zeros((1, 3)))

    def mean_square(self, x: State) -> float:
        """Of the errors at the targets [m^2]."""
        scene = self.scene_of(x.mdh, x.effects)
        depth, focal = self.seen.seen(scene).point[2], self.seen.intrinsic[self.seen.camera, 0]
        error = self.seen.errors(scene) * depth / focal
        return float((error[:, self.seen.weight > 0.0] ** 2).sum(axis=0).mean())

    @property
    def pose_of_row(self) -> Array:
        """u of all pixels, v of all; lenses with the first pose."""
        return np.concatenate([np.tile(self.seen.pose, 2), np.zeros(self.lens_rows, dtype=int)])

    def model_at(self, robot: Robot, data: Images) -> Model:
        """The arm alone."""
        return arm_at(robot, data.at.q)

    def errors(self, model: Model, x: State, data: Images, held: Array) -> Array:
        """At the targets, of all images; wrong pixels are left out."""
        robot, pixels = self.robot, data.images
        every = PixelModel.of(robot, pixels, self.seen.on_flange)
        known = np.isin(np.arange(len(pixels.targets)), self.seen.target) | self.has_length
        out = table_of(every, pixels, self.scene_of(x.mdh, x.effects), known[pixels.target])[0]
        wrong = judged_pixels(robot, pixels, held, self.fit).aside
        out[pixels.part[wrong], pixels.pose[wrong]] = np.nan
        return out

    def listed(
        self, fitted: tuple[Parameter, ...], nominal: State, x: State, covariance: Array
    ) -> tuple[Parameter, ...]:
        """As they are, lenses in their units."""
        units = units_of(self.seen.names)[self.seen.names.geometric :]
        return tuple(replace(p, unit=unit) for p, unit in zip(fitted, units, strict=True))

    def placed(self, x: State, nominal: State) -> dict[str, Any]:
        """Cameras, lenses, and the board or the targets."""
        scene = self.scene_of(x.mdh, x.effects)
        return placed(self.data, replace(self.fit, scene=scene), None)


INSTRUMENT = Instrument(
    name=Images.kind,
    words=Words(
        quantity="pixel at the target",
        caution="A pixel is no position: what moves along the line of sight does not show in it. ",
    ),
    block=Pixels.beside_others,
    options=("camera_on", "fix_camera", "camera_prior"),
    alone="it holds pixels alone: give it to calibrate as pixels=, or add files of other "
    "instruments",
    on_arm=False,
    noise_given=False,
)
