"""What moved between the sessions of a fit: the zero of a joint, the tool, a nest, the base.

The frame of each session is free, so that nothing of this leans on where the instrument stood.
Changes are sought by the evidence among laws that hold at all times, as compliance: what the model
lacks, at poses that differ, may look like a change.  What is named is found again in nearly all
subsamples of the poses.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from minimax_cal.core.arrays import Array
from minimax_cal.core.units import display_unit_of_change
from minimax_cal.fitting.cell_fit import CellFit
from minimax_cal.fitting.session_frames import base_poses_in_sessions
from minimax_cal.fitting.uncertainty import student_quantile
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import cluster_poses
from minimax_cal.measuring.session_frames import convert_to_first_frame
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.effect_names import format_effect
from minimax_cal.modelling.effects.gears import GEAR_RIPPLE
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.modelling.effects.time_effects import SESSION_JUMP
from minimax_cal.modelling.effects_in_model import extend_model_with_effects, pose_arm_at_values
from minimax_cal.modelling.error_rows import linearise_to_point_rows
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.robots.robot import Robot

MAX_P_OF_FRAME_CHANGE = 0.01  # p-value above which a frame may stand where it stood


@dataclass(frozen=True)
class ParameterAmount:
    """A parameter with its 95 % interval.  [SI]"""

    name: str
    value: float
    sigma: float
    low95: float
    high95: float
    unit: str

    @property
    def text(self) -> str:
        """As +0.502 +- 0.003 mrad, the interval of 95 %."""
        scale, unit = display_unit_of_change(self.unit)
        half = 0.5 * scale * (self.high95 - self.low95)
        digits = max(0, 1 - math.floor(math.log10(half))) if half > 0.0 else 3
        return f"{scale * self.value:+.{digits}f} +- {half:.{digits}f} {unit}"


@dataclass(frozen=True)
class SessionChange:
    """Something that is otherwise from a session on, or in one alone.

    effect, place: as in the library.  session: from which on; only: whether in that alone.
    p_value: of so much by accident, among all that was looked at.
    """

    effect: str
    place: str
    session: str
    only: bool
    amounts: tuple[ParameterAmount, ...]
    p_value: float
    text: str

    @property
    def when(self) -> str:
        """In which sessions."""
        return f"in session {self.session} alone" if self.only else f"from {self.session} on"

    @property
    def sizes(self) -> str:
        """By how much."""
        several = len(self.amounts) > 1
        parts = (f"{one.name} {one.text}" if several else one.text for one in self.amounts)
        return f"{', '.join(parts)} (95 %)"

    @property
    def sentence(self) -> str:
        """What changed, by how much, since when, and how a fit takes it into account."""
        if self.text:
            what = f"{format_effect(self.effect, self.place)} {self.when} by {self.sizes}"
            return f"moved between sessions: {what}; effects='{self.text}' fits it"
        if self.p_value > MAX_P_OF_FRAME_CHANGE:
            most = f"{1e3 * self.amounts[0].high95:.2g} mm"
            return f"session {self.session}: instrument and base stand as at first, within {most}"
        return f"instrument or base stands elsewhere {self.when}: {self.sizes}"


# ---- between the sessions ------------------------------------------------------------------------


CHANGE_DRIVERS = frozenset({"time", "session"})  # what laws follow that are no rivals of a change


def find_session_changes(
    robot: Robot, data: Measurements, solved: CellFit, cell: Cell
) -> tuple[SessionChange, ...]:
    """Everything that changed between sessions: of arm, tool and nests, then the frames.

    data: training poses.  cell: of the fit.
    """
    return (*find_law_changes(robot, data, solved), *find_frame_changes(cell, solved))


def find_law_changes(
    robot: Robot, measurements: Measurements, solved: CellFit
) -> tuple[SessionChange, ...]:
    """What changed between sessions beside the frames, clearest first.

    measurements: training poses.
    """
    if len(solved.frames) < 2:
        return ()
    from minimax_cal.modelling.arm_laws import ArmLaws
    from minimax_cal.selection import forward_selection, stability_selection  # slow to import
    from minimax_cal.selection.candidate_library import CandidateLibrary
    from minimax_cal.selection.thresholds import MIN_CONFIRMED_FREQUENCY

    measurements = convert_to_first_frame(measurements, solved.frames)
    model, state = build_point_model(robot, measurements), solved.state
    model, _ = extend_model_with_effects(model, robot, measurements, state, solved.effects.terms)
    model = replace(model, weight=model.weight * solved.robust.weights)
    scene = pose_arm_at_values(robot, measurements, model, state)
    rows = linearise_to_point_rows(model, state, scene.jacobian)
    terms = [
        Term(name, place, choice)
        for name, effect in EFFECTS.items()
        if not (effect.is_map or effect.needs(scene))
        for place in effect.places(scene)
        for choice in effect.choices(scene, place)
        if "session" in choice or effect.follows not in CHANGE_DRIVERS
    ]
    lib = CandidateLibrary.from_terms(ArmLaws(scene, rows, (GEAR_RIPPLE.name,)), terms, ())
    choice = forward_selection.select_effects_by_evidence(lib)
    if not any("session" in found.candidate.term.choice for found in choice.candidate_fits):
        return ()
    group = np.repeat(cluster_poses(measurements), rows.rows_per_pose)
    again = stability_selection.select_on_subsamples(
        choice, stability_selection.build_subsample_masks(group)
    )
    names, out = list(measurements.frames), []
    for number, candidate in enumerate(choice.candidates):
        term = candidate.term
        if (
            "session" not in term.choice
            or again.selection_frequency([term.key]) < MIN_CONFIRMED_FREQUENCY
        ):
            continue
        table, one = choice.compare_with_others(number)
        columns = term.columns(scene)
        half = student_quantile(0.95, table.degrees_of_freedom) * one.sigmas
        found = build_parameter_amounts(columns.names, columns.units, one.values, one.sigmas, half)
        out.append(describe_change(term, names, found, table.p_value(one)))
    return tuple(sorted(out, key=lambda change: change.p_value))


def describe_change(
    term: Term, sessions: Sequence[str], fitted_effect: tuple[ParameterAmount, ...], p_value: float
) -> SessionChange:
    """The change that a law of the sessions is.  sessions: their names."""
    return SessionChange(
        term.effect,
        term.place,
        sessions[int(term.choice["session"]) - 1],
        "alone" in term.choice,
        fitted_effect,
        p_value,
        term.text,
    )


def build_parameter_amounts(
    names: Sequence[str], units: Sequence[str], values: Array, sigmas: Array, half_widths: Array
) -> tuple[ParameterAmount, ...]:
    """Parameters with their intervals.  half_widths: (d,) of their widths."""
    return tuple(
        ParameterAmount(name, float(v), float(s), float(v - h), float(v + h), unit)
        for name, unit, v, s, h in zip(names, units, values, sigmas, half_widths, strict=True)
    )


def find_frame_changes(cell: Cell, solved: CellFit) -> Iterator[SessionChange]:
    """Where the base stands in each further session, as the instrument sees it.

    Whether the instrument or the base was moved no target tells.
    """
    sure, frames = solved.uncertainty, solved.frames
    every = base_poses_in_sessions(frames, cell.base).reshape(-1, 6)
    at = solved.names.geometric_count
    for number, (session, value) in enumerate(zip(list(frames)[1:], every, strict=True)):
        own = slice(at + 6 * number, at + 6 * number + 6)
        covariance = sure.covariance[own, own]
        if not np.isfinite(covariance).all():
            continue
        distance = float(value @ np.linalg.solve(covariance, value)) / 6.0
        p_value = float(fdtrc(6, max(sure.dof, 1.0), distance))
        sigma = np.sqrt(np.diag(covariance))
        sizes = [float(np.linalg.norm(part)) for part in (value[:3], value[3:])]
        spread = [float(np.sqrt((part**2).mean())) for part in (sigma[:3], sigma[3:])]
        half = student_quantile(0.95, sure.dof) * np.array(spread)
        yield SessionChange(
            SESSION_JUMP.name,
            "frame",
            session,
            False,
            build_parameter_amounts(
                ("shift", "turn"), ("m", "rad"), np.array(sizes), np.array(spread), half
            ),
            p_value,
            "",
        )
