"""The result of a diagnosis of several instruments, and its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from minimax_cal.core.files import convert_to_plain_json, float_from_json
from minimax_cal.core.record_fields import (
    SEPARATE_FIELD_FORMAT,
    FieldFormat,
    derived_field,
    record_to_file_values,
    round_to_15_digits,
)
from minimax_cal.core.record_parsing import (
    parse_record_fields,
    raise_read_errors_as_calibration_error,
)
from minimax_cal.core.results import Result, merge_nested_mappings
from minimax_cal.core.tables import Table, drop_empty_tables
from minimax_cal.core.units import display_unit_of_change, file_unit
from minimax_cal.diagnosing.diagnosis import (
    EFFECT_TABLE_COLUMNS,
    Explanation,
    Finding,
    MeasurementProposal,
    summarise_first_and_last_steps,
)
from minimax_cal.diagnosing.diagnosis import (
    VERDICTS as VERDICTS,
)  # in annotations that are inherited
from minimax_cal.diagnosing.diagnosis_sentences import describe_explanation
from minimax_cal.fitting.multi_instrument.relative_result import (
    MeasuredAccuracy,
    RelativeCalibration,
)
from minimax_cal.fitting.opened_results import RELATIVE_CALIBRATION_KIND
from minimax_cal.instruments.instrument import METRE_UNIT
from minimax_cal.modelling.effects.effect_names import format_budget_step
from minimax_cal.selection.thresholds import FALSE_NAME_PROBABILITY
from minimax_cal.solvers.status import Status as Status

SHOWN_ALTERNATIVE_COLUMNS = ("effect", "alternative", "similarity", "power", "fits worse by")


@dataclass(frozen=True)
class RelativeStep:
    """One step of the error budget.  holdout: of all files; files: held out, of each by name."""

    name: Annotated[str, FieldFormat(key="step")]
    holdout: MeasuredAccuracy
    files: Mapping[str, MeasuredAccuracy]

    @staticmethod
    def from_calibration(
        name: str, calibration: RelativeCalibration, *, nominal: bool = False
    ) -> RelativeStep:
        """Of a calibration, or of the drawn arm with its instruments fitted."""
        key = "nominal" if nominal else "holdout"
        several = calibration.instruments if len(calibration.instruments) > 1 else ()
        files = {one.name: one.accuracy[key] for one in several}
        return RelativeStep(name, calibration.accuracy[key], files)


@dataclass(frozen=True, eq=False, repr=False)
class RelativeDiagnosis(Explanation, Result):
    """What is still wrong with an arm that several instruments measured.

    calibration: with the effects that the budget took.  steps: nominal, geometric, then with each
    effect.  floor_file: that exceeds the noise that was given most; floor: what its numbers leave
    at least, and what noise and sound joints may add up to, in its unit [SI].
    """

    KIND = RELATIVE_CALIBRATION_KIND
    COMMAND = "relative"

    calibration: Annotated[RelativeCalibration, SEPARATE_FIELD_FORMAT]
    steps: Annotated[tuple[RelativeStep, ...], FieldFormat(key="gap.ladder", fewest=2)]
    floor_file: Annotated[str, FieldFormat(key="floor.file")]
    floor: Annotated[tuple[float, float], SEPARATE_FIELD_FORMAT]
    floor_unit: Annotated[str, SEPARATE_FIELD_FORMAT]
    seconds: float

    def __repr__(self) -> str:
        return f"<RelativeDiagnosis of {self.calibration.robot.name}: {self.verdict}>"

    @property
    def describe_excess(self) -> str:
        """What the last step leaves, against the noise that was given."""
        scale, unit = display_unit_of_change(self.floor_unit)
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

    @derived_field()
    def reasons(self) -> tuple[str, ...]:
        """The verdict and why, in sentences."""
        return describe_explanation(self)

    @derived_field()
    def next(self) -> MeasurementProposal | None:
        """The one measurement to make next; None where none is worth it."""
        from minimax_cal.diagnosing.proposals import propose_next_measurement

        return propose_next_measurement(self, self.meets_floor is not None)

    def headline(self) -> str:
        """The verdict in words, and the held-out errors."""
        first, last = (self.split_step_by_unit(self.steps[i]) for i in (1, -1))
        texts = []
        for name, before in first.items():
            rms, _, _, unit = before.for_display
            spec = ".3f" if unit == "mm" else "#.3g"
            after = f"{last[name].for_display[0]:{spec}} {unit}"
            fall = f" -> {after} with the effects" if len(self.steps) > 2 else ""
            texts.append(f"{name}{rms:{spec}} {unit}{fall}")
        return " ".join([*self.reasons, f"Held-out RMS error: geometry {', '.join(texts)}."])

    def split_step_by_unit(self, step: RelativeStep) -> dict[str, MeasuredAccuracy]:
        """Errors of a step, each in one unit: of all files, or of each by name."""
        if len(self.calibration.units) == 1:
            return {"": step.holdout}
        return {f"{name} ": scores for name, scores in step.files.items()}

    def budget_table(self) -> Table:
        """The error budget, step by step, by file."""
        files, is_common = tuple(self.steps[0].files), len(self.calibration.units) == 1
        columns = ["model"]
        rows: list[list[object]] = [[format_budget_step(step.name)] for step in self.steps]
        every = [[step.holdout for step in self.steps]] if is_common else []
        every += [[step.files[name] for step in self.steps] for name in files]
        for name, scores in zip([""] * is_common + [f"{n} " for n in files], every, strict=True):
            unit = scores[0].for_display[-1]
            spec = ".4f" if unit == "mm" else ".4g"
            columns += [f"{name}RMS {unit} {spec}"] + [f"max {unit} {spec}"] * (not name)
            for row, one in zip(rows, scores, strict=True):
                row += one.for_display[: 1 if name else 2]
        return Table.from_rows("error budget, held-out poses", rows, *columns)

    def effects_table(self) -> Table:
        """The effects found, with what each does for held-out poses."""
        rows = (
            (f.name, f.cause, 100.0 * f.share, f.before, f.after, f.p_value_text, f.evidence)
            for f in self.effects
        )
        title = f"effects found; p-values below {FALSE_NAME_PROBABILITY:g} are significant"
        return Table.from_rows(title, rows, EFFECT_TABLE_COLUMNS)

    def diagnosis_tables(self) -> tuple[Table, ...]:
        """Those of the diagnosis."""
        return drop_empty_tables(
            self.budget_table(),
            self.effects_table(),
            self.parameter_table(),
            self.alternative_table().shorten(*SHOWN_ALTERNATIVE_COLUMNS),
            self.untestable_table(),
        )

    def first_tables(self) -> tuple[Table, ...]:
        """What stands on the first screen."""
        shown = ("effect", "share of error %", "before mm", "after mm", "evidence")
        return drop_empty_tables(self.budget_table(), self.effects_table().shorten(*shown))

    def tables(self) -> tuple[Table, ...]:
        """Every table, those of the calibration last."""
        return (*self.diagnosis_tables(), *self.calibration.tables())

    def to_dict(self, *, poses: bool = True) -> dict[str, Any]:
        """The JSON of the calibration, with the key diagnosis, as `Diagnosis` where it means so."""
        scale, unit = file_unit(self.floor_unit)
        remaining, highest = (round_to_15_digits(scale * size) for size in self.floor)
        floor = {"remaining": remaining, "noise_floor": highest, "unit": unit}
        if unit == "mm":
            floor = {"remaining_mm": remaining, "noise_floor_mm": highest}
        more = {
            "floor_known": self.meets_floor is not None,
            "floor": floor,
            "effects": self.effects,
            "gap": {
                f"holdout_{kind}": ends
                for kind, ends in summarise_first_and_last_steps(self.steps).items()
            },
        }
        own = merge_nested_mappings(
            convert_to_plain_json(record_to_file_values(self)), convert_to_plain_json(more)
        )
        return {**self.calibration.to_dict(), "diagnosis": own}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], source: str = "diagnosis") -> RelativeDiagnosis:
        """From `to_dict`.  Raises CalibrationError."""
        calibration = RelativeCalibration.from_dict(content, source)
        terms = calibration.cell.effects.terms if calibration.cell else ()
        with raise_read_errors_as_calibration_error(source, "diagnosis"):
            own = content["diagnosis"]
            told, floor = parse_record_fields(cls, own), own["floor"]
            end, scale = ("", 1.0) if "unit" in floor else ("_mm", 1e-3)
            low, high = (
                scale * float_from_json(floor[f"{k}{end}"]) for k in ("remaining", "noise_floor")
            )
            each = enumerate(own["effects"])
            return cls(
                **told,
                calibration=calibration,
                effects=tuple(
                    Finding.parse_finding(one, f"effects[{i}]", terms) for i, one in each
                ),
                floor=(low, high),
                floor_unit=str(floor.get("unit", METRE_UNIT)),
            )
