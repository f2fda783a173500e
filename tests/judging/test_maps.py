"""Maps of the workspace: bins against brute force, and fields that are known."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.fitting.uncertainty import Uncertainty, uncertainty_from_dict
from minimax_cal.modelling.parameters import ParameterNames, ParameterValues
from minimax_cal.modelling.simulate import Simulation, simulate
from minimax_cal.reporting.plots.map_figure import (
    MIN_REACHED_FRACTION,
    draw_training_region_outline,
    save_map,
)
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.kinematics import forward_kinematics
from minimax_cal.selection.noise_model import Noise
from minimax_cal.validation.evaluation import SavedResult
from minimax_cal.validation.workspace_maps import (
    MapGrid,
    Predict,
    SampledJoints,
    bin_section,
    build_radius_predictor,
    build_workspace_map,
    is_interpolated_by_training_poses,
    predict_nan_radius,
    sampled_joint_range,
    tcp_positions,
)

SMALL = MapGrid(samples=3000, bins=16)


@pytest.fixture(scope="module")
def saved(noisy: Simulation) -> SavedResult:
    """Before: a robot that is not quite the one after."""
    rng = np.random.default_rng(7)
    mdh = noisy.cell.robot.mdh + 1e-3 * rng.normal(size=(6, 5))
    before = replace(noisy.cell, robot=noisy.cell.robot.with_mdh(mdh))
    held = np.arange(60) % 5 == 0
    return SavedResult({"before": before, "after": noisy.cell}, noisy.data, held, {}, ())


def height_of(cell: mc.Cell) -> Predict:
    """A field that is known: a thousandth of the height above -3 m."""

    def predict(q: Array) -> Array:
        return np.asarray(1e-3 * (3.0 + tcp_positions(cell, q)[:, 2]))

    return predict


def test_the_place_is_that_of_the_centroid(noisy):
    q = noisy.data.q
    seen = noisy.cell.predict(q).mean(axis=1)
    base = noisy.cell.base
    assert_allclose(tcp_positions(noisy.cell, q), (seen - base[:3, 3]) @ base[:3, :3], atol=1e-12)


def test_the_radius_holds_95_percent_of_the_arms_that_the_covariance_allows(noisy, robot):
    """Parameters drawn from the covariance, and the exact kinematics of each such arm."""
    fit = mc.calibrate(robot, noisy.data, "sum")
    names, draws = ParameterNames(6, fit.cell.target_names), 20_000
    units = tuple("m" if length else "rad" for length in names.linear_mask)
    known = Uncertainty(
        names, units, fit.covariance, lambda: Noise(0.0, 1e-10, 0.0), 100.0, "noise"
    )
    with pytest.raises(OptionError, match="no frame 'table'"):
        build_radius_predictor(fit.cell, known, "table")
    q = noisy.data.q[:4]
    radius = build_radius_predictor(fit.cell, known)(q)
    base = build_radius_predictor(fit.cell, known, "base")(q)
    assert radius.shape == (4,)
    assert np.abs(radius / base - 1.0).max() > 0.05  # the base's pose is part of the first alone
    state = ParameterValues(
        fit.robot.mdh, fit.cell.base[:3, :3], fit.cell.base[:3, 3], fit.cell.target_positions
    ).repeat(draws)
    moved = state.step(np.random.default_rng(3).normal(size=(draws, known.covariance_root.shape[1]))
                       @ known.covariance_root.T)  # fmt: skip
    flange = forward_kinematics(
        moved.mdh, np.broadcast_to(q * robot.sign, (draws, *q.shape)), robot.prismatic
    )
    centre = moved.target_positions.mean(axis=1)[:, None, :, None]
    there = flange[..., :3, 3] + (flange[..., :3, :3] @ centre)[..., 0]
    seen = there @ np.swapaxes(moved.rotation, 1, 2) + moved.origin[:, None]
    off = np.linalg.norm(seen - fit.predict(q).mean(axis=1), axis=-1)
    held = (off <= radius).mean(axis=0)
    # binomial scatter of the draws, and 0.5 % for the gamma variable that stands for the distance
    assert np.abs(held - 0.95).max() < 4.0 * np.sqrt(0.95 * 0.05 / draws) + 0.005


def test_the_radius_of_a_measurement_holds_95_percent_of_those_not_fitted(robot):
    """Twelve arms of 40 poses each; without the noise of a measurement it holds far fewer."""
    held, bare = [], []
    for seed in range(12):
        data = simulate(robot, poses=80, seed=seed).data
        fit = mc.calibrate(robot, data.take(np.arange(80) < 40), "sum", holdout=0.0)
        rest = data.take(np.arange(80) >= 40)
        known = uncertainty_from_dict(fit.to_dict(), fit.cell, "fit")
        off = rest.y.mean(axis=1) - fit.predict(rest.q).mean(axis=1)
        error = np.linalg.norm(off, axis=-1)
        held += (error <= build_radius_predictor(fit.cell, known, measured=True)(rest.q)).tolist()
        bare += (error <= build_radius_predictor(fit.cell, known)(rest.q)).tolist()
    assert abs(np.mean(held) - 0.95) < 4.0 * np.sqrt(0.95 * 0.05 / len(held)) + 0.005
    assert np.mean(bare) < 0.9


def test_bins_hold_the_median_and_the_worst(rng):
    x, y, radius = rng.uniform(-1, 1, (3, 500))
    reached = rng.uniform(size=500) < 0.4
    some = SampledJoints(np.stack([x, y, 0 * x], axis=1), 2.0 + radius, reached, ~reached)
    found = bin_section("flat", ("x", "y"), (x, y), some, 0.25)
    assert found.count.sum() == 500
    left, low = found.edges
    for i in range(len(left) - 1):
        for j in range(len(low) - 1):
            inside = (left[i] <= x) & (x < left[i + 1]) & (low[j] <= y) & (y < low[j + 1])
            assert found.count[i, j] == inside.sum()
            if inside.any():
                assert_allclose(found.median[i, j], np.median(some.radius[inside]))
                assert_allclose(found.worst[i, j], some.radius[inside].max())
                assert_allclose(found.reached[i, j], reached[inside].mean())
            else:
                assert np.isnan([found.median[i, j], found.worst[i, j], found.reached[i, j]]).all()


def test_a_known_field_lies_between_the_edges_of_its_bin(saved):
    found = build_workspace_map(saved, height_of(saved.cells["after"]), SMALL)
    vertical, horizontal = found.sections
    away, height = vertical.edges
    for values in (vertical.median, vertical.worst):
        i, j = np.nonzero(np.isfinite(values))
        assert len(i) > 50
        assert np.all(values[i, j] >= 1e-3 * (3.0 + height[j]) - 1e-15)
        assert np.all(values[i, j] <= 1e-3 * (3.0 + height[j + 1]) + 1e-15)
    level = horizontal.median[np.isfinite(horizontal.median)]
    middle, half = 1e-3 * (3.0 + found.height), 0.5e-3 * found.slab
    assert np.abs(level - middle).max() <= half
    assert vertical.count.sum() == SMALL.samples + 48  # with the training poses
    assert away[0] == 0.0


def test_reached_is_within_the_ranges_and_near(rng):
    train, q = rng.uniform(-1, 1, (40, 3)) * [1, 2, 3], rng.uniform(-4, 4, (300, 3))
    train = np.concatenate([train, train[:7]])  # poses that were visited again
    found = is_interpolated_by_training_poses(train, q)
    size = np.ptp(train, axis=0)
    own = np.linalg.norm((train[:40, None] - train[None, :40]) / size, axis=-1)
    own[np.diag_indices(40)] = np.inf
    limit = np.quantile(own.min(axis=1), 0.95)
    away = np.linalg.norm((q[:, None] - train[None]) / size, axis=-1).min(axis=1)
    inside = ((q >= train.min(axis=0)) & (q <= train.max(axis=0))).all(axis=1)
    assert_array_equal(found, inside & (away <= limit))
    assert 0 < found.sum() < 300
    assert is_interpolated_by_training_poses(train, train).all()


def test_a_joint_that_never_moved_is_not_known_elsewhere():
    rng = np.random.default_rng(1)
    train = rng.uniform(-1, 1, (40, 3)) * [1, 1, 0] + [0, 0, 0.7]
    elsewhere = train + np.array([0, 0, 0.1])
    assert is_interpolated_by_training_poses(train, train).all()
    assert not is_interpolated_by_training_poses(train, elsewhere).any()
    assert not is_interpolated_by_training_poses(
        train[:2], train
    ).any()  # two poses tell no spacing


def test_joints_are_sampled_within_their_limits(robot):
    low, high = sampled_joint_range(robot, np.zeros((0, 6)))
    assert_allclose(low, np.maximum(robot.lower, -np.pi))
    assert_allclose(high, np.minimum(robot.upper, np.pi))
    free = replace(robot, lower=np.full(6, -np.inf), upper=np.full(6, np.inf))
    poses = np.array([[0.0] * 6, [1.0, 1.0, 1.0, 1.0, 1.0, 3.0]])
    low, high = sampled_joint_range(free, poses)
    assert_allclose(low, [-0.25] * 5 + [-0.75])
    assert_allclose(high, [1.25] * 5 + [np.pi])
    low, high = sampled_joint_range(free, np.zeros((0, 6)))
    assert_allclose([low, high], [[-np.pi] * 6, [np.pi] * 6])


@pytest.mark.parametrize("name", ["scara_600", "ur10"])
def test_other_arms(name):
    robot = mc.load_robot(name)
    base, spots = np.eye(4), 0.1 * np.eye(3)
    cell = mc.Cell(robot, base, ("smr1", "smr2", "smr3"), spots)
    q = random_joint_values_above_floor(robot, 30, np.random.default_rng(0))
    data = replace(mc.measurements(q, cell.predict(q)), sliding=robot.prismatic)
    both = SavedResult({"before": cell, "after": cell}, data, np.zeros(30, dtype=bool), {}, ())
    found = build_workspace_map(both, predict_nan_radius, SMALL)
    assert found.sections[0].count.sum() == SMALL.samples + 30
    low, high = sampled_joint_range(robot, q)
    assert np.all(low < high)
    assert np.all(q >= low - 1e-12)
    assert np.all(q <= high + 1e-12)


def test_observed_errors_are_those_of_the_cells(saved):
    found = build_workspace_map(saved, predict_nan_radius, SMALL)
    for name, cell in saved.cells.items():
        told = np.linalg.norm(cell.error(saved.data).mean(axis=1), axis=-1)
        assert_allclose(getattr(found.seen, name), told, atol=1e-15)
    assert found.seen.after.mean() < found.seen.before.mean()
    assert_array_equal(found.seen.held, saved.held)
    gap = saved.data.y.copy()
    gap[3, 1] = np.nan
    part = build_workspace_map(
        replace(saved, data=saved.data.with_y(gap)), predict_nan_radius, SMALL
    ).seen
    one = saved.cells["after"].error(saved.data)[3, [0, 2]].mean(axis=0)
    assert_allclose(part.after[3], np.linalg.norm(one), atol=1e-15)


def test_a_prediction_that_held_out_poses_belie_is_doubted(saved):
    error = build_workspace_map(saved, predict_nan_radius, SMALL).seen.after[saved.held]
    few, more = np.sort(error)[[7, 8]]  # of 12 by chance: 8 in 0.2 %, 9 in 2 % of all cases
    for radius, count, doubted in ((few, 8, True), (more, 9, False), (1.0, 12, False)):
        found = build_workspace_map(
            saved, predict_nan_radius, SMALL, lambda q, r=radius: np.full(len(q), r)
        )
        assert found.inside == (count, 12)
        assert found.to_dict()["held_out_inside"] == {"count": count, "of": 12}
        assert any("not 95 %" in notice for notice in found.notices) == doubted


def test_beyond_the_data_is_told_apart(saved):
    """What is reached has joint 1 on the side that was measured, and is told by its bins."""
    side = saved.data.q[:, 0] > 0.2
    half = replace(saved, data=saved.data.take(side), held=np.zeros(side.sum(), dtype=bool))
    found = build_workspace_map(half, predict_nan_radius, replace(SMALL, samples=20_000))
    vertical, horizontal = found.sections
    share = np.nansum(vertical.reached * vertical.count) / vertical.count.sum()
    assert share == pytest.approx(found.sampled.reached.mean())
    q = random_joint_values_above_floor(saved.cells["after"].robot, 500, np.random.default_rng(2))
    assert not is_interpolated_by_training_poses(half.data.q, q[q[:, 0] < 0.2]).any()
    flat = np.abs(found.sampled.place[:, 2] - found.height) <= 0.5 * found.slab
    assert horizontal.count.sum() == flat.sum()
    assert any("J1 moved over" in notice for notice in found.notices)


def test_what_is_predicted_is_drawn(saved, tmp_path):
    save_map(
        build_workspace_map(saved, height_of(saved.cells["after"]), SMALL), tmp_path / "map.png"
    )
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_without_a_covariance_only_what_was_observed_is_drawn(saved, tmp_path):
    found = build_workspace_map(saved, predict_nan_radius, SMALL)
    assert not found.predicted
    for name in ("seen", "again"):
        save_map(found, tmp_path / f"{name}.svg")
    text = (tmp_path / "seen.svg").read_text()
    assert (tmp_path / "again.svg").read_text() == text  # the same picture, the same file
    assert "observed, after" in text
    assert "predicted" not in text
    assert found.to_dict()["sections"][0]["radius95_median_mm"][0][0] is None


def test_the_line_parts_what_is_reached_from_what_is_not(saved):
    """Each edge of the line has a bin that the training poses reach on one side alone."""
    from matplotlib.figure import Figure

    part = build_workspace_map(saved, predict_nan_radius, SMALL).sections[0]
    axes = Figure().subplots()
    draw_training_region_outline(axes, part)
    (line,) = axes.collections
    x, y = part.edges
    reached = {
        ((x[i] + x[i + 1]) / 2, (y[j] + y[j + 1]) / 2)
        for i, j in np.argwhere(part.reached >= MIN_REACHED_FRACTION)
    }
    inner = np.array(sorted(reached))
    step = np.diff(x).mean(), np.diff(y).mean()
    edges = np.array(line.get_segments())
    assert len(edges)
    for one, other in edges:
        middle = (one + other) / 2
        aside = np.array([step[0], 0.0] if one[0] == other[0] else [0.0, step[1]]) / 2
        sides = [np.abs(inner - (middle + way * aside)).max(axis=1).min() < 1e-9 for way in (1, -1)]
        assert sum(sides) == 1
