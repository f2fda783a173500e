"""Pixels beside a tracker in one fit: never worse than either, each by its own noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from experiments.pixel_cells import (
    PIXEL_NOISE,
    PixelCell,
    SimulatedCamera,
    board_corner_points,
    build_pixel_data,
    format_camera_yaml,
    rms_arm_error_mm,
    simulate_pixel_cell,
    write_cell_files,
)
from minimax_cal.core.arrays import Array
from minimax_cal.fitting.pixels.calibrate import calibrate_pixel_data
from minimax_cal.fitting.pixels.image_instrument import as_image_instrument, read_detections
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.instruments.camera_model import read_camera_file
from minimax_cal.instruments.pixel_data import PixelData, read_pixel_data
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots import kinematics
from minimax_cal.robots.gravity_torques import joint_gravity_torques, link_masses_and_centres
from minimax_cal.robots.joint_sampling import random_joint_values
from minimax_cal.robots.kinematics import rotation_from_vector
from minimax_cal.solvers.status import Status

# ---- pixels beside -------------------------------------------------------------------------------


SPOTS = np.array([[0.1, 0.0, 0.03], [-0.05, 0.08, 0.03], [-0.05, -0.08, 0.05]])  # [m]


def cell_of(seed: int, **more: object) -> PixelCell:
    """A small cell, the camera on the flange or the ground by turns."""
    given = {
        "target_points": board_corner_points((6, 5), 0.04),
        "pose_count": 20,
        "on_flange": bool(seed % 2),
    }
    return simulate_pixel_cell(np.random.default_rng(seed), **given | more)


def tracked(
    cell: PixelCell, seed: int, poses: int, noise: float, wrist: Array | None = None
) -> Measurements:
    """What a tracker measures of the same arm at other poses.

    noise: of a coordinate [m].  wrist: (3,) joints 4 to 6, where they stay [rad].
    """
    rng = np.random.default_rng([seed, 9])
    q = random_joint_values(cell.true, (poses,), rng)
    q[:, 3:] = q[:, 3:] if wrist is None else wrist
    pose = cell.true.pose(cell.law(q))
    point = np.einsum("mij,kj->mki", pose[:, :3, :3], SPOTS) + pose[:, None, :3, 3]
    point = point @ rotation_from_vector(np.array([0.1, 0.0, 0.7])).T + [2.0, 1.0, 0.3]
    return mc.measurements(q, point + noise * rng.normal(size=point.shape))


@pytest.mark.parametrize(("poses", "noise"), [(16, 3e-5), (24, 1e-4)])
@pytest.mark.filterwarnings("ignore:too few poses")
def test_both_are_never_worse_than_either(poses, noise):
    errors = []
    for seed in range(4):
        cell = cell_of(seed)
        data, images = tracked(cell, seed, poses, noise), build_pixel_data(cell)
        both = mc.relative(cell.drawn, [data, as_image_instrument(images)], holdout=0.0)
        assert both.status is Status.CONVERGED
        alone = mc.calibrate(cell.drawn, data, "sum", holdout=0.0)
        pixels = calibrate_pixel_data(cell.drawn, images, PixelOptions(holdout=0.0))
        arms = (both.robot, alone.robot, pixels.calibrated or pixels.robot)
        errors.append([rms_arm_error_mm(cell, arm) for arm in arms])
        tracker, camera = both.instruments
        assert_allclose(tracker.noise, noise, rtol=0.25)
        metre = np.median(both_depths(cell)) / 2500.0
        assert_allclose(camera.noise, PIXEL_NOISE * metre, rtol=0.3)
    together, *either = np.sqrt(np.mean(np.square(errors), axis=0))
    assert together < 0.95 * min(either)


def both_depths(cell: PixelCell) -> Array:
    """Depths of the board in the images [m]."""
    flange = cell.true.pose(cell.q)
    view = cell.views[0].pose
    if cell.on_flange:
        return np.asarray((np.linalg.inv(flange @ view) @ cell.place)[:, 2, 3])
    return np.asarray((np.linalg.inv(view) @ flange @ cell.place)[:, 2, 3])


def test_what_only_the_camera_determines_is_said():
    """The tracker sees an arm whose wrist stays: joints 4 to 6 are told by the camera alone."""
    cell = cell_of(1)
    data = tracked(cell, 1, 30, 3e-5, wrist=np.array([0.3, -0.8, 0.5]))
    both = mc.relative(cell.drawn, [as_image_instrument(build_pixel_data(cell)), data])
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


def test_wrong_pixels_do_not_count():
    cell, rng = cell_of(2), np.random.default_rng(1)
    data = build_pixel_data(cell)
    wrong = rng.random(data.pixel_count) < 0.03
    pixel = data.pixel + np.where(wrong[:, None], 5.0 + rng.exponential(30.0, data.pixel.shape), 0)
    given = [tracked(cell, 2, 24, 3e-5), as_image_instrument(replace(data, pixel=pixel))]
    both = mc.relative(cell.drawn, given)
    assert rms_arm_error_mm(cell, both.robot) < 0.02
    assert both.instruments[1].accuracy["train"].max_mm < 0.5


def test_images_of_other_poses_are_named_and_judge_nothing():
    cell = cell_of(2)
    data = build_pixel_data(cell)
    late = data.at.columns | {"split": np.array(["holdout"] * 4 + ["train"] * 16)}
    q = data.at.q.copy()
    q[[0, 9]] += 0.2  # one that is held out, and one that is not
    data = replace(data, at=replace(data.at, q=q, columns=late))
    both = mc.relative(cell.drawn, [tracked(cell, 2, 24, 3e-5), as_image_instrument(data)])
    named = "whole images are outliers, set aside: pose P9 of camera cam0"
    assert any(named in said for said in both.notices)
    assert rms_arm_error_mm(cell, both.robot) < 0.02
    alone = calibrate_pixel_data(cell.drawn, data, PixelOptions())
    assert any("2 whole images" in said and "pose P0" in said for said in alone.notices)
    assert alone.pixels["holdout"][0] < 3.0 * PIXEL_NOISE
    assert alone.with_them is not None
    assert alone.with_them.rms_mm > 5.0


def test_the_worst_of_pixels_is_a_target_of_a_camera():
    cell = cell_of(2)
    given = [tracked(cell, 2, 24, 3e-5), as_image_instrument(build_pixel_data(cell))]
    both = mc.relative(cell.drawn, given, objective="minimax")
    assert both.worst is not None
    assert {"pixels c0", "pixels c29"} < {*both.worst.functions}
    with pytest.raises(mc.OptionError, match="camera_on='roof': give flange or ground"):
        mc.relative(cell.drawn, given, camera_on="roof")
    with pytest.raises(mc.DataError, match="pixels alone: give it to calibrate"):
        mc.relative(cell.drawn, given[1:])


@pytest.mark.parametrize("board", [True, False], ids=["board", "tags"])
def test_lenses_that_are_held_stay(board):
    cell = cell_of(2)
    data = build_pixel_data(cell, with_board=board)
    data = data.take_pixels((data.pose > 0) | (data.target < 5))  # one image shows little
    given = [tracked(cell, 2, 24, 3e-5), as_image_instrument(data)]
    both = mc.relative(cell.drawn, given, fix_camera=True)
    lens = [p for p in both.parameters if p.name.endswith(("fx", "k1"))]
    assert len(lens) == 2
    assert not any(p.identifiable for p in lens)
    assert lens[0].value == lens[0].nominal == 2500.0


# ---- effects of the arm --------------------------------------------------------------------------


SPRING, SPRUNG = 3e-5, "joint_compliance:J2"  # [rad/(N m)]


def spring(q: Array) -> Array:
    """Where the joints truly are of an arm whose second one winds up under gravity."""
    robot = mc.load_robot("ur5")
    links = kinematics.compute_link_frames(robot.mdh, robot.chain_joint_values(q), robot.prismatic)
    return np.asarray(
        q
        + SPRING
        * np.eye(6)[1]
        * joint_gravity_torques(links, *link_masses_and_centres(robot), robot.up).T
    )


@pytest.mark.parametrize("on_flange", [True, False], ids=["eye in hand", "eye to hand, a tracker"])
def test_an_effect_of_the_arm_is_found_by_cameras(on_flange):
    """Its sigmas hold the spring, whatever masses it bears, and the claim the arm's error."""
    points = board_corner_points((4, 3), 0.08)
    cell = cell_of(
        1, on_flange=on_flange, true_joint_law=spring, pose_count=40, target_points=points
    )
    images = as_image_instrument(build_pixel_data(cell))
    gap = mc.diagnose_relative(
        cell.drawn, images if on_flange else [tracked(cell, 1, 30, 3e-5), images]
    )
    assert gap.verdict == "named"
    assert [(one.term.label, one.established) for one in gap.effects] == [(SPRUNG, True)]
    fit = gap.calibration
    found = [p for p in fit.parameters if p.is_of_effect]
    assert max(abs(p.value - SPRING) / p.sigma for p in found) < 3.5
    assert fit.accuracy["holdout"].rms_mm < 0.1 * gap.steps[1].holdout.rms_mm
    assert not fit.positions_open
    assert fit.cell is not None
    straight = replace(cell, law=np.asarray)  # its joints where they are told to be
    assert rms_arm_error_mm(straight, fit.cell.robot) < 2.5e3 * fit.position_sigma
    again = mc.relative(cell.drawn, images, effects=SPRUNG)
    assert again.instruments[0].kind == "pixels"
    assert {p.name.partition(".")[0] for p in again.parameters if p.is_of_effect} == {SPRUNG}


def test_from_files_to_a_report(tmp_path, answered, refuses):
    cell = cell_of(1)
    files, points, result = (
        write_cell_files(cell, tmp_path),
        tmp_path / "t.csv",
        tmp_path / "r.json",
    )
    mc.write_measurements(points, tracked(cell, 1, 24, 3e-5))
    content = answered("relative ur5", points, *files, "-o", result)
    assert [one["name"] for one in content["instruments"]] == ["t", "detections"]
    assert [one["kind"] for one in content["instruments"]] == ["points", "pixels"]
    assert {"alone", "directions_alone", "file", "noise", "unit"} <= set(content["instruments"][1])
    assert rms_arm_error_mm(cell, mc.load_robot(result)) < 0.03
    assert run("report", result, "-o", tmp_path / "report.html") == 0
    assert repr(mc.load_fit(result)) == "<RelativeCalibration of Universal Robots UR5: converged>"
    cameras = {"cam0": tmp_path / "cam0.yaml"}
    images = read_detections(
        tmp_path / "detections.csv", tmp_path / "joints.csv", cameras, tmp_path / "board.csv"
    )
    again = mc.relative("ur5", [points, images], camera_on="flange")
    assert_allclose(again.robot.mdh, mc.load_robot(result).mdh, rtol=0, atol=1e-9)
    refuses("cameras need all three", "relative ur5", points, *files[:2])


# ---- pixel files ---------------------------------------------------------------------------------


K, D = (2500.0, 2510.0, 1223.5, 1023.5), (-0.12, 0.08, 2e-4, -3e-4, 1e-05)
OPENCV = format_camera_yaml(SimulatedCamera(np.eye(4), K, D))
MATRIX = "[2500.0, 0.0, 1223.5, 0.0, 2510.0, 1023.5, 0.0, 0.0, 1.0]"
ROS = f"""image_width: 2448
image_height: 2048
camera_name: left
camera_matrix: {{rows: 3, cols: 3, data: {MATRIX}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [-0.12, 0.08, 2.0e-4, -0.0003, 1e-05]}}
"""
VECTOR = f"""%YAML 1.2
---
image_width: 2448
image_height: 2048
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: {MATRIX}
distortion_coefficients: !!opencv-nd-matrix
   sizes: [ 5 ]
   dt: d
   data: [ -0.12, 0.08,
       0.0002, -0.0003, 1e-05 ]
"""  # OpenCV 5, of a distortion that is no matrix
MESSAGE = f"""height: 2048
width: 2448
distortion_model: plumb_bob
d: [-0.12, 0.08, 0.0002, -0.0003, 1.0e-05]
k: {MATRIX}
"""
SHORT = "K: [[2500, 0, 1223.5], [0, 2510, 1023.5], [0, 0, 1]]\nD: [-0.12, 0.08, 0.0002, -0.0003]\n"
JOINTS = ["pose,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad"]
JOINTS += [f"P{i},0.1,{i / 10},0.3,0.4,0.5,0.6" for i in range(6)]
ROWS = ["pose,camera,target,u_px,v_px"]
ROWS += [f"P{i},left,t{j},{100 + i + 50 * j},{200 + j}" for i in range(6) for j in range(4)]
BOARD = ["target,x_mm,y_mm,z_mm", "t0,0,0,0", "t1,50,0,0", "t2,0,50,0", "t3,50,50,0"]


def folder_of(
    path: Path, rows: list[str] = ROWS, joints: list[str] = JOINTS, board: list[str] = BOARD
) -> Path:
    """The files of a cell in a folder."""
    (path / "detections.csv").write_text("\n".join(rows) + "\n")
    (path / "joints.csv").write_text("\n".join(joints) + "\n")
    (path / "board.csv").write_text("\n".join(board) + "\n")
    (path / "left.yaml").write_text(ROS)
    return path


def read(path: Path, names: tuple[str, ...] = ("left",), board: bool = True) -> PixelData:
    cameras = [read_camera_file(name, path / "left.yaml") for name in names]
    return read_pixel_data(
        path / "detections.csv", path / "joints.csv", cameras, path / "board.csv" if board else None
    )


def test_files_of_a_cell_in_german(tmp_path):
    german = {
        "rows": ["Pose;Kamera;Ziel;u [px];v [px]", *ROWS[1:]],
        "joints": ["Pose;" + ";".join(f"Achse {i} [rad]" for i in range(1, 7)), *JOINTS[1:]],
        "board": ["Ziel;X [mm];Y [mm];Z [mm]", *BOARD[1:]],
    }
    told = {k: [row.replace(",", ";").replace(".", ",") for row in v] for k, v in german.items()}
    data = read(folder_of(tmp_path, **told))
    assert data.pixel[1].tolist() == [150.0, 201.0]
    assert data.at.q[3].tolist() == [0.1, 0.3, 0.3, 0.4, 0.5, 0.6]
    assert data.board[1].tolist() == [0.05, 0.0, 0.0]


@pytest.mark.parametrize(
    ("text", "count", "size"),
    [*((text, 12, (2448, 2048)) for text in (OPENCV, VECTOR, ROS, MESSAGE)), (SHORT, 4, (0, 0))],
    ids=["OpenCV", "vector", "ROS", "message", "short"],
)
def test_cameras_of_opencv_and_ros_are_one(text, count, size, tmp_path):
    (tmp_path / "camera.yaml").write_text(text)
    camera = read_camera_file("left", tmp_path / "camera.yaml")
    known = 4 + min(count, len(D))
    assert camera.intrinsic.tolist() == [*K, *D, *np.zeros(7)][:known] + [0.0] * (16 - known)
    assert camera.size == size


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<opencv_storage/>", "is XML"),
        ("- 1\n", "holds no camera"),
        ("D: [0, 0, 0, 0]\n", "camera_matrix is missing"),
        (f"K: {MATRIX}\n", "distortion_coefficients is missing; give zeros"),
        (f"K: {MATRIX}\nD: [0, 0, 0]\n", "has 3 numbers; OpenCV has 4, 5, 8 or 12"),
        (f"K: {MATRIX}\nD: [0, 0, x, 0]\n", "D|d is no matrix of numbers"),
        ("K: [1, 2, 3]\nD: [0, 0, 0, 0]\n", "has 3 numbers, not 9"),
        (f"K: {MATRIX}\nD: [0, 0, .nan, 0]\n", "not finite"),
        ("K: [2500, 0, 0, 0, 2500, 0, 1200, 1000, 1]\nD: [0, 0, 0, 0]\n", "is it row by row"),
        ("K: [0.9, 0, 0.5, 0, 0.9, 0.5, 0, 0, 1]\nD: [0, 0, 0, 0]\n", "must be pixels"),
        (f"K: {MATRIX}\nD: [0, 0, 0, 0]\ndistortion_model: equidistant\n", "'equidistant' is not"),
        (f"K: {MATRIX}\nD: [{', '.join(['0'] * 12)}, 0.1, 0]\n", "tilts the sensor"),
        (f"K: {MATRIX}\nD: [0, 0, 0, 0]\nimage_width: wide\n", "is no number of pixels"),
        ("K: [1\n", "cannot be parsed"),
    ],
)
def test_a_file_that_is_no_camera_is_refused(text, said, tmp_path):
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(mc.DataError, match=said) as error:
        read_camera_file("left", tmp_path / "camera.yaml")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (ROWS[:1], "holds a header but no rows"),
        (["pose,camera,target,u,v_px", *ROWS[1:]], r"detections.csv:1: column u_px is missing"),
        ([*ROWS, "P1,right,t0,1,2"], r":26: camera 'right' has no file"),
        ([*ROWS, "P9,left,t0,1,2"], r":26: pose 'P9' has no joint values in .*joints.csv"),
        ([*ROWS, "P1,left,t9,1,2"], r":26: target 't9' has no place in .*board.csv"),
        ([*ROWS, "P1,left,t0,1,2"], r":26: target 't0' of pose 'P1' stands on line 6 too"),
        ([*ROWS[:-1], "P5,left,t3,nan,2"], r":25: column u_px: nan is not a finite number"),
        ([*ROWS[:-1], "P5,left,t3,,2"], r":25: column u_px: is empty"),
        ([*ROWS[:-1], "P5,left,t3,2500,2"], r":25: \(2500, 2\) px is outside the image of camera"),
        (ROWS[:9], r"camera 'left' has 2 images with detections; take at least 4"),
        ([ROWS[0].replace("u_px", "uu"), *ROWS[1:]], r"column u_px is missing; .* u_px, v_px$"),
        ([ROWS[0].replace("u_px", "u_pix"), *ROWS[1:]], r"u_px, v_px; rename 'u_pix'\?$"),
    ],
)
def test_wrong_detections_are_refused(rows, said, tmp_path):
    with pytest.raises(mc.DataError, match=said) as error:
        read(folder_of(tmp_path, rows))
    assert "\n" not in str(error.value)


def test_wrong_joints_cameras_and_boards_are_refused(tmp_path):
    for joints, said in (
        ([*JOINTS, JOINTS[1]], r"joints.csv:8: pose 'P0' stands on line 2 too"),
        ([*JOINTS, JOINTS[1].replace("P0", "")], r"joints.csv:8: column pose is empty"),
        ([line.partition(",")[2] for line in JOINTS], "column pose is missing"),
    ):
        with pytest.raises(mc.DataError, match=said):
            read(folder_of(tmp_path, joints=joints))
    for board, said in (
        ([*BOARD, "t1,9,9,9"], r"board.csv:6: target 't1' stands twice"),
        ([*BOARD, "t4,50,50,0"], r"board.csv:6: target 't4' is where 't3' is"),
        (BOARD[:3], "has 2 targets"),
        ([*BOARD[:3], "t2,99,0,0", "t3,20,0,0"], "lie on one line"),
    ):
        with pytest.raises(mc.DataError, match=said):
            read(folder_of(tmp_path, board=board))
    with pytest.raises(mc.DataError, match="camera 'right' sees nothing"):
        read(folder_of(tmp_path), ("left", "right"))


def test_tags_seen_once_are_left_out(tmp_path):
    data = read(folder_of(tmp_path, [*ROWS, "P1,left,t9,1,2"]), board=False)
    assert data.targets == ("t0", "t1", "t2", "t3")
    assert any("seen once only and left out: t9" in notice for notice in data.notices)
    same = read(folder_of(tmp_path), board=False)
    assert (same.targets, same.notices) == (data.targets, ())
