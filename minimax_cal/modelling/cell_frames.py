"""Where base and tool of a calibrated arm stand, and by how much that corrects the drawn arm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table
from minimax_cal.modelling.cell import Cell
from minimax_cal.robots.transforms import (
    Frame,
    build_frame_tables,
    build_transform,
    invert_transform,
    nearest_rotations,
)

MAX_COLLINEAR_WIDTH_RATIO = (
    0.02  # width over length of reflectors from which their turn is told; as `checks.collinear`
)
# of the frames' names
NOMINAL_SUFFIX, CORRECTION_SUFFIX, WITH_EFFECTS_SUFFIX, SESSION_PREFIX = (
    "_nominal",
    "_correction",
    "_with_effects",
    "session ",
)
FRAME_SUFFIX_WORDS = {
    NOMINAL_SUFFIX: " of the drawn arm",
    CORRECTION_SUFFIX: " correction",
    WITH_EFFECTS_SUFFIX: ", with effects",
}


def build_cell_frames(cell: Cell, nominal_cell: Cell | None) -> dict[str, Frame]:
    """Frames by name: base, tool, those of the drawn arm, the corrections, further instruments.

    Base in the instrument's frame (of the first session), tool in the flange's, a correction in the
    frame that it corrects, the instrument of a further session in that of the first.  The tool
    stands where the reflectors have their centroid; it is turned as the flange for the drawn arm,
    and as the reflectors say against that for the calibrated one.  Fewer than three reflectors, or
    ones on a line, make no tool.  nominal_cell: None where it is not known.
    """
    frames = frame_with_nominal_and_correction(
        "base", cell.base, nominal_cell.base if nominal_cell else None
    )
    if (
        nominal_cell is not None
        and nominal_cell.target_positions.shape == cell.target_positions.shape
    ):
        frames |= frame_with_nominal_and_correction(
            "tool", *fit_tool_poses(cell.target_positions, nominal_cell.target_positions)
        )
    later = list(cell.sessions.frames.items())[1:]
    return frames | {f"{SESSION_PREFIX}{label}": Frame.from_pose(pose) for label, pose in later}


def frame_with_nominal_and_correction(
    name: str, pose: Array | None, nominal_pose: Array | None
) -> dict[str, Frame]:
    """A frame, the same of the drawn arm, and the correction that leads from this one to it."""
    out = {} if pose is None else {name: Frame.from_pose(pose)}
    if pose is not None and nominal_pose is not None:
        correction = Frame.from_pose(invert_transform(nominal_pose) @ pose)
        out |= {
            f"{name}{NOMINAL_SUFFIX}": Frame.from_pose(nominal_pose),
            f"{name}{CORRECTION_SUFFIX}": correction,
        }
    return out


class ToolPoses(NamedTuple):
    """(4, 4) poses of the reflectors as one body, or None."""

    calibrated: Array | None
    nominal: Array | None


def fit_tool_poses(calibrated_points: Array, nominal_points: Array) -> ToolPoses:
    """(4, 4) of the reflectors as one body, calibrated and drawn; None where they tell no turn.

    calibrated_points, nominal_points: (k, 3) in the flange [m].
    """
    new, old = (
        calibrated_points - calibrated_points.mean(axis=0),
        nominal_points - nominal_points.mean(axis=0),
    )
    if len(calibrated_points) < 3 or any(is_nearly_collinear(each) for each in (new, old)):
        return ToolPoses(None, None)
    turn = nearest_rotations(new.T @ old)
    return ToolPoses(
        build_transform(turn, calibrated_points.mean(axis=0)),
        build_transform(np.eye(3), nominal_points.mean(axis=0)),
    )


def name_frames_with_effects(frames: Mapping[str, Frame]) -> dict[str, Frame]:
    """The frames that a fit with effects changes, under names that say so."""
    fixed = (NOMINAL_SUFFIX, SESSION_PREFIX)
    return {
        f"{n}{WITH_EFFECTS_SUFFIX}": f
        for n, f in frames.items()
        if not any(part in n for part in fixed)
    }


def is_nearly_collinear(centred_points: Array) -> bool:
    """Whether points (k, 3) about their centroid lie nearly on a line."""
    size = np.linalg.svd(centred_points, compute_uv=False)
    return bool(size[1] <= MAX_COLLINEAR_WIDTH_RATIO * size[0])


def build_cell_frame_tables(frames: Mapping[str, Frame]) -> tuple[Table, ...]:
    """Frames for people; none without a base."""
    if "base" not in frames:
        return ()
    away = f"frames: the base is {frames['base'].origin_distance_mm:.3f} mm from the instrument"
    tool = ", tool in the flange's" if "tool" in frames else ""
    return build_frame_tables(
        {format_frame_name(name): frame for name, frame in frames.items()},
        f"{away}; base in the instrument's frame{tool}, a correction in the frame of the drawn arm",
    )


def format_frame_name(name: str) -> str:
    """A frame's name for people."""
    if name.startswith(SESSION_PREFIX):
        return f"instrument of {name}"
    for part, said in FRAME_SUFFIX_WORDS.items():
        name = name.replace(part, said)
    return name
