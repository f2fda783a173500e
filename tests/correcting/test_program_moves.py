"""What programs move with and go by: told tools are heeded, and what stays as it is is said."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.compensation.joint_compensation import compensate
from minimax_cal.compensation.programs import krl, rapid
from minimax_cal.compensation.programs.program_text import CORRECTION_MARK
from minimax_cal.compensation.programs.robot_program import RobotProgram, read_robot_program

Q = np.array([0.3, 0.2, 0.1, 0.5, 0.8, 0.4])
TOOL = "PERS tooldata tGrip:=[TRUE,[[20,0,150],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];"
NOWHERE = "0,0,0,1,0,0,0"
JOINTS = "{A1 10,A2 20,A3 -10,A4 30,A5 40,A6 50}"


@pytest.fixture
def target(robot: mc.Robot) -> str:
    """A robtarget that the flange reaches."""
    place = robot.pose(Q)
    x, y, z, w = Rotation.from_matrix(place[:3, :3]).as_quat()
    at = ",".join(f"{1e3 * v:.6f}" for v in place[:3, 3])
    return f"[[{at}],[{w:.9f},{x:.9f},{y:.9f},{z:.9f}],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"


@pytest.fixture
def place(robot: mc.Robot) -> str:
    """The same in KRL, without S and T."""
    pose = robot.pose(Q)
    x, y, z = 1e3 * pose[:3, 3]
    a, b, c = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX", degrees=True)
    return f"X {x:.6f},Y {y:.6f},Z {z:.6f},A {a:.8f},B {b:.8f},C {c:.8f}"


def opened(path: Path, text: str, *frames: str) -> RobotProgram:
    """A program of the IRB 2600."""
    path.write_text(text)
    return read_robot_program(path, mc.load_robot("irb2600"), *frames)


def weld(target: str, *moves: str) -> str:
    """A module of one point."""
    first = ["MODULE weld(SYSMODULE)", TOOL, f"CONST robtarget p1:={target};"]
    return "\n".join([*first, "PROC main()", *moves, "ENDPROC", "ENDMODULE"])


@pytest.mark.parametrize(
    "move",
    [
        "MoveL p1,v100,fine,tGrip;",
        "ArcL p1,v100,seam1,weld1,fine,tGrip;",
        "ArcLStart p1, v100, seam1, weld1, fine, tGrip \\WObj:=wobj0;",
        "ArcC p1,p1,v100,seam1,weld1,fine,tGrip,\\WObj:=wobj0;",
        "TriggL p1,v100,trig1,fine,tGrip;",
        "TRIGGJ p1,v100,trig1\\T2:=trig2,fine,TGRIP;",
        "TriggLIOs p1,v100\\TriggData1:=t1,z5,tGrip;",
        "SearchL\\Stop,di1,pFound,p1,v100,tGrip;",
        "SpotL p1,v100,gun1,spot1,tGrip;",
        "DispL p1,v100,bead1,z1,tGrip;",
        "MoveLDO p1,v100,z10,tGrip,do1,1;",
        'MoveCSync p1,p1,v100,z10,tGrip,"after";',
        "MoveL Offs(p1,0,0,10),v100,\n  z1,\n  tGrip;",
        "IF ready MoveL p1,v100,z1,tGrip;",
        "pick p1,v100,tGrip;",
        "pick RelTool(p1,0,0,9),tGrip\\fast;",
    ],
)
def test_no_motion_hides_its_tool(move, target, tmp_path):
    """Refused as the plain move is, and taken where the tool is named."""
    text = weld(target, "! of tools", move)
    with pytest.raises(mc.CalibrationError, match=r"a\.mod:6: moves with tGrip, not with tool0"):
        opened(tmp_path / "a.mod", text.replace("TGRIP", "tGrip"))
    gripped = opened(tmp_path / "a.mod", text, "20,0,150,1,0,0,0")
    assert_allclose(opened(tmp_path / "a.mod", text, "tGrip").data.q, gripped.data.q, atol=1e-9)
    assert not gripped.data.notices


@pytest.mark.parametrize(
    ("moves", "said"),
    [
        (("MoveL p1,v100,fine,tools{ 1 };",), r"a\.mod:5: moves with tools\{1\}.*give tool=x,y,z"),
        (("ArcL p1,v1,s1,w1,fine,tool0\\WObj:=wT;",), r"moves with wT, not with wobj0"),
        (("TriggL p1,v1,g1,fine,tool0\\WObj?wT;",), r"moves with wT, not with wobj0"),
        (("MoveL p1,v1,z1,tool0;", "ArcL p1,v1,s1,w1,z1,tGrip;"), r"a\.mod:6: moves with tGrip"),
    ],
)
def test_other_tools_and_work_objects_are_refused(moves, said, target, tmp_path):
    with pytest.raises(mc.CalibrationError, match=said):
        opened(tmp_path / "a.mod", weld(target, *moves))


@pytest.mark.parametrize(
    "displaced", ["PDispSet frame1;", "  PDispOn\\Rot, p1, tool0;", "pdispon p1,tool0;"]
)
def test_displaced_points_are_refused(displaced, target, tmp_path):
    """Unless the words are in a comment, or end a displacement."""
    move = "MoveL p1,v1,fine,tool0;"
    name = displaced.strip().partition(",")[0].split()[0].split("\\")[0]
    with pytest.raises(mc.CalibrationError, match=rf"a\.mod:6: {name} displaces the points"):
        opened(tmp_path / "a.mod", weld(target, move, displaced, move))
    assert opened(tmp_path / "a.mod", weld(target, "! " + displaced, "PDispOff;", move)).points


def test_numbers_are_no_two_tools(target, tmp_path):
    text = weld(target, "MoveL p1,v1,z1,tA;", "MoveAbsJ home,v1,z1,tool0;", "SpotL p1,v1,g,s,tB;")
    with pytest.raises(mc.CalibrationError, match=r"a\.mod:7: moves with tB, at line 5 with tA"):
        opened(tmp_path / "a.mod", text, NOWHERE)
    assert opened(tmp_path / "a.mod", text.replace("tB", "tA"), NOWHERE).data.poses == 1


@pytest.mark.parametrize(
    ("moves", "said"),
    [
        (("pick p1,5;", "MoveL p1,v1,z1,tool0;"),
         [" moves at line 5 do not tell the tool and work object of"]),
        (("ENDPROC", "PROC to(robtarget p,PERS tooldata t)", "MoveL p,v1,z1,t;"),
         [" moves at line 7 do not tell the tool of"]),
        (("ENDPROC", "PROC to(robtarget p)", "MoveL p,v1,z1,tool0;", "to p1;"), []),
        (("ENDPROC", "PROC MoveLow(robtarget p)", "MoveL p,v1,z1,tool0;", "MoveLow p1;"), []),
        (("p2:=Offs(p1,0,0,9);", "WaitTime 1;", "TriggCheckIO c1,1,d1,EQ,1,i1;", "grip 3,n1;"),
         [" does not tell the tool and work object of"]),
    ],
)  # fmt: skip
def test_a_tool_that_is_not_told_is_said(moves, said, target, tmp_path):
    notices = opened(tmp_path / "a.mod", weld(target, *moves)).data.notices
    assert len(notices) == len(said)
    assert all(word in notice for word, notice in zip(said, notices, strict=True))


def test_points_are_found_wherever_they_stand(target):
    """In a motion of an option, in a call of a routine, and where a variable is set."""
    lines = [f"ArcL {target},v1,s1,w1,z1,tool0;", f"pick {target},tool0;", "VAR robtarget p2;",
             f"p2:={target};", "p3:=[[1,2,3],[1,0,0,0],[0,0,0,0],[0,0,0,0,0,0]];"]  # fmt: skip
    found = list(rapid.find_points(rapid.parse_program(weld(target, *lines), "a.mod")))
    assert sorted(point.line for point in found) == [3, 5, 6, 8]


def axes_and(place: str, *lines: str) -> str:
    """A program of KRL with a point and lines of a test, the first of them line 4."""
    return "\n".join(["DEF a()", f"PTP {JOINTS}", f"PTP {{{place},S 2,T 0}}", *lines, "END"])


@pytest.mark.parametrize(
    ("line", "told", "option"),
    [
        ("$TOOL = TOOL_DATA[3]", "TOOL_DATA[3]", "tool"),
        ("bas (#tool, 3)", "TOOL_DATA[3]", "tool"),
        ("$ACT_TOOL=3", "TOOL_DATA[3]", "tool"),
        ("$tool={X 0,Y 0,Z 200,A 0,B 0,C 0}", "{X0,Y0,Z200", "tool"),
        ("$TOOL.Z=200", "$TOOL.Z", "tool"),
        ("FDAT_ACT={TOOL_NO 3,BASE_NO 0,IPO_FRAME #BASE}", "TOOL_DATA[3]", "tool"),
        ("DECL FDAT FP1={TOOL_NO 0,BASE_NO 2,IPO_FRAME #BASE}", "BASE_DATA[2]", "wobj"),
        ("$BASE=table", "TABLE", "wobj"),
        ("BAS(#BASE,2)", "BASE_DATA[2]", "wobj"),
    ],
)
def test_krl_moves_with_the_tool_and_the_base_it_tells(line, told, option, place, tmp_path):
    """Refused as a module of RAPID is, and taken where numbers say what they are."""
    text = axes_and(place, line)
    said = rf"a\.src:4: moves with {re.escape(told)}.*not with \$NULLFRAME; give {option}=x,y,z"
    with pytest.raises(mc.CalibrationError, match=said):
        opened(tmp_path / "a.src", text)
    assert opened(tmp_path / "a.src", text, NOWHERE, NOWHERE).data.poses == 2


def test_krl_of_the_flange_and_of_joints_asks_for_no_tool(place, tmp_path):
    lines = ("$TOOL=$NULLFRAME", "BAS(#BASE,0)", "$BASE={X 0,Y 0.0,Z 0,A 0,B 0,C 0}",
             "IF $TOOL == grip THEN")  # fmt: skip
    assert not opened(tmp_path / "a.src", axes_and(place, *lines)).data.notices
    fdat = f"DECL E6AXIS XP1={JOINTS}\nDECL FDAT FP1={{TOOL_NO 3,BASE_NO 2}}"
    assert not opened(tmp_path / "a.dat", fdat).data.notices
    lines = (*fdat.splitlines(), "$TOOL=TOOL_DATA[1]", "$BASE=$WORLD")
    assert opened(tmp_path / "a.src", axes_and(place, *lines), NOWHERE).data.poses == 3


def test_krl_of_several_tools_is_refused_and_of_none_is_said(place, tmp_path):
    lines = ("DECL FDAT FP1={TOOL_NO 3,BASE_NO 2}", "DECL FDAT FP2={TOOL_NO 4,BASE_NO 2}")
    with pytest.raises(mc.CalibrationError, match=r"line 4 with TOOL_DATA\[3\].*split the file"):
        opened(tmp_path / "a.src", axes_and(place, *lines), NOWHERE, NOWHERE)
    said = opened(tmp_path / "a.src", axes_and(place)).data.notices
    assert len(said) == 1
    assert "does not tell the tool and work object of the points" in said[0]
    assert not opened(tmp_path / "a.src", axes_and(place), NOWHERE, NOWHERE).data.notices


def test_relative_motions_and_offsets_stay(fit, place, tmp_path):
    """Byte for byte, each line said; points beside them are corrected."""
    kept = [
        f"PTP_REL {JOINTS}", "LIN_REL {E6POS: X 10,Y 0,Z 0,A 0,B 0,C 0}", "slin_rel {Z 5}",
        "CIRC_REL {X 1,Y 0,Z 0,A 0,B 0,C 0},{X 2,Y 0,Z 0,A 0,B 0,C 0}",
        "LIN XP : {X 0,Y 0,Z 50,A 0,B 0,C 0}", "LIN {X 0,Y 0,Z 50,A 0,B 0,C 0,S 2} : XP",
        f"DECL E6AXIS STEP={JOINTS}", "PTP_REL STEP", "PTP {A1 30}", "PTP {X 1000,Y 0,Z 1000}",
        "DECL E6POS XA", f"XA={{{place}}}"[:-20] + "}", "LIN shift:XP",
        "shift={X 0,Y 0,Z 9,A 0,B 0,C 0}", "table={X 9,Y 0,Z 9,A 0,B 0,C 0}", "$BASE=$NULLFRAME",
        "$TOOL=$NULLFRAME", "DECL LDAT L={VEL 2.0,ACC 100}",
    ]  # fmt: skip
    spline = (f"SPL {{{place}}}", f"XP={{{place}}}", "CIRC XH,XP", f"XH={{{place}}}")
    program = opened(tmp_path / "a.src", axes_and(place, *kept, *spline))
    (said,) = program.data.notices
    assert "12 points are left as programmed, at line 4, 5, 6, 7, 8, 9, 10, 12 ...:" in said
    assert list(krl.find_unchanged_point_lines(program.text))[8:] == [12, 13, 15, 17]
    assert [point.line for point in program.points] == [2, 3, 22, 23, 25]
    made = (
        program.format_corrected(compensate(fit, program.data, program.robot)).decode().splitlines()
    )
    assert made[4 : 4 + len(kept)] == kept
    assert not set(made) & {spline[0], spline[1], spline[3]}
    assert made[1] == f"; {CORRECTION_MARK}"


def test_a_program_of_offsets_alone_is_refused(tmp_path):
    with pytest.raises(mc.CalibrationError, match="no points with numbers, only relative motions"):
        opened(tmp_path / "a.src", "LIN_REL {Z 5}\nLIN XP:{X 0,Y 0,Z 5,A 0,B 0,C 0}\n")


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("a.mod", "%%%\r\n VERSION:1\r\n%%%\r\nMODULE m(SYSMODULE,\r\n NOVIEW) ! of m\r\n{}", 6),
        ("a.mod", "MODULE m {}", 2),
        ("a.mod", "{}", 1),
        ("a.dat", "&ACCESS RVP\nDEFDAT m PUBLIC ; of m\n{}", 3),
    ],
)
def test_a_program_is_corrected_once(name, text, line, fit, target, place, tmp_path, says):
    """A comment tells that it was, and nothing else changes but the numbers."""
    body = f"CONST robtarget p1:={target};" if name == "a.mod" else f"E6POS X={{{place},S 2,T 0}}"
    fit.save(tmp_path / "fit.json")
    (tmp_path / name).write_bytes(text.format(body).encode())
    words = ["compensate", tmp_path / "fit.json"]
    assert run(*words, tmp_path / name, "-o", tmp_path / f"b_{name}", "-q") == 0
    made = (tmp_path / f"b_{name}").read_bytes().decode()
    assert made.splitlines()[line - 1][2:] == CORRECTION_MARK
    assert made.count("\r") == (made.count("\n") if "\r" in text else 0)
    rest = re.sub(rf"\s*[!;] {CORRECTION_MARK}\s*", "", made)
    numbers = re.compile(r"-?\d+\.\d+")
    assert numbers.sub("", "".join(rest.split())) == numbers.sub("", "".join(
        text.format(body).split()))  # fmt: skip
    err = says(*words, tmp_path / f"b_{name}", "-o", tmp_path / f"c_{name}", code=2).err
    assert f"b_{name}:{line}: these points are corrected already" in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / f"c_{name}").exists()


@pytest.mark.parametrize(("given", "out"), [("a.mod", "b.csv"), ("a.csv", "b.mod"),
                                            ("a.mod", "b.src"), ("a.txt", "b.dat")])  # fmt: skip
def test_a_program_goes_into_no_table_nor_a_table_into_a_program(given, out, fit, tmp_path, says):
    fit.save(tmp_path / "fit.json")
    (tmp_path / given).write_text("")
    err = says(
        "compensate", tmp_path / "fit.json", tmp_path / given, "-o", tmp_path / out, code=2
    ).err
    assert f"{out}: " in err
    assert f"end it {'.mod' if given == 'a.mod' else '.csv'}" in err
    assert len(err.splitlines()) == 1


def test_an_arm_without_its_nominal_robot_asks_for_it(fit, tmp_path, says):
    (tmp_path / "cell.json").write_text(json.dumps(fit.cell.whole()))
    (tmp_path / "a.csv").write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n1,2,3,4,50,6\n")
    (tmp_path / "a.src").write_text(f"PTP {JOINTS}")
    for targets in ("a.csv", "a.src"):
        err = says("compensate", tmp_path / "cell.json", tmp_path / targets, code=2).err
        assert err.endswith("cell.json: does not tell its nominal robot; give --robot\n")
        assert len(err.splitlines()) == 1
