"""Files out: read back, each gives the same poses; what cannot be held is said or refused."""

import csv
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from click.testing import CliRunner, Result
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.cli.export import export_command
from minimax_cal.compensation.exporters import ExportJob, build_exported_file
from minimax_cal.compensation.exporters.export_formats import DOCUMENTED_EXPORT_FORMATS
from minimax_cal.compensation.robot_export import build_export
from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.modelling.simulate import Simulation, simulate
from minimax_cal.robots.robot import robot_from_dict
from minimax_cal.robots.transforms import (
    axis_rotation,
    invert_transform,
    link_transform,
    transform_from_xyz_rpy,
)
from minimax_cal.robots.urdf_file import parse_urdf
from minimax_cal.robots.urdf_robot import (
    convert_urdf_to_robot,
    random_joint_values_in_limits,
    tip_poses,
)

EXACT = dict(rtol=0, atol=1e-9)
HALF = "1.5707963267948966"
UR10 = (  # origins that follow from the maker's DH table; base_link is turned by half a turn
    ("base_fixed", "fixed", "0 0 0", "0 0 3.141592653589793", ""),
    ("shoulder_pan", "revolute", "0 0 0.1273", "0 0 0", "0 0 1"),
    ("shoulder_lift", "revolute", "0 0 0", f"{HALF} 0 0", "0 0 1"),
    ("elbow", "revolute", "-0.612 0 0", "0 0 0", "0 0 1"),
    ("wrist_1", "revolute", "-0.5723 0 0.163941", "0 0 0", "0 0 1"),
    ("wrist_2", "revolute", "0 -0.1157 0", f"{HALF} 0 0", "0 0 1"),
    ("wrist_3", "revolute", "0 0.0922 0", f"{HALF} 3.141592653589793 3.141592653589793", "0 0 1"),
    ("to_flange", "fixed", "0 0 0", "0 -1.5707963267948966 -1.5707963267948966", ""),
    ("to_tool0", "fixed", "0 0 0", f"{HALF} 0 {HALF}", ""),
)


def ur10_urdf() -> str:
    """A made-up URDF of the UR10 with comments, odd spaces and a side branch."""
    lines = ['<?xml version="1.0" encoding="utf-8"?>', "<!-- ünïcode, made up -->"]
    lines += ["<robot name='ur10'>", '  <link name="base_link" />']
    lines += [f'  <link name="{name}_link"/>' for name, *_ in UR10[:7]]
    lines += ['  <link name="flange"/><link name="tool0"/><link name="camera"/>']
    links = ["base_link", *(f"{name}_link" for name, *_ in UR10[:7]), "flange", "tool0"]
    for i, (name, kind, xyz, rpy, axis) in enumerate(UR10):
        lines += [f'  <joint   name="{name}" type="{kind}" >  <!-- {name} > -->']
        if name != "to_flange":  # where the origin is left out, and an attribute
            lines += [
                f"    <origin xyz='{xyz}'" + (f' rpy="{rpy}"' if rpy != "0 0 0" else "") + "/>"
            ]
        else:
            lines += [f'    <origin\n       rpy="{rpy}"\n    ></origin>']
        lines += [f'    <parent link="{links[i]}"/>', f'    <child link="{links[i + 1]}"/>']
        lines += [f'    <axis xyz="{axis}"/>', '    <limit lower="-3" upper="3" effort="1" '
                  'velocity="1"/>'] if axis else []  # fmt: skip
        lines += ["  </joint>"]
    lines += ['  <joint name="eye" type="fixed"><parent link="elbow_link"/><child link="camera"/>']
    lines += ["  </joint>", "  <gazebo><x>1 &amp; 2</x></gazebo>", "</robot>", ""]
    return "\r\n".join(lines)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("urdf") / "ur10.urdf"
    path.write_bytes(ur10_urdf().encode())
    return path


def bent(robot: mc.Robot, size: float = 1e-3, last: bool = False) -> mc.Robot:
    """An imperfect copy: every parameter off, the last link's only where asked for."""
    change = size * np.random.default_rng(3).normal(size=robot.mdh.shape)
    change[-1] *= last
    return robot.with_mdh(robot.mdh + change)


def job_of(robot: mc.Robot, nominal: mc.Robot | None = None) -> ExportJob:
    before = nominal or robot
    compliance = np.full(robot.joints, np.nan)
    return ExportJob(robot, before, "fit.json", compliance, fitted=nominal is not None)


NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")


def offsets_of(text: str) -> np.ndarray:
    """The joints' offsets in a file of ros2-control."""
    return np.array(re.findall(r"<offset>(.*)</offset>", text), dtype=float)


def poses_of(robot: mc.Robot) -> tuple[np.ndarray, np.ndarray]:
    q = random_joint_values_in_limits(robot.lower, robot.upper, 30)
    return q, robot.pose(q)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(export_command, [str(a) for a in arguments], standalone_mode=False)


ROBOTS = ("irb120", "fanuc_r2000ic_165f", "ur10", "scara_600", "meca500")


@pytest.mark.dev
@pytest.mark.parametrize("name", ROBOTS)
def test_new_urdf(name):
    pinocchio = pytest.importorskip("pinocchio")
    robot = bent(mc.load_robot(name), last=True)
    mass, com = np.arange(robot.joints) + 1.0, np.ones((robot.joints, 3)) * [0.1, 0.2, 0.3]
    robot = replace(robot, mass=mass, com=com)
    made = build_exported_file(job_of(robot), "urdf")
    assert any("inertias are assumed" in notice for notice in made.notices)
    q, poses = poses_of(robot)
    model = convert_urdf_to_robot(parse_urdf(made.content))
    again = robot_from_dict(model.content)
    assert_allclose(tip_poses(model.chain, q), poses, **EXACT)
    assert_allclose(model.base @ again.pose(q) @ model.tool, poses, **EXACT)
    assert_allclose(again.mass, mass)
    assert_allclose([again.lower, again.upper], [robot.lower, robot.upper])
    # parallel axes stay near: no origin is farther away than the arm reaches
    assert max(np.abs(joint.origin[:3, 3]).max() for joint in model.chain) < robot.reach()
    text = made.content.decode()
    for kind in ("lower", "upper"):
        assert text.count(f'{kind}="') == np.isfinite(getattr(robot, kind)).sum()
    assert_allclose(theirs_at(text, q, "flange"), poses, **EXACT)
    # the centre of gravity of the arm, by a reader that knows of masses, and ours
    theirs = pinocchio.buildModelFromXML(text)
    data = theirs.createData()
    pinocchio.centerOfMass(theirs, data, configuration(theirs, q[1]))
    ends = [robot_prefix(robot, i + 1, q[1]) for i in range(robot.joints)]
    ours = sum(m * (e @ np.append(c, 1.0))[:3] for m, e, c in zip(mass, ends, com, strict=True))
    assert_allclose(data.com[0], ours / mass.sum(), **EXACT)


def robot_prefix(robot: mc.Robot, count: int, q: np.ndarray) -> np.ndarray:
    cut = {key: getattr(robot, key)[:count] for key in ("mdh", "sign", "prismatic")}
    return replace(robot, **cut).pose(q[:count])


def configuration(model: Any, q: np.ndarray) -> np.ndarray:
    """Pinocchio's: an endless joint is a cosine and a sine."""
    pairs = zip(list(model.joints)[1:], q, strict=True)
    return np.hstack([[np.cos(v), np.sin(v)] if joint.nq == 2 else [v] for joint, v in pairs])


def theirs_at(text: str, q: np.ndarray, frame: str) -> np.ndarray:
    pinocchio = pytest.importorskip("pinocchio")
    model = pinocchio.buildModelFromXML(text)
    data, out = model.createData(), []
    for joints in q:
        pinocchio.framesForwardKinematics(model, data, configuration(model, joints))
        out.append(data.oMf[model.getFrameId(frame)].homogeneous)
    return np.array(out)


@pytest.mark.dev
@pytest.mark.parametrize("last", [False, True])
def test_original_urdf_with_corrected_origins(original, last):
    nominal = mc.load_robot(original)
    model = convert_urdf_to_robot(parse_urdf(original.read_bytes()))
    robot = bent(nominal, last=last)
    job = replace(job_of(robot, nominal), originals=(model.urdf,))
    made = build_exported_file(job, "urdf").content
    q, poses = poses_of(robot)
    expected = model.base @ poses @ model.tool
    assert_allclose(theirs_at(made.decode(), q, "tool0"), expected, **EXACT)
    # only origins of joints on the chain differ, and not the first: the base frame is the fit's
    old, new = (raw.split(b"\r\n") for raw in (original.read_bytes(), made))
    changed = [a for a, b in zip(old, new, strict=True) if a != b]
    assert len(changed) == 5 + last
    assert all(b"<origin" in line or b"rpy=" in line for line in changed)
    nothing = replace(job_of(nominal, nominal), originals=(model.urdf,))
    assert build_exported_file(nothing, "urdf").content == original.read_bytes()


@pytest.mark.dev
def test_fit_of_the_builtin_robot_on_a_urdf_with_other_frames(original):
    nominal = mc.load_robot("ur10")
    robot = bent(nominal)
    urdf = parse_urdf(original.read_bytes(), "ur10.urdf")
    made = build_exported_file(replace(job_of(robot, nominal), originals=(urdf,)), "urdf")
    q, poses = poses_of(replace(robot, lower=np.full(6, -3.0), upper=np.full(6, 3.0)))
    expected = axis_rotation(2, np.pi) @ poses  # base_link is turned against the controller's base
    assert_allclose(theirs_at(made.content.decode(), q, "tool0"), expected, **EXACT)
    assert any("base_link to the robot's base" in notice for notice in made.notices)


@pytest.mark.dev
def test_urdf_that_is_rounded_still_gives_the_calibrated_poses(original):
    nominal = mc.load_robot("ur10")
    robot, rounded = bent(nominal), original.read_bytes().replace(HALF.encode(), b"1.5708")
    urdf = parse_urdf(rounded, "rounded.urdf")
    made = build_exported_file(replace(job_of(robot, nominal), originals=(urdf,)), "urdf")
    assert any("differ by up to" in notice for notice in made.notices)
    q, poses = poses_of(robot)
    there = theirs_at(made.content.decode(), q, "tool0")
    # up to one constant at either end
    assert_allclose(
        there @ invert_transform(there[0]) @ (base := base_between(there, poses)),
        base @ poses @ invert_transform(poses[0]),
        rtol=0,
        atol=3e-9,
    )


def base_between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    from minimax_cal.robots.transforms import fit_shared_base

    return fit_shared_base(one @ invert_transform(one[0]), other @ invert_transform(other[0]))


@pytest.mark.dev
def test_urdf_without_a_fixed_joint_after_the_last(original):
    urdf = parse_urdf(original.read_bytes(), "ur10.urdf")
    nominal = robot_from_dict(convert_urdf_to_robot(urdf, "wrist_3_link").content)
    change = np.zeros((6, 5))
    change[-1, 1:3] = 1e-3  # along the joint axis: the last link's frame moves
    job = replace(job_of(nominal.with_mdh(nominal.mdh + change), nominal), tip="wrist_3_link")
    made = build_exported_file(replace(job, originals=(urdf,)), "urdf").content
    q, poses = poses_of(job.robot)
    base = convert_urdf_to_robot(urdf, "wrist_3_link").base
    assert_allclose(theirs_at(made.decode(), q, "wrist_3_link"), base @ poses, **EXACT)
    change[-1, 0] = 1e-3  # off the axis: this URDF cannot hold it
    job = replace(job, robot=nominal.with_mdh(nominal.mdh + change), originals=(urdf,))
    with pytest.raises(OptionError, match="cannot hold this geometry"):
        build_exported_file(job, "urdf")


def test_another_robot_is_refused(original):
    urdf = parse_urdf(original.read_bytes(), "ur10.urdf")
    irb = mc.load_robot("irb120")
    with pytest.raises(OptionError, match="moves otherwise than the nominal robot"):
        build_exported_file(replace(job_of(irb), originals=(urdf,)), "urdf")
    ur10 = mc.load_robot("ur10")
    flipped = replace(ur10, sign=ur10.sign * [1, 1, 1, -1, 1, 1])
    with pytest.raises(OptionError, match=r"most at joint 4 \(wrist_1\)"):
        build_exported_file(replace(job_of(flipped), originals=(urdf,)), "urdf")
    with pytest.raises(OptionError, match="6 moving joints, the robot 4; name another last link"):
        build_exported_file(replace(job_of(mc.load_robot("scara_600")), originals=(urdf,)), "urdf")
    with pytest.raises(OptionError, match="urdf goes with the format urdf"):
        build_exported_file(replace(job_of(ur10), originals=(urdf,)), "json")


@pytest.mark.parametrize("sign", [[1, 1, 1, 1, 1, 1], [1, -1, -1, 1, -1, 1]])
def test_ur_yaml(sign):
    robot = replace(bent(mc.load_robot("ur10")), sign=np.array(sign, dtype=float))
    made = build_exported_file(job_of(robot), "ur-yaml")
    assert not any("has not the axes" in notice for notice in made.notices)
    table = yaml.safe_load(made.content)["kinematics"]
    number = table.pop("hash")
    assert (
        number
        == yaml.safe_load(build_exported_file(job_of(robot), "ur-yaml").content)["kinematics"][
            "hash"
        ]
    )
    assert number.startswith("calib_")
    assert number.removeprefix("calib_").isdigit()
    assert list(table) == ["shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3"]
    q, poses = poses_of(robot)
    for joints, pose in zip(q, poses, strict=True):
        found = np.eye(4)
        for angle, row in zip(joints, table.values(), strict=True):
            xyz, rpy = ([row[k] for k in names] for names in ("xyz", ("roll", "pitch", "yaw")))
            found = (
                found
                @ transform_from_xyz_rpy(np.array(xyz), np.array(rpy))
                @ axis_rotation(2, angle)
            )
        assert_allclose(found, pose, **EXACT)
    assert max(abs(v) for row in table.values() for k, v in row.items() if k in "xyz") < 1
    other = build_exported_file(job_of(robot.with_mdh(robot.mdh * (1 + 1e-12))), "ur-yaml").content
    assert yaml.safe_load(other)["kinematics"]["hash"] != number


@pytest.mark.parametrize("name", ROBOTS)
def test_ros_yaml(name):
    robot = bent(mc.load_robot(name), last=True)
    joints = yaml.safe_load(build_exported_file(job_of(robot), "ros-yaml").content)["joints"]
    q, poses = poses_of(robot)
    for values, pose in zip(q, poses, strict=True):
        found = np.eye(4)
        for value, row in zip((*values, 0.0), joints.values(), strict=True):
            origin = {k: np.array(v) for k, v in row["origin"].items()}
            found = found @ transform_from_xyz_rpy(**origin)
            if row["type"] == "prismatic":
                found = found @ transform_from_xyz_rpy(value * np.array(row["axis"]), np.zeros(3))
            elif row["type"] == "revolute":
                found = found @ axis_rotation(2, value * row["axis"][2])
        assert_allclose(found, pose, **EXACT)


@pytest.mark.parametrize("name", ["irb2600", "scara_600"])
def test_ros2_control_holds_the_offsets(name):
    """The drawing's arm at joint = actuator + offset stands where the calibrated one does."""
    data = simulate(name, 40, 3, seed=4).data
    fit = mc.calibrate(name, data, "sum", only="offsets")
    made = build_export(fit, "ros2-control")
    root = ElementTree.fromstring(made.file.content)
    assert root.tag == "ros2_control"
    parts = root.findall("transmission")
    assert {part.findtext("plugin") for part in parts} == {
        "transmission_interface/SimpleTransmission"
    }
    reduction, offset = (
        np.array([float(str(part.findtext(f"joint/{key}"))) for part in parts])
        for key in ("mechanical_reduction", "offset")
    )
    q = data.q[:5]
    moved = fit.nominal.robot.pose(q / reduction + offset)
    assert_allclose(moved, fit.robot.pose(q), **EXACT)
    assert np.abs(offset).max() > 1e-5
    assert len(made.notices) == 1
    more = build_export(mc.calibrate(name, data, "sum"), "ros2-control")
    again = offsets_of(more.file.content.decode())  # fitted again for offsets alone
    assert_allclose(again, offset, rtol=0, atol=1e-9)
    assert "joint offsets alone" in " ".join(more.notices)
    with pytest.raises(OptionError, match="give a fit, no robot"):
        build_export(name, "ros2-control")


@pytest.mark.parametrize("name", ROBOTS)
def test_dh_csv_and_json(name, tmp_path):
    robot = bent(mc.load_robot(name), last=True)
    made = build_exported_file(job_of(robot), "dh-csv")
    rows = list(csv.DictReader(io.StringIO(made.content.decode())))
    assert "beta is not 0" in made.notices[0]
    keys = ("a_mm", "d_mm", "theta_rad", "alpha_rad", "beta_rad")
    mdh = np.array([[float(row[key]) for key in keys] for row in rows]) * [1e-3, 1e-3, 1, 1, 1]
    again = replace(robot.with_mdh(mdh), sign=np.array([float(row["sign"]) for row in rows]))
    q, poses = poses_of(robot)
    assert_allclose(again.pose(q), poses, **EXACT)
    assert [row["type"] == "prismatic" for row in rows] == list(robot.prismatic)
    (tmp_path / "r.json").write_bytes(build_exported_file(job_of(robot), "json").content)
    assert_allclose(mc.load_robot(tmp_path / "r.json").pose(q), poses, **EXACT)


def moc_values(text: str) -> dict[str, dict[str, dict[str, float]]]:
    """Numbers of a MOC.cfg by section, name and key; an entry goes on after a backslash."""
    header, *lines = text.replace("\\\n", " ").splitlines()
    assert header == "MOC:CFG_1.0:6:0::"
    out: dict[str, dict[str, dict[str, float]]] = {}
    for line in filter(None, map(str.strip, lines)):
        if line.endswith(":") and " " not in line:
            rows = out[line[:-1]] = {}
        elif not line.startswith("#"):
            name, rest = re.fullmatch(r'-name "(\w+)"(.*)', line).groups()
            rows[name] = {key: float(value) for key, value in re.findall(r"-(\w+) (\S+)", rest)}
    return out


def test_moc_holds_the_corrections_of_a_fit():
    nominal = mc.load_robot("irb120")
    robot = bent(nominal, last=True)
    job = replace(job_of(robot, nominal), experimental=True)
    job = replace(job, compliance=np.array([np.nan, 1e-6, 2e-6, np.nan, np.nan, np.nan]))
    made = build_exported_file(job, "moc")
    assert made.notices[0].startswith("EXPERIMENTAL")
    text = made.content.decode()
    assert "EXPERIMENTAL" in text
    assert max(len(line) for line in text.splitlines() if line.startswith(" ")) <= 80
    found = moc_values(text)
    assert found["JOINT_CALIB"]["rob1_3"] == {"Compl": 2e-6}
    for i, row in enumerate(found["ARM_CALIB"].values()):
        xyz = [row.get(f"error_offset_{axis}", 0.0) for axis in "xyz"]
        rpy = [row.get(f"error_{name}", 0.0) for name in ("roll", "pitch", "jaw")]
        pose = link_transform(nominal.mdh[i]) @ transform_from_xyz_rpy(np.array(xyz), np.array(rpy))
        assert_allclose(pose, link_transform(robot.mdh[i]), **EXACT)
    with pytest.raises(OptionError, match="agree \\(experimental\\)"):
        build_exported_file(replace(job, experimental=False), "moc")
    with pytest.raises(OptionError, match="holds no nominal robot"):
        build_exported_file(replace(job, fitted=False), "moc")


@pytest.fixture(scope="module")
def fit(tmp_path_factory: pytest.TempPathFactory, original: Path) -> tuple[Path, Simulation]:
    """The UR10 of a URDF, calibrated with an effect beyond geometry."""
    made = simulate(mc.load_robot(original), 60, 3, seed=2)
    path = tmp_path_factory.mktemp("fit") / "fit.json"
    mc.calibrate(
        mc.load_robot(original), made.data, objective="sum", effects=["joint_coupling:J3"]
    ).save(path)
    return path, made


@pytest.mark.dev
def test_a_calibrated_ur10_by_command_in_an_independent_reader(fit, original, tmp_path):
    path, _ = fit
    result = run(path, "--to", "urdf", "--urdf", original, "-o", tmp_path / "out.urdf")
    assert result.exception is None, result.output
    assert result.stdout == ""
    assert "fitted without joint coupling; the full model: held-out RMS" in result.stderr
    robot, model = mc.load_robot(path), convert_urdf_to_robot(parse_urdf(original.read_bytes()))
    q, poses = poses_of(robot)
    text = (tmp_path / "out.urdf").read_text()
    assert_allclose(theirs_at(text, q, "tool0"), model.base @ poses @ model.tool, **EXACT)
    assert_allclose(mc.load_robot(tmp_path / "out.urdf").pose(q).shape, poses.shape)


@pytest.mark.parametrize("to", DOCUMENTED_EXPORT_FORMATS)
def test_every_format_by_command(to, fit):
    result = run(fit[0], "--to", to)
    assert result.exception is None
    assert "held-out RMS" in result.stderr
    other = build_export(fit[0], to).file.content.decode()
    if to == "ros2-control":  # fitted each time, to rounding
        assert_allclose(offsets_of(other), offsets_of(result.stdout), rtol=0, atol=1e-12)
    elif to == "mjcf":  # so are its springs
        texts = (other, result.stdout)
        assert len({NUMBER.sub("#", text) for text in texts}) == 1
        ours, theirs = ([float(x) for x in NUMBER.findall(text)] for text in texts)
        assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)
    else:
        assert other == result.stdout


def test_command_on_a_robot_and_its_errors(original, tmp_path):
    assert json.loads(run("irb120", "--to", "json").stdout)["name"] == "ABB IRB 120"
    result = run(original, "--to", "dh-csv")
    assert result.exception is None
    assert "not the robot's base" not in result.stderr  # a turn about axis 1
    assert run(f"{original}#wrist_1_link", "--to", "dh-csv").stdout.count("revolute") == 4
    tips = (f"{original}#wrist_1_link",), (original, "--tip", "wrist_1_link")
    both = [run(f"{original}#wrist_1_link", "--to", "urdf", "--urdf", *tip).stdout for tip in tips]
    assert both[0] == both[1] != ""
    for arguments, words in (
        (("irb120", "--to", "step"), "no such format; choose one of urdf, ur-yaml"),
        (("irb120", "--to", "moc"), "agree (experimental)"),
        (("irb120", "--to", "moc", "--experimental"), "holds no nominal robot"),
        (("irb120", "--to", "json", "--urdf", original), "urdf goes with the format urdf"),
        (("irb120", "--to", "urdf", "--tip", "x"), "tip names a link of the file"),
        (("irb120", "--to", "urdf", "-o", tmp_path / "no" / "x"), "no such folder"),
        (("irb12", "--to", "urdf"), "did you mean 'irb120'"),
        (("irb120", "--to", "urdf", "--urdf", tmp_path / "x"), "cannot be read"),
    ):
        result = run(*arguments)
        assert isinstance(result.exception, CalibrationError)
        assert words in str(result.exception)
    (tmp_path / "broken.json").write_text("{")
    assert "cannot be parsed" in str(run(tmp_path / "broken.json", "--to", "json").exception)


def test_an_arm_without_its_nominal_robot(fit, tmp_path):
    content = mc.load_fit(fit[0]).cell.whole()
    (tmp_path / "cell.json").write_text(json.dumps(content))
    found = build_export(tmp_path / "cell.json", "json")
    assert json.loads(found.file.content) == content["robot"]
    assert found.delivered
    assert found.delivered.nominal is None
    assert "joint coupling" in found.notices[-1]
    assert "holds no measurements" in found.notices[-1]


def test_ur_yaml_refuses_what_it_cannot_hold_and_tells_another_make():
    with pytest.raises(OptionError, match="has no place for a, alpha, beta"):
        build_exported_file(job_of(bent(mc.load_robot("ur10"), last=True)), "ur-yaml")
    with pytest.raises(OptionError, match="six turning joints"):
        build_exported_file(job_of(mc.load_robot("scara_600")), "ur-yaml")
    abb = mc.load_robot("irb2600")
    assert (
        "has not the axes of a Universal Robots arm"
        in build_exported_file(job_of(abb), "ur-yaml").notices[0]
    )
