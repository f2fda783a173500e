"""Frames on nearly parallel axes, moved along these to where the arm is.

The common normal of two axes that are parallel but for a milliradian lies metres away from both.
Link tables with such normals (UR's controller has d of 100 m that cancel) give the same poses, but
their a and d are no lengths of links.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.robots.transforms import (
    a_alpha_beta_transform,
    alpha_beta_for_z_axis,
    axis_rotation,
    equivalent_a_theta_within_quarter_turn,
)

MAX_PARALLEL_AXIS_ANGLE = 0.05  # [rad]
MIN_REACH_RATIO = 2.0  # lengths that add up to this many times the arm's are no lengths of links


class MovedFrames(NamedTuple):
    """Links mdh (n, 5), and per frame how far it moved along its z (n,) [m] and turned (n,) [rad].

    The new frame is the old one times Tz(shift) Rz(-turn).
    """

    mdh: Array
    shifts: Array
    turns: Array


def move_frames_along_parallel_axes(mdh: Array) -> MovedFrames:
    """The same arm, each frame on an axis nearly parallel to the one before moved beside it.

    mdh: (n, 5) a, d, theta, alpha, beta [m, rad].  The links stay as they are, and all shifts 0,
    where their lengths are of the size of the arm.
    """
    moved, shifts, turns = np.array(mdh), np.zeros(len(mdh)), np.zeros(len(mdh))
    for i in range(len(mdh) - 1):
        link = a_alpha_beta_transform(moved[i])
        axis = link[:3, 2]
        if np.hypot(axis[0], axis[1]) > MAX_PARALLEL_AXIS_ANGLE:
            continue
        shift = -moved[i, 1] / axis[2]  # where the point on the axis has no d left
        x, y = link[:2, 3] + shift * axis[:2]
        a, angle = equivalent_a_theta_within_quarter_turn(float(np.hypot(x, y)), np.arctan2(y, x))
        rotation = axis_rotation(2, -angle)[:3, :3] @ link[:3, :3]
        alpha, beta = alpha_beta_for_z_axis(rotation[:, 2])
        before = a_alpha_beta_transform(np.array([a, 0.0, 0.0, alpha, beta]))[:3, :3]
        about_z = before.T @ rotation
        turn = np.arctan2(about_z[1, 0], about_z[0, 0])
        moved[i] = a, 0.0, moved[i, 2] + angle, alpha, beta
        moved[i + 1, 1] -= shift
        moved[i + 1, 2] += turn
        shifts[i], turns[i] = shift, turn
    lengths = [np.hypot(rows[:, 0], rows[:, 1]).sum() for rows in (mdh, moved)]
    if lengths[0] < MIN_REACH_RATIO * lengths[1]:
        return MovedFrames(np.asarray(mdh), np.zeros(len(mdh)), np.zeros(len(mdh)))
    return MovedFrames(moved, shifts, turns)
