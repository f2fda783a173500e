"""Two calibrations of an arm side by side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from minimax_cal.ground.files import plain
from minimax_cal.ground.results import Result
from minimax_cal.ground.tables import Table
from minimax_cal.ground.units import for_people, in_files
from minimax_cal.judging.watching.moved import Moved, moved_table
from minimax_cal.measuring.accuracy import Accuracy


@dataclass(frozen=True)
class Difference:
    """B minus A of one parameter, in a common choice of what is kept [SI].

    sigma: NaN, with a reason, where it cannot be compared.
    """

    parameter: str
    unit: str
    a: float
    b: float
    sigma: float
    reason: str = ""

    @property
    def by(self) -> float:
        """B minus A [SI]."""
        return self.b - self.a

    @property
    def sigmas(self) -> float:
        """The same in sigmas."""
        return self.by / self.sigma

    @property
    def scale(self) -> tuple[float, str]:
        """As people read it."""
        return for_people(self.unit)

    def to_dict(self) -> dict[str, Any]:
        """For JSON: lengths in mm, angles in rad."""
        scale, unit = in_files(self.unit)
        told = {"parameter": self.parameter, "unit": unit, "a": scale * self.a, "b": scale * self.b}
        told |= {"by": scale * self.by, "sigma": scale * self.sigma, "sigmas": self.sigmas}
        return told | ({"reason": self.reason} if self.reason else {})


@dataclass(frozen=True, eq=False)
class Comparison(Result):
    """Two calibrations side by side.

    differences: of every link parameter.  changed: those that explain them, the clearest first.
    accuracy: of A and of B on the poses of A and of B, base and reflectors placed anew for both.
    same: chance of such differences where nothing changed.
    """

    names: tuple[str, str]
    robot: str
    differences: tuple[Difference, ...]
    changed: tuple[Moved, ...]
    accuracy: tuple[tuple[str, Accuracy, Accuracy], ...]
    same: float
    notices: tuple[str, ...]

    @property
    def joints(self) -> tuple[str, ...]:
        """That changed, as J3."""
        return tuple(dict.fromkeys(c.joint for c in self.changed))

    def headline(self) -> str:
        """The result in a sentence or two."""
        a, b = self.names
        if not self.changed:
            return f"{self.robot}: no joint differs between {a} and {b} by more than chance allows."
        told = ", ".join(
            f"{c.parameter} by {1e3 * c.by:+.3f} {for_people(c.unit)[1]}" for c in self.changed
        )
        return f"{self.robot}: {', '.join(self.joints)} changed from {a} to {b} ({told})."

    def first_table(self) -> Table:
        """What changed, by how much; where nothing did, the accuracy on common poses."""
        if self.changed:
            return self.changed_table().brief(
                "parameter", "by", "unit", "sigma", "p-value", "or as well"
            )
        return self.common_table().brief()

    def changed_table(self) -> Table:
        """The parameters that explain the differences."""
        return moved_table("parameters that explain the differences", self.changed)

    def common_table(self) -> Table:
        """The accuracy of both on common poses."""
        return Table(
            "the same poses; base and reflectors may have moved",
            ("poses", "count", "A RMS mm", "A max mm", "B RMS mm", "B max mm"),
            tuple(
                (where, one.poses, one.rms_mm, one.max_mm, other.rms_mm, other.max_mm)
                for where, one, other in self.accuracy
            ),
            ("", "d", *[".4f"] * 4),
        )

    def tables(self) -> tuple[Table, ...]:
        """Which joints changed, accuracy on common poses, every parameter."""
        each = Table(
            f"A: {self.names[0]}, B: {self.names[1]}",
            ("parameter", "unit", "A", "B", "B - A", "sigma", "in sigmas", "not compared because"),
            tuple(
                (d.parameter, d.scale[1], d.scale[0] * d.a, d.scale[0] * d.b, d.scale[0] * d.by,
                 d.scale[0] * d.sigma, d.sigmas, d.reason)
                for d in self.differences
            ),
            ("", "", ".4f", ".4f", "+.4f", ".2g", "+.1f", ""),
        )  # fmt: skip
        return tuple(
            table for table in (self.changed_table(), self.common_table(), each) if table.rows
        )

    def to_dict(self) -> dict[str, Any]:
        """For JSON: lengths in mm, angles in rad."""
        return dict(
            plain(
                {
                    "schema": 1,
                    "kind": "comparison",
                    "robot": self.robot,
                    "a": self.names[0],
                    "b": self.names[1],
                    "changed": [c.to_dict() for c in self.changed],
                    "p_value_nothing_changed": self.same,
                    "parameters": [d.to_dict() for d in self.differences],
                    "accuracy": [
                        {"poses": where, "a": one.to_dict(), "b": other.to_dict()}
                        for where, one, other in self.accuracy
                    ],
                    "notices": list(self.notices),
                }
            )
        )
