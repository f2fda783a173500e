"""Several files of one arm as sessions of one set of measurements."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from minimax_cal.measuring.campaigns import campaigns, session_names
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.set_aside import set_aside

DIGITS = 1e-9  # of a millimetre's in a file [m]


def made(seed: int = 0, poses: int = 20, targets: int = 2, **columns: object) -> mc.Measurements:
    rng = np.random.default_rng(seed)
    q, y = rng.uniform(-1.0, 1.0, (poses, 6)), rng.normal(size=(poses, targets, 3))
    return mc.measurements(q, y, **columns)  # type: ignore[arg-type]


def test_files_are_sessions_with_lines_that_count_on(tmp_path):
    parts = [made(seed, poses) for seed, poses in ((0, 20), (1, 15), (2, 12))]
    paths = [tmp_path / f"{name}.csv" for name in ("march", "june", "may")]
    for part, path in zip(parts, paths, strict=True):
        mc.write_measurements(path, part)
    data = mc.read_campaigns(paths)
    assert list(dict.fromkeys(data.columns["session"])) == ["march", "june", "may"]
    assert_allclose(data.q, np.concatenate([part.q for part in parts]), rtol=0, atol=DIGITS)
    assert len(set(data.line)) == data.poses == 47
    own = [mc.read_measurements(path).line for path in paths]
    assert_array_equal(data.line, np.concatenate([own[0], own[1] + 1000, own[2] + 2000]))
    assert any("june.csv from line 1001" in said for said in data.notices)
    assert "march.csv" in data.source
    assert "may.csv" in data.source


def test_one_file_is_read_as_ever(tmp_path):
    path = tmp_path / "march.csv"
    mc.write_measurements(path, made())
    data = mc.read_campaigns([path])
    assert "session" not in data.columns
    assert data.digest == mc.read_measurements(path).digest


def test_targets_go_by_name_and_columns_are_empty_where_a_file_lacks_them():
    one = replace(made(0), target_names=("smr1", "smr3"))
    two = replace(made(1, temperature=np.full(20, 21.0)), target_names=("smr3", "smr2"))
    data = campaigns([one, two], ["a", "b"])
    assert data.target_names == ("smr1", "smr3", "smr2")
    assert_array_equal(data.y[:20, 1], one.y[:, 1])
    assert_array_equal(data.y[20:, 1], two.y[:, 0])
    assert_array_equal(data.seen, np.repeat([[1, 1, 0], [0, 1, 1]], 20, axis=0) > 0)
    assert_array_equal(data.columns["temperature"], np.repeat([np.nan, 21.0], 20))


def test_labels_of_poses_mean_something_in_their_own_file_only():
    labels = np.arange(20).astype(str)
    data = campaigns([made(0, pose=labels), made(1, pose=labels)], ["a", "b"])
    assert len(set(data.columns["pose"])) == 40


def test_sessions_of_a_file_come_after_its_name():
    two = made(1, session=np.repeat(["am", "pm"], 10))
    data = campaigns([made(0), two], ["march", "june"])
    assert list(dict.fromkeys(data.columns["session"])) == ["march", "june/am", "june/pm"]


def test_a_split_of_one_file_leaves_the_others_for_training():
    held = np.where(np.arange(20) < 5, "holdout", "train")
    data = campaigns([made(0), made(1, split=held)], ["a", "b"])
    assert_array_equal(data.columns["split"] == "holdout", np.isin(np.arange(40), range(20, 25)))


def test_clocks_that_start_again_follow_each_other():
    time = np.arange(20) * 60.0
    data = with_history(campaigns([made(0, time=time), made(1, time=time)], ["a", "b"]))
    assert np.all(np.diff(data.columns["clock"]) > 0.0)
    later = campaigns([made(0, time=time), made(1, time=time + 1e6)], ["a", "b"])
    assert_array_equal(later.columns["time"][20:], time + 1e6)


def test_points_set_aside_stay_so():
    points = np.zeros((20, 2), dtype=bool)
    points[3, 1] = True
    two = set_aside(made(1), points, "nest knocked", "user")
    data = campaigns([made(0), two], ["a", "b"])
    (point,) = data.set_aside
    assert data.aside is not None
    assert point.row == data.aside.line[0] == two.set_aside[0].row + 1000
    assert data.aside.columns["session"][0] == "b"


def test_arms_of_other_joints_are_refused():
    other = mc.measurements(np.zeros((4, 7)), np.random.default_rng(0).normal(size=(4, 3)))
    with pytest.raises(mc.DataError, match=r"has 7 joints.* has 6"):
        campaigns([made(), other], ["a", "b"])
    slide = replace(made(), sliding=np.arange(6) == 2)
    with pytest.raises(mc.DataError, match="joint 3 is a length there"):
        campaigns([made(), slide], ["a", "b"])


def test_names_of_sessions_tell_the_files_apart(tmp_path):
    assert session_names(["x/march.csv", "x/june.csv"]) == ["march", "june"]
    assert session_names(["x/data.csv", "y/data.csv"]) == ["x/data", "y/data"]
    with pytest.raises(mc.DataError, match="is given twice"):
        session_names(["x/data.csv", "x/../x/data.csv"])
