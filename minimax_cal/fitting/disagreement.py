"""What differs between the files of one fit that do not agree on the arm."""

from __future__ import annotations

from dataclasses import dataclass

from minimax_cal.ground.units import for_people

SCALE, JOINT_ZERO = "scale", "joint_zero"


@dataclass(frozen=True)
class Cause:
    """What is otherwise in the first of the files than in the others.

    kind: scale, joint_zero, base, clock or order_of_angles.  place: a joint, as J3, or a file.
    by: how much [SI].
    """

    kind: str
    place: str
    by: float
    unit: str

    @property
    def sentence(self) -> str:
        """For people."""
        scale, unit = for_people(self.unit)
        if self.kind == SCALE:
            long = "longer" if self.by > 0.0 else "shorter"
            return (
                f"all lengths of {self.place} are {abs(100.0 * self.by):.3g} % {long}: check the "
                "scale, the units and the temperature compensation"
            )
        return (
            f"the zero of {self.place.replace('J', 'joint ')} differs by {scale * self.by:+.3g} "
            f"{unit}: check what moved between the files, or calibrate from one"
        )


@dataclass(frozen=True)
class Contradiction:
    """Files that each fit an arm and not one together.

    p: of so much by noise and by an arm that bends.  cause: None where no single one explains it.
    """

    files: tuple[str, ...]
    p: float
    cause: Cause | None = None

    @property
    def sentence(self) -> str:
        """For people."""
        first, *others = self.files
        if not others:
            why = self.cause.sentence if self.cause else "its scale is not that of the arm"
            return f"{first} contradicts the drawn arm (p = {self.p:.0e}): {why}"
        why = (
            self.cause.sentence
            if self.cause
            else "no single zero or scale explains it; calibrate from each alone and compare"
        )
        return (
            f"{first} and {' and '.join(others)} each fit an arm, and not one together "
            f"(p = {self.p:.0e}): {why}"
        )
