"""Files of cameras, detections and boards: what is read, and one line for what is wrong."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from experiments.pixel_cells import View, camera_text
from minimax_cal.fitting.pixels.camera import read_camera
from minimax_cal.fitting.pixels.data import read_pixels

K, D = (2500.0, 2510.0, 1223.5, 1023.5), (-0.12, 0.08, 2e-4, -3e-4, 1e-05)
OPENCV = camera_text(View(np.eye(4), K, D))
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


def read(path: Path, names: tuple[str, ...] = ("left",), board: bool = True) -> None:
    cameras = [read_camera(name, path / "left.yaml") for name in names]
    read_pixels(
        path / "detections.csv", path / "joints.csv", cameras, path / "board.csv" if board else None
    )


def test_files_of_a_cell_in_german(tmp_path: Path) -> None:
    german = {
        "rows": ["Pose;Kamera;Ziel;u [px];v [px]", *ROWS[1:]],
        "joints": ["Pose;" + ";".join(f"Achse {i} [rad]" for i in range(1, 7)), *JOINTS[1:]],
        "board": ["Ziel;X [mm];Y [mm];Z [mm]", *BOARD[1:]],
    }
    there = folder_of(
        tmp_path, **{k: [row.replace(",", ";").replace(".", ",") for row in v]
                     for k, v in german.items()}
    )  # fmt: skip
    camera = read_camera("left", there / "left.yaml")
    data = read_pixels(
        there / "detections.csv", there / "joints.csv", [camera], there / "board.csv"
    )
    assert data.pixel[1].tolist() == [150.0, 201.0]
    assert data.at.q[3].tolist() == [0.1, 0.3, 0.3, 0.4, 0.5, 0.6]
    assert data.board[1].tolist() == [0.05, 0.0, 0.0]


@pytest.mark.parametrize(
    "text", [OPENCV, VECTOR, ROS, MESSAGE], ids=["OpenCV", "vector", "ROS", "message"]
)
def test_cameras_of_opencv_and_ros_are_one(text: str, tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(text)
    camera = read_camera("left", tmp_path / "camera.yaml")
    assert_allclose(camera.intrinsic, [*K, *D, *np.zeros(7)], rtol=0, atol=0)
    assert camera.size == (2448, 2048)


def test_a_short_file_is_a_camera(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(SHORT)
    camera = read_camera("left", tmp_path / "camera.yaml")
    assert_allclose(camera.intrinsic[:8], [*K, *D[:4]], rtol=0, atol=0)
    assert camera.size == (0, 0)


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
def test_a_file_that_is_no_camera_is_refused(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(mc.DataError, match=said) as error:
        read_camera("left", tmp_path / "camera.yaml")
    assert "\n" not in str(error.value)


def test_files_are_read(tmp_path: Path) -> None:
    read(folder_of(tmp_path))
    read(folder_of(tmp_path), board=False)


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
    ],
)
def test_wrong_detections_are_refused(rows: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(mc.DataError, match=said) as error:
        read(folder_of(tmp_path, rows))
    assert "\n" not in str(error.value)


def test_wrong_joints_cameras_and_boards_are_refused(tmp_path: Path) -> None:
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


def test_tags_seen_once_are_left_out(tmp_path: Path) -> None:
    path = folder_of(tmp_path, [*ROWS, "P1,left,t9,1,2"])
    cameras = [read_camera("left", path / "left.yaml")]
    data = read_pixels(path / "detections.csv", path / "joints.csv", cameras)
    assert data.targets == ("t0", "t1", "t2", "t3")
    assert any("seen once only and left out: t9" in notice for notice in data.notices)
