"""From how far the four least-squares methods converge: paper S, Table 2 and Fig. 3-5.

    python -m experiments.convergence [--quick] [--full] [--base-angle RAD] [--out FOLDER] ...

IRB 2600, 60 random configurations, one target; measurement noise, errors of all parameters and of
the transmissions.  Starts: theta_2 and alpha_3 off by -3.1 ... 3.1 rad on a grid, base and target
at their identity and origin, everything else nominal.  The paper prints neither the true base nor
the sizes of its errors; here the base is turned by --base-angle about a random axis and the errors
are those of `Setting`.  Every method runs on the paper's parameters (all, redundant ones included,
pseudo-inverse) and on the identifiable ones.  The methods without separation take up to 10000
iterations a start and run on every third grid point unless --full is given.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import click
import numpy as np

from experiments import pseudo_inverse, sweep
from experiments.speed import identified
from experiments.sweep import Study, study_options
from minimax_cal.fitting.start import search
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.files import plain
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.modelling.model import Model, SumOfSquares
from minimax_cal.modelling.parameters import State
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import METHODS, Limits
from minimax_cal.solvers.status import Status

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER = ("nlgn", "nllm", "snlgn", "snllm")
SETS = ("identifiable", "all")
PAPERS_TABLE = {  # iterations, RMS mm, seconds, converged %, to the minimum %
    "nlgn": (144.15, 77.579, 5.933, 92.89, 74.35),
    "nllm": (4595.27, 1.493, 33.931, 68.98, 68.98),
    "snlgn": (13.94, 1.493, 0.927, 100.0, 100.0),
    "snllm": (26.90, 1.493, 1.874, 100.0, 100.0),
}
CAP = 10_000
STEP = 1e-9  # motion of a point at which the iteration has ended [m]
SAME = 1.0 + 1e-6  # a cost up to this factor above the least one is the minimum
CHUNK = 32  # starts solved together


@dataclass(frozen=True)
class Setting:
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


def measured(setting: Setting) -> tuple[Robot, Measurements]:
    """The simulated measurements of a setting."""
    robot = load_robot("irb2600")
    truth = Truth(setting.length, setting.angle, 0.0, 0.0, 0.0, span=setting.span)
    made = simulate(robot, setting.poses, 1, setting.seed, truth)
    rng = np.random.default_rng(setting.seed + 1)
    axis = rng.normal(size=3)
    base = np.eye(4)
    base[:3, :3] = kinematics.rotation(setting.base_angle * axis / np.linalg.norm(axis))
    base[:3, 3] = rng.normal(size=3)
    turned = base @ np.linalg.inv(made.cell.base)
    q = made.data.q
    gear = setting.transmission * np.sin(q + rng.uniform(0, 2 * np.pi, 6))
    y = made.cell.predict(q + gear) @ turned[:3, :3].T + turned[:3, 3]
    return robot, measurements(q, y + setting.noise * rng.normal(size=y.shape))


@dataclass(frozen=True)
class Job:
    """Some starts of one method on one set of parameters: deviations of theta_2 and alpha_3."""

    setting: Setting
    method: str
    parameters: str
    theta: tuple[float, ...]
    alpha: tuple[float, ...]
    cap: int = CAP


@dataclass(frozen=True)
class Outcome:
    """How each start of a job ended: iterations, cost [m^2], converged; and the time of all [s]."""

    iterations: tuple[int, ...]
    cost: tuple[float, ...]
    converged: tuple[bool, ...]
    seconds: float


@lru_cache(maxsize=8)
def problem_of(setting: Setting, parameters: str) -> tuple[Robot, Model]:
    """The model with its free parameters."""
    robot, data = measured(setting)
    model, _ = identified(robot, data)
    every = np.ones(model.names.count, dtype=bool)
    return robot, model if parameters == "identifiable" else model.only(every)


def starts_of(robot: Robot, theta: tuple[float, ...], alpha: tuple[float, ...]) -> State:
    """The paper's starts: base and target at identity and origin."""
    count = len(theta)
    mdh = np.repeat(robot.mdh[None], count, axis=0)
    mdh[:, 1, kinematics.THETA] += theta
    mdh[:, 2, kinematics.ALPHA] += alpha
    eye = np.repeat(np.eye(3)[None], count, axis=0)
    return State(mdh, eye, np.zeros((count, 3)), np.zeros((count, 1, 3)))


def run(job: Job) -> Outcome:
    """Solve from every start of a job."""
    robot, model = problem_of(job.setting, job.parameters)
    begin = starts_of(robot, job.theta, job.alpha)
    began = time.perf_counter()
    if job.parameters == "all":
        return by_pseudo_inverse(job, model, begin)
    with np.errstate(all="ignore"):  # undamped steps may diverge to infinity: that is the finding
        found = least_squares.solve(
            SumOfSquares(model),
            begin,
            len(job.theta),
            float(model.counts.sum()),
            METHODS[job.method],
            Limits(STEP, job.cap),
            trace=False,
        )
    return Outcome(
        tuple(int(i) for i in found.iterations),
        tuple(float(c) for c in found.cost),
        tuple(status is Status.CONVERGED for status in found.status),
        time.perf_counter() - began,
    )


def by_pseudo_inverse(job: Job, model: Model, begin: State) -> Outcome:
    """The paper's own way, one start after the other."""
    began = time.perf_counter()
    with np.errstate(all="ignore"):
        ended = [
            pseudo_inverse.solve(model, begin.take(np.array(i)), METHODS[job.method], STEP, job.cap)
            for i in range(len(job.theta))
        ]
    return Outcome(
        tuple(end.iterations for end in ended),
        tuple(end.cost for end in ended),
        tuple(end.converged for end in ended),
        time.perf_counter() - began,
    )


def grid(every: int) -> tuple[Array, Array]:
    """All (theta, alpha) deviations on every n-th point of the paper's grid, flattened."""
    steps = np.round(np.arange(-31, 32)[(31 % every) :: every] * 0.1, 10)
    theta, alpha = np.meshgrid(steps, steps, indexing="ij")
    return theta.ravel(), alpha.ravel()


def jobs_of(setting: Setting, method: str, parameters: str, every: int, cap: int) -> list[Job]:
    """The grid cut into jobs."""
    theta, alpha = grid(every)
    return [
        Job(setting, method, parameters, tuple(theta[i : i + CHUNK].tolist()),
            tuple(alpha[i : i + CHUNK].tolist()), cap)
        for i in range(0, len(theta), CHUNK)
    ]  # fmt: skip


def least_cost(setting: Setting) -> float:
    """The global minimum, from our own search from the nominal geometry."""
    robot, model = problem_of(setting, "identifiable")
    return float(search(model, robot.mdh, float(model.counts.sum())).cost[0])


def outcomes(study: Study, setting: Setting, method: str, parameters: str, every: int,
             cap: int) -> list[Outcome]:  # fmt: skip
    """All starts of one method on one set of parameters."""
    jobs = jobs_of(setting, method, parameters, every, cap)
    return study.sweep(run, jobs, f"{method}, {parameters}, every {every}")


@dataclass(frozen=True)
class Row:
    """One method on one set of parameters over the grid (all starts, in the grid's order)."""

    method: str
    parameters: str
    every: int
    iterations: Array
    rms_mm: Array
    converged: Array
    minimum: Array
    seconds: float

    def cells(self) -> tuple[Cell, ...]:
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


def row_of(found: Sequence[Outcome], method: str, parameters: str, every: int, least: float,
           poses: int) -> Row:  # fmt: skip
    """The outcomes of all jobs as one row."""
    cost = np.concatenate([o.cost for o in found])
    converged = np.concatenate([o.converged for o in found]).astype(bool)
    return Row(
        method,
        parameters,
        every,
        np.concatenate([o.iterations for o in found]),
        1e3 * np.sqrt(cost / poses),
        converged,
        converged & (cost <= least * SAME),
        sum(o.seconds for o in found),
    )


HEADER = ("method", "parameters", "starts", "iterations", "RMS mm", "ms a start", "converged %",
          "to the minimum %")  # fmt: skip
FORMATS = ("", "", "d", ".2f", ".3f", ".2f", ".2f", ".2f")


def table_2(rows: Sequence[Row], setting: Setting) -> Table:
    """Paper S, Table 2: ours beside theirs."""
    theirs = [
        (f"{method.upper()} (paper)", "all", 3969, *values[:2], 1e3 * values[2], *values[3:])
        for method, values in PAPERS_TABLE.items()
    ]
    return Table(
        f"convergence from off starts (base turned by {setting.base_angle:g} rad, poses within "
        f"{setting.span:g} rad, noise {1e6 * setting.noise:g} um, errors {1e3 * setting.length:g} "
        f"mm and {1e3 * setting.angle:g} mrad, transmission {1e3 * setting.transmission:g} mrad)",
        HEADER,
        (*(row.cells() for row in rows), *theirs),
        FORMATS,
    )


def separable_shares(study: Study, setting: Setting, every: int) -> tuple[int, float, float]:
    """How many starts, and which share of them SNLGN and SNLLM bring to the minimum [%]."""
    least = least_cost(setting)
    rows = [
        row_of(
            outcomes(study, setting, method, "identifiable", every, 500),
            method,
            "identifiable",
            every,
            least,
            setting.poses,
        )
        for method in ("snlgn", "snllm")
    ]
    gauss_newton, levenberg = (100.0 * float(row.minimum.mean()) for row in rows)
    return len(rows[0].minimum), gauss_newton, levenberg


def span_table(study: Study, setting: Setting, every: int) -> Table:
    """Where the claim of global convergence ends: wider poses have other minima."""
    rows: list[tuple[Cell, ...]] = []
    for span in (0.5, 1.0, 1.5, 2.0, np.pi):
        for angle in (0.0, 0.5):
            wider = replace(setting, span=span, base_angle=angle)
            rows.append((span, angle, *separable_shares(study, wider, every)))
    return Table(
        "separable methods on the identifiable parameters, from the paper's start: share of starts "
        "that reach the minimum",
        ("poses within rad", "base turned rad", "starts", "SNLGN %", "SNLLM %"),
        tuple(rows),
        (".2f", ".1f", "d", ".1f", ".1f"),
    )


def seed_table(study: Study, setting: Setting, every: int) -> Table:
    """The separable methods on other simulated arms and poses: how safe the claim is."""
    rows: list[tuple[Cell, ...]] = []
    for seed in range(setting.seed, setting.seed + (2 if study.quick else 4)):
        for angle in (0.0, 0.5):
            other = replace(setting, seed=seed, base_angle=angle)
            rows.append((seed, angle, *separable_shares(study, other, max(every, 2))))
    return Table(
        "separable methods on the identifiable parameters, other simulated arms: share of starts "
        "that reach the minimum",
        ("seed", "base turned rad", "starts", "SNLGN %", "SNLLM %"),
        tuple(rows),
        ("d", ".1f", "d", ".2f", ".2f"),
    )


def maps(rows: Sequence[Row], what: str) -> Figure:
    """Paper S, Fig. 3-5: a value over the grid of deviations, a panel a method."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(rows), 4), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(rows), sharey=True))
    for axes, row in zip(panels, rows, strict=True):
        theta, alpha = grid(row.every)
        side = len(np.unique(theta))
        values = (row.iterations if what == "iterations" else row.rms_mm).reshape(side, side)
        values = np.where(row.converged.reshape(side, side), values, np.nan)
        known = values[np.isfinite(values)] if np.isfinite(values).any() else np.ones(1)
        norm = LogNorm(max(known.min(), 1e-3), max(known.max(), 1e-3) * 1.0001)
        edge = (alpha.min(), alpha.max(), theta.min(), theta.max())
        image = axes.imshow(values, origin="lower", extent=edge, norm=norm, cmap="viridis")
        axes.set(title=f"{row.method.upper()}, {row.parameters}", xlabel="alpha_3 off by (rad)")
        figure.colorbar(image, ax=axes, label=what, shrink=0.8)
    panels[0].set_ylabel("theta_2 off by (rad)")
    return figure


def surface(rows: Sequence[Row]) -> Figure:
    """The RMS at the end over the deviations; starts that do not converge are left out."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(rows), 4), layout="constrained")
    for number, row in enumerate(rows, start=1):
        axes = figure.add_subplot(1, len(rows), number, projection="3d")
        theta, alpha = grid(row.every)
        side = len(np.unique(theta))
        height = np.log10(np.where(row.converged, row.rms_mm, np.nan)).reshape(side, side)
        axes.plot_surface(alpha.reshape(side, side), theta.reshape(side, side), height,
                          cmap="viridis")  # fmt: skip
        axes.set(title=row.method.upper(), xlabel="alpha_3 (rad)", ylabel="theta_2 (rad)",
                 zlabel="log10 RMS mm")  # fmt: skip
    return figure


@click.command()
@study_options("convergence")
@click.option("--full", is_flag=True, help="All 3969 starts for the NL methods too (hours).")
@click.option("--base-angle", type=float, default=0.3, show_default=True, metavar="RAD")
def main(study: Study, full: bool, base_angle: float) -> None:
    """Convergence of NLGN, NLLM, SNLGN, SNLLM from off starts: paper S, Table 2, Fig. 3-5."""
    setting = Setting(seed=study.seed + 1, base_angle=base_angle)
    least = least_cost(setting)
    separable, joint = (9, 15) if study.quick else (1, 1 if full else 3)
    cap = 300 if study.quick else CAP
    rows = []
    for parameters in SETS:
        for method in PAPER:
            every = separable if METHODS[method].separable else joint
            if parameters == "all":  # explicit Jacobians, a start at a time
                every = max(every, 3)
            found = outcomes(study, setting, method, parameters, every, cap)
            rows.append(row_of(found, method, parameters, every, least, setting.poses))
    tables = [
        table_2(rows, setting),
        seed_table(study, setting, separable),
        span_table(study, setting, 15 if study.quick else 7),
    ]
    figures = {}
    for parameters in SETS:
        chosen = [row for row in rows if row.parameters == parameters]
        for what in ("iterations", "RMS mm"):
            name = f"{what.split()[0].lower()}_{parameters}"
            figures[name] = maps(chosen, what)
        figures[f"surface_{parameters}"] = surface(chosen)
    names = [name.replace(" ", "_").replace("%", "percent") for name in HEADER]
    content = {
        "rows": plain([dict(zip(names, row.cells(), strict=True)) for row in rows]),
        "least_rms_mm": float(1e3 * np.sqrt(least / setting.poses)),
    }
    study.save(tables, content, figures)


if __name__ == "__main__":
    sweep.start(__file__)
