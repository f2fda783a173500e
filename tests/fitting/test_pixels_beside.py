"""Pixels beside a tracker in one fit: never worse than either, each by its own noise."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from experiments.pixel_cells import (
    NOISE,
    Cell,
    arm_error,
    board_points,
    data_of,
    make_cell,
    write_cell,
)
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.fitting.several.cameras import as_instrument, detected
from minimax_cal.fitting.several.options import RelativeOptions
from minimax_cal.fitting.several.pixel_calibration import fitted
from minimax_cal.fitting.several.stack import Block, own_state
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots.kinematics import rotation
from minimax_cal.robots.sampling import random_joints
from minimax_cal.solvers.status import Status

SPOTS = np.array([[0.1, 0.0, 0.03], [-0.05, 0.08, 0.03], [-0.05, -0.08, 0.05]])  # [m]


def cell_of(seed: int, **more: object) -> Cell:
    """A small cell, the camera on the flange or the ground by turns."""
    given = {"points": board_points((6, 5), 0.04), "poses": 20, "on_flange": bool(seed % 2)}
    return make_cell(np.random.default_rng(seed), **given | more)  # type: ignore[arg-type]


def tracked(
    cell: Cell, seed: int, poses: int, noise: float, wrist: Array | None = None
) -> Measurements:
    """What a tracker measures of the same arm at other poses.

    noise: of a coordinate [m].  wrist: (3,) joints 4 to 6, where they stay [rad].
    """
    rng = np.random.default_rng([seed, 9])
    q = random_joints(cell.true, (poses,), rng)
    q[:, 3:] = q[:, 3:] if wrist is None else wrist
    pose = cell.true.pose(q)
    point = np.einsum("mij,kj->mki", pose[:, :3, :3], SPOTS) + pose[:, None, :3, 3]
    point = point @ rotation(np.array([0.1, 0.0, 0.7])).T + [2.0, 1.0, 0.3]
    return mc.measurements(q, point + noise * rng.normal(size=point.shape))


@pytest.mark.parametrize(("poses", "noise"), [(16, 3e-5), (24, 1e-4)])
@pytest.mark.filterwarnings("ignore:too few poses")
def test_both_are_never_worse_than_either(poses: int, noise: float) -> None:
    errors = []
    for seed in range(4):
        cell = cell_of(seed)
        data, images = tracked(cell, seed, poses, noise), data_of(cell)
        both = mc.relative(cell.drawn, [data, as_instrument(images)], holdout=0.0)
        assert both.status is Status.CONVERGED
        alone = mc.calibrate(cell.drawn, data, "sum", holdout=0.0)
        pixels = fitted(cell.drawn, images, PixelOptions(holdout=0.0))
        arms = (both.robot, alone.robot, pixels.calibrated or pixels.robot)
        errors.append([arm_error(cell, arm) for arm in arms])
        tracker, camera = both.instruments
        assert_allclose(tracker.noise, noise, rtol=0.25)
        metre = np.median(both_depths(cell)) / 2500.0
        assert_allclose(camera.noise, NOISE * metre, rtol=0.3)
    together, *either = np.sqrt(np.mean(np.square(errors), axis=0))
    assert together < 0.95 * min(either)


def both_depths(cell: Cell) -> Array:
    """Depths of the board in the images [m]."""
    flange = cell.true.pose(cell.q)
    view = cell.views[0].pose
    if cell.on_flange:
        return np.asarray((np.linalg.inv(flange @ view) @ cell.place)[:, 2, 3])
    return np.asarray((np.linalg.inv(view) @ flange @ cell.place)[:, 2, 3])


@pytest.mark.parametrize("board", [True, False], ids=["board", "tags"])
def test_rows_are_the_derivatives(board: bool) -> None:
    cell = cell_of(1, points=board_points((3, 2), 0.08), poses=12)
    data = data_of(cell, board=board)
    images = as_instrument(data).ready(cell.drawn, RelativeOptions(camera_on="flange"))
    block = Block.of(cell.drawn, images)
    rng = np.random.default_rng(0)
    own = images.starts(block.arm.at(cell.drawn.mdh), np.ones(0, dtype=bool))[0]
    own = own + 1e-2 * rng.normal(size=own.size)
    active = np.ones(len(images.model.names.all), dtype=bool)
    active[5 * cell.drawn.joints : images.model.names.geometric] = False
    mdh = cell.drawn.mdh + 1e-3 * rng.normal(size=cell.drawn.mdh.shape)
    _, slope = block.rows(own_state(mdh, own), active)
    assert slope.shape == (active.sum(), len(block.read(own_state(mdh, own)).weights))
    step, count = 1e-6, 5 * cell.drawn.joints
    for i, which in enumerate(np.flatnonzero(active)):
        move = np.zeros(len(active))
        move[which] = step
        ends = []
        for sign in (1.0, -1.0):
            links = mdh + sign * move[:count].reshape(5, -1).T
            state = own_state(links, own + sign * move[images.model.names.geometric :])
            ends.append(block.rows(state, active)[0])
        size = max(float(np.abs(slope[i]).max()), 1e-9)
        found = (ends[1] - ends[0]) / (2.0 * step)
        assert_allclose(slope[i] / size, found / size, rtol=0, atol=1e-4)


def test_what_only_the_camera_determines_is_said() -> None:
    """The tracker sees an arm whose wrist stays: joints 4 to 6 are told by the camera alone."""
    cell = cell_of(1)
    data = tracked(cell, 1, 30, 3e-5, wrist=np.array([0.3, -0.8, 0.5]))
    both = mc.relative(cell.drawn, [as_instrument(data_of(cell)), data])
    assert [one.kind for one in both.instruments] == ["points", "pixels"]
    tracker, camera = both.instruments
    assert not tracker.directions_alone
    assert camera.directions_alone
    assert {name[-1] for name in camera.alone} >= {"4", "5"}
    assert not any(name.endswith("1") for name in camera.alone)
    assert camera.accuracy["holdout"].rms_mm < 0.1
    assert "camera_matrix" in camera.instrument["cameras"]["cam0"]
    units = {p.name.rpartition("_")[2]: p.unit for p in both.parameters if "camera" in p.name}
    assert (units["fx"], units["x"], units["rx"], units["k1"]) == ("px", "m", "rad", "")


def test_wrong_pixels_do_not_count() -> None:
    cell, rng = cell_of(2), np.random.default_rng(1)
    data = data_of(cell)
    wrong = rng.random(data.count) < 0.03
    pixel = data.pixel + np.where(wrong[:, None], 5.0 + rng.exponential(30.0, data.pixel.shape), 0)
    given = [tracked(cell, 2, 24, 3e-5), as_instrument(replace(data, pixel=pixel))]
    both = mc.relative(cell.drawn, given)
    assert arm_error(cell, both.robot) < 0.02
    assert both.instruments[1].accuracy["train"].max_mm < 0.5


def test_lenses_that_are_held_stay() -> None:
    cell = cell_of(2)
    given = [tracked(cell, 2, 24, 3e-5), as_instrument(data_of(cell))]
    both = mc.relative(cell.drawn, given, fix_camera=True)
    lens = [p for p in both.parameters if p.name.endswith(("fx", "k1"))]
    assert len(lens) == 2
    assert not any(p.identifiable for p in lens)
    assert lens[0].value == lens[0].nominal == 2500.0


def test_pixels_alone_have_a_command_of_their_own() -> None:
    cell = cell_of(2)
    with pytest.raises(mc.DataError, match="pixels alone: give it to calibrate"):
        mc.relative(cell.drawn, [as_instrument(data_of(cell))])


def test_from_files_to_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cell = cell_of(1)
    files, points, result = (
        write_cell(cell, tmp_path),
        tmp_path / "tracker.csv",
        tmp_path / "r.json",
    )
    mc.write_measurements(points, tracked(cell, 1, 24, 3e-5))
    assert run("relative", "ur5", points, *files, "--json", "-o", result) == 0
    content = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in content["instruments"]] == ["tracker", "detections"]
    assert [one["kind"] for one in content["instruments"]] == ["points", "pixels"]
    assert {"alone", "directions_alone", "file", "noise", "unit"} <= set(content["instruments"][1])
    assert arm_error(cell, mc.load_robot(result)) < 0.03
    assert run("report", result, "-o", tmp_path / "report.html") == 0
    cameras = {"cam0": tmp_path / "cam0.yaml"}
    images = detected(
        tmp_path / "detections.csv", tmp_path / "joints.csv", cameras, tmp_path / "board.csv"
    )
    again = mc.relative("ur5", [points, images], camera_on="flange")
    assert_allclose(again.robot.mdh, mc.load_robot(result).mdh, rtol=0, atol=1e-9)
    assert run("relative", "ur5", points, *files[:2]) == 2
    assert "cameras need all three" in capsys.readouterr().err
