from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.fitting import beyond
from minimax_cal.fitting.beyond import (
    RESOLUTION,
    needed,
    one_step,
    step_without,
    unidentified,
    without,
)
from minimax_cal.fitting.uncertainty import Poses
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.files import plain
from minimax_cal.measuring.grouping import parts
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.modelling.model import moved
from minimax_cal.modelling.simulate import Simulation, Truth, simulate


@pytest.mark.parametrize("objective", ["sum", "smr:2"])
def test_a_part_is_judged_by_a_fit_without_it(robot, noisy, objective):
    fit = mc.calibrate(robot, noisy.data, objective, holdout=0.0)
    fold = fit.beyond.folds[0]
    part = next(p for p in parts(fit.data) if p.name == fold.where)
    labels = np.where(part.rows, "holdout", "train")
    columns = {**noisy.data.columns, "split": labels}
    fresh = mc.calibrate(robot, replace(noisy.data, columns=columns), objective)
    # one step of Gauss and Newton against the whole search
    assert_allclose(fold.rms_mm, fresh.accuracy["holdout"].rms_mm, rtol=5e-3)
    assert fold.poses == part.rows.sum()


def test_effects_stand_beside_geometry_alone(robot):
    soft = simulate(robot, 80, truth=Truth(compliance=2e-6)).data
    fit = mc.calibrate(robot, soft, "sum", effects=("joint_compliance:all",))
    plain = mc.calibrate(robot, soft, "sum")
    assert fit.beyond.typical_mm < 0.6 * fit.beyond.geometric_typical_mm
    shared = {fold.where: fold.rms_mm for fold in plain.beyond.folds}
    assert [fold.where for fold in fit.beyond.folds] == list(shared)  # an effect costs no part
    for fold in fit.beyond.folds:
        assert_allclose(fold.geometric_mm, shared[fold.where], rtol=5e-3)


def test_typical_is_pooled_and_worst_is_named(robot, noisy):
    found = mc.calibrate(robot, noisy.data, "sum").beyond
    assert found.worst is not None
    assert found.worst_mm == max(fold.rms_mm for fold in found.folds)
    poses = np.array([fold.poses for fold in found.folds])
    square = np.array([fold.rms_mm**2 for fold in found.folds])
    assert_allclose(found.typical_mm**2, (poses * square).sum() / poses.sum(), rtol=1e-12)


def test_no_part_can_be_spared_of_few_poses(robot):
    few = simulate(robot, 12).data
    found = mc.calibrate(robot, few, "sum", holdout=0.0, fix="beta*").beyond
    content = plain(found)
    assert content["typical_mm"] is None or found.folds
    if not found.folds:
        assert content["reason"]


def test_a_fit_that_extrapolates_badly_says_so(robot):
    """An arm whose second joint has a gear error: regions miss by more than poses between."""
    rng = np.random.default_rng(3)
    ideal = simulate(robot, 300, seed=5)
    wave = 1e-3 * np.sin(2.0 * ideal.data.q[:, 1] + rng.uniform(0, 6))
    bent = ideal.data.q + wave[:, None] * np.eye(6)[1]
    data = ideal.data.with_y(ideal.cell.predict(bent))
    fit = mc.calibrate(robot, data, "sum")
    assert fit.beyond.worst_mm > 1.3 * fit.accuracy["holdout"].rms_mm
    assert "joint 2" in fit.beyond.worst.where


def one_end(robot: mc.Robot, poses: int = 40, half: float = 0.6) -> Measurements:
    """A last joint that turns a little about zero, but for four poses at its high end."""
    rng, ideal = np.random.default_rng(5), simulate(robot, poses, seed=5)
    q = ideal.data.q.copy()
    q[:, 5] = rng.uniform(-half, half, poses)
    q[:4, 5] = rng.uniform(2.0, 2.6, 4)
    noise = 2e-5 * rng.normal(size=ideal.data.y.shape)
    return replace(ideal.data, q=q).with_y(ideal.cell.predict(q) + noise)


def test_parts_that_effects_alone_need_are_judged_as_a_calibration_of_the_rest_would(robot):
    """Without one end of joint 6 its gear's harmonics are not told: the rest gives them up."""
    data, gear = one_end(robot), ("gear_error:J6:orders=3",)
    fit = mc.calibrate(robot, data, "sum", effects=gear)
    lost = Poses.of(fit.estimator, fit.cell.state)
    every = {part.name: part.rows for part in parts(fit.data)}
    assert [fold.where for fold in fit.beyond.folds] == list(every)
    assert fit.beyond.missed == ()
    asked = [fold for fold in fit.beyond.folds if needed(lost, every[fold.where][~fit.held])]
    assert "joint 6 at its high end" in [fold.where for fold in asked]
    for fold in asked:
        rows = every[fold.where]
        labels = {"split": np.where(rows | fit.held, "holdout", "train")}
        again = mc.calibrate(robot, replace(data, columns=labels), "sum", effects=gear)
        error = again.cell.error(again.data)[:, rows]
        assert_allclose(fold.rms_mm, 1e3 * np.sqrt((error**2).sum(axis=-1).mean()), rtol=0.01)
    assert "with the same effects" in fit.headline()
    assert fit.within.missed == 0
    assert "40 poses, each judged" in fit.headline()


def test_the_search_goes_on_where_one_step_does_not_arrive(robot):
    data = one_end(robot, 36, half=0.5)
    effects = ("gear_error:J5:orders=3", "gear_error:J6:orders=3")
    fit = mc.calibrate(robot, data, "sum", effects=effects)
    estimator, state = fit.estimator, fit.cell.state
    poses, far = Poses.of(estimator, state), 0
    effects_of = np.flatnonzero(estimator.model.active) >= estimator.model.names.geometric
    for part in (part.rows[~fit.held] for part in parts(fit.data)):
        near = moved(estimator.model, state, step_without(poses, part))
        sums = poses.sums_by_part([part])
        if unidentified(poses, sums.gram[0], effects_of).any():
            continue
        if one_step(poses, [part], sums, np.ones(1, dtype=bool)):
            continue
        far += 1
        (found,) = without(estimator, state, [part], 0)
        assert found is not None
        there = Poses.of(estimator, found)
        step, more = step_without(there, part), step_without(Poses.of(estimator, near), part)
        motion, left = (float(one @ there.normal_matrix @ one) for one in (step, more))
        assert motion < 1e-6 * left  # a further step leads nowhere
    assert far


def test_parts_that_none_can_judge_are_counted_and_named(robot):
    """Joint 6 stands still but at a few poses, which geometry cannot do without."""
    ideal = simulate(robot, 60, seed=5)
    q = ideal.data.q.copy()
    q[:, 5] = np.random.default_rng(5).uniform(-0.02, 0.02, 60)
    q[:8, 5] += 2.0
    data = replace(ideal.data, q=q).with_y(ideal.cell.predict(q))
    found = mc.calibrate(robot, data, "sum", holdout=0.0).beyond
    assert found.missed
    made = len(found.folds) + len(found.missed)
    assert (
        f"{len(found.folds)} of {made} parts (the fit needs the others) left out"
        in found.sentence()
    )
    assert found.table().rows[-1][0] == f"{len(found.folds)} of {made} parts"
    assert plain(found)["not_judged"] == list(found.missed)
    assert plain(found)["effects_sought_anew"] is None


@dataclass(frozen=True, eq=False)
class Rows:
    """Poses of two parameters, whose columns are (m, 2), beside a prior of these weights."""

    rows: Array
    weights: float

    @property
    def normal_matrix(self) -> Array:
        return self.gram_of(np.ones(len(self.rows), dtype=bool)) + self.weights * np.eye(2)

    def gram_of(self, part: Array) -> Array:
        return cast(Array, self.rows[part].T @ self.rows[part])


@pytest.mark.parametrize("weight", [0.0, 1e-2 * RESOLUTION**2])
@pytest.mark.parametrize(
    ("apart", "lost"),
    [([1.0, 1.0, 1.0, 1.0], False), ([0.0, 0.0, 0.0, 0.0], False), ([1.0, 0.0, 0.0, 0.0], True)],
)
def test_what_no_pose_tells_costs_no_part(apart, lost, weight):
    """Of two parameters with nearly the same columns: told by all poses, by none, by the first."""
    rows: Any = np.stack([np.ones(4), 1.0 + np.array(apart) * [1e-2, -1e-2, 1e-2, -1e-2]], axis=1)
    poses = Rows(rows, weight)
    assert needed(cast(Poses, poses), np.arange(4) == 0) is lost


@pytest.mark.parametrize("seed", [2, 5])
def test_no_part_left_out_makes_a_joint_yield_upwards(seed, monkeypatch):
    """Compliances near 0: one step from the whole fit would go below in some parts."""
    found, steps, plain = [], [], beyond.fit_of_rest

    def looked(poses: Poses, part: Array, gone: Array) -> Any:
        found.append(plain(poses, part, gone))
        steps.append(moved(poses.estimator.model, poses.state, step_without(poses, part)))
        return found[-1]

    monkeypatch.setattr(beyond, "fit_of_rest", looked)
    sim = simulate("irb120", 40, 3, seed=seed, truth=Truth(compliance=1e-6))
    mc.calibrate("irb120", sim.data, "sum", effects=["joint_compliance:all"])
    compliances = [
        (one.effects, each.effects) for one, each in zip(found, steps, strict=True) if one
    ]
    assert any((step < 0.0).any() for _, step in compliances)
    assert all((one >= 0.0).all() for one, _ in compliances)


# ---- joints that hardly moved ------------------------------------------------------------------


def with_spans(robot: mc.Robot, joints: Sequence[int], degrees: float) -> Simulation:
    """60 poses of an arm with geometric errors, of which some joints went so far alone."""
    ideal = simulate(robot, 60, 3, seed=2, truth=Truth(compliance=0))
    q, rng = ideal.data.q.copy(), np.random.default_rng(102)
    for joint in joints:
        q[:, joint] = np.median(q[:, joint]) + np.radians(degrees) * rng.uniform(-0.5, 0.5, len(q))
    noise = 2e-5 * rng.normal(size=ideal.data.y.shape)
    return replace(ideal, data=replace(ideal.data, q=q).with_y(ideal.cell.predict(q) + noise))


def rms_mm(arm: mc.Fit, made: Simulation, q: Array) -> float:
    """Of the targets at joints where the truth is known."""
    off = arm.predict(q) - made.cell.predict(q)
    return float(1e3 * np.sqrt((off**2).sum(axis=-1).mean()))


@pytest.mark.parametrize(
    ("joints", "degrees", "narrow"),
    [
        ((0, 1, 2), 0.0, ["J1", "J2", "J3"]),
        (range(6), 2.6, ["J1", "J2", "J3", "J4", "J5", "J6"]),
    ],
)
def test_nothing_is_claimed_outside_what_joints_spanned(robot, joints, degrees, narrow):
    made = with_spans(robot, joints, degrees)
    fit = mc.calibrate(robot, made.data, "sum")
    content = fit.to_dict()["accuracy"]["beyond"]
    assert (content["typical_mm"], content["worst_mm"], content["worst_where"]) == (None,) * 3
    assert content["narrow"] == narrow
    for name in narrow:
        assert f"joint {name[1:]} spans" in content["reason"]
    assert content["plan"] in content["reason"]
    assert content["plan"].startswith("minimax-cal plan ROBOT --poses ")
    said = "Outside the measured region nothing is claimed: joint 1 spans"
    assert said in fit.headline()
    # the claim inside stays, and is true; fresh poses elsewhere are far worse
    inside = fit.within.after.rms_mm
    assert 0.0 < inside < 0.06
    anywhere = simulate(robot, 200, seed=2).data.q
    assert rms_mm(fit, made, anywhere) > 5.0 * inside
    assert rms_mm(fit, made, made.data.q) < inside


def test_what_joints_spanned_survives_the_file(robot):
    fit = mc.calibrate(robot, with_spans(robot, (0,), 3.0).data, "sum")
    again = mc.Fit.from_dict(fit.to_dict())
    assert again.beyond == fit.beyond
    assert again.spans == fit.spans == fit.beyond.spans
    bare = mc.Fit.from_dict(fit.to_dict(poses=False))
    assert bare.spans == fit.spans


def test_joints_that_moved_are_not_named(robot, noisy):
    found = mc.calibrate(robot, noisy.data, "sum").beyond
    assert found.worst is not None
    assert not found.narrow
    assert len(found.spans) == 6
    assert plain(found)["plan"] is None


def test_a_diagnosis_claims_nothing_outside_either(robot):
    found = mc.diagnose(robot, with_spans(robot, (0, 1, 2), 0.0).data)
    gap = found.to_dict()["gap"]["beyond"]
    assert gap["worst_mm"] is None
    assert gap["narrow"] == ["J1", "J2", "J3"]
    assert "Outside the measured region nothing is claimed: joint 1 spans" in found.headline()
    assert mc.Diagnosis.from_dict(found.to_dict()).beyond == found.beyond


@pytest.mark.slow
def test_the_plan_that_is_offered_mends_it(robot):
    made = with_spans(robot, (0, 1, 2), 0.0)
    fit = mc.calibrate(robot, made.data, "sum")
    words = fit.beyond.plan.split()
    proposed = mc.plan(robot, poses=int(words[words.index("--poses") + 1]), candidates=150)
    rng = np.random.default_rng(0)
    y = made.cell.predict(proposed.q)
    data = measurements(proposed.q, y + 2e-5 * rng.normal(size=y.shape))
    mended = mc.calibrate(robot, data, "sum")
    assert mended.beyond.worst is not None
    anywhere = simulate(robot, 200, seed=2).data.q
    assert rms_mm(mended, made, anywhere) < mended.beyond.worst_mm


def test_sums_by_part_are_those_of_each_part(robot, noisy):
    fit = mc.calibrate(robot, noisy.data, "sum")
    poses = Poses.of(fit.estimator, fit.cell.state)
    masks = [np.arange(poses.seen.shape[1]) % 4 == number for number in range(4)]
    every = poses.sums_by_part(masks)
    for i, mask in enumerate(masks):
        gram, pull = poses.sums_of(mask)
        assert_allclose(every.gram[i], gram, rtol=0, atol=1e-12 * np.abs(gram).max())
        assert_allclose(every.gradient[i], pull, rtol=0, atol=1e-12 * np.abs(poses.error).sum())
    assert_allclose(every.square.sum(), poses.estimator.whole.cost(poses.state).sum(), rtol=1e-12)
