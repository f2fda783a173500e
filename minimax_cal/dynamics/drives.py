"""What position drives do with their commands: gains, delay and limits, from logs of both.

    torque = kp (c(t - d) - q) - kv (qd - s c'(t - d)) + what carries gravity

of a command c, linear in kp, kv and kv s for every delay d.  Rows where a limit acts say nothing of
gains.  Rows err together over a stretch of BLOCK_S: each is left out in turn [jackknife].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
import scipy

from minimax_cal.dynamics.logs.table import NOTHING, Run, rows_of
from minimax_cal.dynamics.regressor import Motion
from minimax_cal.dynamics.rows import (
    SLOWEST,
    UNFITTED_S,
    Arm,
    Logs,
    prepare,
    sense_of,
    standard_errors,
)
from minimax_cal.ground.arrays import Array

LATEST, LOOK = 0.1, 0.004  # the latest command that is looked for, and how closely [s]
BLOCK_S = 1.0  # rows that err together
IN_A_RUN = 10**6  # stretches, by which they are numbered
LIMIT = 0.9  # of the largest torque and speed: rows beyond may be at a limit
BEYOND, CLEAR = 1.05, 0.95  # of a limit: where it acts for sure, and where it does not
LEAST_ROWS, LEAST_BLOCKS = 10, 3  # of a log, at a limit; and stretches of time
STANDS = 3.5  # standard deviations by which a number is another
PREDICTS = 2.5  # the same, by which stretches of a run left out are predicted better
STEPS, CLOSE_S = 20, 1e-9  # of a fit, and the step that ends it [s]
AHEAD, INERTIA, FRICTION = "ahead", "inertia", "friction"  # what is fitted beside if it is there
KINDS = ("servo_gain", "command_delay", "torque_limit", "speed_limit")
GAINS, DELAY, TORQUE_LIMIT, SPEED_LIMIT = KINDS
FIELDS = {  # of a drive, that belong to an effect, and their units
    GAINS: {"stiffness": "N m/rad", "damper": "N m s/rad", "ahead": "1"},
    DELAY: {"delay": "s"},
    TORQUE_LIMIT: {"torque": "N m"},
    SPEED_LIMIT: {"speed": "rad/s"},
}
NO_LIMIT = (math.inf, 0.0)
Body = Callable[[Motion], Array]  # torque (m, n) that masses take for a motion [N m]
FITTED = ("stiffness", "damper", "ahead", "delay")


@dataclass(frozen=True)
class Drive:
    """A joint's.  stiffness: kp [N m/rad].  damper: kv [N m s/rad].  ahead: share s of kv that the
    commanded speed has.  delay: d [s].  torque, speed: limits [N m, rad/s], infinite for none.
    """

    stiffness: float
    damper: float
    ahead: float = 0.0
    delay: float = 0.0
    torque: float = math.inf
    speed: float = math.inf

    def taking(self, other: Drive, kind: str) -> Drive:
        """With the numbers of an effect that another has."""
        return replace(self, **{name: getattr(other, name) for name in FIELDS[kind]})


@dataclass(frozen=True, eq=False)
class DriveFit:
    """What logs say of a joint's drive.

    change: (G, 4 + k) by which each stretch (G,), left out, changes FITTED, and what was fitted
    beside these.  beside: that, by name.  limits: standard deviations of torque and speed.
    """

    drive: Drive
    change: Array
    stretch: Array
    beside: dict[str, float]
    limits: tuple[float, float] = (0.0, 0.0)

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviations by name."""
        own = np.sqrt(np.diag(covariance_of(self.change)))[: len(FITTED)].tolist()
        return dict(zip((*FITTED, "torque", "speed"), (*own, *self.limits), strict=True))

    @property
    def apart(self) -> dict[str, float]:
        """What was fitted beside that is no number of the drive."""
        return {name: value for name, value in self.beside.items() if name != AHEAD}

    def rest(self, rows: Rows) -> Array:
        """(R,) torque of some rows that it does not explain."""
        return rows.rest(self.drive, self.apart)


def stretch_of(run: Array | int, since: Array) -> Array:
    """(R,) numbers of the stretches of rows: of which run, and when in it [s]."""
    return run * IN_A_RUN + (since / BLOCK_S).astype(int)


def command_of(run: Run) -> Array:
    """(m, n) commands of a run that has some."""
    return cast(Array, run.command)


@dataclass(frozen=True, eq=False)
class Followed:
    """Runs with their commands, and what arms of a model weigh along them, all in N m.

    logs: of the runs; the rows that are used are those clear of gaps.  told: of the commands in the
    place of torques.  carried: (M, n) torque that the drives add against gravity.  sense: (M, n) of
    the speed.  gain: (n,) torque per unit of the log.
    """

    runs: tuple[Run, ...]
    logs: Logs
    told: Logs
    carried: Array
    sense: Array
    gain: Array

    @property
    def measured(self) -> bool:
        """Whether torques were; else they are those of the model's masses."""
        return self.logs.unit != NOTHING

    @property
    def beside(self) -> tuple[str, ...]:
        """What is fitted in any case: speeds that were not logged may be those of another time.

        Without torques rotors and friction stand between the drive and the masses of the model.
        """
        if not self.measured:
            return INERTIA, FRICTION
        return () if all(run.qd is not None for run in self.runs) else (INERTIA,)

    @cached_property
    def slides(self) -> Array:
        """(M, n) True where friction is that of a joint that slides."""
        return self.logs.away(UNFITTED_S)

    @staticmethod
    def of(runs: Sequence[Run], arm: Arm, body: Body) -> Followed:
        """Without gravity that drives carry.  body: torque of the masses of a motion."""
        logs = prepare(runs)
        if logs.unit == NOTHING:
            logs = replace(logs, torque=body(logs.motion))
        told = prepare([replace(run, torque=command_of(run)) for run in runs])
        sense = sense_of(logs.motion.qd, arm.soft)
        return Followed(tuple(runs), logs, told, 0.0 * sense, sense, arm.gain)

    def carrying(self, share: float, body: Body) -> Followed:
        """Where drives carry a share of gravity besides.  body: as `of`."""
        still = np.zeros((2, *self.logs.torque.shape))
        weight = body(Motion(self.logs.motion.q, *still)) if share else still[0]
        return replace(self, carried=share * weight)

    def joint(self, j: int) -> Rows:
        """The rows of a joint."""
        logs = self.logs
        used = ~logs.gap & (self.measured | self.slides[:, j])
        at = logs.picked[used[logs.picked]]
        run = logs.run_of(at)
        stretch = stretch_of(run, logs.since[at])
        curves = [scipy.interpolate.CubicSpline(logs.since[own], self.told.torque[own, j])
                  for own in logs.spans]  # fmt: skip
        torque = logs.torque[:, j] * self.gain[j] - self.carried[:, j]
        q, qd, qdd = (one[at, j] for one in (logs.motion.q, logs.motion.qd, logs.motion.qdd))
        return Rows(torque[at], q, qd, qdd, self.sense[at, j], logs.since[at], run, stretch,
                    tuple(curves))  # fmt: skip

    def clear(self, j: int, torque: float, speed: float) -> Rows:
        """The rows of a joint that no larger torque and speed is near."""
        rows, seen = self.joint(j), self.samples(j, Drive(0.0, 0.0))
        beyond = (np.abs(seen.torque) > torque) | (np.abs(seen.qd) > speed)
        is_clear = np.ones(len(rows.q), dtype=bool)
        for number in np.unique(rows.run):
            mine, here = rows.run == number, seen.run == number
            count = np.concatenate([[0], np.cumsum(beyond[here])])
            before, after = (count[np.searchsorted(seen.since[here], rows.since[mine] + side)]
                             for side in (-UNFITTED_S, UNFITTED_S))  # fmt: skip
            is_clear[mine] = before == after
        names = ("torque", "q", "qd", "qdd", "sense", "since", "run", "stretch")
        return replace(rows, **rows_of(rows, names, is_clear))

    def samples(self, j: int, drive: Drive) -> Samples:
        """Every row of the logs as logged, at a joint: torque, and what a drive would ask for."""
        out: list[Array] = []
        for number, (run, rows) in enumerate(zip(self.runs, self.logs.spans, strict=True)):
            time, grid = run.time - run.time[0], self.logs.since[rows]
            smooth = (self.logs.motion.qd, self.carried, self.logs.torque)
            qd, carried, torque = (np.interp(time, grid, one[rows, j]) for one in smooth)
            command = command_of(run)[:, j]
            late = np.interp(time - drive.delay, time, command)
            rate = np.interp(time - drive.delay, time, np.gradient(command, time))
            asked = drive.stiffness * (late - run.q[:, j])
            asked -= drive.damper * (qd - drive.ahead * rate)
            torque = run.torque[:, j] * self.gain[j] if self.measured else torque
            stretch = stretch_of(number, time)
            out.append(np.array([torque, asked + carried, qd, time, 0 * time + number, stretch]))
        return Samples(*np.concatenate(out, axis=1))


@dataclass(frozen=True, eq=False)
class Samples:
    """(m,) each of a joint: torque measured and asked for [N m], speed, time, run, stretch."""

    torque: Array
    asked: Array
    qd: Array
    since: Array
    run: Array
    stretch: Array

    @property
    def noise(self) -> float:
        """Standard deviation of torque that the drive does not explain, whatever the limits."""
        return 1.4826 * float(np.median(np.abs(self.torque - self.asked)))


@dataclass(frozen=True, eq=False)
class Rows:
    """(R,) each of a joint: torque less what carries gravity [N m], joint value, speed, its
    derivative and sense, time, run, and the stretch that errs together.  curves: of each run's
    command.
    """

    torque: Array
    q: Array
    qd: Array
    qdd: Array
    sense: Array
    since: Array
    run: Array
    stretch: Array
    curves: tuple[Any, ...]

    def command(self, late: float, order: int = 0) -> Array:
        """(R,) the command or its derivative, so late [s]."""
        out = np.empty(len(self.q))
        for number, curve in enumerate(self.curves):
            mine = self.run == number
            out[mine] = curve(self.since[mine] - late, order)
        return out

    def columns(self, late: float, given: Drive, beside: Sequence[str]) -> Array:
        """(R, 2 + k) torque per stiffness, per damper, and of what else is fitted."""
        rate = self.command(late, 1)
        speed = -self.qd if AHEAD in beside else given.ahead * rate - self.qd
        more = {AHEAD: rate, INERTIA: -self.qdd, FRICTION: -self.sense}
        return np.stack(
            [self.command(late) - self.q, speed, *(more[name] for name in beside)], axis=1
        )

    def rest(self, drive: Drive, beside: Mapping[str, float]) -> Array:
        """(R,) torque that a drive, and what was fitted beside it, do not explain."""
        value = [drive.stiffness, drive.damper, *beside.values()]
        return self.torque - self.columns(drive.delay, drive, list(beside)) @ value


def solve(rows: Rows, given: Drive, beside: Sequence[str]) -> DriveFit:
    """Gains and delay by least squares, with what is fitted beside them."""

    def linear(late: float) -> tuple[Array, Array, float]:
        matrix = rows.columns(late, given, beside)
        value = np.linalg.lstsq(matrix, rows.torque, rcond=None)[0]
        return matrix, value, float(((rows.torque - matrix @ value) ** 2).sum())

    late = min(np.arange(0.0, LATEST, LOOK), key=lambda one: linear(one)[2])
    ahead = 2 + list(beside).index(AHEAD) if AHEAD in beside else -1
    for _ in range(STEPS):
        matrix, value, _ = linear(late)
        speed = value[ahead] if ahead > 0 else value[1] * given.ahead
        by_time = -value[0] * rows.command(late, 1) - speed * rows.command(late, 2)
        whole = np.column_stack([matrix, by_time])
        rest = rows.torque - matrix @ value
        step = float(np.clip(np.linalg.lstsq(whole, rest, rcond=None)[0][-1], -LOOK, LOOK))
        late = float(np.clip(late + step, -LATEST, LATEST))
        if abs(step) < CLOSE_S:
            break
    change = left_out(whole, rest, rows.stretch)
    own = np.zeros((len(change), len(FITTED)))
    own[:, [0, 1, 3]] = change[:, [0, 1, -1]]
    share = given.ahead
    if ahead > 0:
        share = float(value[ahead] / value[1])
        own[:, 2] = (change[:, ahead] - share * change[:, 1]) / value[1]
    drive = replace(given, stiffness=float(value[0]), damper=float(value[1]), ahead=share,
                    delay=late)  # fmt: skip
    return DriveFit(drive, np.hstack([own, change[:, 2:-1]]), np.unique(rows.stretch),
                    dict(zip(beside, value[2:].tolist(), strict=True)))  # fmt: skip


def covariance_of(change: Array) -> Array:
    """(p, p) of numbers that change so (G, p) without each stretch [jackknife]."""
    return (len(change) - 1.0) / len(change) * change.T @ change


def left_out(matrix: Array, rest: Array, stretch: Array) -> Array:
    """(G, p) change of a solution without each stretch of rows, to first order.

    Wider by as much as Student's t is than the normal law, at 95 %, for as few stretches as tell of
    a number where rows err alike [Satterthwaite 1946].
    """
    scale = np.sqrt((matrix**2).sum(axis=0)) + 1e-300
    matrix = matrix / scale
    whole, out, tells = matrix.T @ matrix, [], []
    for one in np.unique(stretch):
        part = matrix[stretch == one]
        less = whole - part.T @ part
        told = np.linalg.lstsq(less, part.T, rcond=1e-12)[0]
        out.append(-told @ rest[stretch == one] / scale)
        tells.append((told**2).sum(axis=1))
    share = np.array(tells) / np.sum(tells, axis=0)
    few = np.clip(1.0 / (share**2).sum(axis=0), 2.0, None)
    wider = scipy.special.stdtrit(few, 0.975) / scipy.special.ndtri(0.975)
    return np.asarray(np.array(out) * wider)


def fit_drive(learnt: Followed, judged: Followed, j: int, given: Drive) -> DriveFit | None:
    """The drive of a joint by its logs; None where these hold too few rows clear of limits.

    judged: runs that are held out.  given: the drive of the model.
    """
    seen = learnt.samples(j, given)
    torque, speed = (LIMIT * float(np.abs(one).max()) for one in (seen.torque, seen.qd))
    rows = learnt.clear(j, torque, speed)
    for _ in range(2):  # clear of what may be a limit, then of what is one
        if len(np.unique(rows.stretch)) < 2 * LEAST_BLOCKS or np.abs(rows.qd).max() < SLOWEST:
            return None
        # No more beside the drive than is there for sure, and predicts rows held out.
        held = judged.clear(j, torque, speed)
        found = solve(rows, given, [AHEAD, INERTIA, FRICTION])
        for name in (FRICTION, INERTIA, AHEAD):
            if name in learnt.beside:
                continue
            at, off = 2, found.drive.ahead - given.ahead
            if name != AHEAD:
                at, off = len(FITTED) + list(found.beside).index(name), found.beside[name]
            sure = abs(off) > STANDS * float(np.sqrt(covariance_of(found.change)[at, at]))
            less = solve(rows, given, [one for one in found.beside if one != name])
            if not (sure and predicts(held, found.rest(held), less.rest(held))):
                found = less
        seen = learnt.samples(j, found.drive)
        torque, slack = torque_limit(seen) if learnt.measured else NO_LIMIT
        speed, off = speed_limit(seen, torque) if learnt.measured else NO_LIMIT
        rows = learnt.clear(j, CLEAR * torque, LIMIT * speed)
    fitted, sigma = found.drive, found.sigma
    if not (fitted.stiffness > STANDS * sigma["stiffness"]
            and fitted.damper > -STANDS * sigma["damper"]):  # fmt: skip
        return None
    limit = given.torque if not np.isfinite(torque) else torque
    if learnt.measured and np.quantile(np.abs(seen.torque), 0.999) > BEYOND * limit:
        limit = float(np.abs(seen.torque).max())
    drive = replace(fitted, damper=max(fitted.damper, 0.0), torque=float(limit),
                    speed=float(min(speed, given.speed)))  # fmt: skip
    return replace(found, drive=drive, limits=(slack, off))


def torque_limit(seen: Samples) -> tuple[float, float]:
    """A torque that is not exceeded where more is asked for, and its deviation [N m].

    Infinite where there is none.
    """
    size, noise = np.abs(seen.torque), seen.noise
    limit = float(np.quantile(size, 1.0 - LEAST_ROWS / len(size)))
    for _ in range(STEPS):
        at_limit = (np.abs(seen.asked) > BEYOND * limit + STANDS * noise) & (size > LIMIT * limit)
        at_limit &= seen.torque * seen.asked > 0.0
        if not stands(at_limit, seen.stretch):
            return NO_LIMIT
        before, limit = limit, float(np.median(size[at_limit]))
        if limit == before:
            break
    spread = float(np.std(size[at_limit])) + 1e-300
    if spread > (BEYOND - 1.0) * limit + STANDS * noise:
        return NO_LIMIT
    return limit, spread / math.sqrt(len(np.unique(seen.stretch[at_limit])))


def speed_limit(seen: Samples, torque: float) -> tuple[float, float]:
    """A speed near which torque falls below what the drive asks for, and its deviation."""
    asked = np.clip(seen.asked, -torque, torque)
    slack = STANDS * seen.noise + (BEYOND - 1.0) * float(np.abs(seen.torque).max())
    size = np.abs(seen.qd)
    at_limit = np.sign(seen.qd) * (asked - seen.torque) > slack
    at_limit &= size > LIMIT * size.max()
    if not stands(at_limit, seen.stretch):
        return NO_LIMIT
    count = len(np.unique(seen.stretch[at_limit]))
    return float(np.median(size[at_limit])), float(np.std(size[at_limit])) / math.sqrt(count)


def stands(rows: Array, stretch: Array) -> bool:
    """Whether rows are enough, in enough stretches of time, to be a limit."""
    return int(rows.sum()) >= LEAST_ROWS and len(np.unique(stretch[rows])) >= LEAST_BLOCKS


def predicts(rows: Rows | Samples, rest: Array, before: Array) -> bool:
    """Whether less is left of rows held out (R,), stretch by stretch, than before (R,)."""
    index = np.unique(rows.stretch, return_inverse=True)[1].reshape(-1)
    squares = (np.bincount(index, one**2) + 1e-300 for one in (before, rest))
    gain = np.subtract(*map(np.log, squares))
    return len(gain) >= LEAST_BLOCKS and standard_errors(gain) > PREDICTS


def is_another(kind: str, fit: DriveFit, given: Drive, held: Followed, j: int, late: float) -> bool:
    """Whether an effect of a drive is surely not the model's, and shows in runs held out.

    late: shortest delay [s].
    """
    drive, sigma = fit.drive, fit.sigma
    off = {name: abs(getattr(drive, name) - getattr(given, name)) for name in FIELDS[kind]
           if getattr(drive, name) != getattr(given, name)}  # fmt: skip
    if not any(size > STANDS * sigma[name] for name, size in off.items()):
        return False
    seen = held.samples(j, drive)
    if kind == SPEED_LIMIT:
        return bool(np.isfinite(speed_limit(seen, drive.torque)[0]))
    if kind == TORQUE_LIMIT:
        ends = (seen.torque - np.clip(seen.asked, -d.torque, d.torque) for d in (drive, given))
        return predicts(seen, *ends)
    if kind == DELAY and off["delay"] < late:
        return False
    rows = held.clear(j, CLEAR * drive.torque, LIMIT * drive.speed)
    ends = (rows.rest(one, fit.apart) for one in (drive, drive.taking(given, kind)))
    return predicts(rows, *ends)
