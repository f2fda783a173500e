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
from minimax_cal.fitting.opened import RELATIVE
from minimax_cal.fitting.several.result import RelativeCalibration, Scores
from minimax_cal.ground.facts import APART, Fact, derived, in_digits, in_file
from minimax_cal.ground.files import number, plain
from minimax_cal.ground.records import reading, stored
from minimax_cal.ground.results import Result, merged
from minimax_cal.ground.tables import Table, filled
from minimax_cal.ground.units import for_people, in_files
from minimax_cal.instruments.instrument import METRE
from minimax_cal.modelling.effects.words import name_step
from minimax_cal.solvers.status import Status as Status

RIVALS = ("effect", "alternative", "similarity", "power", "fits worse by")


@dataclass(frozen=True)
class RelativeStep:
    """One step of the error budget.  holdout: of all files; files: held out, of each by name."""

    name: Annotated[str, Fact(key="step")]
    holdout: Scores
    files: Mapping[str, Scores]

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
    effect.  floor_file: that exceeds the noise that was given most; floor: what its numbers leave
    at least, and what noise and sound joints may add up to, in its unit [SI].
    """

    KIND = RELATIVE
    COMMAND = "relative"

    calibration: Annotated[RelativeCalibration, APART]
    steps: Annotated[tuple[RelativeStep, ...], Fact(key="gap.ladder", fewest=2)]
    floor_file: Annotated[str, Fact(key="floor.file")]
    floor: Annotated[tuple[float, float], APART]
    floor_unit: Annotated[str, APART]
    seconds: float

    def __repr__(self) -> str:
        return f"<RelativeDiagnosis of {self.calibration.robot.name}: {self.verdict}>"

    @property
    def excess(self) -> str:
        """What the last step leaves, against the noise that was given."""
        scale, unit = for_people(self.floor_unit)
        spec = ".3f" if unit == "mm" else "#.3g"
        low, high = (f"{scale * size:{spec}} {unit}" for size in self.floor)
        where = f"{self.floor_file}: " if self.floor_file else ""
        return f"{where}at least {low} against at most {high} (given)"

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
        first, last = (self.in_units(self.steps[i]) for i in (1, -1))
        texts = []
        for name, before in first.items():
            rms, _, _, unit = before.for_display
            spec = ".3f" if unit == "mm" else "#.3g"
            after = f"{last[name].for_display[0]:{spec}} {unit}"
            fall = f" -> {after} with the effects" if len(self.steps) > 2 else ""
            texts.append(f"{name}{rms:{spec}} {unit}{fall}")
        return " ".join([*self.reasons, f"Held-out RMS error: geometry {', '.join(texts)}."])

    def in_units(self, step: RelativeStep) -> dict[str, Scores]:
        """Errors of a step, each in one unit: of all files, or of each by name."""
        if len(self.calibration.units) == 1:
            return {"": step.holdout}
        return {f"{name} ": scores for name, scores in step.files.items()}

    def steps_table(self) -> Table:
        """The error budget, step by step, by file."""
        files, is_common = tuple(self.steps[0].files), len(self.calibration.units) == 1
        columns = ["model"]
        rows: list[list[object]] = [[name_step(step.name)] for step in self.steps]
        every = [[step.holdout for step in self.steps]] if is_common else []
        every += [[step.files[name] for step in self.steps] for name in files]
        for name, scores in zip([""] * is_common + [f"{n} " for n in files], every, strict=True):
            unit = scores[0].for_display[-1]
            spec = ".4f" if unit == "mm" else ".4g"
            columns += [f"{name}RMS {unit} {spec}"] + [f"max {unit} {spec}"] * (not name)
            for row, one in zip(rows, scores, strict=True):
                row += one.for_display[: 1 if name else 2]
        return Table.made("error budget, held-out poses", rows, *columns)

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
        scale, unit = in_files(self.floor_unit)
        remaining, highest = (in_digits(scale * size) for size in self.floor)
        floor = {"remaining": remaining, "noise_floor": highest, "unit": unit}
        if unit == "mm":
            floor = {"remaining_mm": remaining, "noise_floor_mm": highest}
        more = {
            "floor_known": self.meets_floor is not None,
            "floor": floor,
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
            end, scale = ("", 1.0) if "unit" in floor else ("_mm", 1e-3)
            low, high = (scale * number(floor[f"{k}{end}"]) for k in ("remaining", "noise_floor"))
            each = enumerate(own["effects"])
            return cls(
                **told,
                calibration=calibration,
                effects=tuple(Finding.told(one, f"effects[{i}]", terms) for i, one in each),
                floor=(low, high),
                floor_unit=str(floor.get("unit", METRE)),
            )
