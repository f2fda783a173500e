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

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.record_fields import SEPARATE_FIELD_FORMAT
from minimax_cal.dynamics.logs.log_table import Run, select_field_rows
from minimax_cal.dynamics.regressor import (
    INERTIAL_PARAMETERS_PER_LINK,
    JointMotion,
    build_nominal_inertial_parameters,
    compute_base_parameter_combinations,
    inverse_dynamics,
    regressor,
)
from minimax_cal.robots.robot import Robot

SAMPLE_RATE_HZ = 100.0  # of what the columns are computed from
ROW_RATE_HZ = 25.0  # of rows
FITTED_ROW_STRIDE = (
    2  # every second row is fitted: near the filter's cutoff, noise of fewer rows is whiter
)
FILTER_CUTOFF_HZ, FILTER_ORDER = 8.0, 4  # of the zero-phase filter [Butterworth]
FILTER_MEMORY_DURATION = 2.0  # after which the filter has forgotten what went in, to 1e-16
MIN_RELATIVE_FILTER_TAP = (
    1e-7  # of the filter's largest: what it takes of samples further off is nothing
)
REVERSAL_DURATION = 0.1  # about rest and reversals, where a joint does not count as moving
UNFITTED_REVERSAL_DURATION = (
    0.15  # the same, without a fit: as far as the filter takes the step of friction
)
MAX_REST_SPEED_SHARE = 0.01  # of the joint's largest speed: below it the joint is at rest
MAX_REST_SPEED = 2e-3  # below it a joint is at rest, however slow the log [rad/s, m/s]
MIN_GAP_DURATION = 0.1  # longer steps of time are gaps
UNUSED_EDGE_DURATION = 0.4  # at the ends and about gaps, where the filter has little to look at
AUTOREGRESSIVE_ORDER = 4  # of the noise of a joint: rows that went before and matter
GROUPS_PER_RUN = 4  # groups of a trajectory, which err together
ALWAYS_FITTED_FOLD = -1  # number of the fold of rows that are always fitted
SAMPLED_LOG_FIELDS = (
    "torque",
    "since",
    "payload",
    "temperature",
    "gap",
)  # of Logs, beside the motion
MIN_RELATIVE_TORQUE_NOISE = 1e-9  # of the largest torque: the noise of computed rows


@lru_cache(maxsize=32)
def filter_impulse_response(rate_hz: float) -> Array:
    """(k,) the filter forwards, until nothing of it is left.  rate_hz: [Hz].

    By partial fractions of the bilinear transform; scipy.signal would do, and takes longer to
    import than to filter a minute.
    """
    around = np.exp(0.5j * np.pi * (1.0 + (2.0 * np.arange(FILTER_ORDER) + 1.0) / FILTER_ORDER))
    analog = np.tan(np.pi * FILTER_CUTOFF_HZ / rate_hz) * around
    poles = (1.0 + analog) / (1.0 - analog)
    others = 1.0 - poles / poles[:, None]
    np.fill_diagonal(others, 1.0)
    out = (
        (poles ** np.arange(int(FILTER_MEMORY_DURATION * rate_hz))[:, None])
        @ (1.0 / others.prod(axis=1))
    ).real
    for _ in range(FILTER_ORDER):  # zeros at half the rate
        out[1:] += out[:-1].copy()
    return np.asarray(out / out.sum())


def apply_zero_phase_filter(values: Array, rate_hz: float) -> Array:
    """Values (m, ...) after the zero-phase filter: forwards and backwards.  rate_hz: [Hz].

    About the ends the values go on as they came, turned about the end [Gustafsson 1996].
    """
    response = filter_impulse_response(rate_hz)
    pad = min(len(values) - 1, int(rate_hz))
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


def differentiate_in_time(values: Array, rate_hz: float) -> Array:
    """Derivative in time of values (m, ...), to the fourth order of the step [1/s]."""
    out = np.gradient(values, axis=0)
    wide = (values[4:] - values[:-4]) / 4.0
    out[2:-2] = (4.0 * out[2:-2] - wide) / 3.0
    return out * rate_hz


def interpolate_linearly(new_times: Array, times: Array, values: Array) -> Array:
    """Values (m, n) at some times, straight between those that they have (m,)."""
    return np.stack([np.interp(new_times, times, column) for column in values.T], axis=1)


@lru_cache(maxsize=32)
def build_filter_matrix(sample_count: int) -> csr_array:
    """(rows, samples) the filter of one run, from samples to rows, as `apply_zero_phase_filter`
    treats its ends.
    """
    # What the filter takes of the samples about one, as far as that can be seen.
    wide = int(4.0 * SAMPLE_RATE_HZ)
    impulse = np.zeros(2 * wide + 1)
    impulse[wide] = 1.0
    weight = apply_zero_phase_filter(impulse, SAMPLE_RATE_HZ)
    seen = np.flatnonzero(np.abs(weight) > MIN_RELATIVE_FILTER_TAP * weight[wide])
    weight = weight[seen[0] : seen[-1] + 1]
    reach = len(weight) // 2
    rows = np.arange(0, sample_count, int(SAMPLE_RATE_HZ / ROW_RATE_HZ))
    at = rows[:, None] + np.arange(-reach, reach + 1)
    end = np.clip(at, 0, sample_count - 1)
    beyond = at != end
    mirrored = np.clip(2 * end - at, 0, sample_count - 1)
    row = np.broadcast_to(np.arange(len(rows))[:, None], at.shape)
    value = np.broadcast_to(weight, at.shape)
    entries = (
        np.concatenate([np.where(beyond, -value, value).ravel(), 2.0 * value[beyond]]),
        (np.concatenate([row.ravel(), row[beyond]]),
         np.concatenate([mirrored.ravel(), end[beyond]])),
    )  # fmt: skip
    return csr_array(coo_array(entries, shape=(len(rows), sample_count)))


@dataclass(frozen=True, eq=False)
class MotionLogs:
    """Trajectories on an even grid of SAMPLE_HZ, one after another, filtered once.

    motion: (M, n).  torque: (M, n) [N m, N or A].  since: (M,) time since the run began [s].
    payload: (M,) [kg], NaN where not given.  temperature: (M, n) [C], NaN where not given.
    run_starts: (r + 1,) where each run begins.  gap: (M,) True close to a gap or an end.
    """

    names: tuple[str, ...]
    motion: JointMotion
    torque: Array
    since: Array
    payload: Array
    temperature: Array
    run_starts: Array
    gap: Array
    unit: str

    @property
    def joint_count(self) -> int:
        """Number of joints."""
        return int(self.torque.shape[1])

    @property
    def total_duration(self) -> float:
        """Length of all runs [s]."""
        return float(len(self.since) / SAMPLE_RATE_HZ)

    @cached_property
    def run_slices(self) -> list[slice]:
        """The samples of each run."""
        return list(map(slice, self.run_starts[:-1].tolist(), self.run_starts[1:].tolist()))

    @cached_property
    def row_samples(self) -> Array:
        """(R,) samples that are rows."""
        every, step = np.arange(len(self.since)), int(SAMPLE_RATE_HZ / ROW_RATE_HZ)
        return np.concatenate([every[run][::step] for run in self.run_slices])

    @cached_property
    def run_index(self) -> Array:
        """(R,) which run a row is of."""
        return self.find_run_indices(self.row_samples)

    def find_run_indices(self, sample_indices: Array) -> Array:
        """Which run samples are of."""
        return np.searchsorted(self.run_starts, sample_indices, side="right") - 1

    @cached_property
    def quarter_index(self) -> Array:
        """(R,) which quarter, of all runs, a row is of."""
        long = np.diff(self.run_starts)[self.run_index]
        part = GROUPS_PER_RUN * (self.row_samples - self.run_starts[self.run_index]) // long
        return np.asarray(GROUPS_PER_RUN * self.run_index + part)

    def find_samples_away_from_reversals(self, min_duration: float) -> Array:
        """(M, n) True where a joint is neither at rest nor so near a reversal [s]."""
        qd = self.motion.qd
        still = np.abs(qd) < np.maximum(
            MAX_REST_SPEED_SHARE * np.abs(qd).max(axis=0), MAX_REST_SPEED
        )
        still[1:] |= qd[1:] * qd[:-1] < 0.0
        out = np.empty(qd.shape, dtype=bool)
        reach = round(min_duration * SAMPLE_RATE_HZ)
        for run in self.run_slices:
            count = np.cumsum(np.pad(still[run], ((reach + 1, reach), (0, 0))), axis=0)
            out[run] = count[2 * reach + 1 :] == count[: -2 * reach - 1]
        return out

    @cached_property
    def is_sample_moving(self) -> Array:
        """(M, n) True where a joint moves: neither at rest nor near a reversal."""
        return self.find_samples_away_from_reversals(REVERSAL_DURATION)

    @cached_property
    def is_row_moving(self) -> Array:
        """(R, n) the same of the rows."""
        return self.is_sample_moving[self.row_samples]

    @cached_property
    def fitted_row_mask_by_joint(self) -> Array:
        """(R, n) True for rows that are fitted: every THIN-th, no reversal, gap or end close by."""
        number = (self.row_samples - self.run_starts[self.run_index]) // int(
            SAMPLE_RATE_HZ / ROW_RATE_HZ
        )
        some = (number % FITTED_ROW_STRIDE == 0) & ~self.gap[self.row_samples]
        return np.asarray(
            self.find_samples_away_from_reversals(UNFITTED_REVERSAL_DURATION)[self.row_samples]
            & some[:, None]
        )

    @cached_property
    def row_torques(self) -> Array:
        """(R, n) torques of the rows."""
        return self.filter_to_rows(self.torque)

    @cached_property
    def filter_matrix(self) -> csr_array:
        """(R, M) the filter, from samples to rows."""
        parts = map(build_filter_matrix, np.diff(self.run_starts).tolist())
        return csr_array(block_diag(list(parts), format="csr"))

    def filter_to_rows(self, columns: Array) -> Array:
        """Rows (R, ...) of columns (M, ...), filtered."""
        flat = self.filter_matrix @ columns.reshape(len(columns), -1)
        return flat.reshape(len(self.row_samples), *columns.shape[1:])

    def differentiate_each_run(self, values: Array) -> Array:
        """Derivative in time (M, ...) of values (M, ...), each run for itself."""
        return np.concatenate(
            [differentiate_in_time(values[run], SAMPLE_RATE_HZ) for run in self.run_slices]
        )

    def with_torque_delay_removed(self, delay: float) -> MotionLogs:
        """The logs with torques that were logged so much after the motion [s] put back in time."""
        moved = []
        for run in self.run_slices:
            since = self.since[run]
            spline = scipy.interpolate.CubicSpline(since, self.torque[run])
            moved.append(spline(np.clip(since + delay, since[0], since[-1])))
        return replace(self, torque=np.concatenate(moved))

    def split_rows_into_folds(
        self, held_out_share: float, held_out_runs: Sequence[str] = ()
    ) -> Array:
        """(R,) fold of every row: runs named are one; else whole runs in turn, about a share each.

        A single run is left out by quarters.
        """
        count = len(self.names)
        if held_out_runs:
            fold = [0 if name in held_out_runs else ALWAYS_FITTED_FOLD for name in self.names]
            return np.array(fold)[self.run_index]
        if count == 1:
            return self.quarter_index
        parts = min(count, max(2, round(1.0 / held_out_share)))
        return (np.arange(count) % parts)[self.run_index]

    def select_runs(self, run_indices: Sequence[int]) -> MotionLogs:
        """The logs of some runs."""
        keep = np.concatenate([np.arange(len(self.since))[self.run_slices[r]] for r in run_indices])
        start = np.cumsum([0, *np.diff(self.run_starts)[list(run_indices)]])
        names, motion = tuple(self.names[r] for r in run_indices), self.motion.select_samples(keep)
        rows = select_field_rows(self, SAMPLED_LOG_FIELDS, keep)
        return replace(self, names=names, motion=motion, run_starts=start, **rows)


def resample_and_filter_run(run: Run) -> MotionLogs:
    """One trajectory on the even grid."""
    every = max(1, round(1.0 / float(np.median(np.diff(run.time))) / SAMPLE_RATE_HZ))
    rate = SAMPLE_RATE_HZ * every
    time = np.arange(run.time[0], run.time[-1], 1.0 / rate)

    def resampled(values: Array) -> Array:
        return apply_zero_phase_filter(scipy.interpolate.CubicSpline(run.time, values)(time), rate)

    q, torque = resampled(run.q), resampled(run.torque)
    qd = differentiate_in_time(q, rate) if run.qd is None else resampled(run.qd)
    qdd = differentiate_in_time(qd, rate) if run.qdd is None else resampled(run.qdd)
    motion = JointMotion(q, qd, qdd).select_samples(slice(None, None, every))
    m, n = motion.q.shape
    temperature = np.full((m, n), np.nan)
    if run.temperature is not None:
        given = run.temperature.reshape(len(run.time), -1)
        temperature = np.broadcast_to(interpolate_linearly(time[::every], run.time, given), (m, n))
    wide, (first, last) = np.flatnonzero(np.diff(run.time) > MIN_GAP_DURATION), run.time[[0, -1]]
    begin, end = ([first, *run.time[wide + side], last] for side in (0, 1))
    since = time[::every, None]
    near = (since > np.array(begin) - UNUSED_EDGE_DURATION) & (
        since < np.array(end) + UNUSED_EDGE_DURATION
    )
    payload = np.full(m, np.nan if run.payload is None else run.payload)
    return MotionLogs((run.name,), motion, torque[::every], time[::every] - run.time[0], payload,
                temperature, np.array([0, m]), np.asarray(near.any(axis=1)), run.unit)  # fmt: skip


def resample_and_filter_runs(runs: Sequence[Run]) -> MotionLogs:
    """All trajectories on the even grid, one after another."""
    each = [resample_and_filter_run(run) for run in runs]
    motion = (np.concatenate([getattr(one.motion, k) for one in each]) for k in ("q", "qd", "qdd"))
    rows: dict[str, Any] = {
        k: np.concatenate([getattr(o, k) for o in each]) for k in SAMPLED_LOG_FIELDS
    }
    start = np.cumsum([0, *(len(one.since) for one in each)])
    names = tuple(run.name for run in runs)
    return replace(each[0], names=names, motion=JointMotion(*motion), run_starts=start, **rows)


def check_held_out_run_names(
    logs: MotionLogs, run_names: str | Sequence[str] | None
) -> tuple[str, ...]:
    """The runs that judge.  Raises OptionError."""
    wanted = (run_names,) if isinstance(run_names, str) else tuple(run_names or ())
    for name in wanted:
        if name not in logs.names:
            raise OptionError(f"holdout_run: no run {name!r}; choose {', '.join(logs.names)}")
    if wanted and len(set(wanted)) == len(logs.names):
        raise OptionError("holdout_run: leaves no run to learn from; name fewer")
    return wanted


@dataclass(frozen=True, eq=False)
class AutoregressiveWhitening:
    """Which rows are fitted, and what makes their noise white: rows of all joints, joint by
    joint.

    is_row_fitted: (n, R) rows that are fitted.  previous_row_counts: (N,) how many rows of the same
    joint went before without a gap, at most AR_ORDER.  predictor_weights: (n, AR_ORDER + 1,
    AR_ORDER + 1) of the rows before, for each number of these, and last one over the standard
    deviation of what they do not predict.
    """

    is_row_fitted: Array
    previous_row_counts: Array
    predictor_weights: Array

    @cached_property
    def joint_index(self) -> Array:
        """(N,) which joint a row is of."""
        return np.nonzero(self.is_row_fitted)[0]

    def select_fitted_rows(self, values: Array) -> Array:
        """(N,) values of all rows (R,), at those of every joint."""
        return np.broadcast_to(values, self.is_row_fitted.shape)[self.is_row_fitted]

    def whiten_rows(self, rows: Array) -> Array:
        """Rows (N, ...) of all joints with a noise of unit variance and no memory."""
        return np.concatenate([self.whiten_joint_rows(j, rows[self.joint_index == j])
                               for j in range(len(self.is_row_fitted))])  # fmt: skip

    def whiten_joint_rows(self, joint_index: int, rows: Array) -> Array:
        """The same of one joint's rows (k, ...)."""
        own = self.predictor_weights[
            joint_index, self.previous_row_counts[self.joint_index == joint_index]
        ]
        own = own.reshape(*own.shape, *(1,) * (rows.ndim - 1))
        out = rows.copy()
        for lag in range(1, AUTOREGRESSIVE_ORDER + 1):
            out[lag:] -= own[lag:, lag - 1] * rows[:-lag]
        return np.asarray(out * own[:, AUTOREGRESSIVE_ORDER])


def compute_rms_by_joint(residuals: Array, row_mask: Array | None = None) -> Array:
    """(n,) RMS of what is missed (R, n), of all rows or of some of each joint (R, n)."""
    row_mask = np.ones_like(residuals) if row_mask is None else row_mask
    count = np.maximum(row_mask.sum(axis=0), 1)
    return np.asarray(np.sqrt((residuals**2 * row_mask).sum(axis=0) / count))


def mean_over_standard_error(values: Array) -> float:
    """A mean (g,) in units of its standard error."""
    return float(values.mean() / max(values.std(ddof=1) / np.sqrt(len(values)), 1e-300))


def estimate_autoregressive_whitening(
    logs: MotionLogs, residuals: Array
) -> AutoregressiveWhitening:
    """From what a fit leaves of the rows.  residuals: (N,), joint by joint.

    The prediction from the rows before is that of Yule and Walker, of every order up to AR_ORDER:
    a row after a gap has fewer before it.
    """
    kept = logs.fitted_row_mask_by_joint.T
    before = np.zeros(kept.shape, dtype=int)  # fitted rows of the same joint and run just before
    for i in range(FITTED_ROW_STRIDE, kept.shape[1]):
        last = i - FITTED_ROW_STRIDE
        follows = kept[:, last] & (logs.run_index[i] == logs.run_index[last])
        before[:, i] = np.where(follows, before[:, last] + 1, 0)
    place = np.minimum(before, AUTOREGRESSIVE_ORDER)[kept]
    joint, least = (
        np.nonzero(kept)[0],
        MIN_RELATIVE_TORQUE_NOISE * np.abs(logs.row_torques).max(axis=0),
    )
    weights = [solve_yule_walker_predictors(residuals[joint == j], place[joint == j], least[j])
               for j in range(logs.joint_count)]  # fmt: skip
    return AutoregressiveWhitening(kept, place, np.array(weights))


def solve_yule_walker_predictors(
    residuals: Array, previous_row_counts: Array, min_noise: float
) -> Array:
    """Weights of `AutoregressiveWhitening` for one joint.  residuals, previous_row_counts: (k,).
    min_noise: of the noise.
    """
    most = len(residuals)
    lagged = [float(residuals @ residuals) / max(most, 1) + min_noise**2 + 1e-300]
    for lag in range(1, AUTOREGRESSIVE_ORDER + 1):
        here = np.flatnonzero(previous_row_counts >= lag)
        lagged.append(float(residuals[here] @ residuals[here - lag]) / max(len(here), 1))
    covariance = np.array(lagged)
    values = np.linalg.eigvalsh(toeplitz(covariance))
    lift = max(0.0, 1e-4 * covariance[0] - float(values[0]))  # few pairs may contradict each other
    covariance[0] += lift
    out = np.zeros((AUTOREGRESSIVE_ORDER + 1, AUTOREGRESSIVE_ORDER + 1))
    for order in range(AUTOREGRESSIVE_ORDER + 1):
        found = np.linalg.solve(toeplitz(covariance[:order]), covariance[1 : order + 1])
        out[order, :order] = found
        variance = covariance[0] - found @ covariance[1 : order + 1]
        out[order, AUTOREGRESSIVE_ORDER] = 1.0 / np.sqrt(max(variance, min_noise**2, 1e-300))
    return out


# ---- an arm along its logs -----------------------------------------------------------------------


BODY_INDEPENDENT_FIELDS = (
    "regressor",
    "base_parameter_rows",
    "known_payload_torque",
    "speed_sign",
    "bristle_deflection_rows",
    "distance_since_reversal",
)
SIGN_CHANGE_SPEED_SHARE = 0.0025  # of a joint's largest speed: where friction changes its sign
BRISTLE_YIELD_DISTANCES = np.array(
    [1e-4, 1e-3]
)  # way after which each of a joint's bristles slides [rad, m]


def compute_soft_speed_sign(speeds: Array, sign_change_speeds: Array | float) -> Array:
    """Sign of a speed, in proportion to it below `sign_change_speeds`, as simulators have it."""
    return np.clip(speeds / sign_change_speeds, -1.0, 1.0)


def compute_bristle_deflections(logs: MotionLogs, yield_distances: Array) -> Array:
    """(M, n, k) how far bristles are bent along a motion, -1 to 1.  yield_distances: (k,) or (n,
    k).

    A joint that stops or turns round keeps the friction of those that it has not bent over yet:
    Maxwell-slip elements, each after the law of Dahl [Al-Bender, Lampaert, Swevers 2005].
    """
    out = np.zeros((*logs.torque.shape, yield_distances.shape[-1]))
    for run in logs.run_slices:
        q = logs.motion.q[run]
        way = np.diff(q, axis=0, prepend=q[:1])[..., None] / yield_distances
        stays = np.exp(-np.abs(way))
        bent, step = np.sign(way) * (1.0 - stays), 1
        while step < len(q):  # bent[i] += stays[i] * bent[i - 1], all i at once by doubling
            bent[step:] += stays[step:] * bent[:-step]
            stays[step:] *= stays[:-step].copy()
            step *= 2
        out[run] = bent
    return out


@dataclass(frozen=True, eq=False)
class TorqueArm:
    """An arm, and how its torques are read.

    gain: (n,) torque per unit of the log, 1 where it holds torques [N m/A, or none]; empty where a
    current has none, and then each joint has inertial parameters of its own.
    ratio: (n,) gear ratios, NaN where not given.  soft, fastest: (n,) speeds over which friction
    changes its sign, and the largest [rad/s, m/s].  known: (10,) of what the flange carries in runs
    that say so, per kilogram.
    """

    robot: Annotated[Robot, SEPARATE_FIELD_FORMAT]
    gain: Array
    ratio: Array
    soft: Array
    fastest: Array
    known: Array

    @staticmethod
    def build(
        robot: Robot,
        drive_gains: Array,
        gear_ratios: Array,
        payload_parameters_per_kg: Array,
        logs: MotionLogs,
    ) -> TorqueArm:
        """With the speeds that the logs show."""
        fastest = np.maximum(np.abs(logs.motion.qd).max(axis=0), MAX_REST_SPEED)
        return TorqueArm(
            robot,
            drive_gains,
            gear_ratios,
            np.maximum(SIGN_CHANGE_SPEED_SHARE * fastest, 1e-4),
            fastest,
            payload_parameters_per_kg,
        )

    @cached_property
    def nominal_inertial_parameters(self) -> Array:
        """(10 n,) inertial parameters as the robot file gives them."""
        return build_nominal_inertial_parameters(self.robot).ravel()

    @property
    def has_shared_inertial_parameters(self) -> bool:
        """Whether all joints have the same inertial parameters."""
        return bool(len(self.gain))

    @cached_property
    def base_parameter_combinations(self) -> Array:
        """(10 n, r) combinations of inertial parameters that any motion can show."""
        n = self.robot.joints
        rng = np.random.default_rng(0)
        q, qd, qdd = rng.normal(size=(3, 10 * n, n))
        columns = regressor(self.robot, JointMotion(q, qd, qdd))
        return compute_base_parameter_combinations(
            columns.reshape(-1, INERTIAL_PARAMETERS_PER_LINK * n)
        )


@dataclass(frozen=True, eq=False)
class ArmMotion:
    """An arm along the trajectories of some logs: what the laws of joint torque are functions of.

    Columns are made of the motion at every sample, in the unit of the log, and then filtered to
    rows.

    inertial_parameters_by_joint: (n, 10 n) inertial parameters as they are last known, by joint;
    equal rows where joints share them.  friction_torque: (M, n) of every joint as it is last known,
    in the unit of the log.
    """

    arm: TorqueArm
    logs: MotionLogs
    inertial_parameters_by_joint: Array
    friction_torque: Array

    @staticmethod
    def build(arm: TorqueArm, logs: MotionLogs) -> ArmMotion:
        """With the rigid body as drawn and no friction."""
        rigid = np.broadcast_to(
            arm.nominal_inertial_parameters,
            (logs.joint_count, len(arm.nominal_inertial_parameters)),
        )
        return ArmMotion(arm, logs, rigid, np.zeros_like(logs.torque))

    @cached_property
    def torque_per_log_unit(self) -> Array:
        """(n,) torque per unit of the log; 1 where it is not known."""
        return (
            self.arm.gain
            if self.arm.has_shared_inertial_parameters
            else np.ones(self.logs.joint_count)
        )

    @cached_property
    def regressor(self) -> Array:
        """(M, n, 10 n) in the unit of the log."""
        return regressor(self.arm.robot, self.logs.motion) / self.torque_per_log_unit[:, None]

    @cached_property
    def base_parameter_rows(self) -> Array:
        """(R, n, r) of the combinations that any motion can show."""
        return self.logs.filter_to_rows(self.regressor @ self.arm.base_parameter_combinations)

    @cached_property
    def known_payload_torque(self) -> Array:
        """(M, n) of what the flange carries and a run says [unit of the log]."""
        carried = np.nan_to_num(self.logs.payload)[:, None]
        return np.asarray(
            carried * (self.regressor[:, :, -INERTIAL_PARAMETERS_PER_LINK:] @ self.arm.known)
        )

    @cached_property
    def load_torque(self) -> Array:
        """(M, n) torque that the body puts on every joint, in the unit of the log."""
        rigid = np.einsum("mjp,jp->mj", self.regressor, self.inertial_parameters_by_joint)
        return np.asarray(rigid + self.known_payload_torque)

    @cached_property
    def speed_sign(self) -> Array:
        """(M, n) sign of the speed, soft where it changes."""
        return compute_soft_speed_sign(self.logs.motion.qd, self.arm.soft)

    @cached_property
    def bristle_deflection_rows(self) -> Array:
        """(R, n, k) how far bristles are bent, -1 to 1, less the sense; 0 while a joint slides."""
        off = (
            compute_bristle_deflections(self.logs, BRISTLE_YIELD_DISTANCES)
            - self.speed_sign[..., None]
        )
        return self.logs.filter_to_rows(~self.logs.is_sample_moving[..., None] * off)

    @cached_property
    def distance_since_reversal(self) -> Array:
        """(M, n) how far a joint is from where it last turned round, or began [rad, m]."""
        out = np.zeros_like(self.logs.torque)
        for run in self.logs.run_slices:
            q, back = self.logs.motion.q[run], self.logs.motion.qd[run] > 0.0
            flips = np.zeros(back.shape, dtype=bool)
            flips[1:] = back[1:] != back[:-1]
            last = np.maximum.accumulate(np.where(flips, np.arange(len(q))[:, None], 0), axis=0)
            out[run] = np.abs(q - np.take_along_axis(q, last, axis=0))
        return out

    @cached_property
    def unshifted_body_torque(self) -> Array:
        """(M, n) torque of the body by the recursion that `compute_torque_per_shift` takes [N m,
        N].
        """
        links = self.inertial_parameters_by_joint[0].reshape(-1, INERTIAL_PARAMETERS_PER_LINK)
        return inverse_dynamics(self.arm.robot, self.logs.motion, links)

    def compute_torque_per_shift(self, shift: Array) -> Array:
        """(M, n) torque of the body per unit of a shift `shift` (M, n) of the motion [rad, m]."""
        motion, links = (
            self.logs.motion,
            self.inertial_parameters_by_joint[0].reshape(-1, INERTIAL_PARAMETERS_PER_LINK),
        )
        step, rate = (
            1e-6 / max(float(np.abs(shift).max()), 1e-300),
            self.logs.differentiate_each_run(shift),
        )
        moved = JointMotion(motion.q + step * shift, motion.qd + step * rate,
                       motion.qdd + step * self.logs.differentiate_each_run(rate))  # fmt: skip
        torque = inverse_dynamics(self.arm.robot, moved, links)
        return (torque - self.unshifted_body_torque) / step / self.torque_per_log_unit

    def with_body(self, inertial_parameters_by_joint: Array, friction_torque: Array) -> ArmMotion:
        """The scene with another body and friction, its regressor kept."""
        new = replace(
            self,
            inertial_parameters_by_joint=inertial_parameters_by_joint,
            friction_torque=friction_torque,
        )
        for name in vars(self).keys() & BODY_INDEPENDENT_FIELDS:
            vars(new)[name] = vars(self)[name]
        return new
