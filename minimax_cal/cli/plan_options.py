"""The options of `minimax-cal plan` in SI, as keyword arguments of `plan`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from minimax_cal.cli.options import names_of
from minimax_cal.ground.errors import OptionError
from minimax_cal.robots.robot import Robot

JOINT = re.compile(r"[Jj]?(\d+)=(.+)")
DEGREE = float(np.radians(1.0))
SCALES = {  # of what is given as a number: to SI
    "acceptance": DEGREE,
    "floor": 1e-3,
    "body": 1e-3,
    "noise": 1e-6,
    "per_metre": 1e-6,
    "jitter": 1e-6,
}


def keywords_of(given: Mapping[str, Any], robot: Robot) -> dict[str, Any]:
    """What the command was given, as `plan` takes it.  Raises OptionError."""
    numbers = {
        name: None if given[name] is None else scale * given[name] for name, scale in SCALES.items()
    }
    texts = {
        "effects": names_of(given["effects"]),
        "separate": tuple(given["separate"] or ()),
        "tracker": triple(given["tracker"], "--tracker") if given["tracker"] else (),
        "spots": tuple(triple(spot, "--target") for spot in given["spots"]),
        "reach": pair(given["reach"], "--range", 1.0),
        "elevation": pair(given["elevation"], "--elevation", DEGREE),
        "joints": dict(joint(text, robot) for text in given["joints"]),
        "volume": box(given["volume"]) if given["volume"] else (),
    }
    return {**given, **numbers, **texts}


def triple(text: str, option: str) -> tuple[float, ...]:
    """Three lengths in millimetres, in metres.  Raises OptionError."""
    parts = [number(part) for part in text.split(",")]
    if len(parts) != 3 or not np.isfinite(parts).all():
        raise OptionError(f"{option} {text!r}: give x,y,z in mm, as 3000,0,500")
    return tuple(1e-3 * part for part in parts)


def number(text: str) -> float:
    """A number, NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def pair(text: str, option: str, scale: float) -> tuple[float, float]:
    """LOW:HIGH in SI.  Raises OptionError."""
    parts = [scale * number(part) for part in text.split(":")]
    if len(parts) != 2 or np.isnan(parts).any():
        raise OptionError(f"{option} {text!r}: give low:high, as 0.5:20")
    if not parts[0] < parts[1]:
        raise OptionError(f"{option} {text!r}: the limits are reversed; give low:high")
    return parts[0], parts[1]


def joint(text: str, robot: Robot) -> tuple[int, tuple[float, float]]:
    """J2=LOW:HIGH in degrees, slides in millimetres.  Raises OptionError."""
    match = JOINT.fullmatch(text)
    if not match:
        raise OptionError(f"--joint {text!r}: write J2=-30:60, in degrees (slides: mm)")
    index = int(match[1]) - 1
    if not 0 <= index < robot.joints:
        raise OptionError(f"--joint {text!r}: {robot.name} has joints 1 to {robot.joints}")
    scale = 1e-3 if robot.prismatic[index] else DEGREE
    return index, pair(match[2], f"--joint {text.partition('=')[0]}", scale)


def box(text: str) -> tuple[tuple[float, ...], ...]:
    """LOW:HIGH of x, y and z in millimetres, as corners in metres.  Raises OptionError."""
    axes = text.split(",")
    if len(axes) != 3:
        raise OptionError(f"--volume {text!r}: give x, y and z, as 700:1700,-500:500,300:1300")
    limits = [pair(axis, "--volume", 1e-3) for axis in axes]
    return tuple(low for low, _ in limits), tuple(high for _, high in limits)
