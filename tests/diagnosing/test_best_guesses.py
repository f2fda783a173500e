"""Names that are a best guess: waves that nobody told, and effects that change with the poses."""

from dataclasses import replace

import numpy as np
import pytest
from problems_fit import study_of

from experiments.gap_cases import Case, Cause, make
from minimax_cal.diagnosing import causes as module
from minimax_cal.diagnosing.causes import Causes, causes_of, found_again, lone
from minimax_cal.diagnosing.diagnose import with_maps
from minimax_cal.diagnosing.study import Study
from minimax_cal.fitting.options import silent

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
    asked = tuple(replace(found, again=again) for found in causes.effects)
    monkeypatch.setattr(module, "judged_again", lambda *_: asked)
    assert found_again(made, causes).wary == wary
