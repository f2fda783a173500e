"""Rows as poses, parts and regions; the order of visits, and a file that tells none."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy
from conftest import run, shared
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.measuring import visit_history
from minimax_cal.measuring.faults import find_data_faults
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.measuring.pose_groups import (
    MAX_REPEAT_DISTANCE,
    add_group_column,
    cluster_poses,
    describe_mislabelled_pose,
    deviations_from_group_means,
    group_agreeing_visits,
    group_for_holdout,
    group_repeated_poses,
    k_means_labels,
    list_holdout_regions,
    number_groups_by_joints,
    split_train_and_holdout,
)
from minimax_cal.measuring.visit_history import (
    add_history_columns,
    has_visit_order,
    joint_moves,
    list_backward_time_notices,
)
from minimax_cal.modelling.simulate import Truth, simulate


def made(q: Array, **columns: Array) -> Measurements:
    return mc.measurements(q, np.random.default_rng(0).normal(size=(len(q), 3)), **columns)


def spread(rng: np.random.Generator, places: int, each: int, size: float) -> Array:
    centre = rng.uniform(-2.0, 2.0, (places, 6))
    return np.repeat(centre, each, axis=0) + size * rng.normal(size=(places * each, 6))


@pytest.mark.parametrize("m", [7, 40, 400])
def test_regions_are_those_of_scipy(m, rng):
    q = rng.normal(size=(m, 6))
    found = scipy.cluster.vq.kmeans2(q, 5, minit="++", seed=np.random.default_rng(0))[1]
    assert_array_equal(k_means_labels(q, 5, np.random.default_rng(0)), found)


def test_groups_are_asked_again_where_labels_differ(rng):
    """Poses whose joints are the same array, with labels and without."""
    q = rng.uniform(-2.0, 2.0, (20, 6))
    plain = made(q)
    named = replace(plain, columns={"pose": np.repeat([f"p{i}" for i in range(10)], 2)})
    assert [len(np.unique(group_repeated_poses(data))) for data in (plain, named, plain)] == [
        20,
        10,
        20,
    ]


def test_visits_that_differ_by_less_than_the_arm_repeats_are_one_pose(rng):
    q = rng.uniform(-2.0, 2.0, (60, 6))
    twice = np.concatenate([q, q[:40] + 0.2 * MAX_REPEAT_DISTANCE * rng.uniform(-1, 1, (40, 6))])
    group = group_repeated_poses(made(twice))
    assert len(np.unique(group)) == 60
    assert_array_equal(group[:40], group[60:])
    train, held, _ = split_train_and_holdout(made(twice), 0.3, 0)
    nearest = np.abs(train.q[:, None] - held.q[None]).max(axis=2).min()
    assert nearest > 2.0 * MAX_REPEAT_DISTANCE


def test_a_slow_path_is_not_one_pose():
    path = np.outer(np.arange(200) * 0.5 * MAX_REPEAT_DISTANCE, np.eye(6)[0])
    group = group_repeated_poses(made(path))
    assert len(np.unique(group)) > 30
    for number in np.unique(group):
        assert np.ptp(path[group == number], axis=0).max() <= 2.0 * MAX_REPEAT_DISTANCE


def test_groups_do_not_depend_on_the_order_of_rows(rng):
    q = spread(rng, 20, 3, 1e-5)
    shuffled = rng.permutation(60)
    held = [split_train_and_holdout(made(one), 0.3, 4)[1].q for one in (q, q[shuffled])]
    assert {tuple(row) for row in held[0]} == {tuple(row) for row in held[1]}


def test_clusters_are_found_and_held_out_whole(rng):
    data = made(spread(rng, 16, 5, 0.01))
    assert_array_equal(np.ptp(cluster_poses(data).reshape(16, 5), axis=1), 0)
    assert len(np.unique(cluster_poses(data))) == 16
    _, held, notices = split_train_and_holdout(data, 0.2, 0)
    assert held.poses == 15
    assert "80 poses stand in 16 groups" in notices[0]
    assert len(np.unique(add_group_column(data).columns["group"])) == 16


@pytest.mark.parametrize("poses", [12, 30, 100, 400])
def test_scattered_poses_stand_alone(poses, rng):
    for _ in range(5):
        data = made(rng.uniform(-2.0, 2.0, (poses, 6)))
        assert len(np.unique(cluster_poses(data))) == poses
        assert "group" not in add_group_column(data).columns


def test_columns_force_groups(rng):
    q = rng.uniform(-2.0, 2.0, (30, 6))
    label = np.repeat(list("abcdef"), 5)
    assert len(np.unique(group_for_holdout(made(q, group=label)))) == 6
    assert len(np.unique(group_for_holdout(made(q, session=label), "session"))) == 6
    assert len(np.unique(group_for_holdout(made(q), "region"))) == 5
    with pytest.raises(mc.OptionError, match="choose region"):
        group_for_holdout(made(q), "shift")
    train, held, _ = split_train_and_holdout(made(q, session=label), 0.34, 1, "session")
    assert not set(train.columns["session"]) & set(held.columns["session"])


def test_parts_keep_repeats_together(rng):
    q = rng.uniform(-2.0, 2.0, (50, 3))
    q = np.concatenate([q, q + 1e-5])
    found = list_holdout_regions(made(q, order=np.arange(100.0), session=np.repeat(["a", "b"], 50)))
    names = [part.name for part in found]
    for joint in (1, 2, 3):
        assert f"joint {joint} at its low end" in names
        assert f"joint {joint} at its high end" in names
    assert sum("region" in name for name in names) == 5
    for part in found:
        assert_array_equal(part.rows[:50], part.rows[50:])
        assert 3 <= part.rows.sum() <= 50
    low = next(part for part in found if part.name == "joint 2 at its low end").rows
    assert q[low, 1].max() < q[~low, 1].min() + 2e-5


def test_sessions_and_the_last_poses_are_parts(rng):
    q = rng.uniform(-2.0, 2.0, (60, 3))
    day = np.repeat(["mon", "tue", "wed"], 20)
    names = [
        part.name for part in list_holdout_regions(made(q, order=np.arange(60.0), session=day))
    ]
    assert {"session mon", "session tue", "session wed", "the last fifth"} <= set(names)
    assert not any("fifth" in part.name for part in list_holdout_regions(made(q)))
    assert [part.name[:11] for part in list_holdout_regions(made(q, session=day), "session")] == [
        "the session"
    ] * 3


@pytest.mark.parametrize(("places", "each", "groups"), [(8, 2, 8), (8, 5, 8), (7, 5, 35)])
def test_fewer_than_eight_clusters_are_regions(places, each, groups):
    data = made(spread(np.random.default_rng(4), places, each, 0.01))
    assert len(np.unique(cluster_poses(data))) == groups


def test_a_short_path_is_one_pose_and_a_longer_one_is_not():
    """All within two steps of each other, or not."""
    step = 0.8 * MAX_REPEAT_DISTANCE * np.eye(6)[0]
    counts = [
        len(np.unique(group_repeated_poses(made(np.outer(np.arange(n), step))))) for n in (2, 3, 5)
    ]
    assert counts[:2] == [1, 1]
    assert counts[2] > 1


def test_groups_are_numbered_by_their_joints():
    q = np.array([[0.3, 0.0], [-0.2, 1.0], [0.3, 0.0], [-0.2, -1.0]])
    assert_array_equal(group_repeated_poses(made(q)), [2, 1, 2, 0])
    told = made(q, pose=np.array(["a", "b", "c", "b"]))
    assert_array_equal(group_repeated_poses(told), [1, 0, 1, 0])
    assert_array_equal(
        group_for_holdout(made(q, shift=np.array(["x", "", "", "x"])), "shift"), [0, 1, 0, 0]
    )


@pytest.mark.parametrize("share", [-0.1, 1.0, 1.5])
def test_a_share_is_a_share(share, rng):
    with pytest.raises(mc.OptionError, match="is not a fraction"):
        split_train_and_holdout(made(rng.normal(size=(9, 6))), share, 0)


def test_a_column_splits_as_it_says(rng):
    q = rng.uniform(-2.0, 2.0, (6, 6))
    label = np.array(["train", "HOLDOUT", "train", "Train", "holdout", "train"])
    train, held, notices = split_train_and_holdout(made(q, split=label), 0.9, 0)
    assert_array_equal(held.q, q[[1, 4]])
    assert_array_equal(train.q, q[[0, 2, 3, 5]])
    assert notices == ("the split column decides what is held out",)
    label[3] = "trian"
    with pytest.raises(mc.DataError, match=r":4: column split: 'trian' is neither"):
        split_train_and_holdout(made(q, split=label), 0.2, 0)
    with pytest.raises(mc.DataError, match="leaves no row for training"):
        split_train_and_holdout(made(q, split=np.repeat("holdout", 6)), 0.2, 0)
    q[1] = q[0]
    label[3] = "train"
    assert "stand both in training" in split_train_and_holdout(made(q, split=label), 0.2, 0)[2][1]


def test_regions_are_named_by_where_they_stand():
    rng = np.random.default_rng(2)
    q = 1e-3 * rng.normal(size=(35, 3))
    q[:, 1] += np.repeat(np.radians([-80.0, -40.0, 0.0, 40.0, 80.0]), 7)
    data = made(q)
    turn = {f"region about joint 2 = {value} deg" for value in (-80, -40, 40, 80)}
    found = {part.name: part.rows for part in list_holdout_regions(data)}
    assert turn <= set(found)
    assert_array_equal(np.flatnonzero(found["region about joint 2 = 40 deg"]), np.arange(21, 28))
    slides = replace(data, sliding=np.array([False, True, False]))
    middle = np.median(q[21:28, 1])
    assert f"region about joint 2 = {1e3 * middle:.0f} mm" in {
        part.name for part in list_holdout_regions(slides)
    }


def test_parts_are_neither_few_poses_nor_most():
    q = np.linspace(-1.0, 1.0, 40)[:, None] * [1.0, 0.004, 0.0]  # joint 2 hardly moves
    q[:, 2] = np.random.default_rng(3).permutation(q[:, 0])
    named = {part.name: part.rows for part in list_holdout_regions(made(q, order=np.arange(40.0)))}
    assert_array_equal(np.flatnonzero(named["joint 1 at its low end"]), np.arange(10))
    assert_array_equal(np.flatnonzero(named["joint 1 at its high end"]), np.arange(30, 40))
    assert_array_equal(np.flatnonzero(named["the last fifth"]), np.arange(32, 40))
    assert not any("joint 2 at" in name for name in named)
    day = np.repeat(["few", "some", "most"], [2, 3, 35])
    names = [part.name for part in list_holdout_regions(made(q, session=day))]
    assert [name for name in names if "session" in name] == ["session some"]


def test_rows_of_a_group_column_are_told(rng):
    """Nine poses that stand in six groups are worth a notice, eight in six are not."""
    for poses, told in ((10, True), (9, False)):
        label = [str(min(i, 5)) for i in range(poses)]
        notices = split_train_and_holdout(
            made(rng.normal(size=(poses, 6)), group=np.array(label)), 0.3, 0
        )[2]
        assert bool(notices) == told


def test_groups_are_numbered_alike_in_any_order_of_the_rows(rng):
    q = rng.integers(0, 3, (40, 2)) * 0.5  # groups at the same joints, too
    group, order = rng.integers(0, 6, 40), rng.permutation(40)
    found = number_groups_by_joints(group[order], q[order])
    assert_array_equal(found, number_groups_by_joints(group, q)[order])


def test_one_label_at_two_poses_is_told(rng):
    q = np.repeat(rng.uniform(-2.0, 2.0, (4, 6)), 2, axis=0)
    q[1, 5] += 2.0 * np.pi + 1e-3  # the same pose, the wrist a turn on
    label = np.array(["a", "a", "b", "b", "", "", "d", "d"])
    assert describe_mislabelled_pose(made(q, pose=label)) == ""
    assert describe_mislabelled_pose(made(q)) == ""
    q[3, 1] += 0.5
    said = describe_mislabelled_pose(made(q, pose=label))
    assert ":4: pose 'b' is also that of line 3, where joint 2 differs by 0.5 rad" in said


def test_visits_are_of_one_load(rng):
    q = np.repeat(rng.uniform(-2.0, 2.0, (4, 6)), 3, axis=0)
    load = np.tile([0.0, np.nan, 5.0], 4)
    assert_array_equal(group_agreeing_visits(made(q)), group_repeated_poses(made(q)))
    group = group_agreeing_visits(made(q, payload=load))
    assert len(np.unique(group)) == 8
    assert_array_equal(group[0::3], group[1::3])
    assert not np.isin(group[2::3], group[0::3]).any()


def test_scatter_counts_what_was_measured():
    values = np.array([[1.0, np.nan], [3.0, 5.0], [10.0, 7.0], [np.nan, 8.0]])
    off, free = deviations_from_group_means(values, np.array([0, 0, 1, 1]))
    assert_allclose(off, [[-1.0, 0.0], [1.0, 0.0], [0.0, -0.5], [0.0, 0.5]])
    assert_allclose(free, [[0.5, 0.0], [0.5, 0.0], [0.0, 0.5], [0.0, 0.5]])


# ---- history -------------------------------------------------------------------------------------


def walk(q: list[float], **columns: object) -> Measurements:
    """One joint visiting q, one target that follows it."""
    joint = np.array(q, dtype=float)[:, None]
    y = np.stack([np.cos(joint[:, 0]), np.sin(joint[:, 0]), np.arange(len(q))], axis=1)
    return measurements(joint, y, **{name: np.asarray(v) for name, v in columns.items()})


def test_a_joint_that_stands_still_keeps_its_approach():
    columns = add_history_columns(
        walk([0.0, 1.0, 1.0, 1.0 + 5e-8, 0.5, 0.5]).in_visit_order()
    ).columns
    assert_array_equal(columns["approach1"], [0, 1, 1, 1, -1, -1])
    assert_allclose(columns["move1"], [0, 1, 0, 5e-8, -0.5, 0], atol=1e-15)
    assert_array_equal(columns["followed"], [0, 1, 1, 1, 1, 1])
    assert_allclose(columns["clock"], np.linspace(0, 1, 6))


def test_moves_follow_the_visit_order_not_the_rows(rng):
    q = rng.normal(size=20)
    shuffled = rng.permutation(20)
    straight = add_history_columns(walk(list(q), order=np.arange(20.0))).columns
    mixed = add_history_columns(walk(list(q[shuffled]), order=np.arange(20.0)[shuffled])).columns
    for name in ("approach1", "move1", "followed", "clock"):
        assert_array_equal(mixed[name], straight[name][shuffled])


SIXTH, THIRD = 1.0 / 6.0, 1.0 / 3.0
WALKS: dict[str, tuple[list[float], dict[str, Any], dict[str, list[float]]]] = {
    "a gap hides the pose before, and nothing carries over it": (
        [0, 1, 3, 3, 2], {"order": [0, 1, 4, 5, 6]},
        {"followed": [0, 1, 0, 1, 1], "approach1": [0, 1, 0, 0, -1], "move1": [0, 1, 0, 0, -1],
         "clock": [0, SIXTH, 4 * SIXTH, 5 * SIXTH, 1]}),
    "tens are no gaps": ([0, 1, 2], {"order": [10, 20, 30]}, {"followed": [0, 1, 1]}),
    "a pose squeezed in": (
        [0, 2, 1, 5], {"order": [1, 2, 1.5, 4]},
        {"followed": [0, 1, 1, 0], "move1": [0, 1, 1, 0]}),
    "a session breaks the chain and may count anew": (
        [0, 1, 5, 4], {"order": [0, 1, 0, 1], "session": ["b", "b", "a", "a"]},
        {"visit": [0, 1, 2, 3], "followed": [0, 1, 0, 1], "approach1": [0, 1, 0, -1],
         "clock": [0, THIRD, 2 * THIRD, 1]}),
    "repeated numbers side by side are sorted stably": (
        [0, 1, 3, 2], {"order": [0, 1, 1, 2]},
        {"followed": [0, 1, 1, 1], "move1": [0, 1, 2, -1]}),
    "numbers that begin again without a session say nothing of the pose before": (
        [0, 1, 2, 7, 8, 9], {"order": [0, 1, 2, 0, 1, 2]},
        {"followed": [0] * 6, "approach1": [0] * 6}),
    "rows without a number come last and follow nothing": (
        [0, 9, 1], {"order": [0, np.nan, 1]}, {"visit": [0, 2, 1], "followed": [0, 0, 1]}),
    "time sets the clock": ([0, 1, 2], {"time": [100, np.nan, 500]}, {"clock": [0, 0.5, 1]}),
    "one row": ([1], {"order": [5]}, {"clock": [0], "followed": [0]}),
}  # fmt: skip


@pytest.mark.parametrize(("q", "told", "expected"), WALKS.values(), ids=WALKS)
def test_what_an_order_tells(q, told, expected):
    data = walk(q, **told)
    columns = {
        **add_history_columns(data).columns,
        "visit": visit_history.rows_in_visit_order(data),
    }
    for name, values in expected.items():
        assert_allclose(columns[name], values, rtol=0, atol=1e-15)


def test_columns_of_the_file_are_kept():
    data = walk([0.0, 1.0, 2.0], approach1=[-1.0, -1.0, -1.0]).in_visit_order()
    columns = add_history_columns(data).columns
    assert_array_equal(columns["approach1"], [-1, -1, -1])
    assert_array_equal(columns["move1"], [0, 1, 1])
    part = add_history_columns(data).take(np.array([0, 2]))  # a split does not change the moves
    assert_array_equal(add_history_columns(part).columns["move1"], [0, 1])
    assert_array_equal(joint_moves(part), [[0], [1]])


def test_irb120_keeps_the_moves_whose_start_is_in_the_file():
    data = mc.read_measurements(shared("irb120")[1])
    columns = add_history_columns(data).columns
    linked = columns["followed"] > 0
    number = data.columns["order"]
    assert_array_equal(linked[1:], np.diff(number) == 1)
    assert linked.mean() > 0.6
    rows = np.flatnonzero(linked)
    assert_allclose(columns["move3"][rows], data.q[rows, 2] - data.q[rows - 1, 2], atol=0)
    assert np.all(np.abs(columns["approach3"][rows]) == 1)
    assert not columns["approach3"][~linked].any()


def test_a_clock_against_the_order_is_told():
    order, time = np.arange(4.0), np.array([0.0, 2.0, 1.0, np.nan])
    q = [0.0, 1.0, 2.0, 3.0]
    (said,) = list_backward_time_notices(walk(q, order=order, time=time))
    assert ":3: column time_s runs backwards against the column order, 1 times" in said
    assert list_backward_time_notices(walk(q, order=order[::-1], time=-order)) == []
    days = np.array(["a", "a", "b", "b"])
    assert (
        list_backward_time_notices(walk(q, time=np.array([5.0, 6.0, 1.0, 2.0]), session=days)) == []
    )
    assert list_backward_time_notices(walk(q, order=order)) == []


# ---- order untold --------------------------------------------------------------------------------


OF_ORDER = ("frame_drift", "thermal_growth", "backlash", "settling", "target_shift")


@pytest.fixture(scope="module")
def shifted() -> mc.Measurements:
    """A nest that moves half-way."""
    made = simulate(mc.load_robot("irb2600"), 80, 3, seed=4, truth=Truth(compliance=0.0))
    spots = made.cell.target_positions + np.array([[0.0] * 3, [1e-3, 5e-4, 0.0], [0.0] * 3])
    moved = replace(made.cell, target_positions=spots)
    step = (moved.predict(made.data.q) - made.cell.predict(made.data.q)) * (
        np.arange(80) >= 40
    ).reshape(-1, 1, 1)
    return made.data.with_y(made.data.y + step)


def untold(data: mc.Measurements) -> mc.Measurements:
    return replace(data, columns={k: v for k, v in data.columns.items() if k != "order"})


def needs(data: mc.Measurements) -> dict[str, str]:
    """What each effect lacks, where it cannot be tested."""
    from minimax_cal.modelling.effects.table import EFFECTS

    cell = mc.calibrate("irb2600", data, "sum", holdout=0.0).cell
    scene = cell.pose_arm(add_history_columns(data))
    return {name: effect.needs(scene) for name, effect in EFFECTS.items()}


def test_nothing_of_the_order_is_made_up(shifted):
    data = untold(shifted)
    assert has_visit_order(shifted)
    assert not has_visit_order(data)
    told = add_history_columns(data).columns
    assert not any(np.any(column) for column in told.values())
    assert not has_visit_order(data.take(np.arange(40)))
    assert add_history_columns(data.in_visit_order()).columns["clock"][-1] == 1.0


def test_what_needs_an_order_is_not_testable(shifted):
    lacking, known = needs(untold(shifted)), needs(shifted)
    for name in OF_ORDER:
        assert "the file tells no order" in lacking[name]
        assert not known[name]
    assert not lacking["joint_compliance"]
    warm = np.linspace(20.0, 25.0, 80)
    measured = replace(untold(shifted), columns={"temperature": warm})
    assert not needs(measured)["thermal_growth"]  # a thermometer needs no order


def test_faults_of_the_session_need_an_order(shifted):
    def found(data: mc.Measurements) -> list[str]:
        return [fault.effect for fault in find_data_faults(add_history_columns(data))]

    assert "target_shift" in found(shifted)
    assert "target_shift" not in found(untold(shifted))


def test_rows_may_be_said_to_be_the_order(shifted, tmp_path, capsys):
    mc.write_measurements(tmp_path / "poses.csv", untold(shifted))
    command = ("effects", "irb2600", tmp_path / "poses.csv", "--json")
    places: list[Array | str] = []
    for more in ((), ("--rows-in-visit-order",)):
        assert run(*command, *more) == 0
        places.append(capsys.readouterr().out)
    assert "the file tells no order" in places[0]
    assert "the file tells no order" not in places[1]
    same = mc.read_measurements(tmp_path / "poses.csv").in_visit_order()
    assert needs(same)["frame_drift"] == ""
