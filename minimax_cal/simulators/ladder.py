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
from minimax_cal.simulators.chain import Chain
from minimax_cal.simulators.corrected_model import CorrectedModel, correct_model
from minimax_cal.simulators.drive import Commands, drive, placed_error, touching
from minimax_cal.simulators.mjcf import write_document
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


def find_causes(
    chain: Chain,
    data: Measurements,
    fit: Fit | Path | str | None,
    diagnosis: Diagnosis | Path | str | None,
    holdout: float,
    seed: int,
    progress: Progress,
) -> Causes:
    """Fits and effects of a ladder, from a fit, a diagnosis, or both; else from a new diagnosis.

    chain: the arm in the model.  holdout, seed: of the poses kept out, for a new diagnosis.
    Raises DataError for poses that cannot be of the arm of the fit.
    """
    robot = chain.robot
    fit = Fit.load(fit) if isinstance(fit, Path | str) else fit
    found = load_diagnosis(diagnosis) if isinstance(diagnosis, Path | str) else diagnosis
    if fit is None and found is None:
        found = diagnose(robot, data, holdout=holdout, seed=seed, progress=progress)

    # Effects: those that the diagnosis is sure of, in the order of its ladder, or those of the fit.
    terms = fit.cell.effects.terms if fit else ()
    if found is not None:
        sure = {term.text for finding in found.effects if finding.established
                for term in finding.terms if term.effect in EFFECTS}  # fmt: skip
        steps = found.cells[-1].effects.terms if found.cells else ()
        terms = tuple(term for term in steps if term.text in sure)

    # A fit of the poses of the diagnosis; a fit without masses is made again with those of the
    # model: then its springs are the model's.
    if fit is None:
        assert found is not None
        terms = carried_over(terms, robot)
        rows = replace(found.data, digest=found.provenance.data_sha256)
        new: Fit = calibrate(robot, with_split(rows, found.held), objective="sum")
        fit = new
    elif not chain.has_assumed_masses and assumed(fit.nominal.robot):
        progress("fit with the masses of the model")
        nominal = fit.nominal.robot
        mass, com = chain.find_masses(nominal) or (nominal.mass, nominal.com)
        terms = carried_over(terms, robot)
        effects = {"effects": tuple(term if term.choice else term.label for term in terms)}
        new = calibrate(replace(nominal, mass=mass, com=com), with_split(fit.data, fit.held),
                        **vars(fit.options) | effects)  # fmt: skip
        fit, terms = new, new.cell.effects.terms
    geometry = fit if not fit.cell.effects.terms else again(fit, effects=())

    # What a simulator may have an element for, what a command map may hold, and what neither does.
    history, left_out = with_history(fit.data), list[str]()
    firm, turning = list[Term](), list[Term]()
    for term in terms:
        if term.effect in ELEMENTS:
            firm.append(term)
        elif term.columns(fit.cell.scene(history)).only_turns:
            turning.append(term)
        else:
            left_out.append(f"{name_effect(*term.key)}: {why_not(EFFECTS[term.effect])}")

    # The poses that judge: those of the fit with what it held out, or others with some held out.
    is_same = bool(fit.data.poses) and fit.provenance.data_sha256 == data.digest
    held = fit.held
    if not is_same:
        data = check_joints(fit.cell.robot, data)
        check_arm(fit.cell.robot, data)
        history = with_history(data)
        held = held_out(history, holdout, seed)[0]
    return Causes(fit, geometry, tuple(firm), tuple(turning), tuple(left_out), history, held,
                  found.floor if found else None, is_same)  # fmt: skip


def with_split(data: Measurements, held: Array) -> Measurements:
    """The measurements with a split column.  held: (m,) True where held out."""
    return replace(data, columns={**data.columns, "split": np.where(held, "holdout", "train")})


def carried_over(terms: Sequence[Term], robot: Robot) -> tuple[Term, ...]:
    """Terms for a robot whose masses may be known: then each joint has one torque.

    A law that was chosen for masses that nobody told is chosen again.  Those of all joints come
    first: what one of them has besides is chosen beside it.
    """
    is_guess = [
        bool({"assumed", "tool"} & term.choice.keys())
        or any(part % 4 != WHOLE for part in unmasked(term.choice.get("parts", 0.0)))
        for term in terms
    ]
    if assumed(robot) or not any(is_guess):
        return tuple(terms)
    new = [replace(term, choice={}) if guess else term
           for term, guess in zip(terms, is_guess, strict=True)]  # fmt: skip
    return tuple(sorted(new, key=lambda term: term.place != "all"))


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
    chain = Chain.find(given, rows.q.shape[1], tip)
    check_joints(chain.robot, rows)
    if (chain.servos >= 0).all():  # before anything that takes long
        chain.check_force_limits(rows.q, given.source)
        drive(chain, rows.q[:FIRST_MOVES], given.source)  # some moves show whether it is stable
    causes = find_causes(chain, rows, fit, diagnosis, holdout, seed, progress)
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
        first = self.rung("as given", self.chain)
        if (self.chain.servos < 0).any():
            self.notices.append(
                f"{self.given.source}: not every joint has a position servo: joints are set, not "
                "driven, in the model as given"
            )
            return [replace(first, why="joints set, not driven")]
        made = self.correct(None, self.nominal)
        self.notices += made.notices
        stiff = self.rung("servo sag removed", self.compile(made.document))
        return [
            replace(first, why=f"servos sag by up to {first.sag_mrad:.3g} mrad"),
            replace(stiff, why="gains that hold the arm where it is commanded"),
        ]

    def corrected(self) -> tuple[list[Rung], Fit]:
        """A rung for geometry, and each effect that the simulator holds and gains by; their fit.

        Each is fitted with those before it and with nothing else: the values of a fit hold
        together, and an element with those of a fit that had more does not do what that fit says.
        """
        fit, taken, limit = self.causes.geometry, list[Term](), 1.0 + WORSE
        rungs = [self.fitted("calibrated geometry", fit)]
        for term in self.causes.firm:
            label = name_effect(*term.key)
            self.progress(f"fit with {label}")
            more = self.causes.fitted([*taken, term])
            if unheld(more.cell, more.train):
                self.mapped.append(term)
                continue
            before, rung = rungs[-1], self.fitted(term.step, more)
            if (
                rung.train_rms_mm > limit * before.train_rms_mm
                or rung.holdout_rms_mm > limit * before.holdout_rms_mm
            ):
                change = f"{before.holdout_rms_mm:.4f} -> {rung.holdout_rms_mm:.4f} mm"
                self.left_out.append(f"{label}: the simulated arm is worse with it ({change})")
                continue
            fit, taken = more, [*taken, term]
            rungs.append(rung)
        return rungs, fit

    def last(self, before: Rung, fit: Fit, path: Path | None) -> tuple[Rung, Rung | None]:
        """The last rung from its file, with targets, and what a command map does.

        The arm with a command map is another one, in a file of its own: what commands take over
        changes the rest.
        """
        arm, with_map = self.arm(fit), None
        made = self.correct(arm, fit.cell)
        rung = self.rung(before.name, self.compile(made.document, path), arm, fit)
        if self.mapped:
            fit = self.causes.fitted([*fit.cell.effects.terms, *self.mapped])
            arm = self.arm(fit)
        if arm.mapped.terms:
            model = None if path is None else path.with_suffix(COMMANDED)
            chain = self.compile(self.correct(arm, fit.cell).document, model)
            if path is not None:
                for ending, content in arm.format_command_map(fit.cell).items():
                    write_whole(path.with_suffix(ending), content)
                self.notices.append(f"{model}: the model that the command map belongs to; {path} "
                                    "is the best without")  # fmt: skip
            commands = Commands(replace(fit.cell, effects=arm.mapped)).follow(self.data)
            with_map = self.rung("with its command map", chain, arm, fit, commands)
            labels = dict.fromkeys(name_effect(*term.key) for term in arm.mapped.terms)
            with_map = replace(with_map, why="commands corrected for " + ", ".join(labels))
        self.left_out += arm.left_out
        whole = replace(arm, remainder=0.0, left_out=tuple(self.left_out))
        self.notices += (*made.notices, *whole.list_limitations())
        return replace(rung, why=before.why), with_map

    def compile(self, document: Document, path: Path | None = None) -> Chain:
        """The arm in a changed document, from the file where one is written."""
        if path is None:
            return self.chain.in_model(self.given.compiled(document.root))
        write_document(document, self.given.folder, path)
        return self.chain.in_model(mujoco().MjModel.from_xml_path(str(path)))

    def arm(self, fit: Fit) -> Arm:
        """The elements of a fit, with the model's own masses unless those are assumed."""
        own = self.chain.find_masses(self.nominal.robot)
        train, count = fit.train, fit.train.poses
        some = train.take(np.arange(0, count, max(1, count // TRAINING)))
        return arm_of(fit.cell, masses=own, measured=some)

    def fitted(self, name: str, fit: Fit) -> Rung:
        """The simulator with the arm of a fit."""
        arm = self.arm(fit)
        return self.rung(name, self.compile(self.correct(arm, fit.cell).document), arm, fit)

    def correct(self, arm: Arm | None, cell: Cell) -> CorrectedModel:
        """The model with an arm and the targets of a cell in it; without an arm, without sag."""
        names = cell.target_names if arm else ()
        return correct_model(self.given, self.chain, self.nominal.robot, arm, names)

    def rung(
        self,
        name: str,
        chain: Chain,
        arm: Arm | None = None,
        fit: Fit | None = None,
        commands: Array | None = None,
    ) -> Rung:
        """Drive a model to every pose and judge where it comes to rest.

        arm, fit: that the model is to do, if any.
        commands: (m, n) where they are other than the joint values of the poses.
        """
        q = self.data.q
        commands = q if commands is None else commands
        play = None if arm is None else arm.rest_in_play(self.data)
        count = len(q)

        def report(done: int) -> None:
            if done % 20 == 0 or done == count:
                self.progress(f"{name}: {done} of {count} poses")

        driven = drive(chain, commands, self.given.source, play, report)
        judge = judging(self.held, driven.moving)
        self.tell(f"{name}: the simulated arm did not come to rest within 1.5 s of its move",
                  self.data, driven.moving, judge)  # fmt: skip
        for i in np.flatnonzero(driven.limited > AT_LIMIT):
            self.notices.append(
                f"{name}: joint {i + 1} is at its force limit in {driven.limited[i]:.0%} of the "
                "timesteps: raise the limit, or drive more slowly"
            )

        # Base and targets from the training poses, begun where the cell has them.
        start = fit.cell if fit else self.nominal
        end = inverse(driven.poses[0]) @ start.robot.pose(q[0])
        spots = start.target_positions @ end[:3, :3].T + end[:3, 3]
        error = placed_error(driven.poses, self.data, judge & ~self.held, (start.base, spots))
        held, train = (accuracy(error[judge & rows]) for rows in (self.held, ~self.held))
        off = np.abs(driven.q - commands)[judge][:, ~chain.robot.prismatic]
        predicted = np.nan
        if fit is not None and self.causes.same:
            predicted = accuracy(fit.cell.error(self.data)[judge & self.held]).rms_mm
        return Rung(
            name, held.rms_mm, held.max_mm, train.rms_mm, train.max_mm,
            1e3 * off.max(initial=0.0), predicted,
            moving_poses=int(driven.moving.sum()), at_limit=driven.limited.max()
        )  # fmt: skip

    def tell(self, what: str, data: Measurements, rows: Array, judge: Array) -> None:
        """A notice on poses that do not judge.  rows: (m,) where; judge: (m,) those that do."""
        if rows.any():
            how = "they count, too few would be left" if judge.all() else "they are left out"
            self.notices.append(f"{what} at {rows.sum()} poses ({data.list_rows(rows)}): {how}")


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
