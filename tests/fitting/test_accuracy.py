"""RMS, mean, largest and sums of distances, by target and in all, against sums by hand."""

import math

import numpy as np
import pytest

from minimax_cal.fitting.accuracy import accuracy

# Two targets at three poses [m]; distances 5, 0, - and 1, 2, 2 mm.
ERROR = 1e-3 * np.array(
    [
        [[3.0, 0.0, 4.0], [0.0, 0.0, 0.0], [np.nan] * 3],
        [[0.0, 1.0, 0.0], [0.0, 0.0, -2.0], [2.0, 0.0, 0.0]],
    ]
)


def test_all_points_and_each_target():
    found = accuracy(ERROR)
    assert found.rms_mm == pytest.approx(math.sqrt(34.0 / 5.0), rel=1e-14)
    assert (found.max_mm, found.mean_mm) == pytest.approx((5.0, 2.0), rel=1e-14)
    assert (found.poses, found.counts, found.worst) == (3, (2, 3), (0, 0))
    assert found.sse_mm2 == pytest.approx((25.0, 9.0), rel=1e-14)
    assert found.by_target() == pytest.approx((math.sqrt(12.5), math.sqrt(3.0)), rel=1e-14)
    one, other, every = found.table("title", ("smr1", "smr2")).rows
    assert one[:3] == ("smr1", 2, pytest.approx(math.sqrt(12.5)))
    assert other[:3] == ("smr2", 3, pytest.approx(math.sqrt(3.0)))
    assert one[3:5] == pytest.approx((2.5, 5.0), rel=1e-14)
    assert other[3:5] == pytest.approx((5.0 / 3.0, 2.0), rel=1e-14)
    assert every == ("all", 5, found.rms_mm, found.mean_mm, found.max_mm, pytest.approx(34.0))


def test_no_point_is_no_number():
    found = accuracy(np.full((2, 0, 3), np.nan))
    assert (found.poses, found.counts, found.worst) == (0, (0, 0), (-1, -1))
    assert all(map(math.isnan, (found.rms_mm, found.max_mm, *found.by_target())))
