"""Does anything remain: false alarms, what is found, and how large it is said to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minimax_cal.evidence.noise import Noise, Problem, orthonormal
from minimax_cal.evidence.remains import (
    TOGETHER,
    Component,
    Fading,
    Rest,
    asked,
    evened,
    rest_of,
    times_before,
)
from minimax_cal.ground.arrays import Array

VISITS, WIDTH = 80, 6
PLAIN = Noise(0.0, 1.0, 0.0)
STRAIGHT = np.tile(np.eye(WIDTH), (VISITS, 1, 1))


def problem(rng: np.random.Generator, error: Array) -> Problem:
    """Rows beside eight nuisance columns."""
    rows = VISITS * WIDTH
    return Problem(
        error=error,
        basis=orthonormal(rng.normal(size=(rows, 8))),
        variance_ratio=np.ones(rows),
        size=1.0,
        group=np.repeat(np.arange(VISITS), WIDTH),
        measured=np.ones(rows, dtype=bool),
        exact=1e-9,
    )


def places(rng: np.random.Generator) -> list[Component]:
    """Four places, three drivers each."""
    x = rng.uniform(-1.0, 1.0, (3, VISITS))
    drivers = {f"driver {i + 1}": np.array([[u, u**2, np.cos(3.0 * u)]]) for i, u in enumerate(x)}
    out = []
    for place in "ABCD":
        motion = rng.normal(size=(VISITS * WIDTH, 1))
        out += [Component(place, name, motion, f) for name, f in drivers.items()]
    return out


def rest(rng: np.random.Generator, error: Array) -> Rest:
    """What is left of an error."""
    none = np.zeros((len(error), 0))
    return rest_of(problem(rng, error), PLAIN, none, STRAIGHT)


def test_what_fades_is_the_root_of_its_covariance():
    rng = np.random.default_rng(4)
    order, felt = rng.permutation(30), rng.normal(size=(2, 30, 5))
    lag = np.arange(30)[:, None] - np.arange(30)
    root = np.where(lag >= 0, 0.6 ** np.maximum(lag, 0), 0.0)
    expected = ((root @ felt[:, order]) ** 2).sum(axis=(0, 1))
    assert np.allclose(Fading(order, 0.6).score(felt), expected, rtol=1e-12)


def test_noise_is_called_remains_as_often_as_the_level_says():
    rng = np.random.default_rng(5)
    chances = []
    for _ in range(60):
        what = places(rng)
        chances.append(asked(rest(rng, rng.normal(size=VISITS * WIDTH)), what).loud_ones[0].p)
    rare = np.mean(np.array(chances) < 0.05)
    assert rare < 0.14  # 0.05 + 3 sigma


def test_a_motion_that_scatters_by_itself_is_no_remainder():
    rng = np.random.default_rng(6)
    chances = []
    for _ in range(25):
        what = places(rng)
        shaken = what[0].motion[:, 0] * np.repeat(rng.normal(size=VISITS), WIDTH)
        error = rng.normal(size=VISITS * WIDTH) + 5.0 * shaken
        error[:WIDTH] += 40.0  # and one visit that is off
        chances.append(asked(rest(rng, error), what).loud_ones[0].p)
    assert np.mean(np.array(chances) < 0.05) < 0.15


@pytest.mark.parametrize("size", [0.35, 1.0])
def test_what_is_there_is_found_with_its_place_driver_and_size(size):
    rng = np.random.default_rng(7)
    what = places(rng)
    true = what[4]
    field = true.motion[:, 0] * np.repeat(true.feature[0, 0], WIDTH)
    field *= size / np.sqrt(np.mean(field**2))
    found = asked(rest(rng, rng.normal(size=VISITS * WIDTH) + field), what).loud_ones[0]
    assert (found.place, found.driver) == (true.place, true.driver)
    assert found.name == f"{true.place} following {true.driver}"
    assert found.p < 0.005
    assert found.share == pytest.approx(size**2 / (1.0 + size**2), rel=0.5)


def test_what_was_fitted_does_not_remain():
    rng = np.random.default_rng(8)
    what = places(rng)
    field = what[4].motion[:, 0] * np.repeat(what[4].feature[0, 0], WIDTH)
    rows = problem(rng, rng.normal(size=VISITS * WIDTH) + 3.0 * field)
    beside = rest_of(rows, PLAIN, field[:, None], STRAIGHT)
    assert asked(beside, what).loud_ones[0].p > 0.01
    assert beside.dof == VISITS * WIDTH - 9
    fixed = [replace(one, motion=np.zeros_like(one.motion)) for one in what]
    assert asked(beside, fixed).loud_ones == ()


def test_the_axes_of_a_visits_rows_do_not_matter():
    """Rows that are alike have any axes: those of `eigh` differ between processors."""
    rng = np.random.default_rng(9)
    what, rows = places(rng), problem(rng, rng.normal(size=VISITS * WIDTH))
    turn = np.linalg.qr(rng.normal(size=(VISITS, WIDTH, WIDTH)))[0]

    def turned(columns: Array) -> Array:
        shape = VISITS, WIDTH, -1
        return np.asarray((np.swapaxes(turn, 1, 2) @ columns.reshape(shape)).reshape(columns.shape))

    other = replace(rows, error=turned(rows.error), basis=turned(rows.basis))
    none = np.zeros((VISITS * WIDTH, 0))
    straight = asked(rest_of(rows, PLAIN, none, STRAIGHT), what).loud_ones
    what = [replace(one, motion=turned(one.motion)) for one in what]
    turned = asked(rest_of(other, PLAIN, none, turn), what).loud_ones
    for one, same in zip(straight, turned, strict=True):
        assert (one.name, one.p) == (same.name, same.p)
        assert (one.score, one.share) == pytest.approx((same.score, same.share), rel=1e-9)


def test_many_visits_to_one_pose_are_evened_some_at_a_time(rng):
    """Blocks of few visits leave the rest as it was; times of a number are counted in order."""
    group = np.array([3, 1, 3, 3, 1, 2])
    assert times_before(group).tolist() == [0, 0, 1, 2, 1, 0]
    m, wide, p = 200, 3, 4
    basis = np.linalg.qr(rng.normal(size=(m * wide, p)))[0]
    rows = rng.normal(size=m * wide)
    rows = (rows - basis @ (basis.T @ rows)).reshape(m, wide)
    spread = np.broadcast_to(np.eye(wide), (m, wide, wide))
    apart, one = (evened(rows, basis.reshape(m, wide, p), spread, g)
                  for g in (np.arange(m) // TOGETHER, np.zeros(m, dtype=int)))  # fmt: skip
    assert_allclose(one, apart, atol=1e-12)
