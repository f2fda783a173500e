"""Proposals for further measurements, against measuring them."""

import dataclasses
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.next_measurement import (
    MORE_POSE_COUNTS,
    PREPARATION_MINUTES,
    REVISIT_POSE_COUNTS,
    ConfusedEffects,
    MeasurementPlanner,
    describe_best_separation,
    propose_payload,
    rank_separating_measurements,
    separation_powers,
)
from minimax_cal.fitting.cell_fit import fit_cell
from minimax_cal.fitting.options import Options, silent_progress
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.arm_laws import ArmLaws
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.effects_in_model import pose_arm_at_values
from minimax_cal.modelling.error_rows import linearise_to_point_rows
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.modelling.simulate import Simulation, simulate
from minimax_cal.selection.candidate_library import CandidateLibrary
from minimax_cal.selection.candidate_tests import build_candidate_tests
from minimax_cal.selection.noise_model import Noise
from minimax_cal.selection.stability_selection import SUFFICIENT_SEPARATION_POWER
from minimax_cal.selection.thresholds import MAX_NEGLIGIBLE_POWER

ROUNDING = 1e-6  # relative: the same numbers by other algebra
REFIT = 0.03  # relative: another fit of the geometry, to other noise
QUIET = Noise(0.0, (17e-6) ** 2, 8e-6)
SHAKY = Noise(0.0, (17e-6) ** 2, 60e-6)
J2 = Term("joint_compliance", "J2", {"parts": float(1 << 7)})  # the whole torque
BASE = Term("base_flex", "frame")
GAIN, GEAR = Term("encoder_gain", "J3"), Term("gear_error", "J3", {"turns": 1.0})
PLAY, LATE = Term("backlash", "J5"), Term("settling", "J5")
DRIFT = Term("frame_drift", "frame", {"constant": np.inf})
GROWTH = Term("thermal_growth", "all", {"constant": 0.5, "apart": 0.0})
CREEP = np.array([2e-5] * 3 + [1e-5] * 3)


def site(robot: mc.Robot, data: mc.Measurements, noise: Noise) -> MeasurementPlanner:
    data = add_history_columns(data)
    state = fit_cell(robot, data, Options(objective="sum"), silent_progress).state
    model = build_point_model(robot, data)
    return MeasurementPlanner(pose_arm_at_values(robot, data, model, state), model, state, noise)


def measured(sim: Simulation, q: Array, seed: int, **columns: Array) -> mc.Measurements:
    y = sim.cell.predict(q)
    y = y + 17e-6 * np.random.default_rng(seed).normal(size=y.shape)
    return mc.measurements(q, y, order=np.arange(len(q), dtype=float), **columns)


@pytest.fixture(scope="module")
def sim(robot: mc.Robot) -> Simulation:
    return simulate(robot, 70, 3, seed=3)


@pytest.fixture(scope="module")
def wide(robot: mc.Robot, sim: Simulation) -> MeasurementPlanner:
    return site(robot, sim.data, QUIET)


@pytest.fixture(scope="module")
def narrow(robot: mc.Robot, sim: Simulation) -> MeasurementPlanner:
    half = np.array([0.3, 0.5, 0.4, 1.0, 0.8, 2.0])
    q = np.random.default_rng(0).uniform(-half, half, (60, 6))
    q[:, 1] += 0.2
    return site(robot, measured(sim, q, 1), QUIET)


def first(place: MeasurementPlanner, key: tuple[str, int]) -> mc.Measurements:
    """The poses at hand with those of one proposal."""
    rows = place.measurement_plan.select_plan_rows(*key)
    chosen = np.union1d(np.arange(place.scene.poses), np.arange(rows.start, rows.stop))
    return place.measurement_plan.data.take(chosen)


def by_hand(
    place: MeasurementPlanner,
    key: tuple[str, int],
    one: Term,
    value: Array,
    other: Term,
    known: list[Term],
) -> float:
    """Power by dense covariances and a projection of all columns, doubts of no law."""
    data = first(place, key)
    data = data.with_y(np.ones_like(data.y) * np.arange(1.0, 1.0 + data.poses)[:, None, None])
    model = build_point_model(place.scene.robot, data)
    scene = pose_arm_at_values(place.scene.robot, data, model, place.state)
    k, _, m = scene.points.shape
    jacobian = model.point_jacobian(place.state).reshape(m, 3 * k, -1)

    def rowed(fields: Array) -> Array:  # (d, k, 3, m) -> (m, 3k, d)
        return np.moveaxis(fields.reshape(-1, 3 * k, m), (0, 1, 2), (2, 1, 0))

    arm = rowed(scene.jacobian)
    cov = place.noise.variance * np.eye(3 * k) + place.noise.joint_jitter**2 * arm @ arm.swapaxes(
        1, 2
    )
    white = np.linalg.inv(np.linalg.cholesky(cov))
    terms = [rowed(t.columns(scene).target_displacements(scene)) for t in (*known, other)]
    field = (white @ rowed(one.columns(scene).target_displacements(scene)) @ value).reshape(-1)
    matrix = (white @ np.concatenate([jacobian, *terms], axis=2)).reshape(3 * k * m, -1)
    norm = np.linalg.norm(matrix, axis=0)
    matrix = matrix[:, norm > 0] / norm[norm > 0]
    rest = field - matrix @ np.linalg.lstsq(matrix, field, rcond=1e-6)[0]
    return float(rest @ rest)


@pytest.mark.parametrize("key", [("old", 70), ("more", 10), ("more", 80), ("late", 20)])
def test_power_is_that_of_a_dense_fit_to_all_poses(
    wide: MeasurementPlanner, key: tuple[str, int]
) -> None:
    for noise in (QUIET, SHAKY):
        place = dataclasses.replace(wide, noise=noise)
        found = separation_powers(
            place, ConfusedEffects(GROWTH, np.array([1e-5]), DRIFT, [(GAIN, np.array([1e-4]))])
        )
        expected = by_hand(place, key, GROWTH, np.array([1e-5]), DRIFT, [GAIN])
        assert_allclose(found[key], expected, rtol=ROUNDING)


@pytest.mark.parametrize(
    ("one", "value", "key"), [(J2, 1e-7, ("load", 20)), (PLAY, 1e-4, ("side", 40))]
)
def test_power_of_revisits_is_that_of_a_dense_fit(
    wide: MeasurementPlanner, one: Term, value: float, key: tuple[str, int]
) -> None:
    found = separation_powers(wide, ConfusedEffects(one, np.array([value]), GAIN))
    assert_allclose(found[key], by_hand(wide, key, one, np.array([value]), GAIN, []), rtol=ROUNDING)


@pytest.mark.parametrize(
    ("one", "value", "other"),
    [(GAIN, [1e-5], GEAR), (J2, [3e-8], BASE), (GEAR, [2e-5, 1e-5], GAIN)],
)
def test_power_now_is_what_rivals_say(
    robot: mc.Robot,
    sim: Simulation,
    wide: MeasurementPlanner,
    one: Term,
    value: list[float],
    other: Term,
) -> None:
    rows = linearise_to_point_rows(wide.model, wide.state, wide.scene.jacobian)
    lib = CandidateLibrary.without_candidates(ArmLaws(wide.scene, rows))
    both = lib.add_terms([(one, 1.0), (other, 1.0)])
    table = build_candidate_tests(lib, ())
    added = dataclasses.replace(table.fit_candidate(both[0]), values=np.array(value))
    size, rho2 = table.similarity_to_candidate(added, both[1])
    jitter = np.sqrt(added.noise_ratio * added.noise_variance / rows.mean_variance_ratio)
    same = dataclasses.replace(
        wide, noise=Noise(added.noise_ratio, added.noise_variance, float(jitter))
    )
    now = separation_powers(same, ConfusedEffects(one, np.array(value), other))["old", 70]
    # a rival's doubts about masses are those of all proposed poses, not of these alone
    assert_allclose(now, size * (1.0 - rho2), rtol=0.1 if other is BASE else ROUNDING)


@pytest.mark.parametrize(
    ("one", "value", "other"), [(GAIN, [1e-4], GEAR), (J2, [1e-7], BASE), (PLAY, [1e-4], LATE)]
)
def test_power_for_more_poses_is_that_of_a_bigger_data_set(
    robot: mc.Robot,
    sim: Simulation,
    wide: MeasurementPlanner,
    one: Term,
    value: list[float],
    other: Term,
) -> None:
    told = separation_powers(wide, ConfusedEffects(one, np.array(value), other))
    data = first(wide, ("more", 40))
    bigger = dataclasses.replace(data, y=measured(sim, data.q, 7).y)
    again = site(robot, bigger, QUIET)
    found = separation_powers(again, ConfusedEffects(one, np.array(value), other))["old", 110]
    assert_allclose(told["more", 40], found, rtol=REFIT)
    assert told["old", 70] < told["more", 10] < told["more", 40]


def test_a_reflector_on_the_foot_tells_the_base_from_joint_2(narrow: MeasurementPlanner) -> None:
    for one, value, other in ((J2, 2e-7, BASE), (BASE, 1e-7, J2)):
        found = separation_powers(narrow, ConfusedEffects(one, np.array([value]), other))
        assert found["old", 60] < SUFFICIENT_SEPARATION_POWER < found["foot", 40]
        assert found["foot", 10] > 1.1 * found["old", 60]
    assert "foot" in " ".join(
        a.text
        for a in rank_separating_measurements(narrow, ConfusedEffects(BASE, np.array([1e-7]), J2))
    )


def test_the_foot_says_what_three_points_fixed_to_the_base_do(narrow: MeasurementPlanner) -> None:
    """The gain by the foot is bounded by, and near, the weight of its own rows where rho^2 is 1."""
    up, reach = narrow.scene.robot.up, narrow.scene.robot.reach()
    rows = narrow.measurement_plan.select_plan_rows("foot", 20)
    found = separation_powers(narrow, ConfusedEffects(BASE, np.array([1e-7]), J2))
    still = dataclasses.replace(
        narrow.planned_arm, points=np.zeros((1, 3, narrow.measurement_plan.data.poses))
    )
    # about points near the origin the turn of the base alone counts: take three unit offsets
    turned = BASE.columns(
        dataclasses.replace(still, points=np.eye(3)[:, :, None] + 0.0 * still.points)
    )
    motion = 1e-7 * turned.shift[0][..., rows]  # omega x e_a, no payload here
    across = np.linalg.svd(up[None])[2][1:]
    angle = 2 * np.pi * np.arange(3) / 3
    feet = 0.2 * reach * np.stack([np.cos(angle), np.sin(angle)], axis=1) @ across
    foot = np.einsum("fa,acm->fcm", feet, motion)
    foot = foot - foot.mean(axis=-1, keepdims=True)
    gain = float((foot**2).sum()) / narrow.noise.variance
    assert found["foot", 20] - found["old", 60] == pytest.approx(gain, rel=0.05)


def test_gain_and_gear_are_told_apart_by_more_range(
    narrow: MeasurementPlanner, wide: MeasurementPlanner
) -> None:
    value = np.array([2e-4])
    found = separation_powers(narrow, ConfusedEffects(GAIN, value, GEAR))
    assert found["old", 60] < 1.0
    assert found["more", 10] > SUFFICIENT_SEPARATION_POWER
    text = describe_best_separation(narrow, ConfusedEffects(GAIN, value, GEAR))
    advices = rank_separating_measurements(narrow, ConfusedEffects(GAIN, value, GEAR))
    assert text == next(
        advice.text for advice in advices if advice.power > SUFFICIENT_SEPARATION_POWER
    )
    assert re.findall(r"\d+", text) == ["10"]
    assert {kind for kind, _ in found} == {"old", "more"}  # no revisit concerns them
    assert "workspace" in describe_best_separation(wide, ConfusedEffects(GAIN, value, GEAR))


def test_backlash_and_settling_are_told_apart_by_approaches(
    robot: mc.Robot, sim: Simulation
) -> None:
    half = np.array([1.5, 0.5, 0.5, 1.5, 0.2, 2.0])
    rng = np.random.default_rng(2)
    q = rng.uniform(-half, half, (50, 6))
    q[:, 4] = 0.2 + 0.4 * (np.arange(50) % 2)  # joint 5 goes to and fro, always as far
    here = site(robot, measured(sim, q, 4), QUIET)
    found = separation_powers(here, ConfusedEffects(PLAY, np.array([5e-4]), LATE))
    assert found["old", 50] < 1e-3
    assert found["side", 10] > SUFFICIENT_SEPARATION_POWER
    assert found["more", 10] > SUFFICIENT_SEPARATION_POWER  # moves of many sizes
    here = site(robot, measured(sim, q, 4), SHAKY)
    advices = rank_separating_measurements(here, ConfusedEffects(PLAY, np.array([3e-5]), LATE))
    best = max(advices, key=lambda advice: advice.power)
    assert best.power < SUFFICIENT_SEPARATION_POWER
    assert f"{best.power:.2g}" in describe_best_separation(
        here, ConfusedEffects(PLAY, np.array([3e-5]), LATE)
    )


def test_revisits_are_proposed_where_they_concern_the_effects(wide: MeasurementPlanner) -> None:
    kinds = {
        pair: {
            kind for kind, _ in separation_powers(wide, ConfusedEffects(pair[0], value, pair[1]))
        }
        - {"old"}
        for pair, value in {
            (GAIN, GEAR): np.array([1e-4]),
            (J2, GAIN): np.array([1e-7]),
            (PLAY, GAIN): np.array([1e-4]),
            (GROWTH, GAIN): np.array([1e-5]),
            (DRIFT, GROWTH): CREEP,
            (BASE, GEAR): np.array([1e-7]),
        }.items()
    }
    assert kinds == {
        (GAIN, GEAR): {"more"},
        (J2, GAIN): {"more", "load"},
        (PLAY, GAIN): {"more", "side"},
        (GROWTH, GAIN): {"more", "late"},
        (DRIFT, GROWTH): {"more", "late", "foot"},
        (BASE, GEAR): {"more", "load", "foot"},
    }


def test_more_of_a_kind_never_tells_less(
    wide: MeasurementPlanner, narrow: MeasurementPlanner
) -> None:
    for place in (wide, narrow):
        known = [(GEAR, np.array([1e-4, 1e-4]))]
        for one, value, other in ((DRIFT, CREEP, GROWTH), (J2, np.array([1e-7]), BASE)):
            found = separation_powers(place, ConfusedEffects(one, value, other, known))
            now = found["old", place.scene.poses]
            for kind in PREPARATION_MINUTES:
                several = [power for (name, _), power in found.items() if name == kind]
                assert np.all(np.diff([now, *several]) >= -1e-6 * now), kind


def test_advice_is_sorted_by_cost_and_the_cheapest_that_is_enough_is_given(
    narrow: MeasurementPlanner,
) -> None:
    advices = rank_separating_measurements(narrow, ConfusedEffects(BASE, np.array([1e-7]), J2))
    minutes = [advice.minutes for advice in advices]
    assert minutes == sorted(minutes)
    enough = [a for a in advices if a.power >= SUFFICIENT_SEPARATION_POWER]
    assert (
        describe_best_separation(narrow, ConfusedEffects(BASE, np.array([1e-7]), J2))
        == enough[0].text
    )
    weak = describe_best_separation(narrow, ConfusedEffects(BASE, np.array([1e-9]), J2))
    assert weak.endswith("of the 25 needed")


def test_what_includes_the_effect_cannot_be_told_from_it(wide: MeasurementPlanner) -> None:
    everywhere = Term("encoder_gain", "all", {"joints": 63.0})
    pair = ConfusedEffects(GAIN, np.array([1e-4]), everywhere)
    assert (
        max(advice.power for advice in rank_separating_measurements(wide, pair))
        < MAX_NEGLIGIBLE_POWER
    )
    assert describe_best_separation(wide, pair).startswith("no measurement")


def test_proposed_poses_can_be_reached_and_seen(
    narrow: MeasurementPlanner, wide: MeasurementPlanner
) -> None:
    for place in (narrow, wide):
        robot, scene = place.scene.robot, place.planned_arm
        new = place.measurement_plan.select_plan_rows("more", max(MORE_POSE_COUNTS))
        q = place.measurement_plan.data.q[new]
        assert np.all((q >= np.maximum(robot.lower, -2 * np.pi)) & (q <= robot.upper))
        away = np.linalg.norm(scene.links.origin - scene.instrument[:, None], axis=0)
        old = away[: place.scene.poses]
        assert away[new].min() > 0.8 * old.min()
        assert away[new].max() < 1.2 * old.max()
        assert (robot.up @ scene.links.origin[:, new]).min() > -0.2 * robot.reach()


def test_joints_without_limits_stay_where_the_data_were(
    robot: mc.Robot, narrow: MeasurementPlanner
) -> None:
    free = dataclasses.replace(robot, lower=np.full(6, -np.inf), upper=np.full(6, np.inf))
    scene = dataclasses.replace(narrow.scene, robot=free)
    here = dataclasses.replace(narrow, scene=scene)
    q, new = scene.data.q, here.measurement_plan.data.q
    assert np.all((new >= q.min(axis=0)) & (new <= q.max(axis=0)))


def test_every_column_is_kept(robot: mc.Robot, sim: Simulation) -> None:
    """Measured torques, temperature, text labels and unmeasured points come along."""
    q = sim.data.q[:40]
    tau = {f"tau{j + 1}": np.random.default_rng(j).normal(size=40) for j in range(6)}
    more = {"temperature": np.linspace(20, 25, 40), "payload": np.full(40, 3.0)}
    labels = {"session": np.repeat(["a", "b"], 20), "u95": np.full(40, 2e-5)}
    data = measured(sim, q, 5, **tau, **more, **labels)
    y = data.y.copy()
    y[::3, 0] = np.nan
    here = site(robot, data.with_y(y), QUIET)
    torque = Term("joint_compliance", "J2", {"parts": float(1 << 7)})
    found = separation_powers(here, ConfusedEffects(torque, np.array([1e-3]), BASE))
    assert all(np.isfinite(power) for power in found.values())
    assert ("load", REVISIT_POSE_COUNTS[-1]) in found
    assert "kg more" in " ".join(
        a.text
        for a in rank_separating_measurements(here, ConfusedEffects(torque, np.array([1e-3]), BASE))
    )
    warm = Term("thermal_growth", "all", {"temperature": 1.0, "apart": 0.0})
    assert ("late", 10) in separation_powers(here, ConfusedEffects(warm, np.array([1e-6]), BASE))


def test_few_poses_are_no_obstacle(robot: mc.Robot, sim: Simulation) -> None:
    here = site(robot, measured(sim, sim.data.q[:25], 6), QUIET)
    found = separation_powers(here, ConfusedEffects(J2, np.array([1e-7]), BASE))
    assert [count for kind, count in found if kind == "load"] == [10, 20, 25]


def test_payload_is_one_that_the_arm_carries(wide: MeasurementPlanner) -> None:
    assert 1.0 <= propose_payload(wide.scene) <= 20.0
    digits = f"{propose_payload(wide.scene):e}"
    assert digits[0] in "125"
