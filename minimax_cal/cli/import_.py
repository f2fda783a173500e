"""The command `import`: files as they are, into the measurements that `calibrate` reads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    JSON_OPTION,
    PATH_TYPE,
    QUIET_AND_PROGRESS_OPTIONS,
    SAFE_CELLS_OPTION,
    CommandOutput,
    define_command,
    flag_option,
    group_option,
    options_from_parameters,
    output_option,
    pass_output_to_command,
    print_tables,
    refuse_given_options,
)
from minimax_cal.core.files import convert_to_plain_json, format_json
from minimax_cal.core.option_fields import Option
from minimax_cal.core.tables import Table
from minimax_cal.dynamics.logs import LogFiles, are_logs, read_log_files
from minimax_cal.measuring.importers import Imported, import_files
from minimax_cal.measuring.measurements import build_measurements
from minimax_cal.reading.measurement_table import read_measurement_table
from minimax_cal.reading.text_sheet import build_text_sheet

IMPORT_OPTION_GROUP = "What the files do not tell"


@define_command
@click.argument("files", nargs=-1, required=True, type=PATH_TYPE, metavar="FILE...")
@options_from_parameters(
    import_files,
    IMPORT_OPTION_GROUP,
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
@group_option(
    IMPORT_OPTION_GROUP,
    "--leave-out",
    multiple=True,
    metavar="POINTS[=WHY]",
    help="Points to set aside, and why: 12:smr2 is that of line 12, 12 all of its pose; several "
    "with commas, the reason after an equals sign.",
)
@group_option(
    IMPORT_OPTION_GROUP,
    "--mend",
    multiple=True,
    metavar="HOW",
    help="What is wrong in the whole file: shift=1 (each row takes the points one row further on; "
    "shift=1@40.. from line 40 on), reverse (points in the opposite order), joints=1:3:2:4:5:6 "
    "(columns of joints 2 and 3 swapped), scale=0.999 (of the points).",
)
@flag_option("--preview", help="Show the first rows as they were understood.")
@SAFE_CELLS_OPTION
@JSON_OPTION
@QUIET_AND_PROGRESS_OPTIONS
@output_option("the measurements (CSV), or to a .json what was understood,")
@pass_output_to_command(can_write_csv=True)
def import_command(
    files: tuple[Path, ...],
    leave_out: tuple[str, ...],
    mend: tuple[str, ...],
    preview: bool,
    safe_cells: bool,
    to: CommandOutput,
    **chosen: Any,
) -> int:
    """Read FILEs of a tracker or controller as they are and write CSV.

    What was understood is shown.  Files of joints with torques or currents in time are logs of
    motions, which `torques` reads.  Without -o nothing is written.
    """
    if not chosen["joints"] and not chosen["columns"] and are_logs(files):
        idle = {*chosen, "leave_out", "mend", "preview"} - {"units"}
        refuse_given_options(idle, f"is about measured points, and {files[0]} is a log")
        logs = read_log_files(files, units=chosen["units"])
        return write_and_print_import(
            logs, to, lambda: to.escape_formula_cells(logs.format_csv(), safe_cells), logs.table()
        )
    found = import_files(files, **chosen).with_mends(mend, leave_out)

    def rows() -> str:
        text = to.escape_formula_cells(found.csv(), safe_cells)
        build_measurements(
            read_measurement_table(build_text_sheet(to.output or "", text))
        )  # it can be read again
        return text

    tables = (found.files(), *found.columns(), *[found.preview()] * preview)
    return write_and_print_import(found, to, rows, *tables, summary=found.headline())


def write_and_print_import(
    imported: Imported | LogFiles,
    output: CommandOutput,
    make_csv: Callable[[], str],
    *tables: Table,
    summary: str = "",
) -> int:
    """Write and show what was understood."""
    content = {"schema": 1, "output": output.output and str(output.output), **imported.to_dict()}
    wanted = output.write_result_or_print_json(
        lambda: format_json(convert_to_plain_json(content)), make_csv=make_csv
    )
    output.print_notices(*content["notices"])
    if wanted:
        print_tables(*tables)
        for line in filter(
            None, (summary, "" if output.output else "nothing written; add -o FILE")
        ):
            click.echo(line)
    return 0
