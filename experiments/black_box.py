"""What free functions predict beside geometry, and beside the effects that a diagnosis names.

    python -m experiments.black_box [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N] ...

For each arm and split: RMS distances on groups of training poses left out in turn, of geometry and
of the named effects, alone and with maps of joints and a process in all of them; and the held-out
RMS of the names.  Real arms where their measurements are on this machine, and a simulated one.
"""

from __future__ import annotations

from dataclasses import dataclass

import click
import numpy as np

import minimax_cal as mc
from experiments import sweep
from experiments.external import REAL, arm_of
from experiments.real import here
from experiments.sweep import Study, study_options
from minimax_cal.diagnosing.joint import joint
from minimax_cal.diagnosing.remainder import remainder
from minimax_cal.diagnosing.study import SUM, studied
from minimax_cal.fitting.options import silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.tables import Table

SPLITS = 3
SIMULATED = "simulated play"
COLUMNS = ("geometry", "geometry + process", "named", "named + process", "named, held out")


@dataclass(frozen=True)
class Job:
    """One arm and the seed of a split.  every: of so many rows of the file one is used."""

    arm: str
    seed: int
    every: int = 1


@dataclass(frozen=True)
class Result:
    """rms_mm: of COLUMNS.  where: the largest place of what no name predicts, and its share."""

    rms_mm: tuple[float, ...]
    where: str


def run(job: Job) -> Result:
    """The diagnosis of a split, and what it leaves to predict."""
    robot, data = arm_of(job.arm)
    told = mc.diagnose(robot, data.take(np.arange(0, data.poses, job.every)), seed=job.seed,
                       quick=True)  # fmt: skip
    train = told.data.take(~told.held)
    study = studied(robot, train, fit_cell(robot, train, SUM, silent))
    rms, where = [], ""
    for terms in ((), told.cells[-1].effects.terms):
        rest = remainder(joint(study, terms), told.floor)
        rms += [float(np.hypot(rest.predictable_mm, rest.unpredictable_mm)), rest.unpredictable_mm]
        where = " ".join(f"{place} {100.0 * share:.0f} %" for place, share in rest.where[:1])
    return Result((*rms, told.ladder[-1].trusted.rms_mm), where)


def jobs(study: Study, count: int) -> list[Job]:
    """Every split of every arm; quick: the simulated arm once."""
    if study.quick:
        return [Job(SIMULATED, study.seed)]
    arms = [name for name in REAL if here(name)]
    return [Job(arm, study.seed + i) for arm in (*arms, SIMULATED) for i in range(count)]


@click.command()
@study_options("black_box")
@click.option("--splits", "count", type=int, default=SPLITS, show_default=True)
def main(study: Study, count: int) -> None:
    """What free functions predict beside geometry and beside names, by arm and split."""
    every = jobs(study, count)
    found = study.sweep(run, every, "splits")
    table = Table(
        "RMS mm on groups of training poses left out in turn; the last on held-out poses",
        ("arm", "seed", *COLUMNS, "what no name predicts"),
        tuple((j.arm, j.seed, *r.rms_mm, r.where) for j, r in zip(every, found, strict=True)),
        ("", "d", *[".4f"] * len(COLUMNS), ""),
    )
    rows = [
        {
            "arm": j.arm,
            "seed": j.seed,
            **dict(zip(COLUMNS, r.rms_mm, strict=True)),
            "where": r.where,
        }
        for j, r in zip(every, found, strict=True)
    ]
    study.save([table], {"rows": rows})


if __name__ == "__main__":
    sweep.start(__file__)
