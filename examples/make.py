"""Make the example's measurements and picture again: python examples/make.py [FOLDER]."""

import sys
from pathlib import Path

import minimax_cal as mc
from minimax_cal.modelling.simulate import simulate
from minimax_cal.reporting.plots.error_figure import save_errors


def make(folder: Path) -> None:
    """IRB 2600: 100 poses, three targets, geometric errors, some compliance, tracker noise."""
    robot = mc.load_robot("irb2600")
    made = simulate(robot, poses=100, targets=3, seed=1)
    mc.write_measurements(folder / "irb2600.csv", made.data)
    fit = mc.calibrate(robot, folder / "irb2600.csv")
    save_errors(fit, folder / "irb2600.svg")


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
