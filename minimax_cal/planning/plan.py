"""Plan a measurement: which poses tell most, in which order, and how accurate they will make it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.option_fields import take_option_fields_as_keywords
from minimax_cal.core.progress_stages import Progress, silent_progress
from minimax_cal.fitting.opened_results import ResultOrFile
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.planning.candidate_poses import (
    CandidatePoses,
    describe_main_rejection,
    draw_candidates_near_poses,
    draw_visible_candidates,
)
from minimax_cal.planning.designs.design_exchange import (
    find_largest_indices,
    improve_design_by_exchange,
    inverse_criterion_gradient,
)
from minimax_cal.planning.designs.design_search import (
    ROUGH_EXCHANGE_SWEEPS,
    DesignWithBound,
    build_first_design,
    equivalent_random_design_size,
    search_best_design,
)
from minimax_cal.planning.designs.optimality_criteria import (
    invert_information_matrices,
)
from minimax_cal.planning.plan_options import PlanOptions, check_plan_options, plan_settings_record
from minimax_cal.planning.plan_predictions import (
    collect_plan_notices,
    compare_observability_indices,
    predict_accuracy_by_pose_count,
    predict_effect_separation,
)
from minimax_cal.planning.planning_task import (
    DesignProblem,
    PlanningTask,
    build_planning_inputs,
    build_planning_task,
    build_workspace_and_visibility,
)
from minimax_cal.planning.pose_visibility import ArmWorkspace, TrackerVisibility
from minimax_cal.planning.result import SEPARATION_CRITERION, Plan, TravelLengths
from minimax_cal.planning.visit_route import (
    build_visit_sequence,
    order_poses_for_short_path,
    path_length,
)
from minimax_cal.robots.robot import Robot, load_robot

REFINEMENT_STEP_FRACTIONS = (
    0.2,
    0.1,
    0.05,
    0.02,
)  # around the best so far, as a share of the joints' ranges
POSES_DRAWN_PER_REFINEMENT, POSES_KEPT_PER_REFINEMENT = (
    2400,
    400,
)  # poses tried around all of them, and those kept, each time


@take_option_fields_as_keywords(options=PlanOptions)
def plan(
    robot: Robot | str | Path,
    poses: int,
    *,
    fit: ResultOrFile | None = None,
    data: Measurements | str | Path | None = None,
    options: PlanOptions,
    progress: Progress = silent_progress,
) -> Plan:
    """Which poses of a robot to measure next, in which order, and how accurate they will make it.

    Parameters
    ----------
    robot
        Loaded, or a name or path.
    poses
        How many.
    fit
        A calibration whose robot, base, targets and poses are the start.
    data
        Poses measured already; without a fit they are calibrated first.
    options
        See `PlanOptions`.
    progress
        Called with a word on each stage.

    Returns
    -------
    Plan
        The poses in order, and the accuracy they promise.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.plan("irb2600", 40, tracker=(3.0, 0.0, 0.5)).headline())
    """
    began = time.perf_counter()
    robot = load_robot(robot)
    check_plan_options(options, poses, robot)
    progress("start")
    ground = build_planning_inputs(
        robot, "" if fit is None else fit, "" if data is None else data, options
    )
    room, sight, said = build_workspace_and_visibility(
        ground.cell, options, ground.measurement_sets
    )
    progress("candidate poses")
    found = draw_enough_candidates(room, sight, options, poses)
    task = build_planning_task(robot, ground, room, sight, found, options)
    found, first = refine_candidates_near_best(task, found, poses, progress)
    aim = task.build_design_problem(found)
    best = search_best_design(*aim, first, progress)
    progress("comparison")
    notices = (*task.inputs.notices, *said, *collect_plan_notices(task, found))
    return assemble_plan(task, found, aim, best, notices, began)


def draw_enough_candidates(
    workspace: ArmWorkspace, visibility: TrackerVisibility, options: PlanOptions, pose_count: int
) -> CandidatePoses:
    """Candidates for so many poses.  Raises OptionError where there are fewer."""
    found = draw_visible_candidates(workspace, visibility, options.candidates, options.seed)
    if found.count < pose_count:
        raise OptionError(
            f"only {found.count} of {found.tested} poses can "
            f"be taken and seen, but {pose_count} are "
            f"asked for; {describe_main_rejection(found.rejected)}"
        )
    return found


class RefinedCandidates(NamedTuple):
    """Candidates, and the first choice among them."""

    candidates: CandidatePoses
    chosen_indices: Array


def refine_candidates_near_best(
    task: PlanningTask, candidates: CandidatePoses, pose_count: int, progress: Progress
) -> RefinedCandidates:
    """More candidates around those that tell most, and a first choice.

    Where poses that can be seen are rare, the best of a sequence lie inside of what is allowed;
    better ones lie at its edge.
    """
    progress("first poses")
    menu, criterion = task.build_design_problem(candidates)
    chosen = build_first_design(menu, criterion, pose_count, task.options.seed)
    rng = np.random.default_rng(task.options.seed)
    for step in REFINEMENT_STEP_FRACTIONS:
        progress(f"poses within {100.0 * step:g} % around them")
        each = -(-POSES_DRAWN_PER_REFINEMENT // pose_count)
        more, seen = draw_candidates_near_poses(
            task.workspace, task.visibility, candidates.q[chosen], each, step, rng
        )
        menu, criterion = task.build_design_problem(candidates.with_candidates(more, seen))
        cov = invert_information_matrices(menu.information_of_experiments(chosen))
        fresh = menu.score_experiments(
            inverse_criterion_gradient(cov, criterion.equivalent_trace_weight(cov))
        )[candidates.count :]
        kept = np.sort(find_largest_indices(fresh, POSES_KEPT_PER_REFINEMENT))
        old = candidates.count
        candidates = candidates.with_candidates(more[kept], seen[kept])
        menu = menu.select_experiments(np.concatenate([np.arange(old), old + kept]))
        among = np.union1d(np.arange(old, menu.experiment_count), chosen)
        chosen = improve_design_by_exchange(
            menu, criterion, chosen, among, ROUGH_EXCHANGE_SWEEPS
        ).experiment_indices
    return RefinedCandidates(candidates, chosen)


def assemble_plan(
    task: PlanningTask,
    candidates: CandidatePoses,
    design_problem: DesignProblem,
    best: DesignWithBound,
    notices: tuple[str, ...],
    start_seconds: float,
) -> Plan:
    """The plan, in a short order, compared with random poses.  start_seconds: by
    `time.perf_counter`.
    """
    cell, options = task.inputs.cell, task.options
    robot, poses = cell.robot, len(best.design.experiment_indices)
    menu = task.build_parameter_pool(candidates)
    chosen = order_poses_by_travel(best.design.experiment_indices, candidates.q, robot)
    q, seen = candidates.q[chosen], candidates.seen[chosen]
    growth = predict_accuracy_by_pose_count(task, menu, design_problem, best, candidates.drawn)
    here = next(row for row in growth if row.poses == poses)
    stops = build_visit_sequence(
        q,
        robot.prismatic,
        task.workspace.lower,
        task.workspace.upper,
        options.revisit,
        from_other_side=options.approach == "both",
    )
    separation = tuple(
        predict_effect_separation(one, contest, stops, seen[:, task.find_target_indices(one)])
        for one, contest in zip(
            task.questions, task.predict_separation_powers(candidates), strict=True
        )
    )
    some = np.arange(candidates.drawn)
    equal = equivalent_random_design_size(
        design_problem[0].select_experiments(some),
        design_problem[1],
        poses,
        best.design.criterion_value,
        options.seed,
    )

    return Plan(
        cell=cell,
        criterion=SEPARATION_CRITERION if task.questions else options.criterion,
        q=q,
        seen=seen,
        expected=np.where(seen[..., None], cell.predict(q), np.nan),
        visits=stops,
        size=best.design.criterion_value,
        bound=best.lower_bound,
        random=here.size[1],
        equal=equal,
        names=task.pose_information.names,
        sigma=np.sqrt(np.diag(invert_information_matrices(menu.information_of_experiments(chosen))))
        / task.pose_information.parameter_scale,
        indices=compare_observability_indices(
            task.pose_information, candidates, chosen, options.seed
        ),
        growth=growth,
        separation=separation,
        candidates=candidates,
        instrument=task.inputs.noise,
        place=task.visibility.position,
        travel=TravelLengths(
            *(
                path_length(way, robot.prismatic)
                for way in (q, candidates.q[best.design.experiment_indices])
            )
        ),
        at_hand=sum(one.poses for one in task.inputs.measurement_sets),
        settings=plan_settings_record(options, poses),
        notices=notices,
        seconds=time.perf_counter() - start_seconds,
    )


def order_poses_by_travel(pose_indices: Array, q: Array, robot: Robot) -> Array:
    """The chosen poses in a short order, from joint values 0 or as near as the limits let them."""
    home = np.clip(np.zeros(robot.joints), robot.lower, robot.upper)
    return np.asarray(
        pose_indices[order_poses_for_short_path(q[pose_indices], robot.prismatic, home)]
    )
