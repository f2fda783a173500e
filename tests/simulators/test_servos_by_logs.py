"""Drives of a model corrected by logs with commands: MuJoCo with known gains is the judge."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.dynamics.drives import PositionDrive
from minimax_cal.dynamics.laws import TORQUE_EFFECT_WORDS
from minimax_cal.dynamics.logs.log_table import NO_TORQUE_UNIT, TORQUE_UNIT, Run
from tests.conftest import run
from tests.dynamics.motions import three_joints

mujoco = pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")

from experiments.driven_arms import (  # noqa: E402
    DrivenArm,
    WithheldEffects,
    build_motor_model_xml,
    draw_commanded_motion,
    replace_motors_by_servos,
)
from minimax_cal.simulators.mjcf_tree import MjcfTree  # noqa: E402
from minimax_cal.simulators.motion.drives import (  # noqa: E402
    FittedDrives,
    read_model_drives,
)
from minimax_cal.simulators.motion.model_parameters import new_model, open_model  # noqa: E402
from minimax_cal.simulators.result import MotionGap  # noqa: E402

pytestmark = pytest.mark.skipif(
    not hasattr(mujoco, "mj_initCtrlHistory"), reason="no delays in this MuJoCo"
)
STEP, SECONDS = 0.001, 8.0
KP, KV = np.array([2000.0, 2500.0, 600.0]), np.array([200.0, 250.0, 60.0])
REAL_KP, REAL_KV, LATE = KP * [0.6, 1.6, 1.3], KV * [1.4, 0.8, 1.7], 0.0115
LACKS = WithheldEffects(
    np.array([4.0, 3.0, 1.5]), np.array([3.0, 4.0, 1.0]), np.array([0.4, 0.5, 0.3]), np.zeros(3)
)


def driven(arm: DrivenArm, model: object, number: int, speed: float, late: float) -> Run:
    """A log of the arm, whose controller takes its commands late."""
    at, data = draw_commanded_motion(arm, number, speed), mujoco.MjData(model)
    time = STEP * np.arange(round((SECONDS + 1.0) / STEP))
    wanted, told = at(time - late)[0], at(time)[0]
    data.qpos[:3] = wanted[0]
    rows = []
    for k in range(len(time)):
        data.ctrl[:3] = wanted[k]
        q, qd = data.qpos[:3].copy(), data.qvel[:3].copy()
        mujoco.mj_step(model, data)
        rows.append([q, qd, data.qfrc_actuator[:3].copy(), told[k]])
    q, qd, torque, command = np.moveaxis(np.array(rows)[1000::4], 1, 0)
    return Run(f"run{number}", "log.csv", time[1000::4] - 1.0, q, qd, None, torque, TORQUE_UNIT,
               command=command)  # fmt: skip


def arm_with(kp: np.ndarray, kv: np.ndarray, limit: float = np.inf) -> tuple[DrivenArm, object]:
    """An arm as its file is, and what it is really."""
    arm = DrivenArm(three_joints(), build_motor_model_xml(three_joints()), LACKS, 3, STEP)
    real = replace(arm, xml=replace_motors_by_servos(arm.xml, kp, kv)).compile_real_arm()
    if np.isfinite(limit):
        real.actuator_forcelimited[:], real.actuator_forcerange[:] = 1, [-limit, limit]
    return arm, real


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """An arm with other gains and late commands, and the model that `gap` corrects."""
    folder = tmp_path_factory.mktemp("drives")
    arm, real = arm_with(REAL_KP, REAL_KV)
    path, out = folder / "arm.xml", folder / "corrected.xml"
    path.write_bytes(replace_motors_by_servos(arm.xml, KP, KV))
    runs = [driven(arm, real, k, speed, LATE) for k, speed in enumerate((0.4, 1.2, 0.8))]
    gap = mc.motion_gap(path, runs, write=out)
    return SimpleNamespace(arm=arm, real=real, path=path, out=out, runs=runs, gap=gap)


def test_the_file_has_the_gains_and_the_delay_of_the_arm(made):
    model = mujoco.MjModel.from_xml_path(str(made.out))
    assert_allclose(model.actuator_gainprm[:3, 0], REAL_KP, rtol=5e-3)
    assert_allclose(-model.actuator_biasprm[:3, 2], REAL_KV, rtol=5e-3)
    assert_allclose(model.actuator_delay[:3], LATE, atol=2e-4)
    assert_allclose(model.dof_frictionloss, LACKS.friction, rtol=0.1)


def test_it_follows_commands_that_no_log_holds(made):
    """In MuJoCo alone, with ctrl the command and the history filled: 3 % of the error is left."""
    truth = driven(made.arm, made.real, 77, 1.3, LATE)

    def missed(path: Path) -> float:
        model = mujoco.MjModel.from_xml_path(str(path))
        data, step = mujoco.MjData(model), model.opt.timestep
        time = step * np.arange(round(SECONDS / step))
        wanted = np.stack([np.interp(time, truth.time, c) for c in truth.command.T], axis=1)
        data.qpos[:], data.qvel[:], data.ctrl[:] = truth.q[0], truth.qd[0], wanted[0]
        for k in np.flatnonzero(model.actuator_history[:, 0]):
            count = model.actuator_history[k, 0]
            mujoco.mj_initCtrlHistory(model, data, k, None, np.full(count, data.ctrl[k]))
        out = np.empty((len(time), 3))
        for k in range(len(time)):
            out[k], data.ctrl[:] = data.qpos, wanted[k]
            mujoco.mj_step(model, data)
        real = np.stack([np.interp(time, truth.time, c) for c in truth.q.T], axis=1)
        return float(np.sqrt(((out - real)[500:] ** 2).mean()))

    assert missed(made.out) < 0.03 * missed(made.path)


def test_the_fastest_run_judges_and_every_effect_has_its_worth(made):
    gap = made.gap
    assert gap.held_out == ("run1",)
    names = {(one.effect, one.place) for one in gap.effects}
    assert names == {(kind, f"J{j}") for kind in ("servo_gain", "command_delay") for j in (1, 2, 3)}
    for one in gap.effects:
        assert max(before / after for before, after in one.worth.values()) > 1.5
    steps = [f"+ {TORQUE_EFFECT_WORDS[kind]}" for kind in ("servo_gain", "command_delay")]
    assert [rung.name for rung in gap.rungs][:3] == ["as given", *steps]
    assert MotionGap.from_dict(json.loads(json.dumps(gap.to_dict()))).to_dict() == gap.to_dict()
    assert any("delay" in text and "MJX" in text for text in gap.notices)
    corrected = [text for text in gap.sentences() if text.startswith("corrected ")]
    assert len(corrected) == len(gap.effects) + len(gap.elements)


def test_sound_drives_are_not_accused(made, tmp_path):
    arm, real = arm_with(KP, KV)
    runs = [driven(arm, real, k, speed, 0.0) for k, speed in enumerate((0.4, 1.2, 0.8))]
    gap = mc.motion_gap(made.path, runs, write=tmp_path / "out.xml")
    assert gap.effects == ()
    assert {one.name for one in gap.elements} >= {"friction"}


def test_what_nothing_improves_is_not_written(tmp_path):
    nothing = WithheldEffects(*np.zeros((4, 3)))
    arm, _ = arm_with(KP, KV)
    real = replace(
        arm, withheld=nothing, xml=replace_motors_by_servos(arm.xml, KP, KV)
    ).compile_real_arm()
    path, out, files = tmp_path / "arm.xml", tmp_path / "out.xml", []
    path.write_bytes(replace_motors_by_servos(arm.xml, KP, KV))
    for k, speed in enumerate((0.4, 1.2)):
        one = driven(arm, real, k, speed, 0.0)
        files.append(tmp_path / f"log{k}.csv")
        files[-1].write_text(as_csv(one))
    assert run("gap", path, *files, "--write", out, "-o", tmp_path / "gap.json", "-q") == 0
    content = json.loads((tmp_path / "gap.json").read_text())
    assert content["effects"] == content["elements"] == []
    assert content["written"] == ""
    assert not out.exists()
    said = MotionGap.from_dict(content).headline()
    assert said.startswith("No correction lowers the joint error")
    assert said.endswith("nothing is written.")


def test_a_torque_limit_is_found_and_written(made, tmp_path):
    most = 0.6 * np.abs(np.concatenate([one.torque for one in made.runs])).max(axis=0)
    arm, real = arm_with(KP, KV)
    real.actuator_forcelimited[1], real.actuator_forcerange[1] = 1, [-most[1], most[1]]
    runs = [driven(arm, real, k, speed, 0.0) for k, speed in enumerate((0.9, 1.2, 1.0))]
    gap = mc.motion_gap(made.path, runs, write=tmp_path / "out.xml")
    assert ("torque_limit", "J2") in {(one.effect, one.place) for one in gap.effects}
    assert not {"servo_gain", "command_delay"} & {one.effect for one in gap.effects}
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    assert model.actuator_forcerange[1, 1] == pytest.approx(most[1], rel=0.01)


def test_every_number_of_a_drive_is_read_back_from_the_file(made):
    opened = open_model(made.path, 3)
    assert opened.has_correctable_servos()
    given = read_model_drives(opened.chain)
    assert_allclose([drive.stiffness for drive in given], KP)
    wanted = (PositionDrive(900.0, 80.0, 0.25, 0.013, 55.0), given[1], PositionDrive(700.0, 50.0))
    fits = tuple(SimpleNamespace(drive=drive) for drive in wanted)
    told = tuple((kind, j) for kind in ("servo_gain", "command_delay", "torque_limit")
                 for j in range(3))  # fmt: skip
    new = FittedDrives(given, fits, told, (0.0, 0.0), np.zeros(3)).apply_to(opened)
    for drive, again in zip(wanted, read_model_drives(new.chain), strict=True):
        assert_allclose(list(vars(again).values()), list(vars(drive).values()), rtol=1e-12)
    back = FittedDrives(given, (), (), (0.0, 0.0), np.zeros(3)).apply_to(new)
    assert read_model_drives(back.chain) == given


def test_actuators_and_ranges_say_what_was_written(made, tmp_path):
    table, code, ranges = (tmp_path / name for name in ("a.json", "a.py", "r.json"))
    mc.motion_gap(made.path, made.runs, write=tmp_path / "out.xml", actuators=("json", table),
                  randomize=ranges)  # fmt: skip
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    joints = json.loads(table.read_text())["joints"]
    assert [one["joint"] for one in joints] == ["joint1", "joint2", "joint3"]
    assert_allclose([one["stiffness"] for one in joints], model.actuator_gainprm[:3, 0])
    assert_allclose([one["friction"] for one in joints], model.dof_frictionloss)
    assert_allclose([one["armature"] for one in joints], model.dof_armature)
    assert {one["delay_steps"] for one in joints} == {round(LATE / model.opt.timestep)}
    assert all(one["effort_limit"] is None for one in joints)
    content = json.loads(ranges.read_text())
    names = [(one["name"], one["joint"]) for one in content["parameters"]]
    kinds = ("stiffness", "damper", "delay", "friction", "damping", "armature")
    assert set(names) >= {(kind, f"joint{j}") for kind in kinds for j in (1, 2, 3)} - {
        ("armature", "joint1")}  # fmt: skip
    whole = np.array(content["covariance"])
    assert whole.shape == (len(names),) * 2
    assert np.linalg.eigvalsh(whole / np.sqrt(np.outer(*[np.diag(whole)] * 2)))[0] > -1e-9
    assert_allclose([one["sigma"] ** 2 for one in content["parameters"]], np.diag(whole))
    kp = [one for one in content["parameters"] if one["name"] == "stiffness"]
    assert all(abs(one["mean"] - real) < 4.0 * one["sigma"] + 1e-3 * real
               for one, real in zip(kp, REAL_KP, strict=True))  # fmt: skip
    assert all(0.0 < one["between_runs"] < 0.05 * one["mean"] for one in kp)
    files = [str(tmp_path / name) for name in ("log0.csv", "log1.csv", "log2.csv")]
    for path, one in zip(files, made.runs, strict=True):
        Path(path).write_text(as_csv(one))
    assert run("gap", made.path, *files, "--actuators", "isaac", code, "-q",
               "-o", tmp_path / "gap.json") == 0  # fmt: skip
    made_of = {}
    source = code.read_text().replace("from isaaclab.actuators import DelayedPDActuatorCfg", "")
    exec(source, {"DelayedPDActuatorCfg": lambda **fields: fields}, made_of)
    (group,) = made_of["ACTUATORS"].values()
    assert group["joint_names_expr"] == ["joint1", "joint2", "joint3"]
    assert group["min_delay"] == group["max_delay"] == joints[0]["delay_steps"]
    assert group["effort_limit"] is None
    assert_allclose(list(group["damping"].values()), REAL_KV, rtol=0.01)


def as_csv(one: Run) -> str:
    """A log in the house's columns."""
    names = [f"{kind}{j}{end}" for kind, end in (("q", "_rad"), ("tau", "_Nm"), ("q", "_cmd_rad"))
             for j in (1, 2, 3)]  # fmt: skip
    rows = np.column_stack([one.time, one.q, one.torque, one.command])
    lines = [",".join(["t_s", *names]), *(",".join(f"{v:.9g}" for v in row) for row in rows)]
    return "\n".join(lines) + "\n"


def test_commands_and_positions_alone_give_drives_by_the_masses_of_the_model(made, tmp_path):
    """Without torques: all but one common scale, which the model's masses set."""
    out, text, files = tmp_path / "out.xml", tmp_path / "gap.json", []
    for one in made.runs:
        files.append(tmp_path / f"{one.name}.csv")
        files[-1].write_text(without_torques(as_csv(one)))
    assert run("gap", made.path, *files, "--write", out, "-o", text, "-q") == 0
    gap = MotionGap.from_dict(json.loads(text.read_text()))
    assert any("masses" in said and "k times" in said for said in gap.notices)
    assert {one.name for one in gap.elements} == {"friction", "armature"}
    first, last = (np.linalg.norm(gap.rungs[k].tracking_rms_mrad) for k in (0, -1))
    assert last < 0.1 * first
    model = mujoco.MjModel.from_xml_path(str(out))
    assert_allclose(model.actuator_delay[:3], LATE, atol=1.5e-3)
    assert_allclose(model.actuator_gainprm[:3, 0], REAL_KP, rtol=0.15)
    whole = -model.actuator_biasprm[:3, 2] + model.dof_damping
    assert_allclose(whole, REAL_KV + LACKS.damping, rtol=0.15)
    assert run("torques", three_joints_file(tmp_path), *files, "-q") == 2
    assert run("gap", made.path, *files, "--figure", tmp_path / "gap.png", "-q",
               "--actuators", "json", tmp_path / "a.json",
               "--randomize", tmp_path / "r.json") == 0  # fmt: skip
    names = {one["name"] for one in json.loads((tmp_path / "r.json").read_text())["parameters"]}
    assert names == {"stiffness", "damper", "delay"}


def test_a_model_of_motors_needs_torques(made, tmp_path):
    path, logs = tmp_path / "motors.xml", [tmp_path / "log1.csv", tmp_path / "log2.csv"]
    path.write_bytes(made.arm.xml)
    for log, one in zip(logs, made.runs, strict=False):
        log.write_text(without_torques(as_csv(one)))
    with pytest.raises(mc.CalibrationError, match="the model position servos"):
        mc.motion_gap(path, logs)


def three_joints_file(folder: Path) -> Path:
    """The robot of the logs."""
    path = folder / "robot.json"
    path.write_text(json.dumps(three_joints().to_dict()))
    return path


def without_torques(text: str) -> str:
    """A log without its columns of torque."""
    rows = [line.split(",") for line in text.splitlines()]
    kept = [i for i, name in enumerate(rows[0]) if not name.startswith("tau")]
    return "\n".join(",".join(row[i] for i in kept) for row in rows) + "\n"


def test_masses_set_the_one_scale_that_positions_do_not_tell(made, tmp_path):
    """With all masses 1.5 times as large, gains, friction and rotors are, and positions are not."""
    root = ElementTree.parse(made.path).getroot()
    for body in root.iter("inertial"):
        for name in {"mass", "diaginertia", "fullinertia"} & set(body.attrib):
            body.set(name, " ".join(str(1.5 * float(v)) for v in body.get(name).split()))
    root.remove(root.find("custom"))  # the robot whole, which would count in place of the bodies
    heavy = tmp_path / "heavy.xml"
    heavy.write_bytes(ElementTree.tostring(root))
    bare = [replace(one, torque=0.0 * one.torque, unit=NO_TORQUE_UNIT) for one in made.runs]
    gaps, models = [], []
    for path, out in ((made.path, tmp_path / "a.xml"), (heavy, tmp_path / "b.xml")):
        gaps.append(mc.motion_gap(path, bare, write=out))
        models.append(mujoco.MjModel.from_xml_path(str(out)))
    light, heavy = ([m.dof_frictionloss, m.dof_armature, m.actuator_gainprm[:, 0]] for m in models)
    assert_allclose(np.array(heavy), 1.5 * np.array(light), rtol=0.02)
    ends = [np.linalg.norm(gap.rungs[-1].tracking_rms_mrad) for gap in gaps]
    assert ends[1] == pytest.approx(ends[0], rel=0.2)


def test_drives_that_carry_no_gravity_are_told_from_a_model_whose_drives_do(made, tmp_path):
    root = ElementTree.parse(made.path).getroot()
    for body in root.iter("body"):
        body.set("gravcomp", "1")
    for joint in root.iter("joint"):
        joint.set("actuatorgravcomp", "true")
    path, out = tmp_path / "carries.xml", tmp_path / "out.xml"
    path.write_bytes(ElementTree.tostring(root))
    gap = mc.motion_gap(path, made.runs, write=out)
    (share,) = (one for one in gap.effects if one.place == "all")
    assert [(p.name, p.value) for p in share.parameters] == [("gravity_share", 0.0)]
    model = mujoco.MjModel.from_xml_path(str(out))
    assert not model.body_gravcomp.any()
    assert_allclose(model.actuator_gainprm[:3, 0], REAL_KP, rtol=5e-3)


def test_a_damper_too_large_for_an_explicit_step_changes_the_integrator(made):
    root = ElementTree.fromstring(replace_motors_by_servos(made.arm.xml, KP, 0.02 * KV))
    root.find("option").set("integrator", "Euler")
    path = made.path.with_name("euler.xml")
    path.write_bytes(ElementTree.tostring(root))
    opened = open_model(path, 3)
    given = read_model_drives(opened.chain)
    for damper, integrator in ((0.03 * KV[0], "mjINT_EULER"), (9.0 * KV[0], "mjINT_IMPLICITFAST")):
        fits = (SimpleNamespace(drive=replace(given[0], damper=damper)), None, None)
        new = FittedDrives(given, fits, (("servo_gain", 0),), (0.0, 0.0),
                     np.zeros(3)).apply_to(opened)  # fmt: skip
        model = new.chain.model
        assert mujoco.mjtIntegrator(model.opt.integrator).name == integrator


def test_a_new_model_of_a_robot_file_gets_the_drives_of_the_log(made, tmp_path):
    """A plain file has no delay, and says which runs judged."""
    out = tmp_path / "new.xml"
    gap = mc.motion_gap(three_joints_file(tmp_path), made.runs, write=out, plain=True)
    assert {one.effect for one in gap.effects} == {"servo_gain"}
    model = mujoco.MjModel.from_xml_path(str(out))
    assert_allclose(model.actuator_gainprm[:3, 0], REAL_KP, rtol=5e-3)
    assert not model.actuator_delay.any()
    assert not any("delay" in text for text in gap.notices)


@pytest.mark.parametrize("scale", [1.0, 0.7])
def test_a_file_of_ours_whose_joints_hold_the_dampers_of_its_servos(tmp_path, scale):
    """The file itself made the log, sound or with other gains: its torques lack the dampers."""
    path, out = tmp_path / "arm.xml", tmp_path / "out.xml"
    path.write_bytes(MjcfTree(new_model(three_joints()).root).to_bytes())
    arm = DrivenArm(three_joints(), path.read_bytes(), LACKS, 3, STEP)
    real = mujoco.MjModel.from_xml_path(str(path))
    real.opt.timestep = STEP
    real.actuator_gainprm[:, 0] *= scale
    real.actuator_biasprm[:, 1] *= scale
    real.dof_damping[:] *= scale
    real.dof_frictionloss[:] = LACKS.friction
    late = LATE * (scale != 1.0)
    runs = [driven(arm, real, k, speed, late) for k, speed in enumerate((0.4, 1.2, 0.8))]
    gap = mc.motion_gap(path, runs, write=out)
    assert {one.effect for one in gap.effects} == (
        {"servo_gain", "command_delay"} if late else set())  # fmt: skip
    model = mujoco.MjModel.from_xml_path(str(out))
    assert_allclose(model.actuator_gainprm[:, 0], real.actuator_gainprm[:, 0], rtol=1e-3)
    assert_allclose(model.dof_damping, real.dof_damping, rtol=0.05)
    first, last = (np.linalg.norm(gap.rungs[k].tracking_rms_mrad) for k in (0, -1))
    assert last < 0.2 * first
