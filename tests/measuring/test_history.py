import numpy as np
from conftest import shared
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from minimax_cal.measuring.history import moves, time_notices, visits, with_history
from minimax_cal.measuring.measurements import Measurements, measurements


def walk(q: list[float], **columns: object) -> Measurements:
    """One joint visiting q, one target that follows it."""
    joint = np.array(q, dtype=float)[:, None]
    y = np.stack([np.cos(joint[:, 0]), np.sin(joint[:, 0]), np.arange(len(q))], axis=1)
    return measurements(joint, y, **{name: np.asarray(v) for name, v in columns.items()})


def test_a_joint_that_stands_still_keeps_its_approach():
    columns = with_history(walk([0.0, 1.0, 1.0, 1.0 + 5e-8, 0.5, 0.5]).in_visit_order()).columns
    assert_array_equal(columns["approach1"], [0, 1, 1, 1, -1, -1])
    assert_allclose(columns["move1"], [0, 1, 0, 5e-8, -0.5, 0], atol=1e-15)
    assert_array_equal(columns["followed"], [0, 1, 1, 1, 1, 1])
    assert_allclose(columns["clock"], np.linspace(0, 1, 6))


def test_moves_follow_the_visit_order_not_the_rows(rng):
    q = rng.normal(size=20)
    shuffled = rng.permutation(20)
    straight = with_history(walk(list(q), order=np.arange(20.0))).columns
    mixed = with_history(walk(list(q[shuffled]), order=np.arange(20.0)[shuffled])).columns
    for name in ("approach1", "move1", "followed", "clock"):
        assert_array_equal(mixed[name], straight[name][shuffled])


def test_a_gap_hides_the_pose_before():
    columns = with_history(walk([0.0, 1.0, 3.0, 3.0, 2.0], order=[0, 1, 4, 5, 6])).columns
    assert_array_equal(columns["followed"], [0, 1, 0, 1, 1])
    assert_array_equal(columns["approach1"], [0, 1, 0, 0, -1])  # nothing carries over the gap
    assert_array_equal(columns["move1"], [0, 1, 0, 0, -1])
    assert_allclose(columns["clock"], np.array([0, 1, 4, 5, 6]) / 6)


def test_orders_that_count_in_tens_or_squeeze_a_pose_in_have_no_gaps():
    tens = with_history(walk([0.0, 1.0, 2.0], order=[10, 20, 30])).columns
    assert_array_equal(tens["followed"], [0, 1, 1])
    halves = with_history(walk([0.0, 2.0, 1.0, 5.0], order=[1, 2, 1.5, 4])).columns
    assert_array_equal(halves["followed"], [0, 1, 1, 0])
    assert_array_equal(halves["move1"], [0, 1, 1, 0])


def test_a_session_breaks_the_chain_and_may_count_anew():
    data = walk([0.0, 1.0, 5.0, 4.0], order=[0, 1, 0, 1], session=["b", "b", "a", "a"])
    columns = with_history(data).columns
    assert_array_equal(visits(data), [0, 1, 2, 3])
    assert_array_equal(columns["followed"], [0, 1, 0, 1])
    assert_array_equal(columns["approach1"], [0, 1, 0, -1])
    assert_allclose(columns["clock"], [0, 1 / 3, 2 / 3, 1])


def test_repeated_numbers_side_by_side_are_sorted_stably():
    columns = with_history(walk([0.0, 1.0, 3.0, 2.0], order=[0, 1, 1, 2])).columns
    assert_array_equal(columns["followed"], [0, 1, 1, 1])
    assert_array_equal(columns["move1"], [0, 1, 2, -1])


def test_numbers_that_begin_again_without_a_session_say_nothing_of_the_pose_before():
    data = walk([0.0, 1.0, 2.0, 7.0, 8.0, 9.0], order=[0, 1, 2, 0, 1, 2])
    columns = with_history(data).columns
    assert not columns["followed"].any()
    assert not columns["approach1"].any()


def test_rows_without_a_number_come_last_and_follow_nothing():
    data = walk([0.0, 9.0, 1.0], order=[0.0, np.nan, 1.0])
    columns = with_history(data).columns
    assert_array_equal(visits(data), [0, 2, 1])
    assert_array_equal(columns["followed"], [0, 0, 1])


def test_time_sets_the_clock():
    columns = with_history(walk([0.0, 1.0, 2.0], time=[100.0, np.nan, 500.0])).columns
    assert_allclose(columns["clock"], [0, 0.5, 1])


def test_columns_of_the_file_are_kept():
    data = walk([0.0, 1.0, 2.0], approach1=[-1.0, -1.0, -1.0]).in_visit_order()
    columns = with_history(data).columns
    assert_array_equal(columns["approach1"], [-1, -1, -1])
    assert_array_equal(columns["move1"], [0, 1, 1])
    part = with_history(data).take(np.array([0, 2]))  # a split does not change the moves
    assert_array_equal(with_history(part).columns["move1"], [0, 1])
    assert_array_equal(moves(part), [[0], [1]])


def test_one_row():
    columns = with_history(walk([1.0], order=[5])).columns
    assert_array_equal(columns["clock"], [0])
    assert_array_equal(columns["followed"], [0])


def test_irb120_keeps_the_moves_whose_start_is_in_the_file():
    data = mc.read_measurements(shared("irb120")[1])
    columns = with_history(data).columns
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
    (said,) = time_notices(walk(q, order=order, time=time))
    assert ":3: column time_s runs backwards against the column order, 1 times" in said
    assert time_notices(walk(q, order=order[::-1], time=-order)) == []
    days = np.array(["a", "a", "b", "b"])
    assert time_notices(walk(q, time=np.array([5.0, 6.0, 1.0, 2.0]), session=days)) == []
    assert time_notices(walk(q, order=order)) == []
