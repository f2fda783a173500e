"""The ladder and the share of the gap that it closes, against sums written out here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems_fit import study_of

import minimax_cal as mc
from experiments.gap_cases import GapCase, GapCause, build_and_measure_arm
from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing import budget_steps
from minimax_cal.diagnosing.budget_steps import (
    BOOTSTRAP_RESAMPLE_COUNT,
    JACKKNIFE_GROUP_COUNT,
    BudgetSteps,
    JudgingPoses,
    assign_folds,
    clip_explained_fraction,
    compute_explained_fraction,
    error_squares_and_counts,
    estimate_explained_fraction,
    explained_fraction,
    fill_error_fractions,
    fill_fitted_values,
    fit_budget_steps,
    jackknife_explained_fraction,
    max_motion_per_unit,
    select_driver_ends,
)
from minimax_cal.diagnosing.diagnosis import MOTION_UNITS_WITHOUT_MASSES, BudgetStep, Finding
from minimax_cal.diagnosing.joint_fit import fit_geometry_and_effects
from minimax_cal.diagnosing.linear_trials import TrialFit
from minimax_cal.diagnosing.study import LinearisedGeometry, linearise_geometry
from minimax_cal.fitting.accuracy import Accuracy, summarise_point_errors
from minimax_cal.fitting.noise_floor import REPEATS, NoiseFloor
from minimax_cal.measuring.pose_groups import cluster_poses
from minimax_cal.modelling.effects.joint_error_maps import fitted_map_curve, usual_map_choices
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.simulate import simulate
from minimax_cal.selection.thresholds import BUDGET_FOLD_COUNT, MIN_RELATIVE_HELDOUT_GAIN

PLAY = Term("backlash", "J2")
SOFT = Term("joint_compliance", "J3", {"parts": 128.0})
TURN = Term("gear_error", "J3", {"turns": 1.0})
LONG = Term("link_bending", "L2", {"side": 1.0})


@pytest.fixture(scope="module")
def play() -> LinearisedGeometry:
    return study_of(
        build_and_measure_arm(
            GapCase("irb2600", "single", (GapCause("backlash", "J2", 1000.0),), seed=1)
        )
    )


@pytest.fixture(scope="module")
def mapped(play: LinearisedGeometry) -> Term:
    """Any smooth curve of joint 4's angle."""
    return Term("joint_error_map", "J4", usual_map_choices(play.scene, "J4")[0])


@pytest.fixture(scope="module")
def ladder(play: LinearisedGeometry) -> BudgetSteps:
    """Geometry, and with play: the first of two effects is one that no pose is met better with."""
    return fit_budget_steps(
        play, [(Term("gear_ripple", "J6", {"turns": 31.0}),), (PLAY,)], [True, True]
    )


def finding(effect: str, place: str, count: int = 1, unit: str = "rad", **more: object) -> Finding:
    zero = (0.0,) * count
    names = tuple(f"c{i}" for i in range(count))
    return Finding((Term(effect, place),), names, (unit,) * count, zero, zero, 1.0, 1e-9,
                   **more)  # type: ignore[arg-type]  # fmt: skip


def scores(rms: float) -> Accuracy:
    return Accuracy(rms, 2.0 * rms, 0.9 * rms, 20, (20.0 * rms**2,), (20,))


def rung(name: str, train: float, holdout: float, trusted: float) -> BudgetStep:
    return BudgetStep(name, scores(train), scores(holdout), scores(trusted))


def judges_of(play: LinearisedGeometry) -> JudgingPoses:
    """The even poses are held out, and two points of theirs stand out."""
    data = play.data
    odd = np.arange(data.poses) % 2 > 0
    held = data.take(~odd)
    far = np.zeros((held.poses, len(data.target_names)), dtype=bool)
    far[1, 0] = far[4, -1] = True
    return JudgingPoses(data.take(odd), held, far)


# ---- the ladder --------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [3, 5])
def test_folds_keep_groups_together_and_are_even(play: LinearisedGeometry, count: int) -> None:
    twice = play.data.take(np.repeat(np.arange(play.data.poses), 2))  # each pose visited again
    part, group = assign_folds(twice, count), cluster_poses(twice)
    assert_array_equal(part[::2], part[1::2])
    assert_array_equal(np.array([len(set(part[group == i])) for i in range(group.max() + 1)]), 1)
    sizes = np.bincount(part[np.unique(group, return_index=True)[1]])
    assert len(sizes) == count
    assert sizes.max() - sizes.min() <= 1
    assert not np.array_equal(part, group % count)  # at random


def test_a_rung_is_taken_that_meets_groups_left_out_better(
    play: LinearisedGeometry, ladder: BudgetSteps
) -> None:
    assert ladder.last_fit is ladder.joint_fits[-1]
    assert ladder.taken_numbers[-1] == 1
    assert ladder.last_fit.terms[-1] is PLAY
    parts = list(ladder.fold_masks)
    assert_array_equal(np.sum(parts, axis=0), 1)
    squares = [fit.cross_validate_folds(parts) for fit in ladder.joint_fits]
    assert np.all(np.diff(squares) < -MIN_RELATIVE_HELDOUT_GAIN * np.array(squares[:-1]))


def test_a_rung_has_to_help_by_so_much(
    play: LinearisedGeometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, after = fit_geometry_and_effects(play, ()), fit_geometry_and_effects(play, (PLAY,))
    parts = [
        assign_folds(play.data, BUDGET_FOLD_COUNT) == number for number in range(BUDGET_FOLD_COUNT)
    ]
    fall = 1.0 - after.cross_validate_folds(parts) / before.cross_validate_folds(parts)
    assert 0.1 < fall < 0.9
    for helps, taken in ((0.99 * fall, (0,)), (1.01 * fall, ())):
        monkeypatch.setattr(budget_steps, "MIN_RELATIVE_HELDOUT_GAIN", helps)
        assert fit_budget_steps(play, [(PLAY,)], [True]).taken_numbers == taken


def test_what_meets_the_training_poses_worse_is_no_rung(
    play: LinearisedGeometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TrialFit, "fits_no_worse", lambda self, other: False)
    assert fit_budget_steps(play, [(PLAY,)], [True]).taken_numbers == ()


@pytest.mark.parametrize(("law", "turns", "kept"), [
    ("gear_error", 1.0, True), ("outside_step", 2.0, False), ("outside_step", 3.0, False),
])  # fmt: skip
def test_where_structure_is_left_a_law_has_to_hold_at_the_ends(
    law: str, turns: float, kept: bool
) -> None:
    """Waves fitted to a jump of the joint are taken, but not where they are a best guess."""
    study = study_of(
        build_and_measure_arm(GapCase("irb2600", "single", (GapCause(law, "J3", 1000.0),), seed=1))
    )
    wave = [(Term("gear_error", "J3", {"turns": turns}),)]
    assert fit_budget_steps(study, wave, [True]).taken_numbers == (0,)
    assert fit_budget_steps(study, wave, [True], are_best_guesses=True).taken_numbers == (
        (0,) if kept else ()
    )


def test_the_ends_of_what_drives_a_law(play: LinearisedGeometry, mapped: Term) -> None:
    scene = play.scene
    low, high = select_driver_ends(scene, TURN)
    assert scene.q[2, low].max() < scene.q[2, ~low].min()
    assert scene.q[2, high].min() > scene.q[2, ~high].max()
    assert abs(low.mean() - 0.2) < 1.5 / scene.poses
    early, late = select_driver_ends(scene, Term("frame_drift", "frame"))
    assert scene.column("clock")[early].max() < scene.column("clock")[late].min()
    for term in (mapped, PLAY, SOFT, Term("gear_error", "all", {"turns": 1.0, "joints": 63.0})):
        assert not select_driver_ends(scene, term)


def test_findings_get_the_values_of_the_last_rung(
    play: LinearisedGeometry, ladder: BudgetSteps
) -> None:
    two = fit_geometry_and_effects(play, (PLAY, TURN))
    whole = BudgetSteps(
        (ladder.joint_fits[0], fit_geometry_and_effects(play, (PLAY,)), two),
        (2, 0),
        ladder.fold_masks,
        2,
    )
    named = [finding("gear_error", "J3", 2), finding("gear_ripple", "J6", 2),
             finding("backlash", "J2")]  # fmt: skip
    found = fill_fitted_values(named, whole)
    assert [f.term.effect for f in found] == ["backlash", "gear_error"]
    assert_allclose([v for f in found for v in f.values], two.parameter_values.effects)
    assert_allclose([v for f in found for v in f.sigmas], two.uncertainty.sigma[-3:])
    assert np.all(two.uncertainty.sigma[-3:] > 0.0)
    assert [(len(f.values), f.curve.shape) for f in found] == [(1, (3, 0)), (2, (3, 0))]
    assert (
        fill_fitted_values(named, BudgetSteps(ladder.joint_fits[:1], (), ladder.fold_masks, 0))
        == []
    )


def test_an_error_map_is_drawn_with_its_own_uncertainty(
    play: LinearisedGeometry, ladder: BudgetSteps, mapped: Term
) -> None:
    last = fit_geometry_and_effects(play, (PLAY, mapped, TURN))
    count = len(last.parameter_values.effects) - 3
    named = [finding("backlash", "J2"), finding("joint_error_map", "J4", count),
             finding("gear_error", "J3", 2)]  # fmt: skip
    named[1] = replace(named[1], terms=(mapped,))
    found = fill_fitted_values(
        named, BudgetSteps((*ladder.joint_fits[:1], last), (0, 1, 2), ladder.fold_masks, 3)
    )
    assert [f.curve.shape[1] > 0 for f in found] == [False, True, False]
    covariance = last.uncertainty.covariance[-2 - count : -2, -2 - count : -2]
    sign = float(play.robot.sign[3])
    expected = fitted_map_curve(
        mapped.choice, sign, last.parameter_values.effects[1:-2], covariance
    )
    assert_allclose(found[1].curve, expected, rtol=1e-12)
    assert found[1].curve[2].max() > 0.0


def test_a_unit_that_rests_on_masses_is_told_as_a_motion(play: LinearisedGeometry) -> None:
    light = replace(play.scene.robot, mass=np.full(play.scene.joints, np.nan))
    scene = replace(play.scene, robot=light)
    soft = replace(finding("joint_compliance", "J3", unit="rad/(N m)"), terms=(SOFT,))
    assert_allclose(max_motion_per_unit(scene, soft), [np.abs(SOFT.columns(scene).turn).max()])
    long = replace(finding("link_bending", "L2", unit="1/(N m^2)"), terms=(LONG,))
    moved = LONG.columns(scene).target_displacements(scene)
    assert_allclose(
        max_motion_per_unit(scene, long), np.sqrt((moved**2).sum(axis=2)).max(axis=(1, 2))
    )
    foot = Term("base_flex", "frame")
    tilt = replace(finding("base_flex", "frame", unit="rad/(N m)"), terms=(foot,))
    moved = foot.columns(scene).target_displacements(scene)
    assert_allclose(
        max_motion_per_unit(scene, tilt), np.sqrt((moved**2).sum(axis=2)).max(axis=(1, 2))
    )
    units = [one.parameters[0]["unit"] for one in (
        replace(f, motion=max_motion_per_unit(scene, f)) for f in (soft, long, tilt))]  # fmt: skip
    turn, shift = MOTION_UNITS_WITHOUT_MASSES["rad/(N m)"], MOTION_UNITS_WITHOUT_MASSES["1/(N m^2)"]
    assert units == [turn, shift, shift]
    assert max_motion_per_unit(scene, replace(finding("backlash", "J2"), terms=(PLAY,))) == ()
    assert max_motion_per_unit(scene, replace(soft, units=("rad/(N m)", "rad"))) == ()
    assert max_motion_per_unit(play.scene, soft) == ()  # whose masses are told
    torque = {f"tau{j + 1}": np.arange(scene.poses) for j in range(scene.joints)}
    measured = replace(scene.data, columns={**scene.data.columns, **torque})
    assert max_motion_per_unit(replace(scene, data=measured), soft) == ()


# ---- who judges --------------------------------------------------------------------------------


def test_what_a_gap_hid_is_marked_once_it_is_closed() -> None:
    """A pose that is off by less than geometry leaves elsewhere, and by more than effects do."""
    long = study_of(
        build_and_measure_arm(
            GapCase("irb2600", "single", (GapCause("backlash", "J2", 1e5),), seed=1)
        )
    )
    first, last = (fit_geometry_and_effects(long, terms).cell for terms in ((), (PLAY,)))
    limits = [
        12.0 * float(np.median(np.linalg.norm(cell.error(long.data), axis=-1)))
        for cell in (first, last)
    ]
    assert limits[0] > 2.0 * limits[1]
    y = long.data.y.copy()
    y[4] += np.sqrt(limits[0] * limits[1]) * np.array([0.6, 0.0, 0.8])  # distances stay
    odd = np.arange(long.data.poses) % 2 > 0
    held = long.data.with_y(y).take(~odd)
    judges = JudgingPoses(long.data.take(odd), held, np.zeros_like(held.seen))
    same, none = judges.mark_outliers(first, first)
    assert_array_equal(same.outlier_mask, judges.outlier_mask)
    assert none == ()
    marked, found = judges.mark_outliers(first, last)
    assert np.argwhere(marked.outlier_mask.any(axis=1)).tolist() == [[2]]
    assert marked.outlier_mask[2].all()
    assert found == tuple(f"{held.called(int(held.line[2]))} {name}" for name in held.target_names)
    step = marked.judge_cell("last", last)
    assert step.holdout.max_mm > 5.0 * step.trusted.max_mm
    mine, _ = judges.mark_outliers(last, first)  # what only a model misses is its own
    assert not (mine.outlier_mask & ~marked.outlier_mask).any()


@pytest.mark.parametrize("column", ["order", "time"])
def test_a_nest_that_moved_makes_no_points_stand_out(column: str) -> None:
    """Whichever poses are held out: rows are looked at as they were visited."""
    made = simulate(mc.load_robot("irb2600"), 120, seed=4).data
    away = made.y[60:, 1] - made.y[60:, 0]
    y = made.y.copy()
    y[60:, 1] += 1e-3 * away / np.linalg.norm(away, axis=1, keepdims=True)  # on the flange
    data = replace(made.with_y(y), columns={column: np.arange(120.0)})
    found = mc.diagnose("irb2600", data, quick=True)
    assert not [notice for notice in found.notices if "that no effect found explains" in notice]
    assert found.ladder[-1].trusted.counts == found.ladder[-1].holdout.counts


def test_everyone_is_both_parts_in_order_without_what_stands_out(play: LinearisedGeometry) -> None:
    judges = judges_of(play)
    everyone = judges.all_seen_measurements
    order = np.argsort(play.data.line)
    y = play.data.y[order].copy()
    for line, target in (
        (judges.heldout_measurements.line[1], 0),
        (judges.heldout_measurements.line[4], -1),
    ):
        y[play.data.line[order] == line, target] = np.nan
    assert_array_equal(everyone.line, play.data.line[order])
    assert_array_equal(everyone.q, play.data.q[order])
    assert_array_equal(everyone.y, y)
    for name, column in everyone.columns.items():
        assert_array_equal(column, play.data.columns[name][order])
    lost = replace(
        judges,
        outlier_mask=judges.outlier_mask
        | (np.arange(judges.heldout_measurements.poses) == 7)[:, None],
    )
    assert judges.heldout_measurements.line[7] not in lost.all_seen_measurements.line
    assert lost.all_seen_measurements.poses == play.data.poses - 1


def test_a_rung_is_judged_by_poses_of_the_fit_and_held_out(play: LinearisedGeometry) -> None:
    judges, cell = judges_of(play), play.geometric_cell
    step = judges.judge_cell("geometric", cell)
    error = cell.error(judges.heldout_measurements)
    assert step.name == "geometric"
    assert step.train == summarise_point_errors(cell.error(judges.training_measurements))
    assert step.holdout == summarise_point_errors(error)
    trusted = judges.heldout_errors(cell)
    assert_array_equal(np.isnan(trusted).all(axis=2), judges.outlier_mask)
    assert_array_equal(trusted[~judges.outlier_mask], error[~judges.outlier_mask])
    assert step.trusted == summarise_point_errors(trusted)


# ---- shares ------------------------------------------------------------------------------------

STEPS = (
    rung("nominal", 9.0, 9.0, 9.0),
    rung("geometric", 1.0, 5.0, 1.0),
    rung("mended", 0.9, 4.0, 0.8),
    rung("a", 0.7, 3.0, 0.6),
    rung("b", 0.6, 2.0, 0.5),
)


def test_each_effect_closes_what_its_rung_does() -> None:
    one, two = finding("gear_error", "J1"), finding("backlash", "J2")
    steps = (*STEPS[:2], *STEPS[3:])
    found = fill_error_fractions([two, one], steps, 0.2)
    assert [(f.term.effect, f.before, f.after) for f in found] == [
        ("backlash", 1.0, 0.6), ("gear_error", 0.6, 0.5)]  # fmt: skip
    gap_ = 1.0 - 0.2**2
    assert_allclose([f.share for f in found], [(1.0 - 0.36) / gap_, (0.36 - 0.25) / gap_])
    larger = fill_error_fractions(
        [one, two], (*steps[:2], rung("a", 1, 1, 0.9), rung("b", 1, 1, 0.2)), 0.2
    )
    assert [f.term.effect for f in larger] == ["backlash", "gear_error"]  # the largest share first


def test_faults_that_are_mended_share_the_first_rung() -> None:
    faults = [finding("outliers", "all"), finding("swapped_rows", "all")]
    more = [finding("gear_error", "J1"), finding("backlash", "J2")]
    lag = finding("readback", "all")
    found = fill_error_fractions([*faults, lag, *more], STEPS, 0.0)
    told = {f.term.effect: (f.before, f.after, f.share) for f in found}
    assert_allclose(told["outliers"], (1.0, 0.8, 0.18))
    assert_allclose(told["swapped_rows"], (1.0, 0.8, 0.18))
    assert_allclose(told["gear_error"], (0.8, 0.6, 0.28))
    assert_allclose(told["backlash"], (0.6, 0.5, 0.11))
    assert np.isnan(told["readback"]).all()
    assert found[0].term.effect == "readback"  # what has no share comes first
    alone = fill_error_fractions([faults[0]], STEPS[:3], 0.0)[0]
    assert_allclose((alone.before, alone.after, alone.share), (1.0, 0.8, 0.36))
    exact = fill_error_fractions(
        [more[0]], (*STEPS[:2], STEPS[3]), 1.0
    )  # no gap, and no share of it
    assert np.isnan(exact[0].share)
    small = fill_error_fractions([more[0]], (*STEPS[:2], STEPS[3]), 0.999)  # no more than all of it
    assert small[0].share == 1.0


# ---- how much is closed ------------------------------------------------------------------------


def test_sums_are_of_the_points_that_were_measured() -> None:
    error = np.full((3, 2, 3), np.nan)
    error[0, 0], error[0, 1], error[2, 0] = (1e-3, 2e-3, 2e-3), (0.0, 0.0, 1e-3), (3e-3, 0.0, 0.0)
    assert_allclose(
        error_squares_and_counts(error), [[10.0, 0.0, 9.0], [2.0, 0.0, 1.0]], rtol=1e-12
    )


def test_the_share_is_of_mean_squares_above_the_floor() -> None:
    before, after = np.array([[8.0, 1.0, 4.0], [2.0, 1.0, 0.0]]), np.array([[2.0] * 3, [2.0] * 3])
    found = compute_explained_fraction([before, after], np.array([0.5, 1.0, 1.0]))
    assert_allclose(found, [1.0 - 0.75 / 3.75, np.nan, 1.0])


def test_the_interval_is_that_of_groups_drawn_anew() -> None:
    """Against a bootstrap written out, with the same draws."""
    rng = np.random.default_rng(3)
    before, after = (s * rng.normal(size=(30, 2, 3)) for s in (2e-3, 1e-3))
    group = np.repeat(np.arange(10) * 7, 3)  # whatever their numbers are
    floor = NoiseFloor(0.5, 0.4, 0.6, REPEATS)
    share, ends = estimate_explained_fraction(
        before, after, group, floor, 0.0, np.random.default_rng(5)
    )
    squares = [1e6 * (e**2).sum(axis=(1, 2)).reshape(10, 3).sum(axis=1) for e in (before, after)]

    def closing(rows: Array, floors: Array) -> Array:
        one, two = (s[rows].sum(axis=-1) / (6.0 * rows.shape[-1]) for s in squares)
        return np.asarray(1.0 - (two - floors**2) / (one - floors**2))

    assert_allclose(share, closing(np.arange(10), np.array(0.5)), rtol=1e-12)
    rng = np.random.default_rng(5)
    rows = rng.integers(0, 10, (BOOTSTRAP_RESAMPLE_COUNT, 10))
    drawn = closing(rows, floor.sample_values_mm(BOOTSTRAP_RESAMPLE_COUNT, rng))
    assert_allclose(ends, np.quantile(drawn, (0.025, 0.975)), rtol=1e-9)
    assert ends[0] < share < ends[1]
    variance = 3.0 * np.var(drawn)
    _, wide = estimate_explained_fraction(
        before, after, group, floor, variance, np.random.default_rng(5)
    )
    middle = np.median(drawn)
    assert_allclose(np.array(wide) - middle, 2.0 * (np.array(ends) - middle), rtol=1e-9)


@pytest.mark.parametrize(("most", "told"), [(99, False), (100, True)])
def test_few_draws_with_a_gap_give_no_interval(
    most: int, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The floor as drawn leaves a gap so often."""
    error = np.full((40, 1, 3), 1e-3)
    floors = np.where(
        np.arange(BOOTSTRAP_RESAMPLE_COUNT) < most, 1.0, 2.0
    )  # beside an RMS of sqrt(3) mm
    monkeypatch.setattr(NoiseFloor, "sample_values_mm", lambda self, count, rng: floors)
    floor = NoiseFloor(1.0, 1.0, 1.0, REPEATS)
    share, ends = estimate_explained_fraction(error, 0.0 * error, np.arange(40), floor, 0.0,
                               np.random.default_rng(0))  # fmt: skip
    assert_allclose(share, 1.5, rtol=1e-12)
    assert np.isfinite(ends).tolist() == [told, told]


@pytest.mark.parametrize(
    ("share", "ends", "expected"),
    [
        (1.5, (0.9, 1.8), (1.0, (0.9, 1.0))),
        (0.6, (-0.4, 0.7), (0.6, (0.0, 0.7))),
        (-0.2, (-0.6, 0.3), (0.0, (0.0, 0.3))),
        (0.5, (-3.0, 4.0), (0.5, (np.nan, np.nan))),
        (np.nan, (np.nan, np.nan), (np.nan, (np.nan, np.nan))),
    ],
)
def test_a_share_is_between_nothing_and_all(
    share: float, ends: tuple[float, float], expected: tuple[float, tuple[float, float]]
) -> None:
    assert_allclose(np.hstack(clip_explained_fraction(share, ends)), np.hstack(expected))


def test_what_other_training_poses_would_close_is_a_jackknife(play: LinearisedGeometry) -> None:
    """Against fits made anew without each tenth."""
    fits = (fit_geometry_and_effects(play, ()), fit_geometry_and_effects(play, (PLAY,)))
    held = play.data.take(np.arange(play.data.poses) < 30)
    judges = JudgingPoses(play.data, held, np.zeros((30, len(held.target_names)), dtype=bool))
    floor = NoiseFloor(0.01, 0.0, 0.02, REPEATS)
    part, shares = assign_folds(play.data, JACKKNIFE_GROUP_COUNT), []
    for number in range(JACKKNIFE_GROUP_COUNT):
        rest = linearise_geometry(play.robot, play.data.take(part != number), play.fit)
        pair = [
            1e6
            * np.mean((fit_geometry_and_effects(rest, fit.terms).cell.error(held) ** 2).sum(axis=2))
            - 1e-4
            for fit in fits
        ]
        shares.append(1.0 - pair[1] / pair[0])
    expected = (JACKKNIFE_GROUP_COUNT - 1) ** 2 / JACKKNIFE_GROUP_COUNT * np.var(shares, ddof=1)
    found = jackknife_explained_fraction(BudgetSteps(fits, (0,), (), 1), judges, floor)
    assert_allclose(found, expected, rtol=0.05)  # one step of Newton against its end
    share, (low, high) = explained_fraction(BudgetSteps(fits, (0,), (), 1), judges, floor, 4)
    before, after = (judges.heldout_errors(fit.cell) for fit in fits)
    same = estimate_explained_fraction(
        before, after, cluster_poses(held), floor, found, np.random.default_rng(4)
    )
    assert (share, (low, high)) == same


def test_parts_that_a_fit_needs_are_passed_over(
    play: LinearisedGeometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    fits = (fit_geometry_and_effects(play, ()), fit_geometry_and_effects(play, (PLAY,)))
    judges = replace(judges_of(play), training_measurements=play.data)
    floor = NoiseFloor(0.0, 0.0, 0.0, REPEATS)
    plain = budget_steps.refit_without_regions

    def share(states: tuple[object, object]) -> float:
        pair = [error_squares_and_counts(judges.heldout_errors(fit.build_cell(state))).sum(axis=1)  # type: ignore[arg-type]
                for fit, state in zip(fits, states, strict=True)]  # fmt: skip
        return float(compute_explained_fraction(pair, np.array([0.0]))[0])

    def kept(count: int, first: bool) -> float:
        """With so many parts that both fits can do without, others that one of them cannot."""

        def some(estimator: object, state: object, masks: list[Array], frames: int) -> list[object]:
            out: list[object] = list(plain(estimator, state, masks, frames))  # type: ignore[arg-type]
            mine = (state is fits[0].parameter_values) == first
            return [one if i < count or not mine else None for i, one in enumerate(out)]

        monkeypatch.setattr(budget_steps, "refit_without_regions", some)
        return jackknife_explained_fraction(BudgetSteps(fits, (0,), (), 1), judges, floor)

    masks = [
        assign_folds(judges.training_measurements, JACKKNIFE_GROUP_COUNT) == number
        for number in range(JACKKNIFE_GROUP_COUNT)
    ]
    states = [plain(fit.estimator, fit.parameter_values, masks, 0) for fit in fits]
    shares = [share(pair) for pair in zip(*states, strict=True)]  # type: ignore[arg-type]
    for count in (3, 6):
        expected = (count - 1) * np.var(shares[:count])
        for first in (True, False):
            assert_allclose(kept(count, first), expected, rtol=1e-9)
    assert kept(2, True) == 0.0
