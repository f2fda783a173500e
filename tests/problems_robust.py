"""Least-squares problems with wrong points in them, for the tests of robust fits."""

from dataclasses import dataclass, replace

import numpy as np

import minimax_cal as mc
from experiments.speed import identify_parameters
from minimax_cal.core.arrays import Array
from minimax_cal.fitting.robust_fit import Fitter, RobustFit, fit_robust_loss
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointLeastSquares, PointModel
from minimax_cal.modelling.simulate import Simulation, Truth, simulate
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import LEAST_SQUARES_METHODS, LeastSquaresSolution

NOISE = 20e-6  # of a coordinate, the same for all points [m]
EVEN = Truth(compliance=0.0, noise=NOISE, noise_per_metre=0.0)
EXACT = replace(EVEN, noise=0.0)


@dataclass(frozen=True, eq=False)
class Case:
    """A plain fit and what a robust one needs.  bad: (k, m) True for wrong points."""

    robot: mc.Robot
    made: Simulation
    data: mc.Measurements
    model: PointModel
    found: LeastSquaresSolution[ParameterValues]
    bad: Array

    def robust(self, loss: str = "square", trim: float = 0.0) -> RobustFit:
        """The robust fit."""
        given, judged = (fit, self.model, self.found, self.data.line), np.ones(len(self.model.y))
        return fit_robust_loss(*given, loss, trim, is_judged=judged > 0.0)

    def without(self) -> ParameterValues:
        """Least squares on the right points alone."""
        model = replace(self.model, weight=self.model.weight * ~self.bad)
        return state_of(fit(model, state_of(self.found))[1])

    def miss(self, state: ParameterValues) -> float:
        """RMS distance from the true robot's points, at new poses [m]."""
        q = np.random.default_rng(1).uniform(-2.0, 2.0, (100, self.robot.joints))
        cell = Cell.from_parameters(self.robot, state, self.data.target_names)
        error = cell.predict(q) - self.made.cell.predict(q)
        return float(np.sqrt((error**2).sum(axis=-1).mean()))

    def listed(self, found: RobustFit) -> Array:
        """(k, m) True for the suspects."""
        out = np.zeros_like(self.bad)
        for one in found.suspects:
            out[self.data.target_names.index(one.target), self.data.line == one.line] = True
        return out


def state_of(found: LeastSquaresSolution[ParameterValues]) -> ParameterValues:
    """The one solution of a batch of one."""
    return found.x.take(np.array(0))


def fit(
    model: PointModel, begin: ParameterValues
) -> tuple[PointModel, LeastSquaresSolution[ParameterValues]]:
    """Plain least squares of a model."""
    points = float(model.pose_counts_by_target.sum())
    problem = PointLeastSquares(model)
    return model, least_squares.solve(
        problem,
        begin.batch(),
        1,
        points,
        LEAST_SQUARES_METHODS["snllm"],
        least_squares.NEAR_START_LIMITS,
    )


FITTER: Fitter = fit


def case_of(robot: mc.Robot, made: Simulation, data: mc.Measurements, bad: Array) -> Case:
    """The identifiable parameters and the plain fit of some measurements.  bad: (m, k)."""
    model, found = fit(*identify_parameters(robot, data))
    return Case(robot, made, data, model, found, bad.T)


def directions(rng: np.random.Generator, count: int) -> Array:
    """Random unit vectors (count, 3)."""
    out = rng.normal(size=(count, 3))
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def shifted(
    robot: mc.Robot,
    share: float,
    size: float,
    *,
    poses: int = 50,
    targets: int = 3,
    seed: int = 0,
    truth: Truth = EVEN,
) -> Case:
    """A share of the points is moved by `size` [m] in random directions."""
    made = simulate(robot, poses, targets, seed, truth)
    rng = np.random.default_rng(seed)
    bad = np.zeros((poses, targets), dtype=bool)
    bad.flat[rng.permutation(bad.size)[: round(share * bad.size)]] = True
    y = made.data.y.copy()
    y[bad] += size * directions(rng, int(bad.sum()))
    return case_of(robot, made, made.data.with_y(y), bad)


def misread(robot: mc.Robot, share: float, turn: float, joint: int = 1, **more: int) -> Case:
    """At a share of the poses one joint stood `turn` [rad] away from what was written down."""
    made = simulate(robot, truth=EVEN, **{"poses": 50, "targets": 3, "seed": 0, **more})
    rng = np.random.default_rng(0)
    rows = rng.permutation(made.data.poses)[: round(share * made.data.poses)]
    q = made.data.q.copy()
    q[rows, joint] += turn
    noise = made.data.y - made.cell.predict(made.data.q)
    bad = np.zeros(made.data.seen.shape, dtype=bool)
    bad[rows] = True
    return case_of(robot, made, made.data.with_y(made.cell.predict(q) + noise), bad)
