import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import GaussianPrior, PointLeastSquares, build_point_model
from minimax_cal.robots import kinematics


def gappy(rng: np.random.Generator) -> mc.Measurements:
    """Three targets, some not measured, and unequal accuracy."""
    y = rng.normal(size=(40, 3, 3))
    y[rng.uniform(size=(40, 3)) < 0.2] = np.nan
    y[:, 0] = np.where(np.isnan(y[:, 0]), 1.0, y[:, 0])
    return mc.measurements(rng.uniform(-2, 2, (40, 6)), y, u95=rng.uniform(1e-5, 1e-4, 40))


def somewhere(robot: mc.Robot, rng: np.random.Generator) -> ParameterValues:
    return ParameterValues(
        robot.mdh + 0.1 * rng.normal(size=(6, 5)),
        kinematics.rotation_from_vector(rng.normal(size=3)),
        rng.normal(size=3),
        0.1 * rng.normal(size=(3, 3)),
    )


def test_weights_come_from_u95(robot, rng):
    data = gappy(rng)
    this = build_point_model(robot, data)
    u95 = data.columns["u95"]
    assert_allclose(this.weight[0], (np.median(u95) / u95) ** 2, rtol=1e-14)
    assert np.all(this.weight[1][~data.seen[:, 1]] == 0.0)


@pytest.mark.parametrize("kind", ["even", "weighted", "poses"])
def test_full_golub_pereyra_matrix_is_the_square_of_the_projected_jacobian(kind, robot, rng):
    """J'J from Schur complement and coupling against finite differences of the projected residual.

    The residual is P y with lengths eliminated by dense linear algebra, in measurement axes: an
    independent route to paper S, eq. 18-24.
    """
    from minimax_cal.modelling.point_model import pose_error_weights, with_pose_errors
    from minimax_cal.solvers.least_squares import LEAST_SQUARES_METHODS, linearise_iterates

    u95 = {"u95": rng.uniform(1e-5, 1e-4, 30)} if kind == "weighted" else {}
    data = mc.measurements(rng.uniform(-2, 2, (30, 6)), rng.normal(size=(30, 3, 3)), **u95)
    this = build_point_model(robot, data)
    root = np.sqrt(this.weight).T.repeat(3, axis=1)[:, None] * np.eye(9)
    if kind == "poses":
        square, axes = np.linalg.eigh(pose_error_weights(data, 0.3))
        root = np.sqrt(np.maximum(square, 0.0))[..., None] * np.swapaxes(axes, 1, 2)
        this = with_pose_errors(this, pose_error_weights(data, 0.3))
    names = this.names
    chosen = np.zeros(names.parameter_count, dtype=bool)
    for name in (
        *("a1", "a2", "a4", "d4", "d5", "theta2", "theta4", "alpha1", "alpha3", "beta2"),
        *("base_x", "base_y", "base_z", "base_rx", "base_ry", "base_rz"),
        *(f"smr{i}_{axis}" for i in (1, 2, 3) for axis in "xyz"),
    ):
        chosen[names.index_of_name(name)] = True
    this = this.with_active(chosen)
    linear, angles = chosen & names.linear_mask, chosen & ~names.linear_mask
    x, *_ = PointLeastSquares(this).reduced(somewhere(robot, rng).batch(), full=False)
    x = x.take(np.array(0))

    def residual(dw: np.ndarray) -> np.ndarray:
        step = np.zeros(names.parameter_count)
        step[angles] = dw
        at = x.step(step)
        matrix = np.einsum("ab,mkbp->mkap", at.rotation, this.point_jacobian(at)[..., linear])
        matrix = root @ matrix.reshape(30, 9, -1)
        matrix = matrix.reshape(-1, linear.sum())
        error = (this.point_errors(at) @ at.rotation.T).reshape(30, 9, 1)
        error = (root @ error).reshape(-1)
        return np.asarray(error - matrix @ np.linalg.lstsq(matrix, error, rcond=None)[0])

    step = 1e-6
    slopes = np.stack(
        [(residual(step * e) - residual(-step * e)) / (2 * step) for e in np.eye(angles.sum())],
        axis=1,
    )
    for name in ("snllm", "snllm-kaufman"):
        found = linearise_iterates(PointLeastSquares(this), x.batch(), LEAST_SQUARES_METHODS[name])
        gradient = -slopes.T @ residual(np.zeros(angles.sum()))
        assert_allclose(found.target[0], gradient, rtol=0, atol=1e-6 * np.abs(gradient).max())
        off = np.abs(found.matrix[0] - slopes.T @ slopes).max() / np.abs(slopes.T @ slopes).max()
        if name == "snllm":
            assert off < 1e-7  # finite differences of a problem of size one
        else:
            assert off > 1e-3  # Kaufman's really is another matrix


def test_prior_rows_count_like_measurements(robot, rng):
    this = build_point_model(robot, gappy(rng))
    weight = np.where(this.names.link_mask, 2.0, 0.0)
    with_prior = this.with_prior(GaussianPrior(this.prior.mean, weight))
    x = somewhere(robot, rng)
    off = this.parameter_vector(x) - this.prior.mean
    expected = this.target_costs(x).sum() + (weight * off**2).sum()
    cost, gradient, gram = PointLeastSquares(with_prior).normal(x)
    _, plain, bare = PointLeastSquares(this).normal(x)
    assert_allclose(cost, expected, rtol=1e-13)
    assert_allclose(gradient - plain, -weight * off, rtol=0, atol=1e-10)
    assert_allclose(gram - bare, np.diag(weight), rtol=0, atol=1e-10)


def test_pose_weights_are_position_and_orientation_errors(robot, rng):
    """A rigid motion of the measured triangle by (shift, small turn) has the cost it should."""
    from minimax_cal.modelling.point_model import pose_error_weights

    y = rng.normal(size=(7, 3, 3))
    data = mc.measurements(rng.uniform(-2, 2, (7, 6)), y)
    shift, turn, lever = rng.normal(size=(7, 3)), rng.normal(size=(7, 3)), 0.7
    arm = y - y.mean(axis=1, keepdims=True)
    error = shift[:, None] + np.cross(turn[:, None], arm)
    flat = error.reshape(7, 9)
    cost = np.einsum("ma,mab,mb->m", flat, pose_error_weights(data, lever), flat)
    expected = 3 * ((shift**2).sum(1) + lever**2 * (turn**2).sum(1))
    assert_allclose(cost, expected, rtol=1e-9)
    bent = rng.normal(size=(7, 9))  # an error of the triangle's own shape
    pose = np.concatenate([np.tile(np.eye(3), (3, 1))[None].repeat(7, 0),
                           np.moveaxis(np.stack([np.cross(e, arm) for e in np.eye(3)]), 0, -1)
                           .reshape(7, 9, 3)], axis=-1)  # fmt: skip
    bent -= np.einsum("mab,mb->ma", pose @ np.linalg.pinv(pose), bent)
    cost = np.einsum("ma,mab,mb->m", bent, pose_error_weights(data, lever), bent)
    assert_allclose(cost / (bent**2).sum(1), cost[0] / (bent[0] ** 2).sum(), rtol=1e-9)
    assert cost[0] >= (bent[0] ** 2).sum() * (1 - 1e-9)


def test_a_pose_without_all_targets_weighs_nothing(rng):
    from minimax_cal.modelling.point_model import pose_error_weights

    y = rng.normal(size=(30, 3, 3))
    y[4, 1] = np.nan
    weight = pose_error_weights(mc.measurements(rng.uniform(-2, 2, (30, 6)), y), 0.3)
    assert np.all(weight[4] == 0.0)
    assert np.all(np.delete(weight, 4, axis=0).any(axis=(1, 2)))
