"""MJCF and URDF that simulators load: the same arm, at rest where the fit says."""

import io
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.compensation.exporters.export_job import (
    build_export_job,
    joint_compliances,
    joint_origins,
)
from minimax_cal.compensation.robot_export import build_export, write_exported_files
from minimax_cal.modelling.cell import Cell, build_measurements_at_rest
from minimax_cal.modelling.effects.table import Fitted, parse_effect_terms
from minimax_cal.robots.gravity_torques import assumed_link_masses_and_centres
from minimax_cal.robots.robot import robot_from_dict
from minimax_cal.simulators.arm import build_simulated_arm
from minimax_cal.simulators.elements import find_axes_orthogonal_to_their_images
from minimax_cal.simulators.mjcf import build_mjcf_file
from tests.conftest import run

mujoco = pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")

EXACT = dict(rtol=0, atol=1e-9)  # [m]
FIRST_ORDER = 5e-6  # what the laws of a fit leave out, sag of sag, and of stiff servos [m]
IMITATED = 20e-6  # one set of masses in the place of those that each joint had for itself [m]
SPOTS = np.array([[0.1, 0.0, 0.03], [-0.05, 0.08, 0.03], [-0.05, -0.08, 0.03]])


def seven_axes() -> mc.Robot:
    """An arm of seven axes, one of its joints counted backwards, its foot on a slanted wall."""
    lengths, turn = (360.0, 0.0, 420.0, 0.0, 400.0, 0.0, 126.0), np.pi / 2.0
    tilts = (-turn, turn, turn, -turn, -turn, turn, 0.0)
    joints = [
        {"a": 0.0, "d": d, "theta": 0.0, "alpha": alpha, "sign": -1 if i == 2 else 1}
        for i, (d, alpha) in enumerate(zip(lengths, tilts, strict=True))
    ]
    units = {"length": "mm", "angle": "rad"}
    content = {"name": "seven", "units": units, "joints": joints, "up": [0.6, 0.0, 0.8]}
    return robot_from_dict(content)


def robot_called(name: str) -> mc.Robot:
    """Off its drawing in every parameter, beta included."""
    robot = seven_axes() if name == "seven_axes" else mc.load_robot(name)
    return robot.with_mdh(robot.mdh + 1e-3 * np.random.default_rng(0).normal(size=robot.mdh.shape))


def with_masses(robot: mc.Robot) -> mc.Robot:
    mass, com = assumed_link_masses_and_centres(robot.mdh)
    return replace(robot, mass=np.maximum(0.4 * mass, 0.5), com=com)


def poses(robot: mc.Robot, count: int = 8) -> np.ndarray:
    """Within limits."""
    lower, upper = np.maximum(robot.lower, -1.5), np.minimum(robot.upper, 1.5)
    lower = np.where(robot.prismatic, np.maximum(robot.lower, 0.0), lower)
    upper = np.where(robot.prismatic, np.minimum(robot.upper, 0.2), upper)
    return np.random.default_rng(2).uniform(lower, upper, (count, robot.joints))


def cell_with(robot: mc.Robot, *texts: str, size: float = 2e-6, **values: list[float]) -> Cell:
    base = np.eye(4)
    base[:3, 3] = 1.0, 2.0, 0.5
    cell = Cell(robot, base, ("smr1", "smr2", "smr3"), SPOTS)
    scene = cell.pose_arm(build_measurements_at_rest(poses(robot), cell.target_names, robot))
    chosen = parse_effect_terms(scene, texts)
    found = [
        np.array(values[t.effect]) if t.effect in values
        else size * np.linspace(0.8, 1.2, len(t.columns(scene).names))
        for t in chosen
    ]  # fmt: skip
    return replace(cell, effects=Fitted(chosen, tuple(found)))


def model_of(cell: Cell) -> Any:
    text = build_mjcf_file(build_export_job("cell", cell)).content.decode()
    return mujoco.MjModel.from_xml_string(text)


def rested(model: Any, q: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Sites at rest: (m, k, 3) [m]."""
    data, out = mujoco.MjData(model), []
    for row in q:
        mujoco.mj_resetData(model, data)
        for i, value in enumerate(row):
            data.joint(f"joint{i + 1}").qpos[0] = data.actuator(f"joint{i + 1}").ctrl[0] = value
        while data.time < 8.0:
            mujoco.mj_step(model, data, 100)
            if np.abs(data.qvel).max() < 1e-7:
                break
        assert np.abs(data.qvel).max() < 1e-6  # within 8 s, whatever the effects
        out.append([data.site(name).xpos.copy() for name in names])
    return np.array(out)


def in_base(cell: Cell, q: np.ndarray) -> np.ndarray:
    return np.asarray((cell.predict(q) - cell.base[:3, 3]) @ cell.base[:3, :3])


ROBOTS = (*mc.builtin_robots(), "seven_axes")


@pytest.mark.parametrize("name", ROBOTS)
def test_an_arm_without_effects_moves_and_rests_as_its_robot(name):
    robot = robot_called(name)
    model, q = model_of(cell_with(robot)), poses(robot, 4)
    assert [model.joint(f"joint{i + 1}").id for i in range(robot.joints)] == [*range(robot.joints)]
    assert model.nu == model.nq == robot.joints
    assert_allclose(-model.opt.gravity / np.linalg.norm(model.opt.gravity), robot.up, atol=1e-12)
    assert (model.body_mass[1:] > 0.0).all()
    assert (model.body_inertia[1:] > 0.0).all()
    kinds = np.where(robot.prismatic, mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
    assert (model.jnt_type == kinds).all()
    data = mujoco.MjData(model)
    for row in q:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        pose = robot.pose(row)
        assert_allclose(data.site("flange").xpos, pose[:3, 3], **EXACT)
        assert_allclose(data.site("flange").xmat.reshape(3, 3), pose[:3, :3], **EXACT)
    assert_allclose(rested(model, q, ("flange",))[:, 0], robot.pose(q)[:, :3, 3], atol=2e-6)


ONE = {
    "joint_compliance:all": None,
    "base_flex:frame": [2e-7],
    "link_bending:L2": [1e-6],
    "encoder_gain:J2": [1e-3],
    "joint_coupling:J5:source=4": [5e-3],
    "backlash:all": None,
    "tool_flex:all:lever=0": [1e-3, 2e-5],
    "tool_flex:all:lever=1": [-1e-3, -2e-5],
    "tool_flex:all:lever=2": [1e-4, 2e-4, 3e-4, -1e-4, 2e-4, 1e-4, 4e-4, -2e-4, -3e-4, 1e-5],
    "gravity_compensator:J2:zero=0.1:eye=0.4:rest=0.5": [-1e-3],
}


@pytest.mark.parametrize("text", ONE)
def test_each_element_does_what_its_law_says(text):
    robot = with_masses(robot_called("irb2600"))
    robot = replace(robot, sign=np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0]))
    name = text.split(":")[0]
    if name == "backlash":
        cell = cell_with(robot)
        data = replace(build_measurements_at_rest(poses(robot), cell.target_names, robot))
        data = replace(data, columns={**data.columns, "approach2": np.resize([1.0, -1.0], 8),
                                      "approach5": np.resize([1.0, -1.0], 8)})  # fmt: skip
        term = parse_effect_terms(cell.pose_arm(data), [text])
        cell = replace(cell, effects=Fitted(term, (np.array([1e-4, -2e-4]),)))
        model = model_of(cell)
        for joint, width in ((2, 1e-4), (5, -2e-4)):
            play = model.joint(f"play{joint}")
            assert_allclose(play.range, 1.01 * np.array([-0.5, 0.5]) * abs(width))
            model.qpos_spring[play.qposadr[0]] = 0.5 * width  # they came from below
        up = replace(data, columns={**data.columns, "approach2": np.ones(8),
                                    "approach5": np.ones(8)})  # fmt: skip
        expected = (cell.follow(up) - cell.base[:3, 3]) @ cell.base[:3, :3]
        assert (
            np.abs(expected - in_base(replace(cell, effects=Fitted((), ())), data.q)).max() > 2e-5
        )
    else:
        given = ONE[text]
        cell = cell_with(robot, text, **({name: given} if given else {}))
        model, expected = model_of(cell), in_base(cell, poses(robot))
        assert model.nu == robot.joints
    off = rested(model, poses(robot), cell.target_names) - expected
    assert np.linalg.norm(off, axis=-1).max() < FIRST_ORDER


@pytest.mark.parametrize("name", ["ur10", "irb2600", "seven_axes"])
def test_all_effects_at_once_on_arms_of_unknown_masses(name):
    robot = robot_called(name)
    cell = cell_with(
        robot, "joint_compliance:all", "base_flex:frame", "encoder_gain:all", size=1.5e-6,
        base_flex=[2e-7], encoder_gain=(2e-4 * np.ones(robot.joints)).tolist(),
    )  # fmt: skip
    arm = build_simulated_arm(cell)
    assert arm.remaining_rms < IMITATED
    off = rested(model_of(cell), poses(robot), cell.target_names) - in_base(cell, poses(robot))
    assert np.sqrt((off**2).sum(axis=-1).mean()) < IMITATED


def test_a_gain_that_carries_a_deflection_says_so():
    """The compliance that is said is the law's: that of the gain under its share of gravity."""
    cell = cell_with(with_masses(robot_called("irb2600")), "joint_compliance:all")
    text, ((_, compliance),) = (
        build_mjcf_file(build_export_job("cell", cell)).content.decode(),
        cell.effects.terms_with_values,
    )
    model = mujoco.MjModel.from_xml_string(text)
    texts = {element.get("name"): element.get("data", "")
             for element in ElementTree.fromstring(text).iter("text")}  # fmt: skip
    share = 1.0 - model.body_gravcomp[model.body("link2").id]
    for j, value in enumerate(compliance, start=2):
        assert f"{value:.6g}" in texts[f"joint{j}_deflection"]
        assert share / model.actuator(f"joint{j}").gainprm[0] == pytest.approx(value, rel=1e-9)


def test_turns_without_an_element_go_into_the_commands(tmp_path):
    robot = with_masses(robot_called("irb2600"))
    cell = cell_with(robot, "gear_error:J3:turns=2", "joint_compliance:J2",
                     gear_error=[3e-4, -2e-4], joint_compliance=[3e-6])  # fmt: skip
    notices: list[str] = []
    mc.export(cell, "mjcf", tmp_path / "arm.xml", notify=notices.append)
    assert any("load_commands" in text for text in notices)
    commands, q = mc.load_commands(tmp_path / "arm.commands.json"), poses(robot)
    assert [term.label for term in commands.cell.effects.terms] == ["gear_error:J3"]
    assert commands(q[0]).shape == q[0].shape
    model, data = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml")), None
    data = mujoco.MjData(model)
    for row, point in zip(q, in_base(cell, q), strict=True):
        mujoco.mj_resetData(model, data)
        for i, (value, asked) in enumerate(zip(row, commands(row), strict=True)):
            data.joint(f"joint{i + 1}").qpos[0], data.actuator(f"joint{i + 1}").ctrl[0] = (
                value,
                asked,
            )
        mujoco.mj_step(model, data, 1000)
        assert_allclose(data.site("smr1").xpos, point[0], rtol=0, atol=FIRST_ORDER)
    other = tmp_path / "cell.json"
    other.write_text('{"kind": "calibration"}')
    with pytest.raises(mc.CalibrationError, match="is no command map"):
        mc.load_commands(other)
    made = build_export(cell, "mjcf")
    with pytest.raises(mc.OptionError, match="beside it"):
        write_exported_files(made.file, None)


def test_a_joint_that_stiffens_goes_into_the_commands_and_not_into_springs():
    robot = with_masses(robot_called("irb2600"))
    cell = cell_with(robot, "joint_compliance:J2:within=20", joint_compliance=[3e-6])
    arm = build_simulated_arm(cell)
    assert [term.label for term in arm.mapped_effects.terms] == ["joint_compliance:J2"]
    assert not arm.joint_compliances.any()
    assert np.isnan(joint_compliances(cell)[1])  # one number does not tell it
    plain = cell_with(robot, "joint_compliance:J2", joint_compliance=[3e-6])
    assert joint_compliances(plain)[1] == 3e-6


def test_links_that_bend_under_a_tool_nobody_told_have_one_spring():
    robot = robot_called("irb2600")
    cell = cell_with(robot, "link_bending:L2:tool=1", link_bending=[1e-6, 2e-6])
    arm = build_simulated_arm(cell)
    assert list(arm.link_flexibility) == [1]
    assert arm.remaining_rms < IMITATED


def test_what_changes_with_time_is_named():
    robot = with_masses(mc.load_robot("irb120"))
    cell = cell_with(robot)
    data = build_measurements_at_rest(poses(robot), cell.target_names, robot)
    data = replace(data, columns={**data.columns, "clock": np.linspace(0.0, 1.0, data.poses)})
    drift = parse_effect_terms(cell.pose_arm(data), ["frame_drift:frame:constant=0.5"])
    cell = replace(cell, effects=Fitted(drift, (np.full(6, 1e-4),)))
    made = build_mjcf_file(build_export_job("cell", cell))
    assert any("frame drift" in text and "time" in text for text in made.notices)
    assert not made.beside


def test_a_basis_across_itself_is_found():
    matrix = np.random.default_rng(3).normal(size=(3, 3))
    matrix -= np.trace(matrix) / 3.0 * np.eye(3)
    basis = find_axes_orthogonal_to_their_images(matrix)
    assert_allclose(basis @ basis.T, np.eye(3), atol=1e-12)
    assert_allclose(np.diag(basis @ matrix @ basis.T), 0.0, atol=1e-12)


@pytest.mark.dev
@pytest.mark.parametrize("name", ROBOTS)
def test_simulators_load_every_urdf(name):
    robot = robot_called(name)
    text = mc.export(robot, "urdf", notify=lambda notice: None)
    model, q = mujoco.MjModel.from_xml_string(text), poses(robot, 4)
    assert model.nq == robot.joints
    assert (model.body_inertia[1:] > 0.0).all()
    data = mujoco.MjData(model)
    flange = np.linalg.inv(fixed_tip(robot))
    for row in q:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        body = data.body(f"link_{robot.joints}")
        assert_allclose(body.xpos, (robot.pose(row) @ flange)[:3, 3], **EXACT)
    yourdfpy = pytest.importorskip("yourdfpy")
    theirs = yourdfpy.URDF.load(io.StringIO(text), load_meshes=False)
    for row in q:
        theirs.update_cfg(row)
        assert_allclose(theirs.get_transform("flange"), robot.pose(row), **EXACT)
    pinocchio = pytest.importorskip("pinocchio")
    arm = pinocchio.buildModelFromXML(text)
    assert arm.nv == robot.joints
    held, tip = arm.createData(), arm.getFrameId("flange")
    for row in q:  # a joint without limits is a unit circle there
        place = pinocchio.integrate(arm, pinocchio.neutral(arm), row)
        pinocchio.framesForwardKinematics(arm, held, place)
        assert_allclose(held.oMf[tip].homogeneous, robot.pose(row), **EXACT)


def fixed_tip(robot: mc.Robot) -> np.ndarray:
    """From the last moving link to the flange, as the file has it."""
    return np.asarray(joint_origins(robot)[-1])


def test_assumed_masses_do_not_come_back_as_known(tmp_path):
    path = tmp_path / "arm.urdf"
    mc.export("irb120", "urdf", path, notify=lambda notice: None)
    assert np.isnan(mc.load_robot(path).mass).all()


def test_the_command_exports_mjcf(tmp_path, capsys):
    assert run("export", "ur10", "--to", "mjcf", "-o", tmp_path / "arm.xml") == 0
    assert "assumed" in capsys.readouterr().err
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml")).nu == 6
    assert run("export", "ur10", "--to", "urdf", "--mjcf", tmp_path / "arm.xml") == 2
    assert run("export", "ur10", "--to", "mjcf", "--mjcf", tmp_path / "arm.xml") == 2
