"""Fits that a few wrong points cannot pull: losses that grow more slowly than the square.

From a fit to the points that belong together (`trimmed`) a loss of the points' distances is
minimised by iteratively reweighted separable least squares, with the scale held [Yohai 1987].

In concentration steps the points farthest off leave the fit, until the same ones do twice.  Points
are judged by all others (`suspects.scores`), so that one which draws the fit to itself is found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self, TypeVar

import numpy as np

from minimax_cal.fitting.suspects import (
    EXPLANATION,
    LEAST_SCALE,
    RIDGE,
    Scores,
    Spread,
    Suspect,
    scores,
    spread_of,
    suspects_of,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.modelling.model import Model
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers.least_squares import LeastSquares, solve_normal
from minimax_cal.solvers.status import Status

SOFT, STEPS = 8, 20  # reweighted rounds of the start, concentration steps

Fitter = Callable[[Model, State], tuple[Model, LeastSquares[State]]]


class Reweighted(Protocol):
    """A least-squares fit whose points, or whatever was measured at once, have weights."""

    @property
    def weights(self) -> Array:
        """Of the points, besides those of the measurements."""

    def again(self, weights: Array) -> Self:
        """The fit with other weights, from here."""

    def scores(self) -> Scores:
        """How far off each point is."""

    def spread(self, found: Scores) -> Spread:
        """How ordinary points scatter."""

    def sizes(self, loss: Loss, scale: float) -> Array:
        """Distance of each point from its prediction, in tunings of a loss at a scale."""

    def most(self, share: float) -> int:
        """How many points may leave."""

    def unsettled(self) -> Self:
        """The same, its status telling that the rounds did not come to rest."""


W = TypeVar("W", bound=Reweighted)


@dataclass(frozen=True, eq=False)
class Weighted:
    """A least-squares fit whose points have weights besides those of the measurements.

    fitter: fits a model from a state; it may renew the model's prior.  plain: the model without
    the weights (k, m).  judged: (k,) False for targets that only follow the others.
    rounds: how many fits led here.
    """

    fitter: Fitter
    plain: Model
    found: LeastSquares[State]
    weights: Array
    judged: Array
    rounds: int = 0

    @property
    def state(self) -> State:
        """The geometry that was fitted."""
        return self.found.x.take(np.array(0))

    @property
    def model(self) -> Model:
        """The model that was fitted."""
        return replace(self.plain, weight=self.plain.weight * self.weights)

    @property
    def count(self) -> int:
        """Number of points that are judged."""
        return int(self.plain.seen[self.judged].sum())

    def again(self, weights: Array) -> Weighted:
        """The fit with other weights (k, m), from here; targets that follow keep theirs."""
        weights = np.where(self.judged[:, None], weights, 1.0) * self.plain.seen
        model = replace(self.plain, weight=self.plain.weight * weights)
        model, found = self.fitter(model, self.state)
        plain = self.plain.with_prior(model.prior)
        return replace(self, plain=plain, found=found, weights=weights, rounds=self.rounds + 1)

    def scores(self) -> Scores:
        """How far off each point is, those of the judged targets."""
        if not np.isfinite(self.found.cost).all():  # a fit that diverged tells of no point
            return Scores(np.zeros(self.weights.shape), np.zeros(self.weights.shape, dtype=int))
        found = scores(self.plain, self.state, self.weights)
        return replace(found, directions=np.where(self.judged[:, None], found.directions, 0))

    def spread(self, found: Scores) -> Spread:
        """How ordinary points scatter."""
        used = np.count_nonzero(self.weights[self.judged])
        return spread_of(found, max(3.0 * used - float(self.plain.active.sum()), 1.0))

    def sizes(self, loss: Loss, scale: float) -> Array:
        """Distance of each point from its prediction, in tunings of a loss at a scale."""
        return distances(self.plain, self.state) / (scale * loss.tuning)

    def most(self, share: float) -> int:
        """How many points may leave."""
        return leaving(share, self.count, -(-int(self.plain.active.sum()) // 3))

    def unsettled(self) -> Weighted:
        """The same, its status telling that the rounds did not come to rest."""
        return replace(self, found=replace(self.found, status=(Status.ITERATION_LIMIT,)))


def leaving(share: float, count: int, needed: int) -> int:
    """How many points may leave: no more than leave the others a majority, counting what determines
    the parameters [Rousseeuw and Leroy 1987, ch. 3].
    """
    return max(min(int(share * count), (count - needed - 1) // 2), 0)


def farthest(square: Array, count: int) -> Array:
    """(k, m) True for the points farthest off, so many, the first of equals."""
    out = np.zeros(square.size, dtype=bool)
    out[np.argsort(-square, axis=None, kind="stable")[:count]] = True
    return out.reshape(square.shape)


def leave(at: W, goes: Callable[[Scores], Array]) -> W:
    """Fits without the points that go (k, m), to a fixed point; who comes and goes stays in."""
    before: list[Array] = []
    for _ in range(STEPS):
        away = goes(at.scores())
        again = [step for step, other in enumerate(before) if np.array_equal(away, other)]
        if again:
            cycle = before[again[0] :]
            common = np.logical_and.reduce(cycle)
            return at if len(cycle) == 1 else at.again(np.where(common, 0.0, 1.0))
        before.append(away)
        at = at.again(np.where(away, 0.0, 1.0))
    return at.unsettled()


def trimmed(at: W, trim: float = 0.0) -> W:
    """The start of a loss: the fit to the points that belong together.  trim: as `robust_fit`."""
    # The sum of distances instead of that of their squares, so that few points pull less.
    # Standardised by leverage: a point that draws the fit to itself is not near.
    for _ in range(SOFT):
        found = at.scores()
        distance = np.sqrt(found.square)
        usual = float(np.median(distance[found.directions > 0])) if found.directions.any() else 0.0
        at = at.again(1.0 / np.maximum(distance / max(usual, LEAST_SCALE), 1.0))

    # Least trimmed squares: a share of the points farthest off leaves [Rousseeuw and Van Driessen
    # 2006, "Computing LTS regression for large data sets"].
    most = at.most(max(trim, START_TRIM))
    at = leave(at, lambda found: farthest(np.where(found.directions > 0, found.square, -1.0), most))

    # Then only outliers leave, and at most the share: the farthest first.
    count = at.most(trim or START_TRIM)

    def select_outliers(found: Scores) -> Array:
        far = at.spread(found).far(found)
        return farthest(np.where(far, found.square, -1.0), count) & far

    return leave(at, select_outliers)


# ---- losses --------------------------------------------------------------------------------------


SQUARE = "square"  # the loss of plain least squares
START_TRIM = 0.3  # share of the points that may leave the start of a loss
MAX_TRIM = 0.5  # no method tells wrong points from right ones where they are the majority
MAX_ROUNDS = 200  # of reweighting
WEIGHT_TOLERANCE = 1e-6  # change of a weight that ends them
MAX_VARIANCE_GROWTH = 100.0  # times the variance: these poses no longer tell a parameter


@dataclass(frozen=True)
class Loss:
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

    def tuned(self, numbers: Array) -> Array:
        """(n,) tuning for errors of so many numbers each (n,)."""
        return np.asarray(np.interp(numbers, np.arange(len(self.tunings)) + 1.0, self.tunings))

    def slope(self, u: Array, numbers: Array | float = 3.0) -> Array:
        """Mean derivative of psi of an error of so many numbers: one along it, others across."""
        return np.asarray((self.derivative(u) + (numbers - 1.0) * self.weight(u)) / numbers)


LOSSES = {  # [Huber 1964; Holland and Welsch 1977; Beaton and Tukey 1974]
    "huber": Loss(
        lambda u: np.asarray(1.0 / np.maximum(u, 1.0)),
        lambda u: np.asarray((u < 1.0) * 1.0),
        (1.345, 1.5011, 1.628, 1.7311, 1.812, 1.8693),
    ),
    "cauchy": Loss(
        lambda u: np.asarray(1.0 / (1.0 + u**2)),
        lambda u: np.asarray((1.0 - u**2) / (1.0 + u**2) ** 2),
        (2.3849, 2.5486, 2.6656, 2.7516, 2.8154, 2.8624),
    ),
    "tukey": Loss(
        lambda u: np.maximum(1.0 - u**2, 0.0) ** 2,
        lambda u: np.where(u < 1.0, (1.0 - u**2) * (1.0 - 5.0 * u**2), 0.0),
        (4.6851, 5.123, 5.4902, 5.8103, 6.0963, 6.3562),
    ),
}


def reweighted(at: W, kept: Array | float, loss: Loss, scale: float) -> W:
    """The minimum of a loss by iteratively reweighted least squares, the scale held.

    kept: (k, m) 0 for points set aside, which stay out.
    """
    for _ in range(MAX_ROUNDS):
        before = at.weights
        at = at.again(kept * loss.weight(at.sizes(loss, scale)))
        if float(np.abs(at.weights - before).max(initial=0.0)) <= WEIGHT_TOLERANCE:
            return at
    return at.unsettled()


def distances(model: Model, state: State) -> Array:
    """(k, m) distance of each point from its prediction, times the root of its weight [m]."""
    parts = [(model.error_of(state, block)[0] ** 2).sum(axis=-2) for block in model.blocks(state)]
    return np.asarray(np.sqrt(np.concatenate(parts, axis=-1)))


@dataclass(frozen=True, eq=False, kw_only=True)
class Robust(Weighted):
    """A fit whose points have weights, as it ended: from 0 to 1, and 0 where not measured.

    kept: its model with the points set aside at weight 0, not weighted by the loss.
    loss_scale: standard deviation of a coordinate at which the loss was taken [m].
    line: (m,) of the file.
    """

    kept: Model
    loss: str
    loss_scale: float
    line: Array
    notices: tuple[str, ...] = ()

    @cached_property
    def scored(self) -> tuple[Scores, Spread]:
        """How far off each point is, and how ordinary points scatter."""
        found = self.scores()
        return found, self.spread(found)

    @property
    def scale(self) -> float:
        """Standard deviation of a coordinate of an ordinary point [m], of the typical weight."""
        return self.scored[1].scale

    @cached_property
    def suspects(self) -> tuple[Suspect, ...]:
        """The points that stand out from the fit, the least likely first."""
        return suspects_of(self.plain, self.state, *self.scored, self.line)

    @property
    def by_pose(self) -> Model:
        """The model with one weight a pose, the least of its targets': a pose needs them all."""
        least = np.where(self.plain.seen, self.weights, 1.0).min(axis=0)
        return replace(self.plain, weight=self.plain.weight * least)


def check_robust(loss: str, trim: float = 0.0) -> None:
    """Raise OptionError for a choice that does not exist."""
    if loss not in (SQUARE, *LOSSES):
        raise OptionError(f"no loss {loss!r}; choose {', '.join((SQUARE, *LOSSES))}")
    if not 0.0 <= trim < MAX_TRIM:
        raise OptionError(f"trim {trim:g}: give a share of the points, 0 <= trim < {MAX_TRIM:g}")


def robust_fit(
    fitter: Fitter,
    plain: Model,
    found: LeastSquares[State],
    line: Array,
    loss: str = SQUARE,
    trim: float = 0.0,
    *,
    judged: Array,
) -> Robust:
    """Minimise a loss of the distances, with at most a share of the points set aside.

    fitter: least squares of a model from a state.  plain, found: the plain fit, where it starts.
    line: (m,) of the file, for the list of suspects.  trim: the share.  judged: (k,) False for
    targets that do not pull at the fit.  Raises OptionError.
    """
    check_robust(loss, trim)
    seen = plain.seen.astype(float)
    at, kept = Weighted(fitter, plain, found, seen, judged), seen
    scale = np.nan
    if not np.isfinite(found.cost).all():  # its status tells why; there is nothing to start from
        loss, trim = SQUARE, 0.0
    if loss != SQUARE or trim > 0.0:
        at = trimmed(at, trim)
        kept = at.weights if trim else seen
    if loss != SQUARE:
        scale = at.spread(at.scores()).scale
        at = reweighted(at, kept, LOSSES[loss], scale)
    kept_model = replace(at.plain, weight=plain.weight * kept)
    robust = Robust(**vars(at), kept=kept_model, loss=loss, loss_scale=scale, line=line)
    return replace(robust, notices=tuple(remarks(robust, kept, trim))) if at.rounds else robust


def remarks(at: Robust, kept: Array, trim: float) -> Iterator[str]:
    """What the reader should know beside the list of suspects."""
    suspects, away = at.suspects, int((at.plain.seen & (kept == 0.0)).sum())
    if suspects:
        yield f"{len(suspects)} of {at.count} points are outliers: {EXPLANATION}"
    if trim:
        yield f"trim {trim:g}: {away} of {at.count} points are set aside"
    more = f"trim {trim:g}: {len(suspects) - away} more outliers"
    if trim and len(suspects) > away and away == at.most(trim):
        yield f"{more} affect the fit; give a larger share or another loss"
    elif trim and len(suspects) > away:
        yield f"{more}, but not in a fit without them; they stay in it"
    names = at.plain.names.all
    lost = ", ".join(names[i] for i in np.flatnonzero(at.plain.active)[unidentified(at)])
    if lost:
        yield f"without the outliers the poses hardly determine {lost}"


def unidentified(at: Weighted) -> Array:
    """(free,) True for parameters whose variance the weights raise by a factor UNTOLD or more."""
    prior = np.diag(at.plain.prior.weight[at.plain.active])
    both = [
        model.normal(at.state, model.active).gram.sum(axis=0) + prior
        for model in (at.plain, at.model)
    ]
    ridge = RIDGE * np.diag(np.diag(both[0]))
    before, after = (np.diag(solve_normal(gram + ridge, np.eye(len(gram)))) for gram in both)
    return np.asarray(after > MAX_VARIANCE_GROWTH * before)


def moments(model: Model, state: State, loss: str, scale: float) -> tuple[Array, Array]:
    """What a loss does to the covariance of a fit [Huber and Ronchetti 2009, 7.6].

    With psi = rho' along the error, of each target: (k,) mean derivative of psi, a third along and
    two thirds across, and (k,) mean of psi^2 per coordinate [m^2].  Least squares has ones and the
    mean square error.  scale: `Robust.loss_scale`.
    """
    size = distances(model, state)
    counts = np.maximum(model.counts, 1)
    if loss == SQUARE:
        return np.ones(len(size)), (size**2).sum(axis=1) / (3.0 * counts)
    own = LOSSES[loss]
    u = size / (scale * own.tuning)
    derivative = np.where(model.seen, own.slope(u), 0.0)
    square = (own.weight(u) * size) ** 2
    return derivative.sum(axis=1) / counts, square.sum(axis=1) / (3.0 * counts)


def flatness(robust: Robust, state: State) -> float:
    """By how much a loss pulls less, for small changes, than the weights of its fit: at least 1.

    The sandwich of a weighted fit takes the weights for given; the true slope of psi is less.
    """
    if robust.loss == SQUARE or not np.isfinite(robust.loss_scale):
        return 1.0
    derivative, _ = moments(robust.kept, state, robust.loss, robust.loss_scale)
    return float(robust.weights[robust.kept.seen].sum() / (derivative * robust.kept.counts).sum())
