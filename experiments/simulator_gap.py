"""Does a simulator do what the fit says?  Published gains, corrected step by step, in MuJoCo.

    python -m experiments.simulator_gap [--quick] [--out FOLDER] [--json FILE] [--seed N] ...

Three arms, one of seven axes, with compliant joints and a compliant foot, play in their gears and
encoder errors; one of them again with masses unknown.  Their nominal models, with servo
gains as published models have them, are corrected step by step; every figure is measured in the
simulator, on poses that no fit has seen.  The last column drives the corrected file by a loop of
its own.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import minimax_cal as mc
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array, rms
from minimax_cal.core.optional_packages import import_optional
from minimax_cal.core.tables import Table, TableCell
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.effects.table import Fitted, parse_effect_terms
from minimax_cal.reporting.plots.simulator_figure import build_simulator_gap_figure
from minimax_cal.robots.gravity_torques import assumed_link_masses_and_centres
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.robot import robot_from_dict
from minimax_cal.simulators.result import SimulatorGap

PUBLISHED_SERVO_GAINS = (
    5000.0,
    5000.0,
    5000.0,
    1000.0,
    1000.0,
    1000.0,
    1000.0,
)  # gains of the size in use
SIMULATED_JOINT_COMPLIANCE = 6e-6  # of each joint [rad/(N m)]
SIMULATED_ENCODER_GAIN, SIMULATED_BASE_COMPLIANCE, SIMULATED_GEAR_PLAY = (
    4e-4,
    9e-7,
    1.5e-4,
)  # [-], [rad/(N m)], from stop to stop [rad]
SIMULATED_COORDINATE_NOISE = 10e-6  # of a coordinate [m]
SIMULATED_GAP_EFFECTS = (
    "joint_compliance:all",
    "encoder_gain:all",
    "base_flex:frame",
    "backlash:all",
)


@dataclass(frozen=True)
class SimulatorTrial:
    """One arm.  poses: measured, a quarter of them held out.  known: whether its masses are."""

    robot: str
    poses: int
    seed: int
    known: bool = True


@dataclass(frozen=True, eq=False)
class SimulatorTrialResult:
    """gap: the ladder.  The rest is of the corrected file, by a loop of its own.

    alone_mm: held-out RMS.  speed: largest after 1.5 s of rest [rad/s].  limited: share of the
    timesteps at a force limit.
    """

    gap: SimulatorGap
    alone_mm: float
    speed: float
    limited: float


def load_robot_or_seven_axes(name: str) -> mc.Robot:
    """A built-in robot, or the arm of seven axes."""
    if name != "seven_axes":
        return mc.load_robot(name)
    lengths, turn = (360.0, 0.0, 420.0, 0.0, 400.0, 0.0, 126.0), math.pi / 2.0
    tilts = (-turn, turn, turn, -turn, -turn, turn, 0.0)
    joints = [
        {"a": 0.0, "d": d, "theta": 0.0, "alpha": alpha, "lower": -2.8, "upper": 2.8}
        for d, alpha in zip(lengths, tilts, strict=True)
    ]
    units = {"length": "mm", "angle": "rad"}
    return robot_from_dict({"name": "an arm of seven axes", "units": units, "joints": joints})


def add_light_masses(robot: mc.Robot) -> mc.Robot:
    """The robot with masses: a third of what would be assumed, as real arms have."""
    mass, com = assumed_link_masses_and_centres(robot.mdh)
    return replace(robot, mass=np.maximum(mass / 3.0, 0.5), com=com)


def simulate_tracker_measurements(robot: mc.Robot, trial: SimulatorTrial) -> mc.Measurements:
    """What a tracker sees of an arm with all the effects, at poses in random order."""
    rng = np.random.default_rng(trial.seed)
    plain = mc.simulate(robot, 3, seed=trial.seed, truth=mc.Truth(noise=0.0)).cell
    q = random_joint_values_above_floor(robot, trial.poses, rng, 2.0)
    data = mc.measurements(q, plain.predict(q), order=np.arange(len(q)))
    data = add_history_columns(data)
    scene = plain.pose_arm(data)
    found = parse_effect_terms(scene, SIMULATED_GAP_EFFECTS)
    counts = [len(term.columns(scene).names) for term in found]
    sizes = (
        SIMULATED_JOINT_COMPLIANCE,
        SIMULATED_ENCODER_GAIN,
        SIMULATED_BASE_COMPLIANCE,
        SIMULATED_GEAR_PLAY,
    )
    values = tuple(s * rng.uniform(0.7, 1.3, n) for s, n in zip(sizes, counts, strict=True))
    cell = mc.Cell(plain.robot, plain.base, plain.target_names, plain.target_positions,
                   Fitted(found, values))  # fmt: skip
    y = cell.follow(data)
    held = np.where(np.arange(trial.poses) % 4 == 3, "holdout", "train")
    return mc.measurements(
        q,
        y + SIMULATED_COORDINATE_NOISE * rng.normal(size=y.shape),
        order=np.arange(len(q)),
        split=held,
    )


def write_published_model(robot: mc.Robot, path: Path) -> None:
    """The nominal model with gains of the size that published ones have, which gravity loads."""
    text = mc.export(robot, "mjcf", notify=lambda notice: None)
    text = re.sub(r' (actuator)?gravcomp="[^"]*"', "", text)
    gains = iter(PUBLISHED_SERVO_GAINS)
    text = re.sub(r'kp="[^"]*"', lambda _: f'kp="{next(gains)}"', text)
    path.write_text(re.sub(r'kv="[^"]*"', 'kv="400"', text))


def run_trial(trial: SimulatorTrial) -> SimulatorTrialResult:
    """The ladder of one arm, and its corrected file by itself."""
    robot = add_light_masses(load_robot_or_seven_axes(trial.robot))
    data = simulate_tracker_measurements(robot, trial)
    robot = robot if trial.known else load_robot_or_seven_axes(trial.robot)
    fit = mc.calibrate(robot, data, objective="sum", effects=SIMULATED_GAP_EFFECTS)
    with tempfile.TemporaryDirectory() as folder:
        model, corrected = Path(folder) / f"{trial.robot}.xml", Path(folder) / "corrected.xml"
        write_published_model(robot, model)
        gap = mc.simulator_gap(model, data, fit=fit, write=corrected)
        return SimulatorTrialResult(gap, *drive_corrected_model(corrected, fit))


def drive_corrected_model(path: Path, fit: mc.Fit) -> tuple[float, float, float]:
    """Of a corrected file, driven by smooth moves from pose to pose, nothing fitted.

    Held-out RMS of its targets [mm], the largest speed of any joint after 1.5 s of rest [rad/s],
    and the share of the timesteps at which an actuator is at its force limit.
    """
    mujoco = import_optional("mujoco", "the study", "minimax-cal[mujoco]")
    model = mujoco.MjModel.from_xml_path(str(path))
    data, held = mujoco.MjData(model), add_history_columns(fit.data).take(fit.held)
    names = [f"joint{i + 1}" for i in range(held.q.shape[1])]
    at = [int(model.joint(name).qposadr[0]) for name in names]
    limit = np.where(model.actuator_forcelimited, model.actuator_forcerange[:, 1], np.inf)
    error, fastest, limited, steps, before = [], 0.0, 0, 0, held.q[0]
    data.qpos[at] = before
    for row, target in enumerate(held.q):
        for i in range(len(names)):
            play = model.joint(f"play{i + 1}")
            side = held.columns[f"approach{i + 1}"][row]
            model.qpos_spring[play.qposadr[0]] = side * play.range[1] / 1.01 * backlash_sign(fit, i)
        length = max(2.0, 1.875 * float(np.abs(target - before).max()))
        for k in range(1, round((length + 1.5) / model.opt.timestep) + 1):
            s = min(k * model.opt.timestep / length, 1.0)
            data.ctrl[:] = before + (target - before) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
            mujoco.mj_step(model, data)
            limited += bool((np.abs(data.actuator_force) >= limit).any())
            steps += 1
        points = np.array([data.site(name).xpos for name in held.target_names])
        seen = points @ fit.cell.base[:3, :3].T + fit.cell.base[:3, 3]
        error.append(np.linalg.norm(held.y[row] - seen, axis=-1))
        fastest, before = max(fastest, float(np.abs(data.qvel).max())), target
    return 1e3 * rms(np.array(error)), fastest, limited / steps


def backlash_sign(fit: mc.Fit, joint_index: int) -> float:
    """Whether a joint stops short (-1) or runs ahead of its command (+1)."""
    values: dict[str, Array] = {
        term.effect: found
        for term, found in zip(fit.cell.effects.terms, fit.cell.effects.values, strict=True)
    }
    return float(np.sign(values["backlash"][joint_index]))


def build_step_rows(
    trial: SimulatorTrial, result: SimulatorTrialResult
) -> Iterator[tuple[TableCell, ...]]:
    """A row a rung, and with the last what the file does alone."""
    name = trial.robot if trial.known else f"{trial.robot}, masses unknown"
    for rung in result.gap.rungs:
        off = 1e3 * (rung.holdout_rms_mm - rung.predicted_rms_mm)
        alone = result.alone_mm if rung is result.gap.rungs[-1] else math.nan
        yield (name, rung.name, rung.holdout_rms_mm, rung.holdout_max_mm, rung.predicted_rms_mm,
               off, rung.sag_mrad, alone)  # fmt: skip


def build_step_table(
    trials: Sequence[SimulatorTrial], results: Sequence[SimulatorTrialResult]
) -> Table:
    """All ladders."""
    rows = [row for t, r in zip(trials, results, strict=True) for row in build_step_rows(t, r)]
    return Table.from_rows(
        "held-out errors in the simulator, step by step, and the fit's prediction of these poses",
        rows,
        "arm | model | RMS mm .4f | max mm .4f | fit says mm .4f | off um +.2f | "
        "joints off mrad .3f | the file alone mm .4f",
    )


@study_options("simulator_gap")
def main(study: Study) -> None:
    """How far simulated arms are from real ones, before and after."""
    names = ("ur10",) if study.quick else ("ur10", "irb2600", "seven_axes")
    poses = 50 if study.quick else 160
    trials = [SimulatorTrial(name, poses, study.seed + i) for i, name in enumerate(names)]
    trials += [] if study.quick else [SimulatorTrial("ur10", poses, study.seed, known=False)]
    results = study.sweep(run_trial, trials, "arms")
    table = build_step_table(trials, results)
    content = {
        trial.robot + ("" if trial.known else "_unknown_masses"): {
            **result.gap.to_dict(),
            "alone_mm": result.alone_mm,
            "speed_after_rest": result.speed,
            "at_limit": result.limited,
        }
        for trial, result in zip(trials, results, strict=True)
    }
    figures = {"simulator_gap_ladder": build_simulator_gap_figure(results[0].gap)}
    study.save([table], content, figures, packages=("mujoco",))
