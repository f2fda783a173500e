"""Points that people set aside: every other number stays, and so does every row."""

from pathlib import Path

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_array_equal

import minimax_cal as mc
from minimax_cal.measuring.left_out import left_out
from minimax_cal.modelling.simulate import Simulation


def test_only_the_named_points_are_gone(noisy: Simulation) -> None:
    data = noisy.data
    line = data.line
    found = left_out(data, [f"{line[0]}:smr2", str(line[3])])
    gone = data.seen & ~found.seen
    assert {(int(i), int(j)) for i, j in np.argwhere(gone)} == {(0, 1), (3, 0), (3, 1), (3, 2)}
    assert_array_equal(found.y[~gone], data.y[~gone])
    assert_array_equal(found.q, data.q)
    assert found.notices[-1].startswith("4 points left out")


def test_nothing_named_changes_nothing(noisy: Simulation) -> None:
    assert left_out(noisy.data, []) is noisy.data


def test_lines_stay_those_of_the_file(noisy: Simulation, tmp_path: Path) -> None:
    whole, some = tmp_path / "poses.csv", tmp_path / "used.csv"
    mc.write_measurements(whole, noisy.data)
    assert run("import", whole, "--leave-out", "2:smr1,5", "-o", some) == 0
    before, after = whole.read_text().splitlines(), some.read_text().splitlines()
    assert [i + 1 for i, (a, b) in enumerate(zip(before, after, strict=True)) if a != b] == [2, 5]
    data = mc.read_measurements(some)
    assert 5 not in data.line  # a pose without a point
    assert np.isnan(data.y[data.line == 2, 0]).all()


@pytest.mark.parametrize(
    ("points", "said"),
    [("x", "write LINE:TARGET"), ("900000", "no pose stands in line"), ("2:smr9", "smr1, smr2")],
)
def test_a_point_that_is_not_there(
    points: str, said: str, noisy: Simulation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "poses.csv"
    mc.write_measurements(path, noisy.data)
    assert run("import", path, "--leave-out", points, "-o", tmp_path / "out.csv") == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()
