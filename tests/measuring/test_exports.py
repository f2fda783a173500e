"""Ten exports of five makers, as users bring them: read at the first try or after one answer."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.measuring.importers import Imported, import_files
from minimax_cal.measuring.importers.join import match_names
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


def krl(d: mc.Measurements) -> Export:
    """A KUKA program's data list, and points as the tracker wrote them in another order."""
    program = "DEFDAT CAL PUBLIC\n;FOLD joints\n" + "".join(
        f"DECL E6AXIS XP{j + 1}={{"
        + ",".join(f"A{i + 1} {v:.6f}" for i, v in enumerate(DEG * d.q[j]))
        + ",E1 0.0,E2 0.0,E3 0.0,E4 0.0,E5 0.0,E6 0.0}\n"
        for j in range(POSES)
    ) + "ENDDAT\n"  # fmt: skip
    points = "name,x_mm,y_mm,z_mm\n" + "".join(
        f"SMR{t + 1} P{j + 1},{','.join(f'{1e3 * v:.6f}' for v in d.y[j, t])}\n"
        for t in range(TARGETS) for j in reversed(range(POSES))
    )  # fmt: skip
    return Export({"points.csv": points, "cal.dat": program}, joints="cal.dat")


def ur(d: mc.Measurements) -> Export:
    """Lists of a UR script, radians; a CMM's table with X, Y, Z of each ball."""
    script = "def cal():\n" + "".join(
        f"  movej([{', '.join(f'{v:.9f}' for v in q)}], a=1.2, v=0.5)\n  sleep(2)\n" for q in d.q
    ) + "end\n"  # fmt: skip
    header = ";".join(f"Ball {t + 1} {axis} (mm)" for t in range(TARGETS) for axis in "XYZ")
    rows = "".join(";".join(f"{1e3 * v:.6f}" for v in y.ravel()) + "\n" for y in d.y)
    return Export({"cmm.csv": header + "\n" + rows, "cal.script": script}, joints="cal.script")


def rapid(d: mc.Measurements) -> Export:
    lines = "".join(
        f"  CONST jointtarget p{j + 1:03d}:=[[{','.join(f'{v:.6f}' for v in DEG * d.q[j])}],"
        "[9E9,9E9,9E9,9E9,9E9,9E9]];\n"
        for j in range(POSES)
    )  # fmt: skip
    rows = [
        f"P{j + 1},{t + 1},{','.join(f'{1e3 * v:.6f}' for v in d.y[j, t])}\n"
        for j in range(POSES) for t in range(TARGETS)
    ]  # fmt: skip
    text = "Point,Target,X [mm],Y [mm],Z [mm]\n" + "".join(rows)
    return Export({"t.csv": text, "m.mod": f"MODULE m\n{lines}ENDMODULE\n"}, joints="m.mod")


def french(d: mc.Measurements) -> Export:
    """One table, tabs, a row of units below the header, articulations in radians."""
    header = ["Nom du point", *(f"Articulation {i + 1}" for i in range(6))]
    header += [f"Cible{t + 1}_{axis}" for t in range(TARGETS) for axis in "XYZ"] + ["Température"]
    units = ["", *["rad"] * 6, *["mm"] * 9, "°C"]
    lines = ["\t".join(header), "\t".join(units)]
    lines += [
        "\t".join([f"n{j}", *(f"{v:.9f}" for v in d.q[j]),
                   *(f"{1e3 * v:.6f}" for v in d.y[j].ravel()), "20.5"])
        for j in range(POSES)
    ]  # fmt: skip
    return Export({"mesures.txt": "\n".join(lines) + "\n"})


def spanish(d: mc.Measurements) -> Export:
    """A row for each point, the joints repeated; eje, punto, hora."""
    head = "Punto;" + ";".join(f"Eje {i + 1} (°)" for i in range(6)) + ";X (mm);Y (mm);Z (mm);Hora"
    rows = [
        ";".join([f"P{j + 1}-{t + 1}", *(comma(v) for v in DEG * d.q[j]),
                  *(comma(1e3 * v) for v in d.y[j, t]), f"11:{j:02d}:{t:02d}"])
        for j in range(POSES) for t in range(TARGETS)
    ]  # fmt: skip
    return Export({"medidas.csv": head + "\n" + "\n".join(rows) + "\n"})


def chinese(d: mc.Measurements) -> Export:
    head = ["测点", *(f"关节{i + 1}\uff08度\uff09" for i in range(6))]
    head += [f"靶球{t + 1}_{a}坐标" for t in range(TARGETS) for a in "XYZ"] + ["温度\uff08℃\uff09"]
    rows = [
        ",".join([f"{j + 1}", *(f"{v:.6f}" for v in DEG * d.q[j]),
                  *(f"{1e3 * v:.6f}" for v in d.y[j].ravel()), "21.0"])
        for j in range(POSES)
    ]  # fmt: skip
    return Export({"数据.csv": ",".join(head) + "\n" + "\n".join(rows) + "\n"},
                  {"units": "smr=mm"})  # fmt: skip


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


def excel(d: mc.Measurements) -> Export:
    head: list[object] = ["Pkt", *(f"A{i + 1} [Grad]" for i in range(6))]
    head += [f"T{t + 1} {axis} [mm]" for t in range(TARGETS) for axis in "XYZ"]
    rows: list[list[object]] = [["Messung vom 24.11.2026"], head]
    rows += [[j + 1, *(DEG * d.q[j]).tolist(), *(1e3 * d.y[j]).ravel().tolist()]
             for j in range(POSES)]  # fmt: skip
    return Export({"Messung.xlsx": workbook(rows)}, says=("left out: line 1",))


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
    make.__name__: make
    for make in (german, krl, ur, rapid, french, spanish, chinese, excel, nameless, numbered)
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
    match = match_names(points, poses)
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
