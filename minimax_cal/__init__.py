"""Calibrate robot arms, and tell why a calibrated arm still misses.

Names are imported when they are first used: `import minimax_cal as mc` costs next to nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the same names for editors and type checkers
    from minimax_cal.compensation.deliverable import Delivered, deliver
    from minimax_cal.compensation.joint_compensation import Compensation, compensate
    from minimax_cal.compensation.robot_export import export
    from minimax_cal.core.errors import (
        CalibrationError,
        CalibrationWarning,
        DataError,
        OptionError,
        RobotError,
    )
    from minimax_cal.diagnosing.diagnose import diagnose
    from minimax_cal.diagnosing.diagnose_instruments import diagnose_relative
    from minimax_cal.diagnosing.diagnose_many import diagnose_many
    from minimax_cal.diagnosing.diagnosis import Diagnosis
    from minimax_cal.diagnosing.instruments_result import RelativeDiagnosis
    from minimax_cal.dynamics.cross_validation import evaluate_motion
    from minimax_cal.dynamics.diagnose import diagnose_motion
    from minimax_cal.dynamics.laws import register_law
    from minimax_cal.dynamics.logs import read_runs
    from minimax_cal.dynamics.logs.log_table import Run
    from minimax_cal.dynamics.result import MotionDiagnosis, load_motion
    from minimax_cal.fitting.calibrate import calibrate, calibrate_many
    from minimax_cal.fitting.fit import Fit, load_fit
    from minimax_cal.fitting.multi_instrument.relative_calibration import relative
    from minimax_cal.fitting.multi_instrument.relative_result import RelativeCalibration
    from minimax_cal.fitting.options import Options
    from minimax_cal.fitting.pixels.calibrate import calibrate_pixels
    from minimax_cal.instruments.instrument_registry import register_instrument
    from minimax_cal.measuring import datasets
    from minimax_cal.measuring.campaigns import read_campaigns
    from minimax_cal.measuring.importers import import_files
    from minimax_cal.measuring.measurements import (
        Measurements,
        measurements,
        read_measurements,
        write_measurements,
    )
    from minimax_cal.modelling.cell import Cell, load_cell
    from minimax_cal.modelling.effects.table import EFFECTS, register
    from minimax_cal.modelling.simulate import Simulation, Truth, simulate
    from minimax_cal.planning.motion_plan import plan_motion
    from minimax_cal.planning.plan import plan
    from minimax_cal.reporting.plots.error_figure import plot_errors
    from minimax_cal.reporting.report_file import report
    from minimax_cal.robots.robot import Robot, builtin_robots, load_robot
    from minimax_cal.simulators.drive import load_commands
    from minimax_cal.simulators.gap import simulator_gap
    from minimax_cal.simulators.motion.gap import motion_gap
    from minimax_cal.simulators.result import MotionGap, SimulatorGap
    from minimax_cal.solvers.minimize import minimize_max
    from minimax_cal.validation.bootstrap import bootstrap
    from minimax_cal.validation.evaluation import evaluate
    from minimax_cal.validation.iso9283_of_result import iso9283
    from minimax_cal.validation.monitoring.calibration_check import check
    from minimax_cal.validation.monitoring.comparison import compare

    __version__: str

__all__ = [
    "EFFECTS",
    "CalibrationError",
    "CalibrationWarning",
    "Cell",
    "Compensation",
    "DataError",
    "Delivered",
    "Diagnosis",
    "Fit",
    "Measurements",
    "MotionDiagnosis",
    "MotionGap",
    "OptionError",
    "Options",
    "RelativeCalibration",
    "RelativeDiagnosis",
    "Robot",
    "RobotError",
    "Run",
    "Simulation",
    "SimulatorGap",
    "Truth",
    "bootstrap",
    "builtin_robots",
    "calibrate",
    "calibrate_many",
    "calibrate_pixels",
    "check",
    "compare",
    "compensate",
    "datasets",
    "deliver",
    "diagnose",
    "diagnose_many",
    "diagnose_motion",
    "diagnose_relative",
    "evaluate",
    "evaluate_motion",
    "export",
    "import_files",
    "iso9283",
    "load_cell",
    "load_commands",
    "load_fit",
    "load_motion",
    "load_robot",
    "measurements",
    "minimize_max",
    "motion_gap",
    "plan",
    "plan_motion",
    "plot_errors",
    "read_campaigns",
    "read_measurements",
    "read_runs",
    "register",
    "register_instrument",
    "register_law",
    "relative",
    "report",
    "simulate",
    "simulator_gap",
    "write_measurements",
]

MODULES = {  # name: where it is defined
    "CalibrationError": "core.errors",
    "CalibrationWarning": "core.errors",
    "DataError": "core.errors",
    "OptionError": "core.errors",
    "RobotError": "core.errors",
    "minimize_max": "solvers.minimize",
    "Robot": "robots.robot",
    "builtin_robots": "robots.robot",
    "load_robot": "robots.robot",
    "Measurements": "measuring.measurements",
    "measurements": "measuring.measurements",
    "read_measurements": "measuring.measurements",
    "read_campaigns": "measuring.campaigns",
    "write_measurements": "measuring.measurements",
    "import_files": "measuring.importers",
    "datasets": "measuring.datasets",  # the module itself
    "Cell": "modelling.cell",
    "load_cell": "modelling.cell",
    "EFFECTS": "modelling.effects.table",
    "register": "modelling.effects.table",
    "register_instrument": "instruments.instrument_registry",
    "Simulation": "modelling.simulate",
    "Truth": "modelling.simulate",
    "simulate": "modelling.simulate",
    "Fit": "fitting.fit",
    "load_fit": "fitting.fit",
    "Options": "fitting.options",
    "calibrate": "fitting.calibrate",
    "calibrate_many": "fitting.calibrate",
    "calibrate_pixels": "fitting.pixels.calibrate",
    "relative": "fitting.multi_instrument.relative_calibration",
    "bootstrap": "validation.bootstrap",
    "evaluate": "validation.evaluation",
    "check": "validation.monitoring.calibration_check",
    "compare": "validation.monitoring.comparison",
    "iso9283": "validation.iso9283_of_result",
    "Diagnosis": "diagnosing.diagnosis",
    "diagnose": "diagnosing.diagnose",
    "diagnose_many": "diagnosing.diagnose_many",
    "RelativeCalibration": "fitting.multi_instrument.relative_result",
    "RelativeDiagnosis": "diagnosing.instruments_result",
    "diagnose_relative": "diagnosing.diagnose_instruments",
    "Run": "dynamics.logs.log_table",
    "register_law": "dynamics.laws",
    "read_runs": "dynamics.logs",
    "MotionDiagnosis": "dynamics.result",
    "load_motion": "dynamics.result",
    "diagnose_motion": "dynamics.diagnose",
    "evaluate_motion": "dynamics.cross_validation",
    "plan": "planning.plan",
    "plan_motion": "planning.motion_plan",
    "Compensation": "compensation.joint_compensation",
    "compensate": "compensation.joint_compensation",
    "Delivered": "compensation.deliverable",
    "deliver": "compensation.deliverable",
    "export": "compensation.robot_export",
    "SimulatorGap": "simulators.result",
    "load_commands": "simulators.drive",
    "simulator_gap": "simulators.gap",
    "MotionGap": "simulators.result",
    "motion_gap": "simulators.motion.gap",
    "plot_errors": "reporting.plots.error_figure",
    "report": "reporting.report_file",
}


def __getattr__(name: str) -> object:
    """A public name on its first use, kept from then on [PEP 562]."""
    if name == "__version__":
        found: object = import_module("importlib.metadata").version("minimax-cal")
    elif name in MODULES:
        module = import_module(f"minimax_cal.{MODULES[name]}")
        found = module if name == "datasets" else getattr(module, name)
    else:
        raise AttributeError(f"module 'minimax_cal' has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """The public names alone."""
    return sorted((*__all__, "__version__"))
