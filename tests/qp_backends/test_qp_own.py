"""Solvers of the user's own that change the problem, never end, die, or answer nonsense.

Processes of their own import this module: it needs nothing of the other tests.
"""

from __future__ import annotations

import os
import signal
import time
from importlib import metadata, util
from typing import Any

import numpy as np
import pytest

import minimax_cal as mc
import qp_backends
from qp_backends import (
    BackendError,
    Problem,
    Solution,
    Status,
    available,
    child,
    names,
    registry,
    solve,
)
from qp_backends.problem import COLD
from qp_backends.registry import DENSE_ORDER, SPARSE_ORDER, backend, fallback_order

# ---- qp own --------------------------------------------------------------------------------------


EXACT = np.array([-1.0, -1.0])  # of PROBLEM: its lower bounds
ANSWER = (EXACT, np.zeros(2))  # the slope x + 1 vanishes there


def problem() -> Problem:
    return Problem(np.eye(2), np.ones(2), np.eye(2), -np.ones(2), np.ones(2))


@pytest.fixture(autouse=True)
def own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_registered", {})


def spoiling(given: Problem) -> Any:
    for part in (given.P, given.q, given.A, given.l, given.u):
        part[...] = 0.0
    return np.zeros(2), np.zeros(2)


def right(given: Problem, tolerance: float = 1.0) -> Any:
    assert tolerance < 1.0
    return ANSWER


def endless(given: Problem) -> Any:
    while True:
        time.sleep(1.0)


def killed(given: Problem) -> Any:
    os.kill(os.getpid(), signal.SIGKILL)


def leaving(given: Problem) -> Any:
    os._exit(0)


def no_status(given: Problem) -> Any:
    return Solution(*ANSWER, "solved", 0.0)


def test_a_solver_that_changes_the_problem_changes_its_own_copy():
    """Were it the caller's, x = 0 would solve what is left of it."""
    registry.register("mine", spoiling)
    asked = problem()
    found = solve(asked, "mine")
    assert found.backend != "mine"
    assert np.abs(found.x - EXACT).max() < 1e-8
    assert asked.q.tolist() == [1.0, 1.0]


def test_a_process_of_its_own_gives_the_same_answer():
    registry.register("mine", right, seconds=60.0)
    found = solve(problem(), "mine", fallback=False)
    assert found.status is Status.SOLVED
    assert found.x.tolist() == EXACT.tolist()


@pytest.mark.parametrize(
    ("solver", "more", "says"),
    [
        (endless, {"seconds": 1.0}, "stopped after 1 s"),
        (killed, {"seconds": 120.0}, "process ended with -9"),
        (leaving, {"seconds": 120.0}, "raised"),
        (no_status, {}, "no qp_backends.Status"),
    ],
)
def test_what_never_ends_or_dies_or_has_a_status_of_its_own_is_replaced(solver, more, says):
    """The two that die get time to start: a busy machine may need seconds for that."""
    registry.register("mine", solver, **more)
    found = solve(problem(), "mine")
    assert found.status is Status.SOLVED
    assert found.backend != "mine"
    assert says in found.notes[0]


def test_a_process_needs_what_can_be_imported():
    with pytest.raises(BackendError, match="top of a module"):
        registry.register("mine", lambda given: ANSWER, seconds=1.0)
    with pytest.raises(BackendError, match="positive"):
        registry.register("mine", right, seconds=0.0)


# ---- qp registry ---------------------------------------------------------------------------------


ONE = Problem([[1.0]], [-3.0], [[1.0]], [-np.inf], [1.0])


def test_available_backends_have_the_versions_of_their_packages():
    versions = available()
    assert versions["daqp"] == metadata.version("daqp")
    assert versions["proxqp"] == metadata.version("proxsuite")
    assert versions["subgradient"] == "own"
    assert set(versions) <= set(names())


def test_a_missing_package_is_an_error_that_says_what_to_install(monkeypatch):
    find = util.find_spec
    monkeypatch.setattr(util, "find_spec", lambda name: None if name == "piqp" else find(name))
    registry._imported.cache_clear()
    with pytest.raises(BackendError, match="pip install piqp"):
        backend("piqp")
    assert "piqp" not in available()
    assert "piqp" not in fallback_order(ONE)
    monkeypatch.undo()
    assert "piqp" in fallback_order(ONE)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("dapq", "did you mean 'daqp'"),
        ("nothing like it", "choose one of daqp, quadprog"),
        ("daqp:fast", "no QP backend 'daqp:fast'"),
        ("cvxpy:nothing", "cvxpy has no QP solver 'nothing'"),
        ("subgradient:nothing", "choose one of restarted, raw, eliminated"),
    ],
)
def test_a_wrong_name_is_an_error_that_says_what_there_is(name, message):
    with pytest.raises(BackendError, match=message):
        backend(name)


def test_the_fallback_order_depends_on_how_the_problem_is_stored():
    from scipy import sparse

    thin = Problem(sparse.eye_array(1), [-3.0], [[1.0]], [-np.inf], [1.0])
    installed = set(available())
    assert fallback_order(ONE) == tuple(name for name in DENSE_ORDER if name in installed)
    assert fallback_order(thin) == tuple(name for name in SPARSE_ORDER if name in installed)
    assert sorted(DENSE_ORDER) == sorted(SPARSE_ORDER)


def test_a_registered_solver_gets_the_keywords_that_it_takes():
    seen = {}

    def all_of_them(problem, **keywords):
        seen.update(keywords)
        return np.ones(1), np.full(1, 2.0)

    registry.register("all", all_of_them)
    registry.register("none", lambda problem: (np.ones(1), np.full(1, 2.0)))
    given = {"tolerance": 1e-5, "time_limit": 3.0, "warm_start": None}
    assert backend("all")(ONE, **given).x == 1.0
    assert seen == given
    assert backend("none")(ONE, **given).y == 2.0
    assert available()["all"] == "registered"
    assert "none" in names()


# ---- killed backends -----------------------------------------------------------------------------


def raising(problem: Problem) -> Solution:
    raise RuntimeError("licence expired")


def not_numbers(problem: Problem) -> Solution:
    nan = np.full(len(problem.q), np.nan)
    return Solution(nan, np.full(len(problem.l), np.nan), Status.SOLVED, 0.0)


def lying(problem: Problem) -> Solution:
    """Claims that doing nothing is optimal."""
    return Solution(np.zeros(len(problem.q)), np.zeros(len(problem.l)), Status.SOLVED, 0.0)


def out_of_time(problem: Problem, time_limit: float = np.inf) -> Solution:
    time.sleep(0.02)
    nan = np.full(len(problem.q), np.nan)
    return Solution(nan, np.full(len(problem.l), np.nan), Status.TIME_LIMIT, 0.02)


@pytest.mark.parametrize("killed", [raising, not_numbers, lying, out_of_time])
def test_another_backend_takes_over(killed, robot, noisy):
    name = f"killed-{killed.__name__}"
    qp_backends.register(name, killed)
    fit = mc.calibrate(robot, noisy.data, "minimax", qp=name)
    good = mc.calibrate(robot, noisy.data, "minimax")
    assert fit.status == "converged"
    best = fit.minimax
    assert {step.backend for step in best.trace} != {name}
    assert any(note.startswith("QP: ") and name in note for note in fit.notices)
    assert max(fit.accuracy["train"].sse_mm2) == pytest.approx(
        max(good.accuracy["train"].sse_mm2), rel=1e-8
    )


def test_a_backend_that_is_not_installed(robot, noisy):
    missing = [name for name in qp_backends.names() if name not in qp_backends.available()]
    if not missing:
        pytest.skip("every known backend is installed here")
    fit = mc.calibrate(robot, noisy.data, "minimax", qp=missing[0])
    assert fit.status == "converged"
    assert any(missing[0] in note and "daqp is used" in note for note in fit.notices)
    assert fit.qp == missing[0]  # what was asked
    assert set(fit.answered) == {"daqp"}  # the one that ran
    assert fit.provenance.settings["qp"] == missing[0]


def test_a_name_that_does_not_exist_is_a_mistake(robot, noisy):
    with pytest.raises(mc.OptionError, match="did you mean"):
        mc.calibrate(robot, noisy.data, qp="clarabell")


# ---- qp child ------------------------------------------------------------------------------------


def test_a_failure_in_the_process_is_told():
    there = child.run("qp_backends.nothing", ONE, "", 1, 60.0, COLD)
    assert there.status is Status.FAILED
    assert "No module named" in there.notes[-1]


def test_a_solver_without_a_clock_is_stopped_in_time():
    """quadprog would take minutes for this one, and nothing in it looks at a clock."""
    rng = np.random.default_rng(1)
    n = 1800
    problem = Problem(
        np.eye(n), rng.normal(size=n), rng.normal(size=(n, n)), -np.ones(n), np.ones(n)
    )
    start = time.perf_counter()
    solution = solve(problem, "quadprog", time_limit=1.0, fallback=False)
    assert solution.status is Status.TIME_LIMIT
    assert time.perf_counter() - start < 30.0  # on a loaded machine, too
