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
from experiments.speed_peers import RawCalibration
from experiments.study_record import processor_name
from experiments.sweep import Study, study_options
from minimax_cal.core.tables import Table
from minimax_cal.fitting import identification
from minimax_cal.fitting.cell_fit import FIT_QP_TOLERANCE
from minimax_cal.fitting.minimax_problem import (
    MinimaxProblem,
    TargetDistanceLimits,
    build_minimax_problem,
    measured_distances,
)
from minimax_cal.fitting.options import build_qp_solver
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling import global_start
from minimax_cal.modelling.effects.table import Fitted, Term
from minimax_cal.modelling.nearby_fit import fit_within_bounds_from_start
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointLeastSquares, PointModel, build_point_model
from minimax_cal.modelling.simulate import simulate
from minimax_cal.robots.joint_sampling import random_joint_values
from minimax_cal.robots.kernels import kernel_choice, plain
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.solvers import least_squares, minimax

SPEED_PARTS = ("races", "points", "bootstrap", "command", "growth", "diagnosis")
MAX_SAME_OPTIMUM_DIFFERENCE = 1e-6  # relative difference of two optima that are called the same
SPEED_COORDINATE_NOISE = 2e-5  # of a coordinate, where very many poses are made [m]
# of an arm like a real one, beside the compliance that each has, with values in SI
REAL_LIKE_EFFECT_TERMS = (
    (Term("gear_error", "J1", {"turns": 1.0}), (1e-4, 5e-5)),
    (Term("gear_ripple", "J2", {"turns": 120.0}), (3e-5, 2e-5)),
    (Term("gear_ripple", "J3", {"turns": 100.0}), (4e-5, 1e-5)),
    (Term("backlash", "J4"), (1e-4,)),
    (Term("axis_wobble", "J5", {"turns": 1.0}), (5e-5, 5e-5)),
    (Term("target_offset", "smr1"), (5e-5,)),
)
TimedRun = Callable[[], object]


@dataclass(frozen=True, eq=False)
class SpeedCase:
    """A simulated calibration, ready to be fitted: model with its identified parameters, start."""

    robot: Robot
    model: PointModel
    begin: ParameterValues
    worst: Callable[[ParameterValues], MinimaxProblem]


def simulate_speed_case(pose_count: int, seed: int) -> SpeedCase:
    """IRB 2600, three targets, geometric errors, some compliance, tracker noise."""
    robot = load_robot("irb2600")
    data = simulate(robot, pose_count, 3, seed).data
    model, begin = identify_parameters(robot, data)
    distances = measured_distances(data)
    return SpeedCase(
        robot,
        model,
        begin,
        lambda x: build_minimax_problem(model, x, distances, "two-sided", "target"),
    )


def identify_parameters(robot: Robot, data: Measurements) -> tuple[PointModel, ParameterValues]:
    """The model with its identified parameters free, and the nominal start."""
    model = build_point_model(robot, data)
    begin = global_start.fit_base_and_targets(model, robot.mdh).state
    found = identification.identify_point_parameters(
        model,
        begin,
        identification.redundancy_drop_order(robot, model.names),
        is_allowed=model.active,
        reference_model=identification.build_reference_model(robot, model),
        has_prior=np.zeros(model.names.parameter_count, dtype=bool),
    )
    return model.with_active(found.active), begin


def fit_least_squares(robot: Robot, data: Measurements) -> tuple[PointModel, ParameterValues]:
    """The same with its least-squares fit."""
    model, begin = identify_parameters(robot, data)
    found = least_squares.solve(
        PointLeastSquares(model), begin.batch(), 1, float(model.pose_counts_by_target.sum())
    )
    return model, found.x.take(np.array(0))


def to_raw_arrays(case: SpeedCase, data: Measurements) -> RawCalibration:
    """The same for the peers, as plain arrays."""
    kept, x = measured_distances(data), case.begin
    free = np.flatnonzero(case.model.active)
    return RawCalibration(
        case.model.q,
        data.y,
        x.mdh,
        x.rotation,
        x.origin,
        x.target_positions,
        free,
        kept.pairs,
        kept.mean,
        kept.tolerance,
    )


def solve_least_squares(case: SpeedCase) -> ParameterValues:
    """Our least squares from the nominal start."""
    return fit_within_bounds_from_start(case.model, case.begin).x.take(np.array(0))


def solve_minimax_over_targets(case: SpeedCase) -> float:
    """Our minimax from the nominal start, least squares included: max F_i / m_i [m^2]."""
    begin = solve_least_squares(case)
    problem = case.worst(begin)
    return (
        minimax.solve(problem, begin, build_qp_solver("daqp", FIT_QP_TOLERANCE)[0]).value
        * problem.size
    )


def solve_minimax_over_points(
    case: SpeedCase, start: ParameterValues, distances: TargetDistanceLimits
) -> float:
    """Our least worst point from a least-squares fit, distances left free [m]."""
    problem = build_minimax_problem(case.model, start, distances, "off", "point")
    found = minimax.solve(problem, start, build_qp_solver("daqp", FIT_QP_TOLERANCE)[0])
    return float(np.sqrt(found.value * problem.size))


def time_runs_in_turn(runs: Mapping[str, TimedRun], repeats: int) -> dict[str, float]:
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


def check_same_optimum(name: str, values: Mapping[str, float]) -> None:
    """ClickException where optima differ."""
    if max(values.values()) > min(values.values()) * (1.0 + MAX_SAME_OPTIMUM_DIFFERENCE):
        raise click.ClickException(f"{name}: the optima differ: {values}")


def time_100_pose_fits(seed: int, repeats: int, *, quick: bool) -> dict[str, float]:
    """Seconds of everything at 100 poses by name; all must reach the same optimum."""
    case, data = simulate_speed_case(100, seed), simulate_measurements(100, seed)
    raw = to_raw_arrays(case, data)
    scale, size = speed_peers.parameter_and_value_scales(raw)
    fits: dict[str, TimedRun] = {
        "squares": lambda: solve_least_squares(case),
        "squares_without_numba": lambda: run_with_numpy_kernels(partial(solve_least_squares, case)),
        "squares_numpy_gn": lambda: speed_peers.solve_by_gauss_newton(raw),
        "squares_scipy": lambda: speed_peers.solve_by_scipy_least_squares(raw),
    }
    worst: dict[str, TimedRun] = {
        "minimax": lambda: solve_minimax_over_targets(case),
        "minimax_slsqp": lambda: speed_peers.solve_minimax_by_slsqp(raw, scale, size),
    }
    if is_peer_installed("casadi"):
        worst["minimax_ipopt"] = speed_peers.build_ipopt_minimax_solver(raw, scale, size)
    split = replace(
        data, columns={**data.columns, "split": np.repeat(["train", "holdout"], [80, 20])}
    )
    whole: dict[str, TimedRun] = {
        "whole": lambda: mc.calibrate(case.robot, split),
        "whole_beyond": lambda: mc.calibrate(case.robot, split).beyond,
        "whole_without_numba": lambda: run_with_numpy_kernels(
            lambda: mc.calibrate(case.robot, split)
        ),
    }
    seconds = (
        time_runs_in_turn(fits, repeats)
        | time_runs_in_turn(worst, 1 if quick else min(repeats, 5))
        | time_runs_in_turn(whole, repeats)
    )
    sums, ends = (
        {"ours": float(case.model.target_costs(solve_least_squares(case)).sum())},
        {"ours": solve_minimax_over_targets(case)},
    )
    for name in ("squares_numpy_gn", "squares_scipy"):
        sums[name] = float((raw.errors_and_jacobian(np.asarray(fits[name]()))[0] ** 2).sum())
    for name in worst.keys() - {"minimax"}:
        ends[name] = float(raw.target_mean_squares(np.asarray(worst[name]()))[0].max())
    check_same_optimum("least squares", sums)
    check_same_optimum("minimax", ends)
    return seconds


def run_with_numpy_kernels(run: TimedRun) -> object:
    """A run with NumPy's kernels."""
    with kernel_choice.use_numpy_kernels_for_brief_work(brief=True):
        return run()


def is_peer_installed(package: str) -> bool:
    """Whether a peer is installed; a word where it is not."""
    found = find_spec(package) is not None
    if not found:
        click.echo(f'{package} is not installed and left out: pip install ".[peers]"', err=True)
    return found


def time_point_minimax(seed: int, point_counts: tuple[int, ...]) -> dict[str, float]:
    """Seconds of the worst point by the number of points, ours and by cones (of many, one run)."""
    out: dict[str, float] = {}
    for count in point_counts:
        case, data = simulate_speed_case(count // 3, seed), simulate_measurements(count // 3, seed)
        begin, kept = solve_least_squares(case), measured_distances(data)
        runs: dict[str, TimedRun] = {
            f"point_{count}": partial(solve_minimax_over_points, case, begin, kept)
        }
        raw = to_raw_arrays(case, data)
        if is_peer_installed("cvxpy"):
            first = speed_peers.solve_by_gauss_newton(raw)
            began = time.process_time()
            end = raw.errors_and_jacobian(speed_peers.solve_point_minimax_by_cones(raw, first))[0]
            out[f"point_{count}_cvxpy"] = time.process_time() - began
            largest = float(np.sqrt((end**2).sum(axis=0)).max())
            check_same_optimum(
                "worst point",
                {"ours": solve_minimax_over_points(case, begin, kept), "cvxpy": largest},
            )
            if count <= 300:
                runs[f"point_{count}_cvxpy"] = partial(
                    speed_peers.solve_point_minimax_by_cones, raw, first
                )
        out |= time_runs_in_turn(runs, 3)
    return out


def simulate_measurements(pose_count: int, seed: int) -> Measurements:
    """The measurements of `simulate_speed_case`."""
    return simulate(load_robot("irb2600"), pose_count, 3, seed).data


def time_calibrate_command(seed: int) -> float:
    """Processor time of `minimax-cal calibrate` on 100 poses, from the start of the process [s]."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "poses.csv"
        mc.write_measurements(path, simulate_measurements(100, seed))
        words = [sys.executable, "-m", "minimax_cal.cli", "calibrate", "irb2600", str(path)]
        times = []
        for _ in range(3):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run(words, check=True, capture_output=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            spent = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
            times.append(spent)
    return min(times)


def simulate_many_poses(pose_count: int, target_count: int, seed: int) -> Measurements:
    """Poses all over the joints' range, made part by part, for their making to take no memory."""
    robot, rng = load_robot("irb2600"), np.random.default_rng(seed)
    arm = simulate(robot, 100, target_count, seed).cell
    q = random_joint_values(robot, (pose_count,), rng)
    y = np.empty((pose_count, target_count, 3))
    for first in range(0, pose_count, 10000):
        part = slice(first, first + 10000)
        y[part] = arm.predict(q[part])
        y[part] += SPEED_COORDINATE_NOISE * rng.normal(size=y[part].shape)
    return mc.measurements(q, y)


def put_calibration_seconds_and_memory(
    pose_count: int, target_count: int, seed: int, answer_queue: Any
) -> None:
    """Put seconds and peak memory [GB] of one calibration; for a process of its own."""
    data = simulate_many_poses(pose_count, target_count, seed)
    mc.calibrate("irb2600", simulate_many_poses(100, target_count, seed))
    began = time.process_time()
    mc.calibrate("irb2600", data)
    spent = time.process_time() - began
    answer_queue.put((spent, peak_memory_gb()))


def peak_memory_gb() -> float:
    """Of this process [GB]; what getrusage tells includes the parent's at the fork."""
    status = Path("/proc/self/status")
    if not status.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    lines = status.read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024**2


def time_calibration_by_size(
    seed: int, sizes: tuple[tuple[int, int], ...]
) -> tuple[dict[str, float], dict[str, float]]:
    """Seconds and peak memory [GB] of a whole calibration by the number of poses and targets."""
    fresh = multiprocessing.get_context("spawn")
    seconds, memory = {}, {}
    for poses, targets in sizes:
        answer = fresh.SimpleQueue()
        job = fresh.Process(
            target=put_calibration_seconds_and_memory, args=(poses, targets, seed, answer)
        )
        job.start()
        job.join()
        if job.exitcode:
            raise click.ClickException(f"{poses} poses: the process ended with {job.exitcode}")
        name = f"{poses}x{targets}"
        seconds[f"calibrate_{name}"], memory[name] = answer.get()
    return seconds, memory


def time_bootstraps(seed: int) -> dict[str, float]:
    """Seconds of 500 replicates."""
    robot, data = load_robot("irb2600"), simulate_measurements(100, seed)
    return time_runs_in_turn(
        {
            f"bootstrap_500_{objective}": partial(
                mc.bootstrap, mc.calibrate(robot, data, objective)
            )
            for objective in ("minimax", "sum")
        },
        1,
    )


def time_diagnoses_by_size(seed: int, sizes: tuple[tuple[int, int], ...]) -> dict[str, float]:
    """Seconds of a diagnosis by the number of poses and targets."""
    robot, out = load_robot("irb2600"), {}
    mc.diagnose(
        robot, simulate_measurements(60, seed), quick=True
    )  # loads what is imported when it is used
    for poses, targets in sizes:
        more = simulate(robot, poses, targets, seed).data
        began = time.process_time()
        mc.diagnose(robot, more)
        out[f"diagnose_{poses}x{targets}"] = time.process_time() - began
    return out


def time_real_like_diagnosis(seed: int) -> dict[str, float]:
    """Seconds of a diagnosis of 600 poses of an arm with many laws, whole and quick."""
    robot, out = load_robot("irb2600"), {}
    bare = simulate(robot, 600, 3, seed)
    laws = Fitted.from_pairs((term, np.array(values)) for term, values in REAL_LIKE_EFFECT_TERMS)
    history = add_history_columns(bare.data)
    moved = replace(bare.cell, effects=laws).follow(history) - bare.cell.follow(history)
    data = bare.data.with_y(bare.data.y + moved)
    for name, quick in (("like_real", False), ("like_real_quick", True)):
        began = time.process_time()
        mc.diagnose(robot, data, quick=quick)
        out[f"diagnose_{name}"] = time.process_time() - began
    return out


SPEED_RATIOS = {  # name: the peer, ours, in words
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
TIME_DESCRIPTIONS = {  # of times by name
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
SIZED_TIME_DESCRIPTIONS = (  # of times whose names have a size
    (r"point_(\d+)", r"worst of \1 points, from the least squares"),
    (r"point_(\d+)_cvxpy", r"worst of \1 points by cvxpy"),
    (r"bootstrap_500_(\w+)", r"bootstrap of 500, \1"),
    (r"calibrate_(\d+)x(\d+)", r"`mc.calibrate`, poses x targets: \1 x \2"),
    (r"diagnose_(\d+)x(\d+)", r"a diagnosis with its folds, poses x targets: \1 x \2"),
)


def describe_time(time_name: str) -> str:
    """What a time is of."""
    for pattern, words in SIZED_TIME_DESCRIPTIONS:
        if found := re.fullmatch(pattern, time_name):
            return found.expand(words)
    return TIME_DESCRIPTIONS[time_name]


def peer_time_ratios(seconds: Mapping[str, float]) -> dict[str, float | None]:
    """The peers' times over ours; None for a peer that is not there."""
    return {
        name: seconds[peer] / seconds[ours] if peer in seconds else None
        for name, (peer, ours, _) in SPEED_RATIOS.items()
        if ours in seconds
    }


def time_all_parts(
    seed: int, repeats: int, parts: tuple[str, ...], *, quick: bool
) -> tuple[dict[str, float], dict[str, float]]:
    """Seconds of everything by name, and peak memory [GB] by poses x targets."""
    seconds: dict[str, float] = {}
    memory: dict[str, float] = {}
    sizes = ((1000, 3), (10000, 1)) if quick else ((1000, 3), (100000, 1), (1000000, 1))
    cases = ((100, 3),) if quick else ((100, 3), (600, 3), (1200, 1), (2000, 3))
    if "races" in parts:
        seconds |= time_100_pose_fits(seed, 3 if quick else repeats, quick=quick)
    if "points" in parts:
        seconds |= time_point_minimax(seed, (300, 3000) if quick else (300, 3000, 30000))
    if "bootstrap" in parts:
        seconds |= time_bootstraps(seed)
    if "command" in parts:
        seconds["command"] = time_calibrate_command(seed)
    if "growth" in parts:
        grown, memory = time_calibration_by_size(seed, sizes)
        seconds |= grown
    if "diagnosis" in parts:
        seconds |= time_diagnoses_by_size(seed, cases)
        seconds |= {} if quick else time_real_like_diagnosis(seed)
    return seconds, memory


@study_options("speed")
@click.option("--repeats", type=int, default=9, show_default=True)
@click.option(
    "--part", multiple=True, type=click.Choice(SPEED_PARTS), help="These alone  [default: all]"
)
def main(study: Study, repeats: int, part: tuple[str, ...]) -> None:
    """Ratios of our fits to their peers.

    Times are compared, so the runs go one after the other: --jobs and --cluster do not apply.
    """
    with threadpool_limits(1):
        seconds, memory = time_all_parts(
            study.seed, repeats, part or SPEED_PARTS, quick=study.quick
        )
    over = peer_time_ratios(seconds)
    machine = f"{processor_name()}, kernels: {kernel_choice.active_kernels().__name__}"
    numba = kernel_choice.active_kernels() is not plain
    shown = tuple(
        (f"`{k}`", math.nan if v is None else v, SPEED_RATIOS[k][2]) for k, v in over.items()
    )
    spent = tuple((describe_time(name), 1e3 * value) for name, value in seconds.items())
    tables = [
        Table.from_rows("the peer's time over ours", shown, "ratio | times .1f | of what"),
        Table.from_rows(f"processor time ({machine})", spent, "what | ms .2f"),
        Table.from_rows(
            "peak memory of a whole calibration", memory.items(), "poses x targets | GB .2f"
        ),
    ]
    content = {"ratios": over, "seconds": seconds, "memory_gb": memory, "numba": numba}
    study.save(tables, content, packages=("numba", "casadi", "cvxpy", "daqp"))
