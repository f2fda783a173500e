"""From how far the four least-squares methods converge: paper S, Table 2 and Fig. 3-5.

    python -m experiments.convergence [--quick] [--full] [--out FOLDER] [--json FILE] [--seed N]

IRB 2600, 60 random configurations, one target; measurement noise, errors of all parameters and of
the transmissions.  Starts: theta_2 and alpha_3 off by -3.1 ... 3.1 rad on a grid, base and target
at their identity and origin, everything else nominal.  The paper prints neither the true base nor
the sizes of its errors; here the base is turned by --base-angle about a random axis and the errors
are those of `Setting`.  Every method runs on the paper's parameters (all, redundant ones included,
pseudo-inverse) and on the identifiable ones.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from experiments.speed import identified
from minimax_cal import kinematics
from minimax_cal.data import Measurements, measurements
from minimax_cal.kinematics import Array
from minimax_cal.model import Model, SumOfSquares
from minimax_cal.parameters import State
from minimax_cal.robot import Robot, load_robot
from minimax_cal.simulate import Truth, simulate
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import METHODS, Limits
from minimax_cal.solvers.status import Status
from minimax_cal.start import search
from minimax_cal.tables import Cell, Table

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
    transmission: float = 4.0e-3
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
