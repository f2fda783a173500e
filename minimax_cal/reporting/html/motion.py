"""The report of a motion diagnosis: verdict, budget, friction and torques of a run left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.dynamics.laws import WORDS
from minimax_cal.dynamics.result import MotionDiagnosis
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.tables import Table, filled
from minimax_cal.ground.words import visible
from minimax_cal.modelling.effects.words import name_place
from minimax_cal.reporting.html.charts import (
    LOOKS,
    axis,
    frame,
    heading,
    key,
    line,
    log_axis,
    long_key,
    span,
)
from minimax_cal.reporting.html.content import (
    Block,
    Figure,
    Note,
    Report,
    Section,
    bound,
    caveat,
    label,
    plain,
    text,
)
from minimax_cal.reporting.html.document import FILES, Wording, made_by, signers
from minimax_cal.reporting.html.facts import told_facts
from minimax_cal.reporting.html.sources import File, Result, content_of

SHOWN = 3  # joints that are drawn on a page, the worst ones
BAND = 2.0  # standard deviations of a band
SPEEDS = "speed [rad/s, m/s]"


@dataclass(frozen=True, eq=False)
class MotionSource:
    """A motion diagnosis, and its file."""

    found: MotionDiagnosis
    file: File

    def lines(self) -> list[str]:
        """For a terminal."""
        return [self.found.headline()]

    complaint = look = ""  # nothing is required of torques

    def tables(self) -> tuple[Table, ...]:
        """For a terminal."""
        return ()


def motion_of(results: Sequence[Result]) -> MotionSource | None:
    """The motion diagnosis among results; None where there is none.  Raises CalibrationError."""
    for result in filter(is_motion, results):
        content, path, digest = content_of(result)
        if len(results) > 1:
            raise CalibrationError(f"{path}: is a motion diagnosis; report it alone")
        found = MotionDiagnosis.from_dict(content, path)
        return MotionSource(found, File(found.KIND, path, digest))
    return None


def is_motion(result: Result) -> bool:
    """Whether a result is a motion diagnosis.  Raises CalibrationError for a file without JSON."""
    if isinstance(result, Path | str):
        return bool(content_of(result)[0].get("kind") == MotionDiagnosis.KIND)
    return isinstance(result, MotionDiagnosis)


def compose_motion(source: MotionSource, wording: Wording) -> Report:
    """The whole report.  Raises OptionError for what is asked of positions."""
    for name, given in (("tolerance", wording.limits), ("deliver", wording.deliver),
                        ("step", wording.rung is not None)):  # fmt: skip
        if given:
            raise OptionError(
                f"{name}= is of positions; a motion diagnosis is of torques: leave it"
            )
    found = source.found
    robot = found.arm.robot.name
    facts = [("Robot", visible(robot)), *told_facts(wording.facts, None)]
    facts += [("Customer", visible(wording.customer))] if wording.customer else []
    facts += [("Date of this report", wording.date), ("Held out", found.held_out)]
    facts += [("Logs", ", ".join(map(visible, found.runs)))]
    worst = np.argsort(-np.array(found.budget[-1].holdout_rms_moving))
    sheets = (
        Section("verdict", "Result", verdict_blocks(found)),
        Section("budget", "Error budget", budget_blocks(found)),
        Section("where", "Where the errors are",
                (*unexplained_blocks(found), *joint_figures(found, worst[:SHOWN]))),
        Section("parameters", "Parameters", effect_blocks(found)),
    )  # fmt: skip
    rest = joint_figures(found, worst[SHOWN:])
    more = (
        Section("torques", "Torques and friction of the other joints", rest),
        Section("untestable", "What could not be tested", untestable_blocks(found)),
        Section("provenance", "Provenance", provenance_blocks(source)),
    )
    return Report(
        title=visible(wording.title) or f"Torques of {visible(robot)}",
        robot=visible(robot),
        facts=tuple(facts),
        signatures=signers(visible(wording.author), visible(wording.customer)),
        sections=bound(sheets, more, wording.appendix),
        digest="",
        kind="Motion diagnosis",
    )


def verdict_blocks(found: MotionDiagnosis) -> tuple[Block, ...]:
    """The answer, and what to bear in mind."""
    notices = (Note(one, "notice") for one in found.notices)
    return (Note(found.headline(), "verdict"), *notices, budget_figure(found))


def budget_blocks(found: MotionDiagnosis) -> tuple[Block, ...]:
    """Tables of all rows and of moving ones."""
    return found.budget_table(), found.budget_table("moving", "holdout_rms_moving")


def budget_figure(found: MotionDiagnosis) -> Figure:
    """What each step leaves, one panel a joint."""
    joints, steps = len(found.curves), [step.name.replace("_", " ") for step in found.budget]
    values = np.array([step.holdout_rms_moving for step in found.budget]).T
    traces: list[dict[str, Any]] = []
    layout = frame(annotations=[heading(f"J{j + 1}", j, joints) for j in range(joints)])
    for j in range(joints):
        trace = line("after", f"J{j + 1}", values[j], np.arange(len(steps)), panel=j)
        traces.append({**trace, "mode": "lines+markers", "showlegend": False})
        x = {**log_axis(f"[{found.unit}]", values[j]), "domain": span(j, joints, 0.03)}
        y = axis("", autorange="reversed", showticklabels=j == 0, tickmode="array",
                 tickvals=list(range(len(steps))), ticktext=list(map(label, steps)))  # fmt: skip
        if j:
            x["anchor"], y["anchor"] = key("y", j), key("x", j)
        layout |= {long_key("x", j): x, long_key("y", j): y}
    layout["margin"] = {**layout["margin"], "l": 170}
    says = "RMS torque that each step leaves of moving rows, on runs that its fit did not see."
    return Figure("budget", "What each step leaves", says, tuple(traces), layout, 380)


def effect_blocks(found: MotionDiagnosis) -> tuple[Block, ...]:
    """Effects with their values, and what else they could be."""
    if not found.effects:
        return (text("No effect is shown by these logs."),)
    rows = (
        (one.words, f"{WORDS[a.effect]} {name_place(a.place)}", a.rho2, a.separate_with)
        for one in found.effects
        for a in one.alternatives
    )
    columns = "effect | could be | similarity .2f | what tells them apart"
    return filled(found.effects_table(), Table.made("Alternatives", rows, columns))


def joint_figures(found: MotionDiagnosis, joints: Array) -> tuple[Block, ...]:
    """Of some joints, a run left out and the friction curve."""
    return tuple(joint_figure(found, int(j)) for j in joints)


def joint_figure(found: MotionDiagnosis, j: int) -> Figure:
    """Measured and predicted torque, and friction over speed with its band."""
    run, curve, unit = found.held_run, found.curves[j], found.unit
    time, speed, friction, wide = np.array(run.time), curve.speed, curve.torque, BAND * curve.sigma
    colour, _, _, soft = LOOKS["after"]
    band = {
        "type": "scatter", "mode": "lines", "name": "two standard deviations",
        "x": plain(np.concatenate([speed, speed[::-1]])),
        "y": plain(np.concatenate([friction + wide, (friction - wide)[::-1]])),
        "fill": "toself", "fillcolor": soft, "line": {"color": colour, "width": 0},
        "hoverinfo": "skip", "showlegend": False, "xaxis": "x2", "yaxis": "y2",
    }  # fmt: skip
    traces = (
        line("before", "measured", time, run.measured[j]),
        line("after", "predicted without this run", time, run.predicted[j]),
        band,
        line("after", "friction", speed, friction, panel=1, showlegend=False),
    )
    layout = frame(
        xaxis=axis("time [s]", domain=[0.0, 0.62]),
        yaxis=axis(f"J{j + 1} [{unit}]"),
        xaxis2=axis(SPEEDS, domain=[0.72, 1.0], anchor="y2"),
        yaxis2=axis(f"friction [{unit}]", anchor="x2"),
    )
    left = found.budget[-1].holdout_rms_moving[j]
    says = (
        f"Torque of joint {j + 1} on a part of {visible(run.name)}, which the fit did not see "
        f"(it misses {left:.3g} {unit} RMS where the joint moves), and its friction over speed."
    )
    return Figure(f"joint-{j + 1}", f"Joint {j + 1}", says, traces, layout, 320)


def unexplained_blocks(found: MotionDiagnosis) -> tuple[Block, ...]:
    """What remains that follows something."""
    if not found.unexplained:
        return (text("What remains looks random."),)
    return (found.unexplained_table(),)


def untestable_blocks(found: MotionDiagnosis) -> tuple[Block, ...]:
    """What these logs cannot tell, and the run that would."""
    if not found.not_testable:
        return (text("These logs test every effect."),)
    rows = ((WORDS[one.effect], one.place, one.needs) for one in found.not_testable)
    notes = [caveat(f"Too little motion: {one}.") for one in found.too_little]
    return (*notes, Table.made("Not testable", rows, "effect | at | what would tell"))


def provenance_blocks(source: MotionSource) -> tuple[Block, ...]:
    """The file and the programs."""
    row = ("motion diagnosis", visible(source.file.path), source.file.digest)
    return Table.made("Files", [row], FILES), made_by()
