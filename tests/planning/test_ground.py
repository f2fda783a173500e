"""What a plan starts from: the arm of the fit, and joints without limits."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import minimax_cal as mc
from minimax_cal.planning.candidate_poses import find_joint_limits
from minimax_cal.planning.planning_task import check_same_robot


def test_a_fit_of_another_arm_is_refused(robot, noisy, fit):
    with pytest.raises(mc.OptionError, match=r"the fit is of ABB IRB 2600.*, which is not .*UR10"):
        mc.plan("ur10", 10, fit=fit, candidates=100)
    served = robot.mdh + np.array([0, 0, 0.3, 0, 0])  # zeros set anew
    check_same_robot(robot, robot.with_mdh(served))
    other = mc.simulate("ur10", 20, 3, seed=1).data
    with pytest.raises(mc.DataError, match="of the calibrated arm"):
        mc.plan(robot, 10, fit=fit, data=other, candidates=100)
    some = noisy.data.take(np.arange(15))
    turned = some.with_y(some.y * np.array([[1.0, 1, 1], [-1, 1, 1], [1, 1, 1]]))
    with pytest.raises(mc.DataError, match="no calibration of this arm"):
        mc.plan(robot, 10, data=turned, candidates=100)


def test_a_joint_without_limits_goes_where_the_poses_at_hand_went(robot, noisy):
    free = replace(
        robot,
        lower=np.where(np.arange(6) < 4, -np.inf, robot.lower),
        upper=np.where(np.arange(6) < 4, np.inf, robot.upper),
    )
    q = noisy.data.q.copy()
    q[:, 3] = 0.25  # it stood still, which is no range
    at_hand = replace(noisy.data, q=q)
    lower, upper, notices = find_joint_limits(free, {2: (-0.3, 0.4)}, (at_hand,))
    assert_array_equal(lower[:2], q[:, :2].min(axis=0))
    assert_array_equal(upper[:2], q[:, :2].max(axis=0))
    assert (lower[2], upper[2]) == (-0.3, 0.4)
    assert (lower[3], upper[3]) == (-np.pi, np.pi)
    went, still = notices
    low, high = np.degrees([q[:, 0].min(), q[:, 0].max()])
    assert f"(J1={low:.0f}:{high:.0f} deg, J2=" in went
    assert "set others with joints=" in went
    assert "no limits for joint 4:" in still
    with_limits, _, none = find_joint_limits(robot, {}, (at_hand,))
    assert_array_equal(with_limits, find_joint_limits(robot, {})[0])
    assert none == ()
