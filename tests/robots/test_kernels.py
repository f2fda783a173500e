"""The kernels: compiled and NumPy's alike, and both against the Jacobian written out."""

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.modelling.model import Model, arrays_of, model_of
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.kernels import choice, plain, sums

Arrays = tuple[np.ndarray, ...]
ALIKE = 1e-12  # relative to the largest entry
POSES = 210  # more than a block of the compiled kernels


@pytest.fixture
def fast() -> ModuleType:
    pytest.importorskip("numba", reason="numba is not installed: pip install 'minimax-cal[fast]'")
    from minimax_cal.robots.kernels import fast

    return fast


def cell(name: str, robots: int, effects: int, rng: np.random.Generator) -> tuple[Model, State]:
    """An arm amid measurements with holes and weights, and a batch of states near the truth."""
    sim = mc.simulate(mc.load_robot(name), POSES, 2, 0)
    y = sim.data.y.copy()
    y[rng.random(y.shape[:2]) < 0.2] = np.nan
    model = model_of(sim.cell.robot, sim.data.with_y(y))
    fields, moved = (
        1e-3 * rng.normal(size=(effects, *model.y.shape)),
        1e-4 * rng.normal(size=model.y.shape),
    )
    weight = model.weight * rng.uniform(0.5, 2.0, model.weight.shape)
    names = replace(model.names, effects=tuple(f"e{i}" for i in range(effects)))
    model = replace(
        model, names=names, weight=weight, active=np.ones(names.count, dtype=bool),
        fields=fields if effects else model.fields, moved=moved if effects else model.moved,
    )  # fmt: skip
    begin = replace(sim.cell.state, effects=np.zeros(effects)).repeat(robots)
    return model, begin.step(1e-3 * rng.normal(size=(robots, names.count)))


CELLS = [("irb120", 1, 0), ("irb2600", 3, 2), ("scara_600", 2, 0), ("scara_600", 1, 3)]


def near(found: Arrays, wanted: Arrays, alike: float = ALIKE) -> None:
    for mine, other in zip(found, wanted, strict=True):
        assert mine.shape == other.shape
        assert_allclose(mine, other, rtol=0, atol=alike * np.abs(other).max(initial=0.0))


@pytest.mark.parametrize(("name", "robots", "effects"), CELLS)
def test_pairs(name, robots, effects, fast, rng):
    model, state = cell(name, robots, effects, rng)
    at, seen = arrays_of(state), model.sight
    (mdh, *place), (q, prismatic, *_) = at, seen
    near(fast.chain(mdh, q, prismatic), plain.chain(mdh, q, prismatic))
    arm = plain.unwound(mdh, q, prismatic, 20, 90)
    near((fast.unwound(mdh, q, prismatic, 20, 90),), (arm,))
    near(fast.sighted(arm, *place, *seen[2:], 20), plain.sighted(arm, *place, *seen[2:], 20))
    near((sums.cost(fast, at, seen),), (sums.cost(plain, at, seen),))
    one = tuple(part[:1] for part in at)
    for share in (1.0, 0.6):
        which = np.flatnonzero(rng.random(model.names.count) < share)
        step = 1e-2 * rng.normal(size=len(which))
        near(sums.normal(fast, at, seen, which), sums.normal(plain, at, seen, which))
        near(sums.rows(fast, one, seen, which, 20, 90), sums.rows(plain, one, seen, which, 20, 90))
        near(sums.squares(fast, one, seen, which), sums.squares(plain, one, seen, which))
        near(fast.stepped(*one, which, step), plain.stepped(*one, which, step))


def test_a_system_that_is_not_definite_is_told(fast, rng):
    """And one that is has its solution; the last row repeats the first."""
    rows = rng.normal(size=(1, 3, 20, 6))
    right, off, hold = rng.normal(size=(1, 3, 6)), rng.normal(size=6), np.zeros(6)
    for hold in (np.zeros(6), rng.uniform(size=6)):
        gram = np.swapaxes(rows, 2, 3) @ rows
        given = rng.uniform(size=(1, 3)), right, gram, off, hold
        found, wanted = fast.solved(*given), plain.solved(*given)
        assert_allclose(found[0], wanted[0], rtol=1e-11)
        assert_allclose(found[1:3], wanted[1:3], rtol=1e-11)
        assert found[3]
        assert wanted[3]
        total = gram[0].sum(axis=0) + np.diag(hold)
        assert_allclose(total @ wanted[0], right[0].sum(axis=0) + hold * off, rtol=1e-9)
    rows[..., -1] = rows[..., 0]
    given = given[0], right, np.swapaxes(rows, 2, 3) @ rows, off, np.zeros(6)
    assert not fast.solved(*given)[3]
    assert not plain.solved(*given)[3]


@pytest.mark.parametrize(("name", "robots", "effects"), CELLS)
def test_rows_make_the_normal_equations(name, robots, effects, rng):
    model, state = cell(name, 1, effects, rng)
    which = np.flatnonzero(rng.random(model.names.count) < 0.8)
    given = plain, arrays_of(state), model.sight, which
    error, J = sums.rows(*given, 0, POSES)
    cost, gradient, gram = sums.normal(*given)
    made = (
        (error**2).sum(axis=(1, 2)),
        np.einsum("kpic,kic->kp", J, error),
        np.einsum("kpic,kqic->kpq", J, J),
    )
    near(made, (cost[0], gradient[0], gram[0]))
    f, slope = sums.squares(*given)
    near((f.sum(axis=1), slope.sum(axis=1)), (cost[0], -2.0 * gradient[0]))


@pytest.mark.parametrize(("name", "robots", "effects"), CELLS)
def test_normal_equations_are_those_of_the_jacobian(name, robots, effects, rng):
    model, state = cell(name, robots, effects, rng)
    which = np.flatnonzero(rng.random(model.names.count) < 0.8)
    cost, gradient, gram = sums.normal(plain, arrays_of(state), model.sight, which)
    error, J = np.nan_to_num(model.error(state)), model.jacobian(state)[..., which]
    weight = model.weight[..., None]
    near(
        (cost, gradient, gram),
        (
            (weight * error**2).sum(axis=(-1, -2)),
            np.einsum("km,bkmi,bkmip->bkp", model.weight, error, J),
            np.einsum("km,bkmip,bkmiq->bkpq", model.weight, J, J),
        ),
    )
    near((sums.cost(plain, arrays_of(state), model.sight),), (cost,))


@pytest.mark.parametrize(("name", "effects"), [("irb120", 0), ("irb2600", 2)])
def test_plain_steps_end_alike(name, effects, fast, rng):
    model, state = cell(name, 1, effects, rng)
    names = ("a1", "a2", "a3", "theta2", "theta3", "theta4", "theta5")
    told = [model.names.index(one) for one in names]  # by any poses
    which = np.array([*told, *range(5 * model.names.joints, model.names.count)])
    prior = np.full(len(which), 1e-3), np.where(which < 5 * model.names.joints, 1e-3, 0.0)
    ends = [
        sums.descend(module, arrays_of(state), model.sight, which, prior, 1e-12, 15)
        for module in (fast, plain)
    ]
    assert ends[0][-1]
    assert ends[1][-1]
    near(ends[0][0], ends[1][0], alike=1e-10)  # systems of a condition of 1e4
    near(ends[0][1:2], ends[1][1:2], alike=1e-10)


def test_polish(fast, rng):
    truth = Rotation.random(rng=rng).as_matrix()
    matrix = rng.normal(size=(10, 9))
    right = matrix @ truth.reshape(9) + 1e-3 * rng.normal(size=10)
    starts = np.stack([truth @ plain.turned(0.5 * rng.normal(size=3)) for _ in range(8)])
    ends = [module.polish(matrix, right, starts) for module in (fast, plain)]
    assert ends[0][1].min() < 1e-5
    near(ends[0], ends[1], alike=1e-9)
    best = ends[1][0][np.argmin(ends[1][1])]
    assert_allclose(best @ best.T, np.eye(3), rtol=0, atol=1e-14)
    assert_allclose(best, truth, rtol=0, atol=5e-3)


def test_choice(monkeypatch, fast):
    choice.best.cache_clear()
    monkeypatch.setenv(choice.SWITCH, "plain")
    assert choice.kernels() is plain
    choice.best.cache_clear()
    monkeypatch.delenv(choice.SWITCH)
    assert choice.kernels() is fast
    with choice.work(brief=True):
        assert choice.kernels() is plain
        with choice.work(brief=False):
            assert choice.kernels() is fast
    assert choice.kernels() is fast


def test_without_numba_numpy_answers(monkeypatch):
    choice.best.cache_clear()
    monkeypatch.delenv(choice.SWITCH, raising=False)
    monkeypatch.setattr(choice.util, "find_spec", lambda name: None)
    assert choice.kernels() is plain
    choice.best.cache_clear()


@pytest.mark.parametrize("name", ["plain", "fast"])
def test_targets_alone_may_be_free(name, request, rng):
    own = plain if name == "plain" else request.getfixturevalue(name)
    model, state = cell("irb120", 1, 0, rng)
    given = plain, arrays_of(state), model.sight
    first, every = 5 * 6 + 6, np.arange(model.names.count)
    whole = sums.normal(*given, every)
    cost, gradient, gram = sums.normal(own, *given[1:], every[first:])
    near((cost, gradient, gram), (whole[0], whole[1][..., first:], whole[2][..., first:, first:]))
