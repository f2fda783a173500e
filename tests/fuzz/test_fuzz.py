"""Hostile runs of every command; more of them by `python -m tests.fuzz`."""

from __future__ import annotations

import csv
import io
import json
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import minimax_cal as mc
from minimax_cal.cli import main
from minimax_cal.cli.command_runner import cli
from minimax_cal.core.errors import CalibrationError
from minimax_cal.robots.robot import robot_from_dict

from .__main__ import table_of
from .cases import EACH, PLAIN, TEMPLATES, Case, case, each_option
from .known import FATAL, HARMLESS, disagreement, with_known
from .material import material
from .running import GOOD, Outcome, judged, outcomes

CASES, SEED = 20, 20260101
MANY, FRESH = 10_000, 20260707

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="limits are those of POSIX")


WILD = """<mujoco><worldbody><body><joint axis="0 1 0" stiffness="-1e6"/>
<geom size="0.1" pos="0.3 0 0" mass="1"/></body></worldbody></mujoco>"""  # parses, and runs away


def bad(found: list[Outcome]) -> list[Outcome]:
    return [each for each in found if each.kind not in GOOD]


def test_hostile_runs_end_well():
    found = list(outcomes(SEED, range(CASES)))
    assert len(found) == CASES
    assert bad(found) == []
    assert {each.kind for each in found} >= {"ok", "refusal"}


@pytest.mark.slow
def test_command_lines_that_nobody_broke_work():
    """A template that fails by itself would hide whatever is broken in it."""
    found = list(outcomes(PLAIN, range(len(TEMPLATES))))
    assert [(TEMPLATES[each.number], each.kind) for each in found if each.kind != "ok"] == []


@pytest.mark.slow
def test_ten_thousand_hostile_runs_end_well():
    assert bad(list(outcomes(FRESH, range(MANY)))) == []


def test_a_case_comes_again_by_its_number():
    one, other = case(5, 17), case(5, 17)
    assert (one.arguments, one.files) == (other.arguments, other.files)
    left = {line.split()[0] for line in TEMPLATES} - {"robots", "backends", "diagnose"}
    for number in range(900):
        left.discard(case(5, number).command)
        if not left:
            break
    assert not left


# ---- the judge is not blind -----------------------------------------------------------------


def judge(
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    command: Callable[[list[str]], None],
    expect: str = "",
    arguments: tuple[str, ...] = ("robots", "--json"),
) -> str:
    """The kind that the judge finds when the command line does this."""
    from . import running

    monkeypatch.chdir(folder)
    monkeypatch.setattr(running, "main", command)
    (folder / "in.csv").write_bytes(b"a")
    one = Case(0, 0, arguments, {"in.csv": b"a"}, ("something",), expect)
    return judged(one)[0]


def leave(code: int, err: str = "", out: str = "", write: str = "") -> Callable[[Any], None]:
    def command(_: Any) -> None:
        sys.stderr.write(err)
        sys.stdout.write(out)
        if write:
            Path(write).write_text("<script>alert(1)</script>")
        raise SystemExit(code)

    return command


def crash(_: Any) -> None:
    raise KeyError("x")


@pytest.mark.parametrize(
    ("command", "expect", "kind"),
    [
        (leave(0), "", "ok"),
        (leave(2, "error: no\n"), "", "refusal"),
        (leave(1, "error: no\n"), "", "failure"),
        (leave(2, "no\n"), "", "unclear"),
        (leave(1, "error: operands could not be broadcast\n"), "", "unclear"),
        (leave(0, "notice: \x1b[31m\n"), "", "unclear"),
        (leave(0, "", "{NaN"), "", "unclear"),
        (leave(2, "error: no\n", write="new.json"), "", "damage"),
        (leave(0, write="in.csv"), "", "damage"),
        (leave(0, write="out.html"), "", "silently wrong"),
        (leave(0), "noticed", "silently wrong"),
        (leave(0, "notice: check the units\n"), "noticed", "ok"),
        (leave(7), "", "crash"),
        (crash, "", "traceback"),
    ],
)
def test_the_judge_sees(command, expect, kind, tmp_path, monkeypatch):
    assert judge(monkeypatch, tmp_path, command, expect) == kind


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("import a.csv -o out.csv", "q1_rad,smr1_x_mm"),
        ("export fit.json --to urdf -o out.urdf", "<robot"),
        ("export fit.json --to json -o out.json", "{}"),
        ("gap arm.xml data.csv --write out.xml", WILD),
    ],
)
def test_what_is_written_is_read_again(words, text, tmp_path, monkeypatch):
    if "<mujoco" in text:
        pytest.importorskip("mujoco")

    def command(_: Any) -> None:
        Path(words.split()[-1]).write_text(text)
        raise SystemExit(0)

    kind = judge(monkeypatch, tmp_path, command, arguments=tuple(words.split()))
    assert kind == "silently wrong"


def test_the_independent_code_agrees_and_catches():
    files = material()
    data = files["data.csv"]
    answer = files["fit.json"].decode()
    assert disagreement(answer, data, None) == ""
    content = json.loads(answer)
    content["accuracy"]["holdout"]["rms_mm"] += 1e-3
    assert disagreement(json.dumps(content), data, None).startswith("holdout: says")
    content = json.loads(answer)
    content["robot"]["joints"][1]["a"] += 0.1
    assert "train: says" in disagreement(json.dumps(content), data, None)


def test_the_independent_code_knows_the_arm_before_calibration(tmp_path, capsys):
    files = material()
    for name in ("fit.json", "data.csv"):
        (tmp_path / name).write_bytes(files[name])
    fit, data = files["fit.json"], files["data.csv"]
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["evaluate", f"{tmp_path}/fit.json", f"{tmp_path}/data.csv", "--rung", "0", "--json"])
    answer = capsys.readouterr().out
    assert json.loads(answer)["rung"] == "nominal"
    assert disagreement(answer, data, fit, nominal=True) == ""
    assert disagreement(answer, data, fit).startswith("says")


def test_every_option_of_every_command_is_among_the_cases():
    lines = each_option()
    given = {(words[0], flag) for words in lines for flag in words}
    for name in {line.split()[0] for line in TEMPLATES}:
        for part in cli.commands[name].params:
            if isinstance(part, click.Option) and "--pdf" not in part.opts:
                assert (name, max(part.opts, key=len)) in given
    assert len(set(lines)) == len(lines)
    some = range(0, len(lines), len(lines) // 5)
    assert bad(list(outcomes(EACH, some))) == []


@pytest.mark.parametrize("way", [*HARMLESS, *FATAL])
def test_known_changes_do_what_they_say(way):
    """Harmless ones leave what is measured; fatal ones do not."""
    raw = material()["data.csv"]
    changed = with_known(raw, way, np.random.default_rng(2))
    one, other = (
        np.array(sorted(distances(each), key=lambda row: row[0])) for each in (raw, changed)
    )
    same = one.shape == other.shape and np.allclose(one, other, rtol=0, atol=1e-6)
    assert same == (way in HARMLESS)


def distances(raw: bytes) -> list[list[float]]:
    """First joint and sizes of all points, in SI, of each row."""
    rows = [row for row in csv.reader(io.StringIO(raw.decode())) if any(row)]
    unit = {"rad": 1.0, "deg": np.pi / 180, "mm": 1e-3, "m": 1.0}
    names = sorted(rows[0])
    out = []
    for row in rows[1:]:
        cells = dict(zip(rows[0], row, strict=True))
        values = {n.rsplit("_", 1)[0]: float(cells[n]) * unit[n.rsplit("_", 1)[1]]
                  for n in names if n[:1] in "qs" and n.rsplit("_", 1)[-1] in unit}  # fmt: skip
        out.append([values[key] for key in sorted(values)])
    return out


def test_the_table_counts_everything_once():
    found = [
        Outcome(0, "a", "ok", "", (), 1.0),
        Outcome(1, "a", "hang", "", (), 1.0),
        Outcome(2, "b", "ok", "", (), 1.0),
    ]
    table = table_of(found)
    count = dict(zip(table.header, table.rows[-1], strict=True))
    assert count["cases"] == 3
    assert count["ok"] == 2
    assert count["hang"] == 1
    assert Counter(row[0] for row in table.rows) == {"a": 1, "b": 1, "all": 1}


# ---- whatever a reader is given ---------------------------------------------------------------

LEAF = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
KEY = st.sampled_from(
    ["name", "joints", "a", "d", "theta", "sign", "units", "length", "type", "up"]
)
TREE = st.recursive(
    LEAF,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEY | st.text(max_size=3), inner),
    max_leaves=20,
)
QUIET = settings(deadline=None, derandomize=True, max_examples=100)


@QUIET
@given(st.dictionaries(KEY, TREE))
def test_any_tree_is_a_robot_or_refused(tree):
    with suppress(CalibrationError):
        assert robot_from_dict(tree).joints > 0


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("readers") / "file"


@QUIET
@given(st.lists(st.lists(LEAF.map(str) | st.sampled_from(["q1_rad", "smr1_x_mm"]), max_size=5)))
def test_any_text_is_measurements_or_refused(scratch, rows):
    scratch.write_text("\n".join(map(",".join, rows)), errors="replace")
    with pytest.raises(CalibrationError):
        mc.read_measurements(scratch)


@QUIET
@given(TREE)
def test_any_json_is_no_fit(scratch, tree):
    scratch.write_text(json.dumps(tree))
    with pytest.raises(CalibrationError):
        mc.load_fit(scratch)
