import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.fitting import identify
from minimax_cal.fitting.identify import Because
from minimax_cal.modelling import start
from minimax_cal.modelling.model import SumOfSquares, model_of
from minimax_cal.modelling.simulate import simulate
from minimax_cal.solvers import least_squares

TWELVE = "d1 theta1 d2 beta1 beta3 beta4 beta5 a6 d6 theta6 alpha6 beta6"


def find(robot: mc.Robot, data: mc.Measurements, order: np.ndarray | None = None):  # type: ignore[no-untyped-def]
    model = model_of(robot, data)
    frame = start.fit_base(model, robot.mdh)
    order = identify.drop_order(robot, model.names) if order is None else order
    return model, frame.state, identify.identify(
        model,
        frame.state,
        order,
        allowed=model.active,
        reference=identify.plenty_of_poses(robot, model),
        known=np.zeros(model.names.count, dtype=bool),
    )  # fmt: skip


def test_the_twelve_redundant_parameters(robot, noisy):
    _, _, found = find(robot, noisy.data)
    assert set(found.reasons) == set(TWELVE.split())
    assert found.active.sum() == 33
    assert found.reasons["d1"].text == "same motion as base_z"
    assert found.reasons["theta1"].text == "same motion as base_rz"
    assert found.reasons["d2"].text == "same motion as d3"
    assert found.reasons["theta6"].text == "same motion as all targets moved together"


def test_one_target_leaves_27_of_39(robot):
    _, _, found = find(robot, simulate(robot, 60, 1, seed=1).data)
    assert len(found.active) == 39
    assert found.active.sum() == 27


@pytest.mark.parametrize(("name", "dropped"), [("ur10", "d2 d3"), ("irb120", "d2")])
def test_beta_instead_of_d_on_parallel_axes(name, dropped):
    robot = mc.load_robot(name)
    _, _, found = find(robot, simulate(robot, 80, 3, seed=2).data)
    for d in dropped.split():
        assert d in found.reasons
        assert d.replace("d", "beta") not in found.reasons


def test_singular_values_are_those_of_the_scaled_jacobian(robot, noisy):
    model, state, found = find(robot, noisy.data)
    jacobian = model.jacobian(state).reshape(-1, model.names.count)[:, found.active]
    norms = np.sqrt((jacobian**2).sum(axis=0) / model.counts.sum())
    expected = np.linalg.svd(jacobian / norms, compute_uv=False)
    assert_allclose(found.singular, expected, rtol=1e-9)


def test_a_prismatic_joint_has_its_own_redundancy():
    robot = mc.load_robot("scara_600")
    made = simulate(robot, 80, 3, seed=3)
    model, state, found = find(robot, made.data)
    every = np.ones(model.names.count, dtype=bool)
    _, _, gram = SumOfSquares(model).normal_of(state, every)
    scale = np.sqrt(np.diag(gram))
    rank = np.linalg.matrix_rank(gram / np.outer(scale, scale), tol=1e-10, hermitian=True)
    assert found.active.sum() <= rank
    data = made.data
    fit = mc.calibrate(robot, data, "sum", holdout=0.25)
    assert fit.status == "converged"
    assert fit.accuracy["holdout"].rms_mm < 0.3 * fit.accuracy["nominal"].rms_mm


def test_predictions_do_not_depend_on_the_copy_that_is_dropped(robot, noisy):
    rng = np.random.default_rng(6)
    points = float(noisy.data.seen.sum())
    errors = []
    sets = set()
    for trial in range(8):
        model, begin, _ = find(robot, noisy.data)
        order = identify.drop_order(robot, model.names)
        order = rng.permutation(order) if trial else order
        _, _, found = find(robot, noisy.data, order)
        sets.add(tuple(found.active))
        assert found.active.sum() == 33
        model = model.only(found.active)
        fit = least_squares.solve(SumOfSquares(model), begin.batch(), 1, points)
        x = fit.x.take(np.array(0))
        errors.append(model.error(x) @ x.rotation.T)  # measurement axes: the base may differ
    assert len(sets) > 3  # the orders really chose different parameters
    for error in errors[1:]:
        assert_allclose(error, errors[0], rtol=0, atol=1e-9)  # 1e-6 mm


def test_what_the_poses_do_not_show_is_told_from_what_no_pose_can(robot):
    """Joint 4 never moves: its offset is then told from nothing, and the reason says so."""
    rng = np.random.default_rng(7)
    made = simulate(robot, 80, 3, seed=7)
    q = made.data.q.copy()
    q[:, 3] = 0.3
    data = mc.measurements(q, made.cell.predict(q) + 1e-5 * rng.normal(size=(80, 3, 3)))
    _, _, found = find(robot, data)
    assert found.active.sum() < 33
    extra = {name: why for name, why in found.reasons.items() if name not in TWELVE.split()}
    assert extra
    assert all(why.kind is Because.NOT_TOLD for why in extra.values())


def test_a_target_on_the_last_axis_does_not_measure_the_wrist(robot):
    """A tenth of a millimetre of lever (as on a real UR10) must not yield angles of ten degrees."""
    from minimax_cal.modelling.simulate import Truth

    made = simulate(robot, 100, 1, seed=9, truth=Truth(circle=1e-4))
    fit = mc.calibrate(robot, made.data, "sum")
    changes = [abs(p.value - p.nominal) for p in fit.parameters if p.name[0] in "abdt"]
    assert max(changes) < 0.02  # 20 mm, 20 mrad
    assert fit.accuracy["holdout"].rms_mm < 0.7
