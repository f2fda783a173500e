"""The pages after the one to sign: the error budget, where the errors are, the parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from operator import itemgetter

import numpy as np

from minimax_cal.diagnosing.instruments_result import RelativeDiagnosis
from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.diagnosing.sentences import away, causes_first
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.found import parameter_table
from minimax_cal.fitting.identify import Because
from minimax_cal.fitting.several.result import RelativeCalibration
from minimax_cal.ground.records import reading
from minimax_cal.ground.tables import Table, filled
from minimax_cal.ground.words import capitalise, name_first
from minimax_cal.modelling.effects.words import name_parameter
from minimax_cal.modelling.frames import tables_of
from minimax_cal.reporting.html.content import Block, Blocks, Note, missing, text
from minimax_cal.reporting.html.error_charts import Names, against_joints
from minimax_cal.reporting.html.scene import workspace
from minimax_cal.reporting.html.sources import Sources, named
from minimax_cal.reporting.tables import remaining_table, where_tables

SHEET_ROWS = 50  # of tables on a printed page; the appendix has what is longer
SHOWN_KEPT = 14  # reasons why parameters were kept
SHOWN_LEFT = 4  # rows of what the remaining error follows
SHEET_HEIGHT = 66.0  # rows of tables on a printed page: what is beyond stands in the appendix
TALL, LETTERS = 1.35, 105  # of a line of text: its height in rows, its letters
WIDE, LEAST = 5, 36  # columns from which on a cell of so many letters wraps
BELOW = 9  # rows that the sentences below the parameters need
LINE = 90  # letters of a line of a table's sentence
BEFORE_EFFECTS = (
    "The tables are of what geometry leaves, before any effect; what it follows is no cause by "
    "itself, for angles, loads and previous poses go together. Geometry is fitted beside the "
    "effects, so that base, tool and links may take a part of a joint's turn back."
)
NO_POSES = "The file holds no poses, so that nothing can be drawn; write it again with its poses."
OBJECTIVES = {
    "sum": "the sum of all squared errors as small as possible",
    "minimax": "minimax, the error of the worst target as small as possible",
    "point": "minimax over points, the largest single error as small as possible",
    "pose": "errors of position and orientation together as small as possible",
}
REASONS = {
    Because.SAME_MOTION: "Parameters with the same motion move every target alike: only their sum "
    "can be known, and is in the one that was kept free. Positions of the targets lose nothing.",
    Because.NOT_TOLD: "More poses, or a wider range of the joints, may tell the others.",
    Because.NO_MOTION: "A parameter that moves no measured point has no effect on them.",
    Because.FIXED: "Some were kept nominal on purpose.",
}


def names_of(sources: Sources) -> Names:
    """What before and after are called."""
    return ("nominal", "calibrated") if sources.fit else ("geometry alone", "with effects")


def split_reasons(
    found: Diagnosis | RelativeDiagnosis,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The sentences of a diagnosis that name its causes, for the page to sign, and the others."""
    count = max(sum(map(bool, causes_first(found))), 1)
    return found.reasons[:count], found.reasons[count:]


# ---- error budget --------------------------------------------------------------------------------


def budget(sources: Sources) -> Blocks:
    """How far each step brings the error down, and what remains."""
    fit, gap, told, causes = sources.fit, sources.gap, sources.relative, sources.causes
    blocks: list[Block] = []
    if gap:
        said = split_reasons(gap)[1]  # outside, the first page says how what is signed does
        blocks += [text(one) for one in said if not (fit and one == away(gap))]
        left = remaining_table(gap).brief(rows=SHOWN_LEFT)
        blocks += filled(*gap.first_tables(), gap.effects_table(), left)
    elif fit:
        blocks += filled(fit.first_tables()[0], fit.accuracy_table(), fit.beyond.table())
    elif told:
        blocks += [text(told.headline()), *told.first_tables()]
        blocks += causes.first_tables() if causes else ()
    arms = (sources.simulator, sources.motion)
    blocks += [text(f"In the simulator: {arm.headline()}") for arm in arms if arm]
    every = dict.fromkeys(one for _, result in named(sources) for one in result.notices)
    notes = [Note(capitalise(f"{one}."), "notice") for one in every]
    tall = np.cumsum([sum(map(height, blocks)), *map(height, notes)])[1:]
    return [*blocks, *notes[: int(np.count_nonzero(tall <= SHEET_HEIGHT))]]


def height(block: Block) -> float:
    """How much of a printed page a block takes, in rows of a table."""
    if isinstance(block, Note):
        return TALL * math.ceil(len(block.text) / LETTERS)
    if not isinstance(block, Table):
        return 0.0
    wide = len(block.header) > WIDE
    cells = (max(len(cell) / (LEAST if wide else LINE) for cell in row) for row in block.cells())
    return 3.0 + sum(map(math.ceil, cells))


# ---- where ---------------------------------------------------------------------------------------


def where(sources: Sources) -> Blocks:
    """Where in space the errors are, and in which joints and targets."""
    poses, gap, told = sources.poses, sources.gap, sources.relative
    if told:
        return filled(*parts_of(told))
    names, drawn = names_of(sources), list[Block]()
    if poses and sources.cell:
        drawn.append(workspace(poses, sources.cell, names))
    else:
        drawn.append(missing(NO_POSES))
    if gap and gap.where:
        drawn.append(text(BEFORE_EFFECTS))
        with reading("diagnosis", "where"):
            drawn += where_tables(gap.where, turns_of(sources))
    elif poses:
        drawn.append(against_joints(poses, names))
    return drawn


def turns_of(sources: Sources) -> dict[str, tuple[float, str]]:
    """How far effects turn each joint at most [mrad], and at which pose."""
    if not sources.turned:
        return {}
    data, turn = sources.turned
    return {
        f"J{i + 1}": (1e3 * float(turn[pose, i]), data.row_called(int(pose)))
        for i, pose in enumerate(turn.argmax(axis=0))
    }


def parts_of(told: RelativeCalibration) -> list[Table]:
    """RMS errors wire by wire, contact by contact ..., of each file."""
    if len(told.instruments) < 2:
        return [told.parts_table(f"by {told.words.part}")]
    return [one.parts_table(f"{one.name}, by {one.words.part}") for one in told.instruments]


# ---- parameters ----------------------------------------------------------------------------------


def parameters(sources: Sources) -> Blocks:
    """What was identified, how surely, and what was not."""
    fit, gap, told = sources.fit, sources.gap, sources.relative
    if fit:
        known = parameter_table(p for p in fit.parameters if p.identifiable)
        known = known.only(*range(len(known.header) - 1))  # none of these has a reason
        tables = (fit.first_tables()[1], replace(known, title="parameters identified"))
        return [
            *filled(*tables, effects_of(fit, SHEET_ROWS - BELOW - len(known.rows))),
            *identified(fit),
        ]
    if gap:
        return filled(*tables_of(gap.frames)[:1], by_effect(gap.parameter_table(), SHEET_ROWS))
    return on_a_sheet((told.tables()[-1], *tables_of(told.frames)[:1])) if told else ()


def effects_of(fit: Fit, room: int) -> Table:
    """Parameters of the effects of a calibration, as far as so many lines hold them."""
    rows = []
    for name, unit, *sizes in fit.effect_table().cells():
        effect, _, parameter = name.rpartition(", ")
        rows.append((effect, parameter, *sizes[:2], unit))
    known = [row for row in rows if row[3] != "-" or row[1] == "RMS"]
    columns = "effect | parameter | value | sigma | unit"
    table = Table.made("effects beyond geometry", known, columns)
    return by_effect(table, room)


def by_effect(table: Table, room: int) -> Table:
    """Parameters of effects, too many for so many lines, as a row an effect: the first that fit.

    table: effect, parameter, value, sigma, unit.
    """
    if len(table.rows) <= room:
        return table
    rows, every = list[tuple[str, str]](), groupby(table.cells(), key=itemgetter(0))
    for effect, same in every:
        own = list(same)
        said = "; ".join(
            f"{', '.join(f'{row[1]} {row[2]} ({row[3]})' for row in own if row[4] == unit)}"
            f"{f' {unit}' if unit != '1' else ''}"
            for unit in dict.fromkeys(row[4] for row in own)
        )
        room -= max(1, math.ceil(len(said) / LINE))
        if rows and room < 0:
            break
        rows.append((effect, said))
    more = len({row[0] for row in table.cells()}) - len(rows)
    rest = f"; {more} more are in the appendix" if more else ""
    return Table.made(f"{table.title}: value (sigma){rest}", rows, "effect | parameters")


def on_a_sheet(tables: Sequence[Table]) -> list[Table]:
    """The first tables that fit on a page together; at least the first two."""
    every = filled(*tables)
    rows = [sum(len(one.rows) for one in every[: i + 1]) for i in range(len(every))]
    return [one for i, one in enumerate(every) if i < 2 or rows[i] <= SHEET_ROWS]


def identified(fit: Fit) -> Blocks:
    """What was asked for, how much of it the data determined, and why not the rest."""
    known, count = sum(p.identifiable for p in fit.parameters), len(fit.parameters)
    alike = dict[str, list[str]]()
    for one in fit.parameters:
        if not one.identifiable:
            name, why = one.title, one.why_not
            if one.of_effect:
                name, why = name_parameter(one.name), one.why_in_words
            alike.setdefault(why, []).append(name)
    every = [f"{', '.join(names)} ({why})" for why, names in alike.items()]
    said = name_first(every, SHOWN_KEPT, "; ")
    rest = f" Kept nominal: {said}." if said else ""
    given = {p.because for p in fit.parameters if not p.identifiable}
    return [
        text(
            f"{known} of {count} parameters were identified, condition number {fit.condition:.3g}."
            f"{rest} Objective: {OBJECTIVES.get(fit.objective, fit.objective)}. Lengths in mm, "
            "angles in degrees, changes and sigmas of angles in mrad; base_x to base_rz correct "
            "the base along its own axes. Sigma is the standard deviation by measurement noise "
            "and the scatter of the residuals."
        ),
        *(text(words) for kind, words in REASONS.items() if kind in given),
    ]
