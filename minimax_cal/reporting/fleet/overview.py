"""A fleet of cells, calibrated or checked in one go, and its page."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.options import silent
from minimax_cal.ground.errors import CalibrationError, CalibrationWarning, OptionError
from minimax_cal.ground.files import check_writable, made_folder, read_toml, write_whole
from minimax_cal.ground.optional import optional
from minimax_cal.ground.parallel import in_parallel, look_for
from minimax_cal.ground.results import Result
from minimax_cal.ground.stages import count_stage
from minimax_cal.ground.tables import Table
from minimax_cal.judging.tolerance import (
    NOT_PASSED,
    PASSED,
    REFUSED,
    judge,
    limits_of,
    overall,
    within,
)
from minimax_cal.judging.watching.comparison import compare
from minimax_cal.judging.watching.health import check
from minimax_cal.judging.watching.result import NOT_VALID, VALID
from minimax_cal.reporting.html.page import part, policy, template
from minimax_cal.solvers.status import Status

MOST = 10_000  # cells
NAME = re.compile(r"[\w][\w .()+-]{0,80}")


def required(text: str) -> str:
    """A tolerance.  Raises ValueError."""
    try:
        limits_of(text)
    except OptionError as error:
        raise ValueError(str(error)) from error
    return text


def plain_name(text: str) -> str:
    """A name that is also one of a file.  Raises ValueError."""
    if not NAME.fullmatch(text) or text.endswith((".", " ")):
        raise ValueError(f"{text!r}: letters, digits, spaces, . _ - + ( ) only; it names a file")
    return text


class Common(BaseModel):
    """What all cells, or one, may have."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    robot: str = ""
    tolerance: Annotated[str, AfterValidator(required)] = ""
    objective: str = "minimax"
    effects: str = ""
    fix: str = ""
    holdout: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.2
    seed: Annotated[int, Field(ge=0)] = 0


class CellPart(Common):
    """One cell: measurements to calibrate by, or a calibration and poses to check it by."""

    name: Annotated[str, AfterValidator(plain_name)]
    data: str = ""
    fit: str = ""
    check: str = ""

    @model_validator(mode="after")
    def whole(self) -> CellPart:
        """Raises ValueError for a cell with nothing to do."""
        if self.data and not self.robot:
            raise ValueError("data needs robot, a file or a built-in name")
        if self.check and not (self.fit and self.tolerance):
            raise ValueError("check needs fit, the calibration, and tolerance")
        if not (self.data or self.check):
            raise ValueError("give data (and robot), or fit and check")
        if self.data and self.check:
            raise ValueError("give data or check, not both; data with fit compares")
        return self


@dataclass(frozen=True)
class Job:
    """A cell to be done.  told: its settings.  folder: its files are named from there.

    out: where its calibration goes, None for nowhere.
    """

    told: CellPart
    folder: Path
    out: Path | None

    def path(self, name: str) -> str:
        """A file of the cell, or a built-in robot."""
        there = self.folder / name
        return str(there) if there.exists() or Path(name).suffix else name


def read_cells(path: Path | str, out: Path | None) -> tuple[Job, ...]:
    """The jobs of a TOML file: ``[[cells]]`` with what ``[defaults]`` gives all.

    Raises OptionError for what is wrong in the file; what is wrong with one cell's own files is
    found when it is done.
    """
    content = read_toml(path)
    strange = sorted(set(content) - {"defaults", "cells"})
    if strange:
        raise OptionError(f"{path}: the key {strange[0]!r} is not known; there are defaults, cells")
    cells, common = content.get("cells", []), content.get("defaults", {})
    if not (isinstance(cells, list) and isinstance(common, dict)):
        raise OptionError(f"{path}: write [defaults] once, and [[cells]] for each cell")
    if not 1 <= len(cells) <= MOST:
        raise OptionError(f"{path}: holds {len(cells)} cells; give 1 to {MOST} as [[cells]]")
    told = [read_cell(path, number, each, common) for number, each in enumerate(cells, 1)]
    names = [cell.name.casefold() for cell in told]
    twice = [cell.name for cell in told if names.count(cell.name.casefold()) > 1]
    if twice:
        raise OptionError(f"{path}: two cells are called {twice[0]!r}; name each otherwise")
    folder = Path(path).resolve().parent
    return tuple(Job(cell, folder, out) for cell in told)


def read_cell(path: Path | str, number: int, given: Any, common: dict[str, Any]) -> CellPart:
    """One cell.  Raises OptionError."""
    if not isinstance(given, dict):
        raise OptionError(f"{path}: write [[cells]] for each cell")
    where = f"{path}: cell {number}"
    try:
        return CellPart.model_validate({**common, **given})
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        text = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            text = f"is not known; choose {', '.join(CellPart.model_fields)}"
        raise OptionError(f"{where}: {place}{': ' if place else ''}{text}") from error


# ---- the overview --------------------------------------------------------------------------------


FAILED = "failed"
NEEDED = "minimax-cal[fleet]"


@dataclass(frozen=True)
class Row:
    """What became of a cell.

    work: calibrated or checked.  status: of the numbers, or failed.  verdict: of the tolerance, ""
    where none is required.  before, rms, largest: on poses that no fit had seen [mm], NaN where
    unknown.  changed: joints that moved, against the calibration given.  why: in a sentence.
    notices: of the calibration or the check.
    """

    cell: str
    robot: str
    work: str
    status: str
    verdict: str
    before_mm: float
    rms_mm: float
    max_mm: float
    changed: tuple[str, ...]
    file: str
    why: str
    notices: tuple[str, ...] = ()

    @property
    def failed(self) -> bool:
        """Whether there is no result."""
        return self.status == FAILED

    @property
    def end(self) -> str:
        """The verdict, or that there is none."""
        return FAILED if self.failed else self.verdict


def done(job: Job) -> Row:
    """One cell; what goes wrong with it is its row."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CalibrationWarning)  # the result's notices say the same
            return checked(job) if job.told.check else calibrated(job)
    except (CalibrationError, np.linalg.LinAlgError, MemoryError) as error:
        return without(job, " ".join(str(error).split()) or "not enough memory")


def without(job: Job, why: str, robot: str = "", notices: tuple[str, ...] = ()) -> Row:
    """The row of a cell without a result."""
    work, nan = "checked" if job.told.check else "calibrated", math.nan
    return Row(job.told.name, robot, work, FAILED, "", nan, nan, nan, (), "", why, notices)


def calibrated(job: Job) -> Row:
    """Calibrate, judge, and compare with an earlier calibration where there is one."""
    told = job.told
    fit = calibrate(
        job.path(told.robot), job.path(told.data), told.objective, holdout=told.holdout,
        seed=told.seed, effects=told.effects, fix=told.fix,
    )  # fmt: skip
    if fit.status is Status.FAILED:
        why = f"the fit failed: {fit.reason or fit.status.advice}"
        return without(job, why, fit.cell.robot.name, fit.notices)
    found = fit.within
    ends = found.rms, found.largest
    claim = within(found.where, found.before, found.after, ends, found.poses, found.missed)
    claim = replace(claim, refused=REFUSED.get(fit.status, ""))
    judged = tuple(judge(limit, claim) for limit in limits_of(told.tolerance))
    changed: tuple[str, ...] = ()
    said, notices = [one.sentence() for one in judged], fit.notices
    if told.fit:
        other = compare(Fit.load(job.path(told.fit)), fit)
        changed = other.joints
        said.append(other.headline())
        notices = (*notices, *other.notices)
    return Row(
        told.name, fit.cell.robot.name, "calibrated", str(fit.status),
        overall(judged) if judged else "", found.before.rms_mm, found.after.rms_mm,
        found.after.max_mm, changed, saved(job, fit), " ".join(said), notices,
    )  # fmt: skip


def checked(job: Job) -> Row:
    """Check an earlier calibration."""
    told = job.told
    found = check(job.path(told.fit), job.path(told.check), told.tolerance, seed=told.seed)
    return Row(
        told.name, found.robot, "checked", str(found.status), found.word, math.nan,
        found.accuracy.rms_mm, found.accuracy.max_mm,
        tuple(dict.fromkeys(m.joint for m in found.moved)), saved(job, found.fit),
        found.headline(), found.notices,
    )  # fmt: skip


def saved(job: Job, fit: Fit) -> str:
    """The calibration's file in the folder of results, if there is one."""
    if job.out is None:
        return ""
    path = job.out / f"{job.told.name}.json"
    fit.save(path)
    return path.name


# ---- where cells are done ----------------------------------------------------------------------


def arriving(jobs: Sequence[Job], processes: int, cluster: str) -> Iterator[Row]:
    """The rows of all jobs as they are done.

    processes: on this machine, -1 for one a core; one needs no other package.  cluster: address of
    a Dask scheduler whose workers see the same folders.  Raises OptionError.
    """
    if not cluster and (processes == 1 or len(jobs) == 1):
        yield from map(done, jobs)
        return
    count = min(processes, len(jobs))
    calls = [(job,) for job in jobs]
    for _, row in in_parallel(done, calls, processes=count, cluster=cluster):
        yield row


# ---- the overview --------------------------------------------------------------------------------


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
