"""Where base and tool of a calibrated arm stand, and by how much that corrects the drawn arm."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Table
from minimax_cal.modelling.cell import Cell
from minimax_cal.robots.transforms import Frame, frames_tables, inverse, nearest_rotation, transform

FLAT = 0.02  # width over length of reflectors from which their turn is told; as `checks.collinear`
# of the frames' names
DRAWN, CORRECTION, WHOLE, SESSION = "_nominal", "_correction", "_with_effects", "session "
IN_WORDS = {DRAWN: " of the drawn arm", CORRECTION: " correction", WHOLE: ", with effects"}


def frames_of(cell: Cell, nominal: Cell | None) -> dict[str, Frame]:
    """Frames by name: base, tool, those of the drawn arm, the corrections, further instruments.

    Base in the instrument's frame (of the first session), tool in the flange's, a correction in the
    frame that it corrects, the instrument of a further session in that of the first.  The tool
    stands where the reflectors have their centroid; it is turned as the flange for the drawn arm,
    and as the reflectors say against that for the calibrated one.  Fewer than three reflectors, or
    ones on a line, make no tool.  nominal: None where it is not known.
    """
    frames = paired("base", cell.base, nominal.base if nominal else None)
    if nominal is not None and nominal.target_positions.shape == cell.target_positions.shape:
        frames |= paired("tool", *tools(cell.target_positions, nominal.target_positions))
    later = list(cell.sessions.frames.items())[1:]
    return frames | {f"{SESSION}{label}": Frame.of(pose) for label, pose in later}


def paired(name: str, pose: Array | None, drawn: Array | None) -> dict[str, Frame]:
    """A frame, the same of the drawn arm, and the correction that leads from this one to it."""
    out = {} if pose is None else {name: Frame.of(pose)}
    if pose is not None and drawn is not None:
        correction = Frame.of(inverse(drawn) @ pose)
        out |= {f"{name}{DRAWN}": Frame.of(drawn), f"{name}{CORRECTION}": correction}
    return out


def tools(after: Array, before: Array) -> tuple[Array | None, Array | None]:
    """(4, 4) of the reflectors as one body, calibrated and drawn; None where they tell no turn.

    after, before: (k, 3) in the flange [m].
    """
    new, old = after - after.mean(axis=0), before - before.mean(axis=0)
    if len(after) < 3 or any(is_thin(each) for each in (new, old)):
        return None, None
    turn = nearest_rotation(new.T @ old)
    return transform(turn, after.mean(axis=0)), transform(np.eye(3), before.mean(axis=0))


def with_effects(frames: Mapping[str, Frame]) -> dict[str, Frame]:
    """The frames that a fit with effects changes, under names that say so."""
    fixed = (DRAWN, SESSION)
    return {f"{n}{WHOLE}": f for n, f in frames.items() if not any(part in n for part in fixed)}


def is_thin(centred: Array) -> bool:
    """Whether points (k, 3) about their centroid lie nearly on a line."""
    size = np.linalg.svd(centred, compute_uv=False)
    return bool(size[1] <= FLAT * size[0])


def tables_of(frames: Mapping[str, Frame]) -> tuple[Table, ...]:
    """Frames for people; none without a base."""
    if "base" not in frames:
        return ()
    away = f"frames: the base is {frames['base'].distance_mm:.3f} mm from the instrument"
    tool = ", tool in the flange's" if "tool" in frames else ""
    return frames_tables(
        {in_words(name): frame for name, frame in frames.items()},
        f"{away}; base in the instrument's frame{tool}, a correction in the frame of the drawn arm",
    )


def in_words(name: str) -> str:
    """A frame's name for people."""
    if name.startswith(SESSION):
        return f"instrument of {name}"
    for part, said in IN_WORDS.items():
        name = name.replace(part, said)
    return name
