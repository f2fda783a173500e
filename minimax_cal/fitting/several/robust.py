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
from minimax_cal.fitting.solve import LEAST_NOISE
from minimax_cal.fitting.suspects import (
    EXPLANATION,
    RIDGE,
    Scores,
    Spread,
    hat_blocks,
    spread_of,
    standardised,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers.least_squares import LeastSquares, solve_normal
from minimax_cal.solvers.status import Status

LOW_WEIGHT = 0.5  # measurements of a lower one are counted for the reader
Solve = Callable[[Squares, State], LeastSquares[State]]


@dataclass(frozen=True, eq=False)
class AtOnce:
    """The rows of an instrument, those of n measurements together.

    rows: (n, d) of each, of d at most, -1 for none.  live: (n, d, d) projector on what they tell.
    about: (r,) as `ResidualRows` has it.  count: of all rows, with sums.
    """

    rows: Array
    live: Array
    about: Array
    count: int

    @staticmethod
    def of(block: Block, x: State) -> AtOnce:
        """Of a block's own state."""
        flange, own, one = block.flange(x), block.own(x), block.instrument
        read = one.read(flange, own)
        real = np.flatnonzero(read.by_point.any(axis=1) | read.by_rotation.any(axis=1))
        of = read.pose[real]
        if len(read.part) and len(one.parts) > 1:  # corners of one pose are no parts of it
            of = of + one.poses * read.part[real]
        _, first, of = np.unique(of, return_index=True, return_inverse=True)
        slot = place_in(of)
        rows = np.full((len(first), int(slot.max()) + 1), -1)
        rows[of, slot] = real
        live, dead = (rows >= 0)[..., None] * np.eye(rows.shape[1]), one.shapeless(flange, own)
        if dead.size:
            live = live - dead[read.pose[real[first]]]
        return AtOnce(rows, live, read.about, len(read.weights))

    @cached_property
    def numbers(self) -> Array:
        """(n,) independent ones of each."""
        return np.asarray(np.round(np.trace(self.live, axis1=1, axis2=2)))

    def taken(self, values: Array) -> Array:
        """(..., n, d) of the rows (..., R), 0 where there are fewer than d."""
        return np.asarray(values[..., self.rows] * (self.rows >= 0))

    def share(self, weights: Array) -> Array:
        """(R,) weights (n,) as those of all rows, 1 of sums."""
        out = np.ones(self.count)
        out[self.rows[self.rows >= 0]] = np.repeat(weights, (self.rows >= 0).sum(axis=1))
        return out

    def of_places(self, share: Array) -> Array:
        """(n,) what the mean about their place takes of each variance.  share: (R,)."""
        if not len(self.about):
            return np.zeros(len(self.rows))
        weight, about = share[: len(self.about)] + 1e-12, self.about[self.rows[:, 0]]
        total, twice = (np.bincount(self.about, w)[about] for w in (weight, weight**2))
        return np.asarray((2.0 * weight[self.rows[:, 0]] - twice / total) / total)


@dataclass(frozen=True, eq=False)
class WeightedRows:
    """A fit of instruments whose measurements have weights, as `fitting.robust.Reweighted`.

    problem: its rows with weights.  every: what was measured at once, of each of b blocks.
    """

    problem: Squares
    found: LeastSquares[State]
    every: tuple[AtOnce, ...]
    solve: Solve
    rounds: int = 0

    @staticmethod
    def of(
        problem: Squares, found: LeastSquares[State], solve: Solve | None = None
    ) -> WeightedRows:
        """Of a fit, the last one without a solver."""
        stack, x = problem.stack, found.x.take(np.array(0))
        parts = (AtOnce.of(block, stack.part(x, i)) for i, block in enumerate(stack.blocks))
        return WeightedRows(problem, found, tuple(parts), solve or (lambda *_: found))

    @property
    def state(self) -> State:
        """What was fitted."""
        return self.found.x.take(np.array(0))

    @cached_property
    def shares(self) -> list[Array]:
        """(R,) weights of each block's rows."""
        stack = self.problem.stack
        blocks = zip(stack.blocks, self.every, strict=True)
        return [b.share if len(b.share) else np.ones(one.count) for b, one in blocks]

    @property
    def weights(self) -> Array:
        """(n,) of what was measured, block by block."""
        return np.concatenate(self.split)

    @property
    def split(self) -> list[Array]:
        """The weights of each block."""
        return [w[one.rows[:, 0]] for w, one in zip(self.shares, self.every, strict=True)]

    @cached_property
    def rows(self) -> list[tuple[Array, Array]]:
        """Errors (R,) and slopes (free, R) of each block, without weights."""
        return list(self.problem.stack.rows_by_block(self.state, self.problem.active))

    @cached_property
    def judged(self) -> tuple[list[Scores], Array]:
        """Each block's by the others, as `suspects.scores` has them; (b,) degrees of freedom."""
        precision, prior = self.problem.stack.precision, self.problem.prior
        every = list(zip(self.every, self.rows, self.shares, precision, strict=True))
        none, once, twice = (
            sum(w * (slope * share**power) @ slope.T for _, (_, slope), share, w in every)
            for power in (0, 1, 2)
        )
        ridge = RIDGE * np.diag(np.diag(none))
        cover = solve_normal(once + prior + ridge, np.eye(len(prior)))
        spread, scores, spare = cover @ (twice + prior) @ cover, [], []
        for one, (error, slope), share, w in every:
            rows = np.swapaxes(one.taken(slope), 1, 2)[None]
            own = share[one.rows[:, 0], None, None]
            hat = w * (2.0 * own * hat_blocks(rows, cover) - hat_blocks(rows, spread))
            left = one.live * (1.0 - one.of_places(share))[:, None, None] - hat
            square, directions = standardised(left, one.taken(error)[None])
            scores.append(Scores(square[0], directions[0]))
            spare.append(-w * float(((cover @ slope) * (slope * share)).sum()))
        return scores, np.maximum(np.add(self.degrees, spare), 1.0)

    @property
    def degrees(self) -> Array:
        """(b,) independent numbers of each block, but for those that do not count."""
        stack = self.problem.stack
        gone = [one.numbers[w == 0.0].sum() for one, w in zip(self.every, self.split, strict=True)]
        return np.asarray(np.array([one.degrees for one in stack.instruments]) - gone)

    @cached_property
    def scale(self) -> Array:
        """(b,) sigma of a row of each block, of ordinary errors, unless it is held [m]."""
        each = zip(*self.judged, strict=True)
        held = self.problem.scale
        return held if len(held) else np.array([spread_of(one, dof).scale for one, dof in each])

    def scores(self) -> Scores:
        """Of all blocks, in units of their scales."""
        found = zip(self.judged[0], self.scale, strict=True)
        directions = np.concatenate([one.directions for one in self.judged[0]])
        return Scores(np.concatenate([one.square / s**2 for one, s in found]), directions)

    def spread(self, found: Scores) -> Spread:
        """How ordinary errors scatter, in those units."""
        return spread_of(found, float(self.judged[1].sum()))

    def sizes(self, loss: Loss, scale: float = 1.0) -> Array:
        """(n,) size of each error in tunings of a loss at the scales."""
        return np.concatenate(
            [
                np.sqrt((one.taken(error) ** 2).sum(axis=1)) / (scale * s * loss.tuned(one.numbers))
                for one, (error, _), s in zip(self.every, self.rows, self.scale, strict=True)
            ]
        )

    def again(self, weights: Array) -> WeightedRows:
        """The fit with other weights, from here, the instruments weighed by their scales."""
        stack, ends = self.problem.stack, np.cumsum([len(one.rows) for one in self.every])
        each = zip(stack.blocks, self.every, np.split(weights, ends[:-1]), strict=True)
        stack = replace(stack, blocks=tuple(b.weighed(one.share(w)) for b, one, w in each))
        problem = replace(self.problem, stack=stack)
        problem = problem.believed(stack.variance(np.maximum(self.scale, LEAST_NOISE) ** 2))
        found = self.solve(problem, self.state)
        return replace(self, problem=problem, found=found, rounds=self.rounds + 1)

    def most(self, share: float) -> int:
        """How many measurements may leave."""
        count = len(self.weights)
        paid = 1.0 - self.judged[1].sum() / sum(one.numbers.sum() for one in self.every)
        return leaving(share, count, -(-int(count * paid) // 1))

    def unsettled(self) -> WeightedRows:
        """The same, its status telling that the rounds did not come to rest."""
        return replace(self, found=replace(self.found, status=(Status.ITERATION_LIMIT,)))

    def widened(self) -> tuple[Array, Array]:
        """(rows,) what the loss makes of each row's share, and of its square, in a covariance.

        As `fitting.robust.flatness` and `moments`: by the mean derivative of psi, and its mean
        square, of each block.
        """
        loss, share, square = LOSSES[self.problem.loss], [], []
        sizes = np.split(self.sizes(loss), np.cumsum([len(one.rows) for one in self.every])[:-1])
        grown = self.degrees / self.judged[1]
        for one, u, w, more in zip(self.every, sizes, self.shares, grown, strict=True):
            count, weight = one.numbers, loss.weight(u)
            flat = (count @ loss.slope(u, count)) / (count @ weight)
            psi = ((weight * u * loss.tuned(count)) ** 2).sum() / (count @ weight**2)
            known = np.isin(np.arange(one.count), one.rows)
            share.append(np.where(known, flat, 1.0))
            square.append(np.where(known, w * psi * more, 1.0))
        return np.concatenate(share), np.concatenate(square)

    def notice(self) -> str:
        """How many measurements count less than half."""
        labels, several = self.problem.stack.labels, len(self.every) > 1
        low = [int((w < LOW_WEIGHT).sum()) for w in self.split]
        each = ", ".join(
            f"{few} of {len(one.rows)} measurements" + f" of {label}" * several
            for few, one, label in zip(low, self.every, labels, strict=True)
        )
        text = f"loss {self.problem.loss}: {each} count less than half"
        return f"{text}: {EXPLANATION}" if any(low) else text


def with_loss(
    problem: Squares, found: LeastSquares[State], loss: str, solve: Solve
) -> tuple[Squares, LeastSquares[State]]:
    """The minimum of a loss from a fit of squares, and the problem with its weights and scales."""
    if loss == SQUARE or not np.isfinite(found.cost).all():  # its status tells why
        return problem, found
    at = trimmed(WeightedRows.of(replace(problem, scale=np.zeros(0)), found, solve))
    at = replace(at, problem=replace(at.problem, loss=loss, scale=at.scale))
    at = reweighted(at, 1.0, LOSSES[loss], 1.0)
    return at.problem, replace(at.found, iterations=at.found.iterations + at.rounds)
