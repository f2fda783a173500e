"""A fleet of cells, calibrated or checked in one go, and its page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from minimax_cal.fitting.options import silent
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import check_writable, made_folder, write_whole
from minimax_cal.ground.optional import optional
from minimax_cal.ground.parallel import look_for
from minimax_cal.ground.results import Result
from minimax_cal.ground.stages import count_stage
from minimax_cal.ground.tables import Table
from minimax_cal.judging.tolerance import NOT_PASSED, PASSED
from minimax_cal.judging.watching.result import NOT_VALID, VALID
from minimax_cal.reporting.fleet.cells import MOST, read_cells
from minimax_cal.reporting.fleet.work import FAILED, NEEDED, Row, arriving
from minimax_cal.reporting.html.page import part, policy, template

GOOD, BAD = (PASSED, VALID), (NOT_PASSED, NOT_VALID, FAILED)


@dataclass(frozen=True)
class Fleet(Result):
    """What became of all cells, in the order of the file."""

    KIND = "fleet"

    rows: tuple[Row, ...]
    source: str

    @property
    def failed(self) -> tuple[Row, ...]:
        """Cells without a result."""
        return tuple(row for row in self.rows if row.failed)

    def headline(self) -> str:
        """All cells in a sentence."""
        kept = sum(row.verdict in GOOD for row in self.rows)
        asked = sum(bool(row.verdict) for row in self.rows)
        changed = [row.cell for row in self.rows if row.changed]
        text = f"{len(self.rows)} cells: {kept} of {asked} keep what is required"
        text += f", {len(changed)} changed ({', '.join(changed)})" if changed else ""
        return text + f"; {len(self.failed)} failed."

    def table(self) -> Table:
        """A row a cell."""
        return Table.of(f"cells of {self.source}", self.rows, "cell | robot | work | end=verdict | "
                        "before_mm=before RMS mm .3f | rms_mm=RMS mm .3f | max_mm=max mm .3f | "
                        "changed | why")  # fmt: skip

    def beside(self, *, poses: bool = True) -> dict[str, Any]:
        """How many cells, and how many failed."""
        return {"cells": len(self.rows), "failed": len(self.failed)}

    def html(self) -> str:
        """One page that needs nothing else.  Raises OptionError without jinja2."""
        jinja = optional("jinja2", "an overview page", NEEDED)
        from markupsafe import Markup

        table, made = (
            self.table(),
            template(jinja, "fleet.html.jinja", "minimax_cal.reporting.fleet"),
        )
        whole: str = made.render(
            fleet=self,
            policy=policy().replace("script-src ", "script-src 'none'"),
            style=Markup(part("page.css")),
            header=table.header[:-1],
            rows=list(zip(self.rows, table.cells(), strict=True)),
            good=GOOD,
            bad=BAD,
        )
        return whole


def fleet(
    path: Path | str,
    *,
    out: Path | str | None = None,
    page: Path | str | None = None,
    processes: int = -1,
    cluster: str = "",
    progress: Callable[[str], None] = silent,
) -> Fleet:
    """Calibrate, or check, a folder of cells in one go; a cell that fails is one row.

    Parameters
    ----------
    path
        A TOML file with ``[[cells]]``, each with name, robot and data, or fit and check,
        and what ``[defaults]`` gives all; files are named from its folder.
    out
        Folder for each cell's calibration.
    page
        Of the overview, HTML.
    processes
        On this machine, -1 for one a core.
    cluster
        Address of a Dask scheduler instead.
    progress
        Called for each cell.

    Returns
    -------
    Fleet
        A row for each cell.

    Raises
    ------
    CalibrationError
        For what is wrong with the file itself.

    Examples
    --------
    >>> print(mc.fleet("cells.toml", page="fleet.html").summary())
    """
    if processes == 0 or not -1 <= processes <= MOST:
        raise OptionError(f"processes {processes:.6g}: give their number, or -1 for one a core")
    if page is not None:
        check_writable(page, (".html", ".htm"))
        optional("jinja2", "an overview page", NEEDED)
    folder = Path(out).resolve() if out is not None else None
    jobs = read_cells(path, folder)
    if cluster:
        look_for(cluster)  # before anything is written
    if folder is not None:
        made_folder(folder)
    rows: dict[str, Row] = {}
    progress(count_stage("cells:", 1, len(jobs)))
    for row in arriving(jobs, processes, cluster):
        rows[row.cell] = row
        progress(count_stage("cells:", min(len(rows) + 1, len(jobs)), len(jobs)))
    found = Fleet(tuple(rows[job.told.name] for job in jobs), Path(path).name)
    if page is not None:
        write_whole(page, found.html())
    return found
