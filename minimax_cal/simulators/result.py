"""How far a simulated arm is from the real one, rung by rung."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any

from minimax_cal.fitting.fit import Provenance
from minimax_cal.ground.facts import Fact, derived
from minimax_cal.ground.results import Result
from minimax_cal.ground.tables import Table
from minimax_cal.modelling.effects.words import name_step
from minimax_cal.solvers.status import Status

HOLDS, HOLDS_MM = 0.1, 0.02  # of an error: a simulator that holds what a fit claims [-, mm]


@dataclass(frozen=True)
class Rung:
    """How far the simulator misses with a model, base and targets fitted to the training poses.

    why: what is wrong, or what this rung mends.  holdout_*, train_*: distances [mm].  sag_mrad:
    largest that a joint stands from its command.  predicted_rms_mm: held out, by the formulas of
    the fit, NaN where there is none.  moving_poses: at which the arm did not come to rest.
    at_limit: largest share of the timesteps at which a joint was at its force limit.
    """

    name: str
    holdout_rms_mm: float
    holdout_max_mm: float
    train_rms_mm: float
    train_max_mm: float
    sag_mrad: float
    predicted_rms_mm: float = math.nan
    why: str = ""
    moving_poses: int = 0
    at_limit: float = 0.0

    @property
    def holds(self) -> bool:
        """Whether the simulator does what the formulas of the fit say; True where none do."""
        off = abs(self.holdout_rms_mm - self.predicted_rms_mm)
        return not off > max(HOLDS * self.predicted_rms_mm, HOLDS_MM)


@dataclass(frozen=True, eq=False, repr=False)
class SimulatorGap(Result):
    """The gap between a simulator's model and measurements, as a ladder in the simulator itself.

    rungs: as given, without servo sag, with calibrated geometry, with each effect.  commands: the
    last of them with its command map, None where nothing is mapped.  floor: what noise alone would
    leave [mm], floor_from: how that is known.  status: of the last fit.  beyond: its claim for
    poses where none was measured, by its own formulas.  left_out: effects that the simulator has no
    element for.  written: where the last step's model was written, empty where it was not.
    """

    KIND = "simulator_gap"
    COMMAND = "gap"
    model: str
    robot: str
    rungs: Annotated[tuple[Rung, ...], Fact(fewest=1)]
    commands: Annotated[Rung | None, Fact(key="with_commands")]
    floor: Annotated[float, Fact(key="noise_floor_mm")]
    floor_from: Annotated[str, Fact(key="noise_floor_from")]
    train_poses: Annotated[int, Fact(key="poses.train")]
    holdout_poses: Annotated[int, Fact(key="poses.holdout")]
    status: Status
    beyond: Mapping[str, Any]
    left_out: tuple[str, ...]
    notices: tuple[str, ...]
    written: str
    seconds: float
    provenance: Provenance

    def __repr__(self) -> str:
        return f"<SimulatorGap of {self.model}: {self.headline()}>"

    @property
    def every(self) -> tuple[Rung, ...]:
        """The rungs, and the one with the command map."""
        return (*self.rungs, *([self.commands] if self.commands else []))

    @derived()
    def holds(self) -> bool:
        """Whether what was corrected last, and its command map, do what the fit claims."""
        return self.rungs[-1].holds and (self.commands is None or self.commands.holds)

    def table(self) -> Table:
        """The ladder."""
        ladder = Table.of(
            f"{self.robot} in the simulator: errors on {self.holdout_poses} held-out poses",
            [(name_step(rung.name), rung) for rung in self.every],
            "0=model | 1.holdout_rms_mm=RMS mm .4f | 1.holdout_max_mm=max mm .4f | "
            "1.predicted_rms_mm=fit says mm .4f | 1.sag_mrad=joints off mrad .3f | 1.why=",
        )
        noise = ("noise floor", self.floor, None, None, None, self.floor_from)
        return ladder.plus(noise) if math.isfinite(self.floor) else ladder

    def first_tables(self) -> tuple[Table, ...]:
        """The ladder, without what explains its rungs."""
        return (self.table().brief("model", "RMS mm", "max mm", "fit says mm"),)

    def headline(self) -> str:
        """The result in a sentence or two."""
        first, last = self.rungs[0], self.rungs[-1]
        text = (
            f"As given, the simulated arm misses the real one by {first.holdout_rms_mm:.3f} mm RMS "
            f"on {self.holdout_poses} held-out poses (largest {first.holdout_max_mm:.3f} mm)"
        )
        falls = [a.holdout_rms_mm - b.holdout_rms_mm for a, b in pairwise(self.rungs)]
        if falls:
            most = max(range(len(falls)), key=falls.__getitem__)
            text += (
                f"; corrected, by {last.holdout_rms_mm:.3f} mm (largest {last.holdout_max_mm:.3f} "
                f"mm). Most is gained by: {name_step(self.rungs[most + 1].name)}"
            )
        if self.commands:
            text += f". With its command map {self.commands.holdout_rms_mm:.3f} mm remain"
        typical, worst = (self.beyond.get(key) for key in ("typical_mm", "worst_mm"))
        if typical is not None and worst is not None:
            text += (
                f". Outside the measured region its fit claims RMS {typical:.3f} mm, worst region "
                f"{worst:.3f} mm RMS ({self.beyond.get('worst_where')})"
            )
        elif self.beyond.get("narrow"):
            text += f". Outside the measured region nothing is claimed: {self.beyond['reason']}"
        return text + "."
