"""Base and targets of a fixed geometry: the global best, from whatever start it is looked for."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from minimax_cal.modelling import start
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.start import CUBE, Turning, fit_base
from minimax_cal.robots.kernels import plain


def test_the_only_minimum_is_the_best_of_many(rng):
    """Where one start is said to be enough, no other of 24 finds less."""
    alone = 0
    for noise in np.logspace(-4, 0, 40):
        truth = Rotation.random(rng=rng).as_matrix()
        matrix = rng.normal(size=(60, 9))
        right = matrix @ truth.reshape(9) + noise * rng.normal(size=60)
        turning = Turning(matrix, right)
        turn, cost = turning.best()
        guess = np.linalg.lstsq(matrix, right, rcond=1e-9)[0].reshape(3, 3)
        alone += turning.alone(turn, guess)
        _, costs = plain.polish(matrix, right, CUBE.copy())
        assert cost <= costs.min() * (1.0 + 1e-9)
    assert 5 < alone < 40


def test_a_mirrored_frame_fits_far_worse(robot, noisy):
    given = fit_base(model_of(robot, noisy.data), robot.mdh)
    left = noisy.data.with_y(noisy.data.y * [1.0, 1.0, -1.0])
    other = fit_base(model_of(robot, left), robot.mdh)
    assert other.mean_square > 100.0 * given.mean_square


def test_poses_in_parts_are_all_poses(robot, noisy, monkeypatch):
    y = noisy.data.y.copy()
    y[::4, 1] = np.nan
    model = model_of(robot, noisy.data.with_y(y))
    weight = model.weight * np.linspace(0.5, 2.0, len(model.q))
    model = replace(model, weight=weight)
    whole = fit_base(model, robot.mdh)
    monkeypatch.setattr(start, "CHUNK", 7)
    parts = fit_base(model, robot.mdh)
    assert_allclose(parts.state.base, whole.state.base, rtol=0, atol=1e-11)
    assert_allclose(parts.state.target_positions, whole.state.target_positions, rtol=0, atol=1e-11)
    assert parts.mean_square == pytest.approx(whole.mean_square, rel=1e-9)
