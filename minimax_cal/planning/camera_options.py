"""Where cameras and board are, and what an image must show: the options of `plan_cameras`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.options import SI, grouped, numbers
from minimax_cal.instruments.camera import FLANGE, GROUND
from minimax_cal.robots.transforms import from_rpy

SIDES = {"-z": -1.0, "z": 1.0}  # of a board's frame: where its print looks
GROUP = "Cameras in place of a tracker"
PIXEL_NOISE = 0.1  # of u and v [px]
FOR_CAMERAS = (  # options of a plan that are about cameras too
    "criterion", "joints", "volume", "floor", "body", "jitter", "revisit", "approach", "candidates",
    "seed",
)  # fmt: skip


def frame(text: str, name: str) -> Array:
    """X,Y,Z,A,B,C in millimetres and degrees as a pose (4, 4) [m].  Raises OptionError."""
    how = "X,Y,Z in mm and A,B,C in deg (about z, y, x), as 500,0,0,0,0,180"
    parts = np.array(numbers(text, name, how, 6))
    return from_rpy(1e-3 * parts[:3], SI["deg"] * parts[:2:-1])


sight = grouped(GROUP)


@dataclass(frozen=True)
class CameraOptions:
    """Where cameras and board are, and what an image must show.

    camera_on: flange or ground.  camera_at: (4, 4) about where each camera is in the flange or base
    [m].  board_at: (4, 4) about where the board is in the base or flange [m].
    print_looks: z or -z of the board's frame: the side of its print.
    distance: from how near to how far a camera is sharp [m].
    incidence: largest angle to the board's normal [rad].
    share: of the corners that an image must show.  pixel_noise: of u and v [px].
    camera_prior: how well the files know the lenses, as ``f 0.1%, c 2px``.
    """

    camera_on: str = sight(FLANGE, f"What the cameras are fixed to: {FLANGE} or {GROUND}.")
    camera_at: Sequence[Array] = sight(
        (),
        "About where a camera is in the flange's (or base's) frame, mm and deg; once for each, in "
        "their order.",
        metavar="X,Y,Z,A,B,C",
        read=partial(frame, name="camera_at"),
        many=tuple,
    )
    board_at: Array | None = sight(  # noqa: RUF009
        None,
        "About where the board is in the base's (or flange's) frame, mm and deg.",
        metavar="X,Y,Z,A,B,C",
        read=partial(frame, name="board_at"),
    )
    print_looks: str = sight(
        "-z",
        "Where the board's print looks in the frame of its file: -z, as OpenCV counts corners (y "
        "down), or z.",
        metavar="-z|z",
    )
    distance: tuple[float, float] = sight(
        (0.3, 1.0), "From how near to how far a camera is sharp, m.", "m"
    )
    incidence: float = sight(
        np.radians(60.0), "The largest angle between a line of sight and the board's normal.", "deg"
    )
    share: float = sight(0.8, "The share of the corners that an image must show.", metavar="SHARE")
    pixel_noise: float = sight(PIXEL_NOISE, "The noise of u and v, px.")
    camera_prior: str = sight(
        "",
        "How well the files know the lenses, as `calibrate` takes it.",
        metavar='"f 0.1%, c 2px"',
    )


def check_cameras(sees: CameraOptions, count: int) -> None:
    """Raise OptionError for options that make no sense.  count: of the cameras."""
    if sees.camera_on not in (FLANGE, GROUND):
        raise OptionError(f"camera_on={sees.camera_on!r}: give {FLANGE} or {GROUND}")
    if sees.print_looks not in SIDES:
        raise OptionError(f"print_looks={sees.print_looks!r}: give {' or '.join(SIDES)}")
    if len(sees.camera_at) != count or sees.board_at is None:
        many = "camera" if count == 1 else "cameras"
        raise OptionError(
            f"{count} {many}: give camera_at= for each, in their order, and board_at=, about where "
            "they are; or a calibration by cameras as fit="
        )
    if not 0.0 < sees.distance[0] < sees.distance[1]:
        raise OptionError("distance=: give near:far in m, both above 0, near below far")
    if not 0.0 < sees.incidence < np.pi / 2.0:
        raise OptionError("incidence=: give an angle between 0 and 90 degrees")
    if not 0.0 < sees.share <= 1.0:
        raise OptionError(f"share={sees.share:g}: give more than 0, at most 1")
    if not 0.0 < sees.pixel_noise < np.inf:
        raise OptionError(f"pixel_noise={sees.pixel_noise:g}: give a finite number above 0")
