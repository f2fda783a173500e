"""The report of a motion diagnosis: verdict, budget, friction and torques of a run left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import replace_invisible_and_bidi_characters
from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.core.tables import Table, drop_empty_tables
from minimax_cal.dynamics.laws import TORQUE_EFFECT_WORDS
from minimax_cal.dynamics.result import MotionDiagnosis
from minimax_cal.modelling.effects.effect_names import format_place
from minimax_cal.reporting.html.cell_facts import list_labelled_facts
from minimax_cal.reporting.html.chart_parts import (
    TRACE_LOOKS,
    build_axis,
    build_chart_layout,
    build_line_trace,
    build_log_or_linear_axis,
    build_panel_title,
    panel_domain,
    plotly_axis_name,
    plotly_layout_axis_name,
)
from minimax_cal.reporting.html.report_builder import (
    FILE_TABLE_COLUMNS,
    ReportRequest,
    build_program_version_table,
    list_signatures,
)
from minimax_cal.reporting.html.report_content import (
    ChartBlock,
    NoteBlock,
    ReportBlock,
    ReportDocument,
    ReportSection,
    build_caveat_note,
    build_text_note,
    escape_figure_label,
    join_pages_and_appendix,
    round_for_json,
)
from minimax_cal.reporting.html.report_sources import (
    ReportableResult,
    ResultFile,
    read_result_content,
)

MAX_JOINTS_ON_PAGE = 3  # joints that are drawn on a page, the worst ones
FRICTION_BAND_SIGMAS = 2.0  # standard deviations of a band
SPEED_AXIS_TITLE = "speed [rad/s, m/s]"


@dataclass(frozen=True, eq=False)
class MotionReportSource:
    """A motion diagnosis, and its file."""

    diagnosis: MotionDiagnosis
    file: ResultFile

    def list_terminal_lines(self) -> list[str]:
        """For a terminal."""
        return [self.diagnosis.headline()]

    failed_requirements = verdict_style = ""  # nothing is required of torques

    def tables(self) -> tuple[Table, ...]:
        """For a terminal."""
        return ()


def find_motion_diagnosis(results: Sequence[ReportableResult]) -> MotionReportSource | None:
    """The motion diagnosis among results; None where there is none.  Raises CalibrationError."""
    for result in filter(is_motion_diagnosis, results):
        content, path, digest = read_result_content(result)
        if len(results) > 1:
            raise CalibrationError(f"{path}: is a motion diagnosis; report it alone")
        found = MotionDiagnosis.from_dict(content, path)
        return MotionReportSource(found, ResultFile(found.KIND, path, digest))
    return None


def is_motion_diagnosis(result: ReportableResult) -> bool:
    """Whether a result is a motion diagnosis.  Raises CalibrationError for a file without JSON."""
    if isinstance(result, Path | str):
        return bool(read_result_content(result)[0].get("kind") == MotionDiagnosis.KIND)
    return isinstance(result, MotionDiagnosis)


def build_motion_report(source: MotionReportSource, request: ReportRequest) -> ReportDocument:
    """The whole report.  Raises OptionError for what is asked of positions."""
    for name, given in (("tolerance", request.limits), ("deliver", request.deliver),
                        ("step", request.rung is not None)):  # fmt: skip
        if given:
            raise OptionError(
                f"{name}= is of positions; a motion diagnosis is of torques: leave it"
            )
    found = source.diagnosis
    robot = found.arm.robot.name
    facts = [
        ("Robot", replace_invisible_and_bidi_characters(robot)),
        *list_labelled_facts(request.facts, None),
    ]
    facts += (
        [("Customer", replace_invisible_and_bidi_characters(request.customer))]
        if request.customer
        else []
    )
    facts += [("Date of this report", request.date), ("Held out", found.held_out)]
    facts += [("Logs", ", ".join(map(replace_invisible_and_bidi_characters, found.runs)))]
    worst = np.argsort(-np.array(found.budget[-1].holdout_rms_moving))
    sheets = (
        ReportSection("verdict", "Result", build_motion_verdict_blocks(found)),
        ReportSection("budget", "Error budget", build_motion_budget_tables(found)),
        ReportSection(
            "where",
            "Where the errors are",
            (
                *build_unexplained_torque_blocks(found),
                *build_joint_charts(found, worst[:MAX_JOINTS_ON_PAGE]),
            ),
        ),
        ReportSection("parameters", "Parameters", build_motion_effect_tables(found)),
    )
    rest = build_joint_charts(found, worst[MAX_JOINTS_ON_PAGE:])
    more = (
        ReportSection("torques", "Torques and friction of the other joints", rest),
        ReportSection(
            "untestable", "What could not be tested", build_untestable_effect_blocks(found)
        ),
        ReportSection("provenance", "Provenance", build_motion_provenance_tables(source)),
    )
    return ReportDocument(
        title=replace_invisible_and_bidi_characters(request.title)
        or f"Torques of {replace_invisible_and_bidi_characters(robot)}",
        robot=replace_invisible_and_bidi_characters(robot),
        facts=tuple(facts),
        signatures=list_signatures(
            replace_invisible_and_bidi_characters(request.author),
            replace_invisible_and_bidi_characters(request.customer),
        ),
        sections=join_pages_and_appendix(sheets, more, request.appendix),
        digest="",
        kind="Motion diagnosis",
    )


def build_motion_verdict_blocks(diagnosis: MotionDiagnosis) -> tuple[ReportBlock, ...]:
    """The answer, and what to bear in mind."""
    notices = (NoteBlock(one, "notice") for one in diagnosis.notices)
    return (
        NoteBlock(diagnosis.headline(), "verdict"),
        *notices,
        build_motion_budget_chart(diagnosis),
    )


def build_motion_budget_tables(diagnosis: MotionDiagnosis) -> tuple[ReportBlock, ...]:
    """Tables of all rows and of moving ones."""
    return diagnosis.budget_table(), diagnosis.budget_table("moving", "holdout_rms_moving")


def build_motion_budget_chart(diagnosis: MotionDiagnosis) -> ChartBlock:
    """What each step leaves, one panel a joint."""
    joints, steps = (
        len(diagnosis.curves),
        [step.name.replace("_", " ") for step in diagnosis.budget],
    )
    values = np.array([step.holdout_rms_moving for step in diagnosis.budget]).T
    traces: list[dict[str, Any]] = []
    layout = build_chart_layout(
        annotations=[build_panel_title(f"J{j + 1}", j, joints) for j in range(joints)]
    )
    for j in range(joints):
        trace = build_line_trace(
            "after", f"J{j + 1}", values[j], np.arange(len(steps)), panel_index=j
        )
        traces.append({**trace, "mode": "lines+markers", "showlegend": False})
        x = {
            **build_log_or_linear_axis(f"[{diagnosis.unit}]", values[j]),
            "domain": panel_domain(j, joints, 0.03),
        }
        y = build_axis(
            "",
            autorange="reversed",
            showticklabels=j == 0,
            tickmode="array",
            tickvals=list(range(len(steps))),
            ticktext=list(map(escape_figure_label, steps)),
        )
        if j:
            x["anchor"], y["anchor"] = plotly_axis_name("y", j), plotly_axis_name("x", j)
        layout |= {plotly_layout_axis_name("x", j): x, plotly_layout_axis_name("y", j): y}
    layout["margin"] = {**layout["margin"], "l": 170}
    says = "RMS torque that each step leaves of moving rows, on runs that its fit did not see."
    return ChartBlock("budget", "What each step leaves", says, tuple(traces), layout, 380)


def build_motion_effect_tables(diagnosis: MotionDiagnosis) -> tuple[ReportBlock, ...]:
    """Effects with their values, and what else they could be."""
    if not diagnosis.effects:
        return (build_text_note("No effect is shown by these logs."),)
    rows = (
        (
            one.words,
            f"{TORQUE_EFFECT_WORDS[a.effect]} {format_place(a.place)}",
            a.rho2,
            a.separate_with,
        )
        for one in diagnosis.effects
        for a in one.alternatives
    )
    columns = "effect | could be | similarity .2f | what tells them apart"
    return drop_empty_tables(
        diagnosis.effects_table(), Table.from_rows("Alternatives", rows, columns)
    )


def build_joint_charts(diagnosis: MotionDiagnosis, joint_indices: Array) -> tuple[ReportBlock, ...]:
    """Of some joints, a run left out and the friction curve."""
    return tuple(build_torque_and_friction_chart(diagnosis, int(j)) for j in joint_indices)


def build_torque_and_friction_chart(diagnosis: MotionDiagnosis, joint_index: int) -> ChartBlock:
    """Measured and predicted torque, and friction over speed with its band."""
    run, curve, unit = diagnosis.held_run, diagnosis.curves[joint_index], diagnosis.unit
    time, speed, friction, wide = (
        np.array(run.time),
        curve.speed,
        curve.torque,
        FRICTION_BAND_SIGMAS * curve.sigma,
    )
    colour, _, _, soft = TRACE_LOOKS["after"]
    band = {
        "type": "scatter", "mode": "lines", "name": "two standard deviations",
        "x": round_for_json(np.concatenate([speed, speed[::-1]])),
        "y": round_for_json(np.concatenate([friction + wide, (friction - wide)[::-1]])),
        "fill": "toself", "fillcolor": soft, "line": {"color": colour, "width": 0},
        "hoverinfo": "skip", "showlegend": False, "xaxis": "x2", "yaxis": "y2",
    }  # fmt: skip
    traces = (
        build_line_trace("before", "measured", time, run.measured[joint_index]),
        build_line_trace("after", "predicted without this run", time, run.predicted[joint_index]),
        band,
        build_line_trace("after", "friction", speed, friction, panel_index=1, showlegend=False),
    )
    layout = build_chart_layout(
        xaxis=build_axis("time [s]", domain=[0.0, 0.62]),
        yaxis=build_axis(f"J{joint_index + 1} [{unit}]"),
        xaxis2=build_axis(SPEED_AXIS_TITLE, domain=[0.72, 1.0], anchor="y2"),
        yaxis2=build_axis(f"friction [{unit}]", anchor="x2"),
    )
    left = diagnosis.budget[-1].holdout_rms_moving[joint_index]
    says = (
        f"Torque of joint {joint_index + 1} on a part of "
        f"{replace_invisible_and_bidi_characters(run.name)}, which the fit did not see "
        f"(it misses {left:.3g} {unit} RMS where the joint moves), and its friction over speed."
    )
    return ChartBlock(
        f"joint-{joint_index + 1}", f"Joint {joint_index + 1}", says, traces, layout, 320
    )


def build_unexplained_torque_blocks(diagnosis: MotionDiagnosis) -> tuple[ReportBlock, ...]:
    """What remains that follows something."""
    if not diagnosis.unexplained:
        return (build_text_note("What remains looks random."),)
    return (diagnosis.unexplained_table(),)


def build_untestable_effect_blocks(diagnosis: MotionDiagnosis) -> tuple[ReportBlock, ...]:
    """What these logs cannot tell, and the run that would."""
    if not diagnosis.not_testable:
        return (build_text_note("These logs test every effect."),)
    rows = (
        (TORQUE_EFFECT_WORDS[one.effect], one.place, one.needs) for one in diagnosis.not_testable
    )
    notes = [build_caveat_note(f"Too little motion: {one}.") for one in diagnosis.too_little]
    return (*notes, Table.from_rows("Not testable", rows, "effect | at | what would tell"))


def build_motion_provenance_tables(source: MotionReportSource) -> tuple[ReportBlock, ...]:
    """The file and the programs."""
    row = (
        "motion diagnosis",
        replace_invisible_and_bidi_characters(source.file.path),
        source.file.digest,
    )
    return Table.from_rows("Files", [row], FILE_TABLE_COLUMNS), build_program_version_table()
