"""Fits that a few wrong points cannot pull: losses that grow more slowly than the square.

From a fit to the points that belong together (`fit_trimmed_start`) a loss of the points' distances
is minimised by iteratively reweighted separable least squares, with the scale held [Yohai 1987].

In concentration steps the points farthest off leave the fit, until the same ones do twice.  Points
are judged by all others (`suspects.standardised_point_scores`), so that one which draws the fit to
itself is found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self, TypeVar

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.fitting.outliers import (
    MIN_RELATIVE_PIVOT,
    MIN_SCALE,
    OUTLIER_EXPLANATION,
    Outlier,
    PointScores,
    StudentSpread,
    estimate_spread,
    list_outliers,
    standardised_point_scores,
)
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointModel
from minimax_cal.solvers.least_squares import LeastSquaresSolution, solve_normal_equations
from minimax_cal.solvers.status import Status

SOFTENING_ROUNDS, MAX_CONCENTRATION_STEPS = (
    8,
    20,
)  # reweighted rounds of the start, concentration steps

Fitter = Callable[
    [PointModel, ParameterValues], tuple[PointModel, LeastSquaresSolution[ParameterValues]]
]


class ReweightedFit(Protocol):
    """A least-squares fit whose points, or whatever was measured at once, have weights."""

    @property
    def weights(self) -> Array:
        """Of the points, besides those of the measurements."""

    def refit_with_weights(self, weights: Array) -> Self:
        """The fit with other weights, from here."""

    def scores(self) -> PointScores:
        """How far off each point is."""

    def spread(self, found: PointScores) -> StudentSpread:
        """How ordinary points scatter."""

    def standardised_distances(self, loss: RobustLoss, scale: float) -> Array:
        """Distance of each point from its prediction, in tunings of a loss at a scale."""

    def max_trimmed_count(self, share: float) -> int:
        """How many points may leave."""

    def with_iteration_limit_status(self) -> Self:
        """The same, its status telling that the rounds did not come to rest."""


W = TypeVar("W", bound=ReweightedFit)


@dataclass(frozen=True, eq=False)
class WeightedFit:
    """A least-squares fit whose points have weights besides those of the measurements.

    fitter: fits a model from a state; it may renew the model's prior.  unweighted_model: the model
    without the weights (k, m).  is_judged: (k,) False for targets that only follow the others.
    rounds: how many fits led here.
    """

    fitter: Fitter
    unweighted_model: PointModel
    least_squares: LeastSquaresSolution[ParameterValues]
    weights: Array
    is_judged: Array
    rounds: int = 0

    @property
    def state(self) -> ParameterValues:
        """The geometry that was fitted."""
        return self.least_squares.x.take(np.array(0))

    @property
    def model(self) -> PointModel:
        """The model that was fitted."""
        return replace(self.unweighted_model, weight=self.unweighted_model.weight * self.weights)

    @property
    def count(self) -> int:
        """Number of points that are judged."""
        return int(self.unweighted_model.measured_mask[self.is_judged].sum())

    def refit_with_weights(self, weights: Array) -> WeightedFit:
        """The fit with other weights (k, m), from here; targets that follow keep theirs."""
        weights = (
            np.where(self.is_judged[:, None], weights, 1.0) * self.unweighted_model.measured_mask
        )
        model = replace(self.unweighted_model, weight=self.unweighted_model.weight * weights)
        model, found = self.fitter(model, self.state)
        plain = self.unweighted_model.with_prior(model.prior)
        return replace(
            self,
            unweighted_model=plain,
            least_squares=found,
            weights=weights,
            rounds=self.rounds + 1,
        )

    def scores(self) -> PointScores:
        """How far off each point is, those of the judged targets."""
        if not np.isfinite(self.least_squares.cost).all():  # a fit that diverged tells of no point
            return PointScores(
                np.zeros(self.weights.shape), np.zeros(self.weights.shape, dtype=int)
            )
        found = standardised_point_scores(self.unweighted_model, self.state, self.weights)
        return replace(found, directions=np.where(self.is_judged[:, None], found.directions, 0))

    def spread(self, found: PointScores) -> StudentSpread:
        """How ordinary points scatter."""
        used = np.count_nonzero(self.weights[self.is_judged])
        return estimate_spread(
            found, max(3.0 * used - float(self.unweighted_model.active.sum()), 1.0)
        )

    def standardised_distances(self, loss: RobustLoss, scale: float) -> Array:
        """Distance of each point from its prediction, in tunings of a loss at a scale."""
        return weighted_point_distances(self.unweighted_model, self.state) / (scale * loss.tuning)

    def max_trimmed_count(self, share: float) -> int:
        """How many points may leave."""
        return max_leaving_points(
            share, self.count, -(-int(self.unweighted_model.active.sum()) // 3)
        )

    def with_iteration_limit_status(self) -> WeightedFit:
        """The same, its status telling that the rounds did not come to rest."""
        return replace(
            self, least_squares=replace(self.least_squares, status=(Status.ITERATION_LIMIT,))
        )


def max_leaving_points(trim_fraction: float, point_count: int, needed_points: int) -> int:
    """How many points may leave: no more than leave the others a majority, counting what determines
    the parameters [Rousseeuw and Leroy 1987, ch. 3].
    """
    return max(min(int(trim_fraction * point_count), (point_count - needed_points - 1) // 2), 0)


def select_farthest_points(squared_distances: Array, point_count: int) -> Array:
    """(k, m) True for the points farthest off, so many, the first of equals."""
    out = np.zeros(squared_distances.size, dtype=bool)
    out[np.argsort(-squared_distances, axis=None, kind="stable")[:point_count]] = True
    return out.reshape(squared_distances.shape)


def drop_points_until_stable(fit: W, select_points: Callable[[PointScores], Array]) -> W:
    """Fits without the points that go (k, m), to a fixed point; who comes and goes stays in."""
    before: list[Array] = []
    for _ in range(MAX_CONCENTRATION_STEPS):
        away = select_points(fit.scores())
        again = [step for step, other in enumerate(before) if np.array_equal(away, other)]
        if again:
            cycle = before[again[0] :]
            common = np.logical_and.reduce(cycle)
            return fit if len(cycle) == 1 else fit.refit_with_weights(np.where(common, 0.0, 1.0))
        before.append(away)
        fit = fit.refit_with_weights(np.where(away, 0.0, 1.0))
    return fit.with_iteration_limit_status()


def fit_trimmed_start(fit: W, trim_fraction: float = 0.0) -> W:
    """The start of a loss: the fit to the points that belong together.  trim_fraction: as
    `fit_robust_loss`.
    """
    # The sum of distances instead of that of their squares, so that few points pull less.
    # Standardised by leverage: a point that draws the fit to itself is not near.
    for _ in range(SOFTENING_ROUNDS):
        found = fit.scores()
        distance = np.sqrt(found.square)
        usual = float(np.median(distance[found.directions > 0])) if found.directions.any() else 0.0
        fit = fit.refit_with_weights(1.0 / np.maximum(distance / max(usual, MIN_SCALE), 1.0))

    # Least trimmed squares: a share of the points farthest off leaves [Rousseeuw and Van Driessen
    # 2006, "Computing LTS regression for large data sets"].
    most = fit.max_trimmed_count(max(trim_fraction, START_TRIM_FRACTION))
    fit = drop_points_until_stable(
        fit,
        lambda found: select_farthest_points(
            np.where(found.directions > 0, found.square, -1.0), most
        ),
    )

    # Then only outliers leave, and at most the share: the farthest first.
    count = fit.max_trimmed_count(trim_fraction or START_TRIM_FRACTION)

    def select_outliers(found: PointScores) -> Array:
        far = fit.spread(found).is_outlier(found)
        return select_farthest_points(np.where(far, found.square, -1.0), count) & far

    return drop_points_until_stable(fit, select_outliers)


# ---- losses --------------------------------------------------------------------------------------


SQUARE_LOSS = "square"  # the loss of plain least squares
START_TRIM_FRACTION = 0.3  # share of the points that may leave the start of a loss
MAX_TRIM_FRACTION = 0.5  # no method tells wrong points from right ones where they are the majority
MAX_REWEIGHTING_ROUNDS = 200  # of reweighting
MAX_WEIGHT_CHANGE = 1e-6  # change of a weight that ends them
MAX_VARIANCE_GROWTH = 100.0  # times the variance: these poses no longer tell a parameter


@dataclass(frozen=True)
class RobustLoss:
    """rho(z) of a point's distance in robust standard deviations, by the weight rho'(z) / z.

    weight, derivative: of u = z / tuning, (n,): the weight, and the derivative of u weight(u).
    tunings: what makes the fit 95 % as efficient as least squares where all errors are Gaussian, in
    one to six dimensions.
    """

    weight: Callable[[Array], Array]
    derivative: Callable[[Array], Array]
    tunings: tuple[float, ...]

    @property
    def tuning(self) -> float:
        """Of points."""
        return self.tunings[2]

    def interpolate_tuning(self, numbers: Array) -> Array:
        """(n,) tuning for errors of so many numbers each (n,)."""
        return np.asarray(np.interp(numbers, np.arange(len(self.tunings)) + 1.0, self.tunings))

    def mean_psi_slope(self, u: Array, numbers: Array | float = 3.0) -> Array:
        """Mean derivative of psi of an error of so many numbers: one along it, others across."""
        return np.asarray((self.derivative(u) + (numbers - 1.0) * self.weight(u)) / numbers)


LOSSES = {  # [Huber 1964; Holland and Welsch 1977; Beaton and Tukey 1974]
    "huber": RobustLoss(
        lambda u: np.asarray(1.0 / np.maximum(u, 1.0)),
        lambda u: np.asarray((u < 1.0) * 1.0),
        (1.345, 1.5011, 1.628, 1.7311, 1.812, 1.8693),
    ),
    "cauchy": RobustLoss(
        lambda u: np.asarray(1.0 / (1.0 + u**2)),
        lambda u: np.asarray((1.0 - u**2) / (1.0 + u**2) ** 2),
        (2.3849, 2.5486, 2.6656, 2.7516, 2.8154, 2.8624),
    ),
    "tukey": RobustLoss(
        lambda u: np.maximum(1.0 - u**2, 0.0) ** 2,
        lambda u: np.where(u < 1.0, (1.0 - u**2) * (1.0 - 5.0 * u**2), 0.0),
        (4.6851, 5.123, 5.4902, 5.8103, 6.0963, 6.3562),
    ),
}


def minimise_loss_by_reweighting(
    fit: W, kept_weights: Array | float, loss: RobustLoss, scale: float
) -> W:
    """The minimum of a loss by iteratively reweighted least squares, the scale held.

    kept_weights: (k, m) 0 for points set aside, which stay out.
    """
    for _ in range(MAX_REWEIGHTING_ROUNDS):
        before = fit.weights
        fit = fit.refit_with_weights(
            kept_weights * loss.weight(fit.standardised_distances(loss, scale))
        )
        if float(np.abs(fit.weights - before).max(initial=0.0)) <= MAX_WEIGHT_CHANGE:
            return fit
    return fit.with_iteration_limit_status()


def weighted_point_distances(model: PointModel, state: ParameterValues) -> Array:
    """(k, m) distance of each point from its prediction, times the root of its weight [m]."""
    parts = [
        (model.block_errors_and_points(state, block)[0] ** 2).sum(axis=-2)
        for block in model.split_into_blocks(state)
    ]
    return np.asarray(np.sqrt(np.concatenate(parts, axis=-1)))


@dataclass(frozen=True, eq=False, kw_only=True)
class RobustFit(WeightedFit):
    """A fit whose points have weights, as it ended: from 0 to 1, and 0 where not measured.

    kept: its model with the points set aside at weight 0, not weighted by the loss.
    loss_scale: standard deviation of a coordinate at which the loss was taken [m].
    line: (m,) of the file.
    """

    kept: PointModel
    loss: str
    loss_scale: float
    line: Array
    notices: tuple[str, ...] = ()

    @cached_property
    def scores_and_spread(self) -> tuple[PointScores, StudentSpread]:
        """How far off each point is, and how ordinary points scatter."""
        found = self.scores()
        return found, self.spread(found)

    @property
    def scale(self) -> float:
        """Standard deviation of a coordinate of an ordinary point [m], of the typical weight."""
        return self.scores_and_spread[1].scale

    @cached_property
    def suspects(self) -> tuple[Outlier, ...]:
        """The points that stand out from the fit, the least likely first."""
        return list_outliers(self.unweighted_model, self.state, *self.scores_and_spread, self.line)

    @property
    def model_weighted_by_pose(self) -> PointModel:
        """The model with one weight a pose, the least of its targets': a pose needs them all."""
        least = np.where(self.unweighted_model.measured_mask, self.weights, 1.0).min(axis=0)
        return replace(self.unweighted_model, weight=self.unweighted_model.weight * least)


def check_loss_and_trim(loss: str, trim: float = 0.0) -> None:
    """Raise OptionError for a choice that does not exist."""
    if loss not in (SQUARE_LOSS, *LOSSES):
        raise OptionError(f"no loss {loss!r}; choose {', '.join((SQUARE_LOSS, *LOSSES))}")
    if not 0.0 <= trim < MAX_TRIM_FRACTION:
        raise OptionError(
            f"trim {trim:g}: give a share of the points, 0 <= trim < {MAX_TRIM_FRACTION:g}"
        )


def fit_robust_loss(
    fit_least_squares: Fitter,
    model: PointModel,
    least_squares: LeastSquaresSolution[ParameterValues],
    file_lines: Array,
    loss: str = SQUARE_LOSS,
    trim_fraction: float = 0.0,
    *,
    is_judged: Array,
) -> RobustFit:
    """Minimise a loss of the distances, with at most a share of the points set aside.

    fit_least_squares: least squares of a model from a state.  model, least_squares: the plain fit,
    where it starts. file_lines: (m,) of the file, for the list of suspects.  trim_fraction: the
    share.  is_judged: (k,) False for targets that do not pull at the fit.  Raises OptionError.
    """
    check_loss_and_trim(loss, trim_fraction)
    seen = model.measured_mask.astype(float)
    at, kept = WeightedFit(fit_least_squares, model, least_squares, seen, is_judged), seen
    scale = np.nan
    if not np.isfinite(
        least_squares.cost
    ).all():  # its status tells why; there is nothing to start from
        loss, trim_fraction = SQUARE_LOSS, 0.0
    if loss != SQUARE_LOSS or trim_fraction > 0.0:
        at = fit_trimmed_start(at, trim_fraction)
        kept = at.weights if trim_fraction else seen
    if loss != SQUARE_LOSS:
        scale = at.spread(at.scores()).scale
        at = minimise_loss_by_reweighting(at, kept, LOSSES[loss], scale)
    kept_model = replace(at.unweighted_model, weight=model.weight * kept)
    robust = RobustFit(**vars(at), kept=kept_model, loss=loss, loss_scale=scale, line=file_lines)
    return (
        replace(robust, notices=tuple(list_robust_notices(robust, kept, trim_fraction)))
        if at.rounds
        else robust
    )


def list_robust_notices(fit: RobustFit, kept_weights: Array, trim: float) -> Iterator[str]:
    """What the reader should know beside the list of suspects."""
    suspects, away = (
        fit.suspects,
        int((fit.unweighted_model.measured_mask & (kept_weights == 0.0)).sum()),
    )
    if suspects:
        yield f"{len(suspects)} of {fit.count} points are outliers: {OUTLIER_EXPLANATION}"
    if trim:
        yield f"trim {trim:g}: {away} of {fit.count} points are set aside"
    more = f"trim {trim:g}: {len(suspects) - away} more outliers"
    if trim and len(suspects) > away and away == fit.max_trimmed_count(trim):
        yield f"{more} affect the fit; give a larger share or another loss"
    elif trim and len(suspects) > away:
        yield f"{more}, but not in a fit without them; they stay in it"
    names = fit.unweighted_model.names.all_names
    lost = ", ".join(
        names[i] for i in np.flatnonzero(fit.unweighted_model.active)[find_lost_parameters(fit)]
    )
    if lost:
        yield f"without the outliers the poses hardly determine {lost}"


def find_lost_parameters(fit: WeightedFit) -> Array:
    """(free,) True for parameters whose variance the weights raise by a factor UNTOLD or more."""
    prior = np.diag(fit.unweighted_model.prior.weight[fit.unweighted_model.active])
    both = [
        model.normal_equations(fit.state, model.active).gram.sum(axis=0) + prior
        for model in (fit.unweighted_model, fit.model)
    ]
    ridge = MIN_RELATIVE_PIVOT * np.diag(np.diag(both[0]))
    before, after = (
        np.diag(solve_normal_equations(gram + ridge, np.eye(len(gram)))) for gram in both
    )
    return np.asarray(after > MAX_VARIANCE_GROWTH * before)


def loss_moments(
    model: PointModel, state: ParameterValues, loss: str, scale: float
) -> tuple[Array, Array]:
    """What a loss does to the covariance of a fit [Huber and Ronchetti 2009, 7.6].

    With psi = rho' along the error, of each target: (k,) mean derivative of psi, a third along and
    two thirds across, and (k,) mean of psi^2 per coordinate [m^2].  Least squares has ones and the
    mean square error.  scale: `RobustFit.loss_scale`.
    """
    size = weighted_point_distances(model, state)
    counts = np.maximum(model.pose_counts_by_target, 1)
    if loss == SQUARE_LOSS:
        return np.ones(len(size)), (size**2).sum(axis=1) / (3.0 * counts)
    own = LOSSES[loss]
    u = size / (scale * own.tuning)
    derivative = np.where(model.measured_mask, own.mean_psi_slope(u), 0.0)
    square = (own.weight(u) * size) ** 2
    return derivative.sum(axis=1) / counts, square.sum(axis=1) / (3.0 * counts)


def loss_sigma_factor(robust: RobustFit, state: ParameterValues) -> float:
    """By how much a loss pulls less, for small changes, than the weights of its fit: at least 1.

    The sandwich of a weighted fit takes the weights for given; the true slope of psi is less.
    """
    if robust.loss == SQUARE_LOSS or not np.isfinite(robust.loss_scale):
        return 1.0
    derivative, _ = loss_moments(robust.kept, state, robust.loss, robust.loss_scale)
    return float(
        robust.weights[robust.kept.measured_mask].sum()
        / (derivative * robust.kept.pose_counts_by_target).sum()
    )
