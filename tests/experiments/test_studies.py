"""The studies' own arithmetic on a small scale; CI runs them all in their quick form."""

from multiprocessing.pool import Pool

import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments import any_base, conditions, convergence, solver_accuracy
from experiments.convergence import Job, Setting
from experiments.pseudo_inverse import CONVERGED
from qp_backends import Problem


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
