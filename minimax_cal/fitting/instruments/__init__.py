"""Calibration without coordinates: lengths of wires, sockets visited again, whole flange poses.

Lengths and closures know no base frame, closures no length either: what that leaves open is said
with the parameters, by name and reason.
"""

from minimax_cal.fitting.instruments.data import RelativeData
from minimax_cal.fitting.instruments.file import read_relative, write_relative
from minimax_cal.fitting.instruments.kinds import relative
from minimax_cal.fitting.instruments.options import RelativeOptions
from minimax_cal.fitting.instruments.poses import flange_poses, poses_as_targets
from minimax_cal.fitting.instruments.result import RelativeCalibration
from minimax_cal.fitting.instruments.touches import Surface, contacts
from minimax_cal.fitting.instruments.visits import closures
from minimax_cal.fitting.instruments.wires import distances

__all__ = [
    "RelativeCalibration",
    "RelativeData",
    "RelativeOptions",
    "Surface",
    "closures",
    "contacts",
    "distances",
    "flange_poses",
    "poses_as_targets",
    "read_relative",
    "relative",
    "write_relative",
]
