"""Excitations: within limits, at rest at their ends, and what they tell is what a fit finds."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.dynamics.regressor import regressor
from minimax_cal.planning import motion_plan as module
from minimax_cal.planning.fourier_motion import FourierMotion, project_to_rest_at_ends
from minimax_cal.robots.kinematics import compute_link_frames
from minimax_cal.robots.robot import robot_from_dict

ARM = "irb120"
SPEED, ACCELERATION = np.radians(60.0), np.radians(120.0)
BETWEEN = 1.01  # how far a series may pass a limit between the rows that were looked at
BOX = ((-0.6, -0.7, 0.05), (0.9, 0.7, 1.1))


@pytest.fixture(scope="module")
def loaded() -> module.MotionPlan:
    return mc.plan_motion(ARM, duration=10.0, payload=2.0, volume=BOX)


@pytest.fixture(scope="module")
def short() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "MOTION_IMPROVEMENT_STEPS", 5)
        yield


def test_a_series_is_its_own_derivative_and_rests_at_its_ends():
    rng = np.random.default_rng(1)
    series = FourierMotion(
        rng.normal(size=3), *project_to_rest_at_ends(*rng.normal(size=(2, 5, 3))), 7.0
    )
    t = np.linspace(0.0, 7.0, 701)
    moved = series.evaluate(t)
    assert_allclose(moved.qd[[0, -1]], 0.0, atol=1e-12)
    assert_allclose(moved.qdd[[0, -1]], 0.0, atol=1e-11)
    step = 1e-5
    ahead, back = series.evaluate(t + step), series.evaluate(t - step)
    assert_allclose((ahead.q - back.q) / (2.0 * step), moved.qd, atol=1e-7)
    assert_allclose((ahead.qd - back.qd) / (2.0 * step), moved.qdd, atol=1e-6)


def test_the_motion_stays_within_its_limits(loaded):
    robot = mc.load_robot(ARM)
    assert [part.name for part in loaded.parts] == ["fast", "slow", "loaded"]
    for part in loaded.parts:
        moved = part.motion.evaluate(part.motion.sample_times(200.0))
        assert (moved.q > robot.lower + np.radians(1.9)).all()
        assert (moved.q < robot.upper - np.radians(1.9)).all()
        assert np.abs(moved.qd).max() < BETWEEN * SPEED
        assert np.abs(moved.qdd).max() < BETWEEN * ACCELERATION
        points = compute_link_frames(robot.mdh, moved.q * robot.sign, robot.prismatic).after
        moving = np.ptp(points, axis=-1).max(axis=-1) > 1e-3
        low, high = np.array(BOX)[:, :, None]
        assert (points[moving] > low - 5e-3).all()
        assert (points[moving] < high + 5e-3).all()
    slow = loaded.parts[1].motion
    peaks = np.abs(slow.evaluate(slow.sample_times(200.0)).qd).max(axis=0)
    assert (peaks < BETWEEN * 0.2).all()
    assert np.median(peaks) > 0.1


def test_a_payload_tells_drive_gains(loaded, short):
    alone = mc.plan_motion(ARM, duration=10.0)
    assert any("without a known payload" in text for text in alone.notices)
    gains = [t.sigma for t in alone.told if t.parameter == "drive gain"]
    assert np.isinf(gains).all()
    gains = [t.sigma for t in loaded.told if t.parameter == "drive gain"]
    assert max(gains[:5]) < 20.0  # percent
    assert np.isinf(gains[5])  # the payload hangs on the axis of the last joint
    assert "not separable" in {cell for row in alone.told_table().rows for cell in row}


def test_couplings_and_joints_without_a_drive(short):
    plain = mc.load_robot(ARM).to_dict()
    plain["coupling"] = {"J3": {"J2": -1.0}, "J4": {"J2": 0.5, "J4": 0.0}}
    robot = robot_from_dict(plain)
    assert robot.passive.tolist() == [False, False, False, True, False, False]
    found = mc.plan_motion(robot, duration=6.0)
    moved = found.parts[0].motion.evaluate(found.parts[0].motion.sample_times(20.0))
    assert_allclose(moved.q[:, 3], 0.0, atol=1e-12)
    assert {t.sigma for t in found.told if t.place == "J4"} == {np.inf}
    assert np.isfinite([t.sigma for t in found.told if t.parameter == "Coulomb"]).sum() == 5


def test_what_is_told_is_what_a_fit_finds(loaded):
    """Repeated fits of friction to torques with the noise that was assumed."""
    robot = mc.load_robot(ARM)
    model = module.build_torque_prediction_model(robot, [part.motion for part in loaded.parts])
    rows = []
    for part in loaded.parts:
        motion = part.motion.evaluate(part.motion.sample_times(module.INDEPENDENT_TORQUE_ROWS_HZ))
        own = [
            regressor(robot, motion) @ model.base_parameter_basis,
            module.friction_regressor(motion),
        ]
        rows.append(np.concatenate(own, axis=-1))
    columns = np.concatenate(rows) / model.noise[:, None]
    white = columns.reshape(-1, columns.shape[-1])
    inverse = np.linalg.pinv(white)
    noise = np.random.default_rng(3).normal(size=(len(white), 400))
    found = (inverse @ noise).std(axis=1)
    assert_allclose(found, module.standard_deviations_from_columns(white), rtol=0.2)


def test_the_file_is_read_again_once_torques_are_in_it(loaded, tmp_path):
    path = tmp_path / "motion.csv"
    path.write_text(loaded.csv("rad"))
    with pytest.raises(mc.DataError, match="no column of torque or current; drive this motion"):
        mc.read_runs(path)
    rng = np.random.default_rng(4)
    header, *lines = path.read_text().splitlines()
    torques = ",".join(f"tau{j + 1}_Nm" for j in range(6))
    measured = [f"{line},{','.join(f'{v:.4f}' for v in rng.normal(size=6))}" for line in lines]
    path.write_text("\n".join([f"{header},{torques}", *measured]))
    runs = mc.read_runs(path)
    assert [(one.name, one.payload) for one in runs] == [
        ("motion:fast", 0.0), ("motion:slow", 0.0), ("motion:loaded", 2.0)
    ]  # fmt: skip
    assert [one.notices for one in runs] == [()] * 3


def test_the_command(tmp_path, answered, says, short):
    motion, points = tmp_path / "m.csv", tmp_path / "w.csv"
    words = ("plan", ARM, "--motion", "--duration", 6, "--payload", 1)
    said = says(*words, "-o", motion, "--waypoints", points)
    assert "42 s of motion (fast 6 s, slow 30 s, loaded 6 s)" in said.out
    assert len(motion.read_text().splitlines()) == 1 + 601 + 3001 + 601
    assert "qd6_deg_s" in points.read_text().partition("\n")[0]
    told = answered(*words)
    assert told["kind"] == "motion_plan"
    assert [part["payload_kg"] for part in told["parts"]] == [0.0, 0.0, 1.0]
    assert len(told["tells"]) == 24


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "give the number of --poses, or --motion for a motion"),
        (("--poses", 3, "--payload", 1), "--payload is about a motion, with --motion"),
        (("--motion", "--poses", 3), "--poses is about poses, not about a motion"),
        (("--motion", "--tracker", "1,2,3"), "--tracker is about poses, not about a motion"),
        (("--motion", "--payload", -1), "--payload -1: give its mass in kg"),
        (("--motion", "--duration", 1), "--duration 1: give 5 to 300 s"),
        (("--motion", "--speed", 0), "--speed 0: give a number above 0"),
        (("--motion", "--volume", "0:1,0:1,0:1"), "no motion found that stays within"),
        (("--motion", "--unit", "grad"), "no unit 'grad'"),
    ],
)
def test_mistakes(refuses, words, message):
    refuses(message, "plan", ARM, *words)
