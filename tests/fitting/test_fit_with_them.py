"""What was set aside for a fit is listed, and counted beside what the fit claims."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.fitting.set_aside import with_them
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.aside import FILE, TOOL, USER
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.set_aside import left_out, set_aside
from minimax_cal.modelling.simulate import Truth, simulate

TRUTH = Truth(noise=20e-6, noise_per_metre=0.0, compliance=0.0)
BAD = 5  # poses of which each is off


def spoilt(poses: int = 250) -> tuple[Measurements, Array]:
    """Measurements with a few poses that are off by 1 mm, and their lines."""
    data = simulate("irb120", poses, 3, seed=3, truth=TRUTH).data
    rng = np.random.default_rng(0)
    rows = rng.choice(poses, BAD, replace=False)
    y = data.y.copy()
    by = rng.normal(size=(BAD, 1, 3))
    y[rows] += 1e-3 * by / np.linalg.norm(by, axis=-1, keepdims=True)
    return data.with_y(y), data.line[rows]


def unticked(data: Measurements, lines: Array) -> Measurements:
    return left_out(data, [f"{','.join(map(str, lines))}=looks odd"])


def test_points_weigh_as_much_as_they_would_among_all(rng):
    """Where a fifth is held out, a point set aside counts a fifth of a held-out one."""
    held, aside = rng.normal(size=(2, 40, 3)), 3.0 * rng.normal(size=(2, 10, 3))
    found = with_them(held, np.arange(40), aside, 0.2)
    squares = [np.sum(part**2, axis=(1, 2)) for part in (held, aside)]
    mean_square = (squares[0].sum() + 0.2 * squares[1].sum()) / (80 + 0.2 * 20)
    assert_allclose(found.rms_mm, 1e3 * np.sqrt(mean_square), rtol=1e-12)
    assert_allclose(sum(found.sse_mm2) / sum(found.counts), found.rms_mm**2, rtol=1e-12)
    both = np.linalg.norm(np.concatenate([held, aside], axis=1), axis=-1)
    assert found.max_mm == 1e3 * both.max()
    assert (found.poses, found.counts) == (50, (50, 50))
    alone = with_them(held, np.arange(40), aside[:, :0], 0.2)
    assert_allclose(alone.rms_mm, 1e3 * np.sqrt((held**2).sum(-1).mean()), rtol=1e-12)


def test_unticked_poses_are_listed_and_counted(tmp_path):
    """2 % of the poses: the claim without them is smaller, that with them is as before."""
    data, lines = spoilt()
    before = mc.calibrate("irb120", data, "sum").accuracy["holdout"].rms_mm
    fit = mc.calibrate("irb120", unticked(data, lines), "sum")
    assert {(p.row, p.target) for p in fit.set_aside} == {
        (line, name) for line in lines for name in data.target_names
    }
    assert {(p.why, p.by) for p in fit.set_aside} == {("looks odd", USER)}
    assert fit.with_them is not None
    without, counted = fit.accuracy["holdout"], fit.accuracy["holdout_with_them"]
    noise = 1e3 * np.sqrt(3.0) * TRUTH.noise
    assert without.rms_mm < 1.2 * noise
    whole = np.hypot(noise, 1.0 * np.sqrt(BAD / data.poses))  # what all poses together show
    assert_allclose(counted.rms_mm, whole, rtol=0.05)
    assert before > without.rms_mm
    assert_allclose(counted.max_mm, 1.0, rtol=0.1)
    assert counted.poses == without.poses + BAD
    said = f"{3 * BAD} points set aside by the user; with them RMS {counted.rms_mm:.3f} mm"
    assert said in fit.headline()
    fit.save(tmp_path / "fit.json")
    again = mc.load_fit(tmp_path / "fit.json")
    assert again.set_aside == fit.set_aside
    assert again.accuracy["holdout_with_them"] == counted
    assert again.to_dict()["set_aside"] == fit.to_dict()["set_aside"]
    assert again.with_them is not None
    assert again.with_them == fit.with_them
    assert again.with_them.rms_ci95_mm == fit.with_them.rms_ci95_mm


def test_few_poses_are_cross_validated_and_all_count():
    data, lines = spoilt(60)
    fit = mc.calibrate("irb120", unticked(data, lines), "sum", holdout=0.2)
    assert fit.error_crossed.size
    counted = fit.accuracy["holdout_with_them"]
    assert counted.poses == 60
    assert counted.rms_mm > 3.0 * fit.within.after.rms_mm


def test_without_any_nothing_is_said():
    fit = mc.calibrate("irb120", simulate("irb120", 60, 2, seed=1, truth=TRUTH).data, "sum")
    assert fit.set_aside == ()
    assert fit.to_dict()["set_aside"] == []
    assert "holdout_with_them" not in fit.to_dict()["accuracy"]
    assert "set aside" not in fit.headline()


@pytest.mark.parametrize("options", [{"trim": 0.05}, {"loss": "tukey"}])
def test_what_a_robust_fit_gives_no_weight_is_listed(options):
    data, lines = spoilt()
    fit = mc.calibrate("irb120", data, "sum", **options)  # type: ignore[arg-type]
    train = set(fit.train.line)
    assert {p.row for p in fit.set_aside} == {line for line in lines if line in train}
    assert {p.by for p in fit.set_aside} == {TOOL}
    assert next(iter(options)) in fit.set_aside[0].why


def test_a_target_that_hardly_any_pose_shows_is_listed():
    data = simulate("irb120", 60, 3, seed=1, truth=TRUTH).data
    y = data.y.copy()
    y[2:, 2] = np.nan
    fit = mc.calibrate("irb120", data.with_y(y), "sum")
    assert [(p.row, p.target, p.by) for p in fit.set_aside] == [
        (line, "smr3", TOOL) for line in data.line[:2]]  # fmt: skip
    assert fit.accuracy["holdout_with_them"].rms_mm == fit.accuracy["holdout"].rms_mm or (
        fit.error_crossed.size
    )


def test_effects_and_sessions_reach_points_set_aside():
    """Their errors need the moves and the clock of the visits, which they were among."""
    data, lines = spoilt(120)
    marked = np.isin(data.line, lines)[:, None] & np.ones(3, dtype=bool)
    some = set_aside(data, marked, "marked deleted", FILE)
    fit = mc.calibrate("irb120", some, "sum", effects=["backlash:J1", "frame_drift"])
    assert {p.by for p in fit.set_aside} == {FILE}
    assert_allclose(fit.accuracy["holdout_with_them"].max_mm, 1.0, rtol=0.15)
