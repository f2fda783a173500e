"""Instruments: each reads points of the flange, or the flange itself; only that is its own.

Lengths of wires and closures know no base frame, closures no length either: what that leaves open
a fit says with the parameters, by name and reason.  A module is imported when one of its names is
first used: a calibration from a tracker needs none of the others.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the same names for editors and type checkers
    from minimax_cal.instruments.check import check_instrument as check_instrument
    from minimax_cal.instruments.file import read_relative as read_relative
    from minimax_cal.instruments.file import write_relative as write_relative
    from minimax_cal.instruments.instrument import Instrument as Instrument
    from minimax_cal.instruments.poses import flange_poses as flange_poses
    from minimax_cal.instruments.poses import poses_as_targets as poses_as_targets
    from minimax_cal.instruments.probe import contacts as contacts
    from minimax_cal.instruments.shapes import Surface as Surface
    from minimax_cal.instruments.sockets import closures as closures
    from minimax_cal.instruments.table import register_instrument as register_instrument
    from minimax_cal.instruments.wires import distances as distances

MODULES = {
    "check_instrument": "check", "Instrument": "instrument", "Surface": "shapes",
    "closures": "sockets", "contacts": "probe", "distances": "wires", "flange_poses": "poses",
    "poses_as_targets": "poses", "read_relative": "file", "register_instrument": "table",
    "write_relative": "file",
}  # fmt: skip


def __getattr__(name: str) -> object:
    """A name on its first use [PEP 562]."""
    if name not in MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{MODULES[name]}"), name)
