import json
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import minimax_cal as mc
from minimax_cal.robots.angle_units import check_link_angle_unit
from minimax_cal.robots.kinematics import MDH_NAMES
from minimax_cal.robots.robot import robot_from_dict

# ---- robot ---------------------------------------------------------------------------------------


ROBOT = {
    "name": "two bars",
    "units": {"length": "mm", "angle": "deg"},
    "joints": [
        {"a": 300, "d": 0, "theta": 0, "alpha": 90, "lower": -170, "upper": 170, "ratio": 100},
        {
            "a": 0,
            "d": 10,
            "theta": 0,
            "alpha": 0,
            "type": "prismatic",
            "upper": 200,
            "lower": 0,
            "mass_kg": 3,
            "com_mm": [1, 2, 3],
        },
    ],
}
TOML = """
name = "two bars"
units = {length = "mm", angle = "deg"}
[[joints]]
a = 300
d = 0
theta = 0
alpha = 90
lower = -170
upper = 170
ratio = 100
[[joints]]
a = 0
d = 10
theta = 0
alpha = 0
type = "prismatic"
lower = 0
upper = 200
mass_kg = 3
com_mm = [1, 2, 3]
"""
YAML = """
name: two bars
units: {length: mm, angle: deg}
joints:
  - {a: 300, d: 0, theta: 0, alpha: 90, lower: -170, upper: 170, ratio: 1e2}
  - {a: 0, d: 10, theta: 0, alpha: 0, type: prismatic, lower: 0, upper: 200, mass_kg: 3,
     com_mm: [1, 2, 3]}
"""


def test_json_toml_and_yaml_are_the_same_robot(tmp_path):
    robots = []
    for name, text in (("r.json", json.dumps(ROBOT)), ("r.toml", TOML), ("r.yaml", YAML)):
        (tmp_path / name).write_text(text)
        robots.append(mc.load_robot(tmp_path / name).to_dict())
    assert robots[0] == robots[1] == robots[2]
    first, second = robots[0]["joints"]
    assert first["alpha"] == pytest.approx(np.pi / 2, abs=1e-15)
    assert second["type"] == "prismatic"
    assert second["upper"] == pytest.approx(200, abs=1e-12)


@pytest.mark.parametrize("name", mc.builtin_robots())
def test_saved_robot_comes_back(name, tmp_path):
    robot = mc.load_robot(name)
    robot.save(tmp_path / "r.json")
    again = mc.load_robot(tmp_path / "r.json")
    np.testing.assert_allclose(again.mdh, robot.mdh, rtol=1e-15, atol=1e-18)
    np.testing.assert_allclose(again.upper, robot.upper, rtol=1e-15)
    assert_array_equal(again.sign, robot.sign)
    assert_array_equal(again.prismatic, robot.prismatic)


def changed(**fields: object) -> str:
    return json.dumps({**ROBOT, **fields})


def joint(**fields: object) -> str:
    first, second = ROBOT["joints"]
    return json.dumps({**ROBOT, "joints": [{**first, **fields}, second]})


@pytest.mark.parametrize(
    ("text", "say"),
    [
        ("{", "cannot be parsed"),
        ("[1, 2]", "holds no robot"),
        ("[" * 100_000, "cannot be parsed"),
        (changed(joints=[]), "joints"),
        (changed(units={"length": "inch", "angle": "deg"}), "units.length"),
        (changed(convention="Craig"), "convention 'Craig'"),
        (changed(up=[0, 0, 0]), "up: is a zero vector"),
        (joint(alpha="ninety"), "joints[0].alpha"),
        (joint(sign=2), "joints[0].sign"),
        (joint(bta=0.1), "did you mean 'beta'"),
        (joint(lower=10, upper=-10), "joint 1: lower must be less"),
        (json.dumps({"name": "x"}), "units"),
        (joint(a=float("nan")), "joints[0].a"),
    ],
)
def test_broken_robot_files_say_what_is_wrong(text, say, tmp_path):
    path = tmp_path / "r.json"
    path.write_text(text)
    with pytest.raises(mc.RobotError) as caught:
        mc.load_robot(path)
    message = str(caught.value)
    assert say in message
    assert str(path) in message
    assert "\n" not in message


def test_unknown_names_get_a_hint(tmp_path):
    with pytest.raises(mc.RobotError, match="did you mean 'irb2600'"):
        mc.load_robot("irb260")
    with pytest.raises(mc.RobotError, match="cannot be read"):
        mc.load_robot(tmp_path / "absent.json")
    (tmp_path / "robot.txt").write_text("x")
    with pytest.raises(mc.RobotError, match="not a robot file"):
        mc.load_robot(tmp_path / "robot.txt")


BOMB = ["a0: &a0 {x: 1}"]  # nine levels of nine aliases each would be 387 million entries
BOMB += [f"a{i}: &a{i}\n  <<: [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 10)]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name: r\njoints: [{a: 1, d: 2,\n  a: 3}]", "line 3: 'a' stands twice"),
        ("name: r\n? [a]\n: 1", "line 2: a key that is no word"),
        ("? {a: 1}\n: 1", "line 1: a key that is no word"),
        ("name: r\nname: s", "line 2: 'name' stands twice"),
        ("joints: [{d: 0445}]", "line 1: 0445 is no decimal number"),
        ("joints: [{d: 1:30}]", "line 1: 1:30 is no decimal number"),
        ("joints: [{d: 1:30.5}]", "line 1: 1:30.5 is no decimal number"),
        ("!!python/object/apply:os.system ['echo hacked']", "cannot be parsed"),
        ("\n".join(BOMB), "line 3: an alias"),
    ],
)
def test_yaml_means_what_it_reads_as_and_runs_no_code(text, says, tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    with pytest.raises(mc.RobotError, match=says):
        mc.load_robot(path)


def test_a_huge_vertical_keeps_its_direction():
    robot = robot_from_dict(ROBOT | {"up": [0.0, 3e300, 4e300]})
    np.testing.assert_allclose(robot.up, [0.0, 0.6, 0.8])


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"name":', '"name": "twice", "name":', "the key 'name' stands twice"),
        ('"sign": 1', '"sign": 1, "ratio": 0', "gear ratio of zero"),
    ],
)
def test_json_that_could_mean_two_things_is_refused(tmp_path, old, new, says):
    path = tmp_path / "robot.json"
    mc.load_robot("irb2600").save(path)
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(mc.RobotError, match=says):
        mc.load_robot(path)


# ---- angle units ---------------------------------------------------------------------------------


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
    check_link_angle_unit(np.array([angles]), unit, "robot")


def test_limits_in_degrees_are_named(tmp_path, says):
    path = tmp_path / "robot.json"
    path.write_text(json.dumps(content("irb2600", "rad", 180.0 / np.pi, ("lower", "upper"))))
    (line,) = says("plan", path, "--poses", 10, code=2).err.splitlines()
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
