"""Two versions compared: what is noticed, what is accepted, and that nothing is left out."""

import json
from pathlib import Path
from typing import Any

import pytest

from minimax_cal.cli.command_group import COMMAND_MODULES
from minimax_cal.compensation.exporters.export_formats import EXPORTERS
from tests import frozen

TEXT = "progress: reading, 3 s\nRMS 0.25 mm after 1.5 s\n"
PAGE = '<p>RMS 0.25 mm</p><script type="application/json">{"y": [1, 2]}</script><style>p {}</style>'


def found(one: Any, other: Any) -> list[str]:
    """What is said to differ between two contents."""
    return list(frozen.differences(one, other, 1e-9, "case"))


@pytest.mark.parametrize(
    ("one", "other", "where"),
    [
        ({"a": 1.0}, {"a": 1.0 + 1e-8}, "case/a: 1.0 and 1.00000001"),
        ({"a": [1.0, [2, "x"]]}, {"a": [1.0, [2, "y"]]}, "case/a[1][1]: 'x' and 'y'"),
        ({"a": 1, "b": 2}, {"a": 1}, "case/b: only before"),
        ({"a": 1}, {"a": 1, "b": None}, "case/b: only now"),
        ({"a": None}, {"a": 0}, "case/a: 'None' and '0'"),
        ({"a": True}, {"a": False}, "case/a: True and False"),
        ([1.0, 2.0], [1.0], "case: 2 and 1 entries"),
        ([1.0, float("nan")], [1.0, 2.0], "case[1]: nan and 2.0"),
    ],
)
def test_a_difference_is_named(one, other, where):
    assert found(one, other) == [where]
    assert found(one, one) == found(other, other) == []


def test_rounding_is_relative_to_the_largest_beside():
    assert found([4e3, 1e-15], [4e3, 3e-15]) == []
    assert found([4e3, 1e-15], [4e3, 5e-6]) != []
    assert found({"a": 1e-15, "b": 4e3}, {"a": 3e-15, "b": 4e3}) != []
    assert found({"seconds": 1.0}, {"seconds": 2.0}) == []
    assert found({"a": {"rms_mm": 1e-12}}, {"a": {"rms_mm": -1e-12}}) == []
    assert found({"a": {"rms_mm": 1e-12}}, {"a": {"rms_mm": 1e-8}}) != []


def test_text_is_words_and_numbers():
    one = frozen.content("", TEXT)
    assert (
        found(one, frozen.content("", TEXT.replace("3 s", "4 s").replace("1.5 s", "2.5 s"))) == []
    )
    assert found(one, frozen.content("", TEXT.replace("0.25", "0.26"))) == [
        "case[0][1]: 0.25 and 0.26"
    ]
    assert found(one, frozen.content("", TEXT.replace("mm", "um"))) != []
    page = frozen.content("a.html", PAGE)
    assert found(page, frozen.content("a.html", PAGE.replace("p {}", "p {color: red}"))) == []
    assert found(page, frozen.content("a.html", PAGE.replace("0.25", "0.2"))) != []
    assert found(page, frozen.content("a.html", PAGE.replace("[1, 2]", "[1, 3]"))) != []


def test_bytes_of_exports_alone_are_compared(tmp_path):
    for name, file in (("export a", "a.json"), ("calibrate a", "a.json"), ("gap a", "a.xml")):
        sides = []
        for text in ('{"a": 1.0}', '{"a":1.0}'):
            answer = {"code": 0, "stdout": "", "stderr": "", "files": {file: text}}
            (tmp_path / f"{name}.answer").write_text(json.dumps(answer))
            sides.append(frozen.answer_of(tmp_path, name))
        expected = [] if name == "calibrate a" else [f"case/files/{file}/bytes"]
        assert [line.split(":")[0] for line in found(*sides) if "bytes" in line] == expected


def test_what_changes_on_purpose_stands_in_tables(monkeypatch):
    monkeypatch.setattr(frozen, "GONE", {"case/*/old": "no longer told"})
    monkeypatch.setattr(frozen, "ADDED", {"case/new": "told now"})
    monkeypatch.setattr(frozen, "CHANGED", {"case/a*": "a better cutoff"})
    monkeypatch.setattr(frozen, "RENAMED", {"was": "is"})
    assert (
        found({"x": {"old": 1}, "a": [1.0], "was": 3}, {"x": {}, "a": [2.0], "is": 3, "new": 4})
        == []
    )
    assert found({"old": 1, "was": 3}, {"is": 4}) == ["case/is: 3 and 4", "case/old: only before"]
    assert found({"x": {"old": 1}}, {"x": {"old": 2}}) == ["case/x/old: 1 and 2"]


def test_every_command_format_and_input_is_in_it():
    asked = frozen.cases(Path("nowhere"))
    without = {
        "serve",
        "backends",
        "tradeoff",
    }  # a server; what is installed; a picture of two ends
    assert {command[0] for command in asked.values()} == set(COMMAND_MODULES) - without
    assert set(frozen.FORMATS) == set(EXPORTERS)
    words = [word for command in asked.values() for word in command]
    kept = {p for p in frozen.INPUTS.rglob("*.*") if p.parts[-2] != "assets"}
    kept -= {frozen.INPUTS / name for name in ("README.md", "posed/parts.xml")}
    assert {p for p in kept if not any(str(p) in word for word in words)} == set()


def test_a_choice_brings_what_it_reads():
    chosen = frozen.chosen_cases(frozen.cases(Path("nowhere")), "evaluate diagnosis")
    assert list(chosen) == ["diagnose compliance", "evaluate diagnosis"]
