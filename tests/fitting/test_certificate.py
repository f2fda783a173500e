from dataclasses import dataclass, replace
from functools import partial

import cvxpy as cp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_fit import solve

import minimax_cal as mc
from experiments.speed import identify_parameters
from minimax_cal.core import files
from minimax_cal.core.arrays import Array
from minimax_cal.fitting.cell_fit import AT_BOUND_REASON
from minimax_cal.fitting.minimax_problem import (
    MinimaxProblem,
    PointConeProblem,
    TargetDistanceLimits,
    build_certificate,
    build_minimax_problem,
    measured_distances,
)
from minimax_cal.fitting.parameter_results import Parameter
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.effects.table import Fitted, parse_effect_terms
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import GaussianPrior, PointLeastSquares, PointModel
from minimax_cal.modelling.simulate import Simulation, simulate
from minimax_cal.robots.gravity_torques import assumed_link_masses_and_centres
from minimax_cal.solvers import minimax
from minimax_cal.solvers.dual_bound import LinearisedNorms
from minimax_cal.solvers.minimax import Optimum, Sqp
from minimax_cal.solvers.status import Status
from qp_backends import solve as solve_qp

# ---- certificate ---------------------------------------------------------------------------------


QP = partial(solve_qp, name="daqp", tolerance=1e-10)


@dataclass(frozen=True)
class Setup:
    data: mc.Measurements
    model: PointModel
    start: ParameterValues
    distances: TargetDistanceLimits
    form: str = "two-sided"

    @property
    def worst(self) -> MinimaxProblem:
        return build_minimax_problem(self.model, self.start, self.distances, self.form, "point")

    def sqp(self, **settings: object) -> Optimum[ParameterValues]:
        return minimax.solve(self.worst, self.start, QP, Sqp(**settings))

    def value(self) -> float:
        """The largest distance by the SQP on squared distances [m]."""
        return float(np.sqrt(self.sqp().value * self.worst.size))


def linear_optimum(rows: LinearisedNorms, lower: Array, upper: Array) -> tuple[Array, float]:
    """Step and value of min max |r_i + J_i d|, lower <= c + C d <= upper, by cvxpy."""
    n, w, p = rows.J.shape
    d, t = cp.Variable(p), cp.Variable()
    r = rows.r + cp.reshape(rows.J.reshape(n * w, p) @ d, (n, w), order="C")
    kept = [cp.norm(r, axis=1) <= t]
    kept += [rows.c + rows.C @ d >= lower, rows.c + rows.C @ d <= upper] if len(rows.c) else []
    problem = cp.Problem(cp.Minimize(t), kept)
    problem.solve(solver="CLARABEL", tol_gap_abs=1e-9, tol_gap_rel=1e-9, tol_feas=1e-9)
    return np.asarray(d.value), float(problem.value)


def by_cones(here: Setup) -> float:
    """The largest distance by cone programs stated for cvxpy, until it stands still [m]."""
    points, x, value = PointConeProblem.whiten(here.worst), here.start, np.inf
    for _ in range(20):
        rows = points.linearise(x)
        x = points.step(x, linear_optimum(rows, points.lower, points.upper)[0])
        before, value = value, float(points.linearise(x).norms.max())
        if abs(before - value) <= 1e-9 * value:
            break
    return value * float(np.sqrt(here.worst.size))


def setup(robot: mc.Robot, data: mc.Measurements) -> Setup:
    model, begin = identify_parameters(robot, data)
    start = solve(model, begin).x.take(np.array(0))
    return Setup(data, model, start, measured_distances(data))


def plain(robot: mc.Robot, noisy: Simulation) -> Setup:
    return setup(robot, noisy.data)


def bound_by_distances(robot: mc.Robot, noisy: Simulation) -> Setup:
    """Distances that disagree with the points by 50 um bind."""
    here = setup(robot, noisy.data)
    measured = measured_distances(noisy.data, 1e-6)
    off = np.array([5e-5, -5e-5, 0.0])
    return replace(here, distances=replace(measured, mean=measured.mean + off))


def one_target(robot: mc.Robot, noisy: Simulation) -> Setup:
    return setup(robot, noisy.data.only(0))


def missing(robot: mc.Robot, noisy: Simulation) -> Setup:
    gone = np.random.default_rng(2).uniform(size=(60, 3)) < 0.3
    gone[:, 0] &= ~(gone[:, 1] & gone[:, 2])
    y = np.where(gone[..., None], np.nan, noisy.data.y)
    return setup(robot, noisy.data.with_y(y))


def weighted(robot: mc.Robot, noisy: Simulation) -> Setup:
    u95 = np.random.default_rng(4).uniform(1e-5, 4e-5, 60)
    return setup(robot, replace(noisy.data, columns={**noisy.data.columns, "u95": u95}))


def with_prior(robot: mc.Robot, noisy: Simulation) -> Setup:
    here = setup(robot, noisy.data)
    weight = np.zeros(here.model.names.parameter_count)
    weight[[1, 2, 8]] = 0.3, 0.3, 0.5  # a2, a3, d3: as if known to about a noise length
    return replace(here, model=here.model.with_prior(GaussianPrior(here.model.prior.mean, weight)))


CASES = {
    name.__name__: name
    for name in (plain, bound_by_distances, one_target, missing, weighted, with_prior)
}


@pytest.fixture(scope="module", params=CASES.values(), ids=CASES)
def here(request: pytest.FixtureRequest, robot: mc.Robot, noisy: Simulation) -> Setup:
    found: Setup = request.param(robot, noisy)
    return found


def test_derivatives(here):
    problem, rng = PointConeProblem.whiten(here.worst), np.random.default_rng(0)
    at = problem.step(here.start, rng.normal(size=len(problem.white)))
    rows, step = problem.linearise(at), 1e-4
    for _ in range(3):
        e = rng.normal(size=len(problem.white))
        plus, minus = (problem.linearise(problem.step(at, sign * step * e)) for sign in (1, -1))
        # errors are told in base axes, which a step may turn: only their lengths are compared
        jacobian = (plus.norms - minus.norms) / (2 * step)
        along = np.einsum("nw,nwp,p->n", rows.r, rows.J, e) / rows.norms
        assert_allclose(along, jacobian, rtol=1e-6, atol=1e-6)
        assert_allclose(rows.C @ e, (plus.c - minus.c) / (2 * step), rtol=1e-6, atol=1e-6)


def test_the_certificate_closes_at_an_optimum(here, request):
    best = here.sqp()
    assert_allclose(here.value(), by_cones(here), rtol=1e-8)
    proof = build_certificate(here.worst, best, here.data.line)
    assert best.status is Status.CONVERGED
    assert abs(proof.gap) < 1e-8
    assert proof.kkt.residual < 1e-7
    # the bound is right: the linearised problem's optimum by cvxpy is not below it
    problem = PointConeProblem.whiten(here.worst)
    rows = problem.linearise(best.x)
    _, optimum = linear_optimum(rows, problem.lower, problem.upper)
    assert proof.bound <= optimum * np.sqrt(here.worst.size) * (1 + 1e-8)
    assert_allclose(proof.bound, optimum * np.sqrt(here.worst.size), rtol=1e-7)
    assert_allclose(sum(one.multiplier for one in proof.points), 1.0, rtol=1e-6)
    # distances that bind do so with a multiplier
    if "bound_by_distances" in request.node.name:
        assert np.abs(best.lam).max() > 0.0
        assert np.abs(rows.c).max() > 1.0 - 1e-7

    early = here.sqp(iterations=1)
    proof = build_certificate(here.worst, early, here.data.line)
    assert early.status is Status.ITERATION_LIMIT
    assert proof.gap > 1e-2
    assert proof.bound < build_certificate(here.worst, here.sqp(), here.data.line).value


def test_the_points_that_decide_are_named(robot, noisy):
    here = missing(robot, noisy)
    data = replace(here.data, line=here.data.line + 100)
    best = here.sqp()
    proof = build_certificate(here.worst, best, data.line)
    error = here.model.point_errors(best.x)
    distance = np.linalg.norm(error, axis=-1)
    assert_allclose(proof.value, np.nanmax(distance), rtol=1e-12)
    for one in proof.points:
        assert_allclose(one.distance, proof.value, rtol=1e-6)  # every active point is a largest one
        pose = int(np.flatnonzero(data.line == one.line)[0])
        assert_allclose(one.distance, distance[pose, data.target_names.index(one.target)])
    assert np.all(np.diff([one.multiplier for one in proof.points]) <= 0)
    assert np.count_nonzero(distance > proof.value * (1 - 1e-6)) == len(proof.points)
    text = proof.table().text()
    assert f"{1e3 * proof.value:.4f} mm" in text
    content = files.convert_to_plain_json(proof)
    assert content["points"][0]["line"] == proof.points[0].line
    assert_allclose(content["value_mm"], 1e3 * proof.value)


def test_weights_count_in_the_value_and_not_in_the_distances(robot, noisy):
    here = weighted(robot, noisy)
    best = here.sqp()
    proof = build_certificate(here.worst, best, here.data.line)
    weight = here.model.weight[
        [here.data.target_names.index(one.target) for one in proof.points],
        [int(np.flatnonzero(here.data.line == one.line)[0]) for one in proof.points],
    ]
    distance = np.array([one.distance for one in proof.points])
    assert np.ptp(distance) > 1e-5
    assert_allclose(np.sqrt(weight) * distance, proof.value, rtol=1e-6)


def test_a_certificate_does_not_depend_on_the_scaling(robot, noisy):
    """The problem may be scaled at the answer instead of the start: the multipliers follow."""
    here = bound_by_distances(robot, noisy)
    best = here.sqp()
    again = replace(here, start=best.x).worst
    one, two = (build_certificate(problem, best, here.data.line) for problem in (here.worst, again))
    assert again.size != here.worst.size
    assert_allclose(two.value, one.value, rtol=1e-12)
    assert abs(two.gap) < 1e-8
    for same, other in zip(one.points, two.points, strict=True):
        assert (same.target, same.line) == (other.target, other.line)
        assert_allclose(other.multiplier, same.multiplier, rtol=1e-6)


def test_the_sqp_finds_its_way_from_the_nominal_arm(robot, noisy):
    """Errors of millimetres, not of the fit."""
    model, begin = identify_parameters(robot, noisy.data)
    here = Setup(noisy.data, model, begin, measured_distances(noisy.data))
    assert_allclose(here.value(), by_cones(plain(robot, noisy)), rtol=1e-8)


def test_thousands_of_points(robot):
    """3000 points take the SQP no more programs than 300 do, and its answer is certified."""
    few, many = (setup(robot, simulate(robot, poses, 3, seed=1).data) for poses in (100, 1000))
    assert many.sqp().iterations <= few.sqp().iterations + 3
    proof = build_certificate(many.worst, many.sqp(), many.data.line)
    assert abs(proof.gap) < 1e-8
    points = PointConeProblem.whiten(many.worst)
    _, optimum = linear_optimum(points.linearise(many.sqp().x), points.lower, points.upper)
    assert_allclose(optimum * np.sqrt(many.worst.size), proof.value, rtol=1e-7)


# ---- bounds of effects ---------------------------------------------------------------------------


EFFECTS = ("joint_compliance:J2", "joint_compliance:J3", "encoder_gain:J1")
RISES = "joint_compliance:J3"
IRB = mc.load_robot("irb2600")
MASS, COM = assumed_link_masses_and_centres(IRB.mdh)
ARM = replace(IRB, mass=np.maximum(MASS, 1.0), com=COM)  # told: each joint has one compliance
ALIKE, ROUGHLY = 1e-9, 3e-6  # least squares; what ends by a KKT residual
OBJECTIVES = ("sum", "minimax", "point", "pose")


def measured(compliance: float, seed: int = 0) -> mc.Measurements:
    """An arm whose third joint gives way so much [rad/(N m)], or rises where that is negative."""
    rng = np.random.default_rng(seed)
    plain = mc.simulate(ARM, 60, seed=seed, truth=mc.Truth(compliance=0.0, noise=0.0))
    scene = plain.cell.pose_arm(add_history_columns(plain.data))
    found = parse_effect_terms(scene, EFFECTS)
    values = (np.array([1e-6]), np.array([compliance]), np.array([3e-4]))
    y = replace(plain.cell, effects=Fitted(found, values)).predict(plain.data.q)
    return mc.measurements(plain.data.q, y + 15e-6 * rng.normal(size=y.shape))


def of(fit: mc.Fit, effect: str) -> list[Parameter]:
    return [p for p in fit.parameters if p.name.startswith(effect)]


@pytest.mark.parametrize(
    ("objective", "loss"), [*((objective, "square") for objective in OBJECTIVES), ("sum", "huber")]
)
def test_a_compliance_that_would_be_negative_rests_at_0(objective, loss):
    data = measured(-1e-6)
    fit = mc.calibrate(ARM, data, objective, effects=EFFECTS, loss=loss)
    (rests,) = of(fit, RISES)
    assert rests.value == 0.0
    assert np.isnan(rests.sigma)
    assert (rests.identifiable, rests.reason) == (False, AT_BOUND_REASON)
    (soft,) = of(fit, "joint_compliance:J2")
    assert soft.value > 0.0
    assert soft.sigma > 0.0
    assert AT_BOUND_REASON in fit.summary(width=200)
    if loss != "square":  # its scale counts the parameter that rests
        return
    without = mc.calibrate(ARM, data, objective, effects=EFFECTS[::2])
    alike = ALIKE if objective == "sum" else ROUGHLY
    assert_allclose(fit.robot.mdh, without.robot.mdh, rtol=0, atol=alike)
    assert_allclose(soft.value, of(without, "joint_compliance:J2")[0].value, rtol=1e-3)
    assert fit.accuracy["train"].rms_mm == pytest.approx(without.accuracy["train"].rms_mm, rel=1e-5)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_what_is_positive_is_found_as_without_bounds(objective):
    fit = mc.calibrate(ARM, measured(2e-6), objective, effects=EFFECTS)
    (found,) = of(fit, RISES)
    assert abs(found.value - 2e-6) < 5.0 * found.sigma
    assert not of(fit, RISES)[0].reason


def test_a_fit_at_its_bounds_is_the_best_between_them():
    """Its slope pulls no parameter that is free, and those at a bound beyond it."""
    data = measured(-1e-6)
    fit = mc.calibrate(ARM, data, "sum", effects=EFFECTS)
    model = fit.estimator.model
    rests = model.names.geometric_count + 1
    assert not model.active[rests]
    every = model.with_active(model.active | (np.arange(model.names.parameter_count) == rests))
    _, slope, gram = PointLeastSquares(every).normal(fit.cell.parameter_values)
    slope = slope / np.sqrt(np.diag(gram))
    here = np.flatnonzero(every.active) == rests
    assert slope[here] < -1e-5
    assert np.abs(slope[~here]).max() < 1e-7
