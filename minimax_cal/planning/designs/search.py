"""The best design that can be found of a menu by exchange, a bound, and what random ones do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.planning.designs.criteria import Criterion, Trace, inverse, size_of
from minimax_cal.planning.designs.exchange import (
    Design,
    Menu,
    draw,
    exchange,
    greedy,
    highest,
    lower_bound,
    polar,
)

PER_PLACE, BESIDE = 8, 160  # experiments looked at for each to choose, and beside
ROUGH = 2  # sweeps where a design is only to begin with, or to compare
DRAWS = 60  # random designs of which the median is told
RATIOS = (1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0)  # sizes of random designs to compare with
TRIES = 60  # experiments more than asked for, to say how many are needed


@dataclass(frozen=True, eq=False)
class Found:
    """The design, a bound, and the experiments that good designs of this menu hold.

    bound: no design of so many experiments has a size below it.
    """

    design: Design
    bound: float
    likely: Array


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
    """The best design found of as many different experiments as in a first one, and a bound.

    At first those come in that the first design scores highest, then the best one's, then any.
    """
    progress("exchange")
    likely, mix = promising(menu, criterion, first)
    starts = [first, likely[greedy(menu.take(likely), criterion, len(first))]]
    if not isinstance(criterion, Trace):
        starts.append(exchange(menu, Trace(mix), first, likely, ROUGH).chosen)
    designs = [exchange(menu, criterion, start, likely) for start in starts]
    best = min(designs, key=lambda design: design.size)
    likely = np.union1d(likely, promising(menu, criterion, best.chosen)[0])
    best = exchange(menu, criterion, best.chosen, likely)
    best = exchange(menu, criterion, best.chosen, sweeps=ROUGH)
    return Found(best, min(lower_bound(menu, criterion, best.chosen), best.size), likely)


def promising(menu: Menu, criterion: Criterion, chosen: Array) -> tuple[Array, Array]:
    """A design with the experiments that it scores highest, and its weight of the covariance."""
    cov = inverse(menu.of(chosen))
    mix = criterion.mix(cov)
    few = highest(menu.scores(polar(cov, mix)), PER_PLACE * len(chosen) + BESIDE)
    return np.union1d(chosen, few), mix


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
