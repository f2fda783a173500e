"""Robot files of arms that nothing is drawn of."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.fitting import unknown_arm
from minimax_cal.fitting.unknown_arm import SEARCH, SWEEPS, identify_arm, rough, types_of

NOISE = 20e-6


def drawn(rng: np.random.Generator, joints: int = 0) -> mc.Robot:
    """An arm of 3 to 7 joints: square axes, a little off, some of them slides."""
    n = joints or int(rng.integers(3, 8))
    mdh = np.zeros((n, 5))
    mdh[:, 0] = rng.uniform(0.0, 0.6, n) * rng.choice([0, 1], n, p=[0.3, 0.7])
    mdh[:, 1] = rng.uniform(-0.5, 0.5, n) * rng.choice([0, 1], n)
    mdh[:, 2] = rng.uniform(-3.0, 3.0, n)
    mdh[:, 3] = 0.5 * np.pi * rng.choice([0, 1, -1], n) + rng.normal(0.0, 2e-3, n)
    mdh[:, 4] = rng.normal(0.0, 2e-3, n)
    return rough("arm", mdh, rng.uniform(size=n) < 0.12)


def sweeps(robot: mc.Robot, rng: np.random.Generator) -> list[np.ndarray]:
    """Each joint by itself, from a home pose of its own."""
    rows = []
    for joint, slides in enumerate(robot.prismatic):
        home = np.where(
            robot.prismatic, rng.uniform(-0.1, 0.1), rng.uniform(-1.0, 1.0, robot.joints)
        )
        values = np.linspace(-1.0, 1.0, 9) * (0.25 if slides else 1.2)
        rows += [np.where(np.arange(robot.joints) == joint, value, home) for value in values]
    return rows


def measured(
    robot: mc.Robot, rng: np.random.Generator, *, swept: bool = True, noise: float = NOISE
) -> mc.Measurements:
    """Sweeps of each joint and 40 random poses, of one reflector or three, from anywhere."""
    span = np.where(robot.prismatic, 0.3, 2.0)
    q = np.array([*(sweeps(robot, rng) if swept else []),
                  *rng.uniform(-span, span, (40, robot.joints))])  # fmt: skip
    spots = np.array([0.05, 0.05, 0.1]) + rng.uniform(-0.15, 0.15, (int(rng.choice([1, 3])), 3))
    turn = Rotation.random(rng=rng).as_matrix()
    pose = robot.pose(q)
    y = spots @ np.swapaxes(pose[:, :3, :3], 1, 2) + pose[:, None, :3, 3]
    y = y @ turn.T + np.array([2.0, 1.0, 0.3]) + noise * rng.normal(size=y.shape)
    return replace(mc.measurements(q, y), sliding=robot.prismatic)


def reaches_the_noise(seed: int, *, swept: bool = True) -> bool:
    rng = np.random.default_rng(seed)
    robot = drawn(rng)
    found = identify_arm(measured(robot, rng, swept=swept), names_of(robot))
    assert found.way == (SWEEPS if swept else SEARCH)
    return found.fit.accuracy["holdout"].rms_mm < 1.5e3 * NOISE * np.sqrt(3)


def names_of(robot: mc.Robot) -> list[str]:
    return ["prismatic" if slides else "revolute" for slides in robot.prismatic]


def test_axes_of_exact_sweeps_are_the_arm(rng):
    for _ in range(5):
        robot = drawn(rng)
        data = measured(robot, rng, noise=0.0)
        links = unknown_arm.links_of_axes(unknown_arm.axes_of(data, robot.prismatic))
        found = rough("found", links, robot.prismatic)
        here, there = found.pose(data.q), robot.pose(data.q)
        moves = [np.trace(a @ np.linalg.inv(a[0]), axis1=1, axis2=2) for a in (here, there)]
        assert_allclose(*moves, rtol=0, atol=1e-8)  # the same arm up to base and tool


@pytest.mark.parametrize("first", [0, pytest.param(10, marks=pytest.mark.slow)])
def test_arms_by_circle_sweeps_reach_the_noise(first):
    count = 200 if first else 8
    good = [reaches_the_noise(first + seed) for seed in range(count)]
    assert np.mean(good) >= 0.98


def test_an_arm_by_random_poses_alone():
    assert reaches_the_noise(3, swept=False)


def test_the_command_writes_a_rough_robot_that_calibrates(rng, tmp_path):
    robot = drawn(rng, 5)
    data, path, out = measured(robot, rng), tmp_path / "sweeps.csv", tmp_path / "robot.json"
    mc.write_measurements(path, data)
    joints = ",".join(names_of(robot))
    assert run("identify", path, "--joints", joints, "--name", "mine", "-o", out) == 0
    found = mc.load_robot(out)
    assert found.rough
    assert found.name == "mine"
    fit = mc.calibrate(found, mc.read_measurements(path), "sum")
    assert fit.accuracy["holdout"].rms_mm < 1.5e3 * NOISE * np.sqrt(3)
    assert run("identify", path, "--joints", "revolute,revolute") == 2
    assert run("identify", path, "--joints", "hinge") == 2


def test_joints_that_never_move_alone_are_named(rng, monkeypatch):
    monkeypatch.setattr(unknown_arm, "TRIALS", 1)
    monkeypatch.setattr(unknown_arm, "ROUNDS", 0)
    robot = drawn(rng, 4)
    data = measured(robot, rng, swept=False)
    noisy = data.with_y(data.y + 0.05 * rng.normal(size=data.y.shape))
    with pytest.raises(mc.DataError, match="measure sweeps of joint 1, 2, 3, 4"):
        identify_arm(noisy, names_of(robot))


def test_types_of_joints():
    assert types_of("R, prismatic,p").tolist() == [False, True, True]
    with pytest.raises(mc.OptionError, match="write revolute or prismatic"):
        types_of("")
