"""What each effect is worth: every trajectory is predicted by numbers fitted without it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.record_fields import FieldFormat
from minimax_cal.core.results import Result
from minimax_cal.core.tables import Table
from minimax_cal.dynamics.known_inputs import read_checked_runs
from minimax_cal.dynamics.laws import TorqueTerm
from minimax_cal.dynamics.logs.log_table import Run
from minimax_cal.dynamics.result import (
    FrictionCurve,
    HeldOutRun,
    MotionDiagnosis,
    MotionStep,
    build_table_by_joint,
    load_motion,
    pair_changed_rms_by_joint,
    pair_rms_by_joint,
)
from minimax_cal.dynamics.torque_regression import (
    RIGID_BODY_GROUP,
    USUAL_FRICTION_GROUP,
    FittedBody,
    TorqueModel,
    TorqueRegression,
    fit_bristle_friction,
    list_column_groups,
    solve_ridge_normal_equations,
)
from minimax_cal.dynamics.torque_rows import (
    ALWAYS_FITTED_FOLD,
    BRISTLE_YIELD_DISTANCES,
    GROUPS_PER_RUN,
    ROW_RATE_HZ,
    ArmMotion,
    MotionLogs,
    compute_rms_by_joint,
    compute_soft_speed_sign,
    mean_over_standard_error,
    resample_and_filter_runs,
)

GIVEN_STEP_NAME, REFITTED_STEP_NAME, USUAL_FRICTION_STEP_NAME = (
    "model as given",
    "rigid body refitted",
    "usual friction refitted",
)
MAX_HELD_OUT_ROWS = 750  # of the held-out run that is drawn
FRICTION_CURVE_POINT_COUNT = 61  # of a friction curve


class NonzeroColumns(NamedTuple):
    """Columns (q,) that add to the rows of a joint, and these rows (R, q)."""

    column_indices: Array
    rows: Array


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Fits without each fold of trajectories in turn, and the residuals of the rows left out.

    torques_before_delay_removal: (n, R) torques before a delay was taken out.  row_fold: (R,) in
    which a row is left out, negative for rows that are always fitted; fold_by_run: (R,) the same of
    whole runs.  fold_gram_matrices: (f, p, p) and fold_gradients: (f, p) of the rows fitted without
    each fold.
    """

    regression: TorqueRegression
    torques_before_delay_removal: Array
    fold_by_run: Array
    row_fold: Array
    fold_gram_matrices: Array
    fold_gradients: Array

    @staticmethod
    def build(
        regression: TorqueRegression, torques_before_delay_removal: Array, fold_by_run: Array
    ) -> CrossValidation:
        """The fits of whitened rows.  fold_by_run: (R,) of every row, by whole runs.

        Runs whose load, of the payloads among the laws, no other fold has are left out by quarters.
        """
        logs, fold, count = (
            regression.columns.scene.logs,
            fold_by_run.copy(),
            int(fold_by_run.max()) + 1,
        )
        loads = [
            tuple(t.text for t in regression.terms if t.tuned.get(name)) for name in logs.names
        ]
        for load in set(loads):
            rows = np.isin(logs.run_index, [r for r, each in enumerate(loads) if each == load])
            if len(np.unique(fold_by_run[rows])) == 1 and count > 1:
                fold[rows] = logs.quarter_index[rows] % min(count, GROUPS_PER_RUN)
        own = np.broadcast_to(fold, regression.whitening.is_row_fitted.shape)[
            regression.whitening.is_row_fitted
        ]
        parts = [(regression.whitened_design[own == f], regression.whitened_torques[own == f])
                 for f in range(-1, int(fold.max()) + 1)]  # fmt: skip
        gram = np.array([matrix.T @ matrix for matrix, _ in parts])
        pull = np.array([matrix.T @ error for matrix, error in parts])
        return CrossValidation(
            regression,
            torques_before_delay_removal,
            fold_by_run,
            fold,
            gram.sum(axis=0) - gram[1:],
            pull.sum(axis=0) - pull[1:],
        )

    @property
    def logs(self) -> MotionLogs:
        """Whose rows are judged."""
        return self.regression.columns.scene.logs

    @cached_property
    def values(self) -> Array:
        """(p,) of the fit of all laws to all rows."""
        return self.regression.solve_values(self.regression.column_groups)

    @cached_property
    def sigmas(self) -> Array:
        """(p,) their standard deviations."""
        return self.regression.compute_sigmas(self.regression.column_groups, self.values)

    @cached_property
    def held_out_residuals(self) -> Array:
        """(R, n) of fits of all laws."""
        return self.compute_held_out_residuals(self.regression.column_groups)

    @property
    def is_judged(self) -> Array:
        """(R,) True for rows that some fit leaves out."""
        return self.row_fold >= 0

    @cached_property
    def nonzero_columns_by_joint(self) -> list[NonzeroColumns]:
        """Of each joint the columns (q,) that add to its rows, and these rows (R, q)."""
        each = [np.flatnonzero(rows.any(axis=0)) for rows in self.regression.unwhitened_design]
        return [
            NonzeroColumns(used, rows[:, used])
            for used, rows in zip(each, self.regression.unwhitened_design, strict=True)
        ]

    def solve_folds(self, column_indices: Array) -> Array:
        """(f, p) values of some columns (q,), of the fit without each fold."""
        out = np.zeros(self.fold_gradients.shape)
        for value, gram, pull in zip(
            out, self.fold_gram_matrices, self.fold_gradients, strict=True
        ):
            value[column_indices] = solve_ridge_normal_equations(
                gram[np.ix_(column_indices, column_indices)], pull[column_indices]
            )
        return out

    def compute_held_out_residuals(
        self,
        column_groups: Sequence[str],
        *,
        with_delay_removed: bool = True,
        excluded_columns: Sequence[int] = (),
    ) -> Array:
        """(R, n) of fits of some parts, at the rows that each leaves out.

        Rows that no fit leaves out are as one of the fits leaves them, and are not judged.
        with_delay_removed: whether a delay was taken out.  excluded_columns: columns that are left
        out besides.
        """
        index = np.setdiff1d(
            self.regression.column_indices_of_groups(column_groups),
            np.array(excluded_columns, dtype=int),
        )
        torque = (
            self.regression.columns.torques_to_explain
            if with_delay_removed
            else self.torques_before_delay_removal
        )
        value = self.solve_folds(index).T.copy()
        fitted = np.stack([rows @ value[used] for used, rows in self.nonzero_columns_by_joint])
        own = np.where(self.row_fold == ALWAYS_FITTED_FOLD, 0, self.row_fold)
        left_out = np.take_along_axis(fitted, own[None, :, None], axis=2)[..., 0]
        out = np.asarray((torque - left_out).T)
        if self.regression.column_slices[USUAL_FRICTION_GROUP].start not in index:
            return out
        # The friction of bristles of each fold, by the residuals of the others.
        bristles, residuals = self.regression.columns.scene.bristle_deflection_rows, out.copy()
        for f in range(len(self.fold_gram_matrices)):
            rows = self.row_fold == f
            held = fit_bristle_friction(bristles[~rows], residuals[~rows])
            out[rows] -= (held * bristles[rows]).sum(axis=-1)
        return out

    def compute_rms_by_joint(self, residuals: Array, is_moving: Array | None = None) -> Array:
        """(n,) of each joint over the rows left out, or the moving ones of them (R, n)."""
        rows = np.ones(residuals.shape, bool) if is_moving is None else is_moving
        return compute_rms_by_joint(residuals, self.is_judged[:, None] & rows)

    def compare_rms_by_joint(self, residuals: Array) -> dict[str, tuple[float, float]]:
        """RMS of moving rows with some residuals (R, n), and with all laws.

        Of each joint that changes by a thousandth, or of all where none does.
        """
        ends = [
            self.compute_rms_by_joint(each, self.logs.is_row_moving)
            for each in (residuals, self.held_out_residuals)
        ]
        return pair_changed_rms_by_joint(*ends) or pair_rms_by_joint(*ends)

    def select_laws_that_help(self) -> list[TorqueTerm]:
        """The laws without those that harm the joints of rows left out more than they help others.

        By the log RMS of moving rows, a mean over all joints; a law harms where that is higher with
        it by a standard error, paired over the quarters of the trajectories.  The surest goes
        first; all together may harm, too [backward elimination].
        """
        logs, kept = self.logs, list(self.regression.terms)
        quarters = np.eye(int(logs.quarter_index.max()) + 1)[:, logs.quarter_index]
        rows = logs.is_row_moving & self.is_judged[:, None]

        def score(terms: Sequence[TorqueTerm]) -> Array:
            """(g,) of each quarter."""
            squares = quarters @ (
                self.compute_held_out_residuals(list_column_groups(terms)) ** 2 * rows
            )
            mean = squares / np.maximum(quarters @ rows, 1.0)
            return np.asarray(0.5 * np.log(mean + 1e-300).mean(axis=1))

        now = score(kept)
        while kept:
            fewer: list[list[TorqueTerm]] = [[t for t in kept if t is not one] for one in kept] + [
                []
            ]
            scores = [score(terms) for terms in fewer]
            falls = [mean_over_standard_error(now - other) for other in scores]
            best = int(np.argmax(falls))
            if falls[best] < 1.0:
                break
            now, kept = scores[best], fewer[best]
        return kept

    def fit_models_of_budget_steps(
        self, linearisation_body: FittedBody, removed_delay: float
    ) -> tuple[TorqueModel, ...]:
        """The fits of all steps of the budget but the first.  removed_delay: that was taken out
        [s].
        """
        normal, steps = self.regression, list_budget_steps(self.regression.terms, removed_delay)
        body = normal.build_fitted_body(normal.solve_values([RIGID_BODY_GROUP]))
        no_bristles = np.zeros((len(body.usual), len(BRISTLE_YIELD_DISTANCES)))
        return (
            TorqueModel(REFITTED_STEP_NAME, body, (), linearisation_body, no_bristles, 0.0),
            normal.fit_torque_model(USUAL_FRICTION_STEP_NAME, (), linearisation_body, 0.0),
            *(
                normal.fit_torque_model(name, terms, linearisation_body, removed_delay)
                for name, terms in steps
            ),
        )

    def list_heldout_rms_by_step(self, removed_delay: float) -> tuple[MotionStep, ...]:
        """Held-out RMS of each joint, from the model as given to all laws.

        The model as given has a gain of each joint where none is known.
        """
        columns, arm = self.regression.columns, self.regression.columns.scene.arm
        drawn = np.einsum(
            "rjp,p->jr",
            columns.scene.base_parameter_rows,
            arm.base_parameter_combinations.T @ arm.nominal_inertial_parameters,
        )
        if not arm.has_shared_inertial_parameters:
            drawn *= (drawn * self.torques_before_delay_removal).sum(
                axis=1, keepdims=True
            ) / np.maximum((drawn**2).sum(axis=1, keepdims=True), 1e-300)
        steps = [
            (GIVEN_STEP_NAME, (self.torques_before_delay_removal - drawn).T),
            (
                REFITTED_STEP_NAME,
                self.compute_held_out_residuals(
                    [RIGID_BODY_GROUP], with_delay_removed=not removed_delay
                ),
            ),
            (
                USUAL_FRICTION_STEP_NAME,
                self.compute_held_out_residuals(
                    [RIGID_BODY_GROUP, USUAL_FRICTION_GROUP], with_delay_removed=not removed_delay
                ),
            ),
            *(
                (name, self.compute_held_out_residuals(list_column_groups(terms)))
                for name, terms in list_budget_steps(self.regression.terms, removed_delay)
            ),
        ]
        return tuple(
            MotionStep(
                name,
                tuple(self.compute_rms_by_joint(residuals).tolist()),
                tuple(self.compute_rms_by_joint(residuals, self.logs.is_row_moving).tolist()),
            )
            for name, residuals in steps
        )

    def describe_held_out_rows(self) -> str:
        """How rows were held out, for people."""
        logs = self.logs
        if not self.is_judged.all():
            names = dict.fromkeys(logs.names[r] for r in logs.run_index[self.is_judged])
            return f"runs kept out: {', '.join(names)}"
        if len(logs.names) == 1:
            return "one run: its quarters left out in turn"
        alone = ", ".join(
            logs.names[r] for r in np.unique(logs.run_index[self.row_fold != self.fold_by_run])
        )
        quarters = f", the only ones with their load by quarters: {alone}" if alone else ""
        return f"runs left out in turn{quarters}"

    def build_held_out_run(self) -> HeldOutRun:
        """The first rows of a run as a fit without it predicts it."""
        logs = self.logs
        run = int(logs.run_index[np.argmax(self.is_judged)])
        rows = np.flatnonzero((logs.run_index == run) & self.is_judged)[:MAX_HELD_OUT_ROWS]
        measured = self.regression.columns.torques_to_explain[:, rows]
        both = (measured, measured - self.held_out_residuals[rows].T)
        rounded = (np.array([[float(f"{value:.5g}") for value in row] for row in torque])
                   for torque in both)  # fmt: skip
        time = tuple(np.round((rows - rows[0]) / ROW_RATE_HZ, 4).tolist())
        return HeldOutRun(logs.names[run], time, *rounded)

    def compute_friction_curves(self) -> Iterator[FrictionCurve]:
        """Friction over the speed of each joint, and its spread over fits without each fold."""
        normal, arm = self.regression, self.regression.columns.scene.arm
        folds = self.solve_folds(normal.column_indices_of_groups(normal.column_groups))
        values = np.array([self.values, *folds])
        for j in range(arm.robot.joints):
            v = np.linspace(-1.0, 1.0, FRICTION_CURVE_POINT_COUNT) * arm.fastest[j]
            sense = compute_soft_speed_sign(v, arm.soft[j])
            at = normal.column_slices[USUAL_FRICTION_GROUP].start + 2 * j
            drawn = np.outer(values[:, at], sense) + np.outer(values[:, at + 1], v)
            for term in (t for t in normal.terms if t.place == f"J{j + 1}"):
                amounts = values[:, normal.column_slices[term.text]].T
                forms = term.law.compute_friction_curves(v / arm.fastest[j], sense, term.tuned)
                for amount, form in zip(amounts, forms, strict=False):
                    drawn += np.outer(amount, form)
            spread = np.sqrt((len(folds) - 1) * drawn[1:].var(axis=0))  # jackknife
            yield FrictionCurve(f"J{j + 1}", v, drawn[0], spread)


def list_budget_steps(
    law_terms: Sequence[TorqueTerm], removed_delay: float
) -> list[tuple[str, tuple[TorqueTerm, ...]]]:
    """The steps after usual friction: effects in the order found, each at all its places.

    removed_delay: that was taken out of the torques [s].
    """
    done: list[TorqueTerm] = []
    out: list[tuple[str, tuple[TorqueTerm, ...]]] = [("+ delay", ())] if removed_delay else []
    for effect in dict.fromkeys(term.effect for term in law_terms):
        done += [term for term in law_terms if term.effect == effect]
        out.append((f"+ {effect}", tuple(done)))
    return out


# ---- on logs that no fit saw ---------------------------------------------------------------------


@dataclass(frozen=True)
class MotionStepErrors:
    """What a step misses, by joint: RMS of all rows, and of those that move."""

    name: str
    rms: tuple[float, ...]
    rms_moving: tuple[float, ...]


@dataclass(frozen=True)
class MotionEvaluation(Result):
    """How well each step of a motion diagnosis predicts torques of other logs [unit]."""

    KIND = "motion_evaluation"
    COMMAND = "evaluate"
    unit: str
    steps: Annotated[tuple[MotionStepErrors, ...], FieldFormat(key="rungs", fewest=1)]
    runs: tuple[str, ...]
    notices: tuple[str, ...]

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """What the last step misses."""
        return {"rms": self.steps[-1].rms, "rms_moving": self.steps[-1].rms_moving}

    def headline(self) -> str:
        """What the last step misses, in the middle of the joints."""
        size = f"{np.median(self.steps[-1].rms):.3g} {self.unit}"
        return f"RMS torque missed, median of the joints: {size}."

    def table(self) -> Table:
        """RMS of all rows by joint, step by step."""
        title = f"RMS torque [{self.unit}] on {', '.join(self.runs)}, all rows"
        return build_table_by_joint(title, "step", self.steps, "rms")


def evaluate_motion(
    motion: MotionDiagnosis | str | Path, logs: Sequence[Run | str | Path] | str | Path
) -> MotionEvaluation:
    """RMS torque that a motion diagnosis misses on other logs; nothing is fitted.

    Parameters
    ----------
    motion
        Loaded, or its path.
    logs
        Files or runs.

    Returns
    -------
    MotionEvaluation
        Both sides pass the 8 Hz zero-phase filter, at 25 rows a second.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.evaluate_motion("motion.json", ["other.csv"]).table())
    """
    found = load_motion(motion)
    arm = found.arm
    runs = read_checked_runs(arm.robot, arm.robot, logs)
    if runs[0].unit != found.unit:
        raise OptionError(
            f"{runs[0].source}: is in {runs[0].unit}, the diagnosis in {found.unit}; give logs of "
            "the same kind"
        )
    prepared = resample_and_filter_runs(runs)
    if not arm.known.any():
        prepared = replace(prepared, payload=np.full_like(prepared.payload, np.nan))
    scene = ArmMotion.build(arm, prepared)
    columns = cache(lambda context: context.build_torque_columns(scene))
    steps = []
    for model in found.models:
        logged = prepared.with_torque_delay_removed(model.delay) if model.delay else prepared
        residuals = logged.row_torques - model.predict_torques(columns(model.context))
        ends = (
            compute_rms_by_joint(residuals),
            compute_rms_by_joint(residuals, prepared.is_row_moving),
        )
        steps.append(MotionStepErrors(model.name, *(tuple(end.tolist()) for end in ends)))
    said = tuple(text for run in runs for text in run.notices)
    return MotionEvaluation(found.unit, tuple(steps), prepared.names, said)
