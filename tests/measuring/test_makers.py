"""Exports of ten set-ups as makers' programs write them: each is read at the first try, whole."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_exports import workbook  # stands beside this

import minimax_cal as mc
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.importers import import_files

POSES, TARGETS = 48, 3


@dataclass(frozen=True)
class Export:
    """files, joints: as given to the import.  gap: pose and target that the tracker missed.

    order: in which the joints' file has the poses.  says: what the notices must name.
    """

    files: tuple[str, ...]
    joints: str | None
    gap: tuple[int, int]
    order: Array
    says: tuple[str, ...] = ()


def comma(value: float, digits: int = 4) -> str:
    return f"{value:.{digits}f}".replace(".", ",")


def clock(i: int) -> tuple[int, int, int]:
    at = 9 * 3600 + 12 * 60 + 47 * i
    return at // 3600, at // 60 % 60, at % 60


def hour(i: int) -> str:
    return "{:02d}:{:02d}:{:02d}".format(*clock(i))


def german(i: int) -> str:
    return f"17.03.2026 {hour(i)}"


def iso(i: int) -> str:
    return f"2026-03-17 {hour(i)}"


def american(i: int) -> str:
    h, m, s = clock(i)
    return f"3/17/2026 {(h - 1) % 12 + 1}:{m:02d}:{s:02d} {'AM' if h < 12 else 'PM'}"


def seen(gap: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """Poses and targets that were measured."""
    return ((i, k) for i in range(POSES) for k in range(TARGETS) if (i, k) != gap)


def put(path: Path, lines: list[str], encoding: str = "utf-8", end: str = "\n") -> str:
    path.write_text(end.join(lines) + end, encoding=encoding, newline="")
    return path.name


def put_workbook(path: Path, sheets: dict[str, list[list[object]]]) -> str:
    path.write_bytes(workbook(sheets))
    return path.name


def leica_kuka(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Export:
    """German, decimal comma, points shuffled, a preamble with a stray quotation mark."""
    gap = (16, 1)
    rows = [
        f"P{i + 1}_{k + 1};{';'.join(map(comma, y[i, k]))};{comma(rng.uniform(0.004, 0.012))};"
        f"{comma(21.3, 1)};{german(3 * i + k)}"
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
    return Export((points,), joints, gap, np.arange(POSES), ("P17", "line 1, 2, 3, 4", "151"))


def sa_ur(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Export:
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
            for i in range(POSES)
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
    return Export((points,), joints, gap, np.arange(POSES), ("R1",))


def faro_abb(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Export:
    """French, UTF-16, tabs, a row of units, nominal columns between; RAPID with a robtarget."""
    gap = (30, 2)
    out = [
        "FARO CAM2 Measure 10\tRapport d'inspection", "Pièce :\tRobot IRB 120", "",
        "Nom\tType\tX mesuré\tY mesuré\tZ mesuré\tX nominal\tÉcart X\tTempérature\tDate\tHeure",
        "\t\t[mm]\t[mm]\t[mm]\t[mm]\t[mm]\t[°C]\t\t",
    ]  # fmt: skip
    out += [
        f"jp{10 * (i + 1)}_{k + 1}\tPoint\t" + "\t".join(map(comma, y[i, k]))
        + f"\t{comma(y[i, k, 0] + 0.3, 3)}\t-0,300\t{comma(20.4, 2)}\t17/03/2026\t{hour(3 * i + k)}"
        for i, k in seen(gap)
    ]  # fmt: skip
    home = "[[364.35,0,594],[0.5,0,0.866025,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"
    program = ["MODULE Calib", "  ! poses", f"  CONST robtarget pHome:={home};"]
    program += [
        f"  CONST jointtarget jp{10 * i}:=[[{','.join(f'{v:.5f}' for v in values)}],"
        "[9E9,9E9,9E9,9E9,9E9,9E9]];"
        for i, values in enumerate(q, 1)
    ]
    program += [f"    MoveAbsJ jp{10 * i},v200,fine,tool0;" for i in range(1, POSES + 1)]
    points = put(folder / "rapport.txt", out, "utf-16")
    joints = put(folder / "Calib.mod", [*program, "ENDMODULE"])
    return Export((points,), joints, gap, np.arange(POSES), ("jp310",))


def pcdmis_fanuc(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Export:
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
    program += [f"{i:4d}:J P[{i}] 20% FINE    ;" for i in range(1, POSES + 1)] + ["/POS"]
    for i, values in enumerate(q, 1):
        axes = [f"J{j}= {value:9.4f} deg" for j, value in enumerate(values, 1)]
        program += [f"P[{i}]{{", "   GP1:", "\tUF : 0, UT : 1,\t"]
        program += ["\t" + ",\t".join(axes[:3]) + ",", "\t" + ",\t".join(axes[3:]), "};"]
    points = put(folder / "report.txt", out)
    return Export(
        (points,), put(folder / "CALIB.LS", [*program, "/END"]), gap, np.arange(POSES), ("P[5]",)
    )


def calypso_workbook(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Export:
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
    order = rng.permutation(POSES)
    rows: list[list[object]] = [
        ["Achswerte Meca500", ""], ["Stand:", "17.03.2026"], [],
        ["Punkt", *(f"Achse {j + 1} [°]" for j in range(6)), "Bemerkung"],
    ]  # fmt: skip
    rows += [[f"P{i + 1}", *(float(v) for v in q[i]), "" if i else "Start"] for i in order]
    cover: list[list[object]] = [["Kalibrierung"], ["Halle 3"]]
    points = put(folder / "Kalibrierung_1_chr.txt", [*out, "END"], "latin-1")
    joints = put_workbook(folder / "achsen.xlsx", {"Deckblatt": cover, "Achsen": rows})
    return Export((points,), joints, gap, order, ("P12",))


def polyworks_yaskawa(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Export:
    """Spanish, nominal and deviation beside each coordinate, statistics below; S, L, U, R, B, T."""
    gap = (20, 1)
    out = [
        "PolyWorks|Inspector 2022 IR5", "Proyecto;Celda 4", "Unidades;Milímetros", "",
        "Nombre;X nominal;X medido;Desv. X;Y nominal;Y medido;Desv. Y;Z nominal;Z medido;Desv. Z;"
        "Temperatura;Fecha y hora",
    ]  # fmt: skip
    for i, k in seen(gap):
        each = [f"{comma(round(v), 3)};{comma(v)};{comma(v - round(v))}" for v in y[i, k]]
        out.append(f"Esfera{k + 1}_P{i + 1};{';'.join(each)};22,1;17/03/2026 {hour(3 * i + k)}")
    out += ["Media;;;0,0012;;;0,0009;;;-0,0003;;", "Desv. est.;;;0,2871;;;0,2900;;;0,2799;;"]
    turned = [
        "Posición;S (grados);L (grados);U (grados);R (grados);B (grados);T (grados);Velocidad (%)"
    ]
    turned += [f"P{i};{';'.join(comma(v, 5) for v in row)};25" for i, row in enumerate(q, 1)]
    points = put(folder / "puntos.csv", out, "utf-8-sig")
    joints = put(folder / "posiciones.csv", turned, "latin-1")
    says = ("P21", "Media (line 149)", "Desv. est. (line 150)")
    return Export((points,), joints, gap, np.arange(POSES), says)


def api_chinese(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Export:
    """Chinese, in GB 18030; joints shuffled."""
    gap, order = (40, 2), rng.permutation(POSES)
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
    return Export((points,), joints, gap, order, ("P41",))


def leica_inches(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Export:
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
    return Export((points,), joints, gap, np.arange(POSES), ("P34", "line 21"))


def wide_workbook(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Export:
    """A workbook by hand: groups over the names, units below them, means below the rows."""
    gap, order = (25, 1), rng.permutation(POSES)
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
    return Export((name,), None, gap, order, (f"below the table, and left out: line {POSES + 8}",))


def axyz_ur(folder: Path, q: Array, y: Array, rng: np.random.Generator) -> Export:
    """A file a target in columns of blanks, one point exported twice; lists with names."""
    gap, names = (14, 2), []
    for k in range(TARGETS):
        out = [f"! Axyz LTM export  workpiece SMR{k + 1}   units: mm"]
        out += ["!  PointID          X             Y             Z      sX     sY     sZ"]
        for i in rng.permutation(POSES):
            if (i, k) != gap:
                place = " ".join(f"{v:13.4f}" for v in y[i, k])
                out += [f"   P{i + 1:<6d} {place}   0.008  0.009  0.007"] * (1 + ((i, k) == (3, 1)))
        names.append(put(folder / f"SMR{k + 1}.txt", out))
    lists = [
        f"P{i} [{', '.join(f'{v:.7f}' for v in row)}]" for i, row in enumerate(np.radians(q), 1)
    ]
    joints = put(folder / "poses.txt", lists)
    return Export(tuple(names), joints, gap, np.arange(POSES), ("P15", "twice"))


Maker = Callable[[Path, Array, Array, np.random.Generator], Export]
MAKERS: tuple[Maker, ...] = (
    leica_kuka, sa_ur, faro_abb, pcdmis_fanuc, calypso_workbook, polyworks_yaskawa, api_chinese,
    leica_inches, wide_workbook, axyz_ur,
)  # fmt: skip


@pytest.mark.parametrize("make", MAKERS)
def test_an_export_is_read_as_it_is(make, tmp_path, rng):
    """No option: every joint, every point, the gap left empty, and all that is left out listed."""
    truth = mc.simulate("irb2600", POSES, TARGETS, 5).data
    export = make(tmp_path, np.degrees(truth.q), 1e3 * truth.y, rng)
    joints = tmp_path / export.joints if export.joints else None
    found = import_files([tmp_path / name for name in export.files], joints).data
    kept = found.take(np.arange(POSES))
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
    truth = mc.simulate("irb2600", POSES, TARGETS, 5).data
    export = make(tmp_path, np.degrees(truth.q), 1e3 * truth.y, rng)
    lines = (tmp_path / name).read_text().splitlines()
    place = next(i for i, text in enumerate(lines) if text.startswith(line))
    (tmp_path / name).write_text("\n".join([*lines[:place], lines[place], *lines[place:]]))
    with pytest.raises(mc.DataError, match=words):
        import_files([tmp_path / each for each in export.files], tmp_path / (export.joints or ""))
