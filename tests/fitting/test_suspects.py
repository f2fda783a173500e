"""Points that stand out: leverage in closed form, chances by simulation, lists by brute force."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from problems_robust import EVEN, NOISE, Case, fit, misread, shifted, state_of
from scipy import stats

import minimax_cal as mc
from minimax_cal.fitting.suspects import (
    FALSE_DISCOVERY_RATE,
    Scores,
    Spread,
    Suspect,
    fit_log_scale,
    scores,
    spread_of,
    suspects_of,
    table_of,
    unlikely,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.files import plain
from minimax_cal.modelling.model import Prior
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.solvers.scalar import least_between

# ---- leverage --------------------------------------------------------------------------------


def plain_scores(case: Case) -> Scores:
    return scores(case.model, state_of(case.found), case.model.seen.astype(float))


def test_covariance_is_that_of_the_whole_hat_matrix(robot):
    """All rows at once, any weights, a prior: C from R R' with R = I - J A^-1 J' W."""
    case = shifted(robot, 0.0, 0.0, poses=12)
    prior = np.zeros(case.model.names.count)
    prior[case.model.active] = np.random.default_rng(1).uniform(0.0, 0.2, case.model.active.sum())
    quality = np.random.default_rng(2).uniform(0.5, 2.0, case.model.weight.shape)
    model = replace(case.model.with_prior(Prior(prior, prior)), weight=quality)
    weights = np.random.default_rng(0).choice(
        [0.0, 0.3, 1.0], size=quality.shape, p=[0.1, 0.4, 0.5]
    )
    state = state_of(case.found)
    found = scores(model, state, weights)

    rows = model.jacobian(state)[..., model.active] * np.sqrt(quality)[..., None, None]
    rows = rows.reshape(-1, model.active.sum())
    w = np.repeat(weights.reshape(-1), 3)
    known = np.diag(prior[model.active])
    cover = np.linalg.inv(rows.T @ (w[:, None] * rows) + known)
    left = np.eye(len(rows)) - rows @ cover @ rows.T * w
    whole = left @ left.T + rows @ cover @ known @ cover @ rows.T
    error = (model.error(state) * np.sqrt(quality)[..., None]).reshape(-1, 3)
    blocks = np.stack([whole[i : i + 3, i : i + 3] for i in range(0, len(rows), 3)])
    expected = np.einsum("na,nab,nb->n", error, np.linalg.inv(blocks), error)
    full = found.directions.reshape(-1) == 3
    assert full.mean() > 0.9
    assert_allclose(found.square.reshape(-1)[full], expected[full], rtol=1e-7)


def test_a_point_is_judged_as_if_it_were_not_in_the_fit(robot):
    """e'(I - H)^-1 e from the fit is e'(I + H)^-1 e from the fit without the point."""
    case = shifted(robot, 0.05, 2e-4, poses=30)
    plain = plain_scores(case)
    for target, pose in np.argwhere(case.bad | (np.arange(30) == 7)):
        weights = case.model.seen.astype(float)
        weights[target, pose] = 0.0
        model = replace(case.model, weight=case.model.weight * weights)
        without = state_of(fit(model, state_of(case.found))[1])
        own = scores(case.model, without, weights).square[target, pose]
        # the errors of half a millimetre in the arm make the fit nonlinear by parts in ten thousand
        assert own == pytest.approx(plain.square[target, pose], rel=5e-3)


def test_directions_that_the_fit_follows_are_not_judged(robot):
    """The single pose of a target is explained by the target's own place."""
    case = shifted(robot, 0.0, 0.0, poses=40)
    weight = case.model.weight.copy()
    weight[2, 1:] = 0.0
    model = replace(case.model, weight=weight)
    state = state_of(fit(model, state_of(case.found))[1])
    found = scores(model, state, model.seen.astype(float))
    assert found.directions[2, 0] == 0
    assert (found.directions[:2] == 3).all()
    p_value = Spread(NOISE, 100.0).p_value(found)
    assert p_value[2, 0] == 1.0
    assert (p_value[2, 1:] == 1.0).all()  # never measured


# ---- chances ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def clean(robot: mc.Robot) -> list[tuple[Scores, float]]:
    """Scores and spare degrees of freedom of 40 plain fits to clean points."""
    out = []
    for seed in range(40):
        case = shifted(robot, 0.0, 0.0, poses=25, seed=seed)
        dof = 3.0 * case.model.counts.sum() - case.model.active.sum()
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
        p_value = spread_of(found, dof).p_value(found)
        lists += bool(unlikely(p_value).any())
        low, count = low + int((p_value < 0.05).sum()), count + p_value.size
    assert stats.binom.sf(lists - 1, len(clean), FALSE_DISCOVERY_RATE) > 1e-3
    assert abs(low / count - 0.05) < 4.0 * np.sqrt(0.05 * 0.95 / count)


def test_scale_is_that_of_the_noise(clean):
    scale = [spread_of(found, dof).scale for found, dof in clean]
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

    at, _ = least_between(loss, found - 1.0, found + 1.0, 1e-9)
    assert abs(found - at) < 1e-6  # of a flat bottom no more is seen


@pytest.mark.parametrize("tail", [3.0, 6.0, 1e5])
def test_scale_and_tails_are_found_beside_outliers(rng, tail):
    square = drawn(rng, 2000, tail)
    for share in (0.0, 0.2):
        wrong = np.arange(2000)[None] < share * 2000
        mixed = np.where(wrong, (100.0 * NOISE) ** 2, square)
        found = Scores(mixed, np.full(mixed.shape, 3))
        spread = spread_of(found, 5000.0)
        assert_allclose(spread.scale, NOISE, rtol=0.1)
        assert (spread.dof < 10.0) == (tail < 10.0)
        listed = unlikely(spread.p_value(found))
        # not so where the tails are heavy: a hundred sigma are then an ordinary point's right
        if tail > 4.0:
            assert listed[wrong].all()
        assert (listed & ~wrong).sum() <= 0.03 * max(int(listed.sum()), 1) + 1


def test_heavy_tails_make_the_list_short(rng):
    """What a Gaussian would call unlikely is what a model that lacks an effect leaves."""
    found = Scores(drawn(rng, 1000, 3.0), np.full((1, 1000), 3))
    gaussian = Spread(spread_of(found, 3000.0).scale, 3000.0)
    assert unlikely(gaussian.p_value(found)).sum() > 30
    assert unlikely(spread_of(found, 3000.0).p_value(found)).sum() <= 3


def test_points_without_error_are_no_suspects(robot):
    """Rounding has tails too; no instrument tells less than a tenth of a micrometre."""
    exact = Truth(compliance=0.0, noise=0.0, noise_per_metre=0.0)
    assert not shifted(robot, 0.0, 0.0, truth=exact).robust("tukey").suspects
    nothing = Scores(np.zeros((1, 4)), np.zeros((1, 4), dtype=int))
    assert (spread_of(nothing, 1.0).p_value(nothing) == 1.0).all()


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(1e-9, 1.0), min_size=0, max_size=30), st.sampled_from([0.01, 0.1, 0.5]))
def test_lists_are_those_of_benjamini_and_hochberg(chances, level):
    n = len(chances)
    longest = max(
        (r for r in range(n + 1) if r == 0 or sorted(chances)[r - 1] <= level * r / n), default=0
    )
    limit = sorted(chances)[longest - 1] if longest else -1.0
    expected = [p <= limit for p in chances]
    assert unlikely(np.array(chances), level).tolist() == expected


# ---- lists -----------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", ["square", "tukey"])
def test_wrong_points_are_listed_and_few_others(robot, loss):
    hits, misses, others = 0, 0, 0
    for seed in range(6):
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
    state = state_of(found.fit)
    distance = np.linalg.norm(found.plain.error(state), axis=-1)
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
        assert one.distance == pytest.approx(distance[target, pose])
        assert one.score == pytest.approx(one.distance / found.scale, rel=0.3)
    order = [one.p_value for one in found.suspects]
    assert order == sorted(order)
    assert "diagnose" in found.notices[0]
    assert "real effect" in found.notices[0]
    assert "\n" not in found.notices[0]


def test_the_table_has_a_row_a_suspect():
    one = Suspect(7, "smr2", 1.2e-3, 40.0, 1e-30, together=True)
    data = simulate("irb120", 10, seed=1).data
    table = table_of([one], data)
    assert table.rows == (
        (data.called(7), "smr2", pytest.approx(1.2), 40.0, 1e-30, "training", "all targets"),
    )
    assert plain(one) == {
        "line": 7, "target": "smr2", "distance_mm": pytest.approx(1.2), "score": 40.0,
        "chance": 1e-30, "together": True, "held": False,
    }  # fmt: skip
    assert table_of([], data).rows == ()


def test_the_list_is_the_least_likely_first(robot):
    case = shifted(robot, 0.1, 1e-3)
    found = plain_scores(case)
    state = state_of(case.found)
    listed = suspects_of(case.model, state, found, Spread(NOISE, 1e4), case.data.line)
    assert [one.p_value for one in listed] == sorted(one.p_value for one in listed)


def test_lines_are_those_of_the_file(robot):
    case = shifted(robot, 0.02, 1e-3, truth=EVEN)
    moved = replace(case, data=replace(case.data, line=case.data.line + 100))
    lines = [[one.line for one in each.robust().suspects] for each in (case, moved)]
    assert lines[0]
    assert_allclose(lines[1], np.array(lines[0]) + 100)
