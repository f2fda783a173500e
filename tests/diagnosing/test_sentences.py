"""A diagnosis in words: short, the verdict first, in the order of the ladder."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

import minimax_cal as mc
from minimax_cal.diagnosing.proposals import REVISIT
from minimax_cal.diagnosing.result import (
    VERDICTS,
    Alternative,
    Dependence,
    Diagnosis,
    Finding,
    Remaining,
    Step,
)
from minimax_cal.diagnosing.sentences import NOT_VISITED, OPENINGS
from minimax_cal.fitting.accuracy import Accuracy
from minimax_cal.fitting.beyond import Beyond
from minimax_cal.fitting.floor import AT_MOST, DISTANCES, REPEATS, Floor
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.effects.words import name_step
from minimax_cal.modelling.simulate import simulate
from minimax_cal.reporting.tables import remaining_table

FOUND = (  # effect, place, share, held-out RMS before and after [mm]; by share, as in the file
    ("joint_compliance", "J2", 0.60, 0.5, 0.3),
    ("gear_error", "J3", 0.20, 0.8, 0.5),
    ("gear_ripple", "J1", 0.12, 0.3, 0.25),
    ("gear_error", "J5", 0.02, 0.25, 0.24),
    ("backlash", "J4", 0.01, 0.24, 0.23),
)
LADDER = ("gear_error J3", "joint_compliance J2", "gear_ripple J1", "gear_error J5", "backlash J4")
IN_WORDS = [name_step(f"+ {name}").removeprefix("+ ") for name in LADDER]
WIDER = "measure 20 more poses all over the workspace"


def scores(rms: float) -> Accuracy:
    return Accuracy(rms, 2.0 * rms, 0.9 * rms, 20, (20.0 * rms**2,), (20,))


def step(name: str, rms: float) -> Step:
    return Step(name, scores(rms), scores(rms), scores(rms))


def finding(effect: str, place: str, share: float, before: float, after: float) -> Finding:
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
        bare, verdict="named", effects=tuple(finding(*row) for row in FOUND), closed=0.95,
        closed_ci=(0.9, 0.97), ladder=(step("nominal", 2.0), step("geometric", 0.8), *rungs),
        floor=Floor(0.03, 0.0, 0.03, AT_MOST), beyond=Beyond(), floor_known=True,
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
    assert set(OPENINGS) == set(VERDICTS)
    alternative = Alternative("link_bending", "L2", 0.9, 3.0, 1.0)
    first = replace(found.effects[0], alternatives=(alternative,))
    for verdict in VERDICTS:
        changed = replace(found, verdict=verdict)
        if verdict == "one_of":
            changed = replace(changed, effects=(first, *found.effects[1:]))
            assert "one of them is confirmed" in changed.headline()  # not the one that is named
            assert changed.main[0].evidence.startswith("one of these")
        first_words = "Main causes" if verdict == "unknown" else OPENINGS[verdict]
        if verdict in ("none", "not_repeatable"):
            changed = replace(changed, effects=())
        assert changed.headline().startswith(first_words), verdict
        assert OPENINGS[verdict] in changed.headline()
        assert changed.summary().startswith(changed.headline())
    minor = replace(found.effects[-1], alternatives=(alternative,))
    main = replace(found, verdict="one_of", effects=(*found.effects[:-1], minor))
    assert main.headline().startswith(OPENINGS["named"])  # a minor one alone is ambiguous


def test_causes_stand_by_their_share_and_tables_in_the_order_of_the_ladder(
    found: Diagnosis,
) -> None:
    causes = found.reasons[0]
    assert causes.startswith("Main causes: joint compliance at joint 2 (")
    places = [causes.index(f", {share} %") for share in (60, 20, 12)]
    assert places == sorted(places)
    assert causes.endswith("12 % of the squared error above noise.")
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
    assert line == "6 minor effects together take 0.060 mm off the RMS error."


def test_alternatives_stand_at_their_own_place(found: Diagnosis) -> None:
    """Of two causes of a kind only the second has one; the measurement is for the larger share."""
    others = [Alternative("link_bending", f"L{n}", 0.9, 3.0, 1.0, f"measure {n}") for n in (1, 2)]
    large, small = found.effects[:2]
    second = replace(small, terms=(replace(small.term, effect=large.term.effect),),
                     alternatives=(others[0], replace(others[0], place="L3")))  # fmt: skip
    both = replace(found, effects=(large, second), ladder=found.ladder[:4])
    causes = both.reasons[0]
    assert "joint compliance at joint 2 and 3" in causes
    assert (
        ", or link bending at link 1 (for joint 3) or link bending at link 3 (for joint" in causes
    )
    assert "(for joint 2)" not in causes
    both = replace(both, effects=(replace(large, alternatives=(others[1],)), second))
    text = next(text for text in both.reasons if text.startswith("Recommended: "))
    assert large.share > second.share > 0.0
    assert text.startswith("Recommended: measure 2, to know whether it is")


def test_possible_effects_stand_together_below(found: Diagnosis) -> None:
    unsure = marked(found, established={"gear_ripple": False})
    assert "gear ripple" not in unsure.reasons[0]
    assert unsure.reasons[-1] == (
        "Possible causes, not confirmed: gear ripple at joint 1; 0.050 mm off the RMS error."
    )
    table = unsure.effects_table()
    assert table.header[-1] == "evidence"
    assert [(row[0], row[-1]) for row in table.rows][-1] == (
        "gear ripple at joint 1", "possible, 0.00")  # fmt: skip


def test_the_remaining_error_is_given_in_its_parts(found):
    assert not remaining_table(replace(found, remaining=None)).rows  # of a file without it
    left = Remaining((Dependence("J3", "its load", 0.2, 0.002),), 0.1, 0.05, REPEATS)
    parts = replace(found, remaining=left)
    text = next(text for text in parts.reasons if text.startswith("Remaining error"))
    assert "0.050 mm is measurement noise (repeated poses), 0.200 mm is a motion of" in text
    assert text.endswith("joint 3 that depends on its load (p < 0.005), 0.100 mm is unexplained.")
    assert [row[1] for row in remaining_table(parts).rows] == [0.05, 0.2, 0.1]
    unsure = replace(parts, remaining=replace(parts.remaining, noise_mm=float("nan")))
    assert remaining_table(unsure).rows[0][0] == "noise, not known"
    none = replace(left, depends=(), noise_mm=0.02, noise_from=DISTANCES)
    (text,) = [text for text in replace(found, remaining=none, floor_known=False).reasons
               if text.startswith("Remaining error")]  # fmt: skip
    assert "0.020 mm is the instrument's noise (distances between the targets)" in text
    assert text.endswith("no dependence was found, 0.100 mm may be the arm's repeatability.")


def test_what_nobody_measured_is_asked_for_first(found):
    """For every verdict, in the first sentence too."""
    for verdict in VERDICTS:
        opened = replace(found, verdict=verdict, floor_known=False)
        assert opened.next == REVISIT
        assert opened.reasons[0].endswith(f"; {NOT_VISITED}.")
        known = replace(opened, floor_known=True)
        assert NOT_VISITED not in known.headline()
        assert known.next != REVISIT
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
        assert f"(largest 0.460 mm; 0.110 mm without {words})" in changed.headline()


def test_what_does_not_help_is_not_proposed(found: Diagnosis) -> None:
    others = (Alternative("link_bending", "L2", 0.9, 3.0, 1.0, WIDER),
              Alternative("base_flex", "frame", 0.9, 3.0, 1.0, "no measurement considered is "
                          "enough: the best raises the power to 2 of the 25 needed"))  # fmt: skip
    first = replace(found.effects[0], alternatives=others)
    changed = replace(found, verdict="one_of", effects=(first, *found.effects[1:]))
    (text,) = [text for text in changed.reasons if text.startswith("Recommended: ")]
    assert text == (
        f"Recommended: {WIDER}, to know whether it is joint compliance at joint 2 or link bending "
        "at link 2."
    )
    assert "or base flex or link bending at link 2" in changed.reasons[0]
    nothing = replace(changed, effects=(replace(first, alternatives=others[1:]),))
    said = [text for text in nothing.reasons if text.startswith("Recommended: ")]
    assert not said


def test_every_chance_and_power_says_what_is_enough(found: Diagnosis) -> None:
    place = "J3 following its own angle"
    told = replace(found, verdict="unknown", structure=1e-7, structure_in=place)
    assert "p < 0.005" in told.headline()
    assert "Unexplained: the error after all effects is not random" in told.headline()
    assert replace(told, effects=()).headline().startswith("Unexplained: the error after geometry")
    assert "below 0.005 are significant" in told.effects_table().title
    assert "the power is below 25" in told.rival_table().title
    assert "lambda" not in told.summary()


def test_people_read_millimetres_and_milliradians_with_two_digits_of_sigma(
    found: Diagnosis,
) -> None:
    table = found.parameter_table()
    cells = {row[0]: row[2:] for row in table.cells()}
    assert cells["joint compliance at joint 2"] == ["0.002", "0.00012", "mrad/(N m)"]
    assert cells["gear error at joint 3"] == ["0.002", "0.00012", "mrad"]
    assert found.to_dict()["effects"][1]["parameters"][0]["unit"] == "rad"  # SI in the file
