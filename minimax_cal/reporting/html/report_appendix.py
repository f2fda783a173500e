"""What the four pages leave out: errors point by point, correlations, ISO 9283, the solution ..."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from minimax_cal.core.display_text import capitalise_sentence
from minimax_cal.core.errors import CalibrationError
from minimax_cal.core.tables import Table, drop_empty_tables
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.pose_records import are_errors_reproduced
from minimax_cal.fitting.uncertainty import Uncertainty
from minimax_cal.modelling.effects.effect_names import format_budget_step, format_parameter
from minimax_cal.reporting.html.diagnosis_charts import (
    build_budget_chart,
    build_correlation_map,
    build_curve_chart,
    identified_correlations,
)
from minimax_cal.reporting.html.error_charts import (
    build_cumulative_error_chart,
    build_error_by_joint_chart,
    build_error_over_time_charts,
    build_target_box_chart,
)
from minimax_cal.reporting.html.report_content import (
    ReportBlock,
    ReportBlocks,
    ReportSection,
    build_caveat_note,
    build_missing_note,
    build_text_note,
)
from minimax_cal.reporting.html.report_pages import NO_POSES_NOTE, before_and_after_names
from minimax_cal.reporting.html.report_sources import ReportSources
from minimax_cal.validation.iso9283 import compute_iso9283

MIN_LISTED_CORRELATION, MAX_CORRELATION_ROWS = (
    0.5,
    12,
)  # correlations that have a row of their own, and how many


def build_error_distribution_blocks(sources: ReportSources) -> ReportBlocks:
    """How the errors are distributed, before and after, held out beside training."""
    names, poses = before_and_after_names(sources), sources.poses
    if not poses:
        return [build_missing_note(NO_POSES_NOTE)]
    note = build_text_note(
        "An error is the distance between a measured target and where the model puts it. Held-out "
        "poses were not used for the fit: they tell what to expect of new poses measured in the "
        "same way. Training numbers are usually too good."
    )
    return [
        note,
        *([build_cumulative_error_chart(poses, names)] if sources.gap else []),
        build_target_box_chart(poses, names),
    ]


def build_error_trend_blocks(sources: ReportSources) -> ReportBlocks:
    """What the errors go with."""
    if not (poses := sources.poses):
        return [build_missing_note(NO_POSES_NOTE)]
    names, gap = before_and_after_names(sources), sources.gap
    blocks: list[ReportBlock] = (
        [build_error_by_joint_chart(poses, names)] if gap and gap.where else []
    )
    blocks += build_error_over_time_charts(poses, names)
    if gap and "residual" in gap.curves:
        blocks.append(build_curve_chart("residual", gap.curves["residual"], gap.held))
    lacking = [name for name in ("time", "temperature") if name not in poses.data.columns]
    if lacking:
        blocks.append(build_missing_note(f"The measurements tell no {' and no '.join(lacking)}."))
    return blocks


def build_correlation_blocks(fit: Fit) -> ReportBlocks:
    """How the uncertainties hang together."""
    if not fit.uncertainty.active.any():
        return [build_missing_note("No parameter was identified.")]
    note = build_text_note(
        "A correlation near 1 or -1 says that these poses tell the two parameters apart badly: "
        "each alone is uncertain, what they do together is not."
    )
    table = drop_empty_tables(build_correlation_table(fit.uncertainty))
    return [build_correlation_map(fit.uncertainty), *table, note]


def build_correlation_table(uncertainty: Uncertainty) -> Table:
    """The pairs of parameters that these poses tell apart worst."""
    codes, found = identified_correlations(uncertainty)
    names = [format_parameter(code) for code in codes]
    one, other = np.triu_indices(len(found), 1)
    size = np.abs(found[one, other])
    rows = (
        (names[one[i]], names[other[i]], found[one[i], other[i]])
        for i in np.argsort(-np.nan_to_num(size), kind="stable")[:MAX_CORRELATION_ROWS]
        if size[i] >= MIN_LISTED_CORRELATION
    )
    return Table.from_rows("Strongest correlations", rows, "parameter | with | correlation +.3f")


def build_solution_blocks(fit: Fit) -> ReportBlocks:
    """How the numbers came about."""
    blocks: list[ReportBlock] = [
        build_text_note(
            f"Objective {fit.objective}, QP backend {fit.qp or 'none'}: "
            f"{fit.status.replace('_', ' ')}. {fit.describe_solution()}"
        )
    ]
    costs = ((i, 1e6 * cost) for i, cost in enumerate(fit.trace))
    blocks += drop_empty_tables(
        Table.from_rows("Least squares", costs, "iterate d | cost mm^2 .6g")
    )
    if worst := fit.minimax:
        blocks += drop_empty_tables(
            Table.from_records("Steps of the minimax", worst.trace,
                     "iteration d | value=worst, of the start's .8f | violation .1e | "
                     "kkt=KKT residual .1e | length=step length .3g | backend=QP backend"),
            worst.table(),
            Table.from_records("Distances between targets, kept as measured", worst.distances,
                     "target_pair_text=pair | measured=measured mm .4f | "
                     "tolerance=tolerance mm .4f | "
                     "multiplier .4g"),
        )  # fmt: skip
        ends = ", ".join(f"{name} {value:.1e}" for name, value in vars(worst.kkt).items())
        blocks.append(
            build_text_note(f"Conditions of optimality (Karush-Kuhn-Tucker) at the end: {ends}.")
        )
    else:
        blocks.append(build_missing_note("This fit took no minimax steps: least squares alone."))
    return blocks


def build_iso9283_blocks(fit: Fit) -> ReportBlocks:
    """Values by the formulas of ISO 9283."""
    caution = build_caveat_note(
        "These are values by the standard's formulas from calibration data, not a test by the "
        "standard: the last table says which of its conditions the data do not meet."
    )
    try:
        tables = build_iso9283_tables(fit)
    except CalibrationError as error:
        return [build_missing_note(f"Not available: {error}.")]
    return [caution, *tables] if tables else [build_missing_note(NO_POSES_NOTE)]


def build_iso9283_tables(fit: Fit) -> tuple[Table, ...]:
    """The tables of the values, none without poses.  Raises CalibrationError."""
    if not fit.data.poses:
        return ()
    if not are_errors_reproduced(fit.cell.error(fit.data), fit.error):
        raise CalibrationError(
            "the fit's effects need columns of the measurements that its file does not hold"
        )
    return compute_iso9283(
        {"nominal": fit.nominal, "calibrated": fit.cell}, fit.data, fit.held
    ).tables()


def build_simulator_blocks(sources: ReportSources) -> ReportBlocks:
    """The arm in a simulator, at rest and along trajectories, and what it could not hold."""
    out: list[ReportBlock] = []
    if gap := sources.simulator:
        steps = [
            (format_budget_step(r.name), r.holdout_rms_mm, r.holdout_max_mm) for r in gap.all_steps
        ]
        said = [rung.predicted_rms_mm for rung in gap.all_steps]
        out += [build_budget_chart("simulator", steps, gap.floor, said), gap.table()]
        out += [build_caveat_note(f"Not in the model: {lost}.") for lost in gap.left_out]
    if motion := sources.motion:
        out += motion.tables()
        out += [build_text_note(f"{capitalise_sentence(said)}.") for said in motion.sentences()]
    written = (arm.written for arm in (gap, motion) if arm)
    return [*out, *(build_text_note(f"The corrected model is {name}.") for name in written if name)]


def find_tables_not_shown(
    sources: ReportSources, sections: Sequence[ReportSection]
) -> Iterator[ReportSection]:
    """Every table of the results that no section shows."""
    seen = [
        table_identity(one) for part in sections for one in part.blocks if isinstance(one, Table)
    ]
    fit, gap = sources.fit, sources.gap
    if fit and gap and fit.cell.effects.terms:
        seen.append(table_identity(gap.parameter_table()))  # the fit has its own
    relative = sources.causes or sources.relative
    for kind, result in (("calibration", fit or relative), ("diagnosis", gap)):
        tables = result.tables() if result else ()
        left = tuple(one for one in tables if table_identity(one) not in seen)
        yield ReportSection(f"{kind}-tables", f"Other tables of the {kind}", left)


def table_identity(table: Table) -> tuple[object, ...]:
    """What tells a table from others."""
    return table.title, table.formatted_cells()
