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


COMPARED = """
import sys; sys.path[:0] = [{root!r}, {here!r}]
from test_pseudo_inverse import joint_rows, some_arm
import numpy as np
arm = some_arm()
print(np.abs(joint_rows(*arm)[0] - joint_rows.py_func(*arm)[0]).max())
"""


@pytest.mark.slow
def test_compiled_and_plain_are_the_same() -> None:
    pytest.importorskip("numba", reason="needs numba: pip install 'minimax-cal[fast]'")
    here = Path(__file__).parent
    code = COMPARED.format(root=str(here.parent.parent), here=str(here))
    environment = {**os.environ, pseudo_inverse.LOOPS: "compiled"}
    made = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True,
                          text=True, check=True)  # fmt: skip
    assert float(made.stdout) < 1e-13


Way = tuple[int, float, int, np.ndarray]
STARTS = ((0.0, 0.0), (0.1, 0.2), (1.0, -1.0), (3.0, -2.8), (3.1, 3.1), (-2.0, 2.5))
SAME = 1e-9  # relative, of every iterate's cost: the same way but for rounding
HELD, SLOWLY = 1e-2, 2.0  # damping in max diag J'J, and its factor: rounding stays rounding so
COMPILES = pytest.mark.slow  # half a minute, before the first test of the twin


def twins(unit: float, start: tuple[float, float], damping: float, cap: int,
          by: float = off_starts.BY, moved: float = 0.0) -> tuple[Way, Way]:  # fmt: skip
    """The plain loop and its compiled twin, the second from a start moved by a share."""
    fast = pytest.importorskip("experiments.pseudo_inverse_fast", reason="needs numba")
    robot, model = off_starts.problem_of(Setting(seed=1), "identifiable")
    at = off_starts.flat(robot, *start) * np.where(model.names.linear, unit, 1.0)
    q, y = np.ascontiguousarray(model.q), unit * model.y[0].ravel()
    rule = (damping, by, off_starts.SMALL, cap)
    costs = np.full((2, cap + 1), np.nan)
    first = pseudo_inverse.iterate(at, q, y, False, *rule, costs[0])
    second = fast.iterate(at * (1.0 + moved), q, y, *rule, costs[1])
    return (*first, costs[0]), (*second, costs[1])


@COMPILES
@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("unit", off_starts.UNITS.values())
def test_the_compiled_twin_goes_the_same_way(unit: float, start: tuple[float, float]) -> None:
    robot, model = off_starts.problem_of(Setting(seed=1), "identifiable")
    at = off_starts.flat(robot, *start) * np.where(model.names.linear, unit, 1.0)
    rows, _ = joint_rows(at, np.ascontiguousarray(model.q), unit * model.y[0].ravel())
    damping = HELD * float((rows**2).sum(axis=1).max())
    plain, fast = twins(unit, start, damping, 20, SLOWLY)
    assert plain[0] == fast[0]
    assert plain[2] == fast[2]
    assert_allclose(fast[3], plain[3], rtol=SAME, atol=0)
    assert plain[3][~np.isnan(plain[3])][-1] < 0.9 * plain[3][0]


@COMPILES
@pytest.mark.parametrize("start", STARTS[:3])
@pytest.mark.parametrize("damping", [1e-2, -1e-3])
def test_the_twin_ends_where_the_plain_loop_ends(
    damping: float, start: tuple[float, float]
) -> None:
    plain, fast = twins(1.0, start, damping, 200)
    assert plain[2] == fast[2] == pseudo_inverse.CONVERGED
    assert abs(plain[0] - fast[0]) <= 2  # at the minimum rounding decides which step leads down
    assert_allclose(fast[1], plain[1], rtol=SAME)


@COMPILES
def test_the_twin_takes_gauss_newton_steps_alike() -> None:
    """Near the minimum; farther off redundant parameters amplify rounding."""
    (count, _, ended, plain), (others, _, end, fast) = twins(1.0, (0.1, 0.2), 0.0, 50)
    assert (count, ended) == (others, end) == (count, pseudo_inverse.CONVERGED)
    assert_allclose(fast[:count], plain[:count], rtol=SAME, atol=0)


@COMPILES
def test_the_twin_stops_at_the_limit_and_fails_on_no_number() -> None:
    cut, other = twins(1e3, (3.1, 3.1), 1e6, 7)
    assert cut[0] == other[0] == 7
    assert cut[2] == other[2] == pseudo_inverse.LIMIT
    with np.errstate(all="ignore"):
        failed, other = twins(1e3, (np.nan, 0.0), 1e2, 7)
    assert failed[2] == other[2] == pseudo_inverse.FAILED


@COMPILES
def test_rounding_decides_which_way_nllm_takes_in_millimetres() -> None:
    """A unit of rounding at the start is a large share of the error soon after."""
    apart = []
    for moved in (0.0, pseudo_inverse.ROUNDING):
        (*_, plain), (*_, other) = twins(1e3, (1.0, -1.0), off_starts.DAMPING, 200, moved=moved)
        apart.append(np.abs(other / plain - 1.0).max())
    assert min(apart) > 1e-3


@COMPILES
def test_the_twins_least_step_is_that_of_the_pseudo_inverse() -> None:
    fast = pytest.importorskip("experiments.pseudo_inverse_fast", reason="needs numba")
    rng = np.random.default_rng(1)
    J = rng.normal(size=(30, 7)) @ rng.normal(size=(7, 12))
    H, g = J.T @ J, J.T @ rng.normal(size=30)
    expected = np.linalg.pinv(H, rcond=1e-12, hermitian=True) @ g
    assert_allclose(fast.least_step(H, g), expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    damped = np.linalg.solve(H + 0.1 * np.eye(12), g)
    assert_allclose(fast.solved(H, 0.1, g), damped, rtol=0, atol=1e-12 * np.abs(damped).max())
    indefinite = np.diag([1.0, -2.0])
    assert_allclose(fast.solved(indefinite, 0.0, np.ones(2)), [1.0, -0.5], rtol=1e-15)


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
