"""Losses of what any instrument measured at once: a length, a contact, a visit, a point, a pose.

As `fitting.robust` has them of a tracker's points, each instrument by a scale of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from minimax_cal.fitting.robust import LOSSES, SQUARE, Loss, leaving, reweighted, trimmed
from minimax_cal.fitting.several.stack import Block, Squares, place_in
from minimax_cal.fitting.suspects import (
    EXPLANATION,
    Scores,
    Spread,
    covers,
    hat_blocks,
    spread_of,
    standardised,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.instruments.protocol import LEAST_SHARE
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers.least_squares import LeastSquares
from minimax_cal.solvers.status import Status

LOW_WEIGHT = 0.5  # measurements of a lower one are counted for the reader
Solve = Callable[[Squares, State], LeastSquares[State]]
Shares = tuple[Array | float, Array | float]
ALIKE: Shares = (1.0, 1.0)


@dataclass(frozen=True, eq=False)
class Part:
    """What an instrument measured, n times, and its errors at a fit.

    rows: (n, d) of R that belong together, -1 where there are fewer.  live: (n, d, d) projector on
    what they tell.  about: (r,) as `ResidualRows` has it.  weight: (R,) by the loss.  degrees:
    independent numbers.  error: (R,) [m].  slope: (free, R) by the root of the block's precision.
    """

    rows: Array
    live: Array
    about: Array
    weight: Array
    degrees: int
    error: Array
    slope: Array

    @staticmethod
    def of(block: Block, x: State, error: Array, slope: Array) -> Part:
        """Of a block at its own state."""
        flange, own, one = block.flange(x), block.own(x), block.instrument
        read = one.read(flange, own)
        real = np.flatnonzero(read.by_point.any(axis=1) | read.by_rotation.any(axis=1))
        of = (block.part_of(read) * one.poses + read.pose)[real]
        _, first, of = np.unique(of, return_index=True, return_inverse=True)
        slot = place_in(of)
        rows = np.full((len(first), int(slot.max()) + 1), -1)
        rows[of, slot] = real
        live, dead = (rows >= 0)[..., None] * np.eye(rows.shape[1]), one.shapeless(flange, own)
        if dead.size:
            live = live - dead[read.pose[real[first]]]
        weight = np.broadcast_to(block.weight, error.shape)
        return Part(rows, live, read.about, weight, one.degrees, error, slope)

    @property
    def weights(self) -> Array:
        """(n,)."""
        return self.weight[self.rows[:, 0]]

    @cached_property
    def numbers(self) -> Array:
        """(n,) independent ones of each."""
        return np.asarray(np.round(np.trace(self.live, axis1=1, axis2=2)))

    @property
    def counted(self) -> float:
        """Independent numbers of those that have a weight."""
        return float(self.degrees - self.numbers[self.weights == 0.0].sum())

    def taken(self, values: Array) -> Array:
        """(..., n, d) of the rows (..., R), 0 where there are fewer than d."""
        return np.asarray(values[..., self.rows] * (self.rows >= 0))

    def spread_out(self, values: Array) -> Array:
        """(R,) values (n,) as those of all rows, 1 of sums."""
        out, known = np.ones(len(self.error)), self.rows >= 0
        out[self.rows[known]] = np.repeat(values, known.sum(axis=1))
        return out

    def of_places(self) -> Array:
        """(n,) what the means about their places take of each variance."""
        if not len(self.about):
            return np.zeros(len(self.rows))
        weight, first = self.weight[: len(self.about)] + LEAST_SHARE, self.rows[:, 0]
        total, twice = (np.bincount(self.about, w)[self.about] for w in (weight, weight**2))
        return np.asarray((2.0 * weight - twice / total) / total)[first]

    def scores(self, cover: Array, spread: Array) -> Scores:
        """Of each measurement by all others, as `suspects.scores` has them."""
        rows = np.swapaxes(self.taken(self.slope), 1, 2)[None]
        hat = 2.0 * self.weights[:, None, None] * hat_blocks(rows, cover) - hat_blocks(rows, spread)
        left = self.live * (1.0 - self.of_places())[:, None, None] - hat
        square, directions = standardised(left, self.taken(self.error)[None])
        return Scores(square[0], directions[0])


@dataclass(frozen=True, eq=False)
class WeightedRows:
    """A fit of b instruments whose measurements have weights, as `fitting.robust.Reweighted`.

    problem: its rows with weights.
    """

    problem: Squares
    found: LeastSquares[State]
    solve: Solve
    rounds: int = 0

    @cached_property
    def parts(self) -> list[Part]:
        """What was measured, block by block."""
        stack, x = self.problem.stack, self.found.x.take(np.array(0))
        rows, roots = stack.rows_by_block(x, self.problem.active), np.sqrt(stack.precision)
        every = enumerate(zip(stack.blocks, roots, rows, strict=True))
        return [Part.of(b, stack.part(x, i), e, root * slope) for i, (b, root, (e, slope)) in every]

    @property
    def weights(self) -> Array:
        """(n,) of what was measured, block by block."""
        return np.concatenate([part.weights for part in self.parts])

    @cached_property
    def judged(self) -> tuple[list[Scores], Array]:
        """How far off each measurement is, by blocks; (b,) degrees of freedom."""
        prior, parts = self.problem.prior, self.parts
        none, once, twice = (
            sum((part.slope * part.weight**power) @ part.slope.T for part in parts)
            for power in (0, 1, 2)
        )
        cover, spread = covers(none, once, twice, prior)
        paid = [float(((cover @ p.slope) * p.slope * p.weight).sum()) for p in parts]
        spare = np.maximum([p.counted - cost for p, cost in zip(parts, paid, strict=True)], 1.0)
        return [part.scores(cover, spread) for part in parts], spare

    @cached_property
    def scale(self) -> Array:
        """(b,) sigma of an ordinary row of each block, unless it is held [m]."""
        if len(self.problem.scale):
            return self.problem.scale
        return np.array([spread_of(*each).scale for each in zip(*self.judged, strict=True)])

    def scores(self) -> Scores:
        """Of all blocks, in units of their scales."""
        every, scale = self.judged[0], self.scale
        square = [one.square / s**2 for one, s in zip(every, scale, strict=True)]
        return Scores(np.concatenate(square), np.concatenate([one.directions for one in every]))

    def spread(self, found: Scores) -> Spread:
        """How ordinary errors scatter, in those units."""
        return spread_of(found, float(self.judged[1].sum()))

    def sizes_of(self, loss: Loss) -> list[Array]:
        """Of each block: size of each error in tunings of a loss at the scale."""
        return [
            np.sqrt((part.taken(part.error) ** 2).sum(axis=1)) / (s * loss.tuned(part.numbers))
            for part, s in zip(self.parts, self.scale, strict=True)
        ]

    def sizes(self, loss: Loss, scale: float) -> Array:
        """Those of all blocks.  scale: in units of theirs."""
        return np.concatenate(self.sizes_of(loss)) / scale

    def again(self, weights: Array) -> WeightedRows:
        """The fit with other weights, from here, the instruments weighed by their scales."""
        stack, ends = self.problem.stack, np.cumsum([len(part.rows) for part in self.parts])
        each = zip(stack.blocks, self.parts, np.split(weights, ends[:-1]), strict=True)
        stack = replace(stack, blocks=tuple(b.weighed(part.spread_out(w)) for b, part, w in each))
        problem = replace(self.problem, stack=stack).believed(stack.variance(self.scale**2))
        found = self.solve(problem, self.found.x.take(np.array(0)))
        return replace(self, problem=problem, found=found, rounds=self.rounds + 1)

    def most(self, share: float) -> int:
        """How many measurements may leave."""
        count, numbers = len(self.weights), sum(part.numbers.sum() for part in self.parts)
        return leaving(share, count, int(np.ceil(count * (1.0 - self.judged[1].sum() / numbers))))

    def unsettled(self) -> WeightedRows:
        """The same, its status telling that the rounds did not come to rest."""
        return replace(self, found=replace(self.found, status=(Status.ITERATION_LIMIT,)))

    def shares(self) -> Shares:
        """(rows,) what the loss makes of each row's share, and of its square, in a covariance.

        By the mean derivative of psi, and its mean square, of each block [Huber and Ronchetti 2009,
        7.6], as `fitting.robust.flatness` has it.
        """
        loss, out = LOSSES[self.problem.loss], []
        for part, u, spare in zip(self.parts, self.sizes_of(loss), self.judged[1], strict=True):
            count, w = part.numbers, part.weights
            flat = (count @ loss.slope(u, count)) / (count @ w)
            psi = ((w * u * loss.tuned(count)) ** 2).sum() / (count @ w**2)
            psi *= count[w > 0.0].sum() / spare  # as the mean square of a fit without a loss
            out.append([part.spread_out(each) for each in (flat + 0.0 * w, psi * w)])
        share, square = map(np.concatenate, zip(*out, strict=True))
        return share, square

    def notice(self) -> str:
        """How many measurements count less than half."""
        low = [int((part.weights < LOW_WEIGHT).sum()) for part in self.parts]
        each = ", ".join(
            f"{few} of {len(part.rows)} measurements of {label}"
            for few, part, label in zip(low, self.parts, self.problem.stack.labels, strict=True)
        )
        text = f"loss {self.problem.loss}: {each} count less than half"
        return f"{text}: {EXPLANATION}" if any(low) else text


def with_loss(
    problem: Squares, found: LeastSquares[State], loss: str, solve: Solve
) -> tuple[Squares, LeastSquares[State]]:
    """The minimum of a loss from a fit of squares, and the problem with its weights and scales."""
    if loss == SQUARE or not np.isfinite(found.cost).all():  # its status tells why
        return problem, found
    at = WeightedRows(replace(problem, scale=np.zeros(0)), found, solve)
    if not any(len(block.share) for block in problem.stack.blocks):  # else weighed by it before
        at = trimmed(at)
    at = replace(at, problem=replace(at.problem, loss=loss, scale=at.scale))
    at = reweighted(at, 1.0, LOSSES[loss], 1.0)
    return at.problem, replace(at.found, iterations=at.found.iterations + at.rounds)


def of_loss(problem: Squares, found: LeastSquares[State]) -> tuple[Shares, tuple[str, ...]]:
    """What a loss does to the covariance of its fit, and a notice."""
    if problem.loss == SQUARE:
        return ALIKE, ()
    at = WeightedRows(problem, found, lambda *_: found)
    return at.shares(), (at.notice(),)
