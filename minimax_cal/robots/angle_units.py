"""Angles of a robot file in another unit than it says: radians called degrees, or the reverse."""

from __future__ import annotations

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import RobotError
from minimax_cal.robots.kinematics import MDH_NAMES

RIGHT_ANGLE_BY_UNIT = {"rad": np.pi / 2.0, "deg": 90.0}  # a right angle
OTHER_ANGLE_UNIT = {"rad": "deg", "deg": "rad"}
MAX_RIGHT_ANGLE_DEVIATION_RATIO = (
    0.0125  # of a right angle: as square as the axes of an arm are built
)
MAX_LIMIT_TURNS = 4.0  # further than joints with stops go; one without end has no limits
MIN_PLACEHOLDER_LIMIT = 1e3  # larger ones say that there is no limit, in any unit [rad]


def check_link_angle_unit(link_angles: Array, angle_unit: str, source: str) -> None:
    """Raise RobotError where the angles of the links are square in the other unit alone.

    link_angles: (n, 3) theta, alpha, beta in the file's numbers.
    """
    size, right = np.abs(link_angles), RIGHT_ANGLE_BY_UNIT[OTHER_ANGLE_UNIT[angle_unit]]
    told = size > MAX_RIGHT_ANGLE_DEVIATION_RATIO * right
    whole = np.round(size / right)
    square = (
        told
        & (whole >= 1.0)
        & (np.abs(size - whole * right) < MAX_RIGHT_ANGLE_DEVIATION_RATIO * right)
    )
    small = size.max() < (4.0 + MAX_RIGHT_ANGLE_DEVIATION_RATIO) * right  # as of one turn at most
    if small and 2 * np.count_nonzero(square) > np.count_nonzero(told):
        joint, column = np.argwhere(square)[0]
        raise RobotError(
            f"{source}: units.angle: says {angle_unit}, but "
            f"joints[{joint}].{MDH_NAMES[2 + column]} is "
            f"{link_angles[joint, column]:.6g}, a right angle or several "
            f"in {OTHER_ANGLE_UNIT[angle_unit]}: write "
            f"{OTHER_ANGLE_UNIT[angle_unit]}"
        )


def check_joint_limit_unit(
    lower: Array, upper: Array, prismatic: Array, angle_unit: str, source: str
) -> None:
    """Raise RobotError where limits in radians are turns on turns: they are degrees.

    lower, upper: (n,) in the file's numbers, infinite where not told.  One joint may turn far, by
    a number that is not whole; where most of them do, or by whole radians, it is a slip.
    """
    if angle_unit != "rad":
        return
    ends = np.where(prismatic[:, None], 0.0, np.stack([lower, upper], axis=1))
    ends = np.where(np.abs(ends) < MIN_PLACEHOLDER_LIMIT, ends, 0.0)
    far = np.abs(ends) > 2.0 * np.pi * MAX_LIMIT_TURNS
    most = 2 * np.count_nonzero(far.any(axis=1)) > np.count_nonzero(ends.any(axis=1))
    slips = np.argwhere(far & (most | (np.abs(ends - np.round(ends)) < 1e-6)))
    if len(slips):
        joint, end = slips[0]
        raise RobotError(
            f"{source}: joints[{joint}].{('lower', 'upper')[end]}: {ends[joint, end]:.6g} rad are "
            f"{abs(ends[joint, end]) / (2.0 * np.pi):.3g} turns; degrees? then give it in rad, the "
            "unit of the file's angles (units.angle; of every URDF); leave lower and upper out "
            "for a joint that turns without end"
        )
