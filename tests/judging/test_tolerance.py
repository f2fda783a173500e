"""Passed, not passed, not stated: by the upper 95 % limit, and never by too few poses."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.fitting.cell_fit import fit_cell
from minimax_cal.fitting.options import silent_progress
from minimax_cal.fitting.region_holdout import RegionError, RegionHoldout
from minimax_cal.fitting.uncertainty import Estimator
from minimax_cal.measuring.pose_groups import group_repeated_poses
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointLeastSquares, with_pose_errors
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.solvers import least_squares
from minimax_cal.validation.bootstrap import (
    Bootstrap,
    PoseDraws,
    bootstrap,
    draw_poses,
    is_draw_determined,
    parameter_step,
    refit_by_gauss_newton_steps,
    refit_minimax_replicates,
)
from minimax_cal.validation.tolerance import (
    MIN_POSES_FOR_MAXIMUM,
    NOT_PASSED,
    NOT_STATED,
    PASSED,
    AccuracyClaim,
    ErrorBound,
    ToleranceLimit,
    build_outside_claim,
    describe_other_claim,
    judge_limit_by_claim,
    overall_verdict,
    parse_tolerance_limits,
)

# ---- tolerance -----------------------------------------------------------------------------------


def claim(poses: int, value: float = 0.1, high: float = 0.15) -> AccuracyClaim:
    return AccuracyClaim(
        "inside", ErrorBound(value, high), ErrorBound(3 * value, 3 * high), poses, "some poses"
    )


@pytest.mark.parametrize(
    ("poses", "value", "high", "limit", "verdict"),
    [
        (20, 0.10, 0.15, 0.16, PASSED),
        (20, 0.10, 0.15, 0.15, NOT_PASSED),  # under the limit, not equal to it
        (20, 0.10, 0.15, 0.12, NOT_PASSED),  # the value is under it, its 95 % limit is not
        (20, 0.10, 0.15, 0.05, NOT_PASSED),
        (2, 0.10, math.nan, 0.2, NOT_STATED),
        (2, 0.30, math.nan, 0.2, NOT_PASSED),  # seen is seen
    ],
)
def test_rms(poses, value, high, limit, verdict):
    assert (
        judge_limit_by_claim(ToleranceLimit("rms", limit), claim(poses, value, high)).verdict
        == verdict
    )


def test_a_maximum_needs_poses_and_says_how_many():
    """The next pose exceeds all n so far with probability 1/(n + 1): at most 5 % from 19 on."""
    assert MIN_POSES_FOR_MAXIMUM == 19
    few, enough = (judge_limit_by_claim(ToleranceLimit("max", 1.0), claim(n)) for n in (18, 19))
    assert few.verdict == NOT_STATED
    assert "18 poses are too few for a maximum: at least 19 are needed" in few.why
    assert enough.verdict == PASSED
    assert (
        judge_limit_by_claim(ToleranceLimit("max", 0.2), claim(5)).verdict == NOT_PASSED
    )  # 0.3 was seen


def test_all_together():
    limits = ToleranceLimit("rms", 1.0), ToleranceLimit("rms", 0.01), ToleranceLimit("max", 1.0)
    good, bad, open_ = (judge_limit_by_claim(limit, claim(10)) for limit in limits)
    assert overall_verdict((good,)) == PASSED
    assert overall_verdict((good, open_)) == NOT_STATED
    assert overall_verdict((good, open_, bad)) == NOT_PASSED


def test_beyond_is_of_the_worst_part():
    folds = (RegionError("one end", 20, 0.2, 0.9, 0.2), RegionError("the other", 30, 0.4, 0.8, 0.4))
    found = build_outside_claim(RegionHoldout(folds, 0.3, 0.3, "", 0.5, 1.2))
    assert (found.rms, found.largest) == (ErrorBound(0.4, 0.5), ErrorBound(0.9, 1.2))
    assert "the other, 30 poses" in found.where
    assert judge_limit_by_claim(ToleranceLimit("rms", 0.45), found).verdict == NOT_PASSED
    assert judge_limit_by_claim(ToleranceLimit("rms", 0.55), found).verdict == PASSED
    nothing = judge_limit_by_claim(
        ToleranceLimit("rms", 1.0),
        build_outside_claim(RegionHoldout(reason="no part can be spared")),
    )
    assert (nothing.verdict, nothing.why) == (NOT_STATED, "no part can be spared")


def test_nothing_is_passed_beyond_while_parts_could_not_be_judged():
    folds = (RegionError("one end", 20, 0.2, 0.9, 0.2),)
    some = RegionHoldout(folds, 0.2, 0.2, "", 0.3, 1.2, missed=("joint 2 at its low end",))
    found = judge_limit_by_claim(ToleranceLimit("rms", 0.5), build_outside_claim(some))
    assert found.verdict == NOT_STATED
    assert "only 1 of 2 parts could be judged, not joint 2 at its low end" in found.why
    assert "1 of 2 parts could be judged" in build_outside_claim(some).where
    assert (
        judge_limit_by_claim(ToleranceLimit("rms", 0.1), build_outside_claim(some)).verdict
        == NOT_PASSED
    )  # seen is seen


def test_what_is_passed_does_not_hide_what_is_seen_beyond():
    inside = claim(30)
    passed, failed = (
        judge_limit_by_claim(ToleranceLimit("rms", size), inside) for size in (0.2, 0.12)
    )
    away = build_outside_claim(
        RegionHoldout((RegionError("one end", 20, 0.3, 0.9, 0.2),), 0.3, 0.3, "", 0.4, 1.2)
    )
    assert describe_other_claim(passed, away) == (
        "RMS error passed inside the measured region alone: outside it is 0.300 mm, more than "
        "the 0.2 mm required"
    )
    assert describe_other_claim(failed, away) == ""
    assert (
        describe_other_claim(judge_limit_by_claim(ToleranceLimit("rms", 0.35), inside), away) == ""
    )
    assert describe_other_claim(passed, inside) == ""
    assert describe_other_claim(passed, build_outside_claim(RegionHoldout(reason="none"))) == ""


def test_limits_are_read():
    assert parse_tolerance_limits("rms 0.2, max 0.5") == (
        ToleranceLimit("rms", 0.2),
        ToleranceLimit("max", 0.5),
    )
    assert parse_tolerance_limits("MAX=1mm") == (ToleranceLimit("max", 1.0),)
    assert parse_tolerance_limits("") == ()
    for text in (
        "0.2",
        "rms",
        "rms -1",
        "rms 0",
        "mean 0.2",
        "rms 0.2 max 0.5",
        "rms 1e",
        "rms inf",
    ):
        with pytest.raises(mc.OptionError, match="write it in mm as rms"):
            parse_tolerance_limits(text)
    with pytest.raises(mc.OptionError, match="twice"):
        parse_tolerance_limits("rms 0.2, rms 0.3")


def test_the_upper_limits_of_beyond_are_in_the_file(robot):
    fit = mc.calibrate(robot, mc.simulate(robot, 100, 3, seed=1).data, "sum")
    assert fit.beyond.worst is not None
    assert fit.beyond.rms_high_mm > fit.beyond.worst_mm
    assert fit.beyond.max_high_mm > max(fold.max_mm for fold in fit.beyond.folds) * 0.9
    assert mc.Fit.from_dict(fit.to_dict()).beyond == fit.beyond


# ---- bootstrap -----------------------------------------------------------------------------------


SAME = 2e-3  # of a sigma: what two Gauss-Newton steps leave [60 poses, errors of 0.2 mm]


@pytest.fixture(scope="module")
def found(fit: mc.Fit) -> Bootstrap:
    return bootstrap(fit, 120, seed=3)


def inner(
    robot: mc.Robot, data: mc.Measurements, objective: str, **options: object
) -> tuple[mc.Fit, PoseDraws]:
    one = mc.calibrate(robot, data, objective, holdout=0.0, **options)
    return one, draw_poses(one.group, 4, np.random.default_rng(7))


def refitted(estimator: Estimator, state: ParameterValues) -> ParameterValues:
    """The least squares of an estimator, solved to the end by Levenberg and Marquardt."""
    model = estimator.model.with_target_weights(estimator.share)
    model = with_pose_errors(model, estimator.mix) if len(estimator.mix) else model
    points = float(model.pose_counts_by_target.sum())
    solved = least_squares.solve(PointLeastSquares(model), state.batch(), 1, points)
    return solved.x.take(np.array(0))


@pytest.mark.parametrize(
    ("objective", "options"),
    [("sum", {}), ("smr:2", {}), ("pose", {}), ("sum", {"priors": {"a*": 1e-4}})],
)
def test_replicates_are_true_refits(objective, options, robot, noisy, rng):
    """Rows repeated as drawn, and the fit solved from the same start; priors and weights heeded."""
    data = noisy.data
    if options:
        u95 = 1e-5 * rng.uniform(1.0, 3.0, data.poses)
        data = replace(data, columns={**data.columns, "u95": u95})
    one, draws = inner(robot, data, objective, **options)
    change, good = refit_by_gauss_newton_steps(one, draws, silent_progress)
    assert good.all()
    active = one.identification.active
    sigma = one.uncertainty.sigma[active]
    for number in range(4):
        rows = np.repeat(np.arange(data.poses), draws.draw_counts_of_rows(number))
        assert len(rows) == data.poses
        end = refitted(one.estimator.at_poses(rows), one.cell.parameter_values)
        off = parameter_step(one.cell.parameter_values, end)[active]
        assert_allclose(change[number] / sigma, off / sigma, atol=SAME)


def test_replicates_of_a_robust_fit_give_way_as_it_does(robot, noisy):
    """Fitted from scratch on the rows drawn, each point weighed anew: alike on the whole, to 15 %.

    The weights are kept, and one number (`robust.flatness`) stands for what they would give way.
    """
    y = noisy.data.y.copy()
    y[::15, 1] += 1.5e-3
    data = noisy.data.with_y(y)
    fit = mc.calibrate(robot, data, "sum", holdout=0.0, loss="huber")
    found = bootstrap(fit, 8, seed=1)
    draws = draw_poses(group_repeated_poses(data), 8, np.random.default_rng(1))
    cell = fit.cell
    state = cell.parameter_values
    sigma = fit.uncertainty.sigma[found.place]
    ours, theirs = found.change / sigma, np.zeros(found.change.shape)
    for number in range(8):
        rows = np.repeat(np.arange(data.poses), draws.draw_counts_of_rows(number))
        fresh = fit_cell(robot, data.take(rows), fit.options, silent_progress)
        theirs[number] = parameter_step(state, fresh.state)[found.place] / sigma
    assert (theirs * ours).sum() / (ours**2).sum() == pytest.approx(1.0, abs=0.15)
    assert np.corrcoef(theirs.ravel(), ours.ravel())[0, 1] > 0.9


def test_replicates_of_a_minimax_are_minimax_fits(robot, noisy):
    """Fitted from scratch on the rows drawn: no worse a worst target, to 1e-6."""
    one, draws = inner(robot, noisy.data, "minimax")
    change, good = refit_minimax_replicates(one, draws, silent_progress)
    assert good.all()
    for number in range(2):
        rows = np.repeat(np.arange(noisy.data.poses), draws.draw_counts_of_rows(number))
        fresh = fit_cell(robot, noisy.data.take(rows), one.options, silent_progress)
        step = np.zeros(one.estimator.model.names.parameter_count)
        step[one.identification.active] = change[number]
        model = one.estimator.at_poses(rows).model
        ours, theirs = (
            float((model.target_costs(state) / model.pose_counts_by_target).max())
            for state in (one.cell.parameter_values.step(step), fresh.state)
        )
        assert ours == pytest.approx(theirs, rel=1e-6)


def test_the_scatter_is_the_sigma(found, fit):
    """By the same poses: both ask them.  120 replicates know a sigma to 6.5 %, five times that."""
    sigma = {p.name: p.sigma for p in fit.parameters}
    ratio = found.sigma / [sigma[name] for name in found.names]
    assert_allclose(ratio, 1.0, rtol=0, atol=0.35)
    assert abs(np.median(ratio) - 1.0) < 0.15


def test_percentiles_lie_about_the_value(found, fit):
    value = {p.name: p.value for p in fit.parameters}
    assert_allclose(found.value, [value[name] for name in found.names], rtol=0, atol=0)
    low, high = found.interval(0.95).T
    assert np.all((low < found.value) & (found.value < high))
    width = (high - low) / found.sigma
    assert_allclose(width, 2 * 1.96, rtol=0.3)
    narrow = found.interval(0.5)
    assert np.all(np.ptp(narrow, axis=1) < high - low)


def test_rows_of_a_pose_are_drawn_together(rng):
    group = np.array([4, 4, 9, 1, 9, 9])
    draws = draw_poses(group, 50, rng)
    assert draws.draw_counts.shape == (50, 3)
    assert np.all(draws.draw_counts.sum(axis=1) == 3)
    for number in range(50):
        rows = draws.draw_counts_of_rows(number)
        assert rows[0] == rows[1]
        assert rows[2] == rows[4] == rows[5]
    assert abs(
        draw_poses(np.arange(40), 4000, rng).draw_counts.mean(axis=0) - 1.0
    ).max() < 5 / np.sqrt(4000)


def test_positions_are_those_of_the_replicates(robot, found, fit):
    """The whole prediction with the replicate's parameters: to second order in changes of 1e-4."""
    q = np.random.default_rng(5).uniform(-1.5, 1.5, (7, 6))
    places = found.predict_positions(q)
    assert places.shape == (120, 7, 3, 3)
    for number in (0, 50):
        assert_allclose(places[number], whole(robot, found, number).predict(q), rtol=0, atol=2e-7)
    low, high = found.position_interval(q, 0.9)
    share = np.mean((low <= places) & (places <= high))
    assert share == pytest.approx(0.9, abs=0.02)


def whole(robot: mc.Robot, found: Bootstrap, number: int) -> Cell:
    """The cell of one replicate."""
    cell = found.fit.cell
    state = cell.parameter_values
    step = np.zeros(len(found.fit.uncertainty.names.all_names))
    step[found.place] = found.change[number]
    return Cell.from_parameters(robot, state.step(step), cell.target_names)


def test_poses_left_out_judge_a_replicate(robot, noisy, found, fit):
    train = fit.data.take(~fit.held)
    draws = draw_poses(group_repeated_poses(train), 120, np.random.default_rng(3))
    for number in (0, 60):
        out = train.take(draws.draw_counts_of_rows(number) == 0)
        rms = mc.evaluate(whole(robot, found, number), out).rms_mm
        assert 1e3 * found.out_of_bag[number] == pytest.approx(rms, rel=1e-3)
    interval = found.rms_interval()
    held = 1e-3 * fit.accuracy["holdout"].rms_mm
    assert 0.5 * held < interval.low < interval.high < 2.0 * held


def test_a_draw_that_shows_a_parameter_no_more_is_lost():
    """Two poses that tell one parameter each: a draw must hold both."""
    gram = np.zeros((2, 2, 2))
    gram[0, 0, 0], gram[1, 1, 1] = 1.0, 1e-9
    times = np.array([[1, 1], [2, 0], [0, 2]])
    good = is_draw_determined(PoseDraws(times, np.arange(2)), gram, np.zeros(2))
    assert good.tolist() == [True, False, False]
    told = is_draw_determined(PoseDraws(times, np.arange(2)), gram, np.array([0.1, 1e-9]))
    assert told.all()


def test_too_few_poses_are_told(robot):
    data = simulate(robot, 60, 1, seed=12, truth=Truth(compliance=0)).data.take(np.arange(11))
    fit = mc.calibrate(robot, data, "sum", holdout=0.0)
    with pytest.raises(mc.DataError, match=r"of 30 draws of 11 poses do not determine the 27"):
        bootstrap(fit, 30)


def test_a_fit_with_effects_is_drawn_again(robot, noisy):
    fit = mc.calibrate(robot, noisy.data, "sum", effects="joint_compliance:J2")
    found = bootstrap(fit, 40)
    names = [name for name in found.names if name.startswith("joint_compliance:J2")]
    assert names
    assert found.units[-1] == "rad/(N m)"
    sigma = {p.name: p.sigma for p in fit.parameters}
    ratio = found.sigma / [sigma[name] for name in found.names]
    assert 0.7 < np.median(ratio) < 1.3  # 40 replicates: 11 % each


def test_table_and_json(found):
    table = found.table()
    assert len(table.rows) == len(found.names)
    row = next(row for row in table.rows if row[0] == "a2")
    assert row[1] == "mm"
    assert row[2] == pytest.approx(1e3 * found.value[found.names.index("a2")])
    content = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert content["replicates"] == 120
    assert content["lost"] == found.lost == 0
    first = content["parameters"][0]
    assert first["interval"][0] < 1e3 * found.value[0] < first["interval"][1]


@pytest.mark.parametrize(
    ("objective", "options", "say"),
    [
        ("sum", {"replicates": 1}, "give 2 to 100000"),
        ("sum", {"replicates": 10**6}, "give 2 to 100000"),
        ("sum", {"seed": -1}, "seed -1"),
        ("point", {}, "objective point depends on the few worst points"),
    ],
)
def test_wrong_choices_are_refused(objective, options, say, robot, noisy):
    fit = mc.calibrate(robot, noisy.data, objective)
    with pytest.raises(mc.OptionError, match=say) as caught:
        bootstrap(fit, **options)
    assert "\n" not in str(caught.value)
