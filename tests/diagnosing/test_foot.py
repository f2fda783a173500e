"""Reflectors on the foot, on an arm whose base creeps away and which they see do so, or not."""

from dataclasses import replace

import numpy as np
import pytest

import minimax_cal as mc
from minimax_cal.diagnosing.foot import asked_foot, foot_notices, foot_tells
from minimax_cal.diagnosing.joint import Joint, joint
from minimax_cal.diagnosing.result import Finding
from minimax_cal.diagnosing.study import studied
from minimax_cal.fitting.options import Options, silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.simulate import simulate

FOOT = np.array([[0.3, 0.3, 0.0], [-0.3, 0.3, 0.0], [0.0, -0.4, 0.1]])
ONE = Term("frame_drift", "frame", {"constant": 0.3})
TWO = Term("frame_drift", "frame", {"fast": 0.15, "slow": np.inf})  # twelve parameters
SLIP, TURN = np.array([2e-4, -1e-4, 5e-5]), np.array([2e-5, -4e-5, 6e-5])  # at the end [m, rad]


def crept(sees: bool) -> tuple[mc.Robot, Measurements]:
    """An arm that creeps as the base's law says, and reflectors that move with it, or stand."""
    made = simulate("irb2600", 120, 3, 5)
    rng, data = np.random.default_rng(2), made.data
    turn, origin = made.cell.base[:3, :3], made.cell.base[:3, 3]
    clock = np.linspace(0.0, 1.0, data.poses)
    way = (1.0 - np.exp(-clock / 0.3))[:, None, None]

    def moved(y: Array) -> Array:
        inner = (y - origin) @ turn
        return np.asarray(y + way * (SLIP + np.cross(TURN, inner)) @ turn.T)

    spots = np.broadcast_to(FOOT @ turn.T + origin, (data.poses, 3, 3))
    spots = (moved(spots) if sees else spots) + 5e-6 * rng.normal(size=spots.shape)
    columns = {
        f"base{i + 1}_{axis}": spots[:, i, at] for i in range(3) for at, axis in enumerate("xyz")
    }
    order = {"order": np.arange(data.poses, dtype=float)}
    drifted = replace(data, y=moved(data.y), columns={**data.columns, **columns, **order})
    return mc.load_robot("irb2600"), with_history(drifted)


def drifting(sees: bool, term: Term) -> tuple[Joint, Measurements]:
    robot, data = crept(sees)
    fit = fit_cell(robot, data, Options(objective="sum"), silent)
    return joint(studied(robot, data, fit), [term]), data


@pytest.mark.parametrize("term", [ONE, TWO])
def test_reflectors_that_move_confirm_a_drift(term: Term) -> None:
    """Of one course and of two, whose twelve parameters were a traceback."""
    told = [*foot_tells(*drifting(True, term))]
    (notice,) = foot_notices(told)
    found = Finding((term,), (), (), (), (), again=1.0)
    assert [one.evidence for one in asked_foot([found], told)] == ["confirmed, 1.00"]
    assert "they agree with it" in notice
    assert "x +" in notice


@pytest.mark.parametrize("term", [ONE, TWO])
def test_reflectors_that_stand_contradict_it(term: Term) -> None:
    told = [*foot_tells(*drifting(False, term))]
    (notice,) = foot_notices(told)
    assert "they contradict it in x" in notice
    other = Finding((Term("backlash", "J1"),), (), (), (), (), again=1.0)
    found = [*asked_foot([replace(other, terms=(term,)), other], told)]
    assert found[0].evidence.startswith("confirmed, 1.00, contradicted in x")
    assert found[1].evidence == "confirmed, 1.00"


def test_without_reflectors_nothing_is_said() -> None:
    fit, data = drifting(True, ONE)
    columns = {name: column for name, column in data.columns.items() if name[:4] != "base"}
    assert not list(foot_tells(fit, replace(data, columns=columns)))
