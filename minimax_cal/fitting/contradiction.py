"""What differs between the files of one fit that do not agree on the arm."""

from __future__ import annotations

import math
from dataclasses import dataclass

from minimax_cal.core.units import display_unit_of_change

SCALE, JOINT_ZERO, BASE = "scale", "joint_zero", "base"
CLOCK, ORDER_OF_ANGLES = "clock", "order_of_angles"
# Frames of two files that are nearer are one frame in which the base moved: nobody sets up an
# instrument again so near to where it stood.
MAX_SHIFT_OF_BASE, MAX_TURN_OF_BASE = 0.02, math.radians(1.0)  # [m, rad]
# By less nothing moved: a stand of steel, 2 m high, grows by so much in 10 K.
MIN_SHIFT_OF_BASE, MIN_TURN_OF_BASE = 0.25e-3, 0.25e-3  # [m, rad]


@dataclass(frozen=True)
class ContradictionCause:
    """What is otherwise in the first of the files than in the others.

    kind: scale, joint_zero, base, clock or order_of_angles.  place: a joint, as J3, or a file.
    by: how much [SI].  mend: what to do, empty where the kind says it.
    """

    kind: str
    place: str
    by: float
    unit: str
    mend: str = ""

    @property
    def sentence(self) -> str:
        """For people."""
        scale, unit = display_unit_of_change(self.unit)
        if self.kind == SCALE:
            long = "longer" if self.by > 0.0 else "shorter"
            return (
                f"all lengths of {self.place} are {abs(100.0 * self.by):.3g} % {long}: check the "
                "scale, the units and the temperature compensation"
            )
        if self.kind == BASE:
            return (
                f"base or instrument moved by {scale * self.by:.3g} {unit} before {self.place}: "
                "check what moved; this fit has a frame for each file, so that its arm holds if "
                "nothing else moved"
            )
        if self.kind == CLOCK:
            late = "later" if self.by > 0.0 else "earlier"
            return (
                f"{self.place} was measured {abs(scale * self.by):.3g} {unit} {late} than its "
                "joints were read: check the clocks of robot and instrument"
            )
        if self.kind == ORDER_OF_ANGLES:
            return f"{self.place}: {self.mend}"
        return (
            f"the zero of {self.place.replace('J', 'joint ')} differs by {scale * self.by:+.3g} "
            f"{unit}: check what moved between the files, or calibrate from one"
        )


@dataclass(frozen=True)
class Contradiction:
    """Files that each fit an arm and not one together; with a base that moved, not in one frame.

    p: of so much by noise and by an arm that bends.  cause: None where no single one explains it.
    """

    files: tuple[str, ...]
    p: float
    cause: ContradictionCause | None = None

    @property
    def sentence(self) -> str:
        """For people."""
        first, *others = self.files
        if not others:
            why = self.cause.sentence if self.cause else "its scale is not that of the arm"
            return f"{first} contradicts the drawn arm (p = {self.p:.0e}): {why}"
        if self.cause and self.cause.kind == BASE:
            return f"{first} and {' and '.join(others)} are of one frame, but {self.cause.sentence}"
        why = (
            self.cause.sentence
            if self.cause
            else "no single zero, scale or delay explains it; calibrate from each alone and compare"
        )
        return (
            f"{first} and {' and '.join(others)} each fit an arm, and not one together "
            f"(p = {self.p:.0e}): {why}"
        )


def has_base_moved(shift: float, turn: float, p: float, max_p: float) -> bool:
    """Whether two files are of one frame in which the base moved.

    shift: [m], turn: [rad] between where it stood.  p: of so much by chance.
    """
    is_near = shift < MAX_SHIFT_OF_BASE and turn < MAX_TURN_OF_BASE
    return p < max_p and is_near and (shift > MIN_SHIFT_OF_BASE or turn > MIN_TURN_OF_BASE)
