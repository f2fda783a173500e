"""The budget ends with the arm that is recommended, and says what nobody has measured."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal, assert_equal
from problems_fit import study_of
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments.gap_cases import GapCase, GapCause, build_and_measure_arm
from minimax_cal.core import parallel
from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing import extrapolation_test
from minimax_cal.diagnosing.budget_steps import JudgingPoses
from minimax_cal.diagnosing.cause_search import FoundCauses, search_causes
from minimax_cal.diagnosing.confirmation import has_key_or_alternative
from minimax_cal.diagnosing.diagnosis import POSSIBLE_STEP_NAME
from minimax_cal.diagnosing.diagnosis_sentences import SCATTER_SENTENCE
from minimax_cal.diagnosing.extrapolation_test import compare_extrapolation, fit_budget_on_rows
from minimax_cal.diagnosing.proposals import REVISIT_PROPOSAL
from minimax_cal.diagnosing.remaining_error import split_remaining_error
from minimax_cal.diagnosing.study import (
    LEAST_SQUARES_OPTIONS,
    LinearisedGeometry,
    linearise_geometry,
)
from minimax_cal.fitting.accuracy import summarise_point_errors
from minimax_cal.fitting.cell_fit import fit_cell
from minimax_cal.fitting.noise_floor import instrument_noise_without_joints
from minimax_cal.fitting.options import silent_progress
from minimax_cal.fitting.session_frames import place_sessions
from minimax_cal.measuring.pose_groups import list_holdout_regions
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.simulate import Truth, gravity, simulate
from minimax_cal.selection.remaining_structure import RemainingComponent
from minimax_cal.solvers.status import Status


@cache
def loose():
    """A strong cause, play, and a ripple that not all subsamples find; and its diagnosis."""
    causes = (
        GapCause("joint_compliance", "J2", 3000.0),
        GapCause("gear_ripple", "J4", 40.0),
        GapCause("backlash", "J3", 60.0),
    )
    made = build_and_measure_arm(GapCase("irb2600", "pair", causes, seed=5, poses=80))
    return made, mc.diagnose(made.robot, made.data)


def test_the_budget_ends_with_what_is_recommended():
    made, found = loose()
    assert [f.established for f in found.findings_in_step_order] == [True, True, False]
    names = [row["name"] for row in found.budget]
    assert names == [
        "nominal",
        "geometric",
        *(f.term.budget_step_name for f in found.findings_in_step_order[:-1]),
    ]
    held = {"objective": "sum", "effects": found}
    fit = mc.calibrate(made.robot, made.data, **held)
    last = found.budget[-1]
    assert fit.accuracy["holdout"].rms_mm == pytest.approx(last["rms_mm"], rel=0.01)
    assert fit.accuracy["holdout"].poses == last["poses"]
    assert {t.key for t in fit.cell.effects.terms} == {t.key for t in found.cells[-1].effects.terms}
    assert last["outside_rms_mm"] == pytest.approx(found.beyond.typical_mm)


def test_what_is_possible_stands_below_and_in_the_file():
    _, found = loose()
    assert found.budget_possible["name"] == POSSIBLE_STEP_NAME
    assert found.budget_possible["rms_mm"] == found.possible.holdout.rms_mm
    *_, row, noise = found.first_tables()[0].rows
    assert row[:2] == (found.budget_possible["name"], found.possible.holdout.rms_mm)
    assert noise[0].startswith("measurement noise")
    again = mc.Diagnosis.from_dict(json.loads(found.json()))
    assert again.budget == found.budget
    assert again.budget_possible == found.budget_possible
    assert len(again.possible_cell.effects.terms) == len(again.cells[-1].effects.terms) + 1
    texts = ([t.text for f in one.effects for t in f.terms] for one in (again, found))
    assert next(texts) == next(texts)


def test_effects_that_do_not_extrapolate_are_not_recommended():
    """They stay in the list, with the reason, and in the file."""
    _, found = loose()
    loosened = tuple(replace(one, extends=False) for one in found.effects)
    assert not any(one.established for one in loosened)
    again = mc.Diagnosis.from_dict(json.loads(replace(found, effects=loosened).json()))
    assert {one.why_tentative for one in again.effects} == {loosened[0].why_tentative}
    assert "regions" in loosened[0].why_tentative


@pytest.mark.parametrize("jitter", [0.0, 1.2e-5])
def test_what_nobody_measured_is_not_assumed(jitter):
    """Joints that scatter: without visits nobody knows; with them it is noise, and known."""
    robot = mc.load_robot("irb2600")
    sim = simulate(robot, 80, 3, seed=2, truth=Truth(compliance=0.0))
    again = np.concatenate([np.arange(80), np.arange(20)])
    q = sim.data.q[again]
    rng = np.random.default_rng(5)
    y = sim.cell.predict(q + jitter * rng.normal(size=q.shape))
    y = y + 17e-6 * rng.normal(size=y.shape)
    data = replace(sim.data.take(again), y=y, line=np.arange(100) + 1)
    once, twice = (mc.diagnose(robot, each, quick=True) for each in (data.take(slice(80)), data))
    instrument, _ = instrument_noise_without_joints(once.data)
    matters = once.ladder[-1].trusted.rms_mm > 1.2 * instrument
    assert matters == (jitter > 0.0)
    assert once.floor_known == (not matters)
    assert (once.next == REVISIT_PROPOSAL) == matters
    assert twice.floor_known
    assert twice.next is None
    assert {once.verdict, twice.verdict} == {"none"}
    for found in (once, twice):
        left = found.remaining
        told = np.hypot(left.noise_mm, left.unexplained_mm)
        assert told == pytest.approx(max(found.ladder[-1].trusted.rms_mm, left.noise_mm))


def test_a_name_stands_for_its_rivals():
    _, found = loose()
    one = found.effects[0]
    assert has_key_or_alternative(one, one.term.key)
    assert has_key_or_alternative(one, (one.term.effect, "all"))
    assert not has_key_or_alternative(one, ("frame_drift", "frame"))
    for rival in one.alternatives:
        assert has_key_or_alternative(one, (rival.effect, rival.place))


def visited(poses, times, scatter, law=0.0, bend=0.0, cyclic=False):
    """Poses that are visited again and again, joint 2 turned to either side by a scatter."""
    robot, rng = mc.load_robot("irb2600"), np.random.default_rng(7)
    sim = simulate(robot, poses, 3, seed=4, truth=Truth(compliance=0.0, span=1.2))
    rows = np.tile(np.arange(poses), times) if cyclic else np.repeat(np.arange(poses), times)
    q = sim.data.q[rows]
    moved = q + bend * gravity(sim.cell.robot, q)
    moved[:, 1] += law * np.sin(4.0 * q[:, 1] + 3.0 * q[:, 2] + 2.0 * q[:, 0])
    moved[:, 1] += scatter * rng.choice([-1.0, 1.0], len(q))
    y = sim.cell.predict(moved) + 12e-6 * rng.normal(size=(len(q), 3, 3))
    return mc.diagnose(robot, mc.measurements(q, y), quick=True)


def test_the_larger_part_has_the_first_sentence_and_a_visit_is_no_pose():
    """A curve that no law knows, .2 mm, in visits that scatter by half of that."""
    found = visited(24, 10, 60e-6, law=150e-6)
    assert found.verdict == "unknown"
    assert found.reasons[0].startswith("Unexplained")
    assert not found.repeatable
    assert SCATTER_SENTENCE in found.reasons
    assert not any("elsewhere" in text or "contradict" in text for text in found.notices)


def test_what_visits_scatter_is_not_unexplained():
    """Visits one after the other, or all poses again and again."""
    found = visited(40, 5, 80e-6, bend=0.5e-6, cyclic=True)
    assert found.verdict in ("named", "one_of")
    assert found.effects[0].term.effect == "joint_compliance"
    assert found.meets_floor
    assert not found.repeatable
    assert not any("elsewhere" in text or "contradict" in text for text in found.notices)
    alone = visited(40, 5, 80e-6)
    assert alone.verdict == "not_repeatable"
    assert alone.next.kind == "repeat"


@pytest.mark.parametrize("u95", [1e-3, 30e-6, 1e-9])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.4])
def test_the_squares_of_the_parts_are_those_of_the_whole(u95, share):
    """However large the declared noise, and however much a score says that something tells."""
    q = np.random.default_rng(0).normal(size=(30, 6))
    data = mc.measurements(q, np.random.default_rng(1).normal(size=(30, 1, 3)))
    data = replace(data, columns={"u95": np.full(30, u95)})
    left = [
        RemainingComponent("J1", "its load", 9.0, 0.002, share, 3),
        RemainingComponent("J2", "time", 9.0, 0.002, 0.1, 4),
    ]
    told, known = split_remaining_error(left, 0.1, data, np.zeros((30, 1, 3)))
    parts = [told.noise_mm, told.dependent_mm, told.unexplained_mm]
    assert np.hypot.reduce(parts) == pytest.approx(0.1)
    assert known == (u95 == 1e-3)
    assert told.depends[0].place == ("J1" if share > 0.1 else "J2")


def test_few_visits_that_are_far_off_are_no_noise_of_the_others():
    """What is said to be above noise of so much is not that noise."""
    rng = np.random.default_rng(2)
    q, y = np.repeat(rng.normal(size=(40, 6)), 2, axis=0), 1e-5 * rng.normal(size=(80, 1, 3))
    y[:2, 0, 0] += 1e-3, -1e-3
    data = mc.measurements(q, 1.0 + y)
    whole, _ = split_remaining_error([], 0.1, data, y)
    told, known = split_remaining_error([], 0.1, data, y, 0.02)
    assert (whole.noise_mm, told.noise_mm, known) == (0.1, 0.02, True)
    assert np.hypot(told.noise_mm, told.unexplained_mm) == pytest.approx(0.1)


def test_what_failed_asks_whether_it_is_this_arm():
    _, found = loose()
    failed = replace(found, status=Status.FAILED, verdict="unknown", remaining=None)
    assert failed.next.kind == "check"
    assert len(failed.reasons) == 1
    again = mc.Diagnosis.from_dict(json.loads(failed.json()))
    assert again.next == failed.next


def test_an_old_file_knows_its_floor_where_it_met_it():
    _, found = loose()
    said = json.loads(found.json())
    for key in ("floor_known", "remaining", "repeatable", "budget", "next"):
        del said[key]
    said["meets_floor"] = None
    old = mc.Diagnosis.from_dict(said)
    assert (old.floor_known, old.remaining, old.next) == (False, None, REVISIT_PROPOSAL)


def test_geometry_is_recommended_where_effects_make_regions_left_out_worse(monkeypatch):
    made, plain = loose()
    asked = []

    def worse(study, causes, judges, progress):
        out = compare_extrapolation(study, causes, judges, progress)
        asked.append(len(causes.confirmed_findings))
        far = 2.0 * out.geometric_typical_mm
        return replace(out, typical_mm=far) if len(asked) == 1 else out

    monkeypatch.setattr("minimax_cal.diagnosing.diagnose.compare_extrapolation", worse)
    found = mc.diagnose(made.robot, made.data)
    assert asked == [2, 0]
    assert [step.name for step in found.ladder] == ["nominal", "geometric"]
    assert not any(one.established for one in found.effects)
    assert found.verdict == "unknown"
    outside = plain.beyond.geometric_typical_mm
    assert found.beyond.typical_mm == pytest.approx(outside)
    assert found.budget[-1]["outside_rms_mm"] == pytest.approx(outside)
    assert found.budget_possible["outside_rms_mm"] == pytest.approx(2.0 * outside)
    assert any("extrapolate" in text for text in found.reasons)


# ---- folds ---------------------------------------------------------------------------------------


ALONE = SimpleNamespace(jobs=1, cluster="")  # causes that no fold looks at


@pytest.fixture(scope="module")
def play() -> LinearisedGeometry:
    return study_of(
        build_and_measure_arm(
            GapCase("irb2600", "single", (GapCause("backlash", "J2", 1000.0),), seed=1)
        )
    )


@pytest.fixture(scope="module")
def judges(play: LinearisedGeometry) -> JudgingPoses:
    """The poses of the fit, and as many others."""
    held = replace(play.data, q=play.data.q + 0.02, line=play.data.line + 1000)
    held = held.take(np.arange(0, held.poses, 4))
    return JudgingPoses(play.data, held, np.zeros((held.poses, len(held.target_names)), dtype=bool))


def test_every_part_is_left_out_and_judges(
    play: LinearisedGeometry, judges: JudgingPoses, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Array, ParameterValues]] = []
    told: list[str] = []
    cells = [play.geometric_cell, play.nominal_cell]

    def fold(study: LinearisedGeometry, causes: Any, rows: Array, state: ParameterValues) -> Any:
        asked.append((rows, state))
        return SimpleNamespace(joint_fits=[SimpleNamespace(cell=cell) for cell in reversed(cells)])

    monkeypatch.setattr(extrapolation_test, "fit_budget_on_rows", fold)
    found = compare_extrapolation(play, ALONE, judges, told.append)  # type: ignore[arg-type]
    every = judges.all_seen_measurements
    left_out = list_holdout_regions(every)
    assert [one.where for one in found.folds] == [part.name for part in left_out]
    assert told == [f"part {i} of {len(left_out)} held out: {part.name}"
                    for i, part in enumerate(left_out, 1)]  # fmt: skip
    for one, part, (rows, state) in zip(found.folds, left_out, asked, strict=True):
        here = every.take(part.rows)
        assert_array_equal(rows, ~np.isin(play.data.line, here.line))
        assert one.rms_mm == summarise_point_errors(cells[0].error(here)).rms_mm
        assert one.geometric_mm == summarise_point_errors(cells[1].error(here)).rms_mm
        squares = [
            np.nansum(play.model.point_errors(s)[rows] ** 2) for s in (state, play.fit.state)
        ]
        assert squares[0] < squares[1]  # the fit of the others alone


def test_a_part_that_the_fit_needs_judges_nothing(
    play: LinearisedGeometry, judges: JudgingPoses, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = extrapolation_test.refit_without_regions

    def some(*given: Any) -> list[ParameterValues | None]:
        return [None, *plain(*given)[1:]]

    def fold(*given: Any) -> Any:
        return SimpleNamespace(joint_fits=[SimpleNamespace(cell=play.geometric_cell)])

    monkeypatch.setattr(extrapolation_test, "fit_budget_on_rows", fold)
    monkeypatch.setattr(extrapolation_test, "refit_without_regions", some)
    found = compare_extrapolation(play, ALONE, judges, silent_progress)  # type: ignore[arg-type]
    assert [one.where for one in found.folds] == [
        p.name for p in list_holdout_regions(judges.all_seen_measurements)
    ][1:]
    monkeypatch.setattr(extrapolation_test, "list_holdout_regions", lambda data, by: ())
    monkeypatch.setattr(extrapolation_test, "refit_without_regions", plain)
    nothing = compare_extrapolation(play, ALONE, judges, silent_progress)  # type: ignore[arg-type]
    assert nothing.folds == ()
    assert nothing.reason


def test_a_session_left_out_has_no_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own points may not place the frame in which they judge; as `calibrate` has it."""
    robot, made = mc.load_robot("irb2600"), mc.simulate("irb2600", 90, 2, seed=3)
    session, y = np.repeat(["a", "b", "c"], 30), made.data.y.copy()
    turns = Rotation.random(2, rng=np.random.default_rng(0)).as_matrix()
    for name, turn in zip("bc", turns, strict=True):
        y[session == name] = y[session == name] @ turn.T + 0.7
    data = replace(made.data.with_y(y), columns={**made.data.columns, "session": session})
    data = place_sessions(robot, add_history_columns(data), np.ones(90, dtype=bool))
    study = linearise_geometry(
        robot, data, fit_cell(robot, data, LEAST_SQUARES_OPTIONS, silent_progress)
    )
    judges = JudgingPoses(data, data.take(np.zeros(0, dtype=int)), np.zeros((0, 2), dtype=bool))

    def fold(*given: Any) -> Any:
        return SimpleNamespace(joint_fits=[SimpleNamespace(cell=study.geometric_cell)])

    monkeypatch.setattr(extrapolation_test, "fit_budget_on_rows", fold)
    every = tuple(f"session {name}" for name in "abc")
    found = compare_extrapolation(study, ALONE, judges, silent_progress)  # type: ignore[arg-type]
    assert found.missed == every
    assert found.folds
    grouped = compare_extrapolation(
        study, ALONE, replace(judges, holdout_by="session"), silent_progress
    )  # type: ignore[arg-type]
    assert len(grouped.missed) == 3
    assert not grouped.folds


def test_a_fold_is_sought_and_fitted_on_its_rows_alone(play: LinearisedGeometry) -> None:
    _, causes = search_causes(play, (), (), silent_progress)
    assert isinstance(causes, FoundCauses)
    rows = np.arange(play.data.poses) % 5 > 0
    found = fit_budget_on_rows(play, causes, rows, play.fit.state)
    assert_array_equal(found.joint_fits[0].study.data.line, play.data.line[rows])
    assert [term.key for term in found.last_fit.terms] == [("backlash", "J2")]
    spoilt = play.data.y + np.where(rows, 0.0, 1e-3)[:, None, None]
    other = replace(play, data=play.data.with_y(spoilt))
    again = fit_budget_on_rows(other, causes, rows, play.fit.state)
    assert_allclose(
        again.last_fit.parameter_values.effects, found.last_fit.parameter_values.effects, rtol=1e-12
    )


def test_a_fold_fits_the_whole_of_a_law() -> None:
    study = study_of(
        build_and_measure_arm(
            GapCase("irb2600", "single", (GapCause("gear_error", "J3", 2000.0),), seed=3)
        )
    )
    study, causes = search_causes(study, (), (), silent_progress)
    assert [c.term.text for c in causes.selection.candidates] == ["gear_error:J3:turns=1.0"]
    rows = np.arange(study.data.poses) % 6 > 0
    fold = fit_budget_on_rows(study, causes, rows, study.fit.state)
    assert [term.text for term in fold.last_fit.terms] == ["gear_error:J3:orders=2.0"]


def test_two_processes_find_what_one_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "PROCESS_START_SECONDS", 0.0)  # so that they start for so little
    data = mc.simulate("irb120", 60, 1, 1, truth=mc.Truth(compliance=3e-6)).data
    alone, beside = (mc.diagnose("irb120", data, jobs=jobs).to_dict() for jobs in (1, 2))
    assert alone.pop("seconds") != beside.pop("seconds")
    assert_equal(beside, alone)
