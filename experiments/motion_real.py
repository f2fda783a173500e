"""What torques along trajectories tell of a real arm and a simulated one, on runs that no fit saw.

    python -m experiments.motion_real [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N]

Each run is left out in turn: the others are diagnosed, and the model is judged on that run at every
step, beside what the diagnosis claims for runs that it left out itself.  The real arm is a UR10e
whose motor currents were logged, where its logs are on this machine; the simulated one has friction
in proportion to the load at joint 2 and a rotor inertia at joint 3 that its file does not know.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import minimax_cal as mc
from experiments.real_arms import SHARED_DATA_FOLDER, has_measurements
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table, TableCell
from minimax_cal.dynamics.known_inputs import read_checked_runs
from minimax_cal.dynamics.logs.log_table import Run
from minimax_cal.dynamics.regressor import (
    JointMotion,
    build_nominal_inertial_parameters,
    inverse_dynamics,
)
from minimax_cal.robots.robot import Robot, load_robot, robot_from_dict

UR10E_TORQUE_FOLDER, SIMULATED_MOTION_ARM = "ur10e_torque", "simulated"
MOTION_ARM_LABELS = {
    UR10E_TORQUE_FOLDER: "UR10e, motor currents",
    SIMULATED_MOTION_ARM: "simulated, three joints",
}
UR10E_DRIVE_GAINS = (
    14.87,
    13.26,
    11.13,
    10.62,
    11.03,
    11.47,
)  # of the UR10e, from the literature [N m/A]
UR10E_GEAR_RATIO = 101.0  # of its gears
SIMULATED_RUN_COUNT, SIMULATED_RUN_SECONDS, SIMULATED_LOG_RATE_HZ = (
    5,
    20.0,
    100.0,
)  # of the simulated arm: how many, how long [s], [Hz]
SIMULATED_TORQUE_NOISE = 0.1  # of its torques [N m]
SIMULATED_COULOMB_FRICTION, SIMULATED_VISCOUS_FRICTION = (
    np.array([4.0, 3.0, 1.5]),
    np.array([3.0, 4.0, 1.0]),
)  # [N m], [N m s/rad]
SIMULATED_LOAD_FRICTION, SIMULATED_ARMATURE = (
    0.07,
    0.4,
)  # at joint 2, share of the load; at joint 3 [kg m^2]
SIMULATED_LINK_WIDTH = 0.06  # side of the links of the simulated arm [m]


@dataclass(frozen=True)
class LeftOutRun:
    """An arm and the run of it that is left out."""

    arm: str
    run: int
    seed: int


@dataclass(frozen=True)
class LeftOutRunReport:
    """What the others say, and what they reach on the run that was left out.

    steps: names of the budget.  claimed, reached: RMS torque (s, n) of moving rows, whole: of all
    rows that the run has.  confirmed: effects with their places.
    """

    name: str
    unit: str
    steps: tuple[str, ...]
    claimed: Array
    reached: Array
    whole: Array
    confirmed: tuple[str, ...]
    unexplained: tuple[str, ...]


def diagnose_without_run(left: LeftOutRun) -> LeftOutRunReport:
    """Diagnose all runs but one, and judge the model on that."""
    robot, runs = load_or_simulate_logs(left.arm, left.seed)
    rest = [one for i, one in enumerate(runs) if i != left.run]
    gain, ratio = (
        (UR10E_DRIVE_GAINS, UR10E_GEAR_RATIO) if left.arm == UR10E_TORQUE_FOLDER else (None, None)
    )
    found = mc.diagnose_motion(robot, rest, drive_gain=gain, ratio=ratio)
    seen = mc.evaluate_motion(found, [runs[left.run]])
    names = tuple(step.name for step in seen.steps)
    budget = {step.name: step.holdout_rms_moving for step in found.budget}
    return LeftOutRunReport(
        name=runs[left.run].name,
        unit=found.unit,
        steps=names,
        claimed=np.array([budget[name] for name in names]),
        reached=np.array([step.rms_moving for step in seen.steps]),
        whole=np.array([step.rms for step in seen.steps]),
        confirmed=tuple(sorted({f"{e.effect} {e.place}" for e in found.effects if e.established})),
        unexplained=tuple(one.place for one in found.unexplained),
    )


def load_or_simulate_logs(arm_name: str, seed: int) -> tuple[Robot, Sequence[Run]]:
    """The arm as its file has it, and its runs."""
    if arm_name == UR10E_TORQUE_FOLDER:
        robot = load_robot(SHARED_DATA_FOLDER / UR10E_TORQUE_FOLDER / "ur10e.urdf")
        return robot, read_checked_runs(
            robot, robot, sorted((SHARED_DATA_FOLDER / UR10E_TORQUE_FOLDER).glob("*.csv"))
        )
    return simulate_arm_and_runs(seed)


def simulate_arm_and_runs(seed: int) -> tuple[Robot, Sequence[Run]]:
    """An arm of three joints with usual friction, and two effects that its file does not know."""
    rng, robot = np.random.default_rng(seed), build_three_joint_robot()
    time, out = np.arange(0.0, SIMULATED_RUN_SECONDS, 1.0 / SIMULATED_LOG_RATE_HZ), list[Run]()
    for number in range(SIMULATED_RUN_COUNT):
        motion = draw_fourier_motion(rng, time, robot.joints, 0.06 + 0.03 * number)
        torque = inverse_dynamics(robot, motion, build_nominal_inertial_parameters(robot))
        sense = np.sign(motion.qd)
        more = sense * SIMULATED_COULOMB_FRICTION + motion.qd * SIMULATED_VISCOUS_FRICTION
        more[:, 1] += SIMULATED_LOAD_FRICTION * np.abs(torque[:, 1]) * sense[:, 1]
        more[:, 2] += SIMULATED_ARMATURE * motion.qdd[:, 2]
        torque = torque + more + SIMULATED_TORQUE_NOISE * rng.normal(size=torque.shape)
        name = f"run{number + 1}"
        out.append(Run(name, f"{name}.csv", time, motion.q, None, None, torque, "N m"))
    return robot, out


def draw_fourier_motion(
    rng: np.random.Generator, time: Array, joints: int, first_harmonic_hz: float
) -> JointMotion:
    """A finite Fourier series of four harmonics.  first_harmonic_hz: of the first [Hz]."""
    k = np.arange(1.0, 5.0)
    speed = 2.0 * np.pi * first_harmonic_hz * k
    size = 0.6 * rng.normal(size=(2, len(k), joints)) / k[:, None]
    sin, cos = np.sin(np.outer(time, speed)), np.cos(np.outer(time, speed))
    a, b = size
    w = speed[:, None]
    return JointMotion(sin @ a + cos @ b, cos @ (w * a) - sin @ (w * b),
                  -(sin @ (w**2 * a) + cos @ (w**2 * b)))  # fmt: skip


def build_three_joint_robot() -> Robot:
    """A vertical axis and two parallel ones, with links of steel bars."""
    half, joints = np.pi / 2.0, []
    for a, d, alpha, mass in ((0.0, 0.4, half, 8.0), (0.5, 0.0, 0.0, 6.0), (0.4, 0.1, half, 3.0)):
        length = max(a, d)
        about = mass * (length**2 + SIMULATED_LINK_WIDTH**2) / 12.0
        joints.append({
            "a": a, "d": d, "theta": 0.0, "alpha": alpha, "mass_kg": mass,
            "com_mm": [-500.0 * a, -500.0 * d if d > a else 0.0, 20.0],
            "inertia": [mass * SIMULATED_LINK_WIDTH**2 / 6.0, 0.0, 0.0, about, 0.0, about],
        })  # fmt: skip
    units = {"length": "m", "angle": "rad"}
    return robot_from_dict({"name": "three joints", "units": units, "joints": joints})


# ---- tables --------------------------------------------------------------------------------------


def build_budget_steps_table(arm_name: str, reports: Sequence[LeftOutRunReport]) -> Table:
    """RMS torque on the runs left out, by the steps that every diagnosis has, and at the end."""

    def over_runs(each: Sequence[Array]) -> list[TableCell]:
        return list(np.sqrt(np.mean(np.square(each), axis=0)).tolist())

    shared = [name for name in reports[0].steps if all(name in one.steps for one in reports)]
    last = [one.reached[-1] for one in reports]
    claimed = np.array([one.claimed[-1] for one in reports])
    rows = [(name, *over_runs([one.reached[one.steps.index(name)] for one in reports]))
            for name in shared]  # fmt: skip
    rows += [
        ("all effects", *over_runs(last)),
        ("all effects, with rows at rest", *over_runs([one.whole[-1] for one in reports])),
        ("claimed over reached", *np.median(claimed / last, axis=0).tolist()),
    ]
    title = (
        f"{MOTION_ARM_LABELS[arm_name]}: RMS torque [{reports[0].unit}"
        f"] on each run left out, {len(reports)} runs"
    )
    return Table.from_rows(title, rows, "step", *(f"J{j + 1} .3g" for j in range(len(last[0]))))


def build_confirmed_effects_table(arm_name: str, reports: Sequence[LeftOutRunReport]) -> Table:
    """How often each effect is confirmed."""
    counts = Counter(name for one in reports for name in one.confirmed)
    rows = tuple((name, count, len(reports)) for name, count in counts.most_common())
    return Table.from_rows(
        f"{MOTION_ARM_LABELS[arm_name]}: effects confirmed", rows, "effect | runs left out d | of d"
    )


@study_options("motion_real")
def main(study: Study) -> None:
    """Torques along trajectories, judged by runs that no fit saw."""
    arms = [
        arm for arm in MOTION_ARM_LABELS if arm == SIMULATED_MOTION_ARM or has_measurements(arm)
    ]
    tables, content = list[Table](), dict[str, object]()
    for arm in arms[-1:] if study.quick else arms:
        count = (
            SIMULATED_RUN_COUNT
            if arm == SIMULATED_MOTION_ARM
            else len(load_or_simulate_logs(arm, study.seed)[1])
        )
        jobs = [LeftOutRun(arm, i, study.seed) for i in range(2 if study.quick else count)]
        told = study.sweep(diagnose_without_run, jobs, "runs left out")
        tables += [build_budget_steps_table(arm, told), build_confirmed_effects_table(arm, told)]
        content[arm] = [
            {"run": one.name, "unit": one.unit, "rms_moving": one.reached[-1].tolist(),
             "rms": one.whole[-1].tolist(), "claimed": one.claimed[-1].tolist(),
             "unexplained": one.unexplained,
             "confirmed": one.confirmed} for one in told
        ]  # fmt: skip
    study.save(tables, content)
