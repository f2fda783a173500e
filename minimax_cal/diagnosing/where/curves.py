"""Smooth curves of each joint's turn against joints, time and temperature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.diagnosing.where.features import scaled
from minimax_cal.diagnosing.where.gaps import plain
from minimax_cal.diagnosing.where.trends import clock
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements

GRID = 25


@dataclass(frozen=True, eq=False)
class Maps:
    """Smooth curves of each joint's equivalent residual against one thing at a time.

    against: c names, q1 ... qn, clock, temperature.  grid: (c, 25) [rad, m, -, C].
    value, sigma: (c, n, 25) curve and its standard error, NaN where no poses are near [rad, m].
    """

    against: tuple[str, ...]
    grid: Array
    value: Array
    sigma: Array

    def to_dict(self) -> dict[str, object]:
        """For JSON, in milliradians or millimetres; null where no poses are near."""

        def curve(values: Array, scale: float) -> list[float | None]:
            return [plain(v, scale) for v in values]

        return {
            name: {
                "at": curve(self.grid[i], 1.0),
                "joint_milli": [curve(row, 1e3) for row in self.value[i]],
                "sigma_milli": [curve(row, 1e3) for row in self.sigma[i]],
            }
            for i, name in enumerate(self.against)
        }


def maps(data: Measurements, turn: Array) -> Maps:
    """Kernel means (Nadaraya-Watson) of turn (m, n) against joints, clock and temperature."""
    columns = {f"q{i + 1}": column for i, column in enumerate(data.q.T)}
    columns["clock"] = clock(data)
    hot = data.columns.get("temperature", np.zeros(0))
    if np.isfinite(hot).sum() > 8:
        columns["temperature"] = hot
    x = np.stack(list(columns.values()))
    share = np.stack([scaled(column) for column in x])
    steps = np.linspace(0.0, 1.0, GRID)
    width = 0.25 * data.poses**-0.2  # of the range
    weight = np.exp(-0.5 * ((steps[:, None] - share[:, None, :]) / width) ** 2)
    weight = np.where(np.isfinite(share)[:, None, :], weight, 0.0)
    many = weight.sum(-1, keepdims=True)
    near = many**2 / np.maximum((weight**2).sum(-1, keepdims=True), 1e-300) >= 3.0
    mean = weight @ turn / np.maximum(many, 1e-300)
    twice = weight**2
    square = twice @ turn**2 - 2.0 * mean * (twice @ turn) + mean**2 * twice.sum(-1, keepdims=True)
    error = np.sqrt(np.maximum(square, 0.0)) / np.maximum(many, 1e-300)
    low, high = np.nanmin(x, axis=1)[:, None], np.nanmax(x, axis=1)[:, None]
    value, sigma = (np.where(near, a, np.nan).swapaxes(1, 2) for a in (mean, error))
    return Maps(tuple(columns), low + (high - low) * steps, value, sigma)
