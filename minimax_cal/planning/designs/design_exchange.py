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

from minimax_cal.core.arrays import Array
from minimax_cal.planning.designs.optimality_criteria import (
    OptimalityCriterion,
    evaluate_information_matrices,
    evaluate_information_matrix,
    invert_information_matrices,
)

MAX_FRANK_WOLFE_STEPS = 60  # of the weights whose polar gives the bound
EXACTLY_TRIED_EXPERIMENTS = 5  # of the experiments that promise most, so many are tried exactly
MIN_RELATIVE_SWAP_GAIN = 1e-9  # relative gain below which a swap is rounding
EXCHANGE_RELATIVE_RIDGE = (
    1e-10  # of the mean information: keeps what one experiment less leaves invertible
)


@dataclass(frozen=True, eq=False)
class ExperimentPool:
    """Experiments to choose from.

    sensitivities: (c, r, f) sensitivities over noise.  prior_information: (f, f) information that
    is at hand anyway.
    """

    sensitivities: Array
    prior_information: Array

    @property
    def experiment_count(self) -> int:
        """c."""
        return len(self.sensitivities)

    @property
    def unknown_count(self) -> int:
        """f."""
        return int(self.sensitivities.shape[-1])

    def information_of_repetitions(self, repetitions: Array) -> Array:
        """(f, f) of a design.  repetitions: (c,) how often each experiment is done."""
        chosen = np.flatnonzero(repetitions)
        scaled = self.sensitivities[chosen] * np.sqrt(repetitions[chosen])[:, None, None]
        flat = scaled.reshape(-1, self.unknown_count)
        return np.asarray(self.prior_information + flat.T @ flat)

    def information_of_experiments(self, chosen: Array) -> Array:
        """(f, f) information of some experiments.  chosen: indices, repeated where repeated."""
        flat = self.sensitivities[chosen].reshape(-1, self.unknown_count)
        return np.asarray(self.prior_information + flat.T @ flat)

    def select_experiments(self, some: Array) -> ExperimentPool:
        """Some experiments only."""
        return ExperimentPool(self.sensitivities[some], self.prior_information)

    def score_experiments(self, criterion_gradient: Array) -> Array:
        """(c,) what each experiment adds, tr(G A'A).  criterion_gradient: G (f, f)."""
        flat = self.sensitivities.reshape(-1, self.unknown_count)
        return np.asarray(
            ((flat @ criterion_gradient) * flat)
            .sum(axis=1)
            .reshape(self.experiment_count, -1)
            .sum(axis=1)
        )


# ---- bounds ------------------------------------------------------------------------------------


def inverse_criterion_gradient(covariance: Array, trace_weight: Array) -> Array:
    """G = C W C / tr(CW)^2: no information M has a size below 1 / <G, M>, whatever C and W are."""
    return np.asarray(
        covariance @ trace_weight @ covariance / np.einsum("ij,ij->", covariance, trace_weight) ** 2
    )


def criterion_lower_bound(
    pool: ExperimentPool, criterion_gradient: Array, design_size: int
) -> float:
    """A size that no design of so many different experiments is below.  criterion_gradient: as
    `inverse_criterion_gradient`.

    1 / (<G, base> + the `design_size` largest <G, A_j'A_j>).  It is tight where C and W are those
    of the best design, up to what whole experiments lose against parts of them.  With weights that
    may be any number and D, that is the theorem of Kiefer and Wolfowitz [1960]: max_j tr(A_j C
    A_j') = f at the optimum.
    """
    most = np.sort(pool.score_experiments(criterion_gradient))[-design_size:].sum() + np.einsum(
        "ij,ij->", criterion_gradient, pool.prior_information
    )
    return 1.0 / float(most)


def maximise_criterion_lower_bound(
    pool: ExperimentPool, criterion: OptimalityCriterion, design_indices: Array
) -> float:
    """The best floor of weights that begin at a design and move to what scores highest.

    [Frank and Wolfe 1956].  Of each step's polar the floor holds, wherever the weights are.
    """
    weights, bound = np.bincount(design_indices, minlength=pool.experiment_count).astype(float), 0.0
    for step in range(MAX_FRANK_WOLFE_STEPS):
        cov = invert_information_matrices(pool.information_of_repetitions(weights))
        pull = inverse_criterion_gradient(cov, criterion.equivalent_trace_weight(cov))
        bound = max(bound, criterion_lower_bound(pool, pull, len(design_indices)))
        ahead = np.zeros(pool.experiment_count)
        ahead[find_largest_indices(pool.score_experiments(pull), len(design_indices))] = 1.0
        weights += (ahead - weights) * 2.0 / (step + 4.0)
    return bound


def find_largest_indices(scores: Array, count: int) -> Array:
    """Indices of the largest scores."""
    return np.argsort(-scores, kind="stable")[:count]


# ---- exchange ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ExperimentDesign:
    """experiment_indices: (n,) experiments.  criterion_value: of their covariance."""

    experiment_indices: Array
    criterion_value: float


def improve_design_by_exchange(
    pool: ExperimentPool,
    criterion: OptimalityCriterion,
    start_indices: Array,
    allowed_indices: Array | None = None,
    max_sweeps: int = 30,
) -> ExperimentDesign:
    """Swap experiments for better ones until none is found [Fedorov 1972; Mitchell 1974].

    start_indices: (n,) different experiments.  allowed_indices: those that may come in, all unless
    given.  Each place of the design is emptied in turn; the experiments that would fill it best, by
    the update formulas, are tried exactly.  A swap is made only if the size falls: it never grows.
    """
    some = (
        np.arange(pool.experiment_count) if allowed_indices is None else np.asarray(allowed_indices)
    )
    offer = pool.sensitivities[some]
    chosen = np.array(start_indices)
    info = pool.information_of_experiments(chosen)
    best = evaluate_information_matrix(criterion, info)
    ridge = EXCHANGE_RELATIVE_RIDGE * np.diag(np.maximum(np.diag(info), 1e-300))
    for _ in range(max_sweeps):
        swapped = False
        for place in range(len(chosen)):
            own = pool.sensitivities[chosen[place]]
            rest = info - own.T @ own
            estimate = criterion.evaluate_after_adding(np.linalg.inv(rest + ridge), offer)
            estimate[np.isin(some, chosen)] = np.inf
            short = np.argsort(estimate, kind="stable")[:EXACTLY_TRIED_EXPERIMENTS]
            short = short[np.isfinite(estimate[short])]
            trial = rest + np.swapaxes(offer[short], 1, 2) @ offer[short]
            sizes = evaluate_information_matrices(criterion, trial)
            if len(sizes) and sizes.min() < best * (1.0 - MIN_RELATIVE_SWAP_GAIN):
                winner = int(np.argmin(sizes))
                best, swapped = float(sizes[winner]), True
                chosen[place] = some[short[winner]]
                info = trial[winner]
        if not swapped:
            break
        info = pool.information_of_experiments(chosen)  # rounding does not add up
    return ExperimentDesign(
        chosen, evaluate_information_matrix(criterion, pool.information_of_experiments(chosen))
    )


def build_greedy_design(
    pool: ExperimentPool, criterion: OptimalityCriterion, design_size: int
) -> Array:
    """(count,) experiments taken one by one, each the best beside those before.

    While they do not tell everything yet, a faint prior on all unknowns stands in.
    """
    mean = np.einsum("cri,cri->i", pool.sensitivities, pool.sensitivities) / pool.experiment_count
    info = pool.prior_information + 1e-6 * np.diag(np.maximum(mean, 1e-300))
    chosen: list[int] = []
    for _ in range(design_size):
        estimate = criterion.evaluate_after_adding(np.linalg.inv(info), pool.sensitivities)
        estimate[chosen] = np.inf
        best = int(np.argmin(estimate))
        chosen.append(best)
        info = info + pool.sensitivities[best].T @ pool.sensitivities[best]
    return np.array(chosen, dtype=int)


def evaluate_random_designs(
    pool: ExperimentPool,
    criterion: OptimalityCriterion,
    design_sizes: Sequence[int],
    designs_per_size: int,
    seed: int,
) -> Array:
    """(len(counts), draws) sizes of random designs of different experiments."""
    rng = np.random.default_rng(seed)
    return np.array(
        [
            evaluate_information_matrices(
                criterion,
                np.array(
                    [
                        pool.information_of_experiments(
                            rng.choice(pool.experiment_count, count, replace=False)
                        )
                        for _ in range(designs_per_size)
                    ]
                ),
            )
            for count in design_sizes
        ]
    )
