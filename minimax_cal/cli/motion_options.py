"""Options of commands that read logs of an arm in motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from minimax_cal.cli.options import Decorator, plain_option, stacked
from minimax_cal.dynamics.given import Payload
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.options import number

Pair = tuple[tuple[float, ...], tuple[float, ...]]


def listed(text: str, name: str) -> tuple[float, ...]:
    """Numbers separated by commas.  Raises OptionError."""
    found = tuple(number(part) for part in text.split(","))
    if not all(map(math.isfinite, found)):
        raise OptionError(f"{name}={text!r}: give numbers separated by commas")
    return found


def carried(text: str) -> Payload:
    """KG@x,y,z in kg and m.  Raises OptionError."""
    mass, mark, at = text.partition("@")
    parts = [number(part) for part in at.split(",")] if mark else [0.0, 0.0, 0.0]
    if not number(mass) > 0.0 or len(parts) != 3 or not all(map(math.isfinite, parts)):
        raise OptionError(f"payload={text!r}: give KG@x,y,z in kg and m, as 2@0,0,0.05")
    return number(mass), (parts[0], parts[1], parts[2])


def paired(text: str) -> Pair:
    """KP:KD of each joint, separated by commas, or one for all.  Raises OptionError."""
    pairs = [part.partition(":") for part in text.split(",")]
    both = tuple(tuple(number(pair[k]) for pair in pairs) for k in (0, 2))
    if not all(value >= 0.0 and math.isfinite(value) for side in both for value in side):
        raise OptionError(
            f"gains={text!r}: give KP:KD of each joint in N m/rad and N m s/rad, as 2000:200"
        )
    return both[0], both[1]


def read(reader: Callable[[str], Any]) -> Callable[..., Any]:
    """What click calls with an option that may not be given."""
    return lambda context, option, text: None if text is None else reader(text)


def motion_options(group: str) -> Decorator:
    """What is known of the arm whose torques were logged."""
    return stacked(
        plain_option(
            group,
            "--payload",
            metavar="KG@X,Y,Z",
            callback=read(carried),
            help="What the flange is known to carry: kg, and its centre in the last frame in m.",
        ),
        plain_option(
            group,
            "--drive-gain",
            metavar="LIST",
            callback=read(partial(listed, name="drive_gain")),
            help="Torque for one ampere of each joint, N m per A.",
        ),
        plain_option(
            group,
            "--ratio",
            metavar="LIST",
            callback=read(partial(listed, name="ratio")),
            help="Gear ratio of all joints, or of each.",
        ),
    )
