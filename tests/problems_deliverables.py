"""Files of arms, loaded again by readers that share no code with their writers."""

import csv
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import minimax_cal as mc
from minimax_cal.fitting.accuracy import summarise_point_errors
from minimax_cal.fitting.opened_results import place_nominal_arm
from minimax_cal.measuring.measurements import Measurements

KEYS = ("x", "y", "z", "roll", "pitch", "yaw")


def of_urdf(text: str, drawn: mc.Robot, folder: Path) -> mc.Robot:
    """A URDF as its own reader takes it."""
    (folder / "arm.urdf").write_text(text)
    return mc.load_robot(folder / "arm.urdf")


def of_json(text: str, drawn: mc.Robot, folder: Path) -> mc.Robot:
    """Our own file."""
    (folder / "arm.json").write_text(text)
    return mc.load_robot(folder / "arm.json")


def of_dh(text: str, drawn: mc.Robot, folder: Path) -> mc.Robot:
    """The table of links."""
    names = ("a_mm", "d_mm", "theta_rad", "alpha_rad", "beta_rad")
    rows = [[float(row[name]) for name in names] for row in csv.DictReader(io.StringIO(text))]
    return drawn.with_mdh(np.array(rows) * [1e-3, 1e-3, 1.0, 1.0, 1.0])


def of_ros(text: str, drawn: mc.Robot, folder: Path) -> mc.Robot:
    """Joint origins, as the chain that a launch file makes of them."""
    return chained(list(yaml.safe_load(text)["joints"].values()), folder)


def of_ur(text: str, drawn: mc.Robot, folder: Path) -> mc.Robot:
    """The joints of Universal Robots, each about its own z."""
    joints: list[dict[str, Any]] = []
    for origin in list(yaml.safe_load(text)["kinematics"].values())[:-1]:
        six = [float(origin[key]) for key in KEYS]
        place = {"xyz": six[:3], "rpy": six[3:]}
        joints.append({"type": "revolute", "axis": [0, 0, 1], "origin": place})
    return chained(joints, folder)


def chained(joints: list[dict[str, Any]], folder: Path) -> mc.Robot:
    """Joints in a row as a URDF."""
    lines = ['<robot name="arm">', '<link name="link0"/>']
    for i, joint in enumerate(joints):
        xyz, rpy = (" ".join(map(repr, joint["origin"][key])) for key in ("xyz", "rpy"))
        kind = {"revolute": "continuous"}.get(joint["type"], joint["type"])
        axis = " ".join(map(str, joint.get("axis", (0, 0, 1))))
        lines += [
            f'<link name="link{i + 1}"/>',
            f'<joint name="joint{i}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/>',
            f'<parent link="link{i}"/><child link="link{i + 1}"/><axis xyz="{axis}"/></joint>',
        ]
    return of_urdf("\n".join([*lines, "</robot>"]), mc.load_robot("ur10"), folder)


READERS: dict[str, Callable[[str, mc.Robot, Path], mc.Robot]] = {
    "urdf": of_urdf,
    "json": of_json,
    "dh-csv": of_dh,
    "ur-yaml": of_ur,
    "ros-yaml": of_ros,
}


def reached(fit: mc.Fit, to: str, new: Measurements, folder: Path) -> float:
    """RMS on new poses of the file of a fit, loaded again, base and targets fitted to them [mm]."""
    text = mc.export(fit, to, notify=lambda notice: None)
    robot = READERS[to](text, fit.nominal.robot, folder)
    return summarise_point_errors(place_nominal_arm(robot, new).error(new)).rms_mm
