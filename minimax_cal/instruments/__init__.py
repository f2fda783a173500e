"""Instruments: each reads points of the flange, or the flange itself; only that is its own.

Lengths of wires and closures know no base frame, closures no length either: what that leaves open
a fit says with the parameters, by name and reason.  A module is imported when one of its names is
first used: a calibration from a tracker needs none of the others.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the same names for editors and type checkers
    from minimax_cal.instruments.instrument import Instrument as Instrument
    from minimax_cal.instruments.instrument_files import read_relative as read_relative
    from minimax_cal.instruments.instrument_files import write_relative as write_relative
    from minimax_cal.instruments.instrument_registry import (
        register_instrument as register_instrument,
    )
    from minimax_cal.instruments.probe_contacts import contacts as contacts
    from minimax_cal.instruments.shapes import Surface as Surface
    from minimax_cal.instruments.slope_check import check_instrument as check_instrument
    from minimax_cal.instruments.sockets import closures as closures
    from minimax_cal.instruments.whole_poses import flange_poses as flange_poses
    from minimax_cal.instruments.whole_poses import poses_as_targets as poses_as_targets
    from minimax_cal.instruments.wires import distances as distances

MODULE_BY_PUBLIC_NAME = {
    "check_instrument": "slope_check", "Instrument": "instrument", "Surface": "shapes",
    "closures": "sockets", "contacts": "probe_contacts", "distances": "wires",
    "flange_poses": "whole_poses", "poses_as_targets": "whole_poses",
    "read_relative": "instrument_files", "register_instrument": "instrument_registry",
    "write_relative": "instrument_files",
}  # fmt: skip


def __getattr__(name: str) -> object:
    """A name on its first use [PEP 562]."""
    if name not in MODULE_BY_PUBLIC_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{MODULE_BY_PUBLIC_NAME[name]}"), name)
