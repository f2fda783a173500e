"""An effect that somebody registers, with what it states of itself, on the whole way."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.modelling.effects import EFFECTS, Effect, EffectColumns, PosedArm, Term, register
from minimax_cal.modelling.effects.scene import Choice, one_joint
from minimax_cal.modelling.effects.table import Fitted
from minimax_cal.modelling.simulate import Truth, simulate

PULL, SWAY = 8e-5, 1e-3


def wound(scene: PosedArm) -> Array:
    return np.asarray(scene.q[3] + scene.q[5])


def pull(scene: PosedArm, place: str, choice: Choice) -> EffectColumns:
    return EffectColumns(("k",), ("1/rad",), turn=one_joint(scene, 4, wound(scene)[None] ** 2))


def hose(scene: PosedArm, joint: int, choice: Choice) -> tuple[str, Array]:
    return "hose wound up (deg)", np.degrees(wound(scene))


def sway(scene: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """The tracker's mast leans as the arm turns towards it."""
    shift = np.zeros((1, *scene.points.shape))
    shift[0, :, 0] = np.cos(2.0 * scene.q[0])
    return EffectColumns(("s",), ("m",), shift=shift)


HOSE = Effect(
    "hose_pull",
    "a hose that joints 4 and 6 wind up pulls at the wrist",
    "dq_5 = k (q_4 + q_6)^2",
    lambda scene: ("J5",) if scene.joints == 6 else (),
    pull,
    typical=1e-4,
    moves="arm",
    follows="source",
    against=hose,
)
MAST = replace(HOSE, name="mast_sway", cause="the mast sways", law="dx = s cos 2q_1",
               places=lambda scene: ("frame",), columns=sway, typical=1e-3,
               moves="instrument", follows="", against=None)  # fmt: skip


@pytest.fixture(autouse=True)
def library() -> Iterator[None]:
    kept = dict(EFFECTS)
    register(HOSE)
    register(MAST)
    yield
    EFFECTS.clear()
    EFFECTS.update(kept)


@pytest.fixture
def measured(robot: mc.Robot) -> mc.Measurements:
    made = simulate(robot, 90, 2, seed=3, truth=Truth(compliance=0.0))
    terms = Term("hose_pull", "J5"), Term("mast_sway", "frame")
    true = Fitted(terms, (np.array([PULL]), np.array([SWAY])))
    off = replace(made.cell, effects=true).follow(made.data) - made.cell.predict(made.data.q)
    return made.data.with_y(made.data.y + off)


def test_it_is_fitted_diagnosed_drawn_compensated_and_reported(
    robot: mc.Robot, measured: mc.Measurements, tmp_path: Path
) -> None:
    told = mc.diagnose(robot, measured, quick=True)
    named = {finding.term.label: finding for finding in told.effects}
    assert set(named) == {"hose_pull:J5", "mast_sway:frame"}
    for label, true in (("hose_pull:J5", PULL), ("mast_sway:frame", SWAY)):
        (value,), (sigma,) = named[label].values, named[label].sigmas
        assert abs(value - true) < 4.0 * sigma < true

    left = replace(told, effects=(named["hose_pull:J5"],), stated_curves=None)
    curve = left.curves["residual"]
    assert curve.xlabel == "hose wound up (deg)"
    assert "joint 5" in curve.ylabel
    q = told.data.q * robot.sign
    assert_allclose(curve.x, np.degrees(q[:, 3] + q[:, 5]), atol=1e-9)

    fit = mc.calibrate(robot, measured, objective="sum", effects=[*named])
    bent = measured.q[np.abs(measured.q[:, 4]) > 0.4][:8]  # a straight wrist can turn no way
    fixed = mc.compensate(fit, bent)
    assert fixed.distance.max() < 1e-5  # its tolerance
    assert any("fitted without mast sway" in notice for notice in fixed.notices)
    assert fixed.delivered.carries == ("hose_pull:J5",)

    told.save(tmp_path / "told.json")
    page = tmp_path / "report.html"
    assert run("report", tmp_path / "told.json", "-o", page) == 0
    assert "hose pull" in page.read_text()
    assert HOSE.cause in page.read_text()


def test_facts_that_are_none_are_refused() -> None:
    with pytest.raises(OptionError, match="moves 'the arm'; choose arm, foot"):
        register(replace(HOSE, moves="the arm"))
    with pytest.raises(OptionError, match="follows 'weight'; choose angle"):
        register(replace(HOSE, follows="weight"))
