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
from experiments.conditions import CONDITION_ROBOTS, list_available_robots, load_or_simulate_robot
from experiments.speed import fit_least_squares
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table
from minimax_cal.fitting.cell_fit import FIT_QP_TOLERANCE
from minimax_cal.fitting.minimax_problem import (
    MinimaxProblem,
    TargetDistanceLimits,
    build_minimax_problem,
    measured_distances,
)
from minimax_cal.measuring.pose_groups import split_train_and_holdout
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointModel
from minimax_cal.solvers import minimax
from minimax_cal.solvers.epigraph_qp import ignore_warm_start
from minimax_cal.solvers.linearisation import FunctionsAndConstraints, Linearisation
from qp_backends import solve as solve_qp

DAQP_SOLVER = ignore_warm_start(partial(solve_qp, name="daqp", tolerance=FIT_QP_TOLERANCE))
ALGORITHM_1_STEPS = 10  # of Algorithm 1
WITHOUT_CONSTRAINT, WITH_CONSTRAINT = "without", "c(x) <= 0"


@dataclass(frozen=True, eq=False)
class SumOfSquaresProblem:
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

    def evaluate(self, x: ParameterValues) -> FunctionsAndConstraints:
        """The mean square (1,), and the constraints (l,)."""
        f, c = self.problem.evaluate(x)
        return FunctionsAndConstraints(np.array([self.share @ f]), c)

    def linearise(self, x: ParameterValues) -> Linearisation:
        """The same with derivatives."""
        at = self.problem.linearise(x)
        return Linearisation(
            f=np.array([self.share @ at.f]),
            jacobian=(self.share @ at.jacobian)[None],
            c=at.c,
            normal=at.normal,
            curvature=lambda weights: at.curvature(weights[0] * self.share),
        )

    def step(self, x: ParameterValues, d: Array) -> ParameterValues:
        """The state moved by a scaled step."""
        return self.problem.step(x, d)


@dataclass(frozen=True)
class WarmStartJob:
    """An arm of Table 3."""

    robot: str
    seed: int


@dataclass(frozen=True)
class WarmStart:
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


def run_arm(job: WarmStartJob) -> dict[str, WarmStart]:
    """The fits of one arm by name."""
    robot, data = load_or_simulate_robot(job.robot, job.seed)
    train, _, _ = split_train_and_holdout(
        data, 1.0 - CONDITION_ROBOTS[job.robot][2] / data.poses, job.seed
    )
    model, free = fit_least_squares(robot, train)
    distances = measured_distances(train)
    bound = fit_sum_with_constraint(model, free, distances)
    return {
        WITHOUT_CONSTRAINT: evaluate_warm_start(model, free, "converged", distances),
        WITH_CONSTRAINT: evaluate_warm_start(model, bound.x, str(bound.status), distances),
    }


def fit_sum_with_constraint(
    model: PointModel, x: ParameterValues, distances: TargetDistanceLimits
) -> minimax.Optimum[ParameterValues]:
    """Eq. 32 from a start, by constrained Gauss-Newton."""
    problem = build_minimax_problem(model, x, distances, "two-sided", "target")
    return minimax.solve(
        SumOfSquaresProblem(
            problem, model.pose_counts_by_target / model.pose_counts_by_target.sum()
        ),
        x,
        DAQP_SOLVER,
    )


def evaluate_warm_start(
    model: PointModel, x: ParameterValues, status: str, distances: TargetDistanceLimits
) -> WarmStart:
    """A fit, and what begins there.  distances: those that the minimax keeps."""
    problem = build_minimax_problem(model, x, distances, "two-sided", "target")
    best = minimax.solve(problem, x, DAQP_SOLVER).value * problem.size
    printed = build_minimax_problem(model, x, distances, "squared", "target")
    ends = [
        algorithm_1.run_algorithm_1(printed, x, ALGORITHM_1_STEPS, with_line_search=search)[-1]
        * printed.size
        for search in algorithm_1.ALGORITHM_1_VARIANTS.values()
    ]
    sums, apart = model.target_costs(x), problem.distance_values_and_jacobian(x)[0]
    return WarmStart(
        sums=tuple(sums.tolist()),
        phi=float(np.sqrt((sums / model.pose_counts_by_target).max())),
        worst=float(np.abs(apart).max()),
        status=status,
        minimax=best,
        letter=tuple(float(np.sqrt(end / best) - 1.0) for end in ends),
    )


WarmStartResults = Mapping[WarmStartJob, Mapping[str, WarmStart]]


def run_all_cases(study: Study) -> WarmStartResults:
    """All arms of Table 3 that are here."""
    names = list_available_robots()[:1] if study.quick else list_available_robots()
    jobs = [WarmStartJob(name, study.seed) for name in names]
    return dict(zip(jobs, study.sweep(run_arm, jobs, "arms"), strict=True))


def build_warm_start_table(results: WarmStartResults) -> Table:
    """A row a fit."""
    rows = [
        (CONDITION_ROBOTS[job.robot][0], name, *(1e6 * f for f in one.sums), 1e6 * sum(one.sums),
         1e3 * one.phi, one.worst, one.status, 1e3 * np.sqrt(one.minimax), *one.letter)
        for job, starts in results.items()
        for name, one in starts.items()
    ]  # fmt: skip
    return Table.from_rows(
        "eq. 32 with its constraint and without",
        rows,
        "arm | eq. 32 | F_1 mm² .4f | F_2 mm² .4f | F_3 mm² .4f | sum mm² .4f | RMSE(φ) mm .5f | "
        "c: largest over sqrt(ε) .3f | ended | minimax from there, RMSE(φ) mm .5f | "
        "Algorithm 1 from there, as printed .1e | with a line search .1e",
    )


def save_results(study: Study, results: WarmStartResults) -> None:
    """The table."""
    table = build_warm_start_table(results)
    study.save([table], {"rows": table.to_records()})


@study_options("warm_start")
def main(study: Study) -> None:
    """Paper M's warm start, eq. 32, with c(x) <= 0 and without."""
    save_results(study, run_all_cases(study))
