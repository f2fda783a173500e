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
from minimax_cal.diagnosing import next_measurement
from minimax_cal.evidence.stability import ENOUGH
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.cell import still
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.parameters import State
from minimax_cal.modelling.simulate import gravity
from minimax_cal.planning import separating
from minimax_cal.planning.candidates import free_poses
from minimax_cal.planning.designs.criteria import (
    Criterion,
    Determinant,
    Eigenvalue,
    Largest,
    Trace,
    inverse,
    size_of,
    sizes_of,
)
from minimax_cal.planning.designs.exchange import Menu, exchange, floor, lower_bound, polar
from minimax_cal.planning.designs.search import best_design, first_design, worth
from minimax_cal.planning.options import PlanOptions
from minimax_cal.planning.outlook import sigmas
from minimax_cal.planning.plan import plan
from minimax_cal.planning.promise import observability
from minimax_cal.planning.prospect import (
    Instrument,
    Prospect,
    cell_ahead,
    prospect,
    ring,
    with_effects,
)
from minimax_cal.planning.result import POWER, Plan
from minimax_cal.planning.route import lengths, shortest, travel, visits
from minimax_cal.planning.task import surroundings
from minimax_cal.robots.sampling import random_poses

ROUNDING = 1e-9  # relative: the same numbers by other algebra
NEAR = {"D": 0.01, "A": 0.01, "I": 0.01, "G": 0.1, "E": 0.1}  # of the largest, a soft mean serves
NOISE = Instrument(10e-6, 2.5e-6, 10e-6)
pytestmark = pytest.mark.usefixtures("few_candidates")


def silent(message: str) -> None:
    """Say nothing."""


def random_menu(seed: int, count: int = 10, r: int = 2, f: int = 3) -> Menu:
    rng = np.random.default_rng(seed)
    return Menu(rng.normal(size=(count, r, f)) * rng.uniform(0.3, 2.0, f), np.zeros((f, f)))


def criteria(f: int, seed: int = 0) -> dict[str, Criterion]:
    b = np.random.default_rng(seed).normal(size=(7, 2, f))
    squares = b.swapaxes(1, 2) @ b
    return {
        "D": Determinant(),
        "A": Trace(np.eye(f) / f),
        "E": Eigenvalue(),
        "G": Largest(squares),
        "I": Trace(squares.mean(axis=0)),
    }


NAMES = tuple(criteria(2))


# ---- criteria ----------------------------------------------------------------------------------


def test_sizes_are_what_they_say():
    f = 4
    info = random_menu(1, 6, 3, f).of(np.arange(6))
    cov = np.linalg.inv(info)
    all_ = criteria(f)
    assert_allclose(size_of(all_["D"], info), np.linalg.det(cov) ** (1 / f), rtol=ROUNDING)
    assert_allclose(size_of(all_["A"], info), np.trace(cov) / f, rtol=ROUNDING)
    assert_allclose(size_of(all_["E"], info), np.linalg.eigvalsh(cov)[-1], rtol=ROUNDING)
    each = [np.trace(cov @ w) for w in all_["G"].weights]
    assert_allclose(size_of(all_["G"], info), max(each), rtol=ROUNDING)
    assert_allclose(size_of(all_["I"], info), np.mean(each), rtol=ROUNDING)
    for criterion in all_.values():  # all fall as 1/t
        assert_allclose(size_of(criterion, 2.5 * info), size_of(criterion, info) / 2.5)
        batch = sizes_of(criterion, np.array([info, 2.0 * info]))
        assert_allclose(batch, [size_of(criterion, info), size_of(criterion, 2.0 * info)])


@pytest.mark.parametrize("name", NAMES)
def test_what_tells_not_everything_has_no_size(name):
    info = random_menu(0, 1, 2, 3).of(np.array([0]))
    assert size_of(criteria(3)[name], info) == np.inf


@pytest.mark.parametrize("name", ["D", "A", "I"])
@pytest.mark.parametrize("r", [1, 3])
def test_updates_are_those_of_a_new_inverse(name, r):
    menu, criterion = random_menu(3, 12, r, 5), criteria(5)[name]
    info = menu.of(np.arange(12))
    found = criterion.after(np.linalg.inv(info), menu.rows)
    direct = [size_of(criterion, info + a.T @ a) for a in menu.rows]
    assert_allclose(found, direct, rtol=ROUNDING)


@pytest.mark.parametrize("name", ["E", "G"])
def test_updates_of_the_worst_are_bounds(name):
    menu, criterion = random_menu(3, 12, 2, 5), criteria(5)[name]
    info = menu.of(np.arange(12))
    cov = np.linalg.inv(info)
    direct = np.array([size_of(criterion, info + a.T @ a) for a in menu.rows])
    assert np.all(criterion.after(cov, menu.rows) <= direct * (1 + ROUNDING))
    assert np.trace(cov @ criterion.mix(cov)) <= float(criterion.size(cov)) * (1 + ROUNDING)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), name=st.sampled_from(NAMES))
def test_no_information_has_a_size_below_the_polar(seed, name):
    f = 4
    criterion = criteria(f, seed)[name]
    here, there = (random_menu(seed + i, 6, 2, f).of(np.arange(6)) for i in (1, 2))
    cov = np.linalg.inv(here)
    pull = polar(cov, criterion.mix(cov))
    assert size_of(criterion, there) >= 1.0 / np.trace(pull @ there) * (1 - ROUNDING)


# ---- designs -----------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), name=st.sampled_from(NAMES))
def test_an_exchange_never_worsens(seed, name):
    menu, criterion = random_menu(seed, 14, 1, 4), criteria(4, seed)[name]
    start = np.random.default_rng(seed).choice(14, 6, replace=False)
    before = size_of(criterion, menu.of(start))
    found = exchange(menu, criterion, start)
    assert found.size <= before
    assert_allclose(found.size, size_of(criterion, menu.of(found.chosen)), rtol=ROUNDING)
    assert len(set(found.chosen.tolist())) == 6
    again = exchange(menu, criterion, found.chosen)
    assert np.array_equal(again.chosen, found.chosen)
    few = np.arange(8)
    inside = exchange(menu, criterion, start, few)
    assert set(inside.chosen.tolist()) <= {*start.tolist(), *few.tolist()}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("at_hand", [False, True])
def test_small_menus_by_brute_force(name, seed, at_hand):
    menu, criterion = random_menu(seed, 11, 1, 3), criteria(3, seed)[name]
    if at_hand:
        menu = Menu(menu.rows, random_menu(seed + 9, 2, 1, 3).of(np.arange(2)))
    every = [np.array(one) for one in itertools.combinations(range(11), 5)]
    best = min(size_of(criterion, menu.of(one)) for one in every)
    found = best_design(menu, criterion, first_design(menu, criterion, 5, 0), silent)
    assert found.bound <= best * (1 + ROUNDING)
    assert_allclose(found.design.size, best, rtol=ROUNDING)


def polynomial(points: Array, degree: int, copies: int) -> Menu:
    rows = np.vander(points, degree + 1, increasing=True)
    return Menu(np.repeat(rows, copies, axis=0)[:, None], np.zeros((degree + 1,) * 2))


@pytest.mark.parametrize(
    ("degree", "support"),
    [(2, [-1.0, 0.0, 1.0]), (3, [-1.0, -1 / np.sqrt(5), 1 / np.sqrt(5), 1.0])],
)
def test_d_optimal_polynomials_are_the_known_ones(degree, support):
    """Equal weights on the zeros of (1 - x^2) P_n'(x) [Guest 1958; Hoel 1958]."""
    points = np.union1d(np.linspace(-1.0, 1.0, 21), support)
    each = 3
    menu, criterion = polynomial(points, degree, each), Determinant()
    count = each * len(support)
    found = best_design(menu, criterion, first_design(menu, criterion, count, 0), silent)
    at = points[found.design.chosen // each]
    assert_allclose(np.sort(at), np.repeat(support, each), rtol=0, atol=1e-12)
    known = np.vander(np.repeat(support, each), degree + 1, increasing=True)
    best = np.linalg.det(known.T @ known) ** (-1 / (degree + 1))
    assert_allclose(found.design.size, best, rtol=ROUNDING)
    assert_allclose(found.bound, best, rtol=ROUNDING)
    # Kiefer and Wolfowitz: at the optimum the largest variance of a prediction is f / n
    cov = inverse(menu.of(found.design.chosen))
    variance = np.einsum("cri,ij,crj->c", menu.rows, cov, menu.rows)
    assert_allclose(variance.max() * count, degree + 1, rtol=ROUNDING)
    assert_allclose(floor(menu, polar(cov, criterion.mix(cov)), count), best, rtol=ROUNDING)


@pytest.mark.parametrize("name", NAMES)
def test_the_bound_is_near_the_best_weights(name):
    """Below the convex problem's optimum, written down plainly for cvxpy, and near it."""
    cp = pytest.importorskip("cvxpy")
    menu, f, count = random_menu(2, 30, 2, 3), 3, 8
    criterion = criteria(f)[name]
    w = cp.Variable(30, nonneg=True)
    info = sum(w[j] * (menu.rows[j].T @ menu.rows[j]) for j in range(30))
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
        weights = criterion.weights if isinstance(criterion, Largest) else [criterion.weight]
        roots = [np.linalg.cholesky(part + 1e-12 * np.eye(f)) for part in weights]
        worst = cp.max(cp.hstack([cp.matrix_frac(root, info) for root in roots]))
        expected = cp.Problem(cp.Minimize(worst), rules).solve(solver="CLARABEL")
    found = lower_bound(menu, criterion, first_design(menu, criterion, count, 0))
    assert found <= expected * (1 + 1e-6)
    assert found >= expected * (1 - NEAR[name])


def test_too_few_experiments_are_told_with_how_many_it_takes():
    with pytest.raises(mc.OptionError, match=r"2 poses do not tell the 7 parameters .* at least 4"):
        first_design(random_menu(0, 30, 2, 7), Determinant(), 2, 0)
    flat = Menu(np.ones((20, 1, 2)), np.zeros((2, 2)))
    with pytest.raises(mc.OptionError, match="20 of the candidates do not tell"):
        first_design(flat, Determinant(), 3, 0)


def test_worth_is_the_number_of_random_ones_that_tell_as_much():
    menu, criterion = random_menu(8, 4000, 3, 3), Trace(np.eye(3))
    rng = np.random.default_rng(1)
    sizes = [size_of(criterion, menu.of(rng.choice(4000, 75, replace=False))) for _ in range(200)]
    assert worth(menu, criterion, 40, float(np.median(sizes)), 0) == pytest.approx(75, rel=0.05)
    assert worth(menu, criterion, 40, 1e-9, 0) == np.inf


# ---- indices and tours -------------------------------------------------------------------------


def test_observability_by_hand():
    found = observability(np.array([4.0, 2.0, 1.0]), 4)
    assert found == pytest.approx(
        {"O1": 2.0 / 2.0, "O2": 1 / 4, "O3": 1.0, "O4": 1 / 4, "O5": 1 / (1 / 4 + 1 / 2 + 1)}
    )
    assert set(observability(np.array([1.0, 0.0]), 3).values()) == {0.0}


@pytest.mark.parametrize("seed", range(4))
def test_a_short_way_is_near_the_shortest(seed):
    rng = np.random.default_rng(seed)
    q, sliding = rng.uniform(-2.0, 2.0, (6, 3)), np.array([False, True, False])
    begin = np.zeros(3)
    away = lengths(np.concatenate([begin[None], q]), sliding)
    ways = [(0, *way) for way in itertools.permutations(range(1, 7))]
    best = min(sum(away[a, b] for a, b in itertools.pairwise(way)) for way in ways)
    order = shortest(q, sliding, begin)
    assert sorted(order) == list(range(6))
    found = travel(np.concatenate([begin[None], q[order]]), sliding)
    assert best <= found + ROUNDING
    assert found <= 1.15 * best
    # no stretch turned round makes it shorter
    for i, j in itertools.combinations(range(6), 2):
        other = order.copy()
        other[i : j + 1] = other[i : j + 1][::-1]
        assert travel(np.concatenate([begin[None], q[other]]), sliding) >= found - ROUNDING


def test_travel_counts_the_joint_that_goes_farthest():
    q = np.array([[0.0, 0.0], [0.3, -0.1], [0.3, 0.4]])
    assert travel(q, np.array([False, False])) == pytest.approx(0.3 + 0.5)
    assert travel(q, np.array([False, True])) == pytest.approx(0.3 + 1.0)  # a slide of 0.5 m
    assert travel(q[:1], np.array([False, False])) == 0.0


def test_revisits_come_from_the_other_side():
    rng = np.random.default_rng(0)
    q, sliding = rng.uniform(-1.0, 1.0, (9, 3)), np.zeros(3, dtype=bool)
    far = np.full(3, 2.0)
    plain = visits(q, sliding, -far, far, 4)
    assert len(plain.pose) == 13
    assert not plain.via.any()
    assert_allclose(plain.q, q[plain.pose])
    both = visits(q, sliding, -far, far, 4, aside=True)
    assert both.via.sum() == 4
    again = np.flatnonzero(both.via) + 1
    for stop in again:
        first = int(np.flatnonzero(both.pose == both.pose[stop])[0])
        assert_allclose(both.q[stop], both.q[first])
        if first:
            assert np.array_equal(both.approach[stop], -both.approach[first])
    # at a limit there is no room to come from beyond it
    tight = visits(q, sliding, -far, q.max(axis=0), 9, aside=True)
    assert np.all(tight.q <= q.max(axis=0) + ROUNDING)


# ---- poses of an arm ---------------------------------------------------------------------------


def ahead_of(robot: mc.Robot, k: int, q: Array, seen: Array, noise: Instrument) -> Prospect:
    names = tuple(f"smr{i + 1}" for i in range(k))
    cell = cell_ahead(mc.Cell(robot, np.eye(4), names, ring(k)), np.array([3.0, 0.5, 1.0]))
    return prospect(cell, noise, q, seen)


def test_information_is_that_of_dense_covariances(robot):
    rng = np.random.default_rng(0)
    q = random_poses(robot, 40, rng)
    seen = rng.uniform(size=(40, 2)) < 0.7
    seen[:, 0] |= ~seen.any(axis=1)
    ahead = ahead_of(robot, 2, q, seen, Instrument(12e-6, 3e-6, 20e-6))
    cell = ahead.cell
    data = still(q, cell.target_names, robot)
    state = State(robot.mdh, cell.base[:3, :3], cell.base[:3, 3], cell.target_positions)
    jacobian = model_of(robot, data).jacobian(state)
    scene = Scene.of(
        robot, data, (state.rotation, state.origin), cell.target_positions, q * robot.sign
    )
    rows = ahead.ahead(q, seen)
    for pose in (0, 7, 23):
        chosen = np.flatnonzero(seen[pose])
        j = jacobian[pose, chosen].reshape(3 * len(chosen), -1)[:, ahead.active] / ahead.scale
        s = scene.jacobian[..., pose][:, chosen].reshape(6, -1).T
        away = np.linalg.norm(cell.predict(q[pose])[0, chosen], axis=-1)  # tracker at its origin
        v = np.diag(np.repeat((12e-6 + 3e-6 * away) ** 2, 3)) + (20e-6) ** 2 * s @ s.T
        expected = j.T @ np.linalg.inv(v) @ j
        assert_allclose(rows[pose].T @ rows[pose], expected, rtol=1e-7, atol=1e-9 * expected.max())


@pytest.mark.parametrize(
    ("noise", "most"),
    # a plain fit does not know that joints jitter and noise grows with range, the prediction does
    [(Instrument(12e-6, 0.0, 0.0), 1.09), (NOISE, 1.2)],
)
def test_predicted_variance_is_that_of_refits(robot, noise, most):
    rng = np.random.default_rng(3)
    q, work = random_poses(robot, 25, rng), random_poses(robot, 60, rng)
    ahead = ahead_of(robot, 1, q, np.ones((25, 1), dtype=bool), noise)
    menu = Menu(ahead.ahead(q, np.ones((25, 1), dtype=bool)), np.zeros((len(ahead.scale),) * 2))
    b = ahead.predictions(work)
    squares = (b.swapaxes(1, 2) @ b).reshape(len(b), -1)
    (predicted,) = sigmas(menu, [np.arange(25)], squares)
    cell, trials, total = ahead.cell, 40, 0.0
    truth = cell.predict(work)
    for _ in range(trials):
        y = cell.predict(q + noise.jitter * rng.normal(size=q.shape))
        spread = noise.noise + noise.per_metre * np.linalg.norm(y, axis=-1, keepdims=True)
        data = mc.measurements(q, y + spread * rng.normal(size=y.shape))
        fit = mc.calibrate(robot, data, "sum", holdout=0.0)
        assert fit.identification.active.sum() == ahead.active.sum()
        total += float(((fit.predict(work) - truth) ** 2).sum(axis=-1).mean())
    # 40 fits of 27 directions, of which some ten matter: 4 % of a sigma
    found = np.sqrt(total / trials)
    assert 0.91 < found / predicted[0] < most


def test_effects_are_unknowns_too(robot):
    q = random_poses(robot, 60, np.random.default_rng(0))
    seen = np.ones((60, 3), dtype=bool)
    plain = ahead_of(robot, 3, q, seen, NOISE)
    cell = with_effects(plain.cell, ("joint_compliance:J2", "encoder_gain:J1"), q)
    more = prospect(cell, NOISE, q, seen)
    extra = set(more.names) - set(plain.names)
    assert {name.partition(".")[0] for name in extra} == {"joint_compliance:J2", "encoder_gain:J1"}
    work = random_poses(robot, 50, np.random.default_rng(1))
    sigma = []
    for ahead in (plain, more):
        menu = Menu(ahead.ahead(q, seen), np.zeros((len(ahead.scale),) * 2))
        b = ahead.predictions(work)
        squares = (b.swapaxes(1, 2) @ b).reshape(len(b), -1)
        sigma.append(sigmas(menu, [np.arange(60)], squares)[0, 0])
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
    room, _, _ = surroundings(planned.cell, PlanOptions(targets=1))
    fresh = free_poses(room, 1000, 1_000_003)
    every = planned.candidates
    ahead = prospect(planned.cell, planned.instrument, every.q, every.seen)
    b = ahead.predictions(fresh)
    squares = (b.swapaxes(1, 2) @ b).reshape(len(b), -1)

    def told(q: Array, seen: Array, chosen: list[Array]) -> Array:
        menu = Menu(ahead.ahead(q, seen), np.zeros((len(ahead.scale),) * 2))
        return sigmas(menu, chosen, squares)[:, 0]

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
    cell = cell_ahead(mc.Cell(robot, np.eye(4), ("smr1",), ring(1)), np.array([3.0, 0.0, 1.0]))
    q = random_poses(robot, 15, rng)
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
    cell = cell_ahead(mc.Cell(robot, np.eye(4), ("smr1", "smr2", "smr3"), ring(3)),
                      np.array([3.0, 0.0, 1.0]))  # fmt: skip
    q = random_poses(robot, 80, rng)
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
    cell = cell_ahead(mc.Cell(real, np.eye(4), ("smr1", "smr2"), ring(2)), np.array([3.0, 0, 1.0]))
    bent = q + 3e-7 * gravity(real, q)
    bent[:, 2] += 2e-4 * q[:, 2]
    y = cell.predict(bent) + 15e-6 * rng.normal(size=(50, 2, 3))
    return mc.measurements(q, y, order=np.arange(50.0))


@pytest.fixture(scope="module")
def asked(robot: mc.Robot, narrow: mc.Measurements) -> Callable[..., separating.Question]:
    cell = mc.calibrate(robot, narrow, "sum", holdout=0.0).cell

    def question(*pair: str) -> separating.Question:
        return separating.question(robot, narrow, cell, pair, 0)

    return question


@pytest.mark.parametrize("pair", [GAIN, ("joint_compliance:J2", "base_flex:frame")])
def test_power_is_what_separate_says(asked, pair):
    """Its own proposal of more poses, given to us as candidates that are all measured."""
    one = asked(*pair)
    told = next_measurement.powers(one.site, one.pair)
    for count in (10, 80):
        rows = one.site.plan.rows("more", count)
        seen = one.site.plan.weight[:, rows].T > 0.0
        poses = one.site.plan.data.q[rows]
        ours = separating.contest(one, poses, seen, np.zeros(count, dtype=bool))
        # a doubt about masses is that of all proposed poses there, of these alone here
        near = 0.2 if pair != GAIN else 1e-3
        assert_allclose(ours.everything, told["more", count], rtol=near)
        assert_allclose(ours.now, told["old", 50], rtol=near)


def test_planned_poses_tell_effects_apart_sooner(robot, narrow):
    found = plan(robot, 8, data=narrow, separate=GAIN, candidates=150, acceptance=np.pi)
    (separation,) = found.separation
    assert found.criterion == POWER
    assert 1.0 / found.size > 2.0 / found.random  # powers: planned against random poses
    assert separation.now < 1.0 < separation.planned < separation.everything
    assert separation.planned == pytest.approx(1.0 / found.size, rel=0.05)  # visited in order
    assert separation.needed == ENOUGH
    assert not separation.alike
    assert f"{ENOUGH:.0f} is enough" in separation.headline()
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
    asked = separating.question(
        robot, narrow, fit.cell, ("joint_compliance:all", "link_bending:L2"), 0
    )
    assert asked.pair.known == ()
    asked = separating.question(robot, narrow, fit.cell, GAIN, 0)
    assert [term.label for term, _ in asked.pair.known] == ["joint_compliance:all"]


def test_revisits_from_the_other_side_show_play(asked, robot):
    rng = np.random.default_rng(1)
    one = asked(*GAIN)
    pair = next_measurement.Pair(Term("backlash", "J2"), np.array([3e-5]), one.pair.other)
    played = dataclasses.replace(one, pair=pair)
    q = random_poses(robot, 12, rng)
    seen = np.ones((12, 2), dtype=bool)
    far = np.full(6, 4.0)
    power = []
    for aside in (False, True):
        stops = visits(q, robot.prismatic, -far, far, 12, aside=aside)
        told = separating.contest(played, stops.q, seen[stops.pose], stops.via)
        power.append(told.everything)
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
    cell = cell_ahead(mc.Cell(robot, np.eye(4), ("smr1",), ring(1)), np.array([3.0, 0.0, 1.0]))
    with pytest.raises(mc.OptionError, match="leave tracker= and spots= out"):
        plan(robot, 10, fit=cell, tracker=(3.0, 0.0, 1.0))
    with pytest.raises(mc.OptionError, match=r"has 6 joints, but .* has 4"):
        plan("scara_600", 10, fit=cell)
    strange = mc.measurements(np.zeros((1, 6)), np.ones((1, 3, 3)))
    with pytest.raises(mc.OptionError, match="target smr2 is not one of the fit's"):
        plan(robot, 10, fit=cell, data=strange)
