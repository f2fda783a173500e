"""Which elements a model is corrected by: each has to make held-out motion better."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from minimax_cal.dynamics.diagnose import MATTERS
from minimax_cal.dynamics.laws import LAWS, Element, Term
from minimax_cal.dynamics.result import MotionDiagnosis, changed_joints
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.stages import Progress
from minimax_cal.robots.mjcf import is_driven
from minimax_cal.simulators.motion.fit import Asked, Study, fit_numbers
from minimax_cal.simulators.motion.judge import Judge, Missed
from minimax_cal.simulators.motion.numbers import (
    MIN_DELAY_TIMESTEPS,
    POWERS,
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


@dataclass(frozen=True, eq=False)
class Candidate:
    """A corrected model.  missed: on held-out motion."""

    asked: Asked
    numbers: Numbers
    opened: Opened
    missed: Missed

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

    plain: whether the file may have nothing that other simulators leave out.
    """

    judge: Judge
    opened: Opened
    study: Study
    plain: bool = False
    made: dict[Asked, Candidate] = field(default_factory=dict)
    followed: dict[Asked, float] = field(default_factory=dict)

    def candidate(self, asked: Asked) -> Candidate:
        """The model with what is asked for, fitted to the runs to learn from."""
        if asked not in self.made:
            numbers = fit_numbers(self.study, asked)
            document = self.opened.given.document.copy()
            write_numbers(document, self.opened.chain, self.study.given, numbers)
            if self.opened.new and not self.judge.commanded:
                stiffen(document.root, self.opened.chain, numbers)
            opened = self.opened.again(document)
            missed = self.judge.torque(opened.chain, numbers)
            self.made[asked] = Candidate(asked, numbers, opened, missed)
        return self.made[asked]

    def tracking(self, one: Candidate) -> float:
        """Mean log joint error of a candidate under logged commands; 0 where none were logged."""
        if not self.judge.commanded:
            return 0.0
        if one.asked not in self.followed:
            off = self.judge.tracking(one.opened.chain, one.numbers)
            self.followed[one.asked] = mean_log(off)
        return self.followed[one.asked]


@dataclass(frozen=True, eq=False)
class Corrected:
    """A corrected model, and what is said of it.

    rungs: after the first.  fitted: numbers of its body and the logs that told them, None without
    torques.  lost: what other simulators leave out.
    """

    opened: Opened
    rungs: tuple[MotionRung, ...]
    elements: tuple[WrittenElement, ...]
    fitted: tuple[Candidate, Study] | None
    left_out: tuple[str, ...]
    notices: tuple[str, ...]
    lost: tuple[str, ...]


def asked_of(found: MotionDiagnosis, bench: Bench) -> Asked:
    """Everything that elements may hold, and the laws of a joint that none holds."""
    terms, chain = found.models[-1].terms, bench.opened.chain
    link = next((int(e.place[1:]) - 1 for e in found.effects
                 if e.effect in ("payload", "link_inertia") and e.worth), -1)  # fmt: skip
    late = found.models[-1].delay
    late += sum(float(term.value[0]) for term in terms if term.effect == "delay")
    of_command = late < 0.0 and bench.judge.commanded  # which the commands themselves show
    if abs(late) < MIN_DELAY_TIMESTEPS * chain.step or of_command:
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
    laws = tuple(t for t in terms if t.law.torque and not {*t.law.held} - {Element.LEVELLED})
    return Asked(frozenset(elements), link, curved, sprung, geared, laws, late, bent)


def held_at(terms: Sequence[Term], element: Element) -> tuple[int, ...]:
    """Joints at which an element may hold a law."""
    return tuple(sorted({term.joint for term in terms if element in term.law.held}))


def correct(bench: Bench, found: MotionDiagnosis, progress: Progress) -> Corrected:
    """The model with every element that makes held-out motion better, and the ladder to it."""
    whole = asked_of(found, bench)
    progress("fitting the elements of the model")
    best = bench.candidate(replace(whole, link=-1))
    if whole.link >= 0:  # the masses of the one link that changed
        one = bench.candidate(whole)
        best = one if one.score < best.score + STAYS else best

    # Backward elimination of laws and elements that do not make held-out motion better.  Where
    # commands were logged, the joint error under them has a say: what lowers the torque's error
    # alone may be the simulator's own, as a damper that acts within its step.
    effects = dict.fromkeys(term.effect for term in best.asked.laws)
    fewer: list[Callable[[Asked], Asked]] = [partial(Asked.without_law, effect=e) for e in effects]
    fewer += [partial(Asked.without, element=name) for name in reversed(Element)
              if name in best.asked.elements]  # fmt: skip
    fewer.append(lambda asked: asked.without(Element.ARMATURE).without(Element.MASSES))
    for less in fewer:
        bare = bench.candidate(less(best.asked))
        is_idle = bare.score < best.score + STAYS
        harms = bench.tracking(bare) < bench.tracking(best) - STAYS
        best = bare if is_idle or harms else best

    # A rung for each element, fitted with those before it; its worth is what is lost without it.
    names = [name for name in Element if name in best.asked.elements]
    rungs, elements = list[MotionRung](), list[WrittenElement]()
    for number, name in enumerate(names, start=1):
        one = bench.candidate(replace(best.asked, elements=frozenset(names[:number])))
        progress(f"driving the model: + {name}")
        rungs.append(bench.judge.rung(f"+ {name}", one.opened.chain, one.numbers, one.missed))
    for name in names:
        bare = bench.candidate(best.asked.without(name))
        worth = changed_joints(bare.missed.moving, best.missed.moving)
        elements.append(WrittenElement(name.value, name.attributes, worth))

    # What other simulators leave out of the file.
    numbers = best.numbers
    is_held = {
        Element.LEVELLED: numbers.damping[:, 1:].any(),
        Element.SPRINGS: numbers.stiffness[:, 1:].any(),
        Element.DELAY: Element.DELAY in names,
    }
    lost = [name.left_out for name, is_there in is_held.items() if is_there]
    if is_held[Element.DELAY] and numbers.late < 0.0:
        lost.append(HISTORY_FIRST)
    links = unwritten(best.opened.chain, numbers.bodies)
    notices = tuple(f"link of {link}: MuJoCo did not take its mass and inertia from the file; give "
                    'the compiler inertiafromgeom="auto"' for link in links)  # fmt: skip
    return Corrected(best.opened, tuple(rungs), tuple(elements), (best, bench.study),
                     tuple(left_out(found, whole)), notices, tuple(lost))  # fmt: skip


def left_out(found: MotionDiagnosis, whole: Asked) -> Iterator[str]:
    """What the file does not hold, and what that costs.  whole: all that it may hold."""
    for one in found.effects:
        law = LAWS.get(one.effect)  # the model holds a link whose mass is not as given
        is_link = any(p.name == "mass" for p in one.parameters) and math.isnan(one.frequency)
        if law is None or is_link:
            continue
        held = bool(law.held)
        if Element.GAIN in law.held:
            held = int(one.place[1:]) - 1 in whole.geared
        if Element.LEVELLED in law.held:
            held = Element.LEVELLED in whole.elements
        if not held:
            joint, (without, with_it) = one.best
            cost = f"{joint} {without:.3g} in place of {with_it:.3g} {found.unit}"
            small = f"{without:.3g}" == f"{with_it:.3g}"
            yield f"{one.words}: {law.why}" + ("" if small else f" (costs {cost})")
    yield from (one.sentence(found.unit) for one in found.unexplained if one.share > MATTERS)
