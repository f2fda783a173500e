"""In which units people and files read a value that is in SI here."""

from math import pi


def for_people(unit: str) -> tuple[float, str]:
    """Factor and unit in which people read a length, or a change of an angle: mm, mrad."""
    return {"m": (1e3, "mm"), "rad": (1e3, "mrad")}.get(unit, (1.0, unit))


def turned_for_people(unit: str) -> tuple[float, str]:
    """Factor and unit in which people read a value itself: an angle of a robot is in degrees."""
    return (180.0 / pi, "deg") if unit == "rad" else for_people(unit)


def in_mm(metres: float) -> float:
    """A length for a file, in 15 digits: read and written again it is the same text."""
    return float(f"{1e3 * float(metres):.15g}")


def in_files(unit: str) -> tuple[float, str]:
    """Factor and unit in files: only lengths are scaled, to millimetres."""
    return (1e3, "mm") if unit == "m" else (1.0, unit)
