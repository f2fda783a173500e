"""The worst error as a minimax problem, with the distances between targets kept [paper M].

The worst target, f_i = F_i / m_i, as in the paper; or the worst of all measured points.  Values are
divided by their size at the start and parameters scaled to unit curvature: the solver then sees
numbers near one, whatever the robot's size and the instrument's noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.model import Model, moved
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers.minimax import Linear

DISTANCE_FORMS = ("two-sided", "squared", "off")
MIN_TRUSTED_WEIGHT = 0.5  # a point of less weight tells no distance between targets
LEAST_TOLERANCE = 1e-6  # a distance is never asked to hold better than a micrometre [m]


@dataclass(frozen=True, eq=False)
class Distances:
    """What the instrument says about the distances between targets [paper M, eq. 8].

    pairs: (l, 2) indices of targets measured together.  mean: (l,) mean measured distance [m].
    tolerance: (l,) how far the model's distance may lie from it, sqrt(eps) of the paper [m].
    """

    pairs: Array
    mean: Array
    tolerance: Array


def measured_distances(data: Measurements, tolerance: float | None = None) -> Distances:
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
    return Distances(
        np.array(pairs, dtype=int).reshape(-1, 2),
        np.array(mean),
        np.maximum(scatter, LEAST_TOLERANCE),
    )


def trusted_distances(
    data: Measurements, weights: Array, tolerance: float | None = None
) -> Distances:
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
    model: Model
    distances: Distances
    start: State
    first: Sensitivity
    scale: Array
    size: float
    form: str

    @cached_property
    def lower(self) -> Array:
        """Lower bounds of the scaled distance deviations, and of the effects' parameters."""
        count = len(self.distances.mean)
        least = np.full(count, -1.0 if self.form == "two-sided" else -np.inf)
        return np.concatenate([least, self.room[:, 0]])

    @cached_property
    def upper(self) -> Array:
        """Upper bounds of the same."""
        return np.concatenate([np.ones(len(self.distances.mean)), self.room[:, 1]])

    @cached_property
    def held(self) -> Array:
        """(b,) the free parameters, by their place among these, that have bounds."""
        model = self.model
        ends = np.full((model.names.count, 2), np.inf) * [-1.0, 1.0]
        if len(model.room):
            ends[model.names.geometric :] = model.room
        return np.flatnonzero(np.isfinite(ends[model.active]).any(axis=1))

    @cached_property
    def room(self) -> Array:
        """(b, 2) their bounds, scaled."""
        if not len(self.held):
            return np.zeros((0, 2))
        which = np.flatnonzero(self.model.active)[self.held] - self.model.names.geometric
        return np.asarray(self.model.room[which] * self.scale[self.held, None])

    @cached_property
    def squared_scale(self) -> Array:
        """(free, free): one divisor an entry, so that a quotient is as symmetric as what it was."""
        return self.size * np.outer(self.scale, self.scale)

    @cached_property
    def columns(self) -> Array:
        """(2, l, 3) the parameters of both targets of each pair."""
        first = 5 * self.model.names.joints + 6
        return first + 3 * self.distances.pairs.T[..., None] + np.arange(3)

    def deviation(self, x: State) -> tuple[Array, Array]:
        """Model minus measured distance, over the tolerance: (l,), and its derivative (l, p).

        Below them the parameters that have bounds, scaled.
        """
        value = self.model.values(x)[self.model.active][self.held] * self.scale[self.held]
        apart, jacobian = self.distance(x)
        own = np.eye(len(self.scale))[self.held]
        return np.concatenate([apart, value]), np.concatenate([jacobian, own])

    def distance(self, x: State) -> tuple[Array, Array]:
        """The part of `deviation` that is about distances."""
        kept = self.distances
        count = len(kept.mean)
        if not count:
            return np.zeros(0), np.zeros((0, len(self.scale)))
        between = x.target_positions[kept.pairs[:, 0]] - x.target_positions[kept.pairs[:, 1]]
        length = np.maximum(np.sqrt((between * between).sum(axis=1)), 1e-12)
        c = (length - kept.mean) / kept.tolerance
        jacobian = np.zeros((count, self.model.names.count))
        unit = between / (length * kept.tolerance)[:, None]
        jacobian[np.arange(count)[:, None], self.columns[0]] = unit
        jacobian[np.arange(count)[:, None], self.columns[1]] = -unit
        if self.form == "squared":
            jacobian, c = 2.0 * c[:, None] * jacobian, c**2
        return c, jacobian[:, self.model.active] / self.scale

    def evaluate(self, x: State) -> tuple[Array, Array]:
        """f and c."""
        value, _ = PER[self.per]
        return (value(self.model, x) + prior_of(self.model, x)) / self.size, self.deviation(x)[0]

    def linearise(self, x: State) -> Linear:
        """f, c and their derivatives; the curvature is Gauss-Newton's 2 J'J."""
        model = self.model
        at = self.first if x is self.start else PER[self.per][1](model, x)
        slope, held, known = at.jacobian, 0.0, bool(model.prior.weight.any())
        if known:
            total, weight = model.counts.sum(), model.prior.weight[model.active]
            off = (model.prior.mean - model.values(x))[model.active]
            slope, held = slope - 2.0 * weight * off / total, prior_of(model, x)
        c, normal = self.deviation(x)

        def curvature(weights: Array) -> Array:
            both = at.curvature(weights)
            if known:
                both = both + 2.0 * weights.sum() * np.diag(weight) / total
            return np.asarray(both / self.squared_scale)

        return Linear(
            f=(at.f + held) / self.size,
            jacobian=slope / (self.size * self.scale),
            c=c,
            normal=normal,
            curvature=curvature,
        )

    def step(self, x: State, d: Array) -> State:
        """The state moved by a scaled step in the free parameters."""
        return moved(self.model, x, d / self.scale)


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """f (n,) [m^2], its derivative (n, free), and the weighted sum of its curvatures."""

    f: Array
    jacobian: Array
    curvature: Callable[[Array], Array]


def prior_of(model: Model, x: State) -> float:
    """The prior's part of every f_i: the share it has in a mean square [m^2]."""
    if not model.prior.weight.any():
        return 0.0
    off = model.prior.mean - model.values(x)
    return float((model.prior.weight * off**2).sum() / model.counts.sum())


def target_values(model: Model, x: State) -> Array:
    """F_i / m_i of every target: (k,) [m^2]."""
    return np.asarray(model.cost(x) / model.counts)


def target_sensitivity(model: Model, x: State) -> Sensitivity:
    """F_i / m_i and its derivatives."""
    normal = model.normal(x, model.active)
    counts = model.counts
    return Sensitivity(
        normal.cost / counts,
        -2.0 * normal.gradient / counts[:, None],
        lambda weights: 2.0 * np.tensordot(weights / counts, normal.gram, 1),
    )


def point_values(model: Model, x: State) -> Array:
    """The squared distance of every measured point, target by target: (points,) [m^2]."""
    parts = [(model.error_of(x, block)[0] ** 2).sum(axis=-2) for block in model.blocks(x)]
    return np.asarray(np.concatenate(parts, axis=-1)[model.seen])


def point_sensitivity(model: Model, x: State) -> Sensitivity:
    """Squared distances and their derivatives."""
    f, jacobian = model.squares(x)

    def curvature(weights: Array) -> Array:
        share = np.zeros(model.seen.shape)
        share[model.seen] = weights
        return 2.0 * model.gram(x, model.weight * share)

    return Sensitivity(f[model.seen], jacobian[model.seen], curvature)


PER = {
    "target": (target_values, target_sensitivity),
    "point": (point_values, point_sensitivity),
}


def minimax_problem(
    model: Model, start: State, distances: Distances, form: str, per: str
) -> MinimaxProblem:
    """The minimax problem scaled at a start.  Raises OptionError for an unknown form."""
    if form not in DISTANCE_FORMS:
        raise OptionError(f"distance form {form!r}; choose {', '.join(DISTANCE_FORMS)}")
    if form == "off":
        none = np.zeros(0)
        distances = Distances(np.zeros((0, 2), dtype=int), none, none)
    first = PER[per][1](model, start)
    size = float(first.f.max())
    size = size if size > 0.0 else 1e-18
    mean = first.curvature(np.full(len(first.f), 1.0 / len(first.f)))
    known = model.prior.weight[model.active] / model.counts.sum()
    scale = np.sqrt(np.maximum((np.diag(mean) + 2.0 * known) / size, 1e-30))
    return MinimaxProblem(per, model, distances, start, first, scale, size, form)
