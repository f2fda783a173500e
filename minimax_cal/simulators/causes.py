"""What a calibration says is wrong with an arm, and fits of the same poses with some of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from minimax_cal.diagnosing.diagnose import diagnose
from minimax_cal.diagnosing.result import Diagnosis, load_diagnosis
from minimax_cal.fitting.calibrate import again, calibrate
from minimax_cal.fitting.fit import Fit, load_fit
from minimax_cal.fitting.floor import Floor
from minimax_cal.fitting.options import Progress
from minimax_cal.fitting.same_arm import check_arm
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.checks import check_joints
from minimax_cal.measuring.grouping import held_out
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.effects.compliance import WHOLE
from minimax_cal.modelling.effects.scene import unmasked
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.modelling.effects.words import name_effect
from minimax_cal.robots.robot import Robot
from minimax_cal.simulators.arm import ELEMENTS, assumed, why_not
from minimax_cal.simulators.chain import Chain
from minimax_cal.simulators.given import told_masses


@dataclass(frozen=True, eq=False)
class Causes:
    """given: the fit that others are made of.  geometry: the same without effects.

    firm: effects of which a simulator may have an element, in order.  turning: others that turn
    joints only, for a command map.  left_out: what is neither, and why.
    data: the measurements that the simulator is judged by, with their history; held: (m,) True
    where held out.  floor: what noise alone would leave, None untold.  same: whether these are the
    poses of the fits.
    """

    given: Fit
    geometry: Fit
    firm: tuple[Term, ...]
    turning: tuple[Term, ...]
    left_out: tuple[str, ...]
    data: Measurements
    held: Array
    floor: Floor | None
    same: bool

    def fitted(self, terms: Sequence[Term]) -> Fit:
        """The same poses fitted with these effects and no others: values belong together."""
        if [t.text for t in terms] == [t.text for t in self.given.cell.effects.terms]:
            return self.given
        return again(self.given, effects=tuple(t if t.choice else t.label for t in terms))


def causes_of(
    chain: Chain,
    data: Measurements,
    fit: Fit | Path | str | None,
    diagnosis: Diagnosis | Path | str | None,
    chosen: tuple[float, int],
    progress: Progress,
) -> Causes:
    """From a fit, a diagnosis, or both; without either a diagnosis is made.

    chain: the arm in the model.  A fit without masses is made again with those of the model: then
    its springs are the model's.  chosen: share and seed of the held-out poses, for a new diagnosis.
    """
    robot = chain.robot
    fit = load_fit(fit) if isinstance(fit, Path | str) else fit
    told = load_diagnosis(diagnosis) if isinstance(diagnosis, Path | str) else diagnosis
    if fit is None and told is None:
        told = diagnose(robot, data, holdout=chosen[0], seed=chosen[1], progress=progress)
    terms = established(told) if told else fit.cell.effects.terms if fit else ()
    if fit is None:
        assert told is not None
        terms = carried_over(terms, robot)
        rows = replace(told.data, digest=told.provenance.data_sha256)
        fit = calibrate(robot, marked(rows, told.held), objective="sum")
    elif not assumed(robot) and assumed(fit.nominal.robot):
        progress("fit with the masses of the model")
        terms = carried_over(terms, robot)
        fit = weighed(fit, chain, [t.label if not t.choice else t for t in terms])
        terms = fit.cell.effects.terms
    geometry = fit if not fit.cell.effects.terms else again(fit, effects=())
    firm = tuple(term for term in terms if term.effect in ELEMENTS)
    others = [term for term in terms if term.effect not in ELEMENTS]
    turning = tuple(term for term in others if maps(term, fit))
    left_out = tuple(
        f"{name_effect(*term.key)}: {why_not(EFFECTS[term.effect])}"
        for term in others
        if term not in turning
    )
    rows, held, same = judged_by(fit, data, chosen)
    floor = told.floor if told else None
    return Causes(fit, geometry, firm, turning, left_out, rows, held, floor, same)


def weighed(fit: Fit, chain: Chain, effects: Sequence[Term | str]) -> Fit:
    """The same fit, effects given, of a robot that has the masses of a simulator's model."""
    nominal = fit.nominal.robot
    mass, com = told_masses(chain, nominal)
    settings = {**vars(fit.options), "effects": tuple(effects)}
    rows = marked(fit.data, fit.held)
    return calibrate(replace(nominal, mass=mass, com=com), rows, **settings)


def established(told: Diagnosis) -> tuple[Term, ...]:
    """The effects that a diagnosis is sure of, in the order of its ladder."""
    sure = {
        term.text
        for finding in told.effects
        if finding.established
        for term in finding.terms
        if term.effect in EFFECTS
    }
    fitted_terms = told.cells[-1].effects.terms if told.cells else ()
    return tuple(term for term in fitted_terms if term.text in sure)


def carried_over(terms: Sequence[Term], robot: Robot) -> tuple[Term, ...]:
    """Terms for a robot whose masses may be known: then each joint has one torque.

    Those of all joints come first: what one of them has besides is chosen beside it.
    """
    if assumed(robot) or not any(rests_on_guesses(term) for term in terms):
        return tuple(terms)
    new = [replace(term, choice={}) if rests_on_guesses(term) else term for term in terms]
    return tuple(sorted(new, key=lambda term: term.place != "all"))


def rests_on_guesses(term: Term) -> bool:
    """Whether its law was chosen for masses that nobody told."""
    parts = unmasked(term.choice.get("parts", 0.0))
    return bool({"assumed", "tool"} & term.choice.keys()) or any(
        part % 4 != WHOLE for part in parts
    )


def maps(term: Term, fit: Fit) -> bool:
    """Whether an effect without an element turns joints only."""
    told = with_history(fit.data)
    return term.columns(fit.cell.scene(told)).only_turns


def marked(data: Measurements, held: Array) -> Measurements:
    """The measurements with a split column that says what is held out."""
    column = np.where(held, "holdout", "train")
    return replace(data, columns={**data.columns, "split": column})


def judged_by(
    fit: Fit, data: Measurements, chosen: tuple[float, int]
) -> tuple[Measurements, Array, bool]:
    """The poses to judge by, which of them are held out, and whether they are those of the fit.

    Raises DataError for poses that cannot be of its arm.
    """
    if fit.data.poses and fit.provenance.data_sha256 == data.digest:
        return with_history(fit.data), fit.held, True
    data = check_joints(fit.cell.robot, data)
    check_arm(fit.cell.robot, data)
    data = with_history(data)
    return data, held_out(data, *chosen)[0], False
