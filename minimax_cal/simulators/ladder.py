"""The gap between a simulator's model and a real arm, measured in the simulator itself."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from minimax_cal.diagnosing.diagnose import diagnose
from minimax_cal.diagnosing.result import Diagnosis, load_diagnosis
from minimax_cal.fitting.accuracy import accuracy
from minimax_cal.fitting.calibrate import again, calibrate
from minimax_cal.fitting.fit import Fit, Provenance
from minimax_cal.fitting.floor import Floor
from minimax_cal.fitting.options import Progress, silent
from minimax_cal.fitting.same_arm import check_arm
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import check_writable, plain, write_whole
from minimax_cal.measuring.checks import check_joints
from minimax_cal.measuring.grouping import check_chance, held_out
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.compliance import WHOLE
from minimax_cal.modelling.effects.scene import unmasked
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.modelling.effects.words import name_effect, name_step
from minimax_cal.robots.document import Document
from minimax_cal.robots.mjcf import Given, mujoco, read_model
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import inverse
from minimax_cal.robots.urdf import MODELS
from minimax_cal.simulators.arm import ELEMENTS, Arm, arm_of, assumed, unheld, why_not
from minimax_cal.simulators.chain import Chain, chain_of
from minimax_cal.simulators.drive import Commands, Driven, drive, placed_error, resting, touching
from minimax_cal.simulators.mjcf import (
    beside,
    check_limits,
    corrected,
    own_masses,
    told,
    write_document,
)
from minimax_cal.simulators.result import Rung, SimulatorGap
from minimax_cal.solvers.status import Status


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
    fit = Fit.load(fit) if isinstance(fit, Path | str) else fit
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
    mass, com = own_masses(chain, nominal) or (nominal.mass, nominal.com)
    settings = {**vars(fit.options), "effects": tuple(effects)}
    rows = marked(fit.data, fit.held)
    found: Fit = calibrate(replace(nominal, mass=mass, com=com), rows, **settings)
    return found


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


# ---- the ladder ----------------------------------------------------------------------------------


AGREES, AGREES_MM = 0.1, 0.002  # of an error by a fit's formulas, and the simulator's [-, mm]
WORSE = 0.01  # relative rise of an error that is one
AT_LIMIT = 0.01  # an arm that follows is at a force limit in no larger share of the timesteps
COMMANDED = ".commands.xml"  # ending of a model that a command map belongs to
FIRST_MOVES = 4  # that show whether a model is stable
TRAINING, FEWEST = 100, 4  # poses that place base and targets, at most and at least


def simulator_gap(
    model: Path | str,
    data: Measurements | str | Path,
    *,
    fit: Fit | Path | str | None = None,
    diagnosis: Diagnosis | Path | str | None = None,
    write: Path | str | None = None,
    tip: str = "",
    holdout: float = 0.2,
    seed: int = 0,
    progress: Progress = silent,
) -> SimulatorGap:
    """Say how far a simulated arm is from the real one, and why, in the simulator itself.

    Parameters
    ----------
    model
        An MJCF, or a URDF that MuJoCo loads.
    data
        Measurements, or their file.
    fit, diagnosis
        Of the same arm; a diagnosis is made where neither is given.
    write
        Where the corrected model goes.
    tip
        Last body of the arm, where the model has several.
    holdout, seed
        Of the poses kept out, for a new diagnosis.
    progress
        Called with a word on each stage.

    Returns
    -------
    SimulatorGap
        Lengths of the result are in mm, angles in mrad.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.simulator_gap("arm.xml", "poses.csv", write="corrected.xml").summary())
    """
    began = time.perf_counter()
    check_chance(holdout, seed)
    if write is not None:
        check_writable(write, MODELS)
    mujoco()
    progress("reading the model")
    rows = read_measurements(data)
    given = read_model(model)
    chain = chain_of(given.compiled(), rows.q.shape[1], given.source, tip, unknown=given.assumed)
    check_joints(chain.robot, rows)
    check_model(chain, rows.q, given.source)
    causes = causes_of(chain, rows, fit, diagnosis, (holdout, seed), progress)
    if not causes.held.any():
        raise OptionError(f"{causes.data.source}: no pose is held out; give holdout=0.2")
    run = Run(given, chain, causes, progress)
    rungs, (more, best) = run.before(), run.corrected()
    path = None if write is None or best.status is Status.FAILED else Path(write)
    last, commands = run.last(more[-1], best, path)
    rungs += [*more[:-1], last]
    every = [*rungs, commands] if commands else rungs
    notices = (*rows.notices, *run.notices, *disagreement(every))
    return SimulatorGap(
        model=str(model),
        robot=chain.robot.name,
        rungs=tuple(rungs),
        commands=commands,
        floor=causes.floor.value if causes.floor else np.nan,
        floor_from=causes.floor.source if causes.floor else "",
        train_poses=int((~causes.held).sum()),
        holdout_poses=int(run.held.sum()),
        status=best.status,
        beyond=plain(best.beyond),
        left_out=tuple(run.left_out),
        notices=tuple(dict.fromkeys(notices)),
        written="" if path is None else str(path),
        seconds=time.perf_counter() - began,
        provenance=Provenance.of(chain.robot, rows, {"model": str(model), "holdout": holdout,
                                                     "seed": seed}),
    )  # fmt: skip


def check_model(chain: Chain, q: Array, source: str) -> None:
    """Raise RobotError for a model that cannot hold its own weight, or is unstable.

    Before anything that takes long: some moves show it.
    """
    if (chain.servos < 0).any():
        return
    check_limits(chain, q, source)
    drive(chain, q[:FIRST_MOVES], source)


class Run:
    """One ladder in the making: model, poses and fits, and its notices.

    mapped: effects for a command map.  left_out: what is in neither, and why.
    """

    def __init__(self, given: Given, chain: Chain, causes: Causes, progress: Progress) -> None:
        self.given, self.chain, self.causes, self.progress = given, chain, causes, progress
        touched = touching(chain, given.compiled(), causes.data.q)
        judge = judging(causes.held, touched)
        train = np.flatnonzero(judge & ~causes.held)
        some = train[np.linspace(0, len(train) - 1, min(len(train), TRAINING)).astype(int)]
        self.rows = np.sort(np.concatenate([some, np.flatnonzero(judge & causes.held)]))
        self.data = causes.data.take(self.rows)
        self.held = causes.held[self.rows]
        self.nominal = causes.geometry.nominal
        self.notices: list[str] = []
        self.mapped, self.left_out = list(causes.turning), list(causes.left_out)
        self.tell(f"{given.source}: the arm touches something", causes.data, touched, judge)

    def before(self) -> list[Rung]:
        """The model as given, and without the sag of its servos."""
        first = self.rung("as given", self.chain, self.nominal)
        if (self.chain.servos < 0).any():
            self.notices.append(
                f"{self.given.source}: not every joint has a position servo: joints are set, not "
                "driven, in the model as given"
            )
            return [replace(first, why="joints set, not driven")]
        document, notices = corrected(self.given, self.chain, self.nominal.robot, None)
        self.notices += notices
        stiff = self.rung("servo sag removed", self.of(document), self.nominal)
        return [
            replace(first, why=f"servos sag by up to {first.sag_mrad:.3g} mrad"),
            replace(stiff, why="gains that hold the arm where it is commanded"),
        ]

    def corrected(self) -> tuple[list[Rung], Fit]:
        """A rung for geometry, and each effect that the simulator holds and gains by; their fit.

        Each is fitted with those before it and with nothing else: the values of a fit hold
        together, and an element with those of a fit that had more does not do what that fit says.
        """
        fit, taken = self.causes.geometry, list[Term]()
        rungs = [self.fitted("calibrated geometry", fit)]
        for term in self.causes.firm:
            self.progress(f"fit with {name_effect(*term.key)}")
            more = self.causes.fitted([*taken, term])
            if unheld(more.cell, more.train):
                self.mapped.append(term)
                continue
            rung = self.fitted(term.step, more)
            if worse(rung, rungs[-1]):
                change = f"{rungs[-1].holdout_rms_mm:.4f} -> {rung.holdout_rms_mm:.4f} mm"
                self.left_out.append(
                    f"{name_effect(*term.key)}: the simulated arm is worse with it ({change})"
                )
                continue
            fit, taken = more, [*taken, term]
            rungs.append(rung)
        return rungs, fit

    def last(self, before: Rung, fit: Fit, path: Path | None) -> tuple[Rung, Rung | None]:
        """The last rung from its file, with targets, and what a command map does."""
        arm, commands = self.arm(fit), None
        document, notices = self.with_arm(arm, fit)
        rung = self.rung(before.name, self.saved(document, path), fit.cell, arm, fit)
        if self.mapped:
            fit = self.causes.fitted([*fit.cell.effects.terms, *self.mapped])
            arm = self.arm(fit)
        if arm.mapped.terms:
            commands = self.with_commands(arm, fit, path)
        self.left_out += arm.left_out
        whole = replace(arm, remainder=0.0, left_out=tuple(self.left_out))
        self.notices += (*notices, *told(whole))
        return replace(rung, why=before.why), commands

    def saved(self, document: Document, path: Path | None) -> Chain:
        """The arm in a changed tree, from the file where one is written."""
        if path is None:
            return self.of(document)
        write_document(document, self.given.folder, path)
        return self.chain.in_model(mujoco().MjModel.from_xml_path(str(path)))

    def with_commands(self, whole: Arm, fit: Fit, path: Path | None) -> Rung:
        """The arm with all effects, driven with mapped commands.

        It is another arm than that of the last rung: what commands take over changes the rest.
        """
        model = None if path is None else path.with_suffix(COMMANDED)
        chain = self.saved(self.with_arm(whole, fit)[0], model)
        if path is not None and model is not None:
            for ending, content in beside(fit.cell, whole).items():
                write_whole(path.with_suffix(ending), content)
            self.notices.append(
                f"{model}: the model that the command map belongs to; {path} is the best without"
            )
        commands = Commands(replace(fit.cell, effects=whole.mapped)).follow(self.data)
        rung = self.rung("with its command map", chain, fit.cell, whole, fit, commands)
        return replace(rung, why="commands corrected for " + ", ".join(
            dict.fromkeys(name_effect(*term.key) for term in whole.mapped.terms)))  # fmt: skip

    def arm(self, fit: Fit) -> Arm:
        """The elements of a fit, with the model's own masses unless those are assumed."""
        own = own_masses(self.chain, self.nominal.robot)
        some = fit.train.take(np.arange(0, fit.train.poses, max(1, fit.train.poses // TRAINING)))
        return arm_of(fit.cell, masses=own, measured=some)

    def fitted(self, name: str, fit: Fit) -> Rung:
        """The simulator with the arm of a fit."""
        arm = self.arm(fit)
        return self.rung(name, self.of(self.with_arm(arm, fit)[0]), fit.cell, arm, fit)

    def with_arm(self, arm: Arm, fit: Fit) -> tuple[Document, tuple[str, ...]]:
        """The model with an arm and its targets in it, and notices."""
        names = fit.cell.target_names
        return corrected(self.given, self.chain, self.nominal.robot, arm, names)

    def of(self, document: Document) -> Chain:
        """The arm in a changed tree."""
        return self.chain.in_model(self.given.compiled(document.root))

    def rung(
        self,
        name: str,
        chain: Chain,
        start: Cell,
        arm: Arm | None = None,
        fit: Fit | None = None,
        commands: Array | None = None,
    ) -> Rung:
        """Drive a model to every pose and judge where it comes to rest."""
        q = self.data.q
        asked = q if commands is None else commands
        play = None if arm is None else resting(arm, self.data)
        count = len(q)

        def heard(done: int) -> None:
            if done % 20 == 0 or done == count:
                self.progress(f"{name}: {done} of {count} poses")

        driven = drive(chain, asked, self.given.source, play, heard)
        judge = judging(self.held, driven.moving)
        self.tell(f"{name}: the simulated arm did not come to rest within 1.5 s of its move",
                  self.data, driven.moving, judge)  # fmt: skip
        self.tell_limits(name, driven)
        error = placed_error(
            driven.poses, self.data, judge & ~self.held, guess(start, driven.poses[0], q[0])
        )
        held, train = (accuracy(error[judge & rows]) for rows in (self.held, ~self.held))
        off = np.abs(driven.q - asked)[judge][:, ~chain.robot.prismatic]
        return Rung(
            name, held.rms_mm, held.max_mm, train.rms_mm, train.max_mm,
            1e3 * off.max(initial=0.0), self.predicted(fit, judge & self.held),
            moving_poses=int(driven.moving.sum()), at_limit=driven.limited.max(),
        )  # fmt: skip

    def predicted(self, fit: Fit | None, rows: Array) -> float:
        """RMS of some driven poses by the formulas of a fit, NaN where it has others."""
        if fit is None or not self.causes.same:
            return np.nan
        return accuracy(fit.cell.error(self.data)[rows]).rms_mm

    def tell(self, what: str, data: Measurements, rows: Array, judge: Array) -> None:
        """A notice on poses that do not judge.  rows: (m,) where; judge: (m,) those that do."""
        if rows.any():
            how = "they count, too few would be left" if judge.all() else "they are left out"
            self.notices.append(f"{what} at {rows.sum()} poses ({data.list_rows(rows)}): {how}")

    def tell_limits(self, name: str, driven: Driven) -> None:
        """Notices on joints that were at their force limits."""
        for i in np.flatnonzero(driven.limited > AT_LIMIT):
            self.notices.append(
                f"{name}: joint {i + 1} is at its force limit in {driven.limited[i]:.0%} of the "
                "timesteps: raise the limit, or drive more slowly"
            )


def disagreement(rungs: Sequence[Rung]) -> list[str]:
    """A notice on each rung at which the simulator does other than the formulas of its fit."""
    return [
        f"{name_step(rung.name)}: the simulated arm misses by {rung.holdout_rms_mm:.4f} mm "
        f"where the fit says {rung.predicted_rms_mm:.4f} mm"
        for rung in rungs
        if abs(rung.holdout_rms_mm - rung.predicted_rms_mm)
        > max(AGREES * rung.predicted_rms_mm, AGREES_MM)
    ]


def judging(held: Array, out: Array) -> Array:
    """(m,) True at poses that judge: all but those that are out, unless too few would be left."""
    left = ~out
    enough = (left & held).any() and (left & ~held).sum() >= FEWEST
    return left if enough else np.ones_like(left)


def worse(rung: Rung, before: Rung) -> bool:
    """Whether the simulator misses by more than before, on the training poses or the others."""
    return (
        rung.train_rms_mm > (1.0 + WORSE) * before.train_rms_mm
        or rung.holdout_rms_mm > (1.0 + WORSE) * before.holdout_rms_mm
    )


def guess(cell: Cell, pose: Array, q: Array) -> tuple[Array, Array]:
    """Base and targets to begin with, from those of a cell.  pose: of the carrier at q, near it."""
    end = inverse(pose) @ cell.robot.pose(q)
    return cell.base, cell.target_positions @ end[:3, :3].T + end[:3, 3]
