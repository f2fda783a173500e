"""Names that are a best guess: waves that nobody told, and effects that change with the poses."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_fit import study_of

from experiments.gap_cases import Case, Cause, make
from minimax_cal.diagnosing import causes as module
from minimax_cal.diagnosing.causes import Causes, believed, causes_of, found_again, lone
from minimax_cal.diagnosing.diagnose import with_maps
from minimax_cal.diagnosing.established import Again
from minimax_cal.diagnosing.study import Study
from minimax_cal.evidence.selection import select
from minimax_cal.evidence.stability import predicted
from minimax_cal.fitting.options import silent
from minimax_cal.modelling.dictionary import ArmLaws

RIPPLE = Cause("gear_ripple", "J2", 2000.0)


@pytest.fixture(scope="module")
def ripple() -> tuple[Study, Causes]:
    """Of an arm whose gears nobody told."""
    made = make(Case("irb2600", "single", (RIPPLE,), seed=3))
    untold = replace(made, robot=replace(made.robot, ratio=np.full(6, np.nan)))
    return causes_of(study_of(untold), (), (), silent)


def test_a_line_by_itself_is_taken_where_nothing_else_is_left(
    ripple: tuple[Study, Causes],
) -> None:
    made, causes = ripple
    (one,) = causes.effects
    assert one.term.key == ("gear_ripple", "J2")
    assert not causes.wary
    assert lone(one.terms, one.terms, made.scene)
    assert [t.key for t in with_maps(made, causes, silent)[1].last.terms] == [one.term.key]


def test_a_line_by_itself_is_not_taken_where_something_unknown_is_left(
    ripple: tuple[Study, Causes],
) -> None:
    made, causes = ripple
    wary = replace(causes, wary=True)
    spoken, ladder = with_maps(made, wary, silent)
    assert spoken.effects == ladder.last.terms == ()
    one = causes.effects[0].term
    pair = (one, replace(one, choice={"turns": 2.0 * one.choice["turns"]}))
    assert not lone(pair, pair, made.scene)
    play = (replace(one, effect="backlash", choice={}),)
    assert not lone(play, play, made.scene)


@pytest.mark.parametrize(("again", "wary"), [(1.0, False), (0.6, True), (np.nan, False)])
def test_names_that_change_with_the_poses_are_a_best_guess(
    ripple: tuple[Study, Causes], again: float, wary: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As structure that is left; poses that are too few to leave any out say nothing of it."""
    made, causes = ripple
    asked = Again(tuple(replace(found, again=again) for found in causes.effects), 0.5)
    monkeypatch.setattr(module, "judged_again", lambda *_: asked)
    assert found_again(made, causes).wary == wary


@pytest.mark.parametrize(
    ("wary", "met", "held"),
    [(True, 1.1, 0), (True, 0.5, 2), (False, 1.1, 2), (True, np.nan, 2)],
)
def test_a_best_guess_must_help_fifths_that_it_was_sought_without(
    ripple: tuple[Study, Causes], wary: bool, met: float, held: int
) -> None:
    (one,) = ripple[1].effects
    pair = [replace(one, terms=(replace(one.term, place=place),)) for place in ("J1", "J2")]
    both = replace(ripple[1], effects=tuple(pair), wary=wary, met=met)
    assert len(believed(both, ripple[0].scene)) == held


def test_what_is_sought_anew_meets_its_fifth(ripple: tuple[Study, Causes]) -> None:
    """By least squares on the other poses, told here in another way."""
    made, causes = ripple
    part = np.arange(made.data.poses) % 5 == 0
    library = causes.choice.part(made.rows.at(~part))
    choice = select(library)
    assert [c.key for c in choice.chosen] == [("gear_ripple", "J2")]
    rows = library.rows
    mine = np.repeat(part, len(rows.error) // made.data.poses)
    root = np.sqrt(choice.noise.weights(rows))[:, None]
    wide = np.concatenate([rows.basis, choice.known], axis=1)
    back = np.linalg.pinv((wide * root)[~mine])
    leverage = (((wide * root)[mine] @ back) ** 2).sum(axis=1)
    expected = []
    for columns in (rows.basis, wide):
        fit = np.linalg.lstsq((columns * root)[~mine], (rows.error * root[:, 0])[~mine])[0]
        left = (rows.error - columns @ fit)[mine]
        expected.append(float((left**2 / (1.0 + leverage)).sum()))
    assert_allclose(predicted(choice), expected, rtol=1e-6)
    assert causes.met < 0.5


def test_rows_that_others_do_not_tell_are_no_test(
    ripple: tuple[Study, Causes], rng: np.random.Generator
) -> None:
    """An error of theirs alone, however large, is not laid at the door of what was named."""
    made, causes = ripple
    part = np.arange(made.data.poses) % 5 == 0
    choice = select(causes.choice.part(made.rows.at(~part)))
    rows = choice.library.rows
    mine = np.repeat(part, len(rows.error) // made.data.poses)
    known = np.concatenate([rows.basis, choice.known, rows.error[:, None]], axis=1)
    weight = choice.noise.weights(rows)[~mine, None] ** 0.5
    faint = rng.normal(size=(~mine).sum())[:, None] * weight
    faint -= known[~mine] * weight @ np.linalg.lstsq(known[~mine] * weight, faint)[0]
    alone = np.zeros(len(mine))
    alone[np.flatnonzero(mine)[:3]] = 1.0
    shown = alone.copy()  # by the other rows, too, but each ten thousand times less
    shown[~mine] = 1e-4 * (faint / weight)[:, 0]
    basis = np.concatenate([rows.basis, shown[:, None]], axis=1)
    for off, kept in ((0.0, True), (0.01, True), (1.0, False)):  # [m], and in sigmas 500, 50,000
        spoilt = replace(rows, error=rows.error + off * alone, basis=basis)
        laws = ArmLaws(made.scene, spoilt)
        after = predicted(replace(choice, library=replace(choice.library, dictionary=laws)))
        assert np.allclose(after, predicted(choice), rtol=0.06) == kept
