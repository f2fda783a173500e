"""What commands say on stderr: a line of words each, or a line of JSON for a program that reads."""

from __future__ import annotations

import json
from contextvars import ContextVar
from typing import Any

import click

from minimax_cal.cli import FAILED_EXIT_CODE
from minimax_cal.core.display_text import clean_and_shorten_to_one_line

IS_JSON_PROGRESS: ContextVar[bool] = ContextVar(
    "AS_JSON", default=False
)  # of the command that is at work
UNREPORTED_WRITTEN_FILES: ContextVar[list[tuple[str, dict[str, Any]]]] = ContextVar(
    "WRITTEN"
)  # not told yet
UNREPORTED_FILE_KINDS: ContextVar[list[str]] = ContextVar(
    "TAKEN"
)  # what files were taken for, not told yet


def report_event(event: str, text: str, **json_fields: Any) -> None:
    """Say what happened on stderr, what files were taken for before it; an error stands alone.

    Files that were written are named once the command has ended, or before an error of numbers:
    until then any other error takes them back. event: "progress", "notice", "written", "error" or
    "summary".  json_fields: what else the JSON holds.
    """
    if event == "written" and (written := UNREPORTED_WRITTEN_FILES.get(None)) is not None:
        report_detected_file_kinds()
        written.append((text, json_fields))
        return
    if event == "error":
        UNREPORTED_FILE_KINDS.set([])
        report_written_paths()
    report_detected_file_kinds()
    print_event_line(event, text, **json_fields)


def report_written_paths() -> None:
    """Say which files were written, unless stderr says so already."""
    every = UNREPORTED_WRITTEN_FILES.get([])
    while every:
        text, more = every.pop(0)
        print_event_line("written", text, **more)


def report_detected_file_kinds() -> None:
    """Say what files were taken for, unless stderr says so already."""
    every = UNREPORTED_FILE_KINDS.get([])
    while every:
        print_event_line("taken", every.pop(0))


def print_event_line(event: str, text: str, **json_fields: Any) -> None:
    """A line on stderr."""
    line = clean_and_shorten_to_one_line(text)
    if IS_JSON_PROGRESS.get():
        click.echo(json.dumps({"event": event, "text": line, **json_fields}), err=True)
    else:
        click.echo(f"{event}: {line}", err=True)


def report_error(text: str, exit_code: int = FAILED_EXIT_CODE) -> int:
    """A line of error; the exit code."""
    report_event("error", text, exit_code=exit_code)
    return exit_code


def set_json_events(_: click.Context, __: click.Parameter, progress_format: str) -> None:
    """Say all that follows as JSON, where that is asked for."""
    IS_JSON_PROGRESS.set(progress_format == "json")


PROGRESS_OPTION = click.option(
    "--progress",
    type=click.Choice(["text", "json"]),
    default="text",
    is_eager=True,
    expose_value=False,
    callback=set_json_events,
    help="Say notices, progress and errors on stderr as text, or as a line of JSON each.",
)
