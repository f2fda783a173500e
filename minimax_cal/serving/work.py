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
from typing import Annotated, Any, cast

from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.facts import Fact
from minimax_cal.ground.files import json_of, json_text, made_folder, plain, write_whole
from minimax_cal.ground.records import read
from minimax_cal.ground.stages import clock
from minimax_cal.ground.words import one_line
from minimax_cal.serving.sessions import LOG, SCRIPT, Session
from minimax_cal.serving.steps import Command

PATIENCE = 5.0  # seconds from asking a process to end to ending it
CHILD = "minimax_cal.cli.child"  # the program that does a command line
MOST_TOLD = 20_000  # letters of stdout that are kept
MOST_LINES = 400
MOST_LINE = 1 << 20  # bytes of a line on stderr


@dataclass(frozen=True)
class Record:
    """How a step ended.  inputs: SHA-256 of the files that its commands read.  told: its stdout.

    more: what it said of the file that it wrote, beside its name.
    """

    commands: tuple[str, ...]
    code: int
    seconds: Annotated[float, Fact(least=0.0)]
    told: str = ""
    notices: tuple[str, ...] = ()
    error: str = ""
    inputs: Mapping[str, str] = field(default_factory=dict)
    more: Mapping[str, str] = field(default_factory=dict)


def record_of(at: Session, step: str) -> Record | None:
    """How a step ended the last time, None where it never did."""
    try:
        return read(Record, json_of((at.folder / LOG / f"{step}.json").read_bytes()))
    except (OSError, ValueError):
        return None


@dataclass(frozen=True)
class Progress:
    """A step at work, and of a diagnosis the steps so far: name and error [mm]."""

    step: str
    rungs: Sequence[tuple[str, str]]


@dataclass(eq=False)
class Job:
    """A step at work.  stage: what it tells.  rungs: of a diagnosis, name and error [mm]."""

    at: Session
    step: str
    commands: Sequence[Command]
    expected: float
    began: float = field(default_factory=time.monotonic)
    stage: str = "waiting for a free core"
    left: float | None = None
    part: tuple[int, int] | None = None
    rungs: list[tuple[str, str]] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)
    other: deque[str] = field(default_factory=lambda: deque(maxlen=MOST_LINES))
    error: str = ""
    more: dict[str, str] = field(default_factory=dict)
    process: asyncio.subprocess.Process | None = None
    cancelled: bool = False
    task: asyncio.Task[None] | None = None

    def hear(self, line: str) -> None:
        """A line that the process wrote on stderr: an event as `cli.stderr` writes it, or not."""
        try:
            event = json_of(line)
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
            if len(self.notices) < MOST_LINES:
                self.notices.append(text)
        elif kind == "written":
            self.more |= {k: str(v) for k, v in event.items() if k not in ("event", "text")}
        elif not kind and text:
            self.other.append(one_line(text))

    def state(self) -> dict[str, Any]:
        """For the page."""
        seconds = time.monotonic() - self.began
        rest = self.expected - seconds
        left = f"about {rest:.0f} s left, as last time" if rest >= 1.0 else ""
        if self.left is not None:
            left = f"{clock(self.left)} left"
        done = self.part[0] / max(self.part[1], 1) if self.part else None
        return {"step": self.step, "stage": self.stage, "seconds": round(seconds), "left": left,
                "done": done, "rungs": self.rungs}  # fmt: skip


class Work:
    """The processes of all sessions, one at a time in each, as many at once as there are cores."""

    def __init__(self) -> None:
        self.jobs: dict[str, Job] = {}
        self.cores = asyncio.Semaphore(max(os.cpu_count() or 1, 1))

    def start(self, at: Session, step: str, commands: Sequence[Command]) -> Job:
        """Begin a step.  Raises OptionError while the session is at work."""
        if at.name in self.jobs:
            raise OptionError("work is going on in this session; wait for it, or cancel it")
        last = record_of(at, step)
        job = Job(at, step, commands, last.seconds if last and not last.code else 0.0)
        self.jobs[at.name] = job
        job.task = asyncio.get_running_loop().create_task(self.run(job))
        return job

    async def run(self, job: Job) -> None:
        """All commands of a step, up to the first that fails; then its record."""
        told, code = "", 0
        inputs: dict[str, str] = {}
        try:
            async with self.cores:
                job.began = time.monotonic()
                for command in job.commands:
                    job.stage = command.words[0]
                    inputs |= await asyncio.to_thread(digests, job.at, command)
                    if job.cancelled:
                        code = 1
                        break
                    code, told = await self.one(job, command)
                    if code:
                        break
            if not (job.cancelled and code):  # what ended well was cancelled too late
                await asyncio.to_thread(kept, job, code, told, inputs)
        except (OSError, CalibrationError) as error:  # no room, or no process to be had
            job.error = one_line(f"the work could not be done ({error})")
            with suppress(OSError, CalibrationError):
                kept(job, 1, told, inputs)
        finally:
            self.jobs.pop(job.at.name, None)

    async def one(self, job: Job, command: Command) -> tuple[int, str]:
        """Run a command line; its exit code and what it printed."""
        pipe = asyncio.subprocess.PIPE
        job.process = process = await asyncio.create_subprocess_exec(
            *module_command(CHILD), str(job.at.folder), *in_json(command), stdin=pipe, stdout=pipe,
            stderr=pipe, limit=MOST_LINE, env={**os.environ, "PYTHONUTF8": "1"},
        )  # fmt: skip
        out, told = (cast(asyncio.StreamReader, s) for s in (process.stdout, process.stderr))
        raw, _ = await asyncio.gather(out.read(), listen(job, told))
        code = await process.wait()
        text = raw.decode("utf-8", "replace")
        if not code and command.to:
            write_whole(job.at.folder / command.to, text)
            text = ""
        if code == 1 and command.judges and text:
            code, job.error = 0, ""
        if code and not job.error:
            job.error = "; ".join(list(job.other)[-3:]) or f"the command ended with {code}"
        return code, text[:MOST_TOLD]

    async def cancel(self, name: str) -> None:
        """End the work of a session; files are whole or as they were."""
        job = self.jobs.get(name)
        if not job or not job.task:
            return
        job.cancelled = True
        if job.process and job.process.stdin:
            job.process.stdin.close()  # which the process notices
        elif not job.process:
            job.task.cancel()  # it still waits for a core
        done, _ = await asyncio.wait([job.task], timeout=PATIENCE)
        if not done and job.process and job.process.returncode is None:
            job.process.kill()
            await asyncio.wait([job.task])

    async def close(self) -> None:
        """End all work."""
        await asyncio.gather(*(self.cancel(name) for name in list(self.jobs)))


def module_command(module: str) -> list[str]:
    """What starts a module that imports what this process does, and nothing from its folder."""
    safe = [] if os.getcwd() in sys.path else ["-P"]
    return [sys.executable, *safe, "-m", module]


def in_json(command: Command) -> tuple[str, ...]:
    """The words of a command that says each stage in a line of JSON."""
    return (command.words[0], "--progress", "json", *command.words[1:])


async def listen(job: Job, stream: asyncio.StreamReader) -> None:
    """Hear every line of stderr."""
    while True:
        try:
            raw = await stream.readline()
        except ValueError:  # a line without an end
            continue
        if not raw:
            return
        job.hear(raw.decode("utf-8", "replace").strip())


def digests(at: Session, command: Command) -> dict[str, str]:
    """SHA-256 of every file that a command reads."""
    words = command.words[: command.words.index("-o")] if "-o" in command.words else command.words
    paths = {word.removeprefix("--joints=") for word in words if "\0" not in word}
    return {path: found for path in sorted(paths) if len(path) < 200 and (found := at.digest(path))}


def kept(job: Job, code: int, told: str, inputs: dict[str, str]) -> None:
    """Write how a step ended, and its commands into the session's script."""
    seconds = round(time.monotonic() - job.began, 1)
    commands = tuple(command.line() for command in job.commands)
    record = Record(commands, code, seconds, told, tuple(job.notices), job.error, inputs, job.more)
    write_whole(made_folder(job.at.folder / LOG) / f"{job.step}.json", json_text(plain(record)))
    script = job.at.folder / SCRIPT
    text = script.read_text("utf-8") if script.exists() else start_of(job.at.folder)
    when = time.strftime("%Y-%m-%d %H:%M:%S")
    lines = "\n".join(commands)
    write_whole(script, f"{text}\n# {when}, exit code {code}, {seconds:g} s\n{lines}\n")


def start_of(folder: Path) -> str:
    """The first lines of a session's script."""
    words = "#!/bin/sh\n# All that was done on the page, as command lines.\n"
    return f"{words}cd {shlex.quote(str(folder))}\n"
