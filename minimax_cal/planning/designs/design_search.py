"""The best design that can be found of a menu by exchange, a bound, and what random ones do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.planning.designs.design_exchange import (
    ExperimentDesign,
    ExperimentPool,
    build_greedy_design,
    evaluate_random_designs,
    find_largest_indices,
    improve_design_by_exchange,
    inverse_criterion_gradient,
    maximise_criterion_lower_bound,
)
from minimax_cal.planning.designs.optimality_criteria import (
    OptimalityCriterion,
    TraceCriterion,
    evaluate_information_matrix,
    invert_information_matrices,
)

CONSIDERED_PER_CHOSEN_EXPERIMENT, CONSIDERED_IN_ADDITION = (
    8,
    160,
)  # experiments looked at for each to choose, and beside
ROUGH_EXCHANGE_SWEEPS = 2  # sweeps where a design is only to begin with, or to compare
RANDOM_DESIGNS_PER_MEDIAN = 60  # random designs of which the median is told
RANDOM_DESIGN_SIZE_RATIOS = (
    1.0,
    1.25,
    1.5,
    1.75,
    2.0,
    2.5,
    3.0,
    4.0,
)  # sizes of random designs to compare with
MAX_ADDITIONAL_EXPERIMENTS = 60  # experiments more than asked for, to say how many are needed


@dataclass(frozen=True, eq=False)
class DesignWithBound:
    """The design, a bound, and the experiments that good designs of this menu hold.

    lower_bound: no design of so many experiments has a size below it.
    """

    design: ExperimentDesign
    lower_bound: float
    promising_indices: Array


def build_first_design(
    pool: ExperimentPool, criterion: OptimalityCriterion, design_size: int, seed: int
) -> Array:
    """(count,) a fair design among some of the experiments, to start from.

    Raises OptionError where so many do not tell all unknowns.
    """
    some = np.random.default_rng(seed).permutation(pool.experiment_count)[
        : CONSIDERED_PER_CHOSEN_EXPERIMENT * design_size + CONSIDERED_IN_ADDITION
    ]
    start = some[
        build_identifiable_greedy_design(pool.select_experiments(some), criterion, design_size)
    ]
    return improve_design_by_exchange(
        pool, criterion, start, some, ROUGH_EXCHANGE_SWEEPS
    ).experiment_indices


def search_best_design(
    pool: ExperimentPool,
    criterion: OptimalityCriterion,
    first_indices: Array,
    progress: Callable[[str], None],
) -> DesignWithBound:
    """The best design found of as many different experiments as in a first one, and a bound.

    At first those come in that the first design scores highest, then the best one's, then any.
    """
    progress("exchange")
    likely, mix = add_promising_experiments(pool, criterion, first_indices)
    starts = [
        first_indices,
        likely[build_greedy_design(pool.select_experiments(likely), criterion, len(first_indices))],
    ]
    if not isinstance(criterion, TraceCriterion):
        starts.append(
            improve_design_by_exchange(
                pool, TraceCriterion(mix), first_indices, likely, ROUGH_EXCHANGE_SWEEPS
            ).experiment_indices
        )
    designs = [improve_design_by_exchange(pool, criterion, start, likely) for start in starts]
    best = min(designs, key=lambda design: design.criterion_value)
    likely = np.union1d(
        likely, add_promising_experiments(pool, criterion, best.experiment_indices)[0]
    )
    best = improve_design_by_exchange(pool, criterion, best.experiment_indices, likely)
    best = improve_design_by_exchange(
        pool, criterion, best.experiment_indices, max_sweeps=ROUGH_EXCHANGE_SWEEPS
    )
    return DesignWithBound(
        best,
        min(
            maximise_criterion_lower_bound(pool, criterion, best.experiment_indices),
            best.criterion_value,
        ),
        likely,
    )


class WeightedDesign(NamedTuple):
    """Experiments, and the weight (f, f) of the covariance by which they were scored."""

    experiment_indices: Array
    covariance_weight: Array


def add_promising_experiments(
    pool: ExperimentPool, criterion: OptimalityCriterion, design_indices: Array
) -> WeightedDesign:
    """A design with the experiments that it scores highest, and its weight of the covariance."""
    cov = invert_information_matrices(pool.information_of_experiments(design_indices))
    mix = criterion.equivalent_trace_weight(cov)
    few = find_largest_indices(
        pool.score_experiments(inverse_criterion_gradient(cov, mix)),
        CONSIDERED_PER_CHOSEN_EXPERIMENT * len(design_indices) + CONSIDERED_IN_ADDITION,
    )
    return WeightedDesign(np.union1d(design_indices, few), mix)


def build_identifiable_greedy_design(
    pool: ExperimentPool, criterion: OptimalityCriterion, design_size: int
) -> Array:
    """A greedy design that tells all unknowns.  Raises OptionError with how many it takes."""
    chosen = build_greedy_design(pool, criterion, design_size)
    if np.isfinite(evaluate_information_matrix(criterion, pool.information_of_experiments(chosen))):
        return chosen
    longer = build_greedy_design(
        pool, criterion, min(design_size + MAX_ADDITIONAL_EXPERIMENTS, pool.experiment_count)
    )
    for needed in range(design_size + 1, len(longer) + 1):
        if np.isfinite(
            evaluate_information_matrix(criterion, pool.information_of_experiments(longer[:needed]))
        ):
            raise OptionError(
                f"{design_size} poses do not tell the {pool.unknown_count}"
                f" parameters apart; plan at least "
                f"{needed}"
            )
    raise OptionError(
        f"{len(longer)} of the candidates do not tell the "
        f"{pool.unknown_count} parameters apart; allow "
        "more of the joints' ranges, or more candidates="
    )


def build_quick_design(
    experiments: ExperimentPool,
    criterion: OptimalityCriterion,
    design_size: int,
    promising_indices: Array,
) -> Array:
    """A design of another number of experiments, among those that are likely to be in it."""
    pool = experiments.select_experiments(promising_indices)
    start = build_greedy_design(pool, criterion, design_size)
    return np.asarray(
        promising_indices[
            improve_design_by_exchange(
                pool, criterion, start, max_sweeps=ROUGH_EXCHANGE_SWEEPS
            ).experiment_indices
        ]
    )


def equivalent_random_design_size(
    pool: ExperimentPool,
    criterion: OptimalityCriterion,
    design_size: int,
    criterion_value: float,
    seed: int,
) -> float:
    """How many random experiments tell as much as a design of `design_size` of a size (median).

    Infinite where that is more than 4 times as many, or than there are.
    """
    counts = [
        round(design_size * ratio)
        for ratio in RANDOM_DESIGN_SIZE_RATIOS
        if design_size * ratio <= pool.experiment_count
    ]
    if not counts:
        return float("inf")
    middle = np.median(
        evaluate_random_designs(pool, criterion, counts, RANDOM_DESIGNS_PER_MEDIAN, seed), axis=1
    )
    if not middle[-1] <= criterion_value:
        return float("inf")
    known = np.isfinite(middle)
    logs = np.minimum.accumulate(np.log(middle[known]))  # falls but for the luck of the draw
    return float(
        np.exp(np.interp(-np.log(criterion_value), -logs, np.log(np.array(counts)[known])))
    )
