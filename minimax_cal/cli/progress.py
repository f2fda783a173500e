"""Progress of long work on stderr: a live line on a terminal, else a line now and then."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console

from minimax_cal.cli.stderr import AS_JSON, tell
from minimax_cal.ground.stages import Stage, clock

EVERY = 10.0  # seconds between lines where there is no terminal


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
        if done < 1:
            return now - self.began, None
        return now - self.began, (now - self.counting) / done * (stage.parts - done)

    def line(self, text: str) -> str:
        """A stage with the time so far, and the time left of those that count."""
        seconds, left = self.times(as_stage(text))
        return f"{text} ({clock(seconds)}{'' if left is None else f', {clock(left)} left'})"

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


@contextmanager
def stages(quiet: bool) -> Iterator[Callable[[str], None]]:
    """To be told of each stage: shown on a terminal, else a line after every `EVERY` seconds.

    As JSON every stage is a line.
    """
    told, console = Stages(), Console(stderr=True, quiet=quiet, highlight=False)
    if AS_JSON.get() and not quiet:
        yield lambda text: tell("progress", text, **told.event(text))
        return
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
            tell("progress", line)

    yield show
