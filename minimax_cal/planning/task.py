"""What is to be planned: an arm in its room, what poses can tell, and what is asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from minimax_cal.evidence.noise import Noise, restricted
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.checks import wild
from minimax_cal.fitting.opened import Result, open_result
from minimax_cal.fitting.same_arm import check_arm
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.measuring.checks import check_joints
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import fields_of
from minimax_cal.modelling.joint_fit import scene_of
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.parameters import Names, State, links_of, zero_positions
from minimax_cal.modelling.rows import linearised
from minimax_cal.planning import separating
from minimax_cal.planning.candidates import Poses, free_poses, limits_of
from minimax_cal.planning.designs.criteria import Criterion, Determinant, Eigenvalue, Largest, Trace
from minimax_cal.planning.designs.exchange import Menu
from minimax_cal.planning.options import PlanOptions
from minimax_cal.planning.prospect import (
    Instrument,
    Prospect,
    cell_ahead,
    front,
    prospect,
    ring,
    with_effects,
)
from minimax_cal.planning.separating import Contest, Question
from minimax_cal.planning.visibility import THICK, Room, Sight, normals_of
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.status import Status

TRACKER_DISTANCE = 3.0  # where the tracker stands unless told: so far off, or the arm's reach [m]
MAX_COMPUTED_NOISE = 1e-7  # noise below which data were computed, not measured [m]


@dataclass(frozen=True, eq=False)
class Ground:
    """What a plan starts from.  measured: poses at hand, none or one set."""

    cell: Cell
    measured: tuple[Measurements, ...]
    instrument: Instrument
    notices: tuple[str, ...]


def ground_of(
    robot: Robot,
    fit: Result,
    data: Measurements | str | Path,
    options: PlanOptions,
) -> Ground:
    """Cell, poses at hand and noise.  Raises CalibrationError."""
    notices: list[str] = []
    own: tuple[Measurements, ...] = ()
    cells: list[Cell] = []
    if fit:
        known = open_result(fit)
        cells = [known.cell] if known.placed else []
        own = (known.data,) if known.data.poses else ()
    if isinstance(data, Measurements):
        own = (data,)
    elif data:
        own = (read_measurements(data),)
    notices += [notice for one in own for notice in one.notices]
    if cells and cells[0].robot.joints != robot.joints:
        raise OptionError(
            f"the fit's robot has {cells[0].robot.joints} joints, but {robot.name} has "
            f"{robot.joints}"
        )
    if cells:
        check_same(robot, cells[0].robot)
    if own and not cells:
        first = calibrate(robot, own[0], "sum", holdout=0.0)
        if first.status is Status.FAILED:
            raise DataError(f"{own[0].source}: {first.notices[-1]}")
        cells = [first.cell]
        notices.append(
            "the existing poses were calibrated first, geometry alone; give fit= for another model"
        )
    if cells:
        if len(options.tracker) or len(options.spots):
            raise OptionError(
                "the fit tells where tracker and targets are: leave tracker= and spots= out"
            )
        own = tuple(check_joints(robot, one) for one in own)
        for one in own:
            if data:
                check_arm(cells[0].robot, one)
            strange = [name for name in one.target_names if name not in cells[0].target_names]
            if strange:
                raise OptionError(f"{one.source}: target {strange[0]} is not one of the fit's")
        if not own:
            notices.append("the fit tells no poses: none count as measured; give data=")
        noise, text = shown_noise(cells[0], own, options)
        return Ground(cells[0], own, noise, (*notices, text))
    cell, text = assumed(robot, options)
    notices += [text] if text else []
    noise, text = shown_noise(cell, (), options)
    return Ground(cell, (), noise, (*notices, text))


def check_same(robot: Robot, calibrated: Robot) -> None:
    """Raise OptionError where a fit is of another arm than the one to plan for.

    Zeros of the joints may be anywhere: a calibration may have set them.
    """
    change = links_of(calibrated.mdh - robot.mdh)
    change[zero_positions(robot.prismatic)] = 0.0
    if named := wild(Names.of(robot, ()), change, robot.reach()):
        raise OptionError(
            f"the fit is of {calibrated.name}, which is not {robot.name} ({named}); name the robot "
            "of the fit, or give another fit"
        )


def assumed(robot: Robot, options: PlanOptions) -> tuple[Cell, str]:
    """A nominal robot before a tracker, and a notice where nobody said where that is."""
    spots = np.array(options.spots, dtype=float).reshape(-1, 3)
    spots = spots if len(spots) else ring(options.targets)
    names = tuple(f"smr{i + 1}" for i in range(len(spots)))
    cell = Cell(robot, np.eye(4), names, spots)
    if len(options.tracker):
        return cell_ahead(cell, np.array(options.tracker, dtype=float)), ""
    away = max(TRACKER_DISTANCE, robot.reach())
    place = front(cell, away)
    where = ", ".join(f"{1e3 * value:.0f}" for value in place)
    text = f"the tracker is taken to stand at {where} mm in base axes; say where with tracker="
    return cell_ahead(cell, place), text


def shown_noise(
    cell: Cell, measured: Sequence[Measurements], options: PlanOptions
) -> tuple[Instrument, str]:
    """The noise to plan with, and where it is from."""
    given = {name: getattr(options, name) for name in ("noise", "per_metre", "jitter")}
    told = {name: float(value) for name, value in given.items() if value is not None}
    base, source = Instrument(), ", assumed"
    if measured and not told:
        noise = noise_of(cell, measured[0])
        if np.sqrt(noise.variance) > MAX_COMPUTED_NOISE:
            source = (
                ", estimated from the existing poses, with the model errors in them; give noise= "
                "and jitter= where you know them"
            )
            base = Instrument(float(np.sqrt(noise.variance)), 0.0, noise.jitter)
    out = replace(base, **told)
    text = (
        f"noise of a coordinate {1e6 * out.noise:.3g} um + {1e6 * out.per_metre:.3g} um/m, jitter "
        f"of a joint {1e6 * out.jitter:.3g} urad{', as given' if told else source}"
    )
    return out, text


def noise_of(cell: Cell, data: Measurements) -> Noise:
    """Noise of instrument and joints in the errors of a cell."""
    chosen = [cell.target_names.index(name) for name in data.target_names]
    state = State(
        cell.robot.mdh, cell.base[:3, :3], cell.base[:3, 3], cell.target_positions[chosen]
    )
    data = cell.placed(data)
    model = model_of(cell.robot, data)
    scene = scene_of(cell.robot, data, model, state)
    rows = linearised(model, state, scene.jacobian)
    terms = cell.effects.terms
    fields = fields_of(terms, scene) if terms else np.zeros((0, *scene.points.shape))
    return restricted(rows, rows.of(fields))


def surroundings(
    cell: Cell, options: PlanOptions, measured: Sequence[Measurements] = ()
) -> tuple[Room, Sight, tuple[str, ...]]:
    """Where the arm may go and what the instrument sees.  measured: poses at hand."""
    robot = cell.robot
    lower, upper, notices = limits_of(robot, options.joints, measured)
    radius = THICK * robot.reach() if options.body is None else options.body
    room = Room(
        robot, cell.target_positions, normals_of(cell.target_positions, options.normals), lower,
        upper, radius, floor=options.floor, whole=options.whole,
    )  # fmt: skip
    if len(options.volume):
        low, high = np.array(options.volume, dtype=float)
        room = replace(room, low=low, high=high)
    place = -cell.base[:3, 3] @ cell.base[:3, :3]
    sight = Sight(place, robot.up, options.acceptance, *options.reach, *options.elevation)
    return room, sight, notices


# ---- the task ------------------------------------------------------------------------------------


WORK = 1000  # poses of the workspace at which positions are predicted

CRITERIA: Mapping[str, Callable[[Prospect, Array], Criterion]] = {
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
    ahead: Prospect
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
