"""URDF as robot: any chain, the same poses, and clear words for what is not one."""

import itertools
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.robots.robot import robot_from_dict
from minimax_cal.robots.transforms import pose_to_rpy, transform_from_xyz_rpy
from minimax_cal.robots.urdf_file import apply_byte_edits, build_origin_edit, parse_urdf
from minimax_cal.robots.urdf_robot import (
    convert_urdf_to_robot,
    random_joint_values_in_limits,
    tip_poses,
)

EXACT = dict(rtol=0, atol=1e-9)
ARM = (  # made up: a root off the axis, a downward axis, a slide, a bent tip
    ("fixed", "0.1 0.2 0", "0 0 0.3", "", ""),
    ("revolute", "0 0 0.4", "0 0 0", "0 0 -1", 'lower="-2" upper="2.5"'),
    ("continuous", "0.05 0.1 0.2", "1.5708 0 0", "0 0 2", ""),
    ("fixed", "0 0 0.1", "0 0.4 0", "", ""),
    ("prismatic", "0.3 0 0", "0 0 0", "0 -1 0", 'lower="-0.1" upper="0.4"'),
    ("revolute", "0.2 0 0.1", "0 1e-6 0", "1 0 0", 'lower="-1" upper="1"'),
    ("revolute", "0 0.3 0.1", "0.3 0.2 0.1", "0.6 0 0.8", 'lower="-3" upper="3"'),
    ("fixed", "0.01 0.02 0.1", "0.1 0.2 0.3", "", ""),
)


def urdf_of(rows: tuple[tuple[str, ...], ...], masses: bool = False) -> str:
    lines = ['<?xml version="1.0"?>', "<!-- made up -->", '<robot name="made up">']
    for i in range(len(rows) + 1):
        mass = f'<inertial><origin xyz="0.0{i} 0 0.1"/><mass value="{i + 1}"/></inertial>'
        lines.append(f'  <link name="l{i}">{mass if masses else ""}</link>')
    for i, (kind, xyz, rpy, axis, limit) in enumerate(rows):
        lines.append(f'  <joint name="j{i}" type="{kind}">')
        lines.append(f'    <origin rpy="{rpy}" xyz="{xyz}" /> <!-- as drawn -->')
        lines.append(f'    <parent link="l{i}"/><child link="l{i + 1}"/>')
        lines += [f'    <axis xyz="{axis}"/>'] * bool(axis)
        lines += [f'    <limit {limit} effort="1" velocity="1"/>'] * bool(limit)
        lines.append("  </joint>")
    return "\n".join([*lines, "</robot>", ""])


def same_poses(text: str, tip: str = "") -> mc.Robot:
    model = convert_urdf_to_robot(parse_urdf(text.encode()), tip)
    robot = robot_from_dict(model.content)
    q = random_joint_values_in_limits(robot.lower, robot.upper)
    poses = model.base @ robot.pose(q) @ model.tool
    assert_allclose(poses, tip_poses(model.chain, q), **EXACT)
    return robot


def test_a_chain_of_every_joint():
    robot = same_poses(urdf_of(ARM))
    assert robot.joints == 5
    assert list(robot.sign) == [-1, 1, -1, 1, 1]  # z of the base stays upright
    assert_allclose(robot.up, [0, 0, 1], atol=1e-12)
    assert list(robot.prismatic) == [False, False, True, False, False]
    assert_allclose(robot.lower, [-2, -np.inf, -0.1, -1, -3])
    assert np.abs(robot.mdh[:, :2]).max() < 2  # nearly parallel axes do not explode


@pytest.mark.dev
@pytest.mark.parametrize("fixed", [{}, {1: 0.3, 3: -0.2}])
def test_pinocchio_reads_the_same_poses(fixed):
    """A joint whose limits are one number is fixed there."""
    pinocchio = pytest.importorskip("pinocchio")
    rows = [row for row in ARM if row[0] != "continuous"]
    for i, at in fixed.items():
        rows[i] = (*rows[i][:4], f'lower="{at}" upper="{at}"')
    text = urdf_of(tuple(rows))
    model = convert_urdf_to_robot(parse_urdf(text.encode()))
    robot = robot_from_dict(model.content)
    theirs = pinocchio.buildModelFromXML(text)
    data, frame = theirs.createData(), theirs.getFrameId(model.chain[-1].child)
    assert robot.joints == theirs.nq - len(fixed) == 4 - len(fixed)
    for q in random_joint_values_in_limits(robot.lower, robot.upper, 20):
        pinocchio.framesForwardKinematics(theirs, data, np.array([*fixed.values(), *q]))
        ours = model.base @ robot.pose(q) @ model.tool
        assert_allclose(ours, data.oMf[frame].homogeneous, **EXACT)


def test_masses_of_fixed_links_are_lumped():
    text = urdf_of(ARM, masses=True)
    model = convert_urdf_to_robot(parse_urdf(text.encode()))
    robot = robot_from_dict(model.content)
    assert_allclose(robot.mass, [3, 4 + 5, 6, 7, 8 + 9])
    # the centre of gravity of the last body, by the URDF's own frames and by ours
    q = random_joint_values_in_limits(robot.lower, robot.upper, 5)
    ends = {j.child: tip_poses(model.chain[: i + 1], q) for i, j in enumerate(model.chain)}
    theirs = sum(
        m * (ends[f"l{k}"] @ [0.01 * k, 0, 0.1, 1])[:, :3] for k, m in ((7, 8), (8, 9))
    ) / (8 + 9)  # fmt: skip
    ours = (model.base @ robot.pose(q) @ np.append(robot.com[-1], 1.0))[:, :3]
    assert_allclose(ours, theirs, **EXACT)


numbers = st.floats(-1.0, 1.0)
vectors = st.tuples(numbers, numbers, numbers)
quarters = st.sampled_from([-np.pi / 2, 0.0, np.pi / 2, np.pi, 1.5708, 1e-7])
turns = st.one_of(vectors, st.tuples(quarters, quarters, quarters))
axes = st.sampled_from(["1 0 0", "0 1 0", "0 0 1", "0 0 -1", "-1 0 0", "0.6 0 0.8"])
kinds = st.sampled_from(["revolute", "prismatic", "continuous", "fixed"])


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.lists(st.tuples(kinds, vectors, turns, axes), min_size=1, max_size=7))
def test_any_chain(rows):
    text = urdf_of(
        tuple(
            (kind, " ".join(map(repr, xyz)), " ".join(map(repr, rpy)), axis, "")
            for kind, xyz, rpy, axis in [*rows, ("revolute", (0, 0, 1), (0, 0, 0), "0 0 1")]
        )
    )
    same_poses(text)


def test_rpy_comes_back_near_what_stood_there(rng):
    steep = np.array(list(itertools.product((0.3, np.pi / 2, -np.pi / 2, np.pi), repeat=3)))
    for rpy in (*rng.uniform(-4, 4, (200, 3)), *steep):
        pose = transform_from_xyz_rpy(np.zeros(3), rpy)
        assert_allclose(
            transform_from_xyz_rpy(np.zeros(3), pose_to_rpy(pose)), pose, rtol=0, atol=1e-14
        )
        again = pose_to_rpy(pose, rpy)
        assert_allclose(transform_from_xyz_rpy(np.zeros(3), again), pose, rtol=0, atol=1e-14)
        if abs(np.cos(rpy[1])) > 1e-3:
            assert_allclose(again, rpy, rtol=0, atol=1e-9)


def test_load_robot_takes_a_urdf_and_a_tip(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(urdf_of(ARM))
    assert mc.load_robot(path).joints == 5
    assert mc.load_robot(f"{path}#l5").joints == 3
    assert mc.load_robot(path).name == "made up"


TWO_HANDS = """<robot name="r"><link name="a"/><link name="b"/><link name="left"/>
<link name="right"/><link name="plate"/><joint name="j" type="continuous"><parent link="a"/>
<child link="b"/><axis xyz="0 0 1"/></joint><joint name="jl" type="continuous"><parent link="b"/>
<child link="left"/></joint><joint name="jr" type="continuous"><parent link="b"/>
<child link="right"/></joint><joint name="p" type="fixed"><parent link="a"/>
<child link="plate"/></joint></robot>"""


def test_the_chain_is_named_where_there_are_several():
    urdf = parse_urdf(TWO_HANDS.encode(), "hands.urdf")
    with pytest.raises(mc.RobotError, match=r"several chains: they end in left, right; name .*tip"):
        convert_urdf_to_robot(urdf)
    model = convert_urdf_to_robot(urdf, "left")
    assert [j.name for j in model.chain] == ["j", "jl"]
    assert any("jr" in notice for notice in model.notices)
    with pytest.raises(mc.RobotError, match="no link 'hand'; its ends are left, plate, right"):
        convert_urdf_to_robot(urdf, "hand")
    with pytest.raises(mc.RobotError, match="no moving joint leads to 'plate'"):
        convert_urdf_to_robot(urdf, "plate")


def test_of_frames_on_one_body_tool0_is_meant():
    text = TWO_HANDS.replace('"jr" type="continuous"', '"jr" type="fixed"').replace(
        '"jl" type="continuous"', '"jl" type="fixed"'
    )
    assert convert_urdf_to_robot(parse_urdf(text.encode())).chain[-1].child == "b"
    text = text.replace("left", "tool0")
    assert convert_urdf_to_robot(parse_urdf(text.encode())).chain[-1].child == "tool0"


def test_a_chain_between_two_links_and_grippers_left_out():
    """A lifting torso with two arms, each with a flange, a camera and two fingers."""
    pinocchio = pytest.importorskip("pinocchio")
    lines = ['<robot name="cell"><link name="world"/><link name="torso"/>']

    def joint(name: str, kind: str, parent: str, child: str, inside: str) -> None:
        lines.append(
            f'<link name="{child}"/><joint name="{name}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="{child}"/>{inside}'
            '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        )

    lines.append(
        '<joint name="lift" type="prismatic"><parent link="world"/><child link="torso"/>'
        '<origin xyz="0 0 1" rpy="0 1 0"/><axis xyz="1 0 0"/>'
        '<limit lower="0" upper="1" effort="1" velocity="1"/></joint>'
    )
    for side, y in (("left", 0.2), ("right", -0.2)):
        above = "torso"
        for i, turn in enumerate(("0 0 0", "1.5 0 0", "0 0 1", ".2 .3 .4")):
            where = f'<origin xyz=".1 {y} .2" rpy="{turn}"/><axis xyz="0 .1 1"/>'
            joint(f"{side}_{i}", "revolute", above, f"{side}_link{i}", where)
            above = f"{side}_link{i}"
        joint(f"{side}_f", "fixed", above, f"{side}_flange", '<origin xyz="0 0 .1"/>')
        joint(f"{side}_h", "fixed", f"{side}_flange", f"{side}_hand", '<origin xyz="0 0 .1"/>')
        for finger in "ab":
            place = '<origin xyz="0 .02 .1"/>'
            joint(f"{side}_{finger}", "prismatic", f"{side}_hand", f"{side}_finger_{finger}", place)
        joint(f"{side}_c", "fixed", f"{side}_link1", f"{side}_camera", "")
    text = "".join([*lines, "</robot>"])
    urdf = parse_urdf(text.encode(), "cell.urdf")
    with pytest.raises(mc.RobotError, match=r"left_flange, right_flange; .* cell.urdf#left_flange"):
        convert_urdf_to_robot(urdf)
    theirs = pinocchio.buildModelFromXML(text)
    data, q = theirs.createData(), pinocchio.randomConfiguration(theirs)
    pinocchio.framesForwardKinematics(theirs, data, q)
    there = {f.name: data.oMf[i].homogeneous for i, f in enumerate(theirs.frames)}
    for spec in ("torso:right_flange", "right_link0:right_hand", "world:left_finger_a", "torso:"):
        root, _, tip = spec.partition(":")
        if not tip:
            with pytest.raises(mc.RobotError, match="several chains"):
                convert_urdf_to_robot(urdf, spec)
            continue
        model = convert_urdf_to_robot(urdf, spec)
        own = [
            q[theirs.joints[theirs.getJointId(j.name)].idx_q] for j in model.chain if j.is_moving
        ]
        ours = model.base @ robot_from_dict(model.content).pose(np.array(own)) @ model.tool
        assert_allclose(ours, np.linalg.inv(there[root]) @ there[tip], **EXACT)
        up = model.base[:3, :3] @ robot_from_dict(model.content).up
        if root == "torso":
            assert_allclose(up, there["torso"][:3, :3].T @ [0, 0, 1], **EXACT)
    assert convert_urdf_to_robot(urdf, "right_link0:").chain[-1].child == "right_flange"


ENDS = '<parent link="a"/><child link="b"/>'
JOINT = '<joint name="j" type="revolute"><parent link="a"/><child link="b"/>{}</joint>'
BROKEN = {
    "": r":1: is not XML \(no element found\)",
    "<robot><link": ":1: is not XML",
    "<html/>": "its root is <html>, expected <robot>",
    "<robot/>": "holds no <link>, so no robot",
    f'<robot><joint name="j" type="fixed">{ENDS}</joint></robot>': "no link 'a'",
    "<robot>"
    + "".join(
        f'<link name="{a}"/><joint name="j{a}" type="fixed"><parent link="{a}"/>'
        f'<child link="{b}"/></joint>'
        for a, b in ("ab", "ba")
    )
    + "</robot>": "expected one root link, found none: the joints form a ring",
    '<robot><link name="a"/></robot>': "has no revolute, continuous or prismatic joint",
    "<robot><link/></robot>": "<link> has no name",
    '<robot><xacro:macro name="x"/></robot>': "this is xacro, not URDF; expand it first",
    f'<robot><link name="a"/>{JOINT}</robot>': "joint 'j': no link 'b'",
    '<robot><link name="a"/><link name="a"/></robot>': "a second link 'a'",
    '<robot><link name="a"/><link name="b"/></robot>': "expected one root link, found a, b",
    '<robot><link name="a"/><joint name="j" type="fixed"/></robot>': "'j' has no <parent>",
    f'<robot><link name="a"/><link name="b"/>{JOINT}</robot>'.replace(
        "revolute", "ball"
    ): "no joint type 'ball'",
    **{
        f'<robot><link name="a"/><link name="b"/>{JOINT.format(inner)}</robot>': words
        for inner, words in {
            '<origin xyz="1 2"/>': ":1: joint 'j': xyz='1 2': expected 3 numbers",
            '<origin xyz="1 nan 2"/>': "expected 3 numbers",
            '<origin rpy="0 ${pi} 0"/>': "is xacro; expand it first",
            '<axis xyz="0 0 0"/>': "its axis is a zero vector",
            '<limit lower="1" upper="-1"/>': "limit lower is above upper",
            '<limit lower="0" upper="0"/>': r"joint that its limits \(lower = upper\) do not hold",
            '<limit lower="one"/>': "expected a number",
            '<mimic joint="k"/>': "mimics 'k', no moving joint of the file",
            '<mimic joint="j"/>': "mimics 'j', a ring",
            '<origin xyz="1e300 0 0"/>': "is off by|over 1 km|check units",
        }.items()
    },
}


@pytest.mark.parametrize("text", BROKEN, ids=range(len(BROKEN)))
def test_a_broken_file_is_one_clear_line(text, tmp_path):
    path = tmp_path / "broken.urdf"
    path.write_text(text)
    with pytest.raises(mc.RobotError, match=BROKEN[text]) as caught:
        mc.load_robot(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_origins_change_and_no_other_byte():
    raw = """\ufeff<?xml version='1.0'?>
<robot name="é > '"><!-- <origin xyz="1 2 3"/> -->
  <link name="a"><visual><origin xyz="9 9 9"/></visual></link><link name="b"/><link name="c"/>
\t<joint name="j" type="continuous" comment="a > b">
    <parent link="a"/><child link="b"/>
  </joint>
  <joint name="k" type="continuous"><parent link="b"/><child link="c"/><origin/></joint>
</robot>""".encode()
    urdf = parse_urdf(raw)
    same = [build_origin_edit(raw, joint, lambda _: ("1 0 0", "0 0 1")) for joint in urdf.joints]
    made = apply_byte_edits(raw, same)
    origin = b'<origin xyz="1 0 0" rpy="0 0 1"/>'
    expected = raw.replace(b'b">\n', b'b">\n\t  ' + origin + b"\n", 1)
    assert made == expected.replace(b"<origin/>", origin)
    for joint in parse_urdf(made).joints:
        assert_allclose(
            joint.origin, transform_from_xyz_rpy(np.array([1, 0, 0]), np.array([0, 0, 1]))
        )


HOSTILE = (
    '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="&x;"/>',
    '<!DOCTYPE r SYSTEM "http://localhost:1/x.dtd"><robot/>',
    '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><robot>&b;</robot>',
    '<!DOCTYPE r [<!ENTITY % p SYSTEM "file:///etc/hostname"> %p;]><robot/>',
)


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_xml_is_refused(text):
    with pytest.raises(mc.RobotError, match="DOCTYPE or entities"):
        parse_urdf(text.encode(), "x.urdf")
    with pytest.raises(mc.RobotError, match="undefined entity"):
        parse_urdf(b'<robot name="&x;"/>', "x.urdf")


def test_not_text_and_not_there(tmp_path):
    path = tmp_path / "a.urdf"
    with pytest.raises(mc.RobotError, match="cannot be read"):
        mc.load_robot(path)
    path.write_bytes(b"\xff\xfe<\x00")
    with pytest.raises(mc.RobotError, match="not UTF-8"):
        mc.load_robot(path)
    path.write_bytes(b"<robot>" + b"<a>" * 200_000)  # depth costs no stack
    with pytest.raises(mc.RobotError, match="is not XML"):
        mc.load_robot(path)


# ---- ends that are not the robot's own -----------------------------------------------------------


def limited(name: str, kind: str, links: str, more: str = "", axis: str = "0 0 1") -> str:
    """A joint with limits, its links as parent and child."""
    parent, child = links.split()
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{axis}"/><limit lower="0.5" upper="2" effort="1" velocity="1"/>{more}</joint>'
    )


def made_of(*joints: str) -> str:
    """A URDF of joints; its links are those that they name."""
    names = dict.fromkeys(re.findall(r'link="(\w+)"', "".join(joints)))
    links = "".join(f'<link name="{name}"/>' for name in names)
    return f'<robot name="made up">{links}{"".join(joints)}</robot>'


def test_a_base_that_leans_in_the_root_link_is_said_with_its_turn(tmp_path):
    """First a base that only stands elsewhere: then there is no turn to say."""
    place = '<origin xyz="0.1 0 0.2" rpy="{}"/>'
    for rpy, turn in (("0 0 0", ""), ("0 0.785398163397448 0", "A 0 B 45 C 0 deg")):
        fixed = '<joint name="fix" type="fixed"><parent link="root"/><child link="a"/>'
        text = made_of(fixed + place.format(rpy) + "</joint>", limited("j", "revolute", "a b"))
        model = convert_urdf_to_robot(parse_urdf(text.encode()))
        (said,) = model.base_and_tool_notices
        assert "root link is not the robot's base" in said
        assert turn in said
        assert ("turned by" in said) == bool(turn)
        angles = [float(x) for x in re.findall(r"[ABC] ([-\d.]+)", said)] or [0.0] * 3
        spoken = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
        assert_allclose(spoken, model.base[:3, :3], rtol=0, atol=1e-7)
        (tmp_path / "arm.urdf").write_text(text)
        assert said.partition(": ")[2] in mc.load_robot(tmp_path / "arm.urdf").notices[0]


@pytest.mark.parametrize("kind", ["prismatic", "revolute"])
def test_joints_of_the_chain_follow_one_beside_it(kind):
    """Two stages of a column by half each; the values are those of the joint beside the chain.

    One stage follows it by way of the other's mimic.
    """
    text = made_of(
        limited("column", kind, "base virtual"),
        limited("middle", kind, "base m", '<mimic joint="column" multiplier="0.5" offset="-0.7"/>'),
        limited("top", kind, "m t", '<mimic joint="middle" multiplier="2" offset="0.4"/>'),
        limited("turn", "revolute", "t tool", axis="0 1 0"),
    )
    model = convert_urdf_to_robot(parse_urdf(text.encode()), "tool")
    robot = robot_from_dict(model.content)
    assert robot.passive.tolist() == [False, True, False]
    assert model.content["joints"][0]["name"] == "column"
    assert (robot.lower[0], robot.upper[0]) == (0.5, 2.0)
    assert not [text for text in model.notices if "outside the chain" in text]
    u, turn = 1.3, 0.6
    stage = (0.5 * u - 0.7) + (2.0 * (0.5 * u - 0.7) + 0.4)
    wanted = np.eye(4)
    if kind == "prismatic":
        wanted[2, 3] = stage
    else:
        wanted[:3, :3] = Rotation.from_euler("Z", stage).as_matrix()
    wanted[:3, :3] = wanted[:3, :3] @ Rotation.from_euler("Y", turn).as_matrix()
    found = model.base @ robot.pose(np.array([[u, turn]])) @ model.tool
    assert_allclose(found[0], wanted, **EXACT)
    same_poses(text, "tool")


def test_a_joint_beside_the_chain_may_be_held_by_none(tmp_path):
    """A ring of mimics beside the chain, and one that is fixed, are refused in one line."""
    for beside, said in (
        (limited("side", "revolute", "base s", '<mimic joint="side"/>'), "mimics 'side', a ring"),
        (limited("side", "fixed", "base s"), "mimics 'side', no moving joint of the file"),
    ):
        text = made_of(beside, limited("j", "revolute", "base tool", '<mimic joint="side"/>'))
        with pytest.raises(mc.RobotError, match=said):
            convert_urdf_to_robot(parse_urdf(text.encode()), "tool")
