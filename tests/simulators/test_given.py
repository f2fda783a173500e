"""A given MJCF is corrected in place: the arm is the calibrated one, all else is as it was."""

from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.modelling.cell import build_measurements_at_rest
from minimax_cal.modelling.effects.table import Fitted, parse_effect_terms
from minimax_cal.robots.mjcf_import import read_mujoco_model
from tests.problems_mjcf import published_like

mujoco = pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")

from minimax_cal.simulators.chain import ModelArm, find_model_arm  # noqa: E402
from minimax_cal.simulators.drive import compute_error_with_fitted_base, drive_to_poses  # noqa: E402

EXACT = dict(rtol=0, atol=1e-9)  # [m]
FIRST_ORDER = 5e-6  # what the laws of a fit leave out: sag of sag [m]
CHANGED = {  # what a correction may change, by element
    "body": {"pos", "quat", "euler", "gravcomp"},
    "joint": {"damping", "stiffness", "actuatorgravcomp"},
    "general": {"gainprm", "biasprm", "biastype", "gear"},
}


def joints(robot: mc.Robot, count: int = 12) -> np.ndarray:
    return np.random.default_rng(2).uniform(-1.5, 1.5, (count, robot.joints))


@pytest.fixture
def given(tmp_path: Path) -> tuple[Path, ModelArm]:
    path = published_like(tmp_path, mc.load_robot("ur10"))
    return path, find_model_arm(read_mujoco_model(path).compile_model(), 6, str(path))


def bent_cell(robot: mc.Robot, texts: dict[str, list[float]]) -> mc.Cell:
    """An arm that is not quite its drawing, with effects."""
    mdh = robot.mdh.copy()
    mdh[:5] += 1e-3 * np.random.default_rng(1).normal(size=(5, 5))
    spots = np.array([[0.1, 0.0, 0.03], [-0.05, 0.08, 0.03], [-0.05, -0.08, 0.03]])
    cell = mc.Cell(robot.with_mdh(mdh), np.eye(4), ("smr1", "smr2", "smr3"), spots)
    scene = cell.pose_arm(build_measurements_at_rest(joints(robot), cell.target_names, robot))
    chosen = parse_effect_terms(scene, list(texts))
    values = tuple(np.array(v) for v in texts.values())
    return replace(cell, effects=Fitted(chosen, values))


def corrected(path: Path, chain: ModelArm, cell: mc.Cell, out: Path) -> Any:
    from minimax_cal.compensation.exporters.export_job import build_export_job
    from minimax_cal.compensation.robot_export import write_exported_files
    from minimax_cal.simulators.mjcf import build_mjcf_file

    job = replace(
        build_export_job("cell", cell), nominal=chain.robot, fitted=True, model=path, path=out
    )
    write_exported_files(build_mjcf_file(job), out)
    return mujoco.MjModel.from_xml_path(str(out))


def sites(model: Any, chain: ModelArm, q: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """The sites where the model comes to rest, in the robot's base frame."""
    ids = tuple(model.joint(name).id for name in chain.joint_names)
    moved, data, out = replace(chain, model=model, joint_ids=ids), mujoco.MjData(model), []
    for row in q:
        mujoco.mj_resetData(model, data)
        for i, joint in enumerate(ids):
            data.qpos[model.jnt_qposadr[joint]] = row[i]
            data.ctrl[moved.servo_ids[i]] = row[i]
        while data.time < 8.0:
            mujoco.mj_step(model, data, 100)
            if np.abs(data.qvel).max() < 1e-7:
                break
        out.append([data.site(name).xpos.copy() for name in names])
    points = np.array(out) - chain.base[:3, 3]
    return np.asarray(points @ chain.base[:3, :3])


def test_the_robot_of_a_model_moves_as_the_model_does(given):
    _, chain = given
    model, data = chain.model, mujoco.MjData(chain.model)
    assert chain.joint_names == tuple(f"axis{i}" for i in range(6))
    nominal = mc.load_robot("ur10")
    q = joints(nominal)
    frame = []
    for row in q:
        for i, joint in enumerate(chain.joint_ids):
            data.qpos[model.jnt_qposadr[joint]] = row[i]
        mujoco.mj_kinematics(model, data)
        frame.append(data.body("part5").xpos.copy())
    ours = (chain.base @ chain.robot.pose(q) @ chain.urdf_robot.tool)[:, :3, 3]
    assert_allclose(ours, frame, **EXACT)
    assert_allclose(chain.robot.up, [0.0, 0.0, 1.0], atol=1e-12)


@pytest.mark.parametrize("step", ["1e-6", "1e-9"])
def test_a_timestep_that_takes_forever_is_refused(given, tmp_path, step):
    tree = ET.parse(given[0])
    for option in [*tree.getroot().iter("option")] or [ET.SubElement(tree.getroot(), "option")]:
        option.set("timestep", step)
    tree.write(tmp_path / "slow.xml")
    with pytest.raises(mc.RobotError, match=rf"slow\.xml: its timestep of {float(step):g} s"):
        find_model_arm(
            read_mujoco_model(tmp_path / "slow.xml").compile_model(), 6, str(tmp_path / "slow.xml")
        )


def test_everything_stays_but_what_was_corrected(given, tmp_path):
    path, chain = given
    cell = bent_cell(chain.robot, {"joint_compliance:all": [2e-6] * 5, "encoder_gain:J4": [1e-3]})
    corrected(path, chain, cell, tmp_path / "out.xml")
    before = read_mujoco_model(path).document.root
    after = read_mujoco_model(tmp_path / "out.xml").document.root
    own = {"smr1", "smr2", "smr3", "flange"}
    for parent in list(after.iter("body")):
        for site in [e for e in parent.findall("site") if e.get("name") in own]:
            parent.remove(site)
    for custom in after.findall("custom"):  # gains that carry a deflection
        assert all(str(text.get("name")).endswith("_deflection") for text in custom)
        after.remove(custom)
    old = [e for e in before.iter() if isinstance(e.tag, str)]
    new = list(after.iter())
    assert [(e.tag, e.get("name")) for e in old] == [(e.tag, e.get("name")) for e in new]
    touched = set()
    for one, other in zip(old, new, strict=True):
        keys = one.attrib.keys() | other.attrib.keys()
        differing = {key for key in keys if one.get(key) != other.get(key)}
        assert differing <= CHANGED.get(one.tag, set()), (one.tag, one.get("name"), differing)
        touched |= {(one.tag, one.get("name"))} if differing - {"gravcomp"} else set()
    assert ("body", "part4") in touched
    assert not touched & {("body", "tool_plate"), ("body", "finger_body"), ("position", "fingers")}
    text = (tmp_path / "out.xml").read_text()
    kept = ("<!-- a remark -->", "<include file='parts.xml'/>")  # nothing in the include changed
    assert all(part in text for part in kept)


def test_a_corrected_model_in_another_folder_finds_its_meshes(given, tmp_path):
    path, chain = given
    (tmp_path / "elsewhere").mkdir()
    model = corrected(path, chain, bent_cell(chain.robot, {}), tmp_path / "elsewhere" / "arm.xml")
    assert model.nmesh == chain.model.nmesh


EFFECTS = {
    "geometry alone": {},
    "joints": {"joint_compliance:all": [2e-6, 3e-6, 5e-6, 4e-6, 4e-6]},
    "structure": {"base_flex:frame": [2e-7], "link_bending:L2": [2e-6]},
    "gears": {"encoder_gain:J2": [1e-3], "joint_coupling:J5:source=4": [5e-3]},
    "tool": {"tool_flex:all:lever=0": [1e-3, -2e-5]},
    "spring": {"gravity_compensator:J2:zero=0.1:eye=0.4:rest=0.5": [-1e-3]},
}


@pytest.mark.parametrize("name", EFFECTS)
def test_a_corrected_model_rests_where_the_fit_says(given, tmp_path, name):
    path, chain = given
    cell = bent_cell(chain.robot, EFFECTS[name])
    model = corrected(path, chain, cell, tmp_path / "out.xml")
    q = joints(chain.robot, 6)
    off = sites(model, chain, q, cell.target_names) - cell.predict(q)
    assert np.linalg.norm(off, axis=-1).max() < FIRST_ORDER


def test_published_gains_sag(given):
    _, chain = given
    q = joints(chain.robot, 6)
    rested = drive_to_poses(chain, q, str(given[0]))
    assert (chain.servo_ids >= 0).all()
    assert not rested.is_moving.any()
    # the servo is a spring: each joint stands off by its torque over its gain
    torque = still_torque(chain, rested.q)
    gains = np.array(chain.model.actuator_gainprm[chain.servo_ids, 0])
    assert_allclose(rested.q - q, torque / gains, rtol=0, atol=2e-5)  # its slowest pole is at 5/s


def still_torque(chain: ModelArm, q: np.ndarray) -> np.ndarray:
    """Gravity's torque by MuJoCo's own inverse dynamics."""
    data, out = mujoco.MjData(chain.model), []
    at = [int(chain.model.jnt_qposadr[j]) for j in chain.joint_ids]
    dofs = [int(chain.model.jnt_dofadr[j]) for j in chain.joint_ids]
    for row in q:
        data.qpos[at] = row
        mujoco.mj_forward(chain.model, data)
        out.append(-data.qfrc_bias[dofs])
    return np.array(out)


def test_base_and_targets_are_found_from_poses():
    robot = mc.load_robot("irb120")
    simulation = mc.simulate(
        robot, 30, truth=mc.Truth(noise=0.0, noise_per_metre=0.0, compliance=0.0)
    )
    cell = simulation.cell
    start = cell.base.copy()
    start[:3, 3] += 0.02
    train = np.arange(30) < 20
    poses = cell.robot.pose(simulation.data.q)
    error = compute_error_with_fitted_base(
        poses, simulation.data, train, (start, cell.target_positions + 0.01)
    )
    assert_allclose(error, 0.0, **EXACT)


@pytest.mark.parametrize(
    ("before", "within", "says"),
    [
        ('<asset><hfield name="m" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>', "",
         "<hfield>: cells: 1e+10"),
        ('<asset><texture name="m" type="2d" builtin="flat" width="60000" height="60000"/></asset>',
         "", "<texture>: pixels"),
        ("", '<replicate count="200">' * 2 + '<geom size="1"/>' + "</replicate>" * 2,
         "elements, replicated ones too: 8.02e+04"),
        ('<size nuser_body="100000000"/>', "", "<size>: numbers set aside"),
        ("", '<body><freejoint/><geom size="1"/></body>' * 60, "float freely: 60, at most 50"),
        ("", "<body>" * 3000 + "</body>" * 3000, "100 deep"),
        ("", '<body pos="0 0 1"><geom size="1"/></body>' * 1200, "bodies: 1.2e+03, at most 1000"),
    ],
)  # fmt: skip
def test_models_that_no_memory_holds_are_refused(tmp_path, before, within, says):
    file = tmp_path / "bad.xml"
    file.write_text(f"<mujoco>{before}<worldbody>{within}</worldbody></mujoco>")
    with pytest.raises(mc.CalibrationError) as caught:
        read_mujoco_model(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert says in str(caught.value)
