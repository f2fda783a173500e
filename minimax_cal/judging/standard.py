"""A calibration by the formulas of ISO 9283, before and after, on poses it has and has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from minimax_cal.fitting.calibration import Calibration
from minimax_cal.ground.errors import OptionError
from minimax_cal.judging.iso9283 import Iso9283
from minimax_cal.judging.iso9283.result import iso9283 as characteristics
from minimax_cal.judging.saved import AFTER, BEFORE, open_fit


def iso9283(
    fit: Calibration | Path | str,
    data: Path | str | None = None,
    *,
    nominal: str = "",
    tcp: str | Sequence[float] = "centroid",
) -> Iso9283:
    """Pose and distance accuracy of a calibration by the formulas of ISO 9283, before and after.

    fit: a calibration, then judged on its own measurements, or its file.  data: file of the
    measurements; those in the fit's file unless given.  nominal: robot before the calibration, file
    or name; that of the fit unless given.  tcp: centroid of the targets, one target (smr1), or a
    point (3,) in the last frame [m].  Raises CalibrationError for wrong input.

    >>> print(mc.iso9283("fit.json").summary())
    """
    if isinstance(fit, Calibration):
        if data or nominal:
            raise OptionError("iso9283: data and nominal go with the file of a fit: save it first")
        cells = {BEFORE: fit.nominal, AFTER: fit.cell}
        return characteristics(cells, fit.data, fit.held, tcp)
    saved = open_fit(fit, data or "", nominal)
    found = characteristics(saved.cells, saved.data, saved.held, tcp)
    return replace(found, notices=(*saved.notices, *found.notices))
