"""Errors cut by target, direction and region."""

from __future__ import annotations

import math

import numpy as np

from minimax_cal.diagnosing.where.answer import Region, TargetGap
from minimax_cal.ground.arrays import Array, rms


def by_target(names: tuple[str, ...], error: Array, sight: Array) -> tuple[TargetGap, ...]:
    """One `TargetGap` a target.  error, sight (unit vectors): (k, m, 3), NaN if not measured."""
    gaps = []
    for name, all_rows, away in zip(names, error, sight, strict=True):
        seen = np.isfinite(all_rows[:, 0])
        rows, far = all_rows[seen], np.linalg.norm(all_rows[seen], axis=1)
        if not len(rows):
            gaps.append(TargetGap(name, 0, math.nan, math.nan, np.full(3, np.nan), math.nan))
            continue
        along = float((rows * away[seen]).sum(axis=1).mean())
        gaps.append(TargetGap(name, len(rows), rms(far), float(far.max()), rows.mean(0), along))
    return tuple(gaps)


def by_direction(error: Array, point: Array, sight: Array, up: Array) -> dict[str, float]:
    """RMS along each direction [m]; `across` is per axis, so that white noise is alike in all.

    radial points away from the vertical through the base's origin, tangential around it.
    error, point, sight: (k, m, 3) in base axes.
    """
    radial, around = round_axis(point, up)
    along = {
        "x": error[..., 0],
        "y": error[..., 1],
        "z": error[..., 2],
        "radial": (error * radial).sum(-1),
        "tangential": (error * around).sum(-1),
        "vertical": error @ (up / np.linalg.norm(up)),
        "along_sight": (error * sight).sum(-1),
    }
    out = {name: rms(values) for name, values in along.items()}
    square = 3.0 * rms(error) ** 2 - out["along_sight"] ** 2
    return out | {"across_sight": math.sqrt(max(0.0, 0.5 * square))}


def round_axis(point: Array, up: Array) -> tuple[Array, Array]:
    """Unit vectors (..., 3) away from the axis `up` through the origin, and around it."""
    axis = up / np.linalg.norm(up)
    flat = point - (point @ axis)[..., None] * axis
    radial = flat / np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-9)
    return radial, np.cross(axis, radial)


def by_region(error: Array, point: Array, up: Array) -> tuple[Region, ...]:
    """RMS in cells of equal number by radius and height, 3 x 3 (2 x 2 under 90 points)."""
    axis = up / np.linalg.norm(up)
    seen = np.isfinite(error[..., 0])
    spots, square = point[seen], (error[seen] ** 2).sum(-1)
    height = spots @ axis
    radius = np.linalg.norm(spots - height[:, None] * axis, axis=1)
    few = len(spots) < 90
    out, away = ["close in", "far out"], ["low", "high"]
    if not few:
        out, away = ["close in", "midway", "far out"], ["low", "mid-height", "high"]
    rings = np.quantile(radius, np.linspace(0.0, 1.0, len(out) + 1))
    floors = np.quantile(height, np.linspace(0.0, 1.0, len(away) + 1))
    ring = np.searchsorted(rings[1:-1], radius, side="right")
    floor = np.searchsorted(floors[1:-1], height, side="right")
    cells = []
    for i, far in enumerate(out):
        for j, high in enumerate(away):
            inside = (ring == i) & (floor == j)
            if inside.sum() < 9:  # the RMS of a few points is luck
                continue
            edges = (float(rings[i]), float(rings[i + 1])), (float(floors[j]), float(floors[j + 1]))
            rms = float(np.sqrt(square[inside].mean()))
            cells.append(Region(f"{far} and {high}", *edges, int(inside.sum()), rms))
    return tuple(cells)
