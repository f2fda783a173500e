"""The error map of a joint: any smooth curve of its own angle, with a Gaussian prior.

A Gaussian process on an interval is nearly the sum of the interval's sines, each with a normal
factor of its own whose variance is the spectral density at its frequency [Solin and Sarkka 2020].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.modelling.effects.gears import find_sweeping_joints
from minimax_cal.modelling.effects.scene import (
    PRIOR_REFERENCE_ERROR,
    Choice,
    Effect,
    EffectColumns,
    PosedArm,
    joint_index_from_place,
    one_joint,
)

USUAL_MAP_LENGTH, USUAL_MAP_SIZE = float(np.radians(5.0)), 3e-4  # of a usual curve [rad]
MIN_MAP_WAVELENGTH = float(np.radians(6.0))  # wavelength of the shortest sine
MAP_CURVE_STEP = float(np.radians(2.0))  # from one point of a curve that is told to the next
MAP_MARGIN = float(np.radians(4.0))  # beyond the measured angles the curve goes to nothing


def sine_basis(x: Array, low: float, high: float, count: int) -> Array:
    """(count, m) sin(k pi (x - low) / (high - low)), k = 1 ... count, 0 outside.  x: (m,)."""
    along = np.clip((x - low) / (high - low), 0.0, 1.0)
    return np.asarray(np.sin(np.pi * np.arange(1, count + 1)[:, None] * along))


def sine_factor_sigmas(correlation_length: float, span: float, count: int) -> Array:
    """(count,) standard deviations of the sines' factors, for a process of unit variance.

    Matern's covariance of order 3/2, (1 + s) exp(-s) with s = sqrt(3) |x - x'| / length, has the
    spectral density 4 a^3 / (a^2 + w^2)^2, a = sqrt(3) / length.
    """
    a, w = np.sqrt(3.0) / correlation_length, np.pi * np.arange(1, count + 1) / span
    return np.asarray(np.sqrt(2.0 / span * 4.0 * a**3) / (a**2 + w**2))


def sine_count_over_span(span: float) -> int:
    """How many sines a curve over so wide a range has [rad]."""
    return int(2.0 * span / MIN_MAP_WAVELENGTH) + 1


class AngleRange(NamedTuple):
    """Ends of a range of angles [rad]."""

    low: float
    high: float


def map_range_of_angles(angles: Array) -> AngleRange:
    """Where the curve of measured angles (m,) begins and ends [rad]."""
    return AngleRange(float(angles.min()) - MAP_MARGIN, float(angles.max()) + MAP_MARGIN)


def error_map_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """dq_j = f(q_j): f a Gaussian process between `low` and `high`, 0 elsewhere.

    length, size: of its covariance (Matern of order 3/2), size beside coordinates that err by
    `PRIOR_REFERENCE_ERROR`.
    """
    joint, low, high = joint_index_from_place(place), choice["low"], choice["high"]
    count = sine_count_over_span(high - low)
    wave = sine_basis(posed_arm.q[joint], low, high, count)
    sigma = choice["size"] * sine_factor_sigmas(choice["length"], high - low, count)
    return EffectColumns(
        tuple(f"w{k + 1}" for k in range(count)),
        ("rad",) * count,
        one_joint(posed_arm, joint, wave),
        ridge=(PRIOR_REFERENCE_ERROR / sigma) ** 2,
    )


def usual_map_choices(posed_arm: PosedArm, place: str) -> tuple[Choice, ...]:
    """The curve over the measured angles."""
    low, high = map_range_of_angles(posed_arm.q[joint_index_from_place(place)])
    return ({"low": low, "high": high, "length": USUAL_MAP_LENGTH, "size": USUAL_MAP_SIZE},)


JOINT_ERROR_MAP = Effect(
    "joint_error_map",
    "encoder and gear of a joint err by its angle, in a curve without a formula",
    "dq_j = f(q_j), f smooth: a Gaussian process",
    lambda scene: tuple(f"J{j + 1}" for j in find_sweeping_joints(scene)),
    error_map_columns,
    choices=usual_map_choices,
    is_map=True,
    follows="angle",
)


def fitted_map_curve(choice: Choice, joint_sign: float, values: Array, covariance: Array) -> Array:
    """(3, g) the curve of a fitted map: joint value as the controller has it, turn, and its sigma.

    joint_sign: of the joint in the robot file.  values: (d,), covariance: (d, d) [rad].
    """
    low, high = choice["low"], choice["high"]
    x = np.linspace(low, high, int((high - low) / MAP_CURVE_STEP) + 2)
    wave = sine_basis(x, low, high, len(values))
    band = np.sqrt(np.maximum(np.einsum("dg,de,eg->g", wave, covariance, wave), 0.0))
    out = np.stack([joint_sign * x, joint_sign * (values @ wave), band])
    return np.asarray(out[:, :: int(joint_sign)])
