"""A server of the page in a process of its own, and how to ask it without a browser."""

from __future__ import annotations

import http.client
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PATIENCE = 180.0  # seconds; a busy machine is slow
ANSWER = 60.0


@dataclass(frozen=True)
class Answer:
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def text(self) -> str:
        return self.body.decode()

    @property
    def json(self) -> Any:
        return json.loads(self.body)


@dataclass(frozen=True, eq=False)
class Served:
    """port, token: as the address told.  folder: of the sessions."""

    process: subprocess.Popen[str]
    url: str
    folder: Path
    port: int = field(init=False)
    token: str = field(init=False)

    def __post_init__(self) -> None:
        home, _, token = self.url.partition("/?token=")
        object.__setattr__(self, "port", int(home.rpartition(":")[2]))
        object.__setattr__(self, "token", token)

    def ask(
        self,
        method: str,
        path: str,
        body: str | bytes | None = None,
        headers: dict[str, str] | None = None,
        cookie: str | None = None,
    ) -> Answer:
        """One request.  cookie: that of the token unless given."""
        told = {"cookie": f"minimax-cal-{self.port}={self.token}" if cookie is None else cookie}
        told |= headers or {}
        line = http.client.HTTPConnection("127.0.0.1", self.port, timeout=ANSWER)
        try:
            line.putrequest(method, path, skip_host="host" in told, skip_accept_encoding=True)
            for name, value in told.items():
                line.putheader(name, value)
            raw = body.encode() if isinstance(body, str) else body
            if "content-length" not in told and (raw is not None or method != "GET"):
                line.putheader("content-length", str(len(raw or b"")))
            line.endheaders(raw)
            found = line.getresponse()
            lower = {name.lower(): value for name, value in found.getheaders()}
            return Answer(found.status, lower, found.read())
        finally:
            line.close()

    def begin(self, title: str = "cell", **chosen: object) -> str:
        """A new session with some choices; its address."""
        home = f"/s/{self.ask('POST', '/sessions', json.dumps({'title': title})).json['name']}"
        if chosen:
            self.choose(home, **chosen)
        return home

    def choose(self, home: str, **chosen: object) -> None:
        answer = self.ask("PATCH", f"{home}/choices", json.dumps(chosen))
        assert answer.status == 200, answer.text

    def put(self, home: str, name: str, content: bytes) -> Answer:
        return self.ask("PUT", f"{home}/given?name={name}", content)

    def state(self, home: str) -> Any:
        return self.ask("GET", f"{home}/state").json

    def done(self, home: str) -> Any:
        """The state once nothing is at work."""
        end = time.monotonic() + PATIENCE
        while (state := self.state(home))["job"]:
            assert time.monotonic() < end, state["job"]
            time.sleep(0.1)
        return state

    def run(self, home: str, step: str) -> Any:
        """Do a step; the state once it is done."""
        answer = self.ask("POST", f"{home}/run/{step}")
        assert answer.status == 200, answer.text
        return self.done(home)


@contextmanager
def serving(folder: Path, *program: str) -> Iterator[Served]:
    """`minimax-cal serve` on a port of its own; ended at the end.  program: another of Python."""
    started = program or ("-m", "minimax_cal.cli")
    command = [sys.executable, *started, "serve", "--port", "0", "--no-browser"]
    process = subprocess.Popen(
        [*command, "--folder", str(folder)], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    assert process.stdout
    assert process.stderr
    try:
        url = process.stdout.readline().strip()
        assert url, process.stderr.read()
        yield Served(process, url, folder)
    finally:
        process.terminate()
        process.communicate(timeout=PATIENCE)
