"""The result of a diagnosis of several instruments, and its file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field

from minimax_cal.diagnosing.result import Explained, Finding
from minimax_cal.diagnosing.result_file import (
    FindingPart,
    NoisePart,
    StructurePart,
    UntestablePart,
)
from minimax_cal.diagnosing.sentences import explained
from minimax_cal.evidence.limits import LEVEL
from minimax_cal.fitting.fit_file import ScoresPart
from minimax_cal.fitting.instruments import RelativeCalibration
from minimax_cal.ground.files import finite
from minimax_cal.ground.records import Number, Part, checked, reading
from minimax_cal.ground.results import Result
from minimax_cal.ground.tables import Cell as TableCell
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.accuracy import Accuracy
from minimax_cal.modelling.effects.words import name_step
from minimax_cal.solvers.status import Status

RIVALS = ("effect", "alternative", "similarity", "power", "fits worse by")


class StepPart(Part):
    """One step of the error budget."""

    step: str
    holdout: ScoresPart
    files: dict[str, ScoresPart] = Field(default_factory=dict)

    def step_of(self) -> RelativeStep:
        """As the code has it."""
        files = {name: one.accuracy() for name, one in self.files.items()}
        return RelativeStep(self.step, self.holdout.accuracy(), files)


class BudgetPart(Part):
    """The error budget."""

    ladder: Annotated[tuple[StepPart, ...], Field(min_length=2)]


class FloorPart(Part):
    """What is left, and the noise that was given [mm]."""

    file: str = ""
    remaining_mm: Number = math.nan
    noise_floor_mm: Number = math.nan


class RelativeDiagnosisPart(Part):
    """The key diagnosis in the file of `minimax-cal relative --diagnose -o`."""

    verdict: Literal["none", "named", "one_of", "unknown"]
    status: Status
    meets_floor: bool | None = None
    floor: FloorPart = FloorPart()
    effects: tuple[FindingPart, ...]
    gap: BudgetPart
    noise: NoisePart = NoisePart()
    structure: StructurePart = StructurePart()
    not_testable: tuple[UntestablePart, ...] = ()
    seconds: Number = math.nan


@dataclass(frozen=True)
class RelativeStep:
    """One step of the error budget.  holdout: of all files; files: held out, of each by name."""

    name: str
    holdout: Accuracy
    files: Mapping[str, Accuracy]

    @staticmethod
    def of(name: str, found: RelativeCalibration, *, nominal: bool = False) -> RelativeStep:
        """Of a calibration, or of the drawn arm with its instruments fitted."""
        key = "nominal" if nominal else "holdout"
        files = {one.name: one.accuracy[key] for one in found.instruments}
        return RelativeStep(name, found.accuracy[key], files)


@dataclass(frozen=True, eq=False, repr=False)
class RelativeDiagnosis(Explained, Result):
    """What is still wrong with an arm that several instruments measured.

    calibration: with the effects that the budget took.  steps: nominal, geometric, then with each
    effect.  structure: probability that what remains is unrelated to what structure_in names.
    jitter: of a joint [rad].  meets_floor: whether the remaining error is down to the noise that
    was given, None where none was.  floor_file: that exceeds it most; floor_mm: what its numbers
    leave at least, and what noise and sound joints may add up to [mm].
    """

    calibration: RelativeCalibration
    status: Status
    verdict: str
    effects: tuple[Finding, ...]
    steps: tuple[RelativeStep, ...]
    structure: float
    structure_in: str
    jitter: float
    meets_floor: bool | None
    floor_file: str
    floor_mm: tuple[float, float]
    not_testable: tuple[tuple[str, str], ...]
    seconds: float

    def __repr__(self) -> str:
        return f"<RelativeDiagnosis of {self.calibration.robot.name}: {self.verdict}>"

    @property
    def excess(self) -> str:
        """What the last step leaves, against the noise that was given."""
        low, high = self.floor_mm
        where = f"{self.floor_file}: " if self.floor_file else ""
        return f"{where}at least {low:.3f} mm against at most {high:.3f} mm (given)"

    @property
    def notices(self) -> tuple[str, ...]:
        """What the reader should know."""
        return self.calibration.notices

    @property
    def reasons(self) -> tuple[str, ...]:
        """The verdict and why, in sentences."""
        return explained(self)

    def headline(self) -> str:
        """The verdict in words, and the held-out errors."""
        first, last = self.steps[1].holdout, self.steps[-1].holdout
        fall = f" -> {last.rms_mm:.3f} mm with the effects" if len(self.steps) > 2 else ""
        said = f"Held-out RMS error: geometry {first.rms_mm:.3f} mm{fall}."
        return " ".join([*self.reasons, said])

    def steps_table(self) -> Table:
        """The error budget, step by step, by file."""
        files = tuple(self.steps[0].files)
        rows: tuple[tuple[TableCell, ...], ...] = tuple(
            (name_step(step.name), step.holdout.rms_mm, step.holdout.max_mm,
             *(step.files[name].rms_mm for name in files))
            for step in self.steps
        )  # fmt: skip
        header = ("model", "RMS mm", "max mm", *(f"{name} RMS mm" for name in files))
        return Table(
            "error budget, held-out poses", header, rows, ("", *[".4f"] * (len(header) - 1))
        )

    def effects_table(self) -> Table:
        """The effects found, with what each does for held-out poses."""
        rows: tuple[tuple[TableCell, ...], ...] = tuple(
            (f.name, f.cause, 100.0 * f.share, f.before, f.after, f.chance, f.evidence)
            for f in self.effects
        )
        header = ("effect", "cause", "share of error %", "before mm", "after mm", "p-value",
                  "evidence")  # fmt: skip
        title = f"effects found; p-values below {LEVEL:g} are significant"
        return Table(title, header, rows, ("", "", ".0f", ".4f", ".4f", "", ""))

    def rival_table(self) -> Table:
        """What these data cannot tell from the effects found."""
        return super().rival_table().brief(*RIVALS)

    def own_tables(self) -> tuple[Table, ...]:
        """Those of the diagnosis."""
        every = (self.steps_table(), self.effects_table(), self.parameter_table(),
                 self.rival_table(), self.untestable_table())  # fmt: skip
        return tuple(table for table in every if table.rows)

    def first_tables(self) -> list[Table]:
        """What stands on the first screen."""
        found = [self.effects_table().brief("effect", "share of error %", "before mm", "after mm",
                                            "evidence")] if self.effects else []  # fmt: skip
        return [self.steps_table(), *found]

    def tables(self) -> tuple[Table, ...]:
        """Every table, those of the calibration last."""
        return (*self.own_tables(), *self.calibration.tables())

    def to_dict(self) -> dict[str, Any]:
        """The JSON of the calibration, with the key diagnosis."""
        return {**self.calibration.to_dict(), "diagnosis": self.own_dict()}

    def own_dict(self) -> dict[str, Any]:
        """The diagnosis alone, its keys as those of `Diagnosis` where they mean the same."""

        def held(kind: str) -> dict[str, float | None]:
            ends = {"nominal": 0, "geometric": 1, "final": -1}
            return {
                name: finite(getattr(self.steps[at].holdout, kind)) for name, at in ends.items()
            }

        return {
            "verdict": self.verdict,
            "status": str(self.status),
            "reasons": list(self.reasons),
            "floor_known": self.meets_floor is not None,
            "meets_floor": self.meets_floor,
            "floor": {
                "file": self.floor_file,
                "remaining_mm": finite(self.floor_mm[0]),
                "noise_floor_mm": finite(self.floor_mm[1]),
            },
            "effects": [found.to_dict() for found in self.effects],
            "gap": {
                "holdout_rms_mm": held("rms_mm"),
                "holdout_max_mm": held("max_mm"),
                "ladder": [
                    {
                        "step": step.name,
                        "holdout": step.holdout.to_dict(),
                        "files": {name: one.to_dict() for name, one in step.files.items()},
                    }
                    for step in self.steps
                ],
            },
            "noise": {"joint_jitter_mrad": finite(1e3 * self.jitter)},
            "structure": {"p": finite(self.structure), "in": self.structure_in},
            "not_testable": [{"effect": name, "needs": needs} for name, needs in self.not_testable],
            "seconds": self.seconds,
        }

    @staticmethod
    def from_dict(content: Mapping[str, Any], source: str = "diagnosis") -> RelativeDiagnosis:
        """From `to_dict`.  Raises CalibrationError."""
        calibration = RelativeCalibration.from_dict(content, source)
        with reading(source, "diagnosis"):
            part = checked(RelativeDiagnosisPart, content["diagnosis"], f"{source}: diagnosis")
        terms = calibration.cell.effects.terms if calibration.cell else ()
        return RelativeDiagnosis(
            calibration=calibration,
            status=part.status,
            verdict=part.verdict,
            effects=tuple(found.finding(terms) for found in part.effects),
            steps=tuple(step.step_of() for step in part.gap.ladder),
            structure=part.structure.p,
            structure_in=part.structure.place,
            jitter=1e-3 * part.noise.joint_jitter_mrad,
            meets_floor=part.meets_floor,
            floor_file=part.floor.file,
            floor_mm=(part.floor.remaining_mm, part.floor.noise_floor_mm),
            not_testable=tuple((each.effect, each.needs) for each in part.not_testable),
            seconds=part.seconds,
        )
