"""Every file that export and gap write holds still and moves, in a loop that shares no code."""

import difflib
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.compensation.exporters.export_job import build_export_job
from minimax_cal.compensation.robot_export import build_export, write_exported_files
from minimax_cal.modelling.cell import build_measurements_at_rest
from minimax_cal.simulators.mjcf import build_mjcf_file
from minimax_cal.simulators.result import SimulatorGap
from tests.conftest import run
from tests.problems_mjcf import drive_alone, published_like, ur10_like
from tests.simulators.test_mjcf import cell_with, in_base, poses, robot_called, with_masses

mujoco = pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")

from experiments import simulator_gap as study  # noqa: E402
from minimax_cal.robots.mjcf_import import read_mujoco_model  # noqa: E402
from minimax_cal.robots.xml_document import XmlWriteOptions, read_xml_with_includes  # noqa: E402
from minimax_cal.simulators.chain import find_model_arm  # noqa: E402
from minimax_cal.simulators.drive import drive_to_poses  # noqa: E402

HOLDS, HOLDS_MM = 0.1, 0.02  # of what an effect does, or [mm]
STILL = 2e-3  # [rad/s]
SELDOM = 0.01  # of the timesteps at a force limit
LIGHT = "0 0 3"  # where a scene has one [m]
LARGEST_GAIN = 5e5  # that a file of ours may have, for the heaviest arm here [N m/rad]


def check_held(
    path: Path | str, cell: mc.Cell, q: np.ndarray, asked: np.ndarray | None = None
) -> None:
    """The contract's drive test: sites where the cell says, at rest, seldom at a limit."""
    reached = drive_alone(path, q if asked is None else asked, cell.target_names)
    wanted = in_base(cell, q)[1:]
    off = 1e3 * np.linalg.norm(reached.sites - wanted, axis=-1)
    plain = mc.Cell(cell.robot, cell.base, cell.target_names, cell.target_positions)
    done = 1e3 * np.linalg.norm(in_base(plain, q)[1:] - wanted, axis=-1)
    assert (off <= np.maximum(HOLDS * done, HOLDS_MM)).all(), off.max()
    assert reached.speed < STILL
    assert reached.limited < SELDOM


@pytest.mark.parametrize("name", ["ur10", "irb2600", "seven_axes", "scara_600"])
def test_a_new_file_holds_still_and_moves(name):
    robot = with_masses(robot_called(name))
    cell = cell_with(robot, "joint_compliance:all", "encoder_gain:all", "base_flex:frame",
                     size=3e-6, base_flex=[2e-7],
                     encoder_gain=[2e-4] * int((~robot.prismatic).sum()))  # fmt: skip
    text = build_mjcf_file(build_export_job("cell", cell)).content.decode()
    check_held(text, cell, poses(robot, 4))
    model = mujoco.MjModel.from_xml_string(text)
    assert model.actuator_gainprm[:, 0].max() < LARGEST_GAIN
    # joints that are compliant all alike need no springs of their own
    assert not any(model.joint(j).name.startswith("flex") for j in range(model.njnt))


def test_one_compliant_joint_among_stiff_ones_has_a_spring():
    robot = with_masses(robot_called("irb2600"))
    cell = cell_with(robot, "joint_compliance:J2", "link_bending:L1", size=3e-6,
                     link_bending=[1e-6])  # fmt: skip
    text = build_mjcf_file(build_export_job("cell", cell)).content.decode()
    check_held(text, cell, poses(robot, 4))
    model = mujoco.MjModel.from_xml_string(text)
    assert model.jnt_stiffness[model.joint("flex2").id] == pytest.approx(1.0 / 3e-6, rel=0.3)
    assert model.actuator_gainprm[:, 0].max() < LARGEST_GAIN


def in_default_scene(text: str) -> Any:
    """The model attached to a scene that sets nothing: MuJoCo's integrator, 2 ms, its gravity."""
    scene = mujoco.MjSpec()
    child = mujoco.MjSpec.from_string(text)
    scene.attach(child, prefix="arm/", frame=scene.worldbody.add_frame())
    return scene.compile()


@pytest.mark.filterwarnings("ignore:Attach conflict")
@pytest.mark.parametrize("name", ["ur10", "irb2600", "meca500", "scara_600", "seven_axes"])
def test_a_new_file_stands_and_moves_in_a_default_scene(name):
    robot = robot_called(name)
    effects = [] if name == "ur10" else ["joint_compliance:J2", "encoder_gain:J1"]
    cell = cell_with(robot, *effects, size=1e-7)
    text = build_mjcf_file(build_export_job("cell", cell)).content.decode()
    model, q = in_default_scene(text), poses(robot, 3)
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert model.opt.timestep == 0.002
    if name == "seven_axes":  # its vertical is not the scene's
        model.opt.gravity = mujoco.MjModel.from_xml_string(text).opt.gravity
    alone = drive_alone(text, q, cell.target_names)
    attached = drive_alone(model, q, tuple(f"arm/{name}" for name in cell.target_names))
    assert attached.speed < STILL
    np.testing.assert_allclose(attached.sites, alone.sites, rtol=0, atol=1e-6)


def test_a_file_corrected_again_stays_braked_in_its_joints(tmp_path):
    robot = with_masses(robot_called("ur10"))
    cell = cell_with(robot, "joint_compliance:all", size=3e-6)
    path = tmp_path / "arm.xml"
    path.write_bytes(build_mjcf_file(build_export_job("cell", cell_with(robot))).content)
    job = replace(build_export_job("cell", cell), nominal=robot, fitted=True, model=path,
                  path=tmp_path / "out.xml")  # fmt: skip
    text = build_mjcf_file(job).content.decode()
    model = mujoco.MjModel.from_xml_string(text)
    assert (model.actuator_biasprm[:, 2] == 0.0).all()
    check_held(text, cell, poses(robot, 3))


def test_what_is_delivered_is_what_the_file_reaches():
    """One set of masses and springs stands for the torques that a fit takes apart, as it can."""
    name, effects = (
        "fanuc_r2000ic_165f",
        ("joint_compliance:all", "link_bending:L1", "link_bending:L2"),
    )
    real, rng = with_masses(robot_called(name)), np.random.default_rng(0)
    truth = cell_with(real, *effects, size=2e-6, link_bending=[1e-6])
    q = rng.uniform(np.maximum(real.lower, -2.0), np.minimum(real.upper, 2.0), (24, 6))
    y = truth.predict(q) + 1e-5 * rng.normal(size=(24, 3, 3))
    data = replace(build_measurements_at_rest(q, truth.target_names, real), y=y, source="twin.csv")
    fit = mc.calibrate(name, data, "sum", effects=effects)
    made = build_export(fit, "mjcf")
    held = data.take(fit.held)
    reached = drive_alone(
        made.file.content.decode(), held.q[[0, *range(len(held.q))]], held.target_names
    )
    points = reached.sites @ fit.cell.base[:3, :3].T + fit.cell.base[:3, 3]

    def squares(error: np.ndarray) -> float:
        return 1e6 * float((error**2).sum(axis=-1).mean())

    own, formulas = squares(held.y - points), squares(fit.cell.error(held))
    assert abs(own - formulas) > 0.01 * formulas
    whole = fit.within.after.rms_mm
    assert made.delivered is not None
    assert made.delivered.figures.rms**2 == pytest.approx(whole**2 + own - formulas, rel=1e-3)
    assert mc.deliver(fit, "mjcf").figures == made.delivered.figures


def measured(folder: Path, model: Path) -> mc.Fit:
    """A fit of a compliant arm that has the masses of a model."""
    weighs = find_model_arm(read_mujoco_model(model).compile_model(), 6, str(model)).robot
    truth = mc.Truth(compliance=8e-6)
    data = mc.simulate(weighs, 40, 3, seed=3, truth=truth).data
    mc.write_measurements(folder / "poses.csv", data)
    fit = mc.calibrate(weighs, folder / "poses.csv", "sum", effects="joint_compliance:all")
    fit.save(folder / "fit.json")
    return fit


@pytest.fixture(scope="module", params=[
    pytest.param((5000.0,) * 6, marks=pytest.mark.slow),
    (5000.0,) * 3 + (500.0,) * 3,
    pytest.param((500.0,) * 6, marks=pytest.mark.slow),
])  # fmt: skip
def case(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, mc.Fit, SimulatorGap]:
    """A UR10 as published, corrected: its folder, the fit, the gap."""
    folder = tmp_path_factory.mktemp("ur10")
    model = ur10_like(folder, request.param)
    fit = measured(folder, model)
    gap = mc.simulator_gap(model, folder / "poses.csv", fit=folder / "fit.json",
                           write=folder / "corrected.xml")  # fmt: skip
    return folder, fit, gap


def test_a_corrected_file_under_its_force_limits_does_what_the_gap_says(case):
    folder, fit, gap = case
    assert all(rung.at_limit < SELDOM and not rung.moving_poses for rung in gap.rungs[1:])
    for rung in gap.rungs[2:]:
        allowed = max(HOLDS * rung.predicted_rms_mm, HOLDS_MM)
        assert abs(rung.holdout_rms_mm - rung.predicted_rms_mm) < allowed
    assert gap.holds
    check_held(folder / "corrected.xml", fit.cell, fit.data.q[fit.held][:4])
    model = mujoco.MjModel.from_xml_path(str(folder / "corrected.xml"))
    given = mujoco.MjModel.from_xml_path(str(folder / "ur10.xml"))
    assert (model.actuator_forcerange == given.actuator_forcerange).all()
    assert (model.jnt_actfrcrange == given.actuator_forcerange).all()
    assert model.actuator_gainprm[:, 0].max() < 20 * 5000.0


def test_gravity_still_counts_against_the_force_limits(case):
    folder, fit, _ = case
    model = mujoco.MjModel.from_xml_path(str(folder / "corrected.xml"))
    data = mujoco.MjData(model)
    data.qpos[:] = data.ctrl[:] = fit.data.q[0]
    mujoco.mj_step(model, data, 2000)
    dofs = [int(model.joint(f"joint{i + 1}").dofadr[0]) for i in range(6)]
    np.testing.assert_allclose(data.qfrc_actuator[dofs], data.qfrc_bias[dofs], rtol=0, atol=0.01)


def test_the_text_stays_but_for_what_changed(case):
    folder, fit, _ = case
    before = (folder / "ur10.xml").read_text().splitlines()
    after = (folder / "corrected.xml").read_text().splitlines()
    lines = [line for line in difflib.unified_diff(before, after, lineterm="", n=0)
             if line[0] in "+-" and line[:3] not in ("+++", "---")]  # fmt: skip
    gone = [line for line in lines if line[0] == "-"]
    new = [line for line in lines if line[0] == "+"]
    assert all(re.match(r"-\s*<(body|joint|position) ", line) for line in gone), gone
    sites = [line for line in new if "<site" in line]
    assert len(sites) == 1 + len(fit.data.target_names)
    said = [line for line in new if re.match(r"\+\s*</?(custom|text)", line)]  # of servos
    assert len(gone) == len(new) - len(sites) - len(said) <= 18  # a body, a joint, a servo each
    assert "forcerange" not in "".join(line for line in gone if "position" in line)
    for joint in range(1, 7):
        assert any(f"<!-- joint {joint} -->" in line for line in after)


def test_a_file_is_written_byte_for_byte(tmp_path):
    path = published_like(tmp_path, mc.load_robot("ur10"))
    odd = (
        b"<?xml version='1.0'?>\r\n<!-- > -->\r\n<mujoco   model = 'a &gt; b' >\t<option\r\n"
        b"  timestep='0.002'/><include file='empty.xml'/>\r\n<worldbody ></worldbody >\r\n"
        b"<!-- <body> --><include file='arm.xml'/> text\r\n</mujoco>\r\n\r\n"
    )
    (tmp_path / "odd.xml").write_bytes(odd)
    (tmp_path / "empty.xml").write_bytes(b"<mujoco><!-- nothing --></mujoco>")
    assert read_xml_with_includes(path).to_bytes() == path.read_bytes()
    document = read_xml_with_includes(tmp_path / "odd.xml")
    assert document.to_bytes() == odd
    option = document.root.find("option")
    assert option is not None
    option.set("timestep", "0.001")
    assert document.to_bytes() == odd.replace(b"'0.002'", b"'0.001'")
    del option.attrib["timestep"]
    option.set("integrator", "Euler")
    changed = odd.replace(b"<option\r\n  timestep='0.002'/>", b'<option integrator="Euler"/>')
    assert document.to_bytes() == changed


def test_an_include_is_written_out_only_where_it_changed(tmp_path):
    (tmp_path / "arm.xml").write_text(
        "<mujoco>\n  <include file='a.xml'/>\n  <include file='b.xml'/>\n</mujoco>\n"
    )
    (tmp_path / "a.xml").write_text(
        "<mujocoinclude>\n  <option gravity='0 0 0'/>\n</mujocoinclude>"
    )
    (tmp_path / "b.xml").write_text("<mujocoinclude>\n  <size nkey='1'/>\n</mujocoinclude>")
    document = read_xml_with_includes(tmp_path / "arm.xml")
    document.root[0].set("gravity", "0 0 -9")
    changed = "<option gravity='0 0 -9'/>"
    whole = f"<mujoco>\n  {changed}\n  <include file='b.xml'/>\n</mujoco>\n"
    assert document.to_bytes().decode() == whole
    how = XmlWriteOptions(name="new")
    assert document.to_bytes(how).decode() == whole.replace(changed, "<include file='new.a.xml'/>")
    assert how.beside == {".a.xml": f"<mujocoinclude>\n  {changed}\n</mujocoinclude>".encode()}


@pytest.mark.parametrize("folder", [".", "elsewhere"])
def test_a_scene_stays_and_the_arm_that_it_includes_is_beside_it(folder, tmp_path):
    """`export --mjcf` of a scene: MuJoCo makes the same model of it as of one file."""
    model = ur10_like(tmp_path)
    scene = tmp_path / "scene.xml"
    scene.write_text(
        f"<mujoco>\n  <include file='{model.name}'/>\n  <statistic extent='2'/>\n"
        f"  <worldbody><light pos='{LIGHT}'/></worldbody>\n</mujoco>\n"
    )
    (tmp_path / folder).mkdir(exist_ok=True)
    weighs = find_model_arm(read_mujoco_model(model).compile_model(), 6, str(model)).robot
    cell = cell_with(weighs, "joint_compliance:J2", size=5e-6)
    made = {}
    for given, name in ((scene, "new_scene.xml"), (model, "new_arm.xml")):
        path = tmp_path / folder / name
        write_exported_files(
            build_mjcf_file(
                replace(
                    build_export_job("cell", cell),
                    nominal=weighs,
                    fitted=True,
                    model=given,
                    path=path,
                )
            ),
            path,
        )
        made[name] = mujoco.MjModel.from_xml_path(str(path))
    root = ElementTree.parse(tmp_path / folder / "new_scene.xml").getroot()
    included = f"new_scene.{model.stem}.xml"
    assert [element.get("file") for element in root.iter("include")] == [included]
    assert [element.get("pos") for element in root.iter("light")] == [LIGHT]
    assert not list(root.iter("body"))
    arm = ElementTree.parse(tmp_path / folder / included).getroot()
    assert len(list(arm.iter("body"))) >= 6
    one, other = made.values()
    assert one.nlight == other.nlight + 1
    assert_allclose(one.body_pos, other.body_pos, atol=0)
    assert_allclose(one.actuator_gainprm, other.actuator_gainprm, atol=0)


def test_a_keyframe_grows_with_the_springs(tmp_path):
    model = ur10_like(tmp_path)
    text = model.read_text().replace("qpos='0 0 0 0 0 0 '", "qpos='1 2 3 4 5 6'")
    model.write_text(text)
    weighs = find_model_arm(read_mujoco_model(model).compile_model(), 6, str(model)).robot
    cell = cell_with(weighs, "joint_compliance:J2", "base_flex:frame", size=5e-6, base_flex=[2e-7])
    job = replace(
        build_export_job("cell", cell),
        nominal=weighs,
        fitted=True,
        model=model,
        path=tmp_path / "out.xml",
    )
    out = mujoco.MjModel.from_xml_string(build_mjcf_file(job).content.decode())
    assert out.nq == 9
    at = [int(out.joint(f"joint{i + 1}").qposadr[0]) for i in range(6)]
    assert out.key_qpos[0][at].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert out.key_qpos[0].sum() == 21.0


def test_a_command_map_reaches_what_the_fit_says(tmp_path):
    model = ur10_like(tmp_path)
    weighs = find_model_arm(read_mujoco_model(model).compile_model(), 6, str(model)).robot
    cell = cell_with(weighs, "joint_compliance:all", "gear_error:J3:turns=1", size=8e-6,
                     gear_error=[4e-4, -2e-4])  # fmt: skip
    job = replace(build_export_job("cell", cell), nominal=weighs, fitted=True, model=model)
    made = build_mjcf_file(replace(job, path=tmp_path / "out.xml"))
    (tmp_path / "out.xml").write_bytes(made.content)
    (tmp_path / "out.commands.json").write_bytes(made.beside[".commands.json"])
    q = poses(weighs, 4)
    asked = mc.load_commands(tmp_path / "out.commands.json")(q)
    assert np.abs(asked - q).max() > 1e-4
    check_held(tmp_path / "out.xml", cell, q, asked)


UNSTABLE = "integrator='Euler' timestep='0.005'"


def test_an_unstable_model_is_an_error_of_one_line(tmp_path, capsys):
    model = ur10_like(tmp_path, (1e4,) * 6, UNSTABLE, (1e6,) * 6, damping=0.0)
    text = model.read_text().replace('armature="0.1"', "").replace("armature='0.1'", "")
    model.write_text(text.replace("damping='1'", ""))
    mc.write_measurements(tmp_path / "poses.csv", mc.simulate("ur10", 30, 3, seed=3).data)
    assert run("gap", model, tmp_path / "poses.csv") == 2  # before any diagnosis
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert all(fact in said for fact in (str(model), "mjWARN_BAD", "kv"))


def test_a_force_limit_below_the_weight_is_an_error_of_one_line(tmp_path, capsys):
    model = ur10_like(tmp_path, limits=(330.0, 60.0, 150.0, 56.0, 56.0, 56.0))
    data = mc.simulate("ur10", 30, 3, seed=3).data
    mc.write_measurements(tmp_path / "poses.csv", data)
    assert run("gap", model, tmp_path / "poses.csv") == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert all(fact in said for fact in (str(model), "joint2", "60 N m", "forcerange"))
    fit = mc.calibrate("ur10", data, "sum")
    fit.save(tmp_path / "fit.json")
    to = ("--to", "mjcf", "--mjcf", model, "-o", tmp_path / "out.xml")
    assert run("export", tmp_path / "fit.json", *to) == 2
    assert "joint2" in capsys.readouterr().err
    assert not (tmp_path / "out.xml").exists()


def test_a_limit_that_binds_is_counted(tmp_path):
    """A limit above the weight, below what the move asks for."""
    q = np.array([[0.0, -1.5, 0.0, 0.0, 0.0, 0.0], [0.0, -0.4, 0.0, 0.0, 0.0, 0.0]] * 2)
    free = ur10_like(tmp_path)
    chain = find_model_arm(read_mujoco_model(free).compile_model(), 6, str(free))
    assert drive_to_poses(chain, q, "free").share_at_force_limit.max() == 0.0
    model, data = chain.model, mujoco.MjData(chain.model)
    data.qpos[:] = q[1]
    mujoco.mj_forward(model, data)
    tight = (330.0, 1.002 * abs(float(data.qfrc_bias[1])), 150.0, 56.0, 56.0, 56.0)
    bound = ur10_like(tmp_path, limits=tight)
    limited = drive_to_poses(
        find_model_arm(read_mujoco_model(bound).compile_model(), 6, str(bound)), q, "bound"
    ).share_at_force_limit
    assert limited[1] > SELDOM
    assert limited[[0, 2, 3, 4, 5]].max() == 0.0


@pytest.mark.parametrize("name", ["ur10", "irb2600", "seven_axes"])
@pytest.mark.slow
def test_the_study_s_corrected_files_hold_still_and_move(name, tmp_path):
    result = study.run_trial(study.SimulatorTrial(name, 48, 0))
    assert abs(result.alone_mm - result.gap.rungs[-1].holdout_rms_mm) < HOLDS_MM
    assert result.speed < STILL
    assert result.limited < SELDOM
