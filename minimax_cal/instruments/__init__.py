"""Instruments: each reads points of the flange, or the flange itself; only that is its own.

Lengths of wires and closures know no base frame, closures no length either: what that leaves open
a fit says with the parameters, by name and reason.
"""

from minimax_cal.instruments.contacts import contacts
from minimax_cal.instruments.file import read_relative, write_relative
from minimax_cal.instruments.instrument import Instrument
from minimax_cal.instruments.poses import flange_poses, poses_as_targets
from minimax_cal.instruments.shapes import Surface
from minimax_cal.instruments.sockets import closures
from minimax_cal.instruments.table import register_instrument
from minimax_cal.instruments.wires import distances

__all__ = [
    "Instrument",
    "Surface",
    "closures",
    "contacts",
    "distances",
    "flange_poses",
    "poses_as_targets",
    "read_relative",
    "register_instrument",
    "write_relative",
]
