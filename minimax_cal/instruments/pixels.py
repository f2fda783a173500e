"""What cameras saw: a pixel for each corner or tag, the joints of each pose, places on a board."""

from __future__ import annotations

import difflib
import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.words import name_first
from minimax_cal.instruments.camera import Camera
from minimax_cal.measuring.measurements import Measurements, joint_rows
from minimax_cal.reading.rows import Rows, read_rows

POSE = re.compile("pose")
NEEDED = ("pose", "camera", "target", "u_px", "v_px")
BOARD = ("target", *(f"{axis}_{{}}" for axis in "xyz"))
EDGE = 1.0  # a corner may lie so far outside the image, by its interpolation [px]
MOST_PIXELS = 1e5  # no sensor has more in a row
LEAST_SEEN = 2  # pixels of a target of unknown place: fewer say nothing
LEAST_IMAGES = 4  # with fewer a camera's place says nothing of the arm
SAME_PLACE = 1e-7  # no two corners are nearer [m]
MOST_NAMED = 5  # poses or targets that a notice names
LARGEST_BOARD = 100.0  # half its side [m]


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
    def count(self) -> int:
        """Number of pixels, each u and v."""
        return len(self.pixel)

    @property
    def part(self) -> Array:
        """(N,) which target in which camera each pixel is of, as `parts` names them."""
        return np.asarray(self.camera * len(self.targets) + self.target)

    @property
    def image(self) -> Array:
        """(N,) number of the image that each pixel is of: of a pose, in a camera."""
        return np.asarray(self.pose * len(self.cameras) + self.camera)

    @property
    def parts(self) -> tuple[str, ...]:
        """Every target in every camera."""
        several = len(self.cameras) > 1
        return tuple(
            f"{camera.name} {target}" if several else target
            for camera in self.cameras
            for target in self.targets
        )

    def take(self, rows: Array) -> PixelData:
        """The images at some poses only.  rows: (m,) mask, or numbers in their order."""
        chosen = np.arange(self.at.poses)[rows]
        place = np.full(self.at.poses, -1)
        place[chosen] = np.arange(len(chosen))
        labels = tuple(self.labels[i] for i in chosen)
        kept = replace(self.some(place[self.pose] >= 0), at=self.at.take(chosen), labels=labels)
        return replace(kept, pose=place[kept.pose])

    def some(self, kept: Array) -> PixelData:
        """Some of the pixels, of the same poses.  kept: (N,) mask."""
        parts = ("pose", "camera", "target", "pixel", "line")
        return replace(self, **{name: getattr(self, name)[kept] for name in parts})

    def says(self, row: int) -> str:
        """What a pixel is of, for a message."""
        return (
            f"line {self.line[row]} (pose {self.labels[self.pose[row]]}, target "
            f"{self.targets[self.target[row]]})"
        )


def read_pixels(
    detections: Path | str,
    joints: Path | str,
    cameras: Sequence[Camera],
    board: Path | str | None = None,
) -> PixelData:
    """Detections and joints (CSV), and the places of a board's targets.  Raises DataError."""
    file = read_rows(detections)
    header_of(file, NEEDED, "detections")
    at, labels = read_joints(joints)
    known = {camera.name: i for i, camera in enumerate(cameras)}
    if len(known) < len(cameras):
        raise DataError("a camera is given twice; give each name once")
    places = {} if board is None else read_board(board)
    names = file.text("target")
    targets = tuple(places) or tuple(dict.fromkeys(names))
    pixel = np.stack([file.number("u_px"), file.number("v_px")], axis=1)
    data = PixelData(
        at=at,
        labels=labels,
        cameras=tuple(cameras),
        targets=targets,
        board=np.array(list(places.values())).reshape(-1, 3),
        pose=numbered(
            file,
            "pose",
            labels,
            f"has no joint values in {joints}; add them, or leave its rows out",
        ),
        camera=numbered(
            file, "camera", tuple(known), "has no file; name it with camera='NAME=camera.yaml'"
        ),
        target=numbered(
            file, "target", targets, f"has no place in {board}; add it, or leave its rows out"
        ),
        pixel=pixel,
        line=file.line,
        notices=(*file.notices, *at.notices),
        source=str(detections),
        digest=digest_of(file.sheet.digest, at.digest, *(camera.source for camera in cameras)),
    )
    return without_single(checked(data))


def digest_of(*parts: str) -> str:
    """SHA-256 of what several files hold together."""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def header_of(file: Rows, needed: Sequence[str], what: str) -> None:
    """Raise DataError for a column that is missing or stands twice."""
    twice = [name for name in file.header if file.header.count(name) > 1]
    if twice:
        raise DataError(f"{file.path}:1: column {twice[0]} stands twice")
    for name in needed:
        if name not in file.header:
            others = [each for each in file.header if each not in needed]
            near = difflib.get_close_matches(name, others, 1, cutoff=0.4)
            hint = f"; rename {near[0]!r}?" if near else ""
            raise DataError(
                f"{file.path}:1: column {name} is missing; {what} have the columns "
                f"{', '.join(needed)}{hint}"
            )


def numbered(file: Rows, name: str, known: tuple[str, ...], fault: str) -> Array:
    """(N,) which of the known names each row has.  Raises DataError for one that is unknown."""
    place = {each: i for i, each in enumerate(known)}
    out = np.array([place.get(each, -1) for each in file.text(name)], dtype=int)
    if (out < 0).any():
        row = int(np.argmax(out < 0))
        given = file.text(name)[row]
        near = difflib.get_close_matches(given, known, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise DataError(f"{file.path}:{file.line[row]}: {name} {given[:60]!r} {fault}{hint}")
    return out


def read_joints(path: Path | str) -> tuple[Measurements, tuple[str, ...]]:
    """Joint values by pose, and the poses' names.  Raises DataError."""
    file = read_rows(path)
    at = joint_rows(file, POSE)
    header_of(file, ("pose",), "joints")
    labels = tuple(file.text("pose"))
    for row, label in enumerate(labels):
        if not label:
            raise DataError(f"{path}:{file.line[row]}: column pose is empty; name the pose")
        if label in labels[:row]:
            first = file.line[labels.index(label)]
            raise DataError(
                f"{path}:{file.line[row]}: pose {label[:60]!r} stands on line {first} too"
            )
    return at, labels


def read_board(path: Path | str) -> dict[str, Array]:
    """Places of targets by name [m].  Raises DataError."""
    file = read_rows(path)
    unit = "m" if "x_m" in file.header else "mm"
    header_of(file, [name.format(unit) for name in BOARD], "the targets of a board")
    place = np.stack([file.number(f"{axis}_{unit}", unit=unit) for axis in "xyz"], axis=1)
    names = file.text("target")
    for row, name in enumerate(names):
        if not np.abs(place[row]).max() < LARGEST_BOARD:
            raise DataError(
                f"{path}:{file.line[row]}: target {name[:60]!r} is more than {LARGEST_BOARD:g} m "
                "from the board's origin"
            )
        if name in names[:row]:
            raise DataError(f"{path}:{file.line[row]}: target {name[:60]!r} stands twice")
    if len(names) < 3:
        raise DataError(f"{path}: has {len(names)} targets; a board has at least three")
    for row in range(1, len(place)):
        near = np.linalg.norm(place[:row] - place[row], axis=1) < SAME_PLACE
        if near.any():
            raise DataError(
                f"{path}:{file.line[row]}: target {names[row]!r} is where "
                f"{names[int(np.argmax(near))]!r} is"
            )
    spread = np.linalg.svd(place - place.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-6 * spread[0]:
        raise DataError(f"{path}: all targets lie on one line, whose roll no image shows")
    return dict(zip(names, place, strict=True))


def checked(data: PixelData) -> PixelData:
    """The data, if a fit can make sense of them.  Raises DataError."""
    keys = np.stack([data.pose, data.camera, data.target], axis=1)
    _, first, back = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    again = first[back.reshape(-1)] != np.arange(data.count)
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
        size = [extent or MOST_PIXELS for extent in camera.size]
        off = (data.pixel[here] < -EDGE) | (data.pixel[here] > np.array(size) - 1.0 + EDGE)
        if off.any():
            row = here[int(np.argmax(off.any(axis=1)))]
            u, v = data.pixel[row]
            raise DataError(
                f"{data.source}:{data.line[row]}: ({u:g}, {v:g}) px is outside the image of camera "
                f"{camera.name!r}, {size[0]:g} x {size[1]:g} px ({camera.source})"
            )
        images = len(np.unique(data.pose[here]))
        if images < LEAST_IMAGES:
            raise DataError(
                f"{data.source}: camera {camera.name!r} has {images} images with detections; take "
                f"at least {LEAST_IMAGES}, at different poses, and many more for a calibration"
            )
    blind = np.setdiff1d(np.arange(data.at.poses), data.pose)
    if len(blind):
        named = name_first([data.labels[i] for i in blind], MOST_NAMED)
        notice = f"{data.source}: no detections at {len(blind)} poses: {named}"
        data = replace(data, notices=(*data.notices, notice))
    return data


def without_single(data: PixelData) -> PixelData:
    """The data without targets of unknown place that hardly any image shows, with a notice."""
    if len(data.board):
        return data
    often = np.bincount(data.target, minlength=len(data.targets))
    gone = [name for name, count in zip(data.targets, often, strict=True) if count < LEAST_SEEN]
    if not gone:
        return data
    if len(gone) == len(data.targets):
        raise DataError(
            f"{data.source}: every target is seen once only: tags of unknown place must be seen "
            "from several poses, or give their places with board="
        )
    kept = often >= LEAST_SEEN
    place = np.cumsum(kept) - 1
    some = data.some(kept[data.target])
    named = name_first(gone, MOST_NAMED)
    return replace(
        some,
        target=place[some.target],
        targets=tuple(name for name in data.targets if name not in gone),
        notices=(*data.notices, f"{data.source}: seen once only and left out: {named}"),
    )
