"""How far a simulated arm is from the real one, rung by rung."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np

from minimax_cal.core.display_text import capitalise_sentence
from minimax_cal.core.files import convert_to_plain_json
from minimax_cal.core.record_fields import FieldFormat, derived_field
from minimax_cal.core.results import Result
from minimax_cal.core.tables import Table
from minimax_cal.dynamics.result import MotionEffect, build_table_by_joint
from minimax_cal.fitting.fit import Provenance
from minimax_cal.modelling.effects.effect_names import format_budget_step
from minimax_cal.solvers.status import Status

MAX_RELATIVE_DEVIATION_FROM_FIT, MAX_DEVIATION_FROM_FIT_MM = (
    0.1,
    0.02,
)  # of an error: a simulator that holds what a fit claims [-, mm]


@dataclass(frozen=True)
class GapStep:
    """How far the simulator misses with a model, base and targets fitted to the training poses.

    why: what is wrong, or what this rung mends.  holdout_*, train_*: distances [mm].  sag_mrad:
    largest that a joint stands from its command.  predicted_rms_mm: held out, by the formulas of
    the fit, NaN where there is none.  moving_poses: at which the arm did not come to rest.
    at_limit: largest share of the timesteps at which a joint was at its force limit.
    """

    name: str
    holdout_rms_mm: float
    holdout_max_mm: float
    train_rms_mm: float
    train_max_mm: float
    sag_mrad: float
    predicted_rms_mm: float = math.nan
    why: str = ""
    moving_poses: int = 0
    at_limit: float = 0.0

    @property
    def agrees_with_fit(self) -> bool:
        """Whether the simulator does what the formulas of the fit say; True where none do."""
        off = abs(self.holdout_rms_mm - self.predicted_rms_mm)
        return not off > max(
            MAX_RELATIVE_DEVIATION_FROM_FIT * self.predicted_rms_mm, MAX_DEVIATION_FROM_FIT_MM
        )


@dataclass(frozen=True, eq=False, repr=False)
class SimulatorGap(Result):
    """The gap between a simulator's model and measurements, as a ladder in the simulator itself.

    rungs: as given, without servo sag, with calibrated geometry, with each effect.  commands: the
    last of them with its command map, None where nothing is mapped.  floor: what noise alone would
    leave [mm], floor_from: how that is known.  status: of the last fit.  beyond: its claim for
    poses where none was measured, by its own formulas.  left_out: effects that the simulator has no
    element for.  written: where the last step's model was written, empty where it was not.
    """

    KIND = "simulator_gap"
    COMMAND = "gap"
    model: str
    robot: str
    rungs: Annotated[tuple[GapStep, ...], FieldFormat(fewest=1)]
    commands: Annotated[GapStep | None, FieldFormat(key="with_commands")]
    floor: Annotated[float, FieldFormat(key="noise_floor_mm")]
    floor_from: Annotated[str, FieldFormat(key="noise_floor_from")]
    train_poses: Annotated[int, FieldFormat(key="poses.train")]
    holdout_poses: Annotated[int, FieldFormat(key="poses.holdout")]
    status: Status
    beyond: Mapping[str, Any]
    left_out: tuple[str, ...]
    notices: tuple[str, ...]
    written: str
    seconds: float
    provenance: Provenance

    def __repr__(self) -> str:
        return f"<SimulatorGap of {self.model}: {self.headline()}>"

    @property
    def all_steps(self) -> tuple[GapStep, ...]:
        """The rungs, and the one with the command map."""
        return (*self.rungs, *([self.commands] if self.commands else []))

    @derived_field()
    def holds(self) -> bool:
        """Whether what was corrected last, and its command map, do what the fit claims."""
        return self.rungs[-1].agrees_with_fit and (
            self.commands is None or self.commands.agrees_with_fit
        )

    def table(self) -> Table:
        """The ladder."""
        ladder = Table.from_records(
            f"{self.robot} in the simulator: errors on {self.holdout_poses} held-out poses",
            [(format_budget_step(rung.name), rung) for rung in self.all_steps],
            "0=model | 1.holdout_rms_mm=RMS mm .4f | 1.holdout_max_mm=max mm .4f | "
            "1.predicted_rms_mm=fit says mm .4f | 1.sag_mrad=joints off mrad .3f | 1.why=",
        )
        noise = ("noise floor", self.floor, None, None, None, self.floor_from)
        return ladder.with_rows(noise) if math.isfinite(self.floor) else ladder

    def first_tables(self) -> tuple[Table, ...]:
        """The ladder, without what explains its rungs."""
        return (self.table().shorten("model", "RMS mm", "max mm", "fit says mm"),)

    def headline(self) -> str:
        """The result in a sentence or two."""
        first, last = self.rungs[0], self.rungs[-1]
        text = (
            f"As given, the simulated arm misses the real one by {first.holdout_rms_mm:.3f} mm RMS "
            f"on {self.holdout_poses} held-out poses (largest {first.holdout_max_mm:.3f} mm)"
        )
        falls = [a.holdout_rms_mm - b.holdout_rms_mm for a, b in pairwise(self.rungs)]
        if falls:
            most = max(range(len(falls)), key=falls.__getitem__)
            text += (
                f"; corrected, by {last.holdout_rms_mm:.3f} mm (largest {last.holdout_max_mm:.3f} "
                f"mm). Most is gained by: {format_budget_step(self.rungs[most + 1].name)}"
            )
        if self.commands:
            text += f". With its command map {self.commands.holdout_rms_mm:.3f} mm remain"
        typical, worst = (self.beyond.get(key) for key in ("typical_mm", "worst_mm"))
        if typical is not None and worst is not None:
            text += (
                f". Outside the measured region its fit claims RMS {typical:.3f} mm, worst region "
                f"{worst:.3f} mm RMS ({self.beyond.get('worst_where')})"
            )
        elif self.beyond.get("narrow"):
            text += f". Outside the measured region nothing is claimed: {self.beyond['reason']}"
        return text + "."


# ---- along trajectories --------------------------------------------------------------------------


LOGGED_COMMANDS_TEXT = "the logged commands"  # that drive a model, as `drives` says at its end


@dataclass(frozen=True)
class MotionGapStep:
    """How far a model misses on held-out runs, by joint.

    torque_rms_Nm: of the torque that the measured motion takes [N m, slides N].
    torque_rms: the same in the unit of the log; torque_rms_moving: of rows neither at rest nor just
    after a reversal.  tracking_rms_mrad: of where its drives bring it
    [mrad, slides mm], empty where it was not driven.
    """

    name: str
    torque_rms_Nm: tuple[float, ...]
    torque_rms: tuple[float, ...]
    torque_rms_moving: tuple[float, ...]
    tracking_rms_mrad: tuple[float, ...] = ()


@dataclass(frozen=True)
class WrittenElement:
    """Numbers of a model that were corrected.

    worth: of each joint that it changes, the held-out RMS torque of moving rows without and with
    it, in the unit of the log.
    """

    name: str
    attributes: str
    worth: Mapping[str, tuple[float, float]]

    def format_worth(self, unit: str) -> str:
        """For people: where it counts most [unit]."""
        if not self.worth:
            return f"{self.name} ({self.attributes})"
        joint, (before, after) = max(self.worth.items(), key=lambda one: one[1][0] / one[1][1])
        size = f"{joint} {before:.3g} to {after:.3g} {unit}"
        return f"{self.name} ({self.attributes}): {size} held out"


def describe_drive_effect(effect: MotionEffect) -> str:
    """What a drive has that the model's has not, and its worth, for people."""
    amounts = ", ".join(
        f"{p.name.replace('_', ' ')} {p.value:.4g}" + f" ± {p.sigma:.1g}" * (p.sigma > 0.0)
        + f" {p.unit}" * (p.unit != "1") for p in effect.parameters if p.value or p.sigma
    )  # fmt: skip
    if not effect.worth:
        return f"not in the file: {effect.words} ({amounts}), for which MuJoCo has no element"
    joint, (before, after) = effect.joint_of_largest_gain
    size = f"joint error at {joint} {before:.3g} to {after:.3g} mrad"
    return f"corrected {effect.words} ({amounts}): {size} held out"


@dataclass(frozen=True, eq=False, repr=False)
class MotionGap(Result):
    """The gap between a simulator's model and logs of the arm, measured in the simulator.

    rungs: as given, then with each element.  elements: what was corrected, with its worth.
    left_out: what is not in the file, and what that costs.  drives: what moved the arm.
    held_out: runs that no fit saw, or quarters of one.  written: a path, empty if none.
    effects: of its drives, each with the held-out joint error [mrad] without and with it.
    along: tells its file from that of poses.
    """

    KIND = "simulator_gap"
    COMMAND = "gap"
    model: str
    robot: str
    unit: str
    rungs: Annotated[tuple[MotionGapStep, ...], FieldFormat(fewest=1)]
    elements: tuple[WrittenElement, ...]
    left_out: tuple[str, ...]
    drives: str
    held_out: tuple[str, ...]
    notices: tuple[str, ...]
    written: str
    seconds: float
    effects: tuple[MotionEffect, ...] = ()
    along: Literal["trajectories"] = "trajectories"

    def __post_init__(self) -> None:
        rows = [(r.torque_rms_Nm, r.torque_rms, r.torque_rms_moving) for r in self.rungs]
        if len({len(row) for some in rows for row in some}) > 1:
            raise ValueError("its steps are not of one number of joints")

    def __repr__(self) -> str:
        return f"<MotionGap of {self.model}: {self.headline()}>"

    @property
    def is_driven_by_commands(self) -> bool:
        """Whether logged commands drove the model."""
        return self.drives.endswith(LOGGED_COMMANDS_TEXT)

    @property
    def has_corrections(self) -> bool:
        """Whether something was kept, where commands drove the model."""
        return not self.is_driven_by_commands or len(self.rungs) > 1

    def headline(self) -> str:
        """The result in a sentence or two."""
        if not self.has_corrections:
            error = np.linalg.norm(self.rungs[0].tracking_rms_mrad)
            return (
                f"No correction lowers the joint error under {self.drives} on held-out motion "
                f"({', '.join(self.held_out)}), {error:.3g} mrad: nothing is written."
            )
        first, last = self.rungs[0], self.rungs[-1]
        if not first.torque_rms:
            return f"{capitalise_sentence(self.describe_joint_error())}."
        share = np.array(last.torque_rms_moving) / np.maximum(first.torque_rms_moving, 1e-300)
        worst = int(np.argmax(share))
        said = (
            "Torque that the model gets wrong on held-out motion falls to "
            f"{100.0 * np.median(share):.2g} % (median of the joints; worst J{worst + 1}, "
            f"{100.0 * share[worst]:.2g} %)"
        )
        return f"{said}, {self.describe_joint_error()}." if first.tracking_rms_mrad else f"{said}."

    def describe_joint_error(self) -> str:
        """How the joint error changes."""
        ends = [np.linalg.norm(self.rungs[k].tracking_rms_mrad) for k in (0, -1)]
        return f"the joint error under {self.drives} from {ends[0]:.3g} to {ends[1]:.3g} mrad"

    def sentences(self) -> tuple[str, ...]:
        """What was corrected and its worth, and what the file does not hold."""
        drives = (describe_drive_effect(one) for one in self.effects)
        each = (f"corrected {one.format_worth(self.unit)}" for one in self.elements)
        return (*drives, *each, *(f"not in the model: {text}" for text in self.left_out))

    def summarise_file(self) -> dict[str, Any]:
        """What another result says of the file that was written."""
        names = ("written", "elements", "left_out")
        return {name: convert_to_plain_json(getattr(self, name)) for name in names}

    def table(self) -> Table:
        """RMS torque of each joint, rung by rung."""
        title = f"RMS torque [{self.unit}] while moving, held out ({', '.join(self.held_out)})"
        return build_table_by_joint(title, "model", self.rungs, "torque_rms_moving")

    def tables(self) -> tuple[Table, ...]:
        """Torques, and joint errors where drives moved the arm."""
        title = f"RMS joint error [mrad] under {self.drives}"
        driven = build_table_by_joint(title, "model", self.rungs, "tracking_rms_mrad")
        own = (self.table(),) if self.unit else ()
        return (*own, driven) if self.drives else own
