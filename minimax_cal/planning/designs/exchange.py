"""Which experiments to do: choosing some of many by the information that they bring.

Experiment j tells A_j'A_j about f unknowns, A_j being its sensitivities over the noise.  A design
is a set of experiments; the covariance of the unknowns is the inverse of the sum M.  A criterion is
the size of that covariance: it falls as 1/t when all of M grows by t, and 1/size is concave in M
[Pukelsheim 1993, chapter 5].  That makes every bound here: with W such that tr(CW) = size at the
covariance C, no information M' has a size below 1 / <C W C / size^2, M'>.  Nothing here knows of
robots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.planning.designs.criteria import Criterion, inverse, size_of, sizes_of

BOUND_STEPS = 60  # of the weights whose polar gives the bound
SHORT = 5  # of the experiments that promise most, so many are tried exactly
BETTER = 1e-9  # relative gain below which a swap is rounding
RIDGE = 1e-10  # of the mean information: keeps what one experiment less leaves invertible


@dataclass(frozen=True, eq=False)
class Menu:
    """Experiments to choose from.

    rows: (c, r, f) sensitivities over noise.  base: (f, f) information that is at hand anyway.
    """

    rows: Array
    base: Array

    @property
    def count(self) -> int:
        """c."""
        return len(self.rows)

    @property
    def unknowns(self) -> int:
        """f."""
        return int(self.rows.shape[-1])

    def information(self, weights: Array) -> Array:
        """(f, f) of a design.  weights: (c,) how often each experiment is done."""
        chosen = np.flatnonzero(weights)
        scaled = self.rows[chosen] * np.sqrt(weights[chosen])[:, None, None]
        flat = scaled.reshape(-1, self.unknowns)
        return np.asarray(self.base + flat.T @ flat)

    def of(self, chosen: Array) -> Array:
        """(f, f) information of some experiments.  chosen: indices, repeated where repeated."""
        flat = self.rows[chosen].reshape(-1, self.unknowns)
        return np.asarray(self.base + flat.T @ flat)

    def take(self, some: Array) -> Menu:
        """Some experiments only."""
        return Menu(self.rows[some], self.base)

    def scores(self, pull: Array) -> Array:
        """(c,) what each experiment adds, tr(G A'A).  pull: G (f, f)."""
        flat = self.rows.reshape(-1, self.unknowns)
        return np.asarray(((flat @ pull) * flat).sum(axis=1).reshape(self.count, -1).sum(axis=1))


# ---- bounds ------------------------------------------------------------------------------------


def polar(cov: Array, mix: Array) -> Array:
    """G = C W C / tr(CW)^2: no information M has a size below 1 / <G, M>, whatever C and W are."""
    return np.asarray(cov @ mix @ cov / np.einsum("ij,ij->", cov, mix) ** 2)


def floor(menu: Menu, pull: Array, count: int) -> float:
    """A size that no design of so many different experiments is below.  pull: as `polar`.

    1 / (<G, base> + the `count` largest <G, A_j'A_j>).  It is tight where C and W are those of the
    best design, up to what whole experiments lose against parts of them.  With weights that may be
    any number and D, that is the theorem of Kiefer and Wolfowitz [1960]: max_j tr(A_j C A_j') = f
    at the optimum.
    """
    most = np.sort(menu.scores(pull))[-count:].sum() + np.einsum("ij,ij->", pull, menu.base)
    return 1.0 / float(most)


def lower_bound(menu: Menu, criterion: Criterion, chosen: Array) -> float:
    """The best floor of weights that begin at a design and move to what scores highest.

    [Frank and Wolfe 1956].  Of each step's polar the floor holds, wherever the weights are.
    """
    weights, bound = np.bincount(chosen, minlength=menu.count).astype(float), 0.0
    for step in range(BOUND_STEPS):
        cov = inverse(menu.information(weights))
        pull = polar(cov, criterion.mix(cov))
        bound = max(bound, floor(menu, pull, len(chosen)))
        ahead = np.zeros(menu.count)
        ahead[highest(menu.scores(pull), len(chosen))] = 1.0
        weights += (ahead - weights) * 2.0 / (step + 4.0)
    return bound


def highest(scores: Array, count: int) -> Array:
    """Indices of the largest scores."""
    return np.argsort(-scores, kind="stable")[:count]


# ---- exchange ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Design:
    """chosen: (n,) experiments.  size: of their covariance."""

    chosen: Array
    size: float


def exchange(
    menu: Menu,
    criterion: Criterion,
    start: Array,
    among: Array | None = None,
    sweeps: int = 30,
) -> Design:
    """Swap experiments for better ones until none is found [Fedorov 1972; Mitchell 1974].

    start: (n,) different experiments.  among: those that may come in, all unless given.  Each
    place of the design is emptied in turn; the experiments that would fill it best, by the update
    formulas, are tried exactly.  A swap is made only if the size falls: it never grows.
    """
    some = np.arange(menu.count) if among is None else np.asarray(among)
    offer = menu.rows[some]
    chosen = np.array(start)
    info = menu.of(chosen)
    best = size_of(criterion, info)
    ridge = RIDGE * np.diag(np.maximum(np.diag(info), 1e-300))
    for _ in range(sweeps):
        swapped = False
        for place in range(len(chosen)):
            own = menu.rows[chosen[place]]
            rest = info - own.T @ own
            estimate = criterion.after(np.linalg.inv(rest + ridge), offer)
            estimate[np.isin(some, chosen)] = np.inf
            short = np.argsort(estimate, kind="stable")[:SHORT]
            short = short[np.isfinite(estimate[short])]
            trial = rest + np.swapaxes(offer[short], 1, 2) @ offer[short]
            sizes = sizes_of(criterion, trial)
            if len(sizes) and sizes.min() < best * (1.0 - BETTER):
                winner = int(np.argmin(sizes))
                best, swapped = float(sizes[winner]), True
                chosen[place] = some[short[winner]]
                info = trial[winner]
        if not swapped:
            break
        info = menu.of(chosen)  # rounding does not add up
    return Design(chosen, size_of(criterion, menu.of(chosen)))


def greedy(menu: Menu, criterion: Criterion, count: int) -> Array:
    """(count,) experiments taken one by one, each the best beside those before.

    While they do not tell everything yet, a faint prior on all unknowns stands in.
    """
    mean = np.einsum("cri,cri->i", menu.rows, menu.rows) / menu.count
    info = menu.base + 1e-6 * np.diag(np.maximum(mean, 1e-300))
    chosen: list[int] = []
    for _ in range(count):
        estimate = criterion.after(np.linalg.inv(info), menu.rows)
        estimate[chosen] = np.inf
        best = int(np.argmin(estimate))
        chosen.append(best)
        info = info + menu.rows[best].T @ menu.rows[best]
    return np.array(chosen, dtype=int)


def draw(menu: Menu, criterion: Criterion, counts: Sequence[int], draws: int, seed: int) -> Array:
    """(len(counts), draws) sizes of random designs of different experiments."""
    rng = np.random.default_rng(seed)
    return np.array(
        [
            sizes_of(
                criterion,
                np.array(
                    [menu.of(rng.choice(menu.count, count, replace=False)) for _ in range(draws)]
                ),
            )
            for count in counts
        ]
    )
