"""A diagnosis in words: short, the verdict first, in the order of the ladder."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

import minimax_cal as mc
from minimax_cal.diagnosing.remainder import Remainder
from minimax_cal.diagnosing.result import VERDICTS, Alternative, Diagnosis, Finding, Step
from minimax_cal.diagnosing.sentences import REVISIT
from minimax_cal.diagnosing.sentences import VERDICTS as OPENINGS
from minimax_cal.fitting.beyond import Beyond
from minimax_cal.measuring.accuracy import Accuracy
from minimax_cal.measuring.floor import AT_MOST, Floor
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.simulate import simulate
from minimax_cal.reporting.tables import remainder_table

FOUND = (  # effect, place, share, held-out RMS before and after [mm]; by share, as in the file
    ("joint_compliance", "J2", 0.60, 0.5, 0.3),
    ("gear_error", "J3", 0.20, 0.8, 0.5),
    ("gear_ripple", "J1", 0.12, 0.3, 0.25),
    ("gear_error", "J5", 0.02, 0.25, 0.24),
    ("backlash", "J4", 0.01, 0.24, 0.23),
)
LADDER = ("gear_error J3", "joint_compliance J2", "gear_ripple J1", "gear_error J5", "backlash J4")
WIDER = "measure 20 more poses all over the workspace"


def scores(rms: float) -> Accuracy:
    return Accuracy(rms, 2.0 * rms, 0.9 * rms, 20, (20.0 * rms**2,), (20,))


def step(name: str, rms: float) -> Step:
    return Step(name, scores(rms), scores(rms), scores(rms))


def finding(effect: str, place: str, share: float, before: float, after: float) -> Finding:
    unit = "rad/(N m)" if effect == "joint_compliance" else "rad"
    return Finding((Term(effect, place),), ("c",), (unit,), (2e-6,), (1.23456e-7,), 100.0, 1e-9,
                   share=share, before=before, after=after)  # fmt: skip


@pytest.fixture(scope="module")
def bare() -> Diagnosis:
    robot = mc.load_robot("irb2600")
    return mc.diagnose(robot, simulate(robot, 60, 1, seed=1).data, quick=True)


@pytest.fixture
def found(bare: Diagnosis) -> Diagnosis:
    after = {f"{effect} {place}": rms for effect, place, _, _, rms in FOUND}
    rungs = [step(f"+ {name}", after[name]) for name in LADDER]
    return replace(
        bare, verdict="named", findings=tuple(finding(*row) for row in FOUND), closed=0.95,
        closed_ci=(0.9, 0.97), ladder=(step("nominal", 2.0), step("geometric", 0.8), *rungs),
        floor=Floor(0.03, 0.0, 0.03, AT_MOST), beyond=Beyond(),
    )  # fmt: skip


def marked(found: Diagnosis, **more: Any) -> Diagnosis:
    """With what the evidence says besides: whether effects are established, what remains."""
    for name, value in more.pop("established", {}).items():
        one = next(f for f in found.findings if f.term.effect == name)
        object.__setattr__(one, "again", float(value))
    for name, value in more.items():
        object.__setattr__(found, name, value)
    return found


def test_every_verdict_opens_the_words(found: Diagnosis) -> None:
    assert set(OPENINGS) == set(VERDICTS)
    for verdict in VERDICTS:
        told = replace(found, verdict=verdict)
        assert told.headline().startswith(f"Verdict: {verdict.split('_')[0]}"), verdict
        assert told.summary().startswith(told.headline())


def test_words_and_tables_stand_in_the_order_of_the_ladder(found: Diagnosis) -> None:
    causes = next(text for text in found.reasons if text.startswith("Cause"))
    order = [name.split()[0] for name in LADDER[:3]]
    places = [causes.index(name) for name in order]
    assert places == sorted(places)
    assert [row[0] for row in found.effects_table().rows] == list(LADDER)
    assert [row[0] for row in found.parameter_table().rows] == [n.split()[0] for n in LADDER]
    assert [step.name for step in found.ladder[2:]] == [f"+ {name}" for name in LADDER]
    assert [e["effect"] for e in found.to_dict()["effects"]] == [row[0] for row in FOUND]


def test_the_words_are_short_and_have_no_loose_pronoun(found: Diagnosis) -> None:
    assert len(found.reasons) <= 8
    assert all(len(text.split()) < 60 for text in found.reasons)
    for text in found.reasons:
        assert text.split()[0] not in ("It", "They", "Together", "There", "This", "These", "That")
        assert "tell it " not in text
    small = next(text for text in found.reasons if text.startswith("Small"))
    assert "gear_error at joint 5" in small
    assert "backlash at joint 4" in small


def test_a_single_cause_is_one(found: Diagnosis) -> None:
    alone = replace(found, findings=found.findings[:1], ladder=found.ladder[:3])
    assert "Cause: joint_compliance at joint 2 (" in alone.headline()
    assert "Causes" not in alone.headline()
    assert "Small" not in alone.headline()


def test_rivals_stand_at_their_own_place(found: Diagnosis) -> None:
    """Of two causes of a kind only the second has one; the measurement is for the larger share."""
    rivals = [Alternative("link_bending", f"L{n}", 0.9, 3.0, 1.0, f"measure {n}") for n in (1, 2)]
    large, small = found.findings[:2]
    second = replace(small, terms=(replace(small.term, effect=large.term.effect),),
                     alternatives=(rivals[0], replace(rivals[0], place="L3")))  # fmt: skip
    told = replace(found, findings=(large, second), ladder=found.ladder[:4])
    causes = next(text for text in told.reasons if text.startswith("Cause"))
    assert "joint_compliance at joint 3 and 2" in causes
    assert f", {second.at} or else link_bending at link 1 or link_bending at link 3" in causes
    assert f"{large.at} or else" not in causes
    both = replace(told, findings=(replace(large, alternatives=(rivals[1],)), second))
    text = next(text for text in both.reasons if text.startswith("Next measurement"))
    assert large.share > second.share > 0.0
    assert text.startswith("Next measurement: measure 2, to tell")


def test_tentative_effects_stand_together_below(found: Diagnosis) -> None:
    told = marked(found, established={"gear_ripple": False})
    causes = next(text for text in told.reasons if text.startswith("Cause"))
    assert "gear_ripple" not in causes
    assert told.reasons[-1] == "Tentative, and no cause yet: gear_ripple at joint 1."
    table = told.effects_table()
    assert table.header[-1] == "evidence"
    assert [(row[0], row[-1]) for row in table.rows][-1] == ("gear_ripple J1", "tentative, 0.00")


def test_what_remains_is_told_in_its_parts(found: Diagnosis) -> None:
    assert not remainder_table(replace(found, remainder=None)).rows  # of a file that tells none
    left = Remainder(0.2, (("J3", 0.6),), 0.05, (0.02, 0.03))
    told = replace(found, remainder=left)
    text = next(text for text in told.reasons if text.startswith("Of what remains"))
    assert "0.200 mm follow the pose (at joint 3 60 %), 0.050 mm follow nothing known" in text
    assert [row[1] for row in remainder_table(told).rows if not math.isnan(float(row[1]))] == [
        0.2, 0.05, 0.02, 0.03
    ]  # fmt: skip
    told = replace(found, remainder=replace(left, predictable_mm=0.0))
    nothing = "Nothing tells poses left out what remains;"
    assert any(text.startswith(nothing) for text in told.reasons)
    told = replace(found, remainder=None)
    assert not any(text.startswith("Of what remains") for text in told.reasons)


def test_what_stands_out_is_left_out_beside(found: Diagnosis) -> None:
    *before, last = found.ladder
    assert "without" not in found.headline()
    for count, words in ((19, "the point that stands out"), (17, "3 points that stand out")):
        sound = replace(scores(0.11), counts=(count,))
        told = replace(found, ladder=(*before, replace(last, trusted=sound)))
        assert f"(largest 0.460 mm; 0.110 mm without {words})" in told.headline()


def test_what_does_not_help_is_not_proposed(found: Diagnosis) -> None:
    rivals = (Alternative("link_bending", "L2", 0.9, 3.0, 1.0, WIDER),
              Alternative("base_flex", "frame", 0.9, 3.0, 1.0, "no measurement considered is "
                          "enough: the best raises the power to 2 of the 25 needed"))  # fmt: skip
    first = replace(found.findings[0], alternatives=rivals)
    told = replace(found, verdict="one_of", findings=(first, *found.findings[1:]))
    (text,) = [text for text in told.reasons if text.startswith("Next measurement")]
    assert text == (
        f"Next measurement: {WIDER}, to tell joint_compliance at joint 2 from link_bending at "
        "link 2."
    )
    causes = next(text for text in told.reasons if text.startswith("Cause"))
    assert "or else base_flex at frame or link_bending at link 2" in causes
    nothing = replace(told, findings=(replace(first, alternatives=rivals[1:]),))
    said = [text for text in nothing.reasons if text.startswith("Next measurement")]
    assert said == [REVISIT]  # the noise is not known here


def test_every_chance_and_power_says_what_is_enough(found: Diagnosis) -> None:
    told = replace(found, verdict="unknown", structure=1e-7, structure_in="J3 with its own angle")
    assert "by chance 1e-07, below 0.005 is no accident" in told.headline()
    assert told.headline().startswith("Verdict: unknown beside gear_error at joint 3, joint_")
    assert replace(told, findings=()).headline().startswith("Verdict: unknown. What geometry")
    assert "0.005 is rare enough" in told.effects_table().title
    assert "less than the power 25 tells apart" in told.rival_table().title
    assert " p = " not in told.headline()
    assert "lambda" not in told.summary()
    from minimax_cal.reporting.tables import where_tables

    for table in where_tables(found.where):
        assert "p" not in table.header
        assert ("by chance" in table.header) == ("rare enough" in table.title)


def test_people_read_millimetres_and_milliradians_with_two_digits_of_sigma(
    found: Diagnosis,
) -> None:
    table = found.parameter_table()
    cells = {tuple(row[:2]): row[3:] for row in table.cells()}
    assert cells["joint_compliance", "J2"] == ["0.002", "0.00012", "mrad/(N m)"]
    assert cells["gear_error", "J3"] == ["0.002", "0.00012", "mrad"]
    assert found.to_dict()["effects"][1]["parameters"][0]["unit"] == "rad"  # SI in the file
