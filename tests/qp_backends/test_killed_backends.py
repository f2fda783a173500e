"""However a QP backend dies, the calibration goes on with another and says so."""

import time

import numpy as np
import pytest

import minimax_cal as mc
import qp_backends
from qp_backends import Problem, Solution, Status


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
