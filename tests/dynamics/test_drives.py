"""Drives by their commands: numbers by which a log was made come back, in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minimax_cal.dynamics.drives import (
    CommandedRuns,
    DriveFit,
    PositionDrive,
    compute_jackknife_changes,
    find_speed_limit,
    find_torque_limit,
    fit_drive,
    has_smaller_held_out_residuals,
    jackknife_covariance,
)
from minimax_cal.dynamics.logs.log_table import TORQUE_UNIT, Run
from minimax_cal.dynamics.torque_rows import TorqueArm, resample_and_filter_runs
from tests.dynamics.motions import three_joints

HZ, SECONDS, NOISE = 250.0, 12.0, 0.2
REAL = PositionDrive(2000.0, 90.0, delay=0.0123)
GIVEN = PositionDrive(1500.0, 120.0)


def waves(time: np.ndarray, seed: int, order: int = 0) -> np.ndarray:
    """(m, 3) commands, sums of four waves, or their derivative."""
    rng = np.random.default_rng(seed)
    rate = 2.0 * np.pi * np.array([0.13, 0.31, 0.53, 0.89])
    size, phase = 0.5 / rate[:, None] * rng.normal(size=(4, 3)), rng.uniform(0.0, 6.28, (4, 3))
    turn = time[:, None, None] * rate[:, None] + phase + 0.5 * np.pi * order
    return (rate[:, None] ** order * size * np.sin(turn)).sum(axis=1)


def logged(seed: int, drive: PositionDrive, lag: float = 0.03, speed: float = 1.0) -> Run:
    """A joint lags its command and trembles; its drive pushes as the closed form says."""
    time = np.arange(0.0, SECONDS, 1.0 / HZ)
    rng = np.random.default_rng(seed + 100)
    at = speed * time
    off = 0.02 * waves(1.7 * at, seed + 50)
    q = waves(at - speed * lag, seed) + off
    qd = speed * (waves(at - speed * lag, seed, 1) + 0.02 * 1.7 * waves(1.7 * at, seed + 50, 1))
    late = at - speed * drive.delay
    asked = drive.stiffness * (waves(late, seed) - q)
    asked -= drive.damper * (qd - drive.ahead * speed * waves(late, seed, 1))
    torque = np.clip(asked, -drive.torque, drive.torque) + NOISE * rng.normal(size=q.shape)
    return Run(
        f"r{seed}", "log.csv", time, q, qd, None, torque, TORQUE_UNIT, command=waves(at, seed)
    )


def followed(*runs: Run) -> CommandedRuns:
    robot = three_joints()
    arm = TorqueArm.build(
        robot, np.ones(3), robot.ratio, np.zeros(10), resample_and_filter_runs(runs)
    )
    return CommandedRuns.build(runs, arm, lambda motion: 0.0 * motion.q)


def fit(
    drive: PositionDrive, given: PositionDrive = GIVEN, seed: int = 0, **more: float
) -> DriveFit:
    runs = [logged(seed + k, drive, **more) for k in range(4)]
    found = fit_drive(followed(*runs[:3]), followed(runs[3]), 1, given)
    assert found is not None
    return found


def test_gains_and_delay_come_back_between_the_steps_of_the_log():
    found = fit(REAL)
    assert_allclose([found.drive.stiffness, found.drive.damper], [2000.0, 90.0], rtol=2e-3)
    assert found.drive.delay == pytest.approx(REAL.delay, abs=1e-4)
    assert found.drive.ahead == 0.0
    assert np.isinf([found.drive.torque, found.drive.speed]).all()


def test_the_share_of_the_commanded_speed_comes_back():
    found = fit(replace(REAL, ahead=0.8))
    assert found.drive.ahead == pytest.approx(0.8, abs=0.03)
    assert found.drive.delay == pytest.approx(REAL.delay, abs=1e-3)


def test_speeds_that_were_not_logged_may_be_of_another_time():
    """A speed half a step old, as a simulator's is beside its joint values, is no other damper."""
    runs = []
    for k in range(4):
        run = logged(k, replace(REAL, damper=0.0))
        old = np.interp(run.time - 0.002, run.time, run.qd[:, 1])
        torque = run.torque - REAL.damper * np.stack([old] * 3, axis=1)
        runs.append(replace(run, qd=None, torque=torque))
    found = fit_drive(followed(*runs[:3]), followed(runs[3]), 1, GIVEN)
    assert found.drive.damper == pytest.approx(REAL.damper, rel=0.01)
    assert found.drive.delay == pytest.approx(REAL.delay, abs=2e-4)


def test_intervals_hold_under_noise_that_remembers():
    """Of 24 logs with noise of first order, about 0.1 s long, 95 % intervals hold 88 to 100 %."""
    inside = []
    for seed in range(24):
        runs = []
        for k in range(4):
            run = logged(seed * 10 + k, REAL)
            rng, noise = np.random.default_rng([seed, k]), np.zeros(run.q.shape)
            for i in range(1, len(noise)):
                noise[i] = 0.96 * noise[i - 1] + 0.5 * rng.normal(size=3)
            runs.append(replace(run, torque=run.torque + noise))
        found = fit_drive(followed(*runs[:3]), followed(runs[3]), 1, GIVEN)
        inside += [
            abs(getattr(found.drive, name) - getattr(REAL, name))
            < 1.96 * found.sigma_by_field[name]
            for name in ("stiffness", "damper", "delay")
        ]
    assert 0.88 < np.mean(inside) <= 1.0


def test_intervals_hold_where_few_stretches_tell():
    rng, stretch = np.random.default_rng(5), np.repeat(np.arange(12), 40)
    speed = rng.normal(size=480) * np.where(stretch < 2, 10.0, 1.0)
    columns, inside = np.stack([speed, np.ones(480)], axis=1), []
    for _ in range(1000):
        noise = rng.normal(size=481)
        rest = noise[1:] + noise[:-1]  # remembers
        off = np.linalg.lstsq(columns, rest, rcond=None)[0]
        change = compute_jackknife_changes(columns, rest - columns @ off, stretch)
        inside.append(np.abs(off) < 1.96 * np.sqrt(np.diag(jackknife_covariance(change))))
    assert_allclose(np.mean(inside, axis=0), 0.95, atol=0.03)


def test_rows_at_a_torque_limit_are_a_limit_and_not_a_gain():
    found = fit(replace(REAL, torque=25.0))
    assert found.drive.torque == pytest.approx(25.0, rel=0.01)
    assert_allclose([found.drive.stiffness, found.drive.damper], [2000.0, 90.0], rtol=0.02)


def test_a_speed_at_which_torque_falls_is_a_limit():
    runs, top = [logged(k, REAL) for k in range(4)], 0.7
    slowed = [replace(run, torque=np.where(np.abs(run.qd) > top * np.abs(run.qd).max(axis=0),
                                           run.torque - 60.0 * np.sign(run.qd), run.torque))
              for run in runs]  # fmt: skip
    seen = followed(*slowed).build_joint_samples(1, REAL)
    assert np.isinf(find_speed_limit(followed(*runs).build_joint_samples(1, REAL), np.inf)[0])
    fastest = np.abs(seen.speed).max()
    assert 0.9 * fastest < find_speed_limit(seen, np.inf)[0] < fastest
    assert np.isinf(find_torque_limit(seen)[0])


def test_a_joint_without_motion_tells_nothing():
    runs = [replace(one, q=0.0 * one.q, qd=0.0 * one.q, command=0.0 * one.q)
            for one in (logged(k, REAL) for k in range(4))]  # fmt: skip
    assert fit_drive(followed(*runs[:3]), followed(runs[3]), 1, GIVEN) is None


def test_stretches_decide_whether_rows_are_predicted_better():
    rows = followed(logged(0, REAL)).build_joint_rows(1)
    rest, rng = rows.compute_residuals(REAL, {}), np.random.default_rng(0)
    assert has_smaller_held_out_residuals(rows, rest, rows.compute_residuals(GIVEN, {}))
    assert not has_smaller_held_out_residuals(rows, rest, rest + 1e-6 * rng.normal(size=rest.shape))
