"""Poses inside a result file."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minimax_cal.fitting.pose_rows import pose_rows, read_poses
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.measurements import measurements


def test_poses_come_back(rng):
    y = rng.normal(size=(7, 2, 3))
    y[3, 1] = np.nan
    labels = np.array(list("abcabca"))
    u95 = np.array([1e-5] * 6 + [np.nan])
    data = measurements(rng.normal(size=(7, 4)), y, pose=labels, u95=u95, order=np.arange(7)[::-1])
    data = replace(data, sliding=np.array([False, True, False, False]))
    held = np.arange(7) % 3 == 0
    block = pose_rows(data, held, {"nominal": np.moveaxis(y, 1, 0)})
    back, again = read_poses(block, "fit.json")
    assert_array_equal(again, held)
    assert_array_equal(back.q, data.q)
    assert_array_equal(back.sliding, data.sliding)
    assert_allclose(back.y, y, rtol=1e-15)  # to millimetres and back
    assert_array_equal(back.columns["pose"], labels)
    assert_array_equal(back.columns["u95"], u95)
    assert_array_equal(back.columns["order"], np.arange(7, 0, -1))
    assert block["errors_mm"]["nominal"][3][1] == [None, None, None]


@pytest.mark.parametrize(
    ("key", "value"),
    [("q", [[0.0, 1.0]]), ("split", []), ("line", "x"), ("columns", None), ("measured_mm", [])],
)
def test_broken_poses_are_named(key, value, rng):
    data = measurements(rng.normal(size=(4, 2)), rng.normal(size=(4, 3)))
    block = pose_rows(data, np.zeros(4, dtype=bool), {}) | {key: value}
    with pytest.raises(DataError, match=r"fit\.json: .*"):
        read_poses(block, "fit.json")
