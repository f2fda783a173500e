"""The search of causes: effects that explain what geometry leaves, and their alternatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.diagnosing.error_maps import NO_MAPS, Mapped
from minimax_cal.diagnosing.established import (
    has_frequencies,
    is_mostly_unconfirmed,
    keys_standing_for,
)
from minimax_cal.diagnosing.findings import (
    add_untestable_alternatives,
    describe_effect,
    merge_gear_lines,
    order_by_explained_square,
)
from minimax_cal.diagnosing.next_measurement import Site
from minimax_cal.diagnosing.result import Alternative, Finding
from minimax_cal.diagnosing.scatter import weighed_anew
from minimax_cal.diagnosing.study import Study
from minimax_cal.diagnosing.what_remains import left_by, loudest
from minimax_cal.evidence import selection
from minimax_cal.evidence.bench import Added
from minimax_cal.evidence.library import Library
from minimax_cal.evidence.remains import Remains, rest_of
from minimax_cal.evidence.selection import Choice
from minimax_cal.evidence.stability import repeated, subsamples
from minimax_cal.fitting.options import Progress
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.faults import in_lines
from minimax_cal.measuring.faults.fault import Fault
from minimax_cal.measuring.faults.joints import looks_read_back
from minimax_cal.measuring.grouping import clusters
from minimax_cal.modelling.dictionary import arm_library
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.modelling.effects.time import SESSION_JUMP


@dataclass(frozen=True, eq=False)
class Causes:
    """What may be wrong.

    faults: of the data.  exclude: effects that are not looked for.
    choice: the effects selected; effects: the same as findings, the weightiest first.
    left: what remains beside them.  untestable: effects, and what the data lack for them.
    guessed: whether something significant remains, or most effects change with the poses.
    maps: error maps of joints, found after the effects.  jobs: processes that search subsamples of
    the poses; cluster: address of a Dask scheduler instead.
    """

    faults: tuple[Fault, ...]
    exclude: tuple[str, ...]
    choice: Choice
    effects: tuple[Finding, ...]
    left: tuple[Remains, ...]
    untestable: tuple[tuple[str, str], ...]
    guessed: bool = False
    maps: Mapped = NO_MAPS
    jobs: int = 1
    cluster: str = ""

    @property
    def confirmed(self) -> list[Finding]:
        """The effects that are confirmed."""
        return [found for found in self.effects if found.established]


def search_causes(
    study: Study,
    faults: Sequence[Fault],
    exclude: Sequence[str],
    progress: Progress,
    jobs: int = 1,
    cluster: str = "",
) -> tuple[Study, Causes]:
    """The effects that explain a study's errors, beside known faults of the data.

    Returns the study, its rows weighted by the noises found beside the effects, and the causes.
    """
    # Forward selection by evidence, with two noises: the instrument's, and that of all joints.
    choice = select_effects(study, exclude)
    left = left_by(study, choice)

    # Variance components: where joints, or range and angles of a tracker, scatter unlike each
    # other, rows are weighted by that and the selection is repeated.  Each joint by itself only
    # where nothing significant remains, which would pass for scatter of its joint.
    plain, study = study, weighed_anew(study, choice.known, each=loudest(left) is None)
    if study is not plain:
        progress("testing causes again")
        first = choice.found
        del choice  # whose products fill the memory
        choice = select_effects(study, exclude, first)

    # Joint values that were read back before the arm settled lack the same part of every move.
    # That is a fault of the data; what remains of a move then looks like backlash.
    read_back: list[Fault] = []
    if any(EFFECTS[c.term.effect].of_move for c in choice.chosen):
        rest = rest_of(study.rows, choice.noise, choice.known, study.rows.turn)
        error = np.moveaxis(study.rows.back(rest.rows / rest.root), -1, 0)
        error = np.where(study.model.seen.T[..., None], error, np.nan)
        rotation = study.fit.state.rotation
        motion = np.einsum("ab,nkbm->mkan", rotation, study.scene.jacobian) * study.robot.sign
        found = looks_read_back(study.data, error @ rotation.T, motion)
        read_back = in_lines(study.data, found, "readback")
    if read_back:
        play = [name for name, effect in EFFECTS.items() if effect.follows == "approach"]
        exclude = (*exclude, *play)
        choice = select_effects(study, exclude)
    if read_back or study is not plain:
        left = left_by(study, choice)

    causes = Causes(
        (*faults, *read_back), tuple(exclude), choice, (), left, choice.library.untestable,
        jobs=jobs, cluster=cluster,
    )  # fmt: skip
    return study, judge_arm_causes(study, causes)


def judge_arm_causes(study: Study, causes: Causes) -> Causes:
    """`judge_causes` of points of trackers, with what to measure to tell alternatives apart."""
    site = Site(study.scene, study.model, study.fit.state, causes.choice.noise)
    group = np.repeat(clusters(study.data), study.rows.width)
    return judge_causes(study.scene, causes, group, site)


def judge_causes(scene: Scene, causes: Causes, group: Array, site: Site | None = None) -> Causes:
    """The causes with their effects as findings: alternatives, and the selection frequency.

    group: (N,) of rows that stay together.  site: for measurements that tell an effect from its
    alternatives; none is proposed without.
    """
    # Alternatives: what explains the errors as well beside the other effects, or what the data have
    # too little power to exclude; and relatives that cannot be tested.  Lines of one gear are one.
    choice = causes.choice
    fits = [choice.beside_others(number) for number in range(len(choice.found))]
    values = [(one.candidate.term, one.value) for _, one in fits]
    listed = [
        describe_effect(scene, *fits[i], values[:i] + values[i + 1 :], site)
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
    terms = [candidate.term for candidate in choice.chosen]
    if findings:
        masks = subsamples(group)
        repeats = repeated(choice, masks, jobs=causes.jobs, cluster=causes.cluster)
    for finding in findings:
        same = keys_standing_for(finding, repeats)
        known = {finding.term.key, *(term.key for term in terms), *same}
        instead = [key for key in repeats.instead_of(same) if key not in known]
        more: list[Alternative] = []
        if instead:
            table, one = choice.beside_others(terms.index(finding.term))
            best = {other.candidate.key: other for other in reversed(table.everyone)}
            for key in filter(best.__contains__, instead):
                size, rho2 = table.likeness(one, best[key].candidate)
                loss = one.evidence - best[key].evidence
                more.append(Alternative(*key, rho2, size * (1.0 - rho2), loss))
        finding = replace(finding, alternatives=(*finding.alternatives, *more))
        frequency = repeats.frequency(keys_standing_for(finding, repeats))
        effects.append(replace(finding, again=frequency))

    # Effects are a guess where something significant remains, or most of them are not confirmed.
    confirmed = [finding for finding in effects if finding.established]
    change = has_frequencies(effects) and is_mostly_unconfirmed(effects, confirmed)
    guessed = change or loudest(causes.left) is not None
    return replace(causes, choice=choice.portable(), effects=tuple(effects), guessed=guessed)


# ---- beside error maps ---------------------------------------------------------------------------


def search_beside_maps(study: Study, causes: Causes, maps: Sequence[Term]) -> Causes:
    """The causes searched again beside error maps of joints: without laws that stood in for these.

    What the data tell of the maps, by more than their priors do, is projected out like geometry.
    """
    columns = [term.columns(study.scene) for term in maps]
    usual = [one.displacement(study.scene) / np.sqrt(one.ridge)[:, None, None, None]
             for one in columns]  # fmt: skip
    study = replace(study, rows=study.rows.beside(study.rows.of(np.concatenate(usual))))
    choice = select_effects(study, causes.exclude)
    return judge_arm_causes(study, replace(causes, choice=choice, left=left_by(study, choice)))


def remaining_beside_maps(study: Study, causes: Causes, maps: Sequence[Term]) -> Causes:
    """The causes with what remains beside their effects and some error maps together."""
    fields = [study.rows.of(term.columns(study.scene).displacement(study.scene)) for term in maps]
    left = left_by(study, causes.choice, np.concatenate(fields, axis=1) if fields else None)
    return replace(causes, left=left, guessed=loudest(left) is not None)


def remaining_beside_terms(
    study: Study, causes: Causes, terms: Sequence[Term]
) -> tuple[Remains, ...]:
    """What remains beside some of the effects and maps alone."""
    keys, choice = {term.key for term in terms}, causes.choice
    known = {candidate.key for candidate in choice.chosen}
    if known == keys:
        return causes.left
    found = tuple(one for one in choice.found if one.candidate.key in keys)
    causes = replace(causes, choice=replace(choice, found=found))
    maps = [term for term in terms if term.key not in known]
    return remaining_beside_maps(study, causes, maps).left


# ---- the library ---------------------------------------------------------------------------------


def select_effects(study: Study, exclude: Sequence[str], first: Sequence[Added] = ()) -> Choice:
    """Effects of the library that explain a study's errors.  first: selected with other weights."""
    lib = arm_library(study.scene, study.rows, exclude)
    if SESSION_JUMP.name not in exclude:
        lib = add_session_jumps(lib, study)
    return selection.select(lib, first=first)


def add_session_jumps(lib: Library, study: Study) -> Library:
    """The library with jumps at the moments that the errors show."""
    jumps = [Term(SESSION_JUMP.name, "frame", {"since": t}) for t in study.moments.tolist()]
    terms = [(term, 1.0) for term in jumps]  # tried against chance when they were found
    return replace(lib, candidates=(*lib.candidates, *lib.with_terms(terms))) if terms else lib
