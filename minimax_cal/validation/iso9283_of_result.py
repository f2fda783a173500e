"""A calibration by the formulas of ISO 9283, before and after, on poses it has and has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from minimax_cal.fitting.opened_results import ResultOrFile
from minimax_cal.validation.evaluation import open_saved_result
from minimax_cal.validation.iso9283 import Iso9283
from minimax_cal.validation.iso9283.result import compute_iso9283 as characteristics


def iso9283(
    fit: ResultOrFile,
    data: Path | str | None = None,
    *,
    nominal: str = "",
    rung: int | None = None,
    tcp: str | Sequence[float] = "centroid",
) -> Iso9283:
    """Pose and distance accuracy of a calibration by the formulas of ISO 9283, before and after.

    Parameters
    ----------
    fit
        A calibration, a diagnosis, a relative calibration, or the file of one.
    data
        File of the measurements; the fit's own unless given.
    nominal
        Robot before the calibration, file or name; that of the fit unless given.
    rung
        Of a diagnosis, the last unless given.
    tcp
        Centroid of the targets, one target (smr1), or a point (3,) in the last frame [m].

    Returns
    -------
    Iso9283
        Values by the clauses of the standard, before and after.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.iso9283("fit.json").summary())
    """
    saved = open_saved_result(fit, data or "", nominal, rung)
    found = characteristics(saved.cells, saved.data, saved.held, tcp)
    return replace(found, notices=(*saved.notices, *found.notices))
