"""What judges a model: runs that no fit saw, their torques, and the drives that move it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from minimax_cal.dynamics.diagnose import named_runs
from minimax_cal.dynamics.drives import command_of
from minimax_cal.dynamics.given import MotionKnown
from minimax_cal.dynamics.rows import Logs, prepare, rms_by_joint
from minimax_cal.dynamics.run import NOTHING, Run
from minimax_cal.dynamics.scene import Arm, Scene
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.simulators.chain import Chain
from minimax_cal.simulators.given import largest_inertia
from minimax_cal.simulators.motion.driven import (
    Gains,
    follow_commands,
    follow_gains,
    follow_torques,
    inverse_torque,
    tracking,
)
from minimax_cal.simulators.motion.module import installed
from minimax_cal.simulators.motion.numbers import Numbers
from minimax_cal.simulators.motion.opened import Opened, in_its_gravity
from minimax_cal.simulators.motion.result import COMMANDS, MotionRung

Pair = tuple[Sequence[float], Sequence[float]]  # stiffness and damper
LEAST_HELD = 4.0  # of a single run: length of the end that is held out [s]
OWN_SERVOS = f"its position servos and {COMMANDS}"
GIVEN_GAINS = f"the given gains and {COMMANDS}"
TORQUES = "the measured torques and drives that hold it to the log"


@dataclass(frozen=True, eq=False)
class Missed:
    """(n,) RMS torque that a model gets wrong: of all rows, and of those that move [as logged]."""

    whole: Array
    moving: Array


@dataclass(frozen=True, eq=False)
class Judge:
    """Runs to learn from and runs that judge, and how the arm is driven along these.

    arm: of the model as it is read, with gains and speeds.  inertia: (n,) largest about each joint
    of the model as given [kg m^2].  learning, held: on the even grid.  runs: that judge, as logged.
    drives: in words, empty where nothing is driven.  hold: given gains, or the
    model whose inertia those of usual drives follow.
    """

    arm: Arm
    inertia: Array
    learning: Logs
    learning_runs: tuple[Run, ...]
    held: Logs
    runs: tuple[Run, ...]
    source: str
    drives: str = ""
    hold: Gains | Chain | None = None

    @staticmethod
    def of(opened: Opened, runs: Sequence[Run], known: MotionKnown, *, fast: bool = False) -> Judge:
        """Of logs of the arm of a model.  fast: whether fast runs judge.

        Raises CalibrationError.
        """
        if fast:
            runs = sorted(runs, key=lambda run: float(speed_of(run)))
        robot = in_its_gravity(opened.chain)
        gains = known.torque_gains(robot, runs)
        learning, held = divided(known.loaded(runs), known.holdout, known.holdout_run)
        logs = prepare([*learning, *held])
        arm = Arm.of(robot, gains, known.ratios(robot), known.load, logs)
        return Judge(arm, largest_inertia(opened.chain), prepare(learning), tuple(learning),
                     prepare(held), tuple(held), opened.given.source)  # fmt: skip

    def driving(self, opened: Opened, gains: Pair | None) -> Judge:
        """With drives: the model's own where commands were logged, or the given gains.

        Else measured torques, with usual gains for what these leave.  Raises OptionError.
        """
        chain = opened.chain
        commanded = all(run.command is not None for run in (*self.runs, *self.learning_runs))
        own = all(chain.servo(joint) >= 0 for joint in chain.joints)
        hold: Gains | Chain = chain
        if gains is not None:
            try:
                hold = Gains(*(np.broadcast_to(np.array(one, dtype=float), len(self.inertia))
                               for one in gains))  # fmt: skip
            except ValueError as error:
                raise OptionError(f"gains: give one pair, or {len(self.inertia)}") from error
        served = OWN_SERVOS if own and gains is None else GIVEN_GAINS if gains else TORQUES
        return replace(self, drives=served if commanded else TORQUES, hold=hold)

    @property
    def commanded(self) -> bool:
        """Whether logged commands drive the arm."""
        return self.drives in (OWN_SERVOS, GIVEN_GAINS)

    def of_model(self, opened: Opened) -> Judge:
        """The same runs and drives, for another model of the arm."""
        return replace(self, arm=replace(self.arm, robot=in_its_gravity(opened.chain)))

    def off(self, chain: Chain, logs: Logs, numbers: Numbers | None) -> Array:
        """(R, n) torque that a model gets wrong along some logs [unit of the log]."""
        gain = np.ones(len(self.inertia)) if numbers is None else numbers.gain
        late = 0.0 if numbers is None else numbers.late
        seen = logs.earlier(late) if late else logs
        said = inverse_torque(chain, logs) * gain / self.arm.gain
        known = self.known if logs is self.held else Scene.of(self.arm, logs).known_torque
        return np.asarray(seen.y - logs.filtered(said + known))

    def torque(self, chain: Chain, numbers: Numbers | None = None) -> Missed:
        """What a model gets wrong on the runs that judge."""
        off = self.off(chain, self.held, numbers)
        return Missed(rms_by_joint(off), rms_by_joint(off, self.held.moving))

    @cached_property
    def known(self) -> Array:
        """(M, n) torque of a known payload on the runs that judge [unit of the log]."""
        return Scene.of(self.arm, self.held).known_torque

    def tracking(self, chain: Chain, numbers: Numbers | None = None) -> Array:
        """(n,) RMS joint error under the drives over the runs that judge [rad, m]."""
        squares, weight = np.zeros(len(self.inertia)), 0.0
        for number, run in enumerate(self.runs):
            q = self.follow(chain, run, number, numbers)
            squares += tracking(q, run) ** 2 * run.duration
            weight += run.duration
        return np.asarray(np.sqrt(squares / weight))

    def follow(self, chain: Chain, run: Run, number: int, numbers: Numbers | None) -> Array:
        """(m, n) where the drives bring the arm along a run that judges."""
        assert self.hold is not None
        if self.drives == OWN_SERVOS:
            return follow_commands(chain, run, command_of(run), self.source)
        if self.drives == GIVEN_GAINS and isinstance(self.hold, Gains):
            return follow_gains(chain, run, command_of(run), self.hold, self.source)
        gain = np.ones(len(self.inertia)) if numbers is None else numbers.gain
        late = 0.0 if numbers is None else numbers.late
        rows = slice(self.held.start[number], self.held.start[number + 1])
        known, grid = self.known[rows], self.held.since[rows]
        time = run.time - run.time[0]
        carried = np.stack([np.interp(time, grid, column) for column in known.T], axis=1)
        early = [np.interp(time + late, time, column) for column in (run.torque - carried).T]
        torque = np.stack(early, axis=1) * self.arm.gain / gain
        return follow_torques(chain, run, torque, self.hold, self.source)

    def rung(self, name: str, chain: Chain, numbers: Numbers | None = None, module: str = "",
             missed: Missed | None = None) -> MotionRung:  # fmt: skip
        """How far a model misses.  missed: where it is known already."""
        if self.held.unit == NOTHING:
            return MotionRung(name, (), (), (), tuple((1e3 * self.tracking(chain)).tolist()))
        with installed(module, chain):
            off = self.torque(chain, numbers) if missed is None else missed
            where = self.tracking(chain, numbers) if self.drives else np.zeros(0)
        sizes = (off.whole * self.arm.gain, off.whole, off.moving, 1e3 * where)
        return MotionRung(name, *(tuple(size.tolist()) for size in sizes))


def speed_of(run: Run) -> float:
    """RMS speed of the joints, hinges and slides alike [rad/s, m/s]."""
    return float(np.sqrt((np.gradient(run.q, run.time, axis=0) ** 2).mean()))


def divided(
    runs: Sequence[Run], share: float, named: str | Sequence[str] | None
) -> tuple[list[Run], list[Run]]:
    """Runs to learn from, and runs that judge: those named, the last ones, or the end of the only.

    Raises OptionError.
    """
    if not 0.0 < share < 1.0:
        raise OptionError(f"holdout={share:g} must lie between 0 and 1")
    wanted = named_runs(prepare(runs), named)
    if not wanted and len(runs) == 1:
        run = runs[0]
        cut = run.time[-1] - max(share * run.duration, LEAST_HELD)
        if cut - run.time[0] < LEAST_HELD:
            raise OptionError(
                f"{run.source}: {run.duration:.1f} s are too short to learn and to judge; log more"
            )
        early = run.time < cut
        return [part_of(run, early, "")], [part_of(run, ~early, " (its end)")]
    if not wanted:
        count = min(len(runs) - 1, max(1, round(share * len(runs))))
        wanted = tuple(run.name for run in runs[-count:])
    return [r for r in runs if r.name not in wanted], [r for r in runs if r.name in wanted]


def part_of(run: Run, rows: Array, words: str) -> Run:
    """Some rows of a run.  rows: (m,) mask."""
    part = run.at(rows)
    return replace(part, name=run.name + words, time=part.time - part.time[0])
