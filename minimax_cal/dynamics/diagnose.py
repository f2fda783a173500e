"""Diagnose torques along trajectories: what the model lacks, and what each effect is worth."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import ndtr

from minimax_cal.dynamics.budget import (
    LeftOut,
    by_loads,
    drawn_missed,
    folds_of,
    steps_of,
    without_harmful,
)
from minimax_cal.dynamics.given import LEAST_SCALE, MOST_SCALE, MotionKnown, runs_of
from minimax_cal.dynamics.laws import ANGLE, CURVE, LAWS, USUAL, Law, Term, terms_of
from minimax_cal.dynamics.logs.table import CURRENT, Run
from minimax_cal.dynamics.model import (
    FRICTION,
    RIGID,
    Body,
    Columns,
    LinkChange,
    Normal,
    TorqueModel,
    body_as_given,
    carried,
    dictionary_of,
    first_body,
    parts_of,
    softened,
    weighing,
)
from minimax_cal.dynamics.probes import Unexplained, unexplained
from minimax_cal.dynamics.result import (
    Alternative,
    FrictionCurve,
    HeldRun,
    MotionDiagnosis,
    MotionEffect,
    MotionStep,
    NotTestable,
    Verdict,
    worth_by_joint,
)
from minimax_cal.dynamics.rows import ROW_HZ, Arm, Logs, Scene, prepare, sense_of, whitening
from minimax_cal.evidence.library import Library
from minimax_cal.evidence.limits import LEVEL, MINOR
from minimax_cal.evidence.selection import Choice, select
from minimax_cal.evidence.stability import Repeats, alternatives, halves, repeated
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.options import check_left_out, takes
from minimax_cal.ground.stages import Progress, silent
from minimax_cal.ground.threads import one_thread
from minimax_cal.measuring.faults.fault import Amount
from minimax_cal.robots.gravity import weighed
from minimax_cal.robots.robot import Robot, load_robot

LEAST_SECONDS = 25.0  # of trajectories: in less, laws stand in for each other
LEAST_PEAK = 0.25  # speed that some joint must reach [rad/s, m/s]: slower, most laws are invisible
MATTERS = 0.28  # of the remaining error's square at a joint, 15 % of its RMS: more has no name
FOLD = 0.2  # about this share of the trajectories is left out in turn to judge a law
HALVINGS = 2  # of the groups, in whose halves names are sought again
FOUND_AGAIN = 0.75  # share of the halves in which a confirmed name is found
SHOWN_ROWS = 750  # of the held-out run that is drawn
CURVE_POINTS = 61
MAX_GAIN_ERROR = 0.3  # of a drive: what is off by more has another unit or sign
LATE = 1e-4  # delays below it move no row [s]
GIVEN, REFITTED, USUALLY = "model as given", "rigid body refitted", "usual friction refitted"


@dataclass(frozen=True, eq=False)
class Found:
    """The laws that trajectories call for.

    columns, choice: of the search.  context: body and friction that the laws were computed with.
    lacking: effect, place and what is needed of laws that were not tried.
    """

    columns: Columns
    context: Body
    choice: Choice
    terms: tuple[Term, ...]
    lacking: tuple[tuple[str, str, str], ...]


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
    arm_of = load_robot(robot)
    check_left_out(exclude, LAWS)
    progress("reading logs")
    runs = runs_of(robot, arm_of, logs)
    prepared = prepare(known.loaded(runs))
    arm = Arm.of(arm_of, known.gains(arm_of, runs), known.ratios(arm_of), known.load, prepared)
    holdout, named = known.holdout, named_runs(prepared, known.holdout_run)
    if not (named or 0.0 < holdout < 1.0):
        raise OptionError(f"holdout={holdout:g} must lie between 0 and 1")
    with one_thread():
        made = examined(arm, prepared, folds_of(prepared, holdout, named), exclude, progress)
    said = tuple(dict.fromkeys(text for run in runs for text in run.notices))
    return replace(made, notices=(*said, *made.notices), seconds=time.perf_counter() - began)


def named_runs(logs: Logs, given: str | Sequence[str] | None) -> tuple[str, ...]:
    """The runs that judge.  Raises OptionError."""
    wanted = (given,) if isinstance(given, str) else tuple(given or ())
    for name in wanted:
        if name not in logs.names:
            raise OptionError(f"holdout_run: no run {name!r}; choose {', '.join(logs.names)}")
    if wanted and len(set(wanted)) == len(logs.names):
        raise OptionError("holdout_run: leaves no run to learn from; name fewer")
    return wanted


def motion_lacking(logs: Logs) -> Iterator[str]:
    """Why the motion is too little to name a cause."""
    if logs.seconds < LEAST_SECONDS:
        yield (
            f"{logs.seconds:.0f} s of trajectories; record {LEAST_SECONDS:.0f} s or more, better "
            "several of different kinds"
        )
    peak = float(np.abs(logs.motion.qd).max())
    if peak < LEAST_PEAK:
        yield (
            f"no joint is faster than {peak:.2g} rad/s; record a run that reaches "
            f"{LEAST_PEAK:g} rad/s or more"
        )


# ---- the search --------------------------------------------------------------------------------


def search(arm: Arm, logs: Logs, exclude: Sequence[str]) -> Found:
    """The laws that the fitted rows of some logs call for."""
    scene = Scene.of(arm, logs)
    context = first_body(Columns(scene))
    columns = Columns(context.in_scene(scene))
    every, lacking = terms_of(columns.scene, exclude)
    terms = [term for term in every if term.effect != "payload"]
    if len(terms) < len(every):
        terms += weighing(columns, terms, carried(columns, terms))
    white = columns.whitening(terms)
    choice = select(Library.of(dictionary_of(columns, white), terms, []))
    chosen = tuple(one.candidate.term for one in choice.found)
    hidden = [(effect, "all", "motion in which the rigid body does not imitate it")
              for effect, _ in choice.library.untestable]  # fmt: skip
    return Found(columns, context, choice, chosen, (*lacking, *hidden))


def unit_notices(found: Found) -> Iterator[str]:
    """Notices of torques whose size no error of a drive or of the masses explains."""
    scene, scales = found.columns.scene, dict[int, tuple[float, str]]()
    if scene.arm.shared and weighed(scene.arm.robot).all():
        drawn = scene.regressor @ scene.arm.drawn
        j = int(np.argmax((drawn**2).sum(axis=0)))
        scale = float(drawn[:, j] @ scene.load[:, j] / (drawn[:, j] @ drawn[:, j]))
        if not LEAST_SCALE < scale < MOST_SCALE:
            scales[j] = scale, f"the masses of {scene.arm.robot.name}"
    for one, (value, _) in zip(found.choice.found, found.choice.estimates, strict=True):
        term = one.candidate.term
        if term.effect == "drive_gain" and abs(value[0]) > MAX_GAIN_ERROR:
            scales[term.joint] = float(1.0 + value[0]), "masses that all joints share"
    for j, (scale, masses) in scales.items():
        yield (
            f"the torques of joint {j + 1} are {scale:.3g} times what {masses} need: another unit "
            "or sign; currents? then name the columns i1_A, i2_A, ... and give drive_gain=; here "
            "each joint has masses of its own"
        )


def fitted(found: Found, columns: Columns) -> Normal:
    """Rows of what was found, whitened by what it leaves of them."""
    rough = Normal.of(columns, columns.whitening(found.terms), found.terms)
    rest = rough.rest(rough.solve(parts_of(found.terms)))
    return Normal.of(columns, whitening(columns.scene.logs, rest), found.terms)


def helpful(found: Found) -> Found:
    """What was found, less the laws that harm the joints of runs left out more than they help."""
    logs = found.columns.scene.logs
    normal = fitted(found, found.columns)
    fold = by_loads(folds_of(logs, FOLD, ()), logs, found.terms)
    kept = without_harmful(LeftOut.of(normal, found.columns.error, fold), found.terms)
    choice = replace(found.choice, found=tuple(
        one for one in found.choice.found if one.candidate.term in kept))  # fmt: skip
    return replace(found, choice=choice, terms=tuple(kept))


# ---- the answer --------------------------------------------------------------------------------


def examined(
    arm: Arm, logs: Logs, fold: Array, exclude: Sequence[str], progress: Progress
) -> MotionDiagnosis:
    """The diagnosis of runs whose rows are judged in folds.  fold: (R,)."""
    learns = fold < 0 if (fold < 0).any() else np.ones_like(fold, dtype=bool)
    learning = np.unique(logs.run[learns]).tolist()  # all, but runs that alone judge
    too_little = tuple(motion_lacking(logs.only(learning)))

    def sought(why: str) -> Found:
        progress(why)
        return search(arm, logs.only(learning), exclude)

    found = sought("searching for causes")
    soft = softened(found.columns, found.terms)
    if np.any(soft > arm.soft):
        arm = replace(arm, soft=soft)
        found = sought("searching again with softer friction")
    if units := list(unit_notices(found)):
        arm = replace(arm, gain=np.zeros(0))
        found = sought("searching again with masses of each joint")
    early, late, unsure = logs, 0.0, 0.0
    for one, (value, sigma) in zip(found.choice.found, found.choice.estimates, strict=True):
        if one.candidate.family == "delay" and abs(value[0]) > LATE:
            late, unsure = float(value[0]), float(sigma[0])
    if late:
        logs = logs.earlier(late)
        found = sought("searching again without the delay")
    progress("judging causes on trajectories left out")
    found = helpful(found)
    columns = found.columns
    if len(learning) < len(logs.names):
        columns = Columns(found.context.in_scene(Scene.of(arm, logs)))
    normal = fitted(found, columns)
    fold, whole = by_loads(fold, logs, found.terms), fold
    before = columns.error + (early.y - logs.y).T
    judge = LeftOut.of(normal, before, fold)
    group = found.choice.library.rows.group
    again = repeated(found.choice, halves(group, HALVINGS), level=LEVEL)
    given, change = body_as_given(normal)
    left = tuple(unexplained(normal, judge.value))
    if any(one.share > MATTERS for one in left):
        change = None  # what has no name could be what makes the masses look wrong
    effects = [*laws_found(found, judge, again), *usual_found(judge)]
    if late:
        effects = with_delay(effects, judge, late, unsure)
    if change is not None:
        effects.insert(0, changed_link(change))
    effects.sort(key=lambda one: (one.minor, -gain_of(one)))
    models, budget = steps(found.context, judge, late, before)
    return MotionDiagnosis(
        arm=arm,
        unit=logs.unit,
        verdict=verdict_of(effects, left, too_little),
        effects=tuple(effects),
        budget=budget,
        unexplained=left,
        not_testable=tuple(not_testable(found, arm)),
        too_little=too_little,
        models=models,
        runs=logs.names,
        held_out=held_words(logs, fold, whole),
        held_run=held_run(judge, logs),
        curves=tuple(curves(judge)),
        notices=(*units, *body_notices(arm, given, change, logs)),
        seconds=0.0,
    )


def held_words(logs: Logs, fold: Array, whole: Array) -> str:
    """How rows were held out.  fold: (R,); whole: before runs were left out by quarters."""
    if (fold < 0).any():
        names = dict.fromkeys(logs.names[r] for r in logs.run[fold >= 0])
        return f"runs kept out: {', '.join(names)}"
    if len(logs.names) == 1:
        return "one run: its quarters left out in turn"
    alone = [name for r, name in enumerate(logs.names) if np.any((fold != whole)[logs.run == r])]
    quarters = f", the only ones with their load by quarters: {', '.join(alone)}" if alone else ""
    return f"runs left out in turn{quarters}"


def is_minor(worth: dict[str, tuple[float, float]], before: Array) -> bool:
    """Whether an effect closes little of what the step before its kind leaves (n,)."""
    shares = ((a**2 - b**2) / max(before[int(key[1:]) - 1] ** 2, 1e-300)
              for key, (a, b) in worth.items())  # fmt: skip
    return bool(max(shares) < MINOR)


def laws_found(found: Found, judge: LeftOut, again: Repeats) -> Iterator[MotionEffect]:
    """The laws that were found, with what each is worth."""
    for number, term in enumerate(found.terms):
        worth = judge.worth(judge.missed([p for p in judge.every if p != term.text]))
        place, often = judge.normal.place[term.text], again.frequency([term.key])
        yield MotionEffect(
            term.effect,
            term.place,
            parameters_of(term, judge.value[place], judge.sigma[place], found.columns.scene),
            worth,
            others_of(found.choice, number),
            often,
            often >= FOUND_AGAIN,
            is_minor(worth, judge.usual),
            term.law.family,
        )


def parameters_of(term: Term, value: Array, sigma: Array, scene: Scene) -> tuple[Amount, ...]:
    """The numbers of a law in the unit of the log, and those that were tuned."""
    tuned = [Amount(name, v, term.law.tuned[name].unit if name in term.law.tuned else "1")
             for name, v in term.tuned.items()]  # fmt: skip
    return (*amounts_of(term.law, value, sigma, scene.logs.unit), *tuned)


def amounts_of(law: Law, value: Array, sigma: Array, of_log: str) -> Iterator[Amount]:
    """The parameters of a law.  of_log: the unit of the log."""
    said = {"t": of_log, "": "1"}
    for name, unit, v, s in zip(law.names, law.units, value, sigma, strict=False):
        yield Amount(name, float(v), said.get(unit, unit.replace("t", of_log, 1)), float(s))


def others_of(choice: Choice, number: int) -> tuple[Alternative, ...]:
    """What else could be an effect that was found."""
    found = alternatives(*choice.beside_others(number))
    terms = ((other.candidate.term, rho2) for other, rho2, _ in found)
    return tuple(Alternative(t.effect, t.place, rho2, t.law.separate) for t, rho2 in terms)


def usual_found(judge: LeftOut) -> Iterator[MotionEffect]:
    """Coulomb and viscous friction of each joint, where the rows show them."""
    value, sigma, logs = judge.value, judge.sigma, judge.logs
    before = judge.rms(judge.missed([RIGID]), logs.moving)
    start = judge.normal.place[FRICTION].start
    for number in range(2 * logs.joints):
        at, joint, kind = start + number, number // 2, USUAL[number % 2]
        z = value[at] / sigma[at] if sigma[at] > 0.0 else 0.0
        if float(ndtr(-z)) * 2 * logs.joints > LEVEL:
            continue
        worth = judge.worth(judge.missed(judge.every, without=(at,)))
        unit = logs.unit if kind == "coulomb" else f"{logs.unit} s/rad"
        parameter = Amount("friction", float(value[at]), unit, float(sigma[at]))
        yield MotionEffect(kind, f"J{joint + 1}", (parameter,), worth,
                           minor=is_minor(worth, before), family=CURVE)  # fmt: skip


def with_delay(
    effects: list[MotionEffect], judge: LeftOut, late: float, unsure: float
) -> list[MotionEffect]:
    """The effects with a delay by which the rows were shifted, and its standard deviation [s]."""
    worth = judge.worth(judge.missed(judge.every, delayed=False))
    more = next((e for e in effects if e.effect == "delay"), None)
    sigma = more.parameters[0].sigma if more else unsure
    whole = late + (more.parameters[0].value if more else 0.0)
    shifted = MotionEffect("delay", "all", (Amount("time", whole, "s", sigma),), worth,
                           minor=is_minor(worth, judge.usual))  # fmt: skip
    return [shifted, *(e for e in effects if e.effect != "delay")]


def changed_link(change: LinkChange) -> MotionEffect:
    """The link whose parameters are not as given."""
    count = len(change.before)
    effect = "payload" if change.link == count - 1 else "link_inertia"
    law = LAWS["payload"]
    parameters = tuple(amounts_of(law, change.value, change.sigma, ""))
    worth = worth_by_joint(change.before, change.after)
    others = tuple(Alternative("payload" if k == count - 1 else "link_inertia", f"L{k + 1}", 1.0,
                               law.separate) for k in change.others)  # fmt: skip
    return MotionEffect(effect, f"L{change.link + 1}", parameters, worth, others,
                        minor=is_minor(worth, change.before))  # fmt: skip


def gain_of(one: MotionEffect) -> float:
    """By how much an effect lowers the relative squares of the joint at which it closes most."""
    _, (before, after) = one.best
    return (before**2 - after**2) / max(before**2, 1e-300)


def steps(
    context: Body, judge: LeftOut, late: float, before: Array
) -> tuple[tuple[TorqueModel, ...], tuple[MotionStep, ...]]:
    """The models of all steps, and the budget."""
    normal, moving = judge.normal, judge.logs.moving
    later: list[tuple[str, Sequence[Term]]] = [("+ delay", ())] if late else []
    later += [(f"+ {effect}", terms) for effect, terms in steps_of(normal.terms)]
    missed = [
        (GIVEN, drawn_missed(normal.columns, before)),
        (REFITTED, judge.missed([RIGID], delayed=not late)),
        (USUALLY, judge.missed(parts_of(()), delayed=not late)),
        *((name, judge.missed(parts_of(terms))) for name, terms in later),
    ]
    budget = (MotionStep(name, tuple(judge.rms(each).tolist()),
                         tuple(judge.rms(each, moving).tolist()))
              for name, each in missed)  # fmt: skip
    models = (normal.model(name, terms, context, late) for name, terms in later)
    first = normal.rigid_model(REFITTED, context), normal.model(USUALLY, (), context, 0.0)
    return (*first, *models), tuple(budget)


def verdict_of(
    effects: Sequence[MotionEffect], left: Sequence[Unexplained], too_little: Sequence[str]
) -> Verdict:
    """What may be said of the cause."""
    main = [e for e in effects if e.established and not e.minor]
    if too_little or any(one.share > MATTERS for one in left):
        return "unknown"
    if not main:
        return "unknown" if left else "none"
    beyond_usual = [e for e in main if e.effect not in USUAL]
    first = max(beyond_usual or main, key=gain_of)
    same = [e for e in beyond_usual if is_form_of(e, first.effect, first.place)]
    forms_of_angle = len(same) > 1 and family(first.effect) == ANGLE
    others = [a for a in first.alternatives if not is_form_of(a, first.effect, first.place)]
    return "one_of" if others or forms_of_angle else "named"


def is_form_of(one: MotionEffect | Alternative, effect: str, place: str) -> bool:
    """Whether an effect is another form of one at its place: of one curve over speed or angle."""
    return (family(one.effect), one.place) == (family(effect), place)


def family(effect: str) -> str:
    """The family of an effect: forms of one friction curve are one."""
    if effect in USUAL:
        return CURVE
    return LAWS[effect].family or effect if effect in LAWS else effect


def not_testable(found: Found, arm: Arm) -> Iterator[NotTestable]:
    """What the logs cannot show, each effect and need once."""
    needs: dict[tuple[str, str], list[str]] = {}
    for effect, place, what in found.lacking:
        needs.setdefault((effect, what), []).append(place)
    for (effect, what), places in needs.items():
        joints = {f"J{j + 1}" for j in range(arm.robot.joints)}
        place = "all" if joints <= set(places) else ", ".join(places)
        yield NotTestable(effect, place, what)
    if not arm.known.any():
        yield NotTestable("drive_gain", "all", "a known payload: without one a common error of all "
                          "drive gains and masses are the same")  # fmt: skip


def body_notices(arm: Arm, given: bool, change: LinkChange | None, logs: Logs) -> Iterator[str]:
    """What is to be known of masses and gains."""
    if logs.unit == CURRENT and not arm.shared:
        yield (
            "currents are judged in A: without drive gains each joint has masses of its own; give "
            "drive_gain= to test joint flexibility, drive gains and the masses of the model"
        )
    elif not arm.drawn.any():
        yield "the model gives no masses: the rigid body is the one that the torques show"
    elif not given and change is None:
        yield "the masses of the model are not this arm's: the rigid body was refitted"


def held_run(judge: LeftOut, logs: Logs) -> HeldRun:
    """A stretch of a run as a fit without it predicts it."""
    run = int(logs.run[np.argmax(judge.judged)])
    rows = np.flatnonzero((logs.run == run) & judge.judged)[:SHOWN_ROWS]
    measured = judge.normal.columns.error[:, rows]
    predicted = measured - judge.whole[rows].T

    def brief(values: Array) -> Array:
        return np.array([[float(f"{value:.5g}") for value in row] for row in values])

    time_s = tuple(np.round((rows - rows[0]) / ROW_HZ, 4).tolist())
    return HeldRun(logs.names[run], time_s, brief(measured), brief(predicted))


def curves(judge: LeftOut) -> Iterator[FrictionCurve]:
    """Friction over the speed of each joint, and its spread over fits without each fold."""
    normal, arm = judge.normal, judge.normal.columns.scene.arm
    values = np.array([judge.value, *judge.values(normal.index(judge.every))])
    for j in range(arm.robot.joints):
        v = np.linspace(-1.0, 1.0, CURVE_POINTS) * arm.fastest[j]
        sense = sense_of(v, arm.soft[j])
        at = normal.place[FRICTION].start + 2 * j
        drawn = np.outer(values[:, at], sense) + np.outer(values[:, at + 1], v)
        for term in (t for t in normal.terms if t.place == f"J{j + 1}"):
            amounts = values[:, normal.place[term.text]].T
            for amount, form in zip(
                amounts, term.law.curve(v / arm.fastest[j], sense, term.tuned), strict=False
            ):
                drawn += np.outer(amount, form)
        folds = drawn[1:]
        wide = np.sqrt((len(folds) - 1) * folds.var(axis=0))  # jackknife
        yield FrictionCurve(f"J{j + 1}", v, drawn[0], wide)
