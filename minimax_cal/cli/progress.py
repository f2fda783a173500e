"""Progress of long work on stderr: a live line on a terminal, else a line every ten seconds."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import copy_context
from typing import Any, NamedTuple

from rich.console import Console
from rich.live import Live
from rich.text import Text

from minimax_cal.cli.stderr_events import IS_JSON_PROGRESS, report_event
from minimax_cal.core.progress_stages import ProgressStage, format_duration, silent_progress

SECONDS_TO_FIRST_PROGRESS_LINE, SECONDS_BETWEEN_PROGRESS_LINES = (
    1.0,
    10.0,
)  # seconds to the first line, and between lines, without a terminal


class StageTimes(NamedTuple):
    """Seconds since the work began, and seconds left; None of stages that are not counted."""

    elapsed: float
    remaining: float | None


class StageClock:
    """What the work is at, since when, and how long it will take where its steps are counted."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self.now = now
        self.began = self.counting = now()
        self.kind = ""

    def elapsed_and_remaining_seconds(self, stage: ProgressStage) -> StageTimes:
        """Seconds so far, and seconds left of stages that count, None of others."""
        now = self.now()
        if stage.kind != self.kind:
            self.kind, self.counting = stage.kind, now
        done = stage.part - 1  # the part named has just begun
        if done < 1 or now <= self.counting:
            return StageTimes(now - self.began, None)
        return StageTimes(now - self.began, (now - self.counting) / done * (stage.parts - done))

    def format_stage(self, stage_text: str) -> str:
        """A stage with the time so far, and the time left of those that count."""
        seconds, left = self.elapsed_and_remaining_seconds(to_stage(stage_text))
        return (
            f"{stage_text}, {format_duration(seconds)}"
            f"{'' if left is None else f', about {format_duration(left)} left'}"
        )

    def build_stage_event(self, stage_text: str) -> dict[str, Any]:
        """What a line of JSON holds of a stage, beside its words."""
        stage = to_stage(stage_text)
        seconds, left = self.elapsed_and_remaining_seconds(stage)
        out: dict[str, Any] = {"seconds": round(seconds, 1)}
        if stage.parts:
            out |= {"part": stage.part, "parts": stage.parts}
        if left is not None:
            out |= {"seconds_left": round(left, 1)}
        if stage.rung:
            out |= {"rung": {"name": stage.rung, "holdout_rms_mm": stage.rms_mm}}
        return out


def to_stage(stage_text: str) -> ProgressStage:
    """A stage of words alone is one, too."""
    return stage_text if isinstance(stage_text, ProgressStage) else ProgressStage(stage_text)


class ProgressTicker:
    """The last stage and its time, drawn on a terminal as it is then.

    Else a line on stderr: after the first second, then every `SECONDS_BETWEEN_PROGRESS_LINES`
    seconds.
    """

    def __init__(self, shown: StageClock) -> None:
        self.shown, self.text = shown, ProgressStage("reading")
        self.over = threading.Event()

    def start_stage(self, stage_text: str) -> None:
        """A stage has begun; its time counts from now."""
        self.text = to_stage(stage_text)
        self.shown.elapsed_and_remaining_seconds(self.text)

    def __rich__(self) -> Text:
        return Text(self.shown.format_stage(self.text), overflow="ellipsis", no_wrap=True)

    def print_lines_until_over(self) -> None:
        """Print lines until the work is over."""
        pause = SECONDS_TO_FIRST_PROGRESS_LINE
        while not self.over.wait(pause):
            report_event("progress", self.shown.format_stage(self.text))
            pause = SECONDS_BETWEEN_PROGRESS_LINES


@contextmanager
def run_progress_ticker(ticker: ProgressTicker) -> Iterator[Callable[[str], None]]:
    """A callback for each stage, of which a thread prints the last now and then."""
    known = copy_context()  # of the command
    thread = threading.Thread(
        target=known.run, args=(ticker.print_lines_until_over,), name="progress", daemon=True
    )
    thread.start()
    try:
        yield ticker.start_stage
    finally:
        ticker.over.set()
        thread.join()


@contextmanager
def show_stage_progress(is_quiet: bool) -> Iterator[Callable[[str], None]]:
    """A callback for each stage: shown on a terminal, else a line every
    `SECONDS_BETWEEN_PROGRESS_LINES` seconds.

    On a terminal the clock ticks, and steps of an error budget stay.  As JSON every stage is a
    line.
    """
    shown, console = StageClock(), Console(stderr=True, quiet=is_quiet, highlight=False)
    ticker = ProgressTicker(shown)

    def on_terminal(text: str) -> None:
        ticker.start_stage(text)
        if ticker.text.rung:
            console.print(Text(text))  # above the line that ticks

    if is_quiet:
        yield silent_progress
    elif IS_JSON_PROGRESS.get():
        yield lambda text: report_event("progress", text, **shown.build_stage_event(text))
    elif console.is_terminal:
        with Live(ticker, console=console, transient=True, refresh_per_second=1):
            yield on_terminal
    else:
        with run_progress_ticker(ticker) as show:
            yield show
