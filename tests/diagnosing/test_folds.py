"""Parts that are left out judge models that were sought without them, and no others."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal, assert_equal
from problems_fit import study_of
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments.gap_cases import Case, Cause, make
from minimax_cal.diagnosing import folds
from minimax_cal.diagnosing.causes import Causes, causes_of
from minimax_cal.diagnosing.folds import beyond_of, fold_of
from minimax_cal.diagnosing.gap import Judges
from minimax_cal.diagnosing.study import SUM, Study, studied
from minimax_cal.fitting.accuracy import accuracy
from minimax_cal.fitting.options import silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.fitting.stations import stationed
from minimax_cal.ground import parallel
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import parts
from minimax_cal.measuring.history import with_history
from minimax_cal.modelling.parameters import State

ALONE = SimpleNamespace(jobs=1, cluster="")  # causes that no fold looks at


@pytest.fixture(scope="module")
def play() -> Study:
    return study_of(make(Case("irb2600", "single", (Cause("backlash", "J2", 1000.0),), seed=1)))


@pytest.fixture(scope="module")
def judges(play: Study) -> Judges:
    """The poses of the fit, and as many others."""
    held = replace(play.data, q=play.data.q + 0.02, line=play.data.line + 1000)
    held = held.take(np.arange(0, held.poses, 4))
    return Judges(play.data, held, np.zeros((len(held.target_names), held.poses), dtype=bool))


def test_every_part_is_left_out_and_judges(
    play: Study, judges: Judges, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Array, State]] = []
    told: list[str] = []
    cells = [play.geometric, play.nominal]

    def fold(study: Study, causes: Any, rows: Array, state: State) -> Any:
        asked.append((rows, state))
        return SimpleNamespace(fits=[SimpleNamespace(cell=cell) for cell in reversed(cells)])

    monkeypatch.setattr(folds, "fold_of", fold)
    found = beyond_of(play, ALONE, judges, told.append)  # type: ignore[arg-type]
    every = judges.everyone
    left_out = parts(every)
    assert [one.where for one in found.folds] == [part.name for part in left_out]
    assert told == [f"part {i} of {len(left_out)} held out: {part.name}"
                    for i, part in enumerate(left_out, 1)]  # fmt: skip
    for one, part, (rows, state) in zip(found.folds, left_out, asked, strict=True):
        here = every.take(part.rows)
        assert_array_equal(rows, ~np.isin(play.data.line, here.line))
        assert one.rms_mm == accuracy(cells[0].error(here)).rms_mm
        assert one.geometric_mm == accuracy(cells[1].error(here)).rms_mm
        squares = [np.nansum(play.model.error(s)[:, rows] ** 2) for s in (state, play.fit.state)]
        assert squares[0] < squares[1]  # the fit of the others alone


def test_a_part_that_the_fit_needs_judges_nothing(
    play: Study, judges: Judges, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = folds.without

    def some(*given: Any) -> list[State | None]:
        return [None, *plain(*given)[1:]]

    def fold(*given: Any) -> Any:
        return SimpleNamespace(fits=[SimpleNamespace(cell=play.geometric)])

    monkeypatch.setattr(folds, "fold_of", fold)
    monkeypatch.setattr(folds, "without", some)
    found = beyond_of(play, ALONE, judges, silent)  # type: ignore[arg-type]
    assert [one.where for one in found.folds] == [p.name for p in parts(judges.everyone)][1:]
    monkeypatch.setattr(folds, "parts", lambda data, by: ())
    monkeypatch.setattr(folds, "without", plain)
    nothing = beyond_of(play, ALONE, judges, silent)  # type: ignore[arg-type]
    assert nothing.folds == ()
    assert nothing.reason == "the poses are too few or too much alike"


def test_a_session_left_out_has_no_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own points may not place the frame in which they judge; as `calibrate` has it."""
    robot, made = mc.load_robot("irb2600"), mc.simulate("irb2600", 90, 2, seed=3)
    session, y = np.repeat(["a", "b", "c"], 30), made.data.y.copy()
    turns = Rotation.random(2, rng=np.random.default_rng(0)).as_matrix()
    for name, turn in zip("bc", turns, strict=True):
        y[session == name] = y[session == name] @ turn.T + 0.7
    data = replace(made.data.with_y(y), columns={**made.data.columns, "session": session})
    data = stationed(robot, with_history(data), np.ones(90, dtype=bool))
    study = studied(robot, data, fit_cell(robot, data, SUM, silent))
    judges = Judges(data, data.take(np.zeros(0, dtype=int)), np.zeros((2, 0), dtype=bool))

    def fold(*given: Any) -> Any:
        return SimpleNamespace(fits=[SimpleNamespace(cell=study.geometric)])

    monkeypatch.setattr(folds, "fold_of", fold)
    every = tuple(f"session {name}" for name in "abc")
    found = beyond_of(study, ALONE, judges, silent)  # type: ignore[arg-type]
    assert found.missed == every
    assert found.folds
    grouped = beyond_of(study, ALONE, replace(judges, by="session"), silent)  # type: ignore[arg-type]
    assert len(grouped.missed) == 3
    assert not grouped.folds


def test_a_fold_is_sought_and_fitted_on_its_rows_alone(play: Study) -> None:
    _, causes = causes_of(play, (), (), silent)
    assert isinstance(causes, Causes)
    rows = np.arange(play.data.poses) % 5 > 0
    found = fold_of(play, causes, rows, play.fit.state)
    assert_array_equal(found.fits[0].study.data.line, play.data.line[rows])
    assert [term.key for term in found.last.terms] == [("backlash", "J2")]
    spoilt = play.data.y + np.where(rows, 0.0, 1e-3)[:, None, None]
    other = replace(play, data=play.data.with_y(spoilt))
    again = fold_of(other, causes, rows, play.fit.state)
    assert_allclose(again.last.state.effects, found.last.state.effects, rtol=1e-12)


def test_a_fold_fits_the_whole_of_a_law() -> None:
    study = study_of(make(Case("irb2600", "single", (Cause("gear_error", "J3", 2000.0),), seed=3)))
    study, causes = causes_of(study, (), (), silent)
    assert [c.term.text for c in causes.choice.chosen] == ["gear_error:J3:turns=1.0"]
    rows = np.arange(study.data.poses) % 6 > 0
    fold = fold_of(study, causes, rows, study.fit.state)
    assert [term.text for term in fold.last.terms] == ["gear_error:J3:orders=2.0"]


def test_two_processes_find_what_one_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "START", 0.0)  # so that they start for so little
    data = mc.simulate("irb120", 60, 1, 1, truth=mc.Truth(compliance=3e-6)).data
    alone, beside = (mc.diagnose("irb120", data, jobs=jobs).to_dict() for jobs in (1, 2))
    assert alone.pop("seconds") != beside.pop("seconds")
    assert_equal(beside, alone)
