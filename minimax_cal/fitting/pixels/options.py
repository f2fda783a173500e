"""What can be chosen of a calibration by cameras."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.fitting.multi_instrument.options import (
    CAMERA_OPTION_GROUP,
    SUM,
    WORST_TARGET,
    RelativeOptions,
)
from minimax_cal.fitting.options import check_resolution
from minimax_cal.instruments.camera_images import CameraImages
from minimax_cal.instruments.camera_model import (
    CAMERA_ON_FLANGE,
    CAMERA_ON_GROUND,
    FITTED_INTRINSICS,
)
from minimax_cal.reading.measurement_table import MeasurementTable

WORST_CAMERA = "camera"
PIXEL_OBJECTIVES = (SUM, WORST_TARGET, WORST_CAMERA)
# How well a camera's file knows its lens: a share of the focal length, pixels of the centre, and
# the first radial and both tangential coefficients; higher radial ones are known worse.
DEFAULT_LENS_SIGMAS = {"f": 1e-3, "c": 2.0, "k": 5e-3, "p": 5e-4}
LENS_SIGMA_SCALES = {  # of each intrinsic: which doubt it has, and how many times
    "fx": ("f", 1.0), "fy": ("f", 1.0), "cx": ("c", 1.0), "cy": ("c", 1.0), "k1": ("k", 1.0),
    "k2": ("k", 5.0), "k3": ("k", 10.0), "p1": ("p", 1.0), "p2": ("p", 1.0),
}  # fmt: skip
LENS_SIGMA_UNITS = {"f": ("%", 0.01), "c": ("px", 1.0), "k": ("", 1.0), "p": ("", 1.0)}
PIXEL_COLUMNS = {"u_px", "v_px"}  # columns of what cameras saw
LENS_SIGMA_PATTERN = re.compile(r"\s*([fckp])\s+([\d.]+(?:[eE][-+]?\d+)?)\s*(%|px)?\s*")


def parse_lens_sigmas(text: str) -> Mapping[str, float]:
    """How well a lens is known, from a text as ``f 0.1%, c 2px``.  Raises OptionError."""
    found = dict(DEFAULT_LENS_SIGMAS)
    for part in filter(str.strip, text.split(",")):
        match = LENS_SIGMA_PATTERN.fullmatch(part)
        if (
            not match
            or (match[3] or "") != LENS_SIGMA_UNITS[match[1]][0]
            or not float(match[2]) > 0.0
        ):
            raise OptionError(
                f"camera_prior={text!r}: write f in %, c in px, k and p as they are, all more than "
                "0, as 'f 0.1%, c 2px'"
            )
        found[match[1]] = float(match[2]) * LENS_SIGMA_UNITS[match[1]][1]
    return found


def parse_camera_files(texts: Sequence[str]) -> dict[str, str]:
    """Files by the cameras' names, of NAME=FILE each.  Raises OptionError."""
    named = {}
    for text in texts:
        name, _, path = (part.strip() for part in text.partition("="))
        if not (name and path):
            raise OptionError(f"camera={text!r}: give a name and a file, as cam0=camera.yaml")
        named[name] = path
    if len(named) < len(texts):
        raise OptionError("camera= gives one name twice; each camera has its own")
    return named


@dataclass(frozen=True, eq=False)
class PixelFiles:
    """What is given of cameras."""

    pixels: Path | None = CAMERA_OPTION_GROUP(  # noqa: RUF009
        None, "What cameras saw (CSV): pose, camera, target, u_px, v_px.", metavar="FILE", read=Path
    )
    joints: Path | None = CAMERA_OPTION_GROUP(  # noqa: RUF009
        None,
        "The joint values of each pose of the detections (CSV): pose, q1_rad, ...",
        metavar="FILE",
        read=Path,
    )
    camera: Sequence[str] = CAMERA_OPTION_GROUP(
        (),
        "The K and D of a camera, as OpenCV or ROS write them (YAML); may be given several times.",
        metavar="NAME=FILE",
        read=str,
        many=tuple,
    )
    board: Path | None = CAMERA_OPTION_GROUP(  # noqa: RUF009
        None,
        "The places of the targets on a board (CSV): target, x_mm, y_mm, z_mm [default: tags of "
        "unknown place].",
        metavar="FILE",
        read=Path,
    )

    @property
    def is_given(self) -> bool:
        """Whether anything is."""
        return any(vars(self).values())

    def find_in_data(
        self, data: Sequence[MeasurementTable]
    ) -> tuple[PixelFiles, list[MeasurementTable]]:
        """The same with what cameras saw where it is a file of the data, and the other files."""
        seen = [] if self.pixels else [one for one in data if {*one.given} >= PIXEL_COLUMNS]
        rest = [one for one in data if one not in seen]
        return (replace(self, pixels=Path(seen[0].path)) if seen else self), [*seen[1:], *rest]

    def paths(self) -> tuple[Path, Path, dict[str, str], Path | None]:
        """Detections, joints, cameras by name, board.  Raises OptionError."""
        if not (self.pixels and self.joints and self.camera):
            raise OptionError("cameras need all three of pixels=, joints= and camera='NAME=FILE'")
        return self.pixels, self.joints, parse_camera_files(self.camera), self.board


CAMERA_OPTION_NAMES = (*CameraImages.options, "drawn_prior")
PIXEL_OPTION_NAMES = (  # that are of pixels
    "objective", "qp", *CAMERA_OPTION_NAMES, "holdout", "seed", "fix", "free", "resolution",
    "allow_large_changes",
)  # fmt: skip


@dataclass(frozen=True)
class PixelOptions(RelativeOptions):
    """How to calibrate, by `PIXEL_OPTION_NAMES`.

    objective: sum, minimax (the worst target) or camera (the worst camera).
    qp: backend of the minimax QPs.  camera_on: flange or ground; what fits better unless given.
    fix_camera: hold the lenses as their files say, as known unless `camera_prior` is given.
    camera_prior: how well these know them, as ``f 0.1%, c 2px``.
    drawn_prior: take the drawing as a prior, as well as the robot's `drawn_within` says or better.
    holdout: share of the poses kept out of the fit.  seed: of that choice.
    fix, free: names or patterns as ``beta*``.
    resolution: relative singular value that counts as not measured.
    allow_large_changes: accept an arm that is another than the one drawn.
    """

    drawn_prior: bool = CAMERA_OPTION_GROUP(
        False, "Take the drawing as a prior, as well as the robot's drawn_within says or better."
    )

    def settings(self) -> dict[str, object]:
        """For the record."""
        every = super().settings()
        return {name: every[name] for name in PIXEL_OPTION_NAMES}

    def lens_sigma(self, intrinsic: Array) -> Array:
        """(c, 9) standard deviations of the lenses.  intrinsic: (c, 16)."""
        doubts = parse_lens_sigmas(self.camera_prior)
        scales = [LENS_SIGMA_SCALES[name] for name in FITTED_INTRINSICS]
        sigma = np.array([times * doubts[kind] for kind, times in scales])
        every = np.tile(sigma, (len(intrinsic), 1))
        every[:, :2] *= intrinsic[:, :2]
        return every


def check_pixel_options(options: PixelOptions) -> None:
    """Raise OptionError for a choice that does not exist."""
    if options.objective not in PIXEL_OBJECTIVES:
        raise OptionError(
            f"objective={options.objective!r} is not for pixels: "
            f"give {', '.join(PIXEL_OBJECTIVES[:2])} "
            f"or {PIXEL_OBJECTIVES[2]}"
        )
    if options.objective != SUM and options.drawn_prior:
        raise OptionError(f"drawn_prior= is for objective='{SUM}': leave one of them out")
    if options.camera_on not in ("", CAMERA_ON_FLANGE, CAMERA_ON_GROUND):
        raise OptionError(
            f"camera_on={options.camera_on!r}: give {CAMERA_ON_FLANGE} or {CAMERA_ON_GROUND}"
        )
    check_resolution(options.resolution)
    parse_lens_sigmas(options.camera_prior)
