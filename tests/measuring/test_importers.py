"""Files as trackers and controllers write them: each made here, imported, calibrated, broken."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.measuring.importers import Imported, import_files, save
from minimax_cal.modelling.simulate import Simulation
from minimax_cal.solvers.status import Status

POSES = 60
DEG = 180.0 / np.pi


def table(rows: Sequence[Sequence[object]], header: str = "", delimiter: str = ",") -> str:
    lines = [delimiter.join(c if isinstance(c, str) else f"{c:.9f}" for c in row) for row in rows]
    return "\n".join([header, *lines] if header else lines) + "\n"


def same(found: Imported, truth: mc.Measurements, targets: int = 3) -> None:
    """The import holds the simulated joints and points, and calibrates after a round trip."""
    assert_allclose(found.data.q, truth.q, rtol=0, atol=1e-8)
    assert_allclose(found.data.y, truth.y[:, :targets], rtol=0, atol=2e-9)


def calibrates(found: Imported, folder: Path) -> mc.Measurements:
    out = folder / "out.csv"
    save(out, found)
    data = mc.read_measurements(out)
    assert_allclose(data.q, found.data.q, rtol=0, atol=1e-8)
    fit = mc.calibrate("irb2600", data, objective="sum")
    assert fit.status is Status.CONVERGED
    assert fit.accuracy["holdout"].rms_mm < 0.5 < fit.accuracy["nominal"].rms_mm
    return data


@pytest.fixture
def truth(noisy: Simulation) -> mc.Measurements:
    return noisy.data


Write = Callable[[str, str | bytes], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def put(name: str, content: str | bytes) -> Path:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return put


def refused(words: str, *files: Path, **options: object) -> str:
    """The message of an import that must fail: one line with these words in it."""
    with pytest.raises(mc.CalibrationError) as caught:
        import_files(files, **options)  # type: ignore[arg-type]
    text = str(caught.value)
    assert words in text
    assert "\n" not in text
    return text


# --- Leica: one row a point, a joints file -------------------------------------------------

LEICA = (
    "X  [mm],Y  [mm],Z  [mm],U(95)  [mm],U(95) X  [mm],U(95) Y  [mm],U(95) Z  [mm],Q0 ,Q1 ,"
    "Image RMS  [µm],Target,Temperature  [°C],Pressure  [mBar],Time Stamp,OTG Applied,Delete"
)


def leica_rows(
    truth: mc.Measurements, names: Sequence[str] = ("A #1", "B #2", "C #3")
) -> list[list[object]]:
    return [
        [*(1e3 * truth.y[j, t]), f"{0.01 + 0.001 * t}", "0.003", "0.001", "0.003", "0.2", "0.5",
         "0.3", names[t], f"{20 + 0.01 * j:.2f}", "1018",
         f"'11.10.2026 15:{(3 * j + t) // 60:02d}:{(3 * j + t) % 60:02d}.500", "FALSE", ""]
        for j in range(len(truth.q))
        for t in range(3)
    ]  # fmt: skip


def joint_rows(truth: mc.Measurements, header: str = "J1,J2,J3,J4,J5,J6") -> str:
    return table(truth.q * DEG, header)


def test_leica_points_by_target_name(truth, write, tmp_path, capsys):
    points = write("leica.csv", table(leica_rows(truth), LEICA).encode("latin-1"))
    joints = write("joints.csv", joint_rows(truth))
    found = import_files([points], joints)
    same(found, truth)
    data = calibrates(found, tmp_path)
    assert_allclose(data.columns["u95"], 12e-6)  # the largest of a pose
    assert_allclose(data.columns["temperature"], 20 + 0.01 * np.arange(POSES))
    assert_allclose(data.columns["time"], 3.0 * np.arange(POSES))
    assert set(data.unknown["smr2_target"]) == {"B #2"}
    assert run("import", points, "--joints", joints, "-o", tmp_path / "cli.csv") == 0
    out, err = capsys.readouterr()
    assert err.splitlines()[-1] == f"written: {tmp_path / 'cli.csv'}"
    for words in (
        "points", "latin-1", "comma", "point", "smr1 to smr3 x", "header", "temperature",
        "|q| up to", "60 poses",
    ):  # fmt: skip
        assert words in out
    assert mc.read_measurements(tmp_path / "cli.csv").poses == POSES


def test_leica_one_reflector_in_turns_is_told_by_the_rigid_body(truth, write):
    joints = write("joints.csv", joint_rows(truth))
    rows = leica_rows(truth, ("A", "A", "A"))
    same(import_files([write("a.csv", table(rows, LEICA))], joints), truth)
    by_target = [row for t in range(3) for row in rows[t::3]]
    points = write("b.csv", table(by_target, LEICA))
    same(import_files([points], joints), truth)
    same(import_files([points], joints, layout="target"), truth)
    loose = np.random.default_rng(1).permutation(len(rows))
    shuffled = write("c.csv", table([rows[i] for i in loose], LEICA))
    refused("add layout='pose' if", shuffled, joints=joints)


def test_the_points_of_another_arm_in_the_same_file_are_left_out(truth, write):
    """Numbers alone do not tell a pose where names do, under whatever word joints have them."""
    mine = [[f"L{j + 1}", *row] for j in range(POSES) for row in leica_rows(truth)[3 * j :][:3]]
    others = [[f"R{row[0][1:]}", *row[1:]] for row in mine]
    order = np.random.default_rng(3).permutation(POSES)
    for head in ("pose", "name", "Punkt"):
        keyed = [[f"L{j + 1}", *truth.q[j]] for j in order]
        rads = ",".join(f"q{i}_rad" for i in range(1, 7))
        joints = write("joints.csv", table(keyed, f"{head},{rads}"))
        points = write("both.csv", table([*others, *mine], f"{head},{LEICA}"))
        found = import_files([points], joints)
        assert_allclose(found.data.q, truth.q[order], rtol=0, atol=1e-9)
        assert_allclose(found.data.y, truth.y[order], rtol=0, atol=1e-9)
        assert any("have no pose of their name" in told for told in found.understood().notices)


def test_leica_matched_by_key(truth, write):
    rows = [[f"p{i // 3}", *row] for i, row in enumerate(leica_rows(truth))]
    order = np.random.default_rng(2).permutation(len(rows))
    points = write("leica.csv", table([rows[i] for i in order], "Point," + LEICA))
    keyed = [[f"p{j}", *(DEG * q)] for j, q in enumerate(truth.q)]
    joints = write("joints.csv", table(keyed, "name,J1,J2,J3,J4,J5,J6"))
    found = import_files([points], joints)
    assert_allclose(found.data.q, truth.q, atol=1e-8)
    which = [int(found.data.unknown[f"smr{t + 1}_target"][0][-1]) - 1 for t in range(3)]
    assert_allclose(found.data.y, truth.y[:, which], rtol=0, atol=2e-9)
    rows[4][0] = "p99"
    points = write("leica.csv", table(rows, "Point," + LEICA))
    found = import_files([points], joints)
    assert any("1 points have no pose of their name" in text for text in found.data.notices)
    assert any("left empty: p1 (target" in text for text in found.data.notices)
    twice = write("joints.csv", table([*keyed, keyed[0]], "name,J1,J2,J3,J4,J5,J6"))
    refused(f"{twice}:62: 'p0' stands twice", points, joints=twice)


def test_leica_deleted_points_are_left_out(truth, write):
    rows = leica_rows(truth)
    bad = [*rows[0]]
    bad[-1] = "TRUE"
    points = write("leica.csv", table([bad, *rows], LEICA))
    found = import_files([points], write("joints.csv", joint_rows(truth)))
    same(found, truth)
    assert found.data.notices == (
        f"{points}: points that are marked deleted are left out: line 2",)  # fmt: skip


def test_leica_points_deleted_and_not_measured_again_are_set_aside(truth, write, tmp_path):
    """By the targets' names, and where there is one: what follows stays with its joints."""
    joints = write("joints.csv", joint_rows(truth))
    for targets in (3, 1):
        rows = [row for row in leica_rows(truth) if row[10] in ("A #1", "B #2", "C #3")[:targets]]
        for pose, target in ((3, 0), (7, targets - 1)):
            rows[targets * pose + target][-1] = "TRUE"
            rows[targets * pose + target][0] = 9e3
        points = write("leica.csv", table(rows, LEICA))
        found = import_files([points], joints).data
        y = truth.y[:, :targets].copy()
        gone = ([3, 7], [0, targets - 1])
        y[gone] = np.nan
        assert_allclose(found.y, y[np.isfinite(y).any(axis=(1, 2))], rtol=0, atol=2e-9)
        lines = ", ".join(str(2 + targets * p + t) for p, t in ((3, 0), (7, targets - 1)))
        assert found.notices == (f"{points}: points that are marked deleted are set aside: "
                                 f"lines {lines}",)  # fmt: skip
        assert [(p.pose, p.target, p.by) for p in found.set_aside] == [
            (4, "smr1", "file"), (8, f"smr{targets}", "file")]  # fmt: skip
        assert found.aside is not None
        assert found.aside.y[0, 0, 0] == 9.0
        (tmp_path / "poses.csv").write_text(import_files([points], joints).csv())
        again = mc.read_measurements(tmp_path / "poses.csv")
        assert [(p.target, p.why, p.by) for p in again.set_aside] == [
            (p.target, p.why, p.by) for p in found.set_aside]  # fmt: skip
    gone = write("leica.csv", table(rows[:-1], LEICA))
    words = "(left out as marked deleted: lines 5, 9)"
    assert refused(f"{joints}:59: joint row 58 has no point", gone, joints=joints).endswith(words)


def test_leica_broken(truth, write):
    joints = write("joints.csv", joint_rows(truth))
    rows = leica_rows(truth)
    rows[7][1] = "12,5.3"
    points = write("leica.csv", table(rows, LEICA).replace("12,5.3", '"12,5.3"'))
    refused(f"{points}:9: column Y  [mm]: '12,5.3' is not a number", points, joints=joints)
    rows[7] = leica_rows(truth)[7][:5]
    points = write("leica.csv", table(rows, LEICA))
    refused(f"{points}:9: the line is torn, and rows are matched", points, joints=joints)
    points = write("leica.csv", table(leica_rows(truth)[:-1], LEICA))
    refused("target 'C #3' has 59 points", points, joints=joints)
    refused("holds points but no joint values; add their file as joints=", points)
    points = write("leica.csv", table(leica_rows(truth), LEICA).replace("Y  [mm],Z", "V  [mm],Z"))
    refused("say what they are, as columns=", points, joints=joints)
    refused("cannot be read", points.with_name("none.csv"))


# --- header-less columns ---------------------------------------------------------------------


def test_columns_in_order_and_by_place(truth, write, tmp_path):
    rows = np.column_stack([truth.y.reshape(POSES, 9) * 1e3, truth.q * DEG])
    path = write("plain.txt", table(rows))
    text = refused("has 15 columns and no header", path)
    mapping = text.split("columns='")[1].split("'")[0]
    assert mapping == "smr1_mm,smr2_mm,smr3_mm,q_deg"
    same(import_files([path], columns=mapping), truth)
    found = import_files([path], columns="smr1,smr2,smr3,q_deg")
    same(found, truth)
    calibrates(found, tmp_path)
    same(import_files([path], columns="1-3=smr1,4-6=smr2,7-9=smr3,10-15=q_deg"), truth)
    one = import_files([path], columns="smr1_mm,skip*6,q_deg")
    same(one, truth, targets=1)
    spaces = write("spaces.txt", table(rows, delimiter="   "))
    same(import_files([spaces], columns=mapping), truth)
    tabs = write("tabs.txt", table(rows, delimiter="\t").replace(".", ","))
    found = import_files([tabs], columns=mapping)
    same(found, truth)
    assert found.files().rows[0][2:4] == ("tab", "comma")


def test_columns_broken(truth, write):
    rows = np.column_stack([truth.y[:, 0] * 1e3, truth.q * DEG])
    path = write("plain.txt", table(rows).replace("\n", "\nabc", 3).replace("\nabc", "\n", 2))
    refused(f"{path}:4: column column 1: 'abc", path, columns="smr1_mm,q_deg")
    path = write("plain.txt", table(rows))
    refused("means 12 columns, but", path, columns="smr1_mm,smr2_mm,smr3_mm,q1_deg,q2,q3")
    refused("'smrx' is not known", path, columns="smrx,q_deg")
    refused("has columns 1 to 9 only", path, columns="1-3=smr1_mm,4-12=q_deg")
    refused("has no column 'X'", path, columns="X=smr1_x_mm")
    refused("no column for z", path, columns="1=smr1_x_mm,2=smr1_y_mm,4-9=q_deg")
    ragged = write("ragged.txt", table(rows) + "1,2\n")
    found = import_files([ragged], columns="smr1_mm,q_deg")
    same(found, truth, targets=1)
    assert found.data.notices == (f"{ragged}: 1 torn line is left out (61)",)


# --- 6D tracker: semicolons and decimal commas -------------------------------------------------

TRACKER = (
    "Timestamp;Goal x;Goal y;Goal z;shoulder_pan_joint;shoulder_lift_joint;elbow_joint;"
    "wrist_1_joint;wrist_2_joint;wrist_3_joint;measurement_temperature;measurement_x;"
    "measurement_std_x;measurement_y;measurement_std_y;measurement_z;measurement_std_z;"
    "measurement_rx"
)


def tracker6d_text(truth: mc.Measurements, stamp: str = "2,02011E+13") -> str:
    rows = [
        [stamp, "0,1", "-0,4", "0,8", *q, 21.5, y[0], 0.01, y[1], 0.01, y[2], 0.01, -90.1]
        for q, y in zip(truth.q, truth.y[:, 0] * 1e3, strict=True)
    ]
    return table(rows, TRACKER, ";").replace(".", ",")


def test_tracker6d(truth, write, tmp_path):
    found = import_files([write("log.csv", tracker6d_text(truth))])
    same(found, truth, targets=1)
    assert found.files().rows[0][1:4] == ("6D tracker log", "semicolon", "comma")
    known = {row[0]: row for row in found.columns()[0].rows}
    assert known["elbow_joint"][1:3] == ("joint 3", "rad")
    assert "else the arm would not be" in known["elbow_joint"][3]  # radians are proven
    assert known["measurement_std_x"][3] == "scatter of samples, not an uncertainty"
    assert known["Timestamp"][3] == "the same in all rows"
    data = calibrates(found, tmp_path)
    assert_allclose(data.columns["temperature"], 21.5)


def test_tracker6d_joints_in_alphabetical_order(truth, write):
    names = ("elbow_joint", "shoulder_lift_joint", "shoulder_pan_joint", "wrist_1_joint",
             "wrist_2_joint", "wrist_3_joint")  # fmt: skip
    rows = [[*q[[2, 1, 0, 3, 4, 5]], *y] for q, y in zip(truth.q, truth.y[:, 0] * 1e3, strict=True)]
    header = ";".join([*names, "measurement_x", "measurement_y", "measurement_z"])
    path = write("ros.csv", table(rows, header, ";").replace(".", ","))
    same(import_files([path]), truth, targets=1)


def test_tracker6d_broken(truth, write):
    text = tracker6d_text(truth).splitlines()
    text[5] = text[5].replace("21,500000000", "21.5")
    path = write("log.csv", "\n".join(text))
    refused(f"{path}:2: column Timestamp: 2,02011E+13 has a decimal comma, but", path)
    text = tracker6d_text(truth).splitlines()
    text[5] = text[5].replace(";-90,1", ";").replace("21,500000000;", "21,500000000;x")
    path = write("log.csv", "\n".join(text))
    refused(f"{path}:6: column measurement_x: 'x", path)


# --- RoboDK ------------------------------------------------------------------------------------

ROBODK = "J1,J2,J3,J4,J5,J6,x,y,z,w,p,r,tool_x,tool_y,tool_z,tool_w,tool_p,tool_r"


def robodk_rows(truth: mc.Measurements, targets: int) -> list[list[object]]:
    return [
        [
            *(truth.q[j] * DEG),
            *(truth.y[j, t] * 1e3),
            "0",
            "0",
            "0",
            f"{t}",
            "0",
            "9",
            "0",
            "0",
            "0",
        ]
        for t in range(targets)
        for j in range(POSES)
    ]


def test_robodk(truth, write, tmp_path):
    found = import_files([write("val.csv", table(robodk_rows(truth, 1), ROBODK))])
    same(found, truth, targets=1)
    assert "taken as measured points" in found.data.notices[0]
    calibrates(found, tmp_path)
    three = import_files([write("val.csv", table(robodk_rows(truth, 3), ROBODK))])
    assert three.data.target_names == ("smr1", "smr2", "smr3")
    assert_allclose(three.data.y[:POSES, 0], truth.y[:, 0], atol=2e-9)
    calibrates(three, tmp_path)


def test_robodk_broken(truth, write):
    rows = robodk_rows(truth, 1)
    rows[3][4] = ""
    path = write("val.csv", table(rows, ROBODK))
    refused(f"{path}:5: column J5: is empty; complete it or delete the row", path)
    path = write("val.csv", table(robodk_rows(truth, 1), ROBODK.replace("J4", "J5", 1)))
    refused("columns 'J5' and 'J5' both are q5", path)


# --- one file per target, and a joints file ----------------------------------------------------


def test_one_file_per_target(truth, write, tmp_path):
    paths = [
        write(f"position_SMR_{t + 1}.txt", table(truth.y[:, t] * 1e3, delimiter=" "))
        for t in range(3)
    ]
    joints = write("joints_SMR_tool.txt", table(truth.q * DEG, delimiter=" "))
    found = import_files(paths[::-1], joints)  # sorted by the number in the name
    same(found, truth)
    assert [t.rows[0][1] for t in found.columns()][:3] == ["smr1 x", "smr2 x", "smr3 x"]
    calibrates(found, tmp_path)
    found = import_files(
        [write("left.csv", "x [m];y [m];z [m]\n" + table(truth.y[:, 0], delimiter=";")), paths[2]],
        joints,
        units="smr=mm,q=deg",
    )
    assert_allclose(found.data.y[:, 1], truth.y[:, 2], atol=2e-9)
    assert "though header says m" in found.columns()[0].rows[0][3]


def test_one_file_per_target_broken(truth, write):
    joints = write("joints.txt", table(truth.q * DEG, delimiter=" "))
    points = write("smr_1.txt", table(truth.y[:50, 0] * 1e3, delimiter=" "))
    refused(f"{joints}:51: joint row 51 has no point", points, joints=joints)
    few = write("few.txt", table(truth.q[:50] * DEG, delimiter=" "))
    points = write("smr_1.txt", table(truth.y[:, 0] * 1e3, delimiter=" "))
    refused(f"{points}:51: point 51 has no joints", points, joints=few)
    refused("holds points but no joint values", points)
    refused("but no points", write("j.csv", joint_rows(truth)))
    twice = write("j.csv", joint_rows(truth))
    refused("holds joint values, as joints=", points, twice, joints=joints)
    same(import_files([points, twice]), truth, targets=1)  # no need for joints=: it has names


# --- RAPID -------------------------------------------------------------------------------------


def rapid_text(truth: mc.Measurements, odd: bool = False) -> str:
    lines = ["MODULE Poses"]
    for j, q in enumerate(truth.q * DEG):
        values = ",".join(f"{v:.9f}" for v in q)
        lines.append(
            f"LOCAL VAR jointtarget j{j + 1} = j:{{\t{values}\t,\t0\t}}\t{{EJ 0,0,0,0,0,0}}"
            if odd
            else f"  CONST jointtarget p{j + 1}:=[[{values}],[{','.join(['9E+09'] * 6)}]];"
        )
    return "\n".join([*lines, "ENDMODULE"])


@pytest.mark.parametrize("odd", [False, True])
def test_rapid(truth, write, tmp_path, odd):
    points = write("points.csv", table(truth.y[:, 0] * 1e3, "x,y,z"))
    found = import_files([points], write("poses.mod", rapid_text(truth, odd)))
    same(found, truth, targets=1)
    assert list(found.data.columns["pose"][:1]) == ["j1" if odd else "p1"]
    if not odd:
        calibrates(found, tmp_path)


def test_rapid_broken(truth, write):
    points = write("points.csv", table(truth.y[:, 0] * 1e3, "x,y,z"))
    text = rapid_text(truth)
    joints = write("poses.mod", text.replace("p7:=[[", "p7:=[[x"))
    refused(f"{joints}:8: jointtarget p7: axis 1: 'x", points, joints=joints)
    joints = write("poses.mod", text.replace("p7:=", "p6:="))
    refused(f"{joints}:8: jointtarget p6 is set twice", points, joints=joints)
    joints = write("poses.mod", text.replace("p7:=[[", "p7:=[[1,"))
    refused("jointtarget p7 has 7 joint values", points, joints=joints)
    joints = write("poses.mod", text.replace("p7:=", "p7;!"))
    refused(f"{joints}:8: jointtarget p7 has no joint values", points, joints=joints)


# --- FIGAROH -----------------------------------------------------------------------------------

FIGAROH = "x1,y1,z1,phix1,phiy1,phiz1,arm_1,arm_2,arm_3,arm_4,arm_5,arm_6"


def test_figaroh(truth, write, tmp_path):
    rows = [[*y, "0", "0", "0", *q] for q, y in zip(truth.q, truth.y[:, 0], strict=True)]
    found = import_files([write("fig.csv", table(rows, FIGAROH))])
    same(found, truth, targets=1)
    calibrates(found, tmp_path)
    wide = table(np.column_stack([truth.y[:, :2].reshape(POSES, 6), truth.q]),
                 "x1,y1,z1,x2,y2,z2,a,b,c,d,e,f")  # fmt: skip
    same(import_files([write("two.csv", wide)]), truth, targets=2)


def test_figaroh_broken(truth, write):
    header = "x1,y1,z1,a,b,c,d,e,f"
    degrees = table(np.column_stack([truth.y[:, 0], truth.q * DEG]), header)
    path = write("fig.csv", degrees)
    refused("cannot be in rad; add units='q=deg'", path)
    same(import_files([path], units="q=deg"), truth, targets=1)
    path = write("fig.csv", table(np.column_stack([truth.y[:, 0] * 1e3, truth.q]), header))
    refused("add units='smr=mm'", path)
    same(import_files([path], units=["smr=mm"]), truth, targets=1)
    refused("target 2 has no column for z", write("fig.csv", "x1,y1,z1,x2,y2,a\n" + "1," * 5 + "1"))


# --- the contract's own CSV in other units -------------------------------------------------------


def test_contract_in_other_units(truth, write, tmp_path):
    header = ";".join(
        [f"q{i + 1}_deg" for i in range(6)]
        + ["smr1_x_in", "smr1_y_in", "smr1_z_in", "u95_um", "temperature_F", "time_min", "operator"]
    )
    rows = [
        [*(q * DEG), *(y / 0.0254), 15.0, 68.0, j / 2, "ann"]
        for j, (q, y) in enumerate(zip(truth.q, truth.y[:, 0], strict=True))
    ]
    found = import_files([write("own.csv", table(rows, header, ";").replace(".", ","))])
    assert_allclose(found.data.y[:, 0], truth.y[:, 0], atol=1e-9)
    data = calibrates(found, tmp_path)
    assert_allclose(data.columns["u95"], 15e-6)
    assert_allclose(data.columns["temperature"], 20.0)
    assert_allclose(data.columns["time"], 30.0 * np.arange(POSES))
    assert set(data.unknown["operator"]) == {"ann"}


def test_contract_itself_and_with_gaps(truth, tmp_path, noisy):
    mc.write_measurements(tmp_path / "m.csv", truth)
    same(import_files([tmp_path / "m.csv"]), truth)
    y = truth.y.copy()
    y[3, 1] = np.nan
    mc.write_measurements(tmp_path / "m.csv", truth.with_y(y))
    found = import_files([tmp_path / "m.csv"])
    assert not found.data.seen[3, 1]
    assert calibrates(found, tmp_path).seen.sum() == 3 * POSES - 1


def test_contract_broken(truth, write):
    head = "q1_rad;q2_rad;smr1_x_mm;smr1_y_mm;smr1_z_mm"
    refused("mix units of angle", write("m.csv", head.replace("q2_rad", "q2_deg") + "\n0;0;1;2;3"))
    refused("no column for joint 2", write("m.csv", head.replace("q2", "q3") + "\n0;0;1;2;3"))
    path = write("m.csv", head + "\n0;0;1;2;3\n0;1;4;;6")
    refused(f"{path}:3: a point has some of x, y, z only", path)
    refused("no unit for it", write("m.csv", head.replace("x_mm", "x_s") + "\n0;0;1;2;3"))
    refused("has no unit; add units='u95=mm'", write("m.csv", head + ";u95\n0;0;1;2;3;1"))


# --- units: proven, or asked for ---------------------------------------------------------------


@pytest.mark.parametrize("angle", [1.0, DEG])
@pytest.mark.parametrize("length", [1.0, 1e3])
def test_units_are_proven_by_the_arm(truth, write, angle, length):
    rows = np.column_stack([truth.y[:, 0] * length, truth.q * angle])
    same(import_files([write("m.txt", table(rows))], columns="smr1,q"), truth, targets=1)


def test_units_that_cannot_be_proven_are_asked_for(truth, write):
    still = np.column_stack([truth.y[:1, 0], truth.q[:1]])
    path = write("m.txt", table(still))
    text = refused("joints (up to", path, columns="smr1,q")
    assert "add units='q=rad' or units='q=deg', and units='smr=mm' or units='smr=m'" in text
    found = import_files([path], columns="smr1,q", units="rad,m")
    same(found, truth.take(np.array([0])), targets=1)
    refused("write q=rad", path, columns="smr1,q", units="q=parsec")
    refused("write q=deg, smr=mm or", path, columns="smr1,q", units="furlong")


def test_small_ways_in_millimetres_are_not_taken_for_metres(write):
    rng = np.random.default_rng(3)
    q = 0.5 + rng.normal(size=(40, 6)) * 1e-3
    y = np.array([3000.0, 10.0, 20.0]) + rng.normal(size=(40, 3)) * 2.0
    path = write("m.txt", table(np.column_stack([y, q])))
    refused("add units='smr=mm' or units='smr=m'", path, columns="smr1,q_rad")
    y = y - y.mean(axis=0)
    path = write("m.txt", table(np.column_stack([y, q])))
    refused("units='smr=m'", path, columns="smr1,q_rad")


def test_days_and_months_are_asked_for(truth, write):
    def stamped(stamp: str) -> Path:
        rows = [
            [*q, *y, stamp.format(j % 60 if j else 0, 3 + j // 30)]
            for j, (q, y) in enumerate(zip(truth.q, truth.y[:, 0], strict=True))
        ]
        header = "q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad,smr1_x_m,smr1_y_m,smr1_z_m,time"
        return write("t.csv", table(rows, header))

    path = stamped("{1:02d}/04/2026 10:00:{0:02d}")
    refused("add units='time=dmy' or units='time=mdy'", path)
    found = import_files([path], units="time=dmy")
    assert found.data.columns["time"][-1] == pytest.approx(86400 + 59)
    path = stamped("2026-04-{1:02d} 10:00:{0:02d}")
    assert import_files([path]).data.columns["time"][-1] == pytest.approx(86400 + 59)
    same_day = stamped("03/04/2026 10:00:{0:02d}")
    assert import_files([same_day]).data.columns["time"][5] == pytest.approx(5)


def test_thousands_or_decimals_are_asked_for(write):
    path = write("m.csv", "q1_rad;smr1_x_mm;smr1_y_mm;smr1_z_mm\n1;1,234;5,678;9,012\n2;1,2;3;4\n")
    assert_allclose(import_files([path]).data.y[0, 0], [1.234e-3, 5.678e-3, 9.012e-3])
    path = write("m.csv", "q1_rad;smr1_x_mm;smr1_y_mm;smr1_z_mm\n1;1,234;5,678;9,012\n2;2;3;4\n")
    refused("add decimal='comma'", path)
    found = import_files([path], decimal="comma")
    assert_allclose(found.data.y[0, 0], [1.234e-3, 5.678e-3, 9.012e-3])


def test_what_is_no_table(write):
    refused("is a spreadsheet", write("a.csv", b"PK\x03\x04abc"))
    refused("workbook", write("a.xlsx", b"PK\x03\x04abc"))
    refused("is not a text file", write("a.bin", b"abc\0def"))
    refused("is empty", write("a.csv", "\n\n"))
    refused("has no columns", write("a.csv", "hello\nworld\n"))
    refused("holds a header but no rows", write("a.csv", "x,y,z\n"))
    refused("quotation mark", write("a.csv", 'x,y,z\n1,2,3\n1,"2,3\n1,2,3\n'))
    with pytest.raises(mc.OptionError):
        import_files([])


# --- command -----------------------------------------------------------------------------------


def test_command_json_errors_and_dry_run(truth, write, tmp_path, capsys):
    path = write("log.csv", tracker6d_text(truth))
    assert run("import", path) == 0
    assert "nothing written; add -o FILE" in capsys.readouterr().out
    assert run("import", path, "--json", "-o", tmp_path / "o.csv") == 0
    content = json.loads(capsys.readouterr().out)
    assert content["poses"] == POSES
    assert content["files"][0]["format"] == "6D tracker log"
    assert run("import", path, "--joints", tmp_path / "no.csv") == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert "cannot be read" in err
    assert run("import", path, "-o", tmp_path / "no" / "o.csv") == 2
    assert run("calibrate", "irb2600", tmp_path / "o.csv", "--objective", "sum", "-q") == 0


# --- what means something else than it seems -----------------------------------------------


def clocked(truth: mc.Measurements, write: Write, stamps: Sequence[str]) -> Path:
    rows = [[*q, *y, s] for q, y, s in zip(truth.q, truth.y[:, 0], stamps, strict=False)]
    header = "q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad,smr1_x_m,smr1_y_m,smr1_z_m,time"
    return write("t.csv", table(rows, header))


@pytest.mark.parametrize(
    ("stamps", "seconds"),
    [
        (["23:59:58", "23:59:59", "00:00:01", "00:00:02"], [0, 1, 3, 4]),
        (["11:59:59 PM", "12:00:01 AM", "12:00:02 AM"], [0, 2, 3]),
        (["23:59:58", "00:00:02", "23:59:59", "00:00:03"], [0, 4, 1, 5]),  # by target
        (["20:00:00", "04:00:00", "12:00:00"], [0, 8 * 3600, 16 * 3600]),
        (["06:00:00", "12:00:00", "20:00:00", "06:00:01", "12:00:01", "20:00:01"],
         [0, 21600, 50400, 1, 21601, 50401]),
        (["10:00:02", "10:00:01", "10:00:00"], [2, 1, 0]),
        (["00:00:01", "23:59:59"], [0, 86398]),
    ],
)  # fmt: skip
def test_a_clock_runs_on_over_midnight(truth, write, stamps, seconds):
    found = import_files([clocked(truth, write, stamps)])
    assert_allclose(found.data.columns["time"], seconds)


def test_a_clock_of_twelve_hours_is_asked_about(truth, write):
    path = clocked(truth, write, ["12:59:59", "01:00:00", "01:00:01"])
    refused(f"{path}:3: column time: 01:00:00 follows 12:59:59: a clock of twelve hours?", path)


def test_rapid_comments_are_no_poses(truth, write):
    text = rapid_text(truth).replace("  CONST jointtarget p6:", "! CONST jointtarget p6:")
    points = write("points.csv", table(np.delete(truth.y[:, 0], 5, axis=0) * 1e3, "x,y,z"))
    found = import_files([points], write("poses.mod", text))
    assert_allclose(found.data.q, np.delete(truth.q, 5, axis=0), rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("header", "word"), [("Delete", "deleted"), ("Delete", "WAHR"), ("Deleted", "TRUE")]
)
def test_words_for_deleted_points(truth, write, header, word):
    rows = leica_rows(truth)
    bad = [*rows[0]]
    bad[-1] = word
    points = write("leica.csv", table([bad, *rows], LEICA.replace("Delete", header)))
    joints = write("joints.csv", joint_rows(truth))
    same(import_files([points], joints), truth)
    bad[-1] = "perhaps"
    points = write("leica.csv", table([bad, *rows], LEICA.replace("Delete", header)))
    refused("leica.csv:2: column " + header + ": 'perhaps' does not say", points, joints=joints)


def test_what_is_told_twice_is_refused(truth, write):
    for units, words in (
        ("zz=mm,q=deg", "units='zz=mm': write q=deg, smr=mm or time=dmy"),
        ("q=deg,q=rad", "units='q=rad': q is in deg already"),
    ):
        with pytest.raises(mc.OptionError, match=words):
            import_files(["none.csv"], units=units)
    points = write("p1.csv", table(truth.y[:, 0] * 1e3, "x,y,z"))
    copy = write("p2.csv", table(truth.y[:, 0] * 1e3, "x,y,z"))
    joints = write("joints.csv", joint_rows(truth))
    refused(f"{points}: is given twice", points, points, joints=joints)
    refused(f"{copy}: holds the same points as {points}", points, copy, joints=joints)
    whole = write("m.csv", table(truth.q, ",".join(f"q{i}_rad" for i in range(1, 7))))
    refused("7-9", whole, columns="1-6=q_rad,7-9=smr1_mm")
    refused("column 4 is placed twice", whole, columns="1-3=q_rad,4-6=smr1_mm,4-6=smr2_mm")
