"""A motion diagnosis on logs that no fit saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from minimax_cal.dynamics.given import runs_of
from minimax_cal.dynamics.model import TorqueModel
from minimax_cal.dynamics.result import MotionDiagnosis, load_motion, table_by_joint
from minimax_cal.dynamics.rows import Logs, prepare, rms_by_joint
from minimax_cal.dynamics.run import Run
from minimax_cal.dynamics.scene import Scene
from minimax_cal.dynamics.search import Columns
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.facts import Fact
from minimax_cal.ground.results import Result
from minimax_cal.ground.tables import Table


@dataclass(frozen=True)
class MotionStepError:
    """What a step misses, by joint: RMS of all rows, and of those that move."""

    name: str
    rms: tuple[float, ...]
    rms_moving: tuple[float, ...]


@dataclass(frozen=True)
class MotionEvaluation(Result):
    """How well each step of a motion diagnosis predicts torques of other logs [unit]."""

    KIND = "motion_evaluation"
    COMMAND = "evaluate"
    unit: str
    steps: Annotated[tuple[MotionStepError, ...], Fact(key="rungs", fewest=1)]
    runs: tuple[str, ...]
    notices: tuple[str, ...]

    def beside(self, *, poses: bool = True) -> dict[str, Any]:
        """What the last step misses."""
        return {"rms": self.steps[-1].rms, "rms_moving": self.steps[-1].rms_moving}

    def headline(self) -> str:
        """What the last step misses, in the middle of the joints."""
        size = f"{np.median(self.steps[-1].rms):.3g} {self.unit}"
        return f"RMS torque missed, median of the joints: {size}."

    def table(self) -> Table:
        """RMS of all rows by joint, step by step."""
        title = f"RMS torque [{self.unit}] on {', '.join(self.runs)}, all rows"
        return table_by_joint(title, "step", self.steps, "rms")


def missed(model: TorqueModel, logs: Logs, columns: Columns) -> Array:
    """(R, n) what a model misses.  columns: of a scene with its context."""
    seen = logs.earlier(model.delay) if model.delay else logs
    return np.asarray(seen.y - model.predict(columns))


def evaluate_motion(
    motion: MotionDiagnosis | str | Path, logs: Sequence[Run | str | Path] | str | Path
) -> MotionEvaluation:
    """RMS torque that a motion diagnosis misses on other logs; nothing is fitted.

    Parameters
    ----------
    motion
        Loaded, or its path.
    logs
        Files or runs.

    Returns
    -------
    MotionEvaluation
        Both sides pass the 8 Hz zero-phase filter, at 25 rows a second.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.evaluate_motion("motion.json", ["other.csv"]).table())
    """
    found = load_motion(motion)
    arm = found.arm
    runs = runs_of(arm.robot, arm.robot, logs)
    if runs[0].unit != found.unit:
        raise OptionError(
            f"{runs[0].source}: is in {runs[0].unit}, the diagnosis in {found.unit}; give logs of "
            "the same kind"
        )
    prepared = prepare(runs)
    if not arm.known.any():
        prepared = replace(prepared, payload=np.full_like(prepared.payload, np.nan))
    scene = Scene.of(arm, prepared)
    columns = cache(lambda context: Columns(context.in_scene(scene)))
    steps = []
    for model in found.models:
        off = missed(model, prepared, columns(model.context))
        ends = rms_by_joint(off), rms_by_joint(off, prepared.moving)
        steps.append(MotionStepError(model.name, *(tuple(end.tolist()) for end in ends)))
    said = tuple(text for run in runs for text in run.notices)
    return MotionEvaluation(found.unit, tuple(steps), prepared.names, said)
