"""In which units people and files read a value that is in SI here."""

from math import pi
from typing import Any

from minimax_cal.ground.facts import in_file


def for_people(unit: str) -> tuple[float, str]:
    """Factor and unit in which people read a length, or a change of an angle: mm, mrad."""
    return {"m": (1e3, "mm"), "rad": (1e3, "mrad")}.get(unit, (1.0, unit))


def turned_for_people(unit: str) -> tuple[float, str]:
    """Factor and unit in which people read a value itself: an angle of a robot is in degrees."""
    return (180.0 / pi, "deg") if unit == "rad" else for_people(unit)


def in_mm(metres: float) -> float:
    """A length for a file, in 15 digits: read and written again it is the same text."""
    return float(f"{1e3 * metres:.15g}")


def in_own_unit(record: Any, *sizes: str) -> dict[str, Any]:
    """A record of a file, whose `sizes` are in SI, their `unit` told: see `in_files`."""
    scale, unit = in_files(record.unit)
    scaled = {name: scale * getattr(record, name) for name in sizes}
    return in_file(record) | scaled | {"unit": unit}


def in_files(unit: str) -> tuple[float, str]:
    """Factor and unit in files: only lengths are scaled, to millimetres."""
    return (1e3, "mm") if unit == "m" else (1.0, unit)
