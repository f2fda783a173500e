"""Random arms, grossly misdrawn: does a calibration reach the noise whatever the arm is?

    python -m experiments random_arms [--quick] [--out FOLDER] [--json FILE] [--seed N] ...

Six and seven axes, SCARAs, arms with two coaxial neighbours; the tracker anywhere, turned anyhow;
every angle that shows off by up to 0.5 rad, every length by up to 2 mm; three targets.  A fit is at
the noise where its held-out RMS is within 30 % of it (20 poses tell the noise to 9 %).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import click
import numpy as np
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments import sweep
from experiments.sweep import Study, study_options
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.measurements import measurements
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot, robot_from_dict

KINDS = ("six axes", "seven axes", "SCARA", "coaxial neighbours")
NOISE = 5e-5  # of a point [m]
POSES = 100
OFF, LONGER = 0.5, 2e-3  # errors of angles [rad] and lengths [m]
AT_NOISE = 1.3
ARMS = {True: 5, False: 75}  # of each kind, quick and full


@dataclass(frozen=True)
class Job:
    """An arm to draw."""

    kind: str
    seed: int


@dataclass(frozen=True)
class End:
    """How its calibration ended.  rms_mm: held out.  parameters: identified."""

    status: str
    rms_mm: float
    parameters: int


def drawn(job: Job) -> Robot:
    """A robot of a kind as its drawing has it."""
    rng = np.random.default_rng([KINDS.index(job.kind), job.seed])
    n = {"six axes": 6, "seven axes": 7, "SCARA": 4}.get(job.kind, 6)
    types = ["revolute"] * n
    if job.kind == "SCARA":
        a, alpha = np.array([*rng.uniform(0.2, 0.5, 2), 0.0, 0.0]), np.array([0.0, np.pi, 0.0, 0.0])
        d = np.array([rng.uniform(0.2, 0.5), 0.0, 0.0, rng.uniform(0.0, 0.1)])
        types[2] = "prismatic"
    else:
        a, d, alpha = links(rng, n)
        if job.kind == "coaxial neighbours":
            i = int(rng.integers(0, n - 1))
            a[i], alpha[i] = 0.0, 0.0
    joints = [
        {
            "a": 1e3 * float(a[i]), "d": 1e3 * float(d[i]), "theta": 0.0, "alpha": float(alpha[i]),
            "beta": 0.0, "type": kind,
            **({"lower": 0.0, "upper": 300.0} if kind == "prismatic" else {"lower": -2.6,
                                                                           "upper": 2.6}),
        }
        for i, kind in enumerate(types)
    ]  # fmt: skip
    name, units = f"{job.kind} {job.seed}", {"length": "mm", "angle": "rad"}
    return robot_from_dict({"name": name, "units": units, "joints": joints}, name)


def links(rng: np.random.Generator, n: int) -> tuple[Array, Array, Array]:
    """a, d and alpha (n,) of a chain whose axes are parallel or at right angles [m, rad]."""
    alpha = rng.choice([0.0, np.pi / 2, -np.pi / 2], size=n, p=[0.3, 0.35, 0.35])
    alpha[-1] = 0.0
    a = np.where(rng.random(n) < 0.5, rng.uniform(0.05, 0.6, n), 0.0)
    a = np.where((alpha == 0.0) & (a < 0.1), rng.uniform(0.2, 0.6, n), a)
    d = np.where(rng.random(n) < 0.5, rng.uniform(0.1, 0.5, n), 0.0)
    return a, d, alpha


def measured(job: Job, robot: Robot) -> mc.Measurements:
    """What a tracker sees of the real arm."""
    rng = np.random.default_rng([KINDS.index(job.kind), job.seed, 1])
    q = rng.uniform(robot.lower, robot.upper, size=(POSES, robot.joints))
    mdh = robot.mdh.copy()
    mdh[:, :2] += rng.uniform(-LONGER, LONGER, size=(robot.joints, 2))
    mdh[:, 2:4] += rng.uniform(-OFF, OFF, size=(robot.joints, 2))
    spots = 0.1 * np.eye(3) + rng.normal(scale=0.02, size=(3, 3))
    flange = kinematics.forward(mdh, robot.sign * q, robot.prismatic)
    turn, move = Rotation.random(rng=rng).as_matrix(), rng.uniform(-3.0, 3.0, size=3)
    points = np.einsum("mij,kj->mki", flange[:, :3, :3], spots) + flange[:, None, :3, 3]
    y = points @ turn.T + move + rng.normal(scale=NOISE / np.sqrt(3.0), size=points.shape)
    return replace(measurements(q, y), sliding=robot.prismatic)


def end_of(job: Job) -> End:
    """One calibration."""
    robot = drawn(job)
    fit = mc.calibrate(robot, measured(job, robot), "sum", holdout=0.2, allow_large_changes=True)
    known = sum(p.identifiable for p in fit.parameters)
    return End(str(fit.status), fit.accuracy["holdout"].rms_mm, known)


def at_noise(end: End) -> bool:
    """Whether a calibration reached the noise."""
    return end.status == "converged" and end.rms_mm <= 1e3 * AT_NOISE * NOISE


def study_of(study: Study) -> dict[Job, End]:
    """All arms."""
    jobs = [Job(kind, study.seed + i) for kind in KINDS for i in range(ARMS[study.quick])]
    return dict(zip(jobs, study.sweep(end_of, jobs), strict=True))


def tables(found: dict[Job, End]) -> list[Table]:
    """By kind of arm, and the arms that did not get there."""
    rows = []
    for kind in KINDS:
        ends = [end for job, end in found.items() if job.kind == kind]
        there = sum(map(at_noise, ends))
        rms = [end.rms_mm for end in ends]
        rows.append((kind, len(ends), there, float(np.median(rms)), max(rms)))
    missed = tuple(
        (job.kind, job.seed, end.status, end.rms_mm)
        for job, end in found.items()
        if not at_noise(end)
    )
    return [
        Table(
            f"random arms, angles off by up to {OFF:g} rad; noise {1e3 * NOISE:g} mm",
            ("kind", "arms", "at the noise", "median RMS mm", "largest RMS mm"),
            tuple(rows),
            ("", "d", "d", ".4f", ".4f"),
        ),
        Table(
            "not at the noise", ("kind", "seed", "status", "RMS mm"), missed, ("", "d", "", ".4f")
        ),
    ]


def count(ends: Sequence[End]) -> int:
    """How many reached the noise."""
    return sum(map(at_noise, ends))


@click.command()
@study_options("random_arms")
def main(study: Study) -> None:
    """Random arms with gross errors in every angle."""
    found = study_of(study)
    content = {"arms": len(found), "at_noise": count(list(found.values()))}
    study.save([table for table in tables(found) if table.rows], content)


if __name__ == "__main__":
    sweep.start(__file__)
