"""Good files that the fuzzer breaks: an arm, its measurements, and what every command makes."""

from __future__ import annotations

import csv
import io
import json
import os
import tempfile
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments.pixel_cells import board_corner_points, simulate_pixel_cell, write_cell_files
from minimax_cal.cli import main
from minimax_cal.dynamics.regressor import (
    JointMotion,
    build_nominal_inertial_parameters,
    inverse_dynamics,
)
from minimax_cal.instruments.sockets import reach

POSES = 24


def done(*arguments: str) -> None:
    """Run a command that has to work."""
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            main(arguments)
    except SystemExit as ended:
        if ended.code:
            raise RuntimeError(f"{arguments} ended with {ended.code}") from ended


MADE: dict[str, bytes] = {}  # a process that runs cases is handed those of its parent


def material() -> dict[str, bytes]:
    """Files by name, all of one simulated arm, made once.  Skips without MuJoCo."""
    if MADE:
        return MADE
    pytest.importorskip("mujoco", reason="needs pip install minimax-cal[mujoco]")
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            make()
            MADE.update({path.name: path.read_bytes() for path in sorted(Path().iterdir())})
        finally:
            os.chdir(before)
    return MADE


def make() -> None:
    """Write them all to the current folder."""
    robot = mc.load_robot("irb120")
    plain = robot.to_dict()
    Path("robot.json").write_text(json.dumps(plain))
    Path("robot.yaml").write_text(yaml.safe_dump(plain))
    Path("robot.toml").write_text(toml(plain))
    few = ("simulate", "irb120", "--poses", str(POSES), "--seed", "3")
    done(*few, "-o", "data.csv", "--truth", "truth.json")
    measured = Path("data.csv")  # as a tracker's file: without the mark of computed points
    rows = (row.rpartition(",")[0] for row in measured.read_text().splitlines())
    measured.write_text("".join(f"{row}\n" for row in rows))
    rows = list(csv.reader(measured.read_text().splitlines()))
    write("later.csv", [rows[0], *(later(row, 40.0) for row in rows[1:])])
    done("calibrate", "robot.json", "data.csv", "-o", "fit.json")
    sums = ("calibrate", "robot.json", "data.csv", "--objective", "sum")
    done(*sums, "--effects", "joint_compliance:all", "-o", "effects.json")
    done("diagnose", "robot.json", "data.csv", "-o", "diagnosis.json")
    done("export", "fit.json", "--to", "urdf", "-o", "robot.urdf")
    done("export", "fit.json", "--to", "mjcf", "-o", "arm.xml")
    rows = list(csv.reader(Path("data.csv").read_text().splitlines()))
    bent = np.random.default_rng(1).uniform(0.3, 0.9, (12, 6))  # far from singular poses
    write("targets.csv", [[*rows[0][:6], "note"], *([*map(str, q), "a"] for q in bent)])
    Path("weld.mod").write_text(module(robot, bent[:3]))
    semicolon = "\n".join(";".join(row).replace(".", ",") for row in rows)
    Path("tracker.csv").write_text(semicolon + "\n")
    rng = np.random.default_rng(0)
    posts = rng.uniform(-1.0, 1.0, (4, 3)) * 2000.0
    q = np.array([[float(cell) for cell in row[:6]] for row in rows[1:]])
    at = robot.pose(q)[:, :3, 3] * 1e3
    wires = np.linalg.norm(at[:, None] - posts, axis=-1) + rng.normal(0.0, 0.05, (len(q), 4))
    header = [*rows[0][:6], *(f"wire{i + 1}_mm" for i in range(4))]
    write("wires.csv", [header, *(list(map(str, [*a, *w])) for a, w in zip(q, wires, strict=True))])
    touching(robot, rows[0][:6])
    motions()
    trajectories()
    images()
    sweeps(robot)


def later(row: list[str], shift: float) -> list[str]:
    """A row of the same arm by an instrument that stands elsewhere; the first joint was moved."""
    moved = [f"{float(cell) + shift:.6f}" for cell in row[6:15]]
    return [repr(float(row[0]) + 0.001), *row[1:6], *moved, *row[15:]]


def trajectories() -> None:
    """Torque logs of an arm of two links with masses and friction, its diagnosis and MJCF."""
    links = [
        {"a": 0.5, "alpha": 1.5707963, "mass_kg": 6.0, "com_mm": [-240, 10, 60]},
        {"a": 0.4, "alpha": 0.0, "mass_kg": 3.0, "com_mm": [-180, 0, 20]},
    ]
    for link, inertia in zip(links, (0.2, 0.06), strict=True):
        link |= {"d": 0.1, "theta": 0.0, "inertia": [0.02, 0, 0, inertia, 0, inertia]}
    plain = {"name": "links", "units": {"length": "m", "angle": "rad"}, "joints": links}
    Path("links.json").write_text(json.dumps(plain))
    robot = mc.load_robot("links.json")
    t = np.arange(0.0, 8.0, 0.01)
    rng = np.random.default_rng(4)
    for name in ("run1.csv", "run2.csv"):
        rate = 2.0 * np.pi * rng.uniform(0.1, 0.5, (3, 2))
        phase = rate * t[:, None, None] + rng.uniform(0.0, 6.0, (3, 2))
        size = rng.uniform(0.2, 0.5, (3, 2))
        q, qd = (size * np.sin(phase)).sum(1), (size * rate * np.cos(phase)).sum(1)
        motion = JointMotion(q, qd, -(size * rate**2 * np.sin(phase)).sum(1))
        torque = inverse_dynamics(robot, motion, build_nominal_inertial_parameters(robot))
        torque += np.sign(qd) * [3.0, 1.5] + 2.0 * qd + 0.1 * rng.normal(size=q.shape)
        header = ["t_s", *(f"{kind.format(j)}" for kind in ("q{}_rad", "tau{}_Nm") for j in (1, 2))]
        table = np.column_stack([t, q, torque])
        write(name, [header, *([f"{value:.8g}" for value in row] for row in table)])
    logs = ("run1.csv", "run2.csv")
    done("torques", "links.json", *logs, "--write", "links.xml", "-o", "motion.json")


def images() -> None:
    """Corners of a board, seen by a camera on the flange."""
    cell = simulate_pixel_cell(
        np.random.default_rng(2), target_points=board_corner_points((4, 3), 0.06), pose_count=14
    )
    write_cell_files(cell, Path())


def sweeps(robot: mc.Robot) -> None:
    """One reflector while each joint moves alone, of an arm that nobody has drawn."""
    rng = np.random.default_rng(6)
    q = np.repeat(rng.uniform(-0.5, 0.5, (1, 6)), 6 * 7, axis=0)
    for j in range(6):
        q[7 * j : 7 * (j + 1), j] += np.linspace(-0.5, 0.5, 7)
    pose = robot.pose(q)
    at = 1e3 * (pose[:, :3, 3] + pose[:, :3, :3] @ np.array([0.05, 0.03, 0.08]))
    at += rng.normal(0.0, 0.02, at.shape)
    header = [*(f"q{j + 1}_rad" for j in range(6)), *(f"smr1_{axis}_mm" for axis in "xyz")]
    write("sweeps.csv", [header, *([f"{v:.9g}" for v in row] for row in np.hstack([q, at]))])


def touching(robot: mc.Robot, joints: list[str]) -> None:
    """A file of contacts: a ball of the probe on two plates and a sphere."""
    rng, ball = np.random.default_rng(2), np.array([0.01, 0.02, 0.05])
    rows = []
    for label, kind, radius in (("A", "plane", ""), ("B", "plane", ""), ("C", "sphere", "20")):
        goal = np.array([0.3, 0.1, 0.3]) + rng.uniform(-0.1, 0.1, (60, 3))
        if kind == "plane":
            goal[:, "BA".index(label) * 2] = 0.35
        else:
            off = rng.normal(size=(60, 3))
            goal = 0.3 + 0.025 * off / np.linalg.norm(off, axis=1)[:, None]
        q, gap = reach(robot, ball, goal, rng.uniform(-1.0, 1.0, (60, 6)))
        rows += [[*map(str, one), label, kind, radius, "5"] for one in q[gap < 1e-9][:20]]
    write("contacts.csv", [[*joints, "surface", "kind", "radius_mm", "ball_radius_mm"], *rows])


def motions() -> None:
    """Logs of two motions, in the columns of this project and in those of UR."""
    t = 0.02 * np.arange(150)
    rng = np.random.default_rng(5)
    for name, columns in (
        ("log.csv", ("t_s", "q{}_rad", "qd{}_rad_s", "i{}_A", 1)),
        ("rtde.csv", ("timestamp", "actual_q_{}", "actual_qd_{}", "actual_current_{}", 0)),
    ):
        time, *stems, first = columns
        phase = rng.uniform(0.0, 6.0, 6) + t[:, None]
        current = np.cos(phase) + 0.02 * rng.normal(size=(150, 6))
        header = [time, *(str(stem).format(first + j) for stem in stems for j in range(6))]
        table = np.column_stack([t, np.sin(phase), np.cos(phase), current])
        write(name, [header, *([f"{value:.6g}" for value in row] for row in table)])


def write(name: str, rows: list[list[str]]) -> None:
    """A CSV file."""
    Path(name).write_text("".join(",".join(row) + "\n" for row in rows))


def module(robot: mc.Robot, joints: np.ndarray) -> str:
    """A RAPID module that moves to some joints (m, n) as Cartesian targets."""
    lines = ["MODULE Weld"]
    for number, (place, q) in enumerate(zip(robot.pose(joints), joints, strict=True)):
        x, y, z, w = Rotation.from_matrix(place[:3, :3]).as_quat()
        parts = (1e3 * place[:3, 3], (w, x, y, z), np.floor(q[[0, 3, 5, 0]] / (0.5 * np.pi)))
        told = ",".join(f"[{','.join(f'{v:.9g}' for v in part)}]" for part in parts)
        lines.append(f"  CONST robtarget p{number}:=[{told},[9E9,9E9,9E9,9E9,9E9,9E9]];")
    return "\n".join(
        [*lines, "  PROC main()", "    MoveL p0,v100,fine,tool0;", "  ENDPROC", "ENDMODULE", ""]
    )


def toml(robot: dict[str, object]) -> str:
    """A robot as TOML; tables come last."""
    joints = robot.pop("joints")
    units = robot.pop("units")
    assert isinstance(joints, list)
    assert isinstance(units, dict)
    lines = [f"{key} = {json.dumps(value)}" for key, value in robot.items()]
    lines += ["[units]", *(f"{key} = {json.dumps(value)}" for key, value in units.items())]
    for joint in joints:
        lines += ["[[joints]]", *(f"{key} = {json.dumps(value)}" for key, value in joint.items())]
    return "\n".join(lines) + "\n"
