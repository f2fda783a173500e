"""Make the picture of a report's first page again: python docs/first_page.py [PNG].

A simulated arm that gives way under gravity is calibrated with what its diagnosis establishes.
"""

import contextlib
import sys
import tempfile
from pathlib import Path

import minimax_cal as mc

FACTS = """\
serial_number = "26-104711"
controller = "IRC5, RobotWare 6.15"
tool = "three-ball nest, 1.2 kg"
payload = "1.2 kg"
temperature = "20.5 °C to 21.2 °C"
instrument = "laser tracker, no. 750123"
certificate = "2026-0815"
place = "Hall 3, cell 7"
validity = "2027-01-31, or a collision"
customer = "Example Ltd"
author = "A. Smith"
date = "2026-01-31"
"""


def make(picture: Path) -> None:
    """The first page of a calibration and its diagnosis.  Needs Chromium, Chrome or Edge."""
    picture = picture.resolve()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        data = "poses.csv"
        made = mc.simulate("irb2600", 100, 3, seed=3, truth=mc.Truth(compliance=1.5e-6))
        mc.write_measurements(data, made.data)
        Path("cell.toml").write_text(FACTS)
        found = mc.diagnose("irb2600", data)
        fit = mc.calibrate("irb2600", data, effects=found)
        mc.report([fit, found], picture, tolerance="rms 0.1, max 0.25", facts="cell.toml")


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images/report.png")
