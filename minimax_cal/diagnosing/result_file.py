"""The file of a diagnosis: what `Diagnosis.from_dict` reads; `Diagnosis.to_dict` writes it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from minimax_cal.diagnosing.curves import Curve
from minimax_cal.diagnosing.remainder import Remainder
from minimax_cal.diagnosing.result import (
    CURVE,
    SCHEMA,
    Alternative,
    Diagnosis,
    Finding,
    Step,
)
from minimax_cal.evidence.limits import CONFIRMED
from minimax_cal.fitting.fit import Provenance
from minimax_cal.fitting.fit_file import (
    BeyondPart,
    ScoresPart,
    TableParameter,
    in_si,
    measured_poses,
    with_them_of,
)
from minimax_cal.ground.errors import CalibrationError
from minimax_cal.ground.files import numbers
from minimax_cal.ground.records import (
    AGAIN,
    UNKNOWN,
    Ends,
    Number,
    Part,
    Recorded,
    check_schema,
    checked,
)
from minimax_cal.measuring.aside import SetAside
from minimax_cal.measuring.floor import Floor
from minimax_cal.modelling.cell import Cell, cell_from_dict
from minimax_cal.modelling.effects.table import Term
from minimax_cal.solvers.status import Status

BELOW = math.nextafter(CONFIRMED, 0.0)  # what was tentative when it was written stays so


class FallPart(Part):
    """Held-out RMS without and with an effect [mm]."""

    before: Number = math.nan
    after: Number = math.nan


class FindingPart(Part):
    """An effect that was found.  size: lambda.  lines: rows of a fault of the data."""

    effect: str
    place: str
    share: Number = math.nan
    size: Number = Field(alias="lambda", default=math.nan)
    chance: Number = math.nan
    parameters: tuple[TableParameter, ...] = ()
    fixed: dict[str, Number] = Field(default_factory=dict)
    holdout_rms_mm: FallPart = FallPart()
    alternatives: tuple[Recorded[Alternative], ...] = ()
    lines: tuple[int, ...] = ()
    established: bool = True
    minor: bool = False
    frequency: Number = math.nan
    why_tentative: str | None = None
    curve: dict[str, list[Number]] = Field(default_factory=dict)

    @property
    def again(self) -> float:
        """How often it was found again, so that what was tentative stays so."""
        if self.established:
            return self.frequency if self.frequency >= CONFIRMED else 1.0
        return BELOW if self.frequency >= CONFIRMED else self.frequency

    def finding(self, known: Sequence[Term]) -> Finding:
        """As the code has it.  known: terms that were fitted, with their choices."""
        own = [t for t in known if (t.effect, t.place) == (self.effect, self.place)]
        told = [in_si(p) for p in self.parameters]
        return Finding(
            terms=tuple(own) or (Term(self.effect, self.place),),
            names=tuple(p.name for p in told),
            units=tuple(p.unit for p in told),
            values=tuple(p.value for p in told),
            sigmas=tuple(p.sigma for p in told),
            size=self.size,
            p_value=self.chance,
            alternatives=self.alternatives,
            share=self.share,
            before=self.holdout_rms_mm.before,
            after=self.holdout_rms_mm.after,
            fixed=self.fixed,
            rows=self.lines,
            again=self.again,
            minor=self.minor,
            curve=np.array([self.curve.get(key, []) for key in CURVE], dtype=float),
        )


class PlacePart(Part):
    """A share of what is still predictable."""

    place: str
    share: Number


class RemainderPart(Part):
    """What free functions still predict."""

    predictable_mm: Number
    where: tuple[PlacePart, ...] = ()
    unpredictable_mm: Number
    floor_mm: Ends | None = None

    def remainder(self) -> Remainder:
        """As the code has it."""
        where = tuple((one.place, one.share) for one in self.where)
        return Remainder(self.predictable_mm, where, self.unpredictable_mm, self.floor_mm)


class RungPart(Part):
    """One step of the gap ladder."""

    step: str
    train: ScoresPart
    holdout: ScoresPart
    trusted: ScoresPart | None = None

    def rung(self) -> Step:
        """As the code has it."""
        held = self.holdout.accuracy()
        trusted = self.trusted.accuracy() if self.trusted else held
        return Step(self.step, self.train.accuracy(), held, trusted)


class GapPart(Part):
    """The gap, how far it closes, and what noise would leave."""

    noise_floor_mm: Number = math.nan
    noise_floor_range_mm: Ends = UNKNOWN
    noise_floor_from: str = ""
    closed: Number = math.nan
    closed_ci95: Ends | None = None
    ladder: Annotated[tuple[RungPart, ...], Field(min_length=2)]
    beyond: BeyondPart


class NoisePart(Part):
    """Of instrument and joints."""

    instrument_mm: Number = math.nan
    joint_jitter_mrad: Number = math.nan


class StructurePart(Part):
    """Whether what remains is noise."""

    p: Number = math.nan
    place: str = Field(alias="in", default="")


class UntestablePart(Part):
    """What could not be tested, and what that needs."""

    effect: str
    needs: str


class SeriesPart(Part):
    """Values along an axis, or of a view; nested by target where each has its own."""

    label: str = ""
    name: str = ""
    values: list[Number] | list[list[Number]] = Field(default_factory=list)


class CurvePart(Part):
    """Something against something, in several views."""

    title: str
    x: SeriesPart
    y: SeriesPart
    views: tuple[SeriesPart, ...]

    def curve(self) -> Curve:
        """As the code has it.  Raises ValueError."""
        x = numbers(self.x.values)
        y = tuple(numbers(view.values) for view in self.views)
        if not (x.size and y) or any(part.shape != x.shape for part in y):
            raise ValueError(f"curve {self.title!r} has no values, or some that differ in length")
        return Curve(self.title, self.x.label, self.y.label, x, y)


class WithPart(Part):
    """The accuracy where points that were set aside count."""

    holdout_with_them: ScoresPart | None = None


class DiagnosisPart(Part):
    """The file of `minimax-cal diagnose -o`."""

    robot: str
    status: Status
    verdict: Literal["none", "named", "one_of", "unknown", "not_repeatable"]
    effects: tuple[FindingPart, ...]
    gap: GapPart
    set_aside: tuple[Recorded[SetAside], ...] = ()
    accuracy: WithPart = WithPart()
    remainder: RemainderPart | None = None
    noise: NoisePart = NoisePart()
    structure: StructurePart = StructurePart()
    where: dict[str, Any] = Field(default_factory=dict)
    not_testable: tuple[UntestablePart, ...] = ()
    curves: dict[str, CurvePart] = Field(default_factory=dict)
    notices: tuple[str, ...] = ()
    seconds: Number = math.nan
    meets_floor: bool | None = None
    provenance: Provenance


def read(content: Mapping[str, Any], source: str) -> Diagnosis:
    """A diagnosis from its JSON.  Raises CalibrationError."""
    check_schema(content, source, SCHEMA)
    if content.get("kind") != "diagnosis":
        raise CalibrationError(f"{source}: is no diagnosis; {AGAIN} diagnose")
    part = checked(DiagnosisPart, content, source)
    listed = enumerate(content.get("rungs", ()))
    cells = tuple(cell_from_dict(cell, f"{source}: rungs[{i}]") for i, cell in listed)
    if len({(cell.robot.joints, cell.target_names) for cell in cells}) > 1:
        raise CalibrationError(f"{source}: its cells are not of one arm; {AGAIN} diagnose")
    if not cells:
        raise CalibrationError(f"{source}: holds no arm; {AGAIN} diagnose")
    return replace(assembled(content, source, part, cells[1:]), nominal=cells[0])


def assembled(
    content: Mapping[str, Any], source: str, part: DiagnosisPart, cells: tuple[Cell, ...]
) -> Diagnosis:
    """The diagnosis from what was read.  Raises one of FAULTS."""
    fitted = cells[-1].effects.terms if cells else ()
    data, held, errors = measured_poses(content, source, cells[0] if cells else None, "geometric")
    return Diagnosis(
        robot=part.robot,
        status=part.status,
        verdict=part.verdict,
        effects=tuple(finding.finding(fitted) for finding in part.effects),
        ladder=tuple(rung.rung() for rung in part.gap.ladder),
        floor=Floor(
            part.gap.noise_floor_mm, *part.gap.noise_floor_range_mm, part.gap.noise_floor_from
        ),
        closed=part.gap.closed,
        closed_ci=part.gap.closed_ci95 or UNKNOWN,
        beyond=part.gap.beyond.beyond(),
        noise=1e-3 * part.noise.instrument_mm,
        jitter=1e-3 * part.noise.joint_jitter_mrad,
        structure=part.structure.p,
        structure_in=part.structure.place,
        where=part.where,
        not_testable=tuple((each.effect, each.needs) for each in part.not_testable),
        notices=part.notices,
        provenance=part.provenance,
        seconds=part.seconds,
        data=data,
        held=held,
        cells=cells,
        remainder=part.remainder.remainder() if part.remainder else None,
        set_aside=part.set_aside,
        with_them=with_them_of(part.accuracy.holdout_with_them),
        meets_floor=part.meets_floor,
        stated_errors=errors,
        stated_curves={name: curve.curve() for name, curve in part.curves.items()},
    )
