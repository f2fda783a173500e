"""From how far the four least-squares methods converge: paper S, Table 2 and Fig. 3.

    python -m experiments.convergence [--quick] [--out FOLDER] ...

A simulated IRB 2600, 60 random configurations, one target; measurement noise, errors of all
parameters and of the transmissions.  3969 starts: theta_2 and alpha_3 off by -3.1 ... 3.1 rad on a
grid, base and target at their identity and origin, everything else nominal.  The paper prints
neither the true base nor the sizes of its errors, nor its unit of length, nor the rule of its
damping; here the base is turned about a random axis and the errors are those of
`ConvergenceSetting`, and damping is Marquardt's.

Every method runs to the letter on the paper's parameters (all, redundant ones included,
pseudo-inverse) in millimetres, those without separation in metres too: there the unit matters.  The
library's separable methods run on the identifiable parameters.  Redundant parameters amplify
rounding, so that some starts run once more, moved by no more than that.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import click
import numpy as np

from experiments import pseudo_inverse
from experiments.pseudo_inverse import MACHINE_EPSILON
from experiments.speed import identify_parameters
from experiments.study_record import new_figure
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table, TableCell
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.modelling.global_start import search_base_rotations
from minimax_cal.modelling.parameters import ParameterValues, flatten_link_parameters
from minimax_cal.modelling.point_model import PointLeastSquares, PointModel
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import LEAST_SQUARES_METHODS, LeastSquaresLimits
from minimax_cal.solvers.status import Status

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER_S_METHODS = ("nlgn", "nllm", "snlgn", "snllm")
LENGTH_UNITS_PER_METRE = {"all, mm": 1e3, "all, m": 1.0}  # the paper's parameters: units a metre
MAX_PAPER_ITERATIONS = 10_000
MAX_CONVERGED_POINT_MOTION = (
    1e-9  # motion of a point at which the library's iteration has ended [m]
)
MAX_CONVERGED_STEP_LENGTH = (
    1e-6  # length of a step, in the units chosen, at which the paper's has ended
)
FIRST_MARQUARDT_DAMPING, MARQUARDT_DAMPING_FACTOR = (
    1e-2,
    10.0,
)  # Marquardt's first damping and factor, as MATLAB's lsqnonlin has them
MAX_SAME_MINIMUM_RATIO = 1.0 + 1e-6  # a cost up to this factor above the least one is the minimum
STARTS_PER_JOB = 32  # starts solved together
METHOD_VARIANTS = (  # parameters and unit, and the methods that run on them
    *(("all, mm", method) for method in PAPER_S_METHODS),
    *(("all, m", method) for method in ("nlgn", "nllm")),
    *(("identifiable", method) for method in ("snlgn", "snllm")),
)
ROUNDING_START_STRIDE = (
    3  # of all starts each so many-th both ways runs once more, moved by rounding
)
QUICK_START_STRIDE = (
    21  # of the starts, each so many-th both ways with --quick: too few for a verdict
)
PAPER_S_TABLE_2 = {  # iterations, RMS mm, seconds, converged %, to the minimum %
    "nlgn": (144.15, 77.579, 5.933, 92.89, 74.35),
    "nllm": (4595.27, 1.493, 33.931, 68.98, 68.98),
    "snlgn": (13.94, 1.493, 0.927, 100.0, 100.0),
    "snllm": (26.90, 1.493, 1.874, 100.0, 100.0),
}


# ---- starts and how they end ---------------------------------------------------------------------


@dataclass(frozen=True)
class ConvergenceSetting:
    """What is measured: poses, seed, base angle [rad], standard deviations, transmission error.

    transmission: amplitude of a once-a-turn error of every joint [rad]; it sets the RMS at the
    minimum, about the paper's 1.5 mm.  span: joints turn so far to either side of zero [rad].
    """

    seed: int = 0
    poses: int = 60
    base_angle: float = 0.3
    length: float = 0.5e-3
    angle: float = 1.0e-3
    noise: float = 20e-6
    transmission: float = 3.0e-3
    span: float = 1.0


def simulate_measurements(setting: ConvergenceSetting) -> tuple[Robot, Measurements]:
    """The simulated measurements of a setting."""
    robot = load_robot("irb2600")
    truth = Truth(setting.length, setting.angle, 0.0, 0.0, 0.0, span=setting.span)
    made = simulate(robot, setting.poses, 1, setting.seed, truth)
    rng = np.random.default_rng(setting.seed + 1)
    axis = rng.normal(size=3)
    base = np.eye(4)
    base[:3, :3] = kinematics.rotation_from_vector(setting.base_angle * axis / np.linalg.norm(axis))
    base[:3, 3] = rng.normal(size=3)
    turned = base @ np.linalg.inv(made.cell.base)
    q = made.data.q
    gear = setting.transmission * np.sin(q + rng.uniform(0, 2 * np.pi, 6))
    y = made.cell.predict(q + gear) @ turned[:3, :3].T + turned[:3, 3]
    return robot, measurements(q, y + setting.noise * rng.normal(size=y.shape))


@dataclass(frozen=True)
class ConvergenceJob:
    """Some starts of one method: deviations of theta_2 and alpha_3.

    parameters: identifiable, by the library, or one of UNITS, by the paper's own way.  moved:
    whether each value of a start is moved by a unit of rounding, at random.
    """

    setting: ConvergenceSetting
    method: str
    parameters: str
    theta: tuple[float, ...]
    alpha: tuple[float, ...]
    cap: int = MAX_PAPER_ITERATIONS
    moved: bool = False


@dataclass(frozen=True)
class ConvergenceOutcome:
    """How each start of a job ended: iterations, cost [m^2], converged; and the time of all [s]."""

    iterations: tuple[int, ...]
    cost: tuple[float, ...]
    converged: tuple[bool, ...]
    seconds: float


def start_deviations(stride: int) -> tuple[Array, Array]:
    """All (theta, alpha) deviations on every n-th point of the paper's grid, flattened."""
    steps = np.round(np.arange(-31, 32)[(31 % stride) :: stride] * 0.1, 10)
    theta, alpha = np.meshgrid(steps, steps, indexing="ij")
    return theta.ravel(), alpha.ravel()


@lru_cache(maxsize=8)
def build_identifiable_model(setting: ConvergenceSetting) -> tuple[Robot, PointModel]:
    """The model with its identifiable parameters free."""
    robot, data = simulate_measurements(setting)
    return robot, identify_parameters(robot, data)[0]


def build_paper_starts(
    robot: Robot, theta_deviations: tuple[float, ...], alpha_deviations: tuple[float, ...]
) -> ParameterValues:
    """The paper's starts: base and target at identity and origin."""
    count = len(theta_deviations)
    mdh = np.repeat(robot.mdh[None], count, axis=0)
    mdh[:, 1, kinematics.THETA] += theta_deviations
    mdh[:, 2, kinematics.ALPHA] += alpha_deviations
    eye = np.repeat(np.eye(3)[None], count, axis=0)
    return ParameterValues(mdh, eye, np.zeros((count, 3)), np.zeros((count, 1, 3)))


def global_minimum_cost(setting: ConvergenceSetting) -> float:
    """The global minimum, from our own search from the nominal geometry."""
    robot, model = build_identifiable_model(setting)
    return float(
        search_base_rotations(model, robot.mdh, float(model.pose_counts_by_target.sum())).cost[0]
    )


def run_starts(job: ConvergenceJob) -> ConvergenceOutcome:
    """Solve from every start of a job."""
    robot, model = build_identifiable_model(job.setting)
    if job.parameters in LENGTH_UNITS_PER_METRE:
        return run_paper_method(job, robot, model)
    began = time.perf_counter()
    with np.errstate(all="ignore"):  # undamped steps may diverge to infinity: that is the finding
        found = least_squares.solve(
            PointLeastSquares(model),
            build_paper_starts(robot, job.theta, job.alpha),
            len(job.theta),
            float(model.pose_counts_by_target.sum()),
            LEAST_SQUARES_METHODS[job.method],
            LeastSquaresLimits(MAX_CONVERGED_POINT_MOTION, job.cap),
            keep_trace=False,
        )
    return ConvergenceOutcome(
        tuple(int(i) for i in found.iterations),
        tuple(float(c) for c in found.cost),
        tuple(status is Status.CONVERGED for status in found.status),
        time.perf_counter() - began,
    )


def run_paper_method(job: ConvergenceJob, robot: Robot, model: PointModel) -> ConvergenceOutcome:
    """The paper's own way, one start after the other."""
    iterations, costs, converged = [], [], []
    begins = [paper_start_vector(robot, t, a) for t, a in zip(job.theta, job.alpha, strict=True)]
    if job.moved:
        rng = np.random.default_rng(0)
        begins = [perturb_by_rounding(x, rng) for x in begins]
    # compiling does not count
    run_paper_iteration(job.method, job.parameters, model, begins[0], 1)
    began = time.perf_counter()
    for begin in begins:
        count, cost, ended, _ = run_paper_iteration(
            job.method, job.parameters, model, begin, job.cap
        )
        iterations.append(count)
        costs.append(cost)
        converged.append(ended == pseudo_inverse.ENDED_CONVERGED)
    seconds = time.perf_counter() - began
    return ConvergenceOutcome(tuple(iterations), tuple(costs), tuple(converged), seconds)


def perturb_by_rounding(start: Array, rng: np.random.Generator) -> Array:
    """A start, each value of it moved by a unit of rounding or not."""
    return np.asarray(start * (1.0 + MACHINE_EPSILON * rng.integers(-1, 2, start.size)))


def paper_start_vector(
    robot: Robot, theta_deviation: float = 0.0, alpha_deviation: float = 0.0
) -> Array:
    """The paper's start as `pseudo_inverse` takes it [m, rad]: base I(4), target 0, two angles off.

    theta_deviation, alpha_deviation: deviations of theta_2 and alpha_3 [rad].
    """
    mdh = robot.mdh.copy()
    mdh[1, kinematics.THETA] += theta_deviation
    mdh[2, kinematics.ALPHA] += alpha_deviation
    return np.concatenate([flatten_link_parameters(mdh), np.zeros(9)])


def run_paper_iteration(
    method: str,
    parameters: str,
    model: PointModel,
    start_vector: Array,
    max_iterations: int,
    recorded_iterations: int = 0,
) -> tuple[int, float, int, Array]:
    """Iterations, cost [m^2], how it ended, and the costs of the first iterates (course,) [m^2].

    One of PAPER on one of UNITS, on the first target of a model.
    """
    unit = LENGTH_UNITS_PER_METRE[parameters]
    scale = np.where(model.names.linear_mask, unit, 1.0)
    damping = FIRST_MARQUARDT_DAMPING if LEAST_SQUARES_METHODS[method].damped else 0.0
    costs = np.full(recorded_iterations, np.nan)
    y, q = unit * model.y[0].ravel(), np.ascontiguousarray(model.q)
    with np.errstate(all="ignore"):
        count, cost, ended = pseudo_inverse.iterate_to_the_letter(
            start_vector * scale,
            q,
            y,
            LEAST_SQUARES_METHODS[method].separable,
            damping,
            MARQUARDT_DAMPING_FACTOR,
            MAX_CONVERGED_STEP_LENGTH,
            max_iterations,
            costs,
        )
    return int(count), float(cost) / unit**2, int(ended), costs / unit**2


# ---- Table 2 -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class ConvergenceRow:
    """One method on one set of parameters over the grid (all starts, in the grid's order)."""

    method: str
    parameters: str
    every: int
    iterations: Array
    rms_mm: Array
    converged: Array
    minimum: Array
    seconds: float

    def to_table_cells(self) -> tuple[TableCell, ...]:
        """As a line of Table 2; averages leave out the starts that do not converge."""
        kept = self.converged
        return (
            self.method.upper(),
            self.parameters,
            len(kept),
            float(self.iterations[kept].mean()) if kept.any() else np.nan,
            float(self.rms_mm[kept].mean()) if kept.any() else np.nan,
            1e3 * self.seconds / len(kept),
            100.0 * float(kept.mean()),
            100.0 * float(self.minimum.mean()),
        )


def run_method_on_grid(
    study: Study,
    setting: ConvergenceSetting,
    least_cost: float,
    method: str,
    parameters: str,
    stride: int,
    max_iterations: int,
    perturbed: bool = False,
) -> ConvergenceRow:
    """All starts of one method on one set of parameters.  least_cost: cost of the minimum [m^2]."""
    theta, alpha = (value.tolist() for value in start_deviations(stride))
    jobs = [
        ConvergenceJob(
            setting,
            method,
            parameters,
            tuple(theta[i : i + STARTS_PER_JOB]),
            tuple(alpha[i : i + STARTS_PER_JOB]),
            max_iterations,
            perturbed,
        )
        for i in range(0, len(theta), STARTS_PER_JOB)
    ]
    found = study.sweep(run_starts, jobs, f"{method}, {parameters}, every {stride}")
    iterations, cost, converged = (
        np.concatenate([getattr(one, name) for one in found])
        for name in ("iterations", "cost", "converged")
    )
    rms, minimum = (
        1e3 * np.sqrt(cost / setting.poses),
        converged & (cost <= least_cost * MAX_SAME_MINIMUM_RATIO),
    )
    seconds = sum(one.seconds for one in found)
    return ConvergenceRow(method, parameters, stride, iterations, rms, converged, minimum, seconds)


CONVERGENCE_COLUMNS = (
    "method | parameters | starts d | iterations .2f | RMS mm .3f | ms a start .2f | "
    "converged % .2f | to the minimum % .2f"
)


def build_table_2(rows: Sequence[ConvergenceRow], setting: ConvergenceSetting) -> Table:
    """Paper S, Table 2: ours beside theirs."""
    theirs = [
        (f"{method.upper()} (paper)", "all", 3969, *values[:2], 1e3 * values[2], *values[3:])
        for method, values in PAPER_S_TABLE_2.items()
    ]
    return Table.from_rows(
        f"convergence from off starts (base turned by {setting.base_angle:g} rad, poses within "
        f"{setting.span:g} rad, noise {1e6 * setting.noise:g} um, errors {1e3 * setting.length:g} "
        f"mm and {1e3 * setting.angle:g} mrad, transmission {1e3 * setting.transmission:g} mrad)",
        (*(row.to_table_cells() for row in rows), *theirs),
        CONVERGENCE_COLUMNS,
    )


@dataclass(frozen=True)
class RoundingEffect:
    """Shares of the starts of one method before and after they are moved by rounding [%].

    otherwise: which end otherwise: not converged, in the minimum, or converged elsewhere.
    """

    method: str
    starts: int
    converged: tuple[float, float]
    minimum: tuple[float, float]
    otherwise: float


def compare_with_perturbed_starts(
    row: ConvergenceRow, perturbed_row: ConvergenceRow
) -> RoundingEffect:
    """A row beside the same starts moved, of which there may be fewer."""
    place = {
        pair: i for i, pair in enumerate(zip(*map(tuple, start_deviations(row.every)), strict=True))
    }
    same = [
        place[pair] for pair in zip(*map(tuple, start_deviations(perturbed_row.every)), strict=True)
    ]
    differ = (row.converged[same] != perturbed_row.converged) | (
        row.minimum[same] != perturbed_row.minimum
    )
    return RoundingEffect(
        row.method,
        len(same),
        (100.0 * float(row.converged[same].mean()), 100.0 * float(perturbed_row.converged.mean())),
        (100.0 * float(row.minimum[same].mean()), 100.0 * float(perturbed_row.minimum.mean())),
        100.0 * float(differ.mean()),
    )


def build_rounding_table(rounding_effects: Sequence[RoundingEffect]) -> Table:
    """What rounding does to Table 2."""
    return Table.from_rows(
        "all, mm: the same starts, each value moved by a unit of rounding (relative 2e-16) or none",
        (
            (m.method.upper(), m.starts, *m.converged, *m.minimum, m.otherwise)
            for m in rounding_effects
        ),
        "method | starts d | converged % .2f | moved % .2f | to the minimum % .2f | "
        "moved, % .2f | end otherwise % .2f",
    )


def build_separable_methods_table(
    study: Study, settings: Sequence[tuple[float, ConvergenceSetting]], stride: int, columns: str
) -> Table:
    """How many starts, and which share of them SNLGN and SNLLM bring to the minimum [%]."""
    rows = []
    for first, setting in settings:
        for angle in (0.0, 0.5):
            other = replace(setting, base_angle=angle)
            least, shares = global_minimum_cost(other), list[float]()
            for method in ("snlgn", "snllm"):
                row = run_method_on_grid(study, other, least, method, "identifiable", stride, 500)
                shares.append(100.0 * float(row.minimum.mean()))
            rows.append((first, angle, len(row.minimum), *shares))
    title = (
        "separable methods on the identifiable parameters, from the paper's start: share of starts "
        "that reach the minimum"
    )
    return Table.from_rows(title, rows, columns)


def build_joint_range_table(study: Study, setting: ConvergenceSetting, stride: int) -> Table:
    """Where the claim of global convergence ends: wider poses have other minima."""
    spans = (1.0,) if study.quick else (0.5, 1.0, 1.5, 2.0, np.pi)
    return build_separable_methods_table(
        study, [(span, replace(setting, span=span)) for span in spans], stride,
        "poses within rad .2f | base turned rad .1f | starts d | SNLGN % .1f | SNLLM % .1f",
    )  # fmt: skip


def build_seed_table(study: Study, setting: ConvergenceSetting, stride: int) -> Table:
    """The separable methods on other simulated arms and poses: how safe the claim is."""
    seeds = range(setting.seed, setting.seed + (2 if study.quick else 4))
    return build_separable_methods_table(
        study, [(seed, replace(setting, seed=seed)) for seed in seeds], max(stride, 2),
        "seed d | base turned rad .1f | starts d | SNLGN % .2f | SNLLM % .2f",
    )  # fmt: skip


def draw_rms_map(rows: Sequence[ConvergenceRow]) -> Figure:
    """Paper S, Fig. 3: RMS at the end over the grid of deviations, a panel a method."""
    from matplotlib.colors import LogNorm

    figure = new_figure(4.2 * len(rows), 4)
    panels = np.atleast_1d(figure.subplots(1, len(rows), sharey=True))
    for axes, row in zip(panels, rows, strict=True):
        theta, alpha = start_deviations(row.every)
        side = len(np.unique(theta))
        values = np.where(row.converged, row.rms_mm, np.nan).reshape(side, side)
        known = values[np.isfinite(values)] if np.isfinite(values).any() else np.ones(1)
        least = max(known.min(), 1e-3)
        norm = LogNorm(least, max(known.max(), 10.0 * least))
        edge = (alpha.min(), alpha.max(), theta.min(), theta.max())
        image = axes.imshow(values, origin="lower", extent=edge, norm=norm, cmap="viridis")
        axes.set(title=f"{row.method.upper()}, {row.parameters}", xlabel="alpha_3 off by (rad)")
        figure.colorbar(image, ax=axes, label="RMS mm", shrink=0.8)
    panels[0].set_ylabel("theta_2 off by (rad)")
    return figure


@dataclass(frozen=True)
class ConvergenceResults:
    """Table 2, what rounding does to it, and the arm it is of."""

    rows: list[ConvergenceRow]
    moved: list[RoundingEffect]
    setting: ConvergenceSetting


def run_all_cases(study: Study, stride: int = 1) -> ConvergenceResults:
    """Every variant on each so many-th of the starts, both ways."""
    setting = ConvergenceSetting(seed=study.seed + 1)
    row = partial(run_method_on_grid, study, setting, global_minimum_cost(setting))
    cap, stride, some = (
        (100, QUICK_START_STRIDE, QUICK_START_STRIDE)
        if study.quick
        else (MAX_PAPER_ITERATIONS, stride, ROUNDING_START_STRIDE if stride == 1 else stride)
    )
    rows = [row(method, parameters, stride, cap) for parameters, method in METHOD_VARIANTS]
    firsts = [row for row in rows if row.parameters == "all, mm"]
    again = [
        compare_with_perturbed_starts(one, row(one.method, one.parameters, some, cap, True))
        for one in firsts
    ]
    return ConvergenceResults(rows, again, setting)


def save_results(study: Study, results: ConvergenceResults) -> None:
    """Table 2, and how the claim of global convergence fares on other arms and wider poses."""
    rows, setting = results.rows, results.setting
    first = build_table_2(rows, setting)
    more = [
        build_rounding_table(results.moved),
        build_seed_table(study, setting, QUICK_START_STRIDE if study.quick else 3),
        build_joint_range_table(study, setting, QUICK_START_STRIDE if study.quick else 7),
    ]
    names = [name.replace(" ", "_").replace("%", "percent") for name in first.header]
    content = {
        "rows": [dict(zip(names, row.to_table_cells(), strict=True)) for row in rows],
        "least_rms_mm": float(1e3 * np.sqrt(global_minimum_cost(setting) / setting.poses)),
    }
    figures = {
        f"rms_{name.replace(', ', '_')}": draw_rms_map(
            [row for row in rows if row.parameters == name]
        )
        for name in dict.fromkeys(row.parameters for row in rows)
    }
    study.save([first, *more], content, figures)


stride_option = click.option(
    "--every", type=click.IntRange(1), default=1, show_default=True,
    help="Of the 63 x 63 starts of Table 2 each N-th, both ways.",
)  # fmt: skip


@study_options("convergence")
@stride_option
def main(study: Study, every: int) -> None:
    """Convergence of NLGN, NLLM, SNLGN, SNLLM from off starts: paper S, Table 2, Fig. 3."""
    save_results(study, run_all_cases(study, every))
