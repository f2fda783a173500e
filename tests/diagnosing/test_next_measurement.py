"""Proposals for further measurements, against measuring them."""

import dataclasses
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.diagnosing.next_measurement import (
    AGAIN,
    MORE,
    PREPARE,
    Pair,
    Site,
    payload,
    powers,
    separate,
    separate_with,
)
from minimax_cal.evidence.bench import bench
from minimax_cal.evidence.library import Library
from minimax_cal.evidence.limits import NO_POWER
from minimax_cal.evidence.noise import Noise
from minimax_cal.evidence.stability import ENOUGH
from minimax_cal.fitting.options import Options, silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.history import with_history
from minimax_cal.modelling.dictionary import ArmLaws
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.joint_fit import scene_of
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.rows import linearised
from minimax_cal.modelling.simulate import Simulation, simulate

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


def site(robot: mc.Robot, data: mc.Measurements, noise: Noise) -> Site:
    data = with_history(data)
    state = fit_cell(robot, data, Options(objective="sum"), silent).state
    model = model_of(robot, data)
    return Site(scene_of(robot, data, model, state), model, state, noise)


def measured(sim: Simulation, q: Array, seed: int, **columns: Array) -> mc.Measurements:
    y = sim.cell.predict(q)
    y = y + 17e-6 * np.random.default_rng(seed).normal(size=y.shape)
    return mc.measurements(q, y, order=np.arange(len(q), dtype=float), **columns)


@pytest.fixture(scope="module")
def sim(robot: mc.Robot) -> Simulation:
    return simulate(robot, 70, 3, seed=3)


@pytest.fixture(scope="module")
def wide(robot: mc.Robot, sim: Simulation) -> Site:
    return site(robot, sim.data, QUIET)


@pytest.fixture(scope="module")
def narrow(robot: mc.Robot, sim: Simulation) -> Site:
    half = np.array([0.3, 0.5, 0.4, 1.0, 0.8, 2.0])
    q = np.random.default_rng(0).uniform(-half, half, (60, 6))
    q[:, 1] += 0.2
    return site(robot, measured(sim, q, 1), QUIET)


def first(place: Site, key: tuple[str, int]) -> mc.Measurements:
    """The poses at hand with those of one proposal."""
    rows = place.plan.rows(*key)
    chosen = np.union1d(np.arange(place.scene.poses), np.arange(rows.start, rows.stop))
    return place.plan.data.take(chosen)


def by_hand(
    place: Site, key: tuple[str, int], one: Term, value: Array, other: Term, known: list[Term]
) -> float:
    """Power by dense covariances and a projection of all columns, doubts of no law."""
    data = first(place, key)
    data = data.with_y(np.ones_like(data.y) * np.arange(1.0, 1.0 + data.poses)[:, None, None])
    model = model_of(place.scene.robot, data)
    scene = scene_of(place.scene.robot, data, model, place.state)
    k, _, m = scene.points.shape
    jacobian = model.jacobian(place.state).reshape(m, 3 * k, -1)

    def rowed(fields: Array) -> Array:  # (d, k, 3, m) -> (m, 3k, d)
        return np.moveaxis(fields.reshape(-1, 3 * k, m), (0, 1, 2), (2, 1, 0))

    arm = rowed(scene.jacobian)
    cov = place.noise.variance * np.eye(3 * k) + place.noise.jitter**2 * arm @ arm.swapaxes(1, 2)
    white = np.linalg.inv(np.linalg.cholesky(cov))
    terms = [rowed(t.columns(scene).displacement(scene)) for t in (*known, other)]
    field = (white @ rowed(one.columns(scene).displacement(scene)) @ value).reshape(-1)
    matrix = (white @ np.concatenate([jacobian, *terms], axis=2)).reshape(3 * k * m, -1)
    norm = np.linalg.norm(matrix, axis=0)
    matrix = matrix[:, norm > 0] / norm[norm > 0]
    rest = field - matrix @ np.linalg.lstsq(matrix, field, rcond=1e-6)[0]
    return float(rest @ rest)


@pytest.mark.parametrize("key", [("old", 70), ("more", 10), ("more", 80), ("late", 20)])
def test_power_is_that_of_a_dense_fit_to_all_poses(wide: Site, key: tuple[str, int]) -> None:
    for noise in (QUIET, SHAKY):
        place = dataclasses.replace(wide, noise=noise)
        found = powers(place, Pair(GROWTH, np.array([1e-5]), DRIFT, [(GAIN, np.array([1e-4]))]))
        expected = by_hand(place, key, GROWTH, np.array([1e-5]), DRIFT, [GAIN])
        assert_allclose(found[key], expected, rtol=ROUNDING)


@pytest.mark.parametrize(
    ("one", "value", "key"), [(J2, 1e-7, ("load", 20)), (PLAY, 1e-4, ("side", 40))]
)
def test_power_of_revisits_is_that_of_a_dense_fit(
    wide: Site, one: Term, value: float, key: tuple[str, int]
) -> None:
    found = powers(wide, Pair(one, np.array([value]), GAIN))
    assert_allclose(found[key], by_hand(wide, key, one, np.array([value]), GAIN, []), rtol=ROUNDING)


@pytest.mark.parametrize(
    ("one", "value", "other"),
    [(GAIN, [1e-5], GEAR), (J2, [3e-8], BASE), (GEAR, [2e-5, 1e-5], GAIN)],
)
def test_power_now_is_what_rivals_say(
    robot: mc.Robot, sim: Simulation, wide: Site, one: Term, value: list[float], other: Term
) -> None:
    rows = linearised(wide.model, wide.state, wide.scene.jacobian)
    lib = Library.empty(ArmLaws(wide.scene, rows))
    both = lib.with_terms([(one, 1.0), (other, 1.0)])
    table = bench(lib, ())
    added = dataclasses.replace(table.added(both[0]), value=np.array(value))
    size, rho2 = table.likeness(added, both[1])
    jitter = np.sqrt(added.ratio * added.variance / rows.size)
    same = dataclasses.replace(wide, noise=Noise(added.ratio, added.variance, float(jitter)))
    now = powers(same, Pair(one, np.array(value), other))["old", 70]
    # a rival's doubts about masses are those of all proposed poses, not of these alone
    assert_allclose(now, size * (1.0 - rho2), rtol=0.1 if other is BASE else ROUNDING)


@pytest.mark.parametrize(
    ("one", "value", "other"), [(GAIN, [1e-4], GEAR), (J2, [1e-7], BASE), (PLAY, [1e-4], LATE)]
)
def test_power_for_more_poses_is_that_of_a_bigger_data_set(
    robot: mc.Robot, sim: Simulation, wide: Site, one: Term, value: list[float], other: Term
) -> None:
    told = powers(wide, Pair(one, np.array(value), other))
    data = first(wide, ("more", 40))
    bigger = dataclasses.replace(data, y=measured(sim, data.q, 7).y)
    again = site(robot, bigger, QUIET)
    found = powers(again, Pair(one, np.array(value), other))["old", 110]
    assert_allclose(told["more", 40], found, rtol=REFIT)
    assert told["old", 70] < told["more", 10] < told["more", 40]


def test_a_reflector_on_the_foot_tells_the_base_from_joint_2(narrow: Site) -> None:
    for one, value, other in ((J2, 2e-7, BASE), (BASE, 1e-7, J2)):
        found = powers(narrow, Pair(one, np.array([value]), other))
        assert found["old", 60] < ENOUGH < found["foot", 40]
        assert found["foot", 10] > 1.1 * found["old", 60]
    assert "foot" in " ".join(a.text for a in separate(narrow, Pair(BASE, np.array([1e-7]), J2)))


def test_the_foot_says_what_three_points_fixed_to_the_base_do(narrow: Site) -> None:
    """The gain by the foot is bounded by, and near, the weight of its own rows where rho^2 is 1."""
    up, reach = narrow.scene.robot.up, narrow.scene.robot.reach()
    rows = narrow.plan.rows("foot", 20)
    found = powers(narrow, Pair(BASE, np.array([1e-7]), J2))
    still = dataclasses.replace(narrow.whole, points=np.zeros((1, 3, narrow.plan.data.poses)))
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


def test_gain_and_gear_are_told_apart_by_more_range(narrow: Site, wide: Site) -> None:
    value = np.array([2e-4])
    found = powers(narrow, Pair(GAIN, value, GEAR))
    assert found["old", 60] < 1.0
    assert found["more", 10] > ENOUGH
    text = separate_with(narrow, Pair(GAIN, value, GEAR))
    advices = separate(narrow, Pair(GAIN, value, GEAR))
    assert text == next(advice.text for advice in advices if advice.power > ENOUGH)
    assert re.findall(r"\d+", text) == ["10"]
    assert {kind for kind, _ in found} == {"old", "more"}  # no revisit concerns them
    assert "workspace" in separate_with(wide, Pair(GAIN, value, GEAR))


def test_backlash_and_settling_are_told_apart_by_approaches(
    robot: mc.Robot, sim: Simulation
) -> None:
    half = np.array([1.5, 0.5, 0.5, 1.5, 0.2, 2.0])
    rng = np.random.default_rng(2)
    q = rng.uniform(-half, half, (50, 6))
    q[:, 4] = 0.2 + 0.4 * (np.arange(50) % 2)  # joint 5 goes to and fro, always as far
    here = site(robot, measured(sim, q, 4), QUIET)
    found = powers(here, Pair(PLAY, np.array([5e-4]), LATE))
    assert found["old", 50] < 1e-3
    assert found["side", 10] > ENOUGH
    assert found["more", 10] > ENOUGH  # moves of many sizes
    here = site(robot, measured(sim, q, 4), SHAKY)
    advices = separate(here, Pair(PLAY, np.array([3e-5]), LATE))
    best = max(advices, key=lambda advice: advice.power)
    assert best.power < ENOUGH
    assert f"{best.power:.2g}" in separate_with(here, Pair(PLAY, np.array([3e-5]), LATE))


def test_revisits_are_proposed_where_they_concern_the_effects(wide: Site) -> None:
    kinds = {
        pair: {kind for kind, _ in powers(wide, Pair(pair[0], value, pair[1]))} - {"old"}
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


def test_more_of_a_kind_never_tells_less(wide: Site, narrow: Site) -> None:
    for place in (wide, narrow):
        known = [(GEAR, np.array([1e-4, 1e-4]))]
        for one, value, other in ((DRIFT, CREEP, GROWTH), (J2, np.array([1e-7]), BASE)):
            found = powers(place, Pair(one, value, other, known))
            now = found["old", place.scene.poses]
            for kind in PREPARE:
                several = [power for (name, _), power in found.items() if name == kind]
                assert np.all(np.diff([now, *several]) >= -1e-6 * now), kind


def test_advice_is_sorted_by_cost_and_the_cheapest_that_is_enough_is_given(narrow: Site) -> None:
    advices = separate(narrow, Pair(BASE, np.array([1e-7]), J2))
    minutes = [advice.minutes for advice in advices]
    assert minutes == sorted(minutes)
    enough = [a for a in advices if a.power >= ENOUGH]
    assert separate_with(narrow, Pair(BASE, np.array([1e-7]), J2)) == enough[0].text
    weak = separate_with(narrow, Pair(BASE, np.array([1e-9]), J2))
    assert weak.endswith("of the 25 needed")


def test_what_includes_the_effect_cannot_be_told_from_it(wide: Site) -> None:
    everywhere = Term("encoder_gain", "all", {"joints": 63.0})
    pair = Pair(GAIN, np.array([1e-4]), everywhere)
    assert max(advice.power for advice in separate(wide, pair)) < NO_POWER
    assert separate_with(wide, pair).startswith("no measurement")


def test_proposed_poses_can_be_reached_and_seen(narrow: Site, wide: Site) -> None:
    for place in (narrow, wide):
        robot, scene = place.scene.robot, place.whole
        new = place.plan.rows("more", max(MORE))
        q = place.plan.data.q[new]
        assert np.all((q >= np.maximum(robot.lower, -2 * np.pi)) & (q <= robot.upper))
        away = np.linalg.norm(scene.links.origin - scene.instrument[:, None], axis=0)
        old = away[: place.scene.poses]
        assert away[new].min() > 0.8 * old.min()
        assert away[new].max() < 1.2 * old.max()
        assert (robot.up @ scene.links.origin[:, new]).min() > -0.2 * robot.reach()


def test_joints_without_limits_stay_where_the_data_were(robot: mc.Robot, narrow: Site) -> None:
    free = dataclasses.replace(robot, lower=np.full(6, -np.inf), upper=np.full(6, np.inf))
    scene = dataclasses.replace(narrow.scene, robot=free)
    here = dataclasses.replace(narrow, scene=scene)
    q, new = scene.data.q, here.plan.data.q
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
    found = powers(here, Pair(torque, np.array([1e-3]), BASE))
    assert all(np.isfinite(power) for power in found.values())
    assert ("load", AGAIN[-1]) in found
    assert "kg more" in " ".join(
        a.text for a in separate(here, Pair(torque, np.array([1e-3]), BASE))
    )
    warm = Term("thermal_growth", "all", {"temperature": 1.0, "apart": 0.0})
    assert ("late", 10) in powers(here, Pair(warm, np.array([1e-6]), BASE))


def test_few_poses_are_no_obstacle(robot: mc.Robot, sim: Simulation) -> None:
    here = site(robot, measured(sim, sim.data.q[:25], 6), QUIET)
    found = powers(here, Pair(J2, np.array([1e-7]), BASE))
    assert [count for kind, count in found if kind == "load"] == [10, 20, 25]


def test_payload_is_one_that_the_arm_carries(wide: Site) -> None:
    assert 1.0 <= payload(wide.scene) <= 20.0
    digits = f"{payload(wide.scene):e}"
    assert digits[0] in "125"
