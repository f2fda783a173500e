"""Robust fits through `calibrate`."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.modelling.simulate import Simulation, Truth, simulate


@pytest.fixture
def robot() -> mc.Robot:
    return mc.load_robot("irb2600")


def spoilt(made: Simulation, share: float = 0.05, size: float = 1e-3) -> mc.Measurements:
    """A share of all points moved by `size` [m] in random directions."""
    rng = np.random.default_rng(0)
    y = made.data.y.copy()
    points = y.reshape(-1, 3)
    chosen = rng.permutation(len(points))[: round(share * len(points))]
    way = rng.normal(size=(len(chosen), 3))
    points[chosen] += size * way / np.linalg.norm(way, axis=1, keepdims=True)
    return made.data.with_y(y)


@pytest.mark.parametrize(
    "options",
    [
        {"objective": "sum", "loss": "huber"},
        {"objective": "sum", "loss": "tukey"},
        {"objective": "minimax", "trim": 0.1},
        {"objective": "point", "trim": 0.1},
        {"objective": "pose", "loss": "tukey"},
        {"objective": "smr:2", "loss": "tukey"},
    ],
)
def test_wrong_points_do_no_harm(robot, options):  # type: ignore[type-arg]
    made = simulate(robot, 80, 3, seed=14, truth=Truth(compliance=0))
    new = np.random.default_rng(1).uniform(-2, 2, (200, 6))
    truth = made.cell.predict(new)

    def miss(data: mc.Measurements, **chosen: object) -> float:
        fit = mc.calibrate(robot, data, **chosen)  # type: ignore[arg-type]
        assert fit.status == "converged"
        return float(np.sqrt(((fit.predict(new) - truth) ** 2).mean()))

    clean = miss(made.data, objective=options["objective"])
    assert miss(spoilt(made), **options) < 2.0 * clean
    assert miss(spoilt(made), objective=options["objective"]) > 3.0 * clean


def test_suspects_reach_table_and_json(robot):
    made = simulate(robot, 60, 3, seed=15, truth=Truth(compliance=0))
    fit = mc.calibrate(robot, spoilt(made), "point", holdout=0.0, trim=0.1)
    content = json.loads(fit.json())
    assert content["loss"] == "square"
    assert len(content["suspects"]) == len(fit.suspects) >= 9
    for row, one in zip(content["suspects"], fit.suspects, strict=True):
        assert {"line", "target", "distance_mm", "score"} <= set(row)
        assert row["distance_mm"] == pytest.approx(1e3 * one.distance)
    assert any("outliers" in table.title for table in fit.tables())
    assert (fit.weights == 0.0).sum() == 9
    # the points that decide are named among those that were kept
    assert (fit.weights > 0.0).sum() == 171
    kept = np.linalg.norm(fit.errors["train"], axis=-1)[fit.weights > 0.0]
    assert 1e3 * kept.max() == pytest.approx(fit.minimax.table().rows[0][1], rel=1e-6)
    aside = {(s.target, s.line) for s in fit.suspects[:9]}
    assert not aside & {tuple(name.split(" line ")) for name in fit.minimax.functions}
    assert fit.provenance.settings["trim"] == 0.1


def test_sigma_of_a_robust_fit_is_its_scatter(robot):
    """As for least squares, with one point in twenty off by a millimetre."""
    scores: dict[str, list[float]] = {"huber": [], "tukey": []}
    for seed in range(8):
        made = simulate(robot, 40, 3, seed, Truth(compliance=0))
        perfect = made.data.with_y(made.cell.predict(made.data.q))
        exact = mc.calibrate(robot, perfect, "sum", holdout=0.0)
        for loss, found in scores.items():
            fit = mc.calibrate(robot, spoilt(made), "sum", holdout=0.0, loss=loss)
            # the base stands in axes of its own, which wrong points turn
            found += [
                (noisy.value - true.value) / noisy.sigma
                for noisy, true in zip(fit.parameters, exact.parameters, strict=True)
                if noisy.identifiable and not noisy.name.startswith("base_")
            ]
    for found in scores.values():
        square = np.mean(np.square(found))
        assert abs(square - 1.0) < 5 * np.sqrt(2 / len(found)) * 2


def test_robust_fits_take_priors_and_effects(robot):
    made = simulate(robot, 60, 3, seed=16)  # with compliance
    data = spoilt(made)
    held = mc.calibrate(robot, data, "sum", loss="tukey", priors={"a2": 1e-9})
    assert_allclose(next(p.value for p in held.parameters if p.name == "a2"), 0.9, atol=1e-8)
    clean = mc.calibrate(robot, made.data, "sum", effects="joint_compliance:all")
    fit = mc.calibrate(robot, data, "sum", effects="joint_compliance:all", loss="tukey")
    assert fit.status == "converged"
    for one, other in zip(fit.parameters, clean.parameters, strict=True):
        if ":" in one.name and other.identifiable:
            assert abs(one.value - other.value) < 6.0 * other.sigma
