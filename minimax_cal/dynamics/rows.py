"""Rows of joint torque along trajectories, filtered alike on both sides, and their noise in time.

Positions, speeds, accelerations and torques pass one zero-phase filter; what is computed of the
motion then passes it once more, and the torques with it.  Otherwise what the filter did to one side
alone is taken for compliant joints and delays.  Friction near rest and reversals is no function of
the speed: these rows are predicted, and never fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Annotated, Any

import numpy as np
import scipy
from scipy.fft import irfft, next_fast_len, rfft
from scipy.linalg import toeplitz
from scipy.sparse import block_diag, coo_array, csr_array

from minimax_cal.dynamics.logs.table import Run, rows_of
from minimax_cal.dynamics.regressor import (
    PER_LINK,
    Motion,
    base_parameters,
    inertial_parameters,
    inverse_dynamics,
    regressor,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.facts import APART
from minimax_cal.robots.robot import Robot

SAMPLE_HZ = 100.0  # of what the columns are computed from
ROW_HZ = 25.0  # of rows
THIN = 2  # every second row is fitted: near the filter's cutoff, noise of fewer rows is whiter
CUTOFF_HZ, FILTER_ORDER = 8.0, 4  # of the zero-phase filter [Butterworth]
FORGETS_S = 2.0  # after which the filter has forgotten what went in, to 1e-16
LEAST_TAP = 1e-7  # of the filter's largest: what it takes of samples further off is nothing
REVERSAL_S = 0.1  # about rest and reversals, where a joint does not count as moving
UNFITTED_S = 0.15  # the same, without a fit: as far as the filter takes the step of friction
REST = 0.01  # of the joint's largest speed: below it the joint is at rest
SLOWEST = 2e-3  # below it a joint is at rest, however slow the log [rad/s, m/s]
GAP_S = 0.1  # longer steps of time are gaps
EDGE_S = 0.4  # at the ends and about gaps, where the filter has little to look at
AR_ORDER = 4  # of the noise of a joint: rows that went before and matter
QUARTERS = 4  # groups of a trajectory, which err together
NEVER_OUT = -1  # number of the fold of rows that are always fitted
SAMPLED = ("torque", "since", "payload", "temperature", "gap")  # of Logs, beside the motion
LEAST_NOISE = 1e-9  # of the largest torque: the noise of computed rows


@lru_cache(maxsize=32)
def impulse_response(rate: float) -> Array:
    """(k,) the filter forwards, until nothing of it is left.  rate: [Hz].

    By partial fractions of the bilinear transform; scipy.signal would do, and takes longer to
    import than to filter a minute.
    """
    around = np.exp(0.5j * np.pi * (1.0 + (2.0 * np.arange(FILTER_ORDER) + 1.0) / FILTER_ORDER))
    analog = np.tan(np.pi * CUTOFF_HZ / rate) * around
    poles = (1.0 + analog) / (1.0 - analog)
    others = 1.0 - poles / poles[:, None]
    np.fill_diagonal(others, 1.0)
    out = ((poles ** np.arange(int(FORGETS_S * rate))[:, None]) @ (1.0 / others.prod(axis=1))).real
    for _ in range(FILTER_ORDER):  # zeros at half the rate
        out[1:] += out[:-1].copy()
    return np.asarray(out / out.sum())


def smooth(values: Array, rate: float) -> Array:
    """Values (m, ...) after the zero-phase filter: forwards and backwards.  rate: [Hz].

    About the ends the values go on as they came, turned about the end [Gustafsson 1996].
    """
    response = impulse_response(rate)
    pad = min(len(values) - 1, int(rate))
    rows = values.reshape(len(values), -1).T
    before = 2.0 * rows[:, :1] - rows[:, pad:0:-1]
    after = 2.0 * rows[:, -1:] - rows[:, -2 : -pad - 2 : -1]
    out = np.concatenate([before, rows, after], axis=1)
    size = next_fast_len(out.shape[1] + len(response), real=True)
    gain = rfft(response, size)
    for _ in range(2):
        first = out[:, :1]  # at rest there before
        change = irfft(rfft(out - first, size) * gain, size)[:, : out.shape[1]]
        out = (first + change)[:, ::-1]
    return out[:, pad : pad + len(values)].T.reshape(values.shape)


def slope(values: Array, rate: float) -> Array:
    """Derivative in time of values (m, ...), to the fourth order of the step [1/s]."""
    out = np.gradient(values, axis=0)
    wide = (values[4:] - values[:-4]) / 4.0
    out[2:-2] = (4.0 * out[2:-2] - wide) / 3.0
    return out * rate


def at_times(to: Array, time: Array, values: Array) -> Array:
    """Values (m, n) at some times, straight between those that they have (m,)."""
    return np.stack([np.interp(to, time, column) for column in values.T], axis=1)


@lru_cache(maxsize=32)
def run_operator(samples: int) -> csr_array:
    """(rows, samples) the filter of one run, from samples to rows, as `smooth` treats its ends."""
    # What the filter takes of the samples about one, as far as that can be seen.
    wide = int(4.0 * SAMPLE_HZ)
    impulse = np.zeros(2 * wide + 1)
    impulse[wide] = 1.0
    weight = smooth(impulse, SAMPLE_HZ)
    seen = np.flatnonzero(np.abs(weight) > LEAST_TAP * weight[wide])
    weight = weight[seen[0] : seen[-1] + 1]
    reach = len(weight) // 2
    rows = np.arange(0, samples, int(SAMPLE_HZ / ROW_HZ))
    at = rows[:, None] + np.arange(-reach, reach + 1)
    end = np.clip(at, 0, samples - 1)
    beyond = at != end
    mirrored = np.clip(2 * end - at, 0, samples - 1)
    row = np.broadcast_to(np.arange(len(rows))[:, None], at.shape)
    value = np.broadcast_to(weight, at.shape)
    entries = (
        np.concatenate([np.where(beyond, -value, value).ravel(), 2.0 * value[beyond]]),
        (np.concatenate([row.ravel(), row[beyond]]),
         np.concatenate([mirrored.ravel(), end[beyond]])),
    )  # fmt: skip
    return csr_array(coo_array(entries, shape=(len(rows), samples)))


@dataclass(frozen=True, eq=False)
class Logs:
    """Trajectories on an even grid of SAMPLE_HZ, one after another, filtered once.

    motion: (M, n).  torque: (M, n) [N m, N or A].  since: (M,) time since the run began [s].
    payload: (M,) [kg], NaN where not given.  temperature: (M, n) [C], NaN where not given.
    start: (r + 1,) where each run begins.  gap: (M,) True close to a gap or an end.
    """

    names: tuple[str, ...]
    motion: Motion
    torque: Array
    since: Array
    payload: Array
    temperature: Array
    start: Array
    gap: Array
    unit: str

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.torque.shape[1])

    @property
    def seconds(self) -> float:
        """Length of all runs [s]."""
        return float(len(self.since) / SAMPLE_HZ)

    @cached_property
    def spans(self) -> list[slice]:
        """The samples of each run."""
        return list(map(slice, self.start[:-1].tolist(), self.start[1:].tolist()))

    @cached_property
    def picked(self) -> Array:
        """(R,) samples that are rows."""
        every, step = np.arange(len(self.since)), int(SAMPLE_HZ / ROW_HZ)
        return np.concatenate([every[run][::step] for run in self.spans])

    @cached_property
    def run(self) -> Array:
        """(R,) which run a row is of."""
        return self.run_of(self.picked)

    def run_of(self, samples: Array) -> Array:
        """Which run samples are of."""
        return np.searchsorted(self.start, samples, side="right") - 1

    @cached_property
    def quarter(self) -> Array:
        """(R,) which quarter, of all runs, a row is of."""
        long = np.diff(self.start)[self.run]
        part = QUARTERS * (self.picked - self.start[self.run]) // long
        return np.asarray(QUARTERS * self.run + part)

    def away(self, seconds: float) -> Array:
        """(M, n) True where a joint is neither at rest nor so near a reversal [s]."""
        qd = self.motion.qd
        still = np.abs(qd) < np.maximum(REST * np.abs(qd).max(axis=0), SLOWEST)
        still[1:] |= qd[1:] * qd[:-1] < 0.0
        out = np.empty(qd.shape, dtype=bool)
        reach = round(seconds * SAMPLE_HZ)
        for run in self.spans:
            count = np.cumsum(np.pad(still[run], ((reach + 1, reach), (0, 0))), axis=0)
            out[run] = count[2 * reach + 1 :] == count[: -2 * reach - 1]
        return out

    @cached_property
    def sliding(self) -> Array:
        """(M, n) True where a joint moves: neither at rest nor near a reversal."""
        return self.away(REVERSAL_S)

    @cached_property
    def moving(self) -> Array:
        """(R, n) the same of the rows."""
        return self.sliding[self.picked]

    @cached_property
    def fitted(self) -> Array:
        """(R, n) True for rows that are fitted: every THIN-th, no reversal, gap or end close by."""
        number = (self.picked - self.start[self.run]) // int(SAMPLE_HZ / ROW_HZ)
        some = (number % THIN == 0) & ~self.gap[self.picked]
        return np.asarray(self.away(UNFITTED_S)[self.picked] & some[:, None])

    @cached_property
    def y(self) -> Array:
        """(R, n) torques of the rows."""
        return self.filtered(self.torque)

    @cached_property
    def operator(self) -> csr_array:
        """(R, M) the filter, from samples to rows."""
        parts = map(run_operator, np.diff(self.start).tolist())
        return csr_array(block_diag(list(parts), format="csr"))

    def filtered(self, columns: Array) -> Array:
        """Rows (R, ...) of columns (M, ...), filtered."""
        flat = self.operator @ columns.reshape(len(columns), -1)
        return flat.reshape(len(self.picked), *columns.shape[1:])

    def slope(self, values: Array) -> Array:
        """Derivative in time (M, ...) of values (M, ...), each run for itself."""
        return np.concatenate([slope(values[run], SAMPLE_HZ) for run in self.spans])

    def earlier(self, late: float) -> Logs:
        """The logs with torques that were logged so much after the motion [s] put back in time."""
        moved = []
        for run in self.spans:
            since = self.since[run]
            spline = scipy.interpolate.CubicSpline(since, self.torque[run])
            moved.append(spline(np.clip(since + late, since[0], since[-1])))
        return replace(self, torque=np.concatenate(moved))

    def split_folds(self, share: float, held_out_runs: Sequence[str] = ()) -> Array:
        """(R,) fold of every row: runs named are one; else whole runs in turn, about a share each.

        A single run is left out by quarters.
        """
        count = len(self.names)
        if held_out_runs:
            fold = [0 if name in held_out_runs else NEVER_OUT for name in self.names]
            return np.array(fold)[self.run]
        if count == 1:
            return self.quarter
        parts = min(count, max(2, round(1.0 / share)))
        return (np.arange(count) % parts)[self.run]

    def only(self, runs: Sequence[int]) -> Logs:
        """The logs of some runs."""
        keep = np.concatenate([np.arange(len(self.since))[self.spans[r]] for r in runs])
        start = np.cumsum([0, *np.diff(self.start)[list(runs)]])
        names, motion = tuple(self.names[r] for r in runs), self.motion.at(keep)
        rows = rows_of(self, SAMPLED, keep)
        return replace(self, names=names, motion=motion, start=start, **rows)


def prepare_run(run: Run) -> Logs:
    """One trajectory on the even grid."""
    every = max(1, round(1.0 / float(np.median(np.diff(run.time))) / SAMPLE_HZ))
    rate = SAMPLE_HZ * every
    time = np.arange(run.time[0], run.time[-1], 1.0 / rate)

    def resampled(values: Array) -> Array:
        return smooth(scipy.interpolate.CubicSpline(run.time, values)(time), rate)

    q, torque = resampled(run.q), resampled(run.torque)
    qd = slope(q, rate) if run.qd is None else resampled(run.qd)
    qdd = slope(qd, rate) if run.qdd is None else resampled(run.qdd)
    motion = Motion(q, qd, qdd).at(slice(None, None, every))
    m, n = motion.q.shape
    temperature = np.full((m, n), np.nan)
    if run.temperature is not None:
        given = run.temperature.reshape(len(run.time), -1)
        temperature = np.broadcast_to(at_times(time[::every], run.time, given), (m, n))
    wide, (first, last) = np.flatnonzero(np.diff(run.time) > GAP_S), run.time[[0, -1]]
    begin, end = ([first, *run.time[wide + side], last] for side in (0, 1))
    since = time[::every, None]
    near = (since > np.array(begin) - EDGE_S) & (since < np.array(end) + EDGE_S)
    payload = np.full(m, np.nan if run.payload is None else run.payload)
    return Logs((run.name,), motion, torque[::every], time[::every] - run.time[0], payload,
                temperature, np.array([0, m]), np.asarray(near.any(axis=1)), run.unit)  # fmt: skip


def prepare(runs: Sequence[Run]) -> Logs:
    """All trajectories on the even grid, one after another."""
    each = [prepare_run(run) for run in runs]
    motion = (np.concatenate([getattr(one.motion, k) for one in each]) for k in ("q", "qd", "qdd"))
    rows: dict[str, Any] = {k: np.concatenate([getattr(o, k) for o in each]) for k in SAMPLED}
    start = np.cumsum([0, *(len(one.since) for one in each)])
    names = tuple(run.name for run in runs)
    return replace(each[0], names=names, motion=Motion(*motion), start=start, **rows)


def named_runs(logs: Logs, given: str | Sequence[str] | None) -> tuple[str, ...]:
    """The runs that judge.  Raises OptionError."""
    wanted = (given,) if isinstance(given, str) else tuple(given or ())
    for name in wanted:
        if name not in logs.names:
            raise OptionError(f"holdout_run: no run {name!r}; choose {', '.join(logs.names)}")
    if wanted and len(set(wanted)) == len(logs.names):
        raise OptionError("holdout_run: leaves no run to learn from; name fewer")
    return wanted


@dataclass(frozen=True, eq=False)
class Whitening:
    """Which rows are fitted, and what makes their noise white: rows of all joints, joint by joint.

    kept: (n, R) rows that are fitted.  place: (N,) how many rows of the same joint went before
    without a gap, at most AR_ORDER.  weights: (n, AR_ORDER + 1, AR_ORDER + 1) of the rows before,
    for each number of these, and last one over the standard deviation of what they do not predict.
    """

    kept: Array
    place: Array
    weights: Array

    @cached_property
    def joint(self) -> Array:
        """(N,) which joint a row is of."""
        return np.nonzero(self.kept)[0]

    def rows(self, values: Array) -> Array:
        """(N,) values of all rows (R,), at those of every joint."""
        return np.broadcast_to(values, self.kept.shape)[self.kept]

    def white(self, rows: Array) -> Array:
        """Rows (N, ...) of all joints with a noise of unit variance and no memory."""
        return np.concatenate([self.white_joint(j, rows[self.joint == j])
                               for j in range(len(self.kept))])  # fmt: skip

    def white_joint(self, joint: int, rows: Array) -> Array:
        """The same of one joint's rows (k, ...)."""
        own = self.weights[joint, self.place[self.joint == joint]]
        own = own.reshape(*own.shape, *(1,) * (rows.ndim - 1))
        out = rows.copy()
        for lag in range(1, AR_ORDER + 1):
            out[lag:] -= own[lag:, lag - 1] * rows[:-lag]
        return np.asarray(out * own[:, AR_ORDER])


def rms_by_joint(missed: Array, rows: Array | None = None) -> Array:
    """(n,) RMS of what is missed (R, n), of all rows or of some of each joint (R, n)."""
    rows = np.ones_like(missed) if rows is None else rows
    count = np.maximum(rows.sum(axis=0), 1)
    return np.asarray(np.sqrt((missed**2 * rows).sum(axis=0) / count))


def standard_errors(values: Array) -> float:
    """A mean (g,) in units of its standard error."""
    return float(values.mean() / max(values.std(ddof=1) / np.sqrt(len(values)), 1e-300))


def whitening(logs: Logs, rest: Array) -> Whitening:
    """From what a fit leaves of the rows.  rest: (N,), joint by joint.

    The prediction from the rows before is that of Yule and Walker, of every order up to AR_ORDER:
    a row after a gap has fewer before it.
    """
    kept = logs.fitted.T
    before = np.zeros(kept.shape, dtype=int)  # fitted rows of the same joint and run just before
    for i in range(THIN, kept.shape[1]):
        last = i - THIN
        follows = kept[:, last] & (logs.run[i] == logs.run[last])
        before[:, i] = np.where(follows, before[:, last] + 1, 0)
    place = np.minimum(before, AR_ORDER)[kept]
    joint, least = np.nonzero(kept)[0], LEAST_NOISE * np.abs(logs.y).max(axis=0)
    weights = [predictors(rest[joint == j], place[joint == j], least[j])
               for j in range(logs.joints)]  # fmt: skip
    return Whitening(kept, place, np.array(weights))


def predictors(rest: Array, place: Array, least: float) -> Array:
    """Weights of `Whitening` for one joint.  rest, place: (k,).  least: of the noise."""
    most = len(rest)
    lagged = [float(rest @ rest) / max(most, 1) + least**2 + 1e-300]
    for lag in range(1, AR_ORDER + 1):
        here = np.flatnonzero(place >= lag)
        lagged.append(float(rest[here] @ rest[here - lag]) / max(len(here), 1))
    covariance = np.array(lagged)
    values = np.linalg.eigvalsh(toeplitz(covariance))
    lift = max(0.0, 1e-4 * covariance[0] - float(values[0]))  # few pairs may contradict each other
    covariance[0] += lift
    out = np.zeros((AR_ORDER + 1, AR_ORDER + 1))
    for order in range(AR_ORDER + 1):
        found = np.linalg.solve(toeplitz(covariance[:order]), covariance[1 : order + 1])
        out[order, :order] = found
        variance = covariance[0] - found @ covariance[1 : order + 1]
        out[order, AR_ORDER] = 1.0 / np.sqrt(max(variance, least**2, 1e-300))
    return out


# ---- an arm along its logs -----------------------------------------------------------------------


KEPT = ("regressor", "base_rows", "known_torque", "sense", "bristles", "since_reversal")
SOFT = 0.0025  # of a joint's largest speed: where friction changes its sign
YIELD = np.array([1e-4, 1e-3])  # way after which each of a joint's bristles slides [rad, m]


def sense_of(qd: Array, soft: Array | float) -> Array:
    """Sign of a speed, in proportion to it below `soft`, as simulators have it."""
    return np.clip(qd / soft, -1.0, 1.0)


def bent_bristles(logs: Logs, yields: Array) -> Array:
    """(M, n, k) how far bristles are bent along a motion, -1 to 1.  yields: (k,) or (n, k).

    A joint that stops or turns round keeps the friction of those that it has not bent over yet:
    Maxwell-slip elements, each after the law of Dahl [Al-Bender, Lampaert, Swevers 2005].
    """
    out = np.zeros((*logs.torque.shape, yields.shape[-1]))
    for run in logs.spans:
        q = logs.motion.q[run]
        way = np.diff(q, axis=0, prepend=q[:1])[..., None] / yields
        stays = np.exp(-np.abs(way))
        bent, step = np.sign(way) * (1.0 - stays), 1
        while step < len(q):  # bent[i] += stays[i] * bent[i - 1], all i at once by doubling
            bent[step:] += stays[step:] * bent[:-step]
            stays[step:] *= stays[:-step].copy()
            step *= 2
        out[run] = bent
    return out


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm, and how its torques are read.

    gain: (n,) torque per unit of the log, 1 where it holds torques [N m/A, or none]; empty where a
    current has none, and then each joint has inertial parameters of its own.
    ratio: (n,) gear ratios, NaN where not given.  soft, fastest: (n,) speeds over which friction
    changes its sign, and the largest [rad/s, m/s].  known: (10,) of what the flange carries in runs
    that say so, per kilogram.
    """

    robot: Annotated[Robot, APART]
    gain: Array
    ratio: Array
    soft: Array
    fastest: Array
    known: Array

    @staticmethod
    def of(robot: Robot, gain: Array, ratio: Array, known: Array, logs: Logs) -> Arm:
        """With the speeds that the logs show."""
        fastest = np.maximum(np.abs(logs.motion.qd).max(axis=0), SLOWEST)
        return Arm(robot, gain, ratio, np.maximum(SOFT * fastest, 1e-4), fastest, known)

    @cached_property
    def drawn(self) -> Array:
        """(10 n,) inertial parameters as the robot file gives them."""
        return inertial_parameters(self.robot).ravel()

    @property
    def shared(self) -> bool:
        """Whether all joints have the same inertial parameters."""
        return bool(len(self.gain))

    @cached_property
    def base(self) -> Array:
        """(10 n, r) combinations of inertial parameters that any motion can show."""
        n = self.robot.joints
        rng = np.random.default_rng(0)
        q, qd, qdd = rng.normal(size=(3, 10 * n, n))
        columns = regressor(self.robot, Motion(q, qd, qdd))
        return base_parameters(columns.reshape(-1, PER_LINK * n))


@dataclass(frozen=True, eq=False)
class Scene:
    """An arm along the trajectories of some logs: what the laws of joint torque are functions of.

    Columns are made of the motion at every sample, in the unit of the log, and then filtered to
    rows.

    rigid: (n, 10 n) inertial parameters as they are last known, by joint; equal rows where joints
    share them.  friction: (M, n) of every joint as it is last known, in the unit of the log.
    """

    arm: Arm
    logs: Logs
    rigid: Array
    friction: Array

    @staticmethod
    def of(arm: Arm, logs: Logs) -> Scene:
        """With the rigid body as drawn and no friction."""
        rigid = np.broadcast_to(arm.drawn, (logs.joints, len(arm.drawn)))
        return Scene(arm, logs, rigid, np.zeros_like(logs.torque))

    @cached_property
    def divisor(self) -> Array:
        """(n,) torque per unit of the log; 1 where it is not known."""
        return self.arm.gain if self.arm.shared else np.ones(self.logs.joints)

    @cached_property
    def regressor(self) -> Array:
        """(M, n, 10 n) in the unit of the log."""
        return regressor(self.arm.robot, self.logs.motion) / self.divisor[:, None]

    @cached_property
    def base_rows(self) -> Array:
        """(R, n, r) of the combinations that any motion can show."""
        return self.logs.filtered(self.regressor @ self.arm.base)

    @cached_property
    def known_torque(self) -> Array:
        """(M, n) of what the flange carries and a run says [unit of the log]."""
        carried = np.nan_to_num(self.logs.payload)[:, None]
        return np.asarray(carried * (self.regressor[:, :, -PER_LINK:] @ self.arm.known))

    @cached_property
    def load(self) -> Array:
        """(M, n) torque that the body puts on every joint, in the unit of the log."""
        rigid = np.einsum("mjp,jp->mj", self.regressor, self.rigid)
        return np.asarray(rigid + self.known_torque)

    @cached_property
    def sense(self) -> Array:
        """(M, n) sign of the speed, soft where it changes."""
        return sense_of(self.logs.motion.qd, self.arm.soft)

    @cached_property
    def bristles(self) -> Array:
        """(R, n, k) how far bristles are bent, -1 to 1, less the sense; 0 while a joint slides."""
        off = bent_bristles(self.logs, YIELD) - self.sense[..., None]
        return self.logs.filtered(~self.logs.sliding[..., None] * off)

    @cached_property
    def since_reversal(self) -> Array:
        """(M, n) how far a joint is from where it last turned round, or began [rad, m]."""
        out = np.zeros_like(self.logs.torque)
        for run in self.logs.spans:
            q, back = self.logs.motion.q[run], self.logs.motion.qd[run] > 0.0
            flips = np.zeros(back.shape, dtype=bool)
            flips[1:] = back[1:] != back[:-1]
            last = np.maximum.accumulate(np.where(flips, np.arange(len(q))[:, None], 0), axis=0)
            out[run] = np.abs(q - np.take_along_axis(q, last, axis=0))
        return out

    @cached_property
    def recursive_load(self) -> Array:
        """(M, n) torque of the body by the recursion that `shifted` takes [N m, N]."""
        links = self.rigid[0].reshape(-1, PER_LINK)
        return inverse_dynamics(self.arm.robot, self.logs.motion, links)

    def shifted(self, by: Array) -> Array:
        """(M, n) torque of the body per unit of a shift `by` (M, n) of the motion [rad, m]."""
        motion, links = self.logs.motion, self.rigid[0].reshape(-1, PER_LINK)
        step, rate = 1e-6 / max(float(np.abs(by).max()), 1e-300), self.logs.slope(by)
        moved = Motion(motion.q + step * by, motion.qd + step * rate,
                       motion.qdd + step * self.logs.slope(rate))  # fmt: skip
        torque = inverse_dynamics(self.arm.robot, moved, links)
        return (torque - self.recursive_load) / step / self.divisor

    def with_body(self, rigid: Array, friction: Array) -> Scene:
        """The scene with another body and friction, its regressor kept."""
        new = replace(self, rigid=rigid, friction=friction)
        for name in vars(self).keys() & KEPT:
            vars(new)[name] = vars(self)[name]
        return new
