import json

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import minimax_cal as mc
from minimax_cal.robots.robot import robot_from_dict

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
    first, second = ROBOT["joints"]  # type: ignore[misc]
    return json.dumps({**ROBOT, "joints": [{**first, **fields}, second]})  # type: ignore[dict-item]


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


def test_yaml_cannot_run_code(tmp_path):
    path = tmp_path / "r.yaml"
    path.write_text("!!python/object/apply:os.system ['echo hacked']")
    with pytest.raises(mc.RobotError, match="cannot be parsed"):
        mc.load_robot(path)


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
    ],
)
def test_yaml_means_what_it_reads_as(text, says, tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    with pytest.raises(mc.RobotError, match=says):
        mc.load_robot(path)


def test_a_huge_vertical_keeps_its_direction():
    robot = robot_from_dict(ROBOT | {"up": [0.0, 3e300, 4e300]})
    np.testing.assert_allclose(robot.up, [0.0, 0.6, 0.8])


def test_yaml_that_grows_is_refused(tmp_path):
    """Nine levels of nine aliases each would be 387 million entries."""
    lines = ["a0: &a0 {x: 1}"]
    lines += [f"a{i}: &a{i}\n  <<: [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 10)]
    path = tmp_path / "robot.yaml"
    path.write_text("\n".join(lines))
    with pytest.raises(mc.RobotError, match="line 3: an alias"):
        mc.load_robot(path)


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
