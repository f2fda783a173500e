"""A session is a folder; no name leads out of it, and no choice breaks it."""

import os
import stat
import time
from collections.abc import Iterable
from pathlib import Path

import pytest

from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.webapp.sessions import (
    CHOICES_FILE,
    RESERVED_NAME_PATTERN,
    UPLOAD_FOLDER,
    Session,
    check_file_name,
    create_session_folder,
    list_sessions,
    open_session,
    remove_abandoned_partial_files,
)


@pytest.fixture
def at(tmp_path: Path) -> Session:
    made = create_session_folder(tmp_path, "Cell 7: the blue one")
    (made.folder / UPLOAD_FOLDER / "poses.csv").write_text("q1_deg\n")
    return made


@pytest.mark.parametrize(
    "name",
    ["../x.csv", "a/b.csv", "a\\b.csv", "/etc/passwd", "..", ".", "", ".hidden", "-o", "con",
     "NUL.csv", "Con .txt", "com\u00b9.csv", "lpt9", "aux.tar.gz", "\u6e2c" * 100,
     "a\0b", "a\nb", "a.csv ", "a.", "x" * 121, "C:poses.csv", "a\u202egpj.csv"],
)  # fmt: skip
def test_names_that_are_refused(at, name):
    with pytest.raises(OptionError, match=r"^file name "):
        at.resolve_file(UPLOAD_FOLDER, name)


@pytest.mark.parametrize("name", ["poses.csv", "Meßwerte (2).txt", "smr_1.txt", "T_ROB1.mod"])
def test_names_that_serve(name):
    assert check_file_name(name) == name


def test_a_link_leads_nowhere_else(at, tmp_path):
    (tmp_path / "secret").write_text("x")
    os.symlink(tmp_path / "secret", at.folder / "fit.json")
    with pytest.raises(OptionError, match="leads out"):
        at.resolve_file("fit.json")


def test_sessions_have_names_of_their_own(at, tmp_path):
    other = create_session_folder(tmp_path, "Cell 7: the blue one")
    assert (at.name, other.name) == ("cell-7-the-blue-one", "cell-7-the-blue-one-2")
    assert create_session_folder(tmp_path, "../..").folder.parent == tmp_path
    assert {one.name for one in list_sessions(tmp_path)} >= {at.name, other.name}
    for name in ("", "..", "none", "../x", "Cell"):
        with pytest.raises(OptionError, match="no session"):
            open_session(tmp_path, name)


@pytest.mark.parametrize("title", ["con", "NUL", "prn.", " aux ", "Com1", "lpt9...", "con...  "])
def test_no_session_has_the_name_of_a_device(tmp_path, title):
    made = create_session_folder(tmp_path, title)
    assert not RESERVED_NAME_PATTERN.fullmatch(made.name)
    assert open_session(tmp_path, made.name).folder.is_dir()


def test_a_folder_in_capitals_is_the_same_where_the_system_says_so(tmp_path):
    (tmp_path / "CELL").mkdir()
    assert create_session_folder(tmp_path, "cell").name == "cell-2"


def test_a_session_that_cannot_be_made_leaves_no_folder(tmp_path, monkeypatch):
    monkeypatch.setattr("minimax_cal.webapp.sessions.LOG_FOLDER", "x" * 300)
    with pytest.raises(CalibrationError, match="cannot be made"):
        create_session_folder(tmp_path, "cell")
    assert list(tmp_path.iterdir()) == []


def test_choices_are_kept_as_they_were_made(at):
    at.update_choices(
        {"measured": ["poses.csv"], "robot": "irb120", "left_out": ["12:smr2"], "rms": 0.2}
    )
    again = Session(at.folder).choices
    assert again.measured == ("poses.csv",)
    assert again.left_out == ("12:smr2",)
    assert (again.robot, again.rms, again.most) == ("irb120", 0.2, None)


@pytest.mark.parametrize(
    "changes",
    [{"measured": ["../x"]}, {"measured": ["none.csv"]}, {"robot": "nobody"}, {"rms": -1},
     {"rms": float("nan")}, {"left_out": ["x; rm"]}, {"objective": "best"}, {"poses": 0},
     {"unknown": 1}, {"measured": "poses.csv"}, {"units": "x" * 3000},
     {"units": "a\0b"}, {"columns": "a\nb"}, {"units": "\ud800"},
     {"left_out": [f"{line}:smr1" for line in range(100_000)]}, {"measured": ["poses.csv"] * 1000},
     {"reasons": {f"{line}:smr1": "knocked" for line in range(100_000)}}],
)  # fmt: skip
def test_choices_that_are_refused_change_nothing(at, changes):
    before = at.update_choices({"measured": ["poses.csv"]})
    with pytest.raises(OptionError):
        at.update_choices(changes)
    assert at.choices == before


def test_a_removed_file_is_chosen_no_more(at):
    at.update_choices({"measured": ["poses.csv"], "joints": "poses.csv"})
    left = at.remove_uploaded_file("poses.csv")
    assert (left.measured, left.joints) == ((), "")
    assert at.list_uploaded_files() == []


@pytest.mark.parametrize(
    "change",
    [lambda at: at.remove_uploaded_file("poses.csv"),
     lambda at: at.choose_files_and_delete_replaced("measured", ["new.csv"], {}),
     lambda at: at.choose_files_and_delete_replaced("targets", ["poses.csv"], {})],
    ids=["remove", "take", "targets"],
)  # fmt: skip
def test_files_stay_where_choices_cannot_be_written(at, change):
    """A file goes only once no choice is about it."""
    (at.folder / CHOICES_FILE).write_text("{")
    with pytest.raises(OptionError, match=r"session\.json"):
        change(at)
    assert at.list_uploaded_files() == ["poses.csv"]


def test_a_file_that_is_gone_keeps_no_other_choice(at):
    at.update_choices({"measured": ["poses.csv"]})
    (at.folder / UPLOAD_FOLDER / "poses.csv").unlink()
    assert at.update_choices({"rms": 0.1}).rms == 0.1
    assert at.remove_uploaded_file("poses.csv").measured == ()


JOINTS = "Pose,q1_deg,q2_deg\nP1,1,2\nP2,3,4\n"
POINTS = "Pose,x_mm,y_mm,z_mm\nP1,1,2,3\nP2,3,4,5\n"
BOTH = "q1_deg,q2_deg,smr1_x_mm,smr1_y_mm,smr1_z_mm\n1,2,3,4,5\n3,4,5,6,7\n"
NO_HEADER = "1 2 3\n4 5 6\n"


def take_measured(at: Session, names: Iterable[str]) -> None:
    at.choose_files_and_delete_replaced(
        "measured", [*names], {n: at.read_content_kinds(n) for n in {*names, *at.choices.measured}}
    )


@pytest.mark.parametrize(
    ("before", "dropped", "left"),
    [
        ({"a.csv": JOINTS}, {"b.csv": POINTS}, ["a.csv", "b.csv"]),
        ({"a.csv": JOINTS, "b.csv": POINTS}, {"c.csv": POINTS}, ["a.csv", "c.csv"]),
        ({"a.csv": JOINTS, "b.csv": POINTS}, {"c.csv": BOTH}, ["c.csv"]),
        ({"a.csv": BOTH}, {"b.csv": POINTS, "c.csv": JOINTS}, ["b.csv", "c.csv"]),
        ({"a.csv": BOTH}, {"a.csv": POINTS}, ["a.csv"]),
        ({"a.txt": NO_HEADER}, {"b.txt": NO_HEADER}, ["a.txt", "b.txt"]),  # of another target
        ({}, {"a.csv": POINTS, "b.csv": POINTS}, ["a.csv", "b.csv"]),  # at once
    ],
)
def test_a_dropped_file_replaces_what_holds_the_same(at, before, dropped, left):
    for files in (before, dropped):
        for name, text in files.items():
            (at.folder / UPLOAD_FOLDER / name).write_text(text)
        if files:
            take_measured(at, files)
    assert list(at.choices.measured) == left
    assert set(at.list_uploaded_files()) == {"poses.csv", *left}


def test_targets_replace_those_before_and_robots_stay_to_choose(at):
    for name in ("a.csv", "b.csv", "arm.json", "other.json"):
        (at.folder / UPLOAD_FOLDER / name).write_text("x")
    for kind, names in (("targets", ("a.csv", "b.csv")), ("robot", ("arm.json", "other.json"))):
        for name in names:
            at.choose_files_and_delete_replaced(kind, [name], {})
    assert (at.choices.targets, at.choices.robot) == ("b.csv", "other.json")
    assert at.list_uploaded_files() == ["arm.json", "b.csv", "other.json", "poses.csv"]
    for kind, names in (("report", ["a.csv"]), ("robot", []), ("robot", ["../x"])):
        with pytest.raises(OptionError):
            at.choose_files_and_delete_replaced(kind, names, {})


def test_a_session_is_full_at_last(at, monkeypatch):
    assert at.available_bytes("new.csv") == 256 << 20
    monkeypatch.setattr("minimax_cal.webapp.sessions.MAX_SESSION_BYTES", 10)
    assert at.available_bytes("new.csv") == 3  # beside the seven bytes of the one that is there
    assert at.available_bytes("poses.csv") == 10  # in its place
    monkeypatch.setattr("minimax_cal.webapp.sessions.MAX_UPLOADED_FILES", 1)
    with pytest.raises(OptionError, match="remove some"):
        at.available_bytes("new.csv")


@pytest.mark.parametrize("text", ["{", "[" * 100_000], ids=["cut", "deep"])
def test_choices_that_somebody_broke_are_told(at, text):
    (at.folder / CHOICES_FILE).write_text(text)
    with pytest.raises(OptionError, match=r"session\.json"):
        at.choices  # noqa: B018


def test_the_stamp_changes_with_every_file(at):
    before = at.list_file_versions()
    assert at.list_file_versions() == before
    (at.folder / "fit.json").write_text("{}")
    assert at.list_file_versions() != before


def test_files_that_are_being_written_take_their_room(at, monkeypatch):
    """Two that are sent at once must not fill a session beyond its limit."""
    monkeypatch.setattr("minimax_cal.webapp.sessions.MAX_SESSION_BYTES", 1000)
    part = at.reserve_upload_file("large.csv", 900)
    assert part.stat().st_size == 900
    assert at.list_uploaded_files() == ["poses.csv"]  # it is not there yet
    assert at.available_bytes("new.csv") == 1000 - 900 - 7
    monkeypatch.setattr("minimax_cal.webapp.sessions.MAX_UPLOADED_FILES", 2)
    with pytest.raises(OptionError, match="remove some"):
        at.available_bytes("new.csv")


def test_parts_that_a_killed_server_left_are_removed(at):
    old, new = at.reserve_upload_file("old.csv", 10), at.reserve_upload_file("new.csv", 10)
    os.utime(old, (time.time() - 7200.0,) * 2)
    remove_abandoned_partial_files(at.folder.parent)
    assert not old.exists()
    assert new.exists()


@pytest.mark.skipif(os.name == "nt", reason="permissions are those of POSIX")
def test_sessions_are_private(at):
    folders = (at.folder, at.folder / UPLOAD_FOLDER, at.folder / "log")
    assert {stat.S_IMODE(path.stat().st_mode) for path in folders} == {0o700}
    assert stat.S_IMODE(at.reserve_upload_file("x.csv", 3).stat().st_mode) == 0o600
