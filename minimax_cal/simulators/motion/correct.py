"""Which elements a model is corrected by: each has to make held-out motion better."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.progress_stages import Progress
from minimax_cal.dynamics.diagnose import MAX_UNEXPLAINED_SQUARE_SHARE
from minimax_cal.dynamics.laws import TORQUE_LAWS, SimulatorElement, TorqueTerm
from minimax_cal.dynamics.result import MotionDiagnosis, pair_changed_rms_by_joint
from minimax_cal.robots.mjcf_import import has_actuator
from minimax_cal.simulators.motion.fit import ElementSelection, FitData, fit_model_parameters
from minimax_cal.simulators.motion.judge import MotionJudge, TorqueErrors
from minimax_cal.simulators.motion.model_parameters import (
    MIN_DELAY_TIMESTEPS,
    POLYNOMIAL_TERMS,
    ModelParameters,
    OpenedModel,
    find_links_with_other_masses,
    has_damping_polynomials,
    raise_servo_gains_for_friction,
    write_model_parameters,
)
from minimax_cal.simulators.result import MotionGapStep, WrittenElement

MIN_LOG_ERROR_FALL = 1e-3  # fall of the mean log RMS torque by which an element stays
HISTORY_NOTICE = "MuJoCo begins with 0 in the history of delayed commands: call mj_initCtrlHistory"


@dataclass(frozen=True, eq=False)
class CandidateModel:
    """A corrected model.  torque_error: on held-out motion."""

    selection: ElementSelection
    parameters: ModelParameters
    opened: OpenedModel
    torque_error: TorqueErrors

    @property
    def score(self) -> float:
        """Mean log RMS of the joints while they move."""
        return mean_logarithm(self.torque_error.moving_rows)


def mean_logarithm(values: Array) -> float:
    """Mean logarithm, in which a joint counts as any other."""
    return float(np.log(np.maximum(values, 1e-300)).mean())


@dataclass(frozen=True, eq=False)
class CandidateModels:
    """Where candidates are fitted and judged; each once.

    portable: whether the file may have nothing that other simulators leave out.
    """

    judge: MotionJudge
    opened: OpenedModel
    fit_data: FitData
    portable: bool = False
    by_selection: dict[ElementSelection, CandidateModel] = field(default_factory=dict)
    joint_errors: dict[ElementSelection, float] = field(default_factory=dict)

    def fit_candidate(self, selection: ElementSelection) -> CandidateModel:
        """The model with what is asked for, fitted to the runs to learn from."""
        if selection not in self.by_selection:
            numbers = fit_model_parameters(self.fit_data, selection)
            document = self.opened.given.document.copy()
            write_model_parameters(
                document, self.opened.chain, self.fit_data.model_parameters, numbers
            )
            if self.opened.is_new and not self.judge.is_driven_by_commands:
                raise_servo_gains_for_friction(document.root, self.opened.chain, numbers)
            opened = self.opened.with_document(document)
            missed = self.judge.measure_torque_error(opened.chain, numbers)
            self.by_selection[selection] = CandidateModel(selection, numbers, opened, missed)
        return self.by_selection[selection]

    def measure_joint_error(self, candidate: CandidateModel) -> float:
        """Mean log joint error of a candidate under logged commands; 0 where none were logged."""
        if not self.judge.is_driven_by_commands:
            return 0.0
        if candidate.selection not in self.joint_errors:
            off = self.judge.measure_joint_error(candidate.opened.chain, candidate.parameters)
            self.joint_errors[candidate.selection] = mean_logarithm(off)
        return self.joint_errors[candidate.selection]


@dataclass(frozen=True, eq=False)
class CorrectedMotionModel:
    """A corrected model, and what is said of it.

    rungs: after the first.  candidate_and_data: numbers of its body and the logs that told them,
    None without torques.  portability_notices: what other simulators leave out.
    """

    opened: OpenedModel
    rungs: tuple[MotionGapStep, ...]
    elements: tuple[WrittenElement, ...]
    candidate_and_data: tuple[CandidateModel, FitData] | None
    left_out: tuple[str, ...]
    notices: tuple[str, ...]
    portability_notices: tuple[str, ...]


def select_elements(diagnosis: MotionDiagnosis, candidates: CandidateModels) -> ElementSelection:
    """Everything that elements may hold, and the laws of a joint that none holds."""
    terms, chain = diagnosis.models[-1].terms, candidates.opened.chain
    link = next((int(e.place[1:]) - 1 for e in diagnosis.effects
                 if e.effect in ("payload", "link_inertia") and e.worth), -1)  # fmt: skip
    late = diagnosis.models[-1].delay
    late += sum(float(term.value[0]) for term in terms if term.effect == "delay")
    of_command = (
        late < 0.0 and candidates.judge.is_driven_by_commands
    )  # which the commands themselves show
    if abs(late) < MIN_DELAY_TIMESTEPS * chain.timestep or of_command:
        late = 0.0
    pairs = zip(chain.joint_ids, chain.servo_ids, strict=True)
    motors = [has_actuator(chain.model, joint) and servo < 0 for joint, servo in pairs]
    geared = tuple(j for j in find_joints_of_element(terms, SimulatorElement.GAIN) if motors[j])
    curved = (
        find_joints_of_element(terms, SimulatorElement.LEVELLED)
        if has_damping_polynomials(chain.model)
        else ()
    )
    sprung = find_joints_of_element(terms, SimulatorElement.SPRINGS)
    there = {
        SimulatorElement.FRICTION: True,
        SimulatorElement.MASSES: True,
        SimulatorElement.ARMATURE: True,
        SimulatorElement.LEVELLED: curved,
        SimulatorElement.SPRINGS: sprung,
        SimulatorElement.GAIN: geared,
        SimulatorElement.DELAY: late,
    }
    elements = {one for one, where in there.items() if where}
    if candidates.portable:
        elements -= {SimulatorElement.LEVELLED, SimulatorElement.DELAY}
    bent = 1 if candidates.portable else POLYNOMIAL_TERMS - 1
    laws = tuple(
        t for t in terms if t.law.torque and not {*t.law.held} - {SimulatorElement.LEVELLED}
    )
    return ElementSelection(frozenset(elements), link, curved, sprung, geared, laws, late, bent)


def find_joints_of_element(
    terms: Sequence[TorqueTerm], element: SimulatorElement
) -> tuple[int, ...]:
    """Joints at which an element may hold a law."""
    return tuple(sorted({term.joint_index for term in terms if element in term.law.held}))


def correct_elements(
    candidates: CandidateModels, diagnosis: MotionDiagnosis, progress: Progress
) -> CorrectedMotionModel:
    """The model with every element that makes held-out motion better, and the ladder to it."""
    whole = select_elements(diagnosis, candidates)
    progress("fitting the elements of the model")
    best = candidates.fit_candidate(replace(whole, link=-1))
    if whole.link >= 0:  # the masses of the one link that changed
        one = candidates.fit_candidate(whole)
        best = one if one.score < best.score + MIN_LOG_ERROR_FALL else best

    # Backward elimination of laws and elements that do not make held-out motion better.  Where
    # commands were logged, the joint error under them has a say: what lowers the torque's error
    # alone may be the simulator's own, as a damper that acts within its step.
    effects = dict.fromkeys(term.effect for term in best.selection.laws)
    fewer: list[Callable[[ElementSelection], ElementSelection]] = [
        partial(ElementSelection.without_law, effect=e) for e in effects
    ]
    fewer += [
        partial(ElementSelection.without_element, element=name)
        for name in reversed(SimulatorElement)
        if name in best.selection.elements
    ]
    fewer.append(
        lambda asked: asked.without_element(SimulatorElement.ARMATURE).without_element(
            SimulatorElement.MASSES
        )
    )
    for less in fewer:
        bare = candidates.fit_candidate(less(best.selection))
        is_idle = bare.score < best.score + MIN_LOG_ERROR_FALL
        harms = (
            candidates.measure_joint_error(bare)
            < candidates.measure_joint_error(best) - MIN_LOG_ERROR_FALL
        )
        best = bare if is_idle or harms else best

    # A rung for each element, fitted with those before it; its worth is what is lost without it.
    names = [name for name in SimulatorElement if name in best.selection.elements]
    rungs, elements = list[MotionGapStep](), list[WrittenElement]()
    for number, name in enumerate(names, start=1):
        one = candidates.fit_candidate(replace(best.selection, elements=frozenset(names[:number])))
        progress(f"driving the model: + {name}")
        rungs.append(
            candidates.judge.measure_step(
                f"+ {name}", one.opened.chain, one.parameters, one.torque_error
            )
        )
    for name in names:
        bare = candidates.fit_candidate(best.selection.without_element(name))
        worth = pair_changed_rms_by_joint(
            bare.torque_error.moving_rows, best.torque_error.moving_rows
        )
        elements.append(WrittenElement(name.value, name.attributes, worth))

    # What other simulators leave out of the file.
    numbers = best.parameters
    is_held = {
        SimulatorElement.LEVELLED: numbers.damping[:, 1:].any(),
        SimulatorElement.SPRINGS: numbers.stiffness[:, 1:].any(),
        SimulatorElement.DELAY: SimulatorElement.DELAY in names,
    }
    lost = [name.describe_omission for name, is_there in is_held.items() if is_there]
    if is_held[SimulatorElement.DELAY] and numbers.delay < 0.0:
        lost.append(HISTORY_NOTICE)
    links = find_links_with_other_masses(best.opened.chain, numbers.bodies)
    notices = tuple(f"link of {link}: MuJoCo did not take its mass and inertia from the file; give "
                    'the compiler inertiafromgeom="auto"' for link in links)  # fmt: skip
    return CorrectedMotionModel(
        best.opened,
        tuple(rungs),
        tuple(elements),
        (best, candidates.fit_data),
        tuple(list_effects_left_out(diagnosis, whole)),
        notices,
        tuple(lost),
    )


def list_effects_left_out(diagnosis: MotionDiagnosis, selection: ElementSelection) -> Iterator[str]:
    """What the file does not hold, and what that costs.  selection: all that it may hold."""
    for one in diagnosis.effects:
        law = TORQUE_LAWS.get(one.effect)  # the model holds a link whose mass is not as given
        is_link = any(p.name == "mass" for p in one.parameters) and math.isnan(one.frequency)
        if law is None or is_link:
            continue
        held = bool(law.held)
        if SimulatorElement.GAIN in law.held:
            held = int(one.place[1:]) - 1 in selection.gain_joints
        if SimulatorElement.LEVELLED in law.held:
            held = SimulatorElement.LEVELLED in selection.elements
        if not held:
            joint, (without, with_it) = one.joint_of_largest_gain
            cost = f"{joint} {without:.3g} in place of {with_it:.3g} {diagnosis.unit}"
            small = f"{without:.3g}" == f"{with_it:.3g}"
            yield f"{one.words}: {law.why}" + ("" if small else f" (costs {cost})")
    yield from (
        one.describe_structure(diagnosis.unit)
        for one in diagnosis.unexplained
        if one.share > MAX_UNEXPLAINED_SQUARE_SHARE
    )
