"""The studies' own arithmetic on a small scale; CI runs them all in their quick form."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments import convergence, pseudo_inverse
from experiments.convergence import ConvergenceJob, ConvergenceSetting
from experiments.errata import draw_arm_and_points
from experiments.pseudo_inverse import (
    ENDED_CONVERGED,
    arm_points_and_axes,
    joint_jacobian_and_error,
    pseudo_inverse_step,
    separable_jacobian_and_error,
)
from minimax_cal.robots.kinematics import forward_kinematics

# ---- studies -------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", convergence.PAPER_S_METHODS)
@pytest.mark.parametrize("unit", convergence.LENGTH_UNITS_PER_METRE)
def test_the_letter_and_the_library_reach_the_same_minimum(method, unit):
    setting = ConvergenceSetting(seed=1)
    least = convergence.global_minimum_cost(setting)
    robot, model = convergence.build_identifiable_model(setting)
    begin = convergence.paper_start_vector(robot, 0.2, -0.1)
    _, cost, ended, _ = convergence.run_paper_iteration(method, unit, model, begin, 2000)
    assert ended == ENDED_CONVERGED
    assert_allclose(cost, least, rtol=1e-6)
    ours = convergence.run_starts(
        ConvergenceJob(setting, method, "identifiable", (0.2,), (-0.1,), 2000)
    )
    assert ours.converged == (True,)
    assert_allclose(ours.cost[0], least, rtol=1e-6)


# ---- pseudo inverse ------------------------------------------------------------------------------


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


def test_the_arm_is_the_librarys(robot):
    rng = np.random.default_rng(0)
    at = rng.normal(size=39)
    q = rng.normal(size=(7, 6))
    flange = forward_kinematics(at[:30].reshape(5, 6).T, q, robot.prismatic)
    tip = flange[:, :3, :3] @ at[36:] + flange[:, :3, 3]
    assert_allclose(
        arm_points_and_axes(at, q)[0].T, tip @ euler(*at[33:36]).T + at[30:33], rtol=0, atol=1e-13
    )


def test_rows_are_derivatives():
    at, q, y = draw_arm_and_points()
    rows, error = joint_jacobian_and_error(at, q, y)
    assert_allclose(error, y - arm_points_and_axes(at, q)[0].ravel(), rtol=0, atol=0)
    assert_allclose(
        rows, differences(lambda x: arm_points_and_axes(x, q)[0].ravel(), at), rtol=0, atol=NEAR
    )
    _, rows, c = separable_jacobian_and_error(at, q, y)
    slope = differences(lambda x: separable_jacobian_and_error(x, q, y)[2], at)
    assert_allclose(rows, -slope[ANGLES], rtol=0, atol=NEAR * 10)
    lengths = np.setdiff1d(np.arange(39), ANGLES)
    assert_allclose(slope[lengths], 0.0, rtol=0, atol=NEAR)  # eliminated: c does not depend on them
    assert np.linalg.norm(joint_jacobian_and_error(at, q, y)[0][lengths] @ c) > 0.0


def test_the_least_step_is_that_of_the_pseudo_inverse():
    rng = np.random.default_rng(1)
    J = rng.normal(size=(30, 7)) @ rng.normal(size=(7, 12))
    H, g = J.T @ J, J.T @ rng.normal(size=30)
    expected = np.linalg.pinv(H, rcond=1e-12, hermitian=True) @ g
    assert_allclose(
        pseudo_inverse_step(H, g), expected, rtol=0, atol=1e-10 * np.abs(expected).max()
    )


COMPARED = """
import sys; sys.path[:0] = [{root!r}, {here!r}]
from test_studies import joint_rows, some_arm
import numpy as np
arm = some_arm()
print(np.abs(joint_rows(*arm)[0] - joint_rows.py_func(*arm)[0]).max())
"""


@pytest.mark.slow
def test_compiled_and_plain_are_the_same():
    pytest.importorskip("numba", reason="needs numba: pip install 'minimax-cal[fast]'")
    here = Path(__file__).parent
    code = COMPARED.format(root=str(here.parent.parent), here=str(here))
    environment = {**os.environ, pseudo_inverse.LOOPS_ENVIRONMENT_VARIABLE: "compiled"}
    made = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True,
                          text=True, check=True)  # fmt: skip
    assert float(made.stdout) < 1e-13
