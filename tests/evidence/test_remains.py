"""Does anything remain: false alarms, what is found, and how large it is said to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minimax_cal.core.arrays import Array
from minimax_cal.selection.noise_model import LinearProblem, Noise, orthonormal_basis
from minimax_cal.selection.remaining_structure import (
    MAX_VISITS_PER_BLOCK,
    FadingMemory,
    StructureComponent,
    WhitenedResidual,
    correct_leverage,
    count_earlier_occurrences,
    find_remaining_structure,
    whiten_residual,
)

VISITS, WIDTH = 80, 6
PLAIN = Noise(0.0, 1.0, 0.0)
STRAIGHT = np.tile(np.eye(WIDTH), (VISITS, 1, 1))


def problem(rng: np.random.Generator, error: Array) -> LinearProblem:
    """Rows beside eight nuisance columns."""
    rows = VISITS * WIDTH
    return LinearProblem(
        error=error,
        nuisance_basis=orthonormal_basis(rng.normal(size=(rows, 8))),
        variance_ratio=np.ones(rows),
        mean_variance_ratio=1.0,
        row_groups=np.repeat(np.arange(VISITS), WIDTH),
        measured=np.ones(rows, dtype=bool),
        rounding_noise=1e-9,
    )


def places(rng: np.random.Generator) -> list[StructureComponent]:
    """Four places, three drivers each."""
    x = rng.uniform(-1.0, 1.0, (3, VISITS))
    drivers = {f"driver {i + 1}": np.array([[u, u**2, np.cos(3.0 * u)]]) for i, u in enumerate(x)}
    out = []
    for place in "ABCD":
        motion = rng.normal(size=(VISITS * WIDTH, 1))
        out += [StructureComponent(place, name, motion, f) for name, f in drivers.items()]
    return out


def rest(rng: np.random.Generator, error: Array) -> WhitenedResidual:
    """What is left of an error."""
    none = np.zeros((len(error), 0))
    return whiten_residual(problem(rng, error), PLAIN, none, STRAIGHT)


def test_what_fades_is_the_root_of_its_covariance():
    rng = np.random.default_rng(4)
    order, felt = rng.permutation(30), rng.normal(size=(2, 30, 5))
    lag = np.arange(30)[:, None] - np.arange(30)
    root = np.where(lag >= 0, 0.6 ** np.maximum(lag, 0), 0.0)
    expected = ((root @ felt[:, order]) ** 2).sum(axis=(0, 1))
    assert np.allclose(FadingMemory(order, 0.6).score_products(felt), expected, rtol=1e-12)


def test_noise_is_called_remains_as_often_as_the_level_says():
    rng = np.random.default_rng(5)
    chances = []
    for _ in range(60):
        what = places(rng)
        chances.append(
            find_remaining_structure(rest(rng, rng.normal(size=VISITS * WIDTH)), what)
            .significant_components[0]
            .p
        )
    rare = np.mean(np.array(chances) < 0.05)
    assert rare < 0.14  # 0.05 + 3 sigma


def test_a_motion_that_scatters_by_itself_is_no_remainder():
    rng = np.random.default_rng(6)
    chances = []
    for _ in range(25):
        what = places(rng)
        shaken = what[0].motion_columns[:, 0] * np.repeat(rng.normal(size=VISITS), WIDTH)
        error = rng.normal(size=VISITS * WIDTH) + 5.0 * shaken
        error[:WIDTH] += 40.0  # and one visit that is off
        chances.append(find_remaining_structure(rest(rng, error), what).significant_components[0].p)
    assert np.mean(np.array(chances) < 0.05) < 0.15


@pytest.mark.parametrize("size", [0.35, 1.0])
def test_what_is_there_is_found_with_its_place_driver_and_size(size):
    rng = np.random.default_rng(7)
    what = places(rng)
    true = what[4]
    field = true.motion_columns[:, 0] * np.repeat(true.driver_features[0, 0], WIDTH)
    field *= size / np.sqrt(np.mean(field**2))
    found = find_remaining_structure(
        rest(rng, rng.normal(size=VISITS * WIDTH) + field), what
    ).significant_components[0]
    assert (found.place, found.driver) == (true.place, true.driver)
    assert found.place_and_driver == f"{true.place} following {true.driver}"
    assert found.p < 0.005
    assert found.square_fraction == pytest.approx(size**2 / (1.0 + size**2), rel=0.5)


def test_what_was_fitted_does_not_remain():
    rng = np.random.default_rng(8)
    what = places(rng)
    field = what[4].motion_columns[:, 0] * np.repeat(what[4].driver_features[0, 0], WIDTH)
    rows = problem(rng, rng.normal(size=VISITS * WIDTH) + 3.0 * field)
    beside = whiten_residual(rows, PLAIN, field[:, None], STRAIGHT)
    assert find_remaining_structure(beside, what).significant_components[0].p > 0.01
    assert beside.degrees_of_freedom == VISITS * WIDTH - 9
    fixed = [replace(one, motion_columns=np.zeros_like(one.motion_columns)) for one in what]
    assert find_remaining_structure(beside, fixed).significant_components == ()


def test_the_axes_of_a_visits_rows_do_not_matter():
    """Rows that are alike have any axes: those of `eigh` differ between processors."""
    rng = np.random.default_rng(9)
    what, rows = places(rng), problem(rng, rng.normal(size=VISITS * WIDTH))
    turn = np.linalg.qr(rng.normal(size=(VISITS, WIDTH, WIDTH)))[0]

    def turned(columns: Array) -> Array:
        shape = VISITS, WIDTH, -1
        return np.asarray((np.swapaxes(turn, 1, 2) @ columns.reshape(shape)).reshape(columns.shape))

    other = replace(rows, error=turned(rows.error), nuisance_basis=turned(rows.nuisance_basis))
    none = np.zeros((VISITS * WIDTH, 0))
    straight = find_remaining_structure(
        whiten_residual(rows, PLAIN, none, STRAIGHT), what
    ).significant_components
    what = [replace(one, motion_columns=turned(one.motion_columns)) for one in what]
    turned = find_remaining_structure(
        whiten_residual(other, PLAIN, none, turn), what
    ).significant_components
    for one, same in zip(straight, turned, strict=True):
        assert (one.place_and_driver, one.p) == (same.place_and_driver, same.p)
        assert (one.score, one.square_fraction) == pytest.approx(
            (same.score, same.square_fraction), rel=1e-9
        )


def test_many_visits_to_one_pose_are_evened_some_at_a_time(rng):
    """Blocks of few visits leave the rest as it was; times of a number are counted in order."""
    group = np.array([3, 1, 3, 3, 1, 2])
    assert count_earlier_occurrences(group).tolist() == [0, 0, 1, 2, 1, 0]
    m, wide, p = 200, 3, 4
    basis = np.linalg.qr(rng.normal(size=(m * wide, p)))[0]
    rows = rng.normal(size=m * wide)
    rows = (rows - basis @ (basis.T @ rows)).reshape(m, wide)
    spread = np.broadcast_to(np.eye(wide), (m, wide, wide))
    apart, one = (
        correct_leverage(rows, basis.reshape(m, wide, p), spread, g)
        for g in (np.arange(m) // MAX_VISITS_PER_BLOCK, np.zeros(m, dtype=int))
    )
    assert_allclose(one, apart, atol=1e-12)
