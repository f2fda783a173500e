"""The minimax in pixels: the worst target, or the worst camera, as good as it can be made.

f_i is the mean square of the pixels of one target in one camera, or of one camera, with the share
of what the files know that a mean square has.  Values are divided by their size at the least
squares, from which the search starts, and parameters scaled to unit curvature.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from minimax_cal.fitting.options import solver_of
from minimax_cal.fitting.pixels.fit import PixelFit
from minimax_cal.fitting.pixels.options import SUM, WORST_CAMERA, WORST_TARGET, PixelOptions
from minimax_cal.fitting.several.stack import Squares
from minimax_cal.fitting.solve import MIN_TARGET_WEIGHT, QP_TOLERANCE
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.facts import APART, Fact, derived
from minimax_cal.ground.tables import Table
from minimax_cal.ground.words import list_counts
from minimax_cal.instruments.pixels import PixelData
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers import minimax
from minimax_cal.solvers.minimax import Kkt, Linear, Optimum
from minimax_cal.solvers.status import Status

ACTIVE = 1e-6  # relative to the largest: functions so near to it decide
MAX_ROUNDING = 1e-6  # an error below is rounding: pixels that were computed, not seen [px]
NO_LIMITS: Array = np.zeros(0)

OF: Mapping[str, Callable[[PixelData], Array]] = {  # (N,) whose mean square a pixel is part of
    WORST_TARGET: lambda data: data.part,
    WORST_CAMERA: lambda data: data.camera,
}


@dataclass(frozen=True, eq=False)
class RowMinimax:
    """min over the state of the largest f_i of groups of rows, as `solvers.minimax` wants it.

    member: (k, r) how much each row's square counts in each f_i; known: the same of what is known
    of the arm.  scale: (free,) divides a step's entries.  size: divides the f_i.
    """

    problem: Squares
    member: Array
    known: float
    scale: Array
    size: float = 1.0

    @property
    def lower(self) -> Array:
        """There is no constraint."""
        return NO_LIMITS

    upper = lower

    @staticmethod
    def at(problem: Squares, of: Array, numbers: int, start: State) -> RowMinimax:
        """Mean squares, scaled at a start.

        of: (r,) which function each row is of, -1 for none, -2 for rows that all have their share
        of.  numbers: rows behind one square, as two of a pixel.
        """
        member = (of == np.arange(of.max() + 1)[:, None]).astype(float)
        member *= numbers / member.sum(axis=1, keepdims=True)
        known = numbers / np.count_nonzero(of >= 0)
        member[:, of == -2] = known
        plain = RowMinimax(problem, member, known, np.ones(int(problem.active.sum())))
        here = plain.linearise(start)
        size = max(float(here.f.max()), 1e-18)
        mean = here.curvature(np.full(len(here.f), 1.0 / len(here.f)))
        return replace(plain, scale=np.sqrt(np.maximum(np.diag(mean) / size, 1e-30)), size=size)

    def evaluate(self, x: State) -> tuple[Array, Array]:
        """f, and no constraint."""
        error, _ = self.problem.stack.rows(x, np.zeros(len(self.problem.active), dtype=bool))
        off, weight = self.beside(x)
        f = self.member @ error**2 + self.known * float(weight @ off**2)
        return f / self.size, NO_LIMITS

    def linearise(self, x: State) -> Linear:
        """f and its derivatives; the curvature is Gauss-Newton's 2 J'J."""
        error, jacobian = self.problem.stack.rows(x, self.problem.active)
        off, weight = self.beside(x)
        f = self.member @ error**2 + self.known * float(weight @ off**2)
        slope = -2.0 * ((self.member * error) @ jacobian.T + self.known * weight * off)
        divisor = self.size * np.outer(self.scale, self.scale)

        def curvature(share: Array) -> Array:
            gram = (jacobian * (share @ self.member)) @ jacobian.T
            return np.asarray(2.0 * (gram + self.known * share.sum() * np.diag(weight)) / divisor)

        none = np.zeros((0, len(self.scale)))
        return Linear(f / self.size, slope / (self.size * self.scale), NO_LIMITS, none, curvature)

    def step(self, x: State, d: Array) -> State:
        """The state moved by a scaled step in the free parameters."""
        return self.problem.step(x, d / self.scale)

    def beside(self, x: State) -> tuple[Array, Array]:
        """(free,) how far the parameters are from what is known of them, and the weight of that."""
        problem, known = self.problem, self.problem.known
        if known is None or not len(problem.weight):
            return np.zeros(len(self.scale)), np.zeros(len(self.scale))
        off = known.off(x, len(problem.active))
        return off[problem.active], problem.weight[problem.active]


@dataclass(frozen=True, eq=False)
class WorstPixels:
    """What the minimax rests on.

    functions: k names, of a target in a camera or of a camera.  size: (k,) their RMS [px].
    multiplier: (k,) how much each counts, of sum one.  before: the largest RMS of the sum [px].
    """

    functions: tuple[str, ...]
    size: Annotated[Array, Fact(key="rms_px")]
    multiplier: Annotated[Array, Fact(key="multipliers")]
    before: Annotated[float, Fact(key="sum_largest_rms_px")]
    kkt: Kkt
    answered: Annotated[Mapping[str, int], APART] = field(default_factory=dict)

    @derived()
    def active(self) -> tuple[str, ...]:
        """The functions that decide."""
        near = self.size**2 >= self.size.max() ** 2 * (1.0 - ACTIVE)
        return tuple(name for name, held in zip(self.functions, near, strict=True) if held)

    def sentence(self) -> str:
        """For people."""
        return (
            f"Worst of {len(self.functions)} in training: {self.before:.4f} px RMS -> "
            f"{self.size.max():.4f} px, held by {len(self.active)}; QPs: "
            f"{list_counts(self.answered)}."
        )

    def table(self) -> Table:
        """Every function, the heaviest first."""
        every = zip(self.functions, self.size, self.multiplier, strict=True)
        rows = sorted(every, key=lambda row: -row[2])
        return Table.made("what decides the minimax", rows, "target | RMS px .4f | multiplier .3f")


def fit_worst(
    fit: PixelFit, options: PixelOptions
) -> tuple[PixelFit, WorstPixels | None, tuple[str, ...]]:
    """The minimax from a fit of the sum, where the objective asks for one, and notices."""
    if options.objective == SUM or fit.found.status[0] is Status.FAILED:
        return fit, None, ()
    images, data, counted = fit.images, fit.images.pixels, fit.images.counted
    seen, number = np.unique(OF[options.objective](data)[counted], return_inverse=True)
    of = np.full(data.count, -1)
    of[counted] = number.reshape(-1)
    rows = np.concatenate([of, of, np.full(images.lens_rows, -2)])
    problem = RowMinimax.at(fit.problem, rows, 2, fit.state)
    qp, notices = solver_of(options.qp, QP_TOLERANCE)
    best: Optimum[State] = minimax.solve(problem, fit.state, qp)
    if best.status is Status.STALLED and best.value * problem.size < MAX_ROUNDING**2:
        best = replace(best, status=Status.CONVERGED)
    counts = np.bincount(number.reshape(-1))

    def sizes(x: State) -> Array:
        square = (fit.problem.errors(x)[:, counted] ** 2).sum(axis=0)
        return np.asarray(np.sqrt(np.bincount(number.reshape(-1), square) / counts))

    before, after = sizes(fit.state), sizes(best.x)
    names = data.parts if options.objective == WORST_TARGET else [c.name for c in data.cameras]
    functions = tuple(names[i] for i in seen)
    worst = WorstPixels(functions, after, best.mu, float(before.max()), best.kkt, best.answered)
    heavy = np.maximum(best.mu, MIN_TARGET_WEIGHT) * counts.sum() / counts
    share = np.where(of >= 0, heavy[of], 0.0)
    found = replace(fit.found, status=(best.status,), iterations=np.array([best.iterations]))
    notes = tuple(f"QP: {note}" for note in best.notes)
    return replace(fit, state=best.x, found=found, share=share), worst, (*notices, *notes)
