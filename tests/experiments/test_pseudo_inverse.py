"""Paper S to the letter, against the library and against differences."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments import off_starts, pseudo_inverse
from experiments.errata import some_arm
from experiments.off_starts import Setting
from experiments.pseudo_inverse import arm, joint_rows, least_step, separable_rows
from minimax_cal.robots.kinematics import forward
from minimax_cal.robots.robot import Robot

STEP = 1e-6  # of central differences: their error is about 1e-9 of the largest lever
NEAR = 2e-8
ANGLES = np.r_[12:30, 33:36]


def differences(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
    return np.array(
        [(function(at + h) - function(at - h)) / (2.0 * STEP) for h in STEP * np.eye(at.size)]
    )


def euler(phi: float, theta: float, psi: float) -> np.ndarray:
    c, s = np.cos, np.sin
    z = np.array([[c(phi), -s(phi), 0.0], [s(phi), c(phi), 0.0], [0.0, 0.0, 1.0]])
    y = np.array([[c(theta), 0.0, s(theta)], [0.0, 1.0, 0.0], [-s(theta), 0.0, c(theta)]])
    x = np.array([[1.0, 0.0, 0.0], [0.0, c(psi), -s(psi)], [0.0, s(psi), c(psi)]])
    return np.asarray(z @ y @ x)


def test_the_arm_is_the_librarys(robot: Robot) -> None:
    rng = np.random.default_rng(0)
    at = rng.normal(size=39)
    q = rng.normal(size=(7, 6))
    flange = forward(at[:30].reshape(5, 6).T, q, robot.prismatic)
    tip = flange[:, :3, :3] @ at[36:] + flange[:, :3, 3]
    assert_allclose(arm(at, q)[0].T, tip @ euler(*at[33:36]).T + at[30:33], rtol=0, atol=1e-13)


def test_rows_are_derivatives() -> None:
    at, q, y = some_arm()
    rows, error = joint_rows(at, q, y)
    assert_allclose(error, y - arm(at, q)[0].ravel(), rtol=0, atol=0)
    assert_allclose(rows, differences(lambda x: arm(x, q)[0].ravel(), at), rtol=0, atol=NEAR)
    _, rows, c = separable_rows(at, q, y)
    slope = differences(lambda x: separable_rows(x, q, y)[2], at)
    assert_allclose(rows, -slope[ANGLES], rtol=0, atol=NEAR * 10)
    lengths = np.setdiff1d(np.arange(39), ANGLES)
    assert_allclose(slope[lengths], 0.0, rtol=0, atol=NEAR)  # eliminated: c does not depend on them
    assert np.linalg.norm(joint_rows(at, q, y)[0][lengths] @ c) > 0.0


def test_the_least_step_is_that_of_the_pseudo_inverse() -> None:
    rng = np.random.default_rng(1)
    J = rng.normal(size=(30, 7)) @ rng.normal(size=(7, 12))
    H, g = J.T @ J, J.T @ rng.normal(size=30)
    expected = np.linalg.pinv(H, rcond=1e-12, hermitian=True) @ g
    assert_allclose(least_step(H, g), expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def test_compiled_and_plain_are_the_same() -> None:
    plain: Any = getattr(joint_rows, "py_func", None)
    if plain is None:
        pytest.skip("numba is not installed: pip install 'minimax-cal[fast]'")
    at, q, y = some_arm()
    assert_allclose(joint_rows(at, q, y)[0], plain(at, q, y)[0], rtol=0, atol=1e-13)


def test_the_unit_of_length_decides_about_nllm() -> None:
    """(J'J + mu I) adds the same mu to square radians and to square lengths."""
    robot, model = off_starts.problem_of(Setting(seed=1), "identifiable")
    begin = off_starts.flat(robot, 1.0, -1.0)
    runs = {unit: off_starts.letter("nllm", unit, model, begin, 4000) for unit in off_starts.UNITS}
    assert runs["all, m"][2] == pseudo_inverse.CONVERGED
    assert runs["all, mm"][0] > 3 * runs["all, m"][0]
    same = {u: off_starts.letter("snlgn", u, model, begin, 100)[0] for u in off_starts.UNITS}
    assert same["all, mm"] == same["all, m"]  # with lengths eliminated the unit drops out


def test_damping_never_raises_the_cost_and_the_course_is_whole() -> None:
    robot, model = off_starts.problem_of(Setting(seed=1), "identifiable")
    begin = off_starts.flat(robot, 0.5, 0.5)
    count, cost, _, costs = off_starts.letter("nllm", "all, m", model, begin, 200, 201)
    assert np.all(np.diff(costs[:count]) <= 0.0)
    assert costs[count - 1] == cost
    assert np.isnan(costs[count:]).all()


def test_without_converging_the_limit_is_said() -> None:
    robot, model = off_starts.problem_of(replace(Setting(), seed=1), "identifiable")
    count, _, ended, _ = off_starts.letter("nllm", "all, mm", model, off_starts.flat(robot, 3), 5)
    assert (count, ended) == (5, pseudo_inverse.LIMIT)
