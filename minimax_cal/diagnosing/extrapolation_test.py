"""Diagnoses without a part of the poses: effects sought anew, and judged by the part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.parallel import run_in_parallel
from minimax_cal.core.progress_stages import build_counted_stage
from minimax_cal.diagnosing.budget_steps import BudgetSteps, JudgingPoses, fit_budget_steps
from minimax_cal.diagnosing.cause_search import FoundCauses
from minimax_cal.diagnosing.confirmation import has_key_or_alternative
from minimax_cal.diagnosing.findings import group_terms_by_effect
from minimax_cal.diagnosing.study import LinearisedGeometry, linearise_geometry
from minimax_cal.fitting.options import Progress
from minimax_cal.fitting.region_holdout import (
    RegionErrors,
    RegionHoldout,
    check_joint_spans,
    refit_without_regions,
)
from minimax_cal.fitting.session_frames import count_frame_parameters
from minimax_cal.fitting.uncertainty import Estimator
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import list_holdout_regions
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.selection.forward_selection import retune_selection, select_effects_by_evidence


def fit_budget_on_rows(
    study: LinearisedGeometry, causes: FoundCauses, pose_mask: Array, geometry: ParameterValues
) -> BudgetSteps:
    """Effects sought and fitted on some rows only; maps of joints only fitted.

    Of those that are confirmed on all rows, or stand for one.

    causes: of all rows; the products of their library serve every fold.  pose_mask: (m,) True for
    those used.  geometry: the geometry that was fitted to them.
    """
    small = linearise_geometry(
        study.robot, study.data.take(pose_mask), replace(study.fit, state=geometry)
    )
    if not causes.confirmed_findings:
        return fit_budget_steps(small, [], [])
    choice = retune_selection(
        select_effects_by_evidence(
            causes.selection.take_rows(study.rows.row_mask_of_poses(pose_mask))
        )
    )
    named = causes.joint_error_maps.merge_with_effects(group_terms_by_effect(choice))
    sure = [
        any(has_key_or_alternative(one, terms[0].key) for one in causes.confirmed_findings)
        for terms in named
    ]
    return fit_budget_steps(
        small, named, sure, are_best_guesses=causes.is_best_guess
    ).confirmed_steps


def predict_heldout_errors(
    study: LinearisedGeometry,
    causes: FoundCauses,
    pose_mask: Array,
    geometry: ParameterValues,
    heldout_measurements: Measurements,
) -> tuple[Array, Array]:
    """Errors (f, k, 3) at poses left out, of the model sought without them and of its geometry [m].

    As `fit_budget_on_rows`; heldout_measurements: the poses left out.
    """
    fits = fit_budget_on_rows(study, causes, pose_mask, geometry).joint_fits
    return fits[-1].cell.error(heldout_measurements), fits[0].cell.error(heldout_measurements)


def compare_extrapolation(
    study: LinearisedGeometry, causes: FoundCauses, judging_poses: JudgingPoses, progress: Progress
) -> RegionHoldout:
    """Every part of the poses judges a model that was sought without it."""
    data = judging_poses.all_seen_measurements
    known = check_joint_spans(study.robot, study.data)
    if known.narrow_spans:
        return known
    found = list_holdout_regions(data, judging_poses.holdout_by)
    masks = [np.isin(study.data.line, data.line[part.rows]) for part in found]
    estimator = Estimator(
        study.model.with_active(study.fit.identification.active), np.ones(len(study.model.y))
    )
    errors = RegionErrors()
    states = refit_without_regions(
        estimator, study.fit.state, masks, count_frame_parameters(study.data.frames)
    )
    waiting = [i for i, state in enumerate(states) if state is not None]
    for part, state in zip(found, states, strict=True):
        if state is None:
            errors.missed.append(part.name)
    calls = [(study, causes, ~masks[i], states[i], data.take(found[i].rows)) for i in waiting]
    ended = {}
    for number, pair in run_in_parallel(
        predict_heldout_errors, calls, process_count=causes.jobs, scheduler_address=causes.cluster
    ):
        ended[number] = pair
        name = found[waiting[number]].name
        progress(build_counted_stage("part", len(ended), len(calls), f" held out: {name}"))
    for number, i in enumerate(waiting):
        errors.add_region(found[i].name, *ended[number])
    if not found:
        return replace(known, reason="the poses are too few or too much alike")
    return replace(errors.build_region_holdout(sought=True), spans=known.spans)
