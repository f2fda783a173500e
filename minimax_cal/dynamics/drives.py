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

from minimax_cal.core.arrays import Array
from minimax_cal.dynamics.logs.log_table import NO_TORQUE_UNIT, Run, select_field_rows
from minimax_cal.dynamics.regressor import JointMotion
from minimax_cal.dynamics.torque_rows import (
    MAX_REST_SPEED,
    UNFITTED_REVERSAL_DURATION,
    MotionLogs,
    TorqueArm,
    compute_soft_speed_sign,
    mean_over_standard_error,
    resample_and_filter_runs,
)

MAX_COMMAND_DELAY, COMMAND_DELAY_STEP = (
    0.1,
    0.004,
)  # the latest command that is looked for, and how closely [s]
CORRELATED_STRETCH_DURATION = 1.0  # rows that err together
MAX_STRETCHES_PER_RUN = 10**6  # stretches, by which they are numbered
MIN_SHARE_NEAR_LIMIT = 0.9  # of the largest torque and speed: rows beyond may be at a limit
MIN_DEMAND_OVER_LIMIT, MAX_SHARE_CLEAR_OF_LIMIT = (
    1.05,
    0.95,
)  # of a limit: where it acts for sure, and where it does not
MIN_ROWS_AT_LIMIT, MIN_STRETCHES_AT_LIMIT = 10, 3  # of a log, at a limit; and stretches of time
MIN_SIGNIFICANT_SIGMAS = 3.5  # standard deviations by which a number is another
MIN_PREDICTION_GAIN_SIGMAS = (
    2.5  # the same, by which stretches of a run left out are predicted better
)
MAX_DRIVE_FIT_STEPS, MIN_DELAY_STEP = 20, 1e-9  # of a fit, and the step that ends it [s]
SPEED_FEEDFORWARD, ROTOR_INERTIA, COULOMB_FRICTION = (
    "ahead",
    "inertia",
    "friction",
)  # what is fitted beside if it is there
DRIVE_EFFECTS = ("servo_gain", "command_delay", "torque_limit", "speed_limit")
SERVO_GAIN_EFFECT, COMMAND_DELAY_EFFECT, TORQUE_LIMIT_EFFECT, SPEED_LIMIT_EFFECT = DRIVE_EFFECTS
DRIVE_EFFECT_UNITS = {  # of a drive, that belong to an effect, and their units
    SERVO_GAIN_EFFECT: {"stiffness": "N m/rad", "damper": "N m s/rad", "ahead": "1"},
    COMMAND_DELAY_EFFECT: {"delay": "s"},
    TORQUE_LIMIT_EFFECT: {"torque": "N m"},
    SPEED_LIMIT_EFFECT: {"speed": "rad/s"},
}
UNLIMITED = (math.inf, 0.0)
BodyTorqueFunction = Callable[
    [JointMotion], Array
]  # torque (m, n) that masses take for a motion [N m]
FITTED_DRIVE_FIELDS = ("stiffness", "damper", "ahead", "delay")


@dataclass(frozen=True)
class PositionDrive:
    """A joint's.  stiffness: kp [N m/rad].  damper: kv [N m s/rad].  ahead: share s of kv that the
    commanded speed has.  delay: d [s].  torque, speed: limits [N m, rad/s], infinite for none.
    """

    stiffness: float
    damper: float
    ahead: float = 0.0
    delay: float = 0.0
    torque: float = math.inf
    speed: float = math.inf

    def with_effect_of(self, other: PositionDrive, effect: str) -> PositionDrive:
        """With the numbers of an effect that another has."""
        return replace(self, **{name: getattr(other, name) for name in DRIVE_EFFECT_UNITS[effect]})


@dataclass(frozen=True, eq=False)
class DriveFit:
    """What logs say of a joint's drive.

    jackknife_changes: (G, 4 + k) by which each stretch (G,), left out, changes FITTED, and what was
    fitted beside these.  nuisance_values: that, by name.  limit_sigmas: standard deviations of
    torque and speed.
    """

    drive: PositionDrive
    jackknife_changes: Array
    stretch_numbers: Array
    nuisance_values: dict[str, float]
    limit_sigmas: tuple[float, float] = (0.0, 0.0)

    @property
    def sigma_by_field(self) -> dict[str, float]:
        """Standard deviations by name."""
        own = np.sqrt(np.diag(jackknife_covariance(self.jackknife_changes)))[
            : len(FITTED_DRIVE_FIELDS)
        ].tolist()
        return dict(
            zip((*FITTED_DRIVE_FIELDS, "torque", "speed"), (*own, *self.limit_sigmas), strict=True)
        )

    @property
    def values_outside_drive(self) -> dict[str, float]:
        """What was fitted beside that is no number of the drive."""
        return {
            name: value for name, value in self.nuisance_values.items() if name != SPEED_FEEDFORWARD
        }

    def compute_residuals(self, rows: DriveRows) -> Array:
        """(R,) torque of some rows that it does not explain."""
        return rows.compute_residuals(self.drive, self.values_outside_drive)


def number_stretches(run_index: Array | int, time_in_run: Array) -> Array:
    """(R,) numbers of the stretches of rows: of which run, and when in it [s]."""
    return run_index * MAX_STRETCHES_PER_RUN + (time_in_run / CORRELATED_STRETCH_DURATION).astype(
        int
    )


def joint_commands(run: Run) -> Array:
    """(m, n) commands of a run that has some."""
    return cast(Array, run.command)


@dataclass(frozen=True, eq=False)
class CommandedRuns:
    """Runs with their commands, and what arms of a model weigh along them, all in N m.

    logs: of the runs; the rows that are used are those clear of gaps.  command_logs: of the
    commands in the place of torques.  gravity_torque: (M, n) torque that the drives add against
    gravity.  speed_sign: (M, n) of the speed.  drive_gains: (n,) torque per unit of the log.
    """

    runs: tuple[Run, ...]
    logs: MotionLogs
    command_logs: MotionLogs
    gravity_torque: Array
    speed_sign: Array
    drive_gains: Array

    @property
    def has_torques(self) -> bool:
        """Whether torques were; else they are those of the model's masses."""
        return self.logs.unit != NO_TORQUE_UNIT

    @property
    def required_nuisances(self) -> tuple[str, ...]:
        """What is fitted in any case: speeds that were not logged may be those of another time.

        Without torques rotors and friction stand between the drive and the masses of the model.
        """
        if not self.has_torques:
            return ROTOR_INERTIA, COULOMB_FRICTION
        return () if all(run.qd is not None for run in self.runs) else (ROTOR_INERTIA,)

    @cached_property
    def is_sliding(self) -> Array:
        """(M, n) True where friction is that of a joint that slides."""
        return self.logs.find_samples_away_from_reversals(UNFITTED_REVERSAL_DURATION)

    @staticmethod
    def build(
        runs: Sequence[Run], arm: TorqueArm, body_torque: BodyTorqueFunction
    ) -> CommandedRuns:
        """Without gravity that drives carry.  body_torque: torque of the masses of a motion."""
        logs = resample_and_filter_runs(runs)
        if logs.unit == NO_TORQUE_UNIT:
            logs = replace(logs, torque=body_torque(logs.motion))
        told = resample_and_filter_runs([replace(run, torque=joint_commands(run)) for run in runs])
        sense = compute_soft_speed_sign(logs.motion.qd, arm.soft)
        return CommandedRuns(tuple(runs), logs, told, 0.0 * sense, sense, arm.gain)

    def with_gravity_share(
        self, gravity_share: float, body_torque: BodyTorqueFunction
    ) -> CommandedRuns:
        """Where drives carry a share of gravity besides.  body_torque: as `build`."""
        still = np.zeros((2, *self.logs.torque.shape))
        weight = body_torque(JointMotion(self.logs.motion.q, *still)) if gravity_share else still[0]
        return replace(self, gravity_torque=gravity_share * weight)

    def build_joint_rows(self, joint_index: int) -> DriveRows:
        """The rows of a joint."""
        logs = self.logs
        used = ~logs.gap & (self.has_torques | self.is_sliding[:, joint_index])
        at = logs.row_samples[used[logs.row_samples]]
        run = logs.find_run_indices(at)
        stretch = number_stretches(run, logs.since[at])
        curves = [
            scipy.interpolate.CubicSpline(
                logs.since[own], self.command_logs.torque[own, joint_index]
            )
            for own in logs.run_slices
        ]
        torque = (
            logs.torque[:, joint_index] * self.drive_gains[joint_index]
            - self.gravity_torque[:, joint_index]
        )
        q, qd, qdd = (
            one[at, joint_index] for one in (logs.motion.q, logs.motion.qd, logs.motion.qdd)
        )
        return DriveRows(
            torque[at],
            q,
            qd,
            qdd,
            self.speed_sign[at, joint_index],
            logs.since[at],
            run,
            stretch,
            tuple(curves),
        )

    def select_rows_below_limits(
        self, joint_index: int, torque_limit: float, speed_limit: float
    ) -> DriveRows:
        """The rows of a joint that no larger torque and speed is near."""
        rows, seen = (
            self.build_joint_rows(joint_index),
            self.build_joint_samples(joint_index, PositionDrive(0.0, 0.0)),
        )
        beyond = (np.abs(seen.torque) > torque_limit) | (np.abs(seen.speed) > speed_limit)
        is_clear = np.ones(len(rows.q), dtype=bool)
        for number in np.unique(rows.run):
            mine, here = rows.run == number, seen.run_index == number
            count = np.concatenate([[0], np.cumsum(beyond[here])])
            before, after = (
                count[np.searchsorted(seen.time_in_run[here], rows.since[mine] + side)]
                for side in (-UNFITTED_REVERSAL_DURATION, UNFITTED_REVERSAL_DURATION)
            )
            is_clear[mine] = before == after
        names = ("torque", "q", "qd", "qdd", "sense", "since", "run", "stretch_numbers")
        return replace(rows, **select_field_rows(rows, names, is_clear))

    def build_joint_samples(self, joint_index: int, drive: PositionDrive) -> DriveSamples:
        """Every row of the logs as logged, at a joint: torque, and what a drive would ask for."""
        out: list[Array] = []
        for number, (run, rows) in enumerate(zip(self.runs, self.logs.run_slices, strict=True)):
            time, grid = run.time - run.time[0], self.logs.since[rows]
            smooth = (self.logs.motion.qd, self.gravity_torque, self.logs.torque)
            qd, carried, torque = (np.interp(time, grid, one[rows, joint_index]) for one in smooth)
            command = joint_commands(run)[:, joint_index]
            late = np.interp(time - drive.delay, time, command)
            rate = np.interp(time - drive.delay, time, np.gradient(command, time))
            asked = drive.stiffness * (late - run.q[:, joint_index])
            asked -= drive.damper * (qd - drive.ahead * rate)
            torque = (
                run.torque[:, joint_index] * self.drive_gains[joint_index]
                if self.has_torques
                else torque
            )
            stretch = number_stretches(number, time)
            out.append(np.array([torque, asked + carried, qd, time, 0 * time + number, stretch]))
        return DriveSamples(*np.concatenate(out, axis=1))


@dataclass(frozen=True, eq=False)
class DriveSamples:
    """(m,) each of a joint: torque measured and asked for [N m], speed, time, run, stretch."""

    torque: Array
    demanded_torque: Array
    speed: Array
    time_in_run: Array
    run_index: Array
    stretch_numbers: Array

    @property
    def noise_sigma(self) -> float:
        """Standard deviation of torque that the drive does not explain, whatever the limits."""
        return 1.4826 * float(np.median(np.abs(self.torque - self.demanded_torque)))


@dataclass(frozen=True, eq=False)
class DriveRows:
    """(R,) each of a joint: torque less what carries gravity [N m], joint value, speed, its
    derivative and sense, time, run, and the stretch that errs together.  command_splines: of each
    run's command.
    """

    torque: Array
    q: Array
    qd: Array
    qdd: Array
    sense: Array
    since: Array
    run: Array
    stretch_numbers: Array
    command_splines: tuple[Any, ...]

    def interpolate_command(self, delay: float, derivative_order: int = 0) -> Array:
        """(R,) the command or its derivative, so late [s]."""
        out = np.empty(len(self.q))
        for number, curve in enumerate(self.command_splines):
            mine = self.run == number
            out[mine] = curve(self.since[mine] - delay, derivative_order)
        return out

    def build_design_matrix(
        self, delay: float, model_drive: PositionDrive, nuisance_names: Sequence[str]
    ) -> Array:
        """(R, 2 + k) torque per stiffness, per damper, and of what else is fitted."""
        rate = self.interpolate_command(delay, 1)
        speed = (
            -self.qd if SPEED_FEEDFORWARD in nuisance_names else model_drive.ahead * rate - self.qd
        )
        more = {SPEED_FEEDFORWARD: rate, ROTOR_INERTIA: -self.qdd, COULOMB_FRICTION: -self.sense}
        return np.stack(
            [
                self.interpolate_command(delay) - self.q,
                speed,
                *(more[name] for name in nuisance_names),
            ],
            axis=1,
        )

    def compute_residuals(
        self, drive: PositionDrive, nuisance_values: Mapping[str, float]
    ) -> Array:
        """(R,) torque that a drive, and what was fitted beside it, do not explain."""
        value = [drive.stiffness, drive.damper, *nuisance_values.values()]
        return (
            self.torque
            - self.build_design_matrix(drive.delay, drive, list(nuisance_values)) @ value
        )


def fit_gains_and_delay(
    rows: DriveRows, model_drive: PositionDrive, nuisance_names: Sequence[str]
) -> DriveFit:
    """Gains and delay by least squares, with what is fitted beside them."""

    def linear(late: float) -> tuple[Array, Array, float]:
        matrix = rows.build_design_matrix(late, model_drive, nuisance_names)
        value = np.linalg.lstsq(matrix, rows.torque, rcond=None)[0]
        return matrix, value, float(((rows.torque - matrix @ value) ** 2).sum())

    late = min(
        np.arange(0.0, MAX_COMMAND_DELAY, COMMAND_DELAY_STEP), key=lambda one: linear(one)[2]
    )
    ahead = (
        2 + list(nuisance_names).index(SPEED_FEEDFORWARD)
        if SPEED_FEEDFORWARD in nuisance_names
        else -1
    )
    for _ in range(MAX_DRIVE_FIT_STEPS):
        matrix, value, _ = linear(late)
        speed = value[ahead] if ahead > 0 else value[1] * model_drive.ahead
        by_time = -value[0] * rows.interpolate_command(late, 1) - speed * rows.interpolate_command(
            late, 2
        )
        whole = np.column_stack([matrix, by_time])
        rest = rows.torque - matrix @ value
        step = float(
            np.clip(
                np.linalg.lstsq(whole, rest, rcond=None)[0][-1],
                -COMMAND_DELAY_STEP,
                COMMAND_DELAY_STEP,
            )
        )
        late = float(np.clip(late + step, -MAX_COMMAND_DELAY, MAX_COMMAND_DELAY))
        if abs(step) < MIN_DELAY_STEP:
            break
    change = compute_jackknife_changes(whole, rest, rows.stretch_numbers)
    own = np.zeros((len(change), len(FITTED_DRIVE_FIELDS)))
    own[:, [0, 1, 3]] = change[:, [0, 1, -1]]
    share = model_drive.ahead
    if ahead > 0:
        share = float(value[ahead] / value[1])
        own[:, 2] = (change[:, ahead] - share * change[:, 1]) / value[1]
    drive = replace(model_drive, stiffness=float(value[0]), damper=float(value[1]), ahead=share,
                    delay=late)  # fmt: skip
    return DriveFit(drive, np.hstack([own, change[:, 2:-1]]), np.unique(rows.stretch_numbers),
                    dict(zip(nuisance_names, value[2:].tolist(), strict=True)))  # fmt: skip


def jackknife_covariance(leave_one_out_changes: Array) -> Array:
    """(p, p) of numbers that change so (G, p) without each stretch [jackknife]."""
    return (
        (len(leave_one_out_changes) - 1.0)
        / len(leave_one_out_changes)
        * leave_one_out_changes.T
        @ leave_one_out_changes
    )


def compute_jackknife_changes(matrix: Array, residuals: Array, stretch_numbers: Array) -> Array:
    """(G, p) change of a solution without each stretch of rows, to first order.

    Wider by as much as Student's t is than the normal law, at 95 %, for as few stretches as tell of
    a number where rows err alike [Satterthwaite 1946].
    """
    scale = np.sqrt((matrix**2).sum(axis=0)) + 1e-300
    matrix = matrix / scale
    whole, out, tells = matrix.T @ matrix, [], []
    for one in np.unique(stretch_numbers):
        part = matrix[stretch_numbers == one]
        less = whole - part.T @ part
        told = np.linalg.lstsq(less, part.T, rcond=1e-12)[0]
        out.append(-told @ residuals[stretch_numbers == one] / scale)
        tells.append((told**2).sum(axis=1))
    share = np.array(tells) / np.sum(tells, axis=0)
    few = np.clip(1.0 / (share**2).sum(axis=0), 2.0, None)
    wider = scipy.special.stdtrit(few, 0.975) / scipy.special.ndtri(0.975)
    return np.asarray(np.array(out) * wider)


def fit_drive(
    learning_runs: CommandedRuns,
    held_out_runs: CommandedRuns,
    joint_index: int,
    model_drive: PositionDrive,
) -> DriveFit | None:
    """The drive of a joint by its logs; None where these hold too few rows clear of limits.

    held_out_runs: runs that are held out.  model_drive: the drive of the model.
    """
    seen = learning_runs.build_joint_samples(joint_index, model_drive)
    torque, speed = (
        MIN_SHARE_NEAR_LIMIT * float(np.abs(one).max()) for one in (seen.torque, seen.speed)
    )
    rows = learning_runs.select_rows_below_limits(joint_index, torque, speed)
    for _ in range(2):  # clear of what may be a limit, then of what is one
        if (
            len(np.unique(rows.stretch_numbers)) < 2 * MIN_STRETCHES_AT_LIMIT
            or np.abs(rows.qd).max() < MAX_REST_SPEED
        ):
            return None
        # No more beside the drive than is there for sure, and predicts rows held out.
        held = held_out_runs.select_rows_below_limits(joint_index, torque, speed)
        found = fit_gains_and_delay(
            rows, model_drive, [SPEED_FEEDFORWARD, ROTOR_INERTIA, COULOMB_FRICTION]
        )
        for name in (COULOMB_FRICTION, ROTOR_INERTIA, SPEED_FEEDFORWARD):
            if name in learning_runs.required_nuisances:
                continue
            at, off = 2, found.drive.ahead - model_drive.ahead
            if name != SPEED_FEEDFORWARD:
                at, off = (
                    len(FITTED_DRIVE_FIELDS) + list(found.nuisance_values).index(name),
                    found.nuisance_values[name],
                )
            sure = abs(off) > MIN_SIGNIFICANT_SIGMAS * float(
                np.sqrt(jackknife_covariance(found.jackknife_changes)[at, at])
            )
            less = fit_gains_and_delay(
                rows, model_drive, [one for one in found.nuisance_values if one != name]
            )
            if not (
                sure
                and has_smaller_held_out_residuals(
                    held, found.compute_residuals(held), less.compute_residuals(held)
                )
            ):
                found = less
        seen = learning_runs.build_joint_samples(joint_index, found.drive)
        torque, slack = find_torque_limit(seen) if learning_runs.has_torques else UNLIMITED
        speed, off = find_speed_limit(seen, torque) if learning_runs.has_torques else UNLIMITED
        rows = learning_runs.select_rows_below_limits(
            joint_index, MAX_SHARE_CLEAR_OF_LIMIT * torque, MIN_SHARE_NEAR_LIMIT * speed
        )
    fitted, sigma = found.drive, found.sigma_by_field
    if not (fitted.stiffness > MIN_SIGNIFICANT_SIGMAS * sigma["stiffness"]
            and fitted.damper > -MIN_SIGNIFICANT_SIGMAS * sigma["damper"]):  # fmt: skip
        return None
    limit = model_drive.torque if not np.isfinite(torque) else torque
    if (
        learning_runs.has_torques
        and np.quantile(np.abs(seen.torque), 0.999) > MIN_DEMAND_OVER_LIMIT * limit
    ):
        limit = float(np.abs(seen.torque).max())
    drive = replace(fitted, damper=max(fitted.damper, 0.0), torque=float(limit),
                    speed=float(min(speed, model_drive.speed)))  # fmt: skip
    return replace(found, drive=drive, limit_sigmas=(slack, off))


def find_torque_limit(samples: DriveSamples) -> tuple[float, float]:
    """A torque that is not exceeded where more is asked for, and its deviation [N m].

    Infinite where there is none.
    """
    size, noise = np.abs(samples.torque), samples.noise_sigma
    limit = float(np.quantile(size, 1.0 - MIN_ROWS_AT_LIMIT / len(size)))
    for _ in range(MAX_DRIVE_FIT_STEPS):
        at_limit = (
            np.abs(samples.demanded_torque)
            > MIN_DEMAND_OVER_LIMIT * limit + MIN_SIGNIFICANT_SIGMAS * noise
        ) & (size > MIN_SHARE_NEAR_LIMIT * limit)
        at_limit &= samples.torque * samples.demanded_torque > 0.0
        if not has_enough_rows_and_stretches(at_limit, samples.stretch_numbers):
            return UNLIMITED
        before, limit = limit, float(np.median(size[at_limit]))
        if limit == before:
            break
    spread = float(np.std(size[at_limit])) + 1e-300
    if spread > (MIN_DEMAND_OVER_LIMIT - 1.0) * limit + MIN_SIGNIFICANT_SIGMAS * noise:
        return UNLIMITED
    return limit, spread / math.sqrt(len(np.unique(samples.stretch_numbers[at_limit])))


def find_speed_limit(samples: DriveSamples, torque_limit: float) -> tuple[float, float]:
    """A speed near which torque falls below what the drive asks for, and its deviation."""
    asked = np.clip(samples.demanded_torque, -torque_limit, torque_limit)
    slack = MIN_SIGNIFICANT_SIGMAS * samples.noise_sigma + (MIN_DEMAND_OVER_LIMIT - 1.0) * float(
        np.abs(samples.torque).max()
    )
    size = np.abs(samples.speed)
    at_limit = np.sign(samples.speed) * (asked - samples.torque) > slack
    at_limit &= size > MIN_SHARE_NEAR_LIMIT * size.max()
    if not has_enough_rows_and_stretches(at_limit, samples.stretch_numbers):
        return UNLIMITED
    count = len(np.unique(samples.stretch_numbers[at_limit]))
    return float(np.median(size[at_limit])), float(np.std(size[at_limit])) / math.sqrt(count)


def has_enough_rows_and_stretches(is_at_limit: Array, stretch_numbers: Array) -> bool:
    """Whether rows are enough, in enough stretches of time, to be a limit."""
    return (
        int(is_at_limit.sum()) >= MIN_ROWS_AT_LIMIT
        and len(np.unique(stretch_numbers[is_at_limit])) >= MIN_STRETCHES_AT_LIMIT
    )


def has_smaller_held_out_residuals(
    rows: DriveRows | DriveSamples, residuals: Array, reference_residuals: Array
) -> bool:
    """Whether less is left of rows held out (R,), stretch by stretch, than before (R,)."""
    index = np.unique(rows.stretch_numbers, return_inverse=True)[1].reshape(-1)
    squares = (np.bincount(index, one**2) + 1e-300 for one in (reference_residuals, residuals))
    gain = np.subtract(*map(np.log, squares))
    return (
        len(gain) >= MIN_STRETCHES_AT_LIMIT
        and mean_over_standard_error(gain) > MIN_PREDICTION_GAIN_SIGMAS
    )


def is_drive_effect_confirmed(
    effect: str,
    fit: DriveFit,
    model_drive: PositionDrive,
    held_out_runs: CommandedRuns,
    joint_index: int,
    min_delay: float,
) -> bool:
    """Whether an effect of a drive is surely not the model's, and shows in runs held out.

    min_delay: shortest delay [s].
    """
    drive, sigma = fit.drive, fit.sigma_by_field
    off = {
        name: abs(getattr(drive, name) - getattr(model_drive, name))
        for name in DRIVE_EFFECT_UNITS[effect]
        if getattr(drive, name) != getattr(model_drive, name)
    }
    if not any(size > MIN_SIGNIFICANT_SIGMAS * sigma[name] for name, size in off.items()):
        return False
    seen = held_out_runs.build_joint_samples(joint_index, drive)
    if effect == SPEED_LIMIT_EFFECT:
        return bool(np.isfinite(find_speed_limit(seen, drive.torque)[0]))
    if effect == TORQUE_LIMIT_EFFECT:
        ends = (
            seen.torque - np.clip(seen.demanded_torque, -d.torque, d.torque)
            for d in (drive, model_drive)
        )
        return has_smaller_held_out_residuals(seen, *ends)
    if effect == COMMAND_DELAY_EFFECT and off["delay"] < min_delay:
        return False
    rows = held_out_runs.select_rows_below_limits(
        joint_index, MAX_SHARE_CLEAR_OF_LIMIT * drive.torque, MIN_SHARE_NEAR_LIMIT * drive.speed
    )
    ends = (
        rows.compute_residuals(one, fit.values_outside_drive)
        for one in (drive, drive.with_effect_of(model_drive, effect))
    )
    return has_smaller_held_out_residuals(rows, *ends)
