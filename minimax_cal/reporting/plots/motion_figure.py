"""The picture of a motion diagnosis: torques of a held-out run, friction curves, error budget."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from minimax_cal.dynamics.result import MotionDiagnosis
from minimax_cal.reporting.plots.error_figure import (
    AFTER_COLOUR,
    BEFORE_COLOUR,
    new_figure,
    set_plain_log_ticks,
    write_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from minimax_cal.simulators.result import MotionGap

JOINT_ROW_INCHES = 1.7  # of a joint


def write_motion_figure(diagnosis: MotionDiagnosis, path: Path | str) -> None:
    """Draw a motion diagnosis.  path: its suffix, one of `figures.PICTURES`, is the format."""
    write_figure(build_motion_figure(diagnosis), Path(path))


def build_motion_figure(diagnosis: MotionDiagnosis) -> Figure:
    """One row a joint: measured and predicted torque, friction over speed, budget."""
    joints = len(diagnosis.budget[0].holdout_rms)
    figure = new_figure(12, 1.2 + JOINT_ROW_INCHES * joints)
    cells = figure.subplots(joints, 3, squeeze=False, width_ratios=(2.2, 1.0, 1.2))
    for j in range(joints):
        draw_joint_torques(cells[j, 0], diagnosis, j)
        draw_friction_curve(cells[j, 1], diagnosis, j)
        draw_joint_budget(cells[j, 2], diagnosis, j)
        if j < joints - 1:
            cells[j, 0].tick_params(labelbottom=False)
    title = f"held-out torque [{diagnosis.unit}], {diagnosis.held_run.name}"
    cells[0, 0].set_title(title, fontsize="small")
    cells[0, 1].set_title(f"friction [{diagnosis.unit}] over speed", fontsize="small")
    cells[0, 2].set_title(f"held-out RMS, moving [{diagnosis.unit}]", fontsize="small")
    cells[-1, 0].set_xlabel("time [s]")
    cells[-1, 1].set_xlabel("speed [rad/s]")
    cells[0, 0].legend(frameon=False, ncols=2, fontsize="x-small", loc="upper right")
    figure.suptitle(textwrap.fill(diagnosis.headline(), 110), fontweight="bold", fontsize="medium")
    return figure


def draw_joint_torques(axes: Axes, diagnosis: MotionDiagnosis, joint_index: int) -> None:
    """Measured and predicted torque of a joint."""
    run = diagnosis.held_run
    axes.plot(run.time, run.measured[joint_index], color=BEFORE_COLOUR, lw=1.4, label="measured")
    axes.plot(
        run.time,
        run.predicted[joint_index],
        color=AFTER_COLOUR,
        lw=0.8,
        label="predicted without this run",
    )
    axes.set_ylabel(f"J{joint_index + 1}")
    axes.grid(visible=True, alpha=0.3)


def draw_friction_curve(axes: Axes, diagnosis: MotionDiagnosis, joint_index: int) -> None:
    """Friction of a joint with a band of two standard deviations."""
    curve = diagnosis.curves[joint_index]
    speed, torque, wide = curve.speed, curve.torque, 2.0 * curve.sigma
    axes.fill_between(speed, torque - wide, torque + wide, color=AFTER_COLOUR, alpha=0.25)
    axes.plot(speed, torque, color=AFTER_COLOUR, lw=1.2)
    axes.axhline(0.0, color="grey", lw=0.6)
    axes.grid(visible=True, alpha=0.3)


def draw_joint_budget(axes: Axes, diagnosis: MotionDiagnosis, joint_index: int) -> None:
    """What each step leaves at a joint."""
    left = np.array([step.holdout_rms_moving[joint_index] for step in diagnosis.budget])
    at = np.arange(len(left))
    axes.plot(left, at, "o-", color="black", ms=3, lw=0.8)
    if (positive := left[left > 0.0]).size:
        axes.set_xscale("log")
        set_plain_log_ticks(axes.xaxis, positive)
    names = [step.name.replace("_", " ") for step in diagnosis.budget]
    axes.set_yticks(at, [textwrap.shorten(name, 24, placeholder="...") for name in names],
                    fontsize=5.5)  # fmt: skip
    axes.set_ylim(len(left) - 0.5, -0.5)
    axes.tick_params(axis="x", labelsize="x-small")
    axes.grid(visible=True, axis="x", alpha=0.3)


# ---- the model in a simulator ------------------------------------------------------------------


def write_motion_gap_figure(gap: MotionGap, path: Path | str) -> None:
    """Draw how far a model moves as the arm does.  path: its suffix is the format."""
    write_figure(build_motion_gap_figure(gap), Path(path))


def build_motion_gap_figure(gap: MotionGap) -> Figure:
    """Torque and joint error of every joint, from the model as given to the corrected one."""
    names = [textwrap.shorten(rung.name, 40, placeholder="...") for rung in gap.rungs]
    moving = [r.torque_rms_moving for r in gap.rungs]
    parts = [(f"torque [{gap.unit}], moving, held out", moving)] if gap.unit else []
    if gap.rungs[0].tracking_rms_mrad:
        parts.append(("joint error [mrad], driven", [r.tracking_rms_mrad for r in gap.rungs]))
    figure = new_figure(5.5 * len(parts), 2.0 + 0.4 * len(names))
    cells = figure.subplots(1, len(parts), squeeze=False, sharey=True)[0]
    at = np.arange(len(names))
    for axes, (title, rows) in zip(cells, parts, strict=True):
        values = np.array(rows)
        for j, column in enumerate(values.T):
            axes.plot(column, at, "o-", ms=4, lw=1.0, label=f"J{j + 1}")
        if (positive := values[values > 0.0]).size:
            axes.set_xscale("log")
            set_plain_log_ticks(axes.xaxis, positive)
        axes.set_title(title, fontsize="small")
        axes.grid(visible=True, axis="x", alpha=0.3)
    cells[0].set_yticks(at, names, fontsize="small")
    cells[0].set_ylim(len(names) - 0.5, -0.5)
    cells[-1].legend(frameon=False, fontsize="small")
    figure.suptitle(textwrap.fill(gap.headline(), 100), fontweight="bold", fontsize="medium")
    return figure
