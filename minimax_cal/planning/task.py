"""What is to be planned: an arm in its room, what poses can tell, and what is asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.planning import separating
from minimax_cal.planning.candidates import Poses, free_poses
from minimax_cal.planning.designs.criteria import Criterion, Determinant, Eigenvalue, Largest, Trace
from minimax_cal.planning.designs.exchange import Menu
from minimax_cal.planning.options import PlanOptions
from minimax_cal.planning.prospect import Ahead, prospect, with_effects
from minimax_cal.planning.separating import Contest, Question
from minimax_cal.planning.setting import Ground
from minimax_cal.planning.visibility import Room, Sight
from minimax_cal.robots.robot import Robot

WORK = 1000  # poses of the workspace at which positions are predicted

CRITERIA: Mapping[str, Callable[[Ahead, Array], Criterion]] = {
    # of the parameters' covariance, or of the variances at workspace poses by B (w, 3k, f)
    "D": lambda ahead, b: Determinant(),
    "A": lambda ahead, b: Trace(np.eye(len(ahead.scale)) / len(ahead.scale)),
    "E": lambda ahead, b: Eigenvalue(),
    "G": lambda ahead, b: Largest(np.swapaxes(b, 1, 2) @ b),
    "I": lambda ahead, b: Trace(np.einsum("wri,wrj->ij", b, b) / len(b)),
}


@dataclass(frozen=True, eq=False)
class Task:
    """The arm in its room, and what poses can tell of it.

    work: (w, n) poses at which positions are predicted.  known: (f, f) information at hand.
    asked: two effects to tell apart, or nothing.
    """

    options: PlanOptions
    ground: Ground
    room: Room
    sight: Sight
    ahead: Ahead
    work: Array
    known: Array
    asked: tuple[Question, ...]

    @cached_property
    def predictions(self) -> Array:
        """B (w, 3k, f) as `Prospect.predictions`."""
        return self.ahead.predictions(self.work)

    def menu(self, found: Poses) -> Menu:
        """What the candidates tell about the parameters."""
        return Menu(self.ahead.ahead(found.q, found.seen), self.known)

    def contests(self, found: Poses) -> tuple[Contest, ...]:
        """What the candidates tell about the effects asked for."""
        nowhere = np.zeros(found.count, dtype=bool)
        return tuple(
            separating.contest(one, found.q, found.seen[:, self.named(one)], nowhere)
            for one in self.asked
        )

    def aim(self, found: Poses) -> tuple[Menu, Criterion]:
        """What is to be chosen from, and by what."""
        for contest in self.contests(found):
            return contest.menu, contest.criterion
        return self.menu(found), CRITERIA[self.options.criterion](self.ahead, self.predictions)

    def named(self, asked: Question) -> list[int]:
        """Which targets of the cell the measurements behind a question have."""
        names = asked.site.scene.data.target_names
        return [self.ground.cell.target_names.index(name) for name in names]


def task_of(
    robot: Robot, ground: Ground, room: Room, sight: Sight, found: Poses, options: PlanOptions
) -> Task:
    """The task once the candidates are known.  robot: nominal."""
    cell = with_effects(ground.cell, options.effects, found.q)
    ahead = prospect(cell, ground.instrument, found.q, found.seen)
    known = np.zeros((len(ahead.scale),) * 2)
    for one in ground.measured:
        known = known + ahead.known(one)
    work = free_poses(room, WORK, options.seed + 1)
    asked = asked_of(robot, ground, options)
    return Task(options, ground, room, sight, ahead, work, known, asked)


def asked_of(robot: Robot, ground: Ground, options: PlanOptions) -> tuple[Question, ...]:
    """The effects that the poses are to tell apart, if any.  Raises OptionError."""
    if not len(options.separate):
        return ()
    if not ground.measured:
        raise OptionError(
            "separate= needs to know how large the effects are: give measurements as data=, or a "
            "calibration that holds its poses as fit="
        )
    return (
        separating.question(robot, ground.measured[0], ground.cell, options.separate, options.seed),
    )
