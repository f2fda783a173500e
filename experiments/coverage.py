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
from experiments.study_record import new_figure
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array, rms
from minimax_cal.core.tables import Table
from minimax_cal.fitting.accuracy import (
    bootstrap_rms_interval,
    exceedance_probability,
    predict_max_error_interval,
)
from minimax_cal.fitting.cell_fit import CellFit, fit_cell
from minimax_cal.fitting.options import Objective, Options, silent_progress
from minimax_cal.fitting.uncertainty import (
    PosewiseFit,
    Uncertainty,
    noise_covariance,
    position_covariance_factor,
    student_quantile,
)
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.simulate import Truth, gravity, simulate
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.robot import Robot
from minimax_cal.validation.bootstrap import bootstrap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CONFIDENCE_LEVEL = 0.95
BINOMIAL_BAND_LEVEL = (
    0.999  # of the binomial law: one parameter in a thousand lies outside by chance
)
POOLED_COVERAGE_LIMITS = (0.92, 0.98)
REFERENCE_POSES, PREDICTION_POSES, JUDGING_POSES = (
    1000,
    200,
    2000,
)  # poses that tell an arm, to predict, to judge by
HELD_OUT_POSE_COUNTS = (10, 20, 50)
RUNS_PER_JOB = 20  # runs a job
SIGMA_SOURCES = ("poses", "noise")  # what sigma comes from: see `uncertainty`
POSITION_QUESTIONS = (
    "position, instrument's frame",
    "position, base frame",
    "new pose with jitter",
)


@dataclass(frozen=True)
class CoverageCase:
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


COVERAGE_CASES = (
    CoverageCase("IRB 2600", "irb2600", 3, 80, asked=True),
    CoverageCase("UR10", "ur10", 1, 80, asked=True),
    CoverageCase("IRB 2600, compliant", "irb2600", 3, 80, compliance=3e-7),
    CoverageCase("UR10, compliant", "ur10", 1, 80, compliance=3e-7),
    CoverageCase("IRB 2600, 16 poses", "irb2600", 3, 16, share=0.5),
    CoverageCase("UR10, 20 poses", "ur10", 1, 20, share=0.5),
    CoverageCase("IRB 2600, minimax", "irb2600", 3, 80, "minimax", share=0.25),
    CoverageCase("IRB 2600, pose", "irb2600", 3, 80, "pose", share=0.25),
    CoverageCase("IRB 2600, smr:2", "irb2600", 3, 80, "smr:2", share=0.25),
    CoverageCase("IRB 2600, point", "irb2600", 3, 80, "point", share=0.25),
    CoverageCase("UR10, point", "ur10", 1, 80, "point", share=0.25),
)
BOOTSTRAPPED_CASES = ("IRB 2600", "UR10")
# quantile functions of the squared error of a pose
ERROR_LAWS: dict[str, Callable[[Array], Array]] = {
    "chi-square, 3": lambda u: stats.chi2.ppf(u, 3),
    "chi-square, 1": lambda u: stats.chi2.ppf(u, 1),
    "lognormal, 1": lambda u: stats.lognorm.ppf(u, 1.0),
    "chi-square, 3; one in 20 ninefold": lambda u: np.where(
        u < 0.95, stats.chi2.ppf(np.minimum(u / 0.95, 1.0), 3),
        9.0 * stats.chi2.ppf(np.maximum(u - 0.95, 0.0) / 0.05, 3)),
}  # fmt: skip
ERROR_LAW_MEANS = {
    name: float(np.mean(law((np.arange(10**5) + 0.5) / 10**5))) for name, law in ERROR_LAWS.items()
}


@dataclass(frozen=True)
class RunBatch:
    """Some runs of a case.  replicates: of the bootstrap."""

    case: CoverageCase
    seed: int
    first: int
    count: int
    replicates: int = 0


@dataclass(frozen=True)
class LawDraws:
    """Some samples of a law."""

    law: str
    poses: int
    seed: int
    count: int


@dataclass(frozen=True)
class RunResults:
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


def build_arm_in_place(case: CoverageCase, seed: int) -> Cell:
    """The arm in its place, its geometry fixed."""
    return simulate(mc.load_robot(case.robot), 1, case.targets, seed + 7).cell


def true_joint_values(arm: Cell, case: CoverageCase, q: Array) -> Array:
    """Where the arm's joints really are, jitter left out: (m, n) [rad]."""
    return q + case.compliance * gravity(arm.robot, q)


def simulate_measurements(
    arm: Cell, case: CoverageCase, q: Array, rng: np.random.Generator, *, with_noise: bool = True
) -> Measurements:
    """What the tracker sees at poses (m, n)."""
    truth = Truth()
    if not with_noise:
        return measurements(q, arm.predict(true_joint_values(arm, case, q)))
    y = arm.predict(true_joint_values(arm, case, q) + case.jitter * rng.normal(size=q.shape))
    spread = truth.noise + truth.noise_per_metre * np.linalg.norm(y, axis=-1, keepdims=True)
    return measurements(q, y + spread * rng.normal(size=y.shape))


def fit_reference_arm(arm: Cell, case: CoverageCase) -> CellFit:
    """The fit of plenty of poses without noise: the truth in the parameters that are identified.

    What redundant parameters are off, others absorb; with model error, the best fit.
    """
    rng = np.random.default_rng(0)
    q = random_joint_values_above_floor(arm.robot, REFERENCE_POSES, rng)
    data = simulate_measurements(arm, case, q, rng, with_noise=False)
    return fit_cell(mc.load_robot(case.robot), data, Options(objective="sum"), silent_progress)


def uncertainty_by_noise_alone(fit: CellFit) -> Uncertainty:
    """The uncertainty of a fit by its noises alone."""
    active = fit.estimator.model.active
    out = np.full((len(active),) * 2, np.nan)
    out[np.ix_(active, active)] = noise_covariance(
        PosewiseFit(fit.estimator, fit.state), fit.uncertainty.noise
    )
    told = fit.uncertainty
    return Uncertainty(told.names, told.units, out, told.estimate_noise, told.dof, "noise")


def place_cell_in_base(cell: Cell) -> Cell:
    """The cell seen from its base."""
    return Cell(cell.robot, np.eye(4), cell.target_names, cell.target_positions)


@dataclass(frozen=True, eq=False)
class CoverageSubject:
    """The arm of a batch, its drawing, and the arm that plenty of poses tell."""

    arm: Cell
    robot: Robot
    true: CellFit
    ideal: Cell

    @staticmethod
    def build(batch: RunBatch) -> CoverageSubject:
        """The same for every batch of a case and seed."""
        arm, robot = build_arm_in_place(batch.case, batch.seed), mc.load_robot(batch.case.robot)
        true = fit_reference_arm(arm, batch.case)
        return CoverageSubject(
            arm, robot, true, Cell.from_parameters(robot, true.state, arm.target_names)
        )

    def simulate_runs(
        self, batch: RunBatch
    ) -> Iterator[tuple[int, np.random.Generator, Measurements]]:
        """Number, random numbers and measurements of each run."""
        for number in range(batch.first, batch.first + batch.count):
            rng = np.random.default_rng([batch.seed, number])
            q = random_joint_values_above_floor(self.robot, batch.case.poses, rng)
            yield number, rng, simulate_measurements(self.arm, batch.case, q, rng)


def run_batch(batch: RunBatch) -> RunResults:
    """Calibrate some runs and hold their intervals against the truth."""
    case, one = batch.case, CoverageSubject.build(batch)
    true, robot = one.true, one.robot
    active = true.identification.active
    rows = []
    for _, rng, data in one.simulate_runs(batch):
        fit = fit_cell(robot, data, Options(objective=case.objective), silent_progress)
        if not np.array_equal(fit.identification.active, active):
            continue
        axes = fit.nominal.rotation
        error = (
            fit.state.values_in_file_convention(axes, robot)
            - true.state.values_in_file_convention(axes, robot)
        )[active]
        told = (fit.uncertainty, uncertainty_by_noise_alone(fit))
        cell = Cell.from_parameters(robot, fit.state, one.arm.target_names)
        inside = np.array([position_coverages(cell, known, one.ideal, case, rng) for known in told])
        sigma = np.array([known.sigma[active] for known in told])
        whole = (
            real_arm_coverage(cell, told[0], one.arm, case, rng)
            if case.compliance
            else inside[0, 2]
        )
        rows.append((error, sigma, student_quantile(CONFIDENCE_LEVEL, told[0].dof), inside, whole,
                     test_held_out_intervals(cell, one.arm, case, rng)))  # fmt: skip
    names = tuple(name for name, on in zip(true.names.all_names, active, strict=True) if on)
    columns = (np.array(column) for column in zip(*rows, strict=True))
    return RunResults(names, batch.count - len(rows), *columns)


def position_coverages(
    cell: Cell,
    uncertainty: Uncertainty,
    reference_cell: Cell,
    case: CoverageCase,
    rng: np.random.Generator,
) -> tuple[float, float, float]:
    """Shares of coordinates whose interval holds the truth, by QUESTIONS."""
    q = random_joint_values_above_floor(cell.robot, PREDICTION_POSES, rng)
    moved = reference_cell.predict(q + case.jitter * rng.normal(size=q.shape))
    found, cover = cell.predict(q), partial(position_covariance, cell, uncertainty, q)
    off_base = place_cell_in_base(cell).predict(q) - place_cell_in_base(reference_cell).predict(q)
    return (
        share_within_intervals(found - reference_cell.predict(q), cover(), uncertainty),
        share_within_intervals(off_base, cover("base"), uncertainty),
        share_within_intervals(found - moved, cover(with_jitter=True), uncertainty),
    )


def real_arm_coverage(
    cell: Cell, uncertainty: Uncertainty, arm: Cell, case: CoverageCase, rng: np.random.Generator
) -> float:
    """The same at new poses of the real arm, its model error and jitter included."""
    q = random_joint_values_above_floor(cell.robot, PREDICTION_POSES, rng)
    real = arm.predict(true_joint_values(arm, case, q) + case.jitter * rng.normal(size=q.shape))
    return share_within_intervals(
        cell.predict(q) - real,
        position_covariance(cell, uncertainty, q, with_jitter=True),
        uncertainty,
    )


def position_covariance(
    cell: Cell,
    uncertainty: Uncertainty,
    q: Array,
    frame: str = "measurement",
    *,
    with_jitter: bool = False,
) -> Array:
    """(m, k, 3, 3) of each target's predicted position [m^2]; arguments as
    `position_covariance_factor`.
    """
    factor = position_covariance_factor(cell, uncertainty, q, frame, jitter=with_jitter)
    return np.asarray(factor @ np.swapaxes(factor, -1, -2))


def share_within_intervals(error: Array, covariance: Array, uncertainty: Uncertainty) -> float:
    """Share of coordinates within their intervals.  error: (m, k, 3), covariance: (m, k, 3, 3)."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    return float(
        np.mean(np.abs(error) <= student_quantile(CONFIDENCE_LEVEL, uncertainty.dof) * sigma)
    )


def test_held_out_intervals(
    cell: Cell, arm: Cell, case: CoverageCase, rng: np.random.Generator
) -> Array:
    """(sizes, 3) as `test_held_out_interval`, for each of HELD."""
    q = random_joint_values_above_floor(arm.robot, JUDGING_POSES, rng)
    error = cell.error(simulate_measurements(arm, case, q, rng))
    size = float(np.sqrt((error**2).sum(axis=-1).mean()))
    return np.array([test_held_out_interval(error, n, size, rng) for n in HELD_OUT_POSE_COUNTS])


def test_held_out_interval(
    error: Array, held_out_count: int, rms: float, rng: np.random.Generator
) -> tuple[bool, bool, bool]:
    """Whether n poses tell the RMS, the largest of n further ones; and whether one is worse.

    error: (m, k, 3) of many poses, the first n held out, the next n new.
    """
    held, new = error[:held_out_count], error[held_out_count : 2 * held_out_count]
    middle, most = (
        f(held, level=CONFIDENCE_LEVEL, rng=rng)
        for f in (bootstrap_rms_interval, predict_max_error_interval)
    )
    worst = [float(np.linalg.norm(part, axis=-1).max()) for part in (held, new, new[:1])]
    return middle.low <= rms <= middle.high, most.low <= worst[1] <= most.high, worst[2] > worst[0]


def test_intervals_on_law(draws: LawDraws) -> Array:
    """(R, 3) as `test_held_out_interval`, of one target whose squared error follows a law."""
    rng = np.random.default_rng(draws.seed)
    rms = float(np.sqrt(ERROR_LAW_MEANS[draws.law]))
    out = []
    for _ in range(draws.count):
        error = np.zeros((2 * draws.poses, 1, 3))
        error[:, 0, 0] = np.sqrt(ERROR_LAWS[draws.law](rng.uniform(size=2 * draws.poses)))
        out.append(test_held_out_interval(error, draws.poses, rms, rng))
    return np.array(out)


def bootstrap_coverages(batch: RunBatch) -> tuple[Array, Array]:
    """(R, p) whether the bootstrap's percentiles hold each parameter; (R,) share of positions."""
    case, one = batch.case, CoverageSubject.build(batch)
    place = np.flatnonzero(one.true.identification.active)
    held, share = [], []
    for number, rng, data in one.simulate_runs(batch):
        fit = mc.calibrate(one.robot, data, case.objective, holdout=0.0)
        found = bootstrap(fit, batch.replicates, seed=number)
        if not np.array_equal(found.place, place):
            continue
        low, high = found.interval(CONFIDENCE_LEVEL).T
        truth = one.true.state.values_in_file_convention(fit.nominal.base[:3, :3], one.robot)[place]
        held.append((low <= truth) & (truth <= high))
        q = random_joint_values_above_floor(one.robot, PREDICTION_POSES, rng)
        low, high = found.position_interval(q, CONFIDENCE_LEVEL)
        exact = one.ideal.predict(q)
        share.append(float(np.mean((low <= exact) & (exact <= high))))
    return np.array(held), np.array(share)


# ---- what it comes to ----------------------------------------------------------------------------


def join_run_results(results: Sequence[RunResults]) -> RunResults:
    """The runs of one case."""
    fields = ("error", "sigma", "width", "inside", "arm", "held")
    columns = (np.concatenate([getattr(part, name) for part in results]) for name in fields)
    return RunResults(results[0].names, sum(part.odd for part in results), *columns)


def parameter_coverages(runs: RunResults, sigma_source_index: int) -> Array:
    """(p,) share of runs in which the interval of each parameter holds the truth."""
    width = runs.width[:, None] * runs.sigma[:, sigma_source_index]
    return np.asarray((np.abs(runs.error) <= width).mean(axis=0))


def binomial_coverage_band(run_count: int) -> tuple[float, float]:
    """Where the coverage of an exact 95 % interval lies in so many runs, but once in a thousand."""
    low, high = stats.binom.interval(BINOMIAL_BAND_LEVEL, run_count, CONFIDENCE_LEVEL)
    return float(low) / run_count, float(high) / run_count


def list_parameters_outside_band(runs: RunResults, sigma_source_index: int) -> list[str]:
    """Parameters whose coverage is out of the band."""
    low, high = binomial_coverage_band(len(runs.error))
    share = parameter_coverages(runs, sigma_source_index)
    return [name for name, s in zip(runs.names, share, strict=True) if not low <= s <= high]


def build_parameter_coverage_table(results: dict[str, RunResults]) -> Table:
    """Pooled and extreme coverage of the parameters, by case and kind of sigma."""
    rows = []
    for case in COVERAGE_CASES:
        runs = results[case.name]
        for kind, name in enumerate(SIGMA_SOURCES):
            share = 100.0 * parameter_coverages(runs, kind)
            score = runs.error / runs.sigma[:, kind]
            least, most = int(share.argmin()), int(share.argmax())
            out = list_parameters_outside_band(runs, kind)
            rows.append(
                (case.name, name, len(runs.error), float(share.mean()),
                 float(share[least]), runs.names[least], float(share[most]), runs.names[most],
                 len(out), rms(score))
            )  # fmt: skip
    return Table.from_rows(
        "coverage of 95 % intervals of the identified parameters: value +- Student's quantile "
        "times sigma, sigma by the scatter from pose to pose or by the noises alone",
        rows,
        "case | sigma by | runs d | pooled % .1f | least % .1f | of | most % .1f | of  | "
        "outside 99.9 % band d | RMS error / sigma .3f",
    )


def build_position_coverage_table(results: dict[str, RunResults]) -> Table:
    """Pooled coverage of predicted coordinates."""
    rows = []
    for case in COVERAGE_CASES:
        runs = results[case.name]
        for kind, name in enumerate(SIGMA_SOURCES):
            mean = 100.0 * runs.inside[:, kind].mean(axis=0)
            spread = 100.0 * runs.inside[:, kind].std(axis=0) / np.sqrt(len(runs.error))
            real = 100.0 * float(runs.arm.mean()) if kind == 0 else float("nan")
            rows.append((case.name, name, len(runs.error), *map(float, mean),
                         float(spread.max()), real))  # fmt: skip
    return Table.from_rows(
        f"coverage of 95 % intervals of predicted coordinates "
        f"at {PREDICTION_POSES} poses a run.  With "
        "model error the jitter found holds it too: too much for the best fit, all there is for "
        "the real arm (last column: its model error and jitter included)",
        rows,
        "case | sigma by | runs d",
        *(f"{name} % .1f" for name in (*POSITION_QUESTIONS, "+-", "new pose, real arm")),
    )


def build_held_out_coverage_table(
    results: dict[str, RunResults], laws: dict[tuple[str, int], Array]
) -> Table:
    """Coverage of the intervals of held-out RMS and largest error."""
    sources: list[tuple[str, int, Array]] = []
    for case in COVERAGE_CASES:
        if case.objective == "sum" and case.share == 1.0:
            held = results[case.name].held
            sources += [(case.name, n, held[:, i]) for i, n in enumerate(HELD_OUT_POSE_COUNTS)]
    sources += [(f"law: {law}", n, held) for (law, n), held in laws.items()]
    rows = [
        (
            name,
            n,
            len(held),
            *(100.0 * held.mean(axis=0)).tolist(),
            100.0 * exceedance_probability(n),
        )
        for name, n, held in sources
    ]
    return Table.from_rows(
        "held-out accuracy: 95 % intervals of the RMS and of the largest error of equally many new "
        "poses; how often the next pose is worse than all held-out ones",
        rows,
        "errors of | poses d | runs d | RMS % .1f | largest % .1f | next is worst % .1f | "
        "1/(n+1) % .1f",
    )


def build_bootstrap_table(coverages: dict[str, tuple[Array, ...]]) -> Table:
    """Coverage of the bootstrap's percentiles."""
    rows = tuple(
        (name, len(held), 100.0 * float(held.mean()), 100.0 * float(held.mean(axis=0).min()),
         100.0 * float(share.mean()))
        for name, (held, share) in coverages.items()
    )  # fmt: skip
    return Table.from_rows(
        "coverage of the bootstrap's 95 % percentiles",
        rows,
        "case | runs d | parameters, pooled % .1f | least % .1f | positions % .1f",
    )


def build_criterion_table(results: dict[str, RunResults]) -> Table:
    """The criterion, for the cases that have to meet it."""
    rows = []
    for case in COVERAGE_CASES:
        if not case.asked:
            continue
        runs = results[case.name]
        pooled = float(parameter_coverages(runs, 0).mean())
        place = float(runs.inside[:, 0, 0].mean())
        out = list_parameters_outside_band(runs, 0)
        (low, high), (least, most) = binomial_coverage_band(len(runs.error)), POOLED_COVERAGE_LIMITS
        for what, value, good in (
            ("parameters, pooled, in 92-98 %", f"{100 * pooled:.1f} %", least <= pooled <= most),
            ("predicted positions, pooled, in 92-98 %", f"{100 * place:.1f} %",
             least <= place <= most),
            (f"each parameter in {100 * low:.1f}-{100 * high:.1f} %",
             f"outside: {', '.join(out) or 'none'}", not out),
        ):  # fmt: skip
            rows.append((case.name, what, value, "yes" if good else "NO"))
    return Table.from_rows("sigma as reported", rows, "case | criterion | found | met")


def draw_coverage_figure(results: dict[str, RunResults]) -> Figure:
    """Coverage of every parameter, with the band of its binomial law."""
    shown = [case for case in COVERAGE_CASES if case.objective == "sum" and case.share == 1.0]
    figure = new_figure(12, 2.6 * len(shown))
    for axes, case in zip(figure.subplots(len(shown), 1), shown, strict=True):
        runs = results[case.name]
        low, high = binomial_coverage_band(len(runs.error))
        axes.axhspan(100 * low, 100 * high, color="0.9", label="99.9 % band")
        axes.axhline(100 * CONFIDENCE_LEVEL, color="0.5", linewidth=0.8)
        at = np.arange(len(runs.names))
        for kind, (colour, mark) in enumerate((("#0072b2", "o"), ("#d55e00", "x"))):
            share = 100.0 * parameter_coverages(runs, kind)
            axes.plot(at, share, mark, color=colour, label=f"sigma by {SIGMA_SOURCES[kind]}")
        axes.set_xticks(at, runs.names, rotation=90)
        axes.set(ylabel="covered (%)", title=f"{case.name}: {len(runs.error)} runs")
        axes.grid(visible=True, axis="y", alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3, frameon=False)
    return figure


# ---- the command ---------------------------------------------------------------------------------


def split_runs_into_batches(
    case: CoverageCase, seed: int, run_count: int, replicates: int = 0
) -> list[RunBatch]:
    """The jobs of a case."""
    size = RUNS_PER_JOB // 4 if replicates else RUNS_PER_JOB
    return [
        RunBatch(case, seed, first, min(size, run_count - first), replicates)
        for first in range(0, run_count, size)
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
    jobs = [
        b
        for case in COVERAGE_CASES
        for b in split_runs_into_batches(case, study.seed, max(int(case.share * count), 4))
    ]
    parts = study.sweep(run_batch, jobs, "runs")
    found = {
        case.name: join_run_results([p for b, p in zip(jobs, parts, strict=True) if b.case == case])
        for case in COVERAGE_CASES
    }
    draws = [
        LawDraws(law, n, study.seed, count) for law in ERROR_LAWS for n in HELD_OUT_POSE_COUNTS
    ]
    laws = {
        (d.law, d.poses): one
        for d, one in zip(draws, study.sweep(test_intervals_on_law, draws, "laws"), strict=True)
    }
    more = [b for case in COVERAGE_CASES if case.name in BOOTSTRAPPED_CASES
            for b in split_runs_into_batches(case, study.seed, again, replicates)]  # fmt: skip
    booted = study.sweep(bootstrap_coverages, more, "bootstrap")
    boots = {
        name: tuple(np.concatenate([one[i] for b, one in zip(more, booted, strict=True)
                                    if b.case.name == name]) for i in range(2))
        for name in BOOTSTRAPPED_CASES
    }  # fmt: skip
    tables = [
        build_criterion_table(found),
        build_parameter_coverage_table(found),
        build_position_coverage_table(found),
        build_held_out_coverage_table(found, laws),
        build_bootstrap_table(boots),
    ]
    odd = {name: runs.odd for name, runs in found.items() if runs.odd}
    for name, number in odd.items():
        click.echo(f"{name}: {number} runs left out, they identify other parameters", err=True)
    content = {"runs": count, "rows": list_json_rows(found)}
    study.save(tables, content, {"coverage": draw_coverage_figure(found)})


def list_json_rows(results: dict[str, RunResults]) -> list[dict[str, object]]:
    """The figures of the study for other programs."""
    return [
        {
            "case": case.name,
            "asked": case.asked,
            "sigma_by": kind,
            "runs": len(results[case.name].error),
            "pooled": float(parameter_coverages(results[case.name], i).mean()),
            "least": float(parameter_coverages(results[case.name], i).min()),
            "positions": float(results[case.name].inside[:, i, 0].mean()),
            "outside": list_parameters_outside_band(results[case.name], i),
        }
        for case in COVERAGE_CASES
        for i, kind in enumerate(SIGMA_SOURCES)
    ]
