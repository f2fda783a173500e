"""The default way to the minimax: separable least squares, then QPs through qpsolvers, warm."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import qpsolvers
import threadpoolctl
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.fitting import solve
from minimax_cal.modelling.near import jointly, separated
from qp_backends import Solution


def test_the_default_is_separable_squares_then_warm_started_qps_through_qpsolvers(
    robot, noisy, monkeypatch
):
    seen: list[np.ndarray | None] = []
    found: list[np.ndarray] = []
    plain = qpsolvers.solve_problem

    def listen(qp, solver, initvals=None, **settings):  # type: ignore[no-untyped-def]
        answer = plain(qp, solver, initvals=initvals, **settings)
        seen.append(initvals)
        found.append(answer.x)
        assert solver == "daqp"
        return answer

    monkeypatch.setattr(qpsolvers, "solve_problem", listen)
    fit = mc.calibrate(robot, noisy.data)
    assert fit.work.least_squares == "snlgn"
    assert fit.work.steps > 0
    assert fit.answered == {"daqp": len(seen)}
    assert fit.work.qps == len(seen)
    assert fit.work.warm_starts == len(seen) - 1 > 0
    assert seen[0] is None
    for start, last in zip(seen[1:], found, strict=False):
        assert start is not None
        np.testing.assert_array_equal(start, last)


def test_the_fast_choices_end_at_the_same_optimum(robot, noisy):
    usual = mc.calibrate(robot, noisy.data)
    fast = mc.calibrate(robot, noisy.data, method="joint", qp="daqp:direct")
    assert fast.work.least_squares == "nlgn"
    assert set(fast.answered) == {"daqp:direct"}
    assert usual.minimax is not None
    assert fast.minimax is not None
    assert_allclose(fast.minimax.size.max(), usual.minimax.size.max(), rtol=1e-9)


def test_result_file_and_headline_say_who_answered(robot, noisy, monkeypatch):
    fit = mc.calibrate(robot, noisy.data)
    content = fit.to_dict()
    assert content["answered"] == dict(fit.answered)
    assert content["work"] == dataclasses.asdict(fit.work)
    assert content["qp"] == "daqp"
    again = mc.Fit.from_dict(content) if hasattr(mc, "Fit") else type(fit).from_dict(content)
    assert (again.answered, again.work) == (fit.answered, fit.work)
    count = fit.answered["daqp"]
    assert f"QPs: {count} by daqp ({count - 1} warm-started)" in fit.summary()
    assert "QPs" not in mc.calibrate(robot, noisy.data, "sum").headline()


def test_a_function_of_the_user_is_named(robot, noisy):
    from qp_backends import Problem
    from qp_backends import solve as solve_qp

    def mine(problem: Problem) -> Solution:
        return dataclasses.replace(solve_qp(problem, "daqp"), backend="")

    fit = mc.calibrate(robot, noisy.data, qp=mine)
    assert list(fit.answered) == ["function mine"]
    assert fit.work.warm_starts == 0


def test_steps_of_variable_projection_start_from_the_best_lengths(robot, noisy):
    """Same minimum as all parameters at once; the first cost is what the best lengths leave."""
    task = solve.prepared(robot, noisy.data, mc.Options())
    model = task.base.only(task.identified(task.base, task.frame.state).active)
    both, apart = jointly(model, task.frame.state), separated(model, task.frame.state)
    assert both is not None
    assert apart is not None
    assert_allclose(apart.cost, both.cost, rtol=1e-12)
    assert apart.trace[0, 0] < both.trace[0, 0]
    lengths = model.only(model.active & model.names.linear)
    least = jointly(lengths, task.frame.state)
    assert least is not None
    assert_allclose(apart.trace[0, 0], least.cost[0], rtol=1e-9)
    assert (np.diff(apart.trace[:, 0]) <= 1e-12 * apart.trace[0, 0]).all()


@pytest.mark.parametrize(("method", "least"), [("eliminated", 1e-5), ("raw", 1e-3)])
@pytest.mark.parametrize("arm", ["irb2600", "irb120", "ur5e"])
def test_the_papers_subgradient_answers_by_itself(arm, method, least):
    """RMSE(phi) over the optimum; it is no success unless it is one, and says how far it came."""
    drawn = mc.load_robot(arm)
    data = mc.simulate(drawn, 60, 3, seed=0).data
    best, found = (mc.calibrate(drawn, data, qp=qp) for qp in ("daqp", f"subgradient:{method}"))
    assert found.answered == {f"subgradient:{method}": found.work.qps}
    assert found.work.qp_residual > 1e-8
    assert found.work.warm_starts == 0
    assert best.minimax is not None
    assert found.minimax is not None
    over = np.sqrt(found.minimax.size.max() / best.minimax.size.max()) - 1.0
    assert over <= least
    told = [n for n in found.notices if n.startswith("QP: to first order the largest function may")]
    if found.status == "converged":
        assert over <= 1e-6
        assert not told
    else:
        assert found.status == "stalled"
        offered = float(told[0].split(" fall by ")[1].split()[0])
        assert 200.0 * over <= offered <= 5.0
    assert f"by subgradient:{method} (used as they are, relative residual up to" in found.headline()


def test_small_matrices_get_one_thread(robot: mc.Robot) -> None:
    """Two of them wait for each other: a fit took twice as long, its starts thirty times."""
    seen: list[int] = []

    def threads(_: object = None) -> list[int]:
        found = threadpoolctl.threadpool_info()
        return [each["num_threads"] for each in found if each["user_api"] == "blas"]

    with threadpoolctl.threadpool_limits(2, "blas"):
        before = threads()
        mc.calibrate(robot, mc.simulate(robot, 30, 2, seed=1).data, "sum",
                     progress=lambda _: seen.extend(threads()))  # fmt: skip
        assert threads() == before
    assert set(seen) == {1}
