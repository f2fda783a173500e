"""What each effect is worth: every trajectory is predicted by numbers fitted without it."""

from __future__ import annotations

from collections.abc import Sequence
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
    Columns,
    Normal,
    TorqueModel,
    held_friction,
    parts_of,
    solve_scaled,
)
from minimax_cal.dynamics.result import (
    MotionDiagnosis,
    changed_joints,
    load_motion,
    table_by_joint,
    worth_by_joint,
)
from minimax_cal.dynamics.rows import QUARTERS, Logs, Scene, prepare, rms_by_joint, standard_errors
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.facts import Fact
from minimax_cal.ground.results import Result
from minimax_cal.ground.tables import Table

NEVER_OUT = -1  # number of the fold of rows that are always fitted


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Fits without each fold of trajectories in turn, and what they miss there.

    early: (n, R) torques before a delay was taken out.  fold: (R,).  gram: (f, p, p) and pull:
    (f, p) of the rows fitted without each fold.
    """

    normal: Normal
    early: Array
    fold: Array
    gram: Array
    pull: Array

    @staticmethod
    def of(normal: Normal, early: Array, fold: Array) -> LeftOut:
        """The fits of whitened rows.  fold: (R,) of every row."""
        own = np.broadcast_to(fold, normal.white.kept.shape)[normal.white.kept]
        products = [products_of(normal, own == f) for f in range(-1, int(fold.max()) + 1)]
        gram, pull = (np.array([each[k] for each in products]) for k in (0, 1))
        return LeftOut(normal, early, fold,
                       gram.sum(axis=0) - gram[1:], pull.sum(axis=0) - pull[1:])  # fmt: skip

    @property
    def logs(self) -> Logs:
        """Whose rows are judged."""
        return self.normal.columns.scene.logs

    @property
    def every(self) -> list[str]:
        """The parts of the fit of all laws."""
        return parts_of(self.normal.terms)

    @cached_property
    def value(self) -> Array:
        """(p,) of the fit of all laws to all rows."""
        return self.normal.solve(self.every)

    @cached_property
    def sigma(self) -> Array:
        """(p,) their standard deviations."""
        return self.normal.spread(self.every, self.value)

    @cached_property
    def whole(self) -> Array:
        """(R, n) what fits of all laws miss."""
        return self.missed(self.every)

    @cached_property
    def usual(self) -> Array:
        """(n,) RMS of moving rows beside usual friction alone."""
        return self.rms(self.missed(parts_of(())), self.logs.moving)

    def worth(self, missed: Array) -> dict[str, tuple[float, float]]:
        """Of each joint that changes by a thousandth, the RMS of moving rows without and with it.

        missed: (R, n) by fits without it.
        """
        ends = [self.rms(each, self.logs.moving) for each in (missed, self.whole)]
        return changed_joints(*ends) or worth_by_joint(*ends)

    @property
    def judged(self) -> Array:
        """(R,) rows that some fit leaves out."""
        return self.fold >= 0

    @cached_property
    def compact(self) -> list[tuple[Array, Array]]:
        """Of each joint the columns (q,) that add to its rows, and these rows (R, q)."""
        raw = self.normal.raw
        each = [np.flatnonzero(rows.any(axis=0)) for rows in raw]
        return [(used, rows[:, used]) for used, rows in zip(each, raw, strict=True)]

    def values(self, index: Array) -> Array:
        """(f, p) values of some columns, of the fit without each fold."""
        out = np.zeros(self.pull.shape)
        for value, gram, pull in zip(out, self.gram, self.pull, strict=True):
            value[index] = solve_scaled(gram[np.ix_(index, index)], pull[index])
        return out

    def missed(
        self, parts: Sequence[str], *, delayed: bool = True, without: Sequence[int] = ()
    ) -> Array:
        """(R, n) what fits of some parts miss at the rows that each leaves out.

        Rows that no fit leaves out are as one of the fits leaves them, and are not `judged`.
        delayed: whether a delay was taken out.  without: columns that are left out besides.
        """
        index = np.setdiff1d(self.normal.index(parts), np.array(without, dtype=int))
        seen = self.normal.columns.error if delayed else self.early
        value = self.values(index).T.copy()
        fitted = np.stack([rows @ value[used] for used, rows in self.compact])
        own = np.where(self.fold == NEVER_OUT, 0, self.fold)
        out = seen - np.take_along_axis(fitted, own[None, :, None], axis=2)[..., 0]
        missed = np.asarray(out.T)
        return missed if self.normal.place[FRICTION].start not in index else self.less_held(missed)

    def less_held(self, missed: Array) -> Array:
        """(R, n) the same less the friction of bristles, as the other folds show it."""
        bristles, out = self.normal.columns.scene.bristles, missed.copy()
        for f in range(len(self.gram)):
            rows = self.fold == f
            held = held_friction(bristles[~rows], missed[~rows])
            out[rows] -= (held * bristles[rows]).sum(axis=-1)
        return out

    def rms(self, missed: Array, moving: Array | None = None) -> Array:
        """(n,) of each joint over the rows left out, or the moving ones of them (R, n)."""
        rows = self.judged[:, None] & (np.ones(missed.shape, bool) if moving is None else moving)
        return rms_by_joint(missed, rows)


def products_of(normal: Normal, rows: Array) -> tuple[Array, Array]:
    """Products of whitened columns among each other and with the error, of some rows (N,)."""
    matrix = normal.matrix[rows]
    return matrix.T @ matrix, matrix.T @ normal.error[rows]


def folds_of(logs: Logs, share: float, named: Sequence[str]) -> Array:
    """(R,) fold of every row: runs named are one; else whole runs in turn, about a share each.

    A single run is left out by quarters.
    """
    count = len(logs.names)
    if named:
        out = np.array([0 if name in named else NEVER_OUT for name in logs.names])
        return out[logs.run]
    if count == 1:
        return logs.quarter
    parts = min(count, max(2, round(1.0 / share)))
    return (np.arange(count) % parts)[logs.run]


def without_harmful(judge: LeftOut, terms: Sequence[Term]) -> list[Term]:
    """The laws without those that harm the joints of rows left out more than they help others.

    By the log RMS of moving rows, a mean over all joints; a law harms where that is higher with it
    by a standard error, paired over the quarters of the trajectories.  The surest goes first; all
    together may harm, too.
    """
    logs, kept = judge.logs, list(terms)
    quarters = np.eye(int(logs.quarter.max()) + 1)[:, logs.quarter]
    rows = logs.moving & judge.judged[:, None]

    def score(some: Sequence[Term]) -> Array:
        """(g,) of each quarter."""
        squares = quarters @ (judge.missed(parts_of(some)) ** 2 * rows)
        mean = squares / np.maximum(quarters @ rows, 1.0)
        return np.asarray(0.5 * np.log(mean + 1e-300).mean(axis=1))

    now = score(kept)
    while kept:
        fewer: list[list[Term]] = [[t for t in kept if t is not one] for one in kept]
        tried = [score(some) for some in (*fewer, [])]
        falls = [standard_errors(now - other) for other in tried]
        best = int(np.argmax(falls))
        if falls[best] < 1.0:
            break
        now, kept = tried[best], [*fewer, []][best]
    return kept


def by_loads(fold: Array, logs: Logs, terms: Sequence[Term]) -> Array:
    """(R,) folds in which runs whose load no other fold has are left out by quarters.

    fold: (R,) of whole runs.  terms: laws found, with the payloads of runs.
    """
    carried = [tuple(t.text for t in terms if t.tuned.get(name)) for name in logs.names]
    out, parts = fold.copy(), int(fold.max()) + 1
    for load in set(carried):
        rows = np.isin(logs.run, [r for r, each in enumerate(carried) if each == load])
        if len(np.unique(fold[rows])) == 1 and parts > 1:
            out[rows] = logs.quarter[rows] % min(parts, QUARTERS)
    return out


def steps_of(terms: Sequence[Term]) -> list[tuple[str, tuple[Term, ...]]]:
    """The steps after usual friction: effects in the order found, each at all its places."""
    done: list[Term] = []
    out = []
    for effect in dict.fromkeys(term.effect for term in terms):
        done += [term for term in terms if term.effect == effect]
        out.append((effect, tuple(done)))
    return out


def drawn_missed(columns: Columns, error: Array) -> Array:
    """(R, n) what the model as given misses; with a gain of each joint where none is given."""
    arm = columns.scene.arm
    drawn = np.einsum("rjp,p->jr", columns.scene.base_rows, arm.base.T @ arm.drawn)
    if not arm.shared:
        drawn *= (drawn * error).sum(axis=1, keepdims=True) / np.maximum(
            (drawn**2).sum(axis=1, keepdims=True), 1e-300
        )
    return np.asarray((error - drawn).T)


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


def missed(model: TorqueModel, logs: Logs, columns: Columns) -> Array:
    """(R, n) what a model misses.  columns: of a scene with its context."""
    seen = logs.earlier(model.delay) if model.delay else logs
    return seen.y - model.predict(columns)


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
    columns = cache(lambda context: Columns(context.in_scene(scene)))
    steps = []
    for model in found.models:
        off = missed(model, prepared, columns(model.context))
        ends = rms_by_joint(off), rms_by_joint(off, prepared.moving)
        steps.append(MotionStepError(model.name, *(tuple(end.tolist()) for end in ends)))
    said = tuple(text for run in runs for text in run.notices)
    return MotionEvaluation(found.unit, tuple(steps), prepared.names, said)
