"""The worst error as a minimax problem, with the distances between targets kept [paper M].

The worst target, f_i = F_i / m_i, as in the paper; or the worst of all measured points.  Values are
divided by their size at the start and parameters scaled to unit curvature: the solver then sees
numbers near one, whatever the robot's size and the instrument's noise.

`worst` states the problem for the SQP, in squares; here it is stated in the distances themselves.
The parameters are whitened: a step of length one moves the points, in the root mean square, by as
much as the largest error at the start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import starmap
from typing import Annotated

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.record_fields import FieldFormat, derived_field
from minimax_cal.core.tables import Table
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointModel, apply_active_step
from minimax_cal.solvers.dual_bound import (
    LinearisedNorms,
    convert_squared_norm_multipliers,
    dual_lower_bound,
    relative_duality_gap,
)
from minimax_cal.solvers.linearisation import (
    FunctionsAndConstraints,
    Kkt,
    Linearisation,
    measure_kkt,
)
from minimax_cal.solvers.minimax import Optimum

DISTANCE_FORMS = ("two-sided", "squared", "off")
MIN_TRUSTED_WEIGHT = 0.5  # a point of less weight tells no distance between targets
MIN_DISTANCE_TOLERANCE = 1e-6  # a distance is never asked to hold better than a micrometre [m]


@dataclass(frozen=True, eq=False)
class TargetDistanceLimits:
    """What the instrument says about the distances between targets [paper M, eq. 8].

    pairs: (l, 2) indices of targets measured together.  mean: (l,) mean measured distance [m].
    tolerance: (l,) how far the model's distance may lie from it, sqrt(eps) of the paper [m].
    """

    pairs: Array
    mean: Array
    tolerance: Array


def measured_distances(data: Measurements, tolerance: float | None = None) -> TargetDistanceLimits:
    """The distances of all pairs measured together three times or more, and how well known.

    tolerance: for all pairs [m].  None takes the instrument's own accuracy: sqrt(2) times the
    typical `u95` where there is such a column, else the scatter of each measured distance.
    """
    pairs, mean, spread = [], [], []
    for a in range(len(data.target_names)):
        for b in range(a + 1, len(data.target_names)):
            distance = np.linalg.norm(data.y[:, a] - data.y[:, b], axis=-1)
            distance = distance[np.isfinite(distance)]
            if len(distance) > 2:
                pairs.append((a, b))
                mean.append(distance.mean())
                spread.append(distance.std(ddof=1))
    scatter = np.array(spread)
    if "u95" in data.columns and np.isfinite(data.columns["u95"]).any():
        scatter = np.full(len(pairs), np.sqrt(2.0) * float(np.nanmedian(data.columns["u95"])))
    if tolerance is not None:
        scatter = np.full(len(pairs), tolerance)
    return TargetDistanceLimits(
        np.array(pairs, dtype=int).reshape(-1, 2),
        np.array(mean),
        np.maximum(scatter, MIN_DISTANCE_TOLERANCE),
    )


def trusted_distances(
    data: Measurements, weights: Array, tolerance: float | None
) -> TargetDistanceLimits:
    """`measured_distances` of the points that a fit gave weight.  weights: (k, m)."""
    trusted = np.where(weights.T[..., None] > MIN_TRUSTED_WEIGHT, data.y, np.nan)
    return measured_distances(data.with_y(trusted), tolerance)


@dataclass(frozen=True, eq=False)
class MinimaxProblem:
    """min over x of the largest f_i, as `solvers.minimax` wants it.

    per: "target" for f_i = F_i / m_i, "point" for the squared distance of every measured point.
    start, first: where the scaling was found, and the derivatives there.
    scale: (free,) divides a step's entries.  size: divides the f_i [m^2].
    form: "two-sided" |e| <= tol, or the paper's "squared" e^2 <= tol^2, whose gradient vanishes
    at e = 0, or "off".
    """

    per: str
    model: PointModel
    distances: TargetDistanceLimits
    start: ParameterValues
    first: ErrorDerivatives
    scale: Array
    size: float
    form: str

    @cached_property
    def lower(self) -> Array:
        """Lower bounds of the scaled distance deviations, and of the effects' parameters."""
        count = len(self.distances.mean)
        least = np.full(count, -1.0 if self.form == "two-sided" else -np.inf)
        return np.concatenate([least, self.scaled_parameter_bounds[:, 0]])

    @cached_property
    def upper(self) -> Array:
        """Upper bounds of the same."""
        return np.concatenate(
            [np.ones(len(self.distances.mean)), self.scaled_parameter_bounds[:, 1]]
        )

    @cached_property
    def bounded_parameters(self) -> Array:
        """(b,) the free parameters, by their place among these, that have bounds."""
        model = self.model
        ends = np.full((model.names.parameter_count, 2), np.inf) * [-1.0, 1.0]
        if len(model.room):
            ends[model.names.geometric_count :] = model.room
        return np.flatnonzero(np.isfinite(ends[model.active]).any(axis=1))

    @cached_property
    def scaled_parameter_bounds(self) -> Array:
        """(b, 2) their bounds, scaled."""
        if not len(self.bounded_parameters):
            return np.zeros((0, 2))
        which = (
            np.flatnonzero(self.model.active)[self.bounded_parameters]
            - self.model.names.geometric_count
        )
        return np.asarray(self.model.room[which] * self.scale[self.bounded_parameters, None])

    @cached_property
    def curvature_scale(self) -> Array:
        """(free, free) of a curvature, one an entry: a quotient is as symmetric as what it was."""
        return np.asarray(self.size * np.outer(self.scale, self.scale))

    @cached_property
    def target_columns(self) -> Array:
        """(2, l, 3) the parameters of both targets of each pair."""
        first = 5 * self.model.names.joints + 6
        return first + 3 * self.distances.pairs.T[..., None] + np.arange(3)

    def constraint_values_and_jacobian(self, x: ParameterValues) -> tuple[Array, Array]:
        """Model minus measured distance, over the tolerance: (l,), and its derivative (l, p).

        Below them the parameters that have bounds, scaled.
        """
        apart, jacobian = self.distance_values_and_jacobian(x)
        if not len(self.bounded_parameters):
            return apart, jacobian
        value = (
            self.model.parameter_vector(x)[self.model.active][self.bounded_parameters]
            * self.scale[self.bounded_parameters]
        )
        own = np.eye(len(self.scale))[self.bounded_parameters]
        return np.concatenate([apart, value]), np.concatenate([jacobian, own])

    def distance_values_and_jacobian(self, x: ParameterValues) -> tuple[Array, Array]:
        """The part of `constraint_values_and_jacobian` that is about distances."""
        kept = self.distances
        count = len(kept.mean)
        if not count:
            return np.zeros(0), np.zeros((0, len(self.scale)))
        between = x.target_positions[kept.pairs[:, 0]] - x.target_positions[kept.pairs[:, 1]]
        length = np.maximum(np.sqrt((between * between).sum(axis=1)), 1e-12)
        c = (length - kept.mean) / kept.tolerance
        jacobian = np.zeros((count, self.model.names.parameter_count))
        unit = between / (length * kept.tolerance)[:, None]
        jacobian[np.arange(count)[:, None], self.target_columns[0]] = unit
        jacobian[np.arange(count)[:, None], self.target_columns[1]] = -unit
        if self.form == "squared":
            jacobian, c = 2.0 * c[:, None] * jacobian, c**2
        return c, jacobian[:, self.model.active] / self.scale

    def evaluate(self, x: ParameterValues) -> FunctionsAndConstraints:
        """f and c."""
        value, _ = ERROR_FUNCTIONS[self.per]
        cost = value(self.model, x) + prior_cost_per_point(self.model, x)
        return FunctionsAndConstraints(cost / self.size, self.constraint_values_and_jacobian(x)[0])

    def linearise(self, x: ParameterValues) -> Linearisation:
        """f, c and their derivatives; the curvature is Gauss-Newton's 2 J'J."""
        model = self.model
        at = self.first if x is self.start else ERROR_FUNCTIONS[self.per][1](model, x)
        slope, held, known = at.jacobian, 0.0, bool(model.prior.weight.any())
        if known:
            total, weight = model.pose_counts_by_target.sum(), model.prior.weight[model.active]
            off = (model.prior.mean - model.parameter_vector(x))[model.active]
            slope, held = slope - 2.0 * weight * off / total, prior_cost_per_point(model, x)
        c, normal = self.constraint_values_and_jacobian(x)

        def curvature(weights: Array) -> Array:
            both = at.curvature(weights)
            if known:
                both = both + 2.0 * weights.sum() * np.diag(weight) / total
            return np.asarray(both / self.curvature_scale)

        return Linearisation(
            f=(at.f + held) / self.size,
            jacobian=slope / (self.size * self.scale),
            c=c,
            normal=normal,
            curvature=curvature,
        )

    def step(self, x: ParameterValues, d: Array) -> ParameterValues:
        """The state moved by a scaled step in the free parameters."""
        return apply_active_step(self.model, x, d / self.scale)


@dataclass(frozen=True, eq=False)
class ErrorDerivatives:
    """f (n,) [m^2], its derivative (n, free), and the weighted sum of its curvatures."""

    f: Array
    jacobian: Array
    curvature: Callable[[Array], Array]


def prior_cost_per_point(model: PointModel, x: ParameterValues) -> float:
    """The prior's part of every f_i: the share it has in a mean square [m^2]."""
    if not model.prior.weight.any():
        return 0.0
    off = model.prior.mean - model.parameter_vector(x)
    return float((model.prior.weight * off**2).sum() / model.pose_counts_by_target.sum())


def target_mean_squares(model: PointModel, x: ParameterValues) -> Array:
    """F_i / m_i of every target: (k,) [m^2]."""
    return np.asarray(model.target_costs(x) / model.pose_counts_by_target)


def target_derivatives(model: PointModel, x: ParameterValues) -> ErrorDerivatives:
    """F_i / m_i and its derivatives."""
    normal = model.normal_equations(x, model.active)
    counts = model.pose_counts_by_target
    return ErrorDerivatives(
        normal.cost / counts,
        -2.0 * normal.gradient / counts[:, None],
        lambda weights: 2.0 * np.tensordot(weights / counts, normal.gram, 1),
    )


def point_squares(model: PointModel, x: ParameterValues) -> Array:
    """The squared distance of every measured point, target by target: (points,) [m^2]."""
    parts = [
        (model.block_errors_and_points(x, block)[0] ** 2).sum(axis=-2)
        for block in model.split_into_blocks(x)
    ]
    return np.asarray(np.concatenate(parts, axis=-1)[model.measured_mask])


def point_derivatives(model: PointModel, x: ParameterValues) -> ErrorDerivatives:
    """Squared distances and their derivatives."""
    f, jacobian = model.squared_distances_and_gradients(x)

    def curvature(weights: Array) -> Array:
        share = np.zeros(model.measured_mask.shape)
        share[model.measured_mask] = weights
        return 2.0 * model.weighted_gram(x, model.weight * share)

    return ErrorDerivatives(f[model.measured_mask], jacobian[model.measured_mask], curvature)


ERROR_FUNCTIONS = {
    "target": (target_mean_squares, target_derivatives),
    "point": (point_squares, point_derivatives),
}


def build_minimax_problem(
    model: PointModel,
    start: ParameterValues,
    distances: TargetDistanceLimits,
    distance_form: str,
    function_kind: str,
) -> MinimaxProblem:
    """The minimax problem scaled at a start.  Raises OptionError for an unknown form."""
    if distance_form not in DISTANCE_FORMS:
        raise OptionError(f"distance form {distance_form!r}; choose {', '.join(DISTANCE_FORMS)}")
    if distance_form == "off":
        none = np.zeros(0)
        distances = TargetDistanceLimits(np.zeros((0, 2), dtype=int), none, none)
    first = ERROR_FUNCTIONS[function_kind][1](model, start)
    size = float(first.f.max())
    size = size if size > 0.0 else 1e-18
    mean = first.curvature(np.full(len(first.f), 1.0 / len(first.f)))
    known = model.prior.weight[model.active] / model.pose_counts_by_target.sum()
    scale = np.sqrt(np.maximum((np.diag(mean) + 2.0 * known) / size, 1e-30))
    return MinimaxProblem(function_kind, model, distances, start, first, scale, size, distance_form)


# ---- the certificate -----------------------------------------------------------------------------


MIN_RELATIVE_CURVATURE = (
    1e-12  # of the mean curvature, about one: directions without any stay finite
)
MAX_ACTIVE_NORM_GAP = 1e-6  # relative: nearer to the largest than this counts as equal to it


@dataclass(frozen=True, eq=False)
class PointConeProblem:
    """The problem `worst` (of points) in the norms themselves.

    white: (free, free) from a whitened step to one scaled as in `worst`.
    """

    worst: MinimaxProblem
    white: Array

    @staticmethod
    def whiten(worst: MinimaxProblem) -> PointConeProblem:
        """Whitened where the problem was scaled."""
        count = len(worst.first.f)
        mean = 0.5 * worst.linearise(worst.start).curvature(np.full(count, 1.0 / count))
        factor = np.linalg.cholesky(mean + MIN_RELATIVE_CURVATURE * np.eye(len(mean)))
        return PointConeProblem(worst, np.linalg.inv(factor).T)

    @property
    def lower(self) -> Array:
        """Lower bounds of the scaled distance deviations."""
        return self.worst.lower

    @property
    def upper(self) -> Array:
        """Upper bounds of the scaled distance deviations."""
        return self.worst.upper

    def linearise(self, x: ParameterValues) -> LinearisedNorms:
        """Weighted errors of the points, target by target, distances, and their derivatives."""
        model, size = self.worst.model, np.sqrt(self.worst.size)
        rows = [
            model.block_errors_and_jacobian(x, block, model.active)
            for block in model.split_into_blocks(x)
        ]
        error = np.concatenate([part for part, _ in rows], axis=-1)
        turned = np.concatenate([part for _, part in rows], axis=-1)
        r = np.moveaxis(error, 1, 2)[model.measured_mask]
        J = -np.moveaxis(turned, (1, 2), (3, 2))[model.measured_mask]
        known, jacobian = self.prior_rows(x)
        r = np.concatenate([r, np.broadcast_to(known, (len(r), len(known)))], axis=1)
        J = np.concatenate([J, np.broadcast_to(jacobian, (len(J), *jacobian.shape))], axis=1)
        c, normal = self.worst.constraint_values_and_jacobian(x)
        J = J @ (self.white / self.worst.scale[:, None])
        return LinearisedNorms(r / size, J / size, c, normal @ self.white)

    def prior_rows(self, x: ParameterValues) -> tuple[Array, Array]:
        """What the prior adds to every point's vector: (e,) and its derivative (e, free) [m]."""
        model = self.worst.model
        chosen = model.prior.weight > 0.0
        root = np.sqrt(model.prior.weight[chosen] / model.pose_counts_by_target.sum())
        jacobian = (
            -root[:, None] * np.eye(model.names.parameter_count)[np.ix_(chosen, model.active)]
        )
        return root * (model.prior.mean - model.parameter_vector(x))[chosen], jacobian

    def step(self, x: ParameterValues, d: Array) -> ParameterValues:
        """The state moved by a whitened step."""
        return self.worst.step(x, self.white @ d)


@dataclass(frozen=True)
class DecidingPoint:
    """A point that decides: target, line of the file, distance [m], multiplier."""

    target: str
    line: int
    distance: Annotated[float, FieldFormat(key="distance_mm", scale=1e3)]
    multiplier: float


@dataclass(frozen=True)
class Certificate:
    """Why no small change of the parameters makes the worst point better.

    value: the largest distance, weighted where the data tell the points' accuracy (`u95`) [m].
    bound: what the largest distance of the linearised problem cannot fall below, computed from the
    multipliers alone [m].  The problem itself is not convex: this is no statement about far ones,
    and near ones may be better by second-order terms, the size of the curvature times the step
    squared.
    kkt: residuals of the KKT conditions, of the problem scaled to about one.
    points: that decide, the weightiest first; the multipliers sum to one over all points.
    """

    value: Annotated[float, FieldFormat(key="value_mm", scale=1e3)]
    bound: Annotated[float, FieldFormat(key="bound_mm", scale=1e3)]
    kkt: Kkt
    points: tuple[DecidingPoint, ...]

    @derived_field()
    def gap(self) -> float:
        """How much smaller the largest distance could be at most, to first order, relative."""
        return relative_duality_gap(self.value, self.bound)

    def table(self) -> Table:
        """The points that decide."""
        title = (
            f"points that decide: largest {1e3 * self.value:.4f} mm, to first order not below "
            f"{1e3 * self.bound:.4f} mm (gap {self.gap:.1e})"
        )
        columns = "target | line d | distance=distance mm .4f | multiplier .4f"
        return Table.from_records(title, self.points, columns)


def build_certificate(
    problem: MinimaxProblem, optimum: Optimum[ParameterValues], file_lines: Array
) -> Certificate:
    """The certificate of an answer of the SQP.

    problem: of points, scaled at any state of the same model.  file_lines: (m,) of the file, pose
    by pose.
    """
    rows = PointConeProblem.whiten(problem).linearise(optimum.x)
    model, norms, size = problem.model, rows.norms, np.sqrt(problem.size)
    same = float(norms.max()) ** 2 / optimum.value  # the answer's own scaling may be another
    given = convert_squared_norm_multipliers(rows, optimum.mu, optimum.lam * same)
    mu = np.linalg.norm(given.y, axis=1)
    chosen = np.flatnonzero(
        (norms >= norms.max() * (1.0 - MAX_ACTIVE_NORM_GAP)) | (mu > MAX_ACTIVE_NORM_GAP)
    )
    chosen = chosen[np.argsort(-mu[chosen], kind="stable")]
    target, pose = np.argwhere(model.measured_mask)[chosen].T
    distance = np.linalg.norm(model.point_errors(optimum.x), axis=-1)  # (m, k)
    names = (model.names.target_names[i] for i in target)
    numbers = (part.tolist() for part in (file_lines[pose], distance[pose, target], mu[chosen]))
    return Certificate(
        value=float(size * norms.max()),
        bound=float(size * dual_lower_bound(rows, problem.lower, problem.upper, given)),
        kkt=measure_kkt(linearise_norms(rows), mu, given.lam, problem.lower, problem.upper),
        points=tuple(starmap(DecidingPoint, zip(names, *numbers, strict=True))),
    )


def linearise_norms(rows: LinearisedNorms) -> Linearisation:
    """The norms as plain functions; a norm of zero has no gradient."""
    norms = rows.norms
    unit = rows.r / np.where(norms > 0.0, norms, 1.0)[:, None]
    jacobian = np.einsum("nw,nwp->np", unit, rows.J)
    unknown: Callable[[Array], Array] = lambda weights: np.zeros((0, 0))  # noqa: E731
    return Linearisation(norms, jacobian, rows.c, rows.C, unknown)
