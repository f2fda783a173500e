"""Starts far off on a simulated arm, and how the four methods end there [paper S, Table 2].

IRB 2600, 60 random configurations, one target; measurement noise, errors of all parameters and of
the transmissions.  Starts: theta_2 and alpha_3 off by -3.1 ... 3.1 rad on a grid, base and target
at their identity and origin, everything else nominal.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from experiments import pseudo_inverse
from experiments.pseudo_inverse import ROUNDING
from experiments.speed import identified
from minimax_cal.fitting.start import search
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.modelling.model import Model, SumOfSquares
from minimax_cal.modelling.parameters import State, links_of
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import METHODS, Limits
from minimax_cal.solvers.status import Status

PAPER = ("nlgn", "nllm", "snlgn", "snllm")
UNITS = {"all, mm": 1e3, "all, m": 1.0}  # the paper's parameters: units a metre
CAP = 10_000
MANY = 5_000  # iterations allowed from which half a minute of compiling pays
STEP = 1e-9  # motion of a point at which the library's iteration has ended [m]
SMALL = 1e-6  # length of a step, in the units chosen, at which the paper's has ended
DAMPING, BY = 1e-2, 10.0  # Marquardt's first damping and factor, as MATLAB's lsqnonlin has them
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
    """Some starts of one method: deviations of theta_2 and alpha_3.

    parameters: identifiable, by the library, or one of UNITS, by the paper's own way.  moved:
    whether each value of a start is moved by a unit of rounding, at random.
    """

    setting: Setting
    method: str
    parameters: str
    theta: tuple[float, ...]
    alpha: tuple[float, ...]
    cap: int = CAP
    moved: bool = False


@dataclass(frozen=True)
class Outcome:
    """How each start of a job ended: iterations, cost [m^2], converged; and the time of all [s]."""

    iterations: tuple[int, ...]
    cost: tuple[float, ...]
    converged: tuple[bool, ...]
    seconds: float


def grid(every: int) -> tuple[Array, Array]:
    """All (theta, alpha) deviations on every n-th point of the paper's grid, flattened."""
    steps = np.round(np.arange(-31, 32)[(31 % every) :: every] * 0.1, 10)
    theta, alpha = np.meshgrid(steps, steps, indexing="ij")
    return theta.ravel(), alpha.ravel()


def jobs_of(
    setting: Setting, method: str, parameters: str, every: int, cap: int, moved: bool = False
) -> list[Job]:
    """The grid cut into jobs."""
    theta, alpha = grid(every)
    return [
        Job(setting, method, parameters, tuple(theta[i : i + CHUNK].tolist()),
            tuple(alpha[i : i + CHUNK].tolist()), cap, moved)
        for i in range(0, len(theta), CHUNK)
    ]  # fmt: skip


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


def least_cost(setting: Setting) -> float:
    """The global minimum, from our own search from the nominal geometry."""
    robot, model = problem_of(setting, "identifiable")
    return float(search(model, robot.mdh, float(model.counts.sum())).cost[0])


def run(job: Job) -> Outcome:
    """Solve from every start of a job."""
    robot, model = problem_of(job.setting, "identifiable")
    if job.parameters in UNITS:
        return to_the_letter(job, robot, model)
    began = time.perf_counter()
    with np.errstate(all="ignore"):  # undamped steps may diverge to infinity: that is the finding
        found = least_squares.solve(
            SumOfSquares(model),
            starts_of(robot, job.theta, job.alpha),
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


def to_the_letter(job: Job, robot: Robot, model: Model) -> Outcome:
    """The paper's own way, one start after the other."""
    iterations, costs, converged = [], [], []
    begins = [flat(robot, t, a) for t, a in zip(job.theta, job.alpha, strict=True)]
    if job.moved:
        rng = np.random.default_rng(0)
        begins = [nudged(x, rng) for x in begins]
    # compiling does not count
    letter(job.method, job.parameters, model, begins[0], 1, meant=job.cap)
    began = time.perf_counter()
    for begin in begins:
        count, cost, ended, _ = letter(job.method, job.parameters, model, begin, job.cap)
        iterations.append(count)
        costs.append(cost)
        converged.append(ended == pseudo_inverse.CONVERGED)
    seconds = time.perf_counter() - began
    return Outcome(tuple(iterations), tuple(costs), tuple(converged), seconds)


def nudged(start: Array, rng: np.random.Generator) -> Array:
    """A start, each value of it moved by a unit of rounding or not."""
    return np.asarray(start * (1.0 + ROUNDING * rng.integers(-1, 2, start.size)))


def flat(robot: Robot, theta: float = 0.0, alpha: float = 0.0) -> Array:
    """The paper's start as `pseudo_inverse` takes it [m, rad]: base I(4), target 0, two angles off.

    theta, alpha: deviations of theta_2 and alpha_3 [rad].
    """
    mdh = robot.mdh.copy()
    mdh[1, kinematics.THETA] += theta
    mdh[2, kinematics.ALPHA] += alpha
    return np.concatenate([links_of(mdh), np.zeros(9)])


def twin() -> Callable[..., tuple[int, float, int]] | None:
    """`pseudo_inverse.iterate` of all parameters together, where numba is there to compile it."""
    try:
        from experiments.pseudo_inverse_fast import iterate
    except ImportError:
        return None
    return iterate


def letter(
    method: str, parameters: str, model: Model, begin: Array, cap: int, course: int = 0,
    meant: int = 0,
) -> tuple[int, float, int, Array]:  # fmt: skip
    """Iterations, cost [m^2], how it ended, and the costs of the first iterates (course,) [m^2].

    One of PAPER on one of UNITS, on the first target of a model.  meant: the cap that decides
    whether the compiled twin runs, if it is not this one.
    """
    unit = UNITS[parameters]
    scale = np.where(model.names.linear, unit, 1.0)
    damping = DAMPING if METHODS[method].damped else 0.0
    costs = np.full(course, np.nan)
    y = unit * model.y[0].ravel()
    at, q, rule = begin * scale, np.ascontiguousarray(model.q), (damping, BY, SMALL, cap)
    separable = METHODS[method].separable
    fast = twin() if not separable and max(cap, meant) >= MANY else None
    with np.errstate(all="ignore"):
        count, cost, ended = (
            fast(at, q, y, *rule, costs)
            if fast
            else pseudo_inverse.iterate(at, q, y, separable, *rule, costs)
        )
    return int(count), float(cost) / unit**2, int(ended), costs / unit**2
