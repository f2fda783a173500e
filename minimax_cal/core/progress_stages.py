"""Stages of long work, as whoever waits hears of them."""

from __future__ import annotations

from collections.abc import Callable


class ProgressStage(str):
    """The words of a stage, and what of them are numbers.

    kind: what is counted.  part, parts: which of how many has just begun, 0 where nothing is
    counted.  rung, rms_mm: a step of an error budget that is done, and its held-out error.
    """

    __slots__ = ("kind", "part", "parts", "rms_mm", "rung")
    kind: str
    part: int
    parts: int
    rung: str
    rms_mm: float

    def __new__(
        cls,
        text: str,
        kind: str = "",
        part: int = 0,
        parts: int = 0,
        rung: str = "",
        rms_mm: float = 0.0,
    ) -> ProgressStage:
        """A stage; nothing is counted unless given."""
        made = super().__new__(cls, text)
        made.kind, made.part, made.parts = kind or text, part, parts
        made.rung, made.rms_mm = rung, rms_mm
        return made


Progress = Callable[[str], None]


def build_counted_stage(kind: str, part: int, parts: int, extra_text: str = "") -> ProgressStage:
    """A stage of those that count, as "replicate 3 of 10"."""
    return ProgressStage(f"{kind} {part} of {parts}{extra_text}", kind, part, parts)


def announce_step_and_number_stages(
    progress: Progress, step: int, step_count: int, step_name: str
) -> Progress:
    """Begin a step of long work, as "Step 2 of 5: effects"; stages within it have its number."""
    head = f"Step {step} of {step_count}: "

    def numbered(text: str) -> None:
        stage = text if isinstance(text, ProgressStage) else ProgressStage(text)
        progress(ProgressStage(head + stage, stage.kind, stage.part, stage.parts))

    numbered(step_name)
    return numbered


def build_finished_budget_step_stage(step_name: str, rms_mm: float) -> ProgressStage:
    """A step of an error budget that is done, with its held-out error [mm]."""
    return ProgressStage(f"{step_name}: {rms_mm:.3f} mm", rung=step_name, rms_mm=rms_mm)


def format_duration(seconds: float) -> str:
    """As 9 s or 2 min 5 s."""
    minutes, rest = divmod(round(max(seconds, 0.0)), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


class SilentProgress:
    """Progress that says nothing."""

    def __call__(self, message: str) -> None:
        """Say nothing."""

    def __repr__(self) -> str:
        """As the default of a function prints."""
        return "silent"


silent_progress = SilentProgress()
