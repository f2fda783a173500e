"""How far each joint went, and from where on that says nothing of poses outside."""

from dataclasses import replace

import numpy as np
import pytest

import minimax_cal as mc
from minimax_cal.fitting.spans import inner_size, least_span, narrow, outside, spans_of
from minimax_cal.measuring.measurements import Measurements, measurements


def data_of(q: np.ndarray) -> Measurements:
    return measurements(q, np.arange(3.0 * len(q)).reshape(-1, 1, 3) / 1e3)


@pytest.fixture
def free(robot: mc.Robot) -> mc.Robot:
    """Without limits."""
    return replace(robot, lower=np.full(6, -np.inf), upper=np.full(6, np.inf))


@pytest.mark.parametrize(("size", "count"), [(9.0, 6), (11.0, 0), (0.0, 6)])
def test_a_joint_that_spans_less_than_ten_degrees_is_narrow(free, size, count):
    q = np.radians(size) * np.linspace(0.0, 1.0, 400)[:, None] + np.zeros(6)
    assert len(narrow(spans_of(free, data_of(q)))) == count


def test_a_slide_needs_twenty_millimetres(free):
    slides = replace(free, prismatic=np.arange(6) == 0)
    q = np.linspace(0.0, 1.0, 400)[:, None] * [0.019, 1.0, 1.0, 1.0, 1.0, 1.0]
    (few,) = narrow(spans_of(slides, data_of(q)))
    assert (few.joint, few.unit, few.least) == ("J1", "mm", 20.0)
    assert few.high == pytest.approx(19.0)
    assert not narrow(spans_of(slides, data_of(1.2 * q)))


@pytest.mark.parametrize(
    ("size", "least"),
    [
        (np.inf, 10.0),
        (180.0, 10.0),
        (360.0, 18.0),
        (12.0, 6.0),
    ],  # 5 %, or half of a short one
)
def test_the_range_of_a_joint_counts(free, size, least):
    half = np.full(6, np.radians(size) / 2.0)
    limited = replace(free, lower=-half, upper=half)
    assert np.degrees(least_span(limited, 0)) == pytest.approx(least)


def test_one_or_two_poses_elsewhere_make_no_span():
    assert inner_size(np.array([0.0, 0.0, 0.0, 0.0, 2.0, 3.0])) == 0.0
    assert inner_size(np.array([0.0, 0.0, 0.0, 3.0, 3.0, 3.0])) == 3.0
    assert inner_size(np.zeros(2)) == inner_size(np.zeros(0)) == 0.0


def test_poses_that_nothing_measured_do_not_count(free):
    q = np.zeros((40, 6))
    q[:20, 0] = np.linspace(0.0, 2.0, 20)
    whole = data_of(q)
    y = whole.y.copy()
    y[:20] = np.nan
    assert "J1" not in [span.joint for span in narrow(spans_of(free, whole))]
    assert "J1" in [span.joint for span in narrow(spans_of(free, whole.with_y(y)))]


def test_outside_is_where_a_narrow_joint_was_not(free, rng):
    q = rng.uniform(-1.0, 1.0, (50, 6))
    q[:, 2] = 0.3
    spans = spans_of(free, data_of(q))
    asked = np.array([q[0], q[0], q[0], q[0]])
    asked[1, 2], asked[2, 0], asked[3, 2] = 0.35, 3.0, 0.305  # 5 mrad are no move
    assert outside(spans, asked).tolist() == [False, True, False, False]
    assert not outside((), asked).any()
