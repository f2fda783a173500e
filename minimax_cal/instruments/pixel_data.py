"""What cameras saw: a pixel for each corner or tag, the joints of each pose, places on a board."""

from __future__ import annotations

import difflib
import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.core.errors import DataError
from minimax_cal.instruments.camera_model import Camera
from minimax_cal.measuring.measurements import Measurements, build_joint_measurements
from minimax_cal.reading.measurement_table import MeasurementTable, read_measurement_table

POSE_COLUMN_PATTERN = re.compile("pose")
DETECTION_COLUMNS = ("pose", "camera", "target", "u_px", "v_px")
BOARD_COLUMN_TEMPLATES = ("target", *(f"{axis}_{{}}" for axis in "xyz"))
MAX_PIXELS_OUTSIDE_IMAGE = (
    1.0  # a corner may lie so far outside the image, by its interpolation [px]
)
MAX_SENSOR_PIXELS = 1e5  # no sensor has more in a row
MIN_PIXELS_PER_TARGET = 2  # pixels of a target of unknown place: fewer say nothing
MIN_IMAGES_PER_CAMERA = 4  # with fewer a camera's place says nothing of the arm
MIN_BOARD_TARGET_DISTANCE = 1e-7  # no two corners are nearer [m]
MAX_NAMED_POSES = 5  # poses or targets that a notice names
MAX_BOARD_COORDINATE = 100.0  # half its side [m]


@dataclass(frozen=True, eq=False)
class PixelData:
    """Joint values of m poses, and N pixels of corners or tags.

    at: the poses (q, line, columns), without any point.  labels: (m,) what each is called.
    cameras: those that saw them.  targets: k names.  board: (k, 3) places of the targets in a frame
    of their own [m], (0, 3) where these are unknown.
    pose, camera, target: (N,) numbers of pose, camera and target.  pixel: (N, 2) [px].
    line: (N,) line of the file.
    """

    at: Measurements
    labels: tuple[str, ...]
    cameras: tuple[Camera, ...]
    targets: tuple[str, ...]
    board: Array
    pose: Array
    camera: Array
    target: Array
    pixel: Array
    line: Array
    notices: tuple[str, ...] = ()
    source: str = "detections"
    digest: str = ""

    @property
    def pixel_count(self) -> int:
        """Number of pixels, each u and v."""
        return len(self.pixel)

    @property
    def part_of_pixels(self) -> Array:
        """(N,) which target in which camera each pixel is of, as `part_names` names them."""
        return np.asarray(self.camera * len(self.targets) + self.target)

    @property
    def image_of_pixels(self) -> Array:
        """(N,) number of the image that each pixel is of: of a pose, in a camera."""
        return np.asarray(self.pose * len(self.cameras) + self.camera)

    @property
    def part_names(self) -> tuple[str, ...]:
        """Every target in every camera."""
        several = len(self.cameras) > 1
        return tuple(
            f"{camera.name} {target}" if several else target
            for camera in self.cameras
            for target in self.targets
        )

    def take_poses(self, rows: Array) -> PixelData:
        """The images at some poses only.  rows: (m,) mask, or numbers in their order."""
        chosen = np.arange(self.at.poses)[rows]
        place = np.full(self.at.poses, -1)
        place[chosen] = np.arange(len(chosen))
        labels = tuple(self.labels[i] for i in chosen)
        kept = replace(
            self.take_pixels(place[self.pose] >= 0), at=self.at.take(chosen), labels=labels
        )
        return replace(kept, pose=place[kept.pose])

    def take_pixels(self, pixel_mask: Array) -> PixelData:
        """Some of the pixels, of the same poses.  pixel_mask: (N,) mask."""
        parts = ("pose", "camera", "target", "pixel", "line")
        return replace(self, **{name: getattr(self, name)[pixel_mask] for name in parts})

    def pixel_location(self, row: int) -> str:
        """What a pixel is of, for a message."""
        return (
            f"line {self.line[row]} (pose {self.labels[self.pose[row]]}, target "
            f"{self.targets[self.target[row]]})"
        )


def read_pixel_data(
    detections: Path | str,
    joints: Path | str,
    cameras: Sequence[Camera],
    board: Path | str | None = None,
) -> PixelData:
    """Detections and joints (CSV), and the places of a board's targets.  Raises DataError."""
    file = read_measurement_table(detections)
    check_needed_columns(file, DETECTION_COLUMNS, "detections")
    at, labels = read_labelled_joints(joints)
    known = {camera.name: i for i, camera in enumerate(cameras)}
    if len(known) < len(cameras):
        raise DataError("a camera is given twice; give each name once")
    places = {} if board is None else read_board_targets(board)
    names = file.text_column("target")
    targets = tuple(places) or tuple(dict.fromkeys(names))
    pixel = np.stack([file.number_column("u_px"), file.number_column("v_px")], axis=1)
    data = PixelData(
        at=at,
        labels=labels,
        cameras=tuple(cameras),
        targets=targets,
        board=np.array(list(places.values())).reshape(-1, 3),
        pose=number_names_in_column(
            file,
            "pose",
            labels,
            f"has no joint values in {joints}; add them, or leave its rows out",
        ),
        camera=number_names_in_column(
            file, "camera", tuple(known), "has no file; name it with camera='NAME=camera.yaml'"
        ),
        target=number_names_in_column(
            file, "target", targets, f"has no place in {board}; add it, or leave its rows out"
        ),
        pixel=pixel,
        line=file.line,
        notices=(*file.notices, *at.notices),
        source=str(detections),
        digest=combine_digests(
            file.sheet.digest, at.digest, *(camera.source for camera in cameras)
        ),
    )
    return drop_rarely_seen_targets(check_pixel_data(data))


def combine_digests(*parts: str) -> str:
    """SHA-256 of what several files hold together."""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def check_needed_columns(
    table: MeasurementTable, needed_columns: Sequence[str], table_title: str
) -> None:
    """Raise DataError for a column that is missing or stands twice."""
    twice = [name for name in table.header if table.header.count(name) > 1]
    if twice:
        raise DataError(f"{table.path}:1: column {twice[0]} stands twice")
    for name in needed_columns:
        if name not in table.header:
            others = [each for each in table.header if each not in needed_columns]
            near = difflib.get_close_matches(name, others, 1, cutoff=0.4)
            hint = f"; rename {near[0]!r}?" if near else ""
            raise DataError(
                f"{table.path}:1: column {name} is missing; {table_title} have the columns "
                f"{', '.join(needed_columns)}{hint}"
            )


def number_names_in_column(
    table: MeasurementTable, column_name: str, known_names: tuple[str, ...], fault_text: str
) -> Array:
    """(N,) which of the known names each row has.  Raises DataError for one that is unknown."""
    place = {each: i for i, each in enumerate(known_names)}
    out = np.array([place.get(each, -1) for each in table.text_column(column_name)], dtype=int)
    if (out < 0).any():
        row = int(np.argmax(out < 0))
        given = table.text_column(column_name)[row]
        near = difflib.get_close_matches(given, known_names, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise DataError(
            f"{table.path}:{table.line[row]}: {column_name} {given[:60]!r} {fault_text}{hint}"
        )
    return out


class LabelledJoints(NamedTuple):
    """Joint values by pose, and the poses' names."""

    data: Measurements
    labels: tuple[str, ...]


def read_labelled_joints(path: Path | str) -> LabelledJoints:
    """Joint values by pose, and the poses' names.  Raises DataError."""
    file = read_measurement_table(path)
    at = build_joint_measurements(file, POSE_COLUMN_PATTERN)
    check_needed_columns(file, ("pose",), "joints")
    labels = tuple(file.text_column("pose"))
    for row, label in enumerate(labels):
        if not label:
            raise DataError(f"{path}:{file.line[row]}: column pose is empty; name the pose")
        if label in labels[:row]:
            first = file.line[labels.index(label)]
            raise DataError(
                f"{path}:{file.line[row]}: pose {label[:60]!r} stands on line {first} too"
            )
    return LabelledJoints(at, labels)


def read_board_targets(path: Path | str) -> dict[str, Array]:
    """Places of targets by name [m].  Raises DataError."""
    file = read_measurement_table(path)
    unit = "m" if "x_m" in file.header else "mm"
    check_needed_columns(
        file, [name.format(unit) for name in BOARD_COLUMN_TEMPLATES], "the targets of a board"
    )
    place = np.stack([file.number_column(f"{axis}_{unit}", unit=unit) for axis in "xyz"], axis=1)
    names = file.text_column("target")
    for row, name in enumerate(names):
        if not np.abs(place[row]).max() < MAX_BOARD_COORDINATE:
            raise DataError(
                f"{path}:{file.line[row]}: target {name[:60]!r} "
                f"is more than {MAX_BOARD_COORDINATE:g} m "
                "from the board's origin"
            )
        if name in names[:row]:
            raise DataError(f"{path}:{file.line[row]}: target {name[:60]!r} stands twice")
    if len(names) < 3:
        raise DataError(f"{path}: has {len(names)} targets; a board has at least three")
    for row in range(1, len(place)):
        near = np.linalg.norm(place[:row] - place[row], axis=1) < MIN_BOARD_TARGET_DISTANCE
        if near.any():
            raise DataError(
                f"{path}:{file.line[row]}: target {names[row]!r} is where "
                f"{names[int(np.argmax(near))]!r} is"
            )
    spread = np.linalg.svd(place - place.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-6 * spread[0]:
        raise DataError(f"{path}: all targets lie on one line, whose roll no image shows")
    return dict(zip(names, place, strict=True))


def check_pixel_data(data: PixelData) -> PixelData:
    """The data, if a fit can make sense of them.  Raises DataError."""
    keys = np.stack([data.pose, data.camera, data.target], axis=1)
    _, first, back = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    again = first[back.reshape(-1)] != np.arange(data.pixel_count)
    if again.any():
        row = int(np.argmax(again))
        other = int(first[back.reshape(-1)[row]])
        raise DataError(
            f"{data.source}:{data.line[row]}: target {data.targets[data.target[row]]!r} of pose "
            f"{data.labels[data.pose[row]]!r} stands on line {data.line[other]} too, for the same "
            "camera; keep one"
        )
    for number, camera in enumerate(data.cameras):
        here = np.flatnonzero(data.camera == number)
        if not len(here):
            raise DataError(
                f"{data.source}: camera {camera.name!r} sees nothing; leave it out, or check "
                "its name"
            )
        size = [extent or MAX_SENSOR_PIXELS for extent in camera.size]
        off = (data.pixel[here] < -MAX_PIXELS_OUTSIDE_IMAGE) | (
            data.pixel[here] > np.array(size) - 1.0 + MAX_PIXELS_OUTSIDE_IMAGE
        )
        if off.any():
            row = here[int(np.argmax(off.any(axis=1)))]
            u, v = data.pixel[row]
            raise DataError(
                f"{data.source}:{data.line[row]}: ({u:g}, {v:g}) px is outside the image of camera "
                f"{camera.name!r}, {size[0]:g} x {size[1]:g} px ({camera.source})"
            )
        images = len(np.unique(data.pose[here]))
        if images < MIN_IMAGES_PER_CAMERA:
            raise DataError(
                f"{data.source}: camera {camera.name!r} has {images} images with detections; take "
                f"at least {MIN_IMAGES_PER_CAMERA}, at different "
                f"poses, and many more for a calibration"
            )
    blind = np.setdiff1d(np.arange(data.at.poses), data.pose)
    if len(blind):
        named = format_first_names([data.labels[i] for i in blind], MAX_NAMED_POSES)
        notice = f"{data.source}: no detections at {len(blind)} poses: {named}"
        data = replace(data, notices=(*data.notices, notice))
    return data


def drop_rarely_seen_targets(data: PixelData) -> PixelData:
    """The data without targets of unknown place that hardly any image shows, with a notice."""
    if len(data.board):
        return data
    often = np.bincount(data.target, minlength=len(data.targets))
    gone = [
        name
        for name, count in zip(data.targets, often, strict=True)
        if count < MIN_PIXELS_PER_TARGET
    ]
    if not gone:
        return data
    if len(gone) == len(data.targets):
        raise DataError(
            f"{data.source}: every target is seen once only: tags of unknown place must be seen "
            "from several poses, or give their places with board="
        )
    kept = often >= MIN_PIXELS_PER_TARGET
    place = np.cumsum(kept) - 1
    some = data.take_pixels(kept[data.target])
    named = format_first_names(gone, MAX_NAMED_POSES)
    return replace(
        some,
        target=place[some.target],
        targets=tuple(name for name in data.targets if name not in gone),
        notices=(*data.notices, f"{data.source}: seen once only and left out: {named}"),
    )
