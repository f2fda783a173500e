"""Files of measurements, several as sessions, points set aside, tools; texts in one pass."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from minimax_cal.measuring.campaigns import join_campaigns, session_names_from_paths
from minimax_cal.measuring.importers import cmm_reports, robot_programs
from minimax_cal.measuring.measurements import (
    SET_ASIDE_BY_FILE,
    SET_ASIDE_BY_TOOL,
    SET_ASIDE_BY_USER,
    Measurements,
)
from minimax_cal.measuring.pose_groups import group_repeated_poses, split_train_and_holdout
from minimax_cal.measuring.set_aside_points import (
    NO_REASON,
    format_set_aside_count,
    merge_set_aside_points_with_reasons,
    parse_set_aside_cell,
    set_aside_points_named_by_user,
    set_points_aside,
)
from minimax_cal.measuring.tool_targets import join_targets_of_tools, split_targets_by_tool
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.simulate import Simulation, simulate
from minimax_cal.reading import column_words
from minimax_cal.robots.gravity_torques import STANDARD_GRAVITY
from minimax_cal.robots.robot import robot_from_dict

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
    for said in ("column operator is not used", "did you mean temperature_C"):
        assert any(said in note for note in data.notices)


@pytest.mark.parametrize("codec", ["cp1252", "utf-8-sig", "utf-16"])
def test_a_german_spreadsheets_csv_is_read(codec, tmp_path):
    text = "Messung vom 3. M\u00e4rz \u2013 Halle 2\n" + GOOD.replace(",", ";").replace(".", ",")
    data = read(text.replace("\n", "\r\n").encode(codec), tmp_path)
    assert_array_equal(data.q, read(GOOD, tmp_path).q)
    assert_array_equal(data.line, [3, 4])
    assert data.notices == (f"{data.source}: above the table, and left out: line 1",)
    trailing = "\ufeff" + GOOD.replace("\n", ",\r\n")
    assert read(trailing.encode(), tmp_path).poses == 2


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
        (b"PK\x03\x04\x00\xff", "m.csv: is a spreadsheet, not text; save it as CSV"),
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
        train, held, _ = split_train_and_holdout(data, 0.3, seed)
        assert held.poses == 18
        assert not set(map(tuple, train.q)) & set(map(tuple, held.q))
    labels = np.array([""] * 58 + ["p", "p"])
    labels[0] = "p"  # rows 0-2 and 57-59 are the same pose by name
    named = mc.measurements(q, rng.normal(size=(60, 3)), pose=labels)
    assert len(np.unique(group_repeated_poses(named))) == 19


def test_the_split_column_decides(tmp_path):
    text = HEAD + ",split\n0,0,1,2,3,train\n1,0,1,2,3,holdout\n"
    train, held, notices = split_train_and_holdout(read(text, tmp_path), 0.5, 0)
    assert (train.poses, held.poses) == (1, 1)
    assert "split column" in notices[0]
    with pytest.raises(mc.DataError, match=":3: column split: 'test'"):
        split_train_and_holdout(read(text.replace("holdout", "test"), tmp_path), 0.5, 0)


def test_the_same_seed_gives_the_same_split():
    data = mc.measurements(np.arange(40.0).reshape(20, 2), np.eye(20)[:, :3])
    first, second, other = (split_train_and_holdout(data, 0.25, seed)[1].q for seed in (3, 3, 4))
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
    data = read(text + "\n", tmp_path)
    assert data.poses == 6
    assert list(data.columns[first]) == ["0", "#1", "2", "#3", "4", "#5"]


def test_a_payload_beside_joints_in_words_is_no_point(tmp_path):
    head = "Achse 1 [rad],Achse 2 [rad],X [mm],Y [mm],Z [mm],payload_kg,payload_x_mm,payload_y_mm,"
    rows = [f"{0.1 * i},{0.2 * i * i},{i},2,3,1.5,10,20,30" for i in range(6)]
    text = "\n".join([head + "payload_z_mm", *rows]) + "\n"
    assert read(text, tmp_path).target_names == ("smr1",)


def test_a_cell_of_very_many_digits_is_refused_at_once(tmp_path):
    with pytest.raises(mc.DataError):
        read(f"q1_rad,smr1_x_mm\n0.1,{'1' * 200_000}x\n", tmp_path)


# ---- campaigns -----------------------------------------------------------------------------------


DIGITS = 1e-9  # of a millimetre's in a file [m]


def made(seed: int = 0, poses: int = 20, targets: int = 2, **columns: object) -> mc.Measurements:
    rng = np.random.default_rng(seed)
    q, y = rng.uniform(-1.0, 1.0, (poses, 6)), rng.normal(size=(poses, targets, 3))
    return mc.measurements(q, y, **columns)  # type: ignore[arg-type]


def test_files_are_sessions_with_lines_that_count_on(tmp_path):
    parts = [made(seed, poses) for seed, poses in ((0, 20), (1, 15), (2, 12))]
    paths = [tmp_path / f"{name}.csv" for name in ("march", "june", "may")]
    for part, path in zip(parts, paths, strict=True):
        mc.write_measurements(path, part)
    data = mc.read_campaigns(paths)
    assert list(dict.fromkeys(data.columns["session"])) == ["march", "june", "may"]
    assert_allclose(data.q, np.concatenate([part.q for part in parts]), rtol=0, atol=DIGITS)
    assert len(set(data.line)) == data.poses == 47
    own = [mc.read_measurements(path).line for path in paths]
    assert_array_equal(data.line, np.concatenate([own[0], own[1] + 1000, own[2] + 2000]))
    assert any("june.csv from line 1001" in said for said in data.notices)
    assert "march.csv" in data.source
    assert "may.csv" in data.source


def test_one_file_is_read_as_ever(tmp_path):
    path = tmp_path / "march.csv"
    mc.write_measurements(path, made())
    data = mc.read_campaigns([path])
    assert "session" not in data.columns
    assert data.digest == mc.read_measurements(path).digest


def test_targets_go_by_name_and_columns_are_empty_where_a_file_lacks_them():
    one = replace(made(0), target_names=("smr1", "smr3"))
    two = replace(made(1, temperature=np.full(20, 21.0)), target_names=("smr3", "smr2"))
    data = join_campaigns([one, two], ["a", "b"])
    assert data.target_names == ("smr1", "smr3", "smr2")
    assert_array_equal(data.y[:20, 1], one.y[:, 1])
    assert_array_equal(data.y[20:, 1], two.y[:, 0])
    assert_array_equal(data.seen, np.repeat([[1, 1, 0], [0, 1, 1]], 20, axis=0) > 0)
    assert_array_equal(data.columns["temperature"], np.repeat([np.nan, 21.0], 20))


def test_labels_of_poses_mean_something_in_their_own_file_only():
    labels = np.arange(20).astype(str)
    data = join_campaigns([made(0, pose=labels), made(1, pose=labels)], ["a", "b"])
    assert len(set(data.columns["pose"])) == 40


def test_sessions_of_a_file_come_after_its_name():
    two = made(1, session=np.repeat(["am", "pm"], 10))
    data = join_campaigns([made(0), two], ["march", "june"])
    assert list(dict.fromkeys(data.columns["session"])) == ["march", "june/am", "june/pm"]


def test_a_split_of_one_file_leaves_the_others_for_training():
    held = np.where(np.arange(20) < 5, "holdout", "train")
    data = join_campaigns([made(0), made(1, split=held)], ["a", "b"])
    assert_array_equal(data.columns["split"] == "holdout", np.isin(np.arange(40), range(20, 25)))


def test_clocks_that_start_again_follow_each_other():
    time = np.arange(20) * 60.0
    data = add_history_columns(join_campaigns([made(0, time=time), made(1, time=time)], ["a", "b"]))
    assert np.all(np.diff(data.columns["clock"]) > 0.0)
    later = join_campaigns([made(0, time=time), made(1, time=time + 1e6)], ["a", "b"])
    assert_array_equal(later.columns["time"][20:], time + 1e6)


def test_points_set_aside_stay_so():
    points = np.zeros((20, 2), dtype=bool)
    points[3, 1] = True
    two = set_points_aside(made(1), points, "nest knocked", "user")
    data = join_campaigns([made(0), two], ["a", "b"])
    (point,) = data.set_aside
    assert data.aside is not None
    assert point.row == data.aside.line[0] == two.set_aside[0].row + 1000
    assert data.aside.columns["session"][0] == "b"


def test_arms_of_other_joints_are_refused():
    other = mc.measurements(np.zeros((4, 7)), np.random.default_rng(0).normal(size=(4, 3)))
    with pytest.raises(mc.DataError, match=r"has 7 joints.* has 6"):
        join_campaigns([made(), other], ["a", "b"])
    slide = replace(made(), sliding=np.arange(6) == 2)
    with pytest.raises(mc.DataError, match="joint 3 is a length there"):
        join_campaigns([made(), slide], ["a", "b"])


def test_a_campaign_under_two_names_is_refused():
    one, other = (replace(made(), source=name, digest="alike") for name in ("a.csv", "b.csv"))
    with pytest.raises(mc.DataError, match=r"b\.csv: holds the same as a\.csv; a campaign counts"):
        join_campaigns([one, other], ["a", "b"])


def test_names_of_sessions_tell_the_files_apart(tmp_path):
    assert session_names_from_paths(["x/march.csv", "x/june.csv"]) == ["march", "june"]
    assert session_names_from_paths(["x/data.csv", "y/data.csv"]) == ["x/data", "y/data"]
    with pytest.raises(mc.DataError, match="is given twice"):
        session_names_from_paths(["x/data.csv", "x/../x/data.csv"])


# ---- set aside -----------------------------------------------------------------------------------


@pytest.fixture
def measured(noisy: Simulation) -> Measurements:
    """Measurements whose file begins with its header."""
    return replace(noisy.data, simulated=False, line=np.arange(noisy.data.poses) + 2)


def test_only_the_named_points_are_gone(measured):
    data, line = measured, measured.line
    found = set_aside_points_named_by_user(data, [f"{line[0]}:smr2=knocked", str(line[3])])
    assert [(p.row, p.pose, p.target, p.why, p.by) for p in found.set_aside] == [
        (line[0], 1, "smr2", "knocked", SET_ASIDE_BY_USER),
        *((line[3], 4, name, NO_REASON, SET_ASIDE_BY_USER) for name in data.target_names),
    ]
    assert_array_equal(found.line, np.delete(line, 3))  # a pose without a point
    gone = np.zeros(data.seen.shape, dtype=bool)
    gone[0, 1], gone[3] = True, True
    assert_array_equal(found.y, np.where(gone[..., None], np.nan, data.y)[found.line - 2])
    assert found.aside is not None
    assert_array_equal(found.aside.line, line[[0, 3]])
    assert_array_equal(found.aside.y, np.where(gone[..., None], data.y, np.nan)[[0, 3]])
    assert found.notices[-1].startswith("4 points set aside")
    assert_array_equal(merge_set_aside_points_with_reasons(found).y, data.y)
    assert set_aside_points_named_by_user(measured, []) is measured
    assert merge_set_aside_points_with_reasons(measured) is measured


def test_what_is_set_aside_twice_comes_once(measured):
    data = set_aside_points_named_by_user(measured, ["2:smr1", "2:smr1=twice", "3"])
    assert [(p.row, p.target) for p in data.set_aside] == [
        (2, "smr1"), (3, "smr1"), (3, "smr2"), (3, "smr3")]  # fmt: skip
    mask = np.zeros(data.seen.shape, dtype=bool)
    mask[0] = True
    more = set_points_aside(data, mask, "trimmed", SET_ASIDE_BY_TOOL)
    assert [(p.row, p.pose, p.target) for p in more.set_aside[4:]] == [
        (2, 1, "smr2"), (2, 1, "smr3")]  # fmt: skip
    assert_array_equal(merge_set_aside_points_with_reasons(more).y, measured.y)


def test_a_file_keeps_them_with_the_reason_and_who_it_was(measured, tmp_path):
    first, second = tmp_path / "poses.csv", tmp_path / "used.csv"
    mc.write_measurements(first, measured)
    assert run("import", first, "--leave-out", "2:smr1,5=nest, knocked; twice", "-o", second) == 0
    data = mc.read_measurements(second)
    assert 5 not in data.line
    assert np.isnan(data.y[data.line == 2, 0]).all()
    assert {(p.row, p.target) for p in data.set_aside} == {
        (2, "smr1"), (5, "smr1"), (5, "smr2"), (5, "smr3")}  # fmt: skip
    assert {(p.why, p.by) for p in data.set_aside} == {("nest, knocked, twice", SET_ASIDE_BY_USER)}
    assert_allclose(merge_set_aside_points_with_reasons(data).y, measured.y, rtol=0, atol=1e-9)
    mask = np.zeros(data.seen.shape, dtype=bool)
    mask[7, 2] = True
    mc.write_measurements(second, set_points_aside(data, mask, "marked deleted", SET_ASIDE_BY_FILE))
    again = mc.read_measurements(second)
    assert again.set_aside[-1].by == SET_ASIDE_BY_FILE or again.set_aside[0].by == SET_ASIDE_BY_FILE
    assert len(again.set_aside) == 5


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        ("nest knocked", [("", "nest knocked", SET_ASIDE_BY_USER)]),
        ("smr2: too far [file]", [("smr2", "too far", SET_ASIDE_BY_FILE)]),
        ("smr1: a; smr3", [("smr1", "a", SET_ASIDE_BY_USER), ("", "smr3", SET_ASIDE_BY_USER)]),
        ("smr1:", [("smr1", NO_REASON, SET_ASIDE_BY_USER)]),
        ("a: b [x]", [("", "a: b [x]", SET_ASIDE_BY_USER)]),
    ],
)
def test_cells_of_the_column(cell, said):
    assert parse_set_aside_cell(cell) == said


def test_the_column_names_targets_that_are_there(measured, tmp_path):
    path = tmp_path / "poses.csv"
    for cells, said in (
        (["", "smr9: x", *[""] * (measured.poses - 2)], "csv:3: column set_aside: no target smr9"),
        (["smr3: all bad"] * measured.poses, "smr3 is measured at no pose, but for points"),
        (["all bad"] * measured.poses, "every measured point is set aside"),
    ):
        mc.write_measurements(path, replace(measured, columns={"set_aside": np.array(cells)}))
        with pytest.raises(mc.DataError, match=said):
            mc.read_measurements(path)


def test_poses_set_aside_were_visited(measured):
    """The moves of the other poses, and the clock, are those of the whole file."""
    every = add_history_columns(measured)
    found = add_history_columns(set_aside_points_named_by_user(measured, ["9", "10:smr1", "20"]))
    kept = np.isin(every.line, found.line)
    for name, column in found.columns.items():
        assert_array_equal(column, every.columns[name][kept])
    assert found.aside is not None
    for name, column in found.aside.columns.items():
        assert_array_equal(column, every.columns[name][np.isin(every.line, [9, 10, 20])])


def test_how_many_in_words(measured):
    data = set_aside_points_named_by_user(measured, ["3:smr1"])
    assert format_set_aside_count(data.set_aside) == "1 point set aside by the user"
    mask = np.zeros(data.seen.shape, dtype=bool)
    mask[:2, 2] = True
    data = set_points_aside(data, mask, "trimmed", SET_ASIDE_BY_TOOL)
    assert (
        format_set_aside_count(data.set_aside)
        == "3 points set aside (1 by the user, 2 by the program)"
    )


@pytest.mark.parametrize(
    ("points", "said"),
    [("x", "write LINE:TARGET"), ("900000", "no pose stands in line"), ("2:smr9", "smr1, smr2")],
)
def test_a_point_that_is_not_there(points, said, measured, tmp_path, capsys):
    path = tmp_path / "poses.csv"
    mc.write_measurements(path, measured)
    assert run("import", path, "--leave-out", points, "-o", tmp_path / "out.csv") == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()


# ---- tools ---------------------------------------------------------------------------------------


NOISE = 20e-6
APART = np.array([0.03, -0.05, 0.2])  # of the reflectors on one tool and the other [m]
TOOLS = ("gripper", "long probe")


def two_tools(robot: mc.Robot, tmp_path: Path) -> Path:
    """A file of an arm whose tool was changed, rows of both by turns."""
    made = simulate(robot, 80, 2, seed=4)
    other = replace(made.cell, target_positions=made.cell.target_positions + APART)
    rng = np.random.default_rng(0)
    label = np.array([TOOLS[i] for i in rng.integers(0, 2, 80)])
    q = made.data.q
    y = np.where((label == TOOLS[0])[:, None, None], made.cell.predict(q), other.predict(q))
    y[3, 1] = np.nan
    data = mc.measurements(q, y + NOISE * rng.normal(size=y.shape), tool=label)
    path = tmp_path / "tools.csv"
    mc.write_measurements(path, data)
    return path


def test_each_tool_has_reflectors_of_its_own(robot, tmp_path):
    path = two_tools(robot, tmp_path)
    assert "tool" in path.read_text().splitlines()[0].split(",")
    data = mc.read_measurements(path)
    assert set(data.target_names) == {
        f"smr{i}@{tool}" for i in (1, 2) for tool in ("gripper", "long-probe")
    }
    assert not data.notices
    fit = mc.calibrate(robot, data, "sum", holdout=0.25)
    assert fit.accuracy["holdout"].rms_mm < 1.4e3 * NOISE * np.sqrt(3)
    offset = dict(zip(fit.cell.target_names, fit.cell.target_positions, strict=True))
    apart = offset["smr1@long-probe"] - offset["smr1@gripper"]
    assert_allclose(apart, APART, atol=1e-3)  # turned by what the last link is off
    # written and read again it is the same file, and a new file of one tool is predicted
    again = tmp_path / "again.csv"
    mc.write_measurements(again, data)
    assert again.read_text() == path.read_text()
    assert_allclose(split_targets_by_tool(join_targets_of_tools(data)).y, data.y)
    one = tmp_path / "one.csv"
    lines = path.read_text().splitlines()
    kept = [lines[0], *(line for line in lines[1:] if line.endswith("gripper"))]
    one.write_text("\n".join(kept))
    assert mc.read_measurements(one).target_names == ("smr1", "smr2")


def test_a_point_of_a_tool_is_set_aside_by_its_reflector(robot, tmp_path):
    path = two_tools(robot, tmp_path)
    out = tmp_path / "out.csv"
    assert run("import", path, "--leave-out", "12:smr1=knocked", "-o", out, "--quiet") == 0
    data = mc.read_measurements(out)
    (point,) = data.set_aside
    assert point.target.startswith("smr1@")
    assert (point.row, point.why) == (12, "knocked")
    path.write_text(path.read_text().replace("gripper", "", 1))
    with pytest.raises(mc.DataError, match="column tool is empty; name the tool of each pose"):
        mc.read_measurements(path)


def test_torque_of_a_payload_is_that_of_a_mass_at_its_centre():
    robot = robot_from_dict({
        "name": "bar", "units": {"length": "m", "angle": "rad"}, "up": [0, 1, 0],
        "joints": [dict(a=0.5, d=0, theta=0, alpha=0), dict(a=0.4, d=0, theta=0, alpha=0)],
    })  # fmt: skip
    q = np.array([[0.3, 0.4], [1.0, -0.2], [0.0, 0.0]])
    centre = np.array([[0.1, 0.02, 0.0], [0.0, -0.1, 0.3], [np.nan, np.nan, np.nan]])
    mass = np.array([2.0, 5.0, 3.0])
    columns = {f"payload_{a}": centre[:, i] for i, a in enumerate("xyz")}
    data = mc.measurements(q, np.ones((3, 3)) * q.sum(1)[:, None], payload=mass, **columns)
    spot = np.array([[0.05, 0.0, 0.0]])
    cell = Cell(robot, np.eye(4), data.target_names, spot)
    scene: PosedArm = cell.pose_arm(data)
    at = np.where(np.isfinite(centre), centre, spot)
    pose = robot.pose(q)
    place = np.einsum("mij,mj->mi", pose[:, :3, :3], at) + pose[:, :3, 3]
    elbow = 0.5 * np.stack([np.cos(q[:, 0]), np.sin(q[:, 0])], axis=1)
    expected = -STANDARD_GRAVITY * mass * np.stack([place[:, 0], place[:, 0] - elbow[:, 0]])
    assert_allclose(scene.payload_torques, expected, rtol=0, atol=1e-9)
    assert_allclose(scene.payload_centre_in_base.T, place, rtol=0, atol=1e-12)


def test_a_centre_without_its_mass_is_told(tmp_path, robot):
    path = tmp_path / "data.csv"
    data = simulate(robot, 20, 1, seed=1).data
    columns = {**data.columns, **{f"payload_{a}": np.full(20, 0.1) for a in "xyz"}}
    mc.write_measurements(path, replace(data, columns=columns))
    assert "payload_x_mm" in path.read_text()
    notices = mc.read_measurements(path).notices
    assert any("payload_x_mm is not used: the file has no column payload_kg" in n for n in notices)


def test_compliance_counts_where_the_payload_hangs(robot):
    """A heavy load that hangs now here, now there: told where, the fit reaches the noise."""
    made = simulate(robot, 90, 3, seed=8)
    rng = np.random.default_rng(1)
    mass = rng.choice([0.0, 40.0], 90)
    centre = rng.uniform(-0.4, 0.4, (90, 3))
    columns = {f"payload_{a}": centre[:, i] for i, a in enumerate("xyz")}
    whole = mc.measurements(made.data.q, made.data.y, payload=mass, **columns)
    scene = made.cell.pose_arm(whole)
    bend = 2e-6 * scene.gravity.T * robot.sign * [0, 1, 1, 1, 1, 0]
    y = made.cell.predict(made.data.q + bend) + NOISE * rng.normal(size=made.data.y.shape)
    effects = [f"joint_compliance:J{i}" for i in range(2, 6)]
    told = mc.calibrate(robot, whole.with_y(y), "sum", effects=effects, holdout=0.2)
    plain = mc.measurements(made.data.q, y, payload=mass)
    untold = mc.calibrate(robot, plain, "sum", effects=effects, holdout=0.2)
    assert told.accuracy["holdout"].rms_mm < 1.5e3 * NOISE * np.sqrt(3)
    assert untold.accuracy["holdout"].rms_mm > 1.5 * told.accuracy["holdout"].rms_mm


# ---- one pass ------------------------------------------------------------------------------------


TEXTS = (
    "9" * 200_000,
    "P[1]{ " * 40_000,
    "x = {X 1 " * 30_000,
    "{ " * 100_000,
    "[" + " " * 200_000,
    "x = [" + "1, " * 60_000,
)


WORDS = {found for found in vars(column_words).values() if isinstance(found, re.Pattern)}
PATTERNS = [found for module in (cmm_reports, robot_programs) for found in vars(module).values()
            if isinstance(found, re.Pattern) and found not in WORDS]  # fmt: skip
PATTERNS += [language.cartesian for language in robot_programs.PROGRAM_LANGUAGES]


@pytest.mark.parametrize(
    "text", TEXTS, ids=["digits", "positions", "poses", "braces", "blanks", "numbers"]
)
@pytest.mark.parametrize("pattern", PATTERNS)
def test_no_text_takes_more_than_one_pass(pattern, text):
    """Each would take minutes, were its time to grow with the square of its length."""
    assert sum(1 for _ in pattern.finditer(text)) <= len(text)


@pytest.mark.parametrize("cell", ["x_" * 20_000, "pos_x" * 10_000, "x_pos_" * 10_000, "9" * 40_000])
@pytest.mark.parametrize("pattern", sorted(WORDS, key=lambda found: found.pattern))
def test_no_name_takes_more_than_one_pass(pattern, cell):
    """Words are compared with whole cells."""
    assert pattern.fullmatch(cell + "!") is None
