"""Calibration by one or several instruments that share an arm."""

from minimax_cal.fitting.several.kinds import relative
from minimax_cal.fitting.several.options import RelativeOptions
from minimax_cal.fitting.several.result import RelativeCalibration

__all__ = ["RelativeCalibration", "RelativeOptions", "relative"]
