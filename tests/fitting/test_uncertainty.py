"""Covariances of parameters and positions: dense closed forms, refits, simulation, invariance."""

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments import coverage
from experiments.coverage import position_covariance
from minimax_cal.core.arrays import Array
from minimax_cal.fitting import uncertainty
from minimax_cal.fitting.cell_fit import CellFit, fit_cell
from minimax_cal.fitting.options import Options, silent_progress
from minimax_cal.fitting.uncertainty import (
    Estimator,
    PosewiseFit,
    estimate_uncertainty,
    jackknife_covariance_over_poses,
    noise_covariance,
    point_weights_from_multipliers,
    position_confidence_radius,
    position_covariance_factor,
    student_quantile,
    uncertainty_from_dict,
)
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.parameters import ParameterValues, flatten_link_parameters
from minimax_cal.modelling.point_model import GaussianPrior, pose_error_weights
from minimax_cal.modelling.simulate import Simulation, Truth, simulate
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.selection.noise_model import Noise

NOISE = Noise(0.5, (20e-6) ** 2, 15e-6)
H = 1e-6  # step of the central differences [m, rad]: errors of 1e-9 relative
SLOPES = 1e-6  # tolerance of what is compared with them


def fitted(robot: mc.Robot, data: Measurements, **options: object) -> CellFit:
    chosen = Options(**{"objective": "sum", **options})
    return fit_cell(robot, data, chosen, silent_progress)


@pytest.fixture(scope="module")
def fit(robot: mc.Robot, noisy: Simulation) -> CellFit:
    return fitted(robot, noisy.data)


@pytest.fixture(scope="module")
def result(robot: mc.Robot, noisy: Simulation) -> mc.Fit:
    return mc.calibrate(robot, noisy.data, "sum", holdout=0.0)


def differences(fun: Callable[[Array], Array], count: int, h: float = H) -> Array:
    """Derivatives (..., count) of a function of (count,) numbers at zero."""
    steps = h * np.eye(count)
    return np.stack([(fun(step) - fun(-step)) / (2 * h) for step in steps], axis=-1)


def predictor(robot: mc.Robot, found: CellFit, targets: tuple[str, ...], q: Array):
    """Points (m, k, 3) in the instrument's frame after a step in all parameters."""

    def points(step: Array) -> Array:
        return Cell.from_parameters(robot, found.state.step(step), targets).predict(q)

    return points


def dense(robot: mc.Robot, data: Measurements, found: CellFit) -> tuple[Array, Array, Array]:
    """Slopes J (m, 3k, p) and arms S (m, 3k, n) by differences, errors (m, 3k), as measured."""
    m, k = data.poses, len(data.target_names)
    points = predictor(robot, found, data.target_names, data.q)
    J = differences(points, found.names.parameter_count)[..., found.identification.active]
    cell = Cell.from_parameters(robot, found.state, data.target_names)
    S = differences(lambda turn: cell.predict(data.q + turn), robot.joints)
    error = data.y - cell.predict(data.q)
    return J.reshape(m, 3 * k, -1), S.reshape(m, 3 * k, -1), error.reshape(m, 3 * k)


def sandwich(J: Array, A: Array, V: Array, prior: Array) -> Array:
    """H^-1 F H^-1, pose by pose from dense matrices.  A, V: (m, 3k, 3k)."""
    turned = np.swapaxes(J, 1, 2)
    normal_matrix = np.linalg.inv((turned @ A @ J).sum(axis=0) + np.diag(prior))
    score_covariance = (turned @ A @ V @ A @ J).sum(axis=0)
    return np.asarray(normal_matrix @ score_covariance @ normal_matrix)


def alike(found: Array, expected: Array, tolerance: float) -> None:
    """Covariances agree, each entry relative to its two sigmas."""
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert_allclose(found / scale, expected / scale, rtol=0, atol=tolerance)


# ---- parameters ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["sum", "shares", "u95", "pose", "missing", "slide"])
def test_the_sandwich_is_the_dense_one(kind, robot, noisy, rng):
    """Every way to weigh the points, with noise and jitter, against dense matrices."""
    data, k = noisy.data, 3
    if kind == "slide":
        robot = mc.load_robot("scara_600")
        data = simulate(robot, 40, 3, seed=2).data
    if kind == "u95":
        u95 = 1e-5 * rng.uniform(1.0, 4.0, data.poses)
        data = replace(data, columns={**data.columns, "u95": u95})
    if kind == "missing":
        y = data.y.copy()
        y[::3, 1] = np.nan
        data = data.with_y(y)
    found = fitted(robot, data)
    model = found.estimator.model
    share = np.array([0.2, 3.0, 0.7]) if kind == "shares" else np.ones(k)
    estimator = Estimator(model, share)
    weight = np.repeat(model.weight.T, 3, axis=1)
    A = np.eye(9) * (weight * np.repeat(share, 3))[:, None]
    J, S, _ = dense(robot, replace(data, y=np.nan_to_num(data.y)), found)
    if kind == "pose":
        A = pose_error_weights(data, 0.4)
        estimator = Estimator(model, share, A)
    inverse = np.where(weight > 0.0, 1.0 / np.where(weight > 0.0, weight, 1.0), 0.0)
    V = NOISE.variance * np.eye(9) * inverse[:, None]
    V = V + NOISE.joint_jitter**2 * S @ np.swapaxes(S, 1, 2)
    found_covariance = noise_covariance(PosewiseFit(estimator, found.state), NOISE)
    alike(found_covariance, sandwich(J, A, V, np.zeros(J.shape[-1])), SLOPES)


def test_one_target_alone_is_weighed_once(robot, noisy):
    """The others' share stands beside the instrument's weights, not in them too."""
    found = fitted(robot, noisy.data, objective="smr:2")
    assert np.all(found.estimator.model.weight == 1.0)
    assert found.estimator.share[1] == 1.0
    assert np.all(found.estimator.share[[0, 2]] < 1e-6)


def test_leaving_out_each_pose_is_the_jackknife(robot, noisy, fit):
    """The linear least squares of all poses but one, solved anew each time."""
    J, _, error = dense(robot, noisy.data, fit)
    m, _, p = J.shape
    whole = np.linalg.lstsq(J.reshape(-1, p), error.reshape(-1), rcond=None)[0]
    change = []
    for pose in range(m):
        kept = np.arange(m) != pose
        part = np.linalg.lstsq(J[kept].reshape(-1, p), error[kept].reshape(-1), rcond=None)[0]
        change.append(part - whole)
    expected = (m - 1) / m * np.array(change).T @ np.array(change)
    found = jackknife_covariance_over_poses(PosewiseFit(fit.estimator, fit.state), np.arange(m))
    alike(found, expected, 1e-5)


def test_a_pose_measured_twice_is_one_pose(robot, noisy):
    """Rows that stand twice: nothing is known better by the poses, all by the noise."""
    data = noisy.data
    twice = data.take(np.repeat(np.arange(data.poses), 2))
    once, both = fitted(robot, data), fitted(robot, twice)
    assert both.uncertainty.source == "poses"
    inside = np.ix_(once.identification.active, once.identification.active)
    alike(both.uncertainty.covariance[inside], once.uncertainty.covariance[inside], 1e-6)
    halves = [
        noise_covariance(PosewiseFit(f.estimator, f.state), Noise(0.0, 1.0, 0.0))
        for f in (once, both)
    ]
    alike(2.0 * halves[1], halves[0], 1e-6)


def test_a_prior_is_knowledge(robot, noisy, fit):
    """With noise of one kind: (J'J / s^2 + 1 / sigma^2)^-1, Bayes' rule for the linear model."""
    model = fit.estimator.model
    weight = np.zeros(model.names.parameter_count)
    at = [model.names.index_of_name(name) for name in ("a2", "theta3")]
    weight[at] = 1e3
    told = model.with_prior(GaussianPrior(model.prior.mean, weight))
    poses = PosewiseFit(Estimator(told, np.ones(3)), fit.state)
    s = np.sqrt(poses.mean_square)
    J, _, error = dense(robot, noisy.data, fit)
    assert s == pytest.approx(np.sqrt((error**2).mean()), rel=0.05)  # but for degrees of freedom
    flat = J.reshape(-1, J.shape[-1])
    sigma = np.divide(s, np.sqrt(weight), out=np.full_like(weight, np.inf), where=weight > 0)
    bayes = np.linalg.inv(flat.T @ flat / s**2 + np.diag(1.0 / sigma[model.active] ** 2))
    alike(noise_covariance(poses, Noise(0.0, s**2, 0.0)), bayes, SLOPES)
    group = np.arange(len(poses.error))
    wide = jackknife_covariance_over_poses(
        PosewiseFit(Estimator(model, np.ones(3)), fit.state), group
    )
    held = jackknife_covariance_over_poses(poses, group)
    place = [list(np.flatnonzero(model.active)).index(i) for i in at]
    assert np.all(np.diag(held)[place] < 0.5 * np.diag(wide)[place])
    assert np.all(np.sqrt(np.diag(held)[place]) < 1.5 * sigma[at])


def test_a_tight_prior_keeps_its_sigma(robot, noisy):
    """What the data cannot improve is as sure as the prior says: within 2 %."""
    found = mc.calibrate(robot, noisy.data, "sum", holdout=0.0, priors={"a2": 1e-7})
    sigma = next(p.sigma for p in found.parameters if p.name == "a2")
    assert sigma == pytest.approx(1e-7, rel=0.02)


def test_both_noises_are_found_whatever_the_weights(robot):
    """Means over eight runs: noise and jitter that went in, within 12 %; so with 4-fold u95."""
    truth = Truth(compliance=0.0, noise=15e-6, noise_per_metre=0.0)
    found = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        made = simulate(robot, 80, 3, 3, truth)
        q = random_joint_values_above_floor(robot, 80, rng)
        coarse = np.where(np.arange(80) % 2 == 0, 1.0, 4.0)
        y = made.cell.predict(q + 10e-6 * rng.normal(size=q.shape))
        y = y + truth.noise * coarse[:, None, None] * rng.normal(size=y.shape)
        one = fitted(robot, mc.measurements(q, y, u95=2 * truth.noise * coarse))
        usual = np.median(coarse)  # weights are relative to the typical u95
        noise = one.uncertainty.noise
        found.append((np.sqrt(noise.variance) / (truth.noise * usual), noise.joint_jitter / 10e-6))
    assert_allclose(np.mean(found, axis=0), 1.0, rtol=0, atol=0.12)


@pytest.mark.parametrize(("objective", "runs"), [("sum", 24), ("minimax", 12)])
def test_jitter_raises_sigma_as_it_raises_the_scatter(robot, objective, runs):
    """Runs at the same poses, with strong jitter: sigma by either way is the true scatter.

    The scatter of one parameter is known to 1/sqrt(2 R); of 33, say 10 that are independent, to
    1/sqrt(20 R): three times that, after the few-pose bias of `jackknife_covariance_over_poses`, 3
    %.
    """
    truth = Truth(compliance=0.0, noise_per_metre=0.0)
    made = simulate(robot, 60, 3, 4, truth)
    scores = {"poses": [], "noise": []}
    exact = fitted(robot, made.data.with_y(made.cell.predict(made.data.q)))
    active = exact.identification.active
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        y = made.cell.predict(made.data.q + 30e-6 * rng.normal(size=made.data.q.shape))
        y = y + truth.noise * rng.normal(size=y.shape)
        one = fitted(robot, made.data.with_y(y), objective=objective)
        off = step_between(exact.state, one.state)[active]
        poses = PosewiseFit(one.estimator, one.state)
        known = np.sqrt(np.diag(noise_covariance(poses, one.uncertainty.noise)))
        scores["poses"].append(off / one.uncertainty.sigma[active])
        scores["noise"].append(off / known)
    for kind, bias in (("noise", 0.0), ("poses", 0.03)):
        mean = np.sqrt(np.mean(np.square(scores[kind])))
        assert abs(mean + bias - 1.0) < 3.0 / np.sqrt(20 * runs)
    # as if all errors were independent, sigma would be far too small
    blind = np.sqrt(
        np.diag(noise_covariance(poses, Noise(0.0, one.uncertainty.noise.variance, 0.0)))
    )
    assert np.median(known / blind) > 1.5


def step_between(start: ParameterValues, end: ParameterValues) -> Array:
    turn = Rotation.from_matrix(start.rotation.T @ end.rotation).as_rotvec()
    move = start.rotation.T @ (end.origin - start.origin)
    spots = (end.target_positions - start.target_positions).reshape(-1)
    return np.concatenate([flatten_link_parameters(end.mdh - start.mdh), move, turn, spots])


def test_sigma_does_not_depend_on_where_the_instrument_stands(robot, noisy, result):
    turn = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    y = noisy.data.y @ turn.T + [4.0, -2.0, 1.0]
    moved = mc.calibrate(robot, noisy.data.with_y(y), "sum", holdout=0.0)
    active = result.uncertainty.active
    inside = np.ix_(active, active)
    alike(moved.uncertainty.covariance[inside], result.uncertainty.covariance[inside], 1e-6)
    q = noisy.data.q[:7]
    before = position_covariance(result.cell, result.uncertainty, q)
    after = position_covariance(moved.cell, moved.uncertainty, q)
    assert_allclose(after, turn @ before @ turn.T, rtol=0, atol=1e-6 * before.max())
    own = [position_covariance(f.cell, f.uncertainty, q, "base") for f in (result, moved)]
    assert_allclose(own[1], own[0], rtol=0, atol=1e-6 * own[0].max())


def test_a_fit_that_needs_every_pose_asks_the_noise(robot):
    data = simulate(robot, 60, 1, seed=12, truth=Truth(compliance=0)).data
    few = fitted(robot, data.take(np.arange(10)))
    assert few.uncertainty.source == "noise"
    assert np.all(few.uncertainty.sigma[few.identification.active] > 0.0)
    assert fitted(robot, data).uncertainty.source == "poses"


def test_without_spare_rows_nothing_is_known(robot, noisy, fit):
    estimator = fit.estimator.at_poses(np.arange(3))
    found = estimate_uncertainty(estimator, fit.state, np.arange(3))
    assert np.isnan(found.covariance).all()
    assert found.to_dict()["names"] == []


def test_many_poses_are_thinned_fairly(robot, monkeypatch):
    """A quarter of the poses tells the covariance of all: sigma within 15 %, the median 5 %."""
    data = simulate(robot, 600, 1, 5, Truth(compliance=0)).data
    found = fitted(robot, data)
    whole = found.uncertainty.sigma[found.identification.active]
    monkeypatch.setattr(uncertainty, "MAX_THINNED_POSES", 150)
    part = estimate_uncertainty(found.estimator, found.state, found.group).sigma
    ratio = part[found.identification.active] / whole
    assert_allclose(ratio, 1.0, rtol=0, atol=0.4)
    assert abs(np.median(ratio) - 1.0) < 0.1


def test_points_of_a_worst_point_fit_weigh_by_their_multipliers():
    seen = np.array([[True, False, True], [True, True, True]])
    share = point_weights_from_multipliers(np.array([0.6, 0.0, 0.4, 0.0, 0.0]), seen)
    least = uncertainty.MIN_POINT_WEIGHT
    assert_allclose(share, [[3.0, 0.0, least], [2.0, least, least]])


def test_worst_point_sigma_is_larger_than_that_of_the_sum(robot, noisy, result):
    point = mc.calibrate(robot, noisy.data, "point", holdout=0.0)
    assert point.uncertainty.source == "noise"
    active = result.uncertainty.active
    ratio = point.uncertainty.sigma[active] / result.uncertainty.sigma[active]
    assert np.median(ratio) > 1.2


def test_correlation_and_root(result):
    known = result.uncertainty
    inside = np.ix_(known.active, known.active)
    assert_allclose(np.diag(known.correlation)[known.active], 1.0, rtol=1e-12)
    assert np.nanmax(np.abs(known.correlation)) <= 1.0 + 1e-9
    alike((known.covariance_root @ known.covariance_root.T)[inside], known.covariance[inside], 1e-9)
    assert_allclose(
        student_quantile(0.95, known.dof), 1.96, rtol=0, atol=0.01
    )  # many degrees of freedom


# ---- positions -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def anywhere(robot: mc.Robot) -> Array:
    return random_joint_values_above_floor(robot, 6, np.random.default_rng(8))


def test_position_covariance_is_that_of_the_prediction(robot, noisy, fit, anywhere):
    """Central differences of the predicted points by all parameters, in both frames."""
    known, targets = fit.uncertainty, noisy.data.target_names
    cell = Cell.from_parameters(robot, fit.state, targets)
    active = known.active
    C = known.covariance[np.ix_(active, active)]
    points = predictor(robot, fit, targets, anywhere)

    def own(step: Array) -> Array:
        other = Cell.from_parameters(robot, fit.state.step(step), targets)
        return replace(other, base=np.eye(4)).predict(anywhere)

    for frame, place in (("measurement", points), ("base", own)):
        J = differences(place, fit.names.parameter_count)[..., active]
        expected = J @ C @ np.swapaxes(J, -1, -2)
        found = position_covariance(cell, known, anywhere, frame)
        assert found.shape == (6, 3, 3, 3)
        assert_allclose(found, expected, rtol=0, atol=SLOPES * expected.max())
        factor = position_covariance_factor(cell, known, anywhere, frame).mean(
            axis=1
        )  # of the centroid
        expected = (middle := J.mean(axis=1)) @ C @ np.swapaxes(middle, -1, -2)
        found = factor @ np.swapaxes(factor, -1, -2)
        assert_allclose(found, expected, rtol=0, atol=SLOPES * expected.max())


@pytest.mark.parametrize("frame", uncertainty.POSITION_FRAMES)
def test_jitter_of_a_new_pose_is_added(frame, result, anywhere):
    cell = result.cell if frame == "measurement" else replace(result.cell, base=np.eye(4))
    S = differences(lambda turn: cell.predict(anywhere + turn), 6)
    still, moving = (
        position_covariance(result.cell, result.uncertainty, anywhere, frame, with_jitter=jitter)
        for jitter in (False, True)
    )
    expected = result.uncertainty.noise.joint_jitter**2 * S @ np.swapaxes(S, -1, -2)
    assert expected.max() > 0.0
    assert_allclose(moving - still, expected, rtol=0, atol=SLOPES * moving.max())


@pytest.mark.parametrize("free", [["d6"], ["theta6", "alpha6"], ["a6", "beta4"], ["d1", "theta1"]])
@pytest.mark.parametrize("targets", [1, 3])
def test_which_redundant_parameter_is_kept_does_not_matter(free, targets, robot, anywhere):
    """Positions in the measurement frame are as sure, whichever member of a family is fitted.

    So are those in the base frame, unless the base's own parameters were exchanged: that frame
    then is another one.  To 1e-5 of the largest variance: both fits end within 1e-12 m, and H is
    inverted with a condition of 1e6.
    """
    data = simulate(robot, 60, targets, seed=21).data
    plain, other = (mc.calibrate(robot, data, "sum", holdout=0.0, free=f) for f in ([], free))
    names = [{p.name for p in f.parameters if p.identifiable} for f in (plain, other)]
    assert set(free) <= names[1] - names[0]
    for frame in uncertainty.POSITION_FRAMES:
        one, two = (
            position_covariance(f.cell, f.uncertainty, anywhere, frame) for f in (plain, other)
        )
        same = frame == "measurement" or "d1" not in free
        apart = np.abs(one - two).max() / one.max()
        assert apart < 1e-5 if same else apart > 1e-3


def test_positions_move_as_effects_do(robot, noisy, anywhere):
    """A fit with a compliance: its sigma enters, by differences of the cell's own prediction."""
    result = mc.calibrate(robot, noisy.data, "sum", holdout=0.0, effects="joint_compliance:J2")
    known, (values,) = result.uncertainty, result.cell.effects.values
    place = np.arange(known.names.geometric_count, known.names.parameter_count)
    told = known.active[place]  # one of the three would be negative, and rests at 0
    place = place[told]
    assert told.sum() == 2
    assert known.units[-1] == "rad/(N m)"
    C = known.covariance[np.ix_(place, place)]
    alone = np.full_like(known.covariance, np.nan)
    alone[np.ix_(place, place)] = C
    found = position_covariance(result.cell, replace(known, covariance=alone), anywhere)
    h = 1e-3 * np.abs(values).max()

    def points(step: Array) -> Array:
        effects = replace(result.cell.effects, values=(values + step,))
        return replace(result.cell, effects=effects).predict(anywhere)

    J = differences(points, len(values), h)[..., told]
    expected = J @ C @ np.swapaxes(J, -1, -2)
    # columns are of first order at the fit: a turn of 1e-3 rad bends them by as much
    assert_allclose(found, expected, rtol=0, atol=5e-3 * expected.max())


def test_positions_in_many_chunks(result, anywhere, monkeypatch):
    whole = position_covariance(result.cell, result.uncertainty, anywhere)
    monkeypatch.setattr(uncertainty, "POSITION_CHUNK", 4)
    parts = position_covariance(result.cell, result.uncertainty, anywhere)
    assert_allclose(parts, whole, rtol=1e-12)
    one = position_covariance(result.cell, result.uncertainty, anywhere[0])
    assert_allclose(one[0], whole[0], rtol=1e-12)


def test_a_frame_that_does_not_exist(result, anywhere):
    with pytest.raises(mc.OptionError, match="no frame 'world'; choose measurement or base"):
        position_covariance(result.cell, result.uncertainty, anywhere, "world")


def test_radius_that_holds_a_share(rng):
    """Closed forms, and a million samples of a skew covariance within 1 %."""
    assert position_confidence_radius(np.diag([4.0, 0.0, 0.0])) == pytest.approx(
        2.0 * 1.959964, rel=1e-6
    )
    assert position_confidence_radius(np.eye(3)) == pytest.approx(2.795483, rel=1e-6)
    assert position_confidence_radius(np.zeros((2, 3, 3))).tolist() == [0.0, 0.0]
    root = rng.normal(size=(3, 3)) * [3.0, 1.0, 0.4]
    points = rng.normal(size=(10**6, 3)) @ root.T
    sampled = np.quantile(np.linalg.norm(points, axis=1), 0.95)
    assert position_confidence_radius(root @ root.T) == pytest.approx(sampled, rel=0.01)


# ---- saved fits ----------------------------------------------------------------------------------


def test_the_saved_block_is_in_millimetres(result):
    block = result.uncertainty.to_dict()
    json.dumps(block, allow_nan=False)
    sigma = {p.name: p.sigma for p in result.parameters}
    for i, (name, unit) in enumerate(zip(block["names"], block["units"], strict=True)):
        scale = 1e3 if unit == "mm" else 1.0
        assert block["rows"][i][i] == pytest.approx((scale * sigma[name]) ** 2, rel=1e-9)
    assert set(block["units"]) == {"mm", "rad"}


@pytest.mark.parametrize(
    ("change", "say"),
    [
        (lambda c: c["covariance"].update(names=["a1"]), "does not fit"),
        (lambda c: c["covariance"].update(rows=[[1.0]]), "does not fit"),
        (lambda c: c["covariance"].update(rows="none"), "does not fit"),
        (lambda c: c["covariance"].update(noise_mm=None), "does not fit"),
        (lambda c: c["covariance"]["rows"][0].__setitem__(1, 99.0), "no symmetric matrix"),
        (lambda c: c.clear(), "does not hold a covariance"),
    ],
)
def test_a_broken_block_is_told(change, say, result):
    content = {"covariance": result.uncertainty.to_dict()}
    change(content)
    with pytest.raises(mc.CalibrationError, match=say) as caught:
        uncertainty_from_dict(content, result.cell, "fit.json")
    assert "\n" not in str(caught.value)


# ---- the study of coverage -----------------------------------------------------------------------


def test_coverage_is_counted(rng):
    """Normal errors with sigmas right and half: 95 % and 67.3 %, within the band and not."""
    runs, width = 1000, 1.959964
    error = rng.normal(size=(runs, 3))
    sigma = np.stack([np.ones((runs, 3)), np.full((runs, 3), 0.5)], axis=1)
    none = np.zeros((runs, 1))
    made = coverage.RunResults(
        ("a", "b", "c"), 0, error, sigma, np.full(runs, width), none, none, none
    )
    assert_allclose(coverage.parameter_coverages(made, 0), 0.95, atol=0.03)
    assert_allclose(coverage.parameter_coverages(made, 1), 0.673, atol=0.06)
    assert coverage.list_parameters_outside_band(made, 0) == []
    assert coverage.list_parameters_outside_band(made, 1) == ["a", "b", "c"]
    low, high = coverage.binomial_coverage_band(400)
    counts = np.random.default_rng(0).binomial(400, 0.95, 200_000) / 400
    assert np.mean((counts < low) | (counts > high)) <= 0.001 + 4 * np.sqrt(0.001 / 200_000)
