"""The command `import`: files as they are, into the measurements that `calibrate` reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from minimax_cal.cli.options import (
    JSON,
    PATH,
    QUIET,
    SAFE_CELLS,
    InGroups,
    Output,
    can,
    output,
    plain_option,
    show,
    with_output,
)
from minimax_cal.dynamics.logs import LogFiles, are_logs, import_logs, runs_text
from minimax_cal.dynamics.run import Run
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import json_text, plain
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.columns import rows_in
from minimax_cal.measuring.faults import distance_faults
from minimax_cal.measuring.importers import Imported, csv_of, import_files
from minimax_cal.measuring.measurements import check_finite, measurements_in
from minimax_cal.measuring.mending import mended
from minimax_cal.measuring.set_aside import left_out

TOLD = "What the files do not tell"


@click.command(name="import", cls=InGroups)
@click.argument("files", nargs=-1, required=True, type=PATH, metavar="FILE...")
@plain_option(
    TOLD, "--joints", type=PATH, help="The file of joint values, where FILE holds points only."
)
@plain_option(
    TOLD,
    "--columns",
    multiple=True,
    metavar="MAPPING",
    help="What the columns are, in order: smr1_mm,smr2_mm,smr3_mm,q_deg (skip*2 leaves two out), "
    "or by place: 1-3=smr1_mm,4-9=q_deg,Temp=temperature_C. One with joints alone is that of the "
    "file of joints.",
)
@plain_option(
    TOLD,
    "--units",
    multiple=True,
    metavar="WHAT=UNIT",
    help="The units that the files do not tell, as q=deg, smr=mm, u95=mm, time=dmy.",
)
@plain_option(
    TOLD,
    "--layout",
    type=click.Choice(["pose", "target"]),
    help="Which points follow each other, in a file with several a pose.",
)
@plain_option(TOLD, "--decimal", type=click.Choice(["point", "comma"]), help="The decimal sign.")
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
@click.option("--preview", is_flag=True, help="Show the first rows as they were understood.")
@SAFE_CELLS
@JSON
@QUIET
@output("the measurements (CSV), or to a .json what was understood,")
@with_output
@can("rows")
def import_command(
    files: Sequence[Path],
    joints: Path | None,
    layout: str | None,
    decimal: str | None,
    leave_out: tuple[str, ...],
    mend: tuple[str, ...],
    preview: bool,
    safe_cells: bool,
    to: Output,
    **chosen: Any,
) -> int:
    """Read FILEs of a tracker or controller as they are, show what was understood, write CSV.

    Files of joints with torques or currents in time are logs of motions, which `torques` reads.
    Without -o nothing is written.
    """
    if joints is None and not chosen["columns"] and are_logs(files):
        unused = {"leave_out": leave_out, "layout": layout, "decimal": decimal}
        if name := next((name for name, value in unused.items() if value), ""):
            raise OptionError(f"{name}= is about measured points, and {files[0]} is a log")
        return show_logs(import_logs(files, units=chosen["units"]), to, safe_cells)
    found = import_files(files, joints, layout=layout or "", decimal=decimal or "", **chosen)
    found = replace(found, data=left_out(mended(found.data, mend), leave_out))
    check_finite(found.data)  # what is left of it
    off = [fault.text for fault in distance_faults(found.data)]
    found = replace(found, data=replace(found.data, notices=(*found.data.notices, *off)))
    wanted = to.deliver(
        lambda: json_text(content(found, to.path)),
        rows=lambda: readable(to.cells(csv_of(found), safe_cells), to.path),
    )
    to.notice(*found.data.notices)
    if wanted:
        show(found.files(), *found.columns(), *([found.preview()] if preview else []))
        click.echo(found.headline() + ("" if to.path else "\nnothing written; add -o FILE"))
    return 0


def show_logs(found: LogFiles, to: Output, safe_cells: bool) -> int:
    """Show what was understood of logs, and write them."""
    wanted = to.deliver(
        lambda: json_text(log_content(found, to.path)),
        rows=lambda: to.cells(runs_text(found.runs, found.sliding), safe_cells),
    )
    to.notice(*found.notices)
    if not wanted:
        return 0
    rows = (
        (run.name, title, len(run.time), run.duration, 1.0 / step_of(run), columns[0], run.unit)
        for run, title, columns in zip(found.runs, found.titles, found.columns, strict=True)
    )
    total = sum(run.duration for run in found.runs)
    many = f"{len(found.runs)} runs" if len(found.runs) > 1 else "1 run"
    title = f"{many}, {total:.1f} s, {found.runs[0].joints} joints"
    columns = "run | format | rows | s | rows a second | first joint | torque in"
    show(Table.made(title, rows, columns))
    if not to.path:
        click.echo("nothing written; add -o FILE")
    return 0


def step_of(run: Run) -> float:
    """Typical time between rows [s]."""
    return float(np.median(np.diff(run.time)))


def log_content(found: LogFiles, output: Path | None) -> dict[str, object]:
    """The JSON of the command for logs."""
    return {
        "schema": 1,
        "output": str(output) if output else None,
        "joints": found.runs[0].joints,
        "unit": found.runs[0].unit,
        "runs": [
            {
                "name": run.name,
                "source": run.source,
                "format": title,
                "rows": len(run.time),
                "duration_s": run.duration,
                "step_s": step_of(run),
                "payload_kg": run.payload,
                "columns": list(columns),
            }
            for run, title, columns in zip(found.runs, found.titles, found.columns, strict=True)
        ],
        "notices": list(found.notices),
    }


def readable(text: str, path: Path | None) -> str:
    """CSV that is about to be written, if it can be read again.  Raises DataError."""
    measurements_in(rows_in(text, path or ""))
    return text


def content(found: Imported, output: Path | None) -> dict[str, object]:
    """The JSON of the command."""
    whole = {
        "schema": 1,
        "output": str(output) if output else None,
        "poses": found.data.poses,
        "joints": found.data.q.shape[1],
        "targets": found.data.target_names,
        "files": [
            {**file, "columns": table.records()}
            for file, table in zip(found.files().records(), found.columns(), strict=True)
        ],
        "set_aside": found.data.set_aside,
        "notices": found.data.notices,
    }
    return dict(plain(whole))
