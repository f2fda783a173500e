"""The worst point of all as objective: what it brings, what it costs, and whether it is right.

    python -m experiments.worst_point [--quick] [--out FOLDER] [--json FILE] [--seed N] ...

Gain: the largest training error of `point` against that of least squares, held-out errors beside
it, on a simulated IRB 2600 whose compliance no geometry holds, and on a real IRB 120 over several
splits.  Agreement: the SQP on squared distances, our cone programs, and cone programs stated for
cvxpy, from the same start.  Cost: their times on 300 points, and the growth of ours with the number
of points.  Times are of the processor: other work on the machine counts less.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

import minimax_cal as mc
from experiments import cones, sweep
from experiments.record import environment, save_figure, save_json, save_tables
from experiments.speed import fitted
from experiments.sweep import Study, study_options
from minimax_cal.fitting.certificate import PointCones, certify
from minimax_cal.fitting.minimax_problem import MinimaxProblem, measured_distances, minimax_problem
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.parameters import State
from minimax_cal.modelling.simulate import simulate
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.solvers import minimax
from minimax_cal.solvers.dual_bound import Rows
from qp_backends import solve as solve_qp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REAL = Path(__file__).parents[2] / "shared" / "data" / "irb120"
POINTS = 300  # where the ways are compared
OBJECTIVES = ("sum", "minimax", "point")
SQP, CONES, CVXPY = "SQP", "cone programs", "cvxpy"
QP = partial(solve_qp, name="daqp", tolerance=1e-9)
LIMITS = {  # by figure: what it is, and the most that it may be
    "largest_ratio_to_least_squares": ("largest training error over least squares', any seed", 0.8),
    "apart_relative": ("difference of the three ways, relative, any seed", 1e-8),
    "largest_gap": ("gap of the certificates, relative, any seed", 1e-6),
    "sqp_share_of_cvxpy": ("time of the SQP over cvxpy's", 0.1),
    "sqp_exponent": ("power of the number of points with which the SQP's time grows", 1.0),
}


# ---- three ways to the same answer -------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Case:
    """A simulated calibration at its least-squares fit, scaled as the SQP and the cones take it."""

    data: Measurements
    start: State
    worst: MinimaxProblem


def case_of(points: int, seed: int) -> Case:
    """So many points of three targets on a simulated IRB 2600."""
    robot = load_robot("irb2600")
    data = simulate(robot, round(points / 3), 3, seed).data
    model, start = fitted(robot, data)
    return Case(
        data, start, minimax_problem(model, start, measured_distances(data), "two-sided", "point")
    )


def by_sqp(case: Case) -> float:
    """The largest distance by the SQP on squared distances [m]."""
    problem = scaled(case)
    return float(np.sqrt(minimax.solve(problem, case.start, QP).value * problem.size))


def by_cones(case: Case) -> float:
    """The largest distance by our cone programs [m]."""
    problem = scaled(case)
    return cones.solve(PointCones.of(problem), case.start).value * float(np.sqrt(problem.size))


def by_cvxpy(case: Case) -> float:
    """The largest distance by cone programs stated for cvxpy, until the value stands still [m].

    Stated anew each time: given other values of its parameters, cvxpy takes longer still.
    """
    problem = scaled(case)
    points, x, value = PointCones.of(problem), case.start, np.inf
    for _ in range(20):
        rows = points.linearise(x)
        x = points.step(x, linear_optimum(rows, points.lower, points.upper)[0])
        before, value = value, float(points.linearise(x).norms.max())
        if abs(before - value) <= 1e-9 * value:
            break
    return value * float(np.sqrt(problem.size))


def linear_optimum(rows: Rows, lower: Array, upper: Array) -> tuple[Array, float]:
    """Step and value of min max |r_i + J_i d|, lower <= c + C d <= upper, by cvxpy."""
    cp: Any = import_module("cvxpy")  # slow to import, and not needed by every part of the study
    n, w, p = rows.J.shape
    d, t = cp.Variable(p), cp.Variable()
    r = rows.r + cp.reshape(rows.J.reshape(n * w, p) @ d, (n, w), order="C")
    kept = [cp.norm(r, axis=1) <= t]
    kept += [rows.c + rows.C @ d >= lower, rows.c + rows.C @ d <= upper] if len(rows.c) else []
    problem = cp.Problem(cp.Minimize(t), kept)
    problem.solve(solver="CLARABEL", tol_gap_abs=1e-9, tol_gap_rel=1e-9, tol_feas=1e-9)
    return np.asarray(d.value), float(problem.value)


def scaled(case: Case) -> MinimaxProblem:
    """The problem scaled anew, which is part of the work."""
    worst = case.worst
    return minimax_problem(worst.model, case.start, worst.distances, worst.form, worst.per)


WAYS: dict[str, Callable[[Case], float]] = {SQP: by_sqp, CONES: by_cones, CVXPY: by_cvxpy}


def race(case: Case, ways: Sequence[str], repeats: int) -> dict[str, float]:
    """Median processor time of each way, taken in turn after one run that does not count [s]."""
    times: dict[str, list[float]] = {way: [] for way in ways}
    for repeat in range(repeats + 1):
        for way in ways:
            began = time.process_time()
            WAYS[way](case)
            if repeat:
                times[way].append(time.process_time() - began)
    return {way: float(np.median(values)) for way, values in times.items()}


# ---- agreement and cost ------------------------------------------------------------------------


@dataclass(frozen=True)
class Agreement:
    """Largest distances by each way [m], and the certificate of the SQP's answer."""

    seed: int
    values: dict[str, float]
    active: int
    bound: float
    gap: float


def agreement(job: tuple[int, int]) -> Agreement:
    """All ways from the same start.  job: points, seed."""
    points, seed = job
    case = case_of(points, seed)
    best = minimax.solve(case.worst, case.start, QP)
    proof = certify(case.worst, best, case.data.line)
    values = {way: run(case) for way, run in WAYS.items()}
    return Agreement(seed, values, len(proof.points), proof.bound, proof.gap)


def agreement_table(points: int, found: Sequence[Agreement]) -> Table:
    """The values side by side, and how far apart they are."""
    rows = tuple(
        (
            a.seed,
            *(1e3 * a.values[way] for way in WAYS),
            apart(a),
            a.active,
            1e3 * a.bound,
            a.gap,
        )
        for a in found
    )
    header = ("seed", *(f"{way} mm" for way in WAYS), "apart, relative", "active points",
              "lower bound mm", "gap, relative")  # fmt: skip
    formats = ("d", *[".9f"] * 3, ".1e", "d", ".9f", ".1e")
    return Table(f"the same largest error three ways, {points} points", header, rows, formats)


def apart(found: Agreement) -> float:
    """Relative difference of the values."""
    values = list(found.values.values())
    return max(values) / min(values) - 1.0


def cost_table(times: dict[str, float], points: int) -> Table:
    """Times and their share of cvxpy's."""
    rows = tuple((way, 1e3 * t, t / times[CVXPY]) for way, t in times.items())
    title = f"processor time from the least-squares fit, {points} points (medians)"
    return Table(title, ("way", "ms", "share of cvxpy's"), rows, ("", ".1f", ".3f"))


@dataclass(frozen=True, eq=False)
class Growth:
    """Median processor times (ways, counts) [s] and the exponents (ways,) of their growth."""

    counts: tuple[int, ...]
    seconds: Array
    exponent: Array


def growth(counts: tuple[int, ...], seeds: Sequence[int], repeats: int) -> Growth:
    """How times grow with the number of points: a line through all seeds' medians, log-log."""
    times = np.array(
        [
            [list(race(case_of(n, seed), (SQP, CONES), repeats).values()) for n in counts]
            for seed in seeds
        ]
    )
    logs = np.log(times).reshape(len(seeds), len(counts), 2).mean(axis=0)
    exponent = np.polyfit(np.log(counts), logs, 1)[0]
    return Growth(counts, np.median(times, axis=0).T, exponent)


def growth_table(found: Growth) -> Table:
    """Times by the number of points."""
    rows = tuple(
        (count, 1e3 * sqp, 1e3 * cone)
        for count, sqp, cone in zip(found.counts, *found.seconds, strict=True)
    )
    title = (
        f"growth with the number of points: times grow as its power {found.exponent[0]:.2f} (SQP) "
        f"and {found.exponent[1]:.2f} (cone programs)"
    )
    return Table(title, ("points", f"{SQP} ms", f"{CONES} ms"), rows, ("d", ".1f", ".1f"))


def growth_figure(found: Growth) -> Figure:
    """Times by the number of points, with the fitted lines and one of slope one."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    figure = Figure(figsize=(6.5, 4.2), layout="constrained")
    axes = figure.subplots()
    counts = np.array(found.counts)
    for name, seconds, exponent in zip((SQP, CONES), found.seconds, found.exponent, strict=True):
        axes.loglog(counts, 1e3 * seconds, "o-", label=f"{name}: power {exponent:.2f}")
    linear = 1e3 * found.seconds[0, 0] * counts / counts[0]
    axes.loglog(counts, linear, "k--", lw=1, label="linear")
    axes.set(xlabel="points", ylabel="processor time (ms)")
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.minorticks_off()
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.grid(visible=True, alpha=0.3)
    axes.legend(frameon=False)
    figure.suptitle("Worst point: time against the number of points", fontweight="bold")
    return figure


# ---- gain --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fits:
    """RMS and largest error [mm] by objective and kind of pose: (training, held out)."""

    name: str
    rms: dict[str, tuple[float, float]]
    most: dict[str, tuple[float, float]]


def simulated(job: tuple[int, int]) -> Fits:
    """Fits of a simulated arm with compliance.  job: poses, seed."""
    poses, seed = job
    robot = load_robot("irb2600")
    return fits_of(f"seed {seed}", robot, simulate(robot, poses, 3, seed).data, seed)


def real(split: int) -> Fits:
    """Fits of the real arm, some poses held out."""
    robot, data = load_robot(REAL / "robot.json"), mc.read_measurements(REAL / "measurements.csv")
    return fits_of(f"split {split}", robot, data, split)


def fits_of(name: str, robot: Robot, data: Measurements, split: int) -> Fits:
    """All objectives on one split."""
    found = {
        objective: mc.calibrate(robot, data, objective, seed=split) for objective in OBJECTIVES
    }
    train = {key: fit.accuracy["train"] for key, fit in found.items()}
    held = {key: fit.accuracy["holdout"] for key, fit in found.items()}
    return Fits(
        name,
        {key: (train[key].rms_mm, held[key].rms_mm) for key in found},
        {key: (train[key].max_mm, held[key].max_mm) for key in found},
    )


def ratio(fits: Fits, objective: str = "point") -> float:
    """Largest training error over that of least squares."""
    return fits.most[objective][0] / fits.most["sum"][0]


def gain_table(title: str, found: Sequence[Fits]) -> Table:
    """Point against least squares, one row a seed or split, and their medians."""
    rows: list[tuple[Cell, ...]] = [(fits.name, *gains(fits)) for fits in found]
    rows.append(("median", *np.median([gains(fits) for fits in found], axis=0).tolist()))
    header = ("", "sum: training max mm", "point: training max mm", "ratio",
              "sum: held-out RMS mm", "point: held-out RMS mm", "sum: held-out max mm",
              "point: held-out max mm")  # fmt: skip
    return Table(title, header, tuple(rows), ("", ".4f", ".4f", ".3f", *[".4f"] * 4))


def gains(fits: Fits) -> tuple[float, ...]:
    """The numbers of a row of `gain_table`."""
    (before, held_before), (after, held_after) = fits.most["sum"], fits.most["point"]
    rms = (fits.rms["sum"][1], fits.rms["point"][1])
    return before, after, after / before, *rms, held_before, held_after


def objectives_table(title: str, found: Sequence[Fits]) -> Table:
    """Medians over the splits for every objective."""
    rows = tuple(
        (
            objective,
            *np.median([fits.rms[objective] for fits in found], axis=0).tolist(),
            *np.median([fits.most[objective] for fits in found], axis=0).tolist(),
        )
        for objective in OBJECTIVES
    )
    header = ("objective", "training RMS mm", "held-out RMS mm", "training max mm",
              "held-out max mm")  # fmt: skip
    return Table(title, header, rows, ("", *[".4f"] * 4))


def limits_table(figures: dict[str, float]) -> Table:
    """What was asked of the worst-point fit, and what was measured."""
    rows = tuple(
        (text, figures[name], most, "yes" if figures[name] <= most else "no")
        for name, (text, most) in LIMITS.items()
    )
    header = ("figure", "measured", "at most", "holds")
    return Table("what is asked of it", header, rows, ("", ".3g", ".3g", ""))


# ---- the study ---------------------------------------------------------------------------------


@click.command()
@study_options("worst_point")
def main(study: Study) -> None:
    """The worst point as objective: gain, agreement of three solvers, time and its growth."""
    quick, first = study.quick, study.seed
    seeds = list(range(first, first + (2 if quick else 20)))
    splits = list(range(first, first + (1 if quick else 11))) if REAL.is_dir() else []
    counts = (300, 1000, 3000) if quick else (300, 600, 1000, 2000, 3000, 10000)
    gain = study.sweep(simulated, [(125, seed) for seed in seeds], "simulated arms")
    arm = study.sweep(real, splits, "real arm") if splits else []
    agreed = study.sweep(agreement, [(POINTS, seed) for seed in seeds], "three ways")
    times = race(case_of(POINTS, first), tuple(WAYS), 3 if quick else 15)
    grown = growth(counts, seeds[: 1 if quick else 5], 2 if quick else 7)
    figures = {
        "largest_ratio_to_least_squares": max(map(ratio, gain)),
        "apart_relative": max(map(apart, agreed)),
        "largest_gap": max(a.gap for a in agreed),
        "sqp_share_of_cvxpy": times[SQP] / times[CVXPY],
        "cones_share_of_cvxpy": times[CONES] / times[CVXPY],
        "sqp_exponent": float(grown.exponent[0]),
        "cones_exponent": float(grown.exponent[1]),
    }
    tables = [gain_table("IRB 2600, simulated with compliance, 100 training poses", gain)]
    if arm:
        title = f"IRB 120, real: medians of {len(arm)} splits"
        tables += [objectives_table(title, arm), gain_table("IRB 120, real, each split", arm)]
    else:
        click.echo(f"IRB 120: its measurements are not on this machine ({REAL})", err=True)
    tables += [agreement_table(POINTS, agreed), cost_table(times, POINTS), growth_table(grown)]
    made_on = environment(("clarabel", "cvxpy", "daqp"))
    save_tables(study.out, "worst_point", [*tables, limits_table(figures), made_on])
    save_figure(study.out, "growth", growth_figure(grown))
    if study.json:
        save_json(study.json, {"figures": figures})
    if figures["apart_relative"] > LIMITS["apart_relative"][1]:
        raise click.ClickException("the three ways disagree")


if __name__ == "__main__":
    sweep.start(__file__)
