"""Arms as shops have them, against the package's own kinematics and against what was asked for."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments import gap_cases, machine_gap, machines
from experiments.gap_cases import Cause
from experiments.machines import LAWS, MAKES, Asked


@pytest.mark.parametrize("robot", MAKES)
def test_an_arm_moves_as_the_package_says_slides_too(robot):
    place = machines.world_of(Asked(robot, "test", poses=40), np.random.default_rng(4))
    pose = place.base @ place.robot.pose(place.q + place.jitter)
    expected = np.einsum("mij,kj->mki", pose[:, :3, :3], place.spots) + pose[:, None, :3, 3]
    assert_allclose(gap_cases.measure(place, gap_cases.rigid(place)), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("robot", ["scara_600", "rail"])
def test_a_slide_is_a_column_of_the_jacobian(robot):
    asked = Asked(robot, "test", poses=40, jitter=0.0)
    place = replace(machines.world_of(asked, np.random.default_rng(4)), base=np.eye(4))
    joint, step = int(np.argmax(place.robot.prismatic)), 1e-6
    ends = []
    for sign in (1.0, -1.0):
        q = place.q.copy()
        q[:, joint] += sign * step
        ends.append(gap_cases.measure(replace(place, q=q), gap_cases.rigid(place)))
    slope = (ends[0] - ends[1]) / (2.0 * step)
    assert_allclose(gap_cases.jacobians(place)[1][..., joint], slope, rtol=0, atol=1e-9)


@pytest.mark.parametrize("law", LAWS)
def test_lambda_is_what_was_asked_for(law):
    able = [robot for robot in MAKES if machines.places(law, robot, 3)]
    for robot in (able[0], able[-1]):
        place = machines.places(law, robot, 3)[-1]
        made = machines.make(Asked(robot, "test", (Cause(law, place, 70.0, 1),), poses=60))
        assert_allclose(made.powers, [70.0], rtol=1e-5)
        assert made.displacement.shape == (1, 3, made.data.poses, 3)


def test_a_separable_cause_is_told_from_one_that_is_not():
    row = {"verdict": "named", "all_right": True, "lambda": 60.0, "telling": 30.0}
    assert machine_gap.separable(row)
    assert machine_gap.right(row)
    assert not machine_gap.separable(row | {"telling": 20.0})
    assert not machine_gap.right(row | {"verdict": "unknown"})
    assert not machine_gap.right(row | {"all_right": False})


def test_every_case_can_be_made_and_has_a_seed_of_its_own():
    cases = machine_gap.plan(5, machine_gap.QUICK)
    assert len({case.seed for case in cases}) == len(cases)
    for case in cases:
        for cause in case.causes:
            assert cause.place in machines.places(cause.law, case.robot, case.targets)
