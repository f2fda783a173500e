"""The worst point of a calibration by cone programs, and the certificate of a worst-point answer.

`worst` states the problem for the SQP, in squares; here it is stated in the distances themselves.
The parameters are whitened: a step of length one moves the points, in the root mean square, by as
much as the largest error at the start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import starmap
from typing import Annotated

import numpy as np

from minimax_cal.fitting.minimax_problem import MinimaxProblem
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.facts import Fact, derived
from minimax_cal.ground.tables import Table
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers.dual_bound import Rows, gap_of, lower_bound, of_squares
from minimax_cal.solvers.minimax import Kkt, Linear, Optimum, optimality

RIDGE = 1e-12  # of the mean curvature, about one: directions without any stay finite
ACTIVE = 1e-6  # relative: nearer to the largest than this counts as equal to it


@dataclass(frozen=True, eq=False)
class PointCones:
    """The problem `worst` (of points) in the norms themselves.

    white: (free, free) from a whitened step to one scaled as in `worst`.
    """

    worst: MinimaxProblem
    white: Array

    @staticmethod
    def of(worst: MinimaxProblem) -> PointCones:
        """Whitened where the problem was scaled."""
        count = len(worst.first.f)
        mean = 0.5 * worst.linearise(worst.start).curvature(np.full(count, 1.0 / count))
        factor = np.linalg.cholesky(mean + RIDGE * np.eye(len(mean)))
        return PointCones(worst, np.linalg.inv(factor).T)

    @property
    def lower(self) -> Array:
        """Lower bounds of the scaled distance deviations."""
        return self.worst.lower

    @property
    def upper(self) -> Array:
        """Upper bounds of the scaled distance deviations."""
        return self.worst.upper

    def linearise(self, x: State) -> Rows:
        """Weighted errors of the points, target by target, distances, and their derivatives."""
        model, size = self.worst.model, np.sqrt(self.worst.size)
        rows = [model.weighted_rows(x, block, model.active) for block in model.blocks(x)]
        error = np.concatenate([part for part, _ in rows], axis=-1)
        turned = np.concatenate([part for _, part in rows], axis=-1)
        r = np.moveaxis(error, 1, 2)[model.seen]
        J = -np.moveaxis(turned, (1, 2), (3, 2))[model.seen]
        known, jacobian = self.prior(x)
        r = np.concatenate([r, np.broadcast_to(known, (len(r), len(known)))], axis=1)
        J = np.concatenate([J, np.broadcast_to(jacobian, (len(J), *jacobian.shape))], axis=1)
        c, normal = self.worst.deviation(x)
        J = J @ (self.white / self.worst.scale[:, None])
        return Rows(r / size, J / size, c, normal @ self.white)

    def prior(self, x: State) -> tuple[Array, Array]:
        """What the prior adds to every point's vector: (e,) and its derivative (e, free) [m]."""
        model = self.worst.model
        chosen = model.prior.weight > 0.0
        root = np.sqrt(model.prior.weight[chosen] / model.counts.sum())
        jacobian = -root[:, None] * np.eye(model.names.count)[np.ix_(chosen, model.active)]
        return root * (model.prior.mean - model.values(x))[chosen], jacobian

    def step(self, x: State, d: Array) -> State:
        """The state moved by a whitened step."""
        return self.worst.step(x, self.white @ d)


@dataclass(frozen=True)
class DecidingPoint:
    """A point that decides: target, line of the file, distance [m], multiplier."""

    target: str
    line: int
    distance: Annotated[float, Fact(key="distance_mm", scale=1e3)]
    multiplier: float


@dataclass(frozen=True)
class Certificate:
    """Why no small change of the parameters makes the worst point better.

    value: the largest distance, weighted where the data tell the points' accuracy (`u95`) [m].
    bound: what the largest distance of the linearised problem cannot fall below, computed from the
    multipliers alone [m].  The problem itself is not convex: this is no statement about far ones,
    and near ones may be better by second-order terms, the size of the curvature times the step
    squared.
    kkt: residuals of the optimality conditions, of the problem scaled to about one.
    points: that decide, the weightiest first; the multipliers sum to one over all points.
    """

    value: Annotated[float, Fact(key="value_mm", scale=1e3)]
    bound: Annotated[float, Fact(key="bound_mm", scale=1e3)]
    kkt: Kkt
    points: tuple[DecidingPoint, ...]

    @derived()
    def gap(self) -> float:
        """How much smaller the largest distance could be at most, to first order, relative."""
        return gap_of(self.value, self.bound)

    def table(self) -> Table:
        """The points that decide."""
        title = (
            f"points that decide: largest {1e3 * self.value:.4f} mm, to first order not below "
            f"{1e3 * self.bound:.4f} mm (gap {self.gap:.1e})"
        )
        columns = "target | line d | distance=distance mm .4f | multiplier .4f"
        return Table.of(title, self.points, columns)


def certify(problem: MinimaxProblem, best: Optimum[State], line: Array) -> Certificate:
    """The certificate of an answer of the SQP.

    problem: of points, scaled at any state of the same model.  line: (m,) of the file, pose by
    pose.
    """
    rows = PointCones.of(problem).linearise(best.x)
    model, norms, size = problem.model, rows.norms, np.sqrt(problem.size)
    same = float(norms.max()) ** 2 / best.value  # the answer's own scaling may be another
    given = of_squares(rows, best.mu, best.lam * same)
    mu = np.linalg.norm(given.y, axis=1)
    chosen = np.flatnonzero((norms >= norms.max() * (1.0 - ACTIVE)) | (mu > ACTIVE))
    chosen = chosen[np.argsort(-mu[chosen], kind="stable")]
    target, pose = np.argwhere(model.seen)[chosen].T
    distance = np.linalg.norm(model.error(best.x), axis=-1)
    names = (model.names.target_names[i] for i in target)
    numbers = (part.tolist() for part in (line[pose], distance[target, pose], mu[chosen]))
    return Certificate(
        value=float(size * norms.max()),
        bound=float(size * lower_bound(rows, problem.lower, problem.upper, given)),
        kkt=optimality(gradients(rows), mu, given.lam, problem.lower, problem.upper),
        points=tuple(starmap(DecidingPoint, zip(names, *numbers, strict=True))),
    )


def gradients(rows: Rows) -> Linear:
    """The norms as plain functions; a norm of zero has no gradient."""
    norms = rows.norms
    unit = rows.r / np.where(norms > 0.0, norms, 1.0)[:, None]
    jacobian = np.einsum("nw,nwp->np", unit, rows.J)
    unknown: Callable[[Array], Array] = lambda weights: np.zeros((0, 0))  # noqa: E731
    return Linear(norms, jacobian, rows.c, rows.C, unknown)
