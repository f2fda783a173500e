"""The tables of a calibration, from its file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.reporting.html.schema import Covariance, FitFile, ParameterLine, Scores, Suspect
from minimax_cal.reporting.html.sources import Fit, Sources

MILLI = {"mm": (1.0, "mm"), "rad": (1e3, "mrad"), "m": (1e3, "mm")}
STRONG = 0.5  # correlations from here on have a row of their own
MOST_ROWS = 12


def interval_header(scores: Sequence[Scores], kind: str) -> tuple[str, ...]:
    """Columns for the intervals of a number, where any is known."""
    found = [getattr(s, f"{kind.lower()}_ci95_mm") for s in scores]
    known = any(math.isfinite(end) for ends in found for end in ends)
    return (f"{kind} from mm", f"{kind} to mm") if known else ()


def accuracy_rows(fit: Fit) -> tuple[tuple[str, Scores], ...]:
    """What is compared: held-out poses beside training poses, nominal beside calibrated."""
    a = fit.content.accuracy
    return (
        ("held out, nominal", a.nominal),
        ("held out, calibrated", a.holdout),
        ("training, nominal", a.nominal_train),
        ("training, calibrated", a.train),
    )


def accuracy_table(fit: Fit) -> Table:
    """Accuracy before and after, held out and training, with intervals where the file has them."""
    named = accuracy_rows(fit)
    every = [scores for _, scores in named]
    spread = interval_header(every, "RMS")
    tails = interval_header(every, "max")
    rows: list[tuple[Cell, ...]] = [
        (
            name,
            s.poses,
            s.rms_mm,
            *(s.rms_ci95_mm if spread else ()),
            s.mean_mm,
            s.max_mm,
            *(s.max_ci95_mm if tails else ()),
            *(
                math.sqrt(f / m) if m else math.nan
                for f, m in zip(s.sse_mm2, s.points, strict=True)
            ),
        )
        for name, s in named
    ]
    targets = tuple(f"{name} RMS mm" for name in fit.cell.target_names)
    header = ("poses", "count", "RMS mm", *spread, "mean mm", "max mm", *tails, *targets)
    formats = ("", "d", *[".4f"] * (len(header) - 2))
    return Table("Position error (distance between measured and predicted points)", header,
                 tuple(rows), formats)  # fmt: skip


def glance_table(sources: Sources) -> Table:
    """The numbers that matter, held-out ones first."""
    rows: list[tuple[Cell, ...]] = []
    for fit in sources.fits:
        a = fit.content.accuracy
        for name, one, other in (
            ("held-out poses", a.nominal, a.holdout),
            ("training poses", a.nominal_train, a.train),
        ):
            rows += compared(name, one, other)
    header = ("position error", "nominal mm", "calibrated mm", "change %")
    if not sources.fits:
        ladder = sources.gaps[0].content.gap.ladder
        first, last = ladder[1], ladder[-1]
        rows += compared("held-out poses", first.holdout, last.holdout)
        rows += compared("training poses", first.train, last.train)
        header = ("position error", "geometry alone mm", "with effects mm", "change %")
    return Table("At a glance", header, tuple(rows), ("", ".3f", ".3f", "+.0f"))


def compared(name: str, one: Scores, other: Scores) -> list[tuple[Cell, ...]]:
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


def scaled(p: ParameterLine) -> tuple[float, str]:
    """Factor and unit in which people read a parameter."""
    return MILLI.get(p.unit, (1.0, p.unit))


def geometric(content: FitFile) -> list[ParameterLine]:
    """The parameters of geometry, base and targets; those of effects have a colon."""
    return [p for p in content.parameters if ":" not in p.name]


def parameter_table(content: FitFile) -> Table:
    """Every parameter with its nominal value, change and sigma."""
    rows = []
    for p in geometric(content):
        scale, unit = scaled(p)
        change = (p.value - p.nominal) * scale
        rows.append((p.name, unit, p.nominal * scale, p.value * scale, change, p.sigma * scale,
                     "yes" if p.identifiable else "no"))  # fmt: skip
    return Table(
        "Parameters",
        ("name", "unit", "nominal", "calibrated", "change", "sigma", "identified"),
        tuple(rows),
        ("", "", ".4f", ".4f", "+.4f", ".4f", ""),
    )


def effect_parameters(content: FitFile) -> Table:
    """Parameters of effects beyond geometry; empty without any."""
    rows = tuple(
        (p.name, p.unit, p.value, p.sigma, "yes" if p.identifiable else "no")
        for p in content.parameters
        if ":" in p.name
    )
    header = ("effect", "unit", "value", "sigma", "identified")
    return Table("Effects beyond geometry, fitted with it", header, rows,
                 ("", "", ".4g", ".2g", ""))  # fmt: skip


def kept_table(content: FitFile) -> Table:
    """What was not identified, and why."""
    rows = []
    for p in content.parameters:
        if not p.identifiable:
            scale, unit = scaled(p)
            rows.append((p.name, p.value * scale, unit, p.reason or "no reason was recorded"))
    return Table("Not identified: kept at the nominal value",
                 ("parameter", "kept at", "unit", "because"), tuple(rows),
                 ("", ".4f", "", ""))  # fmt: skip


def correlations(covariance: Covariance) -> Array:
    """(p, p) correlations; NaN where a variance is zero or not known."""
    rows = np.array(covariance.rows, dtype=float)
    size = len(covariance.names)
    if rows.shape != (size, size):
        raise ValueError(f"{size} names for a covariance of shape {rows.shape}")
    sigma = np.sqrt(np.maximum(np.diag(rows), 0.0))
    sigma = np.where(sigma > 0.0, sigma, np.nan)
    return np.asarray(rows / np.outer(sigma, sigma))


def correlation_table(covariance: Covariance) -> Table:
    """The pairs of parameters that these poses tell apart worst."""
    found = correlations(covariance)
    one, other = np.triu_indices(len(found), 1)
    size = np.abs(found[one, other])
    order = [int(i) for i in np.argsort(-np.nan_to_num(size), kind="stable")[:MOST_ROWS]]
    rows = tuple(
        (covariance.names[one[i]], covariance.names[other[i]], float(found[one[i], other[i]]))
        for i in order
        if size[i] >= STRONG
    )
    return Table("Strongest correlations", ("parameter", "with", "correlation"), rows,
                 ("", "", "+.3f"))  # fmt: skip


def multiplier_table(content: FitFile) -> Table:
    """Which targets or points the minimax rests on."""
    best = content.minimax
    rows = tuple(
        (name, mu, "yes" if name in best.active else "no")
        for name, mu in zip(best.functions, best.multipliers, strict=True)
    )
    header = ("error of", "multiplier", "is the worst")
    return Table("Multipliers of the minimax (they sum to one)", header, rows, ("", ".4f", ""))


def distance_table(content: FitFile) -> Table:
    """Distances between targets that the minimax keeps."""
    rows = tuple(
        (" - ".join(d.pair), d.measured_mm, d.tolerance_mm, d.multiplier)
        for d in content.minimax.distances
    )
    return Table("Distances between targets, kept as measured",
                 ("pair", "measured mm", "tolerance mm", "multiplier"), rows,
                 ("", ".4f", ".4f", ".4g"))  # fmt: skip


def iteration_table(content: FitFile) -> Table:
    """Every step of the minimax, with the QP solver that answered."""
    rows = tuple(
        (s.iteration, s.value, s.violation, s.kkt, s.length, s.backend)
        for s in content.minimax.trace
    )
    header = ("iteration", "worst, of the start's", "violation", "KKT residual", "step length",
              "QP backend")  # fmt: skip
    return Table("Steps of the minimax", header, rows, ("d", ".8f", ".1e", ".1e", ".3g", ""))


def cost_table(content: FitFile) -> Table:
    """The cost at each iterate of the least squares."""
    rows = tuple((i, cost) for i, cost in enumerate(content.trace_mm2))
    return Table("Least squares", ("iterate", "cost mm^2"), rows, ("d", ".6g"))


def suspect_table(suspects: Sequence[Suspect]) -> Table:
    """Points that do not fit the others."""
    rows = tuple(
        (s.line, s.target, s.distance_mm, s.score, s.chance, "yes" if s.together else "no")
        for s in suspects
    )
    header = ("line of the file", "target", "distance mm", "score", "chance", "its whole pose")
    return Table("Suspect points", header, rows, ("d", "", ".4f", ".1f", ".1g", ""))


def settings_table(title: str, settings: dict[str, Any]) -> Table:
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
