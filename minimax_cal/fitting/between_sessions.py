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

from minimax_cal.fitting.solve import Solved
from minimax_cal.fitting.stations import jumps
from minimax_cal.fitting.uncertainty import quantile
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.units import for_people
from minimax_cal.measuring.grouping import clusters
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.stations import seen_from
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.gears import GEAR_RIPPLE
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.modelling.effects.time import SESSION_JUMP
from minimax_cal.modelling.effects.words import name_effect
from minimax_cal.modelling.joint_fit import extended, scene_of
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.rows import linearised
from minimax_cal.robots.robot import Robot

STILL = 0.01  # p-value above which a frame may stand where it stood


@dataclass(frozen=True)
class Amount:
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
        scale, unit = for_people(self.unit)
        half = 0.5 * scale * (self.high95 - self.low95)
        digits = max(0, 1 - math.floor(math.log10(half))) if half > 0.0 else 3
        return f"{scale * self.value:+.{digits}f} +- {half:.{digits}f} {unit}"


@dataclass(frozen=True)
class Change:
    """Something that is otherwise from a session on, or in one alone.

    effect, place: as in the library.  session: from which on; only: whether in that alone.
    p_value: of so much by accident, among all that was looked at.
    """

    effect: str
    place: str
    session: str
    only: bool
    amounts: tuple[Amount, ...]
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
            what = f"{name_effect(self.effect, self.place)} {self.when} by {self.sizes}"
            return f"moved between sessions: {what}; effects='{self.text}' fits it"
        if self.p_value > STILL:
            most = f"{1e3 * self.amounts[0].high95:.2g} mm"
            return f"session {self.session}: instrument and base stand as at first, within {most}"
        return f"instrument or base stands elsewhere {self.when}: {self.sizes}"


# ---- between the sessions ------------------------------------------------------------------------


CHANGING = frozenset({"time", "session"})  # what laws follow that are no rivals of a change


def between_sessions(
    robot: Robot, data: Measurements, solved: Solved, cell: Cell
) -> tuple[Change, ...]:
    """Everything that changed between sessions: of arm, tool and nests, then the frames.

    data: training poses.  cell: of the fit.
    """
    return (*changes(robot, data, solved), *frame_changes(cell, solved))


def changes(robot: Robot, data: Measurements, solved: Solved) -> tuple[Change, ...]:
    """What changed between sessions beside the frames, clearest first.

    data: training poses.
    """
    if len(solved.frames) < 2:
        return ()
    from minimax_cal.evidence import selection, stability  # slow to import
    from minimax_cal.evidence.library import Library
    from minimax_cal.evidence.limits import CONFIRMED
    from minimax_cal.modelling.dictionary import ArmLaws

    data = seen_from(data, solved.frames)
    model, state = model_of(robot, data), solved.state
    model, _ = extended(model, robot, data, state, solved.effects.terms)
    model = replace(model, weight=model.weight * solved.robust.weights)
    scene = scene_of(robot, data, model, state)
    rows = linearised(model, state, scene.jacobian)
    terms = [
        Term(name, place, choice)
        for name, effect in EFFECTS.items()
        if not (effect.is_map or effect.needs(scene))
        for place in effect.places(scene)
        for choice in effect.choices(scene, place)
        if "session" in choice or effect.follows not in CHANGING
    ]
    lib = Library.of(ArmLaws(scene, rows, (GEAR_RIPPLE.name,)), terms, ())
    choice = selection.select(lib)
    if not any("session" in found.candidate.term.choice for found in choice.found):
        return ()
    group = np.repeat(clusters(data), rows.width)
    again = stability.repeated(choice, stability.subsamples(group))
    names, out = list(data.frames), []
    for number, candidate in enumerate(choice.chosen):
        term = candidate.term
        if "session" not in term.choice or again.frequency([term.key]) < CONFIRMED:
            continue
        table, one = choice.beside_others(number)
        columns = term.columns(scene)
        half = quantile(0.95, table.dof) * one.sigma
        found = amounts(columns.names, columns.units, one.value, one.sigma, half)
        out.append(change_of(term, names, found, table.p_value(one)))
    return tuple(sorted(out, key=lambda change: change.p_value))


def change_of(
    term: Term, sessions: Sequence[str], found: tuple[Amount, ...], p_value: float
) -> Change:
    """The change that a law of the sessions is.  sessions: their names."""
    return Change(
        term.effect,
        term.place,
        sessions[int(term.choice["session"]) - 1],
        "alone" in term.choice,
        found,
        p_value,
        term.text,
    )


def amounts(
    names: Sequence[str], units: Sequence[str], value: Array, sigma: Array, half: Array
) -> tuple[Amount, ...]:
    """Parameters with their intervals.  half: (d,) of their widths."""
    return tuple(
        Amount(name, float(v), float(s), float(v - h), float(v + h), unit)
        for name, unit, v, s, h in zip(names, units, value, sigma, half, strict=True)
    )


def frame_changes(cell: Cell, solved: Solved) -> Iterator[Change]:
    """Where the base stands in each further session, as the instrument sees it.

    Whether the instrument or the base was moved no target tells.
    """
    sure, frames = solved.uncertainty, solved.frames
    every = jumps(frames, cell.base).reshape(-1, 6)
    at = solved.names.geometric
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
        half = quantile(0.95, sure.dof) * np.array(spread)
        yield Change(
            SESSION_JUMP.name,
            "frame",
            session,
            False,
            amounts(("shift", "turn"), ("m", "rad"), np.array(sizes), np.array(spread), half),
            p_value,
            "",
        )
