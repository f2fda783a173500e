"""The study of drives that logs with commands give a model."""

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")

from experiments.servos import Case, Closed, closed_table, drawn, drawn_cases


def test_half_of_the_arms_have_elastic_joints_and_each_repeats_by_its_seed():
    cases = drawn_cases(20, 5)
    assert sum(case.elastic for case in cases) == 10
    assert len({case.arm for case in cases}) == 4
    one, again = (drawn("scara_600", 7, elastic=True) for _ in range(2))
    assert one.delay == again.delay
    assert one.real.njnt == 2 * one.arm.robot.joints
    assert ((one.gain >= 0.5) & (one.gain <= 2.0)).all()
    sound = drawn("scara_600", 7, elastic=False, sound=True)
    assert (sound.gain == 1.0).all()
    assert sound.delay == 0.0
    assert np.allclose(sound.real.actuator_gainprm[:, 0], sound.stiffness)


def test_the_table_counts_what_remains_and_which_intervals_hold():
    one = Closed(10.0, 0.5, 1.0, ([0.0, 3.0], [1.0, -1.0], []), ())
    *_, last = closed_table([Case("ur10", 1, elastic=False)], [one]).rows
    assert last[1:6] == (10.0, pytest.approx(5.0), pytest.approx(10.0), 50.0, 100.0)
    assert np.isnan(last[6])
