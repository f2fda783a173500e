"""What trajectories say of an arm's torques: a record, its file, its words and its tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.record_fields import SEPARATE_FIELD_FORMAT, FieldFormat
from minimax_cal.core.record_parsing import parse_record_fields
from minimax_cal.core.results import Result
from minimax_cal.core.tables import Table, drop_empty_tables
from minimax_cal.dynamics.laws import TORQUE_EFFECT_WORDS, USUAL_FRICTION_EFFECTS
from minimax_cal.dynamics.regressor import INERTIAL_PARAMETERS_PER_LINK
from minimax_cal.dynamics.residual_structure import Unexplained
from minimax_cal.dynamics.torque_regression import TorqueModel
from minimax_cal.dynamics.torque_rows import BRISTLE_YIELD_DISTANCES, TorqueArm
from minimax_cal.measuring.faults.data_fault import FaultAmount
from minimax_cal.modelling.effects.effect_names import format_place
from minimax_cal.robots.robot import robot_from_dict

MotionVerdict = Literal["named", "one_of", "unknown", "none"]
MIN_LISTED_RELATIVE_RMS_CHANGE = 1e-3  # relative change of a joint's RMS that is listed
MOTION_VERDICT_SENTENCES: dict[MotionVerdict, str] = {
    "named": "Cause identified",
    "one_of": "Ambiguous cause",
    "unknown": "Unexplained",
    "none": "No cause beyond the rigid body",
}


@dataclass(frozen=True)
class MotionAlternative:
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
    parameters: Annotated[tuple[FaultAmount, ...], FieldFormat(fewest=1)]
    worth: Mapping[str, tuple[float, float]]
    alternatives: tuple[MotionAlternative, ...] = ()
    frequency: float = math.nan
    established: bool = True
    minor: bool = False
    family: str = ""

    @property
    def joint_of_largest_gain(self) -> tuple[str, tuple[float, float]]:
        """The joint at which it closes most, and the RMS without and with it."""
        return max(self.worth.items(), key=lambda item: item[1][0] ** 2 - item[1][1] ** 2)

    @property
    def relative_gain(self) -> float:
        """Fall of the squared RMS at the joint at which it closes most, over the square before."""
        before, after = self.joint_of_largest_gain[1]
        return (before**2 - after**2) / max(before**2, 1e-300)

    @property
    def words(self) -> str:
        """For people, as `joint flexibility at J2`; of a payload with the runs that carry it."""
        runs = ", ".join(
            p.name
            for p in self.parameters[INERTIAL_PARAMETERS_PER_LINK:]
            if self.effect == "payload"
        )
        return f"{TORQUE_EFFECT_WORDS[self.effect]} {format_place(self.place)}" + (
            f" ({runs})" if runs else ""
        )

    def build_table_row(self) -> tuple[str, ...]:
        """Of a table: words, the surest number, the worth where it is most, and whether it is."""
        p = max(self.parameters, key=lambda each: abs(each.value) / (each.sigma or 1.0))
        joint, (before, after) = self.joint_of_largest_gain
        return (self.words, f"{p.value:.3g} ± {p.sigma:.1g} {p.unit}",
                f"{joint}: {before:.3g} to {after:.3g}",
                "yes" if self.established else "possible")  # fmt: skip


@dataclass(frozen=True)
class MotionStep:
    """A step of the error budget.  holdout_rms: of all rows, holdout_rms_moving: by joint."""

    name: str
    holdout_rms: tuple[float, ...]
    holdout_rms_moving: tuple[float, ...]


@dataclass(frozen=True)
class UntestableMotionEffect:
    """An effect that the logs cannot show, and the run that would."""

    effect: str
    place: str
    needs: str


@dataclass(frozen=True, eq=False)
class HeldOutRun:
    """A stretch of a run, measured and predicted by a fit without it: times and (n, k) torques."""

    name: str
    time: tuple[float, ...]
    measured: Array
    predicted: Array


@dataclass(frozen=True, eq=False)
class FrictionCurve:
    """Friction of a joint over its speed, with a standard deviation over fits without each fold."""

    place: str
    speed: Array
    torque: Array
    sigma: Array


@dataclass(frozen=True, eq=False, repr=False)
class MotionDiagnosis(Result):
    """Why the torques of an arm are not those of its model, and how far each effect closes the gap.

    arm: and how its torques are read.  unit: "N m" or "A", of torques.
    models: a fit of each step of the budget but the first.
    too_little: why the motion is too little to name anything, empty where it is enough.
    """

    KIND = "motion_diagnosis"
    COMMAND = "torques"
    arm: Annotated[TorqueArm, SEPARATE_FIELD_FORMAT]
    unit: str
    verdict: MotionVerdict
    effects: tuple[MotionEffect, ...]
    budget: Annotated[tuple[MotionStep, ...], FieldFormat(fewest=1)]
    unexplained: tuple[Unexplained, ...]
    not_testable: tuple[UntestableMotionEffect, ...]
    too_little: Annotated[tuple[str, ...], FieldFormat(key="too_little_motion")]
    models: Annotated[tuple[TorqueModel, ...], FieldFormat(fewest=1)]
    runs: tuple[str, ...]
    held_out: str
    held_run: HeldOutRun
    curves: tuple[FrictionCurve, ...]
    notices: tuple[str, ...]
    seconds: float

    def __repr__(self) -> str:
        return f"<MotionDiagnosis of {self.arm.robot.name}: {self.headline()}>"

    @property
    def main(self) -> tuple[MotionEffect, ...]:
        """Confirmed effects that matter, by what they are worth."""
        return tuple(e for e in self.effects if e.established and not e.minor)

    def headline(self) -> str:
        """The verdict in a sentence or two."""
        if self.too_little:
            return f"Too little motion to name a cause: {self.too_little[0]}."
        said = MOTION_VERDICT_SENTENCES[self.verdict]
        if self.main:
            places: dict[str, set[str]] = {}
            for one in sorted(
                self.main, key=lambda one: one.effect in USUAL_FRICTION_EFFECTS
            ):  # those come last
                places.setdefault(TORQUE_EFFECT_WORDS[one.effect], set()).add(one.place)
            named = (f"{words} at {', '.join(sorted(some))}" for words, some in places.items())
            said += f": {'; '.join(named)}"
        if self.unexplained and self.verdict in ("named", "unknown"):
            said += f". {self.unexplained[0].describe_structure(self.unit)}"
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
        return drop_empty_tables(
            self.budget_table(), self.effects_table(), self.unexplained_table()
        )

    def budget_table(self, which: str = "all", of: str = "holdout_rms") -> Table:
        """The error budget: held-out RMS of each joint, step by step.  which: rows, of: those."""
        title = f"Held-out RMS torque [{self.unit}], {which} rows ({self.held_out})"
        return build_table_by_joint(title, "step", self.budget, of)

    def effects_table(self) -> Table:
        """The effects, the most valuable first."""
        rows = (one.build_table_row() for one in self.effects)
        worth = f"held-out RMS, moving [{self.unit}]"
        return Table.from_rows("Effects", rows, "effect | value", worth, "confirmed")

    def unexplained_table(self) -> Table:
        """What has no name, by joint."""
        return Table.from_records("Unexplained", self.unexplained, "place=joint | follows",
                        f"size=size [{self.unit}] .3g",
                        f"noise=remaining error [{self.unit}] .3g")  # fmt: skip

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """The headline, and the arm with its robot for itself."""
        return {"headline": self.headline(), "robot": self.arm.robot, "arm": self.arm}

    @classmethod
    def parse_extra_fields(
        cls, content: Mapping[str, Any], parsed_fields: Mapping[str, Any], source: str
    ) -> dict[str, Any]:
        """The arm.  Raises CalibrationError and ValueError, also for parts of another arm."""
        robot = robot_from_dict(content["robot"], source)
        arm = TorqueArm(robot, **parse_record_fields(TorqueArm, content["arm"], "arm"))
        check_diagnosis_is_of_one_arm(cls(**parsed_fields, arm=arm))
        return {"arm": arm}


def build_table_by_joint(
    title: str, name_heading: str, records: Sequence[object], attribute: str
) -> Table:
    """A number of each joint, a row a record.  name_heading: their names are; attribute: the
    attribute.
    """
    joints = range(len(getattr(records[0], attribute)))
    return Table.from_records(
        title, records, f"name={name_heading}", *(f"{attribute}.{j}=J{j + 1} .3g" for j in joints)
    )


def pair_rms_by_joint(rms_without: Array, rms_with: Array) -> dict[str, tuple[float, float]]:
    """RMS without and with something (n,) each, by joint."""
    pairs = np.stack([rms_without, rms_with], axis=1).tolist()
    return {f"J{j + 1}": (before, after) for j, (before, after) in enumerate(pairs)}


def pair_changed_rms_by_joint(
    rms_without: Array, rms_with: Array
) -> dict[str, tuple[float, float]]:
    """`pair_rms_by_joint` of the joints that something changes by a thousandth or more."""
    worth = pair_rms_by_joint(rms_without, rms_with).items()
    return {
        joint: (a, b) for joint, (a, b) in worth if abs(a - b) > MIN_LISTED_RELATIVE_RMS_CHANGE * a
    }


def check_diagnosis_is_of_one_arm(diagnosis: MotionDiagnosis) -> None:
    """Raise ValueError for parts that are not of one arm, and for effects that do not exist."""
    arm, run, n = diagnosis.arm, diagnosis.held_run, diagnosis.arm.robot.joints
    sizes: list[tuple[Any, tuple[int, ...]]] = [
        *((row, (n,)) for row in (arm.ratio, arm.soft, arm.fastest, diagnosis.curves)),
        *((row, (n,)) for s in diagnosis.budget for row in (s.holdout_rms, s.holdout_rms_moving)),
        (arm.gain, (n if arm.has_shared_inertial_parameters else 0,)),
        (arm.known, (INERTIAL_PARAMETERS_PER_LINK,)),
        *((part, (n, len(run.time))) for part in (run.measured, run.predicted)),
        *((p, (len(c.speed),)) for c in diagnosis.curves for p in (c.speed, c.torque, c.sigma)),
    ]
    for model in diagnosis.models:
        sizes.append((model.held, (n, len(BRISTLE_YIELD_DISTANCES))))
        for body in (model.body, model.context):
            joints = 1 if len(body.rigid) == 1 else n
            sizes += [
                (body.usual, (n, 2)),
                (body.rigid, (joints, INERTIAL_PARAMETERS_PER_LINK * n)),
            ]
    late = [model.delay for model in diagnosis.models]
    if any(np.shape(part) != size for part, size in sizes) or not np.isfinite(late).all():
        raise ValueError(f"its numbers are not of one arm of {n} joints and one run")
    if not all(one.worth for one in diagnosis.effects):
        raise ValueError("effects: one has no worth")
    names = [one.effect for one in diagnosis.effects] + [
        one.effect for one in diagnosis.not_testable
    ]
    names += [other.effect for one in diagnosis.effects for other in one.alternatives]
    for name in names:
        if name not in TORQUE_EFFECT_WORDS:
            raise ValueError(f"no effect {name!r:.40}")


def load_motion(path: MotionDiagnosis | Path | str) -> MotionDiagnosis:
    """A motion diagnosis from its file.

    Parameters
    ----------
    path
        Of the JSON that `save` or `minimax-cal torques -o` wrote; a diagnosis stays as it is.

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
    return MotionDiagnosis.load(path)
