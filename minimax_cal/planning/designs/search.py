"""The best design that can be found of a menu: relaxation, exchange, and what random ones do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.planning.designs.criteria import Criterion, Trace, inverse, size_of
from minimax_cal.planning.designs.exchange import Design, Menu, draw, exchange, greedy
from minimax_cal.planning.designs.relaxation import Relaxed, highest, relax

PER_PLACE, BESIDE = 8, 160  # experiments looked at for each to choose, and beside
ROUGH = 2  # sweeps where a design is only to begin with, or to compare
DRAWS = 60  # random designs of which the median is told
RATIOS = (1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0)  # sizes of random designs to compare with
TRIES = 60  # experiments more than asked for, to say how many are needed


@dataclass(frozen=True, eq=False)
class Found:
    """The design, and the relaxation that says how good it is.

    likely: experiments that good designs of this menu hold.
    """

    design: Design
    relaxed: Relaxed
    likely: Array

    @property
    def bound(self) -> float:
        """No design of so many is below it."""
        return min(self.relaxed.bound, self.design.size)


def first_design(menu: Menu, criterion: Criterion, count: int, seed: int) -> Array:
    """(count,) a fair design among some of the experiments, to start from.

    Raises OptionError where so many do not tell all unknowns.
    """
    some = np.random.default_rng(seed).permutation(menu.count)[: PER_PLACE * count + BESIDE]
    start = some[begin(menu.take(some), criterion, count)]
    return exchange(menu, criterion, start, some, ROUGH).chosen


def best_design(
    menu: Menu, criterion: Criterion, first: Array, progress: Callable[[str], None]
) -> Found:
    """The best design found of as many different experiments as in a first one, and a bound."""
    count = len(first)
    progress("relaxation")
    relaxed = relax(menu, criterion, first)
    few = highest(relaxed.scores, PER_PLACE * count + BESIDE)
    order = np.lexsort((-relaxed.scores, -np.round(relaxed.weights, 4)))
    likely = np.union1d(np.union1d(few, order[:count]), first)
    progress("exchange")
    starts = [order[:count], first, likely[greedy(menu.take(likely), criterion, count)]]
    if not isinstance(criterion, Trace):
        mean = Trace(criterion.mix(inverse(menu.information(relaxed.weights))))
        starts.append(exchange(menu, mean, order[:count], likely, ROUGH).chosen)
    designs = [exchange(menu, criterion, start, likely) for start in starts]
    best = min(designs, key=lambda design: design.size)
    return Found(exchange(menu, criterion, best.chosen, sweeps=ROUGH), relaxed, likely)


def begin(menu: Menu, criterion: Criterion, count: int) -> Array:
    """A greedy design that tells all unknowns.  Raises OptionError with how many it takes."""
    chosen = greedy(menu, criterion, count)
    if np.isfinite(size_of(criterion, menu.of(chosen))):
        return chosen
    longer = greedy(menu, criterion, min(count + TRIES, menu.count))
    for needed in range(count + 1, len(longer) + 1):
        if np.isfinite(size_of(criterion, menu.of(longer[:needed]))):
            raise OptionError(
                f"{count} poses do not tell the {menu.unknowns} parameters apart; plan at least "
                f"{needed}"
            )
    raise OptionError(
        f"{len(longer)} of the candidates do not tell the {menu.unknowns} parameters apart; allow "
        "more of the joints' ranges, or more candidates="
    )


def quick_design(menu: Menu, criterion: Criterion, count: int, likely: Array) -> Array:
    """A design of another number of experiments, among those that are likely to be in it."""
    pool = menu.take(likely)
    start = greedy(pool, criterion, count)
    return np.asarray(likely[exchange(pool, criterion, start, sweeps=ROUGH).chosen])


def worth(menu: Menu, criterion: Criterion, count: int, size: float, seed: int) -> float:
    """How many random experiments tell as much as a design of `count` of a size (median).

    Infinite where that is more than 4 times as many, or than there are.
    """
    counts = [round(count * ratio) for ratio in RATIOS if count * ratio <= menu.count]
    if not counts:
        return float("inf")
    middle = np.median(draw(menu, criterion, counts, DRAWS, seed), axis=1)
    if not middle[-1] <= size:
        return float("inf")
    known = np.isfinite(middle)
    logs = np.minimum.accumulate(np.log(middle[known]))  # falls but for the luck of the draw
    return float(np.exp(np.interp(-np.log(size), -logs, np.log(np.array(counts)[known]))))
