"""Slips of pixels that no fit should be asked to explain: flipped axes, board size, wrong lens."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from minimax_cal.fitting.checks import POOR_FIT
from minimax_cal.fitting.claims import MAX_MISS_OF_REACH
from minimax_cal.fitting.pixels.camera import INTRINSICS
from minimax_cal.fitting.pixels.data import PixelData
from minimax_cal.fitting.pixels.drawing import Scale
from minimax_cal.fitting.pixels.fit import FAR_LENS, PixelFit
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.fitting.pixels.start import Started, start_scene
from minimax_cal.fitting.same_arm import too_changed
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.robots.robot import Robot

BETTER = 0.3  # of the error: a slip whose mending leaves no more is the cause
ALIKE = 1.2  # errors that differ by less do not tell one slip from another
MOST_ASIDE = 1.0 / 3.0  # of the pixels: where more stand out, none of them is to be believed
LISTED = 5  # lines, or images, that a notice names
WHOLE_IMAGE = 0.5  # of an image: where more pixels stand out, its pose is wrong, not its pixels
OTHER_LENS = 0.05  # of the focal length: no lens changes so much, it is another one
OTHER_SIZE, ODD_SIZE = 1e-6, 0.01  # p-values of a board of another size: it fails, a notice
LEAST_SIZE = 3e-3  # share of a board's size: by less it is no other board
UNITS = (1e-3, 1e3, 0.1, 10.0, 25.4, 1.0 / 25.4)  # slips of a board's unit


def check_start(robot: Robot, data: PixelData, started: Started) -> None:
    """Raise DataError for slips that show where the arm as drawn is fitted."""
    given = started.miss(robot, data)
    if given <= POOR_FIT * robot.reach():
        return
    found = [
        (start_scene(robot, mended, started.on_flange).miss(robot, mended), text)
        for text, mended in slips(data)
    ]
    least = min(miss for miss, _ in found)
    miss, text = next(each for each in found if each[0] <= ALIKE * least)
    if miss < BETTER * given and miss < 4.0 * POOR_FIT * robot.reach():
        raise DataError(
            f"{data.source}: {text} (the drawn arm then misses by {1e3 * miss:.3g} mm at the "
            f"target, not {1e3 * given:.3g} mm)"
        )


def slips(data: PixelData) -> Iterator[tuple[str, PixelData]]:
    """Slips worth testing: what to say, and the data with the slip mended."""
    u, v = data.pixel.T
    size = np.array([extent_of(data, i) for i in range(len(data.cameras))])
    width, height = size[data.camera].T
    for text, pixel in (
        ("v_px counts from the bottom of the image; v is to count from the top", (u, height - v)),
        ("u_px counts from the right of the image; u is to count from the left", (width - u, v)),
        ("u_px and v_px look exchanged", (v, u)),
    ):
        yield text, replace(data, pixel=np.stack(pixel, axis=1))
    for factor in UNITS if len(data.board) else ():
        text = f"the board's places look {1.0 / factor:g} times too large: check their unit"
        yield text, replace(data, board=factor * data.board)


def extent_of(data: PixelData, camera: int) -> tuple[float, float]:
    """The largest pixel of a camera's image, or twice its centre where the size is not told."""
    each = data.cameras[camera]
    width, height = (
        extent - 1.0 if extent else 2.0 * centre
        for extent, centre in zip(each.size, each.intrinsic[2:4], strict=True)
    )
    return float(width), float(height)


def contradiction(
    robot: Robot, data: PixelData, fit: PixelFit, scale: Scale | None, options: PixelOptions
) -> str:
    """Why a fit contradicts its own data; empty where it does not."""
    depth = np.abs(fit.model.seen(fit.scene).point[2])
    focal = fit.model.intrinsic[fit.model.camera, 0]
    size = np.linalg.norm(fit.model.errors(fit.scene), axis=0) * depth / focal
    miss, aside = float(np.median(size)), float((fit.model.weight == 0.0).mean())
    said = ""
    if miss > MAX_MISS_OF_REACH * robot.reach():
        said = f"the calibrated arm misses by {1e3 * miss:.3g} mm at the target"
    elif aside > MOST_ASIDE:
        said = f"{100 * aside:.0f} % of the pixels are outliers"
    if said:
        return (
            f"{said}: check that joints, detections, board and camera files belong together, and "
            "what the cameras are fixed to (camera_on)"
        )
    links = fit.active[: 5 * robot.joints]
    return (
        other_lens(data, fit)
        or other_size(scale, OTHER_SIZE, LEAST_SIZE)
        or (
            ""
            if options.allow_large_changes
            else too_changed(robot, robot.with_mdh(fit.scene.mdh[0]), links)
        )
    )


def other_lens(data: PixelData, fit: PixelFit) -> str:
    """Which camera's file is of another lens; empty where none is."""
    for camera, lens in zip(data.cameras, fit.lens, strict=True):
        file = camera.intrinsic[:2]
        if (np.abs(lens[:2] / file - 1.0) > OTHER_LENS).any():
            return (
                f"{camera.source}: the pixels of {camera.name} fit fx {lens[0]:.5g}, fy "
                f"{lens[1]:.5g}, not {file[0]:.5g}, {file[1]:.5g}: it is the file of another "
                "camera, of another image size, or of another focus"
            )
    return ""


def other_size(scale: Scale | None, limit: float, least: float = 0.0) -> str:
    """That the board is of another size than its file says; empty where it is not.

    limit: p-value from which on it is.  Pixels leave it open how large all is: with a board of
    another size the arm comes out larger by the same factor, in all its lengths alike.
    """
    if scale is None or scale.p_value > limit or abs(scale.share) < least:
        return ""
    larger, board = ("longer", "smaller") if scale.share > 0.0 else ("shorter", "larger")
    own = abs(scale.share / (1.0 + scale.share))
    return (
        f"all lengths of the arm come out {100 * abs(scale.share):.2f} % {larger} than drawn: the "
        f"board is {100 * own:.2f} % (sigma {100 * scale.sigma:.2f} %) {board} than its file says "
        "(board): measure its squares"
    )


def file_notices(data: PixelData, fit: PixelFit, scale: Scale | None) -> list[str]:
    """Notices of lenses that are far from their files, and of a board of another size."""
    file = fit.model.intrinsic[:, : len(INTRINSICS)]
    off = np.abs(fit.lens - file) / fit.doubt
    out = []
    for i, camera in enumerate(data.cameras):
        far = [j for j in range(len(INTRINSICS)) if off[i, j] > FAR_LENS]
        if far:
            named = ", ".join(
                f"{INTRINSICS[j]} {fit.lens[i, j]:.6g} (file: {file[i, j]:.6g})" for j in far
            )
            out.append(
                f"{camera.source}: the pixels say that the lens of {camera.name} is "
                f"{off[i, far].max():.0f} times its doubt away from its file: {named}; is it the "
                "file of this camera?"
            )
    odd = other_size(scale, ODD_SIZE)
    return [*out, odd] if odd else out


def outlier_notices(data: PixelData, rows: Array) -> list[str]:
    """Notices of pixels that were set aside, and of images most of whose pixels were."""
    if not len(rows):
        return []
    images = np.stack([data.pose, data.camera], axis=1)
    _, image, count = np.unique(images, axis=0, return_inverse=True, return_counts=True)
    image = image.reshape(-1)
    lost = np.bincount(image[rows], minlength=len(count)) > WHOLE_IMAGE * count
    single = rows[~lost[image[rows]]]
    out = []
    if lost.any():
        first = [int(np.argmax(image == each)) for each in np.flatnonzero(lost)]
        named = ", ".join(
            f"pose {data.labels[data.pose[row]]} of camera {data.cameras[data.camera[row]].name}"
            for row in first[:LISTED]
        )
        more = f" and {len(first) - LISTED} more" if len(first) > LISTED else ""
        out.append(
            f"{data.source}: {len(first)} whole images are outliers, set aside: {named}{more}; "
            "are the joint values those of the image?"
        )
    if len(single):
        named = ", ".join(data.says(int(row)) for row in single[:LISTED])
        more = f" and {len(single) - LISTED} more" if len(single) > LISTED else ""
        one = len(single) == 1
        out.append(
            f"{data.source}: {len(single)} pixel{'' if one else 's'} "
            f"stand{'s' if one else ''} out and {'is' if one else 'are'} set aside: {named}{more}"
        )
    return out
