"""Arms of any kind, grossly misdrawn, reach the noise."""

from __future__ import annotations

import numpy as np
import pytest

import minimax_cal as mc
from experiments.random_arms import KINDS, Job, at_noise, count, drawn, end_of, measured, tables
from minimax_cal.fitting import solve


def test_axes_hardly_apart_join_where_the_fit_needs_them() -> None:
    """Two of the arms that a threshold on what shows alone leaves at 0.14 and 0.15 mm."""
    assert all(at_noise(end_of(Job("coaxial neighbours", seed))) for seed in (54, 60))


@pytest.mark.parametrize("kind", KINDS)
def test_a_random_arm_reaches_the_noise(kind: str) -> None:
    found = {job: end_of(job) for job in (Job(kind, 0), Job(kind, 3))}
    assert count(list(found.values())) == 2, tables(found)[1].text()


def test_identification_is_asked_again_at_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Axes drawn coaxial that are not: without the second look the fit stops above the noise."""
    job = Job("coaxial neighbours", 0)
    monkeypatch.setattr(solve, "MAX_GROWTHS", 0)
    before = end_of(job)
    monkeypatch.undo()
    after = end_of(job)
    assert not at_noise(before)
    assert at_noise(after)
    assert after.parameters > before.parameters


def test_what_was_identified_stays_so_and_the_rest_stays_as_drawn() -> None:
    job = Job("coaxial neighbours", 1)
    fit = mc.calibrate(drawn(job), measured(job, drawn(job)), "sum", allow_large_changes=True)
    rest = [p for p in fit.parameters if not p.identifiable]
    assert rest
    assert all(p.value == p.nominal for p in rest)


def test_whole_arms_gain_nothing(robot: mc.Robot) -> None:
    """A drawing that is right but for tolerances: the second look finds no more."""
    data = mc.simulate(robot, 60, 3, seed=4).data
    task = solve.prepared(robot, data, mc.Options(objective="sum"))
    model = task.base.emphasise(task.share)
    known = task.identified(model, task.frame.state)
    _, squares = task.squares(model.only(known.active), task.frame.state)
    assert task.grown(model, squares.x.take(np.array(0)), known, solve.MIN_GROWN_SINGULAR) is None
