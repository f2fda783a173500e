"""How fast the fits are, as ratios to peers on the same problem in the same run.

    python -m experiments.speed [--quick] [--part PART ...] [--repeats N] [--out FOLDER]
                                [--json FILE] [--seed N]

Peers (`speed_peers`) share no line with the package and start where it starts; that all reach the
same optimum is checked.  Times are of the processor, on one thread, medians of runs taken in turn,
so that a slow spell hits all alike.  Peers that are not installed are left out, with a word:
pip install ".[peers]".
"""

from __future__ import annotations

import math
import multiprocessing
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click
import numpy as np
from threadpoolctl import threadpool_limits

import minimax_cal as mc
from experiments import speed_peers
from experiments.record import processor
from experiments.speed_peers import Raw
from experiments.sweep import Study, study_options
from minimax_cal.fitting import identify
from minimax_cal.fitting.minimax_problem import (
    Distances,
    MinimaxProblem,
    measured_distances,
    minimax_problem,
)
from minimax_cal.fitting.options import solver_of
from minimax_cal.fitting.solve import QP_TOLERANCE
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling import start
from minimax_cal.modelling.effects.table import Fitted, Term
from minimax_cal.modelling.model import Model, SumOfSquares, model_of
from minimax_cal.modelling.near import nearby
from minimax_cal.modelling.parameters import State
from minimax_cal.modelling.simulate import simulate
from minimax_cal.robots.kernels import choice, plain
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.sampling import random_joints
from minimax_cal.solvers import least_squares, minimax

PARTS = ("races", "points", "bootstrap", "command", "growth", "diagnosis")
SAME = 1e-6  # relative difference of two optima that are called the same
NOISE = 2e-5  # of a coordinate, where very many poses are made [m]
LAWS = (  # of an arm like a real one, beside the compliance that each has, with values in SI
    (Term("gear_error", "J1", {"turns": 1.0}), (1e-4, 5e-5)),
    (Term("gear_ripple", "J2", {"turns": 120.0}), (3e-5, 2e-5)),
    (Term("gear_ripple", "J3", {"turns": 100.0}), (4e-5, 1e-5)),
    (Term("backlash", "J4"), (1e-4,)),
    (Term("axis_wobble", "J5", {"turns": 1.0}), (5e-5, 5e-5)),
    (Term("target_offset", "smr1"), (5e-5,)),
)
Run = Callable[[], object]


@dataclass(frozen=True, eq=False)
class Case:
    """A simulated calibration, ready to be fitted: model with its identified parameters, start."""

    robot: Robot
    model: Model
    begin: State
    worst: Callable[[State], MinimaxProblem]


def case_of(poses: int, seed: int) -> Case:
    """IRB 2600, three targets, geometric errors, some compliance, tracker noise."""
    robot = load_robot("irb2600")
    data = simulate(robot, poses, 3, seed).data
    model, begin = identified(robot, data)
    distances = measured_distances(data)
    return Case(
        robot, model, begin, lambda x: minimax_problem(model, x, distances, "two-sided", "target")
    )


def identified(robot: Robot, data: Measurements) -> tuple[Model, State]:
    """The model with its identified parameters free, and the nominal start."""
    model = model_of(robot, data)
    begin = start.fit_base(model, robot.mdh).state
    found = identify.identify(
        model,
        begin,
        identify.drop_order(robot, model.names),
        allowed=model.active,
        reference=identify.plenty_of_poses(robot, model),
        known=np.zeros(model.names.count, dtype=bool),
    )
    return model.only(found.active), begin


def fitted(robot: Robot, data: Measurements) -> tuple[Model, State]:
    """The same with its least-squares fit."""
    model, begin = identified(robot, data)
    found = least_squares.solve(SumOfSquares(model), begin.batch(), 1, float(model.counts.sum()))
    return model, found.x.take(np.array(0))


def raw_of(case: Case, data: Measurements) -> Raw:
    """The same for the peers, as plain arrays."""
    kept, x = measured_distances(data), case.begin
    free = np.flatnonzero(case.model.active)
    return Raw(case.model.q, data.y, x.mdh, x.rotation, x.origin, x.target_positions, free,
               kept.pairs, kept.mean, kept.tolerance)  # fmt: skip


def squares(case: Case) -> State:
    """Our least squares from the nominal start."""
    return nearby(case.model, case.begin).x.take(np.array(0))


def worst_target(case: Case) -> float:
    """Our minimax from the nominal start, least squares included: max F_i / m_i [m^2]."""
    begin = squares(case)
    problem = case.worst(begin)
    return minimax.solve(problem, begin, solver_of("daqp", QP_TOLERANCE)[0]).value * problem.size


def worst_point(case: Case, begin: State, kept: Distances) -> float:
    """Our least worst point from a least-squares fit, distances left free [m]."""
    problem = minimax_problem(case.model, begin, kept, "off", "point")
    found = minimax.solve(problem, begin, solver_of("daqp", QP_TOLERANCE)[0])
    return float(np.sqrt(found.value * problem.size))


def race(runs: Mapping[str, Run], repeats: int) -> dict[str, float]:
    """Median processor time of each, the runs taken in turn after one that does not count [s]."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(repeats):
        for name, run in runs.items():
            began, count = time.process_time(), 0
            while count == 0 or (time.process_time() - began < 0.02 and count < 50):
                run()
                count += 1
            times[name].append((time.process_time() - began) / count)
    return {name: statistics.median(values) for name, values in times.items()}


def alike(name: str, values: Mapping[str, float]) -> None:
    """ClickException where optima differ."""
    if max(values.values()) > min(values.values()) * (1.0 + SAME):
        raise click.ClickException(f"{name}: the optima differ: {values}")


def races(seed: int, repeats: int, *, quick: bool) -> dict[str, float]:
    """Seconds of everything at 100 poses by name; all must reach the same optimum."""
    case, data = case_of(100, seed), simulated(100, seed)
    raw = raw_of(case, data)
    scale, size = speed_peers.scaled(raw)
    fits: dict[str, Run] = {
        "squares": lambda: squares(case),
        "squares_without_numba": lambda: briefly(partial(squares, case)),
        "squares_numpy_gn": lambda: speed_peers.gauss_newton(raw),
        "squares_scipy": lambda: speed_peers.scipy_squares(raw),
    }
    worst: dict[str, Run] = {
        "minimax": lambda: worst_target(case),
        "minimax_slsqp": lambda: speed_peers.slsqp(raw, scale, size),
    }
    if there("casadi"):
        worst["minimax_ipopt"] = speed_peers.ipopt(raw, scale, size)
    split = replace(
        data, columns={**data.columns, "split": np.repeat(["train", "holdout"], [80, 20])}
    )
    whole: dict[str, Run] = {
        "whole": lambda: mc.calibrate(case.robot, split),
        "whole_beyond": lambda: mc.calibrate(case.robot, split).beyond,
        "whole_without_numba": lambda: briefly(lambda: mc.calibrate(case.robot, split)),
    }
    seconds = (
        race(fits, repeats) | race(worst, 1 if quick else min(repeats, 5)) | race(whole, repeats)
    )
    sums, ends = {"ours": float(case.model.cost(squares(case)).sum())}, {"ours": worst_target(case)}
    for name in ("squares_numpy_gn", "squares_scipy"):
        sums[name] = float((raw.rows(np.asarray(fits[name]()))[0] ** 2).sum())
    for name in worst.keys() - {"minimax"}:
        ends[name] = float(raw.squares(np.asarray(worst[name]()))[0].max())
    alike("least squares", sums)
    alike("minimax", ends)
    return seconds


def briefly(run: Run) -> object:
    """A run with NumPy's kernels."""
    with choice.work(brief=True):
        return run()


def there(package: str) -> bool:
    """Whether a peer is installed; a word where it is not."""
    found = find_spec(package) is not None
    if not found:
        click.echo(f'{package} is not installed and left out: pip install ".[peers]"', err=True)
    return found


def points(seed: int, counts: tuple[int, ...]) -> dict[str, float]:
    """Seconds of the worst point by the number of points, ours and by cones (of many, one run)."""
    out: dict[str, float] = {}
    for count in counts:
        case, data = case_of(count // 3, seed), simulated(count // 3, seed)
        begin, kept = squares(case), measured_distances(data)
        runs: dict[str, Run] = {f"point_{count}": lambda: worst_point(case, begin, kept)}  # noqa: B023
        raw = raw_of(case, data)
        if there("cvxpy"):
            first = speed_peers.gauss_newton(raw)
            began = time.process_time()
            end = raw.rows(speed_peers.cones(raw, first))[0]
            out[f"point_{count}_cvxpy"] = time.process_time() - began
            largest = float(np.sqrt((end**2).sum(axis=0)).max())
            alike("worst point", {"ours": worst_point(case, begin, kept), "cvxpy": largest})
            if count <= 300:
                runs[f"point_{count}_cvxpy"] = lambda: speed_peers.cones(raw, first)  # noqa: B023
        out |= race(runs, 3)
    return out


def simulated(poses: int, seed: int) -> Measurements:
    """The measurements of `case_of`."""
    return simulate(load_robot("irb2600"), poses, 3, seed).data


def command(seed: int) -> float:
    """Processor time of `minimax-cal calibrate` on 100 poses, from the start of the process [s]."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "poses.csv"
        mc.write_measurements(path, simulated(100, seed))
        words = [sys.executable, "-m", "minimax_cal.cli", "calibrate", "irb2600", str(path)]
        times = []
        for _ in range(3):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run(words, check=True, capture_output=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            spent = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
            times.append(spent)
    return min(times)


def plenty(poses: int, targets: int, seed: int) -> Measurements:
    """Poses all over the joints' range, made part by part, for their making to take no memory."""
    robot, rng = load_robot("irb2600"), np.random.default_rng(seed)
    arm = simulate(robot, 100, targets, seed).cell
    q = random_joints(robot, (poses,), rng)
    y = np.empty((poses, targets, 3))
    for first in range(0, poses, 10000):
        part = slice(first, first + 10000)
        y[part] = arm.predict(q[part])
        y[part] += NOISE * rng.normal(size=y[part].shape)
    return mc.measurements(q, y)


def calibrated_in(poses: int, targets: int, seed: int, answer: Any) -> None:
    """Put seconds and peak memory [GB] of one calibration; for a process of its own."""
    data = plenty(poses, targets, seed)
    mc.calibrate("irb2600", plenty(100, targets, seed))
    began = time.process_time()
    mc.calibrate("irb2600", data)
    spent = time.process_time() - began
    answer.put((spent, peak_memory()))


def peak_memory() -> float:
    """Of this process [GB]; what getrusage tells includes the parent's at the fork."""
    status = Path("/proc/self/status")
    if not status.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    lines = status.read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024**2


def growth(
    seed: int, sizes: tuple[tuple[int, int], ...]
) -> tuple[dict[str, float], dict[str, float]]:
    """Seconds and peak memory [GB] of a whole calibration by the number of poses and targets."""
    fresh = multiprocessing.get_context("spawn")
    seconds, memory = {}, {}
    for poses, targets in sizes:
        answer = fresh.SimpleQueue()
        job = fresh.Process(target=calibrated_in, args=(poses, targets, seed, answer))
        job.start()
        job.join()
        if job.exitcode:
            raise click.ClickException(f"{poses} poses: the process ended with {job.exitcode}")
        name = f"{poses}x{targets}"
        seconds[f"calibrate_{name}"], memory[name] = answer.get()
    return seconds, memory


def bootstraps(seed: int) -> dict[str, float]:
    """Seconds of 500 replicates."""
    robot, data = load_robot("irb2600"), simulated(100, seed)
    return race(
        {
            f"bootstrap_500_{objective}": partial(
                mc.bootstrap, mc.calibrate(robot, data, objective)
            )
            for objective in ("minimax", "sum")
        },
        1,
    )


def diagnoses(seed: int, sizes: tuple[tuple[int, int], ...]) -> dict[str, float]:
    """Seconds of a diagnosis by the number of poses and targets."""
    robot, out = load_robot("irb2600"), {}
    mc.diagnose(robot, simulated(60, seed), quick=True)  # loads what is imported when it is used
    for poses, targets in sizes:
        more = simulate(robot, poses, targets, seed).data
        began = time.process_time()
        mc.diagnose(robot, more)
        out[f"diagnose_{poses}x{targets}"] = time.process_time() - began
    return out


def diagnosis_like_real(seed: int) -> dict[str, float]:
    """Seconds of a diagnosis of 600 poses of an arm with many laws, whole and quick."""
    robot, out = load_robot("irb2600"), {}
    bare = simulate(robot, 600, 3, seed)
    laws = Fitted.of((term, np.array(values)) for term, values in LAWS)
    history = with_history(bare.data)
    moved = replace(bare.cell, effects=laws).follow(history) - bare.cell.follow(history)
    data = bare.data.with_y(bare.data.y + moved)
    for name, quick in (("like_real", False), ("like_real_quick", True)):
        began = time.process_time()
        mc.diagnose(robot, data, quick=quick)
        out[f"diagnose_{name}"] = time.process_time() - began
    return out


RATIOS = {  # name: the peer, ours, in words
    "whole_over_slsqp": (
        "minimax_slsqp", "whole", "`mc.calibrate` as a whole against SLSQP's minimax alone"),
    "minimax_over_slsqp": (
        "minimax_slsqp", "minimax", "minimax from the nominal robot, least squares included"),
    "minimax_over_ipopt": ("minimax_ipopt", "minimax", "the same against IPOPT"),
    "squares_over_numpy_gn": (
        "squares_numpy_gn", "squares", "least squares against plain Gauss-Newton in NumPy"),
    "point_over_cvxpy": (
        "point_300_cvxpy", "point_300", "the least worst of 300 points against cvxpy's cones"),
    "point_3000_over_cvxpy": ("point_3000_cvxpy", "point_3000", "of 3,000"),
    "point_30000_over_cvxpy": ("point_30000_cvxpy", "point_30000", "of 30,000"),
    "squares_over_scipy": (
        "squares_scipy", "squares", "least squares against SciPy's by finite differences"),
    "squares_without_numba_over_with": (
        "squares_without_numba", "squares", "our least squares without numba"),
    "whole_without_numba_over_with": (
        "whole_without_numba", "whole", "`mc.calibrate` without numba"),
}  # fmt: skip
WORDS = {  # of times by name
    "squares": "least squares",
    "squares_without_numba": "the same without numba",
    "squares_numpy_gn": "plain Gauss-Newton in NumPy",
    "squares_scipy": "SciPy's least_squares, finite differences",
    "minimax": "minimax from the nominal robot",
    "minimax_slsqp": "the same by SLSQP",
    "minimax_ipopt": "the same by IPOPT",
    "whole": "`mc.calibrate`",
    "whole_beyond": "`mc.calibrate` and `fit.beyond`",
    "whole_without_numba": "`mc.calibrate` without numba",
    "command": "`minimax-cal calibrate`, from the start of the process",
    "diagnose_like_real": "a diagnosis of an arm with seven laws, 600 poses x 3 targets",
    "diagnose_like_real_quick": "the same, quick",
}
KINDS = (  # of times whose names have a size
    (r"point_(\d+)", r"worst of \1 points, from the least squares"),
    (r"point_(\d+)_cvxpy", r"worst of \1 points by cvxpy"),
    (r"bootstrap_500_(\w+)", r"bootstrap of 500, \1"),
    (r"calibrate_(\d+)x(\d+)", r"`mc.calibrate`, poses x targets: \1 x \2"),
    (r"diagnose_(\d+)x(\d+)", r"a diagnosis with its folds, poses x targets: \1 x \2"),
)


def words_of(name: str) -> str:
    """What a time is of."""
    for pattern, words in KINDS:
        if found := re.fullmatch(pattern, name):
            return found.expand(words)
    return WORDS[name]


def ratios(seconds: Mapping[str, float]) -> dict[str, float | None]:
    """The peers' times over ours; None for a peer that is not there."""
    return {
        name: seconds[peer] / seconds[ours] if peer in seconds else None
        for name, (peer, ours, _) in RATIOS.items()
        if ours in seconds
    }


def timed(
    seed: int, repeats: int, parts: tuple[str, ...], *, quick: bool
) -> tuple[dict[str, float], dict[str, float]]:
    """Seconds of everything by name, and peak memory [GB] by poses x targets."""
    seconds: dict[str, float] = {}
    memory: dict[str, float] = {}
    sizes = ((1000, 3), (10000, 1)) if quick else ((1000, 3), (100000, 1), (1000000, 1))
    cases = ((100, 3),) if quick else ((100, 3), (600, 3), (1200, 1), (2000, 3))
    if "races" in parts:
        seconds |= races(seed, 3 if quick else repeats, quick=quick)
    if "points" in parts:
        seconds |= points(seed, (300, 3000) if quick else (300, 3000, 30000))
    if "bootstrap" in parts:
        seconds |= bootstraps(seed)
    if "command" in parts:
        seconds["command"] = command(seed)
    if "growth" in parts:
        grown, memory = growth(seed, sizes)
        seconds |= grown
    if "diagnosis" in parts:
        seconds |= diagnoses(seed, cases)
        seconds |= {} if quick else diagnosis_like_real(seed)
    return seconds, memory


@study_options("speed")
@click.option("--repeats", type=int, default=9, show_default=True)
@click.option("--part", multiple=True, type=click.Choice(PARTS), help="These alone  [default: all]")
def main(study: Study, repeats: int, part: tuple[str, ...]) -> None:
    """Ratios of our fits to their peers.

    Times are compared, so the runs go one after the other: --jobs and --cluster do not apply.
    """
    with threadpool_limits(1):
        seconds, memory = timed(study.seed, repeats, part or PARTS, quick=study.quick)
    over = ratios(seconds)
    machine = f"{processor()}, kernels: {choice.kernels().__name__}"
    numba = choice.kernels() is not plain
    shown = tuple((f"`{k}`", math.nan if v is None else v, RATIOS[k][2]) for k, v in over.items())
    spent = tuple((words_of(name), 1e3 * value) for name, value in seconds.items())
    tables = [
        Table.made("the peer's time over ours", shown, "ratio | times .1f | of what"),
        Table.made(f"processor time ({machine})", spent, "what | ms .2f"),
        Table.made(
            "peak memory of a whole calibration", memory.items(), "poses x targets | GB .2f"
        ),
    ]
    content = {"ratios": over, "seconds": seconds, "memory_gb": memory, "numba": numba}
    study.save(tables, content, packages=("numba", "casadi", "cvxpy", "daqp"))
