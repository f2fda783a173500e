"""Robot files in other conventions, judged by chains written here and by Pinocchio."""

import copy
import json
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.compensation.exporters.export_formats import EXPORTERS
from minimax_cal.compensation.robot_export import export
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots.robot import robot_from_dict
from minimax_cal.robots.transforms import build_links_table

NOISE = 20e-6  # of a coordinate [m]
Content = dict[str, Any]


def joint(a: float, d: float, theta: float, alpha: float, **more: object) -> Content:
    return {"a": a, "d": d, "theta": theta, "alpha": alpha, "lower": -150, "upper": 150, **more}


def arm(*joints: Content, **more: object) -> Content:
    units = {"length": "mm", "angle": "deg"}
    return {"name": "arm", "units": units, "joints": list(joints), **more}


CRAIG = arm(  # the Puma of Craig's book, its table row by row
    joint(0, 660, 0, 0), joint(0, 0, -90, -90, offset=90), joint(432, 149, 0, 0),
    joint(20, 432, 0, -90), joint(0, 0, 0, 90, sign=-1), joint(0, 56, 0, -90),
    convention="modified",
)  # fmt: skip
TURNED = arm(  # as some makers draw arms: joint 1 looks down
    joint(0, -675, 0, 180), joint(350, 0, 0, 90), joint(1150, 0, -90, 0), joint(41, -1200, 0, 90),
    joint(0, 0, 0, -90), joint(0, -215, 180, 90), convention="modified",
)  # fmt: skip
SLIDE = arm(
    joint(0, 300, 0, 0), joint(250, 0, 0, 0, beta=0.5), joint(200, -50, 10, 180, type="prismatic",
    offset=20, lower=-100, upper=150), joint(0, 40, 0, 0), convention="modified",
)  # fmt: skip
LINKED = arm(  # joint 3 as some controllers count it: from the horizontal
    joint(100, 400, 0, 90), joint(600, 0, 90, 0), joint(130, 0, 0, 90), joint(0, 700, 0, -90),
    joint(0, 0, 0, 90), joint(0, 100, 0, 0), coupling={"J3": {"J2": -1.0}},
)  # fmt: skip
PALLETISER = arm(  # rods keep the wrist level: joint 4 has no drive
    joint(200, 600, 0, 90), joint(900, 0, 90, 0), joint(1000, 0, -90, 0), joint(200, 0, 0, -90),
    joint(0, -150, 0, 0), coupling={"J3": {"J2": -1}, "J4": {"J3": -1, "J4": 0}},
)  # fmt: skip


def matrix(axis: str, turn: float, place: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Any:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_euler(axis, turn).as_matrix(), place
    return out


def flange(content: Content, q: Any) -> Any:
    """The last frame as the file's own convention says, joint by joint (m, 4, 4)."""
    n = len(content["joints"])
    ratio = np.eye(n)
    for name, shares in content.get("coupling", {}).items():
        for other, share in shares.items():
            ratio[int(name[1:]) - 1, int(other[1:]) - 1] = share
    unit = {"deg": np.pi / 180, "rad": 1.0}[content["units"]["angle"]]
    poses = []
    for values in q @ ratio.T:
        links = []
        for row, value in zip(content["joints"], values, strict=True):
            slides = row.get("type") == "prismatic"
            turn, move = unit * row["theta"], 1e-3 * row["d"]
            own = row.get("sign", 1) * value + row.get("offset", 0) * (1e-3 if slides else unit)
            turn, move = turn + own * (not slides), move + own * slides
            drive = matrix("z", turn, (0.0, 0.0, move))
            rest = matrix("x", unit * row["alpha"], (1e-3 * row["a"], 0.0, 0.0))
            rest = rest @ matrix("y", unit * row.get("beta", 0.0))
            craig = content.get("convention") == "modified"
            links.append(rest @ drive if craig else drive @ rest)
        end = content.get("flange", {})
        rest = matrix("x", unit * end.get("alpha", 0.0), (1e-3 * end.get("a", 0.0), 0.0, 0.0))
        poses.append(reduce(np.matmul, [*links, rest @ matrix("y", unit * end.get("beta", 0.0))]))
    return np.array(poses)


def bent(content: Content, rng: np.random.Generator) -> Content:
    """The arm as it was built: every number of its file a little off."""
    out = copy.deepcopy(content)
    for i, row in enumerate(out["joints"]):
        craig_first = content.get("convention") == "modified" and i == 0
        for key, size in (("a", 0.4), ("d", 0.4), ("theta", 0.05), ("alpha", 0.05)):
            if not (craig_first and key in ("a", "alpha")):
                row[key] = row[key] + size * rng.normal()
    return out


def driven(robot: mc.Robot, rng: np.random.Generator, poses: int) -> Any:
    low, high = np.maximum(robot.lower, -2.0), np.minimum(robot.upper, 2.0)
    return rng.uniform(low, high, (poses, robot.joints))


def measured(truth: Content, robot: mc.Robot, rng: np.random.Generator) -> Measurements:
    """Three reflectors at 70 poses by the truth's own chain; columns of driven joints alone."""
    q = driven(robot, rng, 70)
    pose = matrix("xyz", np.array([0.1, 0.2, 0.7]), (2.0, 1.0, 0.3)) @ flange(truth, q)
    spots = np.array([[0.1, 0, 0.05], [-0.05, 0.09, 0.02], [-0.05, -0.09, 0.1]])
    y = spots @ np.swapaxes(pose[:, :3, :3], 1, 2) + pose[:, None, :3, 3]
    data = mc.measurements(q[:, ~robot.passive], y + NOISE * rng.normal(size=y.shape))
    return Measurements(**{**vars(data), "sliding": robot.prismatic[~robot.passive]})


FILES = {
    "craig": CRAIG, "turned": TURNED, "slide": SLIDE, "linked": LINKED, "palletiser": PALLETISER,
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_the_flange_is_where_the_files_own_convention_puts_it(name, rng):
    robot = robot_from_dict(FILES[name])
    q = driven(robot, rng, 30)
    assert_allclose(robot.pose(q), flange(FILES[name], q), rtol=0, atol=1e-12)
    assert_allclose(robot.pose(q[:, ~robot.passive]), robot.pose(q), rtol=0, atol=0)


@pytest.mark.parametrize("name", FILES)
def test_a_file_written_again_is_the_same_file(name, tmp_path):
    robot = robot_from_dict(FILES[name])
    robot.save(tmp_path / "arm.json")
    again = mc.load_robot(tmp_path / "arm.json")
    assert_allclose(again.mdh, robot.mdh, rtol=0, atol=1e-15)
    assert_allclose(again.joint_to_chain_matrix, robot.joint_to_chain_matrix)
    written = json.loads((tmp_path / "arm.json").read_text())
    for old, new in zip(FILES[name]["joints"], written["joints"], strict=True):
        for key in ("a", "d"):
            assert new[key] == pytest.approx(old[key], abs=1e-9), key
        for key in ("theta", "alpha"):
            assert np.degrees(new[key]) == pytest.approx(old[key], abs=1e-9), key


def test_masses_of_craigs_links_are_in_the_frames_of_his_joints(tmp_path):
    content = copy.deepcopy(CRAIG)
    inertia = [0.5, 0.01, -0.02, 0.6, 0.03, 0.7]
    content["joints"][2] |= {"mass_kg": 10, "com_mm": [200, 10, 20], "inertia": inertia}
    robot = robot_from_dict(content)
    q = np.zeros((1, 6))
    first_three = {**content, "joints": content["joints"][:3]}
    frame = flange(first_three, q[:, :3])[0]  # Craig's frame 3
    whole = robot_from_dict({**CRAIG, "joints": content["joints"][:4]})
    ours = whole.pose(q[:, :4])[0] @ matrix("z", 0.0, (0, 0, -0.432))  # where joint 4 begins
    place = frame @ [0.2, 0.01, 0.02, 1.0]
    assert_allclose(ours @ [*robot.com[2], 1.0], place, rtol=0, atol=1e-12)
    robot.save(tmp_path / "arm.json")
    again = mc.load_robot(tmp_path / "arm.json")
    written = json.loads((tmp_path / "arm.json").read_text())["joints"][2]
    assert written["com_mm"] == pytest.approx([200, 10, 20])
    assert written["inertia"] == pytest.approx(inertia)
    assert_allclose(again.inertia[2], robot.inertia[2], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", FILES)
def test_a_simulated_arm_is_calibrated_to_its_noise(name, rng):
    truth, robot = bent(FILES[name], rng), robot_from_dict(FILES[name])
    data = measured(truth, robot, rng)
    fit = mc.calibrate(robot, data, "sum", holdout=0.2)
    assert fit.accuracy["nominal"].rms_mm > 0.3
    assert fit.accuracy["holdout"].rms_mm < 1.4e3 * NOISE * np.sqrt(3)
    # the result speaks the file's convention: its rows move as the truth's do
    content = fit.robot.to_dict()
    found = {p.name: p for p in fit.parameters}
    rows = content["joints"]
    for i, row in enumerate(rows):
        for key in ("a", "d", "theta", "alpha"):
            parameter = found.get(f"{key}{i + 1}")
            if parameter is None:
                assert (content["convention"], i) == ("modified", 0)
                continue
            value = parameter.value * (1e3 if key in "ad" else 1.0)
            assert row[key] == pytest.approx(value, abs=1e-9), parameter.name
            inner = name != "slide" and parameter.identifiable and parameter.sigma < 2e-5
            if inner and key == "a":
                assert row[key] == pytest.approx(truth["joints"][i][key], abs=0.2), parameter.name
    q = driven(robot, rng, 20)
    assert_allclose(fit.robot.pose(q), flange(content, q), rtol=0, atol=1e-12)


def test_options_and_tables_speak_of_the_files_rows(rng):
    robot = robot_from_dict(CRAIG)
    data = measured(bent(CRAIG, rng), robot, rng)
    fit = mc.calibrate(robot, data, "sum", fix="a3", holdout=0.2)
    found = {p.name: p for p in fit.parameters}
    assert "a1" not in found
    assert (found["a3"].value, found["a3"].reason) == (0.432, "fixed by the user")
    assert found["a4"].identifiable
    assert found["theta2"].nominal == pytest.approx(-np.pi / 2)
    with pytest.raises(mc.OptionError, match="no parameter called 'a1'"):
        mc.calibrate(robot, data, "sum", fix="a1")
    rows = build_links_table(robot).rows
    assert rows[2][1:4] == pytest.approx((432.0, 149.0, 0.0))


def test_joints_that_bring_a_linked_arm_to_a_pose(rng):
    for content in (LINKED, PALLETISER, CRAIG):
        robot = robot_from_dict(content)
        q = 0.5 * driven(robot, rng, 10)
        found = robot.inverse(robot.pose(q), near=q + 0.05 * ~robot.passive)
        assert_allclose(robot.pose(found), robot.pose(q), rtol=0, atol=1e-6)
        assert not found[:, robot.passive].any()


@pytest.mark.dev
def test_a_urdf_of_a_linked_arm_follows_by_mimic(rng, tmp_path):
    pinocchio = pytest.importorskip("pinocchio")
    for content in (LINKED, PALLETISER, TURNED):
        robot = robot_from_dict(content)
        path = tmp_path / "arm.urdf"
        export(robot, "urdf", path, notify=str)
        model = pinocchio.buildModelFromUrdf(str(path), mimic=True)
        data = model.createData()
        q = driven(robot, rng, 10)
        frame = model.getFrameId("flange")
        for values, pose in zip(q[:, ~robot.passive], robot.pose(q), strict=True):
            state = pinocchio.neutral(model)
            for number, value in zip(np.flatnonzero(~robot.passive) + 1, values, strict=True):
                at = model.joints[model.getJointId(f"joint_{number}")]
                turns = [np.cos(value), np.sin(value)] if at.nq == 2 else [value]
                state[at.idx_q : at.idx_q + at.nq] = turns
            pinocchio.framesForwardKinematics(model, data, state)
            assert_allclose(data.oMf[frame].homogeneous, pose, rtol=0, atol=1e-9)
        again = mc.load_robot(path)
        assert_allclose(again.pose(q[:, ~robot.passive]), robot.pose(q), rtol=0, atol=1e-9)


MIMIC = """<robot name="linked">
  <link name="base"/><link name="l1"/><link name="l2"/><link name="l3"/><link name="l4"/>
  <link name="tool0"/>
  <joint name="turn" type="revolute"><origin xyz="0 0 0.5"/><parent link="base"/>
    <child link="l1"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="lift" type="revolute"><origin xyz="0.2 0.01 0.1" rpy="1.5707963 0 0.01"/>
    <parent link="l1"/><child link="l2"/><axis xyz="0 0 -1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="arm" type="revolute"><origin xyz="0.01 0.7 0"/><parent link="l2"/><child link="l3"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="level" type="revolute"><origin xyz="0.8 0 0"/><parent link="l3"/><child link="l4"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/>
    <mimic joint="lift" multiplier="1.5" offset="0.2"/></joint>
  <joint name="tip" type="fixed"><origin xyz="0.1 0 0.05" rpy="0.3 0 0"/><parent link="l4"/>
    <child link="tool0"/></joint>
</robot>"""


@pytest.mark.dev
def test_mimic_of_a_urdf_is_read_and_corrected(rng, tmp_path):
    pinocchio = pytest.importorskip("pinocchio")
    path = tmp_path / "linked.urdf"
    path.write_text(MIMIC)
    robot = mc.load_robot(path)
    assert robot.passive.tolist() == [False, False, False, True]
    q = rng.uniform(-0.9, 0.9, (40, 3))

    def poses(urdf: Path) -> Any:
        model = pinocchio.buildModelFromUrdf(str(urdf), mimic=True)
        data = model.createData()
        out = []
        for values in q:
            pinocchio.framesForwardKinematics(model, data, values)
            out.append(data.oMf[model.getFrameId("tool0")].homogeneous.copy())
        return np.array(out)

    drawn, ours = poses(path), robot.pose(q)
    base, tool = drawn @ np.linalg.inv(drawn[0]), ours @ np.linalg.inv(ours[0])
    assert_allclose(np.trace(base, axis1=1, axis2=2), np.trace(tool, axis1=1, axis2=2), atol=1e-9)
    # an arm whose wrist is mounted a little askew, found from points and written back
    wrong = tmp_path / "wrong.urdf"
    wrong.write_text(MIMIC.replace('xyz="0.8 0 0"', 'xyz="0.801 0.001 0" rpy="0.002 0.001 0.003"'))
    truth = poses(wrong)
    spots = np.array([[0.1, 0, 0.05, 1], [-0.05, 0.09, 0.02, 1], [0.0, -0.1, 0.1, 1]])
    y = (truth @ spots.T).swapaxes(1, 2)[..., :3]
    data = mc.measurements(q, y + NOISE * rng.normal(size=y.shape))
    fit = mc.calibrate(robot, data, "sum", holdout=0.2)
    assert fit.accuracy["nominal"].rms_mm > 0.3
    assert fit.accuracy["holdout"].rms_mm < 1.4e3 * NOISE * np.sqrt(3)
    out = tmp_path / "corrected.urdf"
    export(fit, "urdf", out, urdf=path, notify=str)
    one, other = poses(out), truth
    place = one @ np.linalg.inv(one[0]), other @ np.linalg.inv(other[0])
    turns = np.trace(place[0], axis1=1, axis2=2), np.trace(place[1], axis1=1, axis2=2)
    assert_allclose(turns[0], turns[1], rtol=0, atol=1e-3)


SHEET = """# convention: modified
joint;a_i-1 [mm];alpha_i-1 [deg];d_i [mm];offset [deg];theta [deg];lower_deg;upper_deg
1;0;0;660,5;0;0;-160;160
2;0;-90;0;90;-90;-110;110
3;432;0;149;0;0;-135;135
"""


def test_a_data_sheet_as_csv(tmp_path, rng):
    path = tmp_path / "puma.csv"
    path.write_text(SHEET)
    robot = mc.load_robot(path)
    same = arm(
        joint(0, 660.5, 0, 0), joint(0, 0, -90, -90, offset=90), joint(432, 149, 0, 0),
        convention="modified",
    )  # fmt: skip
    q = rng.uniform(-1, 1, (5, 3))
    assert_allclose(robot.pose(q), flange(same, q), rtol=0, atol=1e-12)
    assert np.degrees(robot.upper) == pytest.approx([160, 110, 135])
    german = (
        SHEET.replace("joint;", "Gelenk;").replace("deg]", "\u00b0]").replace("_deg", " [\u00b0]")
    )
    german = german.replace("lower", "Untergrenze").replace("upper", "Obergrenze")
    path.write_bytes(("Name;Puma 560\n" + german).encode("cp1252"))
    assert mc.load_robot(path).name == "Puma 560"
    assert_allclose(mc.load_robot(path).mdh, robot.mdh, rtol=0, atol=0)
    for content in (CRAIG, TURNED, arm(joint(1, 2, 3, 90), joint(4, 5, 6, 7))):
        out = tmp_path / "out.csv"
        written = robot_from_dict(content)
        export(written, "dh-csv", out, notify=str)
        assert_allclose(mc.load_robot(out).mdh, written.mdh, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("# convention: modified\n", "# convention: standard\n"), "says standard and modified"),
        (("d_i [mm]", "d_i [inch]"), "unknown column 'd_i \\[inch\\]'"),
        (("a_i-1 [mm]", "r"), "unknown column 'r'; did you mean"),
        (("432", "4e"), ":5: column a: '4e' is not a number"),
        (("alpha_i-1 [deg]", "alpha_i-1 [rad]"), "one unit for theta and alpha, please"),
        (("3;432;0;149;0;0;-135;135", "3;432;0"), ":5: 3 cells, but the header has 8"),
        ((SHEET, "a_mm,alpha_deg,d_mm,theta_deg\n0,90,300,0\n"), "standard or modified"),
    ],
)
def test_what_a_data_sheet_cannot_say(change, said, tmp_path):
    path = tmp_path / "sheet.csv"
    path.write_text(SHEET.replace(*change))
    with pytest.raises(mc.RobotError, match=said):
        mc.load_robot(path)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({**CRAIG, "convention": "craig"}, "'standard' .* or 'modified'"),
        (arm(joint(10, 0, 0, 0), convention="modified"), "joints\\[0\\]: a, alpha and beta of the"),
        ({**LINKED, "flange": {"a": 1}}, "flange: of modified DH alone"),
        ({**LINKED, "coupling": {"J7": {"J2": 1}}}, "coupling: no joint 'J7'; did you mean"),
        ({**LINKED, "coupling": [[1.0, 0.0]]}, "6 rows of 6 numbers"),
        ({**LINKED, "coupling": {"J3": {"J3": 0}}}, "joint 3 neither has a drive nor follows"),
        ({**LINKED, "coupling": {"J1": {"J2": 1}, "J2": {"J1": 0, "J2": 0}}}, "alike|nei"),
        ({**LINKED, "couplings": {}}, "unknown key 'couplings'; did you mean 'coupling'"),
    ],
)
def test_what_a_robot_file_cannot_say(content, said):
    with pytest.raises(mc.RobotError, match=said):
        robot_from_dict(content)


@pytest.mark.parametrize("to", sorted(EXPORTERS))
def test_formats_without_couplings_refuse_a_linked_arm(to, tmp_path):
    linked = robot_from_dict(LINKED)
    if EXPORTERS[to].couples:
        assert export(linked, to, tmp_path / "arm.x", notify=lambda said: None)
        return
    with pytest.raises(mc.OptionError, match=r"coupling.*use urdf, json"):
        export(linked, to, tmp_path / "arm.x")
    assert not (tmp_path / "arm.x").exists()
