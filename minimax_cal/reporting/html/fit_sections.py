"""The sections about a calibration."""

from __future__ import annotations

import math

import numpy as np

from minimax_cal.ground.errors import CalibrationError
from minimax_cal.ground.tables import Table
from minimax_cal.judging.iso9283 import iso9283
from minimax_cal.reporting.html.content import Block, Section, caveat, missing, text
from minimax_cal.reporting.html.error_charts import (
    Names,
    against_joints,
    boxes,
    cumulative,
    histogram,
    over_time,
)
from minimax_cal.reporting.html.fit_tables import (
    accuracy_table,
    correlation_table,
    cost_table,
    distance_table,
    effect_parameters,
    iteration_table,
    kept_table,
    multiplier_table,
    parameter_table,
    suspect_table,
)
from minimax_cal.reporting.html.gap_tables import ladder_table
from minimax_cal.reporting.html.more_charts import correlation_map, iterations
from minimax_cal.reporting.html.scene import workspace
from minimax_cal.reporting.html.sources import Fit, Sources, reading
from minimax_cal.reporting.html.verdict import why_not

SAME = 1e-6  # a file's own errors come back to this, or its effects need other columns [m]
MOST_SUSPECTS = 50
NO_FIT = (
    "Not in this report: it was made without a calibration; give the file of `minimax-cal "
    "calibrate -o` as well."
)
NO_POSES = (
    "The file holds no poses, so that nothing can be drawn; write it again with this version of "
    "minimax-cal."
)


def filled(*tables: Table) -> tuple[Table, ...]:
    """The tables that have rows."""
    return tuple(table for table in tables if table.rows)


def names_of(sources: Sources) -> Names:
    """What before and after are called."""
    return ("nominal", "calibrated") if sources.fits else ("geometry alone", "with effects")


def accuracy_section(sources: Sources) -> Section:
    """How large the errors are, before and after, held out beside training."""
    blocks: list[Block] = []
    for fit in sources.fits:
        blocks.append(accuracy_table(fit))
        a = fit.content.accuracy
        told = any(math.isfinite(end) for _, s in a for end in s.rms_ci95_mm)
        blocks.append(
            text("From, to: 95 % intervals of the RMS and of the largest error.")
            if told
            else missing("95 % intervals of these numbers are not in the file.")
        )
    if not sources.fits:
        blocks += [ladder_table(gap.content) for gap in sources.gaps]
    blocks.append(
        text(
            "An error is the distance between a measured target and where the model puts it. "
            "Held-out poses were not used for the fit: they tell what to expect of new poses "
            "measured in the same way. Training numbers are usually too good."
        )
    )
    names = names_of(sources)
    for poses in sources.poses:
        blocks += [histogram(poses, names), cumulative(poses, names), boxes(poses, names)]
    if not sources.poses:
        blocks.append(missing(NO_POSES))
    return Section("accuracy", "Accuracy", tuple(blocks))


def workspace_section(sources: Sources) -> Section:
    """Where in space the errors are."""
    blocks: tuple[Block, ...] = tuple(
        workspace(poses, cell, names_of(sources))
        for poses in sources.poses
        for cell in sources.cells[:1]
    )
    note = missing(NO_POSES)
    return Section("workspace", "The errors in the workspace", blocks or (note,))


def joints_section(sources: Sources) -> Section:
    """What the errors go with."""
    blocks: list[Block] = []
    for poses in sources.poses:
        names = names_of(sources)
        blocks += [against_joints(poses, names), *over_time(poses, names)]
    for poses in sources.poses:
        told = poses.data.columns
        lacking = [name for name in ("time", "temperature") if name not in told]
        if lacking:
            blocks.append(missing(f"The measurements tell no {' and no '.join(lacking)}."))
    note = missing(NO_POSES)
    return Section("joints", "What the errors go with", tuple(blocks) or (note,))


def parameter_section(sources: Sources) -> Section:
    """What was identified, how surely, and what was not."""
    if not sources.fits:
        return Section("parameters", "Parameters", (missing(NO_FIT),))
    c = sources.fits[0].content
    kept = kept_table(c)
    blocks: list[Block] = [parameter_table(c), *filled(effect_parameters(c))]
    blocks.append(
        text(
            "Lengths in mm, angles in mrad. Sigma is the standard deviation that measurement noise "
            "and the scatter of the residuals give the identified value; a dash means that the "
            f"parameter was kept. Condition number of what was identified: {c.condition:.3g}."
        )
    )
    return Section("parameters", "Parameters", (*blocks, *filled(kept), *why_not(c)))


def correlation_section(sources: Sources) -> Section:
    """How the uncertainties hang together."""
    title = "How the parameters hang together"
    blocks: list[Block] = []
    for fit in sources.fits:
        covariance = fit.content.covariance
        with reading(fit.path, "covariance"):
            if covariance.names:
                blocks += [correlation_map(covariance), *filled(correlation_table(covariance))]
                blocks.append(
                    text(
                        "A correlation near 1 or -1 says that these poses tell the two parameters "
                        "apart badly: each alone is uncertain, what they do together is not."
                    )
                )
    note = missing("The file holds no covariance of the parameters." if sources.fits else NO_FIT)
    return Section("correlations", title, tuple(blocks) or (note,))


def solution_section(sources: Sources) -> Section:
    """How the numbers came about."""
    title = "How the fit was found"
    if not sources.fits:
        return Section("solution", title, (missing(NO_FIT),))
    fit = sources.fits[0]
    c = fit.content
    blocks: list[Block] = [
        text(
            f"Objective {c.objective}, QP backend {c.qp or 'none'}: {c.status.replace('_', ' ')} "
            f"after {c.iterations} iterations, {c.seconds:.2f} s."
        )
    ]
    with reading(fit.path, "minimax"):
        if c.trace_mm2 or c.minimax.trace:
            blocks.append(iterations(c))
        blocks += filled(cost_table(c), iteration_table(c), multiplier_table(c), distance_table(c))
    if c.minimax.kkt:
        ends = ", ".join(f"{name} {value:.1e}" for name, value in c.minimax.kkt.items())
        blocks.append(text(f"Conditions of optimality (Karush-Kuhn-Tucker) at the end: {ends}."))
    if not c.minimax.trace:
        blocks.append(missing("This fit took no minimax steps: least squares alone."))
    return Section("solution", title, tuple(blocks))


def iso_section(sources: Sources) -> Section:
    """Values by the formulas of ISO 9283."""
    title = "Values by the formulas of ISO 9283"
    if not sources.fits:
        return Section("iso9283", title, (missing(NO_FIT),))
    fit = sources.fits[0]
    caution = caveat(
        "These are values by the standard's formulas from calibration data, not a test by the "
        "standard: the last table says which of its conditions the data do not meet."
    )
    try:
        with reading(fit.path, "poses or effects"):
            tables = iso_tables(fit)
    except CalibrationError as error:
        return Section("iso9283", title, (missing(f"Not available: {error}."),))
    return Section("iso9283", title, (caution, *tables) if tables else (missing(NO_POSES),))


def iso_tables(fit: Fit) -> tuple[Table, ...]:
    """The tables of the values, none in an old file.  Raises CalibrationError."""
    for poses in fit.poses:
        for before in fit.nominal:
            told = 1e-3 * poses.after
            if not np.nanmax(np.abs(fit.cell.error(poses.data) - told), initial=0.0) <= SAME:
                raise CalibrationError(
                    "the fit's effects need columns of the measurements that its file does not hold"
                )
            found = iso9283({"nominal": before, "calibrated": fit.cell}, poses.data, poses.held)
            return found.tables()
    return ()


def suspects_section(sources: Sources) -> Section:
    """Points that do not fit the others."""
    found = [suspect for gap in sources.gaps for suspect in gap.content.suspects]
    found += [suspect for fit in sources.fits for suspect in fit.content.suspects]
    table = suspect_table(sorted(found, key=lambda s: -s.score)[:MOST_SUSPECTS])
    note = text("The files name no suspect points.")
    what = caveat(
        "A suspect may be a wrong point, or a real effect that the fit lacks: no row should be "
        "deleted before the diagnosis has been read."
    )
    return Section("suspects", "Suspect points", (table, what) if table.rows else (note,))
