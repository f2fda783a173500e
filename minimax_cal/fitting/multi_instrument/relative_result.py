"""The result of a calibration without coordinates: what was found, how well, and what it is not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np

from minimax_cal.core.arrays import Array, rms
from minimax_cal.core.display_text import capitalise_sentence, format_first_names
from minimax_cal.core.files import convert_to_plain_json
from minimax_cal.core.record_fields import (
    SEPARATE_FIELD_FORMAT,
    FieldFormat,
    LengthInMillimetres,
    derived_field,
    record_to_file_values,
    round_to_15_digits,
    scale_numbers,
)
from minimax_cal.core.record_parsing import (
    parse_as_type,
    parse_record,
    parse_record_fields,
    raise_read_errors_as_calibration_error,
)
from minimax_cal.core.results import Result, merge_nested_mappings
from minimax_cal.core.tables import Table, drop_empty_tables
from minimax_cal.core.units import display_unit_of_change, file_unit
from minimax_cal.fitting.accuracy import (
    IS_HELD_BY_KEY,
    UNKNOWN_ENDS,
    Accuracy,
    Ends,
    Interval,
    accuracy_before_and_after,
    bootstrap_rms_interval,
    interval_for_display,
    summarise_point_errors,
)
from minimax_cal.fitting.contradiction import Contradiction
from minimax_cal.fitting.fit import ACCURACY_TITLES_AND_KEYS, Provenance
from minimax_cal.fitting.identification import Identification
from minimax_cal.fitting.multi_instrument.instrument_identification import DeterminedAlone
from minimax_cal.fitting.multi_instrument.worst_rows import (
    WorstPixels,
    WorstRows,
    WorstRowsOverNoise,
)
from minimax_cal.fitting.opened_results import RELATIVE_CALIBRATION_KIND
from minimax_cal.fitting.parameter_results import (
    Parameter,
    effect_parameter_table,
    geometry_parameter_table,
)
from minimax_cal.instruments.instrument import METRE_UNIT, Words
from minimax_cal.instruments.instrument_registry import INSTRUMENT_CLASSES, load_instrument_class
from minimax_cal.measuring.measurements import Measurements, SetAsidePoint
from minimax_cal.measuring.pose_groups import group_repeated_poses
from minimax_cal.modelling.cell import Cell, cell_from_dict, pose_from_dict
from minimax_cal.modelling.cell_frames import (
    build_cell_frame_tables,
    frame_with_nominal_and_correction,
)
from minimax_cal.robots.robot import Robot, robot_from_dict
from minimax_cal.robots.transforms import ABC_ANGLES_CONVENTION, Frame
from minimax_cal.solvers.status import Status

SEVERAL_KINDS = "several"  # kind of a calibration from several files
ALL_FILES_WORDS = Words(
    quantity="what every file measured",
    caution="Lengths, misclosures and positions are one number here; each file has its own. ",
)


@dataclass(frozen=True)
class MeasuredAccuracy(Accuracy):
    """Accuracy of what an instrument measured, with what else is told of the errors.

    unit: SI, of rms, max, mean and rms_ci95, where the errors are no lengths; those in mm are then
    NaN, and so are all of errors in several units.
    """

    numbers: int = 0
    unit: Annotated[str, FieldFormat(brief=True)] = ""
    rms: Annotated[float | None, FieldFormat(brief=True)] = None
    max: Annotated[float | None, FieldFormat(brief=True)] = None
    mean: Annotated[float | None, FieldFormat(brief=True)] = None
    rms_ci95: Annotated[Ends | None, FieldFormat(brief=True)] = None
    rms_mrad: Annotated[float | None, FieldFormat(brief=True)] = None
    max_mrad: Annotated[float | None, FieldFormat(brief=True)] = None
    rms_px: Annotated[float | None, FieldFormat(brief=True)] = None
    max_px: Annotated[float | None, FieldFormat(brief=True)] = None

    @staticmethod
    def from_errors(error: Array, units: Sequence[str], numbers: int = 0) -> MeasuredAccuracy:
        """Of errors (m, k, 3), NaN where not measured.

        units: SI, of all of them.  numbers: independent ones.
        """
        plain = MeasuredAccuracy(**vars(summarise_point_errors(error)), numbers=numbers)
        if tuple(units) == (METRE_UNIT,):
            return plain
        sizes = scale_numbers((plain.rms_mm, plain.max_mm, plain.mean_mm), 1e-3)
        none = (math.nan,) * len(plain.counts)
        no_lengths = replace(
            plain, rms_mm=math.nan, max_mm=math.nan, mean_mm=math.nan, sse_mm2=none, means_mm=(),
            largest_mm=(),
        )  # fmt: skip
        if len(units) > 1:
            return no_lengths
        return replace(no_lengths, unit=units[0], rms=sizes[0], max=sizes[1], mean=sizes[2])

    @property
    def for_display(self) -> tuple[float, float, float, str]:
        """RMS, largest and mean error, and their unit: mm, mrad or the instrument's own."""
        if not self.unit:
            return self.rms_mm, self.max_mm, self.mean_mm, "mm"
        scale, unit = display_unit_of_change(self.unit)
        sizes = (math.nan if size is None else size for size in (self.rms, self.max, self.mean))
        rms, largest, mean = (scale * size for size in sizes)
        return rms, largest, mean, unit

    @property
    def rms_error(self) -> float:
        """RMS error in the unit of the rows [SI]."""
        return 1e-3 * self.rms_mm if not self.unit else math.nan if self.rms is None else self.rms


@dataclass(frozen=True)
class StatedIdentification(Identification):
    """As a file tells it, without the singular values."""

    told: float

    @property
    def condition(self) -> float:
        """As the file says."""
        return self.told


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredResult:
    """What was measured, and how well it is fitted.

    kind: name of an instrument, or `SEVERAL_KINDS`.  parts: what each row of the errors is, as
    wire1. errors: by key nominal, holdout, nominal_train, train, (parts, m, 3) of the measured
    quantity, NaN where not measured [units]; a length's error stands first of three.  numbers:
    independent numbers behind each accuracy.  turns: RMS and largest error of orientation by key
    [rad], empty but for poses.  instrument: what was fitted besides the robot, for JSON.  units:
    SI, those of the errors.
    """

    kind: Annotated[str, FieldFormat(key="measured")]
    parts: tuple[str, ...]
    errors: Annotated[Mapping[str, Array], SEPARATE_FIELD_FORMAT]
    numbers: Annotated[Mapping[str, int], SEPARATE_FIELD_FORMAT]
    turns: Annotated[Mapping[str, tuple[float, float]], SEPARATE_FIELD_FORMAT]
    instrument: Mapping[str, Any]
    stated: Annotated[Mapping[str, MeasuredAccuracy] | None, SEPARATE_FIELD_FORMAT] = None
    units: Annotated[tuple[str, ...], SEPARATE_FIELD_FORMAT] = (METRE_UNIT,)

    @property
    def words(self) -> Words:
        """What is said of it."""
        return (
            ALL_FILES_WORDS
            if self.kind == SEVERAL_KINDS
            else load_instrument_class(self.kind).words
        )

    @cached_property
    def accuracy(self) -> Mapping[str, MeasuredAccuracy]:
        """Of the errors, by their keys; as a file states it where it keeps no errors."""
        if self.stated is not None:
            return self.stated
        return {
            key: MeasuredAccuracy.from_errors(error, self.units, self.numbers[key])
            for key, error in self.errors.items()
        }

    def before_and_after(self) -> tuple[MeasuredAccuracy, MeasuredAccuracy, str]:
        """On held-out poses where there are any, and which poses those are."""
        return accuracy_before_and_after(self.accuracy)

    def error_sentence(self) -> str:
        """RMS and largest error before and after, and at which poses."""
        before, after, where = self.before_and_after()
        rms, largest, _, unit = before.for_display
        rms_after, largest_after, *_ = after.for_display
        spec = ".3f" if unit == "mm" else "#.3g"
        return (
            f"RMS error {rms:{spec}} {unit} -> {rms_after:{spec}} {unit}, largest "
            f"{largest:{spec}} {unit} -> {largest_after:{spec}} {unit}, at {where}"
        )

    def scores(self, title: str) -> Table:
        """Accuracy before and after, training and held out."""
        unit, spec = self.display
        rows = (
            (heading, one.poses, one.numbers, rms, mean, largest, one.rms_mrad, one.max_mrad)
            for heading, key in ACCURACY_TITLES_AND_KEYS
            for one in [self.accuracy_record(key)]
            for rms, largest, mean, _ in [one.for_display]
        )
        columns = "poses | count d | numbers d"
        sizes = (f"{what} {unit} {spec}" for what in ("RMS", "mean", "max"))
        turns = (f"{what} mrad .4f" for what in ("RMS", "max"))
        table = Table.from_rows(title, rows, columns, *sizes, *turns)
        return table if self.turns else table.select_columns(*range(len(table.header) - 2))

    def parts_table(self, title: str) -> Table:
        """RMS errors part by part, as wire by wire; empty for a single one."""
        titles, keys = zip(*ACCURACY_TITLES_AND_KEYS, strict=True)
        (unit, spec), scale = self.display, display_unit_of_change(self.units[0])[0]
        rows = (
            (part, *(scale * rms(np.linalg.norm(self.errors[key][:, i], axis=-1)) for key in keys))
            for i, part in enumerate(self.parts)
            if len(self.parts) > 1 and self.errors
        )
        return Table.from_rows(title, rows, f"RMS {unit}", *(f"{each} {spec}" for each in titles))

    @property
    def display(self) -> tuple[str, str]:
        """Unit of the errors for people, and the format of a number in it."""
        unit = display_unit_of_change(self.units[0])[1]
        return unit, ".4f" if unit == "mm" else ".4g"

    @property
    def frames(self) -> dict[str, Frame]:
        """Base and tool as a tracker's points or whole poses have them, the drawn arm's, and the
        corrections.
        """
        places = {
            name: pose_from_dict(self.instrument[name]) if name in self.instrument else None
            for name in ("base", "nominal_base", "tool", "nominal_tool")
        }
        base = frame_with_nominal_and_correction("base", places["base"], places["nominal_base"])
        return base | frame_with_nominal_and_correction(
            "tool", places["tool"], places["nominal_tool"]
        )

    def accuracy_record(self, key: str) -> MeasuredAccuracy:
        """An accuracy with all that is told beside it."""
        if key not in self.turns:
            return self.accuracy[key]
        turn, largest = self.turns[key]
        return replace(self.accuracy[key], rms_mrad=1e3 * turn, max_mrad=1e3 * largest)

    def measured_file_fields(self) -> dict[str, Any]:
        """What of a file its fields do not tell."""
        frames = {"frames": self.frames, "frames_convention": ABC_ANGLES_CONVENTION}
        return {
            **(frames if self.frames else {}),
            "accuracy": {
                key: record_to_file_values(self.accuracy_record(key)) for key in self.accuracy
            },
        }

    @staticmethod
    def parse_measured_fields(content: Mapping[str, Any], at: str) -> dict[str, Any]:
        """Fields that are `SEPARATE_FIELD_FORMAT`, without the errors of single rows.  Raises
        ValueError.
        """
        if content["measured"] not in (*INSTRUMENT_CLASSES, SEVERAL_KINDS):
            known = ", ".join((*INSTRUMENT_CLASSES, SEVERAL_KINDS))
            raise ValueError(f"{at}measured: should be one of {known}; where it is an instrument "
                             "of your own, import the module that registers it")  # fmt: skip
        told = {
            key: parse_record(MeasuredAccuracy, content["accuracy"][key], f"{at}accuracy.{key}")
            for key in IS_HELD_BY_KEY
        }
        turns = {
            key: (1e-3 * each.rms_mrad, 1e-3 * each.max_mrad)
            for key, each in told.items()
            if each.rms_mrad is not None and each.max_mrad is not None
        }
        if turns and len(turns) < len(told):
            raise ValueError(f"{at}accuracy: of some only tells angles")
        numbers = {key: each.numbers for key, each in told.items()}
        files = content.get("instruments") or () if content["measured"] == SEVERAL_KINDS else ()
        kinds = [one["kind"] for one in files] or [content["measured"]]
        units = tuple(
            dict.fromkeys(
                load_instrument_class(kind).unit for kind in kinds if kind in INSTRUMENT_CLASSES
            )
        )
        return {"errors": {}, "numbers": numbers, "turns": turns, "stated": told,
                "units": units or (METRE_UNIT,)}  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class InstrumentResult(MeasuredResult):
    """One of the files.

    interval: 95 % of the held-out RMS.  noise: sigma of a number by what the fit leaves.  Both in
    SI, in the unit of the instrument's rows.
    alone: link parameters that of several files only this one
    determines; directions_alone: the number of independent directions in which it does.
    """

    kind: str
    name: str
    file: str
    interval: Annotated[Interval, SEPARATE_FIELD_FORMAT]
    noise: float
    alone: tuple[str, ...]
    directions_alone: int

    @staticmethod
    def from_measured(
        name: str,
        seen: MeasuredResult,
        at: Measurements,
        held: Array,
        noise: float,
        alone: DeterminedAlone,
    ) -> InstrumentResult:
        """Of what was seen at poses.  at: with its source.  held: (m,).  noise: [unit]."""
        own = {one.name: getattr(seen, one.name) for one in fields(MeasuredResult)}
        group, after = group_repeated_poses(at)[held], seen.accuracy["holdout"]
        interval = bootstrap_rms_interval(
            seen.errors["holdout"], group, rng=np.random.default_rng(0)
        )
        return InstrumentResult(
            **own,
            name=name,
            file=at.source,
            interval=interval_for_display(interval, after.rms_error),
            noise=noise,
            alone=alone.names,
            directions_alone=alone.directions,
        )

    @derived_field()
    def unit(self) -> str:
        """Of its noise in a file: mm, or that of the instrument's rows."""
        return file_unit(self.units[0])[1]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        told = merge_nested_mappings(record_to_file_values(self), self.measured_file_fields())
        scale, unit = file_unit(self.units[0])
        told["noise"] = round_to_15_digits(scale * self.noise)
        ends = "rms_ci95_mm" if unit == "mm" else "rms_ci95"
        told["accuracy"]["holdout"][ends] = list(scale_numbers(self.interval, scale))
        return dict(convert_to_plain_json(told))

    @staticmethod
    def from_dict(content: Any, at: str) -> InstrumentResult:
        """From `to_dict`.  Raises ValueError."""
        told = parse_record_fields(InstrumentResult, content, at)
        apart = MeasuredResult.parse_measured_fields(
            {**content, "measured": told["kind"]}, f"{at}."
        )
        scale, held = file_unit(apart["units"][0])[0], apart["stated"]["holdout"]
        told["noise"] /= scale
        ends = scale_numbers(held.rms_ci95 or held.rms_ci95_mm or UNKNOWN_ENDS, 1.0 / scale)
        return InstrumentResult(**told, **apart, interval=Interval(*ends))


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class RelativeCalibration(MeasuredResult, Result):
    """A robot calibrated from lengths, closures or poses, or from several files together.

    robot: calibrated; nominal: as drawn.  position_sigma: expected error of a position over the
    joints' range, by the parameters' sigmas and the lack of fit, the base fitted [m]; NaN while
    a direction that moves positions is open.  positions_open: parameters that positions depend on
    and that the measurements do not determine.
    beyond: parameters that whole poses tell and one reflector does not.  instruments: each file.
    cell: the arm with its effects, fitted together; None without any.  robot is then of a fit
    without them.  worst: what a minimax rests on, None where there was none.
    calibrated: the robot that fits what was measured; `robot` is the drawn one where the status
    keeps that.  reason: why it failed or keeps the drawn arm; empty where neither.
    contradictions: of the files.
    """

    KIND = RELATIVE_CALIBRATION_KIND
    COMMAND = "relative"

    robot: Robot
    nominal: Annotated[Robot, FieldFormat(key="nominal_robot")]
    status: Status
    iterations: int
    seconds: float
    parameters: tuple[Parameter, ...]
    identification: Annotated[Identification, SEPARATE_FIELD_FORMAT]
    position_sigma: LengthInMillimetres
    beyond: Annotated[tuple[str, ...], FieldFormat(key="beyond_one_reflector")]
    notices: tuple[str, ...]
    provenance: Provenance
    instruments: tuple[InstrumentResult, ...] = ()
    positions_open: tuple[str, ...] = ()
    objective: str = "sum"
    qp: str = ""
    set_aside: tuple[SetAsidePoint, ...] = ()
    reason: str = ""
    worst: Annotated[WorstRows | WorstRowsOverNoise | None, FieldFormat(key="minimax")] = None
    cell: Annotated[Cell | None, SEPARATE_FIELD_FORMAT] = None
    contradictions: tuple[Contradiction, ...] = ()
    calibrated: Annotated[Robot | None, SEPARATE_FIELD_FORMAT] = None

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.robot.name}: {self.status}>"

    @derived_field()
    def advice(self) -> str:
        """What to do where it failed or keeps the drawn arm, else what its status advises."""
        return self.reason or self.status.advice

    @derived_field()
    def condition(self) -> float:
        """Condition number of what was identified."""
        return self.identification.condition

    @derived_field()
    def identified(self) -> int:
        """Number of identified parameters."""
        return sum(p.identifiable for p in self.parameters)

    def accuracy_table(self) -> Table:
        """Accuracy of what was measured, before and after, training and held out."""
        return self.scores(f"{self.robot.name}: {self.words.quantity}")

    def files_table(self) -> Table:
        """Each of several files: held-out RMS before and after, and what it alone determines."""
        rows = (
            (one.name, unit, before.for_display[0], after.for_display[0],
             *scale_numbers(tuple(one.interval), scale), scale * one.noise)
            for one in self.instruments
            for scale, unit in [display_unit_of_change(one.units[0])]
            for before, after, _ in [one.before_and_after()]
        )  # fmt: skip
        if self.units == (METRE_UNIT,):
            columns = (
                "file | unit | nominal mm .4f | RMS mm .4f | 95 % from .4f | to .4f | noise mm .4f"
            )
            return Table.from_rows("each file, RMS", rows, columns).select_columns(0, *range(2, 7))
        columns = "file | unit | nominal .4g | RMS .4g | 95 % from .4g | to .4g | noise .4g"
        return Table.from_rows("each file, RMS", rows, columns)

    def error_table(self) -> Table:
        """RMS and largest error before and after, or the RMS of each file."""
        if self.kind == SEVERAL_KINDS:
            return self.files_table()
        unit, _ = self.display
        return self.accuracy_table().shorten("poses", "count", f"RMS {unit}", f"max {unit}")

    def alone_table(self) -> Table:
        """What only one of the files determines."""
        rows = ((one.name, one.directions_alone, one.alone or "none") for one in self.instruments)
        columns = "only by | directions d | parameters of the arm"
        return Table.from_rows("identified by one file alone", rows, columns)

    def first_tables(self) -> tuple[Table, ...]:
        """What stands on the first screen."""
        first = [self.error_table()]
        if self.kind == SEVERAL_KINDS:
            first += [self.alone_table()]
        return drop_empty_tables(*first, effect_parameter_table(self.parameters))

    def tables(self) -> tuple[Table, ...]:
        """Every table of the result."""
        first = self.first_tables()
        if self.kind != SEVERAL_KINDS:
            first = (self.accuracy_table(), *first[1:], self.parts_table(f"by {self.words.part}"))
        every = [*first, *build_cell_frame_tables(self.frames)]
        every += [self.worst.table()] if self.worst else []
        for one in self.instruments if self.kind == SEVERAL_KINDS else ():
            every += [
                one.scores(f"{one.name}: {one.words.quantity}"),
                *build_cell_frame_tables(one.frames),
                one.parts_table(f"{one.name}, by {one.words.part}"),
            ]
        return (*drop_empty_tables(*every), geometry_parameter_table(self.parameters))

    @property
    def outcome(self) -> str:
        """How many parameters were identified, and how the numbers ended, as sentences."""
        text = (
            f"{self.identified} of {len(self.parameters)} parameters identified (condition "
            f"{self.identification.condition:.3g}); {self.status} after {self.iterations} "
            f"iterations, {self.seconds:.2f} s."
        )
        return text + (f" {self.worst.sentence()}" if self.worst else "")

    @property
    def position_claim(self) -> str:
        """How good positions are, as a sentence."""
        if self.positions_open:
            return (
                f"These data do not determine {format_first_names(self.positions_open)}, on which "
                "positions depend: how good a position is they do not say."
            )
        return (
            "By the parameters' sigmas, lack of fit included, but for errors of what is fixed, a "
            f"position over the joints' range is good to {1e3 * self.position_sigma:.3f} mm RMS "
            f"once {self.words.fitted} fitted."
        )

    def headline(self) -> str:
        """The result in some sentences, with what it does not say."""
        text = f"{capitalise_sentence(self.reason)}. " if self.reason else ""
        if len(self.units) == 1:
            text += f"{self.words.quantity.capitalize()}: {self.error_sentence()}."
        else:  # no one number holds errors in several units
            text += " ".join(
                f"{capitalise_sentence(one.name)}, {one.words.quantity}: {one.error_sentence()}."
                for one in self.instruments
            )
        if self.status is Status.FAILED and self.reason:  # nothing follows but its mend
            return text
        caution = self.words.caution if len(self.units) == 1 else ""
        text += f" {caution}{self.position_claim} {self.outcome}"
        advice = "" if self.reason else self.status.advice
        return text + (f" {advice}." if advice else "")

    def summary(self, width: int = 110) -> str:
        """The result as plain text."""
        return "\n\n".join([*(table.text(width) for table in self.tables()), self.headline()])

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """The accuracies, and the arm with its effects."""
        answered = {"answered": self.worst.answered} if self.worst else {}
        cell = {"cell": self.cell.whole()} if self.cell else {}
        fitted = {"calibrated_robot": self.calibrated} if self.status.keeps_drawn else {}
        return self.measured_file_fields() | cell | answered | fitted

    @classmethod
    def parse_extra_fields(
        cls, content: Mapping[str, Any], parsed_fields: Mapping[str, Any], source: str
    ) -> dict[str, Any]:
        """The accuracies without the errors of single rows, and the arm with its effects."""
        own = {**parsed_fields, **cls.parse_measured_fields(content, "")}
        for each in (MeasuredResult(**{f.name: own[f.name] for f in fields(MeasuredResult)}),
                     *parsed_fields.get("instruments", ())):  # fmt: skip
            with raise_read_errors_as_calibration_error(
                source, "instrument"
            ):  # poses that are none are refused before shown
                _ = each.frames
        known = np.array([p.identifiable for p in parsed_fields["parameters"]])
        condition = parse_as_type(float, content.get("condition"), FieldFormat(), "condition")
        whole, worst = content.get("cell"), parsed_fields.get("worst")
        answered = parse_as_type(
            Mapping[str, int], content.get("answered", {}), FieldFormat(), "answered"
        )
        return {
            **cls.parse_measured_fields(content, ""),
            "worst": replace(worst, answered=answered) if worst else None,
            "identification": StatedIdentification(known, {}, np.zeros(0), np.zeros(0), condition),
            "cell": cell_from_dict(whole, f"{source}: cell") if whole else None,
            "calibrated": robot_from_dict(
                content["calibrated_robot"], f"{source}: calibrated_robot"
            )
            if "calibrated_robot" in content
            else None,
        }


# ---- by cameras ----------------------------------------------------------------------------------


MAX_CLEARLY_BETTER_RATIO = (
    2.0 / 3.0
)  # of the drawing's sigma: an arm less sure may be worse than drawn
MIN_SHOWN_DIFFERENCE = 1e-9  # arms so far apart are one and the same [m]


@dataclass(frozen=True)
class PositionClaim:
    """What is known of positions of the arm, RMS over the joints' range, base and tool fitted [m].

    sigma: of the calibrated arm.  drawn: of the drawing, by `drawn_within`.  change: between the
    two.  shown: of the drawing, by how far the pixels show it to be off; 0 where they do not.
    """

    sigma: LengthInMillimetres
    drawn: Annotated[float, FieldFormat(key="drawn_sigma_mm", scale=1e3)]
    change: LengthInMillimetres
    shown: Annotated[float, FieldFormat(key="drawn_shown_mm", scale=1e3)]

    @derived_field(key="better")
    def is_better(self) -> bool:
        """Whether the calibrated arm is known clearly better than the drawn one."""
        return self.sigma < MAX_CLEARLY_BETTER_RATIO * self.shown

    def texts(self) -> dict[str, str]:
        """Each number for people."""
        return {f.name: f"{1e3 * getattr(self, f.name):#.3g} mm" for f in fields(self)}

    def why_kept(self) -> str:
        """Why the drawn arm is kept."""
        mm = self.texts()
        why = (
            f"the calibrated arm, known to {mm['sigma']}, differs from the drawn one by "
            f"{mm['change']}, which shows the drawing to be off by {mm['shown']}: too little to be "
            "sure"
        )
        if self.sigma >= self.drawn:
            why = (
                f"the drawing is known better ({mm['drawn']}) than these pixels tell the arm "
                f"({mm['sigma']})"
            )
        return (
            f"{why}: the drawn arm is kept; take more images, nearer and more tilted, or say how "
            "well the drawing is known (drawn_within)"
        )

    def sentence(self) -> str:
        """For people."""
        mm = self.texts()
        if self.change < MIN_SHOWN_DIFFERENCE:
            return (
                "The arm stays as drawn: cameras and targets go with it, whose positions the "
                f"drawing knows to {mm['drawn']} RMS (drawn_within)."
            )
        said = (
            f"These pixels determine a position of the arm to {mm['sigma']} RMS (sigma over the "
            "joints' whole range, lack of fit and the lenses' doubt included); the drawing knows "
            f"it to {mm['drawn']} (drawn_within), and the calibrated arm differs from it by "
            f"{mm['change']}"
        )
        if self.is_better:
            return f"{said}: the calibrated arm is better."
        if self.sigma >= self.drawn:
            return f"{said}: keep the drawn arm; take more images, nearer, with more tilt."
        return (
            f"{said}. By that the drawing is off by {mm['shown']}, too little to be sure: keep the "
            "drawn arm."
        )


NO_POSITION_CLAIM = PositionClaim(*[np.nan] * 4)


@dataclass(frozen=True, eq=False, repr=False)
class PixelCalibration(RelativeCalibration):
    """A robot calibrated by cameras.

    pixels: RMS and largest error by key [px].
    claim: of positions of the arm.  with_them: held-out accuracy with the pixels set aside.
    worst: what a minimax rests on, None where there was none.
    """

    worst: Annotated[WorstPixels | None, FieldFormat(key="minimax")] = None
    pixels: Annotated[Mapping[str, tuple[float, float]], SEPARATE_FIELD_FORMAT] = field(
        default_factory=dict
    )
    claim: Annotated[PositionClaim, FieldFormat(key="arm_position")] = NO_POSITION_CLAIM
    with_them: Annotated[
        Accuracy | None, FieldFormat(key="accuracy.holdout_with_them", brief=True)
    ] = None

    def accuracy_table(self) -> Table:
        """Errors in the image, and at the target, before and after, training and held out."""
        return Table.from_rows(
            f"{self.robot.name}: pixels, and the same at the target",
            [(title, a.poses, *self.pixels.get(key, UNKNOWN_ENDS), a.rms_mm, a.max_mm)
             for title, key in ACCURACY_TITLES_AND_KEYS for a in [self.accuracy[key]]],
            "poses | count d | RMS px .3f | max px .3f | RMS mm .4f | max mm .4f",
        )  # fmt: skip

    def claim_table(self) -> Table:
        """Positions of the arm: what pixels and the drawing know."""
        rows = (
            ("calibrated arm, sigma", 1e3 * self.claim.sigma),
            ("drawn arm, sigma (drawn_within)", 1e3 * self.claim.drawn),
            ("drawn arm, as pixels show it", 1e3 * self.claim.shown),
            ("calibrated against drawn", 1e3 * self.claim.change),
        )
        title = "positions over the joints' whole range, base and tool fitted"
        return Table.from_rows(title, rows, "arm | RMS mm .4f")

    def tables(self) -> tuple[Table, ...]:
        """Every table of the result."""
        worst = [self.worst.table()] if self.worst else []
        parameters = geometry_parameter_table(self.parameters)
        return (self.accuracy_table(), self.claim_table(), *worst, parameters)

    def first_tables(self) -> tuple[Table, ...]:
        """What stands on the first screen."""
        return (self.accuracy_table().shorten(),)

    def headline(self) -> str:
        """The result in some sentences, with what it does not say."""
        before, after, where = self.before_and_after()
        keys = (
            ("nominal", "holdout") if self.accuracy["holdout"].poses else ("nominal_train", "train")
        )
        (px_before, _), (px_after, _) = (self.pixels.get(key, UNKNOWN_ENDS) for key in keys)
        text = (
            f"Pixels: RMS error {px_before:.3f} px -> {px_after:.3f} px ({before.rms_mm:.3f} mm -> "
            f"{after.rms_mm:.3f} mm at the target), at {where}. That says nothing of the arm's "
            f"positions by itself. {self.claim.sentence()} {self.outcome}"
        )
        if self.set_aside:
            text += f" {len(self.set_aside)} pixels set aside as wrong."
        if self.reason:
            return f"{capitalise_sentence(self.reason)}. {text}"
        return text + (f" {self.status.advice}." if self.status.advice else "")

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """What pixels tell besides."""
        more = {
            "accuracy": {
                key: dict(zip(("rms_px", "max_px"), sizes, strict=True))
                for key, sizes in self.pixels.items()
            },
            "answered": self.worst.answered if self.worst else {},
            "calibrated_robot": self.calibrated or self.robot,
        }
        return merge_nested_mappings(super().extra_file_content(), more)

    @classmethod
    def parse_extra_fields(
        cls, content: Mapping[str, Any], parsed_fields: Mapping[str, Any], source: str
    ) -> dict[str, Any]:
        """As `RelativeCalibration`, and what pixels tell besides."""
        own = super().parse_extra_fields(content, parsed_fields, source)
        pixels = {key: (each.rms_px, each.max_px) for key, each in own["stated"].items()}
        return own | {"pixels": pixels}


def read_result(content: Mapping[str, Any], source: str) -> RelativeCalibration:
    """A calibration of other instruments than trackers from its JSON.  Raises CalibrationError."""
    kind = PixelCalibration if "arm_position" in content else RelativeCalibration
    return kind.from_dict(content, source)
