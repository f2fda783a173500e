"""Frames as people write them, against SciPy; there and back."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from minimax_cal.robots.frames import CONVENTION, Frame, frames_tables
from minimax_cal.robots.transforms import transform

TURNS = Rotation.random(50, random_state=3).as_matrix()
SPECIAL = Rotation.from_euler(
    "ZYX",
    [[0, 0, 0], [180, 0, 0], [0, 0, 180], [10, 90, 0], [-30, -90, 0], [180, 90, 0], [90, 0, -90]],
    degrees=True,
).as_matrix()


@pytest.mark.parametrize("turn", [*TURNS, *SPECIAL])
def test_a_frame_is_what_scipy_says(turn):
    frame = Frame.of(transform(turn, np.array([0.1, -2.0, 3.0])))
    assert_allclose(frame.xyz_mm, [100.0, -2000.0, 3000.0], rtol=1e-15)
    back = Rotation.from_euler("ZYX", frame.abc_deg, degrees=True).as_matrix()
    assert_allclose(back, turn, rtol=0, atol=1e-14)
    assert abs(frame.abc_deg[1]) < 90.0 + 1e-12
    assert_allclose(np.linalg.norm(frame.quaternion_wxyz), 1.0, rtol=1e-15)
    assert frame.quaternion_wxyz[0] >= 0.0
    of_quaternion = Rotation.from_quat(frame.quaternion_wxyz, scalar_first=True).as_matrix()
    assert_allclose(of_quaternion, turn, rtol=0, atol=1e-14)
    of_vector = Rotation.from_rotvec(frame.rotation_vector_rad).as_matrix()
    assert_allclose(of_vector, turn, rtol=0, atol=1e-14)


@pytest.mark.parametrize("turn", TURNS[:20])
def test_angles_are_those_of_scipy(turn):
    expected = Rotation.from_matrix(turn).as_euler("ZYX", degrees=True)
    assert_allclose(Frame.of(transform(turn, np.zeros(3))).abc_deg, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("turn", [*TURNS[:20], *SPECIAL])
def test_there_and_back(turn):
    pose = transform(turn, np.array([0.1, -2.0, 3.0]))
    assert_allclose(Frame.of(pose).pose, pose, rtol=0, atol=1e-14)


def test_a_turns_about_z_b_about_y_c_about_x():
    """Each angle alone, by hand: what KUKA calls A, B, C."""
    quarter = {"A": [[0, -1, 0], [1, 0, 0], [0, 0, 1]], "C": [[1, 0, 0], [0, 0, -1], [0, 1, 0]]}
    for name, turn in quarter.items():
        found = Frame.of(transform(np.array(turn, dtype=float), np.zeros(3))).abc_deg
        assert_allclose(found, np.array([90.0, 0.0, 0.0] if name == "A" else [0.0, 0.0, 90.0]))
    tilt = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], dtype=float)
    assert_allclose(Frame.of(transform(tilt, np.zeros(3))).abc_deg, [0.0, 90.0, 0.0], atol=1e-12)
    assert "Rz(A) Ry(B) Rx(C)" in CONVENTION


def test_tables_hold_every_digit_and_say_the_order():
    frame = Frame.of(transform(TURNS[0], np.array([0.1, -2.0, 3.0])))
    places, turns = frames_tables({"base": frame}, "frames")
    assert places.rows == (("base", *frame.xyz_mm, *frame.abc_deg),)
    assert turns.rows == (("base", *frame.quaternion_wxyz, *frame.rotation_vector_rad),)
    assert CONVENTION in places.title
    assert frame.distance_mm == pytest.approx(np.linalg.norm(frame.xyz_mm), rel=1e-15)
