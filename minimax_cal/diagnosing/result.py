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

from minimax_cal.diagnosing.curves import Curve, Leftover, order_curve, residual_curve
from minimax_cal.evidence.limits import BAND, CONFIRMED, ENOUGH, LEVEL
from minimax_cal.evidence.remains import FOLLOWING
from minimax_cal.fitting.accuracy import Accuracy
from minimax_cal.fitting.beyond import Beyond
from minimax_cal.fitting.fit import Provenance
from minimax_cal.fitting.floor import REPEATS, Floor
from minimax_cal.fitting.pose_rows import measured_poses, pose_rows
from minimax_cal.fitting.set_aside import aside_sentence
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.errors import CalibrationError
from minimax_cal.ground.facts import APART, Fact, derived
from minimax_cal.ground.files import finite, number
from minimax_cal.ground.records import AGAIN, array, as_kind, stored
from minimax_cal.ground.results import Record, Result
from minimax_cal.ground.tables import Table, filled
from minimax_cal.ground.units import in_files
from minimax_cal.measuring.faults.fault import Amount
from minimax_cal.measuring.faults.nests import RESEAT
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements, SetAside
from minimax_cal.modelling.cell import Cell, cell_from_dict
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.modelling.effects.words import name_effect, name_place, name_step
from minimax_cal.modelling.frames import frames_of
from minimax_cal.robots.transforms import CONVENTION, Frame
from minimax_cal.solvers.status import Status

FOUND = (  # columns of the effects
    "effect | cause | share of error % .0f | before mm .4f | after mm .4f | p-value | evidence"
)
CURVE = ("q_rad", "turn_rad", "sigma_rad")
SURE = 1e-15  # a smaller chance is as good as none
SHOWN_LINES = 12  # lines of a fault that are told one by one
FAULTS = {
    "outliers": "single points that are off",
    "swapped_rows": "rows or targets that hold each other's points",
    "readback": "joint values that were read back before the arm had settled",
    RESEAT: "a reflector that was re-seated, or exchanged for one of another radius",
}
PEOPLES = {  # how people read a unit of the file
    "rad": (1e3, "mrad"),
    "rad/(N m)": (1e3, "mrad/(N m)"),
}
TOLD_AS = {"rad/(N m)": "mrad at most", "1/(N m^2)": "mm at most"}  # where masses are not told
NONE_HELPS = "no measurement"  # how what is proposed begins where nothing helps
VERDICTS = ("none", "named", "one_of", "unknown", "not_repeatable")
WORSE_OUTSIDE = "with the effects regions left out are met worse"
NAMED = {"geometric": "calibrated geometry (least squares)"}  # `calibrate` may have another
IF_REAL = "if the possible causes are real"
BELOW = math.nextafter(CONFIRMED, 0.0)  # what was tentative when it was written stays so


def as_motion(effect: str, unit: str) -> str:
    """How a value is told whose unit rests on masses that are not; '' where none does."""
    own = TOLD_AS.get(unit, "")
    moves = EFFECTS[effect].moves if effect in EFFECTS else "arm"
    return TOLD_AS["1/(N m^2)"] if own and moves == "foot" else own  # no joint turns


@dataclass(frozen=True)
class Alternative:
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
    def at(self) -> str:
        """Where, in words."""
        return name_place(self.place, self.effect)

    @property
    def name(self) -> str:
        """Effect and place, in words."""
        return name_effect(self.effect, self.place)

    @property
    def helps(self) -> bool:
        """Whether a measurement was found that is worth its while."""
        return bool(self.separate_with) and not self.separate_with.startswith(NONE_HELPS)


@dataclass(frozen=True, eq=False)
class Finding(Record):
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

    terms: Annotated[tuple[Term, ...], APART]
    names: Annotated[tuple[str, ...], APART]
    units: Annotated[tuple[str, ...], APART]
    values: Annotated[tuple[float, ...], APART]
    sigmas: Annotated[tuple[float, ...], APART]
    size: Annotated[float, Fact(key="lambda")] = math.nan
    p_value: Annotated[float, Fact(key="chance")] = math.nan
    alternatives: tuple[Alternative, ...] = ()
    share: float = math.nan
    before: Annotated[float, Fact(key="holdout_rms_mm.before")] = math.nan
    after: Annotated[float, Fact(key="holdout_rms_mm.after")] = math.nan
    fixed: Mapping[str, float] = field(default_factory=dict)
    rows: Annotated[tuple[int, ...], Fact(key="lines")] = ()
    motion: Annotated[tuple[float, ...], APART] = ()
    again: Annotated[float, Fact(key="frequency")] = 1.0
    extends: Annotated[bool, APART] = True
    minor: bool = False
    contradicted: str = ""
    curve: Annotated[Array, APART] = field(default_factory=lambda: np.zeros((3, 0)))
    shown: Annotated[tuple[Term, ...], APART] = ()

    @derived()
    def effect(self) -> str:
        """Its name in the library, or of a fault."""
        return self.term.effect

    @derived()
    def place(self) -> str:
        """As J2."""
        return self.term.place

    @derived()
    def established(self) -> bool:
        """Whether it is found again in nearly all subsamples of the poses."""
        return not self.why_tentative

    @derived()
    def why_tentative(self) -> str | None:
        """What keeps it from being confirmed; None if nothing does."""
        if not self.extends:
            return WORSE_OUTSIDE
        if math.isnan(self.again):
            return "poses too few to leave any out"
        return "not found again without some of the poses" if self.again < CONFIRMED else None

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
        return FAULTS.get(name, name)

    @property
    def at(self) -> str:
        """Where, in words."""
        return name_place(self.term.place, self.term.effect)

    @property
    def name(self) -> str:
        """Effect and place, in words."""
        return name_effect(self.term.effect, self.term.place)

    def points(self, data: Measurements) -> str:
        """The points that a fault of the data concerns."""
        if not self.rows:
            return ""
        more = len(self.rows) - SHOWN_LINES
        first, *others = map(data.called, self.rows[:SHOWN_LINES])
        kind = first.partition(" ")[0]
        named = ", ".join([first, *(name.removeprefix(f"{kind} ") for name in others)])
        return f" ({named}{f' and {more} more' if more > 0 else ''})"

    @property
    def chance(self) -> str:
        """Its probability by accident, which may be too small to matter how small."""
        p = self.p_value
        return "-" if math.isnan(p) else f"< {SURE:g}" if p < SURE else f"{p:.1g}"

    @derived()
    def parameters(self) -> list[dict[str, Any]]:
        """Each with value, sigma and unit, for JSON: lengths in millimetres.

        Where masses are not told, by the largest motion that it makes: mrad, or mm.
        """
        if self.curve.size:
            _, turn, sure = self.curve
            most = int(np.argmax(np.abs(turn)))
            ends = {"RMS": (rms(turn), rms(sure)), "largest": (abs(turn[most]), sure[most])}
            return [
                {"name": name, "value": float(value), "sigma": finite(float(sigma)), "unit": "rad"}
                for name, (value, sigma) in ends.items()
            ]
        scale = [in_files(unit)[0] for unit in self.units]
        units = tuple(in_files(unit)[1] for unit in self.units)
        if self.motion:
            scale = [1e3 * size for size in self.motion]
            units = tuple(as_motion(self.term.effect, unit) or unit for unit in self.units)
        return [
            {
                "name": name,
                "value": value * factor,
                "sigma": finite(sigma * factor),
                "unit": unit,
            }
            for name, unit, value, sigma, factor in zip(
                self.names, units, self.values, self.sigmas, scale, strict=True
            )
        ]

    @derived(key="curve", brief=True)
    def curve_columns(self) -> Mapping[str, Array]:
        """The curve of an error map by its columns."""
        return dict(zip(CURVE, self.curve, strict=True)) if self.curve.size else {}

    @staticmethod
    def told(content: Any, at: str, known: Sequence[Term]) -> Finding:
        """From `to_dict`.  known: terms that were fitted, with their choices.  Raises ValueError.

        What was tentative when it was written stays so.
        """
        told = stored(Finding, content, at)
        key = as_kind(tuple[str, str], [content["effect"], content["place"]], Fact(), at)
        own = tuple(term for term in known if term.key == key) or (Term(*key),)
        listed = content.get("parameters", [])
        every = as_kind(tuple[Amount, ...], listed, Fact(), f"{at}.parameters")
        again, curve = told.get("again", math.nan), content.get("curve", {})
        told["extends"] = content.get("why_tentative") != WORSE_OUTSIDE
        if told["extends"] and content.get("established", True) != (again >= CONFIRMED):
            told["again"] = 1.0 if content.get("established", True) else BELOW
        return Finding(
            **told,
            terms=own,
            names=tuple(p.name for p in every),
            units=tuple(p.unit for p in every),
            values=tuple(p.value for p in every),
            sigmas=tuple(p.sigma for p in every),
            curve=array([curve.get(key, []) for key in CURVE], f"{at}.curve"),
        )


class Dependence(NamedTuple):
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
        return f"{self.place}{FOLLOWING}{self.driver}"


@dataclass(frozen=True)
class Remaining:
    """What the last step leaves, by where it comes from; the squares of the parts add up.

    depends: what it certainly follows, the loudest first; they overlap, so the first is the part.
    unexplained_mm: RMS distance that neither that nor known noise accounts for.  noise_mm: of the
    noise, NaN where nothing tells; noise_from: how it is known.
    """

    depends: tuple[Dependence, ...]
    unexplained_mm: float
    noise_mm: float
    noise_from: str

    @property
    def dependent_mm(self) -> float:
        """RMS distance of what errors follow, 0 where that is nothing."""
        return self.depends[0].rms_mm if self.depends else 0.0

    def in_short(self, floor: tuple[float, float] | None) -> dict[str, Any]:
        """For JSON: what could be predicted, what not.  floor: ends of the noise [mm]."""
        noise = float(np.nan_to_num(self.noise_mm))
        return {
            "predictable_mm": self.dependent_mm,
            "where": [{"place": one.place, "share": 1.0} for one in self.depends[:1]],
            "unpredictable_mm": math.hypot(self.unexplained_mm, noise),
            "floor_mm": floor,
        }


@dataclass(frozen=True)
class Proposal:
    """One measurement to make next.

    kind: of it.  text: for whoever carries it out.  settles: what is known then.  poses_file: of
    its poses, None where any will do.  power: to tell that, `ENOUGH` does; None where that is not
    worked out.
    """

    kind: str
    text: str
    settles: str
    poses_file: str | None = None
    power: float | None = None


@dataclass(frozen=True)
class Step:
    """One rung of the gap ladder: accuracy on the training and on the held-out poses.

    trusted: on the held-out points that do not stand out.
    """

    name: Annotated[str, Fact(key="step")]
    train: Accuracy
    holdout: Accuracy
    trusted: Accuracy


def ends_of(steps: Sequence[Any], of: str = "holdout") -> dict[str, dict[str, float]]:
    """RMS and largest error of the first steps and the last, for JSON.  of: which poses."""
    ends = {"nominal": steps[0], "geometric": steps[1], "final": steps[-1]}
    return {kind: {name: getattr(getattr(step, of), kind) for name, step in ends.items()}
            for kind in ("rms_mm", "max_mm")}  # fmt: skip


class Untestable(NamedTuple):
    """An effect that the data cannot test, and what they lack for it."""

    effect: str
    needs: str


@dataclass(frozen=True, eq=False, kw_only=True)
class Explained:
    """What was explained, of whatever instruments: a verdict and its effects.

    status: of the fit of geometry.  verdict: one of VERDICTS.  effects: the largest first.
    jitter: of a joint [rad].
    structure: probability that what remains is unrelated to what structure_in names.
    not_testable: effects, and what the data lack for them.
    meets_floor: whether the remaining error is down to the known noise, None where that is not
    known.
    """

    status: Status
    verdict: Annotated[str, Fact(among=VERDICTS)]
    effects: Annotated[tuple[Finding, ...], APART]
    jitter: Annotated[float, Fact(key="noise.joint_jitter_mrad", scale=1e3)]
    structure: Annotated[float, Fact(key="structure.p")]
    structure_in: Annotated[str, Fact(key="structure.in")]
    not_testable: tuple[Untestable, ...]
    meets_floor: bool | None = None

    @property
    def excess(self) -> str:
        """How far the remaining error is above the known noise, in words."""
        raise NotImplementedError

    @property
    def shares_of(self) -> str:
        """Of which squared error the effects' shares are."""
        return "that geometry leaves"

    @property
    def main(self) -> list[Finding]:
        """The confirmed causes but for the minor ones, the largest first; at least one if any."""
        sure = [f for f in self.effects if f.established]
        return [f for f in sure if not f.minor] or sure[:1]

    @property
    def minor(self) -> list[Finding]:
        """The other confirmed causes."""
        main = self.main
        return [f for f in self.effects if f.established and f not in main]

    @property
    def minor_sizes(self) -> tuple[float, float]:
        """RMS that the minor causes explain, and what they take off the held-out RMS [mm]."""
        both = [(f.before, f.after) for f in self.minor if math.isfinite(f.before - f.after)]
        explained = sum(before**2 - after**2 for before, after in both)
        return math.sqrt(max(explained, 0.0)), sum(before - after for before, after in both)

    @property
    def by_rung(self) -> list[Finding]:
        """The effects in the order of the error budget."""
        return list(self.effects)

    def parameter_table(self) -> Table:
        """The parameters of every effect found: millimetres and milliradians."""
        rows = (
            (f.name, p["name"], scale * p["value"], scale * number(p["sigma"]), unit)
            for f in self.by_rung
            for p in f.parameters
            for scale, unit in (PEOPLES.get(p["unit"], (1.0, p["unit"])),)
        )
        columns = "effect | parameter | value .4g | sigma .2g | unit"
        return Table.made("parameters of the effects", rows, columns)

    def rival_table(self) -> Table:
        """What these data cannot tell from the effects found, and what would tell them apart."""
        none = "no measurement considered would"
        return Table.made(
            f"alternatives that these data do not exclude: they fit worse by less than {BAND:.0f}, "
            f"or the power is below {ENOUGH:.0f}; at similarity 1 both move the arm alike",
            [(f.name, a.name, a.rho2, a.power, a.loss, a.separate_with or none)
             for f in self.by_rung for a in f.alternatives],
            "effect | alternative | similarity .3f | power .3g | fits worse by .3g | "
            "what to measure next",
        )  # fmt: skip

    def untestable_table(self) -> Table:
        """Effects that are neither found nor excluded."""
        rows = ((name_effect(effect), needs) for effect, needs in self.not_testable)
        return Table.made("not testable with these data", rows, "effect | needs")


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Explained, Result):
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
    ladder: Annotated[tuple[Step, ...], Fact(key="gap.ladder", fewest=2)]
    floor: Annotated[Floor, APART]
    closed: Annotated[float, Fact(key="gap.closed")]
    closed_ci: Annotated[tuple[float, float], APART]
    beyond: Annotated[Beyond, Fact(key="gap.beyond")]
    noise: Annotated[float, Fact(key="noise.instrument_mm", scale=1e3)]
    where: Mapping[str, Any]
    notices: tuple[str, ...]
    provenance: Provenance
    seconds: float
    data: Annotated[Measurements, APART]
    held: Annotated[Array, APART]
    cells: Annotated[tuple[Cell, ...], APART]
    stated_errors: Annotated[tuple[Array, Array] | None, APART] = None
    stated_curves: Annotated[Mapping[str, Curve] | None, APART] = None
    nominal: Annotated[Cell | None, APART] = None
    remaining: Remaining | None = None
    set_aside: tuple[SetAside, ...] = ()
    with_them: Annotated[Accuracy | None, Fact(key="accuracy.holdout_with_them", brief=True)] = None
    floor_known: bool = True
    repeatable: bool = True
    tested: Annotated[tuple[float, float], Fact(key="gap.tested_mm")] = (math.nan, math.nan)
    refused: Annotated[float, Fact(key="gap.refused_outside_mm")] = math.nan
    possible: Annotated[Step | None, Fact(key="gap.possible")] = None
    possible_cell: Annotated[Cell | None, APART] = None

    def __repr__(self) -> str:
        return f"<Diagnosis of {self.robot}: {self.verdict}. {self.headline()}>"

    @derived()
    def reasons(self) -> tuple[str, ...]:
        """The verdict and why, in sentences."""
        from minimax_cal.diagnosing.sentences import reasons

        return reasons(self)

    @derived()
    def budget(self) -> list[dict[str, Any]]:
        """The error budget on held-out poses, to the arm that `calibrate --effects` fits."""
        rows = [self.budget_row(step) for step in self.ladder]
        rows[1]["outside_rms_mm"] = finite(self.beyond.geometric_typical_mm)
        if self.ladder[-1].name.startswith("+ "):
            rows[-1]["outside_rms_mm"] = finite(self.beyond.typical_mm)
        return rows

    @derived()
    def budget_possible(self) -> dict[str, Any] | None:
        """The same with the possible causes besides; None without any."""
        if self.possible is None:
            return None
        row = self.budget_row(replace(self.possible, name=IF_REAL))
        return {**row, "outside_rms_mm": finite(self.refused)}

    @staticmethod
    def budget_row(step: Step) -> dict[str, Any]:
        """A step for JSON."""
        told = step.holdout
        sizes = {"rms_mm": finite(told.rms_mm), "max_mm": finite(told.max_mm)}
        return {"name": step.name, **sizes, "outside_rms_mm": None, "poses": told.poses}

    @derived()
    def next(self) -> Proposal | None:
        """The one measurement to make next; None where none is worth it."""
        from minimax_cal.diagnosing.proposals import proposal

        return proposal(self, self.floor_known)

    @property
    def excess(self) -> str:
        """What the last step leaves, against the noise beneath it."""
        joints = "" if self.floor.source == REPEATS else ", with what sound joints add"
        low, high = self.tested
        noise = f"at most {high:.3f} mm ({self.floor.source}{joints})"
        return f"at least {low:.3f} mm on the poses of the fit against {noise}"

    @property
    def shares_of(self) -> str:
        """Of which squared error shares are: where noise has but an upper bound, of all."""
        return f"{super().shares_of}{' above noise' if self.floor.certain else ''}"

    @property
    def by_rung(self) -> list[Finding]:
        """The effects in the order of the ladder, faults of the data first."""
        rungs = [step.name for step in self.ladder]
        names = [f.term.step for f in self.effects]
        last = len(rungs)  # what is possible follows
        at = [last if not f.established else rungs.index(name) if name in rungs else 0
              for f, name in zip(self.effects, names, strict=True)]  # fmt: skip
        return [self.effects[i] for i in sorted(range(len(at)), key=at.__getitem__)]

    def leftover(self) -> Leftover:
        """What geometry leaves and what the effects leave, pose by pose."""
        found = [finding.term for finding in self.effects]
        return Leftover.of(self.data, self.held, self.noise, self.cells, found)

    @cached_property
    def errors(self) -> tuple[Array, Array]:
        """(m, k, 3) of all poses, geometry alone and with the effects, NaN not measured [m]."""
        if self.stated_errors is not None:
            return self.stated_errors
        told = with_history(self.data)
        return self.cells[0].error(told), self.cells[-1].error(told)

    @derived()
    def curves(self) -> Mapping[str, Curve]:
        """The errors against their cause (residual), and as the poses were visited (order)."""
        if self.stated_curves is not None:
            return self.stated_curves
        left = self.leftover()
        return {"residual": residual_curve(left), "order": order_curve(left)}

    def beside(self, *, poses: bool = True) -> dict[str, Any]:
        """The error budget in short, the arms, the poses."""
        held = {f"holdout_{kind}": ends for kind, ends in ends_of(self.ladder).items()}
        explained, gain = self.minor_sizes
        errors = dict(zip(("geometric", "final"), self.errors, strict=True))
        return {
            "remainder": self.remaining.in_short(self.floor.ends) if self.remaining else None,
            "effects": self.effects,
            "gap": {
                **held,
                "trusted_rms_mm": ends_of(self.ladder, "trusted")["rms_mm"],
                "noise_floor_mm": self.floor.value,
                "noise_floor_range_mm": [self.floor.low, self.floor.high],
                "noise_floor_from": self.floor.source,
                "minor_effects": {
                    "count": len(self.minor),
                    "explained_mm": explained,
                    "gain_mm": gain,
                },
                "closed_ci95": self.closed_ci if self.has_interval else None,
            },
            "frames": self.frames,
            "frames_convention": CONVENTION,
            "cells": [cell.whole() for cell in (self.cells[0], self.cells[-1])],
            "rungs": [{"name": name, **cell.whole()} for name, cell in self.rungs()],
            "rung_possible": self.possible_cell and self.possible_cell.whole(),
            "poses": pose_rows(self.data, self.held, errors),
        }

    @classmethod
    def told_beside(
        cls, content: Mapping[str, Any], told: Mapping[str, Any], source: str
    ) -> dict[str, Any]:
        """The arms, their effects and the poses, from a file."""
        listed = enumerate(content.get("rungs", ()))
        arms = [cell_from_dict(cell, f"{source}: rungs[{i}]") for i, cell in listed]
        if not arms:
            raise CalibrationError(f"{source}: holds no arm; {AGAIN} diagnose")
        nominal, *cells = arms
        if len({(cell.robot.joints, cell.target_names) for cell in arms}) > 1:
            raise CalibrationError(f"{source}: its cells are not of one arm; {AGAIN} diagnose")
        loose = content.get("rung_possible")
        more = cell_from_dict(loose, f"{source}: rung_possible") if loose else None
        fitted, first = (cells[-1].effects.terms, cells[0]) if cells else ((), None)
        fitted = more.effects.terms if more else fitted
        data, held, errors = measured_poses(content, source, first, "geometric")
        gap, pair = content["gap"], tuple[float, float]
        (low, high), closed = (
            as_kind(pair, gap.get(key), Fact(), f"gap.{key}")
            for key in ("noise_floor_range_mm", "closed_ci95")
        )
        floor, known = number(gap.get("noise_floor_mm")), str(gap.get("noise_floor_from", ""))
        effects = enumerate(content["effects"])
        return {
            "effects": tuple(Finding.told(each, f"effects[{i}]", fitted) for i, each in effects),
            "floor": Floor(floor, low, high, known),
            "closed_ci": closed,
            "data": data,
            "held": held,
            "cells": tuple(cells),
            "possible_cell": more,
            "floor_known": content.get("floor_known", told.get("meets_floor") is not None),
            "nominal": nominal,
            "stated_errors": errors,
            "stated_curves": {
                name: Curve.from_dict(curve, f"curves.{name}")
                for name, curve in content.get("curves", {}).items()
            },
        }

    @property
    def frames(self) -> dict[str, Frame]:
        """Where base and tool stand with all effects, and the corrections: `frames_of`."""
        return frames_of(self.cells[-1], self.nominal) if self.cells else {}

    @property
    def has_interval(self) -> bool:
        """Whether anything is known of how sure the share closed is."""
        return math.isfinite(self.closed_ci[0])

    def rungs(self) -> tuple[tuple[str, Cell], ...]:
        """Every arm with its name: nominal, geometric, then with each effect."""
        if self.nominal is None:
            return ()
        names = ("nominal", "geometric", *(c.effects.terms[-1].step for c in self.cells[1:]))
        return tuple(zip(names, (self.nominal, *self.cells), strict=True))

    def ladder_table(self) -> Table:
        """The error budget, step by step."""
        floor = self.floor.value
        steps = [(name_step(step.name), step) for step in self.ladder]
        return Table.of(
            f"{self.robot}: error budget, step by step",
            [*steps, *([(IF_REAL, self.possible)] if self.possible else [])],
            "0=model | 1.train.rms_mm=train RMS mm .4f | 1.train.max_mm=train max mm .4f | "
            "1.holdout.rms_mm=held-out RMS mm .4f | 1.holdout.max_mm=held-out max mm .4f",
        ).plus((f"noise floor ({self.floor.source})", floor, "", floor, ""))

    def first_tables(self) -> tuple[Table, ...]:
        """What stands on the first screen: the budget, minor effects that follow each other as one.

        What the possible causes would do stands below.
        """
        if not self.ladder:
            return ()
        small = {f.term.step for f in self.minor}
        every: list[tuple[str, Accuracy]] = []
        for is_minor, steps in groupby(self.ladder, key=lambda step: step.name in small):
            some = list(steps)
            if is_minor and len(some) > 1:
                every.append((f"+ {len(some)} minor effects", some[-1].holdout))
            else:
                every += [(NAMED.get(s.name) or name_step(s.name), s.holdout) for s in some]
        if self.possible:
            every.append((IF_REAL, self.possible.holdout))
        known = "" if self.floor.certain else ", at most"
        title = "error budget, step by step, on held-out poses"
        shown = Table.of(title, every, "0=model | 1.rms_mm=RMS mm .3f | 1.max_mm=max mm .3f")
        return (shown.plus((f"measurement noise{known}", self.floor.value, "")),)

    def effects_table(self) -> Table:
        """The effects found, with what each does for held-out poses; possible ones last."""
        found = sorted(self.by_rung, key=lambda f: not f.established)
        rows = (
            (f"{f.name}{f.points(self.data)}",
             "as above" if f.cause in [e.cause for e in found[:i]] else f.cause,
             100.0 * f.share + 0.0, f.before, f.after, f.chance, f.evidence)
            for i, f in enumerate(found)
        )  # fmt: skip
        title = f"effects found, step by step; p-values below {LEVEL:g} are significant"
        every = Table.made(title, rows, FOUND)
        plain = every.only(*range(len(every.header) - 1))  # without what says one thing
        one = all(f.established and not (f.alternatives or f.contradicted) for f in found)
        return plain if one else every

    def tables(self) -> tuple[Table, ...]:
        """Every table of the result, but for those of where the errors lie."""
        return filled(
            self.ladder_table(), self.beyond.table(), self.effects_table(), self.parameter_table(),
            self.rival_table(), self.untestable_table(),
        )  # fmt: skip

    @property
    def said(self) -> tuple[str, ...]:
        """The verdict and why, and what was set aside, in sentences."""
        aside = aside_sentence(self.set_aside, self.with_them) if self.set_aside else ""
        return tuple(filter(None, [*self.reasons, aside]))

    def headline(self) -> str:
        """The verdict in words."""
        return " ".join(self.said)


def load_diagnosis(path: Path | str) -> Diagnosis:
    """The diagnosis that `Diagnosis.save` or `minimax-cal diagnose -o` wrote.

    Raises CalibrationError.
    """
    return Diagnosis.load(path)
