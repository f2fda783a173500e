"""Rows in which targets stand under each other's names."""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.checks import orders_of
from minimax_cal.measuring.faults.distances import Between, between
from minimax_cal.measuring.faults.fault import NO_ERROR, Amount, Fault
from minimax_cal.measuring.faults.limits import outlier_limit
from minimax_cal.measuring.measurements import Measurements


def swapped_rows(data: Measurements, error: Array = NO_ERROR) -> tuple[Fault, ...]:
    """Rows whose distances fit under other names of their targets, and not under their own.

    error: (k, m, 3) of a fit, in the axes of the data [m]; it tells orders apart whose distances
    are alike.
    """
    predicted = data.y - np.moveaxis(error, 0, 1) if len(error) else np.zeros_like(data.y)
    apart = between(data)
    if len(apart.pairs) < 3:
        return ()
    limit = outlier_limit(len(apart.pairs), data.poses, data.poses)
    cost = np.nansum((apart.off / apart.sigma[:, None]) ** 2, axis=0)
    orders: list[Array] = []
    rows: list[int] = []
    for row in np.flatnonzero(cost > 9.0 * limit):
        order, least = best_order(data.y[row], apart, predicted[row])
        if least < limit and np.any(order != np.arange(len(order))):
            rows.append(int(row))
            orders.append(order)
    if not rows:
        return ()
    return (
        Fault(
            "swapped_rows",
            "all",
            f"targets stand under each other's names in {len(rows)} rows: "
            f"{data.list_rows(np.array(rows))}",
            np.array(rows),
            np.stack(orders),
            (Amount("rows", float(len(rows))),),
        ),
    )


def best_order(point: Array, apart: Between, predicted: Array) -> tuple[Array, float]:
    """Where each target of a row seems to stand, and the squared deviation left over.

    point: (k, 3) [m].  predicted: (k, 3), zeros for unknown [m].  Of orders that fit alike (a
    triangle of equal sides) the one nearest to the prediction, else the least changed.
    """
    k = len(point)
    seen = np.flatnonzero(np.isfinite(point[:, 0]))
    count = len(seen)
    if count < 3:
        return np.arange(k), np.inf
    found: list[tuple[float, float, Array]] = []
    for some in orders_of(count):
        order = np.arange(k)
        order[seen] = seen[list(some)]
        moved = point[order]
        distance = np.linalg.norm(moved[apart.pairs[:, 0]] - moved[apart.pairs[:, 1]], axis=-1)
        cost = float(np.nansum(((distance - apart.centre) / apart.sigma) ** 2))
        miss = float(np.nansum((moved - predicted)[seen] ** 2))
        changed = float((order != np.arange(k)).sum())
        found.append((cost, miss if predicted.any() else changed, order))
    least = min(cost for cost, _, _ in found)
    alike = [entry for entry in found if entry[0] < least + 4.0 * count]
    return min(alike, key=lambda entry: entry[1])[2], least
