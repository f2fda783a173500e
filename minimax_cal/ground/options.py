"""What a field of a dataclass is as an option of a command: unit, default and help in one place."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from typing import Any

from minimax_cal.ground.errors import OptionError

SI = {  # what a unit of the command line is
    "": 1.0,
    "m": 1.0,
    "mm": 1e-3,
    "um": 1e-6,
    "um/m": 1e-6,
    "deg": math.pi / 180.0,
    "mrad": 1e-3,
    "urad": 1e-6,
    "urad/Nm": 1e-6,
    "kg": 1.0,
}


@dataclass(frozen=True)
class Option:
    """How people give a field.

    help: a sentence.  unit: of the number that they give, a key of SI.  metavar: what stands for
    the value in the help.  flag: the option's name where it is not the field's.  read: the value
    from a text.  values: how many the option takes.  many: what gathers those of an option that
    may be given several times; without `read` they are names, also separated by commas.
    group: under which heading the help lists it.
    """

    help: str = ""
    unit: str = ""
    metavar: str = ""
    flag: str = ""
    read: Callable[[str], Any] | None = None
    values: int = 1
    many: Callable[[Iterable[Any]], Any] | None = None
    group: str = ""


def option(default: Any, help: str = "", unit: str = "", **more: Any) -> Any:
    """A field that is an option too.  default: SI, or dict.  help, unit, more: see `Option`."""
    told = {"option": Option(help, unit, **more)}
    if default is dict:
        return field(default_factory=dict, metadata=told)
    return field(default=default, metadata=told)


def names_of(texts: Iterable[str]) -> tuple[str, ...]:
    """Names separated by commas, from an option that may be given several times."""
    return tuple(name.strip() for text in texts for name in text.split(",") if name.strip())


def check_left_out(names: Iterable[str], known: Collection[str]) -> None:
    """Raise OptionError for an effect to leave out that nobody knows."""
    for name in names:
        if name not in known:
            raise OptionError(f"no effect {name!r} to leave out; choose {', '.join(known)}")


def number(text: str) -> float:
    """A number, NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def triple(text: str, name: str) -> tuple[float, ...]:
    """Three lengths in millimetres, in metres.  Raises OptionError."""
    parts = [number(part) for part in text.split(",")]
    if len(parts) != 3 or not all(map(math.isfinite, parts)):
        raise OptionError(f"{name}={text!r}: give x,y,z in mm, as 3000,0,500")
    return tuple(1e-3 * part for part in parts)


def pair(text: str, name: str, scale: float) -> tuple[float, float]:
    """LOW:HIGH in SI.  Raises OptionError."""
    parts = [scale * number(part) for part in text.split(":")]
    if len(parts) != 2 or any(map(math.isnan, parts)):
        raise OptionError(f"{name}={text!r}: give low:high, as 0.5:20")
    if not parts[0] < parts[1]:
        raise OptionError(f"{name}={text!r}: the limits are reversed; give low:high")
    return parts[0], parts[1]
