"""Parts left out, folds, intervals, spans and floors: what is claimed of poses not measured."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import stats

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.core.files import convert_to_plain_json
from minimax_cal.fitting import region_holdout
from minimax_cal.fitting.accuracy import (
    Interval,
    bootstrap_rms_interval,
    exceedance_probability,
    interval_for_display,
    predict_max_error_interval,
    sample_largest_normals,
    summarise_point_errors,
)
from minimax_cal.fitting.cross_validation import MIN_HELD_POSES
from minimax_cal.fitting.joint_spans import (
    is_outside_narrow_spans,
    measure_joint_spans,
    min_joint_span,
    robust_span_width,
    select_narrow_spans,
)
from minimax_cal.fitting.noise_floor import (
    AT_MOST,
    DECLARED,
    DISTANCES,
    REPEATS,
    RMS_TO_REPEATABILITY_RATIO,
    NoiseFloor,
    declared_noise_mm,
    estimate_noise_floor,
    floor_from_distances,
    instrument_coordinate_sigma,
    parse_instrument_accuracy,
    rms_mm_from_coordinate_sigma,
    with_u95_of_instrument,
)
from minimax_cal.fitting.region_holdout import (
    is_region_needed,
    one_step_without_regions,
    refit_without_regions,
    step_without_poses,
    unidentified_without_poses,
)
from minimax_cal.fitting.uncertainty import PosewiseFit
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.measuring.pose_groups import list_holdout_regions
from minimax_cal.modelling.point_model import apply_active_step
from minimax_cal.modelling.simulate import Simulation, Truth, simulate

# ---- beyond --------------------------------------------------------------------------------------


@pytest.mark.parametrize("objective", ["sum", "smr:2"])
def test_a_part_is_judged_by_a_fit_without_it(robot, noisy, objective):
    fit = mc.calibrate(robot, noisy.data, objective, holdout=0.0)
    found = fit.beyond
    fold = found.folds[0]
    part = next(p for p in list_holdout_regions(fit.data) if p.name == fold.where)
    labels = np.where(part.rows, "holdout", "train")
    columns = {**noisy.data.columns, "split": labels}
    fresh = mc.calibrate(robot, replace(noisy.data, columns=columns), objective)
    # one step of Gauss and Newton against the whole search
    assert_allclose(fold.rms_mm, fresh.accuracy["holdout"].rms_mm, rtol=5e-3)
    assert fold.poses == part.rows.sum()
    poses, rms = np.array([(each.poses, each.rms_mm) for each in found.folds]).T
    assert_allclose(found.typical_mm**2, (poses * rms**2).sum() / poses.sum(), rtol=1e-12)
    assert found.worst_mm == found.worst.rms_mm == max(rms)
    assert len(found.spans) == 6
    assert (found.narrow_spans, convert_to_plain_json(found)["plan"]) == ((), None)


def test_effects_stand_beside_geometry_alone(robot):
    soft = simulate(robot, 80, truth=Truth(compliance=2e-6)).data
    fit = mc.calibrate(robot, soft, "sum", effects=("joint_compliance:all",))
    plain = mc.calibrate(robot, soft, "sum")
    assert fit.beyond.typical_mm < 0.6 * fit.beyond.geometric_typical_mm
    shared = {fold.where: fold.rms_mm for fold in plain.beyond.folds}
    assert [fold.where for fold in fit.beyond.folds] == list(shared)  # an effect costs no part
    for fold in fit.beyond.folds:
        assert_allclose(fold.geometric_mm, shared[fold.where], rtol=5e-3)


def test_a_fit_that_extrapolates_badly_says_so(robot):
    """An arm whose second joint has a gear error: regions miss by more than poses between."""
    rng = np.random.default_rng(3)
    ideal = simulate(robot, 300, seed=5)
    wave = 1e-3 * np.sin(2.0 * ideal.data.q[:, 1] + rng.uniform(0, 6))
    bent = ideal.data.q + wave[:, None] * np.eye(6)[1]
    data = ideal.data.with_y(ideal.cell.predict(bent))
    fit = mc.calibrate(robot, data, "sum")
    assert fit.beyond.worst_mm > 1.3 * fit.accuracy["holdout"].rms_mm
    assert "joint 2" in fit.beyond.worst.where


def one_end(robot: mc.Robot, poses: int = 40, half: float = 0.6) -> Measurements:
    """A last joint that turns a little about zero, but for four poses at its high end."""
    rng, ideal = np.random.default_rng(5), simulate(robot, poses, seed=5)
    q = ideal.data.q.copy()
    q[:, 5] = rng.uniform(-half, half, poses)
    q[:4, 5] = rng.uniform(2.0, 2.6, 4)
    noise = 2e-5 * rng.normal(size=ideal.data.y.shape)
    return replace(ideal.data, q=q).with_y(ideal.cell.predict(q) + noise)


def test_parts_that_effects_alone_need_are_judged_as_a_calibration_of_the_rest_would(robot):
    """Without one end of joint 6 its gear's harmonics are not told: the rest gives them up."""
    data, gear = one_end(robot), ("gear_error:J6:orders=3",)
    fit = mc.calibrate(robot, data, "sum", effects=gear)
    lost = PosewiseFit(fit.estimator, fit.cell.parameter_values)
    every = {part.name: part.rows for part in list_holdout_regions(fit.data)}
    assert [fold.where for fold in fit.beyond.folds] == list(every)
    assert fit.beyond.missed == ()
    asked = [
        fold for fold in fit.beyond.folds if is_region_needed(lost, every[fold.where][~fit.held])
    ]
    assert "joint 6 at its high end" in [fold.where for fold in asked]
    for fold in asked:
        rows = every[fold.where]
        labels = {"split": np.where(rows | fit.held, "holdout", "train")}
        again = mc.calibrate(robot, replace(data, columns=labels), "sum", effects=gear)
        error = again.cell.error(again.data)[rows]
        assert_allclose(fold.rms_mm, 1e3 * np.sqrt((error**2).sum(axis=-1).mean()), rtol=0.01)
    assert "with the same effects" in fit.headline()
    assert fit.within.missed == 0
    assert "40 poses, each judged" in fit.headline()


def test_parts_that_none_can_judge_are_counted_and_named(robot):
    """Joint 6 stands still but at a few poses, which geometry cannot do without."""
    ideal = simulate(robot, 60, seed=5)
    q = ideal.data.q.copy()
    q[:, 5] = np.random.default_rng(5).uniform(-0.02, 0.02, 60)
    q[:8, 5] += 2.0
    data = replace(ideal.data, q=q).with_y(ideal.cell.predict(q))
    found = mc.calibrate(robot, data, "sum", holdout=0.0).beyond
    assert found.missed
    made = len(found.folds) + len(found.missed)
    assert (
        f"{len(found.folds)} of {made} parts (the fit needs the others) left out"
        in found.sentence()
    )
    assert found.table().rows[-1][0] == f"{len(found.folds)} of {made} parts"
    assert convert_to_plain_json(found)["not_judged"] == list(found.missed)
    assert convert_to_plain_json(found)["effects_sought_anew"] is None


@pytest.mark.parametrize("seed", [2, 5])
def test_no_part_left_out_makes_a_joint_yield_upwards(seed, monkeypatch):
    """Compliances near 0: one step from the whole fit would go below in some parts."""
    found, steps, plain = [], [], region_holdout.fit_remaining_poses

    def looked(poses: PosewiseFit, part: Array, gone: Array) -> Any:
        found.append(plain(poses, part, gone))
        steps.append(
            apply_active_step(poses.estimator.model, poses.state, step_without_poses(poses, part))
        )
        return found[-1]

    monkeypatch.setattr(region_holdout, "fit_remaining_poses", looked)
    sim = simulate("irb120", 40, 3, seed=seed, truth=Truth(compliance=1e-6))
    mc.calibrate("irb120", sim.data, "sum", effects=["joint_compliance:all"])
    compliances = [
        (one.effects, each.effects) for one, each in zip(found, steps, strict=True) if one
    ]
    assert any((step < 0.0).any() for _, step in compliances)
    assert all((one >= 0.0).all() for one, _ in compliances)


# ---- joints that hardly moved ------------------------------------------------------------------


def with_spans(robot: mc.Robot, joints: Sequence[int], degrees: float) -> Simulation:
    """60 poses of an arm with geometric errors, of which some joints went so far alone."""
    ideal = simulate(robot, 60, 3, seed=2, truth=Truth(compliance=0))
    q, rng = ideal.data.q.copy(), np.random.default_rng(102)
    for joint in joints:
        q[:, joint] = np.median(q[:, joint]) + np.radians(degrees) * rng.uniform(-0.5, 0.5, len(q))
    noise = 2e-5 * rng.normal(size=ideal.data.y.shape)
    return replace(ideal, data=replace(ideal.data, q=q).with_y(ideal.cell.predict(q) + noise))


def rms_mm(arm: mc.Fit, made: Simulation, q: Array) -> float:
    """Of the targets at joints where the truth is known."""
    off = arm.predict(q) - made.cell.predict(q)
    return float(1e3 * np.sqrt((off**2).sum(axis=-1).mean()))


@pytest.mark.parametrize(
    ("joints", "degrees", "narrow"),
    [((0, 1, 2), 0.0, ["J1", "J2", "J3"]), (range(6), 2.6, ["J1", "J2", "J3", "J4", "J5", "J6"])],
)
def test_nothing_is_claimed_outside_what_joints_spanned(robot, joints, degrees, narrow):
    made = with_spans(robot, joints, degrees)
    fit = mc.calibrate(robot, made.data, "sum")
    content = fit.to_dict()["accuracy"]["beyond"]
    assert (content["typical_mm"], content["worst_mm"], content["worst_where"]) == (None,) * 3
    assert content["narrow"] == narrow
    for name in narrow:
        assert f"joint {name[1:]} spans" in content["reason"]
    assert content["plan"] in content["reason"]
    assert content["plan"].startswith("minimax-cal plan ROBOT --poses ")
    said = "Outside the measured region nothing is claimed: joint 1 spans"
    assert said in fit.headline()
    # the claim inside stays, and is true; fresh poses elsewhere are far worse
    inside = fit.within.after.rms_mm
    assert 0.0 < inside < 0.06
    anywhere = simulate(robot, 200, seed=2).data.q
    assert rms_mm(fit, made, anywhere) > 5.0 * inside
    assert rms_mm(fit, made, made.data.q) < inside


def test_what_joints_spanned_survives_the_file(robot):
    fit = mc.calibrate(robot, with_spans(robot, (0,), 3.0).data, "sum")
    again = mc.Fit.from_dict(fit.to_dict())
    assert again.beyond == fit.beyond
    assert again.spans == fit.spans == fit.beyond.spans
    bare = mc.Fit.from_dict(fit.to_dict(poses=False))
    assert bare.spans == fit.spans


@pytest.mark.slow
def test_the_plan_that_is_offered_mends_it(robot):
    made = with_spans(robot, (0, 1, 2), 0.0)
    fit = mc.calibrate(robot, made.data, "sum")
    words = fit.beyond.plan.split()
    proposed = mc.plan(robot, poses=int(words[words.index("--poses") + 1]), candidates=150)
    rng = np.random.default_rng(0)
    y = made.cell.predict(proposed.q)
    data = measurements(proposed.q, y + 2e-5 * rng.normal(size=y.shape))
    mended = mc.calibrate(robot, data, "sum")
    assert mended.beyond.worst is not None
    anywhere = simulate(robot, 200, seed=2).data.q
    assert rms_mm(mended, made, anywhere) < mended.beyond.worst_mm


# ---- crossed -------------------------------------------------------------------------------------


ONE_STEP = 0.02  # of an error's size: a fit without a fold is one Gauss-Newton step away


def test_every_pose_is_judged_by_a_fit_without_it(robot, noisy):
    """One held-out pose each, so that a fold's own fit can be had by `split`."""
    fit = mc.calibrate(robot, noisy.data, "sum", cv=True, seed=3)
    held = fit.error_crossed[fit.held]
    assert_allclose(held, fit.errors["holdout"], rtol=0, atol=1e-12)
    folds = np.random.default_rng(3).permutation(48) % 10
    for number in (0, 7):
        rows = np.flatnonzero(~fit.held)[_by_group(fit, folds) == number]
        label = np.where(np.isin(np.arange(60), rows) | fit.held, "holdout", "train")
        other = mc.Measurements(**{**vars(noisy.data), "columns": {"split": label}})
        again = mc.calibrate(robot, other, "sum").cell.error(noisy.data.take(rows))
        assert_allclose(
            summarise_point_errors(fit.error_crossed[rows]).rms_mm,
            summarise_point_errors(again).rms_mm,
            rtol=ONE_STEP,
        )


def _by_group(fit: mc.Fit, folds: np.ndarray) -> np.ndarray:
    """(training poses,) the fold of each, by the order of its joints."""
    from minimax_cal.measuring.pose_groups import cluster_poses

    group = cluster_poses(fit.data)
    return folds[np.searchsorted(np.unique(group[~fit.held]), group[~fit.held])]


def test_few_held_out_poses_are_cross_validated(robot):
    few, many = (simulate(robot, count, 3, seed=5).data for count in (60, 100))
    told = mc.calibrate(robot, few, "sum")
    assert told.accuracy["holdout"].poses < MIN_HELD_POSES
    assert any("the result is cross-validated" in notice for notice in told.notices)
    assert "60 poses, each judged by a fit without it" in told.headline()
    assert_allclose(
        told.within.after.rms_mm, summarise_point_errors(told.error_crossed).rms_mm, rtol=1e-12
    )
    plain = mc.calibrate(robot, many, "sum")
    assert not plain.error_crossed.size
    assert "20 poses that were not used for the fit" in plain.headline()
    again = mc.Fit.from_dict(told.to_dict())
    assert again.within == told.within
    assert told.to_dict()["accuracy"]["cv"]["poses"] == 60
    # the truth of a random hold-out stays where it was
    assert told.to_dict()["accuracy"]["holdout"]["poses"] == 12


def test_too_few_poses_are_a_loud_warning(robot):
    """8 training poses of 3 targets tell 48 numbers, for 33 parameters."""
    data = simulate(robot, 10, 3, seed=5).data
    with pytest.warns(mc.CalibrationWarning, match="too few poses: 8 training poses tell 48"):
        fit = mc.calibrate(robot, data, "sum")
    said = next(notice for notice in fit.notices if notice.startswith("too few poses"))
    assert "for 33 free parameters" in said
    assert "measure at 17 poses or more" in said
    held, train = fit.accuracy["holdout"].rms_mm, fit.accuracy["train"].rms_mm
    assert held > 1.5 * train


# ---- intervals -----------------------------------------------------------------------------------


RUNS = 200
CHANCE = 3.3 * np.sqrt(0.95 * 0.05 / RUNS)  # one test in a thousand fails by chance


def rng_of(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def both(error: Array, seed: int = 0) -> Array:
    """Ends of both intervals, (4,)."""
    out = [f(error, rng=rng_of(seed)) for f in (bootstrap_rms_interval, predict_max_error_interval)]
    return np.array([end for interval in out for end in (interval.low, interval.high)])


@settings(max_examples=40)
@given(st.integers(3, 40), st.integers(1, 4), st.floats(1e-7, 1e3), st.integers(0, 99))
def test_intervals_scale_with_the_errors(m, k, size, seed):
    error = rng_of(seed).normal(size=(m, k, 3))
    low, high, least, most = both(error)
    rms = np.sqrt((error**2).sum(-1).mean())
    assert 0.0 < low < rms < high
    assert 0.0 < least < most
    assert_allclose(both(size * error), size * np.array([low, high, least, most]), rtol=1e-9)


def test_targets_of_a_pose_are_no_further_poses(rng):
    error = rng.normal(size=(20, 1, 3))
    assert_allclose(both(np.repeat(error, 3, axis=1)), both(error), rtol=1e-12)


def test_what_was_not_measured_does_not_count(rng):
    error = rng.normal(size=(20, 3, 3))
    error[::2, 1] = np.nan
    padded = np.concatenate([error, np.full((7, 3, 3), np.nan)])
    assert_allclose(both(padded), both(error), rtol=1e-12)
    turned = error[:, ::-1] @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    assert_allclose(both(turned), both(error), rtol=1e-9)


def test_too_few_poses_tell_nothing():
    for m in range(3):
        assert np.isnan(both(np.ones((m, 2, 3)))).all()
    assert bootstrap_rms_interval(np.zeros((5, 1, 3)), rng=rng_of()) == Interval(0.0, 0.0)
    assert predict_max_error_interval(np.zeros((5, 1, 3)), rng=rng_of()) == Interval(0.0, 0.0)


@pytest.mark.parametrize(("m", "zero"), [(12, 6), (7, 6), (400, 399)])
def test_exact_zeros_are_the_smallest_errors(m, zero):
    """Bootstrap samples may hold nothing but zeros: no warning, and the ends of tiny errors."""
    error = rng_of(5).normal(size=(m, 1, 3))
    error[:zero] = 0.0
    found, tiny = (
        bootstrap_rms_interval(errors, rng=rng_of())
        for errors in (error, np.where(error == 0.0, 1e-12, error))
    )
    rms = np.sqrt((error**2).sum() / m)
    assert 0.0 < found.low < rms < found.high
    assert_allclose([found.low, found.high], [tiny.low, tiny.high], rtol=1e-9)
    assert np.isnan(interval_for_display(found, rms).high) == (
        m == zero + 1
    )  # one pose is all of the error


def test_an_upper_end_of_the_law_alone_is_not_told():
    """Seven poses of which one is nearly all of the error: no sample without it tells anything."""
    error = np.zeros((7, 1, 3))
    error[:, 0, 0] = [2.09, 0.31, 0.35, 0.4, 0.29, 0.38, 0.33]
    for interval, seen in (
        (bootstrap_rms_interval, np.sqrt((error**2).sum() / 7)),
        (predict_max_error_interval, 2.09),
    ):
        found = interval(error, rng=rng_of())
        assert found.high > 10.0 * seen
        assert interval_for_display(found, seen).low == found.low
        assert np.isnan(interval_for_display(found, seen).high)
    for end, said in ((2.0, 2.0), (0.9, 1.0)):  # never below what was seen
        assert interval_for_display(Interval(0.5, end), 1.0) == Interval(0.5, said)


@settings(max_examples=40, deadline=None)
@given(st.integers(3, 30), st.data())
def test_exact_poses_count_as_nearly_exact_ones(m, data):
    """Bootstrap samples of exact poses alone have no logarithm; the limit of small errors does."""
    exact = data.draw(st.integers(1, m - 1))
    error = rng_of(m).normal(size=(m, 2, 3))
    error[:exact] = 0.0
    low, high, least, most = found = both(error)
    assert 0.0 < low <= np.sqrt((error**2).sum(-1).mean()) <= high < np.inf
    assert 0.0 < least <= most < np.inf
    error[:exact] = 1e-9
    assert_allclose(both(error), found, rtol=1e-6)


def test_many_normal_errors_give_the_chi_square_interval(rng):
    """3m normal coordinates of one variance: its exact interval, within 10 % of its width."""
    error = rng.normal(size=(2000, 1, 3))
    found = bootstrap_rms_interval(error, rng=rng_of())
    total, free = float((error**2).sum()), 6000
    exact = np.sqrt(total / stats.chi2.ppf([0.975, 0.025], free) * 3.0)
    assert_allclose([found.low, found.high], exact, rtol=0, atol=0.1 * np.ptp(exact))


def test_a_wider_level_is_wider(rng):
    error = rng.normal(size=(12, 3, 3))
    for interval in (bootstrap_rms_interval, predict_max_error_interval):
        wide, narrow = (interval(error, level=v, rng=rng_of()) for v in (0.99, 0.8))
        assert wide.low < narrow.low < narrow.high < wide.high


# Known shortfall of each law at these numbers of poses, from 1500 samples each: the method is no
# better on few skew squares.
LAWS = {
    "tracker noise": (lambda rng, n: rng.chisquare(3, n), 3.0, 10, 0.01),
    "one axis": (lambda rng, n: rng.chisquare(1, n), 1.0, 20, 0.01),
    "skew": (lambda rng, n: np.exp(0.7 * rng.normal(size=n)), np.exp(0.245), 40, 0.015),
    "half exact": (lambda rng, n: rng.chisquare(3, n) * rng.integers(0, 2, n), 1.5, 20, 0.01),
    "very skew": (lambda rng, n: np.exp(rng.normal(size=n)), np.exp(0.5), 20, 0.03),
}


@pytest.mark.parametrize("name", LAWS)
def test_the_rms_interval_covers(name):
    """95 % less the known shortfall, within 3.3 standard deviations of the number of runs."""
    law, mean, poses, loss = LAWS[name]
    rng, held = rng_of(1), 0
    for _ in range(RUNS):
        error = np.zeros((poses, 1, 3))
        error[:, 0, 1] = np.sqrt(law(rng, poses))
        found = bootstrap_rms_interval(error, rng=rng)
        held += found.low <= np.sqrt(mean) <= found.high
    assert 0.95 - loss - CHANCE < held / RUNS < 0.95 + loss + CHANCE


@pytest.mark.parametrize(("name", "poses"), [("exact", 10), ("exact", 40), ("tracker", 20)])
def test_the_largest_of_new_poses_is_covered(name, poses):
    """Lognormal distances: 95 %.  Lighter tails, as of noise: up to 3 % more."""
    rng, held = rng_of(2), 0
    for _ in range(RUNS):
        if name == "exact":
            distance = np.exp(0.6 * rng.normal(size=2 * poses))
        else:
            distance = np.sqrt(rng.chisquare(3, 2 * poses))
        error = np.zeros((poses, 1, 3))
        error[:, 0, 2] = distance[:poses]
        found = predict_max_error_interval(error, rng=rng)
        held += found.low <= distance[poses:].max() <= found.high
    more = 0.0 if name == "exact" else 0.03
    assert 0.95 - CHANCE < held / RUNS < 0.95 + more + CHANCE


def test_chance_of_a_larger_error_is_free_of_the_law(rng):
    """The next of n + 1 is the largest as often as any other; 4 standard deviations."""
    runs, n = 20000, 14
    for sample in (rng.standard_cauchy((runs, n + 1)), rng.uniform(size=(runs, n + 1))):
        share = float(np.mean(sample[:, n] > sample[:, :n].max(axis=1)))
        p_value = exceedance_probability(n)
        assert abs(share - p_value) < 4.0 * np.sqrt(p_value / runs)


def test_the_search_goes_on_where_one_step_does_not_arrive(robot):
    data = one_end(robot, 36, half=0.5)
    effects = ("gear_error:J5:orders=3", "gear_error:J6:orders=3")
    fit = mc.calibrate(robot, data, "sum", effects=effects)
    estimator, state = fit.estimator, fit.cell.parameter_values
    poses, far = PosewiseFit(estimator, state), 0
    effects_of = np.flatnonzero(estimator.model.active) >= estimator.model.names.geometric_count
    for part in (part.rows[~fit.held] for part in list_holdout_regions(fit.data)):
        near = apply_active_step(estimator.model, state, step_without_poses(poses, part))
        sums = poses.sums_by_part([part])
        if unidentified_without_poses(poses, sums.gram[0], effects_of).any():
            continue
        if one_step_without_regions(poses, [part], sums, np.ones(1, dtype=bool)):
            continue
        far += 1
        (found,) = refit_without_regions(estimator, state, [part], 0)
        assert found is not None
        there = PosewiseFit(estimator, found)
        step, more = (
            step_without_poses(there, part),
            step_without_poses(PosewiseFit(estimator, near), part),
        )
        motion, left = (float(one @ there.normal_matrix @ one) for one in (step, more))
        assert motion < 1e-6 * left  # a further step leads nowhere
    assert far


def test_the_largest_of_normal_samples_follow_their_law():
    """The largest of n has the distribution Phi^n; all of n sorted are a normal sample."""
    top = sample_largest_normals(12, 5, rng_of(3))
    assert np.all(np.diff(top, axis=1) < 0.0)
    assert stats.kstest(stats.norm.cdf(top[:, 0]) ** 12, "uniform").pvalue > 1e-3
    fifth = stats.beta(12 - 4, 5)  # the fifth largest of 12 uniform numbers
    assert stats.kstest(fifth.cdf(stats.norm.cdf(top[:, 4])), "uniform").pvalue > 1e-3
    every = sample_largest_normals(6, 6, rng_of(4)).reshape(-1)
    assert abs(every.mean()) < 4.0 / np.sqrt(len(every))
    assert abs(every.var() - 1.0) < 4.0 * np.sqrt(2.0 / len(every))


# ---- accuracy ------------------------------------------------------------------------------------


# Two targets at three poses [m]; distances 5, 0, - and 1, 2, 2 mm.
ERROR = 1e-3 * np.array(
    [
        [[3.0, 0.0, 4.0], [0.0, 1.0, 0.0]],
        [[0.0, 0.0, 0.0], [0.0, 0.0, -2.0]],
        [[np.nan] * 3, [2.0, 0.0, 0.0]],
    ]
)


def test_all_points_and_each_target():
    found = summarise_point_errors(ERROR)
    assert found.rms_mm == pytest.approx(math.sqrt(34.0 / 5.0), rel=1e-14)
    assert (found.max_mm, found.mean_mm) == pytest.approx((5.0, 2.0), rel=1e-14)
    assert (found.poses, found.counts, found.worst) == (3, (2, 3), (0, 0))
    assert found.sse_mm2 == pytest.approx((25.0, 9.0), rel=1e-14)
    assert found.rms_by_target() == pytest.approx((math.sqrt(12.5), math.sqrt(3.0)), rel=1e-14)
    one, other, every = found.table("title", ("smr1", "smr2")).rows
    assert one[:3] == ("smr1", 2, pytest.approx(math.sqrt(12.5)))
    assert other[:3] == ("smr2", 3, pytest.approx(math.sqrt(3.0)))
    assert one[3:5] == pytest.approx((2.5, 5.0), rel=1e-14)
    assert other[3:5] == pytest.approx((5.0 / 3.0, 2.0), rel=1e-14)
    assert every == ("all", 5, found.rms_mm, found.mean_mm, found.max_mm, pytest.approx(34.0))


def test_no_point_is_no_number():
    found = summarise_point_errors(np.full((0, 2, 3), np.nan))
    assert (found.poses, found.counts, found.worst) == (0, (0, 0), (-1, -1))
    assert all(map(math.isnan, (found.rms_mm, found.max_mm, *found.rms_by_target())))


# ---- spans ---------------------------------------------------------------------------------------


def data_of(q: np.ndarray) -> Measurements:
    return measurements(q, np.arange(3.0 * len(q)).reshape(-1, 1, 3) / 1e3)


@pytest.fixture
def free(robot: mc.Robot) -> mc.Robot:
    """Without limits."""
    return replace(robot, lower=np.full(6, -np.inf), upper=np.full(6, np.inf))


@pytest.mark.parametrize(("size", "count"), [(9.0, 6), (11.0, 0), (0.0, 6)])
def test_a_joint_that_spans_less_than_ten_degrees_is_narrow(free, size, count):
    q = np.radians(size) * np.linspace(0.0, 1.0, 400)[:, None] + np.zeros(6)
    assert len(select_narrow_spans(measure_joint_spans(free, data_of(q)))) == count


def test_a_slide_needs_twenty_millimetres(free):
    slides = replace(free, prismatic=np.arange(6) == 0)
    q = np.linspace(0.0, 1.0, 400)[:, None] * [0.019, 1.0, 1.0, 1.0, 1.0, 1.0]
    (few,) = select_narrow_spans(measure_joint_spans(slides, data_of(q)))
    assert (few.joint, few.unit, few.least) == ("J1", "mm", 20.0)
    assert few.high == pytest.approx(19.0)
    assert not select_narrow_spans(measure_joint_spans(slides, data_of(1.2 * q)))


@pytest.mark.parametrize(
    ("size", "least"),
    [
        (np.inf, 10.0),
        (180.0, 10.0),
        (360.0, 18.0),
        (12.0, 6.0),
    ],  # 5 %, or half of a short one
)
def test_the_range_of_a_joint_counts(free, size, least):
    half = np.full(6, np.radians(size) / 2.0)
    limited = replace(free, lower=-half, upper=half)
    assert np.degrees(min_joint_span(limited, 0)) == pytest.approx(least)


def test_one_or_two_poses_elsewhere_make_no_span():
    assert robust_span_width(np.array([0.0, 0.0, 0.0, 0.0, 2.0, 3.0])) == 0.0
    assert robust_span_width(np.array([0.0, 0.0, 0.0, 3.0, 3.0, 3.0])) == 3.0
    assert robust_span_width(np.zeros(2)) == robust_span_width(np.zeros(0)) == 0.0


def test_poses_that_nothing_measured_do_not_count(free):
    q = np.zeros((40, 6))
    q[:20, 0] = np.linspace(0.0, 2.0, 20)
    whole = data_of(q)
    y = whole.y.copy()
    y[:20] = np.nan
    assert "J1" not in [
        span.joint for span in select_narrow_spans(measure_joint_spans(free, whole))
    ]
    assert "J1" in [
        span.joint for span in select_narrow_spans(measure_joint_spans(free, whole.with_y(y)))
    ]


def test_outside_is_where_a_narrow_joint_was_not(free, rng):
    q = rng.uniform(-1.0, 1.0, (50, 6))
    q[:, 2] = 0.3
    spans = measure_joint_spans(free, data_of(q))
    asked = np.array([q[0], q[0], q[0], q[0]])
    asked[1, 2], asked[2, 0], asked[3, 2] = 0.35, 3.0, 0.305  # 5 mrad are no move
    assert is_outside_narrow_spans(spans, asked).tolist() == [False, True, False, False]
    assert not is_outside_narrow_spans((), asked).any()


# ---- floor ---------------------------------------------------------------------------------------


SIGMA = 1e-5


def visited(
    rng: np.random.Generator, times: int, poses: int = 200
) -> tuple[Measurements, np.ndarray]:
    """Poses visited several times, and errors of three targets."""
    q = np.repeat(rng.uniform(-2.0, 2.0, (poses, 6)), times, axis=0)
    q += 1e-5 * rng.normal(size=q.shape)
    error = SIGMA * rng.normal(size=(len(q), 3, 3))
    error += 1e-3 * np.repeat(rng.normal(size=(poses, 3, 3)), times, axis=0)  # of the model
    return mc.measurements(q, error), error


@pytest.mark.parametrize("times", [2, 3, 5])
def test_visits_tell_the_noise_whatever_the_model(rng, times):
    data, error = visited(rng, times)
    found = estimate_noise_floor(data, error, np.nan, 10.0)
    assert found.source == REPEATS
    # 600 to 3000 squares of three coordinates; a median is a little less sure than a mean
    assert_allclose(found.value, 1e3 * np.sqrt(3.0) * SIGMA, rtol=0.06)
    assert found.low < 1e3 * np.sqrt(3.0) * SIGMA < found.high


def test_a_few_wrong_visits_do_not_set_the_floor(rng):
    data, error = visited(rng, 2)
    error[:20] += 2e-3 * rng.normal(size=(20, 3, 3))
    found = estimate_noise_floor(data, error, np.nan, 10.0)
    assert found.source == REPEATS
    assert_allclose(found.value, 1e3 * np.sqrt(3.0) * SIGMA, rtol=0.12)


def test_without_visits_or_promises_the_fit_tells_at_most(rng):
    q = rng.uniform(-2.0, 2.0, (30, 6))
    data = mc.measurements(q, rng.normal(size=(30, 1, 3)))
    error = SIGMA * rng.normal(size=(30, 1, 3))
    assert estimate_noise_floor(data, error, np.nan, 0.3) == NoiseFloor(0.3, 0.0, 0.3, AT_MOST)
    assert estimate_noise_floor(data, error, 1e-4, 0.3) == NoiseFloor(0.3, 0.0, 0.3, AT_MOST)
    assert estimate_noise_floor(data, error, 1e-3, 0.3) == NoiseFloor(0.3, 0.0, 0.3, AT_MOST)
    told = estimate_noise_floor(with_u95_of_instrument(data, "0.0392mm"), error, 1e-4, 0.3)
    assert told.source == DECLARED
    both = np.hypot(np.sqrt(3.0) * 0.0392 / 1.959964, 0.1 * RMS_TO_REPEATABILITY_RATIO)
    assert_allclose(told.value, both, rtol=1e-6)
    assert told.low < told.value


def test_no_floor_is_above_what_a_model_leaves():
    assert NoiseFloor(1.79, 0.0, 1.79, AT_MOST).limited_by_error(0.273) == NoiseFloor(
        0.273, 0.0, 0.273, AT_MOST
    )
    assert NoiseFloor(0.1, 0.05, 0.4, REPEATS).limited_by_error(0.3) == NoiseFloor(
        0.1, 0.05, 0.3, REPEATS
    )


def test_repeatability_is_mean_and_three_deviations(rng):
    distance = np.linalg.norm(rng.normal(size=(400_000, 3)), axis=1)
    promise = distance.mean() + 3.0 * distance.std()
    assert_allclose(np.sqrt((distance**2).mean()) / promise, RMS_TO_REPEATABILITY_RATIO, rtol=3e-3)


def test_a_floor_is_drawn_between_its_ends(rng):
    known = NoiseFloor(0.02, 0.018, 0.023, REPEATS).sample_values_mm(20_000, rng)
    assert_allclose(np.quantile(known, [0.025, 0.5, 0.975]), [0.018, 0.02, 0.023], rtol=0.01)
    loose = NoiseFloor(0.1, 0.0, 0.1, AT_MOST)
    assert loose.lower_limit_mm == 0.0
    assert_allclose(loose.sample_values_mm(20_000, rng).mean(), 0.05, rtol=0.02)


@pytest.mark.parametrize(
    ("text", "base", "more"),
    [("10um+2.5um/m", 1e-5, 2.5e-6), ("0.05mm", 5e-5, 0.0), (" 15 um + 6 um/m", 1.5e-5, 6e-6)],
)
def test_an_instrument_in_words(text, base, more):
    told = parse_instrument_accuracy(text)
    assert_allclose([told.base, told.per_metre], [base, more], rtol=1e-12)


@pytest.mark.parametrize("text", ["", "10", "10 parsec", "1.2.3um", "0um", "5um+3um", "2 m"])
def test_an_instrument_that_is_none(text):
    with pytest.raises(mc.OptionError, match=r"10um\+2.5um/m"):
        parse_instrument_accuracy(text)


def test_a_column_counts_more_than_the_option(rng):
    y = rng.normal(size=(5, 2, 3))
    bare = mc.measurements(rng.normal(size=(5, 6)), y)
    filled = with_u95_of_instrument(bare, "10um+2um/m")
    far = np.linalg.norm(y, axis=-1).mean(axis=1)
    assert_allclose(filled.columns["u95"], 1e-5 + 2e-6 * far, rtol=1e-12)
    kept = with_u95_of_instrument(mc.measurements(bare.q, y, u95=np.full(5, 3e-5)), "10um+2um/m")
    assert_allclose(kept.columns["u95"], 3e-5)
    assert "column u95_mm is used" in kept.notices[-1]
    assert declared_noise_mm(bare, np.nan) is None
    assert np.isnan(instrument_coordinate_sigma(bare))
    assert_allclose(
        instrument_coordinate_sigma(kept), 3e-5 / 1.959964, rtol=1e-6
    )  # of a coordinate


def test_a_fit_that_leaves_a_little_less_contradicts_no_distance():
    """What distances tell has an interval; what a fit leaves at most may be inside of it."""
    sigma, sure = 17e-6, 0.05
    told = rms_mm_from_coordinate_sigma(sigma)
    for most, source in ((1.2 * told, DISTANCES), (0.97 * told, DISTANCES), (0.8 * told, AT_MOST)):
        floor = floor_from_distances((sigma, sure), np.nan, np.nan, most)
        assert floor.source == source
        assert floor.low <= floor.value <= floor.high <= most
        assert floor.value == min(told, most)
