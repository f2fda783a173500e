"""The command `import`: files as they are, into the measurements that `calibrate` reads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    JSON,
    PATH,
    QUIET,
    SAFE_CELLS,
    Output,
    command,
    flag,
    options_of,
    output,
    plain_option,
    refuse,
    show,
    with_output,
)
from minimax_cal.dynamics.logs import LogFiles, are_logs, import_logs
from minimax_cal.ground.files import json_text, plain
from minimax_cal.ground.options import Option
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.importers import Imported, import_files
from minimax_cal.measuring.measurements import measurements_in
from minimax_cal.reading.rows import read_rows
from minimax_cal.reading.sheet import sheet_of

TOLD = "What the files do not tell"


@command
@click.argument("files", nargs=-1, required=True, type=PATH, metavar="FILE...")
@options_of(
    import_files,
    TOLD,
    joints=Option("The file of joint values, where FILE holds points only.", read=Path),
    columns=Option(
        "What the columns are, in order: smr1_mm,smr2_mm,smr3_mm,q_deg (skip*2 leaves two out), or "
        "by place: 1-3=smr1_mm,4-9=q_deg,Temp=temperature_C. One with joints alone is that of the "
        "file of joints.",
        metavar="MAPPING",
        read=str,
        many=tuple,
    ),
    units=Option(
        "The units that the files do not tell, as q=deg, smr=mm, u95=mm, time=dmy.",
        metavar="WHAT=UNIT",
        read=str,
        many=tuple,
    ),
    layout=Option(
        "Which points follow each other, in a file with several a pose.",
        metavar="[pose|target]",
    ),
    decimal=Option("The decimal sign.", metavar="[point|comma]"),
)
@plain_option(
    TOLD,
    "--leave-out",
    multiple=True,
    metavar="POINTS[=WHY]",
    help="Points to set aside, and why: 12:smr2 is that of line 12, 12 all of its pose; several "
    "with commas, the reason after an equals sign.",
)
@plain_option(
    TOLD,
    "--mend",
    multiple=True,
    metavar="HOW",
    help="What is wrong in the whole file: shift=1 (each row takes the points one row further on; "
    "shift=1@40.. from line 40 on), reverse (points in the opposite order), joints=1:3:2:4:5:6 "
    "(columns of joints 2 and 3 swapped), scale=0.999 (of the points).",
)
@flag("--preview", help="Show the first rows as they were understood.")
@SAFE_CELLS
@JSON
@QUIET
@output("the measurements (CSV), or to a .json what was understood,")
@with_output(rows=True)
def import_command(
    files: tuple[Path, ...],
    leave_out: tuple[str, ...],
    mend: tuple[str, ...],
    preview: bool,
    safe_cells: bool,
    to: Output,
    **chosen: Any,
) -> int:
    """Read FILEs of a tracker or controller as they are and write CSV.

    What was understood is shown.  Files of joints with torques or currents in time are logs of
    motions, which `torques` reads.  Without -o nothing is written.
    """
    if not chosen["joints"] and not chosen["columns"] and are_logs(files):
        idle = {*chosen, "leave_out", "mend", "preview"} - {"units"}
        refuse(idle, f"is about measured points, and {files[0]} is a log")
        logs = import_logs(files, units=chosen["units"])
        return finish(logs, to, lambda: to.cells(logs.csv(), safe_cells), logs.table())
    found = import_files(files, **chosen).put_right(mend, leave_out)

    def rows() -> str:
        text = to.cells(found.csv(), safe_cells)
        measurements_in(read_rows(sheet_of(to.output or "", text)))  # it can be read again
        return text

    tables = (found.files(), *found.columns(), *[found.preview()] * preview)
    return finish(found, to, rows, *tables, said=found.headline())


def finish(
    found: Imported | LogFiles, to: Output, rows: Callable[[], str], *tables: Table, said: str = ""
) -> int:
    """Write and show what was understood."""
    content = {"schema": 1, "output": to.output and str(to.output), **found.to_dict()}
    wanted = to.deliver(lambda: json_text(plain(content)), rows=rows)
    to.notice(*content["notices"])
    if wanted:
        show(*tables)
        for line in filter(None, (said, "" if to.output else "nothing written; add -o FILE")):
            click.echo(line)
    return 0
