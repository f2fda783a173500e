"""What is to be exported, and what an exporter gives back; the joint origins most formats share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.files import NotSavedResultError, read_saved_result_json
from minimax_cal.fitting.opened_results import OpenedResult, ResultOrFile, open_result
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, build_measurements_at_rest
from minimax_cal.modelling.effects.compliance import JOINT_COMPLIANCE, is_stiffening_choice
from minimax_cal.modelling.effects.scene import joint_index_from_place
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.transforms import (
    MAX_EQUAL_TRANSFORM_DIFFERENCE,
    a_alpha_beta_transform,
    theta_d_transform,
)
from minimax_cal.robots.urdf_file import Urdf
from minimax_cal.robots.urdf_robot import is_urdf_or_mjcf_source, load_urdf


@dataclass(frozen=True, eq=False)
class ExportJob:
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
class ExportedFile:
    """A file's content, and what people should know about it.

    beside: contents of files that belong to it, by the ending that takes the place of its own.
    point_deviations: how far (m, k, 3) its targets stand from the formulas of the fit at measured
    poses, as the instrument sees it [m]; None where they stand where these say, or no simulator is
    there.
    """

    content: bytes
    notices: tuple[str, ...] = ()
    beside: Mapping[str, bytes] = field(default_factory=dict)
    point_deviations: Callable[[Measurements], Array] | None = None

    @staticmethod
    def from_text(text: str, *notices: str) -> ExportedFile:
        """From text."""
        return ExportedFile(text.encode("utf-8"), notices)


def open_export_source(
    source: ResultOrFile | Robot, step_number: int | None = None
) -> OpenedResult | ExportJob:
    """A result, or its file, opened; of any robot that `load_robot` takes the job itself.

    Raises CalibrationError.
    """
    if isinstance(source, Robot):
        return ExportJob(source, source, source.name, np.full(source.joints, np.nan))
    if not isinstance(source, Path | str):
        return open_result(source, step_number)
    path = Path(source)
    if path.suffix.lower() == ".json" and path.is_file():
        with suppress(NotSavedResultError):  # load_robot says what is wrong with it
            if {"targets_mm", "kind"} & set(read_saved_result_json(path)):
                return open_result(path, step_number)
    robot = load_robot(source)
    notices = load_urdf(source).notices if is_urdf_or_mjcf_source(source) else ()
    return ExportJob(robot, robot, str(source), np.full(robot.joints, np.nan), notices=notices)


def build_export_job(
    source: str, cell: Cell, nominal: Cell | None = None, q: Array | None = None
) -> ExportJob:
    """Of an arm; its nominal robot may be unknown.  q: (m, n) poses of the fit [rad, m]."""
    before = nominal.robot if nominal else cell.robot
    return ExportJob(
        cell.robot,
        before,
        source,
        joint_compliances(cell),
        fitted=nominal is not None,
        cell=cell,
        q=q,
    )


def joint_compliances(cell: Cell) -> Array:
    """(n,) turn per torque of each joint's whole load [rad/(N m)].

    NaN where none was fitted, or where the joint stiffens.
    """
    out = np.full(cell.robot.joints, np.nan)
    scene = cell.pose_arm(
        build_measurements_at_rest(np.zeros((1, cell.robot.joints)), cell.target_names, cell.robot)
    )
    compliances = cell.effects.select_terms(lambda term: term.effect == JOINT_COMPLIANCE.name)
    for term, values in compliances.terms_with_values:
        for name, value in zip(term.columns(scene).names, values, strict=True):
            if name[1:].isdigit():
                out[int(name[1:]) - 1] = value
    for term in compliances.terms:
        if is_stiffening_choice(term.choice):
            out[joint_index_from_place(term.place)] = np.nan
    return out


def joint_origins(robot: Robot) -> Array:
    """Where each joint lies in the link before it, at joint values 0: (n + 1, 4, 4) [m].

    Joint i turns or slides along z of origin i (backwards where its sign is -1); the last one is
    the flange.  Parallel axes stay near: beta is part of the rotation.
    """
    tails = [np.eye(4), *map(a_alpha_beta_transform, robot.mdh)]
    heads = [*map(theta_d_transform, robot.mdh), np.eye(4)]
    return np.array([before @ after for before, after in zip(tails, heads, strict=True)])


def list_joint_names(robot: Robot) -> tuple[str, ...]:
    """joint_1 ... joint_n."""
    return tuple(f"joint_{i + 1}" for i in range(robot.joints))


def is_identity_transform(pose: Array) -> bool:
    """Whether a transform does nothing, to rounding."""
    return bool(np.abs(pose - np.eye(4)).max() <= MAX_EQUAL_TRANSFORM_DIFFERENCE)


def format_exact_number(value: float) -> str:
    """A number that reads back as the same one."""
    return repr(float(value) + 0.0)


def format_number_triple(values: Array) -> str:
    """Three numbers for XML."""
    return " ".join(map(format_exact_number, values))


def escape_xml_text(text: str) -> str:
    """Text as a value in XML."""
    for letter, name in (("&", "amp"), ("<", "lt"), (">", "gt"), ('"', "quot")):
        text = text.replace(letter, f"&{name};")
    return "".join(letter for letter in text if letter.isprintable())
