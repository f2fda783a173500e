"""How far a simulator's model moves as the real arm does, once logs corrected it.

    python -m experiments.motion_gap [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N]

Simulated "real" arms in MuJoCo with friction, friction of the load, rotor inertias, a payload and a
delay that their files do not have: after `gap --write`, model and arm follow commands that no log
holds, under a controller that knows the first file alone.  What remains of the joint error and of
the torque error is counted.  The real UR10e, where its logs are on this machine: the corrected
model under the measured motion of runs that no fit saw.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import minimax_cal as mc
from experiments.driven_arms import ARMS, commands, drawn_arm, drive_along, logged
from experiments.motion_real import DRIVE_GAIN, RATIO, REAL
from experiments.real import SHARED, here
from experiments.sweep import Study, study_options
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Table
from minimax_cal.robots.mjcf import mujoco

WITHHELD = (  # of the cases of an arm, in turn
    ("friction", "payload"),
    ("friction", "load"),
    ("friction", "load", "armature", "payload"),
    ("friction", "armature"),
    ("friction", "load", "armature", "payload", "delay"),
)
RUNS, SECONDS = 4, 10.0  # of the logs
UNSEEN, UNSEEN_SPEED, UNSEEN_SECONDS = 77, 1.1, 8.0  # the run that judges


@dataclass(frozen=True)
class Case:
    """A simulated arm, and what its file lacks."""

    arm: str
    withheld: tuple[str, ...]
    seed: int


@dataclass(frozen=True)
class Closed:
    """What remains on the unseen run, over what was: of the joint error, and of each torque.

    before, after: joint error [mrad] of the file as given, and corrected.
    torque: (n,) of what the file as given had.
    """

    before: float
    after: float
    torque: Array


def run(case: Case) -> Closed:
    """Correct the file of an arm by its logs, and let it follow commands that these do not hold."""
    arm = drawn_arm(case.arm, case.seed, case.withheld)
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "arm.xml", Path(folder) / "corrected.xml"
        path.write_bytes(arm.xml)
        mc.motion_gap(path, logged(arm, RUNS, SECONDS), write=out, driven=False)
        first, last = (mujoco().MjModel.from_xml_path(str(one)) for one in (path, out))
    at = commands(arm, UNSEEN, UNSEEN_SPEED)
    real = drive_along(arm, arm.real(), at, UNSEEN_SECONDS, arm.withheld)

    def missed(model: Any) -> tuple[float, Array]:
        course = drive_along(arm, model, at, UNSEEN_SECONDS)
        off, torque = course.q - real.q, course.torque - real.torque
        return 1e3 * float(np.sqrt((off**2).mean())), np.sqrt((torque**2).mean(axis=0))

    before, after = missed(first), missed(last)
    return Closed(before[0], after[0], after[1] / before[1])


# ---- the real arm ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Left:
    """The run of the real arm that judges."""

    run: int


@dataclass(frozen=True)
class Judged:
    """RMS current (n,) under the measured motion of the run [A], all rows.

    before: of the URDF.  after: of the corrected file.
    """

    name: str
    before: Array
    after: Array


def judge(left: Left) -> Judged:
    """The corrected model on a run of the real arm that no fit saw."""
    files = sorted((SHARED / REAL).glob("*.csv"))
    name = files[left.run].stem
    gap = mc.motion_gap(
        SHARED / REAL / "ur10e.urdf",
        files,
        holdout_run=name,
        drive_gain=DRIVE_GAIN,
        ratio=RATIO,
        driven=False,
    )
    return Judged(name, *(np.array(gap.rungs[end].torque_rms) for end in (0, -1)))


# ---- tables ------------------------------------------------------------------------------------


SAID = {"before": "URDF", "after": "corrected file"}


def closed_table(cases: Sequence[Case], found: Sequence[Closed]) -> Table:
    """What remains on the unseen run, case by case, and its median."""
    rows = []
    for case, one in zip(cases, found, strict=True):
        rows.append((f"{case.arm} {case.seed}: {', '.join(case.withheld)}", one.before,
                     *shares(one)))  # fmt: skip
    each = np.array([shares(one) for one in found])
    rows.append(("median", float(np.median([one.before for one in found])),
                 *np.median(each, axis=0).tolist()))  # fmt: skip

    title = "Simulated arms on a run that no log holds: what remains after gap --write"
    return Table.made(
        title,
        rows,
        "withheld | joint error as given mrad .3g | remains % .3g | worst torque % .3g",
    )


def shares(one: Closed) -> tuple[float, float]:
    """Of joint error and worst torque [%]."""
    return 100.0 * one.after / one.before, 100.0 * float(one.torque.max())


def real_table(found: Sequence[Judged]) -> Table:
    """RMS current of the real arm's runs, each judged by a model that did not see it."""
    n = len(found[0].before)
    rows = []
    for name, said in SAID.items():
        each = np.array([getattr(one, name) for one in found])
        rows.append((said, *np.sqrt((each**2).mean(axis=0)).tolist()))
    title = f"UR10e: RMS current [A] under measured motion, {len(found)} runs left out, all rows"
    return Table.made(title, rows, "model", *(f"J{j + 1} .3g" for j in range(n)))


@study_options("motion_gap")
def main(study: Study) -> None:
    """The dynamic gap in the simulator, before and after."""
    arms = ARMS[-1:] if study.quick else ARMS
    kinds = WITHHELD[2:3] if study.quick else WITHHELD
    cases = [Case(arm, kind, study.seed + number)
             for arm in arms for number, kind in enumerate(kinds)]  # fmt: skip
    found = study.sweep(run, cases, "simulated arms")
    tables = [closed_table(cases, found)]
    content: dict[str, object] = {
        "cases": [{**vars(case), "before_mrad": one.before, "remains_percent": shares(one)}
                  for case, one in zip(cases, found, strict=True)]
    }  # fmt: skip
    if not study.quick and here(REAL):
        count = len(list((SHARED / REAL).glob("*.csv")))
        judged = study.sweep(judge, [Left(i) for i in range(count)], "runs left out")
        tables.append(real_table(judged))
        content["real"] = [{"run": one.name, **{name: getattr(one, name).tolist() for name in SAID}}
                           for one in judged]  # fmt: skip
    study.save(tables, content)
