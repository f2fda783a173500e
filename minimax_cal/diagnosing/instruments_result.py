"""The result of a diagnosis of several instruments, and its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from minimax_cal.diagnosing.result import FOUND, Explained, Finding, Proposal, ends_of
from minimax_cal.diagnosing.result import VERDICTS as VERDICTS  # in annotations that are inherited
from minimax_cal.diagnosing.result import Untestable as Untestable
from minimax_cal.diagnosing.sentences import explained
from minimax_cal.evidence.limits import LEVEL
from minimax_cal.fitting.accuracy import Accuracy
from minimax_cal.fitting.opened import RELATIVE
from minimax_cal.fitting.several.result import RelativeCalibration
from minimax_cal.ground.facts import APART, Fact, derived, in_file
from minimax_cal.ground.files import number, plain
from minimax_cal.ground.records import reading, stored
from minimax_cal.ground.results import Result, merged
from minimax_cal.ground.tables import Table, filled
from minimax_cal.modelling.effects.words import name_step
from minimax_cal.solvers.status import Status as Status

RIVALS = ("effect", "alternative", "similarity", "power", "fits worse by")


@dataclass(frozen=True)
class RelativeStep:
    """One step of the error budget.  holdout: of all files; files: held out, of each by name."""

    name: Annotated[str, Fact(key="step")]
    holdout: Accuracy
    files: Mapping[str, Accuracy]

    @staticmethod
    def of(name: str, found: RelativeCalibration, *, nominal: bool = False) -> RelativeStep:
        """Of a calibration, or of the drawn arm with its instruments fitted."""
        key = "nominal" if nominal else "holdout"
        several = found.instruments if len(found.instruments) > 1 else ()
        files = {one.name: one.accuracy[key] for one in several}
        return RelativeStep(name, found.accuracy[key], files)


@dataclass(frozen=True, eq=False, repr=False)
class RelativeDiagnosis(Explained, Result):
    """What is still wrong with an arm that several instruments measured.

    calibration: with the effects that the budget took.  steps: nominal, geometric, then with each
    effect.  floor_file: that exceeds the noise that was given most; floor_mm: what its numbers
    leave at least, and what noise and sound joints may add up to [mm].
    """

    KIND = RELATIVE
    COMMAND = "relative"

    calibration: Annotated[RelativeCalibration, APART]
    steps: Annotated[tuple[RelativeStep, ...], Fact(key="gap.ladder", fewest=2)]
    floor_file: Annotated[str, Fact(key="floor.file")]
    floor_mm: Annotated[tuple[float, float], APART]
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
    def reason(self) -> str:
        """Why its calibration failed or keeps the drawn arm; empty where neither."""
        return self.calibration.reason

    @property
    def notices(self) -> tuple[str, ...]:
        """What the reader should know."""
        return self.calibration.notices

    @derived()
    def reasons(self) -> tuple[str, ...]:
        """The verdict and why, in sentences."""
        return explained(self)

    @derived()
    def next(self) -> Proposal | None:
        """The one measurement to make next; None where none is worth it."""
        from minimax_cal.diagnosing.proposals import proposal

        return proposal(self, self.meets_floor is not None)

    def headline(self) -> str:
        """The verdict in words, and the held-out errors."""
        first, last = self.steps[1].holdout, self.steps[-1].holdout
        fall = f" -> {last.rms_mm:.3f} mm with the effects" if len(self.steps) > 2 else ""
        said = f"Held-out RMS error: geometry {first.rms_mm:.3f} mm{fall}."
        return " ".join([*self.reasons, said])

    def steps_table(self) -> Table:
        """The error budget, step by step, by file."""
        files = tuple(self.steps[0].files)
        rows = (
            (name_step(step.name), step.holdout.rms_mm, step.holdout.max_mm,
             *(step.files[name].rms_mm for name in files))
            for step in self.steps
        )  # fmt: skip
        of_files = (f"{name} RMS mm .4f" for name in files)
        columns = "model | RMS mm .4f | max mm .4f"
        return Table.made("error budget, held-out poses", rows, columns, *of_files)

    def effects_table(self) -> Table:
        """The effects found, with what each does for held-out poses."""
        rows = (
            (f.name, f.cause, 100.0 * f.share, f.before, f.after, f.chance, f.evidence)
            for f in self.effects
        )
        title = f"effects found; p-values below {LEVEL:g} are significant"
        return Table.made(title, rows, FOUND)

    def own_tables(self) -> tuple[Table, ...]:
        """Those of the diagnosis."""
        return filled(self.steps_table(), self.effects_table(), self.parameter_table(),
                      self.rival_table().brief(*RIVALS), self.untestable_table())  # fmt: skip

    def first_tables(self) -> tuple[Table, ...]:
        """What stands on the first screen."""
        shown = ("effect", "share of error %", "before mm", "after mm", "evidence")
        return filled(self.steps_table(), self.effects_table().brief(*shown))

    def tables(self) -> tuple[Table, ...]:
        """Every table, those of the calibration last."""
        return (*self.own_tables(), *self.calibration.tables())

    def to_dict(self, *, poses: bool = True) -> dict[str, Any]:
        """The JSON of the calibration, with the key diagnosis, as `Diagnosis` where it means so."""
        remaining, highest = self.floor_mm
        more = {
            "floor_known": self.meets_floor is not None,
            "floor": {"remaining_mm": remaining, "noise_floor_mm": highest},
            "effects": self.effects,
            "gap": {f"holdout_{kind}": ends for kind, ends in ends_of(self.steps).items()},
        }
        own = merged(plain(in_file(self)), plain(more))
        return {**self.calibration.to_dict(), "diagnosis": own}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], source: str = "diagnosis") -> RelativeDiagnosis:
        """From `to_dict`.  Raises CalibrationError."""
        calibration = RelativeCalibration.from_dict(content, source)
        terms = calibration.cell.effects.terms if calibration.cell else ()
        with reading(source, "diagnosis"):
            own = content["diagnosis"]
            told, floor = stored(cls, own), own["floor"]
            each = enumerate(own["effects"])
            return cls(
                **told,
                calibration=calibration,
                effects=tuple(Finding.told(one, f"effects[{i}]", terms) for i, one in each),
                floor_mm=(number(floor["remaining_mm"]), number(floor["noise_floor_mm"])),
            )
