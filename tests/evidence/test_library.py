"""Columns of candidates: each motion by itself, however many poses there are."""

from dataclasses import replace

import numpy as np
import pytest

from minimax_cal.diagnosing.study import SUM, Study, studied
from minimax_cal.evidence.bench import bench
from minimax_cal.evidence.library import Library, Stack
from minimax_cal.evidence.selection import select, tuned
from minimax_cal.fitting.options import silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.measuring.history import with_history
from minimax_cal.modelling.dictionary import ArmLaws, arm_library
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots.robot import Robot

POSES, MOVED = 400, 163


@pytest.fixture(scope="module")
def shifted(robot: Robot) -> Study:
    """400 poses; the first of two targets sits 0.3 mm elsewhere after some of them."""
    sim = simulate(robot, POSES, 2, seed=1, truth=Truth(compliance=0.0))
    seats = sim.cell.target_positions + np.array([[2e-4, -1e-4, 2e-4], [0.0, 0.0, 0.0]])
    moved = replace(sim.cell, target_positions=seats).predict(sim.data.q)
    moved -= sim.cell.predict(sim.data.q)
    after = (np.arange(POSES) >= MOVED)[:, None, None]
    data = with_history(sim.data.with_y(sim.data.y + np.where(after, moved, 0.0)))
    return studied(robot, data, fit_cell(robot, data, SUM, silent))


def test_motions_that_differ_at_one_pose_are_two(shifted):
    clock = np.sort(shifted.scene.column("clock"))
    terms = [
        (Term("target_shift", target, {"since": float(clock[row])}), 1.0)
        for target in shifted.data.target_names
        for row in (*range(150, 180), POSES - 4)
    ]
    found = Library.empty(ArmLaws(shifted.scene, shifted.rows)).with_terms(terms)
    every = np.concatenate([candidate.main for candidate in found])
    assert len(np.unique(every)) == len(every) == 3 * len(terms)


def test_equal_motions_are_one(shifted):
    stack, term = (
        Stack(ArmLaws(shifted.scene, shifted.rows)),
        Term("frame_drift", "frame", {"constant": 0.5}),
    )
    one, other = stack.add(term), stack.add(term)
    assert one
    assert other
    assert (one.main == other.main).all()
    assert stack.columns.shape == (shifted.rows.error.size, len(np.unique(one.main)))


def test_a_nest_moved_at_the_pose_at_which_it_did(shifted):
    found = select(arm_library(shifted.scene, shifted.rows, ("gear_ripple",))).chosen
    clock = np.sort(shifted.scene.column("clock"))
    assert [c.term.label for c in found] == ["target_shift:smr1"]
    assert found[0].term.choice["since"] == clock[MOVED]


@pytest.mark.parametrize("off", [-30, 1, 17, 30])
def test_a_moment_is_found_from_one_nearby(shifted, off):
    clock = np.sort(shifted.scene.column("clock"))
    term = Term("target_shift", "smr1", {"since": float(clock[MOVED + off])})
    lib = Library.empty(ArmLaws(shifted.scene, shifted.rows))
    near = lib.with_terms([(term, 1.0)])
    table = bench(replace(lib, candidates=tuple(near)), ())
    assert tuned(table, table.added(near[0])).candidate.term.choice["since"] == clock[MOVED]


def test_fewer_moments_are_tried_the_farther_off(shifted):
    clock = np.sort(shifted.scene.column("clock"))
    finer = EFFECTS["target_shift"].finer(shifted.scene, {"since": float(clock[200])})
    rows = np.searchsorted(clock, [choice["since"] for choice in finer])
    assert len(rows) < 48
    assert {199, 200, 201} <= set(rows.tolist())
    assert rows.min() <= 170
    assert rows.max() >= 230
