"""What a design could reach if experiments could be done in part: weights by convex programming.

    minimise size(C), C^-1 = M = base + sum_j w_j A_j'A_j  s.t.  sum w = n, 0 <= w_j <= 1

With Z >= K'CK as [[M, K], [K', Z]] >= 0 mean variances are linear in Z [Boyd and Vandenberghe 2004,
section 7.5].  cvxpy builds the problem and hands it to a solver; the answer is only ever used as
weights and as the polar that gives the bound (`exchange.floor`), so that a sloppy answer makes the
bound looser, never wrong.  Of many experiments a few are given to the solver; those that score
highest come in next, and the bound holds for all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.planning.designs.criteria import (
    Criterion,
    Largest,
    inverse,
    size_of,
)
from minimax_cal.planning.designs.exchange import Menu, floor, polar

SOLVERS: dict[str, dict[str, float]] = {  # by cvxpy's name, tried in turn
    "SCS": {"eps_abs": 1e-4, "eps_rel": 1e-4, "max_iters": 1000},
    "CLARABEL": {},
}
# experiments beyond the number to choose that the solver sees at a time
MAX_EXTRA_EXPERIMENTS = 160
WORST = 60  # predictions of `Largest` that it sees at a time
GAP = 3e-3  # relative, between size and bound, at which no more rounds are needed
STALE = 0.8  # of the gap that a round leaves: more, and further ones are in vain
MAX_ROUNDS = 6
NOTHING = 1e-6  # a smaller weight is none


@dataclass(frozen=True, eq=False)
class Relaxed:
    """weights: (c,).  size: with them.  bound: no design of so many experiments is below it.

    scores: (c,) by the polar of the bound: the best designs hold what scores high.
    solver: that was used, "" for none.  rounds: how often.  given: experiments it saw at last.
    """

    weights: Array
    size: float
    bound: float
    scores: Array
    solver: str
    rounds: int
    given: int


def relax(
    menu: Menu,
    criterion: Criterion,
    begin: Array,
    solvers: tuple[str, ...] = tuple(SOLVERS),
    gap: float = GAP,
    rounds: int = MAX_ROUNDS,
) -> Relaxed:
    """The best weights for as many experiments as there are in a design, and a bound.

    begin: (n,) a design of different experiments that tells all unknowns, to start from.
    solvers: of SOLVERS, tried in turn.
    """
    from minimax_cal.planning.designs.convex import solved  # cvxpy comes with it

    count = len(begin)
    offered = {name: SOLVERS[name] for name in solvers}
    weights = np.bincount(begin, minlength=menu.count).astype(float)
    cov = inverse(menu.information(weights))
    size = float(criterion.size(cov))
    pull = latest = polar(cov, criterion.mix(cov))
    bound, used, done = floor(menu, pull, count), "", 0
    given, posed, found = begin[:0], begin[:0], weights
    for _ in range(rounds):
        support = np.flatnonzero(weights + found > NOTHING)
        newer = union(begin, support, highest(menu.scores(latest), count + MAX_EXTRA_EXPERIMENTS))
        worse = union(posed, minimax_problem(criterion, cov))
        known = np.isin(newer, given).all() and np.isin(worse, posed).all()
        if bound >= size * (1.0 - gap) or known:
            break
        given, posed, before = newer, worse, 1.0 - bound / size
        small = Largest(criterion.weights[posed]) if isinstance(criterion, Largest) else criterion
        found, pulls, name = solved(menu, small, count, given, cov, offered)
        reached = size_of(criterion, menu.information(found))
        if not (name and np.isfinite(reached)):
            break
        done, used = done + 1, name
        if reached < size:
            size, weights = reached, found
        cov = inverse(menu.information(found))
        for latest in (polar(cov, criterion.mix(cov)), pulls(cov)):
            new = floor(menu, latest, count)
            if new > bound:
                bound, pull = new, latest
        if done > 2 and 1.0 - bound / size > STALE * before:
            break
    return Relaxed(weights, size, min(bound, size), menu.scores(pull), used, done, len(given))


def union(*parts: Array) -> Array:
    """Indices in any of them."""
    return np.unique(np.concatenate(parts))


def minimax_problem(criterion: Criterion, cov: Array) -> Array:
    """The predictions that matter most where the largest counts; none otherwise."""
    if not isinstance(criterion, Largest):
        return np.zeros(0, dtype=int)
    return highest(criterion.each(cov), WORST)


def highest(scores: Array, count: int) -> Array:
    """Indices of the largest scores."""
    return np.argsort(-scores, kind="stable")[:count]
