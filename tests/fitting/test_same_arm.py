"""Measurements and calibrations that are of another arm, or in another unit, are named as such."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import run

import minimax_cal as mc
from minimax_cal.fitting.same_arm import check_arm


def turned(data: mc.Measurements, joint: int, angle: float) -> mc.Measurements:
    """The same points, read at a joint whose zero has moved since [rad]."""
    q = data.q.copy()
    q[:, joint] += angle
    return replace(data, q=q)


def test_another_arm_or_unit_is_refused_before_anything_is_judged(fit, noisy, tmp_path):
    few = noisy.data.take(np.arange(12))
    check_arm(fit.robot, few)
    with pytest.raises(mc.DataError, match="millimetres given as metres"):
        mc.check(fit, few.with_y(1e3 * few.y), "rms 0.5")
    with pytest.raises(mc.DataError, match=r"misses ABB IRB 2600.* by \d+ mm wherever base"):
        mc.check(fit, mc.simulate("ur10", 12, 3, seed=5).data, "rms 0.5")
    data, saved, out = tmp_path / "d.csv", tmp_path / "fit.json", tmp_path / "refit.json"
    mc.write_measurements(data, few.with_y(1e3 * few.y))
    fit.save(saved)
    assert run("check", saved, data, "--tolerance", "rms 0.5", "-o", out) == 2
    assert not out.exists()


@pytest.mark.parametrize("angle", [5e-3, 0.1, 0.5])
def test_a_zero_may_have_moved_far(fit, noisy, angle):
    few = turned(noisy.data.take(np.arange(20)), 1, angle)
    check_arm(fit.robot, few)
    if angle < 0.05:
        found = mc.check(fit, few, "rms 0.5")
        assert {moved.joint for moved in found.moved} == {"J2"}


def test_too_few_poses_say_nothing_of_the_arm(fit):
    check_arm(fit.robot, mc.simulate("ur10", 2, 3, seed=5).data)


def test_calibrations_of_two_arms_are_not_compared(fit, robot):
    other = mc.calibrate("ur10", mc.simulate("ur10", 40, 3, seed=5).data, "sum")
    with pytest.raises(mc.OptionError, match="drawn as different arms"):
        mc.compare(fit, other)
    assert not any("implausibly" in text for text in mc.compare(fit, fit).notices)


def test_a_change_that_no_arm_makes_is_told(fit, robot, noisy):
    longer, later = np.array([0.2, 0, 0, 0, 0]), np.array([0, 0, 0.3, 0, 0])
    far = replace(fit, cell=replace(fit.cell, robot=robot.with_mdh(robot.mdh + longer)))
    (said,) = (text for text in mc.compare(fit, far).notices if "implausibly" in text)
    assert "a1 by +200" in said
    served = robot.with_mdh(fit.robot.mdh + later)  # zeros set anew
    anew = replace(fit, cell=replace(fit.cell, robot=served))
    assert not any("implausibly" in text for text in mc.compare(fit, anew).notices)
