"""Made-up models of simulators: one as published ones are, with includes, defaults and meshes."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.robots.gravity import tubes
from minimax_cal.robots.transforms import inverse, transform
from minimax_cal.simulators.elements import frames, numbers

GAINS = (2000.0, 2000.0, 2000.0, 500.0, 500.0, 500.0)  # of the size that published arms have
TETRAHEDRON = """v 0 0 0
v 0.05 0 0
v 0 0.05 0
v 0 0 0.05
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
"""


def published_like(folder: Path, robot: mc.Robot, gains: tuple[float, ...] = GAINS) -> Path:
    """A model of a robot in frames of its own, written to a folder with what it includes.

    Angles in degrees; a turned foot; joints beside their bodies' origins and off their axes; a
    camera, a tool and a gripper; servos whose gains stand in default classes.
    """
    (folder / "assets").mkdir()
    (folder / "assets" / "part.obj").write_text(TETRAHEDRON)
    (folder / "parts.xml").write_text(
        "<mujocoinclude><asset><mesh name='part' file='part.obj'/></asset><default>"
        "<default class='arm'><joint armature='0.1' damping='1'/>"
        "<geom contype='0' conaffinity='0' group='2'/>"
        + "".join(
            f"<default class='size{i}'><general gaintype='fixed' biastype='affine' gainprm='{k}' "
            f"biasprm='0 -{k} -{0.2 * k}'/></default>"
            for i, k in enumerate(gains)
        )
        + "</default></default></mujocoinclude>"
    )
    path = folder / "arm.xml"
    path.write_text(
        "<mujoco model='made up'><!-- a remark --><compiler meshdir='assets' autolimits='true'/>"
        "<option integrator='implicitfast'/><include file='parts.xml'/>"
        "<worldbody><light pos='0 0 3'/><geom name='floor' type='plane' pos='0 0 -2' size='4 4 1' "
        "contype='0' conaffinity='0'/><frame pos='0.1 0 0' euler='0 0 90'>"
        f"{bodies(robot)}</frame></worldbody>"
        "<contact><exclude body1='part0' body2='part1'/></contact><actuator>"
        + "".join(
            f"<general name='servo{i}' class='size{i}' joint='axis{i}'/>" for i in range(len(gains))
        )
        + "<position name='fingers' joint='finger' kp='50000' kv='100'/></actuator>"
        "<sensor><jointpos joint='axis2'/></sensor></mujoco>"
    )
    return path


def bodies(robot: mc.Robot) -> str:
    """The arm's bodies, each in a frame of its own."""
    rng, at = np.random.default_rng(4), frames(robot)
    mass, com = tubes(robot.mdh)
    out, before, closing = "", np.eye(4), ""
    for i, frame in enumerate(at):
        turned = transform(Rotation.random(rng=rng).as_matrix(), 0.03 * rng.normal(size=3))
        body = frame @ turned
        place = inverse(before) @ body
        axis = turned[:3, :3].T @ [0.0, 0.0, robot.sign[i]]
        anchor = inverse(turned)[:3, 3]
        euler = Rotation.from_matrix(place[:3, :3]).as_euler("XYZ", degrees=True)
        end = at[i] @ inverse(at[i]) @ frame
        centre = inverse(turned) @ np.append(0.3 * com[i], 1.0)
        out += (
            f"<body name='part{i}' childclass='arm' pos='{numbers(place[:3, 3])}' "
            f"euler='{numbers(euler)}'><inertial pos='{numbers(centre[:3])}' "
            f"mass='{max(0.3 * mass[i], 0.5)}' diaginertia='0.1 0.1 0.1'/>"
            f"<joint name='axis{i}' pos='{numbers(anchor)}' axis='{numbers(axis)}'/>"
            "<geom type='mesh' mesh='part'/>"
        )
        if i == 2:
            out += "<camera name='eye' pos='0 0 0.1'/>"
        closing += "</body>"
        before = end @ turned
    return (
        out + "<body name='tool_plate' pos='0 0 0.02'><geom type='box' size='.01 .01 .01' "
        "mass='0.2'/><site name='attachment'/><body name='finger_body' pos='0 0 .02'>"
        "<joint name='finger' type='slide' axis='1 0 0' range='0 0.02'/>"
        "<geom type='box' size='.01 .01 .01' mass='0.05'/></body></body>" + closing
    )
