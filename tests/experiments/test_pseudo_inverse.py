"""Paper S to the letter, against the library and against differences."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments import convergence, pseudo_inverse
from experiments.convergence import Setting
from experiments.errata import some_arm
from experiments.pseudo_inverse import arm, joint_rows, least_step, separable_rows
from minimax_cal.robots.kinematics import forward

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
    flange = forward(at[:30].reshape(5, 6).T, q, robot.prismatic)
    tip = flange[:, :3, :3] @ at[36:] + flange[:, :3, 3]
    assert_allclose(arm(at, q)[0].T, tip @ euler(*at[33:36]).T + at[30:33], rtol=0, atol=1e-13)


def test_rows_are_derivatives():
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


def test_the_least_step_is_that_of_the_pseudo_inverse():
    rng = np.random.default_rng(1)
    J = rng.normal(size=(30, 7)) @ rng.normal(size=(7, 12))
    H, g = J.T @ J, J.T @ rng.normal(size=30)
    expected = np.linalg.pinv(H, rcond=1e-12, hermitian=True) @ g
    assert_allclose(least_step(H, g), expected, rtol=0, atol=1e-10 * np.abs(expected).max())


COMPARED = """
import sys; sys.path[:0] = [{root!r}, {here!r}]
from test_pseudo_inverse import joint_rows, some_arm
import numpy as np
arm = some_arm()
print(np.abs(joint_rows(*arm)[0] - joint_rows.py_func(*arm)[0]).max())
"""


@pytest.mark.slow
def test_compiled_and_plain_are_the_same():
    pytest.importorskip("numba", reason="needs numba: pip install 'minimax-cal[fast]'")
    here = Path(__file__).parent
    code = COMPARED.format(root=str(here.parent.parent), here=str(here))
    environment = {**os.environ, pseudo_inverse.LOOPS: "compiled"}
    made = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True,
                          text=True, check=True)  # fmt: skip
    assert float(made.stdout) < 1e-13


def test_the_unit_of_length_decides_about_nllm():
    """(J'J + mu I) adds the same mu to square radians and to square lengths."""
    robot, model = convergence.problem_of(Setting(seed=1))
    begin = convergence.flat(robot, 1.0, -1.0)
    runs = {
        unit: convergence.letter("nllm", unit, model, begin, 4000) for unit in convergence.UNITS
    }
    assert runs["all, m"][2] == pseudo_inverse.CONVERGED
    assert runs["all, mm"][0] > 3 * runs["all, m"][0]
    same = {u: convergence.letter("snlgn", u, model, begin, 100)[0] for u in convergence.UNITS}
    assert same["all, mm"] == same["all, m"]  # with lengths eliminated the unit drops out


def test_rounding_decides_which_way_nllm_takes_in_millimetres():
    """A unit of rounding at the start is a large share of the error soon after."""
    robot, model = convergence.problem_of(Setting(seed=1))
    begin = convergence.flat(robot, 1.0, -1.0)
    plain, moved = (
        convergence.letter("nllm", "all, mm", model, begin * by, 200, 201)[3]
        for by in (1.0, 1.0 + pseudo_inverse.ROUNDING)
    )
    assert np.nanmax(np.abs(moved / plain - 1.0)) > 1e-3


def test_damping_never_raises_the_cost_and_the_course_is_whole():
    robot, model = convergence.problem_of(Setting(seed=1))
    begin = convergence.flat(robot, 0.5, 0.5)
    count, cost, _, costs = convergence.letter("nllm", "all, m", model, begin, 200, 201)
    assert np.all(np.diff(costs[:count]) <= 0.0)
    assert costs[count - 1] == cost
    assert np.isnan(costs[count:]).all()


def test_without_converging_the_limit_is_said():
    robot, model = convergence.problem_of(replace(Setting(), seed=1))
    count, _, ended, _ = convergence.letter("nllm", "all, mm", model, convergence.flat(robot, 3), 5)
    assert (count, ended) == (5, pseudo_inverse.LIMIT)
