"""Simulated trajectories for the tests of this room."""

from __future__ import annotations

import numpy as np

from minimax_cal.dynamics.run import Run
from minimax_cal.ground.arrays import Array


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
