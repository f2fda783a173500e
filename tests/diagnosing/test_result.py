"""A diagnosis as numbers, file and tables: a made one, of which every number is known."""

from __future__ import annotations

import json
import math
import re
from dataclasses import FrozenInstanceError, replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems_fit import numbers

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.diagnosis import (
    MAX_SHOWN_FAULT_LINES,
    MOTION_UNITS_WITHOUT_MASSES,
    VERDICTS,
    AlternativeEffect,
    BudgetStep,
    Diagnosis,
    DriverDependence,
    Finding,
    RemainingError,
    UntestableEffect,
)
from minimax_cal.diagnosing.diagnosis_sentences import (
    UNKNOWN_REPEATABILITY_TEXT,
    VERDICT_OPENINGS,
    describe_explained_fraction,
    join_places,
)
from minimax_cal.diagnosing.proposals import REVISIT_PROPOSAL
from minimax_cal.diagnosing.residual_curves import (
    ResidualCurve,
    ResidualViews,
    build_residual_curve,
    build_visit_order_curve,
    drop_effect,
    equivalent_joint_rotations,
    fit_equivalent_rotations,
    select_shown_joint,
)
from minimax_cal.fitting.accuracy import Accuracy
from minimax_cal.fitting.fit import Provenance
from minimax_cal.fitting.noise_floor import AT_MOST, DECLARED, DISTANCES, REPEATS, NoiseFloor
from minimax_cal.fitting.region_holdout import RegionHoldout
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.effects import curve_axes
from minimax_cal.modelling.effects.curve_axes import joint_value_axis
from minimax_cal.modelling.effects.effect_names import (
    format_budget_step,
    format_effect,
    format_p_value,
    format_place,
    format_remaining_structure,
)
from minimax_cal.modelling.effects.table import NO_EFFECTS, Fitted, Term
from minimax_cal.modelling.simulate import simulate
from minimax_cal.reporting.diagnosis_tables import build_remaining_error_table
from minimax_cal.robots.gravity_torques import link_masses_and_centres
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.kinematics import rotation_from_vector
from minimax_cal.selection.thresholds import FALSE_NAME_PROBABILITY, SUFFICIENT_SEPARATION_POWER
from minimax_cal.solvers.status import Status

PLAY, SOFT = Term("backlash", "J2"), Term("joint_compliance", "J3", {"parts": 128.0})


def scores(rms: float) -> Accuracy:
    return Accuracy(rms, 2.0 * rms, 0.9 * rms, 20, (20.0 * rms**2,), (20,))


def rung(name: str, train: float) -> BudgetStep:
    return BudgetStep(name, scores(train), scores(1.1 * train), scores(1.05 * train))


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
    error = np.zeros((30, 2, 3))
    return Diagnosis(
        "arm",
        RUNGS,
        NoiseFloor(0.1, 0.05, 0.2, DECLARED),
        0.9,
        (0.8, 0.95),
        RegionHoldout(),
        2e-5,
        {},
        ("a notice",),
        Provenance("arm"),
        1.5,
        sim.data,
        np.arange(30) % 5 == 0,
        tuple(cells),
        stated_errors=(error + 1e-3, error + 5e-4),
        stated_curves={},
        nominal=base,
        status=Status.CONVERGED,
        verdict="named",
        effects=FINDINGS,
        jitter=4e-6,
        structure=0.25,
        structure_in="pose",
        not_testable=(UntestableEffect("thermal", "temperatures"),),
    )


# ---- a finding ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, ""),
        (1, " (line 7)"),
        (MAX_SHOWN_FAULT_LINES, " (line 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18)"),
        (
            MAX_SHOWN_FAULT_LINES + 2,
            " (line 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18 and 2 more)",
        ),
    ],
)
def test_a_dozen_lines_are_told_one_by_one(made: Diagnosis, count: int, text: str) -> None:
    found = replace(FINDINGS[2], rows=tuple(range(7, 7 + count)))
    assert found.describe_fault_points(made.data) == text


def test_points_go_by_the_names_of_the_file(made: Diagnosis) -> None:
    names = np.array([f"P{200 + i}" for i in range(made.data.poses)], dtype=object)
    named = replace(made.data, columns={**made.data.columns, "pose": names})
    found = replace(FINDINGS[2], rows=tuple(int(line) for line in named.line[:2]))
    assert re.findall(r"P\d+", found.describe_fault_points(named)) == ["P200", "P201"]


@pytest.mark.parametrize(
    ("p", "text"), [(0.0123, "0.01"), (1e-15, "1e-15"), (9e-16, "< 1e-15"), (math.nan, "-")]
)
def test_a_chance_too_small_to_matter_is_not_told(p: float, text: str) -> None:
    assert replace(FINDINGS[0], p_value=p).p_value_text == text


def test_it_is_established_if_every_part_finds_it_again() -> None:
    assert [f.established for f in FINDINGS] == [True, False, True]


def test_parameters_are_told_in_units_of_files() -> None:
    soft, play, fault = (f.parameters[0] for f in FINDINGS)
    assert (soft["value"], soft["unit"]) == (2e-6, "rad/(N m)")
    assert (play["name"], play["value"], play["sigma"], play["unit"]) == ("c", 3e-5, 2e-6, "rad")
    assert (fault["value"], fault["sigma"], fault["unit"]) == (2.0, None, "mm")
    assumed = replace(FINDINGS[0], motion=(200.0,)).parameters[0]
    assert_allclose([assumed["value"], assumed["sigma"]], [0.4, 0.02])
    assert assumed["unit"] == MOTION_UNITS_WITHOUT_MASSES["rad/(N m)"]
    bent = replace(FINDINGS[0], units=("1/(N m^2)",), motion=(50.0,)).parameters[0]
    assert_allclose(bent["value"], 0.1)
    assert bent["unit"] == MOTION_UNITS_WITHOUT_MASSES["1/(N m^2)"]


def test_an_error_map_is_told_in_two_numbers() -> None:
    curve = np.array([[-1.0, 0.0, 1.0], [1e-4, -5e-4, 2e-4], [1e-5, 2e-5, 3e-5]])
    drawn = replace(FINDINGS[1], curve=curve)
    told = drawn.parameters
    assert [p["name"] for p in told] == ["RMS", "largest"]
    assert [p["unit"] for p in told] == ["rad", "rad"]
    rms = [math.sqrt(sum(v * v for v in row) / 3.0) for row in curve[1:].tolist()]
    assert_allclose([[p["value"], p["sigma"]] for p in told], [rms, [5e-4, 2e-5]])
    said = drawn.to_dict()
    assert said["curve"] == {"q_rad": [-1.0, 0.0, 1.0], "turn_rad": [1e-4, -5e-4, 2e-4],
                             "sigma_rad": [1e-5, 2e-5, 3e-5]}  # fmt: skip
    assert "curve" not in FINDINGS[1].to_dict()
    assert FINDINGS[1].curve.shape == (3, 0)


def test_an_alternative_helps_if_a_measurement_tells_it_apart() -> None:
    other = AlternativeEffect("gear_error", "J2", 0.9, 12.0, 3.0, "20 poses")
    assert other.has_helpful_measurement
    assert not replace(other, separate_with="").has_helpful_measurement
    assert not replace(
        other, separate_with="no measurement considered would"
    ).has_helpful_measurement


@pytest.mark.parametrize(
    ("place", "words"),
    [("all", "of the whole arm"), ("J2", "at joint 2"), ("L11", "at link 11"), ("Jaw", "at Jaw"),
     ("smr1", "at smr1"), ("T1", "at T1")],
)  # fmt: skip
def test_places_in_words(place: str, words: str) -> None:
    assert format_place(place) == words


def test_all_targets_are_not_the_whole_arm() -> None:
    assert format_place("all", "outliers") == format_place("all", "target_reseat")
    assert format_place("all", "joint_compliance") not in ("", format_place("all", "outliers"))
    assert format_place("smr1", "outliers") == "at smr1"


def test_results_are_themselves_and_stay_so(made: Diagnosis) -> None:
    """Their arrays would not compare."""
    other = AlternativeEffect("gear_error", "J2", 0.9, 12.0, 3.0)
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
    steps = [finding.term.budget_step_name for finding in (FINDINGS[1], FINDINGS[0])]
    assert [row["name"] for row in said["rungs"]] == ["nominal", "geometric", *steps]
    assert len(said["poses"]["line"]) == 30
    assert replace(made, nominal=None).rungs() == ()


def test_an_interval_that_says_nothing_is_null(made: Diagnosis) -> None:
    unsure = replace(made, closed_ci=(math.nan, math.nan))
    said = json.loads(unsure.json())
    assert said["gap"]["closed_ci95"] is None
    assert numbers(describe_explained_fraction(made)) == [90.0, 95.0, 80.0, 95.0]
    assert numbers(describe_explained_fraction(unsure)) == [90.0]
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
    assert [f.term.effect for f in made.findings_in_step_order] == [
        "outliers",
        "joint_compliance",
        "backlash",
    ]


def test_the_tables_hold_the_numbers_of_people(made: Diagnosis) -> None:
    ladder = made.budget_table()
    assert ladder.rows[1][1:] == (1.0, 2.0, 1.1, 2.2)
    assert ladder.rows[-1][1:] == (0.1, "", 0.1, "")
    effects = made.effects_table()
    soft, play, fault = FINDINGS
    names = [f"{fault.name}{fault.describe_fault_points(made.data)}", soft.name, play.name]
    assert [row[0] for row in effects.rows] == names  # what is tentative last
    assert_allclose([row[2] for row in effects.rows], [10.0, 60.0, 30.0])
    assert [row[-1] for row in effects.rows] == [f.evidence for f in (fault, soft, play)]
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
    assert rows[0][0] == twice.name


def test_rivals_are_told_with_what_tells_them_apart(made: Diagnosis) -> None:
    rivals = (AlternativeEffect("gear_error", "J2", 0.9, 12.0, 3.0, "20 poses"),
              AlternativeEffect("encoder_gain", "J2", 0.5, 30.0, 9.0))  # fmt: skip
    found = replace(made, effects=(replace(FINDINGS[1], alternatives=rivals),))
    rows = found.alternative_table().rows
    assert [row[:2] for row in rows] == [(FINDINGS[1].name, rival.name) for rival in rivals]
    assert [row[2:5] for row in rows] == [(0.9, 12.0, 3.0), (0.5, 30.0, 9.0)]
    assert (rows[0][5], rows[1][5] in ("", "20 poses")) == ("20 poses", False)
    titles = [table.title for table in found.tables()]
    assert len(titles) == len(made.tables()) + 1
    assert all(table.rows for table in found.tables())


# ---- sentences -----------------------------------------------------------------------------------


FOUND = (  # effect, place, share, held-out RMS before and after [mm]; by share, as in the file
    ("joint_compliance", "J2", 0.60, 0.5, 0.3),
    ("gear_error", "J3", 0.20, 0.8, 0.5),
    ("gear_ripple", "J1", 0.12, 0.3, 0.25),
    ("gear_error", "J5", 0.02, 0.25, 0.24),
    ("backlash", "J4", 0.01, 0.24, 0.23),
)
LADDER = ("gear_error J3", "joint_compliance J2", "gear_ripple J1", "gear_error J5", "backlash J4")
IN_WORDS = [format_budget_step(f"+ {name}").removeprefix("+ ") for name in LADDER]
WIDER = "measure 20 more poses all over the workspace"


def step(name: str, rms: float) -> BudgetStep:
    return BudgetStep(name, scores(rms), scores(rms), scores(rms))


def cause(effect: str, place: str, share: float, before: float, after: float) -> Finding:
    unit = "rad/(N m)" if effect == "joint_compliance" else "rad"
    return Finding((Term(effect, place),), ("c",), (unit,), (2e-6,), (1.23456e-7,), 100.0, 1e-9,
                   share=share, before=before, after=after, minor=share < 0.05)  # fmt: skip


@pytest.fixture(scope="module")
def bare() -> Diagnosis:
    robot = mc.load_robot("irb2600")
    return mc.diagnose(robot, simulate(robot, 60, 1, seed=1).data, quick=True)


@pytest.fixture
def found(bare: Diagnosis) -> Diagnosis:
    after = {f"{effect} {place}": rms for effect, place, _, _, rms in FOUND}
    rungs = [step(f"+ {name}", after[name]) for name in LADDER]
    return replace(
        bare, verdict="named", effects=tuple(cause(*row) for row in FOUND), closed=0.95,
        closed_ci=(0.9, 0.97), ladder=(step("nominal", 2.0), step("geometric", 0.8), *rungs),
        floor=NoiseFloor(0.03, 0.0, 0.03, AT_MOST), beyond=RegionHoldout(), floor_known=True,
    )  # fmt: skip


def marked(found: Diagnosis, **more: Any) -> Diagnosis:
    """With what the evidence says besides: whether effects are established, what remains."""
    for name, value in more.pop("established", {}).items():
        one = next(f for f in found.effects if f.term.effect == name)
        object.__setattr__(one, "again", float(value))
    for name, value in more.items():
        object.__setattr__(found, name, value)
    return found


def test_every_verdict_opens_the_words(found: Diagnosis) -> None:
    assert set(VERDICT_OPENINGS) == set(VERDICTS)
    alternative = AlternativeEffect("link_bending", "L2", 0.9, 3.0, 1.0)
    first = replace(found.effects[0], alternatives=(alternative,))
    for verdict in VERDICTS:
        changed = replace(found, verdict=verdict)
        if verdict == "one_of":
            changed = replace(changed, effects=(first, *found.effects[1:]))
            assert changed.main_findings[0].evidence.startswith("one of these")
        first_words = "Main causes" if verdict == "unknown" else VERDICT_OPENINGS[verdict]
        if verdict in ("none", "not_repeatable"):
            changed = replace(changed, effects=())
        assert changed.headline().startswith(first_words), verdict
        assert VERDICT_OPENINGS[verdict] in changed.headline()
        assert changed.summary().startswith(changed.headline())
    minor = replace(found.effects[-1], alternatives=(alternative,))
    main = replace(found, verdict="one_of", effects=(*found.effects[:-1], minor))
    assert main.headline().startswith(VERDICT_OPENINGS["named"])  # a minor one alone is ambiguous


def test_causes_stand_by_their_share_and_tables_in_the_order_of_the_ladder(
    found: Diagnosis,
) -> None:
    causes = found.reasons[0]
    assert causes.startswith("Main causes: joint compliance at joint 2 (")
    places = [causes.index(f", {share} %") for share in (60, 20, 12)]
    assert places == sorted(places)
    assert causes.endswith("12 % of the squared error that geometry leaves.")
    assert [row[0] for row in found.effects_table().rows] == IN_WORDS
    assert [row[0] for row in found.parameter_table().rows] == IN_WORDS
    assert [step.name for step in found.ladder[2:]] == [f"+ {name}" for name in LADDER]
    assert [e["effect"] for e in found.to_dict()["effects"]] == [row[0] for row in FOUND]


def test_the_words_are_short_and_have_no_loose_pronoun(found: Diagnosis) -> None:
    assert len(found.reasons) <= 8
    assert all(len(text.split()) < 60 for text in found.reasons)
    for text in found.reasons:
        assert text.split()[0] not in ("It", "They", "Together", "There", "This", "These", "That")
        assert "tell it " not in text


def test_minor_effects_take_one_line(found: Diagnosis) -> None:
    (line,) = [text for text in found.reasons if "minor" in text]
    assert line.startswith("2 minor effects (gear error at joint 5; backlash at joint 4) together")
    assert line.endswith(" take 0.020 mm off the RMS error.")
    many = tuple(replace(found.effects[-1], terms=(Term("backlash", f"J{n}"),))
                 for n in range(1, 7))  # fmt: skip
    (line,) = [
        text for text in replace(found, effects=(*found.effects[:3], *many)).reasons
        if "minor" in text
    ]  # fmt: skip
    assert numbers(line) == [6.0, 0.06]


def test_alternatives_stand_at_their_own_place(found: Diagnosis) -> None:
    """Of two causes of a kind only the second has one; the measurement is for the larger share."""
    others = [
        AlternativeEffect("link_bending", f"L{n}", 0.9, 3.0, 1.0, f"measure {n}") for n in (1, 2)
    ]
    large, small = found.effects[:2]
    second = replace(small, terms=(replace(small.term, effect=large.term.effect),),
                     alternatives=(others[0], replace(others[0], place="L3")))  # fmt: skip
    both = replace(found, effects=(large, second), ladder=found.ladder[:4])
    causes = both.reasons[0]
    assert large.term.effect == second.term.effect
    rivals, rest = causes.partition(others[0].name)[::2]
    whose = re.findall(r"for joint (\d)", f"{others[0].name}{rest}")
    assert whose == ["3", "3"]
    assert others[0].name not in rivals
    both = replace(both, effects=(replace(large, alternatives=(others[1],)), second))
    text = next(text for text in both.reasons if text.startswith("Recommended: "))
    assert large.share > second.share > 0.0
    assert text.startswith("Recommended: measure 2, to know whether ")
    assert " is rather " in text


def test_places_of_one_kind_are_told_in_one() -> None:
    alike, unlike = ("at joint 2", "at joint 1", "at joint 3"), ("at joint 2", "in the base")
    joined = join_places(alike)
    assert (numbers(joined), joined.count("joint")) == ([2.0, 1.0, 3.0], 1)
    assert join_places(unlike).split(", ") == list(unlike)


def test_possible_effects_stand_together_below(found: Diagnosis) -> None:
    unsure = marked(found, established={"gear_ripple": False})
    assert "gear ripple" not in unsure.reasons[0]
    (ripple,) = (f for f in unsure.effects if not f.established)
    assert ripple.name in unsure.reasons[-1]
    assert numbers(unsure.reasons[-1].replace(ripple.name, "")) == [0.05]
    table = unsure.effects_table()
    assert table.header[-1] == "evidence"
    assert (table.rows[-1][0], table.rows[-1][-1]) == (ripple.name, ripple.evidence)


def test_the_remaining_error_is_given_in_its_parts(found):
    assert not build_remaining_error_table(
        replace(found, remaining=None)
    ).rows  # of a file without it
    left = RemainingError((DriverDependence("J3", "its load", 0.2, 0.002),), 0.1, 0.05, REPEATS)
    parts = replace(found, remaining=left)
    text = next(text for text in parts.reasons if text.startswith("Remaining error"))
    assert REPEATS in text
    assert format_remaining_structure(left.depends[0].name) in text
    rms = round(found.ladder[-1].trusted.rms_mm, 3)
    assert numbers(text) == [rms, 0.05, 0.2, 3.0, 0.005, 0.1]
    assert [row[1] for row in build_remaining_error_table(parts).rows] == [0.05, 0.2, 0.1]
    unsure = replace(parts, remaining=replace(parts.remaining, noise_mm=float("nan")))
    assert [row[1] for row in build_remaining_error_table(unsure).rows[1:]] == [0.2, 0.1]
    none = replace(left, depends=(), noise_mm=0.02, noise_from=DISTANCES)
    (text,) = [text for text in replace(found, remaining=none, floor_known=False).reasons
               if text.startswith("Remaining error")]  # fmt: skip
    assert DISTANCES in text
    assert numbers(text) == [rms, 0.02, 0.1]
    assert "repeatability" in text


def test_what_nobody_measured_is_asked_for_first(found):
    """For every verdict, in the first sentence too."""
    for verdict in VERDICTS:
        opened = replace(found, verdict=verdict, floor_known=False)
        assert opened.next == REVISIT_PROPOSAL
        assert opened.reasons[0].endswith(f"; {UNKNOWN_REPEATABILITY_TEXT}.")
        known = replace(opened, floor_known=True)
        assert UNKNOWN_REPEATABILITY_TEXT not in known.headline()
        assert known.next != REVISIT_PROPOSAL
        assert known.next or verdict not in ("unknown", "not_repeatable")


@pytest.mark.parametrize(
    ("driver", "kind"),
    [
        ("its last move and load", "approach"),
        ("its load and angle", "payload"),
        ("time, to and fro", "late"),
        ("temperature", "warm"),
        ("where it is", "instrument"),
        ("two angles together", "more"),
    ],
)
def test_each_kind_of_unknown_has_its_measurement(found, driver, kind):
    sure = replace(found, effects=(), verdict="unknown", structure=0.002)
    told = replace(sure, structure_in=f"J2 following {driver}").next
    assert told.kind == kind
    assert "joint 2" in told.settles
    assert replace(sure, structure_in="anything else").next.kind == "more"


def test_outliers_are_left_out_beside(found: Diagnosis) -> None:
    *before, last = found.ladder
    assert "without" not in found.headline()
    for count, words in ((19, "1 outlier"), (17, "3 outliers")):
        sound = replace(scores(0.11), counts=(count,))
        changed = replace(found, ladder=(*before, replace(last, trusted=sound)))
        assert words in changed.headline()
        assert {0.46, 0.11} <= {*numbers(changed.headline())}


def test_what_does_not_help_is_not_proposed(found: Diagnosis) -> None:
    others = (AlternativeEffect("link_bending", "L2", 0.9, 3.0, 1.0, WIDER),
              AlternativeEffect("base_flex", "frame", 0.9, 3.0, 1.0, "no measurement considered is "
                          "enough: the best raises the power to 2 of the 25 needed"))  # fmt: skip
    first = replace(found.effects[0], alternatives=others)
    changed = replace(found, verdict="one_of", effects=(first, *found.effects[1:]))
    (text,) = [text for text in changed.reasons if text.startswith("Recommended: ")]
    assert WIDER in text
    assert first.name in text
    assert [other.name in text for other in others] == [True, False]
    assert all(other.name in changed.reasons[0] for other in others)
    nothing = replace(changed, effects=(replace(first, alternatives=others[1:]),))
    said = [text for text in nothing.reasons if text.startswith("Recommended: ")]
    assert not said


def test_every_chance_and_power_says_what_is_enough(found: Diagnosis) -> None:
    place = "J3 following its own angle"
    told = replace(found, verdict="unknown", structure=1e-7, structure_in=place)
    assert format_p_value(1e-7) in told.headline()
    assert VERDICT_OPENINGS["unknown"] in told.headline()
    assert replace(told, effects=()).headline().startswith("Unexplained: the error after geometry")
    assert FALSE_NAME_PROBABILITY in numbers(told.effects_table().title)
    assert SUFFICIENT_SEPARATION_POWER in numbers(told.alternative_table().title)
    assert "lambda" not in told.summary()


def test_people_read_millimetres_and_milliradians_with_two_digits_of_sigma(
    found: Diagnosis,
) -> None:
    table = found.parameter_table()
    cells = {row[0]: row[2:] for row in table.formatted_cells()}
    soft, gear = (cells[f"{effect} at joint {n}"] for effect, n in (("joint compliance", 2),
                                                                    ("gear error", 3)))  # fmt: skip
    assert soft == ["0.002", "0.00012", "mrad/(N m)"]
    assert gear == ["0.002", "0.00012", "mrad"]
    assert found.to_dict()["effects"][1]["parameters"][0]["unit"] == "rad"  # SI in the file


# ---- curves --------------------------------------------------------------------------------------


M = 60
SPOTS = np.array([[0.1, 0.0, 0.03], [-0.05, 0.09, 0.03], [-0.05, -0.09, 0.03]])
NAMES = ("smr1", "smr2", "smr3")


def fitted(name: str, place: str, value: list[float], **choice: float) -> Fitted:
    return Fitted((Term(name, place, choice),), (np.array(value),))


def cell_of(robot: mc.Robot, effects: Fitted = NO_EFFECTS) -> mc.Cell:
    base = np.eye(4)
    base[:3, :3], base[:3, 3] = rotation_from_vector(np.array([0.2, -0.1, 1.0])), [3.0, -1.0, 0.5]
    return mc.Cell(robot, base, NAMES, SPOTS, effects)


def left_by(
    effects: Fitted, name: str = "irb2600", told: bool = True, **columns: Array
) -> ResidualViews:
    """What is left of exact measurements of an arm with effects, without them and with."""
    robot, rng = mc.load_robot(name), np.random.default_rng(1)
    order = {"order": np.arange(M)[::-1] + 1.0} if told else {}
    q = random_joint_values_above_floor(robot, M, rng)
    data = mc.measurements(q, rng.normal(size=(M, 3, 3)), **order, **columns)
    data = add_history_columns(replace(data, target_names=NAMES, sliding=robot.prismatic))
    first, last = cell_of(robot), cell_of(robot, effects)
    data = data.with_y(last.follow(data))
    return ResidualViews.from_cells(data, np.arange(M) % 5 == 0, 1e-5, (first, last), effects.terms)


LOOSE = fitted("backlash", "J5", [1e-3])


def test_views_are_geometry_effects_and_all_but_the_first() -> None:
    left = left_by(LOOSE)
    plain, whole, bare = left.errors_by_view
    measured = left.data.y - cell_of(left.scene.robot).predict(left.data.q)
    axes = cell_of(left.scene.robot).base[:3, :3]
    assert_allclose(plain, measured @ axes, rtol=0, atol=1e-12)
    assert_allclose(whole, 0.0, atol=1e-12)
    assert_allclose(bare, plain, rtol=0, atol=1e-12)
    assert_allclose(left.error_distances()[0], 1e3 * np.linalg.norm(measured, axis=-1), atol=1e-9)
    there = left.scene.robot.pose(left.data.q) @ np.append(SPOTS[1], 1.0)
    assert_allclose(
        left.measured_points[:, 1] - left.errors_by_view[0][:, 1], there[:, :3], rtol=0, atol=1e-12
    )
    alone = left_by(NO_EFFECTS)
    assert len(alone.errors_by_view) == 1
    assert alone.errors_without_first_effect is None
    assert alone.term is None


def test_an_effect_is_taken_out_with_all_its_lines() -> None:
    ripple = [Term("gear_ripple", "J3", {"turns": t}) for t in (121.0, 242.0)]
    both = Fitted((*ripple, *LOOSE.terms), (np.ones(2), 2.0 * np.ones(2), np.ones(1)))
    assert drop_effect(both, ripple[1]).terms == LOOSE.terms
    assert drop_effect(both, LOOSE.terms[0]).terms == tuple(ripple)
    assert [v.tolist() for v in drop_effect(both, LOOSE.terms[0]).values] == [[1, 1], [2, 2]]


def test_play_is_a_turn_of_its_joint_by_the_side_it_came_from() -> None:
    left = left_by(LOOSE)
    curve = build_residual_curve(left)
    came = np.zeros(M)
    came[:-1] = left.data.q[:-1, 4] - left.data.q[1:, 4]  # the last row is visited first
    assert_allclose(curve.x, np.degrees(came), rtol=0, atol=1e-9)
    assert curve.xlabel.endswith("(deg)")
    assert curve.ylabel.endswith("(mrad)")
    assert format_effect("backlash", "J5") in curve.title
    plain, whole, bare = curve.y
    assert_array_equal(np.sign(plain[:-1]), np.sign(came[:-1]))
    assert 0.2 < np.abs(plain[:-1]).max() < 0.6  # half of a milliradian, less the ridge
    assert_allclose(whole, 0.0, atol=1e-9)
    assert_allclose(bare, plain, rtol=1e-9)


def static_torque(left: ResidualViews, joint: int) -> Array:
    return np.asarray(left.scene.gravity[joint])


def test_torques_of_masses_that_were_told_do_not_say_that_they_are_assumed() -> None:
    scene = left_by(NO_EFFECTS).scene
    mass, com = link_masses_and_centres(scene.robot)
    told = replace(scene, robot=replace(scene.robot, mass=mass, com=com))
    measured = {f"tau{j + 1}": np.arange(M) for j in range(scene.joints)}
    felt = replace(scene, data=replace(scene.data, columns={**scene.data.columns, **measured}))
    for one in (told, felt):
        label = curve_axes.gravity_torque_axis(one, 1, {})[0]
        assert label.endswith("(N m)")
        assert "assumed" not in label
    assert "assumed" in curve_axes.gravity_torque_axis(scene, 1, {})[0]


def wave(left: ResidualViews, joint: int) -> Array:
    return np.asarray(np.degrees(left.data.q[:, joint]) % (360.0 / 121.0))


def degrees(left: ResidualViews, joint: int) -> Array:
    return np.degrees(left.data.q[:, joint])


@pytest.mark.parametrize(
    ("effects", "law", "joint", "label"),
    [
        (fitted("link_bending", "L2", [1e-6]), static_torque, 1,
         "static torque of joint 2, masses assumed (N m)"),
        (fitted("base_flex", "frame", [5e-7]), static_torque, 1,
         "static torque of joint 2, masses assumed (N m)"),
        (fitted("gear_ripple", "J3", [2e-4, 1e-4], turns=121.0), wave, 2,
         "joint 3 within a wave of 2.98° (deg)"),
        (fitted("encoder_gain", "J4", [1e-3]), degrees, 3, "joint 4 (deg)"),
        (fitted("joint_coupling", "J5", [1e-3], source=4.0), degrees, 3, "joint 4 (deg)"),
        (NO_EFFECTS, degrees, 0, "joint 1 (deg)"),
    ],
    ids=lambda part: part.terms[0].effect if isinstance(part, Fitted) and part.terms else "",
)  # fmt: skip
def test_a_curve_is_drawn_against_what_its_law_looks_at(
    effects: Fitted, law: object, joint: int, label: str
) -> None:
    left = left_by(effects)
    curve = build_residual_curve(left)
    assert curve.xlabel == label
    wanted = law(left, joint)  # type: ignore[operator]
    assert_allclose(np.abs(curve.x), np.abs(wanted), rtol=1e-9, atol=1e-9)
    assert len(curve.y) == (3 if effects.terms else 1)
    if effects.terms and effects.terms[0].effect in ("encoder_gain", "joint_coupling"):
        shown = equivalent_joint_rotations(left)[-1][
            :, select_shown_joint(left, equivalent_joint_rotations(left))
        ]
        assert_allclose(curve.y[-1], 1e3 * (shown - shown.mean()), rtol=0, atol=1e-12)
        assert abs(curve.y[0].mean()) > 1e-3  # a constant turn, which geometry takes


def test_time_and_heat_are_drawn_along_their_motion() -> None:
    heat = np.linspace(20.0, 30.0, M)
    warm = left_by(fitted("thermal_growth", "all", [3e-4], temperature=1.0, apart=0.0),
                   temperature=heat)  # fmt: skip
    curve = build_residual_curve(warm)
    assert curve.xlabel == "temperature (°C)"
    assert_array_equal(curve.x, np.broadcast_to(heat, (3, M)))
    assert curve.ylabel.endswith("(mm)")
    assert_allclose(np.abs(curve.y[0]), warm.error_distances()[0].T, rtol=0, atol=1e-6)
    jump = left_by(fitted("session_jump", "frame", [1e-3, 0, 0, 0, 0, 0], since=0.5))
    curve = build_residual_curve(jump)
    assert format_effect("session_jump", "frame") in curve.title
    assert_allclose(curve.x[0], np.linspace(1.0, 0.0, M), rtol=0, atol=1e-12)
    assert_allclose(curve.y[0], 1.0 * (curve.x >= 0.5), rtol=0, atol=1e-9)
    shift = left_by(fitted("target_shift", "smr2", [0.0, 2e-3, 0.0], since=0.5))
    curve = build_residual_curve(shift)
    assert format_effect("target_shift", "smr2") in curve.title
    assert curve.y[0].shape == curve.x.shape == (1, M)
    assert_allclose(curve.y[0], 2.0 * (curve.x >= 0.5), rtol=0, atol=1e-9)


def test_an_offset_is_drawn_along_the_line_of_sight() -> None:
    left = left_by(fitted("target_offset", "all", [1e-3]))
    curve = build_residual_curve(left)
    away = np.linalg.norm(left.data.y, axis=-1).T  # the instrument is the origin
    assert_allclose(curve.x, away, rtol=1e-12)
    assert_allclose(curve.y[0], 1.0, rtol=0, atol=1e-9)
    assert curve.xlabel.endswith("(m)")


def test_a_slide_is_shown_in_millimetres() -> None:
    left = left_by(NO_EFFECTS, "scara_600")
    label, x = joint_value_axis(left.scene, 2, {})
    assert label.endswith("(mm)")
    assert_allclose(x, 1e3 * left.data.q[:, 2], rtol=1e-14)


@pytest.mark.parametrize("told", [True, False])
def test_errors_in_the_order_of_the_visits(told: bool) -> None:
    left = left_by(LOOSE, told=told)
    curve = build_visit_order_curve(left)
    rms = np.sqrt(np.mean(left.error_distances()[0] ** 2, axis=1))
    assert_allclose(curve.y[0], rms, rtol=1e-12)
    if told:
        assert_array_equal(curve.x, np.arange(M)[::-1] + 1.0)
    assert ("visit" in curve.xlabel) == told
    some = replace(left, errors=tuple(np.where(np.arange(3)[:, None] == 1, np.nan, e)
                                      for e in left.errors))  # fmt: skip
    rms = np.sqrt(np.mean(left.error_distances()[0][:, [0, 2]] ** 2, axis=1))
    assert_allclose(build_visit_order_curve(some).y[0], rms, rtol=1e-12)


def test_a_curve_names_its_views() -> None:
    curve = ResidualCurve(
        "t", "x (m)", "y (mm)", np.arange(2.0), (np.ones(2), np.array([np.nan, 2.0]))
    )
    told = curve.to_dict()
    assert told["x"] == {"label": "x (m)", "values": [0.0, 1.0]}
    assert told["views"] == [
        {"name": "geometry alone", "values": [1.0, 1.0]},
        {"name": "with effects", "values": [None, 2.0]},
    ]


def test_joint_equivalent_is_the_turn():
    scene = left_by(NO_EFFECTS).scene
    turn = 1e-3 * np.random.default_rng(0).normal(size=(scene.poses, scene.joints))
    error = np.einsum("nkcm,mn->mkc", scene.jacobian, turn)
    off = np.abs(fit_equivalent_rotations(error, scene.jacobian, 1e-7) - turn)
    assert np.median(off) < 1e-5  # large only where the wrist or the arm is stretched
    assert np.quantile(off[:, :3], 0.9) < 1e-4
