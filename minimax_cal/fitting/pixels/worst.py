"""The minimax in pixels: the worst target, or the worst camera, as good as it can be made.

f_i is the mean square of the pixels of one target in one camera, or of one camera.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from minimax_cal.fitting.pixels.fit import PixelFit
from minimax_cal.fitting.pixels.options import SUM, WORST_CAMERA, WORST_TARGET, PixelOptions
from minimax_cal.fitting.several.worst import Worst, least_worst
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.facts import Fact
from minimax_cal.instruments.pixels import PixelData
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers.status import Status

MAX_ROUNDING = 1e-6  # an error below is rounding: pixels that were computed, not seen [px]

OF: Mapping[str, Callable[[PixelData], Array]] = {  # (N,) whose mean square a pixel is part of
    WORST_TARGET: lambda data: data.part,
    WORST_CAMERA: lambda data: data.camera,
}


@dataclass(frozen=True, eq=False)
class WorstPixels(Worst):
    """What the minimax rests on: targets in a camera, or cameras.  size, before: [px]."""

    UNIT: ClassVar[tuple[str, float]] = ("px", 1.0)

    size: Annotated[Array, Fact(key="rms_px")]
    before: Annotated[float, Fact(key="sum_largest_rms_px")]


def fit_worst(
    fit: PixelFit, options: PixelOptions
) -> tuple[PixelFit, WorstPixels | None, tuple[str, ...]]:
    """The minimax from a fit of the sum, where the objective asks for one, and notices."""
    if options.objective == SUM or fit.found.status[0] is Status.FAILED:
        return fit, None, ()
    images, data, counted = fit.images, fit.images.pixels, fit.images.counted
    seen, number = np.unique(OF[options.objective](data)[counted], return_inverse=True)
    number = number.reshape(-1)
    of = np.full(data.count, -1)
    of[counted] = number
    rows = np.concatenate([of, of, np.full(images.lens_rows, -2)])
    best, share, notes = least_worst(fit.problem, rows, 2, fit.state, options.qp, MAX_ROUNDING)

    def sizes(x: State) -> Array:
        square = (fit.problem.errors(x)[:, counted] ** 2).sum(axis=0)
        return np.asarray(np.sqrt(np.bincount(number, square) / np.bincount(number)))

    names = data.parts if options.objective == WORST_TARGET else [c.name for c in data.cameras]
    worst = WorstPixels.of([names[i] for i in seen], sizes(fit.state), sizes(best.x), best)
    found = replace(fit.found, status=(best.status,), iterations=np.array([best.iterations]))
    return replace(fit, state=best.x, found=found, share=share[: data.count]), worst, notes
