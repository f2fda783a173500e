"""Every click is a command line that the command line takes."""

import shlex
from pathlib import Path

import click
import pytest

from minimax_cal.cli.command_runner import cli
from minimax_cal.core.errors import OptionError
from minimax_cal.webapp.sessions import UPLOAD_FOLDER, Session, create_session_folder
from minimax_cal.webapp.step_commands import DIAGNOSIS_FILE, FIT_FILE, POSES_FILE, SESSION_STEPS

RESULT = '{"provenance": {"data_sha256": "abc"}}'


@pytest.fixture
def at(tmp_path: Path) -> Session:
    made = create_session_folder(tmp_path, "cell")
    for name in ("tracker (1).csv", "joints.txt", "targets.csv"):
        (made.folder / UPLOAD_FOLDER / name).write_text("x")
    return made


def lines(at: Session, step: str) -> list[str]:
    return [
        command.format_shell_line()
        for command in SESSION_STEPS[step].build_commands(at, at.choices)
    ]


def everything(at: Session) -> None:
    """A session in which every step can be done."""
    for name in (POSES_FILE, FIT_FILE, DIAGNOSIS_FILE):
        (at.folder / name).write_text(RESULT)
    at.update_choices(
        {"measured": ["tracker (1).csv", "joints.txt"], "joints": "joints.txt", "robot": "irb120",
         "units": "--json", "targets": "targets.csv", "left_out": ["12:smr2", "40"], "rms": 0.2,
         "most": 0.5, "effects": True, "quick": True}
    )  # fmt: skip


def test_points_are_set_aside_with_their_reasons(at):
    everything(at)
    at.update_choices({"left_out": ["3:smr1", "12:smr2", "40"],
               "reasons": {"12:smr2": "nest, knocked", "40": "nest, knocked"}})  # fmt: skip
    assert lines(at, "fit")[0] == (
        "minimax-cal import poses.csv --leave-out=3:smr1 '--leave-out=12:smr2,40=nest, knocked' "
        "-o used.csv"
    )


def test_the_lines_are_what_people_would_type(at):
    everything(at)
    left = "minimax-cal import poses.csv --leave-out=12:smr2,40 -o used.csv"
    assert lines(at, "read") == [
        "minimax-cal import 'given/tracker (1).csv' --joints=given/joints.txt --units=--json "
        "-o poses.csv --json > understood.json"
    ]
    assert lines(at, "fit") == [
        left,
        "minimax-cal calibrate irb120 used.csv --objective minimax --effects diagnosis.json "
        "-o fit.json",
    ]
    assert lines(at, "diagnose") == [
        left,
        "minimax-cal diagnose irb120 used.csv --quick -o diagnosis.json",
    ]
    assert lines(at, "judge") == [
        "minimax-cal report fit.json diagnosis.json --tolerance 'rms 0.2, max 0.5' "
        "--tolerance-for inside -o report.html"
    ]


def test_a_diagnosis_of_other_measurements_joins_no_report(at):
    everything(at)
    (at.folder / DIAGNOSIS_FILE).write_text(RESULT.replace("abc", "def"))
    assert "diagnosis.json" not in lines(at, "judge")[0]


@pytest.mark.parametrize("step", SESSION_STEPS)
def test_the_command_line_takes_every_line(at, step):
    """Each option is one that its command has, and every value is that of its option."""
    everything(at)
    for line in lines(at, step):
        words = shlex.split(line.partition(" > ")[0])
        command = cli.get_command(click.Context(cli), words[1])
        assert command is not None
        found = command.make_context(words[1], words[2:])
        assert str(found.params["output" if words[1] != "report" else "path"])


@pytest.mark.parametrize(
    ("step", "said"),
    [("read", "drop the files"), ("fit", "not been read"), ("judge", "calibrate first"),
     ("plan", "not been read"), ("urdf", "calibrate first"), ("correct", "joint targets first")],
)  # fmt: skip
def test_what_a_step_waits_for_is_told(at, step, said):
    with pytest.raises(OptionError, match=said):
        lines(at, step)
