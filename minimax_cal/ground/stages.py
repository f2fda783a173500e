"""Stages of long work, as whoever waits hears of them."""

from __future__ import annotations

from collections.abc import Callable


class Stage(str):
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
    ) -> Stage:
        """A stage; nothing is counted unless given."""
        made = super().__new__(cls, text)
        made.kind, made.part, made.parts = kind or text, part, parts
        made.rung, made.rms_mm = rung, rms_mm
        return made


Progress = Callable[[str], None]


def count_stage(kind: str, part: int, parts: int, more: str = "") -> Stage:
    """A stage of those that count, as "replicate 3 of 10"."""
    return Stage(f"{kind} {part} of {parts}{more}", kind, part, parts)


def number_step(progress: Progress, step: int, steps: int, name: str) -> Progress:
    """Begin a step of long work, as "Step 2 of 5: effects"; stages within it have its number."""
    head = f"Step {step} of {steps}: "

    def numbered(text: str) -> None:
        stage = text if isinstance(text, Stage) else Stage(text)
        progress(Stage(head + stage, stage.kind, stage.part, stage.parts))

    numbered(name)
    return numbered


def name_rung(name: str, rms_mm: float) -> Stage:
    """A step of an error budget that is done, with its held-out error [mm]."""
    return Stage(f"{name}: {rms_mm:.3f} mm", rung=name, rms_mm=rms_mm)


def clock(seconds: float) -> str:
    """As 9 s or 2 min 5 s."""
    minutes, rest = divmod(round(max(seconds, 0.0)), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


class Silent:
    """Progress that says nothing."""

    def __call__(self, message: str) -> None:
        """Say nothing."""

    def __repr__(self) -> str:
        """As the default of a function prints."""
        return "silent"


silent = Silent()
