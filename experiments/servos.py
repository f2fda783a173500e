"""Do logs with commands give a model the drives of its arm: gains, a late command, friction.

    python -m experiments.servos [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N]

Simulated "real" arms in MuJoCo, half of them with elastic joints, whose position servos have other
gains than their file says, and take commands late; friction and rotors that the file lacks besides.
After `gap --write` arm and model follow a fast run that no log holds.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

import minimax_cal as mc
from experiments.driven_arms import DrivenArm, Motion, commands, drawn_arm, served
from experiments.sweep import Study, study_options
from minimax_cal.dynamics.given import MotionKnown
from minimax_cal.dynamics.logs.table import NOTHING, TORQUE, Run
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Table
from minimax_cal.robots.mjcf import mujoco, numbers
from minimax_cal.simulators.chain import chain_of, fill_history
from minimax_cal.simulators.mjcf_tree import MjcfTree
from minimax_cal.simulators.motion.drives import serve
from minimax_cal.simulators.motion.judge import Judge
from minimax_cal.simulators.motion.numbers import open_model

ARMS = ("ur10", "seven_axes", "irb2600", "scara_600")
HZ, STEP = 250.0, 0.001  # of the log, of the real arm [s]
BANDWIDTH = 2.0 * np.pi * 4.0  # of the file's servos at the largest inertia [1/s]
SPRING = 2.0 * np.pi * 15.0  # of an elastic joint with its link [1/s]
NOISE_Q, NOISE_QD, NOISE_TORQUE = 2e-6, 1e-4, 2e-3  # of the log [rad, rad/s]; of most torque
SPEEDS = (0.3, 0.7, 1.0, 1.2)  # of the logs, over the usual; the fastest judges
UNSEEN, UNSEEN_SPEED = 77, 1.4  # the run that no log holds
SETTLED, SECONDS = 1.0, 11.0  # of each: from when on it is logged, and its end [s]
LATE = 0.02  # the latest command [s]
NORMAL = 1.96  # deviations that hold 95 %


@dataclass(frozen=True, eq=False)
class Servoed:
    """An arm, its file with position servos, and what drives it really.

    stiffness, damper: (n,) of the file's servos [N m/rad, N m s/rad].  gain: (2, n) of the real
    over these.  delay: of the command [s].  spring: (n,) stiffness of elastic joints, 0 for stiff.
    """

    arm: DrivenArm
    stiffness: Array
    damper: Array
    gain: Array
    delay: float
    spring: Array

    @property
    def xml(self) -> bytes:
        """The file."""
        return served(self.arm.xml, self.stiffness, self.damper)

    @cached_property
    def real(self) -> Any:
        """The real arm, compiled; its command comes late before it gets there."""
        kp, kv = self.gain * [self.stiffness, self.damper]
        root, lacks = ET.fromstring(served(self.arm.xml, kp, kv)), self.arm.withheld
        option = root.find("option")
        assert option is not None
        option.set("timestep", str(STEP))
        joints = [joint for joint in root.iter("joint") if joint.get("name", "").startswith("j")]
        for j, joint in enumerate(joints):
            joint.set("frictionloss", numbers([lacks.friction[j]]))
            joint.set("damping", numbers([lacks.damping[j]]))
            joint.set("armature", numbers([lacks.armature[j]]))
        if self.spring.any():
            parents = MjcfTree(root).find_parents()
            for j, joint in enumerate(joints):
                sprung(parents, joint, float(self.spring[j]), j)
        return mujoco().MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))

    def follow(self, model: Any, at: Motion, late: float = 0.0) -> Array:
        """(3, m, n) joint values, speeds and torques at HZ along commands.  at: of `commands`."""
        mj, data = mujoco(), mujoco().MjData(model)
        names = [model.joint(i).name for i in range(model.njnt)]
        own = [i for i, name in enumerate(names) if not name.startswith("flex")]
        step, n = float(model.opt.timestep), len(own)
        time = step * np.arange(round(SECONDS / step))
        wanted, start = at(time - late)[0], at(np.zeros(1))
        data.qpos[own], data.qvel[own] = start[0, 0], start[1, 0]
        data.ctrl[:n] = wanted[0]
        fill_history(model, data)
        every, rows = round(1.0 / HZ / step), []
        for k in range(len(time)):
            data.ctrl[:n] = wanted[k]
            q, qd = data.qpos[own].copy(), data.qvel[own].copy()
            mj.mj_step(model, data)
            if k % every == 0 and time[k] >= SETTLED:
                rows.append([q, qd, data.qfrc_actuator[own].copy()])
        return np.moveaxis(np.array(rows), 1, 0)

    def logs(self, speeds: Sequence[float] = SPEEDS, seed: int = 0) -> list[Run]:
        """Logs of the real arm with commands, joint values and torques."""
        rng, out = np.random.default_rng([self.arm.seed, seed, 98]), []
        for number, speed in enumerate(speeds):
            at = commands(self.arm, number, speed)
            q, qd, torque = self.follow(self.real, at, self.delay)
            time, noise = np.arange(len(q)) / HZ, rng.normal(size=(3, *q.shape))
            torque += NOISE_TORQUE * np.abs(torque).max(axis=0) * noise[2]
            out.append(Run(f"run{number}", f"run{number}.csv", time, q + NOISE_Q * noise[0],
                           qd + NOISE_QD * noise[1], None, torque, TORQUE,
                           command=at(SETTLED + time)[0]))  # fmt: skip
        return out

    def missed(self, xml: bytes, real: Array) -> float:
        """RMS joint error of a file on the run that no log holds [rad]."""
        model = mujoco().MjModel.from_xml_string(xml.decode())
        q = self.follow(model, commands(self.arm, UNSEEN, UNSEEN_SPEED))[0]
        return float(np.sqrt(((q - real) ** 2).mean()))


def sprung(parents: dict[ET.Element, ET.Element], joint: ET.Element, spring: float, j: int) -> None:
    """Put a spring between a joint's motor and its link."""
    body = parents[joint]
    above = parents[body]
    motor = ET.Element("body", {"name": f"motor{j + 1}"})
    for name in ("pos", "quat"):
        if name in body.attrib:
            motor.set(name, body.attrib.pop(name))
    above[list(above).index(body)] = motor
    body.remove(joint)
    ET.SubElement(motor, "inertial", pos="0 0 0", mass="1e-6", diaginertia="1e-9 1e-9 1e-9")
    motor.append(joint)
    motor.append(body)
    flex = {name: joint.get(name, "") for name in ("type", "pos", "axis") if joint.get(name)}
    flex |= {"name": f"flex{j + 1}", "stiffness": numbers([spring])}
    flex["damping"] = numbers([0.02 * spring / SPRING])
    body.insert(0, ET.Element("joint", flex))


def drawn(name: str, seed: int, *, elastic: bool, sound: bool = False) -> Servoed:
    """An arm with gains times 0.5 to 2, a delay of up to 20 ms, friction and rotors.

    sound: whether its servos are those of the file.
    """
    arm = drawn_arm(name, seed, ("friction", "armature"))
    rng, n = np.random.default_rng([seed, 97]), arm.robot.joints
    inertia = largest(arm)
    kp = BANDWIDTH**2 * inertia
    kv = 2.0 * rng.uniform(0.7, 1.0, n) * np.sqrt(kp * inertia)
    gain = np.exp(rng.uniform(np.log(0.5), np.log(2.0), (2, n)))
    late = float(rng.uniform(0.0, LATE))
    spring = SPRING**2 * inertia * elastic
    if sound:
        gain, late = np.ones((2, n)), 0.0
    return Servoed(arm, kp, kv, gain, late, spring)


def largest(arm: DrivenArm) -> Array:
    """(n,) largest inertia about each joint of the file [kg m^2]."""
    model = arm.known
    return chain_of(model, arm.robot.joints, arm.robot.name).find_largest_inertias()


@dataclass(frozen=True)
class Case:
    """A simulated arm.  sound: whether its servos are those of the file."""

    arm: str
    seed: int
    elastic: bool
    sound: bool = False


@dataclass(frozen=True)
class Closed:
    """Joint error on the unseen run before, after, and by logs without torques [mrad]; errors of
    stiffness, damper and delay over their deviations; what is said of drives.
    """

    before: float
    after: float
    alone: float
    off: tuple[list[float], list[float], list[float]]
    effects: tuple[str, ...]


def run(case: Case) -> Closed:
    """Correct the file of an arm by its logs, and let it follow commands that these do not hold."""
    one = drawn(case.arm, case.seed, elastic=case.elastic, sound=case.sound)
    runs, at = one.logs(), commands(one.arm, UNSEEN, UNSEEN_SPEED)
    real = one.follow(one.real, at, one.delay)[0]
    ends = [1e3 * one.missed(one.xml, real)]
    with tempfile.TemporaryDirectory() as folder:
        path, out, other = (Path(folder) / name for name in ("arm.xml", "out.xml", "alone.xml"))
        path.write_bytes(one.xml)
        gap = mc.motion_gap(path, runs, write=out)
        bare = [replace(log, torque=0.0 * log.torque, unit=NOTHING) for log in runs]
        alone = mc.motion_gap(path, bare, write=other)
        for file, found in ((out, gap), (other, alone)):
            text = file.read_bytes() if found.written else one.xml
            ends.append(1e3 * one.missed(text, real))
    kp, kv = one.gain * [one.stiffness, one.damper]
    off: tuple[list[float], list[float], list[float]] = ([], [], [])
    for each in gap.effects:
        j = int(each.place[1:]) - 1
        truth = {"stiffness": kp[j], "damper": kv[j], "delay": one.delay}
        for p in each.parameters:
            if p.name in truth:
                off[list(truth).index(p.name)].append((p.value - truth[p.name]) / p.sigma)
    return Closed(
        ends[0], ends[1], ends[2], off, tuple(f"{e.effect}:{e.place}" for e in gap.effects)
    )


def accused(case: Case) -> tuple[str, ...]:
    """What `gap` says of drives; it is asked where a number is surely another than the file's."""
    one = drawn(case.arm, case.seed, elastic=case.elastic, sound=case.sound)
    runs = one.logs()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_bytes(one.xml)
        opened = open_model(path, one.arm.robot.joints)
        judge = Judge.of(opened, runs, MotionKnown(), fast=True).driving(opened, None)
        effects = mc.motion_gap(path, runs).effects if serve(judge, opened).told else ()
    return tuple(f"{each.effect}:{each.place}" for each in effects)


def drawn_cases(count: int, seed: int, *, sound: bool = False) -> list[Case]:
    """Arms in turn, every second one of each kind with elastic joints."""
    kinds = len(ARMS)
    return [
        Case(ARMS[k % kinds], seed + k, elastic=bool((k // kinds + k) % 2), sound=sound)
        for k in range(count)
    ]


def closed_table(cases: Sequence[Case], found: Sequence[Closed]) -> Table:
    """What remains on the unseen run, arm by arm, and how often intervals hold."""
    rows = []
    each = np.array([[one.before, 100.0 * one.after / one.before, 100.0 * one.alone / one.before]
                     for one in found])  # fmt: skip
    for case, one, ends in zip(cases, found, each.tolist(), strict=True):
        kind = "elastic" if case.elastic else "stiff"
        rows.append((f"{case.arm} {case.seed}, {kind}", *ends, *map(share_inside, zip(one.off))))
    held = (share_inside([one.off[k] for one in found]) for k in range(3))
    rows.append(("median; intervals of all", *np.median(each, axis=0).tolist(), *held))
    title = "Simulated arms on a fast run that no log holds, after gap --write"
    return Table.made(
        title,
        rows,
        "arm | joint error as given mrad .3g | remains % .3g | without torques % .3g | "
        "intervals of kp that hold % .3g | of kv % .3g | of the delay % .3g",
    )


def share_inside(off: Sequence[Sequence[float]]) -> float:
    """How many errors are within 1.96 deviations, NaN of none [%]."""
    every = np.concatenate([np.zeros(0), *off])
    return float(100.0 * (np.abs(every) < NORMAL).mean()) if len(every) else float("nan")


@study_options("servos")
def main(study: Study) -> None:
    """Drives by logs with commands."""
    cases, sound = drawn_cases(20, study.seed), drawn_cases(100, study.seed + 1000, sound=True)
    if study.quick:  # the first SCARA, the quickest arm
        cases, sound = cases[3:4], sound[3:4]
    found = study.sweep(run, cases, "arms with other drives")
    wrongly = study.sweep(accused, sound, "arms with sound drives")
    rows = [(len(wrongly), sum(bool(one) for one in wrongly), ", ".join(sum(wrongly, ())) or None)]
    tables = [closed_table(cases, found),
              Table.made("Sound drives", rows, "arms | accused | of")]  # fmt: skip
    content = {
        "cases": [{"arm": case.arm, "seed": case.seed, "elastic": case.elastic,
                   "before_mrad": one.before, "after_mrad": one.after, "alone_mrad": one.alone,
                   "off": one.off, "effects": one.effects}
                  for case, one in zip(cases, found, strict=True)],
        "accused": wrongly,
    }  # fmt: skip
    study.save(tables, content)
