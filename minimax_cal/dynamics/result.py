"""What trajectories say of an arm's torques: a record, its file, its words and its tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from minimax_cal.dynamics.laws import LAWS, USUAL, Term
from minimax_cal.dynamics.model import Body, TorqueModel
from minimax_cal.dynamics.probes import Unexplained
from minimax_cal.dynamics.regressor import PER_LINK
from minimax_cal.dynamics.scene import YIELD, Arm
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError
from minimax_cal.ground.files import plain
from minimax_cal.ground.records import Number, Part, Recorded, checked, reading
from minimax_cal.ground.results import Result
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.modelling.effects.words import name_place
from minimax_cal.robots.robot import robot_from_dict

KIND = "motion_diagnosis"
SCHEMA = 1
WORDS = {"coulomb": "Coulomb friction", "viscous": "viscous friction",
         "link_inertia": "mass or inertia of a link"}  # fmt: skip
WORDS |= {name: law.words for name, law in LAWS.items()}
SHOWN = 1e-3  # relative change of a joint's RMS that is listed
SENTENCES = {
    "named": "Cause identified",
    "one_of": "Ambiguous cause",
    "unknown": "Unexplained",
    "none": "No cause beyond the rigid body",
}


@dataclass(frozen=True)
class Parameter:
    """A number of an effect, with its standard deviation."""

    name: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class Alternative:
    """Another effect that explains the same.  rho2: similarity.  separate_with: what would tell."""

    effect: str
    place: str
    rho2: float
    separate_with: str


@dataclass(frozen=True)
class MotionEffect:
    """An effect that the torques show.

    worth: of each joint that it changes, the held-out RMS without and with it.  frequency: share
    of the halves of the data in which it is found again, NaN where that was not asked.
    established: whether it is confirmed.  minor: whether it matters little beside usual friction.
    """

    effect: str
    place: str
    parameters: tuple[Recorded[Parameter], ...]
    worth: Mapping[str, tuple[float, float]]
    alternatives: tuple[Recorded[Alternative], ...] = ()
    frequency: float = math.nan
    established: bool = True
    minor: bool = False
    family: str = ""

    @property
    def words(self) -> str:
        """For people, as `joint flexibility at J2`; of a payload with the runs that carry it."""
        runs = ", ".join(p.name for p in self.parameters[PER_LINK:] if self.effect == "payload")
        return f"{WORDS[self.effect]} {name_place(self.place)}" + (f" ({runs})" if runs else "")


@dataclass(frozen=True)
class MotionStep:
    """A step of the error budget.  holdout_rms: of all rows, holdout_rms_moving: by joint."""

    name: str
    holdout_rms: tuple[float, ...]
    holdout_rms_moving: tuple[float, ...]


@dataclass(frozen=True)
class NotTestable:
    """An effect that the logs cannot show, and the run that would."""

    effect: str
    place: str
    needs: str


@dataclass(frozen=True)
class HeldRun:
    """A stretch of a run, measured and predicted by a fit without it: times and (n, k) torques."""

    name: str
    time: tuple[float, ...]
    measured: tuple[tuple[float, ...], ...]
    predicted: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class FrictionCurve:
    """Friction of a joint over its speed, with a standard deviation over fits without each fold."""

    place: str
    speed: tuple[float, ...]
    torque: tuple[float, ...]
    sigma: tuple[float, ...]


@dataclass(frozen=True, eq=False, repr=False)
class MotionDiagnosis(Result):
    """Why the torques of an arm are not those of its model, and how far each effect closes the gap.

    unit: "N m" or "A", of torques.  models: a fit of each step of the budget but the first.
    too_little: why the motion is too little to name anything, empty where it is enough.
    """

    unit: str
    verdict: str
    effects: tuple[MotionEffect, ...]
    budget: tuple[MotionStep, ...]
    unexplained: tuple[Unexplained, ...]
    not_testable: tuple[NotTestable, ...]
    too_little: tuple[str, ...]
    models: tuple[TorqueModel, ...]
    runs: tuple[str, ...]
    held_out: str
    held_run: HeldRun
    curves: tuple[FrictionCurve, ...]
    notices: tuple[str, ...]
    seconds: float = 0.0

    def __repr__(self) -> str:
        return f"<MotionDiagnosis of {self.arm.robot.name}: {self.headline()}>"

    @property
    def arm(self) -> Arm:
        """The arm, and how its torques are read."""
        return self.models[-1].arm

    @property
    def main(self) -> tuple[MotionEffect, ...]:
        """Confirmed effects that matter, by what they are worth."""
        return tuple(e for e in self.effects if e.established and not e.minor)

    def headline(self) -> str:
        """The verdict in a sentence or two."""
        if self.too_little:
            return f"Too little motion to name a cause: {self.too_little[0]}."
        said = SENTENCES[self.verdict]
        if self.main:
            said += f": {grouped(self.main)}"
        if self.unexplained and self.verdict in ("named", "unknown"):
            worst = self.unexplained[0]
            said += (
                f". {worst.size:.3g} {self.unit} at {worst.place} follow the {worst.follows} and "
                "have no name"
            )
        return f"{said}."

    def sentences(self) -> tuple[str, ...]:
        """The verdict, and how far the error of the torques falls on rows that no fit saw."""
        first, last = (np.array(self.budget[i].holdout_rms) for i in (0, -1))
        j = int(np.argmax(last / np.maximum(first, 1e-300)))
        fall = (
            f"RMS error of held-out torques, median of the joints: {np.median(first):.3g} "
            f"{self.unit} -> {np.median(last):.3g} {self.unit}; least at J{j + 1}, "
            f"{first[j]:.3g} -> {last[j]:.3g} {self.unit}."
        )
        return self.headline(), fall

    def tables(self) -> tuple[Table, ...]:
        """Every table of the result."""
        every = (self.budget_table(), self.effects_table(), self.unexplained_table())
        return tuple(table for table in every if table.rows)

    def budget_table(self) -> Table:
        """The error budget: held-out RMS of each joint, step by step."""
        title = f"Held-out RMS torque [{self.unit}], all rows ({self.held_out})"
        rows = [(step.name, step.holdout_rms) for step in self.budget]
        return table_by_joint(title, "step", rows)

    def effects_table(self) -> Table:
        """The effects, the most valuable first."""
        rows = []
        for one in self.effects:
            p = max(one.parameters, key=lambda each: abs(each.value) / (each.sigma or 1.0))
            joint, (before, after) = best_worth(one)
            sure = "yes" if one.established else "possible"
            rows.append((one.words, f"{p.value:.3g} ± {p.sigma:.1g} {p.unit}",
                         f"{joint}: {before:.3g} to {after:.3g}", sure))  # fmt: skip
        header = ("effect", "value", f"held-out RMS, moving [{self.unit}]", "confirmed")
        return Table("Effects", header, tuple(rows), ("", "", "", ""))

    def unexplained_table(self) -> Table:
        """What has no name, by joint."""
        rows = tuple((u.place, u.follows, u.size, u.noise) for u in self.unexplained)
        header = ("joint", "follows", f"size [{self.unit}]", f"remaining error [{self.unit}]")
        return Table("Unexplained", header, rows, ("", "", ".3g", ".3g"))

    def to_dict(self) -> dict[str, Any]:
        """The JSON of the contract, and more; `from_dict` reads it back."""
        return {
            "schema": SCHEMA,
            "kind": KIND,
            "robot": self.arm.robot.to_dict(),
            "headline": self.headline(),
            "too_little_motion": list(self.too_little),
            "arm": plain({name: getattr(self.arm, name) for name in ARM}),
            "models": [model_dict(model) for model in self.models],
            **plain({name: getattr(self, name) for name in KEPT}),
        }

    @staticmethod
    def from_dict(content: Mapping[str, Any], source: str = "motion diagnosis") -> MotionDiagnosis:
        """The diagnosis of a file.  Raises CalibrationError."""
        if content.get("kind") != KIND or content.get("schema") != SCHEMA:
            raise CalibrationError(
                f"{source}: is no motion diagnosis of this version; write it with minimax-cal "
                "torques"
            )
        part = checked(MotionPart, content, source)
        with reading(source):
            robot = robot_from_dict(part.robot, source)
            arm = Arm(robot, *(np.array(part.arm[name]) for name in ARM))
            found = MotionDiagnosis(
                **{name: getattr(part, name) for name in KEPT},
                too_little=part.too_little_motion,
                models=tuple(model_of(one, arm) for one in part.models),
            )
            check_parts(found, robot.joints)
            return found


ARM = ("gain", "ratio", "soft", "fastest", "known")  # numbers of an arm beside its robot


def grouped(effects: tuple[MotionEffect, ...]) -> str:
    """Effects in words, each once with all its places."""
    places: dict[str, list[str]] = {}
    for one in effects:
        places.setdefault(WORDS[one.effect], []).append(one.place)
    usual = [WORDS[name] for name in USUAL]
    order = sorted(places, key=lambda words: words in usual)  # what a toolbox has comes last
    return "; ".join(f"{words} at {', '.join(sorted(set(places[words])))}" for words in order)


def table_by_joint(title: str, what: str, rows: Sequence[tuple[str, Sequence[float]]]) -> Table:
    """A number of each joint, row by row.  what: the rows' names are."""
    joints = [f"J{j + 1}" for j in range(len(rows[0][1]))]
    cells: tuple[tuple[Cell, ...], ...] = tuple((name, *values) for name, values in rows)
    return Table(title, (what, *joints), cells, ("", *[".3g"] * len(joints)))


def worth_by_joint(without: Array, with_it: Array) -> dict[str, tuple[float, float]]:
    """RMS without and with something (n,) each, by joint."""
    pairs = zip(without, with_it, strict=True)
    return {f"J{j + 1}": (float(a), float(b)) for j, (a, b) in enumerate(pairs)}


def changed_joints(worth: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Of the joints that something changes by a thousandth or more."""
    return {joint: (a, b) for joint, (a, b) in worth.items() if abs(a - b) > SHOWN * a}


def best_worth(one: MotionEffect) -> tuple[str, tuple[float, float]]:
    """The joint at which an effect closes most, and the RMS without and with it."""
    return max(one.worth.items(), key=lambda item: item[1][0] ** 2 - item[1][1] ** 2)


def check_parts(found: MotionDiagnosis, joints: int) -> None:
    """Raise ValueError for parts that are not of one arm, and for effects that do not exist."""
    run = found.held_run
    rows = [row for step in found.budget for row in (step.holdout_rms, step.holdout_rms_moving)]
    if {len(row) for row in (*rows, run.measured, run.predicted)} != {joints}:
        raise ValueError(f"its numbers are not of {joints} joints")
    for trace in (*run.measured, *run.predicted):
        if len(trace) != len(run.time):
            raise ValueError("held_run: torques are not of the same times")
    for curve in found.curves:
        if not len(curve.speed) == len(curve.torque) == len(curve.sigma):
            raise ValueError("curves: numbers of one curve differ in their count")
    if len(found.curves) > joints or not found.models:
        raise ValueError("its curves or models are not of the arm")
    if not all(one.parameters and one.worth for one in found.effects):
        raise ValueError("effects: one has no parameters, or no worth")
    others = [other.effect for one in found.effects for other in one.alternatives]
    named = [*(one.effect for one in found.effects), *others]
    named += [untested.effect for untested in found.not_testable]
    if unknown := [name for name in named if name not in WORDS]:
        raise ValueError(f"no effect {unknown[0]!r:.40}")


def model_dict(model: TorqueModel) -> dict[str, Any]:
    """A model for JSON: parameters that joints share once."""

    def body(one: Body) -> dict[str, Any]:
        rows = one.rigid[:1] if model.arm.shared else one.rigid
        return {"rigid": rows.tolist(), "usual": one.usual.tolist()}

    terms = [
        {"effect": t.effect, "place": t.place, "tuned": dict(t.tuned), "value": v.tolist()}
        for t, v in zip(model.terms, model.value, strict=True)
    ]
    return {"name": model.name, "body": body(model.body), "context": body(model.context),
            "terms": terms, "held": model.held.tolist(), "delay": model.delay}  # fmt: skip


def model_of(content: Mapping[str, Any], arm: Arm) -> TorqueModel:
    """A model of a file."""
    n = arm.robot.joints

    def body(part: Mapping[str, Any]) -> Body:
        rigid = np.broadcast_to(np.array(part["rigid"], dtype=float), (n, 10 * n))
        return Body(rigid, np.array(part["usual"], dtype=float).reshape(n, 2))

    terms = tuple(
        Term(t["effect"], t["place"], tuple((k, float(v)) for k, v in t["tuned"].items()))
        for t in content["terms"]
    )
    value: tuple[Array, ...] = tuple(np.array(t["value"], dtype=float) for t in content["terms"])
    held = np.array(content["held"], dtype=float).reshape(n, len(YIELD))
    return TorqueModel(content["name"], arm, body(content["body"]), terms, value,
                       body(content["context"]), held, float(content["delay"]))  # fmt: skip


class MotionPart(Part):
    """The file of `minimax-cal torques -o`."""

    robot: dict[str, Any]
    arm: dict[str, tuple[Number, ...]]
    verdict: Literal["named", "one_of", "unknown", "none"]
    unit: str
    effects: tuple[Recorded[MotionEffect], ...]
    budget: tuple[Recorded[MotionStep], ...] = Field(min_length=1)
    unexplained: tuple[Recorded[Unexplained], ...]
    not_testable: tuple[Recorded[NotTestable], ...]
    too_little_motion: tuple[str, ...]
    models: tuple[dict[str, Any], ...]
    runs: tuple[str, ...]
    held_out: str
    held_run: Recorded[HeldRun]
    curves: tuple[Recorded[FrictionCurve], ...]
    notices: tuple[str, ...]
    seconds: Number


KEPT = ("unit", "verdict", "effects", "budget", "unexplained", "not_testable", "runs", "held_out",
        "held_run", "curves", "notices", "seconds")  # fmt: skip


def load_motion(path: Path | str) -> MotionDiagnosis:
    """A motion diagnosis from its file.

    Parameters
    ----------
    path
        Of the JSON that `save` or `minimax-cal torques -o` wrote.

    Returns
    -------
    MotionDiagnosis
        The diagnosis.

    Raises
    ------
    CalibrationError
        For a file that is none.

    Examples
    --------
    >>> motion = mc.load_motion("motion.json")
    """
    from minimax_cal.ground.files import saved_content  # only who reads a file waits for it

    return MotionDiagnosis.from_dict(saved_content(path), str(path))
