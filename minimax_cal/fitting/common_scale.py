"""Whether all points are longer or shorter by one factor than errors of links would have them.

Before the fit, by the drawn arm alone: errors e of its points are A x + c s + noise, A the links'
columns and c that of a scale, both without what base and targets take.  Links are off by what arms
are, times an unknown factor; the evidence for s is the gain in marginal likelihood over s = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.fitting.start import BaseFit
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.model import model_of
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot

OFF_LENGTH, OFF_ANGLE = 0.3e-3, 0.5e-3  # how well arms are drawn; times FACTORS [m, rad]
FACTORS = np.geomspace(0.1, 30.0, 26)  # of the links' errors
NOISES = np.geomspace(2e-6, 2e-2, 30)  # of a coordinate, with what no link explains [m]
POSES = 60  # that tell a scale


@dataclass(frozen=True)
class Scale:
    """factor: 1 + s by which the points are too long.  gain: in twice the log likelihood."""

    factor: float
    gain: float


def scale_of(robot: Robot, data: Measurements, given: BaseFit) -> Scale:
    """The common factor that the points of a drawn arm suggest.  given: its base and targets."""
    rows = np.linspace(0, data.poses - 1, min(data.poses, POSES)).astype(int)
    model = model_of(robot, data.take(rows))
    n, p = 5 * robot.joints, model.names.geometric
    seen = np.broadcast_to(model.seen[..., None], (*model.seen.shape, 3)).reshape(-1)
    every = model.jacobian(given.state).reshape(-1, p)[seen]
    error = model.error(given.state).reshape(-1)[seen]
    links_at = kinematics.chain(given.state.mdh, model.q, model.prismatic)
    drawn = kinematics.points(links_at, given.state.target_positions)  # measured ones hold error
    points = np.swapaxes(drawn, -1, -2).reshape(-1)[seen]
    taken, _ = np.linalg.qr(every[:, n:])
    sigma = np.repeat([OFF_LENGTH, OFF_ANGLE], [2 * robot.joints, 3 * robot.joints])
    links, stretch, left = (
        part - taken @ (taken.T @ part) for part in (every[:, :n] * sigma, points, error)
    )
    u, size, _ = np.linalg.svd(links, full_matrices=False)
    inside = np.array([u.T @ left, u.T @ stretch])
    outside = np.array([left - u @ inside[0], stretch - u @ inside[1]])
    free = max(len(left) - p, 1) - len(size)
    without, _ = best(size, inside, outside, free, scaled=False)
    with_it, change = best(size, inside, outside, free, scaled=True)
    return Scale(1.0 + change, 2.0 * (with_it - without))


def best(
    size: Array, inside: Array, outside: Array, free: int, *, scaled: bool
) -> tuple[float, float]:
    """The largest log likelihood over factors and noises, and the scale there.

    size: singular values of the links' columns.  inside, outside: error and stretch along these
    columns, and beside them.  free: numbers beside them.
    """
    variance = (FACTORS[:, None, None] * size) ** 2 + NOISES[:, None] ** 2  # (f, v, r)
    e, c = inside
    beside = outside @ outside.T
    noise = NOISES**2
    scale = np.zeros(variance.shape[:2])
    if scaled:
        scale = ((e * c / variance).sum(-1) + beside[0, 1] / noise) / (
            (c * c / variance).sum(-1) + beside[1, 1] / noise
        )
    square = ((e - scale[..., None] * c) ** 2 / variance).sum(-1)
    rest = beside[0, 0] - 2.0 * scale * beside[0, 1] + scale**2 * beside[1, 1]
    likely = -0.5 * (square + np.log(variance).sum(-1) + rest / noise + free * np.log(noise))
    at = np.unravel_index(int(np.argmax(likely)), likely.shape)
    return float(likely[at]), float(scale[at])
