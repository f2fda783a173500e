"""Designs against brute force and known optima; plans of poses against refits."""

import dataclasses
import itertools
import json
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing import next_measurement
from minimax_cal.modelling.cell import build_measurements_at_rest
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.modelling.simulate import gravity
from minimax_cal.planning import effect_separation
from minimax_cal.planning.candidate_poses import draw_collision_free_poses
from minimax_cal.planning.designs.design_exchange import (
    ExperimentPool,
    criterion_lower_bound,
    improve_design_by_exchange,
    inverse_criterion_gradient,
    maximise_criterion_lower_bound,
)
from minimax_cal.planning.designs.design_search import (
    build_first_design,
    equivalent_random_design_size,
    search_best_design,
)
from minimax_cal.planning.designs.optimality_criteria import (
    DeterminantCriterion,
    LargestEigenvalueCriterion,
    LargestVarianceCriterion,
    OptimalityCriterion,
    TraceCriterion,
    evaluate_information_matrices,
    evaluate_information_matrix,
    invert_information_matrices,
)
from minimax_cal.planning.plan import plan
from minimax_cal.planning.plan_figures import observability_indices
from minimax_cal.planning.plan_options import PlanOptions
from minimax_cal.planning.plan_predictions import predict_position_sigmas
from minimax_cal.planning.planning_task import build_workspace_and_visibility
from minimax_cal.planning.pose_information import (
    PlanningNoise,
    PoseInformation,
    add_effects_to_cell,
    build_pose_information,
    place_measurement_frame,
    target_positions_on_circle,
)
from minimax_cal.planning.result import SEPARATION_CRITERION, Plan
from minimax_cal.planning.visit_route import (
    build_visit_sequence,
    order_poses_for_short_path,
    pairwise_move_lengths,
    path_length,
)
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.selection.stability_selection import SUFFICIENT_SEPARATION_POWER

ROUNDING = 1e-9  # relative: the same numbers by other algebra
NEAR = {"D": 0.01, "A": 0.01, "I": 0.01, "G": 0.1, "E": 0.1}  # of the largest, a soft mean serves
NOISE = PlanningNoise(10e-6, 2.5e-6, 10e-6)
pytestmark = pytest.mark.usefixtures("few_candidates")


def silent(message: str) -> None:
    """Say nothing."""


def random_menu(seed: int, count: int = 10, r: int = 2, f: int = 3) -> ExperimentPool:
    rng = np.random.default_rng(seed)
    return ExperimentPool(
        rng.normal(size=(count, r, f)) * rng.uniform(0.3, 2.0, f), np.zeros((f, f))
    )


def criteria(f: int, seed: int = 0) -> dict[str, OptimalityCriterion]:
    b = np.random.default_rng(seed).normal(size=(7, 2, f))
    squares = b.swapaxes(1, 2) @ b
    return {
        "D": DeterminantCriterion(),
        "A": TraceCriterion(np.eye(f) / f),
        "E": LargestEigenvalueCriterion(),
        "G": LargestVarianceCriterion(squares),
        "I": TraceCriterion(squares.mean(axis=0)),
    }


NAMES = tuple(criteria(2))


# ---- criteria ----------------------------------------------------------------------------------


def test_sizes_are_what_they_say():
    f = 4
    info = random_menu(1, 6, 3, f).information_of_experiments(np.arange(6))
    cov = np.linalg.inv(info)
    all_ = criteria(f)
    assert_allclose(
        evaluate_information_matrix(all_["D"], info), np.linalg.det(cov) ** (1 / f), rtol=ROUNDING
    )
    assert_allclose(evaluate_information_matrix(all_["A"], info), np.trace(cov) / f, rtol=ROUNDING)
    assert_allclose(
        evaluate_information_matrix(all_["E"], info), np.linalg.eigvalsh(cov)[-1], rtol=ROUNDING
    )
    each = [np.trace(cov @ w) for w in all_["G"].weights]
    assert_allclose(evaluate_information_matrix(all_["G"], info), max(each), rtol=ROUNDING)
    assert_allclose(evaluate_information_matrix(all_["I"], info), np.mean(each), rtol=ROUNDING)
    for criterion in all_.values():  # all fall as 1/t
        assert_allclose(
            evaluate_information_matrix(criterion, 2.5 * info),
            evaluate_information_matrix(criterion, info) / 2.5,
        )
        batch = evaluate_information_matrices(criterion, np.array([info, 2.0 * info]))
        assert_allclose(
            batch,
            [
                evaluate_information_matrix(criterion, info),
                evaluate_information_matrix(criterion, 2.0 * info),
            ],
        )


@pytest.mark.parametrize("name", NAMES)
def test_what_tells_not_everything_has_no_size(name):
    info = random_menu(0, 1, 2, 3).information_of_experiments(np.array([0]))
    assert evaluate_information_matrix(criteria(3)[name], info) == np.inf


@pytest.mark.parametrize("name", ["D", "A", "I"])
@pytest.mark.parametrize("r", [1, 3])
def test_updates_are_those_of_a_new_inverse(name, r):
    menu, criterion = random_menu(3, 12, r, 5), criteria(5)[name]
    info = menu.information_of_experiments(np.arange(12))
    found = criterion.evaluate_after_adding(np.linalg.inv(info), menu.sensitivities)
    direct = [evaluate_information_matrix(criterion, info + a.T @ a) for a in menu.sensitivities]
    assert_allclose(found, direct, rtol=ROUNDING)


@pytest.mark.parametrize("name", ["E", "G"])
def test_updates_of_the_worst_are_bounds(name):
    menu, criterion = random_menu(3, 12, 2, 5), criteria(5)[name]
    info = menu.information_of_experiments(np.arange(12))
    cov = np.linalg.inv(info)
    direct = np.array(
        [evaluate_information_matrix(criterion, info + a.T @ a) for a in menu.sensitivities]
    )
    assert np.all(
        criterion.evaluate_after_adding(cov, menu.sensitivities) <= direct * (1 + ROUNDING)
    )
    assert np.trace(cov @ criterion.equivalent_trace_weight(cov)) <= float(
        criterion.evaluate(cov)
    ) * (1 + ROUNDING)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), name=st.sampled_from(NAMES))
def test_no_information_has_a_size_below_the_polar(seed, name):
    f = 4
    criterion = criteria(f, seed)[name]
    here, there = (
        random_menu(seed + i, 6, 2, f).information_of_experiments(np.arange(6)) for i in (1, 2)
    )
    cov = np.linalg.inv(here)
    pull = inverse_criterion_gradient(cov, criterion.equivalent_trace_weight(cov))
    assert evaluate_information_matrix(criterion, there) >= 1.0 / np.trace(pull @ there) * (
        1 - ROUNDING
    )


# ---- designs -----------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), name=st.sampled_from(NAMES))
def test_an_exchange_never_worsens(seed, name):
    menu, criterion = random_menu(seed, 14, 1, 4), criteria(4, seed)[name]
    start = np.random.default_rng(seed).choice(14, 6, replace=False)
    before = evaluate_information_matrix(criterion, menu.information_of_experiments(start))
    found = improve_design_by_exchange(menu, criterion, start)
    assert found.criterion_value <= before
    assert_allclose(
        found.criterion_value,
        evaluate_information_matrix(
            criterion, menu.information_of_experiments(found.experiment_indices)
        ),
        rtol=ROUNDING,
    )
    assert len(set(found.experiment_indices.tolist())) == 6
    again = improve_design_by_exchange(menu, criterion, found.experiment_indices)
    assert np.array_equal(again.experiment_indices, found.experiment_indices)
    few = np.arange(8)
    inside = improve_design_by_exchange(menu, criterion, start, few)
    assert set(inside.experiment_indices.tolist()) <= {*start.tolist(), *few.tolist()}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("at_hand", [False, True])
def test_small_menus_by_brute_force(name, seed, at_hand):
    menu, criterion = random_menu(seed, 11, 1, 3), criteria(3, seed)[name]
    if at_hand:
        menu = ExperimentPool(
            menu.sensitivities,
            random_menu(seed + 9, 2, 1, 3).information_of_experiments(np.arange(2)),
        )
    every = [np.array(one) for one in itertools.combinations(range(11), 5)]
    best = min(
        evaluate_information_matrix(criterion, menu.information_of_experiments(one))
        for one in every
    )
    found = search_best_design(menu, criterion, build_first_design(menu, criterion, 5, 0), silent)
    assert found.lower_bound <= best * (1 + ROUNDING)
    assert_allclose(found.design.criterion_value, best, rtol=ROUNDING)


def polynomial(points: Array, degree: int, copies: int) -> ExperimentPool:
    rows = np.vander(points, degree + 1, increasing=True)
    return ExperimentPool(np.repeat(rows, copies, axis=0)[:, None], np.zeros((degree + 1,) * 2))


@pytest.mark.parametrize(
    ("degree", "support"),
    [(2, [-1.0, 0.0, 1.0]), (3, [-1.0, -1 / np.sqrt(5), 1 / np.sqrt(5), 1.0])],
)
def test_d_optimal_polynomials_are_the_known_ones(degree, support):
    """Equal weights on the zeros of (1 - x^2) P_n'(x) [Guest 1958; Hoel 1958]."""
    points = np.union1d(np.linspace(-1.0, 1.0, 21), support)
    each = 3
    menu, criterion = polynomial(points, degree, each), DeterminantCriterion()
    count = each * len(support)
    found = search_best_design(
        menu, criterion, build_first_design(menu, criterion, count, 0), silent
    )
    at = points[found.design.experiment_indices // each]
    assert_allclose(np.sort(at), np.repeat(support, each), rtol=0, atol=1e-12)
    known = np.vander(np.repeat(support, each), degree + 1, increasing=True)
    best = np.linalg.det(known.T @ known) ** (-1 / (degree + 1))
    assert_allclose(found.design.criterion_value, best, rtol=ROUNDING)
    assert_allclose(found.lower_bound, best, rtol=ROUNDING)
    # Kiefer and Wolfowitz: at the optimum the largest variance of a prediction is f / n
    cov = invert_information_matrices(
        menu.information_of_experiments(found.design.experiment_indices)
    )
    variance = np.einsum("cri,ij,crj->c", menu.sensitivities, cov, menu.sensitivities)
    assert_allclose(variance.max() * count, degree + 1, rtol=ROUNDING)
    assert_allclose(
        criterion_lower_bound(
            menu, inverse_criterion_gradient(cov, criterion.equivalent_trace_weight(cov)), count
        ),
        best,
        rtol=ROUNDING,
    )


@pytest.mark.parametrize("name", NAMES)
def test_the_bound_is_near_the_best_weights(name):
    """Below the convex problem's optimum, written down plainly for cvxpy, and near it."""
    cp = pytest.importorskip("cvxpy")
    menu, f, count = random_menu(2, 30, 2, 3), 3, 8
    criterion = criteria(f)[name]
    w = cp.Variable(30, nonneg=True)
    info = sum(w[j] * (menu.sensitivities[j].T @ menu.sensitivities[j]) for j in range(30))
    rules = [cp.sum(w) == count, w <= 1]
    if name == "D":
        goal = cp.exp(-cp.log_det(info) / f)
        cp.Problem(cp.Maximize(cp.log_det(info)), rules).solve(solver="CLARABEL")
        expected = float(goal.value)
    elif name == "E":
        expected = 1.0 / cp.Problem(cp.Maximize(cp.lambda_min(info)), rules).solve(
            solver="CLARABEL"
        )
    else:
        weights = (
            criterion.weights
            if isinstance(criterion, LargestVarianceCriterion)
            else [criterion.weight]
        )
        roots = [np.linalg.cholesky(part + 1e-12 * np.eye(f)) for part in weights]
        worst = cp.max(cp.hstack([cp.matrix_frac(root, info) for root in roots]))
        expected = cp.Problem(cp.Minimize(worst), rules).solve(solver="CLARABEL")
    found = maximise_criterion_lower_bound(
        menu, criterion, build_first_design(menu, criterion, count, 0)
    )
    assert found <= expected * (1 + 1e-6)
    assert found >= expected * (1 - NEAR[name])


def test_too_few_experiments_are_told_with_how_many_it_takes():
    with pytest.raises(mc.OptionError, match=r"2 poses do not tell the 7 parameters .* at least 4"):
        build_first_design(random_menu(0, 30, 2, 7), DeterminantCriterion(), 2, 0)
    flat = ExperimentPool(np.ones((20, 1, 2)), np.zeros((2, 2)))
    with pytest.raises(mc.OptionError, match="20 of the candidates do not tell"):
        build_first_design(flat, DeterminantCriterion(), 3, 0)


def test_worth_is_the_number_of_random_ones_that_tell_as_much():
    menu, criterion = random_menu(8, 4000, 3, 3), TraceCriterion(np.eye(3))
    rng = np.random.default_rng(1)
    sizes = [
        evaluate_information_matrix(
            criterion, menu.information_of_experiments(rng.choice(4000, 75, replace=False))
        )
        for _ in range(200)
    ]
    assert equivalent_random_design_size(
        menu, criterion, 40, float(np.median(sizes)), 0
    ) == pytest.approx(75, rel=0.05)
    assert equivalent_random_design_size(menu, criterion, 40, 1e-9, 0) == np.inf


# ---- indices and tours -------------------------------------------------------------------------


def test_observability_by_hand():
    found = observability_indices(np.array([4.0, 2.0, 1.0]), 4)
    assert found == pytest.approx(
        {"O1": 2.0 / 2.0, "O2": 1 / 4, "O3": 1.0, "O4": 1 / 4, "O5": 1 / (1 / 4 + 1 / 2 + 1)}
    )
    assert set(observability_indices(np.array([1.0, 0.0]), 3).values()) == {0.0}


@pytest.mark.parametrize("seed", range(4))
def test_a_short_way_is_near_the_shortest(seed):
    rng = np.random.default_rng(seed)
    q, sliding = rng.uniform(-2.0, 2.0, (6, 3)), np.array([False, True, False])
    begin = np.zeros(3)
    away = pairwise_move_lengths(np.concatenate([begin[None], q]), sliding)
    ways = [(0, *way) for way in itertools.permutations(range(1, 7))]
    best = min(sum(away[a, b] for a, b in itertools.pairwise(way)) for way in ways)
    order = order_poses_for_short_path(q, sliding, begin)
    assert sorted(order) == list(range(6))
    found = path_length(np.concatenate([begin[None], q[order]]), sliding)
    assert best <= found + ROUNDING
    assert found <= 1.15 * best
    # no stretch turned round makes it shorter
    for i, j in itertools.combinations(range(6), 2):
        other = order.copy()
        other[i : j + 1] = other[i : j + 1][::-1]
        assert path_length(np.concatenate([begin[None], q[other]]), sliding) >= found - ROUNDING


def test_travel_counts_the_joint_that_goes_farthest():
    q = np.array([[0.0, 0.0], [0.3, -0.1], [0.3, 0.4]])
    assert path_length(q, np.array([False, False])) == pytest.approx(0.3 + 0.5)
    assert path_length(q, np.array([False, True])) == pytest.approx(0.3 + 1.0)  # a slide of 0.5 m
    assert path_length(q[:1], np.array([False, False])) == 0.0


def test_revisits_come_from_the_other_side():
    rng = np.random.default_rng(0)
    q, sliding = rng.uniform(-1.0, 1.0, (9, 3)), np.zeros(3, dtype=bool)
    far = np.full(3, 2.0)
    plain = build_visit_sequence(q, sliding, -far, far, 4)
    assert len(plain.pose) == 13
    assert not plain.via.any()
    assert_allclose(plain.q, q[plain.pose])
    both = build_visit_sequence(q, sliding, -far, far, 4, from_other_side=True)
    assert both.via.sum() == 4
    again = np.flatnonzero(both.via) + 1
    for stop in again:
        first = int(np.flatnonzero(both.pose == both.pose[stop])[0])
        assert_allclose(both.q[stop], both.q[first])
        if first:
            assert np.array_equal(both.approach[stop], -both.approach[first])
    # at a limit there is no room to come from beyond it
    tight = build_visit_sequence(q, sliding, -far, q.max(axis=0), 9, from_other_side=True)
    assert np.all(tight.q <= q.max(axis=0) + ROUNDING)


# ---- poses of an arm ---------------------------------------------------------------------------


def ahead_of(
    robot: mc.Robot, k: int, q: Array, seen: Array, noise: PlanningNoise
) -> PoseInformation:
    names = tuple(f"smr{i + 1}" for i in range(k))
    cell = place_measurement_frame(
        mc.Cell(robot, np.eye(4), names, target_positions_on_circle(k)), np.array([3.0, 0.5, 1.0])
    )
    return build_pose_information(cell, noise, q, seen)


def test_information_is_that_of_dense_covariances(robot):
    rng = np.random.default_rng(0)
    q = random_joint_values_above_floor(robot, 40, rng)
    seen = rng.uniform(size=(40, 2)) < 0.7
    seen[:, 0] |= ~seen.any(axis=1)
    ahead = ahead_of(robot, 2, q, seen, PlanningNoise(12e-6, 3e-6, 20e-6))
    cell = ahead.cell
    data = build_measurements_at_rest(q, cell.target_names, robot)
    state = ParameterValues(robot.mdh, cell.base[:3, :3], cell.base[:3, 3], cell.target_positions)
    jacobian = build_point_model(robot, data).point_jacobian(state)
    scene = PosedArm.at_measured_poses(
        robot, data, (state.rotation, state.origin), cell.target_positions, q * robot.sign
    )
    rows = ahead.whitened_jacobian_of_new_poses(q, seen)
    for pose in (0, 7, 23):
        chosen = np.flatnonzero(seen[pose])
        j = (
            jacobian[pose, chosen].reshape(3 * len(chosen), -1)[:, ahead.is_identifiable]
            / ahead.parameter_scale
        )
        s = scene.jacobian[..., pose][:, chosen].reshape(6, -1).T
        away = np.linalg.norm(cell.predict(q[pose])[0, chosen], axis=-1)  # tracker at its origin
        v = np.diag(np.repeat((12e-6 + 3e-6 * away) ** 2, 3)) + (20e-6) ** 2 * s @ s.T
        expected = j.T @ np.linalg.inv(v) @ j
        assert_allclose(rows[pose].T @ rows[pose], expected, rtol=1e-7, atol=1e-9 * expected.max())


@pytest.mark.parametrize(
    ("noise", "most"),
    # a plain fit does not know that joints jitter and noise grows with range, the prediction does
    [(PlanningNoise(12e-6, 0.0, 0.0), 1.09), (NOISE, 1.2)],
)
def test_predicted_variance_is_that_of_refits(robot, noise, most):
    rng = np.random.default_rng(3)
    q, work = (
        random_joint_values_above_floor(robot, 25, rng),
        random_joint_values_above_floor(robot, 60, rng),
    )
    ahead = ahead_of(robot, 1, q, np.ones((25, 1), dtype=bool), noise)
    menu = ExperimentPool(
        ahead.whitened_jacobian_of_new_poses(q, np.ones((25, 1), dtype=bool)),
        np.zeros((len(ahead.parameter_scale),) * 2),
    )
    b = ahead.position_prediction_matrices(work)
    squares = (b.swapaxes(1, 2) @ b).reshape(len(b), -1)
    (predicted,) = predict_position_sigmas(menu, [np.arange(25)], squares)
    cell, trials, total = ahead.cell, 40, 0.0
    truth = cell.predict(work)
    for _ in range(trials):
        y = cell.predict(q + noise.jitter * rng.normal(size=q.shape))
        spread = noise.noise + noise.per_metre * np.linalg.norm(y, axis=-1, keepdims=True)
        data = mc.measurements(q, y + spread * rng.normal(size=y.shape))
        fit = mc.calibrate(robot, data, "sum", holdout=0.0)
        assert fit.identification.active.sum() == ahead.is_identifiable.sum()
        total += float(((fit.predict(work) - truth) ** 2).sum(axis=-1).mean())
    # 40 fits of 27 directions, of which some ten matter: 4 % of a sigma
    found = np.sqrt(total / trials)
    assert 0.91 < found / predicted[0] < most


def test_effects_are_unknowns_too(robot):
    q = random_joint_values_above_floor(robot, 60, np.random.default_rng(0))
    seen = np.ones((60, 3), dtype=bool)
    plain = ahead_of(robot, 3, q, seen, NOISE)
    cell = add_effects_to_cell(plain.cell, ("joint_compliance:J2", "encoder_gain:J1"), q)
    more = build_pose_information(cell, NOISE, q, seen)
    extra = set(more.names) - set(plain.names)
    assert {name.partition(".")[0] for name in extra} == {"joint_compliance:J2", "encoder_gain:J1"}
    work = random_joint_values_above_floor(robot, 50, np.random.default_rng(1))
    sigma = []
    for ahead in (plain, more):
        menu = ExperimentPool(
            ahead.whitened_jacobian_of_new_poses(q, seen),
            np.zeros((len(ahead.parameter_scale),) * 2),
        )
        b = ahead.position_prediction_matrices(work)
        squares = (b.swapaxes(1, 2) @ b).reshape(len(b), -1)
        sigma.append(predict_position_sigmas(menu, [np.arange(60)], squares)[0, 0])
    assert sigma[1] > sigma[0]  # what is not known costs accuracy


@pytest.fixture(scope="module")
def planned(robot: mc.Robot, few_candidates: None) -> Plan:
    return plan(robot, 12, targets=1, candidates=150, revisit=3, approach="both", seed=2)


def test_a_plan_is_better_than_random_poses(planned):
    assert planned.bound <= planned.size < planned.random
    assert 0.6 < planned.efficiency <= 1.0  # 36 coordinates for 27 unknowns: whole poses cost
    assert planned.equal > 12
    here = planned.here
    assert here.poses == 12
    assert here.mean[0] < here.mean[1]
    assert_allclose(here.mean[0], np.sqrt(planned.size), rtol=ROUNDING)  # criterion I
    sizes = [row.mean[0] for row in planned.growth]
    assert sizes == sorted(sizes, reverse=True)
    assert planned.travel[0] < planned.travel[1]
    for one, other in planned.indices.values():
        assert one > 0.0
        assert other > 0.0


def test_a_plan_is_better_at_poses_that_it_does_not_know(planned):
    room, _, _ = build_workspace_and_visibility(planned.cell, PlanOptions(targets=1))
    fresh = draw_collision_free_poses(room, 1000, 1_000_003)
    every = planned.candidates
    ahead = build_pose_information(planned.cell, planned.instrument, every.q, every.seen)
    b = ahead.position_prediction_matrices(fresh)
    squares = (b.swapaxes(1, 2) @ b).reshape(len(b), -1)

    def told(q: Array, seen: Array, chosen: list[Array]) -> Array:
        menu = ExperimentPool(
            ahead.whitened_jacobian_of_new_poses(q, seen),
            np.zeros((len(ahead.parameter_scale),) * 2),
        )
        return predict_position_sigmas(menu, chosen, squares)[:, 0]

    (ours,) = told(planned.q, planned.seen, [np.arange(12)])
    rng = np.random.default_rng(0)
    drawn = [rng.choice(every.drawn, 12, replace=False) for _ in range(20)]
    assert_allclose(ours, planned.here.mean[0], rtol=0.1)
    assert ours < told(every.q, every.seen, drawn).min()


def test_a_plan_of_as_few_poses_as_can_be(robot):
    """Nine poses of one target are 27 coordinates for 27 unknowns."""
    found = plan(robot, 9, targets=1, candidates=9, acceptance=np.pi, seed=1)
    assert len(found.names) == 27
    assert found.candidates.drawn == 9  # random choices are all of them
    assert found.here.mean[0] < np.inf
    assert [row.poses for row in found.growth] == [9]  # fewer tell nothing, more were not drawn
    assert "more than" not in found.headline()
    with pytest.raises(mc.OptionError, match="8 poses do not tell the 27 parameters apart; plan"):
        plan(robot, 8, targets=1, candidates=100, acceptance=np.pi)


def test_a_plan_tells_itself(planned, tmp_path):
    content = json.loads(planned.json())
    assert content["schema"] == 1
    assert content["kind"] == "plan"
    assert content["poses"] == len(content["q"]) == 12
    assert content["value"]["bound_sigma_um"] <= content["value"]["planned_sigma_um"]
    assert len(content["visits"]["pose"]) == 12 + 2 * 3
    planned.save(tmp_path / "plan.json")
    assert json.loads((tmp_path / "plan.json").read_text()) == content
    text = planned.summary()
    for words in ("12 poses by criterion I", "O4", "no choice is better than", "acceptance"):
        assert words in text


def test_poses_at_hand_count(robot):
    rng = np.random.default_rng(5)
    cell = place_measurement_frame(
        mc.Cell(robot, np.eye(4), ("smr1",), target_positions_on_circle(1)),
        np.array([3.0, 0.0, 1.0]),
    )
    q = random_joint_values_above_floor(robot, 15, rng)
    y = cell.predict(q) + 10e-6 * rng.normal(size=(15, 1, 3))
    data = mc.measurements(q, y)
    wishes = {"candidates": 100, "noise": 1e-5, "jitter": 1e-5}
    alone = plan(robot, 10, fit=cell, **wishes)
    beside = plan(robot, 10, fit=cell, data=data, **wishes)
    assert alone.at_hand == 0
    assert beside.at_hand == 15
    assert beside.here.mean[0] < alone.here.mean[0]
    assert beside.here.mean[1] < alone.here.mean[1]
    one = plan(robot, 1, fit=cell, data=data, **wishes)  # too few alone, enough beside those
    assert one.here.mean[0] < np.inf
    assert any("tells no poses" in notice for notice in alone.notices)


def test_noise_is_as_the_data_show_it(robot):
    rng = np.random.default_rng(6)
    cell = place_measurement_frame(
        mc.Cell(robot, np.eye(4), ("smr1", "smr2", "smr3"), target_positions_on_circle(3)),
        np.array([3.0, 0.0, 1.0]),
    )
    q = random_joint_values_above_floor(robot, 80, rng)
    y = cell.predict(q + 60e-6 * rng.normal(size=q.shape)) + 30e-6 * rng.normal(size=(80, 3, 3))
    found = plan(robot, 8, data=mc.measurements(q, y), candidates=60)
    assert found.instrument.noise == pytest.approx(30e-6, rel=0.1)
    assert found.instrument.jitter == pytest.approx(60e-6, rel=0.15)
    assert any("estimated from the existing poses" in notice for notice in found.notices)


# ---- two effects -------------------------------------------------------------------------------

GAIN = ("encoder_gain:J3", "gear_error:J3:turns=1")


@pytest.fixture(scope="module")
def narrow(robot: mc.Robot) -> mc.Measurements:
    """Poses near one another, of an arm that gives way and whose joint 3 gains."""
    rng = np.random.default_rng(0)
    half = np.array([0.3, 0.5, 0.4, 1.0, 0.8, 2.0])
    q = rng.uniform(-half, half, (50, 6))
    real = robot.with_mdh(robot.mdh + rng.normal(size=(6, 5)) * 3e-4)
    cell = place_measurement_frame(
        mc.Cell(real, np.eye(4), ("smr1", "smr2"), target_positions_on_circle(2)),
        np.array([3.0, 0, 1.0]),
    )
    bent = q + 3e-7 * gravity(real, q)
    bent[:, 2] += 2e-4 * q[:, 2]
    y = cell.predict(bent) + 15e-6 * rng.normal(size=(50, 2, 3))
    return mc.measurements(q, y, order=np.arange(50.0))


@pytest.fixture(scope="module")
def asked(
    robot: mc.Robot, narrow: mc.Measurements
) -> Callable[..., effect_separation.SeparationQuestion]:
    cell = mc.calibrate(robot, narrow, "sum", holdout=0.0).cell

    def question(*pair: str) -> effect_separation.SeparationQuestion:
        return effect_separation.build_separation_question(robot, narrow, cell, pair, 0)

    return question


@pytest.mark.parametrize("pair", [GAIN, ("joint_compliance:J2", "base_flex:frame")])
def test_power_is_what_separate_says(asked, pair):
    """Its own proposal of more poses, given to us as candidates that are all measured."""
    one = asked(*pair)
    told = next_measurement.separation_powers(one.site, one.pair)
    for count in (10, 80):
        rows = one.site.measurement_plan.select_plan_rows("more", count)
        seen = one.site.measurement_plan.weight[:, rows].T > 0.0
        poses = one.site.measurement_plan.data.q[rows]
        ours = effect_separation.predict_separation_power(
            one, poses, seen, np.zeros(count, dtype=bool)
        )
        # a doubt about masses is that of all proposed poses there, of these alone here
        near = 0.2 if pair != GAIN else 1e-3
        assert_allclose(ours.all_candidates_power, told["more", count], rtol=near)
        assert_allclose(ours.measured_power, told["old", 50], rtol=near)


def test_planned_poses_tell_effects_apart_sooner(robot, narrow):
    found = plan(robot, 8, data=narrow, separate=GAIN, candidates=150, acceptance=np.pi)
    (separation,) = found.separation
    assert found.criterion == SEPARATION_CRITERION
    assert 1.0 / found.size > 2.0 / found.random  # powers: planned against random poses
    assert separation.now < 1.0 < separation.planned < separation.everything
    assert separation.planned == pytest.approx(1.0 / found.size, rel=0.05)  # visited in order
    assert separation.needed == SUFFICIENT_SEPARATION_POWER
    assert not separation.alike
    assert f"{SUFFICIENT_SEPARATION_POWER:.0f} is enough" in separation.headline()
    assert json.loads(found.json())["separation"][0]["rival"] == "gear_error:J3"


def test_effects_that_are_alike_everywhere_are_said_to_be(robot, narrow):
    pair = ("encoder_gain:J3", "encoder_gain:all")
    found = plan(robot, 6, data=narrow, separate=pair, candidates=60, acceptance=np.pi)
    (separation,) = found.separation
    assert separation.alike
    assert "alike at every pose: no pose tells them apart" in separation.headline()
    assert separation.else_


def test_effects_that_a_fit_holds_as_a_whole_are_not_asked_for_in_part(robot, narrow):
    fit = mc.calibrate(robot, narrow, "sum", holdout=0.0, effects=("joint_compliance:all",))
    with pytest.raises(mc.OptionError, match="the fit holds joint_compliance:all, and"):
        plan(robot, 6, fit=fit, separate=("joint_compliance:J2", "link_bending:L2"), candidates=60)
    asked = effect_separation.build_separation_question(
        robot, narrow, fit.cell, ("joint_compliance:all", "link_bending:L2"), 0
    )
    assert asked.pair.other_effects == ()
    asked = effect_separation.build_separation_question(robot, narrow, fit.cell, GAIN, 0)
    assert [term.label for term, _ in asked.pair.other_effects] == ["joint_compliance:all"]


def test_revisits_from_the_other_side_show_play(asked, robot):
    rng = np.random.default_rng(1)
    one = asked(*GAIN)
    pair = next_measurement.ConfusedEffects(
        Term("backlash", "J2"), np.array([3e-5]), one.pair.alternative
    )
    played = dataclasses.replace(one, pair=pair)
    q = random_joint_values_above_floor(robot, 12, rng)
    seen = np.ones((12, 2), dtype=bool)
    far = np.full(6, 4.0)
    power = []
    for aside in (False, True):
        stops = build_visit_sequence(q, robot.prismatic, -far, far, 12, from_other_side=aside)
        told = effect_separation.predict_separation_power(
            played, stops.q, seen[stops.pose], stops.via
        )
        power.append(told.all_candidates_power)
    assert power[1] > 1.2 * power[0]


# ---- what a user gets wrong --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wishes", "message"),
    [
        ({"criterion": "Z"}, "no criterion 'Z'; choose D, A, E, G, I"),
        ({"poses": 0}, "poses=0: give 1 to 1000"),
        ({"candidates": 5}, "candidates=5: give at least as many as poses"),
        ({"approach": "both"}, "approach='both' is about revisits"),
        ({"approach": "left"}, "choose none or both"),
        ({"revisit": 50}, "revisit=50: give 0 to 10"),
        ({"targets": 0}, "targets=0"),
        ({"acceptance": 0.0}, "acceptance="),
        ({"reach": (5.0, 1.0)}, "reach=: the limits are reversed"),
        ({"volume": ((1.0, 0.0, 0.0), (0.5, 1.0, 1.0))}, "volume=: the limits"),
        ({"noise": -1.0}, "noise=-1 must be"),
        ({"joints": {7: (0.0, 1.0)}}, "has no joint 8"),
        ({"seed": -1}, "seed -1"),
        ({"separate": ("backlash:J2",)}, "name two effects"),
        ({"separate": GAIN}, "give measurements as data="),
        ({"effects": ("nonsense",)}, "no effect 'nonsense'"),
    ],
)
def test_wishes_that_make_no_sense(robot, wishes, message):
    given = {"poses": 10, "candidates": 60, **wishes}
    with pytest.raises(mc.OptionError, match=message):
        plan(robot, given.pop("poses"), **given)


def test_a_fit_tells_where_things_are(robot, noisy):
    cell = place_measurement_frame(
        mc.Cell(robot, np.eye(4), ("smr1",), target_positions_on_circle(1)),
        np.array([3.0, 0.0, 1.0]),
    )
    with pytest.raises(mc.OptionError, match="leave tracker= and spots= out"):
        plan(robot, 10, fit=cell, tracker=(3.0, 0.0, 1.0))
    with pytest.raises(mc.OptionError, match=r"has 6 joints, but .* has 4"):
        plan("scara_600", 10, fit=cell)
    strange = mc.measurements(np.zeros((1, 6)), np.ones((1, 3, 3)))
    with pytest.raises(mc.OptionError, match="target smr2 is not one of the fit's"):
        plan(robot, 10, fit=cell, data=strange)
