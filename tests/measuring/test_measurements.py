from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from minimax_cal.measuring.grouping import groups, split

HEAD = "q1_rad,q2_rad,smr1_x_mm,smr1_y_mm,smr1_z_mm"
GOOD = HEAD + "\n0.1,0.2,1,2,3\n0.3,0.4,4,5,6\n"


def read(text: str | bytes, tmp_path: Path) -> mc.Measurements:
    path = tmp_path / "m.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return mc.read_measurements(path)


def test_units_stand_in_the_header(tmp_path):
    data = read("q1_deg,q2_mm,smr2_x_m,smr2_y_mm,smr2_z_mm,u95_mm\n90,100,1,2,3,0.05\n", tmp_path)
    assert_allclose(data.q, [[np.pi / 2, 0.1]], rtol=1e-15)
    assert_allclose(data.y, [[[1.0, 0.002, 0.003]]], rtol=1e-15)
    assert_array_equal(data.sliding, [False, True])
    assert data.target_names == ("smr2",)
    assert_allclose(data.columns["u95"], [5e-5])


def test_empty_cells_are_targets_not_measured(tmp_path):
    head = HEAD + ",smr2_x_mm,smr2_y_mm,smr2_z_mm"
    data = read(f"{head}\n0,0,,,,1,2,3\n0,1,1,2,3,,,\n1,1,,,,,,\n", tmp_path)
    assert_array_equal(data.seen, [[False, True], [True, False]])
    assert "1 rows hold no measured target" in data.notices[0]


def test_unknown_columns_are_kept_with_a_notice(tmp_path):
    data = read(GOOD.replace("z_mm\n", "z_mm,operator,tempeture_C\n").replace("\n", ",\n")
                .replace("3,\n", "3,ann,20\n").replace("6,\n", "6,bob,21\n").replace("_C,", "_C"),
                tmp_path)  # fmt: skip
    assert list(data.unknown["operator"]) == ["ann", "bob"]
    assert any("column operator is not used" in note for note in data.notices)
    assert any("did you mean temperature_C" in note for note in data.notices)


@pytest.mark.parametrize("codec", ["cp1252", "utf-8-sig", "utf-16"])
def test_a_german_spreadsheets_csv_is_read(codec, tmp_path):
    text = "Messung vom 3. M\u00e4rz \u2013 Halle 2\n" + GOOD.replace(",", ";").replace(".", ",")
    data = read(text.replace("\n", "\r\n").encode(codec), tmp_path)
    assert_array_equal(data.q, read(GOOD, tmp_path).q)
    assert_array_equal(data.line, [3, 4])
    assert data.notices == (f"{data.source}: above the table, and left out: line 1",)


def test_other_words_are_read_with_a_line_that_says_how(tmp_path):
    truth = mc.simulate("irb120", 12, 1, 5).data
    head = ";".join([*(f"Achse {j + 1} [°]" for j in range(6)), "X [mm];Y [mm];Z [mm];Werkzeug"])
    rows = [*(";".join(f"{v:.7f}" for v in (*np.degrees(q), *(1e3 * y[0]))) + ";Prüfkugel"
              for q, y in zip(truth.q, truth.y, strict=True))]  # fmt: skip
    data = read("\n".join([head, *rows]).replace(".", ",").encode("cp1252"), tmp_path)
    assert_allclose(data.q, truth.q, rtol=0, atol=1e-8)
    assert_allclose(data.y, truth.y, rtol=0, atol=1e-9)
    assert set(data.columns["tool"]) == {"Prüfkugel"}
    assert "semicolon, decimal comma, latin-1: 12 poses, 6 joints" in data.notices[-1]
    bare = head.replace(" [°]", "") + "\n0,1;0,2;0,3;0,4;0,5;0,6;100,5;20,5;30,5;A"
    with pytest.raises(mc.DataError, match="units='q=deg'"):
        read(bare, tmp_path)


def test_what_a_tool_is_called_beside_own_names(tmp_path):
    text = GOOD.replace("z_mm", "z_mm,Werkzeug").replace("3\n", "3,A\n").replace("6\n", "6,B\n")
    assert read(text, tmp_path).target_names == ("smr1@A", "smr1@B")


def test_a_spreadsheet_is_named(tmp_path):
    with pytest.raises(mc.DataError, match=r"m\.csv: is a spreadsheet, not text; save it as CSV"):
        read(b"PK\x03\x04\x00\xff", tmp_path)


def test_byte_order_mark_crlf_and_trailing_commas_are_fine(tmp_path):
    text = ("\ufeff" + GOOD.replace("\n", ",\r\n")).encode()
    assert read(text, tmp_path).poses == 2


@pytest.mark.parametrize(
    ("text", "say"),
    [
        ("", "is empty"),
        (HEAD + "\n", "no rows"),
        (GOOD.replace("q2_rad", "q3_rad"), "column q2_rad is missing"),
        (GOOD.replace("q1_rad,q2_rad", "a,b"), "no joint columns"),
        (GOOD.replace("q2_rad", "q2_deg"), "mix _rad and _deg"),
        (GOOD.replace("q2_rad", "q1_rad"), "stands twice"),
        (GOOD.replace("smr1_y_mm", "smr1_y"), "column smr1_y_mm is missing"),
        (GOOD.replace("smr1", "tcp"), "no target columns"),
        (GOOD.replace("0.3,0.4", "0.3,abc"), ":3: column q2_rad: 'abc' is not a number"),
        (GOOD.replace("0.3,0.4", "0.3,"), ":3: column q2_rad: is empty"),
        (GOOD.replace("0.3,0.4", "0.3,nan"), ":3: column q2_rad: nan is not a finite"),
        (GOOD.replace("4,5,6", "4,inf,6"), ":3: column smr1_y_mm: inf is not a finite"),
        (GOOD.replace("4,5,6", "4,,6"), ":3: smr1 has some of x, y, z only"),
        (GOOD.replace("4,5,6", "4,5"), ":3: 4 cells, but the header has 5"),
        (GOOD.replace("4,5,6", "4,5,6,7"), ":3: 6 cells, but the header has 5"),
        (GOOD.replace("4,5,6", '"4,5",5,6'), "use a decimal point"),
        (HEAD + "\n0,0,,,\n", "no target was measured"),
        (HEAD + ",smr2_x_mm,smr2_y_mm,smr2_z_mm\n0,0,1,2,3,,,\n", "smr2 is measured at no pose"),
        (HEAD + "\n0,0,1,2,3\n1,0,1,2,3\n2,0,1,2,3\n", "all points of smr1 are the same"),
        (GOOD.replace("4,5,6", "4,5,1e12"), ":3: smr1 is more than 100 km away"),
        (GOOD.replace("4,5,6", "4,5,1_000"), "'1_000' is not a number"),
        (
            GOOD.replace("z_mm", "z_mm,u95_mm").replace("3\n", "3,0\n").replace("6\n", "6,1\n"),
            ":2: column u95_mm: 0 is not positive",
        ),
        (b"\xff\xfe\x00", "not a text file"),
        (b"q1_rad\x00", "not a text file"),
    ],
)
def test_broken_files_name_line_and_column(text, say, tmp_path):
    with pytest.raises(mc.DataError) as caught:
        read(text, tmp_path)
    assert say in str(caught.value)
    assert "m.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_written_measurements_come_back(tmp_path):
    rng = np.random.default_rng(1)
    y = rng.normal(size=(5, 2, 3))
    y[2, 1] = np.nan
    columns = {"u95": np.full(5, 1e-4), "order": np.arange(5), "session": np.array(list("aabbb"))}
    columns |= {"tau1": rng.normal(size=5), "qread2": rng.normal(size=5), "time": np.arange(5.0)}
    data = mc.measurements(rng.normal(size=(5, 3)), y, **columns)
    mc.write_measurements(tmp_path / "w.csv", data)
    again = mc.read_measurements(tmp_path / "w.csv")
    assert again.notices == ()
    assert_allclose(again.q, data.q, atol=1e-9)
    assert_allclose(again.y, data.y, atol=1e-9)
    assert set(again.columns) == set(columns)
    assert_allclose(again.columns["u95"], columns["u95"], rtol=1e-8)
    assert_array_equal(again.columns["session"], columns["session"])


def test_rows_of_one_pose_stay_together():
    rng = np.random.default_rng(2)
    q = rng.normal(size=(20, 6))[np.repeat(np.arange(20), 3)]
    data = mc.measurements(q, rng.normal(size=(60, 3)))
    for seed in range(5):
        train, held, _ = split(data, 0.3, seed)
        assert held.poses == 18
        assert not set(map(tuple, train.q)) & set(map(tuple, held.q))
    labels = np.array([""] * 58 + ["p", "p"])
    labels[0] = "p"  # rows 0-2 and 57-59 are the same pose by name
    named = mc.measurements(q, rng.normal(size=(60, 3)), pose=labels)
    assert len(np.unique(groups(named))) == 19


def test_the_split_column_decides(tmp_path):
    text = HEAD + ",split\n0,0,1,2,3,train\n1,0,1,2,3,holdout\n"
    train, held, notices = split(read(text, tmp_path), 0.5, 0)
    assert (train.poses, held.poses) == (1, 1)
    assert "split column" in notices[0]
    with pytest.raises(mc.DataError, match=":3: column split: 'test'"):
        split(read(text.replace("holdout", "test"), tmp_path), 0.5, 0)


def test_the_same_seed_gives_the_same_split():
    data = mc.measurements(np.arange(40.0).reshape(20, 2), np.eye(20)[:, :3])
    first, second, other = (split(data, 0.25, seed)[1].q for seed in (3, 3, 4))
    assert_array_equal(first, second)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize(
    ("column", "value", "says"),
    [
        ("temperature", -500.0, "column temperature_C: -500 cannot be"),
        ("payload", -2.0, "column payload_kg: -2 cannot be"),
        ("tau3", 2e80, "column tau3_Nm: 2e\\+80 cannot be"),
        ("base2_y", -1e12, "column base2_y_mm: -1e\\+15 cannot be"),
        ("qread4", 1e50, "column qread4: 1e\\+50 cannot be"),
        ("u95", 1e305, "column u95_mm: 1e\\+308 cannot be"),
    ],
)
def test_what_cannot_be_is_refused(column, value, says):
    q, y = np.random.default_rng(0).normal(size=(2, 6, 3))
    values = np.full(6, 1.0 if column != "u95" else 1e-5)
    values[3] = value
    with pytest.raises(mc.DataError, match=f"4: {says}"):
        mc.measurements(q, y, **{column: values})


SIX = ",".join(f"q{i}_rad" for i in range(1, 7)) + ",smr1_x_mm,smr1_y_mm,smr1_z_mm"


@pytest.mark.parametrize("side", [0.5, 7.0])
def test_an_approach_is_a_sign(side, tmp_path):
    rows = "\n0.1,0.2,1,2,3,-1\n0.3,0.4,4,5,6,{}\n0.3,0.5,4,5,7,\n"
    with pytest.raises(mc.DataError, match=f"m.csv:3: column approach2: {side:g} is no sign"):
        read(HEAD + ",approach2" + rows.format(side), tmp_path)
    assert read(HEAD + ",approach2" + rows.format(0), tmp_path).columns["approach2"][1] == 0.0


@pytest.mark.parametrize(
    ("one", "other"),
    [("u95_mm", "u95_m"), ("qread1_rad", "qread1_deg"), ("base1_x_mm", "base1_x_m")],
)
def test_a_column_in_two_units_is_refused(one, other, tmp_path):
    with pytest.raises(mc.DataError, match=f"m.csv:1: {one} and {other} are one column"):
        read(f"{HEAD},{one},{other}\n0.1,0.2,1,2,3,0.1,0.1\n0.3,0.4,4,5,6,0.1,0.1\n", tmp_path)


@pytest.mark.parametrize(
    ("column", "why"),
    [
        ("approach9", "the file has no joint 9"),
        ("approach0", "the file has no joint 0"),
        ("tau9_Nm", "the file has no joint 9"),
        ("qread9_rad", "the file has no joint 9"),
        ("base1_x_mm", "base1_y_mm is missing"),
    ],
)
def test_a_column_of_no_use_is_kept_with_a_notice(column, why, tmp_path):
    data = read(f"{SIX},{column}\n0,0,0,0,0,0,1,2,3,1\n1,0,0,0,0,0,4,5,6,-1\n", tmp_path)
    assert list(data.unknown[column]) == ["1", "-1"]
    assert data.notices == (f"{data.source}: column {column} is not used: {why}",)


def test_rows_pasted_twice_count_once(tmp_path):
    head, one, two, three = HEAD, "0.1,0.2,1,2,3", "0.3,0.4,4,5,6", "0.3,0.5,4,5,6.5"
    data = read("\n".join([head, one, two, three, one, two, three, two]) + "\n", tmp_path)
    assert_array_equal(data.line, [2, 3, 4])
    (said,) = data.notices
    assert "lines 5-7 repeat lines 2-4, line 8 repeats line 3 in every cell" in said
    visits = [f"{row},{i}" for i, row in enumerate([one, two, one])]
    assert read("\n".join([head + ",order", *visits]) + "\n", tmp_path).poses == 3


@pytest.mark.parametrize("first", ["pose", "session"])
def test_a_row_whose_name_begins_like_a_comment_is_a_row(first, tmp_path):
    rows = [f"{'#' if i % 2 else ''}{i},{0.1 * i},1,2,{i}" for i in range(6)]
    text = "\n".join(["# made by hand", f"{first},q1_rad,smr1_x_mm,smr1_y_mm,smr1_z_mm", *rows])
    (tmp_path / "n.csv").write_text(text + "\n")
    data = mc.read_measurements(tmp_path / "n.csv")
    assert data.poses == 6
    assert list(data.columns[first]) == ["0", "#1", "2", "#3", "4", "#5"]


def test_a_payload_beside_joints_in_words_is_no_point(tmp_path):
    head = "Achse 1 [rad],Achse 2 [rad],X [mm],Y [mm],Z [mm],payload_kg,payload_x_mm,payload_y_mm,"
    rows = [f"{0.1 * i},{0.2 * i * i},{i},2,3,1.5,10,20,30" for i in range(6)]
    (tmp_path / "n.csv").write_text("\n".join([head + "payload_z_mm", *rows]) + "\n")
    data = mc.read_measurements(tmp_path / "n.csv")
    assert data.target_names == ("smr1",)


def test_a_cell_of_very_many_digits_is_refused_at_once(tmp_path):
    (tmp_path / "m.csv").write_text(f"q1_rad,smr1_x_mm\n0.1,{'1' * 200_000}x\n")
    with pytest.raises(mc.DataError):
        mc.read_measurements(tmp_path / "m.csv")
