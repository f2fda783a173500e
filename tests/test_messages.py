"""What people read: messages of Python know no command line, and every command's help is whole."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import click
import pytest
from conftest import ROOT

import minimax_cal as mc
from minimax_cal.cli.command_group import COMMAND_MODULES, HELP_ALL_FLAG
from minimax_cal.cli.command_runner import cli
from minimax_cal.cli.options import (
    MOST_USED_OPTION_GROUP,
    MOST_USED_OPTIONS,
    RESULT_OPTION_GROUP,
    CommandWithGroupedHelp,
    GroupedOption,
    replace_arguments_by_flags,
)

PACKAGE = ROOT / "minimax_cal"
FLAG = re.compile(r"(?:^|[\s(`'\"])(?:--[a-z]|-[oq]\b)")
# whose strings are options of a browser, of Dask, and of commands that a message proposes
THEIRS = {
    "browser_print.py",
    "parallel.py",
    "joint_spans.py",
    "file_mistakes.py",
    "instrument_slips.py",
}


def strings(tree: ast.AST) -> Iterator[ast.Constant]:
    """Text that the code may show: no docstrings, no names of options."""
    hidden = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    hidden |= {
        id(k.value) for k in ast.walk(tree) if isinstance(k, ast.keyword) and k.arg == "flag"
    }
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in hidden
        ):
            yield node


def test_messages_of_python_speak_of_no_flag():
    theirs = {"cli", "webapp"}  # the page writes the command lines that do the same
    rooms = [path for path in PACKAGE.rglob("*.py") if not theirs & set(path.parts)]
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.value!r}"
        for path in rooms
        if path.name not in THEIRS
        for node in strings(ast.parse(path.read_text()))
        if FLAG.search(node.value)
    ]
    assert len(rooms) > 200
    assert not found, "\n".join(found)


def test_the_command_line_calls_arguments_by_its_options(tmp_path, refuses, says):
    plan = cli.commands["plan"]
    for said, shown in (
        ("candidates=5: give more", "--candidates 5: give more"),
        ("approach='both' is about revisits: give revisit=", "--approach both is about revisits: "
         "give --revisit"),
        ("give another tracker=, normals= or reach=.", "give another --tracker, --normals or "
         "--range."),
        ("per_metre=-1 must be", "--noise-per-metre -1 must be"),
        ("units='q=deg' is no option here, nor is q=3", "units='q=deg' is no option here, nor is "
         "q=3"),
    ):  # fmt: skip
        assert replace_arguments_by_flags(said, plan) == shown
    mend = "minimax-cal import a.csv --mend joints=1:3:2:4:5:6 -o b.csv"
    assert replace_arguments_by_flags(mend, cli.commands["import"]) == mend
    with pytest.raises(mc.OptionError, match=r"^candidates=5: "):
        mc.plan("irb120", 8, candidates=5)
    assert says("plan irb120 --poses 8 --candidates 5", code=2).err.startswith(
        "error: --candidates 5: "
    )
    (tmp_path / "raw.csv").write_text("1,2,3,4,5,6,7,8,9\n2,3,4,5,6,7,8,9,1\n")
    with pytest.raises(mc.DataError, match=r"say what they are, as columns='"):
        mc.import_files([tmp_path / "raw.csv"])
    refuses("as --columns smr1_mm,q_deg (6 joints) or --columns", "import", tmp_path / "raw.csv")


def test_the_first_help_is_twelve_commands_on_one_screen(says):
    brief, whole = says("--help").out, says(HELP_ALL_FLAG).out
    assert len(brief.splitlines()) <= 30
    listed, more = (re.findall(r"^  ([a-z]\w+)  ", out, re.M) for out in (brief, whole))
    assert len(listed) == 12
    assert more == list(COMMAND_MODULES)
    rest = " ".join(brief.partition("More:")[2].partition("\n\n")[0].split())
    assert rest == ", ".join(more[12:])
    assert brief.endswith(f"\nEvery command in a line: minimax-cal {HELP_ALL_FLAG}\n")


@pytest.mark.parametrize("name", COMMAND_MODULES)
def test_help_is_in_groups_and_whole_sentences(name, says):
    command = cli.commands[name]
    assert isinstance(command, CommandWithGroupedHelp)
    brief, out = says(name, "--help").out, says(name, HELP_ALL_FLAG).out
    assert len(brief.splitlines()) <= 40
    assert max(map(len, brief.splitlines())) <= 80
    titles = re.findall(r"^(\S.*):$", out, re.M)
    assert titles[-1] == RESULT_OPTION_GROUP
    assert len(titles) == len(set(titles))
    options = [p for p in command.params if isinstance(p, click.Option)]
    first = MOST_USED_OPTIONS.get(name, "").split()
    groups = {p.group or RESULT_OPTION_GROUP for p in options if isinstance(p, GroupedOption)}
    assert groups <= {
        *titles,
        *(p.group for p in options if p.name in first and isinstance(p, GroupedOption)),
    }
    if first:
        assert len(first) == 10
        assert titles[0] == MOST_USED_OPTION_GROUP
        part = out.partition(f"{MOST_USED_OPTION_GROUP}:")[2].partition(f"\n{titles[1]}:")[0]
        assert len(re.findall(r"^  -", part, re.M)) == 10
        assert (
            brief
            == out.partition(f"\n{titles[1]}:")[0]
            + f"\nEvery option: minimax-cal {name} {HELP_ALL_FLAG}\n"
        )
    else:
        assert brief == out
    assert len(options) <= 15 or first
    for each in options:
        text = re.sub(r" \[default: [^]]*\]", "", each.help or "")
        assert re.match(r"[A-Z]|u95", text), f"{name} {each.name}: {text!r}"
        assert text.endswith("."), f"{name} {each.name}: {text!r}"
        assert len(text.split()) > 2, f"{name} {each.name}: {text!r}"
