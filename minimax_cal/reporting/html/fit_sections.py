"""The sections about a calibration."""

from __future__ import annotations

import numpy as np

from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.suspects import table_of
from minimax_cal.fitting.uncertainty import Uncertainty
from minimax_cal.ground.errors import CalibrationError
from minimax_cal.ground.tables import Table, filled
from minimax_cal.judging.iso9283 import iso9283
from minimax_cal.modelling.effects.words import name_parameter
from minimax_cal.modelling.frames import tables_of
from minimax_cal.reporting.html.content import Block, Blocks, caveat, missing, text
from minimax_cal.reporting.html.error_charts import (
    Names,
    against_joints,
    boxes,
    cumulative,
    histogram,
    over_time,
)
from minimax_cal.reporting.html.more_charts import correlation_map, correlations, iterations
from minimax_cal.reporting.html.scene import workspace
from minimax_cal.reporting.html.sources import Sources
from minimax_cal.reporting.html.verdict import fit_verdict, why_not

SAME = 1e-6  # a file's own errors come back to this, or its effects need other columns [m]
MOST_SUSPECTS = 50
STRONG, MOST_ROWS = 0.5, 12  # correlations that have a row of their own, and how many
NO_POSES = "The file holds no poses, so that nothing can be drawn; write it again with its poses."


def names_of(sources: Sources) -> Names:
    """What before and after are called."""
    return ("nominal", "calibrated") if sources.fit else ("geometry alone", "with effects")


def accuracy(sources: Sources) -> Blocks:
    """How large the errors are, before and after, held out beside training."""
    blocks: list[Block] = []
    if sources.fit:
        blocks += [*fit_verdict(sources.fit), glance_table(sources), sources.fit.accuracy_table()]
        unknown = missing("95 % intervals of these numbers are not in the file.")
        blocks += filled(sources.fit.interval_table()) or (unknown,)
        blocks += filled(sources.fit.beyond.table())
    elif sources.gap:
        blocks += [glance_table(sources), sources.gap.ladder_table()]
    blocks.append(
        text(
            "An error is the distance between a measured target and where the model puts it. "
            "Held-out poses were not used for the fit: they tell what to expect of new poses "
            "measured in the same way. Training numbers are usually too good."
        )
    )
    names, poses = names_of(sources), sources.poses
    if poses:
        blocks += [histogram(poses, names), cumulative(poses, names), boxes(poses, names)]
    else:
        blocks.append(missing(NO_POSES))
    return blocks


def glance_table(sources: Sources) -> Table:
    """The numbers that matter, held-out ones first."""
    pairs = []
    if sources.fit:
        a = sources.fit.accuracy
        pairs = [(a["nominal"], a["holdout"]), (a["nominal_train"], a["train"])]
    elif sources.gap:
        first, last = sources.gap.ladder[1], sources.gap.ladder[-1]
        pairs = [(first.holdout, last.holdout), (first.train, last.train)]
    rows = (
        (f"{poses} poses, {what}", size := getattr(one, key), left := getattr(other, key),
         100.0 * (left / size - 1.0) if size else None)
        for poses, (one, other) in zip(("held-out", "training"), pairs, strict=False)
        for what, key in (("RMS", "rms_mm"), ("largest", "max_mm"))
        if other.poses
    )  # fmt: skip
    heads = (f"{name} mm .3f" for name in names_of(sources))
    return Table.made("At a glance", rows, "position error", *heads, "change % +.0f")


def parts_accuracy(sources: Sources) -> Blocks:
    """How large the errors of lengths, closures or poses are."""
    told = sources.relative
    return [text(told.headline()), *told.tables()[:-1]] if told else []


def parts_parameters(sources: Sources) -> Blocks:
    """The parameters of a calibration without coordinates."""
    return [sources.relative.tables()[-1]] if sources.relative else []


def parts_causes(sources: Sources) -> Blocks:
    """What the diagnosis of several instruments says; nothing without one."""
    causes = sources.causes
    return [text(causes.headline()), *causes.own_tables()] if causes else ()


def errors_in_space(sources: Sources) -> Blocks:
    """Where in space the errors are."""
    if sources.poses and sources.cell:
        return [workspace(sources.poses, sources.cell, names_of(sources))]
    return [missing(NO_POSES)]


def joints(sources: Sources) -> Blocks:
    """What the errors go with."""
    if not (poses := sources.poses):
        return [missing(NO_POSES)]
    names = names_of(sources)
    blocks: list[Block] = [against_joints(poses, names), *over_time(poses, names)]
    lacking = [name for name in ("time", "temperature") if name not in poses.data.columns]
    if lacking:
        blocks.append(missing(f"The measurements tell no {' and no '.join(lacking)}."))
    return blocks


def parameters(fit: Fit) -> Blocks:
    """What was identified, how surely, and what was not."""
    blocks: list[Block] = [*tables_of(fit.frames)]
    blocks += [fit.parameter_table(), *filled(fit.effect_table())]
    blocks.append(
        text(
            "Lengths in mm, angles in degrees, their changes and sigmas in mrad; base_x to base_rz "
            "correct the base of the drawn arm, along its own axes. Sigma is the standard "
            "deviation that measurement noise and the scatter of the residuals give the identified "
            "value; a dash means that the parameter was kept. Condition number of what was "
            f"identified: {fit.condition:.3g}."
        )
    )
    return [*blocks, *why_not(fit)]


def correlated(fit: Fit) -> Blocks:
    """How the uncertainties hang together."""
    if not fit.uncertainty.active.any():
        return [missing("No parameter was identified.")]
    note = text(
        "A correlation near 1 or -1 says that these poses tell the two parameters apart badly: "
        "each alone is uncertain, what they do together is not."
    )
    table = filled(correlation_table(fit.uncertainty))
    return [correlation_map(fit.uncertainty), *table, note]


def correlation_table(known: Uncertainty) -> Table:
    """The pairs of parameters that these poses tell apart worst."""
    codes, found = correlations(known)
    names = [name_parameter(code) for code in codes]
    one, other = np.triu_indices(len(found), 1)
    size = np.abs(found[one, other])
    rows = (
        (names[one[i]], names[other[i]], found[one[i], other[i]])
        for i in np.argsort(-np.nan_to_num(size), kind="stable")[:MOST_ROWS]
        if size[i] >= STRONG
    )
    return Table.made("Strongest correlations", rows, "parameter | with | correlation +.3f")


def solution(fit: Fit) -> Blocks:
    """How the numbers came about."""
    blocks: list[Block] = [
        text(
            f"Objective {fit.objective}, QP backend {fit.qp or 'none'}: "
            f"{fit.status.replace('_', ' ')}. {fit.solution()}"
        )
    ]
    if fit.trace or fit.minimax:
        blocks.append(iterations(fit))
    costs = ((i, 1e6 * cost) for i, cost in enumerate(fit.trace))
    blocks += filled(Table.made("Least squares", costs, "iterate d | cost mm^2 .6g"))
    if worst := fit.minimax:
        blocks += filled(
            Table.of("Steps of the minimax", worst.trace,
                     "iteration d | value=worst, of the start's .8f | violation .1e | "
                     "kkt=KKT residual .1e | length=step length .3g | backend=QP backend"),
            worst.table(),
            Table.of("Distances between targets, kept as measured", worst.distances,
                     "between=pair | measured=measured mm .4f | tolerance=tolerance mm .4f | "
                     "multiplier .4g"),
        )  # fmt: skip
        ends = ", ".join(f"{name} {value:.1e}" for name, value in vars(worst.kkt).items())
        blocks.append(text(f"Conditions of optimality (Karush-Kuhn-Tucker) at the end: {ends}."))
    else:
        blocks.append(missing("This fit took no minimax steps: least squares alone."))
    return blocks


def iso_values(fit: Fit) -> Blocks:
    """Values by the formulas of ISO 9283."""
    caution = caveat(
        "These are values by the standard's formulas from calibration data, not a test by the "
        "standard: the last table says which of its conditions the data do not meet."
    )
    try:
        tables = iso_tables(fit)
    except CalibrationError as error:
        return [missing(f"Not available: {error}.")]
    return [caution, *tables] if tables else [missing(NO_POSES)]


def iso_tables(fit: Fit) -> tuple[Table, ...]:
    """The tables of the values, none without poses.  Raises CalibrationError."""
    if not fit.data.poses:
        return ()
    if not np.nanmax(np.abs(fit.cell.error(fit.data) - fit.error), initial=0.0) <= SAME:
        raise CalibrationError(
            "the fit's effects need columns of the measurements that its file does not hold"
        )
    return iso9283({"nominal": fit.nominal, "calibrated": fit.cell}, fit.data, fit.held).tables()


def suspect_points(sources: Sources) -> Blocks:
    """Points that do not fit the others."""
    if not sources.fit or not sources.fit.suspects:
        return ()
    worst = sorted(sources.fit.suspects, key=lambda s: -s.score)[:MOST_SUSPECTS]
    what = caveat(
        "A suspect may be a wrong point, or a real effect that the fit lacks: no row should be "
        "deleted before the diagnosis has been read."
    )
    return [table_of(worst, sources.fit.data), what]
