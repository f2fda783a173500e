"""What a plan promises: growth with the number of poses, indices, power, and what to know of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.modelling.effects.effect_names import format_effect
from minimax_cal.planning import effect_separation
from minimax_cal.planning.candidate_poses import CandidatePoses, describe_main_rejection
from minimax_cal.planning.designs.design_exchange import ExperimentPool
from minimax_cal.planning.designs.design_search import (
    RANDOM_DESIGNS_PER_MEDIAN,
    DesignWithBound,
    build_quick_design,
)
from minimax_cal.planning.designs.optimality_criteria import (
    evaluate_information_matrices,
    invert_information_matrices,
)
from minimax_cal.planning.effect_separation import SeparationPower, SeparationQuestion
from minimax_cal.planning.plan_figures import (
    OBSERVABILITY_INDEX_NAMES,
    Growth,
    PlannedAndRandom,
    Separation,
    observability_indices,
)
from minimax_cal.planning.planning_task import DesignProblem, PlanningTask
from minimax_cal.planning.pose_information import PoseInformation
from minimax_cal.planning.visit_route import VisitSequence
from minimax_cal.selection.thresholds import SUFFICIENT_SEPARATION_POWER

COMPARED_POSE_COUNT_RATIOS = (
    0.5,
    0.75,
    1.0,
    1.5,
    2.0,
)  # numbers of poses to compare, as parts of those asked for
RANDOM_SETS_FOR_OBSERVABILITY = 20  # random sets of which observability indices are told


def predict_position_sigmas(
    pool: ExperimentPool, designs: Sequence[Array], prediction_squares: Array
) -> Array:
    """(d, 2) root mean and largest predicted variance of a position [m]; infinite where not told.

    prediction_squares: (w, f * f) B'B of each pose of the workspace.
    """
    cov = invert_information_matrices(
        np.array([pool.information_of_experiments(chosen) for chosen in designs])
    ).reshape(len(designs), -1)
    told = np.asarray(np.isfinite(cov).all(axis=1))
    variance = np.where(told[:, None], cov, 0.0) @ prediction_squares.T
    both = np.sqrt(np.stack([variance.mean(axis=1), variance.max(axis=1)], axis=1))
    return np.where(told[:, None], both, np.inf)


def predict_accuracy_by_pose_count(
    task: PlanningTask,
    parameter_pool: ExperimentPool,
    design_problem: DesignProblem,
    best: DesignWithBound,
    random_candidate_count: int,
) -> tuple[Growth, ...]:
    """What other numbers of poses would tell, planned and random ones of the first
    `random_candidate_count`.
    """
    rng, b = np.random.default_rng(task.options.seed), task.position_predictions
    squares = (np.swapaxes(b, 1, 2) @ b).reshape(len(b), -1)
    poses, out = len(best.design.experiment_indices), []
    for count in sorted({max(1, round(poses * part)) for part in COMPARED_POSE_COUNT_RATIOS}):
        if count > min(random_candidate_count, len(best.promising_indices)):
            continue
        own = best.design.experiment_indices
        if count != poses:
            own = build_quick_design(*design_problem, count, best.promising_indices)
        designs = [
            own,
            *(
                rng.choice(random_candidate_count, count, replace=False)
                for _ in range(RANDOM_DESIGNS_PER_MEDIAN)
            ),
        ]
        sizes = evaluate_information_matrices(
            design_problem[1],
            np.array([design_problem[0].information_of_experiments(one) for one in designs]),
        )
        both = predict_position_sigmas(parameter_pool, designs, squares)
        if not np.isfinite(both[0]).all() and count != poses:
            continue  # so few tell not everything
        columns = (*both.T, sizes)
        pairs = [
            PlannedAndRandom(float(column[0]), float(np.median(column[1:]))) for column in columns
        ]
        out.append(Growth(count, *pairs))
    return tuple(out)


def compare_observability_indices(
    pose_information: PoseInformation, candidates: CandidatePoses, pose_indices: Array, seed: int
) -> dict[str, PlannedAndRandom]:
    """Observability indices of the poses chosen, and the median of random ones."""
    rng = np.random.default_rng(seed)

    def of(some: Array) -> list[float]:
        jacobian = pose_information.scaled_jacobian(candidates.q[some], candidates.seen[some])
        values = np.linalg.svd(jacobian, compute_uv=False)
        whole = np.zeros(
            len(pose_information.parameter_scale)
        )  # fewer coordinates than parameters: the rest is 0
        whole[: len(values)] = values
        return list(observability_indices(whole, len(some)).values())

    random = [
        of(rng.choice(candidates.drawn, len(pose_indices), replace=False))
        for _ in range(RANDOM_SETS_FOR_OBSERVABILITY)
    ]
    return {
        name: PlannedAndRandom(one, float(other))
        for name, one, other in zip(
            OBSERVABILITY_INDEX_NAMES, of(pose_indices), np.median(random, axis=0), strict=True
        )
    }


def predict_effect_separation(
    question: SeparationQuestion,
    separation_power: SeparationPower,
    visits: VisitSequence,
    visible_targets: Array,
) -> Separation:
    """How far the chosen poses tell two effects apart, visited in their order with all revisits."""
    final = effect_separation.predict_separation_power(
        question, visits.q, visible_targets[visits.pose], visits.via
    )
    planned, everything = final.all_candidates_power, separation_power.all_candidates_power
    other = ""
    if separation_power.is_inseparable or max(planned, everything) < SUFFICIENT_SEPARATION_POWER:
        other = effect_separation.suggest_other_separation(question)
    return Separation(
        question.pair.effect.label,
        question.pair.alternative.label,
        separation_power.measured_power,
        planned,
        everything,
        SUFFICIENT_SEPARATION_POWER,
        separation_power.is_inseparable,
        other,
    )


def collect_plan_notices(task: PlanningTask, candidates: CandidatePoses) -> list[str]:
    """What the reader should know about how the poses were found."""
    out = ["the arm's body is a crude one and the cell is not known: check every move yourself"]
    told = {name.partition(".")[0] for name in task.pose_information.names}
    terms = [
        term for term in task.pose_information.cell.effects.terms if not term.frees_session_frames
    ]
    silent_ones = [format_effect(*term.key) for term in terms if term.label not in told]
    if silent_ones:
        out.append(
            f"{', '.join(silent_ones)}: taken as known, not planned for, since the way to a pose "
            "and the time are not known yet"
        )
    if candidates.drawn < task.options.candidates:
        out.append(
            f"{candidates.drawn} candidates, not {task.options.candidates}"
            f": poses that can be taken and "
            f"seen are rare ({candidates.tested} were drawn); "
            f"{describe_main_rejection(candidates.rejected)}"
        )
    return out
