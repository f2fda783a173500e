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
from minimax_cal.fitting.pixels.data import PixelData
from minimax_cal.fitting.pixels.fit import PixelFit
from minimax_cal.fitting.pixels.model import PixelModel, Scene
from minimax_cal.fitting.pixels.options import SUM, WORST_CAMERA, WORST_TARGET, PixelOptions
from minimax_cal.fitting.solve import MIN_TARGET_WEIGHT, QP_TOLERANCE
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.facts import APART, Fact, derived
from minimax_cal.ground.tables import Table
from minimax_cal.ground.words import list_counts
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
class PixelMinimax:
    """min over the scene of the largest f_i, as `solvers.minimax` wants it.

    of: (N,) the number i of each pixel's function, -1 for none.  scale: (free,) divides a step's
    entries.  size: divides the f_i [px^2].
    """

    model: PixelModel
    of: Array
    scale: Array
    size: float = 1.0

    @property
    def lower(self) -> Array:
        """There is no constraint."""
        return NO_LIMITS

    upper = lower

    @staticmethod
    def at(model: PixelModel, of: Array, start: Scene) -> PixelMinimax:
        """Scaled at a start."""
        plain = PixelMinimax(model, of, np.ones(int(model.active.sum())))
        here = plain.linearise(start)
        size = max(float(here.f.max()), 1e-18)
        mean = here.curvature(np.full(len(here.f), 1.0 / len(here.f)))
        return replace(plain, scale=np.sqrt(np.maximum(np.diag(mean) / size, 1e-30)), size=size)

    @property
    def counts(self) -> Array:
        """(k,) pixels behind each function."""
        return np.bincount(self.of[self.of >= 0])

    def evaluate(self, x: Scene) -> tuple[Array, Array]:
        """f, and no constraint."""
        return self.values(x, self.model.errors(x)), NO_LIMITS

    def sizes(self, x: Scene) -> Array:
        """(k,) RMS of each function's pixels [px]."""
        square = (self.model.errors(x) ** 2).sum(axis=0)
        return np.asarray(np.sqrt(self.summed(square) / self.counts))

    def values(self, x: Scene, error: Array) -> Array:
        """f of the errors (2, N) at a scene."""
        off, weight = self.beside(x)
        known = float(weight @ off**2) / self.counts.sum()
        return np.asarray((self.summed((error**2).sum(axis=0)) / self.counts + known) / self.size)

    def linearise(self, x: Scene) -> Linear:
        """f and its derivatives; the curvature is Gauss-Newton's 2 J'J."""
        counts = self.counts
        error, jacobian = self.model.rows(x, self.model.active)
        off, weight = self.beside(x)
        pulled = self.summed((jacobian * error).sum(axis=1)) / counts
        slope = -2.0 * (pulled.T + weight * off / counts.sum())
        divisor = self.size * np.outer(self.scale, self.scale)

        def curvature(share: Array) -> Array:
            each = np.where(self.of >= 0, (share / counts)[self.of], 0.0)
            flat = (jacobian * np.sqrt(each)).reshape(len(jacobian), -1)
            known = np.diag(weight) * share.sum() / counts.sum()
            return np.asarray(2.0 * (flat @ flat.T + known) / divisor)

        f, slope = self.values(x, error), slope / (self.size * self.scale)
        return Linear(f, slope, NO_LIMITS, np.zeros((0, len(self.scale))), curvature)

    def step(self, x: Scene, d: Array) -> Scene:
        """The scene moved by a scaled step in the free parameters."""
        return self.model.step(x, (d / self.scale)[None])

    def beside(self, x: Scene) -> tuple[Array, Array]:
        """(free,) how far the parameters are from what the files know, and the weight of that."""
        model = self.model
        off = model.prior.mean - model.values(x)
        return off[model.active], model.prior.weight[model.active]

    def summed(self, each: Array) -> Array:
        """(..., k) sums over the pixels of each function.  each: (..., N)."""
        flat, kept = each.reshape(-1, each.shape[-1]), self.of >= 0
        sums = [np.bincount(self.of[kept], row[kept]) for row in flat]
        return np.array(sums).reshape(*each.shape[:-1], -1)


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
    data: PixelData, fit: PixelFit, options: PixelOptions
) -> tuple[PixelFit, WorstPixels | None, tuple[str, ...]]:
    """The minimax from a fit of the sum, where the objective asks for one, and notices.

    data: the training pixels.
    """
    if options.objective == SUM or fit.found.status[0] is Status.FAILED:
        return fit, None, ()
    label = OF[options.objective](data)
    seen, number = np.unique(label[fit.model.weight > 0.0], return_inverse=True)
    of = np.full(data.count, -1)
    of[fit.model.weight > 0.0] = number
    problem = PixelMinimax.at(fit.model, of, fit.scene)
    qp, notices = solver_of(options.qp, QP_TOLERANCE)
    best: Optimum[Scene] = minimax.solve(problem, fit.scene, qp)
    if best.status is Status.STALLED and best.value * problem.size < MAX_ROUNDING**2:
        best = replace(best, status=Status.CONVERGED)
    before, after = (problem.sizes(x) for x in (fit.scene, best.x))
    names = data.parts if options.objective == WORST_TARGET else [c.name for c in data.cameras]
    functions = tuple(names[i] for i in seen)
    worst = WorstPixels(functions, after, best.mu, float(before.max()), best.kkt, best.answered)
    heavy = np.maximum(best.mu, MIN_TARGET_WEIGHT) * problem.counts.sum() / problem.counts
    share = np.where(of >= 0, heavy[of], 0.0)
    found = replace(fit.found, status=(best.status,), iterations=np.array([best.iterations]))
    notes = tuple(f"QP: {note}" for note in best.notes)
    return replace(fit, scene=best.x, found=found, share=share), worst, (*notices, *notes)
