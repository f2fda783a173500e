"""Solvers of the user's own that change the problem, never end, die, or answer nonsense."""

from __future__ import annotations

import os
import signal
import time
from typing import Any

import numpy as np
import pytest

from qp_backends import BackendError, Problem, Solution, Status, registry, solve

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
    return Solution(*ANSWER, "solved", 0.0)  # type: ignore[arg-type]


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
    ("solver", "seconds", "says"),
    [
        (endless, 1.0, "stopped after 1 s"),
        (killed, 120.0, "process ended with -9"),
        (leaving, 120.0, "raised"),
    ],
)
def test_what_never_ends_or_dies_is_replaced(solver, seconds, says):
    """The two that die get time to start: a busy machine may need seconds for that."""
    registry.register("mine", solver, seconds=seconds)
    found = solve(problem(), "mine")
    assert found.status is Status.SOLVED
    assert found.backend != "mine"
    assert says in found.notes[0]


def test_a_status_of_its_own_making_is_no_answer():
    registry.register("mine", no_status)
    found = solve(problem(), "mine")
    assert found.status is Status.SOLVED
    assert "no qp_backends.Status" in found.notes[0]


def test_a_process_needs_what_can_be_imported():
    with pytest.raises(BackendError, match="top of a module"):
        registry.register("mine", lambda given: ANSWER, seconds=1.0)
    with pytest.raises(BackendError, match="positive"):
        registry.register("mine", right, seconds=0.0)
