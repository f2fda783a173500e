"""Points that a model meets exactly: every command takes them, without a warning or a traceback.

What a fit leaves of computed points is rounding, another on each processor.  Here all of it is 0.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from conftest import run

import minimax_cal as mc
from minimax_cal.fitting.several.stack import Block
from minimax_cal.instruments import write_relative
from minimax_cal.instruments.sockets import Visits
from minimax_cal.instruments.wires import Lengths
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.model import Model
from minimax_cal.modelling.simulate import Truth, simulate

ROUNDING = 1e-8  # [m]
EXACT = Truth(length=0.0, angle=0.0, compliance=0.0, noise=0.0, noise_per_metre=0.0)


def rounded(errors: Callable[..., Any]) -> Callable[..., Any]:
    """Errors, or errors and what goes with them, that are 0 where they are rounding."""

    def zero(error: Any) -> Any:
        return np.where(np.abs(error) < ROUNDING, 0.0, error)

    def made(*given: Any, **named: Any) -> Any:
        found = errors(*given, **named)
        return (zero(found[0]), *found[1:]) if isinstance(found, tuple) else zero(found)

    return made


@pytest.fixture(autouse=True)
def exact() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for owner, name in [
            (Cell, "error"), (Model, "error"), (Model, "error_of"),
            (Block, "rows"), (Lengths, "errors"), (Visits, "errors"),
        ]:  # fmt: skip
            patch.setattr(owner, name, rounded(getattr(owner, name)))
        yield


@pytest.mark.parametrize("off", [(), (7,)], ids=["none", "one"])
def test_commands_take_exact_points(off, tmp_path, robot):
    """Of the poses none or one is off."""
    data, rng = simulate(robot, 40, 3, seed=3, truth=EXACT).data, np.random.default_rng(0)
    y = data.y.copy()
    y[list(off)] += 5e-5 * rng.normal(size=(len(off), 3, 3))
    poses, fit, gap, targets = (tmp_path / n for n in ("d.csv", "f.json", "g.json", "t.csv"))
    mc.write_measurements(poses, data.with_y(y))
    header = ",".join(f"q{joint}_rad" for joint in range(1, 7))
    np.savetxt(targets, data.q[:4], "%.17g", ",", header=header, comments="")
    commands = [
        *(("calibrate", "irb2600", poses, "--objective", o, "-o", fit) for o in ("sum", "point")),
        ("calibrate", "irb2600", poses, "--loss", "tukey", "--effects", "joint_compliance:J2"),
        ("calibrate", "irb2600", poses, "--bootstrap", "5", "-o", fit),
        ("diagnose", "irb2600", poses, "-o", gap),
        ("evaluate", fit, poses, "--json"),
        ("check", fit, poses, "--tolerance", "rms 0.5"),
        ("compare", fit, fit),
        ("map", fit, poses, "--samples", "200"),
        ("iso9283", fit),
        ("compensate", fit, targets, "--keep-anyway", "-o", tmp_path / "out.csv"),
        ("plan", "irb2600", "--poses", "3", "--fit", fit, "--candidates", "30"),
        ("report", fit, gap, "--date", "2026-01-01", "-o", tmp_path / "r.html"),
    ]
    for command in commands:
        assert run(*command) in (0, 1), command  # 1: no better than the drawn arm, which is exact


@pytest.mark.parametrize("kind", ["wires_3", "closures"])
def test_instruments_take_exact_rows(kind, tmp_path):
    from experiments import relative

    arm = relative.Arm.of("irb2600", 3, 0.0)
    made = relative.SIMULATORS[kind](arm, np.random.default_rng(3), 60, 0.0)
    write_relative(tmp_path / "d.csv", made.data)
    assert run("relative", "irb2600", tmp_path / "d.csv", "--diagnose") == 0
