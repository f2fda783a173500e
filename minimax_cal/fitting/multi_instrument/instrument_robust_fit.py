"""Losses of what any instrument measured at once: a length, a contact, a visit, a point, a pose.

As `fitting.robust` has them of a tracker's points, each instrument by a scale of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.fitting.multi_instrument.instrument_stack import (
    InstrumentBlock,
    InstrumentLeastSquares,
    row_index_in_pose,
)
from minimax_cal.fitting.outliers import (
    OUTLIER_EXPLANATION,
    PointScores,
    StudentSpread,
    estimate_spread,
    hat_matrix_blocks,
    loo_covariance_terms,
    standardise_errors,
)
from minimax_cal.fitting.robust_fit import (
    LOSSES,
    SQUARE_LOSS,
    RobustLoss,
    fit_trimmed_start,
    max_leaving_points,
    minimise_loss_by_reweighting,
)
from minimax_cal.instruments.protocol import MIN_MEAN_WEIGHT
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.solvers.least_squares import LeastSquaresSolution
from minimax_cal.solvers.status import Status

MAX_LOW_WEIGHT = 0.5  # measurements of a lower one are counted for the reader
SolveSquares = Callable[
    [InstrumentLeastSquares, ParameterValues], LeastSquaresSolution[ParameterValues]
]
LossWeights = tuple[Array | float, Array | float]
EQUAL_LOSS_WEIGHTS: LossWeights = (1.0, 1.0)


@dataclass(frozen=True, eq=False)
class InstrumentErrors:
    """What an instrument measured, n times, and its errors at a fit.

    rows: (n, d) of R that belong together, -1 where there are fewer.  is_used: (n, d, d) projector
    on what they tell.  about: (r,) as `ResidualRows` has it.  weight: (R,) by the loss.  degrees:
    independent numbers.  error: (R,) [m].  slope: (free, R) by the root of the block's precision.
    """

    rows: Array
    is_used: Array
    about: Array
    weight: Array
    degrees: int
    error: Array
    slope: Array

    @staticmethod
    def from_block(
        block: InstrumentBlock, x: ParameterValues, error: Array, slope: Array
    ) -> InstrumentErrors:
        """Of a block at its own state."""
        flange, own, one = block.flange(x), block.own_values(x), block.instrument
        read = one.read(flange, own)
        real = np.flatnonzero(read.by_point.any(axis=1) | read.by_rotation.any(axis=1))
        of = (block.part_indices(read) * one.poses + read.pose)[real]
        _, first, of = np.unique(of, return_index=True, return_inverse=True)
        slot = row_index_in_pose(of)
        rows = np.full((len(first), int(slot.max()) + 1), -1)
        rows[of, slot] = real
        live, dead = (
            (rows >= 0)[..., None] * np.eye(rows.shape[1]),
            one.projectors_on_empty_rows(flange, own),
        )
        if dead.size:
            live = live - dead[read.pose[real[first]]]
        weight = np.broadcast_to(block.weight, error.shape)
        return InstrumentErrors(
            rows, live, read.about, weight, one.degrees_of_freedom, error, slope
        )

    @property
    def weights(self) -> Array:
        """(n,)."""
        return self.weight[self.rows[:, 0]]

    @cached_property
    def numbers(self) -> Array:
        """(n,) independent ones of each."""
        return np.asarray(np.round(np.trace(self.is_used, axis1=1, axis2=2)))

    @property
    def effective_count(self) -> float:
        """Independent numbers of those that have a weight."""
        return float(self.degrees - self.numbers[self.weights == 0.0].sum())

    def take_rows(self, values: Array) -> Array:
        """(..., n, d) of the rows (..., R), 0 where there are fewer than d."""
        return np.asarray(values[..., self.rows] * (self.rows >= 0))

    def expand_to_rows(self, values: Array) -> Array:
        """(R,) values (n,) as those of all rows, 1 of sums."""
        out, known = np.ones(len(self.error)), self.rows >= 0
        out[self.rows[known]] = np.repeat(values, known.sum(axis=1))
        return out

    def place_mean_variance(self) -> Array:
        """(n,) what the means about their places take of each variance."""
        if not len(self.about):
            return np.zeros(len(self.rows))
        weight, first = self.weight[: len(self.about)] + MIN_MEAN_WEIGHT, self.rows[:, 0]
        total, twice = (np.bincount(self.about, w)[self.about] for w in (weight, weight**2))
        return np.asarray((2.0 * weight - twice / total) / total)[first]

    def scores(self, cover: Array, spread: Array) -> PointScores:
        """Of each measurement by all others, as `suspects.scores` has them."""
        rows = np.swapaxes(self.take_rows(self.slope), 1, 2)[None]
        hat = 2.0 * self.weights[:, None, None] * hat_matrix_blocks(
            rows, cover
        ) - hat_matrix_blocks(rows, spread)
        left = self.is_used * (1.0 - self.place_mean_variance())[:, None, None] - hat
        square, directions = standardise_errors(left, self.take_rows(self.error)[None])
        return PointScores(square[0], directions[0])


@dataclass(frozen=True, eq=False)
class WeightedInstrumentFit:
    """A fit of b instruments whose measurements have weights, as `robust_fit.ReweightedFit`.

    problem: its rows with weights.
    """

    problem: InstrumentLeastSquares
    found: LeastSquaresSolution[ParameterValues]
    solve: SolveSquares
    rounds: int = 0

    @cached_property
    def parts(self) -> list[InstrumentErrors]:
        """What was measured, block by block."""
        stack, x = self.problem.stack, self.found.x.take(np.array(0))
        rows, roots = stack.rows_by_block(x, self.problem.active), np.sqrt(stack.precision)
        every = enumerate(zip(stack.blocks, roots, rows, strict=True))
        return [
            InstrumentErrors.from_block(b, stack.state_of_block(x, i), e, root * slope)
            for i, (b, root, (e, slope)) in every
        ]

    @property
    def weights(self) -> Array:
        """(n,) of what was measured, block by block."""
        return np.concatenate([part.weights for part in self.parts])

    @cached_property
    def scores_by_block(self) -> tuple[list[PointScores], Array]:
        """How far off each measurement is, by blocks; (b,) degrees of freedom."""
        prior, parts = self.problem.prior, self.parts
        none, once, twice = (
            sum((part.slope * part.weight**power) @ part.slope.T for part in parts)
            for power in (0, 1, 2)
        )
        cover, spread = loo_covariance_terms(none, once, twice, prior)
        paid = [float(((cover @ p.slope) * p.slope * p.weight).sum()) for p in parts]
        spare = np.maximum(
            [p.effective_count - cost for p, cost in zip(parts, paid, strict=True)], 1.0
        )
        return [part.scores(cover, spread) for part in parts], spare

    @cached_property
    def scale(self) -> Array:
        """(b,) sigma of an ordinary row of each block, unless it is held [m]."""
        if len(self.problem.scale):
            return self.problem.scale
        return np.array(
            [estimate_spread(*each).scale for each in zip(*self.scores_by_block, strict=True)]
        )

    def scores(self) -> PointScores:
        """Of all blocks, in units of their scales."""
        every, scale = self.scores_by_block[0], self.scale
        square = [one.square / s**2 for one, s in zip(every, scale, strict=True)]
        return PointScores(
            np.concatenate(square), np.concatenate([one.directions for one in every])
        )

    def spread(self, found: PointScores) -> StudentSpread:
        """How ordinary errors scatter, in those units."""
        return estimate_spread(found, float(self.scores_by_block[1].sum()))

    def standardised_sizes_by_block(self, loss: RobustLoss) -> list[Array]:
        """Of each block: size of each error in tunings of a loss at the scale."""
        return [
            np.sqrt((part.take_rows(part.error) ** 2).sum(axis=1))
            / (s * loss.interpolate_tuning(part.numbers))
            for part, s in zip(self.parts, self.scale, strict=True)
        ]

    def standardised_distances(self, loss: RobustLoss, scale: float) -> Array:
        """Those of all blocks.  scale: in units of theirs."""
        return np.concatenate(self.standardised_sizes_by_block(loss)) / scale

    def refit_with_weights(self, weights: Array) -> WeightedInstrumentFit:
        """The fit with other weights, from here, the instruments weighed by their scales."""
        stack, ends = self.problem.stack, np.cumsum([len(part.rows) for part in self.parts])
        each = zip(stack.blocks, self.parts, np.split(weights, ends[:-1]), strict=True)
        stack = replace(
            stack, blocks=tuple(b.with_row_weights(part.expand_to_rows(w)) for b, part, w in each)
        )
        problem = replace(self.problem, stack=stack).with_variances(
            stack.row_variances(self.scale**2)
        )
        found = self.solve(problem, self.found.x.take(np.array(0)))
        return replace(self, problem=problem, found=found, rounds=self.rounds + 1)

    def max_trimmed_count(self, share: float) -> int:
        """How many measurements may leave."""
        count, numbers = len(self.weights), sum(part.numbers.sum() for part in self.parts)
        return max_leaving_points(
            share, count, int(np.ceil(count * (1.0 - self.scores_by_block[1].sum() / numbers)))
        )

    def with_iteration_limit_status(self) -> WeightedInstrumentFit:
        """The same, its status telling that the rounds did not come to rest."""
        return replace(self, found=replace(self.found, status=(Status.ITERATION_LIMIT,)))

    def covariance_loss_weights(self) -> LossWeights:
        """(rows,) what the loss makes of each row's share, and of its square, in a covariance.

        By the mean derivative of psi, and its mean square, of each block [Huber and Ronchetti 2009,
        7.6], as `fitting.robust_fit.loss_sigma_factor` has it.
        """
        loss, out = LOSSES[self.problem.loss], []
        for part, u, spare in zip(
            self.parts, self.standardised_sizes_by_block(loss), self.scores_by_block[1], strict=True
        ):
            count, w = part.numbers, part.weights
            flat = (count @ loss.mean_psi_slope(u, count)) / (count @ w)
            psi = ((w * u * loss.interpolate_tuning(count)) ** 2).sum() / (count @ w**2)
            psi *= count[w > 0.0].sum() / spare  # as the mean square of a fit without a loss
            out.append([part.expand_to_rows(each) for each in (flat + 0.0 * w, psi * w)])
        share, square = map(np.concatenate, zip(*out, strict=True))
        return share, square

    def notice(self) -> str:
        """How many measurements count less than half."""
        low = [int((part.weights < MAX_LOW_WEIGHT).sum()) for part in self.parts]
        each = ", ".join(
            f"{few} of {len(part.rows)} measurements of {label}"
            for few, part, label in zip(low, self.parts, self.problem.stack.labels, strict=True)
        )
        text = f"loss {self.problem.loss}: {each} count less than half"
        return f"{text}: {OUTLIER_EXPLANATION}" if any(low) else text


def minimise_instrument_loss(
    problem: InstrumentLeastSquares,
    least_squares: LeastSquaresSolution[ParameterValues],
    loss: str,
    solve: SolveSquares,
) -> tuple[InstrumentLeastSquares, LeastSquaresSolution[ParameterValues]]:
    """The minimum of a loss from a fit of squares, and the problem with its weights and scales."""
    if loss == SQUARE_LOSS or not np.isfinite(least_squares.cost).all():  # its status tells why
        return problem, least_squares
    at = WeightedInstrumentFit(replace(problem, scale=np.zeros(0)), least_squares, solve)
    if not any(len(block.share) for block in problem.stack.blocks):  # else weighed by it before
        at = fit_trimmed_start(at)
    at = replace(at, problem=replace(at.problem, loss=loss, scale=at.scale))
    at = minimise_loss_by_reweighting(at, 1.0, LOSSES[loss], 1.0)
    return at.problem, replace(at.found, iterations=at.found.iterations + at.rounds)


def loss_weights_and_notice(
    problem: InstrumentLeastSquares, least_squares: LeastSquaresSolution[ParameterValues]
) -> tuple[LossWeights, tuple[str, ...]]:
    """What a loss does to the covariance of its fit, and a notice."""
    if problem.loss == SQUARE_LOSS:
        return EQUAL_LOSS_WEIGHTS, ()
    at = WeightedInstrumentFit(problem, least_squares, lambda *_: least_squares)
    return at.covariance_loss_weights(), (at.notice(),)
