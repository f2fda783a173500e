import math
from xml.etree import ElementTree

import pytest

from minimax_cal.core.errors import CalibrationError
from minimax_cal.core.files import format_json, write_file_atomically
from minimax_cal.core.tables import Table, format_cell

TABLE = Table(
    "errors & more",
    ("name", "RMS mm", "poses"),
    (("[bold]a|b[/]", 0.12345, 7), ("c_d", math.nan, 10)),
    ("", ".3f", "d"),
)


def test_a_table_of_records():
    records = [("a", {"x": 1.5, "seen": True}), ("b", {"x": None, "seen": False})]
    made = Table.from_records(
        "t", records, "0=name | 1.x=size of |x| mm .2f | 1.seen=", "1.x=a | b=c .1f"
    )
    assert made.header == ("name", "size of |x| mm", "", "a | b=c")
    assert made.with_rows(("c", 2, "", 2)).formatted_cells() == [
        ["a", "1.50", "yes", "1.5"], ["b", "-", "", "-"], ["c", "2.00", "", "2.0"]
    ]  # fmt: skip


def test_one_number_reads_the_same_everywhere():
    for text in (TABLE.text(), TABLE.markdown(), TABLE.latex(), TABLE.html()):
        assert "0.123" in text
        assert "0.1234" not in text
        assert "nan" not in text.lower()
    assert "0.12345" in TABLE.csv()  # full precision for further work


@pytest.mark.parametrize(
    ("value", "spec", "text"),
    [(-0.2, ".0f", "0"), (-0.001, ".2f", "0.00"), (-0.6, ".0f", "-1"), (-0.0, "", "0.0"),
     (-12, "d", "-12"), (-0.01, ".2f", "-0.01")],
)  # fmt: skip
def test_nothing_has_no_sign(value, spec, text):
    assert format_cell(value, spec) == text


def test_cells_are_literal_text():
    assert "[bold]a|b[/]" in TABLE.text()
    assert r"a\|b" in TABLE.markdown()
    assert r"c\_d" in TABLE.latex()
    assert r"errors \& more" in TABLE.latex()


def test_html_is_a_table_with_headers():
    table = Table("a < b", ("name", "size mm"), (("<script>x</script>", 1.5), ('"&', math.nan)))
    read = ElementTree.fromstring(table.html())  # well formed, and every letter itself again
    assert read.findtext("caption") == "a < b"
    assert [cell.attrib for cell in read.iter("th")] == [
        {"scope": "col"}, {"scope": "col", "class": "right"}, {"scope": "row"}, {"scope": "row"}
    ]  # fmt: skip
    rows = [[cell.text for cell in row] for row in read.iter("tr")]
    assert rows == [["name", "size mm"], ["<script>x</script>", "1.5"], ['"&', "-"]]


def test_files_are_whole_or_absent(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    write_file_atomically(path, "first")
    monkeypatch.setattr("os.replace", lambda *a: (_ for _ in ()).throw(OSError(28, "disk full")))
    with pytest.raises(CalibrationError, match="disk full"):
        write_file_atomically(path, "second")
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]  # no scrap left
    monkeypatch.undo()
    link = tmp_path / "link.json"
    link.symlink_to(path)
    write_file_atomically(link, "third")
    assert link.is_symlink()
    assert path.read_text() == "third"
    with pytest.raises(ValueError, match="JSON"):
        format_json({"x": math.nan})


def test_a_pipe_is_written_into_not_replaced(tmp_path):
    import os
    import stat
    import threading

    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    received: list[str] = []
    reader = threading.Thread(target=lambda: received.append(pipe.read_text()))
    reader.start()
    write_file_atomically(pipe, "through")
    reader.join(timeout=10)
    assert received == ["through"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)


@pytest.mark.parametrize("width", [110, 80, 60, 40])
def test_no_number_unit_or_name_is_broken(width):
    said = "as 0.333 mrad/N and more words that go on for longer than any line has room for"
    numbers = (0.1234, 12.3456, 1234.5678, 3.3, 0.0001, 22.5)
    header = ("model", *(f"number{i} mrad" for i in range(len(numbers))), "why")
    wide = Table("wide", header, (("joint compliance J2", *numbers, said),), ("", *[".4f"] * 6, ""))
    lines = wide.text(width).splitlines()
    assert max(len(line.rstrip()) for line in lines) <= width
    for part in ("joint compliance J2", *(f"{x:.4f}" for x in numbers), "0.333 mrad/N"):
        assert any(part in line for line in lines), part
    for i in range(len(numbers)):
        assert any(f"number{i}" in line for line in lines)
