"""A 6D tracker's log: `;`, decimal comma, `..._joint` columns, goal pose and measured pose."""

from __future__ import annotations

from minimax_cal.measuring.importers.reading import (
    Reading,
    Told,
    joint_names,
    named_reading,
    plain,
    stems,
)
from minimax_cal.measuring.importers.sheet import Sheet

TITLE = "6D tracker log"


def fits(sheet: Sheet, joints: bool) -> bool:
    """Whether a measured position stands beside named joints."""
    names = stems(sheet)
    measured = {f"measurement_{axis}" for axis in "xyz"} <= set(names)
    return measured and any(name.endswith("_joint") for name in names)


def read(sheet: Sheet, told: Told) -> Reading:
    """One row a pose; the point is the origin of the measured pose."""
    names = joint_names(sheet)

    def meaning(stem: str) -> str:
        if stem in names:
            return f"q{names.index(stem) + 1}"
        axis = stem.removeprefix("measurement_")
        return f"smr1_{axis}" if axis in ("x", "y", "z") and axis != stem else plain(stem)

    remarks = {
        f"measurement_std_{axis}": "scatter of samples, not an uncertainty" for axis in "xyz"
    }
    return named_reading(TITLE, sheet, meaning, remarks=remarks)
