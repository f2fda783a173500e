"""The studies' own arithmetic on a small scale; CI runs them all in their quick form."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from multiprocessing.pool import Pool
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments import (
    algorithm_1,
    any_base,
    conditions,
    convergence,
    pseudo_inverse,
    solver_accuracy,
    speed,
    speed_peers,
)
from experiments.algorithm_1 import GOOD, course_of, problem_of, rows_of, subproblem
from experiments.algorithm_1 import Job as PrintedJob
from experiments.convergence import Job, Setting
from experiments.errata import some_arm
from experiments.pixels import (
    REACHED,
    WAYS,
    WEAK_OFF,
    Start,
    Weak,
    reach,
    run,
    starts_table,
    ways_table,
    weak,
    weak_table,
)
from experiments.pixels import (
    Job as PixelJob,
)
from experiments.pseudo_inverse import CONVERGED, arm, joint_rows, least_step, separable_rows
from minimax_cal.robots.kinematics import forward
from qp_backends import Problem, subgradient

# ---- studies -------------------------------------------------------------------------------------


def test_the_grid_is_the_papers():
    theta, alpha = convergence.grid(1)
    assert len(theta) == 63 * 63
    assert_allclose([theta.min(), theta.max(), alpha.min(), alpha.max()], [-3.1, 3.1, -3.1, 3.1])
    few, _ = convergence.grid(3)
    assert len(few) == 21 * 21
    assert set(few) <= set(theta)
    assert 0.0 in few  # the nominal start is on every grid


@pytest.mark.parametrize("method", convergence.PAPER)
@pytest.mark.parametrize("unit", convergence.UNITS)
def test_the_letter_and_the_library_reach_the_same_minimum(method, unit):
    setting = Setting(seed=1)
    least = convergence.least_cost(setting)
    robot, model = convergence.problem_of(setting)
    begin = convergence.flat(robot, 0.2, -0.1)
    _, cost, ended, _ = convergence.letter(method, unit, model, begin, 2000)
    assert ended == CONVERGED
    assert_allclose(cost, least, rtol=1e-6)
    ours = convergence.run(Job(setting, method, "identifiable", (0.2,), (-0.1,), 2000))
    assert ours.converged == (True,)
    assert_allclose(ours.cost[0], least, rtol=1e-6)


def test_separable_methods_come_back_from_radians_away():
    setting = Setting(seed=1)
    least = convergence.least_cost(setting)
    corners = (-3.1, -3.1, 3.1, 3.1, 1.5), (-3.1, 3.1, -3.1, 3.1, -2.0)
    for method in ("snlgn", "snllm"):
        found = convergence.run(Job(setting, method, "identifiable", *corners, 500))
        assert_allclose(found.cost, least, rtol=1e-6)


def test_any_base_is_found():
    for trial in any_base.trials(3, 3, float(np.pi)):
        assert any_base.run(trial).ours


def test_minimax_has_the_least_rmse_phi_in_training():
    phi = {
        c: conditions.run(conditions.Job("irb2600", c, 60, 4)).train.phi
        for c in ("smr:1", "smr:2", "sum", "pose", "minimax")
    }
    # a fit of one target is the minimax where that target stays the worst: equal then
    assert phi["minimax"] <= min(phi.values()) * (1 + 1e-7)
    assert phi["sum"] > phi["minimax"]


def test_a_solver_that_takes_too_long_is_ended(monkeypatch):
    one = np.eye(1)
    problem = Problem(one, -np.ones(1), one, np.array([-1.0]), np.array([0.5]))
    pools: list[Pool] = []
    solution, _ = solver_accuracy.in_time(pools, problem, "daqp")
    assert_allclose(solution.x, 0.5, rtol=1e-9)
    monkeypatch.setattr(solver_accuracy, "LIMIT", 0.0)
    with pytest.raises(TimeoutError):
        solver_accuracy.in_time(pools, problem, "daqp")
    assert not pools


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


# ---- algorithm 1 ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def course() -> algorithm_1.Course:
    return course_of(PrintedJob("irb2600", 0, 10), ("subgradient:raw",))


def test_the_printed_algorithm_comes_near_the_optimum(course):
    """A thousandth of what the start is off by, within ten outer steps, full steps or searched."""
    for values in course.ways.values():
        assert values[10] <= min(GOOD, 1e-3 * values[0])
        assert min(values) > -1e-9  # nothing is below the optimum


def test_a_line_search_never_rises(course):
    assert (np.diff(course.ways["with a line search"]) <= 1e-9).all()


def test_our_backend_of_the_method_comes_as_near(course):
    assert course.ours["subgradient:raw"] <= 1e-3


@pytest.mark.slow  # loops that are not compiled; `test_the_inner_loop_...` holds the iterates
def test_the_eliminated_form_comes_nearer():
    ours = course_of(PrintedJob("irb2600", 0, 0), ("subgradient:eliminated",)).ours
    assert ours["subgradient:eliminated"] <= 1e-5


def test_the_inner_loop_is_that_of_our_backend():
    """Written twice, from the paper: the same iterates."""
    problem, start = problem_of(PrintedJob("irb2600", 0, 1), "squared")
    at = problem.linearise(start)
    slope, C, G = rows_of(at)
    H = at.curvature(np.full(3, 1.0 / 3.0))
    dx, lam = subproblem(H, slope, C, G)
    given = Problem(H, slope, G, np.full(len(C), -np.inf), -C)
    ours = subgradient.solve(given, method="raw", tolerance=0.0, iterations=3_008)
    near = subgradient.solve(given, method="raw", tolerance=0.0, iterations=2_944)
    assert_allclose(dx, ours.x, atol=np.abs(ours.x - near.x).max() + 1e-12)
    assert_allclose(lam, ours.y, atol=np.abs(ours.y - near.y).max() + 1e-12)


def test_rows_are_those_of_the_paper():
    """The active function's own row is zero; a distance that is met exactly leaves C = -1."""
    problem, start = problem_of(PrintedJob("irb2600", 0, 1), "squared")
    at = problem.linearise(start)
    slope, C, G = rows_of(at)
    active = int(at.f.argmax())
    assert C[active] == 0.0
    assert not G[active].any()
    assert (C[:3] <= 0.0).all()
    assert_allclose(slope, at.jacobian[active])
    assert (C[3:] >= -1.0).all()


# ---- pixels study --------------------------------------------------------------------------------


def test_reprojection_is_better_than_poses_and_than_the_drawing():
    ways = ("hand-eye alone, arm as drawn", "poses by PnP, then whole poses",
            "reprojection, lenses freed")  # fmt: skip
    drawn, poses, pixels = (run(PixelJob(way, 0, True)) for way in ways)
    assert pixels.error < 0.5 * poses.error < 0.25 * drawn.error
    assert pixels.error < 2.0 * pixels.sigma
    jobs = [PixelJob(way, 0, True) for way in WAYS]
    table = ways_table(jobs, [replace(pixels, error=i + 1.0) for i in range(len(jobs))])
    assert [row[2] for row in table.rows] == [i + 1.0 for i in range(len(WAYS))]


def test_a_bad_start_is_reached_from_the_poses_of_images():
    depths, pixels = reach(Start(3, True))
    assert depths < REACHED < pixels
    assert [row[1] for row in starts_table([(depths, pixels)]).rows] == [1, 0]


def test_weak_pixels_leave_the_drawn_arm():
    job = Weak(WEAK_OFF[1], 1.0, 0)
    drawn, fitted, out, prior, kept = weak(job)
    assert kept
    assert out == pytest.approx(drawn)
    assert fitted > drawn
    assert prior < 1.03 * drawn
    (row,) = weak_table([job], [(drawn, fitted, out, prior, kept)]).rows
    assert np.allclose(row[5], 1.0)


@pytest.mark.usefixtures("few_candidates")
def test_planned_poses_lower_the_bound():
    given, planned = (
        run(PixelJob(way, 0, True))
        for way in ("reprojection, lenses freed", "poses planned, lenses freed")
    )
    assert sum(planned.least) < 0.6 * sum(given.least)
    assert planned.error**2 < 4.0 * sum(planned.least)


# ---- speed ---------------------------------------------------------------------------------------


PAGE = Path(__file__).parents[2] / "docs" / "speed.md"
MAGNITUDE = 10.0  # other machines, other loads


@pytest.fixture(scope="module")
def case() -> speed.Case:
    return speed.case_of(60, 0)


@pytest.fixture(scope="module")
def raw(case: speed.Case) -> speed_peers.Raw:
    return speed.raw_of(case, speed.simulated(60, 0))


def told() -> dict[str, float]:
    """The ratios on the page."""
    rows = re.findall(r"^\| `(\w+)` \| ([\d.]+) \|", PAGE.read_text(), re.MULTILINE)
    return {name: float(value) for name, value in rows}


def test_peers_and_we_reach_the_same_optimum(case, raw):
    ours = case.model.cost(speed.squares(case)).sum()
    theirs = (raw.rows(speed_peers.gauss_newton(raw))[0] ** 2).sum()
    assert_allclose(theirs, ours, rtol=1e-9)
    worst = raw.squares(speed_peers.slsqp(raw, *speed_peers.scaled(raw)))[0].max()
    assert_allclose(worst, speed.worst_target(case), rtol=speed.SAME)


def test_the_page_tells_the_order_of_magnitude(case, raw):
    pytest.importorskip("numba", reason="the page's ratios are those with numba")
    times = speed.race(
        {
            "squares": partial(speed.squares, case),
            "squares_numpy_gn": partial(speed_peers.gauss_newton, raw),
            "minimax": partial(speed.worst_target, case),
            "minimax_slsqp": partial(speed_peers.slsqp, raw, *speed_peers.scaled(raw)),
        },
        1,
    )
    ratios = {
        "squares_over_numpy_gn": times["squares_numpy_gn"] / times["squares"],
        "minimax_over_slsqp": times["minimax_slsqp"] / times["minimax"],
    }
    page = told()
    for name, ratio in ratios.items():
        assert page[name] / MAGNITUDE < ratio < page[name] * MAGNITUDE, name
