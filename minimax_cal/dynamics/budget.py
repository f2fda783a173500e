"""What each effect is worth: every trajectory is predicted by numbers fitted without it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from minimax_cal.dynamics.given import runs_of
from minimax_cal.dynamics.laws import Term
from minimax_cal.dynamics.logs.table import Run
from minimax_cal.dynamics.model import (
    FRICTION,
    RIGID,
    Body,
    Normal,
    TorqueModel,
    held_friction,
    parts_of,
    solve_scaled,
)
from minimax_cal.dynamics.result import (
    FrictionCurve,
    HeldRun,
    MotionDiagnosis,
    MotionStep,
    changed_joints,
    load_motion,
    table_by_joint,
    worth_by_joint,
)
from minimax_cal.dynamics.rows import (
    NEVER_OUT,
    QUARTERS,
    ROW_HZ,
    YIELD,
    Logs,
    Scene,
    prepare,
    rms_by_joint,
    sense_of,
    standard_errors,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.facts import Fact
from minimax_cal.ground.results import Result
from minimax_cal.ground.tables import Table

GIVEN, REFITTED, USUALLY = "model as given", "rigid body refitted", "usual friction refitted"
MAX_HELD_OUT_ROWS = 750  # of the held-out run that is drawn
CURVE_POINTS = 61  # of a friction curve


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Fits without each fold of trajectories in turn, and the residuals of the rows left out.

    undelayed: (n, R) torques before a delay was taken out.  fold: (R,) in which a row is left out,
    negative for rows that are always fitted; run_fold: (R,) the same of whole runs.  gram:
    (f, p, p) and pull: (f, p) of the rows fitted without each fold.
    """

    normal: Normal
    undelayed: Array
    run_fold: Array
    fold: Array
    gram: Array
    pull: Array

    @staticmethod
    def of(normal: Normal, undelayed: Array, run_fold: Array) -> CrossValidation:
        """The fits of whitened rows.  run_fold: (R,) of every row, by whole runs.

        Runs whose load, of the payloads among the laws, no other fold has are left out by quarters.
        """
        logs, fold, count = normal.columns.scene.logs, run_fold.copy(), int(run_fold.max()) + 1
        loads = [tuple(t.text for t in normal.terms if t.tuned.get(name)) for name in logs.names]
        for load in set(loads):
            rows = np.isin(logs.run, [r for r, each in enumerate(loads) if each == load])
            if len(np.unique(run_fold[rows])) == 1 and count > 1:
                fold[rows] = logs.quarter[rows] % min(count, QUARTERS)
        own = np.broadcast_to(fold, normal.white.kept.shape)[normal.white.kept]
        parts = [(normal.matrix[own == f], normal.error[own == f])
                 for f in range(-1, int(fold.max()) + 1)]  # fmt: skip
        gram = np.array([matrix.T @ matrix for matrix, _ in parts])
        pull = np.array([matrix.T @ error for matrix, error in parts])
        return CrossValidation(normal, undelayed, run_fold, fold, gram.sum(axis=0) - gram[1:],
                               pull.sum(axis=0) - pull[1:])  # fmt: skip

    @property
    def logs(self) -> Logs:
        """Whose rows are judged."""
        return self.normal.columns.scene.logs

    @cached_property
    def value(self) -> Array:
        """(p,) of the fit of all laws to all rows."""
        return self.normal.solve(self.normal.parts)

    @cached_property
    def sigma(self) -> Array:
        """(p,) their standard deviations."""
        return self.normal.spread(self.normal.parts, self.value)

    @cached_property
    def residuals(self) -> Array:
        """(R, n) of fits of all laws."""
        return self.predict_residuals(self.normal.parts)

    @property
    def is_judged(self) -> Array:
        """(R,) True for rows that some fit leaves out."""
        return self.fold >= 0

    @cached_property
    def joint_columns(self) -> list[tuple[Array, Array]]:
        """Of each joint the columns (q,) that add to its rows, and these rows (R, q)."""
        each = [np.flatnonzero(rows.any(axis=0)) for rows in self.normal.raw]
        return [(used, rows[:, used]) for used, rows in zip(each, self.normal.raw, strict=True)]

    def solve_folds(self, index: Array) -> Array:
        """(f, p) values of some columns (q,), of the fit without each fold."""
        out = np.zeros(self.pull.shape)
        for value, gram, pull in zip(out, self.gram, self.pull, strict=True):
            value[index] = solve_scaled(gram[np.ix_(index, index)], pull[index])
        return out

    def predict_residuals(
        self, parts: Sequence[str], *, delayed: bool = True, without: Sequence[int] = ()
    ) -> Array:
        """(R, n) of fits of some parts, at the rows that each leaves out.

        Rows that no fit leaves out are as one of the fits leaves them, and are not judged.
        delayed: whether a delay was taken out.  without: columns that are left out besides.
        """
        index = np.setdiff1d(self.normal.index(parts), np.array(without, dtype=int))
        torque = self.normal.columns.error if delayed else self.undelayed
        value = self.solve_folds(index).T.copy()
        fitted = np.stack([rows @ value[used] for used, rows in self.joint_columns])
        own = np.where(self.fold == NEVER_OUT, 0, self.fold)
        left_out = np.take_along_axis(fitted, own[None, :, None], axis=2)[..., 0]
        out = np.asarray((torque - left_out).T)
        if self.normal.place[FRICTION].start not in index:
            return out
        # The friction of bristles of each fold, by the residuals of the others.
        bristles, residuals = self.normal.columns.scene.bristles, out.copy()
        for f in range(len(self.gram)):
            rows = self.fold == f
            held = held_friction(bristles[~rows], residuals[~rows])
            out[rows] -= (held * bristles[rows]).sum(axis=-1)
        return out

    def rms(self, residuals: Array, moving: Array | None = None) -> Array:
        """(n,) of each joint over the rows left out, or the moving ones of them (R, n)."""
        rows = np.ones(residuals.shape, bool) if moving is None else moving
        return rms_by_joint(residuals, self.is_judged[:, None] & rows)

    def compare(self, residuals: Array) -> dict[str, tuple[float, float]]:
        """RMS of moving rows with some residuals (R, n), and with all laws.

        Of each joint that changes by a thousandth, or of all where none does.
        """
        ends = [self.rms(each, self.logs.moving) for each in (residuals, self.residuals)]
        return changed_joints(*ends) or worth_by_joint(*ends)

    def drop_harmful_laws(self) -> list[Term]:
        """The laws without those that harm the joints of rows left out more than they help others.

        By the log RMS of moving rows, a mean over all joints; a law harms where that is higher with
        it by a standard error, paired over the quarters of the trajectories.  The surest goes
        first; all together may harm, too [backward elimination].
        """
        logs, kept = self.logs, list(self.normal.terms)
        quarters = np.eye(int(logs.quarter.max()) + 1)[:, logs.quarter]
        rows = logs.moving & self.is_judged[:, None]

        def score(terms: Sequence[Term]) -> Array:
            """(g,) of each quarter."""
            squares = quarters @ (self.predict_residuals(parts_of(terms)) ** 2 * rows)
            mean = squares / np.maximum(quarters @ rows, 1.0)
            return np.asarray(0.5 * np.log(mean + 1e-300).mean(axis=1))

        now = score(kept)
        while kept:
            fewer: list[list[Term]] = [[t for t in kept if t is not one] for one in kept] + [[]]
            scores = [score(terms) for terms in fewer]
            falls = [standard_errors(now - other) for other in scores]
            best = int(np.argmax(falls))
            if falls[best] < 1.0:
                break
            now, kept = scores[best], fewer[best]
        return kept

    def build_models(self, context: Body, delay: float) -> tuple[TorqueModel, ...]:
        """The fits of all steps of the budget but the first.  delay: that was taken out [s]."""
        normal, steps = self.normal, list_steps(self.normal.terms, delay)
        body = normal.body(normal.solve([RIGID]))
        no_bristles = np.zeros((len(body.usual), len(YIELD)))
        return (
            TorqueModel(REFITTED, body, (), context, no_bristles, 0.0),
            normal.model(USUALLY, (), context, 0.0),
            *(normal.model(name, terms, context, delay) for name, terms in steps),
        )

    def build_budget(self, delay: float) -> tuple[MotionStep, ...]:
        """Held-out RMS of each joint, from the model as given to all laws.

        The model as given has a gain of each joint where none is known.
        """
        columns, arm = self.normal.columns, self.normal.columns.scene.arm
        drawn = np.einsum("rjp,p->jr", columns.scene.base_rows, arm.base.T @ arm.drawn)
        if not arm.shared:
            drawn *= (drawn * self.undelayed).sum(axis=1, keepdims=True) / np.maximum(
                (drawn**2).sum(axis=1, keepdims=True), 1e-300
            )
        steps = [
            (GIVEN, (self.undelayed - drawn).T),
            (REFITTED, self.predict_residuals([RIGID], delayed=not delay)),
            (USUALLY, self.predict_residuals([RIGID, FRICTION], delayed=not delay)),
            *((name, self.predict_residuals(parts_of(terms)))
              for name, terms in list_steps(self.normal.terms, delay)),
        ]  # fmt: skip
        return tuple(MotionStep(name, tuple(self.rms(residuals).tolist()),
                                tuple(self.rms(residuals, self.logs.moving).tolist()))
                     for name, residuals in steps)  # fmt: skip

    def describe_folds(self) -> str:
        """How rows were held out, for people."""
        logs = self.logs
        if not self.is_judged.all():
            names = dict.fromkeys(logs.names[r] for r in logs.run[self.is_judged])
            return f"runs kept out: {', '.join(names)}"
        if len(logs.names) == 1:
            return "one run: its quarters left out in turn"
        alone = ", ".join(logs.names[r] for r in np.unique(logs.run[self.fold != self.run_fold]))
        quarters = f", the only ones with their load by quarters: {alone}" if alone else ""
        return f"runs left out in turn{quarters}"

    def sample_held_out_run(self) -> HeldRun:
        """The first rows of a run as a fit without it predicts it."""
        logs = self.logs
        run = int(logs.run[np.argmax(self.is_judged)])
        rows = np.flatnonzero((logs.run == run) & self.is_judged)[:MAX_HELD_OUT_ROWS]
        measured = self.normal.columns.error[:, rows]
        both = (measured, measured - self.residuals[rows].T)
        rounded = (np.array([[float(f"{value:.5g}") for value in row] for row in torque])
                   for torque in both)  # fmt: skip
        time = tuple(np.round((rows - rows[0]) / ROW_HZ, 4).tolist())
        return HeldRun(logs.names[run], time, *rounded)

    def draw_friction_curves(self) -> Iterator[FrictionCurve]:
        """Friction over the speed of each joint, and its spread over fits without each fold."""
        normal, arm = self.normal, self.normal.columns.scene.arm
        folds = self.solve_folds(normal.index(normal.parts))
        values = np.array([self.value, *folds])
        for j in range(arm.robot.joints):
            v = np.linspace(-1.0, 1.0, CURVE_POINTS) * arm.fastest[j]
            sense = sense_of(v, arm.soft[j])
            at = normal.place[FRICTION].start + 2 * j
            drawn = np.outer(values[:, at], sense) + np.outer(values[:, at + 1], v)
            for term in (t for t in normal.terms if t.place == f"J{j + 1}"):
                amounts = values[:, normal.place[term.text]].T
                forms = term.law.curve(v / arm.fastest[j], sense, term.tuned)
                for amount, form in zip(amounts, forms, strict=False):
                    drawn += np.outer(amount, form)
            spread = np.sqrt((len(folds) - 1) * drawn[1:].var(axis=0))  # jackknife
            yield FrictionCurve(f"J{j + 1}", v, drawn[0], spread)


def list_steps(terms: Sequence[Term], delay: float) -> list[tuple[str, tuple[Term, ...]]]:
    """The steps after usual friction: effects in the order found, each at all its places.

    delay: that was taken out of the torques [s].
    """
    done: list[Term] = []
    out: list[tuple[str, tuple[Term, ...]]] = [("+ delay", ())] if delay else []
    for effect in dict.fromkeys(term.effect for term in terms):
        done += [term for term in terms if term.effect == effect]
        out.append((f"+ {effect}", tuple(done)))
    return out


# ---- on logs that no fit saw ---------------------------------------------------------------------


@dataclass(frozen=True)
class MotionStepError:
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
    steps: Annotated[tuple[MotionStepError, ...], Fact(key="rungs", fewest=1)]
    runs: tuple[str, ...]
    notices: tuple[str, ...]

    def beside(self, *, poses: bool = True) -> dict[str, Any]:
        """What the last step misses."""
        return {"rms": self.steps[-1].rms, "rms_moving": self.steps[-1].rms_moving}

    def headline(self) -> str:
        """What the last step misses, in the middle of the joints."""
        size = f"{np.median(self.steps[-1].rms):.3g} {self.unit}"
        return f"RMS torque missed, median of the joints: {size}."

    def table(self) -> Table:
        """RMS of all rows by joint, step by step."""
        title = f"RMS torque [{self.unit}] on {', '.join(self.runs)}, all rows"
        return table_by_joint(title, "step", self.steps, "rms")


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
    runs = runs_of(arm.robot, arm.robot, logs)
    if runs[0].unit != found.unit:
        raise OptionError(
            f"{runs[0].source}: is in {runs[0].unit}, the diagnosis in {found.unit}; give logs of "
            "the same kind"
        )
    prepared = prepare(runs)
    if not arm.known.any():
        prepared = replace(prepared, payload=np.full_like(prepared.payload, np.nan))
    scene = Scene.of(arm, prepared)
    columns = cache(lambda context: context.build_columns(scene))
    steps = []
    for model in found.models:
        logged = prepared.earlier(model.delay) if model.delay else prepared
        residuals = logged.y - model.predict(columns(model.context))
        ends = rms_by_joint(residuals), rms_by_joint(residuals, prepared.moving)
        steps.append(MotionStepError(model.name, *(tuple(end.tolist()) for end in ends)))
    said = tuple(text for run in runs for text in run.notices)
    return MotionEvaluation(found.unit, tuple(steps), prepared.names, said)
