"""Two calibrations of an arm side by side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

from minimax_cal.fitting.accuracy import Accuracy
from minimax_cal.ground.facts import Apart, Fact, derived, scaled
from minimax_cal.ground.results import Result
from minimax_cal.ground.tables import Table, filled
from minimax_cal.ground.units import for_people, in_own_unit
from minimax_cal.judging.watching.moved import FIRST, Moved, moved_table


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
    reason: Annotated[str, Fact(brief=True)] = ""

    @derived()
    def by(self) -> float:
        """B minus A [SI]."""
        return self.b - self.a

    @derived()
    def sigmas(self) -> float:
        """The same in sigmas."""
        return self.by / self.sigma

    def to_dict(self) -> dict[str, Any]:
        """For JSON: lengths in mm, angles in rad."""
        return in_own_unit(self, "a", "b", "by", "sigma")


class OnPoses(NamedTuple):
    """The accuracy of A and of B on some poses, base and reflectors placed anew for both."""

    poses: str
    a: Accuracy
    b: Accuracy


@dataclass(frozen=True, eq=False)
class Comparison(Result):
    """Two calibrations side by side.

    differences: of every link parameter.  changed: those that explain them, the clearest first.
    accuracy: on the poses of A and of B.  same: chance of such differences where nothing changed.
    """

    KIND = "comparison"

    names: Apart[tuple[str, str]]
    robot: str
    differences: Annotated[tuple[Difference, ...], Fact(key="parameters")]
    changed: tuple[Moved, ...]
    accuracy: tuple[OnPoses, ...]
    same: Annotated[float, Fact(key="p_value_nothing_changed")]
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

    def first_tables(self) -> tuple[Table, ...]:
        """What changed, by how much; where nothing did, the accuracy on common poses."""
        first = self.changed_table().brief(*FIRST) if self.changed else self.common_table().brief()
        return (first,)

    def changed_table(self) -> Table:
        """The parameters that explain the differences."""
        return moved_table("parameters that explain the differences", self.changed)

    def common_table(self) -> Table:
        """The accuracy of both on common poses."""
        return Table.of(
            "the same poses; base and reflectors may have moved",
            self.accuracy,
            "poses | a.poses=count d | a.rms_mm=A RMS mm .4f | a.max_mm=A max mm .4f | "
            "b.rms_mm=B RMS mm .4f | b.max_mm=B max mm .4f",
        )

    def tables(self) -> tuple[Table, ...]:
        """Which joints changed, accuracy on common poses, every parameter."""
        rows = (
            (d.parameter, unit, *scaled((d.a, d.b, d.by, d.sigma), scale), d.sigmas, d.reason)
            for d in self.differences
            for scale, unit in [for_people(d.unit)]
        )
        columns = "parameter | unit | A .4f | B .4f | B - A +.4f | sigma .2g | in sigmas +.1f"
        title = f"A: {self.names[0]}, B: {self.names[1]}"
        each = Table.made(title, rows, columns, "not compared because")
        return filled(self.changed_table(), self.common_table(), each)

    def beside(self, *, poses: bool = True) -> dict[str, Any]:
        """The names."""
        return dict(zip("ab", self.names, strict=True))
