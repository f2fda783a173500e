"""The ROS 2 example as far as it goes without ROS: rest and rows, and its node by stand-ins."""

import configparser
import runpy
import sys
import xml.etree.ElementTree as Xml
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from conftest import ROOT
from numpy.testing import assert_allclose

import minimax_cal as mc

HERE = ROOT / "examples" / "ros2" / "minimax_cal_ros2"
JOINTS = [f"joint_{i}" for i in range(1, 7)]
TARGETS = ["smr1", "smr2"]


@pytest.fixture(autouse=True)
def found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(HERE))
    for name in [name for name in sys.modules if name.startswith("minimax_cal_ros2")]:
        monkeypatch.delitem(sys.modules, name)


def test_an_arm_stands_after_a_second_without_moving():
    from minimax_cal_ros2.sheet import Rest

    rest = Rest(["a", "b"])
    for i in range(30):
        rest.hear(0.1 * i, ["b", "a", "gripper"], [2.0, 1.0, 0.1 * i])
        assert (rest.joints() is not None) == (i >= 10), i
    assert_allclose(rest.joints(), [1.0, 2.0], rtol=0, atol=1e-12)
    rest.hear(3.0, ["a"], [5.0])  # lacks a joint
    assert rest.joints()
    rest.hear(3.0, ["a", "b"], [1.01, 2.0])
    assert rest.joints() is None
    rest.hear(1.0, ["a", "b"], [1.0, 2.0])  # the clock went back
    assert rest.joints() is None


class Node:
    """What the node uses of rclpy's."""

    given: ClassVar[dict[str, Any]] = {}

    def __init__(self, name: str) -> None:
        self.heard: dict[str, Any] = {}
        Node.made = self

    def declare_parameter(self, name: str, default: Any) -> Any:
        return SimpleNamespace(value=self.given.get(name, default))

    def create_subscription(self, kind: Any, topic: str, callback: Any, depth: int) -> None:
        self.heard[topic] = callback

    def get_logger(self) -> Any:
        return SimpleNamespace(info=lambda text: None, warning=lambda text: None)


def standing_in(monkeypatch: pytest.MonkeyPatch, **modules: dict[str, Any]) -> None:
    for name, content in modules.items():
        made = ModuleType(name.replace("__", "."))
        vars(made).update(content)
        monkeypatch.setitem(sys.modules, made.__name__, made)


def test_what_the_node_writes_is_a_measurement_file(tmp_path, monkeypatch):
    data = mc.simulate("irb120", 12, 2, seed=1).data
    path = tmp_path / "poses.csv"
    standing_in(
        monkeypatch,
        rclpy={"init": lambda: None, "spin": lambda node: None},
        rclpy__node={"Node": Node},
        geometry_msgs={}, geometry_msgs__msg={"PointStamped": object},
        sensor_msgs={}, sensor_msgs__msg={"JointState": object},
    )  # fmt: skip
    monkeypatch.setattr(Node, "given", {"joints": JOINTS, "targets": TARGETS, "path": str(path)})
    from minimax_cal_ros2.record import main

    main()
    topics = Node.made.heard
    now = 0.0
    for q, y in zip(data.q, data.y, strict=True):
        for _ in range(15):
            now += 0.1
            stamp = SimpleNamespace(sec=int(now), nanosec=int(1e9 * (now % 1.0)))
            state = SimpleNamespace(
                header=SimpleNamespace(stamp=stamp), name=JOINTS, position=q.tolist()
            )
            topics["/joint_states"](state)
        for target, place in zip(TARGETS, y, strict=True):
            point = SimpleNamespace(**dict(zip("xyz", place.tolist(), strict=True)))
            topics[f"/measured/{target}"](SimpleNamespace(point=point))
    read = mc.read_measurements(path)
    assert read.target_names == tuple(TARGETS)
    assert_allclose(read.q, data.q[:-1], rtol=0, atol=1e-9)  # the last pose goes on
    assert_allclose(read.y, data.y[:-1], rtol=0, atol=1e-9)
    with pytest.raises(FileExistsError):  # an earlier file is never replaced
        main()


def test_the_launch_file_publishes_the_urdf(tmp_path, monkeypatch):
    urdf = tmp_path / "corrected.urdf"
    urdf.write_text("<robot name='arm'/>")
    perform = SimpleNamespace(perform=lambda context: str(urdf))
    standing_in(
        monkeypatch,
        launch={"LaunchDescription": list},
        launch__actions={"DeclareLaunchArgument": lambda name, **_: name,
                         "OpaqueFunction": lambda function: function},
        launch__substitutions={"LaunchConfiguration": lambda name: perform},
        launch_ros={}, launch_ros__actions={"Node": lambda **told: told},
    )  # fmt: skip
    made = runpy.run_path(str(HERE / "launch" / "corrected.launch.py"))
    name, function = made["generate_launch_description"]()
    (node,) = function(None)
    assert name == "urdf"
    assert node["package"] == "robot_state_publisher"
    assert node["parameters"] == [{"robot_description": "<robot name='arm'/>"}]


def test_the_package_is_whole():
    package = Xml.parse(HERE / "package.xml").getroot()
    assert package.findtext("name") == "minimax_cal_ros2"
    assert package.findtext("export/build_type") == "ament_python"
    settings = configparser.ConfigParser()
    settings.read(HERE / "setup.cfg")
    assert settings["install"]["install_scripts"] == "$base/lib/minimax_cal_ros2"
    assert (HERE / "resource" / "minimax_cal_ros2").is_file()
    text = (HERE / "setup.py").read_text()
    assert "record = {NAME}.record:main" in text
    assert np.all([(HERE / name).is_file() for name in ("launch/corrected.launch.py", "README.md")])
