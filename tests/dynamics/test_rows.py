"""Rows of a log: filters, rows that are not fitted, and noise that remembers."""

from __future__ import annotations

import numpy as np
import pytest
from dynamics.motions import fourier, run_of
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import butter, sosfilt, sosfilt_zi

from minimax_cal.core.arrays import Array
from minimax_cal.dynamics.torque_rows import (
    ALWAYS_FITTED_FOLD,
    AUTOREGRESSIVE_ORDER,
    FILTER_CUTOFF_HZ,
    FILTER_ORDER,
    ROW_RATE_HZ,
    UNUSED_EDGE_DURATION,
    apply_zero_phase_filter,
    differentiate_in_time,
    estimate_autoregressive_whitening,
    resample_and_filter_runs,
)


def log(seed: int = 0, rate: float = 125.0, seconds: float = 30.0, uneven: float = 0.0):  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 1.0 / rate)
    time = time + uneven / rate * rng.uniform(size=len(time))
    q, qd, qdd = fourier(rng, time, 3)
    return run_of(f"run{seed}", time, q, 3.0 * qdd + qd), time, (q, qd, qdd)


@pytest.mark.parametrize(("rate", "uneven"), [(125.0, 0.4), (500.0, 0.0), (60.0, 0.2)])
def test_derivatives_and_torques_are_filtered_alike(rate: float, uneven: float) -> None:
    """What is linear in the motion stays so to far below the noise of any motor."""
    run, *_ = log(1, rate, uneven=uneven)
    logs = resample_and_filter_runs([run])
    inner = ~logs.gap[logs.row_samples]
    fitted = logs.filter_to_rows(3.0 * logs.motion.qdd + logs.motion.qd)
    assert_allclose(
        logs.row_torques[inner], fitted[inner], rtol=0, atol=2e-3 * np.abs(logs.row_torques).max()
    )
    assert logs.total_duration == pytest.approx(30.0, abs=0.1)
    assert len(logs.row_samples) == pytest.approx(30.0 * ROW_RATE_HZ, abs=2)


@pytest.mark.parametrize("rate", [100.0, 1000.0])
@pytest.mark.parametrize("samples", [3, 2000])
def test_smooth_is_a_butterworth_filter_forwards_and_backwards(rate: float, samples: int) -> None:
    values = np.cumsum(np.random.default_rng(0).normal(size=(samples, 2)), axis=0)
    sections = butter(FILTER_ORDER, FILTER_CUTOFF_HZ, fs=rate, output="sos")
    pad = min(samples - 1, int(rate))
    wide = np.pad(values, ((pad, pad), (0, 0)), mode="reflect", reflect_type="odd").T
    for _ in range(2):
        state = sosfilt_zi(sections)[:, None, :] * wide[:, :1]
        wide = sosfilt(sections, wide, zi=state)[0][:, ::-1]
    assert_allclose(
        apply_zero_phase_filter(values, rate), wide.T[pad : pad + samples], rtol=0, atol=1e-10
    )


def test_slope_is_exact_for_cubics() -> None:
    t = np.linspace(0.0, 1.0, 101)
    cubic = t**3 - t**2
    assert_allclose(
        differentiate_in_time(cubic, 100.0)[2:-2], (3 * t**2 - 2 * t)[2:-2], rtol=0, atol=1e-11
    )


def test_rows_at_rest_near_reversals_and_gaps_are_not_fitted() -> None:
    run, time, (q, qd, _) = log(2)
    hold = (time > 10.0) & (time < 12.0)
    q[hold] = q[np.argmax(hold)]  # a jump at its end, which is far from both sides
    cut = (time < 20.0) | (time > 20.5)
    logs = resample_and_filter_runs([run_of("one", time[cut], q[cut], run.torque[cut])])
    at = logs.since[logs.row_samples]
    assert not logs.is_row_moving[(at > 10.3) & (at < 11.7)].any()
    assert not logs.fitted_row_mask_by_joint[
        (at > 20.0 - UNUSED_EDGE_DURATION + 0.02) & (at < 20.5 + UNUSED_EDGE_DURATION - 0.02)
    ].any()
    speed = np.stack([np.interp(at, time, column) for column in qd.T], axis=1)
    flips = np.diff(np.sign(speed), axis=0) != 0
    assert not (logs.is_row_moving[1:] & flips)[at[1:] < 9.0].any()
    near = np.abs(at[:, None] - at[1:][flips[:, 1] & (at[1:] < 9.0)]).min(axis=1)
    assert (
        near[logs.fitted_row_mask_by_joint[:, 1] & (at < 9.0)].min() > 0.15 - 0.04
    )  # a row of 25 Hz apart at most
    assert near[logs.is_row_moving[:, 1] & (at < 9.0)].min() < 0.14  # but counted as moving
    assert logs.fitted_row_mask_by_joint[at < 9.0].mean() > 0.25
    assert not logs.fitted_row_mask_by_joint[1::2].any()


def test_runs_stand_one_after_another() -> None:
    first, second = (log(seed)[0] for seed in (3, 4))
    both, alone = resample_and_filter_runs([first, second]), resample_and_filter_runs([second])
    assert (np.bincount(both.quarter_index) > 150).all()
    assert both.quarter_index.max() == 7
    mine = both.select_runs([1])
    for found in (mine.row_torques, both.row_torques[both.run_index == 1]):
        assert_allclose(found, alone.row_torques, rtol=0, atol=1e-12)
    assert (mine.is_row_moving == alone.is_row_moving).all()
    assert mine.names == ("run4",)


def test_folds_are_whole_runs_and_quarters_of_a_single_one() -> None:
    logs = resample_and_filter_runs([log(seed)[0] for seed in (3, 4, 5)])
    assert_array_equal(logs.split_rows_into_folds(0.5), logs.run_index % 2)
    assert_array_equal(logs.split_rows_into_folds(0.2), logs.run_index)
    named = logs.split_rows_into_folds(0.2, [logs.names[1]])
    assert_array_equal(named, np.where(logs.run_index == 1, 0, ALWAYS_FITTED_FOLD))
    alone = logs.select_runs([2])
    assert_array_equal(alone.split_rows_into_folds(0.2), alone.quarter_index)


def remembering(rng: np.random.Generator, count: int) -> Array:
    """Autoregressive noise whose innovations have unit variance."""
    out, new = np.zeros(count), rng.normal(size=count)
    for i in range(2, count):
        out[i] = 1.2 * out[i - 1] - 0.5 * out[i - 2] + new[i]
    return out


def test_noise_is_white_after_whitening_across_gaps_too() -> None:
    logs = resample_and_filter_runs([log(seed, seconds=120.0)[0] for seed in (5, 6)])
    rng = np.random.default_rng(7)
    size = np.array([0.5, 2.0, 7.0])
    noise = np.zeros((3, len(logs.row_samples)))
    for run in range(2):  # as the rows that are fitted remember each other
        rows = np.flatnonzero(logs.run_index == run)[::2]
        noise[:, rows] = np.stack([remembering(rng, len(rows)) for _ in size]) * size[:, None]
    rest = noise[logs.fitted_row_mask_by_joint.T]
    white = estimate_autoregressive_whitening(logs, rest)
    out = white.whiten_rows(rest)
    for j in range(3):
        mine, place = out[white.joint_index == j], white.previous_row_counts[white.joint_index == j]
        assert mine.std() == pytest.approx(1.0, abs=0.06)
        for lag in (1, 2, 3):
            here = np.flatnonzero(place >= lag)
            assert abs((mine[here] * mine[here - lag]).mean()) < 4.0 / np.sqrt(len(here))
        for order in range(
            AUTOREGRESSIVE_ORDER
        ):  # after a gap rows are no noisier, however few went before
            assert mine[place == order].std() == pytest.approx(1.0, abs=0.25)
        assert_allclose(white.predictor_weights[j, 4, :2], [1.2, -0.5], atol=0.08)
    columns = np.stack([rest, 2.0 * rest], axis=1)
    assert_allclose(white.whiten_rows(columns), np.stack([out, 2.0 * out], axis=1), rtol=1e-12)


def test_computed_torques_have_a_noise() -> None:
    run, *_ = log(8)
    logs = resample_and_filter_runs([run])
    white = estimate_autoregressive_whitening(
        logs, np.zeros(int(logs.fitted_row_mask_by_joint.sum()))
    )
    assert np.isfinite(white.predictor_weights).all()
