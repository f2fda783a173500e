"""Visits to one pose that contradict each other: known points moved, and sound arms."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.fitting.second_visits import contradictions, nearest
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.simulate import Truth, simulate

NOISE = 0.02e-3  # [m]


def visited(robot: mc.Robot, *, twice: int = 12, seed: int = 0) -> tuple[Measurements, Array]:
    """40 poses of which some stand twice in the file, and the errors of the true arm (k, m, 3)."""
    data = simulate(robot, 40, 2, seed, Truth(compliance=0.0, noise=0.0, noise_per_metre=0.0)).data
    rows = np.r_[0:40, 0:twice]
    data = data.take(rows)
    data = replace(data, line=np.arange(2, 2 + len(rows)), columns={})
    noise = np.random.default_rng(seed).normal(0.0, NOISE, data.y.shape)
    return data.with_y(data.y + noise), np.moveaxis(noise, 1, 0)


def moved(data: Measurements, error: Array, row: int, off: float) -> tuple[Measurements, Array]:
    """The same, a point of the first target elsewhere [m]."""
    y, error = data.y.copy(), error.copy()
    y[row, 0, 2] += off
    error[0, row, 2] += off
    return data.with_y(y), error


def test_the_nearest_other_visit_by_brute_force():
    rng = np.random.default_rng(4)
    points, group = rng.normal(size=(2, 9, 3)), np.array([0, 1, 0, 2, 0, 1, 3, 4, 4])
    points[1, 8] = np.nan
    apart, other, amid = nearest(points, group)
    for target in range(2):
        for row in range(9):
            rest = [i for i in np.flatnonzero(group == group[row]) if i != row]
            far = [np.linalg.norm(points[target, row] - points[target, i]) for i in rest]
            if not rest or np.isnan(far).all():
                assert np.isnan(apart[target, row])
            else:
                assert_allclose(apart[target, row], np.nanmin(far), rtol=1e-12)
                assert_allclose(amid[target, row], np.nanmedian(far), rtol=1e-12)
                assert other[target, row] == rest[int(np.nanargmin(far))]


def test_a_point_that_its_own_second_visit_contradicts(robot):
    """Whichever of both is wrong, the fit tells; far less than a fit alone would find."""
    for row, right in ((3, 43), (43, 3)):
        (text,) = contradictions(*moved(*visited(robot), row, 20.0 * NOISE))
        assert f"line {row + 2} smr1 is " in text
        assert f"from line {right + 2}, which fits" in text
        assert text.count("smr") == 1


def test_a_fit_that_does_not_know_does_not_say_which(robot):
    data, error = moved(*visited(robot), 3, 20.0 * NOISE)
    field = 1e-3 * np.ones(3)  # what the model lacks at both visits
    (text,) = contradictions(data, error + field)
    assert "smr1" in text
    assert "which fits" not in text


def test_three_visits_tell_without_a_fit(robot):
    data, error = visited(robot)
    rows = np.r_[0:52, 0:12]
    data = replace(data.take(rows), line=np.arange(2, 66))
    fresh = np.random.default_rng(9).normal(0.0, NOISE, (12, *data.y.shape[1:]))
    y = data.y.copy()
    y[52:] += fresh
    error = error[:, rows] + 1e-3
    error[:, 52:] += np.moveaxis(fresh, 1, 0)
    (text,) = contradictions(*moved(data.with_y(y), error, 43, 30.0 * NOISE))
    assert "line 45 smr1" in text or "from line 45" in text
    assert text.count("smr") == 1


def test_sound_visits_and_few_visits_say_nothing(robot):
    """A distance of four times that of 95 % of all is one of eight sigmas."""
    assert not any(list(contradictions(*visited(robot, seed=seed))) for seed in range(60))
    assert not list(contradictions(*moved(*visited(robot, twice=4), 3, 1e-3)))
    assert not list(contradictions(*moved(*visited(robot, twice=0), 3, 1e-3)))


def test_calibrate_and_diagnose_tell(robot):
    data, _ = moved(*visited(robot), 3, 20.0 * NOISE)
    for notices in (
        mc.calibrate(robot, data, objective="sum").notices,
        mc.diagnose(robot, data, quick=True).notices,
    ):
        (text,) = [one for one in notices if "contradict each other" in one]
        assert "line 5 smr1" in text or "from line 5" in text


def test_the_same_pose_under_another_load_contradicts_nothing(robot):
    data, error = visited(robot)
    for row in (40, 41, 42):
        data, error = moved(data, error, row, 25.0 * NOISE)
    assert list(contradictions(data, error))
    load = np.where(np.isin(np.arange(data.poses), (40, 41, 42)), 20.0, 0.0)
    assert not list(contradictions(replace(data, columns={"payload": load}), error))
