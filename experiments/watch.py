"""Is a knock found?  Checks of simulated arms with ten poses, the tracker moved.

    python -m experiments.watch [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N] ...

Each arm is calibrated on 60 poses.  Then the tracker is moved and ten other poses are
measured, twice: of the arm as it was, where whatever is named is a false alarm, and with the zero
of one joint of 2 ... n-1 shifted by 0.2 mrad, which should be named, alone.  Also with a law that
the calibrated model lacks (joint compliance under gravity), where honest sigmas find less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import click
import numpy as np
from scipy.spatial.transform import Rotation

from experiments import sweep
from experiments.sweep import Study, study_options
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Cell as TableCell
from minimax_cal.ground.tables import Table
from minimax_cal.judging.watching.health import check
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.simulate import Truth, gravity, simulate
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import load_robot
from minimax_cal.robots.sampling import random_poses

ARMS = ("irb2600", "irb120", "ur10")
SHIFT = 2e-4  # of a joint's zero [rad]
POSES = 10  # of a check
CALIBRATED = 60  # poses
LACKING = 3e-7  # turn of a joint per gravity torque, which geometry does not hold [rad/(N m)]
KINDS = (("geometry and noise", 0.0), ("compliant joints, not modelled", LACKING))


@dataclass(frozen=True)
class Trial:
    """One arm; which joint is knocked comes from its seed."""

    arm: str
    seed: int
    compliance: float


@dataclass(frozen=True)
class Result:
    """What was named of the arm as it was, and of the one whose joint was knocked."""

    joint: str
    alarms: tuple[str, ...]
    named: tuple[str, ...]
    hidden: tuple[str, ...]
    smallest: float
    enough: int


def seen_anew(cell: Cell, q: Array, truth: Truth, rng: np.random.Generator) -> Measurements:
    """What a tracker elsewhere sees of an arm at some joints (m, n)."""
    base = np.eye(4)
    base[:3, :3] = Rotation.random(rng=rng).as_matrix()
    aside = rng.normal(size=3)
    base[:3, 3] = truth.distance * aside / np.linalg.norm(aside)
    y = replace(cell, base=base).predict(q + truth.compliance * gravity(cell.robot, q))
    spread = truth.noise + truth.noise_per_metre * np.linalg.norm(y, axis=-1, keepdims=True)
    return measurements(q, y + spread * rng.normal(size=y.shape))


def shifted(cell: Cell, joint: int, by: float) -> Cell:
    """An arm with the zero of a joint, counted from 0, shifted [rad]."""
    mdh = cell.robot.mdh.copy()
    mdh[joint, kinematics.THETA] += by
    return replace(cell, robot=cell.robot.with_mdh(mdh))


def run(trial: Trial) -> Result:
    """One calibration, and two checks of it."""
    robot, truth = load_robot(trial.arm), Truth(compliance=trial.compliance)
    made = simulate(robot, CALIBRATED, 3, trial.seed, truth)
    fit = calibrate(robot, made.data, "sum")
    rng = np.random.default_rng([trial.seed, 1])
    joint = 1 + trial.seed % (robot.joints - 2)
    q = random_poses(robot, POSES, rng, truth.span)
    as_it_was, knocked = (
        check(fit, seen_anew(shifted(made.cell, joint, by), q, truth, rng), "rms 0.2")
        for by in (0.0, SHIFT)
    )
    worst = max(as_it_was.findable.values())
    return Result(
        joint=f"J{joint + 1}",
        alarms=tuple(m.joint for m in as_it_was.moved),
        named=tuple(m.joint for m in knocked.moved),
        hidden=tuple(h.parameter for h in as_it_was.hidden),
        smallest=1e3 * worst,
        enough=as_it_was.enough or as_it_was.asked or 0,
    )


def trials(study: Study, count: int) -> list[Trial]:
    """So many of each arm, with and without the law that the model lacks."""
    return [
        Trial(arm, study.seed + number, compliance)
        for _, compliance in KINDS
        for arm in ARMS
        for number in range(count)
    ]


def row_of(arm: str, kind: str, results: Sequence[Result]) -> tuple[TableCell, ...]:
    """Rates [%] of an arm."""
    found = [result.joint in result.named for result in results]
    others = [bool(set(result.named) - {result.joint}) for result in results]
    alarms = [bool(result.alarms) for result in results]
    both = [{"theta1"} <= set(result.hidden) for result in results]
    rates = (100.0 * float(np.mean(part)) for part in (found, others, alarms, both))
    smallest = float(np.median([result.smallest for result in results]))
    enough = float(np.median([result.enough for result in results]))
    return (arm, kind, len(results), *rates, smallest, enough)


@click.command()
@study_options("watch")
@click.option("--trials", "count", type=int, default=100, show_default=True)
def main(study: Study, count: int) -> None:
    """Rates at which a check finds a shifted joint, and at which it cries wolf."""
    count = 2 if study.quick else count
    jobs = trials(study, count)
    results = study.sweep(run, jobs, "checks")
    rows = []
    for kind, compliance in KINDS:
        for arm in (*ARMS, "all"):
            chosen = [
                result
                for job, result in zip(jobs, results, strict=True)
                if job.compliance == compliance and arm in (job.arm, "all")
            ]
            rows.append(row_of(arm, kind, chosen))
    table = Table(
        f"a joint of 2 ... n-1 shifted by {1e3 * SHIFT:g} mrad, tracker moved, {POSES} poses",
        ("arm", "model", "arms", "found %", "another named too %", "false alarms %",
         "J1 reported as hidden %", "smallest found mrad", "poses enough"),
        tuple(rows),
        ("", "", "d", ".1f", ".1f", ".2f", ".1f", ".3f", ".0f"),
    )  # fmt: skip
    names = ("arm", "model", "arms", "found_percent", "another_percent", "false_percent",
             "hidden_percent", "smallest_mrad", "poses_enough")  # fmt: skip
    study.save([table], {"rows": [dict(zip(names, row, strict=True)) for row in table.rows]})


if __name__ == "__main__":
    sweep.start(__file__)
