"""Whole programs: their points corrected, everything else byte for byte."""

import re

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.compensation.joint_compensation import compensate
from minimax_cal.compensation.programs import krl, rapid
from minimax_cal.compensation.programs.program_text import CORRECTION_MARK
from minimax_cal.compensation.programs.robot_program import read_robot_program
from minimax_cal.core.errors import DataError

JOINTS = np.array(
    [
        [0.3, 0.2, 0.1, 0.5, 0.8, -0.4],
        [-0.6, 0.4, -0.2, -0.3, 0.9, 0.7],
        [0.9, 0.1, 0.3, 1.2, 0.6, 2],
    ]
)
TOOL = np.array([20.0, -10.0, 150.0, np.cos(0.2), 0.0, np.sin(0.2), 0.0])
WORK = np.array([100.0, 50.0, 20.0, np.cos(0.1), 0.0, 0.0, np.sin(0.1)])
DIGITS = 2e-9  # of a file: 1e-6 mm, and 1e-9 of a quaternion at a metre [m]
AXES = "[0,0,0,0],[0,0,0,0,0,0]];"


def pose(numbers: np.ndarray) -> np.ndarray:
    """Of x, y, z [mm] and w, x, y, z."""
    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat(numbers[[4, 5, 6, 3]]).as_matrix()
    out[:3, 3] = 1e-3 * numbers[:3]
    return out


def robtarget(place: np.ndarray, q: np.ndarray) -> str:
    """As RAPID writes it."""
    x, y, z, w = Rotation.from_matrix(place[:3, :3]).as_quat()
    xyz = ",".join(f"{1e3 * v:.6f}" for v in place[:3, 3])
    cf = ",".join(str(int(np.floor(q[j] / (np.pi / 2)))) for j in (0, 3, 5))
    quat = ",".join(f"{v:.9f}" for v in (w, x, y, z))
    return f"[[{xyz}],[{quat}],[{cf},0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]]"


def module(robot: mc.Robot) -> str:
    """A made-up module: comments, strings, CRLF, a letter that is no ASCII, odd spaces."""
    places = np.linalg.inv(pose(WORK)) @ robot.pose(JOINTS) @ pose(TOOL)
    points = [robtarget(p, q) for p, q in zip(places, JOINTS, strict=True)]
    tool, work = (f"[{list(map(float, v[:3]))},{list(map(float, v[3:]))}]" for v in (TOOL, WORK))
    frames = [
        f"PERS tooldata tGrip:=[TRUE,{tool},[1,[0,0,1],[1,0,0,0],0,0,0]];",
        f'TASK PERS wobjdata wTable:=[FALSE,TRUE,"",{work},[[0,0,0],[1,0,0,0]]];',
    ]
    lines = [
        "MODULE Made_up", "  ! robtarget pX:=[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9]] im Gef\xe4\xdf",
        *frames, f"  CONST robtarget p10:={points[0]};", f"  VAR robtarget  p20 := {points[1]} ;",
        "  CONST jointtarget home:=[[10.000000,20.000000,-5.000000,0,30.000000,0],"
        "[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]];",
        "  CONST robtarget pSame:=p10;",
        "  PROC main()", '    TPWrite "robtarget p9:=[[1,2,3],[1,0,0,0],[0,0,0,0],[0]];";',
        "    MoveAbsJ home,v1000,fine,tGrip\\WObj:=wTable;",
        "    MoveL p10,v1000,z10,tGrip\\WObj:=wTable;",
        f"    MoveJ {points[2]},v200,z1,tGrip\\WObj:=wTable;", "  ENDPROC", "ENDMODULE", "",
    ]  # fmt: skip
    return "\r\n".join(lines)


def data_list(robot: mc.Robot) -> str:
    """A made-up KRL data list and its motions."""
    out = ["&ACCESS RVP", "DEFDAT made_up", "; E6POS XOLD={X 1,Y 2,Z 3,A 0,B 0,C 0,S 2,T 3}"]
    for number, (place, q) in enumerate(zip(robot.pose(JOINTS), JOINTS, strict=True)):
        a, b, c = Rotation.from_matrix(place[:3, :3]).as_euler("ZYX", degrees=True)
        x, y, z = 1e3 * place[:3, 3]
        bits = sum(1 << i for i in range(6) if q[i] < 0)
        body = f"X {x:.6f},Y {y:.6f},Z {z:.6f},A {a:.8f},B {b:.8f},C {c:.8f}"
        if number < 2:
            out.append(f"DECL E6POS XP{number}={{{body},S 2,T {bits},E1 0.0,E2 0.0}}")
        else:
            out.append(f"  LIN {{{body}}} C_DIS")
    out += ["DECL FRAME TABLE={X 1.5,Y 2,Z 3,A 0,B 0,C 0}", "E6AXIS HOME={A1 0.000000,A2 10.000000,"
            "A3 20.0,A4 0,A5 30,A6 0}", "ENDDAT"]  # fmt: skip
    return "\n".join(out)


def unmarked(made: bytes) -> bytes:
    """A corrected program without the line that tells so."""
    lines = made.splitlines(keepends=True)
    rest = [line for line in lines if CORRECTION_MARK.encode() not in line]
    assert len(rest) == len(lines) - 1
    return b"".join(rest)


@pytest.mark.parametrize("language", ["rapid", "krl"])
def test_the_calibrated_arm_reaches_the_points(language, fit, robot, tmp_path):
    """What the controller makes of the new numbers brings the calibrated flange to the old ones."""
    name, text = ("a.mod", module(robot)) if language == "rapid" else ("a.dat", data_list(robot))
    frames = ("tGrip", "wTable") if language == "rapid" else ()
    (tmp_path / name).write_bytes(text.encode("latin-1"))
    before = read_robot_program(tmp_path / name, robot, *frames)
    found = compensate(fit, before.data, robot, frame="own")
    assert not found.failed.any()
    (tmp_path / f"new_{name}").write_bytes(unmarked(before.format_corrected(found)))
    after = read_robot_program(tmp_path / f"new_{name}", robot, *frames)
    assert len(after.points) == 4
    posed = [i for i, point in enumerate(before.points) if point.pose is not None]
    q_old, q_new = before.data.q, after.data.q
    assert posed == ([0, 1, 3] if language == "rapid" else [0, 1, 2])
    assert_allclose(q_old[posed], JOINTS, rtol=0, atol=1e-6)
    assert_allclose(fit.robot.pose(q_new), robot.pose(q_old), rtol=0, atol=2 * DIGITS + 1e-5)
    assert np.abs(fit.robot.pose(q_old) - robot.pose(q_old))[..., :3, 3].max() > 1e-4
    assert_allclose(q_new, found.q, rtol=0, atol=1e-7)


@pytest.mark.parametrize("language", ["rapid", "krl"])
def test_all_else_stays_byte_for_byte(language, fit, robot, tmp_path):
    name, text = ("a.mod", module(robot)) if language == "rapid" else ("a.src", data_list(robot))
    frames = ("tGrip", "wTable") if language == "rapid" else ()
    (tmp_path / name).write_bytes(text.encode("latin-1"))
    program = read_robot_program(tmp_path / name, robot, *frames)
    same = program.text.replace_numbers([])
    assert same == text
    found = compensate(fit, program.data, robot)
    made = unmarked(program.format_corrected(found)).decode("latin-1")
    spans = [
        n for p in program.points for n in (*p.pose_or_joint_numbers, *p.configuration_numbers)
    ]
    old, new, at_old, at_new = text, made, 0, 0
    for number in sorted(spans, key=lambda n: n.start):
        kept = old[at_old : number.start]
        assert new[at_new : at_new + len(kept)] == kept
        at_new += len(kept)
        at_new = re.compile(r"[-+.\dEe]+").match(new, at_new).end()
        at_old = number.stop
    assert new[at_new:] == old[at_old:]
    lines = [(a, b) for a, b in zip(text.splitlines(), made.splitlines(), strict=True) if a != b]
    assert len(lines) == 4


def test_angles_and_quaternions_stay_near_what_was_there(rng):
    """Through the singular B = 90 degrees, and with the other sign of a quaternion."""
    for b in (90.0, 89.9999, -90.0, 12.0):
        text = f"PTP {{X 1,Y 2,Z 3,A 100,B {b},C -170,S 2,T 2}}"
        (point,) = krl.find_points(krl.parse_program(text, "a.src"))
        assert point.pose is not None
        numbers = np.array([float(v) for v in krl.format_pose_numbers(point.pose, point)])
        again = Rotation.from_euler("ZYX", numbers[3:], degrees=True).as_matrix()
        assert_allclose(again, point.pose[:3, :3], rtol=0, atol=1e-8)
    text = "robtarget p:=[[1,2,3],[-0.5,0.5,-0.5,0.5],[0,0,0,0],[0,0,0,0,0,0]];"
    (point,) = rapid.find_points(rapid.parse_program(text, "a.mod"))
    assert point.pose is not None
    assert [float(v) for v in rapid.format_pose_numbers(point.pose, point)] == [
        1,
        2,
        3,
        -0.5,
        0.5,
        -0.5,
        0.5,
    ]


def test_a_quarter_turn_that_changed_is_told():
    text = "robtarget p:=[[1,2,3],[1,0,0,0],[0,-1,0,1],[0,0,0,0,0,0]];"
    (point,) = rapid.find_points(rapid.parse_program(text, "a.mod"))
    before, after = np.array([1e-4, 0, 0, -0.1, 0, 0.3]), np.array([-1e-4, 0, 0, -0.1, 0, 0.3])
    assert rapid.has_programmed_configuration(point, before)
    assert [
        (n.value, new) for n, new in rapid.list_configuration_changes(point, before, after)
    ] == [(0.0, "-1")]
    (point,) = krl.find_points(krl.parse_program("PTP {X 1,Y 2,Z 3,A 0,B 0,C 0,S 2,T 8}", "a.src"))
    assert krl.has_programmed_configuration(point, before)
    assert [new for _, new in krl.list_configuration_changes(point, before, after)] == ["9"]


@pytest.mark.parametrize(
    ("name", "text", "options", "said"),
    [
        ("a.mod", "MODULE a\nENDMODULE", [], "holds no points"),
        ("a.mod", "\nCONST robtarget p:=[[1,2],[1,0,0,0]," + AXES, [], "a.mod:2"),
        ("a.mod", "robtarget p:=[[x,2,3],[1,0,0,0]," + AXES, [], "'x' is no number"),
        ("a.mod", "robtarget p:=[[1,2,3],[1,1,0,0]," + AXES, [], "must be 1"),
        ("a.mod", "robtarget p:=[[9E9,2,3],[1,0,0,0]," + AXES, [], "no coordinate"),
        ("a.mod", "robtarget p:=[[9000,2,3],[1,0,0,0]," + AXES, [], "out of reach"),
        ("a.mod", "robtarget p:=[[900,2,900],[1,0,0,0]," + AXES + "\nMoveL p,v1,z1,tX;",
         [], "a.mod:2: moves with tX"),
        ("a.mod", "robtarget p:=[[900,2,900],[1,0,0,0]," + AXES,
         ["--tool", "tY"], "--tool tY"),
        ("a.src", "E6POS P={X 1,Y 2,Z 3,A 0,B 0,C 0,S 2,X 4}", [], "X stands twice"),
        ("a.src", "PTP {X 1,Y 2,Z q,A 0,B 0,C 0}", [], "no number"),
        ("a.dat", "\0", [], "is no text"),
        ("a.csv", "q1_deg\n1\n", ["--tool", "t"], "go with a program"),
    ],
)  # fmt: skip
def test_a_wrong_program_is_one_line(name, text, options, said, fit, tmp_path, says):  # fmt: skip
    fit.save(tmp_path / "fit.json")
    (tmp_path / name).write_text(text)
    err = says("compensate", tmp_path / "fit.json", tmp_path / name, *options, code=2).err
    assert said in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    "change",
    ["tGrip.tframe.trans.z:=tGrip.tframe.trans.z+5;", "IF di1=1 wTable.oframe:=PoseVect(x);",
     "tGrip := tOther;", "wTable.uframe.trans:=[1,2,3];"],
)  # fmt: skip
def test_frames_that_the_run_writes_are_refused(change, robot, tmp_path):
    """Nobody knows where the points are then; a correction would be wrong in silence."""
    text = module(robot).replace("  PROC main()", f"  PROC main()\r\n    {change}")
    (tmp_path / "a.mod").write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError, match=r"a\.mod:10: the program changes (tGrip|wTable)"):
        read_robot_program(tmp_path / "a.mod", robot, "tGrip", "wTable")
    other = text.replace(change, change.replace("tGrip", "tOther").replace("wTable", "wOther"))
    (tmp_path / "a.mod").write_bytes(other.encode("latin-1"))
    assert read_robot_program(tmp_path / "a.mod", robot, "tGrip", "wTable").points


def test_coordinates_that_the_run_writes_are_said(robot, tmp_path):
    before = "    MoveL p10,"
    text = module(robot).replace(before, f"    IF a=1 p10.trans.z:=p10.trans.z+5;\r\n{before}")
    (tmp_path / "a.mod").write_bytes(text.encode("latin-1"))
    notices = read_robot_program(tmp_path / "a.mod", robot, "tGrip", "wTable").data.notices
    assert [n.partition(": ")[2] for n in notices] == [
        "at line 12 the run writes p10.trans.z: what it writes is not corrected"
    ]
    (tmp_path / "a.src").write_text(data_list(robot) + "\nXP0.Z = XP0.Z + 5\n")
    assert "XP0.Z" in " ".join(read_robot_program(tmp_path / "a.src", robot).data.notices)


def test_external_axes_are_said(robot, tmp_path):
    """A track carries the arm to where no correction knows it."""
    none, path = "9E+09,9E+09,9E+09,9E+09,9E+09,9E+09", tmp_path / "a.mod"
    for values, said in (
        (("1500,9E+09", "0,9E+09", "2000.5,9E+09", "0,9E+09"), "eax_a stands from 0 to 2000.5;"),
        (("0,30", "0,30", "0,30", "0,30"), "eax_b stands at 30;"),
        (("0,9E9", "0,9E9", "0,9E9", "0,9E9"), ""),
    ):
        text = module(robot)
        for value in values:
            text = text.replace(f"[{none}]", f"[{value},9E9,9E9,9E9,9E9]", 1)
        path.write_bytes(text.encode("latin-1"))
        notices = " ".join(read_robot_program(path, robot, "tGrip", "wTable").data.notices)
        assert ("external axis" in notices) == bool(said)
        assert said in notices
    (tmp_path / "a.src").write_text(data_list(robot).replace("E1 0.0", "E1 250.0", 1))
    assert "axis E1 stands from 0 to 250;" in " ".join(
        read_robot_program(tmp_path / "a.src", robot).data.notices
    )


def test_the_command_writes_a_program(fit, robot, tmp_path):
    fit.save(tmp_path / "fit.json")
    (tmp_path / "a.mod").write_bytes(module(robot).encode("latin-1"))
    words = ["compensate", tmp_path / "fit.json", tmp_path / "a.mod", "--tool", "tGrip"]
    assert run(*words, "--wobj", "wTable", "-o", tmp_path / "b.mod") == 0
    made = unmarked((tmp_path / "b.mod").read_bytes())
    assert made.count(b"\r\n") == module(robot).count("\r\n")
    assert b"Gef\xe4\xdf" in made
