"""What judges a model: runs that no fit saw, their torques, and the drives that move it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from minimax_cal.dynamics.drives import command_of
from minimax_cal.dynamics.given import MotionKnown
from minimax_cal.dynamics.logs.table import NOTHING, Run
from minimax_cal.dynamics.rows import (
    EDGE_S,
    Arm,
    Logs,
    Scene,
    at_times,
    named_runs,
    prepare,
    rms_by_joint,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.simulators.chain import Chain, fill_history
from minimax_cal.simulators.drive import check_stable
from minimax_cal.simulators.motion.numbers import Numbers, Opened
from minimax_cal.simulators.result import COMMANDS, MotionRung

# ---- a simulated arm along a log -----------------------------------------------------------------


Pull = Callable[[Array, Array, Array], Array]  # torque of joint values, and how far they are off
BANDWIDTH = 2.0 * np.pi * 5.0  # of drives that hold an arm to a log, where none are given [1/s]


@dataclass(frozen=True, eq=False)
class Gains:
    """Of proportional and derivative drives: (n,) stiffness [N m/rad] and damper [N m s/rad]."""

    stiffness: Array
    damper: Array

    def __call__(self, q: Array, off: Array, slow: Array) -> Array:
        """(n,) torque where joints and their speeds are off by so much."""
        return np.asarray(self.stiffness * off + self.damper * slow)


def inverse_torque(chain: Chain, logs: Logs) -> Array:
    """(M, n) torque that a model takes for the motion of logs, as its drives feel it [N m]."""
    mj, model, data, at, dofs = chain.fresh()
    out = np.empty(logs.motion.q.shape)
    floating = ~model.jnt_actgravcomp[list(chain.joints)].astype(bool)
    motion = logs.motion
    for k in range(len(out)):
        data.qpos[at], data.qvel[dofs], data.qacc[dofs] = motion.q[k], motion.qd[k], motion.qdd[k]
        mj.mj_inverse(model, data)
        out[k] = data.qfrc_inverse[dofs] + floating * data.qfrc_gravcomp[dofs]
    return out


def follow_commands(chain: Chain, run: Run, commands: Array, source: str) -> Array:
    """(m, n) joint values where a model's own position servos bring an arm.

    commands: (m, n) at the times of the run [rad, m].  Raises RobotError for an unstable model.
    """
    servos = chain.servos
    speeds = chain.find_feed_forward()

    def drive(data: Any, now: int) -> None:
        data.ctrl[servos] = path[now]
        data.ctrl[list(speeds)] = rates[now, list(speeds.values())]
        if not now:  # delayed and filtered commands begin as if they had been there all the time
            fill_history(chain.model, data)
            states = chain.model.actuator_actadr[servos]
            data.act[states[states >= 0]] = path[0][states >= 0]

    path = at_times(steps_of(run.time, chain), run.time, commands)
    rates = np.gradient(path, chain.step, axis=0)
    return stepped(chain, run, drive, source)


def follow_torques(
    chain: Chain, run: Run, path: tuple[Array, Array, Array], pull: Pull, source: str
) -> Array:
    """(m, n) joint values under torques, and drives that hold an arm to joint values and speeds.

    path: these values and speeds and torques at the steps of the model, (steps, n) each
    [rad, rad/s, N m].  The model's own actuators are off, and it has all its weight.
    """
    at, dofs, model = chain.places, chain.dofs, chain.model
    q, qd, torque = path

    def drive(data: Any, now: int) -> None:
        off, slow = q[now] - data.qpos[at], qd[now] - data.qvel[dofs]
        data.qfrc_applied[dofs] = torque[now] + pull(data.qpos[at], off, slow)

    fields = ("actuator_gainprm", "actuator_biasprm", "body_gravcomp")
    kept = {name: getattr(model, name).copy() for name in fields}
    try:
        for name in fields:
            getattr(model, name)[:] = 0.0
        return stepped(chain, run, drive, source)
    finally:
        for name in fields:
            getattr(model, name)[:] = kept[name]


def by_inertia(chain: Chain) -> Pull:
    """Drives whose gains follow the inertia of an arm: critically damped."""
    mj, model, data, at, dofs = chain.fresh()
    wanted, torque = np.zeros(model.nv), np.zeros(model.nv)

    def pull(q: Array, off: Array, slow: Array) -> Array:
        data.qpos[at] = q
        mj.mj_fwdPosition(model, data)
        wanted[dofs] = BANDWIDTH**2 * off + 2.0 * BANDWIDTH * slow
        mj.mj_mulM(model, data, torque, wanted)
        return torque[dofs]

    return pull


def steps_of(time: Array, chain: Chain) -> Array:
    """Times of a model's steps along a log [s]."""
    step = chain.step
    return np.asarray(time[0] + step * np.arange(int((time[-1] - time[0]) / step) + 1))


def stepped(chain: Chain, run: Run, drive: Callable[[Any, int], None], source: str) -> Array:
    """(m, n) joint values at the times of a run.  drive: sets what acts at a step."""
    mj, model, data, at, dofs = chain.fresh()
    start = scipy.interpolate.CubicSpline(run.time, run.q)
    data.qpos[at], data.qvel[dofs] = start(run.time[0]), start(run.time[0], 1)
    time = steps_of(run.time, chain)
    out = np.empty((len(time), run.joints))
    for now in range(len(time)):
        out[now] = data.qpos[at]
        drive(data, now)
        mj.mj_step(model, data)
    check_stable(mj, data, source)
    return at_times(run.time, time, out)


# ---- the judge -----------------------------------------------------------------------------------


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
    drives: in words, empty where nothing is driven.  hold: given gains, or
    those of usual drives.
    """

    arm: Arm
    inertia: Array
    learning: Logs
    learning_runs: tuple[Run, ...]
    held: Logs
    runs: tuple[Run, ...]
    source: str
    drives: str = ""
    hold: Pull | None = None

    @staticmethod
    def of(opened: Opened, runs: Sequence[Run], known: MotionKnown, *, fast: bool = False) -> Judge:
        """Of logs of the arm of a model.  fast: whether fast runs judge.

        Raises CalibrationError.
        """
        if fast:  # by the RMS speed of the joints, hinges and slides alike
            runs = sorted(runs, key=lambda run: float(
                np.sqrt((np.gradient(run.q, run.time, axis=0) ** 2).mean())))  # fmt: skip
        robot = opened.chain.robot_under_gravity()
        gains = known.torque_gains(robot, runs)
        learning, held = divided(known.loaded(runs), known.holdout, known.holdout_run)
        logs = prepare([*learning, *held])
        arm = Arm.of(robot, gains, known.ratios(robot), known.load, logs)
        return Judge(arm, opened.chain.find_largest_inertias(), prepare(learning), tuple(learning),
                     prepare(held), tuple(held), opened.given.source)  # fmt: skip

    def driving(self, opened: Opened, gains: Pair | None) -> Judge:
        """With drives: the model's own where commands were logged, or the given gains.

        Else measured torques, with usual gains for what these leave.  Raises OptionError.
        """
        chain = opened.chain
        commanded = all(run.command is not None for run in (*self.runs, *self.learning_runs))
        own = bool((chain.servos >= 0).all())
        hold: Pull = by_inertia(chain)
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
        return replace(self, arm=replace(self.arm, robot=opened.chain.robot_under_gravity()))

    def read(self, numbers: Numbers | None) -> tuple[Array, float]:
        """(n,) torque of the log per torque of the joint, and by how much it is late [s]."""
        if numbers is None:
            return np.ones(len(self.inertia)), 0.0
        return numbers.gain, numbers.late

    def off(self, chain: Chain, logs: Logs, numbers: Numbers | None) -> Array:
        """(R, n) torque that a model gets wrong along some logs [unit of the log]."""
        gain, late = self.read(numbers)
        seen = logs.earlier(late) if late else logs
        said = inverse_torque(chain, logs) * gain / self.arm.gain
        known = self.known if logs is self.held else Scene.of(self.arm, logs).known_torque
        return seen.y - logs.filtered(said + known)

    def torque(self, chain: Chain, numbers: Numbers | None = None) -> Missed:
        """What a model gets wrong on the runs that judge."""
        off = self.off(chain, self.held, numbers)
        return Missed(rms_by_joint(off), rms_by_joint(off, self.held.moving))

    @cached_property
    def known(self) -> Array:
        """(M, n) torque of a known payload on the runs that judge [unit of the log]."""
        return Scene.of(self.arm, self.held).known_torque

    def tracking(self, chain: Chain, numbers: Numbers | None = None) -> Array:
        """(n,) RMS joint error under the drives over the runs that judge [rad, m].

        Without the ends of each run.
        """
        squares = []
        for number, run in enumerate(self.runs):
            inside = (run.time > run.time[0] + EDGE_S) & (run.time < run.time[-1] - EDGE_S)
            off = (self.follow(chain, run, number, numbers) - run.q)[inside]
            squares.append(np.square(np.sqrt((off**2).mean(axis=0))))
        weights = [run.duration for run in self.runs]
        return np.asarray(np.sqrt(np.average(squares, axis=0, weights=weights)))

    def follow(self, chain: Chain, run: Run, number: int, numbers: Numbers | None) -> Array:
        """(m, n) where the drives bring the arm along a run that judges."""
        assert self.hold is not None
        if self.drives == OWN_SERVOS:
            return follow_commands(chain, run, command_of(run), self.source)
        steps = steps_of(run.time, chain)
        if self.drives == GIVEN_GAINS:
            wanted = at_times(steps, run.time, command_of(run))
            path = wanted, 0.0 * wanted, 0.0 * wanted
        else:
            # The drives make up for what the model gets wrong: where it is right, the arm follows
            # the log by the measured torques alone, less those of a known payload.
            gain, late = self.read(numbers)
            rows, time = self.held.spans[number], run.time - run.time[0]
            carried = at_times(time, self.held.since[rows], self.known[rows])
            torque = at_times(time + late, time, run.torque - carried) * self.arm.gain / gain
            spline = scipy.interpolate.CubicSpline(run.time, run.q)
            path = spline(steps), spline(steps, 1), at_times(steps, run.time, torque)
        return follow_torques(chain, run, path, self.hold, self.source)

    def rung(self, name: str, chain: Chain, numbers: Numbers | None = None,
             missed: Missed | None = None) -> MotionRung:  # fmt: skip
        """How far a model misses.  missed: where it is known already."""
        if self.held.unit == NOTHING:
            return MotionRung(name, (), (), (), tuple((1e3 * self.tracking(chain)).tolist()))
        off = self.torque(chain, numbers) if missed is None else missed
        where = self.tracking(chain, numbers) if self.drives else np.zeros(0)
        sizes = (off.whole * self.arm.gain, off.whole, off.moving, 1e3 * where)
        return MotionRung(name, *(tuple(size.tolist()) for size in sizes))


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
        parts = {run.name: run.at(early), f"{run.name} (its end)": run.at(~early)}
        start, end = (replace(part, name=name, time=part.time - part.time[0])
                      for name, part in parts.items())  # fmt: skip
        return [start], [end]
    if not wanted:
        count = min(len(runs) - 1, max(1, round(share * len(runs))))
        wanted = tuple(run.name for run in runs[-count:])
    return [r for r in runs if r.name not in wanted], [r for r in runs if r.name in wanted]
