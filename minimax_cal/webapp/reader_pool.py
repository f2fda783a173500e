"""Processes that read the files of sessions for the server, which itself only answers."""

from __future__ import annotations

import asyncio
import json
import os
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, cast

from minimax_cal.core.errors import CalibrationError
from minimax_cal.core.files import parse_json
from minimax_cal.webapp.job_runner import python_module_command
from minimax_cal.webapp.sessions import Session

MAX_READER_PROCESSES = 6  # processes that read at once
MAX_IDLE_READERS = 2  # that wait for work, since one takes a second or more to start
MAX_READ_SECONDS = 300.0  # in which any file is read
RESTART_DELAY_SECONDS = 0.2  # in which the deaths of other processes are known, too
READER_MODULE = "minimax_cal.webapp.session_reader"


@dataclass(frozen=True)
class ReaderAnswer:
    """What a reader found.  status: of HTTP.  content: JSON."""

    status: int
    content: bytes

    def parse_content(self) -> Any:
        """The content.  Raises CalibrationError for what the reader says is wrong."""
        found = parse_json(self.content)
        if self.status != 200:
            raise CalibrationError(found["error"])
        return found


@dataclass(eq=False)
class ReaderProcess:
    """A process.  folder: of the session that it read last, whose files it remembers."""

    process: asyncio.subprocess.Process
    folder: str = ""

    async def ask(self, question: bytes) -> ReaderAnswer:
        """Raises IncompleteReadError where the process died, and TimeoutError."""
        questions = cast(asyncio.StreamWriter, self.process.stdin)
        answers = cast(asyncio.StreamReader, self.process.stdout)
        async with asyncio.timeout(MAX_READ_SECONDS):
            questions.write(question + b"\n")
            with suppress(ConnectionError):  # it is dead, which the next line says
                await questions.drain()
            head = parse_json(await answers.readuntil(b"\n"))
            return ReaderAnswer(head["status"], await answers.readexactly(head["bytes"]))

    def kill(self) -> None:
        """End the process, whatever it does."""
        with suppress(ProcessLookupError):
            self.process.kill()


class ReaderPool:
    """Some processes, of which each answers one question at a time.

    Equal questions that are asked while one of them is at work get one answer, so that no browser
    that asks again and again takes all processes.
    """

    def __init__(self) -> None:
        self.idle: list[ReaderProcess] = []
        self.readers: set[ReaderProcess] = set()
        self.free_slots = asyncio.Semaphore(MAX_READER_PROCESSES)
        self.pending: dict[object, asyncio.Task[ReaderAnswer]] = {}
        self.starting: asyncio.Task[None] | None = None

    async def ask(self, verb: str, session: Session, **arguments: Any) -> ReaderAnswer:
        """The answer to a question about a session; `reader` has the verbs."""
        folder = str(session.folder)
        question = json.dumps({"verb": verb, "folder": folder, **arguments}).encode()
        key = question, session.list_file_versions()  # of files as they are now
        task = self.pending.get(key)
        if task is None:
            task = self.pending[key] = asyncio.create_task(self.answer_with_retry(folder, question))
            task.add_done_callback(lambda _: self.pending.pop(key, None))
        return await asyncio.shield(task)

    async def answer_with_retry(self, folder: str, question: bytes) -> ReaderAnswer:
        """Have a process answer, and another where that died, as perhaps before it was asked."""
        for _ in range(2):
            with suppress(asyncio.IncompleteReadError, ConnectionError):
                return await self.answer_with_one_reader(folder, question)
            await asyncio.sleep(RESTART_DELAY_SECONDS)
        raise CalibrationError(
            "a file of this session takes more memory than there is; remove the largest"
        )

    async def answer_with_one_reader(self, folder: str, question: bytes) -> ReaderAnswer:
        """Have a process answer.  Raises IncompleteReadError where it dies; CalibrationError."""
        async with self.free_slots:
            reader = await self.take_or_start_reader(folder)
            try:
                found = await reader.ask(question)
            except TimeoutError:
                raise CalibrationError(
                    f"a file of this session takes more than "
                    f"{MAX_READ_SECONDS:g} s to read; remove it"
                ) from None
            else:
                self.idle.append(reader)
                while len(self.idle) > MAX_IDLE_READERS:
                    self.kill_reader(self.idle.pop(0))
                return found
            finally:
                if reader not in self.idle:
                    self.kill_reader(reader)

    async def take_or_start_reader(self, folder: str) -> ReaderProcess:
        """An idle process: that which knows the session, else the longest idle, else a new one."""
        for reader in [one for one in self.idle if one.process.returncode is not None]:
            self.idle.remove(reader)
            self.kill_reader(reader)
        known = [one for one in self.idle if one.folder == folder] or self.idle
        reader = known[0] if known else await self.start_reader()
        if reader in self.idle:
            self.idle.remove(reader)
        reader.folder = folder
        if not self.idle and self.starting is None and len(self.readers) < MAX_READER_PROCESSES:
            self.starting = asyncio.create_task(self.start_idle_reader())
        return reader

    async def start_idle_reader(self) -> None:
        """Start a process that waits for work."""
        try:
            self.idle.append(await self.start_reader())
        finally:
            self.starting = None

    async def start_reader(self) -> ReaderProcess:
        """A new process, which imports all that it needs before its first answer."""
        pipe = asyncio.subprocess.PIPE
        try:
            process = await asyncio.create_subprocess_exec(
                *python_module_command(READER_MODULE), stdin=pipe, stdout=pipe,
                env={**os.environ, "PYTHONUTF8": "1"},
            )  # fmt: skip
        except OSError as error:
            raise CalibrationError(f"no process to read with ({error.strerror})") from error
        reader = ReaderProcess(process)
        self.readers.add(reader)
        return reader

    def kill_reader(self, reader: ReaderProcess) -> None:
        """End a process for good."""
        reader.kill()
        self.readers.discard(reader)

    async def kill_all_readers(self) -> None:
        """End all processes."""
        for task in [*self.pending.values(), *filter(None, [self.starting])]:
            task.cancel()
        for reader in list(self.readers):
            self.kill_reader(reader)
            await reader.process.wait()
