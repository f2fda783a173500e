"""Diagnoses of several stations, of a station that moved, and what the foot says of it."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from measuring.test_faults import reseated
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.diagnosis import Diagnosis, Finding
from minimax_cal.diagnosing.foot_reflectors import (
    compare_laws_with_reflectors,
    describe_reflector_agreement,
    mark_contradicted_findings,
)
from minimax_cal.diagnosing.joint_fit import GeometryEffectFit, fit_geometry_and_effects
from minimax_cal.diagnosing.residual_curves import ResidualViews
from minimax_cal.diagnosing.set_aside_points import SET_ASIDE_REASONS
from minimax_cal.diagnosing.study import linearise_geometry
from minimax_cal.fitting.cell_fit import fit_cell
from minimax_cal.fitting.noise_floor import DISTANCES
from minimax_cal.fitting.options import Options, silent_progress
from minimax_cal.measuring.faults.target_steps import TARGET_RESEAT_EFFECT
from minimax_cal.measuring.measurements import SET_ASIDE_BY_TOOL, SET_ASIDE_BY_USER, Measurements
from minimax_cal.measuring.set_aside_points import set_aside_points_named_by_user
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.simulate import Simulation, Truth, simulate

ROBOT = "irb2600"
BENT = mc.Truth(noise=20e-6, noise_per_metre=0.0)  # and compliance
MADE = mc.simulate(ROBOT, 120, 3, seed=4, truth=BENT)
ONE = MADE.data
SHIFT = np.array([0.6e-3, -0.8e-3, 0.0])  # 1 mm, in the measurement frame
LATE = np.arange(120) >= 70
SAMPLING = 1.0 / np.sqrt(2.0 * 9.0 * 24)  # relative, of an RMS over 24 poses of three targets
FOOT = np.array([[0.3, 0.2, 0.0], [-0.3, 0.2, 0.0], [0.0, -0.3, 0.1]])
FOOT_NOISE = 5e-6


def diagnosed(data: mc.Measurements) -> mc.Diagnosis:
    return mc.diagnose(ROBOT, data, quick=True)


@pytest.fixture(scope="module")
def plain() -> mc.Diagnosis:
    return diagnosed(ONE)


def test_two_stations_are_diagnosed_as_one(plain: mc.Diagnosis) -> None:
    session = np.where(np.arange(120) % 3 == 0, "a", "b")
    turn = Rotation.random(rng=np.random.default_rng(0)).as_matrix()
    y = np.where((session == "b")[:, None, None], ONE.y @ turn.T + 2.0, ONE.y)
    found = diagnosed(replace(ONE.with_y(y), columns={**ONE.columns, "session": session}))
    assert [f.term.label for f in found.effects] == [f.term.label for f in plain.effects]
    assert_allclose(
        [step.holdout.rms_mm for step in found.ladder[1:]],
        [step.holdout.rms_mm for step in plain.ladder[1:]],
        rtol=SAMPLING,
    )
    again = Diagnosis.from_dict(found.to_dict())
    assert again.data.frames.keys() == {"a", "b"}
    before, after = (d.cells[-1].error(d.data) for d in (found, again))
    assert_allclose(after, before, rtol=0, atol=1e-9)  # digits of millimetres
    left = ResidualViews.from_cells(found.data, found.held, found.noise, found.cells, [])
    reach = mc.load_robot(ROBOT).reach()
    assert (
        np.nanmax(np.linalg.norm(left.measured_points, axis=-1)) < 1.5 * reach
    )  # all about one base


def foot() -> dict[str, np.ndarray]:
    """Columns of three reflectors on the foot that move when the targets do."""
    base, rng = MADE.cell.base, np.random.default_rng(1)
    out = {}
    for number, spot in enumerate(FOOT):
        seen = base[:3, :3] @ spot + base[:3, 3] + LATE[:, None] * SHIFT
        seen = seen + FOOT_NOISE * rng.normal(size=seen.shape)
        out |= {f"base{number + 1}_{axis}": seen[:, i] for i, axis in enumerate("xyz")}
    return out


def test_a_jump_is_named_with_its_size_and_the_foot_judges_it(plain: mc.Diagnosis) -> None:
    data = ONE.with_y(ONE.y + LATE[:, None, None] * SHIFT)
    found = diagnosed(replace(data, columns={**data.columns, **foot()}))
    (jump,) = (f for f in found.effects if f.term.effect == "session_jump")
    assert jump.term.place == "frame"
    assert_allclose(jump.term.choice["since"], 70 / 119, rtol=1e-12)
    truth = np.concatenate([SHIFT @ MADE.cell.base[:3, :3], np.zeros(3)])
    assert np.all(np.abs(np.array(jump.values) - truth) < 4.0 * np.array(jump.sigmas))
    assert {f.term.label for f in found.effects} == {
        "session_jump:frame",
        *(f.term.label for f in plain.effects),
    }
    assert_allclose(found.ladder[-1].holdout.rms_mm, plain.ladder[-1].holdout.rms_mm, rtol=SAMPLING)
    (told,) = (text for text in found.notices if "on the foot" in text)
    assert told.endswith("they agree with it")


# ---- foot ----------------------------------------------------------------------------------------


FEET = np.array([[0.3, 0.3, 0.0], [-0.3, 0.3, 0.0], [0.0, -0.4, 0.1]])
SLOW = Term("frame_drift", "frame", {"constant": 0.3})
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

    spots = np.broadcast_to(FEET @ turn.T + origin, (data.poses, 3, 3))
    spots = (moved(spots) if sees else spots) + 5e-6 * rng.normal(size=spots.shape)
    columns = {
        f"base{i + 1}_{axis}": spots[:, i, at] for i in range(3) for at, axis in enumerate("xyz")
    }
    order = {"order": np.arange(data.poses, dtype=float)}
    drifted = replace(data, y=moved(data.y), columns={**data.columns, **columns, **order})
    return mc.load_robot("irb2600"), add_history_columns(drifted)


def drifting(sees: bool, term: Term) -> tuple[GeometryEffectFit, Measurements]:
    robot, data = crept(sees)
    fit = fit_cell(robot, data, Options(objective="sum"), silent_progress)
    return fit_geometry_and_effects(linearise_geometry(robot, data, fit), [term]), data


@pytest.mark.parametrize("term", [SLOW, TWO])
def test_reflectors_that_move_confirm_a_drift(term: Term) -> None:
    """Of one course and of two, whose twelve parameters were a traceback."""
    told = [*compare_laws_with_reflectors(*drifting(True, term))]
    (notice,) = describe_reflector_agreement(told)
    found = Finding((term,), (), (), (), (), again=1.0)
    assert [one.evidence for one in mark_contradicted_findings([found], told)] == [
        "confirmed, 1.00"
    ]
    assert not any(odd for _, _, odd in told)
    assert told[0][1] in notice
    assert "x +" in notice


@pytest.mark.parametrize("term", [SLOW, TWO])
def test_reflectors_that_stand_contradict_it(term: Term) -> None:
    told = [*compare_laws_with_reflectors(*drifting(False, term))]
    (notice,) = describe_reflector_agreement(told)
    assert [odd for _, _, odd in told] == ["x"]
    assert told[0][1] in notice
    other = Finding((Term("backlash", "J1"),), (), (), (), (), again=1.0)
    found = [*mark_contradicted_findings([replace(other, terms=(term,)), other], told)]
    assert found[0].evidence.startswith("confirmed, 1.00, contradicted in x")
    assert found[1].evidence == "confirmed, 1.00"


def test_without_reflectors_nothing_is_said() -> None:
    fit, data = drifting(True, SLOW)
    columns = {name: column for name, column in data.columns.items() if name[:4] != "base"}
    assert not list(compare_laws_with_reflectors(fit, replace(data, columns=columns)))


# ---- reseats -------------------------------------------------------------------------------------


NOISY = Truth(noise=20e-6, noise_per_metre=0.0, compliance=0.0)
ROW = 30
NOISE_MM = 1e3 * np.sqrt(3.0) * NOISY.noise


@cache
def reseat_of(targets: int) -> tuple[Simulation, Measurements, mc.Diagnosis]:
    """A reflector that was re-seated by 5 mm; the file tells no visits."""
    sim = simulate("irb120", 60, targets, seed=1, truth=NOISY)
    data = reseated(sim, replace(sim.data, columns={}), ROW, 1, np.array([3e-3, 0.0, 4e-3]))
    return sim, data, mc.diagnose("irb120", data, quick=True)


@pytest.mark.parametrize("targets", [2, 3])
def test_a_reseat_of_5_mm_is_named_with_its_size(targets: int) -> None:
    sim, _, found = reseat_of(targets)
    assert found.verdict == "named"
    (reseat,) = found.effects
    assert (reseat.term.effect, reseat.term.place) == ("target_reseat", "smr2")
    assert reseat.place_text == "at smr2"
    assert "re-seated" in reseat.cause
    assert_allclose(reseat.values[0], 5e-3, rtol=0.02)
    assert min(reseat.rows) == sim.data.line[ROW] or max(reseat.rows) == sim.data.line[ROW - 1]
    assert found.floor.source == DISTANCES
    assert_allclose(found.floor.value, NOISE_MM, rtol=0.5)
    assert found.floor.high < 2.0 * NOISE_MM
    assert found.ladder[-1].trusted.rms_mm < 2.0 * NOISE_MM


def test_a_fault_of_the_data_is_no_effect_to_fit() -> None:
    _, data, found = reseat_of(3)
    fit = mc.calibrate("irb120", data, objective="sum", effects=found)
    assert fit.cell.effects.terms == ()
    assert any("smr2" in notice for notice in fit.notices)


@pytest.mark.parametrize("targets", [1, 3])
def test_8_of_60_poses_that_are_off_are_named(targets: int) -> None:
    """All targets of a pose alike, which no distance shows; more than a tenth of the poses."""
    rng = np.random.default_rng(1)
    sim = simulate("irb120", 60, targets, seed=2, truth=NOISY)
    rows, by = rng.choice(60, 8, replace=False), rng.normal(size=(8, 1, 3))
    y = sim.data.y.copy()
    y[rows] += 3e-3 * by / np.linalg.norm(by, axis=-1, keepdims=True)
    found = mc.diagnose("irb120", replace(sim.data.with_y(y), columns={}), quick=True)
    assert found.verdict == "named"
    (wrong,) = found.effects
    assert wrong.term.effect == "outliers"
    assert set(wrong.rows) == set(sim.data.line[rows].tolist())
    assert found.ladder[-1].trusted.rms_mm < 2.0 * NOISE_MM
    assert found.floor.high < 2.5 * NOISE_MM


def test_what_no_fit_counts_is_listed_and_counted() -> None:
    """The re-seated part, and a point that the user set aside; both in the accuracy with them."""
    _, data, _ = reseat_of(3)
    found = mc.diagnose(
        "irb120", set_aside_points_named_by_user(data, ["3:smr1=looks odd"]), quick=True
    )
    by = {(p.by, p.target) for p in found.set_aside}
    assert by == {(SET_ASIDE_BY_USER, "smr1"), (SET_ASIDE_BY_TOOL, "smr2")}
    assert len(found.set_aside) == 1 + min(ROW, 60 - ROW)
    assert {p.why for p in found.set_aside if p.by == SET_ASIDE_BY_TOOL} == {
        SET_ASIDE_REASONS[TARGET_RESEAT_EFFECT]
    }
    assert found.with_them is not None
    assert_allclose(found.with_them.max_mm, 5.0, rtol=0.05)
    content = found.to_dict()
    assert len(content["set_aside"]) == len(found.set_aside)
    assert content["accuracy"]["holdout_with_them"]["max_mm"] == found.with_them.max_mm
    again = mc.Diagnosis.from_dict(content)
    assert again.set_aside == found.set_aside
    assert again.to_dict()["accuracy"] == content["accuracy"]
    counts = [int(n) for n in re.findall(r"(\d+) by the", found.headline())]
    assert counts == [1, 30]
