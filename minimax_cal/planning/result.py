"""The result of planning: which poses to measure, in which order, and what they will tell."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.files import write_file_atomically
from minimax_cal.core.record_fields import (
    FieldFormat,
    StoredSeparately,
    derived_field,
    scale_numbers,
)
from minimax_cal.core.results import Result
from minimax_cal.core.tables import Table, columns_to_records
from minimax_cal.modelling.cell import Cell
from minimax_cal.planning.candidate_poses import CandidatePoses
from minimax_cal.planning.plan_figures import (
    OBSERVABILITY_INDEX_NAMES,
    Growth,
    PlannedAndRandom,
    Separation,
)
from minimax_cal.planning.pose_information import PlanningNoise
from minimax_cal.planning.visit_route import VisitSequence, build_stop_rows, format_rounded_csv

SEPARATION_CRITERION = "separate"  # the criterion that is a power: the larger the better
CRITERION_MEANINGS = {
    "D": "geometric mean of the parameters' sigma, each as motion of a target",
    "A": "mean of the parameters' sigma, each as motion of a target",
    "E": "largest sigma of any combination of parameters, as motion of a target",
    "G": "largest sigma of a position in the workspace",
    "I": "mean sigma of a position in the workspace",
    SEPARATION_CRITERION: "power to tell the effects apart",
}


class TravelLengths(NamedTuple):
    """Of the largest joint moves through all poses [rad]."""

    ordered: float
    as_chosen: float


@dataclass(frozen=True, eq=False)
class Plan(Result):
    """Poses to measure.

    cell: the robot, its base and targets as assumed.  criterion: a key of MEANINGS.
    q: (N, n) the poses in the order of visiting [rad, m].  seen: (N, k) targets seen there.
    expected: (N, k, 3) where [m].  visits: every stop, revisits included.
    size: of the criterion, a variance [m^2] (one over the power).  bound: no N candidates are
    below it.  random: median of random candidates.  equal: how many random ones tell as much.
    names, sigma: identifiable parameters and their predicted sigma [m, rad].
    indices: observability.  growth: with the number of poses.
    candidates: what was chosen from.  instrument: noise that was assumed, place: (3,) where it
    stands in base axes [m].  at_hand: number of poses measured before, which count.
    """

    KIND = "plan"

    cell: StoredSeparately[Cell]
    criterion: str
    q: Array
    seen: Array
    expected: StoredSeparately[Array]
    visits: VisitSequence
    size: StoredSeparately[float]
    bound: StoredSeparately[float]
    random: StoredSeparately[float]
    equal: Annotated[float, FieldFormat(key="worth_random_poses")]
    names: StoredSeparately[tuple[str, ...]]
    sigma: StoredSeparately[Array]
    indices: Annotated[Mapping[str, PlannedAndRandom], FieldFormat(key="observability")]
    growth: tuple[Growth, ...]
    separation: tuple[Separation, ...]
    candidates: CandidatePoses
    instrument: PlanningNoise
    place: StoredSeparately[Array]
    travel: Annotated[TravelLengths, FieldFormat(unit="rad")]
    at_hand: int
    settings: Mapping[str, object]
    notices: tuple[str, ...]
    seconds: float

    @derived_field()
    def poses(self) -> int:
        """N."""
        return len(self.q)

    @derived_field(key="efficiency_at_least")
    def efficiency(self) -> float:
        """Bound over size: so much of the best possible is sure."""
        return min(1.0, self.bound / self.size)

    @property
    def here(self) -> Growth:
        """The row of `growth` with as many poses as planned."""
        return next(row for row in self.growth if row.poses == self.poses)

    def shown(self, size: float) -> float:
        """A size as people read it: a power, or a sigma [um]."""
        return 1.0 / size if self.criterion == SEPARATION_CRITERION else 1e6 * float(np.sqrt(size))

    def headline(self) -> str:
        """The plan in a few sentences."""
        robot, here = self.cell.robot.name, self.here
        more = f" in addition to {self.at_hand} existing ones" if self.at_hand else ""
        out = [
            f"{robot}: {self.poses} poses{more}, at least {100.0 * self.efficiency:.1f} % as good "
            f"as the best {self.poses} of {len(self.candidates.q)} candidates.",
            f"Predicted sigma of a position over the workspace: mean {1e6 * here.mean[0]:.1f} um, "
            f"worst {1e6 * here.worst[0]:.1f} um; {self.poses} random poses: "
            f"{1e6 * here.mean[1]:.1f} and {1e6 * here.worst[1]:.1f} um.",
        ]
        if np.isfinite(self.equal):
            out.append(f"By the criterion they are worth {self.equal:.0f} random poses.")
        elif 4 * self.poses <= self.candidates.drawn:
            out.append(f"By the criterion they are worth more than {4 * self.poses} random poses.")
        out += [separation.headline() for separation in self.separation]
        return " ".join(out)

    # ---- tables --------------------------------------------------------------------------------

    def criterion_table(self) -> Table:
        """The criterion: planned, random, and what no choice of candidates beats."""
        own, unit = self.criterion, "" if self.criterion == SEPARATION_CRITERION else "um"
        sizes = map(self.shown, (self.size, self.random, self.bound))
        others = (
            (CRITERION_MEANINGS[name], "um", *scale_numbers(both, 1e6), None)
            for name, both in (("I", self.here.mean), ("G", self.here.worst))
            if name != own
        )
        rows = [(f"{own}: {CRITERION_MEANINGS[own]}", unit, *sizes), *others]
        columns = "what | unit | planned .4g | random (median) .4g | no choice is better than .4g"
        return Table.from_rows(f"{self.poses} poses by criterion {own}", rows, columns)

    def growth_table(self) -> Table:
        """How accuracy grows with the number of poses."""
        more = self.criterion not in ("G", "I")
        rows = (
            (
                g.poses,
                *scale_numbers((*g.mean, *g.worst), 1e6),
                *(map(self.shown, g.size) if more else ()),
            )
            for g in self.growth
        )
        own = "power" if self.criterion == SEPARATION_CRITERION else f"{self.criterion} um"
        names = ("mean um", "worst um", own) if more else ("mean um", "worst um")
        heads = (f"{name}, {which} .4g" for name in names for which in ("planned", "random"))
        title = "predicted sigma of a position over the workspace"
        return Table.from_rows(title, rows, "poses d", *heads)

    def index_table(self) -> Table:
        """Observability indices of the poses."""
        return Table.from_rows(
            "observability indices of these poses alone (parameters by the motion they give)",
            [
                (name, OBSERVABILITY_INDEX_NAMES[name], *values)
                for name, values in self.indices.items()
            ],
            "index | what | planned .4g | random (median) .4g",
        )

    def pose_table(self, unit: str = "deg") -> Table:
        """Every stop, in order."""
        header, rows = build_stop_rows(self.visits, self.cell, self.expected, unit)
        title, n = f"stops in order, travel {self.travel.ordered:.1f} rad", 2 + self.q.shape[1]
        heads = (f"{name} .3f" for name in header[2:n])
        return Table.from_rows(title, [row[:n] for row in rows], "order d | pose", *heads)

    def tables(self) -> tuple[Table, ...]:
        """Every table but the poses themselves."""
        shown = self.criterion_table(), self.growth_table(), self.index_table()
        return (*shown, self.candidates.rejection_table())

    # ---- files ---------------------------------------------------------------------------------

    def csv(self, unit: str = "deg") -> str:
        """The stops as CSV.  unit: of turning joints."""
        return format_rounded_csv(*build_stop_rows(self.visits, self.cell, self.expected, unit))

    def save_csv(self, path: Path | str, unit: str = "deg") -> None:
        """Write the stops; never a half-written file."""
        write_file_atomically(path, self.csv(unit))

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """Names, units, sizes and sigmas."""
        unit = "power" if self.criterion == SEPARATION_CRITERION else "sigma_um"
        sizes = {"planned": self.size, "random": self.random, "bound": self.bound}
        return {
            "robot": self.cell.robot.name,
            "targets": self.cell.target_names,
            "q_units": ["m" if sliding else "rad" for sliding in self.cell.robot.prismatic],
            "value": {f"{name}_{unit}": self.shown(size) for name, size in sizes.items()},
            "parameters": columns_to_records({"name": self.names, "sigma": self.sigma}),
            "instrument": {"place_in_base_mm": 1e3 * self.place},
        }
