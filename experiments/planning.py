"""How many random poses are as good as 40 planned ones: predicted, and in real calibrations.

    python -m experiments.planning [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N] ...

An IRB 2600 before a tracker, with three reflectors or one.  Planned and random poses come from the
same poses that the arm can take and the tracker sees: anywhere; with reflectors that are seen from
within 30 degrees of the flange's axis; and besides with the flange in a box of one metre before the
arm.  Both are judged at workspace poses of which the plan knows nothing, by prediction and by
calibrating simulated arms.  What no choice of poses could be better than is computed too.  Last,
measured poses of real arms are chosen from: there the model is not true.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from experiments import sweep
from experiments.real import SHARED
from experiments.sweep import Study, study_options
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.files import plain
from minimax_cal.ground.tables import Cell as TableCell
from minimax_cal.ground.tables import Table
from minimax_cal.judging.saved import evaluate
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.simulate import Truth, gravity
from minimax_cal.planning.candidates import Poses, candidates, free_poses
from minimax_cal.planning.designs.criteria import Largest, Trace, size_of
from minimax_cal.planning.designs.exchange import Menu
from minimax_cal.planning.designs.search import best_design, first_design, worth
from minimax_cal.planning.options import PlanOptions
from minimax_cal.planning.outlook import sigmas
from minimax_cal.planning.plan import refined
from minimax_cal.planning.prospect import Instrument, prospect, with_effects
from minimax_cal.planning.setting import ground_of, surroundings
from minimax_cal.planning.task import CRITERIA, Task, task_of
from minimax_cal.reporting.plots.figures import AFTER, BEFORE
from minimax_cal.robots.robot import load_robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REAL = ("irb120", "ur10_b")
FEW, SETS, SPLITS = 40, 7, 2  # poses of a first fit of a real arm; random sets; divisions
ROBOT, POSES = "irb2600", 40
COUNTS = (40, 60, 80, 100, 120)  # of random poses
FRESH, DRAWS = 1000, 60  # workspace poses that judge; random sets of which the median is told
BOX = ((0.7, -0.5, 0.3), (1.7, 0.5, 1.3))  # corners [m]
SETTINGS = {
    "anywhere": PlanOptions(acceptance=np.pi),
    "30 deg cone": PlanOptions(),
    "cone, 1 m box": PlanOptions(volume=BOX),
}
CLOSE, MANY = ("cone, 1 m box", "I"), 120  # a few percent decide there: more arms are simulated
TRUTH = Truth()
COMPLIANCE = ("joint_compliance:all",)
ARMS: dict[str, tuple[float, tuple[str, ...], int]] = {
    # what is wrong with the arm: compliance [rad/(N m)], effects fitted, arms at most
    "geometry": (0.0, (), 1000),
    "compliance, not fitted": (TRUTH.compliance, (), 12),
    "compliance, fitted": (TRUTH.compliance, COMPLIANCE, 12),
}


def silent(message: str) -> None:
    """Say nothing."""


@dataclass(frozen=True)
class Job:
    """One plan.  trials: simulated arms that are calibrated.  effects: planned for as unknown."""

    setting: str
    targets: int
    criterion: str
    seed: int
    candidates: int
    trials: int
    effects: tuple[str, ...] = ()

    @property
    def row(self) -> tuple[str, int, str]:
        """What the tables tell apart."""
        return self.setting, self.targets, self.criterion + (", compliance" if self.effects else "")


@dataclass(frozen=True, eq=False)
class Result:
    """Of one plan, judged at fresh workspace poses.

    planned: root mean and largest predicted variance [m].  random: (counts, 2) of random sets,
    median.  worth, most: how many random poses the plan is worth by the mean variance, and any
    choice of as many candidates at most.  worst: by the largest variance.
    errors: by arm, (trials, 3, 2) RMS and largest error of true arms at the fresh poses, calibrated
    from the plan, from as many random poses, and from twice as many [m].
    """

    planned: Array
    random: Array
    worth: float
    most: float
    worst: float
    efficiency: float
    candidates: int
    errors: dict[str, Array]


def task_for(job: Job) -> tuple[Task, Poses]:
    """The task and its candidates."""
    robot = load_robot(ROBOT)
    options = replace(
        SETTINGS[job.setting],
        criterion=job.criterion,
        effects=job.effects,
        targets=job.targets,
        candidates=job.candidates,
        seed=job.seed,
    )
    ground = ground_of(robot, "", "", options)
    room, sight, _ = surroundings(ground.cell, options)
    found = candidates(room, sight, job.candidates, job.seed)
    return task_of(robot, ground, room, sight, found, options), found


def run(job: Job) -> Result:
    """Plan, predict, and calibrate."""
    task, found = task_for(job)
    found, first = refined(task, found, POSES, silent)
    menu, criterion = task.aim(found)
    best = best_design(menu, criterion, first, silent)
    fresh = free_poses(task.room, FRESH, 1_000_003 + job.seed)
    b = task.ahead.predictions(fresh)
    mean, largest = Trace(np.einsum("wri,wrj->ij", b, b) / len(b)), Largest(b.swapaxes(1, 2) @ b)
    squares = largest.weights.reshape(len(b), -1)
    some = menu.take(np.arange(found.drawn))
    rng = np.random.default_rng(job.seed)
    random = [
        np.median(sigmas(some, drawn(rng, found.drawn, count), squares), axis=0) for count in COUNTS
    ]
    info = menu.of(best.design.chosen)
    judge = {"mean": size_of(mean, info), "worst": size_of(largest, info)}
    return Result(
        planned=np.sqrt([judge["mean"], judge["worst"]]),
        random=np.array(random),
        worth=worth(some, mean, POSES, judge["mean"], job.seed),
        # the bound is of the plan's own workspace poses, which the fresh ones resemble
        most=worth(some, criterion, POSES, best.bound, job.seed),
        worst=worth(some, largest, POSES, judge["worst"], job.seed),
        efficiency=best.bound / best.design.size,
        candidates=len(found.q),
        errors={
            arm: np.array(
                [
                    trial(task, found, best.design.chosen, fresh, arm, number)
                    for number in range(min(job.trials, ARMS[arm][2]))
                ]
            ).reshape(-1, 3, 2)
            for arm in (ARMS if job.criterion == "I" else ("geometry",))
        },
    )


def drawn(rng: np.random.Generator, menu: int, count: int) -> list[Array]:
    """Random sets of different candidates, where there are enough."""
    return [rng.choice(menu, min(count, menu), replace=False) for _ in range(DRAWS)]


# ---- calibrations ------------------------------------------------------------------------------


def trial(
    task: Task, found: Poses, planned: Array, fresh: Array, arm: str, number: int
) -> list[tuple[float, float]]:
    """RMS and largest error at fresh poses of one true arm, calibrated from three sets [m]."""
    compliance, effects, _ = ARMS[arm]
    rng = np.random.default_rng([task.options.seed, number])
    cell = task.ground.cell
    n = cell.robot.joints
    off = rng.normal(size=(n, 5)) * ([TRUTH.length] * 2 + [TRUTH.angle] * 3)
    real = Cell(
        cell.robot.with_mdh(cell.robot.mdh + off),
        cell.base,
        cell.target_names,
        cell.target_positions,
    )
    random = (rng.choice(found.drawn, count, replace=False) for count in (POSES, 2 * POSES))
    truth = real.predict(bent(real, fresh, compliance))
    out = []
    for chosen in (planned, *random):
        data = measured(task, real, found.q[chosen], found.seen[chosen], compliance, rng)
        fit = calibrate(cell.robot, data, "sum", holdout=0.0, effects=effects)
        error = np.linalg.norm(fit.predict(fresh) - truth, axis=-1)
        out.append((float(np.sqrt(np.mean(error**2))), float(error.max())))
    return out


def bent(real: Cell, q: Array, compliance: float) -> Array:
    """Joint values once gravity has turned the joints."""
    return np.asarray(q + compliance * gravity(real.robot, q))


def measured(
    task: Task, real: Cell, q: Array, seen: Array, compliance: float, rng: np.random.Generator
) -> Measurements:
    """What the tracker measures, with the noise that was planned for."""
    noise = task.ground.instrument
    stopped = bent(real, q, compliance) + noise.jitter * rng.normal(size=q.shape)
    y = real.predict(stopped)
    spread = noise.noise + noise.per_metre * np.linalg.norm(y, axis=-1, keepdims=True)
    y = np.where(seen[..., None], y + spread * rng.normal(size=y.shape), np.nan)
    lines = np.arange(len(q)) + 1
    return Measurements(
        q, y, real.target_names, real.robot.prismatic, lines, {}, source="simulated"
    )


# ---- poses that were measured ------------------------------------------------------------------


@dataclass(frozen=True)
class Real:
    """Some of the measured poses of a real arm, chosen by their information or at random.

    A third of the poses, another one each split, judges.
    """

    arm: str
    poses: int
    effects: tuple[str, ...]
    split: int
    seed: int
    folder: Path


def run_real(job: Real) -> dict[str, float]:
    """RMS on poses that no fit has seen, from the best poses by I and D and from random ones [m].

    What the poses tell is computed from a fit of a few of them, as one would know it beforehand.
    """
    robot = load_robot(job.folder / job.arm / "robot.json")
    data = read_measurements(job.folder / job.arm / "measurements.csv")
    data = data.take(np.asarray(data.seen.all(axis=1)))
    order = np.random.default_rng([job.seed, job.split]).permutation(data.poses)
    third = data.poses // 3
    pool, judge = data.take(order[third:]), data.take(order[:third])
    cell = calibrate(robot, pool.take(np.arange(FEW)), "sum", holdout=0.0).cell
    cell = with_effects(cell, job.effects, pool.q)
    seen = np.ones((pool.poses, len(pool.target_names)), dtype=bool)
    ahead = prospect(cell, Instrument(), pool.q, seen)
    menu = Menu(ahead.ahead(pool.q, seen), np.zeros((len(ahead.scale),) * 2))
    b = ahead.predictions(judge.q)
    rng = np.random.default_rng([job.seed, job.split, 1])

    def error(chosen: Array) -> float:
        fit = calibrate(robot, pool.take(chosen), "sum", holdout=0.0, effects=job.effects)
        return evaluate(fit.cell, judge).rms_mm * 1e-3

    out = {}
    for name in ("I", "D"):
        criterion = CRITERIA[name](ahead, b)
        first = first_design(menu, criterion, job.poses, job.seed)
        best = best_design(menu, criterion, first, silent).design
        out[f"planned by {name}"] = error(best.chosen)
        if name == "I":
            out["predicted worth"] = worth(menu, criterion, job.poses, best.size, job.seed)
    for times in (1, 2):
        sets = [rng.permutation(pool.poses)[: times * job.poses] for _ in range(SETS)]
        out[f"random, {times} times as many"] = float(np.median([error(one) for one in sets]))
    return out


def real_jobs(seed: int, folder: Path) -> list[Real]:
    """The arms whose measurements are there."""
    return [
        Real(arm, poses, effects, split, seed, folder)
        for arm in REAL
        if (folder / arm / "measurements.csv").exists()
        for effects in ((), COMPLIANCE)
        for poses in (POSES // 2, POSES)
        for split in range(SPLITS)
    ]


def real_table(found: dict[Real, dict[str, float]]) -> Table:
    """Held-out errors of real arms, means over splits."""
    rows: list[tuple[TableCell, ...]] = []
    names = ("random, 1 times as many", "planned by I", "planned by D", "random, 2 times as many")
    for key in dict.fromkeys((job.arm, job.effects, job.poses) for job in found):
        results = [r for job, r in found.items() if (job.arm, job.effects, job.poses) == key]
        means = [1e3 * float(np.mean([r[name] for r in results])) for name in names]
        told = middle([r["predicted worth"] for r in results])
        rows.append((key[0], ", ".join(key[1]) or "geometry", key[2], *means, told))
    return Table(
        "real arms: held-out RMS, calibrated from some of the measured poses (means over splits)",
        ("arm", "fitted", "poses", "random mm", "planned by I mm", "planned by D mm",
         "twice as many random mm", "I predicted to be worth random poses"),
        tuple(rows),
        ("", "", "d", ".4f", ".4f", ".4f", ".4f", ".0f"),
    )  # fmt: skip


# ---- tables and figure -------------------------------------------------------------------------

Found = dict[Job, Result]


def of(found: Found, setting: str, targets: int, criterion: str) -> list[Result]:
    """The results of one row, a seed each."""
    return [r for job, r in found.items() if job.row == (setting, targets, criterion)]


def middle(values: Sequence[float]) -> float:
    """Median over seeds."""
    return float(np.median(values))


def rows_of(found: Found) -> list[tuple[str, int, str]]:
    """Setting, targets and criterion, as planned."""
    return list(dict.fromkeys(job.row for job in found))


def predicted_table(found: Found) -> Table:
    """Predicted sigma at fresh poses."""
    rows: list[tuple[TableCell, ...]] = []
    for setting, targets, criterion in rows_of(found):
        results = of(found, setting, targets, criterion)
        sigma = [middle([1e6 * r.planned[i] for r in results]) for i in (0, 1)]
        random = np.median([1e6 * r.random for r in results], axis=0)
        twice = COUNTS.index(2 * POSES)
        rows.append(
            (
                setting,
                targets,
                criterion,
                len(results),
                sigma[0],
                float(random[0, 0]),
                float(random[twice, 0]),
                middle([r.worth for r in results]),
                min(r.worth for r in results),
                middle([r.most for r in results]) if criterion[0] == "I" else np.nan,
                sigma[1],
                float(random[0, 1]),
                float(random[twice, 1]),
                middle([r.worst for r in results]),
                100.0 * min(r.efficiency for r in results),
            )
        )
    return Table(
        f"predicted sigma of a position at {FRESH} fresh workspace poses, {POSES} planned poses "
        "against random ones of the same candidates (medians over seeds)",
        ("poses that can be measured", "targets", "criterion", "seeds", "mean um, 40 planned",
         "mean, 40 random", "mean, 80 random", "worth random poses", "least of the seeds",
         "no choice is worth more than", "worst um, 40 planned", "worst, 40 random",
         "worst, 80 random", "worth by the worst", "efficiency at least %"),
        tuple(rows),
        ("", "d", "", "d", ".2f", ".2f", ".2f", ".0f", ".0f", ".0f", ".2f", ".2f", ".2f", ".0f",
         ".1f"),
    )  # fmt: skip


def simulated_table(found: Found) -> Table:
    """True errors at fresh poses of simulated arms."""
    rows: list[tuple[TableCell, ...]] = []
    for setting, targets, criterion in rows_of(found):
        for arm in ARMS:
            parts = [r.errors[arm] for r in of(found, setting, targets, criterion)
                     if len(r.errors.get(arm, ()))]  # fmt: skip
            if not parts:
                continue
            errors = np.concatenate(parts)
            rms = 1e6 * np.sqrt((errors[..., 0] ** 2).mean(axis=0))
            worst = 1e6 * np.median(errors[..., 1], axis=0)
            beaten = 100.0 * (errors[:, :1] < errors[:, 1:]).mean(axis=0)
            rows.append(
                (
                    setting, targets, criterion, arm, len(errors), *map(float, rms),
                    float(rms[0] / rms[2]), float(beaten[1, 0]), *map(float, worst),
                    float(worst[0] / worst[2]),
                )
            )  # fmt: skip
    return Table(
        f"true errors of simulated arms at {FRESH} fresh workspace poses, calibrated from "
        f"{POSES} planned, {POSES} random and {2 * POSES} random poses",
        ("poses that can be measured", "targets", "criterion", "arm's errors", "arms",
         "RMS um, 40 planned", "RMS, 40 random", "RMS, 80 random", "RMS, planned / 80 random",
         "planned beats 80 random %", "largest um (median), 40 planned", "largest, 40 random",
         "largest, 80 random", "largest, planned / 80 random"),
        tuple(rows),
        ("", "d", "", "", "d", ".1f", ".1f", ".1f", ".3f", ".0f", ".1f", ".1f", ".1f", ".3f"),
    )  # fmt: skip


def picture(found: Found) -> Figure:
    """Random sets by their number, and the plan as a line across: where they meet it is worth."""
    from matplotlib.figure import Figure

    settings = list(dict.fromkeys(job.setting for job in found))
    figure = Figure(figsize=(4.2 * len(settings), 3.8), layout="constrained")
    panels = figure.subplots(1, len(settings), squeeze=False)[0]
    for axes, setting in zip(panels, settings, strict=True):
        for targets, style in ((3, "-"), (1, "--")):
            results = of(found, setting, targets, "I")
            if not results:
                continue
            random = np.median([1e6 * r.random[:, 0] for r in results], axis=0)
            planned = middle([1e6 * r.planned[0] for r in results])
            word = "targets" if targets > 1 else "target"
            axes.plot(COUNTS, random, style, marker="o", ms=4, color=BEFORE,
                      label=f"random, {targets} {word}")  # fmt: skip
            axes.plot(COUNTS, [planned] * len(COUNTS), style, color=AFTER,
                      label=f"{POSES} planned, {targets} {word}")  # fmt: skip
        axes.set(title=setting, xlabel="random poses", ylim=(0.0, None))
        axes.grid(visible=True, alpha=0.3)
    panels[0].set(ylabel="predicted sigma of a position (µm)")
    panels[0].legend(frameon=False, fontsize="small")
    return figure


# ---- the study ---------------------------------------------------------------------------------


def jobs_of(quick: bool, seed: int) -> list[Job]:
    """Every plan of the study."""
    if quick:
        plain = [("anywhere", 1), ("cone, 1 m box", 3)]
        return [Job(setting, targets, "I", seed, 500, 4) for setting, targets in plain]
    seeds = range(seed, seed + 3)
    out = [
        Job(setting, targets, criterion, s, 2000, MANY if (setting, criterion) == CLOSE else 24)
        for targets in (3, 1)
        for setting in SETTINGS
        for criterion, count in (("I", 3), ("G", 2))
        for s in seeds[:count]
    ]
    others = [name for name in CRITERIA if name not in ("I", "G")]
    for setting in ("anywhere", "cone, 1 m box"):
        out += [Job(setting, 3, "I", s, 2000, 24, COMPLIANCE) for s in seeds[:2]]
    return out + [Job("30 deg cone", 3, name, seed, 2000, 0) for name in others]


def study(
    quick: bool,
    seed: int,
    run_all: Callable[[Callable[[Job], Result], Sequence[Job]], list[Result]],
) -> Found:
    """All plans with their results."""
    jobs = jobs_of(quick, seed)
    return dict(zip(jobs, run_all(run, jobs), strict=True))


@click.command()
@study_options("planning")
@click.option("--data", "folder", type=click.Path(path_type=Path), default=SHARED)
def main(options: Study, folder: Path) -> None:
    """Planned poses against random ones."""

    def run_all(function: Callable[[Job], Result], jobs: Sequence[Job]) -> list[Result]:
        return options.sweep(function, jobs, "plans")

    found = study(options.quick, options.seed, run_all)
    tables = [predicted_table(found), simulated_table(found)]
    waiting = [] if options.quick else real_jobs(options.seed, folder)
    if waiting:
        results = options.sweep(run_real, waiting, "real arms")
        tables.append(real_table(dict(zip(waiting, results, strict=True))))
    content: dict[str, object] = {
        name: plain([dict(zip(table.header, row, strict=True)) for row in table.rows])
        for name, table in zip(("predicted", "simulated", "real"), tables, strict=False)
    }
    options.save(tables, content, {"planning": picture(found)}, ("cvxpy", "scs", "matplotlib"))


if __name__ == "__main__":
    sweep.start(__file__)
