"""Degrees called radians in a robot file, and the reverse: refused by the file alone."""

import json
from typing import Any

import numpy as np
import pytest
from conftest import run

import minimax_cal as mc
from minimax_cal.robots.angle_units import check_angles
from minimax_cal.robots.kinematics import MDH_NAMES
from minimax_cal.robots.robot import robot_from_dict

ANGLES = (*MDH_NAMES[2:], "lower", "upper")


def content(name: str, unit: str = "rad", factor: float = 1.0, keys: Any = ANGLES) -> Any:
    """A built-in robot with some of its angles scaled, under a unit."""
    out = mc.load_robot(name).to_dict()
    out["units"]["angle"] = unit
    for joint in out["joints"]:
        joint |= {key: factor * joint[key] for key in keys if key in joint}
    return out


@pytest.mark.parametrize("name", mc.builtin_robots())
def test_each_unit_is_told_from_the_other(name):
    given = mc.load_robot(name)
    right = robot_from_dict(content(name, "deg", 180.0 / np.pi))
    np.testing.assert_allclose(right.mdh, given.mdh, rtol=1e-14)
    with pytest.raises(mc.RobotError, match=r"units\.angle: says deg, .*: write rad"):
        robot_from_dict(content(name, "deg"))
    with pytest.raises(mc.RobotError, match=r"units\.angle: says rad, .*: write deg"):
        robot_from_dict(content(name, "rad", 180.0 / np.pi))


def test_calibrated_angles_are_told_too(robot):
    off = robot.mdh + np.random.default_rng(0).normal(scale=2e-3, size=robot.mdh.shape)
    whole = robot.with_mdh(off).to_dict()
    robot_from_dict(whole)
    whole["units"]["angle"] = "deg"
    with pytest.raises(mc.RobotError, match="write rad"):
        robot_from_dict(whole)


@pytest.mark.parametrize(
    ("unit", "angles"),
    [
        ("deg", [0.0, 0.0, 0.0]),
        ("deg", [0.3, -0.02, 0.01]),  # parallel axes, calibrated
        ("deg", [1.57, 0.4, -0.7]),
        ("deg", [90.0, 1.57, 0.0]),
        ("rad", [0.5, -1.2, 3.0]),
        ("rad", [1.5708, 1.4, 6.9]),
    ],
)
def test_angles_that_may_be_are_taken(unit, angles):
    check_angles(np.array([angles]), unit, "robot")


def test_limits_in_degrees_are_named(tmp_path, capsys):
    path = tmp_path / "robot.json"
    path.write_text(json.dumps(content("irb2600", "rad", 180.0 / np.pi, ("lower", "upper"))))
    assert run("plan", path, "--poses", 10) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "joints[0].lower: -180 rad are 28.6 turns; degrees?" in line
    slip = content("irb2600")
    slip["joints"][2]["upper"] = 75.0
    with pytest.raises(mc.RobotError, match=r"joints\[2\]\.upper: 75 rad"):
        robot_from_dict(slip)


def test_one_joint_may_turn_far_and_a_placeholder_is_no_slip():
    far = content("irb2600")
    far["joints"][5] |= {"lower": -200.0 * np.pi, "upper": 200.0 * np.pi}
    assert robot_from_dict(far).upper[5] == 200.0 * np.pi
    for joint in far["joints"]:
        joint |= {"lower": -1e16, "upper": 1e16}
    robot_from_dict(far)


def test_limits_of_a_urdf_are_radians(tmp_path):
    path = tmp_path / "arm.urdf"
    mc.export("irb2600", "urdf", path, notify=list)
    mc.load_robot(path)
    text = path.read_text()
    assert 'upper="3.14159' in text
    path.write_text(text.replace('upper="3.14159', 'upper="180.0" note="'))
    with pytest.raises(mc.RobotError, match=r"joints\[0\]\.upper: 180 rad"):
        mc.load_robot(path)
