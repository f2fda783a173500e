"""Do 95 % intervals hold the truth 95 times in a hundred?  Simulated measurement runs.

    python -m experiments.coverage [--quick] [--runs N] [--out FOLDER] [--json FILE] [--seed N] ...

One arm of each case is measured again and again: new poses, tracker noise that grows with range,
joints that stop a little off.  Each run is calibrated, and its intervals for parameters and for
predicted positions are held against the arm; those of its held-out accuracy against 2000 further
poses.  Cases with model error (compliance) ask for the best fit, which plenty of poses would give.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import click
import numpy as np
from scipy import stats

import minimax_cal as mc
from experiments.record import canvas
from experiments.sweep import Study, study_options
from minimax_cal.fitting.accuracy import chance_of_larger, max_interval, rms_interval
from minimax_cal.fitting.options import Objective, Options, silent
from minimax_cal.fitting.solve import Solved, fit_cell
from minimax_cal.fitting.uncertainty import (
    Poses,
    Uncertainty,
    by_noise,
    position_factor,
    quantile,
)
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.tables import Table
from minimax_cal.judging.bootstrap import bootstrap
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.simulate import Truth, gravity, simulate
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.sampling import random_poses

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVEL = 0.95
BAND = 0.999  # of the binomial law: one parameter in a thousand lies outside by chance
POOLED = (0.92, 0.98)
PLENTY, WORKSPACE, FURTHER = 1000, 200, 2000  # poses that tell an arm, to predict, to judge by
HELD = (10, 20, 50)
BATCH = 20  # runs a job
KINDS = ("poses", "noise")  # what sigma comes from: see `uncertainty`
QUESTIONS = ("position, instrument's frame", "position, base frame", "new pose with jitter")


@dataclass(frozen=True)
class Case:
    """Measurement runs of one arm.  compliance: see `simulate.Truth`.  jitter: of a joint [rad].

    asked: whether this case has to meet the criterion.  share: of the runs asked for.
    """

    name: str
    robot: str
    targets: int
    poses: int
    objective: Objective = "sum"
    compliance: float = 0.0
    jitter: float = 10e-6
    asked: bool = False
    share: float = 1.0


CASES = (
    Case("IRB 2600", "irb2600", 3, 80, asked=True),
    Case("UR10", "ur10", 1, 80, asked=True),
    Case("IRB 2600, compliant", "irb2600", 3, 80, compliance=3e-7),
    Case("UR10, compliant", "ur10", 1, 80, compliance=3e-7),
    Case("IRB 2600, 16 poses", "irb2600", 3, 16, share=0.5),
    Case("UR10, 20 poses", "ur10", 1, 20, share=0.5),
    Case("IRB 2600, minimax", "irb2600", 3, 80, "minimax", share=0.25),
    Case("IRB 2600, pose", "irb2600", 3, 80, "pose", share=0.25),
    Case("IRB 2600, smr:2", "irb2600", 3, 80, "smr:2", share=0.25),
    Case("IRB 2600, point", "irb2600", 3, 80, "point", share=0.25),
    Case("UR10, point", "ur10", 1, 80, "point", share=0.25),
)
RESAMPLED = ("IRB 2600", "UR10")
LAWS: dict[str, Callable[[Array], Array]] = {  # quantile functions of the squared error of a pose
    "chi-square, 3": lambda u: stats.chi2.ppf(u, 3),
    "chi-square, 1": lambda u: stats.chi2.ppf(u, 1),
    "lognormal, 1": lambda u: stats.lognorm.ppf(u, 1.0),
    "chi-square, 3; one in 20 ninefold": lambda u: np.where(
        u < 0.95, stats.chi2.ppf(np.minimum(u / 0.95, 1.0), 3),
        9.0 * stats.chi2.ppf(np.maximum(u - 0.95, 0.0) / 0.05, 3)),
}  # fmt: skip
MEANS = {name: float(np.mean(law((np.arange(10**5) + 0.5) / 10**5))) for name, law in LAWS.items()}


@dataclass(frozen=True)
class Batch:
    """Some runs of a case.  replicates: of the bootstrap."""

    case: Case
    seed: int
    first: int
    count: int
    replicates: int = 0


@dataclass(frozen=True)
class Draws:
    """Some samples of a law."""

    law: str
    poses: int
    seed: int
    count: int


@dataclass(frozen=True)
class Runs:
    """What some runs gave.

    names: p parameters.  error: (R, p) found minus true [SI].  sigma: (R, 2, p) by KINDS [SI].
    width: (R,) quantile that sigma is multiplied by.  inside: (R, 2, 3) share of coordinates whose
    interval holds the truth, by KINDS and QUESTIONS.  arm: (R,) share of coordinates at which the
    interval of a new pose holds the real arm.  held: (R, sizes, 3) whether the intervals of RMS and
    largest error hold, and whether the next pose is worse than all.  odd: runs left out, since
    their poses identify other parameters.
    """

    names: tuple[str, ...]
    odd: int
    error: Array
    sigma: Array
    width: Array
    inside: Array
    arm: Array
    held: Array


# ---- the arm and its runs ------------------------------------------------------------------------


def arm_of(case: Case, seed: int) -> Cell:
    """The arm in its place, its geometry fixed."""
    return simulate(mc.load_robot(case.robot), 1, case.targets, seed + 7).cell


def bent(arm: Cell, case: Case, q: Array) -> Array:
    """Where the arm's joints really are, jitter left out: (m, n) [rad]."""
    return q + case.compliance * gravity(arm.robot, q)


def measured(
    arm: Cell, case: Case, q: Array, rng: np.random.Generator, *, noisy: bool = True
) -> Measurements:
    """What the tracker sees at poses (m, n)."""
    truth = Truth()
    if not noisy:
        return measurements(q, arm.predict(bent(arm, case, q)))
    y = arm.predict(bent(arm, case, q) + case.jitter * rng.normal(size=q.shape))
    spread = truth.noise + truth.noise_per_metre * np.linalg.norm(y, axis=-1, keepdims=True)
    return measurements(q, y + spread * rng.normal(size=y.shape))


def reference(arm: Cell, case: Case) -> Solved:
    """The fit of plenty of poses without noise: the truth in the parameters that are identified.

    What redundant parameters are off, others absorb; with model error, the best fit.
    """
    rng = np.random.default_rng(0)
    q = random_poses(arm.robot, PLENTY, rng)
    data = measured(arm, case, q, rng, noisy=False)
    return fit_cell(mc.load_robot(case.robot), data, Options(objective="sum"), silent)


def known_by_noise(fit: Solved) -> Uncertainty:
    """The uncertainty of a fit by its noises alone."""
    active = fit.estimator.model.active
    out = np.full((len(active),) * 2, np.nan)
    out[np.ix_(active, active)] = by_noise(Poses(fit.estimator, fit.state), fit.uncertainty.noise)
    told = fit.uncertainty
    return Uncertainty(told.names, told.units, out, told.listen, told.dof, "noise")


def in_base(cell: Cell) -> Cell:
    """The cell seen from its base."""
    return Cell(cell.robot, np.eye(4), cell.target_names, cell.target_positions)


@dataclass(frozen=True, eq=False)
class Subject:
    """The arm of a batch, its drawing, and the arm that plenty of poses tell."""

    arm: Cell
    robot: Robot
    true: Solved
    ideal: Cell

    @staticmethod
    def of(batch: Batch) -> Subject:
        """The same for every batch of a case and seed."""
        arm, robot = arm_of(batch.case, batch.seed), mc.load_robot(batch.case.robot)
        true = reference(arm, batch.case)
        return Subject(arm, robot, true, Cell.of(robot, true.state, arm.target_names))

    def runs(self, batch: Batch) -> Iterator[tuple[int, np.random.Generator, Measurements]]:
        """Number, random numbers and measurements of each run."""
        for number in range(batch.first, batch.first + batch.count):
            rng = np.random.default_rng([batch.seed, number])
            q = random_poses(self.robot, batch.case.poses, rng)
            yield number, rng, measured(self.arm, batch.case, q, rng)


def run(batch: Batch) -> Runs:
    """Calibrate some runs and hold their intervals against the truth."""
    case, one = batch.case, Subject.of(batch)
    true, robot = one.true, one.robot
    active = true.identification.active
    rows = []
    for _, rng, data in one.runs(batch):
        fit = fit_cell(robot, data, Options(objective=case.objective), silent)
        if not np.array_equal(fit.identification.active, active):
            continue
        axes = fit.nominal.rotation
        error = (fit.state.along(axes, robot) - true.state.along(axes, robot))[active]
        told = (fit.uncertainty, known_by_noise(fit))
        cell = Cell.of(robot, fit.state, one.arm.target_names)
        inside = np.array([positions(cell, known, one.ideal, case, rng) for known in told])
        sigma = np.array([known.sigma[active] for known in told])
        whole = whole_arm(cell, told[0], one.arm, case, rng) if case.compliance else inside[0, 2]
        rows.append((error, sigma, quantile(LEVEL, told[0].dof), inside, whole,
                     judged(cell, one.arm, case, rng)))  # fmt: skip
    names = tuple(name for name, on in zip(true.names.all, active, strict=True) if on)
    columns = (np.array(column) for column in zip(*rows, strict=True))
    return Runs(names, batch.count - len(rows), *columns)


def positions(
    cell: Cell, known: Uncertainty, ideal: Cell, case: Case, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Shares of coordinates whose interval holds the truth, by QUESTIONS."""
    q = random_poses(cell.robot, WORKSPACE, rng)
    moved = ideal.predict(q + case.jitter * rng.normal(size=q.shape))
    found, cover = cell.predict(q), partial(position_covariance, cell, known, q)
    off_base = in_base(cell).predict(q) - in_base(ideal).predict(q)
    return (
        inside(found - ideal.predict(q), cover(), known),
        inside(off_base, cover("base"), known),
        inside(found - moved, cover(jitter=True), known),
    )


def whole_arm(
    cell: Cell, known: Uncertainty, arm: Cell, case: Case, rng: np.random.Generator
) -> float:
    """The same at new poses of the real arm, its model error and jitter included."""
    q = random_poses(cell.robot, WORKSPACE, rng)
    real = arm.predict(bent(arm, case, q) + case.jitter * rng.normal(size=q.shape))
    return inside(cell.predict(q) - real, position_covariance(cell, known, q, jitter=True), known)


def position_covariance(
    cell: Cell, known: Uncertainty, q: Array, frame: str = "measurement", *, jitter: bool = False
) -> Array:
    """(m, k, 3, 3) of each target's predicted position [m^2]; arguments as `position_factor`."""
    factor = position_factor(cell, known, q, frame, jitter=jitter)
    return np.asarray(factor @ np.swapaxes(factor, -1, -2))


def inside(error: Array, covariance: Array, known: Uncertainty) -> float:
    """Share of coordinates within their intervals.  error: (m, k, 3), covariance: (m, k, 3, 3)."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    return float(np.mean(np.abs(error) <= quantile(LEVEL, known.dof) * sigma))


def judged(cell: Cell, arm: Cell, case: Case, rng: np.random.Generator) -> Array:
    """(sizes, 3) as `held_out`, for each of HELD."""
    q = random_poses(arm.robot, FURTHER, rng)
    error = cell.error(measured(arm, case, q, rng))
    size = float(np.sqrt((error**2).sum(axis=-1).mean()))
    return np.array([held_out(error, n, size, rng) for n in HELD])


def held_out(error: Array, n: int, rms: float, rng: np.random.Generator) -> tuple[bool, bool, bool]:
    """Whether n poses tell the RMS, the largest of n further ones; and whether one is worse.

    error: (m, k, 3) of many poses, the first n held out, the next n new.
    """
    held, new = error[:n], error[n : 2 * n]
    middle, most = (f(held, level=LEVEL, rng=rng) for f in (rms_interval, max_interval))
    worst = [float(np.linalg.norm(part, axis=-1).max()) for part in (held, new, new[:1])]
    return middle.low <= rms <= middle.high, most.low <= worst[1] <= most.high, worst[2] > worst[0]


def drawn(draws: Draws) -> Array:
    """(R, 3) as `held_out`, of one target whose squared error follows a law."""
    rng = np.random.default_rng(draws.seed)
    rms = float(np.sqrt(MEANS[draws.law]))
    out = []
    for _ in range(draws.count):
        error = np.zeros((2 * draws.poses, 1, 3))
        error[:, 0, 0] = np.sqrt(LAWS[draws.law](rng.uniform(size=2 * draws.poses)))
        out.append(held_out(error, draws.poses, rms, rng))
    return np.array(out)


def resampled(batch: Batch) -> tuple[Array, Array]:
    """(R, p) whether the bootstrap's percentiles hold each parameter; (R,) share of positions."""
    case, one = batch.case, Subject.of(batch)
    place = np.flatnonzero(one.true.identification.active)
    held, share = [], []
    for number, rng, data in one.runs(batch):
        fit = mc.calibrate(one.robot, data, case.objective, holdout=0.0)
        found = bootstrap(fit, batch.replicates, seed=number)
        if not np.array_equal(found.place, place):
            continue
        low, high = found.interval(LEVEL).T
        truth = one.true.state.along(fit.nominal.base[:3, :3], one.robot)[place]
        held.append((low <= truth) & (truth <= high))
        q = random_poses(one.robot, WORKSPACE, rng)
        low, high = found.position_interval(q, LEVEL)
        exact = one.ideal.predict(q)
        share.append(float(np.mean((low <= exact) & (exact <= high))))
    return np.array(held), np.array(share)


# ---- what it comes to ----------------------------------------------------------------------------


def joined(parts: Sequence[Runs]) -> Runs:
    """The runs of one case."""
    fields = ("error", "sigma", "width", "inside", "arm", "held")
    columns = (np.concatenate([getattr(part, name) for part in parts]) for name in fields)
    return Runs(parts[0].names, sum(part.odd for part in parts), *columns)


def coverage(runs: Runs, kind: int) -> Array:
    """(p,) share of runs in which the interval of each parameter holds the truth."""
    width = runs.width[:, None] * runs.sigma[:, kind]
    return np.asarray((np.abs(runs.error) <= width).mean(axis=0))


def band(count: int) -> tuple[float, float]:
    """Where the coverage of an exact 95 % interval lies in so many runs, but once in a thousand."""
    low, high = stats.binom.interval(BAND, count, LEVEL)
    return float(low) / count, float(high) / count


def outside(runs: Runs, kind: int) -> list[str]:
    """Parameters whose coverage is out of the band."""
    low, high = band(len(runs.error))
    share = coverage(runs, kind)
    return [name for name, s in zip(runs.names, share, strict=True) if not low <= s <= high]


def parameters_table(found: dict[str, Runs]) -> Table:
    """Pooled and extreme coverage of the parameters, by case and kind of sigma."""
    rows = []
    for case in CASES:
        runs = found[case.name]
        for kind, name in enumerate(KINDS):
            share = 100.0 * coverage(runs, kind)
            score = runs.error / runs.sigma[:, kind]
            least, most = int(share.argmin()), int(share.argmax())
            out = outside(runs, kind)
            rows.append(
                (case.name, name, len(runs.error), float(share.mean()),
                 float(share[least]), runs.names[least], float(share[most]), runs.names[most],
                 len(out), rms(score))
            )  # fmt: skip
    return Table.made(
        "coverage of 95 % intervals of the identified parameters: value +- Student's quantile "
        "times sigma, sigma by the scatter from pose to pose or by the noises alone",
        rows,
        "case | sigma by | runs d | pooled % .1f | least % .1f | of | most % .1f | of  | "
        "outside 99.9 % band d | RMS error / sigma .3f",
    )


def positions_table(found: dict[str, Runs]) -> Table:
    """Pooled coverage of predicted coordinates."""
    rows = []
    for case in CASES:
        runs = found[case.name]
        for kind, name in enumerate(KINDS):
            mean = 100.0 * runs.inside[:, kind].mean(axis=0)
            spread = 100.0 * runs.inside[:, kind].std(axis=0) / np.sqrt(len(runs.error))
            real = 100.0 * float(runs.arm.mean()) if kind == 0 else float("nan")
            rows.append((case.name, name, len(runs.error), *map(float, mean),
                         float(spread.max()), real))  # fmt: skip
    return Table.made(
        f"coverage of 95 % intervals of predicted coordinates at {WORKSPACE} poses a run.  With "
        "model error the jitter found holds it too: too much for the best fit, all there is for "
        "the real arm (last column: its model error and jitter included)",
        rows,
        "case | sigma by | runs d",
        *(f"{name} % .1f" for name in (*QUESTIONS, "+-", "new pose, real arm")),
    )


def held_table(found: dict[str, Runs], laws: dict[tuple[str, int], Array]) -> Table:
    """Coverage of the intervals of held-out RMS and largest error."""
    sources: list[tuple[str, int, Array]] = []
    for case in CASES:
        if case.objective == "sum" and case.share == 1.0:
            held = found[case.name].held
            sources += [(case.name, n, held[:, i]) for i, n in enumerate(HELD)]
    sources += [(f"law: {law}", n, held) for (law, n), held in laws.items()]
    rows = [
        (name, n, len(held), *(100.0 * held.mean(axis=0)).tolist(), 100.0 * chance_of_larger(n))
        for name, n, held in sources
    ]
    return Table.made(
        "held-out accuracy: 95 % intervals of the RMS and of the largest error of equally many new "
        "poses; how often the next pose is worse than all held-out ones",
        rows,
        "errors of | poses d | runs d | RMS % .1f | largest % .1f | next is worst % .1f | "
        "1/(n+1) % .1f",
    )


def bootstrap_table(found: dict[str, tuple[Array, ...]]) -> Table:
    """Coverage of the bootstrap's percentiles."""
    rows = tuple(
        (name, len(held), 100.0 * float(held.mean()), 100.0 * float(held.mean(axis=0).min()),
         100.0 * float(share.mean()))
        for name, (held, share) in found.items()
    )  # fmt: skip
    return Table.made(
        "coverage of the bootstrap's 95 % percentiles",
        rows,
        "case | runs d | parameters, pooled % .1f | least % .1f | positions % .1f",
    )


def verdicts(found: dict[str, Runs]) -> Table:
    """The criterion, for the cases that have to meet it."""
    rows = []
    for case in CASES:
        if not case.asked:
            continue
        runs = found[case.name]
        pooled = float(coverage(runs, 0).mean())
        place = float(runs.inside[:, 0, 0].mean())
        out = outside(runs, 0)
        (low, high), (least, most) = band(len(runs.error)), POOLED
        for what, value, good in (
            ("parameters, pooled, in 92-98 %", f"{100 * pooled:.1f} %", least <= pooled <= most),
            ("predicted positions, pooled, in 92-98 %", f"{100 * place:.1f} %",
             least <= place <= most),
            (f"each parameter in {100 * low:.1f}-{100 * high:.1f} %",
             f"outside: {', '.join(out) or 'none'}", not out),
        ):  # fmt: skip
            rows.append((case.name, what, value, "yes" if good else "NO"))
    return Table.made("sigma as reported", rows, "case | criterion | found | met")


def figure_of(found: dict[str, Runs]) -> Figure:
    """Coverage of every parameter, with the band of its binomial law."""
    shown = [case for case in CASES if case.objective == "sum" and case.share == 1.0]
    figure = canvas(12, 2.6 * len(shown))
    for axes, case in zip(figure.subplots(len(shown), 1), shown, strict=True):
        runs = found[case.name]
        low, high = band(len(runs.error))
        axes.axhspan(100 * low, 100 * high, color="0.9", label="99.9 % band")
        axes.axhline(100 * LEVEL, color="0.5", linewidth=0.8)
        at = np.arange(len(runs.names))
        for kind, (colour, mark) in enumerate((("#0072b2", "o"), ("#d55e00", "x"))):
            share = 100.0 * coverage(runs, kind)
            axes.plot(at, share, mark, color=colour, label=f"sigma by {KINDS[kind]}")
        axes.set_xticks(at, runs.names, rotation=90)
        axes.set(ylabel="covered (%)", title=f"{case.name}: {len(runs.error)} runs")
        axes.grid(visible=True, axis="y", alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3, frameon=False)
    return figure


# ---- the command ---------------------------------------------------------------------------------


def batches(case: Case, seed: int, count: int, replicates: int = 0) -> list[Batch]:
    """The jobs of a case."""
    size = BATCH // 4 if replicates else BATCH
    return [
        Batch(case, seed, first, min(size, count - first), replicates)
        for first in range(0, count, size)
    ]


@study_options("coverage")
@click.option("--runs", "count", type=click.IntRange(4), default=400, show_default=True)
def main(study: Study, count: int) -> None:
    """Coverage of the intervals of parameters, positions and held-out accuracy."""
    again, replicates = 60, 300  # runs that are bootstrapped too
    if study.quick:
        count, again, replicates = 6, 2, 30
        click.echo(
            f"quick: {count} runs a case tell whether it works, not what is covered", err=True
        )
    jobs = [b for case in CASES for b in batches(case, study.seed, max(int(case.share * count), 4))]
    parts = study.sweep(run, jobs, "runs")
    found = {
        case.name: joined([p for b, p in zip(jobs, parts, strict=True) if b.case == case])
        for case in CASES
    }
    draws = [Draws(law, n, study.seed, count) for law in LAWS for n in HELD]
    laws = {(d.law, d.poses): one
            for d, one in zip(draws, study.sweep(drawn, draws, "laws"), strict=True)}  # fmt: skip
    more = [b for case in CASES if case.name in RESAMPLED
            for b in batches(case, study.seed, again, replicates)]  # fmt: skip
    booted = study.sweep(resampled, more, "bootstrap")
    boots = {
        name: tuple(np.concatenate([one[i] for b, one in zip(more, booted, strict=True)
                                    if b.case.name == name]) for i in range(2))
        for name in RESAMPLED
    }  # fmt: skip
    tables = [
        verdicts(found),
        parameters_table(found),
        positions_table(found),
        held_table(found, laws),
        bootstrap_table(boots),
    ]
    odd = {name: runs.odd for name, runs in found.items() if runs.odd}
    for name, number in odd.items():
        click.echo(f"{name}: {number} runs left out, they identify other parameters", err=True)
    content = {"runs": count, "rows": rows_of(found)}
    study.save(tables, content, {"coverage": figure_of(found)})


def rows_of(found: dict[str, Runs]) -> list[dict[str, object]]:
    """The figures of the study for other programs."""
    return [
        {
            "case": case.name,
            "asked": case.asked,
            "sigma_by": kind,
            "runs": len(found[case.name].error),
            "pooled": float(coverage(found[case.name], i).mean()),
            "least": float(coverage(found[case.name], i).min()),
            "positions": float(found[case.name].inside[:, i, 0].mean()),
            "outside": outside(found[case.name], i),
        }
        for case in CASES
        for i, kind in enumerate(KINDS)
    ]
