"""The search of causes: effects that explain what geometry leaves, and their alternatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.confirmation import (
    has_frequencies,
    is_mostly_unconfirmed,
    list_equivalent_keys,
)
from minimax_cal.diagnosing.diagnosis import AlternativeEffect, Finding
from minimax_cal.diagnosing.error_map_search import NO_ERROR_MAPS, FoundErrorMaps
from minimax_cal.diagnosing.findings import (
    add_untestable_alternatives,
    build_effect_finding,
    merge_gear_lines,
    order_by_explained_square,
)
from minimax_cal.diagnosing.next_measurement import MeasurementPlanner
from minimax_cal.diagnosing.noise_components import reweight_by_noise_components
from minimax_cal.diagnosing.remaining_error import find_remaining_components, most_telling_component
from minimax_cal.diagnosing.study import LinearisedGeometry
from minimax_cal.fitting.options import Progress
from minimax_cal.measuring.faults import faults_with_file_lines
from minimax_cal.measuring.faults.data_fault import DataFault
from minimax_cal.measuring.faults.read_back_joints import find_lag_in_point_errors
from minimax_cal.measuring.pose_groups import cluster_poses
from minimax_cal.modelling.arm_laws import build_library_of_testable_arm_laws
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.modelling.effects.time_effects import SESSION_JUMP
from minimax_cal.selection import forward_selection
from minimax_cal.selection.candidate_library import CandidateLibrary
from minimax_cal.selection.candidate_tests import CandidateFit
from minimax_cal.selection.forward_selection import EffectSelection
from minimax_cal.selection.remaining_structure import RemainingComponent, whiten_residual
from minimax_cal.selection.stability_selection import build_subsample_masks, select_on_subsamples


@dataclass(frozen=True, eq=False)
class FoundCauses:
    """What may be wrong.

    faults: of the data.  exclude: effects that are not looked for. selection: the effects selected;
    effects: the same as findings, the weightiest first. remaining_components: what remains beside
    them.  untestable: effects, and what the data lack for them. is_best_guess: whether something
    significant remains, or most effects change with the poses. joint_error_maps: error maps of
    joints, found after the effects.  jobs: processes that search subsamples of the poses; cluster:
    address of a Dask scheduler instead.
    """

    faults: tuple[DataFault, ...]
    exclude: tuple[str, ...]
    selection: EffectSelection
    effects: tuple[Finding, ...]
    remaining_components: tuple[RemainingComponent, ...]
    untestable: tuple[tuple[str, str], ...]
    is_best_guess: bool = False
    joint_error_maps: FoundErrorMaps = NO_ERROR_MAPS
    jobs: int = 1
    cluster: str = ""

    @property
    def confirmed_findings(self) -> list[Finding]:
        """The effects that are confirmed."""
        return [found for found in self.effects if found.established]


def search_causes(
    study: LinearisedGeometry,
    faults: Sequence[DataFault],
    excluded_effects: Sequence[str],
    progress: Progress,
    process_count: int = 1,
    cluster_address: str = "",
) -> tuple[LinearisedGeometry, FoundCauses]:
    """The effects that explain a study's errors, beside known faults of the data.

    Returns the study, its rows weighted by the noises found beside the effects, and the causes.
    """
    # Forward selection by evidence, with two noises: the instrument's, and that of all joints.
    choice = select_arm_effects(study, excluded_effects)
    left = find_remaining_components(study, choice)

    # Variance components: where joints, or range and angles of a tracker, scatter unlike each
    # other, rows are weighted by that and the selection is repeated.  Each joint by itself only
    # where nothing significant remains, which would pass for scatter of its joint.
    plain, study = (
        study,
        reweight_by_noise_components(
            study, choice.effect_columns, separate_joints=most_telling_component(left) is None
        ),
    )
    if study is not plain:
        progress("testing causes again")
        first = choice.candidate_fits
        del choice  # whose products fill the memory
        choice = select_arm_effects(study, excluded_effects, first)

    # Joint values that were read back before the arm settled lack the same part of every move.
    # That is a fault of the data; what remains of a move then looks like backlash.
    read_back: list[DataFault] = []
    if any(EFFECTS[c.term.effect].follows_last_move for c in choice.candidates):
        rest = whiten_residual(study.rows, choice.noise, choice.effect_columns, study.rows.turn)
        error = np.moveaxis(study.rows.rows_to_points(rest.residuals / rest.weight_roots), -1, 0)
        error = np.where(study.model.measured_mask.T[..., None], error, np.nan)
        rotation = study.fit.state.rotation
        motion = np.einsum("ab,nkbm->mkan", rotation, study.scene.jacobian) * study.robot.sign
        found = find_lag_in_point_errors(study.data, error @ rotation.T, motion)
        read_back = faults_with_file_lines(study.data, found, "readback")
    if read_back:
        play = [name for name, effect in EFFECTS.items() if effect.follows == "approach"]
        excluded_effects = (*excluded_effects, *play)
        choice = select_arm_effects(study, excluded_effects)
    if read_back or study is not plain:
        left = find_remaining_components(study, choice)

    causes = FoundCauses(
        (*faults, *read_back), tuple(excluded_effects), choice, (), left, choice.library.untestable,
        jobs=process_count, cluster=cluster_address,
    )  # fmt: skip
    return study, judge_tracker_causes(study, causes)


def judge_tracker_causes(study: LinearisedGeometry, causes: FoundCauses) -> FoundCauses:
    """`judge_causes` of points of trackers, with what to measure to tell alternatives apart."""
    site = MeasurementPlanner(study.scene, study.model, study.fit.state, causes.selection.noise)
    group = np.repeat(cluster_poses(study.data), study.rows.rows_per_pose)
    return judge_causes(study.scene, causes, group, site)


def judge_causes(
    scene: PosedArm,
    causes: FoundCauses,
    row_groups: Array,
    measurement_planner: MeasurementPlanner | None = None,
) -> FoundCauses:
    """The causes with their effects as findings: alternatives, and the selection frequency.

    row_groups: (N,) of rows that stay together.  measurement_planner: for measurements that tell an
    effect from its alternatives; none is proposed without.
    """
    # Alternatives: what explains the errors as well beside the other effects, or what the data have
    # too little power to exclude; and relatives that cannot be tested.  Lines of one gear are one.
    choice = causes.selection
    fits = [choice.compare_with_others(number) for number in range(len(choice.candidate_fits))]
    values = [(one.candidate.term, one.values) for _, one in fits]
    listed = [
        build_effect_finding(scene, *fits[i], values[:i] + values[i + 1 :], measurement_planner)
        for i in order_by_explained_square(choice)
    ]
    del fits  # which fill the memory
    findings = [
        add_untestable_alternatives(finding, scene, causes.exclude)
        for finding in merge_gear_lines(listed)
    ]

    # Stability selection [Meinshausen and Buehlmann 2010]: the search is repeated on subsamples.
    # What is found in place of an effect is an alternative, unless all rows exclude it.
    effects: list[Finding] = []
    terms = [candidate.term for candidate in choice.candidates]
    if findings:
        masks = build_subsample_masks(row_groups)
        repeats = select_on_subsamples(
            choice, masks, process_count=causes.jobs, cluster_address=causes.cluster
        )
    for finding in findings:
        same = list_equivalent_keys(finding, repeats)
        known = {finding.term.key, *(term.key for term in terms), *same}
        instead = [key for key in repeats.find_replacing_keys(same) if key not in known]
        more: list[AlternativeEffect] = []
        if instead:
            table, one = choice.compare_with_others(terms.index(finding.term))
            best = {other.candidate.key: other for other in reversed(table.ranked_candidates)}
            for key in filter(best.__contains__, instead):
                size, rho2 = table.similarity_to_candidate(one, best[key].candidate)
                loss = one.evidence - best[key].evidence
                more.append(AlternativeEffect(*key, rho2, size * (1.0 - rho2), loss))
        finding = replace(finding, alternatives=(*finding.alternatives, *more))
        frequency = repeats.selection_frequency(list_equivalent_keys(finding, repeats))
        effects.append(replace(finding, again=frequency))

    # Effects are a guess where something significant remains, or most of them are not confirmed.
    confirmed = [finding for finding in effects if finding.established]
    change = has_frequencies(effects) and is_mostly_unconfirmed(effects, confirmed)
    guessed = change or most_telling_component(causes.remaining_components) is not None
    return replace(
        causes, selection=choice.without_caches(), effects=tuple(effects), is_best_guess=guessed
    )


# ---- beside error maps ---------------------------------------------------------------------------


def search_beside_maps(
    study: LinearisedGeometry, causes: FoundCauses, maps: Sequence[Term]
) -> FoundCauses:
    """The causes searched again beside error maps of joints: without laws that stood in for these.

    What the data tell of the maps, by more than their priors do, is projected out like geometry.
    """
    columns = [term.columns(study.scene) for term in maps]
    usual = [one.target_displacements(study.scene) / np.sqrt(one.ridge)[:, None, None, None]
             for one in columns]  # fmt: skip
    study = replace(
        study,
        rows=study.rows.with_nuisance_columns(study.rows.rows_from_fields(np.concatenate(usual))),
    )
    choice = select_arm_effects(study, causes.exclude)
    return judge_tracker_causes(
        study,
        replace(
            causes, selection=choice, remaining_components=find_remaining_components(study, choice)
        ),
    )


def with_remaining_beside_maps(
    study: LinearisedGeometry, causes: FoundCauses, maps: Sequence[Term]
) -> FoundCauses:
    """The causes with what remains beside their effects and some error maps together."""
    fields = [
        study.rows.rows_from_fields(term.columns(study.scene).target_displacements(study.scene))
        for term in maps
    ]
    left = find_remaining_components(
        study, causes.selection, np.concatenate(fields, axis=1) if fields else None
    )
    return replace(
        causes, remaining_components=left, is_best_guess=most_telling_component(left) is not None
    )


def find_remaining_beside_terms(
    study: LinearisedGeometry, causes: FoundCauses, terms: Sequence[Term]
) -> tuple[RemainingComponent, ...]:
    """What remains beside some of the effects and maps alone."""
    keys, choice = {term.key for term in terms}, causes.selection
    known = {candidate.key for candidate in choice.candidates}
    if known == keys:
        return causes.remaining_components
    found = tuple(one for one in choice.candidate_fits if one.candidate.key in keys)
    causes = replace(causes, selection=replace(choice, candidate_fits=found))
    maps = [term for term in terms if term.key not in known]
    return with_remaining_beside_maps(study, causes, maps).remaining_components


# ---- the library ---------------------------------------------------------------------------------


def select_arm_effects(
    study: LinearisedGeometry,
    excluded_effects: Sequence[str],
    previous_fits: Sequence[CandidateFit] = (),
) -> EffectSelection:
    """Effects of the library that explain a study's errors.  previous_fits: selected with other
    weights.
    """
    lib = build_library_of_testable_arm_laws(study.scene, study.rows, excluded_effects)
    if SESSION_JUMP.name not in excluded_effects:
        lib = add_session_jumps(lib, study)
    return forward_selection.select_effects_by_evidence(lib, previous_fits=previous_fits)


def add_session_jumps(library: CandidateLibrary, study: LinearisedGeometry) -> CandidateLibrary:
    """The library with jumps at the moments that the errors show."""
    jumps = [Term(SESSION_JUMP.name, "frame", {"since": t}) for t in study.jump_times.tolist()]
    terms = [(term, 1.0) for term in jumps]  # tried against chance when they were found
    return (
        replace(library, candidates=(*library.candidates, *library.add_terms(terms)))
        if terms
        else library
    )
