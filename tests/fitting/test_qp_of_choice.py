"""Whoever is asked for the QPs of a calibration answers all of them, and to the same optimum."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from qp_backends import Problem, Solution, available

ASKED = ("osqp", "clarabel", "proxqp", "cvxpy", "subgradient", "quadprog", "piqp", "scs")
CASES = [("irb2600", 3, "minimax"), ("ur5e", 2, "minimax"), ("irb120", 3, "point")]


@pytest.fixture(scope="module", params=CASES, ids=lambda case: f"{case[0]}-{case[2]}")
def case(request: pytest.FixtureRequest) -> Any:
    """Robot, measurements, objective, and the largest function of the calibration by DAQP."""
    robot, targets, objective = request.param
    data = mc.simulate(robot, 40, targets, seed=targets).data
    return robot, data, objective, largest(mc.calibrate(robot, data, objective))


def largest(fit: Any) -> float:
    """The largest function at the optimum of the minimax."""
    return float(fit.minimax.size.max())


@pytest.mark.parametrize("name", ASKED)
def test_who_is_asked_answers(name, case):
    if name not in available():
        pytest.skip(f"{name} is not installed")
    robot, data, objective, best = case
    fit = mc.calibrate(robot, data, objective, qp=name)
    assert set(fit.answered) == {name}
    assert_allclose(largest(fit), best, rtol=1e-9)


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_each_answer_is_judged_once_and_none_is_polished(seed, monkeypatch):
    """Data whose last steps are so small that 1e-8 of curvature left more rounding than 1e-9."""
    judge = import_module("qp_backends.judge")
    accuracy, judged = judge.accuracy, []

    def counted(problem: Problem, solution: Solution) -> Any:
        judged.append(accuracy(problem, solution))
        return judged[-1]

    monkeypatch.setattr(judge, "accuracy", counted)
    monkeypatch.setattr(judge, "polish", pytest.fail)
    fit = mc.calibrate("irb2600", mc.simulate("irb2600", 100, 3, seed=seed).data)
    assert len(judged) == sum(fit.answered.values()) == fit.work.qps
    assert max(one.worst for one in judged) <= 1e-9
