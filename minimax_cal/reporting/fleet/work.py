"""One cell done, whatever becomes of it, and all of them: here, or on a Dask cluster."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit, load_fit
from minimax_cal.ground.errors import CalibrationError, CalibrationWarning
from minimax_cal.ground.parallel import in_parallel
from minimax_cal.judging.tolerance import REFUSED, judge, limits_of, overall, within
from minimax_cal.judging.watching.comparison import compare
from minimax_cal.judging.watching.health import check
from minimax_cal.reporting.fleet.cells import Job
from minimax_cal.solvers.status import Status

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
        other = compare(load_fit(job.path(told.fit)), fit)
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
