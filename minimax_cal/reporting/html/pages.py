"""The pages after the one to sign: the error budget, where the errors are, the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from operator import itemgetter

from minimax_cal.diagnosing.instruments_result import RelativeDiagnosis
from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.diagnosing.sentences import causes_first
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.identify import Because
from minimax_cal.fitting.several import RelativeCalibration
from minimax_cal.ground.records import reading
from minimax_cal.ground.tables import Table, filled
from minimax_cal.modelling.frames import tables_of
from minimax_cal.reporting.html.content import Block, Blocks, missing, text
from minimax_cal.reporting.html.error_charts import Names, against_joints
from minimax_cal.reporting.html.scene import workspace
from minimax_cal.reporting.html.sources import Sources
from minimax_cal.reporting.tables import remaining_table, where_tables

SHEET_ROWS = 50  # of tables on a printed page; the appendix has what is longer
NO_POSES = "The file holds no poses, so that nothing can be drawn; write it again with its poses."
OBJECTIVES = {
    "sum": "the sum of all squared errors as small as possible",
    "minimax": "minimax, the error of the worst target as small as possible",
    "point": "minimax over points, the largest single error as small as possible",
    "pose": "errors of position and orientation together as small as possible",
}
REASONS = {
    Because.SAME_MOTION: "Parameters with the same motion move every target alike: only their sum "
    "can be known, and is in the one that was kept free. Positions lose nothing.",
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
        blocks += map(text, split_reasons(gap)[1])
        blocks += filled(*gap.first_tables(), gap.effects_table(), remaining_table(gap))
    elif fit:
        blocks += filled(fit.first_tables()[0], fit.accuracy_table(), fit.beyond.table())
    elif told:
        blocks += [text(told.headline()), *told.first_tables()]
        blocks += causes.first_tables() if causes else ()
    arms = (sources.simulator, sources.motion)
    return [*blocks, *(text(f"In the simulator: {arm.headline()}") for arm in arms if arm)]


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
        with reading("diagnosis", "where"):
            drawn += where_tables(gap.where)
    elif poses:
        drawn.append(against_joints(poses, names))
    return drawn


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
        tables = (fit.first_tables()[1], fit.parameter_table(), fit.effect_table())
        return [*on_a_sheet(tables), *identified(fit)]
    if gap:
        return filled(*tables_of(gap.frames)[:1], by_effect(gap.parameter_table()))
    return on_a_sheet((told.tables()[-1], *tables_of(told.frames)[:1])) if told else ()


def by_effect(table: Table) -> Table:
    """Parameters of effects, too many for a page, as a row an effect."""
    if len(table.rows) <= SHEET_ROWS:
        return table
    said = "{1} {2} (sigma {3}) {4}".format
    rows = (
        (effect, "; ".join(said(*row) for row in same))
        for effect, same in groupby(table.cells(), key=itemgetter(0))
    )
    return Table.made(table.title, rows, "effect | parameters")


def on_a_sheet(tables: Sequence[Table]) -> list[Table]:
    """The first tables that fit on a page together; at least the first two."""
    every = filled(*tables)
    rows = [sum(len(one.rows) for one in every[: i + 1]) for i in range(len(every))]
    return [one for i, one in enumerate(every) if i < 2 or rows[i] <= SHEET_ROWS]


def identified(fit: Fit) -> Blocks:
    """What was asked for, how much of it the data determined, and why not the rest."""
    known, count = sum(p.identifiable for p in fit.parameters), len(fit.parameters)
    rest = " The others keep their nominal values." if known < count else ""
    given = {p.because for p in fit.parameters if not p.identifiable}
    return [
        text(
            f"{known} of {count} parameters were identified, condition number {fit.condition:.3g}."
            f"{rest} Objective: {OBJECTIVES.get(fit.objective, fit.objective)}. Lengths in mm, "
            "angles in degrees, changes and sigmas of angles in mrad; base_x to base_rz correct "
            "the base along its own axes. Sigma is the standard deviation by measurement noise "
            "and the scatter of the residuals; a dash: the parameter was kept."
        ),
        *(text(words) for kind, words in REASONS.items() if kind in given),
    ]
