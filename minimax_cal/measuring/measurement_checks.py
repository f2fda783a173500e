"""Slips that no fit should be asked to explain: units, signs, swapped reflectors, too few poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.core.errors import DataError
from minimax_cal.core.units import display_unit_of_change
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import describe_mislabelled_pose
from minimax_cal.reading.measurement_table import JOINT_OPTION_COLUMN_PATTERN
from minimax_cal.robots.joint_couplings import insert_passive_joint_zeros
from minimax_cal.robots.robot import Robot

MIN_OUTLIER_OVER_TYPICAL = (
    8.0  # times the typical error, and 4 times what 95 % keep to: worth a look
)
MAX_FLANGE_OVER_POINT_SPREAD = 50.0  # factor by which points may spread less than the flange
MIN_FLANGE_SPREAD = 0.3  # spread that is one [m]
MAX_FULLY_PERMUTED_TARGETS = 5  # targets of which all orders are tried
MAX_COMMANDED_SWING = (
    4.0 * np.pi
)  # no arm joint is commanded beyond two turns unless it says so in its limits


def check_and_complete_joints(robot: Robot, data: Measurements) -> Measurements:
    """The data with columns of 0 for joints without a drive, where these are not among them.

    Raises DataError if the joint columns cannot belong to the robot.
    """
    n = data.q.shape[1]
    if n != robot.joints:
        data = insert_passive_joint_columns(robot, data)
    for i in np.flatnonzero(data.sliding != robot.prismatic):
        unit, mend = ("rad", "mm") if robot.prismatic[i] else ("mm", "rad")
        kind = "slides" if robot.prismatic[i] else "turns"
        raise DataError(
            f"{data.source}: joint {i + 1} of {robot.name} {kind}; name its column "
            f"q{i + 1}_{mend}, not q{i + 1}_{unit}"
        )
    limit = np.where(
        robot.prismatic,
        np.inf,
        np.maximum(0.5 * MAX_COMMANDED_SWING, max_absolute_joint_limits(robot)),
    )
    beyond = 0.5 * np.abs(data.q) > limit
    if beyond.any():
        row, joint = np.argwhere(beyond)[0]
        raise DataError(
            f"{data.source}:{data.line[row]}: joint {joint + 1} at {data.q[row, joint]:.1f} rad is "
            f"more than two turns; degrees? then name the columns q1_deg, q2_deg, ..."
        )
    return data


MIN_JOINT_SPAN = 5e-3  # of some joint, in measurements that could tell anything of an arm [rad, m]


def check_joints_move(data: Measurements) -> None:
    """Raise DataError where no joint moves, whatever was measured."""
    moved = float(np.ptp(data.q, axis=0).max(initial=0.0)) if data.poses else 0.0
    if data.poses > 1 and moved < MIN_JOINT_SPAN:
        raise DataError(
            f"{data.source}: the joint values do not move ({np.degrees(moved):.2f} deg at most) "
            f"over {data.poses} poses: were they read once? record them at each pose"
        )


def insert_passive_joint_columns(robot: Robot, data: Measurements) -> Measurements:
    """The data with columns of 0 for joints without a drive.  Raises DataError for another arm."""
    n, driven = data.q.shape[1], np.flatnonzero(~robot.passive)
    if n != len(driven):
        passive = robot.joints - len(driven)
        without = f", {passive} of them without a drive" if passive else ""
        raise DataError(
            f"{data.source}: has {n} joint columns, but {robot.name} has {robot.joints} joints"
            f"{without}"
        )

    def renumbered(name: str) -> str:
        found = JOINT_OPTION_COLUMN_PATTERN.fullmatch(name)
        return f"{name[: found.start(1)]}{driven[int(found[1]) - 1] + 1}" if found else name

    def widened(part: Measurements) -> Measurements:
        columns = {renumbered(name): column for name, column in part.columns.items()}
        sliding = np.where(
            robot.passive, robot.prismatic, insert_passive_joint_zeros(part.sliding, robot.passive)
        )
        return replace(
            part,
            q=insert_passive_joint_zeros(part.q, robot.passive),
            sliding=sliding,
            columns=columns,
        )

    return data.change_with_set_aside(widened)


def max_absolute_joint_limits(robot: Robot) -> Array:
    """(n,) the larger of the two joint limits, 0 where unknown."""
    limits = np.maximum(np.abs(robot.lower), np.abs(robot.upper))
    return np.where(np.isfinite(limits), limits, 0.0)


def check_pose_count(
    data: Measurements, distinct_poses: int, unknown_count: int, prior_count: int
) -> None:
    """Raise DataError if the poses cannot determine the unknowns.

    distinct_poses: number of different ones.  unknown_count: free parameters.  prior_count: priors
    on them.
    """
    if distinct_poses == 1 and data.poses > 1:
        alike = f"{data.source}: all {data.poses} rows have the same joint values"
        raise DataError(describe_mislabelled_pose(data) or alike)
    a_pose = min(3.0 * data.seen.sum() / data.poses, 6.0)  # a rigid flange has six freedoms
    needed = int(np.ceil((unknown_count - prior_count) / a_pose)) + 1
    if distinct_poses < needed:
        raise DataError(
            f"{data.source}: {distinct_poses} different poses "
            f"for the fit, but {unknown_count} unknown "
            f"parameters need at least {needed}; measure more poses, hold out fewer, fix "
            "parameters (fix) or give priors"
        )


def list_robot_notices(robot: Robot, data: Measurements) -> list[str]:
    """Notices about the robot's frames, and joint values outside its limits (1 % of slack)."""
    slack = 0.01 * (robot.upper - robot.lower)
    slack = np.where(np.isfinite(slack), slack, 0.0)
    outside = (data.q < robot.lower - slack) | (data.q > robot.upper + slack)
    return [
        *robot.notices,
        *(
            f"{data.source}: joint {i + 1} is outside the limits of {robot.name} at "
            f"{int(outside[:, i].sum())} poses"
            for i in np.flatnonzero(outside.any(axis=0))
        ),
    ]


class TargetOrders(NamedTuple):
    """Order (m, k) of targets in which each row fits best, its squares (m,), those as given."""

    orders: Array
    best_squares: Array
    given_squares: Array


def find_best_target_orders(distances: Array) -> TargetOrders:
    """Under which names the targets of each row fit best.

    distances: (k, k, m) distance from measured target i to predicted target j at each pose, NaN
    where i was not measured [m].  Returns the order (m, k) of the targets, its sum of squares and
    that of the names as given, (m,) each [m^2].
    """
    k = len(distances)
    squared = np.nan_to_num(distances) ** 2
    orders = list(list_target_orders(k))
    cost = np.stack([squared[range(k), order, :].sum(axis=0) for order in orders])
    best = cost.argmin(axis=0)
    return TargetOrders(np.array(orders)[best], cost.min(axis=0), cost[0])


def find_swapped_rows(best_squares: Array, given_squares: Array) -> Array:
    """Rows whose targets fit far better under other names.  best_squares, given_squares: as
    `find_best_target_orders`.
    """
    better = best_squares < 0.1 * given_squares
    if not better.any():
        return np.flatnonzero(better)
    return np.flatnonzero(better & (given_squares > 25.0 * float(np.median(best_squares))))


def list_outlier_notices(data: Measurements, distances: Array, unit: str = "m") -> list[str]:
    """Points that miss by far more than the others.

    distances: (m, k), NaN where not measured [unit].
    """
    scale, name = display_unit_of_change(unit)
    known = np.where(np.isfinite(distances), distances, -1.0)
    given = known[known >= 0.0]
    usual = float(np.median(given)) if len(given) else 0.0
    if known.max(initial=0.0) <= MIN_OUTLIER_OVER_TYPICAL * usual:
        return []
    far = known > max(MIN_OUTLIER_OVER_TYPICAL * usual, 4.0 * np.quantile(given, 0.95), 1e-6)
    found = np.argwhere(far)
    if not len(found):
        return []
    named = [
        f"{data.called(data.line[pose])} {data.target_names[target]} "
        f"{scale * distances[pose, target]:.3g} {name}"
        for pose, target in sorted(found, key=lambda at: -distances[tuple(at)])
    ]
    typical = f"outliers (typical error {scale * usual:.3g} {name})"
    return [f"{data.source}: {typical}: {format_first_names(named, 5)}"]


def check_point_spread(robot: Robot, data: Measurements) -> None:
    """Raise DataError if the points cannot be those of targets on this arm.

    If one target's spread a hundred times more than another's, if two targets have the same points,
    or if they stay while the flange moves: by another factor than 1000, which `slips` tells.
    """
    for i, j in combinations(range(len(data.target_names)), 2):
        both = data.seen[:, i] & data.seen[:, j]
        apart = np.abs(data.y[both, i] - data.y[both, j])
        if both.any() and not apart.any():
            names = f"{data.target_names[i]} and {data.target_names[j]}"
            raise DataError(
                f"{data.source}: {names} have the same points at all poses; leave one of them out, "
                "or mend its columns"
            )
    spread = np.nanstd(data.y, axis=0).max(axis=1)
    flange, points = robot.pose(data.q)[:, :3, 3].std(axis=0).max(), float(np.nanmax(spread))
    stay = (
        0.0 < points < flange / MAX_FLANGE_OVER_POINT_SPREAD
        and not 0.5 < 1e3 * points / flange < 2.0
    )
    if data.poses > 2 and stay and flange > MIN_FLANGE_SPREAD:
        raise DataError(
            f"{data.source}: the points spread over {points:.3g} m, but the flange of {robot.name} "
            f"over {flange:.3g} m at these joint values; check their units, and whether they "
            "belong together"
        )
    if spread.max() > 100.0 * spread.min() and np.all(data.seen.sum(axis=0) > 5):
        big, small = (data.target_names[i] for i in (int(spread.argmax()), int(spread.argmin())))
        raise DataError(
            f"{data.source}: the points of {big} spread over {spread.max():.3g} m, those of "
            f"{small} over {spread.min():.3g} m; one of them has the wrong unit"
        )


def list_target_orders(target_count: int) -> Iterator[tuple[int, ...]]:
    """The orders of k targets that are tried, their own first: of many only exchanges of two."""
    if target_count <= MAX_FULLY_PERMUTED_TARGETS:
        yield from permutations(range(target_count))
        return
    own = tuple(range(target_count))
    yield own
    for a, b in combinations(own, 2):
        yield (*own[:a], b, *own[a + 1 : b], a, *own[b + 1 :])


def has_collinear_targets(data: Measurements) -> bool:
    """Whether three or more targets lie on a line, as their measured distances say."""
    whole = data.y[data.seen.all(axis=1)]
    if whole.shape[1] < 3 or not len(whole):
        return False
    spread = whole - whole.mean(axis=1, keepdims=True)
    square = np.linalg.eigvalsh(np.swapaxes(spread, 1, 2) @ spread)
    return bool(np.median(square[:, 1] / square[:, 2]) < 0.02**2)
