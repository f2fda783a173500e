"""A diagnosis as numbers, file and tables: a made one, of which every number is known."""

from __future__ import annotations

import json
import math
from dataclasses import FrozenInstanceError, replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minimax_cal.diagnosing.result import (
    SHOWN_LINES,
    Alternative,
    Diagnosis,
    Finding,
    Step,
    Untestable,
    of_curve,
)
from minimax_cal.diagnosing.sentences import closed_words
from minimax_cal.fitting.accuracy import Accuracy
from minimax_cal.fitting.beyond import Beyond
from minimax_cal.fitting.fit import Provenance
from minimax_cal.fitting.floor import DECLARED, Floor
from minimax_cal.modelling.effects.table import Fitted, Term
from minimax_cal.modelling.effects.words import name_place
from minimax_cal.modelling.simulate import simulate
from minimax_cal.solvers.status import Status

PLAY, SOFT = Term("backlash", "J2"), Term("joint_compliance", "J3", {"parts": 128.0})


def scores(rms: float) -> Accuracy:
    return Accuracy(rms, 2.0 * rms, 0.9 * rms, 20, (20.0 * rms**2,), (20,))


def rung(name: str, train: float) -> Step:
    return Step(name, scores(train), scores(1.1 * train), scores(1.05 * train))


RUNGS = (rung("nominal", 3.0), rung("calibrated geometry", 1.0), rung("+ backlash J2", 0.8),
         rung("+ joint_compliance J3", 0.5))  # fmt: skip


def finding(term: Term, unit: str, value: float, sigma: float, **more: Any) -> Finding:
    return Finding((term,), ("c",), (unit,), (value,), (sigma,), 50.0, 1e-9, **more)


FINDINGS = (  # by share
    finding(SOFT, "rad/(N m)", 2e-6, 1e-7, share=0.6, before=0.84, after=0.5),
    finding(PLAY, "rad", 3e-5, 2e-6, share=0.3, before=1.05, after=0.84, again=0.8),
    finding(Term("outliers", "all"), "m", 0.002, math.nan, share=0.1, rows=(3, 5)),
)


@pytest.fixture(scope="module")
def made() -> Diagnosis:
    sim = simulate("irb2600", 30, 2, seed=1)
    base = sim.cell
    play, soft = np.array([3e-5]), np.array([2e-6])
    cells = [base, replace(base, effects=Fitted((PLAY,), (play,))),
             replace(base, effects=Fitted((PLAY, SOFT), (play, soft)))]  # fmt: skip
    error = np.zeros((2, 30, 3))
    return Diagnosis(
        "arm", RUNGS, Floor(0.1, 0.05, 0.2, DECLARED), 0.9, (0.8, 0.95), Beyond(), 2e-5, {},
        ("a notice",), Provenance("arm"), 1.5, sim.data, np.arange(30) % 5 == 0, tuple(cells),
        stated_errors=(error + 1e-3, error + 5e-4), stated_curves={}, nominal=base,
        status=Status.CONVERGED, verdict="named", effects=FINDINGS, jitter=4e-6, structure=0.25,
        structure_in="pose", not_testable=(Untestable("thermal", "temperatures"),),
    )  # fmt: skip


# ---- a finding ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, ""),
        (1, " (line 7)"),
        (SHOWN_LINES, " (line 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18)"),
        (SHOWN_LINES + 2, " (line 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18 and 2 more)"),
    ],
)
def test_a_dozen_lines_are_told_one_by_one(made: Diagnosis, count: int, text: str) -> None:
    found = replace(FINDINGS[2], rows=tuple(range(7, 7 + count)))
    assert found.points(made.data) == text


def test_points_go_by_the_names_of_the_file(made: Diagnosis) -> None:
    names = np.array([f"P{200 + i}" for i in range(made.data.poses)], dtype=object)
    named = replace(made.data, columns={**made.data.columns, "pose": names})
    found = replace(FINDINGS[2], rows=tuple(int(line) for line in named.line[:2]))
    assert found.points(named) == " (pose P200, P201)"


@pytest.mark.parametrize(
    ("p", "text"), [(0.0123, "0.01"), (1e-15, "1e-15"), (9e-16, "< 1e-15"), (math.nan, "-")]
)
def test_a_chance_too_small_to_matter_is_not_told(p: float, text: str) -> None:
    assert replace(FINDINGS[0], p_value=p).chance == text


def test_it_is_established_if_every_part_finds_it_again() -> None:
    assert [f.established for f in FINDINGS] == [True, False, True]


def test_parameters_are_told_in_units_of_files() -> None:
    soft, play, fault = (f.parameters[0] for f in FINDINGS)
    assert (soft["value"], soft["unit"]) == (2e-6, "rad/(N m)")
    assert (play["name"], play["value"], play["sigma"], play["unit"]) == ("c", 3e-5, 2e-6, "rad")
    assert (fault["value"], fault["sigma"], fault["unit"]) == (2.0, None, "mm")
    assumed = replace(FINDINGS[0], motion=(200.0,)).parameters[0]
    assert_allclose([assumed["value"], assumed["sigma"]], [0.4, 0.02])
    assert assumed["unit"] == "mrad at most"
    bent = replace(FINDINGS[0], units=("1/(N m^2)",), motion=(50.0,)).parameters[0]
    assert_allclose(bent["value"], 0.1)
    assert bent["unit"] == "mm at most"


def test_an_error_map_is_told_in_two_numbers() -> None:
    curve = np.array([[-1.0, 0.0, 1.0], [1e-4, -5e-4, 2e-4], [1e-5, 2e-5, 3e-5]])
    told = of_curve(curve)
    assert [p["name"] for p in told] == ["RMS", "largest"]
    assert [p["unit"] for p in told] == ["rad", "rad"]
    rms = [math.sqrt(sum(v * v for v in row) / 3.0) for row in curve[1:].tolist()]
    assert_allclose([[p["value"], p["sigma"]] for p in told], [rms, [5e-4, 2e-5]])
    drawn = replace(FINDINGS[1], curve=curve)
    assert drawn.parameters == told
    said = drawn.to_dict()
    assert said["curve"] == {"q_rad": [-1.0, 0.0, 1.0], "turn_rad": [1e-4, -5e-4, 2e-4],
                             "sigma_rad": [1e-5, 2e-5, 3e-5]}  # fmt: skip
    assert "curve" not in FINDINGS[1].to_dict()
    assert FINDINGS[1].curve.shape == (3, 0)


def test_an_alternative_helps_if_a_measurement_tells_it_apart() -> None:
    other = Alternative("gear_error", "J2", 0.9, 12.0, 3.0, "20 poses")
    assert other.helps
    assert not replace(other, separate_with="").helps
    assert not replace(other, separate_with="no measurement considered would").helps


@pytest.mark.parametrize(
    ("place", "words"),
    [("all", "of the whole arm"), ("J2", "at joint 2"), ("L11", "at link 11"), ("Jaw", "at Jaw"),
     ("smr1", "at smr1"), ("T1", "at T1")],
)  # fmt: skip
def test_places_in_words(place: str, words: str) -> None:
    assert name_place(place) == words


def test_all_targets_are_not_the_whole_arm() -> None:
    assert name_place("all", "outliers") == name_place("all", "target_reseat") == "of the targets"
    assert name_place("all", "joint_compliance") == "of the whole arm"
    assert name_place("smr1", "outliers") == "at smr1"


def test_results_are_themselves_and_stay_so(made: Diagnosis) -> None:
    """Their arrays would not compare."""
    other = Alternative("gear_error", "J2", 0.9, 12.0, 3.0)
    assert len({made, replace(made), *FINDINGS, replace(FINDINGS[0])}) == len(FINDINGS) + 3
    for one, name in ((made, "verdict"), (FINDINGS[0], "share"), (RUNGS[0], "name"),
                      (other, "effect")):  # fmt: skip
        with pytest.raises(FrozenInstanceError):
            setattr(one, name, "")


# ---- the file ----------------------------------------------------------------------------------


def test_the_file_holds_every_number(made: Diagnosis) -> None:
    said = json.loads(made.json())
    assert (said["schema"], said["kind"], said["robot"]) == (1, "diagnosis", "arm")
    gap = said["gap"]
    three = np.array([3.0, 1.0, 0.5])
    for name, factor in (("holdout_rms", 1.1), ("holdout_max", 2.2), ("trusted_rms", 1.05)):
        row = gap[f"{name}_mm"]
        assert_allclose([row[k] for k in ("nominal", "geometric", "final")], factor * three)
    assert [gap["noise_floor_mm"], *gap["noise_floor_range_mm"]] == [0.1, 0.05, 0.2]
    assert (gap["noise_floor_from"], gap["closed"]) == (DECLARED, 0.9)
    assert gap["closed_ci95"] == [0.8, 0.95]
    assert [row["step"] for row in gap["ladder"]] == [step.name for step in RUNGS]
    for row, step in zip(gap["ladder"], RUNGS, strict=True):
        told = [row[part]["rms_mm"] for part in ("train", "holdout", "trusted")]
        assert told == [step.train.rms_mm, step.holdout.rms_mm, step.trusted.rms_mm]
    assert said["noise"] == {"instrument_mm": 0.02, "joint_jitter_mrad": 0.004}
    assert said["structure"] == {"p": 0.25, "in": "pose"}
    assert said["not_testable"] == [{"effect": "thermal", "needs": "temperatures"}]
    soft, play, fault = said["effects"]
    assert (play["effect"], play["place"], play["established"], play["frequency"]) == (
        "backlash", "J2", False, 0.8)  # fmt: skip
    assert (soft["share"], soft["lambda"], soft["chance"]) == (0.6, 50.0, 1e-9)
    assert soft["holdout_rms_mm"] == {"before": 0.84, "after": 0.5}
    assert (fault["lines"], fault["holdout_rms_mm"]["after"]) == ([3, 5], None)
    assert [len(cell["effects"]) for cell in said["cells"]] == [0, 2]
    assert [row["name"] for row in said["rungs"]] == [
        "nominal", "geometric", "+ backlash J2", "+ joint_compliance J3"]  # fmt: skip
    assert len(said["poses"]["line"]) == 30
    assert replace(made, nominal=None).rungs() == ()


def test_an_interval_that_says_nothing_is_null(made: Diagnosis) -> None:
    unsure = replace(made, closed_ci=(math.nan, math.nan))
    said = json.loads(unsure.json())
    assert said["gap"]["closed_ci95"] is None
    assert "95 % interval" not in closed_words(unsure)
    assert "95 % interval 80 to 95 %" in closed_words(made)
    assert not Diagnosis.from_dict(said).has_interval


def test_errors_and_curves_are_those_of_the_cells(made: Diagnosis) -> None:
    bare = replace(made, stated_errors=None, stated_curves=None)
    first, last = bare.errors
    assert_allclose(first, made.cells[0].error(made.data), rtol=0, atol=1e-12)
    assert_allclose(last, made.cells[-1].error(made.data), rtol=0, atol=1e-12)
    assert np.abs(last - made.cells[1].error(made.data)).max() > 1e-5  # what gives way sags
    assert set(bare.curves) == {"residual", "order"}
    assert_array_equal(made.errors[1], 5e-4)
    assert made.curves == {}


# ---- tables ------------------------------------------------------------------------------------


def test_findings_stand_in_the_order_of_the_ladder(made: Diagnosis) -> None:
    assert [f.term.effect for f in made.by_rung] == ["outliers", "joint_compliance", "backlash"]


def test_the_tables_hold_the_numbers_of_people(made: Diagnosis) -> None:
    ladder = made.ladder_table()
    assert ladder.rows[1] == ("calibrated geometry", 1.0, 2.0, 1.1, 2.2)
    assert ladder.rows[-1] == (f"noise floor ({DECLARED})", 0.1, "", 0.1, "")
    effects = made.effects_table()
    assert [row[0] for row in effects.rows] == [  # what is tentative last
        "outliers of the targets (line 3, 5)", "joint compliance at joint 3",
        "backlash at joint 2"]  # fmt: skip
    assert_allclose([row[2] for row in effects.rows], [10.0, 60.0, 30.0])
    assert [row[-1] for row in effects.rows] == [
        "confirmed", "confirmed, 1.00", "possible, 0.80"]  # fmt: skip
    assert effects.rows[1][3:6] == (0.84, 0.5, "1e-09")
    values = {row[0].partition(" at ")[0]: row[2:] for row in made.parameter_table().rows}
    assert_allclose(values["backlash"][:2], (0.03, 0.002))
    assert values["backlash"][2] == "mrad"
    assert_allclose(values["joint compliance"][:2], (2e-3, 1e-4))
    assert values["joint compliance"][2] == "mrad/(N m)"
    assert_allclose(values["outliers of the targets"][:2], (2.0, math.nan))
    assert made.untestable_table().rows == (("thermal", "temperatures"),)


def test_what_every_row_says_alike_is_no_column(made: Diagnosis) -> None:
    sure = replace(made, effects=(FINDINGS[0], replace(FINDINGS[1], again=1.0)))
    table = sure.effects_table()
    assert "evidence" not in table.header
    assert {len(table.header), len(table.formats), *map(len, table.rows)} == {6}
    assert len(made.effects_table().header) == 7


def test_a_cause_is_told_once(made: Diagnosis) -> None:
    twice = replace(FINDINGS[0], terms=(Term("joint_compliance", "J4"),), share=0.2)
    rows = replace(made, effects=(FINDINGS[0], twice)).effects_table().rows
    assert [row[1] == "as above" for row in rows] == [False, True]
    assert rows[0][0] == "joint compliance at joint 4"


def test_rivals_are_told_with_what_tells_them_apart(made: Diagnosis) -> None:
    rivals = (Alternative("gear_error", "J2", 0.9, 12.0, 3.0, "20 poses"),
              Alternative("encoder_gain", "J2", 0.5, 30.0, 9.0))  # fmt: skip
    found = replace(made, effects=(replace(FINDINGS[1], alternatives=rivals),))
    assert found.rival_table().rows == (
        ("backlash at joint 2", "gear error at joint 2", 0.9, 12.0, 3.0, "20 poses"),
        ("backlash at joint 2", "encoder gain at joint 2", 0.5, 30.0, 9.0,
         "no measurement considered would"),
    )  # fmt: skip
    titles = [table.title for table in found.tables()]
    assert len(titles) == len(made.tables()) + 1
    assert all(table.rows for table in found.tables())
