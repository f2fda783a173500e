"""MJCF as robot: MuJoCo's own forward kinematics and inverse dynamics, and who is left out."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.dynamics.regressor import (
    JointMotion,
    build_nominal_inertial_parameters,
    inverse_dynamics,
)
from minimax_cal.robots.joint_ranges import clip_range_near_zero
from minimax_cal.robots.mjcf_import import read_mujoco_model
from minimax_cal.robots.robot import robot_from_dict
from minimax_cal.robots.urdf_robot import load_urdf

mujoco = pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")

SIX = """<mujoco model="six"><compiler angle="degree" eulerseq="zyx"/>
<option gravity="0 3 -9"/>
<default><joint armature="0" damping="0"/><default class="wide"><joint range="-170 170"/>
  <default class="narrow"><joint range="-100 60" axis="0 1 0"/></default></default></default>
<worldbody><geom type="plane" size="1 1 1"/><body name="foot" pos=".3 -.2 .1" euler="30 0 0">
 <inertial pos="0 0 0" mass="5" diaginertia="1 1 1"/>
 <body name="b1" pos="0 0 .4" childclass="wide"><joint name="j1" axis="0 0 -1"/>
  <inertial pos=".02 .01 -.1" mass="9" fullinertia=".3 .25 .2 .01 -.02 .03"/>
  <body name="b2" pos=".15 0 .1" axisangle="1 0 0 20">
   <joint name="j2" class="narrow" pos="0 .03 .02" ref="15"/>
    <geom type="capsule" size=".05 .2" pos="0 0 .2"/>
   <body name="b3" pos="0 0 .6" xyaxes="1 0 0 0 .8 .6"><joint name="j3" axis=".1 1 0"/>
    <geom type="box" size=".1 .05 .05"/>
    <body name="b4" pos=".3 0 .1" quat=".9 .1 .2 .3"><joint name="j4" axis="1 0 0"/>
     <geom size=".06"/>
     <body name="b5" pos=".3 0 0" zaxis=".1 0 1"><joint name="j5" axis="0 1 0"/><geom size=".05"/>
      <body name="b6" pos=".08 0 0"><joint name="j6" axis="1 0 0"/>
       <geom size=".04" pos=".01 .02 0"/>
       <site name="flange" pos=".05 0 0" euler="10 20 30"/></body></body></body></body></body>
        </body>
</body></worldbody>
<keyframe><key name="home" qpos="1 .2 .3 .4 .5 .6"/></keyframe></mujoco>"""
SEVEN = """<mujoco><compiler angle="radian" autolimits="false"/><worldbody>
 <body name="b1" pos="0 0 .3"><joint name="j1" axis="0 0 1" limited="true" range="-2 2"/>{}</body>
</worldbody></mujoco>"""
SCARA = """<mujoco><worldbody><body name="post"><geom size=".1"/>
 <body name="arm" pos="0 0 .4"><joint name="q1" axis="0 0 1" range="-140 140"/><geom size=".1"/>
  <body name="fore" pos=".35 0 .05"><joint name="q2" axis="0 0 1" range="-150 150"/>
   <geom size=".1"/>
   <body name="quill" pos=".3 .01 0" euler="180 0 0">
    <joint name="z" type="slide" axis="0 0 1" range="0 .2" ref=".05"/>
    <joint name="q4" axis="0 0 1" pos=".01 0 0" range="-300 300"/><geom size=".05" pos=".02 0 .1"/>
    <body name="tool" pos="0 0 .15" euler="0 0 40"><geom size=".02"/></body>
 </body></body></body></body></worldbody></mujoco>"""
CAMERA = """<mujoco><worldbody><body name="a"><joint name="q1" axis="0 0 1"/><geom size=".1"/>
 <body name="plate" pos=".1 .1 .2" euler="10 20 30"><geom size=".05"/>
  <body name="spacer" pos=".1 0 0" euler="5 5 5"><geom size=".02" pos=".1 .1 0"/>
   <body name="b" pos="0 .2 0"><joint name="q2" axis="1 0 1"/><geom size=".1"/>
    <body name="elbow" pos="0 0 .3"><geom size=".01"/><site name="camera"/></body>
    <body name="c" pos=".4 0 0" euler="0 30 0"><joint name="q3" axis="0 1 0"/><geom size=".1"/>
     </body>
 </body></body></body></body></worldbody></mujoco>"""


def seven() -> str:
    """Frames turned anew at each joint, without a name or a limit but the first joint's."""
    inside = '<geom type="cylinder" size=".03 .1"/><site name="tool0" pos="0 .1 .2"/>'
    for turn in ("1.57 0 .2", "-1.57 .1 0", "0 1.2 .4", ".3 .2 .1", "-1.5 0 0", "1.5 .3 0"):
        inside = (
            f'<geom type="cylinder" size=".04 .1"/><body pos=".02 .1 .2" euler="{turn}">'
            f'<joint axis="0 .1 1"/>{inside}</body>'
        )
    return SEVEN.format(inside)


ARMS = {
    "six": (SIX, "flange", 6), "seven": (seven(), "tool0", 7), "scara": (SCARA, "tool", 4),
    "fixed bodies": (CAMERA, "c", 3),
}  # fmt: skip


def pose_in(model: Any, q: Array, tip: str) -> Array:
    """(4, 4) of a body or site by MuJoCo, q (n,) in the order of its own joints."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    found = data.site(tip) if any(model.site(i).name == tip for i in range(model.nsite)) else None
    found = found or data.body(tip)
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = found.xmat.reshape(3, 3), found.xpos
    return out


@pytest.mark.parametrize("name", ARMS)
def test_mujoco_has_the_same_poses_and_torques(name, tmp_path):
    text, tip, n = ARMS[name]
    (tmp_path / "arm.xml").write_text(text)
    model = mujoco.MjModel.from_xml_string(text)
    seen, robot = load_urdf(tmp_path / "arm.xml"), mc.load_robot(tmp_path / "arm.xml")
    assert seen.chain[-1].child == tip
    assert robot.joints == n == model.nq
    limited = model.jnt_limited.astype(bool)
    assert_allclose(robot.lower, np.where(limited, model.jnt_range[:, 0], -np.inf))
    assert_allclose(robot.upper, np.where(limited, model.jnt_range[:, 1], np.inf))
    rng = np.random.default_rng(3)
    q = rng.uniform(*clip_range_near_zero(robot.lower, robot.upper), (20, n))
    ours = seen.base @ robot.pose(q) @ seen.tool
    assert_allclose(ours, [pose_in(model, each, tip) for each in q], atol=1e-9)
    rate, change = rng.normal(size=(2, 20, n))
    data = mujoco.MjData(model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    judge = []
    for each in zip(q, rate, change, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = each
        mujoco.mj_inverse(model, data)
        judge.append(data.qfrc_inverse.copy())
    size = np.linalg.norm(model.opt.gravity) / 9.80665  # ours knows one gravity: scale and compare
    torque = inverse_dynamics(
        robot, JointMotion(q, rate, change), build_nominal_inertial_parameters(robot)
    )
    still = inverse_dynamics(
        robot, JointMotion(q, 0 * q, 0 * q), build_nominal_inertial_parameters(robot)
    )
    assert_allclose(torque + (size - 1.0) * still, judge, atol=1e-8)


GRIPPER = """<mujoco><worldbody><body name="base"><freejoint/><geom size=".1"/>
 <body name="torso" pos="0 0 1" euler="0 90 0"><geom size=".1"/>
 {arms}</body></body>
 <body name="door" pos="2 0 0"><joint name="hinge"/><geom size=".1"/></body></worldbody>
 <equality><joint joint1="left_2" joint2="left_1" polycoef=".1 -.5 0 0 0"/></equality>
 <actuator>{motors}</actuator></mujoco>"""
ARM = """<body name="{s}_a" pos="0 {y} 0"><joint name="{s}_1" axis="0 0 1"/><geom size=".1"/>
 <body name="{s}_b" pos=".3 0 0"><joint name="{s}_2" axis="0 1 0"/><geom size=".1"/>
 <body name="{s}_c" pos=".3 0 0"><joint name="{s}_3" axis="0 1 0"/><geom size=".1"/>
 <body name="{s}_hand" pos=".1 0 0"><geom size=".1"/>
  <body name="{s}_thumb" pos=".1 .02 0"><joint name="{s}_4" type="slide"/><geom size=".01"/></body>
  <body name="{s}_index" pos=".1 -.02 0"><joint name="{s}_5" type="slide"/><geom size=".01"/></body>
 </body></body></body></body>"""


def two_arms(passive: tuple[str, ...] = ()) -> str:
    arms = "".join(ARM.format(s=s, y=y) for s, y in (("left", 0.2), ("right", -0.2)))
    names = [f"{s}_{i}" for s in ("left", "right") for i in range(1, 6)]
    motors = "".join(f'<motor joint="{name}"/>' for name in names if name not in passive)
    return GRIPPER.format(arms=arms, motors=motors)


def test_a_chain_between_two_bodies_and_behind_a_floating_base(tmp_path):
    file = tmp_path / "two.xml"
    file.write_text(two_arms())
    with pytest.raises(mc.RobotError, match=r"end in left_hand, right_hand; .*two.xml#left_hand"):
        mc.load_robot(file)
    model = mujoco.MjModel.from_xml_string(two_arms())
    names = [model.joint(i).name for i in range(model.njnt)]
    for spec, root in (
        ("left_hand", "base"),
        ("torso:left_hand", "torso"),
        ("torso:left_c", "torso"),
    ):
        seen = load_urdf(f"{file}#{spec}")
        tip, robot = spec.split(":")[-1], robot_from_dict(seen.content, "two")
        assert robot.joints == 3
        assert seen.chain[0].parent == root
        assert any("begins at" in notice for notice in seen.notices)
        q = np.random.default_rng(1).uniform(-1, 1, (5, 3))
        for each in q:
            own = model.qpos0.copy()
            for number, value in enumerate(each, 1):
                own[model.jnt_qposadr[names.index(f"left_{number}")]] = value
            judge = np.linalg.inv(pose_in(model, own, root)) @ pose_in(model, own, tip)
            assert_allclose(seen.base @ robot.pose(each) @ seen.tool, judge, atol=1e-9)
        up = {"base": [0, 0, 1], "torso": [-1, 0, 0]}[root]  # the torso's x points downwards
        assert_allclose(seen.base[:3, :3] @ robot.up, up, atol=1e-12)
    assert mc.load_robot(f"{file}#left_thumb").joints == 4  # a finger by its name
    with pytest.raises(mc.RobotError, match="does not hang on 'right_a'"):
        mc.load_robot(f"{file}#right_a:left_hand")
    with pytest.raises(mc.RobotError, match="no link 'nose'"):
        mc.load_robot(f"{file}#torso:nose")


def test_joints_without_a_drive_follow_or_stay(tmp_path):
    file, text = tmp_path / "two.xml", two_arms(passive=("left_2", "left_3"))
    file.write_text(text)
    seen = load_urdf(f"{file}#left_hand")
    robot = robot_from_dict(seen.content, "two")
    assert robot.joints == 2
    assert robot.passive.tolist() == [False, True]
    assert any("hinge, left_3" in n or "left_3, hinge" in n for n in seen.notices)
    model = mujoco.MjModel.from_xml_string(text)
    own = model.qpos0.copy()
    own[model.joint("left_1").qposadr], own[model.joint("left_2").qposadr] = 0.4, 0.1 - 0.5 * 0.4
    judge = np.linalg.inv(pose_in(model, own, "base")) @ pose_in(model, own, "left_hand")
    assert_allclose(seen.base @ robot.pose(np.array([0.4])) @ seen.tool, judge, atol=1e-9)


def test_one_line_says_what_is_wrong(tmp_path, monkeypatch):
    ball = '<body name="b"><joint type="ball"/>{0}<body name="c"><joint/>{0}</body></body>'
    ball = ball.format('<geom size="1"/>')
    wrong = {
        "<mujoco><worldbody/></mujoco>": "has no revolute",
        "<mujoco><worldbody><body/><joint/></worldbody></mujoco>": "MuJoCo refuses",
        "<mujoco>": "is not XML",
        "<svg/>": "neither MJCF nor URDF",
    }
    for text, match in wrong.items():
        (tmp_path / "arm.xml").write_text(text)
        with pytest.raises(mc.RobotError, match=match) as caught:
            mc.load_robot(tmp_path / "arm.xml")
        assert "\n" not in str(caught.value)
    (tmp_path / "arm.xml").write_text(f"<mujoco><worldbody>{ball}</worldbody></mujoco>")
    assert mc.load_robot(tmp_path / "arm.xml").joints == 1  # behind the ball
    with pytest.raises(mc.RobotError, match="is ball; only"):
        mc.load_robot(f"{tmp_path / 'arm.xml'}#world:c")
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    with pytest.raises(mc.OptionError, match=r"needs mujoco: pip install .*\[mujoco\]"):
        mc.load_robot(tmp_path / "arm.xml")


def six_of(side: str, y: float) -> str:
    """An arm of six joints with a site at its flange."""
    inside = f'<site name="{side}_flange" pos="0 0 .1"/>'
    places = ("0 0 .3", "0 .1 .1", ".4 0 .05", ".35 .02 0", "0 .1 0", ".1 0 0")
    for i, axis in reversed(
        list(enumerate(("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")))
    ):
        inside = (
            f'<body name="{side}_{i}" pos="{places[i]}"><joint name="{side}_j{i}" axis="{axis}" '
            f'range="-140 140" damping="5"/><inertial pos=".05 0 0" mass="{6 - i}" '
            f'diaginertia=".02 .02 .02"/>{inside}</body>'
        )
    return f'<body name="{side}_base" pos="0 {y} .5">{inside}</body>'


def test_an_arm_of_a_cell_is_corrected_by_the_command_that_is_printed(tmp_path, monkeypatch, says):
    monkeypatch.chdir(tmp_path)
    motors = "".join(
        f'<position joint="{side}_j{i}" kp="2000" kv="100"/>'
        for side in ("left", "right")
        for i in range(6)
    )
    bodies = six_of("left", 0.4) + six_of("right", -0.4)
    text = f"<mujoco><worldbody>{bodies}</worldbody><actuator>{motors}</actuator></mujoco>"
    Path("cell.xml").write_text(text)
    arm = "cell.xml#left_base:left_flange"
    command = f"simulate {arm} --poses 50 --seed 1 --compliance 0 --truth true.json -o poses.csv"
    assert run(*command.split()) == 0
    lines = says("calibrate", arm, "poses.csv", "-o", "fit.json").out.splitlines()
    (line,) = (each for each in lines if "minimax-cal export" in each)
    assert run(*line.split()[1:]) == 0
    before, after = (mujoco.MjModel.from_xml_path(f) for f in ("cell.xml", "calibrated.xml"))
    q = mc.read_measurements("poses.csv").q
    goal = mc.load_robot("true.json").pose(q)[:, :3, 3]

    def missed(model: Any) -> float:
        """RMS distance of the site from the true flange, base and tool fitted [m]."""
        own = np.hstack([q, np.zeros((len(q), 6))])
        there = np.array([pose_in(model, each, "left_flange") for each in own])

        def off(x: Array) -> Array:
            point = there[:, :3, :3] @ x[6:] + there[:, :3, 3]
            return np.asarray(Rotation.from_rotvec(x[:3]).apply(point) + x[3:6] - goal).ravel()

        x = least_squares(off, [0.0] * 9, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        return float(np.sqrt((off(x) ** 2).sum() / len(q)))

    assert missed(after) < 0.05 * missed(before)
    for name in ("right_0", "right_5"):
        assert_allclose(after.body(name).pos, before.body(name).pos, atol=1e-12)


COLON = """<mujoco><worldbody><body name="a:b0" pos=".2 .1 0"><geom size=".1"/>
<joint name="j1" axis="0 0 1"/>
<body name="a:b1" pos=".1 0 .4"><geom size=".1"/><joint name="j2" axis="0 1 0"/>
<body name="a:b2" pos="0 0 .4"><geom size=".1"/><joint name="j3" axis="0 1 0"/>
<body name="a:b3" pos=".05 0 .4"><geom size=".1"/><joint name="j4" axis="1 0 0"/></body></body>
</body></body></worldbody>{}</mujoco>"""


def test_names_may_hold_colons_and_frames_that_are_not_the_robots_are_told(tmp_path):
    file = tmp_path / "arm.xml"
    file.write_text(COLON.format(""))
    robot = mc.load_robot(f"{file}#a:b3")
    assert (robot.joints, mc.load_robot(f"{file}#a:b0:a:b3").joints) == (4, 3)
    fit = mc.calibrate(robot, mc.simulate(robot, 60, 3, 1).data, objective="sum")
    assert "a:b3" in mc.export(fit, to="mjcf", mjcf=f"{file}#a:b3")
    (said,) = (told for told in fit.notices if "root link is not the robot's base" in told)
    at = np.array([float(x) for x in said.rpartition("(")[2].partition(")")[0].split(",")])
    assert_allclose(at, 1e3 * load_urdf(f"{file}#a:b3").base[:3, 3], atol=1e-2)
    with pytest.raises(mc.RobotError, match="no link 'a'; its ends are a:b3"):
        mc.load_robot(f"{file}#a:b9")


def test_an_arm_without_actuators_beside_driven_fingers_is_refused_with_the_reason(tmp_path):
    file = tmp_path / "arm.xml"
    file.write_text(COLON.format('<actuator><motor joint="j1"/></actuator>'))
    with pytest.raises(mc.RobotError, match=r"no actuator drives these joints.* j2, j3, j4"):
        mc.load_robot(f"{file}#a:b0:a:b3")


MESHED = """<mujoco><compiler meshdir="looks" angle="radian"/><asset><mesh file="hull.obj"/>
<texture name="skin" type="2d" file="skin.png"/><material name="m" texture="skin"/></asset>
<worldbody><body name="a" pos="0 0 0.3"><inertial pos="0.1 0 0" mass="3" diaginertia=".1 .2 .2"/>
<joint name="j1" axis="0 0 1"/><geom type="mesh" mesh="hull" material="m"/>
<body name="b" pos="0.4 0 0">{inertial}<joint name="j2" axis="0 1 0"/>
<geom type="mesh" mesh="hull"/></body></body></worldbody></mujoco>"""
INERTIAL = '<inertial pos="0.2 0 0" mass="2" diaginertia=".1 .1 .1"/>'


def test_a_mesh_that_is_missing_is_no_reason_where_masses_are_given(tmp_path):
    """Of a simulator's model and of a URDF: what is drawn of an arm moves nothing."""
    file = tmp_path / "arm.xml"
    file.write_text(MESHED.format(inertial=INERTIAL))
    robot = mc.load_robot(file)
    assert robot.mass.tolist() == [3.0, 2.0]
    bare = re.sub(
        r"<asset>.*</asset>|<geom[^>]*>", "", MESHED.format(inertial=INERTIAL), flags=re.S
    )
    (tmp_path / "bare.xml").write_text(bare)
    q = np.array([[0.3, -0.8]])
    assert_allclose(robot.pose(q), mc.load_robot(tmp_path / "bare.xml").pose(q), atol=1e-12)
    file.write_text(MESHED.format(inertial=""))  # here the mesh would tell the mass
    with pytest.raises(mc.RobotError, match=r"MuJoCo refuses it: .*hull\.obj"):
        mc.load_robot(file)
    shape = '<geometry><mesh filename="package://maker/meshes/hull.dae"/></geometry>'
    inertia = '<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/>'
    link = f'<inertial><mass value="2"/>{inertia}</inertial><collision>{shape}</collision>'
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(
        f'<robot name="r"><link name="w"/><link name="a">{link}</link><joint name="j" '
        'type="continuous"><parent link="w"/><child link="a"/><axis xyz="0 0 1"/></joint></robot>'
    )
    model = read_mujoco_model(urdf).compile_model()
    assert model.body_mass.sum() == 2.0
