"""The tables of a calibration, from its file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from minimax_cal.fitting.fit import Fit, WorstCase
from minimax_cal.fitting.uncertainty import Uncertainty
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.measuring.accuracy import Accuracy
from minimax_cal.modelling.effects.words import name_parameter
from minimax_cal.reporting.html.sources import Sources

STRONG = 0.5  # correlations from here on have a row of their own
MOST_ROWS = 12


def glance_table(sources: Sources) -> Table:
    """The numbers that matter, held-out ones first."""
    rows: list[tuple[Cell, ...]] = []
    header = ("position error", "nominal mm", "calibrated mm", "change %")
    if sources.fit:
        a = sources.fit.accuracy
        rows += compared("held-out poses", a["nominal"], a["holdout"])
        rows += compared("training poses", a["nominal_train"], a["train"])
    elif sources.gap:
        first, last = sources.gap.ladder[1], sources.gap.ladder[-1]
        rows += compared("held-out poses", first.holdout, last.holdout)
        rows += compared("training poses", first.train, last.train)
        header = ("position error", "geometry alone mm", "with effects mm", "change %")
    return Table("At a glance", header, tuple(rows), ("", ".3f", ".3f", "+.0f"))


def compared(name: str, one: Accuracy, other: Accuracy) -> list[tuple[Cell, ...]]:
    """RMS and largest error before and after, on some poses; none without poses."""
    if not other.poses:
        return []
    return [
        (f"{name}, {what}", before, after, 100.0 * (after / before - 1.0) if before else math.nan)
        for what, before, after in (
            ("RMS", one.rms_mm, other.rms_mm),
            ("largest", one.max_mm, other.max_mm),
        )
    ]


def correlations(known: Uncertainty) -> tuple[tuple[str, ...], Array]:
    """Names of the identified parameters, and their correlations; NaN without a variance."""
    place = np.flatnonzero(known.active)
    names = tuple(known.names.all[i] for i in place)
    return names, known.correlation[np.ix_(place, place)]


def correlation_table(known: Uncertainty) -> Table:
    """The pairs of parameters that these poses tell apart worst."""
    codes, found = correlations(known)
    names = [name_parameter(code) for code in codes]
    one, other = np.triu_indices(len(found), 1)
    size = np.abs(found[one, other])
    order = [int(i) for i in np.argsort(-np.nan_to_num(size), kind="stable")[:MOST_ROWS]]
    rows = tuple(
        (
            names[one[i]],
            names[other[i]],
            float(found[one[i], other[i]]),
        )
        for i in order
        if size[i] >= STRONG
    )
    return Table("Strongest correlations", ("parameter", "with", "correlation"), rows,
                 ("", "", "+.3f"))  # fmt: skip


def distance_table(worst: WorstCase) -> Table:
    """Distances between targets that the minimax keeps."""
    title = "Distances between targets, kept as measured"
    return Table.of(title, worst.distances, "between=pair", "measured=measured mm .4f",
                    "tolerance=tolerance mm .4f", "multiplier .4g")  # fmt: skip


def iteration_table(worst: WorstCase) -> Table:
    """Every step of the minimax, with the QP solver that answered."""
    return Table.of("Steps of the minimax", worst.trace, "iteration d",
                    "value=worst, of the start's .8f", "violation .1e", "kkt=KKT residual .1e",
                    "length=step length .3g", "backend=QP backend")  # fmt: skip


def cost_table(fit: Fit) -> Table:
    """The cost at each iterate of the least squares."""
    rows = tuple((i, 1e6 * cost) for i, cost in enumerate(fit.trace))
    return Table("Least squares", ("iterate", "cost mm^2"), rows, ("d", ".6g"))


def settings_table(title: str, settings: Mapping[str, Any]) -> Table:
    """Settings of a run, as they were."""
    rows = tuple((name, words(value)) for name, value in settings.items())
    return Table(title, ("setting", "value"), rows)


def words(value: Any) -> str:
    """A setting as text."""
    if value is None:
        return "default"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    if isinstance(value, dict):
        return ", ".join(f"{key} = {part}" for key, part in value.items()) or "none"
    return str(value)
