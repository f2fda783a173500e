"""Points that stand out: leverage in closed form, chances by simulation, lists by brute force."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from problems_robust import NOISE, Case, fit, misread, shifted, state_of
from scipy import stats

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.core.files import convert_to_plain_json
from minimax_cal.fitting.outliers import (
    FALSE_DISCOVERY_RATE,
    PointScores,
    StudentSpread,
    estimate_spread,
    find_contradicting_points,
    fit_log_scale,
    nearest_revisits,
    reject_by_false_discovery_rate,
    standardised_point_scores,
)
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.point_model import GaussianPrior
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.solvers.scalar_minimum import minimise_scalar_between

# ---- suspects ------------------------------------------------------------------------------------


# ---- leverage --------------------------------------------------------------------------------


def plain_scores(case: Case) -> PointScores:
    return standardised_point_scores(
        case.model, state_of(case.found), case.model.measured_mask.astype(float)
    )


def test_covariance_is_that_of_the_whole_hat_matrix(robot):
    """All rows at once, any weights, a prior: C from R R' with R = I - J A^-1 J' W."""
    case = shifted(robot, 0.0, 0.0, poses=12)
    prior = np.zeros(case.model.names.parameter_count)
    prior[case.model.active] = np.random.default_rng(1).uniform(0.0, 0.2, case.model.active.sum())
    quality = np.random.default_rng(2).uniform(0.5, 2.0, case.model.weight.shape)
    model = replace(case.model.with_prior(GaussianPrior(prior, prior)), weight=quality)
    weights = np.random.default_rng(0).choice(
        [0.0, 0.3, 1.0], size=quality.shape, p=[0.1, 0.4, 0.5]
    )
    state = state_of(case.found)
    found = standardised_point_scores(model, state, weights)

    rows = np.swapaxes(
        model.point_jacobian(state)[..., model.active], 0, 1
    )  # as scores: targets first
    rows = rows * np.sqrt(quality)[..., None, None]
    rows = rows.reshape(-1, model.active.sum())
    w = np.repeat(weights.reshape(-1), 3)
    known = np.diag(prior[model.active])
    cover = np.linalg.inv(rows.T @ (w[:, None] * rows) + known)
    left = np.eye(len(rows)) - rows @ cover @ rows.T * w
    whole = left @ left.T + rows @ cover @ known @ cover @ rows.T
    error = np.swapaxes(model.point_errors(state), 0, 1) * np.sqrt(quality)[..., None]
    error = error.reshape(-1, 3)
    blocks = np.stack([whole[i : i + 3, i : i + 3] for i in range(0, len(rows), 3)])
    expected = np.einsum("na,nab,nb->n", error, np.linalg.inv(blocks), error)
    full = found.directions.reshape(-1) == 3
    assert full.mean() > 0.9
    assert_allclose(found.square.reshape(-1)[full], expected[full], rtol=1e-7)


def test_directions_that_the_fit_follows_are_not_judged(robot):
    """The single pose of a target is explained by the target's own place."""
    case = shifted(robot, 0.0, 0.0, poses=40)
    weight = case.model.weight.copy()
    weight[2, 1:] = 0.0
    model = replace(case.model, weight=weight)
    state = state_of(fit(model, state_of(case.found))[1])
    found = standardised_point_scores(model, state, model.measured_mask.astype(float))
    assert found.directions[2, 0] == 0
    assert (found.directions[:2] == 3).all()
    p_value = StudentSpread(NOISE, 100.0).p_value(found)
    assert p_value[2, 0] == 1.0
    assert (p_value[2, 1:] == 1.0).all()  # never measured


# ---- chances ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def clean(robot: mc.Robot) -> list[tuple[PointScores, float]]:
    """Scores and spare degrees of freedom of 40 plain fits to clean points."""
    out = []
    for seed in range(40):
        case = shifted(robot, 0.0, 0.0, poses=25, seed=seed)
        dof = 3.0 * case.model.pose_counts_by_target.sum() - case.model.active.sum()
        out.append((plain_scores(case), float(dof)))
    return out


def test_scores_of_clean_points_are_chi_square(clean):
    """Kolmogorov and Smirnov over 3000 points of fits with 33 parameters from 225 coordinates."""
    full = np.concatenate([found.square[found.directions == 3] for found, _ in clean])
    assert len(full) > 2900
    assert stats.kstest(full / NOISE**2, stats.chi2(3).cdf).pvalue > 1e-3


def test_clean_points_are_rarely_listed(clean):
    """At most 1 % of the data sets have suspects; 4 of 40 would be a chance of 1 in 2000."""
    lists, low, count = 0, 0, 0
    for found, dof in clean:
        p_value = estimate_spread(found, dof).p_value(found)
        lists += bool(reject_by_false_discovery_rate(p_value).any())
        low, count = low + int((p_value < 0.05).sum()), count + p_value.size
    assert stats.binom.sf(lists - 1, len(clean), FALSE_DISCOVERY_RATE) > 1e-3
    assert abs(low / count - 0.05) < 4.0 * np.sqrt(0.05 * 0.95 / count)


def test_scale_is_that_of_the_noise(clean):
    scale = [estimate_spread(found, dof).scale for found, dof in clean]
    assert_allclose(np.mean(scale), NOISE, rtol=0.02)


def drawn(rng: np.random.Generator, count: int, tail: float) -> Array:
    """Squared lengths of 3-D Student's t vectors of scale NOISE: (1, count)."""
    wide = tail / rng.chisquare(tail, size=count)
    return (NOISE**2 * wide * rng.chisquare(3, size=count))[None]


@pytest.mark.parametrize("tail", [3.0, 10.0, 1e4])
def test_the_likeliest_scale_is_where_the_density_is_largest(rng, tail):
    square = drawn(rng, 500, tail)[0]
    found = fit_log_scale(square, np.full(500, 1.5), tail, float(np.log(NOISE)) + 1.0)

    def loss(log_scale: float) -> float:
        ratio = square / 3.0 / np.exp(2.0 * log_scale)
        return float(2.0 * 500 * log_scale - stats.f.logpdf(ratio, 3, tail).sum())

    at, _ = minimise_scalar_between(loss, found - 1.0, found + 1.0, 1e-9)
    assert abs(found - at) < 1e-6  # of a flat bottom no more is seen


@pytest.mark.parametrize("tail", [3.0, 6.0, 1e5])
def test_scale_and_tails_are_found_beside_outliers(rng, tail):
    square = drawn(rng, 2000, tail)
    for share in (0.0, 0.2):
        wrong = np.arange(2000)[None] < share * 2000
        mixed = np.where(wrong, (100.0 * NOISE) ** 2, square)
        found = PointScores(mixed, np.full(mixed.shape, 3))
        spread = estimate_spread(found, 5000.0)
        assert_allclose(spread.scale, NOISE, rtol=0.1)
        assert (spread.dof < 10.0) == (tail < 10.0)
        listed = reject_by_false_discovery_rate(spread.p_value(found))
        # not so where the tails are heavy: a hundred sigma are then an ordinary point's right
        if tail > 4.0:
            assert listed[wrong].all()
        assert (listed & ~wrong).sum() <= 0.03 * max(int(listed.sum()), 1) + 1


def test_points_without_error_are_no_suspects(robot):
    """Rounding has tails too; no instrument tells less than a tenth of a micrometre."""
    exact = Truth(compliance=0.0, noise=0.0, noise_per_metre=0.0)
    assert not shifted(robot, 0.0, 0.0, truth=exact).robust("tukey").suspects
    nothing = PointScores(np.zeros((1, 4)), np.zeros((1, 4), dtype=int))
    assert (estimate_spread(nothing, 1.0).p_value(nothing) == 1.0).all()


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(1e-9, 1.0), min_size=0, max_size=30), st.sampled_from([0.01, 0.1, 0.5]))
def test_lists_are_those_of_benjamini_and_hochberg(chances, level):
    n = len(chances)
    longest = max(
        (r for r in range(n + 1) if r == 0 or sorted(chances)[r - 1] <= level * r / n), default=0
    )
    limit = sorted(chances)[longest - 1] if longest else -1.0
    expected = [p <= limit for p in chances]
    assert reject_by_false_discovery_rate(np.array(chances), level).tolist() == expected


# ---- lists -----------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", ["square", "tukey"])
def test_wrong_points_are_listed_and_few_others(robot, loss):
    hits, misses, others = 0, 0, 0
    for seed in range(4):
        case = shifted(robot, 0.05, 1e-3, poses=40, seed=seed)
        listed = case.listed(case.robust(loss))
        hits += int((listed & case.bad).sum())
        misses += int((case.bad & ~listed).sum())
        others += int((listed & ~case.bad).sum())
    assert hits >= 0.95 * (hits + misses)
    assert others <= 0.1 * (hits + others)


def test_a_list_tells_where_and_how_far(robot):
    case = misread(robot, 0.04, 5e-3)
    y = case.data.y.copy()
    alone = int(np.flatnonzero(~case.bad.any(axis=0))[0])
    y[alone, 1] += [0.0, 2e-3, 0.0]
    case = replace(
        case, data=case.data.with_y(y), model=replace(case.model, y=np.moveaxis(y, 0, 2))
    )
    found = case.robust("tukey")
    state = state_of(found.least_squares)
    distance = np.linalg.norm(found.unweighted_model.point_errors(state), axis=-1)
    line = case.data.line
    by_pose = {pose: [s for s in found.suspects if s.line == line[pose]] for pose in range(50)}
    assert [s.target for s in by_pose[alone]] == ["smr2"]
    assert not by_pose[alone][0].together
    assert by_pose[alone][0].distance == pytest.approx(2e-3, abs=5 * NOISE)
    for pose in np.flatnonzero(case.bad.any(axis=0)):
        assert {s.target for s in by_pose[int(pose)]} == {"smr1", "smr2", "smr3"}
        assert all(s.together for s in by_pose[int(pose)])
    for one in found.suspects:
        target, pose = case.data.target_names.index(one.target), list(line).index(one.line)
        assert one.distance == pytest.approx(distance[pose, target])
        assert one.score == pytest.approx(one.distance / found.scale, rel=0.3)
    order = [one.p_value for one in found.suspects]
    assert order == sorted(order)
    assert "diagnose" in found.notices[0]
    assert "real effect" in found.notices[0]
    assert "\n" not in found.notices[0]


# ---- second visits -------------------------------------------------------------------------------


VISIT_NOISE = 0.02e-3  # [m]


def visited(robot: mc.Robot, *, twice: int = 12, seed: int = 0) -> tuple[Measurements, Array]:
    """40 poses of which some stand twice in the file, and the errors of the true arm (m, k, 3)."""
    data = simulate(robot, 40, 2, seed, Truth(compliance=0.0, noise=0.0, noise_per_metre=0.0)).data
    rows = np.r_[0:40, 0:twice]
    data = data.take(rows)
    data = replace(data, line=np.arange(2, 2 + len(rows)), columns={})
    noise = np.random.default_rng(seed).normal(0.0, VISIT_NOISE, data.y.shape)
    return data.with_y(data.y + noise), noise


def moved(data: Measurements, error: Array, row: int, off: float) -> tuple[Measurements, Array]:
    """The same, a point of the first target elsewhere [m]."""
    y, error = data.y.copy(), error.copy()
    y[row, 0, 2] += off
    error[row, 0, 2] += off
    return data.with_y(y), error


def test_the_nearest_other_visit_by_brute_force():
    rng = np.random.default_rng(4)
    points, group = rng.normal(size=(9, 2, 3)), np.array([0, 1, 0, 2, 0, 1, 3, 4, 4])
    points[8, 1] = np.nan
    apart, other, amid = nearest_revisits(points, group)
    for target in range(2):
        for row in range(9):
            rest = [i for i in np.flatnonzero(group == group[row]) if i != row]
            far = [np.linalg.norm(points[row, target] - points[i, target]) for i in rest]
            if not rest or np.isnan(far).all():
                assert np.isnan(apart[row, target])
            else:
                assert_allclose(apart[row, target], np.nanmin(far), rtol=1e-12)
                assert_allclose(amid[row, target], np.nanmedian(far), rtol=1e-12)
                assert other[row, target] == rest[int(np.nanargmin(far))]


def test_a_point_that_its_own_second_visit_contradicts(robot):
    """Whichever of both is wrong, the fit tells; far less than a fit alone would find."""
    for row, right in ((3, 43), (43, 3)):
        (text,) = find_contradicting_points(*moved(*visited(robot), row, 20.0 * VISIT_NOISE))
        assert f"line {row + 2} smr1 is " in text
        assert f"from line {right + 2}, which fits" in text
        assert text.count("smr") == 1


def test_a_fit_that_does_not_know_does_not_say_which(robot):
    data, error = moved(*visited(robot), 3, 20.0 * VISIT_NOISE)
    field = 1e-3 * np.ones(3)  # what the model lacks at both visits
    (text,) = find_contradicting_points(data, error + field)
    assert "smr1" in text
    assert "which fits" not in text


def test_three_visits_tell_without_a_fit(robot):
    data, error = visited(robot)
    rows = np.r_[0:52, 0:12]
    data = replace(data.take(rows), line=np.arange(2, 66))
    fresh = np.random.default_rng(9).normal(0.0, VISIT_NOISE, (12, *data.y.shape[1:]))
    y = data.y.copy()
    y[52:] += fresh
    error = error[rows] + 1e-3
    error[52:] += fresh
    (text,) = find_contradicting_points(*moved(data.with_y(y), error, 43, 30.0 * VISIT_NOISE))
    assert "line 45 smr1" in text or "from line 45" in text
    assert text.count("smr") == 1


def test_sound_visits_and_few_visits_say_nothing(robot):
    """A distance of four times that of 95 % of all is one of eight sigmas."""
    assert not any(
        list(find_contradicting_points(*visited(robot, seed=seed))) for seed in range(60)
    )
    assert not list(find_contradicting_points(*moved(*visited(robot, twice=4), 3, 1e-3)))
    assert not list(find_contradicting_points(*moved(*visited(robot, twice=0), 3, 1e-3)))


def test_calibrate_and_diagnose_tell(robot):
    data, _ = moved(*visited(robot), 3, 20.0 * VISIT_NOISE)
    for notices in (
        mc.calibrate(robot, data, objective="sum").notices,
        mc.diagnose(robot, data, quick=True).notices,
    ):
        (text,) = [one for one in notices if "contradict each other" in one]
        assert "line 5 smr1" in text or "from line 5" in text


def test_the_same_pose_under_another_load_contradicts_nothing(robot):
    data, error = visited(robot)
    for row in (40, 41, 42):
        data, error = moved(data, error, row, 25.0 * VISIT_NOISE)
    assert list(find_contradicting_points(data, error))
    load = np.where(np.isin(np.arange(data.poses), (40, 41, 42)), 20.0, 0.0)
    assert not list(find_contradicting_points(replace(data, columns={"payload": load}), error))


# ---- claims --------------------------------------------------------------------------------------


def mirrored(data: Measurements) -> Measurements:
    """One coordinate of one target with the wrong sign."""
    y = data.y.copy()
    y[:, 1, 0] *= -1.0
    return data.with_y(y)


def stuck(robot: mc.Robot, data: Measurements) -> tuple[Measurements, np.ndarray]:
    """A joint that was not read anew for some of the held-out rows, and those rows."""
    rows = np.flatnonzero(mc.calibrate(robot, data, "sum").held)[:5]
    q = data.q.copy()
    q[rows, 2] = q[rows[0], 2]
    return replace(data, q=q), rows[1:]


def test_a_fit_that_contradicts_its_data_has_failed_and_writes_no_robot(robot, tmp_path, says):
    data, out = tmp_path / "d.csv", tmp_path / "fit.json"
    mc.write_measurements(data, mirrored(simulate(robot, 40, 2, seed=5).data))
    fit = mc.Fit.from_dict(
        json.loads(
            says("calibrate irb2600", data, "--objective", "sum", "--json", "-o", out, code=1).out
        )
    )
    assert not out.exists()
    assert fit.status == "failed"
    assert "no calibration of this arm" in fit.notices[-1]
    with pytest.raises(mc.OptionError, match="contradicts its own data"):
        mc.export(fit, "json")


def test_bad_rows_that_are_held_out_are_told(robot, noisy):
    data, wrong = stuck(robot, noisy.data)
    fit = mc.calibrate(robot, data, "sum")
    assert fit.status == "converged"
    assert {one.line for one in fit.suspects if one.held} >= set(data.line[wrong].tolist())
    assert any("outliers among the held-out points" in text for text in fit.notices)
    assert fit.accuracy["holdout"].rms_mm > 20.0
    clean = mc.calibrate(robot, noisy.data, "sum")
    # the same arm judged by the rows that are left
    assert_allclose(fit.trusted.rms_mm, clean.accuracy["holdout"].rms_mm, rtol=0.15)
    assert fit.beyond.worst_mm > 20.0  # they judge outside the measured region as well
    assert fit.beyond.trusted is not None
    assert_allclose(fit.beyond.trusted.worst_mm, clean.beyond.worst_mm, rtol=0.3)
    assert "without outliers worst part" in fit.headline()


def test_sound_held_out_rows_are_no_suspects(robot):
    named = [
        one
        for seed in range(6)
        for one in mc.calibrate(robot, simulate(robot, 80, seed=seed).data, "sum").suspects
        if one.held
    ]
    assert not named  # errors of the model are larger at new poses, and no fault of the rows


def test_suspects_of_a_file_come_back(robot, noisy, tmp_path):
    data, _ = stuck(robot, noisy.data)
    fit = mc.calibrate(robot, data, "sum")
    fit.save(tmp_path / "fit.json")
    again = mc.load_fit(tmp_path / "fit.json")
    keys = [[(s.line, s.target, s.held) for s in one.suspects] for one in (fit, again)]
    assert keys[0] == keys[1]
    assert convert_to_plain_json(again.beyond) == convert_to_plain_json(fit.beyond)
    assert again.trusted.rms_mm == pytest.approx(fit.trusted.rms_mm, rel=1e-9)


def test_a_wrong_point_of_the_fit_is_set_aside_where_its_part_judges(robot):
    """As beyond as measured without it: the loss gives it no weight, its part would tell it."""
    data = mc.simulate(robot, 100, 3, seed=4).data
    clean = mc.calibrate(robot, data, "sum", loss="tukey")
    y = data.y.copy()
    y[np.flatnonzero(~clean.held)[3], 1] += [5e-3, 0.0, 0.0]
    fit = mc.calibrate(robot, data.with_y(y), "sum", loss="tukey")
    assert [one.held for one in fit.suspects] == [False]
    assert fit.beyond.trusted is not None
    assert fit.beyond.worst_mm > 1.5 * clean.beyond.worst_mm
    assert fit.beyond.trusted.worst_mm == pytest.approx(clean.beyond.worst_mm, rel=0.02)
