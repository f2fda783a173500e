"""Calibrate robot arms, and tell why a calibrated arm still misses."""

from minimax_cal import datasets
from minimax_cal.calibrate import Options, calibrate
from minimax_cal.calibration import Calibration
from minimax_cal.cell import Cell, evaluate, load_cell
from minimax_cal.compensate import Compensation, compensate
from minimax_cal.data import Measurements, measurements, read_measurements, write_measurements
from minimax_cal.diagnose import diagnose
from minimax_cal.diagnosis import Diagnosis
from minimax_cal.errors import CalibrationError, DataError, OptionError, RobotError
from minimax_cal.minimize import minimize_max
from minimax_cal.robot import Robot, builtin_robots, load_robot

__all__ = [
    "Calibration",
    "CalibrationError",
    "Cell",
    "Compensation",
    "DataError",
    "Diagnosis",
    "Measurements",
    "OptionError",
    "Options",
    "Robot",
    "RobotError",
    "builtin_robots",
    "calibrate",
    "compensate",
    "datasets",
    "diagnose",
    "evaluate",
    "load_cell",
    "load_robot",
    "measurements",
    "minimize_max",
    "read_measurements",
    "write_measurements",
]
