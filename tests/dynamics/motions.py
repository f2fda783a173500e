"""Simulated trajectories for the tests of this room."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.dynamics.logs.log_table import Run
from minimax_cal.dynamics.regressor import (
    JointMotion,
    build_nominal_inertial_parameters,
    compute_link_inertial_parameters,
    inverse_dynamics,
)
from minimax_cal.robots.robot import robot_from_dict

NOISE = 0.1  # of a torque sample [N m]
RATE = 100.0  # [Hz]
Extra = Callable[
    [JointMotion, Array, Array], Array
]  # of motion, rigid torque and time: more torque


def fourier(
    rng: np.random.Generator, time: Array, joints: int, rate: float = 0.12
) -> tuple[Array, Array, Array]:
    """Joint values and two derivatives (m, n) of a finite Fourier series, at rest nowhere."""
    q, qd, qdd = np.zeros((3, len(time), joints))
    for k in range(1, 5):
        w = 2.0 * np.pi * rate * k
        for j in range(joints):
            a, b = rng.normal(size=2) * 0.6 / k
            q[:, j] += a * np.sin(w * time) + b * np.cos(w * time)
            qd[:, j] += w * (a * np.cos(w * time) - b * np.sin(w * time))
            qdd[:, j] += -w * w * (a * np.sin(w * time) + b * np.cos(w * time))
    return q, qd, qdd


def run_of(name: str, time: Array, q: Array, torque: Array, unit: str = "N m") -> Run:
    """A run that logs positions and torques only."""
    return Run(name, f"{name}.csv", time, q, None, None, torque, unit)


def three_joints() -> mc.Robot:
    """An arm of three joints: a vertical axis, two parallel ones, and a wrist's weight."""
    half = np.pi / 2.0
    joints = [
        {"a": 0.0, "d": 0.4, "theta": 0.0, "alpha": half, "mass_kg": 8.0, "com_mm": [0, -90, 20]},
        {"a": 0.5, "d": 0.0, "theta": 0.0, "alpha": 0.0, "mass_kg": 6.0, "com_mm": [-240, 10, 60]},
        {"a": 0.4, "d": 0.1, "theta": 0.0, "alpha": half, "mass_kg": 3.0, "com_mm": [-180, 0, 20]},
    ]
    about = [[0.05, 0, 0, 0.04, 0, 0.05], [0.02, 0, 0, 0.2, 0, 0.2], [0.01, 0, 0, 0.06, 0, 0.06]]
    for joint, inertia in zip(joints, about, strict=True):
        joint["inertia"] = inertia
    units = {"length": "m", "angle": "rad"}
    return robot_from_dict({"name": "three joints", "units": units, "joints": joints})


def driven_torque(motion: JointMotion, body: Array, turns: Array | None = None) -> Array:
    """Torques (m, 3) of the drives of the arm.  turns: (3, 3) of its joints per turn of a drive."""
    c = np.eye(3) if turns is None else turns
    moved = JointMotion(*(part @ c.T for part in (motion.q, motion.qd, motion.qdd)))
    return np.asarray(inverse_dynamics(three_joints(), moved, body) @ c)


def simulated(
    extra: Extra | None = None,
    *,
    seed: int = 0,
    runs: int = 3,
    seconds: float = 20.0,
    carried: float | Sequence[float] = 0.0,
    friction: bool = True,
    turns: Array | None = None,
    noise: float = NOISE,
) -> list[Run]:
    """Runs of the arm with usual friction, noise, and something more.

    carried: kg at the flange, 50 mm along z of the last frame, in all runs or in each.
    turns: (3, 3) of the joints per turn of a drive.
    """
    rng, robot, out = np.random.default_rng(seed), three_joints(), []
    for number, mass in enumerate(np.broadcast_to(carried, runs)):
        time = np.arange(0.0, seconds, 1.0 / RATE)
        motion = JointMotion(*fourier(rng, time, 3, 0.1 + 0.05 * (number % 3)))
        body = build_nominal_inertial_parameters(robot)
        body[-1] += compute_link_inertial_parameters(
            float(mass), np.array([0.0, 0.0, 0.05]), np.zeros(6)
        )
        rigid = driven_torque(motion, body, turns)
        torque = rigid + noise * rng.normal(size=rigid.shape)
        if friction:
            torque += np.sign(motion.qd) * [4.0, 3.0, 1.5] + motion.qd * [3.0, 4.0, 1.0]
        if extra is not None:
            torque += extra(motion, rigid, time)
        out.append(run_of(f"run{number}", time, motion.q, torque))
    return out
