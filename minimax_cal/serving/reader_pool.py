"""Processes that read the files of sessions for the server, which itself only answers."""

from __future__ import annotations

import asyncio
import json
import os
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, cast

from minimax_cal.ground.errors import CalibrationError
from minimax_cal.ground.files import json_of
from minimax_cal.serving.sessions import Session
from minimax_cal.serving.work import module_command

MAX_READERS = 6  # processes that read at once
IDLE_READERS = 2  # that wait for work, since one takes a second or more to start
READ_SECONDS = 300.0  # in which any file is read
DEATH_SECONDS = 0.2  # in which the deaths of other processes are known, too
READER = "minimax_cal.serving.reader"


@dataclass(frozen=True)
class Answer:
    """What a reader found.  status: of HTTP.  content: JSON."""

    status: int
    content: bytes

    def value(self) -> Any:
        """The content.  Raises CalibrationError for what the reader says is wrong."""
        found = json_of(self.content)
        if self.status != 200:
            raise CalibrationError(found["error"])
        return found


@dataclass(eq=False)
class Reader:
    """A process.  folder: of the session that it read last, whose files it remembers."""

    process: asyncio.subprocess.Process
    folder: str = ""

    async def ask(self, question: bytes) -> Answer:
        """Raises IncompleteReadError where the process died, and TimeoutError."""
        questions = cast(asyncio.StreamWriter, self.process.stdin)
        answers = cast(asyncio.StreamReader, self.process.stdout)
        async with asyncio.timeout(READ_SECONDS):
            questions.write(question + b"\n")
            with suppress(ConnectionError):  # it is dead, which the next line says
                await questions.drain()
            head = json_of(await answers.readuntil(b"\n"))
            return Answer(head["status"], await answers.readexactly(head["bytes"]))

    def end(self) -> None:
        """End the process, whatever it does."""
        with suppress(ProcessLookupError):
            self.process.kill()


class ReaderPool:
    """Some processes, of which each answers one question at a time.

    Equal questions that are asked while one of them is at work get one answer, so that no browser
    that asks again and again takes all processes.
    """

    def __init__(self) -> None:
        self.idle: list[Reader] = []
        self.readers: set[Reader] = set()
        self.room = asyncio.Semaphore(MAX_READERS)
        self.pending: dict[object, asyncio.Task[Answer]] = {}
        self.starting: asyncio.Task[None] | None = None

    async def ask(self, verb: str, at: Session, **arguments: Any) -> Answer:
        """The answer to a question about a session; `reader` has the verbs."""
        folder = str(at.folder)
        question = json.dumps({"verb": verb, "folder": folder, **arguments}).encode()
        key = question, at.stamp()  # of files as they are now
        task = self.pending.get(key)
        if task is None:
            task = self.pending[key] = asyncio.create_task(self.answer_again(folder, question))
            task.add_done_callback(lambda _: self.pending.pop(key, None))
        return await asyncio.shield(task)

    async def answer_again(self, folder: str, question: bytes) -> Answer:
        """Have a process answer, and another where that died, as perhaps before it was asked."""
        for _ in range(2):
            with suppress(asyncio.IncompleteReadError, ConnectionError):
                return await self.answer(folder, question)
            await asyncio.sleep(DEATH_SECONDS)
        raise CalibrationError(
            "a file of this session takes more memory than there is; remove the largest"
        )

    async def answer(self, folder: str, question: bytes) -> Answer:
        """Have a process answer.  Raises IncompleteReadError where it dies; CalibrationError."""
        async with self.room:
            reader = await self.take_reader(folder)
            try:
                found = await reader.ask(question)
            except TimeoutError:
                raise CalibrationError(
                    f"a file of this session takes more than {READ_SECONDS:g} s to read; remove it"
                ) from None
            else:
                self.idle.append(reader)
                while len(self.idle) > IDLE_READERS:
                    self.discard(self.idle.pop(0))
                return found
            finally:
                if reader not in self.idle:
                    self.discard(reader)

    async def take_reader(self, folder: str) -> Reader:
        """An idle process: that which knows the session, else the longest idle, else a new one."""
        for reader in [one for one in self.idle if one.process.returncode is not None]:
            self.idle.remove(reader)
            self.discard(reader)
        known = [one for one in self.idle if one.folder == folder] or self.idle
        reader = known[0] if known else await self.start_reader()
        if reader in self.idle:
            self.idle.remove(reader)
        reader.folder = folder
        if not self.idle and self.starting is None and len(self.readers) < MAX_READERS:
            self.starting = asyncio.create_task(self.fill())
        return reader

    async def fill(self) -> None:
        """Start a process that waits for work."""
        try:
            self.idle.append(await self.start_reader())
        finally:
            self.starting = None

    async def start_reader(self) -> Reader:
        """A new process, which imports all that it needs before its first answer."""
        pipe = asyncio.subprocess.PIPE
        try:
            process = await asyncio.create_subprocess_exec(
                *module_command(READER), stdin=pipe, stdout=pipe,
                env={**os.environ, "PYTHONUTF8": "1"},
            )  # fmt: skip
        except OSError as error:
            raise CalibrationError(f"no process to read with ({error.strerror})") from error
        reader = Reader(process)
        self.readers.add(reader)
        return reader

    def discard(self, reader: Reader) -> None:
        """End a process for good."""
        reader.end()
        self.readers.discard(reader)

    async def close(self) -> None:
        """End all processes."""
        for task in [*self.pending.values(), *filter(None, [self.starting])]:
            task.cancel()
        for reader in list(self.readers):
            self.discard(reader)
            await reader.process.wait()
