"""Stops of the arm, the poses they belong to, and their values as a cell sees them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import group_repeated_poses
from minimax_cal.measuring.visit_history import (
    MIN_JOINT_MOVE,
    follows_previous_pose,
    joint_moves,
    rows_in_visit_order,
)
from minimax_cal.modelling.cell import Cell
from minimax_cal.validation.iso9283.formulas import (
    distance_accuracy,
    distance_accuracy_and_repeatability,
    euler_angles,
    euler_deviation,
    fit_rotations,
    group_means,
    group_standard_deviations,
    mean_rotations,
    multidirectional_variation,
    orientation_error,
    position_repeatability,
)

MIN_GIMBAL_LOCK_COSINE = 0.1  # |cos b| below which a and c exaggerate a turn more than tenfold
MAX_PAIRED_POSES = 3000  # poses whose pairs are all formed


class StopPoses(NamedTuple):
    """Names of the P poses as they were first visited, and (v,) the number of each stop's."""

    names: Array
    numbers: Array


@dataclass(frozen=True, eq=False)
class ArmStops:
    """Every stop of the arm, in the order of visits.

    attained: (v, k, 3) targets as measured, NaN where not [m].  commanded: the same as each cell
    predicts it, by its name.  pose: (v,) name of the pose.  way: (v,) number of the direction of
    approach, -1 unknown.  place: (v,) in the order of visits.  linked: (v,) True where the stop
    before is in the data.  held: (v,) True where no fit has seen the pose.
    """

    attained: Array
    commanded: Mapping[str, Array]
    pose: Array
    way: Array
    place: Array
    linked: Array
    held: Array

    def poses(self) -> StopPoses:
        """Names of the P poses as they were first visited, and (v,) the number of each stop's."""
        names, first, number = np.unique(self.pose, return_index=True, return_inverse=True)
        order = np.argsort(first)
        return StopPoses(names[order], np.argsort(order)[number])

    def take(self, rows: Array) -> ArmStops:
        """Some of the stops.  rows: (v,) mask."""
        arrays = {name: part[rows] for name, part in vars(self).items() if name != "commanded"}
        commanded = {name: points[rows] for name, points in self.commanded.items()}
        return ArmStops(commanded=commanded, **arrays)


def build_stops(data: Measurements, commanded: Mapping[str, Array], held: Array) -> ArmStops:
    """Stops from rows.  data: with its history.  commanded: (m, k, 3) by name.  held: (m,).

    Rows that follow each other at the same joints are one stop, unless a `pose` label says that
    the pose was visited again: the arm did not move, so they tell nothing of repeatability.
    """
    order = rows_in_visit_order(data)
    linked = follows_previous_pose(data)[order]
    new = ~linked | (np.abs(joint_moves(data)[order]) > MIN_JOINT_MOVE).any(axis=1)
    label = data.columns.get("pose", np.full(data.poses, "")).astype(str)
    new |= label[order] != ""
    new[0] = True
    stop = np.empty(data.poses, dtype=int)
    stop[order] = np.cumsum(new) - 1
    first, count = order[new], int(new.sum())
    seen = np.ones(count, dtype=bool)
    np.logical_and.at(seen, stop, held)
    return ArmStops(
        attained=group_means(data.y, stop, count),
        commanded={key: group_means(points, stop, count) for key, points in commanded.items()},
        pose=pose_names(data, label)[first],
        way=approach_directions(data)[first],
        place=np.arange(count),
        linked=linked[new],
        held=seen,
    )


def pose_names(data: Measurements, label: Array) -> Array:
    """(m,) name of each row's pose: its label, else the line at which it stands first."""
    _, first, group = np.unique(group_repeated_poses(data), return_index=True, return_inverse=True)
    told = np.flatnonzero(label != "")
    name = np.array([data.called(line) for line in data.line[first]], dtype=object)
    name[group[told[::-1]]] = label[told[::-1]]  # of two labels the first
    return np.asarray(name[group].astype(str))


def approach_directions(data: Measurements) -> Array:
    """(m,) number of the direction of approach, -1 unknown: the sense of each joint's last move.

    data: with its history.  A joint whose sense no row tells does not count.
    """
    stems = [f"approach{j + 1}" for j in range(data.q.shape[1])]
    sense = np.sign(np.nan_to_num(np.stack([data.columns[s].astype(float) for s in stems], axis=1)))
    sense = sense[:, (sense != 0.0).any(axis=0)]
    unknown = (sense == 0.0).any(axis=1) | (sense.shape[1] == 0)
    number = np.unique(sense, axis=0, return_inverse=True)[1].reshape(-1)
    return np.where(unknown, -1, number)


@dataclass(frozen=True, eq=False)
class IsoAccuracy:
    """Accuracy of one cell over P poses, NaN where not available.

    position: (P, 3) AP_x, AP_y, AP_z of the TCP; targets: (P, k, 3) of each target; along the axes
    of the base [m].  euler: (P, 3) AO_a, AO_b, AO_c.  angle: (P,) AO' [rad].  pairs, moves,
    repeated: AD of all pairs of poses, of stops that follow each other, of pairs visited again [m].
    """

    position: Array
    targets: Array
    euler: Array
    angle: Array
    pairs: Array
    moves: Array
    repeated: Array


@dataclass(frozen=True, eq=False)
class IsoRepeatability:
    """Repeatability of P poses; no calibration enters.  NaN where not available.

    stops: (P,) visits at which the TCP was measured.  ways: (P,) known directions of approach.
    one_way: (P,) RP of the worst single direction.  all_ways: (P,) RP over all visits.  variation:
    (P,) vAP.  targets: (P, k) RP of each target over all visits [m].  euler: (P, 3) RO_a, RO_b,
    RO_c = 3 S.  angle: (P,) RO' = mean + 3 S of the angle from the mean orientation [rad].
    distance: (N,) RD [m].
    """

    stops: Array
    ways: Array
    one_way: Array
    all_ways: Array
    variation: Array
    targets: Array
    euler: Array
    angle: Array
    distance: Array


@dataclass(frozen=True, eq=False)
class CellView:
    """Points as one cell sees them, in the axes of its base, NaN where not known.

    attained, commanded: (v, 3) TCP [m].  off: (v, k, 3) of each target, attained minus commanded
    [m].  turn, goal: (v, 3, 3) orientation attained and commanded.
    """

    attained: Array
    commanded: Array
    off: Array
    turn: Array
    goal: Array


def build_cell_view(
    cell: Cell, attained: Array, commanded: Array, spots: Array, tcp: int | Array
) -> CellView:
    """What a cell makes of targets attained and commanded: (v, k, 3) each [m].

    spots: (k, 3) of these targets in the last frame [m].  tcp: (3,) in the last frame [m], (0,) for
    the centroid of the targets, or a target's number.
    """
    axes, origin = cell.base[:3, :3], cell.base[:3, 3]
    both = [(points - origin) @ axes for points in (attained, commanded)]
    turns = [fit_rotations(spots, points) for points in both]

    def place(points: Array, turn: Array) -> Array:
        if isinstance(tcp, int):
            return points[:, tcp]
        centre = points.mean(axis=1)
        return np.asarray(centre + turn @ (tcp - spots.mean(axis=0)) if len(tcp) else centre)

    places = [place(points, turn) for points, turn in zip(both, turns, strict=True)]
    return CellView(places[0], places[1], both[0] - both[1], turns[0], turns[1])


def compute_iso_accuracy(poses: CellView, each: CellView, stops: ArmStops) -> IsoAccuracy:
    """Accuracy as one cell sees it.

    poses: of the barycentres of each pose.  each: of every stop.  The TCP and the orientation of
    the barycentres are the means over the visits, to the first order of their scatter; with them
    one reflector that is measured at one nest after the other gives a pose too.
    """
    deviation = euler_deviation(poses.turn, poses.goal)
    deviation[:, ::2][is_near_gimbal_lock(poses)] = np.nan
    known = np.flatnonzero(np.isfinite(poses.attained[:, 0]))
    thin = known[
        np.unique(np.linspace(0, len(known) - 1, min(len(known), MAX_PAIRED_POSES)).astype(int))
    ]
    after = stops.linked[1:] & (np.diff(stops.place) == 1) & (stops.pose[1:] != stops.pose[:-1])
    step = [np.linalg.norm(np.diff(at, axis=0), axis=1) for at in (each.attained, each.commanded)]
    moved = (step[0] - step[1])[after]
    return IsoAccuracy(
        position=poses.attained - poses.commanded,
        targets=poses.off,
        euler=deviation,
        angle=orientation_error(poses.turn, poses.goal),
        pairs=distance_accuracy(poses.attained[thin], poses.commanded[thin]),
        moves=moved[np.isfinite(moved)],
        repeated=distance_accuracy_and_repeatability(each.attained, each.commanded, stops.pose)[0],
    )


def is_near_gimbal_lock(view: CellView) -> Array:
    """(v,) True where the commanded orientation is near gimbal lock."""
    level = np.cos(euler_angles(view.goal)[:, 1])
    return np.asarray(np.nan_to_num(level, nan=1.0) < MIN_GIMBAL_LOCK_COSINE)


def compute_iso_repeatability(view: CellView, stops: ArmStops) -> IsoRepeatability:
    """Repeatability, from what is attained beside what is commanded at every stop.

    Where all visits of a pose have the same joints that is the scatter of the attained points;
    where they differ a little, each counts from its own commanded point.
    """
    names, pose = stops.poses()
    count = len(names)
    off = view.attained - view.commanded
    known = np.isfinite(off[:, 0])
    both = np.stack([pose, stops.way])
    seen = np.unique(both[:, known & (stops.way >= 0)], axis=1)
    pairs, member = np.unique(both, axis=1, return_inverse=True)
    single = position_repeatability(off, member.reshape(-1), pairs.shape[1])
    told = pairs[1] >= 0
    one_way = np.full(count, np.nan)
    np.fmax.at(one_way, pairs[0][told], single[told])
    deviation = 3.0 * group_standard_deviations(euler_deviation(view.turn, view.goal), pose, count)
    near = group_means(is_near_gimbal_lock(view).astype(float), pose, count) > 0.0
    deviation[:, ::2][near] = np.nan
    turn = np.swapaxes(view.goal, 1, 2) @ view.turn
    angle = orientation_error(turn, mean_rotations(turn, pose, count)[pose])
    each = [position_repeatability(view.off[:, i], pose, count) for i in range(view.off.shape[1])]
    return IsoRepeatability(
        stops=np.bincount(pose[known], minlength=count),
        ways=np.bincount(seen[0], minlength=count),
        one_way=one_way,
        all_ways=position_repeatability(off, pose, count),
        variation=multidirectional_variation(off, pose, stops.way, count),
        targets=np.stack(each, axis=1),
        euler=deviation,
        angle=group_means(angle, pose, count) + 3.0 * group_standard_deviations(angle, pose, count),
        distance=distance_accuracy_and_repeatability(view.attained, view.commanded, stops.pose)[1],
    )
