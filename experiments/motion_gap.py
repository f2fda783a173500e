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
from experiments.driven_arms import (
    DRIVEN_ARMS,
    draw_commanded_motion,
    draw_driven_arm,
    simulate_controlled_run,
    simulate_logs,
)
from experiments.motion_real import UR10E_DRIVE_GAINS, UR10E_GEAR_RATIO, UR10E_TORQUE_FOLDER
from experiments.real_arms import SHARED_DATA_FOLDER, has_measurements
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table
from minimax_cal.robots.mjcf_import import import_mujoco

WITHHELD_EFFECT_SETS = (  # of the cases of an arm, in turn
    ("friction", "payload"),
    ("friction", "load"),
    ("friction", "load", "armature", "payload"),
    ("friction", "armature"),
    ("friction", "load", "armature", "payload", "delay"),
)
MOTION_GAP_LOG_RUNS, MOTION_GAP_RUN_SECONDS = 4, 10.0  # of the logs
UNSEEN_RUN_NUMBER, UNSEEN_RUN_SPEED_FACTOR, UNSEEN_RUN_SECONDS = 77, 1.1, 8.0  # the run that judges


@dataclass(frozen=True)
class MotionGapCase:
    """A simulated arm, and what its file lacks."""

    arm: str
    withheld: tuple[str, ...]
    seed: int


@dataclass(frozen=True)
class ClosedMotionGap:
    """What remains on the unseen run, over what was: of the joint error, and of each torque.

    before, after: joint error [mrad] of the file as given, and corrected.
    torque: (n,) of what the file as given had.
    """

    before: float
    after: float
    torque: Array


def run_case(case: MotionGapCase) -> ClosedMotionGap:
    """Correct the file of an arm by its logs, and let it follow commands that these do not hold."""
    arm = draw_driven_arm(case.arm, case.seed, case.withheld)
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "arm.xml", Path(folder) / "corrected.xml"
        path.write_bytes(arm.xml)
        mc.motion_gap(
            path,
            simulate_logs(arm, MOTION_GAP_LOG_RUNS, MOTION_GAP_RUN_SECONDS),
            write=out,
            driven=False,
        )
        first, last = (import_mujoco().MjModel.from_xml_path(str(one)) for one in (path, out))
    at = draw_commanded_motion(arm, UNSEEN_RUN_NUMBER, UNSEEN_RUN_SPEED_FACTOR)
    real = simulate_controlled_run(
        arm, arm.compile_real_arm(), at, UNSEEN_RUN_SECONDS, arm.withheld
    )

    def missed(model: Any) -> tuple[float, Array]:
        course = simulate_controlled_run(arm, model, at, UNSEEN_RUN_SECONDS)
        off, torque = course.q - real.q, course.torque - real.torque
        return 1e3 * float(np.sqrt((off**2).mean())), np.sqrt((torque**2).mean(axis=0))

    before, after = missed(first), missed(last)
    return ClosedMotionGap(before[0], after[0], after[1] / before[1])


# ---- the real arm ------------------------------------------------------------------------------


@dataclass(frozen=True)
class LeftOutRealRun:
    """The run of the real arm that judges."""

    run: int


@dataclass(frozen=True)
class JudgedRealRun:
    """RMS current (n,) under the measured motion of the run [A], all rows.

    before: of the URDF.  after: of the corrected file.
    """

    name: str
    before: Array
    after: Array


def judge_left_out_run(left: LeftOutRealRun) -> JudgedRealRun:
    """The corrected model on a run of the real arm that no fit saw."""
    files = sorted((SHARED_DATA_FOLDER / UR10E_TORQUE_FOLDER).glob("*.csv"))
    name = files[left.run].stem
    gap = mc.motion_gap(
        SHARED_DATA_FOLDER / UR10E_TORQUE_FOLDER / "ur10e.urdf",
        files,
        holdout_run=name,
        drive_gain=UR10E_DRIVE_GAINS,
        ratio=UR10E_GEAR_RATIO,
        driven=False,
    )
    return JudgedRealRun(name, *(np.array(gap.rungs[end].torque_rms) for end in (0, -1)))


# ---- tables ------------------------------------------------------------------------------------


MODEL_LABELS = {"before": "URDF", "after": "corrected file"}


def build_closed_gap_table(
    cases: Sequence[MotionGapCase], gaps: Sequence[ClosedMotionGap]
) -> Table:
    """What remains on the unseen run, case by case, and its median."""
    rows = []
    for case, one in zip(cases, gaps, strict=True):
        rows.append((f"{case.arm} {case.seed}: {', '.join(case.withheld)}", one.before,
                     *remaining_percentages(one)))  # fmt: skip
    each = np.array([remaining_percentages(one) for one in gaps])
    rows.append(("median", float(np.median([one.before for one in gaps])),
                 *np.median(each, axis=0).tolist()))  # fmt: skip

    title = "Simulated arms on a run that no log holds: what remains after gap --write"
    return Table.from_rows(
        title,
        rows,
        "withheld | joint error as given mrad .3g | remains % .3g | worst torque % .3g",
    )


def remaining_percentages(gap: ClosedMotionGap) -> tuple[float, float]:
    """Of joint error and worst torque [%]."""
    return 100.0 * gap.after / gap.before, 100.0 * float(gap.torque.max())


def build_real_arm_table(judged_runs: Sequence[JudgedRealRun]) -> Table:
    """RMS current of the real arm's runs, each judged by a model that did not see it."""
    n = len(judged_runs[0].before)
    rows = []
    for name, said in MODEL_LABELS.items():
        each = np.array([getattr(one, name) for one in judged_runs])
        rows.append((said, *np.sqrt((each**2).mean(axis=0)).tolist()))
    title = (
        f"UR10e: RMS current [A] under measured motion, {len(judged_runs)} runs left out, all rows"
    )
    return Table.from_rows(title, rows, "model", *(f"J{j + 1} .3g" for j in range(n)))


@study_options("motion_gap")
def main(study: Study) -> None:
    """The dynamic gap in the simulator, before and after."""
    arms = DRIVEN_ARMS[-1:] if study.quick else DRIVEN_ARMS
    kinds = WITHHELD_EFFECT_SETS[2:3] if study.quick else WITHHELD_EFFECT_SETS
    cases = [MotionGapCase(arm, kind, study.seed + number)
             for arm in arms for number, kind in enumerate(kinds)]  # fmt: skip
    found = study.sweep(run_case, cases, "simulated arms")
    tables = [build_closed_gap_table(cases, found)]
    content: dict[str, object] = {
        "cases": [
            {**vars(case), "before_mrad": one.before, "remains_percent": remaining_percentages(one)}
            for case, one in zip(cases, found, strict=True)
        ]
    }
    if not study.quick and has_measurements(UR10E_TORQUE_FOLDER):
        count = len(list((SHARED_DATA_FOLDER / UR10E_TORQUE_FOLDER).glob("*.csv")))
        judged = study.sweep(
            judge_left_out_run, [LeftOutRealRun(i) for i in range(count)], "runs left out"
        )
        tables.append(build_real_arm_table(judged))
        content["real"] = [
            {"run": one.name, **{name: getattr(one, name).tolist() for name in MODEL_LABELS}}
            for one in judged
        ]
    study.save(tables, content)
