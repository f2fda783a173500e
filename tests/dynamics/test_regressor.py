"""The rigid body against Pinocchio, and against the arm's own energy where that is not there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.dynamics.regressor import (
    JointMotion,
    build_nominal_inertial_parameters,
    compute_base_parameter_combinations,
    inverse_dynamics,
    regressor,
)
from minimax_cal.robots.gravity_torques import STANDARD_GRAVITY
from minimax_cal.robots.kinematics import forward_kinematics

EXACT = 1e-10  # of the largest torque
COUPLED = {"J3": {"J2": -1.0}, "J5": {"J4": 0.5, "J5": 0.0}, "J6": {"J4": 1.0}}  # J5 has no drive


def random_arm(seed: int, slides: tuple[int, ...] = (), coupled: bool = False) -> mc.Robot:
    """An arm of six joints with links of any shape."""
    rng = np.random.default_rng(seed)
    spread = rng.normal(size=(6, 3, 3))
    joints = []
    for i in range(6):
        about = spread[i] @ spread[i].T * 0.05
        joints.append(
            {
                "a": rng.normal() * 0.3,
                "d": rng.normal() * 0.3,
                "theta": rng.normal(),
                "alpha": rng.choice([0.0, 1.5, -1.5]) + 0.1 * rng.normal(),
                "beta": 0.0 if i % 2 else 0.05,
                "sign": int(rng.choice([-1, 1])),
                "type": "prismatic" if i in slides else "revolute",
                "mass_kg": rng.uniform(0.5, 9.0),
                "com_mm": (rng.normal(size=3) * 100.0).tolist(),
                "inertia": about[np.triu_indices(3)].tolist(),
            }
        )
    up = rng.normal(size=3).tolist()
    return robot_of({"name": "arm", "units": {"length": "m", "angle": "rad"}, "up": up,
                     "joints": joints, "coupling": COUPLED if coupled else None})  # fmt: skip


def robot_of(content: dict) -> mc.Robot:  # type: ignore[type-arg]
    from minimax_cal.robots.robot import robot_from_dict

    return robot_from_dict(content)


def motion(robot: mc.Robot, seed: int, count: int = 60) -> JointMotion:
    q, qd, qdd = np.random.default_rng(seed).normal(size=(3, count, robot.joints)) * 1.5
    return JointMotion(*(np.where(robot.passive, 0.0, part) for part in (q, qd, qdd)))


def from_drives(robot: mc.Robot) -> Array:
    """(n, n) turns of the chain per turn of each drive, signs applied."""
    matrix = np.diag(robot.sign)
    for joint, shares in COUPLED.items() if len(robot.coupling) else ():
        for drive, share in shares.items():
            matrix[int(joint[1]) - 1, int(drive[1]) - 1] = share * robot.sign[int(joint[1]) - 1]
    return matrix


def by_energy(robot: mc.Robot, moved: JointMotion) -> Array:
    """Torques (m, n) of the drives by Lagrange: complex steps of poses, differences of energy."""
    weight, turns = np.linalg.norm(robot.up), from_drives(robot)
    about = np.zeros((robot.joints, 3, 3))
    for i, j, value in zip(*np.triu_indices(3), robot.inertia.T, strict=True):
        about[:, i, j] = about[:, j, i] = value

    def lagrangian(q: Array, qd: Array) -> Array:
        """(m,) kinetic less potential energy.  q, qd: (m, n)."""
        out, turned = np.zeros(len(q)), (q + 1e-30j * qd) @ turns.T
        for i in range(robot.joints):
            some = slice(i + 1)
            pose = forward_kinematics(robot.mdh[some], turned[:, some], robot.prismatic[some])
            centre = pose[:, :3, :3] @ robot.com[i] + pose[:, :3, 3]
            spin = np.swapaxes(pose[:, :3, :3].real, 1, 2) @ pose[:, :3, :3].imag / 1e-30
            w = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
            fast = ((centre.imag / 1e-30) ** 2).sum(axis=1)
            out += 0.5 * (robot.mass[i] * fast + np.einsum("mi,ij,mj->m", w, about[i], w))
            out -= robot.mass[i] * STANDARD_GRAVITY * centre.real @ robot.up / weight
        return out

    def momentum(s: float, j: int) -> Array:
        q = moved.q + s * moved.qd + 0.5 * s * s * moved.qdd
        qd, unit = moved.qd + s * moved.qdd, np.eye(robot.joints)[j]
        return 0.5 * (lagrangian(q, qd + unit) - lagrangian(q, qd - unit))  # quadratic: exact

    step, torque = 1e-4, np.zeros_like(moved.q)
    for j in range(robot.joints):
        by = step * np.eye(robot.joints)[j]
        change = momentum(step, j) - momentum(-step, j)
        pull = lagrangian(moved.q + by, moved.qd) - lagrangian(moved.q - by, moved.qd)
        torque[:, j] = (change - pull) / (2.0 * step)
    return torque


def by_pinocchio(robot: mc.Robot, moved: JointMotion) -> Array:
    """Torques (m, n) by another's recursion."""
    pin = pytest.importorskip("pinocchio")
    model = pin.Model()
    model.gravity.linear = -STANDARD_GRAVITY * robot.up
    before, parent = pin.SE3.Identity(), 0
    for i, (a, d, theta, alpha, beta) in enumerate(robot.mdh):
        slides = robot.prismatic[i]
        kind = pin.JointModelPZ() if slides else pin.JointModelRZ()
        parent = model.addJoint(parent, kind, before, f"j{i}")
        turned = pin.SE3(Rotation.from_euler("z", theta).as_matrix(), np.zeros(3))
        bent = Rotation.from_euler("XY", [alpha, beta]).as_matrix()
        before = turned * pin.SE3(bent, np.array([a, 0.0, d]))
        about = np.zeros((3, 3))
        about[np.triu_indices(3)] = robot.inertia[i]
        about = about + np.triu(about, 1).T
        body = pin.Inertia(robot.mass[i], robot.com[i], about)
        model.appendBodyToJoint(parent, body, before)
    data = model.createData()
    turns = from_drives(robot)
    parts = zip(*(part @ turns.T for part in (moved.q, moved.qd, moved.qdd)), strict=True)
    return np.array([pin.rnea(model, data, *part) for part in parts]) @ turns


@pytest.mark.dev
@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("slides", [(), (0,), (2, 4)])
@pytest.mark.parametrize("seed", range(4))
def test_torques_are_those_of_pinocchio(seed: int, slides: tuple[int, ...], coupled: bool) -> None:
    robot = random_arm(seed, slides, coupled)
    moved, body = motion(robot, seed), build_nominal_inertial_parameters(robot)
    theirs = by_pinocchio(robot, moved)
    for ours in (regressor(robot, moved) @ body.ravel(), inverse_dynamics(robot, moved, body)):
        assert_allclose(ours, theirs, rtol=0, atol=EXACT * np.abs(theirs).max())


@pytest.mark.dev
def test_a_urdf_has_the_torques_of_pinocchio(tmp_path: Path) -> None:
    """Inertias in turned frames, a body fixed to a link, an axis that points down."""
    pin = pytest.importorskip("pinocchio")
    rng, parts = np.random.default_rng(3), ['<robot name="arm"><link name="l0"/>']
    for i in range(1, 6):
        kind = ["revolute", "prismatic", "continuous", "revolute", "fixed"][i - 1]
        xyz, rpy, about, turned = (" ".join(map(str, rng.normal(size=3) * s))
                                   for s in (0.3, 1.0, 0.1, 1.0))  # fmt: skip
        axis = ["0 0 1", "0 1 0", "0 0 -1", "1 0 0", "0 0 1"][i - 1]
        parts.append(
            f'<link name="l{i}"><inertial><mass value="{rng.uniform(1, 5)}"/>'
            f'<origin xyz="{about}" rpy="{turned}"/><inertia ixx="0.3" ixy="0.01" ixz="-0.02" '
            f'iyy="0.2" iyz="0.03" izz="0.4"/></inertial></link><joint name="j{i}" type="{kind}">'
            f'<parent link="l{i - 1}"/><child link="l{i}"/><origin xyz="{xyz}" rpy="{rpy}"/>'
            f'<axis xyz="{axis}"/><limit effort="1" velocity="1" lower="-2" upper="2"/></joint>'
        )
    path = tmp_path / "arm.urdf"
    path.write_text("".join(parts) + "</robot>")
    robot, model = mc.load_robot(path), pin.buildModelFromUrdf(str(path))
    model.gravity.linear = np.array([0.0, 0.0, -STANDARD_GRAVITY])
    data, moved = model.createData(), motion(robot, 5)
    theirs = []
    for q, qd, qdd in zip(moved.q, moved.qd, moved.qdd, strict=True):
        wound = [*q[:2], np.cos(q[2]), np.sin(q[2]), q[3]]  # a continuous joint is a pair there
        theirs.append(pin.rnea(model, data, np.array(wound), qd, qdd))
    ours = regressor(robot, moved) @ build_nominal_inertial_parameters(robot).ravel()
    assert_allclose(ours, theirs, rtol=0, atol=EXACT * np.abs(theirs).max())


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("slides", [(), (0,), (2, 4)])
def test_torques_are_those_of_the_energy(slides: tuple[int, ...], coupled: bool) -> None:
    """Twin without Pinocchio; differences of 1e-4 err by some 1e-8, rounding by 1e-11."""
    robot = random_arm(1, slides, coupled)
    moved, body = motion(robot, 3, 20), build_nominal_inertial_parameters(robot)
    theirs = by_energy(robot, moved)
    ours = regressor(robot, moved) @ body.ravel()
    assert_allclose(ours, theirs, rtol=0, atol=1e-6 * np.abs(theirs).max())
    found = inverse_dynamics(robot, moved, body)
    assert_allclose(found, ours, rtol=0, atol=EXACT * np.abs(ours).max())


def test_base_parameters_of_known_arms() -> None:
    """36 of a spatial arm with six turning joints whose first is vertical [Khalil, Dombre 2002]."""
    robot = mc.load_robot("ur10")
    columns = regressor(robot, motion(robot, 1, 200)).reshape(-1, 60)
    base = compute_base_parameter_combinations(columns)
    assert base.shape == (60, 36)
    value = np.random.default_rng(0).normal(size=60)
    assert_allclose(columns @ base @ (base.T @ value), columns @ value, rtol=0, atol=1e-8)


def test_a_robot_file_keeps_inertia_and_gain(tmp_path: Path) -> None:
    robot = random_arm(0)
    assert not len(robot.drive_gain)
    robot.save(tmp_path / "arm.json")
    again = mc.load_robot(tmp_path / "arm.json")
    assert_allclose(
        build_nominal_inertial_parameters(again),
        build_nominal_inertial_parameters(robot),
        rtol=1e-12,
    )
    content = robot.to_dict()
    content["joints"][2]["drive_gain"] = 11.5
    assert mc.Robot.to_dict(robot_of(content))["joints"][2]["drive_gain"] == 11.5
    assert np.isnan(robot_of(content).drive_gain[[0, 1, 3, 4, 5]]).all()
