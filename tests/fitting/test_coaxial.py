"""Two axes that are drawn as one and lie apart: both coordinates of that are found."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.fitting.data_slips import describe_other_arm
from minimax_cal.fitting.multi_instrument.relative_calibration import relative
from minimax_cal.instruments import distances, flange_poses
from minimax_cal.measuring.measurements import measurements
from minimax_cal.robots.robot import robot_from_dict

NOISE = 3e-5  # of a coordinate or a length [m]
OFFSET, TILT = np.array([1e-4, -3e-4]), np.array([4e-4, -3e-4])  # of the next axis [m, rad]
KINDS = ("tracker", "declared", "wires", "poses")
AXES = [  # a, d [m], alpha: joints 3 and 4 are drawn on one axis, as 5 and 6 in `WRIST`
    (0.1, 0.4, np.pi / 2), (0.5, 0.0, 0.0), (0.0, 0.1, 0.0),
    (0.05, 0.45, np.pi / 2), (0.08, 0.0, np.pi / 2), (0.0, 0.1, 0.0),
]  # fmt: skip
WRIST = [*AXES[:2], (0.1, 0.0, np.pi / 2), AXES[3], (0.0, 0.05, 0.0), AXES[5]]
BASE = [(0.0, 0.4, 0.0), *AXES[1:2], (0.1, 0.0, np.pi / 2), *AXES[3:]]
SHORT = [*AXES[:2], (8e-4, 0.1, 0.0), *AXES[3:]]
ARMS = {"short": (SHORT, 2), "third": (AXES, 2), "wrist": (WRIST, 4), "base": (BASE, 0)}


def drawn(axes):
    joints = [
        {"a": 1e3 * a, "d": 1e3 * d, "alpha": alpha, "theta": 0.0, "beta": 0.0,
         "type": "revolute", "lower": -2.0, "upper": 2.0}
        for a, d, alpha in axes
    ]  # fmt: skip
    units = {"length": "mm", "angle": "rad"}
    return robot_from_dict({"name": "coaxial", "units": units, "joints": joints}, "coaxial")


def matrix(rotation=((1, 0, 0), (0, 1, 0), (0, 0, 1)), place=(0.0, 0.0, 0.0)):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, place
    return out


def flange(axes, at, q, offset):
    """(m, 4, 4) by a product of matrices in which the offset is a translation in x and y."""
    out = []
    for row in q:
        frame = np.eye(4)
        for j, (a, d, alpha) in enumerate(axes):
            frame = frame @ matrix(Rotation.from_euler("z", row[j]).as_matrix())
            frame = frame @ matrix(Rotation.from_euler("x", alpha).as_matrix(), (a, 0.0, d))
            if j == at:
                tilt = Rotation.from_rotvec([*(TILT * bool(offset.any())), 0.0]).as_matrix()
                frame = frame @ matrix(tilt, (*offset, 0.0))
        out.append(frame)
    return np.array(out)


def measured(name, kind, offset, rng):
    axes, at = ARMS[name]
    q = rng.uniform(-2.0, 2.0, (90, 6))
    pose = flange(axes, at, q, offset)
    place = pose[:, :3, 3] + pose[:, :3, :3] @ [0.06, -0.04, 0.1]
    turn = Rotation.from_rotvec([0.3, -0.5, 1.1]).as_matrix()
    if kind == "wires":
        anchors = 2.0 * np.array([[1.0, 0.0, 0.2], [-0.5, 0.9, 0.5], [-0.5, -0.9, -0.2]])
        length = np.linalg.norm(place[:, None] - anchors, axis=-1)
        return distances(q, length + NOISE * rng.normal(size=length.shape))
    points = place @ turn.T + [1.0, -2.0, 0.5] + NOISE * rng.normal(size=place.shape)
    if kind != "poses":
        return measurements(q, points[:, None])
    jitter = Rotation.from_rotvec(1e1 * NOISE * rng.normal(size=(90, 3))).as_matrix()
    seen = pose.copy()
    seen[:, :3, :3], seen[:, :3, 3] = jitter @ turn @ pose[:, :3, :3], points
    return flange_poses(q, seen)


def fitted(name, kind, offset=OFFSET):
    rng = np.random.default_rng([7, *(ord(letter) for letter in name + kind)])
    robot, data = drawn(ARMS[name][0]), measured(name, kind, offset, rng)
    if kind in ("wires", "poses"):
        return robot, relative(robot, [data])
    instrument = "60um" if kind == "declared" else None
    return robot, mc.calibrate(robot, data, "sum", holdout=0.2, instrument=instrument)


def of_theta(fit):
    return [p.name for p in fit.parameters if p.identifiable and p.name.startswith("theta")]


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("kind", KINDS)
def test_axes_apart_in_any_direction_are_fitted_to_the_noise(name, kind):
    _, fit = fitted(name, kind)
    noise = 1e3 * NOISE * np.sqrt(1 if kind == "wires" else 3)
    assert str(fit.status) == "converged"
    assert fit.accuracy["holdout"].rms_mm < 1.35 * noise
    axes, at = ARMS[name]
    length = np.hypot(axes[at][0] + OFFSET[0], OFFSET[1])
    assert abs(abs(fit.robot.mdh[at, 0]) - length) < 6e-5  # of the common normal


@pytest.mark.parametrize("kind", KINDS)
def test_positions_elsewhere_are_right(kind):
    _, fit = fitted("third", kind)
    q = np.random.default_rng(3).uniform(-2.0, 2.0, (200, 6))
    axes, at = ARMS["third"]
    true, found = flange(axes, at, q, OFFSET)[:, :3, 3], fit.robot.pose(q)
    p = found[:, :3, 3]
    turns = -np.cross(np.eye(3)[None], p[:, None]).transpose(0, 2, 1)
    columns = [found[:, :3, :3], np.tile(np.eye(3), (200, 1, 1)), turns]  # tool and base
    basis, gap = np.concatenate(columns, axis=2).reshape(600, 9), (true - p).reshape(-1)
    gap = gap - basis @ np.linalg.lstsq(basis, gap, rcond=None)[0]
    assert np.sqrt((gap.reshape(-1, 3) ** 2).sum(axis=1).mean()) < 6e-5


@pytest.mark.parametrize("kind", KINDS)
def test_axes_on_one_line_get_no_direction_of_a_normal(kind):
    _, apart = fitted("third", kind)
    _, fit = fitted("third", kind, np.zeros(2))
    assert len(of_theta(apart)) == len(of_theta(fit)) + 1


@pytest.mark.parametrize(("name", "joint"), [("third", 2), ("wrist", 4), ("base", 0)])
def test_a_normal_that_turns_is_no_other_arm(name, joint):
    robot = drawn(ARMS[name][0])
    active, mdh = np.ones(30, dtype=bool), robot.mdh.copy()
    mdh[joint, 2] += 2.0
    mdh[joint + 1, 2] -= 2.0
    assert describe_other_arm(robot, mdh, active) == ""
    mdh[joint, 2] += 0.6  # the sum is drawn, but where a base or a tool takes it
    assert bool(describe_other_arm(robot, mdh, active)) == (name == "third")
