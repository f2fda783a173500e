"""Noises that are not alike are told from those that are, and found in size."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_fit import study

from minimax_cal.diagnosing import scatter
from minimax_cal.diagnosing.scatter import WholePoses, motions, weighed, weighed_anew
from minimax_cal.diagnosing.study import SUM, Study, studied
from minimax_cal.evidence.limits import LEAST_DOF
from minimax_cal.evidence.noise import restricted
from minimax_cal.fitting.options import silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.arrays import Array

QUIET, LOUD = 1e-5, 1e-4  # joints [rad]
POINT = 2e-5  # of a coordinate [m]


@pytest.fixture(scope="module")
def plain() -> Study:
    return study(0.0, 0.01, 0, poses=100)


def drawn(made: Study, joints: Array, along: float, across: float, seed: int) -> Study:
    """The study with errors of given noises: joints (n,) [rad], of a coordinate [m]."""
    rng = np.random.default_rng(seed)
    moved, sight = motions(made)
    sizes = (*joints, along, across)
    fields = [(part, size) for part, size in zip((*moved, *sight), sizes, strict=True)]
    y = sum(size * np.einsum("dkcm,dm->kcm", part, rng.normal(size=(len(part), made.scene.poses)))
            for part, size in fields)  # fmt: skip
    moved = np.moveaxis(np.asarray(y), -1, 0) @ made.fit.state.rotation.T
    data = made.data.with_y(made.data.y + moved)
    return studied(made.robot, data, fit_cell(made.robot, data, SUM, silent))


def nothing(made: Study) -> Array:
    return np.zeros((len(made.rows.error), 0))


def test_noises_that_are_alike_stay_so(plain: Study) -> None:
    for seed in range(4):
        made = drawn(plain, np.full(6, QUIET), POINT, POINT, seed)
        assert weighed_anew(made, nothing(made)) is made


def test_a_wrist_that_scatters_hides_the_shoulder_no_more(plain: Study) -> None:
    """A turn of joint 1 is seen by so much more as its own scatter is smaller than the mean."""
    joints = np.full(6, QUIET)
    joints[4:] = 3.0 * LOUD
    made = drawn(plain, joints, POINT, POINT, 1)
    found = weighed_anew(made, nothing(made))
    seen = []
    for one in (made, found):
        arm = one.rows.of(plain.scene.jacobian[:1])[:, 0]
        seen.append(float(restricted(one.rows, nothing(one)).weights(one.rows) @ arm**2))
    assert seen[1] > 3.0 * seen[0]
    assert seen[1] < 1.5 * plain.scene.poses / QUIET**2  # by its scatter alone, which is estimated


def test_an_instrument_whose_directions_differ(plain: Study) -> None:
    still = 0.2 * QUIET
    made = drawn(plain, np.full(6, still), 0.4 * POINT, 1.5 * POINT, 2)
    found = weighed_anew(made, nothing(made))
    _, sight = motions(made)
    variance = 1.0 / restricted(found.rows, nothing(found)).weights(found.rows)
    m, r = found.rows.weight.shape
    arm = found.rows.of(plain.scene.jacobian).reshape(m, r, -1)
    for part, size in zip(sight, (0.4 * POINT, 1.5 * POINT), strict=True):
        rows = found.rows.of(part).reshape(m, r, -1)
        told = np.einsum("mrd,mr->md", rows**2, variance.reshape(m, r)).mean()
        of_joints = still**2 * (np.einsum("mrd,mrj->mdj", rows, arm) ** 2).sum(axis=2).mean()
        assert abs(told - of_joints - size**2) < 0.2 * POINT**2
    mean = (0.4**2 + 2.0 * 1.5**2) / 3.0 * POINT**2
    assert abs(found.uneven * restricted(found.rows, nothing(found)).variance / mean - 1.0) < 0.2


def test_the_slope_is_that_of_the_likelihood(plain: Study) -> None:
    made = drawn(plain, np.full(6, QUIET), POINT, POINT, 3)
    joints, sight = motions(made)
    rest = WholePoses.of(made, nothing(made), np.ones(made.scene.poses, dtype=bool))
    parts = np.concatenate([rest.products(joints), rest.products(sight)])
    at = np.log(np.array([*np.linspace(0.5, 2.0, 6) * QUIET, POINT, 2.0 * POINT]) ** 2)
    _, slope = rest.cost(at, parts)
    step = 1e-4 * np.eye(len(at))
    steps = [rest.cost(at + d, parts)[0] - rest.cost(at - d, parts)[0] for d in step]
    assert_allclose(slope, np.array(steps) / 2e-4, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(("along", "across"), [(0.4, 1.5), (1.5, 0.4), (0.01, 1.0)])
def test_weighed_rows_have_the_covariance_of_the_noises(
    plain: Study, along: float, across: float
) -> None:
    """With the variance of the best direction, and the joints' RMS as their scatter."""
    joints = QUIET * np.arange(1.0, 7.0)
    variance = (POINT * np.array([along, across])) ** 2
    turned, sight = motions(plain)
    found = weighed(plain, joints, sight, variance)
    assert_allclose(found.uneven, (variance[0] + 2.0 * variance[1]) / 3.0 / variance.min()
                    if variance.min() > 1e-3 * variance.max() else 20.0, rtol=1e-12)  # fmt: skip
    mean = (variance[0] + 2.0 * variance[1]) / 3.0
    best = mean / found.uneven
    alike = best + np.mean(joints**2) * found.rows.size * found.rows.variance_ratio
    m, r = found.rows.weight.shape
    told = (found.rows.turn * alike.reshape(m, 1, r)) @ np.swapaxes(found.rows.turn, 1, 2)

    def spread(field: Array) -> Array:
        flat = np.moveaxis(field.reshape(len(field), r, m), -1, 0)
        return np.asarray(np.swapaxes(flat, 1, 2) @ flat)

    size = np.maximum(variance, best)
    expected = sum(joint**2 * spread(part) for joint, part in zip(joints, turned, strict=True))
    expected = expected + sum(s * spread(part) for s, part in zip(size, sight, strict=True))
    assert_allclose(told, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_motions_are_those_of_a_point_of_unit_weight(plain: Study) -> None:
    heavy = replace(plain, model=replace(plain.model, weight=4.0 * plain.model.weight))
    joints, sight = motions(plain)
    for one, other in zip(sight, motions(heavy)[1], strict=True):
        assert_allclose(other, 0.5 * one, rtol=1e-12)
    assert_allclose(motions(heavy)[0], joints, rtol=0, atol=0)
    flat = np.concatenate(sight)
    assert_allclose(np.einsum("dkcm,dlem->mkcle", flat, flat),
                    np.broadcast_to(np.eye(9).reshape(3, 3, 3, 3), (plain.scene.poses, 3, 3, 3, 3)),
                    atol=1e-12)  # fmt: skip


def test_poses_that_lack_a_point_do_not_count(plain: Study) -> None:
    """Joints scatter unlike each other at the other poses, and that is found."""
    joints = np.array([1.0, 1.0, 1.0, 1.0, 30.0, 30.0]) * QUIET
    made = drawn(plain, joints, POINT, POINT, 1)
    y = made.data.y.copy()
    y[::9, 0] = np.nan
    part = made.data.with_y(y)
    some = studied(made.robot, part, fit_cell(made.robot, part, SUM, silent))
    found = weighed_anew(some, nothing(some))
    assert found is not some
    assert 0.8 < restricted(found.rows, nothing(found)).jitter / np.sqrt(np.mean(joints**2)) < 1.25


def test_of_few_poses_or_of_computed_points_nothing_is_said(
    plain: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scatter, "CERTAIN", 1.0)  # noises alike are weighed anew too
    made = drawn(plain, np.full(6, QUIET), POINT, POINT, 1)
    rows = 3 * made.scene.targets
    few = -(-(made.rows.basis.shape[1] + int(LEAST_DOF)) // rows)  # poses that are just enough
    for count in (few - 1, few):
        data = made.data.take(np.arange(made.scene.poses) < count)
        some = studied(made.robot, data, made.fit)
        assert (weighed_anew(some, nothing(some)) is some) == (count < few)
    spare = rows * few - made.rows.basis.shape[1] - int(LEAST_DOF)
    columns = np.eye(rows * few)[:, : spare + 1]  # each known column costs a degree of freedom
    assert weighed_anew(some, columns[:, :spare]) is not some
    assert weighed_anew(some, columns) is some
    usual = np.sqrt(restricted(made.rows, nothing(made)).variance)
    for size, told in ((1e-2, False), (1e2, True)):
        error = size * made.rows.exact / usual * made.rows.error
        exact = replace(made, rows=replace(made.rows, error=error))
        assert (weighed_anew(exact, nothing(exact)) is exact) != told
