"""Files as people have them, at every door: read right, or one line with the place and the mend."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from measuring.test_exports import workbook
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.compensation.target_file import read_target_file
from minimax_cal.core.arrays import Array
from minimax_cal.dynamics.logs import read_log_files
from minimax_cal.measuring.campaigns import read_campaigns
from minimax_cal.robots.robot import load_robot

POSES = 24
NAMES = [f"P{i + 5:03d}" for i in range(POSES)]
ROUNDED = 2e-6  # of four decimals, in degrees [rad] and mm [m]
JOINTS = range(1, 7)


@pytest.fixture(scope="module")
def truth() -> mc.Measurements:
    return mc.simulate("irb120", POSES, 1, seed=3).data


def point(value: float) -> str:
    return f"{value:.4f}"


def comma(value: float) -> str:
    return point(value).replace(".", ",")


def thousands(value: float) -> str:
    return f"{value:,.4f}"


def swiss(value: float) -> str:
    return f"{value:,.4f}".replace(",", "'")


def spanish(value: float) -> str:
    return f"{value:,.4f}".translate(str.maketrans(",.", ".,"))


def table(
    head: Sequence[str],
    q: Array,
    y: Array,
    sign: Callable[[float], str] = point,
    delimiter: str = ";",
    big: Callable[[float], str] | None = None,
) -> list[str]:
    """A header over a row a pose: name, joints, point."""
    cells = (
        [name, *map(sign, a), *map(big or sign, b)] for name, a, b in zip(NAMES, q, y, strict=True)
    )
    return [delimiter.join(row) for row in (head, *cells)]


GERMAN = ["Punkt", *(f"Achse {j} [°]" for j in JOINTS), "X [mm]", "Y [mm]", "Z [mm]"]
FRENCH = ["Nom du point", *(f"Axe {j} (deg)" for j in JOINTS),
          *(f"Coordonnée {axis} (mm)" for axis in "XYZ")]  # fmt: skip
CHINESE = ["点名", *(f"关节{j}(度)" for j in JOINTS), *(f"{axis}坐标(毫米)" for axis in "XYZ")]
SPANISH = ["Punto", *(f"Eje {j} [grados]" for j in JOINTS), "X [mm]", "Y [mm]", "Z [mm]"]
DIN = ["Punkt", *(f"Achse {j} / °" for j in JOINTS), "X / mm", "Y / mm", "Z / mm"]
TORN = [f'"Achse {j}\n[°]"' for j in JOINTS]


def german(q: Array, y: Array) -> bytes:
    above = [
        "Messprotokoll;Größe der Kugel: 38,1 mm",
        "Prüfer;Müller",
        ";Roboterachsen;;;;;;Punkt;;",
    ]
    below = ["", "Mittelwert;;;;;;;" + ";".join(map(comma, y.mean(axis=0))), "Ende"]
    return "\r\n".join([*above, *table(GERMAN, q, y, comma), *below]).encode("cp1252")


def french(q: Array, y: Array) -> bytes:
    below = "Moyenne\t\t\t\t\t\t\t" + "\t".join(map(comma, y.mean(axis=0)))
    return "\n".join([*table(FRENCH, q, y, comma, "\t"), below]).encode("utf-16")


def groups(q: Array, y: Array) -> bytes:
    head = ["No", "Name", *(f"J{j} [deg]" for j in JOINTS), "X [mm]", "Y [mm]", "Z [mm]"]
    rows = [[i, NAMES[i], *map(float, (*q[i], *y[i]))] for i in range(POSES)]
    above = [["", "", "Joints", *[""] * 5, "Measured"], head]
    return workbook({"Info": [["Customer", "ACME"], ["Order", 4711]], "Data": [*above, *rows]})


def units_below(q: Array, y: Array) -> bytes:
    rows = table(["Punkt", *(f"A{j}" for j in JOINTS), *"XYZ"], q, y, point, "\t")
    return "\n".join([rows[0], "\t".join(["", *["°"] * 6, *["mm"] * 3]), *rows[1:]]).encode(
        "utf-8-sig"
    )


def text(rows: Sequence[str], encoding: str = "utf-8") -> bytes:
    return ("\n".join(rows) + "\n").encode(encoding)


RADIANS = ["Name", *(f"q{j} [rad]" for j in JOINTS), "smr1_x_mm", "smr1_y [mm]", "smr1_z_mm"]
READ: dict[str, Callable[[Array, Array], bytes]] = {
    "german.csv": german,
    "french.txt": french,
    "chinese.csv": lambda q, y: text(table(CHINESE, q, y, point, ","), "gbk"),
    "spanish.csv": lambda q, y: text(table(SPANISH, q, y, comma, big=spanish), "utf-8-sig"),
    "quoted.csv": lambda q, y: text(
        table(GERMAN, q, y, lambda v: f'"{point(v)}"', ",", big=lambda v: f'"{thousands(v)}"')
    ),
    "swiss.csv": lambda q, y: text(table(GERMAN, q, y, big=swiss)),
    "din.csv": lambda q, y: text(table(DIN, q, y, comma)),
    "groups.xlsx": groups,
    "units.tsv": units_below,
    "minus.csv": lambda q, y: text(
        [row.replace("-", "\N{MINUS SIGN}") for row in table(GERMAN, q, y)]
    ),
    "no_mark.csv": lambda q, y: text(table(GERMAN, q, y, comma), "utf-16-le"),
    "two_lines.csv": lambda q, y: text(table(["Punkt", *TORN, *GERMAN[7:]], q, y, comma)),
    "brackets.csv": lambda q, y: text(table(RADIANS, np.radians(q), y, lambda v: f"{v:.7f}")),
    "own_joints.csv": lambda q, y: text(
        table(["Name", *(f"q{j}_deg" for j in JOINTS), "X [mm]", "Y [mm]", "Z [mm]"], q, y)
    ),
    "wrapped.csv": lambda q, y: text([f'"{row}"' for row in table(GERMAN, q, y)]),
    "bars.csv": lambda q, y: text(table(GERMAN, q, y, point, "|")),
    "capitals.csv": lambda q, y: text(
        table(["NAME", *(f"J{j} [DEG]" for j in JOINTS), "X1 [MM]", "Y1 [MM]", "Z1 [MM]"], q, y)
    ),
    "prefixes.csv": lambda q, y: text(
        table(
            ["No.", *(f"Robot J{j} (deg)" for j in JOINTS), *(f"Tracker {a} mm" for a in "XYZ")],
            q,
            y,
        )
    ),
    "from_0.csv": lambda q, y: text(
        table(
            ["Name", *(f"actual_q_{j - 1} [deg]" for j in JOINTS), "X [mm]", "Y [mm]", "Z [mm]"],
            q,
            y,
        )
    ),
    "greek.csv": lambda q, y: text(
        table(["Punkt", *(f"θ{j} [°]" for j in JOINTS), *GERMAN[7:]], q, y)
    ),
    "of_all.csv": lambda q, y: text([*table(GERMAN, q, y), "", "Temperatur: ;21.5"]),
    "remark.csv": lambda q, y: text([*table(GERMAN, q, y), "Total: 24 Punkte"]),
}


@pytest.mark.parametrize("name", READ)
def test_measurements_are_read_as_they_are(name, truth, tmp_path):
    path = tmp_path / name
    path.write_bytes(READ[name](np.degrees(truth.q), 1e3 * truth.y[:, 0]))
    data = mc.read_measurements(path)
    assert_allclose(data.q, truth.q, rtol=0, atol=ROUNDED)
    assert_allclose(data.y, truth.y, rtol=0, atol=ROUNDED)
    assert any("left out" in text for text in data.notices) == (
        name in ("german.csv", "french.txt", "of_all.csv", "remark.csv")
    )
    assert list(data.columns.get("pose", NAMES)) == NAMES


def test_what_was_not_measured_may_be_said_in_words(truth, tmp_path):
    q, y = np.degrees(truth.q), 1e3 * truth.y[:, 0]
    for i, word in enumerate(("n/a", "---", "#N/A", "-", "")):
        rows = table(GERMAN, q, y)
        rows[4] = ";".join([*rows[4].split(";")[:7], word, word, word])
        (tmp_path / f"{i}.csv").write_bytes(text(rows))
        data = mc.read_measurements(tmp_path / f"{i}.csv")
        assert_allclose(data.y, np.delete(truth.y, 3, axis=0), rtol=0, atol=ROUNDED)


def changed(line: int, cells: Callable[[list[str]], list[str]]) -> Callable[[list[str]], list[str]]:
    """Rows with one line changed, which is counted from 1."""
    return lambda rows: [
        ";".join(cells(row.split(";"))) if n == line else row for n, row in enumerate(rows, 1)
    ]


BARE = ["Name", *["q [rad]"] * 6, "X [mm]", "Y [mm]", "Z [mm]"]
REFUSED: list[tuple[Callable[[list[str]], list[str]], str]] = [
    (lambda rows: [*rows, "P1;2", "P2;3"], ":26: 2 cells, but the header has 10; complete the row"),
    (lambda rows: [*rows[:9], "P1;2"], ":10: 2 cells, but the header has 10"),
    (
        changed(9, lambda cells: [*cells[:8], "12.5.3", cells[9]]),
        ":9: column Y .*'12.5.3' is not a n",
    ),
    (
        changed(9, lambda cells: [*cells[:9], "1.269,3"]),
        "decimal point; use a decimal point in all",
    ),
    (changed(1, lambda cells: BARE), "twice; number the joints, as q1_rad, q2_rad, not q .rad"),
]


def test_one_torn_line_of_many_is_left_out_and_named(truth, tmp_path):
    """Not where rows are matched by their order, or where each row is a target to drive to."""
    rows = table(GERMAN, np.degrees(truth.q), 1e3 * truth.y[:, 0])
    for line in (rows[0], rows[8] + ";1", rows[8][:40]):  # the header once more, a cell too many
        rows[8] = line
        (tmp_path / "x.csv").write_bytes(text(rows))
        data = mc.read_measurements(tmp_path / "x.csv")
        assert_allclose(data.y, np.delete(truth.y, 7, axis=0), rtol=0, atol=ROUNDED)
        assert any(said.endswith("1 torn line is left out (9)") for said in data.notices)
    with pytest.raises(mc.DataError, match=":9: the line is torn; complete it or delete it"):
        read_target_file(tmp_path / "x.csv")


@pytest.mark.parametrize(("change", "said"), REFUSED)
def test_a_slip_is_named_with_its_line(change, said, truth, tmp_path, capsys):
    rows = table(GERMAN, np.degrees(truth.q), 1e3 * truth.y[:, 0])
    (tmp_path / "x.csv").write_bytes(text(change(rows)))
    with pytest.raises(mc.DataError, match=said):
        mc.read_measurements(tmp_path / "x.csv")
    assert run("calibrate", "irb120", str(tmp_path / "x.csv")) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_files_joined_by_the_order_of_rows_say_so(truth, tmp_path):
    q, y = np.degrees(truth.q), 1e3 * truth.y[:, 0]
    rows = table(GERMAN, q, y, comma)
    (tmp_path / "j.csv").write_bytes(text([";".join(row.split(";")[1:7]) for row in rows]))
    (tmp_path / "p.csv").write_bytes(text([";".join(row.split(";")[7:]) for row in rows]))
    data = read_campaigns([tmp_path / "j.csv", tmp_path / "p.csv"])
    assert_allclose(data.y, truth.y, rtol=0, atol=ROUNDED)
    assert sum(f"matched with {tmp_path / 'j.csv'} by order" in said for said in data.notices) == 1


def test_targets_with_a_payload_in_words(truth, tmp_path):
    head = ["Punkt", *GERMAN[1:7], "Traglast [kg]"]
    rows = [
        [name, *map(comma, q), "1,5"] for name, q in zip(NAMES, np.degrees(truth.q), strict=True)
    ]
    lines = ["Programm;Ablage", *(";".join(row) for row in (head, *rows))]
    (tmp_path / "t.csv").write_bytes(text(lines, "cp1252"))
    found = read_target_file(tmp_path / "t.csv").data
    assert_allclose(found.q, truth.q, rtol=0, atol=ROUNDED)
    assert set(found.columns["payload"]) == {1.5}


TIME = 0.01 * np.arange(1500)
MOVED = np.stack([0.7 * np.sin(TIME * (0.35 * j + 0.35) + j) for j in JOINTS], axis=1)
HELD = 10.0 * np.sin(MOVED) + 0.1 * np.random.default_rng(0).normal(size=MOVED.shape)
LOGS = {
    "words": ("Zeit [ms]", 1e3, "Achse {} Ist [°]", "Drehmoment Achse {} [Nm]", 1.0, "cp1252"),
    "accents": ("Temps (s)", 1.0, "Axe {} (deg)", "Couple axe {} (Nm)", 1.0, "utf-16"),
    "signs": ("时间(秒)", 1.0, "关节{}(度)", "关节{}扭矩(Nm)", 1.0, "gbk"),
    "letters": ("t [s]", 1.0, "A{} [°]", "M{} [Nm]", 1.0, "utf-8-sig"),
    "rtde": ("timestamp", 1.0, "actual_q_{} [deg]", "actual_current_{} [mA]", 1e3, "utf-8"),
}


@pytest.mark.parametrize("kind", LOGS)
def test_logs_are_read_as_they_are(kind, tmp_path):
    """Also where a known format says another unit than it has by itself."""
    time, ms, joint, drive, factor, encoding = LOGS[kind]
    numbers = [j - (kind == "rtde") for j in JOINTS]
    head = [time, *map(joint.format, numbers), *map(drive.format, numbers)]
    values = np.column_stack([ms * TIME, np.degrees(MOVED), factor * HELD])
    rows = [";".join(comma(value) for value in row) for row in values]
    below = "Mittelwert;" + ";".join(map(comma, values.mean(axis=0)[1:]))
    path = tmp_path / "log.csv"
    path.write_bytes(text(["Antriebsprotokoll 3", ";".join(head), *rows, below], encoding))
    found = read_log_files([path])
    (one,) = found.runs
    assert_allclose(one.q, MOVED, rtol=0, atol=ROUNDED)
    assert_allclose(one.torque, HELD, rtol=0, atol=1e-4)
    assert one.unit == ("A" if kind == "rtde" else "N m")
    assert [said.partition(": ")[2] for said in found.notices] == [
        "above the table, and left out: line 1", "below the table, and left out: line 1503"
    ]  # fmt: skip


ROBOTS = {
    "german": (
        ["Gelenk", "Länge a [mm]", "Versatz d [mm]", "theta [°]", "alpha [°]"],
        ";",
        "cp1252",
    ),
    "chinese": (["关节", "a(毫米)", "d(毫米)", "theta(度)", "alpha(度)"], ";", "gbk"),
    "commas": (["Joint", '"a, mm"', '"d, mm"', '"theta, deg"', '"alpha, deg"'], ",", "utf-8-sig"),
    "lines": (["Achse", '"Länge\na [mm]"', '"d\n[mm]"', "theta [°]", "alpha [°]"], ";", "utf-16"),
}


@pytest.mark.parametrize("kind", ROBOTS)
def test_robots_are_read_as_they_are(kind, tmp_path):
    head, delimiter, encoding = ROBOTS[kind]
    drawn = load_robot("irb120").mdh
    rows = [
        [str(j), *(f'"{comma(v)}"' for v in (*(1e3 * row[:2]), *np.degrees(row[2:4])))]
        for j, row in enumerate(drawn, 1)
    ]
    lines = ["# Roboter: IRB 120", "# convention: standard",
             *(delimiter.join(row) for row in (head, *rows))]  # fmt: skip
    (tmp_path / "x.csv").write_bytes(text(lines, encoding))
    found = load_robot(tmp_path / "x.csv")
    assert found.name == "IRB 120"
    assert_allclose(found.mdh[:, :4], drawn[:, :4], rtol=0, atol=ROUNDED)


def test_accents_are_no_chinese_signs(tmp_path):
    """In cp1252 the two letters before the e of Größe are one sign of GB 2312, a rare one."""
    from minimax_cal.reading.text_sheet import read_text_sheet

    for words, encoding in (("Größe; Süßöl; Île", "cp1252"), ("关节, 坐标, 毫米, 镕", "gbk")):
        (tmp_path / "x.csv").write_bytes(words.encode(encoding))
        assert Path(read_text_sheet(tmp_path / "x.csv").path).name == "x.csv"
        assert read_text_sheet(tmp_path / "x.csv").text == words
