"""Calibrate robot arms, and tell why a calibrated arm still misses."""

from minimax_cal.correcting.compensate import Compensation, compensate
from minimax_cal.diagnosing.diagnose import diagnose
from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit, load_fit
from minimax_cal.fitting.options import Options
from minimax_cal.ground.errors import CalibrationError, DataError, OptionError, RobotError
from minimax_cal.measuring import datasets
from minimax_cal.measuring.measurements import (
    Measurements,
    measurements,
    read_measurements,
    write_measurements,
)
from minimax_cal.modelling.cell import Cell, evaluate, load_cell
from minimax_cal.robots.robot import Robot, builtin_robots, load_robot
from minimax_cal.solvers.minimize import minimize_max

__all__ = [
    "CalibrationError",
    "Cell",
    "Compensation",
    "DataError",
    "Diagnosis",
    "Fit",
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
    "load_fit",
    "load_robot",
    "measurements",
    "minimize_max",
    "read_measurements",
    "write_measurements",
]
