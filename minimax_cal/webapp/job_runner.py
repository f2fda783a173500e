"""Work in processes of its own: each is the command line itself, in the session's folder."""

from __future__ import annotations

import asyncio
import os
import shlex
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple, cast

from minimax_cal.core.display_text import clean_and_shorten_to_one_line
from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.core.files import (
    convert_to_plain_json,
    create_folder,
    format_json,
    parse_json,
    write_file_atomically,
)
from minimax_cal.core.progress_stages import format_duration
from minimax_cal.core.record_fields import FieldFormat
from minimax_cal.core.record_parsing import parse_record
from minimax_cal.webapp.sessions import LOG_FOLDER, SCRIPT_FILE, Session
from minimax_cal.webapp.step_commands import CommandLine

MAX_SECONDS_TO_END = 5.0  # seconds from asking a process to end to ending it
COMMAND_CHILD_MODULE = "minimax_cal.cli.webapp_child"  # the program that does a command line
MAX_KEPT_OUTPUT_LETTERS = 20_000  # letters of stdout that are kept
MAX_KEPT_STDERR_LINES = 400
MAX_STDERR_LINE_BYTES = 1 << 20  # bytes of a line on stderr


@dataclass(frozen=True)
class StepRecord:
    """How a step ended.  inputs: SHA-256 of the files that its commands read.  told: its stdout.

    more: what it said of the file that it wrote, beside its name.
    """

    commands: tuple[str, ...]
    code: int
    seconds: Annotated[float, FieldFormat(least=0.0)]
    told: str = ""
    notices: tuple[str, ...] = ()
    error: str = ""
    inputs: Mapping[str, str] = field(default_factory=dict)
    more: Mapping[str, str] = field(default_factory=dict)


def read_step_record(session: Session, step: str) -> StepRecord | None:
    """How a step ended the last time, None where it never did."""
    try:
        return parse_record(
            StepRecord, parse_json((session.folder / LOG_FOLDER / f"{step}.json").read_bytes())
        )
    except (OSError, ValueError):
        return None


@dataclass(frozen=True)
class StepProgress:
    """A step at work, and of a diagnosis the steps so far: name and error [mm]."""

    step: str
    rungs: Sequence[tuple[str, str]]


@dataclass(eq=False)
class StepJob:
    """A step at work.  stage: what it tells.  rungs: of a diagnosis, name and error [mm]."""

    session: Session
    step: str
    commands: Sequence[CommandLine]
    expected: float
    began: float = field(default_factory=time.monotonic)
    stage: str = "waiting for a free core"
    left: float | None = None
    part: tuple[int, int] | None = None
    rungs: list[tuple[str, str]] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)
    other: deque[str] = field(default_factory=lambda: deque(maxlen=MAX_KEPT_STDERR_LINES))
    error: str = ""
    more: dict[str, str] = field(default_factory=dict)
    process: asyncio.subprocess.Process | None = None
    cancelled: bool = False
    task: asyncio.Task[None] | None = None

    def handle_stderr_line(self, line: str) -> None:
        """A line that the process wrote on stderr: an event as `cli.stderr` writes it, or not."""
        try:
            event = parse_json(line)
            kind, text = event["event"], event["text"]
        except (ValueError, TypeError, KeyError):
            kind, text = "", line
        if kind == "progress":
            if rung := event.get("rung"):
                self.rungs.append((rung["name"], f"{rung['holdout_rms_mm']:.3f}"))
            self.part = (event["part"] - 1, event["parts"]) if "parts" in event else None
            self.stage, self.left = text, event.get("seconds_left")
        elif kind == "error":
            self.error = text
        elif kind == "notice":
            if len(self.notices) < MAX_KEPT_STDERR_LINES:
                self.notices.append(text)
        elif kind == "written":
            self.more |= {k: str(v) for k, v in event.items() if k not in ("event", "text")}
        elif not kind and text:
            self.other.append(clean_and_shorten_to_one_line(text))

    def build_progress_json(self) -> dict[str, Any]:
        """For the page."""
        seconds = time.monotonic() - self.began
        rest = self.expected - seconds
        left = f"about {rest:.0f} s left, as last time" if rest >= 1.0 else ""
        if self.left is not None:
            left = f"{format_duration(self.left)} left"
        done = self.part[0] / max(self.part[1], 1) if self.part else None
        return {"step": self.step, "stage": self.stage, "seconds": round(seconds), "left": left,
                "done": done, "rungs": self.rungs}  # fmt: skip


class CommandOutcome(NamedTuple):
    """How a command line ended."""

    exit_code: int
    stdout_text: str


class JobRunner:
    """The processes of all sessions, one at a time in each, as many at once as there are cores."""

    def __init__(self) -> None:
        self.jobs: dict[str, StepJob] = {}
        self.cores = asyncio.Semaphore(max(os.cpu_count() or 1, 1))

    def start_job(self, session: Session, step: str, commands: Sequence[CommandLine]) -> StepJob:
        """Begin a step.  Raises OptionError while the session is at work."""
        if session.name in self.jobs:
            raise OptionError("work is going on in this session; wait for it, or cancel it")
        last = read_step_record(session, step)
        job = StepJob(session, step, commands, last.seconds if last and not last.code else 0.0)
        self.jobs[session.name] = job
        job.task = asyncio.get_running_loop().create_task(self.run_job(job))
        return job

    async def run_job(self, job: StepJob) -> None:
        """All commands of a step, up to the first that fails; then its record."""
        told, code = "", 0
        inputs: dict[str, str] = {}
        try:
            async with self.cores:
                job.began = time.monotonic()
                for command in job.commands:
                    job.stage = command.words[0]
                    inputs |= await asyncio.to_thread(input_file_digests, job.session, command)
                    if job.cancelled:
                        code = 1
                        break
                    code, told = await self.run_command_line(job, command)
                    if code:
                        break
            if not (job.cancelled and code):  # what ended well was cancelled too late
                await asyncio.to_thread(write_step_record_and_script, job, code, told, inputs)
        except (OSError, CalibrationError) as error:  # no room, or no process to be had
            job.error = clean_and_shorten_to_one_line(f"the work could not be done ({error})")
            with suppress(OSError, CalibrationError):
                write_step_record_and_script(job, 1, told, inputs)
        finally:
            self.jobs.pop(job.session.name, None)

    async def run_command_line(self, job: StepJob, command: CommandLine) -> CommandOutcome:
        """Run a command line; its exit code and what it printed."""
        pipe = asyncio.subprocess.PIPE
        job.process = process = await asyncio.create_subprocess_exec(
            *python_module_command(COMMAND_CHILD_MODULE),
            str(job.session.folder),
            *with_json_progress(command),
            stdin=pipe,
            stdout=pipe,
            stderr=pipe,
            limit=MAX_STDERR_LINE_BYTES,
            env={**os.environ, "PYTHONUTF8": "1"},
        )
        out, told = (cast(asyncio.StreamReader, s) for s in (process.stdout, process.stderr))
        raw, _ = await asyncio.gather(out.read(), read_stderr_lines(job, told))
        code = await process.wait()
        text = raw.decode("utf-8", "replace")
        if not code and command.to:
            write_file_atomically(job.session.folder / command.to, text)
            text = ""
        if code == 1 and command.judges and text:
            code, job.error = 0, ""
        if code and not job.error:
            job.error = "; ".join(list(job.other)[-3:]) or f"the command ended with {code}"
        return CommandOutcome(code, text[:MAX_KEPT_OUTPUT_LETTERS])

    async def cancel_job(self, session_name: str) -> None:
        """End the work of a session; files are whole or as they were."""
        job = self.jobs.get(session_name)
        if not job or not job.task:
            return
        job.cancelled = True
        if job.process and job.process.stdin:
            job.process.stdin.close()  # which the process notices
        elif not job.process:
            job.task.cancel()  # it still waits for a core
        done, _ = await asyncio.wait([job.task], timeout=MAX_SECONDS_TO_END)
        if not done and job.process and job.process.returncode is None:
            job.process.kill()
            await asyncio.wait([job.task])

    async def cancel_all_jobs(self) -> None:
        """End all work."""
        await asyncio.gather(*(self.cancel_job(name) for name in list(self.jobs)))


def python_module_command(module_name: str) -> list[str]:
    """What starts a module that imports what this process does, and nothing from its folder."""
    safe = [] if os.getcwd() in sys.path else ["-P"]
    return [sys.executable, *safe, "-m", module_name]


def with_json_progress(command: CommandLine) -> tuple[str, ...]:
    """The words of a command that says each stage in a line of JSON."""
    return (command.words[0], "--progress", "json", *command.words[1:])


async def read_stderr_lines(job: StepJob, stream: asyncio.StreamReader) -> None:
    """Hear every line of stderr."""
    while True:
        try:
            raw = await stream.readline()
        except ValueError:  # a line without an end
            continue
        if not raw:
            return
        job.handle_stderr_line(raw.decode("utf-8", "replace").strip())


def input_file_digests(session: Session, command: CommandLine) -> dict[str, str]:
    """SHA-256 of every file that a command reads."""
    words = command.words[: command.words.index("-o")] if "-o" in command.words else command.words
    paths = {word.removeprefix("--joints=") for word in words if "\0" not in word}
    return {
        path: found
        for path in sorted(paths)
        if len(path) < 200 and (found := session.file_sha256(path))
    }


def write_step_record_and_script(
    job: StepJob, exit_code: int, stdout_text: str, input_digests: dict[str, str]
) -> None:
    """Write how a step ended, and its commands into the session's script."""
    seconds = round(time.monotonic() - job.began, 1)
    commands = tuple(command.format_shell_line() for command in job.commands)
    record = StepRecord(
        commands,
        exit_code,
        seconds,
        stdout_text,
        tuple(job.notices),
        job.error,
        input_digests,
        job.more,
    )
    write_file_atomically(
        create_folder(job.session.folder / LOG_FOLDER) / f"{job.step}.json",
        format_json(convert_to_plain_json(record)),
    )
    script = job.session.folder / SCRIPT_FILE
    text = script.read_text("utf-8") if script.exists() else script_header(job.session.folder)
    when = time.strftime("%Y-%m-%d %H:%M:%S")
    lines = "\n".join(commands)
    write_file_atomically(
        script, f"{text}\n# {when}, exit code {exit_code}, {seconds:g} s\n{lines}\n"
    )


def script_header(folder: Path) -> str:
    """The first lines of a session's script."""
    words = "#!/bin/sh\n# All that was done on the page, as command lines.\n"
    return f"{words}cd {shlex.quote(str(folder))}\n"
