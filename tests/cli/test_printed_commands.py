"""What a command advises to run next runs as it is printed, and so on, for five arms."""

import shlex
from pathlib import Path

import numpy as np
import pytest
from conftest import run

import minimax_cal as mc
from minimax_cal.modelling.simulate import Truth, simulate

ARMS = ("irb120", "irb2600", "ur10", "scara_600", "meca500")


def printed(out: str) -> list[list[str]]:
    """The commands among the lines that are indented, as a shell would take them."""
    lines = (line.strip() for line in out.splitlines())
    return [shlex.split(line)[1:] for line in lines if line.startswith("minimax-cal ")]


@pytest.mark.parametrize("name", ARMS)
def test_what_is_advised_runs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco", reason="needs pip install minimax-cal[mujoco]")
    monkeypatch.chdir(tmp_path)
    robot = mc.load_robot(name)
    truth = Truth(compliance=0.0 if name == "scara_600" else 3e-6)
    data = simulate(robot, 60, 3, seed=1, truth=truth).data
    mc.write_measurements("poses.csv", data)
    units = [f"q{i + 1}_{'mm' if slides else 'rad'}" for i, slides in enumerate(robot.prismatic)]
    rows = data.q[:3] * np.where(robot.prismatic, 1e3, 1.0)
    np.savetxt("targets.csv", rows, "%.6f", ",", header=",".join(units), comments="")
    waiting = [
        ["calibrate", name, "poses.csv", "-o", "fit.json"],
        ["diagnose", name, "poses.csv", "-o", "diagnosis.json", "--quick"],
    ]
    done: list[list[str]] = []
    while waiting:
        command = waiting.pop(0)
        done.append(command)
        code = run(*command)
        out, err = capsys.readouterr()
        singular = command[0] == "compensate" and "are missed: singular" in err
        assert code == singular, f"{' '.join(command)}: {err}"
        waiting += [more for more in printed(out) if more not in (*done, *waiting)]
    verbs = {command[0] for command in done}
    assert {"calibrate", "diagnose", "compensate", "export"} <= verbs
