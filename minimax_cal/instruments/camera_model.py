"""A camera as OpenCV writes it: a pinhole with distortion, its derivatives, and its file.

No OpenCV is needed: the file is text, and the model is four lines [OpenCV, calib3d, eq. of
projectPoints].
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.core.files import read_text

CAMERA_ON_FLANGE, CAMERA_ON_GROUND = "flange", "ground"  # what a camera is fixed to
FITTED_INTRINSICS = (
    "fx",
    "fy",
    "cx",
    "cy",
    "k1",
    "k2",
    "p1",
    "p2",
    "k3",
)  # those that can be fitted
OPENCV_COEFFICIENT_COUNTS = (0, 4, 5, 8, 12, 14)  # of OpenCV's list of distortion coefficients
FIRST_TILT_COEFFICIENT = 12  # from here on the list tilts the sensor
MIN_UNDISTORTION_STEP, MAX_UNDISTORTION_STEPS = (
    1e-13,
    50,
)  # when Newton's steps in the image plane end; at most so many
MAX_DIRECTION_TANGENT = 10.0  # no lens sees farther from its axis, as a tangent
# what K, D and the size are called: OpenCV's samples, ROS, ROS messages, tutorials
CAMERA_FILE_KEYS = {
    "matrix": ("camera_matrix", "cameramatrix", "k", "intrinsic_matrix", "mtx"),
    "distortion": (
        "distortion_coefficients", "dist_coeffs", "distcoeffs", "dist_coeff", "d", "dist",
    ),
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
}  # fmt: skip
DISTORTION_MODELS = ("", "plumb_bob", "rational_polynomial")


@dataclass(frozen=True, eq=False)
class Camera:
    """intrinsic: (16,) fx, fy, cx, cy [px], k1, k2, p1, p2, k3, then `HELD`.

    size: width and height of the image [px], 0 where the file does not tell.
    """

    name: str
    intrinsic: Array
    size: tuple[int, int] = (0, 0)
    source: str = ""


def project_to_pixels(intrinsic: Array, x: Array, y: Array) -> Array:
    """Pixels (..., 2, N) of directions x, y (..., N) in the plane at depth one."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = intrinsic
    square = x * x + y * y
    above = 1.0 + square * (k1 + square * (k2 + square * k3))
    below = 1.0 + square * (k4 + square * (k5 + square * k6))
    radial = above / below
    u = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
    v = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
    u = u + square * (s1 + square * s2)
    v = v + square * (s3 + square * s4)
    return np.stack([fx * u + cx, fy * v + cy], axis=-2)


class PixelDerivatives(NamedTuple):
    """Pixels (2, N), derivatives (2, 2, N) by directions and (9, 2, N) by `FITTED_INTRINSICS`."""

    pixels: Array
    by_direction: Array
    by_intrinsics: Array


def pixel_derivatives(intrinsic: Array, x: Array, y: Array) -> PixelDerivatives:
    """Pixels (2, N), and their derivatives by x, y (2, 2, N) and by `FITTED_INTRINSICS` (9, 2, N).

    intrinsic: (16, N) or (16, 1).  The first axis of a derivative is what it is taken by.
    """
    fx, fy, _, _, k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = intrinsic
    s = x * x + y * y
    above = 1.0 + s * (k1 + s * (k2 + s * k3))
    below = 1.0 + s * (k4 + s * (k5 + s * k6))
    radial = above / below
    steep = (k1 + s * (2.0 * k2 + 3.0 * s * k3)) / below
    steep = steep - radial * (k4 + s * (2.0 * k5 + 3.0 * s * k6)) / below
    prism = s1 + 2.0 * s * s2, s3 + 2.0 * s * s4  # derivatives by the square
    by_x = np.stack(
        [
            radial + 2.0 * x * x * steep + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * x * prism[0],
            2.0 * x * y * steep + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * x * prism[1],
        ]
    )
    by_y = np.stack(
        [
            2.0 * x * y * steep + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * y * prism[0],
            radial + 2.0 * y * y * steep + 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * y * prism[1],
        ]
    )
    focal = np.stack(np.broadcast_arrays(fx, fy))
    pixel = project_to_pixels(intrinsic, x, y)
    bare = (pixel - np.stack(np.broadcast_arrays(*intrinsic[2:4]))) / focal
    none, one = np.zeros_like(x), np.ones_like(x)
    here = np.stack([x, y]) / below
    own = np.stack(
        [
            np.stack([bare[0], none]),
            np.stack([none, bare[1]]),
            np.stack([one, none]),
            np.stack([none, one]),
            focal * here * s,
            focal * here * s * s,
            focal * np.stack([2.0 * x * y, s + 2.0 * y * y]),
            focal * np.stack([s + 2.0 * x * x, 2.0 * x * y]),
            focal * here * s**3,
        ]
    )
    return PixelDerivatives(pixel, np.stack([focal * by_x, focal * by_y]), own)


def undistort_pixels(intrinsic: Array, pixels: Array) -> Array:
    """Directions (2, N) in the plane at depth one whose pixels (2, N) are given, by Newton.

    intrinsic: (16, N) or (16, 1).  A pixel that the lens shows nowhere ends at
    `MAX_DIRECTION_TANGENT`.
    """
    focal = np.stack(np.broadcast_arrays(*intrinsic[:2]))
    centre = np.stack(np.broadcast_arrays(*intrinsic[2:4]))
    place = (pixels - centre) / focal
    for _ in range(MAX_UNDISTORTION_STEPS):
        at, by, _ = pixel_derivatives(intrinsic, *place)
        step = np.linalg.solve(np.moveaxis(by, -1, 0).swapaxes(1, 2), (pixels - at).T[..., None])
        step = np.clip(step[..., 0].T, -0.5, 0.5)
        place = np.clip(place + step, -MAX_DIRECTION_TANGENT, MAX_DIRECTION_TANGENT)
        if np.abs(step).max(initial=0.0) < MIN_UNDISTORTION_STEP:
            break
    return np.asarray(place)


# ---- the file --------------------------------------------------------------------------------

OPENCV_MATRIX_TAG_PATTERN = re.compile(
    r"!!opencv-(nd-)?matrix\b"
)  # what FileStorage writes before a matrix


def read_camera_file(camera_name: str, path: Path | str) -> Camera:
    """A camera from a YAML file of OpenCV (FileStorage) or ROS (camera_info).  Raises DataError."""
    from minimax_cal.robots.strict_yaml import parse_strict_yaml  # few calibrations read one

    text = read_text(path, error_type=DataError)
    if text.lstrip().startswith("<"):
        raise DataError(f"{path}: is XML; save the camera as YAML, with K and D")
    text = OPENCV_MATRIX_TAG_PATTERN.sub("", re.sub(r"^\s*%YAML[^\n]*\n", "", text))
    try:
        content = parse_strict_yaml(text)
    except ValueError as error:
        raise DataError(f"{path}: cannot be parsed: {' '.join(str(error).split())}") from error
    if not isinstance(content, Mapping):
        raise DataError(
            f"{path}: holds no camera; expected camera_matrix and distortion_coefficients"
        )
    known = {str(key).lower(): value for key, value in content.items()}
    model = str(known.get("distortion_model", "")).lower()
    if model not in DISTORTION_MODELS:
        raise DataError(
            f"{path}: distortion_model {model!r} is not known; calibrate the camera with plumb_bob "
            "or rational_polynomial"
        )
    matrix = parse_matrix_entries(path, known, "matrix", 9).reshape(3, 3)
    return Camera(
        camera_name,
        build_intrinsic(path, matrix, parse_distortion_coefficients(path, known)),
        parse_image_size(path, known),
        str(path),
    )


class ImageSize(NamedTuple):
    """Width and height of an image [px], 0 where unknown."""

    width: int
    height: int


def parse_image_size(path: Path | str, content: Mapping[str, Any]) -> ImageSize:
    """Width and height of the image, 0 where the file does not tell.  Raises DataError."""
    out = []
    for key in ("width", "height"):
        given = [content[name] for name in CAMERA_FILE_KEYS[key] if name in content]
        if given and (not isinstance(given[0], int) or given[0] <= 0):
            raise DataError(f"{path}: image_{key} {given[0]!r} is no number of pixels")
        out.append(int(given[0]) if given else 0)
    return ImageSize(out[0], out[1])


def parse_distortion_coefficients(path: Path | str, content: Mapping[str, Any]) -> Array:
    """(12,) distortion coefficients in OpenCV's order, 0 where none.  Raises DataError."""
    if not any(name in content for name in CAMERA_FILE_KEYS["distortion"]):
        raise DataError(
            f"{path}: distortion_coefficients is missing; give zeros for a lens without distortion"
        )
    given = parse_matrix_entries(path, content, "distortion")
    if len(given) not in OPENCV_COEFFICIENT_COUNTS:
        raise DataError(
            f"{path}: distortion_coefficients has {len(given)} numbers; OpenCV has 4, 5, 8 or 12"
        )
    if given[FIRST_TILT_COEFFICIENT:].any():
        raise DataError(f"{path}: distortion_coefficients tilts the sensor, which is not modelled")
    return np.concatenate(
        [given[:FIRST_TILT_COEFFICIENT], np.zeros(max(FIRST_TILT_COEFFICIENT - len(given), 0))]
    )


def parse_matrix_entries(
    path: Path | str, content: Mapping[str, Any], key: str, required_count: int = 0
) -> Array:
    """The numbers of a matrix, row by row.  required_count: how many there must be.  Raises
    DataError.
    """
    names = [name for name in CAMERA_FILE_KEYS[key] if name in content]
    if not names:
        raise DataError(
            f"{path}: {CAMERA_FILE_KEYS[key][0]} is missing; it is OpenCV's, of nine numbers"
        )
    given = content[names[0]]
    if isinstance(given, Mapping):
        given = given.get("data")
    try:
        numbers = [float(each) for each in flatten_nested_lists(given)]
    except (TypeError, ValueError) as error:
        raise DataError(f"{path}: {names[0]} is no matrix of numbers") from error
    out = np.array(numbers)
    if not np.isfinite(out).all():
        raise DataError(f"{path}: {names[0]} holds a number that is not finite")
    if required_count and len(out) != required_count:
        raise DataError(f"{path}: {names[0]} has {len(out)} numbers, not {required_count}")
    return out


def flatten_nested_lists(nested: Any) -> Iterable[Any]:
    """The entries of lists in lists."""
    if not isinstance(nested, list):
        yield nested
        return
    for each in nested:
        yield from flatten_nested_lists(each)


def build_intrinsic(path: Path | str, matrix: Array, distortion: Array) -> Array:
    """(16,) numbers of a camera.  matrix: (3, 3).  distortion: (12,).  Raises DataError."""
    shape = np.array([[1, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=bool)
    rest = matrix - np.diag([0.0, 0.0, 1.0])
    if np.any(rest[~shape] != 0.0):
        raise DataError(
            f"{path}: camera_matrix must be [fx, 0, cx; 0, fy, cy; 0, 0, 1]; is it row by row?"
        )
    focal = np.array([matrix[0, 0], matrix[1, 1]])
    if not (focal > 1.0).all():
        raise DataError(f"{path}: camera_matrix: fx and fy must be pixels, more than 1")
    k1, k2, p1, p2, k3, *more = distortion
    return np.array([*focal, matrix[0, 2], matrix[1, 2], k1, k2, p1, p2, k3, *more])
