"""The error map of a joint: any smooth curve of its own angle, with a Gaussian prior.

A Gaussian process on an interval is nearly the sum of the interval's sines, each with a normal
factor of its own whose variance is the spectral density at its frequency [Solin and Sarkka 2020].
"""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.gears import sweeping
from minimax_cal.modelling.effects.scene import (
    BESIDE,
    Choice,
    Columns,
    Effect,
    Scene,
    joint_of,
    one_joint,
)

LENGTH, SIZE = float(np.radians(5.0)), 3e-4  # of a usual curve [rad]
FINEST = float(np.radians(6.0))  # wavelength of the shortest sine
CURVE_STEP = float(np.radians(2.0))  # from one point of a curve that is told to the next
MARGIN = float(np.radians(4.0))  # beyond the measured angles the curve goes to nothing


def sines(x: Array, low: float, high: float, count: int) -> Array:
    """(count, m) sin(k pi (x - low) / (high - low)), k = 1 ... count, 0 outside.  x: (m,)."""
    along = np.clip((x - low) / (high - low), 0.0, 1.0)
    return np.asarray(np.sin(np.pi * np.arange(1, count + 1)[:, None] * along))


def spread(length: float, span: float, count: int) -> Array:
    """(count,) standard deviations of the sines' factors, for a process of unit variance.

    Matern's covariance of order 3/2, (1 + s) exp(-s) with s = sqrt(3) |x - x'| / length, has the
    spectral density 4 a^3 / (a^2 + w^2)^2, a = sqrt(3) / length.
    """
    a, w = np.sqrt(3.0) / length, np.pi * np.arange(1, count + 1) / span
    return np.asarray(np.sqrt(2.0 / span * 4.0 * a**3) / (a**2 + w**2))


def waves_over(span: float) -> int:
    """How many sines a curve over so wide a range has [rad]."""
    return int(2.0 * span / FINEST) + 1


def range_of(q: Array) -> tuple[float, float]:
    """Where the curve of measured angles (m,) begins and ends [rad]."""
    return float(q.min()) - MARGIN, float(q.max()) + MARGIN


def error_map(scene: Scene, place: str, choice: Choice) -> Columns:
    """dq_j = f(q_j): f a Gaussian process between `low` and `high`, 0 elsewhere.

    length, size: of its covariance (Matern of order 3/2), size beside coordinates that err by
    `BESIDE`.
    """
    joint, low, high = joint_of(place), choice["low"], choice["high"]
    count = waves_over(high - low)
    wave = sines(scene.q[joint], low, high, count)
    sigma = choice["size"] * spread(choice["length"], high - low, count)
    return Columns(
        tuple(f"w{k + 1}" for k in range(count)),
        ("rad",) * count,
        one_joint(scene, joint, wave),
        ridge=(BESIDE / sigma) ** 2,
    )


def usual(scene: Scene, place: str) -> tuple[Choice, ...]:
    """The curve over the measured angles."""
    low, high = range_of(scene.q[joint_of(place)])
    return ({"low": low, "high": high, "length": LENGTH, "size": SIZE},)


JOINT_ERROR_MAP = Effect(
    "joint_error_map",
    "encoder and gear of a joint err by its angle, in a curve without a formula",
    "dq_j = f(q_j), f smooth: a Gaussian process",
    lambda scene: tuple(f"J{j + 1}" for j in sweeping(scene)),
    error_map,
    choices=usual,
    is_map=True,
    follows="angle",
)


def curve_of(choice: Choice, sign: float, values: Array, covariance: Array) -> Array:
    """(3, g) the curve of a fitted map: joint value as the controller has it, turn, and its sigma.

    sign: of the joint in the robot file.  values: (d,), covariance: (d, d) [rad].
    """
    low, high = choice["low"], choice["high"]
    x = np.linspace(low, high, int((high - low) / CURVE_STEP) + 2)
    wave = sines(x, low, high, len(values))
    band = np.sqrt(np.maximum(np.einsum("dg,de,eg->g", wave, covariance, wave), 0.0))
    out = np.stack([sign * x, sign * (values @ wave), band])
    return np.asarray(out[:, :: int(sign)])
