"""The drives of a model beside those that logs with commands show: told, kept, written."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError, RobotError
from minimax_cal.core.files import convert_to_plain_json, format_json, write_file_atomically
from minimax_cal.dynamics.drives import (
    COMMAND_DELAY_EFFECT,
    COULOMB_FRICTION,
    DRIVE_EFFECT_UNITS,
    DRIVE_EFFECTS,
    FITTED_DRIVE_FIELDS,
    MAX_STRETCHES_PER_RUN,
    ROTOR_INERTIA,
    SERVO_GAIN_EFFECT,
    SPEED_LIMIT_EFFECT,
    BodyTorqueFunction,
    CommandedRuns,
    DriveFit,
    PositionDrive,
    fit_drive,
    is_drive_effect_confirmed,
    jackknife_covariance,
)
from minimax_cal.dynamics.laws import TORQUE_EFFECT_WORDS, SimulatorElement
from minimax_cal.dynamics.logs.log_table import NO_TORQUE_UNIT
from minimax_cal.dynamics.regressor import JointMotion
from minimax_cal.dynamics.result import MotionEffect, pair_changed_rms_by_joint
from minimax_cal.measuring.faults.data_fault import FaultAmount
from minimax_cal.robots.mjcf_import import format_exact_numbers
from minimax_cal.robots.xml_document import XmlDocument
from minimax_cal.simulators.chain import IMPLICIT_INTEGRATORS, ModelArm
from minimax_cal.simulators.elements import set_servo_gains
from minimax_cal.simulators.mjcf_tree import MjcfTree, set_element
from minimax_cal.simulators.motion.correct import (
    HISTORY_NOTICE,
    CandidateModel,
    CorrectedMotionModel,
    mean_logarithm,
)
from minimax_cal.simulators.motion.fit import FitData, fit_model_parameters
from minimax_cal.simulators.motion.judge import OWN_SERVOS_TEXT, MotionJudge
from minimax_cal.simulators.motion.model_parameters import (
    MIN_DELAY_TIMESTEPS,
    ModelBodies,
    ModelParameters,
    OpenedModel,
    delay_attributes,
    read_model_parameters,
    write_model_parameters,
)
from minimax_cal.simulators.result import WrittenElement

MIN_LOG_JOINT_ERROR_FALL = (
    0.01  # fall of the mean log joint error by which an effect of a drive is kept
)
MIN_LOG_TORQUE_FALL_FOR_GRAVITY_SHARE = (
    0.4  # fall of what is left, as a mean log, by which drives carry gravity otherwise
)
MAX_DAMPER_SHARE_OF_NONE = 0.25  # of a joint's damping: a drive with less has none
MAX_EXPLICIT_DAMPING = (
    0.5  # of the inertia, damper times timestep: more is too much for an explicit step
)
LearningAndHeldOut = tuple[CommandedRuns, CommandedRuns]
JointEffect = tuple[str, int]  # an effect, and at which joint
GRAVITY_SHARE_EFFECT: JointEffect = (
    SERVO_GAIN_EFFECT,
    -1,
)  # the share of gravity that all drives carry


@dataclass(frozen=True, eq=False)
class FittedDrives:
    """Drives as the model has them, and as logs show them.

    model_drives: (n) of the model.  fits: (n), None where the logs tell nothing.  changed_effects:
    effects that are another than the model's.  gravity_shares: of gravity that drives carry, of the
    model and of the arm. joint_damping: (n,) of the joints, that is part of the fitted dampers
    where no torque tells them apart.
    """

    model_drives: tuple[PositionDrive, ...]
    fits: tuple[DriveFit | None, ...]
    changed_effects: tuple[JointEffect, ...]
    gravity_shares: tuple[float, float]
    joint_damping: Array

    def select_drives(self, kinds: Sequence[str] = DRIVE_EFFECTS) -> tuple[PositionDrive, ...]:
        """(n) the model's with what is told of some kinds."""
        out = list(self.model_drives)
        for kind, j in self.changed_effects:
            if kind in kinds and (fit := self.fits[j]):
                servo = max(fit.drive.damper - float(self.joint_damping[j]), 0.0)
                out[j] = out[j].with_effect_of(replace(fit.drive, damper=servo), kind)
        return tuple(out)

    def without_effect(self, one: JointEffect) -> FittedDrives:
        """With the model's own numbers of one effect."""
        if one == GRAVITY_SHARE_EFFECT:
            return replace(self, gravity_shares=(self.gravity_shares[0], self.gravity_shares[0]))
        return replace(
            self, changed_effects=tuple(each for each in self.changed_effects if each != one)
        )

    @property
    def has_changes(self) -> bool:
        """Whether anything is another than in the model."""
        return bool(self.changed_effects) or self.gravity_shares[0] != self.gravity_shares[1]

    def apply_to(self, opened: OpenedModel, kinds: Sequence[str] = DRIVE_EFFECTS) -> OpenedModel:
        """The model with what is told of its drives, of some kinds."""
        document = opened.given.document.copy()
        write_drives(document, opened.chain, self.select_drives(kinds), self.gravity_shares[1])
        return opened.with_document(document)

    def measure_joint_error(self, judge: MotionJudge, opened: OpenedModel) -> float:
        """Mean log joint error on the runs held out; infinite where the model is unstable."""
        try:
            return mean_logarithm(judge.measure_joint_error(self.apply_to(opened).chain))
        except RobotError:
            return math.inf

    def without_idle(self, judge: MotionJudge, opened: OpenedModel) -> FittedDrives:
        """Without effects whose lack does not raise the joint error of the driven model.

        opened: the model with all that logs show beside.
        """
        served, best = self, self.measure_joint_error(judge, opened)
        for one in (*reversed(self.changed_effects), GRAVITY_SHARE_EFFECT):
            less = served.without_effect(one)
            if one[0] == SPEED_LIMIT_EFFECT or (
                one == GRAVITY_SHARE_EFFECT and less.gravity_shares == served.gravity_shares
            ):
                continue
            error = less.measure_joint_error(judge, opened)
            if error < best + MIN_LOG_JOINT_ERROR_FALL:
                served, best = less, error
        return served

    def rate_effects(self, judge: MotionJudge, opened: OpenedModel) -> tuple[MotionEffect, ...]:
        """What is told, each with the joint errors [mrad] of the model without and with it."""
        whole, effects = judge.measure_joint_error(self.apply_to(opened).chain), []
        shared = [GRAVITY_SHARE_EFFECT] if self.gravity_shares[0] != self.gravity_shares[1] else []
        for kind, j in (*shared, *self.changed_effects):
            amounts: tuple[FaultAmount, ...] = (
                FaultAmount("gravity_share", self.gravity_shares[1], "1"),
            )
            fit = self.fits[j]
            if fit and j >= 0:
                amounts = tuple(
                    FaultAmount(name, getattr(fit.drive, name), unit, fit.sigma_by_field[name])
                    for name, unit in DRIVE_EFFECT_UNITS[kind].items()
                )
            less = whole
            if kind != SPEED_LIMIT_EFFECT:
                less = judge.measure_joint_error(
                    self.without_effect((kind, j)).apply_to(opened).chain
                )
            place = "all" if j < 0 else f"J{j + 1}"
            worth = pair_changed_rms_by_joint(1e3 * less, 1e3 * whole)
            effects.append(MotionEffect(kind, place, amounts, worth))
        return tuple(effects)

    def apply_by_steps(
        self, effects: Sequence[MotionEffect], opened: OpenedModel
    ) -> Iterator[tuple[str, OpenedModel]]:
        """The model with the drives, a step for each kind of effect, and what it is called."""
        for number, kind in enumerate(DRIVE_EFFECTS):
            if kind in {effect.effect for effect in effects}:
                yield (
                    f"+ {TORQUE_EFFECT_WORDS[kind]}",
                    self.apply_to(opened, DRIVE_EFFECTS[: number + 1]),
                )


def read_model_drives(chain: ModelArm) -> tuple[PositionDrive, ...]:
    """(n) the position servos of a model."""
    model, out = chain.model, []
    late = getattr(model, "actuator_delay", np.zeros(model.nu))[chain.servo_ids].tolist()
    servos, forward = chain.read_servos(), chain.find_feed_forward_joints_by_actuator()
    for j in range(len(chain.joint_ids)):
        ahead = sum(float(model.actuator_gainprm[k, 0]) for k, i in forward.items() if i == j)
        whole = float(servos.damper[j]) + ahead
        out.append(
            PositionDrive(
                float(servos.gain[j]),
                whole,
                ahead / whole if ahead else 0.0,
                late[j],
                float(np.abs(servos.limits[j]).min()),
            )
        )
    return tuple(out)


def read_gravity_share(chain: ModelArm) -> float:
    """Of gravity, that the actuators of a model carry."""
    return float(np.mean(chain.model.body_gravcomp[list(chain.body_ids)]))


@dataclass(frozen=True, eq=False)
class DriveFits:
    """Fits (n,) of drives that carry a share of gravity, None where the logs tell nothing.

    held_out_runs: runs held out.  mean_log_torque_left: mean log of the torque that is left of
    these, all without a fit.
    """

    gravity_share: float
    fits: tuple[DriveFit | None, ...]
    held_out_runs: CommandedRuns
    mean_log_torque_left: float

    @staticmethod
    def fit_all(
        seen: LearningAndHeldOut,
        given: Sequence[PositionDrive],
        share: float,
        body: BodyTorqueFunction,
    ) -> DriveFits:
        """By the runs to learn from.  seen: these, and those held out."""
        learnt, held = (one.with_gravity_share(share, body) for one in seen)
        left = list[float]()
        each = tuple(fit_drive(learnt, held, j, drive) for j, drive in enumerate(given))
        for j, fit in enumerate(each):
            rows = held.build_joint_rows(j)
            rest = fit.compute_residuals(rows) if fit else rows.torque
            left.append(float((rest**2).sum()))
        return DriveFits(share, each, held, 0.5 * mean_logarithm(np.array(left)))

    def is_beaten_by(self, other: DriveFits) -> bool:
        """Whether another share leaves far less, and tells of as many drives."""
        known, more = (sum(fit is not None for fit in one.fits) for one in (self, other))
        return (
            more >= max(known, 1)
            and other.mean_log_torque_left
            < self.mean_log_torque_left - MIN_LOG_TORQUE_FALL_FOR_GRAVITY_SHARE
        )


def fit_drives(judge: MotionJudge, opened: OpenedModel, *, portable: bool = False) -> FittedDrives:
    """What logs with commands say of a model's drives.

    portable: without delays, which other simulators do not read.
    """
    chain, least = opened.chain, MIN_DELAY_TIMESTEPS * opened.chain.timestep
    own, damping, first = (
        read_model_drives(chain),
        np.zeros(len(chain.dof_indices)),
        read_gravity_share(chain),
    )
    if judge.held_out_logs.unit == NO_TORQUE_UNIT:
        damping = chain.model.dof_damping[chain.dof_indices]
    given = [replace(one, damper=one.damper + by) for one, by in zip(own, damping, strict=True)]
    body = body_torque_function(chain)
    seen = read_followed_runs(judge, body)
    best = DriveFits.fit_all(seen, given, first, body)
    for other in {0.0, 1.0} - {first}:
        tried = DriveFits.fit_all(seen, given, other, body)
        best = tried if best.is_beaten_by(tried) else best
    late = hasattr(chain.model, "actuator_delay") and not portable
    kinds = [one for one in DRIVE_EFFECTS if one != COMMAND_DELAY_EFFECT or late]
    told = tuple(
        (kind, j)
        for kind in kinds
        for j, fit in enumerate(best.fits)
        if fit and is_drive_effect_confirmed(kind, fit, given[j], best.held_out_runs, j, least)
    )
    return FittedDrives(own, best.fits, told, (first, best.gravity_share), damping)


def read_followed_runs(judge: MotionJudge, body_torque: BodyTorqueFunction) -> LearningAndHeldOut:
    """The runs to learn from, and those held out, with their commands."""
    arm = judge.arm
    return CommandedRuns.build(judge.learning_runs, arm, body_torque), CommandedRuns.build(
        judge.held_out_runs, arm, body_torque
    )


def are_logs_without_joint_dampers(judge: MotionJudge, opened: OpenedModel) -> bool:
    """Whether logged torques lack the dampers that joints of a file hold for its servos.

    So they do where the same file, simulated, made the log.
    """
    chain = opened.chain
    damping, held = chain.model.dof_damping[chain.dof_indices], chain.has_servo_dampers()
    if not held.all():
        return False
    body = body_torque_function(chain)
    fits = DriveFits.fit_all(
        read_followed_runs(judge, body), read_model_drives(chain), read_gravity_share(chain), body
    ).fits
    parts = [fit.drive.damper / damping[j] for j, fit in enumerate(fits) if fit]
    return bool(parts) and np.median(parts) < MAX_DAMPER_SHARE_OF_NONE


def body_torque_function(chain: ModelArm) -> BodyTorqueFunction:
    """Torque that the masses of a model alone take for a motion, whatever carries them."""
    mj, model, data, at, dofs = replace(chain, model=copy(chain.model)).create_data_with_indices()
    model.opt.disableflags |= int(mj.mjtDisableBit.mjDSBL_CONSTRAINT)
    for name in ("dof_armature", "dof_damping", "jnt_stiffness", "body_gravcomp"):
        getattr(model, name)[:] = 0.0

    def body(motion: JointMotion) -> Array:
        out = np.empty(motion.q.shape)
        for k, row in enumerate(zip(motion.q, motion.qd, motion.qdd, strict=True)):
            data.qpos[at], data.qvel[dofs], data.qacc[dofs] = row
            mj.mj_inverse(model, data)
            out[k] = data.qfrc_inverse[dofs]
        return out

    return body


def list_delay_notices(effects: Sequence[MotionEffect]) -> Iterator[str]:
    """What is to be said where a file has late commands, for people."""
    if any(one.effect == COMMAND_DELAY_EFFECT for one in effects):
        yield SimulatorElement.DELAY.describe_omission
        yield HISTORY_NOTICE


def write_drives(
    document: XmlDocument, chain: ModelArm, drives: Sequence[PositionDrive], gravity_share: float
) -> None:
    """Give the servos of a model the numbers of drives, where these are others than it has.

    gravity_share: of gravity, that the actuators carry.
    """
    tree, model, step = MjcfTree(document.root), chain.model, chain.timestep
    floating, joints = bool(model.body_gravcomp[chain.body_ids[0]]), tree.find_joints(chain)
    for j, (drive, own) in enumerate(zip(drives, read_model_drives(chain), strict=True)):
        # Gains at the motor; a velocity actuator takes the commanded speed.
        name, gear = chain.joint_names[j], model.actuator_gear[chain.servo_ids[j], 0]
        servo = next(e for e in tree.find_actuators(name) if e.tag in ("position", "general"))
        has_other_gains = drive.with_effect_of(own, SERVO_GAIN_EFFECT) != drive
        if has_other_gains:
            damper = (1.0 - drive.ahead) * drive.damper
            set_servo_gains(servo, drive.stiffness / gear**2, damper / gear**2)
            if forward := drive.ahead * drive.damper:
                set_element(
                    tree.section_or_new("actuator"),
                    "velocity",
                    f"{name}_ahead",
                    joint=name,
                    kv=forward,
                )
            else:
                tree.remove_elements("actuator", "velocity", f"{name}_ahead")

        # Torque limit: of the joint where actuators carry gravity, else of the servo.
        if drive.torque != own.torque:
            element, what = (joints[j], "actuatorfrc") if floating else (servo, "force")
            is_limited = math.isfinite(drive.torque)
            element.set(f"{what}limited", "true" if is_limited else "false")
            if is_limited:
                limit = drive.torque / (1.0 if floating else abs(gear))
                element.set(f"{what}range", format_exact_numbers([-limit, limit]))

        # Delay of the command, of all actuators of the joint.
        if has_other_gains or drive.delay != own.delay:
            for actuator in tree.find_actuators(name):
                for attribute in ("delay", "nsample", "interp"):
                    actuator.attrib.pop(attribute, None)
                actuator.attrib |= delay_attributes(drive.delay, step)
    damping = np.array([d.damper for d in drives]) * step * model.dof_invweight0[chain.dof_indices]
    if model.opt.integrator not in IMPLICIT_INTEGRATORS and damping.max() > MAX_EXPLICIT_DAMPING:
        tree.section_or_new("option").set("integrator", "implicitfast")
    if gravity_share != read_gravity_share(chain):
        for body in tree.find_parents()[joints[0]].iter("body"):
            body.set("gravcomp", format_exact_numbers([gravity_share]))
        for joint in joints:
            joint.set("actuatorgravcomp", "true" if gravity_share else "false")


# ---- actuators and ranges ------------------------------------------------------------------------


DRIVE_FIELD_UNITS = {
    name: unit for fields in DRIVE_EFFECT_UNITS.values() for name, unit in fields.items()
}
RANGED_ELEMENTS = {  # of the body, their names and units, and how they stand in `ModelParameters`
    SimulatorElement.FRICTION: (("friction", "N m"), ("damping", "N m s/rad")),
    SimulatorElement.ARMATURE: (("armature", "kg m^2"),),
}
ISAAC_TEMPLATE = '''"""Actuators of {name} for Isaac Lab, whose physics steps are of {step} s.

A drive whose feed_forward is s wants s times the commanded speed as its velocity target.
feed_forward = {ahead}
"""

from isaaclab.actuators import DelayedPDActuatorCfg

ACTUATORS = {{
{entries}}}
'''


def write_actuators(
    path: Path | str, file_format: str, chain: ModelArm, fitted_drives: FittedDrives | None
) -> None:
    """Write the actuators of a model as it is written, in SI, in a format that simulators take.

    file_format: json or isaac.  fitted_drives: what its logs say of speeds that no model holds.
    """
    dofs, step, name = chain.dof_indices, chain.timestep, chain.robot.name
    fits = fitted_drives.fits if fitted_drives else (None,) * len(dofs)
    held = ("dof_armature", "dof_frictionloss", "dof_damping")
    body = np.array([getattr(chain.model, field)[dofs] for field in held]).T.tolist()
    joints: list[dict[str, Any]] = [
        {
            "joint": joint,
            "stiffness": drive.stiffness,
            "damping": drive.damper,
            "feed_forward": drive.ahead,
            "armature": own[0],
            "friction": own[1],
            "viscous_friction": own[2],
            "effort_limit": drive.torque,
            "velocity_limit": fit.drive.speed if fit else math.inf,
            "delay": drive.delay,
            "delay_steps": round(drive.delay / step),
        }
        for joint, drive, own, fit in zip(
            chain.joint_names, read_model_drives(chain), body, fits, strict=True
        )
    ]
    if file_format == "json":
        content = {"schema": 1, "kind": "actuators", "model": name, "timestep": step,
                   "joints": joints}  # fmt: skip
        write_file_atomically(Path(path), format_json(convert_to_plain_json(content)))
        return

    # Isaac Lab has a group of actuators for each delay, and no infinite limits.
    entries = ""
    for late in sorted({one["delay_steps"] for one in joints}):
        some = [one for one in joints if one["delay_steps"] == late]
        fields: dict[str, Any] = {"joint_names_expr": [one["joint"] for one in some]}
        for of in ("stiffness", "damping", "armature", "friction", "viscous_friction",
                   "effort_limit", "velocity_limit"):  # fmt: skip
            fields[of] = {o["joint"]: o[of] for o in some if math.isfinite(o[of])} or None
        fields |= {"dynamic_friction": fields["friction"], "min_delay": late, "max_delay": late}
        entries += f'    "delay_{late}": DelayedPDActuatorCfg(\n'
        entries += "".join(f"        {key}={value!r},\n" for key, value in fields.items())
        entries += "    ),\n"
    ahead = {one["joint"]: one["feed_forward"] for one in joints}
    write_file_atomically(
        Path(path), ISAAC_TEMPLATE.format(name=name, step=step, ahead=ahead, entries=entries)
    )


# ---- ranges ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ParameterRanges:
    """Numbers of a kind, with their covariance (p, p) and their spread between runs (p,)."""

    names: tuple[tuple[str, str, str], ...]
    mean: Array
    covariance: Array
    spread_between_runs: Array


def estimate_drive_ranges(
    served: FittedDrives, joints: tuple[str, ...], run_count: int
) -> ParameterRanges:
    """Gains and delays, by stretches of the runs left out in turn.  run_count: of the runs."""
    told = [
        (fit, k, (name, joint, DRIVE_FIELD_UNITS[name]), getattr(drive, name))
        for joint, fit, drive in zip(joints, served.fits, served.select_drives(), strict=True)
        if fit
        for k, name in enumerate(FITTED_DRIVE_FIELDS)
        if (fit.jackknife_changes[:, k] != 0.0).any()
    ]
    every = sorted({stretch for fit, *_ in told for stretch in fit.stretch_numbers.tolist()})
    changes = [dict(zip(fit.stretch_numbers.tolist(), fit.jackknife_changes[:, k], strict=True))
               for fit, k, *_ in told]  # fmt: skip
    change = np.array([[one.get(stretch, 0.0) for one in changes] for stretch in every])
    change = change.reshape(len(every), len(changes))
    run = np.array(every, dtype=int) // MAX_STRETCHES_PER_RUN
    by_run = np.array([change[run == number].sum(axis=0) for number in range(run_count)])
    covariance = jackknife_covariance(change) if every else np.zeros((0, 0))
    names, mean = tuple(name for *_, name, _ in told), np.array([one[-1] for one in told])
    return ParameterRanges(names, mean, covariance, jackknife_spread(by_run))


def jackknife_spread(leave_one_out_changes: Array) -> Array:
    """(p,) between runs, of the changes (r, p) without each; NaN of a single run."""
    if len(leave_one_out_changes) < 2:
        return np.full(leave_one_out_changes.shape[1:], np.nan)
    return np.asarray(
        (len(leave_one_out_changes) - 1.0) * np.std(leave_one_out_changes, axis=0, ddof=1)
    )


def estimate_body_ranges(
    candidate: CandidateModel, fit_data: FitData, joint_names: tuple[str, ...]
) -> ParameterRanges:
    """Friction, damping and armature that were fitted, each run left out in turn."""
    kinds = [one for one in RANGED_ELEMENTS if one in candidate.selection.elements]
    names = tuple((name, joint, unit) for kind in kinds for name, unit in RANGED_ELEMENTS[kind]
                  for joint in joint_names)  # fmt: skip

    def values(numbers: ModelParameters) -> Array:
        each = (getattr(numbers, name) for kind in kinds for name, _ in RANGED_ELEMENTS[kind])
        return np.concatenate([[], *(one.reshape(len(joint_names), -1)[:, 0] for one in each)])

    mean, runs = values(candidate.parameters), range(len(fit_data.scene.logs.names))
    if len(runs) < 2 or not names:
        unknown = np.full(len(names), np.nan)
        return ParameterRanges(names, mean, np.diag(unknown), unknown)
    studies = (fit_data.select_runs([run for run in runs if run != out]) for out in runs)
    change = np.array(
        [values(fit_model_parameters(one, candidate.selection)) - mean for one in studies]
    )
    whole = (len(runs) - 1.0) / len(runs) * change.T @ change
    return ParameterRanges(names, mean, whole, jackknife_spread(change))


def write_ranges(
    path: Path | str,
    fitted: tuple[CandidateModel, FitData] | None,
    fitted_drives: FittedDrives | None,
    joint_names: tuple[str, ...],
    run_count: int,
) -> None:
    """Write mean, deviation and spread of what was fitted, and the covariance of all of it.

    fitted: numbers of the body and the logs that told them.  run_count: of the runs to learn from.
    """
    parts = [estimate_drive_ranges(fitted_drives, joint_names, run_count)] if fitted_drives else []
    parts += [estimate_body_ranges(*fitted, joint_names)] if fitted else []
    whole = block_diag(*(part.covariance for part in parts))
    sigma = iter(np.sqrt(np.diag(whole)).tolist())
    parameters = [
        {
            "name": name,
            "joint": joint,
            "mean": mean,
            "sigma": next(sigma),
            "between_runs": float(between),
            "unit": unit,
        }
        for part in parts
        for (name, joint, unit), mean, between in zip(
            part.names, part.mean, part.spread_between_runs, strict=True
        )
    ]
    content = {"schema": 1, "kind": "ranges", "parameters": parameters, "covariance": whole}
    write_file_atomically(Path(path), format_json(convert_to_plain_json(content)))


# ---- by commands and positions alone -------------------------------------------------------------


# of the body, by their fields of `ModelParameters`: what was fitted beside drives, attributes
BODY_ELEMENT_FIELDS = {
    SimulatorElement.FRICTION: (COULOMB_FRICTION, "frictionloss"),
    SimulatorElement.ARMATURE: (ROTOR_INERTIA, "armature"),
}
MASS_SCALE_NOTICE = (
    "commands and positions without torques: gains, friction and rotors are those for the masses "
    "of the model; were all masses k times as large, so would these be, and no position would "
    "change; a torque, or a weighed arm, tells k; dampers of servo and joint stand as one"
)


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrectedDrivesModel(CorrectedMotionModel):
    """A corrected model with its drives, and what each effect of these is worth."""

    served: FittedDrives | None = None
    effects: tuple[MotionEffect, ...] = ()


def correct_by_positions(
    judge: MotionJudge, opened: OpenedModel, *, portable: bool
) -> CorrectedDrivesModel:
    """What lowers the joint error under the logged commands, each step of it.

    Raises OptionError without servos to correct.
    """
    if filtered := opened.chain.name_joints_with_filtered_commands():
        raise OptionError(
            f"{opened.given.source}: the servos of {filtered} filter their commands (dyntype or "
            "timeconst): positions alone do not correct them; leave the filter out of the model, "
            "or log torques or currents"
        )
    if judge.drive_text != OWN_SERVOS_TEXT or not opened.has_correctable_servos():
        raise OptionError(
            f"{judge.held_out_runs[0].source}: no column of "
            f"torque or current: then every run needs "
            "commands of all joints (q1_cmd_rad, ...), and the model position servos"
        )
    served, names = fit_drives(judge, opened, portable=portable), tuple(BODY_ELEMENT_FIELDS)
    served = served.without_idle(judge, apply_body_elements(opened, served, names))
    for name in reversed(names):
        less = tuple(one for one in names if one != name)
        bare, whole = (served.measure_joint_error(judge, apply_body_elements(opened, served, some))
                       for some in (less, names))  # fmt: skip
        names = less if bare < whole + MIN_LOG_JOINT_ERROR_FALL else names
    effects = served.rate_effects(judge, apply_body_elements(opened, served, names))
    steps = list(served.apply_by_steps(effects, opened))
    driven = served.apply_to(opened)
    steps += [(f"+ {name}", apply_body_elements(driven, served, names[: number + 1]))
              for number, name in enumerate(names)]  # fmt: skip
    rungs = tuple(judge.measure_step(name, one.chain) for name, one in steps)
    elements = tuple(WrittenElement(name.value, BODY_ELEMENT_FIELDS[name][1], {}) for name in names)
    return CorrectedDrivesModel(
        apply_body_elements(driven, served, names),
        rungs,
        elements,
        None,
        (),
        (MASS_SCALE_NOTICE,),
        tuple(list_delay_notices(effects)),
        served=served,
        effects=effects,
    )


def apply_body_elements(
    opened: OpenedModel, fitted_drives: FittedDrives, elements: Sequence[SimulatorElement]
) -> OpenedModel:
    """The model with friction and rotors that were fitted beside the drives."""
    document = opened.given.document.copy()
    new = given = read_model_parameters(opened.chain, ModelBodies.read(opened.chain))
    for name in elements:
        values = [
            old if fit is None else max(fit.nuisance_values[BODY_ELEMENT_FIELDS[name][0]], 0.0)
            for fit, old in zip(fitted_drives.fits, getattr(given, name), strict=True)
        ]
        changes: dict[str, Any] = {name: np.array(values)}
        new = replace(new, **changes)
    write_model_parameters(document, opened.chain, given, new)
    return opened.with_document(document)
