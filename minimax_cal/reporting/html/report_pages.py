"""The pages after the one to sign: the error budget, where the errors are, the parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from minimax_cal.core.display_text import capitalise_sentence, format_first_names
from minimax_cal.core.record_parsing import raise_read_errors_as_calibration_error
from minimax_cal.core.tables import Table, drop_empty_tables
from minimax_cal.diagnosing.diagnosis import Diagnosis
from minimax_cal.diagnosing.diagnosis_sentences import describe_extrapolation, describe_main_causes
from minimax_cal.diagnosing.instruments_result import RelativeDiagnosis
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.identification import ReasonKind
from minimax_cal.fitting.multi_instrument.relative_result import RelativeCalibration
from minimax_cal.fitting.parameter_results import geometry_parameter_table
from minimax_cal.modelling.cell_frames import build_cell_frame_tables
from minimax_cal.modelling.effects.effect_names import format_parameter
from minimax_cal.reporting.diagnosis_tables import (
    build_error_location_tables,
    build_remaining_error_table,
)
from minimax_cal.reporting.html.error_charts import BeforeAfterNames, build_error_by_joint_chart
from minimax_cal.reporting.html.report_content import (
    NoteBlock,
    ReportBlock,
    ReportBlocks,
    build_missing_note,
    build_text_note,
)
from minimax_cal.reporting.html.report_sources import ReportSources, list_named_results
from minimax_cal.reporting.html.workspace_view import build_workspace_view

MAX_TABLE_ROWS_PER_SHEET = 50  # of tables on a printed page; the appendix has what is longer
MAX_SHOWN_KEPT_REASONS = 14  # reasons why parameters were kept
MAX_SHOWN_REMAINING_ROWS = 4  # rows of what the remaining error follows
SHEET_HEIGHT_IN_ROWS = (
    66.0  # rows of tables on a printed page: what is beyond stands in the appendix
)
TEXT_LINE_HEIGHT_IN_ROWS, TEXT_LINE_LETTERS = (
    1.35,
    105,
)  # of a line of text: its height in rows, its letters
MAX_UNWRAPPED_COLUMNS, WRAPPED_CELL_LETTERS = (
    5,
    36,
)  # columns from which on a cell of so many letters wraps
ROWS_FOR_PARAMETER_NOTES = 9  # rows that the sentences below the parameters need
TABLE_TEXT_LINE_LETTERS = 90  # letters of a line of a table's sentence
BEFORE_EFFECTS_NOTE = (
    "The tables are of what geometry leaves, before any effect; what it follows is no cause by "
    "itself, for angles, loads and previous poses go together. Geometry is fitted beside the "
    "effects, so that base, tool and links may take a part of a joint's turn back."
)
NO_POSES_NOTE = (
    "The file holds no poses, so that nothing can be drawn; write it again with its poses."
)
OBJECTIVE_DESCRIPTIONS = {
    "sum": "the sum of all squared errors as small as possible",
    "minimax": "minimax, the error of the worst target as small as possible",
    "point": "minimax over points, the largest single error as small as possible",
    "pose": "errors of position and orientation together as small as possible",
}
NOT_IDENTIFIED_NOTES = {
    ReasonKind.SAME_MOTION: "Parameters with the same motion move "
    "every target alike: only their sum "
    "can be known, and is in the one that was kept free. Positions of the targets lose nothing.",
    ReasonKind.NOT_TOLD: "More poses, or a wider range of the joints, may tell the others.",
    ReasonKind.NO_MOTION: "A parameter that moves no measured point has no effect on them.",
    ReasonKind.FIXED: "Some were kept nominal on purpose.",
}


class CauseSentences(NamedTuple):
    """Sentences of a diagnosis."""

    of_causes: tuple[str, ...]
    others: tuple[str, ...]


class LargestRotation(NamedTuple):
    """How far effects turn a joint at most [mrad], and at which pose."""

    milliradians: float
    pose_name: str


def before_and_after_names(sources: ReportSources) -> BeforeAfterNames:
    """What before and after are called."""
    return ("nominal", "calibrated") if sources.fit else ("geometry alone", "with effects")


def split_cause_sentences(
    diagnosis: Diagnosis | RelativeDiagnosis,
) -> CauseSentences:
    """The sentences of a diagnosis that name its causes, for the page to sign, and the others."""
    count = max(sum(map(bool, describe_main_causes(diagnosis))), 1)
    return CauseSentences(diagnosis.reasons[:count], diagnosis.reasons[count:])


# ---- error budget --------------------------------------------------------------------------------


def build_budget_page(sources: ReportSources) -> ReportBlocks:
    """How far each step brings the error down, and what remains."""
    fit, gap, told, causes = sources.fit, sources.gap, sources.relative, sources.causes
    blocks: list[ReportBlock] = []
    if gap:
        said = split_cause_sentences(gap)[1]  # outside, the first page says how what is signed does
        blocks += [
            build_text_note(one) for one in said if not (fit and one == describe_extrapolation(gap))
        ]
        left = build_remaining_error_table(gap).shorten(max_rows=MAX_SHOWN_REMAINING_ROWS)
        blocks += drop_empty_tables(*gap.first_tables(), gap.effects_table(), left)
    elif fit:
        blocks += drop_empty_tables(fit.first_tables()[0], fit.accuracy_table(), fit.beyond.table())
    elif told:
        blocks += [build_text_note(told.headline()), *told.first_tables()]
        blocks += causes.first_tables() if causes else ()
    arms = (sources.simulator, sources.motion)
    blocks += [build_text_note(f"In the simulator: {arm.headline()}") for arm in arms if arm]
    every = dict.fromkeys(
        one for _, result in list_named_results(sources) for one in result.notices
    )
    notes = [NoteBlock(capitalise_sentence(f"{one}."), "notice") for one in every]
    tall = np.cumsum([sum(map(block_height_in_rows, blocks)), *map(block_height_in_rows, notes)])[
        1:
    ]
    return [*blocks, *notes[: int(np.count_nonzero(tall <= SHEET_HEIGHT_IN_ROWS))]]


def block_height_in_rows(block: ReportBlock) -> float:
    """How much of a printed page a block takes, in rows of a table."""
    if isinstance(block, NoteBlock):
        return TEXT_LINE_HEIGHT_IN_ROWS * math.ceil(len(block.text) / TEXT_LINE_LETTERS)
    if not isinstance(block, Table):
        return 0.0
    wide = len(block.header) > MAX_UNWRAPPED_COLUMNS
    cells = (
        max(len(cell) / (WRAPPED_CELL_LETTERS if wide else TABLE_TEXT_LINE_LETTERS) for cell in row)
        for row in block.formatted_cells()
    )
    return 3.0 + sum(map(math.ceil, cells))


# ---- where ---------------------------------------------------------------------------------------


def build_error_location_page(sources: ReportSources) -> ReportBlocks:
    """Where in space the errors are, and in which joints and targets."""
    poses, gap, told = sources.poses, sources.gap, sources.relative
    if told:
        return drop_empty_tables(*build_part_tables(told))
    names, drawn = before_and_after_names(sources), list[ReportBlock]()
    if poses and sources.cell:
        drawn.append(build_workspace_view(poses, sources.cell, names))
    else:
        drawn.append(build_missing_note(NO_POSES_NOTE))
    if gap and gap.where:
        drawn.append(build_text_note(BEFORE_EFFECTS_NOTE))
        with raise_read_errors_as_calibration_error("diagnosis", "where"):
            drawn += build_error_location_tables(gap.where, largest_joint_rotations(sources))
    elif poses:
        drawn.append(build_error_by_joint_chart(poses, names))
    return drawn


def largest_joint_rotations(sources: ReportSources) -> dict[str, LargestRotation]:
    """How far effects turn each joint at most [mrad], and at which pose."""
    if not sources.joint_rotations_by_effects:
        return {}
    data, turn = sources.joint_rotations_by_effects
    return {
        f"J{i + 1}": LargestRotation(1e3 * float(turn[pose, i]), data.row_name(int(pose)))
        for i, pose in enumerate(turn.argmax(axis=0))
    }


def build_part_tables(calibration: RelativeCalibration) -> list[Table]:
    """RMS errors wire by wire, contact by contact ..., of each file."""
    if len(calibration.instruments) < 2:
        return [calibration.parts_table(f"by {calibration.words.part}")]
    return [one.parts_table(f"{one.name}, by {one.words.part}") for one in calibration.instruments]


# ---- parameters ----------------------------------------------------------------------------------


def build_parameter_page(sources: ReportSources) -> ReportBlocks:
    """What was identified, how surely, and what was not."""
    fit, gap, told = sources.fit, sources.gap, sources.relative
    if fit:
        known = geometry_parameter_table(p for p in fit.parameters if p.identifiable)
        known = known.select_columns(*range(len(known.header) - 1))  # none of these has a reason
        tables = (fit.first_tables()[1], replace(known, title="parameters identified"))
        return [
            *drop_empty_tables(
                *tables,
                build_effect_parameter_table(
                    fit, MAX_TABLE_ROWS_PER_SHEET - ROWS_FOR_PARAMETER_NOTES - len(known.rows)
                ),
            ),
            *build_identification_notes(fit),
        ]
    if gap:
        return drop_empty_tables(
            *build_cell_frame_tables(gap.frames)[:1],
            merge_rows_by_effect(gap.parameter_table(), MAX_TABLE_ROWS_PER_SHEET),
        )
    return (
        select_tables_for_sheet((told.tables()[-1], *build_cell_frame_tables(told.frames)[:1]))
        if told
        else ()
    )


def build_effect_parameter_table(fit: Fit, max_rows: int) -> Table:
    """Parameters of the effects of a calibration, as far as so many lines hold them."""
    rows = []
    for name, unit, *sizes in fit.effect_table().formatted_cells():
        effect, _, parameter = name.rpartition(", ")
        rows.append((effect, parameter, *sizes[:2], unit))
    known = [row for row in rows if row[3] != "-" or row[1] == "RMS"]
    columns = "effect | parameter | value | sigma | unit"
    table = Table.from_rows("effects beyond geometry", known, columns)
    return merge_rows_by_effect(table, max_rows)


def merge_rows_by_effect(table: Table, max_rows: int) -> Table:
    """Parameters of effects, too many for so many lines, as a row an effect: the first that fit.

    table: effect, parameter, value, sigma, unit.
    """
    if len(table.rows) <= max_rows:
        return table
    rows, every = list[tuple[str, str]](), groupby(table.formatted_cells(), key=itemgetter(0))
    for effect, same in every:
        own = list(same)
        said = "; ".join(
            f"{', '.join(f'{row[1]} {row[2]} ({row[3]})' for row in own if row[4] == unit)}"
            f"{f' {unit}' if unit != '1' else ''}"
            for unit in dict.fromkeys(row[4] for row in own)
        )
        max_rows -= max(1, math.ceil(len(said) / TABLE_TEXT_LINE_LETTERS))
        if rows and max_rows < 0:
            break
        rows.append((effect, said))
    more = len({row[0] for row in table.formatted_cells()}) - len(rows)
    rest = f"; {more} more are in the appendix" if more else ""
    return Table.from_rows(f"{table.title}: value (sigma){rest}", rows, "effect | parameters")


def select_tables_for_sheet(tables: Sequence[Table]) -> list[Table]:
    """The first tables that fit on a page together; at least the first two."""
    every = drop_empty_tables(*tables)
    rows = [sum(len(one.rows) for one in every[: i + 1]) for i in range(len(every))]
    return [one for i, one in enumerate(every) if i < 2 or rows[i] <= MAX_TABLE_ROWS_PER_SHEET]


def build_identification_notes(fit: Fit) -> ReportBlocks:
    """What was asked for, how much of it the data determined, and why not the rest."""
    known, count = sum(p.identifiable for p in fit.parameters), len(fit.parameters)
    alike = dict[str, list[str]]()
    for one in fit.parameters:
        if not one.identifiable:
            name, why = one.title, one.why_not
            if one.is_of_effect:
                name, why = format_parameter(one.name), one.reason_for_display
            alike.setdefault(why, []).append(name)
    every = [f"{', '.join(names)} ({why})" for why, names in alike.items()]
    said = format_first_names(every, MAX_SHOWN_KEPT_REASONS, "; ")
    rest = f" Kept nominal: {said}." if said else ""
    given = {p.because for p in fit.parameters if not p.identifiable}
    return [
        build_text_note(
            f"{known} of {count} parameters were identified, condition number {fit.condition:.3g}."
            f"{rest} Objective: {OBJECTIVE_DESCRIPTIONS.get(fit.objective, fit.objective)}"
            f". Lengths in mm, "
            "angles in degrees, changes and sigmas of angles in mrad; base_x to base_rz correct "
            "the base along its own axes. Sigma is the standard deviation by measurement noise "
            "and the scatter of the residuals."
        ),
        *(build_text_note(words) for kind, words in NOT_IDENTIFIED_NOTES.items() if kind in given),
    ]
