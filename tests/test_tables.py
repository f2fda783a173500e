import math
from pathlib import Path

import pytest

from minimax_cal.errors import CalibrationError
from minimax_cal.files import json_text, write_whole
from minimax_cal.tables import Table

TABLE = Table(
    "errors & more",
    ("name", "RMS mm", "poses"),
    (("[bold]a|b[/]", 0.12345, 7), ("c_d", math.nan, 10)),
    ("", ".3f", "d"),
)


def test_one_number_reads_the_same_everywhere() -> None:
    for text in (TABLE.text(), TABLE.markdown(), TABLE.latex()):
        assert "0.123" in text
        assert "0.1234" not in text
        assert "nan" not in text.lower()
    assert "0.12345" in TABLE.csv()  # full precision for further work


def test_cells_are_literal_text() -> None:
    assert "[bold]a|b[/]" in TABLE.text()
    assert r"a\|b" in TABLE.markdown()
    assert r"c\_d" in TABLE.latex()
    assert r"errors \& more" in TABLE.latex()


def test_files_are_whole_or_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    write_whole(path, "first")
    monkeypatch.setattr("os.replace", lambda *a: (_ for _ in ()).throw(OSError(28, "disk full")))
    with pytest.raises(CalibrationError, match="disk full"):
        write_whole(path, "second")
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]  # no scrap left
    with pytest.raises(ValueError, match="JSON"):
        json_text({"x": math.nan})
