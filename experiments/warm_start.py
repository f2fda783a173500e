"""The start of paper M's search, eq. 32, with its constraint and without.

    python -m experiments.warm_start [--quick] [--out FOLDER] [--json FILE] [--seed N] ...

Eq. 32 is min F_1 + F_2 + F_3 subject to c(x) <= 0, the distances between the reflectors, by
Gauss-Newton.  `calibrate` starts from the fit without c(x) <= 0.  Here they stand beside each
other, on the training poses of Table 3, with the minimax and with ten steps of Algorithm 1 that
begin at each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from experiments import algorithm_1
from experiments.conditions import ROBOTS, arm_of, robots_here
from experiments.speed import fitted
from experiments.sweep import Study, study_options
from minimax_cal.fitting.minimax_problem import (
    Distances,
    MinimaxProblem,
    measured_distances,
    minimax_problem,
)
from minimax_cal.fitting.solve import QP_TOLERANCE
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.grouping import split
from minimax_cal.modelling.model import Model
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers import minimax
from minimax_cal.solvers.epigraph_qp import ignore_warm_start
from minimax_cal.solvers.linearisation import Linearisation
from qp_backends import solve as solve_qp

SOLVE = ignore_warm_start(partial(solve_qp, name="daqp", tolerance=QP_TOLERANCE))
STEPS = 10  # of Algorithm 1
FREE, BOUND = "without", "c(x) <= 0"


@dataclass(frozen=True, eq=False)
class SumProblem:
    """min over x of the mean square of all points, the distances kept [paper M, eq. 32].

    Its epigraph QP with the Gauss-Newton curvature is the step of constrained Gauss-Newton.
    problem: has F_i / m_i and the constraints.  share: (k,) m_i over their sum.
    """

    problem: MinimaxProblem
    share: Array

    @property
    def lower(self) -> Array:
        """(l,) of the constraints."""
        return self.problem.lower

    @property
    def upper(self) -> Array:
        """(l,) of the constraints."""
        return self.problem.upper

    def evaluate(self, x: State) -> tuple[Array, Array]:
        """The mean square (1,), and the constraints (l,)."""
        f, c = self.problem.evaluate(x)
        return np.array([self.share @ f]), c

    def linearise(self, x: State) -> Linearisation:
        """The same with derivatives."""
        at = self.problem.linearise(x)
        return Linearisation(
            f=np.array([self.share @ at.f]),
            jacobian=(self.share @ at.jacobian)[None],
            c=at.c,
            normal=at.normal,
            curvature=lambda weights: at.curvature(weights[0] * self.share),
        )

    def step(self, x: State, d: Array) -> State:
        """The state moved by a scaled step."""
        return self.problem.step(x, d)


@dataclass(frozen=True)
class Job:
    """An arm of Table 3."""

    robot: str
    seed: int


@dataclass(frozen=True)
class Start:
    """A fit of the sum, and what begins there.

    sums: F_i [m^2].  phi: RMSE(φ) [m].  worst: the largest |distance - measured| over sqrt(ε).
    minimax: the largest F_i / m at the optimum that is found from here [m^2].  letter: RMSE(φ) over
    the optimum, minus one, after ten steps of Algorithm 1, as printed and with a line search.
    """

    sums: tuple[float, ...]
    phi: float
    worst: float
    status: str
    minimax: float
    letter: tuple[float, ...]


def run(job: Job) -> dict[str, Start]:
    """The fits of one arm by name."""
    robot, data = arm_of(job.robot, job.seed)
    train, _, _ = split(data, 1.0 - ROBOTS[job.robot][2] / data.poses, job.seed)
    model, free = fitted(robot, train)
    distances = measured_distances(train)
    bound = constrained_fit(model, free, distances)
    return {
        FREE: start_of(model, free, "converged", distances),
        BOUND: start_of(model, bound.x, str(bound.status), distances),
    }


def constrained_fit(model: Model, x: State, distances: Distances) -> minimax.Optimum[State]:
    """Eq. 32 from a start, by constrained Gauss-Newton."""
    problem = minimax_problem(model, x, distances, "two-sided", "target")
    return minimax.solve(SumProblem(problem, model.counts / model.counts.sum()), x, SOLVE)


def start_of(model: Model, x: State, status: str, distances: Distances) -> Start:
    """A fit, and what begins there.  distances: those that the minimax keeps."""
    problem = minimax_problem(model, x, distances, "two-sided", "target")
    best = minimax.solve(problem, x, SOLVE).value * problem.size
    printed = minimax_problem(model, x, distances, "squared", "target")
    ends = [
        algorithm_1.algorithm_1(printed, x, STEPS, search=search)[-1] * printed.size
        for search in algorithm_1.WAYS.values()
    ]
    sums, apart = model.cost(x), problem.distance(x)[0]
    return Start(
        sums=tuple(sums.tolist()),
        phi=float(np.sqrt((sums / model.counts).max())),
        worst=float(np.abs(apart).max()),
        status=status,
        minimax=best,
        letter=tuple(float(np.sqrt(end / best) - 1.0) for end in ends),
    )


Found = Mapping[Job, Mapping[str, Start]]


def study_of(study: Study) -> Found:
    """All arms of Table 3 that are here."""
    names = robots_here()[:1] if study.quick else robots_here()
    jobs = [Job(name, study.seed) for name in names]
    return dict(zip(jobs, study.sweep(run, jobs, "arms"), strict=True))


def table_of(found: Found) -> Table:
    """A row a fit."""
    rows = [
        (ROBOTS[job.robot][0], name, *(1e6 * f for f in one.sums), 1e6 * sum(one.sums),
         1e3 * one.phi, one.worst, one.status, 1e3 * np.sqrt(one.minimax), *one.letter)
        for job, starts in found.items()
        for name, one in starts.items()
    ]  # fmt: skip
    return Table.made(
        "eq. 32 with its constraint and without",
        rows,
        "arm | eq. 32 | F_1 mm² .4f | F_2 mm² .4f | F_3 mm² .4f | sum mm² .4f | RMSE(φ) mm .5f | "
        "c: largest over sqrt(ε) .3f | ended | minimax from there, RMSE(φ) mm .5f | "
        "Algorithm 1 from there, as printed .1e | with a line search .1e",
    )


def save(study: Study, found: Found) -> None:
    """The table."""
    table = table_of(found)
    study.save([table], {"rows": table.records()})


@study_options("warm_start")
def main(study: Study) -> None:
    """Paper M's warm start, eq. 32, with c(x) <= 0 and without."""
    save(study, study_of(study))
