"""SDF of an arm, read by a reader of its own: the same poses, torques and friction as its MJCF."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc

mujoco = pytest.importorskip("mujoco")
pin = pytest.importorskip("pinocchio")
pytestmark = pytest.mark.dev

KINDS = {
    "revolute": pin.JointModelRevoluteUnaligned,
    "prismatic": pin.JointModelPrismaticUnaligned,
}
GIVEN = """<mujoco><compiler angle="radian"/><option gravity="0 0 -9.81"/><worldbody>
<body name="a" pos="0 0 0.3" euler="0.2 0 0.1"><inertial pos="0.1 0 0.02" mass="4" fullinertia="0.05
 0.06 0.04 0.001 0.002 0"/><joint name="j1" axis="0 0 1" damping="2" frictionloss="3" armature="0.1"
 range="-2 2" stiffness="5" springref="0.4" pos="0.01 0.02 0"/>
<body name="b" pos="0.4 0 0.1" euler="1.5707963 0 0"><inertial pos="0 0.1 0" mass="2"
 diaginertia="0.02 0.03 0.01"/><joint name="j2" axis="0 0.6 0.8" damping="1.5 0 2"/>
<body name="c" pos="0 0.2 0"><inertial pos="0 0 0.05" mass="1" diaginertia="0.01 0.01 0.01"/>
<joint name="j3" type="slide" axis="1 0 0" range="-0.1 0.3"/>
<site name="smr1" pos="0.01 0.02 0.03"/>
</body></body></body></worldbody></mujoco>"""


def numbers(text: str | None) -> np.ndarray:
    return np.array([float(value) for value in str(text).split()])


def placement(parent: ET.Element) -> pin.SE3:
    values = numbers(parent.findtext("pose"))
    return pin.SE3(Rotation.from_euler("xyz", values[3:]).as_matrix(), values[:3])


def chain_of(text: str) -> tuple[pin.Model, dict[str, ET.Element]]:
    """A serial arm of SDF by Pinocchio, link after link."""
    arm = ET.fromstring(text).find("model")
    assert arm is not None
    links = {str(link.get("name")): link for link in arm.iter("link")}
    model, index, seat = pin.Model(), {"world": 0}, {"world": pin.SE3.Identity()}
    for joint in arm.iter("joint"):
        parent, child = str(joint.findtext("parent")), str(joint.findtext("child"))
        link, at = links[child], placement(links[child])
        assert link.find("pose").get("relative_to", "world") == parent
        anchor, axis = placement(joint), numbers(joint.findtext("axis/xyz"))
        kinds = {
            "revolute": pin.JointModelRevoluteUnaligned,
            "prismatic": pin.JointModelPrismaticUnaligned,
        }
        number = model.addJoint(
            index[parent],
            kinds[str(joint.get("type"))](axis),
            seat[parent] * at * anchor,
            joint.get("name"),
        )
        index[child], seat[child] = number, anchor.inverse()
        moments = link.find("inertial/inertia")
        ixx, ixy, ixz, iyy, iyz, izz = (
            float(moments.findtext(k)) for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        )
        tensor = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
        body = pin.Inertia(
            float(link.findtext("inertial/mass")),
            placement(link.find("inertial")).translation,
            tensor,
        )
        model.appendBodyToJoint(number, body, anchor.inverse())
        model.addFrame(pin.Frame(child, number, anchor.inverse(), pin.FrameType.BODY))
    frames = {str(frame.get("name")): frame for frame in arm.iter("frame")}
    for name, frame in frames.items():
        holder = str(frame.get("attached_to"))
        model.addFrame(
            pin.Frame(name, index[holder], seat[holder] * placement(frame), pin.FrameType.OP_FRAME)
        )
    return model, {str(joint.get("name")): joint for joint in arm.iter("joint")}


def test_poses_and_torques_are_those_of_the_mjcf(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(GIVEN)
    said: list[str] = []
    model, joints = chain_of(mc.export(path, to="sdf", notify=said.append))
    model.gravity.linear = np.array([0.0, 0.0, -9.81])
    data, theirs = model.createData(), mujoco.MjModel.from_xml_path(str(path))
    theirs.dof_armature[:] = theirs.dof_damping[:] = theirs.dof_frictionloss[:] = 0.0
    theirs.dof_dampingpoly[:] = theirs.jnt_stiffness[:] = 0.0
    state = mujoco.MjData(theirs)
    rng = np.random.default_rng(0)
    for _ in range(5):
        state.qpos[:], state.qvel[:], state.qacc[:] = rng.uniform(-0.1, 0.3, (3, 3))
        mujoco.mj_inverse(theirs, state)
        mujoco.mj_kinematics(theirs, state)
        torque = pin.rnea(model, data, state.qpos.copy(), state.qvel.copy(), state.qacc.copy())
        assert_allclose(torque, state.qfrc_inverse, atol=1e-9)
        pin.framesForwardKinematics(model, data, state.qpos.copy())
        place = data.oMf[model.getFrameId("smr1")].translation
        assert_allclose(place, state.site("smr1").xpos, atol=1e-12)
    dynamics = joints["j1"].find("axis/dynamics")
    found = [
        float(dynamics.findtext(k))
        for k in ("damping", "friction", "spring_reference", "spring_stiffness")
    ]
    assert found == [2.0, 3.0, 0.4, 5.0]
    assert float(joints["j3"].findtext("axis/limit/upper")) == 0.3
    told = " ".join(said)
    assert "armature) of j1" in told
    assert "proportional to the speed, of j2" in told


def test_a_calibration_as_sdf_has_its_targets_where_they_are(tmp_path):
    made = mc.simulate("irb2600", 40, 3, seed=1)
    fit = mc.calibrate("irb2600", made.data)
    text = mc.export(fit, to="sdf", path=tmp_path / "arm.sdf", notify=lambda _: None)
    assert (tmp_path / "arm.sdf").read_text() == text
    model, _ = chain_of(text)
    data, cell = model.createData(), fit.cell
    for q in made.data.q[:5]:
        pin.framesForwardKinematics(model, data, q)
        for name, target in zip(cell.target_names, cell.target_positions, strict=True):
            expected = cell.robot.pose(q[None])[0] @ [*target, 1.0]
            assert_allclose(data.oMf[model.getFrameId(name)].translation, expected[:3], atol=1e-9)


def test_a_body_of_several_joints_is_refused(tmp_path, capsys):
    path = tmp_path / "arm.xml"
    path.write_text(GIVEN.replace('<joint name="j2"', '<joint name="play"/><joint name="j2"'))
    assert run("export", path, "--to", "sdf", "-o", tmp_path / "arm.sdf") == 2
    assert "body b has several joints" in capsys.readouterr().err
    assert not (tmp_path / "arm.sdf").exists()
