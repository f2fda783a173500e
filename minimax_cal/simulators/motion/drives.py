"""The drives of a model beside those that logs with commands show: told, kept, written."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from xml.etree import ElementTree as ET

import numpy as np

from minimax_cal.dynamics.drives import (
    DELAY,
    FIELDS,
    GAINS,
    KINDS,
    SPEED_LIMIT,
    Body,
    Drive,
    DriveFit,
    Followed,
    fit_drive,
    is_another,
)
from minimax_cal.dynamics.laws import DELAY as LATE_IN_FILE
from minimax_cal.dynamics.laws import WORDS
from minimax_cal.dynamics.regressor import Motion
from minimax_cal.dynamics.result import MotionEffect, changed_joints
from minimax_cal.dynamics.run import NOTHING
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import RobotError
from minimax_cal.measuring.faults.fault import Amount
from minimax_cal.robots.document import Document
from minimax_cal.robots.mjcf import mujoco, numbers
from minimax_cal.simulators.chain import Chain, braked
from minimax_cal.simulators.elements import known, parents_of, section, tune
from minimax_cal.simulators.given import IMPLICIT, elements_of
from minimax_cal.simulators.motion.correct import HISTORY_FIRST, left_out_by, mean_log
from minimax_cal.simulators.motion.driven import ahead_of
from minimax_cal.simulators.motion.judge import Judge
from minimax_cal.simulators.motion.opened import Opened
from minimax_cal.simulators.motion.written import SHORTEST, actuators_of, delayed

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


def own_drives(chain: Chain) -> tuple[Drive, ...]:
    """(n) the position servos of a model."""
    model, out = chain.model, []
    for joint, name in zip(chain.joints, chain.names, strict=True):
        servo = chain.servo(joint)
        gear = float(model.actuator_gear[servo, 0])
        kp, kv = (-float(model.actuator_biasprm[servo, k]) * gear**2 for k in (1, 2))
        ahead = sum(float(model.actuator_gainprm[k, 0]) for k in ahead_of(model, (name,)))
        limits = [math.inf]
        if model.actuator_forcelimited[servo]:
            limits.append(float(np.abs(model.actuator_forcerange[servo]).min() * abs(gear)))
        if model.jnt_actfrclimited[joint]:
            limits.append(float(np.abs(model.jnt_actfrcrange[joint]).min()))
        late = float(getattr(model, "actuator_delay", np.zeros(model.nu))[servo])
        whole = kv + ahead
        out.append(Drive(kp, whole, ahead / whole if ahead else 0.0, late, min(limits)))
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
            rest = rows.rest(fit.drive, fit.beside) if fit else rows.torque
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
    chain, least = opened.chain, SHORTEST * float(opened.chain.model.opt.timestep)
    own, damping, first = own_drives(chain), np.zeros(len(chain.dofs)), share_of(chain)
    if judge.held.unit == NOTHING:
        damping = np.array(chain.model.dof_damping[chain.dofs])
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
    damping, held = chain.model.dof_damping[chain.dofs], braked(chain.model)[list(chain.joints)]
    if not held.all():
        return False
    body = body_of(chain)
    fits = Fits.of(followed(judge, body), own_drives(chain), share_of(chain), body).each
    parts = [fit.drive.damper / damping[j] for j, fit in enumerate(fits) if fit]
    return bool(parts) and float(np.median(parts)) < NO_DAMPER


def body_of(chain: Chain) -> Body:
    """Torque that the masses of a model alone take for a motion, whatever carries them."""
    mj, model = mujoco(), copy(chain.model)
    model.opt.disableflags |= int(mj.mjtDisableBit.mjDSBL_CONSTRAINT)
    for name in ("dof_armature", "dof_damping", "jnt_stiffness", "body_gravcomp"):
        getattr(model, name)[:] = 0.0
    data, at, dofs = mj.MjData(model), chain.places, chain.dofs

    def body(motion: Motion) -> Array:
        out = np.empty(motion.q.shape)
        for k, row in enumerate(zip(motion.q, motion.qd, motion.qdd, strict=True)):
            data.qpos[at], data.qvel[dofs], data.qacc[dofs] = row
            mj.mj_inverse(model, data)
            out[k] = data.qfrc_inverse[dofs]
        return out

    return body


def kept(served: Served, judge: Judge, opened: Opened) -> Served:
    """Without effects whose lack does not raise the joint error of the driven model.

    opened: the model with all that logs show beside.
    """
    best = joint_error(judge, opened, served)
    for one in (*reversed(served.told), ALL):
        less = served.without(one)
        if one[0] == SPEED_LIMIT or (one == ALL and less.share == served.share):
            continue
        error = joint_error(judge, opened, less)
        if error < best + WORTH:
            served, best = less, error
    return served


def joint_error(judge: Judge, opened: Opened, served: Served) -> float:
    """Mean log joint error on the runs held out; infinite where the model is unstable."""
    try:
        return mean_log(judge.tracking(with_drives(opened, served).chain))
    except RobotError:
        return math.inf


def effects_of(served: Served, judge: Judge, opened: Opened) -> Iterator[MotionEffect]:
    """What is told, each with the joint errors [mrad] of the model without and with it."""
    whole = judge.tracking(with_drives(opened, served).chain)
    shared = [ALL] if served.share[0] != served.share[1] else []
    for kind, j in (*shared, *served.told):
        amounts: tuple[Amount, ...] = (Amount("gravity_share", served.share[1], "1"),)
        fit = served.fits[j]
        if fit and j >= 0:
            amounts = tuple(Amount(name, getattr(fit.drive, name), unit, fit.sigma[name])
                            for name, unit in FIELDS[kind].items())  # fmt: skip
        less = whole
        if kind != SPEED_LIMIT:
            less = judge.tracking(with_drives(opened, served.without((kind, j))).chain)
        place = "all" if j < 0 else f"J{j + 1}"
        yield MotionEffect(kind, place, amounts, changed_joints(1e3 * less, 1e3 * whole))


def lost_late(effects: Sequence[MotionEffect]) -> Iterator[str]:
    """What is to be said where a file has late commands, for people."""
    if any(one.effect == DELAY for one in effects):
        yield left_out_by(LATE_IN_FILE)
        yield HISTORY_FIRST


def steps_with(
    served: Served, effects: Sequence[MotionEffect], opened: Opened
) -> Iterator[tuple[str, Opened]]:
    """The model with the drives, a step for each kind of effect, and what it is called."""
    for number, kind in enumerate(KINDS):
        if kind in {effect.effect for effect in effects}:
            yield f"+ {WORDS[kind]}", with_drives(opened, served, KINDS[: number + 1])


def with_drives(opened: Opened, served: Served, kinds: Sequence[str] = KINDS) -> Opened:
    """The model with what is told of its drives, of some kinds."""
    document = opened.given.document.copy()
    write_drives(document, opened.chain, served.drives(kinds))
    if served.share[1] != share_of(opened.chain):
        write_share(document.root, opened.chain, served.share[1])
    return opened.again(document)


def write_drives(document: Document, chain: Chain, drives: Sequence[Drive]) -> None:
    """Give the servos of a model the numbers of drives, where these are others than it has."""
    root, model = document.root, chain.model
    step, floating = float(model.opt.timestep), bool(model.body_gravcomp[chain.bodies[0]])
    joints = elements_of(root, chain)
    for j, (drive, own) in enumerate(zip(drives, own_drives(chain), strict=True)):
        name, number = chain.names[j], chain.joints[j]
        servo = next(e for e in actuators_of(root, name) if e.tag in ("position", "general"))
        gear = float(model.actuator_gear[chain.servo(number), 0])
        regulated = drive.taking(own, GAINS) != drive
        if regulated:
            tune(servo, drive.stiffness / gear**2, (1.0 - drive.ahead) * drive.damper / gear**2)
            write_ahead(root, name, drive.ahead * drive.damper)
        if drive.torque != own.torque:
            where, what = (joints[j], "actuatorfrc") if floating else (servo, "force")
            write_limit(where, what, drive.torque / (1.0 if floating else abs(gear)))
        for actuator in actuators_of(root, name) if regulated or drive.delay != own.delay else ():
            write_late(actuator, drive.delay, step)
    shaken = np.array([d.damper for d in drives]) * step * model.dof_invweight0[chain.dofs]
    if int(model.opt.integrator) not in IMPLICIT and shaken.max() > SHAKES:
        section(root, "option").set("integrator", "implicitfast")


def write_limit(element: ET.Element, what: str, size: float) -> None:
    """Limit a force on both sides, or let it be without limits."""
    element.set(f"{what}limited", "true" if math.isfinite(size) else "false")
    if math.isfinite(size):
        element.set(f"{what}range", numbers([-size, size]))


def write_ahead(root: ET.Element, joint: str, gain: float) -> None:
    """Give a joint an actuator that takes the commanded speed, or none."""
    if gain:
        known(section(root, "actuator"), "velocity", f"{joint}_ahead", joint=joint, kv=gain)
        return
    for part in root.iter("actuator"):
        for old in part.findall("velocity"):
            if old.get("name") == f"{joint}_ahead":
                part.remove(old)


def write_late(actuator: ET.Element, late: float, step: float) -> None:
    """Let an actuator take its command late."""
    for name in ("delay", "nsample", "interp"):
        actuator.attrib.pop(name, None)
    actuator.attrib |= delayed(late, step)


def write_share(root: ET.Element, chain: Chain, share: float) -> None:
    """Let the actuators of an arm carry a share of gravity."""
    joints, parents = elements_of(root, chain), parents_of(root)
    for body in parents[joints[0]].iter("body"):
        body.set("gravcomp", numbers([share]))
    for joint in joints:
        joint.set("actuatorgravcomp", "true" if share else "false")


def can_write(opened: Opened) -> bool:
    """Whether every joint has a servo of its own that can be given other numbers."""
    chain, root = opened.chain, opened.given.document.root
    servos = [chain.servo(joint) for joint in chain.joints]
    tags = [{e.tag for e in actuators_of(root, name)} for name in chain.names]
    named = all({"position", "general"} & some for some in tags)
    return named and not chain.model.actuator_dyntype[servos].any()
