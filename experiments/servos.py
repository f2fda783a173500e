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
from experiments.driven_arms import (
    CommandedMotion,
    DrivenArm,
    draw_commanded_motion,
    draw_driven_arm,
    replace_motors_by_servos,
)
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table
from minimax_cal.dynamics.known_inputs import MotionKnown
from minimax_cal.dynamics.logs.log_table import NO_TORQUE_UNIT, TORQUE_UNIT, Run
from minimax_cal.robots.mjcf_import import format_exact_numbers, import_mujoco
from minimax_cal.simulators.chain import fill_command_history, find_model_arm
from minimax_cal.simulators.mjcf_tree import MjcfTree
from minimax_cal.simulators.motion.drives import fit_drives
from minimax_cal.simulators.motion.judge import MotionJudge
from minimax_cal.simulators.motion.model_parameters import open_model

SERVO_ARMS = ("ur10", "seven_axes", "irb2600", "scara_600")
SERVO_LOG_RATE_HZ, SERVO_TIME_STEP = 250.0, 0.001  # of the log, of the real arm [s]
SERVO_BANDWIDTH = 2.0 * np.pi * 4.0  # of the file's servos at the largest inertia [1/s]
ELASTIC_JOINT_FREQUENCY = 2.0 * np.pi * 15.0  # of an elastic joint with its link [1/s]
SERVO_JOINT_NOISE, SERVO_SPEED_NOISE, SERVO_TORQUE_NOISE_FRACTION = (
    2e-6,
    1e-4,
    2e-3,
)  # of the log [rad, rad/s]; of most torque
LOG_SPEED_FACTORS = (0.3, 0.7, 1.0, 1.2)  # of the logs, over the usual; the fastest judges
UNSEEN_SERVO_RUN_NUMBER, UNSEEN_SERVO_SPEED_FACTOR = 77, 1.4  # the run that no log holds
FIRST_LOGGED_SECOND, SERVO_RUN_SECONDS = (
    1.0,
    11.0,
)  # of each: from when on it is logged, and its end [s]
MAX_COMMAND_DELAY = 0.02  # the latest command [s]
NORMAL_95_QUANTILE = 1.96  # deviations that hold 95 %


@dataclass(frozen=True, eq=False)
class ServoArm:
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
    def file_xml(self) -> bytes:
        """The file."""
        return replace_motors_by_servos(self.arm.xml, self.stiffness, self.damper)

    @cached_property
    def compiled_real_arm(self) -> Any:
        """The real arm, compiled; its command comes late before it gets there."""
        kp, kv = self.gain * [self.stiffness, self.damper]
        root, lacks = (
            ET.fromstring(replace_motors_by_servos(self.arm.xml, kp, kv)),
            self.arm.withheld,
        )
        option = root.find("option")
        assert option is not None
        option.set("timestep", str(SERVO_TIME_STEP))
        joints = [joint for joint in root.iter("joint") if joint.get("name", "").startswith("j")]
        for j, joint in enumerate(joints):
            joint.set("frictionloss", format_exact_numbers([lacks.friction[j]]))
            joint.set("damping", format_exact_numbers([lacks.damping[j]]))
            joint.set("armature", format_exact_numbers([lacks.armature[j]]))
        if self.spring.any():
            parents = MjcfTree(root).find_parents()
            for j, joint in enumerate(joints):
                insert_joint_spring(parents, joint, float(self.spring[j]), j)
        return import_mujoco().MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))

    def simulate_commands(
        self, model: Any, commands: CommandedMotion, command_delay: float = 0.0
    ) -> Array:
        """(3, m, n) joint values, speeds and torques at HZ along commands.  commands: of
        `draw_commanded_motion`.
        """
        mj, data = import_mujoco(), import_mujoco().MjData(model)
        names = [model.joint(i).name for i in range(model.njnt)]
        own = [i for i, name in enumerate(names) if not name.startswith("flex")]
        step, n = float(model.opt.timestep), len(own)
        time = step * np.arange(round(SERVO_RUN_SECONDS / step))
        wanted, start = commands(time - command_delay)[0], commands(np.zeros(1))
        data.qpos[own], data.qvel[own] = start[0, 0], start[1, 0]
        data.ctrl[:n] = wanted[0]
        fill_command_history(model, data)
        every, rows = round(1.0 / SERVO_LOG_RATE_HZ / step), []
        for k in range(len(time)):
            data.ctrl[:n] = wanted[k]
            q, qd = data.qpos[own].copy(), data.qvel[own].copy()
            mj.mj_step(model, data)
            if k % every == 0 and time[k] >= FIRST_LOGGED_SECOND:
                rows.append([q, qd, data.qfrc_actuator[own].copy()])
        return np.moveaxis(np.array(rows), 1, 0)

    def simulate_logs(
        self, speed_factors: Sequence[float] = LOG_SPEED_FACTORS, seed: int = 0
    ) -> list[Run]:
        """Logs of the real arm with commands, joint values and torques."""
        rng, out = np.random.default_rng([self.arm.seed, seed, 98]), []
        for number, speed in enumerate(speed_factors):
            at = draw_commanded_motion(self.arm, number, speed)
            q, qd, torque = self.simulate_commands(self.compiled_real_arm, at, self.delay)
            time, noise = np.arange(len(q)) / SERVO_LOG_RATE_HZ, rng.normal(size=(3, *q.shape))
            torque += SERVO_TORQUE_NOISE_FRACTION * np.abs(torque).max(axis=0) * noise[2]
            out.append(
                Run(
                    f"run{number}",
                    f"run{number}.csv",
                    time,
                    q + SERVO_JOINT_NOISE * noise[0],
                    qd + SERVO_SPEED_NOISE * noise[1],
                    None,
                    torque,
                    TORQUE_UNIT,
                    command=at(FIRST_LOGGED_SECOND + time)[0],
                )
            )
        return out

    def rms_joint_error_of_file(self, xml: bytes, real: Array) -> float:
        """RMS joint error of a file on the run that no log holds [rad]."""
        model = import_mujoco().MjModel.from_xml_string(xml.decode())
        q = self.simulate_commands(
            model,
            draw_commanded_motion(self.arm, UNSEEN_SERVO_RUN_NUMBER, UNSEEN_SERVO_SPEED_FACTOR),
        )[0]
        return float(np.sqrt(((q - real) ** 2).mean()))


def insert_joint_spring(
    parents: dict[ET.Element, ET.Element], joint: ET.Element, stiffness: float, joint_index: int
) -> None:
    """Put a spring between a joint's motor and its link."""
    body = parents[joint]
    above = parents[body]
    motor = ET.Element("body", {"name": f"motor{joint_index + 1}"})
    for name in ("pos", "quat"):
        if name in body.attrib:
            motor.set(name, body.attrib.pop(name))
    above[list(above).index(body)] = motor
    body.remove(joint)
    ET.SubElement(motor, "inertial", pos="0 0 0", mass="1e-6", diaginertia="1e-9 1e-9 1e-9")
    motor.append(joint)
    motor.append(body)
    flex = {name: joint.get(name, "") for name in ("type", "pos", "axis") if joint.get(name)}
    flex |= {"name": f"flex{joint_index + 1}", "stiffness": format_exact_numbers([stiffness])}
    flex["damping"] = format_exact_numbers([0.02 * stiffness / ELASTIC_JOINT_FREQUENCY])
    body.insert(0, ET.Element("joint", flex))


def draw_servo_arm(
    name: str, seed: int, *, with_elastic_joints: bool, with_sound_servos: bool = False
) -> ServoArm:
    """An arm with gains times 0.5 to 2, a delay of up to 20 ms, friction and rotors.

    with_sound_servos: whether its servos are those of the file.
    """
    arm = draw_driven_arm(name, seed, ("friction", "armature"))
    rng, n = np.random.default_rng([seed, 97]), arm.robot.joints
    inertia = largest_joint_inertias(arm)
    kp = SERVO_BANDWIDTH**2 * inertia
    kv = 2.0 * rng.uniform(0.7, 1.0, n) * np.sqrt(kp * inertia)
    gain = np.exp(rng.uniform(np.log(0.5), np.log(2.0), (2, n)))
    late = float(rng.uniform(0.0, MAX_COMMAND_DELAY))
    spring = ELASTIC_JOINT_FREQUENCY**2 * inertia * with_elastic_joints
    if with_sound_servos:
        gain, late = np.ones((2, n)), 0.0
    return ServoArm(arm, kp, kv, gain, late, spring)


def largest_joint_inertias(arm: DrivenArm) -> Array:
    """(n,) largest inertia about each joint of the file [kg m^2]."""
    model = arm.compiled_file_model
    return find_model_arm(model, arm.robot.joints, arm.robot.name).largest_inertias_over_workspace()


@dataclass(frozen=True)
class ServoCase:
    """A simulated arm.  sound: whether its servos are those of the file."""

    arm: str
    seed: int
    elastic: bool
    sound: bool = False


@dataclass(frozen=True)
class ClosedServoGap:
    """Joint error on the unseen run before, after, and by logs without torques [mrad]; errors of
    stiffness, damper and delay over their deviations; what is said of drives.
    """

    before: float
    after: float
    alone: float
    off: tuple[list[float], list[float], list[float]]
    effects: tuple[str, ...]


def run_case(case: ServoCase) -> ClosedServoGap:
    """Correct the file of an arm by its logs, and let it follow commands that these do not hold."""
    one = draw_servo_arm(
        case.arm, case.seed, with_elastic_joints=case.elastic, with_sound_servos=case.sound
    )
    runs, at = (
        one.simulate_logs(),
        draw_commanded_motion(one.arm, UNSEEN_SERVO_RUN_NUMBER, UNSEEN_SERVO_SPEED_FACTOR),
    )
    real = one.simulate_commands(one.compiled_real_arm, at, one.delay)[0]
    ends = [1e3 * one.rms_joint_error_of_file(one.file_xml, real)]
    with tempfile.TemporaryDirectory() as folder:
        path, out, other = (Path(folder) / name for name in ("arm.xml", "out.xml", "alone.xml"))
        path.write_bytes(one.file_xml)
        gap = mc.motion_gap(path, runs, write=out)
        bare = [replace(log, torque=0.0 * log.torque, unit=NO_TORQUE_UNIT) for log in runs]
        alone = mc.motion_gap(path, bare, write=other)
        for file, found in ((out, gap), (other, alone)):
            text = file.read_bytes() if found.written else one.file_xml
            ends.append(1e3 * one.rms_joint_error_of_file(text, real))
    kp, kv = one.gain * [one.stiffness, one.damper]
    off: tuple[list[float], list[float], list[float]] = ([], [], [])
    for each in gap.effects:
        j = int(each.place[1:]) - 1
        truth = {"stiffness": kp[j], "damper": kv[j], "delay": one.delay}
        for p in each.parameters:
            if p.name in truth:
                off[list(truth).index(p.name)].append((p.value - truth[p.name]) / p.sigma)
    return ClosedServoGap(
        ends[0], ends[1], ends[2], off, tuple(f"{e.effect}:{e.place}" for e in gap.effects)
    )


def list_accused_drives(case: ServoCase) -> tuple[str, ...]:
    """What `gap` says of drives; it is asked where a number is surely another than the file's."""
    one = draw_servo_arm(
        case.arm, case.seed, with_elastic_joints=case.elastic, with_sound_servos=case.sound
    )
    runs = one.simulate_logs()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_bytes(one.file_xml)
        opened = open_model(path, one.arm.robot.joints)
        judge = MotionJudge.from_runs(
            opened, runs, MotionKnown(), judge_by_fastest=True
        ).with_drives(opened, None)
        effects = (
            mc.motion_gap(path, runs).effects if fit_drives(judge, opened).changed_effects else ()
        )
    return tuple(f"{each.effect}:{each.place}" for each in effects)


def list_cases(case_count: int, seed: int, *, sound: bool = False) -> list[ServoCase]:
    """Arms in turn, every second one of each kind with elastic joints."""
    kinds = len(SERVO_ARMS)
    return [
        ServoCase(SERVO_ARMS[k % kinds], seed + k, elastic=bool((k // kinds + k) % 2), sound=sound)
        for k in range(case_count)
    ]


def build_closed_gap_table(cases: Sequence[ServoCase], gaps: Sequence[ClosedServoGap]) -> Table:
    """What remains on the unseen run, arm by arm, and how often intervals hold."""
    rows = []
    each = np.array([[one.before, 100.0 * one.after / one.before, 100.0 * one.alone / one.before]
                     for one in gaps])  # fmt: skip
    for case, one, ends in zip(cases, gaps, each.tolist(), strict=True):
        kind = "elastic" if case.elastic else "stiff"
        rows.append(
            (f"{case.arm} {case.seed}, {kind}", *ends, *map(share_within_interval, zip(one.off)))
        )
    held = (share_within_interval([one.off[k] for one in gaps]) for k in range(3))
    rows.append(("median; intervals of all", *np.median(each, axis=0).tolist(), *held))
    title = "Simulated arms on a fast run that no log holds, after gap --write"
    return Table.from_rows(
        title,
        rows,
        "arm | joint error as given mrad .3g | remains % .3g | without torques % .3g | "
        "intervals of kp that hold % .3g | of kv % .3g | of the delay % .3g",
    )


def share_within_interval(off: Sequence[Sequence[float]]) -> float:
    """How many errors are within 1.96 deviations, NaN of none [%]."""
    every = np.concatenate([np.zeros(0), *off])
    return (
        float(100.0 * (np.abs(every) < NORMAL_95_QUANTILE).mean()) if len(every) else float("nan")
    )


@study_options("servos")
def main(study: Study) -> None:
    """Drives by logs with commands."""
    cases, sound = list_cases(20, study.seed), list_cases(100, study.seed + 1000, sound=True)
    if study.quick:  # the first SCARA, the quickest arm
        cases, sound = cases[3:4], sound[3:4]
    found = study.sweep(run_case, cases, "arms with other drives")
    wrongly = study.sweep(list_accused_drives, sound, "arms with sound drives")
    rows = [(len(wrongly), sum(bool(one) for one in wrongly), ", ".join(sum(wrongly, ())) or None)]
    tables = [build_closed_gap_table(cases, found),
              Table.from_rows("Sound drives", rows, "arms | accused | of")]  # fmt: skip
    content = {
        "cases": [{"arm": case.arm, "seed": case.seed, "elastic": case.elastic,
                   "before_mrad": one.before, "after_mrad": one.after, "alone_mrad": one.alone,
                   "off": one.off, "effects": one.effects}
                  for case, one in zip(cases, found, strict=True)],
        "accused": wrongly,
    }  # fmt: skip
    study.save(tables, content)
