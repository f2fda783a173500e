"""What is left of the torques when all that has a name is taken out, and what it follows.

A probe is a set of functions of one driver, at the rows that are fitted.  Its size is what it
foretells of rows that its fit does not see: no number of functions makes it large, and noise that
remembers, or that was taken for more than it is, does not make it small.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import stdtr

from minimax_cal.core.arrays import Array
from minimax_cal.core.linear_algebra import project_out
from minimax_cal.dynamics.torque_regression import TorqueRegression
from minimax_cal.dynamics.torque_rows import (
    FILTER_CUTOFF_HZ,
    FILTER_ORDER,
    SAMPLE_RATE_HZ,
    ArmMotion,
)
from minimax_cal.selection.noise_model import orthonormal_basis

FALSE_STRUCTURE_PROBABILITY = (
    0.02  # chance that noise alone is called structure, of all probes at all joints, at most:
)
# what noise foretells of rows left out is below 0 on average
MIN_PROBE_DIRECTION_SIZE = (
    1e-4  # of a probe's largest direction beside the model: smaller ones are no test
)
BUMP_COUNT = 5  # smooth steps over the range of a driver
MAX_ANGLE_WAVES_PER_TURN = (
    4  # a turn of a joint that angle alone is tried by; more are those of gears
)
MAX_GEAR_WAVES_PER_TURN, GEAR_WAVE_COUNT = (
    60.0,
    28,
)  # waves a turn of a gear that are tried at most, and how many of them
EXPLAINED_SQUARE_SHARES = (
    1.0,
    0.1,
    0.01,
)  # of the remaining error's square, that a probe may explain
TIME_FOLD_STRETCH_DURATION, TIME_FOLD_COUNT = (
    1.0,
    8,
)  # length of stretches that are left out together, every eighth [s]
TIME_DRIVER = "time"
MOTION_AVERAGING_TIMES = (0.5, 2.0, 8.0)  # over which motion that went before is averaged [s]
ACCELERATION_LAGS = (0.1, 0.2, 0.3, 0.45, 0.6, 0.8)  # by which accelerations went before [s]
PLAY_RANGE_SHARES = (0.03, 0.1, 0.3)  # of a joint's range: ways over which a spring lags the angle


@dataclass(frozen=True)
class Unexplained:
    """Torque without a name.  size: RMS that its driver foretells of rows left out, and noise: that
    of the whole remaining error, both of the rows that are fitted [unit of the log].  share: of its
    square.
    """

    place: str
    follows: str
    size: float
    noise: float
    share: float
    p: float

    def describe_structure(self, log_unit: str) -> str:
        """For people, without its full stop.  log_unit: of the log."""
        size = f"{self.size:.3g} {log_unit}"
        return f"{size} at {self.place} follow the {self.follows} and have no name"


# ---- what drivers are functions of ---------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class DriverInputs:
    """What a scene knows of some rows, for one joint.

    scene: of all samples.  joint_index: from 0.  sample_indices: (k,) samples.  motion_history:
    what all joints did before. q, qd, qdd, speed_signs: (k, n) of the joints.
    relative_load_torques: (k, n) torques that the body puts on them, over the largest.
    """

    scene: ArmMotion
    joint_index: int
    sample_indices: Array
    motion_history: MotionHistory
    q: Array
    qd: Array
    qdd: Array
    speed_signs: Array
    relative_load_torques: Array

    @staticmethod
    def build(
        scene: ArmMotion, joint_index: int, sample_indices: Array, motion_history: MotionHistory
    ) -> DriverInputs:
        """With what joints do there."""
        motion, load = scene.logs.motion.select_samples(sample_indices), scene.load_torque
        size = np.maximum(np.abs(load).max(axis=0), 1e-12)
        return DriverInputs(
            scene,
            joint_index,
            sample_indices,
            motion_history,
            motion.q,
            motion.qd,
            motion.qdd,
            scene.speed_sign[sample_indices],
            load[sample_indices] / size,
        )

    @property
    def joint_speed_sign(self) -> Array:
        """(k,) of the joint."""
        return self.speed_signs[:, self.joint_index]

    @property
    def joint_speed(self) -> Array:
        """(k,) of the joint."""
        return self.qd[:, self.joint_index]

    def with_speed_sign_products(self, columns: list[Array]) -> list[Array]:
        """Columns alone and with the direction."""
        return [f for one in columns for f in (one, one * self.joint_speed_sign)]

    @property
    def other_joint_indices(self) -> list[int]:
        """The other joints."""
        return [k for k in range(self.q.shape[1]) if k != self.joint_index]


@dataclass(frozen=True, eq=False)
class MotionHistory:
    """What joints did before: (M, n, d) at every sample.

    recent_speed_averages: averages of the speed's size and of the angle.  play_positions: where a
    spring with play is.
    """

    recent_speed_averages: Array
    play_positions: Array

    @staticmethod
    def build(scene: ArmMotion) -> MotionHistory:
        """Of every run for itself."""
        q, qd = scene.logs.motion.q, scene.logs.motion.qd
        recent = np.empty((*q.shape, len(MOTION_AVERAGING_TIMES)))
        lagged = np.empty((*q.shape, len(PLAY_RANGE_SHARES)))
        way = np.maximum(np.ptp(q, axis=0), 1e-12)[:, None] * np.array(PLAY_RANGE_SHARES)
        stays = np.exp(-1.0 / SAMPLE_RATE_HZ / np.array(MOTION_AVERAGING_TIMES))
        for run in scene.logs.run_slices:
            now, average = np.zeros_like(way), np.zeros((q.shape[1], len(MOTION_AVERAGING_TIMES)))
            step = np.diff(q[run], axis=0, prepend=q[run][:1])[:, :, None]
            new = np.abs(qd[run, :, None]) * (1.0 - stays)
            for i in range(len(new)):
                now = np.clip(now + step[i], -way, way)
                average = stays * average + new[i]
                lagged[run.start + i], recent[run.start + i] = now, average
        return MotionHistory(recent, lagged / way)


# ---- drivers -------------------------------------------------------------------------------------


def build_waves(angles: Array, waves_per_turn: Array) -> list[Array]:
    """Cosines and sines of an angle (k,), so many a turn."""
    return [f(k * angles) for k in waves_per_turn for f in (np.cos, np.sin)]


def build_bumps_over_range(driver_values: Array) -> list[Array]:
    """Smooth bumps over the range of a driver (k,)."""
    low, high = np.quantile(driver_values, [0.02, 0.98])
    width = max(float(high - low), 1e-12) / BUMP_COUNT
    return build_bumps_at_integers((driver_values - low) / width)


def build_bumps_at_integers(scaled_driver_values: Array) -> list[Array]:
    """Smooth bumps about 0, 1, ... BUMPS."""
    return [np.exp(-((scaled_driver_values - k) ** 2)) for k in range(BUMP_COUNT + 1)]


def build_own_angle_probes(inputs: DriverInputs) -> list[Array]:
    """The joint's own angle, alone and with the direction."""
    q = inputs.q[:, inputs.joint_index]
    if inputs.scene.arm.robot.prismatic[inputs.joint_index]:
        return inputs.with_speed_sign_products(build_bumps_over_range(q))
    slow = build_waves(q, np.arange(1.0, MAX_ANGLE_WAVES_PER_TURN + 1.0))
    return [*slow, *(wave * inputs.joint_speed_sign for wave in slow[:4])]


def build_fine_angle_wave_functions(inputs: DriverInputs) -> list[Array]:
    """Waves of the angle as gears and motors have them, less what the filter takes."""
    q, qd = inputs.q[:, inputs.joint_index], inputs.joint_speed
    far = max(float(np.ptp(q)), 1e-12)
    first = (
        MAX_ANGLE_WAVES_PER_TURN + 1.0
        if not inputs.scene.arm.robot.prismatic[inputs.joint_index]
        else np.pi / far
    )
    counts = first + np.arange(GEAR_WAVE_COUNT) * max(
        np.pi / far, (MAX_GEAR_WAVES_PER_TURN - first) / GEAR_WAVE_COUNT
    )
    out = []
    for k in counts:
        rate = k * np.abs(qd) / (2.0 * np.pi * FILTER_CUTOFF_HZ)
        out += [f / (1.0 + rate ** (2 * FILTER_ORDER)) for f in build_waves(q, np.array([k]))]
    return out


def build_speed_functions(inputs: DriverInputs) -> list[Array]:
    """The joint's speed, the same both ways."""
    return [b * inputs.joint_speed_sign for b in build_bumps_over_range(np.abs(inputs.joint_speed))]


def build_direction_functions(inputs: DriverInputs) -> list[Array]:
    """The joint's speed, otherwise one way than the other."""
    return build_bumps_over_range(np.abs(inputs.joint_speed))


def build_load_functions(inputs: DriverInputs) -> list[Array]:
    """The torque that the joint transmits, alone, with the direction and with the speed."""
    load, sense, v = (
        inputs.relative_load_torques[:, inputs.joint_index],
        inputs.joint_speed_sign,
        inputs.joint_speed,
    )
    size, square = np.abs(load), load**2
    return [load, size, square, load**3, size * sense, square * sense, size * v, square * v,
            load * sense]  # fmt: skip


def build_acceleration_functions(inputs: DriverInputs) -> list[Array]:
    """The joint's acceleration, its derivative, and accelerations that went before."""
    logs, j = inputs.scene.logs, inputs.joint_index
    qdd = inputs.qdd[:, j]
    first = logs.run_starts[logs.find_run_indices(inputs.sample_indices)]
    earlier = [
        logs.motion.qdd[np.maximum(inputs.sample_indices - int(s * SAMPLE_RATE_HZ), first), j]
        for s in ACCELERATION_LAGS
    ]
    return [
        qdd,
        np.abs(qdd),
        np.abs(qdd) * inputs.joint_speed_sign,
        logs.differentiate_each_run(logs.motion.qdd[:, j])[inputs.sample_indices],
        *earlier,
    ]


def build_other_joint_functions(inputs: DriverInputs) -> list[Array]:
    """Where the other joints are, alone and two together, how they move and what they transmit."""
    others = inputs.other_joint_indices
    alone = [
        f
        for k in others
        for f in (
            np.cos(inputs.q[:, k]),
            np.sin(inputs.q[:, k]),
            inputs.qd[:, k],
            inputs.qdd[:, k],
            inputs.speed_signs[:, k],
            inputs.relative_load_torques[:, k],
            np.abs(inputs.qd[:, k]),
        )
    ]
    sums = [inputs.q[:, a] + inputs.q[:, b] for a in others for b in others if a <= b]
    differences = [inputs.q[:, a] - inputs.q[:, b] for a in others for b in others if a < b]
    return [*alone, *(f(q) for q in (*sums, *differences) for f in (np.cos, np.sin))]


def build_other_joint_friction_functions(inputs: DriverInputs) -> list[Array]:
    """Friction and damping of this joint by what the other joints do."""
    sense, v = inputs.joint_speed_sign, inputs.joint_speed
    out = []
    for k in inputs.other_joint_indices:
        cos, sin = np.cos(inputs.q[:, k]), np.sin(inputs.q[:, k])
        out += [
            sense * cos,
            sense * sin,
            v * cos,
            v * sin,
            sense * inputs.relative_load_torques[:, k],
            sense * np.abs(inputs.relative_load_torques[:, k]),
            sense * inputs.speed_signs[:, k],
            v * inputs.qd[:, k],
            sense * np.abs(inputs.qd[:, k]),
        ]
    return out


def build_time_functions(inputs: DriverInputs) -> list[Array]:
    """The time since the run began, of every run for itself."""
    logs = inputs.scene.logs
    run = logs.find_run_indices(inputs.sample_indices)
    out = []
    for r in range(len(logs.names)):
        mine = run == r
        if mine.any():
            since = logs.since[inputs.sample_indices] / max(
                float(logs.since[inputs.sample_indices][mine].max()), 1e-9
            )
            out += [mine * hill for hill in build_bumps_at_integers(BUMP_COUNT * since)]
    return inputs.with_speed_sign_products(out)


def build_motion_history_functions(inputs: DriverInputs) -> list[Array]:
    """How far the joint is from where it last turned round, and how it moved before."""
    j, whole = inputs.joint_index, inputs.scene.distance_since_reversal[:, inputs.joint_index]
    way = whole[inputs.sample_indices] / max(float(whole.max()), 1e-12)
    faded = [np.exp(-way / length) for length in (0.02, 0.06, 0.2, 0.6)]
    recent = [*inputs.motion_history.recent_speed_averages[inputs.sample_indices, j].T]
    by_way = [f for b in faded for f in (b * inputs.joint_speed_sign, b * inputs.joint_speed)]
    return [
        *by_way,
        *inputs.with_speed_sign_products(recent),
        *inputs.motion_history.play_positions[inputs.sample_indices, j].T,
    ]


RESIDUAL_DRIVERS: dict[str, Callable[[DriverInputs], list[Array]]] = {
    "angle": build_own_angle_probes,
    "fine waves of the angle": build_fine_angle_wave_functions,
    "speed": build_speed_functions,
    "direction": build_direction_functions,
    "load": build_load_functions,
    "acceleration": build_acceleration_functions,
    "other joints": build_other_joint_functions,
    "other joints and the direction": build_other_joint_friction_functions,
    TIME_DRIVER: build_time_functions,
    "motion before": build_motion_history_functions,
}


# ---- the test ------------------------------------------------------------------------------------


def find_unexplained_torques(regression: TorqueRegression, values: Array) -> list[Unexplained]:
    """What the remaining error follows, at each joint the drivers whose p-value is low enough.

    values: (p,) of the fit, 0 where a column is not part of it.
    """
    scene, white = regression.columns.scene, regression.whitening
    plain, out, past = (
        regression.compute_unwhitened_residuals(values),
        list[Unexplained](),
        MotionHistory.build(scene),
    )
    for j in range(scene.logs.joint_count):
        mine, kept = white.joint_index == j, white.is_row_fitted[j]
        if np.count_nonzero(mine) < 10 * BUMP_COUNT:
            continue
        basis = orthonormal_basis(regression.unwhitened_design[j, kept][:, values != 0.0])
        left = project_out(plain[mine], basis)
        noise = float(np.sqrt(np.mean(plain[mine] ** 2)))
        moments = DriverInputs.build(scene, j, scene.logs.row_samples[kept], past)
        group = np.unique(regression.row_groups[mine], return_inverse=True)[1]
        for name, columns in RESIDUAL_DRIVERS.items():
            fold = group
            if (
                name == TIME_DRIVER
            ):  # stretches: what follows time is not foretold far from where it was
                fold = (
                    scene.logs.since[moments.sample_indices] / TIME_FOLD_STRETCH_DURATION
                ).astype(int) % TIME_FOLD_COUNT
            raw = np.stack(columns(moments), axis=1)
            share, p = predicted_share_and_p_value(
                project_out_model_and_normalise(basis, raw), left, fold, group
            )
            p = min(1.0, p * len(RESIDUAL_DRIVERS) * scene.logs.joint_count)
            if p < FALSE_STRUCTURE_PROBABILITY:
                size = noise * float(np.sqrt(share))
                out.append(Unexplained(f"J{j + 1}", name, size, noise, share, p))
    return sorted(out, key=lambda one: -one.share)


def project_out_model_and_normalise(model_basis: Array, probe_columns: Array) -> Array:
    """Columns (k, d) less what the model imitates, of unit size a row."""
    field = project_out(probe_columns, model_basis)
    size = np.sqrt(np.mean(field**2, axis=0))
    least = MIN_PROBE_DIRECTION_SIZE * np.sqrt(np.mean(probe_columns**2, axis=0)) + 1e-300
    return np.asarray(field / np.maximum(size, least))


class PredictedShare(NamedTuple):
    """Share of a squared error that a probe predicts in folds left out, and its p-value."""

    share: float
    p_value: float


def predicted_share_and_p_value(
    probe_columns: Array, residuals: Array, row_folds: Array, row_groups: Array
) -> PredictedShare:
    """Share of the square of the remaining error that a probe foretells in folds left out, p-value.

    The ridge is that of a probe that explains a part of the error, the part that foretells best.
    The p-value is Student's, of relative gains over groups, each between -1 and 1: no group counts
    for more than another.  probe_columns: (k, d).  residuals: (k,).  row_folds, row_groups: (k,)
    from 0.
    """
    d, found = probe_columns.shape[1], (-np.inf, 1.0)
    folds = [row_folds == f for f in np.unique(row_folds)]
    gram, pull = probe_columns.T @ probe_columns, probe_columns.T @ residuals
    parts = [
        (probe_columns[own].T @ probe_columns[own], probe_columns[own].T @ residuals[own])
        for own in folds
    ]
    before = np.bincount(row_groups, residuals**2)
    for part in EXPLAINED_SQUARE_SHARES:
        missed = residuals.copy()
        for own, (inner, toward) in zip(folds, parts, strict=True):
            value = np.linalg.solve(gram - inner + d / part * np.eye(d), pull - toward)
            missed[own] -= probe_columns[own] @ value
        after = np.bincount(row_groups, missed**2)
        share = 1.0 - float(after.sum()) / max(float(before.sum()), 1e-300)
        if share > found[0]:
            gain = (before - after) / np.maximum(np.maximum(before, after), 1e-300)
            count = len(gain)
            unsure = float(gain.std(ddof=1)) / np.sqrt(count) if count > 1 else np.inf
            found = share, float(stdtr(count - 1, -float(gain.mean()) / max(unsure, 1e-12)))
    return PredictedShare(*found)
