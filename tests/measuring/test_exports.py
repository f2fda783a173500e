"""Exports as users bring them and as makers' programs write them: read at the first try, whole."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.measuring.importers import Imported, import_files
from minimax_cal.measuring.importers.point_pose_matching import match_point_names_to_poses
from minimax_cal.modelling.simulate import simulate

DEG = 180.0 / np.pi
POSES, TARGETS = 40, 3


@pytest.fixture(scope="module")
def truth() -> mc.Measurements:
    return simulate("irb2600", POSES, TARGETS, seed=3).data


@dataclass
class Export:
    """Files of an export: text or bytes by name; what a second try adds; what is lost."""

    files: dict[str, str | bytes]
    options: dict[str, Any] = field(default_factory=dict)
    joints: str = ""
    without: tuple[tuple[int, int], ...] = ()
    says: tuple[str, ...] = ()
    order: bool = True


def comma(value: float, digits: int = 6) -> str:
    return f"{value:.{digits}f}".replace(".", ",")


def german(d: mc.Measurements) -> Export:
    """A tracker's report with a preamble, decimal commas, target beside the pose's name."""
    rows = [
        ";".join([f"P{j + 1}_{t + 1}", *(comma(1e3 * v) for v in d.y[j, t]), "20,1",
                  f"24.11.2026 10:{j:02d}:{10 * t:02d}"])
        for j in range(POSES) for t in range(TARGETS)
    ]  # fmt: skip
    rng = np.random.default_rng(1)
    shuffled = [rows[i] for i in rng.permutation(len(rows)) if not rows[i].startswith("P18_2;")]
    head = "Messbericht;Halle 4\nBediener;M. Muster\n\nPunkt;X Ist [mm];Y Ist [mm];Z Ist [mm];"
    points = head + "Temperatur [°C];Zeitstempel\n" + "\n".join(shuffled) + "\n"
    joints = "Roboter;R1\nPunktname;" + ";".join(f"Achse {i + 1} [°]" for i in range(6)) + "\n"
    joints += "".join(
        f"P{j + 1};" + ";".join(comma(v) for v in DEG * d.q[j]) + "\n" for j in range(POSES)
    )
    return Export(
        {"bericht.csv": points.encode("latin-1"), "achsen.csv": joints.encode("latin-1")},
        joints="achsen.csv", without=((17, 1),),
        says=("left empty: P18 (target 2)", "above the table, and left out: line 1, 2"),
    )  # fmt: skip


def spanish(d: mc.Measurements) -> Export:
    """A row for each point, the joints repeated; eje, punto, hora."""
    head = "Punto;" + ";".join(f"Eje {i + 1} (°)" for i in range(6)) + ";X (mm);Y (mm);Z (mm);Hora"
    rows = [
        ";".join([f"P{j + 1}-{t + 1}", *(comma(v) for v in DEG * d.q[j]),
                  *(comma(1e3 * v) for v in d.y[j, t]), f"11:{j:02d}:{t:02d}"])
        for j in range(POSES) for t in range(TARGETS)
    ]  # fmt: skip
    return Export({"medidas.csv": head + "\n" + "\n".join(rows) + "\n"})


def workbook(rows: list[list[object]] | dict[str, list[list[object]]]) -> bytes:
    """A workbook of one sheet or several, in as little XML as a reader takes.

    Skips without a reader.
    """
    pytest.importorskip("python_calamine", reason="python-calamine is not installed")
    sheets = rows if isinstance(rows, dict) else {"Tabelle1": rows}

    def cell(value: object) -> str:
        if isinstance(value, str):
            return f'<c t="inlineStr"><is><t>{escape(value)}</t></is></c>'
        return "<c/>" if value is None else f"<c><v>{value!r}</v></c>"

    numbers = range(1, len(sheets) + 1)
    main = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    office = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    package = "http://schemas.openxmlformats.org/package/2006"
    kind = "application/vnd.openxmlformats-officedocument.spreadsheetml"
    named = "".join(f'<sheet name="{name}" sheetId="{i}" r:id="r{i}"/>'
                    for i, name in zip(numbers, sheets, strict=True))  # fmt: skip
    types = "".join(f'<Override PartName="/xl/worksheets/sheet{i}.xml" ContentType='
                    f'"{kind}.worksheet+xml"/>' for i in numbers)  # fmt: skip
    related = "".join(f'<Relationship Id="r{i}" Type="{office}/worksheet" Target='
                      f'"worksheets/sheet{i}.xml"/>' for i in numbers)  # fmt: skip
    parts = {
        "[Content_Types].xml": f'<Types xmlns="{package}/content-types"><Default Extension="xml" '
        'ContentType="application/xml"/><Default Extension="rels" ContentType='
        '"application/vnd.openxmlformats-package.relationships+xml"/><Override PartName='
        f'"/xl/workbook.xml" ContentType="{kind}.sheet.main+xml"/>{types}</Types>',
        "_rels/.rels": f'<Relationships xmlns="{package}/relationships"><Relationship Id="r1" '
        f'Type="{office}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        "xl/workbook.xml": f'<workbook xmlns="{main}" xmlns:r="{office}"><sheets>{named}</sheets>'
        "</workbook>",
        "xl/_rels/workbook.xml.rels": f'<Relationships xmlns="{package}/relationships">{related}'
        "</Relationships>",
    }
    for i, sheet in zip(numbers, sheets.values(), strict=True):
        data = "".join(f"<row>{''.join(map(cell, row))}</row>" for row in sheet)
        parts[f"xl/worksheets/sheet{i}.xml"] = (
            f'<worksheet xmlns="{main}"><sheetData>{data}</sheetData></worksheet>'
        )
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        for name, text in parts.items():
            file.writestr(name, f'<?xml version="1.0" encoding="UTF-8"?>{text}')
    return stream.getvalue()


def nameless(d: mc.Measurements) -> Export:
    """Nothing but numbers in two files: one answer for either file."""
    points = "".join(" ".join(f"{1e3 * v:.6f}" for v in y.ravel()) + "\n" for y in d.y)
    joints = "".join(f"{i} " + " ".join(f"{v:.6f}" for v in DEG * q) + "\n"
                     for i, q in enumerate(d.q))  # fmt: skip
    told = {"columns": ["smr1_mm,smr2_mm,smr3_mm", "skip,q_deg"]}
    return Export({"p.txt": points, "j.txt": joints}, told, joints="j.txt")


def numbered(d: mc.Measurements) -> Export:
    """Poses 1, 2 ... of one side, Pkt 001 of the other, two of them without points."""
    rows = [
        f"Pkt {j + 1:03d};{t + 1};" + ";".join(f"{1e3 * v:.6f}" for v in d.y[j, t])
        for j in range(POSES) for t in range(TARGETS) if j not in (4, 30)
    ] + ["Pkt 999;1;1.0;2.0;3.0"]  # fmt: skip
    joints = "No;" + ";".join(f"J{i + 1} [deg]" for i in range(6)) + "\n"
    joints += "".join(f"{j + 1};" + ";".join(f"{v:.6f}" for v in DEG * d.q[j]) + "\n"
                      for j in range(POSES))  # fmt: skip
    gone = tuple((j, t) for j in (4, 30) for t in range(TARGETS))
    says = ("left empty: 5, 31", "1 points have no pose of their name", "Pkt 999 (line")
    text = "Point name;Reflector;X [mm];Y [mm];Z [mm]\n" + "\n".join(rows) + "\n"
    return Export({"p.csv": text, "j.csv": joints}, joints="j.csv", without=gone, says=says)


EXPORTS: dict[str, Callable[[mc.Measurements], Export]] = {
    make.__name__: make for make in (german, spanish, nameless, numbered)
}


def read(export: Export, folder: Path) -> Imported:
    for name, content in export.files.items():
        raw = content if isinstance(content, bytes) else content.encode()
        (folder / name).write_bytes(raw)
    names = [folder / name for name in export.files if name != export.joints]
    joints = folder / export.joints if export.joints else None
    return import_files(names, joints, **export.options)


@pytest.mark.parametrize("name", EXPORTS)
def test_an_export_is_read_with_nothing_lost(name, truth, tmp_path):
    export = EXPORTS[name](truth)
    found = read(export, tmp_path)
    assert_allclose(found.data.q, truth.q, rtol=0, atol=2e-8)
    y = truth.y.copy()
    for pose, target in export.without:
        y[pose, target] = np.nan
    assert_allclose(found.data.y, y, rtol=0, atol=2e-9)
    for said in export.says:
        assert any(said in notice for notice in found.data.notices), found.data.notices
    if not export.says:
        assert not found.data.notices
    shown = found.preview().text()
    assert "joint 6" in shown
    assert "smr3 z" in shown


def test_what_was_read_calibrates(truth, tmp_path, capsys):
    export = german(truth)
    read(export, tmp_path)
    out = tmp_path / "out.csv"
    files = (tmp_path / "bericht.csv", "--joints", tmp_path / "achsen.csv")
    assert run("import", *files, "--preview", "-o", out) == 0
    shown = capsys.readouterr().out
    assert "rows as understood" in shown
    assert "name: pose, target" in " ".join(shown.split())
    assert run("calibrate", "irb2600", out, "--quiet") == 0


def test_two_points_of_one_name_are_reported(truth, tmp_path):
    export = german(truth)
    text = export.files["bericht.csv"]
    assert isinstance(text, bytes)
    export.files["bericht.csv"] = text.replace(b"P9_3;", b"P9_2;")
    with pytest.raises(mc.DataError, match="a second point of the pose and target of line"):
        read(export, tmp_path)


def test_names_that_have_nothing_in_common_go_by_order(truth, tmp_path):
    points = "name,x_mm,y_mm,z_mm\n" + "".join(
        f"nest-{chr(97 + j % 26)}{chr(97 + j // 26)},{','.join(f'{1e3 * v:.6f}' for v in y[0])}\n"
        for j, y in enumerate(truth.y)
    )
    joints = "name," + ",".join(f"J{i + 1} [rad]" for i in range(6)) + "\n"
    joints += "".join(f"T{j}," + ",".join(f"{v:.9f}" for v in q) + "\n"
                      for j, q in enumerate(truth.q))  # fmt: skip
    found = read(Export({"p.csv": points, "j.csv": joints}, joints="j.csv"), tmp_path)
    assert_allclose(found.data.y[:, 0], truth.y[:, 0], atol=2e-9)
    assert any("have nothing in common" in notice for notice in found.data.notices)


@pytest.mark.parametrize(
    ("points", "poses", "pose", "label"),
    [
        (["P17_2", "P3_1"], ["P3", "P17"], (1, 0), ("2", "1")),
        (["SMR1-P017", "SMR2-P3"], ["P3", "P17"], (1, 0), ("smr1", "smr2")),
        (["17", "3"], ["P3", "P17"], (1, 0), ("", "")),
        (["Pose 17 - Refl. 2"], ["pose17"], (0,), ("refl2",)),
        (["P17", "X9"], ["P3", "P17"], (1, -1), ("", "")),
        (["P1_2_1"], ["P1_2", "P1"], (0,), ("1",)),
    ],
)
def test_patterns_of_names(points, poses, pose, label):
    match = match_point_names_to_poses(points, poses)
    assert match is not None
    assert (match.pose, match.label) == (pose, label)


def test_a_pose_keeps_its_name(truth, tmp_path, capsys):
    """What the file of joints calls a pose, whatever the tracker calls its points."""
    points = ["name,X [mm],Y [mm],Z [mm]"]
    points += [f"P{i + 1:03d}_{k + 1},{','.join(f'{1e3 * v:.6f}' for v in truth.y[i, k])}"
               for i in range(POSES) for k in range(2)]  # fmt: skip
    joints = ["name," + ",".join(f"J{j} [rad]" for j in range(1, 7))]
    joints += [f"P{i + 1:03d},{','.join(f'{v:.9f}' for v in truth.q[i])}" for i in range(POSES)]
    for name, lines in (("points.csv", points), ("joints.csv", joints)):
        (tmp_path / name).write_text("\n".join(lines))
    data = mc.read_campaigns([tmp_path / "points.csv", tmp_path / "joints.csv"])
    assert data.called(data.line[4]) == "pose P005"
    out = tmp_path / "out.csv"
    assert run("import", tmp_path / "points.csv", tmp_path / "joints.csv", "-o", out) == 0
    again = mc.read_measurements(out)
    assert again.columns["pose"][4] == "P005"
    assert again.notices == ()


def test_a_workbook_is_measurements(truth, tmp_path):
    head: list[object] = [*(f"q{i + 1}_rad" for i in range(6)), "smr1_x_mm", "smr1_y_mm"]
    rows: list[list[object]] = [[*head, "smr1_z_mm", "session"]]
    rows += [[*q.tolist(), *(1e3 * y[0]).tolist(), "may"]
             for q, y in zip(truth.q, truth.y, strict=True)]  # fmt: skip
    path = tmp_path / "data.xlsx"
    path.write_bytes(workbook(rows))
    data = mc.read_measurements(path)
    assert_allclose(data.q, truth.q, rtol=0, atol=1e-15)
    assert set(data.columns["session"]) == {"may"}


def test_a_workbook_is_a_robot(tmp_path):
    rows = [["Robot", "KR 10"], ["Konvention", "modifiziert"],
            ["Gelenk", "a [mm]", "alpha [°]", "d [mm]", "theta [°]"],
            [1, 0, 0, 660.5, 0], [2, 0, -90, 0, 90], [3, 432, 0, 149, 0]]  # fmt: skip
    path = tmp_path / "Datenblatt.xlsx"
    path.write_bytes(workbook(rows))
    robot = mc.load_robot(path)
    assert robot.name == "KR 10"
    assert_allclose(robot.mdh[:, :2], [[0, 0.6605], [0.432, 0], [0, 0.149]], rtol=1e-15)


@pytest.mark.parametrize(
    ("part", "old", "new"),
    [
        ("xl/worksheets/sheet1.xml", "<c><v>6", '<c r="XFD1048576"><v>6'),
        ("xl/sharedStrings.xml", "", '<sst count="99999999999" uniqueCount="99999999999"></sst>'),
    ],
)
def test_a_workbook_that_asks_for_any_memory(part, old, new, tmp_path):
    path, packed = tmp_path / "bomb.xlsx", io.BytesIO(workbook([[1, 2, 3], [4, 5, 6]]))
    with zipfile.ZipFile(packed) as source, zipfile.ZipFile(path, "w") as bomb:
        for name in source.namelist():
            text = source.read(name).decode()
            bomb.writestr(name, text.replace(old, new) if name == part and old else text)
        if not old:
            bomb.writestr(part, new)
    with pytest.raises(mc.DataError, match=r"bomb\.xlsx: asks for more memory"):
        mc.read_measurements(path)


# ---- makers --------------------------------------------------------------------------------------


VISITS = 48


@dataclass(frozen=True)
class Made:
    """files, joints: as given to the import.  gap: pose and target that the tracker missed.

    order: in which the joints' file has the poses.  says: what the notices must name.
    """

    files: tuple[str, ...]
    joints: str | None
    gap: tuple[int, int]
    order: Array
    says: tuple[str, ...] = ()


def short(value: float, digits: int = 4) -> str:
    return f"{value:.{digits}f}".replace(".", ",")


def clock(i: int) -> tuple[int, int, int]:
    at = 9 * 3600 + 12 * 60 + 47 * i
    return at // 3600, at // 60 % 60, at % 60


def hour(i: int) -> str:
    return "{:02d}:{:02d}:{:02d}".format(*clock(i))


def day_first(i: int) -> str:
    return f"17.03.2026 {hour(i)}"


def iso(i: int) -> str:
    return f"2026-03-17 {hour(i)}"


def american(i: int) -> str:
    h, m, s = clock(i)
    return f"3/17/2026 {(h - 1) % 12 + 1}:{m:02d}:{s:02d} {'AM' if h < 12 else 'PM'}"


def seen(gap: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """Poses and targets that were measured."""
    return ((i, k) for i in range(VISITS) for k in range(TARGETS) if (i, k) != gap)


def put(path: Path, lines: list[str], encoding: str = "utf-8", end: str = "\n") -> str:
    path.write_text(end.join(lines) + end, encoding=encoding, newline="")
    return path.name


def put_workbook(path: Path, sheets: dict[str, list[list[object]]]) -> str:
    path.write_bytes(workbook(sheets))
    return path.name


def leica_kuka(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Made:
    """German, decimal comma, points shuffled, a preamble with a stray quotation mark."""
    gap = (16, 1)
    rows = [
        f"P{i + 1}_{k + 1};{';'.join(map(short, y[i, k]))};{short(rng.uniform(0.004, 0.012))};"
        f"{short(21.3, 1)};{day_first(3 * i + k)}"
        for i, k in seen(gap)
    ]
    text = [
        "Hexagon Manufacturing Intelligence - Leica Absolute Tracker AT960",
        "Projekt:;Zelle 12 Halle B", "Bediener:;Müller", 'Reflektor:;RRR 1,5"', "",
        "Punkt;X [mm];Y [mm];Z [mm];RMS [mm];Lufttemperatur [°C];Zeitstempel",
        *(rows[i] for i in rng.permutation(len(rows))), "", "Anzahl Punkte:;143",
    ]  # fmt: skip
    dat = ["&ACCESS RVP", "DEFDAT KALIB", ";FOLD EXTERNAL DECLARATIONS;%{PE}%MKUKATPBASIS", ""]
    for i, values in enumerate(q, 1):
        axes = ",".join(f"A{j} {value:.6f}" for j, value in enumerate(values, 1))
        outer = ",".join(f"E{j} 0.0" for j in range(1, 7))
        dat += [f"DECL E6AXIS XP{i}={{{axes},{outer}}}", f"DECL FDAT FP{i}={{TOOL_NO 1,BASE_NO 0}}"]
    points = put(folder / "tracker.csv", text, "latin-1", "\r\n")
    joints = put(folder / "kalib.dat", [*dat, "ENDDAT"])
    return Made((points,), joints, gap, np.arange(VISITS), ("P17", "line 1, 2, 3, 4", "151"))


def sa_ur(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Made:
    """Collections and groups; reference points among them; a program with Cartesian waypoints."""
    gap = (8, 0)
    out = [
        "// SpatialAnalyzer 2023.1 - Exported Points", "// Units: Millimeters",
        "Collection,Group,Target,X,Y,Z,Timestamp",
    ]  # fmt: skip
    out += [f"A,REF,R{k},{1000 * k + 500.1234:.4f},-800.5,12.25,{iso(k)}" for k in (1, 2, 3)]
    for k in range(TARGETS):
        out += [
            f"A,SMR{k + 1},P{i + 1:03d},{','.join(f'{v:.4f}' for v in y[i, k])},{iso(48 * k + i)}"
            for i in range(VISITS)
            if (i, k) != gap
        ]
    program = [
        "def calib():",
        "  set_tcp(p[0.0,0.0,0.12,0.0,0.0,0.0])",
        "  set_payload(1.5, [0,0,0.05])",
    ]
    for i, values in enumerate(np.radians(q), 1):
        pose = ", ".join(f"{v:.6f}" for v in rng.normal(size=6))
        turned = ", ".join(f"{v:.8f}" for v in values)
        program += [f"  global Waypoint_{i}_p=p[{pose}]", f"  global Waypoint_{i}_q=[{turned}]"]
    points = put(folder / "points.csv", out)
    joints = put(folder / "calib.script", [*program, "end"])
    return Made((points,), joints, gap, np.arange(VISITS), ("R1",))


def faro_abb(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Made:
    """French, UTF-16, tabs, a row of units, nominal columns between; RAPID with a robtarget."""
    gap = (30, 2)
    out = [
        "FARO CAM2 Measure 10\tRapport d'inspection", "Pièce :\tRobot IRB 120", "",
        "Nom\tType\tX mesuré\tY mesuré\tZ mesuré\tX nominal\tÉcart X\tTempérature\tDate\tHeure",
        "\t\t[mm]\t[mm]\t[mm]\t[mm]\t[mm]\t[°C]\t\t",
    ]  # fmt: skip
    out += [
        f"jp{10 * (i + 1)}_{k + 1}\tPoint\t" + "\t".join(map(short, y[i, k]))
        + f"\t{short(y[i, k, 0] + 0.3, 3)}\t-0,300\t{short(20.4, 2)}\t17/03/2026\t{hour(3 * i + k)}"
        for i, k in seen(gap)
    ]  # fmt: skip
    home = "[[364.35,0,594],[0.5,0,0.866025,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"
    program = ["MODULE Calib", "  ! poses", f"  CONST robtarget pHome:={home};"]
    program += [
        f"  CONST jointtarget jp{10 * i}:=[[{','.join(f'{v:.5f}' for v in values)}],"
        "[9E9,9E9,9E9,9E9,9E9,9E9]];"
        for i, values in enumerate(q, 1)
    ]
    program += [f"    MoveAbsJ jp{10 * i},v200,fine,tool0;" for i in range(1, VISITS + 1)]
    points = put(folder / "rapport.txt", out, "utf-16")
    joints = put(folder / "Calib.mod", [*program, "ENDMODULE"])
    return Made((points,), joints, gap, np.arange(VISITS), ("jp310",))


def pcdmis_fanuc(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Made:
    """A report in blocks, a row for each coordinate; an LS program."""
    gap = (4, 1)
    out = ["PART NAME  : R2000iC            March 17, 2026   09:12", ""]
    for n, (i, k) in enumerate(seen(gap), 1):
        out += [f"DIM LOC{n}= LOCATION OF POINT P{i + 1}_{k + 1}  UNITS=MM",
                "AX    NOMINAL       MEAS       +TOL       -TOL        DEV     OUTTOL"]  # fmt: skip
        out += [
            f"{axis}  {round(v):10.4f} {v:10.4f} {0.05:10.4f} {0.05:10.4f} {v - round(v):10.4f} 0.0"
            for axis, v in zip("XYZ", y[i, k], strict=True)
        ]
        out.append(f"END OF DIMENSION LOC{n}")
    program = ["/PROG  CALIB", "/ATTR", 'COMMENT\t\t= "";', "/MN"]
    program += [f"{i:4d}:J P[{i}] 20% FINE    ;" for i in range(1, VISITS + 1)] + ["/POS"]
    for i, values in enumerate(q, 1):
        axes = [f"J{j}= {value:9.4f} deg" for j, value in enumerate(values, 1)]
        program += [f"P[{i}]{{", "   GP1:", "\tUF : 0, UT : 1,\t"]
        program += ["\t" + ",\t".join(axes[:3]) + ",", "\t" + ",\t".join(axes[3:]), "};"]
    points = put(folder / "report.txt", out)
    return Made(
        (points,), put(folder / "CALIB.LS", [*program, "/END"]), gap, np.arange(VISITS), ("P[5]",)
    )


def calypso_workbook(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Made:
    """A table with a row for each coordinate; joints in a workbook's second sheet, shuffled."""
    gap = (11, 0)
    head = "planid partnb id type idsymbol actual nominal uppertol lowertol deviation exceed"
    out = ["\t".join([*head.split(), "featureid", "unit"])]
    for i, k in seen(gap):
        name = f"P{i + 1}_{k + 1}"
        out += [
            f"Kalibrierung\t1\t{axis}-Wert_{name}\t{axis.lower()}Value\t{axis}\t{v:.5f}"
            f"\t{round(v, 1):.5f}\t0.05\t-0.05\t{v - round(v, 1):.5f}\t\t{name}\tmm"
            for axis, v in zip("XYZ", y[i, k], strict=True)
        ]
    order = rng.permutation(VISITS)
    rows: list[list[object]] = [
        ["Achswerte Meca500", ""], ["Stand:", "17.03.2026"], [],
        ["Punkt", *(f"Achse {j + 1} [°]" for j in range(6)), "Bemerkung"],
    ]  # fmt: skip
    rows += [[f"P{i + 1}", *(float(v) for v in q[i]), "" if i else "Start"] for i in order]
    cover: list[list[object]] = [["Kalibrierung"], ["Halle 3"]]
    points = put(folder / "Kalibrierung_1_chr.txt", [*out, "END"], "latin-1")
    joints = put_workbook(folder / "achsen.xlsx", {"Deckblatt": cover, "Achsen": rows})
    return Made((points,), joints, gap, order, ("P12",))


def polyworks_yaskawa(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Made:
    """Spanish, nominal and deviation beside each coordinate, statistics below; S, L, U, R, B, T."""
    gap = (20, 1)
    out = [
        "PolyWorks|Inspector 2022 IR5", "Proyecto;Celda 4", "Unidades;Milímetros", "",
        "Nombre;X nominal;X medido;Desv. X;Y nominal;Y medido;Desv. Y;Z nominal;Z medido;Desv. Z;"
        "Temperatura;Fecha y hora",
    ]  # fmt: skip
    for i, k in seen(gap):
        each = [f"{short(round(v), 3)};{short(v)};{short(v - round(v))}" for v in y[i, k]]
        out.append(f"Esfera{k + 1}_P{i + 1};{';'.join(each)};22,1;17/03/2026 {hour(3 * i + k)}")
    out += ["Media;;;0,0012;;;0,0009;;;-0,0003;;", "Desv. est.;;;0,2871;;;0,2900;;;0,2799;;"]
    turned = [
        "Posición;S (grados);L (grados);U (grados);R (grados);B (grados);T (grados);Velocidad (%)"
    ]
    turned += [f"P{i};{';'.join(short(v, 5) for v in row)};25" for i, row in enumerate(q, 1)]
    points = put(folder / "puntos.csv", out, "utf-8-sig")
    joints = put(folder / "posiciones.csv", turned, "latin-1")
    says = ("P21", "Media (line 149)", "Desv. est. (line 150)")
    return Made((points,), joints, gap, np.arange(VISITS), says)


def api_chinese(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Made:
    """Chinese, in GB 18030; joints shuffled."""
    gap, order = (40, 2), rng.permutation(VISITS)
    out = [
        "API Radian 激光跟踪仪 测量报告",
        "操作员,王伟",
        "",
        "点号,靶球,X坐标(mm),Y坐标(mm),Z坐标(mm),温度(℃),气压(hPa),时间",
    ]
    out += [
        f"P{i + 1},靶球{k + 1},{','.join(f'{v:.4f}' for v in y[i, k])},23.1,1013.2,{iso(3 * i + k)}"
        for i, k in seen(gap)
    ]
    turned = ["机器人关节角", "点号,关节1(°),关节2(°),关节3(°),关节4(°),关节5(°),关节6(°)"]
    turned += [f"P{i + 1},{','.join(f'{v:.6f}' for v in q[i])}" for i in order]
    points = put(folder / "测量.csv", out, "gb18030", "\r\n")
    joints = put(folder / "关节.csv", turned, "gb18030", "\r\n")
    return Made((points,), joints, gap, order, ("P41",))


def leica_inches(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Made:
    """Inches, a point that was knocked, marked as deleted and measured again, American dates."""
    gap = (33, 0)
    out = [
        "X [in],Y [in],Z [in],U(95) [in],Target,Temperature [F],Pressure [inHg],Time Stamp,Delete,"
    ]
    for n, (i, k) in enumerate(seen(gap)):
        inches = y[i, k] / 25.4
        if (i, k) == (6, 1):
            off = ",".join(f"{v:.6f}" for v in inches + 0.4)
            out.append(f"{off},0.0012,P07-SMR2,69.8,29.92,'{american(n)},True,")
        place = ",".join(f"{v:.6f}" for v in inches)
        out.append(f"{place},0.0012,P{i + 1:02d}-SMR{k + 1},69.8,29.92,'{american(n)},False,")
    turned = ["# joint log", "pose\t" + "\t".join(f"J{j} (deg)" for j in range(1, 7)) + "\tstatus"]
    turned += [
        f"P{i:02d}\t" + "\t".join(f"{v:.5f}" for v in row) + "\tOK" for i, row in enumerate(q, 1)
    ]
    points = put(folder / "AT500.csv", out, "latin-1")
    joints = put(folder / "joints.txt", turned)
    return Made((points,), joints, gap, np.arange(VISITS), ("P34", "line 21"))


def wide_workbook(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Made:
    """A workbook by hand: groups over the names, units below them, means below the rows."""
    gap, order = (25, 1), rng.permutation(VISITS)
    rows: list[list[object]] = [
        ["Messprotokoll Roboterkalibrierung"], ["Gerät", "Leica AT401"], [],
        ["", "Achswinkel", *[""] * 5, "SMR 1", "", "", "SMR 2", "", "", "SMR 3", "", "",
         "Temp.", "Uhrzeit"],
        ["Pose Nr.", *(f"A{j}" for j in range(1, 7)), *list("XYZ") * TARGETS, "", ""],
        ["", *["°"] * 6, *["mm"] * 9, "°C", ""],
    ]  # fmt: skip
    for i in order:
        points = [None if (i, k) == gap else float(v) for k in range(TARGETS) for v in y[i, k]]
        rows.append([float(i + 1), *map(float, q[i]), *points, 21.5, hour(int(i))])
    rows += [[], ["Mittelwert", *map(float, q.mean(axis=0))]]
    name = put_workbook(folder / "Protokoll.xlsx", {"Info": [["Kunde", "ACME"]], "Messung": rows})
    return Made((name,), None, gap, order, (f"below the table, and left out: line {VISITS + 8}",))


def axyz_ur(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Made:
    """A file a target in columns of blanks, one point exported twice; lists with names."""
    gap, names = (14, 2), []
    for k in range(TARGETS):
        out = [f"! Axyz LTM export  workpiece SMR{k + 1}   units: mm"]
        out += ["!  PointID          X             Y             Z      sX     sY     sZ"]
        for i in rng.permutation(VISITS):
            if (i, k) != gap:
                place = " ".join(f"{v:13.4f}" for v in y[i, k])
                out += [f"   P{i + 1:<6d} {place}   0.008  0.009  0.007"] * (1 + ((i, k) == (3, 1)))
        names.append(put(folder / f"SMR{k + 1}.txt", out))
    lists = [
        f"P{i} [{', '.join(f'{v:.7f}' for v in row)}]" for i, row in enumerate(np.radians(q), 1)
    ]
    joints = put(folder / "poses.txt", lists)
    return Made(tuple(names), joints, gap, np.arange(VISITS), ("P15", "twice"))


Maker = Callable[[Path, Array, Array, np.random.Generator], Made]
MAKERS: tuple[Maker, ...] = (
    leica_kuka, sa_ur, faro_abb, pcdmis_fanuc, calypso_workbook, polyworks_yaskawa, api_chinese,
    leica_inches, wide_workbook, axyz_ur,
)  # fmt: skip


@pytest.mark.parametrize("make", MAKERS)
def test_an_export_is_read_as_it_is(make, tmp_path, rng):
    """No option: every joint, every point, the gap left empty, and all that is left out listed."""
    truth = mc.simulate("irb2600", VISITS, TARGETS, 5).data
    export = make(tmp_path, np.degrees(truth.q), 1e3 * truth.y, rng)
    joints = tmp_path / export.joints if export.joints else None
    found = import_files([tmp_path / name for name in export.files], joints).data
    kept = found.take(np.arange(VISITS))
    assert_allclose(kept.q, truth.q[export.order], rtol=0, atol=2e-6)
    expected = truth.y.copy()
    expected[export.gap] = np.nan
    assert_allclose(kept.y, expected[export.order], rtol=0, atol=2e-7)
    said = " ".join(found.notices)
    for words in export.says:
        assert words in said
    files = [tmp_path / name for name in (*export.files, export.joints) if name]
    assert_allclose(mc.read_campaigns(files).q, found.q[found.seen.any(axis=1)], rtol=0, atol=0)


@pytest.mark.parametrize(
    ("make", "name", "line", "words"),
    [
        (pcdmis_fanuc, "report.txt", "Y ", "a second y of point"),
        (pcdmis_fanuc, "CALIB.LS", "\tJ1=", "J1:"),
        (leica_kuka, "kalib.dat", "DECL E6AXIS", "set twice"),
    ],
)
def test_a_line_that_is_there_twice_is_named(make, name, line, words, tmp_path, rng):
    truth = mc.simulate("irb2600", VISITS, TARGETS, 5).data
    export = make(tmp_path, np.degrees(truth.q), 1e3 * truth.y, rng)
    lines = (tmp_path / name).read_text().splitlines()
    place = next(i for i, text in enumerate(lines) if text.startswith(line))
    (tmp_path / name).write_text("\n".join([*lines[:place], lines[place], *lines[place:]]))
    with pytest.raises(mc.DataError, match=words):
        import_files([tmp_path / each for each in export.files], tmp_path / (export.joints or ""))
