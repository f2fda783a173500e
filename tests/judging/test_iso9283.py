"""Values by the formulas of ISO 9283: by hand, in closed form, and from motions that are known."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from scipy.stats import chi

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError, OptionError
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.validation.iso9283 import Iso9283, compute_iso9283
from minimax_cal.validation.iso9283.formulas import (
    distance_accuracy,
    distance_accuracy_and_repeatability,
    euler_angles,
    euler_deviation,
    fit_rotations,
    mean_rotations,
    multidirectional_variation,
    orientation_error,
    position_repeatability,
)
from minimax_cal.validation.iso9283.result import STANDARD_CYCLE_COUNT
from minimax_cal.validation.iso9283.visits import build_stops

TRIANGLE = np.array([[0.1, 0.0, 0.03], [-0.05, 0.09, 0.03], [-0.05, -0.09, 0.03]])
EXACT = dict(rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def cell(robot: mc.Robot) -> mc.Cell:
    base = np.eye(4)
    base[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 1.1]).as_matrix()
    base[:3, 3] = 1.0, 2.0, -0.5
    return mc.Cell(robot, base, ("smr1", "smr2", "smr3"), TRIANGLE)


def level_poses(robot: mc.Robot, count: int, seed: int = 3) -> Array:
    """Joints whose flange is far from gimbal lock."""
    q = random_joint_values_above_floor(robot, 4 * count, np.random.default_rng(seed))
    b = euler_angles(robot.pose(q)[:, :3, :3])[:, 1]
    return q[np.cos(b) > 0.3][:count]


def seen_at(cell: mc.Cell, q: Array, **columns: Array) -> Measurements:
    """What the arm shows if it goes exactly where it is commanded."""
    return measurements(q, cell.predict(q), **columns)


def of(cell: mc.Cell, data: Measurements, **choice: object) -> Iso9283:
    """All poses as training poses of one cell."""
    held = np.zeros(data.poses, dtype=bool)
    return compute_iso9283({"after": cell}, data, held, **choice)


def turned(cell: mc.Cell, y: Array, shift: Array, turn: Array) -> Array:
    """Points moved in the axes of the base: each triangle turned about its own centroid."""
    axes = cell.base[:3, :3]
    spin = axes @ Rotation.from_rotvec(turn).as_matrix() @ axes.T
    centre = y.mean(axis=1, keepdims=True)
    return np.asarray(centre + (y - centre) @ spin.T + axes @ shift)


# ---- formulas ------------------------------------------------------------------------------------


def test_repeatability_by_hand():
    # a square around (1, 2, 3): every l is 2, so S_l = 0; two points 6 apart: l = 3, S_l = 0
    square = np.array([[3, 2, 3], [-1, 2, 3], [1, 4, 3], [1, 0, 3]])
    pair = np.array([[0, 0, 0], [0, 0, 6]])
    # on a line, 0 0 3: barycentre 1, l = 1 1 2, mean 4/3, S_l = 1/sqrt(3)
    line = np.array([[0, 0, 0], [0, 0, 0], [3, 0, 0]])
    points = np.concatenate([square, pair, line, [[7, 7, 7]], [[np.nan] * 3]])
    pose = np.repeat([0, 1, 2, 3, 3], [4, 2, 3, 1, 1])
    found = position_repeatability(points, pose, 5)
    assert_allclose(found[:3], [2.0, 3.0, 4.0 / 3.0 + 3.0 / np.sqrt(3.0)], **EXACT)
    assert np.isnan(found[3:]).all()  # one visit that was measured, and none


def test_repeatability_of_known_scatter():
    # l is sigma times a chi variable of three degrees of freedom, about the barycentre of n
    n, sigma, rng = 4000, 2e-5, np.random.default_rng(1)
    found = position_repeatability(sigma * rng.normal(size=(n, 3)), np.zeros(n, dtype=int), 1)[0]
    mean, sd = chi.mean(3), chi.std(3)
    kurtosis = 3.0 + float(chi.stats(3, moments="k"))
    error = sigma * (sd / np.sqrt(n) + 3.0 * sd * np.sqrt((kurtosis - 1.0) / (4.0 * n)))
    assert found == pytest.approx(sigma * (mean + 3.0 * sd), abs=4.0 * error)


def test_direction_variation_by_hand():
    points = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [2, 3, 0], [1, 1, 2.0], [50, 0, 0]])
    way = np.array([4, 4, 7, 7, 9, -1])  # barycentres (1,0,0), (1,3,0), (1,1,2); one unknown
    pose = np.zeros(6, dtype=int)
    assert_allclose(multidirectional_variation(points, pose, way, 2), [3.0, np.nan])
    assert np.isnan(multidirectional_variation(points, pose, np.full(6, -1), 1)).all()


def test_rigid_fit_is_that_of_scipy(rng):
    points = rng.normal(size=(40, 3, 3))
    points[7, 1] = np.nan
    found = fit_rotations(TRIANGLE, points)
    assert np.isnan(found[7]).all()
    own = TRIANGLE - TRIANGLE.mean(axis=0)
    for j in np.delete(np.arange(40), 7):
        other, _ = Rotation.align_vectors(points[j] - points[j].mean(axis=0), own)
        assert_allclose(found[j], other.as_matrix(), rtol=0, atol=1e-10)


@pytest.mark.parametrize("flat", [TRIANGLE[:2], np.outer([0.0, 1.0, 2.0], [1.0, 2.0, 0.5])])
def test_two_targets_or_a_line_show_no_orientation(flat, rng):
    assert np.isnan(fit_rotations(flat, rng.normal(size=(5, len(flat), 3)))).all()


@settings(deadline=None, max_examples=60)
@given(
    st.integers(0, 2**32 - 1),
    st.one_of(st.floats(0.0, np.pi), st.floats(0.0, 1e-6), st.floats(np.pi - 1e-6, np.pi)),
)
def test_orientation_error_is_the_angle_of_the_turn(seed, angle):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    one = Rotation.random(rng=rng)
    other = one * Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    found = orientation_error(one.as_matrix(), other.as_matrix())
    assert_allclose(found, angle, rtol=0, atol=1e-14)
    assert_allclose(found, (one.inv() * other).magnitude(), rtol=0, atol=1e-14)


def test_euler_angles_are_those_of_scipy(rng):
    turn = Rotation.random(200, rng=rng)
    assert_allclose(euler_angles(turn.as_matrix()), turn.as_euler("xyz"), rtol=0, atol=1e-10)


def test_euler_deviation_takes_the_short_way():
    one, other = (
        Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        for angles in ([170, 5, -179], [-170, 2, 178])
    )
    assert_allclose(euler_deviation(one, other), np.radians([-20, 3, 3]), **EXACT)


def test_mean_turn_is_that_of_scipy(rng):
    turn = Rotation.from_rotvec(0.1 * rng.normal(size=(30, 3))) * Rotation.random(rng=rng)
    found = mean_rotations(turn.as_matrix(), np.zeros(30, dtype=int), 2)
    assert_allclose(found[0], turn.mean().as_matrix(), rtol=0, atol=1e-12)
    assert np.isnan(found[1]).all()


def test_distance_errors_pair_by_pair(rng):
    real, told = rng.normal(size=(2, 6, 3))
    every = [
        np.linalg.norm(real[i] - real[j]) - np.linalg.norm(told[i] - told[j])
        for i in range(6)
        for j in range(i + 1, 6)
    ]
    assert_allclose(distance_accuracy(real, told), every, **EXACT)


def test_repeated_distances_by_hand():
    # P at 0 thrice, Q at 1, 2, 3 along x (a fourth P has no partner): D = 1 2 3, D_c = 1.5
    x = np.array([0.0, 1.0, 0.0, 2.0, 0.0, 3.0, 0.4, 9.0])
    pose = np.array(["P", "Q", "P", "Q", "P", "Q", "P", "once"])
    attained = np.column_stack([x, 0 * x, 0 * x])
    commanded = np.column_stack([np.where(pose == "Q", 1.5, 0.0), 0 * x, 0 * x])
    accuracy, scatter = distance_accuracy_and_repeatability(attained, commanded, pose)
    assert_allclose(accuracy, [0.5], **EXACT)
    assert_allclose(scatter, [3.0], **EXACT)  # S of 1, 2, 3 is 1


# ---- motions that are known ----------------------------------------------------------------------


def test_an_arm_that_does_as_told_has_no_error(cell):
    found = of(cell, seen_at(cell, level_poses(cell.robot, 20)))
    values = found.parts["train"].values["after"]
    for part in (values.position, values.targets, values.angle, values.euler, values.pairs):
        assert np.abs(part).max() < 1e-13
    assert list(found.parts) == ["train"]


def test_a_shift_and_a_turn_are_found_back(cell):
    """AP is the shift in base axes; AO' and, for a turn about z, AO_c are the turn; AD is 0."""
    data = seen_at(cell, level_poses(cell.robot, 20))
    shift, angle = np.array([3e-4, -1e-4, 2e-4]), 2e-3
    y = turned(cell, data.y, shift, np.array([0.0, 0.0, angle]))
    values = of(cell, data.with_y(y)).parts["train"].values["after"]
    assert_allclose(values.position, np.tile(shift, (20, 1)), **EXACT)
    assert_allclose(values.angle, angle, **EXACT)
    assert_allclose(values.euler, np.tile([0.0, 0.0, angle], (20, 1)), **EXACT)
    assert np.abs(values.pairs).max() < 1e-12
    assert np.abs(values.moves).max() < 1e-12
    arm = TRIANGLE - TRIANGLE.mean(axis=0)  # each target moves with the turn as well
    flange = cell.robot.pose(data.q)[:, :3, :3]
    spin = Rotation.from_rotvec([0, 0, angle]).as_matrix() - np.eye(3)
    moved = shift + np.einsum("ab,mbc,kc->mka", spin, flange, arm)
    assert_allclose(values.targets, moved, **EXACT)


@pytest.mark.parametrize("seed", range(3))
def test_values_do_not_depend_on_where_the_instrument_stands(cell, noisy, seed):
    rng = np.random.default_rng(seed)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.uniform(-5, 5, 3)
    there = noisy.data.with_y(noisy.data.y @ motion[:3, :3].T + motion[:3, 3])
    moved = replace(noisy.cell, base=motion @ noisy.cell.base)
    one = of(noisy.cell, noisy.data).parts["train"].values["after"]
    other = of(moved, there).parts["train"].values["after"]
    assert np.abs(one.position).max() > 1e-5
    for name in ("position", "targets", "euler", "angle", "pairs", "moves"):
        assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=1e-11, err_msg=name)


def test_a_tcp_anywhere_on_the_flange(cell):
    """A body that moved rigidly: its points have the errors that the motion gives them."""
    data = seen_at(cell, level_poses(cell.robot, 10))
    y = turned(cell, data.y, np.array([1e-4, 0, 0]), np.array([1e-3, -2e-3, 5e-4]))
    data = data.with_y(y)
    at_target = of(cell, data, tcp="smr2")
    at_point = of(cell, data, tcp=TRIANGLE[1])
    same = [one.parts["train"].values["after"] for one in (at_target, at_point)]
    assert_allclose(same[0].position, same[1].position, **EXACT)
    assert_allclose(same[0].position, same[0].targets[:, 1], **EXACT)
    far = of(cell, data, tcp=[0.0, 0.0, 0.5]).parts["train"].values["after"]
    spot = np.array([0.0, 0.0, 0.5]) - TRIANGLE.mean(axis=0)
    flange = cell.robot.pose(data.q)[:, :3, :3]
    spin = Rotation.from_rotvec([1e-3, -2e-3, 5e-4]).as_matrix() - np.eye(3)
    assert_allclose(far.position, [1e-4, 0, 0] + flange @ spot @ spin.T, **EXACT)


def test_near_gimbal_lock_a_and_c_are_left_out(cell):
    """AO_b and AO' stay: a turn of 1 mrad is 1 mrad everywhere, while a and c run away."""
    q = random_joint_values_above_floor(cell.robot, 3000, np.random.default_rng(8))
    level = np.cos(euler_angles(cell.robot.pose(q)[:, :3, :3])[:, 1])
    q = np.concatenate([q[level < 0.08][:6], q[level > 0.5][:6]])
    data = seen_at(cell, q)
    data = data.with_y(turned(cell, data.y, np.zeros(3), np.array([1e-3, 0.0, 0.0])))
    found = of(cell, data)
    part = found.parts["train"]
    values = part.values["after"]
    assert part.locked == 6
    assert_allclose(values.angle, 1e-3, **EXACT)
    assert np.isfinite(values.euler[:, 1]).all()
    assert np.isnan(values.euler[:, ::2]).sum() == 12
    both = fit_rotations(TRIANGLE, (data.y - cell.base[:3, 3]) @ cell.base[:3, :3])
    there = cell.robot.pose(q)[:, :3, :3]
    assert np.abs(euler_deviation(both, there)[:6, ::2]).max() > 5e-3  # what was left out
    assert "6 poses" in part.reasons["AO_a, AO_c"]
    assert "gimbal lock" in found.summary()


# ---- poses that were visited again ---------------------------------------------------------------


def revisited(cell: mc.Cell, visits: int, sigma: float, poses: int = 4) -> Measurements:
    """Poses in cycles; every coordinate of every target is off by sigma."""
    q = np.tile(level_poses(cell.robot, poses), (visits, 1))
    labels = np.tile([f"P{i + 1}" for i in range(poses)], visits)
    data = seen_at(cell, q, pose=labels, order=np.arange(len(q)))
    rng = np.random.default_rng(4)
    return data.with_y(data.y + sigma * rng.normal(size=data.y.shape))


def test_simulated_revisits_have_the_repeatability_they_were_given(cell):
    n, sigma = 400, 30e-6
    found = of(cell, revisited(cell, n, sigma)).parts["train"].scatter
    assert_array_equal(found.stops, 4 * [n])
    mean, sd = chi.mean(3), chi.std(3)
    kurtosis = 3.0 + float(chi.stats(3, moments="k"))
    share = sd / np.sqrt(n) + 3.0 * sd * np.sqrt((kurtosis - 1.0) / (4.0 * n))
    for size, rp in ((sigma / np.sqrt(3.0), found.all_ways), (sigma, found.targets.T)):
        assert np.abs(rp - size * (mean + 3.0 * sd)).max() < 4.0 * size * share
    # D between two centroids: sigma sqrt(2/3); RD = 3 S_D, whose sd is 3 S / sqrt(2 n)
    size = 3.0 * sigma * np.sqrt(2.0 / 3.0)
    assert len(found.distance) == 6
    assert np.abs(found.distance - size).max() < 4.0 * size / np.sqrt(2.0 * n)
    # small turns of the triangle: (sum over targets of hat(s)'hat(s))^-1 sigma^2
    arm = TRIANGLE - TRIANGLE.mean(axis=0)
    inertia = (arm**2).sum() * np.eye(3) - arm.T @ arm
    rms = sigma * np.sqrt(np.trace(np.linalg.inv(inertia)))
    assert np.all(found.angle > rms)
    assert np.all(found.angle < 4.5 * rms)  # mean + 3 S of a length of that RMS
    flange = cell.robot.pose(level_poses(cell.robot, 4))[:, :3, :3]
    spread = flange @ np.linalg.inv(inertia) @ np.swapaxes(flange, 1, 2)
    c = euler_angles(flange)[:, 2]
    # db = (-sin c, cos c, 0) . w for a small turn w in base axes
    along = np.stack([-np.sin(c), np.cos(c), 0 * c], axis=1)
    size_b = 3.0 * sigma * np.sqrt(np.einsum("ma,mab,mb->m", along, spread, along))
    assert np.abs(found.euler[:, 1] / size_b - 1.0).max() < 4.0 / np.sqrt(2.0 * n)


def test_the_barycentre_gains_with_the_visits(cell):
    few, many = (
        of(cell, revisited(cell, n, 1e-4, poses=40)).parts["train"].values["after"].position
        for n in (1, 25)
    )
    sizes = [np.sqrt(np.mean(part**2)) for part in (few, many)]
    assert sizes[0] / sizes[1] == pytest.approx(5.0, rel=4.0 * np.sqrt(2.0 / (2.0 * 120.0)))


def test_play_shows_between_ways_and_not_within_one(cell):
    """Two ways of approach, 0.2 mm apart: vAP tells it, and RP one way is that of the noise."""
    rng, n = np.random.default_rng(5), 40
    q = np.tile(level_poses(cell.robot, 2), (n, 1))
    way = np.repeat([-1.0, 1.0], n)
    ways = {f"approach{j + 1}": way for j in range(6)}
    labels = np.tile(["P1", "P2"], n)
    data = seen_at(cell, q, pose=labels, **ways)
    aside = cell.base[:3, :3] @ [2e-4, 0.0, 0.0]
    noise = 5e-6 * rng.normal(size=(2 * n, 1, 3))
    data = data.with_y(data.y + noise + np.where(way[:, None, None] > 0, aside, 0.0))
    s = of(cell, data).parts["train"].scatter
    assert_array_equal(s.ways, [2, 2])
    assert_allclose(s.variation, 2e-4, rtol=0, atol=4 * 5e-6 * np.sqrt(2.0 / 20) * 2)
    assert s.one_way.max() < 3e-5
    assert s.all_ways.min() > 9e-5


def test_what_was_not_moved_is_one_stop(cell):
    """The same pose measured twice without a move tells nothing of repeatability."""
    q = level_poses(cell.robot, 3)[[0, 0, 0, 1, 2, 0]]
    data = seen_at(cell, q)
    data = data.with_y(data.y + np.arange(6)[:, None, None] * 1e-5)
    told = add_history_columns(data.in_visit_order())
    stops = build_stops(told, {"after": data.y}, np.zeros(6, dtype=bool))
    assert_array_equal(stops.pose, ["line 1", "line 4", "line 5", "line 1"])
    assert_allclose(stops.attained[0], data.y[:3].mean(axis=0), **EXACT)
    found = of(cell, data)
    assert_array_equal(found.parts["train"].scatter.stops, [2, 1, 1])
    assert any("2 rows repeat the joints of the row before" in n for n in found.notices)
    told = replace(data, columns={"pose": np.array(["home"] * 3 + ["a", "b", "home"])})
    again = of(cell, told).parts["train"]
    assert_array_equal(again.names, ["home", "a", "b"])
    assert_array_equal(again.scatter.stops, [4, 1, 1])


def test_one_reflector_at_one_nest_after_the_other(cell):
    """Three rounds through the poses with another nest each: AP and AO, but no repeatability."""
    q = np.tile(level_poses(cell.robot, 8), (3, 1))
    data = seen_at(cell, q)
    y = turned(cell, data.y, np.array([0, 1e-4, 0]), np.array([1e-3, 0, 0]))
    nest = np.repeat([0, 1, 2], 8)
    y[nest[:, None] != np.arange(3)] = np.nan
    found = of(cell, data.with_y(y))
    values, scatter = found.parts["train"].values["after"], found.parts["train"].scatter
    assert_allclose(values.position, np.tile([0, 1e-4, 0], (8, 1)), **EXACT)
    assert_allclose(values.angle, 1e-3, **EXACT)
    assert np.isnan(scatter.all_ways).all()
    assert_array_equal(scatter.stops, 0)
    assert found.conditions[-1][2].startswith("3 visits")


def test_pairs_keep_to_their_part(cell):
    data = seen_at(cell, level_poses(cell.robot, 9))
    held = np.array([0, 0, 1, 1, 0, 1, 0, 0, 1], dtype=bool)
    parts = compute_iso9283({"after": cell}, data, held).parts
    assert len(parts["holdout"].values["after"].pairs) == 6
    assert len(parts["train"].values["after"].pairs) == 10
    assert len(parts["holdout"].values["after"].moves) == 1  # rows 3 and 4
    assert len(parts["train"].values["after"].moves) == 2


# ---- the result ----------------------------------------------------------------------------------


def test_two_targets_say_why_there_is_no_orientation(cell, noisy):
    found = of(noisy.cell, noisy.data.keep(np.array([True, False, True])))
    assert "needs three reflectors" in found.summary()
    content = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    part = content["parts"]["train"]
    assert "three reflectors" in part["not_available"]["AO"]
    assert part["cells"]["after"]["AO_angle_mrad"] == {
        "count": 0,
        "mean": None,
        "rms": None,
        "max": None,
    }
    assert part["cells"]["after"]["AP_mm"]["count"] == 60


def test_json_holds_what_the_tables_say(cell):
    found = of(cell, revisited(cell, 5, 1e-4))
    content = json.loads(json.dumps(found.to_dict(), allow_nan=False))["parts"]["train"]
    text = found.summary(200)
    for number in (
        content["cells"]["after"]["AP_mm"]["mean"],
        content["cells"]["after"]["AO_angle_mrad"]["max"],
        content["cells"]["after"]["AD_mm"]["all"]["rms"],
        content["repeat"]["RD_mm"]["max"],
        content["poses"][2]["RP_all_mm"],
    ):
        assert f"{number:.4f}" in text
    assert [pose["pose"] for pose in content["poses"]] == ["P1", "P2", "P3", "P4"]
    assert f"{STANDARD_CYCLE_COUNT} or more at 0 of 4 poses" in text
    rows = found.pose_table().rows
    assert [row[0] for row in rows] == ["P1", "P2", "P3", "P4"]


def test_conditions_say_what_the_data_tell(cell):
    q = level_poses(cell.robot, 4)
    columns = {
        "temperature": np.array([20.5, 22.0, np.nan, 21.0]),
        "payload": np.full(4, 5.0),
        "u95": np.full(4, 2e-5),
    }
    told = {c: t for c, _, t in of(cell, seen_at(cell, q, **columns)).conditions}
    assert told["6.3"] == "temperature 20.5 to 22 C"
    assert told["6.6"] == "payload 5 kg"
    assert told["6.5"] == "u95 0.02 mm"
    assert told["6.7"] == "not given"


@pytest.mark.parametrize(
    ("tcp", "words"), [("smr9", "smr1, smr2, smr3"), ([1.0, 2.0], "three numbers")]
)
def test_a_tcp_that_is_none_is_refused(cell, tcp, words):
    with pytest.raises(OptionError, match=words):
        of(cell, seen_at(cell, level_poses(cell.robot, 4)), tcp=tcp)


def test_wrong_targets_and_joints_are_refused(cell):
    data = seen_at(cell, level_poses(cell.robot, 4))
    with pytest.raises(DataError, match="target smr7"):
        of(cell, replace(data, target_names=("smr1", "smr2", "smr7")))
    with pytest.raises(DataError, match="5 joint columns"):
        of(cell, replace(data, q=data.q[:, :5], sliding=data.sliding[:5]))
    with pytest.raises(DataError, match="three of them"):
        of(cell, data.only(0), tcp=[0.0, 0.0, 0.1])


def test_many_poses_form_pairs_of_some(cell, monkeypatch):
    monkeypatch.setattr("minimax_cal.validation.iso9283.visits.MAX_PAIRED_POSES", 10)
    monkeypatch.setattr("minimax_cal.validation.iso9283.result.MAX_PAIRED_POSES", 10)
    found = of(cell, seen_at(cell, level_poses(cell.robot, 30)))
    assert len(found.parts["train"].values["after"].pairs) == 45
    assert any("pairs of 10 of 30" in notice for notice in found.notices)


def test_one_label_at_two_poses_is_no_repeatability(cell):
    data = seen_at(cell, level_poses(cell.robot, 6), pose=np.repeat(["a", "b", "c"], 2))
    with pytest.raises(DataError, match="pose 'a' is also that of line 1"):
        of(cell, data)
