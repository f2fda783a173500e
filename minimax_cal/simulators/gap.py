"""The gap between a simulator's model and a real arm, measured in the simulator itself."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import check_output_path, convert_to_plain_json, write_file_atomically
from minimax_cal.diagnosing.diagnose import diagnose
from minimax_cal.diagnosing.diagnosis import Diagnosis, load_diagnosis
from minimax_cal.fitting.accuracy import summarise_point_errors
from minimax_cal.fitting.arm_identity import check_same_arm
from minimax_cal.fitting.calibrate import calibrate, refit_with_options
from minimax_cal.fitting.fit import Fit, Provenance
from minimax_cal.fitting.noise_floor import NoiseFloor
from minimax_cal.fitting.options import Progress, silent_progress
from minimax_cal.measuring.measurement_checks import check_and_complete_joints
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.measuring.pose_groups import check_holdout_and_seed, select_holdout_rows
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.compliance import ALL_LINKS_GROUP
from minimax_cal.modelling.effects.effect_names import format_budget_step, format_effect
from minimax_cal.modelling.effects.scene import bit_mask_to_numbers
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.robots.mjcf_import import MjcfModel, import_mujoco, read_mujoco_model
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import invert_transform
from minimax_cal.robots.urdf_robot import MJCF_SUFFIXES
from minimax_cal.robots.xml_document import XmlDocument
from minimax_cal.simulators.arm import (
    ELEMENT_WRITERS,
    SimulatedArm,
    build_simulated_arm,
    explain_missing_element,
    has_assumed_masses,
    list_effects_without_element,
)
from minimax_cal.simulators.chain import ModelArm
from minimax_cal.simulators.corrected_model import CorrectedModel, correct_model
from minimax_cal.simulators.drive import (
    Commands,
    compute_error_with_fitted_base,
    drive_to_poses,
    find_poses_in_contact,
)
from minimax_cal.simulators.mjcf import write_document
from minimax_cal.simulators.result import GapStep, SimulatorGap
from minimax_cal.solvers.status import Status


@dataclass(frozen=True, eq=False)
class GapInputs:
    """fit: the fit that others are made of.  geometry_fit: the same without effects.

    element_terms: effects of which a simulator may have an element, in order.  mapped_terms: others
    that turn joints only, for a command map.  left_out: what is neither, and why. data: the
    measurements that the simulator is judged by, with their history; is_held_out: (m,) True where
    held out.  noise_floor: what noise alone would leave, None untold.  is_data_of_fit: whether
    these are the poses of the fits.
    """

    fit: Fit
    geometry_fit: Fit
    element_terms: tuple[Term, ...]
    mapped_terms: tuple[Term, ...]
    left_out: tuple[str, ...]
    data: Measurements
    is_held_out: Array
    noise_floor: NoiseFloor | None
    is_data_of_fit: bool

    def fit_terms(self, terms: Sequence[Term]) -> Fit:
        """The same poses fitted with these effects and no others: values belong together."""
        if [t.text for t in terms] == [t.text for t in self.fit.cell.effects.terms]:
            return self.fit
        return refit_with_options(
            self.fit, effects=tuple(t if t.choice else t.label for t in terms)
        )


def build_gap_inputs(
    chain: ModelArm,
    data: Measurements,
    fit: Fit | Path | str | None,
    diagnosis: Diagnosis | Path | str | None,
    holdout: float,
    seed: int,
    progress: Progress,
) -> GapInputs:
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
        terms = carry_terms_to_known_masses(terms, robot)
        rows = replace(found.data, digest=found.provenance.data_sha256)
        new: Fit = calibrate(robot, add_split_column(rows, found.held), objective="sum")
        fit = new
    elif not chain.has_assumed_masses and has_assumed_masses(fit.nominal.robot):
        progress("fit with the masses of the model")
        nominal = fit.nominal.robot
        mass, com = chain.find_masses(nominal) or (nominal.mass, nominal.com)
        terms = carry_terms_to_known_masses(terms, robot)
        effects = {"effects": tuple(term if term.choice else term.label for term in terms)}
        new = calibrate(replace(nominal, mass=mass, com=com), add_split_column(fit.data, fit.held),
                        **vars(fit.options) | effects)  # fmt: skip
        fit, terms = new, new.cell.effects.terms
    geometry = fit if not fit.cell.effects.terms else refit_with_options(fit, effects=())

    # What a simulator may have an element for, what a command map may hold, and what neither does.
    history, left_out = add_history_columns(fit.data), list[str]()
    firm, turning = list[Term](), list[Term]()
    for term in terms:
        if term.effect in ELEMENT_WRITERS:
            firm.append(term)
        elif term.columns(fit.cell.pose_arm(history)).moves_joints_only:
            turning.append(term)
        else:
            left_out.append(
                f"{format_effect(*term.key)}: {explain_missing_element(EFFECTS[term.effect])}"
            )

    # The poses that judge: those of the fit with what it held out, or others with some held out.
    is_same = bool(fit.data.poses) and fit.provenance.data_sha256 == data.digest
    held = fit.held
    if not is_same:
        data = check_and_complete_joints(fit.cell.robot, data)
        check_same_arm(fit.cell.robot, data)
        history = add_history_columns(data)
        held = select_holdout_rows(history, holdout, seed)[0]
    return GapInputs(fit, geometry, tuple(firm), tuple(turning), tuple(left_out), history, held,
                  found.floor if found else None, is_same)  # fmt: skip


def add_split_column(data: Measurements, is_held_out: Array) -> Measurements:
    """The measurements with a split column.  is_held_out: (m,) True where held out."""
    return replace(
        data, columns={**data.columns, "split": np.where(is_held_out, "holdout", "train")}
    )


def carry_terms_to_known_masses(terms: Sequence[Term], robot: Robot) -> tuple[Term, ...]:
    """Terms for a robot whose masses may be known: then each joint has one torque.

    A law that was chosen for masses that nobody told is chosen again.  Those of all joints come
    first: what one of them has besides is chosen beside it.
    """
    is_guess = [
        bool({"assumed", "tool"} & term.choice.keys())
        or any(
            part % 4 != ALL_LINKS_GROUP
            for part in bit_mask_to_numbers(term.choice.get("parts", 0.0))
        )
        for term in terms
    ]
    if has_assumed_masses(robot) or not any(is_guess):
        return tuple(terms)
    new = [replace(term, choice={}) if guess else term
           for term, guess in zip(terms, is_guess, strict=True)]  # fmt: skip
    return tuple(sorted(new, key=lambda term: term.place != "all"))


# ---- the ladder ----------------------------------------------------------------------------------


MAX_FORMULA_DISAGREEMENT, MAX_FORMULA_DISAGREEMENT_MM = (
    0.1,
    0.002,
)  # of an error by a fit's formulas, and the simulator's [-, mm]
MAX_RELATIVE_ERROR_RISE = 0.01  # relative rise of an error that is one
MAX_SHARE_AT_FORCE_LIMIT = (
    0.01  # an arm that follows is at a force limit in no larger share of the timesteps
)
COMMANDED_MODEL_ENDING = ".commands.xml"  # ending of a model that a command map belongs to
STABILITY_CHECK_MOVES = 4  # that show whether a model is stable
MAX_TRAINING_POSES, MIN_TRAINING_POSES = (
    100,
    4,
)  # poses that place base and targets, at most and at least


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
    progress: Progress = silent_progress,
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
    check_holdout_and_seed(holdout, seed)
    if write is not None:
        check_output_path(write, MJCF_SUFFIXES)
    import_mujoco()
    progress("reading the model")
    rows = read_measurements(data)
    given = read_mujoco_model(model)
    chain = ModelArm.find_in_model(given, rows.q.shape[1], tip)
    check_and_complete_joints(chain.robot, rows)
    if (chain.servo_ids >= 0).all():  # before anything that takes long
        chain.check_force_limits(rows.q, given.source)
        drive_to_poses(
            chain, rows.q[:STABILITY_CHECK_MOVES], given.source
        )  # some moves show whether it is stable
    causes = build_gap_inputs(chain, rows, fit, diagnosis, holdout, seed, progress)
    if not causes.is_held_out.any():
        raise OptionError(f"{causes.data.source}: no pose is held out; give holdout=0.2")
    run = GapLadder(given, chain, causes, progress)
    rungs, (more, best) = run.measure_given_model(), run.measure_corrections()
    path = None if write is None or best.status is Status.FAILED else Path(write)
    last, commands = run.measure_written_model(more[-1], best, path)
    rungs += [*more[:-1], last]
    every = [*rungs, commands] if commands else rungs
    notices = (*rows.notices, *run.notices, *list_disagreements_with_fits(every))
    return SimulatorGap(
        model=str(model),
        robot=chain.robot.name,
        rungs=tuple(rungs),
        commands=commands,
        floor=causes.noise_floor.value if causes.noise_floor else np.nan,
        floor_from=causes.noise_floor.source if causes.noise_floor else "",
        train_poses=int((~causes.is_held_out).sum()),
        holdout_poses=int(run.held.sum()),
        status=best.status,
        beyond=convert_to_plain_json(best.beyond),
        left_out=tuple(run.left_out),
        notices=tuple(dict.fromkeys(notices)),
        written="" if path is None else str(path),
        seconds=time.perf_counter() - began,
        provenance=Provenance.from_run(chain.robot, rows, {"model": str(model), "holdout": holdout,
                                                     "seed": seed}),
    )  # fmt: skip


class CorrectionSteps(NamedTuple):
    """Steps of a ladder, and the fit of the last."""

    steps: list[GapStep]
    fit: Fit


class WrittenModelSteps(NamedTuple):
    """The step of a written file, and of the file with a command map, if there is one."""

    step: GapStep
    step_with_command_map: GapStep | None


class GapLadder:
    """One ladder in the making: model, poses and fits, and its notices.

    mapped: effects for a command map.  left_out: what is in neither, and why.
    """

    def __init__(
        self, given: MjcfModel, chain: ModelArm, causes: GapInputs, progress: Progress
    ) -> None:
        self.given, self.chain, self.causes, self.progress = given, chain, causes, progress
        touched = find_poses_in_contact(chain, given.compile_model(), causes.data.q)
        judge = select_judging_poses(causes.is_held_out, touched)
        train = np.flatnonzero(judge & ~causes.is_held_out)
        some = train[
            np.linspace(0, len(train) - 1, min(len(train), MAX_TRAINING_POSES)).astype(int)
        ]
        self.rows = np.sort(np.concatenate([some, np.flatnonzero(judge & causes.is_held_out)]))
        self.data = causes.data.take(self.rows)
        self.held = causes.is_held_out[self.rows]
        self.nominal = causes.geometry_fit.nominal
        self.notices: list[str] = []
        self.mapped, self.left_out = list(causes.mapped_terms), list(causes.left_out)
        self.add_pose_notice(
            f"{given.source}: the arm touches something", causes.data, touched, judge
        )

    def measure_given_model(self) -> list[GapStep]:
        """The model as given, and without the sag of its servos."""
        first = self.measure_step("as given", self.chain)
        if (self.chain.servo_ids < 0).any():
            self.notices.append(
                f"{self.given.source}: not every joint has a position servo: joints are set, not "
                "driven, in the model as given"
            )
            return [replace(first, why="joints set, not driven")]
        made = self.correct_given_model(None, self.nominal)
        self.notices += made.notices
        stiff = self.measure_step(
            "servo sag removed", self.write_and_compile_document(made.document)
        )
        return [
            replace(first, why=f"servos sag by up to {first.sag_mrad:.3g} mrad"),
            replace(stiff, why="gains that hold the arm where it is commanded"),
        ]

    def measure_corrections(self) -> CorrectionSteps:
        """A rung for geometry, and each effect that the simulator holds and gains by; their fit.

        Each is fitted with those before it and with nothing else: the values of a fit hold
        together, and an element with those of a fit that had more does not do what that fit says.
        """
        fit, taken, limit = self.causes.geometry_fit, list[Term](), 1.0 + MAX_RELATIVE_ERROR_RISE
        rungs = [self.measure_fit("calibrated geometry", fit)]
        for term in self.causes.element_terms:
            label = format_effect(*term.key)
            self.progress(f"fit with {label}")
            more = self.causes.fit_terms([*taken, term])
            if list_effects_without_element(more.cell, more.train):
                self.mapped.append(term)
                continue
            before, rung = rungs[-1], self.measure_fit(term.budget_step_name, more)
            if (
                rung.train_rms_mm > limit * before.train_rms_mm
                or rung.holdout_rms_mm > limit * before.holdout_rms_mm
            ):
                change = f"{before.holdout_rms_mm:.4f} -> {rung.holdout_rms_mm:.4f} mm"
                self.left_out.append(f"{label}: the simulated arm is worse with it ({change})")
                continue
            fit, taken = more, [*taken, term]
            rungs.append(rung)
        return CorrectionSteps(rungs, fit)

    def measure_written_model(
        self, last_step: GapStep, fit: Fit, path: Path | None
    ) -> WrittenModelSteps:
        """The last rung from its file, with targets, and what a command map does.

        The arm with a command map is another one, in a file of its own: what commands take over
        changes the rest.
        """
        arm, with_map = self.build_arm(fit), None
        made = self.correct_given_model(arm, fit.cell)
        rung = self.measure_step(
            last_step.name, self.write_and_compile_document(made.document, path), arm, fit
        )
        if self.mapped:
            fit = self.causes.fit_terms([*fit.cell.effects.terms, *self.mapped])
            arm = self.build_arm(fit)
        if arm.mapped_effects.terms:
            model = None if path is None else path.with_suffix(COMMANDED_MODEL_ENDING)
            chain = self.write_and_compile_document(
                self.correct_given_model(arm, fit.cell).document, model
            )
            if path is not None:
                for ending, content in arm.format_command_map(fit.cell).items():
                    write_file_atomically(path.with_suffix(ending), content)
                self.notices.append(f"{model}: the model that the command map belongs to; {path} "
                                    "is the best without")  # fmt: skip
            commands = Commands(replace(fit.cell, effects=arm.mapped_effects)).follow(self.data)
            with_map = self.measure_step("with its command map", chain, arm, fit, commands)
            labels = dict.fromkeys(format_effect(*term.key) for term in arm.mapped_effects.terms)
            with_map = replace(with_map, why="commands corrected for " + ", ".join(labels))
        self.left_out += arm.left_out
        whole = replace(arm, remaining_rms=0.0, left_out=tuple(self.left_out))
        self.notices += (*made.notices, *whole.list_limitations())
        return WrittenModelSteps(replace(rung, why=last_step.why), with_map)

    def write_and_compile_document(
        self, document: XmlDocument, path: Path | None = None
    ) -> ModelArm:
        """The arm in a changed document, from the file where one is written."""
        if path is None:
            return self.chain.with_model(self.given.compile_model(document.root))
        write_document(document, self.given.folder, path)
        return self.chain.with_model(import_mujoco().MjModel.from_xml_path(str(path)))

    def build_arm(self, fit: Fit) -> SimulatedArm:
        """The elements of a fit, with the model's own masses unless those are assumed."""
        own = self.chain.find_masses(self.nominal.robot)
        train, count = fit.train, fit.train.poses
        some = train.take(np.arange(0, count, max(1, count // MAX_TRAINING_POSES)))
        return build_simulated_arm(fit.cell, masses=own, measured=some)

    def measure_fit(self, name: str, fit: Fit) -> GapStep:
        """The simulator with the arm of a fit."""
        arm = self.build_arm(fit)
        return self.measure_step(
            name,
            self.write_and_compile_document(self.correct_given_model(arm, fit.cell).document),
            arm,
            fit,
        )

    def correct_given_model(self, arm: SimulatedArm | None, cell: Cell) -> CorrectedModel:
        """The model with an arm and the targets of a cell in it; without an arm, without sag."""
        names = cell.target_names if arm else ()
        return correct_model(self.given, self.chain, self.nominal.robot, arm, names)

    def measure_step(
        self,
        name: str,
        chain: ModelArm,
        arm: SimulatedArm | None = None,
        fit: Fit | None = None,
        commands: Array | None = None,
    ) -> GapStep:
        """Drive a model to every pose and judge where it comes to rest.

        arm, fit: that the model is to do, if any.
        commands: (m, n) where they are other than the joint values of the poses.
        """
        q = self.data.q
        commands = q if commands is None else commands
        play = None if arm is None else arm.find_play_positions(self.data)
        count = len(q)

        def report(done: int) -> None:
            if done % 20 == 0 or done == count:
                self.progress(f"{name}: {done} of {count} poses")

        driven = drive_to_poses(chain, commands, self.given.source, play, report)
        judge = select_judging_poses(self.held, driven.is_moving)
        self.add_pose_notice(
            f"{name}: the simulated arm did not come to rest within 1.5 s of its move",
            self.data,
            driven.is_moving,
            judge,
        )
        for i in np.flatnonzero(driven.share_at_force_limit > MAX_SHARE_AT_FORCE_LIMIT):
            self.notices.append(
                f"{name}: joint {i + 1} is at its force limit in "
                f"{driven.share_at_force_limit[i]:.0%} of the "
                "timesteps: raise the limit, or drive more slowly"
            )

        # Base and targets from the training poses, begun where the cell has them.
        start = fit.cell if fit else self.nominal
        end = invert_transform(driven.target_body_poses[0]) @ start.robot.pose(q[0])
        spots = start.target_positions @ end[:3, :3].T + end[:3, 3]
        error = compute_error_with_fitted_base(
            driven.target_body_poses, self.data, judge & ~self.held, (start.base, spots)
        )
        held, train = (
            summarise_point_errors(error[judge & rows]) for rows in (self.held, ~self.held)
        )
        off = np.abs(driven.q - commands)[judge][:, ~chain.robot.prismatic]
        predicted = np.nan
        if fit is not None and self.causes.is_data_of_fit:
            predicted = summarise_point_errors(fit.cell.error(self.data)[judge & self.held]).rms_mm
        return GapStep(
            name, held.rms_mm, held.max_mm, train.rms_mm, train.max_mm,
            1e3 * off.max(initial=0.0), predicted,
            moving_poses=int(driven.is_moving.sum()), at_limit=driven.share_at_force_limit.max()
        )  # fmt: skip

    def add_pose_notice(
        self, problem: str, data: Measurements, has_problem: Array, is_judging: Array
    ) -> None:
        """A notice on poses that do not judge.  has_problem: (m,) where; is_judging: (m,) those
        that do.
        """
        if has_problem.any():
            how = "they count, too few would be left" if is_judging.all() else "they are left out"
            self.notices.append(
                f"{problem} at {has_problem.sum()} poses "
                f"({data.format_row_names(has_problem)}): {how}"
            )


def list_disagreements_with_fits(steps: Sequence[GapStep]) -> list[str]:
    """A notice on each rung at which the simulator does other than the formulas of its fit."""
    return [
        f"{format_budget_step(rung.name)}: the simulated arm "
        f"misses by {rung.holdout_rms_mm:.4f} mm "
        f"where the fit says {rung.predicted_rms_mm:.4f} mm"
        for rung in steps
        if abs(rung.holdout_rms_mm - rung.predicted_rms_mm)
        > max(MAX_FORMULA_DISAGREEMENT * rung.predicted_rms_mm, MAX_FORMULA_DISAGREEMENT_MM)
    ]


def select_judging_poses(is_held_out: Array, is_excluded: Array) -> Array:
    """(m,) True at poses that judge: all but those that are out, unless too few would be left."""
    left = ~is_excluded
    enough = (left & is_held_out).any() and (left & ~is_held_out).sum() >= MIN_TRAINING_POSES
    return left if enough else np.ones_like(left)
