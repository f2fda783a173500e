"""Which elements a model is corrected by: each has to make held-out motion better."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from minimax_cal.dynamics.diagnose import MATTERS
from minimax_cal.dynamics.laws import CURVE, IN_FILE, LAWS, WORDS, Element, Term
from minimax_cal.dynamics.result import MotionDiagnosis, MotionEffect, changed_joints
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.stages import Progress
from minimax_cal.robots.mjcf import is_driven
from minimax_cal.simulators.chain import Chain
from minimax_cal.simulators.motion.fit import Asked, Study, fit_bristles, fit_numbers
from minimax_cal.simulators.motion.judge import Judge, Missed, installed, module_text
from minimax_cal.simulators.motion.numbers import (
    POWERS,
    SHORTEST,
    Numbers,
    Opened,
    has_powers,
    stiffen,
    unwritten,
    write_numbers,
)
from minimax_cal.simulators.result import MotionRung, WrittenElement

STAYS = 1e-3  # fall of the mean log RMS torque by which an element stays
HISTORY_FIRST = "MuJoCo begins with 0 in the history of delayed commands: call mj_initCtrlHistory"
BESIDE = 0.01  # the same, for a module beside the file, and of all rows for friction at rest


@dataclass(frozen=True, eq=False)
class Candidate:
    """A corrected model.  missed: on held-out motion.  module: text beside it, or empty."""

    asked: Asked
    numbers: Numbers
    opened: Opened
    missed: Missed
    module: str = ""

    @property
    def score(self) -> float:
        """Mean log RMS of the joints while they move."""
        return mean_log(self.missed.moving)


def mean_log(values: Array) -> float:
    """Mean logarithm, in which a joint counts as any other."""
    return float(np.log(np.maximum(values, 1e-300)).mean())


@dataclass(frozen=True, eq=False)
class Bench:
    """Where candidates are fitted and judged; each once.

    bristled: whether motors without input may hold friction at rest.  plain: whether the file may
    have nothing that other simulators leave out.
    """

    judge: Judge
    opened: Opened
    study: Study
    bristled: bool = False
    plain: bool = False
    made: dict[Asked, Candidate] = field(default_factory=dict)
    followed: dict[Asked, float] = field(default_factory=dict)

    def candidate(self, asked: Asked) -> Candidate:
        """The model with what is asked for, fitted to the runs to learn from."""
        if asked not in self.made:
            numbers = fit_numbers(self.study, asked)
            if Element.BRISTLES in asked.elements:
                numbers = self.with_bristles(numbers)
            return self.made_of(asked, numbers)
        return self.made[asked]

    def made_of(self, asked: Asked, numbers: Numbers) -> Candidate:
        """The model with these numbers, and how far it misses."""
        opened = self.written(numbers)
        text = self.module(opened.chain, numbers) if asked.laws else ""
        return self.judged(asked, opened, numbers, text)

    def judged(self, asked: Asked, opened: Opened, numbers: Numbers, text: str) -> Candidate:
        """A model, and how far it misses with a module."""
        with installed(text, opened.chain):
            missed = self.judge.torque(opened.chain, numbers)
        self.made[asked] = Candidate(asked, numbers, opened, missed, text)
        return self.made[asked]

    def beside(self, plain: Candidate, laws: tuple[Term, ...]) -> Candidate:
        """The file of a candidate as it is, with a module for some laws.

        What the module sets is fitted for that file: each joint's friction and damping, the laws.
        """
        asked = replace(plain.asked, laws=laws)
        if laws and asked not in self.made:
            found, chain = plain.numbers, plain.opened.chain
            chain = chain.in_model(copy(chain.model))
            study = self.study.of_file(chain, found.gain)
            own = Asked((plain.asked.elements & {Element.DELAY}) | {Element.FRICTION}, laws=laws,
                        late=plain.asked.late)  # fmt: skip
            numbers = fit_numbers(study, own).put(**found.at_rest)
            text = module_text(chain, numbers, study.scene.arm.gain, self.judge.arm.ratio)
            opened = replace(plain.opened, chain=chain)
            return self.judged(asked, opened, numbers.put(gain=found.gain), text)
        return self.made[asked] if laws else plain

    def with_bristles(self, numbers: Numbers) -> Numbers:
        """Numbers with bristles too, by the same runs."""
        opened = self.written(numbers)
        with installed(self.module(opened.chain, numbers) if numbers.laws else "", opened.chain):
            off = self.judge.off(opened.chain, self.judge.learning, numbers)
        return fit_bristles(self.study, numbers, off)

    def tracking(self, one: Candidate) -> float:
        """Mean log joint error of a candidate under logged commands; 0 where none were logged."""
        if not self.judge.commanded:
            return 0.0
        if one.asked not in self.followed:
            with installed(one.module, one.opened.chain):
                off = self.judge.tracking(one.opened.chain, one.numbers)
            self.followed[one.asked] = mean_log(off)
        return self.followed[one.asked]

    def written(self, numbers: Numbers) -> Opened:
        """The model with numbers in it."""
        document = self.opened.given.document.copy()
        write_numbers(document, self.opened.chain, self.study.given, numbers)
        if self.opened.new and not self.judge.commanded:
            stiffen(document.root, self.opened.chain, numbers)
        return self.opened.again(document)

    def module(self, chain: Chain, numbers: Numbers) -> str:
        """The text of the module for laws that no element holds."""
        return module_text(chain, numbers, self.judge.arm.gain, self.judge.arm.ratio)


@dataclass(frozen=True, eq=False)
class Corrected:
    """A corrected model, and what is said of it.

    rungs: after the first.  fitted: numbers of its body and the logs that told them, None without
    torques.  module: text beside it.  lost: what other simulators leave out.
    """

    opened: Opened
    rungs: tuple[MotionRung, ...]
    elements: tuple[WrittenElement, ...]
    fitted: tuple[Candidate, Study] | None
    module: str
    left_out: tuple[str, ...]
    notices: tuple[str, ...]
    lost: tuple[str, ...]


def asked_of(found: MotionDiagnosis, bench: Bench) -> tuple[Asked, tuple[Term, ...]]:
    """Everything that elements may hold, and the laws that none holds."""
    terms, chain = found.models[-1].terms, bench.opened.chain
    link = next((int(e.place[1:]) - 1 for e in found.effects
                 if e.effect in ("payload", "link_inertia") and e.worth), -1)  # fmt: skip
    late = found.models[-1].delay
    late += sum(float(term.value[0]) for term in terms if term.effect == "delay")
    of_command = late < 0.0 and bench.judge.commanded  # which the commands themselves show
    if abs(late) < SHORTEST * chain.step or of_command:
        late = 0.0
    pairs = zip(chain.joints, chain.servos, strict=True)
    motors = [is_driven(chain.model, joint) and servo < 0 for joint, servo in pairs]
    geared = tuple(j for j in held_at(terms, Element.GAIN) if motors[j])
    curved = held_at(terms, Element.LEVELLED) if has_powers(chain.model) else ()
    sprung = held_at(terms, Element.SPRINGS)
    there = {Element.FRICTION: True, Element.MASSES: True, Element.ARMATURE: True,
             Element.LEVELLED: curved, Element.SPRINGS: sprung, Element.GAIN: geared,
             Element.DELAY: late}  # fmt: skip
    elements = {one for one, where in there.items() if where}
    if bench.plain:
        elements -= {Element.LEVELLED, Element.DELAY}
    bent = 1 if bench.plain else POWERS - 1
    asked = Asked(frozenset(elements), link, curved, sprung, geared, late=late, bent=bent)
    return asked, tuple(term for term in terms if Element.MODULE in term.law.held)


def held_at(terms: Sequence[Term], element: Element) -> tuple[int, ...]:
    """Joints at which an element may hold a law."""
    return tuple(sorted({term.joint for term in terms if element in term.law.held}))


def correct(bench: Bench, found: MotionDiagnosis, progress: Progress) -> Corrected:
    """The model with every element that makes held-out motion better, and the ladder to it."""
    whole, laws = asked_of(found, bench)
    progress("fitting the elements of the model")
    full = without_idle(bench, first_choice(bench, whole, laws))
    plain = without_idle(bench, by_elements(bench, full, whole))
    if bench.plain or bench.beside(plain, full.asked.laws).score > plain.score - BESIDE:
        full = plain
    if bench.bristled:
        plain, full = at_rest(bench, plain, full)
    full = bench.beside(plain, full.asked.laws)
    rungs = tuple(ladder(bench, plain, full, progress))
    names = unwritten(plain.opened.chain, plain.numbers.bodies, plain.opened.chain.names)
    notices = tuple(f"link of {name}: MuJoCo did not take its mass and inertia from the file; give "
                    'the compiler inertiafromgeom="auto"' for name in names)  # fmt: skip
    elements = (*worths(bench, plain), *law_worths(bench, plain, full))
    left = tuple(left_out(found, whole.geared))
    return Corrected(plain.opened, rungs, elements, (plain, bench.study), full.module, left,
                     notices, tuple(lost(plain, full)))  # fmt: skip


def first_choice(bench: Bench, whole: Asked, laws: tuple[Term, ...]) -> Candidate:
    """All elements and laws: with the masses of all links or of the one that changed."""
    if any(term.law.family == CURVE for term in laws):
        whole = whole.without(Element.LEVELLED)  # the laws say it better
    whole = replace(whole, laws=laws)
    best = bench.candidate(replace(whole, link=-1))
    if whole.link >= 0:
        one = bench.candidate(whole)
        best = one if one.score < best.score + STAYS else best
    return best


def by_elements(bench: Bench, full: Candidate, whole: Asked) -> Candidate:
    """Elements alone, with the masses that belong to the laws that none holds."""
    if not full.asked.laws:
        return full
    elements = full.asked.elements | (whole.elements & {Element.LEVELLED, Element.FRICTION})
    asked = replace(full.asked, elements=elements, laws=(), behind=full.asked.laws)
    return bench.candidate(asked)


def without_idle(bench: Bench, best: Candidate) -> Candidate:
    """Without elements and laws that do not make held-out motion better.

    Where commands were logged, the joint error under them has a say: what lowers the torque's error
    alone may be the simulator's own, as a damper that acts within its step.
    """
    fewer: list[Callable[[Asked], Asked]] = [
        partial(without_law, effect=effect) for effect in effects_of(best.asked.laws)
    ]
    fewer += [partial(Asked.without, element=name) for name in reversed(IN_FILE)
              if name in best.asked.elements]  # fmt: skip
    fewer.append(lambda asked: asked.without(Element.ARMATURE).without(Element.MASSES))
    for less in fewer:
        bare = bench.candidate(less(best.asked))
        idle = bare.score < best.score + STAYS
        harms = bench.tracking(bare) < bench.tracking(best) - STAYS
        best = bare if idle or harms else best
    return best


def at_rest(bench: Bench, plain: Candidate, full: Candidate) -> tuple[Candidate, Candidate]:
    """Both with the same bristles, if all rows gain by them, and more than moving ones lose."""
    more = bench.candidate(full.asked.adding(Element.BRISTLES))
    gain = mean_log(full.missed.whole) - mean_log(more.missed.whole)
    helps = gain > BESIDE + max(0.0, more.score - full.score)
    if not helps or bench.tracking(more) > bench.tracking(full) + STAYS:
        return plain, full
    if full is plain:
        return more, more
    numbers = plain.numbers.put(**more.numbers.at_rest)
    return bench.made_of(plain.asked.adding(Element.BRISTLES), numbers), more


def without_law(asked: Asked, effect: str) -> Asked:
    """All but the laws of one effect."""
    return replace(asked, laws=tuple(term for term in asked.laws if term.effect != effect))


def effects_of(laws: Sequence[Term]) -> tuple[str, ...]:
    """The effects of some laws, each once."""
    return tuple(dict.fromkeys(term.effect for term in laws))


def ladder(
    bench: Bench, plain: Candidate, full: Candidate, progress: Progress
) -> Iterator[MotionRung]:
    """A rung for each element, fitted with those before it, and for each effect of the module."""
    taken = set[Element]()
    for name in IN_FILE:
        if name in plain.asked.elements:
            taken.add(name)
            asked = replace(plain.asked, elements=frozenset(taken))
            yield rung(bench, bench.candidate(asked), f"+ {name}", progress)
    some: tuple[Term, ...] = ()
    for effect in effects_of(full.asked.laws):
        some += tuple(term for term in full.asked.laws if term.effect == effect)
        one = bench.beside(plain, some)
        yield rung(bench, one, f"+ {WORDS[effect]} (module)", progress)


def rung(bench: Bench, one: Candidate, name: str, progress: Progress) -> MotionRung:
    """How far a candidate misses."""
    progress(f"driving the model: {name}")
    return bench.judge.rung(name, one.opened.chain, one.numbers, one.module, one.missed)


def worths(bench: Bench, plain: Candidate) -> Iterator[WrittenElement]:
    """What each element of the file is worth."""
    for name in IN_FILE:
        if name in plain.asked.elements:
            bare = bench.candidate(plain.asked.without(name))
            rows = "whole" if name == Element.BRISTLES else "moving"
            ends = (getattr(one.missed, rows) for one in (bare, plain))
            worth = changed_joints(*ends)
            yield WrittenElement(name.value, "file", name.attributes, worth)


def law_worths(bench: Bench, plain: Candidate, full: Candidate) -> Iterator[WrittenElement]:
    """What each effect of the module is worth."""
    for effect in effects_of(full.asked.laws):
        bare = bench.beside(plain, without_law(full.asked, effect).laws)
        where = ", ".join(t.place for t in full.asked.laws if t.effect == effect)
        worth = changed_joints(bare.missed.moving, full.missed.moving)
        yield WrittenElement(WORDS[effect], "module", f"at {where}", worth)


def lost(plain: Candidate, full: Candidate) -> Iterator[str]:
    """What other simulators leave out of the file, for people."""
    numbers, elements = plain.numbers, plain.asked.elements
    held = {
        Element.LEVELLED: numbers.damping[:, 1:].any(),
        Element.SPRINGS: numbers.stiffness[:, 1:].any(),
        Element.DELAY: Element.DELAY in elements,
        Element.BRISTLES: numbers.bristles.any(),
        Element.MODULE: full.module,
    }
    for name, is_there in held.items():
        if is_there:
            yield name.left_out
    if Element.DELAY in elements and numbers.late < 0.0:
        yield HISTORY_FIRST


def left_out(found: MotionDiagnosis, geared: Sequence[int]) -> Iterator[str]:
    """What neither file nor module holds, and what that costs.

    geared: joints whose drive gain the file holds.
    """
    for one in found.effects:
        law = LAWS.get(one.effect)
        alone = law and law.held == (Element.GAIN,)
        held = law and law.held and (not alone or int(one.place[1:]) - 1 in geared)
        if law and not held and not is_body(one):
            joint, (without, with_it) = one.best
            cost = f"{joint} {without:.3g} in place of {with_it:.3g} {found.unit}"
            yield f"{one.words}: {law.why} (costs {cost})"
    yield from (one.sentence(found.unit) for one in found.unexplained if one.share > MATTERS)


def is_body(one: MotionEffect) -> bool:
    """Whether an effect is a link whose mass is not as given, which the model holds."""
    return any(p.name == "mass" for p in one.parameters) and math.isnan(one.frequency)
