from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.fitting.beyond import RANK, needed
from minimax_cal.fitting.uncertainty import Poses
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import parts
from minimax_cal.modelling.simulate import Simulation, Truth, simulate


@pytest.mark.parametrize("objective", ["sum", "smr:2"])
def test_a_part_is_judged_by_a_fit_without_it(
    robot: mc.Robot, noisy: Simulation, objective: str
) -> None:
    fit = mc.calibrate(robot, noisy.data, objective, holdout=0.0)
    fold = fit.beyond.folds[0]
    part = next(p for p in parts(fit.data) if p.name == fold.where)
    labels = np.where(part.rows, "holdout", "train")
    columns = {**noisy.data.columns, "split": labels}
    fresh = mc.calibrate(robot, replace(noisy.data, columns=columns), objective)
    # one step of Gauss and Newton against the whole search
    assert_allclose(fold.rms_mm, fresh.accuracy["holdout"].rms_mm, rtol=5e-3)
    assert fold.poses == part.rows.sum()


def test_effects_stand_beside_geometry_alone(robot: mc.Robot) -> None:
    soft = simulate(robot, 80, truth=Truth(compliance=2e-6)).data
    fit = mc.calibrate(robot, soft, "sum", effects=("joint_compliance:all",))
    plain = mc.calibrate(robot, soft, "sum")
    assert fit.beyond.typical_mm < 0.6 * fit.beyond.geometric_typical_mm
    # parts that one fit needs are not judged by it, so that the folds may differ
    shared = {fold.where: fold.rms_mm for fold in plain.beyond.folds}
    for fold in fit.beyond.folds:
        assert_allclose(fold.geometric_mm, shared[fold.where], rtol=5e-3)


def test_typical_is_pooled_and_worst_is_named(robot: mc.Robot, noisy: Simulation) -> None:
    found = mc.calibrate(robot, noisy.data, "sum").beyond
    assert found.worst is not None
    assert found.worst_mm == max(fold.rms_mm for fold in found.folds)
    poses = np.array([fold.poses for fold in found.folds])
    square = np.array([fold.rms_mm**2 for fold in found.folds])
    assert_allclose(found.typical_mm**2, (poses * square).sum() / poses.sum(), rtol=1e-12)


def test_no_part_can_be_spared_of_few_poses(robot: mc.Robot) -> None:
    few = simulate(robot, 12).data
    found = mc.calibrate(robot, few, "sum", holdout=0.0, fix="beta*").beyond
    content = found.to_dict()
    assert content["typical_mm"] is None or found.folds
    if not found.folds:
        assert content["reason"]


def test_a_fit_that_extrapolates_badly_says_so(robot: mc.Robot) -> None:
    """An arm whose second joint has a gear error: regions miss by more than poses between."""
    rng = np.random.default_rng(3)
    ideal = simulate(robot, 300, seed=5)
    wave = 1e-3 * np.sin(2.0 * ideal.data.q[:, 1] + rng.uniform(0, 6))
    bent = ideal.data.q + wave[:, None] * np.eye(6)[1]
    data = ideal.data.with_y(ideal.cell.predict(bent))
    fit = mc.calibrate(robot, data, "sum")
    assert fit.beyond.worst_mm > 1.3 * fit.accuracy["holdout"].rms_mm
    assert "joint 2" in fit.beyond.worst.where


@dataclass(frozen=True, eq=False)
class Rows:
    """Poses of two parameters, whose columns are (m, 2), beside a prior of these weights."""

    rows: Array
    weights: float

    @property
    def bread(self) -> Array:
        return self.gram_of(np.ones(len(self.rows), dtype=bool)) + self.weights * np.eye(2)

    def gram_of(self, part: Array) -> Array:
        return cast(Array, self.rows[part].T @ self.rows[part])


@pytest.mark.parametrize("weight", [0.0, 1e-2 * RANK**2])
@pytest.mark.parametrize(
    ("apart", "lost"),
    [([1.0, 1.0, 1.0, 1.0], False), ([0.0, 0.0, 0.0, 0.0], False), ([1.0, 0.0, 0.0, 0.0], True)],
)
def test_what_no_pose_tells_costs_no_part(apart: list[float], lost: bool, weight: float) -> None:
    """Of two parameters with nearly the same columns: told by all poses, by none, by the first."""
    rows: Any = np.stack([np.ones(4), 1.0 + np.array(apart) * [1e-2, -1e-2, 1e-2, -1e-2]], axis=1)
    poses = Rows(rows, weight)
    assert needed(cast(Poses, poses), np.arange(4) == 0) is lost
