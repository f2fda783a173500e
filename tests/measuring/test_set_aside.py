"""Points that are set aside: every other number stays, and nobody forgets them."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import FILE, TOOL, USER, Measurements
from minimax_cal.measuring.set_aside import NO_REASON, counted, entries, left_out, set_aside, whole
from minimax_cal.modelling.simulate import Simulation


@pytest.fixture
def measured(noisy: Simulation) -> Measurements:
    """Measurements whose file begins with its header."""
    return replace(noisy.data, simulated=False, line=np.arange(noisy.data.poses) + 2)


def test_only_the_named_points_are_gone(measured):
    data, line = measured, measured.line
    found = left_out(data, [f"{line[0]}:smr2=knocked", str(line[3])])
    assert [(p.row, p.pose, p.target, p.why, p.by) for p in found.set_aside] == [
        (line[0], 1, "smr2", "knocked", USER),
        *((line[3], 4, name, NO_REASON, USER) for name in data.target_names),
    ]
    assert_array_equal(found.line, np.delete(line, 3))  # a pose without a point
    gone = np.zeros(data.seen.shape, dtype=bool)
    gone[0, 1], gone[3] = True, True
    assert_array_equal(found.y, np.where(gone[..., None], np.nan, data.y)[found.line - 2])
    assert found.aside is not None
    assert_array_equal(found.aside.line, line[[0, 3]])
    assert_array_equal(found.aside.y, np.where(gone[..., None], data.y, np.nan)[[0, 3]])
    assert found.notices[-1].startswith("4 points set aside")
    assert_array_equal(whole(found).y, data.y)


def test_nothing_named_changes_nothing(measured):
    assert left_out(measured, []) is measured
    assert whole(measured) is measured


def test_what_is_set_aside_twice_comes_once(measured):
    data = left_out(measured, ["2:smr1", "2:smr1=twice", "3"])
    assert [(p.row, p.target) for p in data.set_aside] == [
        (2, "smr1"), (3, "smr1"), (3, "smr2"), (3, "smr3")]  # fmt: skip
    mask = np.zeros(data.seen.shape, dtype=bool)
    mask[0] = True
    more = set_aside(data, mask, "trimmed", TOOL)
    assert [(p.row, p.pose, p.target) for p in more.set_aside[4:]] == [
        (2, 1, "smr2"), (2, 1, "smr3")]  # fmt: skip
    assert_array_equal(whole(more).y, measured.y)


def test_a_file_keeps_them_with_the_reason_and_who_it_was(measured, tmp_path):
    first, second = tmp_path / "poses.csv", tmp_path / "used.csv"
    mc.write_measurements(first, measured)
    assert run("import", first, "--leave-out", "2:smr1,5=nest, knocked; twice", "-o", second) == 0
    data = mc.read_measurements(second)
    assert 5 not in data.line
    assert np.isnan(data.y[data.line == 2, 0]).all()
    assert {(p.row, p.target) for p in data.set_aside} == {
        (2, "smr1"), (5, "smr1"), (5, "smr2"), (5, "smr3")}  # fmt: skip
    assert {(p.why, p.by) for p in data.set_aside} == {("nest, knocked, twice", USER)}
    assert_allclose(whole(data).y, measured.y, rtol=0, atol=1e-9)
    mask = np.zeros(data.seen.shape, dtype=bool)
    mask[7, 2] = True
    mc.write_measurements(second, set_aside(data, mask, "marked deleted", FILE))
    again = mc.read_measurements(second)
    assert again.set_aside[-1].by == FILE or again.set_aside[0].by == FILE
    assert len(again.set_aside) == 5


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        ("nest knocked", [("", "nest knocked", USER)]),
        ("smr2: too far [file]", [("smr2", "too far", FILE)]),
        ("smr1: a; smr3", [("smr1", "a", USER), ("", "smr3", USER)]),
        ("smr1:", [("smr1", NO_REASON, USER)]),
        ("a: b [x]", [("", "a: b [x]", USER)]),
    ],
)
def test_cells_of_the_column(cell, said):
    assert entries(cell) == said


def test_the_column_names_targets_that_are_there(measured, tmp_path):
    path = tmp_path / "poses.csv"
    cells = np.array(["", "smr9: x", *[""] * (measured.poses - 2)])
    mc.write_measurements(path, replace(measured, columns={"set_aside": cells}))
    with pytest.raises(mc.DataError, match=r"poses.csv:3: column set_aside: no target smr9"):
        mc.read_measurements(path)
    cells[:] = "smr3: all bad"
    mc.write_measurements(path, replace(measured, columns={"set_aside": cells}))
    with pytest.raises(mc.DataError, match="smr3 is measured at no pose, but for points"):
        mc.read_measurements(path)
    cells[:] = "all bad"
    mc.write_measurements(path, replace(measured, columns={"set_aside": cells}))
    with pytest.raises(mc.DataError, match="every measured point is set aside"):
        mc.read_measurements(path)


def test_poses_set_aside_were_visited(measured):
    """The moves of the other poses, and the clock, are those of the whole file."""
    every = with_history(measured)
    found = with_history(left_out(measured, ["9", "10:smr1", "20"]))
    kept = np.isin(every.line, found.line)
    for name, column in found.columns.items():
        assert_array_equal(column, every.columns[name][kept])
    assert found.aside is not None
    for name, column in found.aside.columns.items():
        assert_array_equal(column, every.columns[name][np.isin(every.line, [9, 10, 20])])


def test_how_many_in_words(measured):
    data = left_out(measured, ["3:smr1"])
    assert counted(data.set_aside) == "1 point set aside by the user"
    mask = np.zeros(data.seen.shape, dtype=bool)
    mask[:2, 2] = True
    data = set_aside(data, mask, "trimmed", TOOL)
    assert counted(data.set_aside) == "3 points set aside (1 by the user, 2 by the program)"


@pytest.mark.parametrize(
    ("points", "said"),
    [("x", "write LINE:TARGET"), ("900000", "no pose stands in line"), ("2:smr9", "smr1, smr2")],
)
def test_a_point_that_is_not_there(points, said, measured, tmp_path, capsys):
    path = tmp_path / "poses.csv"
    mc.write_measurements(path, measured)
    assert run("import", path, "--leave-out", points, "-o", tmp_path / "out.csv") == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()
