"""Progress of long work on stderr: a live line on a terminal, else a line every ten seconds."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import copy_context
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

from minimax_cal.cli.stderr import AS_JSON, tell
from minimax_cal.ground.stages import Stage, clock, silent

FIRST, EVERY = 1.0, 10.0  # seconds to the first line, and between lines, without a terminal


class Stages:
    """What the work is at, since when, and how long it will take where its steps are counted."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self.now = now
        self.began = self.counting = now()
        self.kind = ""

    def times(self, stage: Stage) -> tuple[float, float | None]:
        """Seconds so far, and seconds left of stages that count, None of others."""
        now = self.now()
        if stage.kind != self.kind:
            self.kind, self.counting = stage.kind, now
        done = stage.part - 1  # the part named has just begun
        if done < 1 or now <= self.counting:
            return now - self.began, None
        return now - self.began, (now - self.counting) / done * (stage.parts - done)

    def line(self, text: str) -> str:
        """A stage with the time so far, and the time left of those that count."""
        seconds, left = self.times(as_stage(text))
        return f"{text}, {clock(seconds)}{'' if left is None else f', about {clock(left)} left'}"

    def event(self, text: str) -> dict[str, Any]:
        """What a line of JSON holds of a stage, beside its words."""
        stage = as_stage(text)
        seconds, left = self.times(stage)
        out: dict[str, Any] = {"seconds": round(seconds, 1)}
        if stage.parts:
            out |= {"part": stage.part, "parts": stage.parts}
        if left is not None:
            out |= {"seconds_left": round(left, 1)}
        if stage.rung:
            out |= {"rung": {"name": stage.rung, "holdout_rms_mm": stage.rms_mm}}
        return out


def as_stage(text: str) -> Stage:
    """A stage of words alone is one, too."""
    return text if isinstance(text, Stage) else Stage(text)


class Ticker:
    """The last stage and its time, drawn on a terminal as it is then.

    Else a line on stderr: after the first second, then every `EVERY` seconds.
    """

    def __init__(self, shown: Stages) -> None:
        self.shown, self.text = shown, Stage("reading")
        self.over = threading.Event()

    def show(self, text: str) -> None:
        """A stage has begun; its time counts from now."""
        self.text = as_stage(text)
        self.shown.times(self.text)

    def __rich__(self) -> Text:
        return Text(self.shown.line(self.text), overflow="ellipsis", no_wrap=True)

    def run(self) -> None:
        """Print lines until the work is over."""
        pause = FIRST
        while not self.over.wait(pause):
            tell("progress", self.shown.line(self.text))
            pause = EVERY


@contextmanager
def ticking(ticker: Ticker) -> Iterator[Callable[[str], None]]:
    """A callback for each stage, of which a thread prints the last now and then."""
    known = copy_context()  # of the command
    thread = threading.Thread(target=known.run, args=(ticker.run,), name="progress", daemon=True)
    thread.start()
    try:
        yield ticker.show
    finally:
        ticker.over.set()
        thread.join()


@contextmanager
def stages(quiet: bool) -> Iterator[Callable[[str], None]]:
    """A callback for each stage: shown on a terminal, else a line every `EVERY` seconds.

    On a terminal the clock ticks, and steps of an error budget stay.  As JSON every stage is a
    line.
    """
    shown, console = Stages(), Console(stderr=True, quiet=quiet, highlight=False)
    ticker = Ticker(shown)

    def on_terminal(text: str) -> None:
        ticker.show(text)
        if ticker.text.rung:
            console.print(Text(text))  # above the line that ticks

    if quiet:
        yield silent
    elif AS_JSON.get():
        yield lambda text: tell("progress", text, **shown.event(text))
    elif console.is_terminal:
        with Live(ticker, console=console, transient=True, refresh_per_second=1):
            yield on_terminal
    else:
        with ticking(ticker) as show:
            yield show
