"""A file that tells no order yields nothing of time or move, unless its rows are said to be it."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import run

import minimax_cal as mc
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.faults import find_faults
from minimax_cal.measuring.history import ordered, with_history
from minimax_cal.modelling.simulate import Truth, simulate

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
    scene = cell.scene(with_history(data))
    return {name: effect.needs(scene) for name, effect in EFFECTS.items()}


def test_nothing_of_the_order_is_made_up(shifted):
    data = untold(shifted)
    assert ordered(shifted)
    assert not ordered(data)
    told = with_history(data).columns
    assert not any(np.any(column) for column in told.values())
    assert not ordered(data.take(np.arange(40)))
    assert with_history(data.in_visit_order()).columns["clock"][-1] == 1.0


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
        return [fault.effect for fault in find_faults(with_history(data))]

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
