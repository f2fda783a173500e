"""Calibrate robot arms, and tell why a calibrated arm still misses.

Names are imported when they are first used: `import minimax_cal as mc` costs next to nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the same names for editors and type checkers
    from minimax_cal.correcting.compensate import Compensation, compensate
    from minimax_cal.correcting.deliverable import Delivered, deliver
    from minimax_cal.correcting.export import export
    from minimax_cal.diagnosing.diagnose import diagnose
    from minimax_cal.diagnosing.instruments import diagnose_relative
    from minimax_cal.diagnosing.instruments_result import RelativeDiagnosis
    from minimax_cal.diagnosing.many import diagnose_many
    from minimax_cal.diagnosing.result import Diagnosis
    from minimax_cal.dynamics.budget import evaluate_motion
    from minimax_cal.dynamics.diagnose import diagnose_motion
    from minimax_cal.dynamics.laws import register_law
    from minimax_cal.dynamics.logs import read_runs
    from minimax_cal.dynamics.logs.table import Run
    from minimax_cal.dynamics.result import MotionDiagnosis, load_motion
    from minimax_cal.fitting.calibrate import calibrate, calibrate_many
    from minimax_cal.fitting.fit import Fit, load_fit
    from minimax_cal.fitting.options import Options
    from minimax_cal.fitting.pixels.calibrate import calibrate_pixels
    from minimax_cal.fitting.several.kinds import relative
    from minimax_cal.fitting.several.result import RelativeCalibration
    from minimax_cal.ground.errors import (
        CalibrationError,
        CalibrationWarning,
        DataError,
        OptionError,
        RobotError,
    )
    from minimax_cal.instruments.table import register_instrument
    from minimax_cal.judging.bootstrap import bootstrap
    from minimax_cal.judging.saved import evaluate
    from minimax_cal.judging.standard import iso9283
    from minimax_cal.judging.watching.comparison import compare
    from minimax_cal.judging.watching.health import check
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
    from minimax_cal.reporting.plots.figures import plot_errors
    from minimax_cal.reporting.report import report
    from minimax_cal.robots.robot import Robot, builtin_robots, load_robot
    from minimax_cal.simulators.drive import load_commands
    from minimax_cal.simulators.ladder import simulator_gap
    from minimax_cal.simulators.motion.ladder import motion_gap
    from minimax_cal.simulators.result import MotionGap, SimulatorGap
    from minimax_cal.solvers.minimize import minimize_max

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
    "CalibrationError": "ground.errors",
    "CalibrationWarning": "ground.errors",
    "DataError": "ground.errors",
    "OptionError": "ground.errors",
    "RobotError": "ground.errors",
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
    "register_instrument": "instruments.table",
    "Simulation": "modelling.simulate",
    "Truth": "modelling.simulate",
    "simulate": "modelling.simulate",
    "Fit": "fitting.fit",
    "load_fit": "fitting.fit",
    "Options": "fitting.options",
    "calibrate": "fitting.calibrate",
    "calibrate_many": "fitting.calibrate",
    "calibrate_pixels": "fitting.pixels.calibrate",
    "relative": "fitting.several.kinds",
    "bootstrap": "judging.bootstrap",
    "evaluate": "judging.saved",
    "check": "judging.watching.health",
    "compare": "judging.watching.comparison",
    "iso9283": "judging.standard",
    "Diagnosis": "diagnosing.result",
    "diagnose": "diagnosing.diagnose",
    "diagnose_many": "diagnosing.many",
    "RelativeCalibration": "fitting.several.result",
    "RelativeDiagnosis": "diagnosing.instruments_result",
    "diagnose_relative": "diagnosing.instruments",
    "Run": "dynamics.logs.table",
    "register_law": "dynamics.laws",
    "read_runs": "dynamics.logs",
    "MotionDiagnosis": "dynamics.result",
    "load_motion": "dynamics.result",
    "diagnose_motion": "dynamics.diagnose",
    "evaluate_motion": "dynamics.budget",
    "plan": "planning.plan",
    "plan_motion": "planning.motion_plan",
    "Compensation": "correcting.compensate",
    "compensate": "correcting.compensate",
    "Delivered": "correcting.deliverable",
    "deliver": "correcting.deliverable",
    "export": "correcting.export",
    "SimulatorGap": "simulators.result",
    "load_commands": "simulators.drive",
    "simulator_gap": "simulators.ladder",
    "MotionGap": "simulators.result",
    "motion_gap": "simulators.motion.ladder",
    "plot_errors": "reporting.plots.figures",
    "report": "reporting.report",
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
