"""How many poses reach a required sigma: planning in a loop, one plan at the start, random poses.

    python -m experiments.measuring_loop [--quick] [--out FOLDER] [--json FILE] [--seed N] ...

Both papers describe the cell: the robot goes to a pose, the tracker measures, the robot goes on.
Here what was measured decides where it goes next: a few planned poses on the nominal arm, a fit,
the next few planned in addition, and so on until the predicted sigma of a position over
the workspace is as asked for.  Against it: one plan on the nominal arm, as large as its own promise
says; and random poses of the same candidates.  An IRB 2600 with errors that the plan does not know,
reflectors seen within 30 degrees, the flange in a box of one metre.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click
import numpy as np

from experiments import sweep
from experiments.planning import BOX, ROBOT, TRUTH, measured, silent
from experiments.sweep import Study, study_options
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.files import plain
from minimax_cal.ground.tables import Cell as TableCell
from minimax_cal.ground.tables import Table
from minimax_cal.modelling.cell import Cell
from minimax_cal.planning.candidates import Poses, candidates, free_poses
from minimax_cal.planning.designs.criteria import Trace, size_of
from minimax_cal.planning.options import PlanOptions
from minimax_cal.planning.plan import refined
from minimax_cal.planning.prospect import Instrument, prospect
from minimax_cal.planning.setting import ground_of, surroundings
from minimax_cal.planning.task import Task, task_of
from minimax_cal.reporting.plots.figures import AFTER, BEFORE
from minimax_cal.robots.robot import load_robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIRST, MORE, MOST = 8, 4, 120  # poses of the first plan, of each next one, and at most
FRESH = 500  # workspace poses that judge
WAYS = ("loop", "one plan", "random")


@dataclass(frozen=True)
class Job:
    """One true arm.  goal: sigma of a position asked for [m].  orders: random ones."""

    seed: int
    goal: float
    candidates: int
    orders: int


@dataclass(frozen=True, eq=False)
class Course:
    """One way of measuring: after so many poses, the promise and the true RMS error [m]."""

    poses: tuple[int, ...]
    promise: tuple[float, ...]
    error: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Found:
    """The courses of one arm; several random ones."""

    loop: Course
    once: Course
    random: tuple[Course, ...]


@dataclass(frozen=True, eq=False)
class Arm:
    """A true arm in its cell, the poses that judge, and the task as planned without any fit."""

    real: Cell
    task: Task
    found: Poses
    fresh: Array
    rng: np.random.Generator

    def fit(self, q: Array, seen: Array) -> Fit:
        """Measure some poses and calibrate."""
        data = measured(self.task, self.real, q, seen, 0.0, self.rng)
        return calibrate(self.task.ground.cell.robot, data, "sum", holdout=0.0)

    def judged(self, fit: Fit, q: Array, seen: Array) -> tuple[float, float]:
        """The promise of a fit from poses, and its true RMS error at the fresh poses [m]."""
        ahead = prospect(fit.cell, self.task.ground.instrument, q, seen)
        b = ahead.predictions(self.fresh)
        mean = Trace(np.einsum("wri,wrj->ij", b, b) / len(b))
        promise = float(np.sqrt(size_of(mean, ahead.known(fit.data))))
        error = np.linalg.norm(fit.predict(self.fresh) - self.real.predict(self.fresh), axis=-1)
        return promise, float(rms(error))


def options_of(job: Job) -> PlanOptions:
    """What a plan is told: the cell and the noise."""
    noise = Instrument()
    return PlanOptions(
        volume=BOX, candidates=job.candidates, seed=job.seed, noise=noise.noise,
        per_metre=noise.per_metre, jitter=noise.jitter,
    )  # fmt: skip


def task_for(job: Job, fit: Fit | None) -> tuple[Task, Poses]:
    """What is to be planned, beside the poses of a fit if there is one."""
    options, robot = options_of(job), load_robot(ROBOT)
    ground = ground_of(robot, "" if fit is None else fit, "", options)
    room, sight, _ = surroundings(ground.cell, options)
    found = candidates(room, sight, options.candidates, options.seed)
    return task_of(robot, ground, room, sight, found, options), found


def arm_of(job: Job) -> Arm:
    """A true arm, off its drawing."""
    task, found = task_for(job, None)
    rng = np.random.default_rng([job.seed, 5])
    cell = task.ground.cell
    off = rng.normal(size=cell.robot.mdh.shape) * ([TRUTH.length] * 2 + [TRUTH.angle] * 3)
    robot = cell.robot.with_mdh(cell.robot.mdh + off)
    real = Cell(robot, cell.base, cell.target_names, cell.target_positions)
    return Arm(real, task, found, free_poses(task.room, FRESH, 2_000_003 + job.seed), rng)


def chosen(task: Task, found: Poses, count: int) -> tuple[Array, Array]:
    """The poses that `plan` chooses before it proves how good they are, and what is seen there."""
    found, rows = refined(task, found, count, silent)
    return found.q[rows], found.seen[rows]


def loop(job: Job, arm: Arm) -> Course:
    """Measure a few, fit, plan the next few, until the promise is met."""
    q, seen = chosen(arm.task, arm.found, FIRST)
    counts, course = [], []
    while True:
        fit = arm.fit(q, seen)
        counts.append(len(q))
        course.append(arm.judged(fit, q, seen))
        if course[-1][0] <= job.goal or len(q) >= MOST:
            return Course(tuple(counts), *zip(*course, strict=True))
        more, sight = chosen(*task_for(job, fit), MORE)
        q, seen = np.concatenate([q, more]), np.concatenate([seen, sight])


def once(job: Job, arm: Arm) -> Course:
    """One plan on the nominal arm, as large as its promise says; then measured and judged."""
    count = FIRST
    while True:
        found, rows = refined(arm.task, arm.found, count, silent)
        menu, criterion = arm.task.aim(found)
        if np.sqrt(size_of(criterion, menu.of(rows))) <= job.goal or count >= MOST:
            break
        count += MORE
    q, seen = found.q[rows], found.seen[rows]
    promise, error = arm.judged(arm.fit(q, seen), q, seen)
    return Course((count,), (promise,), (error,))


def random(job: Job, arm: Arm) -> Course:
    """Random poses, a few more at a time, until the promise is met."""
    order = arm.rng.permutation(arm.found.drawn)
    counts, course = [], []
    for count in range(FIRST + MORE, MOST + 1, MORE):
        q, seen = arm.found.q[order[:count]], arm.found.seen[order[:count]]
        counts.append(count)
        course.append(arm.judged(arm.fit(q, seen), q, seen))
        if course[-1][0] <= job.goal:
            break
    return Course(tuple(counts), *zip(*course, strict=True))


def run(job: Job) -> Found:
    """All three ways on one arm."""
    arm = arm_of(job)
    return Found(loop(job, arm), once(job, arm), tuple(random(job, arm) for _ in range(job.orders)))


def jobs_of(study: Study) -> list[Job]:
    """The arms."""
    if study.quick:
        return [Job(study.seed, 45e-6, 150, 2)]
    return [Job(study.seed + number, 30e-6, 400, 5) for number in range(3)]


def study_of(study: Study) -> dict[Job, Found]:
    """Every arm with its courses."""
    jobs = jobs_of(study)
    return dict(zip(jobs, study.sweep(run, jobs, "measuring loop"), strict=True))


def counts_of(found: Sequence[Found]) -> dict[str, Array]:
    """Poses that each way needed: (arms,), the random ones by their median."""
    return {
        "loop": np.array([f.loop.poses[-1] for f in found]),
        "one plan": np.array([f.once.poses[-1] for f in found]),
        "random": np.array([np.median([c.poses[-1] for c in f.random]) for f in found]),
    }


def table_of(found: dict[Job, Found]) -> Table:
    """Poses, promise and truth at the end of each way."""
    rows: list[tuple[TableCell, ...]] = []
    for job, each in found.items():
        for way, courses in zip(WAYS, ((each.loop,), (each.once,), each.random), strict=True):
            ends = [(c.poses[-1], c.promise[-1], c.error[-1]) for c in courses]
            poses, promise, error = np.median(np.array(ends), axis=0)
            rows.append((job.seed, way, float(poses), 1e6 * float(promise), 1e6 * float(error)))
    goals = ", ".join(f"{1e6 * goal:g}" for goal in sorted({job.goal for job in found}))
    return Table(
        f"poses until the predicted sigma of a position is {goals} um (random: medians)",
        ("arm", "way", "poses", "promised sigma um", "true RMS um"),
        tuple(rows),
        ("d", "", ".0f", ".1f", ".1f"),
    )


def saving_table(found: dict[Job, Found]) -> Table:
    """What the loop saves."""
    counts = counts_of(list(found.values()))
    rows = tuple(
        (way, float(np.median(counts["loop"])), float(np.median(counts[way])),
         100.0 * (1.0 - float(np.median(counts["loop"] / counts[way]))))
        for way in WAYS[1:]
    )  # fmt: skip
    return Table(
        "poses that the loop saves (medians over arms)",
        ("against", "loop", "poses", "saved %"),
        rows,
        ("", ".0f", ".0f", ".0f"),
    )


def picture(found: dict[Job, Found]) -> Figure:
    """The promise against the number of poses."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    for number, (job, each) in enumerate(found.items()):
        labels = ("random", "loop", "one plan", "asked for") if number == 0 else (None,) * 4
        for again, course in enumerate(each.random):
            axes.plot(course.poses, 1e6 * np.array(course.promise), color=BEFORE, alpha=0.3,
                      label=labels[0] if again == 0 else None)  # fmt: skip
        axes.plot(each.loop.poses, 1e6 * np.array(each.loop.promise), color=AFTER, marker="o",
                  ms=3, label=labels[1])  # fmt: skip
        axes.plot(each.once.poses, 1e6 * np.array(each.once.promise), "k^", ms=5, label=labels[2])
        axes.axhline(1e6 * job.goal, color="0.5", ls=":", label=labels[3])
    axes.set(xlabel="poses", ylabel="predicted sigma of a position (µm)", yscale="log")
    axes.grid(visible=True, alpha=0.3)
    axes.legend(frameon=False)
    return figure


def save(study: Study, found: dict[Job, Found]) -> None:
    """Tables and picture."""
    tables = [table_of(found), saving_table(found)]
    content = {
        "saved": plain([dict(zip(tables[1].header, r, strict=True)) for r in tables[1].rows])
    }
    study.save(tables, content, {"measuring_loop": picture(found)})


@click.command()
@study_options("measuring_loop")
def main(study: Study) -> None:
    """Measure a few, fit, plan the next: poses saved against one plan and random ones."""
    save(study, study_of(study))


if __name__ == "__main__":
    sweep.start(__file__)
