"""In which units people and files read a value that is in SI here."""


def for_people(unit: str) -> tuple[float, str]:
    """Factor and unit in which people read a value: millimetres, milliradians."""
    return {"m": (1e3, "mm"), "rad": (1e3, "mrad")}.get(unit, (1.0, unit))


def in_files(unit: str) -> tuple[float, str]:
    """Factor and unit in files: only lengths are scaled, to millimetres."""
    return (1e3, "mm") if unit == "m" else (1.0, unit)
