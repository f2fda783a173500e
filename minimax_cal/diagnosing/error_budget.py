"""The error budget: geometry, then effects and error maps of joints, step by step."""

from __future__ import annotations

from dataclasses import replace

from minimax_cal.diagnosing.budget_steps import BudgetSteps, fit_budget_steps
from minimax_cal.diagnosing.cause_search import (
    FoundCauses,
    search_beside_maps,
    with_remaining_beside_maps,
)
from minimax_cal.diagnosing.confirmation import select_frequent
from minimax_cal.diagnosing.error_map_search import search_error_maps
from minimax_cal.diagnosing.findings import merge_gear_lines, with_complete_law
from minimax_cal.diagnosing.study import LinearisedGeometry
from minimax_cal.fitting.options import Progress


def fit_error_budget(
    study: LinearisedGeometry, causes: FoundCauses, progress: Progress
) -> tuple[FoundCauses, FoundCauses, BudgetSteps]:
    """The error budget of the causes, with the error maps that joints have besides.

    Returns the causes, the same as the budget tried them, and the steps that it took.
    """

    def fit_steps(tried: FoundCauses) -> BudgetSteps:
        laws = [found.terms for found in tried.effects]
        confirmed = [found.established for found in tried.effects]
        return fit_budget_steps(study, laws, confirmed, are_best_guesses=tried.is_best_guess)

    searched = causes
    for is_repeated in (False, True):
        # Effects found again in enough subsamples, each with the whole of its law.
        frequent = select_frequent(searched.effects)
        terms = [term for found in frequent for term in found.terms]
        effects = [with_complete_law(found, terms, study.scene) for found in frequent]
        tried = replace(searched, effects=tuple(effects))
        ladder = fit_steps(tried)

        # Error maps, and fine waves, that these steps lack; then the steps with them, and without
        # laws of the same angle that they replace.
        progress("error maps of joints")
        maps = search_error_maps(ladder.last_fit, tried.exclude)
        if maps.terms:
            taken = [tried.effects[number] for number in ladder.taken_numbers]
            effects = merge_gear_lines(maps.build_findings(taken, study.scene))
            tried = replace(tried, effects=tuple(effects), joint_error_maps=maps)
            tried = with_remaining_beside_maps(study, tried, maps.terms)
            ladder = fit_steps(tried)
            texts = {term.text for term in ladder.last_fit.terms}
            held = [term for term in maps.terms if term.text in texts]
            if len(held) < len(maps.terms):
                tried = with_remaining_beside_maps(study, tried, held)

        # The search is repeated beside the maps: laws that stood in for a curve are found no more.
        # The second budget counts where groups held out are predicted no worse by it.
        if not is_repeated:
            best = tried, ladder
            if not ladder.error_map_terms:
                break
            progress("causes beside the error maps")
            searched = search_beside_maps(study, causes, ladder.error_map_terms)
        elif ladder.error_map_terms and predicts_no_worse(ladder, best[1]):
            best = tried, ladder
    tried, ladder = best
    return tried if tried.joint_error_maps.terms else causes, tried, ladder


def predicts_no_worse(budget: BudgetSteps, other_budget: BudgetSteps) -> bool:
    """Whether groups left out of the last fit are predicted no worse than by another's."""
    parts = budget.last_fit.select_dispensable_folds(
        other_budget.last_fit.select_dispensable_folds(other_budget.fold_masks)
    )
    return budget.last_fit.cross_validate_folds(
        parts
    ) <= other_budget.last_fit.cross_validate_folds(parts)
