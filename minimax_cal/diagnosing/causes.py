"""What explains the errors that geometry leaves: effects, and their rivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.diagnosing.error_maps import NO_MAPS, Mapped
from minimax_cal.diagnosing.established import asked, judged_again, mostly_loose
from minimax_cal.diagnosing.next_measurement import Pair, Site, separate_with
from minimax_cal.diagnosing.result import Alternative, Finding
from minimax_cal.diagnosing.scatter import weighed_anew
from minimax_cal.diagnosing.study import Study
from minimax_cal.diagnosing.what_remains import left_by, loudest
from minimax_cal.evidence import selection
from minimax_cal.evidence.bench import Added, Bench
from minimax_cal.evidence.library import Library
from minimax_cal.evidence.limits import ENOUGH
from minimax_cal.evidence.remains import Remains, rest_of
from minimax_cal.evidence.selection import Choice
from minimax_cal.evidence.stability import alternatives
from minimax_cal.fitting.options import Progress
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.faults import in_lines
from minimax_cal.measuring.faults.fault import Fault
from minimax_cal.measuring.faults.joints import looks_read_back
from minimax_cal.measuring.grouping import clusters
from minimax_cal.modelling.dictionary import arm_library
from minimax_cal.modelling.effects.scene import Scene, joint_of, unmasked
from minimax_cal.modelling.effects.table import EFFECTS, Term, by_waves, names_of
from minimax_cal.modelling.effects.time import SESSION_JUMP
from minimax_cal.modelling.effects.words import own_name

ADVISED = 3  # rivals of an effect for which a further measurement is worked out


@dataclass(frozen=True, eq=False)
class Causes:
    """What may be wrong.

    faults: of the data.  exclude: effects that were not looked for.
    choice: the effects selected, effects: as findings, the weightiest first.
    left: what they leave.  untestable: effects, and what the data lack for them.  guessed:
    whether anything is left that matters, or most names change with the poses.  maps: of joints,
    sought beside the effects, once there is a ladder.  jobs: processes that search parts of the
    poses, cluster: address of a Dask scheduler instead.
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
        """The effects that hold."""
        return [found for found in self.effects if found.established]


def causes_of(
    study: Study,
    faults: Sequence[Fault],
    exclude: Sequence[str],
    progress: Progress,
    jobs: int = 1,
    cluster: str = "",
) -> tuple[Study, Causes]:
    """The effects that explain a study's errors, beside faults that are known.

    And the study, its rows weighed by the noises that were found beside the effects.
    """
    choice = chosen(study, exclude)
    left = left_by(study, choice)
    clear = loudest(left) is None  # or each joint would absorb it
    plain, study = study, weighed_anew(study, choice.known, each=clear)
    if study is not plain:
        progress("testing causes again")
        first = choice.found
        del choice  # whose products fill the memory
        choice = chosen(study, exclude, first)
    read_back = read_back_fault(study, choice)
    if read_back:  # what is left of a move looks like play in the gears
        play = [name for name, effect in EFFECTS.items() if effect.follows == "approach"]
        exclude = (*exclude, *play)
        choice = chosen(study, exclude)
    every, told = (*faults, *read_back), choice.library.untestable
    if read_back or study is not plain:
        left = left_by(study, choice)
    causes = Causes(every, tuple(exclude), choice, (), left, told, jobs=jobs, cluster=cluster)
    return study, found_again(study, causes)


def found_again(study: Study, causes: Causes) -> Causes:
    """`sought_again`, with what would tell rivals apart."""
    site = Site(study.scene, study.model, study.fit.state, causes.choice.noise)
    group = np.repeat(clusters(study.data), study.rows.width)
    return sought_again(study.scene, causes, group, site)


def sought_again(scene: Scene, causes: Causes, group: Array, site: Site | None = None) -> Causes:
    """The causes with their effects as findings: rivals, and how often each is found again.

    group: (N,) of rows that stay together.  site: as `findings` has it.
    """
    choice = causes.choice
    found = merged(findings(scene, choice, site))
    found = [with_untested(one, scene, causes.exclude) for one in found]
    effects = judged_again(found, choice, group, causes.jobs, causes.cluster)
    change = asked(effects) and mostly_loose(effects, [f for f in effects if f.established])
    guessed = change or loudest(causes.left) is not None
    return replace(causes, choice=choice.portable(), effects=effects, guessed=guessed)


def beside_curves(study: Study, causes: Causes, maps: Sequence[Term]) -> Causes:
    """The causes sought anew beside maps of joints: what stood in for these is named no more.

    What the data tell of the curves, by more than their priors do, is projected out like geometry.
    """
    columns = [term.columns(study.scene) for term in maps]
    usual = [one.displacement(study.scene) / np.sqrt(one.ridge)[:, None, None, None]
             for one in columns]  # fmt: skip
    study = replace(study, rows=study.rows.beside(study.rows.of(np.concatenate(usual))))
    choice = chosen(study, causes.exclude)
    left = left_by(study, choice)
    return found_again(study, replace(causes, choice=choice, left=left))


def beside_maps(study: Study, causes: Causes, maps: Sequence[Term]) -> Causes:
    """The causes with what their effects and some maps leave together."""
    fields = [study.rows.of(term.columns(study.scene).displacement(study.scene)) for term in maps]
    left = left_by(study, causes.choice, np.concatenate(fields, axis=1) if fields else None)
    return replace(causes, left=left, guessed=loudest(left) is not None)


def left_beside(study: Study, causes: Causes, kept: Sequence[Term]) -> tuple[Remains, ...]:
    """What some of the effects and maps leave.  kept: their terms."""
    keys, choice = {term.key for term in kept}, causes.choice
    known = {candidate.key for candidate in choice.chosen}
    if known == keys:
        return causes.left
    found = tuple(one for one in choice.found if one.candidate.key in keys)
    causes = replace(causes, choice=replace(choice, found=found))
    return beside_maps(study, causes, [term for term in kept if term.key not in known]).left


def chosen(study: Study, exclude: Sequence[str], first: Sequence[Added] = ()) -> Choice:
    """What the library explains.  first: what was chosen with other weights."""
    lib = arm_library(study.scene, study.rows, exclude)
    if SESSION_JUMP.name not in exclude:
        lib = with_jumps(lib, study)
    return selection.select(lib, first=first)


def with_jumps(lib: Library, study: Study) -> Library:
    """The library with jumps at the moments that the errors show."""
    jumps = [Term(SESSION_JUMP.name, "frame", {"since": t}) for t in study.moments.tolist()]
    terms = [(term, 1.0) for term in jumps]  # tried against chance when they were found
    return replace(lib, candidates=(*lib.candidates, *lib.with_terms(terms))) if terms else lib


def read_back_fault(study: Study, choice: Choice) -> list[Fault]:
    """A fault if the joint values look read back before the arm had settled.

    Asked of what the effects leave: a joint that always lacks the same part of its move settles.
    """
    if not any(EFFECTS[c.term.effect].of_move for c in choice.chosen):
        return []
    rest = rest_of(study.rows, choice.noise, choice.known, study.rows.turn)
    error = np.moveaxis(study.rows.back(rest.rows / rest.root), -1, 0)
    error = np.where(study.model.seen.T[..., None], error, np.nan)
    error = error @ study.fit.state.rotation.T
    push = np.einsum("ab,nkbm->mkan", study.fit.state.rotation, study.scene.jacobian)
    found = looks_read_back(study.data, error, push * study.robot.sign)
    return in_lines(study.data, found, "readback")


def by_weight(choice: Choice) -> list[int]:
    """The effects in the order in which each takes most of what is left, points weighing alike."""
    lib = choice.library
    fields = [lib.products.clear(candidate.main) for candidate in choice.chosen]
    sizes = [len(field) for field in fields]
    parts = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
    columns = np.concatenate([np.zeros((0, len(lib.rows.error))), *fields])
    columns = columns / np.linalg.norm(columns, axis=1, keepdims=True)
    gram, pull = columns @ columns.T, columns @ lib.rows.error
    waiting, order = list(range(len(fields))), []
    taken = np.zeros(0, dtype=int)
    while waiting:
        gains = []
        for i in waiting:
            both = np.concatenate([taken, parts[i]])
            value = np.linalg.lstsq(gram[np.ix_(both, both)], pull[both], rcond=1e-12)[0]
            gains.append(float(pull[both] @ value))
        best = waiting.pop(int(np.argmax(gains)))
        taken = np.concatenate([taken, parts[best]])
        order.append(best)
    return order


def effects_of(choice: Choice) -> list[tuple[Term, ...]]:
    """The terms of each effect selected, the weightiest first, all lines of a joint together."""
    out: dict[tuple[str, str], list[Term]] = {}
    for number in by_weight(choice):
        term = choice.chosen[number].term
        out.setdefault((term.effect, term.place), []).append(term)
    every = [candidate.term for candidate in choice.chosen]
    return [entire(terms, every) for terms in out.values()]


def entire(terms: Sequence[Term], every: Sequence[Term]) -> tuple[Term, ...]:
    """The whole of an effect's law, of which its terms may be what shows.

    every: the terms of all effects.
    """
    first, found = terms[0], [term.choice for term in terms]
    joint = joint_of(first.place) if first.place[:1] == "J" else None
    wide = [t.choice for t in every if t.effect == first.effect and "joints" in t.choice]
    law = EFFECTS[first.effect].entire(found, [c for c in wide if joint in unmasked(c["joints"])])
    return tuple(terms) if law is found else tuple(replace(first, choice=one) for one in law)


def findings(scene: Scene, choice: Choice, site: Site | None = None) -> list[Finding]:
    """Each effect with its rivals, in the order of `by_weight`.

    site: for what would tell them apart; nothing is proposed without one.
    """
    beside = [choice.beside_others(number) for number in range(len(choice.found))]
    fits = [one for _, one in beside]
    return [finding(scene, *beside[number], fits, site) for number in by_weight(choice)]


def finding(
    scene: Scene, table: Bench, one: Added, fits: Sequence[Added], site: Site | None
) -> Finding:
    """An effect with its rivals, and what would tell the nearest of them apart.

    table, one: it beside the others.  fits: of every effect.
    """
    found = alternatives(table, one)
    unclear = [i for i, (_, _, power) in enumerate(found) if power < ENOUGH][:ADVISED]
    advice = [""] * len(found)
    if site:
        others = [(f.candidate.term, f.value) for f in fits if f is not one]
        for i in unclear:
            rival = found[i][0].candidate.term
            advice[i] = separate_with(site, Pair(one.candidate.term, one.value, rival, others))
    columns = one.candidate.term.columns(scene)
    size, _ = table.likeness(one, one.candidate)
    return Finding(
        terms=(one.candidate.term,),
        names=columns.names,
        units=columns.units,
        values=tuple(float(v) for v in one.value),
        sigmas=tuple(float(v) for v in one.sigma),
        size=size,
        p_value=table.p_value(one),
        alternatives=tuple(
            Alternative(
                other.candidate.term.effect,
                other.candidate.term.place,
                rho2,
                power,
                one.evidence - other.evidence,
                text,
            )
            for (other, rho2, power), text in zip(found, advice, strict=True)
        ),
        fixed=columns.fixed,
    )


def with_untested(found: Finding, scene: Scene, exclude: Sequence[str]) -> Finding:
    """A finding with its relatives that the data lack something for: they may be it as well.

    Relatives turn the same joint by what drives it; of how much alike they are nothing is known.
    """
    if not found.term.place.startswith("J"):
        return found
    own = EFFECTS[found.term.effect]
    lacking = [
        Alternative(name, found.term.place, 1.0, 0.0, 0.0, f"give {other.needs(scene)}")
        for name, other in EFFECTS.items()
        if (other.moves, other.follows) == (own.moves, own.follows)
        and name not in (own.name, *exclude)
        and other.needs(scene)
    ]
    return replace(found, alternatives=(*found.alternatives, *lacking)) if lacking else found


def whole(finding: Finding, every: Sequence[Term], scene: Scene) -> Finding:
    """A finding with the whole of its law, whose values are those of a fit that comes.

    every: the terms of all effects.
    """
    terms = entire(finding.terms, every)
    if terms == finding.terms:
        return finding
    named, units = names_of(terms, scene)
    names = tuple(own_name(name) for name in named)
    none = (0.0,) * len(names)
    new = replace(finding, terms=terms, names=names, units=units, values=none, sigmas=none)
    return replace(new, shown=finding.terms)


def merged(findings: Sequence[Finding]) -> list[Finding]:
    """Lines of one joint are one effect: their parameters together, the strongest first."""
    out: dict[tuple[str, str], Finding] = {}
    keys = [(found.term.effect, found.term.place) for found in findings]
    for key, found in zip(keys, findings, strict=True):
        turns = found.fixed.get("waves_per_turn")
        if turns and (EFFECTS[key[0]].follows == "wave" or keys.count(key) > 1):
            names = by_waves(found.names, found.term)
            found = replace(found, names=names, fixed={f"waves_per_turn {turns:.4g}": turns})
        if key not in out:
            out[key] = found
            continue
        first = out[key]
        others = {(a.effect, a.place): a for a in (*first.alternatives, *found.alternatives)}
        out[key] = replace(
            first,
            terms=(*first.terms, *found.terms),
            names=(*first.names, *found.names),
            units=(*first.units, *found.units),
            values=(*first.values, *found.values),
            sigmas=(*first.sigmas, *found.sigmas),
            size=first.size + found.size,
            p_value=max(first.p_value, found.p_value),
            alternatives=tuple(others.values()),
            fixed={**first.fixed, **found.fixed},
        )
    return list(out.values())


def fault_findings(faults: Sequence[Fault]) -> list[Finding]:
    """Faults as entries of the list of effects, those of a kind together."""
    out = []
    for effect in dict.fromkeys(fault.effect for fault in faults):
        same = [fault for fault in faults if fault.effect == effect]
        places = {fault.place for fault in same}
        amounts = [amount for fault in same for amount in fault.parameters]
        out.append(
            Finding(
                terms=(Term(effect, places.pop() if len(places) == 1 else "all"),),
                names=tuple(a.name for a in amounts),
                units=tuple(a.unit for a in amounts),
                values=tuple(a.value for a in amounts),
                sigmas=tuple(a.sigma for a in amounts),
                size=float("nan"),
                p_value=float("nan"),
                rows=tuple(sorted({int(row) for fault in same for row in fault.rows})),
            )
        )
    return out
