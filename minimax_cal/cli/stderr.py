"""What commands say on stderr: a line of words each, or a line of JSON for a program that reads."""

from __future__ import annotations

import json
from contextvars import ContextVar
from typing import Any

import click

from minimax_cal.cli import FAILED
from minimax_cal.ground.words import one_line

AS_JSON: ContextVar[bool] = ContextVar("AS_JSON", default=False)  # of the command that is at work
WRITTEN: ContextVar[list[tuple[str, dict[str, Any]]]] = ContextVar("WRITTEN")  # not told yet
TAKEN: ContextVar[list[str]] = ContextVar("TAKEN")  # what files were taken for, not told yet


def tell(event: str, text: str, **more: Any) -> None:
    """Say what happened on stderr, what files were taken for before it; an error stands alone.

    Files that were written are named once the command has ended, or before an error of numbers:
    until then any other error takes them back.
    event: "progress", "notice", "written", "error" or "summary".  more: what else the JSON holds.
    """
    if event == "written" and (written := WRITTEN.get(None)) is not None:
        tell_taken()
        written.append((text, more))
        return
    if event == "error":
        TAKEN.set([])
        tell_written()
    tell_taken()
    say(event, text, **more)


def tell_written() -> None:
    """Say which files were written, unless stderr says so already."""
    every = WRITTEN.get([])
    while every:
        text, more = every.pop(0)
        say("written", text, **more)


def tell_taken() -> None:
    """Say what files were taken for, unless stderr says so already."""
    every = TAKEN.get([])
    while every:
        say("taken", every.pop(0))


def say(event: str, text: str, **more: Any) -> None:
    """A line on stderr."""
    line = one_line(text)
    if AS_JSON.get():
        click.echo(json.dumps({"event": event, "text": line, **more}), err=True)
    else:
        click.echo(f"{event}: {line}", err=True)


def complain(text: str, code: int = FAILED) -> int:
    """A line of error; the exit code."""
    tell("error", text, exit_code=code)
    return code


def tell_json(_: click.Context, __: click.Parameter, form: str) -> None:
    """Say all that follows as JSON, where that is asked for."""
    AS_JSON.set(form == "json")


PROGRESS = click.option(
    "--progress",
    type=click.Choice(["text", "json"]),
    default="text",
    is_eager=True,
    expose_value=False,
    callback=tell_json,
    help="Say notices, progress and errors on stderr as text, or as a line of JSON each.",
)
