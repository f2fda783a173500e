"""Whether all points are longer or shorter by one factor than errors of links would have them.

After the fit, by how its lengths changed: all by one share, beyond what its angles let expect.

Before the fit, by the drawn arm alone: errors e of its points are A x + c s + noise, A the links'
columns and c that of a scale, both without what base and targets take.  Links are off by what arms
are, times an unknown factor; the evidence for s is the gain in marginal likelihood over s = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr

from minimax_cal.fitting.start import BaseFit
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.model import model_of
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot

OFF_LENGTH, OFF_ANGLE = 0.3e-3, 0.5e-3  # how well arms are drawn; times FACTORS [m, rad]
LEAST_SHARE = 7e-4  # a smaller common factor may be the warmth of the arm: aluminium by 30 K
FACTORS = np.geomspace(0.1, 30.0, 26)  # of the links' errors
NOISES = np.geomspace(2e-6, 2e-2, 30)  # of a coordinate, with what no link explains [m]
POSES = 60  # that tell a scale
LEAST_LENGTH, FEWEST = 0.05, 4  # of lengths that tell a common share: size [m]; their number
MAX_P_VALUE, MAX_DOUBTFUL_P_VALUE = (
    0.003,
    0.05,
)  # that lengths which are off at random agree so well on a share
# sigmas of what the angles let expect, beside which doubtful agreement is enough
MIN_CLEAR_SIGMAS = 3.0
MEDIAN = 0.6745  # of a Gaussian's absolute value, in sigmas


def common_share(drawn: Array, change: Array, found: Array) -> float:
    """The share by which the lengths of a fit changed together, 0 where that may be chance.

    The lengths must agree on it, or nearly so where it is more than the angles let expect: of arms
    that are drawn to OFF_LENGTH and OFF_ANGLE, times one factor.  A share that a warm arm may have
    is none.  drawn, change: (n, 5) rows [m, rad].  found: (n, 5) True where identified.
    """
    lengths = found[:, :2] & (np.abs(drawn[:, :2]) > LEAST_LENGTH)
    angles = np.abs(change[:, 2:][found[:, 2:]])
    if lengths.sum() < FEWEST or len(angles) < FEWEST:
        return 0.0
    length, more = drawn[:, :2][lengths], change[:, :2][lengths]
    size = float(length @ length)
    share = float(length @ more) / size
    spare = len(length) - 1
    apart = max(float(np.sqrt(((more - share * length) ** 2).sum() / spare)), 1e-12)
    stretch = abs(share) * np.sqrt(size)
    chance = 2.0 * float(stdtr(spare, -stretch / apart))
    usual = float(np.median(angles)) / MEDIAN / OFF_ANGLE * OFF_LENGTH
    clear = chance < MAX_P_VALUE or (
        chance < MAX_DOUBTFUL_P_VALUE and stretch > MIN_CLEAR_SIGMAS * usual
    )
    return share if clear and abs(share) > LEAST_SHARE else 0.0


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
    sigma = np.repeat([OFF_LENGTH, OFF_ANGLE], [2 * robot.joints, 3 * robot.joints])
    columns = np.column_stack([every[:, n:], every[:, :n] * sigma, points, error])
    triangle = np.asarray(np.linalg.qr(columns, mode="r"))
    reduced = triangle[p - n :, p - n :]  # beside base and targets
    u, size, _ = np.linalg.svd(reduced[:, :n], full_matrices=False)
    stretch, left = reduced[:, n], reduced[:, n + 1]
    inside = np.array([u.T @ left, u.T @ stretch])
    outside = np.array([left - u @ inside[0], stretch - u @ inside[1]])
    free = max(len(error) - p, 1) - len(size)
    without, with_it, change = best(size, inside, outside, free)
    return Scale(1.0 + change, 2.0 * (with_it - without))


def best(size: Array, inside: Array, outside: Array, free: int) -> tuple[float, float, float]:
    """The largest log likelihood over factors and noises, without a scale and with it; the scale.

    size: singular values of the links' columns.  inside, outside: error and stretch along these
    columns, and beside them.  free: numbers beside them.
    """
    variance = (FACTORS[:, None, None] * size) ** 2 + NOISES[:, None] ** 2  # (f, v, r)
    noise, beside = NOISES**2, outside @ outside.T
    e, c = inside
    ee, ec, cc = np.moveaxis((1.0 / variance) @ np.array([e * e, e * c, c * c]).T, -1, 0)
    ee, ec, cc = ee + beside[0, 0] / noise, ec + beside[0, 1] / noise, cc + beside[1, 1] / noise
    sizes = np.log(variance).sum(-1) + free * np.log(noise)
    likely = -0.5 * (ee - ec**2 / cc + sizes)
    at = np.unravel_index(int(np.argmax(likely)), likely.shape)
    return float(np.max(-0.5 * (ee + sizes))), float(likely[at]), float(ec[at] / cc[at])
