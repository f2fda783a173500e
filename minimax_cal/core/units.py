"""In which units people and files read a value that is in SI here."""

from math import pi
from typing import Any, NamedTuple

from minimax_cal.core.record_fields import record_to_file_values


class DisplayUnit(NamedTuple):
    """A unit and the factor that converts an SI number to it."""

    scale: float
    name: str


def display_unit_of_change(si_unit: str) -> DisplayUnit:
    """Unit in which people read a length, or a change of an angle: mm, mrad."""
    name = {"m": "mm", "rad": "mrad"}.get(si_unit)
    return DisplayUnit(1e3, name) if name else DisplayUnit(1.0, si_unit)


def display_unit_of_value(si_unit: str) -> DisplayUnit:
    """Unit in which people read a value itself: an angle of a robot is in degrees."""
    return DisplayUnit(180.0 / pi, "deg") if si_unit == "rad" else display_unit_of_change(si_unit)


def metres_to_file_mm(metres: float) -> float:
    """A length for a file, in 15 digits: read and written again it is the same text."""
    return float(f"{1e3 * metres:.15g}")


def record_in_file_unit(record: Any, *si_fields: str) -> dict[str, Any]:
    """A record of a file, whose `si_fields` are in SI, their `si_unit` told: see `file_unit`."""
    scale, unit = file_unit(record.unit)
    scaled = {name: scale * getattr(record, name) for name in si_fields}
    return record_to_file_values(record) | scaled | {"unit": unit}


def file_unit(si_unit: str) -> DisplayUnit:
    """Unit in files: only lengths are scaled, to millimetres."""
    return DisplayUnit(1e3, "mm") if si_unit == "m" else DisplayUnit(1.0, si_unit)
