"""A model corrected by logs: it has the real arm's numbers, and moves as the arm does."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.dynamics.known_inputs import MotionKnown, Payload, read_runs_of_robot
from minimax_cal.dynamics.logs import format_runs_csv_in_rad_and_mm
from minimax_cal.dynamics.logs.log_table import NO_TORQUE_UNIT, Run
from minimax_cal.dynamics.regressor import compute_link_inertial_parameters
from tests.conftest import run
from tests.dynamics.motions import run_of, three_joints
from tests.problems_mjcf import drive_alone
from tests.simulators.test_mjcf import in_base

mujoco = pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")

from experiments.driven_arms import (  # noqa: E402
    DrivenArm,
    WithheldEffects,
    build_motor_model_xml,
    draw_commanded_motion,
    simulate_controlled_run,
    simulate_logs,
    write_model_file,
)
from minimax_cal.simulators.motion import model_parameters as bodies  # noqa: E402
from minimax_cal.simulators.motion.fit import (  # noqa: E402
    levelling_damping_coefficients,
    minimise_squares_with_bounds,
    speed_powers,
)
from minimax_cal.simulators.motion.judge import (  # noqa: E402
    OWN_SERVOS_TEXT,
    MotionJudge,
    simulate_commands,
)
from minimax_cal.simulators.motion.model_parameters import open_model  # noqa: E402
from minimax_cal.simulators.result import MotionGap  # noqa: E402

STEP = 0.002
LACKS = WithheldEffects(
    friction=np.array([4.0, 3.0, 1.5]),
    damping=np.array([3.0, 4.0, 1.0]),
    armature=np.array([0.4, 0.5, 0.3]),
    share=np.array([0.0, 0.08, 0.0]),
    payload=1.5,
)
LEFT, LEFT_TORQUE = 0.12, 0.15  # of the joint error, of the worst joint's torque


def errors(arm: DrivenArm, model: object, real: object) -> tuple[float, np.ndarray]:
    """Joint error [rad] and torques of the joints that differ from the real arm's, RMS."""
    course = simulate_controlled_run(arm, model, draw_commanded_motion(arm, 77, 1.1), 5.0)
    off, torque = course.q - real.q, course.torque - real.torque
    return float(np.sqrt((off**2).mean())), np.sqrt((torque**2).mean(axis=0))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """An arm, its logs, and the gap that the command closes."""
    folder = tmp_path_factory.mktemp("motion")
    robot = three_joints()
    xml = build_motor_model_xml(robot).replace(
        b"<worldbody>", b"<!-- as drawn -->\n  <worldbody>", 1
    )
    arm = DrivenArm(robot, xml, LACKS, 3, STEP)
    model = write_model_file(arm, folder)
    logs = []
    for one in simulate_logs(arm, 3, 8.0):
        path = folder / f"{one.name}.csv"
        path.write_text(format_runs_csv_in_rad_and_mm([one], np.zeros(3, dtype=bool)))
        logs.append(path)
    out, text = folder / "corrected.xml", folder / "gap.json"
    figure = folder / "gap.png"
    files = ("--write", out, "--json", "-o", text, "--figure", figure, "-q")
    assert run("gap", model, *logs, *files) == 0
    gap = MotionGap.from_dict(json.loads(text.read_text()))
    return SimpleNamespace(arm=arm, model=model, logs=logs, out=out, gap=gap, text=text,
                           figure=figure)  # fmt: skip


def test_the_file_has_the_numbers_of_the_real_arm(made):
    found, real = mujoco.MjModel.from_xml_path(str(made.out)), made.arm.compile_real_arm()
    assert_allclose(found.dof_frictionloss[[0, 2]], LACKS.friction[[0, 2]], rtol=0.05)
    assert_allclose(found.dof_damping[[0, 2]], LACKS.damping[[0, 2]], rtol=0.1)
    assert_allclose(found.dof_armature[1:], real.dof_armature[1:], rtol=0.1)
    first = [m.body_mass[-1] * m.body_ipos[-1] for m in (found, real)]
    across = (first[0] - first[1])[:2]  # along its own axis it turns no joint of this arm
    assert np.linalg.norm(across) < 0.03 * LACKS.payload * np.linalg.norm(real.body_ipos[-1])


def test_it_moves_as_the_arm_does(made):
    """On a run that no log holds, under a controller that knows the first file."""
    arm, before = made.arm, made.arm.compiled_file_model
    real = simulate_controlled_run(
        arm, arm.compile_real_arm(), draw_commanded_motion(arm, 77, 1.1), 5.0, LACKS
    )
    first = errors(arm, before, real)
    plain = errors(arm, mujoco.MjModel.from_xml_path(str(made.out)), real)
    assert plain[0] < LEFT * first[0]
    assert (plain[1] < LEFT_TORQUE * first[1]).all()


def test_the_ladder_says_so(made):
    content = json.loads(made.text.read_text())
    assert content["kind"] == "simulator_gap"
    first, *_, last = content["rungs"]
    assert first["name"] == "as given"
    for rung in content["rungs"]:
        assert len(rung["tracking_rms_mrad"]) == len(rung["torque_rms_Nm"]) == 3
    assert np.linalg.norm(last["tracking_rms_mrad"]) < LEFT * np.linalg.norm(
        first["tracking_rms_mrad"]
    )
    gap = made.gap
    assert gap.to_dict() == content
    assert {e.name for e in gap.elements} == {"friction", "masses", "armature"}
    assert any("joint 2" in text for text in gap.left_out)  # friction that no element holds
    assert all(after < before for e in gap.elements for before, after in [max(
        e.worth.values(), key=lambda ends: ends[0] / ends[1])])  # fmt: skip
    assert made.figure.read_bytes().startswith(b"\x89PNG")
    assert len(gap.sentences()) == len(gap.elements) + len(gap.left_out)


def test_a_plain_file_has_nothing_that_others_leave_out(made,
                                                       tmp_path):  # fmt: skip
    out = tmp_path / "plain.xml"
    gap = mc.motion_gap(made.model, made.logs, write=out, plain=True, driven=False)
    assert not [text for text in gap.notices if "leave out" in text]
    model, bent = mujoco.MjModel.from_xml_path(str(out)), ("dof_dampingpoly", "jnt_stiffnesspoly")
    assert not any(np.any(getattr(model, name, 0.0)) for name in bent)
    assert_allclose(
        reached(out, read_runs_of_robot(made.model, made.logs)), gap.rungs[-1].torque_rms, rtol=1e-4
    )


def test_a_plain_file_moves_alike_in_every_simulator(made, tmp_path):
    """MuJoCo in C, in JAX and in Warp: 50 steps from a start at speed, in single precision."""
    mjx = pytest.importorskip("mujoco.mjx", reason="needs pip install minimax-cal[rl]")
    jax = pytest.importorskip("jax", reason="needs pip install minimax-cal[rl]")
    warp = pytest.importorskip("mujoco_warp", reason="needs pip install minimax-cal[rl]")
    out, speed = tmp_path / "plain.xml", [1.0, -0.5, 2.0]
    mc.motion_gap(made.model, made.logs, write=out, plain=True, driven=False)
    model = mujoco.MjModel.from_xml_path(str(out))
    data = mujoco.MjData(model)
    data.qvel[:] = speed
    in_jax, in_warp = mjx.put_data(model, data), warp.put_data(model, data)
    jax_model, warp_model, step = mjx.put_model(model), warp.put_model(model), jax.jit(mjx.step)
    for _ in range(50):
        mujoco.mj_step(model, data)
        in_jax = step(jax_model, in_jax)
        warp.step(warp_model, in_warp)
    assert_allclose(in_jax.qpos, data.qpos, atol=1e-4)
    assert_allclose(in_warp.qpos.numpy()[0], data.qpos, atol=1e-4)


def reached(path: Path, runs: list[Run], payload: Payload | None = None) -> np.ndarray:
    """(n,) RMS torque that a file misses on the last run, loaded again [N m]."""
    opened = open_model(path, 3)
    judge = MotionJudge.from_runs(opened, runs, MotionKnown(payload=payload))
    return np.array(judge.measure_torque_error(opened.chain).all_rows)


def test_a_file_reaches_the_last_rung(made):
    runs = read_runs_of_robot(made.model, made.logs)
    assert_allclose(reached(made.out, runs), made.gap.rungs[-1].torque_rms, rtol=1e-4)


def test_a_drive_gain_that_no_file_holds_is_in_no_figure(made, tmp_path):
    """Torques of joint 2 are logged 17 % too large; position servos hold no gain, motors do."""
    robot, out = tmp_path / "robot.json", tmp_path / "out.xml"
    robot.write_text(json.dumps(three_joints().to_dict()))
    runs = [replace(run, torque=run.torque * [1.0, 1.17, 1.0])
            for run in read_runs_of_robot(made.model, made.logs)]  # fmt: skip
    payload = (LACKS.payload, (0.02, 0.0, 0.06))
    new = mc.motion_gap(robot, runs, payload=payload, write=out, driven=False)
    assert any("drive gain" in text and "joint 2" in text for text in new.left_out)
    assert_allclose(reached(out, runs, payload), new.rungs[-1].torque_rms, rtol=1e-4)
    given = mc.motion_gap(made.model, runs, payload=payload, write=out, driven=False)
    gear = mujoco.MjModel.from_xml_path(str(out)).actuator_gear[:, 0]
    assert gear[1] < 0.95
    assert_allclose(gear[[0, 2]], 1.0)
    assert any(e.name == "drive gain" for e in given.elements)
    assert not any("drive gain" in text for text in given.left_out)


def test_a_report_has_it_beside_a_calibration(made, tmp_path):
    poses = mc.simulate(three_joints(), 30, seed=1).data
    mc.calibrate(three_joints(), poses, "sum").save(tmp_path / "fit.json")
    page = tmp_path / "report.html"
    assert run("report", tmp_path / "fit.json", made.text, "--appendix", "-o", page, "-q") == 0
    text = page.read_text()
    assert made.gap.held_out == ("run2",)
    assert all(fact in text for fact in ("run2", "joint 2", *(e.name for e in made.gap.elements)))


def test_the_text_stays_but_for_what_changes(made):
    before, after = (path.read_text().splitlines() for path in (made.model, made.out))
    assert len(before) == len(after)
    changed = [old for old, new in zip(before, after, strict=True) if old != new]
    assert changed
    assert all(line.lstrip().startswith(("<inertial", "<joint")) for line in changed)


def test_an_arm_as_drawn_keeps_its_file(tmp_path):
    nothing = WithheldEffects(*np.zeros((4, 3)))
    arm = DrivenArm(three_joints(), build_motor_model_xml(three_joints()), nothing, 5, STEP)
    gap = mc.motion_gap(write_model_file(arm, tmp_path), simulate_logs(arm, 2, 8.0), driven=False,
                        write=tmp_path / "same.xml")  # fmt: skip
    assert gap.elements == ()
    assert len(gap.rungs) == 1
    assert (tmp_path / "same.xml").read_bytes() == arm.xml


def test_torques_write_a_new_file_that_holds_still(made, tmp_path):
    """Of a robot file: position servos, friction, and the drive test of every written model."""
    robot, out = tmp_path / "robot.json", tmp_path / "new.xml"
    robot.write_text(json.dumps(three_joints().to_dict()))
    assert run("torques", robot, *made.logs, "--write", out, "-o", tmp_path / "m.json", "-q") == 0
    content = json.loads((tmp_path / "m.json").read_text())
    assert content["kind"] == "motion_diagnosis"
    assert content["written"] == str(out)
    model = mujoco.MjModel.from_xml_path(str(out))
    assert_allclose(model.dof_frictionloss[[0, 2]], LACKS.friction[[0, 2]], rtol=0.05)
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (4, 3))
    reached = drive_alone(out, q, ("flange",))
    data = mujoco.MjData(model)
    for row, site in zip(q[1:], reached.sites, strict=True):
        data.qpos[:3] = row
        mujoco.mj_kinematics(model, data)
        assert 1e3 * np.linalg.norm(site[0] - data.site("flange").xpos) < 0.02
    assert reached.speed < 2e-3
    assert reached.limited < 0.01


@pytest.mark.slow
def test_a_static_calibration_goes_into_the_same_file(made, tmp_path):
    """Compliance in springs of its own, so that friction of the servos does not hold it."""
    robot, runs = three_joints(), made.logs[-2:]
    truth = mc.Truth(compliance=3e-6)
    poses = mc.simulate(robot, 40, seed=3, truth=truth).data
    fit = mc.calibrate(robot, poses, "sum", effects="joint_compliance:all")
    (tmp_path / "robot.json").write_text(json.dumps(robot.to_dict()))
    for model, name in ((tmp_path / "robot.json", "new.xml"), (made.model, "motors.xml")):
        gap = mc.motion_gap(model, runs, fit=fit, driven=False, write=tmp_path / name)
        assert [rung.name for rung in gap.rungs[:2]] == ["as given", "calibrated geometry"]
        found = mujoco.MjModel.from_xml_path(str(tmp_path / name))
        springs = [j for j in range(found.njnt) if found.joint(j).name.startswith("flex")]
        assert len(springs) == 2
        assert (found.jnt_stiffness[springs] < 1e6).all()
        assert found.dof_frictionloss[0] == pytest.approx(LACKS.friction[0], rel=0.05)
    assert found.actuator_gainprm[:, 0].max() == 1.0  # motors stay motors
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (3, 3))
    reached = drive_alone(tmp_path / "new.xml", q, fit.cell.target_names)
    wanted = in_base(fit.cell, q)[1:]
    off = 1e3 * np.linalg.norm(reached.sites - wanted, axis=-1)
    assert off.max() < 0.03  # the logs' payload, which was not there when the poses were measured


@pytest.mark.slow
def test_logged_commands_drive_the_servos_of_the_model(tmp_path):
    """A real arm with the servos of its model, friction and late commands, driven by its log."""
    robot = three_joints()
    xml = build_motor_model_xml(robot).decode().replace("<motor ", '<position kp="2000" kv="200" ')
    path = tmp_path / "servos.xml"
    path.write_text(xml)
    real = mujoco.MjModel.from_xml_path(str(path))
    real.dof_frictionloss[:] = LACKS.friction
    arm = DrivenArm(robot, xml.encode(), LACKS, 3, STEP)
    rows = []
    for number in range(2):
        at = draw_commanded_motion(arm, number, 0.5 + 0.5 * number)(STEP * np.arange(4000))[0]
        data = mujoco.MjData(real)
        data.qpos[:] = at[0]
        out = np.empty((len(at), 10))
        for k, wanted in enumerate(at):
            data.ctrl[:] = wanted
            q = data.qpos.copy()
            mujoco.mj_step(real, data)
            out[k] = np.concatenate([[k * STEP], q, data.qfrc_actuator, wanted])
        rows.append(out[500::2])
    header = ["t_s", *(f"q{j}_rad" for j in (1, 2, 3)), *(f"tau{j}_Nm" for j in (1, 2, 3)),
              *(f"q{j}_cmd_rad" for j in (1, 2, 3))]  # fmt: skip
    files = []
    for number, table in enumerate(rows):
        files.append(tmp_path / f"log{number}.csv")
        text = "\n".join(",".join(f"{v:.9g}" for v in row) for row in table)
        files[-1].write_text(",".join(header) + "\n" + text + "\n")
    gap = mc.motion_gap(path, files)
    assert gap.drives == OWN_SERVOS_TEXT
    first, last = (np.array(r.tracking_rms_mrad) for r in (gap.rungs[0], gap.rungs[-1]))
    assert (last < 0.1 * first).all()


@pytest.mark.skipif(not hasattr(mujoco, "mj_initCtrlHistory"), reason="no delays in this MuJoCo")
def test_a_delayed_servo_at_its_command_stays_there(tmp_path):
    """MuJoCo fills the history of a delayed command with 0: the arm would jump towards it."""
    servo = '<position kp="2000" kv="200" delay="0.02" nsample="14" '
    path, q = tmp_path / "late.xml", np.array([0.4, -0.3, 0.5])
    path.write_text(build_motor_model_xml(three_joints()).decode().replace("<motor ", servo))
    chain, time = open_model(path, 3).chain, np.arange(0.0, 0.5, 0.01)
    chain.model.opt.gravity[:] = 0.0
    still = np.broadcast_to(q, (len(time), 3))
    log = run_of("still", time, still, 0.0 * still)
    assert_allclose(simulate_commands(chain, log, still, str(path)), still, atol=1e-9)


FILTERED = (
    '<general dyntype="filter" dynprm="0.05" gainprm="2000" biastype="affine" '
    'biasprm="0 -2000 -200" '
)


@pytest.mark.parametrize("servo", [FILTERED, '<position kp="2000" kv="200" timeconst="0.05" '])
def test_servos_with_a_filter_are_read_and_named(servo, tmp_path):
    """They begin where the log does, not at 0; what is not corrected of them is said."""
    path, q = tmp_path / "filtered.xml", np.array([0.4, -0.3, 0.5])
    path.write_text(build_motor_model_xml(three_joints()).decode().replace("<motor ", servo))
    chain, time = open_model(path, 3).chain, np.arange(0.0, 4.0, 0.01)
    chain.model.opt.gravity[:] = 0.0
    still = np.broadcast_to(q, (len(time), 3))
    log = run_of("still", time, still, 0.0 * still)
    assert_allclose(simulate_commands(chain, log, still, str(path)), still, atol=1e-9)
    shake = np.sin(np.outer(time, [2.0, 3.0, 5.0]))
    log = replace(run_of("run", time, shake, 5.0 * shake), command=shake)
    silent = replace(log, torque=0.0 * shake, unit=NO_TORQUE_UNIT)
    with pytest.raises(
        mc.OptionError, match=r"servos of joint1, joint2, joint3 filter their commands"
    ):
        mc.motion_gap(path, [silent, replace(silent, name="two")])


def test_no_link_grows_in_place_of_a_rotor(tmp_path):
    """Torques tell J1's rotor from no mass off its axis: what is nearer to the drawing counts."""
    rotors = replace(LACKS, armature=np.array([6.0, 5.0, 2.0]))
    arm, out = (
        DrivenArm(three_joints(), build_motor_model_xml(three_joints()), rotors, 3, STEP),
        "new.xml",
    )
    mc.motion_gap(write_model_file(arm, tmp_path), simulate_logs(arm, 3, 8.0), driven=False,
                  write=tmp_path / out)  # fmt: skip
    found, real = mujoco.MjModel.from_xml_path(str(tmp_path / out)), arm.compile_real_arm()
    assert_allclose(found.dof_armature, real.dof_armature, rtol=0.02)
    assert_allclose(found.body_mass[1:], real.body_mass[1:], rtol=0.1)


def test_currents_need_drive_gains(made, tmp_path,
                                   capsys):  # fmt: skip
    log = tmp_path / "currents.csv"
    log.write_text(made.logs[0].read_text().replace("_Nm", "_A").replace("tau", "i"))
    assert run("gap", made.model, log) == 2
    assert "drive-gain" in capsys.readouterr().err


def test_options_of_logs_are_none_of_poses(made, tmp_path,
                                           capsys):  # fmt: skip
    poses = tmp_path / "poses.csv"
    poses.write_text("q1_rad,q2_rad,q3_rad,x_mm,y_mm,z_mm\n0,0,0,1,2,3\n")
    assert run("gap", made.model, poses, "--payload", "1") == 2
    assert "payload" in capsys.readouterr().err


# ---- bodies ------------------------------------------------------------------------------------


def test_a_pseudo_inertia_holds_what_its_parameters_do():
    parameters = compute_link_inertial_parameters(2.0, np.array([0.1, -0.2, 0.3]),
                                 np.array([0.5, 0.01, 0.02, 0.6, -0.03, 0.4]))  # fmt: skip
    pseudo = bodies.pseudo_inertia_from_parameters(parameters)
    assert_allclose(bodies.parameters_from_pseudo_inertia(pseudo), parameters, atol=1e-15)
    assert_allclose(bodies.nearest_physical_body(pseudo), pseudo, atol=1e-15)
    values = bodies.inertial_attributes(pseudo)
    again = bodies.pseudo_inertia_from_inertia(2.0, values["pos"], about_of(values))
    assert_allclose(again, pseudo, atol=1e-14)


def about_of(values: dict[str, np.ndarray]) -> np.ndarray:
    """Inertia (3, 3) of attributes of an <inertial>."""
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, values["quat"])
    turn = out.reshape(3, 3)
    return turn @ np.diag(values["diaginertia"]) @ turn.T


def test_a_body_as_thin_as_a_plate_is_one_that_mujoco_takes():
    plate = bodies.pseudo_inertia_from_inertia(
        2.0, np.zeros(3), np.diag([0.1, 0.2, 0.3])
    )  # no height at all
    values = bodies.inertial_attributes(plate)
    low, middle, high = np.sort(values["diaginertia"])
    assert low + middle > high
    assert_allclose(np.sort(values["diaginertia"]), [0.1, 0.2, 0.3], rtol=1e-5)


def test_slopes_are_the_derivatives_of_the_links():
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(2, 4, 4))
    drawn = factor @ np.swapaxes(factor, 1, 2)
    turn = np.array([np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0])])
    arm = bodies.ModelBodies(drawn, np.zeros((2, 4, 4)), turn)
    at = 0.3 * rng.normal(size=(2, 10))
    slopes = arm.link_parameter_jacobian(at)
    for k in range(10):
        step = np.zeros((2, 10))
        step[:, k] = 1e-6
        there, back = (
            arm.link_parameters(arm.at_coordinates(at + side * step)) for side in (1.0, -1.0)
        )
        assert_allclose(slopes[:, k], (there - back) / 2e-6, rtol=1e-6, atol=1e-7)
    assert np.linalg.eigvalsh(arm.at_coordinates(at)).min() > 0.0


def test_a_bounded_fit_stops_at_its_bound():
    matrix = np.array([[1.0, 0.5], [0.5, 1.0], [0.1, 0.1]])
    found = minimise_squares_with_bounds(
        lambda x: matrix @ x - [1.0, -1.0, 0.0], lambda x: matrix, np.ones(2), np.zeros(2)
    )
    assert_allclose(found, [0.5 / 1.26, 0.0], atol=1e-6)


def test_damping_that_levels_off_falls_nowhere():
    v = np.linspace(0.0, 5.0, 200)
    for speed in (0.5, 2.0):
        assert (np.diff(speed_powers(v) @ levelling_damping_coefficients(speed)) >= -1e-12).all()


def test_the_damper_of_a_servo_is_no_friction(tmp_path):
    """Joints of an exported file hold the dampers of their servos: not along logs."""
    path = tmp_path / "arm.xml"
    assert run("export", "ur10", "--to", "mjcf", "-o", path) == 0
    model = mujoco.MjModel.from_xml_path(str(path))
    opened = open_model(path, 6).chain.model
    assert (opened.dof_damping == 0.0).all()
    np.testing.assert_allclose(-opened.actuator_biasprm[:, 2], model.dof_damping, rtol=1e-12)
    np.testing.assert_array_equal(opened.actuator_gainprm, model.actuator_gainprm)
    text = path.read_text().replace('kv="0.0"', 'kv="10"')  # it has one of its own: friction then
    path.write_text(text)
    np.testing.assert_array_equal(open_model(path, 6).chain.model.dof_damping, model.dof_damping)
