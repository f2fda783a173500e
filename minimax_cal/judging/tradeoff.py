"""Between the least RMS and the least worst error: the compromises a user can choose from.

Both ends are fits of `calibrate`: least squares (`sum`) and the worst point (`point`).  A
compromise minimises (1 - w) max_i f_i + w mean_i f_i of the squared distances f_i, the distances
between targets kept.  That is again a max of smooth functions, so the SQP of `point` solves it; and
each such answer is efficient: nothing has both a smaller RMS and a smaller largest error.  (A path
of p-norms has not this property, and its problems grow stiff with p.)  The weights w come from the
curve: the widest gap between two neighbours gets the w whose level lines are parallel to their
chord [Cohon 1978, noninferior set estimation].
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.fitting.calibrate import again, calibrate
from minimax_cal.fitting.checks import POOR_FIT
from minimax_cal.fitting.fit import Fit, Provenance
from minimax_cal.fitting.minimax_problem import MinimaxProblem, minimax_problem
from minimax_cal.fitting.options import Progress, silent, usable
from minimax_cal.fitting.solve import QP_TOLERANCE
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.results import Result
from minimax_cal.ground.stages import count_stage
from minimax_cal.ground.tables import Cell as TableCell
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.accuracy import Accuracy, accuracy
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.joint_fit import extended, fitted
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import minimax
from minimax_cal.solvers.minimax import Linear, Solver
from minimax_cal.solvers.status import Status
from qp_backends import solve as solve_qp

SCHEMA = 1
DEFAULT_STEPS, MAX_STEPS = 7, 100
CHORD_TOLERANCE = 1e-6  # relative: what is not farther than this below a chord lies on it


@dataclass(frozen=True, eq=False)
class Blend:
    """The problem `worst` (of points) with a share w of the mean: (1 - w) f_i + w mean f."""

    worst: MinimaxProblem
    share: float

    @property
    def lower(self) -> Array:
        """Lower bounds of the scaled distance deviations."""
        return self.worst.lower

    @property
    def upper(self) -> Array:
        """Upper bounds of the scaled distance deviations."""
        return self.worst.upper

    def mixed(self, f: Array) -> Array:
        """Values (n,) or slopes (n, p) of the functions from those of the f_i."""
        return np.asarray((1.0 - self.share) * f + self.share * f.mean(axis=0))

    def evaluate(self, x: State) -> tuple[Array, Array]:
        """The functions and c."""
        f, c = self.worst.evaluate(x)
        return self.mixed(f), c

    def linearise(self, x: State) -> Linear:
        """The functions, c and their derivatives."""
        at = self.worst.linearise(x)

        def curvature(weights: Array) -> Array:
            return at.curvature(self.mixed(weights))  # the mixing is symmetric

        return Linear(self.mixed(at.f), self.mixed(at.jacobian), at.c, at.normal, curvature)

    def step(self, x: State, d: Array) -> State:
        """The state moved by a scaled step."""
        return self.worst.step(x, d)


@dataclass(frozen=True, eq=False)
class Compromise:
    """One answer on the curve.

    share: w of what it minimises; 1 is `sum`, 0 is `point`.
    mean, most: the mean and the largest of the f_i, in the scale of the problem.
    """

    share: float
    state: State
    mean: float
    most: float
    status: Status

    @staticmethod
    def of(worst: MinimaxProblem, share: float, state: State, status: Status) -> Compromise:
        """A state and what it is worth."""
        f, _ = worst.evaluate(state)
        return Compromise(share, state, float(f.mean()), float(f.max()), status)

    @property
    def place(self) -> Array:
        """Where it lies on the curve: RMS and largest distance, in the scale of the problem."""
        return np.sqrt([self.mean, self.most])

    def level(self, share: float) -> float:
        """(1 - w) max f + w mean f."""
        return (1.0 - share) * self.most + share * self.mean


def curve_of(
    worst: MinimaxProblem,
    ends: tuple[Compromise, Compromise],
    steps: int,
    qp: Solver,
    progress: Progress,
) -> list[Compromise]:
    """The ends, `sum` first, and up to so many compromises between them, by growing RMS."""
    curve, straight = list(ends), set[float]()
    span = np.maximum(np.abs(ends[1].place - ends[0].place), 1e-300)

    def width(a: Compromise, b: Compromise) -> float:
        bends = a.share not in straight and a.most > b.most and a.mean < b.mean
        return float(np.linalg.norm((b.place - a.place) / span)) if bends else 0.0

    while len(curve) < steps + 2:
        progress(count_stage("compromise", len(curve) - 1, steps))
        gaps = [width(a, b) for a, b in itertools.pairwise(curve)]
        at = int(np.argmax(gaps))
        if gaps[at] == 0.0:
            break
        a, b = curve[at : at + 2]
        share = (a.most - b.most) / (a.most - b.most + b.mean - a.mean)
        best = minimax.solve(Blend(worst, share), b.state, qp)
        found = Compromise.of(worst, share, best.x, best.status)
        if found.level(share) < b.level(share) * (1.0 - CHORD_TOLERANCE):
            curve.insert(at + 1, found)
        else:
            straight.add(a.share)
    return curve


@dataclass(frozen=True, eq=False)
class Choice:
    """A calibrated cell, the objective or compromise that it comes from, and how well it does."""

    objective: str
    share: float
    cell: Cell
    train: Accuracy
    holdout: Accuracy
    status: Status

    def to_dict(self) -> dict[str, Any]:
        """For JSON; `cell` is what `load_cell` reads."""
        return {
            "objective": self.objective,
            "share": self.share,
            "status": str(self.status),
            "train": self.train.to_dict(),
            "holdout": self.holdout.to_dict(),
            "cell": self.cell.whole(),
        }


@dataclass(frozen=True, eq=False)
class Tradeoff(Result):
    """The choices, from the least RMS to the least worst error on the training poses."""

    robot: str
    choices: tuple[Choice, ...]
    seconds: float
    notices: tuple[str, ...]
    provenance: Provenance

    @property
    def status(self) -> Status:
        """The first that is not `converged`, if any."""
        ended = [choice.status for choice in self.choices]
        return next((s for s in ended if s is not Status.CONVERGED), Status.CONVERGED)

    def table(self) -> Table:
        """Every choice, on the training and on the held-out poses."""
        rows: list[tuple[TableCell, ...]] = [
            (number, c.objective, c.share, c.train.rms_mm, c.train.max_mm, c.holdout.rms_mm,
             c.holdout.max_mm, str(c.status))
            for number, c in enumerate(self.choices)
        ]  # fmt: skip
        counts = [a.poses for a in (self.choices[0].train, self.choices[0].holdout)]
        title = (
            f"{self.robot}: RMS or largest error, {counts[0]} training, {counts[1]} held-out poses"
        )
        header = ("", "objective", "w", "training RMS mm", "training max mm", "held-out RMS mm",
                  "held-out max mm", "status")  # fmt: skip
        return Table(title, header, tuple(rows), ("d", "", ".3g", *[".4f"] * 4, ""))

    def headline(self) -> str:
        """What giving up RMS buys, in a sentence."""
        first, last = self.choices[0], self.choices[-1]
        if first is last:
            return (
                f"Least squares misses by {first.train.rms_mm:.4g} mm RMS: this is no calibration."
            )
        if not first.train.rms_mm:
            return "Least squares leaves no error at the training poses: nothing is to be gained."
        grows = 100.0 * (last.train.rms_mm / first.train.rms_mm - 1.0)
        falls = 100.0 * (1.0 - last.train.max_mm / first.train.max_mm)
        text = (
            f"From sum to point the training RMS grows by {grows:.0f} % and the largest training "
            f"error falls by {falls:.0f} %"
        )
        if not first.holdout.poses:
            return f"{text}; no pose was held out."
        if not first.holdout.rms_mm:
            return f"{text}; at the held-out poses least squares leaves no error."
        rms = 100.0 * (last.holdout.rms_mm / first.holdout.rms_mm - 1.0)
        most = 100.0 * (last.holdout.max_mm / first.holdout.max_mm - 1.0)
        return (
            f"{text}; on held-out poses RMS changes by {rms:+.0f} %, the largest by {most:+.0f} %."
        )

    def tables(self) -> tuple[Table, ...]:
        """Every choice."""
        return (self.table(),)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "schema": SCHEMA,
            "kind": "tradeoff",
            "robot": self.robot,
            "status": str(self.status),
            "advice": self.status.advice,
            "choices": [choice.to_dict() for choice in self.choices],
            "seconds": self.seconds,
            "notices": list(self.notices),
            "provenance": vars(self.provenance),
        }


def tradeoff(
    robot: Robot | Fit | str | Path,
    data: Measurements | str | Path | None = None,
    steps: int = DEFAULT_STEPS,
    qp: str = "daqp",
    holdout: float = 0.2,
    seed: int = 0,
    progress: Progress = silent,
) -> Tradeoff:
    """The choices between least squares and the worst point for a robot and its measurements.

    Parameters
    ----------
    robot, data
        Loaded, or a name or path; or a fit alone, whose measurements are taken as they were
        split.
    steps
        Compromises between the two.
    qp, holdout, seed
        As in `calibrate`.
    progress
        Called with a word on each stage.

    Returns
    -------
    Tradeoff
        Fits between the sum and the worst target.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.tradeoff(mc.load_fit("fit.json"), steps=5).headline())
    """
    if not 0 <= steps <= MAX_STEPS:
        raise OptionError(f"steps {steps}: give a whole number from 0 to {MAX_STEPS}")
    began = time.perf_counter()
    settings = {"steps": steps, "qp": qp, "holdout": holdout, "seed": seed}

    def fit(objective: str) -> Fit:
        if isinstance(robot, Fit):
            same = robot.objective == objective
            return robot if same else again(robot, progress, objective=objective)
        if data is None:
            raise OptionError("tradeoff: give the measurements too, or a fit that holds them")
        return calibrate(robot, data, objective, qp, holdout=holdout, seed=seed, progress=progress)

    first = fit("sum")
    if first.accuracy["train"].rms_mm > 1e3 * POOR_FIT * first.nominal.robot.reach():
        return hopeless(first, began, settings)
    last = fit("point")
    worst = problem_of(first)
    ends = (
        Compromise.of(worst, 1.0, first.cell.state, first.status),
        Compromise.of(worst, 0.0, last.cell.state, last.status),
    )
    solver = partial(solve_qp, name=usable(qp)[0], tolerance=QP_TOLERANCE)
    curve = curve_of(worst, ends, steps, solver, progress)
    names = ("sum", *["compromise"] * (len(curve) - 2), "point")
    return Tradeoff(
        robot=first.cell.robot.name,
        choices=tuple(choice_of(first, *each) for each in zip(names, curve, strict=True)),
        seconds=time.perf_counter() - began,
        notices=tuple(dict.fromkeys((*first.notices, *last.notices))),
        provenance=Provenance.of(first.cell.robot, first.data, settings),
    )


def hopeless(fit: Fit, began: float, settings: dict[str, Any]) -> Tradeoff:
    """Least squares alone: with errors of that size the worst point is searched for minutes."""
    choice = Choice(
        "sum", 1.0, fit.cell, fit.accuracy["train"], fit.accuracy["holdout"], Status.FAILED
    )
    said = (*fit.notices, "the fit is too poor to look for compromises")
    provenance = Provenance.of(fit.cell.robot, fit.data, settings)
    return Tradeoff(fit.cell.robot.name, (choice,), time.perf_counter() - began, said, provenance)


def problem_of(fit: Fit) -> MinimaxProblem:
    """The worst-point problem on the training poses of a fit, with its identified parameters."""
    robot, train, effects = fit.nominal.robot, fit.train, fit.cell.effects
    model = model_of(robot, train)
    if effects.terms:
        model, _ = extended(model, robot, train, fit.cell.state, effects.terms)
    model = model.only(fit.identification.active)
    return minimax_problem(model, fit.cell.state, fit.distances, "two-sided", "point")


def choice_of(fit: Fit, name: str, compromise: Compromise) -> Choice:
    """A compromise as a cell, judged on the training and held-out poses of a fit."""
    robot, names, sessions = fit.nominal.robot, fit.cell.target_names, fit.cell.sessions
    scene = fit.cell.scene(fit.data)
    effects = fitted(fit.cell.effects.terms, scene, compromise.state.effects)
    cell = Cell.of(robot, compromise.state, names, effects, sessions)
    train, held = (accuracy(cell.error(fit.data.take(rows))) for rows in (~fit.held, fit.held))
    return Choice(name, compromise.share, cell, train, held, compromise.status)
