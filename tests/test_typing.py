"""What a type checker says of a user's script: mypy is run on one, line by line."""

import re
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

from minimax_cal.fitting.options import Loss, Objective, Options
from minimax_cal.fitting.robust_fit import LOSSES, SQUARE_LOSS
from qp_backends.registry import BACKENDS, CHOOSING, BackendName

ROOT = Path(__file__).parent.parent
SCRIPT = """\
from typing import assert_type
import numpy as np
from numpy.typing import NDArray
import minimax_cal as mc
from minimax_cal.instruments import Instrument
from minimax_cal.instruments.tracker_points import TrackerPoints
from qp_backends import Problem, Solution

robot = mc.load_robot("irb120")
Rows = NDArray[np.float64]

def of_points(data: mc.Measurements, tracker: TrackerPoints, q: Rows, y: Rows) -> None:
    assert_type(mc.calibrate(robot, data), mc.Fit)
    assert_type(mc.calibrate("irb120", data, "sum", "clarabel", holdout=0.3), mc.Fit)
    assert_type(mc.calibrate(robot, (q, y)), mc.Fit)
    assert_type(mc.calibrate(robot, tracker), mc.Fit)
    assert_type(mc.diagnose(robot, data, quick=True), mc.Diagnosis)
    assert_type(mc.diagnose(robot, data), mc.RelativeDiagnosis)  # assert-type
    assert_type(mc.calibrate(robot, data), mc.RelativeCalibration)  # assert-type

def of_instruments(wires: Instrument, data: mc.Measurements) -> None:
    assert_type(mc.calibrate(robot, wires), mc.RelativeCalibration)
    assert_type(mc.calibrate(robot, [data, wires]), mc.RelativeCalibration)
    assert_type(mc.diagnose(robot, wires), mc.RelativeDiagnosis)
    assert_type(mc.diagnose(robot, [wires, data]), mc.RelativeDiagnosis)
    assert_type(mc.calibrate(robot, wires), mc.Fit)  # assert-type
    mc.calibrate(robot, wires).cell.target_names  # union-attr

def of_files(path: str) -> None:
    assert_type(mc.calibrate(robot, path), mc.Fit | mc.RelativeCalibration)
    assert_type(mc.calibrate(robot, [path, path]), mc.Fit | mc.RelativeCalibration)
    assert_type(mc.diagnose(robot, path), mc.Diagnosis | mc.RelativeDiagnosis)
    fit = mc.load_fit(path)
    assert_type(fit, mc.Fit | mc.RelativeCalibration)
    assert_type(fit, mc.Fit)  # assert-type
    if isinstance(fit, mc.Fit):
        assert_type(mc.load_fit(fit), mc.Fit)

def qp(problem: Problem) -> Solution:
    raise NotImplementedError

def of_choices(data: mc.Measurements, name: str) -> None:
    mc.calibrate(robot, data, "smr:2", qp, loss="huber")
    mc.calibrate(robot, data, "maximin")  # call-overload
    mc.calibrate(robot, data, qp="dapq")  # call-overload
    mc.calibrate(robot, data, loss="l1")  # call-overload
    mc.calibrate(robot, 3)  # call-overload
    mc.diagnose(robot, 3)  # call-overload
    mc.minimize_max(np.abs, np.ones(2), qp="piqp")
    mc.minimize_max(np.abs, np.ones(2), qp=qp)
    mc.minimize_max(np.abs, np.ones(2), qp="pipq")  # arg-type
"""


@pytest.mark.dev
def test_a_script_has_the_types_that_the_verbs_return(tmp_path):
    """Errors stand where the script says so, of that kind, and nowhere else."""
    pytest.importorskip("mypy")
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--no-error-summary", "--show-error-codes",
         "--config-file", str(ROOT / "pyproject.toml"), str(script)],
        cwd=ROOT, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    found = re.findall(r"script\.py:(\d+): error: .*\[([a-z-]+)\]", done.stdout)
    lines = enumerate(SCRIPT.splitlines(), 1)
    wanted = [(str(i), line.rpartition("# ")[2]) for i, line in lines if "  # " in line]
    assert len(wanted) >= 10
    errors = [line for line in done.stdout.splitlines() if ": error: " in line]
    assert found == wanted, "\n".join([*errors, done.stderr])


def test_the_literals_are_the_names_that_are_understood():
    assert set(get_args(Loss)) == {SQUARE_LOSS, *LOSSES}
    names = {name.partition(":")[0] for name in get_args(BackendName)}
    assert names == set(BACKENDS)
    chosen = {name.partition(":")[0] for name in get_args(BackendName) if ":" in name}
    assert chosen <= set(CHOOSING)
    plain = {name for name in get_args(Objective) if ":" not in name}
    assert plain == {"sum", "minimax", "point", "pose"}
    assert Options().objective in plain
    assert Options().loss in get_args(Loss)
    assert Options().qp in get_args(BackendName)
