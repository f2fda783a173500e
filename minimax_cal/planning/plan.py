"""Plan a measurement: which poses tell most, in which order, and how accurate they will make it."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from minimax_cal.fitting.opened import Result
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.options import takes
from minimax_cal.ground.stages import Progress, silent
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.planning.candidates import Poses, candidates, near, rarest
from minimax_cal.planning.designs.criteria import Criterion, inverse
from minimax_cal.planning.designs.exchange import Menu, exchange, highest, polar
from minimax_cal.planning.designs.search import ROUGH, Found, best_design, first_design, worth
from minimax_cal.planning.options import PlanOptions, check_options, settings_of
from minimax_cal.planning.outlook import grown, indices, remarks, separated
from minimax_cal.planning.result import POWER, Plan, Travel
from minimax_cal.planning.route import shortest, travel, visits
from minimax_cal.planning.task import Task, ground_of, surroundings, task_of
from minimax_cal.planning.visibility import Room, Sight
from minimax_cal.robots.robot import Robot, load_robot

STEPS = (0.2, 0.1, 0.05, 0.02)  # around the best so far, as a share of the joints' ranges
AROUND, KEPT = 2400, 400  # poses tried around all of them, and those kept, each time


@takes(options=PlanOptions)
def plan(
    robot: Robot | str | Path,
    poses: int,
    *,
    fit: Result | None = None,
    data: Measurements | str | Path | None = None,
    options: PlanOptions,
    progress: Progress = silent,
) -> Plan:
    """Which poses of a robot to measure next, in which order, and how accurate they will make it.

    Parameters
    ----------
    robot
        Loaded, or a name or path.
    poses
        How many.
    fit
        A calibration whose robot, base, targets and poses are the start.
    data
        Poses measured already; without a fit they are calibrated first.
    options
        See `PlanOptions`.
    progress
        Called with a word on each stage.

    Returns
    -------
    Plan
        The poses in order, and the accuracy they promise.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.plan("irb2600", 40, tracker=(3.0, 0.0, 0.5)).headline())
    """
    began = time.perf_counter()
    robot = load_robot(robot)
    check_options(options, poses, robot)
    progress("start")
    ground = ground_of(robot, "" if fit is None else fit, "" if data is None else data, options)
    room, sight, said = surroundings(ground.cell, options, ground.measured)
    progress("candidate poses")
    found = enough(room, sight, options, poses)
    task = task_of(robot, ground, room, sight, found, options)
    found, first = refined(task, found, poses, progress)
    aim = task.aim(found)
    best = best_design(*aim, first, progress)
    progress("comparison")
    notices = (*task.ground.notices, *said, *remarks(task, found))
    return assembled(task, found, aim, best, notices, began)


def enough(room: Room, sight: Sight, options: PlanOptions, poses: int) -> Poses:
    """Candidates for so many poses.  Raises OptionError where there are fewer."""
    found = candidates(room, sight, options.candidates, options.seed)
    if found.count < poses:
        raise OptionError(
            f"only {found.count} of {found.tested} poses can be taken and seen, but {poses} are "
            f"asked for; {rarest(found.rejected)}"
        )
    return found


def refined(task: Task, found: Poses, poses: int, progress: Progress) -> tuple[Poses, Array]:
    """More candidates around those that tell most, and a first choice.

    Where poses that can be seen are rare, the best of a sequence lie inside of what is allowed;
    better ones lie at its edge.
    """
    progress("first poses")
    menu, criterion = task.aim(found)
    chosen = first_design(menu, criterion, poses, task.options.seed)
    rng = np.random.default_rng(task.options.seed)
    for step in STEPS:
        progress(f"poses within {100.0 * step:g} % around them")
        each = -(-AROUND // poses)
        more, seen = near(task.room, task.sight, found.q[chosen], each, step, rng)
        menu, criterion = task.aim(found.join(more, seen))
        cov = inverse(menu.of(chosen))
        fresh = menu.scores(polar(cov, criterion.mix(cov)))[found.count :]
        kept = np.sort(highest(fresh, KEPT))
        old = found.count
        found = found.join(more[kept], seen[kept])
        menu = menu.take(np.concatenate([np.arange(old), old + kept]))
        among = np.union1d(np.arange(old, menu.count), chosen)
        chosen = exchange(menu, criterion, chosen, among, ROUGH).chosen
    return found, chosen


def assembled(
    task: Task,
    found: Poses,
    aim: tuple[Menu, Criterion],
    best: Found,
    notices: tuple[str, ...],
    began: float,
) -> Plan:
    """The plan, in a short order, compared with random poses.  began: by `time.perf_counter`."""
    cell, options = task.ground.cell, task.options
    robot, poses = cell.robot, len(best.design.chosen)
    menu = task.menu(found)
    chosen = ordered(best.design.chosen, found.q, robot)
    q, seen = found.q[chosen], found.seen[chosen]
    growth = grown(task, menu, aim, best, found.drawn)
    here = next(row for row in growth if row.poses == poses)
    stops = visits(
        q,
        robot.prismatic,
        task.room.lower,
        task.room.upper,
        options.revisit,
        aside=options.approach == "both",
    )
    separation = tuple(
        separated(one, contest, stops, seen[:, task.named(one)])
        for one, contest in zip(task.asked, task.contests(found), strict=True)
    )
    some = np.arange(found.drawn)
    equal = worth(aim[0].take(some), aim[1], poses, best.design.size, options.seed)

    return Plan(
        cell=cell,
        criterion=POWER if task.asked else options.criterion,
        q=q,
        seen=seen,
        expected=np.where(seen[..., None], cell.predict(q), np.nan),
        visits=stops,
        size=best.design.size,
        bound=best.bound,
        random=here.size[1],
        equal=equal,
        names=task.ahead.names,
        sigma=np.sqrt(np.diag(inverse(menu.of(chosen)))) / task.ahead.scale,
        indices=indices(task.ahead, found, chosen, options.seed),
        growth=growth,
        separation=separation,
        candidates=found,
        instrument=task.ground.instrument,
        place=task.sight.place,
        travel=Travel(*(travel(way, robot.prismatic) for way in (q, found.q[best.design.chosen]))),
        at_hand=sum(one.poses for one in task.ground.measured),
        settings=settings_of(options, poses),
        notices=notices,
        seconds=time.perf_counter() - began,
    )


def ordered(chosen: Array, q: Array, robot: Robot) -> Array:
    """The chosen poses in a short order, from joint values 0 or as near as the limits let them."""
    home = np.clip(np.zeros(robot.joints), robot.lower, robot.upper)
    return np.asarray(chosen[shortest(q[chosen], robot.prismatic, home)])
