"""Known causes show where they lie, and noise shows nowhere."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import shared
from numpy.testing import assert_allclose
from problems_fit import study

import minimax_cal as mc
from minimax_cal.diagnosing.study import SUM, Study, studied
from minimax_cal.diagnosing.where import Follows, by_region, of_target, where
from minimax_cal.evidence.limits import STRUCTURE
from minimax_cal.fitting.options import silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.measuring.history import with_history
from minimax_cal.modelling.simulate import Simulation, Truth, gravity, simulate

SIGMA = 15e-6
EXACT = Truth(compliance=0, noise=0, noise_per_metre=0)


def made(poses: int = 100, targets: int = 3, robot: str = "irb2600") -> Simulation:
    return simulate(mc.load_robot(robot), poses, targets, seed=1, truth=EXACT)


def fitted(sim: Simulation, turn=0.0, shift=0.0, **columns) -> Study:
    """Of joints that turn by more, (m, n), and of targets that are shifted, (m, k, 3), in noise."""
    y = sim.cell.predict(sim.data.q + turn) + shift
    y = y + SIGMA * np.random.default_rng(0).normal(size=y.shape)
    data = replace(sim.data.with_y(y), columns={**sim.data.columns, **columns})
    data, robot = with_history(data), sim.cell.robot
    return studied(robot, data, fit_cell(robot, data, SUM, silent))


def test_noise_follows_nothing():
    """One chance for everything that is asked of an arm."""
    found = [where(study(6e-6, 1.0, seed)) for seed in range(8)]
    for places in zip(*(one.by_joint for one in found), strict=True):
        assert sum(one.what.p < 0.05 for one in places) <= 2
    assert sum(one.order.p < 0.05 for one in found) <= 2
    assert_allclose([one.noise for one in found], 17.5e-6, rtol=0.25)


def test_compliance_of_a_joint_appears_at_that_joint():
    """Torque at joint 2 alone, mostly a function of q2 and q3."""
    sim = made(120)
    bend = np.zeros_like(sim.data.q)
    bend[:, 1] = 1e-6 * gravity(sim.cell.robot, sim.data.q)[:, 1]
    found = where(fitted(sim, bend))
    share = [gap.what.share for gap in found.by_joint]
    assert np.argmax(share) == 1
    assert share[1] > 0.9
    assert found.by_joint[1].what.follows == "its load"
    assert found.by_joint[1].what.p < STRUCTURE
    assert not found.order.p < STRUCTURE


@pytest.mark.parametrize(("joint", "size"), [(0, 2e-4), (3, 2e-4), (5, 2e-4), (3, 1e-3), (5, 1e-3)])
def test_a_gear_error_appears_at_its_joint_with_its_size(joint, size):
    sim = made(120)
    turn = np.zeros_like(sim.data.q)
    turn[:, joint] = size * np.cos(2.0 * sim.data.q[:, joint] + 1.0)
    made_of = fitted(sim, turn)
    gap = where(made_of).by_joint[joint]
    assert (gap.what.place, gap.what.p < STRUCTURE) == (f"J{joint + 1}", True)
    error = made_of.model.error(made_of.fit.state)
    hidden = 1.0 - SIGMA**2 / (error**2).mean()
    assert_allclose(gap.what.share, hidden, atol=0.15)


def test_what_a_target_and_the_whole_arm_follow_in_time():
    sim = made(120)
    late, flange = np.arange(120) / 119.0, sim.cell.robot.pose(sim.data.q)[:, :3, :3]
    moved = np.zeros((120, 3, 3))
    slid = flange[:, :, 0] @ sim.cell.base[:3, :3].T
    moved[:, 1] = 150e-6 * np.cos(4.0 * late)[:, None] * slid
    found = where(fitted(sim, shift=moved))
    names = {one.name: one.what.p for one in found.by_target}
    assert names["smr2"] < STRUCTURE
    assert found.order.p < STRUCTURE
    assert max(found.by_target, key=lambda one: one.rms).name == "smr2"
    warm = 25.0 + 5.0 * np.random.default_rng(3).normal(size=120)
    lift = 10e-6 * (warm - 25.0)[:, None, None] * np.array([0.0, 0.6, 0.8])
    heated = where(fitted(sim, shift=lift, temperature=warm))
    assert heated.temperature.p < STRUCTURE
    assert found.temperature is None


def test_one_target_has_a_mean_along_the_line_of_sight_and_a_region():
    sight = np.random.default_rng(0).normal(size=(50, 3))
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    error = 80e-6 * sight
    error[::5] = np.nan
    gap = of_target("smr1", error, sight, Follows())
    assert gap.points == 40
    assert_allclose([gap.sight, gap.rms, gap.worst], 80e-6, rtol=1e-12)
    none = of_target("smr2", np.full((50, 3), np.nan), sight, Follows())
    assert none.points == 0
    assert math.isnan(none.rms)


def test_the_worst_region_is_where_the_error_is():
    point = np.random.default_rng(0).normal(size=(3, 100, 3))
    far = np.hypot(point[..., 0], point[..., 1])
    size = np.where(far > np.quantile(far, 2 / 3), 5e-5, 1e-5)
    cells = by_region(size[..., None] * np.array([1.0, 0.0, 0.0]), point, np.array([0.0, 0.0, 1.0]))
    assert {one.name for one in cells if one.rms > 4.9e-5} == {
        "far out and low", "far out and mid-height", "far out and high"
    }  # fmt: skip


def test_a_slide_is_in_millimetres_and_nothing_is_nan():
    sim = made(80, 3, "scara_600")
    slide = int(np.argmax(sim.cell.robot.prismatic))
    turn = np.zeros_like(sim.data.q)
    turn[:, slide] = 1e-4 * np.cos(40.0 * sim.data.q[:, slide])
    said = where(fitted(sim, turn)).to_dict()
    assert "rms_mm" in said["by_joint"][slide]
    assert "rms_mrad" in said["by_joint"][0]
    json.dumps(said, allow_nan=False)


def test_rounding_follows_nothing():
    sim = made(60)
    robot, data = sim.cell.robot, with_history(sim.data)
    found = where(studied(robot, data, fit_cell(robot, data, SUM, silent)))
    assert all(math.isnan(one.what.p) for one in found.by_joint)
    json.dumps(found.to_dict(), allow_nan=False)


def test_a_real_arm():
    """IRB 120, commanded joints: gravity bends joint 2 and 3, not the frame."""
    name, path = shared("irb120")
    robot, data = mc.load_robot(name), with_history(mc.read_measurements(path))
    found = where(studied(robot, data, fit_cell(robot, data, SUM, silent))).to_dict()
    share = {gap["joint"]: gap["share"] for gap in found["by_joint"]}
    assert max(share, key=lambda joint: share[joint]) in ("J1", "J2", "J3")
    assert found["noise_mm"] < 30e-3
    json.dumps(found, allow_nan=False)
