"""What people mix up of any instrument is named with its mend, which makes the file right."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from conftest import SHARED, run
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments.agreement import SimulatedArm
from minimax_cal.fitting.multi_instrument.relative_calibration import relative
from minimax_cal.instruments import flange_poses
from minimax_cal.instruments.whole_poses import propose_other_rotation_conventions

REPORTS = SHARED / "reports"
HEAD = [f"q{i}_rad" for i in range(1, 7)] + [f"flange_{axis}_mm" for axis in "xyz"]
UR5_FIXED = ("--camera-on", "flange", "--fix", "a*,d*,theta*,alpha*,beta*")


@pytest.fixture(scope="module")
def arm():
    return SimulatedArm(mc.load_robot("irb2600"), np.random.default_rng(5))


@pytest.fixture(scope="module")
def poses(arm):
    return arm.simulate_measurement("poses", 50, 2e-5)


def written(path, data, names, columns):
    """A file of whole poses with these columns of rotation."""
    table = np.c_[data.at.q, 1e3 * data.pose[:, :3, 3], columns]
    np.savetxt(path, table, "%.8f", ",", header=",".join(HEAD + names), comments="")
    return path


@pytest.mark.parametrize("order", ["ZYX", "xyz", "ZYZ", "zxy"])
@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_euler_angles_in_the_columns_of_a_rotation_vector_are_named(
    order, unit, poses, tmp_path, refuses
):
    turn = Rotation.from_matrix(poses.pose[:, :3, :3])
    names = [f"flange_r{axis}_{unit}" for axis in "xyz"]
    path = written(tmp_path / "d.csv", poses, names, turn.as_euler(order, unit == "deg"))
    named = " ".join(f"R{axis}" for axis in order.lower())
    about = "moving" if order.isupper() else "fixed"
    refuses(f"about {about} axes, {named}", "calibrate", "irb2600", path)
    # what it says to do
    good = written(tmp_path / "good.csv", poses, [f"flange_r{a}_rad" for a in "xyz"],
                   turn.as_rotvec())  # fmt: skip
    assert relative("irb2600", good).status == "converged"


@pytest.mark.parametrize("order", ["", "xyz"])
def test_euler_angles_so_small_that_an_arm_nearly_fits_them_contradict_it(order, tmp_path):
    """Of poses near one another the orders differ by 10 mrad: links take a part of that."""
    arm = SimulatedArm(mc.load_robot("irb2600"), np.random.default_rng(1), "leaning", 2e-4)
    rng, middle = arm.rng, np.array([0.1, 0.2, -0.1, 0.3, 0.5, 0.2])
    q = middle + 0.1 * rng.uniform(-1.0, 1.0, (60, 6))
    seen = arm.flange_poses(q)
    seen[:, :3, 3] += 3e-5 * rng.normal(size=(60, 3))
    noise = Rotation.from_rotvec(3e-4 * rng.normal(size=(60, 3)))
    tool = Rotation.from_rotvec([0.1, -0.05, 0.08])
    base = Rotation.from_matrix(arm.flange_poses(middle[None])[0, :3, :3]).inv()
    turn = noise * base * Rotation.from_matrix(seen[:, :3, :3]) * tool
    seen[:, :3, 3] = base.apply(seen[:, :3, 3])
    columns = turn.as_euler(order) if order else turn.as_rotvec()
    names = [f"flange_r{axis}_rad" for axis in "xyz"]
    path = written(tmp_path / "near.csv", flange_poses(q, seen), names, columns)
    found = relative("irb2600", path)
    if not order:
        assert found.status == "converged"
        assert not found.contradictions
        return
    (one,) = found.contradictions
    assert found.status == "contradictory"
    assert (one.cause.kind, one.cause.place) == ("order_of_angles", "near")
    assert "fixed axes, Rx Ry Rz" in found.reason
    right = turn.as_matrix().swapaxes(1, 2) @ Rotation.from_rotvec(columns).as_matrix()
    off = Rotation.from_matrix(right).magnitude()
    assert_allclose(one.cause.by, np.sqrt((off**2).mean()), rtol=0.1)


def test_whole_poses_the_other_way_round_are_named(poses, tmp_path, refuses):
    back = np.linalg.inv(poses.pose)
    turned = flange_poses(poses.at.q, back)
    vector = Rotation.from_matrix(back[:, :3, :3]).as_rotvec()
    names = [f"flange_r{axis}_rad" for axis in "xyz"]
    path = written(tmp_path / "d.csv", turned, names, vector)
    refuses(
        "poses of the measurement frame in the flange's: invert them", "calibrate", "irb2600", path
    )


ROWS = {  # which rows of joints and of what was measured stand beside each other
    "one row above": (slice(None, -1), slice(1, None)),
    "two rows below": (slice(2, None), slice(None, -2)),
    "in reverse order": (slice(None), slice(None, None, -1)),
}


@pytest.mark.parametrize("kind", ["wires", "poses"])
@pytest.mark.parametrize("words", ROWS)
def test_rows_beside_other_joints_are_named_of_any_instrument(kind, words, arm):
    joints, own = ROWS[words]
    data = arm.simulate_measurement(kind, 50, 2e-5)
    wrong = data.take_rows(np.arange(50)[own])
    wrong = replace(wrong, at=replace(wrong.at, q=data.at.q[joints]))
    with pytest.raises(mc.DataError, match=f"{words}.*correct the file") as caught:
        relative("irb2600", wrong)
    assert "minimax-cal import" not in str(caught.value)  # which writes a tracker's points


def test_joint_columns_exchanged_are_named_of_wires(arm):
    data = arm.simulate_measurement("wires", 60, 2e-5)
    wrong = replace(data, at=replace(data.at, q=data.at.q[:, [0, 2, 1, 3, 4, 5]]))
    with pytest.raises(mc.DataError, match="columns of joints 2 and 3 look swapped"):
        relative("irb2600", wrong)


def test_a_quaternion_in_another_order_is_named(poses, tmp_path, refuses):
    turn = Rotation.from_matrix(poses.pose[:, :3, :3]).as_quat()  # scalar last
    names = [f"flange_q{a}" for a in "wxyz"]
    path = written(tmp_path / "d.csv", poses, names, turn)
    refuses("a quaternion with its scalar last", "calibrate", "irb2600", path)
    path = written(tmp_path / "e.csv", poses, names, np.roll(turn, 1, axis=1))
    assert relative("irb2600", path).status == "converged"


def test_each_reading_of_rotations_is_that_of_scipy(rng):
    angles = rng.uniform(-1.0, 1.0, (7, 3))
    found = dict(propose_other_rotation_conventions(angles))
    assert len(found) == 3 * 25 + 2
    (zyx,) = [t for text, t in found.items()
              if "moving axes, Rz Ry Rx" in text and "angles about" in text]  # fmt: skip
    one = [Rotation.from_rotvec(angle[:, None] * axis)
           for angle, axis in zip(angles.T, np.eye(3)[::-1], strict=True)]  # fmt: skip
    by_hand = (one[0] * one[1] * one[2]).as_matrix()
    assert_allclose(zyx, by_hand, atol=1e-12)


def test_rotations_that_no_convention_explains_fail(arm, poses):
    pose = poses.pose.copy()
    pose[:, :3, :3] = Rotation.random(len(pose), random_state=1).as_matrix()
    found = relative(arm.robot, flange_poses(poses.at.q, pose))
    assert found.status == "failed"
    assert "rotations" in found.reason


@pytest.mark.parametrize(
    ("factor", "words"),
    [(1.0 / 25.4, "inches given as millimetres"), (1e-3, "metres given as millimetres")],
)
def test_lengths_in_another_unit_are_named(arm, factor, words, tmp_path, refuses):
    data = arm.simulate_measurement("wires", 60, 2e-5)
    names = [f"q{i}_rad" for i in range(1, 7)] + [f"{wire}_mm" for wire in data.wires]

    def put(name, scale):
        table = np.c_[data.at.q, scale * 1e3 * data.length]
        np.savetxt(tmp_path / name, table, "%.9f", ",", header=",".join(names), comments="")
        return tmp_path / name

    refuses(words, "calibrate", "irb2600", put("d.csv", factor))
    assert run("calibrate", "irb2600", put("good.csv", 1.0)) == 0


@pytest.mark.parametrize("kind", ["tracker", "wires", "poses"])
def test_joints_that_never_move_are_said_first(arm, kind):
    data = arm.simulate_measurement(kind, 40, 2e-5)
    q = data.at.q[0] + 1e-4 * np.random.default_rng(0).normal(size=data.at.q.shape)
    still = replace(data.at, q=q)
    given = still if kind == "tracker" else replace(data, at=still)
    with pytest.raises(mc.DataError, match=r"do not move \(0\.0\d deg|the same joint values"):
        mc.calibrate(arm.robot, given)


# ---- the reports ---------------------------------------------------------------------------------


@pytest.mark.skipif(not REPORTS.exists(), reason="reports are not on this machine")
@pytest.mark.parametrize(
    ("report", "robot", "name", "words"),
    [
        ("files_disagree", "irb2600", "euler", "Euler angles about moving axes, Rz Ry Rx"),
        ("files_disagree", "irb2600", "wires_inch", "inches given as millimetres"),
        ("controller_euler", "ur5", "euler", "Euler angles about fixed axes, Rx Ry Rz"),
    ],
)
def test_reports_of_units_and_orders(report, robot, name, words, tmp_path, refuses):
    subprocess.run([sys.executable, REPORTS / f"{report}.py", tmp_path], check=True)
    refuses(words, "calibrate", robot, tmp_path / f"{name}.csv")


@pytest.mark.skipif(not REPORTS.exists(), reason="reports are not on this machine")
def test_reports_of_wrong_hand_eye_recordings(tmp_path, refuses):
    subprocess.run([sys.executable, REPORTS / "hand_eye_wrong.py", tmp_path], check=True)

    def given(joints, board):
        files = {name: tmp_path / f"{name}.csv" for name in ("detections", joints, board)}
        return (
            "calibrate", "ur5", files["detections"], "--joints", files[joints],
            "--camera", f"cam={tmp_path / 'camera.yaml'}", "--board", files[board], *UR5_FIXED,
        )  # fmt: skip

    for joints, moved in (("static", "0.00"), ("jitter", "0.03")):
        for board in ("board", "board25"):
            refuses(f"do not move ({moved} deg", *given(joints, board))
    refuses("the board is 1.20", *given("joints", "board25"))
    assert run(*given("joints", "board")) == 0
