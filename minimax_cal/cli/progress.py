"""Progress of long work on stderr: a live line on a terminal, else a line now and then."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import click
from rich.console import Console

EVERY = 10.0  # seconds between lines where there is no terminal
COUNT = re.compile(r"(\d+) of (\d+)")


class Stages:
    """What the work is at, since when, and how long it will take where its steps are counted."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self.now = now
        self.began = self.counting = now()
        self.kind = ""

    def line(self, text: str) -> str:
        """A stage with the time so far, and the time left of those that count."""
        now, counted = self.now(), COUNT.search(text)
        kind = COUNT.sub("", text.partition(":")[0])
        if kind != self.kind:
            self.kind, self.counting = kind, now
        left = ""
        if counted and int(counted[1]) > 1:
            done, steps = int(counted[1]) - 1, int(counted[2])  # the step named has just begun
            left = f", {clock((now - self.counting) / done * (steps - done))} left"
        return f"{text} ({clock(now - self.began)}{left})"


def clock(seconds: float) -> str:
    """As 9 s or 2 min 5 s."""
    minutes, rest = divmod(round(max(seconds, 0.0)), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


@contextmanager
def stages(quiet: bool) -> Iterator[Callable[[str], None]]:
    """To be told of each stage: shown on a terminal, else a line after every `EVERY` seconds."""
    told, console = Stages(), Console(stderr=True, quiet=quiet, highlight=False)
    if console.is_terminal or quiet:
        with console.status("reading") as status:
            yield lambda text: status.update(told.line(text))
        return
    last = told.began

    def show(text: str) -> None:
        nonlocal last
        line = told.line(text)
        if told.now() - last >= EVERY:
            last = told.now()
            click.echo(f"progress: {line}", err=True)

    yield show
