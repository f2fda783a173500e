"""What the four pages leave out: errors point by point, correlations, ISO 9283, the solution ..."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.pose_rows import comes_back
from minimax_cal.fitting.uncertainty import Uncertainty
from minimax_cal.ground.errors import CalibrationError
from minimax_cal.ground.tables import Table, filled
from minimax_cal.ground.words import capitalise
from minimax_cal.judging.iso9283 import iso9283
from minimax_cal.modelling.effects.words import name_parameter, name_step
from minimax_cal.reporting.html.content import Block, Blocks, Section, caveat, missing, text
from minimax_cal.reporting.html.error_charts import against_joints, boxes, cumulative, over_time
from minimax_cal.reporting.html.more_charts import (
    budget_chart,
    correlation_map,
    correlations,
    curve_chart,
)
from minimax_cal.reporting.html.pages import NO_POSES, names_of
from minimax_cal.reporting.html.sources import Sources

STRONG, MOST_ROWS = 0.5, 12  # correlations that have a row of their own, and how many


def accuracy(sources: Sources) -> Blocks:
    """How the errors are distributed, before and after, held out beside training."""
    names, poses = names_of(sources), sources.poses
    if not poses:
        return [missing(NO_POSES)]
    note = text(
        "An error is the distance between a measured target and where the model puts it. Held-out "
        "poses were not used for the fit: they tell what to expect of new poses measured in the "
        "same way. Training numbers are usually too good."
    )
    return [note, *([cumulative(poses, names)] if sources.gap else []), boxes(poses, names)]


def joints(sources: Sources) -> Blocks:
    """What the errors go with."""
    if not (poses := sources.poses):
        return [missing(NO_POSES)]
    names, gap = names_of(sources), sources.gap
    blocks: list[Block] = [against_joints(poses, names)] if gap and gap.where else []
    blocks += over_time(poses, names)
    if gap and "residual" in gap.curves:
        blocks.append(curve_chart("residual", gap.curves["residual"], gap.held))
    lacking = [name for name in ("time", "temperature") if name not in poses.data.columns]
    if lacking:
        blocks.append(missing(f"The measurements tell no {' and no '.join(lacking)}."))
    return blocks


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
    if not comes_back(fit.cell.error(fit.data), fit.error):
        raise CalibrationError(
            "the fit's effects need columns of the measurements that its file does not hold"
        )
    return iso9283({"nominal": fit.nominal, "calibrated": fit.cell}, fit.data, fit.held).tables()


def simulator(sources: Sources) -> Blocks:
    """The arm in a simulator, at rest and along trajectories, and what it could not hold."""
    out: list[Block] = []
    if gap := sources.simulator:
        steps = [(name_step(r.name), r.holdout_rms_mm, r.holdout_max_mm) for r in gap.every]
        said = [rung.predicted_rms_mm for rung in gap.every]
        out += [budget_chart("simulator", steps, gap.floor, said), gap.table()]
        out += [caveat(f"Not in the model: {lost}.") for lost in gap.left_out]
    if motion := sources.motion:
        out += motion.tables()
        out += [text(f"{capitalise(said)}.") for said in motion.sentences()]
    written = (arm.written for arm in (gap, motion) if arm)
    return [*out, *(text(f"The corrected model is {name}.") for name in written if name)]


def other_tables(sources: Sources, shown: Sequence[Section]) -> Iterator[Section]:
    """Every table of the results that no section shows."""
    seen = [told(one) for part in shown for one in part.blocks if isinstance(one, Table)]
    fit, gap = sources.fit, sources.gap
    if fit and gap and fit.cell.effects.terms:
        seen.append(told(gap.parameter_table()))  # the fit has its own
    relative = sources.causes or sources.relative
    for kind, result in (("calibration", fit or relative), ("diagnosis", gap)):
        tables = result.tables() if result else ()
        left = tuple(one for one in tables if told(one) not in seen)
        yield Section(f"{kind}-tables", f"Other tables of the {kind}", left)


def told(table: Table) -> tuple[object, ...]:
    """What tells a table from others."""
    return table.title, table.cells()
