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

from minimax_cal.dynamics.drives import (
    DELAY,
    FIELDS,
    FITTED,
    FRICTION,
    GAINS,
    IN_A_RUN,
    INERTIA,
    KINDS,
    SPEED_LIMIT,
    Body,
    Drive,
    DriveFit,
    Followed,
    covariance_of,
    fit_drive,
    is_another,
)
from minimax_cal.dynamics.laws import WORDS, Element
from minimax_cal.dynamics.logs.table import NOTHING
from minimax_cal.dynamics.regressor import Motion
from minimax_cal.dynamics.result import MotionEffect, changed_joints
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError, RobotError
from minimax_cal.ground.files import json_text, plain, write_whole
from minimax_cal.measuring.faults.fault import Amount
from minimax_cal.robots.document import Document
from minimax_cal.robots.mjcf import numbers
from minimax_cal.simulators.chain import IMPLICIT_INTEGRATORS, Chain
from minimax_cal.simulators.elements import set_servo_gains
from minimax_cal.simulators.mjcf_tree import MjcfTree, set_element
from minimax_cal.simulators.motion.correct import HISTORY_FIRST, Candidate, Corrected, mean_log
from minimax_cal.simulators.motion.fit import Study, fit_numbers
from minimax_cal.simulators.motion.judge import OWN_SERVOS, Judge
from minimax_cal.simulators.motion.numbers import (
    MIN_DELAY_TIMESTEPS,
    Bodies,
    Numbers,
    Opened,
    delay_attributes,
    given_numbers,
    write_numbers,
)
from minimax_cal.simulators.result import WrittenElement

WORTH = 0.01  # fall of the mean log joint error by which an effect of a drive is kept
OTHER_SHARE = 0.4  # fall of what is left, as a mean log, by which drives carry gravity otherwise
NO_DAMPER = 0.25  # of a joint's damping: a drive with less has none
SHAKES = 0.5  # of the inertia, damper times timestep: more is too much for an explicit step
Pair = tuple[Followed, Followed]
Told = tuple[str, int]  # an effect, and at which joint
ALL: Told = (GAINS, -1)  # the share of gravity that all drives carry


@dataclass(frozen=True, eq=False)
class Served:
    """Drives as the model has them, and as logs show them.

    given: (n) of the model.  fits: (n), None where the logs tell nothing.  told: effects that are
    another than the model's.  share: of gravity that drives carry, of the model and of the arm.
    damping: (n,) of the joints, that is part of the fitted dampers where no torque tells them
    apart.
    """

    given: tuple[Drive, ...]
    fits: tuple[DriveFit | None, ...]
    told: tuple[Told, ...]
    share: tuple[float, float]
    damping: Array

    def drives(self, kinds: Sequence[str] = KINDS) -> tuple[Drive, ...]:
        """(n) the model's with what is told of some kinds."""
        out = list(self.given)
        for kind, j in self.told:
            if kind in kinds and (fit := self.fits[j]):
                servo = max(fit.drive.damper - float(self.damping[j]), 0.0)
                out[j] = out[j].taking(replace(fit.drive, damper=servo), kind)
        return tuple(out)

    def without(self, one: Told) -> Served:
        """With the model's own numbers of one effect."""
        if one == ALL:
            return replace(self, share=(self.share[0], self.share[0]))
        return replace(self, told=tuple(each for each in self.told if each != one))

    @property
    def changes(self) -> bool:
        """Whether anything is another than in the model."""
        return bool(self.told) or self.share[0] != self.share[1]

    def apply_to(self, opened: Opened, kinds: Sequence[str] = KINDS) -> Opened:
        """The model with what is told of its drives, of some kinds."""
        document = opened.given.document.copy()
        write_drives(document, opened.chain, self.drives(kinds), self.share[1])
        return opened.again(document)

    def joint_error(self, judge: Judge, opened: Opened) -> float:
        """Mean log joint error on the runs held out; infinite where the model is unstable."""
        try:
            return mean_log(judge.tracking(self.apply_to(opened).chain))
        except RobotError:
            return math.inf

    def without_idle(self, judge: Judge, opened: Opened) -> Served:
        """Without effects whose lack does not raise the joint error of the driven model.

        opened: the model with all that logs show beside.
        """
        served, best = self, self.joint_error(judge, opened)
        for one in (*reversed(self.told), ALL):
            less = served.without(one)
            if one[0] == SPEED_LIMIT or (one == ALL and less.share == served.share):
                continue
            error = less.joint_error(judge, opened)
            if error < best + WORTH:
                served, best = less, error
        return served

    def rate_effects(self, judge: Judge, opened: Opened) -> tuple[MotionEffect, ...]:
        """What is told, each with the joint errors [mrad] of the model without and with it."""
        whole, effects = judge.tracking(self.apply_to(opened).chain), []
        shared = [ALL] if self.share[0] != self.share[1] else []
        for kind, j in (*shared, *self.told):
            amounts: tuple[Amount, ...] = (Amount("gravity_share", self.share[1], "1"),)
            fit = self.fits[j]
            if fit and j >= 0:
                amounts = tuple(Amount(name, getattr(fit.drive, name), unit, fit.sigma[name])
                                for name, unit in FIELDS[kind].items())  # fmt: skip
            less = whole
            if kind != SPEED_LIMIT:
                less = judge.tracking(self.without((kind, j)).apply_to(opened).chain)
            place = "all" if j < 0 else f"J{j + 1}"
            worth = changed_joints(1e3 * less, 1e3 * whole)
            effects.append(MotionEffect(kind, place, amounts, worth))
        return tuple(effects)

    def apply_by_steps(
        self, effects: Sequence[MotionEffect], opened: Opened
    ) -> Iterator[tuple[str, Opened]]:
        """The model with the drives, a step for each kind of effect, and what it is called."""
        for number, kind in enumerate(KINDS):
            if kind in {effect.effect for effect in effects}:
                yield f"+ {WORDS[kind]}", self.apply_to(opened, KINDS[: number + 1])


def own_drives(chain: Chain) -> tuple[Drive, ...]:
    """(n) the position servos of a model."""
    model, out = chain.model, []
    late = getattr(model, "actuator_delay", np.zeros(model.nu))[chain.servos].tolist()
    servos, forward = chain.read_servos(), chain.find_feed_forward()
    for j in range(len(chain.joints)):
        ahead = sum(float(model.actuator_gainprm[k, 0]) for k, i in forward.items() if i == j)
        whole = float(servos.damper[j]) + ahead
        out.append(Drive(float(servos.gain[j]), whole, ahead / whole if ahead else 0.0, late[j],
                         float(np.abs(servos.limits[j]).min())))  # fmt: skip
    return tuple(out)


def share_of(chain: Chain) -> float:
    """Of gravity, that the actuators of a model carry."""
    return float(np.mean(chain.model.body_gravcomp[list(chain.bodies)]))


@dataclass(frozen=True, eq=False)
class Fits:
    """Fits (n,) of drives that carry a share of gravity, None where the logs tell nothing.

    held: runs held out.  left: mean log of the torque that is left of these, all without a fit.
    """

    share: float
    each: tuple[DriveFit | None, ...]
    held: Followed
    left: float

    @staticmethod
    def of(seen: Pair, given: Sequence[Drive], share: float, body: Body) -> Fits:
        """By the runs to learn from.  seen: these, and those held out."""
        learnt, held = (one.carrying(share, body) for one in seen)
        left = list[float]()
        each = tuple(fit_drive(learnt, held, j, drive) for j, drive in enumerate(given))
        for j, fit in enumerate(each):
            rows = held.joint(j)
            rest = fit.rest(rows) if fit else rows.torque
            left.append(float((rest**2).sum()))
        return Fits(share, each, held, 0.5 * mean_log(np.array(left)))

    def beaten_by(self, other: Fits) -> bool:
        """Whether another share leaves far less, and tells of as many drives."""
        known, more = (sum(fit is not None for fit in one.each) for one in (self, other))
        return more >= max(known, 1) and other.left < self.left - OTHER_SHARE


def serve(judge: Judge, opened: Opened, *, plain: bool = False) -> Served:
    """What logs with commands say of a model's drives.

    plain: without delays, which other simulators do not read.
    """
    chain, least = opened.chain, MIN_DELAY_TIMESTEPS * opened.chain.step
    own, damping, first = own_drives(chain), np.zeros(len(chain.dofs)), share_of(chain)
    if judge.held.unit == NOTHING:
        damping = chain.model.dof_damping[chain.dofs]
    given = [replace(one, damper=one.damper + by) for one, by in zip(own, damping, strict=True)]
    body = body_of(chain)
    seen = followed(judge, body)
    best = Fits.of(seen, given, first, body)
    for other in {0.0, 1.0} - {first}:
        tried = Fits.of(seen, given, other, body)
        best = tried if best.beaten_by(tried) else best
    late = hasattr(chain.model, "actuator_delay") and not plain
    kinds = [one for one in KINDS if one != DELAY or late]
    told = tuple((kind, j) for kind in kinds for j, fit in enumerate(best.each)
                 if fit and is_another(kind, fit, given[j], best.held, j, least))  # fmt: skip
    return Served(own, best.each, told, (first, best.share), damping)


def followed(judge: Judge, body: Body) -> Pair:
    """The runs to learn from, and those held out, with their commands."""
    arm = judge.arm
    return Followed.of(judge.learning_runs, arm, body), Followed.of(judge.runs, arm, body)


def damped_by_joints(judge: Judge, opened: Opened) -> bool:
    """Whether logged torques lack the dampers that joints of a file hold for its servos.

    So they do where the same file, simulated, made the log.
    """
    chain = opened.chain
    damping, held = chain.model.dof_damping[chain.dofs], chain.has_servo_dampers()
    if not held.all():
        return False
    body = body_of(chain)
    fits = Fits.of(followed(judge, body), own_drives(chain), share_of(chain), body).each
    parts = [fit.drive.damper / damping[j] for j, fit in enumerate(fits) if fit]
    return bool(parts) and np.median(parts) < NO_DAMPER


def body_of(chain: Chain) -> Body:
    """Torque that the masses of a model alone take for a motion, whatever carries them."""
    mj, model, data, at, dofs = replace(chain, model=copy(chain.model)).fresh()
    model.opt.disableflags |= int(mj.mjtDisableBit.mjDSBL_CONSTRAINT)
    for name in ("dof_armature", "dof_damping", "jnt_stiffness", "body_gravcomp"):
        getattr(model, name)[:] = 0.0

    def body(motion: Motion) -> Array:
        out = np.empty(motion.q.shape)
        for k, row in enumerate(zip(motion.q, motion.qd, motion.qdd, strict=True)):
            data.qpos[at], data.qvel[dofs], data.qacc[dofs] = row
            mj.mj_inverse(model, data)
            out[k] = data.qfrc_inverse[dofs]
        return out

    return body


def lost_late(effects: Sequence[MotionEffect]) -> Iterator[str]:
    """What is to be said where a file has late commands, for people."""
    if any(one.effect == DELAY for one in effects):
        yield Element.DELAY.left_out
        yield HISTORY_FIRST


def write_drives(
    document: Document, chain: Chain, drives: Sequence[Drive], gravity_share: float
) -> None:
    """Give the servos of a model the numbers of drives, where these are others than it has.

    gravity_share: of gravity, that the actuators carry.
    """
    tree, model, step = MjcfTree(document.root), chain.model, chain.step
    floating, joints = bool(model.body_gravcomp[chain.bodies[0]]), tree.find_joints(chain)
    for j, (drive, own) in enumerate(zip(drives, own_drives(chain), strict=True)):
        # Gains at the motor; a velocity actuator takes the commanded speed.
        name, gear = chain.names[j], model.actuator_gear[chain.servos[j], 0]
        servo = next(e for e in tree.find_actuators(name) if e.tag in ("position", "general"))
        has_other_gains = drive.taking(own, GAINS) != drive
        if has_other_gains:
            damper = (1.0 - drive.ahead) * drive.damper
            set_servo_gains(servo, drive.stiffness / gear**2, damper / gear**2)
            if forward := drive.ahead * drive.damper:
                set_element(tree.section("actuator"), "velocity", f"{name}_ahead", joint=name,
                            kv=forward)  # fmt: skip
            else:
                tree.remove("actuator", "velocity", f"{name}_ahead")

        # Torque limit: of the joint where actuators carry gravity, else of the servo.
        if drive.torque != own.torque:
            element, what = (joints[j], "actuatorfrc") if floating else (servo, "force")
            is_limited = math.isfinite(drive.torque)
            element.set(f"{what}limited", "true" if is_limited else "false")
            if is_limited:
                limit = drive.torque / (1.0 if floating else abs(gear))
                element.set(f"{what}range", numbers([-limit, limit]))

        # Delay of the command, of all actuators of the joint.
        if has_other_gains or drive.delay != own.delay:
            for actuator in tree.find_actuators(name):
                for attribute in ("delay", "nsample", "interp"):
                    actuator.attrib.pop(attribute, None)
                actuator.attrib |= delay_attributes(drive.delay, step)
    damping = np.array([d.damper for d in drives]) * step * model.dof_invweight0[chain.dofs]
    if model.opt.integrator not in IMPLICIT_INTEGRATORS and damping.max() > SHAKES:
        tree.section("option").set("integrator", "implicitfast")
    if gravity_share != share_of(chain):
        for body in tree.find_parents()[joints[0]].iter("body"):
            body.set("gravcomp", numbers([gravity_share]))
        for joint in joints:
            joint.set("actuatorgravcomp", "true" if gravity_share else "false")


# ---- actuators and ranges ------------------------------------------------------------------------


UNITS = {name: unit for fields in FIELDS.values() for name, unit in fields.items()}
ELEMENTS = {  # of the body, their names and units, and how they stand in `Numbers`
    Element.FRICTION: (("friction", "N m"), ("damping", "N m s/rad")),
    Element.ARMATURE: (("armature", "kg m^2"),),
}
ISAAC = '''"""Actuators of {name} for Isaac Lab, whose physics steps are of {step} s.

A drive whose feed_forward is s wants s times the commanded speed as its velocity target.
feed_forward = {ahead}
"""

from isaaclab.actuators import DelayedPDActuatorCfg

ACTUATORS = {{
{entries}}}
'''


def write_actuators(path: Path | str, form: str, chain: Chain, served: Served | None) -> None:
    """Write the actuators of a model as it is written, in SI, in a format that simulators take.

    form: json or isaac.  served: what its logs say of speeds that no model holds.
    """
    dofs, step, name = chain.dofs, chain.step, chain.robot.name
    fits = served.fits if served else (None,) * len(dofs)
    held = ("dof_armature", "dof_frictionloss", "dof_damping")
    body = np.array([getattr(chain.model, field)[dofs] for field in held]).T.tolist()
    joints: list[dict[str, Any]] = [
        {"joint": joint, "stiffness": drive.stiffness, "damping": drive.damper,
         "feed_forward": drive.ahead, "armature": own[0], "friction": own[1],
         "viscous_friction": own[2], "effort_limit": drive.torque,
         "velocity_limit": fit.drive.speed if fit else math.inf, "delay": drive.delay,
         "delay_steps": round(drive.delay / step)}
        for joint, drive, own, fit in zip(chain.names, own_drives(chain), body, fits, strict=True)
    ]  # fmt: skip
    if form == "json":
        content = {"schema": 1, "kind": "actuators", "model": name, "timestep": step,
                   "joints": joints}  # fmt: skip
        write_whole(Path(path), json_text(plain(content)))
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
    write_whole(Path(path), ISAAC.format(name=name, step=step, ahead=ahead, entries=entries))


# ---- ranges ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Ranged:
    """Numbers of a kind, with their covariance (p, p) and their spread between runs (p,)."""

    names: tuple[tuple[str, str, str], ...]
    mean: Array
    covariance: Array
    between: Array


def of_drives(served: Served, joints: tuple[str, ...], count: int) -> Ranged:
    """Gains and delays, by stretches of the runs left out in turn.  count: of the runs."""
    told = [(fit, k, (name, joint, UNITS[name]), getattr(drive, name))
            for joint, fit, drive in zip(joints, served.fits, served.drives(), strict=True) if fit
            for k, name in enumerate(FITTED) if (fit.change[:, k] != 0.0).any()]  # fmt: skip
    every = sorted({stretch for fit, *_ in told for stretch in fit.stretch.tolist()})
    changes = [dict(zip(fit.stretch.tolist(), fit.change[:, k], strict=True))
               for fit, k, *_ in told]  # fmt: skip
    change = np.array([[one.get(stretch, 0.0) for one in changes] for stretch in every])
    change = change.reshape(len(every), len(changes))
    run = np.array(every, dtype=int) // IN_A_RUN
    by_run = np.array([change[run == number].sum(axis=0) for number in range(count)])
    covariance = covariance_of(change) if every else np.zeros((0, 0))
    names, mean = tuple(name for *_, name, _ in told), np.array([one[-1] for one in told])
    return Ranged(names, mean, covariance, spread(by_run))


def spread(change: Array) -> Array:
    """(p,) between runs, of the changes (r, p) without each; NaN of a single run."""
    if len(change) < 2:
        return np.full(change.shape[1:], np.nan)
    return np.asarray((len(change) - 1.0) * np.std(change, axis=0, ddof=1))


def of_body(made: Candidate, study: Study, joints: tuple[str, ...]) -> Ranged:
    """Friction, damping and armature that were fitted, each run left out in turn."""
    kinds = [one for one in ELEMENTS if one in made.asked.elements]
    names = tuple((name, joint, unit) for kind in kinds for name, unit in ELEMENTS[kind]
                  for joint in joints)  # fmt: skip

    def values(numbers: Numbers) -> Array:
        each = (getattr(numbers, name) for kind in kinds for name, _ in ELEMENTS[kind])
        return np.concatenate([[], *(one.reshape(len(joints), -1)[:, 0] for one in each)])

    mean, runs = values(made.numbers), range(len(study.scene.logs.names))
    if len(runs) < 2 or not names:
        unknown = np.full(len(names), np.nan)
        return Ranged(names, mean, np.diag(unknown), unknown)
    studies = (study.only([run for run in runs if run != out]) for out in runs)
    change = np.array([values(fit_numbers(one, made.asked)) - mean for one in studies])
    whole = (len(runs) - 1.0) / len(runs) * change.T @ change
    return Ranged(names, mean, whole, spread(change))


def write_ranges(
    path: Path | str,
    fitted: tuple[Candidate, Study] | None,
    served: Served | None,
    joints: tuple[str, ...],
    count: int,
) -> None:
    """Write mean, deviation and spread of what was fitted, and the covariance of all of it.

    fitted: numbers of the body and the logs that told them.  count: of the runs to learn from.
    """
    parts = [of_drives(served, joints, count)] if served else []
    parts += [of_body(*fitted, joints)] if fitted else []
    whole = block_diag(*(part.covariance for part in parts))
    sigma = iter(np.sqrt(np.diag(whole)).tolist())
    parameters = [
        {"name": name, "joint": joint, "mean": mean, "sigma": next(sigma),
         "between_runs": float(between), "unit": unit}
        for part in parts
        for (name, joint, unit), mean, between in zip(part.names, part.mean, part.between,
                                                      strict=True)
    ]  # fmt: skip
    content = {"schema": 1, "kind": "ranges", "parameters": parameters, "covariance": whole}
    write_whole(Path(path), json_text(plain(content)))


# ---- by commands and positions alone -------------------------------------------------------------


HELD = {  # of the body, by their fields of `Numbers`: what was fitted beside drives, attributes
    Element.FRICTION: (FRICTION, "frictionloss"),
    Element.ARMATURE: (INERTIA, "armature"),
}
SCALE = (
    "commands and positions without torques: gains, friction and rotors are those for the masses "
    "of the model; were all masses k times as large, so would these be, and no position would "
    "change; a torque, or a weighed arm, tells k; dampers of servo and joint stand as one"
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Answer(Corrected):
    """A corrected model with its drives, and what each effect of these is worth."""

    served: Served | None = None
    effects: tuple[MotionEffect, ...] = ()


def by_positions(judge: Judge, opened: Opened, *, plain: bool) -> Answer:
    """What lowers the joint error under the logged commands, each step of it.

    Raises OptionError without servos to correct.
    """
    if filtered := opened.chain.find_filtered_servos():
        raise OptionError(
            f"{opened.given.source}: the servos of {filtered} filter their commands (dyntype or "
            "timeconst): positions alone do not correct them; leave the filter out of the model, "
            "or log torques or currents"
        )
    if judge.drives != OWN_SERVOS or not opened.has_correctable_servos():
        raise OptionError(
            f"{judge.runs[0].source}: no column of torque or current: then every run needs "
            "commands of all joints (q1_cmd_rad, ...), and the model position servos"
        )
    served, names = serve(judge, opened, plain=plain), tuple(HELD)
    served = served.without_idle(judge, with_body(opened, served, names))
    for name in reversed(names):
        less = tuple(one for one in names if one != name)
        bare, whole = (served.joint_error(judge, with_body(opened, served, some))
                       for some in (less, names))  # fmt: skip
        names = less if bare < whole + WORTH else names
    effects = served.rate_effects(judge, with_body(opened, served, names))
    steps = list(served.apply_by_steps(effects, opened))
    driven = served.apply_to(opened)
    steps += [(f"+ {name}", with_body(driven, served, names[: number + 1]))
              for number, name in enumerate(names)]  # fmt: skip
    rungs = tuple(judge.rung(name, one.chain) for name, one in steps)
    elements = tuple(WrittenElement(name.value, HELD[name][1], {}) for name in names)
    return Answer(with_body(driven, served, names), rungs, elements, None, (), (SCALE,),
                  tuple(lost_late(effects)), served=served, effects=effects)  # fmt: skip


def with_body(opened: Opened, served: Served, names: Sequence[Element]) -> Opened:
    """The model with friction and rotors that were fitted beside the drives."""
    document = opened.given.document.copy()
    new = given = given_numbers(opened.chain, Bodies.of(opened.chain))
    for name in names:
        values = [old if fit is None else max(fit.beside[HELD[name][0]], 0.0)
                  for fit, old in zip(served.fits, getattr(given, name), strict=True)]  # fmt: skip
        changes: dict[str, Any] = {name: np.array(values)}
        new = replace(new, **changes)
    write_numbers(document, opened.chain, given, new)
    return opened.again(document)
