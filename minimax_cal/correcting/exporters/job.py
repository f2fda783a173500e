"""What is to be exported, and what an exporter gives back; the joint origins most formats share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from minimax_cal.fitting.opened import Opened, Result, open_result
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.files import NotSaved, saved_content
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, still
from minimax_cal.modelling.effects.compliance import JOINT_COMPLIANCE, stiffens
from minimax_cal.modelling.effects.scene import joint_of
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.transforms import SAME, head, tail
from minimax_cal.robots.urdf import has_links, load_urdf
from minimax_cal.robots.urdf_file import Urdf


@dataclass(frozen=True, eq=False)
class Job:
    """A robot on its way to a file.

    robot: calibrated.  nominal: before the calibration, the same where there was none.
    compliance: (n,) turn per torque that was fitted, NaN where none [rad/(N m)].
    originals: the URDF to correct, or none.  tip: its last link, empty for the only end.
    experimental: whether the user agreed to what no maker documents.
    fitted: whether nominal is known.  notices: what of the source is not in the robot.
    cell: base, targets and effects, None for a bare robot.  q: (m, n) poses of the fit [rad, m].
    model: an MJCF to correct, None for a new one.  path: where the file goes, None for nowhere yet.
    """

    robot: Robot
    nominal: Robot
    source: str
    compliance: Array
    originals: tuple[Urdf, ...] = ()
    tip: str = ""
    experimental: bool = False
    fitted: bool = False
    notices: tuple[str, ...] = ()
    cell: Cell | None = None
    q: Array | None = None
    model: Path | None = None
    path: Path | None = None


@dataclass(frozen=True)
class Export:
    """A file's content, and what people should know about it.

    beside: contents of files that belong to it, by the ending that takes the place of its own.
    off: how far (m, k, 3) its targets stand from the formulas of the fit at measured poses, as the
    instrument sees it [m]; None where they stand where these say, or no simulator is there.
    """

    content: bytes
    notices: tuple[str, ...] = ()
    beside: Mapping[str, bytes] = field(default_factory=dict)
    off: Callable[[Measurements], Array] | None = None

    @staticmethod
    def of(text: str, *notices: str) -> Export:
        """From text."""
        return Export(text.encode("utf-8"), notices)


def read_source(source: Result | Robot, rung: int | None = None) -> Opened | Job:
    """A result, or its file, opened; of any robot that `load_robot` takes the job itself.

    Raises CalibrationError.
    """
    if isinstance(source, Robot):
        return Job(source, source, source.name, np.full(source.joints, np.nan))
    if not isinstance(source, Path | str):
        return open_result(source, rung)
    path = Path(source)
    if path.suffix.lower() == ".json" and path.is_file():
        with suppress(NotSaved):  # load_robot says what is wrong with it
            if {"targets_mm", "kind"} & set(saved_content(path)):
                return open_result(path, rung)
    robot = load_robot(source)
    notices = load_urdf(source).notices if has_links(source) else ()
    return Job(robot, robot, str(source), np.full(robot.joints, np.nan), notices=notices)


def job_of(source: str, cell: Cell, nominal: Cell | None = None, q: Array | None = None) -> Job:
    """Of an arm; its nominal robot may be unknown.  q: (m, n) poses of the fit [rad, m]."""
    before = nominal.robot if nominal else cell.robot
    return Job(
        cell.robot, before, source, compliance_of(cell), fitted=nominal is not None, cell=cell, q=q
    )


def compliance_of(cell: Cell) -> Array:
    """(n,) turn per torque of each joint's whole load [rad/(N m)].

    NaN where none was fitted, or where the joint stiffens.
    """
    out = np.full(cell.robot.joints, np.nan)
    scene = cell.scene(still(np.zeros((1, cell.robot.joints)), cell.target_names, cell.robot))
    compliances = cell.effects.where(lambda term: term.effect == JOINT_COMPLIANCE.name)
    for term, values in compliances.pairs:
        for name, value in zip(term.columns(scene).names, values, strict=True):
            if name[1:].isdigit():
                out[int(name[1:]) - 1] = value
    for term in compliances.terms:
        if stiffens(term.choice):
            out[joint_of(term.place)] = np.nan
    return out


def origins(robot: Robot) -> Array:
    """Where each joint lies in the link before it, at joint values 0: (n + 1, 4, 4) [m].

    Joint i turns or slides along z of origin i (backwards where its sign is -1); the last one is
    the flange.  Parallel axes stay near: beta is part of the rotation.
    """
    tails = [np.eye(4), *map(tail, robot.mdh)]
    heads = [*map(head, robot.mdh), np.eye(4)]
    return np.array([before @ after for before, after in zip(tails, heads, strict=True)])


def joint_names(robot: Robot) -> tuple[str, ...]:
    """joint_1 ... joint_n."""
    return tuple(f"joint_{i + 1}" for i in range(robot.joints))


def is_identity(pose: Array) -> bool:
    """Whether a transform does nothing, to rounding."""
    return bool(np.abs(pose - np.eye(4)).max() <= SAME)


def number(value: float) -> str:
    """A number that reads back as the same one."""
    return repr(float(value) + 0.0)


def triple(values: Array) -> str:
    """Three numbers for XML."""
    return " ".join(map(number, values))


def mark_up(text: str) -> str:
    """Text as a value in XML."""
    for letter, name in (("&", "amp"), ("<", "lt"), (">", "gt"), ('"', "quot")):
        text = text.replace(letter, f"&{name};")
    return "".join(letter for letter in text if letter.isprintable())
