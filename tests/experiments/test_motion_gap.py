"""The study of models that move as the arm does."""

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")

from experiments.driven_arms import drawn_arm
from experiments.motion_gap import Case, Closed, Judged, closed_table, real_table


def test_an_arm_lacks_what_is_asked_for_and_repeats_by_its_seed():
    arm, again = (drawn_arm("scara_600", 2, ("friction", "payload")) for _ in range(2))
    assert arm.withheld.payload == again.withheld.payload > 0.0
    assert (arm.withheld.friction > 0.0).all()
    assert not arm.withheld.share.any()
    assert not arm.withheld.armature.any()
    real = arm.real()
    assert real.body_mass[-1] == pytest.approx(arm.known.body_mass[-1] + arm.withheld.payload)


def test_tables_count_what_remains():
    one = Closed(10.0, 1.0, 0.1, np.array([0.1, 0.2]), np.array([0.01, 0.02]))
    case = Case("ur10", ("friction",), 1)
    *_, last = closed_table([case, case], [one, one]).rows
    assert last == ("median", 10.0, pytest.approx(10.0), pytest.approx(20.0),
                    pytest.approx(1.0), pytest.approx(2.0))  # fmt: skip
    low = np.array([0.05, 0.06])
    run = Judged(
        "a", np.array([2.0, 2.0]), np.array([0.3, 0.4]), np.array([0.1, 0.2]), low, 0.5 * low
    )
    assert [row[1:] for row in real_table([run, run]).rows] == [
        (pytest.approx(2.0), pytest.approx(2.0)),
        (pytest.approx(0.3), pytest.approx(0.4)),
        (pytest.approx(0.1), pytest.approx(0.2)),
        (pytest.approx(0.05), pytest.approx(0.06)),
        (pytest.approx(0.025), pytest.approx(0.03)),
    ]
