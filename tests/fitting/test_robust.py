"""Robust fits: against scipy's losses, against fits that know the wrong points, in closed form."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_robust import EVEN, EXACT, FITTER, NOISE, Case, case_of, directions, shifted, state_of
from scipy import integrate, optimize, stats

import minimax_cal as mc
from minimax_cal import solvers
from minimax_cal.core.arrays import Array
from minimax_cal.fitting import robust_fit
from minimax_cal.fitting.minimax_problem import build_minimax_problem, measured_distances
from minimax_cal.fitting.outliers import reject_by_false_discovery_rate
from minimax_cal.fitting.robust_fit import (
    LOSSES,
    WeightedFit,
    fit_robust_loss,
    loss_moments,
    weighted_point_distances,
)
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import GaussianPrior
from minimax_cal.modelling.simulate import Simulation, Truth, simulate
from minimax_cal.solvers.minimax import Sqp
from minimax_cal.solvers.status import Status
from qp_backends import solve as solve_qp

# ---- robust --------------------------------------------------------------------------------------


RHO = {  # rho(u) with rho'(u) = u weight(u), written down anew
    "huber": lambda u: np.where(u < 1.0, u**2 / 2.0, u - 0.5),
    "cauchy": lambda u: np.log1p(u**2) / 2.0,
    "tukey": lambda u: (1.0 - np.maximum(1.0 - u**2, 0.0) ** 3) / 6.0,
}


# ---- the losses ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LOSSES)
def test_weight_and_slope_are_derivatives_of_the_loss(name):
    u, step = np.linspace(0.05, 2.5, 51), 1e-6  # no knot of a loss is on this grid
    weight = (RHO[name](u + step) - RHO[name](u - step)) / (2.0 * step) / u
    assert_allclose(LOSSES[name].weight(u), weight, atol=1e-8)
    psi = LOSSES[name].weight(u + step) * (u + step) - LOSSES[name].weight(u - step) * (u - step)
    assert_allclose(LOSSES[name].derivative(u), psi / (2.0 * step), atol=1e-8)


@pytest.mark.parametrize("name", LOSSES)
def test_losses_are_95_percent_efficient_in_three_dimensions(name):
    """(E psi')^2 / E psi^2, integrated over the chi distribution with three degrees of freedom."""
    loss = LOSSES[name]

    def mean(function: object) -> float:
        parts = ((0.0, loss.tuning), (loss.tuning, 40.0))
        return sum(
            integrate.quad(lambda r: float(function(r)) * stats.chi.pdf(r, 3), *part)[0]
            for part in parts
        )

    def derivative(r: float) -> Array:
        u = np.array(r / loss.tuning)
        return (loss.derivative(u) + 2.0 * loss.weight(u)) / 3.0

    def square(r: float) -> Array:
        return (r * loss.weight(np.array(r / loss.tuning))) ** 2 / 3.0

    assert mean(derivative) ** 2 / mean(square) == pytest.approx(0.95, abs=1e-4)


# ---- the same optimum as other solvers find --------------------------------------------------


FREE = ("a2", "a3", "theta2", "theta3", "theta4", "theta5", "alpha3", "smr1_x", "smr1_y", "smr1_z")


@pytest.fixture(scope="module")
def small(robot: mc.Robot) -> Case:
    """Ten parameters of an arm that is otherwise known, one target, a tight prior on a2."""
    case = shifted(robot, 0.1, 2e-4, poses=30, targets=1, seed=2)
    cell, names = case.made.cell, case.model.names
    active = np.isin(names.all_names, FREE)
    weight = np.zeros(names.parameter_count)
    weight[names.index_of_name("a2")] = (NOISE / 1e-5) ** 2
    model = case.model.with_active(active).with_prior(GaussianPrior(case.model.prior.mean, weight))
    truth = cell.parameter_values
    model, found = FITTER(model, truth)
    return replace(case, model=model, found=found)


def moved(case: Case, x: Array) -> ParameterValues:
    """The plain fit moved by steps of the free parameters [0.1 mm, 0.1 mrad].

    Nothing of the base is free: steps simply add up.
    """
    step = np.zeros(case.model.names.parameter_count)
    step[case.model.active] = 1e-4 * x
    return state_of(case.found).step(step)


def residuals(case: Case, x: Array, unit: float) -> Array:
    """Distances, and the prior's roots [unit]."""
    state = moved(case, x)
    off = np.sqrt(case.model.prior.weight) * (
        case.model.parameter_vector(state) - case.model.prior.mean
    )
    return (
        np.concatenate([weighted_point_distances(case.model, state)[case.model.measured_mask], off])
        / unit
    )


def slopes(case: Case, x: Array, unit: float) -> Array:
    """Their derivatives (n, free)."""
    model, state = case.model, moved(case, x)
    rows = model.point_jacobian(state)[..., model.active]
    error = model.point_errors(state)
    along = error / np.linalg.norm(error, axis=-1, keepdims=True)
    far = -np.einsum("mkcp,mkc->kmp", rows, along)[model.measured_mask]
    prior = np.diag(np.sqrt(model.prior.weight))[:, model.active]
    return np.concatenate([far, prior]) * 1e-4 / unit


@pytest.mark.parametrize("name", LOSSES)
def test_nothing_near_is_better(small, name):
    """BFGS on the sum of rho and the prior comes from beside the answer back to it."""
    found = small.robust(name)
    unit = found.loss_scale * LOSSES[name].tuning
    points = int(small.model.measured_mask.sum())

    def objective(x: Array) -> float:
        parts = residuals(small, x, unit)
        return float(RHO[name](parts[:points]).sum() + 0.5 * (parts[points:] ** 2).sum())

    def gradient(x: Array) -> Array:
        u = residuals(small, x, unit)
        psi = np.append(u[:points] * LOSSES[name].weight(u[:points]), u[points:])
        return slopes(small, x, unit).T @ psi

    values = [
        small.model.parameter_vector(state_of(one)) for one in (found.least_squares, small.found)
    ]
    ours = (values[0] - values[1])[small.model.active] / 1e-4
    beside = ours + 0.05 * np.random.default_rng(0).normal(size=len(ours))
    other = optimize.minimize(
        objective, beside, jac=gradient, method="BFGS", options={"gtol": 1e-7, "maxiter": 500}
    )
    assert objective(ours) == pytest.approx(other.fun, rel=1e-8)
    gap = residuals(small, other.x, NOISE)[:points] - residuals(small, ours, NOISE)[:points]
    assert np.abs(gap).max() < 1e-4  # of the noise
    assert np.abs(ours).max() > 0.01  # and it is not where least squares is


# ---- wrong points do not matter --------------------------------------------------------------


@pytest.mark.parametrize(("loss", "trim"), [("tukey", 0.0), ("square", 0.25), ("cauchy", 0.25)])
@pytest.mark.parametrize("size", [1e-3, 1.0])
def test_a_fifth_of_wrong_points_does_no_harm(robot, loss, trim, size):
    case = shifted(robot, 0.2, size)
    found = case.robust(loss, trim)
    assert found.least_squares.status[0] == "converged"
    knowing = case.miss(case.without())
    assert case.miss(state_of(found.least_squares)) < 1.25 * knowing
    assert case.miss(state_of(case.found)) > 5.0 * knowing
    assert_allclose(found.scale, NOISE, rtol=0.15)
    assert (case.listed(found) >= case.bad).all()
    assert found.weights[case.bad].max() < 0.01


@pytest.mark.parametrize(("loss", "trim", "most"), [
    ("tukey", 0.0, 1e-9), ("square", 0.25, 1e-9), ("cauchy", 0.0, 1e-8), ("huber", 0.0, 1e-6),
])  # fmt: skip
def test_without_noise_the_truth_is_found(robot, loss, trim, most):
    case = shifted(robot, 0.2, 1e-3, truth=EXACT)
    found = case.robust(loss, trim)
    assert case.miss(state_of(found.least_squares)) < most
    assert (case.listed(found) == case.bad).all()


@pytest.mark.parametrize("loss", LOSSES)
def test_clean_points_are_fitted_as_by_least_squares(robot, loss):
    case = shifted(robot, 0.0, 0.0, poses=80)
    found = case.robust(loss)
    off = np.linalg.norm(case.model.point_errors(state_of(found.least_squares))
                         - case.model.point_errors(state_of(case.found)), axis=-1)  # fmt: skip
    assert np.sqrt(np.mean(off**2)) < 0.3 * NOISE
    assert_allclose(found.scale, NOISE, rtol=0.1)
    aside = case.robust(trim=0.1)
    assert aside.weights.all() == (not aside.suspects)


def test_one_target(robot):
    case = shifted(robot, 0.1, 1e-3, poses=60, targets=1)
    for found in (case.robust("tukey"), case.robust(trim=0.15)):
        assert (case.listed(found) == case.bad).all()
        assert case.miss(state_of(found.least_squares)) < 1.3 * case.miss(case.without())
        assert not any(one.together for one in found.suspects)


def test_missing_points(robot):
    """A third of the points was not measured; of some poses one target is left."""
    full = shifted(robot, 0.1, 1e-3, poses=60)
    y = full.data.y.copy()
    gone = np.random.default_rng(3).uniform(size=full.bad.T.shape) < 1.0 / 3.0
    gone[gone.all(axis=1), 0] = False
    y[gone] = np.nan
    case = case_of(robot, full.made, full.data.with_y(y), full.bad.T & ~gone)
    found = case.robust("tukey")
    assert (found.weights[gone.T] == 0.0).all()
    assert (case.listed(found) == case.bad).all()
    alone = (~gone).sum(axis=1) == 1
    lines = case.data.line[alone]
    assert not any(one.together for one in found.suspects if one.line in lines)
    aside = case.robust(trim=0.2)
    assert_allclose(aside.model.pose_counts_by_target, (~gone.T & ~case.bad).sum(axis=1))


def test_weights_of_the_instrument_stay(robot):
    """Points of a tenth the accuracy are no suspects when u95 says so, and wrong good ones are."""
    made = simulate(robot, 60, 3, 0, EVEN)
    rng = np.random.default_rng(0)
    rough, wrong = np.arange(60) % 3 == 0, np.arange(60) % 10 == 1
    y = made.data.y + 9.95 * NOISE * rough[:, None, None] * rng.normal(size=made.data.y.shape)
    y[wrong, 0] += [5e-4, 0.0, 0.0]
    bad = np.zeros((60, 3), dtype=bool)
    bad[wrong & ~rough, 0] = True
    u95 = np.where(rough, 10.0, 1.0) * 2.8 * NOISE
    data = replace(made.data.with_y(y), columns={**made.data.columns, "u95": u95})
    told = case_of(robot, made, data, bad)
    found = told.robust("tukey")
    assert (told.listed(found) == told.bad).all()
    assert_allclose(found.model.weight, told.model.weight * found.weights)
    assert_allclose(found.scale, NOISE, rtol=0.1)  # of a point with the typical u95
    assert told.miss(state_of(found.least_squares)) < 1.3 * told.miss(told.without())


def few_that_tell_the_wrist(
    robot: mc.Robot, wrist: tuple[float, ...], wrong: int, turn: float, seed: int, targets: int
) -> Case:
    """Joint 5 stands still but for the first poses; at `wrong` of these joint 2 is misread."""
    made = simulate(robot, 60, targets, seed, EVEN)
    rng = np.random.default_rng(seed)
    q = made.data.q.copy()
    q[:, 4] = 0.3 + 0.02 * rng.normal(size=60)
    q[: len(wrist), 4] = wrist
    true = q.copy()
    true[:wrong, 1] += turn
    y = made.cell.predict(true) + NOISE * rng.normal(size=made.data.y.shape)
    bad = np.zeros((60, targets), dtype=bool)
    bad[:wrong] = True
    return case_of(robot, made, replace(made.data, q=q, y=y), bad)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_bad_pose_that_draws_the_fit_to_itself(robot, seed):
    case = few_that_tell_the_wrist(robot, (-1.2,), 1, 2e-3, seed, 1)
    plain = weighted_point_distances(case.model, state_of(case.found))[0]
    assert (plain > plain[0]).sum() > 40  # least squares misses most other points by more
    found = case.robust("tukey")
    assert (case.listed(found) == case.bad).all()
    assert found.weights[0, 0] == 0.0
    assert (
        weighted_point_distances(case.model, state_of(found.least_squares))[0, 0] > 20.0 * plain[0]
    )
    assert case.miss(state_of(found.least_squares)) < 0.3 * case.miss(state_of(case.found))


def test_parameters_that_only_suspects_tell_are_named(robot):
    wrist = (-1.2, 1.4, -0.7)
    for wrong in (1, 3):
        case = few_that_tell_the_wrist(robot, wrist, wrong, 0.05, 0, 3)
        for found in (case.robust("tukey"), case.robust(trim=0.1)):
            assert (case.listed(found) == case.bad).all()
            told = [note for note in found.notices if "hardly determine" in note]
            assert len(told) == (wrong == 3)
            assert all("alpha5" in note for note in told)


# ---- points set aside ------------------------------------------------------------------------


def test_at_most_the_share_is_set_aside(robot):
    case = shifted(robot, 0.1, 1e-3)
    for share in (0.02, 0.05, 0.1, 0.2, 0.4):
        found = case.robust(trim=share)
        away = (found.weights == 0.0) & case.model.measured_mask
        assert away.sum() == min(int(share * case.bad.size), case.bad.sum())
        assert (away <= case.bad).all()
        assert any("give a larger share" in note for note in found.notices) == (share < 0.1)
        assert_allclose(found.kept.weight, case.model.weight * ~away)


def test_what_is_set_aside_is_a_fixed_point(robot):
    """The final fit itself finds just these points to stand out, and comes out again the same."""
    case = shifted(robot, 0.1, 3e-4, seed=4)
    found = case.robust(trim=0.2)
    last = WeightedFit(
        FITTER, found.unweighted_model, found.least_squares, found.weights, np.ones(3, dtype=bool)
    )
    judged = last.scores()
    far = reject_by_false_discovery_rate(last.spread(judged).p_value(judged))
    assert (far == (found.weights == 0.0)).all()
    again = case.robust(trim=0.2)
    assert_allclose(again.weights, found.weights, rtol=0)
    assert_allclose(state_of(again.least_squares).mdh, state_of(found.least_squares).mdh, rtol=0)


@pytest.mark.parametrize("per", ["target", "point"])
def test_minimax_on_the_trimmed_model_is_that_without_the_points(robot, per):
    case = shifted(robot, 0.05, 1e-3, poses=40)
    found = case.robust(trim=0.1)
    y = np.where((found.weights > 0.0).T[..., None], case.data.y, np.nan)
    deleted = case_of(robot, case.made, case.data.with_y(y), case.bad.T)
    worst = []
    for model, state in (
        (found.model, state_of(found.least_squares)),
        (deleted.model.with_active(found.model.active), state_of(deleted.found)),
    ):
        assert_allclose(model.pose_counts_by_target, (found.weights > 0.0).sum(axis=1))
        problem = build_minimax_problem(
            model, state, measured_distances(case.data.with_y(y)), "off", per
        )
        best = solvers.minimax.solve(problem, state, partial(solve_qp, name="daqp"), Sqp())
        assert best.status == "converged"
        worst.append(best.f.max() * problem.size)
    assert worst[0] == pytest.approx(worst[1], rel=1e-6)


# ---- the rest of the model -------------------------------------------------------------------


def test_targets_that_follow_are_not_judged(robot):
    """As with objective smr:2: the others have a weight that is nothing beside one."""
    case = shifted(robot, 0.1, 1e-3)
    model, plain = FITTER(
        case.model.with_target_weights(np.array([1e-9, 1.0, 1e-9])), state_of(case.found)
    )
    judged = np.array([False, True, False])
    found = fit_robust_loss(FITTER, model, plain, case.data.line, "tukey", is_judged=judged)
    assert {one.target for one in found.suspects} == {"smr2"}
    assert (case.listed(found)[1] == case.bad[1]).all()
    assert (found.weights[~judged] == 1.0).all()
    assert_allclose(found.scale, NOISE, rtol=0.2)


def test_a_pose_has_the_least_weight_of_its_targets(robot):
    case = shifted(robot, 0.1, 1e-3)
    found = case.robust("tukey")
    assert_allclose(found.model_weighted_by_pose.weight, np.tile(found.weights.min(axis=0), (3, 1)))


def test_rounds_that_do_not_settle_are_told(robot, monkeypatch):
    monkeypatch.setattr(robust_fit, "MAX_REWEIGHTING_ROUNDS", 1)
    found = shifted(robot, 0.1, 1e-3, poses=30).robust("huber")
    assert found.least_squares.status == ("iteration_limit",)


def test_a_plain_fit_that_diverged_stays_what_it_is(robot):
    case = shifted(robot, 0.1, 1e-3, poses=20)
    state = state_of(case.found)
    lost = replace(
        state, origin=state.origin * np.nan, target_positions=state.target_positions * np.nan
    )
    failed = replace(case.found, x=lost.batch(), cost=np.array([np.nan]), status=(Status.FAILED,))
    found = replace(case, found=failed).robust("tukey", 0.1)
    assert found.least_squares.status == ("failed",)
    assert not found.suspects
    assert found.weights.all()


@pytest.mark.parametrize(
    ("loss", "trim", "say"),
    [
        ("l1", 0.0, "no loss 'l1'; choose square, huber, cauchy, tukey"),
        ("square", -0.1, "trim -0.1"),
        ("tukey", 0.5, "0 <= trim < 0.5"),
        ("square", float("nan"), "trim nan"),
    ],
)
def test_wrong_choices_are_refused(robot, loss, trim, say):
    case = shifted(robot, 0.0, 0.0, poses=20)
    with pytest.raises(mc.OptionError, match=say) as caught:
        case.robust(loss, trim)
    assert "\n" not in str(caught.value)


# ---- robust calibrate ----------------------------------------------------------------------------


def spoilt(made: Simulation, share: float = 0.05, size: float = 1e-3) -> mc.Measurements:
    """A share of all points moved by `size` [m] in random directions."""
    rng = np.random.default_rng(0)
    y = made.data.y.copy()
    points = y.reshape(-1, 3)
    chosen = rng.permutation(len(points))[: round(share * len(points))]
    points[chosen] += size * directions(rng, len(chosen))
    return made.data.with_y(y)


@pytest.mark.parametrize(
    "options",
    [
        {"objective": "sum", "loss": "huber"},
        {"objective": "sum", "loss": "tukey"},
        {"objective": "minimax", "trim": 0.1},
        {"objective": "point", "trim": 0.1},
        {"objective": "pose", "loss": "tukey"},
        {"objective": "smr:2", "loss": "tukey"},
    ],
)
def test_wrong_points_do_no_harm(robot, options):
    made = simulate(robot, 80, 3, seed=14, truth=Truth(compliance=0))
    new = np.random.default_rng(1).uniform(-2, 2, (200, 6))
    truth = made.cell.predict(new)

    def miss(data: mc.Measurements, **chosen: object) -> float:
        fit = mc.calibrate(robot, data, **chosen)
        assert fit.status == "converged"
        return float(np.sqrt(((fit.predict(new) - truth) ** 2).mean()))

    clean = miss(made.data, objective=options["objective"])
    assert miss(spoilt(made), **options) < 2.0 * clean
    assert miss(spoilt(made), objective=options["objective"]) > 3.0 * clean


def test_suspects_reach_table_and_json(robot):
    made = simulate(robot, 60, 3, seed=15, truth=Truth(compliance=0))
    fit = mc.calibrate(robot, spoilt(made), "point", holdout=0.0, trim=0.1)
    content = json.loads(fit.json())
    assert content["loss"] == "square"
    assert len(content["suspects"]) == len(fit.suspects) >= 9
    for row, one in zip(content["suspects"], fit.suspects, strict=True):
        assert {"line", "target", "distance_mm", "score"} <= set(row)
        assert row["distance_mm"] == pytest.approx(1e3 * one.distance)
    assert any("outliers" in table.title for table in fit.tables())
    assert (fit.weights == 0.0).sum() == 9
    # the points that decide are named among those that were kept
    assert (fit.weights > 0.0).sum() == 171
    kept = np.linalg.norm(fit.errors["train"], axis=-1)[fit.weights.T > 0.0]
    assert 1e3 * kept.max() == pytest.approx(fit.minimax.table().rows[0][1], rel=1e-6)
    aside = {(s.target, s.line) for s in fit.suspects[:9]}
    assert not aside & {tuple(name.split(" line ")) for name in fit.minimax.functions}
    assert fit.provenance.settings["trim"] == 0.1


def test_sigma_of_a_robust_fit_is_its_scatter(robot):
    """As for least squares, with one point in twenty off by a millimetre."""
    scores: dict[str, list[float]] = {"huber": [], "tukey": []}
    for seed in range(8):
        made = simulate(robot, 40, 3, seed, Truth(compliance=0))
        perfect = made.data.with_y(made.cell.predict(made.data.q))
        exact = mc.calibrate(robot, perfect, "sum", holdout=0.0)
        for loss, found in scores.items():
            fit = mc.calibrate(robot, spoilt(made), "sum", holdout=0.0, loss=loss)
            # the base stands in axes of its own, which wrong points turn
            found += [
                (noisy.value - true.value) / noisy.sigma
                for noisy, true in zip(fit.parameters, exact.parameters, strict=True)
                if noisy.identifiable and not noisy.name.startswith("base_")
            ]
    for found in scores.values():
        square = np.mean(np.square(found))
        assert abs(square - 1.0) < 5 * np.sqrt(2 / len(found)) * 2


def test_robust_fits_take_priors_and_effects(robot):
    made = simulate(robot, 60, 3, seed=16)  # with compliance
    data = spoilt(made)
    held = mc.calibrate(robot, data, "sum", loss="tukey", priors={"a2": 1e-9})
    assert_allclose(next(p.value for p in held.parameters if p.name == "a2"), 0.9, atol=1e-8)
    clean = mc.calibrate(robot, made.data, "sum", effects="joint_compliance:all")
    fit = mc.calibrate(robot, data, "sum", effects="joint_compliance:all", loss="tukey")
    assert fit.status == "converged"
    for one, other in zip(fit.parameters, clean.parameters, strict=True):
        if ":" in one.name and other.identifiable:
            assert abs(one.value - other.value) < 6.0 * other.sigma


@pytest.mark.parametrize("name", LOSSES)
def test_moments_are_those_of_the_chi_distribution(robot, name):
    """At the truth itself the distances are sigma chi_3; 15000 of them leave 2 % of chance."""
    case = shifted(robot, 0.0, 0.0, poses=5000, seed=3)
    state = case.without()
    derivative, square = loss_moments(case.model, state, name, NOISE)
    assert_allclose(derivative**2 * NOISE**2 / square, 0.95, rtol=0.02)
    one, plain = loss_moments(case.model, state, "square", np.nan)
    assert_allclose(one, 1.0)
    assert_allclose(
        plain, case.model.target_costs(state) / (3.0 * case.model.pose_counts_by_target), rtol=1e-12
    )
    assert_allclose(plain, NOISE**2, rtol=0.05)
