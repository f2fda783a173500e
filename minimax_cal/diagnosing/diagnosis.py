"""The result of a diagnosis: what is still wrong, why, and how far it shrinks once known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array, rms
from minimax_cal.core.errors import CalibrationError
from minimax_cal.core.files import finite_or_none, float_from_json
from minimax_cal.core.record_fields import SEPARATE_FIELD_FORMAT, FieldFormat, derived_field
from minimax_cal.core.record_parsing import (
    WRITE_AGAIN_ADVICE,
    parse_array,
    parse_as_type,
    parse_record_fields,
)
from minimax_cal.core.results import JsonRecord, Result
from minimax_cal.core.tables import Table, drop_empty_tables
from minimax_cal.core.units import file_unit
from minimax_cal.diagnosing.residual_curves import (
    ResidualCurve,
    ResidualViews,
    build_residual_curve,
    build_visit_order_curve,
)
from minimax_cal.fitting.accuracy import Accuracy
from minimax_cal.fitting.fit import Provenance
from minimax_cal.fitting.noise_floor import REPEATS, NoiseFloor
from minimax_cal.fitting.pose_records import build_pose_records, parse_measured_poses
from minimax_cal.fitting.region_holdout import RegionHoldout
from minimax_cal.fitting.set_aside_points import describe_points_set_aside
from minimax_cal.measuring.faults.data_fault import FaultAmount
from minimax_cal.measuring.faults.target_steps import TARGET_RESEAT_EFFECT
from minimax_cal.measuring.measurements import Measurements, SetAsidePoint
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.cell import Cell, cell_from_dict
from minimax_cal.modelling.cell_frames import build_cell_frames
from minimax_cal.modelling.effects.effect_names import (
    format_budget_step,
    format_effect,
    format_place,
)
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.robots.transforms import ABC_ANGLES_CONVENTION, Frame
from minimax_cal.selection.remaining_structure import PLACE_DRIVER_SEPARATOR
from minimax_cal.selection.thresholds import (
    ALTERNATIVE_EVIDENCE_DEFICIT,
    FALSE_NAME_PROBABILITY,
    MIN_CONFIRMED_FREQUENCY,
    SUFFICIENT_SEPARATION_POWER,
)
from minimax_cal.solvers.status import Status

EFFECT_TABLE_COLUMNS = (  # columns of the effects
    "effect | cause | share of error % .0f | before mm .4f | after mm .4f | p-value | evidence"
)
CURVE_COLUMN_NAMES = ("q_rad", "turn_rad", "sigma_rad")
MIN_REPORTED_P_VALUE = 1e-15  # a smaller chance is as good as none
MAX_SHOWN_FAULT_LINES = 12  # lines of a fault that are told one by one
FAULT_DESCRIPTIONS = {
    "outliers": "single points that are off",
    "swapped_rows": "rows or targets that hold each other's points",
    "readback": "joint values that were read back before the arm had settled",
    TARGET_RESEAT_EFFECT: "a reflector that was re-seated, or exchanged for one of another radius",
}
DISPLAY_UNITS = {  # how people read a unit of the file
    "rad": (1e3, "mrad"),
    "rad/(N m)": (1e3, "mrad/(N m)"),
}
MOTION_UNITS_WITHOUT_MASSES = {
    "rad/(N m)": "mrad at most",
    "1/(N m^2)": "mm at most",
}  # where masses are not told
NO_MEASUREMENT_PREFIX = "no measurement"  # how what is proposed begins where nothing helps
VERDICTS = ("none", "named", "one_of", "unknown", "not_repeatable")
WORSE_OUTSIDE_TEXT = "with the effects regions left out are met worse"
STEP_DISPLAY_NAMES = {
    "geometric": "calibrated geometry (least squares)"
}  # `calibrate` may have another
POSSIBLE_STEP_NAME = "if the possible causes are real"
TENTATIVE_FREQUENCY = math.nextafter(
    MIN_CONFIRMED_FREQUENCY, 0.0
)  # what was tentative when it was written stays so


def motion_unit(effect_name: str, unit: str) -> str:
    """How a value is told whose unit rests on masses that are not; '' where none does."""
    own = MOTION_UNITS_WITHOUT_MASSES.get(unit, "")
    moves = EFFECTS[effect_name].moves if effect_name in EFFECTS else "arm"
    return (
        MOTION_UNITS_WITHOUT_MASSES["1/(N m^2)"] if own and moves == "foot" else own
    )  # no joint turns


@dataclass(frozen=True)
class AlternativeEffect:
    """Another effect that these data cannot tell from the one named.

    rho2: how much of the named effect's motion it imitates.  power: lambda (1 - rho2), about 25 is
    enough to tell them apart.  loss: by how much worse it fits, in -2 log likelihood.
    separate_with: the cheapest further measurement that would tell them apart.
    """

    effect: str
    place: str
    rho2: float
    power: float
    loss: float
    separate_with: str = ""

    @property
    def place_text(self) -> str:
        """Where, in words."""
        return format_place(self.place, self.effect)

    @property
    def name(self) -> str:
        """Effect and place, in words."""
        return format_effect(self.effect, self.place)

    @property
    def has_helpful_measurement(self) -> bool:
        """Whether a measurement was found that is worth its while."""
        return bool(self.separate_with) and not self.separate_with.startswith(NO_MEASUREMENT_PREFIX)


@dataclass(frozen=True, eq=False)
class Finding(JsonRecord):
    """One effect found, or a fault of the data.

    terms: what is fitted; several lines of one gear are one effect.  values, sigmas, names, units:
    of its parameters, SI.  size: lambda, the weighed square of its projected motion.  p_value:
    probability of so much by accident, the whole library tried.  share: of the gap that it closes
    on held-out poses, NaN where noise alone leaves as much.  before, after: held-out RMS without
    and with it, the larger effects being known [mm].  rows: of a data fault.  motion: the largest
    that a unit of each parameter makes at the poses of the fit [rad, or m for a bending], where its
    own unit rests on masses that nobody told; empty otherwise.  again: frequency, the share of the
    subsamples of the poses in which it is found again; NaN where poses are too few to ask.  minor:
    whether it is below 5 % of the squared held-out error that geometry leaves.  extends: False
    where the effects together make regions that are left out worse than geometry alone.
    curve: (3, g) of an error map: joint value, turn, sigma [rad].
    contradicted: where by what was measured besides, as in x by the foot; empty where nowhere.
    shown: the terms that the data ask for, where `terms` are the whole law that these belong to.
    """

    terms: Annotated[tuple[Term, ...], SEPARATE_FIELD_FORMAT]
    names: Annotated[tuple[str, ...], SEPARATE_FIELD_FORMAT]
    units: Annotated[tuple[str, ...], SEPARATE_FIELD_FORMAT]
    values: Annotated[tuple[float, ...], SEPARATE_FIELD_FORMAT]
    sigmas: Annotated[tuple[float, ...], SEPARATE_FIELD_FORMAT]
    size: Annotated[float, FieldFormat(key="lambda")] = math.nan
    p_value: Annotated[float, FieldFormat(key="chance")] = math.nan
    alternatives: tuple[AlternativeEffect, ...] = ()
    share: float = math.nan
    before: Annotated[float, FieldFormat(key="holdout_rms_mm.before")] = math.nan
    after: Annotated[float, FieldFormat(key="holdout_rms_mm.after")] = math.nan
    fixed: Mapping[str, float] = field(default_factory=dict)
    rows: Annotated[tuple[int, ...], FieldFormat(key="lines")] = ()
    motion: Annotated[tuple[float, ...], SEPARATE_FIELD_FORMAT] = ()
    again: Annotated[float, FieldFormat(key="frequency")] = 1.0
    extends: Annotated[bool, SEPARATE_FIELD_FORMAT] = True
    minor: bool = False
    contradicted: str = ""
    curve: Annotated[Array, SEPARATE_FIELD_FORMAT] = field(default_factory=lambda: np.zeros((3, 0)))
    shown: Annotated[tuple[Term, ...], SEPARATE_FIELD_FORMAT] = ()

    @derived_field()
    def effect(self) -> str:
        """Its name in the library, or of a fault."""
        return self.term.effect

    @derived_field()
    def place(self) -> str:
        """As J2."""
        return self.term.place

    @derived_field()
    def established(self) -> bool:
        """Whether it is found again in nearly all subsamples of the poses."""
        return not self.why_tentative

    @derived_field()
    def why_tentative(self) -> str | None:
        """What keeps it from being confirmed; None if nothing does."""
        if not self.extends:
            return WORSE_OUTSIDE_TEXT
        if math.isnan(self.again):
            return "poses too few to leave any out"
        return (
            "not found again without some of the poses"
            if self.again < MIN_CONFIRMED_FREQUENCY
            else None
        )

    @property
    def evidence(self) -> str:
        """Whether it is confirmed, and the frequency that decides."""
        sure = "one of these" if self.alternatives else "confirmed"
        said = sure if self.established else "possible"
        often = "" if self.rows or math.isnan(self.again) else f", {self.again:.2f}"
        return f"{said}{often}{f', contradicted {self.contradicted}' if self.contradicted else ''}"

    @property
    def term(self) -> Term:
        """The effect and its place; of several lines the strongest."""
        return self.terms[0]

    @property
    def cause(self) -> str:
        """What it is, in a few words."""
        name = self.term.effect
        if name in EFFECTS and not self.rows:
            return EFFECTS[name].cause
        return FAULT_DESCRIPTIONS.get(name, name)

    @property
    def place_text(self) -> str:
        """Where, in words."""
        return format_place(self.term.place, self.term.effect)

    @property
    def name(self) -> str:
        """Effect and place, in words."""
        return format_effect(self.term.effect, self.term.place)

    def describe_fault_points(self, data: Measurements) -> str:
        """The points that a fault of the data concerns."""
        if not self.rows:
            return ""
        more = len(self.rows) - MAX_SHOWN_FAULT_LINES
        first, *others = map(data.called, self.rows[:MAX_SHOWN_FAULT_LINES])
        kind = first.partition(" ")[0]
        named = ", ".join([first, *(name.removeprefix(f"{kind} ") for name in others)])
        return f" ({named}{f' and {more} more' if more > 0 else ''})"

    @property
    def p_value_text(self) -> str:
        """Its probability by accident, which may be too small to matter how small."""
        p = self.p_value
        return (
            "-"
            if math.isnan(p)
            else f"< {MIN_REPORTED_P_VALUE:g}"
            if p < MIN_REPORTED_P_VALUE
            else f"{p:.1g}"
        )

    @derived_field()
    def parameters(self) -> list[dict[str, Any]]:
        """Each with value, sigma and unit, for JSON: lengths in millimetres.

        Where masses are not told, by the largest motion that it makes: mrad, or mm.
        """
        if self.curve.size:
            _, turn, sure = self.curve
            most = int(np.argmax(np.abs(turn)))
            ends = {"RMS": (rms(turn), rms(sure)), "largest": (abs(turn[most]), sure[most])}
            return [
                {
                    "name": name,
                    "value": float(value),
                    "sigma": finite_or_none(float(sigma)),
                    "unit": "rad",
                }
                for name, (value, sigma) in ends.items()
            ]
        scale = [file_unit(unit)[0] for unit in self.units]
        units = tuple(file_unit(unit)[1] for unit in self.units)
        if self.motion:
            scale = [1e3 * size for size in self.motion]
            units = tuple(motion_unit(self.term.effect, unit) or unit for unit in self.units)
        return [
            {
                "name": name,
                "value": value * factor,
                "sigma": finite_or_none(sigma * factor),
                "unit": unit,
            }
            for name, unit, value, sigma, factor in zip(
                self.names, units, self.values, self.sigmas, scale, strict=True
            )
        ]

    @derived_field(key="curve", brief=True)
    def curve_columns(self) -> Mapping[str, Array]:
        """The curve of an error map by its columns."""
        return dict(zip(CURVE_COLUMN_NAMES, self.curve, strict=True)) if self.curve.size else {}

    @staticmethod
    def parse_finding(content: Any, location: str, fitted_terms: Sequence[Term]) -> Finding:
        """From `to_dict`.  fitted_terms: terms that were fitted, with their choices.  Raises
        ValueError.

        What was tentative when it was written stays so.
        """
        told = parse_record_fields(Finding, content, location)
        key = parse_as_type(
            tuple[str, str], [content["effect"], content["place"]], FieldFormat(), location
        )
        own = tuple(term for term in fitted_terms if term.key == key) or (Term(*key),)
        listed = content.get("parameters", [])
        every = parse_as_type(
            tuple[FaultAmount, ...], listed, FieldFormat(), f"{location}.parameters"
        )
        again, curve = told.get("again", math.nan), content.get("curve", {})
        told["extends"] = content.get("why_tentative") != WORSE_OUTSIDE_TEXT
        if told["extends"] and content.get("established", True) != (
            again >= MIN_CONFIRMED_FREQUENCY
        ):
            told["again"] = 1.0 if content.get("established", True) else TENTATIVE_FREQUENCY
        return Finding(
            **told,
            terms=own,
            names=tuple(p.name for p in every),
            units=tuple(p.unit for p in every),
            values=tuple(p.value for p in every),
            sigmas=tuple(p.sigma for p in every),
            curve=parse_array(
                [curve.get(key, []) for key in CURVE_COLUMN_NAMES], f"{location}.curve"
            ),
        )


class DriverDependence(NamedTuple):
    """What errors still follow: a motion of a place, by a driver.

    rms_mm: RMS distance of it, as far as it tells.  p: chance that anything that was asked is so
    loud.
    """

    place: str
    driver: str
    rms_mm: float
    p: float

    @property
    def name(self) -> str:
        """As J2 following time."""
        return f"{self.place}{PLACE_DRIVER_SEPARATOR}{self.driver}"


@dataclass(frozen=True)
class RemainingError:
    """What the last step leaves, by where it comes from; the squares of the parts add up.

    depends: what it certainly follows, the loudest first; they overlap, so the first is the part.
    unexplained_mm: RMS distance that neither that nor known noise accounts for.  noise_mm: of the
    noise, NaN where nothing tells; noise_from: how it is known.
    """

    depends: tuple[DriverDependence, ...]
    unexplained_mm: float
    noise_mm: float
    noise_from: str

    @property
    def dependent_mm(self) -> float:
        """RMS distance of what errors follow, 0 where that is nothing."""
        return self.depends[0].rms_mm if self.depends else 0.0

    def to_short_dict(self, floor: tuple[float, float] | None) -> dict[str, Any]:
        """For JSON: what could be predicted, what not.  floor: ends of the noise [mm]."""
        noise = float(np.nan_to_num(self.noise_mm))
        return {
            "predictable_mm": self.dependent_mm,
            "where": [{"place": one.place, "share": 1.0} for one in self.depends[:1]],
            "unpredictable_mm": math.hypot(self.unexplained_mm, noise),
            "floor_mm": floor,
        }


@dataclass(frozen=True)
class MeasurementProposal:
    """One measurement to make next.

    kind: of it.  text: for whoever carries it out.  settles: what is known then.  poses_file: of
    its poses, None where any will do.  power: to tell that, `SUFFICIENT_SEPARATION_POWER` does;
    None where that is not worked out.
    """

    kind: str
    text: str
    settles: str
    poses_file: str | None = None
    power: float | None = None


@dataclass(frozen=True)
class BudgetStep:
    """One rung of the gap ladder: accuracy on the training and on the held-out poses.

    trusted: on the held-out points that do not stand out.
    """

    name: Annotated[str, FieldFormat(key="step")]
    train: Accuracy
    holdout: Accuracy
    trusted: Accuracy


def summarise_first_and_last_steps(
    steps: Sequence[Any], pose_set: str = "holdout"
) -> dict[str, dict[str, float]]:
    """RMS and largest error of the first steps and the last, for JSON.  pose_set: which poses."""
    ends = {"nominal": steps[0], "geometric": steps[1], "final": steps[-1]}
    return {kind: {name: getattr(getattr(step, pose_set), kind) for name, step in ends.items()}
            for kind in ("rms_mm", "max_mm")}  # fmt: skip


class UntestableEffect(NamedTuple):
    """An effect that the data cannot test, and what they lack for it."""

    effect: str
    needs: str


@dataclass(frozen=True, eq=False, kw_only=True)
class Explanation:
    """What was explained, of whatever instruments: a verdict and its effects.

    status: of the fit of geometry.  verdict: one of VERDICTS.  effects: the largest first.
    jitter: of a joint [rad].
    structure: probability that what remains is unrelated to what structure_in names.
    not_testable: effects, and what the data lack for them.
    meets_floor: whether the remaining error is down to the known noise, None where that is not
    known.
    """

    status: Status
    verdict: Annotated[str, FieldFormat(among=VERDICTS)]
    effects: Annotated[tuple[Finding, ...], SEPARATE_FIELD_FORMAT]
    jitter: Annotated[float, FieldFormat(key="noise.joint_jitter_mrad", scale=1e3)]
    structure: Annotated[float, FieldFormat(key="structure.p")]
    structure_in: Annotated[str, FieldFormat(key="structure.in")]
    not_testable: tuple[UntestableEffect, ...]
    meets_floor: bool | None = None

    @property
    def describe_excess(self) -> str:
        """How far the remaining error is above the known noise, in words."""
        raise NotImplementedError

    @property
    def describe_share_reference(self) -> str:
        """Of which squared error the effects' shares are."""
        return "that geometry leaves"

    @property
    def main_findings(self) -> list[Finding]:
        """The confirmed causes but for the minor ones, the largest first; at least one if any."""
        sure = [f for f in self.effects if f.established]
        return [f for f in sure if not f.minor] or sure[:1]

    @property
    def minor_findings(self) -> list[Finding]:
        """The other confirmed causes."""
        main = self.main_findings
        return [f for f in self.effects if f.established and f not in main]

    @property
    def minor_effect_sizes(self) -> tuple[float, float]:
        """RMS that the minor causes explain, and what they take off the held-out RMS [mm]."""
        both = [
            (f.before, f.after) for f in self.minor_findings if math.isfinite(f.before - f.after)
        ]
        explained = sum(before**2 - after**2 for before, after in both)
        return math.sqrt(max(explained, 0.0)), sum(before - after for before, after in both)

    @property
    def findings_in_step_order(self) -> list[Finding]:
        """The effects in the order of the error budget."""
        return list(self.effects)

    def parameter_table(self) -> Table:
        """The parameters of every effect found: millimetres and milliradians."""
        rows = (
            (f.name, p["name"], scale * p["value"], scale * float_from_json(p["sigma"]), unit)
            for f in self.findings_in_step_order
            for p in f.parameters
            for scale, unit in (DISPLAY_UNITS.get(p["unit"], (1.0, p["unit"])),)
        )
        columns = "effect | parameter | value .4g | sigma .2g | unit"
        return Table.from_rows("parameters of the effects", rows, columns)

    def alternative_table(self) -> Table:
        """What these data cannot tell from the effects found, and what would tell them apart."""
        none = "no measurement considered would"
        return Table.from_rows(
            f"alternatives that these data do not exclude: they fit worse "
            f"by less than {ALTERNATIVE_EVIDENCE_DEFICIT:.0f}, "
            f"or the power is below {SUFFICIENT_SEPARATION_POWER:.0f}"
            f"; at similarity 1 both move the arm alike",
            [
                (f.name, a.name, a.rho2, a.power, a.loss, a.separate_with or none)
                for f in self.findings_in_step_order
                for a in f.alternatives
            ],
            "effect | alternative | similarity .3f | power .3g | fits worse by .3g | "
            "what to measure next",
        )

    def untestable_table(self) -> Table:
        """Effects that are neither found nor excluded."""
        rows = ((format_effect(effect), needs) for effect, needs in self.not_testable)
        return Table.from_rows("not testable with these data", rows, "effect | needs")


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Explanation, Result):
    """What is still wrong with a calibrated robot.

    ladder: nominal, geometric, then with each confirmed effect, to the arm that is recommended;
    possible: with the possible ones besides, None without any, and its arm possible_cell.
    beyond: on whole parts left out, effects searched again without each.
    floor: RMS that noise alone would leave.
    closed: share of the gap closed, 0 to 1, with its interval, NaN where it says nothing.
    noise: of a coordinate [m].
    where: see `where.Where.to_dict`.  data: as it was fitted, faults mended; held: (m,) True where
    held out.  cells: geometric, then with each effect.  nominal: before, None in an old file.
    set_aside: points that no fit counts; with_them: how the last step does where they count.
    remaining: what the last step leaves, None in an old file.  floor_known: whether all noise
    beneath it is: that of the joints, which only visits to one pose tell, where it matters.
    repeatable: False where visits to one pose scatter more than instrument and sound joints do.
    tested: lower 95 % limit of the remaining error, and what noise may add up to at most [mm].
    refused: RMS outside with the effects, where geometry alone is better and recommended [mm].
    stated_errors, stated_curves: as they stand in the file that the diagnosis was read from.
    """

    KIND = "diagnosis"
    COMMAND = "diagnose"

    robot: str
    ladder: Annotated[tuple[BudgetStep, ...], FieldFormat(key="gap.ladder", fewest=2)]
    floor: Annotated[NoiseFloor, SEPARATE_FIELD_FORMAT]
    closed: Annotated[float, FieldFormat(key="gap.closed")]
    closed_ci: Annotated[tuple[float, float], SEPARATE_FIELD_FORMAT]
    beyond: Annotated[RegionHoldout, FieldFormat(key="gap.beyond")]
    noise: Annotated[float, FieldFormat(key="noise.instrument_mm", scale=1e3)]
    where: Mapping[str, Any]
    notices: tuple[str, ...]
    provenance: Provenance
    seconds: float
    data: Annotated[Measurements, SEPARATE_FIELD_FORMAT]
    held: Annotated[Array, SEPARATE_FIELD_FORMAT]
    cells: Annotated[tuple[Cell, ...], SEPARATE_FIELD_FORMAT]
    stated_errors: Annotated[tuple[Array, Array] | None, SEPARATE_FIELD_FORMAT] = None
    stated_curves: Annotated[Mapping[str, ResidualCurve] | None, SEPARATE_FIELD_FORMAT] = None
    nominal: Annotated[Cell | None, SEPARATE_FIELD_FORMAT] = None
    remaining: RemainingError | None = None
    set_aside: tuple[SetAsidePoint, ...] = ()
    with_them: Annotated[
        Accuracy | None, FieldFormat(key="accuracy.holdout_with_them", brief=True)
    ] = None
    floor_known: bool = True
    repeatable: bool = True
    tested: Annotated[tuple[float, float], FieldFormat(key="gap.tested_mm")] = (math.nan, math.nan)
    refused: Annotated[float, FieldFormat(key="gap.refused_outside_mm")] = math.nan
    possible: Annotated[BudgetStep | None, FieldFormat(key="gap.possible")] = None
    possible_cell: Annotated[Cell | None, SEPARATE_FIELD_FORMAT] = None

    def __repr__(self) -> str:
        return f"<Diagnosis of {self.robot}: {self.verdict}. {self.headline()}>"

    @derived_field()
    def reasons(self) -> tuple[str, ...]:
        """The verdict and why, in sentences."""
        from minimax_cal.diagnosing.diagnosis_sentences import describe_diagnosis

        return describe_diagnosis(self)

    @derived_field()
    def budget(self) -> list[dict[str, Any]]:
        """The error budget on held-out poses, to the arm that `calibrate --effects` fits."""
        rows = [self.build_budget_row(step) for step in self.ladder]
        rows[1]["outside_rms_mm"] = finite_or_none(self.beyond.geometric_typical_mm)
        if self.ladder[-1].name.startswith("+ "):
            rows[-1]["outside_rms_mm"] = finite_or_none(self.beyond.typical_mm)
        return rows

    @derived_field()
    def budget_possible(self) -> dict[str, Any] | None:
        """The same with the possible causes besides; None without any."""
        if self.possible is None:
            return None
        row = self.build_budget_row(replace(self.possible, name=POSSIBLE_STEP_NAME))
        return {**row, "outside_rms_mm": finite_or_none(self.refused)}

    @staticmethod
    def build_budget_row(step: BudgetStep) -> dict[str, Any]:
        """A step for JSON."""
        told = step.holdout
        sizes = {"rms_mm": finite_or_none(told.rms_mm), "max_mm": finite_or_none(told.max_mm)}
        return {"name": step.name, **sizes, "outside_rms_mm": None, "poses": told.poses}

    @derived_field()
    def next(self) -> MeasurementProposal | None:
        """The one measurement to make next; None where none is worth it."""
        from minimax_cal.diagnosing.proposals import propose_next_measurement

        return propose_next_measurement(self, self.floor_known)

    @property
    def describe_excess(self) -> str:
        """What the last step leaves, against the noise beneath it."""
        joints = "" if self.floor.source == REPEATS else ", with what sound joints add"
        low, high = self.tested
        noise = f"at most {high:.3f} mm ({self.floor.source}{joints})"
        return f"at least {low:.3f} mm on the poses of the fit against {noise}"

    @property
    def describe_share_reference(self) -> str:
        """Of which squared error shares are: where noise has but an upper bound, of all."""
        return (
            f"{super().describe_share_reference}{' above noise' if self.floor.is_certain else ''}"
        )

    @property
    def findings_in_step_order(self) -> list[Finding]:
        """The effects in the order of the ladder, faults of the data first."""
        rungs = [step.name for step in self.ladder]
        names = [f.term.budget_step_name for f in self.effects]
        last = len(rungs)  # what is possible follows
        at = [last if not f.established else rungs.index(name) if name in rungs else 0
              for f, name in zip(self.effects, names, strict=True)]  # fmt: skip
        return [self.effects[i] for i in sorted(range(len(at)), key=at.__getitem__)]

    def leftover(self) -> ResidualViews:
        """What geometry leaves and what the effects leave, pose by pose."""
        found = [finding.term for finding in self.effects]
        return ResidualViews.from_cells(self.data, self.held, self.noise, self.cells, found)

    @cached_property
    def errors(self) -> tuple[Array, Array]:
        """(m, k, 3) of all poses, geometry alone and with the effects, NaN not measured [m]."""
        if self.stated_errors is not None:
            return self.stated_errors
        told = add_history_columns(self.data)
        return self.cells[0].error(told), self.cells[-1].error(told)

    @derived_field()
    def curves(self) -> Mapping[str, ResidualCurve]:
        """The errors against their cause (residual), and as the poses were visited (order)."""
        if self.stated_curves is not None:
            return self.stated_curves
        left = self.leftover()
        return {"residual": build_residual_curve(left), "order": build_visit_order_curve(left)}

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """The error budget in short, the arms, the poses."""
        held = {
            f"holdout_{kind}": ends
            for kind, ends in summarise_first_and_last_steps(self.ladder).items()
        }
        explained, gain = self.minor_effect_sizes
        errors = dict(zip(("geometric", "final"), self.errors, strict=True))
        return {
            "remainder": self.remaining.to_short_dict(self.floor.interval_mm)
            if self.remaining
            else None,
            "effects": self.effects,
            "gap": {
                **held,
                "trusted_rms_mm": summarise_first_and_last_steps(self.ladder, "trusted")["rms_mm"],
                "noise_floor_mm": self.floor.value,
                "noise_floor_range_mm": [self.floor.low, self.floor.high],
                "noise_floor_from": self.floor.source,
                "minor_effects": {
                    "count": len(self.minor_findings),
                    "explained_mm": explained,
                    "gain_mm": gain,
                },
                "closed_ci95": self.closed_ci if self.has_interval else None,
            },
            "frames": self.frames,
            "frames_convention": ABC_ANGLES_CONVENTION,
            "cells": [cell.whole() for cell in (self.cells[0], self.cells[-1])],
            "rungs": [{"name": name, **cell.whole()} for name, cell in self.rungs()],
            "rung_possible": self.possible_cell and self.possible_cell.whole(),
            "poses": build_pose_records(self.data, self.held, errors),
        }

    @classmethod
    def parse_extra_fields(
        cls, content: Mapping[str, Any], parsed_fields: Mapping[str, Any], source: str
    ) -> dict[str, Any]:
        """The arms, their effects and the poses, from a file."""
        listed = enumerate(content.get("rungs", ()))
        arms = [cell_from_dict(cell, f"{source}: rungs[{i}]") for i, cell in listed]
        if not arms:
            raise CalibrationError(f"{source}: holds no arm; {WRITE_AGAIN_ADVICE} diagnose")
        nominal, *cells = arms
        if len({(cell.robot.joints, cell.target_names) for cell in arms}) > 1:
            raise CalibrationError(
                f"{source}: its cells are not of one arm; {WRITE_AGAIN_ADVICE} diagnose"
            )
        loose = content.get("rung_possible")
        more = cell_from_dict(loose, f"{source}: rung_possible") if loose else None
        fitted, first = (cells[-1].effects.terms, cells[0]) if cells else ((), None)
        fitted = more.effects.terms if more else fitted
        data, held, errors = parse_measured_poses(content, source, first, "geometric")
        gap, pair = content["gap"], tuple[float, float]
        (low, high), closed = (
            parse_as_type(pair, gap.get(key), FieldFormat(), f"gap.{key}")
            for key in ("noise_floor_range_mm", "closed_ci95")
        )
        floor, known = (
            float_from_json(gap.get("noise_floor_mm")),
            str(gap.get("noise_floor_from", "")),
        )
        effects = enumerate(content["effects"])
        return {
            "effects": tuple(
                Finding.parse_finding(each, f"effects[{i}]", fitted) for i, each in effects
            ),
            "floor": NoiseFloor(floor, low, high, known),
            "closed_ci": closed,
            "data": data,
            "held": held,
            "cells": tuple(cells),
            "possible_cell": more,
            "floor_known": content.get("floor_known", parsed_fields.get("meets_floor") is not None),
            "nominal": nominal,
            "stated_errors": errors,
            "stated_curves": {
                name: ResidualCurve.from_dict(curve, f"curves.{name}")
                for name, curve in content.get("curves", {}).items()
            },
        }

    @property
    def frames(self) -> dict[str, Frame]:
        """Where base and tool stand with all effects, and the corrections: `build_cell_frames`."""
        return build_cell_frames(self.cells[-1], self.nominal) if self.cells else {}

    @property
    def has_interval(self) -> bool:
        """Whether anything is known of how sure the share closed is."""
        return math.isfinite(self.closed_ci[0])

    def rungs(self) -> tuple[tuple[str, Cell], ...]:
        """Every arm with its name: nominal, geometric, then with each effect."""
        if self.nominal is None:
            return ()
        names = (
            "nominal",
            "geometric",
            *(c.effects.terms[-1].budget_step_name for c in self.cells[1:]),
        )
        return tuple(zip(names, (self.nominal, *self.cells), strict=True))

    def budget_table(self) -> Table:
        """The error budget, step by step."""
        floor = self.floor.value
        steps = [(format_budget_step(step.name), step) for step in self.ladder]
        return Table.from_records(
            f"{self.robot}: error budget, step by step",
            [*steps, *([(POSSIBLE_STEP_NAME, self.possible)] if self.possible else [])],
            "0=model | 1.train.rms_mm=train RMS mm .4f | 1.train.max_mm=train max mm .4f | "
            "1.holdout.rms_mm=held-out RMS mm .4f | 1.holdout.max_mm=held-out max mm .4f",
        ).with_rows((f"noise floor ({self.floor.source})", floor, "", floor, ""))

    def first_tables(self) -> tuple[Table, ...]:
        """What stands on the first screen: the budget, minor effects that follow each other as one.

        What the possible causes would do stands below.
        """
        if not self.ladder:
            return ()
        small = {f.term.budget_step_name for f in self.minor_findings}
        every: list[tuple[str, Accuracy]] = []
        for is_minor, steps in groupby(self.ladder, key=lambda step: step.name in small):
            some = list(steps)
            if is_minor and len(some) > 1:
                every.append((f"+ {len(some)} minor effects", some[-1].holdout))
            else:
                every += [
                    (STEP_DISPLAY_NAMES.get(s.name) or format_budget_step(s.name), s.holdout)
                    for s in some
                ]
        if self.possible:
            every.append((POSSIBLE_STEP_NAME, self.possible.holdout))
        known = "" if self.floor.is_certain else ", at most"
        title = "error budget, step by step, on held-out poses"
        shown = Table.from_records(
            title, every, "0=model | 1.rms_mm=RMS mm .3f | 1.max_mm=max mm .3f"
        )
        return (shown.with_rows((f"measurement noise{known}", self.floor.value, "")),)

    def effects_table(self) -> Table:
        """The effects found, with what each does for held-out poses; possible ones last."""
        found = sorted(self.findings_in_step_order, key=lambda f: not f.established)
        rows = (
            (f"{f.name}{f.describe_fault_points(self.data)}",
             "as above" if f.cause in [e.cause for e in found[:i]] else f.cause,
             100.0 * f.share + 0.0, f.before, f.after, f.p_value_text, f.evidence)
            for i, f in enumerate(found)
        )  # fmt: skip
        title = (
            f"effects found, step by step; p-values below "
            f"{FALSE_NAME_PROBABILITY:g} are significant"
        )
        every = Table.from_rows(title, rows, EFFECT_TABLE_COLUMNS)
        plain = every.select_columns(*range(len(every.header) - 1))  # without what says one thing
        one = all(f.established and not (f.alternatives or f.contradicted) for f in found)
        return plain if one else every

    def tables(self) -> tuple[Table, ...]:
        """Every table of the result, but for those of where the errors lie."""
        return drop_empty_tables(
            self.budget_table(), self.beyond.table(), self.effects_table(), self.parameter_table(),
            self.alternative_table(), self.untestable_table(),
        )  # fmt: skip

    @property
    def said(self) -> tuple[str, ...]:
        """The verdict and why, and what was set aside, in sentences."""
        aside = describe_points_set_aside(self.set_aside, self.with_them) if self.set_aside else ""
        return tuple(filter(None, [*self.reasons, aside]))

    def headline(self) -> str:
        """The verdict in words."""
        return " ".join(self.said)


def load_diagnosis(path: Path | str) -> Diagnosis:
    """The diagnosis that `Diagnosis.save` or `minimax-cal diagnose -o` wrote.

    Raises CalibrationError.
    """
    return Diagnosis.load(path)
