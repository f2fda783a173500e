"""Several tools in one file, and the payload's centre at each pose."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.measuring.tools import by_tool, side_by_side
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.simulate import simulate
from minimax_cal.robots.gravity import G
from minimax_cal.robots.robot import robot_from_dict

NOISE = 20e-6
APART = np.array([0.03, -0.05, 0.2])  # of the reflectors on one tool and the other [m]
TOOLS = ("gripper", "long probe")


def two_tools(robot: mc.Robot, tmp_path: Path) -> tuple[Path, mc.Measurements]:
    """A file of an arm whose tool was changed, rows of both by turns."""
    made = simulate(robot, 80, 2, seed=4)
    other = replace(made.cell, target_positions=made.cell.target_positions + APART)
    rng = np.random.default_rng(0)
    label = np.array([TOOLS[i] for i in rng.integers(0, 2, 80)])
    q = made.data.q
    y = np.where((label == TOOLS[0])[:, None, None], made.cell.predict(q), other.predict(q))
    y[3, 1] = np.nan
    data = mc.measurements(q, y + NOISE * rng.normal(size=y.shape), tool=label)
    path = tmp_path / "tools.csv"
    mc.write_measurements(path, data)
    return path, data


def test_each_tool_has_reflectors_of_its_own(robot, tmp_path):
    path, _ = two_tools(robot, tmp_path)
    assert "tool" in path.read_text().splitlines()[0].split(",")
    data = mc.read_measurements(path)
    assert set(data.target_names) == {
        f"smr{i}@{tool}" for i in (1, 2) for tool in ("gripper", "long-probe")
    }
    assert not data.notices
    fit = mc.calibrate(robot, data, "sum", holdout=0.25)
    assert fit.accuracy["holdout"].rms_mm < 1.4e3 * NOISE * np.sqrt(3)
    offset = dict(zip(fit.cell.target_names, fit.cell.target_positions, strict=True))
    apart = offset["smr1@long-probe"] - offset["smr1@gripper"]
    assert_allclose(apart, APART, atol=1e-3)  # turned by what the last link is off
    # written and read again it is the same file, and a new file of one tool is predicted
    again = tmp_path / "again.csv"
    mc.write_measurements(again, data)
    assert again.read_text() == path.read_text()
    assert_allclose(by_tool(side_by_side(data)).y, data.y)
    one = tmp_path / "one.csv"
    lines = path.read_text().splitlines()
    kept = [lines[0], *(line for line in lines[1:] if line.endswith("gripper"))]
    one.write_text("\n".join(kept))
    assert mc.read_measurements(one).target_names == ("smr1", "smr2")


def test_a_point_of_a_tool_is_set_aside_by_its_reflector(robot, tmp_path):
    path, _ = two_tools(robot, tmp_path)
    out = tmp_path / "out.csv"
    assert run("import", path, "--leave-out", "12:smr1=knocked", "-o", out, "--quiet") == 0
    data = mc.read_measurements(out)
    (point,) = data.set_aside
    assert point.target.startswith("smr1@")
    assert (point.row, point.why) == (12, "knocked")


def test_a_pose_without_its_tool_is_refused(robot, tmp_path):
    path, _ = two_tools(robot, tmp_path)
    path.write_text(path.read_text().replace("gripper", "", 1))
    with pytest.raises(mc.DataError, match="column tool is empty; name the tool of each pose"):
        mc.read_measurements(path)


def test_torque_of_a_payload_is_that_of_a_mass_at_its_centre():
    robot = robot_from_dict({
        "name": "bar", "units": {"length": "m", "angle": "rad"}, "up": [0, 1, 0],
        "joints": [dict(a=0.5, d=0, theta=0, alpha=0), dict(a=0.4, d=0, theta=0, alpha=0)],
    })  # fmt: skip
    q = np.array([[0.3, 0.4], [1.0, -0.2], [0.0, 0.0]])
    centre = np.array([[0.1, 0.02, 0.0], [0.0, -0.1, 0.3], [np.nan, np.nan, np.nan]])
    mass = np.array([2.0, 5.0, 3.0])
    columns = {f"payload_{a}": centre[:, i] for i, a in enumerate("xyz")}
    data = mc.measurements(q, np.ones((3, 3)) * q.sum(1)[:, None], payload=mass, **columns)
    spot = np.array([[0.05, 0.0, 0.0]])
    cell = Cell(robot, np.eye(4), data.target_names, spot)
    scene: Scene = cell.scene(data)
    at = np.where(np.isfinite(centre), centre, spot)
    pose = robot.pose(q)
    place = np.einsum("mij,mj->mi", pose[:, :3, :3], at) + pose[:, :3, 3]
    elbow = 0.5 * np.stack([np.cos(q[:, 0]), np.sin(q[:, 0])], axis=1)
    expected = -G * mass * np.stack([place[:, 0], place[:, 0] - elbow[:, 0]])
    assert_allclose(scene.payload, expected, rtol=0, atol=1e-9)
    assert_allclose(scene.payload_place.T, place, rtol=0, atol=1e-12)


def test_a_centre_without_its_mass_is_told(tmp_path, robot):
    path = tmp_path / "data.csv"
    data = simulate(robot, 20, 1, seed=1).data
    columns = {**data.columns, **{f"payload_{a}": np.full(20, 0.1) for a in "xyz"}}
    mc.write_measurements(path, replace(data, columns=columns))
    assert "payload_x_mm" in path.read_text()
    notices = mc.read_measurements(path).notices
    assert any("payload_x_mm is not used: the file has no column payload_kg" in n for n in notices)


def test_compliance_counts_where_the_payload_hangs(robot):
    """A heavy load that hangs now here, now there: told where, the fit reaches the noise."""
    made = simulate(robot, 90, 3, seed=8)
    rng = np.random.default_rng(1)
    mass = rng.choice([0.0, 40.0], 90)
    centre = rng.uniform(-0.4, 0.4, (90, 3))
    columns = {f"payload_{a}": centre[:, i] for i, a in enumerate("xyz")}
    whole = mc.measurements(made.data.q, made.data.y, payload=mass, **columns)
    scene = made.cell.scene(whole)
    bend = 2e-6 * scene.gravity.T * robot.sign * [0, 1, 1, 1, 1, 0]
    y = made.cell.predict(made.data.q + bend) + NOISE * rng.normal(size=made.data.y.shape)
    effects = [f"joint_compliance:J{i}" for i in range(2, 6)]
    told = mc.calibrate(robot, whole.with_y(y), "sum", effects=effects, holdout=0.2)
    plain = mc.measurements(made.data.q, y, payload=mass)
    untold = mc.calibrate(robot, plain, "sum", effects=effects, holdout=0.2)
    assert told.accuracy["holdout"].rms_mm < 1.5e3 * NOISE * np.sqrt(3)
    assert untold.accuracy["holdout"].rms_mm > 1.5 * told.accuracy["holdout"].rms_mm
