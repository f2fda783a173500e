"""In which units people and files read a value that is in SI here."""

from math import pi
from typing import Any

from minimax_cal.core.record_fields import record_to_file_values


def display_unit_of_change(si_unit: str) -> tuple[float, str]:
    """Factor and unit in which people read a length, or a change of an angle: mm, mrad."""
    return {"m": (1e3, "mm"), "rad": (1e3, "mrad")}.get(si_unit, (1.0, si_unit))


def display_unit_of_value(si_unit: str) -> tuple[float, str]:
    """Factor and unit in which people read a value itself: an angle of a robot is in degrees."""
    return (180.0 / pi, "deg") if si_unit == "rad" else display_unit_of_change(si_unit)


def metres_to_file_mm(metres: float) -> float:
    """A length for a file, in 15 digits: read and written again it is the same text."""
    return float(f"{1e3 * metres:.15g}")


def record_in_file_unit(record: Any, *si_fields: str) -> dict[str, Any]:
    """A record of a file, whose `si_fields` are in SI, their `si_unit` told: see `file_unit`."""
    scale, unit = file_unit(record.unit)
    scaled = {name: scale * getattr(record, name) for name in si_fields}
    return record_to_file_values(record) | scaled | {"unit": unit}


def file_unit(si_unit: str) -> tuple[float, str]:
    """Factor and unit in files: only lengths are scaled, to millimetres."""
    return (1e3, "mm") if si_unit == "m" else (1.0, si_unit)
