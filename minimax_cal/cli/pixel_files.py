"""The files of cameras as options, which `calibrate` and `relative` share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from minimax_cal.cli.options import PATH, options_from, plain_option, stacked
from minimax_cal.fitting.pixels.options import CAMERAS, PixelOptions, cameras_of
from minimax_cal.ground.errors import OptionError

PIXEL_FILES = stacked(
    plain_option(
        CAMERAS,
        "--pixels",
        type=PATH,
        metavar="FILE",
        help="What cameras saw (CSV): pose, camera, target, u_px, v_px.",
    ),
    plain_option(
        CAMERAS,
        "--joints",
        type=PATH,
        metavar="FILE",
        help="The joint values of each pose of the detections (CSV): pose, q1_rad, ...",
    ),
    plain_option(
        CAMERAS,
        "--camera",
        multiple=True,
        metavar="NAME=FILE",
        help="The K and D of a camera, as OpenCV or ROS write them (YAML); may be given several "
        "times.",
    ),
    plain_option(
        CAMERAS,
        "--board",
        type=PATH,
        metavar="FILE",
        help="The places of the targets on a board (CSV): target, x_mm, y_mm, z_mm [default: tags "
        "of unknown place].",
    ),
    options_from(PixelOptions, "camera_on", "fix_camera", "camera_prior"),
)


@dataclass(frozen=True, eq=False)
class PixelFiles:
    """What was given of cameras."""

    pixels: Path | None
    joints: Path | None
    camera: tuple[str, ...]
    board: Path | None

    @property
    def given(self) -> bool:
        """Whether anything was."""
        return bool(self.pixels or self.joints or self.camera or self.board)

    def paths(self) -> tuple[Path, Path, dict[str, str], Path | None]:
        """Detections, joints, cameras by name, board.  Raises OptionError."""
        if not (self.pixels and self.joints and self.camera):
            raise OptionError("cameras need all three of pixels=, joints= and camera='NAME=FILE'")
        return self.pixels, self.joints, cameras_of(self.camera), self.board
