"""The error budget: geometry, then effects and error maps of joints, step by step."""

from __future__ import annotations

from dataclasses import replace

from minimax_cal.diagnosing.causes import Causes, remaining_beside_maps, search_beside_maps
from minimax_cal.diagnosing.error_maps import error_maps
from minimax_cal.diagnosing.established import select_frequent
from minimax_cal.diagnosing.findings import merge_gear_lines, with_complete_law
from minimax_cal.diagnosing.gap import Ladder, fit_ladder
from minimax_cal.diagnosing.study import Study
from minimax_cal.fitting.options import Progress


def fit_error_budget(
    study: Study, causes: Causes, progress: Progress
) -> tuple[Causes, Causes, Ladder]:
    """The error budget of the causes, with the error maps that joints have besides.

    Returns the causes, the same as the budget tried them, and the steps that it took.
    """

    def fit_steps(tried: Causes) -> Ladder:
        laws = [found.terms for found in tried.effects]
        confirmed = [found.established for found in tried.effects]
        return fit_ladder(study, laws, confirmed, guessed=tried.guessed)

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
        maps = error_maps(ladder.last, tried.exclude)
        if maps.terms:
            taken = [tried.effects[number] for number in ladder.taken]
            effects = merge_gear_lines(maps.findings(taken, study.scene))
            tried = replace(tried, effects=tuple(effects), maps=maps)
            tried = remaining_beside_maps(study, tried, maps.terms)
            ladder = fit_steps(tried)
            texts = {term.text for term in ladder.last.terms}
            held = [term for term in maps.terms if term.text in texts]
            if len(held) < len(maps.terms):
                tried = remaining_beside_maps(study, tried, held)

        # The search is repeated beside the maps: laws that stood in for a curve are found no more.
        # The second budget counts where groups held out are predicted no worse by it.
        if not is_repeated:
            best = tried, ladder
            if not ladder.maps:
                break
            progress("causes beside the error maps")
            searched = search_beside_maps(study, causes, ladder.maps)
        elif ladder.maps and predicts_no_worse(ladder, best[1]):
            best = tried, ladder
    tried, ladder = best
    return tried if tried.maps.terms else causes, tried, ladder


def predicts_no_worse(ladder: Ladder, other: Ladder) -> bool:
    """Whether groups left out of the last fit are predicted no worse than by another's."""
    parts = ladder.last.spared(other.last.spared(other.parts))
    return ladder.last.cross_validated(parts) <= other.last.cross_validated(parts)
