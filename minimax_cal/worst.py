"""The worst target's error as a minimax problem, with the distances between targets kept [paper M].

f_i = F_i / m_i, divided by its size at the start; parameters are scaled to unit curvature.  The
solver then sees numbers near one, whatever the robot's size and the instrument's noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.data import Measurements
from minimax_cal.errors import OptionError
from minimax_cal.kinematics import Array
from minimax_cal.model import Model, Normal
from minimax_cal.parameters import State
from minimax_cal.solvers.minimax import Linear

DISTANCE_FORMS = ("two-sided", "squared", "off")
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


def measured_distances(data: Measurements, tolerance: float = np.nan) -> Distances:
    """The distances of all pairs measured together, and how well they are known.

    tolerance: for all pairs [m].  NaN takes the instrument's own accuracy: sqrt(2) times the
    typical `u95` where there is such a column, else the scatter of each measured distance.
    """
    pairs, mean, spread = [], [], []
    for a in range(len(data.targets)):
        for b in range(a + 1, len(data.targets)):
            distance = np.linalg.norm(data.y[:, a] - data.y[:, b], axis=-1)
            distance = distance[np.isfinite(distance)]
            if len(distance):
                pairs.append((a, b))
                mean.append(distance.mean())
                spread.append(distance.std(ddof=1) if len(distance) > 1 else np.inf)
    scatter = np.array(spread)
    if "u95" in data.columns and np.isfinite(data.columns["u95"]).any():
        scatter = np.full(len(pairs), np.sqrt(2.0) * float(np.nanmedian(data.columns["u95"])))
    if np.isfinite(tolerance):
        scatter = np.full(len(pairs), tolerance)
    return Distances(
        np.array(pairs, dtype=int).reshape(-1, 2),
        np.array(mean),
        np.maximum(scatter, LEAST_TOLERANCE),
    )


@dataclass(frozen=True, eq=False)
class WorstTarget:
    """min over x of max_i F_i / m_i, as `solvers.minimax` wants it.

    start, normal: where the scaling was found, and the normal equations there.
    scale: (free,) divides a step's entries.  size: divides the f_i [m^2].
    form: "two-sided" |e| <= tol, or the paper's "squared" e^2 <= tol^2, whose gradient vanishes
    at e = 0, or "off".
    """

    model: Model
    distances: Distances
    start: State
    normal: Normal
    scale: Array
    size: float
    form: str

    @property
    def lower(self) -> Array:
        """Lower bounds of the scaled distance deviations."""
        count = len(self.distances.mean)
        return np.full(count, -1.0 if self.form == "two-sided" else -np.inf)

    @property
    def upper(self) -> Array:
        """Upper bounds of the scaled distance deviations."""
        return np.ones(len(self.distances.mean))

    def deviation(self, x: State) -> tuple[Array, Array]:
        """Model minus measured distance, over the tolerance: (l,), and its derivative (l, p)."""
        pairs, names = self.distances.pairs, self.model.names
        between = x.targets[pairs[:, 0]] - x.targets[pairs[:, 1]]
        length = np.maximum(np.linalg.norm(between, axis=-1), 1e-12)
        c = (length - self.distances.mean) / self.distances.tolerance
        slope = np.zeros((len(pairs), names.count))
        unit = between / length[:, None] / self.distances.tolerance[:, None]
        first = 5 * names.joints + 6
        for row, (a, b) in enumerate(pairs):
            slope[row, first + 3 * a : first + 3 * a + 3] = unit[row]
            slope[row, first + 3 * b : first + 3 * b + 3] = -unit[row]
        if self.form == "squared":
            slope, c = 2.0 * c[:, None] * slope, c**2
        return c, slope[:, self.model.active] / self.scale

    def mean_squares(self, x: State, cost: Array) -> Array:
        """f_i from F_i, the prior added to each in the share it has in the sum of squares."""
        off = self.model.prior.mean - self.model.values(x)
        prior = float((self.model.prior.weight * off**2).sum())
        total = self.model.counts.sum()
        return np.asarray((cost / self.model.counts + prior / total) / self.size)

    def evaluate(self, x: State) -> tuple[Array, Array]:
        """f and c."""
        return self.mean_squares(x, self.model.cost(x)), self.deviation(x)[0]

    def linearise(self, x: State) -> Linear:
        """f, c and their derivatives; the curvature is Gauss-Newton's 2 J'J."""
        model, active = self.model, self.model.active
        normal = self.normal if x is self.start else model.normal(x, active)
        counts, total = model.counts[:, None], model.counts.sum()
        weight = model.prior.weight[active]
        off = (model.prior.mean - model.values(x))[active]
        slope = -2.0 * (normal.slope / counts + weight * off / total)
        curvature = 2.0 * (normal.gram / counts[..., None] + np.diag(weight) / total)
        c, of_c = self.deviation(x)
        return Linear(
            f=self.mean_squares(x, normal.cost),
            slope=slope / self.size / self.scale,
            c=c,
            normal=of_c,
            curvature=curvature / self.size / self.scale[:, None] / self.scale,
        )

    def step(self, x: State, d: Array) -> State:
        """The state moved by a scaled step in the free parameters."""
        full = np.zeros(self.model.names.count)
        full[self.model.active] = d / self.scale
        return x.step(full)


def worst_target(model: Model, start: State, distances: Distances, form: str) -> WorstTarget:
    """The minimax problem scaled at a start.  Raises OptionError for an unknown form."""
    if form not in DISTANCE_FORMS:
        raise OptionError(f"distance form {form!r}; choose {', '.join(DISTANCE_FORMS)}")
    if form == "off":
        none = np.zeros(0)
        distances = Distances(np.zeros((0, 2), dtype=int), none, none)
    normal = model.normal(start, model.active)
    size = float((normal.cost / model.counts).max())
    size = size if size > 0.0 else 1e-18
    mean = np.diag((normal.gram / model.counts[:, None, None]).mean(axis=0))
    mean = mean + model.prior.weight[model.active] / model.counts.sum()
    scale = np.sqrt(np.maximum(2.0 * mean / size, 1e-30))
    return WorstTarget(model, distances, start, normal, scale, size, form)
