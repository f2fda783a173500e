"""Diagnose torques along trajectories: what the model lacks, and what each effect is worth."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import ndtr

from minimax_cal.dynamics.budget import CrossValidation
from minimax_cal.dynamics.given import LEAST_SCALE, MOST_SCALE, MotionKnown
from minimax_cal.dynamics.laws import ANGLE, CURVE, LAWS, USUAL, Term, terms_of
from minimax_cal.dynamics.logs.table import Run
from minimax_cal.dynamics.masses import LinkChange, compare_with_given_masses, find_payloads
from minimax_cal.dynamics.model import (
    FRICTION,
    RIGID,
    Body,
    Columns,
    Normal,
    TorqueLaws,
)
from minimax_cal.dynamics.probes import Unexplained, unexplained
from minimax_cal.dynamics.result import (
    Alternative,
    MotionDiagnosis,
    MotionEffect,
    NotTestable,
    Verdict,
)
from minimax_cal.dynamics.rows import Arm, Logs, Scene
from minimax_cal.evidence.library import Library
from minimax_cal.evidence.limits import LEVEL, MINOR
from minimax_cal.evidence.selection import Choice, select
from minimax_cal.evidence.stability import Repeats, alternatives, halves, repeated
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.options import check_left_out, takes
from minimax_cal.ground.stages import Progress, silent
from minimax_cal.ground.threads import one_thread
from minimax_cal.measuring.faults.fault import Amount
from minimax_cal.robots.gravity import weighed
from minimax_cal.robots.robot import Robot

MIN_DURATION = 25.0  # of trajectories: in less, laws stand in for each other
MIN_PEAK_SPEED = 0.25  # that some joint must reach [rad/s, m/s]: slower, most laws are invisible
MATTERS = 0.28  # of the remaining error's square at a joint, 15 % of its RMS: more has no name
SELECTION_FOLD = 0.2  # about this share of the trajectories is left out in turn to judge a law
HALVINGS = 2  # of the groups, in whose halves names are sought again
MIN_REPEAT_SHARE = 0.75  # of the halves in which a confirmed name is found
MAX_GAIN_ERROR = 0.3  # of a drive: what is off by more has another unit or sign
MIN_DELAY = 1e-4  # delays below it move no row [s]
NO_DELAY = Amount("time", 0.0, "s", 0.0)


@takes(known=MotionKnown)
def diagnose_motion(
    robot: Robot | str | Path,
    logs: Sequence[Run | str | Path] | str | Path,
    *,
    known: MotionKnown,
    exclude: Sequence[str] = (),
    progress: Progress = silent,
) -> MotionDiagnosis:
    """Say why the torques of a robot along trajectories are not those of its model.

    Parameters
    ----------
    robot
        Loaded, or a name or path; masses, inertias and drive gains of its file are used.
    logs
        Files or runs; each is a trajectory.
    known
        See `MotionKnown`.
    exclude
        Effects that are not to be considered.
    progress
        Called with a word on each stage.

    Returns
    -------
    MotionDiagnosis

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.diagnose_motion("arm.urdf", ["run1.csv", "run2.csv"]).summary())
    """
    began = time.perf_counter()
    check_left_out(exclude, LAWS)
    progress("reading logs")
    inputs = known.read_inputs(robot, logs)
    with one_thread():
        found = diagnose_torques(inputs.arm, inputs.logs, inputs.run_fold, exclude, progress)
    seconds = time.perf_counter() - began
    return replace(found, notices=(*inputs.notices, *found.notices), seconds=seconds)


def diagnose_torques(
    arm: Arm, logs: Logs, run_fold: Array, exclude: Sequence[str], progress: Progress
) -> MotionDiagnosis:
    """Causes of what a rigid body leaves of the torques, judged on rows that their fit did not see.

    run_fold: (R,) in which a row is left out, negative for rows that are always fitted; the search
    sees these alone where there are some.  exclude: effects that are not considered.
    """
    rows = run_fold < 0 if (run_fold < 0).any() else run_fold >= 0
    learning, logged_torque = np.unique(logs.run[rows]).tolist(), logs.y

    # Forward selection of laws by evidence; again with whatever changes the rows or all columns.
    progress("searching for causes")
    search = search_laws(arm, logs.only(learning), exclude)
    soft = search.columns.soften_friction(search.terms)
    if np.any(soft > arm.soft):
        arm = replace(arm, soft=soft)
        progress("searching again with softer friction")
        search = search_laws(arm, logs.only(learning), exclude)
    if wrong_units := search.describe_wrong_units():
        arm = replace(arm, gain=np.zeros(0))
        progress("searching again with masses of each joint")
        search = search_laws(arm, logs.only(learning), exclude)
    delay = search.read_delay()
    if delay.value:
        logs = logs.earlier(delay.value)
        progress("searching again without the delay")
        search = search_laws(arm, logs.only(learning), exclude)

    # Backward elimination by cross-validation over the runs that the search saw.
    progress("judging causes on trajectories left out")
    normal = Normal.fit_whitened(search.columns, search.terms)
    fold = search.logs.split_folds(SELECTION_FOLD)
    validation = CrossValidation.of(normal, search.columns.error, fold)
    search = search.keep_terms(validation.drop_harmful_laws())

    # Generalised least squares of all runs, and without each fold.
    columns = search.columns
    if len(learning) < len(logs.names):
        columns = search.context.build_columns(Scene.of(arm, logs))
    normal = Normal.fit_whitened(columns, search.terms)
    undelayed = columns.error + (logged_torque - logs.y).T
    validation = CrossValidation.of(normal, undelayed, run_fold)

    # Stability selection, test of the masses as given, structure of the residuals.
    masks = halves(search.choice.library.rows.group, HALVINGS)
    repeats = repeated(search.choice, masks, level=LEVEL)
    masses = compare_with_given_masses(normal)
    left = tuple(unexplained(normal, validation.value))
    if any(one.share > MATTERS for one in left):  # what makes the masses look wrong, perhaps
        masses = replace(masses, change=None)

    effects = build_effects(search, validation, repeats, delay, masses.change)
    too_little = search.describe_lacking_motion()
    return MotionDiagnosis(
        arm=arm, unit=logs.unit, verdict=find_verdict(effects, left, too_little), effects=effects,
        budget=validation.build_budget(delay.value), unexplained=left,
        not_testable=search.list_untestable(), too_little=too_little,
        models=validation.build_models(search.context, delay.value), runs=logs.names,
        held_out=validation.describe_folds(), held_run=validation.sample_held_out_run(),
        curves=tuple(validation.draw_friction_curves()),
        notices=(*wrong_units, *masses.describe(arm, logs.unit)), seconds=0.0,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class LawSearch:
    """The laws that trajectories call for.

    columns: of the rows that were searched.  context: body and friction that the laws were computed
    with.  lacking: effect, place and what is needed of laws that were not tried.
    """

    columns: Columns
    context: Body
    choice: Choice
    lacking: tuple[tuple[str, str, str], ...]

    @property
    def logs(self) -> Logs:
        """Whose rows were searched."""
        return self.columns.scene.logs

    @property
    def terms(self) -> tuple[Term, ...]:
        """The laws."""
        return tuple(one.candidate.term for one in self.choice.found)

    def keep_terms(self, terms: Sequence[Term]) -> LawSearch:
        """With some of its laws."""
        found = tuple(one for one in self.choice.found if one.candidate.term in terms)
        return replace(self, choice=replace(self.choice, found=found))

    def describe_lacking_motion(self) -> tuple[str, ...]:
        """Why the motion is too little to name a cause."""
        peak, out = float(np.abs(self.logs.motion.qd).max()), []
        if self.logs.seconds < MIN_DURATION:
            out.append(
                f"{self.logs.seconds:.0f} s of trajectories; record {MIN_DURATION:.0f} s or more, "
                "better several of different kinds"
            )
        if peak < MIN_PEAK_SPEED:
            out.append(
                f"no joint is faster than {peak:.2g} rad/s; record a run that reaches "
                f"{MIN_PEAK_SPEED:g} rad/s or more"
            )
        return tuple(out)

    def list_untestable(self) -> tuple[NotTestable, ...]:
        """What the logs cannot show, each effect and need once."""
        needs: dict[tuple[str, str], list[str]] = {}
        for effect, place, what in self.lacking:
            needs.setdefault((effect, what), []).append(place)
        joints, out = {f"J{j + 1}" for j in range(self.logs.joints)}, []
        for (effect, what), places in needs.items():
            place = "all" if joints <= set(places) else ", ".join(places)
            out.append(NotTestable(effect, place, what))
        if not self.columns.scene.arm.known.any():
            what = "a known payload: without one a common error of all drive gains and masses are "
            out.append(NotTestable("drive_gain", "all", f"{what}the same"))
        return tuple(out)

    def describe_wrong_units(self) -> tuple[str, ...]:
        """Notices of torques whose size no error of a drive or of the masses explains."""
        scene, scales = self.columns.scene, dict[int, tuple[float, str]]()
        if scene.arm.shared and weighed(scene.arm.robot).all():
            drawn = scene.regressor @ scene.arm.drawn
            j = int(np.argmax((drawn**2).sum(axis=0)))
            scale = float(drawn[:, j] @ scene.load[:, j] / (drawn[:, j] @ drawn[:, j]))
            if not LEAST_SCALE < scale < MOST_SCALE:
                scales[j] = scale, f"the masses of {scene.arm.robot.name}"
        for term, (value, _) in zip(self.terms, self.choice.estimates, strict=True):
            if term.effect == "drive_gain" and abs(value[0]) > MAX_GAIN_ERROR:
                scales[term.joint] = float(1.0 + value[0]), "masses that all joints share"
        return tuple(
            f"the torques of joint {j + 1} are {scale:.3g} times what {masses} need: another unit "
            "or sign; currents? then name the columns i1_A, i2_A, ... and give drive_gain=; here "
            "each joint has masses of its own"
            for j, (scale, masses) in scales.items()
        )

    def read_delay(self) -> Amount:
        """By which torques were logged after the motion [s]."""
        delay = NO_DELAY
        for term, (value, sigma) in zip(self.terms, self.choice.estimates, strict=True):
            if term.effect == "delay" and abs(value[0]) > MIN_DELAY:
                delay = replace(delay, value=float(value[0]), sigma=float(sigma[0]))
        return delay


def search_laws(arm: Arm, logs: Logs, exclude: Sequence[str]) -> LawSearch:
    """The laws that the fitted rows of some logs call for."""
    scene = Scene.of(arm, logs)
    context = Body.fit_with_friction(scene)
    columns = context.build_columns(scene)
    every, lacking = terms_of(columns.scene, exclude)
    terms = [term for term in every if term.effect != "payload"]
    if len(terms) < len(every):
        terms += find_payloads(columns, terms)
    laws = TorqueLaws.of(columns, columns.whitening(terms))
    choice = select(Library.of(laws, terms, []))
    hidden = ((effect, "all", "motion in which the rigid body does not imitate it")
              for effect, _ in choice.library.untestable)  # fmt: skip
    return LawSearch(columns, context, choice, (*lacking, *hidden))


def build_effects(
    search: LawSearch,
    validation: CrossValidation,
    repeats: Repeats,
    delay: Amount,
    change: LinkChange | None,
) -> tuple[MotionEffect, ...]:
    """What the torques show, with what each effect is worth; those that close most first.

    delay: that was taken out of the torques.  change: a link whose parameters are not as given.
    """
    normal, logs, unit = validation.normal, validation.logs, validation.logs.unit
    value, sigma = validation.value, validation.sigma
    usual = validation.rms(validation.predict_residuals([RIGID, FRICTION]), logs.moving)
    effects: list[MotionEffect] = []

    def is_minor(worth: dict[str, tuple[float, float]], before: Array) -> bool:
        """Whether an effect closes little of what the step before its kind leaves (n,)."""
        shares = ((a**2 - b**2) / max(before[int(joint[1:]) - 1] ** 2, 1e-300)
                  for joint, (a, b) in worth.items())  # fmt: skip
        return bool(max(shares) < MINOR)

    # Laws: confirmed where most halves of the data show them, too.
    whole = delay
    for number, term in enumerate(search.terms):
        at = normal.place[term.text]
        if delay.value and term.effect == "delay":  # what the shift of the torques left of it
            rest = value[at].item(), sigma[at].item()
            whole = replace(delay, value=delay.value + rest[0], sigma=rest[1])
            continue
        others = [part for part in normal.parts if part != term.text]
        worth = validation.compare(validation.predict_residuals(others))
        rivals = ((rival.candidate.term, rho2) for rival, rho2, _ in alternatives(
            *search.choice.beside_others(number)))  # fmt: skip
        frequency = repeats.frequency([term.key])
        effects.append(MotionEffect(
            term.effect, term.place, term.law.amounts(value[at], sigma[at], unit, term.tuned),
            worth, tuple(Alternative(t.effect, t.place, rho2, t.law.separate)
                         for t, rho2 in rivals),
            frequency, frequency >= MIN_REPEAT_SHARE, is_minor(worth, usual), term.law.family,
        ))  # fmt: skip

    # Coulomb and viscous friction of each joint, where the rows show them [z test, Bonferroni].
    rigid = validation.rms(validation.predict_residuals([RIGID]), logs.moving)
    for number, column in enumerate(normal.index([FRICTION]).tolist()):
        z = value[column] / sigma[column] if sigma[column] > 0.0 else 0.0
        if float(ndtr(-z)) * 2 * logs.joints > LEVEL:
            continue
        worth = validation.compare(validation.predict_residuals(normal.parts, without=(column,)))
        unit_of = unit if number % 2 == 0 else f"{unit} s/rad"
        amount = Amount("friction", float(value[column]), unit_of, float(sigma[column]))
        effects.append(MotionEffect(USUAL[number % 2], f"J{number // 2 + 1}", (amount,), worth,
                                    minor=is_minor(worth, rigid), family=CURVE))  # fmt: skip

    # A delay that was taken out before, and a link that is not as given.
    if delay.value:
        worth = validation.compare(validation.predict_residuals(normal.parts, delayed=False))
        minor = is_minor(worth, usual)
        effects.insert(0, MotionEffect("delay", "all", (whole,), worth, minor=minor))
    if change is not None:
        last, law = logs.joints - 1, LAWS["payload"]
        names = {k: ("payload" if k == last else "link_inertia", f"L{k + 1}")
                 for k in range(last + 1)}  # fmt: skip
        effects.insert(0, MotionEffect(
            *names[change.link], law.amounts(change.value, change.sigma, ""), change.worth,
            tuple(Alternative(*names[k], 1.0, law.separate) for k in change.others),
            minor=is_minor(change.worth, change.before),
        ))  # fmt: skip
    return tuple(sorted(effects, key=lambda one: (one.minor, -one.relative_gain)))


def find_verdict(
    effects: Sequence[MotionEffect], left: Sequence[Unexplained], too_little: Sequence[str]
) -> Verdict:
    """What may be said of the cause."""
    main = [e for e in effects if e.established and not e.minor]
    if too_little or any(one.share > MATTERS for one in left):
        return "unknown"
    if not main:
        return "unknown" if left else "none"
    beyond_usual = [e for e in main if e.effect not in USUAL]
    first = max(beyond_usual or main, key=lambda one: one.relative_gain)
    # Forms of one curve over speed or angle at a joint are one cause.
    form = family(first.effect), first.place
    same = [e for e in beyond_usual if (family(e.effect), e.place) == form]
    others = [a for a in first.alternatives if (family(a.effect), a.place) != form]
    return "one_of" if others or (len(same) > 1 and form[0] == ANGLE) else "named"


def family(effect: str) -> str:
    """The family of an effect: forms of one friction curve are one."""
    if effect in USUAL:
        return CURVE
    return LAWS[effect].family or effect if effect in LAWS else effect
