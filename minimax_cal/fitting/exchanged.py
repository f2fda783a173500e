"""Rows that hold each other's points: found by where the arm would have been."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from minimax_cal.fitting import start
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.model import in_base, model_of
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot

ROUNDS = 5
APART = 8.0  # times the typical miss, and this share of the reach: no error of the arm
LEAST = 0.02
CLOSE = 3.0  # times the typical miss: where a row belongs


def misplaced(robot: Robot, data: Measurements) -> tuple[Array, Array]:
    """Rows whose points belong to other poses: (b,) rows, and (b,) the row whose points are theirs.

    A row whose points belong nowhere has itself there.
    """
    rows = np.arange(data.poses)
    good = np.ones(data.poses, dtype=bool)
    miss = np.zeros(data.poses)
    predicted = np.zeros(0)
    model = model_of(robot, data)
    for _ in range(ROUNDS):
        frame = start.fit_base(model_of(robot, data.take(good)), robot.mdh)
        links = kinematics.chain(frame.state.mdh, model.q, model.prismatic)
        predicted = kinematics.points(links, frame.state.target_positions)
        measured = in_base(frame.state, model.y)
        squares = (np.where(model.seen[:, None], measured - predicted, 0.0) ** 2).sum(axis=(0, 1))
        miss = np.sqrt(squares / np.maximum(model.seen.sum(axis=0), 1))
        typical = float(np.median(miss[good]))
        limit = max(APART * typical, LEAST * robot.reach())
        if not (miss > limit).any() and good.all():
            break
        kept = miss < max(CLOSE * float(np.median(miss)), limit)
        if (kept == good).all() or kept.sum() < max(10, data.poses // 2):
            break
        good = kept
    bad = rows[miss > max(APART * float(np.median(miss)), LEAST * robot.reach())]
    if not len(bad) or len(bad) > data.poses // 5:
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
    off = measured[:, :, None, bad] - predicted[:, :, bad, None]  # of points b at pose a
    both = model.seen[:, None, bad] & model.seen[:, bad, None]
    distance = np.sqrt((off**2).sum(axis=1) * both).sum(axis=0) / np.maximum(both.sum(axis=0), 1)
    pose, points = linear_sum_assignment(distance)
    fits = distance[pose, points] < max(CLOSE * typical, LEAST * robot.reach() / 4.0)
    return bad, bad[np.where(fits, points, pose)]


def put_right(data: Measurements, rows: Array, source: Array) -> Measurements:
    """Points put where they belong; rows that belong nowhere are left out."""
    y = data.y.copy()
    y[rows] = data.y[source]
    lost = rows[rows == source]
    kept = np.ones(data.poses, dtype=bool)
    kept[lost] = False
    return data.with_y(y).take(kept)
